"""What the screen says of a `BenchState`, as text; no screen in here."""

from __future__ import annotations

from adis_gonio.base.numbers import counted, format_duration, format_fixed, format_uncertain, use_minus
from adis_gonio.bench import events
from adis_gonio.bench.guidance import to_do
from adis_gonio.faces.tui import whole_turns
from adis_gonio.faces.tui.state import BenchState, Mark
from adis_gonio.record.plans import Position, attitude

SILENT_S = 5.0
"""Time without news of the sensor after which that is said."""


_SETTLED = (Mark.DONE, Mark.FAULTY, Mark.SKIPPED)


def title(state: BenchState) -> str:
    """First line: plan, how far, how much longer, where it is recorded."""
    if state.plan is None:
        return "adis-gonio"
    total = len(state.plan)
    settled = sum(state.mark(place) in _SETTLED for place in range(total))
    left = "" if state.time_left_s is None else f", about {format_duration(state.time_left_s)} left"
    return f"{state.plan.name}: {settled} of {total} done{left} · {state.variant} · {state.path}"


def place_name(position: Position) -> str:
    """A position in a list: short, with its side of approach and use."""
    if position.angle_deg is None:
        where = "attitude" if position.direction is None else _axes(position)
    else:
        where = f"{position.angle_deg:g}°"
    return (
        where
        + {-1: " from above"}.get(position.approach, "")
        + (" check" if position.use == "check" else "")
    )


def _axes(position: Position) -> str:
    return attitude(position.direction or ()).removeprefix("one that ")


def plan_rows(state: BenchState, height: int) -> list[tuple[str, str]]:
    """Lines of the plan with the name of their mark, as many as fit, around the position in hand."""
    if state.plan is None:
        return []
    name = whole_turns.place_name if whole_turns.on_table(state) else place_name
    rows = [
        (f"{mark.sign} {mark.word:<7} {name(position)}", mark.name.lower())
        for place, position in enumerate(state.plan.positions)
        for mark in (state.mark(place),)
    ]
    if len(rows) <= height:
        return rows
    room = max(1, height - 2)
    centre = state.place if state.place is not None else len(rows) - 1
    first = min(max(0, centre - room // 2), len(rows) - room)
    last = first + room
    above = (f"  ↑ {first} more" if first else "", "open")
    below = (f"  ↓ {len(rows) - last} more" if last < len(rows) else "", "open")
    return [above, *rows[first:last], below]


def task(state: BenchState) -> str:
    """What is to be done now, in one sentence or two."""
    if state.paused:
        return "PAUSED. Nothing is measured; p goes on."
    question = state.question
    if isinstance(question, events.PositionAsked) and whole_turns.on_table(state):
        return whole_turns.task(state, question)
    if isinstance(question, events.PositionAsked):
        todo = to_do(question.position, state.here, reverse=state.reversed)
        return f"{question.number} of {question.total}: {todo}, then press Enter"
    if isinstance(question, events.GuardRaised):
        return question.message
    if state.whole is not None:
        return f"{state.position}: {whole_turns.doing(state.whole)}"
    if state.span is not None and state.span.what == "dwell":
        return f"{state.position}: hands off, recording" if state.position else "recording"
    if state.position is not None:
        return f"{state.position}: {state.doing}"
    return state.doing[:1].upper() + state.doing[1:]


def target(state: BenchState) -> str:
    """The angle asked for, and how far it is from there."""
    if whole_turns.on_table(state):
        return whole_turns.target(state)
    if state.target_deg is None:
        return "free attitude: no angle to reach" if _is_free(state) else ""
    more, tolerance = state.more_deg, state.tolerance_deg
    goal = f"target {use_minus(f'{state.target_deg:g}')}°"
    if not state.zero_known:
        return f"{goal}   this position sets the zero"
    if more is None or tolerance is None or state.passes:
        return goal
    if abs(more) <= tolerance:
        return f"{goal}   ● there, to ±{tolerance:.1f}°"
    if state.lost_way:
        return goal
    arrow, way = ("▶▶", "more") if more > 0 else ("◀◀", "back")
    return f"{goal}   {arrow} turn {format_fixed(more, 1, sign=True)}° {way}"


def _is_free(state: BenchState) -> bool:
    return state.position is not None and state.position.angle_deg is None


def stillness(state: BenchState, width: int) -> str:
    """Word, number, limit and a bar of the stillness; while the part is turned on a table, of its rate."""
    if state.whole is not None:
        return whole_turns.rate(state, width)
    if state.spread_mg is None:
        return "no samples yet"
    if state.limit_mg is None:
        return f"varies by {state.spread_mg:.2f} mg (limit not known yet)"
    still = state.spread_mg <= state.limit_mg
    text = f"{'still' if still else 'MOVING'}  {state.spread_mg:.2f} of at most {state.limit_mg:.2f} mg "
    return text + bar(state.spread_mg / state.limit_mg, width - len(text))


def waiting(state: BenchState, silence_s: float = 0.0) -> str:
    """What the session waits for; `silence_s` is how long nothing has come, which a trace is timed by."""
    if state.paused:
        return "paused"
    if state.whole is not None:
        return whole_turns.waiting(state)
    if state.quiet and silence_s >= 1:
        return f"for {format_duration(silence_s)} so far"
    return f"waits for {state.waits_for}" if state.waits_for else state.doing


def progress(state: BenchState, width: int) -> str:
    """How far what is going on has come."""
    if state.span is None:
        return ""
    span = state.span
    text = f"{span.what}  {span.elapsed_s:.0f} of {span.length_s:.0f} s "
    return text + bar(span.elapsed_s / span.length_s if span.length_s else 1.0, width - len(text))


def bar(share: float, width: int) -> str:
    """A bar of at most 20 characters; full from 1 on."""
    width = min(20, width)
    if width < 4:
        return ""
    filled = round(min(max(share, 0.0), 1.0) * width)
    return "█" * filled + "░" * (width - filled)


def facts(state: BenchState) -> list[tuple[str, str]]:
    """Rows of name and value below the angle."""
    if whole_turns.on_table(state):
        return whole_turns.facts(state)
    return [("last turn", _turn(state.turn)), ("result", _running(state.running))]


def surroundings(state: BenchState, width: int, silence_s: float = 0.0) -> list[str]:
    """Temperature and link, in lines; `silence_s` is how long nothing has come from the sensor."""
    lines = [_temperature(state)]
    if silence_s >= SILENT_S and not state.quiet:
        lines.append(f"NO NEWS for {format_duration(silence_s)}")
    if state.rate_hz is not None:
        lines += [f"{state.lost} scans lost, {state.rate_hz:.4g}/s", state.link]
    url = state.url
    return [*lines, url if len(url) <= width else f"{url[: max(0, width - 1)]}…"]


def _turn(turn: events.TurnMeasured | None) -> str:
    if turn is None:
        return "–"
    said = []
    if turn.asked_deg is not None:
        said.append(f"asked {format_fixed(turn.asked_deg, 1, sign=True)}°")
    if turn.gyro_deg is not None:
        u = "" if turn.gyro_u_deg is None else f" ± {turn.gyro_u_deg:.1f}"
        said.append(f"gyro {format_fixed(turn.gyro_deg, 1, sign=True)}{u}°")
    if turn.gravity_deg is not None:
        said.append(f"gravity {format_fixed(turn.gravity_deg, 1, sign=True)}°")
    return ", ".join(said) or "not watched"


_SYMBOLS = {"delta_k": "ΔK", "delta_phi": "Δφ"}


def _running(running: events.Running | None) -> str:
    if running is None:
        return "– (after the second position)"
    said = []
    for name, symbol in _SYMBOLS.items():
        entry = running.parameters.get(name)
        if entry is not None:
            said.append(f"{symbol} {format_uncertain(entry['value'], entry['u'], entry['unit'])}")
    if not said:
        return f"{counted(running.dwells, 'dwell')}, by {running.method}"
    return "\n".join(said) + f"   ({running.method}, {counted(running.dwells, 'dwell')})"


def _temperature(state: BenchState) -> str:
    if state.temperature_c is None or state.began_c is None:
        return "temperature not measured"
    drift = state.temperature_c - state.began_c
    return f"{state.temperature_c:.1f} °C, {format_fixed(drift, 1, sign=True)} K since begin"


_UNITS = {
    "deg": "°", "mg": " mg", "c": " °C", "v": " V", "s": " s", "dps": " °/s", "k": " K", "percent": " %",
}  # fmt: skip


def measured(name: str, value: float) -> tuple[str, str]:
    """A number by a name that ends in its unit, such as `gyro_deg`, as words."""
    stem, _, unit = name.rpartition("_")
    if not stem or unit not in _UNITS:
        return name.replace("_", " "), use_minus(f"{value:.4g}")
    return stem.replace("_", " "), use_minus(f"{value:.4g}") + _UNITS[unit]


def keys(state: BenchState) -> list[tuple[str, str]]:
    """Keys that do something now, with their words."""
    asked = state.question if isinstance(state.question, events.PositionAsked) else None
    shown = [("Enter", "take")] if asked is not None else []
    if asked is not None and asked.can_repeat:
        shown.append(("t", "retake"))
    if asked is not None:
        shown.append(("s", "skip"))
    if asked is not None and asked.can_undo:
        shown.append(("u", "undo"))
    return [
        *shown,
        ("p", "go on" if state.paused else "pause"),
        ("n", "note"),
        ("q", "quit"),
        ("?", "help"),
    ]


def explained(state: BenchState) -> str:
    """The help: keys, signs, and what the angle is."""
    return HELP.replace(_BY_GRAVITY, whole_turns.THE_ANGLE) if whole_turns.on_table(state) else HELP


_BY_GRAVITY = """\
The angle is by gravity, to a degree or two while biases and gains
are not known yet: what counts is the stage's scale."""
HELP = f"""\
Enter  take: the part is at the position that is asked for
t      take the last dwell again; the old one stays in the file
s      skip this position
u      undo: withdraw the last dwell, its position is asked again
p      pause, and go on; nothing is measured meanwhile
n      a note, kept with the session
d      the drawing: how the part is held, which way is positive
q      quit; all that is recorded stays, --resume goes on with it
Ctrl-C quit at once

▶ now   ✓ done   – skipped   ! fault   ↶ again   · to do
{_BY_GRAVITY}
No question has a time limit."""
