"""Options that say what a session's file should have said, and the loading that obeys them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.model.gravity import checked_gravity_mps2
from adis_gonio.model.records import ACCEL_UNITS, SENSORS

if TYPE_CHECKING:
    from adis_gonio.model.records import Session
    from adis_gonio.record.overrides import AngleChange, Overrides

F = TypeVar("F", bound=Callable[..., Any])

part_option = click.option(
    "--sensor-part",
    "part",
    type=click.Choice(["accelerometer", "gyro"]),
    default="accelerometer",
    show_default=True,
    help="Part of the sensor whose readings are taken.",
)


def gravity(text: str) -> float:
    """Local gravity in m/s²; outside of Earth's only with its unit, such as `1.62mps2`."""
    bare = str(text).strip().lower()
    number = bare.removesuffix("mps2").removesuffix("m/s²").removesuffix("m/s^2")
    value = _number(number)
    if value is None or not 0 < value < math.inf:
        raise click.BadParameter(f"'{text}' is no gravity: give m/s², such as 9.81")
    if number == bare:
        try:
            return checked_gravity_mps2(value)
        except UsageError as error:
            raise click.BadParameter(str(error)) from None
    return value


def fixture(text: str) -> float:
    """Standard uncertainty of a declared angle in degrees; `free` is infinite."""
    if str(text).strip().lower() == "free":
        return math.inf
    sigma = _number(str(text))
    if sigma is None or not 0 <= sigma < 180:
        raise click.BadParameter(f"'{text}': give degrees, 0 or more, or free where angles are unknown")
    return sigma


UNITS = f"[{'|'.join(ACCEL_UNITS)}]"
"""The units in a command's help."""


def unit(text: str) -> str:
    """One of `ACCEL_UNITS`; m/s² and m/s^2 are what people write for `mps2`."""
    name = {"m/s²": "mps2", "m/s^2": "mps2"}.get(str(text).strip().lower(), str(text))
    if name not in ACCEL_UNITS:
        raise click.BadParameter(f"'{text}' is no unit: give {', '.join(ACCEL_UNITS)}")
    return name


def _columns(text: str) -> dict[str, str]:
    """Column of the format → column of the file, from `name=column,…`."""
    columns: dict[str, str] = {}
    for pair in text.split(","):
        mine, equals, theirs = (part.strip() for part in pair.partition("="))
        if not (mine and equals and theirs):
            raise click.BadParameter(f"'{pair.strip()}': write name=column, such as time=t,ax=Acc_X")
        if mine in columns:
            raise click.BadParameter(f"'{mine}' stands there twice")
        columns[mine] = theirs
    return columns


_ANGLE = re.compile(r"(\d+)(?:-(\d+))?\s*(\+?=)\s*(\S+)")


def _angles(text: str) -> tuple[AngleChange, ...]:
    """Changes from `position=degrees,…`; `first-last+=degrees` adds, `first-last=reverse` turns back."""
    from adis_gonio.record.overrides import REVERSE, AngleChange

    changes = []
    for part in text.split(","):
        found = _ANGLE.fullmatch(part.strip())
        value = None if found is None else _number(found[4])
        back = found is not None and found[3] == "=" and found[4] == REVERSE
        if found is None or not (back or (value is not None and math.isfinite(value))):
            raise click.BadParameter(
                f"'{part.strip()}': write position=degrees, such as 7=210, 7-12+=1.5 to add to several, or"
                f" 7-12={REVERSE} where the stage turned the other way"
            )
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise click.BadParameter(f"'{part.strip()}': the second position is before the first")
        changes.append(AngleChange(first, last, value, added=found[3] == "+="))
    return tuple(changes)


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def override_options(function: F) -> F:
    """Add the options; the command gets them as one argument, `overrides`."""

    @wraps(function)
    def with_overrides(**arguments: Any) -> Any:
        from adis_gonio.record.overrides import Overrides

        taken = {name: arguments.pop(name) for name in _NAMES}
        taken["columns"] = taken["columns"] or {}
        taken["angles"] = taken["angles"] or ()
        return function(overrides=Overrides(**taken), **arguments)

    for option in reversed(_OPTIONS):
        with_overrides = option(with_overrides)
    return with_overrides  # type: ignore[return-value]


_OPTIONS = (
    click.option(
        "--gravity", "gravity_mps2", type=gravity, metavar="M/S²", help="Local gravity was this, m/s²."
    ),
    click.option(
        "--fixture",
        "fixture_sigma_deg",
        type=fixture,
        metavar="DEGREES",
        help="Standard uncertainty of a stage angle was this, degrees; free: angles are unknown.",
    ),
    click.option(
        "--angles",
        type=_angles,
        metavar="POSITION=DEGREES,…",
        help="Positions stood at other angles than declared, such as 7=210; 7-12+=1.5 adds to several,"
        " 7-12=reverse turns them the other way, seen from the position before.",
    ),
    click.option("--reverse", is_flag=True, help="The stage turned the other way than declared."),
    click.option(
        "--unit", "accel_unit", type=unit, metavar=UNITS, help="Unit of the file's accelerations."
    ),
    click.option("--sensor", type=click.Choice(SENSORS), help="The sensor was this one."),
    click.option(
        "--columns",
        type=_columns,
        metavar="NAME=COLUMN,…",
        help="A CSV's own names of columns, such as time=t,ax=Acc_X,ay=Acc_Y.",
    ),
)
_NAMES = ("gravity_mps2", "fixture_sigma_deg", "angles", "reverse", "accel_unit", "sensor", "columns")


def load(path: Path, overrides: Overrides) -> Session:
    """Session of a file, with progress on standard error where it takes long."""
    from adis_gonio.faces.cli.working import working
    from adis_gonio.record.loading import load_session

    with working(f"reading {path.name}"):
        return load_session(path, overrides)
