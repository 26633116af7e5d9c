"""Effects that could each explain what an inadequate model leaves: what this session cannot decide."""

from __future__ import annotations

import numpy as np

from adis_gonio.tracing.design import Problem, span
from adis_gonio.tracing.selection import Selection

LEVEL = 0.1
ALIKE = 2.0
"""Ratio of p-values up to which another name is as likely as the best one."""


def undecided(selection: Selection, count: int = 5) -> tuple[str, ...]:
    """Names that, added alone, take a significant part of an inadequate model's residual (F-test at 10 %).

    The noise is then the residual itself, since what was measured within the dwells does not explain it.
    The best variant of each name counts; the most likely comes first, with all that are about as likely.
    None of them is claimed.
    """
    from scipy import stats

    problem: Problem = selection.problem
    basis, residual = span(problem, selection.verdict.best)
    chi2 = float(residual @ residual)
    dof = problem.dof - basis.shape[1]
    gains = problem.gains(basis, residual)
    best: dict[str, float] = {}
    inside = {problem.terms[k].name for k in selection.verdict.best}
    for k, term in enumerate(problem.terms):
        width = int(problem.width[k])
        if term.name is None or term.name in inside or "(dwell=" in term.label or dof - width < 1:
            continue
        left = max(chi2 - float(gains[k]), 1e-12)
        p = float(stats.f.sf(float(gains[k]) / width / (left / (dof - width)), width, dof - width))
        best[term.name] = min(best.get(term.name, np.inf), p)
    if not best or min(best.values()) >= LEVEL:
        return ()
    likely = {name: p for name, p in best.items() if p < max(LEVEL, ALIKE * min(best.values()))}
    return tuple(sorted(likely, key=lambda name: likely[name])[:count])
