"""What a bring-up says: figures, verdicts, answers, and the document that they make.

What is open about the ADIS16354: the rows of the table that a real part can settle.

Source and confidence come from the register table and the variants table where the row stands there.
`otherwise` says why the question stays open where no step answers it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np

from adis_gonio.base.jsonable import INLINE, JsonRecord, key
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.device.sensor.variants import VARIANTS

_PART = VARIANTS["adis16354"]
_FIGURES = _PART.performance


@dataclass(frozen=True)
class Question:
    """One row.

    Attributes
    ----------
    table : str
        What the table says.
    confidence : str
        A the data sheet of the sibling and code agree, B the sibling's sheet only, C derived or code
        only, D an estimate, ? nothing is known.
    otherwise : str
        Why it is not measured where no step answers it.
    """

    name: str
    text: str
    table: str
    source: str
    confidence: str
    otherwise: str = "the step that answers it was not done"

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "name": self.name,
            "question": self.text,
            "table": self.table,
            "source": self.source,
            "confidence": self.confidence,
        }


def _register(name: str, register: str, text: str, table: str, confidence: str = "") -> Question:
    row = BY_NAME[register]
    return Question(name, text, table, row.source, confidence or row.confidence)


_ESTIMATE = "estimate"

QUESTIONS: tuple[Question, ...] = (
    Question(
        "accel_lsb", "LSB of the accelerometers: 0.4672 or 0.467 mg?",
        f"{_PART.accel_mg_per_lsb} mg", _PART.source, _PART.confidence,
        "the two are 0.04 % apart; the gain error of a part (0.1 % and more) hides that whatever is done,"
        " and one pose also has the bias in it (10 mg are 1 %)",
    ),
    _register(
        "accel_offset_lsb", "XACCL_OFF", "LSB of XACCL_OFF, YACCL_OFF, ZACCL_OFF in LSB of the output?",
        "1",
    ),
    Question(
        "offset_after_filter", "Do the offsets act before or after the filter?",
        "not known (after, on later parts)", "later parts", "C",
    ),
    Question(
        "accel_noise", "Noise of the accelerometers, unfiltered, rms?",
        f"{_FIGURES.noise_mg} mg", _ESTIMATE, "D",
    ),
    Question(
        "gyro_noise", "Noise of the gyros, unfiltered, rms?",
        f"{_FIGURES.gyro_noise_dps} °/s", "DS", "B",
    ),
    Question(
        "accel_bias_scale", "Initial bias and gain error of the accelerometers?",
        f"{_FIGURES.initial_bias_mg:g} mg and {100 * _FIGURES.scale_error_typical:g} % (1 sigma)",
        _ESTIMATE, "D", "one pose has |a| only; calibrate with the plan 'poses'",
    ),
    Question(
        "accel_alignment", "Angle between the axes?", f"within {_FIGURES.non_orthogonality_deg}°",
        "DS", "B",
        "needs several poses; calibrate with the plan 'poses'",
    ),
    Question(
        "accel_stability", "Bias instability of the accelerometers?",
        f"{_FIGURES.bias_instability_mg} mg", _ESTIMATE, "D",
        "needs hours at rest; record them with adis-gonio stream",
    ),
    Question(
        "accel_temperature", "Temperature coefficients of bias and gain?",
        f"{_FIGURES.bias_tempco_mg_per_c} mg/°C, {_FIGURES.scale_tempco_ppm_per_c:g} ppm/°C",
        _ESTIMATE, "D",
        "needs a chamber, or a warm-up that is recorded",
    ),
    Question(
        "accel_nonlinearity", "Nonlinearity of the accelerometers?", "within 0.2 % of the range", "DS", "B",
        "needs many poses; adis-gonio trace of such a session",
    ),
    _register("filter_gain", "SENS_AVG", "Noise gain of the filter steps M?", "two boxcars of 2^M taps"),
    _register(
        "sample_period", "SMPL_PRD", "Period of the internal update?", "0.61035 or 18.921 ms × (N + 1)"
    ),
    Question(
        "data_ready_edge", "Which edge of the data-ready pulse follows the update?", "the first",
        "inferred", "C",
    ),
    Question("data_ready_pulse", "Width of the data-ready pulse?", "not given", "–", "?"),
    _register(
        "self_test_gyro", "MSC_CTRL", "Do the gyros answer to both signs of the manual self-test?",
        "yes", "B",
    ),
    _register(
        "self_test_accel", "MSC_CTRL", "Do the accelerometers answer to the positive sign only?", "yes", "B"
    ),
    _register(
        "over_range_falls", "STATUS", "Does STATUS's over-range bit fall by itself?", "yes (DS, p. 20)"
    ),
    _register(
        "alarm_stays", "STATUS", "Does an alarm's bit stay until STATUS is read?", "yes (DS, p. 20)", "B"
    ),
    Question("over_range_threshold", "Threshold of over-range?", "not given", "–", "?"),
    _register("flash_count", "ENDURANCE", "Does ENDURANCE count a flash update by one?", "yes"),
    Question(
        "autonull_duration", "Duration of the autonull?", "not given", "–", "?",
        "an autonull overwrites the gyros' offsets in flash, which cannot be undone without more writes",
    ),
    Question(
        "reset_recovery", "Recovery from a reset?", "not given; taken as a start-up, 0.15 s", "DS", "B",
        "to find its end something must be asked too early, and traffic during a reset can leave a part"
        " without answers",
    ),
    Question(
        "illegal_settings", "What do illegal SENS_AVG and SMPL_PRD = 0 do?", "not given", "–", "?",
        "nothing illegal is ever written",
    ),
)  # fmt: skip


FORMAT = "adis-gonio bringup 1"
Number = TypeVar("Number", float, float | None)


class Verdict(StrEnum):
    """What a step found."""

    OK = "ok"
    FAULT = "fault"
    """The board does what no sound board does."""
    DIFFERS = "differs"
    """The board works and contradicts a row of the table: the table or the part is other than thought."""
    NOT_MEASURED = "not measured"


class Outcome(StrEnum):
    """What was found about a row of the table."""

    CONFIRMS = "confirms"
    CONTRADICTS = "contradicts"
    MEASURED = "measured"
    """The table has no value: here is one."""
    NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Measured(JsonRecord):
    """A figure with its standard uncertainty.

    Attributes
    ----------
    u : float or None
        None where the figure is a count or a setting.
    expected : float or None
        What table or configuration say.
    """

    document_keys = ("name", "value", "u", "unit", "expected")

    name: str
    value: float
    unit: str = "1"
    u: float | None = None
    expected: float | None = None


@dataclass(frozen=True)
class Answer(JsonRecord):
    """What was measured of one question about the part; `text` is one sentence."""

    outcome: Outcome
    text: str
    figures: tuple[Measured, ...] = field(default=(), metadata=key("measured"))


@dataclass(frozen=True)
class Curve:
    """A series to draw: x and y with their labels, and what is expected where there is such."""

    name: str
    x_label: str
    y_label: str
    x: Sequence[float]
    y: Mapping[str, Sequence[float]]
    caption: str
    log: bool = False


@dataclass(frozen=True)
class StepResult(JsonRecord):
    """Result of a step: a verdict, one sentence that says it, figures, answers to open questions."""

    document_keys = ("verdict", "text", "figures")

    verdict: Verdict
    text: str
    figures: tuple[Measured, ...] = ()
    answers: Mapping[str, Answer] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()


def _plain(number: Number) -> Number:
    return number.item() if isinstance(number, np.generic) else number


class Findings:
    """Figures, answers and curves of a step as they come, and the result that they make with a verdict."""

    def __init__(self) -> None:
        self.figures: list[Measured] = []
        self.answers: dict[str, Answer] = {}
        self.curves: tuple[Curve, ...] = ()

    def measure(
        self,
        name: str,
        value: float,
        unit: str = "1",
        u: float | None = None,
        expected: float | None = None,
    ) -> Measured:
        """Add a figure; numbers of numpy become Python's."""
        figure = Measured(name, _plain(value), unit, _plain(u), _plain(expected))
        self.figures.append(figure)
        return figure

    def answer(self, question: str, outcome: Outcome, text: str, *figures: Measured) -> None:
        """Answer a question about the part."""
        self.answers[question] = Answer(outcome, text, figures)

    def settle(self, question: str, text: str, *, differs: bool) -> StepResult:
        """Result of a step that answers one question, with all its figures and one sentence."""
        self.answer(question, Outcome.CONTRADICTS if differs else Outcome.CONFIRMS, text, *self.figures)
        return self.differs(text) if differs else self.ok(text)

    def contradictions(self) -> str:
        """Texts of the answers that contradict the table; empty without one."""
        answers = self.answers.values()
        return "; ".join(one.text for one in answers if one.outcome is Outcome.CONTRADICTS)

    def ok(self, text: str) -> StepResult:
        """Result of a step that found nothing wrong."""
        return self._result(Verdict.OK, text)

    def fault(self, text: str) -> StepResult:
        """Result of a step that found a fault of the board."""
        return self._result(Verdict.FAULT, text)

    def differs(self, text: str) -> StepResult:
        """Result of a step that contradicts the table."""
        return self._result(Verdict.DIFFERS, text)

    def _result(self, verdict: Verdict, text: str) -> StepResult:
        return StepResult(verdict, text, tuple(self.figures), self.answers, self.curves)


@dataclass(frozen=True)
class Row(JsonRecord):
    """A step with its result, as it stands in the document."""

    name: str
    does: str
    effect: str
    result: StepResult = field(metadata=INLINE)


@dataclass(frozen=True)
class Bringup:
    """The whole bring-up.

    Attributes
    ----------
    rows : tuple of Row
        One a step, in order.
    answers : mapping of str to Answer
        One for each question of `adis_gonio.bench.bringup.result`.
    undone : str
        What became of the registers that were written.
    undone_ok : bool
        True where every register was read back as it was found.
    stopped : bool
        True where the operator ended it early.
    """

    url: str
    variant: str
    begun_utc: str
    software: str
    bridge: Mapping[str, Any]
    registers: Mapping[str, int]
    rows: tuple[Row, ...]
    answers: Mapping[str, Answer]
    undone: str
    undone_ok: bool
    comparisons: int
    false_alarm: float
    stopped: bool = False

    def row(self, name: str) -> StepResult:
        """Result of a step by its name."""
        return next(row.result for row in self.rows if row.name == name)

    @property
    def accused(self) -> tuple[str, ...]:
        """Names of the steps that found a fault or a difference."""
        return tuple(
            row.name for row in self.rows if row.result.verdict in (Verdict.FAULT, Verdict.DIFFERS)
        )

    @property
    def sound(self) -> bool:
        """True where no step found a fault and everything was undone."""
        return self.undone_ok and all(row.result.verdict is not Verdict.FAULT for row in self.rows)

    @property
    def simulated(self) -> bool:
        """True for a simulated sensor."""
        return self.url.startswith("sim:")

    @property
    def headline(self) -> str:
        """The whole in one sentence."""
        faults = [row.name for row in self.rows if row.result.verdict is Verdict.FAULT]
        differs = [row.name for row in self.rows if row.result.verdict is Verdict.DIFFERS]
        left = sum(row.result.verdict is Verdict.NOT_MEASURED for row in self.rows)
        parts = [f"fault: {', '.join(faults)}" if faults else "no fault was found"]
        if differs:
            parts.append(f"differs from the table: {', '.join(differs)}")
        if left:
            parts.append(f"{left} of {len(self.rows)} steps were not measured")
        if not self.undone_ok:
            parts.append(self.undone)
        text = "; ".join(parts)
        return text[0].upper() + text[1:] + "."

    def as_dict(self) -> dict[str, Any]:
        """JSON document."""
        return {
            "format": FORMAT,
            "software": self.software,
            "begun_utc": self.begun_utc,
            "url": self.url,
            "simulated": self.simulated,
            "variant": self.variant,
            "bridge": dict(self.bridge),
            "registers": dict(self.registers),
            "sound": self.sound,
            "accused": self.accused,
            "headline": self.headline,
            "stopped": self.stopped,
            "undone": {"verified": self.undone_ok, "text": self.undone},
            "false_alarm": {"board": self.false_alarm, "comparisons": self.comparisons},
            "steps": [row.as_dict() for row in self.rows],
            "answers": [
                question.as_dict() | self.answers[question.name].as_dict() for question in QUESTIONS
            ],
        }
