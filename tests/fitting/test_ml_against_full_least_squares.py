"""The eliminated fit against scipy's least_squares with every nuisance angle as a parameter."""

import math

import numpy as np
import pytest
from scipy.optimize import least_squares

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import from_means
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import Conditions, effect

G_MG = 1000.0
PLANAR = [0, 3, 1, 2, 4, 5]
"""Places of alpha, delta_phi, scale_x, scale_y, bias_x, bias_y among the parameters of a fit."""
SPATIAL = [6, 7, 8, 0, 1, 2, 3, 4, 5]
"""The same of three biases, three gains and three skews."""


def ml(z, cov, theta=None, sigma=math.inf):
    """Fit of base model and bias to readings (n, axes) in g: parameters, covariance and χ², in g."""
    n, axes = z.shape
    angle = np.full(n, np.nan) if theta is None else theta
    data = from_means(
        G_MG * z,
        G_MG**2 * np.asarray(cov),
        Conditions(time_s=np.arange(float(n))),
        gravity_mg=G_MG,
        fixture_rad=sigma,
        angle_rad=angle,
        fitted=None if axes == 2 else np.ones(6, dtype=bool),
    )
    bias = NamedTerm("bias", (), 0.0, effect("bias", "xyz"[:axes]))
    fit = Fit.begin(data, with_prior=False).with_terms((bias,), (np.zeros(axes),)).refit(100, 1e-13)
    order = PLANAR if axes == 2 else SPATIAL
    size = np.array([1.0] * len(data.model.parameters) + [G_MG] * axes)
    scaled = fit.covariance / np.outer(size, size)
    return (fit.values.parameters / size)[order], scaled[np.ix_(order, order)], fit


def correlated(rng, n, axes, u):
    """Covariances (n, axes, axes) that differ from dwell to dwell and correlate the axes."""
    a = rng.normal(size=(n, axes, axes))
    c = a @ a.transpose(0, 2, 1) + axes * np.eye(axes)
    return u**2 * c / axes


def planar_session(rng, n, sigma, u=3e-3):
    theta = np.linspace(0, 2 * math.pi, n, endpoint=False)
    psi = 0.3 - theta + rng.normal(0, 1, n) * (sigma if math.isfinite(sigma) else 0.05)
    cov = correlated(rng, n, 2, u)
    noise = (np.linalg.cholesky(cov) @ rng.normal(size=(n, 2, 1)))[..., 0]
    truth = np.stack([1.02 * np.cos(psi) + 0.03, 0.99 * np.sin(psi + 0.02) - 0.02], axis=1)
    return truth + noise, cov, theta


def full_planar(z, cov, theta, sigma):
    """Estimates and covariance of the six parameters by dense least squares over 6 + n parameters."""
    n = len(z)
    white = np.linalg.inv(np.linalg.cholesky(cov))
    declared = np.isfinite(theta) & math.isfinite(sigma)
    zero = np.where(declared, theta, 0.0)

    def split(p):
        alpha, phi, kx, ky, bx, by = p[:6]
        psi = alpha - zero + p[6:]
        return psi, phi, kx, ky, bx, by

    def residual(p):
        psi, phi, kx, ky, bx, by = split(p)
        model = np.stack([kx * np.cos(psi) + bx, ky * np.sin(psi + phi) + by], axis=1)
        rows = (white @ (z - model)[..., None])[..., 0].ravel()
        return rows if math.isinf(sigma) else np.concatenate([rows, p[6:][declared] / sigma])

    start = np.zeros(6 + n)
    start[2:4] = 1
    shown = np.arctan2(z[:, 1], z[:, 0])
    start[0] = 0.0 if math.isinf(sigma) else np.angle(np.exp(1j * (shown + zero))[declared].sum())
    start[6:] = np.where(declared, 0.0, (shown - start[0] + np.pi) % (2 * np.pi) - np.pi)
    if math.isinf(sigma):
        fixed = least_squares(
            lambda q: residual(np.concatenate([[0.0], q])), start[1:], xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        cov_all = np.linalg.inv(fixed.jac.T @ fixed.jac)
        return np.concatenate([[0.0], fixed.x[:5]]), cov_all[:5, :5], 2 * fixed.cost
    found = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    cov_all = np.linalg.inv(found.jac.T @ found.jac)
    return found.x[:6], cov_all[:6, :6], 2 * found.cost


@pytest.mark.parametrize("sigma", [1e-4, 2e-3, 0.05, 0.3, math.inf])
@pytest.mark.parametrize("n", [9, 40])
def test_planar_estimate_and_covariance_agree_with_all_angles_as_parameters(sigma, n):
    rng = np.random.default_rng(n + int(1e4 * min(sigma, 9)))
    z, cov, theta = planar_session(rng, n, sigma)
    found, mine, fit = ml(z, cov, theta, sigma)
    free = np.arange(6) > 0 if math.isinf(sigma) else np.ones(6, dtype=bool)
    beta, dense, chi2 = full_planar(z, cov, theta, sigma)
    u = np.sqrt(np.diag(dense))
    assert fit.chi2 == pytest.approx(chi2, rel=1e-8)
    np.testing.assert_allclose((found - beta)[free] / u, 0, atol=1e-4)
    np.testing.assert_allclose(mine[np.ix_(free, free)] / np.outer(u, u), dense / np.outer(u, u), atol=2e-6)


def test_planar_dwells_without_a_declared_angle_agree_too():
    rng = np.random.default_rng(5)
    z, cov, theta = planar_session(rng, 20, 0.01)
    theta[[2, 7, 8, 15]] = np.nan
    found, mine, fit = ml(z, cov, theta, 0.01)
    beta, dense, chi2 = full_planar(z, cov, theta, 0.01)
    u = np.sqrt(np.diag(dense))
    assert fit.dof == 2 * 20 - 4 - 6
    assert fit.chi2 == pytest.approx(chi2, rel=1e-8)
    np.testing.assert_allclose((found - beta) / u, 0, atol=1e-4)
    np.testing.assert_allclose(mine / np.outer(u, u), dense / np.outer(u, u), atol=2e-6)


def test_planar_limits_are_the_fixed_and_the_free_fit():
    rng = np.random.default_rng(6)
    z, cov, theta = planar_session(rng, 24, 1e-3)
    (exact, _, at_zero), (nearly, _, near_zero) = ml(z, cov, theta, 0.0), ml(z, cov, theta, 1e-9)
    np.testing.assert_allclose(exact, nearly, atol=1e-9)
    assert at_zero.chi2 == pytest.approx(near_zero.chi2, rel=1e-8)
    wide, free = ml(z, cov, theta, 1e5)[0], ml(z, cov, theta, math.inf)[0]
    np.testing.assert_allclose(wide[1:], free[1:], atol=1e-7)


def test_planar_with_exact_angles_is_linear_least_squares_in_cosine_and_sine():
    rng = np.random.default_rng(7)
    z, _, theta = planar_session(rng, 12, 0.0)
    cov = np.broadcast_to(1e-6 * np.eye(2), (12, 2, 2))
    found, _, _ = ml(z, cov, theta, 0.0)
    design = np.stack([np.cos(theta), np.sin(theta), np.ones(12)], axis=1)
    (ax, bx, cx), (ay, by, cy) = np.linalg.lstsq(design, z, rcond=None)[0].T
    alpha = math.atan2(bx, ax)
    expected = [alpha, math.atan2(ay, -by) - alpha, math.hypot(ax, bx), math.hypot(ay, by), cx, cy]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def directions(xy, xz, yz):
    """Rows: unit vectors of the axes, 90° minus the skews apart, by Gram and Schmidt."""
    x = np.array([1.0, 0.0, 0.0])
    y = np.array([math.sin(xy), math.cos(xy), 0.0])
    z_x = math.sin(xz)
    z_y = (math.sin(yz) - z_x * y[0]) / y[1]
    return np.array([x, y, [z_x, z_y, math.sqrt(1 - z_x**2 - z_y**2)]])


def spatial_session(rng, n, u=2e-3):
    u_vectors = rng.normal(size=(n, 3))
    u_vectors /= np.linalg.norm(u_vectors, axis=1, keepdims=True)
    axes = directions(0.01, -0.02, 0.03)
    cov = correlated(rng, n, 3, u)
    noise = (np.linalg.cholesky(cov) @ rng.normal(size=(n, 3, 1)))[..., 0]
    gain = np.array([1.02, 0.98, 1.01])
    return u_vectors @ (gain[:, None] * axes).T + [0.05, -0.02, 0.04] + noise, cov


@pytest.mark.parametrize("n", [12, 40])
def test_spatial_estimate_and_covariance_agree_with_all_attitudes_as_parameters(n):
    rng = np.random.default_rng(n)
    z, cov = spatial_session(rng, n)
    white = np.linalg.inv(np.linalg.cholesky(cov))

    # Two angles about a base vector a dwell, so that no pole is near.
    base = z / np.linalg.norm(z, axis=1, keepdims=True)
    helper = np.eye(3)[np.abs(base).argmin(axis=1)]
    first = np.cross(base, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(base, first)

    def residual(p):
        axes = directions(*p[6:9])
        a, b = p[9 : 9 + n, None], p[9 + n :, None]
        vectors = base + a * first + b * second
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        model = vectors @ (p[3:6, None] * axes).T + p[:3]
        return (white @ (z - model)[..., None])[..., 0].ravel()

    start = np.concatenate([np.repeat([0.0, 1.0, 0.0], 3), np.zeros(2 * n)])
    found = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    dense = np.linalg.inv(found.jac.T @ found.jac)[:9, :9]
    beta, mine, fit = ml(z, cov)
    u = np.sqrt(np.diag(dense))
    assert fit.chi2 == pytest.approx(2 * found.cost, rel=1e-7)
    np.testing.assert_allclose((beta - found.x[:9]) / u, 0, atol=1e-3)
    np.testing.assert_allclose(mine / np.outer(u, u), dense / np.outer(u, u), atol=1e-5)


def test_the_fit_finds_its_minimum_from_far_away():
    rng = np.random.default_rng(8)
    theta = np.radians(np.arange(0, 360, 30.0))
    psi = 2.9 - theta
    z = np.stack([1.2 * np.cos(psi) + 0.3, 0.85 * np.sin(psi + 0.15) - 0.25], axis=1)
    z += rng.normal(0, 1e-4, z.shape)
    cov = np.broadcast_to(1e-8 * np.eye(2), (12, 2, 2))
    for sigma in (0.0, 1e-3, math.inf):
        beta, _, _ = ml(z, cov, theta, sigma)
        np.testing.assert_allclose(beta[1:], [0.15, 1.2, 0.85, 0.3, -0.25], atol=1e-3)
