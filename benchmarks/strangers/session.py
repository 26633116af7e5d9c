"""One session with one disturbance, and the oracle that knows its true shape."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from .bench import GRAVITY_MG, Array, Bench, draw_bench, session_csv
from .kinds import KINDS, Kind

LEAST_SEEN = 0.15
"""Least part of a disturbance, by its weighted norm, that bias, gains and Δφ do not absorb."""
WEAKEST, STRONGEST = 2.0, 12.0
"""Size of that part: its rms per dwell in standard deviations of a dwell."""


@dataclass(frozen=True)
class StrangeSession:
    """A session in the samples CSV with its truth.

    Attributes
    ----------
    kind, bench
        The disturbance and the conditions.
    axis
        Name of the axis: `x`, `y`, or empty where both are disturbed.
    basis_mg
        True change of the readings, mg, shape (n, 2).
    strength
        Rms of the visible part per dwell in standard deviations of a dwell.
    csv
        Text of the file.
    """

    kind: Kind
    bench: Bench
    axis: str
    basis_mg: Array
    strength: float
    csv: str


@dataclass(frozen=True)
class Oracle:
    """Fits with and without the true shape.

    Attributes
    ----------
    check_mg, fit_mg, check_deg
        Rms errors of the fit with the true shape: of check dwells, of the other dwells, of the angle of
        check dwells.
        Errors in mg are measured at the attitude that fits a dwell best within the fixture's tolerance.
    bias_check_mg, bias_fit_mg, bias_check_deg
        Rms errors of bias, gains and Δφ alone.
    log_likelihood_gain
        By the true shape, on the dwells that are not check dwells.
    """

    check_mg: float
    fit_mg: float
    check_deg: float
    bias_check_mg: float
    bias_fit_mg: float
    bias_check_deg: float
    log_likelihood_gain: float


def draw_session(kind: Kind, rng: np.random.Generator) -> StrangeSession:
    """Draw a session in which the disturbance is visible.

    Raises
    ------
    RuntimeError
        If no bench of 200 shows it.
    """
    for _ in range(200):
        bench = draw_bench(rng)
        axis = int(rng.integers(2))
        shape = kind.shape(bench, rng, axis)
        ratio = rng.choice([-1, 1]) * rng.uniform(0.4, 1.5)
        basis = placed_basis(kind, bench, shape, axis, ratio)
        seen = _seen(bench, basis)
        if seen is None:
            continue
        strength = float(np.exp(rng.uniform(np.log(WEAKEST), np.log(STRONGEST))))
        size = strength / seen * rng.choice([-1, 1])
        turned = np.zeros(len(shape))
        added = size * basis
        if kind.enters == "attitude":
            turned, added = size * shape / GRAVITY_MG, np.zeros_like(basis)
        csv = session_csv(bench, rng, added, turned)
        name = "xy"[axis] if kind.enters in ("zero", "gain") else ""
        return StrangeSession(kind, bench, name, size * basis, strength, csv)
    raise RuntimeError(f"{kind.name}: no bench shows this disturbance")


def placed_basis(kind: Kind, bench: Bench, shape: Array, axis: int, ratio: float) -> Array:
    """Change of the readings by a shape of size one, shape (n, 2)."""
    placed = np.zeros((len(shape), 2))
    match kind.enters:
        case "zero":
            placed[:, axis] = shape
        case "zeros":
            placed = np.column_stack([shape, ratio * shape])
        case "gain":
            placed[:, axis] = shape * bench.forces()[:, axis]
        case "misalignment":
            placed[:, 1] = shape * bench.slopes()[:, 1] / GRAVITY_MG
        case _:
            placed = shape[:, None] * bench.slopes() / GRAVITY_MG
    return placed


def _seen(bench: Bench, basis: Array) -> float | None:
    """Rms per dwell, in standard deviations, of the part that the base cannot absorb; None if too small."""
    fit = ~bench.check
    whitened = whiten(bench, basis)[fit].ravel()
    rest = whitened - _projected(base_columns(bench)[fit.repeat(2)], whitened)
    whole = float(np.linalg.norm(whitened - whitened.mean()))
    left = float(np.linalg.norm(rest))
    return left / np.sqrt(fit.sum()) if left > LEAST_SEEN * whole > 0 else None


def _projected(design: Array, target: Array) -> Array:
    return np.asarray(design @ np.linalg.lstsq(design, target, rcond=None)[0])


def whiten(bench: Bench, values: Array) -> Array:
    """Divide readings (n, 2) by the root of their covariance: noise, and the fixture along the slope."""
    slopes = bench.slopes()
    length = np.linalg.norm(slopes, axis=1, keepdims=True)
    along = slopes / length
    sigma = bench.dwell_mg
    shrink = 1 - sigma / np.hypot(sigma, bench.fixture_rad * length)  # of the component along the slope
    part = (values * along).sum(axis=1, keepdims=True)
    return (values - shrink * part * along) / sigma


def base_columns(bench: Bench) -> Array:
    """Whitened columns of gains, angles and biases, shape (2 n, 6)."""
    cos, sin, one, none = (
        np.cos(bench.theta),
        np.sin(bench.theta),
        np.ones(len(bench.theta)),
        np.zeros(len(bench.theta)),
    )
    columns = []
    for shape in (cos, sin, one):
        columns += [np.column_stack([shape, none]), np.column_stack([none, shape])]
    return np.column_stack([whiten(bench, column).ravel() for column in columns])


def dwell_means(session: StrangeSession) -> Array:
    """Means of the dwells as they stand in the file, mg, shape (n, 2)."""
    rows = [line.split(",")[4:6] for line in session.csv.splitlines() if line[0].isdigit()]
    return np.array(rows, float).reshape(len(session.bench.time_s), -1, 2).mean(axis=1)


def consult_oracle(session: StrangeSession) -> Oracle:
    """Fit bias, gains, Δφ and the amplitude of the true shape by weighted least squares."""
    bench, fit = session.bench, ~session.bench.check
    means = dwell_means(session)
    whitened = whiten(bench, means).ravel()
    base = base_columns(bench)
    whole = np.column_stack([base, whiten(bench, session.basis_mg).ravel()])
    rows = fit.repeat(2)
    errors = []
    for design in (whole, base):
        solved = np.linalg.lstsq(design[rows], whitened[rows], rcond=None)[0]
        residual = (whitened - design @ solved).reshape(-1, 2)
        remaining, angles = unwhiten(bench, residual)
        errors.append(
            (
                rms(remaining[bench.check]),
                rms(remaining[fit]),
                rms(angles[bench.check]),
                _half_chi2(residual[fit]),
            )
        )
    true, bias = errors
    return Oracle(true[0], true[1], true[2], bias[0], bias[1], bias[2], bias[3] - true[3])


def rms(values: Array) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(values**2)))


def _half_chi2(whitened: Array) -> float:
    return 0.5 * float((whitened**2).sum())


def unwhiten(bench: Bench, whitened: Array) -> tuple[Array, Array]:
    """Residual in mg at the best attitude of each dwell (n, 2), and error of the angle in degrees (n,).

    A whitened component along the slope is r/√(σ² + s²); the best attitude leaves r σ²/(σ² + s²) of it.
    """
    slopes = bench.slopes()
    length = np.linalg.norm(slopes, axis=1, keepdims=True)
    along = slopes / length
    sigma = bench.dwell_mg
    spread = np.hypot(sigma, bench.fixture_rad * length)
    part = (whitened * along).sum(axis=1, keepdims=True)
    return sigma * (whitened - (1 - sigma / spread) * part * along), np.degrees(
        part * spread / length
    ).ravel()


def noise_alone(bench: Bench, check: bool, rms_mg: float) -> float:
    """Probability that noise alone leaves at least this rms in the check dwells or in the others.

    The components of the residual have the variance σ² across the slope and σ⁴/(σ² + s²) along it.
    Their sum of squares is compared with the chi-square distribution of equal mean and variance.
    """
    length = np.linalg.norm(bench.slopes()[bench.check == check], axis=1)
    sigma = bench.dwell_mg
    kept = sigma**2 / (sigma**2 + (bench.fixture_rad * length) ** 2)
    mean, variance = float((1 + kept).sum()), float(2 * (1 + kept**2).sum())
    total = 2 * len(length) * (rms_mg / sigma) ** 2
    return float(stats.chi2.sf(total * 2 * mean / variance, 2 * mean**2 / variance))


def kind_of(index: int, seed: int) -> Kind:
    """Kind of a session: a new permutation of all kinds after each round."""
    names = sorted(KINDS)
    turn, place = divmod(index, len(names))
    order = np.random.default_rng([seed, 1, turn]).permutation(len(names))
    return KINDS[names[order[place]]]


def session_of(index: int, seed: int) -> StrangeSession:
    """Session of a run by its number: the same number and seed give the same file."""
    return draw_session(kind_of(index, seed), np.random.default_rng([seed, 2, index]))
