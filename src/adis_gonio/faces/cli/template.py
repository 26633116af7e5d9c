"""`adis-gonio template`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in
from adis_gonio.faces.cli.overrides import UNITS, fixture, gravity, unit
from adis_gonio.model.records import SENSORS, STANDARD_GRAVITY_MPS2


@click.command("template")
@click.option(
    "--plan",
    "plan_name",
    default="two-position",
    show_default=True,
    help="two-position, four-position, mmpm, tumble, poses, or a plan file.",
)
@click.option("--positions", type=int, help="Number of angles, where the plan leaves a choice.")
@click.option(
    "--check", type=int, default=0, show_default=True, help="Extra positions kept out of the fit."
)
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="CSV file to make.")
@click.option("--sensor", type=click.Choice(SENSORS), default=SENSORS[0], show_default=True)
@click.option(
    "--unit", "accel_unit", type=unit, metavar=UNITS, default="mg", show_default=True,
    help="Unit of the accelerations.",
)  # fmt: skip
@click.option(
    "--gravity", "gravity_mps2", type=gravity, metavar="M/S²", default=STANDARD_GRAVITY_MPS2,
    show_default=True, help="Local gravity in m/s².",
)  # fmt: skip
@click.option(
    "--fixture", "fixture_sigma_deg", type=fixture, metavar="DEGREES",
    help="Standard uncertainty of a stage angle, degrees.",
)  # fmt: skip
def command(*, plan_name: str, positions: int | None, check: int, output: Path, **keys: Any) -> None:
    """Make an empty samples file to fill in: keys with what they mean, one row a position of the plan.

    Fill in times and readings, in an editor or a spreadsheet; `adis-gonio fit` reads what is saved.
    """
    from adis_gonio.plan.document import plan_by
    from adis_gonio.record.template import template_text, write_template

    if ends_in(output, ".gz"):
        raise UsageError(f"{output}: a template is filled in by hand: name it .csv")
    chosen = plan_by(plan_name, positions, check)
    write_template(output, template_text(chosen, **keys))
    click.echo(f"{output}: {counted(len(chosen), 'position')} to fill in", err=True)
