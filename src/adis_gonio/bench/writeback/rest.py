"""A dwell at rest by polling: read frames alone, so that nothing but the offsets is ever written."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.base.jsonable import OPTIONAL, JsonRecord
from adis_gonio.device.sensor.decoding import ScanBlock, join
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import ACCEL_OUT, GYRO_OUT, TEMP_OUT, Kind
from adis_gonio.device.sensor.scanning import ScanStream
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.device.sensor.variants import variant
from adis_gonio.model.effects.base import AXES
from adis_gonio.record.settings import LEAST_SAMPLES
from adis_gonio.record.stillness import limits_from_noise
from adis_gonio.record.watch import NoiseMeter, StillnessWatch, window_samples

REGISTERS = (*ACCEL_OUT, "XTEMP_OUT", "SUPPLY_OUT")
OF_GYROS = (*REGISTERS, *GYRO_OUT, *TEMP_OUT[1:])


@dataclass(frozen=True)
class Rest(JsonRecord):
    """Means of a dwell.

    Attributes
    ----------
    mean_mg, u_mg : (3,) float
        Mean reading and its standard uncertainty: the noise, and the rounding where noise does not blur it.
    temperature_c, supply_v : float
    samples : int
    mean_dps, u_dps : (3,) float or None
        The same of the gyros, where they were read.
    sample_dps : (3,) float or None
        Standard deviation of one sample of the gyros.
    temperatures_c : (3,) float or None
        Of the gyros' dies, where they were read.
    """

    document_keys = ("mean_mg", "u_mg", "temperature_c", "supply_v", "samples", "mean_dps", "u_dps")

    mean_mg: Floats
    u_mg: Floats
    temperature_c: float
    supply_v: float
    samples: int
    mean_dps: Floats | None = field(default=None, metadata=OPTIONAL)
    u_dps: Floats | None = field(default=None, metadata=OPTIONAL)
    sample_dps: Floats | None = None
    temperatures_c: Floats | None = None


def measure(sensor: Adis16354, dwell_s: float, patience_s: float, *, gyros: bool = False) -> Rest:
    """Wait until the part is at rest, then take a dwell with the settings that the sensor has.

    Parameters
    ----------
    dwell_s : float
        Length of the dwell in s.
    patience_s : float
        How long to wait for rest, in s, beside what the watch needs.
    gyros : bool
        Read these too.

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
    names = OF_GYROS if gyros else REGISTERS
    with sensor.stream(names, block_scans=block, leave_registers=True, data_ready=False) as stream:
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
    part, k = variant(scans.variant), len(AXES)
    mean, u, _ = _mean(values[:, :k], part.accel_mg_per_lsb, now)
    rest = Rest(mean, u, float(values[:, k].mean()), float(values[:, k + 1].mean()), len(scans))
    if len(scans.registers) == len(REGISTERS):
        return rest
    first = len(REGISTERS)
    lsb = part.lsb(Kind.GYRO, scans.gyro_range_dps or 300)[0]
    mean, u, sample = _mean(values[:, first : first + k], lsb, now)
    dies = np.array([rest.temperature_c, *values[:, first + k :].mean(axis=0)])
    return replace(rest, mean_dps=mean, u_dps=u, sample_dps=sample, temperatures_c=dies)


def _mean(values: Floats, lsb: float, now: Configuration) -> tuple[Floats, Floats, Floats]:
    """Mean (3,) with its standard uncertainty, and the standard deviation of a sample."""
    deviation = values.std(axis=0, ddof=1)
    # The filter takes no noise out at the lowest frequencies: a mean is worth one of unfiltered samples.
    spread = deviation / white_noise_gain(now.filter_m)
    rounding = lsb / np.sqrt(12) * np.where(deviation > lsb, 1 / np.sqrt(len(values)), 1.0)
    return values.mean(axis=0), np.hypot(spread / np.sqrt(len(values)), rounding), deviation
