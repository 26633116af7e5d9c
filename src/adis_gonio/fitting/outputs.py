"""From natural parameters to what is reported: names, units, gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.fitting import planar, spatial
from adis_gonio.fitting.families import Units
from adis_gonio.model.records import Floats


@dataclass(frozen=True)
class Output:
    """A reported quantity at the solution: value and gradient (p,) by the natural parameters."""

    name: str
    value: float
    unit: str
    gradient: Floats


def planar_outputs(beta: Floats, units: Units) -> tuple[Output, ...]:
    """delta_k, delta_phi, alpha, scale_x, scale_y, bias_x, bias_y of natural parameters (6,)."""
    eye = np.eye(6)
    to_deg = 180 / math.pi
    ratio = float(units.per_g[0] / units.per_g[1])
    x, y = float(beta[planar.SCALE_X]), float(beta[planar.SCALE_Y])
    bias_unit = "mg" if units.unit == "mg" else "counts"
    outputs = [
        Output(
            "delta_k",
            ratio * x / y - 1,
            "1",
            ratio * (eye[planar.SCALE_X] / y - eye[planar.SCALE_Y] * x / y**2),
        ),
        Output("delta_phi", float(beta[planar.DELTA_PHI]) * to_deg, "deg", eye[planar.DELTA_PHI] * to_deg),
        Output(
            "alpha",
            (float(beta[planar.ALPHA]) * to_deg + 180) % 360 - 180,
            "deg",
            eye[planar.ALPHA] * to_deg,
        ),
    ]
    gain = units.scale_per_natural
    for k, axis in enumerate("xy"):
        index = planar.SCALE_X + k
        outputs.append(
            Output(f"scale_{axis}", float(beta[index] * gain[k]), units.scale_unit, eye[index] * gain[k])
        )
    for k, axis in enumerate("xy"):
        index = planar.BIAS_X + k
        value = float(units.zero[k] + beta[index] * units.per_g[k])
        outputs.append(Output(f"bias_{axis}", value, bias_unit, eye[index] * units.per_g[k]))
    return tuple(outputs)


def spatial_outputs(beta: Floats, units: Units) -> tuple[Output, ...]:
    """Biases, scales and skews of natural parameters (9,)."""
    eye = np.eye(9)
    gain = units.scale_per_natural
    bias_unit = "mg" if units.unit == "mg" else "counts"
    outputs = []
    for k in range(3):
        value = float(units.zero[k] + beta[k] * units.per_g[k])
        outputs.append(Output(spatial.NAMES[k], value, bias_unit, eye[k] * units.per_g[k]))
    for k in range(3):
        outputs.append(
            Output(
                spatial.NAMES[3 + k], float(beta[3 + k] * gain[k]), units.scale_unit, eye[3 + k] * gain[k]
            )
        )
    for k in range(6, 9):
        outputs.append(
            Output(spatial.NAMES[k], math.degrees(float(beta[k])), "deg", eye[k] * 180 / math.pi)
        )
    return tuple(outputs)
