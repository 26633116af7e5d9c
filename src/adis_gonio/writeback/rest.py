"""A dwell at rest by polling: read frames alone, so that nothing but the offsets is ever written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.errors import SessionError, UsageError
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Floats
from adis_gonio.sensor.decoding import ScanBlock, join
from adis_gonio.sensor.driver import Adis16354
from adis_gonio.sensor.registers import ACCEL_OUT
from adis_gonio.sensor.scanning import ScanStream
from adis_gonio.sensor.settings import Configuration
from adis_gonio.sensor.variants import variant
from adis_gonio.session.settings import LEAST_SAMPLES
from adis_gonio.session.stillness import limits_from_noise
from adis_gonio.session.watch import NoiseMeter, StillnessWatch, white_noise_gain, window_samples

REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")


@dataclass(frozen=True)
class Rest:
    """Means of a dwell.

    Attributes
    ----------
    mean_mg, u_mg : (3,) float
        Mean reading and its standard uncertainty: the noise, and the rounding where noise does not blur it.
    temperature_c, supply_v : float
    samples : int
    """

    mean_mg: Floats
    u_mg: Floats
    temperature_c: float
    supply_v: float
    samples: int

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "mean_mg": self.mean_mg.tolist(),
            "u_mg": self.u_mg.tolist(),
            "temperature_c": self.temperature_c,
            "supply_v": self.supply_v,
            "samples": self.samples,
        }


def measure(sensor: Adis16354, dwell_s: float, patience_s: float) -> Rest:
    """Wait until the part is at rest, then take a dwell with the settings that the sensor has.

    Parameters
    ----------
    dwell_s : float
        Length of the dwell in s.
    patience_s : float
        How long to wait for rest, in s, beside what the watch needs.

    Raises
    ------
    UsageError
        The dwell is too short for the sensor's rate.
    SessionError
        It does not come to rest, moves within the dwell, or an axis is stuck.
    BusError, SilentChipError
        The sensor does not answer.
    """
    now = sensor.configuration()
    if dwell_s < LEAST_SAMPLES * now.sample_period_s:
        raise UsageError(
            f"a dwell of {dwell_s:g} s is too short at {now.sample_rate_hz:.4g} samples a second: take"
            f" {LEAST_SAMPLES * now.sample_period_s:.3g} s or more, or set SMPL_PRD"
        )
    window = window_samples(now)
    block = max(8, window // 2)
    with sensor.stream(REGISTERS, block_scans=block, leave_registers=True, data_ready=False) as stream:
        noise = _noise(sensor, stream, now, patience_s)
        scans = _dwell(sensor, stream, noise, window, dwell_s)
    return _means(scans, now)


def _noise(sensor: Adis16354, stream: ScanStream, now: Configuration, patience_s: float) -> Floats:
    expected = sensor.variant.performance.noise_mg * white_noise_gain(now.filter_m)
    meter = NoiseMeter(window_samples(now), expected)
    seen, begin_s = 0, sensor.bus.now_s()
    for scans in stream:
        noise = meter.feed(scans.accel_mg)
        if noise is not None:
            return noise
        seen += len(scans)
        # A slow bridge needs its time for the windows that the meter compares.
        if seen > meter.least_samples and sensor.bus.now_s() - begin_s > patience_s:
            break
    raise SessionError(
        f"the part does not come to rest: a sample varies by {max(meter.spread_mg):.3g} mg, its noise"
        f" should be about {expected:.2g} mg; put it on a quiet support and try again"
    )


def _dwell(sensor: Adis16354, stream: ScanStream, noise: Floats, window: int, dwell_s: float) -> ScanBlock:
    step = sensor.variant.accel_mg_per_lsb
    watch = StillnessWatch(limits_from_noise(noise, window, step), np.maximum(noise, step / np.sqrt(12)))
    watch.anchor(0)
    blocks: list[ScanBlock] = []
    begin_s = sensor.bus.now_s()
    for scans in stream:
        for look in watch.feed(scans.accel_mg):
            if look.state != "still":
                raise SessionError(
                    f"the part moved within the dwell ({look.why}); let it lie and try again"
                )
        blocks.append(scans)
        enough = sum(len(b) for b in blocks) >= max(window, LEAST_SAMPLES)
        if enough and sensor.bus.now_s() - begin_s >= dwell_s:
            break
    return join(blocks)


def _means(scans: ScanBlock, now: Configuration) -> Rest:
    values = scans.values()
    accel = values[:, : len(AXES)]
    # The filter takes no noise out at the lowest frequencies: a mean is worth one of unfiltered samples.
    spread = accel.std(axis=0, ddof=1) / white_noise_gain(now.filter_m)
    lsb = variant(scans.variant).accel_mg_per_lsb
    blurred = accel.std(axis=0, ddof=1) > lsb
    rounding = lsb / np.sqrt(12) * np.where(blurred, 1 / np.sqrt(len(scans)), 1.0)
    return Rest(
        accel.mean(axis=0),
        np.hypot(spread / np.sqrt(len(scans)), rounding),
        float(values[:, len(AXES)].mean()),
        float(values[:, len(AXES) + 1].mean()),
        len(scans),
    )
