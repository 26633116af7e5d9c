"""Where the paper's method overtakes MMPM: over fixture error, bias and noise of a reading.

Thousands of sessions through chip and driver would take hours. The map is therefore made of readings: the
planar model with a fixture error of its own at each position, a bias of each axis and white noise. Points
drawn from it are measured through chip and driver besides (`checked_points`), to see whether both agree.

The error of a method is rms over sessions about the truth; it overtakes where its error is smaller.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import Record
from adis_gonio.device.sensor.settings import sample_period_s
from adis_gonio.fitting.closed_form import DELTA_PHI, FOUR, SCALE_X, SCALE_Y, as_printed, turn_parameters
from adis_gonio.handover.paper.sessions import DWELL_S, METHODS, Part, Results, true_values
from adis_gonio.handover.paper.truth import Truth
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.sim.world import GREATEST_ALPHA_DEG

FIXTURES_DEG: tuple[float, ...] = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
BIASES_MG: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
NOISES_MG: tuple[float, ...] = (0.05, 0.16, 0.5, 1.6)
"""Levels of the map: standard deviations of a declared angle, of the bias of an axis, of a reading."""

MMPM_ANGLES_DEG = tuple(40.0 * k for k in range(9))
COMPARED = ("delta_k", "non_orthogonality")
BY_READINGS = ("paper", "two-position", "four-position", "mmpm")
DRAWS = 2000
_SEARCHED_DEG = (1e-3, 10.0)
"""Farther out a position is now and then across, where equation 5 divides by nothing."""


@dataclass(frozen=True)
class Point:
    """A place of the map: standard deviations of fixture (degrees), bias and noise of a reading (mg)."""

    fixture_deg: float
    bias_mg: float
    noise_mg: float


@dataclass(frozen=True)
class Draws:
    """What is random in n sessions, in units of its standard deviation: every point uses the same ones.

    Attributes
    ----------
    alpha_rad : (n,) float
    fixture : (n, 4), (n, 9) float
        Of the four and the nine positions.
    bias : (n, 2) float
    noise : (n, 4, 2), (n, 9, 2) float
    """

    alpha_rad: Floats
    fixture: tuple[Floats, Floats]
    bias: Floats
    noise: tuple[Floats, Floats]

    @classmethod
    def of(cls, rng: np.random.Generator, n: int) -> Draws:
        """Draw n sessions."""
        sizes = (len(FOUR), len(MMPM_ANGLES_DEG))
        alpha = np.radians(rng.uniform(-GREATEST_ALPHA_DEG, GREATEST_ALPHA_DEG, n))
        fixture = tuple(rng.standard_normal((n, size)) for size in sizes)
        bias = rng.standard_normal((n, 2))
        noise = tuple(rng.standard_normal((n, size, 2)) for size in sizes)
        return cls(alpha, (fixture[0], fixture[1]), bias, (noise[0], noise[1]))


def readings(
    truth: Truth, angles_deg: Sequence[float], alpha_rad: Floats, fixture_rad: Floats, added: Floats
) -> Floats:
    """Readings (n, positions, 2) of X and Y in local gravity, by the planar model.

    Parameters
    ----------
    alpha_rad : (n,) float
    fixture_rad : (n, positions) float
    added : (n, positions, 2) float
        Bias and noise, in local gravity.
    """
    k_x, k_y, phi, *_ = truth.natural
    psi = alpha_rad[:, None] - np.radians(np.asarray(angles_deg, dtype=float)) + fixture_rad
    return np.stack([k_x * np.cos(psi), k_y * np.sin(psi + phi)], axis=2) + added


def by_positions(angles_deg: Sequence[float], natural: Floats, *, bias: bool) -> Floats:
    """Parameters (n, 6) of readings (n, positions, 2) by least squares that trusts the angles."""
    theta = np.radians(np.asarray(angles_deg, dtype=float))
    columns = [np.cos(theta), np.sin(theta)] + [np.ones_like(theta)] * bias
    return turn_parameters(np.einsum("kp,npa->nka", np.linalg.pinv(np.stack(columns, axis=1)), natural))


def estimates(truth: Truth, point: Point, draws: Draws) -> dict[str, dict[str, Floats]]:
    """ΔK and Δφ (degrees) of every session by each method of `BY_READINGS`."""
    fixture = math.radians(point.fixture_deg)
    at_four, at_nine = (
        readings(
            truth,
            angles,
            draws.alpha_rad,
            fixture * draws.fixture[k],
            1e-3 * (point.bias_mg * draws.bias[:, None, :] + point.noise_mg * draws.noise[k]),
        )
        for k, angles in enumerate((FOUR, MMPM_ANGLES_DEG))
    )
    two = at_four[:, :2]
    with np.errstate(invalid="ignore", divide="ignore"):
        gain, phi = as_printed(two[:, 0, 0], two[:, 0, 1], two[:, 1, 0], two[:, 1, 1])
    found = {"paper": {"delta_k": gain, "non_orthogonality": np.degrees(phi)}}
    for method, parameters in (
        ("two-position", by_positions(FOUR[:2], two, bias=False)),
        ("four-position", by_positions(FOUR, at_four, bias=True)),
        ("mmpm", by_positions(MMPM_ANGLES_DEG, at_nine, bias=True)),
    ):
        found[method] = {
            "delta_k": parameters[:, SCALE_X] / parameters[:, SCALE_Y] - 1,
            "non_orthogonality": np.degrees(parameters[:, DELTA_PHI]),
        }
    return found


def errors(truth: Truth, point: Point, draws: Draws) -> dict[str, dict[str, float]]:
    """Error (rms over the sessions that have an answer) of ΔK and of Δφ in degrees, by method."""
    true = true_values(truth)
    return {
        method: {key: rms(values[key] - true[key]) for key in COMPARED}
        for method, values in estimates(truth, point, draws).items()
    }


def rms(values: Floats) -> float:
    """Root of the mean square of those that are finite."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


def crossing_deg(
    truth: Truth, bias_mg: float, noise_mg: float, draws: Draws, key: str = "delta_k"
) -> float | None:
    """Fixture error in degrees from which the paper's method is better; None: at none to 10°."""

    def excess(log_deg: float) -> float:
        found = errors(truth, Point(math.exp(log_deg), bias_mg, noise_mg), draws)
        return math.log(found["paper"][key] / found["mmpm"][key])

    low, high = map(math.log, _SEARCHED_DEG)
    if excess(low) < 0:
        return _SEARCHED_DEG[0]
    if excess(high) > 0:
        return None
    return math.exp(float(optimize.brentq(excess, low, high, xtol=1e-3)))


@dataclass(frozen=True)
class Checked(Record):
    """A point of the map, measured through chip and driver.

    Attributes
    ----------
    sessions : int
    by_chip : mapping of str to mapping of str to float
        Error by method and parameter, rms.
    by_readings : mapping of str to mapping of str to float
        The same of the map's own sessions.
    p : float
        That squared errors so far from the map's would be chance, for the least likely method and
        parameter, times their number (Bonferroni).
    """

    point: Point
    sessions: int
    by_chip: Mapping[str, Mapping[str, float]]
    by_readings: Mapping[str, Mapping[str, float]]
    p: float


@dataclass(frozen=True)
class Map:
    """The map of ΔK and Δφ.

    Attributes
    ----------
    draws : int
        Sessions of each point.
    error : mapping of Point to mapping
        Errors by method and parameter.
    crossing : mapping of (bias, noise) to float or None
        Fixture error at which the paper's ΔK overtakes MMPM's, in degrees; None: at none to 10°.
    checked : tuple of Checked
    """

    draws: int
    error: Mapping[Point, Mapping[str, Mapping[str, float]]]
    crossing: Mapping[tuple[float, float], float | None]
    checked: tuple[Checked, ...] = ()

    def ratio(self, point: Point, key: str) -> float:
        """Error of the paper's method over that of MMPM."""
        return self.error[point]["paper"][key] / self.error[point]["mmpm"][key]

    @property
    def least_ratio_phi(self) -> float:
        """The most favourable place of the map for the paper's Δφ."""
        return min(self.ratio(point, "non_orthogonality") for point in self.error)

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "draws": self.draws,
            "points": [{**asdict(point), "error": error} for point, error in self.error.items()],
            "crossing_of_delta_k": [
                {"bias_mg": bias, "noise_mg": noise, "fixture_deg": fixture}
                for (bias, noise), fixture in self.crossing.items()
            ],
            "least_ratio_of_delta_phi": self.least_ratio_phi,
            "checked": [one.as_dict() for one in self.checked],
        }


def map_of(truth: Truth, draws: Draws) -> Map:
    """The whole map, by readings."""
    points = [Point(f, b, n) for n in NOISES_MG for b in BIASES_MG for f in FIXTURES_DEG]
    return Map(
        len(draws.alpha_rad),
        {point: errors(truth, point, draws) for point in points},
        {(b, n): crossing_deg(truth, b, n, draws) for n in NOISES_MG for b in BIASES_MG},
    )


def points_to_check(rng: np.random.Generator, count: int) -> list[Point]:
    """Places of the map, drawn without repetition."""
    points = [Point(f, b, n) for n in NOISES_MG[1:] for b in BIASES_MG for f in FIXTURES_DEG[1:]]
    return [points[k] for k in rng.choice(len(points), count, replace=False)]


def parts_at(point: Point, truth: Truth, rng: np.random.Generator, sessions: int) -> list[Part]:
    """Parts through chip and driver that stand for a point of the map.

    A sample's noise is that of a reading times the root of the samples in it; the chip's 1/f noise is
    switched off, which the map does not have.
    """
    sample_mg = point.noise_mg * math.sqrt(DWELL_S / sample_period_s(1))
    parts = []
    for _ in range(sessions):
        b_x, b_y = point.bias_mg * rng.standard_normal(2)
        settings = {
            "fixture_sigma_deg": point.fixture_deg,
            "noise_mg": sample_mg,
            "bias_instability_mg": 0.0,
            "gravity_mps2": STANDARD_GRAVITY_MPS2,
        }
        hidden = Truth(truth.scale_x, truth.scale_y, truth.delta_phi_deg, (float(b_x), float(b_y)))
        parts.append(Part(int(rng.integers(2**31)), hidden, settings))
    return parts


def checked(point: Point, truth: Truth, draws: Draws, measured: Sequence[Results]) -> Checked:
    """Compare what came through chip and driver with the map."""
    by_readings = errors(truth, point, draws)
    by_chip: dict[str, dict[str, float]] = {}
    for method in METHODS:
        by_chip[method] = {key: rms(_errors(measured, method, key)) for key in COMPARED}
    values = estimates(truth, point, draws)
    true = true_values(truth)
    least = 1.0
    for method in BY_READINGS:
        for key in COMPARED:
            least = min(least, _alike(_errors(measured, method, key), values[method][key] - true[key]))
    return Checked(
        point,
        len(measured),
        {m: e for m, e in by_chip.items() if math.isfinite(e[COMPARED[0]])},
        by_readings,
        min(1.0, least * len(BY_READINGS) * len(COMPARED)),
    )


def _alike(ours: Floats, theirs: Floats) -> float:
    """p-value that both samples of errors have one distribution (Kolmogorov and Smirnov)."""
    ours, theirs = ours[np.isfinite(ours)], theirs[np.isfinite(theirs)]
    return float(stats.ks_2samp(ours, theirs).pvalue) if len(ours) else 1.0


def _errors(measured: Sequence[Results], method: str, key: str) -> NDArray[np.float64]:
    """Errors of a method over the sessions in which it answered."""
    found = [
        (one.found[method].values[key], true_values(one.part.truth)[key])
        for one in measured
        if method in one.found
    ]
    return np.array([value - true for value, true in found if value is not None], dtype=float)
