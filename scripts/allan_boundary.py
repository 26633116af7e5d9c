"""Coverage of the profile likelihood of noise at rest in the limit of long records, by its information.

    python scripts/allan_boundary.py --draws 20000 --seed 1

Kinds of noise that a record does not have lie on the boundary of what the fit allows: they may be found
above zero and not below it, and what they take they take from their neighbours. There 2 Δ log L of a
coefficient is not χ² with one degree of freedom. Here estimates are drawn from the normal distribution of
the Fisher information of each case of `allan_statistics.py`, projected on the cone by trying every set of
kinds at zero, and the share within 3.84 is counted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import secrets
import sys

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import NORMAL_95
from adis_gonio.device.sensor.settings import filter_response
from adis_gonio.fitting.allan.spectral_likelihood import KINDS, Likelihood, ordinates
from allan_statistics import CASES, Case

PASSED = 0.01


def information(case: Case) -> tuple[Floats, Floats, list[str]]:
    """Information (k, k) on squared coefficients, their truth (k,), and the kinds that are fitted."""
    kinds = [kind for kind in KINDS if kind != "quantization" or case.filter_m == 0]
    has = [KINDS.index(kind) for kind in kinds]
    truth = np.array([case.truth.get(kind, 0.0) ** 2 for kind in KINDS])
    grid = np.linspace(0.0, 0.5**case.filter_m if case.filter_m else 0.5, 2049)
    data = ordinates(
        np.zeros(case.samples), case.filter_m, case.period_s, np.zeros(1), np.zeros(0, np.intp)
    ).below(float(grid[filter_response(case.filter_m, grid) >= PASSED].max()))
    likelihood = Likelihood(data, [k for k in range(len(KINDS)) if k not in has])
    return likelihood.derivatives(truth)[2][np.ix_(has, has)], truth[has], kinds


def least(metric: Floats, drawn: Floats, low: Floats, fixed: int | None = None) -> Floats:
    """Squared distance (n,) from points (n, k) about the truth to the cone above `low` (k,).

    Parameters
    ----------
    fixed : int, optional
        Coordinate that is held at its truth.
    """
    size = len(low)
    best = np.full(len(drawn), np.inf)
    others = [k for k in range(size) if k != fixed]
    for count in range(len(others) + 1):
        for at_zero in itertools.combinations(others, count):
            held = [*at_zero, *([] if fixed is None else [fixed])]
            free = [k for k in range(size) if k not in held]
            wanted = np.array([0.0 if k == fixed else low[k] for k in held])
            off = np.zeros_like(drawn)
            off[:, held] = wanted - drawn[:, held]
            if free and held:
                pull = np.linalg.solve(metric[np.ix_(free, free)], metric[np.ix_(free, held)])
                off[:, free] = -off[:, held] @ pull.T
            inside = (drawn + off >= low - 1e-9).all(axis=1)
            square = np.einsum("ni,ij,nj->n", off, metric, off)
            best = np.minimum(best, np.where(inside, square, np.inf))
    return best


def coverage(case: Case, draws: int, rng: np.random.Generator) -> dict[str, float]:
    """Share within the interval of 95 % of each kind that the case has."""
    full, truth, kinds = information(case)
    scale = 1 / np.sqrt(np.diag(full))
    metric = full * np.outer(scale, scale)
    low = -truth / scale
    drawn = rng.standard_normal((draws, len(low))) @ np.linalg.cholesky(np.linalg.inv(metric)).T
    whole = least(metric, drawn, low)
    return {
        kind: float(np.mean(least(metric, drawn, low, k) - whole <= NORMAL_95**2))
        for k, kind in enumerate(kinds)
        if truth[k] > 0
    }


def main() -> int:
    """Print the coverage of every case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=20000)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    cases = {name: coverage(case, options.draws, rng) for name, case in CASES.items()}
    print(json.dumps({"seed": options.seed, "draws": options.draws, "cases": cases}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
