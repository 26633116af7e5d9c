"""What a reader of a trace is shown and told, on sessions and models that are made by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, Unit, from_means
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.fitting.slips.session_positions import Named, PositionFinding, sentences_of
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.tracing.credible_sets import credible_sets, merge_by_function, votes
from adis_gonio.tracing.findings import (
    base_mixture,
    base_of,
    cycles_alike,
    detectable,
    dof_of,
    excesses,
    finding_of,
    in_units_of_file,
    notes_of,
    probability_of_equals,
    rivals_of,
    scatter_finding,
    unnamed_of,
)
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.scatter import Scatter
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace import (
    TraceRun,
    correct_slips,
    likelier_functions,
    restrict_candidates,
    shown_findings,
    with_positions,
)
from adis_gonio.tracing.trace_figures import Panel, view_residual, view_uncertainty, views_of
from adis_gonio.tracing.trace_result import ErrorFigures, Finding, TraceResult
from tracing.small_problems import (
    G,
    U,
    base_and_bias,
    believed,
    biased,
    chosen,
    function,
    ideal_mg,
    labelled,
    named,
    names_only,
    noisy,
    read,
    single,
    surroundings,
    turn,
)


def steps_of(data: Readings, *models: Sequence[Term], unnamed: Any = None) -> Any:
    """As much of a result as figures look at: fits of nested models, by the last term's name."""
    fits = [Fit.begin(data).refit()]
    for terms in models:
        zero = [term.start(np.zeros(term.columns(data.mean, data.conditions).shape[-1])) for term in terms]
        fits.append(fits[0].with_terms(terms, zero).refit())
    steps = tuple(SimpleNamespace(effect=terms[-1].shown_as) for terms in models)
    return SimpleNamespace(fits=tuple(fits), steps=steps, unnamed=unnamed)


def panels(data: Readings, *terms: Term) -> tuple[Panel, ...]:
    """What is drawn of the last of nested steps."""
    nested = [terms[: k + 1] for k in range(len(terms))]
    return views_of(data, steps_of(data, *nested)).steps[-1]


def shown(drawn: Sequence[Panel]) -> list[tuple[str, str]]:
    return [(panel.covariate, panel.quantity) for panel in drawn]


def misfit_mg(data: Readings, fit: Fit) -> np.ndarray:
    """Readings minus base model, by the equations of the paper."""
    start, scale_x, scale_y, lean = fit.values.base
    psi = start - data.conditions.angle_rad
    return data.mean - G * np.column_stack([scale_x * np.cos(psi), scale_y * np.sin(psi + lean)])


class TestFiguresOfSteps:
    data = noisy(surroundings(), 21)

    @property
    def catalogue(self) -> dict[str, Term]:
        """Candidates by their labels, made when they are asked for."""
        return {term.label: term for term in named_terms(self.data)[0]}

    @pytest.mark.parametrize(
        ("label", "drawn"),
        [
            ("bias[xy]", [("angle", "residual_x"), ("angle", "residual_y")]),
            ("cross_axis[x]", [("angle", "residual_x")]),
            ("cross_quadratic[y]", [("angle", "residual_y")]),
            ("quadratic[x]", [("reading_x", "residual_x")]),
            ("cubic[xy]", [("reading_x", "residual_x"), ("reading_y", "residual_y")]),
            ("supply_bias[y]", [("supply", "residual_y")]),
            ("bias_temperature[x](degree=1)", [("temperature", "residual_x")]),
            ("bias_drift[y]", [("time", "residual_y")]),
            ("outlier_dwell[y](dwell=7)", [("order", "residual_y")]),
            ("position_slip(dwell=7)", [("order", "angle")]),
            ("backlash", [("approach", "angle")]),
            ("stage_eccentricity", [("angle", "angle")]),
        ],
    )
    def test_a_step_is_drawn_against_what_its_effect_follows(
        self, label: str, drawn: list[tuple[str, str]]
    ) -> None:
        assert shown(panels(self.data, self.catalogue[label])) == drawn

    def test_a_function_without_a_name_is_drawn_on_its_own_axes_against_its_covariate(self) -> None:
        on_y = replace(function("line", lambda c: c.time_s / 1e3), axes=(1,))
        assert shown(panels(self.data, on_y)) == [("time", "residual_y")]
        turns = function("line", lambda c: c.time_s / 1e3, where="angle")
        assert shown(panels(self.data, turns)) == [("time", "angle")]

    def test_each_step_is_drawn_for_the_term_that_came_in(self) -> None:
        one, two = self.catalogue["quadratic[x]"], self.catalogue["supply_bias[y]"]
        steps = views_of(self.data, steps_of(self.data, [one], [two, one])).steps
        assert [shown(step) for step in steps] == [
            [("reading_x", "residual_x")],
            [("supply", "residual_y")],
        ]

    def test_readings_are_drawn_before_and_after_with_their_own_uncertainty(self) -> None:
        c = surroundings()
        mean = self.data.mean + np.outer(np.arange(24) == 7, [0.0, 5.0])
        data = replace(
            self.data, mean=mean, own_covariance=np.tile(np.diag([0.01, 0.04]), (len(c.time_s), 1, 1))
        )
        term = self.catalogue["outlier_dwell[y](dwell=7)"]
        result = steps_of(data, [term])
        (panel,) = views_of(data, result).steps[0]
        base, last = result.fits
        np.testing.assert_allclose(panel.before, misfit_mg(data, base)[:, 1], atol=1e-9)
        outlier = last.values.terms[0][0] * (np.arange(24) == 7)
        np.testing.assert_allclose(panel.after, misfit_mg(data, last)[:, 1] - outlier, atol=1e-9)
        assert panel.after[7] == pytest.approx(0.0, abs=1e-6)
        np.testing.assert_allclose(panel.u, 0.2)
        assert panel.x.tolist() == list(range(24))
        assert not len(panel.check_x)
        assert not len(panel.check_after)

    def test_angles_are_drawn_in_degrees_as_the_goniometer_errs(self) -> None:
        c = surroundings()
        slips = 0.5 * (np.arange(24) == 7)
        data = replace(read(c, ideal_mg(c, slips)), fixture_rad=2e-4)
        term = self.catalogue["position_slip(dwell=7)"]
        result = steps_of(data, [term])
        (panel,) = views_of(data, result).steps[0]
        # A part that is turned forward by a slip shows an angle that is as much too small.
        others = np.delete(panel.before, 7)
        assert panel.before[7] - others.mean() == pytest.approx(-0.5, abs=0.01)
        assert np.abs(others).max() < 0.05, "none is off by a turn"
        np.testing.assert_allclose(panel.after, 0.0, atol=1e-4)
        np.testing.assert_allclose(panel.u, np.degrees(math.hypot(U / G, 2e-4)), rtol=1e-3)

    def test_an_angle_is_off_by_less_than_half_a_turn_however_often_the_stage_has_turned(self) -> None:
        # By how much the part is turned is known but for whole turns.
        off_deg = np.array([0.3, 170.0, -170.0, -0.2])
        turned = np.radians(off_deg + 360.0 * np.array([2, -1, 1, -3]))
        fit: Any = SimpleNamespace(data=self.data, angle_error_rad=lambda data: turned)
        np.testing.assert_allclose(view_residual(fit, "angle"), off_deg, atol=1e-9)

    def test_dwells_for_checking_are_drawn_beside_those_that_were_fitted(self) -> None:
        check = np.arange(24) % 6 == 5
        every = replace(self.data, check=check)
        training = every.training
        term = self.catalogue["bias_drift[y]"]
        result = steps_of(training, [term])
        (panel,) = views_of(every, result).steps[0]
        minutes = every.conditions.time_s / 60
        np.testing.assert_allclose(panel.x, minutes[~check])
        np.testing.assert_allclose(panel.check_x, minutes[check])
        fit = result.fits[-1]
        checking = every.rows(check)
        drift = term.added(fit.values.terms[0], checking.mean, checking.conditions)
        np.testing.assert_allclose(panel.check_after, (misfit_mg(checking, fit) - drift)[:, 1], atol=1e-6)

    def test_where_the_noise_is_not_known_no_uncertainty_is_drawn(self) -> None:
        data = replace(self.data, noise_known=False)
        (panel,) = panels(data, self.catalogue["quadratic[x]"])
        assert np.isnan(panel.u).all()
        np.testing.assert_allclose(panel.x, data.mean[:, 0] / G)

    def test_a_lag_is_drawn_against_how_far_its_element_is_behind(self) -> None:
        history = np.linspace(0, 1440, 289)
        c = replace(surroundings(), temperature_history=(history, 25 + 0.01 * history))
        c = replace(c, temperature_c=25 + 0.01 * c.time_s)
        tau = 300.0
        behind = -0.01 * tau * (1 - np.exp(-c.time_s / tau))  # of a ramp, from rest
        data = read(c, ideal_mg(c) + np.outer(2 * behind, [0.0, 1.0]))
        (panel,) = panels(
            data, next(t for k, t in self.catalogue.items() if k.startswith("thermal_lag[y]"))
        )
        assert (panel.covariate, panel.quantity) == ("temperature_lag", "residual_y")
        # Its time constant is fitted from readings of 0.1 mg, which say 2 mg/°C to some hundredths of °C.
        np.testing.assert_allclose(panel.x, behind, atol=0.1)

    def test_in_space_the_length_of_a_reading_is_drawn(self) -> None:
        # Of faces, edges and corners of a cube no gain or skew imitates a bias.
        up = np.array([v for v in itertools.product([-1.0, 0.0, 1.0], repeat=3) if any(v)])
        up /= np.linalg.norm(up, axis=1)[:, None]
        n = len(up)
        c = Conditions(60.0 * np.arange(n), order=np.arange(float(n)), supply_v=5 + 0.01 * np.arange(n))
        spread = np.diag([0.01, 0.04, 0.09])
        data = from_means(G * up + [2.0, 0.0, 0.0], np.tile(spread, (n, 1, 1)), c)
        (panel, other) = panels(data, *labelled(data, "bias[xy]"))
        assert shown([panel, other]) == [("reading_x", "norm"), ("reading_y", "norm")]
        np.testing.assert_allclose(panel.before, 2.0 * up[:, 0], atol=0.02)
        np.testing.assert_allclose(panel.after, 0.0, atol=1e-3)
        np.testing.assert_allclose(panel.u, np.sqrt(np.einsum("ni,ij,nj->n", up, spread, up)), rtol=0.01)
        supply = panels(data, *labelled(data, "supply_bias[xz]"))
        assert shown(supply) == [("supply", "norm")], "both axes have one covariate: it is drawn once"
        np.testing.assert_allclose(supply[0].x, c.supply_v)

    def test_of_a_dwell_without_a_declared_angle_the_noise_of_its_reading_is_drawn(self) -> None:
        angles = np.where(np.arange(24) == 7, np.nan, self.data.angle_rad)
        fit = Fit.begin(replace(self.data, angle_rad=angles, fixture_rad=2e-4)).refit()
        told = view_uncertainty(fit, "angle")
        expected = np.where(np.arange(24) == 7, U / G, math.hypot(U / G, 2e-4))
        np.testing.assert_allclose(told, np.degrees(expected), rtol=1e-3)


class TestFiguresOfWhatIsLeft:
    def left(self, data: Readings, *covariates: str, terms: Sequence[Term] = ()) -> tuple[Panel, ...]:
        unnamed = SimpleNamespace(covariates=covariates) if covariates else None
        models = [terms] if terms else []
        return views_of(data, steps_of(data, *models, unnamed=unnamed)).left

    def test_it_is_drawn_against_all_that_changed_on_both_axes(self) -> None:
        drawn = shown(self.left(noisy(surroundings(), 23)))
        covariates = ("angle", "time", "temperature", "supply")
        assert drawn == list(itertools.product(covariates, ("residual_x", "residual_y")))

    @pytest.mark.parametrize(("steps", "drawn"), [(0.7, False), (1.5, True)])
    def test_what_moved_by_less_than_a_step_of_the_sensors_is_not_drawn(
        self, steps: float, drawn: bool
    ) -> None:
        # Data sheet: 0.145 °C and 1.83 mV a step.
        way = np.linspace(0, 1, 24)
        c = turn(temperature_c=25 + 0.145 * steps * way, supply_v=5 + 0.00183 * steps * way)
        covariates = {panel.covariate for panel in self.left(noisy(c, 24))}
        assert covariates - {"angle", "time"} == ({"temperature", "supply"} if drawn else set())

    def test_what_the_rest_depends_on_comes_first_however_little_it_moved(self) -> None:
        c = turn(temperature_c=25 + 0.01 * np.linspace(0, 1, 24))
        drawn = self.left(noisy(c, 24), "temperature")
        assert [panel.covariate for panel in drawn[::2]] == ["temperature", "angle", "time"]

    def test_it_is_drawn_beside_what_the_base_model_left(self) -> None:
        c = turn()
        data = read(c, ideal_mg(c) + np.outer(3.0 * np.cos(4 * c.angle_rad), [1.0, 0.0]))
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        (panel,) = [p for p in self.left(data, terms=[wave]) if shown([p]) == [("angle", "residual_x")]]
        np.testing.assert_allclose(panel.x, np.arange(24) * 15.0, atol=1e-9)
        np.testing.assert_allclose(panel.before, 3.0 * np.cos(4 * c.angle_rad), atol=1e-3)
        np.testing.assert_allclose(panel.after, 0.0, atol=1e-3)

    def test_covariates_are_drawn_in_the_units_of_their_axes(self) -> None:
        c = turn()
        history = np.linspace(-100, 1600, 1701)
        c = replace(
            c,
            previous_angle_rad=np.roll(c.angle_rad, 1),
            temperature_history=(history, 25 + 1e-5 * history**2),
            variance_mg2=np.outer(np.arange(24), [1.0, 3.0]),
        )
        names = ("previous_angle", "temperature_rate", "variance", "order")
        x = {panel.covariate: panel.x for panel in self.left(noisy(c, 25), *names)}
        np.testing.assert_allclose(x["previous_angle"], np.roll(np.arange(24) * 15.0, 1), atol=1e-9)
        # 2e-5 °C/s² for t s, in °C/min.
        np.testing.assert_allclose(x["temperature_rate"], 60 * 2e-5 * c.time_s, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(x["variance"], 2.0 * np.arange(24))
        np.testing.assert_allclose(x["order"], np.arange(24))

    def test_what_was_not_recorded_is_not_drawn(self) -> None:
        names = ("temperature_rate", "variance", "force", "rotation", "approach", "previous_angle")
        assert {panel.covariate for panel in self.left(noisy(turn(), 25), *names)} == {"angle", "time"}

    def test_of_gyros_force_and_rotation_are_drawn_by_the_component_that_moves_most(self) -> None:
        rng = np.random.default_rng(26)
        force, rate = rng.normal(size=(12, 3)) * [0.1, 5.0, 0.2], rng.normal(size=(12, 3)) * [1, 2, 30]
        c = Conditions(60.0 * np.arange(12), force_g=force, rate_dps=rate)
        gyros = from_means(
            rate + rng.normal(size=(12, 3)), np.tile(np.eye(3), (12, 1, 1)), c, measurement=MeanRate()
        )
        drawn = {panel.covariate: panel for panel in self.left(gyros, "force", "rotation")}
        np.testing.assert_allclose(drawn["force"].x, force[:, 1])
        np.testing.assert_allclose(drawn["rotation"].x, rate[:, 2])
        assert "reading_z" in drawn
        np.testing.assert_allclose(drawn["reading_z"].x, gyros.mean[:, 2] / 100.0)


def accused(position: int, finding: Any, *names: str, error_deg: float = 1.0, others: Any = ()) -> Any:
    """A position that is not where it was declared (10° a position)."""
    said = tuple(Named(name, (position,), 0.9) for name in (names or (finding,)))
    angle = (10.0 * position, 0.1)
    return PositionFinding(
        position, finding, 10.0 * position, angle, None, angle, (error_deg, 0.1), None, others, 0.99, said
    )


class TestPositions:
    """What gravity and gyro say of positions, in one story with the trace."""

    OF_ONE_DWELL = ("outlier_dwell[xy]", "position_slip")

    def stood_deg(self, data: Readings, *findings: PositionFinding) -> np.ndarray:
        """By how much the angles of the readings are moved."""
        stood = correct_slips(data, findings)
        assert stood.conditions is data.conditions
        return np.degrees(stood.angle_rad - data.angle_rad)

    def test_gross_slips_that_last_are_taken_out_of_all_that_follows_and_add_up(self) -> None:
        data = noisy(turn(5), 27)
        slips = (
            accused(1, "slipped", error_deg=5.0, others=(2, 3, 4)),
            accused(4, "slipped", error_deg=-20.0),
            accused(2, "mistyped", error_deg=7.0),
        )
        np.testing.assert_allclose(self.stood_deg(data, *slips), [0, 5, 5, 5, -15], atol=1e-9)

    def test_a_slip_is_taken_out_where_it_shortens_a_reading_by_its_uncertainty(self) -> None:
        data = noisy(turn(5), 27)
        reach = math.degrees(math.acos(1 - float(np.sqrt(data.variance_of_mean[0])) / G))
        slips = [accused(1, "slipped", error_deg=times * reach, others=(2, 3, 4)) for times in (0.98, 1.02)]
        assert [bool(self.stood_deg(data, slip).any()) for slip in slips] == [False, True]

    @pytest.mark.parametrize(("exact", "taken_out"), [(12, False), (13, True)])
    def test_a_slip_is_taken_out_where_it_shortens_most_of_the_readings_by_their_uncertainty(
        self, exact: int, taken_out: bool
    ) -> None:
        # Off by 1°, a reading is 0.15 mg shorter along its old direction.
        u = np.where(np.arange(24) < exact, 0.1, 0.2)
        data = replace(noisy(turn(24), 27), own_covariance=u[:, None, None] ** 2 * np.eye(2))
        assert self.stood_deg(data, accused(1, "slipped", error_deg=1.0)).any() == taken_out

    def test_without_a_slip_that_lasts_the_readings_stay_as_they_are(self) -> None:
        data = noisy(turn(5), 27)
        assert correct_slips(data, (accused(1, "mistyped", error_deg=7.0),)) is data

    @pytest.mark.parametrize(
        ("finding", "names", "gone"),
        [
            # The reading is right where the entry is wrong; it may be wrong where gravity may be.
            ("mistyped", ("mistyped",), {"outlier_dwell"}),
            ("misset", ("misset",), {"outlier_dwell"}),
            ("swapped", ("swapped",), {"outlier_dwell"}),
            ("misset", ("misset", "gravity_wrong"), set()),
            ("gravity_wrong", ("gravity_wrong", "misset"), set()),
            # It stood where it was declared where only gravity can be wrong.
            ("gravity_wrong", ("gravity_wrong",), {"position_slip"}),
            ("slipped", ("slipped",), set()),
            ("gyro_wrong", ("gyro_wrong",), set()),
        ],
    )
    def test_effects_of_one_dwell_are_ruled_out_by_its_three_angles(
        self, finding: str, names: tuple[str, ...], gone: set[str]
    ) -> None:
        data = replace(noisy(turn(), 27), position=np.arange(24) + 100)
        terms = labelled(data, *(f"{name}(dwell={k})" for name in self.OF_ONE_DWELL for k in range(24)))
        left = restrict_candidates(terms, data, (accused(105, finding, *names),))
        assert {term.label for term in terms} - {term.label for term in left} == {
            term.label for term in terms if term.name in gone and term.dwell == 5
        }

    @pytest.mark.parametrize(
        ("finding", "times", "begins"),
        [
            ("misset", 1.02, True),
            ("misset", 0.98, False),  # the linear problem reaches it
            ("mistyped", -1.02, True),
            ("swapped", 1.02, True),
            ("slipped", 1.02, False),  # taken out of all that follows
            ("gravity_wrong", 1.02, False),
        ],
    )
    def test_a_slip_out_of_the_linear_problem_s_reach_begins_at_the_size_that_the_angles_show(
        self, finding: str, times: float, begins: bool
    ) -> None:
        data = replace(noisy(turn(), 27), position=np.arange(24) + 100)
        reach = math.degrees(math.acos(1 - float(np.sqrt(data.variance_of_mean[0])) / G))
        shown = (accused(105, finding, "gravity_wrong", "misset", error_deg=times * reach),)
        terms = labelled(data, "bias[xy]", "position_slip(dwell=4)", "position_slip(dwell=5)")
        left = restrict_candidates(terms, data, shown)
        # ψ = α − θ: what stands further on has a negative slip.
        assert [term.begins for term in left] == pytest.approx([0.0, 0.0, -times * reach * begins])

    def test_what_is_wrong_with_a_check_dwell_is_none_of_the_candidates_business(self) -> None:
        data = noisy(turn(), 27)
        terms = labelled(data, "bias[xy]", "position_slip(dwell=5)", "outlier_dwell[xy](dwell=5)")
        assert restrict_candidates(terms, data, (accused(105, "misset"),)) == terms

    def test_without_an_order_no_effect_of_one_dwell_is_there_to_be_ruled_out(self) -> None:
        data = noisy(turn(order=None), 27)
        terms = labelled(data, "bias[xy]")
        assert restrict_candidates(terms, data, (accused(5, "mistyped"),)) == terms

    def result(self) -> TraceResult:
        figures = ErrorFigures(1.0, None, None, None)
        return TraceResult(True, (), (), figures, figures, advice=("measure on",), notes=("a note",))

    def test_a_trace_begins_with_how_positions_are_put_right(self) -> None:
        findings = (
            accused(1, "slipped", error_deg=5.0, others=(2, 3)),
            accused(5, "mistyped"),
            accused(7, "gravity_wrong"),
            accused(9, "gyro_wrong"),
        )
        positions = findings
        told = with_positions(self.result(), noisy(turn(), 27), positions)
        assert told.position_findings == findings
        assert told.advice == (
            "look at what was written down; then trace again with --angles 5=50",
            "repeat position 1 to 3, 7, 9",
            "measure on",
        )
        assert told.notes[:-1] == ("a note", *sentences_of(positions))
        assert told.notes[-1].startswith("traced as the part stood: +5.00° from position 1 on")

    def test_where_all_can_be_put_right_no_position_is_repeated_and_the_other_way_round(self) -> None:
        (first, _) = with_positions(self.result(), noisy(turn(), 27), (accused(5, "mistyped"),)).advice
        assert first.endswith("--angles 5=50")
        advice = with_positions(self.result(), noisy(turn(), 27), (accused(7, "gravity_wrong"),)).advice
        assert advice == ("repeat position 7", "measure on")

    def test_of_a_session_without_a_wrong_position_nothing_more_is_said(self) -> None:
        result = self.result()
        assert with_positions(result, noisy(turn(), 27), ()) is result


class TestFindings:
    """The figures of a finding, against least squares by hand."""

    def test_a_bias_is_the_mean_and_its_uncertainty_that_of_a_mean(self) -> None:
        # In equal steps a constant is at right angles to gains, misalignment and start angle.
        data = biased()
        found = finding_of(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), "bias")
        assert (found.effect, found.axes) == ("bias", ("x", "y"))
        for axis, name in enumerate(("bias_x", "bias_y")):
            value = found.parameters[name]
            assert value.value == pytest.approx(data.mean[:, axis].mean(), abs=0.02)
            assert value.u == pytest.approx(U / math.sqrt(24), rel=1e-3)
            assert (value.unit, value.dof) == ("mg", math.inf)
        assert "zero without acceleration" in found.cause
        assert found.probability == 1.0

    @pytest.mark.parametrize("inflation", [1.0, 2.0])
    def test_p_is_that_of_what_it_takes_over_its_share_of_the_prior(self, inflation: float) -> None:
        data = biased(mg=(0.08, 0.0))
        selection = chosen(data, labelled(data, "bias[x]"), ((0,), 1.0))
        found = finding_of(replace(selection, inflation=inflation), "bias")
        # Six times as likely as another effect of 7 in 400, in three variants.
        share = 6 * 7 / 400 / 3
        taken = 24 * (data.mean[:, 0].mean() / U) ** 2
        assert found.p_value == pytest.approx(stats.chi2.sf(taken / inflation, 1) / share, rel=0.02)
        assert found.p_value < 1
        assert found.parameters["bias_x"].u == pytest.approx(U * math.sqrt(inflation / 24), rel=1e-3)

    def test_p_is_never_above_one(self) -> None:
        data = biased(mg=(0.0, 0.0))
        assert finding_of(chosen(data, labelled(data, "bias[x]"), ((0,), 1.0)), "bias").p_value == 1.0

    def test_it_is_as_probable_as_models_that_have_it_or_what_stands_for_it(self) -> None:
        data = biased(mg=(0.1, 0.0))
        selection = chosen(data, labelled(data, "bias[x]", "quadratic[y]"), ((0,), 0.7), ((), 0.3))
        assert finding_of(selection, "bias").probability == pytest.approx(0.7)

    def test_its_choices_stand_among_its_parameters(self) -> None:
        data = biased()
        terms = labelled(data, "bias[xy]", "outlier_dwell[x](dwell=7)")
        found = finding_of(chosen(data, terms, ((0, 1), 1.0)), "outlier_dwell")
        assert found.parameters["dwell"] == Value(7.0, None, "1")
        assert found.axes == ("x",)

    def test_what_the_session_does_not_show_is_zero_without_an_uncertainty(self) -> None:
        shaken = np.outer(np.random.default_rng(32).uniform(1, 5, 24), [1.0, 0.0])
        data = noisy(turn(variance_mg2=shaken), 32)
        (term,) = labelled(data, "vibration_rectification[xy]")
        (seen, unseen) = finding_of(chosen(data, [term], ((0,), 1.0)), term.name or "").parameters.values()
        assert seen.u is not None
        assert (unseen.value, unseen.u) == (0.0, None)

    def test_models_that_predict_the_same_without_it_are_named_beside_it(self) -> None:
        data = biased()
        terms = labelled(data, "bias[x]", "bias[xy]", "quadratic[x]", "cubic[x]")
        selection = chosen(data, terms, ((0,), 1.0))
        k = {term.label: k for k, term in enumerate(selection.problem.terms)}
        alike = [
            (k["bias[xy]"],),
            (k["quadratic[x]"], k["cubic[x]"]),
            (k["quadratic[x]"],),
            (k["quadratic[x]"], k["cubic[x]"]),
        ]
        verdict = replace(selection.verdict, same={selection.verdict.best: alike})
        found = finding_of(replace(selection, verdict=verdict), "bias")
        assert found.equivalents == ("cubic + quadratic", "quadratic")

    def test_names_that_predict_the_same_beside_as_many_causes_count_with_it(self) -> None:
        # In a plane the squares of both readings add up to a constant.
        data = biased()
        curve = np.outer(np.cos(np.radians(3.0) - data.conditions.angle_rad) ** 2, [2.0, 0.0])
        data = replace(data, mean=data.mean + curve)
        terms = labelled(data, "bias[xy]", "quadratic[x]", "cross_quadratic[x]", "cubic[x]")
        selection = chosen(data, terms, ((0, 1), 0.5), ((0, 2), 0.3), ((3,), 0.2))
        verdict = selection.verdict
        alike = [model for models in (verdict.weights, *verdict.same.values()) for model in models]
        same = {verdict.best: [model for model in alike if model != verdict.best]}
        selection = replace(selection, verdict=replace(verdict, same=same))
        assert finding_of(selection, "quadratic").probability == pytest.approx(0.5)
        assert probability_of_equals(selection, "quadratic") == pytest.approx(0.3)
        assert probability_of_equals(selection, "bias") == 0.0

    def test_an_amplitude_is_as_uncertain_as_probable_models_differ_on_it(self) -> None:
        # In the other model a curvature of x, which is half a constant, takes its part of the bias.
        data = biased(mg=(5.0, 0.0))
        curve = np.outer(np.cos(np.radians(3.0) - data.conditions.angle_rad) ** 2, [1.0, 0.0])
        data = replace(data, mean=data.mean + 0.2 * curve)
        terms = labelled(data, "bias[x]", "quadratic[x]")
        selection = replace(chosen(data, terms, ((0,), 0.5), ((0, 1), 0.5)), inflation=1.0)
        value = finding_of(selection, "bias").parameters["bias_x"]
        base = base_and_bias(data.conditions)[..., :5]
        both = np.linalg.lstsq(
            np.concatenate([base, curve[:, :, None]], axis=2).reshape(48, 6),
            (data.mean - ideal_mg(data.conditions)).ravel(),
            rcond=None,
        )[0]
        away, u = both[4] - value.value, U / math.sqrt(24)
        assert abs(away) > u, "or the other model says the same"
        half = stats.norm.ppf(0.975) * (value.u or 0)
        inside = [stats.norm.cdf((half - d) / u) - stats.norm.cdf((-half - d) / u) for d in (0.0, away)]
        assert np.mean(inside) == pytest.approx(0.95, abs=0.003)

    @pytest.mark.parametrize(
        ("known", "inflation", "left", "dof"),
        [
            (True, 1.0, 30.0, 200.0),  # the noise of the dwells
            (True, 2.0, 30.0, 30.0),  # what the model leaves, where that is the noise
            (True, 2.0, 300.0, 200.0),
            (False, 1.0, 30.0, 30.0),
            (False, 1.0, 0.0, 1.0),
        ],
    )
    def test_uncertainties_have_the_freedom_of_what_shows_the_noise(
        self, known: bool, inflation: float, left: float, dof: float
    ) -> None:
        data = SimpleNamespace(noise_known=known, noise_dof=200.0)
        selection: Any = SimpleNamespace(data=data, inflation=inflation, fit=SimpleNamespace(dof=left))
        assert dof_of(selection) == dof

    def test_scatter_is_as_probable_as_its_odds(self) -> None:
        scatter = Scatter("fixture_scatter", 0.02, 0.003, 0.01, math.log(19), 1e-4, "deg")
        found = scatter_finding(scatter, 0.4)
        assert found.probability == pytest.approx(0.95)
        assert found.parameters == {"scatter": Value(0.02, 0.003, "deg")}
        assert (found.effect, found.explains, found.p_value) == ("fixture_scatter", 0.4, 1e-4)

    def test_a_bias_in_counts_is_the_reading_at_zero(self) -> None:
        counts = Unit("counts", np.array([100.0, 200.0]), np.array([2.0, -4.0]))
        bias = Finding(
            "bias",
            ("x", "y"),
            {"bias_x": Value(1.0, None, "mg", 9.0), "bias_y": Value(3.0, 0.5, "mg", 9.0)},
            0.0,
            0.0,
            1.0,
        )
        told = in_units_of_file(bias, counts).parameters
        assert told["bias_x"] == Value(102.0, None, "counts", 9.0)
        assert told["bias_y"].value == 188.0
        assert abs(told["bias_y"].u or 0) == 2.0
        assert in_units_of_file(bias, replace(counts, name="mg")) is bias
        cubic = replace(bias, effect="cubic")
        assert in_units_of_file(cubic, counts) is cubic


class TestTheWhole:
    """What the result says of the session besides its findings."""

    figures = ErrorFigures(1.0, None, None, None)

    def result(self, *fits: Any, found: Sequence[str] = ()) -> TraceResult:
        findings = tuple(Finding(name, (), {}, 0.0, 0.0, 1.0) for name in found)
        return TraceResult(True, findings, (), self.figures, self.figures, fits=fits)

    def fit(self, recorded: bool, *covariates: str) -> Any:
        """As much of a fit as is looked at: terms by their covariates, dwells at 30 and 33 °C."""
        c = Conditions(np.arange(2.0), temperature_c=np.array([30.0, 33.0]) if recorded else None)
        terms = [named(None, covariates=(name,)) for name in covariates]
        data = SimpleNamespace(conditions=c, model=SimpleNamespace(part="gyro"))
        return SimpleNamespace(data=data, terms=terms)

    def test_parameters_hold_at_25_degrees_where_the_final_model_follows_the_temperature(self) -> None:
        plain, warm = self.fit(True, "time"), self.fit(True, "time", "temperature")
        for fits, expected in (
            ((warm,), 25.0),
            ((plain, warm), 25.0),
            ((plain,), 31.5),
            ((warm, plain), 31.5),  # an average may take the place of what a step before it had
            ((self.fit(False),), None),
        ):
            assert self.result(*fits).reference_temperature_c == expected

    def test_without_fits_they_hold_at_25_degrees_where_an_effect_of_the_temperature_was_found(
        self,
    ) -> None:
        for name in ("bias_temperature", "thermal_lag"):
            assert self.result(found=[name, "warm_up"]).reference_temperature_c == 25.0
        assert self.result(found=["warm_up"]).reference_temperature_c is None

    def test_the_part_is_that_of_the_readings_and_without_fits_the_accelerometer(self) -> None:
        fit = self.fit(True)
        assert self.result(fit).part == self.result(fit, fit).part == "gyro"
        assert self.result().part == "accelerometer"


class TestBaseAndRivals:
    def test_base_parameters_are_those_of_least_squares(self) -> None:
        data = biased()
        terms = labelled(data, "bias[xy]", "quadratic[x]", "cubic[x]")
        base = base_of(chosen(data, terms, ((0,), 1.0)))
        assert "bias_x" not in base
        # Equal steps: a gain is known as 24/2 readings of G know it, the start angle as 24 do.
        for axis, name in enumerate(("scale_x", "scale_y")):
            assert base[name].u == pytest.approx(U / G / math.sqrt(12), rel=1e-3)
            wave = [np.cos, np.sin][axis](math.radians(base["alpha"].value) - data.conditions.angle_rad)
            assert base[name].value == pytest.approx(wave @ data.mean[:, axis] / 12 / G, abs=1e-7)
        start = math.atan2(*(data.mean[:, 0] @ f(data.conditions.angle_rad) for f in (np.sin, np.cos)))
        assert base["alpha"].value == pytest.approx(math.degrees(start), abs=1e-4)
        assert base["alpha"].u == pytest.approx(math.degrees(U / G / math.sqrt(12)), rel=1e-3)
        rough = base_of(replace(chosen(data, terms, ((0,), 1.0)), inflation=4.0))
        assert rough["scale_x"].u == pytest.approx(2 * (base["scale_x"].u or 0))

    def test_a_base_parameter_that_is_not_seen_is_nominal_without_an_uncertainty(self) -> None:
        data = replace(biased(), fitted=np.array([True, True, False, True]))
        base = base_of(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)))
        assert (base["scale_y"].value, base["scale_y"].u) == (1.0, None)
        assert base["scale_x"].u is not None

    def test_a_cubic_that_may_be_there_moves_the_gain_as_a_fit_with_it_does(self) -> None:
        data = biased()
        terms = labelled(data, "bias[xy]", "cubic[x]")
        models = ((0,), (0, 1))
        selection = chosen(data, terms, *((model, 0.5) for model in models))
        spread = base_mixture(selection)
        (cubic,) = (
            selection.problem.prior_of(k)[0, 0]
            for k, t in enumerate(selection.problem.terms)
            if t.name == "cubic"
        )
        gains = [base_of(chosen(data, terms, (model, 1.0)))["scale_x"].value for model in models]
        moved = spread.away[:, data.model.names.index("scale_x")]
        assert abs(gains[1] - gains[0]) > 1e-6
        # The cubic is known to 5 mg/g³ and has a prior of 50, which its own fit has not: a hundredth less.
        expected = (gains[1] - gains[0]) * (1 - cubic)
        assert sorted(moved) == pytest.approx(sorted([0.0, expected]), abs=1e-8)

    def test_rivals_are_the_eight_best_models_in_words(self) -> None:
        problem = names_only(*"abcdefghij")
        terms = [SimpleNamespace(**{**vars(t), "label": f"{t.name}[x]"}) for t in problem.terms]
        weights = {(k,): 0.01 * (k + 1) for k in range(10)}
        selection = believed(replace(problem, terms=tuple(terms)), weights)
        rivals = rivals_of(selection)
        assert [rival.terms for rival in rivals] == [(f"{letter}[x]",) for letter in "jihgfedc"]
        assert rivals[0].probability == pytest.approx(0.10 / 0.55)


class TestWhatHasNoName:
    wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
    drift = function("drift", lambda c: c.time_s / 1e3, ("time",))

    def test_functions_of_the_model_are_said_with_the_least_probable_of_them(self) -> None:
        c = turn()
        wave = read(c, ideal_mg(c) + np.outer(0.1 * np.cos(4 * c.angle_rad), [1.0, 0.0]))
        data = replace(wave, mean=wave.mean + np.outer(0.4 * c.time_s / 1e3, [1.0, 0.0]))
        selection = chosen(data, [self.wave, self.drift], ((0, 1), 0.6), ((0,), 0.4))
        told = unnamed_of(selection, None)
        assert told is not None
        assert set(told.covariates) == {"angle", "time"}
        assert set(told.form.split("; ")) == {"bias of x follows wave", "bias of x follows drift"}
        assert told.probability == pytest.approx(0.6)
        alone = unnamed_of(chosen(wave, [self.wave, self.drift], ((0,), 1.0)), None)
        assert alone is not None
        # χ² of a wave of 0.1 mg beside the base model, over e^−5 of the prior.
        assert alone.p_value == pytest.approx(stats.chi2.sf(12.0, 1) * math.exp(5.0), rel=0.01)

    def test_a_function_that_explains_nothing_has_a_p_of_one(self) -> None:
        data = biased(mg=(0.0, 0.0))
        told = unnamed_of(chosen(data, [self.wave], ((0,), 1.0)), None)
        assert told is not None
        assert told.p_value == 1.0

    def test_an_average_is_said_with_what_is_left_for_no_function_at_all(self) -> None:
        data = biased()
        selection = chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0))
        averaged: Any = SimpleNamespace(smooth=self.drift, weight=0.8)
        told = unnamed_of(selection, averaged)
        assert told is not None
        assert (told.covariates, told.form) == (("time",), "bias of x follows drift")
        assert (told.probability, told.p_value) == (0.8, pytest.approx(0.2))

    def test_a_model_of_names_leaves_nothing_without_one_however_badly_it_fits(self) -> None:
        data = noisy(turn(), 33)
        selection = chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0))
        for adequate in (True, False):
            assert unnamed_of(replace(selection, adequate=adequate), None) is None

    def test_its_share_is_that_of_its_steps(self) -> None:
        selection = chosen(biased(), [self.wave], ((0,), 1.0))
        run: Any = SimpleNamespace(selection=selection, averaged=None, judged=None, functions_checked=True)
        stepped = TraceRun.unnamed(run, {"bias": 0.7, "unnamed: a": 0.1, "unnamed: b": 0.05})
        assert stepped is not None
        assert stepped.explains == pytest.approx(0.15)
        assert TraceRun.unnamed(run, {"bias": 0.7}) == unnamed_of(selection, None)
        run.functions_checked = False
        unchecked = TraceRun.unnamed(run, {})
        assert unchecked is not None
        assert unchecked.probability == limits.certain


class TestExcess:
    def test_it_is_chi2_beyond_its_freedom_and_never_less_than_nothing(self) -> None:
        fits: Any = [SimpleNamespace(dof=40), SimpleNamespace(dof=38)]
        figures = [ErrorFigures(3.0, None, None, 2.5), ErrorFigures(2.0, None, None, 0.8)]
        assert excesses(fits, figures) == [60.0, 0.0]

    def test_without_known_noise_it_is_the_square_of_the_residual(self) -> None:
        fits: Any = [SimpleNamespace(dof=40), SimpleNamespace(dof=38)]
        figures = [ErrorFigures(3.0, None, None, 2.5), ErrorFigures(2.0, None, None, None)]
        assert excesses(fits, figures) == [9.0, 4.0]

    def test_findings_have_the_share_of_their_step(self) -> None:
        found = [Finding(name, (), {}, 0.0, 0.5, 1.0) for name in ("bias", "cubic")]
        data: Any = SimpleNamespace(unit=SimpleNamespace(known=True))
        assert [one.explains for one in shown_findings(found, data, None, {"bias": 0.75})] == [0.75, 0.0]


class TestNotes:
    def said(self, scatter: Scatter | None = None, **others: Any) -> tuple[str, ...]:
        data = replace(biased(), notes=("from the file",))
        selection = chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0))
        return notes_of(replace(selection, **others), scatter)

    def test_of_an_adequate_model_only_the_readings_own_notes_are_said(self) -> None:
        assert self.said() == ("from the file",)

    def test_what_was_taken_for_noise_is_said_where_no_model_explains_it(self) -> None:
        (_, note) = self.said(inflation=9.0, adequate=False)
        assert "against 3 times that noise" in note
        assert self.said(inflation=1.0, adequate=False) == ("from the file",)
        assert self.said(inflation=9.0, adequate=True) == ("from the file",)

    @pytest.mark.parametrize(
        ("kind", "unit", "facts"),
        [
            ("fixture_scatter", "deg", ("0.02°", "0.01°", "fixture")),
            ("reading_scatter", "mg", ("0.02 mg", "0.01 mg", "noise of a reading")),
        ],
    )
    def test_scatter_is_said_in_its_unit_and_the_noise_not_once_more(
        self, kind: Any, unit: str, facts: tuple[str, ...]
    ) -> None:
        scatter = Scatter(kind, 0.02, 0.001, 0.01, 3.0, 0.01, unit)
        (_, note) = self.said(scatter, inflation=9.0, adequate=False)
        assert all(fact in note for fact in facts)

    def test_noise_that_is_not_known_is_said(self) -> None:
        data = replace(biased(), noise_known=False)
        selection = chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0))
        (note,) = notes_of(replace(selection, inflation=9.0, adequate=False), None)
        assert "noise of a reading" in note
        assert "adequacy" in note

    def test_cycles_that_equal_steps_cannot_tell_apart_are_said(self) -> None:
        # n cycles look like k·24 ± n at 24 equal steps.
        c = turn()
        data = read(c, ideal_mg(c, 0.1 * np.cos(5 * c.angle_rad)))
        terms = labelled(data, "stage_periodic(cycles=4)", "stage_periodic(cycles=5)")
        selection = chosen(data, terms, ((1,), 1.0))
        assert cycles_alike(selection) == [(5, (19, 29, 43, 53, 67))]
        assert "5 cycles a turn of the stage look like 19, 29, 43, 53, 67" in notes_of(selection, None)[0]

    @pytest.mark.parametrize(
        ("steps", "others"),
        [(25, (22, 28, 47, 53, 72)), (23, (20, 26, 43, 49, 66)), (24, (21, 27, 45, 51, 69))],
    )
    def test_cycles_alike_are_said_up_to_72_and_no_more_than_five(
        self, steps: int, others: tuple[int, ...]
    ) -> None:
        c = turn(steps)
        data = read(c, ideal_mg(c, 0.1 * np.cos(3 * c.angle_rad)))
        selection = chosen(data, labelled(data, "stage_periodic(cycles=3)"), ((0,), 1.0))
        assert cycles_alike(selection) == [(3, others)]

    def test_cycles_of_like_scores_are_said_and_those_of_far_worse_ones_are_not(self) -> None:
        angles = np.random.default_rng(34).uniform(0, 360, 30)
        c = turn(angles_deg=angles)
        for size_deg, alone in ((0.1, True), (0.0, False)):
            data = read(c, ideal_mg(c, size_deg * np.cos(5 * c.angle_rad)))
            terms = labelled(data, *(f"stage_periodic(cycles={n})" for n in (5, 6, 7)))
            told = cycles_alike(chosen(data, terms, ((0,), 1.0)))
            assert told == ([] if alone else [(5, (6, 7))])


class TestDetectable:
    """Amplitudes that are found nine times in ten, by least squares beside the model."""

    def u_of(self, c: Conditions, column: np.ndarray, *, bias: bool) -> float:
        """Standard uncertainty of an amplitude beside the base model (and a bias)."""
        base = base_and_bias(c)[..., : 6 if bias else 4] * [1, 1, 1, 1, 1e-3, 1e-3][: 6 if bias else 4] * G
        rows = np.concatenate([base, column[:, :, None]], axis=2).reshape(-1, base.shape[2] + 1)
        return U * math.sqrt(np.linalg.inv(rows.T @ rows)[-1, -1])

    def power(self, figure: float, u: float, price: float, inflation: float = 1.0) -> float:
        """How often a score of that mean exceeds its price."""
        root = math.sqrt(inflation)
        return float(stats.norm.sf(math.sqrt(2 * price) - figure / u / root))

    @pytest.mark.parametrize("inflation", [1.0, 4.0])
    def test_an_amplitude_is_found_with_ninety_percent(self, inflation: float) -> None:
        c = turn()
        data = noisy(c, 35)
        terms = labelled(data, "quadratic[x]", "quadratic[xy]", "bias[xy]")
        psi = np.radians(3.0) - c.angle_rad
        curve = np.outer(np.cos(psi) ** 2, [1.0, 0.0])
        for model, bias in (((2,), True), ((), False), ((0, 2), True)):
            selection = chosen(data, terms, (model, 1.0))
            found = replace(selection.found, inflation=inflation)
            told = detectable(found, selection.verdict.best, {})["quadratic"]
            price = float(
                found.prices[
                    next(k for k, t in enumerate(found.problem.terms) if t.label == "quadratic[x]")
                ]
            )
            assert told.amplitude is not None
            u = self.u_of(c, curve, bias=bias)
            assert self.power(told.amplitude, u, price, inflation) == pytest.approx(0.9, abs=0.005)
            assert (told.parameter, told.unit, told.reason) == ("k2_x", "mg/g²", "")

    def test_of_dwells_the_median_and_of_axes_the_worst_is_said(self) -> None:
        c = turn(angles_deg=np.sort(np.random.default_rng(36).uniform(0, 360, 11)))
        data = noisy(c, 36)
        data = replace(data, own_covariance=data.own_covariance * np.diag([1.0, 9.0]))
        labels = [f"outlier_dwell[{axis}](dwell={k})" for axis in "xy" for k in range(11)]
        selection = chosen(data, labelled(data, *labels), ((), 1.0))
        each = []
        base = base_and_bias(c)[..., :4] / np.array([1.0, 3.0])[:, None]
        rows = base.reshape(-1, 4) * G / U
        prices = dict(zip((t.label for t in selection.problem.terms), selection.found.prices, strict=True))
        for k in range(11):
            column = np.zeros((11, 2))
            column[k, 1] = 1 / (3 * U)
            whole = np.column_stack([rows, column.ravel()])
            u = math.sqrt(np.linalg.inv(whole.T @ whole)[-1, -1])
            each.append(u * (math.sqrt(2 * prices[f"outlier_dwell[y](dwell={k})"]) + stats.norm.ppf(0.9)))
        told = detectable(selection.found, (), {})["outlier_dwell"]
        assert told.amplitude == pytest.approx(np.median(each), rel=0.01)
        assert told.parameter.endswith("_y")

    def test_why_an_effect_cannot_be_seen_is_said(self) -> None:
        data = biased()
        fitted = function("same", lambda c: c.supply_v - 5.0, ("supply",))
        terms = [*labelled(data, "supply_bias[x]", "quadratic[x]"), fitted]
        selection = chosen(data, terms, ((2,), 1.0))
        creep = Detectable(None, "", "", "not recorded")
        told = detectable(selection.found, selection.verdict.best, {"creep": creep})
        assert told["creep"] is creep
        assert told["supply_bias"].amplitude is None
        assert told["supply_bias"].reason == "lies in what is fitted already"
        assert told["cubic"].reason == "lies in the base model: this session cannot show it"
        assert told["quadratic"].amplitude is not None


class TestSets:
    def test_two_names_that_are_likelier_pieces_of_one_function_have_one_set(self) -> None:
        terms = [named("cubic", covariates=("angle",)), named("gravity", covariates=("angle",))]
        terms.append(named(None, covariates=("angle",)))
        rows = np.eye(4)
        problem = single(9 * rows.sum(axis=0), rows[:3], terms)
        for share, leads in ((0.8, ["unnamed: angle"]), (0.2, ["cubic", "gravity"])):
            selection = believed(problem, {(0, 1): 1 - share, (0, 1, 2): share}, terms=terms[:2])
            every = credible_sets(selection)
            sets = merge_by_function(every, likelier_functions(every, terms[:2]))
            assert [one.names[0] for one in sets] == leads
            assert sets[0].cause == "cubic"
            assert likelier_functions(every, []) == {}, "only names have something in their place"
            assert sets[0].as_dict() == {
                "names": list(sets[0].names),
                "probability": [pytest.approx(max(share, 1 - share)), pytest.approx(min(share, 1 - share))],
                "present": 1.0,
            }

    def test_a_cause_that_no_likely_model_has_is_not_there(self) -> None:
        selection = believed(names_only("cubic"), {(0,): 1e-9, (): 1.0})
        assert votes(selection, "cubic") == ({"cubic": 1.0}, 0.0)

    def test_a_function_without_a_name_is_a_cause_by_its_covariates(self) -> None:
        terms = [named(None, covariates=("angle",)), named("warm_up", covariates=("time",))]
        rows = np.eye(3)
        problem = single(9 * rows.sum(axis=0), rows[:2], terms)
        share, present = votes(believed(problem, {(0,): 0.6, (1,): 0.3, (): 0.1}), "unnamed: angle")
        assert share == pytest.approx({"unnamed: angle": 2 / 3, "warm_up": 1 / 3})
        assert present == pytest.approx(0.9)

    def test_a_model_with_a_function_of_its_own_is_no_piece_of_the_smooth_one_beside_it(self) -> None:
        data = biased()
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        terms = [*labelled(data, "quadratic[x]"), wave]
        averaged: Any = SimpleNamespace(smooth=replace(wave, label="smooth"), weight=0.5)
        with_own = chosen(data, terms, ((0, 1), 0.4), ((0,), 0.6))
        share, _ = votes(with_own, "quadratic", averaged)
        assert share == pytest.approx({"quadratic": 0.6, "unnamed: angle": 0.4})
        without = chosen(data, terms, ((0,), 1.0))
        share, _ = votes(without, "quadratic", averaged)
        assert share == pytest.approx({"quadratic": 0.5, "unnamed: angle": 0.5})

    def test_a_model_with_two_others_in_the_place_votes_for_both_by_what_they_add(self) -> None:
        # The cause adds (3, 4, 0)/5 of its size: one stands for its first row, the other for its second.
        rows = [[0.6, 0.8, 0], [1, 0, 0], [0, 1, 0]]
        problem = single([6, 8, 0], rows, [named("cubic"), named("warm_up"), named("backlash")])
        share, _ = votes(believed(problem, {(0,): 0.5, (1, 2): 0.5}), "cubic")
        assert share["cubic"] == pytest.approx(0.5)
        assert share["warm_up"] == pytest.approx(0.5 * 0.36, rel=1e-3)
        assert share["backlash"] == pytest.approx(0.5 * 0.64, rel=1e-3)
