"""Noise that dwells share: the whitening of `trace` against the covariance of all readings together."""

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.spectrum import covariance_of_means, modes
from adis_gonio.tracing.linear_problem import linearise, span
from adis_gonio.tracing.model_search import search
from adis_gonio.tracing.named_candidates import named_terms
from tracing.small_problems import observations

ALLAN_MG = np.array([0.3, 0.1])


def shared(data: Readings, allan_mg=ALLAN_MG) -> tuple[Readings, np.ndarray]:
    """The same with 1/f noise in its covariance, and the covariance (n·axes, n·axes) of that noise."""
    n, axes = data.mean.shape
    time = data.conditions.time_s
    factor, _ = modes(covariance_of_means(time - 5, time + 5))
    k = factor.shape[1]
    slow = np.zeros((n, axes, axes * k))
    for axis, level in enumerate(allan_mg):
        slow[:, axis, axis * k : (axis + 1) * k] = level * factor
    flat = slow.reshape(n * axes, -1)
    return replace(data, slow=slow), flat @ flat.T


def in_space(n: int = 20, seed: int = 1) -> Readings:
    rng = np.random.default_rng(seed)
    data = observations(n=n)
    unit = rng.normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return from_means(
        1000 * unit,
        np.tile(0.01 * np.eye(3), (n, 1, 1)),
        replace(data.conditions, angle_rad=None, previous_angle_rad=None, approach=None),
        fixture_rad=float("inf"),
    )


def whole_covariance(data: Readings, slow: np.ndarray) -> np.ndarray:
    n, axes = data.mean.shape
    total = slow.copy()
    for i in range(n):
        block = slice(axes * i, axes * (i + 1))
        total[block, block] += data.own_covariance[i]
    return total


@pytest.mark.parametrize("fixture_deg", [0.0, 0.02])
def test_rows_in_a_plane_are_white_under_the_covariance_of_all_readings(fixture_deg: float) -> None:
    data, slow = shared(observations(fixture_deg=fixture_deg))
    at = Fit.begin(data)
    total = whole_covariance(data, slow)
    n = len(data)
    for i in range(n):
        t = at.tangent[i, :, 0]
        total[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += data.fixture_rad**2 * np.outer(t, t)
    root = at.white(np.eye(2 * n).reshape(n, 2, 2 * n))
    np.testing.assert_allclose(root @ total @ root.T, np.eye(2 * n), atol=1e-8)


@pytest.mark.parametrize("space", [False, True])
def test_rows_of_free_attitudes_are_white_and_nothing_is_left_along_the_tangents(space: bool) -> None:
    data = in_space() if space else replace(observations(), fixture_rad=float("inf"))
    data, slow = shared(data, [0.3, 0.1, 0.2][: data.axes])
    at = Fit.begin(data)
    n, axes = data.mean.shape
    root = at.white(np.eye(axes * n).reshape(n, axes, axes * n))
    assert root.shape == (n, axes * n)
    np.testing.assert_allclose(root @ whole_covariance(data, slow) @ root.T, np.eye(n), atol=1e-8)
    along = at.white(at.tangent)
    assert np.abs(along).max() < 1e-6 * np.abs(at.tangent).max()


def test_some_of_the_dwells_have_the_covariance_of_those() -> None:
    data, slow = shared(observations(fixture_deg=0.0))
    rows = np.flatnonzero(np.arange(len(data)) % 3 > 0)
    some = data.rows(rows)
    flat = (2 * rows[:, None] + np.arange(2)).ravel()
    m = len(rows)
    root = Fit.begin(some).white(np.eye(2 * m).reshape(m, 2, 2 * m))
    total = whole_covariance(data, slow)[np.ix_(flat, flat)]
    np.testing.assert_allclose(root @ total @ root.T, np.eye(2 * m), atol=1e-8)
    mask = np.isin(np.arange(len(data)), rows)
    np.testing.assert_array_equal(data.rows(mask).slow, some.slow)


def test_problem_refit_and_gates_agree_on_chi2() -> None:
    data, _ = shared(observations(seed=4))
    fit = Fit.begin(data).refit()
    terms = named_terms(data)[0]
    problem = linearise(fit, terms)
    assert problem.chi2 == pytest.approx(fit.chi2, rel=1e-3)
    base, _, target = fit.linear()
    left = target - base @ np.linalg.lstsq(base, target, rcond=1e-10)[0]
    assert left @ left == pytest.approx(fit.chi2, rel=1e-3)
    k = next(i for i, term in enumerate(problem.terms) if term.label == "bias_drift[y]")
    refitted = fit.with_terms((problem.terms[k],), (np.zeros(1),)).refit()
    chi2 = float((span(problem, [k])[1] ** 2).sum())
    assert refitted.chi2 == pytest.approx(chi2, rel=1e-3)


def test_slow_noise_is_believed_for_what_it_is() -> None:
    """Gain of a drift under 1/f noise: that of one degree of freedom only where the noise is shared."""
    clean, _ = shared(observations(u=0.05))
    apart = replace(clean, slow=clean.slow[:, :, :0])
    named = {term.label: term for term in named_terms(clean)[0]}
    terms = [named["bias[xy]"], named["bias_drift[x]"]]
    rng = np.random.default_rng(8)
    squares = {"shared": [], "apart": []}
    for seed in range(60):
        noise = clean.slow @ rng.standard_normal(clean.slow.shape[2])
        mean = observations(u=0.05, seed=seed).mean + noise
        for which, data in (("shared", clean), ("apart", apart)):
            data = replace(data, mean=mean)
            problem = linearise(Fit.begin(data).refit(), terms)
            order = [next(k for k, term in enumerate(problem.terms) if term is one) for one in terms]
            without, beside = (float((span(problem, order[:m])[1] ** 2).sum()) for m in (1, 2))
            squares[which].append(without - beside)
    assert 0.55 < np.mean(squares["shared"]) < 1.6  # χ² of one degree, 60 draws: 1 ± 0.18
    assert np.mean(squares["apart"]) > 2.0


def test_without_shared_noise_whitening_is_dwell_by_dwell() -> None:
    data = observations()
    at = Fit.begin(data)
    expected = np.einsum("nrk,nk->nr", at.whitener, at.declared_misfit)
    np.testing.assert_allclose(at.residual, expected, rtol=1e-12, atol=1e-12)
    none = replace(data, slow=np.zeros((len(data), 2, 0)))
    np.testing.assert_array_equal(Fit.begin(none).residual, at.residual)


def test_gain_of_a_wide_block_is_exact_where_it_is_large() -> None:
    """A bias of hundreds of uncertainties must not score less than itself beside anything else."""
    bias = np.array([30.0, -20.0])
    data = observations(added=lambda c, g: bias, u=0.05, seed=6)
    problem = linearise(Fit.begin(data).refit(), named_terms(data)[0])
    k = next(i for i, term in enumerate(problem.terms) if term.label == "bias[xy]")
    found = search(problem, 2)
    exact = 0.5 * (problem.chi2 - float((span(problem, [k])[1] ** 2).sum()))
    assert exact > 1e4
    assert found.explained((k,)) == pytest.approx(exact, abs=0.05)
