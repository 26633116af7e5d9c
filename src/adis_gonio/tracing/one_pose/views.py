"""Figures of one pose as a time series: residuals of single samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects import AXES, Conditions, catalogue
from adis_gonio.model.records import Session
from adis_gonio.tracing.one_pose.series import mg_per_unit, series_columns, series_conditions
from adis_gonio.tracing.outcome.figures import Panel, StepView, Views
from adis_gonio.tracing.outcome.result import TraceResult


def series_views(session: Session, result: TraceResult) -> Views:
    """Residuals of the samples of a traced pose before and after each step."""
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
        name = (catalogue()[step.effect].covariates or ("time",))[0]
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
