"""Scatter from dwell to dwell: its size, its uncertainty, and what it is weighed against, by hand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.model.effects import Conditions
from adis_gonio.tracing import scatter
from adis_gonio.tracing.scatter import Scatter, with_scatter
from adis_gonio.tracing.selection import Selection
from tracing.small_problems import (
    G,
    U,
    base_and_bias,
    biased,
    chosen,
    function,
    ideal_mg,
    labelled,
    read,
    turn,
)

CHECKS = 48 - 4
"""Rows of a turn of 24 dwells less those of the base model."""


def rough(times: float, seed: int = 61, u: float = U) -> Readings:
    """A turn of which readings scatter by so many of their uncertainties, as χ² over its freedom has it."""
    c = turn()
    noise = np.random.default_rng(seed).normal(0, u, (24, 2))
    size = math.sqrt(Fit.begin(read(c, ideal_mg(c) + noise, u)).refit().chi2 / CHECKS)
    return read(c, ideal_mg(c) + times / size * noise, u)


@cache
def biased_and_curved() -> tuple[Readings, list[Term], Selection]:
    """A turn with a bias, two candidates, and the model that has both."""
    data = biased(mg=(0.05, 0.03))
    terms = labelled(data, "bias[xy]", "cubic[x]")
    return data, terms, chosen(data, terms, ((0, 1), 1.0))


def likelihood(left: float, variance: float) -> float:
    """Restricted log likelihood of rows of one variance, `left` the sum of their squared residuals."""
    return -0.5 * (left / variance + CHECKS * math.log(variance))


class TestSize:
    @pytest.mark.parametrize(("times", "u"), [(1.02, 0.1), (1.5, 0.1), (5.0, 0.1), (500.0, 0.001)])
    def test_it_is_what_the_variance_of_the_residuals_has_beyond_the_noise(
        self, times: float, u: float
    ) -> None:
        data = rough(times, u=u)
        told = scatter._size_of_component(Fit.begin(data).refit(), data, "reading_scatter")
        assert told == pytest.approx(u * math.sqrt(times**2 - 1), rel=0.06)

    def test_there_is_none_where_residuals_are_no_larger_than_the_noise(self) -> None:
        data = rough(0.95)
        assert scatter._size_of_component(Fit.begin(data).refit(), data, "reading_scatter") == 0.0

    def test_that_of_a_fixture_is_in_the_angle(self) -> None:
        c = turn()
        slips = np.random.default_rng(62).normal(0, 0.05, 24)
        data = read(c, ideal_mg(c, slips))
        # Off in angle, a reading is off along the tangent alone: 24 rows less the start angle, gains, lean.
        base = base_and_bias(c)[..., :4]
        along = np.einsum("nap,na->np", base, base[..., 0])
        away = np.radians(slips)
        away = away - along @ np.linalg.lstsq(along, away, rcond=None)[0]
        told = scatter._size_of_component(Fit.begin(data).refit(), data, "fixture_scatter")
        # Some of the base model's columns are fixed by the lengths as well, so that 1 to 4 are used up.
        low, high = (math.sqrt(float(away @ away) / (24 - used)) for used in (0, 4))
        assert 0.95 * low < told < 1.05 * high

    def test_its_measure_is_the_median_reading_or_the_angle_that_it_says(self) -> None:
        data = rough(1.0)
        own = data.own_covariance.copy()
        own[:5] *= 100.0
        data = replace(data, own_covariance=own, fixture_rad=3e-4)
        assert scatter._measured_u(data, "reading_scatter") == pytest.approx(U)
        assert scatter._measured_u(data, "fixture_scatter") == pytest.approx(math.hypot(U / G, 3e-4))

    def test_it_adds_to_the_noise_as_a_variance(self) -> None:
        data = replace(rough(1.0), fixture_rad=3e-4)
        more = Scatter("reading_scatter", 0.2, 0.0, U, 0.0, 0.0).applied(data)
        np.testing.assert_allclose(more.own_covariance, np.tile((U**2 + 0.04) * np.eye(2), (24, 1, 1)))
        assert more.fixture_rad == 3e-4
        turned = Scatter("fixture_scatter", math.degrees(4e-4), 0.0, 0.0, 0.0, 0.0, "deg").applied(data)
        assert turned.fixture_rad == pytest.approx(5e-4)
        np.testing.assert_array_equal(turned.own_covariance, data.own_covariance)


def harville(data: Readings, fit: Fit, columns: np.ndarray, tangent: np.ndarray, fixture: float) -> float:
    """Restricted log likelihood of readings, by dense matrices."""
    start, scale_x, scale_y, lean = fit.values.base
    psi = start - data.conditions.angle_rad
    left = data.mean - G * np.column_stack([scale_x * np.cos(psi), scale_y * np.sin(psi + lean)])
    spread = np.zeros((48, 48))
    for k in range(24):
        block = data.own_covariance[k] + fixture**2 * np.outer(tangent[k], tangent[k])
        spread[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    firm = np.linalg.inv(spread)
    rows = columns.reshape(48, -1)
    size = np.linalg.slogdet(spread)[1] + np.linalg.slogdet(rows.T @ firm @ rows)[1]
    return -0.5 * float(left.ravel() @ firm @ left.ravel() + size)


class TestLikelihood:
    def test_it_is_that_of_readings_with_the_base_model_integrated_out(self) -> None:
        c = turn()
        spread = np.random.default_rng(63).uniform(0.05, 0.2, (24, 2))
        mean = ideal_mg(c) + np.random.default_rng(63).normal(0, 0.2, (24, 2))
        data = read(c, mean)
        data = replace(data, own_covariance=spread[:, :, None] ** 2 * np.eye(2))
        psi = np.radians(3.0) - c.angle_rad
        tangent = G * np.column_stack([-np.sin(psi), np.cos(psi)])
        told, expected = [], []
        for fixture in (0.0, 1e-4, 4e-4):
            fit = Fit.begin(replace(data, fixture_rad=fixture)).refit()
            told.append(scatter._restricted(fit))
            expected.append(harville(data, fit, base_and_bias(c)[..., :4], tangent, fixture))
        np.testing.assert_allclose(np.diff(told), np.diff(expected), atol=0.01)
        assert np.abs(np.diff(expected)).min() > 0.3

    def test_a_factor_on_the_noise_is_as_good_as_readings_with_that_noise(self) -> None:
        data = replace(rough(1.5), fixture_rad=3e-4)
        loud = replace(data, own_covariance=4 * data.own_covariance, fixture_rad=6e-4)
        told = scatter.log_evidence(Fit.begin(data).refit(), 3.0, 4.0)
        assert told == pytest.approx(scatter.log_evidence(Fit.begin(loud).refit(), 3.0), abs=1e-3)

    def test_terms_are_integrated_out_but_where_their_prices_have_it(self) -> None:
        data, (bias, _), selection = biased_and_curved()
        fit = selection.base.with_terms([bias], [np.zeros(2)]).refit()
        louder = replace(data, own_covariance=4 * data.own_covariance)
        told = [
            scatter._restricted(replace(fit, data=louder).refit(), base_only=alone)
            - scatter._restricted(fit, base_only=alone)
            for alone in (True, False)
        ]
        # 48 variances times 4, and 4 base parameters or 6 that are known half as well.
        for told_so, parameters in zip(told, (4, 6), strict=True):
            assert told_so == pytest.approx(0.5 * fit.chi2 * 3 / 4 - 0.5 * (48 - parameters) * math.log(4))

    def test_of_a_free_attitude_the_length_of_a_reading_counts(self) -> None:
        c = turn()
        data = replace(
            read(c, ideal_mg(c) + np.random.default_rng(64).normal(0, U, (24, 2))),
            angle_rad=np.full(24, np.nan),
        )
        assert data.free
        psi = np.radians(3.0) - c.angle_rad
        along = np.column_stack([np.cos(psi), np.sin(psi)])
        rows = np.einsum("nap,na->np", base_and_bias(c)[..., 1:4], along)
        told, expected = [], []
        for own in (np.diag([1.0, 1.0]), np.diag([1.0, 9.0])):
            fit = Fit.begin(replace(data, own_covariance=np.tile(U**2 * own, (24, 1, 1)))).refit()
            told.append(scatter._restricted(fit) + 0.5 * fit.chi2)
            variance = U**2 * np.einsum("na,ab,nb->n", along, own, along)
            firm = rows / np.sqrt(variance)[:, None]
            expected.append(-0.5 * (np.log(variance).sum() + np.linalg.slogdet(firm.T @ firm)[1]))
        assert told[1] - told[0] == pytest.approx(expected[1] - expected[0], abs=0.02)


class TestStatement:
    """The figures that a reader is told of it."""

    def stated(self, data: Readings, kind: Any, size: float) -> Scatter:
        base = Fit.begin(data).refit()
        selection = replace(biased_and_curved()[2], base=base, fit=base)
        return scatter._make_scatter(data, kind, size, selection, 2.5)

    def test_its_uncertainty_is_that_of_the_curvature_and_p_that_of_the_ratio_of_likelihoods(self) -> None:
        data = rough(1.4)
        left = 1.4**2 * U**2 * CHECKS
        size = U * math.sqrt(1.4**2 - 1)

        def at(log_size: float) -> float:
            return likelihood(left, U**2 + size**2 * math.exp(2 * log_size))

        told = self.stated(data, "reading_scatter", size)
        curvature = -(at(0.01) - 2 * at(0.0) + at(-0.01)) / 0.01**2
        assert told.value == size
        assert told.u == pytest.approx(size / math.sqrt(curvature), rel=0.02)
        ratio = 2 * (at(0.0) - likelihood(left, U**2))
        assert told.p_value == pytest.approx(0.5 * stats.chi2.sf(ratio, 1) / 0.0175, rel=0.02)
        assert told.p_value < 1
        assert told.declared == pytest.approx(U)
        assert (told.kind, told.unit, told.log_odds) == ("reading_scatter", "mg", 2.5)

    def test_where_the_likelihood_is_not_curved_it_is_as_uncertain_as_it_is_large(self) -> None:
        # A twentieth of what the residuals ask for: the likelihood only rises there.
        told = self.stated(rough(1.4), "reading_scatter", 0.05 * U)
        assert told.u == told.value == 0.05 * U

    def test_what_explains_nothing_has_a_p_of_one(self) -> None:
        assert self.stated(rough(0.9), "reading_scatter", 0.5 * U).p_value == 1.0

    def test_that_of_a_fixture_is_said_in_degrees(self) -> None:
        c = turn()
        slips = np.random.default_rng(62).normal(0, 0.05, 24)
        data = replace(read(c, ideal_mg(c, slips)), fixture_rad=1e-4)
        told = self.stated(data, "fixture_scatter", math.radians(0.05))
        assert told.value == pytest.approx(0.05)
        assert told.declared == pytest.approx(math.degrees(1e-4))
        assert told.unit == "deg"
        # A standard deviation from some 22 of one size that is far above the noise.
        assert told.u == pytest.approx(0.05 / math.sqrt(2 * 22), rel=0.3)

    def test_it_costs_the_thought_of_an_effect_and_one_parameter(self) -> None:
        assert scatter.price_of_scatter(rough(1.0)) == pytest.approx(-math.log(0.0175) + 0.5 * math.log(48))


class TestRival:
    """A smooth function under the measured noise, beside the names of the model or without them."""

    @pytest.mark.parametrize("beside", [("bias", "cubic"), ("bias",), ()])
    def test_it_stands_beside_all_names_or_a_bias_or_nothing_by_what_is_more_likely(
        self, monkeypatch: pytest.MonkeyPatch, beside: tuple[str, ...]
    ) -> None:
        data = biased(mg=(0.05, 0.03))
        terms = labelled(data, "bias[xy]", "cubic[x]")
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        selection = chosen(data, [*terms, wave], ((0, 1, 2), 1.0))

        def evidence(fit: Fit, columns: np.ndarray, left: np.ndarray, candidates: Any) -> np.ndarray:
            np.testing.assert_allclose(columns.T @ left, 0.0, atol=1e-8)
            assert columns.shape == (48, 4 + {0: 0, 1: 2, 2: 3}[len(fit.terms)])
            here = tuple(sorted(str(term.name) for term in fit.terms)) == beside
            return np.array([-5.0, 30.0 if here else -30.0])

        monkeypatch.setattr(scatter, "processes", lambda data: ["one", "two"])
        monkeypatch.setattr(scatter, "evidence", evidence)
        told = scatter._evidence_of_processes(selection)
        prices = {
            str(term.name): float(price)
            for term, price in zip(selection.problem.terms, selection.found.prices, strict=True)
        }
        kept = [term for term in terms if term.name in beside]
        fit = Fit.begin(data).with_terms(kept, [np.zeros(len(term.amplitudes)) for term in kept]).refit()
        gained = 0.5 * (selection.base.chi2 - fit.chi2) - sum(prices[name] for name in beside) + 30.0
        assert told - scatter._restricted(selection.base, base_only=True) == pytest.approx(gained, abs=1e-3)

    def test_without_a_smooth_function_there_is_none(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(scatter, "processes", lambda data: [])
        selection = biased_and_curved()[2]
        assert scatter._evidence_of_processes(selection) == -math.inf

    def test_a_model_is_worth_its_likelihood_less_the_prices_of_its_terms(self) -> None:
        selection = biased_and_curved()[2]
        worth = scatter._evidence(selection) - scatter._restricted(selection.base, base_only=True)
        explained = 0.5 * (selection.base.chi2 - selection.fit.chi2)
        assert worth == pytest.approx(explained - float(sum(selection.found.prices)), abs=1e-3)


class TestSettling:
    """Size and choice, each given the other."""

    @pytest.mark.parametrize(
        ("sizes", "settled", "chosen_under"),
        [
            ((1.0, 1.05), 1.0, [1.0]),
            ((1.0, 0.95), 1.0, [1.0]),
            ((1.0, 1.5), 1.5, [1.0, 1.5]),
            ((1.0, 0.7), 0.7, [1.0, 0.7]),
            ((0.4,), None, []),
            ((0.6, 0.6), 0.6, [0.6]),
            ((1.0, 0.4), None, [1.0]),
        ],
    )
    def test_it_is_chosen_again_where_the_size_moves_by_a_tenth_and_left_where_it_is_half_the_noise(
        self,
        monkeypatch: pytest.MonkeyPatch,
        sizes: tuple[float, ...],
        settled: float | None,
        chosen_under: list[float],
    ) -> None:
        data, terms, selection = biased_and_curved()
        to_come: Iterator[float] = iter(sizes)
        beside: list[list[str]] = []
        under: list[float] = []

        made: list[SimpleNamespace] = []

        def most_likely(fit: Fit, data: Readings, kind: str) -> float:
            beside.append(sorted(str(term.name) for term in fit.terms))
            return next(to_come) * U

        def choose(data: Readings, kind: str, size: float, terms: Any, most: int) -> Any:
            under.append(size / U)
            made.append(SimpleNamespace(fit=selection.fit, size=size))
            return made[-1]

        monkeypatch.setattr(scatter, "_size_of_component", most_likely)
        monkeypatch.setattr(scatter, "_select_with", choose)
        size, again = scatter._fit_component(data, "reading_scatter", selection, terms, 2)
        assert under == pytest.approx(chosen_under)
        # First beside a bias alone, then beside what was chosen.
        assert beside == [["bias"], ["bias", "cubic"]][: len(sizes)]
        if settled is None:
            assert (size, again) == (0.0, None)
        else:
            assert size == pytest.approx(settled * U)
            assert again is made[-1]
            assert made[-1].size == size


class TestChoice:
    """Which account of a session stands."""

    def weighed(
        self,
        monkeypatch: pytest.MonkeyPatch,
        data: Readings,
        model: tuple[int, ...] = (0, 1),
        most: int = 2,
        *,
        worth: tuple[float, float, float] = (0.0, 10.0, 5.0),
        smooth: float = -9.0,
        **others: Any,
    ) -> tuple[Any, Any]:
        """The choice where the model, reading scatter and fixture scatter are worth so much in nats."""
        _, terms, both = biased_and_curved()
        fit = both.fit.with_terms([terms[k] for k in model], [np.zeros(1) for _ in model])
        selection: Any = replace(both, fit=replace(fit, data=data), **others)
        of = {"reading_scatter": worth[1], "fixture_scatter": worth[2]}
        monkeypatch.setattr(
            scatter,
            "_fit_component",
            lambda data, kind, *more: (of[kind], None if math.isnan(of[kind]) else of[kind]),
        )
        monkeypatch.setattr(scatter, "_evidence", lambda one: worth[0] if one is selection else one)
        monkeypatch.setattr(scatter, "price_of_scatter", lambda data: 1.0)
        monkeypatch.setattr(scatter, "_evidence_of_processes", lambda selection: smooth)
        monkeypatch.setattr(
            scatter, "_select_with", lambda data, kind, size, terms, most: (kind, size, len(terms))
        )
        monkeypatch.setattr(scatter, "_make_scatter", lambda data, kind, size, under, odds: odds)
        told, found = with_scatter(selection, terms, most)
        return ("the model" if told is selection else told), found

    def test_the_better_kind_stands_where_it_is_worth_more_than_its_price(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        nan = math.nan
        for worth, smooth, told in (
            ((0.0, 10.0, 5.0), -9.0, (("reading_scatter", 10.0, 2), 9.0)),
            ((0.0, 5.0, 10.0), -9.0, (("fixture_scatter", 10.0, 2), 9.0)),
            ((0.0, nan, 10.0), -9.0, (("fixture_scatter", 10.0, 2), 9.0)),
            ((8.5, 10.0, 5.0), -9.0, (("reading_scatter", 10.0, 2), 0.5)),
            ((9.5, 10.0, 5.0), -9.0, ("the model", None)),
            ((0.0, nan, nan), -9.0, ("the model", None)),
            # A smooth function is weighed against it as well.
            ((0.0, 10.0, 5.0), 8.5, (("reading_scatter", 10.0, 2), 0.5)),
            ((0.0, 10.0, 5.0), 9.5, ("the model", None)),
        ):
            assert self.weighed(monkeypatch, data, worth=worth, smooth=smooth) == told

    def test_it_is_not_thought_of_where_a_bias_is_adequate_or_nothing_can_show_it(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        plain = ("the model", None)
        assert self.weighed(monkeypatch, data, (0,), adequate=True) == plain
        assert self.weighed(monkeypatch, data, (), adequate=True) == plain
        assert self.weighed(monkeypatch, data, (0, 1), adequate=True) != plain
        assert self.weighed(monkeypatch, data, (0,), adequate=False) != plain
        assert self.weighed(monkeypatch, data, most=0) == plain
        unknown = replace(data, noise_known=False)
        assert self.weighed(monkeypatch, unknown) == plain

    def test_scatter_of_a_fixture_is_thought_of_where_angles_are_declared_in_a_plane(self) -> None:
        data = biased()
        assert list(scatter._kinds(data)) == ["reading_scatter", "fixture_scatter"]
        assert list(scatter._kinds(replace(data, angle_rad=np.full(24, np.nan)))) == ["reading_scatter"]
        space = from_means(G * np.eye(3), np.tile(np.eye(3), (3, 1, 1)), Conditions(np.arange(3.0)))
        assert list(scatter._kinds(space)) == ["reading_scatter"]
