"""Keys, answers and lines of text about events, for a bench session on the screen or by plain prompts.

Both front ends take every key, question and line from here, so that an operator meets one wording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from adis_gonio.base.numbers import NAMES, counted, format_duration, format_uncertain, signed
from adis_gonio.base.uncertainty import NORMAL_95
from adis_gonio.bench import events
from adis_gonio.device.sensor.settings import compensations


@dataclass(frozen=True)
class BenchKey:
    """A key of the screen and the prompts: its letter, a word for lists of keys, and an explanation."""

    letter: str
    word: str
    meaning: str
    also: str = ""
    """Another letter for the same key in a dialog of the screen; empty for none."""


ENTER = "Enter"
ANSWERS = {
    "confirm": BenchKey(ENTER, "take", "the part is at the position"),
    "repeat": BenchKey("r", "again", "take the last dwell again; the old one stays in the file"),
    "retake": BenchKey("r", "again", "go back: ask for the position again"),
    "skip": BenchKey("s", "skip", "skip this position"),
    "undo": BenchKey("u", "undo", "withdraw the last dwell, and ask for its position again"),
    "keep": BenchKey("k", "keep", "keep it as it is"),
    "reverse": BenchKey("v", "reverse", "the stage counts the other way: reverse the whole session"),
    "accept": BenchKey("y", "yes", "yes"),
    "decline": BenchKey("n", "no", "no"),
    "stop": BenchKey("q", "quit", "end here; the data stay, --resume goes on"),
}
"""Key of each answer to the runner's questions, by the name of the answer."""
ON_TABLE = {"retake": BenchKey("r", "again", "go back to the mark and turn again")}
"""Keys of the answers that have another meaning for whole turns on a table, by the name of the answer."""
PAUSE = BenchKey("p", "pause", "pause or go on; nothing is measured during a pause")
NOTE = BenchKey("n", "note", "add a note to the session")
DRAW = BenchKey("d", "draw", "draw how to hold the part, and the positive direction")
HELP = BenchKey("?", "help", "show this list")
MOVE = BenchKey("m", "move", "turn the simulated part by some degrees, such as m -30")
BUMP = BenchKey("b", "bump", "bump the simulated part")
"""Key that bumps the simulated part with `sim:?hands=free`.

The keys `MOVE` and `BUMP` act only on this part, which nothing but the operator's keys moves.
"""

Question = events.PositionAsked | events.GuardRaised | events.ExtensionOffered


def answers_to(question: Question) -> dict[str, BenchKey]:
    """Return the keys of the possible answers to a question, by name of the answer, in their order."""
    match question:
        case events.PositionAsked():
            names = ["confirm", "repeat", "skip", "undo"] if question.can_undo else ["confirm", "skip"]
        case events.GuardRaised():
            names = [*question.answers]
        case _:
            names = ["accept", "decline"]
    asks_turn = isinstance(question, events.GuardRaised) and question.position.turned_deg is not None
    known = ANSWERS | (ON_TABLE if asks_turn else {})
    return {name: known[name] for name in (*names, "stop")}


def default_of(question: Question) -> str:
    """Return the name of the answer that the Enter key gives to a question."""
    if isinstance(question, events.GuardRaised):
        return question.default
    return "confirm" if isinstance(question, events.PositionAsked) else "accept"


def reason_of(question: events.ExtensionOffered, planned: int) -> tuple[str, str]:
    """Return the reason for extending the plan as sentences, and the offer as a question.

    `planned` is the number of positions in the present plan.
    """
    where = ", ".join(str(position) for position in question.plan.positions[planned:])
    return " ".join(
        f"{reason[:1].upper()}{reason[1:]}." for reason in question.reasons
    ), f"Go on with {where}?"


def help_lines(*, hands: bool) -> list[str]:
    """Return the lines of a list of all keys with their meanings.

    `hands` adds the keys that move a simulated part.
    """
    keys = [ANSWERS[name] for name in ("confirm", "repeat", "skip", "undo", "keep", "reverse")]
    keys += [PAUSE, NOTE, DRAW, ANSWERS["stop"], *([MOVE, BUMP] if hands else [])]
    return [f"{key.letter:<6} {key.meaning}" for key in keys] + ["Ctrl-C end at once"]


# -- lines about events ------------------------------------------------------------------------------

Level = Literal["said", "warned"]


def lines_about(event: events.Event) -> list[tuple[str, Level]]:
    """Return the lines that tell the operator about an event and remain on the screen.

    Each line has a level: `said` for information, `warned` for a warning. The list is empty for an event
    that only updates the display, such as the progress of a dwell.
    """
    match event:
        case events.Started():
            shape = counted(len(event.plan), "position")
            begun = f"resumed, {event.done} of {shape} done" if event.resumed else f"begun, {shape}"
            return [(f"{event.plan.name} {begun}, {event.variant} on {event.url}", "said")]
        case events.Configured():
            return [(line, "said") for line in configuration_lines(event)]
        case events.NoiseMeasured():
            noise = ", ".join(f"{value:.2f}" for value in event.noise_mg)
            return [(f"noise at rest {noise} mg (x, y, z)", "said")]
        case events.DwellDone():
            each = zip("xyz", event.accel_mg, strict=True)
            mean = "  ".join(f"{axis} {signed(mg, 2):>8}" for axis, mg in each)
            lost = f", {event.lost} lost" if event.lost else ""
            lost += f", {event.alarms} with an error or alarm" if event.alarms else ""
            return [(f"{mean} mg  {event.position}{lost}", "said")]
        case events.TurnDone():
            lost = f", {event.lost} scans lost" if event.lost else ""
            turns = f"{counted(event.turns, 'full turn')}, {event.travelled_deg:.0f}° in all"
            took = f"{event.length_s:.0f} s, {event.samples} scans{lost}"
            return [(f"turned {signed(event.turned_deg, 1)}°: {turns}, {took}", "said")]
        case _:
            return _course(event)


def _course(event: events.Event) -> list[tuple[str, Level]]:
    """Return the lines about an interruption, problem, note, withdrawn dwell or end of the session.

    Each line has its level, `said` or `warned`. The list is empty for other events.
    """
    match event:
        case events.DwellInterrupted() if not event.guarded:
            return [(f"{event.position} interrupted: {event.reason} (samples kept)", "warned")]
        case events.Problem():
            return [(event.message, "warned")]
        case events.Noted():
            return [(f"noted: {event.text}", "said")]
        case events.Withdrawn():
            return [(f"{event.position} withdrawn; it stays in the file, marked", "said")]
        case events.Advised() if event.ended:
            return [(f"{event.ended[0].upper()}{event.ended[1:]}.", "said")]
        case events.Finished() if not event.complete:
            return [(f"not complete: {event.done} of {event.total}", "warned")]
    return []


def configuration_lines(event: events.Configured) -> list[str]:
    """Return the lines about sample rate, filter, changed registers and compensations of the chip.

    The last line gives the reason if scans are polled.
    """
    filter_m = event.configuration.get("filter_m")
    filtered = "" if filter_m is None else f", filter 2 × {2**filter_m} taps"
    changed = ", ".join(f"{name} {a} → {b}" for name, (a, b) in event.changed.items())
    rate = f"{event.configuration['sample_rate_hz']:.1f} samples/s{filtered}"
    lines = [rate + (f"; changed {changed}" if changed else "")]
    compensated = compensations(event.configuration)
    if compensated:
        lines.append(f"the chip compensates {', '.join(compensated)}")
    if event.why_polled:
        lines.append(f"scans are polled: {event.why_polled}")
    return lines


def turn_text(turn: events.TurnMeasured | None) -> str:
    """Return a text with the turn since the last position in degrees.

    It has the requested turn, the turn that the gyros measured with its expanded uncertainty U (95 %), and
    the turn that follows from gravity, as far as each is known. The text is a dash if `turn` is None.
    """
    if turn is None:
        return "–"
    parts = [] if turn.asked_deg is None else [f"asked {signed(turn.asked_deg)}°"]
    if turn.gyro_deg is not None:
        u = None if turn.gyro_u_deg is None else NORMAL_95 * turn.gyro_u_deg
        parts.append(f"gyro {format_uncertain(turn.gyro_deg, u, 'deg', sign=True)}")
    if turn.gravity_deg is not None:
        parts.append(f"gravity {signed(turn.gravity_deg, 2)}°")
    return ", ".join(parts) or "not watched"


def running_values(running: events.Running) -> list[str]:
    """Return a text for each of ΔK and Δφ that the dwells so far determine, with ± U (95 %).

    `running` is the event with the parameters so far. The list is empty if neither is determined.
    """
    known: Mapping[str, Any] = running.parameters
    return [
        f"{NAMES[name]} {format_uncertain(known[name]['value'], known[name]['U'], known[name]['unit'])}"
        for name in ("delta_k", "delta_phi")
        if name in known
    ]


def lines_of_result(event: events.Event) -> list[tuple[str, Level]]:
    """Return a line about the measured turn or the parameters so far, if the event contains them.

    The line has the level `said`. The list is empty for other events. The bench screen shows this
    information in fields of its own instead.
    """
    if isinstance(event, events.TurnMeasured):
        return [(f"last turn: {turn_text(event)}", "said")]
    values = running_values(event) if isinstance(event, events.Running) else []
    return [(f"so far: {', '.join(values)} (± U, 95 %)", "said")] if values else []


def position_count(question: events.PositionAsked) -> str:
    """Return a text such as `3 of 8 (about 5 min left)` for the position that the operator is asked for."""
    minutes = round(question.time_left_s / 60)
    left = f" (about {format_duration(60 * minutes)} left)" if minutes else ""
    return f"{question.number} of {question.total}{left}"
