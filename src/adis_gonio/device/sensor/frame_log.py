"""Frames of a recording or capture as rows: register, decoded word, and violations of the SPI timing.

The timing rules come from the data sheet (DS; sources in `registers`): the clock, stall and period that the
mode of SMPL_PRD needs, and silence after a reset, a restore, a flash update or a precision autonull. The
mode is known from the first access to SMPL_PRD on; before that, and after a reset until the next access,
no timing rule is checked.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.bus import FrameBlock, SpiTiming
from adis_gonio.device.bus.recording import Call
from adis_gonio.device.sensor import registers
from adis_gonio.device.sensor.settings import Configuration

BUSY_S = {"reset": 0.15, "restore": 0.15, "flash_update": 0.1, "autonull": 0.1, "precision_autonull": 30.1}
"""Shortest time in s for which the chip must not be addressed after a command.

It is the start-up time after a reset and a restore (DS, B), 100 ms for a flash update (A), with which both
autonulls end, and before it 30 s for a precision autonull (B).
"""
FASTEST_FAST_HZ, FASTEST_NORMAL_HZ = 2e6, 300e3
"""Highest SPI clock in Hz in fast mode and in normal mode (DS, A)."""

TOLERANCE = 0.01
"""Relative tolerance of a measured time or clock, because a logic analyser samples in steps."""


class FrameRow(JsonRecord):
    """One frame of a recording or capture, or one other call of the bus, as a row.

    Attributes
    ----------
    record : int
        Number of the record in the recording.
    time_s : float
        Start of the frame on the clock of the bus; within a batch interpolated.
    action : str
        `read`, `write`, or the name of another call.
    register : str
        Register that the frame addresses; `+1` marks its high byte; empty for another call.
    frame, word : int or None
        The frame, and the word that answers it, which the chip shifts out during the next frame; None for
        another call or an unknown word.
    value : str
        Decoded word, or a description of the call.
    problem : str
        Recorded error, or violated timing rule; otherwise empty.
    """

    record: int
    time_s: float
    action: str
    register: str = ""
    frame: int | None = None
    word: int | None = None
    value: str = ""
    problem: str = ""


class FrameLog:
    """Converts the calls of a recording or capture to rows, one for each frame or block of a stream.

    Parameters
    ----------
    part : Variant
        Variant that decodes the words.
    """

    def __init__(self, part: registers.Variant) -> None:
        self._part = part
        self._gyro_range = 300
        self._timing: SpiTiming | None = None
        self._smpl_prd: int | None = None
        self._busy_until_s, self._busy_with = float("-inf"), ""
        self._before: tuple[int, float, int, str] | None = None
        self._ended: tuple[float, float] | None = None

    def rows(self, calls: Iterable[Call]) -> Iterator[FrameRow]:
        """Yield the rows of calls in their order; calls that only read the clock have no row."""
        for call in calls:
            if call.name == "exchange":
                yield from self._exchanged(call)
            elif call.name == "frame":
                yield from self._captured(call)
            elif call.name == "block" and isinstance(call.result, FrameBlock):
                (n, k), lost = call.result.words.shape, call.result.lost
                ended = f", {lost} lost before their end" if lost else ""
                yield FrameRow(call.number, call.end_s, "block", value=f"{n} scans of {k} words{ended}")
            elif call.name != "clock":
                if call.name == "configure" and call.result:
                    self._timing = SpiTiming(**call.result)
                elif call.name == "hard_reset":
                    self._busy_until_s, self._busy_with = call.begin_s + BUSY_S["reset"], "a hard reset"
                    self._smpl_prd = None
                yield FrameRow(
                    call.number, call.begin_s, call.name, value=_described(call), problem=_failure(call)
                )
        if self._before is not None:
            yield self._frame_row(*self._before, None)

    def _exchanged(self, call: Call) -> Iterator[FrameRow]:
        assert call.frames is not None
        times, words = (each.tolist() for each in call.read_words())
        for frame, word, time_s in zip(call.frames.tolist(), words, times, strict=True):
            problem = _failure(call) or self._broken_rule(time_s)
            yield self._frame_row(call.number, time_s, frame, problem, None if word < 0 else word)

    def _captured(self, call: Call) -> Iterator[FrameRow]:
        """Yield the row of the previous frame of a capture, whose reply is now known.

        `call` is the present frame, during which the chip shifts out the reply to the previous one. Before
        the second frame nothing is yielded.
        """
        assert call.frames is not None
        if self._before is not None:
            yield self._frame_row(*self._before, int(call.result[0]))
        if self._ended is not None and call.arguments[0] > 0:
            began_s, ended_s = self._ended
            stall_us, period_us = (call.begin_s - ended_s) * 1e6, (call.begin_s - began_s) * 1e6
            self._timing = SpiTiming(call.arguments[0], stall_us, period_us)
        self._ended = call.begin_s, call.end_s
        problem = _failure(call) or self._broken_rule(call.begin_s)
        self._before = call.number, call.begin_s, int(call.frames[0]), problem

    def _frame_row(
        self, number: int, time_s: float, frame: int, problem: str, word: int | None
    ) -> FrameRow:
        row, high = registers.addressed(frame)
        action = "write" if frame & registers.WRITE else "read"
        name = f"0x{frame >> 8 & 0x3F:02X}" if row is None else row.name + ("+1" if high else "")
        if frame & registers.WRITE:
            self._follow_write(row, high, frame & 0xFF, time_s)
            # Names of the commands or fields that the byte sets.
            fields = row.fields if row is not None and row.kind is registers.Kind.FIELDS else ()
            shifted = (frame & 0xFF) << (8 if high else 0)
            names = [field.name for field in fields if shifted & field.mask]
            value = f"0x{frame & 0xFF:02X}" + (f" ({', '.join(names)})" if names else "")
        else:
            value = "" if word is None else self._decoded(row, word)
        return FrameRow(number, time_s, action, name, frame, word, value, problem)

    def _decoded(self, row: registers.Register | None, word: int) -> str:
        if row is None:
            return ""
        if row.name == "SMPL_PRD":
            self._smpl_prd = word & 0xFF
        elif row.name == "SENS_AVG":
            self._gyro_range = Configuration.from_words(0, word, 0).gyro_range_dps or self._gyro_range
        if row.kind is registers.Kind.FIELDS:
            return " ".join(f"{field.name}={field.of(word)}" for field in row.fields if field.of(word))
        if row.kind is registers.Kind.COUNT:
            return str(row.number(word))
        lsb, zero, unit = self._part.lsb(row.kind, self._gyro_range)
        flags = " (old)" if row.flags and not word & registers.ND else ""
        flags += " (error or alarm)" if row.flags and word & registers.EA else ""
        return f"{row.number(word) * lsb + zero:.6g} {unit}{flags}"

    def _follow_write(self, row: registers.Register | None, high: bool, byte: int, time_s: float) -> None:
        """Note a written byte that sets the timing mode (SMPL_PRD) or starts a command.

        After some commands the host must be silent for a time, which begins at `time_s`. `row` is the
        written register (None if unknown), `high` is True for its high byte, `byte` the value of the byte.
        """
        if row is None or high:
            return
        if row.name == "SMPL_PRD":
            self._smpl_prd = byte
        if row.name == "COMMAND":
            for name in started_commands(byte):
                self._busy_until_s, self._busy_with = time_s + BUSY_S[name], name.replace("_", " ")
                if name == "reset":  # the copy in flash, which is not known, takes effect
                    self._smpl_prd = None

    def _broken_rule(self, time_s: float) -> str:
        if time_s < self._busy_until_s:
            return f"sent {self._busy_until_s - time_s:.3g} s before the end of {self._busy_with}"
        if self._smpl_prd is None or self._timing is None:
            return ""
        needed = registers.timing_for(self._smpl_prd)
        fastest_hz = FASTEST_FAST_HZ if needed is registers.FAST else FASTEST_NORMAL_HZ
        now = self._timing
        if now.clock_hz > fastest_hz * (1 + TOLERANCE):
            return f"clock {now.clock_hz / 1e3:.4g} kHz, at most {fastest_hz / 1e3:g} kHz"
        if now.frame_s < needed.period_us * 1e-6 * (1 - TOLERANCE):
            return f"period {now.frame_s * 1e6:.3g} µs, at least {needed.period_us:g} µs"
        if now.stall_us < needed.stall_us * (1 - TOLERANCE):
            return f"stall {now.stall_us:.3g} µs, at least {needed.stall_us:g} µs"
        return ""


def started_commands(byte: int) -> list[str]:
    """Return the names of the commands that a byte written to the register COMMAND starts.

    Only commands after which the host must be silent for a time are returned.
    """
    return [name for name in BUSY_S if byte & registers.BY_NAME["COMMAND"].field(name).mask]


def _failure(call: Call) -> str:
    return "" if call.error is None else f"{type(call.error).__name__}: {call.error}"


def _described(call: Call) -> str:
    if call.name == "configure" and call.result:
        timing = SpiTiming(**call.result)
        kilohertz = timing.clock_hz / 1e3
        return f"{kilohertz:g} kHz, stall {timing.stall_us:g} µs, period {timing.period_us:g} µs"
    parts = [] if call.frames is None else [f"{len(call.frames)} frames"]
    parts += [str(argument) for argument in call.arguments]
    return ", ".join(parts) + ("" if call.result is None else f" → {call.result}")
