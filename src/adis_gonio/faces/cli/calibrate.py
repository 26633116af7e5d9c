"""`adis-gonio calibrate`: the bench session with plain prompts."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import exists_error
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.plain import choose_face
from adis_gonio.faces.cli.show import print_json

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


@click.command("calibrate")
@option.url
@option.output("Session file to make.", required=True)
@click.option(
    "--plan",
    "plan_name",
    help="two-position (default), four-position, mmpm, tumble, poses, free-turn, gyro-turns, or a file.",
)
@option.positions
@option.check
@click.option(
    "--duration",
    "duration_s",
    type=click.FloatRange(min=15, max=600),
    help="With --plan free-turn: longest recording in s (default 60).",
)
@click.option(
    "--turns",
    type=int,
    help="With --plan free-turn: full turns within it (default 2); with gyro-turns: each way (default 5).",
)
@click.option("--auto", is_flag=True, help="Move the stage by program and answer all prompts (simulator).")
@click.option("--extend", is_flag=True, help="With --auto: go on from two to four positions.")
@click.option(
    "--trace",
    "closing",
    is_flag=True,
    help="Then trace the session, and go on with the positions that would decide what is still open.",
)
@click.option(
    "--max-extra",
    type=click.IntRange(0, 1000),
    help="With --trace: most positions beyond the plan (default 24).",
)
@click.option("--resume", is_flag=True, help="Go on with the session in the file.")
@option.dwell()
@option.settle
@option.rate
@option.filter
@option.shown("--range", "range_dps", type=int, default=300, help="Gyros: 300, 150, 75 °/s.")
@click.option(
    "--record-turns/--no-record-turns",
    "record_turns",
    default=None,
    help="Keep the moves between dwells, which calibrate the gyros: at most 2.4 MB each (default: yes;"
    " of gyro-turns its whole turns alone).",
)
@option.poll
@option.gravity
@click.option("--latitude", type=float, help="Latitude in degrees: gravity of the ellipsoid there.")
@click.option("--height", type=float, default=0.0, help="Height in m, with --latitude.")
@option.fixture()
@option.title
@click.option("--note", default="", help="Note to keep with the session.")
@click.option("--operator", help="Who measures; asked for on a terminal.")
@click.option("--serial", help="Serial number of the part; asked for on a terminal.")
@click.option("--stage", help="Stage or fixture in your own words; asked for on a terminal.")
@click.option("--plain", is_flag=True, help="Prompts in plain lines, for logs and dumb terminals.")
@option.variant
@option.no_check
@option.json
def command(
    *,
    url: str,
    output: Path,
    resume: bool,
    as_json: bool,
    closing: bool,
    plain: bool,
    max_extra: int | None,
    **options: Any,
) -> int:
    """Calibrate a sensor on a stage, position by position, and compute ΔK and Δφ.

    Every sample goes into the session file as it is taken. The file survives a kill at any moment;
    --resume goes on with what is missing. Ctrl-C ends the session and keeps all of it.

    Each position is judged as the part comes to rest: not moved, turned the wrong way or about another
    axis, off by more than part and fixture explain. What is kept nevertheless ends in exit status 1.

    Scans start at the sensor's data-ready edges where the bridge can use them and the line is wired; else,
    or with --poll, they are polled.

    In a terminal of 80 × 24 or more the session is shown on a screen with the live angle (extra: bench);
    --plain, a log or a smaller terminal gets prompts line by line.

    --plan free-turn records slow continuous turns, from a rest to a rest, without declared angles: two in
    a minute, on and on or forth and back; or --turns N.

    --plan gyro-turns calibrates the gyros on a level table: whole turns both ways, from a mark back to it,
    with the X, the Y and the Z arrow up (down it only rests; --positions 3 leaves that out).

    With --trace the session then says which further positions would decide what is still open, and goes on
    with them until the model is adequate or no position is expected to show more.
    """
    from adis_gonio.bench.advisor import MOST_EXTRA, TraceAdvisor
    from adis_gonio.record.loading import load_session
    from adis_gonio.record.plans import GYRO_TURNS
    from adis_gonio.record.source import open_source, refuse_chip_options

    if output.exists() and not resume:
        raise exists_error(output, "--resume goes on with it, or choose another name")
    if resume and not output.exists():
        raise SessionError(f"{output}: no such session to resume")
    if max_extra is not None and not closing:
        raise UsageError("--max-extra limits what --trace adds: give --trace as well")
    refuse_chip_options(url, _given("rate_hz", "filter_m", "range_dps", "poll", "variant", "no_check"))
    advisor = TraceAdvisor(MOST_EXTRA if max_extra is None else max_extra) if closing else None
    if resume and not closing and _nothing_left(output):
        click.echo(f"{output}: complete, nothing is left to do", err=True)
        complete = True
    else:
        from adis_gonio.faces.cli.plain import PlainBench

        with open_source(url, variant=options["variant"], check=not options["no_check"]) as sensor:
            runner = _runner(sensor, output, resume=resume, advisor=advisor, **options)
            prompts = PlainBench(runner, auto=options["auto"])
            resume_by = shlex.join(["adis-gonio", "calibrate", url, "--resume", "-o", str(output)])
            plain = plain or options["auto"] or not runner.on_screen
            face = choose_face(runner, prompts, plain=plain, resume_by=resume_by)
            complete = face.run()
    session = load_session(output)
    if session.facts["plan"]["name"] == GYRO_TURNS:
        from adis_gonio.faces.cli.fit import show_gyro_fit

        show_gyro_fit(session, None, as_json=as_json)
    else:
        _show(session, advisor, complete=complete, as_json=as_json)
    if not as_json:
        click.echo(f"session: {session.source}")
    return _status(session, complete=complete)


def _show(session: Session, advisor: TraceAdvisor | None, *, complete: bool, as_json: bool) -> None:
    """What a session of positions gives, its gyros in a line."""
    from adis_gonio.faces.cli.fit import print_answer, print_gains
    from adis_gonio.fitting import fit
    from adis_gonio.fitting.gyros.gyro_fit import gains_of
    from adis_gonio.tracing.traced_answer import answer_with_trace

    truth = session.facts.get("truth")
    traced = _traced(session, advisor) if advisor is not None else None
    answer = answer_with_trace(fit(session), traced, own=False)
    if as_json:
        document = answer.as_dict()
        document |= {"session": session.source, "complete": complete, "truth": truth}
        document["doubts"] = session.facts["doubts"]
        gains = gains_of(session)
        if gains is not None:
            document["gyro_gains"] = gains.as_dict()
        if traced is not None:
            document |= {"trace": traced.as_dict(), "rounds": session.facts["advised"]}
        print_json(document)
        return
    print_answer(answer, truth)
    print_gains(session)
    if traced is not None:
        from adis_gonio.faces.cli.closing import print_loop
        from adis_gonio.faces.cli.trace import print_trace

        click.echo()
        print_trace(session, traced)
        print_loop(session, traced)


def _status(session: Session, *, complete: bool) -> int:
    """Exit status; where a dwell was kept against a guard, why the result cannot be right is said."""
    doubts = session.facts["doubts"]
    for doubt in doubts:
        sure = "cannot" if doubt["attempt"] is not None else "may not"
        click.echo(f"the result {sure} be right: {doubt['message']}", err=True)
    if doubts:
        kept = sum(doubt["attempt"] is not None for doubt in doubts)
        what = [f"{counted(kept, 'dwell')} kept nevertheless"] if kept else []
        skipped = sum(doubt["kind"] != "registers" for doubt in doubts) - kept
        if skipped:
            what.append(f"{counted(skipped, 'position')} that contradicted dwells before skipped")
        click.echo("; ".join([*what, f"the data stay in {session.source}: measure again"]), err=True)
    return 0 if complete and not doubts else 1


def _written(options: dict[str, Any], *, ask: bool) -> dict[str, str]:
    """Operator, serial number and stage: as given, else asked once where somebody sits at a terminal."""
    written = {}
    for name, what in _METADATA.items():
        given = options[name]
        if given is None and ask:
            given = click.prompt(f"{what} (Enter: none)", default="", show_default=False, err=True)
        written[name] = given or ""
    return written


def _traced(session: Session, advisor: TraceAdvisor) -> TraceResult | None:
    """The advisor's last trace where it saw all of the session, else a new one; None where none can be."""
    from adis_gonio.faces.cli.show import working
    from adis_gonio.tracing.trace import trace

    if advisor.result is not None and advisor.dwells == len(session.dwells):
        return advisor.result
    try:
        with working(f"tracing {counted(len(session.dwells), 'dwell')}"):
            return trace(session, advisor.max_effects)
    except FitError as error:
        click.echo(f"not traced: {error}", err=True)
        return None


def _nothing_left(path: Path) -> bool:
    """True where all positions are done and the plan has no longer form to offer."""
    from adis_gonio.record.archive import ArchiveView
    from adis_gonio.record.plans import extension

    with ArchiveView(path) as view:
        done = not view.pending() and not view.faulty()
        return done and extension(view.plan(), len(view.dwells())) is None


def _given(*names: str) -> dict[str, bool]:
    """Which options stand on the command line, by their spelling there."""
    context = click.get_current_context()
    spelling = {option.name: option.opts[-1] for option in context.command.params}
    default = click.core.ParameterSource.DEFAULT
    return {spelling[name]: context.get_parameter_source(name) is not default for name in names}


def _runner(
    sensor: SampleSource,
    output: Path,
    *,
    resume: bool,
    plan_name: str | None,
    positions: int | None,
    check: int,
    auto: bool,
    extend: bool,
    advisor: TraceAdvisor | None,
    duration_s: float | None,
    turns: int | None,
    **options: Any,
) -> SessionRunner:
    from adis_gonio.bench.gyro_turns import ALL_THERMOMETERS
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor.driver import DEFAULT_SCAN
    from adis_gonio.faces.cli.plain import on_terminal
    from adis_gonio.model.records import normal_gravity_mps2
    from adis_gonio.record.plans import GYRO_TURNS
    from adis_gonio.record.session_reader import FREE_TURN

    if resume:
        if plan_name is not None or positions is not None or turns is not None:
            raise UsageError(
                "--resume goes on with the session's own plan: leave --plan, --positions and --turns out"
            )
        if options["poll"]:
            raise UsageError("--resume gets its scans as the session did before: leave --poll out")
        return SessionRunner.resume(sensor, output, auto=auto, extend=extend, advisor=advisor)
    if options["latitude"] is not None and options["gravity_mps2"] is not None:
        raise UsageError("give --gravity or --latitude, not both")
    world = sensor.world
    gravity = options["gravity_mps2"]
    fixture = options["fixture_deg"]
    if options["latitude"] is not None:
        gravity = normal_gravity_mps2(options["latitude"], options["height"])
    # What an operator would know of a real bench, the simulated one says of itself.
    if gravity is None:
        gravity = world.settings.gravity_mps2 if world is not None else 9.80665
    if fixture is None and world is not None:
        fixture = world.settings.fixture_sigma_deg
    if (plan_name in (FREE_TURN, GYRO_TURNS)) and (check or extend or advisor is not None):
        raise UsageError(f"{_TURNED[plan_name or '']}: leave --check, --extend and --trace out")
    if plan_name == GYRO_TURNS and world is not None and options["fixture_deg"] is None:
        fixture = world.settings.mark_sigma_deg
    chosen, length_s = _chosen(plan_name, positions, check, duration_s, turns)
    keeps_moves = options["record_turns"]
    settings = option.measuring_settings(
        dwell_s=options["dwell_s"] if length_s is None else length_s,
        settle_s=options["settle_s"],
        rate_hz=options["rate_hz"],
        filter_m=options["filter_m"],
        gyro_range_dps=options["range_dps"],
        data_ready=False if options["poll"] else None,
        turns=plan_name not in _TURNED if keeps_moves is None else keeps_moves,
        registers=ALL_THERMOMETERS if plan_name == GYRO_TURNS else DEFAULT_SCAN,
    )
    return SessionRunner.begin(
        sensor,
        output,
        chosen,
        settings,
        auto=auto,
        extend=extend,
        gravity_mps2=gravity,
        fixture_sigma_deg=None if plan_name == FREE_TURN else fixture,
        title=options["title"],
        note=options["note"],
        **_written(options, ask=on_terminal() and not auto),
        advisor=advisor,
    )


_TURNED = {
    "free-turn": "a free turn has no positions",
    "gyro-turns": "of gyro turns all take part in the fit",
}


def _chosen(
    name: str | None, positions: int | None, check: int, duration_s: float | None, turns: int | None
) -> tuple[Plan, float | None]:
    """Return the plan by its options, and the longest recording of a free turn."""
    from adis_gonio.bench import gyro_turns, recorder
    from adis_gonio.plan.document import plan_by
    from adis_gonio.record.plans import DEFAULT_PLAN

    if name == "free-turn":
        if positions is not None:
            raise UsageError(f"{_TURNED[name]}: leave --positions, --check, --extend and --trace out")
        length_s = recorder.DURATION_S if duration_s is None else duration_s
        return recorder.free_turn_plan(recorder.TURNS if turns is None else turns, length_s), length_s
    if duration_s is not None:
        dwell = "" if name == "gyro-turns" else ", or --dwell"
        raise UsageError(f"--duration is that of a free turn: give --plan free-turn{dwell}")
    if name == "gyro-turns":
        faces = 6 if positions is None else positions
        return gyro_turns.gyro_turns_plan(gyro_turns.TURNS if turns is None else turns, faces), None
    if turns is not None:
        raise UsageError("--turns are those of a free turn: give --plan free-turn (of gyros: gyro-turns)")
    return plan_by(name or DEFAULT_PLAN, positions, check), None
