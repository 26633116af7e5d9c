"""What each number of the trace means, said so that half or twice of it is noticed.

`scripts/trace_numbers.py` runs each test with the number of `tracing/thresholds.py` that it is marked with
halved and doubled. What is expected stands here in words and figures of its own (docs/testing.md); where
a number is derived it is derived here once more.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import Basis
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate, SessionOrigin
from adis_gonio.tracing.averaging import AveragedTerm, average, processes
from adis_gonio.tracing.credible_sets import Names, judge, set_of, undecided
from adis_gonio.tracing.findings import differs_from_zero
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.joint_trace import stack
from adis_gonio.tracing.linear_problem import linearise, span
from adis_gonio.tracing.named_candidates import cycles_shown, named_terms
from adis_gonio.tracing.scatter import with_scatter
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.trace_result import Finding
from adis_gonio.tracing.validation import (
    Fold,
    cut_worse_steps,
    determined,
    folds,
    guard_errors,
    nest_fits,
    reject_unchecked,
)
from tracing.small_problems import (
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


def prior(terms: Iterable[Any]) -> float:
    """What candidates have of the prior together: e to the minus their price in nats."""
    return sum(math.exp(-term.cost) for term in terms)


class TestPrior:
    """Who is how likely before a reading is seen."""

    data = noisy(surroundings(), 0)

    def share(self, name: str, data: Readings | None = None) -> float:
        return prior(t for t in named_terms(data or self.data)[0] if t.name == name)

    @pytest.mark.number("effect_share")
    @pytest.mark.parametrize("name", ["cubic", "warm_up", "stage_periodic", "outlier_dwell", "backlash"])
    def test_an_effect_is_there_in_seven_sessions_of_four_hundred_however_many_variants_it_has(
        self, name: str
    ) -> None:
        assert self.share(name) == pytest.approx(7 / 400)

    @pytest.mark.number("nameless_share")
    def test_functions_without_a_name_have_three_tenths_together(self) -> None:
        assert prior(nameless_terms(self.data)) == pytest.approx(0.3)
        assert sum(math.exp(-process.cost) for process in processes(self.data)) == pytest.approx(0.3)

    @pytest.mark.number("bias_share")
    @pytest.mark.number("bias_weight")
    def test_nine_parts_in_ten_have_a_bias_on_all_axes_and_few_on_one_alone(self) -> None:
        biases = {term.label: term for term in named_terms(self.data)[0] if term.name == "bias"}
        assert prior([biases["bias[xy]"]]) == pytest.approx(0.9)
        # Six effects' share in three variants, of which two are a single axis.
        assert prior([biases["bias[x]"]]) == pytest.approx(self.share("cubic") * 6 / 3)

    @pytest.mark.number("quadratic_weight")
    def test_a_curvature_is_half_again_as_likely_as_a_cubic(self) -> None:
        assert self.share("quadratic") / self.share("cubic") == pytest.approx(1.5)

    @pytest.mark.number("g_weight")
    def test_a_gyro_that_feels_gravity_is_four_times_as_likely_as_one_that_drifts(self) -> None:
        rng = np.random.default_rng(2)
        force = rng.normal(size=(12, 3))
        c = Conditions(60.0 * np.arange(12), force_g=force, rate_dps=np.zeros((12, 3)))
        gyros = from_means(np.zeros((12, 3)), np.tile(np.eye(3), (12, 1, 1)), c, measurement=MeanRate())
        ratio = self.share("g_sensitivity", gyros) / self.share("gyro_drift", gyros)
        assert ratio == pytest.approx(4.0)

    @pytest.mark.number("family_weight")
    @pytest.mark.parametrize("covariate", ["supply", "approach", "previous_angle"])
    def test_supply_approach_and_memory_are_seven_tenths_as_likely_as_time(self, covariate: str) -> None:
        terms = nameless_terms(self.data)
        of = {name: [t for t in terms if t.covariates == (name,)] for name in ("time", covariate)}
        assert prior(of[covariate]) / prior(of["time"]) == pytest.approx(0.7)

    @pytest.mark.number("smooth_weight")
    @pytest.mark.parametrize("covariate", ["time", "temperature", "supply"])
    def test_a_quarter_of_a_covariate_is_polynomials_that_only_approximate(self, covariate: str) -> None:
        terms = [t for t in nameless_terms(self.data) if t.covariates == (covariate,)]
        smooth = prior(t for t in terms if t.basis.approximates)
        assert smooth / prior(terms) == pytest.approx(0.25)

    @pytest.mark.number("own_weight")
    def test_a_curvature_of_each_session_is_a_tenth_as_likely_as_that_of_the_part(self) -> None:
        terms, _ = named_terms(
            stack([self.data, self.data], [SessionOrigin("one", "A7"), SessionOrigin("two", "A7")])
        )
        each, part = (
            prior(t for t in terms if t.label == f"quadratic[x]{end}") for end in ("@session", "")
        )
        assert each / part == pytest.approx(0.1)
        # The start of a session drives a warm-up, which is as likely to differ.
        each, part = (
            prior(t for t in terms if re.fullmatch(rf"warm_up\[x\]<[^>]*>{end}", t.label))
            for end in ("@session", "")
        )
        assert each / part == pytest.approx(1.0)

    @pytest.mark.number("pair_weight")
    def test_a_process_in_two_covariates_is_three_tenths_as_likely_as_one_in_time(self) -> None:
        terms = processes(self.data)
        pair = prior(t for t in terms if t.covariates == ("time", "temperature"))
        assert pair / prior(t for t in terms if t.covariates == ("time",)) == pytest.approx(0.3)

    @pytest.mark.number("prior_snr")
    def test_an_outlier_is_expected_at_some_four_uncertainties_of_a_reading(self) -> None:
        # The price of one row is what a normal prior of four uncertainties costs where nothing is seen:
        # the mean of the likelihood over it.
        problem = linearise(Fit.begin(self.data).refit(), labelled(self.data, "outlier_dwell[x](dwell=7)"))
        mean = integrate.quad(lambda a: stats.norm.pdf(a, 0, 4) * math.exp(-0.5 * a**2), -9, 9)[0]
        assert problem.column_price[0] == pytest.approx(-math.log(mean), rel=0.15)

    @pytest.mark.number("effect_share")
    def test_scatter_that_nobody_declared_is_there_as_often_as_an_effect(self) -> None:
        c = turn()
        ideal = ideal_mg(c)
        rough = ideal + np.random.default_rng(3).normal(0, 2 * U, ideal.shape)
        data = read(c, rough)
        terms = labelled(data, "bias[xy]", "quadratic[x]")
        selection, scatter = with_scatter(select(data, terms, 2), terms, 2)
        assert scatter is not None
        assert scatter.kind == "reading_scatter"
        assert not selection.terms
        # Restricted likelihoods of one variance on all rows, beside the four base parameters.
        rows, variance = ideal.size, U**2 + scatter.value**2
        base = Fit.begin(data).refit()
        ratio = base.chi2 * (1 - U**2 / variance) - (rows - 4) * math.log(variance / U**2)
        tail = 0.5 * stats.chi2.sf(ratio, 1)
        assert math.log(scatter.p_value / tail) == pytest.approx(-math.log(0.0175), abs=0.1)


class TestWhatASessionCanShow:
    """Which columns and models are told apart, and which functions are looked for at all."""

    @pytest.mark.number("independent")
    @pytest.mark.parametrize(("part", "shown"), [(0.008, False), (0.013, True)])
    def test_a_function_is_seen_if_a_hundredth_of_it_lies_beside_the_base_model(
        self, part: float, shown: bool
    ) -> None:
        data = noisy(turn(), 1)
        fit = Fit.begin(data).refit()
        psi = np.radians(3.0) - data.conditions.angle_rad
        # A gain of x with a wave on it that is at right angles to the base model on 24 equal steps.
        nearly = function("gain", lambda c: np.cos(psi) + part * np.cos(5 * c.angle_rad), ("angle",))
        problem = linearise(fit, [nearly])
        assert bool(problem.terms) == shown

    @pytest.mark.number("independent")
    @pytest.mark.parametrize(("apart", "columns"), [(0.8e-4, 1), (1.3e-4, 2)])
    def test_effects_that_correlate_by_all_but_a_ten_thousandth_are_one(
        self, apart: float, columns: int
    ) -> None:
        r = 1 - apart
        problem = single([1, 1, 1], [[1, 0, 0], [r, math.sqrt(1 - r**2), 0]], [named("a"), named("b")])
        assert span(problem, [0, 1])[0].shape[1] == columns

    @pytest.mark.number("same_prediction")
    @pytest.mark.parametrize(("differ_by_u", "models"), [(0.5, 1), (0.7, 2)])
    def test_models_that_differ_by_half_an_uncertainty_altogether_are_one(
        self, differ_by_u: float, models: int
    ) -> None:
        # Two names with a reading each, of which they explain 10 u: one predicts a little on a third row.
        tilt = math.atan2(differ_by_u, 10.0)
        rows = [[1, 0, 0], [math.cos(tilt), math.sin(tilt), 0]]
        problem = single([10, 0, 3], rows, [named("a"), named("b")])
        one, other = (problem.target - span(problem, [k])[1] for k in (0, 1))
        assert np.linalg.norm(one - other) == pytest.approx(differ_by_u, rel=0.01)
        assert len(believed(problem, {(0,): 0.5, (1,): 0.5}).verdict.weights) == models

    @pytest.mark.number("least_range_c")
    @pytest.mark.number("least_range_v")
    @pytest.mark.parametrize(
        ("what", "span_of_it", "looked_for"),
        [
            ("temperature", 0.4, False),
            ("temperature", 0.7, True),
            ("supply", 0.007, False),
            ("supply", 0.015, True),
        ],
    )
    def test_products_want_half_a_degree_or_a_hundredth_of_a_volt(
        self, what: str, span_of_it: float, looked_for: bool
    ) -> None:
        still = {"temperature_c": np.full(24, 31.0), "supply_v": np.full(24, 5.02)}
        field = "temperature_c" if what == "temperature" else "supply_v"
        moved = still[field] + span_of_it * np.random.default_rng(4).permutation(np.linspace(0, 1, 24))
        data = noisy(turn(**(still | {field: moved})), 2)
        pairs = {term.covariates for term in nameless_terms(data)}
        assert (("time", what) in pairs) == looked_for

    @pytest.mark.number("most_cycles")
    def test_a_worm_of_72_teeth_is_looked_for_and_nothing_finer(self) -> None:
        angles = np.random.default_rng(5).uniform(0, 2 * np.pi, 40)
        assert max(cycles_shown(angles)) == 72


class TestChoice:
    """What is called adequate, found, scatter."""

    @pytest.mark.number("adequate")
    @pytest.mark.parametrize(("p", "adequate"), [(0.007, False), (0.014, True)])
    def test_a_model_is_adequate_down_to_a_chance_of_one_in_a_hundred(
        self, p: float, adequate: bool
    ) -> None:
        data = noisy(turn(), 8)
        # 48 rows less four base parameters; the noise is set so that χ² has this chance.
        scale = Fit.begin(data).refit().chi2 / stats.chi2.isf(p, 44)
        data = replace(data, own_covariance=scale * data.own_covariance)
        assert select(data, labelled(data, "quadratic[x]"), 0).adequate == adequate

    @pytest.mark.number("certain")
    @pytest.mark.parametrize(("posterior", "found"), [(0.53, ()), (0.57, ("cubic",))])
    def test_a_name_is_found_from_a_posterior_of_fifty_five_percent(
        self, posterior: float, found: tuple[str, ...]
    ) -> None:
        selection = believed(names_only("cubic", "warm_up"), {(0,): posterior, (): 1 - posterior})
        assert judge(selection).accepted == found

    @pytest.mark.number("significance")
    @pytest.mark.parametrize(("value", "told"), [(1.9, False), (2.1, True), (-2.1, True)])
    def test_a_value_is_a_finding_from_two_uncertainties(self, value: float, told: bool) -> None:
        assert stats.norm.cdf(2) - stats.norm.cdf(-2) == pytest.approx(0.95, abs=0.005)
        k3 = {"k3_x": Value(value, 1.0, "mg/g³")}
        assert differs_from_zero(Finding("cubic", ("x",), k3, 0.0, 0.0, 1.0)) == told

    @pytest.mark.number("mostly_bias")
    @pytest.mark.parametrize(("times", "apart"), [(4.5, False), (7.0, True)])
    def test_a_bias_five_times_what_varies_is_no_part_of_its_form(self, times: float, apart: bool) -> None:
        assert math.sqrt(0.97 / 0.03) == pytest.approx(5.7, abs=0.05)
        c = turn()
        wave = np.sin(4 * c.angle_rad)
        mean = ideal_mg(c) + np.outer(wave * math.sqrt(2), [1.0, 0.0]) + [times, 0.0]
        data = read(c, mean + np.random.default_rng(9).normal(0, 0.01, mean.shape), 0.01)
        alone = function("wave", lambda c: np.sin(4 * c.angle_rad))
        both = Basis("wave + const", ("time",), beside_one(alone.basis), with_constant=True)
        terms = [*labelled(data, "bias[x]"), alone, replace(alone, label="wave + const", basis=both)]
        left = {term.label for term in select(data, terms, 2).problem.terms}
        assert left == {"bias[x]", "wave"} | (set() if apart else {"wave + const"})

    @pytest.mark.number("scatter_checks")
    @pytest.mark.parametrize("dwells", [5, 6])
    def test_scatter_is_said_where_a_standard_deviation_is_known_to_a_third(self, dwells: int) -> None:
        checks = 2 * dwells - 4 - 2  # two rows each, four base parameters, a bias on each axis
        known_to = 1 / math.sqrt(2 * checks)
        c = turn(dwells)
        data = read(c, ideal_mg(c) + np.random.default_rng(10).normal(0, 30 * U, (dwells, 2)))
        terms = labelled(data, "bias[xy]")
        scatter = with_scatter(select(data, terms, 1), terms, 1)[1]
        assert (scatter is not None) == (known_to < 1 / 3)


def beside_one(basis: Basis) -> Any:
    """Columns of a basis beside a constant."""
    return lambda c: np.column_stack([np.ones(len(c.time_s)), basis.over(c)])


class TestLeftOutDwells:
    """How dwells are left out, and what they decide."""

    @pytest.mark.number("folds")
    @pytest.mark.number("alone")
    @pytest.mark.parametrize(("dwells", "count"), [(16, 16), (17, 5)])
    def test_up_to_sixteen_dwells_each_is_left_out_alone_and_of_more_a_fifth(
        self, dwells: int, count: int
    ) -> None:
        assert len(folds(noisy(turn(dwells), 11))["whole dwells"]) == count

    @pytest.mark.number("blocks")
    def test_a_turn_there_and_back_is_left_out_by_quarters_of_its_time(self) -> None:
        steps = np.arange(0, 360, 15.0)
        data = noisy(turn(angles_deg=[*steps, *steps[::-1]]), 12)
        quarters = folds(data)["blocks of time"]
        assert [np.flatnonzero(mask).tolist() for mask in quarters] == [
            list(range(first, first + 12)) for first in (0, 12, 24, 36)
        ]

    @pytest.mark.number("repeated_deg")
    @pytest.mark.parametrize(("apart_deg", "one"), [(1.5, True), (3.0, False)])
    def test_dwells_within_two_degrees_are_in_one_position(self, apart_deg: float, one: bool) -> None:
        steps = np.arange(0, 360, 30.0)
        data = noisy(turn(angles_deg=[*steps, *(steps + apart_deg)]), 13)
        assert ("body axes" in folds(data)) == one

    @pytest.mark.number("predicted")
    def test_a_dwell_counts_where_the_others_predict_it_to_four_times_the_noise(self) -> None:
        # A turn that lacks more and more of itself: what is left out lies farther and farther outside.
        data = noisy(turn(36), 14)
        columns = base_and_bias(data.conditions)
        variances = []
        for missing in range(12, 30):
            out = np.arange(36) < missing
            gram = np.linalg.inv(columns[~out].reshape(-1, 6).T @ columns[~out].reshape(-1, 6))
            variance = 1 + np.einsum("nap,pq,naq->na", columns[out], gram, columns[out]).max(axis=1)
            clear = np.abs(variance / 4 - 1) > 0.02  # the model's own columns are at the readings
            assert (determined(data, [out])[out] == (variance < 4))[clear].all()
            variances += variance.tolist()
        assert sum(2 < v < 3.9 for v in variances) > 5
        assert sum(4.1 < v < 8 for v in variances) > 5

    @pytest.mark.number("least_choice")
    @pytest.mark.parametrize(("dwells", "anew"), [(8, False), (9, True)])
    def test_effects_are_chosen_anew_from_nine_dwells(self, dwells: int, anew: bool) -> None:
        c = turn(dwells)
        data = read(c, noisy(c, 16).mean + np.array([5.0, -3.0]))
        terms = labelled(data, "bias[xy]")
        selection = select(data, terms, 1)
        fits, _ = nest_fits(selection, None)
        assert len(fits) == 2
        errors = guard_errors(selection, fits, Fold(terms, None, 1))
        assert all((error is not None) == anew for error in errors)

    @pytest.mark.number("least_checks")
    @pytest.mark.parametrize(("left", "found"), [(1, ("bias",)), (2, ("bias", "cubic"))])
    def test_with_fewer_than_two_readings_to_check_by_nothing_but_a_bias_is_found(
        self, left: int, found: tuple[str, ...]
    ) -> None:
        selection: Any = SimpleNamespace(fit=SimpleNamespace(dof=left))
        assert reject_unchecked(Names(("bias", "cubic"), {}, ()), selection).accepted == found

    @pytest.mark.number("worse")
    @pytest.mark.parametrize(("growth", "kept"), [(1.04, 1), (1.08, 0)])
    def test_an_effect_may_raise_the_left_out_error_by_a_twentieth(self, growth: float, kept: int) -> None:
        names = Names(("cubic",), {}, ())
        assert cut_worse_steps(names, names.accepted, (0.5, 0.5 * growth), None)[0] == kept
        assert cut_worse_steps(names, names.accepted, (0.5, 0.5), (0.3, 0.3 * growth))[0] == kept


class TestWhatIsSaid:
    """Which rivals, sets and openings a reader is told."""

    @pytest.mark.number("near")
    @pytest.mark.parametrize(("odds", "said"), [(0.12, ()), (0.18, (("cubic", "warm_up"),))])
    def test_a_rival_is_named_from_a_seventh_of_the_best(
        self, odds: float, said: tuple[tuple[str, ...], ...]
    ) -> None:
        selection = believed(names_only("cubic", "warm_up"), {(0,): 1.0, (1,): odds})
        assert judge(selection).confounded == said

    @pytest.mark.number("sure")
    @pytest.mark.parametrize(
        ("rival", "probability", "said"), [(0.06, 0.94, ()), (0.12, 0.88, (("cubic", "warm_up"),))]
    )
    def test_of_a_name_at_nine_tenths_no_rival_is_named(
        self, rival: float, probability: float, said: tuple[tuple[str, ...], ...]
    ) -> None:
        # The best model is one of several with the name, so that its rival is near it all the same.
        with_name = dict.fromkeys([(0,), (0, 2), (0, 3)], probability / 3)
        problem = names_only("cubic", "warm_up", "backlash", "creep")
        selection = believed(problem, {**with_name, (1,): rival})
        assert selection.verdict.names["cubic"] == pytest.approx(probability)
        assert judge(selection).confounded == said

    @pytest.mark.number("set_level")
    @pytest.mark.parametrize(("shares", "names"), [((0.60, 0.36, 0.04), 2), ((0.60, 0.33, 0.07), 3)])
    def test_a_set_is_the_fewest_names_that_hold_95_percent(
        self, shares: tuple[float, ...], names: int
    ) -> None:
        problem = names_only("cubic", "warm_up", "backlash")
        selection = believed(problem, {(k,): share for k, share in enumerate(shares)})
        assert set_of(selection, "cubic").names == ("cubic", "warm_up", "backlash")[:names]

    @pytest.mark.number("open_level")
    @pytest.mark.parametrize(("p", "said"), [(0.13, ()), (0.08, ("cubic",))])
    def test_what_could_explain_the_rest_is_said_at_one_in_ten(
        self, p: float, said: tuple[str, ...]
    ) -> None:
        rows = np.eye(20)
        target = np.ones(20)
        target[0] = math.sqrt(stats.f.isf(p, 1, 19))
        assert undecided(believed(single(target, rows[:1], [named("cubic")]), {(): 1.0})) == said

    @pytest.mark.number("open_alike")
    @pytest.mark.parametrize(("rarer", "said"), [(8.0, ("cubic", "backlash")), (12.0, ("cubic",))])
    def test_there_a_name_ten_times_less_likely_is_as_good(
        self, rarer: float, said: tuple[str, ...]
    ) -> None:
        rows = np.eye(20)
        target = np.ones(20)
        target[0] = 9.0
        terms = [named("cubic"), named("backlash", math.log(rarer))]
        assert undecided(believed(single(target, [rows[0], rows[0]], terms), {(): 1.0})) == said

    @pytest.mark.number("visible")
    @pytest.mark.parametrize(("part", "member"), [(0.035, False), (0.07, True)])
    def test_a_formula_is_averaged_if_a_twentieth_of_it_lies_beside_the_base_model(
        self, part: float, member: bool
    ) -> None:
        c = turn()
        psi = np.radians(3.0) - c.angle_rad
        wave = function("wave", lambda c: np.sin(5 * c.angle_rad), ("angle",))
        nearly = function("nearly", lambda c: np.cos(psi) + part * np.sin(5 * c.angle_rad), ("angle",))
        mean = noisy(c, 17).mean + np.outer(np.sin(5 * c.angle_rad), [1.5, 0.0])
        data = read(c, mean)
        averaged = average(select(data, [wave, nearly], 1), processes(data)[:1])
        assert averaged is not None
        terms = [term for term in averaged.terms if isinstance(term, AveragedTerm)]
        labels = {own.label for term in terms for _, own, _ in term.members}
        assert "wave" in labels
        assert ("nearly" in labels) == member
