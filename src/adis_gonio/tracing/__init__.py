"""Residual → missing effect → corrected model → error before and after.

>>> import adis_gonio
>>> result = adis_gonio.trace(adis_gonio.load_session("session.csv"))  # doctest: +SKIP
>>> [finding.effect for finding in result.found]  # doctest: +SKIP
['bias']

`adis_gonio.tracing.trace.trace` is the function; names here are imported when first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base.lazy_names import lazily

_HOMES = {
    "Detectable": "trace_result",
    "ErrorFigures": "trace_result",
    "Finding": "trace_result",
    "Rival": "trace_result",
    "Step": "trace_result",
    "TraceResult": "trace_result",
    "Unnamed": "trace_result",
    "Value": "trace_result",
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
    from adis_gonio.tracing.trace_result import Detectable as Detectable
    from adis_gonio.tracing.trace_result import ErrorFigures as ErrorFigures
    from adis_gonio.tracing.trace_result import Finding as Finding
    from adis_gonio.tracing.trace_result import Rival as Rival
    from adis_gonio.tracing.trace_result import Step as Step
    from adis_gonio.tracing.trace_result import TraceResult as TraceResult
    from adis_gonio.tracing.trace_result import Unnamed as Unnamed
    from adis_gonio.tracing.trace_result import Value as Value

__getattr__ = lazily(__name__, _HOMES)
