"""The model at one point: what it predicts, how it is whitened, and its full nonlinear refit.

In the plane position i stands at ψ_i = α − θ_i + δ_i (+ effects of the stage) with δ_i ~ N(0, σ_f²), and
the ideal readings are K_x G cos ψ, K_y G sin(ψ + Δφ) (THEORY.md section 2). In space they are M u_i G
with M lower triangular (three gains, three skews; a rotation is not observable) and u_i any unit vector.
δ_i and u_i are nuisance parameters. They are eliminated dwell by dwell: with C = L Lᵀ the covariance of a
reading and T its tangents, rows are whitened by (I − β û ûᵀ) L⁻¹, û ∥ L⁻¹ t, β = 1 − (1 + σ_f² |L⁻¹
t|²)^(−1/2), which is the inverse root of C + σ_f² t tᵀ and, for σ_f → ∞, the projection that leaves
nothing along t.

Noise that dwells share (1/f noise, F = Φ Φᵀ over all readings) leaves the rows so whitened with the
covariance 1 + A Aᵀ, A = W Φ. Its symmetric inverse root 1 − A g(Aᵀ A) Aᵀ, g(λ) = 1/(r (r + 1)) with r =
√(1 + λ), is applied to them, which of all roots changes rows least: a row still belongs to its dwell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adis_gonio.model.records import Floats
from adis_gonio.tracing.observations import Observations
from adis_gonio.tracing.terms import Term

_SPACE = np.array([[0, 0], [1, 0], [1, 1], [2, 0], [2, 1], [2, 2]])
"""Entries of M in the order of the base parameters in space."""
_BASE_BOUNDS = (
    np.where(_SPACE[:, 0] == _SPACE[:, 1], 0.5, -0.2),
    np.where(_SPACE[:, 0] == _SPACE[:, 1], 2.0, 0.2),
)
"""Gains and skews (in radians) that a part can have: where few poses show them, a base model without a bias
would pay for it with axes that nearly coincide."""

GAIN_SPREAD = 0.2
"""Prior standard deviation of gains, skews and misalignment (rad)."""


NAMELESS_SPREAD = 100.0
"""Prior standard deviation of an amplitude without a name (mg, mrad): where time and the position before
run together, their difference and a gain of twenty would cancel."""


@dataclass(frozen=True)
class State:
    """Base parameters, nuisance attitudes and values of the terms.

    Attributes
    ----------
    base : (4,) or (6,) float
        α, K_x, K_y, Δφ in the plane (angles in rad); entries of M by rows in space.
    delta_rad : (n,) float
        Deviations of the declared angles; unused in space.
    unit : (n, 3) float
        Attitudes in space; unused in the plane.
    values : tuple of (p,) float
        Values of each term of the model.
    """

    base: Floats
    delta_rad: Floats
    unit: Floats
    values: tuple[Floats, ...] = ()


@dataclass(frozen=True)
class Prediction:
    """What a state predicts for n readings, before and after whitening.

    Attributes
    ----------
    ideal_mg, predicted_mg : (n, axes) float
    tangent : (n, axes, m) float
        ∂ideal/∂nuisance in mg per rad; m is 1 in the plane, 2 in space.
    whiten : (n, rows, axes) float
        Dwell by dwell.
    left_mg : (n, axes) float
        Reading minus prediction, with the nuisance parameters' own part added back, so that it belongs to
        declared angles.
    slow_mg : (n, axes, k) float or None
        Modes of the noise that dwells share.
    """

    ideal_mg: Floats
    predicted_mg: Floats
    tangent: Floats
    whiten: Floats
    left_mg: Floats
    slow_mg: Floats | None

    @cached_property
    def residual(self) -> Floats:
        """Whitened residual (n, rows)."""
        return self.white(self.left_mg[:, :, None]).reshape(len(self.left_mg), -1)

    @cached_property
    def _shared(self) -> tuple[Floats, Floats] | None:
        """A (n·rows, k) and the middle V g(λ) Vᵀ (k, k), with Aᵀ A = V λ Vᵀ."""
        if self.slow_mg is None or not self.slow_mg.shape[2]:
            return None
        rows = (self.whiten @ self.slow_mg).reshape(-1, self.slow_mg.shape[2])
        values, vectors = np.linalg.eigh(rows.T @ rows)
        root = np.sqrt(1 + np.maximum(values, 0.0))
        return rows, (vectors / (root * (root + 1))) @ vectors.T

    def white(self, columns: Floats) -> Floats:
        """Columns (n·rows, d), whitened, of what stands in readings (n, axes, d) in mg."""
        turned = self.whiten @ columns
        flat: Floats = turned.reshape(-1, turned.shape[2])
        if self._shared is None:
            return flat
        rows, middle = self._shared
        return flat - rows @ (middle @ (rows.T @ flat))


@dataclass(frozen=True)
class Refit:
    """A model refitted in full.

    Attributes
    ----------
    state : State
    covariance : (p, p) float
        Of base parameters and then the values of the terms.
    chi2, dof : float
        Of the readings; a term with a prior uses as many degrees of freedom as the prior leaves it.
    prediction : Prediction
    """

    state: State
    covariance: Floats
    chi2: float
    dof: float
    prediction: Prediction


def begin(data: Observations) -> State:
    """First state: linear least squares in the plane, unit vectors along the readings in space."""
    n = len(data)
    if not data.planar:
        length = np.linalg.norm(data.mean_mg, axis=1, keepdims=True)
        base = np.array([1.0, 0, 1.0, 0, 0, 1.0]) * float(length.mean()) / data.gravity_mg
        return State(base, np.zeros(n), data.mean_mg / length)
    theta = data.conditions.angle_rad
    x, y = data.mean_mg.T / data.gravity_mg
    if theta is None:
        return State(np.array([0.0, 1.0, 1.0, 0.0]), np.arctan2(y, x), np.zeros((n, 0)))
    design = np.column_stack([np.cos(theta), np.sin(theta)])
    (xc, xs), (yc, ys) = (np.linalg.lstsq(design, rows, rcond=None)[0] for rows in (x, y))
    alpha, phase = np.arctan2(xs, xc), np.arctan2(yc, -ys)
    skew = (phase - alpha + np.pi) % (2 * np.pi) - np.pi
    return State(np.array([alpha, np.hypot(xc, xs), np.hypot(yc, ys), skew]), np.zeros(n), np.zeros((n, 0)))


def predict(data: Observations, model: Sequence[Term], state: State) -> Prediction:
    """Prediction of a state with its whitening."""
    ideal, tangent = _ideal(data, model, state)
    predicted = ideal.copy()
    for term, values in zip(model, state.values, strict=True):
        if not term.enters_angle:
            predicted = predicted + term.added(values, ideal, data.conditions)
    whiten = _whitening(data, tangent)
    left = data.mean_mg - predicted
    if data.planar:
        left = left + tangent[:, :, 0] * state.delta_rad[:, None]
    return Prediction(ideal, predicted, tangent, whiten, left, data.slow_mg)


def angles(data: Observations, model: Sequence[Term], state: State) -> Floats:
    """True angles ψ (n,) in the plane."""
    theta = data.conditions.angle_rad
    psi = state.base[0] - (0.0 if theta is None else theta) + state.delta_rad
    for term, values in zip(model, state.values, strict=True):
        if term.enters_angle:
            psi = psi + term.added(values, data.mean_mg, data.conditions)
    return np.asarray(psi)


def _ideal(data: Observations, model: Sequence[Term], state: State) -> tuple[Floats, Floats]:
    g = data.gravity_mg
    if data.planar:
        _, kx, ky, skew = state.base
        psi = angles(data, model, state)
        ideal = g * np.stack([kx * np.cos(psi), ky * np.sin(psi + skew)], axis=1)
        slope = g * np.stack([-kx * np.sin(psi), ky * np.cos(psi + skew)], axis=1)
        return ideal, slope[:, :, None]
    matrix = _matrix(state.base)
    return g * state.unit @ matrix.T, g * np.einsum("jk,nkm->njm", matrix, _across(state.unit))


def _matrix(base: Floats) -> Floats:
    matrix = np.zeros((3, 3))
    matrix[_SPACE[:, 0], _SPACE[:, 1]] = base
    return matrix


def _across(unit: Floats) -> Floats:
    """Two directions across each unit vector, (n, 3, 2)."""
    axis = np.eye(3)[np.abs(unit).argmin(axis=1)]
    first = np.cross(unit, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(unit, first)], axis=2)


def _whitening(data: Observations, tangent: Floats) -> Floats:
    root = data.own_root
    along = root @ tangent
    if not data.planar:
        # One direction is left: across both whitened tangents.
        normal = np.cross(along[:, :, 0], along[:, :, 1])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        return normal[:, None, :] @ root
    along = along[:, :, 0]
    size = np.linalg.norm(along, axis=1, keepdims=True)
    unit = along / np.maximum(size, 1e-300)
    if np.isinf(data.fixture_rad):
        across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
        return across[:, None, :] @ root
    beta = 1 - 1 / np.sqrt(1 + (data.fixture_rad * size) ** 2)
    whitening: Floats = root - (beta * unit)[:, :, None] * (unit[:, None, :] @ root)
    return whitening


def base_columns(data: Observations, state: State, at: Prediction) -> Floats:
    """∂ideal/∂base (n, axes, 4 or 6) in mg."""
    n = len(data)
    if data.planar:
        columns = np.zeros((n, 2, 4))
        columns[:, :, 0] = at.tangent[:, :, 0]
        columns[:, 0, 1] = at.ideal_mg[:, 0] / state.base[1]
        columns[:, 1, 2] = at.ideal_mg[:, 1] / state.base[2]
        columns[:, 1, 3] = at.tangent[:, 1, 0]
        columns[:, :, ~data.base_seen] = 0.0
        return columns
    columns = np.zeros((n, 3, 6))
    for k, (row, column) in enumerate(_SPACE):
        columns[:, row, k] = data.gravity_mg * state.unit[:, column]
    columns[:, :, ~data.base_seen] = 0.0
    return columns


def as_reading(term: Term, columns: Floats, at: Prediction) -> Floats:
    """Columns of a term in readings (n, axes, d) in mg, whatever it enters by."""
    if not term.enters_angle:
        return columns
    if at.tangent.shape[2] > 1:
        return np.zeros((*at.ideal_mg.shape, columns.shape[1]))
    return at.tangent * columns[:, None, :]


def refit(
    data: Observations,
    model: Sequence[Term],
    state: State,
    iterations: int = 15,
    free: bool = True,
) -> Refit:
    """Full nonlinear least squares of base parameters and terms, by Gauss–Newton.

    Nuisance attitudes are eliminated by the whitening and updated dwell by dwell; the dependence of an
    effect on the ideal reading is left out of the slope, not out of the model, so that steps converge
    linearly with a factor as small as the effect is against 1 g.

    Parameters
    ----------
    free : bool
        False keeps all parameters and only places the nuisance attitudes (for dwells that took no part).
    """
    state = settle(data, model, state)
    at = predict(data, model, state)
    prior = _prior(data, model, state)
    loss = _loss(at, prior, state)
    for _ in range(iterations if free else 0):
        scaled, left = _with_prior(_jacobian(data, model, state, at), at.residual.ravel(), prior, state)
        size = np.linalg.norm(scaled, axis=0)
        size[size == 0] = 1.0
        step = np.linalg.lstsq(scaled / size, left, rcond=1e-9)[0] / size
        moved = False
        for damping in (1.0, 0.5, 0.2, 0.05, 0.01):
            trial = settle(data, model, _stepped(model, state, damping * step))
            there = predict(data, model, trial)
            new = _loss(there, prior, trial)
            if new <= loss * (1 + 1e-12):
                moved = True
                break
        if not moved:
            break
        gain, state, at, loss = loss - new, trial, there, new
        if gain < 1e-6 * max(1.0, 1e-3 * loss):
            break
    jacobian = _jacobian(data, model, state, at)
    scaled, _ = _with_prior(jacobian, at.residual.ravel(), prior, state)
    size = np.linalg.norm(scaled, axis=0)
    size[size == 0] = 1.0
    _, s, vt = np.linalg.svd(scaled / size, full_matrices=False)
    keep = s > 1e-9 * (s[0] if s.size else 1.0)
    half = (vt[keep].T / s[keep]) / size[:, None]
    covariance = half @ half.T
    # What a prior holds back is no degree of freedom of the fit.
    used = float(((jacobian @ half) ** 2).sum())
    if all(term.prior_sd is None for term in model):
        used = float(round(used))  # the base's prior is wide: a parameter is either seen or not
    chi2 = float((at.residual**2).sum())
    return Refit(state, covariance, chi2, at.residual.size - used, at)


@dataclass(frozen=True)
class _Prior:
    """Normal prior of the parameters: 1/σ (p,), zero where there is none, and its centre (p,)."""

    precision: Floats
    centre: Floats

    def away(self, state: State) -> Floats:
        """Parameters' distance (p,) from the centre in σ."""
        away: Floats = self.precision * (np.concatenate([state.base, *state.values]) - self.centre)
        return away


def _prior(data: Observations, model: Sequence[Term], state: State) -> _Prior:
    """Priors of the base, but for the start angle, and of the terms that have one.

    Few positions leave directions of the base undetermined, beside functions of the angle above all, in
    which a fit would run to gains of twenty.
    """
    base = begin(data).base
    if data.planar and not data.zero_unknown:
        base = np.array([0.0, 1.0, 1.0, 0.0])
    parts = [np.full(len(base), 1 / GAIN_SPREAD)]
    if data.planar:
        parts[0][0] = 0.0
    for term, values in zip(model, state.values, strict=True):
        loose = NAMELESS_SPREAD if term.name is None else np.inf
        parts.append(np.full(len(values), 1.0 / (loose if term.prior_sd is None else term.prior_sd)))
    precision = np.concatenate(parts)
    centre = np.zeros(len(precision))
    centre[: len(base)] = base
    return _Prior(precision, centre)


def _loss(at: Prediction, prior: _Prior, state: State) -> float:
    """χ² of the readings and of the priors."""
    return float((at.residual**2).sum() + (prior.away(state) ** 2).sum())


def _with_prior(jacobian: Floats, residual: Floats, prior: _Prior, state: State) -> tuple[Floats, Floats]:
    """Jacobian and residual with a row more for each prior."""
    held = np.flatnonzero(prior.precision)
    if not held.size:
        return jacobian, residual
    rows = np.zeros((held.size, len(prior.precision)))
    rows[np.arange(held.size), held] = prior.precision[held]
    return np.concatenate([jacobian, rows]), np.concatenate([residual, -prior.away(state)[held]])


def _jacobian(data: Observations, model: Sequence[Term], state: State, at: Prediction) -> Floats:
    blocks = [base_columns(data, state, at)]
    for term, values in zip(model, state.values, strict=True):
        blocks.append(as_reading(term, term.derivative(values, at.ideal_mg, data.conditions), at))
    return at.white(np.concatenate(blocks, axis=2))


def _stepped(model: Sequence[Term], state: State, step: Floats) -> State:
    cut = len(state.base)
    values = []
    for term, old in zip(model, state.values, strict=True):
        new = old + step[cut : cut + len(old)]
        cut += len(old)
        if term.name is not None:
            low, high = term.bounds().T
            # A shape may at most double or halve in one step: the slope is only local.
            shape = getattr(term, "shapes", ())
            for index, _ in shape:
                new[index] = np.clip(new[index], 0.5 * old[index], 2 * old[index])
            new = np.clip(new, low, high)
        values.append(new)
    base = state.base + step[: len(state.base)]
    if len(base) == len(_SPACE):
        base = np.clip(base, *_BASE_BOUNDS)
    return replace(state, base=base, values=tuple(values))


def settle(data: Observations, model: Sequence[Term], state: State, passes: int = 2) -> State:
    """State whose nuisance attitudes fit its other parameters best."""
    if data.planar and data.fixture_rad == 0:
        return state
    root = data.root
    for _ in range(passes):
        at = predict(data, model, state)
        along = root @ at.tangent
        left = data.mean_mg - at.predicted_mg
        if data.planar:
            left = left + at.tangent[:, :, 0] * state.delta_rad[:, None]
            prior = 0.0 if np.isinf(data.fixture_rad) else 1 / data.fixture_rad**2
            whitened = np.einsum("nrk,nk->nr", root, left)
            delta = (along[:, :, 0] * whitened).sum(axis=1) / (prior + (along[:, :, 0] ** 2).sum(axis=1))
            state = replace(state, delta_rad=delta)
        else:
            whitened = np.einsum("nrk,nk->nr", root, left)
            gram = along.transpose(0, 2, 1) @ along
            # Where an axis has lost its gain a pose may have but one tangent.
            gram += 1e-12 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
            turn = np.linalg.solve(gram, along.transpose(0, 2, 1) @ whitened[:, :, None])
            moved = state.unit + (_across(state.unit) @ turn)[:, :, 0]
            state = replace(state, unit=moved / np.linalg.norm(moved, axis=1, keepdims=True))
    return state
