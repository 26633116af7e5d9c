"""What is open about the ADIS16354: the rows of the table that a real part can settle.

Source and confidence come from the register table and the variants table where the row stands there.
`otherwise` says why the question stays open where no step answers it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from adis_gonio.base.jsonable import HIDDEN, Record, key
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.device.sensor.variants import VARIANTS

_PART = VARIANTS["adis16354"]
_FIGURES = _PART.performance


@dataclass(frozen=True)
class Question(Record):
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
    text: str = field(metadata=key("question"))
    table: str
    source: str
    confidence: str
    otherwise: str = field(default="the step that answers it was not done", metadata=HIDDEN)


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
