"""`adis-gonio report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.cli.overrides import load, override_options
from adis_gonio.cli.trace import working
from adis_gonio.counting import counted

if TYPE_CHECKING:
    from adis_gonio.model import Session
    from adis_gonio.report.parts import Section
    from adis_gonio.session.overrides import Overrides
    from adis_gonio.tracing import TraceResult


def _twin(session: Session, traced: TraceResult) -> list[Section]:
    """The twin's section, where the session can have one."""
    from adis_gonio.errors import AdisGonioError
    from adis_gonio.report.parts import Section
    from adis_gonio.report.twin import twin_section

    try:
        section = twin_section(session, traced)
    except AdisGonioError as error:
        return [Section("The digital twin against the measured data", words=(f"There is none: {error}.",))]
    return [] if section is None else [section]


@click.command("report")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="Where to write the page; a page that is there is replaced.",
)
@click.option(
    "--time-limit",
    type=click.FloatRange(min=0, min_open=True),
    metavar="SECONDS",
    help="End the trace after so long with the best model so far.",
)
@override_options
def command(*, session: Path, output: Path, time_limit: float | None, overrides: Overrides) -> None:
    """Write the calibration report: one HTML page that needs nothing else.

    The page holds the results of every method that the session supports, the trace with a figure for each
    step, what could not be seen, what to measure next, and the data. It is made from the session's file
    alone, so that an older page of the same name is replaced.
    """
    from adis_gonio.report.svg import require_matplotlib

    require_matplotlib()
    from adis_gonio.errors import AdisGonioError, UsageError
    from adis_gonio.fitting import applicable_methods, fit
    from adis_gonio.report.page import build_page
    from adis_gonio.report.views import views
    from adis_gonio.tracing import trace

    if output.exists() and session.exists() and output.samefile(session):
        raise UsageError(f"{output}: is the session itself; name another file for the page")
    loaded = load(session, overrides)
    with working(f"tracing {counted(len(loaded.dwells), 'dwell')} of {session.name}"):
        fits, failures = [], {}
        for method in applicable_methods(loaded):
            try:
                fits.append(fit(loaded, method=method))
            except AdisGonioError as error:
                failures[method] = str(error)
        drawn = None
        try:
            traced = trace(loaded, time_limit=time_limit)
            drawn = views(loaded, traced)
        except AdisGonioError as error:
            page = build_page(loaded, fits, str(error), failures=failures)
        else:
            page = build_page(
                loaded, fits, traced, drawn, sections=_twin(loaded, traced), failures=failures
            )
    output.write_text(page, encoding="utf-8")
    click.echo(f"{output}: {len(page.encode()) // 1024 + 1} kB", err=True)
