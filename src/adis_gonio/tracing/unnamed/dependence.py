"""Beyond the grammar: what the residual of an inadequate model depends on, by permutation."""

from __future__ import annotations

import itertools

import numpy as np

from adis_gonio.estimation.readings import Readings
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Floats
from adis_gonio.tracing.outcome.result import Unnamed
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits


def dependence(selection: Selection) -> Unnamed | None:
    """Covariates on which the residual depends, or None.

    Statistic: Σ_ij k(u_i, u_j) r_i·r_j over pairs of different dwells, r the whitened residuals and k a
    Gaussian kernel in the covariate (two of them for a pair), which is large where dwells of like covariate
    have like residuals; its distribution is that of the dwells permuted. Bonferroni over the covariates.
    """
    data = selection.data
    _, residual = span(selection.problem, selection.verdict.best)
    rows = residual.reshape(len(data), -1)
    rng = np.random.default_rng(20)
    covariates = _covariates(data)
    if len(data) < limits.least_choice or not covariates:
        return None
    candidates: dict[tuple[str, ...], Floats] = {(name,): _kernel(u) for name, u in covariates.items()}
    for (one, u), (two, v) in itertools.combinations(covariates.items(), 2):
        candidates[(one, two)] = _kernel(u) * _kernel(v)
    orders = np.array([rng.permutation(len(data)) for _ in range(limits.permutations)])
    like = rows @ rows.T
    scores = {}
    for names, kernel in candidates.items():
        seen = float((kernel * like).sum())
        null = np.array([(kernel * like[np.ix_(o, o)]).sum() for o in orders])
        spread = float(null.std()) or 1.0
        scores[names] = ((seen - null.mean()) / spread, float((null >= seen).mean()))
    # A pair is believed only where it does better than each alone by what tells a value from zero.
    best = max(scores, key=lambda names: scores[names][0] - limits.told * (len(names) - 1))
    z, p = scores[best]
    p = max(p, 1 / limits.permutations)
    if z < limits.dependence_z or p > 1 / limits.permutations:
        return None
    smooth = _kernel_share(candidates[best], rows)
    return Unnamed(
        covariates=best,
        form=f"a smooth function of {' and '.join(best)} (no formula of the grammar fits)",
        explains=smooth,
        probability=None,
        p_value=min(1.0, p * len(candidates)),
    )


def _covariates(data: Readings) -> dict[str, Floats]:
    c = data.conditions
    out: dict[str, Floats] = {"time": c.time_s[:, None]}
    if c.temperature_c is not None:
        out["temperature"] = c.temperature_c[:, None]
    if c.supply_v is not None:
        out["supply"] = c.supply_v[:, None]
    if c.approach is not None:
        out["approach"] = c.approach[:, None]
    if c.angle_rad is not None:
        out["angle"] = np.column_stack([np.cos(c.angle_rad), np.sin(c.angle_rad)])
    if c.previous_angle_rad is not None:
        out["previous_angle"] = np.column_stack(
            [np.cos(c.previous_angle_rad), np.sin(c.previous_angle_rad)]
        )
    if c.angle_rad is None and "reading" in data.model.driven_by:
        for k, letter in enumerate(AXES[: data.axes]):
            out[f"reading_{letter}"] = data.mean[:, k : k + 1]
    for name, rows in (("force", c.force_g), ("rotation", c.rate_dps)):
        if name in data.model.driven_by and rows is not None:
            out[name] = rows
    return {name: u for name, u in out.items() if np.ptp(u, axis=0).max() > 0}


def _kernel(u: Floats) -> Floats:
    scaled = u / max(float(u.std(axis=0).max()), 1e-12)
    squared = ((scaled[:, None, :] - scaled[None, :, :]) ** 2).sum(axis=2)
    kernel: Floats = np.exp(-squared / (2 * 0.4**2))
    return kernel


def _kernel_share(kernel: Floats, rows: Floats) -> float:
    """Fraction of the residual's χ² beyond its noise that a smoother of this kernel takes."""
    smooth = kernel @ np.linalg.solve(kernel + np.eye(len(kernel)), rows)
    total = float((rows**2).sum()) - rows.size
    return float(np.clip(1 - ((rows - smooth) ** 2).sum() / max(total, 1e-12), 0, 1))
