"""Steps of a bring-up: base class, shared sensor and bus, results, and the document of all results.

Each limit is a quantile of the distribution of the compared figure on a good board: normal for means,
chi-square for variances, exponential for the bins of a periodogram. One comparison accuses a good board
with the probability `ALPHA`; a run makes less than 100 comparisons, so that a good board is accused less
often than once in 10 000, even if the comparisons depend on each other (Bonferroni). A fault that is not
random (a stuck line, a lost edge) has no limit: one occurrence is enough.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord, key
from adis_gonio.device.bus import SpiBus, SpiTiming, Words
from adis_gonio.device.bus.recording import Call, ObservedBus
from adis_gonio.device.sensor.driver import Adis16354, Undo
from adis_gonio.device.sensor.registers import IDLE, VARIANTS, Register, read_frames, register
from adis_gonio.device.sensor.settings import ScanBlock, join

_PART = VARIANTS["adis16354"]
_FIGURES = _PART.performance


class Question(JsonRecord):
    """An open question about the sensor: a property that is not certain, with its tabulated value.

    Attributes
    ----------
    name : str
        Name of the property.
    text : str
        The question as a sentence.
    table : str
        Value in the table of the sensor's properties.
    source : str
        Source of this value, such as `DS` (data sheet).
    confidence : str
        A: the data sheet of the sibling and code agree; B: the sibling's sheet only; C: derived or code
        only; D: an estimate; ?: nothing is known.
    otherwise : str
        Reason why the property is not measured, if no step answers the question.
    """

    document_keys = ("name", "text", "table", "source", "confidence")

    name: str
    text: str = field(metadata=key("question"))
    table: str
    source: str
    confidence: str
    otherwise: str


_LSB = f"{_PART.accel_mg_per_lsb} mg | {_PART.source} | {_PART.confidence}"
_LATER = "not known (after, on later parts)"
_PER_C = f"{_FIGURES.bias_tempco_mg_per_c} mg/°C, {_FIGURES.scale_tempco_ppm_per_c:g} ppm/°C"
_INITIAL = f"{_FIGURES.initial_bias_mg:g} mg and {100 * _FIGURES.scale_error_typical:g} % (1 sigma)"

_TABLE = f"""
accel_lsb | LSB of the accelerometers: 0.4672 or 0.467 mg? | {_LSB}
    the two are 0.04 % apart, less than the gain error of a part (0.1 % or more), which no measurement
    separates; in one pose the bias (10 mg are 1 %) adds to it
accel_offset_lsb | LSB of XACCL_OFF, YACCL_OFF, ZACCL_OFF in LSB of the output? | 1 | DS; LSB from code | C
offset_after_filter | Do the offsets act before or after the filter? | {_LATER} | later parts | C
accel_noise | Noise of the accelerometers, unfiltered, rms? | {_FIGURES.noise_mg} mg | estimate | D
gyro_noise | Noise of the gyros, unfiltered, rms? | {_FIGURES.gyro_noise_dps} °/s | DS | B
accel_bias_scale | Initial bias and gain error of the accelerometers? | {_INITIAL} | estimate | D
    one pose has |a| only; calibrate with the plan 'poses'
accel_alignment | Angle between the axes? | within {_FIGURES.non_orthogonality_deg}° | DS | B
    needs several poses; calibrate with the plan 'poses'
accel_stability | Bias instability of the accelerometers? | {_FIGURES.bias_instability_mg} mg | estimate | D
    needs hours at rest; record them with adis-gonio stream
accel_temperature | Temperature coefficients of bias and gain? | {_PER_C} | estimate | D
    needs a chamber, or a warm-up that is recorded
accel_nonlinearity | Nonlinearity of the accelerometers? | within 0.2 % of the range | DS | B
    needs many poses; adis-gonio trace of such a session
filter_gain | Noise gain of the filter steps M? | two boxcars of 2^M taps | DS | A
sample_period | Period of the internal update? | 0.61035 or 18.921 ms × (N + 1) | DS | A
data_ready_edge | Which edge of the data-ready pulse follows the update? | the first | inferred | C
data_ready_pulse | Width of the data-ready pulse? | not given | – | ?
    a bridge sees edges, not levels; an oscilloscope shows it
self_test_gyro | Do the gyros answer to both signs of the manual self-test? | yes | DS | B
self_test_accel | Do the accelerometers answer to the positive sign only? | yes | DS | B
over_range_falls | Does the over-range bit clear automatically? | yes (DS, p. 20) | DS | A
alarm_stays | Does an alarm's bit stay until STATUS is read? | yes (DS, p. 20) | DS | B
over_range_threshold | Threshold of over-range? | not given | – | ?
    the step 'status' crosses it, but does not search for it
flash_count | Does ENDURANCE count a flash update by one? | yes | DS | A
autonull_duration | Duration of the autonull? | not given | – | ?
    an autonull overwrites the gyros' offsets in flash, which cannot be undone without more writes
reset_recovery | Recovery from a reset? | not given; taken as a start-up, 0.15 s | DS | B
    to find its end, registers must be read too early, and traffic during a reset can leave a part
    without answers
illegal_settings | What do illegal SENS_AVG and SMPL_PRD = 0 do? | not given | – | ?
    nothing illegal is ever written
"""
"""A line for each question: name, question, value in the table, source and confidence. Indented lines give
the reason why no step answers it."""


def _parse(block: str) -> Question:
    line, *reason = block.splitlines()
    name, text, table, source, confidence = line.split(" | ")
    otherwise = " ".join(part.strip() for part in reason) or "the step that answers it was not done"
    return Question(name, text, table, source, confidence, otherwise)


QUESTIONS = tuple(_parse(block) for block in re.split(r"\n(?=\w)", _TABLE.strip()))
FORMAT = "adis-gonio bringup 1"
_COPIED = (
    *("software", "begun_utc", "url", "simulated", "variant", "bridge", "registers"),
    *("sound", "accused", "headline", "stopped"),
)


class Verdict(StrEnum):
    """Kinds of result of a bring-up step."""

    OK = "ok"
    FAULT = "fault"
    """The board has a defect."""
    DIFFERS = "differs"
    """The board works, but contradicts a value of the table."""
    NOT_MEASURED = "not measured"


class Outcome(StrEnum):
    """Kinds of answer to a question that the table of the sensor's properties leaves open."""

    CONFIRMS = "confirms"
    CONTRADICTS = "contradicts"
    OPEN = "open"
    """The observations do not decide between the table's value and another value."""
    NOT_MEASURED = "not measured"


class Measured(JsonRecord):
    """A measured figure with its standard uncertainty.

    Attributes
    ----------
    name : str
        Name of the figure.
    value : float
        Measured value.
    unit : str
        Unit of the value; "1" for a number without unit.
    u : float or None
        Standard uncertainty; None for a count or a setting.
    expected : float or None
        Value by the table or the configuration; None if there is none.
    """

    document_keys = ("name", "value", "u", "unit", "expected")

    name: str
    value: float
    unit: str = "1"
    u: float | None = None
    expected: float | None = None


class Answer(JsonRecord):
    """Answer to one open question about the sensor.

    Attributes
    ----------
    outcome : Outcome
        Kind of the answer.
    text : str
        The answer in one sentence.
    figures : tuple of Measured
        Figures on which the answer is based.
    """

    outcome: Outcome
    text: str
    figures: tuple[Measured, ...] = field(default=(), metadata=key("measured"))


class StepResult(JsonRecord, frozen=False):
    """Result of a bring-up step, which the step fills.

    Attributes
    ----------
    name, does : str
        Name of the step, and its description in one line.
    effect : str
        Kind of change that the step makes to the sensor, a `SideEffect`.
    verdict : Verdict
        Kind of the result.
    text : str
        The result in one sentence.
    figures : list of Measured
        Measured figures.
    answers : dict of str to Answer
        Answers to open questions, by the question's name.
    """

    document_keys = ("name", "does", "effect", "verdict", "text", "figures")

    name: str
    does: str
    effect: str
    verdict: Verdict = Verdict.NOT_MEASURED
    text: str = ""
    figures: list[Measured] = field(default_factory=list)
    answers: dict[str, Answer] = field(default_factory=dict)

    def measure(
        self,
        name: str,
        value: float,
        unit: str = "1",
        u: float | None = None,
        expected: float | None = None,
    ) -> None:
        """Add a measured figure with this name and value to the result.

        `unit` is "1" for a number without unit. `u` is the standard uncertainty (None for a count or a
        setting), `expected` the value by the table (None if there is none).
        """
        self.figures.append(Measured(name, value, unit, u, expected))

    def check(self, question: str, holds: object, text: str, *figures: Measured) -> None:
        """Record an answer to the open question named `question`.

        The answer confirms the table if `holds` is true, and contradicts the table otherwise. `text` is the
        answer in one sentence, `figures` are the figures on which it is based.
        """
        self.answers[question] = Answer(Outcome.CONFIRMS if holds else Outcome.CONTRADICTS, text, figures)

    def by_answers(self) -> Ending:
        """Return the ending of the step by its answers: a contradiction of the table is a difference.

        Raises
        ------
        NotMeasuredError
            No answer was measured.
        """
        wrong = [one.text for one in self.answers.values() if one.outcome is Outcome.CONTRADICTS]
        known = [one.text for one in self.answers.values() if one.outcome is not Outcome.NOT_MEASURED]
        if wrong:
            return Verdict.DIFFERS, "; ".join(wrong)
        if not known:
            raise NotMeasuredError("; ".join(one.text for one in self.answers.values()))
        return Verdict.OK, "; ".join(known)


Ending = tuple[Verdict, str]
"""End of a bring-up step: kind of its result, and the result in one sentence."""


class NotMeasuredError(Exception):
    """A bring-up step, or a part of it, could not measure; the text is the reason."""


@dataclass
class Bringup:
    """Result of a bring-up, which the run fills: results of the steps, and answers to open questions.

    Attributes
    ----------
    url, variant : str
        URL of the bus, and variant of the sensor.
    begun_utc, software : str
        Time of the beginning (ISO 8601, UTC), and the program.
    bridge : dict of str to object
        Facts about the bridge.
    registers : dict of str to int
        Words of the registers before the bring-up, by name; empty if they were not read.
    rows : list of StepResult
        Results of the steps, in order.
    answers : dict of str to Answer
        One answer for each open question about the sensor (`QUESTIONS`), by name.
    undo : Undo or None
        Restores the registers; None if no step changed the sensor.
    stopped : bool
        True if the operator ended it early.
    """

    url: str
    variant: str
    begun_utc: str
    software: str
    bridge: dict[str, Any] = field(default_factory=dict)
    registers: dict[str, int] = field(default_factory=dict)
    rows: list[StepResult] = field(default_factory=list)
    answers: dict[str, Answer] = field(
        default_factory=lambda: {q.name: Answer(Outcome.NOT_MEASURED, q.otherwise) for q in QUESTIONS}
    )
    undo: Undo | None = None
    stopped: bool = False

    @property
    def undone_ok(self) -> bool:
        """True if every register was read back with its original number."""
        return self.undo is None or not self.undo.unrestored

    @property
    def undone(self) -> str:
        """Sentence on the restored registers."""
        if self.undo is None:
            return "nothing was written"
        if self.undo.unrestored:
            return f"NOT put back: {', '.join(self.undo.unrestored)}; switch the supply off and on"
        return f"all {len(self.undo.rows)} registers were read back with their original numbers"

    def row(self, name: str) -> StepResult:
        """Return the result of a step by the step's name."""
        return next(row for row in self.rows if row.name == name)

    @property
    def accused(self) -> tuple[str, ...]:
        """Names of the steps that found a fault of the board or a difference from the table."""
        return tuple(row.name for row in self.rows if row.verdict in (Verdict.FAULT, Verdict.DIFFERS))

    @property
    def sound(self) -> bool:
        """True if no step found a fault and all registers were restored."""
        return self.undone_ok and all(row.verdict is not Verdict.FAULT for row in self.rows)

    @property
    def simulated(self) -> bool:
        """True if the sensor of the bring-up is simulated."""
        return self.url.startswith("sim:")

    @property
    def headline(self) -> str:
        """Result of the bring-up in one sentence."""
        faults = [row.name for row in self.rows if row.verdict is Verdict.FAULT]
        differs = [row.name for row in self.rows if row.verdict is Verdict.DIFFERS]
        left = sum(row.verdict is Verdict.NOT_MEASURED for row in self.rows)
        parts = [f"fault: {', '.join(faults)}" if faults else "no fault was found"]
        if differs:
            parts.append(f"differs from the table: {', '.join(differs)}")
        if left:
            parts.append(f"{left} of {len(self.rows)} steps not measured")
        if not self.undone_ok:
            parts.append(self.undone)
        text = "; ".join(parts)
        return text[0].upper() + text[1:] + "."

    def as_dict(self) -> dict[str, Any]:
        """Return the document that `adis-gonio bringup --json` prints."""
        answers = [question.as_dict() | self.answers[question.name].as_dict() for question in QUESTIONS]
        return {
            "format": FORMAT,
            **{name: getattr(self, name) for name in _COPIED},
            "undone": {"verified": self.undone_ok, "text": self.undone},
            "steps": [row.as_dict() for row in self.rows],
            "answers": answers,
        }


class BringupBus(ObservedBus):
    """A bus that forwards to another bus, limits the SPI clock, and records each call.

    A new value of `ceiling_hz` acts from the next `configure` on.

    Attributes
    ----------
    ceiling_hz : float
        Highest SPI clock in Hz.
    calls : list of Call
        Calls since the list was last cleared, in order.
    """

    def __init__(self, inner: SpiBus, ceiling_hz: float) -> None:
        self.calls: list[Call] = []
        super().__init__(inner, self.calls.append)
        self.ceiling_hz = ceiling_hz

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return super()._configure(replace(timing, clock_hz=min(timing.clock_hz, self.ceiling_hz)))


ALPHA = 1e-6
"""Probability that one comparison accuses a good board."""
Z = 4.9
"""Largest deviation of a good board from an expected value, in standard uncertainties: by `ALPHA`."""


def variance_ratio(dof: float) -> tuple[float, float]:
    """Return the lower and the upper limit of a measured variance divided by the expected variance.

    The measured variance has `dof` degrees of freedom.
    """
    from scipy.special import gammainccinv, gammaincinv

    tail, shape = ALPHA / 2, dof / 2
    return float(gammaincinv(shape, tail)) / shape, float(gammainccinv(shape, tail)) / shape


def highest_bin(bins: int) -> float:
    """Return the limit of the largest bin of a periodogram of white noise, divided by the bins' mean."""
    return math.log(bins / ALPHA)


HOST_CLOCK_U = 100e-6 / np.sqrt(3)
"""Relative standard uncertainty of a computer's clock: quartz, within 100 ppm."""
BOARD_CLOCK_U = 5e-3 / np.sqrt(3)
"""Relative standard uncertainty of a bridge's clock: a ceramic resonator, within 0.5 %."""
PART_CLOCK = 0.03
"""Largest relative error of the part's clock."""


LONGEST_S = 40.0
"""Largest time in s for scans with slow bridges and slow sample rates."""
FEWEST = 16
"""Smallest number of scans of a recording; they are read even if this takes longer than `LONGEST_S`."""


class SideEffect(StrEnum):
    """Kinds of change that a bring-up step makes to the sensor."""

    READS = "reads"
    LENDS = "lends data-ready"
    """The step enables data-ready while it runs, as a stream does, and restores MSC_CTRL."""
    WRITES = "writes, undone"
    FLASH = "flash write"


@dataclass(frozen=True)
class BringupStep:
    """One test of a bring-up, such as the link or the noise.

    Attributes
    ----------
    name : str
        Name of the step.
    run : callable
        Runs the step, adds figures and answers to the given result, and returns the end of the step; the
        `BringupBench` has the sensor and earlier findings. The first line of its docstring describes the
        step in the report. Raises `AdisGonioError` if the sensor or the bridge fails, and
        `NotMeasuredError` if the step cannot measure.
    effect : SideEffect
        Kind of change that the step makes to the sensor.
    question : str
        Question to the operator before a register is written; empty if the step writes none.
    settles : tuple of str
        Names of the questions about the sensor that the step answers.
    """

    name: str
    run: Callable[[BringupBench, StepResult], Ending]
    effect: SideEffect = SideEffect.READS
    question: str = ""
    settles: tuple[str, ...] = ()

    def new_result(self, text: str = "", verdict: Verdict = Verdict.NOT_MEASURED) -> StepResult:
        """Return the result of the step before it runs; `text` is the reason if it does not run."""
        does = str(self.run.__doc__).partition("\n")[0].removesuffix(".")
        return StepResult(self.name, does, self.effect, verdict, text)


@dataclass
class BringupBench:
    """Sensor and bus of one bring-up, and the findings that later steps need.

    Attributes
    ----------
    bus : BringupBus
        The bus, which limits its clock and keeps the calls of the present step.
    sensor : Adis16354
        The sensor.
    blocked : str
        Reason why no further step can measure; empty while steps can.
    clock : float
        Measured period of the sample update divided by its nominal period; 1 if unknown.
    clock_error : float
        Largest relative error of the part's clock that `clock` does not include.
    data_ready : bool
        True if edges of data-ready were seen to follow the updates.
    supply_ok : bool
        True if the supply voltage allows a flash update.
    constants : dict of str to int
        Words of the constant registers by name, as read by the step `link`; empty before it.
    """

    bus: BringupBus
    sensor: Adis16354
    blocked: str = ""
    clock: float = 1.0
    clock_error: float = PART_CLOCK
    data_ready: bool = False
    supply_ok: bool = True
    constants: dict[str, int] = field(default_factory=dict)

    def refresh(self) -> None:
        """Set the SPI clock to the fastest that the sensor's present mode and the bus's limit allow."""
        self.sensor._follow()

    # -- reading --------------------------------------------------------------------------------------

    def repeated(self, name: str | Register, count: int) -> tuple[Words, float]:
        """Read register `name` in consecutive frames; return the words (count,) and a frame's time in s.

        Returns fewer than `count` words if the bridge cannot run that many frames without a pause.
        """
        if self.bus.unbroken_frames is not None:
            count = min(count, self.bus.unbroken_frames - 1)
        frames = np.append(np.repeat(read_frames([register(name)]), count), np.uint16(IDLE))
        begin_s = self.bus.now_s()
        replies = self.bus.exchange_array(frames)
        took_s = (self.bus.now_s() - begin_s) / (count + 1)
        timed = self.bus.unbroken_frames is not None
        return replies[1:], self.bus.timing.frame_s if timed else took_s

    def scans(self, count: int, names: Sequence[str], *, gaps: bool = True) -> ScanBlock:
        """Read at most `count` scans of the registers `names`.

        Reading ends after `LONGEST_S`. The bridge streams if data-ready works, else it polls. If there are
        gaps, the longest run without a gap is returned if it has at least half of `count` scans and skips
        no updates at even times. Otherwise all scans are returned.

        Raises
        ------
        NotMeasuredError
            `gaps` is False, and no such run was found.
        """
        blocks: list[ScanBlock] = []
        have, begin_s = 0, self.bus.now_s()
        period_s, size = self.sensor.configuration().sample_period_s, min(count, 256)
        # Data-ready may be enabled, but not wired; polling does not need it.
        size = size if self.data_ready else max(4, min(size, round(0.5 / period_s)))
        ready = None if self.data_ready else False
        with self.sensor.stream(names, block_scans=size, data_ready=ready) as stream:
            for block in stream:
                blocks.append(block)
                have += len(block)
                late = self.bus.now_s() - begin_s > LONGEST_S
                if have >= count or (late and have >= FEWEST):
                    break
        scans = join(blocks)
        step_s = period_s * self.clock
        begin, end = longest_run(scans.time_s, step_s)
        # Polling at even times, but more slowly than the sensor samples, skips updates without a gap.
        slow = np.ptp(scans.time_s[begin:end]) > 1.02 * step_s * (end - begin)
        if end - begin < count // 2 or slow:
            if not gaps:
                raise NotMeasuredError("the scans have gaps on this bridge, so that they have no spectrum")
            return scans.first(count)
        cut = slice(begin, min(end, begin + count))
        words, times = scans.words[cut], scans.time_s[cut]
        return replace(scans, words=words, time_s=times, lost=0, missed=None)

    def means(self, count: int, names: Sequence[str]) -> Floats:
        """Return the means (k,) in LSB of the k output registers `names` over `count` scans."""
        return np.asarray(self.scans(count, names).numbers().mean(axis=0), np.float64)

    def sample_quickly(self) -> None:
        """Set the fastest sample rate, for steps that may write registers."""
        if self.sensor.read("SMPL_PRD") & 0xFF != 0x01:
            self.sensor.write("SMPL_PRD", 0x01)
            self.wait_updates()

    def wait_updates(self, count: int = 4) -> None:
        """Wait until the filter has settled and `count` more samples were taken."""
        now = self.sensor.configuration()
        self.bus.sleep_s(now.settling_s + count * now.sample_period_s)


def longest_run(times: Floats, step_s: float) -> tuple[int, int]:
    """Return begin and end (exclusive) of the longest run of times (n,) in s without a gap.

    A gap is a step of more than 1.5 times `step_s`.
    """
    ends = [0, *(np.flatnonzero(np.diff(times) > 1.5 * step_s) + 1), len(times)]
    return max(pairwise(ends), key=lambda run: run[1] - run[0])
