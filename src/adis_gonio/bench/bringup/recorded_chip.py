"""The registers of a chip, followed through the frames of a recording or a capture of its bus.

`RecordedChip` keeps the contents that the register table predicts after each write and command, and stores
the replies that show a rule of the chip, which `chip_rows` judges. It writes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.bench.bringup.link_steps import legal
from adis_gonio.device.bus import FrameBlock
from adis_gonio.device.bus.recording import Call
from adis_gonio.device.sensor import settings
from adis_gonio.device.sensor.frame_log import started_commands
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_ADDRESS,
    BY_NAME,
    GYRO_OFF,
    GYRO_OUT,
    ND,
    READING_BITS,
    WRITE,
    Register,
    addressed,
)

Integers = NDArray[np.int64]
_COMMAND, _MISC = BY_NAME["COMMAND"], BY_NAME["MSC_CTRL"]
SELF_TEST = _MISC.field("self_test").mask


@dataclass
class RegisterSpan:
    """Time between two changes of the registers.

    Attributes
    ----------
    begin_s : float
        Time in s of the change at its beginning.
    image : dict of str to int
        Words of the control registers, by name, as far as they are known.
    changed_s : float
        Time in s of the last change that affects readings; from then on they settle.
    verified : set of str
        Names of the registers that were read since they changed.
    outputs : dict of str to list of (times, words)
        Times in s and words of each output register that was read, by name.
    """

    begin_s: float
    image: dict[str, int]
    changed_s: float = -math.inf
    verified: set[str] = field(default_factory=set)
    outputs: dict[str, list[tuple[Floats, Integers]]] = field(default_factory=dict)

    @property
    def period_s(self) -> float:
        """Nominal period of the sample update in s; NaN if SMPL_PRD is not known."""
        code = self.image.get("SMPL_PRD", 0) & 0xFF
        return settings.sample_period_s(code) if code else math.nan

    @property
    def m(self) -> int | None:
        """Filter setting M; None if SENS_AVG is not known."""
        word = self.image.get("SENS_AVG")
        return None if word is None else word & 7

    def settings(self, *names: str) -> tuple[int | None, ...]:
        """Return the bits of some registers that affect readings; None for a register that is not known."""
        return tuple(
            self.image[name] & READING_BITS.get(name, -1) if name in self.image else None for name in names
        )

    def first(self, name: str) -> tuple[float, int] | None:
        """Return time (s) and number of the first word of the output register `name`.

        The result is None if the register was not read.
        """
        runs = self.outputs.get(name)
        return (float(runs[0][0][0]), BY_NAME[name].number(int(runs[0][1][0]))) if runs else None

    def settled(self, name: str) -> tuple[Floats, Floats]:
        """Return times (n,) in s and numbers (n,) of the updates of output register `name` after settling.

        A number is the decoded content of a word. Both are empty if the register was not read or the
        settings are not known.
        """
        runs = self.outputs.get(name)
        if not runs or self.m is None or math.isnan(self.period_s):
            return np.empty(0), np.empty(0)
        times, words = (np.concatenate(part) for part in zip(*runs, strict=True))
        settled_s = self.changed_s + (settings.filter_settling_samples(self.m) + 2) * self.period_s
        new = (words & ND).astype(bool)
        used = (times > settled_s) & (new | (not new.any()))
        raw = words[used, None].astype(np.uint16)
        return times[used], settings.decode_numbers((BY_NAME[name],), raw)[:, 0].astype(float)


@dataclass(frozen=True)
class RestStatistics:
    """Means and standard deviations of accelerometers and gyros at rest, in a span without changes.

    Attributes
    ----------
    span : RegisterSpan
        The span.
    mean, rms : (6,) float
        Mean and standard deviation of each axis in LSB of the outputs; NaN for gyros that were not read.
    slope : (6,) float
        Change of each axis in LSB/s.
    middle_s : float
        Mean time of the updates in s.
    count : int
        Number of sample updates.
    dps : int
        Range of the gyros in °/s.
    """

    span: RegisterSpan
    mean: Floats
    rms: Floats
    slope: Floats
    middle_s: float
    count: int
    dps: int


class RecordedChip:
    """The history of a chip's registers, by the calls of a recording.

    Parameters
    ----------
    calls : iterable of Call
        Calls of a `BusRecording` or a `LogicCapture`.
    edge_rises : bool or None
        Edge of data-ready that starts a scan of a stream; None if it is not known.

    Attributes
    ----------
    reads : list of (Register, int)
        Words read from control registers.
    spans : list of RegisterSpan
        Times between two changes of the registers, in order.
    after_writes : list of (frame, content, reply before, reply)
        For each write: frame, content after it, reply to the frame before, and reply to the write.
    waits : dict of str to list of (float, bool)
        By command: times in s after the command at which the chip was seen ready (True) or not.
    nulls : list of (int, str)
        Index of the span after each autonull, and its command.
    edges : list of (k, n) int64
        Words of k scans that read one register n times, each started at the first edge of the data-ready
        pulse.
    """

    def __init__(self, calls: Iterable[Call], edge_rises: bool | None = None) -> None:
        self.reads: list[tuple[Register, int]] = []
        self.after_writes: list[tuple[int, int, int, int]] = []
        self.waits: dict[str, list[tuple[float, bool]]] = {}
        self.nulls: list[tuple[int, str]] = []
        self.edges: list[Integers] = []
        # Contents by name as far as they are known, and names of the registers read since they changed.
        self._contents: dict[str, int] = {}
        self._verified: set[str] = set()
        self.spans = [RegisterSpan(-math.inf, {})]
        self._edge_rises = edge_rises
        self._listed: list[Register | None] = []
        self._pending: tuple[str, float] | None = None
        self._unsure: list[tuple[Floats, Integers, Integers]] = []
        self._testing: float | None = None
        self._follow(calls)

    @cached_property
    def rests(self) -> list[RestStatistics]:
        """Statistics of the spans with at least 16 updates of the accelerometers.

        Gyros that were not read have NaN.
        """
        found = []
        for span in self.spans:
            columns = [span.settled(name) for name in (*ACCEL_OUT, *GYRO_OUT)]
            count = min(len(values) for _, values in columns[:3])
            if count < 16 or span.m is None:
                continue
            mean, rms, slope = np.full((3, 6), math.nan)
            for k, (at, values) in enumerate(columns):
                if len(values) >= 16:
                    mean[k], rms[k], at = values.mean(), values.std(ddof=1), at - at.mean()
                    slope[k] = at @ values / (at @ at)
            dps = settings.Configuration.from_words(1, span.image["SENS_AVG"], 0).gyro_range_dps or 300
            found.append(RestStatistics(span, mean, rms, slope, float(columns[0][0].mean()), count, dps))
        return found

    # -- calls --------------------------------------------------------------------------------------------

    def _follow(self, calls: Iterable[Call]) -> None:
        for call in _in_batches(calls):
            if call.name in ("exchange", "frame") and call.frames is not None:
                if call.result is None:
                    self._contents.clear()
                    continue
                times, words = call.read_words()
                self._batch(times, call.frames.astype(np.int64), words)
            elif call.name == "hard_reset":
                self._command("reset", call.begin_s)
            elif call.name == "stream" and call.frames is not None:
                self._listed = [addressed(int(frame))[0] for frame in call.frames]
            elif call.name == "block" and isinstance(call.result, FrameBlock) and not self._pending:
                self._block(call.result)

    def _block(self, block: FrameBlock) -> None:
        words = block.words.astype(np.int64)
        names = [row.name for row in self._listed if row is not None]
        span = self.spans[-1]
        if len(names) != words.shape[1] or not len(words):
            return
        if len(set(names)) == 1 and len(names) > 3:
            rises = bool(_MISC.field("polarity").of(span.image.get("MSC_CTRL", 0)))
            if self._edge_rises == rises:
                self.edges.append(words[1:])
            return
        for k, name in enumerate(names):
            if BY_NAME[name].flags:
                span.outputs.setdefault(name, []).append((block.time_s, words[:, k]))

    # -- frames -------------------------------------------------------------------------------------------

    def _batch(self, times: Floats, frames: Integers, words: Integers) -> None:
        if self._pending is not None:
            ready = _is_ready(frames, words)
            if ready is None:
                self._unsure.append((times, frames, words))
                return
            command, since_s = self._pending
            self.waits.setdefault(command, []).append((float(times[0]) - since_s, ready))
            earlier, self._unsure = self._unsure, []
            if not ready:
                return
            self._pending = None
            for one in earlier:
                self._batch(*one)
        begin = 0
        for at in np.flatnonzero(frames & WRITE):
            self._reads(times[begin:at], frames[begin:at], words[begin:at])
            reply = int(words[at])
            self._write(int(frames[at]), float(times[at]), int(words[at - 1]) if at else -1, reply)
            begin = int(at) + 1
            if self._pending is not None:
                return
        self._reads(times[begin:], frames[begin:], words[begin:])

    def _reads(self, times: Floats, frames: Integers, words: Integers) -> None:
        known = words >= 0
        times, frames, words = times[known], frames[known], words[known]
        slots = frames >> 8 & 0x3E
        for slot in np.unique(slots):
            row = BY_ADDRESS.get(int(slot))
            chosen = slots == slot
            if row is None or not row.readable:
                continue
            if row.flags:
                self.spans[-1].outputs.setdefault(row.name, []).append((times[chosen], words[chosen]))
            else:
                for time_s, word in dict(zip(times[chosen], words[chosen], strict=True)).items():
                    self._control(row, int(word), float(time_s))

    def _control(self, row: Register, word: int, time_s: float) -> None:
        if not row.writable or row.name in ("SLP_CNT", "GPIO_CTRL"):
            return  # it also changes without a write
        if row is _MISC and self._testing is not None:
            ready = not word & SELF_TEST
            self.waits.setdefault("self_test", []).append((time_s - self._testing, ready))
            self._testing = None if ready else self._testing
        self.reads.append((row, word))
        held = word & row.write_mask
        self._contents[row.name] = held
        self._verified.add(row.name)
        if self.spans[-1].image.setdefault(row.name, held) != held:
            self._new_span(time_s)
        self.spans[-1].verified.add(row.name)

    # -- changes ------------------------------------------------------------------------------------------

    def _write(self, frame: int, time_s: float, reply_before: int, reply: int) -> None:
        (row, high), byte = addressed(frame), frame & 0xFF
        if row is None or not row.writable:
            return
        if row is _COMMAND:
            if not high:
                for name in started_commands(byte)[:1]:
                    self._command(name, time_s)
            return
        shift = 8 if high else 0
        mask = row.write_mask & 0xFF << shift
        old = self._contents.get(row.name)
        if row is _MISC and shift and byte << 8 & SELF_TEST:
            self._testing = time_s
        self._verified.discard(row.name)
        if old is not None:  # otherwise the content is known when it is read
            word = old & ~mask & row.write_mask | byte << shift & mask
            self._contents[row.name] = word
            if reply >= 0:
                self.after_writes.append((frame, word, reply_before, reply))
        self._new_span(time_s)

    def _command(self, name: str, time_s: float) -> None:
        nulled = GYRO_OFF if "null" in name else ()
        lost = {"reset": [*self._contents], "restore": [*GYRO_OFF, *ACCEL_OFF]}.get(name, nulled)
        for key in lost:  # they are known again when they are read
            self._contents.pop(key, None)
        self._pending = name, time_s
        self._testing = None
        self._new_span(time_s)
        if "null" in name:
            self.nulls.append((len(self.spans) - 1, name))

    def _new_span(self, time_s: float) -> None:
        before = self.spans[-1]
        span = RegisterSpan(time_s, dict(self._contents), time_s, self._verified & self._contents.keys())
        if self._pending is None and span.settings(*READING_BITS) == before.settings(*READING_BITS):
            span.changed_s = before.changed_s
        self.spans.append(span)


def _is_ready(frames: Integers, words: Integers) -> bool | None:
    """Return True if the replies of a batch show that the chip answers, False if they show the opposite.

    Returns None if they show neither. `words` are the replies to `frames`, −1 if not known. SENS_AVG and
    SMPL_PRD are never zero, and different registers do not all have one content.
    """
    got = words[words >= 0]
    telling = [
        legal(BY_ADDRESS[slot], int(word) & BY_ADDRESS[slot].write_mask)
        for slot, word in zip((frames >> 8 & 0x3E).tolist(), words.tolist(), strict=True)
        if word >= 0 and slot in (BY_NAME["SENS_AVG"].address, BY_NAME["SMPL_PRD"].address)
    ]
    if not telling or np.any(frames & WRITE):
        return None
    return all(telling) and not (len(got) > 2 and np.all(got == got[0]))


def _in_batches(calls: Iterable[Call]) -> Iterator[Call]:
    """Yield the calls of a recording; successive single frames of a capture are joined to one call."""
    waiting: list[Call] = []

    def joined() -> Iterator[Call]:
        good = [call for call in waiting if call.error is None and call.frames is not None]
        if good:
            frames = np.array([int(call.frames[0]) for call in good if call.frames is not None], np.uint16)
            replies = np.array([int(call.result[0]) for call in good], np.uint16)
            yield Call(good[0].number, "frame", good[0].begin_s, good[-1].end_s, frames, (), replies)
        waiting.clear()

    for call in calls:
        # A pause of more than 2 ms separates batches.
        if waiting and (call.name != "frame" or call.begin_s - waiting[-1].end_s > 2e-3):
            yield from joined()
        if call.name == "frame":
            waiting.append(call)
        else:
            yield call
    yield from joined()
