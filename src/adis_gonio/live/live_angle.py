"""The present angle from arriving samples: raw, corrected, and with uncertainty.

The angle is positive for the stage's positive turn. The raw angle takes the readings as they are: equal
gains, square axes and no bias. If a calibration states the stage's zero, the angle is 0 there, otherwise it
is 0 if X reads +1 g.

`AngleMeter` averages short spans of samples, and passes all samples to the smoother of gyros and gravity.
The calibration is part of the uncertainty of both angles. Impossible values are reported and increase the
uncertainty: a length of gravity at rest that contradicts the calibration, and a zero rate that the gyros'
calibration excludes, such as with the file of another sensor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, GYRO_OFF, GYRO_OUT, TEMP_OUT, VARIANTS
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.live.motion_model import LAG_S, AngleSmoother, GyroKnowledge, Sensing
from adis_gonio.record.blocks import GENERIC, Block, block_series, count_alarms
from adis_gonio.record.source import ChipSource, Measuring, SampleStream, Settings, open_source
from adis_gonio.record.stillness import limits_from_noise, window_samples

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

GENERIC_WALK_DEG = 0.021
"""Standard deviation, in degrees, of the angle by integrated noise after one second, for gyros of unknown
noise (ADIS16350 data sheet, B)."""
LENGTH_FLOOR = 1e-3
"""Standard uncertainty of the length of gravity, as a share of it, that is added to the calibration's:
gravity differs from place to place, and biases change with temperature."""
Z_ERROR = 0.05
"""Relative error of the reading of Z that is allowed if a calibration in the plane does not determine Z
(ADIS16350 data sheet, B and D)."""


@dataclass(frozen=True)
class Smoothed:
    """The smoothed angle for display.

    Attributes
    ----------
    smoothed_deg, smoothed_u_deg : float
        Angle at one lag before the newest sample, within ±180°. Its zero is the zero of `corrected_deg`
        with a calibration, else of `angle_deg`. Standard uncertainty by noise, motion, drift and
        calibration.
    lag_s : float
        Age of the angle at the end of the span: the smoother's lag, its time step, and the delay of the
        chip's filter.
    rate_dps : float
        Rate of turn at the time of the angle.
    gyro_zero_dps, gyro_zero_u_dps : float
        Estimated zero rate that the gyro has after its calibration, and its standard uncertainty.
    notes : tuple of str
        Events within the last second or so: `gap`, `saturated`, `out_of_plane`; `calibration` or
        `gyro_calibration` if the calibration of accelerometers or gyros does not belong to this part.
    """

    smoothed_deg: float
    smoothed_u_deg: float
    lag_s: float
    rate_dps: float
    gyro_zero_dps: float
    gyro_zero_u_dps: float
    notes: tuple[str, ...]


def sensing_of(measuring: Measuring, part: str, noise_mg: float) -> Sensing:
    """Return the properties of a sensor that the smoother needs, from its settings and its variant.

    Parameters
    ----------
    measuring : Measuring
        Settings of the sensor.
    part : str
        Name of the sensor's variant.
    noise_mg : float
        Noise (rms) of a sample at rest, after the filter.
    """
    period_s = measuring.sample_period_s
    settings = measuring if isinstance(measuring, Configuration) else None
    filter_m = settings.filter_m if settings else 0
    range_dps = settings.gyro_range_dps if settings else None
    noise_mg /= white_noise_gain(filter_m)
    sensing = Sensing(period_s, noise_mg, GENERIC_WALK_DEG / math.sqrt(period_s), filter_m, range_dps)
    if part not in VARIANTS:
        return sensing
    known = VARIANTS[part].performance
    drift_mg, bias_mg = known.bias_instability_mg, known.initial_bias_mg
    return replace(sensing, gyro_noise_dps=known.gyro_noise_dps, drift_mg=drift_mg, bias_mg=bias_mg)


def corrected_angle(
    calibration: Calibration, mean_mg: Floats, temperature_c: float | None, u_mg: Floats | None = None
) -> tuple[float | None, float | None]:
    """Return the angle of a reading by a calibration, and its standard uncertainty, in degrees.

    The angle is positive for the stage's positive turn. Both results are None if the calibration refuses
    the reading, for example because its length is far from gravity. The uncertainty alone is None if it is
    not finite.

    Parameters
    ----------
    mean_mg : (3,) float
        The reading.
    temperature_c : float or None
        Its temperature; None for the mean of the session.
    u_mg : (3,) float, optional
        Standard uncertainty of the reading; without it u is the uncertainty by the calibration alone.
    """
    reading_u = None if u_mg is None else [float(u) for u in u_mg[: calibration.axes]]
    try:
        if "alpha" in calibration:
            by = calibration.stage_angle(mean_mg, temperature_c, reading_u=reading_u)
            angle_deg = float(by.angle_deg)
        else:
            by = calibration.angle(mean_mg, temperature_c, reading_u=reading_u, plane="xy")
            angle_deg = -float(by.angle_deg)
    except UsageError:
        return None, None
    u_deg = float(by.u_deg)
    return angle_deg, u_deg if math.isfinite(u_deg) else None


def _bend_of(calibration: Calibration) -> float | None:
    """Return the standard uncertainty of the slope of the calibrated angle as a function of the true angle.

    The slope is 1 for a perfect calibration. Its uncertainty is derived from the largest uncertainty of the
    angle over the turn, without the uncertainty of the start angle. None if the calibration states none.
    """
    # Standard uncertainty of the angle at eight angles over a turn.
    psi = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    unit = np.stack([np.cos(psi), np.sin(psi), np.zeros(8)], axis=1)[:, : calibration.axes]
    u_deg = calibration.angle(calibration.readings_of(unit), plane="xy").u_deg
    u_deg = u_deg[np.isfinite(u_deg)]
    # An error with two cycles per turn has a largest slope of twice its amplitude.
    return 2 * math.radians(float(u_deg.max())) if u_deg.size else None


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
        Standard uncertainty of the corrected angle: by the noise and shaking of the last second, by the 1/f
        noise since the calibration, and by the calibration. Without a calibration by noise and shaking
        alone. None if unknown.
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
        every u. `alarm` if a sample of the span has the flag EA (an error or alarm in STATUS).
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
    part : str
        Name of the sensor's variant.
    every_s : float
        Least length in time of the span of samples that one reading averages.
    lag_s : float
        Delay of the smoothed angle; 0 for the filter without smoothing.
    """

    def __init__(
        self,
        measuring: Measuring,
        noise_mg: float,
        step_mg: float,
        calibration: Calibration | None = None,
        *,
        part: str = GENERIC,
        every_s: float = EVERY_S,
        lag_s: float = LAG_S,
    ) -> None:
        self._calibration = calibration
        self._zero_deg = 0.0
        if calibration is not None and "alpha" in calibration:
            self._zero_deg = calibration["alpha"].value
        sensing = sensing_of(measuring, part, noise_mg)
        self._drift_rad = sensing.drift_mg / 1000  # gravity is 1000 mg
        self._drift_deg = math.degrees(sensing.drift_rms_mg / 1000)
        gyro = None if calibration is None else calibration.gyro
        stated = {} if gyro is None else {one.name: one.u for one in gyro.parameters}
        self._smoother = AngleSmoother(
            sensing,
            GyroKnowledge.of(gyro, stated),
            lag_s=lag_s,
            corrected=None if calibration is None else self._corrected,
            bend=None if calibration is None else _bend_of(calibration),
        )
        self._off_deg = 0.0
        """Relative error of gravity's length at the last rest, as an angle in degrees.

        It is 0 if it does not contradict the calibration.
        """
        self._noise_mg = noise_mg
        self._window = window_samples(measuring)
        self._limits = limits_from_noise(np.full(3, noise_mg), self._window, step_mg)
        self._least = max(1, round(every_s * measuring.sample_rate_hz))
        self._turns = False
        """True if the blocks have the rates of the gyros."""
        self._waiting: list[Block] = []
        self._kept = np.empty((0, 3))
        self._first_s: float | None = None
        self._lost = 0

    def feed(self, block: Block) -> LiveAngle | None:
        """Add a block of samples; return a reading if the block completes a span, else None."""
        self._lost += block.lost
        if not len(block):
            return None
        series = block_series(block)
        self._turns = "gyro" in series
        rates = series.get("gyro", np.zeros_like(block.accel_mg))
        self._smoother.feed(block.time_s, block.accel_mg, rates, series.get("temperature_c"))
        if self._first_s is None:
            self._first_s = float(block.time_s[0])
        self._waiting.append(block)
        if sum(map(len, self._waiting)) < self._least:
            return None
        blocks, self._waiting = self._waiting, []
        return self._reading(blocks, self._first_s)

    def _reading(self, blocks: list[Block], first_s: float) -> LiveAngle:
        """Return the angle by the samples of `blocks`, with u and notes; its time counts from `first_s`."""
        accel = np.concatenate([block.accel_mg for block in blocks])
        # Keep a window of the newest samples, or all of this span.
        self._kept = np.concatenate([self._kept, accel])[-max(self._window, len(accel)) :]
        mean = accel.mean(axis=0)
        known = [one["temperature_c"] for one in map(block_series, blocks) if "temperature_c" in one]
        temperature_c = float(np.concatenate(known).mean()) if known else None
        u_mg = self._smoother.gravity_u_mg(len(accel))
        spread_mg = still = None
        if len(self._kept) > 1:
            spreads = self._kept.std(axis=0, ddof=1)
            spread_mg = float(spreads.max())
            if len(self._kept) >= self._window:
                # Only the upper limit is tested: a stuck axis is reported by `bringup`.
                still = bool((spreads <= self._limits.upper).all())
                if still:
                    self._check_at_rest(mean, temperature_c, spread_mg)
        end_s = float(blocks[-1].time_s[-1])
        raw_deg, u_deg = self._raw(mean, u_mg)
        corrected_deg = None
        if self._calibration is not None:
            corrected_deg, u_deg = corrected_angle(self._calibration, mean, temperature_c, np.full(3, u_mg))
            if u_deg is not None:
                u_deg = math.hypot(u_deg, self._drift_deg, self._off_deg)
        doubts = {"calibration": self._off_deg > 0, "alarm": any(map(count_alarms, blocks))}
        notes = tuple(name for name, holds in doubts.items() if holds)
        return LiveAngle(
            end_s - first_s,
            raw_deg,
            corrected_deg,
            u_deg,
            still,
            spread_mg,
            temperature_c,
            self._lost,
            self._smoothed(end_s, notes),
            notes,
        )

    def _raw(self, mean_mg: Floats, u_mg: float) -> tuple[float, float | None]:
        length_mg = math.hypot(mean_mg[0], mean_mg[1])
        u_deg = math.degrees(u_mg / length_mg) if length_mg else None
        return wrap_degrees(self._zero_deg + float(raw_angle_deg(mean_mg))), u_deg

    def _check_at_rest(self, mean_mg: Floats, temperature_c: float | None, spread_mg: float) -> None:
        """Check the calibration at rest: compare the length of the reading `mean_mg` with local gravity.

        `temperature_c` is None if the sensor reports none: the mean of the calibration's session is taken.
        `spread_mg` is the standard deviation of the samples. Its excess over the noise is motion, slow
        enough to change the mean: a hand that begins to turn the sensor.
        If the length differs from local gravity by more than the uncertainties allow, the difference is
        added to the uncertainty of later angles, with a note.
        """
        calibration = self._calibration
        if calibration is None:
            return
        gravity = self._corrected(mean_mg, temperature_c) / calibration.gravity_mg
        along = math.hypot(float(gravity[0]), float(gravity[1]))
        if along < 0.1:
            return
        # A calibration in the plane has no Z: use the raw reading of Z, with a larger error.
        planar = len(gravity) < 3
        z = float(mean_mg[2]) / calibration.gravity_mg if planar else float(gravity[2])
        # Relative error of the length of gravity, and the largest allowed error.
        off = abs(math.hypot(along, z) - 1.0)
        _, u_deg = corrected_angle(calibration, mean_mg, temperature_c)
        across = abs(z) * Z_ERROR if planar else 0.0
        motion = math.sqrt(max(spread_mg**2 - self._noise_mg**2, 0.0)) / calibration.gravity_mg
        allowed = math.hypot(math.radians(u_deg or 0.0), 3 * self._drift_rad, LENGTH_FLOOR, across, motion)
        self._off_deg = math.degrees(off) if off > 3 * allowed else 0.0

    def _smoothed(self, end_s: float, notes: tuple[str, ...]) -> Smoothed | None:
        """Return the smoothed angle at one lag before `end_s`, the time of the last sample.

        `notes` are added to the notes of the angle. Return None until a lag has passed.
        """
        angle, calibration = self._smoother.angle() if self._turns else None, self._calibration
        if angle is None:
            return None
        u_deg, notes = angle.u_deg, (*angle.notes, *notes)
        shown_deg = wrap_degrees(angle.angle_deg + self._zero_deg)
        if calibration is not None:
            _, by_calibration = corrected_angle(calibration, angle.accel_mg, angle.temperature_c)
            u_deg = math.hypot(u_deg, by_calibration or 0.0, self._off_deg)
        return Smoothed(
            shown_deg, u_deg, end_s - angle.time_s, angle.rate_dps, angle.zero_dps, angle.zero_u_dps, notes
        )

    def _corrected(self, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """Return the calibrated gravity vector (3,) in mg; zeros if the calibration cannot compute it.

        `temperature_c` None takes the mean of the calibration's session.
        """
        assert self._calibration is not None
        try:
            gravity = self._calibration.apply(accel_mg, temperature_c) * self._calibration.gravity_mg
        except UsageError:  # shorter than any gravity in the plane
            return np.zeros(self._calibration.axes)
        return np.nan_to_num(gravity)


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
    meter = AngleMeter(
        source.measuring, source.noise_mg, source.step_mg, now, part=source.part, lag_s=lag_s
    )
    for block in source.stream:
        reading = meter.feed(block)
        if reading is not None:
            yield reading


def _block_samples(measuring: Measuring) -> int:
    return max(1, round(EVERY_S * measuring.sample_rate_hz / 2))
