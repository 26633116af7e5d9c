"""The catalogue's terms as columns, written from their formulas (docs/effects.md) for this benchmark alone.

A `Term` is one way in which a name can act (on x alone, with this time constant, in that dwell): columns
that are linear in their amplitudes. The generator plants them, the oracle and the simple runners look
for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from .circumstances import Circumstances, Floats, lagged

TAUS_S = (60.0, 150.0, 400.0, 1000.0)
"""Time constants that are tried where a term has one."""

NAMES = (
    "cross_axis",
    "quadratic",
    "cubic",
    "asymmetry",
    "cross_quadratic",
    "bias_temperature",
    "scale_temperature",
    "thermal_lag",
    "bias_drift",
    "warm_up",
    "supply_bias",
    "vibration_rectification",
    "hysteresis",
    "backlash",
    "stage_eccentricity",
    "stage_ellipticity",
    "position_slip",
    "outlier_dwell",
)
"""Names that show in the readings beside a bias."""

WITHIN = ("tone", "settling", "noise_change", "saturation", "quantization")
"""Names that show within the dwells."""

_ANGLE = {"backlash", "stage_eccentricity", "stage_ellipticity", "position_slip"}


@dataclass
class Term:
    """One way in which a cause can act.

    Attributes
    ----------
    name : str
        Name in the catalogue, or `stranger`.
    label : str
        Name and which way.
    parameters : tuple of str
        Name of each amplitude, in the catalogue's spelling.
    reading : (n, axes, k) float
        What one unit of each amplitude adds to the readings, mg.
    angle : (n, k) float
        What it adds to the true angle, rad.
    """

    name: str
    label: str
    parameters: tuple[str, ...]
    reading: Floats
    angle: Floats


def _by_axis(name: str, c: Circumstances, stems: list[tuple[str, Floats]], extra: str = "") -> list[Term]:
    """Terms on each axis alone and on all; stems of (parameter's name, column (n,), axis number)."""
    axes = "xyz"[: c.axes]
    terms = []
    for chosen in [*axes, axes]:
        parameters: list[str] = []
        columns = []
        for stem, value in stems:
            for letter in chosen:
                i = axes.index(letter)
                v = value if value.ndim == 1 else value[:, i]
                column = np.zeros((c.n, c.axes))
                column[:, i] = v
                parameters.append(f"{stem}_{letter}")
                columns.append(column)
        reading = np.stack(columns, axis=2)
        terms.append(
            Term(
                name, f"{name}[{chosen}]{extra}", tuple(parameters), reading, np.zeros((c.n, len(columns)))
            )
        )
    return terms


def _across(name: str, c: Circumstances, stem: str, a: Floats, square: bool) -> list[Term]:
    """Terms of the pairs (axis, axis across): each pair alone and all of them."""
    axes = "xyz"[: c.axes]
    pairs = list(permutations(range(c.axes), 2))
    columns = {}
    for i, p in pairs:
        column = np.zeros((c.n, c.axes))
        column[:, i] = a[:, p] ** 2 if square else a[:, i] * a[:, p]
        columns[f"{stem}_{axes[i]}{axes[p]}"] = column
    groups = [[key] for key in columns] + [list(columns)]
    return [
        Term(
            name,
            f"{name}[{','.join(g)}]",
            tuple(g),
            np.stack([columns[key] for key in g], axis=2),
            np.zeros((c.n, len(g))),
        )
        for g in groups
    ]


def _angular(
    name: str, c: Circumstances, parameters: tuple[str, ...], *columns: Floats, label: str = ""
) -> Term:
    angle = np.radians(np.column_stack(columns))
    return Term(name, label or name, parameters, np.zeros((c.n, c.axes, angle.shape[1])), angle)


def terms(name: str, c: Circumstances, a: Floats) -> list[Term]:
    """All ways in which a name can act in a session; none where the session cannot show it.

    Parameters
    ----------
    name : str
        One of NAMES, or `bias`.
    c : Circumstances
    a : (n, axes) float
        What the axes should read, in g.
    """
    if name in _ANGLE and not c.plane:
        return []
    if name == "bias":
        return _by_axis(name, c, [("bias", np.ones(c.n))])
    if name == "quadratic":
        return _by_axis(name, c, [("k2", a**2)])
    if name == "cubic":
        return _by_axis(name, c, [("k3", a**3)])
    if name == "asymmetry":
        return _by_axis(name, c, [("asymmetry", np.abs(a))])
    if name == "cross_axis":
        return _across(name, c, "kip", a, square=False)
    if name == "cross_quadratic":
        return _across(name, c, "kpp", a, square=True)
    if name == "bias_drift":
        return _by_axis(name, c, [("drift", c.minutes)])
    if name == "warm_up":
        return [
            t
            for tau in TAUS_S
            for t in _by_axis(name, c, [("warm_up", np.exp(-c.time_s / tau))], f"(tau={tau:g})")
        ]
    if name == "vibration_rectification":
        known = np.ptp(c.variance_mg2) > 0
        return _by_axis(name, c, [("vre", c.variance_mg2 * 1e-6)]) if known else []
    if name in ("bias_temperature", "scale_temperature", "thermal_lag"):
        return _thermal(name, c, a)
    if name == "supply_bias":
        return [] if np.isnan(c.supply_v).any() else _by_axis(name, c, [("supply", c.supply_v - 5)])
    if name in ("hysteresis", "backlash"):
        if np.ptp(c.approach) == 0:
            return []
        if name == "backlash":
            return [_angular(name, c, ("backlash",), c.approach / 2)]
        return _by_axis(name, c, [("hysteresis", c.approach / 2)])
    if name == "stage_eccentricity":
        return [_angular(name, c, ("ecc_sin", "ecc_cos"), np.sin(c.angle_rad), np.cos(c.angle_rad))]
    if name == "stage_ellipticity":
        return [_angular(name, c, ("ell_sin", "ell_cos"), np.sin(2 * c.angle_rad), np.cos(2 * c.angle_rad))]
    if name in ("position_slip", "outlier_dwell"):
        return _single(name, c)
    raise KeyError(name)


def _thermal(name: str, c: Circumstances, a: Floats) -> list[Term]:
    if np.isnan(c.temp_c).any() or np.ptp(c.temp_c) == 0:
        return []
    warmth = c.temp_c - 25
    if name == "bias_temperature":
        return _by_axis(name, c, [("tempco", warmth)])
    if name == "scale_temperature":
        return _by_axis(name, c, [("scale_tempco", 1e-3 * warmth[:, None] * a)])
    return [
        t
        for tau in TAUS_S
        for t in _by_axis(name, c, [("lag", lagged(c.time_s, c.temp_c, tau) - c.temp_c)], f"(tau={tau:g})")
    ]


def _single(name: str, c: Circumstances) -> list[Term]:
    """One dwell moved (angle) or disturbed (reading); dwells are numbered from 1, check dwells left out."""
    out = []
    for k in np.flatnonzero(~c.check):
        here = np.zeros(c.n)
        here[k] = 1
        extra = f"(dwell={k + 1})"
        if name == "position_slip":
            out.append(_angular(name, c, ("slip",), here, label=name + extra))
        else:
            out += _by_axis(name, c, [("offset", here)], extra)
    return out
