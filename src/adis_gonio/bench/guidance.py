"""Instructions for the operator: sense of rotation, directions of the axes, and the next move.

The conventions are the model of the plane (U_x = G cos(α − θ), U_y = G sin(α − θ + Δφ)) and the sensor's
arrows: an axis reads +1 g if its drawn arrow points down (lying level with Z up, Z reads −1 g).
"""

from __future__ import annotations

from adis_gonio.base.numbers import signed
from adis_gonio.bench.guards import angle_between_deg
from adis_gonio.record.plans import Plan, Position

PLANE = (
    "Start, 0°, seen with the Z arrow towards you:       At +90°:",
    "",
    "        +--------+                                      Y",
    "        | part   |---> Y                                ^",
    "        |   (.)Z |                                 +----|---+",
    "        +---|----+                                 | (.)Z   |---> X",
    "            v                                      | part   |",
    "            X                                      +--------+",
    "",
    "  X arrow down (reads +1 g),                   X level (0),",
    "  Y level (0).                                 Y arrow up (reads -1 g).",
    "  Z is the axis of rotation and lies level: it reads about 0.",
    "  Positive is counter-clockwise, seen with Z towards you:",
    "  at +90° X points as Y did at 0°.",
)
SPACE = (
    "An axis reads + if its arrow points down, - if it points up,",
    "and about 0 if it is level.",
    "Lying flat with Z up:",
    "",
    "           Z  (reads -1 g)",
    "           ^",
    "        +--|--+",
    "        |part |---> X  (0)",
    "        +-----+",
    "       /",
    "      Y  (0)",
)


def turn_to_do(turns: int) -> str:
    """Return the instruction to the operator for a free turn of this many full turns, in one line."""
    if turns > 1:
        ways = f"{turns} times all around in the time, on and on, or forth and back if a cable requires it"
    else:
        ways = "once all around"
    return (
        f"lay the part at rest; press Enter, leave it alone for 3 s, turn it slowly {ways}"
        " (stops to change your grip do no harm) and let it rest again"
    )


def turn_sense(angle_deg: float) -> str:
    """Return the sense of a turn seen from above: `counter-clockwise` (`angle_deg` > 0) or `clockwise`."""
    return "counter-clockwise" if angle_deg > 0 else "clockwise"


def drawing(plan: Plan) -> tuple[str, ...]:
    """Return a drawing of the sensor at a plan's first position, as lines of text."""
    return SPACE if plan.plane == "none" else PLANE


def to_do(
    position: Position,
    before: Position | None = None,
    *,
    reverse: bool = False,
    fastest_dps: float = 180.0,
    table: bool = False,
) -> str:
    """Return the instruction to take the next position, such as `turn the part +90° …`.

    Parameters
    ----------
    position : Position
        The next position.
    before : Position or None
        Present position of the sensor; None if it is not known.
    reverse : bool
        True in a reversed session, in which the stage counts angles the other way than the plan.
    fastest_dps : float
        Largest rate of whole turns.
    table : bool
        True if the sensor lies on a table, against a mark.
    """
    if position.turned_deg is not None:
        turns, sense = round(abs(position.turned_deg) / 360), turn_sense(position.turned_deg)
        times = "once" if turns == 1 else f"{turns} times"
        return (
            f"leave the part at the mark; 1 s after Enter turn it {times} {sense}, seen from above,"
            f" flat on the table and back to the mark, at {fastest_dps:.0f} °/s at most"
            f" ({360 / fastest_dps:.0f} s a turn; stops to change your grip do no harm), and let it rest:"
            " get ready"
        )
    if position.angle_deg is None:
        return _hold(position, table=table)
    return _turn(position, before, reverse=reverse)


def _turn(position: Position, before: Position | None, *, reverse: bool) -> str:
    if before is None or before.angle_deg is None:
        return f"turn the part to {position}"
    by = (position.angle_deg or 0.0) - before.angle_deg
    if by == 0:
        if before.approach != position.approach:
            return f"turn the part past it and back to {position}"
        return f"leave the part at {position}"
    return f"turn the part {signed(by)}° ({turn_sense(-by if reverse else by)}) to {position}"


def _hold(position: Position, *, table: bool) -> str:
    if position.direction is None:
        return f"hold the part in {position}"
    arrows = []
    for axis, part in zip("XYZ", position.direction, strict=True):
        if abs(part) > 0.3:
            tilt = angle_between_deg(position.direction, [part if axis == name else 0.0 for name in "XYZ"])
            way = "down" if part > 0 else "up"
            arrows.append(f"{axis} arrow {way}" + (f" ({tilt:.0f}° off)" if tilt >= 10.0 else ""))
    if table:
        return f"lay the part flat on the table, against the mark, with its {', '.join(arrows)}"
    check = " (check)" if position.use == "check" else ""
    return f"hold the part with its {', '.join(arrows)}, still, near enough{check}"
