"""A part on a stage whose power can be cut after any frame, and a session recorded from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import Adis16354
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.sim import SimBus, World, WorldSettings

OFFSETS = ("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF")
DEAD_LINE = 0xFFFF


class PowerBus(SimBus):
    """A simulated bus that counts frames and cuts the chip's power after one of them.

    Parameters
    ----------
    cut_after : int or None
        Frames until the power goes, counted from `arm` on.
    back : bool
        It comes back at once (a dip): the part restarts with what its flash holds. Else it stays off, and
        nothing drives the data line.
    """

    def __init__(self, *args, cut_after: int | None = None, back: bool = False, **options) -> None:
        super().__init__(*args, **options)
        self.cut_after, self.back = cut_after, back
        self.frames, self.armed, self.off = 0, False, False
        self.log: list[int] = []

    def arm(self) -> None:
        """Count from here."""
        self.armed, self.frames, self.log = True, 0, []

    def power_on(self) -> None:
        """The power comes (back): the part starts up from its flash."""
        self.off, self.cut_after = False, None
        self.chip.hard_reset(self.now_s())
        self.sleep_s(0.5)

    def _exchange(self, frames):
        if self.off:
            self._set_now(self.now_s() + len(frames) * self.timing.frame_s)
            return np.full(len(frames), DEAD_LINE, np.uint16)
        if not self.armed:
            return super()._exchange(frames)
        left = len(frames) if self.cut_after is None else self.cut_after - self.frames
        if left >= len(frames):
            self.frames += len(frames)
            self.log += frames.tolist()
            return super()._exchange(frames)
        first = super()._exchange(frames[:left]) if left else np.empty(0, np.uint16)
        self.frames += left
        self.log += frames[:left].tolist()
        self.cut_after = None
        self.chip.hard_reset(self.now_s())
        if self.back:
            self.sleep_s(0.5)  # a dip's start-up; the host goes on and knows nothing of it
            self.log += frames[left:].tolist()
            return np.concatenate([first, super()._exchange(frames[left:])])
        self.off = True
        return np.concatenate([first, self._exchange(frames[left:])])


def new_bus(seed: int = 3, part: str = "adis16354", flash=None, endurance: int = 0, **options) -> PowerBus:
    """A bus as a new process opens it; `options` are those of `PowerBus` and of the world."""
    cut = {name: options.pop(name) for name in ("cut_after", "back") if name in options}
    url = f"sim:?seed={seed}"
    bus = PowerBus(World(WorldSettings(**options), seed=seed, part=part), url=url, **cut)
    if flash or endurance:
        memory = bus.chip.memory
        for name, number in (flash or {}).items():
            memory._flash[name] = number & 0xFFF
        memory._words["ENDURANCE"] = endurance
        memory.load()
        bus.chip.hard_reset(0.0)
    return bus


def record(path: Path, bus: PowerBus, plan_name="four-position", dwell_s=1.0, **options) -> Path:
    """A session of the part on a bus; `plan_name` is a plan or the name of one."""
    made = plan(plan_name) if isinstance(plan_name, str) else plan_name
    sensor, settings = Adis16354(bus, bus.world.variant), Settings(dwell_s=dwell_s, settle_s=0.1)
    for _ in SessionRunner.begin(sensor, path, made, settings, auto=True, **options).run(so_far=False):
        pass
    return path


def numbers(bus) -> tuple[int, int, int]:
    """Offsets in the registers, past the serial port."""
    return tuple(_signed(bus.chip.memory[name]) for name in OFFSETS)


def flash(bus) -> tuple[int, int, int]:
    """Offsets in the flash."""
    return tuple(_signed(bus.chip.memory._flash[name]) for name in OFFSETS)


def _signed(word: int) -> int:
    return (word & 0xFFF) - ((word & 0x800) << 1)
