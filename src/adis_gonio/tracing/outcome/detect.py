"""Detectability: the smallest amplitude of every effect that this session would have shown."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.uncertainty import Detectable
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.selection.design import LinearProblem, span
from adis_gonio.tracing.selection.search import Model, Search

_POWER_90 = 1.2815515655446004
"""Quantile of the normal distribution at 90 %."""


def detectable(
    found: Search, model: Model, missing: dict[str, str], part: str = "accelerometer"
) -> dict[str, Detectable]:
    """Smallest amplitude with 90 % power at the level of the search, beside the model that was found.

    One column c of an effect, projected off base and model, has score z ~ N(|c| a, 1); it is added where
    z² > 2 × its price, hence a = (√(2 price) + 1.28)/|c|. Of several axes, the worst; of several shapes or
    dwells, the median.
    """
    problem = found.problem
    out = {name: Detectable(None, "", "", reason) for name, reason in missing.items()}
    inside = {problem.terms[k].name for k in model}
    basis_of: dict[str | None, np.ndarray] = {}
    figures: dict[str, dict[str, list[float]]] = {}
    units: dict[str, dict[str, str]] = {}
    for k, term in enumerate(problem.terms):
        if not isinstance(term, NamedTerm) or len(term.effect.axes) > 1:
            continue
        name = term.effect.name
        key = name if name in inside else None
        if key not in basis_of:
            others = [m for m in model if key is None or problem.terms[m].name != key]
            basis_of[key] = span(problem, others)[0]
        basis = basis_of[key]
        lengths = _lengths(problem, k, basis)
        reach = np.sqrt(2 * max(float(found.prices[k]), 0.5) * found.inflation) + _POWER_90 * np.sqrt(
            found.inflation
        )
        parameters = [term.effect.parameters[i] for i in term.amplitudes]
        for parameter, length in zip(parameters, lengths, strict=True):
            figure = reach / length if length > 0 else np.inf
            figures.setdefault(name, {}).setdefault(parameter.name, []).append(float(figure))
            units.setdefault(name, {})[parameter.name] = parameter.unit
    for name, by_parameter in figures.items():
        median = {p: float(np.median(values)) for p, values in by_parameter.items()}
        worst = max(median, key=lambda p: median[p])
        if np.isfinite(median[worst]):
            out[name] = Detectable(median[worst], units[name][worst], worst)
        else:
            out[name] = Detectable(None, units[name][worst], worst, "lies in what is fitted already")
    for name in catalogue(part):
        if name not in out:
            out[name] = Detectable(None, "", "", "lies in the base model: this session cannot show it")
    return out


def _lengths(problem: LinearProblem, term: int, basis: np.ndarray) -> list[float]:
    """Length of each amplitude's own column, whitened and projected off base and model."""
    # Columns by amplitudes = block · back⁺, with `back` from block coefficients to amplitudes.
    back = problem.back[term]
    columns = problem.block(term) @ (1 / back if back.size == 1 else np.linalg.pinv(back))
    columns = columns - basis @ (basis.T @ columns)
    return [float(x) if x > 1e-9 else 0.0 for x in np.linalg.norm(columns, axis=0)]
