"""Dialogs of the bench screen: guards, offers, the end, a note, and help; all work by keys alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, TypeVar

from rich.text import Text
from textual import events as ui
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from adis_gonio.bench import events
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.bench_words import BenchKey
from adis_gonio.faces.tui.screen_text import format_measured

Result = TypeVar("Result")


class _Finishing(ModalScreen[Result]):
    """Base of dialogs that close only once, even if keys follow quickly."""

    _has_result = False

    def finish(self, result: Result | None = None) -> None:
        """Close the dialog with a result; later calls do nothing."""
        if not self._has_result:
            self._has_result = True
            self.dismiss(result)


class Dialog(_Finishing[str]):
    """Dialog that asks a question and offers answers; Enter gives the selected answer.

    Parameters
    ----------
    heading, text : str
        The question and its reason.
    choices : mapping of str to BenchKey
        Keys of the answers, by name.
    default : str
        Answer that is selected at first.
    rows : sequence of (str, str)
        Names and values of the measured numbers.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,shift+tab", "move(-1)", show=False),
        Binding("down,tab", "move(1)", show=False),
        Binding("enter", "choose", show=False),
        Binding("ctrl+c,ctrl+q", "app.stop_now", show=False, priority=True),
    ]

    def __init__(
        self,
        heading: str,
        text: str,
        choices: Mapping[str, BenchKey],
        default: str,
        rows: Sequence[tuple[str, str]] = (),
    ) -> None:
        super().__init__()
        self._heading, self._text, self._rows = heading, text, rows
        self._choices = list(choices.items())
        self._default = default
        self._at = list(choices).index(default) if default in choices else 0

    def compose(self) -> ComposeResult:
        """Create the box of the dialog with its texts."""
        with Vertical(id="box"):
            yield Static(Text(self._heading, style="bold"), id="heading")
            yield Static(Text(self._text), id="text")
            if self._rows:
                width = max(len(name) for name, _ in self._rows)
                lines = [f"{name:<{width}}  {value}" for name, value in self._rows]
                yield Static(Text("\n".join(lines)), id="values")
            yield Static(id="choices")
            yield Static(Text("Enter takes ▶, ↑ ↓ move it, a letter answers at once", style="dim"))

    def on_mount(self) -> None:
        """Show the answers when the dialog is ready."""
        self._show()

    def _show(self) -> None:
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
        self._show()

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


class LineDialog(_Finishing[str]):
    """Dialog in which the operator types a line, such as a note; the result is empty after a cancel."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "give_up", show=False),
        Binding("ctrl+c,ctrl+q", "app.stop_now", show=False, priority=True),
    ]

    def __init__(self, heading: str, hint: str) -> None:
        super().__init__()
        self._heading, self._hint = heading, hint

    def compose(self) -> ComposeResult:
        """Create the box of the dialog with its input line."""
        with Vertical(id="box"):
            yield Static(Text(self._heading, style="bold"), id="heading")
            yield Input(placeholder=self._hint, id="note")
            yield Static(Text("Enter takes it, Esc gives it up", style="dim"))

    def action_give_up(self) -> None:
        """Close the dialog without a line."""
        self.finish("")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Close the dialog with the typed line."""
        self.finish(event.value)


class HelpDialog(_Finishing[None]):
    """Dialog with a text to read, such as the keys; any key closes it."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("ctrl+c,ctrl+q", "app.stop_now", show=False, priority=True)
    ]

    def __init__(self, heading: str, text: str) -> None:
        super().__init__()
        self._heading, self._text = heading, text

    def compose(self) -> ComposeResult:
        """Create the box of the dialog with its text."""
        with Vertical(id="box"):
            yield Static(Text(self._heading, style="bold"), id="heading")
            yield Static(Text(self._text), id="text")
            yield Static(Text("any key closes this", style="dim"))

    def on_key(self, event: ui.Key) -> None:
        """Close the dialog at any key."""
        event.stop()
        self.finish()


def guard_dialog(event: events.GuardRaised) -> Dialog:
    """Make the dialog for the question of a guard, with its measured numbers."""
    heading = f"{event.position}: {event.kind.replace('_', ' ')}"
    rows = [format_measured(name, value) for name, value in event.values.items()]
    return Dialog(heading, event.message, words.answers_to(event), event.default, rows)


def offer_dialog(event: events.RepetitionOffered | events.ExtensionOffered, planned: int) -> Dialog:
    """Make the dialog that offers to repeat dwells, or to go on beyond the `planned` positions."""
    reason, offer = words.reason_of(event, planned)
    return Dialog(offer, reason, words.answers_to(event), words.default_of(event))


QUIT = {
    "stop": BenchKey("y", "yes", "quit here", also="q"),
    "stay": BenchKey("n", "no", "go on with the session"),
}


def quit_dialog(resume_by: str) -> Dialog:
    """Make the dialog that asks if the session is to end."""
    text = f"The recorded data stay. Go on later with\n  {resume_by}"
    return Dialog("Quit the session?", text, QUIT, "stay")
