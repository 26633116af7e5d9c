"""The screen of a session, and its dialogs.

The screen shows a `BenchState`, and passes the operator's keys to the session's runner in its thread.
Dialogs ask the questions of guards (checks of a dwell), offer more positions, ask if the session
is to end, take a note, and show help. All of them work by keys alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from rich.table import Table
from rich.text import Text
from textual import events as ui
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.geometry import Size
from textual.screen import ModalScreen, Screen
from textual.widget import Widget
from textual.widgets import Input, Static

from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.bench import events
from adis_gonio.bench.guidance import drawing
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.bench_words import BenchKey
from adis_gonio.faces.free_hands import Hands
from adis_gonio.faces.tui import screen_text
from adis_gonio.faces.tui.bench_state import LEAST_SIZE, BenchState
from adis_gonio.faces.tui.screen_text import format_measured
from adis_gonio.record.archive import ArchiveView

Result = TypeVar("Result")


class _Box(ModalScreen[Result]):
    """A heading with widgets below it, which closes only once even if several keys follow quickly."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("ctrl+c,ctrl+q", "app.stop_now", show=False, priority=True)
    ]
    _has_result = False

    def __init__(self, heading: str, *content: Widget, hint: str) -> None:
        super().__init__()
        top = Static(Text(heading, style="bold"), id="heading")
        self._content = (top, *content, Static(Text(hint, style="dim")))

    def compose(self) -> ComposeResult:
        """Create the box with its widgets."""
        yield Vertical(*self._content, id="box")

    def finish(self, result: Result | None = None) -> None:
        """Close the dialog with a result, None for none; later calls do nothing."""
        if not self._has_result:
            self._has_result = True
            self.dismiss(result)


class Dialog(_Box[str]):
    """Dialog that asks a question and offers answers; Enter gives the selected answer.

    Parameters
    ----------
    heading, text : str
        The question and its reason.
    choices : mapping of str to BenchKey
        Keys of the answers, by name of the answer.
    default : str
        Answer that is selected at first.
    rows : sequence of (str, str)
        Names and values of the measured numbers.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,shift+tab", "move(-1)", show=False),
        Binding("down,tab", "move(1)", show=False),
        Binding("enter", "choose", show=False),
    ]

    def __init__(
        self,
        heading: str,
        text: str,
        choices: Mapping[str, BenchKey],
        default: str,
        rows: Sequence[tuple[str, str]] = (),
    ) -> None:
        width = max((len(name) for name, _ in rows), default=0)
        values = Text("\n".join(f"{name:<{width}}  {value}" for name, value in rows))
        content = [Static(Text(text), id="text"), *([Static(values, id="values")] if rows else [])]
        hint = "Enter takes ▶, ↑ ↓ move it, a letter answers at once"
        super().__init__(heading, *content, Static(id="choices"), hint=hint)
        self._choices = list(choices.items())
        self._default = default
        self._at = list(choices).index(default) if default in choices else 0

    def on_mount(self) -> None:
        """Show the answers when the dialog is ready."""
        text = Text()
        for number, (answer, key) in enumerate(self._choices):
            here = number == self._at
            line = f"{'▶' if here else ' '} {key.letter}  {key.meaning}"
            if answer == self._default:
                line += " (default)"
            text.append(line + "\n", style="bold reverse" if here else "")
        text.rstrip()
        self.query_one("#choices", Static).update(text)

    def action_move(self, step: int) -> None:
        """Select the next answer (step 1) or the previous one (step −1)."""
        self._at = (self._at + step) % len(self._choices)
        self.on_mount()

    def action_choose(self) -> None:
        """Close the dialog with the selected answer."""
        self.finish(self._choices[self._at][0])

    def on_key(self, event: ui.Key) -> None:
        """Close the dialog with the answer that has this letter."""
        for answer, key in self._choices:
            if event.character and event.character in (key.letter, key.also):
                event.stop()
                self.finish(answer)
                return


class LineDialog(_Box[str]):
    """Dialog in which the operator types a line, such as a note; after a cancel the result is empty."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "finish('')", show=False)]

    def __init__(self, heading: str, hint: str) -> None:
        super().__init__(
            heading, Input(placeholder=hint, id="note"), hint="Enter takes it, Esc gives it up"
        )

    def action_finish(self, line: str) -> None:
        """Close the dialog with a line."""
        self.finish(line)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Close the dialog with the typed line."""
        self.finish(event.value)


class HelpDialog(_Box[None]):
    """Dialog with a text to read, such as the keys; any key closes it."""

    def __init__(self, heading: str, text: str) -> None:
        super().__init__(heading, Static(Text(text), id="text"), hint="any key closes this")

    def on_key(self, event: ui.Key) -> None:
        """Close the dialog at any key."""
        event.stop()
        self.finish()


QUIT = {
    "stop": BenchKey("y", "yes", "quit here", also="q"),
    "stay": BenchKey("n", "no", "go on with the session"),
}
"""Keys of the answers to the question whether the session is to end, by the name of the answer."""

LARGE_SIZE = (120, 40)
"""Smallest terminal, in columns and rows, on which the digits of the angle have double size."""


class BenchApp(App[None]):
    """The textual application that shows a session and passes on the operator's answers.

    Parameters
    ----------
    runner : SessionRunner
        Runner of the session, which has not started.
    resume_by : str
        Command that resumes the session.
    hands : Hands, optional
        Simulated part that the operator's keys move; None for a real part.

    Attributes
    ----------
    state : BenchState
        State of the session on the screen.
    error : BaseException or None
        Exception that ended the runner; None if none did.
    crash : Exception or None
        Exception of the screen itself; None if none occurred.
    abandoned : bool
        True if the operator did not wait for the runner's end.
    killed : bool
        True if a signal (SIGTERM, SIGINT, SIGHUP) ended the session in order.
    """

    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("enter", "answer_position('confirm')", show=False),
        Binding("r", "answer_position('repeat')", show=False),
        Binding("s", "answer_position('skip')", show=False),
        Binding("u", "answer_position('undo')", show=False),
        Binding("p", "pause", show=False),
        Binding("n", "note", show=False),
        Binding("q", "ask_to_quit", show=False),
        Binding("d", "draw", show=False),
        Binding("m", "move", show=False),
        Binding("b", "bump", show=False),
        Binding("question_mark,f1,h", "explain", show=False),
        Binding("ctrl+c,ctrl+q", "stop_now", show=False, priority=True),
    ]
    CSS = """
    Screen { layout: vertical; overflow: hidden; }
    #title { height: 1; background: $primary; color: $text; text-style: bold; padding: 0 1; }
    #body { height: 1fr; }
    #side { width: 30; height: 100%; border-right: solid $secondary; }
    #plan { height: 1fr; padding: 0 1; }
    #link { height: auto; max-height: 7; padding: 0 1; border-top: solid $secondary; }
    #right { width: 1fr; padding: 0 1; }
    #task { height: auto; max-height: 3; text-style: bold; color: $warning; }
    #angle { height: auto; margin: 1 0 0 0; }
    #target { height: 1; text-style: bold; margin: 0 0 1 0; }
    #still { height: 1; }
    #waits, #progress { height: auto; max-height: 2; }
    #facts { height: auto; margin: 1 0 0 0; }
    #messages { height: 1fr; border-top: solid $secondary; }
    #keys { height: 1; background: $panel; padding: 0 1; }
    #small { display: none; padding: 1; }
    .small #small { display: block; }
    .small #body { display: none; }
    .large #side { width: 40; }
    ModalScreen { align: center middle; }
    #box { width: 78; height: auto; max-height: 24; border: thick $warning; background: $surface;
           padding: 0 2; }
    #box > Static { height: auto; margin: 0 0 1 0; }
    #box > Static:last-of-type { margin: 0; }
    """

    def __init__(self, runner: SessionRunner, resume_by: str, hands: Hands | None = None) -> None:
        super().__init__()
        self.state = BenchState()
        self.state.hands = hands is not None
        self._hands = hands
        self.error: BaseException | None = None
        self.crash: Exception | None = None
        self.abandoned = self.killed = False
        self._runner = runner
        self._resume_by = resume_by
        self._events: queue.SimpleQueue[events.Event] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._work, name="session", daemon=True)
        self._ended = threading.Event()
        self._stopping = self._drawn = False
        self._news_s = time.monotonic()
        self._asked: events.Event | None = None
        self._open_question: Dialog | None = None

    # -- the runner, in its thread ------------------------------------------------------------------

    def _work(self) -> None:
        looked_s = 0.0
        try:
            for event in self._runner.run():
                self._events.put(event)
                if isinstance(event, events.Watching) and event.state == "idle":
                    # During a question a simulated sensor itself does not wait between two readings.
                    time.sleep(max(0.0, looked_s + 0.05 - time.monotonic()))
                    looked_s = time.monotonic()
        except BaseException as error:
            self.error = error
        finally:
            self._ended.set()

    def wait(self) -> None:
        """Wait until the runner has ended, after the screen has closed."""
        if self._worker.is_alive():
            self._worker.join()

    # -- showing ------------------------------------------------------------------------------------

    def compose(self) -> ComposeResult:
        """Create the widgets of the screen."""
        yield Static(id="title")
        yield Static(id="small")
        with Horizontal(id="body"):
            with Vertical(id="side"):
                yield Static(id="plan")
                yield Static(id="link")
            with Vertical(id="right"):
                for name in ("task", "angle", "target", "still", "waits", "progress", "facts", "messages"):
                    yield Static(id=name)
        yield Static(id="keys")

    def on_mount(self) -> None:
        """Start the session when the screen is ready."""
        # Signals end the session as Ctrl-C does, so that the terminal is restored.
        loop = asyncio.get_running_loop()
        for name in ("SIGTERM", "SIGINT", "SIGHUP"):
            with contextlib.suppress(AttributeError, NotImplementedError, RuntimeError, ValueError):
                loop.add_signal_handler(getattr(signal, name), self._kill)
        self._worker.start()
        self.set_interval(0.1, self.tick)

    def _kill(self) -> None:
        self.killed = True
        self._stop()

    def on_resize(self, event: ui.Resize) -> None:
        """Choose the layout of the screen for its new size."""
        width, height = event.size
        base = self.screen_stack[0]
        base.set_class(width < LEAST_SIZE[0] or height < LEAST_SIZE[1], "small")
        base.set_class(width >= LARGE_SIZE[0] and height >= LARGE_SIZE[1], "large")
        self.call_after_refresh(self.show)

    def terminal_size(self) -> Size:
        """Return the size of the terminal, independent of signals and of COLUMNS and LINES."""
        if self.is_headless or sys.__stderr__ is None:
            return self.size
        try:
            return Size(*os.get_terminal_size(sys.__stderr__.fileno()))
        except (OSError, ValueError):  # no terminal
            return self.size

    def tick(self) -> None:
        """Process the runner's new events, and update the screen."""
        if (size := self.terminal_size()) != self.size:
            self.post_message(ui.Resize(size, size))
        ended = self._ended.is_set()  # read before the queue is emptied, because no event follows the end
        while not self._events.empty():
            event = self._events.get_nowait()
            self._news_s = time.monotonic()
            self.state.take(event)
            if isinstance(event, events.Started) and event.resumed:
                remember(self.state, event.path)
        self.state.reversed = self._runner.reversed
        self.show()
        if ended:
            self.exit()
            return
        self._ask()

    def show(self) -> None:
        """Update all widgets by the state of the session."""
        if not self.is_running:
            return
        base, state = self.screen_stack[0], self.state
        room = base.query_one("#right").content_size.width
        large = base.has_class("large")
        rows, side = base.query_one("#plan").content_size.height, base.query_one("#link").content_size.width
        silence_s = time.monotonic() - self._news_s
        plan = Text(no_wrap=True, overflow="ellipsis")
        for line, style in screen_text.plan_rows(state, rows):
            plan.append(f"{line}\n", style=style)
        messages = Text()
        for message, level in reversed(state.messages):  # the newest first: the oldest are cut off
            messages.append(f"{message}\n", style="yellow" if level == "warned" else "")
        size = f"{LEAST_SIZE[0]} × {LEAST_SIZE[1]}"
        small = f"This screen needs {size}, the terminal has {self.size.width} × {self.size.height}."
        texts: dict[str, Text] = {
            "title": Text(screen_text.title(state), no_wrap=True, overflow="ellipsis"),
            "small": Text(f"{small} The session goes on: make it larger, or press q to quit."),
            "plan": plan,
            "link": Text("\n".join(screen_text.surroundings(state, side, silence_s))),
            "task": Text(screen_text.task(state)),
            "angle": Text("\n".join(screen_text.large_angle(state.angle_deg, 2 if large else 1))),
            "target": Text(screen_text.target(state), no_wrap=True),
            "still": Text(screen_text.stillness(state, room), no_wrap=True, style=_still_style(state)),
            "waits": Text(screen_text.waiting(state, silence_s)),
            "progress": Text(screen_text.progress(state, room), no_wrap=True),
            "messages": messages,
            "keys": _keys(state, self.size.width),
        }
        for name, text in texts.items():
            base.query_one(f"#{name}", Static).update(text)
        facts = Table.grid(padding=(0, 2, 0, 0))
        for name, value in screen_text.facts(state):
            facts.add_row(Text(name, style="dim"), Text(value))
        base.query_one("#facts", Static).update(facts)

    # -- asking -------------------------------------------------------------------------------------

    def _ask(self) -> None:
        """Open the dialog of a new question of the runner; close the dialog of a withdrawn question."""
        question = self.state.question
        if self._open_question is not None and question is not self._asked:
            gone, self._open_question = self._open_question, None
            if gone in self.screen_stack:
                gone.finish("")
            return
        if question is self._asked or len(self.screen_stack) > 1:
            return
        dialog: Dialog | None = None
        match question:
            case events.GuardRaised():
                heading = f"{question.position}: {question.kind.replace('_', ' ')}"
                rows = [format_measured(name, value) for name, value in question.values.items()]
                choices = words.answers_to(question)
                dialog = Dialog(heading, question.message, choices, question.default, rows)
            case events.ExtensionOffered():
                planned = 0 if self.state.plan is None else len(self.state.plan)
                reason, offer = words.reason_of(question, planned)
                dialog = Dialog(offer, reason, words.answers_to(question), words.default_of(question))
            case events.PositionAsked() if not (self.state.zero_known or self._drawn):
                self.action_draw()
        self._asked = question
        if dialog is not None:
            self._open_question = dialog
            self.push_screen(dialog, self._give)

    def _give(self, answer: str | None) -> None:
        """Pass an answer of a dialog to the runner; an answer that comes too late gives a message.

        None or `stay` passes nothing.
        """
        self._open_question = None
        if not answer or answer == "stay":
            return
        if answer == "stop":
            self._stop()
            return
        try:
            self._runner.answer(answer)
        except UsageError:
            self.state.say("that question has gone: nothing was answered")
            return
        if answer == "accept" and isinstance(self.state.question, events.ExtensionOffered):
            self.state.plan = self.state.question.plan
        self.state.answered(answer)
        self.show()

    # -- keys ---------------------------------------------------------------------------------------

    def action_answer_position(self, answer: str) -> None:
        """Answer the runner's question about a position, or report why that is not possible.

        `answer` is the name of the answer.
        """
        question = self.state.question
        if not isinstance(question, events.PositionAsked):
            self.state.say("no position is asked for now")
        elif answer not in words.answers_to(question):
            self.state.say("there is no dwell before this one")
        else:
            self._give(answer)
        self.show()

    def action_pause(self) -> None:
        """Pause the session, or continue it after a pause."""
        if self.state.paused:
            self._runner.unpause()
        else:
            self._runner.pause()
            self.state.doing = "pausing"
        self.show()

    def action_note(self) -> None:
        """Open the dialog for a note."""

        def keep(text: str | None) -> None:
            if text:
                self._runner.note(text)

        self._open(LineDialog("Note", "saved in the session with its time and position"), keep)

    def action_move(self) -> None:
        """Ask for an angle, and turn a simulated part without a stage by it."""
        if (hands := self._hands) is not None:
            dialog = LineDialog("Turn the part by … degrees", "such as -30")
            self._open(dialog, lambda text: self._tell(hands.move(text)) if text else None)

    def action_bump(self) -> None:
        """Turn a simulated sensor without a stage a little, forth and back, as by a bump."""
        if self._hands is not None:
            self._tell(self._hands.bump())

    def _tell(self, text: str) -> None:
        self.state.say(text)
        self.show()

    def action_explain(self) -> None:
        """Show the help on keys and signs."""
        self._open(HelpDialog("Keys and signs", screen_text.help_text(self.state)), lambda _: None)

    def action_draw(self) -> None:
        """Show a drawing of the way to hold the sensor."""
        if self.state.plan is not None:
            self._drawn = True
            text = "\n".join(drawing(self.state.plan))
            self._open(HelpDialog("How the part is held", text), lambda _: None)

    def action_ask_to_quit(self) -> None:
        """Ask if the session is to end."""
        text = f"The recorded data stay. Go on later with\n  {self._resume_by}"
        self._open(Dialog("Quit the session?", text, QUIT, "stay"), self._give)

    def _open(self, screen: Screen[Any], then: Callable[..., None]) -> None:
        if len(self.screen_stack) == 1:
            self.push_screen(screen, then)

    def action_stop_now(self) -> None:
        """End the session in order; if called a second time, leave at once."""
        if self._stopping:
            self.abandoned = True
            self.exit()
        self._stop()

    def _stop(self) -> None:
        self._stopping = True
        self._runner.stop()
        self.state.answered()
        self.state.doing = "ending the session"
        self.show()

    def _handle_exception(self, error: Exception) -> None:
        """Close the screen without a traceback; `run_screen` reports the error afterwards."""
        self.crash = self.crash or error
        self._runner.stop()
        super()._handle_exception(error)
        self._exit_renderables.clear()


def _still_style(state: BenchState) -> str:
    if state.spread_mg is None or state.limit_mg is None:
        return "dim"
    return "green" if state.spread_mg <= state.limit_mg else "bold red"


def _keys(state: BenchState, width: int) -> Text:
    listed = screen_text.keys(state)
    text = Text(no_wrap=True)
    wide = sum(len(f"{key} {word}  ") for key, word in listed) < width
    for key, word in listed:
        text.append(key, style="bold reverse")
        text.append(f" {word}  " if wide else f" {word} ")
    return text


def run_screen(runner: SessionRunner, resume_by: str, hands: Hands | None = None) -> bool:
    """Run a session on the full-screen display; return True if it is complete.

    Parameters
    ----------
    runner : SessionRunner
        Runner of the session, which has not started.
    resume_by : str
        Command that resumes the session.
    hands : Hands, optional
        Simulated part that the operator's keys move; None for a real part.

    Raises
    ------
    SessionError
        The screen itself failed; the recorded data are kept.
    Exception
        Any error of the runner.
    KeyboardInterrupt
        The operator did not wait for the session's end, or a signal ended it.
    """
    app = BenchApp(runner, resume_by, hands)
    try:
        app.run(mouse=False)
    finally:
        runner.stop()
        if not app.abandoned:
            app.wait()
    for message, _ in app.state.messages:
        print(f"  {message}", file=sys.stderr)  # noqa: T201
    if app.abandoned or app.killed:
        raise KeyboardInterrupt
    if app.crash is not None:
        name = type(app.crash).__name__
        raise SessionError(
            f"the screen failed ({name}: {app.crash}); go on with {resume_by} --plain"
        ) from app.crash
    if app.error is not None:
        raise app.error
    finished = app.state.latest(events.Finished)
    return finished is not None and finished.complete


def remember(state: BenchState, path: str) -> None:
    """Mark the positions of a resumed session (`path`) that earlier runs have done or skipped."""
    with ArchiveView(path) as view:
        done = [attempt.place for attempt in view.dwells()]
        state.remember(done, view.skipped())
