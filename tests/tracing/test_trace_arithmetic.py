"""Parts of the trace that have a closed form: shapes, shares, mixtures, errors, dwells left out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.tracing.findings import Mixture, shares
from adis_gonio.tracing.grammar import (
    approach_shape,
    bump_shape,
    growth_shape,
    knee_shape,
    legendre,
    multiple,
    ring_bump,
    step_shape,
)
from adis_gonio.tracing.validation import HeldOut, disagreement_p_value, drop_unpredicted, folds, rms
from tracing.small_problems import observations

U = np.linspace(-1, 1, 41)


class TestShapes:
    def test_a_step_is_nothing_up_to_its_place_and_one_beyond(self) -> None:
        values = np.array([-1.0, 0.2, 0.2001, 1.0])
        assert step_shape(0.2)(values).tolist() == [0.0, 0.0, 1.0, 1.0]

    def test_a_knee_is_a_line_on_the_side_of_its_sign(self) -> None:
        values = np.array([-1.0, 0.25, 0.75])
        assert knee_shape(0.25, 1.0)(values).tolist() == [0.0, 0.0, 0.5]
        assert knee_shape(0.25, -1.0)(values).tolist() == [1.25, 0.0, 0.0]

    @pytest.mark.parametrize("rate", [2.5, -2.5])
    def test_growth_is_one_at_most_and_grows_at_its_rate(self, rate: float) -> None:
        values = growth_shape(rate)(U)
        assert values.max() == pytest.approx(1.0)
        np.testing.assert_allclose(np.diff(np.log(values)), rate * np.diff(U), rtol=1e-9)

    def test_an_approach_falls_to_a_share_of_e_within_its_time_of_the_session(self) -> None:
        session = np.array([-1.0, 0.0, 1.0])  # its begin, middle and end
        np.testing.assert_allclose(approach_shape(0.5, -1.0)(session), [1, math.exp(-1), math.exp(-2)])
        np.testing.assert_allclose(approach_shape(0.5, 1.0)(session), [math.exp(-2), math.exp(-1), 1])

    def test_a_bump_is_the_normal_density_over_its_peak(self) -> None:
        known = stats.norm(0.3, 0.2)
        np.testing.assert_allclose(bump_shape(0.3, 0.2)(U), known.pdf(U) / known.pdf(0.3), rtol=1e-12)

    def test_a_bump_on_the_circle_is_von_mises_density_over_its_peak(self) -> None:
        angle = np.linspace(-4, 9, 50)
        known = stats.vonmises(1 / 0.5**2, loc=2.0)
        np.testing.assert_allclose(ring_bump(2.0, 0.5)(angle), known.pdf(angle) / known.pdf(2.0), rtol=1e-9)

    @pytest.mark.parametrize("degree", [0, 1, 2, 6])
    def test_legendre_polynomials_are_scipys(self, degree: int) -> None:
        np.testing.assert_allclose(
            legendre([degree])(U)[:, 0], special.eval_legendre(degree, U), atol=1e-13
        )

    def test_a_multiple_of_a_turn_turns_so_many_times(self) -> None:
        np.testing.assert_allclose(multiple(np.sin, 3)(U), np.sin(3 * U))


class TestShares:
    def test_each_step_has_the_fall_below_the_least_before_it(self) -> None:
        # From 10 to 4; up to 6, which takes nothing; to 1, three below the least.
        found = shares(["bias", "drift", "cubic"], [10.0, 4.0, 6.0, 1.0])
        assert found == pytest.approx({"bias": 0.6, "drift": 0.0, "cubic": 0.3})

    def test_steps_of_one_name_add_up_and_all_together_never_exceed_what_was_explained(self) -> None:
        assert shares(["bias", "bias"], [8.0, 6.0, 2.0]) == pytest.approx({"bias": 0.75})
        rng = np.random.default_rng(2)
        excess = [5.0, *rng.uniform(0, 9, 12)]
        assert sum(shares(list("abcdefghijkl"), excess).values()) == pytest.approx(
            max(1 - min(excess) / 5.0, 0.0)
        )

    def test_where_there_was_no_excess_nothing_is_explained(self) -> None:
        assert shares(["bias"], [0.0, 0.0]) == {"bias": 0.0}


class TestMixture:
    def test_the_interval_holds_95_percent_of_draws_from_all_models(self) -> None:
        away = np.array([[0.0, 0.0], [3.0, 1.0], [-8.0, 0.0]])
        weight, within, along = np.array([0.6, 0.25, 0.15]), 1.3, np.array([1.0, -0.5])
        u = Mixture(away, weight).u(within, along)
        rng = np.random.default_rng(6)
        model = rng.choice(3, size=400_000, p=weight)
        drawn = rng.normal((away @ along)[model], within)
        inside = float((np.abs(drawn) <= stats.norm.ppf(0.975) * u).mean())
        assert inside == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / 400_000))

    def test_models_that_agree_add_nothing(self) -> None:
        assert Mixture(np.zeros((3, 2)), np.full(3, 1 / 3)).u(0.7, np.ones(2)) == 0.7

    def test_models_that_differ_only_across_the_direction_add_nothing(self) -> None:
        away = np.array([[0.0, 0.0], [0.0, 5.0]])
        assert Mixture(away, np.array([0.5, 0.5])).u(0.7, np.array([1.0, 0.0])) == 0.7


class TestLeftOut:
    def test_the_error_is_by_reading_or_by_the_length_that_a_pose_leaves(self) -> None:
        residual = np.array([[3.0, 4.0], [0.0, 0.0]])
        assert rms(residual, by_axis=True) == pytest.approx(math.sqrt(25 / 4))
        assert rms(residual, by_axis=False) == pytest.approx(math.sqrt(25 / 2))

    @pytest.mark.parametrize("dwells", [12, 24, 47])
    def test_every_dwell_is_left_out_once_under_each_design_and_never_all_of_them(self, dwells) -> None:
        data = observations(n=dwells)
        for masks in folds(data).values():
            assert (np.sum(masks, axis=0) == 1).all()
            assert max(mask.sum() for mask in masks) < dwells / 2

    def test_dwells_that_the_model_does_not_know_count_no_more_and_a_design_of_few_not_at_all(self) -> None:
        def left(*predicted: bool) -> HeldOut:
            return HeldOut(np.zeros((6, 2)), None, np.array(predicted))

        every = np.ones(6, dtype=bool)
        two, one = left(1, 1, 0, 0, 0, 0), left(1, 0, 0, 0, 0, 0)
        counts = drop_unpredicted({"a": every, "b": every}, {"a": two, "b": one})
        assert list(counts) == ["a"]
        assert counts["a"].tolist() == [True, True, False, False, False, False]
        kept = drop_unpredicted({"b": every}, {"b": one})
        assert kept["b"].all(), "without any design that applies, all dwells count"

    def test_check_dwells_are_judged_by_what_they_add_to_chi2_in_a_fit_of_all(self) -> None:
        # An innovation's rᵀ (1 + X C Xᵀ)⁻¹ r is what χ² of the fit rises by when the dwells join it.
        every = observations(n=24, seed=4)
        check = np.arange(24) % 4 == 0
        for off_mg in (0.0, 0.4):
            moved = every.mean + np.outer(check, [off_mg, 0.0])
            data = replace(every, mean=moved)
            fit = Fit.begin(data.rows(~check)).refit(tolerance=1e-9)
            whole = Fit.begin(data).refit(tolerance=1e-9)
            rise, count = whole.chi2 - fit.chi2, 2 * int(check.sum())
            for inflation in (1.0, 2.0):
                expected = stats.f.sf(rise / inflation / count, count, 1e4)  # of the noise's own freedom
                assert disagreement_p_value(fit, data.rows(check), inflation) == pytest.approx(
                    expected, rel=1e-2
                )
