"""The commands `trace` and `report`: the effects behind the residual of a session, as text or a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option, show

if TYPE_CHECKING:
    from adis_gonio.base.conformity import Tolerance
    from adis_gonio.model.records import Session
    from adis_gonio.record.loading import Overrides
    from adis_gonio.tracing.trace_result import TraceResult


_WHAT_IF = {"What if": "--with --without --only"}


@option.command("trace", "--max-effects --time-limit --json", _WHAT_IF)
@option.sessions
@option.with_default(
    "--max-effects",
    type=click.IntRange(0, 12),
    default=6,
    metavar="N",
    help="Most effects to add to the model.",
)
@option.time_limit(
    "End after this time with the best model so far; effects without validation are not called found."
)
@option.part()
@option.what_if
@option.overrides
@option.json
def trace_command(
    *,
    sessions: Sequence[Path],
    max_effects: int,
    time_limit: float | None,
    part: str,
    as_json: bool,
    overrides: Overrides,
    **what_if: Any,
) -> None:
    """Trace the residual of a session to the effects that the seed paper's model lacks.

    Several sessions of one part, board or stage are traced as one model: gains and misalignments are shared
    by the sessions of one part, and an effect is shared or differs between sessions, parts or stages, by
    evidence. The keys `serial` and `stage` of the files name part and stage; sessions without a key share
    it.

    The command reports each effect found with its probability, the error before and after on data that the
    fit did not use, the effects that this session cannot distinguish or detect, and measurements to make
    next. With --with, --without or --only it compares your model with the best one.
    """
    from adis_gonio.tracing.joint_trace import trace_sessions
    from adis_gonio.tracing.trace import trace

    loaded = [option.load(session, overrides) for session in sessions]
    dwells = counted(sum(len(one.dwells) for one in loaded), "dwell")
    if len(loaded) > 1 and (part != "accelerometer" or any(what_if.values())):
        raise UsageError(
            "several sessions are traced together for the accelerometers only, without --with, --without"
            " and --only: give one session"
        )
    where = sessions[0].name if len(loaded) == 1 else counted(len(loaded), "session")
    result: TraceResult
    with show.report_progress(f"tracing {dwells} of {where}"):
        if len(loaded) == 1:
            result = trace(loaded[0], max_effects=max_effects, time_limit=time_limit, part=part, **what_if)
        else:
            result = trace_sessions(loaded, max_effects=max_effects, time_limit=time_limit)
    if as_json:
        show.print_json(result.as_dict())
    else:
        print_trace(loaded, result)


def print_trace(sessions: Sequence[Session], result: TraceResult) -> None:
    """Show the result of a trace of one or more sessions on the terminal, by sections of the report."""
    from adis_gonio.handover import calibration_report as report
    from adis_gonio.page.document import Section
    from adis_gonio.tracing import trace_summary as summary
    from adis_gonio.tracing.joint_trace import JointResult

    screen = show.console(most=show.WIDTH)
    for session in sessions:
        screen.print(f"{summary.title(session)}: {summary.shape(session)}")
    seen = summary.group_undetected(result)
    smallest = {name: summary.amplitude(entry) for name, entry in result.detectable.items()}
    weak = ", ".join(f"{name} from {smallest[name]}" for name in seen.weak)
    hidden = [f"only if larger than usual: {weak}"] if weak else []
    hidden += [f"{', '.join(names)}: {reason}" for reason, names in seen.blind.items()]
    visible = ", ".join(f"{name} {smallest[name]}" for name in seen.visible)
    notes = dict.fromkeys(note for session in sessions for note in session.notes)
    joint = result if isinstance(result, JointResult) else None
    points = {
        "Belongs to": [] if joint is None else summary.owners(joint),
        "Evidence of each session": [] if joint is None else summary.session_shares(joint),
        "Inside the dwells": summary.within(result),
        "What this session could not have seen": hidden,
        f"{summary.absent(result).capitalize()} (90 % power) from": [visible] if visible else [],
        "What to measure next": summary.advice(result),
        "Remarks": [*notes, *result.notes],
    }
    sections = [*report.what_if_section(result, figures=False), report.summary_section(result)]
    sections += [report.found_section(result), report.errors_section(result)]
    sections += [Section(title, points=texts) for title, texts in points.items()]
    show.print_sections(screen, sections)


# -- the closed loop of `calibrate --trace` ----------------------------------------------------------


def loop_line(summary: Mapping[str, Any]) -> str:
    """Return a line about the model after a round of positions that the trace had proposed.

    Parameters
    ----------
    summary : mapping
        Summary of a trace by `bench.advisor.summarise_trace`.
    """
    state = "adequate" if summary["adequate"] else "not adequate"
    state = f"the model is {state}" if summary["tested"] else "no readings remain to test the model"
    found = ", ".join(summary["found"]) or "–"
    return f"With {counted(summary['dwells'], 'dwell')}: {state}; found: {found}"


def print_loop(session: Session) -> None:
    """Print why no more positions of the trace were measured; nothing if the trace was not asked."""
    from adis_gonio.page.document import Section

    rounds = session.facts.get("advised", [])
    if not rounds:
        return
    ended = rounds[-1]["ended"]
    if not ended:
        declined = len(session.facts["plan"]["positions"]) == rounds[-1]["planned"]
        ended = "further positions were declined" if declined else "not ended: go on with --resume --trace"
    show.print_sections(show.console(most=show.WIDTH), [Section("Closing the loop", words=[ended])])


@option.command("report", "--output --time-limit", {"Conformity": "--tolerance --rule --risk", **_WHAT_IF})
@option.session
@option.output("Page to write.", required=True)
@option.time_limit("End the trace after this time with the best model so far.")
@option.tolerance("State on the certificate if the angle error is within this tolerance.")
@option.what_if
@option.overrides
def report_command(
    *,
    session: Path,
    output: Path,
    time_limit: float | None,
    tolerance: Tolerance | None,
    overrides: Overrides,
    **what_if: Any,
) -> None:
    """Write the calibration report: one self-contained HTML page.

    The first page is a certificate to sign. The annex shows the results of every method that the session
    supports, the trace with a figure for each step, the effects that could not be seen, measurements to
    make next, and the data.
    """
    show.check_page(output)
    loaded = option.load(session, overrides)
    what = "a free turn" if loaded.free_turn else counted(len(loaded.dwells), "dwell")
    with show.report_progress(f"report of {what} of {session.name}"):
        page = _report_page(loaded, time_limit, tolerance, what_if)
    show.write_page(output, page)


def _report_page(
    session: Session, time_limit: float | None, tolerance: Tolerance | None, what_if: Mapping[str, Any]
) -> str:
    """Build the HTML report of a session from all fits, the trace and the digital twin.

    `time_limit` ends the trace after this time in s, None never; `tolerance` adds a statement of
    conformity; `what_if` are the terms and names that the user puts into the model or takes out of it.
    """
    from adis_gonio.base.budget import current, with_progress
    from adis_gonio.fitting.methods import applicable_methods, fit
    from adis_gonio.handover.calibration_report import build_page
    from adis_gonio.handover.digital_twin import twin_section
    from adis_gonio.handover.gyro_report import gyro_section, noise_section
    from adis_gonio.page.document import Section
    from adis_gonio.tracing.trace import trace

    tell = current().tell
    tell("every method")
    fits, failures = [], {}
    for method in with_progress(applicable_methods(session)):
        try:
            fits.append(fit(session, method=method))
        except AdisGonioError as error:
            failures[method] = str(error)
    sections = [one for one in (gyro_section(session), noise_section(session)) if one is not None]
    traced: TraceResult | str
    try:
        traced = trace(session, time_limit=time_limit, **what_if)
    except AdisGonioError as error:
        if any(what_if.values()):
            raise
        traced = str(error)
    else:
        tell("its digital twin")
        title = "The digital twin against the measured data"
        try:
            twin = twin_section(session, traced)
        except AdisGonioError as error:
            twin = Section(title, words=(f"There is none: {error}.",))
        sections += [] if twin is None else [twin]
        tell("its figures")
    return build_page(session, fits, traced, sections, failures, tolerance)
