"""The link: does anything sensible answer, are the limits kept, at which clocks are words right."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.bringup.bench import BOARD_CLOCK_U, BringupBench, BringupStep, at_most
from adis_gonio.bench.bringup.result import Curve, Findings, StepResult
from adis_gonio.device.bus import SpiTiming, Words
from adis_gonio.device.sensor.registers import (
    FAST,
    FAST_UP_TO,
    IDLE,
    NORMAL,
    REGISTERS,
    Register,
    read_frames,
)
from adis_gonio.device.sensor.variants import LEAST_M, RANGE_CODE

CLOCKS_HZ = (2e6, 1.5e6, 1e6, 750e3, 500e3, 250e3, 125e3, 62.5e3, 31.25e3)
"""Clocks that a bridge is asked for: the bridges' own steps, within the limits of the chip's modes."""
FASTEST_HZ = {"fast": 2e6, "normal": 300e3}
"""Highest clock of a mode (DS, A)."""
READS = 1000
_PASSES = 3

_CONSTANT = tuple(
    row
    for row in REGISTERS
    if row.readable and not row.flags and row.name not in ("STATUS", "GPIO_CTRL", "SLP_CNT")
)
"""Registers whose content nobody changes meanwhile."""


def legal(row: Register, word: int) -> bool:
    """True where a word can stand in a register: no bit beside its number or its fields."""
    if row.name == "ENDURANCE":
        return word < 1 << 15
    if row.name == "SMPL_PRD":
        return word & ~row.write_mask == 0 and word & row.write_mask != 0
    if row.name == "SENS_AVG":
        code, m = row.field("range").of(word), row.field("m").of(word)
        dps = next((dps for dps, known in RANGE_CODE.items() if known == code), None)
        return word & ~row.write_mask == 0 and dps is not None and LEAST_M[dps] <= m <= 6
    if row.signed:
        return row.number(word) in (word, word - (1 << row.bits), word - (1 << 16))
    return word & ~row.write_mask == 0


_READINGS: tuple[tuple[str, Callable[[int], int]], ...] = (
    ("", lambda word: word),
    ("the data line (MISO) is inverted: look for an inverting level shifter", lambda word: word ^ 0xFFFF),
    (
        "the words come one bit late: the bridge samples at the wrong edge (mode 3?)",
        lambda w: w << 1 & 0xFFFF,
    ),
    (
        "the words come one bit early: the bridge samples at the wrong edge (mode 3?)",
        lambda word: word >> 1,
    ),
    ("the two bytes of the words are swapped", lambda word: word >> 8 | (word & 0xFF) << 8),
)


class Link(BringupStep):
    """Whether there is a chip, and whether it is read the right way."""

    name = "link"
    does = "reads the control registers three times: silence, a stuck, inverted or shifted data line"

    def run(self, bench: BringupBench) -> StepResult:
        """Try every way of reading that a wrong board makes."""
        frames = np.append(np.tile(read_frames(_CONSTANT), _PASSES), np.uint16(IDLE))
        words = bench.bus.exchange_array(frames)[1:].reshape(_PASSES, -1)
        first = [int(word) for word in words[0]]
        found = Findings()
        found.measure("control registers read", len(first), expected=len(_CONSTANT))
        problem = _silence(words) or _unsteady(words)
        if not problem:
            scores = [
                sum(legal(row, way(word)) for row, word in zip(_CONSTANT, first, strict=True))
                for _, way in _READINGS
            ]
            found.measure("of them with legal content", scores[0], expected=len(_CONSTANT))
            if max(scores) > scores[0]:
                problem = _READINGS[scores.index(max(scores))][0]
            elif 2 * scores[0] < len(first):
                problem = "what is read makes no sense in any way: check the wires of DIN, DOUT and CS"
        if problem:
            bench.blocked = "the link does not work"
            return found.fault(problem)
        bench.constants = dict(zip((row.name for row in _CONSTANT), first, strict=True))
        wrong = [row.name for row, word in zip(_CONSTANT, first, strict=True) if not legal(row, word)]
        if wrong:
            return found.differs(
                f"registers answer, but with bits that they should not have: {', '.join(wrong)}"
            )
        names = ", ".join(sorted(bench.bus.capabilities)) or "none"
        return found.ok(f"the registers answer with legal content; capabilities of the bridge: {names}")


def _silence(words: Words) -> str:
    found = {int(word) for word in words.ravel()}
    if found == {0}:
        return "all replies are zeros: the data line (MISO) is stuck low, or nothing drives it"
    if found == {0xFFFF}:
        return "all replies are ones: the data line (MISO) is stuck high, or no chip is selected"
    return f"all replies are 0x{found.pop():04X}: nothing drives the data line" if len(found) == 1 else ""


def _unsteady(words: Words) -> str:
    changing = int(np.count_nonzero(np.any(words != words[0], axis=0)))
    if 2 * changing > words.shape[1]:
        return (
            f"{changing} of {words.shape[1]} constant registers read differently each time: check the wires"
        )
    return ""


class Timing(BringupStep):
    """What the bridge says of clock, stall and period, and how long a frame takes by its clock."""

    name = "timing"
    does = "asks the bridge for both modes' timing and times 500 frames"
    _frames = 500

    def run(self, bench: BringupBench) -> StepResult:
        """Compare with the limits of the part."""
        found, wrong = Findings(), []
        for mode, asked in (("fast", FAST), ("normal", NORMAL)):
            got = bench.bus.inner.configure(asked)
            found.measure(f"{mode}: clock", got.clock_hz, "Hz", expected=asked.clock_hz)
            found.measure(f"{mode}: stall", got.stall_us, "us", expected=asked.stall_us)
            found.measure(f"{mode}: period", got.period_us, "us", expected=asked.period_us)
            if got.clock_hz > asked.clock_hz:
                wrong.append(f"clocks at {got.clock_hz:g} Hz where at most {asked.clock_hz:g} was asked")
            if got.stall_us < asked.stall_us or got.period_us < asked.period_us:
                wrong.append(f"stall {got.stall_us:g} and period {got.period_us:g} µs in {mode} mode")
        bench.bus.configure(NORMAL)
        frame_us = 1e6 * _frame_s(bench, self._frames)
        found.measure("normal: a frame took", frame_us, "us", expected=NORMAL.period_us)
        wrong += _too_quick(frame_us, bench.bus.timing)
        if wrong:
            bench.blocked = "the bridge breaks the part's limits"
            return found.fault(f"the bridge breaks the part's limits: {'; '.join(wrong)}")
        value = [figure.value for figure in found.figures]
        return found.ok(
            f"the bridge reports {value[0] / 1e3:g} kHz and {value[1]:g} µs of stall in fast mode,"
            f" {value[3] / 1e3:g} kHz and {value[4]:g} µs in normal mode, where a frame takes"
            f" {frame_us:.0f} µs"
        )


def _frame_s(bench: BringupBench, count: int) -> float:
    """Time of a frame by the bus's clock, in one batch."""
    begin_s = bench.bus.now_s()
    bench.bus.exchange_array(np.full(count, IDLE, np.uint16))
    return (bench.bus.now_s() - begin_s) / count


def _too_quick(frame_us: float, timing: SpiTiming) -> list[str]:
    """A frame that takes less than the bridge promises by more than its clock can be off."""
    least_us = 1e6 * timing.frame_s
    if frame_us < least_us * (1 - np.sqrt(3) * BOARD_CLOCK_U):
        return [f"a frame takes {frame_us:.1f} µs, the part needs {least_us:.0f}: the stall is not kept"]
    return []


@dataclass(frozen=True)
class _Trial:
    clock_hz: float
    reads: int
    wrong_words: int
    wrong_bits: int
    frame_us: float


class BitErrors(BringupStep):
    """Constant registers at every clock, slowest first; ends at the first clock with errors.

    A flipped bit on the way in may make a write of a read, so no clock above one with errors is tried.
    A link is sound where its error rate is below 1e-10 a bit: then an error comes about once in 100 000
    boards.
    """

    name = "bit errors"
    does = "1000 reads of constant registers at each clock of the bridge, slowest first"

    def run(self, bench: BringupBench) -> StepResult:
        """Try the clocks and set the ceiling."""
        smpl_prd = bench.constants["SMPL_PRD"] & 0xFF
        mode, limit = ("fast", FAST) if smpl_prd <= FAST_UP_TO else ("normal", NORMAL)
        clocks = _offered(bench, FASTEST_HZ[mode], limit)
        bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=clocks[0]))
        expected = np.array([bench.constants[row.name] for row in _CONSTANT], np.uint16)
        trials: list[_Trial] = []
        quick: list[str] = []
        for clock in clocks:
            timing = bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=clock))
            trial, words = _try(bench, clock, expected)
            if (
                not trials
            ):  # at the slowest the majority is the truth: a wrong first reading is no reference
                expected = _majority(words)
                trial = _judge(clock, words, expected, trial.frame_us)
            trials.append(trial)
            quick += _too_quick(trial.frame_us, timing)
            if trial.wrong_words:
                break
        bad = trials[-1] if trials[-1].wrong_words else None
        clean = [trial.clock_hz for trial in trials if not trial.wrong_words]
        bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=clocks[0]))
        changed: list[str] = []
        if bad is not None and clean:
            _, words = _try(bench, clocks[0], expected)
            changed = [
                row.name for row, a, b in zip(_CONSTANT, expected, _majority(words), strict=True) if a != b
            ]
        bench.bus.ceiling_hz = max(clean, default=clocks[0])
        bench.refresh()
        bits = 16 * sum(trial.reads for trial in trials)
        errors = sum(trial.wrong_bits for trial in trials)
        found = Findings()
        for t in trials:
            found.measure(f"wrong of {t.reads} at {t.clock_hz / 1e3:g} kHz", t.wrong_words, expected=0)
        found.measure("bit error rate, upper limit (95 %)", at_most(errors, bits))
        curve = Curve(
            "bit errors", "clock / kHz", "wrong words / 1000 reads", [t.clock_hz / 1e3 for t in trials],
            {"wrong words": [1e3 * t.wrong_words / t.reads for t in trials]},
            "Wrong words at each clock; no clock above the first with errors is tried.",
        )  # fmt: skip
        found.curves = (curve,)
        if quick:
            bench.blocked = "the bridge breaks the part's limits"
            return found.fault(quick[0])
        if bad is None:
            return found.ok(
                f"no error in {bits // 16} words at {len(trials)} clocks from {clocks[0] / 1e3:g} to"
                f" {clocks[-1] / 1e3:g} kHz"
            )
        text = f"{bad.wrong_words} of {bad.reads} words are wrong at {bad.clock_hz / 1e3:g} kHz"
        if not clean:
            bench.blocked = "words are wrong at the slowest clock"
            text += ", the slowest: shorten the wires, check supply and ground"
        else:
            text += (
                f", none up to {clean[-1] / 1e3:g} kHz: shorten the wires; what follows was done no faster"
            )
        if changed:
            text += f"; a read became a write: {', '.join(changed)} changed"
        return found.fault(text)


def _offered(bench: BringupBench, most_hz: float, limit: SpiTiming) -> list[float]:
    """Clocks of the bridge within the limits of the mode, slowest first."""
    found = set()
    for asked in CLOCKS_HZ:
        if asked <= most_hz:
            try:
                found.add(bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=asked)).clock_hz)
            except UsageError:  # slower than the bridge can
                break
    return sorted(clock for clock in found if clock <= most_hz)


def _try(bench: BringupBench, clock_hz: float, expected: Words) -> tuple[_Trial, Words]:
    passes = -(-READS // len(_CONSTANT))
    frames = np.append(np.tile(read_frames(_CONSTANT), passes), np.uint16(IDLE))
    begin_s = bench.bus.now_s()
    words = bench.bus.exchange_array(frames)[1:].reshape(passes, -1)
    frame_us = 1e6 * (bench.bus.now_s() - begin_s) / len(frames)
    return _judge(clock_hz, words, expected, frame_us), words


def _judge(clock_hz: float, words: Words, expected: Words, frame_us: float) -> _Trial:
    wrong = words ^ expected
    bits = int(np.unpackbits(wrong.astype(">u2").view(np.uint8)).sum())
    return _Trial(clock_hz, words.size, int(np.count_nonzero(wrong)), bits, frame_us)


def _majority(words: Words) -> Words:
    """Each bit as most of the passes have it."""
    ones = ((words[:, :, np.newaxis] >> np.arange(16, dtype=np.uint16)) & 1).mean(axis=0) > 0.5
    words_of: Words = (ones.astype(np.uint32) << np.arange(16)).sum(axis=1).astype(np.uint16)
    return words_of
