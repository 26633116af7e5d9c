"""`adis-gonio calibrate`: the bench session with plain prompts."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.cli.show import (
    console,
    json_option,
    no_check_option,
    poll_option,
    print_json,
    variant_option,
)
from adis_gonio.errors import FitError, SessionError, UsageError

if TYPE_CHECKING:
    from adis_gonio.model.records import Session
    from adis_gonio.session import SessionRunner
    from adis_gonio.session.closing import TraceAdvisor
    from adis_gonio.session.events import (
        Advised,
        Configured,
        DwellDone,
        Event,
        ExtensionOffered,
        PositionAsked,
        RepetitionOffered,
        Started,
    )
    from adis_gonio.session.plans import Position
    from adis_gonio.session.source import SampleSource
    from adis_gonio.tracing import TraceResult

_WIDTH = 100
"""Widest text: longer lines are hard to read."""


@click.command("calibrate")
@click.argument("url")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="Session file to make."
)
@click.option("--plan", "plan_name", help="two-position (default), four-position, mmpm, tumble or poses.")
@click.option("--positions", type=int, help="Number of angles, where the plan leaves a choice.")
@click.option(
    "--check", type=int, default=0, show_default=True, help="Extra positions kept out of the fit."
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
@click.option(
    "--dwell", "dwell_s", type=float, default=10.0, show_default=True, help="Length of a dwell in s."
)
@click.option(
    "--settle", "settle_s", type=float, default=0.5, show_default=True, help="Wait after stillness, s."
)
@click.option("--rate", "rate_hz", type=float, help="Samples a second, 0.413 to 819.2 (default).")
@click.option(
    "--filter", "filter_m", type=int, default=2, show_default=True, help="Filter: 2^M taps twice."
)
@click.option(
    "--range", "range_dps", type=int, default=300, show_default=True, help="Gyros: 300, 150, 75 °/s."
)
@poll_option
@click.option("--gravity", "gravity_mps2", type=float, help="Local gravity in m/s² (default 9.80665).")
@click.option("--latitude", type=float, help="Latitude in degrees: gravity of the ellipsoid there.")
@click.option("--height", type=float, default=0.0, help="Height in m, with --latitude.")
@click.option(
    "--fixture", "fixture_deg", type=float, help="Standard uncertainty of a stage angle, degrees."
)
@click.option("--title", default="", help="Title to keep with the session.")
@click.option("--note", default="", help="Note to keep with the session.")
@variant_option
@no_check_option
@json_option
def command(
    *,
    url: str,
    output: Path,
    resume: bool,
    as_json: bool,
    closing: bool,
    max_extra: int | None,
    **options: Any,
) -> int:
    """Calibrate a sensor on a stage, position by position, and compute ΔK and Δφ.

    Every sample goes into the session file as it is taken. The file survives a kill at any moment;
    --resume goes on with what is missing. Ctrl-C ends the session and keeps all of it.

    Scans start at the sensor's data-ready edges where the bridge can use them and the line is wired; else,
    or with --poll, they are polled.

    With --trace the session then says which further positions would decide what is still open, and goes on
    with them until the model is adequate or no position is expected to show more.
    """
    from adis_gonio.session import load_session
    from adis_gonio.session.source import open_source, refuse_chip_options

    if output.exists() and not resume:
        raise SessionError(f"{output}: exists already; --resume goes on with it, or choose another name")
    if resume and not output.exists():
        raise SessionError(f"{output}: no such session to resume")
    if max_extra is not None and not closing:
        raise UsageError("--max-extra limits what --trace adds: give --trace as well")
    refuse_chip_options(url, _given("rate_hz", "filter_m", "range_dps", "poll", "variant", "no_check"))
    advisor = _advisor(max_extra) if closing else None
    if resume and not closing and _nothing_left(output):
        click.echo(f"{output}: complete, nothing is left to do", err=True)
        complete = True
    else:
        with open_source(url, variant=options["variant"], check=not options["no_check"]) as sensor:
            runner = _runner(sensor, output, resume=resume, advisor=advisor, **options)
            complete = Bench(runner, auto=options["auto"]).run()
    session = load_session(output)
    truth = session.facts.get("truth")
    traced = _traced(session, advisor) if advisor is not None else None
    from adis_gonio.answer import Answer
    from adis_gonio.fitting import fit

    answer = Answer.of(fit(session), traced, own=False)
    if as_json:
        document = answer.as_dict()
        document |= {"session": str(output), "complete": complete, "truth": truth}
        if traced is not None:
            document |= {"trace": traced.as_dict(), "rounds": session.facts["advised"]}
        print_json(document)
        return 0 if complete else 1
    from adis_gonio.cli.fit import print_answer

    print_answer(answer, truth)
    if traced is not None:
        from adis_gonio.cli.closing import print_loop
        from adis_gonio.cli.trace import print_trace

        click.echo()
        print_trace(session, traced)
        print_loop(session, traced)
    click.echo(f"session: {output}")
    return 0 if complete else 1


def _advisor(max_extra: int | None) -> TraceAdvisor:
    from adis_gonio.session.closing import MOST_EXTRA, TraceAdvisor

    return TraceAdvisor(MOST_EXTRA if max_extra is None else max_extra)


def _traced(session: Session, advisor: TraceAdvisor) -> TraceResult | None:
    """The advisor's last trace where it saw all of the session, else a new one; None where none can be."""
    from adis_gonio.cli.working import working
    from adis_gonio.tracing import trace

    if advisor.result is not None and advisor.dwells == len(session.dwells):
        return advisor.result
    try:
        with working(f"tracing {len(session.dwells)} dwells"):
            return trace(session, advisor.max_effects)
    except FitError as error:
        click.echo(f"not traced: {error}", err=True)
        return None


def _nothing_left(path: Path) -> bool:
    """True where all positions are done and the plan has no longer form to offer."""
    from adis_gonio.session.archive import ArchiveView
    from adis_gonio.session.plans import extension

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
    **options: Any,
) -> SessionRunner:
    from adis_gonio.model.gravity import normal_gravity_mps2
    from adis_gonio.sensor.settings import smpl_prd_for
    from adis_gonio.session import SessionRunner, Settings, plan
    from adis_gonio.session.plans import DEFAULT_PLAN

    if resume:
        if plan_name is not None or positions is not None:
            raise UsageError(
                "--resume goes on with the session's own plan: leave --plan and --positions out"
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
    settings = Settings(
        dwell_s=options["dwell_s"],
        settle_s=options["settle_s"],
        smpl_prd=1 if options["rate_hz"] is None else smpl_prd_for(options["rate_hz"]),
        filter_m=options["filter_m"],
        gyro_range_dps=options["range_dps"],
        data_ready=False if options["poll"] else None,
    )
    return SessionRunner.begin(
        sensor,
        output,
        plan(plan_name or DEFAULT_PLAN, positions, check),
        settings,
        auto=auto,
        extend=extend,
        gravity_mps2=gravity,
        fixture_sigma_deg=fixture,
        title=options["title"],
        note=options["note"],
        advisor=advisor,
    )


class Bench:
    """Plain prompts and progress for a session, on standard error."""

    def __init__(self, runner: SessionRunner, *, auto: bool) -> None:
        self._runner = runner
        self._auto = auto
        self._asking = False
        self._screen = console(stderr=True)

    def run(self) -> bool:
        """Run the session; return True where it is complete."""
        from rich.progress import BarColumn, Progress, TextColumn

        complete = False
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
        with (
            self._interruptible(),
            Progress(*columns, console=self._screen, transient=True) as self._progress,
        ):
            self._task = self._progress.add_task("", total=None, note="", visible=False)
            for event in self._runner.run():
                complete = self._handle(event) or complete
        return complete

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let the first Ctrl-C end the session in order, so that nothing recorded is lost."""

        def interrupt(number: int, frame: Any) -> None:
            self._runner.stop()
            if self._asking:
                raise KeyboardInterrupt

        before = signal.signal(signal.SIGINT, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def _say(self, text: str, style: str | None = None) -> None:
        self._screen.print(text, style=style, markup=False)

    def _handle(self, event: Event) -> bool:
        """Show one event, answer it where it is a question; True where the session is complete."""
        from adis_gonio.session import events

        match event:
            case events.Watching():
                self._show(event.state, f"spread {max(event.spread_mg):.2f} mg", None, None)
            case events.DwellProgress():
                self._show_time("dwell", event.elapsed_s, event.length_s)
            case events.Waiting():
                self._show_time("waiting", event.elapsed_s, event.length_s)
            case events.Advising():
                if not self._screen.is_terminal:
                    self._say(f"tracing {event.dwells} dwells …")
                self._show("tracing", f"{event.dwells} dwells", None, None)
            case events.PositionAsked() | events.RepetitionOffered() | events.ExtensionOffered():
                self._answer(event)
            case events.Finished():
                if not event.complete:
                    self._say(
                        f"  not complete: {event.done} of {event.total}; go on with --resume", "yellow"
                    )
                return event.complete
            case _:
                self._tell(event)
        return False

    def _answer(self, event: PositionAsked | RepetitionOffered | ExtensionOffered) -> None:
        """Put a question to the operator."""
        from adis_gonio.session import events

        match event:
            case events.PositionAsked():
                if not self._auto:
                    self._ask_position(event)
            case events.RepetitionOffered():
                self._offer_repetition(event)
            case events.ExtensionOffered():
                self._offer(event)

    def _tell(self, event: Event) -> None:
        """Say what has happened, in lines that stay."""
        from adis_gonio.session import events

        match event:
            case events.Started():
                self._started(event)
            case events.Configured():
                self._configured(event)
            case events.NoiseMeasured():
                noise = ", ".join(f"{value:.2f}" for value in event.noise_mg)
                self._say(f"  noise at rest {noise} mg (x, y, z)")
            case events.DwellDone():
                self._dwell_done(event)
            case events.DwellInterrupted():
                where = event.position
                self._say(f"  dwell at {where} interrupted: {event.reason} (samples kept)", "yellow")
            case events.Problem():
                self._say(f"  {event.message}", "yellow")
            case events.Advised():
                self._hide()
                self._advised(event)
            case _:
                pass

    def _started(self, event: Started) -> None:
        what = "resumed" if event.resumed else "begun"
        self._say(f"{event.plan.name} {what}, {len(event.plan)} positions, {event.variant} on {event.url}")
        if event.resumed:
            self._say(f"  {event.done} positions are done")

    def _configured(self, event: Configured) -> None:
        rate = event.configuration["sample_rate_hz"]
        filter_m = event.configuration.get("filter_m")
        filtered = "" if filter_m is None else f", filter 2 × {2**filter_m} taps"
        changed = ", ".join(f"{name} {a} → {b}" for name, (a, b) in event.changed.items())
        self._say(f"  {rate:.1f} samples/s{filtered}" + (f"; changed {changed}" if changed else ""))
        if event.why_polled:
            self._say(f"  scans are polled: {event.why_polled}")

    def _dwell_done(self, event: DwellDone) -> None:
        x, y, z = event.accel_mg
        lost = f", {event.lost} lost" if event.lost else ""
        lost += f", {event.alarms} with an error or alarm" if event.alarms else ""
        self._hide()
        self._say(
            f"  {event.position!s:>16}   x {x:+9.2f}   y {y:+9.2f}   z {z:+9.2f} mg"
            f"   {event.samples} samples{lost}"
        )

    def _show_time(self, what: str, elapsed_s: float, length_s: float) -> None:
        self._show(what, f"{elapsed_s:.0f} of {length_s:.0f} s", elapsed_s, length_s)

    def _show(self, what: str, note: str, done: float | None, total: float | None) -> None:
        self._progress.update(
            self._task,
            description=f"  {what:<9}",
            note=note,
            completed=done or 0,
            total=total,
            visible=True,
        )

    def _hide(self) -> None:
        """Take the bar away at once, not at its next refresh."""
        self._progress.update(self._task, visible=False)
        self._progress.refresh()

    def _ask_position(self, event: PositionAsked) -> None:
        others = "s skip, r repeat the last, q end" if event.can_repeat else "s skip, q end"
        place, todo = _to_do(event.position)
        answer = self._question(
            f"{event.number} of {event.total}: {todo} {place} and press Enter ({others})", "srq"
        )
        match answer:
            case "":
                self._runner.confirm()
            case "s":
                self._runner.skip()
            case "r" if event.can_repeat:
                self._runner.repeat()
            case "r":
                self._say("  there is no dwell before this one to repeat")
            case _:
                self._runner.stop()

    def _offer_repetition(self, event: RepetitionOffered) -> None:
        where = ", ".join(str(position) for position in event.positions)
        if self._auto:
            self._say(f"  kept with an error or alarm in them: {where}", "yellow")
            return
        answer = self._question(
            f"an error or alarm stood at {where}: repeat? (Enter yes, n no: keep as it is, q end)", "nq"
        )
        match answer:
            case "":
                self._runner.accept()
            case "n":
                self._runner.decline()
            case _:
                self._runner.stop()

    def _offer(self, event: ExtensionOffered) -> None:
        if event.blindness is not None:
            self._say(event.blindness.message, "yellow")
            text = "go on with 180° and 270°? (Enter yes, n no)"
        else:
            for reason in event.reasons:
                self._say_wrapped(f"{reason[0].upper()}{reason[1:]}.")
            text = "  Go on? (Enter yes, n no: end the session here)"
        if self._auto:
            return
        answer = self._question(text, "n")
        if answer == "":
            self._runner.accept()
        else:
            self._runner.decline()

    def _advised(self, event: Advised) -> None:
        from adis_gonio.cli.closing import standing

        self._say("")
        for line in standing(event.summary):
            self._say_wrapped(line)
        if not event.positions:
            closed = event.summary.get("adequate") and event.summary.get("tested")
            said = f"{event.ended[0].upper()}{event.ended[1:]}."
            self._say_wrapped(said, "green" if closed else "yellow")

    def _say_wrapped(self, text: str, style: str = "") -> None:
        """Text of several lines, indented by two."""
        from rich.padding import Padding
        from rich.text import Text

        width = min(self._screen.width, _WIDTH)
        self._screen.print(Padding(Text(text, style=style), (0, 0, 0, 2)), width=width)

    def _question(self, text: str, letters: str) -> str:
        """Ask until the answer is empty or one of the letters; `q` where nobody can answer."""
        self._progress.update(self._task, visible=False)
        self._progress.stop()
        self._asking = True
        try:
            while True:
                print(f"{text}: ", end="", file=sys.stderr, flush=True)  # noqa: T201
                line = sys.stdin.readline()
                if not line:
                    self._say("\nno more input: the session ends here, go on with --resume", "yellow")
                    return "q"
                answer = line.strip().lower()
                if answer == "" or (len(answer) == 1 and answer in letters):
                    return answer
                self._say(f"  '{answer}' is no answer: press Enter, or one of {', '.join(letters)}")
        except KeyboardInterrupt:
            return "q"
        finally:
            self._asking = False
            self._progress.start()


def _to_do(position: Position) -> tuple[str, str]:
    """Place and what to do with the part, as words of a prompt."""
    from adis_gonio.session.plans import attitude

    place, todo = str(position), "turn the part to"
    if position.angle_deg is None:
        todo = "hold the part in"
        if position.direction is not None:
            place += f", {attitude(position.direction)},"
    first = []
    if position.temperature_c is not None:
        first.append(f"bring the part to {position.temperature_c:.0f} °C")
    if position.supply_v is not None:
        first.append(f"set the supply to {position.supply_v:.2f} V")
    return place, ", ".join([*first, todo])
