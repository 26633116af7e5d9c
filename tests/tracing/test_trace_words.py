"""Sentences and tables on results of a trace that are made by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace_result import ErrorFigures, Finding
from tracing.small_problems import turn

BEFORE = ErrorFigures(10.0, 12.0, 0.5, 40.0)
AFTER = ErrorFigures(0.5, 0.6, 0.02, 1.1)


def finding(effect: str, axes: str = "", p_value: float = 1e-9, probability: float = 0.999) -> Finding:
    return Finding(effect, tuple(axes), {}, p_value, 0.9, probability)


def result(**other: Any) -> Any:
    """Return the attributes of a result that the words use: nothing found, an adequate base model."""
    plain = {
        "found": (), "steps": (), "within": (), "unnamed": None, "adequate": True, "tested": True,
        "what_if": None, "stopped": None, "confounded": (), "reasons": {}, "detectable": {}, "advice": (),
        "before": BEFORE, "after": AFTER, "fits": (),
    }  # fmt: skip
    return SimpleNamespace(**plain | other)


def step(effect: str, error: ErrorFigures = AFTER) -> Any:
    return SimpleNamespace(effect=effect, error=error)


def has_word(text: str, name: str) -> bool:
    """Return whether a text has this name as a word."""
    return name in text.replace(",", " ").replace(".", " ").replace(";", " ").split()


BOTH = (finding("quadratic", "x"), finding("bias", "xy"))
STEPS = (step("bias"), step("quadratic"))


# -- the outcome -----------------------------------------------------------------------------------------


def test_the_outcome_counts_and_names_the_findings_in_the_order_of_the_model() -> None:
    text = words.headline(result(found=BOTH, steps=STEPS))
    assert text.startswith("Two effects")
    assert text.index("bias (x, y)") < text.index("quadratic (x)")
    assert words.headline(result(found=BOTH[:1], steps=STEPS[1:])).startswith("One effect")
    many = [f"effect_{k}" for k in range(7)]
    text = words.headline(result(found=tuple(map(finding, many)), steps=tuple(map(step, many))))
    assert text.startswith("7 effects")
    assert [one.effect for one in words.ordered(result(found=(finding("tone"), *BOTH), steps=STEPS))] == [
        "bias", "quadratic", "tone",
    ]  # fmt: skip


def test_a_step_that_is_no_finding_is_uncertain_unless_the_user_put_it_there() -> None:
    only = result(found=BOTH[1:], steps=STEPS)
    assert words.uncertain_steps(only) == ["quadratic"]
    assert "quadratic is not certain" in words.headline(only)
    two = result(found=(), steps=STEPS)
    assert "are not certain" in words.headline(two)
    asked = SimpleNamespace(forced=(SimpleNamespace(effect="quadratic"),))
    put = result(found=BOTH[1:], steps=STEPS, what_if=asked)
    assert words.uncertain_steps(put) == []
    assert words.headline(put).startswith("Two effects")


NOISE_UNKNOWN = SimpleNamespace(data=SimpleNamespace(noise_known=False))
NOISE_KNOWN = SimpleNamespace(data=SimpleNamespace(noise_known=True))
ONE_POSE = replace(BEFORE, heldout_by_axis={"x": 1.0})


@pytest.mark.parametrize(
    ("other", "said", "not_said"),
    [
        ({}, "No effect had to be added", "Found"),
        ({"adequate": False}, "no named effect explains the rest", "cannot decide"),
        ({"adequate": False, "confounded": (("bias", "cubic"),)}, "cannot decide", "no named effect"),
        ({"adequate": False, "reasons": {"cubic": "few angles"}}, "cannot decide", "no named effect"),
        ({"adequate": False, "tested": False}, "noise of a reading is unknown", "more positions"),
        ({"adequate": False, "tested": False, "fits": (NOISE_UNKNOWN,)}, "is unknown", "more positions"),
        ({"adequate": False, "tested": False, "fits": (NOISE_KNOWN,)}, "more positions", "is unknown"),
        ({"adequate": False, "before": ONE_POSE}, "One pose", "larger than the noise"),
        ({"adequate": False, "before": ONE_POSE, "fits": (NOISE_KNOWN,)}, "larger than", "One pose"),
        (
            {"adequate": False, "steps": STEPS, "after": replace(AFTER, residual_rms=0.0)},
            "no reading remains to test it",
            "larger than the noise",
        ),
        (
            {"found": BOTH, "steps": STEPS, "unnamed": SimpleNamespace(covariates=("time", "angle"))},
            "residual follows the time and the angle",
            "Not all",
        ),
        ({"adequate": False, "unnamed": SimpleNamespace(covariates=("time",))}, "Not all", "Found"),
    ],
)
def test_an_outcome_says_why_it_ends_there(other: dict, said: str, not_said: str) -> None:
    text = words.headline(result(**other))
    assert said in text
    assert not_said not in text


def test_a_finding_inside_the_dwells_alone_is_named_apart() -> None:
    tone, within = finding("tone", "x"), (SimpleNamespace(effect="tone", sentence="a line", p_value=1e-5),)
    both = result(found=(*BOTH, tone), steps=STEPS, within=within)
    assert words.inside_only(both) == [tone]
    first, inside = words.headline(both).split("Inside the dwells")
    assert has_word(inside, "tone")
    assert not has_word(first, "tone")
    assert first.startswith("Two effects")
    (line,) = words.within(both)
    assert line.startswith("A line (p")
    in_both = result(found=(*BOTH, tone), steps=(*STEPS, step("tone")), within=within)
    assert words.inside_only(in_both) == []


def test_a_time_limit_comes_first_and_only_checked_results_follow() -> None:
    for checked in (True, False):
        stopped = SimpleNamespace(sentence="The time is over.", checked=checked)
        text = words.headline(result(found=BOTH, steps=STEPS, stopped=stopped))
        assert text.startswith("The time is over.")
        assert ("quadratic" in text) is checked


@pytest.mark.parametrize(
    ("probability", "p_value", "grade"),
    [
        (0.999, 1e-3, 0), (0.9989, 1e-3, 1), (0.999, 1.1e-3, 1), (0.98, 1e-2, 1), (0.979, 1e-9, 2),
        (1.0, 0.011, 2), (0.9, 0.05, 2), (0.899, 0.0, 3), (1.0, 0.051, 3), (0.0, 1.0, 3),
    ],
)  # fmt: skip
def test_a_finding_is_as_sure_as_its_probability_and_its_p_value_both_allow(probability, p_value, grade):
    grades = ["as good as certain", "very likely", "likely", "the best of several explanations"]
    text = words.how_sure(finding("bias", p_value=p_value, probability=probability))
    assert text.split(":")[0] == grades[grade]


# -- what the session could have shown -------------------------------------------------------------------


def test_effects_that_were_not_found_are_grouped_by_what_the_session_could_have_shown() -> None:
    sizes = {"quadratic": 0.1, "cubic": 20.0, "asymmetry": 1e9, "cross_quadratic": 0.1, "bias": 1.0}
    units = {"quadratic": "k2_x", "cubic": "k3_x", "asymmetry": "asymmetry_x"}
    seen = {name: Detectable(size, "mg", units.get(name, "")) for name, size in sizes.items()}
    warm = ("temperature_c", "temperature_history")
    seen["bias_temperature"] = Detectable(None, "mg", "", "is missing", warm)
    seen["supply_bias"] = Detectable(None, "mg", "", "is missing", ("supply_v",))
    seen["vibration_rectification"] = Detectable(None, "mg", "", "is missing", ("variance_mg2",))
    seen["tone"] = Detectable(None, "mg", "tone", "looked for within the dwells")
    found = words.group_undetected(result(detectable=seen, found=(finding("bias"),)))
    assert found.visible == ["quadratic", "cross_quadratic"]
    assert found.weak == ["cubic"]
    assert found.open == []
    reasons = {name: reason for reason, names in found.blind.items() for name in names}
    assert set(reasons) == {
        "asymmetry", "bias_temperature", "supply_bias", "tone", "vibration_rectification"
    }  # fmt: skip
    assert reasons["vibration_rectification"] == "scatter of the samples in mg not recorded"
    assert reasons["bias_temperature"] == "temperature not recorded"
    assert reasons["supply_bias"] == "supply not recorded"
    assert "no physical amplitude" in reasons["asymmetry"]
    for other in (
        {"confounded": (("bias", "cubic", "quadratic"),)},
        {"reasons": {"cubic": "few angles", "quadratic": "few angles"}},
        {"steps": (step("cubic"), step("quadratic"))},
    ):
        open_ = words.group_undetected(result(detectable=seen, found=(finding("bias"),), **other))
        assert open_.open == ["quadratic", "cubic"]
        assert (open_.visible, open_.weak) == (["cross_quadratic"], [])


def test_an_effect_is_absent_only_beside_an_adequate_model_without_an_unnamed_part() -> None:
    unnamed = SimpleNamespace(covariates=("time",))
    sure = [result(), result(adequate=False), result(unnamed=unnamed)]
    assert [words.absent(one).startswith("absent") for one in sure] == [True, False, False]


def test_sizes_are_stated_with_their_units_and_a_dash_without() -> None:
    assert words.amplitude(Detectable(0.1234, "mg", "bias_x")).split() == ["0.12", "mg"]
    assert words.amplitude(Detectable(None, "mg", "bias_x", "why")) == "–"
    assert words.typical("no_such_effect", Detectable(1.0, "mg", "a")) == ""
    assert words.typical("tone", Detectable(1.0, "mg", "")) == ""
    assert words.typical("tone", Detectable(1.0, "mg", "tone")).endswith("mg")


# -- rivals, causes, tables ------------------------------------------------------------------------------


def test_rivals_that_begin_alike_are_one_line_of_at_most_four_names() -> None:
    groups = (("bias", "cubic", "asymmetry"), ("bias", "asymmetry", "quadratic"), ("tone", "settling"))
    some = result(confounded=groups, reasons={"tone": "few angles", "warm_up": "short"})
    assert words.confounded(some) == [
        "bias — or cubic, or asymmetry, or quadratic",
        "tone — or settling: few angles",
    ]
    assert words.open_names(some) == ["warm_up: short"]
    many = ("bias", "cubic", "asymmetry", "quadratic", "warm_up", "settling", "f(time)", "f(angle)")
    (line,) = words.confounded(result(confounded=(many,)))
    assert "settling" not in line
    assert "f(time)" in line
    assert "2 more" in line  # settling and f(angle)
    (line,) = words.confounded(result(confounded=(("bias", "f(a)", "f(b)", "f(c)"),)))
    assert "2 other unnamed forms" in line


def test_the_table_of_errors_has_a_row_a_model_and_no_empty_column() -> None:
    middle = replace(AFTER, angle_rms_deg=None)
    head, rows = words.error_rows(result(steps=(step("bias", middle), step("cubic"))))
    assert len(head) == 5
    assert [row[0] for row in rows] == ["base model", "+ bias", "+ cubic"]
    assert [row[1] for row in rows] == ["10.0", "0.500", "0.500"]
    bare = ErrorFigures(1.0, None, None, None)
    head, rows = words.error_rows(result(before=bare, steps=(step("bias", bare),)))
    assert len(head) == 2
    axes = replace(bare, heldout_by_axis={"x": 1.0, "z": 3.0}, unit="°/s")
    head, rows = words.error_rows(result(before=axes))
    assert head[2:] == ["x / (°/s)", "z / (°/s)"]
    assert rows[0][2:] == ["1.00", "3.00"]


def test_gains_are_stated_with_what_was_held_out() -> None:
    text = words.gains(result(steps=STEPS))
    for number in ("10", "0.5", "12", "0.6", "20 times"):
        assert number in text
    bare = {"before": ErrorFigures(10.0, None, None, 9.0), "after": ErrorFigures(0.5, None, None, 1.0)}
    assert "no data were held out" in words.gains(result(steps=STEPS, **bare))
    kept = replace(AFTER, heldout_kept=0.45)
    assert "0.45" in words.gains(result(steps=STEPS, after=kept))
    exact = result(steps=STEPS, after=replace(AFTER, residual_rms=1e-9))
    assert words.exact(exact)
    assert "0.5" not in words.gains(exact)
    assert not words.exact(result(steps=(), after=replace(AFTER, residual_rms=0.0)))


def test_the_gains_state_a_smaller_model_that_predicts_better() -> None:
    small, large = replace(AFTER, heldout_rms=0.2), replace(AFTER, heldout_rms=3.0)
    worse = (step("bias", small), step("unnamed: bias of y follows the angle", large))
    clause = "; with bias alone, the held-out error is smaller: 0.200 mg."
    assert words.gains(result(steps=worse, after=large)).endswith(clause)
    nothing = (step("unnamed: bias of y follows the angle", replace(AFTER, heldout_rms=15.0)),)
    text = words.gains(result(steps=nothing, after=nothing[0].error))
    assert text.endswith("; with the base model alone, the held-out error is smaller: 12.0 mg.")
    # A model that does not predict worse by its own terms needs no such clause.
    kept = replace(large, heldout_kept=0.21)
    assert "smaller" not in words.gains(result(steps=(worse[0], step("cubic", kept)), after=kept))
    assert "smaller" not in words.gains(
        result(steps=(step("bias", large), step("cubic", small)), after=small)
    )
    # A model chosen again in each fold can predict better than the final one, which is no smaller model.
    again = replace(AFTER, heldout_rms=2.0, heldout_kept=3.0)
    assert "smaller" not in words.gains(result(steps=(step("bias", again),), after=again))


@pytest.mark.parametrize(
    ("log_odds", "text"), [(0.0, "1.0 : 1"), (3.2189, "25 : 1"), (-3.2189, "1 : 25"), (-23.03, "1 : 10¹⁰")]
)
def test_odds_are_written_with_the_larger_number_on_its_side(log_odds: float, text: str) -> None:
    assert words.odds(log_odds) == text


def test_a_what_if_names_its_question_and_compares_each_model_with_the_best() -> None:
    def model(log_evidence: float, *terms: str) -> Any:
        return SimpleNamespace(terms=terms, error=AFTER, log_evidence=log_evidence)

    def question(*include: str, exclude: tuple[str, ...] = (), only: bool = False) -> str:
        request = SimpleNamespace(include=include, exclude=exclude, only=only)
        return words.asked(SimpleNamespace(request=request))

    assert question("cubic:x", exclude=("bias",)).endswith("with cubic:x, without bias")
    assert question("cubic:x", "bias", only=True).endswith("only cubic:x and bias")
    assert question(only=True).endswith("the base model only")
    models = {
        "before": SimpleNamespace(terms=(), error=BEFORE, log_evidence=-20.0),
        "best": model(10.0, "bias", "quadratic"),
        "asked": model(10.0 - 3.2189, "bias"),
    }
    head, rows = words.compared(SimpleNamespace(**models))
    assert len(head) == len(rows[0]) == 5
    assert [row[0] for row in rows] == ["base: no effect", "best: bias + quadratic", "asked: bias"]
    assert [row[1] for row in rows] == ["10.0", "0.500", "0.500"]
    assert [row[-1] for row in rows] == ["1 : 10¹³", "1.0 : 1", "1 : 25"]
    terms = [
        SimpleNamespace(effect="cubic", parameters={"k3_x": Value(1.0, 0.1, "mg")}, differs_from_zero=sure)
        for sure in (True, False)
    ]
    sure, unsure = words.forced(SimpleNamespace(forced=terms))
    assert sure.startswith("cubic: k3_x = ")
    assert "zero" in unsure
    assert "zero" not in sure


def test_an_unnamed_part_has_its_form_its_share_and_its_probability() -> None:
    assert words.unnamed(result()) == ""
    rest = SimpleNamespace(form="f(time)", explains=0.42, probability=0.93, p_value=1e-7)
    text = words.unnamed(result(unnamed=rest))
    assert text.startswith("f(time)")
    assert "42" in text
    assert "93" in text


def test_parameters_are_grouped_by_axis_if_there_are_many() -> None:
    values = {f"{stem}_{axis}": Value(1.0, 0.1, "mg") for axis in "xy" for stem in ("a", "b")}
    many = replace(finding("bias", "xy"), parameters=values)
    assert [line.count("=") for line in words.parameters(many)] == [2, 2]
    few = replace(many, parameters=dict(list(values.items())[:3]))
    assert [line.count("=") for line in words.parameters(few)] == [1, 1, 1]


def test_owners_below_one_percent_are_left_out() -> None:
    by = {"the part": 0.985, "the stage": 0.011, "the session": 0.004}
    (line,) = words.owners(SimpleNamespace(owners={"bias": by}))
    assert line.startswith("bias: ")
    assert ["the part" in line, "the stage" in line, "the session" in line] == [True, True, False]


def test_a_session_has_its_share_of_the_evidence_of_each_cause() -> None:
    def one(name: str, evidence: float, alone: dict) -> Any:
        return SimpleNamespace(
            session=name, evidence={"bias": evidence}, alone=alone, heldout_before_mg=2.0,
            heldout_after_mg=1.0, session_before_mg=4.0, session_after_mg=3.0,
        )  # fmt: skip

    joint = result(sessions=(one("a", 3.0, {"bias": 0.9}), one("b", 1.0, {})))
    first, second = words.session_shares(joint)
    assert "bias 75" in first
    assert "bias (90" in first
    assert "bias 25" in second
    assert "Alone: nothing" in second
    assert words.session_shares(result(sessions=())) == []


# -- the session -----------------------------------------------------------------------------------------


def test_a_session_is_described_by_its_dwells_that_have_samples() -> None:
    time_s = turn(4).time_s
    some = [
        Dwell(k, time_s, time_s[:, None] * [1.0, 1.0], use=use) for k, use in enumerate(["fit", "check"])
    ]
    empty = Dwell(5, time_s[:0], some[0].accel[:0])
    whole = Session((*some, empty), sensor="generic", source="a/b.csv")
    assert words.shape(whole) == "2 dwells, one plane, 1 of them for checking, generic"
    assert "attitudes in space" in words.shape(replace(whole, plane="none"))
    assert words.shape(replace(whole, dwells=(some[0], empty))) == "one pose, 4 samples, generic"
    turned = replace(whole, free_turn=True, recording=some[0])
    assert words.shape(turned) == "one free turn, 4 samples, generic"
    assert [words.title(one) for one in (whole, replace(whole, title="t"), Session(()))] == [
        "b.csv", "t", "session",
    ]  # fmt: skip
    assert words.written_down(replace(whole, serial="17", stage=" ")) == {"part": "17"}
    assert words.advice(result(advice=("do",))) == ("do",)
    assert len(words.advice(result())) == 1
