"""Residual → missing effect → corrected model → error before and after.

>>> import adis_gonio
>>> result = adis_gonio.trace(adis_gonio.load_session("session.csv"))  # doctest: +SKIP
>>> [finding.effect for finding in result.found]  # doctest: +SKIP
['bias']
"""

from adis_gonio.tracing.outcome.result import (
    Detectable,
    ErrorFigures,
    Finding,
    Rival,
    Step,
    TraceResult,
    Unnamed,
    Value,
)
from adis_gonio.tracing.trace import trace, trace_readings

__all__ = [
    "Detectable",
    "ErrorFigures",
    "Finding",
    "Rival",
    "Step",
    "TraceResult",
    "Unnamed",
    "Value",
    "trace",
    "trace_readings",
]
