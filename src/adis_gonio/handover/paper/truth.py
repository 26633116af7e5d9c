"""The seed paper's table 1 as it is printed, and how it is read.

| printed | read as |
|---|---|
| SF | relative error of an axis's scale: K − 1 |
| Δφ, "g/deg/s" | offset of zeros of equation 2, in g |
| N | misalignment Δφ of equation 3, the angle between X and Y away from 90°, in degrees |

A turn in one plane has one angle between X and Y, the table prints N for each. The two are therefore read
as two determinations of one angle, each the truth of sessions of its own: column X has Δφ = 0.0612°,
column Y has 0.0673°. Scales and offsets are those of both axes in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from adis_gonio.base.numbers import label_quantity

Axis = Literal["x", "y"]
AXES: tuple[Axis, ...] = ("x", "y")


@dataclass(frozen=True)
class TableRow:
    """One row of table 1 for one axis, as printed.

    Attributes
    ----------
    key, printed, unit : str
        Our name of the parameter, the paper's, and the unit that we read it in.
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
        """Such as `SF, X`."""
        return f"{self.printed}, {self.axis.upper()}"

    @property
    def label(self) -> str:
        """Name with the unit, such as `N, X / °`."""
        return label_quantity(self.name, self.unit)


TABLE: tuple[TableRow, ...] = (
    TableRow("scale_error", "SF", "1", "x", 0.0214, 0.0116, 0.0128, 0.0),
    TableRow("scale_error", "SF", "1", "y", 0.021, 0.0121, 0.0129, 0.0),
    TableRow("offset", "Δφ", "g", "x", -0.003, -0.0025, -0.003, -0.001),
    TableRow("offset", "Δφ", "g", "y", -0.0029, -0.0023, -0.003, 0.001),
    TableRow("non_orthogonality", "N", "deg", "x", 0.0612, 0.051, -0.057, 0.05),
    TableRow("non_orthogonality", "N", "deg", "y", 0.0673, 0.0514, -0.055, 0.05),
)
"""Table 1, mean values."""

RMSD = 0.0033
"""Printed beside the specification of SF."""


def row_of(key: str, axis: Axis) -> TableRow:
    """Row of a parameter and an axis."""
    return next(row for row in TABLE if (row.key, row.axis) == (key, axis))


@dataclass(frozen=True)
class Truth:
    """Hidden parameters of simulated sessions.

    Attributes
    ----------
    scale_x, scale_y : float
        Gains, 1 is perfect.
    delta_phi_deg : float
        Misalignment of Y in the plane.
    bias_mg : (float, float)
        Of X and Y.
    """

    scale_x: float
    scale_y: float
    delta_phi_deg: float
    bias_mg: tuple[float, float]

    @property
    def delta_k(self) -> float:
        """K_x/K_y − 1."""
        return self.scale_x / self.scale_y - 1

    @property
    def natural(self) -> tuple[float, float, float, float, float]:
        """K_x, K_y, Δφ in rad, b_x and b_y in local gravity."""
        b_x, b_y = (b / 1000 for b in self.bias_mg)
        return self.scale_x, self.scale_y, float(np.radians(self.delta_phi_deg)), b_x, b_y

    @property
    def values(self) -> dict[str, float]:
        """The paper's quantities: relative errors of scales, offsets in g, the angle in degrees, ΔK."""
        return {
            "scale_error_x": self.scale_x - 1,
            "scale_error_y": self.scale_y - 1,
            "offset_x": self.bias_mg[0] / 1000,
            "offset_y": self.bias_mg[1] / 1000,
            "non_orthogonality": self.delta_phi_deg,
            "delta_k": self.delta_k,
        }

    def with_bias(self, sigma_mg: float, rng: np.random.Generator) -> Truth:
        """The same gains and misalignment, with biases of a standard deviation."""
        b_x, b_y = sigma_mg * rng.standard_normal(2)
        return replace(self, bias_mg=(float(b_x), float(b_y)))

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "scale_x": self.scale_x,
            "scale_y": self.scale_y,
            "delta_k": self.delta_k,
            "delta_phi_deg": self.delta_phi_deg,
            "bias_x_mg": self.bias_mg[0],
            "bias_y_mg": self.bias_mg[1],
        }


def truth_of(column: Axis) -> Truth:
    """Truth of the sessions of a column: the table's measured values."""
    return Truth(
        1 + row_of("scale_error", "x").measured,
        1 + row_of("scale_error", "y").measured,
        row_of("non_orthogonality", column).measured,
        (1000 * row_of("offset", "x").measured, 1000 * row_of("offset", "y").measured),
    )
