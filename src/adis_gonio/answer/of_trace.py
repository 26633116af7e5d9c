"""What a traced model says of the angle that it shows, and its uncertainty budget."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.intervals import factor_over
from adis_gonio.estimation.shown import ShownAngle
from adis_gonio.estimation.values import Value
from adis_gonio.fitting.noise import NoiseAssumptions
from adis_gonio.fitting.sources import MODEL, response_of, sources_of
from adis_gonio.fitting.uncertainty_budget import BudgetRow, budget_of
from adis_gonio.model.records import Floats
from adis_gonio.tracing.outcome.result import TraceResult


def shown_angle(traced: TraceResult, error_deg: float) -> Value:
    """An error of the angle with the uncertainty of one shown by the traced model, rms over the dwells."""
    final = traced.fits[-1]
    covariance = _covariance(final)
    if covariance is None:
        return Value(error_deg, None, "deg")
    reading = final.data.covariance.mean(axis=0)
    shown = ShownAngle.at_dwells(final)
    variances = traced.inflation * shown.variances(covariance, reading)
    u = math.sqrt(float(variances.mean()))
    return Value(error_deg, u, "deg", traced.dof, factor_over(variances, traced.dof))


def budgets_of_trace(traced: TraceResult, values: Mapping[str, Value]) -> dict[str, tuple[BudgetRow, ...]]:
    """Budget of `delta_k`, `delta_phi` and `angle` by the traced model.

    What the sources of the readings leave of u is the choice of the model: a residual larger than the
    noise, and other models that are as probable.
    """
    final = traced.fits[-1]
    covariance = _covariance(final)
    if covariance is None or not final.data.planar:
        return {}
    data = final.data
    # Where nothing states the noise, `inflation` is its estimate.
    noise = NoiseAssumptions(scale=math.sqrt(traced.inflation), sigma_rad=data.fixture_rad, dof=traced.dof)
    response = response_of(final, covariance, np.ones(len(covariance)))
    sources = sources_of(data, noise, final, response)
    slopes = {name: (row[None], None) for name, row in _gradients(final).items()}
    shown = ShownAngle.at_dwells(final)
    found = {}
    for name, (gradient, reading) in {**slopes, "angle": (shown.gradient, shown.reading)}.items():
        if name in values and values[name].u is not None:
            found[name] = _completed(budget_of(sources, gradient, reading), values[name])
    return found


def _covariance(fit: Fit) -> Floats | None:
    """Covariance of all parameters of a fit; None where an average stands for some of them."""
    covariance = fit.covariance
    return covariance if len(covariance) == len(fit.values.parameters) else None


def _gradients(fit: Fit) -> dict[str, Floats]:
    base = fit.values.base
    eye = np.eye(len(fit.values.parameters))
    x, y = fit.data.model.index("scale_x"), fit.data.model.index("scale_y")
    return {
        "delta_k": eye[x] / base[y] - eye[y] * base[x] / base[y] ** 2,
        "delta_phi": np.degrees(eye[fit.data.model.index("delta_phi")]),
    }


def _completed(rows: tuple[BudgetRow, ...], value: Value) -> tuple[BudgetRow, ...]:
    """Rows whose contributions add up to u, the rest of it in the choice of the model."""
    total = (value.u or 0.0) ** 2
    known = sum(row.contribution**2 for row in rows if row.source != MODEL)
    rest = math.sqrt(max(total - known, 0.0))
    total = known + rest**2
    done = []
    for row in rows:
        if row.source == MODEL:
            row = replace(
                row,
                kind="A",
                u=None,
                sensitivity=None,
                contribution=rest,
                dof=value.dof,
                note="residual beyond the noise, and other models as probable as this one",
            )
        done.append(replace(row, share=row.contribution**2 / total if total else 0.0))
    return tuple(done)
