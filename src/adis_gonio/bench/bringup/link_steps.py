"""Bring-up steps on the link and the sensor: replies, limits, clocks, supply, temperature, variant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.bench.bringup.bringup_step import (
    BOARD_CLOCK_U,
    BringupBench,
    Ending,
    StepResult,
    Verdict,
    Z,
)
from adis_gonio.device.bus import SpiTiming, Words
from adis_gonio.device.sensor.driver import PLAUSIBLE
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    FAST,
    FAST_UP_TO,
    IDLE,
    NORMAL,
    REGISTERS,
    SUPPLY_LIMITS_V,
    TEMP_OUT,
    TEMPERATURE_LIMITS_C,
    VARIANTS,
    Register,
    read_frames,
    registers,
)
from adis_gonio.device.sensor.settings import Configuration, Status, mean_at_rest, scales

CLOCKS_HZ = (2e6, 1.5e6, 1e6, 750e3, 500e3, 250e3, 125e3, 62.5e3, 31.25e3)
"""Clocks to try in Hz: steps of the bridges within the limits of the chip's modes."""
READS = 1000
_PASSES = 3

_CONSTANT = tuple(
    row
    for row in REGISTERS
    if row.readable and not row.flags and row.name not in ("STATUS", "GPIO_CTRL", "SLP_CNT")
)
"""Registers that only a write changes."""


def legal(row: Register, word: int) -> bool:
    """Return True if a register can contain this word.

    It cannot if a bit is set outside the bits of its number or its fields, or if the chip does not allow
    its content.
    """
    if row.name == "ENDURANCE":
        return word < 1 << 15
    if row.signed:
        return row.number(word) in (word, word - (1 << row.bits), word - (1 << 16))
    # The default of the other of the two registers is allowed.
    held = {"SMPL_PRD": 0x0001, "SENS_AVG": 0x0402, row.name: word}
    allowed = Configuration.from_words(held["SMPL_PRD"], held["SENS_AVG"], 0).allowed
    return word & ~row.write_mask == 0 and allowed


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


def check_link(bench: BringupBench, found: StepResult) -> Ending:
    """Read the control registers three times: silence, a stuck, inverted or shifted data line.

    Tests also if a known wiring error explains the replies.
    """
    words, _ = _read_constants(bench, _PASSES)
    first = [int(word) for word in words[0]]
    found.measure("control registers read", len(first), expected=len(_CONSTANT))
    problem = _unreadable(words)
    if not problem:
        scores = [
            sum(legal(row, way(word)) for row, word in zip(_CONSTANT, first, strict=True))
            for _, way in _READINGS
        ]
        found.measure("of them with legal content", scores[0], expected=len(_CONSTANT))
        if 2 * max(scores) < len(first):
            problem = "the words make no sense in any reading: check the wires of DIN, DOUT and CS"
        else:
            problem = _READINGS[scores.index(max(scores))][0]
    if problem:
        bench.blocked = "the link does not work"
        return Verdict.FAULT, problem
    bench.constants = dict(zip((row.name for row in _CONSTANT), first, strict=True))
    wrong = [
        f"{r.name} 0x{word:04X}" for r, word in zip(_CONSTANT, first, strict=True) if not legal(r, word)
    ]
    if wrong:
        return Verdict.DIFFERS, f"registers answer, but with contents not allowed: {', '.join(wrong)}"
    names = ", ".join(sorted(bench.bus.capabilities)) or "none"
    return Verdict.OK, f"the registers answer with legal content; capabilities of the bridge: {names}"


def _unreadable(words: Words) -> str:
    found = {int(word) for word in words.ravel()}
    if len(found) == 1:
        return f"all replies are 0x{found.pop():04X}: nothing drives the data line"
    changing = int(np.count_nonzero(np.any(words != words[0], axis=0)))
    if 2 * changing > words.shape[1]:
        return (
            f"{changing} of {words.shape[1]} constant registers read differently each time: check the wires"
        )
    return ""


_TIMED_FRAMES = 500


def check_timing(bench: BringupBench, found: StepResult) -> Ending:
    """Ask the bridge for the timing of both modes and time 500 frames.

    Clock, stall and period that the bridge reports, and the measured time of a frame, are compared with the
    limits of the sensor.
    """
    wrong: list[str] = []
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
    begin_s = bench.bus.now_s()
    bench.bus.exchange_array(np.full(_TIMED_FRAMES, IDLE, np.uint16))
    frame_us = 1e6 * (bench.bus.now_s() - begin_s) / _TIMED_FRAMES
    found.measure("normal: a frame took", frame_us, "us", expected=NORMAL.period_us)
    wrong += _too_quick(frame_us, bench.bus.timing)
    if wrong:
        bench.blocked = "the bridge breaks the part's limits"
        return Verdict.FAULT, f"the bridge breaks the part's limits: {'; '.join(wrong)}"
    value = [figure.value for figure in found.figures]
    return Verdict.OK, (
        f"the bridge reports {value[0] / 1e3:g} kHz and {value[1]:g} µs of stall in fast mode,"
        f" {value[3] / 1e3:g} kHz and {value[4]:g} µs in normal mode, where a frame takes"
        f" {frame_us:.0f} µs"
    )


def _too_quick(frame_us: float, timing: SpiTiming) -> list[str]:
    """Return a message, in a list, if a frame takes less time than the bridge reports; else an empty list.

    `frame_us` is the measured time of a frame in µs, `timing` the reported timing. The error of the
    bridge's clock is allowed for.
    """
    least_us = 1e6 * timing.frame_s
    if frame_us < least_us * (1 - np.sqrt(3) * BOARD_CLOCK_U):
        return [f"a frame takes {frame_us:.1f} µs, the part needs {least_us:.0f}: the stall is not kept"]
    return []


def count_bit_errors(bench: BringupBench, found: StepResult) -> Ending:
    """Read constant registers 1000 times at each clock of the bridge, slowest first.

    Ends at the first clock with errors, and limits later steps to the fastest clock without errors. A
    flipped bit may turn a read into a write, so no clock above a clock with errors is tried. A link is
    good if its error rate is below 1e-10 per bit: then about one board in 100 000 shows an error.
    """
    smpl_prd = bench.constants["SMPL_PRD"] & 0xFF
    # The highest clock of each mode is by the data sheet (A).
    fastest_hz, limit = (2e6, FAST) if smpl_prd <= FAST_UP_TO else (300e3, NORMAL)
    clocks = _offered(bench, fastest_hz, limit)
    expected = np.empty(0, np.uint16)
    clean: list[float] = []
    quick: list[str] = []
    bad = total = 0
    for clock in clocks:
        timing = bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=clock))
        words, frame_us = _read_constants(bench, -(-READS // len(_CONSTANT)))
        if not clean:  # the majority at the slowest clock is the truth
            expected = _majority(words)
        bad, total = int(np.count_nonzero(words != expected)), total + words.size
        found.measure(f"wrong of {words.size} at {clock / 1e3:g} kHz", bad, expected=0)
        quick += _too_quick(frame_us, timing)
        if bad:
            break
        clean.append(clock)
    bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=clocks[0]))
    changed: list[str] = []
    if bad and clean:
        now = _majority(_read_constants(bench, len(words))[0])
        changed = [row.name for row, a, b in zip(_CONSTANT, expected, now, strict=True) if a != b]
    bench.bus.ceiling_hz = max(clean, default=clocks[0])
    bench.refresh()
    if quick:
        bench.blocked = "the bridge breaks the part's limits"
        return Verdict.FAULT, quick[0]
    if not bad:
        return Verdict.OK, (
            f"no error in {total} words at {len(clean)} clocks from {clocks[0] / 1e3:g} to"
            f" {clocks[-1] / 1e3:g} kHz"
        )
    text = f"{bad} of {words.size} words are wrong at {clock / 1e3:g} kHz"
    if not clean:
        bench.blocked = "words are wrong at the slowest clock"
        text += ", the slowest: shorten the wires, check supply and ground"
    else:
        text += f", none up to {clean[-1] / 1e3:g} kHz: shorten the wires; later steps were no faster"
    if changed:
        text += f"; a read became a write: {', '.join(changed)} changed"
    return Verdict.FAULT, text


def _offered(bench: BringupBench, most_hz: float, limit: SpiTiming) -> list[float]:
    """Return the clocks in Hz that the bridge offers up to `most_hz`, slowest first.

    `limit` is the timing of the sensor's mode, whose stall and period are kept.
    """
    found = set()
    for asked in CLOCKS_HZ:
        if asked <= most_hz:
            try:
                found.add(bench.bus.inner.configure(dataclasses.replace(limit, clock_hz=asked)).clock_hz)
            except UsageError:  # slower than the bridge can
                break
    return sorted(clock for clock in found if clock <= most_hz)


def _read_constants(bench: BringupBench, passes: int) -> tuple[Words, float]:
    """Read the constant registers in `passes` passes.

    Returns the words (passes, registers), and the time of a frame in µs.
    """
    frames = np.append(np.tile(read_frames(_CONSTANT), passes), np.uint16(IDLE))
    begin_s = bench.bus.now_s()
    words = bench.bus.exchange_array(frames)[1:].reshape(passes, -1)
    return words, 1e6 * (bench.bus.now_s() - begin_s) / len(frames)


def _majority(words: Words) -> Words:
    """Return the words (registers,) in which each bit has the value that most passes read.

    `words` are the words (passes, registers) that were read.
    """
    # Bits (passes, registers, 16): a bit is one if it is one in most passes.
    ones = ((words[:, :, np.newaxis] >> np.arange(16, dtype=np.uint16)) & 1).mean(axis=0) > 0.5
    return np.asarray((ones.astype(np.uint32) << np.arange(16)).sum(axis=1), np.uint16)


_SCANS = 256


def check_supply(bench: BringupBench, found: StepResult) -> Ending:
    """Read supply and temperatures 256 times; read STATUS twice (a read clears it).

    Supply and temperatures are compared with the limits of operation, and STATUS has to be clear.
    """
    first = bench.sensor.read("STATUS")
    bench.wait_updates()
    standing = Status(bench.sensor.read("STATUS"))
    names = ("SUPPLY_OUT", *TEMP_OUT)
    block = bench.scans(_SCANS, names)
    lsb, _, _ = scales(registers(names), bench.sensor.variant, 300)
    value, u = mean_at_rest(block.values(), lsb, bench.sensor.configuration().filter_m)
    found.measure("supply", value[0], "V", u[0], 5.0)
    for axis, t, s in zip("xyz", value[1:], u[1:], strict=True):
        found.measure(f"temperature {axis}", t, "degC", s)
    found.measure("STATUS at first", first)
    found.measure("STATUS read again", standing.word, expected=0)
    wrong = []
    low, high = SUPPLY_LIMITS_V
    if not low - Z * u[0] <= value[0] <= high + Z * u[0]:
        bench.supply_ok = False
        wrong.append(f"the supply is {value[0]:.3f} V, the part needs {low} to {high} V")
    for axis, t, s in zip("XYZ", value[1:], u[1:], strict=True):
        if not TEMPERATURE_LIMITS_C[0] - Z * s <= t <= TEMPERATURE_LIMITS_C[1] + Z * s:
            wrong.append(f"{axis}TEMP_OUT says {t:.0f} °C")
    if standing.word:
        wrong.append(f"STATUS: {standing}")
    if standing.flags["supply_low"] or standing.flags["supply_high"]:
        bench.supply_ok = False
    if wrong:
        return Verdict.FAULT, "; ".join(wrong)
    warmth = ", ".join(f"{t:.1f}" for t in value[1:])
    return Verdict.OK, f"supply {value[0]:.3f} V, temperatures {warmth} °C, STATUS clear"


def identify_variant(bench: BringupBench, found: StepResult) -> Ending:
    """Measure |a| at rest, less the offsets: 2140 LSB on the ADIS16354, 397 on the ADIS16350/55.

    No property but |a| at 1 g differs between the variants.
    """
    block = bench.scans(_SCANS, ACCEL_OUT)
    numbers = block.numbers().astype(np.float64)
    mean, u = mean_at_rest(numbers, 1.0, bench.sensor.configuration().filter_m)
    # The bias in the table is the bias of the part alone, without the offset registers.
    offsets = [row.number(bench.constants[row.name]) for row in registers(ACCEL_OFF)]
    mean = mean - offsets
    norm = float(np.linalg.norm(mean))
    u_norm = float(np.sqrt((mean * u) @ (mean * u))) / max(norm, 1e-9)
    asked = bench.sensor.variant
    warm = bench.sensor.quantity("XTEMP_OUT").value - 25.0
    # Of all good sensors of the variant at all places on Earth, relative to 1 g.
    figures = asked.performance
    parts = (
        figures.initial_bias_mg / 1000,
        figures.scale_error_typical,
        figures.bias_tempco_mg_per_c * warm / 1000,
        0.0026 / np.sqrt(3),  # local gravity is within 0.26 % of the standard value
        u_norm * asked.accel_mg_per_lsb / 1000,
    )
    tolerance = float(np.linalg.norm(parts))
    off = norm / asked.one_g_lsb - 1
    found.measure("|a|", norm, "LSB", u_norm, asked.one_g_lsb)
    for name, m, s in zip(ACCEL_OUT, mean, u, strict=True):
        found.measure(f"mean of {name}, less its offset", m, "LSB", s)
    found.measure("tolerance of |a| (1 sigma)", tolerance * asked.one_g_lsb, "LSB")
    fits = [v for v in VARIANTS.values() if abs(norm / v.one_g_lsb - 1) <= PLAUSIBLE]
    if not fits:
        return Verdict.FAULT, f"|a| is {norm / asked.one_g_lsb:.2f} g: no known part; was it still?"
    if fits[0].one_g_lsb != asked.one_g_lsb:
        names = " or ".join(v.name.upper() for v in fits)
        bench.sensor.variant = fits[0]
        return Verdict.FAULT, (
            f"|a| is {norm:.0f} LSB: this is an {names}, not an {asked.name.upper()}"
            f" ({asked.one_g_lsb:.0f} LSB); the rest is judged as for an {fits[0].name.upper()}"
        )
    if abs(off) > Z * tolerance:
        return Verdict.DIFFERS, (
            f"|a| is {1000 * norm / asked.one_g_lsb:.0f} mg, further from 1 g than the table's bias and"
            " gain allow"
        )
    return Verdict.OK, f"|a| is {norm:.0f} LSB, {1 + off:.3f} g of an {asked.name.upper()}"
