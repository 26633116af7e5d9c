"""Sequentially thresholded least squares (pysindy's STLSQ) over the catalogue's columns."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .common import Prepared, tuned


def answer(directory: Path) -> dict[str, Any]:
    """Columns of length 1 and noise of 1: a coefficient's threshold is in standard uncertainties."""
    from pysindy import STLSQ

    prepared = Prepared(directory, single_dwells=False)
    setting = tuned("stlsq")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = STLSQ(threshold=setting["threshold"], alpha=0.1).fit(prepared.x, prepared.y[:, None])
    coefficients = np.ravel(model.coef_)
    chosen = [int(k) for k in np.argsort(-np.abs(coefficients)) if coefficients[k] != 0][:12]
    return prepared.answer(prepared.prune(chosen, setting["gain"]))
