"""Base model, whitening and likelihood of a session whose noise is known.

Plane: rows are all x, then all y readings; base parameters α, two gains, Δφ. Space: attitudes are free,
so a pose gives one row, the length of the reading; base parameters three gains, three skews. A bias is
always fitted too. Everything else is linear in its amplitudes about that fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .catalogue import Term
from .circumstances import Circumstances, Floats, ideal_plane, tangent_plane


@dataclass
class Linear:
    """A session about its base fit.

    Attributes
    ----------
    c : Circumstances
    e : (rows,) float
        Measured minus base model, mg.
    base : (rows, p) float
        Derivatives by the base parameters and biases; mg, mg/rad.
    names : list of str
        Their names: `alpha`, `scale_x`, …, `delta_phi`, `bias_x`, …
    values : (p,) float
        Where it is linearised; gains of unit 1, angles in rad, biases in mg.
    covariance : (rows, rows) float
        Noise of the rows, with the fixture's part, mg².
    fit : (rows,) bool
        Rows that are no check dwells.
    ideal_g : (n, axes) float
        What the axes should read, g.
    to_rows : (rows, n·axes) float
        What a change of the readings (x of all dwells, then y, …) does to the rows.
    tangent : (n·axes, n) float
        Change of the readings by the true angle of each dwell, mg/rad; zeros in space.
    """

    c: Circumstances
    e: Floats
    base: Floats
    names: list[str]
    values: Floats
    covariance: Floats
    fit: np.ndarray
    ideal_g: Floats
    to_rows: Floats
    tangent: Floats

    def rows(self, reading: Floats, angle: Floats) -> Floats:
        """Rows (rows, k) of what is added to readings (n, axes, k) and to true angles (n, k)."""
        stacked = reading.transpose(1, 0, 2).reshape(-1, reading.shape[2]) + self.tangent @ angle
        return self.to_rows @ stacked

    def columns(self, term: Term) -> Floats:
        """Columns (rows, k) of a term."""
        return self.rows(term.reading, term.angle)


class Whitened:
    """Fit rows with unit covariance, and what is left of them beside the base model and the bias."""

    def __init__(self, linear: Linear) -> None:
        self.linear = linear
        fit = linear.fit
        self.factor = np.linalg.cholesky(linear.covariance[np.ix_(fit, fit)])
        self.base = np.linalg.solve(self.factor, linear.base[fit])
        self.q = np.linalg.svd(self.base, full_matrices=False)
        keep = self.q[1] > self.q[1][0] * 1e-9
        self.basis = self.q[0][:, keep]
        self.e = np.linalg.solve(self.factor, linear.e[fit])
        self.left = self.project(self.e[:, None])[:, 0]

    @property
    def dof(self) -> int:
        """Rows less base parameters that show."""
        return len(self.e) - self.basis.shape[1]

    def white(self, columns: Floats) -> Floats:
        """Whitened fit rows of columns (rows, k)."""
        return np.linalg.solve(self.factor, columns[self.linear.fit])

    def project(self, white: Floats) -> Floats:
        """What base model and bias cannot take of whitened columns."""
        return white - self.basis @ (self.basis.T @ white)

    def gain(self, columns: Floats) -> float:
        """2Δ ln L of adding columns (rows, k)."""
        z = self.project(self.white(columns))
        q = np.linalg.svd(z, full_matrices=False)
        u = q[0][:, q[1] > 1e-7 * max(q[1][0], 1e-12)]
        return float(np.sum((u.T @ self.left) ** 2))

    def solve(self, columns: Floats) -> tuple[Floats, Floats]:
        """Values and covariance of base parameters (changes) and amplitudes of columns together."""
        everything = np.hstack([self.base, self.white(columns)])
        size = np.linalg.norm(everything, axis=0)
        size[size == 0] = 1.0
        inverse = np.linalg.pinv(everything / size, rcond=1e-10)
        return inverse @ self.e / size, inverse @ inverse.T / np.outer(size, size)

    def scatter(self, covariance: Floats) -> tuple[Floats, Floats]:
        """Eigenvalues d of a further covariance (rows, rows) beside the base model, and squares w² to them.

        With its size A², 2Δ ln L = Σ w² A²d/(1 + A²d) − ln(1 + A²d).
        """
        fit = self.linear.fit
        white = np.linalg.solve(self.factor, np.linalg.solve(self.factor, covariance[np.ix_(fit, fit)]).T)
        p = np.eye(len(white)) - self.basis @ self.basis.T
        d, v = np.linalg.eigh(p @ white @ p)
        keep = d > 1e-9 * max(d[-1], 1e-12)
        return d[keep], (v[:, keep].T @ self.left) ** 2


def scatter_gain(d: Floats, w2: Floats, size: float) -> float:
    """2Δ ln L of a scatter of size A² (see `Whitened.scatter`)."""
    x = size * d
    return float(np.sum(w2 * x / (1 + x) - np.log1p(x)))


def linearise(
    c: Circumstances, reading_mg: Floats, covariance: list[Floats], fixture_rad: float, gravity_mg: float
) -> Linear:
    """Fit the base model and a bias, and linearise there.

    Parameters
    ----------
    c : Circumstances
    reading_mg : (n, axes) float
    covariance : list of (n, n) float
        Covariance of the readings of each axis, mg².
    fixture_rad : float
        Standard uncertainty of a declared angle.
    gravity_mg : float
    """
    return (_plane if c.plane else _space)(c, reading_mg, covariance, fixture_rad, gravity_mg)


def _least_squares(base: Floats, e: Floats, covariance: Floats, fit: np.ndarray) -> Floats:
    factor = np.linalg.cholesky(covariance[np.ix_(fit, fit)])
    return np.linalg.lstsq(
        np.linalg.solve(factor, base[fit]), np.linalg.solve(factor, e[fit]), rcond=1e-12
    )[0]


def _plane(c: Circumstances, r: Floats, covariance: list[Floats], fixture_rad: float, g: float) -> Linear:
    n, theta = c.n, c.angle_rad
    fit = np.concatenate([~c.check, ~c.check])
    noise = np.zeros((2 * n, 2 * n))
    noise[:n, :n], noise[n:, n:] = covariance
    measured = r.T.ravel()
    used = ~c.check
    # Start: r_x = p cos θ + q sin θ + b gives α and K_x, y likewise.
    harmonics = np.column_stack([np.cos(theta), np.sin(theta), np.ones(n)])
    px, qx, bx = np.linalg.lstsq(harmonics[used], r[used, 0], rcond=None)[0]
    py, qy, by = np.linalg.lstsq(harmonics[used], r[used, 1], rcond=None)[0]
    alpha = np.arctan2(qx, px)
    lean = np.arctan2(py, -qy) - alpha
    lean = (lean + np.pi) % (2 * np.pi) - np.pi
    values = np.array([alpha, np.hypot(px, qx) / g, np.hypot(py, qy) / g, lean, bx, by])
    for _ in range(6):
        linear = _plane_at(c, measured, noise, fixture_rad, g, values, fit)
        values = values + _least_squares(linear.base, linear.e, linear.covariance, fit)
    return _plane_at(c, measured, noise, fixture_rad, g, values, fit)


def _plane_at(
    c: Circumstances,
    measured: Floats,
    noise: Floats,
    fixture_rad: float,
    g: float,
    values: Floats,
    fit: np.ndarray,
) -> Linear:
    n = c.n
    alpha, kx, ky, lean, bx, by = values
    psi = alpha - c.angle_rad
    gains = np.array([kx, ky])
    ideal = ideal_plane(psi, lean)
    slope = tangent_plane(psi, lean) * gains * g
    tangent = np.vstack([np.diag(slope[:, 0]), np.diag(slope[:, 1])])
    zero, one = np.zeros(n), np.ones(n)
    base = np.column_stack(
        [
            slope.T.ravel(),
            np.concatenate([g * ideal[:, 0], zero]),
            np.concatenate([zero, g * ideal[:, 1]]),
            np.concatenate([zero, slope[:, 1]]),
            np.concatenate([one, zero]),
            np.concatenate([zero, one]),
        ]
    )
    predicted = (g * gains * ideal + [bx, by]).T.ravel()
    return Linear(
        c,
        measured - predicted,
        base,
        ["alpha", "scale_x", "scale_y", "delta_phi", "bias_x", "bias_y"],
        values,
        noise + fixture_rad**2 * tangent @ tangent.T,
        fit,
        ideal * g / 1000,
        np.eye(2 * n),
        tangent,
    )


_SKEWS = ((0, 1), (0, 2), (1, 2))
_SPACE_NAMES = [
    "scale_x", "scale_y", "scale_z", "skew_xy", "skew_xz", "skew_yz", "bias_x", "bias_y", "bias_z",
]  # fmt: skip


def _space(c: Circumstances, r: Floats, covariance: list[Floats], fixture_rad: float, g: float) -> Linear:
    values = np.array([1.0, 1, 1, 0, 0, 0, 0, 0, 0])
    fit = ~c.check
    for _ in range(10):
        linear = _space_at(c, r, covariance, g, values)
        values = values + _least_squares(linear.base, linear.e, linear.covariance, fit)
    return _space_at(c, r, covariance, g, values)


def space_matrix(values: Floats) -> Floats:
    """Reading = matrix · acceleration + bias; (3, 3), upper triangle."""
    matrix = np.diag(values[:3])
    for value, (i, p) in zip(values[3:6], _SKEWS, strict=True):
        matrix[i, p] = value
    return matrix


def _space_at(c: Circumstances, r: Floats, covariance: list[Floats], g: float, values: Floats) -> Linear:
    n = c.n
    inverse = np.linalg.inv(space_matrix(values))
    a = (r - values[6:]) @ inverse.T
    length = np.linalg.norm(a, axis=1)
    weight = (a / length[:, None]) @ inverse  # change of the length by a change of each reading
    a = a * (g / length)[:, None]
    to_rows = np.hstack([np.diag(weight[:, i]) for i in range(3)])
    columns = [weight[:, i] * a[:, i] for i in range(3)]
    columns += [weight[:, i] * a[:, p] for i, p in _SKEWS]
    columns += [weight[:, i] for i in range(3)]
    noise = sum(np.outer(weight[:, i], weight[:, i]) * covariance[i] for i in range(3))
    return Linear(
        c,
        length - g,
        np.column_stack(columns),
        list(_SPACE_NAMES),
        values,
        np.asarray(noise),
        ~c.check,
        a / 1000,
        to_rows,
        np.zeros((3 * n, n)),
    )


def base_parameters(names: list[str], values: Floats, covariance: Floats) -> dict[str, dict[str, float]]:
    """The parameters that entrants state: delta_k (unit 1), delta_phi (degree), bias_x, … (mg)."""
    out: dict[str, dict[str, float]] = {}

    def put(name: str, value: float, gradient: Floats) -> None:
        out[name] = {"value": float(value), "u": float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))}

    unit = np.eye(len(names))
    if "delta_phi" in names:
        x, y = names.index("scale_x"), names.index("scale_y")
        put(
            "delta_k", values[x] / values[y] - 1, unit[x] / values[y] - unit[y] * values[x] / values[y] ** 2
        )
        k = names.index("delta_phi")
        put("delta_phi", np.degrees(values[k]), np.degrees(unit[k]))
    for k, name in enumerate(names):
        if name.startswith("bias_"):
            put(name, values[k], unit[k])
    return out
