"""Fits of a spectral density near zero, against densities that are known and a general optimiser."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import bartlett, f as fisher

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation import spectrum as module
from adis_gonio.fitting.estimation.spectrum import noise_of_means

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
    beta, covariance, found = module._whittle(design, weight, mean, 1 / X)

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
    found = module._fit_foot(1.0, (X, np.full(len(X), 400.0), mean, 1 / X), with_flicker=True)
    assert found is not None
    # The white part at zero is one, whatever rises there beside it.
    assert np.polynomial.legendre.legval(-1.0, found.coefficients) == pytest.approx(0.0, abs=1e-6)


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


def power(spectrum: Floats, dwells: int = 1, n: int | None = None) -> list[module._Ordinates]:
    """One group of dwells of one axis whose ordinates 1, 2, … are all these."""
    count = len(spectrum)
    k = np.arange(1.0, count + 1)
    length = n or 2 * count
    cross = np.broadcast_to(spectrum[None, :, None, None], (dwells, count, 1, 1)).copy()
    one = np.ones(count)
    return [module._Ordinates(np.arange(dwells), length, k / length, one, k / length, length / k, cross)]


def samples_with(ordinates: dict[int, float], n: int) -> Floats:
    """Samples (n,) whose periodogram |X_k|²/n has these ordinates and no others."""
    lines = np.zeros(n // 2 + 1)
    for k, value in ordinates.items():
        lines[k] = np.sqrt(value * n)
    return np.fft.irfft(lines, n)


@pytest.mark.parametrize("n", [256, 4096, 5000])
def test_ordinates_are_joined_just_where_no_band_and_no_cell_divides_them(n: int) -> None:
    frequency = np.arange(1, n // 2 + 1) / n
    starts = set(module._bins(frequency).tolist())
    assert set(range(64)) <= starts
    told = []
    for octave in range(12):
        band = 0.5 / 2**octave
        inside = frequency <= band
        told.append(np.where(inside, np.minimum((frequency / band * 32).astype(int), 31), -1))
        told.append(np.where(frequency == band, 1, 0))  # the end of a band counts to its last cell
    places = np.array(told)
    divided = (np.diff(places, axis=1) != 0).any(axis=0)
    expected = {0, *range(64), *(np.flatnonzero(divided) + 1).tolist()}
    assert starts >= expected
    # Cells of the widest band that holds an ordinate are the finest that are asked for: hardly more bins.
    assert len(starts - expected) <= 12


def test_the_corner_is_where_the_density_has_fallen_to_a_third() -> None:
    # Legendre's first polynomial of 2x² − 1 with −2: the logarithm falls by 4x², to −1 at x = 1/2.
    foot = module._Foot(0.25, 2.0 + 3.0, 0.1, 50.0, np.array([3.0, -2.0]))
    assert foot.log_shape(np.array([0.0, 0.5, 1.0])) == pytest.approx([0.0, -1.0, -4.0])
    assert 0.125 < foot.corner < 0.125 + 0.25 / 60
    slow = module._Foot(0.25, 0.0 + 0.4, 0.1, 50.0, np.array([0.0, -0.4]))
    assert slow.corner == 0.25, "by 0.8 at the edge of the band: nowhere"


def test_white_is_a_constant_over_the_whole_band_and_nothing_else() -> None:
    one, two = np.zeros(1), np.zeros(2)
    assert module._Foot(0.5, 0.0, 0.1, 9.0, one).is_white
    assert not module._Foot(0.25, 0.0, 0.1, 9.0, one).is_white
    assert not module._Foot(0.5, 0.0, 0.1, 9.0, two).is_white
    assert not module._Foot(0.5, 0.0, 0.1, 9.0, one, with_flicker=True).is_white


def test_levels_are_of_one_noise_as_bartletts_test_says() -> None:
    rng = np.random.default_rng(5)
    sizes = (3, 4, 6)
    rows = [rng.standard_normal((n, 2)) for n in sizes]
    answers = set()
    for factor in np.geomspace(8, 12, 30):
        scaled = [rows[0] * [1, factor], *rows[1:]]
        level = np.stack([np.cov(own.T) for own in scaled])
        worst = min(bartlett(*(own[:, axis] for own in scaled)).pvalue for axis in range(2))
        found = module._homogeneous(level, (np.array(sizes) - 1) / 2)
        assert found == (worst >= 1e-3 / 2)
        answers.add(found)
    assert answers == {True, False}
    apart = np.stack([np.eye(2), 1e6 * np.eye(2)])
    assert module._homogeneous(apart, np.array([10.0, 0.0])), "a level without weight says nothing"
    assert not module._homogeneous(apart, np.array([10.0, 10.0]))


@pytest.mark.parametrize(
    ("correlation", "kept"),
    [(0.25, 0.0), (-0.25, 0.0), (0.35, 0.35), (-0.35, -0.35), (0.99, 0.95), (-0.99, -0.95)],
)
def test_correlation_counts_beyond_three_standard_errors_and_is_never_whole(
    correlation: float, kept: float
) -> None:
    deviation = np.array([2.0, 5.0])
    level = np.array([[1.0, correlation], [correlation, 1.0]]) * np.outer(deviation, deviation)
    found = module._without_chance_correlation(level[None], np.array([100.0]))[0]
    np.testing.assert_allclose(found, [[4.0, 10 * kept], [10 * kept, 25.0]])


def test_three_axes_that_move_together_keep_a_correlation_that_chance_could_explain() -> None:
    xy, xz, yz = -0.882, -0.936, 0.962  # gyros of a part in the hand; three standard errors are 0.905
    level = np.array([[1.0, xy, xz], [xy, 1.0, yz], [xz, yz, 1.0]])
    found = module._without_chance_correlation(level[None], np.array([11.0]))[0]
    np.testing.assert_allclose(found, 0.95 * level + 0.05 * np.eye(3))
    assert np.linalg.eigvalsh(found)[0] >= 0.05, "without the correlation of x and y it is indefinite"


def test_the_whole_of_the_lowest_ordinates_read_as_flicker_is_its_allan_variance() -> None:
    rows = [samples_with({1: 8.0, 2: 5.0, 3: 2.0, 4: 77.0}, n)[:, None] for n in (64, 100)]
    found = module._all_flicker(module._periodograms(rows, 1.0))
    # S = h/f at f = k/n is h = S k/n; Allan variance 4 ln 2 h of a two-sided density.
    strengths = [s * k / n for n in (64, 100) for k, s in ((1, 8.0), (2, 5.0), (3, 2.0))]
    assert found == pytest.approx([4 * np.log(2) * np.mean(strengths)])


@pytest.mark.parametrize("side", [0.98, 1.02])
def test_excess_of_the_lowest_ordinates_is_flicker_beyond_the_99_percent_of_f(side: float) -> None:
    dwells, n, dof, level = 4, 50, 60.0, 3.0
    ordinates = 3 * dwells
    ratio = side * fisher.ppf(0.99, 2 * ordinates, dof)
    # The excess falls as 1/k; its mean over three ordinates is that of the ratio.
    excess = ordinates * (ratio - 1)
    weight = dwells * (1 + 1 / 2 + 1 / 3)
    values = {k: level * (1 + excess / weight / k) for k in (1, 2, 3)}
    rows = [samples_with({**values, 9: 1.0}, n)[:, None] for _ in range(dwells)]
    groups = module._periodograms(rows, 1.0)
    foot = module._Foot(0.5, 0.0, 0.01, 100.0, np.zeros(1))
    density = np.full((dwells, 1, 1), level)
    found, limit = module._flicker(groups, density, foot, dof, np.full(dwells, float(n)))
    # A strength h in units of the density at k = 1: h = relative · level/n.
    strength = excess / weight * level / n * 4 * np.log(2)
    spread = np.sqrt(ordinates * (1 + 2 * ordinates / dof)) / weight * level / n * 4 * np.log(2)
    assert found == pytest.approx([strength if side > 1 else 0.0])
    assert limit == pytest.approx([strength + 1.645 * spread])


@pytest.mark.parametrize(
    ("exponent", "flicker"),
    [
        (-1.0, True),
        (-0.65, True),
        (-0.55, False),
        (-1.45, True),
        (-1.6, False),
        (-2.0, False),
        (0.0, False),
    ],
)
def test_a_power_near_one_is_flicker_and_others_are_not(exponent: float, flicker: bool) -> None:
    k = np.arange(1.0, 65)
    assert module._flicker_at_foot(power(k**exponent, dwells=400))[1] == flicker
    assert not any(module._flicker_at_foot(power(k[:32] ** -1.0, dwells=400))), "too few ordinates to tell"


def test_white_noise_with_flicker_is_told_from_the_foot_of_a_filter() -> None:
    k = np.arange(1.0, 65)
    assert module._flicker_at_foot(power(1 + 5 / k, dwells=400))[0]
    assert not module._flicker_at_foot(power(np.exp(-((k / 20) ** 2)), dwells=400))[0]
    assert not module._flicker_at_foot(power(np.ones(64), dwells=400))[0]
    assert not module._flicker_at_foot(power(1 + 5 / k[:32], dwells=400))[0]


def test_lowest_ordinates_are_means_over_dwells_each_relative_to_its_own() -> None:
    rng = np.random.default_rng(4)
    rows = [scale * rng.standard_normal((n, 2)) for scale, n in ((1, 70), (9, 70), (3, 80), (5, 60))]
    total, mean = module._lowest(module._periodograms(rows, 1.0))
    by_hand = []
    for own in rows[:3]:  # the last has thirty ordinates only
        lines = np.abs(np.fft.rfft(own, axis=0)[1:33]) ** 2
        by_hand.append(lines / lines.mean(axis=0))
    np.testing.assert_allclose(mean, np.mean(by_hand, axis=(0, 2)))
    np.testing.assert_allclose(total, [6.0] * 32)
