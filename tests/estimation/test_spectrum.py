"""Fits of a spectral density near zero, against densities that are known and a general optimiser."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from adis_gonio.estimation import spectrum as module
from adis_gonio.estimation.spectrum import noise_of_means
from adis_gonio.model.records import Floats

X = (np.arange(32) + 0.5) / 32


def deviance(density: Floats, weight: Floats, mean: Floats) -> float:
    """−2 log likelihood of exponentially distributed ordinates."""
    return 2 * float(weight @ (np.log(density) + mean / density))


@pytest.mark.parametrize("order", [0, 1, 2])
@pytest.mark.parametrize("strength", [0.003, 0.1, 3.0])
def test_a_polynomial_beside_flicker_is_of_the_greatest_likelihood(order: int, strength: float) -> None:
    rng = np.random.default_rng(order)
    weight = rng.uniform(20, 200, len(X))
    mean = (np.exp(-0.8 * X**2) + strength / X) * rng.gamma(weight) / weight
    design = np.polynomial.legendre.legvander(2 * X**2 - 1, order)
    beta, covariance, found = module._whittle_with_flicker(design, 1 / X, weight, mean)

    def cost(p: Floats) -> float:
        return deviance(np.exp(design @ p[:-1]) + np.exp(p[-1]) / X, weight, mean)

    begin = np.append(beta, np.log(strength)) + 0.1
    best = minimize(cost, begin, method="BFGS", options={"gtol": 1e-6})
    assert found == pytest.approx(best.fun, abs=1e-4)
    # Distances count in standard uncertainties, of which the inverse curvature tells.
    u = np.sqrt(np.diagonal(best.hess_inv)[:-1] * 2)
    assert (np.abs(beta - best.x[:-1]) < 0.02 * u).all()
    expected = np.exp(design @ best.x[:-1]) + np.exp(best.x[-1]) / X
    slope = np.column_stack([design * np.exp(design @ best.x[:-1])[:, None], np.exp(best.x[-1]) / X])
    slope = slope / expected[:, None]
    information = slope.T @ (weight[:, None] * slope)
    np.testing.assert_allclose(covariance, np.linalg.inv(information)[:-1, :-1], rtol=0.02)


def test_a_polynomial_alone_is_of_the_greatest_likelihood() -> None:
    rng = np.random.default_rng(9)
    weight = rng.uniform(20, 200, len(X))
    mean = 7.0 * np.exp(-1.5 * X**2) * rng.gamma(weight) / weight
    design = np.polynomial.legendre.legvander(2 * X**2 - 1, 1)
    beta, covariance, found = module._whittle(design, weight, mean)
    best = minimize(lambda p: deviance(np.exp(design @ p), weight, mean), np.zeros(2), method="BFGS")
    assert found == pytest.approx(best.fun, abs=1e-6)
    np.testing.assert_allclose(beta, best.x, atol=1e-4)
    np.testing.assert_allclose(covariance, np.linalg.inv(design.T @ (weight[:, None] * design)))


@pytest.mark.parametrize(("fall", "strength"), [(1.0, 0.1), (2.0, 0.3), (4.0, 0.3)])
def test_a_filter_beside_flicker_keeps_its_shape(fall: float, strength: float) -> None:
    mean = np.exp(-fall * X**2) + strength / X
    found = module._beside_flicker(X, np.full(len(X), 400.0), mean, 1 / X)
    assert found is not None
    beta, _ = found
    # The white part at zero is one, whatever rises there beside it.
    assert np.polynomial.legendre.legval(-1.0, beta) == pytest.approx(0.0, abs=1e-6)


def test_cells_hold_what_their_ordinates_say_together() -> None:
    rng = np.random.default_rng(3)
    samples = [rng.standard_normal((n, 2)) for n in (300, 300, 500)]
    band = 0.25
    x, weight, mean, inverse_x = module._cells(module._periodograms(samples, 1.0), band)
    cells: dict[int, list[tuple[float, float]]] = {}
    for rows in samples:
        n = len(rows)
        lines = np.abs(np.fft.rfft(rows - rows.mean(axis=0), axis=0)[1:]) ** 2 / n
        frequency = np.arange(1, n // 2 + 1) / n
        inside = frequency <= band
        relative = lines[inside] / lines[inside].mean(axis=0)
        for f, both in zip(frequency[inside], relative, strict=True):
            cell = min(int(f / band * 32), 31)
            cells.setdefault(cell, []).extend((f / band, value) for value in both)
    by_hand = [np.array(cells[k]) for k in sorted(cells)]
    np.testing.assert_allclose(weight, [len(own) for own in by_hand])
    np.testing.assert_allclose(x, [own[:, 0].mean() for own in by_hand])
    np.testing.assert_allclose(mean, [own[:, 1].mean() for own in by_hand])
    np.testing.assert_allclose(inverse_x, [(1 / own[:, 0]).mean() for own in by_hand])


@pytest.mark.parametrize(("dwells", "samples"), [(2, 2), (3, 2), (4, 3), (6, 40)])
def test_white_noise_has_the_textbooks_variance_and_degrees_of_freedom(dwells: int, samples: int) -> None:
    rng = np.random.default_rng(dwells)
    rows = [rng.standard_normal((samples, 2)) * [1.0, 3.0] for _ in range(dwells)]
    noise = noise_of_means(rows, 2.0)
    pooled = 4 * np.mean([r.var(axis=0, ddof=1) for r in rows], axis=0)
    assert noise.pooled
    np.testing.assert_allclose(np.diagonal(noise.covariance, axis1=1, axis2=2), [pooled / samples] * dwells)
    np.testing.assert_allclose(noise.dof, dwells * (samples - 1))
    assert not noise.too_short
