"""Effects that could each explain what an inadequate model leaves: what this session cannot decide."""

from __future__ import annotations

import math
from collections import defaultdict

from adis_gonio.tracing.selection.design import LinearProblem, span
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits


def undecided(selection: Selection, count: int = 5) -> tuple[str, ...]:
    """Names that, added alone, take a significant part of an inadequate model's residual (F-test at 10 %).

    The noise is then the residual itself, since what was measured within the dwells does not explain it.
    Where one does, others count that are nearly as likely, all variants of a name together and each by its
    share of the prior. The most likely comes first. None of them is claimed.
    """
    from scipy import stats

    problem: LinearProblem = selection.problem
    basis, residual = span(problem, selection.verdict.best)
    chi2 = float(residual @ residual)
    dof = problem.dof - basis.shape[1]
    gains = problem.gains(basis, residual)
    likely: dict[str, float] = defaultdict(float)
    least_p = 1.0
    inside = {problem.terms[k].name for k in selection.verdict.best}
    for k, term in enumerate(problem.terms):
        width = int(problem.width[k])
        if term.name is None or term.name in inside or term.dwell is not None or dof - width < 1:
            continue
        left = max(chi2 - float(gains[k]), 1e-12 * chi2)
        p = float(stats.f.sf(float(gains[k]) / width / (left / (dof - width)), width, dof - width))
        least_p = min(least_p, p)
        price = float(problem.cost[k] + problem.column_price[k])
        likely[term.name] += math.exp(-0.5 * dof * math.log(left / chi2) - price)
    if least_p >= limits.open_level:
        return ()
    most = max(likely.values())
    alike = [name for name, odds in likely.items() if odds * limits.open_alike > most]
    return tuple(sorted(alike, key=lambda name: -likely[name])[:count])
