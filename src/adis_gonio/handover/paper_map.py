"""The seed paper's table 1, and the conditions under which its method is better than MMPM.

| printed | read as |
|---|---|
| SF | relative error of an axis's scale: K − 1 |
| Δφ, "g/deg/s" | offset of zeros of equation 2, in g |
| N | misalignment Δφ of equation 3, the angle between X and Y away from 90°, in degrees |

A turn in one plane has one angle between X and Y, but the table prints N for each axis. The values are
read as two determinations of one angle, each the truth of a set of sessions: Δφ = 0.0612° for column X,
0.0673° for column Y. Both sets have the scales and offsets of both axes.

The map compares the paper's method with MMPM over fixture error, bias and noise of a reading. Thousands
of sessions through chip and driver would take hours, so the map uses readings of the planar model with a
fixture error at each position, a bias of each axis and white noise. The error of a method is the rms
deviation from the truth over sessions; the method with the smaller error is better.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import optimize

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import label_quantity
from adis_gonio.fitting.closed_form import DELTA_PHI, FOUR, SCALE_X, SCALE_Y, as_printed, turn_parameters
from adis_gonio.sim.world import GREATEST_ALPHA_DEG

Axis = Literal["x", "y"]
AXES: tuple[Axis, ...] = ("x", "y")


@dataclass(frozen=True)
class TableRow:
    """One row of table 1 of the paper for one axis, as printed.

    Attributes
    ----------
    key, printed, unit : str
        Name of the parameter in this package and in the paper, and the unit of its reading.
    axis : {"x", "y"}
    measured, paper, mmpm, specification : float
        Columns of the table.
    """

    key: str
    printed: str
    unit: str
    axis: Axis
    measured: float
    paper: float
    mmpm: float
    specification: float

    @property
    def name(self) -> str:
        """Name of the parameter and its axis, such as `SF, X`."""
        return f"{self.printed}, {self.axis.upper()}"

    @property
    def label(self) -> str:
        """Name with the unit, such as `N, X / °`."""
        return label_quantity(self.name, self.unit)


TABLE: tuple[TableRow, ...] = (
    TableRow("scale_error", "SF", "1", "x", 0.0214, 0.0116, 0.0128, 0.0),
    TableRow("scale_error", "SF", "1", "y", 0.021, 0.0121, 0.0129, 0.0),
    TableRow("offset", "Δφ", "g", "x", -0.003, -0.0025, -0.003, -0.001),
    TableRow("offset", "Δφ", "g", "y", -0.0029, -0.0023, -0.003, -0.001),
    TableRow("non_orthogonality", "N", "deg", "x", 0.0612, 0.051, -0.057, 0.05),
    TableRow("non_orthogonality", "N", "deg", "y", 0.0673, 0.0514, -0.055, 0.05),
)
"""Mean values in table 1 of the paper."""

RMSD = {"SF": 0.0033, "Δφ": 0.001}
"""Root mean square deviations that the paper prints with the specifications, which are averages."""


def row_of(key: str, axis: Axis) -> TableRow:
    """Find the row of the paper's table for a parameter and an axis."""
    return next(row for row in TABLE if (row.key, row.axis) == (key, axis))


class Truth(JsonRecord):
    """True parameters of the sensor in simulated sessions.

    Attributes
    ----------
    scale_x, scale_y : float
        Gains, 1 is perfect.
    delta_phi_deg : float
        Misalignment of Y in the plane.
    bias_x_mg, bias_y_mg : float
    """

    document_keys = ("scale_x", "scale_y", "delta_k", "delta_phi_deg", "bias_x_mg", "bias_y_mg")

    scale_x: float
    scale_y: float
    delta_phi_deg: float
    bias_x_mg: float
    bias_y_mg: float

    @property
    def delta_k(self) -> float:
        """True gain ratio ΔK = K_x/K_y − 1."""
        return self.scale_x / self.scale_y - 1

    @property
    def natural(self) -> tuple[float, float, float, float, float]:
        """Gains K_x and K_y, misalignment Δφ in rad, and biases b_x and b_y in g."""
        phi = float(np.radians(self.delta_phi_deg))
        return self.scale_x, self.scale_y, phi, self.bias_x_mg / 1000, self.bias_y_mg / 1000

    @property
    def values(self) -> dict[str, float]:
        """The true values of the paper's quantities, by name.

        They are relative scale errors, offsets in g, the non-orthogonality in degrees, and ΔK.
        """
        return {
            "scale_error_x": self.scale_x - 1,
            "scale_error_y": self.scale_y - 1,
            "offset_x": self.bias_x_mg / 1000,
            "offset_y": self.bias_y_mg / 1000,
            "non_orthogonality": self.delta_phi_deg,
            "delta_k": self.delta_k,
        }

    def with_bias(self, sigma_mg: float, rng: np.random.Generator) -> Truth:
        """Return a copy with random biases of standard deviation `sigma_mg`."""
        b_x, b_y = sigma_mg * rng.standard_normal(2)
        return replace(self, bias_x_mg=float(b_x), bias_y_mg=float(b_y))


def truth_of(column: Axis) -> Truth:
    """True parameters for the sessions of one column of the table: the table's measured values."""
    return Truth(
        1 + row_of("scale_error", "x").measured,
        1 + row_of("scale_error", "y").measured,
        row_of("non_orthogonality", column).measured,
        1000 * row_of("offset", "x").measured,
        1000 * row_of("offset", "y").measured,
    )


FIXTURES_DEG: tuple[float, ...] = (0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
BIASES_MG: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
NOISES_MG: tuple[float, ...] = (0.05, 0.16, 0.5, 1.6)
"""Values on the axes of the map: standard deviations of a stage angle, of a bias, and of a reading."""

MMPM_ANGLES_DEG = tuple(40.0 * k for k in range(9))
COMPARED = ("delta_k", "non_orthogonality")
DRAWS = 2000
_SEARCHED_DEG = (1e-3, 10.0)
"""Range of the search; with larger errors, equation 5 sometimes divides by almost zero."""


@dataclass(frozen=True)
class Point:
    """A point of the map: standard deviations of the three random errors of a simulated session.

    They are the errors of a stage angle (degrees), of the bias of an axis (mg) and of a reading (mg).
    """

    fixture_deg: float
    bias_mg: float
    noise_mg: float


@dataclass(frozen=True)
class Draws:
    """Random numbers of n sessions, drawn once and scaled at every point of the map.

    Attributes
    ----------
    alpha_rad : (n,) float
    fixture : (n, 4), (n, 9) float
        Fixture errors of the four and of the nine positions.
    bias : (n, 2) float
    noise : (n, 4, 2), (n, 9, 2) float
    """

    alpha_rad: Floats
    fixture: tuple[Floats, Floats]
    bias: Floats
    noise: tuple[Floats, Floats]

    @classmethod
    def of(cls, rng: np.random.Generator, n: int) -> Draws:
        """Draw the random numbers of n sessions from the generator."""
        sizes = (len(FOUR), len(MMPM_ANGLES_DEG))
        alpha = np.radians(rng.uniform(-GREATEST_ALPHA_DEG, GREATEST_ALPHA_DEG, n))
        fixture = tuple(rng.standard_normal((n, size)) for size in sizes)
        bias = rng.standard_normal((n, 2))
        noise = tuple(rng.standard_normal((n, size, 2)) for size in sizes)
        return cls(alpha, (fixture[0], fixture[1]), bias, (noise[0], noise[1]))


def readings(
    truth: Truth, angles_deg: Sequence[float], alpha_rad: Floats, fixture_rad: Floats, added: Floats
) -> Floats:
    """Simulate readings (n, positions, 2) of X and Y in units of local gravity, by the planar model.

    Parameters
    ----------
    alpha_rad : (n,) float
    fixture_rad : (n, positions) float
    added : (n, positions, 2) float
        Bias and noise, in local gravity.
    """
    k_x, k_y, phi, *_ = truth.natural
    # Angle of gravity in the part, (n, positions).
    psi = alpha_rad[:, None] - np.radians(np.asarray(angles_deg, dtype=float)) + fixture_rad
    return np.stack([k_x * np.cos(psi), k_y * np.sin(psi + phi)], axis=2) + added


def by_positions(angles_deg: Sequence[float], natural: Floats, *, bias: bool) -> Floats:
    """Fit the parameters (n, 6) of n sessions by least squares, with the declared angles.

    `natural` are the readings (n, positions, 2) in local gravity.
    """
    theta = np.radians(np.asarray(angles_deg, dtype=float))
    # Linear problem U = A cos θ + B sin θ (+ b) of each axis, solved for all sessions at once.
    columns = [np.cos(theta), np.sin(theta)] + [np.ones_like(theta)] * bias
    return turn_parameters(np.einsum("kp,npa->nka", np.linalg.pinv(np.stack(columns, axis=1)), natural))


def estimates(truth: Truth, point: Point, draws: Draws) -> dict[str, dict[str, Floats]]:
    """ΔK and Δφ (degrees) of every session at a point of the map, for four methods.

    The methods are `paper`, `two-position`, `four-position` and `mmpm`, which need only the readings and
    the declared angles.

    The methods are `paper`, `two-position`, `four-position` and `mmpm`; `ml` and the trace need whole
    sessions.
    """
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
    # The paper and its closed form use the first two of the four positions.
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
    """Errors of ΔK and Δφ (degrees) by method, rms over the sessions with a result."""
    true = truth.values
    return {
        method: {key: rms(values[key] - true[key]) for key in COMPARED}
        for method, values in estimates(truth, point, draws).items()
    }


def rms(values: Floats) -> float:
    """Root mean square of the finite values."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


def crossing_deg(
    truth: Truth, bias_mg: float, noise_mg: float, draws: Draws, key: str = "delta_k"
) -> float | None:
    """Fixture error in degrees above which the paper's method is better than MMPM.

    Returns None if there is no such error up to 10°.
    """

    # Log ratio of the errors; it changes its sign at the crossing.
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
class Map:
    """Errors of ΔK and Δφ by method, over a grid of fixture error, bias and noise.

    Attributes
    ----------
    draws : int
        Sessions of each point.
    error : mapping of Point to mapping
        Errors by method and parameter.
    crossing : mapping of (bias, noise) to float or None
        Fixture error in degrees above which the paper's ΔK is better than the ΔK by MMPM; None if there
        is no such error up to 10°.
    """

    draws: int
    error: Mapping[Point, Mapping[str, Mapping[str, float]]]
    crossing: Mapping[tuple[float, float], float | None]

    def ratio(self, point: Point, key: str) -> float:
        """Error of the paper's method over the error of MMPM, for one parameter at one point."""
        return self.error[point]["paper"][key] / self.error[point]["mmpm"][key]

    @property
    def least_ratio_phi(self) -> float:
        """Smallest ratio of the errors of Δφ, paper's method over MMPM, among all points of the map."""
        return min(self.ratio(point, "non_orthogonality") for point in self.error)

    def as_dict(self) -> dict[str, Any]:
        """JSON form of the map."""
        return {
            "draws": self.draws,
            "points": [{**asdict(point), "error": error} for point, error in self.error.items()],
            "crossing_of_delta_k": [
                {"bias_mg": bias, "noise_mg": noise, "fixture_deg": fixture}
                for (bias, noise), fixture in self.crossing.items()
            ],
            "least_ratio_of_delta_phi": self.least_ratio_phi,
        }


def map_of(truth: Truth, draws: Draws) -> Map:
    """Compute the errors at all points of the map from simulated readings."""
    points = [Point(f, b, n) for n in NOISES_MG for b in BIASES_MG for f in FIXTURES_DEG]
    return Map(
        len(draws.alpha_rad),
        {point: errors(truth, point, draws) for point in points},
        {(b, n): crossing_deg(truth, b, n, draws) for n in NOISES_MG for b in BIASES_MG},
    )
