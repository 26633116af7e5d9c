"""The command `calibrate`: the bench session, by the screen or by plain prompts."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import check_output
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import WIDTH, console, opened, print_json, report_progress, say
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

if TYPE_CHECKING:
    from adis_gonio.bench.advisor import TraceAdvisor
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.model.records import Session
    from adis_gonio.record.plans import Plan
    from adis_gonio.record.source import SampleSource
    from adis_gonio.tracing.trace_result import TraceResult

_METADATA = {
    "operator": "operator, who measures",
    "serial": "serial number of the part",
    "stage": "stage or fixture",
}
_PLAN_OPTIONS = {
    "free-turn": {"duration_s", "turns"},
    "gyro-turns": {"positions", "turns"},
}
"""Options of the plans without declared angles; the other plans take `_POSITION_OPTIONS`."""
_POSITION_OPTIONS = {"positions", "check", "extend", "closing"}


@option.command(
    "calibrate",
    "--output --plan --resume",
    {
        "Plan": "--positions --check --duration --turns --auto --extend --trace --max-extra",
        "Measuring": "--dwell --settle --rate --filter --range --record-turns --poll",
        "Place and fixture": "--gravity --fixture",
        "Record": "--title --note --operator --serial --stage --laboratory --customer",
    },
)
@option.url
@option.file("--output", "-o", help="Session file to write.", required=True)
@option.flag("--force", help="Begin a new session; an existing one gets another name.")
@click.option(
    "--plan", "plan_name",
    help="two-position (default), four-position, mmpm, tumble, poses, free-turn, gyro-turns, or a file.",
)  # fmt: skip
@option.positions
@option.check
@click.option(
    "--duration", "duration_s", type=click.FloatRange(min=15, max=600), metavar="SECONDS",
    help="With --plan free-turn: longest recording in s (default 60).",
)  # fmt: skip
@click.option(
    "--turns", type=int, metavar="N",
    help="With --plan free-turn: number of full turns (default 2); with gyro-turns: in each direction"
    " (default 5).",
)  # fmt: skip
@option.flag("--auto", help="Move the stage by program and answer all prompts (simulator).")
@option.flag("--extend", help="With --auto: extend two positions to four.")
@option.flag(
    "--trace", "closing",
    help="Then trace the session, and measure the positions that decide open questions.",
)  # fmt: skip
@click.option(
    "--max-extra", type=click.IntRange(0, 1000), metavar="N",
    help="With --trace: most positions beyond the plan (default 24).",
)  # fmt: skip
@option.flag("--resume", help="Continue the session in the file.")
@option.dwell()
@option.settle
@option.rate
@option.filter
@option.with_default(
    "--range", "range_dps", type=int, default=300, metavar="DPS",
    help="Range of the gyros: 300, 150 or 75 °/s.",
)  # fmt: skip
@click.option(
    "--record-turns/--no-record-turns", "record_turns", default=None,
    help="Record the moves between dwells, which calibrate the gyros: at most 2.4 MB each (default: yes;"
    " for gyro-turns only the whole turns).",
)  # fmt: skip
@option.poll
@option.gravity()
@option.fixture(
    type=option.parse_stage,
    metavar="DEGREES|dcc:FILE",
    help="Standard uncertainty of a stage angle in degrees; dcc:stage.xml: the stage's certificate.",
)
@option.title
@click.option("--note", default="", help="Note to keep with the session.")
@click.option("--operator", help="Operator; a terminal asks for it.")
@click.option("--serial", help="Serial number of the part; a terminal asks for it.")
@click.option("--stage", help="Stage or fixture in your own words; a terminal asks for it.")
@click.option("--laboratory", default="", help="Laboratory, for the certificate.")
@click.option("--customer", default="", help="Customer, for the certificate.")
@option.flag("--plain", help="Prompt in plain lines, for logs and simple terminals.")
@option.variant
@option.no_check
@option.json
def calibrate_command(
    *,
    url: str,
    output: Path,
    force: bool,
    resume: bool,
    as_json: bool,
    closing: bool,
    plain: bool,
    max_extra: int | None,
    **options: Any,
) -> int:
    """Calibrate a sensor on a stage, position by position, and compute ΔK and Δφ.

    Every sample goes into the session file as it is taken. The file survives a kill at any moment; --resume
    continues with the missing positions. Ctrl-C ends the session and keeps all its data.

    Each position is checked when the part comes to rest: the part was not moved, it was turned the wrong
    way or about another axis, or the angle is off by more than part and fixture explain. If you keep such a
    dwell, the exit status is 1.

    Scans start at the sensor's data-ready edges if the line is wired and the bridge can use it; otherwise,
    or with --poll, they are polled.

    A terminal of at least 80 × 24 shows the session on a screen with the live angle (extra: bench); for a
    plan of turns, with --plain, in a log or on a smaller terminal the prompts are lines.

    --plan free-turn records slow continuous turns between two rests, without declared angles: two in a
    minute, in one direction or forth and back; or --turns N.

    --plan gyro-turns calibrates the gyros on a level table: whole turns in both directions, from a mark
    back to it, with the X, the Y and the Z arrow up (with an arrow down the part only rests; --positions 3
    omits that).

    With --trace, the session then lists the further positions that would decide open questions, and
    measures them until the model is adequate or no position is expected to show more.
    """
    from adis_gonio.bench.advisor import MOST_EXTRA, TraceAdvisor
    from adis_gonio.record.archive import ArchiveView, set_aside
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.plans import GYRO_TURNS, extension
    from adis_gonio.record.source import refuse_chip_options

    option.check_session_name(output)
    cure = "--resume goes on with it, --force keeps it under another name"
    check_output(output, force=force or resume, cure=cure)
    if output.exists() and not resume:
        say(f"{output}: renamed to {set_aside(output)}")
    if resume and not output.exists():
        raise SessionError(f"{output}: no such session to resume")
    option.refuse(() if closing else ("max_extra",), "limits the positions that --trace adds")
    refuse_chip_options(
        url, option.given_flags("rate_hz", "filter_m", "range_dps", "poll", "variant", "no_check")
    )
    advisor = TraceAdvisor(MOST_EXTRA if max_extra is None else max_extra) if closing else None
    complete = on_screen = False
    if resume:
        with ArchiveView(output) as view:
            _refuse_another_plan(view.header.plan, output, options)
            done = not view.pending() and extension(view.plan(), len(view.dwells())) is None
        complete = done and not closing
    if complete:
        say(f"{output}: complete, nothing is left to do")
    else:
        complete, on_screen = _run(url, output, plain=plain, resume=resume, advisor=advisor, **options)
    session = load_session(output)
    if session.facts["plan"]["name"] == GYRO_TURNS:
        from adis_gonio.faces.cli.fit_commands import show_gyro_fit

        show_gyro_fit(session, None, as_json=as_json)
    else:
        _show_result(session, advisor, complete=complete, as_json=as_json, brief=on_screen)
    if not as_json:
        click.echo(f"session: {session.source}")
    return _status(session, complete=complete)


def _run(
    url: str, output: Path, *, plain: bool, resume: bool, advisor: TraceAdvisor | None, **options: Any
) -> tuple[bool, bool]:
    """Run the session on the screen or by plain prompts.

    Returns True if the session is complete, and True if it was on the screen.

    `output` is the session file. `resume` is True for the session of an earlier run; `advisor` is None
    without a trace. `options` are further options of the command.
    """
    from adis_gonio.faces.cli.line_prompts import PlainBench, can_show_screen
    from adis_gonio.faces.free_hands import FREE_RATE_HZ, free_hands
    from adis_gonio.record.source import open_source

    resume_by = shlex.join(["adis-gonio", "calibrate", url, "--resume", "-o", str(output)])
    with (
        free_hands(url) as (port, hands),
        opened(open_source, port, variant=options["variant"], check=not options["no_check"]) as sensor,
    ):
        if hands is not None:
            sensor.url = url  # the port of the simulated board is no name to keep
            if options["rate_hz"] is None and not resume:
                options["rate_hz"] = FREE_RATE_HZ
        runner = _runner(sensor, output, options, resume=resume, advisor=advisor)
        plain = plain or options["auto"] or not runner.judges_places  # the screen shows positions
        on_screen, complete = not plain and can_show_screen(), False
        try:
            if on_screen:
                from adis_gonio.faces.tui.bench_screen import run_screen

                complete = run_screen(runner, resume_by, hands)
            else:
                complete = PlainBench(runner, auto=options["auto"], hands=hands).run()
        finally:  # also if the device is lost
            if not complete:
                click.echo(f"recorded data are kept; go on with {resume_by}", err=True)
        return complete, on_screen


def _show_result(
    session: Session, advisor: TraceAdvisor | None, *, complete: bool, as_json: bool, brief: bool
) -> None:
    """Show the fit of a session, and its trace if requested.

    The trace is requested if `advisor` is not None. `complete` is True if all positions were measured;
    `as_json` prints a JSON document instead of text; `brief` prints the answer only, because a terminal of
    24 lines follows a session on the screen.
    """
    from adis_gonio.faces.cli.fit_commands import print_answer
    from adis_gonio.faces.cli.trace_commands import print_loop, print_trace
    from adis_gonio.fitting.methods import fit
    from adis_gonio.tracing.traced_answer import answer_with_trace

    truth = session.facts.get("truth")
    traced = _trace(session, advisor) if advisor is not None else None
    answer = answer_with_trace(fit(session), traced)
    if as_json:
        document = answer.as_dict()
        document |= {"session": session.source, "complete": complete, "truth": truth}
        document["doubts"] = session.facts["doubts"]
        if traced is not None:
            document |= {"trace": traced.as_dict(), "rounds": session.facts["advised"]}
        print_json(document)
        return
    if brief:
        click.echo(answer.text(min(console().width, WIDTH)))
        more = ["fit", *(["trace"] if traced is not None else []), "report"]
        click.echo(f"more: adis-gonio {' | '.join(more)} {shlex.quote(str(session.source))}")
        return
    print_answer(answer, truth)
    if traced is not None:
        click.echo()
        print_trace([session], traced)
        print_loop(session)


def _status(session: Session, *, complete: bool) -> int:
    """Return the exit status; report dwells that the operator kept although a guard (check) objected.

    The status is 0 if the session is complete without doubts, otherwise 1.
    """
    doubts = session.facts["doubts"]
    for doubt in doubts:
        sure = "cannot" if doubt["attempt"] is not None else "may not"
        say(f"the result {sure} be right: {doubt['message']}")
    if doubts:
        say(f"the data stay in {session.source}: measure again")
    return 0 if complete and not doubts else 1


def _trace(session: Session, advisor: TraceAdvisor) -> TraceResult | None:
    """Return the advisor's last trace if it covered all dwells, else trace again.

    Return None if no trace is possible.
    """
    from adis_gonio.tracing.trace import trace

    if advisor.result is not None and advisor.dwells == len(session.dwells):
        return advisor.result
    try:
        with report_progress(f"tracing {counted(len(session.dwells), 'dwell')}"):
            return trace(session)
    except FitError as error:
        say(f"not traced: {error}")
        return None


def _runner(
    sensor: SampleSource,
    output: Path,
    options: dict[str, Any],
    *,
    resume: bool,
    advisor: TraceAdvisor | None,
) -> SessionRunner:
    """Make the runner of a new or resumed session from the options of the command, None if not given.

    `output` is the session file; `advisor` is None without a trace.
    """
    from adis_gonio.bench.gyro_turns import ALL_THERMOMETERS
    from adis_gonio.bench.recorder import DURATION_S
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor.driver import DEFAULT_SCAN
    from adis_gonio.faces.cli.terminal import on_terminal
    from adis_gonio.record.plans import GYRO_TURNS
    from adis_gonio.record.session_reader import FREE_TURN

    plan_name, auto, extend = (options[name] for name in ("plan_name", "auto", "extend"))
    if resume:
        option.refuse(("poll",), "--resume gets its scans as the session did before")
        return SessionRunner.resume(sensor, output, auto=auto, extend=extend, advisor=advisor)
    gravity, fixture = options["gravity_mps2"], options["fixture_deg"]
    if sensor.world is not None:
        # A simulated bench states values that are not given, as the operator of a real bench knows them.
        known = sensor.world.settings
        sigma = known.mark_sigma_deg if plan_name == GYRO_TURNS else known.fixture_sigma_deg
        gravity = known.gravity_mps2 if gravity is None else gravity
        fixture = sigma if fixture is None else fixture
    chosen = _choose_plan(plan_name, options)
    keeps_moves = options["record_turns"]
    settings = option.measuring_settings(
        dwell_s=(options["duration_s"] or DURATION_S) if plan_name == FREE_TURN else options["dwell_s"],
        settle_s=options["settle_s"],
        rate_hz=options["rate_hz"],
        filter_m=options["filter_m"],
        gyro_range_dps=options["range_dps"],
        data_ready=False if options["poll"] else None,
        turns=plan_name not in _PLAN_OPTIONS if keeps_moves is None else keeps_moves,
        registers=ALL_THERMOMETERS if plan_name == GYRO_TURNS else DEFAULT_SCAN,
    )
    return SessionRunner.begin(
        sensor,
        output,
        chosen,
        settings,
        auto=auto,
        extend=extend,
        gravity_mps2=STANDARD_GRAVITY_MPS2 if gravity is None else gravity,
        fixture_sigma_deg=fixture if isinstance(fixture, float) and plan_name != FREE_TURN else None,
        stage_curve=None if isinstance(fixture, float | None) else fixture,
        title=options["title"],
        note=options["note"],
        **_metadata(options, ask=on_terminal() and not auto),
        advisor=advisor,
    )


def _metadata(options: dict[str, Any], *, ask: bool) -> dict[str, str]:
    """Return operator, serial number, stage, laboratory and customer from the options.

    If `ask` is true, the operator is asked for a missing one of the first three.
    """
    written = {name: options[name] for name in ("laboratory", "customer")}
    for name, what in _METADATA.items():
        given = options[name]
        if given is None and ask:
            given = click.prompt(f"{what} (Enter: none)", default="", show_default=False, err=True)
        written[name] = given or ""
    return written


def _refuse_another_plan(own: Plan, output: Path, options: dict[str, Any]) -> None:
    """Raise `UsageError` if the options ask for another plan than the session in `output` began with."""
    if all(options[name] is None for name in ("plan_name", "positions", "turns")):
        return
    asked = _choose_plan(options["plan_name"] or own.name, options)
    if asked != replace(own, positions=own.positions[: len(asked)]):
        raise UsageError(
            f"{output} has the plan {own.name} with {counted(len(own), 'position')}: leave --plan,"
            " --positions and --turns out"
        )


def _choose_plan(name: str | None, options: dict[str, Any]) -> Plan:
    """Return the plan of a name (None: the default plan) with the options of the command.

    It raises `UsageError` for an option that the plan does not take.
    """
    from adis_gonio.bench import gyro_turns, recorder
    from adis_gonio.plan import find_plan
    from adis_gonio.record.plans import DEFAULT_PLAN

    name = name or DEFAULT_PLAN
    others = _POSITION_OPTIONS | {"duration_s", "turns"}
    option.refuse(sorted(others - _PLAN_OPTIONS.get(name, _POSITION_OPTIONS)), f"not with --plan {name}")
    if name != DEFAULT_PLAN:
        option.refuse(("extend",), f"{name} is complete: only --plan {DEFAULT_PLAN} can be extended")
    positions, turns = options["positions"], options["turns"]
    if name == "free-turn":
        turns = recorder.TURNS if turns is None else turns
        return recorder.free_turn_plan(turns, options["duration_s"] or recorder.DURATION_S)
    if name == "gyro-turns":
        turns = gyro_turns.TURNS if turns is None else turns
        return gyro_turns.gyro_turns_plan(turns, 6 if positions is None else positions)
    return find_plan(name, positions, options["check"])
