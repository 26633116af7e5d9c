"""The angle as it is now, from samples that come in: raw, corrected, and how surely.

The angle is positive for the stage's positive turn. Raw, it is taken from the readings as they come, as if
gains were equal, axes square and biases zero. It is 0 at the stage's zero where a calibration knows that,
else where X reads +1 g.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import BusError, ChipError, UsageError
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, GYRO_OFF, GYRO_OUT, TEMP_OUT
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.live.smoothed_meter import Smoothed, SmoothedMeter, sensing_of
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.settings import Settings
from adis_gonio.record.source import ChipSource, Measuring, SampleStream, open_source
from adis_gonio.record.stillness import limits_from_noise, window_samples

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

EVERY_S = 0.1
"""Between two readings of the angle: what a person can follow."""


@dataclass(frozen=True)
class LiveAngle:
    """The angle over one short span of samples.

    Attributes
    ----------
    time_s : float
        End of the span, since the first sample.
    angle_deg : float
        From the readings as they come, within ±180°.
    corrected_deg : float or None
        By the calibration; None without one, and where gravity stands across the plane.
    u_deg : float or None
        Standard uncertainty of the corrected angle: of the noise within the newest samples, and of the
        calibration. Without one that of the noise alone. None where it is not known, and while there is but
        one sample.
    still : bool or None
        True where no axis varies by more than it would at rest; None until there are
        samples enough to tell.
    spread_mg : float or None
        Largest standard deviation of an axis over the newest samples.
    temperature_c : float or None
        Mean over the span; None where the sensor does not tell.
    lost : int
        Samples missed since the first.
    smoothed : Smoothed or None
        By gyros and gravity together, a lag ago; None without gyros, and until the first lag is over.
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

    def as_dict(self) -> dict[str, Any]:
        """JSON form: one object without depth; what `smoothed` tells is null without it."""
        told = asdict(self)
        smoothed = told.pop("smoothed") or dict.fromkeys(Smoothed.__dataclass_fields__)
        return told | smoothed | {"notes": list(smoothed["notes"] or ())}


def raw_angle_deg(accel_mg: Floats) -> Floats:
    """Angles (n,) within ±180° of readings (n, 2 or more) in any unit; 0 where X reads +1 g.

    From U_x = G cos(−θ), U_y = G sin(−θ): the convention of `model.measurement` with α = 0.
    """
    return np.asarray(np.degrees(np.arctan2(-accel_mg[..., 1], accel_mg[..., 0])))


class AngleMeter:
    """Turns blocks of samples into readings of the angle.

    Parameters
    ----------
    measuring : Measuring
        How the sensor measures.
    noise_mg, step_mg : float
        Noise that a sample has at rest, and step of the converter: what varies more is moving.
    calibration : Calibration or None
        As `calibration_for` gives it.
    every_s : float
        Least length of a span.
    smoother : SmoothedMeter or None
        Tells the smoothed angle too.
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
        # Samples behind the filter lean on one another: as many independent ones have its white noise.
        filter_m = measuring.filter_m if isinstance(measuring, Configuration) else 0
        self._independent = white_noise_gain(filter_m) ** 2 if filter_m else 1.0
        self._waiting: list[Block] = []
        self._kept = np.empty((0, 3))
        self._first_s: float | None = None
        self._lost = 0
        self._resume_s = self._last_s = 0.0

    def feed(self, block: Block) -> LiveAngle | None:
        """Take samples; return a reading once a span is full."""
        self._lost += block.lost
        if not len(block):
            return None
        if self._smoother is not None:
            self._smoother.feed(block)
        if self._first_s is None:
            self._first_s = float(block.time_s[0]) - self._resume_s
        self._waiting.append(block)
        if sum(map(len, self._waiting)) < self._least:
            return None
        blocks, self._waiting = self._waiting, []
        return self._reading(blocks, self._first_s)

    def restart(self) -> None:
        """The link broke: samples go on at another time, with another part of the turn behind them.

        Times count on, without the time of the break where the sensor's clock began anew.
        """
        self._waiting, self._kept = [], np.empty((0, 3))
        self._resume_s, self._first_s = self._last_s, None
        if self._smoother is not None:
            self._smoother.restart()

    def go_on(self, before: AngleMeter) -> None:
        """Count times and losses on from where another one ended."""
        self._resume_s, self._lost = before._last_s, before._lost

    def _reading(self, blocks: list[Block], first_s: float) -> LiveAngle:
        accel = np.concatenate([block.accel_mg for block in blocks])
        self._kept = np.concatenate([self._kept, accel])[-max(self._window, len(accel)) :]
        mean = accel.mean(axis=0)
        temperature_c = _temperature_c(blocks)
        raw_deg, u_deg = self._raw(mean, len(accel))
        corrected_deg = None
        if self._calibration is not None:
            corrected_deg, u_deg = self._corrected(mean, len(accel), temperature_c)
        spread_mg = self._kept.std(axis=0, ddof=1) if len(self._kept) > 1 else None
        still = None
        if spread_mg is not None and len(self._kept) >= self._window:
            # The upper limit alone: a stuck axis is a matter for `bringup`.
            still = bool((spread_mg <= self._limits.upper).all())
        end_s = float(blocks[-1].time_s[-1])
        self._last_s = end_s - first_s
        return LiveAngle(
            self._last_s,
            raw_deg,
            corrected_deg,
            u_deg,
            still,
            None if spread_mg is None else float(spread_mg.max()),
            temperature_c,
            self._lost,
            self._smoothed(mean, temperature_c, end_s, still=still),
        )

    def _smoothed(
        self, mean_mg: Floats, temperature_c: float | None, end_s: float, *, still: bool | None
    ) -> Smoothed | None:
        if self._smoother is None:
            return None
        if still:
            self._smoother.rested(mean_mg, temperature_c)
        return self._smoother.reading(end_s)

    def _u_mg(self, count: int) -> Floats | None:
        """Standard uncertainty (3,) of a mean of so many samples, from the scatter of the newest ones."""
        if len(self._kept) < 2:
            return None
        u: Floats = self._kept.std(axis=0, ddof=1) / math.sqrt(max(1.0, count * self._independent))
        return u

    def _raw(self, mean_mg: Floats, count: int) -> tuple[float, float | None]:
        x, y = float(mean_mg[0]), float(mean_mg[1])
        zero_deg = 0.0
        if self._calibration is not None and "alpha" in self._calibration:
            zero_deg = self._calibration["alpha"].value
        u_mg = self._u_mg(count)
        u_deg = None
        if u_mg is not None and (x or y):
            u_deg = math.degrees(math.hypot(y * u_mg[0], x * u_mg[1]) / (x * x + y * y))
        return wrap_degrees(zero_deg + float(raw_angle_deg(mean_mg))), u_deg

    def _corrected(
        self, mean_mg: Floats, count: int, temperature_c: float | None
    ) -> tuple[float | None, float | None]:
        calibration, u_mg = self._calibration, self._u_mg(count)
        if calibration is None:
            return None, None
        reading_u = None if u_mg is None else [float(u) for u in u_mg[: calibration.axes]]
        try:
            if "alpha" in calibration:
                by = calibration.stage_angle(mean_mg, temperature_c, reading_u=reading_u)
                angle_deg = float(by.angle_deg)
            else:
                by = calibration.angle(mean_mg, temperature_c, reading_u=reading_u, plane="xy")
                angle_deg = -float(by.angle_deg)
        except UsageError:  # a reading too short to have an angle, or far too long
            return None, None
        u_deg = float(by.u_deg)
        return angle_deg, u_deg if u_mg is not None and math.isfinite(u_deg) else None


def _temperature_c(blocks: list[Block]) -> float | None:
    told = [columns["temp_c"] for block in blocks if "temp_c" in (columns := session_columns(block))]
    return float(np.concatenate(told).mean()) if told else None


@dataclass(frozen=True)
class LiveSource:
    """An open sensor whose samples run.

    Attributes
    ----------
    measuring : Measuring
    stream : SampleStream
    noise_mg, step_mg : float
        As `AngleMeter` takes them.
    part : str
        Its variant.
    offsets_lsb : tuple of int or None
        Numbers in XACCL_OFF, YACCL_OFF, ZACCL_OFF; None where there are no registers.
    gyro_offsets_lsb : tuple of int or None
        Those in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF.
    """

    measuring: Measuring
    stream: SampleStream
    noise_mg: float
    step_mg: float
    part: str
    offsets_lsb: tuple[int, ...] | None
    gyro_offsets_lsb: tuple[int, ...] | None = None

    @property
    def offsets(self) -> tuple[tuple[int, ...] | None, ...]:
        """All of them."""
        return self.offsets_lsb, self.gyro_offsets_lsb


def calibration_for(calibration: Calibration, source: LiveSource) -> Calibration:
    """The calibration as it holds for a sensor, whose registers may correct another offset by now.

    Raises
    ------
    UsageError
        It is another part's, or takes readings in counts.
    """
    where = calibration.provenance
    if where.counts:
        raise UsageError("the calibration takes readings in counts of unknown scale; a sensor gives mg")
    if where.sensor != source.part:
        raise UsageError(f"the calibration is of an {where.sensor}, this is an {source.part}")
    return calibration.for_registers(source.offsets_lsb, source.gyro_offsets_lsb)


def smoother_for(
    source: LiveSource, calibration: Calibration | None = None, *, lag_s: float
) -> SmoothedMeter:
    """What smooths the angle of a sensor.

    Raises
    ------
    UsageError
        The lag is negative or too long.
    """
    sensing = sensing_of(source.measuring, source.part, source.noise_mg)
    return SmoothedMeter(sensing, calibration, lag_s=lag_s)


@contextmanager
def open_live(
    url: str,
    *,
    variant: str = "adis16354",
    check: bool = True,
    data_ready: bool | None = None,
    gyros: bool = True,
) -> Iterator[LiveSource]:
    """Open a sensor and let its samples run, a span in two blocks; its settings stay as they are.

    Parameters
    ----------
    data_ready : bool or None
        None where scans start at data-ready edges if they can; False polls.
    gyros : bool
        False leaves the gyros out, so that a slow bridge has fewer registers to read.

    Raises
    ------
    UsageError, CannotOpenError, BusError, ChipError
        As `open_source` and the sensor's stream.
    """
    with ExitStack() as stack:
        source = stack.enter_context(open_source(url, variant=variant, check=check))
        offsets_lsb: tuple[int, ...] | None = None
        gyro_offsets_lsb: tuple[int, ...] | None = None
        if isinstance(source, ChipSource):
            offsets_lsb = tuple(source.sensor.read(name) for name in ACCEL_OFF)
            gyro_offsets_lsb = tuple(source.sensor.read(name) for name in GYRO_OFF)
            settings = source.sensor.configuration()
            measuring: Measuring = settings
            count = _block_samples(measuring)
            # A range that the part does not know leaves the gyros without a scale.
            turning = GYRO_OUT if gyros and settings.gyro_range_dps is not None else ()
            names = (*ACCEL_OUT, TEMP_OUT[0], *turning)
            stream: SampleStream = source.sensor.stream(names, block_scans=count, data_ready=data_ready)
        else:
            measuring = source.configure(Settings())
            stream = source.samples(Settings(), _block_samples(measuring))
        stack.enter_context(stream)
        noise_mg = source.expected_noise_mg(measuring)
        part = source.part
        yield LiveSource(
            measuring, stream, noise_mg, part.step_mg, part.name, offsets_lsb, gyro_offsets_lsb
        )


Opener = Callable[[], AbstractContextManager[LiveSource]]


class LiveBlocks:
    """Blocks of a sensor, opened again where its link breaks.

    Parameters
    ----------
    opener : callable
        Opens the sensor, as often as it is asked.
    patience_s : float
        How long it is tried after a break; 0 lets the error through.
    broken : callable
        Told of each break with its error, before the first try.
    sleep : callable
        Waits so many seconds between two tries.

    Attributes
    ----------
    source : LiveSource
        Open now.
    breaks : int
        How often the link has been opened again.
    """

    EVERY_S = 1.0

    def __init__(
        self,
        opener: Opener,
        patience_s: float,
        broken: Callable[[Exception], None],
        sleep: Callable[[float], None],
    ) -> None:
        self._opener, self._patience_s, self._broken, self._sleep = opener, patience_s, broken, sleep
        self._stack = ExitStack()
        self.breaks = 0
        self._open()

    def _open(self) -> None:
        self.source = self._stack.enter_context(self._opener())
        self._blocks = iter(self.source.stream)

    def __iter__(self) -> Iterator[Block]:
        return self

    def __next__(self) -> Block:
        """Next block; raises the error of the break where the sensor does not come back in time."""
        try:
            return next(self._blocks)
        except (BusError, ChipError) as error:
            if not self._patience_s:
                raise
            self._broken(error)
            self._again(error)
        return next(self)

    def _again(self, error: Exception) -> None:
        self.close()
        waited_s = 0.0
        while True:
            self._sleep(self.EVERY_S)
            waited_s += self.EVERY_S
            try:
                self._open()
            except (BusError, ChipError):
                self.close()
                if waited_s >= self._patience_s:
                    raise error from None
                continue
            self.breaks += 1
            return

    def close(self) -> None:
        """Close the sensor; one that is gone cannot be set back."""
        stack, self._stack = self._stack, ExitStack()
        with suppress(BusError, ChipError):
            stack.close()


def live_angles(
    blocks: LiveBlocks, calibration: Calibration | None = None, *, lag_s: float
) -> Iterator[LiveAngle]:
    """Angles of a sensor that runs, one after another, over breaks of its link.

    What was learnt goes on after a break where the sensor measures as before.

    Raises
    ------
    UsageError
        The calibration is another part's; the lag is negative or too long.
    """
    breaks, source = blocks.breaks, blocks.source
    meter = _meter(source, calibration, lag_s)
    for block in blocks:
        if blocks.breaks != breaks:
            breaks, before, source = blocks.breaks, source, blocks.source
            if (before.measuring, before.offsets) == (source.measuring, source.offsets):
                meter.restart()
            else:
                meter = _meter(source, calibration, lag_s, meter)
        reading = meter.feed(block)
        if reading is not None:
            yield reading


def _meter(
    source: LiveSource, calibration: Calibration | None, lag_s: float, before: AngleMeter | None = None
) -> AngleMeter:
    now = None if calibration is None else calibration_for(calibration, source)
    smoother = smoother_for(source, now, lag_s=lag_s)
    meter = AngleMeter(source.measuring, source.noise_mg, source.step_mg, now, smoother=smoother)
    if before is not None:
        meter.go_on(before)
    return meter


def _block_samples(measuring: Measuring) -> int:
    return max(1, round(EVERY_S * measuring.sample_rate_hz / 2))
