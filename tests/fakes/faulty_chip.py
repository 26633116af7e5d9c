"""A simulated chip with one fault between the chip and the driver: `faulty:?seed=3&fault=restart&move=2`.

The driver and its bus know nothing of the fault: registers change inside the chip, and replies change on
the data line. Options beyond those of `sim:`

    fault=KIND     a key of `FAULTS`; without it nothing happens
    move=K         the fault's clock starts as the stage's K-th move begins; 0: as the bus opens
    wait_s=T       the fault comes T seconds later
    draw=N         seed of the fault's size, length and place
    preset=N       offset registers hold N (X) and -N (Y) LSB in RAM, not in flash; `written`: they cancel
                   the biases, as after `adis-gonio write` without --save
    pulsing=1      flash holds MSC_CTRL with data-ready enabled, so that a stream survives a restart
    limit_s=T      raise `OvertimeError` if the bus's clock passes T
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.sensor.registers import ACCEL_OFF, BY_NAME
from adis_gonio.sim.bus import SimBus, SimStage, SimStream, open_from_url as open_simulated
from adis_gonio.sim.memory import START_UP_S

SETTLED_S = 2e-4
"""The chip takes frames so much later than its start-up ends."""
FEW_FRAMES = 40
OWN_OPTIONS = ("fault", "move", "wait_s", "draw", "preset", "pulsing", "limit_s")


class OvertimeError(BaseException):
    """A session took more simulated time than it may; no handler of the product catches this."""


@dataclass(frozen=True)
class Window:
    """A time in which the data line carries no reply of the chip.

    Attributes
    ----------
    line : str
        `high`, `low` or `noise` (random words).
    deaf : bool
        Frames do not reach the chip.
    """

    begin_s: float
    end_s: float
    line: str
    deaf: bool


class FaultyChip:
    """A simulated chip behind a line that a fault can spoil.

    Attributes
    ----------
    actions : list of (float, callable)
        Changes of the chip, each with its time in s.
    windows : list of Window
    fired : bool
        True if any fault has acted.
    """

    def __init__(self, chip, rng: np.random.Generator) -> None:
        self.inner = chip
        self.rng = rng
        self.actions: list[tuple[float, Callable[[float], None]]] = []
        self.windows: list[Window] = []
        self.cut_s = math.inf
        self.fired = False

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def act_until(self, time_s: float) -> None:
        """Carry out the actions up to a time."""
        while self.actions and self.actions[0][0] <= time_s:
            at_s, act = self.actions.pop(0)
            self.fired = True
            act(max(at_s, self.inner.time_s))

    def next_edge_s(self, after_s, *, rising):
        self.act_until(after_s)
        return self.inner.next_edge_s(after_s, rising=rising)

    def data_ready_edges(self, time_s):
        self.act_until(time_s)
        return self.inner.data_ready_edges(time_s)

    def frames(self, words, *, start_s, frame_s, clock_hz):
        return self.frames_at(words, start_s + frame_s * np.arange(len(words)), clock_hz=clock_hz)

    def frames_at(self, words, starts_s, *, clock_hz):
        """Split a batch at the times of the fault and carry each piece as the fault demands."""
        times = [time for time, _ in self.actions]
        times += [time for window in self.windows for time in (window.begin_s, window.end_s)]
        cuts = sorted({int(np.searchsorted(starts_s, time)) for time in times} | {0, len(words)})
        replies = np.empty(len(words), np.uint16)
        for first, end in pairwise(cuts):
            begin_s = float(starts_s[first])
            self.act_until(begin_s)
            window = next((w for w in self.windows if w.begin_s <= begin_s < w.end_s), None)
            piece = slice(first, end)
            if window is None or not window.deaf:
                replies[piece] = self.inner.frames_at(words[piece], starts_s[piece], clock_hz=clock_hz)
            if window is not None:
                self.fired = True
                replies[piece] = self._line(window.line, end - first)
        return replies

    def _line(self, line: str, count: int):
        if line == "noise":
            return self.rng.integers(0, 1 << 16, count).astype(np.uint16)
        return np.full(count, 0xFFFF if line == "high" else 0, np.uint16)

    # -- faults ------------------------------------------------------------------------------------

    def set_register(self, at_s: float, name: str, word: int) -> None:
        """Change a register inside the chip at a time."""

        def act(now_s: float) -> None:
            chip = self.inner
            chip.run_to(now_s)
            chip.memory[name] = word

        self.actions.append((at_s, act))

    def restart(self, at_s: float, *, deaf: bool = True) -> None:
        """Start the chip up again; frames within the start-up put it into its bad state unless deaf."""
        self.actions.append((at_s, self.inner.hard_reset))
        self.cut_s = min(self.cut_s, at_s)
        if deaf:
            line = str(self.rng.choice(["high", "low", "noise"]))
            self.windows.append(Window(at_s, at_s + START_UP_S + SETTLED_S, line, deaf=True))


def _restart(chip: FaultyChip, at_s: float) -> None:
    chip.restart(at_s)


def _restart_under_traffic(chip: FaultyChip, at_s: float) -> None:
    chip.restart(at_s, deaf=False)


def _change_offset(chip: FaultyChip, at_s: float) -> None:
    name = str(chip.rng.choice([*ACCEL_OFF, *ACCEL_OFF[:2], "ZGYRO_OFF"]))
    change = int(chip.rng.choice([8, 32, 128]) * chip.rng.choice([-1, 1]))
    chip.set_register(at_s, name, (chip.memory[name] + change) & BY_NAME[name].write_mask)


def _change_one(name: str, words: Sequence[int]) -> Callable[[FaultyChip, float], None]:
    def fault(chip: FaultyChip, at_s: float) -> None:
        chip.set_register(at_s, name, int(chip.rng.choice(words)))

    return fault


def _change_rate(chip: FaultyChip, at_s: float) -> None:
    chip.set_register(at_s, "SMPL_PRD", int(chip.rng.choice([0x02, 0x03, 0x04, 0x09, 0x0A, 0x20, 0x81])))
    chip.cut_s = at_s


def _change_control(chip: FaultyChip, at_s: float) -> None:
    bit = int(chip.rng.choice([0x80, 0x40, 0x04, 0x02, 0x01, 0x0100, 0x0200]))

    def act(now_s: float) -> None:
        chip.inner.run_to(now_s)
        chip.inner.memory["MSC_CTRL"] = chip.inner.memory["MSC_CTRL"] ^ bit

    chip.actions.append((at_s, act))
    chip.cut_s = at_s


def _stick(line: str) -> Callable[[FaultyChip, float], None]:
    def fault(chip: FaultyChip, at_s: float) -> None:
        length_s = math.inf if chip.rng.random() < 0.4 else float(chip.rng.choice([0.003, 0.05, 0.4, 3.0]))
        chip.windows.append(Window(at_s, at_s + length_s, line, deaf=False))

    return fault


def _dip(chip: FaultyChip, at_s: float) -> None:
    length_s = float(np.exp(chip.rng.uniform(np.log(0.005), np.log(0.5))))
    line = str(chip.rng.choice(["noise", "noise", "high", "low"]))
    chip.windows.append(Window(at_s, at_s + length_s, line, deaf=True))


def _dip_and_restart(chip: FaultyChip, at_s: float) -> None:
    _dip(chip, at_s)
    chip.restart(chip.windows[-1].end_s)


FAULTS: dict[str, Callable[[FaultyChip, float], None]] = {
    "restart": _restart,
    "restart-under-traffic": _restart_under_traffic,
    "offset": _change_offset,
    "range": _change_one("SENS_AVG", [0x0202, 0x0104]),
    "filter": _change_one("SENS_AVG", [0x0400, 0x0401, 0x0404, 0x0406]),
    "rate": _change_rate,
    "control": _change_control,
    "stuck-high": _stick("high"),
    "stuck-low": _stick("low"),
    "dip": _dip,
    "dip-and-restart": _dip_and_restart,
}
"""Each kind of fault by name: a function that plans it for a time in s."""


class FaultyStage(SimStage):
    """A stage whose moves start the fault's clock; `move_to` and `orient` begin like the other moves."""

    def turn_about(self, angle_deg, axis=None):
        self._bus.note_move()
        return super().turn_about(angle_deg, axis)

    def begin_move(self, angle_deg, approach=0):
        self._bus.note_move()
        return super().begin_move(angle_deg, approach)

    def begin_orient(self, vector):
        self._bus.note_move()
        return super().begin_orient(vector)

    def begin_turn(self, angle_deg):
        self._bus.note_move()
        return super().begin_turn(angle_deg)

    def turn_freely(self, turns=1):
        self._bus.note_move()
        return super().turn_freely(turns)


class CutStream(SimStream):
    """A stream whose block ends where the fault stops the data-ready edges, as a real one does."""

    def __next__(self):
        bus, whole = self._bus, self._block
        remaining_s = bus.chip.cut_s - bus.now_s()
        if bus.chip.actions and 0 < remaining_s < whole * bus.chip.update_period_s:
            self._block = max(1, int(remaining_s / bus.chip.update_period_s))
        bus.chip.act_until(bus.now_s())
        try:
            return super().__next__()
        finally:
            self._block = whole


class FaultyBus(SimBus):
    """A simulated bus whose chip gets one fault.

    Attributes
    ----------
    moves_s : list of float
        When each move of the stage began.
    exchanges_s : list of float
        When each exchange of at most `FEW_FRAMES` frames began: reads and writes of registers.
    longest_s : float
        Longest simulated time of one exchange after the fault.
    """

    def __init__(self, url: BusUrl) -> None:
        own = {name: url.options[name] for name in OWN_OPTIONS if name in url.options}
        rest = {name: text for name, text in url.options.items() if name not in own}
        plain = open_simulated(replace(url, options=rest))
        super().__init__(world=plain.world, chip=plain.chip, stream="stream" in plain.capabilities)
        self.url = url.text
        self._own = own
        self.limit_s = float(own.get("limit_s", "inf"))
        self.moves_s: list[float] = []
        self.exchanges_s: list[float] = []
        self.longest_s = 0.0
        if own.get("pulsing") == "1":
            self.chip.memory["MSC_CTRL"] = 0x04
            self.chip.memory.save()
        for name, number in self._preset(own.get("preset", "0")).items():
            self.chip.memory[name] = BY_NAME[name].word(number)
        self.chip = FaultyChip(self.chip, np.random.default_rng(int(own.get("draw", 0))))
        self.stage = FaultyStage(self, self.world.stage)
        self._arm()

    def _preset(self, text: str) -> dict[str, int]:
        if text != "written":
            return {"XACCL_OFF": int(text), "YACCL_OFF": -int(text)}
        truth, lsb_mg = self.world.truth(), self.world.variant.accel_mg_per_lsb
        return {f"{axis.upper()}ACCL_OFF": -round(truth[f"bias_{axis}"] / lsb_mg) for axis in "xyz"}

    def note_move(self) -> None:
        """A move of the stage begins."""
        self.moves_s.append(self.now_s())
        self._arm()

    def _arm(self) -> None:
        if "fault" in self._own and len(self.moves_s) == int(self._own.get("move", 0)):
            FAULTS[self._own["fault"]](self.chip, self.now_s() + float(self._own.get("wait_s", 0)))

    def _exchange(self, frames):
        before_s = self.now_s()
        if len(frames) <= FEW_FRAMES:
            self.exchanges_s.append(before_s)
        replies = super()._exchange(frames)
        if self.chip.fired:
            self.longest_s = max(self.longest_s, self.now_s() - before_s)
        return replies

    def _set_now(self, time_s):
        super()._set_now(time_s)
        if self._now > self.limit_s:
            raise OvertimeError(f"{self.url}: {self._now:.0f} s of simulated time")

    def stream(self, frames, *, block_scans=256):
        super().stream(frames, block_scans=block_scans).close()
        self._stream = CutStream(self, np.array(frames, np.uint16), block_scans)
        return self._stream


OPENED: list[FaultyBus] = []
"""Buses that this process has opened, the newest last."""
OUTLIVED = ("fault", "preset")
"""Options that end as the chip is switched off and on: RAM is lost, and the fault is over."""


def open_from_url(url: BusUrl) -> FaultyBus:
    """Open `faulty:`; the second time, the same URL in a process means a chip that was off in between."""
    if any(bus.url == url.text for bus in OPENED):
        options = {name: text for name, text in url.options.items() if name not in OUTLIVED}
        url = replace(url, options=options)
    OPENED.append(FaultyBus(url))
    return OPENED[-1]
