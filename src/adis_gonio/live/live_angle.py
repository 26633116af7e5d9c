"""The present angle from arriving samples: raw, corrected, and with uncertainty.

The angle is positive for the stage's positive turn. The raw angle takes the readings as they are: equal
gains, square axes and no bias. If a calibration states the stage's zero, the angle is 0 there, otherwise it
is 0 if X reads +1 g.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, GYRO_OFF, GYRO_OUT, TEMP_OUT
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.live.smoothed_meter import Smoothed, SmoothedMeter, corrected_angle, sensing_of
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.source import ChipSource, Measuring, SampleStream, Settings, open_source
from adis_gonio.record.stillness import limits_from_noise, window_samples

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

EVERY_S = 0.1
"""Default time in s between two readings of the angle, slow enough for a person to follow."""


@dataclass(frozen=True)
class LiveAngle:
    """Reading of the angle, averaged over a short span of samples.

    Attributes
    ----------
    time_s : float
        Time in s from the first sample to the end of the span.
    angle_deg : float
        Angle computed from the uncorrected readings, within ±180°.
    corrected_deg : float or None
        Angle computed with the calibration; None without a calibration, or if gravity is perpendicular to
        the plane.
    u_deg : float or None
        Standard uncertainty of the corrected angle: by the noise of the newest samples, and by the
        calibration. Without a calibration by the noise alone. None if unknown, and with a single sample.
    still : bool or None
        True if no axis varies by more than at rest, over a window of samples; None until the first window
        is complete.
    spread_mg : float or None
        Standard deviation of the newest samples, of the axis with the largest; None with a single sample.
    temperature_c : float or None
        Mean temperature over the span; None if the sensor has no thermometer.
    lost : int
        Number of samples missed since the first.
    smoothed : Smoothed or None
        Angle at a fixed time (the lag) before the newest sample, computed from gyros and gravity together;
        None without gyros, and until a lag has passed.
    notes : tuple of str
        `calibration` if the reading at rest contradicts the calibration; the difference is then part of
        every u.
    """

    time_s: float
    angle_deg: float
    corrected_deg: float | None
    u_deg: float | None
    still: bool | None
    spread_mg: float | None
    temperature_c: float | None
    lost: int
    smoothed: Smoothed | None = None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the reading as one flat JSON object; the entries of `smoothed` are null if it is None."""
        document = asdict(self)
        notes = document.pop("notes")
        smoothed = document.pop("smoothed") or {
            **dict.fromkeys(Smoothed.__dataclass_fields__),
            "notes": notes,
        }
        return document | smoothed | {"notes": list(smoothed["notes"])}


def raw_angle_deg(accel_mg: Floats) -> Floats:
    """Return the angles (n,) in degrees, within ±180°, that uncorrected readings (n, 2 or more) show.

    The readings may have any unit. The angle θ is 0 if X reads +1 g, and follows from U_x = G cos(−θ) and
    U_y = G sin(−θ), with readings U and gravity G: the convention of `model.measurement` for a start angle
    of 0.
    """
    return np.asarray(np.degrees(np.arctan2(-accel_mg[..., 1], accel_mg[..., 0])))


class AngleMeter:
    """Computes readings of the angle from blocks of samples.

    Parameters
    ----------
    measuring : Measuring
        Settings of the sensor.
    noise_mg, step_mg : float
        Standard deviation of a sample at rest, and step of the analogue-to-digital converter. They limit
        the variation that counts as rest.
    calibration : Calibration or None
        Calibration for the sensor's present offsets (`calibration_for`); None for the raw angle only.
    every_s : float
        Least length in time of the span of samples that one reading averages.
    smoother : SmoothedMeter or None
        Computes the smoothed angle; None for readings without it.
    """

    def __init__(
        self,
        measuring: Measuring,
        noise_mg: float,
        step_mg: float,
        calibration: Calibration | None = None,
        every_s: float = EVERY_S,
        smoother: SmoothedMeter | None = None,
    ) -> None:
        self._smoother = smoother
        self._calibration = calibration
        self._window = window_samples(measuring)
        self._limits = limits_from_noise(np.full(3, noise_mg), self._window, step_mg)
        self._least = max(1, round(every_s * measuring.sample_rate_hz))
        # Samples behind the filter are correlated: this is the number of independent ones per sample.
        filter_m = measuring.filter_m if isinstance(measuring, Configuration) else 0
        self._independent = white_noise_gain(filter_m) ** 2 if filter_m else 1.0
        self._waiting: list[Block] = []
        self._kept = np.empty((0, 3))
        self._first_s: float | None = None
        self._lost = 0

    def feed(self, block: Block) -> LiveAngle | None:
        """Add a block of samples; return a reading if the block completes a span, else None."""
        self._lost += block.lost
        if not len(block):
            return None
        if self._smoother is not None:
            self._smoother.feed(block)
        if self._first_s is None:
            self._first_s = float(block.time_s[0])
        self._waiting.append(block)
        if sum(map(len, self._waiting)) < self._least:
            return None
        blocks, self._waiting = self._waiting, []
        return self._reading(blocks, self._first_s)

    def _reading(self, blocks: list[Block], first_s: float) -> LiveAngle:
        accel = np.concatenate([block.accel_mg for block in blocks])
        # Keep a window of the newest samples, or all of this span.
        self._kept = np.concatenate([self._kept, accel])[-max(self._window, len(accel)) :]
        mean = accel.mean(axis=0)
        known = [columns["temp_c"] for block in blocks if "temp_c" in (columns := session_columns(block))]
        temperature_c = float(np.concatenate(known).mean()) if known else None
        spread_mg = u_mg = still = None
        if len(self._kept) > 1:
            # Uncertainty of the mean by the scatter of the newest samples.
            spread_mg = self._kept.std(axis=0, ddof=1)
            u_mg = spread_mg / math.sqrt(max(1.0, len(accel) * self._independent))
        if spread_mg is not None and len(self._kept) >= self._window:
            # Only the upper limit is tested: a stuck axis is reported by `bringup`.
            still = bool((spread_mg <= self._limits.upper).all())
        end_s = float(blocks[-1].time_s[-1])
        smoothed, off_deg = None, 0.0
        if self._smoother is not None:
            if still:
                self._smoother.take_rest(mean, temperature_c)
            off_deg, smoothed = self._smoother.off_deg, self._smoother.reading(end_s)
        raw_deg, u_deg = self._raw(mean, u_mg)
        corrected_deg = None
        if self._calibration is not None:
            corrected_deg, u_deg = corrected_angle(self._calibration, mean, temperature_c, u_mg)
            u_deg = None if u_mg is None or u_deg is None else math.hypot(u_deg, off_deg)
        return LiveAngle(
            end_s - first_s,
            raw_deg,
            corrected_deg,
            u_deg,
            still,
            None if spread_mg is None else float(spread_mg.max()),
            temperature_c,
            self._lost,
            smoothed,
            ("calibration",) if off_deg else (),
        )

    def _raw(self, mean_mg: Floats, u_mg: Floats | None) -> tuple[float, float | None]:
        x, y = float(mean_mg[0]), float(mean_mg[1])
        zero_deg = 0.0
        if self._calibration is not None and "alpha" in self._calibration:
            zero_deg = self._calibration["alpha"].value
        u_deg = None
        if u_mg is not None and (x or y):
            u_deg = math.degrees(math.hypot(y * u_mg[0], x * u_mg[1]) / (x * x + y * y))
        return wrap_degrees(zero_deg + float(raw_angle_deg(mean_mg))), u_deg


@dataclass(frozen=True)
class LiveSource:
    """An open sensor with running samples.

    Attributes
    ----------
    measuring : Measuring
        Settings of the sensor.
    stream : SampleStream
        The running samples, in blocks.
    noise_mg, step_mg : float
        Noise of a sample at rest, and step of the analogue-to-digital converter.
    part : str
        Name of the sensor's variant.
    offsets_lsb, gyro_offsets_lsb : tuple of int or None
        Numbers in XACCL_OFF, YACCL_OFF, ZACCL_OFF and in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF; None without
        registers.
    """

    measuring: Measuring
    stream: SampleStream
    noise_mg: float
    step_mg: float
    part: str
    offsets_lsb: tuple[int, ...] | None = None
    gyro_offsets_lsb: tuple[int, ...] | None = None


def calibration_for(calibration: Calibration, source: LiveSource) -> Calibration:
    """Return the calibration adapted to the present values of a sensor's offset registers.

    Raises
    ------
    UsageError
        The calibration belongs to another sensor, or is for readings in counts.
    """
    where = calibration.provenance
    if where.counts:
        raise UsageError("the calibration takes readings in counts of unknown scale; a sensor gives mg")
    if where.sensor != source.part:
        raise UsageError(f"the calibration is of sensor {where.sensor}, this is sensor {source.part}")
    return calibration.for_registers(source.offsets_lsb, source.gyro_offsets_lsb)


@contextmanager
def open_live(
    url: str,
    *,
    variant: str = "adis16354",
    check: bool = True,
    data_ready: bool | None = None,
    gyros: bool = True,
) -> Iterator[LiveSource]:
    """Open a sensor and start sampling; the settings of the sensor are not changed.

    A block of samples is half as long as the span that one reading of the angle averages.

    Parameters
    ----------
    url : str
        Address of the sensor or its bridge.
    variant : str
        Name of the sensor's variant.
    check : bool
        True to check at the start that the chip is of this variant.
    data_ready : bool or None
        None to start scans at data-ready edges if possible; False polls.
    gyros : bool
        False leaves the gyros out, so that a slow bridge has fewer registers to read.

    Raises
    ------
    UsageError, CannotOpenError, BusError, ChipError
        The sensor cannot be opened, its manual self-test is on, or its samples cannot be read.
    """
    with ExitStack() as stack:
        source = stack.enter_context(open_source(url, variant=variant, check=check))
        offsets: tuple[tuple[int, ...], ...] = ()
        if isinstance(source, ChipSource):
            source.refuse_self_test()
            offsets = tuple(tuple(source.sensor.read(name) for name in of) for of in (ACCEL_OFF, GYRO_OFF))
            settings = source.sensor.configuration()
            measuring: Measuring = settings
            count = _block_samples(measuring)
            # If the range of the gyros is unknown, their scale factor is unknown too.
            turning = GYRO_OUT if gyros and settings.gyro_range_dps is not None else ()
            names = (*ACCEL_OUT, TEMP_OUT[0], *turning)
            stream: SampleStream = source.sensor.stream(names, block_scans=count, data_ready=data_ready)
        else:
            measuring = source.configure(Settings())
            stream = source.samples(Settings(), _block_samples(measuring))
        stack.enter_context(stream)
        noise_mg = source.expected_noise_mg(measuring)
        part = source.part
        yield LiveSource(measuring, stream, noise_mg, part.step_mg, part.name, *offsets)


def live_angles(
    source: LiveSource, calibration: Calibration | None = None, *, lag_s: float
) -> Iterator[LiveAngle]:
    """Yield the angles of a running sensor.

    `calibration` is None for raw angles, `lag_s` the delay of the smoothed angle.

    Raises
    ------
    UsageError
        The calibration belongs to another part; the lag `lag_s` is negative or above 10 s.
    BusError, ChipError
        The link broke, or the sensor does not answer.
    """
    now = None if calibration is None else calibration_for(calibration, source)
    sensing = sensing_of(source.measuring, source.part, source.noise_mg)
    smoother = SmoothedMeter(sensing, now, lag_s=lag_s)
    meter = AngleMeter(source.measuring, source.noise_mg, source.step_mg, now, smoother=smoother)
    for block in source.stream:
        reading = meter.feed(block)
        if reading is not None:
            yield reading


def _block_samples(measuring: Measuring) -> int:
    return max(1, round(EVERY_S * measuring.sample_rate_hz / 2))
