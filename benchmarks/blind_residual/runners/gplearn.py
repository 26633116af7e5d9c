"""Symbolic regression of the residual (gplearn); gives covariates of its formula and no names."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .common import Prepared, tuned
from .gaussian_process import bent, covariates, residual


def answer(directory: Path) -> dict[str, Any]:
    """A formula an output; its covariates are claimed where its gain passes the tuned limit."""
    from gplearn.genetic import SymbolicRegressor

    prepared = Prepared(directory, single_dwells=False)
    c = prepared.linear.c
    y = residual(prepared)
    use = ~c.check
    words = covariates(c, prepared.linear.ideal_g)
    label = [w for w, v in words.items() for _ in range(v.shape[1])]
    x = np.hstack(list(words.values()))
    seen: set[str] = set()
    bend = np.zeros_like(y)
    gain = 0.0
    for i in range(y.shape[1]):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = SymbolicRegressor(
                population_size=300,
                generations=8,
                function_set=("add", "sub", "mul", "sin", "abs", "max"),
                parsimony_coefficient=0.02,
                metric="mse",
                random_state=0,
            ).fit(x[use], y[use, i])
        formula = model.predict(x)
        used = sorted({int(k) for k in re.findall(r"X(\d+)", str(model._program))})
        n = int(use.sum())
        better = n * np.log(np.var(y[use, i]) / max(np.mean((y[use, i] - formula[use]) ** 2), 1e-12))
        better -= model._program.length_ * np.log(n) / 2
        if used and better > tuned("gplearn")["gain"]:
            seen |= {label[k] for k in used}
            bend[:, i] = formula
            gain = max(gain, float(better))
    out = prepared.answer([])
    if seen:
        out["covariates"] = sorted(seen)
        out["something"] = float(1 / (1 + np.exp(-np.clip(gain / 2 - np.log(10), -50, 50))))
        out["heldout"] = bent(prepared, bend)
    return out
