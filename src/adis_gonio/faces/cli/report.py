"""`adis-gonio report`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import check_page, working, write_page

if TYPE_CHECKING:
    from adis_gonio.model import Session
    from adis_gonio.page.parts import Section
    from adis_gonio.record.loading import Overrides
    from adis_gonio.tracing.trace_result import TraceResult


@click.command("report")
@option.session
@option.output("Where to write the page; a page that is there is replaced.", required=True)
@option.time_limit("End the trace after so long with the best model so far.")
@option.overrides
def command(*, session: Path, output: Path, time_limit: float | None, overrides: Overrides) -> None:
    """Write the calibration report: one HTML page that needs nothing else.

    The page holds the results of every method that the session supports, the trace with a figure for each
    step, what could not be seen, what to measure next, and the data. It is made from the session's file
    alone, so that an older page of the same name is replaced.
    """
    from adis_gonio.base.errors import UsageError

    if output.exists() and session.exists() and output.samefile(session):
        raise UsageError(f"{output}: is the session itself; name another file for the page")
    check_page(output)
    loaded = option.load(session, overrides)
    what = "a free turn" if loaded.free_turn else counted(len(loaded.dwells), "dwell")
    with working(f"report of {what} of {session.name}"):
        page = _page(loaded, time_limit)
    write_page(output, page)


def _page(session: Session, time_limit: float | None) -> str:
    """Every result on one page."""
    from adis_gonio.base.budget import current, told
    from adis_gonio.base.errors import AdisGonioError
    from adis_gonio.fitting import applicable_methods, fit
    from adis_gonio.handover.calibration_report import build_page, views
    from adis_gonio.handover.gyro_report import gyro_section, noise_section
    from adis_gonio.tracing.trace import trace

    tell = current().tell
    tell("every method")
    fits, failures = [], {}
    for method in told(applicable_methods(session)):
        try:
            fits.append(fit(session, method=method))
        except AdisGonioError as error:
            failures[method] = str(error)
    made = (gyro_section(session), noise_section(session))
    gyros = [section for section in made if section is not None]
    try:
        traced = trace(session, time_limit=time_limit)
        drawn = views(session, traced)
    except AdisGonioError as error:
        return build_page(session, fits, str(error), sections=gyros, failures=failures)
    tell("its digital twin")
    twin = _twin(session, traced)
    tell("its figures")
    return build_page(session, fits, traced, drawn, sections=[*gyros, *twin], failures=failures)


def _twin(session: Session, traced: TraceResult) -> list[Section]:
    """The twin's section, where the session can have one."""
    from adis_gonio.base.errors import AdisGonioError
    from adis_gonio.handover.twin_comparison import twin_section
    from adis_gonio.page.parts import Section

    try:
        section = twin_section(session, traced)
    except AdisGonioError as error:
        return [Section("The digital twin against the measured data", words=(f"There is none: {error}.",))]
    return [] if section is None else [section]
