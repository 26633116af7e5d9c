"""`adis-gonio due`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.remembering import remembered, sessions_of
from adis_gonio.faces.cli.show import console, print_json

if TYPE_CHECKING:
    from adis_gonio.fleet.calibration_due import Due

_POSITIVE = click.FloatRange(min=0, min_open=True)


@click.command("due")
@click.argument("serial")
@option.places
@click.option(
    "--limit",
    "limit_deg",
    type=_POSITIVE,
    metavar="DEG",
    help="Permissible error of an angle, which your use of it decides; without it 0.1° is assumed.",
)
@option.shown(
    "--first", "first_days", type=_POSITIVE, default=365.25, metavar="DAYS",
    help="Interval of a sensor of which nothing is known yet.",
)  # fmt: skip
@option.shown("--longer", type=click.FloatRange(min=1), default=1.5, help="Factor after a good one.")
@option.shown(
    "--shorter", type=click.FloatRange(0, 1, min_open=True), default=0.5,
    help="Factor after one outside the limit.",
)  # fmt: skip
@option.index
@option.json
def command(
    *,
    serial: str,
    places: tuple[Path, ...],
    limit_deg: float | None,
    index_path: Path | None,
    trace: bool,
    as_json: bool,
    **more: Any,
) -> None:
    """Say when a sensor is to be calibrated next, by which rule and why (ILAC-G24 / OIML D 10).

    Staircase: intervals grow while the calibration before was still good, and shrink when it was not.
    Control chart: the day on which drift and U reach the permissible error. The earlier date counts.
    """
    from adis_gonio.fleet.calibration_due import DEFAULT_LIMIT_DEG, Rules, due_of
    from adis_gonio.fleet.sensor_history import history_of

    limits = Rules(DEFAULT_LIMIT_DEG if limit_deg is None else limit_deg, limit_deg is None, **more)
    with remembered(places, index_path, trace=trace) as (store, _):
        found = due_of(history_of(serial, sessions_of(store, serial)), limits)
    if as_json:
        print_json(found.as_dict())
    else:
        _show(found)


def _show(found: Due) -> None:
    screen = console(most=100)
    date = f"{found.date}, by the {found.by}" if found.date else "cannot be said"
    screen.print(f"Next calibration of {found.serial}: {date}", style="bold")
    for rule in found.rules:
        screen.print(f"  {rule.method}: {rule.date or 'no date'}: {rule.why}")
        if rule.assumes:
            screen.print(f"    assumes: {rule.assumes}")
    if found.limits.assumed:
        screen.print(
            f"  {found.limits.limit_deg:g}° is assumed as permissible error of an angle: --limit says yours"
        )
