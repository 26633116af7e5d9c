"""The text of the bench screen for a `BenchState`; nothing in here draws on a screen."""

from __future__ import annotations

from adis_gonio.base.numbers import DASH, counted, format_duration, signed, use_minus
from adis_gonio.bench import events
from adis_gonio.bench.guidance import to_do
from adis_gonio.faces import bench_words as words
from adis_gonio.faces.tui.bench_state import BenchState, Mark
from adis_gonio.record.plans import Position, describe_direction

SILENT_S = 5.0
"""Time in s without an event of the session after which the screen reports the silence."""
_SETTLED = (Mark.DONE, Mark.FAULTY, Mark.SKIPPED)
_UNITS = {
    "deg": "°", "mg": " mg", "c": " °C", "v": " V", "s": " s", "dps": " °/s", "k": " K", "percent": " %",
}  # fmt: skip
_BY_GRAVITY = """\
The angle comes from gravity, with an error of a degree or two until
biases and gains are known: set each position by the stage's scale."""
_SIGNS = "▶ now   ✓ done   – skipped   ! fault   ↶ again   · to do"
_DIGITS = {
    "0": ("████", "█  █", "█  █", "█  █", "████"),
    "1": ("  █ ", " ██ ", "  █ ", "  █ ", " ███"),
    "2": ("████", "   █", "████", "█   ", "████"),
    "3": ("████", "   █", " ███", "   █", "████"),
    "4": ("█  █", "█  █", "████", "   █", "   █"),
    "5": ("████", "█   ", "████", "   █", "████"),
    "6": ("████", "█   ", "████", "█  █", "████"),
    "7": ("████", "   █", "  █ ", "  █ ", "  █ "),
    "8": ("████", "█  █", "████", "█  █", "████"),
    "9": ("████", "█  █", "████", "   █", "████"),
    "+": ("   ", " █ ", "███", " █ ", "   "),
    "−": ("   ", "   ", "███", "   ", "   "),
    ".": (" ", " ", " ", " ", "█"),
    "°": ("███", "█ █", "███", "   ", "   "),
    "–": ("    ", "    ", "████", "    ", "    "),
    " ": ("  ", "  ", "  ", "  ", "  "),
}
"""Digits and signs of a number, each as five rows of block characters."""


def large_angle(value_deg: float | None, scale: int = 1) -> list[str]:
    """Draw an angle in degrees with two decimals in large digits, as rows of text; None gives a dash.

    Parameters
    ----------
    scale : int
        Factor on width and height; 2 doubles both.
    """
    text = DASH if value_deg is None else f"{signed(value_deg, 2)}°"
    rows = []
    for row in range(5):
        thin = " ".join(_DIGITS[character][row] for character in text)
        rows += ["".join(character * scale for character in thin)] * scale
    return rows


def title(state: BenchState) -> str:
    """Return the first line of the screen: plan, positions done, remaining time, sensor and file."""
    begun, asked = state.latest(events.Started), state.latest(events.PositionAsked)
    if state.plan is None or begun is None:
        return "adis-gonio"
    total = len(state.plan)
    settled = sum(state.mark(place) in _SETTLED for place in range(total))
    remaining = "" if asked is None else f", about {format_duration(asked.time_left_s)} left"
    return f"{state.plan.name}: {settled} of {total} done{remaining} · {begun.variant} · {begun.path}"


def _place_name(position: Position) -> str:
    """Return the name of a position in the list, such as `90° from above (check)` or `reads +x −z`."""
    if position.direction is None:
        return str(position)
    return describe_direction(position.direction) + (" (check)" if position.use == "check" else "")


def plan_rows(state: BenchState, height: int) -> list[tuple[str, str]]:
    """Return the rows of the list of positions, each as its text and its style, such as `green`.

    The list has at most `height` rows, around the current position.
    """
    if state.plan is None:
        return []
    rows = []
    for place, position in enumerate(state.plan.positions):
        sign, word, style = state.mark(place).value
        rows.append((f"{sign} {word:<7} {_place_name(position)}", style))
    if len(rows) <= height:
        return rows
    room = max(1, height - 2)
    centre = state.place if state.place is not None else len(rows) - 1
    first = min(max(0, centre - room // 2), len(rows) - room)
    last = first + room
    above = (f"  ↑ {first} more" if first else "", "")
    below = (f"  ↓ {len(rows) - last} more" if last < len(rows) else "", "")
    return [above, *rows[first:last], below]


def task(state: BenchState) -> str:
    """Return the next task of the operator, in one or two sentences."""
    if state.paused:
        return "PAUSED. Nothing is measured; p goes on."
    question = state.question
    if isinstance(question, events.PositionAsked):
        count = f"{question.number} of {question.total}"
        return f"{count}: {to_do(question.position, state.here, reverse=state.reversed)}, then press Enter"
    if isinstance(question, events.GuardRaised):
        return question.message
    if state.span is not None and state.span.what == "dwell":
        return f"{state.position}: hands off, recording" if state.position else "recording"
    if state.position is not None:
        return f"{state.position}: {state.doing}"
    return state.doing[:1].upper() + state.doing[1:]


def target(state: BenchState) -> str:
    """Return the line with the requested angle and the remaining turn."""
    if state.target_deg is None:
        free = state.position is not None and state.position.angle_deg is None
        return "free attitude: no angle to reach" if free else ""
    more, tolerance = state.more_deg, state.tolerance_deg
    goal = f"target {use_minus(f'{state.target_deg:g}')}°"
    if not state.zero_known:
        return f"{goal}   this position sets the zero"
    if more is None or tolerance is None or state.passes:
        return goal
    if abs(more) <= tolerance:
        return f"{goal}   ● within ±{tolerance:.1f}°: now by the scale"
    if state.lost_way:
        return goal
    arrow, way = ("▶▶", "more") if more > 0 else ("◀◀", "back")
    return f"{goal}   {arrow} turn {signed(more, 1)}° {way}"


def stillness(state: BenchState, width: int) -> str:
    """Return the line that shows if the sensor is still: spread, limit and a bar.

    The line is at most `width` characters long.
    """
    if state.spread_mg is None:
        return "no samples yet"
    if state.limit_mg is None:
        return f"varies by {state.spread_mg:.2f} mg (limit not known yet)"
    still = state.spread_mg <= state.limit_mg
    text = f"{'still' if still else 'MOVING'}  {state.spread_mg:.2f} of at most {state.limit_mg:.2f} mg "
    return text + _bar(state.spread_mg / state.limit_mg, width - len(text))


def waiting(state: BenchState, silence_s: float = 0.0) -> str:
    """Return the line that names the event for which the session waits, or the pause or activity.

    Parameters
    ----------
    silence_s : float
        Time in s since the last event, which is the time that a running trace has taken.
    """
    if state.paused:
        return "paused"
    if state.quiet and silence_s >= 1:
        return f"for {format_duration(silence_s)} so far"
    return f"waits for {state.waits_for}" if state.waits_for else state.doing


def progress(state: BenchState, width: int) -> str:
    """Return the line with elapsed time and length of a dwell or wait, and a bar.

    The line is empty during other activities. It is at most `width` characters long.
    """
    if state.span is None:
        return ""
    span = state.span
    text = f"{span.what}  {span.elapsed_s:.0f} of {span.length_s:.0f} s "
    return text + _bar(span.elapsed_s / span.length_s if span.length_s else 1.0, width - len(text))


def _bar(share: float, width: int) -> str:
    """Return a bar of at most 20 characters for a share of 0 to 1.

    Larger shares are drawn full. A width of less than 4 characters gives an empty text.
    """
    width = min(20, width)
    if width < 4:
        return ""
    filled = round(min(max(share, 0.0), 1.0) * width)
    return "█" * filled + "░" * (width - filled)


def facts(state: BenchState) -> list[tuple[str, str]]:
    """Return the rows (name, value) that the screen shows below the angle."""
    turn = words.turn_text(state.latest(events.TurnMeasured))
    return [("last turn", turn), ("result", _running(state.latest(events.Running)))]


def _running(running: events.Running | None) -> str:
    """Return the text of the parameters from the dwells so far.

    None gives a note that there are no parameters yet.
    """
    if running is None:
        return "– (after the second position)"
    dwells = counted(running.dwells, "dwell")
    values = words.running_values(running)
    if not values:
        return f"{dwells}, by {running.method}"
    return "\n".join([*values, f"(± U, 95 %; {dwells}, {running.method})"])


def surroundings(state: BenchState, width: int, silence_s: float = 0.0) -> list[str]:
    """Return the lines about temperature, lost scans, sample rate and URL.

    A further line gives a warning if the last event came more than `SILENT_S` seconds ago.

    Parameters
    ----------
    width : int
        Width in characters, to which the URL is cut.
    silence_s : float
        Time in s since the last event.
    """
    if state.temperature_c is None or state.began_c is None:
        lines = ["temperature not measured"]
    else:
        drift = signed(state.temperature_c - state.began_c, 1)
        lines = [f"{state.temperature_c:.1f} °C, {drift} K since begin"]
    if silence_s >= SILENT_S and not state.quiet:
        lines.append(f"NO NEWS for {format_duration(silence_s)}")
    begun, configured = state.latest(events.Started), state.latest(events.Configured)
    if configured is not None:
        lines.append(f"{state.lost} scans lost, {configured.configuration['sample_rate_hz']:.4g}/s")
        polled = f"polled: {configured.why_polled}" if configured.why_polled else ""
        lines.append(polled or "at the data-ready edges")
    url = "" if begun is None else begun.url
    return [*lines, url if len(url) <= width else f"{url[: max(0, width - 1)]}…"]


def format_measured(name: str, value: float) -> tuple[str, str]:
    """Return name and value with unit as text; `name` ends in the unit, such as `gyro_deg`."""
    stem, _, unit = name.rpartition("_")
    if not stem or unit not in _UNITS:
        return name.replace("_", " "), use_minus(f"{value:.4g}")
    text = use_minus(f"{value:.2f}" if unit == "deg" else f"{value:.4g}")
    return stem.replace("_", " "), f"{text}{_UNITS[unit]}"


def keys(state: BenchState) -> list[tuple[str, str]]:
    """Return the keys that have an effect now, each with its meaning."""
    question = state.question
    answers = {} if question is None else words.answers_to(question)
    end = answers.pop("stop", words.ANSWERS["stop"])
    shown = [(key.letter, key.word) for key in answers.values()]
    if question is not None and not isinstance(question, events.PositionAsked):  # a dialog is open
        return [(words.ENTER, answers[words.default_of(question)].word), *shown, (end.letter, end.word)]
    more = [words.MOVE, words.BUMP] if state.hands else [words.DRAW]
    shown += [(words.PAUSE.letter, "go on" if state.paused else words.PAUSE.word)]
    return shown + [(key.letter, key.word) for key in (words.NOTE, *more, end, words.HELP)]


def help_text(state: BenchState) -> str:
    """Return the help on keys and signs, and on the origin of the displayed angle."""
    listed = words.help_lines(hands=state.hands)
    return "\n".join([*listed, "", _SIGNS, _BY_GRAVITY, "No question has a time limit."])
