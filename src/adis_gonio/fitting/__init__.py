"""Estimators and their uncertainty: `fit(session, method)`; no files, no devices.

Names are imported when first used: a guard at the bench needs some modules of this package and no scipy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "METHODS": "methods",
    "Estimate": "fit_result",
    "FitResult": "fit_result",
    "applicable_methods": "methods",
    "fit": "methods",
    "fit_readings": "methods",
}

if TYPE_CHECKING:
    from adis_gonio.fitting.fit_result import Estimate as Estimate
    from adis_gonio.fitting.fit_result import FitResult as FitResult
    from adis_gonio.fitting.methods import METHODS as METHODS
    from adis_gonio.fitting.methods import applicable_methods as applicable_methods
    from adis_gonio.fitting.methods import fit as fit
    from adis_gonio.fitting.methods import fit_readings as fit_readings

__getattr__ = lazily(__name__, _HOMES)
