"""The simulated bus: a chip in a world behind the contract of `adis_gonio.device.bus`.

Time is virtual: an exchange takes as long as its frames would, `sleep_s` and moves of the stage only set
the clock forward, so an hour's session runs in seconds. With `realtime` the clock is the wall's.

The bus keeps the timing that it is given and refuses none that is physically possible: the chip answers
for what it is sent.

What is not simulated
    Electrical faults, a bridge's own latency and buffers (a stream never overflows; edges are lost only
    where the read list takes longer than the update period), which DIO line the bridge listens to.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import BusClosedError, BusTimeoutError, CapabilityError, UsageError
from adis_gonio.device.bus.contract import (
    FRAME_BITS,
    Capability,
    FrameBlock,
    FrameStream,
    SpiBus,
    SpiTiming,
    Words,
)
from adis_gonio.device.bus.host import SAFE_TIMING
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.sensor.registers import WRITE
from adis_gonio.device.sensor.variants import Variant
from adis_gonio.model.effects import parse_effect
from adis_gonio.model.effects.base import Effect
from adis_gonio.sim.chip import SimulatedChip
from adis_gonio.sim.gyros import realistic_gyros, stream_of
from adis_gonio.sim.memory import FlashFile
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.stage import Stage
from adis_gonio.sim.world import Values, World

_POWERED_BEFORE_S = 0.5
_TRIGGER_S = 2e-6
_OPTIONS = ("seed", "variant", "stream", "realtime", "effects", "flash", "gyros")


class SimBus(SpiBus):
    """A simulated ADIS16350-family chip on a stage.

    Parameters
    ----------
    settings : WorldSettings
        The world; by default all that is hidden is drawn from the seed.
    seed : int
        Seed of everything random.
    part : str or Variant
        `adis16354`, `adis16350` or `adis16355`.
    effects : sequence of (Effect, values)
        Terms added to the readings.
    stream : bool
        Offer `Capability.STREAM` and `Capability.EVENT_COUNTER`.
    realtime : bool
        Follow the wall clock.
    chip : SimulatedChip
        A chip of one's own, in `world`, instead of a new one.
    world : World
        A world of one's own; settings, seed and effects are then its business.

    Attributes
    ----------
    chip, world, stage
        What is behind the bus; `stage` moves the part.
    """

    def __init__(
        self,
        settings: WorldSettings | None = None,
        *,
        seed: int = 0,
        part: str | Variant = "adis16354",
        effects: Sequence[tuple[Effect, Values]] = (),
        stream: bool = True,
        realtime: bool = False,
        url: str = "sim:",
        world: World | None = None,
        chip: SimulatedChip | None = None,
    ) -> None:
        super().__init__(SAFE_TIMING)
        self.url = url
        self.world = world or World(settings, part=part, seed=seed, effects=effects)
        self.chip = chip or SimulatedChip(self.world, self.world.variant, start_s=-_POWERED_BEFORE_S)
        self.stage = SimStage(self, self.world.stage)
        offered = {Capability.HARD_RESET}
        if stream:
            offered |= {Capability.STREAM, Capability.EVENT_COUNTER}
        self.capabilities = frozenset(offered)
        self._now = 0.0
        self._last_start = self._last_rise = -math.inf
        self._wall_s = time.monotonic() if realtime else None
        self._stream: SimStream | None = None
        self._counted = 0

    @property
    def virtual_time(self) -> bool:
        """True where the clock is set forward by what is done; False where it is the wall's."""
        return self._wall_s is None

    # -- time -----------------------------------------------------------------------------------

    def now_s(self) -> float:
        """Virtual time in s; 0 at opening."""
        with self._lock:
            if self._wall_s is not None:
                self._now = max(self._now, time.monotonic() - self._wall_s)
            return self._now

    def sleep_s(self, seconds: float) -> None:
        """Set the clock forward; waits only where the bus follows the wall clock."""
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

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return timing

    def _exchange(self, frames: Words) -> Words:
        if self._stream is not None:
            raise UsageError(f"{self.url}: a stream is running; close it first")
        start = max(
            self.now_s(),
            self._last_rise + self.timing.stall_us * 1e-6,
            self._last_start + self.timing.period_us * 1e-6,
        )
        frame_s = self.timing.frame_s
        replies = self.chip.frames(frames, start_s=start, frame_s=frame_s, clock_hz=self.timing.clock_hz)
        self._last_start = start + (len(frames) - 1) * frame_s
        self._last_rise = self._last_start + FRAME_BITS / self.timing.clock_hz
        self._set_now(start + len(frames) * frame_s)
        return replies

    def _close(self) -> None:
        if self._stream is not None:
            self._stream.close()

    # -- optional capabilities ---------------------------------------------------------------------

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Run read frames once at each data-ready edge.

        Raises
        ------
        BusTimeoutError
            The chip gives no data-ready edges: its output is not enabled in MSC_CTRL, or it is not
            running.
        UsageError
            The list is empty or holds a write, or a stream is running.
        """
        with self._lock:
            self._require_open()
            if Capability.STREAM not in self.capabilities:
                raise CapabilityError(f"{self.url} has no capability '{Capability.STREAM}'")
            if self._stream is not None:
                raise UsageError(f"{self.url}: a stream is running; close it first")
            if not frames or any(not 0 <= frame < WRITE >> 1 for frame in frames):
                raise UsageError("a stream takes at least one read frame and no writes")
            if block_scans < 1:
                raise UsageError(f"a block of {block_scans} scans is not possible; give at least 1")
            self._stream = SimStream(self, np.array(frames, np.uint16), block_scans)
            return self._stream

    def hard_reset(self) -> None:
        """Pull the RST line; the chip then starts up."""
        with self._lock:
            self._require_open()
            self.chip.hard_reset(self.now_s())

    def read_event_counter(self) -> int:
        """Data-ready edges since the last call."""
        with self._lock:
            self._require_open()
            if Capability.EVENT_COUNTER not in self.capabilities:
                raise CapabilityError(f"{self.url} has no capability '{Capability.EVENT_COUNTER}'")
            edges = self.chip.data_ready_edges(self.now_s())
            new, self._counted = edges - self._counted, edges
            return new


class SimStream(FrameStream):
    """A stream of a simulated bus.

    The list runs from each falling edge on, with one idle frame behind it that fetches the last reply;
    edges that fall into a run are lost. Time that the caller lets pass between blocks is buffered.
    """

    def __init__(self, bus: SimBus, frames: Words, block_scans: int) -> None:
        self._bus = bus
        self._list = np.append(frames, np.uint16(0))
        self._block = block_scans
        self._free_s = bus.now_s()
        self._last_edge: float | None = None
        self._open = True
        self._require_edges()

    def __next__(self) -> FrameBlock:
        bus = self._bus
        with bus._lock:
            if not self._open:
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
            if self._last_edge is not None:  # the chip may have lived on meanwhile
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
            bus._last_rise = bus._last_start + FRAME_BITS / timing.clock_hz
            bus._set_now(self._free_s)
            return FrameBlock(np.ascontiguousarray(words), edges, lost)

    def close(self) -> None:
        """Stop; the bus is free again."""
        with self._bus._lock:
            if self._open:
                self._open = False
                self._bus._stream = None

    def _require_edges(self) -> None:
        if not self._bus.chip.data_ready_enabled:
            self._bus._stream = None
            self._open = False
            raise BusTimeoutError(
                f"{self._bus.url}: no data-ready edge on the chip's DIO lines; enable it in MSC_CTRL[2]"
            )


class SimStage:
    """The stage as a program moves it: a move takes its time on the bus's clock."""

    def __init__(self, bus: SimBus, stage: Stage) -> None:
        self._bus = bus
        self._stage = stage

    @property
    def angle_deg(self) -> float:
        """Declared angle; nan where the attitude was given in space."""
        return self._stage.angle_deg

    @property
    def error_deg(self) -> float:
        """Hidden error of the present position in degrees."""
        return self._stage.error_deg

    def move_to(self, angle_deg: float, approach: int = 0) -> None:
        """Turn to a declared angle in degrees, arriving from below (+1), above (-1) or the short way."""
        with self._bus._lock:
            self._require_open()
            self._bus._set_now(self._stage.move_to(self._bus.now_s(), angle_deg, approach))

    def orient(self, vector: Sequence[float] | Floats) -> None:
        """Turn until an ideal sensor reads along a vector (3,); level with Z up is (0, 0, -1)."""
        with self._bus._lock:
            self._require_open()
            self._bus._set_now(self._stage.orient(self._bus.now_s(), np.asarray(vector, np.float64)))

    def turn_about(self, angle_deg: float, axis: Sequence[float] | Floats | None = None) -> None:
        """Turn the part by an angle in degrees about an axis (3,) of its own, or about the vertical.

        See `Stage.turn_about`.
        """
        with self._bus._lock:
            self._require_open()
            about = None if axis is None else np.asarray(axis, np.float64)
            self._bus._set_now(self._stage.turn_about(self._bus.now_s(), angle_deg, about))

    def begin_move(self, angle_deg: float, approach: int = 0) -> float:
        """As `move_to`, but the bus's clock stands still, so that the move can be recorded."""
        with self._bus._lock:
            self._require_open()
            return self._stage.move_to(self._bus.now_s(), angle_deg, approach)

    def begin_orient(self, vector: Sequence[float] | Floats) -> float:
        """As `orient`, but the bus's clock stands still; when it ends."""
        with self._bus._lock:
            self._require_open()
            return self._stage.orient(self._bus.now_s(), np.asarray(vector, np.float64))

    def begin_turn(self, angle_deg: float) -> float:
        """Begin to turn the part about the vertical (counter-clockwise positive); returns when it ends.

        The bus's clock stands still, so that the turn can be recorded.
        """
        with self._bus._lock:
            self._require_open()
            return self._stage.turn_about(self._bus.now_s(), angle_deg)

    def turn_freely(self, turns: int = 1) -> float:
        """Begin turns by hand; returns when they end, on the bus's clock, which stands still."""
        with self._bus._lock:
            self._require_open()
            return self._stage.turn_freely(self._bus.now_s(), turns)

    def _require_open(self) -> None:
        if self._bus.closed:
            raise BusClosedError(f"{self._bus.url}: the bus is closed")


def open_from_url(url: BusUrl) -> SimBus:
    """Open `sim:?seed=1&variant=adis16354&noise_mg=4.7…`.

    Options are `seed`, `variant`, `stream` (0 or 1), `realtime` (0 or 1), `effects` (of the catalogue,
    such as `quadratic:k2_x=2.5;cubic`), `flash` (a file that keeps the part's flash, and only that, from
    one opening to the next), `gyros` (`realistic` draws their faults from the seed, see `gyros`; what
    is given by name stands) and every name of `WorldSettings`.

    Raises
    ------
    UsageError
        An unknown option (with the nearest name), or a value that is not possible.
    """
    if url.place:
        raise UsageError(f"'{url.text}': the simulator has no place '{url.place}'; write sim:?seed=1")
    options = url.options
    seed = _whole(options, "seed", 0)
    world = World(
        WorldSettings.from_options(options, others=_OPTIONS, drawn=_gyros(options, seed)),
        part=options.get("variant", "adis16354"),
        seed=seed,
        effects=[parse_effect(text) for text in filter(None, options.get("effects", "").split(";"))],
    )
    return SimBus(
        world=world,
        chip=_chip(world, options["flash"], seed) if "flash" in options else None,
        stream=_switch(options, "stream", default=True),
        realtime=_switch(options, "realtime", default=False),
        url=url.text,
    )


def _chip(world: World, path: str, seed: int) -> SimulatedChip:
    """A part that begins with the flash of a file and keeps it there."""
    if not path:
        raise UsageError("flash: name a file, such as flash=part.flash")
    kept = FlashFile(Path(path), f"{world.variant.name}, seed {seed}")
    flash, endurance = kept.read()
    return SimulatedChip(
        world,
        world.variant,
        start_s=-_POWERED_BEFORE_S,
        flash=flash,
        endurance=endurance,
        saved=kept.write,
    )


def find_devices() -> list[Device]:
    """What the simulator offers to open."""
    return [Device("sim:?seed=1", "simulated ADIS16354 on a stage (no hardware)")]


def _gyros(options: Mapping[str, str], seed: int) -> dict[str, float]:
    """Settings of the gyros that the option `gyros` asks for."""
    wanted = options.get("gyros", "ideal")
    if wanted not in ("ideal", "realistic"):
        raise UsageError(f"gyros: write ideal or realistic, not '{wanted}'")
    return realistic_gyros(stream_of(seed)) if wanted == "realistic" else {}


def _whole(options: Mapping[str, str], name: str, default: int) -> int:
    text = options.get(name, str(default))
    if not text.isascii() or not text.isdigit():
        raise UsageError(f"{name}: '{text}' is no whole number from 0 on")
    return int(text)


def _switch(options: Mapping[str, str], name: str, *, default: bool) -> bool:
    text = options.get(name, "1" if default else "0")
    if text not in ("0", "1"):
        raise UsageError(f"{name}: write 0 or 1, not '{text}'")
    return text == "1"
