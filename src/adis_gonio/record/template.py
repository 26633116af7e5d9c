"""An empty samples CSV to fill in by hand: keys, what they mean, and one row a position of a plan."""

from __future__ import annotations

import math
from pathlib import Path

from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.base.output import exists_error
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, AccelUnit
from adis_gonio.record.plans import Plan, Position

# No line of help has a colon: it would be a key.
_HELP = (
    "-- One row is one averaged reading; for more samples repeat the row with its position and angle.",
    "-- time_s is the time of the reading in seconds from any origin, row after row later.",
    "-- accel_unit is lsb, mg, g, mps2 or counts; reading_u_mg the standard uncertainty of a reading.",
    "-- fixture_sigma_deg is the standard uncertainty of a stage angle in degrees; empty is not stated.",
    "-- Columns that the format does not know may be added; they are ignored. A spreadsheet may save it.",
)


def template_text(
    plan: Plan,
    *,
    sensor: str = "adis16354",
    accel_unit: AccelUnit = "mg",
    gravity_mps2: float = STANDARD_GRAVITY_MPS2,
    fixture_sigma_deg: float | None = None,
) -> str:
    """The file as text; times and readings are left empty, and whoever fills them in changes nothing else.

    Raises
    ------
    UsageError
        Readings in LSB of a sensor whose LSB is not known.
    """
    if sensor == "generic" and accel_unit == "lsb":
        raise UsageError("a generic sensor has no LSB that is known: give --unit mg, g, mps2 or counts")
    planar = plan.plane == "xy"
    sigma = fixture_sigma_deg if planar else math.inf
    keys = {
        "title": "",
        "operator": "",
        "serial": "",
        "stage": "",
        "sensor": sensor,
        "accel_unit": accel_unit,
        "gravity_mps2": repr(gravity_mps2),
        "fixture_sigma_deg": "" if sigma is None else "free" if math.isinf(sigma) else f"{sigma:g}",
        "plane": plan.plane,
        "reading_u_mg": "",
    }
    columns = ["time_s", "position", *(["angle_deg", "approach"] if planar else []), "ax", "ay"]
    columns += [] if planar else ["az"]
    checks = any(position.use == "check" for position in plan.positions)
    columns += ["use"] if checks else []
    lines = [f"# {key}: {value}".rstrip() for key, value in keys.items()]
    lines += [f"# {line}" for line in _HELP]
    lines.append(",".join(columns))
    for number, position in enumerate(plan.positions):
        cells = _cells(number, position)
        lines.append(",".join(cells.get(name, "") for name in columns))
    return "\n".join(lines) + "\n"


def _cells(number: int, position: Position) -> dict[str, str]:
    angle = position.angle_deg
    return {
        "position": str(number),
        "angle_deg": "" if angle is None else f"{angle:.10g}",
        "approach": f"{position.approach:+d}" if position.approach else "",
        "use": position.use,
    }


def write_template(path: Path, text: str) -> None:
    """Write a new file.

    Raises
    ------
    UsageError
        The file exists.
    SessionError
        It cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    except FileExistsError:
        raise exists_error(path) from None
    except OSError as error:
        raise SessionError(f"{path}: cannot be written: {error.strerror or error}") from None
