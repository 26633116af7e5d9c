"""A bench session in plain lines: prompts and progress on standard error, answers from standard input.

`choose_face` decides between these prompts and the bench screen.
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
from rich.padding import Padding
from rich.text import Text

from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.bench import events
from adis_gonio.bench.guidance import drawing, to_do, turn_to_do
from adis_gonio.device.sensor.settings import compensations
from adis_gonio.faces.cli.show import WIDTH, console
from adis_gonio.faces.cli.trace_commands import loop_lines
from adis_gonio.faces.tui.bench_state import LEAST_SIZE
from adis_gonio.record.plans import GYRO_TURNS

if TYPE_CHECKING:
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.record.plans import Position

Actions = dict[str, Callable[[], None]]
"""Action of each key."""
StyledLines = list[tuple[str, str]]
"""Lines with their style."""

_KEYS = {"retake": "r", "keep": "k", "skip": "s", "reverse": "v"}
_MEANING = {"s": "skip", "r": "repeat the last", "u": "undo the last", "p": "pause", "q": "end"}
_GUARD_MEANING = {
    "r": "take the position again",
    "k": "keep it as it is",
    "s": "skip",
    "v": "reverse the whole session",
    "p": "pause",
    "q": "end",
}
_WHOLE_TURN_MEANING = {"r": "turn again", "v": "keep it, and turn the next one the other way"}


def on_terminal() -> bool:
    """True if standard input is a terminal, at which somebody types."""
    asks = getattr(sys.stdin, "isatty", None)
    return asks is not None and asks()


class Lines:
    """Reads standard input line by line, if wanted without waiting."""

    def __init__(self) -> None:
        self._kept = b""
        self._ended = False
        try:
            self._file: int | None = None if os.name == "nt" else sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # closed, or an object without a file descriptor
            self._file = None

    def next(self, *, wait: bool) -> str | None:
        """Return the next line, or None if there is none yet and `wait` is false.

        Without a file descriptor that can be polled, it always waits. `EOFError` follows the last line.
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
    """An open question: its text, the action of each key, and the action if the input ends."""

    text: str
    keys: Actions
    at_end: Callable[[], None]
    takes_notes: bool


class PlainBench:
    """Runs a session with prompts and progress as plain lines on a terminal."""

    def __init__(self, runner: SessionRunner, *, auto: bool) -> None:
        self._runner = runner
        self._auto = auto
        self._lines = Lines()
        self._question: _Question | None = None
        self._asking = False
        self._here: Position | None = None  # position of the part; unknown after an interrupted dwell
        self._drawn = False
        self._screen = console(stderr=True)

    def run(self) -> bool:
        """Run the session; return True if it is complete."""
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
        """Context in which the first Ctrl-C ends the session in order, so that no data are lost."""

        def interrupt(number: int, frame: Any) -> None:
            self._runner.stop()
            if self._asking:
                raise KeyboardInterrupt

        before = signal.signal(signal.SIGINT, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def _handle(self, event: events.Event) -> bool:
        """Show an event, or ask its question; return True if the session is complete."""
        match event:
            case events.Watching() if self._question is not None:
                self._listen(wait=False)
            case events.Watching() | events.DwellProgress() | events.Waiting() | events.TurnProgress():
                self._show_progress(*_progress_of(event))
            case events.Advising():
                if not self._screen.is_terminal:
                    self._say(f"tracing {counted(event.dwells, 'dwell')} …")
                self._show_progress("tracing", counted(event.dwells, "dwell"), None, None)
            case events.Finished():
                if not event.complete:
                    self._say(
                        f"  not complete: {event.done} of {event.total}; go on with --resume", "yellow"
                    )
                return event.complete
            case _:
                self._ask(event)
                self._report(event)
        return False

    # -- questions --------------------------------------------------------------------------------

    def _ask(self, event: events.Event) -> None:
        """Ask the operator a question, if the event is one."""
        match event:
            case events.PositionAsked() if not self._auto:
                self._ask_position(event)
            case events.GuardRaised():
                self._ask_guard(event)
            case events.RepetitionOffered():
                self._offer_repetition(event)
            case events.ExtensionOffered():
                self._offer_extension(event)
            case events.Paused():
                text = "paused: nothing is measured; Enter goes on, q ends"
                keys = {"": self._runner.unpause, "q": self._runner.stop}
                self._put(text, keys, self._runner.stop, notes=True, wait=True)
            case _:
                pass

    def _ask_position(self, event: events.PositionAsked) -> None:
        if not self._drawn:
            self._drawn = True
            for line in drawing(self._plan):
                self._say(f"    {line}")
        runner = self._runner
        keys: Actions = {"": runner.confirm, "s": runner.skip}
        if event.can_repeat:
            keys |= {"r": runner.repeat, "u": runner.undo}
        keys |= {"p": runner.pause, "q": runner.stop}
        if runner.one_recording:
            task = turn_to_do(max(self._plan.turns, 1))
        else:
            task = to_do(
                event.position,
                self._here,
                reverse=runner.reversed,
                fastest_dps=runner.fastest_dps,
                table=self._plan.name == GYRO_TURNS,
            )
        minutes = round(event.time_left_s / 60)
        remaining = f" (about {minutes} min left)" if minutes else ""
        number = f"{event.number} of {event.total}{remaining}"
        text = f"{number}: {task} and press Enter ({_explain(keys, _MEANING)})"
        self._put(text, keys, self._no_more_input, notes=True)

    def _ask_guard(self, event: events.GuardRaised) -> None:
        self._hide()
        self._say(f"  {event.message}", "bold yellow")

        def answering(name: str) -> Callable[[], None]:
            return lambda: self._runner.answer(name)

        keys: Actions = {"": answering(event.default)}
        keys |= {_KEYS[name]: answering(name) for name in event.answers}
        keys |= {"p": self._runner.pause, "q": self._runner.stop}
        meaning = _GUARD_MEANING | ({} if event.position.turned_deg is None else _WHOLE_TURN_MEANING)
        text = f"  Enter: {meaning[_KEYS[event.default]]} ({_explain(keys, meaning)})"
        self._put(text, keys, self._no_more_input, notes=True)

    def _offer_repetition(self, event: events.RepetitionOffered) -> None:
        where = ", ".join(str(position) for position in event.positions)
        if self._auto:
            self._say(f"  kept with an error or alarm: {where}", "yellow")
            return
        keys = {"": self._runner.accept, "n": self._runner.decline, "q": self._runner.stop}
        text = f"an error or alarm occurred at {where}: repeat? (Enter yes, n no: keep it, q end)"
        self._put(text, keys, self._no_more_input)

    def _offer_extension(self, event: events.ExtensionOffered) -> None:
        if event.blindness is not None:
            self._say_wrapped(event.blindness.message, "yellow")
            text = "go on with 180° and 270°? (Enter yes, n no)"
        else:
            for reason in event.reasons:
                self._say_wrapped(f"{reason[0].upper()}{reason[1:]}.")
            text = "  Go on? (Enter yes, n no: end the session here)"
        if not self._auto:
            decline = self._runner.decline
            self._put(text, {"": self._runner.accept, "n": decline, "q": decline}, decline)

    def _put(
        self,
        text: str,
        keys: Actions,
        at_end: Callable[[], None],
        *,
        notes: bool = False,
        wait: bool = False,
    ) -> None:
        """Open a question.

        If `wait` is set or the sensor's clock is simulated, the answer is waited for. A recording gives its
        own answers.
        """
        if self._runner.replayed:
            self._say(text)
            return
        self._progress.update(self._task, visible=False)
        self._progress.stop()
        self._question = _Question(text, keys, at_end, notes)
        self._prompt(text)
        while self._question is not None and (wait or self._runner.virtual_time):
            self._listen(wait=True)

    def _prompt(self, text: str) -> None:
        print(f"{text}: ", end="", file=sys.stderr, flush=True)  # noqa: T201

    def _listen(self, *, wait: bool) -> None:
        """Read a line and use it as the answer to the open question; do nothing if there is no line."""
        question, self._asking = self._question, wait
        if question is None:
            return
        try:
            line = self._lines.next(wait=wait)
        except EOFError:
            self._close(question.at_end)
            return
        except KeyboardInterrupt:
            self._close(self._runner.stop)
            return
        finally:
            self._asking = False
        if line is None:
            return
        key, _, rest = line.partition(" ")
        action = question.keys.get(key.lower()) if not rest else None
        if action is not None:
            self._close(action)
            return
        if question.takes_notes and key.lower() == "n":
            self._take_note(rest)
        else:
            known = ", ".join(key for key in question.keys if key)
            self._say(f"  '{line}' is no answer: press Enter, or one of {known}")
        self._prompt(question.text)

    def _take_note(self, text: str) -> None:
        if not text:
            self._prompt("  note")
            try:
                text = self._lines.next(wait=True) or ""
            except EOFError:
                text = ""
        self._runner.note(text)
        self._say("  noted" if text else "  nothing noted")

    def _close(self, action: Callable[[], None]) -> None:
        self._question = None
        self._progress.start()
        action()

    def _no_more_input(self) -> None:
        self._say("\nno more input: the session ends here, go on with --resume", "yellow")
        self._runner.stop()

    # -- lines that stay --------------------------------------------------------------------------

    def _report(self, event: events.Event) -> None:
        """Print the lines about an event that stay on the screen."""
        match event:
            case events.Started():
                self._plan = event.plan
            case events.TurnDone():
                self._hide()
            case events.DwellDone():
                self._here = event.position
                self._hide()
            case events.DwellInterrupted():
                self._here = None
            case events.TurnMeasured() | events.Running() if self._auto:
                return
            case events.Advised():
                self._hide()
                self._say("")
                for line, style in _advised(event):
                    self._say_wrapped(line, style)
            case _:
                pass
        for line, style in (*_measured(event), *_reported(event)):
            self._say(line, style)

    def _say(self, text: str, style: str = "") -> None:
        self._screen.print(text, style=style or None)

    def _say_wrapped(self, text: str, style: str = "") -> None:
        """Print a text, wrapped to the screen and indented by two columns."""
        width = min(self._screen.width, WIDTH)
        self._screen.print(Padding(Text(text, style=style), (0, 0, 0, 2)), width=width)

    # -- the line that moves ----------------------------------------------------------------------

    def _show_progress(self, what: str, note: str, done: float | None, total: float | None) -> None:
        self._progress.update(
            self._task,
            description=f"  {what:<9}",
            note=note,
            completed=done or 0,
            total=total,
            visible=True,
        )

    def _hide(self) -> None:
        """Remove the progress bar now instead of at its next refresh."""
        self._progress.update(self._task, visible=False)
        self._progress.refresh()


def _explain(keys: Actions, meaning: dict[str, str]) -> str:
    return ", ".join(f"{key} {meaning[key]}" for key in keys if key) + ", n note"


def _progress_of(
    event: events.Watching | events.DwellProgress | events.Waiting | events.TurnProgress,
) -> tuple[str, str, float | None, float | None]:
    """Content of the progress line: activity, note, elapsed time and length in s."""
    if isinstance(event, events.Watching):
        note = f"spread {max(event.spread_mg):.2f} mg"
        if event.limit_mg is not None:
            note += f" (still below {min(event.limit_mg):.2f})"
        if event.angle_deg is not None:
            note += f", {event.angle_deg:+.2f}°"
        return event.state, note, None, None
    what = "dwell" if isinstance(event, events.DwellProgress) else "waiting"
    note = f"{event.elapsed_s:.0f} of {event.length_s:.0f} s"
    if isinstance(event, events.TurnProgress):
        turn = "turn" if event.turns == 1 else f"turn {event.turn} of {event.turns}"
        what = {"rest": "at rest", "turn": turn, "after": "let rest"}[event.state]
        note = f"{event.turned_deg:+.0f}°, {event.rate_dps:+.1f} °/s, {event.elapsed_s:.0f} s"
    return what, note, event.elapsed_s, event.length_s


def _measured(event: events.Event) -> StyledLines:
    """Lines about a measured result; empty for an event without one."""
    match event:
        case events.NoiseMeasured():
            noise = ", ".join(f"{value:.2f}" for value in event.noise_mg)
            return [(f"  noise at rest {noise} mg (x, y, z)", "")]
        case events.TurnMeasured():
            parts = [] if event.gravity_deg is None else [f"{event.gravity_deg:+.2f}° by gravity"]
            if event.gyro_deg is not None and event.gyro_u_deg is not None:
                parts.append(f"{event.gyro_deg:+.1f}° ± {event.gyro_u_deg:.1f}° by the gyro")
            asked = "" if event.asked_deg is None else f" ({event.asked_deg:+g}° asked)"
            return [(f"  turned {', '.join(parts)}{asked}", "")]
        case events.TurnDone():
            lost = f", {event.lost} lost" if event.lost else ""
            turns = f"{counted(event.turns, 'full turn')}, {event.travelled_deg:.0f}° in all,"
            return [(f"  {turns} in {event.length_s:.0f} s, {event.samples} scans{lost}", "")]
        case events.DwellDone():
            x, y, z = event.accel_mg
            lost = f", {event.lost} lost" if event.lost else ""
            lost += f", {event.alarms} with an error or alarm" if event.alarms else ""
            mean = f"x {x:+9.2f}   y {y:+9.2f}   z {z:+9.2f} mg"
            return [(f"  {event.position!s:>16}   {mean}   {counted(event.samples, 'sample')}{lost}", "")]
        case events.Running():
            known = {name: event.parameters.get(name) for name in ("delta_k", "delta_phi")}
            values = [
                f"{name} {format_uncertain(entry['value'], entry['u'], entry['unit'])}"
                for name, entry in known.items()
                if entry is not None
            ]
            return [(f"  so far: {', '.join(values)}", "")] if values else []
    return []


def _reported(event: events.Event) -> StyledLines:
    """Lines about the course of the session; empty for other events."""
    match event:
        case events.Started():
            what = "resumed" if event.resumed else "begun"
            shape = counted(len(event.plan), "position")
            lines = [(f"{event.plan.name} {what}, {shape}, {event.variant} on {event.url}", "")]
            return [*lines, (f"  {event.done} of them done", "")] if event.resumed else lines
        case events.Configured():
            return [(line, "") for line in configuration_lines(event)]
        case events.DwellInterrupted():
            return [(f"  dwell at {event.position} interrupted: {event.reason} (samples kept)", "yellow")]
        case events.Problem():
            return [(f"  {event.message}", "yellow")]
        case events.Withdrawn():
            return [(f"  the dwell at {event.position} is withdrawn (samples kept)", "yellow")]
    return []


def configuration_lines(event: events.Configured) -> list[str]:
    """Lines about the configuration of the sensor.

    They state rate, filter, changed registers, the chip's compensations, and why it is polled.
    """
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


def _advised(event: events.Advised) -> StyledLines:
    """Lines about the state of the model, and the reason if no further positions are proposed."""
    lines = [(line, "") for line in loop_lines(event.summary)]
    if not event.positions:
        closed = event.summary.get("adequate") and event.summary.get("tested")
        ended = f"{event.ended[0].upper()}{event.ended[1:]}."
        lines.append((ended, "green" if closed else "yellow"))
    return lines


class Face(Protocol):
    """Interface of front ends, which run a session and ask its operator."""

    def run(self) -> bool:
        """Run the session; return True if it is complete."""


def choose_face(runner: SessionRunner, prompts: Face, *, plain: bool, resume_by: str) -> Face:
    """Return the full-screen front end if it is wanted and possible, else the plain prompts.

    A message explains why a terminal gets plain prompts although the screen was wanted.

    Parameters
    ----------
    runner : SessionRunner
        Not run yet.
    prompts : Face
        Plain prompts for the same runner.
    plain : bool
        True if the screen is not wanted: `--plain`, or a session without questions.
    resume_by : str
        Command that resumes the session.
    """
    encoding = (getattr(sys.stderr, "encoding", None) or "").lower().replace("-", "")
    able = os.environ.get("TERM", "") not in ("", "dumb", "unknown") and encoding == "utf8"
    if plain or not (able and on_terminal() and sys.stderr.isatty()):
        return prompts
    size = shutil.get_terminal_size()
    missing = ""
    if importlib.util.find_spec("textual") is None:
        missing = "the bench screen needs pip install 'adis-gonio[bench]'"
    elif size.columns < LEAST_SIZE[0] or size.lines < LEAST_SIZE[1]:
        least = f"{LEAST_SIZE[0]} × {LEAST_SIZE[1]} characters"
        missing = f"the bench screen needs {least}, this terminal has {size.columns} × {size.lines}"
    if missing:
        click.echo(f"plain prompts: {missing}", err=True)
        return prompts
    from adis_gonio.faces.tui.bench_screen import ScreenFace

    return ScreenFace(runner, resume_by)
