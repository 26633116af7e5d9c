"""Integral of attitude: the rotation of the part over a turn, and what errors of its gyros do to it.

A direction fixed in space goes backwards in the part: u̇ = −ω × u. Between two samples the rate is their
mean, and the rotation by it is exact (Rodrigues), so that u(t₁) = Φ(t₁, t₀) u(t₀) with a product of
rotations Φ. A small error δω of the rates turns the result by ε, u(t₁) → u(t₁) + ε × u(t₁) with

    ε = −∫ Φ(t₁, t) δω(t) dt,

which is linear in all that a gyro can have: with ω = A⁻¹ (m − z − a |m − z|) for readings m, zero rate z,
gains and directions A, asymmetry a, it is ε = ∫ Φ(t₁, t) A⁻¹ (δA ω + δz + δa |m − z|) dt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats

PARAMETERS = 21
"""Of three gyros: A (9, row by row), g-sensitivity (9, row by row) in °/s/g, asymmetry (3)."""


@dataclass(frozen=True)
class AssumedGyros:
    """What three gyros are taken for.

    Attributes
    ----------
    sensitivity : (3, 3) float
        A: gains times directions, a row a gyro.
    per_g : (3, 3) float
        What force adds, °/s/g.
    asymmetry : (3,) float
        What |rate| adds, relative.
    """

    sensitivity: Floats
    per_g: Floats
    asymmetry: Floats

    @classmethod
    def of(cls, values: Floats) -> AssumedGyros:
        """From `PARAMETERS` values in their order."""
        return cls(values[:9].reshape(3, 3), values[9:18].reshape(3, 3), values[18:])


@dataclass(frozen=True)
class Attitude:
    """What a turn did to a direction fixed in space.

    Attributes
    ----------
    rotation : (3, 3) float
        Φ: components in the part after the turn, from those before.
    by_parameter : (3, 21) float
        ∂ε/∂(A, g-sensitivity, asymmetry), rad, rad/(°/s/g), rad.
    by_zero : (3, 3) float
        ∂ε/∂(zero rate), rad/(°/s).
    noise_rad2 : (3, 3) float
        Covariance of ε for white noise of the rates.
    travelled_rad : float
        Length of the way, ∫ |ω| dt.
    """

    rotation: Floats
    by_parameter: Floats
    by_zero: Floats
    noise_rad2: Floats
    travelled_rad: float


def attitude(
    time_s: Floats,
    rate_dps: Floats,
    force_g: Floats,
    gyros: AssumedGyros,
    noise_dps2: Floats,
    magnitude_dps: Floats | None = None,
) -> Attitude:
    """Rotation over a turn.

    Parameters
    ----------
    time_s : (n,) float
    rate_dps : (n, 3) float
        Readings less the zero rate without force.
    force_g : (n, 3) float
        What the accelerometers read beyond the force at which that zero rate holds.
    gyros : AssumedGyros
    noise_dps2 : (3, 3) float
        Covariance of one sample, as the spectral density at frequency zero has it.
    magnitude_dps : (n, 3) float, optional
        |rate| without the samples' noise; by default of `rate_dps` as it is.
    """
    inverse = np.linalg.inv(gyros.sensitivity)
    free = rate_dps - force_g @ gyros.per_g.T
    size = np.abs(free) if magnitude_dps is None else magnitude_dps
    omega = np.radians(free - gyros.asymmetry * size) @ inverse.T
    steps = np.diff(time_s)
    to_end = _to_end((omega[1:] + omega[:-1]) / 2 * steps[:, None])
    weight = np.zeros(len(time_s))
    weight[:-1] += steps / 2
    weight[1:] += steps / 2
    by_rate = to_end @ inverse
    weighted = weight[:, None, None] * by_rate
    rad = math.pi / 180
    flat = weighted.reshape(-1, 9).T
    by_parameter = np.concatenate(
        [
            (flat @ omega).reshape(3, 9),
            rad * (flat @ force_g).reshape(3, 9),
            rad * (weighted * size[:, None, :]).sum(axis=0),
        ],
        axis=1,
    )
    by_row = weighted.transpose(1, 0, 2)
    noise = rad**2 * (by_row @ noise_dps2).reshape(3, -1) @ by_row.reshape(3, -1).T
    travelled = float(weight @ np.linalg.norm(np.radians(size) @ inverse.T, axis=1))
    return Attitude(to_end[0], by_parameter, rad * weighted.sum(axis=0), noise, travelled)


def _to_end(steps_rad: Floats) -> Floats:
    """Φ(t₁, t) (n + 1, 3, 3) of each sample, from the angles (n, 3) turned between samples.

    Products within blocks of about √n steps, all blocks side by side, then of the blocks.
    """
    n = len(steps_rad)
    size = max(1, math.isqrt(n))
    blocks = -(-n // size)
    turns = np.broadcast_to(np.eye(3), (blocks * size, 3, 3)).copy()
    turns[:n] = rotations(-steps_rad)
    turns = turns.reshape(blocks, size, 3, 3)
    # The last step acts last: Φ of a sample is the product of all later steps, the latest to the left.
    for k in range(size - 2, -1, -1):
        turns[:, k] = turns[:, k + 1] @ turns[:, k]
    after = np.eye(3)
    for block in range(blocks - 1, -1, -1):
        whole = after @ turns[block, 0]
        turns[block] = after @ turns[block]
        after = whole
    return np.concatenate([turns.reshape(-1, 3, 3)[:n], np.eye(3)[None]])


def rotations(vectors_rad: Floats) -> Floats:
    """Matrices (n, 3, 3) of rotation vectors (n, 3): Rodrigues' formula."""
    angle = np.linalg.norm(vectors_rad, axis=1)[:, None, None]
    cross = np.zeros((len(vectors_rad), 3, 3))
    x, y, z = vectors_rad.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = z, -y, x
    half = np.sinc(angle / (2 * np.pi))
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * half**2 * (cross @ cross))
