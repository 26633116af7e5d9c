"""Calibrations with known numbers, one of each kind that a header can hold."""

from __future__ import annotations

import numpy as np

from adis_gonio.calibrate import Calibration, Coefficient, EffectTerm
from adis_gonio.model.effects import effect
from adis_gonio.record.provenance import Covered, Provenance

PLANE = {
    "alpha": 31.25,
    "scale_x": 1.012,
    "scale_y": 0.991,
    "delta_phi": 0.41,
    "bias_x": 12.3,
    "bias_y": -27.9,
}
SPACE = {
    "scale_x": 1.012, "scale_y": 0.991, "scale_z": 1.004, "skew_xy": 0.41, "skew_xz": -0.33,
    "skew_yz": 0.27, "bias_x": 12.3, "bias_y": -27.9, "bias_z": 40.1,
}  # fmt: skip
CURVED = {"quadratic": (6.1, -3.4), "bias_temperature": (0.31, -0.62)}
EVERY = {
    "scale": (1.3e-3, -0.7e-3),
    "misalignment": (0.21, -0.17),
    "cross_axis": (2.2, -1.9),
    "quadratic": (6.1, -3.4),
    "cubic": (1.7, -2.1),
    "asymmetry": (1.1, -0.9),
    "cross_quadratic": (1.4, -2.6),
    "bias_temperature": (0.31, -0.011, 1.2e-4, -0.62, 0.007, -0.9e-4),
    "scale_temperature": (61.0, -45.0),
    "misalignment_temperature": (0.0021, -0.0018),
    "supply_bias": (7.3, -5.1),
    "supply_scale": (2100.0, -1900.0),
}
CHOICES = {"bias_temperature": {"degree": 3}}


def calibration(
    base: dict[str, float],
    effects: dict[str, tuple[float, ...]] | None = None,
    *,
    sensor: str = "adis16354",
    counts_per_mg: tuple[float, ...] | None = None,
    **where: str,
) -> Calibration:
    """A calibration of parameters that are known up to small uncertainties."""
    parameters, terms = [], []
    for name, value in base.items():
        unit = "deg" if name.startswith(("alpha", "delta_phi", "skew")) else "1"
        unit = "mg" if name.startswith("bias") else unit
        parameters.append(Coefficient(name, value, 1e-4, unit))
    axes = ("x", "y", "z") if "scale_z" in base else ("x", "y")
    for name, values in (effects or {}).items():
        kind = effect(name, axes, **(CHOICES.get(name, {}) if len(values) > len(axes) else {}))
        names = tuple(f"{one.name}_also" if one.name in base else one.name for one in kind.parameters)
        assert len(names) == len(values), name
        terms.append(EffectTerm(kind, names))
        parameters += [
            Coefficient(n, v, 1e-4, one.unit)
            for n, v, one in zip(names, values, kind.parameters, strict=True)
        ]
    source = Provenance(
        sensor,
        "xy" if len(axes) == 2 else "none",
        9.81,
        counts=counts_per_mg is not None,
        sha256="ab" * 32,
        temperature_c=Covered(25.0, 20.0, 30.0),
        supply_v=Covered(5.0, 4.9, 5.1),
        **where,
    )
    matrix = np.diag([one.u**2 for one in parameters])
    return Calibration(
        method="trace",
        provenance=source,
        parameters=tuple(parameters),
        covariance=matrix,
        effects=tuple(terms),
        counts_per_mg=counts_per_mg,
    )


def of_counts(zero: float = 300.0) -> Calibration:
    """Readings in counts: 2.5 to a mg and zeros at `zero` and −120."""
    counts = {**PLANE, "bias_x": zero, "bias_y": -120.0}
    per_mg = (2.5, 2.4)
    for axis, own in zip("xy", per_mg, strict=True):
        counts[f"scale_{axis}"] = PLANE[f"scale_{axis}"] * own * 1000 / 9.80665
    return calibration(counts, {"quadratic": (6.1, -3.4)}, sensor="generic", counts_per_mg=per_mg)
