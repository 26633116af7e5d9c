"""Maximum likelihood in the plane: α, Δφ, gains and biases with latent true angles.

A dwell's true angle is ψ = α − θ + δ, δ ~ N(0, σ_f²). χ² is the whitened distance of the reading from the
model plus (δ/σ_f)², at the best δ of each dwell. σ_f = 0 fixes the angles (least squares with declared
angles), σ_f = ∞ or a missing θ frees them (fit of an ellipse): both are limits without a special case,
since the block of a dwell is the three rows (reading x, reading y, prior) and one column for δ, which is
projected out.

Parameters are in natural units: radians, gains, biases in units of local gravity.
"""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.errors import FitError
from adis_gonio.fitting.least_squares import BLOCK, Reduced, blocks, sum_of, whitener_of
from adis_gonio.model.geometry import planar_angle, planar_ideal, planar_tangent, wrap_rad
from adis_gonio.model.records import Floats

ALPHA, DELTA_PHI, SCALE_X, SCALE_Y, BIAS_X, BIAS_Y = range(6)
NAMES = ("alpha", "delta_phi", "scale_x", "scale_y", "bias_x", "bias_y")
NOMINAL = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0])

_INNER_STEPS = 50


class PlanarProblem:
    """χ² of readings in the plane.

    Parameters
    ----------
    readings : (n, 2) float
        Readings in units of local gravity.
    covariance : (n, 2, 2) float
        Their covariance in the same unit.
    angle_rad : (n,) float
        Declared angle θ, NaN where unknown.
    sigma_rad : float
        Standard uncertainty σ_f of a declared angle; 0 and inf are allowed.
    """

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return NAMES

    def __init__(self, readings: Floats, covariance: Floats, angle_rad: Floats, sigma_rad: float) -> None:
        self.readings = readings
        declared = np.isfinite(angle_rad) & (not math.isinf(sigma_rad))
        self.angle = np.where(declared, angle_rad, 0.0)
        self.fixed = declared & (sigma_rad == 0)
        weight = 0.0 if sigma_rad == 0 or math.isinf(sigma_rad) else 1 / sigma_rad
        self.prior = np.where(declared, weight, 0.0)
        self.unbound = ~declared
        n = len(readings)
        self._parts = [
            PlanarProblem(readings[rows], covariance[rows], angle_rad[rows], sigma_rad)
            for rows in (blocks(n) if n > BLOCK else [])
        ]
        self.whitener: Floats = (
            np.concatenate([part.whitener for part in self._parts])
            if self._parts
            else whitener_of(covariance)
        )

    @property
    def determines_alpha(self) -> bool:
        """False where no dwell has a declared angle that counts."""
        return not bool(self.unbound.all())

    def rows(self) -> int:
        """Rows that carry information: two a reading, less one for each angle without a prior."""
        return 2 * len(self.readings) - int(self.unbound.sum())

    def model(self, beta: Floats, psi: Floats) -> Floats:
        """Readings (n, 2) at the true angles ψ (n,)."""
        gain, bias = beta[[SCALE_X, SCALE_Y]], beta[[BIAS_X, BIAS_Y]]
        return planar_ideal(psi, float(beta[DELTA_PHI])) * gain + bias

    def angle_shown(self, beta: Floats) -> Floats:
        """Angle ψ (n,) that the calibrated goniometer computes from each reading alone."""
        ideal = (self.readings - beta[[BIAS_X, BIAS_Y]]) / beta[[SCALE_X, SCALE_Y]]
        return planar_angle(ideal, float(beta[DELTA_PHI]))

    def best_delta(self, beta: Floats) -> Floats:
        """δ (n,) that minimises χ² of each dwell; zero where the angle is fixed.

        Gauss-Newton from the angle that the reading shows: its error is of the order of the noise, and
        each step reduces it by that ratio once more.
        """
        if self._parts:
            return np.concatenate([part.best_delta(beta) for part in self._parts])
        gain = beta[[SCALE_X, SCALE_Y]]
        if not (gain > 0).all() or abs(beta[DELTA_PHI]) > 1.5:
            raise FitError("gains must stay positive and the axes apart")
        nominal = beta[ALPHA] - self.angle
        shown = wrap_rad(self.angle_shown(beta) - nominal)
        delta = shown
        prior2 = self.prior**2
        for step in range(_INNER_STEPS):
            tangent, residual = self._whitened(beta, nominal + delta)
            information = (tangent**2).sum(axis=1)
            if step == 0:
                delta = delta * information / (information + prior2)
                delta[self.fixed] = 0.0
                if self.fixed.all():
                    break
                continue
            change = ((tangent * residual).sum(axis=1) - prior2 * delta) / (information + prior2)
            change[self.fixed] = 0.0
            delta = delta + np.clip(change, -0.5, 0.5)
            if float(np.abs(change).max()) < 1e-13:
                break
        return np.asarray(delta)

    def tangent_information(self, beta: Floats) -> Floats:
        """Information (n,) in 1/rad² that each reading carries on its declared angle; zero without one."""
        psi = beta[ALPHA] - self.angle + self.best_delta(beta)
        tangent, _ = self._whitened(beta, psi)
        return np.asarray(np.where(self.unbound, 0.0, (tangent**2).sum(axis=1)))

    def _whitened(self, beta: Floats, psi: Floats) -> tuple[Floats, Floats]:
        gain = beta[[SCALE_X, SCALE_Y]]
        tangent = planar_tangent(psi, float(beta[DELTA_PHI])) * gain
        residual = self.readings - self.model(beta, psi)
        both = self.whitener @ np.stack([tangent, residual], axis=-1)
        return both[..., 0], both[..., 1]

    def evaluate(self, beta: Floats) -> Reduced:
        """χ² and its derivatives with δ projected out (see `least_squares.Problem`)."""
        if self._parts:
            return sum_of([part.evaluate(beta) for part in self._parts])
        rows, right = self._rows(beta)
        flat, residuals = rows.reshape(-1, 6), right.reshape(-1)
        return Reduced(float(residuals @ residuals), flat.T @ residuals, flat.T @ flat)

    def influence(self, beta: Floats) -> Floats:
        """Derivative (n, 2, 6) of the gradient by each reading."""
        if self._parts:
            return np.concatenate([part.influence(beta) for part in self._parts])
        rows, _ = self._rows(beta)
        return np.asarray(self.whitener.transpose(0, 2, 1) @ rows[:, :2])

    def _rows(self, beta: Floats) -> tuple[Floats, Floats]:
        """Rows (n, 3, 6) of each dwell without the nuisance direction, and the residuals (n, 3)."""
        delta = self.best_delta(beta)
        psi = beta[ALPHA] - self.angle + delta
        tangent, residual = self._whitened(beta, psi)
        n = len(psi)
        columns = np.zeros((n, 2, 6))
        phi = float(beta[DELTA_PHI])
        gain = beta[[SCALE_X, SCALE_Y]]
        ideal = planar_ideal(psi, phi)
        columns[:, 1, DELTA_PHI] = gain[1] * np.cos(psi + phi)
        columns[:, 0, SCALE_X] = ideal[:, 0]
        columns[:, 1, SCALE_Y] = ideal[:, 1]
        columns[:, 0, BIAS_X] = columns[:, 1, BIAS_Y] = 1.0
        rows = np.zeros((n, 3, 6))
        rows[:, :2] = self.whitener @ columns
        rows[:, :2, ALPHA] = tangent
        right = np.concatenate([residual, (-self.prior * delta)[:, None]], axis=1)
        nuisance = np.concatenate([tangent, self.prior[:, None]], axis=1)
        nuisance[self.fixed] = (0.0, 0.0, 1.0)
        nuisance /= np.linalg.norm(nuisance, axis=1, keepdims=True)
        rows -= nuisance[:, :, None] * np.einsum("nk,nkp->np", nuisance, rows)[:, None, :]
        # The residual is orthogonal to the nuisance already, up to what the inner steps left.
        return rows, right


def start_of(readings: Floats, angle_rad: Floats, sigma_rad: float) -> Floats:
    """Starting parameters: α by the circular mean of shown and declared angles, all else nominal."""
    beta = NOMINAL.copy()
    declared = np.isfinite(angle_rad)
    if math.isinf(sigma_rad) or not declared.any():
        return beta
    turn = np.exp(1j * (planar_angle(readings[declared], 0.0) + angle_rad[declared])).sum()
    beta[ALPHA] = float(np.angle(turn))
    return beta
