"""Two chips, one life: the frame-level simulator beside the line-level chip, on random frame sequences.

A *life* begins at power-on and has a number of *sequences*: up to a dozen frames, a command with its
pause, or something that a host may not do. Both chips see the same frames at the same times and measure
the same constants, which step now and then. Compared are all bits of all replies that the facts of the
part settle, and the levels of both DIO lines.

What those facts leave open is a parameter of the line-level chip, and set here to what the simulator says
that it chose (`CHOICES`); what neither can settle is left out of the sequences (see `_legal_write`) or
of the comparison: replies to writes and to reads of COMMAND and of reserved addresses, the first reply
after a start-up, the outputs during a self-test, bits 13:12 of outputs of 12 bits, and one LSB while the
filter fills.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adis_gonio.sim import SimulatedChip
from adis_gonio.sim.chip import SELF_TEST_BITS
from adis_gonio.sim.sampling import Inputs
from rig_simavr.line_chip import FRAME, INPUTS, LineChip

CHOICES = {
    "smpl_restart": 1,
    "filter_zeros": 1,
    "filter_clears": 1,
    "busy_updates": 0,
    "busy_restart": 1,
    "flash_needs_supply": 1,
    "alarm_line_held": 1,
    "autonull_ms": 0,
    "dr_width_us": 50,
    "gpio_pins": 0,
}
"""Open in the sheet, chosen (confidence D) by the simulator: parameters of the line-level chip."""

OPTIONS = dict.fromkeys(("conditions", "rates", "manual_test"), True)
"""What the sequences take in."""

US, MS = 1_000_000, 1_000_000_000
"""In ps."""

_FAST_HALVES = tuple(round(0.5e12 / hz) for hz in (2e6, 1e6, 1e6, 500e3, 250e3, 100e3))
_SLOW_HALVES = tuple(-round(-0.5e12 / hz) for hz in (250e3, 300e3 * (1 - 1e-6), 125e3, 50e3))
_SMPL_PRD, _SENS_AVG, _SLP_CNT, _COMMAND, _MSC_CTRL, _ALM_CTRL = 0x36, 0x38, 0x3A, 0x3E, 0x34, 0x2E
_LEAST_M = {4: 0, 2: 2, 1: 4}
_ALARM_REGISTERS = range(0x26, 0x30)
_FRACTION = 0.2371
"""Inputs lie this far beside a whole LSB, so that no result lies on the edge between two."""


class _Constants:
    """Surroundings of the simulator: inputs that are constant between steps."""

    def __init__(self, values: NDArray[np.float64]) -> None:
        self._from_s = [-np.inf]
        self._values = [values]

    def step(self, at_s: float, values: NDArray[np.float64]) -> None:
        self._from_s.append(at_s)
        self._values.append(values)

    def sample(self, time_s: NDArray[np.float64]) -> Inputs:
        at = np.searchsorted(self._from_s, time_s, side="right") - 1
        values = np.array(self._values)[at]
        return Inputs(values[:, 4:7], values[:, 1:4], values[:, 7:10], values[:, 0], values[:, 10])


@dataclass(frozen=True)
class Difference:
    """Two answers to one frame (or two levels of the DIO lines) that cannot both be right."""

    seed: int
    sequence: int
    kind: str
    frame: str
    simulator: str
    line: str

    def __str__(self) -> str:
        place = f"life {self.seed}, sequence {self.sequence} ({self.kind}), {self.frame}"
        return f"{place}: simulator {self.simulator}, line-level chip {self.line}"


@dataclass
class Tally:
    """What was compared, and what differed."""

    sequences: int = 0
    frames: int = 0
    bits: int = 0
    abandoned: int = 0
    """Lives ended early, since an update came within 20 ns of a reading."""
    differences: list[Difference] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Take another tally in."""
        self.sequences += other.sequences
        self.frames += other.frames
        self.bits += other.bits
        self.abandoned += other.abandoned
        self.differences += other.differences


class Life:
    """One life of both chips.

    Parameters
    ----------
    library : Path
        libchip.so.
    seed : int
        Everything follows from it.
    conditions : bool
        Supply and sensors go beyond their limits too.
    rates : bool
        Rate-of-change alarms too.
    manual_test : bool
        The manual self-test too (its size is open, its signs are not).
    choices : dict
        In place of some of CHOICES.
    """

    def __init__(
        self,
        library: Path,
        seed: int,
        *,
        conditions: bool = False,
        rates: bool = False,
        manual_test: bool = False,
        choices: dict[str, float] | None = None,
    ) -> None:
        self._seed = seed
        self._dice = random.Random(seed)
        self._conditions, self._rates, self._manual = conditions, rates, manual_test
        fails = [name for name in SELF_TEST_BITS if self._dice.random() < 0.1]
        bits = 0
        for name in fails:
            bits |= SELF_TEST_BITS[name]
        values = self._draw_inputs()
        self._around = _Constants(values)
        self.simulator = SimulatedChip(self._around, self_test_failures=fails, data_ready_pulse_s=50e-6)
        parameters = {**CHOICES, "self_test_fails": bits & ~0x20, **_manual_test_size(), **(choices or {})}
        self.line = LineChip(library, **parameters)
        for name, value in zip(INPUTS, values, strict=True):
            self.line.input(0, name, float(value))
        self.line.power_on(0)
        self._begin = self._rise = 0
        self._free = 151 * MS
        self._kind = ""
        self._queue: list[tuple[int, int, int, int]] = []
        self.tally = Tally()

    def close(self) -> None:
        """Free the line-level chip."""
        self.line.close()

    # -- a life ------------------------------------------------------------------------------------------

    def run(self, sequences: int) -> Tally:
        """Live through sequences, until one differs or the order of events is open."""
        kinds: dict[Callable[[], None], float] = {
            self._reads: 30,
            self._scans: 15,
            self._writes: 35,
            self._status_reads: 4,
            self._alarm_on_the_edge: 2,
            self._flash: 2,
            self._restore: 1,
            self._autonull: 1,
            self._self_test: 2,
            self._sleep: 1,
            self._reset: 1,
            self._odd_length: 3,
            self._short_stall: 1,
            self._short_period: 2,
            self._odd_clock: 2,
            self._hard_reset: 1,
            self._precision: 0.02,
        }
        try:
            for action in self._dice.choices(list(kinds), list(kinds.values()), k=sequences):
                if self._dice.random() < 0.1:
                    self._step_inputs()
                self._kind = action.__name__[1:]
                action()
                if not self.tally.differences and self._dice.random() < 0.3:
                    self._compare_lines()
                self.tally.sequences += 1
                if self.tally.differences:
                    break
        except _OpenOrderError:
            self.tally.abandoned += 1
        return self.tally

    # -- sequences ----------------------------------------------------------------------------------------

    def _reads(self) -> None:
        self._send([self._any_read() for _ in range(self._dice.randrange(1, 13))])

    def _scans(self) -> None:
        registers = [0x200 * self._dice.randrange(1, 12) for _ in range(self._dice.randrange(1, 8))]
        self._send(registers * self._dice.randrange(1, 4))

    def _status_reads(self) -> None:
        self._send([0x3C00, self._any_read(), 0x3C00, 0x3D00, 0])

    def _writes(self) -> None:
        # A frame in the slow mode is not followed by one with the clock of the fast mode.
        words: list[int] = []
        sens, changed = self.simulator.memory["SENS_AVG"], False
        for _ in range(self._dice.randrange(1, 10)):
            if self._dice.random() < 0.4:
                words.append(self._any_read())
                continue
            address = self._dice.randrange(0x40)
            data = self._legal_write(address, self._dice.randrange(0x100))
            if address >> 1 == _SENS_AVG >> 1:
                new = (sens & 0xFF) | data << 8 if address & 1 else (sens & 0xFF00) | data
                m = new & 7
                if m > 6 or m < _LEAST_M.get(new >> 8 & 7, 99):
                    continue
                sens = new
            words.append(0x8000 | address << 8 | data)
            changed |= address == _SMPL_PRD
            if self._dice.random() < 0.5:
                words.append((address ^ self._dice.randrange(2)) << 8)
        self._send([*words, 0], slow_clock=changed)

    def _legal_write(self, address: int, data: int) -> int:
        """A byte whose effect the sheet settles."""
        if address == _COMMAND:
            return data & 0x60  # commands have sequences of their own
        if address == _SLP_CNT:
            return 0
        if address == _SMPL_PRD:
            small = self._dice.choice((1, 1, 1, 2, 3, 9, 10, 20, 0x80, 0x81))
            return small if self._dice.random() < 0.95 else max(1, data & 0x3F)
        if address == _MSC_CTRL:
            return data & 0x7F  # the size of the compensation is open
        if address == _MSC_CTRL + 1:
            both = data & 3 == 3
            return data & (0xFB if self._manual and not both else 0xF8)
        if address == _ALM_CTRL and not self._rates:
            return data & 0x3F
        if address in (0x2A, 0x2C):
            return max(1, data)
        return data

    def _alarm_on_the_edge(self) -> None:
        """A threshold that an output has, or is one beside."""
        channel = self._dice.randrange(11)
        word = self._send([0x200 * (channel + 1), 0])[1]
        bits = 14 if 1 <= channel <= 6 else 12
        level = (word + self._dice.choice((-1, 0, 0, 1))) & ((1 << bits) - 1)
        level |= self._dice.choice((0, 0x8000))
        filtered = self._dice.choice((0, 0x10))
        writes = ((0x26, level & 0xFF), (0x27, level >> 8), (0x2E, filtered), (0x2F, channel + 1))
        self._send([0x8000 | address << 8 | data for address, data in writes])
        self._pause(3 * self._periods())
        self._send([0x3C00, 0x0C00, 0x3C00, 0])
        self._pause(3 * self._periods())
        self._send([0x3C00, 0x0C00, 0])

    def _flash(self) -> None:
        self._send([0xBE08])
        self._pause(self._between(100.1, 105))
        self._send([0x0000, 0x0000, 0x3C00, 0x0000])

    def _restore(self) -> None:
        self._send([0xBE02])
        self._pause(self._between(100.1, 105))
        self._send([0x1A00, 0x2000, 0x2400, 0x0000, 0x0000])

    def _autonull(self) -> None:
        self._pause(self._between(160, 165) * self._periods())
        self._send([0xBE01])
        self._pause(self._between(100.1, 105))
        self._send([0x1A00, 0x1C00, 0x1E00, 0x0000, 0x0000])

    def _precision(self) -> None:
        self._send([0xBE10])
        self._pause(self._between(30_100.1, 30_105))
        self._send([0x1A00, 0x1C00, 0x1E00, 0x0000, 0x0000])

    def _self_test(self) -> None:
        self._send([0xB504])
        self._send([*(self._dice.randrange(0x0D, 0x1E) << 9 for _ in range(5)), 0])
        self._pause(self._between(36, 40))
        self._send([0x3C00, 0x3400, 0x0400, 0x0000])

    def _sleep(self) -> None:
        self._send([0xBA01], slow_clock=False)
        if self._dice.random() < 0.5:
            self._pause(self._between(1, 450))
            self._send([0x0000], compare=False)
            self._pause(self._between(3.2, 8))
        else:
            self._pause(self._between(503.2, 510))
        self._send([0x3A00, 0x3600, 0x0000], begin_unknown=True)

    def _reset(self) -> None:
        self._send([0xBE80])
        self._pause(self._between(150.1, 160))
        self._send([0x3600, 0x3C00, 0x3400, 0x0000])

    def _hard_reset(self) -> None:
        at = self._free + 100 * US
        self.line.line("rst", at / US, 0)
        self.line.line("rst", (at + 10 * US) / US, 1)
        self.simulator.hard_reset((at + 10 * US) * 1e-12)
        self._free = at + 10 * US
        self._pause(self._between(150.1, 160))
        self._send([0x3600, 0x3C00, 0x0000])

    def _odd_length(self) -> None:
        bits = self._dice.choice((0, 1, 8, 15, 17, 24, 32))
        self._send([self._any_read(), 0])
        self._send([self._any_read()], bits=bits)
        self._send([0x3C00, 0x3C00, 0])

    def _short_stall(self) -> None:
        """Around the limit of the stall; where it was too short both are deaf until the reset line."""
        slow = self._is_slow()
        limit_us = 75 if slow else 9
        half = round(0.5e12 / (150e3 if slow else 400e3))  # long enough for the period to be kept
        self._send([0x3600], half=half)
        self._free = self._rise + round(self._near(limit_us) * US)
        self._send([0x3600], half=half, early=True)
        self._send([0x3600, 0x3800, 0])
        self._hard_reset()

    def _short_period(self) -> None:
        # The quickest clock, and never so near that the stall is broken too.
        hz, limit_us, least_us = (299e3, 160, 130) if self._is_slow() else (1.9e6, 40, 18)
        self._judged(round(0.5e12 / hz), round(max(self._near(limit_us), least_us) * US))

    def _odd_clock(self) -> None:
        hz = self._near(self._dice.choice((10e3, 300e3 if self._is_slow() else 2e6)))
        self._judged(round(0.5e12 / hz), 5 * MS)

    def _judged(self, half: int, period: int) -> None:
        """Two harmless frames, and whether either chip says that they broke a rule."""
        self._send([0x3C00, 0x0000])
        before = self.line.violations()
        self._pause(1)
        self._send([0x0000], half=half, compare=False)
        self._free = self._begin + period
        self._send([0x0000], half=half, early=True, compare=False)
        self._pause(1)
        ours = self.line.violations() != before
        # What the simulator answers to such frames, and that it tells by STATUS[3], is its choice.
        words = np.array([0x3C00, 0x0000], np.uint16)
        begin = np.array([self._free, self._free + MS])
        self._begin, self._free = int(begin[1]), int(begin[1]) + MS
        self._rise = self._free
        theirs = bool(self.simulator.frames_at(words, begin * 1e-12, clock_hz=250e3)[1] & 8)
        self.line.frames(begin / US, [0x3C00, 0x0000], 250e3)
        self.tally.bits += 1
        if ours != theirs:
            rule = f"half a clock of {half * 1e-6:.6f} µs, a period of {period * 1e-6:.6f} µs"
            self._differ(rule, f"sees a fault: {theirs}", f"sees a fault: {ours}")

    def _near(self, limit: float) -> float:
        """Above or below a limit, never on it."""
        return limit * self._dice.choice((0.6, 0.95, 0.999, 1.001, 1.05, 2.0))

    # -- both chips ----------------------------------------------------------------------------------------

    def _is_slow(self) -> bool:
        return self.simulator.memory["SMPL_PRD"] & 0xFF >= 0x0A

    def _periods(self) -> float:
        """Update period in ms."""
        return self.simulator.update_period_s * 1e3

    def _between(self, low: float, high: float) -> float:
        return self._dice.uniform(low, high)

    def _any_read(self) -> int:
        return self._dice.randrange(0x4000)

    def _pause(self, ms: float) -> None:
        self._free += round(ms * MS)

    def _send(
        self,
        words: list[int],
        *,
        bits: int = 16,
        slow_clock: bool = False,
        half: int = 0,
        early: bool = False,
        compare: bool = True,
        begin_unknown: bool = False,
    ) -> list[int]:
        """Frames at random distances, none too short unless `early`; compares all answers, returns them."""
        dice, slow = self._dice, self._is_slow()
        half = half or dice.choice(_SLOW_HALVES if slow or slow_clock else _FAST_HALVES)
        spread = dice.choice((0, 0, 20, 200, 3000))
        begin = self._free
        rows = []
        for word in words:
            stall, period = (75, 160) if slow else (9, 40)
            if not early:
                begin = max(begin, self._rise + stall * US, self._begin + period * US)
                begin += round(dice.expovariate(1 / spread) * US) if spread else 0
            rows.append((begin, half, word, bits))
            self._begin, self._rise = begin, begin + 2 * bits * half
            if word >> 8 == 0x80 | _SMPL_PRD:
                slow = word & 0xFF >= 0x0A
        frames = np.array(rows, FRAME)
        self._free = self._rise
        answers, unsure = self.line.exchange(frames)
        if unsure:
            raise _OpenOrderError
        told = self._simulator_takes(frames)
        if compare:
            self._compare(frames, answers, told, first=1 if begin_unknown else 0)
        return [int(word) for word in told]

    def _simulator_takes(self, frames: NDArray[np.void]) -> NDArray[np.int64]:
        clock_hz = 0.5e12 / int(frames["half"][0])
        starts = frames["begin"] * 1e-12
        if frames["bits"][0] == 16 and self._dice.random() < 0.5:
            words = frames["word"].astype(np.uint16)
            return self.simulator.frames_at(words, starts, clock_hz=clock_hz).astype(np.int64)
        return np.array(
            [
                self.simulator.frame(int(word), start_s=float(at), clock_hz=clock_hz, bits=int(bits))
                for word, at, bits in zip(frames["word"], starts, frames["bits"], strict=True)
            ],
            np.int64,
        )

    def _compare(
        self, frames: NDArray[np.void], answers: NDArray[np.void], told: NDArray[np.int64], first: int
    ) -> None:
        said, known = answers["word"].astype(np.int64), answers["known"].astype(np.int64)
        known[:first] = 0
        differ = (said ^ told) & known
        self.tally.frames += len(frames)
        self.tally.bits += int(np.bitwise_count(known).sum())
        for k in np.flatnonzero(differ):
            if answers["loose"][k] and _within_one(int(said[k]), int(told[k]), int(known[k])):
                continue
            before = f"0x{int(frames['word'][k - 1]):04X}" if k else "the frame before the sequence"
            self._differ(
                f"answer to {before} at {frames['begin'][k] * 1e-9:.6f} ms",
                f"0x{told[k]:04X}",
                f"0x{said[k]:04X} (bits 0x{known[k]:04X})",
            )
            break

    def _compare_lines(self) -> None:
        at = self._free + round(self._between(0, 2) * MS)
        self._free = at
        ours = tuple(self.line.dio(at / US, line) for line in (1, 2))
        theirs = tuple(-1 if level is None else level for level in self.simulator.dio(at * 1e-12))
        self.tally.bits += 2
        if ours != theirs:
            self._differ(f"DIO1, DIO2 at {at * 1e-9:.6f} ms", str(theirs), str(ours))

    def _differ(self, frame: str, simulator: str, line: str) -> None:
        self.tally.differences.append(
            Difference(self._seed, self.tally.sequences, self._kind, frame, simulator, line)
        )

    # -- inputs --------------------------------------------------------------------------------------------

    def _draw_inputs(self) -> NDArray[np.float64]:
        dice = self._dice
        supply, rate, acceleration = dice.randrange(2600, 2860), 4000, 3600
        if self._conditions and dice.random() < 0.5:
            supply, rate, acceleration = dice.randrange(2500, 2960), 20_000, 9000
        rates, accelerations, temperatures = (
            np.array([dice.randrange(-most, most) for _ in range(3)]) for most in (rate, acceleration, 1500)
        )
        aux = dice.randrange(4000)
        return np.concatenate(
            [
                [(supply + _FRACTION) * 1.8315e-3],
                (rates + _FRACTION) * 0.018315,
                (accelerations + _FRACTION) * 0.4672,
                (temperatures + _FRACTION) * 0.1453 + 25,
                [(aux + _FRACTION) * 0.6105e-3],
            ]
        )

    def _step_inputs(self) -> None:
        values = self._draw_inputs()
        at = self._free + 5 * US
        self._free = at
        self._around.step(at * 1e-12, values)
        for name, value in zip(INPUTS, values, strict=True):
            self.line.input(at / US, name, float(value))


class _OpenOrderError(Exception):
    """An update came so close to a reading that either order is right."""


def _manual_test_size() -> dict[str, float]:
    """Size of the manual self-test, which is open: the simulator's."""
    from adis_gonio.sim import sampling

    return {
        "self_test_gyro": sampling.SELF_TEST_GYRO_DPS,
        "self_test_accl": sampling.SELF_TEST_ACCEL_MG,
    }


def _within_one(one: int, other: int, known: int) -> bool:
    """True where flags agree and the numbers are at most one apart."""
    if (one ^ other) & 0xC000:
        return False
    data = known & 0x3FFF
    apart = ((one & data) - (other & data)) & data
    return apart in (1, data)


def run_lives(library: Path, seeds: range, sequences: int, **options: bool) -> Tally:
    """Lives of so many sequences each."""
    total = Tally()
    for seed in seeds:
        life = Life(library, seed, **options)
        try:
            total.add(life.run(sequences))
        finally:
            life.close()
    return total
