"""Effects that could each explain what an inadequate model leaves: what this session cannot decide."""

from __future__ import annotations

import numpy as np

from adis_gonio.tracing.selection.design import LinearProblem, span
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits


def undecided(selection: Selection, count: int = 5) -> tuple[str, ...]:
    """Names that, added alone, take a significant part of an inadequate model's residual (F-test at 10 %).

    The noise is then the residual itself, since what was measured within the dwells does not explain it.
    Where one does, others count that are nearly as likely. The best variant of each
    name counts; the most likely comes first. None of them is claimed.
    """
    from scipy import stats

    problem: LinearProblem = selection.problem
    basis, residual = span(problem, selection.verdict.best)
    chi2 = float(residual @ residual)
    dof = problem.dof - basis.shape[1]
    gains = problem.gains(basis, residual)
    best: dict[str, tuple[float, float]] = {}
    inside = {problem.terms[k].name for k in selection.verdict.best}
    for k, term in enumerate(problem.terms):
        width = int(problem.width[k])
        if term.name is None or term.name in inside or term.dwell is not None or dof - width < 1:
            continue
        left = max(chi2 - float(gains[k]), 1e-12)
        p = float(stats.f.sf(float(gains[k]) / width / (left / (dof - width)), width, dof - width))
        best[term.name] = min(best.get(term.name, (np.inf, np.inf)), (p, left))
    if not best or min(best.values())[0] >= limits.open_level:
        return ()
    least = min(left for _, left in best.values())
    alike = {
        name: p
        for name, (p, left) in best.items()
        if 0.5 * dof * np.log(left / least) < np.log(limits.open_alike)
    }
    return tuple(sorted(alike, key=lambda name: alike[name])[:count])
