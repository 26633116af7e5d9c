"""Hypotheses on rows of the register table, and the probabilities of the hypotheses after recordings.

Each row of `ROWS` has alternatives: the statement of the table, other possible statements, and "something
else". An observation is either a label (the alternative with which one event agrees) or a `RowFigure` (a
number for which each alternative predicts an interval). The prior probability of the table's statement
follows from its confidence. Observations multiply:

* labels: if an alternative is true, each event has its label, except one in 10 000 (a bit error). If
  something else is true, the events have unknown probabilities with a Dirichlet prior, so that a chip that
  does one thing each time is more probable than one that changes.
* figures: if an alternative is true, a figure is uniform in the interval that it predicts, with a normal
  error. One figure in 10 000 may be anything. If something else is true, an unknown share of the figures
  agrees with the table, and the others are uniform over the row's range.

`RecordedChip` follows the chip's registers through the frames of a recording or a capture: it keeps the
contents that the register table predicts after each write and command, and the replies that show a rule.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, log_sum_exp
from adis_gonio.base.jsonable import INLINE, JsonRecord
from adis_gonio.bench.bringup.bringup_step import QUESTIONS, Measured, Outcome, Question
from adis_gonio.bench.bringup.link_steps import legal
from adis_gonio.device.bus import FrameBlock
from adis_gonio.device.bus.capture import LogicCapture
from adis_gonio.device.bus.recording import BusRecording, Call
from adis_gonio.device.sensor import settings
from adis_gonio.device.sensor.frame_log import BUSY_S, started_commands
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_ADDRESS,
    BY_NAME,
    GYRO_LSB_DPS,
    GYRO_OFF,
    GYRO_OUT,
    ND,
    READING_BITS,
    WRITE,
    Kind,
    Register,
    Variant,
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
                if call.result is None:  # the frames may have reached the chip
                    self._new_span(call.begin_s, lost=self.spans[-1].image)
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
        if self.spans[-1].image.setdefault(row.name, held) != held:
            self._new_span(time_s, {row.name: held})
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
        old = self.spans[-1].image.get(row.name)
        if row is _MISC and shift and byte << 8 & SELF_TEST:
            self._testing = time_s
        changed = {}
        if old is not None:  # otherwise the content is known when it is read
            word = old & ~mask & row.write_mask | byte << shift & mask
            changed[row.name] = word
            if reply >= 0:
                self.after_writes.append((frame, word, reply_before, reply))
        self._new_span(time_s, changed)

    def _command(self, name: str, time_s: float) -> None:
        nulled = GYRO_OFF if "null" in name else ()
        lost = {"reset": self.spans[-1].image, "restore": (*GYRO_OFF, *ACCEL_OFF)}.get(name, nulled)
        self._pending = name, time_s
        self._testing = None
        self._new_span(time_s, lost=lost)  # their contents are known again when they are read
        if "null" in name:
            self.nulls.append((len(self.spans) - 1, name))

    def _new_span(self, time_s: float, changed: Mapping[str, int] = {}, lost: Collection[str] = ()) -> None:
        """Begin a span at a time in s, with the new contents `changed` by name; `lost` are not known."""
        before = self.spans[-1]
        image = {name: word for name, word in before.image.items() if name not in lost} | dict(changed)
        span = RegisterSpan(time_s, image, time_s, before.verified & image.keys() - changed.keys())
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


ELSE = "something else"
PRIOR = {"A": 0.999, "B": 0.99, "C": 0.9, "D": 0.7}
"""Prior probability that a statement of the table is right, by its confidence."""
ODD_EVENT = 1e-4
"""Probability of an event or a figure that contradicts the alternative that is true."""
DECIDED = 0.01
"""Probability of the table's statement below which it is contradicted.

It is confirmed above one minus this probability.
"""
SELF_TEST_S = 0.035
"""Length of the self-test in s (DS, A)."""


@dataclass(frozen=True)
class RowFigure:
    """A measured number with the intervals that the alternatives predict for it.

    Attributes
    ----------
    x, u : float
        The number and its standard uncertainty.
    predicted : mapping of str to (float, float)
        Lower and upper limit of the number, by alternative.
    """

    x: float
    u: float
    predicted: Mapping[str, tuple[float, float]]


Observation = str | RowFigure
Observer = Callable[[RecordedChip, Variant], Iterable[Observation]]


@dataclass(frozen=True)
class ChipRow:
    """A row of the register table as hypotheses.

    Attributes
    ----------
    question : Question
        Statement of the table, its source and its confidence.
    observe : callable
        Yields the observations of a recorded chip.
    alternatives : tuple of str
        Names of the possible statements, as in the observations; the first is the statement of the table.
    wide : (float, float)
        Range of a figure if none of the alternatives is true.
    """

    question: Question
    observe: Observer
    alternatives: tuple[str, ...]
    wide: tuple[float, float]

    def judge(self, observed: Sequence[Observation]) -> RowFinding:
        """Compute the probabilities of the alternatives after the observations `observed`."""
        names = (*self.alternatives, ELSE)
        prior = PRIOR[self.question.confidence]
        priors = np.array([prior, *[(1 - prior) / len(self.alternatives)] * len(self.alternatives)])
        labels = Counter(one for one in observed if isinstance(one, str))
        figures = [one for one in observed if isinstance(one, RowFigure)]
        likelihood = _of_labels(names, labels)
        if figures:
            likelihood = likelihood + _of_figures(names, figures, self.wide)
        logs = np.log(priors) + likelihood
        # Evidence for the table against the best rival, and normalised probabilities.
        evidence = float(likelihood[0] - likelihood[1:].max()) / math.log(10)
        chances = dict(zip(names, np.exp(logs - log_sum_exp(logs)).tolist(), strict=True))
        outcome, table = Outcome.OPEN, chances[names[0]]
        if not observed:
            outcome = Outcome.NOT_MEASURED
        elif table < DECIDED:
            outcome = Outcome.CONTRADICTS
        elif table > 1 - DECIDED and evidence > 0:
            outcome = Outcome.CONFIRMS
        return RowFinding(
            replace(self.question, table=names[0]), outcome, max(chances, key=lambda name: chances[name]),
            len(observed), evidence, chances, _described(labels, figures),
            tuple(
                Measured(f"{self.question.name} {k}", float(figure.x), "1", figure.u)
                for k, figure in enumerate(figures, 1)
            ),
        )  # fmt: skip


def _described(labels: Counter[str], figures: Sequence[RowFigure]) -> str:
    parts = [f"{label}: {count}" for label, count in labels.most_common(3)]
    if figures:
        x = [figure.x for figure in figures]
        few = ", ".join(f"{one:.3g}" for one in x)
        parts.append(few if len(x) < 5 else f"{len(x)} figures {min(x):.3g} … {max(x):.3g}")
    return "; ".join(parts)


class RowFinding(JsonRecord):
    """Finding on one row of the register table.

    Attributes
    ----------
    question : Question
        Name of the row, its question, and the statement of the table with its source and confidence.
    outcome : Outcome
        Verdict on the statement of the table.
    best : str
        Most probable alternative.
    observations : int
        Number of observed events and figures.
    log10_evidence : float
        Decimal logarithm of the odds of the table's statement against the most probable other alternative
        by the recordings alone, without the table's prior probability.
    probabilities : dict of str to float
        Probability of each alternative after the recordings.
    seen : str
        Summary of the observations.
    measured : tuple of Measured
        The observed figures, in order.
    """

    question: Question = field(metadata=INLINE)
    outcome: Outcome
    best: str
    observations: int
    log10_evidence: float
    probabilities: dict[str, float]
    seen: str
    measured: tuple[Measured, ...] = ()

    @property
    def name(self) -> str:
        """Name of the row."""
        return self.question.name


def _of_labels(names: Sequence[str], labels: Counter[str]) -> Floats:
    """Return the log-likelihood (k,) of the observed labels under each of k alternatives.

    `labels` counts each label; `names` are the alternatives, "something else" last. The docstring of the
    module describes the model.
    """
    keys = [*names, *sorted(labels.keys() - {*names})]
    counts = np.array([labels[key] for key in keys], np.float64)
    total = float(counts.sum())
    named = [
        labels[name] * math.log(1 - ODD_EVENT) + (total - labels[name]) * math.log(ODD_EVENT / len(keys))
        for name in names[:-1]
    ]
    flat = sum(math.lgamma(n + 0.5) - math.lgamma(0.5) for n in counts)
    flat += math.lgamma(len(keys) / 2) - math.lgamma(len(keys) / 2 + total)
    return np.array([*named, flat], np.float64)


def _of_figures(names: Sequence[str], figures: Sequence[RowFigure], wide: tuple[float, float]) -> Floats:
    """Return the log-likelihood (k,) of the observed figures under each of k alternatives.

    `names` are the alternatives, "something else" last; `wide` is the range of a figure in that case. The
    docstring of the module describes the model.
    """
    flat = 1 / (wide[1] - wide[0])
    density = np.array([[_density(figure, name) for name in names[:-1]] for figure in figures])
    named = np.log((1 - ODD_EVENT) * density + ODD_EVENT * flat).sum(axis=0)
    # Something else: a share p of the figures, but not all, agree with the table; the others are flat.
    p = (np.arange(100) + 0.5)[:, None] / 100
    table = np.maximum(density[:, 0], 1e-300)
    some = np.log(p * table + (1 - p) * flat).sum(axis=1)
    every = np.log(p * table).sum(axis=1)
    logs = some + np.log(-np.expm1(every - some))
    other = float(log_sum_exp(logs)) - math.log(len(logs))
    return np.array([*named, other])


def _density(figure: RowFigure, name: str) -> float:
    """Return the probability density of a figure under the alternative `name`.

    The true number is uniform in the predicted interval, and the error is normal.
    """
    low, high = figure.predicted[name]
    z = np.array([figure.x - low, figure.x - high]) / figure.u
    if high - low < figure.u:
        return math.exp(-0.5 * float(z.mean()) ** 2) / figure.u / math.sqrt(2 * math.pi)
    below, above = (0.5 * math.erfc(-one / math.sqrt(2)) for one in z.tolist())
    return (below - above) / (high - low)


# -- observers --------------------------------------------------------------------------------------------


def _replies_to_writes(chip: RecordedChip, _: Variant) -> Iterator[str]:
    for frame, content, before, reply in chip.after_writes:
        candidates = {"zeros": 0, "the frame": frame, "the content": content, "the reply before": before}
        hits = [name for name, word in candidates.items() if word == reply]
        if len({*candidates.values()}) == len(candidates) or len(hits) == 1:
            yield hits[0] if hits else ELSE


def _reserved_bits(chip: RecordedChip, _: Variant) -> Iterator[str]:
    # Each content of a register counts once.
    for row, word in {read for read in chip.reads if read[0].kind is Kind.FIELDS}:
        unused, extra = ~row.write_mask & 0xFFFF, word & ~row.write_mask
        if unused:
            yield "zeros" if not extra else "ones" if extra == unused else ELSE


def _upper_bits(chip: RecordedChip, _: Variant) -> Iterator[str]:
    for row, word in {read for read in chip.reads if read[0].signed}:
        extra, upper = word & ~row.data_mask & 0xFFFF, ~row.data_mask & 0xFFFF
        negative = word >> (row.bits - 1) & 1
        if negative or extra:
            yield "zeros" if not extra else ELSE if extra != upper else "the sign" if negative else "ones"


def _waits(command: str) -> Observer:
    def observe(chip: RecordedChip, _: Variant) -> Iterator[str]:
        table_s = BUSY_S.get(command, SELF_TEST_S)
        for after_s, ready in chip.waits.get(command, []):
            if ready:
                yield "in time" if after_s > 0.9 * table_s else "shorter"
            elif after_s > 1.1 * table_s:
                yield "longer"

    return observe


def _mean_u(part: Variant, rest: RestStatistics, columns: slice) -> float:
    """Return the standard uncertainty of the difference of two means of readings at rest, in LSB.

    It comes from noise, flicker and rounding. The noise is the measured noise in `rest` or the noise of the
    variant `part`, whichever is larger, because the bench may add noise. `columns` chooses accelerometers
    or gyros.
    """
    figures, gyros = part.performance, columns.start == 3
    lsb = part.lsb(Kind.GYRO if gyros else Kind.ACCEL, rest.dps)[0]
    white, floor = figures.noise[columns.start] / lsb, figures.floor[columns.start] / lsb
    noise = max(white**2, float(np.mean(rest.rms[columns] ** 2)))
    return math.sqrt(2 * noise / rest.count + 4 * floor**2 + 1 / 6)


def _offset_steps(
    outputs: Sequence[str], offsets: Sequence[str], columns: slice, rivals: Mapping[str, float]
) -> Callable[[RecordedChip, Variant], Iterable[RowFigure]]:
    """Return a function that yields each change of an output divided by the change of its offset register.

    The function takes a recorded chip and its variant. `outputs` and `offsets` name the registers,
    `columns` chooses their axes, and `rivals` has the ratio that each alternative predicts.
    """

    def observe(chip: RecordedChip, part: Variant) -> Iterator[RowFigure]:
        for one, two in pairwise(chip.rests):
            if one.span.settings("SENS_AVG", "MSC_CTRL") != two.span.settings("SENS_AVG", "MSC_CTRL"):
                continue
            for k, name in enumerate(offsets):
                then, now = one.span.image.get(name), two.span.image.get(name)
                if then is None or now is None or name not in one.span.verified & two.span.verified:
                    continue
                row = BY_NAME[name]
                step = (row.number(now) - row.number(then)) / (one.dps / 75 if columns.start else 1)
                moved = two.mean[columns][k] - one.mean[columns][k]
                short, long = sorted((one, two), key=lambda rest: rest.count)
                # A short rest shows only the slope of its noise.
                drift = (two.middle_s - one.middle_s) * float(long.slope[columns][k])
                u = math.hypot(_mean_u(part, short, columns), drift)
                if abs(step) > 10 * u and math.isfinite(moved):
                    predicted = {key: (value - 0.01, value + 0.01) for key, value in rivals.items()}
                    yield RowFigure(moved / step, u / abs(step), predicted)

    return observe


def _after_filter(chip: RecordedChip, part: Variant) -> Iterator[RowFigure]:
    """Yield the share of an offset's step that the first output word after the write shows.

    The share is corrected for the part of the step that would already have passed through the filter. It is
    1 if the offset acts after the filter, and 0 if it acts before.
    """
    ratio = float(np.median([figure.x for figure in _accel_steps(chip, part)] or [1.0]))
    unknown = RegisterSpan(-math.inf, {})
    level: dict[str, tuple[RegisterSpan, float, float]] = {}
    for span in chip.spans:
        for name, out in zip(ACCEL_OFF, ACCEL_OUT, strict=True):
            first, (before, mean, sigma) = span.first(out), level.get(out, (unknown, 0.0, 0.0))
            _, numbers = span.settled(out)
            if len(numbers) >= 8:
                level[out] = span, float(numbers.mean()), float(numbers.std())
            alike = span.settings("SENS_AVG", "MSC_CTRL") == before.settings("SENS_AVG", "MSC_CTRL")
            if first is None or not alike or name not in before.image.keys() & span.image.keys():
                continue
            changed = BY_NAME[name].number(span.image[name]) - BY_NAME[name].number(before.image[name])
            passed = (first[0] - span.begin_s) / span.period_s
            taps = 1 << (span.m or 0)
            ramp = min(passed, taps) ** 2 / 2 / taps**2
            # One update has to pass before the offset can act.
            if abs(changed) > 500 and ramp < 0.4 and passed > 1:
                share = (first[1] - mean) / (changed * ratio)
                predicted = {"after": (0.9, 1.1), "before": (-0.1, 0.1)}
                yield RowFigure((share - ramp) / (1 - ramp), 0.05 + sigma / abs(changed), predicted)


def _edge(chip: RecordedChip, _: Variant) -> Iterator[str]:
    for words in chip.edges:
        flags = (words & ND).astype(bool)
        if np.all(flags.sum(axis=1) == 1):
            yield "the first" if np.median(np.argmax(flags, axis=1)) == 0 else "the second"


def _rounding(chip: RecordedChip, part: Variant) -> Iterator[RowFigure]:
    """Yield two figures for each gyro and each precision autonull, in LSB of the offset registers.

    The first figure is the remainder of the written offset after division by the LSB of the output. The
    second is the remaining rate, positive in the direction of the bias before the autonull. A recording is
    used only if its steps of the offsets show that these LSB are right.
    """
    steps = [figure.x for figure in _gyro_steps(chip, part)] or [1.0]
    nulls = [*chip.nulls, (len(chip.spans), "")] if abs(float(np.median(steps)) - 1) < 0.1 else []
    for (begin, command), (end, _) in pairwise(nulls):
        after = {id(span) for span in chip.spans[begin:end]}
        rests = [rest for rest in chip.rests if id(rest.span) in after and rest.count > 2000]
        for name, mean in zip(GYRO_OFF, rests[0].mean[3:] if rests else [], strict=False):
            number = BY_NAME[name].number(rests[0].span.image.get(name, 0))
            if command != "precision_autonull" or not number or math.isnan(mean):
                continue
            lsb_dps, scale = GYRO_LSB_DPS[75], rests[0].dps / 75  # LSB of the output in LSB of the offset
            any_rest, one_rest = (-0.5, scale - 0.5), (-0.5, 0.5)
            lattice = dict.fromkeys(_ROUNDINGS, any_rest) | {"truncated to the output's LSB": one_rest}
            yield RowFigure(number % scale, 0.01, lattice)
            # White noise of the mean after the autonull, and flicker between this mean and the autonull.
            white, floor = part.performance.noise[3], part.performance.floor[3]
            moves = _flicker_moves(rests[0].count * rests[0].span.period_s, BUSY_S[command])
            u = math.sqrt(white**2 / rests[0].count + moves * floor**2) / lsb_dps
            predicted = dict(zip(_ROUNDINGS, ((-0.5, 0.5), (0.0, 1.0), (0.0, scale)), strict=True))
            yield RowFigure(-math.copysign(scale, number) * float(mean), u, predicted)


def _flicker_moves(one_s: float, two_s: float) -> float:
    """Return the variance of the difference between two successive means of 1/f noise.

    It is divided by the Allan variance of the noise. The means are over `one_s` and `two_s` seconds, and
    the result is 2 if these are equal. It follows from the covariance −h ln|t| + constant of noise with the
    spectrum h/f, whose Allan variance is 2 h ln 2.
    """

    def twice_integrated_log(t: float) -> float:
        return t * t * (math.log(t) / 2 - 0.75)

    across = twice_integrated_log(one_s + two_s) - twice_integrated_log(one_s) - twice_integrated_log(two_s)
    within = 3 - math.log(one_s) - math.log(two_s)
    return (within + 2 * across / (one_s * two_s)) / (2 * math.log(2))


_ROUNDINGS = ("rounded", "truncated to its LSB", "truncated to the output's LSB")


# -- table ------------------------------------------------------------------------------------------------


def _entry(
    text: str, observe: Observer, *alternatives: str, wide: tuple[float, float] = (-10.0, 10.0)
) -> ChipRow:
    """Return a row of hypotheses on one question about the chip.

    `text` is the name of a question of the bring-up, or name, question, source and confidence separated by
    ` | `. `observe` yields the observations of a recorded chip, and `alternatives` are the possible
    statements, the statement of the table first. `wide` is the range of a figure if none is true.
    """
    name, *own = text.split(" | ")
    asked = {question.name: question for question in QUESTIONS}
    question = Question(name, own[0], alternatives[0], own[1], own[2], "") if own else asked[name]
    return ChipRow(question, observe, alternatives, wide)


_ACCELS, _GYROS = slice(0, 3), slice(3, 6)
_ACCEL_STEPS = {"1": 1.0, "−1": -1.0, "0": 0.0, "1/2": 0.5, "2": 2.0, "the sibling's": 5.398}
_GYRO_STEPS = {"1": 1.0, "−1": -1.0, "0": 0.0, "4": 4.0}
_accel_steps = _offset_steps(ACCEL_OUT, ACCEL_OFF, _ACCELS, _ACCEL_STEPS)
_gyro_steps = _offset_steps(GYRO_OUT, GYRO_OFF, _GYROS, _GYRO_STEPS)

# fmt: off
ROWS: tuple[ChipRow, ...] = (
    _entry("reply_to_write | Reply to a write? | estimate | D", _replies_to_writes,
           "zeros", "the frame", "the content", "the reply before"),
    _entry("reserved_bits | Reserved bits of control registers? | estimate | D", _reserved_bits,
           "zeros", "ones"),
    _entry("offset_upper_bits | Bits above the number of an offset? | estimate | D", _upper_bits,
           "zeros", "the sign", "ones"),
    _entry("reset_time | Recovery from a reset within 0.15 s? | DS, start-up | B", _waits("reset"),
           "in time", "longer", "shorter"),
    _entry("flash_time | Flash update within 0.1 s? | DS | B", _waits("flash_update"),
           "in time", "longer", "shorter"),
    _entry("self_test_time | Self-test within 35 ms? | DS | B", _waits("self_test"),
           "in time", "longer", "shorter"),
    _entry("precision_time | Precision autonull within 30 s? | DS | B", _waits("precision_autonull"),
           "in time", "longer", "shorter"),
    _entry("accel_offset_lsb", _accel_steps, *_ACCEL_STEPS),
    _entry("gyro_offset_lsb | LSB of the gyro offsets, in 0.018315 °/s? | DS | A", _gyro_steps,
           *_GYRO_STEPS),
    _entry("offset_after_filter", _after_filter, "after", "before"),
    _entry("autonull_rounding | Does an autonull round or truncate? | estimate | D", _rounding,
           *_ROUNDINGS, wide=(-50.0, 50.0)),
    _entry("data_ready_edge", _edge, "the first", "the second"),
)
# fmt: on
"""Rows of the table in the order of the report."""
BY_QUESTION = {row.question.name: row for row in ROWS}


def judge_recordings(paths: Iterable[str | Path], part: Variant) -> tuple[RowFinding, ...]:
    """Judge all rows of the register table by files of recordings or captures of one sensor variant.

    The files at `paths` are judged together; each counts as a separate power-on of a chip.

    Raises
    ------
    DataError
        A file cannot be read, or is neither a recording nor a capture.
    """
    chips = []
    for path in paths:
        capture = Path(path).suffix.lower() == ".vcd"
        source = LogicCapture(path) if capture else BusRecording(path)
        rises = None if isinstance(source, LogicCapture) else source.header["edge_rises"]
        chips.append(RecordedChip(source, rises))
    return tuple(row.judge([found for chip in chips for found in row.observe(chip, part)]) for row in ROWS)


def findings_text(findings: Sequence[RowFinding]) -> str:
    """Return a table of findings in 80 columns, contradicted rows first, with each row's observations."""
    lines = [f"{'row':20}{'the table says':18}{'recorded':18}{'evidence':>8}  verdict"]
    order = [Outcome.CONTRADICTS, Outcome.OPEN, Outcome.CONFIRMS]
    for one in sorted((f for f in findings if f.observations), key=lambda f: order.index(f.outcome)):
        size = abs(one.log10_evidence)
        odds = f"{10**size:.0f}" if size < 4 else f"1e{min(size, 99):.0f}"
        odds = f"{odds}:1" if one.log10_evidence >= 0 else f"1:{odds}"
        lines.append(f"{one.name:20}{one.question.table[:17]:18}{one.best[:17]:18}{odds:>8}  {one.outcome}")
        lines.append(f"  {one.question.text} {one.seen}"[:80])
    lines += ["", "evidence: odds of the table against its best rival, by the recordings alone"]
    idle = ", ".join(one.name for one in findings if not one.observations)
    return "\n".join(
        [*lines, *textwrap.wrap(f"not exercised: {idle or 'none'}", 80, subsequent_indent="  ")]
    )
