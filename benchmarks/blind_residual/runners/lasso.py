"""LASSO over the catalogue's columns, penalty by BIC or cross-validation (scikit-learn), then refitted."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from .common import Prepared, tuned


def lasso_bic(directory: Path) -> dict[str, Any]:
    """Penalty by BIC at the noise that is known."""
    from sklearn.linear_model import LassoLarsIC

    prepared = Prepared(directory)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = LassoLarsIC("bic", fit_intercept=False, noise_variance=1.0, max_iter=60).fit(
            prepared.x, prepared.y
        )
    return _refitted(prepared, model.coef_, "lasso_bic")


def lasso_cv(directory: Path) -> dict[str, Any]:
    """Penalty by five folds."""
    from sklearn.linear_model import LassoCV

    prepared = Prepared(directory)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = LassoCV(cv=5, fit_intercept=False, alphas=40, max_iter=3000).fit(prepared.x, prepared.y)
    return _refitted(prepared, model.coef_, "lasso_cv")


def _refitted(prepared: Prepared, coefficients: Any, name: str) -> dict[str, Any]:
    order = np.argsort(-np.abs(coefficients))
    chosen = [int(k) for k in order if coefficients[k] != 0][:12]
    return prepared.answer(prepared.prune(chosen, tuned(name)["gain"]))
