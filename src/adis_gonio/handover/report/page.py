"""The page: sections into one self-contained HTML document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from adis_gonio.base.version import __version__
from adis_gonio.fitting import FitResult
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.slips import PositionFinding
from adis_gonio.handover.report import sections as make
from adis_gonio.model.records import Session
from adis_gonio.page.parts import Section
from adis_gonio.page.render import render
from adis_gonio.tracing import trace_summary as words
from adis_gonio.tracing.trace_figures import Views, series_views, views_of
from adis_gonio.tracing.trace_result import TraceResult
from adis_gonio.tracing.traced_answer import answer_with_trace


def views(session: Session, result: TraceResult) -> Views:
    """Residuals of a traced session before and after each step, whatever it is of."""
    if not result.fits:
        return series_views(session, result)
    return views_of(readings_of(session), result)


def build_page(
    session: Session,
    fits: Sequence[FitResult],
    traced: TraceResult | str,
    shown: Views | None = None,
    sections: Sequence[Section] = (),
    failures: Mapping[str, str] | None = None,
) -> str:
    """The calibration report as HTML.

    Parameters
    ----------
    session : Session
    fits : sequence of FitResult
        One a method, the best last.
    traced : TraceResult or str
        The trace, or why there is none.
    shown : Views, optional
        What the figures show (`views`).
    sections : sequence of Section
        Further sections, put before data and configuration.
    failures : mapping of str to str, optional
        Reason of each method that failed.

    Returns
    -------
    str
        One page that loads nothing; whatever came from a file is escaped.
    """
    software = f"adis-gonio {__version__}"
    result = traced if isinstance(traced, TraceResult) else None
    best = next((fit for fit in reversed(fits) if fit.comparison is not None), None)
    given = None if best is None else answer_with_trace(best, result, own=False)
    body = [make.answer(given)] if given is not None else []
    body += [make.summary(traced, fits, shown)]
    body += make.positions(result.position_findings if result is not None else _of_fits(fits))
    if given is not None:
        body += [make.budget(given), make.scores(given)]
    body += [make.fitted(fits, failures or {})]
    if result is not None:
        body += [make.found(result), make.errors(result)]
        if shown is not None:
            body += [make.steps(result, shown), make.left(shown)]
        body += [make.within(result)]
        body += [make.rivals(result), make.sight(result), make.advice(result)]
    reference_c = None if given is None else given.reference_temperature_c
    if reference_c is None and result is not None:
        reference_c = result.reference_temperature_c
    body += [*sections, make.data(session, result, software, reference_c)]
    return render(
        "Calibration report",
        words.title(session),
        shape=" · ".join([words.shape(session), *map(" ".join, words.written_down(session).items())]),
        simulated=bool(session.facts.get("simulated")),
        begun=str(session.facts.get("started_utc", "")),
        software=software,
        sections=body,
        closing="This page is made from the session's file alone and can be made again from it.",
    )


def _of_fits(fits: Sequence[FitResult]) -> tuple[PositionFinding, ...]:
    return next((fit.position_findings for fit in fits if fit.position_findings), ())
