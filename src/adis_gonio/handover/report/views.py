"""Figures of a traced session, whatever it is of."""

from __future__ import annotations

from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.model.records import Session
from adis_gonio.tracing.trace_figures import Views, series_views, views_of
from adis_gonio.tracing.trace_result import TraceResult


def views(session: Session, result: TraceResult) -> Views:
    """Residuals of a traced session before and after each step."""
    if not result.fits:
        return series_views(session, result)
    return views_of(readings_of(session), result)
