"""Residual → missing effect → corrected model → error before and after.

>>> import adis_gonio
>>> result = adis_gonio.trace(adis_gonio.load_session("session.csv"))  # doctest: +SKIP
>>> [finding.effect for finding in result.found]  # doctest: +SKIP
['bias']

`adis_gonio.tracing.trace.trace` is the function; names here are imported when first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Detectable": "outcome.result",
    "ErrorFigures": "outcome.result",
    "Finding": "outcome.result",
    "Rival": "outcome.result",
    "Step": "outcome.result",
    "TraceResult": "outcome.result",
    "Unnamed": "outcome.result",
    "Value": "outcome.result",
}

__all__ = [
    "Detectable",
    "ErrorFigures",
    "Finding",
    "Rival",
    "Step",
    "TraceResult",
    "Unnamed",
    "Value",
]

if TYPE_CHECKING:
    from adis_gonio.tracing.outcome.result import Detectable as Detectable
    from adis_gonio.tracing.outcome.result import ErrorFigures as ErrorFigures
    from adis_gonio.tracing.outcome.result import Finding as Finding
    from adis_gonio.tracing.outcome.result import Rival as Rival
    from adis_gonio.tracing.outcome.result import Step as Step
    from adis_gonio.tracing.outcome.result import TraceResult as TraceResult
    from adis_gonio.tracing.outcome.result import Unnamed as Unnamed
    from adis_gonio.tracing.outcome.result import Value as Value

__getattr__ = lazily(__name__, _HOMES)
