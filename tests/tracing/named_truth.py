"""Own physics of the catalogue's effects that a planar session can show, from docs/effects.md.

Written apart from the product's effect objects so that an error in one of them shows. Left out are names
that the base model absorbs in the plane (scale, misalignment, gravity, axis_tilt), the bias, which is in
every part, and those that live among the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from tracing.plans import Floats, Rows

Basis = Callable[[Rows, Floats], Floats]
AXES = "xyz"


@dataclass(frozen=True)
class Term:
    """What a session hides: coefficients times a basis.

    Attributes
    ----------
    basis : callable
        From rows (n) and ideal readings (n, 2) to (k, n, 2) in mg, or to (k, n) in degrees for a term of
        the true angle (`attitude`).
    coefficients : (k,) float
    reported : tuple of str
        Name of each coefficient in the product's units, for a catalogued term.
    shapes : dict
        Nonlinear parameters by name.
    covariates : tuple of str
        What drives it; for an undeclared term.
    also : tuple of str
        Covariates that may be named besides: the reading, for what multiplies it.
    leading : tuple of str
        Catalogue names that are the leading part of the same cause.
    form : str
        Regular expression of words, one of which names its form.
    """

    name: str
    basis: Basis
    coefficients: Floats
    attitude: bool = False
    reported: tuple[str, ...] = ()
    shapes: dict[str, float] = field(default_factory=dict)
    covariates: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    leading: tuple[str, ...] = ()
    form: str = ""
    needs: tuple[str, ...] = ()

    def value(self, rows: Rows, ideal_mg: Floats) -> Floats:
        """Contribution (n, 2) in mg or (n,) in degrees."""
        return np.tensordot(self.coefficients, self.basis(rows, ideal_mg), axes=1)

    def scaled(self, factor: float) -> Term:
        """The same with its coefficients multiplied."""
        return replace(self, coefficients=self.coefficients * factor)


def on_axes(axes: str, drive: Callable[[Rows, Floats, int], Floats]) -> Basis:
    """Basis with one column an axis of `axes`: `drive(rows, ideal, axis)` (n,) there, zero beside."""

    def basis(rows: Rows, ideal_mg: Floats) -> Floats:
        columns = np.zeros((len(axes), *ideal_mg.shape))
        for k, axis in enumerate(axes):
            i = AXES.index(axis)
            columns[k, :, i] = drive(rows, ideal_mg, i)
        return columns

    return basis


def lagged(rows: Rows, driver: Floats, tau_s: float) -> Floats:
    """Lag of a driver (m,) of the history at the rows' times, τ dy/dt = x − y, by small steps."""
    times, _ = rows.history
    fine = np.linspace(times[0], times[-1], 4000)
    step = fine[1] - fine[0]
    course = np.interp(fine, times, driver)
    kept = np.exp(-step / tau_s)
    # The lag e = T − T_lag obeys e' = kept·e + s·τ·(1 − kept), exactly for a constant slope s over a step.
    feed = np.concatenate([[0.0], np.diff(course) / step * tau_s * (1 - kept)])
    late = course - lfilter([1.0], [1.0, -kept], feed)
    return np.interp(rows.time_s, fine, late)


_READING: dict[str, tuple[str, Callable[[Rows, Floats, int], Floats], tuple[str, ...]]] = {
    "cross_axis": ("kip_{i}{p}", lambda r, a, i: a[:, 0] * a[:, 1] * 1e-6, ()),
    "quadratic": ("k2_{i}", lambda r, a, i: (a[:, i] / 1000) ** 2, ()),
    "cubic": ("k3_{i}", lambda r, a, i: (a[:, i] / 1000) ** 3, ()),
    "asymmetry": ("asymmetry_{i}", lambda r, a, i: np.abs(a[:, i]) / 1000, ()),
    "cross_quadratic": ("kpp_{i}{p}", lambda r, a, i: (a[:, 1 - i] / 1000) ** 2, ()),
    "bias_temperature": ("tempco_{i}", lambda r, a, i: r.temperature_c - 25, ("surroundings",)),
    "scale_temperature": (
        "scale_tempco_{i}",
        lambda r, a, i: 1e-6 * (r.temperature_c - 25) * a[:, i],
        ("surroundings",),
    ),
    "bias_drift": ("drift_{i}", lambda r, a, i: r.time_s / 60, ()),
    "supply_bias": ("supply_{i}", lambda r, a, i: r.supply_v - 5, ("surroundings",)),
    "hysteresis": ("hysteresis_{i}", lambda r, a, i: r.approach / 2, ("approach",)),
    "scale_drift": ("scale_drift_{i}", lambda r, a, i: 1e-6 * r.time_s / 60 * a[:, i], ()),
    "supply_scale": (
        "supply_scale_{i}",
        lambda r, a, i: 1e-6 * (r.supply_v - 5) * a[:, i],
        ("surroundings",),
    ),
    "misalignment_temperature": (
        "misalignment_tempco_{i}{p}",
        lambda r, a, i: np.pi / 180 * (r.temperature_c - 25) * a[:, 1 - i],
        ("surroundings",),
    ),
}
_STAGE: dict[str, tuple[tuple[str, ...], Callable[[Rows], Floats], tuple[str, ...]]] = {
    "backlash": (("backlash",), lambda r: r.approach[None] / 2, ("approach",)),
    "stage_eccentricity": (
        ("ecc_sin", "ecc_cos"),
        lambda r: np.stack([np.sin(r.angle_rad), np.cos(r.angle_rad)]),
        (),
    ),
    "stage_ellipticity": (
        ("ell_sin", "ell_cos"),
        lambda r: np.stack([np.sin(2 * r.angle_rad), np.cos(2 * r.angle_rad)]),
        (),
    ),
}
LASTING: dict[str, tuple[str, Callable[[Rows, Floats, int, float], Floats], tuple[str, ...]]] = {
    "thermal_lag": (
        "lag_{i}",
        lambda r, a, i, tau: lagged(r, r.history[1], tau) - r.temperature_c,
        ("surroundings",),
    ),
    "warm_up": ("warm_up_{i}", lambda r, a, i, tau: np.exp(-r.time_s / tau), ()),
    "creep": ("creep_{i}", lambda r, a, i, tau: (lagged(r, r.loads[:, i], tau) - a[:, i]) / 1000, ()),
}
"""Names with a time constant."""
OF_ONE_AXIS = {"misalignment_temperature"}
"""Names that are drawn on one axis: two leans at once are one lean and a part that turns with its mount."""
MOST_CYCLES = 24
"""Most cycles a turn of `stage_periodic` that the judge tries."""
NAMES = (*_READING, *_STAGE, *LASTING, "stage_periodic", "position_slip", "outlier_dwell")


def catalogued_term(name: str, axes: str, choice: float) -> Term:
    """Term of unit coefficients; `choice` is τ in s, cycles a turn or the number of a dwell."""
    ones = np.ones(len(axes))
    if name in _READING:
        label, drive, needs = _READING[name]
        labels = tuple(label.format(i=i, p="yxy"[AXES.index(i)]) for i in axes)
        return Term(name, on_axes(axes, drive), ones, reported=labels, needs=needs)
    if name in _STAGE:
        labels, waves, needs = _STAGE[name]
        return Term(
            name, lambda r, a: waves(r), np.ones(len(labels)), attitude=True, reported=labels, needs=needs
        )
    if name in LASTING:
        label, late, needs = LASTING[name]
        basis = on_axes(axes, lambda r, a, i: late(r, a, i, choice))
        labels = tuple(label.format(i=i) for i in axes)
        return Term(name, basis, ones, reported=labels, shapes={"tau": choice}, needs=needs)
    if name == "stage_periodic":
        return Term(
            name,
            lambda r, a: np.stack([np.sin(choice * r.angle_rad), np.cos(choice * r.angle_rad)]),
            np.ones(2),
            attitude=True,
            reported=("per_sin", "per_cos"),
            shapes={"cycles": choice},
        )
    if name == "position_slip":
        return Term(
            name,
            lambda r, a: (r.order == choice).astype(float)[None],
            np.ones(1),
            attitude=True,
            reported=("slip",),
        )
    if name == "outlier_dwell":
        labels = tuple(f"offset_{i}" for i in axes)
        basis = on_axes(axes, lambda r, a, i: (r.order == choice).astype(float))
        return Term(name, basis, ones, reported=labels)
    raise KeyError(name)


def draw_named(
    rng: np.random.Generator,
    name: str,
    rows: Rows,
    check: NDArray[np.bool_],
    choices: Sequence[str] = ("x", "y", "xy"),
) -> Term:
    """A catalogued term with random axes, signs and shapes (its size is set afterwards)."""
    axes = str(rng.choice(choices))
    choice = 0.0
    if name in OF_ONE_AXIS:
        axes = axes[0]
    if name == "stage_periodic":
        angles = len(np.unique(np.round(np.mod(rows.angle_rad[~check], 2 * np.pi), 6)))
        choice = float(rng.integers(3, max((angles - 1) // 2, 3), endpoint=True))
    elif name in LASTING:
        choice = float(rows.time_s[-1] * np.exp(rng.uniform(np.log(0.05), np.log(0.4))))
    elif name in {"position_slip", "outlier_dwell"}:
        choice = float(rng.choice(np.flatnonzero(~check)[1:]))
        axes = choices[-1]
    term = catalogued_term(name, axes, choice)
    size = rng.choice([-1, 1], len(term.coefficients)) * rng.uniform(0.5, 1, len(term.coefficients))
    return replace(term, coefficients=term.coefficients * size)


def alternatives(name: str, rows: Rows, axes: str = "xy") -> list[Term]:
    """All that `name` could mean in a session: every axis, time constants by grid, each dwell, degrees."""
    if name in OF_ONE_AXIS:
        return [catalogued_term(name, axis, 0.0) for axis in axes]
    if name == "stage_periodic":
        return [catalogued_term(name, axes, float(cycles)) for cycles in range(3, MOST_CYCLES + 1)]
    if name in LASTING:
        taus = rows.time_s[-1] * np.geomspace(0.01, 4, 14)
        return [catalogued_term(name, axes, float(tau)) for tau in taus]
    if name in {"position_slip", "outlier_dwell"}:
        return [catalogued_term(name, axes, float(k)) for k in rows.order]
    if name == "bias_temperature":
        powers = []
        for degree in (1, 2, 3):

            def basis(r: Rows, a: Floats, degree: int = degree) -> Floats:
                line = [
                    on_axes(axes, lambda r, a, i, p=p: ((r.temperature_c - 25) / 10) ** p)(r, a)
                    for p in range(1, degree + 1)
                ]
                return np.concatenate(line)

            powers.append(Term(name, basis, np.ones(len(axes) * degree), needs=("surroundings",)))
        return powers
    return [catalogued_term(name, axes, 0.0)]
