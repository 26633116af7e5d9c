"""The bench in plain lines: prompts and progress on standard error, answers from standard input.

How a session shows itself: on the bench screen where the terminal can, else by plain prompts.
"""

from __future__ import annotations

import importlib.util
import os
import select
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import click

from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.device.sensor.settings import compensations
from adis_gonio.faces.cli.show import WIDTH, console

if TYPE_CHECKING:
    from adis_gonio.bench.events import (
        Advised,
        Configured,
        DwellDone,
        Event,
        ExtensionOffered,
        GuardRaised,
        PositionAsked,
        RepetitionOffered,
        Started,
        TurnDone,
        TurnMeasured,
        TurnProgress,
        Watching,
    )
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.record.plans import Position

_KEYS = {"retake": "r", "keep": "k", "skip": "s", "reverse": "v"}


def on_terminal() -> bool:
    """True where somebody types the lines; False for a pipe, a file or what only reads like one."""
    asks = getattr(sys.stdin, "isatty", None)
    return asks is not None and asks()


class Lines:
    """Standard input line by line."""

    def __init__(self) -> None:
        self._kept = b""
        self._ended = False
        try:
            self._file: int | None = None if os.name == "nt" else sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # no real file: only something with lines, or closed
            self._file = None

    def next(self, *, wait: bool) -> str | None:
        """The next line; None where there is none yet and nobody waits. `EOFError` after the last one.

        Where the system cannot look without waiting, it waits.
        """
        if self._file is None:
            line = sys.stdin.readline()
            if not line:
                raise EOFError
            return line.strip()
        while b"\n" not in self._kept and not self._ended:
            if not select.select([self._file], [], [], None if wait else 0.0)[0]:
                return None
            read = os.read(self._file, 4096)
            self._ended = not read
            self._kept += read
        if not self._kept:
            raise EOFError
        line_bytes, _, self._kept = self._kept.partition(b"\n")
        return line_bytes.decode(errors="replace").strip()


@dataclass
class _Question:
    """What stands open: its line, what each key does, and what the end of the input does."""

    text: str
    keys: dict[str, Callable[[], None]]
    at_end: Callable[[], None]
    takes_notes: bool


class PlainBench:
    """Plain prompts and progress for a session."""

    def __init__(self, runner: SessionRunner, *, auto: bool) -> None:
        self._runner = runner
        self._auto = auto
        self._lines = Lines()
        self._question: _Question | None = None
        self._asking = False
        self._here: Position | None = None  # where the part lies; unknown once a dwell was broken off
        self._drawn = False
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

    def _handle(self, event: Event) -> bool:
        """Show one event, answer it where it is a question; True where the session is complete."""
        from adis_gonio.bench import events

        match event:
            case events.Watching():
                if self._question is not None:
                    self._listen(wait=False)
                else:
                    self._show(*watched(event))
            case events.DwellProgress():
                self._show(*dwell_shown("dwell", event.elapsed_s, event.length_s))
            case events.TurnProgress():
                self._show(*turn_shown(event))
            case events.Waiting():
                self._show(*dwell_shown("waiting", event.elapsed_s, event.length_s))
            case events.Advising():
                if not self._screen.is_terminal:
                    self._say(f"tracing {counted(event.dwells, 'dwell')} …")
                self._show("tracing", counted(event.dwells, "dwell"), None, None)
            case events.Finished():
                if not event.complete:
                    done = f"{event.done} of {event.total}"
                    self._say(f"  not complete: {done}; go on with --resume", "yellow")
                return event.complete
            case _:
                self._ask(event)
                self._tell(event)
        return False

    # -- questions --------------------------------------------------------------------------------

    def _ask(self, event: Event) -> None:
        """Put a question to the operator, where the event is one."""
        from adis_gonio.bench import events

        match event:
            case events.PositionAsked() if not self._auto:
                self._ask_position(event)
            case events.GuardRaised():
                self._ask_guard(event)
            case events.RepetitionOffered():
                self._offer_repetition(event)
            case events.ExtensionOffered():
                self._offer(event)
            case events.Paused():
                text = "paused: nothing is measured; Enter goes on, q ends"
                self._put(
                    text, {"": self._runner.unpause, "q": self._end}, self._end, notes=True, wait=True
                )
            case _:
                pass

    def _ask_position(self, event: PositionAsked) -> None:
        from adis_gonio.bench.guidance import drawing, to_do, turn_to_do
        from adis_gonio.record.plans import GYRO_TURNS

        if not self._drawn:
            self._drawn = True
            for line in drawing(self._plan):
                self._say(f"    {line}")
        runner = self._runner
        keys: dict[str, Callable[[], None]] = {"": runner.confirm, "s": runner.skip}
        if event.can_repeat:
            keys |= {"r": runner.repeat, "u": runner.undo}
        keys |= {"p": runner.pause, "q": self._end}
        todo = to_do(
            event.position,
            self._here,
            reverse=runner.reversed,
            fastest_dps=runner.fastest_dps,
            table=self._plan.name == GYRO_TURNS,
        )
        if runner.one_recording:
            todo = turn_to_do(max(self._plan.turns, 1))
        left = time_left(event.time_left_s)
        others = ", ".join(f"{key} {_MEANING[key]}" for key in keys if key) + ", n note"
        text = f"{event.number} of {event.total}{left}: {todo} and press Enter ({others})"
        self._put(text, keys, self._no_more_input, notes=True)

    def _ask_guard(self, event: GuardRaised) -> None:
        self._hide()
        self._say(f"  {event.message}", "bold yellow")
        keys: dict[str, Callable[[], None]] = {"": self._answering(event.default)}
        keys |= {_KEYS[name]: self._answering(name) for name in event.answers}
        keys |= {"p": self._runner.pause, "q": self._end}
        meaning = _GUARD_MEANING
        if event.position.turned_deg is not None:
            meaning = meaning | _WHOLE_TURN_MEANING
        others = ", ".join(f"{key} {meaning[key]}" for key in keys if key) + ", n note"
        default = meaning[_KEYS[event.default]]
        self._put(f"  Enter: {default} ({others})", keys, self._no_more_input, notes=True)

    def _answering(self, name: str) -> Callable[[], None]:
        return lambda: self._runner.answer(name)

    def _offer_repetition(self, event: RepetitionOffered) -> None:
        where = ", ".join(str(position) for position in event.positions)
        if self._auto:
            self._say(f"  kept with an error or alarm in them: {where}", "yellow")
            return
        keys = {"": self._runner.accept, "n": self._runner.decline, "q": self._end}
        text = f"an error or alarm stood at {where}: repeat? (Enter yes, n no: keep as it is, q end)"
        self._put(text, keys, self._no_more_input)

    def _offer(self, event: ExtensionOffered) -> None:
        lines, text = extension_offered(event)
        for line, style in lines:
            self._say_wrapped(line, style)
        if not self._auto:
            keys = {"": self._runner.accept, "n": self._runner.decline, "q": self._runner.decline}
            self._put(text, keys, self._runner.decline)

    def _put(
        self,
        text: str,
        keys: dict[str, Callable[[], None]],
        at_end: Callable[[], None],
        *,
        notes: bool = False,
        wait: bool = False,
    ) -> None:
        """Let a question stand; where the sensor's time waits with the operator, until it is answered."""
        self._progress.update(self._task, visible=False)
        self._progress.stop()
        self._question = _Question(text, keys, at_end, notes)
        self._prompt()
        while self._question is not None and (wait or self._runner.virtual_time):
            self._listen(wait=True)

    def _prompt(self) -> None:
        if self._question is not None:
            print(f"{self._question.text}: ", end="", file=sys.stderr, flush=True)  # noqa: T201

    def _listen(self, *, wait: bool) -> None:
        """Take a line, where there is one, as the answer to the question that stands."""
        question, self._asking = self._question, wait
        if question is None:
            return
        try:
            line = self._lines.next(wait=wait)
        except EOFError:
            self._close(question.at_end)
            return
        except KeyboardInterrupt:
            self._close(self._end)
            return
        finally:
            self._asking = False
        if line is not None:
            self._take(question, line)

    def _take(self, question: _Question, line: str) -> None:
        """Do what a line says; where it says nothing known, ask again."""
        key, _, rest = line.partition(" ")
        action = question.keys.get(key.lower()) if not rest else None
        if action is not None:
            self._close(action)
        elif question.takes_notes and key.lower() == "n":
            self._take_note(rest)
        else:
            known = ", ".join(key for key in question.keys if key)
            self._say(f"  '{line}' is no answer: press Enter, or one of {known}")
            self._prompt()

    def _take_note(self, text: str) -> None:
        if not text:
            print("  note: ", end="", file=sys.stderr, flush=True)  # noqa: T201
            try:
                text = self._lines.next(wait=True) or ""
            except EOFError:
                text = ""
        self._runner.note(text)
        self._say("  noted" if text else "  nothing noted")
        self._prompt()

    def _close(self, action: Callable[[], None]) -> None:
        self._question = None
        self._progress.start()
        action()

    def _end(self) -> None:
        self._runner.stop()

    def _no_more_input(self) -> None:
        self._say("\nno more input: the session ends here, go on with --resume", "yellow")
        self._runner.stop()

    # -- lines that stay --------------------------------------------------------------------------

    def _tell(self, event: Event) -> None:
        """Say what has happened, in lines that stay."""
        from adis_gonio.bench import events

        match event:
            case events.Started():
                self._started(event)
            case events.Configured():
                self._say_all(configured(event))
            case events.NoiseMeasured():
                noise = ", ".join(f"{value:.2f}" for value in event.noise_mg)
                self._say(f"  noise at rest {noise} mg (x, y, z)")
            case events.TurnMeasured() if not self._auto:
                self._say(turned(event))
            case events.DwellDone():
                self._here = event.position
                self._hide()
                self._say(dwell_done(event))
            case events.Running() if not self._auto:
                self._say_running(event)
            case events.DwellInterrupted():
                where, self._here = event.position, None
                self._say(f"  dwell at {where} interrupted: {event.reason} (samples kept)", "yellow")
            case _:
                self._tell_rest(event)

    def _tell_rest(self, event: Event) -> None:
        from adis_gonio.bench import events

        match event:
            case events.Problem():
                self._say(f"  {event.message}", "yellow")
            case events.TurnDone():
                self._hide()
                self._say(turn_done(event))
            case events.Withdrawn():
                self._say(f"  the dwell at {event.position} is withdrawn (samples kept)", "yellow")
            case events.Advised():
                self._hide()
                self._say("")
                for line, style in advised(event):
                    self._say_wrapped(line, style)
            case _:
                pass

    def _started(self, event: Started) -> None:
        self._plan = event.plan
        what = "resumed" if event.resumed else "begun"
        shape = counted(len(event.plan), "position")
        self._say(f"{event.plan.name} {what}, {shape}, {event.variant} on {event.url}")
        if event.resumed:
            self._say(f"  {event.done} of them done")

    def _say_running(self, event: Any) -> None:
        shown = []
        for name in ("delta_k", "delta_phi"):
            entry = event.parameters.get(name)
            if entry is not None:
                shown.append(f"{name} {format_uncertain(entry['value'], entry['u'], entry['unit'])}")
        if shown:
            self._say(f"  so far: {', '.join(shown)}")

    def _say(self, text: str, style: str | None = None) -> None:
        self._screen.print(text, style=style, markup=False)

    def _say_all(self, lines: list[str]) -> None:
        for line in lines:
            self._say(line)

    def _say_wrapped(self, text: str, style: str = "") -> None:
        """Text of several lines, indented by two."""
        from rich.padding import Padding
        from rich.text import Text

        width = min(self._screen.width, WIDTH)
        self._screen.print(Padding(Text(text, style=style), (0, 0, 0, 2)), width=width)

    # -- the line that moves ----------------------------------------------------------------------

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


_MEANING = {"s": "skip", "r": "repeat the last", "u": "undo the last", "p": "pause", "q": "end"}
_WHOLE_TURN_MEANING = {"r": "turn again", "v": "take it so, and turn the next one the other way"}
_GUARD_MEANING = {
    "r": "take the position again",
    "k": "keep it as it is",
    "s": "skip",
    "v": "take the whole session as reversed",
    "p": "pause",
    "q": "end",
}


Shown = tuple[str, str, float | None, float | None]
"""What a progress line shows: what, note, done, total."""


def watched(event: Watching) -> Shown:
    """A look at the sensor."""
    note = f"spread {max(event.spread_mg):.2f} mg"
    if event.limit_mg is not None:
        note += f" (still below {min(event.limit_mg):.2f})"
    if event.angle_deg is not None:
        note += f", {event.angle_deg:+.2f}°"
    return event.state, note, None, None


def dwell_shown(what: str, elapsed_s: float, length_s: float) -> Shown:
    """A time that runs."""
    return what, f"{elapsed_s:.0f} of {length_s:.0f} s", elapsed_s, length_s


def turn_shown(event: TurnProgress) -> Shown:
    """A free turn as it goes on."""
    turn = "turn" if event.turns == 1 else f"turn {event.turn} of {event.turns}"
    what = {"rest": "at rest", "turn": turn, "after": "let rest"}[event.state]
    note = f"{event.turned_deg:+.0f}°, {event.rate_dps:+.1f} °/s, {event.elapsed_s:.0f} s"
    return what, note, event.elapsed_s, event.length_s


def turn_done(event: TurnDone) -> str:
    """What was recorded of a free turn."""
    lost = f", {event.lost} lost" if event.lost else ""
    turns = f"{counted(event.turns, 'full turn')}, {event.travelled_deg:.0f}° in all,"
    return f"  {turns} in {event.length_s:.0f} s, {event.samples} scans{lost}"


def configured(event: Configured) -> list[str]:
    """How the sensor measures."""
    rate = event.configuration["sample_rate_hz"]
    filter_m = event.configuration.get("filter_m")
    filtered = "" if filter_m is None else f", filter 2 × {2**filter_m} taps"
    changed = ", ".join(f"{name} {a} → {b}" for name, (a, b) in event.changed.items())
    lines = [f"  {rate:.1f} samples/s{filtered}" + (f"; changed {changed}" if changed else "")]
    compensated = compensations(event.configuration)
    if compensated:
        lines.append(f"  the chip compensates {', '.join(compensated)}")
    if event.why_polled:
        lines.append(f"  scans are polled: {event.why_polled}")
    return lines


def dwell_done(event: DwellDone) -> str:
    """A dwell with its mean."""
    x, y, z = event.accel_mg
    lost = f", {event.lost} lost" if event.lost else ""
    lost += f", {event.alarms} with an error or alarm" if event.alarms else ""
    return (
        f"  {event.position!s:>16}   x {x:+9.2f}   y {y:+9.2f}   z {z:+9.2f} mg"
        f"   {counted(event.samples, 'sample')}{lost}"
    )


def turned(event: TurnMeasured) -> str:
    """The last turn, by what was asked, by gravity and by the gyro."""
    parts = [] if event.gravity_deg is None else [f"{event.gravity_deg:+.2f}° by gravity"]
    if event.gyro_deg is not None and event.gyro_u_deg is not None:
        parts.append(f"{event.gyro_deg:+.1f}° ± {event.gyro_u_deg:.1f}° by the gyro")
    asked = "" if event.asked_deg is None else f" ({event.asked_deg:+g}° asked)"
    return f"  turned {', '.join(parts)}{asked}"


def time_left(seconds: float) -> str:
    """About how long it still takes; empty for less than half a minute."""
    minutes = round(seconds / 60)
    return f" (about {minutes} min left)" if minutes else ""


def extension_offered(event: ExtensionOffered) -> tuple[list[tuple[str, str]], str]:
    """Lines with their style that say why more is asked for, and the question."""
    if event.blindness is not None:
        return [(event.blindness.message, "yellow")], "go on with 180° and 270°? (Enter yes, n no)"
    lines = [(f"{reason[0].upper()}{reason[1:]}.", "") for reason in event.reasons]
    return lines, "  Go on? (Enter yes, n no: end the session here)"


def advised(event: Advised) -> list[tuple[str, str]]:
    """Where the session stands, as lines with their style."""
    from adis_gonio.faces.cli.closing import standing

    lines = [(line, "") for line in standing(event.summary)]
    if not event.positions:
        closed = event.summary.get("adequate") and event.summary.get("tested")
        said = f"{event.ended[0].upper()}{event.ended[1:]}."
        lines.append((said, "green" if closed else "yellow"))
    return lines


LEAST_COLUMNS, LEAST_ROWS = 80, 24
"""The screen's; kept here too so that asking costs no import (a test compares them)."""


class Face(Protocol):
    """Runs a session and asks its operator."""

    def run(self) -> bool:
        """Run the session; return True where it is complete."""


def choose_face(runner: SessionRunner, prompts: Face, *, plain: bool, resume_by: str) -> Face:
    """The screen where it is wanted and possible, else the plain prompts; says why where that is news.

    Parameters
    ----------
    runner : SessionRunner
        Not run yet.
    prompts : Face
        Plain prompts for the same runner.
    plain : bool
        True where the screen is not wanted: `--plain`, or nobody is asked anything.
    resume_by : str
        Command that goes on with the session.
    """
    if plain or not _is_terminal():
        return prompts
    why_not = _why_not()
    if why_not:
        click.echo(f"plain prompts: {why_not}", err=True)
        return prompts
    from adis_gonio.faces.tui.face import ScreenFace

    return ScreenFace(runner, resume_by)


def _is_terminal() -> bool:
    """True where both ends are a terminal that can place its cursor and show the screen's signs."""
    if not (on_terminal() and sys.stderr.isatty()):
        return False
    encoding = (sys.stderr.encoding or "").lower().replace("-", "")
    return os.environ.get("TERM", "") not in ("", "dumb", "unknown") and encoding == "utf8"


def _why_not() -> str:
    """What the screen lacks in this terminal; empty where nothing."""
    if importlib.util.find_spec("textual") is None:
        return "the bench screen needs pip install 'adis-gonio[bench]'"
    size = shutil.get_terminal_size()
    if size.columns < LEAST_COLUMNS or size.lines < LEAST_ROWS:
        return (
            f"the bench screen needs {LEAST_COLUMNS} × {LEAST_ROWS} characters,"
            f" this terminal has {size.columns} × {size.lines}"
        )
    return ""
