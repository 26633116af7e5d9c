"""Parts of the trace by themselves: candidates, search, posterior, choice, validation, averages."""

from __future__ import annotations

import itertools
import math
import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import linalg, stats

from adis_gonio.base.budget import Budget, within
from adis_gonio.base.errors import FitError
from adis_gonio.base.numbers import format_percent
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import NamelessTerm
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate
from adis_gonio.tracing import averaging, selection as choice
from adis_gonio.tracing.averaging import RING, AveragedTerm, average, evidence, processes
from adis_gonio.tracing.credible_sets import Names, probability_of
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.linear_problem import LinearProblem
from adis_gonio.tracing.model_search import (
    Model,
    ModelPosterior,
    presence_probabilities,
    search,
    weigh,
)
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.proposals import fitted_hypothesis, parameter_prior, whitened_columns
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.session_blocks import orthonormal, project_off_base
from adis_gonio.tracing.trace import disagreement_of, refuse_too_few, weak_names
from adis_gonio.tracing.trace_result import ErrorFigures, Finding
from adis_gonio.tracing.validation import (
    Fold,
    cut_worse_steps,
    disagreement_p_value,
    error_figures,
    guard_errors,
    harmful_functions,
    longest_acceptable,
    nest_fits,
    reject_names,
    reject_unchecked,
    without_folds,
)
from tracing.small_problems import (
    G,
    U,
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
    slipped,
    surroundings,
    turn,
)


class TestFunctionsWithoutAName:
    """Forms are what their words say."""

    c = surroundings()

    @staticmethod
    @cache
    def terms() -> dict[str, NamelessTerm]:
        return {t.label: t for t in nameless_terms(noisy(surroundings(), 41))}

    def column(self, label: str, reading: np.ndarray) -> np.ndarray:
        """Of one axis, with readings in g."""
        return self.terms()[label].columns(G * reading, self.c)[:, :, 0]

    @pytest.mark.parametrize(
        "form",
        [
            "a⁴",
            "a⁵",
            "a⁶",
            "a⁷",
            "a|a|",
            "|a|³",
            "sign a",
            "√|a|",
            "sign a √|a|",
            "max(a, 0)²",
            "min(a, 0)²",
            "max(a, 0)³",
            "min(a, 0)³",
            "max(a − -0.75 g, 0)",
            "max(a − 0.25 g, 0)",
            "|a_p|",
            "a_p³",
            "a a_p²",
            "a² a_p",
            "a |a_p|",
            "a_p |a|",
            "sign a_p",
            "a_p⁴",
            "a_p⁵",
            "a² a_p²",
            "a³ a_p",
            "a a_p³",
        ],
    )
    def test_a_form_of_the_readings_is_what_it_says(self, form: str) -> None:
        reading = np.random.default_rng(41).uniform(-1, 1, (24, 2))
        told = self.column(f"bias[y]~{form}", reading)
        expected = [said(form, a, p) for p, a in reading.tolist()]
        np.testing.assert_allclose(told[:, 1], expected, rtol=1e-9, atol=1e-12)
        assert not told[:, 0].any()

    @pytest.mark.parametrize(
        ("form", "of"),
        [
            ("sin 3θ", lambda t, u: np.sin(3 * t)),
            ("cos 2θ", lambda t, u: np.cos(2 * t)),
            ("sign sin θ", lambda t, u: np.sign(np.round(np.sin(t), 9))),
            ("|cos θ|", lambda t, u: np.abs(np.cos(t))),
            ("θ within a turn (saw-tooth)", lambda t, u: t / np.pi - 1),
            ("θ (along all turns)", lambda t, u: t / (2 * np.pi)),
            ("sin 2θ′ of the previous position", lambda t, u: np.sin(2 * u)),
            ("cos 1θ′ of the previous position", lambda t, u: np.cos(u)),
            ("the move θ − θ′", lambda t, u: (t - u) / np.abs(t - u).max()),
            ("|θ − θ′|", lambda t, u: np.abs(t - u) / np.abs(t - u).max()),
            ("sign(θ − θ′)", lambda t, u: np.sign(np.round(t - u, 9))),
        ],
    )
    def test_a_form_of_the_angle_or_the_one_before_is_what_it_says(self, form: str, of: Any) -> None:
        told = self.column(f"bias[x]~{form}", np.ones((24, 2)))[:, 0]
        assert self.c.angle_rad is not None
        np.testing.assert_allclose(told, of(self.c.angle_rad, self.c.previous_angle_rad), atol=1e-12)

    def test_a_rate_of_temperature_is_the_slope_of_its_history_over_the_steepest(self) -> None:
        # 30 + 6 sin(t/200 s), read once a minute: its slope is 0.03 cos(t/200 s) °C/s.
        told = self.column("gain[x]~dT/dt", np.ones((24, 2)))[:, 0]
        slope = np.cos(self.c.time_s / 200.0)
        inside = slice(1, -1)  # at the ends the history is held
        ratio = told[inside] @ slope[inside] / (slope[inside] @ slope[inside])
        np.testing.assert_allclose(told[inside], ratio * slope[inside], atol=0.02)
        assert np.abs(told).max() == pytest.approx(1.0)

    def test_powers_of_time_are_of_its_share_of_the_session(self) -> None:
        share = self.c.time_s / np.ptp(self.c.time_s)
        for form, power in (("t²", 2), ("t³", 3), ("√t", 0.5)):
            np.testing.assert_allclose(self.column(f"bias[x]~{form}", np.ones((24, 2)))[:, 0], share**power)
        np.testing.assert_allclose(self.column("misalignment[x]~t", np.ones((24, 2)))[:, 0], share)

    def test_a_product_is_of_both_covariates_from_their_own_zeros(self) -> None:
        told = self.column("bias[x]~(T − 25 °C) × (V − 5 V)", np.ones((24, 2)))[:, 0]
        temperature, supply = self.c.temperature_c, self.c.supply_v
        assert temperature is not None
        assert supply is not None
        expected = (temperature - 25) / np.ptp(temperature) * 2 * (supply - 5) / np.ptp(supply) * 2
        np.testing.assert_allclose(told, expected)

    def test_of_a_gyro_forms_of_force_and_rate_are_what_they_say(self) -> None:
        rng = np.random.default_rng(42)
        force, rate = rng.normal(size=(20, 3)), 50 * rng.normal(size=(20, 3))
        c = Conditions(60.0 * np.arange(20), force_g=force, rate_dps=rate)
        gyros = from_means(rate.copy(), np.tile(np.eye(3), (20, 1, 1)), c, measurement=MeanRate())
        terms = {t.label: t for t in nameless_terms(gyros)}

        def told(label: str) -> np.ndarray:
            return terms[label].columns(rate, c)[:, 1, 0]

        x, _, z = force.T
        expected = {
            "f_x³": x**3,
            "|f_z|": np.abs(z),
            "f_z|f_z|": z * np.abs(z),
            "sign f_x": np.sign(x),
            "max(f_x, 0)²": np.maximum(x, 0) ** 2,
            "min(f_x, 0)²": np.minimum(x, 0) ** 2,
            "f_x f_z": x * z,
            "(f_x² − f_z²)/2": (x * x - z * z) / 2,
        }
        for form, column in expected.items():
            np.testing.assert_allclose(told(f"bias[y]~{form}"), column, err_msg=form)
        # Amplitudes are stated at 100 °/s.
        own = rate[:, 1] / 100.0
        for form, column in {
            "ω²": own**2,
            "ω³": own**3,
            "ω|ω|": own * np.abs(own),
            "sign ω": np.sign(own),
        }.items():
            np.testing.assert_allclose(told(f"bias[y]~{form}"), column, err_msg=form)
        # Of x, y, z and their products up to the second degree z² is 1 − x² − y².
        smooth = terms["bias[y]~a smooth function of the force (degree 2)"].columns(rate, c)
        assert smooth.shape[2] == 8


def said(form: str, a: float, p: float) -> float:
    """A form of the readings a of the axis and a_p of the other, computed from its words."""
    words = form.replace("−", "-").replace(" g,", ",")
    words = re.sub("[²³⁴⁵⁶⁷]", lambda power: f"**{unicodedata.digit(power[0])}", words)
    words = re.sub(r"√\|a\|", " sqrt(abs(a))", words)
    words = re.sub(r"\|(a_p|a)\|", r" abs(\1)", words)
    words = re.sub(r"sign (a_p|a)", r"sign(\1)", words)
    words = re.sub(r"(?<=[\w)]) +(?=[a-z])", "*", words.strip())  # factors stand side by side
    functions = {"sqrt": math.sqrt, "sign": np.sign, "abs": abs, "max": max, "min": min}
    return float(eval(words, functions | {"a": a, "a_p": p}))


class TestProcesses:
    data = noisy(surroundings(), 43)

    @classmethod
    @cache
    def every(cls) -> tuple[NamelessTerm, ...]:
        return tuple(processes(cls.data))

    @pytest.mark.parametrize(("inflation", "noise"), [((), 1.0), ((2.0,), 2.0)])
    def test_the_evidence_is_that_of_a_normal_prior_on_the_features(
        self, inflation: tuple[float, ...], noise: float
    ) -> None:
        # Against none: ln N(y; 0, 1 + φ s² φᵀ) − ln N(y; 0, 1), both beside the base model.
        fit = Fit.begin(self.data).refit()
        beside = orthonormal(fit.jacobian)
        left = np.random.default_rng(43).normal(size=48) * 2
        left -= beside @ (beside.T @ left)
        space = linalg.null_space(beside.T)
        candidates = processes(self.data)[:: len(processes(self.data)) // 12]
        told = evidence(fit, beside, left, candidates, *inflation)
        for process, score in zip(candidates, told, strict=True):
            features = space.T @ fit.white(fit.candidate(process))
            spread = noise * np.eye(len(features)) + (process.prior_sd or 0) ** 2 * features @ features.T
            y = space.T @ left
            ratio = stats.multivariate_normal(np.zeros(len(y)), spread).logpdf(y)
            ratio -= stats.multivariate_normal(np.zeros(len(y)), noise * np.eye(len(y))).logpdf(y)
            assert score == pytest.approx(ratio - process.cost, abs=1e-4)

    def test_each_enters_on_some_axes_or_at_the_angle(self) -> None:
        placed = {(process.where, process.axes) for process in self.every()}
        at_readings = itertools.product(("bias", "gain", "misalignment"), [(0,), (1,), (0, 1)])
        assert placed == {("angle", ()), *at_readings}

    @pytest.mark.parametrize("width", RING)
    def test_features_of_the_angle_are_those_of_the_periodic_kernel(self, width: float) -> None:
        number = RING.index(width)
        seen: dict[int, Any] = {}
        for process in processes(self.data):
            if process.covariates == ("angle",) and process.where == "angle":
                seen.setdefault(id(process.basis), process.basis)
        features = list(seen.values())[number].over(self.data.conditions)
        theta = self.data.conditions.angle_rad
        assert theta is not None
        kernel = np.exp(-2 * np.sin((theta[:, None] - theta) / 2) ** 2 / width**2)
        np.testing.assert_allclose(features @ features.T, kernel, atol=2e-3)

    def test_features_of_time_are_a_constant_a_line_and_the_squared_exponential(self) -> None:
        seen: dict[int, Any] = {}
        for process in processes(self.data):
            if process.covariates == ("time",):
                seen.setdefault(id(process.basis), process.basis)
        u = self.data.conditions.time_s / np.ptp(self.data.conditions.time_s)
        for length, basis in zip((0.1, 0.18, 0.32, 0.56, 1.0), seen.values(), strict=True):
            features = basis.over(self.data.conditions)
            line = 2 * u - 1
            kernel = 1 + np.outer(line, line) + np.exp(-0.5 * ((u[:, None] - u) / length) ** 2)
            np.testing.assert_allclose(features @ features.T, kernel, atol=5e-3)

    def features(self, covariates: tuple[str, ...], data: Readings | None = None) -> list[Any]:
        """Bases of these covariates, one a length."""
        seen: dict[int, Any] = {}
        for process in self.every() if data is None else processes(data):
            if process.covariates == covariates:
                seen.setdefault(id(process.basis), process.basis)
        return list(seen.values())

    def test_beyond_a_tenth_of_its_range_a_covariate_is_held(self) -> None:
        c = self.data.conditions
        first, length = c.time_s.min(), np.ptp(c.time_s)
        u = np.array([-2.0, -0.1, -0.05, 0.5, 1.05, 1.1, 3.0])
        basis = self.features(("time",))[1]
        told = basis.over(Conditions(first + u * length))
        held = np.clip(u, -0.1, 1.1)
        line = 2 * held - 1
        kernel = 1 + np.outer(line, line) + np.exp(-0.5 * ((held[:, None] - held) / 0.18) ** 2)
        np.testing.assert_allclose(told @ told.T, kernel, atol=5e-3)

    def test_features_of_a_reading_are_a_constant_and_its_squared_exponential_up_to_a_tenth_beyond_1_g(
        self,
    ) -> None:
        a = np.array([-3.0, -1.1, -1.05, -0.9, -0.3, 0.2, 0.9, 1.05, 1.1, 3.0])
        held = np.clip(a, -1.1, 1.1)
        bases = self.features(("reading",))
        for length, basis in zip((0.18, 0.32, 0.56, 1.0), bases, strict=True):
            for axis in (0, 1):
                ideal = np.zeros((len(a), 2))
                ideal[:, axis] = a
                told = basis.by_axis(ideal, axis)
                # The range of a reading is 2 g.
                kernel = 1 + np.exp(-0.5 * ((held[:, None] - held) / (2 * length)) ** 2)
                np.testing.assert_allclose(told @ told.T, kernel, atol=5e-3)

    def test_a_function_of_two_covariates_has_the_product_of_their_kernels(self) -> None:
        c = self.data.conditions
        (short, long) = self.features(("time", "temperature"))
        for number, both in ((2, short), (4, long)):
            parts = [self.features((name,))[number].over(c) for name in ("time", "temperature")]
            told = both.over(c)
            np.testing.assert_allclose(told @ told.T, (parts[0] @ parts[0].T) * (parts[1] @ parts[1].T))

    def test_every_covariate_enters_where_it_can_with_each_choice_of_axes_length_and_amplitude(
        self,
    ) -> None:
        every = self.every()
        count = Counter(process.covariates for process in every)
        # Of two axes three choices, once at the angle; four amplitudes.
        single = {("time",), ("temperature",), ("supply",)}
        expected = dict.fromkeys(single, 5 * (3 * 3 + 1) * 4)
        expected |= dict.fromkeys([("angle",), ("previous_angle",)], 4 * (3 + 1) * 4)
        expected[("reading",)] = 4 * 3 * 4
        pairs = itertools.combinations(("time", "temperature", "supply"), 2)
        expected |= dict.fromkeys(pairs, 2 * (2 * 3 + 1) * 4)
        assert count == expected
        assert len({(p.label, id(p.basis)) for p in every}) == len(every)
        for process in every:
            assert (process.axes == ()) == (process.where == "angle")
        assert {round(float(p.prior_sd or 0) / U, 9) for p in every} == {2.0, 4.0, 8.0, 16.0}
        weight = {which: 1.0 if len(which) == 1 else 0.3 for which in expected} | {("previous_angle",): 0.3}
        for process in every:
            which = process.covariates
            share = 0.3 * weight[which] / sum(weight.values()) / count[which]
            assert process.cost == pytest.approx(-math.log(share))

    def test_what_stood_still_and_a_turn_without_a_declared_angle_have_no_process(self) -> None:
        c = replace(surroundings(), supply_v=np.full(24, 5.0))
        names = {name for p in processes(noisy(c, 43)) for name in p.covariates}
        assert names == {"time", "temperature", "angle", "previous_angle", "reading"}
        space = from_means(G * np.eye(3), np.tile(np.eye(3), (3, 1, 1)), Conditions(np.arange(3.0)))
        told = processes(space)
        assert {term.where for term in told} == {"bias", "gain", "misalignment"}
        assert {term.covariates for term in told} == {("time",), ("reading",)}

    def test_force_is_a_covariate_of_gyros_component_by_component_and_in_no_product(self) -> None:
        rng = np.random.default_rng(43)
        force = rng.normal(size=(12, 3)) * [1.0, 0.0, 2.0]
        c = Conditions(60.0 * np.arange(12), force_g=force, temperature_c=25 + rng.normal(size=12))
        gyros = from_means(
            rng.normal(size=(12, 3)), np.tile(np.eye(3), (12, 1, 1)), c, measurement=MeanRate()
        )
        pairs = {("time", "temperature")}
        single = {("time",), ("temperature",), ("force_x",), ("force_z",)}
        assert {process.covariates for process in processes(gyros)} == single | pairs
        u = (force[:, 2] - force[:, 2].min()) / np.ptp(force[:, 2])
        told = self.features(("force_z",), gyros)[0].over(c)
        kernel = 1 + np.outer(2 * u - 1, 2 * u - 1) + np.exp(-0.5 * ((u[:, None] - u) / 0.1) ** 2)
        np.testing.assert_allclose(told @ told.T, kernel, atol=5e-3)


class TestDesign:
    def test_what_is_rounding_beside_the_columns_of_its_own_term_is_no_direction(self) -> None:
        # Terms of two, one and two columns: 1e-14 is nothing beside 1, and all that there is by itself.
        sizes = np.array([1.0, 1e-14, 1e-14, 1e-14, 1.0, 1.0, 1e-14])
        columns, length = project_off_base(np.zeros((7, 0)), np.diag(sizes), np.array([2, 1, 2, 2]))
        seen = np.array([True, False, True, False, True, True, False])
        np.testing.assert_allclose(columns, np.diag(seen.astype(float)))
        np.testing.assert_allclose(length, np.where(seen, sizes, 1.0))


class TestSearch:
    def test_every_pair_that_scores_near_the_best_one_is_scored(self) -> None:
        rows = np.eye(30)
        terms = [named(letter, 1.0) for letter in "abcdefghi"]
        target = np.concatenate([np.linspace(4.0, 3.5, 9), np.zeros(21)])
        problem = single(target, rows[:9], terms)
        pairs = set(itertools.combinations(range(9), 2))
        assert {model for model in search(problem, 2).scores if len(model) == 2} == pairs
        with within(Budget(left_out=["the time is over"])):
            assert set(map(len, search(problem, 2).scores)) == {0, 1}

    def exhaustive(self, problem: LinearProblem, prices: np.ndarray, most: int) -> dict[Model, float]:
        """Score of every model by least squares."""
        scores = {}
        for size in range(most + 1):
            for model in itertools.combinations(range(len(problem.terms)), size):
                columns = problem.columns[:, list(model)]
                fitted = columns @ np.linalg.lstsq(columns, problem.target, rcond=None)[0]
                left = float(((problem.target - fitted) ** 2).sum())
                scores[model] = 0.5 * (problem.chi2 - left) - float(prices[list(model)].sum())
        return scores

    @pytest.mark.parametrize("seed", range(4))
    def test_it_finds_the_best_of_all_models_and_scores_it_right(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rows = rng.normal(size=(9, 24))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        target = rng.normal(size=24) + 6 * rows[1] - 5 * rows[4] + 5 * rows[7]
        terms = [named(letter, 2.0) for letter in "abcdefghi"]
        problem = single(target, rows, terms)
        expected = self.exhaustive(problem, problem.cost, 3)
        found = search(problem, 3)
        assert found.best == max(expected, key=expected.__getitem__)
        for model, score in found.scores.items():
            assert score == pytest.approx(expected[model], abs=1e-3)

    @pytest.mark.parametrize("seed", range(3))
    def test_terms_that_explain_nothing_by_themselves_are_found_by_exchange_or_growth(
        self, seed: int
    ) -> None:
        # Two columns of which the difference counts, beside one that looks like it and is not.
        rng = np.random.default_rng(seed)
        basis = np.linalg.qr(rng.normal(size=(30, 3)))[0].T
        one, two = basis[0], basis[0] + 0.3 * basis[1]
        decoy = basis[1] + 0.6 * basis[2]
        rows = [row / np.linalg.norm(row) for row in (one, two, decoy)]
        problem = single(9 * basis[1] + 0.1 * rng.normal(size=30), rows, [named(n, 1.0) for n in "abc"])
        assert search(problem, 2).best == (0, 1)

    def test_noise_of_unknown_origin_costs_what_is_explained(self) -> None:
        problem = single([4.0, 0.0, 0.0], [[1.0, 0.0, 0.0]], [named("cubic", 1.5)])
        for inflation in (1.0, 2.0):
            assert search(problem, 1, inflation, spare=1).scores[(0,)] == pytest.approx(8 / inflation - 1.5)

    def test_half_of_the_checks_stay_but_for_one_name_no_wider_than_a_bias(self) -> None:
        rows = np.eye(4)
        terms = [named("bias"), named("cubic"), named(None), named("warm_up")]
        found = search(single([9, 9, 9, 9], rows, terms), 4)
        assert max(map(len, found.scores)) == 2
        tight = search(single([9.0], [[1.0]] * 3, [named("bias"), named("cubic"), named(None)]), 2)
        assert set(tight.scores) == {(), (0,), (1,)}

    def test_without_a_candidate_the_base_model_stands(self) -> None:
        assert search(single([3.0, 1.0], np.zeros((0, 2)), []), 3).scores == {(): 0.0}


class TestPosterior:
    def test_a_name_is_as_probable_as_all_models_that_have_it(self) -> None:
        problem = names_only("cubic", "warm_up")
        verdict = believed(problem, {(0,): 0.5, (0, 1): 0.3, (): 0.2}).verdict
        assert verdict.names == pytest.approx({"cubic": 0.8, "warm_up": 0.3})
        assert verdict.weights == pytest.approx({(0,): 0.5, (0, 1): 0.3, (): 0.2})

    def test_a_name_that_all_models_have_is_certain_and_never_more_for_rounding(self) -> None:
        wave = named(None, covariates=("angle",))
        terms = [named("cubic"), wave, *(named(name) for name in "abc")]
        shares = {(0, 1): 0.2, (0, 1, 2): 0.4, (0, 1, 3): 0.3, (0, 1, 4): 0.1}
        assert sum(shares.values()) > 1
        names = presence_probabilities(terms, shares)
        assert names["cubic"] == 1.0
        assert names["b"] == 0.3

    def test_the_model_is_the_best_of_the_names_that_are_most_probable_together(self) -> None:
        # Variants of one name share what they have; a single model of another name has less than they.
        problem = names_only("cubic", "cubic", "warm_up")
        found = believed(problem, {(0,): 0.32, (1,): 0.28, (2,): 0.4}).found
        assert weigh(found).best == (0,)


class TestSelection:
    @pytest.mark.parametrize("known", [True, False])
    def test_what_no_model_explains_is_assumed_for_noise_by_the_freedom_beside_the_model(
        self, known: bool
    ) -> None:
        # Beside one column three rows are left: χ² of 12.6 exceeds 11.3 once in a hundred with three
        # degrees of freedom, and with five it would not.
        data: Any = SimpleNamespace(noise_known=known, noise_dof=math.inf)
        problem = single([20.0, *[math.sqrt(4.2)] * 3], np.eye(4)[:1], [named("cubic")])
        found, inflation = choice._search_with_noise(data, problem, 1, 1, 1.0)
        assert found.best == (0,)
        assert inflation == found.inflation == pytest.approx(4.2)

    def test_where_the_noise_is_not_known_it_is_what_the_model_leaves_and_no_model_is_inadequate(
        self,
    ) -> None:
        c = turn()
        rough = ideal_mg(c) + np.random.default_rng(44).normal([5.0, -3.0], 7 * U, (24, 2))
        data = replace(read(c, rough), noise_known=False)
        chose = select(data, labelled(data, "bias[xy]", "quadratic[x]"), 2)
        assert chose.adequate
        assert [term.name for term in chose.terms] == ["bias"]
        assert chose.inflation == pytest.approx(chose.fit.chi2 / chose.fit.dof, rel=0.1)
        assert chose.inflation == pytest.approx(49.0, rel=0.6)

    def test_one_reading_more_than_parameters_shows_the_noise_where_nothing_else_does(self) -> None:
        rng = np.random.default_rng(45)
        up = rng.normal(size=(4, 3))  # the length of each, and three gains
        up /= np.linalg.norm(up, axis=1)[:, None]
        data = from_means(
            G * up + rng.normal(0, 7 * U, (4, 3)),
            np.tile(U**2 * np.eye(3), (4, 1, 1)),
            Conditions(60.0 * np.arange(4)),
        )
        chose = select(replace(data, noise_known=False), [], 0)
        assert chose.fit.dof == 1
        assert chose.inflation == pytest.approx(chose.fit.chi2, rel=1e-3)

    def test_noise_that_no_candidate_explains_is_assumed_for_all(self) -> None:
        c = turn()
        wave = np.outer(2.0 * np.cos(5 * c.angle_rad), [1.0, 1.0])
        data = read(c, ideal_mg(c) + wave)
        chose = select(data, labelled(data, "quadratic[x]"), 2)
        assert not chose.adequate
        assert not chose.terms
        # 24 squares of 2 cos on each axis over 44 degrees of freedom, in units of 0.1 mg.
        assert chose.inflation == pytest.approx(2 * 12 * 4 / U**2 / 44, rel=0.01)

    def test_models_beyond_physical_bounds_have_no_share_of_the_posterior(self) -> None:
        # A temperature that hardly moves would explain a bias by thousands of mg/°C.
        data = biased()
        c = replace(
            data.conditions, temperature_c=25.01 + 1e-4 * np.random.default_rng(45).standard_normal(24)
        )
        data = replace(data, conditions=c)
        terms = labelled(data, "bias[xy]", "bias[x]", "bias_temperature[xy](degree=1)")
        told = select(data, terms, 2)
        assert told.verdict.names.get("bias_temperature", 0.0) < 1e-6
        assert told.verdict.names["bias"] == pytest.approx(1.0)

    def test_without_a_function_that_was_refuted_the_best_of_the_others_stands(self) -> None:
        data = biased()
        drift = np.outer(0.4 * data.conditions.time_s / 1e3, [1.0, 0.0])
        data = replace(data, mean=data.mean + drift)
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        other = function("other", lambda c: np.sin(4 * c.angle_rad), ("angle",))
        line = function("line", lambda c: c.time_s / 1e3, ("time",))
        (bias,) = labelled(data, "bias[xy]")
        terms = [bias, wave, other, line]
        selection = chosen(data, terms, ((0, 1), 0.6), ((0, 2), 0.2), ((0, 3), 0.15), ((0,), 0.05))
        told = selection.without_functions([wave])
        assert {term.label for term in told.terms} == {"bias[xy]", "line"}
        assert probability_of(told, "unnamed: time") == pytest.approx(0.75)

    def test_a_bias_that_is_far_larger_than_the_rest_is_taken_out_before_forms_with_a_constant(
        self,
    ) -> None:
        data = biased(mg=(900.0, 400.0))
        chose = select(data, labelled(data, "bias[xy]", "quadratic[x]", "quadratic[y]"), 3)
        assert [term.name for term in chose.terms] == ["bias"]
        assert chose.adequate
        assert chose.fit.values.terms[0] == pytest.approx([900.0, 400.0], abs=0.2)

    @pytest.mark.parametrize("biases", [("bias[x]", "bias[xy]", "bias[y]"), ()])
    def test_a_slip_of_known_size_is_refitted_beside_the_widest_bias_that_is_a_candidate(
        self, biases: tuple[str, ...]
    ) -> None:
        off = np.array([50.0, -30.0]) if biases else np.zeros(2)
        data = slipped(by_deg=15.0)
        data = replace(data, mean=data.mean + np.random.default_rng(46).normal(off, U, (24, 2)))
        terms = labelled(data, *biases, *(f"position_slip(dwell={k})" for k in range(24)))
        terms = [replace(term, begins=14.0 * (term.dwell == 1)) for term in terms]
        fit = choice._start_with_slips(Fit.begin(data).refit(), terms)
        slip, *bias = fit.values.terms
        assert [term.label for term in fit.terms] == ["position_slip(dwell=1)", "bias[xy]"][: 1 + len(bias)]
        assert slip == pytest.approx([15.0], abs=0.03)
        assert len(bias) == bool(biases)
        np.testing.assert_allclose(bias, [off] * len(bias), atol=5 * U / math.sqrt(24))

    @pytest.mark.parametrize(
        ("worse", "taken"),
        [
            ("", 1),  # the best of the names that are likeliest together, whatever is likelier by itself
            ("1", 0),
            ("10", 3),
            ("103", 2),
            ("1032", 4),
            ("10324", 1),  # four others and no more
            ("103245", 1),
        ],
    )
    def test_a_model_that_ends_above_the_base_model_gives_way_to_the_likeliest_that_does_not(
        self, monkeypatch: pytest.MonkeyPatch, worse: str, taken: int
    ) -> None:
        shares = (0.35, 0.02, 0.2, 0.3, 0.1, 0.03)
        verdict: Any = ModelPosterior((1,), {(k,): share for k, share in enumerate(shares)}, {}, {})
        problem: Any = SimpleNamespace()
        about: Any = SimpleNamespace()

        def refitted(of: Any, model: Model, start: Any) -> Any:
            assert (of, start) == (problem, about)
            # As good as the base model but for rounding, or worse by a little.
            return SimpleNamespace(model=model, chi2=40.0 * (1 + (3e-6 if str(*model) in worse else 1e-8)))

        monkeypatch.setattr(choice, "fit_model", refitted)
        told, fit = choice._refit_best(problem, verdict, about, 40.0)
        assert told == replace(verdict, best=(taken,))
        assert vars(fit)["model"] == (taken,)

    def test_whether_a_bias_is_large_is_asked_of_a_refit_where_nothing_was_chosen_yet(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        base: Any = SimpleNamespace(chi2=1010.0, dof=10, terms=())
        with_one: Any = SimpleNamespace(terms=("bias",))
        for left, about, refitted, large in (
            (30.0, with_one, None, 3),  # 20 of an excess of 1000 remain
            (50.0, base, 30.0, 3),
            (50.0, base, 50.0, None),
            (50.0, with_one, 30.0, None),
        ):
            problem: Any = SimpleNamespace(
                widest_bias=3,
                chi2=1010.0,
                dof=10,
                width=np.full(4, 2),
                target=np.zeros(12),
                off=lambda model, target, left=left: np.sqrt([left * (model == [3])]),
            )
            trial = SimpleNamespace(chi2=refitted, dof=10)
            monkeypatch.setattr(choice, "fit_model", lambda *_, trial=trial: trial)
            assert choice._large_bias(problem, base, about) == large
            problem.dof = 2  # no reading remains to check a bias of two axes
            assert choice._large_bias(problem, base, about) == (3 if left < 40 else None)
            problem.widest_bias = None
            assert choice._large_bias(problem, base, about) is None


class TestNestedModels:
    def test_steps_come_by_what_they_take_and_each_fit_has_them_so_far(self) -> None:
        data = biased(mg=(0.5, 0.0))
        psi = np.radians(3.0) - data.conditions.angle_rad
        data = replace(data, mean=data.mean + np.outer(5.0 * np.sin(psi) ** 3, [0.0, 1.0]))
        terms = labelled(data, "bias[x]", "cubic[y]")
        selection = chosen(data, terms, ((0, 1), 1.0))
        fits, steps = nest_fits(selection, None)
        assert steps == ["cubic", "bias"]
        assert [[term.label for term in fit.terms] for fit in fits] == [
            [],
            ["cubic[y]"],
            ["cubic[y]", "bias[x]"],
        ]
        assert fits[2].chi2 == pytest.approx(selection.fit.chi2, rel=1e-3)
        assert fits[0].chi2 > fits[1].chi2 > fits[2].chi2

    def test_errors_on_check_dwells_are_those_of_readings_and_angles_there(self) -> None:
        every = biased()
        check = np.arange(24) % 4 == 3
        every = replace(every, check=check)
        data, checking = every.training, every.checking
        assert checking is not None
        fits = [Fit.begin(data).refit()]
        (term,) = labelled(data, "bias[xy]")
        fits.append(fits[0].with_terms([term], [np.zeros(2)]).refit())
        figures, design = without_folds(fits, data, checking)
        assert design == "6 check dwells"
        start, scale_x, scale_y, lean = fits[1].values.base
        bias = fits[1].values.terms[0]
        theta = checking.conditions.angle_rad
        assert theta is not None
        psi = start - theta
        left = checking.mean - bias - G * np.stack([scale_x * np.cos(psi), scale_y * np.sin(psi + lean)], 1)
        assert figures[1].heldout_rms == pytest.approx(math.sqrt((left**2).mean()), rel=1e-3)
        x, y = ((checking.mean - bias) / G / [scale_x, scale_y]).T
        shown = np.arctan2((y - x * math.sin(lean)) / math.cos(lean), x)
        off = np.degrees(np.angle(np.exp(1j * (shown - psi))))
        assert figures[1].angle_rms_deg == pytest.approx(math.sqrt((off**2).mean()), rel=1e-2)
        assert figures[1].residual_rms == pytest.approx(math.sqrt((fits[1].misfit ** 2).mean()))
        assert figures[1].chi2_per_dof == pytest.approx(fits[1].chi2 / (36 - 6))
        assert figures[0].heldout_rms is not None
        assert figures[0].heldout_rms > 10 * (figures[1].heldout_rms or 0)

    def test_without_time_and_check_dwells_nothing_is_left_out(self) -> None:
        data = biased()
        figures, design = without_folds([Fit.begin(data).refit()], data, None)
        assert design == "no dwell"
        assert (figures[0].heldout_rms, figures[0].angle_rms_deg) == (None, None)

    def test_of_few_dwells_each_is_left_out_in_turn_with_the_effects_kept(self) -> None:
        c = turn(8)
        data = read(c, noisy(c, 46).mean + np.array([5.0, -3.0]))
        terms = labelled(data, "bias[xy]")
        selection = chosen(data, terms, ((0,), 1.0))
        fits, _ = nest_fits(selection, None)
        figures, design = error_figures(selection, data, None, fits, Fold(terms, None, 1))
        assert design.startswith("each of 8 dwells in turn, effects kept")
        # Leaving one out by hand: readings are linear in the parameters but for rounding.
        psi = np.radians(3.0) - c.angle_rad
        zero, one = np.zeros(8), np.ones(8)
        rows = np.stack(
            [
                np.column_stack([-np.sin(psi), np.cos(psi), zero, zero, one, zero]),
                np.column_stack([np.cos(psi), zero, np.sin(psi), np.cos(psi), zero, one]),
            ],
            axis=1,
        )
        away = data.mean - ideal_mg(c)
        left = []
        for k in range(8):
            rest = np.arange(8) != k
            solved = np.linalg.lstsq(rows[rest].reshape(-1, 6), away[rest].ravel(), rcond=None)[0]
            left.append(away[k] - rows[k] @ solved)
        assert figures[-1].heldout_rms == pytest.approx(math.sqrt(np.mean(np.square(left))), rel=0.02)
        assert figures[-1].heldout_kept is None

    def test_where_the_others_do_not_determine_the_model_no_dwell_is_left_out(self) -> None:
        c = turn(4)
        data = read(c, noisy(c, 47).mean + np.array([5.0, -3.0]))
        terms = labelled(data, "bias[xy]", "quadratic[x]")
        selection = chosen(data, terms, ((0, 1), 1.0))
        fits, _ = nest_fits(selection, None)
        figures, design = error_figures(selection, data, None, fits, Fold(terms, None, 2))
        assert "the model has 7 parameters, too many for the other dwells" in design
        assert [one.heldout_rms for one in figures] == [None] * len(fits)

    def test_in_folds_effects_are_chosen_anew_and_with_them_kept_the_error_is_said_too(self) -> None:
        data = biased()
        terms = labelled(data, "bias[xy]", "quadratic[x]")
        selection = chosen(data, terms, ((0,), 1.0))
        fits, _ = nest_fits(selection, None)
        figures, design = error_figures(selection, data, None, fits, Fold(terms, None, 1))
        assert "whole dwells (5 folds)" in design
        assert "effects chosen again in each fold" in design
        # The bias is chosen in every fold, so that it does not matter whether it was kept.
        assert figures[-1].heldout_kept == pytest.approx(figures[-1].heldout_rms, rel=0.01)
        assert figures[-1].heldout_rms == pytest.approx(U * math.sqrt(1 + 6 / 38), rel=0.25)
        assert figures[0].heldout_rms is not None
        assert figures[0].heldout_rms > math.sqrt((25 + 9) / 2), "a fit without these dwells errs by more"

    def test_a_fold_is_made_once_for_the_guard_and_for_the_figures(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        terms = labelled(data, "bias[xy]", "quadratic[x]")
        selection = chosen(data, terms, ((0,), 1.0))
        fits, _ = nest_fits(selection, None)
        fold = Fold(terms, None, 1)
        refitted: list[int] = []
        again = Fit.again

        def counted(fit: Fit, rows: Readings) -> Fit:
            refitted.append(len(fit.terms))
            return again(fit, rows)

        monkeypatch.setattr(Fit, "again", counted)
        guard = guard_errors(selection, fits, fold)
        figures, _ = error_figures(selection, data, None, fits, fold)
        assert sorted(refitted) == [0] * 5 + [1] * 5
        assert guard[0] == figures[0].heldout_rms
        assert guard[1] == figures[1].heldout_kept

    def test_of_gyros_errors_are_said_axis_by_axis(self) -> None:
        rng = np.random.default_rng(48)
        c = Conditions(60.0 * np.arange(20), rate_dps=np.zeros((20, 3)), force_g=np.zeros((20, 3)))
        rates = rng.normal(size=(20, 3)) * [1.0, 2.0, 3.0]
        gyros = from_means(rates, np.tile(np.eye(3), (20, 1, 1)), c, measurement=MeanRate())
        check = np.arange(20) < 5
        every = replace(gyros, check=check)
        fit = Fit.begin(every.training).refit()
        ((figure,), _) = without_folds([fit], every.training, every.checking)
        expected = np.sqrt(((rates[check] - rates[~check].mean(axis=0)) ** 2).mean(axis=0))
        assert figure.heldout_by_axis == pytest.approx(dict(zip("xyz", expected, strict=True)), rel=1e-6)
        assert figure.unit == "dps"


class TestSurvival:
    def test_a_name_taken_away_stands_alone_among_the_confounded(self) -> None:
        names = Names(("bias", "cubic"), {"gravity": "why"}, (("cubic", "gravity"), ("cubic",)))
        told = reject_names(names, {"cubic": "reason", "gravity": "reason"})
        rejected = {"gravity": "reason", "cubic": "reason"}
        assert told == Names(("bias",), rejected, (("cubic", "gravity"), ("cubic",)))

    @pytest.mark.parametrize(
        ("errors", "steps"),
        [
            ([1.0, 0.5, 0.4], 2),
            ([1.0, 0.5, 0.6], 1),
            ([1.0, 0.5, 0.524], 2),
            ([1.0, 2.0, 0.9], 2),
            ([1.0, 2.0, 3.0], 0),
            ([], 2),
            ([0.0, 0.0, 0.0], 2),
        ],
    )
    def test_the_longest_model_that_is_never_worse_than_a_shorter_one_stays(
        self, errors: Sequence[float], steps: int
    ) -> None:
        assert longest_acceptable(errors, 2) == steps
        names = Names(("bias", "cubic"), {}, ())
        count, left = cut_worse_steps(names, ("bias", "cubic"), errors, None)
        assert count == steps
        assert left.accepted == ("bias", "cubic")[:steps]
        assert set(left.rejected) == {"bias", "cubic"} - set(left.accepted)

    def test_the_reason_has_the_errors_with_and_without_it_in_their_unit(self) -> None:
        names = Names(("bias", "cubic"), {}, ())
        left = cut_worse_steps(names, ("bias", "cubic"), (1.0, 0.5, 0.75), None, "dps")[1]
        assert left.rejected == {"cubic": "the held-out error would go from 0.5 to 0.75 dps with it"}
        stated = cut_worse_steps(names, ("bias",), (1.0, 0.5), (0.2, 0.4))[1]
        assert stated.rejected == {"bias": "the held-out error would go from 0.2 to 0.4 mg with it"}

    def test_functions_that_only_longer_models_have_are_refuted_and_names_are_not(self) -> None:
        wave, line = named(None, covariates=("angle",)), named(None, covariates=("time",))
        cubic = named("cubic")
        fits: Any = [
            SimpleNamespace(terms=terms) for terms in ((), (wave,), (wave, line), (wave, line, cubic))
        ]
        selection: Any = SimpleNamespace(terms=(wave, line, cubic))
        assert harmful_functions(selection, fits, [1.0, 0.5, 0.6, 0.6]) == [line]
        assert harmful_functions(selection, fits, [1.0, 0.5, 0.5, 0.5]) == []
        assert harmful_functions(selection, fits[:3], [1.0, 0.5, 0.4]) == []

    def test_of_a_model_that_leaves_too_few_readings_all_names_but_a_bias_are_open_with_the_reason(
        self,
    ) -> None:
        # Backlash comes before a bias in the alphabet.
        names = Names(("backlash", "bias", "cubic"), {"gravity": "why"}, ())
        selection: Any = SimpleNamespace(fit=SimpleNamespace(dof=1))
        reason = "the model leaves 1 readings to check it by: too few"
        assert reject_unchecked(names, selection) == Names(
            ("bias",),
            {"gravity": "why", "backlash": reason, "cubic": reason},
            (("backlash",), ("cubic",)),
        )

    def test_a_name_of_which_one_term_stays_is_not_taken_away(self) -> None:
        names = Names(("bias", "outlier_dwell"), {}, ())
        steps = ("bias", "outlier_dwell", "outlier_dwell")
        assert cut_worse_steps(names, steps, (1.0, 0.5, 0.3, 0.6), None) == (2, names)

    def test_names_are_weak_by_what_is_likelier_what_was_not_checked_and_what_is_no_larger_than_its_u(
        self,
    ) -> None:
        def of(name: str, value: float) -> Finding:
            return Finding(name, (), {"a": Value(value, 1.0, "mg")}, 0.0, 0.0, 1.0)

        found = [of("bias", 9.0), of("cubic", 9.0), of("gravity", 0.5), of("backlash", 9.0)]
        checked, unchecked = ErrorFigures(1.0, 1.0, None, None), ErrorFigures(1.0, None, None, None)
        weak = weak_names(found, checked, {"backlash": "unnamed: angle"}, {})
        assert set(weak) == {"gravity", "backlash"}
        assert "no larger than their own uncertainty" in weak["gravity"]
        assert "unnamed: angle" in weak["backlash"]
        assert set(weak_names(found, unchecked, {}, {})) == {"cubic", "gravity", "backlash"}

    def test_a_name_that_most_models_do_not_have_in_its_place_is_not_found(self) -> None:
        # Models that predict the same are one, of which a slip and a backlash are found; by themselves
        # nearly all of them have one step in the place of the backlash, and nothing for the slip.
        checked = ErrorFigures(1.0, 1.0, None, None)
        # Other names that predict the same in its place count with it.
        for probability, equal, found in (
            (0.06, 0.0, False),
            (0.54, 0.0, False),
            (0.56, 0.0, True),
            (0.44, 0.1, False),
            (0.44, 0.12, True),
        ):
            slip = Finding("position_slip", (), {"slip": Value(-0.15, 0.01, "deg")}, 0.0, 0.0, probability)
            weak = weak_names([slip], checked, {}, {"position_slip": equal})
            assert (weak == {}) == found
            assert found or format_percent(1 - probability - equal) in weak["position_slip"]

    def test_check_dwells_that_do_not_agree_are_said_with_their_number(self) -> None:
        check = np.arange(24) % 4 == 0
        for off_mg, said in ((0.0, False), (1.0, True)):
            data = biased()
            data = replace(data, mean=data.mean + np.outer(check, [off_mg, 0.0]))
            selection = chosen(data.rows(~check), labelled(data, "bias[xy]"), ((0,), 1.0))
            told = disagreement_of(selection, data.rows(check))
            assert bool(told) == said
            assert all(note.startswith("the 6 check dwells do not agree") for note in told)

    @pytest.mark.parametrize(("n", "least"), [(1, "2 positions"), (2, None)])
    def test_a_turn_wants_as_many_equations_as_base_parameters(self, n: int, least: str | None) -> None:
        data = noisy(turn(24), 49).rows(np.arange(24) < n)
        if least is None:
            refuse_too_few(data)
        else:
            with pytest.raises(
                FitError, match=f"2 equations for 4 base parameters; measure at least {least}"
            ):
                refuse_too_few(data)

    def test_in_space_a_pose_is_one_equation_and_one_reading_of_gyros_is_too_few(self) -> None:
        two = from_means(G * np.eye(3)[:2], np.tile(np.eye(3), (2, 1, 1)), Conditions(np.arange(2.0)))
        with pytest.raises(FitError, match="2 equations for 6 base parameters; measure at least 6 pos"):
            refuse_too_few(two)
        c = Conditions(np.zeros(1), rate_dps=np.zeros((1, 3)))
        gyros = from_means(np.zeros((1, 3)), np.eye(3)[None], c, measurement=MeanRate())
        with pytest.raises(FitError, match="one reading alone"):
            refuse_too_few(gyros)


class TestAverages:
    @pytest.mark.parametrize(
        ("adequate", "known", "called_for"),
        [(True, True, False), (True, False, False), (False, False, False), (False, True, True)],
    )
    def test_names_alone_are_averaged_where_they_are_inadequate_under_known_noise(
        self, monkeypatch: pytest.MonkeyPatch, adequate: bool, known: bool, called_for: bool
    ) -> None:
        data = replace(biased(), noise_known=known)
        selection = replace(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), adequate=adequate)
        smooth = processes(data)[:3]
        for gained, wanted in ((20.0, called_for), (-20.0, False)):
            monkeypatch.setattr(
                averaging, "evidence", lambda *_, gained=gained: np.array([-9.0, gained, -9.0])
            )
            averaged = average(selection, smooth)
            assert (averaged is not None) == wanted
            if averaged is not None:
                assert averaged.smooth is smooth[1]
                assert averaged.weight == pytest.approx(1.0)
                assert [term.name for term in averaged.terms if term.name] == ["bias"]

    def test_formulas_and_processes_weigh_by_their_evidence_against_the_names_alone(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        theta = data.conditions.angle_rad
        assert theta is not None
        data = replace(data, mean=data.mean + np.outer(0.12 * np.cos(4 * theta), [1.0, 0.0]))
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        terms = [*labelled(data, "bias[xy]"), wave]
        selection = chosen(data, terms, ((0, 1), 0.9), ((0,), 0.1))
        column = np.cos(4 * theta)
        # Equal steps: a wave of four cycles is at right angles to base model and bias.
        gained = 0.5 * (column @ data.mean[:, 0]) ** 2 / (column @ column) / U**2
        price = {t.label: p for t, p in zip(selection.problem.terms, selection.found.prices, strict=True)}
        formula = gained - price["wave"]
        smooth = processes(data)[:2]
        monkeypatch.setattr(averaging, "evidence", lambda *_: np.array([formula - 1.0, formula - 9.0]))
        averaged = average(selection, smooth)
        assert averaged is not None
        share = math.exp(-1) / (1 + math.exp(-1))
        assert averaged.weight == pytest.approx(share, abs=2e-3)
        (mixed,) = [term for term in averaged.terms if isinstance(term, AveragedTerm)]
        told = {own.label: weight for weight, own, _ in mixed.members}
        # What has less than a hundredth is left out.
        assert told == pytest.approx({"wave": 1 - share, smooth[0].label: share}, abs=2e-3)
        assert list(averaged.promising) == smooth[:2]

    def test_check_dwells_refuse_an_average_as_often_as_its_p_value_says(self) -> None:
        # Functions of time drawn from the first process; the second one bends less.
        refused = {0.0: 0, 1.0: 0}
        label = "bias[x]~a smooth function of time (16 u)"
        for seed in range(40):
            data = noisy(surroundings(32, seed), seed)
            smooth = [one for one in processes(data) if one.label == label]
            term = smooth[1]
            rng = np.random.default_rng(1000 + seed)
            features = term.columns(data.mean, data.conditions)
            added = features @ rng.normal(0, term.prior_sd or 0.0, features.shape[-1])
            check = np.isin(np.arange(32), rng.choice(np.arange(1, 31), 8, replace=False))
            for off_mg in refused:
                moved = data.mean + added + np.outer(check, [off_mg, 0.0])
                seen = replace(data, mean=moved)
                fitted = seen.rows(~check)
                selection = chosen(fitted, labelled(fitted, "bias[xy]"), ((0,), 1.0))
                averaged = average(replace(selection, adequate=False), smooth[1:3])
                fit = selection.fit if averaged is None else averaged
                refused[off_mg] += disagreement_p_value(fit, seen.rows(check)) < 0.05
        assert refused[0.0] <= 6  # two are expected
        assert refused[1.0] >= 36

    @pytest.mark.parametrize(
        ("inflation", "adequate", "asked"),
        [(4.0, True, [1.0]), (4.0, False, [1.0, 4.0]), (1.0, True, [1.0])],
    )
    def test_what_is_adequate_under_the_measured_noise_is_weighed_under_that(
        self, monkeypatch: pytest.MonkeyPatch, inflation: float, adequate: bool, asked: list[float]
    ) -> None:
        data = biased()
        selection = replace(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), inflation=inflation)
        fit = selection.fit if adequate else selection.base
        seen: list[float] = []

        def weighed(own: Any, candidates: Any) -> Any:
            seen.append(own.inflation)
            return fit

        monkeypatch.setattr(averaging, "_average", weighed)
        told: Any = average(selection)
        assert seen == asked
        assert told is fit

    def test_under_more_noise_it_is_weighed_again_where_under_the_measured_one_nothing_is_called_for(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        data = biased()
        selection = replace(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), inflation=4.0)
        monkeypatch.setattr(
            averaging, "_average", lambda own, candidates: None if own.inflation == 1 else "an average"
        )
        assert average(selection) == "an average"

    @pytest.mark.parametrize("inflation", [1.0, 2.0])
    def test_formulas_are_those_of_models_with_the_same_names_by_evidence_beside_these(
        self, inflation: float
    ) -> None:
        data = biased()
        theta = np.asarray(data.conditions.angle_rad)
        waves = {
            "one": function("one", lambda c: np.cos(4 * c.angle_rad), ("angle",)),
            "two": function("two", lambda c: np.sin(4 * c.angle_rad), ("angle",)),
            "three": function("three", lambda c: np.cos(5 * c.angle_rad), ("angle",)),
        }
        terms = [*labelled(data, "bias[xy]", "outlier_dwell[y](dwell=7)"), *waves.values()]
        # The chosen one stays though it is far behind; with another name or without the bias none does.
        models = (((0, 2), 1e-4), ((0, 3), 0.5), ((0, 1, 4), 0.3), ((3,), 0.1), ((0,), 0.1), ((0, 4), 1e-5))
        selection = replace(chosen(data, terms, *models), inflation=inflation)
        number = {term.label: k for k, term in enumerate(selection.problem.terms)}
        pool = averaging._formulas(selection, (number["bias[xy]"],), [])
        told = [(own.label, score) for score, (own,) in pool]
        # Equal steps: a wave of four cycles is at right angles to base model and bias.
        columns = {"one": np.cos(4 * theta), "two": np.sin(4 * theta)}
        expected = {
            name: 0.5 * (column @ data.mean[:, 0]) ** 2 / (column @ column) / U**2 / inflation
            - float(selection.found.prices[number[name]])
            for name, column in columns.items()
        }
        assert sorted(label for label, _ in told) == ["one", "two"]
        assert dict(told) == pytest.approx(expected, abs=1e-3)

    def fitted(self, selection: Any, *parts: Any) -> Any:
        """The average of parts of these weights, the columns of each part, and the target."""
        fit = selection.fit
        base, blocks, target = fit.linear()
        fixed = np.concatenate([base, *blocks], axis=1)
        pool = [(0.0, terms) for _, terms in parts]
        weights = np.array([weight for weight, _ in parts])
        columns = [
            np.concatenate([fixed, *(fit.white(fit.candidate(term)) for term in terms)], axis=1)
            for _, terms in parts
        ]
        solutions = averaging.fit_members(selection, fixed, target, pool, weights)
        no_process: Any = None
        spent = averaging.AveragedFit(
            *(fit.data, fit.terms, fit.values, fit.with_prior),
            solutions=solutions,
            inflation=selection.inflation,
            selected=fit,
            smooth=no_process,
            weight=1.0,
            promising=(),
        )
        return spent, columns, target

    @pytest.mark.parametrize("inflation", [1.0, 2.0])
    def test_what_is_fixed_is_as_uncertain_as_within_and_between_the_members(
        self, inflation: float
    ) -> None:
        data = biased()
        data = replace(data, mean=data.mean + np.outer(data.conditions.time_s / 1e3, [1.0, 0.0]))
        selection = replace(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), inflation=inflation)
        line = function("line", lambda c: c.time_s / 1e3)
        curve = function("curve", lambda c: (c.time_s / 1e3) ** 2)
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        spent, columns, target = self.fitted(
            selection, (0.75, (line,)), (0.0, (curve,)), (0.25, (wave, curve))
        )
        assert [(one.weight, [own.label for own in one.terms]) for one in spent.solutions] == [
            (0.75, ["line"]),
            (0.25, ["wave", "curve"]),
        ]
        one, two = (np.linalg.lstsq(columns[k], target, rcond=None)[0] for k in (0, 2))
        for solution, expected in zip(spent.solutions, (one, two), strict=True):
            assert solution.values == pytest.approx(expected, rel=1e-3, abs=1e-4)
        # The law of total variance, in units of the noise that is assumed.
        within = [np.linalg.inv(columns[k].T @ columns[k])[:6, :6] for k in (0, 2)]
        apart = one[:6] - two[:6]
        total = 0.75 * within[0] + 0.25 * within[1] + 0.75 * 0.25 * np.outer(apart, apart) / inflation
        np.testing.assert_allclose(spent.covariance, total, rtol=1e-3, atol=1e-12)
        # The mean function at the middle of the session, likewise; nothing acts on y.
        joint = spent.joint_covariance
        np.testing.assert_allclose(joint[:6, :6], spent.covariance, rtol=1e-9, atol=1e-12)
        at_s = float(data.conditions.time_s.min() + data.conditions.time_s.max()) / 2e3
        inside = [np.linalg.inv(columns[k].T @ columns[k])[-1, -1] for k in (0, 2)]
        values = 0.75 * inside[0] * at_s**2, 0.25 * inside[1] * at_s**4
        apart_mg = one[6] * at_s - two[7] * at_s**2
        assert joint[6, 6] == pytest.approx(sum(values) + 0.75 * 0.25 * apart_mg**2 / inflation, rel=1e-3)
        assert joint[7, 7] == 0
        assert spent.used == pytest.approx(0.75 * 7 + 0.25 * 8, abs=1e-3)

    @pytest.mark.parametrize(("u", "inflation"), [(0.1, 1.0), (0.1, 3.0), (5.0, 1.0)])
    def test_a_process_is_held_by_its_prior_however_coarse_the_readings_are(
        self, u: float, inflation: float
    ) -> None:
        data = biased(u=u)
        selection = replace(chosen(data, labelled(data, "bias[xy]"), ((0,), 1.0)), inflation=inflation)
        term = next(p for p in processes(data) if p.covariates == ("time",))
        fit = selection.fit
        rng = np.random.default_rng(49)
        fixed, target = rng.normal(size=(48, 6)), 2 * rng.normal(size=48)
        unseen = np.column_stack([fixed, np.zeros(48)])  # of a parameter that the dwells do not show
        told = averaging.solve_ridge(selection, unseen, target, [term])
        # The same as noise of the rows: generalised least squares of what is fixed.
        features = fit.white(fit.candidate(term))
        prior = (term.prior_sd or 0) ** 2 / inflation
        firm = np.linalg.inv(np.eye(48) + prior * features @ features.T)
        expected = np.linalg.inv(fixed.T @ firm @ fixed)
        base = expected @ fixed.T @ firm @ target
        left = firm - firm @ fixed @ expected @ fixed.T @ firm
        np.testing.assert_allclose(told.values[:6], base, rtol=1e-6)
        added = features @ told.values[7:]
        np.testing.assert_allclose(added, prior * features @ features.T @ left @ target)
        np.testing.assert_allclose((told.half @ told.half.T)[:6, :6], expected, rtol=1e-6)
        assert told.used == pytest.approx(48 - np.trace(left))
        assert told.visible == 1.0

    def test_members_at_the_angle_and_at_the_readings_are_two_terms_by_the_likeliest_of_each(self) -> None:
        one = function("one", lambda c: c.time_s, ("time",))
        two = replace(function("two", lambda c: c.supply_v, ("supply",)), axes=(1,))
        turned = function("turned", lambda c: c.time_s, ("time",), where="angle")
        members = [(0.2, one, np.ones(1)), (0.5, two, np.ones(1)), (0.3, turned, np.ones(1))]
        readings, angle = averaging._averaged_terms(members)
        assert (readings.where, readings.axes, readings.covariates) == ("bias", (0, 1), ("supply",))
        assert [own.label for _, own, _ in readings.members] == ["one", "two"]
        assert (angle.where, angle.axes, angle.covariates) == ("angle", (), ("time",))
        assert [own.label for _, own, _ in angle.members] == ["turned"]
        assert [term.label for term in averaging._averaged_terms(members[2:])] == ["average at the angle"]

    def test_a_polynomial_gives_way_to_a_process_in_its_place_and_a_formula_does_not(self) -> None:
        covered: Any = {("bias", ("time",))}
        formula = function("formula", lambda c: c.time_s)
        smooth = function("smooth", lambda c: c.time_s, approximates=True)
        elsewhere = replace(smooth, where="gain")
        other = replace(smooth, covariates=("supply",))
        told = [
            averaging._covered_by_process(term, covered) for term in (formula, smooth, elsewhere, other)
        ]
        assert told == [False, True, False, False]

    def test_an_average_adds_the_weighted_mean_and_has_no_columns(self) -> None:
        c = turn()
        ideal = ideal_mg(c)
        wave = function("wave", lambda c: np.cos(4 * c.angle_rad), ("angle",))
        line = function("line", lambda c: c.time_s / 1e3, ("time",))
        members = ((0.3, wave, np.array([2.0])), (0.7, line, np.array([-1.0])))
        term = AveragedTerm("average", ("time",), 0.0, "bias", (0,), line.basis, members=members)
        expected = 0.3 * 2 * np.cos(4 * c.angle_rad) - 0.7 * c.time_s / 1e3
        np.testing.assert_allclose(term.added(np.zeros(0), ideal, c), np.outer(expected, [1.0, 0.0]))
        assert term.form == "bias of x follows line"
        assert term.columns(ideal, c).shape == (24, 2, 0)
        turned = AveragedTerm("average", ("time",), 0.0, "angle", (), line.basis, members=members)
        assert turned.columns(ideal, c).shape == (24, 0)


class TestNamedCandidates:
    def test_why_an_effect_is_no_candidate_is_said(self) -> None:
        missing = named_terms(noisy(turn(), 53))[1]
        assert missing["bias_temperature"].reason == "temperature_c not recorded"
        assert missing["bias_temperature"].lacking == ("temperature_c",)
        assert missing["saturation"].lacking == ()
        assert missing["saturation"].reason == "looked for within the dwells"
        free = from_means(G * np.eye(3), np.tile(np.eye(3), (3, 1, 1)), Conditions(np.arange(3.0)))
        assert "stage_eccentricity" in named_terms(free)[1]

    def test_in_space_an_outlier_is_of_the_axis_nearest_to_gravity(self) -> None:
        mean = G * np.array([[0.9, 0.3, -0.3], [0.1, -0.99, 0.1], [0.0, 0.6, 0.8]])
        c = Conditions(60.0 * np.arange(3), order=np.arange(3.0))
        data = from_means(mean, np.tile(np.eye(3), (3, 1, 1)), c, check=np.array([False, False, True]))
        labels = [t.label for t in named_terms(data)[0] if t.name == "outlier_dwell"]
        assert labels == ["outlier_dwell[x](dwell=0)", "outlier_dwell[y](dwell=1)"]

    def test_time_constants_go_from_the_distance_of_dwells_to_half_again_the_session(self) -> None:
        # 24 dwells a minute apart.
        data = noisy(turn(), 54)
        grid = sorted({t.shapes[0][1] for t in named_terms(data)[0] if t.name == "warm_up"})
        assert (grid[0], grid[-1]) == (pytest.approx(60.0), pytest.approx(1.5 * 23 * 60))
        assert np.diff(np.log(grid)) == pytest.approx(np.full(len(grid) - 1, math.log(grid[1] / grid[0])))

    def test_a_dwell_between_two_and_one_for_checking_have_no_effect_of_their_own(self) -> None:
        data = noisy(turn(6, order=np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0])), 56)
        data = replace(data, check=np.array([False, False, True, False, False, False]))
        terms = [t for t in named_terms(data)[0] if t.name == "position_slip"]
        assert [t.dwell for t in terms] == [0, 2, 3]

    @pytest.mark.parametrize(("levels", "degrees"), [(2, {1}), (3, {1, 2}), (24, {1, 2, 3})])
    def test_a_temperature_of_few_levels_shows_few_powers(self, levels: int, degrees: set[int]) -> None:
        c = turn(temperature_c=25 + np.arange(24.0) % levels)
        terms = named_terms(noisy(c, 55))[0]
        assert {t.effect.degree for t in terms if t.name == "bias_temperature"} == degrees


def test_what_a_model_knows_of_its_values_is_not_lost_to_rounding_where_columns_are_nearly_alike() -> None:
    data = noisy(turn(), 61)
    data = replace(data, own_covariance=1e-20 * data.own_covariance)
    functions = {term.label: term for term in nameless_terms(data)}
    smooth = functions["bias[x]~a smooth function of the angle (harmonics to 6)"]
    terms = [*labelled(data, "bias[xy]", "cubic[xy]"), smooth]
    widths = [term.columns(data.mean, data.conditions).shape[-1] for term in terms]
    fit = Fit.begin(data).refit()
    fit = fit.with_terms(terms, [term.start(np.zeros(w)) for term, w in zip(terms, widths, strict=True)])
    told = fitted_hypothesis(fit, 1.0, 1.0)
    rows = whitened_columns(fit, fit.whitener).reshape(-1, len(told.root))
    _, precision = parameter_prior(fit, rows)
    scaled = rows / np.sqrt(precision)
    assert scaled.shape[1] > 13
    # XᵀX + 1 has the variances 1/(s² + 1) along X's right singular vectors.
    _, size, along = np.linalg.svd(scaled)
    exact = (along.T / (size**2 + 1)) @ along
    variance = np.diag(told.root @ told.root.T) * precision
    np.testing.assert_allclose(variance, np.diag(exact), rtol=1e-9)
    formed = np.linalg.inv(scaled.T @ scaled + np.eye(len(precision)))
    assert np.abs(np.diag(formed) / np.diag(exact) - 1).max() > 1e-7, "the case is too easy"
    assert told.evidence == pytest.approx(-0.5 * (told.chi2 + np.log(size**2 + 1).sum()), rel=1e-9)
