"""The page: sections into one self-contained HTML document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from adis_gonio import __version__
from adis_gonio.fitting import FitResult
from adis_gonio.model.records import Session
from adis_gonio.report import sections as make
from adis_gonio.report import words
from adis_gonio.report.parts import Section
from adis_gonio.tracing.outcome.figures import Views
from adis_gonio.tracing.outcome.result import TraceResult


def build_page(
    session: Session,
    fits: Sequence[FitResult],
    traced: TraceResult | str,
    views: Views | None = None,
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
    views : Views, optional
        What the figures show (`adis_gonio.report.views.views`).
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
    body = [make.summary(traced, fits, views), make.fitted(fits, failures or {})]
    if result is not None:
        body += [make.found(result), make.errors(result)]
        if views is not None:
            body += [make.steps(result, views), make.left(views)]
        body += [make.within(result)]
        body += [make.rivals(result), make.sight(result), make.advice(result)]
    body += [*sections, make.data(session, result, software)]
    environment = Environment(
        loader=PackageLoader("adis_gonio.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Figures are the package's own drawings, whose texts are escaped already.
    environment.filters["drawing"] = Markup
    return environment.get_template("page.html").render(
        title=words.title(session),
        shape=words.shape(session),
        simulated=bool(session.facts.get("simulated")),
        begun=str(session.facts.get("started_utc", "")),
        software=software,
        sections=[section for section in body if _filled(section)],
    )


def _filled(section: Section) -> bool:
    return any(
        (section.words, section.points, section.figures, section.tables, section.notes, section.parts)
    )
