"""`adis-gonio template`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in
from adis_gonio.faces.cli import options as option
from adis_gonio.model.records import SENSORS, STANDARD_GRAVITY_MPS2


@click.command("template")
@option.shown(
    "--plan",
    "plan_name",
    default="two-position",
    help="two-position, four-position, mmpm, tumble, poses, or a plan file.",
)
@option.positions
@option.check
@option.output("CSV file to make.", required=True)
@option.shown("--sensor", type=click.Choice(SENSORS), default=SENSORS[0], help="")
@option.shown(
    "--unit",
    "accel_unit",
    type=option.parse_unit,
    metavar=option.UNITS,
    default="mg",
    help="Unit of the accelerations.",
)
@option.shown(
    "--gravity", "gravity_mps2", type=option.parse_gravity, metavar="M/S²", default=STANDARD_GRAVITY_MPS2,
    help="Local gravity in m/s².",
)  # fmt: skip
@option.fixture("fixture_sigma_deg", metavar="DEGREES")
def command(*, plan_name: str, positions: int | None, check: int, output: Path, **keys: Any) -> None:
    """Make an empty samples file to fill in: keys with what they mean, one row a position of the plan.

    Fill in times and readings, in an editor or a spreadsheet; `adis-gonio fit` reads what is saved.
    """
    from adis_gonio.plan.document import plan_by
    from adis_gonio.record.samples_writer import template_text, write_template

    if ends_in(output, ".gz"):
        raise UsageError(f"{output}: a template is filled in by hand: name it .csv")
    chosen = plan_by(plan_name, positions, check)
    write_template(output, template_text(chosen, **keys))
    click.echo(f"{output}: {counted(len(chosen), 'position')} to fill in", err=True)
