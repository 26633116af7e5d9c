"""Events of a session as words."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor.settings import compensations

if TYPE_CHECKING:
    from adis_gonio.bench.events import (
        Advised,
        Configured,
        DwellDone,
        ExtensionOffered,
        TurnDone,
        TurnMeasured,
        TurnProgress,
        Watching,
    )

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
