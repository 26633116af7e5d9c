"""Arguments and options that several commands share, each declared once."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import ACCEL_UNITS, SENSORS, checked_gravity_mps2

if TYPE_CHECKING:
    from adis_gonio.model.records import Session
    from adis_gonio.record.loading import AngleChange, Overrides
    from adis_gonio.record.settings import Settings

F = TypeVar("F", bound=Callable[..., Any])
Option = Callable[[F], F]
FILE = click.Path(path_type=Path)


def parse_gravity(text: str) -> float:
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


def parse_fixture(text: str) -> float:
    """Standard uncertainty of a declared angle in degrees; `free` is infinite."""
    if str(text).strip().lower() == "free":
        return math.inf
    sigma = _number(str(text))
    if sigma is None or not 0 <= sigma < 180:
        raise click.BadParameter(f"'{text}': give degrees, 0 or more, or free where angles are unknown")
    return sigma


UNITS = f"[{'|'.join(ACCEL_UNITS)}]"
"""The units in a command's help."""


def parse_unit(text: str) -> str:
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
    from adis_gonio.record.loading import REVERSE, AngleChange

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


url = click.argument("url")
session = click.argument("session", type=FILE)
places = click.argument(
    "places", type=click.Path(path_type=Path, readable=False), nargs=-1, metavar="[DIR]..."
)


def file(*names: str, help: str, **more: Any) -> Option[Any]:
    """Return an option that names a file."""
    return click.option(*names, type=FILE, help=help, **more)


def output(help: str, **more: Any) -> Option[Any]:
    """Return `-o`, the file to make."""
    return file("-o", "--output", help=help, **more)


def shown(*names: str, default: Any, help: str, **more: Any) -> Option[Any]:
    """Return an option whose help shows its default."""
    return click.option(*names, default=default, show_default=True, help=help, **more)


def dwell(default_s: float = 10.0) -> Option[Any]:
    """Return `--dwell`."""
    return shown("--dwell", "dwell_s", type=float, default=default_s, help="Length of a dwell in s.")


json = click.option("--json", "as_json", is_flag=True, help="One JSON document on standard output.")
variant = shown("--variant", default="adis16354", help="adis16354, adis16350 or adis16355.")
poll = click.option(
    "--poll", is_flag=True, help="Poll the scans: leave the data-ready line alone, whatever is on it."
)
no_check = click.option(
    "--no-check", is_flag=True, help="Open without proving that |a| is 1 g for this variant."
)
seconds = click.option("--seconds", type=float, help="Stop after so long; without it, at Ctrl-C.")
positions = click.option("--positions", type=int, help="Number of angles, where the plan leaves a choice.")
check = shown("--check", type=int, default=0, help="Extra positions kept out of the fit.")
settle = shown("--settle", "settle_s", type=float, default=0.5, help="Wait after stillness, s.")
rate = click.option("--rate", "rate_hz", type=float, help="Samples a second, 0.413 to 819.2 (default).")
filter = shown("--filter", "filter_m", type=int, default=2, help="Filter: 2^M taps twice.")
title = click.option("--title", default="", help="Title to keep with the session.")
gravity = click.option(
    "--gravity",
    "gravity_mps2",
    type=parse_gravity,
    metavar="GRAVITY",
    help="Local gravity in m/s² (default 9.80665).",
)
_OVERRIDES = (
    click.option(
        "--gravity",
        "gravity_mps2",
        type=parse_gravity,
        metavar="M/S²",
        help="Local gravity was this, m/s².",
    ),
    click.option(
        "--fixture",
        "fixture_sigma_deg",
        type=parse_fixture,
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
        "--unit", "accel_unit", type=parse_unit, metavar=UNITS, help="Unit of the file's accelerations."
    ),
    click.option("--sensor", type=click.Choice(SENSORS), help="The sensor was this one."),
    click.option(
        "--columns",
        type=_columns,
        metavar="NAME=COLUMN,…",
        help="A CSV's own names of columns, such as time=t,ax=Acc_X,ay=Acc_Y.",
    ),
)
_OVERRIDDEN = ("gravity_mps2", "fixture_sigma_deg", "angles", "reverse", "accel_unit", "sensor", "columns")


def fixture(name: str = "fixture_deg", metavar: str = "FIXTURE", **more: Any) -> Option[Any]:
    """Return `--fixture`."""
    text = "Standard uncertainty of a stage angle, degrees."
    return click.option("--fixture", name, type=parse_fixture, metavar=metavar, help=text, **more)


def part(
    default: str = "accelerometer", help: str = "Part of the sensor whose readings are taken."
) -> Option[Any]:
    """Return `--sensor-part`."""
    parts = click.Choice(sorted(("accelerometer", "gyro"), key=lambda part: part != default))
    return shown("--sensor-part", "part", type=parts, default=default, help=help)


def time_limit(help: str) -> Option[Any]:
    """Return `--time-limit`."""
    above_0 = click.FloatRange(min=0, min_open=True)
    return click.option("--time-limit", type=above_0, metavar="SECONDS", help=help)


def index(function: F) -> F:
    """Add `--index` and `--trace`."""
    index = file(
        "--index",
        "index_path",
        metavar="FILE",
        help="Where results are kept; by default adis-gonio.index in the first folder.",
    )
    trace = click.option(
        "--trace", is_flag=True, help="Look for effects too: seconds to half a minute a session, once."
    )
    with_trace: F = index(trace(function))
    return with_trace


def overrides(function: F) -> F:
    """Add the options; the command gets them as one argument, `overrides`."""

    @wraps(function)
    def with_overrides(**arguments: Any) -> Any:
        from adis_gonio.record.loading import Overrides

        taken = {name: arguments.pop(name) for name in _OVERRIDDEN}
        taken["columns"] = taken["columns"] or {}
        taken["angles"] = taken["angles"] or ()
        return function(overrides=Overrides(**taken), **arguments)

    for option in reversed(_OVERRIDES):
        with_overrides = option(with_overrides)
    return with_overrides  # type: ignore[return-value]


def measuring_settings(*, dwell_s: float, rate_hz: float | None, filter_m: int, **more: Any) -> Settings:
    """Return the settings of a session by `--dwell`, `--rate`, `--filter` and others by their names."""
    from adis_gonio.device.sensor.settings import smpl_prd_for
    from adis_gonio.record.settings import Settings

    smpl_prd = 1 if rate_hz is None else smpl_prd_for(rate_hz)
    return Settings(dwell_s=dwell_s, smpl_prd=smpl_prd, filter_m=filter_m, **more)


def load(path: Path, overrides: Overrides) -> Session:
    """Session of a file, with progress on standard error where it takes long."""
    from adis_gonio.faces.cli.show import working
    from adis_gonio.record.loading import load_session

    with working(f"reading {path.name}"):
        return load_session(path, overrides)
