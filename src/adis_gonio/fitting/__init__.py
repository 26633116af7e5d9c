"""Estimators and their uncertainty: `fit(session, method)`; no files, no devices.

Names are imported when first used: a guard at the bench needs some modules of this package and no scipy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "fit_result": "FitResult",
    "methods": "METHODS applicable_methods fit fit_readings",
}

if TYPE_CHECKING:
    from adis_gonio.fitting.fit_result import FitResult as FitResult
    from adis_gonio.fitting.methods import (
        METHODS as METHODS,
        applicable_methods as applicable_methods,
        fit as fit,
        fit_readings as fit_readings,
    )

__getattr__ = lazily(__name__, _HOMES)
