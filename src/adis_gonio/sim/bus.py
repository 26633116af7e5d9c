"""The simulated bus: it has the interface of `adis_gonio.device.bus`, and a simulated chip behind it.

Time is virtual: an exchange takes as long as its frames would take, and `sleep_s` and moves of the stage
only advance the clock, so an hour's session runs in seconds. With `realtime` the bus follows the wall
clock.

The bus accepts every timing that is physically possible. If frames come too fast for the chip, the chip
answers as a real chip is supposed to (see `adis_gonio.sim.chip`).

Not simulated
    Electrical faults, a bridge's own latency and buffers (a stream never overflows; edges are lost only
    if the read list takes longer than the update period), the choice of the DIO line.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import BusTimeoutError, UsageError
from adis_gonio.device.bus import contract
from adis_gonio.device.bus.host import SAFE_TIMING, UrlOptions
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.model.effects import parse_effect
from adis_gonio.sim.chip import SimulatedChip
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.stage import Stage
from adis_gonio.sim.world import World

_POWERED_BEFORE_S = 0.5
_TRIGGER_S = 2e-6
_OPTIONS = ("seed", "day", "variant", "stream", "realtime", "effects")


class SimBus(contract.SpiBus):
    """A bus with a simulated chip of the ADIS16350 family, mounted on a simulated stage.

    Parameters
    ----------
    world : World
        Surroundings of the chip, with the stage.
    stream : bool
        True offers `Capability.STREAM` and `Capability.EVENT_COUNTER`.
    realtime : bool
        True makes the bus follow the wall clock; False gives it a virtual clock.
    url : str
        URL of the bus, for messages and recordings.
    chip : SimulatedChip or None
        An existing chip in `world`; None makes a new chip.

    Attributes
    ----------
    chip, world, stage
        Simulated objects behind the bus; `stage` moves the sensor.
    """

    def __init__(
        self,
        world: World,
        *,
        stream: bool = True,
        realtime: bool = False,
        url: str = "sim:",
        chip: SimulatedChip | None = None,
    ) -> None:
        super().__init__(SAFE_TIMING)
        self.url = url
        self.world = world
        self.chip = chip or SimulatedChip(self.world, self.world.variant, start_s=-_POWERED_BEFORE_S)
        self.stage = SimStage(self, self.world.stage)
        offered = {contract.Capability.HARD_RESET}
        if stream:
            offered |= {contract.Capability.STREAM, contract.Capability.EVENT_COUNTER}
        self.capabilities = frozenset(offered)
        self._now = 0.0
        self._last_start = self._last_rise = -math.inf
        self._wall_s = time.monotonic() if realtime else None
        self._stream: SimStream | None = None
        self._counted = 0

    @property
    def virtual_time(self) -> bool:
        """True if waits and frames advance a virtual clock; False if the bus follows the wall clock."""
        return self._wall_s is None

    # -- time -----------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Return the time in s since the bus was opened, by its virtual clock or by the wall clock."""
        with self._lock:
            if self._wall_s is not None:
                self._now = max(self._now, time.monotonic() - self._wall_s)
            return self._now

    def sleep_s(self, seconds: float) -> None:
        """Advance the bus's clock by `seconds`; really wait only if the bus follows the wall clock."""
        if not seconds >= 0:
            raise UsageError(f"cannot sleep {seconds} s")
        with self._lock:
            self._require_open()
            self._set_now(self.now_s() + seconds)

    def _set_now(self, time_s: float) -> None:
        self._now = max(self._now, time_s)
        if self._wall_s is not None:
            left = self._now - (time.monotonic() - self._wall_s)
            if left > 0:
                time.sleep(left)

    # -- frames ----------------------------------------------------------------------------------

    def _configure(self, timing: contract.SpiTiming) -> contract.SpiTiming:
        return timing

    def _exchange(self, frames: contract.Words) -> contract.Words:
        if self._stream is not None:
            raise UsageError(f"{self.url}: a stream is running; close it first")
        start = max(
            self.now_s(),
            self._last_rise + self.timing.stall_us * 1e-6,
            self._last_start + self.timing.period_us * 1e-6,
        )
        frame_s = self.timing.frame_s
        starts_s = start + frame_s * np.arange(len(frames), dtype=np.float64)
        replies = self.chip.frames_at(frames, starts_s, clock_hz=self.timing.clock_hz)
        self._last_start = start + (len(frames) - 1) * frame_s
        self._last_rise = self._last_start + contract.FRAME_BITS / self.timing.clock_hz
        self._set_now(start + len(frames) * frame_s)
        return replies

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()

    # -- optional capabilities ---------------------------------------------------------------------

    def _start_stream(self, frames: Sequence[int], block_scans: int) -> contract.FrameStream:
        if self._stream is not None:
            raise UsageError(f"{self.url}: a stream is running; close it first")
        self._stream = SimStream(self, np.array(frames, np.uint16), block_scans)
        return self._stream

    def _pull_reset(self) -> None:
        self.chip.hard_reset(self.now_s())

    def _count_edges(self) -> int:
        edges = self.chip.data_ready_edges(self.now_s())
        new, self._counted = edges - self._counted, edges
        return new


class SimStream(contract.FrameStream):
    """A stream of a simulated bus, which scans at each data-ready edge.

    The list of read frames runs after each falling edge, followed by one idle frame that fetches the last
    reply; edges during a run are lost. Scans that fall between two calls of the program are buffered.
    """

    def __init__(self, bus: SimBus, frames: contract.Words, block_scans: int) -> None:
        self._bus = bus
        self._list = np.append(frames, np.uint16(0))
        self._block = block_scans
        self._free_s = bus.now_s()
        self._last_edge: float | None = None
        self._require_edges()

    def __next__(self) -> contract.FrameBlock:
        bus = self._bus
        with bus._lock:
            if bus._stream is not self:
                raise StopIteration
            bus._require_open()
            self._require_edges()
            chip, timing, k = bus.chip, bus.timing, len(self._list)
            first = chip.next_edge_s(max(self._free_s, chip.time_s), rising=bus.edge_rises)
            if first is None:
                raise BusTimeoutError(f"{bus.url}: no data-ready edge; the chip is not running")
            period = chip.update_period_s
            stride = max(1, math.ceil((_TRIGGER_S + k * timing.frame_s) / period - 1e-9))
            lost = (stride - 1) * self._block
            if self._last_edge is not None:  # the chip's time may have passed meanwhile
                lost += max(0, round((first - self._last_edge) / period) - stride)
            edges = first + stride * period * np.arange(self._block, dtype=np.float64)
            starts = (edges + _TRIGGER_S)[:, None] + timing.frame_s * np.arange(k)
            replies = chip.frames_at(
                np.tile(self._list, self._block), starts.ravel(), clock_hz=timing.clock_hz
            )
            words = replies.reshape(self._block, k)[:, 1:]
            self._last_edge = float(edges[-1])
            self._free_s = float(edges[-1] + _TRIGGER_S + k * timing.frame_s)
            bus._last_start = float(starts[-1, -1])
            bus._last_rise = bus._last_start + contract.FRAME_BITS / timing.clock_hz
            bus._set_now(self._free_s)
            return contract.FrameBlock(np.ascontiguousarray(words), edges, lost)

    def close(self) -> None:
        """Stop the stream, so that the bus accepts other frames again."""
        with self._bus._lock:
            if self._bus._stream is self:
                self._bus._stream = None

    def _require_edges(self) -> None:
        if not self._bus.chip.data_ready_enabled:
            self.close()
            raise BusTimeoutError(
                f"{self._bus.url}: no data-ready edge on the chip's DIO lines; enable it in MSC_CTRL[2]"
            )


class SimStage:
    """The simulated stage, moved by a program: each move advances the clock of the bus by its duration."""

    def __init__(self, bus: SimBus, stage: Stage) -> None:
        self._bus = bus
        self._stage = stage

    @property
    def angle_deg(self) -> float:
        """Declared angle of the stage in degrees; NaN after a move in space."""
        return self._stage.angle_deg

    @property
    def error_deg(self) -> float:
        """True minus declared angle of the stage at the present position, in degrees.

        A fit does not know this error.
        """
        return self._stage.error_deg

    def move_to(self, angle_deg: float, approach: int = 0) -> None:
        """Turn the stage to a declared angle in degrees; return when it rests.

        The stage arrives from below if `approach` is +1, from above if -1, or by the shortest turn if 0.
        """
        self._wait_until(self.begin_move(angle_deg, approach))

    def orient(self, vector: Sequence[float] | Floats) -> None:
        """Turn the sensor to the attitude in which an ideal sensor reads along `vector` (3,).

        With the sensor level and its Z up, an ideal sensor reads (0, 0, -1).
        """
        self._wait_until(self.begin_orient(vector))

    def turn_about(self, angle_deg: float, axis: Sequence[float] | Floats | None = None) -> None:
        """Turn the sensor by an angle in degrees about an axis.

        `axis` (3,) is a direction in the sensor's frame; None means the vertical. A positive angle is
        right-handed about the axis; about the vertical it is counter-clockwise, seen from above.
        """
        self._wait_until(self._begin(self._stage.turn_about, angle_deg, axis))

    def begin_move(self, angle_deg: float, approach: int = 0) -> float:
        """Begin `move_to` and return the time in s at which it ends, without advancing the clock.

        Samples can therefore be recorded during the move. It takes the arguments of `move_to`.
        """
        return self._begin(self._stage.move_to, angle_deg, approach)

    def begin_orient(self, vector: Sequence[float] | Floats) -> float:
        """Begin `orient` and return the time in s at which it ends, without advancing the clock.

        `vector` (3,) is the reading of an ideal sensor at the end.
        """
        return self._begin(self._stage.orient, vector)

    def begin_turn(self, angle_deg: float) -> float:
        """Begin to turn the sensor about the vertical; return the time in s at which the turn ends.

        Positive angles are counter-clockwise, seen from above. The clock does not advance, so the turn can
        be recorded.
        """
        return self._begin(self._stage.turn_about, angle_deg)

    def turn_freely(self, turns: int = 1) -> float:
        """Begin turns by hand, `turns` in number; return the time in s at which they end.

        The clock does not advance.
        """
        return self._begin(self._stage.turn_freely, turns)

    def _begin(self, motion: Callable[..., float], *arguments: object) -> float:
        with self._bus._lock:
            self._bus._require_open()
            return motion(self._bus.now_s(), *arguments)

    def _wait_until(self, end_s: float) -> None:
        with self._bus._lock:
            self._bus._set_now(end_s)


def open_from_url(url: BusUrl) -> SimBus:
    """Open a simulated bus by a URL such as `sim:?seed=1&variant=adis16354&noise_mg=4.7`.

    Options of the URL are `seed`, `day` (another session of the same part), `variant`, `stream` (0 or 1),
    `realtime` (0 or 1), `effects` (of the catalogue, such as `quadratic:k2_x=2.5;cubic`), and every name of
    `WorldSettings`.

    Raises
    ------
    UsageError
        An unknown option (with the nearest name), or a value that is not possible.
    """
    if url.place:
        raise UsageError(f"'{url.text}': the simulator has no place '{url.place}'; write sim:?seed=1")
    if "hands" in url.options:
        raise UsageError(f"'{url.text}': only calibrate and write know hands=free; leave it out")
    options = UrlOptions(url, tuple(url.options))  # `WorldSettings.from_options` refuses unknown names
    world = World(
        WorldSettings.from_options(url.options, others=_OPTIONS),
        part=options.text("variant", "adis16354"),
        seed=options.number("seed", 0, 0, 2**63 - 1),
        day=options.number("day", 0, 0, 2**63 - 1),
        effects=[parse_effect(text) for text in filter(None, options.text("effects").split(";"))],
    )
    return SimBus(
        world,
        stream=options.switch("stream", default=True),
        realtime=options.switch("realtime"),
        url=url.text,
    )


def find_devices() -> list[Device]:
    """Return the one device that the simulator offers, for the list of devices."""
    return [Device("sim:?seed=1", "simulated ADIS16354 on a stage (no hardware)")]
