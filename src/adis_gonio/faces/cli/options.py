"""Arguments and options that several commands share, each declared once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from functools import reduce, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli.command_groups import SectionedCommand
from adis_gonio.model.records import ACCEL_UNITS, SENSORS, checked_gravity_mps2

if TYPE_CHECKING:
    from adis_gonio.model.records import Session, StageCurve
    from adis_gonio.record.loading import Overrides
    from adis_gonio.record.source import Settings

F = TypeVar("F", bound=Callable[..., Any])
Option = Callable[[F], F]
FILE = click.Path(path_type=Path)
UNITS = f"[{'|'.join(ACCEL_UNITS)}]"
"""Text that lists the units of acceleration, for the help of a command."""
_SHARED_SECTIONS = {
    "Measuring": "--dwell --settle --rate --filter --range --poll",
    "Sensor": "--sensor --no-check --sensor-part",
    "Corrections of the file": "--gravity --fixture --angles --reverse --unit --sensor --columns"
    " --laboratory --customer",
}


def command(
    name: str, first: str = "", sections: Mapping[str, str] | None = None
) -> Callable[[Callable[..., Any]], click.Command]:
    """Return a decorator that makes a function a command with options in sections.

    Parameters
    ----------
    name : str
        Name of the command.
    first : str
        The flags that an operator needs first, separated by spaces; without any, the help lists all options
        in one section.
    sections : mapping of str to str, optional
        Further sections of the help: flags by heading, see `SectionedCommand`.
    """
    own = sections or {}
    shared = {heading: flags for heading, flags in _SHARED_SECTIONS.items() if heading not in own}
    listed = {"Main options": first, **own, **shared} if first else {}
    return click.command(name, cls=SectionedCommand, sections=listed)


def _with(function: Callable[..., Any], *options: Option[Any]) -> Callable[..., Any]:
    """Return a function of a command with these options, which the help lists in this order."""
    return reduce(lambda made, option: option(made), reversed(options), function)


def parse_gravity(text: str) -> float:
    """Parse local gravity in m/s².

    A value that no place on Earth has needs its unit, such as `1.62mps2`.
    """
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
    """Parse the standard uncertainty of a declared angle in degrees; `free` means infinite."""
    if str(text).strip().lower() == "free":
        return math.inf
    sigma = _number(str(text))
    if sigma is None or not 0 <= sigma < 180:
        raise click.BadParameter(f"'{text}': give degrees, 0 or more, or free if the angles are unknown")
    return sigma


def parse_stage(text: str) -> float | StageCurve:
    """Parse the uncertainty in degrees of a declared angle, or read a certificate.

    The text `dcc:FILE` reads the stage's certificate from a file.
    """
    if str(text).startswith("dcc:"):
        from adis_gonio.handover.certificate import read_stage_curve

        return read_stage_curve(Path(str(text).removeprefix("dcc:")))
    return parse_fixture(text)


def parse_positive(text: str) -> float:
    """Parse a number above 0, such as a time in s."""
    value = _number(str(text))
    if value is None or not value > 0:
        raise click.BadParameter(f"'{text}': give a number above 0")
    return value


def parse_unit(text: str) -> str:
    """Parse a unit of acceleration, one of `ACCEL_UNITS`; `m/s²` and `m/s^2` also mean `mps2`."""
    name = {"m/s²": "mps2", "m/s^2": "mps2"}.get(str(text).strip().lower(), str(text))
    if name not in ACCEL_UNITS:
        raise click.BadParameter(f"'{text}' is no unit: give {', '.join(ACCEL_UNITS)}")
    return name


def _parse_columns(text: str) -> dict[str, str]:
    """Parse `name=column,…`: map each column of the samples format to a column of the user's file."""
    columns: dict[str, str] = {}
    for pair in text.split(","):
        mine, equals, theirs = (part.strip() for part in pair.partition("="))
        if not (mine and equals and theirs):
            raise click.BadParameter(f"'{pair.strip()}': write name=column, such as time=t,ax=Acc_X")
        if mine in columns:
            raise click.BadParameter(f"'{mine}' is given twice")
        columns[mine] = theirs
    return columns


def _parse_angles(text: str) -> dict[int, float]:
    """Parse declared angles in degrees by position number from `position=degrees,…`."""
    angles: dict[int, float] = {}
    for part in text.split(","):
        position, _, degrees = (piece.strip() for piece in part.partition("="))
        value = _number(degrees)
        if not position.isdecimal() or value is None or not math.isfinite(value):
            raise click.BadParameter(f"'{part.strip()}': write position=degrees, such as 7=210")
        if int(position) in angles:
            raise click.BadParameter(f"position {position} is given twice")
        angles[int(position)] = value
    return angles


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def file(*names: str, help: str, **more: Any) -> Option[Any]:
    """Return an option that names a file, with its help text; `more` goes to `click.option`."""
    return click.option(*names, type=FILE, help=help, **{"metavar": "FILE", **more})


def check_session_name(path: Path) -> None:
    """Raise `UsageError` if a new session file has the ending of another format, such as `.csv`."""
    from adis_gonio.base.output import ends_in

    if ends_in(path, ".csv", ".gz", ".json", ".html", ".svg", ".xml", ".h", ".txt", ".parquet"):
        raise UsageError(f"{path}: becomes a session file: name it {path.stem}.session")


STANDARD_OUTPUT = Path("-")


def output(
    help: str,
    *,
    paths: Callable[[Any], Iterable[Path]] = lambda given: (given,),
    name: str = "output",
    **more: Any,
) -> Option[Any]:
    """Return a decorator with the options `-o` for the file to write, and `--force` to replace it.

    `help` is the help text of `-o`; `more` goes to `click.option`. A file that exists is refused before the
    command begins, unless `--force` is given. The command gets the file only, and replaces it when it has
    something to write.

    Parameters
    ----------
    paths : callable
        Returns the files that the command writes for the given path; by default only that path.
    name : str
        Name of the command's argument.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def checked(*, force: bool, **arguments: Any) -> Any:
            from adis_gonio.base.output import check_output

            given = arguments[name]
            inputs = [value for key, value in arguments.items() if key != name and isinstance(value, Path)]
            for path in () if given is None else paths(given):
                if path == STANDARD_OUTPUT:
                    raise UsageError("-o -: only export writes to standard output; name a file")
                check_output(path, force=force)
                if any(path.exists() and one.exists() and path.samefile(one) for one in inputs):
                    raise UsageError(f"{path}: the command reads this file; name another one for -o")
            return function(**arguments)

        force = flag("--force", help="Replace an existing file.")
        return _with(checked, file("--output", "-o", name, help=help, **more), force)

    return decorate


def flag(*names: str, help: str) -> Option[Any]:
    """Return an option that takes no value, with its help text."""
    return click.option(*names, is_flag=True, help=help)


def with_default(*names: str, default: Any, help: str, **more: Any) -> Option[Any]:
    """Return an option that shows its default in the help; `more` goes to `click.option`."""
    return click.option(*names, default=default, show_default=True, help=help, **more)


def dwell(default_s: float = 10.0) -> Option[Any]:
    """Return the option `--dwell` for the length of a dwell in s, with this default."""
    help = "Length of a dwell."
    return with_default("--dwell", "dwell_s", type=float, default=default_s, metavar="SECONDS", help=help)


def fixture(
    name: str = "fixture_deg",
    metavar: str = "DEGREES",
    help: str = "Standard uncertainty of a stage angle in degrees.",
    **more: Any,
) -> Option[Any]:
    """Return the option `--fixture` for the standard uncertainty of a stage angle in degrees.

    `name` is the argument of the command; `metavar` stands for the value in the help.
    """
    return click.option("--fixture", name, metavar=metavar, help=help, **{"type": parse_fixture, **more})


def gravity(help: str = "Local gravity in m/s² (default 9.80665).", **more: Any) -> Option[Any]:
    """Return the option `--gravity` for local gravity in m/s²."""
    return click.option("--gravity", "gravity_mps2", type=parse_gravity, metavar="M/S²", help=help, **more)


def part(default: str = "accelerometer") -> Option[Any]:
    """Return the option `--sensor-part`, which selects accelerometer or gyro.

    `default` is the preselected part.
    """
    parts = click.Choice(sorted(("accelerometer", "gyro"), key=lambda part: part != default))
    return with_default(
        "--sensor-part", "part", type=parts, default=default, help="Part of the sensor to use."
    )


def seed(default: int = 0, help: str = "Seed of all random numbers.") -> Option[Any]:
    """Return the option `--seed` for a whole number from 0, with this default and help text."""
    return with_default("--seed", type=click.IntRange(min=0), default=default, help=help)


def time_limit(help: str) -> Option[Any]:
    """Return the option `--time-limit` in seconds, with this help text."""
    return click.option("--time-limit", type=parse_positive, metavar="SECONDS", help=help)


def what_if(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a command with the options `--with`, `--without` and `--only`."""
    include = click.option(
        "--with",
        "include",
        multiple=True,
        metavar="TERM",
        help="Put this term into the model: an effect with axes, such as quadratic:x, or a formula, such as"
        " 'mine_x = (T-25)**2 * gx' (gx gy gz angle t T V approach).",
    )
    exclude = click.option(
        "--without", "exclude", multiple=True, metavar="NAME", help="Leave this effect out of the model."
    )
    only = flag("--only", help="No term other than the terms of --with.")
    return _with(function, include, exclude, only)


url = click.argument("url")
session = click.argument("session", type=FILE)
sessions = click.argument("sessions", type=FILE, nargs=-1, required=True, metavar="SESSION...")
places = click.argument(
    "places", type=click.Path(path_type=Path, readable=False), nargs=-1, metavar="[DIR]..."
)
json = flag("--json", "as_json", help="Write one JSON document to standard output.")
variant = with_default(
    "--sensor", "variant", default="adis16354", help="Sensor variant: adis16354, adis16350 or adis16355."
)
poll = flag("--poll", help="Poll the scans and leave the data-ready line alone.")
no_check = flag("--no-check", help="Open the sensor without checking that |a| is 1 g for this variant.")
seconds = click.option(
    "--seconds", type=parse_positive, metavar="SECONDS", help="Stop after this time (default: at Ctrl-C)."
)
positions = click.option(
    "--positions", type=int, metavar="N", help="Number of positions, if the plan leaves a choice."
)
check = with_default(
    "--check", type=int, default=0, metavar="N", help="Extra positions that the fit does not use."
)
settle = with_default(
    "--settle", "settle_s", type=float, default=0.5, metavar="SECONDS", help="Wait after stillness."
)
rate = click.option(
    "--rate",
    "rate_hz",
    type=float,
    metavar="HZ",
    help="Samples per second, 0.413 to 819.2 (default; 102.4 with hands=free).",
)
filter = with_default(
    "--filter", "filter_m", type=int, default=2, metavar="M", help="Filter: two passes of 2^M taps."
)
title = click.option("--title", default="", help="Title to keep with the session.")
_OVERRIDES = (
    gravity("Correct the local gravity to this value in m/s²."),
    click.option(
        "--fixture",
        "fixture_sigma_deg",
        type=parse_stage,
        multiple=True,
        metavar="DEGREES|dcc:FILE",
        help="Correct the standard uncertainty of a stage angle in degrees; free: the angles are unknown;"
        " dcc:stage.xml: correct the angles by the stage's certificate.",
    ),
    click.option(
        "--angles",
        type=_parse_angles,
        metavar="POSITION=DEGREES,…",
        help="Correct declared angles, such as 7=210,8=240.",
    ),
    flag("--reverse", help="The stage turned the other way than declared."),
    click.option("--unit", "accel_unit", type=parse_unit, metavar=UNITS, help="Unit of the accelerations."),
    click.option("--sensor", type=click.Choice(SENSORS), help="Sensor variant."),
    click.option(
        "--columns",
        type=_parse_columns,
        metavar="NAME=COLUMN,…",
        help="Column names of a CSV, such as time=t,ax=Acc_X,ay=Acc_Y.",
    ),
    click.option("--laboratory", help="Laboratory, for the certificate."),
    click.option("--customer", help="Customer, for the certificate."),
)


def index(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a command with the options `--index` and `--trace`."""
    index = file(
        "--index",
        "index_path",
        help="Index of the results (default: adis-gonio.index in the first folder).",
    )
    trace = flag("--trace", help="Also look for effects: up to half a minute a session, once.")
    return _with(function, index, trace)


def _parse_tolerance(text: str) -> float:
    value = _number(str(text).strip().removesuffix("deg").removesuffix("°"))
    if value is None:
        raise click.BadParameter(f"'{text}' is no angle: give degrees, such as 0.1deg")
    return value


def _parse_risk(text: str) -> float:
    value, percent = _number(str(text).strip().removesuffix("%")), str(text).strip().endswith("%")
    if value is None:
        raise click.BadParameter(f"'{text}' is no risk: give a percentage, such as 2%")
    return value / 100 if percent else value


def tolerance(help: str) -> Option[Any]:
    """Return a decorator with the options `--tolerance`, `--rule` and `--risk`.

    `help` is the help text of `--tolerance`. The command gets the values as one argument, `tolerance`,
    which is None without `--tolerance`.
    """
    options = (
        click.option("--tolerance", type=_parse_tolerance, metavar="ANGLE", help=help),
        click.option(
            "--rule",
            type=click.Choice(("guarded", "simple", "shared")),
            help="Decision rule of the conformity (default: guarded; docs/handover.md).",
        ),
        click.option(
            "--risk",
            type=_parse_risk,
            metavar="PERCENT",
            help="With rule guarded: largest risk of a wrong statement (default: 2.5%).",
        ),
    )

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def with_tolerance(
            tolerance: float | None, rule: str | None, risk: float | None, **arguments: Any
        ) -> Any:
            from adis_gonio.base.conformity import Tolerance

            if tolerance is None:
                refuse(("rule", "risk"), "goes with --tolerance, such as 0.1deg")
                return function(tolerance=None, **arguments)
            given = {"rule": rule, "risk": risk}
            chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
            if risk is not None and rule not in (None, "guarded"):
                raise UsageError(f"--risk goes with the rule guarded, not with {rule}")
            return function(tolerance=Tolerance(tolerance, **chosen), **arguments)

        return _with(with_tolerance, *options)

    return decorate


def overrides(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a command with the options that replace statements of a session file, such as `--gravity`.

    The command gets the values of these options as one argument, `overrides`.
    """

    @wraps(function)
    def with_overrides(**arguments: Any) -> Any:
        from adis_gonio.record.loading import Overrides

        # The options have the names of the fields, except for the stage's curve, which --fixture gives.
        taken = {one.name: arguments.pop(one.name) for one in fields(Overrides) if one.name in arguments}
        taken["columns"] = taken["columns"] or {}
        taken["angles"] = taken["angles"] or ()
        given = taken.pop("fixture_sigma_deg")
        sigmas = [one for one in given if isinstance(one, float)]
        curves = [one for one in given if not isinstance(one, float)]
        if len(sigmas) > 1 or len(curves) > 1:
            raise UsageError("--fixture: give one uncertainty and one certificate at most")
        taken |= {"fixture_sigma_deg": next(iter(sigmas), None), "stage_curve": next(iter(curves), None)}
        return function(overrides=Overrides(**taken), **arguments)

    return _with(with_overrides, *_OVERRIDES)


def given_flags(*names: str) -> dict[str, bool]:
    """Map the flag of each named parameter (such as `--plan`) to True if it was on the command line."""
    context = click.get_current_context()
    flags = {one.name: one.opts[-1] for one in context.command.params}
    default = click.core.ParameterSource.DEFAULT
    return {flags[name]: context.get_parameter_source(name) is not default for name in names}


def refuse(names: Iterable[str], why: str) -> None:
    """Raise `UsageError` with the reason if any of the named parameters was on the command line."""
    wrong = [flag for flag, is_given in given_flags(*names).items() if is_given]
    if wrong:
        raise UsageError(f"{', '.join(wrong)}: {why}")


def measuring_settings(*, rate_hz: float | None, **more: Any) -> Settings:
    """Make the `Settings` of a session at a sample rate in Hz; None takes the fastest rate.

    `more` are further fields of the settings.
    """
    from adis_gonio.device.sensor.settings import smpl_prd_for
    from adis_gonio.record.source import Settings

    return Settings(smpl_prd=1 if rate_hz is None else smpl_prd_for(rate_hz), **more)


def load(path: Path, overrides: Overrides) -> Session:
    """Load a session from a file; `overrides` replaces statements of the file, such as local gravity.

    Progress is shown on standard error if loading takes long.
    """
    from adis_gonio.faces.cli.show import report_progress
    from adis_gonio.record.loading import load_session

    with report_progress(f"reading {path.name}"):
        return load_session(path, overrides)
