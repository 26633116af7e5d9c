"""How a trace goes from stage to stage: what each hands on, and what follows from what it says.

The stages themselves are replaced by what they could have said; other tests are about them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from adis_gonio.base.budget import Budget, within
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.readings import Readings, Unit, in_mg
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing import validation
from adis_gonio.tracing.credible_sets import CredibleSet, Names
from adis_gonio.tracing.scatter import Scatter
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.trace import UNCHECKED, trace, trace_readings
from adis_gonio.tracing.trace_result import ErrorFigures, Finding, Stopped, TraceResult
from tracing.small_problems import biased, chosen, function, labelled, noisy, turn
from tracing.test_trace_outcome import accused

stages = import_module("adis_gonio.tracing.trace")

SCATTER = Scatter("reading_scatter", 0.2, 0.02, 0.1, 3.0, 0.01)


@cache
def bent(check: tuple[int, ...] = (), off_mg: float = 0.0) -> tuple[Readings, list[Term], Selection]:
    """A turn with a bias and a cubic of x, and the model that has both; dwells to check are off."""
    data = biased(mg=(5.0, 0.0))
    psi = np.radians(3.0) - data.conditions.angle_rad
    checks = np.isin(np.arange(24), check)
    mean = data.mean + np.outer(60.0 * np.cos(psi) ** 3 + off_mg * checks, [1.0, 0.0])
    data = replace(data, mean=mean, check=checks)
    terms = labelled(data, "bias[x]", "cubic[x]")
    return data, terms, chosen(data.training, terms, ((0, 1), 1.0))


class Told:
    """A trace of stages that say what they are told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monkeypatch = monkeypatch
        self.advised: list[Any] = []

    def __call__(
        self,
        made: tuple[Readings, list[Term], Selection],
        scatter: Scatter | None = None,
        errors: Sequence[float] | None = None,
        heldout: Sequence[float] = (10.0, 5.0, 1.0),
        could: tuple[str, ...] = (),
        averaged: Any = None,
    ) -> TraceResult:
        data, terms, selection = made

        def advise(*about: Any) -> tuple[tuple[str, ...], tuple[Any, ...]]:
            self.advised.append(about)
            return ("go on",), ()

        def figures(selection: Any, measured: Any, checking: Any, fits: Sequence[Any], fold: Any) -> Any:
            return [ErrorFigures(e, e, None, e) for e in heldout[: len(fits)]], "a design"

        for name, stage in {
            "select": lambda *_: selection,
            "with_scatter": lambda *_: (selection, scatter),
            "named_terms": lambda _: (terms, {}),
            "nameless_terms": lambda _: [],
            "average": lambda _: averaged,
            "guard_errors": lambda _, fits, fold: errors or [],
            "error_figures": figures,
            "undecided": lambda _: could,
        }.items():
            module = stages if hasattr(stages, name) else validation
            self.monkeypatch.setattr(module, name, stage)
        self.monkeypatch.setattr("adis_gonio.tracing.proposals.advise", advise)
        return trace_readings(data, 2)


def judge_late(*_: Any) -> Names:
    """Judge the names of `bent`, at the end of the time."""
    stages.current().leave_out("what follows")
    return Names(("bias", "cubic"), {}, ())


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    return Told(monkeypatch)


class TestResult:
    def test_an_adequate_model_is_a_result_with_all_of_its_names_steps_and_figures(
        self, told: Told
    ) -> None:
        made = bent()
        result = told(made)
        assert result.adequate
        assert {finding.effect for finding in result.found} == {"bias", "cubic"}
        assert [step.effect for step in result.steps] == ["cubic", "bias"]
        assert [step.error.heldout_rms for step in result.steps] == [5.0, 1.0]
        assert (result.before.heldout_rms, result.after.heldout_rms) == (10.0, 1.0)
        assert [len(fit.terms) for fit in result.fits] == [0, 1, 2]
        assert result.fits[-1] is made[2].fit
        assert (result.advice, result.heldout_design, result.reasons) == (("go on",), "a design", {})
        # χ² beyond its freedom: 10, 5 and 1 times 44, 43 and 42, less as much.
        excess = np.array([9.0 * 44, 4.0 * 43, 0.0])
        shares = {"cubic": excess[0] - excess[1], "bias": excess[1] - excess[2]}
        for finding in result.found:
            assert finding.explains == pytest.approx(shares[finding.effect] / excess[0])

    @pytest.mark.parametrize(
        ("adequate", "scatter", "could", "said"),
        [
            (True, None, ("one", "two"), False),
            (False, None, ("one", "two"), True),
            (True, SCATTER, ("one", "two"), True),
            (False, None, ("one",), False),
        ],
    )
    def test_what_could_explain_the_rest_is_said_where_there_is_one_and_it_has_two_names(
        self, told: Told, adequate: bool, scatter: Scatter | None, could: tuple[str, ...], said: bool
    ) -> None:
        data, terms, selection = bent()
        result = told((data, terms, replace(selection, adequate=adequate)), scatter, could=could)
        assert result.confounded == ((could,) if said else ())
        assert result.adequate == (adequate and scatter is None)
        assert self.open_still(told) == result.adequate, "what to measure next is asked about the same"

    @staticmethod
    def open_still(told: Told) -> bool:
        return bool(told.advised[-1][1].adequate)

    def test_scatter_stands_last_with_what_the_steps_leave_and_in_the_noise_of_what_follows(
        self, told: Told
    ) -> None:
        data, *_ = made = bent()
        result = told(made, SCATTER, heldout=(10.0, 5.0, 2.0))
        assert result.found[-1].effect == "reading_scatter"
        assert result.found[-1].explains == pytest.approx(1.0 * 42 / (9.0 * 44))
        noise = told.advised[-1][0].own_covariance
        np.testing.assert_allclose(noise, data.own_covariance + 0.2**2 * np.eye(2))

    @pytest.mark.parametrize(("off_mg", "agree"), [(0.0, True), (2.0, False)])
    def test_check_dwells_that_do_not_agree_leave_the_model_inadequate(
        self, told: Told, off_mg: float, agree: bool
    ) -> None:
        result = told(bent((2, 7, 12, 17), off_mg))
        assert result.adequate == agree
        assert len([note for note in result.notes if "4 check dwells do not agree" in note]) == (not agree)

    def test_check_dwells_do_not_speak_of_a_model_that_is_inadequate_already_or_of_unknown_noise(
        self, told: Told
    ) -> None:
        data, terms, selection = bent((2, 7, 12, 17), 2.0)
        inadequate = told((data, terms, replace(selection, adequate=False)))
        assert not any("do not agree" in note for note in inadequate.notes)
        unknown = replace(data, noise_known=False)
        fit = replace(selection.fit, data=unknown.training)
        silent = told((unknown, terms, replace(selection, fit=fit)))
        assert not silent.adequate, "noise that is not known tests no model"
        assert not any("do not agree" in note for note in silent.notes)

    @pytest.mark.parametrize("known", [True, False])
    def test_a_model_that_leaves_no_freedom_cannot_be_called_adequate(
        self, told: Told, known: bool
    ) -> None:
        data = replace(noisy(turn(angles_deg=[0, 70]), 71), noise_known=known)
        selection = chosen(data, labelled(data, "quadratic[x]"), ((), 1.0))
        assert selection.adequate
        assert not told((data, [], selection)).adequate

    def test_the_longest_model_that_left_out_dwells_do_not_speak_against_is_the_result(
        self, told: Told
    ) -> None:
        result = told(bent(), errors=(10.0, 1.0, 2.0))
        assert [step.effect for step in result.steps] == ["cubic"]
        assert [finding.effect for finding in result.found] == ["cubic"]
        assert [[term.label for term in fit.terms] for fit in result.fits] == [[], ["cubic[x]"]]
        assert result.after.heldout_rms == 5.0
        assert result.reasons == {"bias": "the held-out error would go from 1 to 2 mg with it"}

    def test_a_name_that_does_not_stand_after_all_is_open_with_the_reason_and_no_finding(
        self, told: Told, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def weak(_: Any, final: ErrorFigures, *others: Any) -> dict[str, str]:
            assert final.heldout_rms == 1.0, "it is judged by the figures of the final model"
            return {"cubic": "too weak"}

        monkeypatch.setattr(stages, "weak_names", weak)
        result = told(bent())
        assert [finding.effect for finding in result.found] == ["bias"]
        assert result.reasons == {"cubic": "too weak"}
        assert ("cubic",) in result.confounded

    def test_of_a_model_that_leaves_too_few_readings_a_bias_is_all_that_is_found(
        self, told: Told, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(stages.limits, "least_checks", 48 - 6 + 1)
        result = told(bent())
        assert [finding.effect for finding in result.found] == ["bias"]
        assert "too few" in result.reasons["cubic"]

    def average(self, selection: Selection) -> Any:
        """An average beside the names, at the values of their fit."""
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        fit = selection.fit.with_terms([*selection.terms, wave], [*selection.fit.values.terms, np.zeros(1)])
        vars(fit).update(smooth=wave, weight=0.9)
        return fit

    @pytest.mark.parametrize(("off_mg", "agree"), [(0.0, True), (2.0, False)])
    def test_an_average_is_the_result_and_check_dwells_judge_it(
        self, told: Told, off_mg: float, agree: bool
    ) -> None:
        made = bent((2, 7, 12, 17), off_mg)
        averaged = self.average(made[2])
        result = told(made, averaged=averaged, heldout=(10.0, 5.0, 2.0, 1.0))
        assert result.fits[-1] is averaged
        assert result.steps[-1].effect == "unnamed: bias of x follows wave"
        assert result.unnamed is not None
        assert result.unnamed.probability == 0.9
        assert result.adequate == agree
        assert any("4 check dwells do not agree" in note for note in result.notes) == (not agree)

    def test_of_an_average_that_left_out_dwells_speak_against_nothing_is_said(self, told: Told) -> None:
        made = bent()
        result = told(made, averaged=self.average(made[2]), errors=(10.0, 5.0, 1.0, 2.0))
        assert [step.effect for step in result.steps] == ["cubic", "bias"]
        assert result.unnamed is None
        assert len(result.fits[-1].terms) == 2

    def test_out_of_time_after_it_was_made_an_average_is_the_best_model_so_far(
        self, told: Told, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(stages, "judge", judge_late)
        made = bent()
        averaged = self.average(made[2])
        with within(Budget()):
            result = told(made, averaged=averaged)
        assert result.fits[-1] is averaged
        assert set(result.reasons.values()) == {UNCHECKED}

    @pytest.mark.parametrize(("present", "said"), [(0.5, False), (0.6, True)])
    def test_a_set_is_said_of_a_cause_that_is_more_likely_there_than_not(
        self, told: Told, monkeypatch: pytest.MonkeyPatch, present: float, said: bool
    ) -> None:
        one = CredibleSet("cubic", ("cubic", "gravity"), (0.6, 0.4), present)
        monkeypatch.setattr(stages, "credible_sets", lambda *_: (one,))
        assert told(bent()).sets == ((one,) if said else ())

    def test_errors_that_are_stated_count_where_they_are_of_the_folds_and_not_of_check_dwells(
        self, told: Told
    ) -> None:
        worse = (10.0, 5.0, 11.0)
        assert len(told(bent(), errors=(10.0, 2.0, 1.0), heldout=worse).steps) == 1
        assert len(told(bent((2, 7, 12, 17)), errors=(10.0, 2.0, 1.0), heldout=worse).steps) == 2

    def test_effects_that_the_angles_of_the_positions_rule_out_are_no_candidates(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        candidates: list[Term] = []

        def searched(training: Readings, terms: Sequence[Term], most: int) -> Any:
            candidates.extend(terms)
            raise FitError("enough")

        monkeypatch.setattr(stages, "select", searched)
        monkeypatch.setattr(stages, "nameless_terms", lambda training: [])
        with pytest.raises(FitError, match="enough"):
            trace_readings(data, 2, (accused(7, "misset"), accused(3, "gravity_wrong")))
        dwells = {
            name: {term.dwell for term in candidates if term.name == name}
            for name in ("outlier_dwell", "position_slip")
        }
        assert dwells == {"outlier_dwell": set(range(24)) - {7}, "position_slip": set(range(24)) - {3}}


class TestOutOfTime:
    @pytest.mark.parametrize("scatter", [None, SCATTER])
    def test_what_was_not_checked_is_open_with_all_of_the_model_and_its_scatter(
        self, told: Told, monkeypatch: pytest.MonkeyPatch, scatter: Scatter | None
    ) -> None:
        monkeypatch.setattr(stages, "judge", judge_late)
        made = bent()
        with within(Budget()):
            result = told(made, scatter)
        names = ["cubic", "bias", *([] if scatter is None else ["reading_scatter"])]
        assert result.reasons == dict.fromkeys(names, UNCHECKED)
        assert (result.adequate, result.found) == (False, ())
        assert [step.effect for step in result.steps] == ["cubic", "bias"]
        assert [len(fit.terms) for fit in result.fits] == [0, 1, 2]
        assert result.fits[-1] is made[2].fit
        assert result.before.residual_rms > result.steps[0].error.residual_rms > result.after.residual_rms
        assert result.after.residual_rms == pytest.approx(math.sqrt((made[2].fit.misfit ** 2).mean()))
        assert result.stopped is not None
        assert not result.stopped.checked

    def test_what_was_left_out_after_the_checks_leaves_a_result_that_is_checked(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        result = replace(given(), stopped=None)
        with within(Budget(left_out=["what to measure next"])):
            stamped = stages.with_time_left_out(result, checked=True)
        assert stamped.stopped is not None
        assert stamped.stopped.checked
        assert stamped.stopped.left_out == ("what to measure next",)
        with within(Budget()):
            assert stages.with_time_left_out(result, checked=True) is result

    @pytest.mark.parametrize("over", [True, False])
    def test_a_search_that_the_limit_ended_is_said_and_weighs_no_scatter(
        self, monkeypatch: pytest.MonkeyPatch, over: bool
    ) -> None:
        data, _, selection = bent()
        now = 0.0

        def select(*_: Any) -> Selection:
            nonlocal now
            now = 2.0 if over else 0.5
            return selection

        monkeypatch.setattr(stages, "select", select)
        monkeypatch.setattr(stages, "with_scatter", lambda first, *_: (first, SCATTER))
        budget = Budget(1.0, clock=lambda: now)
        with within(budget):
            run = stages.TraceRun(data, 2, ())
            run.search()
        assert run.selection is selection
        assert run.scatter is (None if over else SCATTER)
        assert ("the end of the search for effects" in budget.left_out) == over


class TestGuard:
    """A model is chosen again without the functions that left-out dwells refute."""

    @pytest.mark.parametrize(("left_out", "chosen_without"), [((), ["wave", "line"]), (("a stage",), [])])
    def test_until_none_is_refuted_or_the_time_is_over(
        self, monkeypatch: pytest.MonkeyPatch, left_out: tuple[str, ...], chosen_without: list[str]
    ) -> None:
        without: list[str] = []

        def model(*gone: str) -> Any:
            def again(refuted: Sequence[str]) -> Any:
                without.extend(refuted)
                return model(*gone, *refuted)

            return SimpleNamespace(gone=gone, without_functions=again)

        def nest(run: Any, selection: Any) -> None:
            run.selection, run.fits, run.errors = selection, [], []

        to_go = {(): ["wave"], ("wave",): ["line"], ("wave", "line"): []}
        monkeypatch.setattr(stages.TraceRun, "nest", nest)
        monkeypatch.setattr(
            validation, "harmful_functions", lambda selection, fits, errors: to_go[selection.gone]
        )
        run = stages.TraceRun(biased(), 3, ())
        run.selection = model()
        with within(Budget(left_out=list(left_out))):
            run.drop_harmful_functions()
        assert without == chosen_without
        assert run.selection.gone == tuple(chosen_without)


def given() -> TraceResult:
    figures = ErrorFigures(1.0, None, None, None)
    return TraceResult(True, (), (), figures, figures)


class TestParts:
    def test_scatter_has_what_the_steps_leave_and_no_less_than_nothing(self) -> None:
        bias = Finding("bias", ("x",), {"bias_x": Value(1.0, 0.1, "mg")}, 0.0, 0.0, 1.0)
        data: Any = SimpleNamespace(unit=in_mg(2))
        seen = stages.shown_findings([bias], data, SCATTER, {"bias": 0.7})
        assert [(one.effect, pytest.approx(one.explains)) for one in seen] == [
            ("bias", 0.7),
            ("reading_scatter", 0.3),
        ]
        assert stages.shown_findings([bias], data, SCATTER, {"bias": 1.2})[-1].explains == 0.0
        assert [one.effect for one in stages.shown_findings([bias], data, None, {"bias": 0.7})] == ["bias"]
        counts: Any = SimpleNamespace(unit=Unit("counts", np.array([100.0, 0]), np.array([2.0, 2.0])))
        (told,) = stages.shown_findings([bias], counts, None, {})
        assert told.parameters["bias_x"].value == 102.0

    def test_errors_are_reported_where_both_ends_have_one(self) -> None:
        def figures(*errors: float | None) -> list[ErrorFigures]:
            return [ErrorFigures(1.0, error, None, None) for error in errors]

        assert stages.reported_errors(figures(3.0, 2.0, 1.0)) == (3.0, 1.0)
        assert stages.reported_errors(figures(3.0, None, 1.0)) == (3.0, 1.0)
        assert stages.reported_errors(figures(None, 2.0, 1.0)) is None
        assert stages.reported_errors(figures(3.0, 2.0, None)) is None

    def test_degrees_of_freedom_are_those_of_the_first_base_parameter_that_has_an_uncertainty(self) -> None:
        base = {"alpha": Value(1.0, None, "deg", 7.0), "scale_x": Value(1.0, 0.1, "1", 30.0)}
        assert replace(given(), base=base).dof == 30.0
        assert replace(given(), base={"alpha": base["alpha"]}).dof == math.inf


def session(dwells: int = 3, **others: Any) -> Session:
    """Single readings at angles 90° apart, with empty dwells beside them."""
    made = [
        Dwell(
            k,
            np.array([20.0 * k]),
            1000 * np.array([[math.cos(k * math.pi / 2), -math.sin(k * math.pi / 2)]]),
            angle_deg=90.0 * k,
        )
        for k in range(dwells)
    ]
    return Session(tuple(made), accel_unit="mg", reading_u_mg=0.1, sensor="generic", **others)


class TestSessions:
    """What is done of a session for which part of the sensor."""

    def traced(
        self, monkeypatch: pytest.MonkeyPatch, session: Session, part: str = "accelerometer", **others: Any
    ) -> tuple[TraceResult, list[str]]:
        """The result, and the stages that were asked, of which each says its name in the notes."""
        asked: list[str] = []

        def saying(name: str, result: TraceResult) -> TraceResult:
            asked.append(name)
            return replace(result, notes=(*result.notes, name))

        def positions(session: Session) -> tuple[()]:
            asked.append("positions")
            return ()

        def readings(session: Session, part: str) -> Readings:
            asked.append(part)
            return biased()

        stopped = others.pop("stopped", None)
        monkeypatch.setattr(stages, "positions_of", positions)
        monkeypatch.setattr(stages, "readings_of_part", readings)
        monkeypatch.setattr(
            stages, "trace_readings", lambda *_: saying("readings", replace(given(), stopped=stopped))
        )
        monkeypatch.setattr(
            "adis_gonio.tracing.within.second_pass.with_second_pass",
            lambda session, data, result: saying("samples", result),
        )
        monkeypatch.setattr(
            "adis_gonio.tracing.one_pose.trace_series",
            lambda session, most: saying("series", given()),
        )
        return trace(session, part=part, **others), asked

    def test_of_accelerometers_positions_and_samples_are_looked_at_and_of_gyros_neither(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        result, asked = self.traced(monkeypatch, session())
        assert asked == ["positions", "accelerometer", "readings", "samples"]
        assert result.notes == ("readings", "samples")
        result, asked = self.traced(monkeypatch, session(), "gyro")
        assert asked == ["gyro", "readings"]
        assert result.notes == ("readings",)

    def test_one_dwell_of_accelerometers_is_traced_sample_by_sample(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert self.traced(monkeypatch, session(1))[1] == ["series"]
        assert "series" not in self.traced(monkeypatch, session(2))[1]
        assert "series" not in self.traced(monkeypatch, session(1), "gyro")[1]
        empty = Dwell(1, np.zeros(0), np.zeros((0, 2)), angle_deg=90.0)
        one = session(1)
        assert self.traced(monkeypatch, replace(one, dwells=(*one.dwells, empty)))[1] == ["series"]
        assert "series" not in self.traced(monkeypatch, replace(one, dwells=(empty,)))[1]

    def test_of_one_dwell_what_the_limit_left_out_leaves_a_result_that_is_checked(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        with within(Budget(left_out=["a model of the samples"])):
            result, asked = self.traced(monkeypatch, session(1))
        assert asked == ["series"]
        assert result.stopped is not None
        assert result.stopped.checked

    @pytest.mark.parametrize("checked", [True, False])
    def test_what_the_limit_left_out_is_said_with_whether_it_was_checked_by_then(
        self, monkeypatch: pytest.MonkeyPatch, checked: bool
    ) -> None:

        stopped = None if checked else Stopped(1.0, 2.0, ("folds",), checked=False)
        with monkeypatch.context() as patched:
            patched.setattr(stages, "attempt", lambda stage, work, otherwise: self.left_out(otherwise))
            result, _ = self.traced(patched, session(), time_limit=1e9, stopped=stopped)
        assert result.stopped is not None
        assert result.stopped.checked == checked
        assert result.stopped.left_out == ("the samples",)

    @staticmethod
    def left_out(otherwise: TraceResult) -> TraceResult:
        stages.current().leave_out("the samples")
        return otherwise

    @pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan])
    def test_a_limit_that_is_no_positive_number_is_refused(
        self, monkeypatch: pytest.MonkeyPatch, seconds: float
    ) -> None:
        with pytest.raises(UsageError, match="give a positive number of seconds"):
            self.traced(monkeypatch, session(), time_limit=seconds)

    def test_a_free_turn_is_refused_where_it_has_no_positions(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        free: Any = SimpleNamespace(free_turn=object(), dwells=(), source="file.csv")
        with pytest.raises(FitError, match="a free turn has no positions"):
            trace(free)
        made = session(free_turn=object())
        assert "readings" in self.traced(monkeypatch, made)[1]

    def test_what_is_wrong_with_the_readings_is_said_of_their_session(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(_: Readings) -> None:
            raise FitError("too few")

        with monkeypatch.context() as patched:
            patched.setattr(stages, "failure_message", lambda session, error: f"of this session: {error}")
            patched.setattr(stages, "refuse_too_few", refuse)
            with pytest.raises(FitError, match="of this session: too few"):
                trace(session())

    def test_positions_stand_in_the_result_and_what_was_overridden_does_too(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            stages, "with_positions", lambda result, *_: replace(result, notes=("of positions",))
        )
        result, _ = self.traced(monkeypatch, session(facts={"overrides": {"unit": "mg"}}))
        assert result.notes == ("of positions", "samples")
        assert result.overrides == {"unit": "mg"}
