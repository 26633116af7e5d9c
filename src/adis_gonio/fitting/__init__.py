"""Estimators and their uncertainty: `fit(session, method)`; no files, no devices.

Names are imported when first used: a guard at the bench needs some modules of this package and no scipy.
"""

from adis_gonio.base import lazily

_HOMES = {
    "fit_result": "FitResult",
    "methods": "METHODS applicable_methods fit fit_readings",
}

__getattr__ = lazily(__name__, _HOMES)
