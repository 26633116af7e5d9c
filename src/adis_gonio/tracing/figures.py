"""What the figures of a trace show: residual against covariate before and after each step.

A `TraceResult` holds numbers and names, not residuals. Here its steps are fitted again to the session: of
the terms that a step's name can mean, the one whose full refit has the step's residual.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.model.effects import AXES, Conditions, catalogue
from adis_gonio.model.records import Floats, Session
from adis_gonio.tracing.design import linearise, span
from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.heldout import leave, rms
from adis_gonio.tracing.named import covariates_of, named_terms
from adis_gonio.tracing.naming import describe
from adis_gonio.tracing.observations import Observations, observe
from adis_gonio.tracing.result import Finding, Step, TraceResult, Value
from adis_gonio.tracing.selection import fit_model
from adis_gonio.tracing.state import Refit, begin, refit
from adis_gonio.tracing.terms import NamedTerm, NamelessTerm, Term

_SAME = 1e-4
"""Relative difference of two residuals up to which a refitted step is the step of the trace."""
_REFITS = 16
_LEFT = ("angle", "time", "temperature", "supply")
_LEAST_SPAN = {"temperature": 0.145, "supply": 0.0018}
"""Spans (°C, V) below one step of the part's own sensors: nothing can be read from such an axis."""


@dataclass(frozen=True)
class Panel:
    """One axis of one step.

    Attributes
    ----------
    covariate : str
        angle (degrees), previous_angle (degrees), time (minutes), order (number of the dwell), temperature
        (°C), temperature_rate (°C/min), temperature_lag (°C), supply (V), approach (+1, −1), reading_x …
        (g), variance (mg²).
    quantity : str
        residual_x, residual_y, residual_z, or norm (in space), in mg; angle in degrees: what the calibrated
        goniometer computes minus the declared angle.
    x : (n,) float
    before, after : (n,) float
    u : (n,) float
        Standard uncertainty of a point; NaN where it is not known.
    check_x, check_after : (m,) float
        Dwells that took no part.
    """

    covariate: str
    quantity: str
    x: Floats
    before: Floats
    after: Floats
    u: Floats
    check_x: Floats
    check_after: Floats


@dataclass(frozen=True)
class StepView:
    """The panels of a step; none where its term could not be told from its name.

    `beside_all`: before is the final model without this effect, not the model of the step before.
    """

    effect: str
    panels: tuple[Panel, ...]
    beside_all: bool = False


@dataclass(frozen=True)
class Views:
    """All that is shown of a trace beside its result.

    Attributes
    ----------
    steps : tuple of StepView
    left : tuple of Panel
        What the final model leaves; before: the base model.
    delta_k : Value or None
        K_x/K_y − 1 of the final model, with the covariance of both; None without a plane.
    """

    steps: tuple[StepView, ...]
    left: tuple[Panel, ...]
    delta_k: Value | None = None


@dataclass(frozen=True)
class _Fitted:
    model: tuple[Term, ...]
    fit: Refit


def views(session: Session, result: TraceResult) -> Views:
    """Residuals of a traced session before and after each step.

    Raises
    ------
    DataError, FitError
        As `adis_gonio.trace`, which such a session does not survive.
    """
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    if len(dwells) == 1:
        return _series_views(session, result)
    data = observe(session)
    training = data.rows(~data.check)
    checking = data.rows(data.check) if data.check.any() else None
    chain = _chain(training, result)
    steps = []
    for before, after in itertools.pairwise(chain):
        name = describe(after.model[-1]) if after is not before else ""
        term = after.model[-1] if after is not before else None
        steps.append(
            StepView(name, () if term is None else _panels(training, checking, term, before, after))
        )
    names = [step.effect for step in result.steps]
    steps = [replace(view, effect=name) for view, name in zip(steps, names, strict=True)]
    return Views(
        tuple(steps),
        _left(training, checking, result, chain[0], chain[-1]),
        _delta_k(result, chain[-1].fit) if data.planar else None,
    )


def _delta_k(result: TraceResult, fit: Refit) -> Value:
    """ΔK with the covariance of the refit, at the level of noise that the trace worked with."""
    _, kx, ky, _ = fit.state.base
    slope = np.array([1 / ky, -kx / ky**2])
    u = np.sqrt(slope @ fit.covariance[1:3, 1:3] @ slope)
    stated, own = result.base["scale_x"].u, float(np.sqrt(fit.covariance[1, 1]))
    level = stated / own if stated is not None and own > 0 else 1.0
    return Value(float(kx / ky - 1), float(u * level), "1")


def _chain(data: Observations, result: TraceResult) -> list[_Fitted]:
    """The base model and the model after each step; an unrecognised step repeats the one before."""
    base = _Fitted((), refit(data, (), begin(data)))
    chain = [base]
    if not result.steps:
        return chain
    names = {step.effect for step in result.steps}
    every: list[Term] = [*named_terms(data)[0], *nameless_terms(data)]
    pool = [term for term in every if describe(term) in names and _on_found_axes(term, result.found)]
    likely = {label for rival in result.rivals for label in rival.terms}
    for step in result.steps:
        chain.append(_next(data, base, chain[-1], step, pool, likely) or chain[-1])
    return chain


def _on_found_axes(term: Term, found: Sequence[Finding]) -> bool:
    for finding in found:
        if isinstance(term, NamedTerm) and finding.effect == term.name:
            chosen = {c: v.value for c, v in finding.parameters.items() if c in term.effect.choices()}
            same = all(getattr(term.effect, c) == value for c, value in chosen.items())
            return set(term.effect.axes) <= set(finding.axes) and (same or not chosen or _several(finding))
    return True


def _several(finding: Finding) -> bool:
    """An effect with a choice may stand for several terms, of which the finding shows the last choice."""
    return finding.effect in ("position_slip", "outlier_dwell")


def _next(
    data: Observations, base: _Fitted, last: _Fitted, step: Step, pool: Sequence[Term], likely: set[str]
) -> _Fitted | None:
    """The model with the term whose refit has the residual of the step."""
    inside = {term.label for term in last.model}
    options = [term for term in pool if describe(term) == step.effect and term.label not in inside]
    problem = linearise(data, (), base.fit.state, [*last.model, *options]) if options else None
    if problem is None:
        return None
    at = {term.label: k for k, term in enumerate(problem.terms)}
    if any(label not in at for label in inside):
        return None
    chosen = [at[term.label] for term in last.model]
    seen = [at[term.label] for term in options if term.label in at]
    chi2 = {k: float((span(problem, [*chosen, k])[1] ** 2).sum()) for k in seen}
    ranked = sorted(seen, key=lambda k: (problem.terms[k].label not in likely, chi2[k]))
    best: tuple[float, _Fitted] | None = None
    for k in ranked[:_REFITS]:
        model = (*last.model, problem.terms[k])
        fit = fit_model(data, problem, [*chosen, k], base.fit.state)
        size = rms(data.mean_mg - fit.prediction.predicted_mg, data.planar)
        off = abs(size - step.error.residual_rms_mg) / max(step.error.residual_rms_mg, 1e-12)
        if best is None or off < best[0]:
            best = (off, _Fitted(model, fit))
        if off < _SAME:
            break
    return None if best is None else best[1]


def _panels(
    data: Observations, checking: Observations | None, term: Term, before: _Fitted, after: _Fitted
) -> tuple[Panel, ...]:
    if term.enters_angle and data.planar and data.conditions.angle_rad is not None:
        return (_panel(data, checking, _covariate(data, term, 0), "angle", before, after),)
    if not data.planar:
        axes = _axes(term)
        wanted = dict.fromkeys(_covariate(data, term, axis) for axis in axes)
        return tuple(_panel(data, checking, name, "norm", before, after) for name in wanted)
    return tuple(
        _panel(data, checking, _covariate(data, term, axis), f"residual_{AXES[axis]}", before, after)
        for axis in _axes(term)
    )


def _axes(term: Term) -> list[int]:
    if isinstance(term, NamelessTerm):
        return list(term.axes) or [0]
    if isinstance(term, NamedTerm) and term.effect.axes:
        return [AXES.index(letter) for letter in term.effect.axes]
    return [0]


def _covariate(data: Observations, term: Term, axis: int) -> str:
    """The covariate that explains a term best to the eye."""
    planar_angle = data.planar and data.conditions.angle_rad is not None
    if term.name == "thermal_lag":
        return "temperature_lag"
    name = term.covariates[0] if term.covariates else ""
    own = f"reading_{AXES[axis]}"
    if term.name in ("bias", "cross_axis", "cross_quadratic"):
        # A constant has no covariate: it shows as a harmonic of the turn that the base model cannot follow.
        return "angle" if planar_angle else own
    if name in ("", "reading"):
        return own
    return name if _values(data.conditions, data, name) is not None else "order"


def _values(conditions: Conditions, data: Observations, name: str) -> Floats | None:
    """Covariate (n,) in the unit of a figure; None where it was not recorded."""
    if name.startswith("reading_"):
        axis = AXES.index(name[-1])
        return data.mean_mg[:, axis] / 1000.0
    if name == "time":
        return conditions.time_s / 60.0
    if name in ("angle", "previous_angle"):
        rad = conditions.angle_rad if name == "angle" else conditions.previous_angle_rad
        return None if rad is None else np.degrees(rad)
    if name == "temperature_rate":
        history = conditions.temperature_history
        if history is None or len(history[0]) < 2:
            return None
        return np.interp(conditions.time_s, history[0], np.gradient(history[1], history[0])) * 60.0
    if name == "variance":
        rows = conditions.variance_mg2
        return None if rows is None else rows.mean(axis=1)
    fields = {
        "temperature": "temperature_c",
        "supply": "supply_v",
        "order": "order",
        "approach": "approach",
    }
    found: Floats | None = getattr(conditions, fields[name]) if name in fields else None
    return found


def _lag(data: Observations, after: _Fitted) -> Floats:
    """Temperature of the lagging element minus the die's (n,) in °C, as the fitted effect has it."""
    for term, values in zip(after.model, after.fit.state.values, strict=True):
        if term.name == "thermal_lag" and isinstance(term, NamedTerm):
            axis = AXES.index(term.effect.axes[0])
            ideal = np.ones((len(data), data.axes))
            column: Floats = term.derivative(values, ideal, data.conditions)[:, axis, 0]
            return column
    return np.full(len(data), np.nan)


def _panel(
    data: Observations,
    checking: Observations | None,
    covariate: str,
    quantity: str,
    before: _Fitted,
    after: _Fitted,
) -> Panel:
    def abscissa(rows: Observations) -> Floats:
        if covariate == "temperature_lag":
            return _lag(rows, after)
        found = _values(rows.conditions, rows, covariate)
        return np.full(len(rows), np.nan) if found is None else found

    was, _ = _left_over(data, before, quantity, fitted=True)
    now, u = _left_over(data, after, quantity, fitted=True)
    none = np.zeros(0)
    check_x, check_now = none, none
    if checking is not None:
        check_x, check_now = abscissa(checking), _left_over(checking, after, quantity, fitted=False)[0]
    return Panel(
        covariate,
        quantity,
        abscissa(data),
        was,
        now,
        u if data.known else np.full(len(data), np.nan),
        check_x,
        check_now,
    )


def _left_over(data: Observations, model: _Fitted, quantity: str, fitted: bool) -> tuple[Floats, Floats]:
    """Residual (n,) of a quantity and its standard uncertainty."""
    at = model.fit.prediction
    if quantity == "angle":
        turned = leave(data, model.model, model.fit.state).angle_rad
        assert turned is not None
        root = np.linalg.inv(np.linalg.cholesky(data.covariance))
        slope = np.linalg.norm(root @ at.tangent, axis=1)[:, 0] if fitted else np.ones(len(data))
        fixture = data.fixture_rad if np.isfinite(data.fixture_rad) else 0.0
        wrapped = np.mod(turned + np.pi, 2 * np.pi) - np.pi
        return np.degrees(wrapped), np.degrees(np.hypot(1 / slope, fixture))
    if quantity == "norm":
        across = data.mean_mg / np.linalg.norm(data.mean_mg, axis=1, keepdims=True)
        left = (
            data.mean_mg - at.predicted_mg
            if fitted
            else leave(data, model.model, model.fit.state).residual_mg
        )
        u = np.sqrt(np.einsum("nj,njk,nk->n", across, data.covariance, across))
        return (left * across).sum(axis=1), u
    axis = AXES.index(quantity[-1])
    left = (
        data.mean_mg - at.predicted_mg if fitted else leave(data, model.model, model.fit.state).residual_mg
    )
    return left[:, axis], np.sqrt(data.covariance[:, axis, axis])


def _left(
    data: Observations,
    checking: Observations | None,
    result: TraceResult,
    base: _Fitted,
    last: _Fitted,
) -> tuple[Panel, ...]:
    """What the final model leaves against every covariate that moved, those of the unnamed rest first."""
    unnamed = result.unnamed.covariates if result.unnamed is not None else ()
    names = list(dict.fromkeys((*unnamed, *_LEFT)))
    if not data.planar:
        names += [f"reading_{letter}" for letter in AXES[: data.axes]]
    quantities = [f"residual_{letter}" for letter in AXES[: data.axes]] if data.planar else ["norm"]
    out = []
    for name in names:
        values = _values(data.conditions, data, name)
        if values is not None and np.ptp(values) > (0.0 if name in unnamed else _LEAST_SPAN.get(name, 0.0)):
            out += [_panel(data, checking, name, quantity, base, last) for quantity in quantities]
    return tuple(out)


def _series_views(session: Session, result: TraceResult) -> Views:
    """The same for one pose as a time series: residuals of single samples."""
    from adis_gonio.tracing.series import mg_per_unit, series_columns, series_conditions

    dwell = next(dwell for dwell in session.dwells if len(dwell))
    readings = dwell.accel * mg_per_unit(session, dwell)
    conditions = series_conditions(dwell)
    axes = readings.shape[1]
    blocks = {finding.effect: series_columns(finding, conditions, axes) for finding in result.found}
    after = _series_left(readings, list(blocks.values()))
    steps = []
    for step in result.steps:
        if step.effect not in blocks:
            steps.append(StepView(step.effect, ()))
            continue
        before = _series_left(readings, [block for name, block in blocks.items() if name != step.effect])
        name = (covariates_of(catalogue()[step.effect]) or ("time",))[0]
        x = _series_covariate(conditions, name)
        if step.effect == "thermal_lag":
            name, x = "temperature_lag", blocks[step.effect][0][:, 0]
        steps.append(StepView(step.effect, _series_panels(name, x, before, after), beside_all=True))
    left: list[Panel] = []
    base = _series_left(readings, [])
    for name in ("time", "temperature"):
        left += _series_panels(name, _series_covariate(conditions, name), base, after)
    return Views(tuple(steps), tuple(left))


def _series_left(readings: Floats, blocks: Sequence[Sequence[Floats]]) -> Floats:
    """Readings (n, axes) minus the best constant and columns of each axis, each block (n, d) by axis."""
    left = np.empty_like(readings)
    for axis in range(readings.shape[1]):
        design = np.concatenate([np.ones((len(readings), 1)), *(block[axis] for block in blocks)], axis=1)
        size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        solved = np.linalg.lstsq(design / size, readings[:, axis], rcond=None)[0]
        left[:, axis] = readings[:, axis] - design / size @ solved
    return left


def _series_covariate(conditions: Conditions, name: str) -> Floats:
    if name == "temperature" and conditions.temperature_c is not None:
        return conditions.temperature_c
    if name == "supply" and conditions.supply_v is not None:
        return conditions.supply_v
    return conditions.time_s / 60.0


def _series_panels(name: str, x: Floats, before: Floats, after: Floats) -> tuple[Panel, ...]:
    none = np.zeros(0)
    return tuple(
        Panel(
            name,
            f"residual_{AXES[k]}",
            x,
            before[:, k],
            after[:, k],
            np.full(len(x), np.nan),
            none,
            none,
        )
        for k in range(before.shape[1])
    )


__all__ = ["Panel", "StepView", "Views", "views"]
