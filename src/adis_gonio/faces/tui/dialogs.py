"""Dialogs of the bench screen: guards, offers, the end, a note, and help; all work by keys alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.events import Key
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from adis_gonio.bench import events
from adis_gonio.faces.tui.screen_text import format_measured


@dataclass(frozen=True)
class Choice:
    """One answer of a dialog: its name for the runner, its letter and its label."""

    answer: str
    key: str
    label: str


CHOICES = {
    choice.answer: choice
    for choice in (
        Choice("retake", "t", "go back: ask for the position again"),
        Choice("keep", "k", "keep it as it is"),
        Choice("reverse", "r", "the stage counts the other way: reverse the whole session"),
        Choice("confirm", "c", "take it"),
        Choice("skip", "s", "skip this position"),
        Choice("undo", "u", "withdraw the last dwell"),
        Choice("repeat", "a", "take the last dwell again"),
        Choice("accept", "y", "yes"),
        Choice("decline", "n", "no"),
        Choice("stop", "q", "quit here; the session can be resumed"),
    )
}
"""Answers to the runner's questions."""

ON_TABLE = {
    "retake": Choice("retake", "t", "go back to the mark and turn again"),
    "reverse": Choice("reverse", "r", "keep it, and turn the next one the other way"),
}
"""Answers with other labels for whole turns on a table."""

STAY = Choice("stay", "g", "go on with the session")
QUIT = Choice("stop", "q", "quit here")


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
    choices : sequence of Choice
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
        choices: Sequence[Choice],
        default: str,
        rows: Sequence[tuple[str, str]] = (),
    ) -> None:
        super().__init__()
        self._heading, self._text, self._rows = heading, text, rows
        self._choices = choices
        self._default = default
        answers = [choice.answer for choice in choices]
        self._at = answers.index(default) if default in answers else 0

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
        for number, choice in enumerate(self._choices):
            here = number == self._at
            line = f"{'▶' if here else ' '} {choice.key}  {choice.label}"
            if choice.answer == self._default:
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
        self.finish(self._choices[self._at].answer)

    def on_key(self, event: Key) -> None:
        """Close the dialog with the answer that has this letter."""
        for choice in self._choices:
            if event.character == choice.key:
                event.stop()
                self.finish(choice.answer)
                return


class NoteDialog(_Finishing[str]):
    """Dialog in which the operator types a note; the result is empty after a cancel."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "give_up", show=False),
        Binding("ctrl+c,ctrl+q", "app.stop_now", show=False, priority=True),
    ]

    def compose(self) -> ComposeResult:
        """Create the box of the dialog with its input line."""
        with Vertical(id="box"):
            yield Static(Text("Note", style="bold"), id="heading")
            yield Input(placeholder="saved in the session with its time and position", id="note")
            yield Static(Text("Enter keeps it, Esc gives it up", style="dim"))

    def action_give_up(self) -> None:
        """Close the dialog without a note."""
        self.finish("")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Close the dialog with the typed line as the note."""
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

    def on_key(self, event: Key) -> None:
        """Close the dialog at any key."""
        event.stop()
        self.finish()


def guard_dialog(event: events.GuardRaised) -> Dialog:
    """Make the dialog for the question of a guard, with its measured numbers."""
    known = CHOICES | (ON_TABLE if event.position.turned_deg is not None else {})
    choices = [known[name] for name in event.answers if name != "stop"] + [CHOICES["stop"]]
    heading = f"{event.position}: {event.kind.replace('_', ' ')}"
    rows = [format_measured(name, value) for name, value in event.values.items()]
    return Dialog(heading, event.message, choices, event.default, rows)


def repetition_dialog(event: events.RepetitionOffered) -> Dialog:
    """Make the dialog that asks if dwells with a fault are to be repeated."""
    where = ", ".join(str(position) for position in event.positions)
    text = f"An error or alarm occurred at {where}. Repeat these dwells? Otherwise they are kept."
    answers = [CHOICES["accept"], CHOICES["decline"], CHOICES["stop"]]
    return Dialog("Faults within dwells", text, answers, "accept")


def extension_dialog(event: events.ExtensionOffered, positions: int) -> Dialog:
    """Make the dialog that asks if the session is to continue with further positions."""
    more = event.plan.positions[positions:]
    where = ", ".join(str(position) for position in more)
    reasons = [event.blindness.message] if event.blindness is not None else list(event.reasons)
    text = " ".join(f"{reason[:1].upper()}{reason[1:]}." for reason in reasons)
    answers = [CHOICES["accept"], CHOICES["decline"], CHOICES["stop"]]
    return Dialog("More positions?", f"{text}\n\nGo on with {where}?", answers, "accept")


def quit_dialog(resume_by: str) -> Dialog:
    """Make the dialog that asks if the session is to end."""
    text = f"The recorded data stay. Go on later with\n  {resume_by}"
    return Dialog("Quit the session?", text, [STAY, QUIT], "stay")
