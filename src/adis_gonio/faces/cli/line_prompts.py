"""A bench session in plain lines: prompts and progress on standard error, answers from standard input.

`can_show_screen` decides between these prompts and the bench screen.
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
from functools import partial
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import install_extra
from adis_gonio.base.numbers import counted, signed
from adis_gonio.base.tables import fold_text
from adis_gonio.bench import events
from adis_gonio.bench.guidance import drawing, to_do, turn_to_do
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.cli.show import console, print_indented, say
from adis_gonio.faces.cli.terminal import on_terminal
from adis_gonio.faces.cli.trace_commands import loop_line
from adis_gonio.faces.tui import screen_text
from adis_gonio.faces.tui.bench_state import LEAST_SIZE, BenchState
from adis_gonio.record.plans import GYRO_TURNS
from adis_gonio.record.session_reader import FREE_TURN

if TYPE_CHECKING:
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.faces.free_hands import Hands

Actions = dict[str, Callable[[], None]]
"""Action of each key; the Enter key is an empty text."""


class Lines:
    """Reads standard input line by line, with or without waiting for a line."""

    def __init__(self) -> None:
        self._kept = b""
        self._ended = False
        try:
            self._file: int | None = None if os.name == "nt" else sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # closed, or an object without a file descriptor
            self._file = None

    def next(self, *, wait: bool) -> str | None:
        """Return the next line of standard input, or None if `wait` is false and no line has arrived.

        It always waits if standard input has no file descriptor that can be polled. It raises `EOFError`
        after the last line.
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
    """A question that waits for an answer: its text, the action of each key, and if notes may be typed."""

    text: str
    keys: Actions
    takes_notes: bool


class PlainBench:
    """Runs a session with prompts and progress as plain lines on a terminal."""

    def __init__(self, runner: SessionRunner, *, auto: bool, hands: Hands | None = None) -> None:
        self._runner = runner
        self._auto = auto
        self._hands = hands
        self._lines = Lines()
        self._question: _Question | None = None
        self._asking = False
        self._state = BenchState()
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
            for event in self._runner.run(so_far=not self._auto):
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
        self._state.take(event)
        match event:
            case events.Watching() if self._question is not None:
                self._listen(wait=False)
            case events.Watching() | events.DwellProgress() | events.Waiting() | events.TurnProgress():
                self._show_progress()
            case events.Advising():
                if not self._screen.is_terminal:
                    self._say(f"tracing {counted(event.dwells, 'dwell')} …")
                self._show_progress()
            case _:
                self._ask(event)
                self._report(event)
        return isinstance(event, events.Finished) and event.complete

    # -- questions --------------------------------------------------------------------------------

    def _ask(self, event: events.Event) -> None:
        """Ask the operator the question of an event; do nothing if the event contains no question."""
        match event:
            case events.PositionAsked() if not self._auto:
                self._ask_position(event)
            case events.GuardRaised():
                self._hide()
                print_indented(self._screen, event.message, style="bold yellow")
                meaning = words.answers_to(event)[event.default].meaning
                self._put(f"  {words.ENTER}: {meaning}", event)
            case events.ExtensionOffered():
                reason, offer = words.reason_of(event, len(self._plan))
                print_indented(self._screen, reason, style="yellow")
                if not self._auto:
                    self._put(f"  {offer}", event)
            case events.Paused():
                text = f"paused: nothing is measured; {words.ENTER} goes on"
                keys = {"": self._runner.unpause, "p": self._runner.unpause, "q": self._runner.stop}
                self._open(text, keys, wait=True)

    def _ask_position(self, event: events.PositionAsked) -> None:
        if not self._drawn:
            self._draw()
        if self._plan.name == FREE_TURN:
            task = turn_to_do(max(self._plan.turns, 1))
        else:
            task = to_do(
                event.position,
                self._state.here,
                reverse=self._runner.reversed,
                fastest_dps=self._runner.fastest_dps,
                table=self._plan.name == GYRO_TURNS,
            )
        text = f"{words.position_count(event)}: {task} and press {words.ENTER}"
        self._put(text, event)

    def _draw(self) -> None:
        self._drawn = True
        for line in drawing(self._plan):
            self._say(f"    {line}")

    def _put(self, text: str, question: words.Question) -> None:
        """Show a question of the session runner as `text` with its keys, and accept answers to it."""
        known, answer = words.answers_to(question), self._runner.answer
        keys: Actions = {"": partial(answer, words.default_of(question))}
        keys |= {
            key.letter: partial(answer, name) for name, key in known.items() if key.letter != words.ENTER
        }
        offers = isinstance(question, events.ExtensionOffered)
        keys |= {} if offers else {words.PAUSE.letter: self._runner.pause}
        listed = [key for key in known.values() if key.letter != words.ENTER]
        listed += [] if offers else [words.PAUSE, words.NOTE]
        listed += [words.MOVE, words.BUMP] if self._hands else []
        shown = ", ".join(f"{key.letter} {key.word}" for key in (*listed, words.HELP))
        self._open(f"{text} ({shown})", keys, takes_notes=not offers)

    def _open(self, text: str, keys: Actions, *, takes_notes: bool = True, wait: bool = False) -> None:
        """Show the question `text`, and accept its answers; `keys` has the action of each key.

        The method waits for the answer if `wait` is True or the sensor's clock is simulated. In the replay
        of a recording it only prints the text, because the recording has the answers. If `takes_notes` is
        True, the operator may also type notes.
        """
        if self._runner.bench.replayed:
            self._say(text)
            return
        self._progress.update(self._task, visible=False)
        self._progress.stop()
        self._question = _Question(text, keys, takes_notes)
        self._prompt(text)
        while self._question is not None and (wait or self._runner.bench.virtual_time):
            self._listen(wait=True)

    def _prompt(self, text: str) -> None:
        if self._screen.is_terminal:  # a terminal would break words
            text = "\n".join(fold_text(text, self._screen.width - 3, 2)).removeprefix("  ")
        print(f"{text}: ", end="", file=sys.stderr, flush=True)  # noqa: T201

    def _listen(self, *, wait: bool) -> None:
        """Read a line and use it as the answer to the open question; do nothing if there is no line.

        `wait` is True to wait for a line.
        """
        question = self._question
        if question is None:
            return
        try:
            line = self._read_line(wait=wait)
            if line is None:
                return
            key, _, rest = line.partition(" ")
            action = question.keys.get(key.lower()) if not rest else None
            if action is None:
                self._obey(line, key.lower(), rest, question)
                self._prompt(question.text)
                return
        except (EOFError, KeyboardInterrupt) as error:
            if isinstance(error, EOFError):
                self._screen.print("\nno more input: the session ends here", style="yellow")
            action = self._runner.stop
        self._close(action)

    def _read_line(self, *, wait: bool) -> str | None:
        """Return the next line like `Lines.next`; while this method waits, Ctrl-C ends it."""
        self._asking = wait
        try:
            return self._lines.next(wait=wait)
        finally:
            self._asking = False

    def _obey(self, line: str, key: str, rest: str, question: _Question) -> None:
        """Carry out a line that is no answer to the question.

        The line may give a note, request a drawing or help, or move a simulated part; any other line gives
        a message.

        `key` is the first word of the line, `rest` the remaining text.
        """
        if key == words.NOTE.letter and question.takes_notes:
            text = self._rest_of(rest, "  note")
            self._runner.note(text)
            self._say("  noted" if text else "  nothing noted")
        elif line == words.HELP.letter:
            for text in words.help_lines(hands=self._hands is not None):
                self._say(f"  {text}")
        elif line == words.DRAW.letter:
            self._draw()
        elif self._hands is not None and line == words.BUMP.letter:
            self._say(f"  {self._hands.bump()}")
        elif self._hands is not None and key == words.MOVE.letter:
            self._say(f"  {self._hands.move(self._rest_of(rest, '  degrees'))}")
        else:
            notes = (words.NOTE.letter,) if question.takes_notes else ()
            known = ", ".join((*filter(None, question.keys), *notes))
            self._say(f"  '{line}' is no answer: press Enter, or one of {known} (? lists them)")

    def _rest_of(self, text: str, asked: str) -> str:
        """Return `text`, the text after a key on its line.

        If it is empty, show the prompt `asked` and return the next line of standard input.
        """
        if text:
            return text
        self._prompt(asked)
        return self._read_line(wait=True) or ""

    def _close(self, action: Callable[[], None]) -> None:
        self._question = None
        self._progress.start()
        action()

    # -- lines that stay --------------------------------------------------------------------------

    def _report(self, event: events.Event) -> None:
        """Print the lines about an event that stay on the screen."""
        match event:
            case events.Started():
                self._plan = event.plan
            case events.TurnDone() | events.DwellDone() | events.DwellInterrupted():
                self._hide()
            case events.Advised():
                self._hide()
                if event.summary:
                    self._say(f"\n{loop_line(event.summary)}")
            case events.Noted() if not self._runner.bench.replayed:
                return  # confirmed when it was typed; a line now would hide the prompt
        results = [] if self._auto else words.lines_of_result(event)
        for line, level in [*words.lines_about(event), *results]:
            print_indented(self._screen, line, style="yellow" if level == "warned" else "")

    def _say(self, text: str) -> None:
        self._screen.print(text)

    # -- the line that moves ----------------------------------------------------------------------

    def _show_progress(self) -> None:
        """Show the activity, with a bar if it has a length, else with stillness and angle of the part."""
        state, span = self._state, self._state.span
        note = screen_text.progress(state, 0) or screen_text.stillness(state, 0)
        if span is None and state.angle_deg is not None:
            note += f" {signed(state.angle_deg, 2)}°"
        self._progress.update(
            self._task,
            description=f"  {state.doing}",
            note="" if state.quiet else note,
            completed=0 if span is None else span.elapsed_s,
            total=None if span is None else span.length_s,
            visible=True,
        )

    def _hide(self) -> None:
        """Remove the progress bar now instead of at its next refresh."""
        self._progress.update(self._task, visible=False)
        self._progress.refresh()


def can_show_screen() -> bool:
    """Return True if the terminal can show a session on the full screen, else it needs plain prompts.

    A message explains why a terminal gets plain prompts.
    """
    encoding = (getattr(sys.stderr, "encoding", None) or "").lower().replace("-", "")
    able = os.environ.get("TERM", "") not in ("", "dumb", "unknown") and encoding == "utf8"
    if not (able and on_terminal() and sys.stderr.isatty()):
        return False
    size = shutil.get_terminal_size()
    missing = ""
    if importlib.util.find_spec("textual") is None:
        missing = f"the bench screen needs textual: {install_extra('bench')}"
    elif size.columns < LEAST_SIZE[0] or size.lines < LEAST_SIZE[1]:
        least = f"{LEAST_SIZE[0]} × {LEAST_SIZE[1]} characters"
        missing = f"the bench screen needs {least}, this terminal has {size.columns} × {size.lines}"
    if missing:
        say(f"plain prompts: {missing}")
    return not missing
