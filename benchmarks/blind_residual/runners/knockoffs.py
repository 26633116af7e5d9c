"""Knockoffs (knockpy): second-order knockoffs of the catalogue's columns, LASSO statistic.

The columns are no draws of a distribution, so that the promise of the false discovery rate holds only
roughly here.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .common import Prepared, tuned


def answer(directory: Path) -> dict[str, Any]:
    """Features that the filter keeps at the tuned rate."""
    setting = tuned("knockoffs")
    prepared = Prepared(directory, single_dwells=False)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        from knockpy.knockoff_filter import KnockoffFilter

        state = np.random.get_state()  # noqa: NPY002 - knockpy draws from numpy's global state
        np.random.seed(0)  # noqa: NPY002
        try:
            rows = np.sqrt(len(prepared.y))
            kept = KnockoffFilter(
                "lasso", "gaussian", knockoff_kwargs={"method": "equicorrelated"}
            ).forward(prepared.x * rows, prepared.y, fdr=setting["fdr"])
        finally:
            np.random.set_state(state)  # noqa: NPY002
    chosen = [int(k) for k in np.flatnonzero(kept)]
    chosen.sort(key=lambda k: -abs(float(prepared.x[:, k] @ prepared.y)))
    return prepared.answer(prepared.prune(chosen[:12], setting["gain"]))
