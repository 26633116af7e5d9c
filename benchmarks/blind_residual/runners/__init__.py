"""Entrants that come with the benchmark, a module each: `answer(directory) -> dict` (see README.md)."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

RUNNERS = (
    "adis_gonio",
    "lasso_cv",
    "lasso_bic",
    "stepwise",
    "stlsq",
    "knockoffs",
    "susie",
    "gaussian_process",
    "gplearn",
)

SEES_CHECK_READINGS = frozenset({"adis_gonio"})
"""Runners that get the check dwells' readings, since they state `heldout_rms_mg` themselves."""


def runner(name: str) -> Callable[[Path], dict[str, Any]]:
    """The function of a runner by its name."""
    module = {"lasso_cv": "lasso", "lasso_bic": "lasso"}.get(name, name)
    function: Callable[[Path], dict[str, Any]] = getattr(
        import_module(f"{__name__}.{module}"), name if name != module else "answer"
    )
    return function
