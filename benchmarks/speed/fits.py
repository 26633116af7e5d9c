"""`ml` against the same least squares by hand, lmfit, Tedaldi's method and Ferraris' by imucal."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from adis_gonio.fitting import fit_readings
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import axes_matrix
from speed.tedaldi import calibrate as tedaldi
from speed.timing import Row, compare, require

Floats = NDArray[np.float64]

G_MG = 1000.0
NOISE_MG = 0.3
SIGMA_RAD = math.radians(0.05)
TOLERANCE_U = 0.05
"""Two fits of one likelihood differ by less than so many standard uncertainties."""
NORM_TOLERANCE_U = 0.5
"""The squared norm weighs readings a little otherwise than the norm: a part of an uncertainty."""
EXACT = 1e-6


def _readings(mean: Floats, angle: Floats, sigma: float) -> Readings:
    n, axes = mean.shape
    covariance = np.broadcast_to(NOISE_MG**2 * np.eye(axes), (n, axes, axes))
    conditions = Conditions(time_s=np.arange(float(n)))
    return from_means(mean, covariance, conditions, gravity_mg=G_MG, fixture_rad=sigma, angle_rad=angle)


def planar(rng: np.random.Generator, n: int) -> Readings:
    """Readings of n positions in the plane, evenly spaced at a random start."""
    theta = 2 * math.pi * (np.arange(n) + rng.uniform()) / n
    psi = 0.4 - theta + rng.normal(0, SIGMA_RAD, n)
    ideal = np.stack([1.004 * np.cos(psi), 0.997 * np.sin(psi + 0.003)], axis=1)
    return _readings(G_MG * ideal + [12.0, -7.0] + rng.normal(0, NOISE_MG, (n, 2)), theta, SIGMA_RAD)


@dataclass(frozen=True)
class Spatial:
    """A sensor in space: reading = mixing @ gravity + bias."""

    mixing: Floats
    bias: Floats

    def means(self, directions: Floats, rng: np.random.Generator, noise_mg: float = NOISE_MG) -> Floats:
        """Readings (n, 3) of gravity along unit vectors (n, 3)."""
        noise = rng.normal(0, 1, directions.shape) * noise_mg
        return G_MG * directions @ self.mixing.T + self.bias + noise


SENSOR = Spatial(
    np.array([1.004, 0.997, 1.001])[:, None] * axes_matrix(np.array([0.003, -0.002, 0.004])),
    np.array([12.0, -7.0, 20.0]),
)


def attitudes(rng: np.random.Generator, n: int) -> Floats:
    """Directions (n, 3) all around."""
    u = rng.normal(size=(n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def spatial(rng: np.random.Generator, n: int) -> Readings:
    """Readings of n attitudes in space."""
    return _free(SENSOR.means(attitudes(rng, n), rng))


def _free(mean: Floats) -> Readings:
    return _readings(mean, np.full(len(mean), np.nan), math.inf)


# In the plane -------------------------------------------------------------------------------------------

NAMES = ("delta_k", "delta_phi", "bias_x", "bias_y")


@dataclass(frozen=True)
class Planar:
    """What every side of the planar benchmark gives: values, u, and the parameters of its model."""

    values: Floats
    u: Floats
    gains: Floats
    phi: float
    bias: Floats

    def angle_error_deg(self) -> float:
        """Error of the angle over a full turn at fresh positions, rms in degrees, its mean left out."""
        psi = np.linspace(0, 2 * math.pi, 1000, endpoint=False)
        reading = G_MG * np.stack([1.004 * np.cos(psi), 0.997 * np.sin(psi + 0.003)], axis=1) + [12.0, -7.0]
        c, s = ((reading - self.bias) / (G_MG * self.gains)).T
        shown = np.arctan2((s - c * math.sin(self.phi)) / math.cos(self.phi), c)
        return math.degrees(float(np.std(np.angle(np.exp(1j * (shown - psi))))))


def ours_planar(readings: Readings) -> Planar:
    """By `ml`."""
    result = fit_readings(readings, "ml")
    values = np.array([result[name].value for name in NAMES])
    u = np.array([result[name].u for name in NAMES], dtype=float)
    gains = np.array([result["scale_x"].value, result["scale_y"].value])
    values[1], u[1] = math.radians(values[1]), math.radians(u[1])
    return Planar(values, u, gains, values[1], values[2:])


def _residual_planar(readings: Readings) -> Callable[[Floats], Floats]:
    z, theta, u = readings.mean / G_MG, readings.angle_rad, NOISE_MG / G_MG

    def residual(p: Floats) -> Floats:
        psi = p[0] - theta + p[6:]
        model = np.stack([p[2] * np.cos(psi) + p[4], p[3] * np.sin(psi + p[1]) + p[5]], axis=1)
        return np.concatenate([((z - model) / u).ravel(), p[6:] / SIGMA_RAD])

    return residual


def _answer(p: Floats, covariance: Floats) -> Planar:
    ratio = p[2] / p[3]
    response = np.zeros((4, len(p)))
    response[0, 2:4] = 1 / p[3], -ratio / p[3]
    response[1, 1] = 1
    response[2, 4] = response[3, 5] = G_MG
    u = np.sqrt(np.einsum("ij,jk,ik->i", response, covariance, response))
    values = np.array([ratio - 1, p[1], G_MG * p[4], G_MG * p[5]])
    return Planar(values, u, p[2:4], float(p[1]), G_MG * p[4:6])


def _start(readings: Readings) -> Floats:
    start = np.zeros(6 + len(readings))
    start[0], start[2:4] = 0.35, 1.0
    return start


def scipy_planar(readings: Readings) -> Planar:
    """By scipy's `least_squares`, every angle a parameter, u from the Jacobian."""
    found = least_squares(_residual_planar(readings), _start(readings))
    return _answer(found.x, np.linalg.inv(found.jac.T @ found.jac))


def lmfit_planar(readings: Readings) -> Planar:
    """The same by lmfit."""
    import lmfit

    residual = _residual_planar(readings)
    parameters = lmfit.Parameters()
    for k, value in enumerate(_start(readings)):
        parameters.add(f"p{k}", value=value)
    found = lmfit.minimize(
        lambda p: residual(np.array(list(p.valuesdict().values()))), parameters, scale_covar=False
    )
    return _answer(np.array(list(found.params.valuesdict().values())), found.covar)


def agree_planar(name: str, ours: Planar, theirs: Planar) -> str:
    """Same values and same uncertainties."""
    off = float(np.max(np.abs(ours.values - theirs.values) / ours.u))
    wide = float(np.max(np.abs(theirs.u / ours.u - 1)))
    what = f"values to {off:.1g} u (allowed {TOLERANCE_U:g} u), u to {100 * wide:.1g} % (allowed 5 %)"
    return require(off <= TOLERANCE_U and wide <= 0.05, f"{name}: {what}").removeprefix(f"{name}: ")


# In space -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Space:
    """gravity = matrix @ (reading − bias), up to a rotation; `u` of bias (mg) where it is known."""

    matrix: Floats
    bias: Floats
    u: Floats | None = None

    @property
    def gains(self) -> Floats:
        """Lengths of the rows of the inverse: what each axis gives for 1 g."""
        length: Floats = np.linalg.norm(np.linalg.inv(self.matrix), axis=1)
        return length

    def angle_error_deg(self, sensor: Spatial) -> float:
        """Angle between gravity and what is computed, rms in degrees at 500 attitudes, a rotation free."""
        u = attitudes(np.random.default_rng(0), 500)
        v = (G_MG * u @ sensor.mixing.T + sensor.bias - self.bias) @ self.matrix.T
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        a, _, b = np.linalg.svd(v.T @ u)
        turned = v @ (a @ np.diag([1, 1, np.sign(np.linalg.det(a @ b))]) @ b)
        sine = np.linalg.norm(np.cross(turned, u), axis=1)
        return math.degrees(float(np.sqrt(np.mean(np.arcsin(np.clip(sine, 0, 1)) ** 2))))


def ours_space(readings: Readings) -> Space:
    """By `ml`, attitudes free."""
    result = fit_readings(readings, "ml")
    gains = np.array([result[f"scale_{a}"].value for a in "xyz"])
    skews = np.radians([result[f"skew_{a}"].value for a in ("xy", "xz", "yz")])
    bias = np.array([result[f"bias_{a}"].value for a in "xyz"])
    u = np.array([result[f"bias_{a}"].u for a in "xyz"], dtype=float)
    return Space(np.linalg.inv(gains[:, None] * axes_matrix(skews)), bias, u)


def tedaldi_space(readings: Readings) -> Space:
    """By Tedaldi's method."""
    return Space(*tedaldi(readings.mean, G_MG))


def agree_norm(name: str, ours: Space, theirs: Space) -> str:
    """Same bias and gains, in u."""
    u = np.ones(3) if ours.u is None else ours.u
    off = max(
        float(np.max(np.abs(ours.bias - theirs.bias) / u)),
        float(np.max(np.abs(ours.gains - theirs.gains) * G_MG / u)),
    )
    what = f"bias and gains to {off:.1g} u (allowed {NORM_TOLERANCE_U:g} u)"
    return require(off <= NORM_TOLERANCE_U, f"{name}: {what}").removeprefix(f"{name}: ")


FACES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
CORNERS = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / math.sqrt(3)
SAMPLES = 500
PLACED_DEG = 0.3
"""Standard uncertainty with which a face is placed by hand on a table."""


def _tilted(directions: Floats, rng: np.random.Generator, sigma_deg: float) -> Floats:
    moved = directions + rng.normal(0, math.radians(sigma_deg), directions.shape)
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def ferraris_regions(means: Floats, spread: Floats) -> Any:
    """Regions of six faces for imucal: samples (s, 3) around each mean; gyros that turned by one turn."""
    from imucal import FerrarisSignalRegions

    regions: dict[str, Floats] = {}
    still = np.zeros((len(spread), 3))
    for name, mean in zip(("x_p", "x_a", "y_p", "y_a", "z_p", "z_a"), means, strict=True):
        regions[f"acc_{name}"], regions[f"gyr_{name}"] = mean + spread, still
    for k, axis in enumerate("xyz"):
        turn = np.zeros((100, 3))
        turn[:, k] = -360.0
        regions[f"acc_{axis}_rot"], regions[f"gyr_{axis}_rot"] = np.tile(means[2 * k], (100, 1)), turn
    return FerrarisSignalRegions(**regions)


def ferraris(regions: Any) -> Space:
    """Accelerometer part of imucal's calibration (its gyro part runs along)."""
    from imucal import FerrarisCalibration

    found = FerrarisCalibration(grav=G_MG).compute(regions, 100.0, "mg", "deg/s")
    return Space(np.linalg.inv(found.K_a @ found.R_a), np.asarray(found.b_a))


def agree_exact(name: str, ours: Space, theirs: Space) -> str:
    """Same bias and Gram matrix on faces placed exactly and read without noise."""
    off = float(np.max(np.abs(ours.bias - theirs.bias))) / G_MG
    gram = float(np.max(np.abs(ours.matrix.T @ ours.matrix - theirs.matrix.T @ theirs.matrix)))
    what = f"without noise and placing error to {max(off, gram):.1g} (allowed {EXACT:g})"
    return require(max(off, gram) <= EXACT, what)


def run(rng: np.random.Generator, *, fast: bool) -> list[Row]:
    """All rows."""
    runs, sessions = (3, 5) if fast else (15, 100)
    rows: list[Row] = []
    turn = planar(rng, 24)
    sides = {"scipy least_squares by hand": scipy_planar, "lmfit": lmfit_planar}
    made = compare(
        "fit, plane, 24 positions",
        lambda: ours_planar(turn),
        {name: (lambda f=f: f(turn)) for name, f in sides.items()},
        agree_planar,
        runs,
    )
    trials = [planar(rng, 24) for _ in range(sessions)]
    own = _rms([ours_planar(t).angle_error_deg() for t in trials])
    for row in made:
        other = _rms([sides[row.baseline](t).angle_error_deg() for t in trials])
        rows.append(_with_error(row, other / own, sessions))
    poses = spatial(rng, 48)
    (row,) = compare(
        "fit, space, 48 attitudes",
        lambda: ours_space(poses),
        {"Tedaldi's multi-position method": lambda: tedaldi_space(poses)},
        agree_norm,
        runs,
    )
    pairs = [spatial(rng, 48) for _ in range(sessions)]
    own = _rms([ours_space(p).angle_error_deg(SENSOR) for p in pairs])
    rows.append(
        _with_error(row, _rms([tedaldi_space(p).angle_error_deg(SENSOR) for p in pairs]) / own, sessions)
    )
    rows.append(_ferraris_row(rng, runs, sessions))
    return rows


def _ferraris_row(rng: np.random.Generator, runs: int, sessions: int) -> Row:
    """14 poses placed by hand: all of them by `ml`, the six faces by Ferraris' method."""
    spread = rng.normal(0, 1, (SAMPLES, 3))
    spread -= spread.mean(axis=0)
    both = np.concatenate([FACES, CORNERS])

    def exact(side: str) -> Space:
        means = SENSOR.means(both, rng, 0.0)
        return ours_space(_free(means)) if side == "ours" else ferraris(ferraris_regions(means[:6], spread))

    agreement = agree_exact("imucal", exact("ours"), exact("theirs"))
    means = SENSOR.means(_tilted(both, rng, PLACED_DEG), rng)
    readings, regions = _free(means), ferraris_regions(means[:6], spread)
    (row,) = compare(
        "fit, space, 14 poses",
        lambda: ours_space(readings),
        {"imucal's Ferraris (6 of them, declared)": lambda: ferraris(regions)},
        lambda *_: agreement,
        runs,
    )
    ours, theirs = [], []
    for _ in range(sessions):
        means = SENSOR.means(_tilted(both, rng, PLACED_DEG), rng)
        ours.append(ours_space(_free(means)).angle_error_deg(SENSOR))
        theirs.append(ferraris(ferraris_regions(means[:6], spread)).angle_error_deg(SENSOR))
    return _with_error(row, _rms(theirs) / _rms(ours), sessions)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _with_error(row: Row, ratio: float, sessions: int) -> Row:
    note = f"its error of the angle is {ratio:.2f} times ours ({sessions} sessions)"
    return replace(row, note=note, figures={"error_ratio": ratio, "sessions": sessions})
