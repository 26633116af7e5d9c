"""From fitted parameters to what is reported: names, units, gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.determination import LIMIT, names_of
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.result import Estimate
from adis_gonio.fitting.sources import Sources
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import MG_PER_MPS2


@dataclass(frozen=True)
class Output:
    """A reported quantity: value and gradient (p,) by the parameters in natural units."""

    name: str
    value: float
    unit: str
    gradient: Floats


def outputs_of(data: Readings, parameters: Floats) -> tuple[Output, ...]:
    """All reported quantities of base parameters and biases (p,), these in mg.

    In the plane delta_k and delta_phi come first; gains and biases of readings in counts are in counts.
    """
    names = names_of(data)
    eye = np.eye(len(names))
    at = {name: k for k, name in enumerate(names)}
    axes = AXES[: data.axes]
    outputs = []
    for base in data.model.parameters:
        k = at[base.name]
        factor, unit = base.per_natural, base.unit
        if base.name.startswith("scale") and not data.unit.known:
            factor, unit = float(data.unit.per_mg[AXES.index(base.name[-1])]) * MG_PER_MPS2, "counts/(m/s²)"
        value = float(parameters[k]) * factor if unit != "deg" else base.stated(float(parameters[k]))
        outputs.append(Output(base.name, value, unit, eye[k] * factor))
    for axis, letter in enumerate(axes):
        k = at[f"bias_{letter}"]
        factor = float(data.unit.per_mg[axis])
        value = float(data.unit.zero[axis]) + float(parameters[k]) * factor
        outputs.append(Output(names[k], value, data.unit.name, eye[k] * factor * data.gravity_mg))
    if data.planar:
        x, y = at["scale_x"], at["scale_y"]
        ratio = float(data.unit.per_mg[0] / data.unit.per_mg[1])
        k_x, k_y = float(parameters[x]), float(parameters[y])
        outputs.append(
            Output("delta_k", ratio * k_x / k_y - 1, "1", ratio * (eye[x] / k_y - eye[y] * k_x / k_y**2))
        )
    return tuple(sorted(outputs, key=lambda output: _RANK.get(output.name, len(_RANK))))


def left_to_the_stage(found: Sequence[Estimate], sigma_rad: float) -> list[str]:
    """What has to be said where the axes' angle is known by the stage alone, and the stage is wide."""
    u_deg = next((one.u for one in found if one.name == "delta_phi"), None)
    if u_deg is None or math.radians(u_deg) <= LIMIT or not math.radians(u_deg) <= 2 * sigma_rad < math.inf:
        return []
    return [
        f"u of delta_phi is {u_deg:.2g}°: these positions leave it to the stage "
        f"({math.degrees(sigma_rad):.3g}°), and the uncertainties of gains and biases beside, which are "
        "linear in it, are rough; five positions or more, spread over the turn, need no stage for it"
    ]


_FIRST: Sequence[str] = ("delta_k", "delta_phi", "alpha", "scale_x", "scale_y", "scale_z")
_RANK = {name: rank for rank, name in enumerate(_FIRST)}


def variances(outputs: Sequence[Output], natural: Floats) -> Floats:
    """Covariance (m, m) of outputs by that of the parameters (p, p) in natural units."""
    gradients = np.stack([output.gradient for output in outputs])
    return np.asarray(gradients @ natural @ gradients.T)


def estimates(outputs: Sequence[Output], sources: Sources | None) -> tuple[Estimate, ...]:
    """Outputs with their uncertainty; None for it where nothing tells the noise."""
    found = []
    for output in outputs:
        u, dof = (None, math.inf) if sources is None else sources.uncertainty(output.gradient[None])
        found.append(Estimate(output.name, output.value, u, output.unit, dof))
    return tuple(found)
