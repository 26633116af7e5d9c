"""What a reader of a trace is shown and told, on sessions and models that are made by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.readings import Readings, Unit, from_means
from adis_gonio.estimation.terms import NamedTerm, Term
from adis_gonio.estimation.values import Value
from adis_gonio.model.effects import Conditions
from adis_gonio.model.rates import MeanRate
from adis_gonio.model.records import Dwell, Session
from adis_gonio.slips import Diagnosis, PositionFinding
from adis_gonio.slips.finding import Named
from adis_gonio.tracing.candidates.named import named_terms
from adis_gonio.tracing.outcome.cycles import cycles_alike
from adis_gonio.tracing.outcome.detect import detectable
from adis_gonio.tracing.outcome.figures import Panel, views_of
from adis_gonio.tracing.outcome.findings import (
    base_of,
    dof_of,
    finding_of,
    in_units_of_file,
    notes_of,
    rivals_of,
    scatter_finding,
    unnamed_of,
)
from adis_gonio.tracing.outcome.positions import as_the_part_stood, ruled_out, with_positions
from adis_gonio.tracing.outcome.result import ErrorFigures, Finding, TraceResult, Unnamed
from adis_gonio.tracing.outcome.sets import credible_sets, votes
from adis_gonio.tracing.outcome.shares import excesses, unnamed_with_share, with_shares
from adis_gonio.tracing.selection.posterior import weigh
from adis_gonio.tracing.selection.scatter import Scatter
from adis_gonio.tracing.selection.select import Selection, select
from tracing.test_trace_numbers import (
    G,
    U,
    base_and_bias,
    believed,
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
        fits.append(fits[0].having(terms, zero).refit())
    steps = tuple(SimpleNamespace(effect=terms[-1].shown_as) for terms in models)
    return SimpleNamespace(fits=tuple(fits), steps=steps, unnamed=unnamed)


def panels(data: Readings, *terms: Term) -> tuple[Panel, ...]:
    """What is drawn of the last of nested steps."""
    nested = [terms[: k + 1] for k in range(len(terms))]
    return views_of(data, steps_of(data, *nested)).steps[-1].panels


def shown(drawn: Sequence[Panel]) -> list[tuple[str, str]]:
    return [(panel.covariate, panel.quantity) for panel in drawn]


def misfit_mg(data: Readings, fit: Fit) -> np.ndarray:
    """Readings minus base model, by the equations of the paper."""
    start, scale_x, scale_y, lean = fit.values.base
    psi = start - data.conditions.angle_rad
    return data.mean - G * np.column_stack([scale_x * np.cos(psi), scale_y * np.sin(psi + lean)])


class TestFiguresOfSteps:
    data = noisy(surroundings(), 21)
    catalogue = MappingProxyType({term.label: term for term in named_terms(data)[0]})

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
        assert [step.effect for step in steps] == ["quadratic", "quadratic"]
        assert [shown(step.panels) for step in steps] == [
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
        (panel,) = views_of(data, result).steps[0].panels
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
        (panel,) = views_of(data, result).steps[0].panels
        # A part that is turned forward by a slip shows an angle that is as much too small.
        others = np.delete(panel.before, 7)
        assert panel.before[7] - others.mean() == pytest.approx(-0.5, abs=0.01)
        assert np.abs(others).max() < 0.05, "none is off by a turn"
        np.testing.assert_allclose(panel.after, 0.0, atol=1e-4)
        np.testing.assert_allclose(panel.u, np.degrees(math.hypot(U / G, 2e-4)), rtol=1e-3)

    def test_dwells_for_checking_are_drawn_beside_those_that_were_fitted(self) -> None:
        check = np.arange(24) % 6 == 5
        every = replace(self.data, check=check)
        training = every.training
        term = self.catalogue["bias_drift[y]"]
        result = steps_of(training, [term])
        (panel,) = views_of(every, result).steps[0].panels
        minutes = every.conditions.time_s / 60
        np.testing.assert_allclose(panel.x, minutes[~check])
        np.testing.assert_allclose(panel.check_x, minutes[check])
        fit = result.fits[-1]
        checking = every.rows(check)
        drift = term.added(fit.values.terms[0], checking.mean, checking.conditions)
        np.testing.assert_allclose(
            panel.check_after, (misfit_mg(checking, fit) - drift)[:, 1], atol=1e-6
        )

    def test_where_the_noise_is_not_known_no_uncertainty_is_drawn(self) -> None:
        data = replace(self.data, known=np.zeros(24, dtype=bool))
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
        (panel,) = panels(data, next(t for k, t in self.catalogue.items() if k.startswith("thermal_lag[y]")))
        assert (panel.covariate, panel.quantity) == ("temperature_lag", "residual_y")
        # Time constant and start are fitted from readings of 0.1 mg: 2 mg/°C say it to some hundredths of °C.
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


def session_at(*angles_deg: float | None) -> Session:
    """Dwells at these angles, of no readings that matter."""
    return Session(
        tuple(
            Dwell(k, np.array([20.0 * k]), np.zeros((1, 2)), angle_deg=angle)
            for k, angle in enumerate(angles_deg)
        ),
        accel_unit="mg",
        sensor="generic",
    )


def accused(position: int, finding: Any, *names: str, error_deg: float = 1.0, others: Any = ()) -> Any:
    """A position that is not where it was declared (10° a position)."""
    said = tuple(Named(name, (position,), 0.9) for name in (names or (finding,)))  # type: ignore[arg-type]
    angle = (10.0 * position, 0.1)
    return PositionFinding(
        position, finding, 10.0 * position, angle, None, angle, (error_deg, 0.1), None, others, 0.99, said
    )


class TestPositions:
    """What gravity and gyro say of positions, in one story with the trace."""

    def test_slips_that_last_are_taken_out_of_all_that_follows_and_add_up(self) -> None:
        session = session_at(0.0, 10.0, 20.0, None, 40.0)
        slips = (
            accused(1, "slipped", error_deg=0.5, others=(2, 3, 4)),
            accused(4, "slipped", error_deg=-2.0),
            accused(2, "mistyped", error_deg=7.0),
        )
        stood = as_the_part_stood(session, Diagnosis(slips))
        assert [dwell.angle_deg for dwell in stood.dwells] == [0.0, 10.5, 20.5, None, 38.5]

    def test_without_a_slip_that_lasts_the_session_stays_as_it_is(self) -> None:
        session = session_at(0.0, 10.0)
        assert as_the_part_stood(session, Diagnosis((accused(1, "mistyped", error_deg=7.0),))) is session

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
        said = ruled_out(data, Diagnosis((accused(105, finding, *names),)))
        assert said == {(name, 5) for name in gone}

    def test_without_an_order_no_effect_of_one_dwell_is_there_to_be_ruled_out(self) -> None:
        data = noisy(turn(order=None), 27)
        assert ruled_out(data, Diagnosis((accused(5, "mistyped"),))) == frozenset()

    def result(self) -> TraceResult:
        figures = ErrorFigures(1.0, None, None, None)
        return TraceResult(True, (), (), (), None, figures, figures, {}, ("measure on",), notes=("a note",))

    def test_a_trace_begins_with_how_positions_are_put_right(self) -> None:
        findings = (
            accused(1, "slipped", error_deg=0.5, others=(2, 3)),
            accused(5, "mistyped"),
            accused(7, "gravity_wrong"),
            accused(9, "gyro_wrong"),
        )
        positions = Diagnosis(findings)
        told = with_positions(self.result(), positions)
        assert told.position_findings == findings
        assert told.advice == (
            "look at what was written down; then trace again with --angles 1-3+=0.5,5=50",
            "repeat position 7, 9",
            "measure on",
        )
        assert told.notes[:-1] == ("a note", *positions.sentences)
        assert told.notes[-1].startswith("traced as the part stood: +0.50° from position 1 on")

    def test_where_all_can_be_put_right_no_position_is_repeated_and_the_other_way_round(self) -> None:
        (first, _) = with_positions(self.result(), Diagnosis((accused(5, "mistyped"),))).advice
        assert first.endswith("--angles 5=50")
        advice = with_positions(self.result(), Diagnosis((accused(7, "gravity_wrong"),))).advice
        assert advice == ("repeat position 7", "measure on")

    def test_of_a_session_without_a_wrong_position_nothing_more_is_said(self) -> None:
        result = self.result()
        assert with_positions(result, Diagnosis()) is result
