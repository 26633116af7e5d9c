"""What the screen says where the part lies on a table and is turned there, as text: plan `gyro-turns`.

Here gravity shows nothing: the angle is the gyro's own integral, and instead of how still the part is the
rate counts, against what the gyros can show.
"""

from __future__ import annotations

from adis_gonio.base.numbers import counted, format_fixed
from adis_gonio.bench import events
from adis_gonio.bench.guidance import face
from adis_gonio.bench.runner import SHARE_OF_RANGE
from adis_gonio.faces.tui.state import BenchState
from adis_gonio.record.plans import GYRO_TURNS, Position

THE_ANGLE = """\
The angle is the gyros' integral since the rest before, counter-clockwise
positive as seen from above; as large as their gain makes it."""


def on_table(state: BenchState) -> bool:
    """True in a session of whole turns."""
    return state.plan is not None and state.plan.name == GYRO_TURNS


def face_in_hand(state: BenchState) -> str:
    """The face that lies up at the place in hand, or at the one before it."""
    if state.plan is None or state.place is None:
        return ""
    before = reversed(state.plan.positions[: state.place + 1])
    return next((name for name in map(face, before) if name), "")


def place_name(position: Position) -> str:
    """A place in a list."""
    if position.turned_deg is None:
        return face(position)
    turns = counted(round(abs(position.turned_deg) / 360), "turn")
    return f"{format_fixed(position.turned_deg, 0, sign=True)}°, {turns}"


def task(state: BenchState, question: events.PositionAsked) -> str:
    """What is to be done before Enter, in few words."""
    count = f"{question.number} of {question.total}"
    turned = question.position.turned_deg
    if turned is None:
        return (
            f"{count}: lay the part flat on the table against the mark, {face(question.position)}, then"
            " press Enter"
        )
    turns, way = round(abs(turned) / 360), "counter-clockwise" if turned > 0 else "clockwise"
    times = "once" if turns == 1 else f"{turns} times"
    return f"{count}: press Enter, 1 s later turn it {times} {way}, seen from above, back to the mark"


def doing(event: events.TurnProgress) -> str:
    """What goes on, in words."""
    if event.state == "rest":
        return "leave it at the mark"
    if event.state == "after":
        return "back at the mark? let it rest"
    return f"turn {event.turn} of {event.turns}"


def target(state: BenchState) -> str:
    """How far it was asked to be turned, and how far it is from there."""
    position = state.position
    if position is None:
        return ""
    if position.turned_deg is None:
        return face(position)
    goal = f"asked {format_fixed(position.turned_deg, 0, sign=True)}°"
    if state.whole is None:
        fastest = SHARE_OF_RANGE * state.range_dps
        return f"{goal} at {fastest:.0f} °/s at most ({360 / fastest:.0f} s a turn)"
    turns = format_fixed(state.whole.turned_deg / 360.0, 2, sign=True)
    more = format_fixed(position.turned_deg - state.whole.turned_deg, 0, sign=True)
    return f"{goal}   {turns} turns so far   {more}° to go"


def rate(state: BenchState, width: int) -> str:
    """Rate against what the gyros can show, with a bar."""
    from adis_gonio.faces.tui.words import bar

    whole = state.whole
    if whole is None:
        return ""
    beyond = "TOO FAST  " if too_fast(state) else ""
    now = format_fixed(whole.rate_dps, 0, sign=True)
    text = f"{beyond}{now} °/s, largest {whole.peak_dps:.0f} of {state.range_dps:.0f} "
    return text + bar(whole.peak_dps / state.range_dps, width - len(text))


def too_fast(state: BenchState) -> bool:
    """True once the turn in hand has been beyond the range."""
    return state.whole is not None and state.whole.peak_dps >= state.range_dps


def waiting(state: BenchState) -> str:
    """What a turn waits for."""
    whole = state.whole
    if whole is None:
        return ""
    told = {"rest": "for your turn to begin", "turn": "for the turns to end at the mark"}
    if whole.state == "after" or whole.rest_s > 0.5:
        return f"waits for rest: {whole.rest_s:.1f} s so far"
    return f"waits {told[whole.state]}"


def facts(state: BenchState) -> list[tuple[str, str]]:
    """Rows of name and value below the angle."""
    return [("face", face_in_hand(state) or "–"), ("last turn", _turn(state.turned))]


def _turn(turn: events.TurnDone | None) -> str:
    if turn is None:
        return "–"
    off = turn.turned_deg - 360.0 * round(turn.turned_deg / 360.0)
    lost = f", {turn.lost} scans lost" if turn.lost else ""
    return (
        f"gyro {format_fixed(turn.turned_deg, 1, sign=True)}° in {turn.length_s:.0f} s,\n"
        f"{format_fixed(off, 1, sign=True)}° off {counted(turn.turns, 'whole turn')}{lost}"
    )
