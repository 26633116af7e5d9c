"""The algebra of a fit: whitening against the dense covariance, attitudes and steps against brute force."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, Values, adequacy, predictable_dwells
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import Basis, NamedTerm, NamelessTerm
from adis_gonio.model.effects import Conditions, effect
from adis_gonio.model.measurement import sensitivity

BASE = np.array([0.3, 1.02, 0.99, 0.01])
G = 1000.0


def planar(
    n: int = 9,
    *,
    noise: float = 1.0,
    fixture: float = 0.01,
    seed: int = 1,
    undeclared: tuple[int, ...] = (),
) -> tuple[Readings, Floats]:
    """A turn with unequal, correlated noise, and the deviations of the stage."""
    rng = np.random.default_rng(seed)
    theta = 2 * math.pi * np.arange(n) / n
    delta = 0.01 * rng.standard_normal(n)
    psi = BASE[0] - theta + delta
    ideal = G * np.stack([BASE[1] * np.cos(psi), BASE[2] * np.sin(psi + BASE[3])], axis=1)
    roots = noise * (np.eye(2) + 0.3 * rng.standard_normal((n, 2, 2)))
    mean = ideal + (roots @ rng.standard_normal((n, 2, 1)))[:, :, 0]
    theta[list(undeclared)] = np.nan
    declared = None if undeclared else theta
    conditions = Conditions(time_s=10.0 * np.arange(n), angle_rad=declared, order=np.arange(float(n)))
    data = from_means(mean, roots @ roots.transpose(0, 2, 1), conditions, fixture_rad=fixture)
    return replace(data, angle_rad=theta), delta


def spatial(n: int = 8, *, noise: float = 1.0, seed: int = 2) -> tuple[Readings, Floats]:
    """Poses, and the base parameters of the part."""
    rng = np.random.default_rng(seed)
    base = np.array([1.01, 0.98, 1.02, 0.01, -0.02, 0.015])
    unit = rng.standard_normal((n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    roots = noise * (np.eye(3) + 0.2 * rng.standard_normal((n, 3, 3)))
    mean = G * unit @ sensitivity(base).T + (roots @ rng.standard_normal((n, 3, 1)))[:, :, 0]
    return from_means(mean, roots @ roots.transpose(0, 2, 1), Conditions(time_s=np.arange(float(n)))), base


def at(data: Readings, base: Floats, **more: bool) -> Fit:
    """A fit at given base parameters, the attitudes as the readings have them."""
    begun = Fit.begin(data, **more)
    return replace(begun, values=Values(base, begun.values.attitude)).settled(6)


def with_attitudes(fit: Fit) -> Floats:
    """C⁻¹ of all readings, dense: own noise, what dwells share, and each attitude at its prior."""
    data, n = fit.data, len(fit.data)
    dense = block_diag(*data.own_covariance)
    if data.slow.size:
        flat = data.slow.reshape(dense.shape[0], -1)
        dense = dense + flat @ flat.T
    known = np.isfinite(fit.data.fixture)
    tangents = [fit.tangent[k] * (fit.data.fixture[k] if known[k] else 1.0) for k in range(n)]
    prior = block_diag(*[t if known[k] else np.zeros_like(t) for k, t in enumerate(tangents)])
    inverse = np.linalg.inv(dense + prior @ prior.T)
    open_ = block_diag(*[t for k, t in enumerate(tangents)])
    keep = np.repeat(~known, fit.data.model.freedom)
    open_ = open_[:, keep]
    if not open_.shape[1]:
        return inverse
    # Of no prior at all nothing is left along the tangent: the limit of an ever larger variance.
    return inverse - inverse @ open_ @ np.linalg.solve(open_.T @ inverse @ open_, open_.T @ inverse)


@pytest.mark.parametrize("noise", [0.5, 4000.0], ids=["small noise", "noise beyond the signal"])
@pytest.mark.parametrize("kind", ["exact", "stage", "one undeclared", "free", "space"])
def test_whitened_rows_have_the_products_of_the_dense_covariance(kind: str, noise: float) -> None:
    if kind == "space":
        data, base = spatial(noise=noise)
    else:
        sigma = {"exact": 0.0, "free": math.inf}.get(kind, 0.02)
        data, _ = planar(noise=noise, fixture=sigma, undeclared=(4,) if kind == "one undeclared" else ())
        base = BASE
    fit = at(data, base)
    columns = np.random.default_rng(3).standard_normal((*data.mean.shape, 4))
    flat = columns.reshape(-1, 4)
    white = fit.white(columns)
    expected = flat.T @ with_attitudes(fit) @ flat
    np.testing.assert_allclose(white.T @ white, expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("size", [0.1, 3.0])
@pytest.mark.parametrize("kind", ["stage", "exact"])
def test_noise_that_dwells_share_is_whitened_as_the_dense_covariance_has_it(kind: str, size: float) -> None:
    data, _ = planar(fixture=0.0 if kind == "exact" else 5e-4)
    slow = size * np.random.default_rng(4).standard_normal((len(data), 2, 3))
    fit = at(replace(data, slow=slow), BASE)
    columns = np.random.default_rng(3).standard_normal((*data.mean.shape, 4))
    flat = columns.reshape(-1, 4)
    white = fit.white(columns)
    np.testing.assert_allclose(white.T @ white, flat.T @ with_attitudes(fit) @ flat, rtol=1e-9, atol=1e-9)
    left = fit.declared_misfit.ravel()
    assert fit.chi2 == pytest.approx(left @ with_attitudes(fit) @ left, rel=1e-9)
    # What a whitened row changes by with a reading is the transpose of the same.
    slope = np.random.default_rng(5).standard_normal((len(white), 2))
    by_reading = fit.by_reading(slope)
    np.testing.assert_allclose(by_reading.reshape(2, -1) @ flat, slope.T @ white, rtol=1e-9, atol=1e-9)


# -- attitudes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.5, 20.0])
def test_attitudes_settle_where_reading_and_stage_pull_alike(noise: float) -> None:
    data, _ = planar(noise=noise, fixture=0.05, undeclared=(4,))
    begun = Fit.begin(data)
    away = begun.values.attitude + 0.07
    fit = replace(begun, values=Values(BASE, away)).settled(8)
    for k in range(len(data)):
        pull = 0.0 if k == 4 else 1 / 0.05

        def cost(x: Floats, k: int = k, pull: float = pull) -> Floats:
            psi = BASE[0] + data.turn_rad[k] + x[0]
            ideal = G * np.array([BASE[1] * np.cos(psi), BASE[2] * np.sin(psi + BASE[3])])
            return np.append(data.root[k] @ (data.mean[k] - ideal), pull * x[0])

        found = least_squares(cost, [away[k]], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert fit.values.attitude[k] == pytest.approx(found.x[0], abs=1e-7)


def test_four_degrees_are_settled_to_a_billionth_without_being_asked_for_more_steps() -> None:
    psi = 0.3 * np.arange(9)
    even = np.tile(np.eye(2), (9, 1, 1))
    readings = from_means(
        G * np.stack([np.cos(psi), np.sin(psi)], axis=1), even, Conditions(time_s=np.arange(9.0))
    )
    begun = Fit.begin(readings)
    perfect = Values(np.array([0.0, 1.0, 1.0, 0.0]), psi + 0.07)
    # tan e = e + e³/3: a step from 0.07 leaves 1e-4, the next the cube of that.
    np.testing.assert_allclose(replace(begun, values=perfect).settled().values.attitude, psi, atol=1e-9)


def test_a_stage_that_is_exact_leaves_attitudes_where_they_are() -> None:
    data, _ = planar(fixture=0.0, undeclared=(2,))
    fit = Fit.begin(data)
    moved = replace(fit, values=Values(BASE, fit.values.attitude + 0.01)).settled()
    declared = np.isfinite(data.angle_rad)
    np.testing.assert_array_equal(moved.values.attitude[declared], 0.01)
    assert abs(moved.values.attitude[2] - fit.values.attitude[2] - 0.01) > 1e-3
    whole, _ = planar(fixture=0.0)
    begun = Fit.begin(whole)
    assert begun.settled() is begun


def test_poses_settle_where_the_weighted_misfit_is_least() -> None:
    data, base = spatial(noise=15.0)
    begun = Fit.begin(data)
    fit = replace(begun, values=replace(begun.values, base=base)).settled(4)
    matrix = G * sensitivity(base)
    for k in range(len(data)):

        def cost(x: Floats, k: int = k) -> Floats:
            return data.root[k] @ (data.mean[k] - matrix @ x / np.linalg.norm(x))

        found = least_squares(cost, data.mean[k] / G, xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        np.testing.assert_allclose(fit.values.attitude[k], found / np.linalg.norm(found), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(fit.values.attitude, axis=1), 1.0)


# -- parameters, terms and their priors -------------------------------------------------------------------

LINE = Basis("t", ("time",), lambda c: (c.time_s / 80.0)[:, None])
BIAS = NamedTerm("bias", (), 0.0, effect("bias", ("x", "y")))
DRIFT = NamelessTerm("drift", ("time",), 0.0, "bias", (0,), LINE)
TURN = NamelessTerm("turn", ("time",), 0.0, "angle", (), LINE)


def with_terms(data: Readings, **more: bool) -> Fit:
    """Bias, drift of x and a drift of the angle, at some values."""
    values = [np.array([4.0, -3.0]), np.array([50.0]), np.array([30.0])]
    return at(data, BASE, **more).with_terms((BIAS, DRIFT, TURN), values)


def test_each_terms_values_stand_where_its_slice_says() -> None:
    fit = with_terms(planar()[0])
    assert [fit.slice_of(k) for k in range(3)] == [slice(4, 6), slice(6, 7), slice(7, 8)]
    np.testing.assert_array_equal(fit.values.parameters[fit.slice_of(0)], [4.0, -3.0])
    np.testing.assert_array_equal(fit.value_of(TURN), [30.0])


def test_columns_are_the_slopes_of_the_prediction() -> None:
    data, _ = planar()
    fit = with_terms(data)
    step = 1e-5
    for k in range(8):
        by = step * np.eye(8)[k]
        up, down = (
            replace(fit, values=Values(p[:4], fit.values.attitude, (p[4:6], p[6:7], p[7:8]))).predicted
            for p in (fit.values.parameters + by, fit.values.parameters - by)
        )
        np.testing.assert_allclose(fit.columns[:, :, k], (up - down) / (2 * step), rtol=1e-6, atol=1e-4)
    # A drift of 30 mrad over the session turns the part by as much.
    np.testing.assert_allclose(fit.turn_rad - data.turn_rad, 0.030 * data.conditions.time_s / 80.0)


def test_what_has_no_name_is_held_to_a_tenth_of_gravity_and_of_a_radian() -> None:
    fit = with_terms(planar()[0])
    base = ((BASE - [0.0, 1.0, 1.0, 0.0]) / [math.inf, 0.2, 0.2, 0.2]) ** 2
    assert fit.loss - fit.chi2 == pytest.approx(base.sum() + (50 / 100) ** 2 + (30 / 100) ** 2)
    assert with_terms(planar()[0], with_prior=False).loss == pytest.approx(fit.chi2)


def test_a_shrunken_amplitude_uses_part_of_a_degree_of_freedom() -> None:
    data, _ = planar()
    for shrinkage in (0.3, 3.0, 1e4):
        term = replace(DRIFT, prior_sd=shrinkage)
        fit = at(data, BASE).with_terms((term,), [np.array([1.0])])
        hat = fit.jacobian.T @ fit.jacobian
        prior = np.diag([0, *[1 / 0.2**2] * 3, 1 / shrinkage**2])
        used = np.trace(np.linalg.solve(hat + prior, hat))
        assert fit.used == pytest.approx(used, rel=1e-6)
        np.testing.assert_allclose(fit.covariance, np.linalg.inv(hat + prior), rtol=1e-6, atol=1e-15)
    plain = at(data, BASE).with_terms((DRIFT,), [np.array([1.0])])
    assert plain.used == 5
    assert plain.dof == 2 * len(data) - 5


def test_a_step_of_the_base_is_that_of_regularised_least_squares() -> None:
    fit = with_terms(planar()[0])
    left = np.random.default_rng(6).standard_normal((len(fit.jacobian), 2))
    rows = fit.jacobian[:, :4]
    precision = np.diag([0.0, 1 / 0.04, 1 / 0.04, 1 / 0.04])
    pull = precision @ (np.array([0.0, 1.0, 1.0, 0.0]) - BASE)
    expected = np.linalg.solve(rows.T @ rows + precision, rows.T @ left + pull[:, None])
    np.testing.assert_allclose(fit.base_step(left), expected, rtol=1e-6, atol=1e-12)


def test_at_the_best_fit_the_linear_problem_has_its_amplitudes_and_no_step_of_the_base() -> None:
    data, _ = planar(noise=0.3, fixture=1e-3)
    fit = Fit.begin(data, with_prior=False).with_terms((BIAS, DRIFT), [np.zeros(2), np.zeros(1)])
    fit = fit.refit(30, 1e-14)
    base, blocks, target = fit.linear()
    solved = np.linalg.lstsq(np.concatenate([base, *blocks], axis=1), target, rcond=None)[0]
    u = np.sqrt(np.diagonal(fit.covariance))
    assert np.abs(solved[:4] / u[:4]).max() < 0.01
    assert np.abs((solved[4:] - fit.values.parameters[4:]) / u[4:]).max() < 0.01
    assert [block.shape[1] for block in blocks] == [2, 1]


@pytest.mark.parametrize("far", [0.1, 0.4])
def test_a_fit_that_begins_far_away_ends_where_the_best_one_is(far: float) -> None:
    data, _ = planar(n=12, noise=1.0, fixture=1e-3)
    start = at(data, BASE + far * np.array([1.0, 0.4, -0.4, 0.3]), with_prior=False)
    fit = start.refit()
    best = least_squares(lambda p: at(data, p, with_prior=False).settled(8).residual.ravel(), BASE)
    u = np.sqrt(np.diagonal(fit.covariance))
    assert np.abs((fit.values.base - best.x) / u).max() < 0.03
    assert fit.chi2 == pytest.approx(2 * best.cost, abs=2e-3)


def test_a_fit_within_a_plane_moves_nowhere_else() -> None:
    data, _ = planar(noise=0.3)
    begun = Fit.begin(data, with_prior=False)
    fit = begun.refit(within=np.eye(4)[:, [0, 1]])
    np.testing.assert_array_equal(fit.values.base[2:], begun.values.base[2:])
    assert fit.chi2 < begun.settled().chi2


# -- dwells that took no part -----------------------------------------------------------------------------


def test_a_part_that_is_turned_on_shows_an_angle_that_is_smaller_by_it() -> None:
    data, delta = planar(n=12, noise=0.01)
    fit = at(data, BASE)
    np.testing.assert_allclose(fit.angle_error_rad(data), -delta, atol=1e-4)
    assert fit.angle_error_rad(planar(undeclared=(1,))[0]) is None
    space, base = spatial()
    assert at(space, base).angle_error_rad(space) is None


def test_a_fit_keeps_its_values_on_other_dwells_and_finds_their_attitudes() -> None:
    fit = at(planar(noise=0.01)[0], BASE)
    others, delta = planar(n=7, noise=0.01, seed=8, fixture=1.0, undeclared=(3,))
    there = fit.on(others)
    np.testing.assert_array_equal(there.values.base, fit.values.base)
    theta = 2 * math.pi * np.arange(7) / 7
    np.testing.assert_allclose(there.turn_rad + there.values.attitude, delta - theta, atol=1e-4)
    again = fit.again(others)
    assert again.chi2 <= there.chi2


def test_dwells_are_foreseen_as_far_as_the_others_tell_what_they_read() -> None:
    rng = np.random.default_rng(7)
    rest, left = rng.standard_normal((12, 3)) * [1.0, 1e3, 1e-3], rng.standard_normal((30, 2, 3))
    left = left * [1.0, 1e3, 1e-3]
    carried = np.linalg.inv(rest.T @ rest)
    variance = 1 + np.einsum("nrp,pq,nrq->nr", left, carried, left).max(axis=1)
    most = float(np.median(variance))
    np.testing.assert_array_equal(predictable_dwells(rest, left, most), variance <= most)
    blind = rest * [1.0, 1.0, 0.0]
    assert not predictable_dwells(blind, left, math.inf).any()
    assert predictable_dwells(blind, left * [1.0, 1.0, 0.0], math.inf).all()
    assert not predictable_dwells(np.zeros((0, 3)), left, math.inf).any()
    faint = rest * [1.0, 1.0, 1e-155]
    assert not predictable_dwells(faint, left, 4.0).any(), "and no overflow"


def test_fewer_rows_than_columns_foresee_what_lies_in_their_plane_alone() -> None:
    rest = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -1.0]])
    weights = np.random.default_rng(9).standard_normal((20, 2, 2))
    inside = weights @ rest
    # A reading that is the sum of others, times weights, has the sum of their variances, times squares.
    variance = 1 + (weights**2).sum(axis=2).max(axis=1)
    most = float(np.median(variance))
    np.testing.assert_array_equal(predictable_dwells(rest, inside, most), variance <= most)
    assert not predictable_dwells(rest, np.add(inside, [0.0, 0.0, 1.0]), math.inf).any()


def test_columns_that_are_nearly_alike_are_still_told_apart() -> None:
    rng = np.random.default_rng(8)
    rest, left = rng.standard_normal((12, 2)), rng.standard_normal((30, 2, 2))
    rest[:, 1] = rest[:, 0] + 1e-4 * rest[:, 1]
    left[:, :, 1] = left[:, :, 0] + 1e-4 * left[:, :, 1]
    carried = np.linalg.inv(rest.T @ rest)
    variance = 1 + np.einsum("nrp,pq,nrq->nr", left, carried, left).max(axis=1)
    most = float(np.median(variance))
    np.testing.assert_array_equal(predictable_dwells(rest, left, most), variance <= most)


def test_dwells_of_a_turn_are_foreseen_as_far_as_the_fitted_ones_reach() -> None:
    data, _ = planar(n=24, noise=1.0, fixture=0.0)
    near = np.arange(24) < 4
    fit = at(data.rows(near), BASE, with_prior=False)
    there = fit.on(data)
    inverse = np.linalg.inv(fit.jacobian.T @ fit.jacobian)
    rows = there.white_by_dwell(there.columns)
    variance = 1 + np.einsum("nrp,pq,nrq->nr", rows, inverse, rows).max(axis=1)
    most = float(np.median(variance))
    np.testing.assert_array_equal(fit.can_predict(data, most), variance <= most)


# -- adequacy ---------------------------------------------------------------------------------------------


def test_adequacy_with_two_degrees_of_freedom_is_the_closed_form() -> None:
    for chi2 in (0.1, 3.0, 20.0):
        assert adequacy(chi2, 2, math.inf) == pytest.approx(math.exp(-chi2 / 2))
        for of in (1.0, 5.0, 40.0):
            assert adequacy(chi2, 2, of) == pytest.approx((1 + chi2 / of) ** (-of / 2))
    assert adequacy(3.0, 2, 0.2) == adequacy(3.0, 2, 1.0)
    assert adequacy(100.0, 0, 5.0) == 1.0
