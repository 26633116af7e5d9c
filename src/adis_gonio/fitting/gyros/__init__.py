"""Gyros: means of their rates over dwells and turns, and what the part truly turned meanwhile.

Names are imported when first used, so that the package itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "RateIntervals": "intervals",
    "rate_intervals": "intervals",
}

__all__ = [
    "RateIntervals",
    "rate_intervals",
]

if TYPE_CHECKING:
    from adis_gonio.fitting.gyros.intervals import RateIntervals as RateIntervals
    from adis_gonio.fitting.gyros.intervals import rate_intervals as rate_intervals


__getattr__ = lazily(__name__, _HOMES)
