"""Data of the figures of a trace: residual against covariate, before and after each added effect.

The points are dwells; for a single pose, which `one_pose` traces, they are averages over time.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.model.effects import AXES
from adis_gonio.tracing.trace_result import TraceResult
from adis_gonio.tracing.validation import residuals_on
from adis_gonio.tracing.what_if import WhatIf

_COVARIATES = ("angle", "time", "temperature", "supply")
_LEAST_SPAN = {"temperature": 0.145, "supply": 0.0018}
"""Ranges (°C, V) below one digit of the chip's thermometer and voltmeter, not shown in figures."""


@dataclass(frozen=True)
class Panel:
    """Data of one plot: residuals of one quantity over one covariate.

    Attributes
    ----------
    covariate : str
        angle (degrees), previous_angle (degrees), time (minutes), order (number of the dwell), temperature
        (°C), temperature_rate (°C/min), temperature_lag (°C), supply (V), approach (+1, −1), reading_x …
        (g), variance (mg²).
    quantity : str
        residual_x, residual_y, residual_z: residual of an axis in mg; norm (in space): residual along
        gravity in mg; angle: angle computed from the reading minus the declared angle, in degrees.
    x : (n,) float
        Values of the covariate.
    before, after : (n,) float
        Values of the quantity without and with the added effect.
    u : (n,) float
        Standard uncertainty of a point; NaN if unknown.
    check_x, check_after : (m,) float
        Covariate and quantity (with the effect) of the check dwells.
    """

    covariate: str
    quantity: str
    x: Floats
    before: Floats
    after: Floats
    u: Floats
    check_x: Floats = field(default_factory=lambda: np.zeros(0))
    check_after: Floats = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Views:
    """Data of all residual figures of a trace.

    Attributes
    ----------
    steps : tuple of tuple of Panel
        Residuals before and after each added effect; empty for an effect whose term is unknown.
    left : tuple of Panel
        Residuals of the final model (`after`) and of the base model (`before`).
    """

    steps: tuple[tuple[Panel, ...], ...]
    left: tuple[Panel, ...]


def views_of(readings: Readings, result: TraceResult) -> Views:
    """Return the data of the figures: residuals of the readings before and after each added effect.

    Parameters
    ----------
    readings : Readings
        Readings of all dwells of the session, check dwells included.
    """
    checking, chain = readings.checking, result.fits
    steps = []
    for before, after in itertools.pairwise(chain):
        inside = {term.label for term in before.terms}
        fresh = [term for term in after.terms if term.label not in inside] or after.terms
        steps.append(_panels(checking, fresh[-1], before, after))
    return Views(tuple(steps), _residual_panels(checking, result))


def what_if_panels(what_if: WhatIf) -> tuple[Panel, ...]:
    """Return panels with the residuals of the best model (`before`) and of the asked model (`after`).

    They are over the covariates of the terms that only one of the two models has.
    """
    best, asked = what_if.fits
    labels = [{term.label for term in fit.terms} for fit in (asked, best)]
    terms = [
        term
        for fit, other in zip((best, asked), labels, strict=True)
        for term in fit.terms
        if term.label not in other
    ]
    panels = [panel for term in terms for panel in _panels(None, term, best, asked)]
    return tuple({(panel.covariate, panel.quantity): panel for panel in panels}.values())


def _panels(checking: Readings | None, term: Term, before: Fit, after: Fit) -> tuple[Panel, ...]:
    """Return panels with the residuals of two fits over the covariate of a term, one for each axis.

    `checking` are the readings of check dwells, None without any.
    """
    data = after.data
    if term.enters_angle and data.planar and data.conditions.angle_rad is not None:
        return (_panel(checking, _covariate(data, term, 0), "angle", before, after),)
    axes = term.axes if isinstance(term, NamelessTerm) else ()
    if isinstance(term, NamedTerm):
        axes = tuple(AXES.index(letter) for letter in term.effect.axes)
    wanted = {
        (_covariate(data, term, axis), f"residual_{AXES[axis]}" if data.by_axis else "norm"): None
        for axis in axes or (0,)
    }
    return tuple(_panel(checking, *one, before, after) for one in wanted)


def _covariate(data: Readings, term: Term, axis: int) -> str:
    """Return the name of the covariate over which the residual shows a term best, on one axis."""
    planar_angle = data.planar and data.conditions.angle_rad is not None
    shown = term.effect.shown_over if isinstance(term, NamedTerm) else ""
    name = term.covariates[0] if term.covariates else ""
    own = f"reading_{AXES[axis]}"
    if shown == "angle":
        # A constant has no covariate; over the angle it shows as a harmonic that the base model lacks.
        return "angle" if planar_angle else own
    if shown:
        return shown
    if name in ("", "reading"):
        return own
    return name if _values(data, name) is not None else "order"


def _values(data: Readings, name: str) -> Floats | None:
    """Return the values (n,) of a covariate in the unit of the figures; None if it was not recorded.

    `name` is the covariate as in `Panel.covariate`.
    """
    c = data.conditions
    if name.startswith("reading_"):
        return data.mean[:, AXES.index(name[-1])] / data.model.full
    if name in ("force", "rotation"):
        rows = c.force_g if name == "force" else c.rate_dps
        return None if rows is None else rows[:, int(np.ptp(rows, axis=0).argmax())]
    if name in ("angle", "previous_angle"):
        rad = c.angle_rad if name == "angle" else c.previous_angle_rad
        return None if rad is None else np.degrees(rad)
    if name == "temperature_rate":
        history = c.temperature_history
        if history is None or len(history[0]) < 2:
            return None
        return np.interp(c.time_s, history[0], np.gradient(history[1], history[0])) * 60.0
    if name == "variance":
        return None if c.variance_mg2 is None else c.variance_mg2.mean(axis=1)
    fields = {"temperature": "temperature_c", "supply": "supply_v", "line_frequency": "line_hz"}
    found: Floats | None = getattr(c, fields.get(name, name), None)
    return c.time_s / 60.0 if name == "time" else found


def _lag(data: Readings, after: Fit) -> Floats:
    """Return the temperature of the fitted lagging element minus the die's temperature, (n,) in °C.

    An effect of a model may belong to an element of the sensor whose temperature lags behind the die. The
    result is NaN if the model `after` has no such effect.
    """
    for term, values in zip(after.terms, after.values.terms, strict=True):
        if isinstance(term, NamedTerm) and term.effect.shown_over == "temperature_lag":
            axis = AXES.index(term.effect.axes[0])
            ideal = np.ones((len(data), data.axes))
            column: Floats = term.derivative(values, ideal, data.conditions)[:, axis, 0]
            return column
    return np.full(len(data), np.nan)


def _panel(checking: Readings | None, covariate: str, quantity: str, before: Fit, after: Fit) -> Panel:
    """Return one panel; its abscissa is NaN if the covariate was not recorded.

    `covariate` and `quantity` are named as in `Panel`. `checking` are the readings of check dwells, None
    without any.
    """
    data = after.data

    def abscissa(rows: Readings) -> Floats:
        if covariate == "temperature_lag":
            return _lag(rows, after)
        found = _values(rows, covariate)
        return np.full(len(rows), np.nan) if found is None else found

    was, now = view_residual(before, quantity), view_residual(after, quantity)
    u = view_uncertainty(after, quantity) if data.noise_known else np.full(len(data), np.nan)
    panel = Panel(covariate, quantity, abscissa(data), was, now, u)
    if checking is None:
        return panel
    return replace(panel, check_x=abscissa(checking), check_after=view_residual(after, quantity, checking))


def view_residual(fit: Fit, quantity: str, others: Readings | None = None) -> Floats:
    """Return the residual (n,) of an axis, along gravity (`norm`), or of the angle in degrees.

    It is for the fitted dwells, or for the dwells of `others` if given. `quantity` is named as in
    `Panel.quantity`.
    """
    data = fit.data if others is None else others
    if quantity == "angle":
        turned = fit.angle_error_rad(data)
        assert turned is not None
        return np.degrees(wrap_radians(turned))
    left = fit.misfit if others is None else residuals_on(fit, others).residual
    if quantity == "norm":
        return np.asarray((left * _along(data)).sum(axis=1))
    return np.asarray(left[:, AXES.index(quantity[-1])])


def _along(data: Readings) -> Floats:
    pose = data.model.pose(data.mean, data.conditions)
    assert pose is not None  # readings judged by their norm have a direction
    return pose


def view_uncertainty(fit: Fit, quantity: str) -> Floats:
    """Return the standard uncertainty (n,) of the residual of an axis, along gravity, or of the angle.

    `quantity` is named as in `Panel.quantity`.
    """
    data = fit.data
    if quantity == "angle":
        # A reading changes by `slope` standard uncertainties per rad.
        slope = np.linalg.norm(data.root @ fit.tangent, axis=1)[:, 0]
        fixture = np.where(np.isfinite(data.fixture), data.fixture, 0.0)
        return np.asarray(np.degrees(np.hypot(1 / slope, fixture)))
    if quantity == "norm":
        across = _along(data)
        return np.asarray(np.sqrt(np.einsum("nj,njk,nk->n", across, data.covariance, across)))
    axis = AXES.index(quantity[-1])
    return np.asarray(np.sqrt(data.covariance[:, axis, axis]))


def _residual_panels(checking: Readings | None, result: TraceResult) -> tuple[Panel, ...]:
    """Return panels with the final model's residual over each covariate that varied.

    `checking` are the readings of check dwells, None without any. The covariates of the unnamed part are
    first.
    """
    base, last = result.fits[0], result.fits[-1]
    data = last.data
    unnamed = result.unnamed.covariates if result.unnamed is not None else ()
    names = list(dict.fromkeys((*unnamed, *_COVARIATES)))
    if not data.planar:
        names += [f"reading_{letter}" for letter in AXES[: data.axes]]
    quantities = [f"residual_{letter}" for letter in AXES[: data.axes]] if data.by_axis else ["norm"]
    out = []
    for name in names:
        values = _values(data, name)
        if values is not None and np.ptp(values) > (0.0 if name in unnamed else _LEAST_SPAN.get(name, 0.0)):
            out += [_panel(checking, name, quantity, base, last) for quantity in quantities]
    return tuple(out)
