"""Cycles a turn of the stage that a session cannot tell from those that were found.

At N equally spaced angles n, N − n, N + n, … cycles are one column: only the fewest is a candidate, and
the others are named here. At other angles each is a candidate of its own, and the scores tell.
"""

from __future__ import annotations

import numpy as np

from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects.stage_terms import StagePeriodic, alike
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits

MOST_NAMED = 5


def cycles_alike(selection: Selection) -> list[tuple[int, tuple[int, ...]]]:
    """Cycles of each `stage_periodic` of the model, and the numbers that may as well be, fewest first."""
    problem, best = selection.problem, selection.verdict.best
    angle = selection.data.conditions.angle_rad
    periodic = {
        k: term.effect.cycles
        for k, term in enumerate(problem.terms)
        if isinstance(term, NamedTerm) and isinstance(term.effect, StagePeriodic)
    }
    out = []
    for own in [k for k in best if k in periodic]:
        assert angle is not None
        basis, residual = span(problem, [k for k in best if k != own])
        score = 0.5 * problem.gains(basis, residual) / selection.inflation - selection.found.prices
        weight = np.exp([score[k] - score[own] for k in periodic])
        likely = weight >= (1 - limits.set_level) * weight.sum()
        cycles = {n for n, shown in zip(periodic.values(), likely, strict=True) if shown}
        cycles |= {
            n for n in range(periodic[own], limits.most_cycles + 1) if alike(n, periodic[own], angle)
        }
        others = sorted(cycles - {periodic[own]})
        if others:
            out.append((periodic[own], tuple(others[:MOST_NAMED])))
    return out
