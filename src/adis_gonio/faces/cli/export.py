"""`adis-gonio export`."""

from __future__ import annotations

import shutil
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import working
from adis_gonio.handover.formats import BY_NAME, format_of

if TYPE_CHECKING:
    from adis_gonio.handover.session_export import ExportSource
    from adis_gonio.record.loading import Overrides

STANDARD_OUTPUT = "-"


@click.command("export")
@option.session
@click.option(
    "--format",
    "kind",
    type=click.Choice(list(BY_NAME)),
    help="By default the ending of the file says it.",
)
@click.option("-o", "--output", help="File to make; - is standard output.")
@click.option("--method", help="Method of the coefficients; the best one unless told.")
@click.option("--trace", "traced", is_flag=True, help="Coefficients of the traced model.")
@click.option("--samples", is_flag=True, help="JSON: every sample too.")
@click.option("--name", help="C header: what every name in it begins with.  [default: adis_gonio]")
@option.file(
    "--gyros",
    help="Gyros of another session of this part (plan gyro-turns), or of a calibration file.",
)
@click.option("--force", is_flag=True, help="Replace a file that exists.")
@option.overrides
def command(
    *,
    session: Path,
    kind: str | None,
    output: str | None,
    method: str | None,
    traced: bool,
    samples: bool,
    name: str | None,
    gyros: Path | None,
    force: bool,
    overrides: Overrides,
) -> None:
    r"""Hand a session's coefficients or data over to other programs.

    \b
    c-header   .h              gravity and angle in C, fixed point and float
    json       .json           a calibration file, the fit or trace, what is known of the session
    csv        .csv .csv.gz    samples, as adis-gonio fit reads them back
    parquet    .parquet        samples (extra: parquet)
    dcc        .xml            digital calibration certificate
    registers  .txt            offsets, as adis-gonio registers takes them

    A session whose registers changed in the middle gives no coefficients but in the fit of its json.
    SESSION may be a calibration file for c-header, dcc and registers.
    """
    from adis_gonio.base.output import check_output, replacing
    from adis_gonio.handover.session_export import ExportSource

    if kind is None and output in (None, STANDARD_OUTPUT):
        raise UsageError("what shall be made? Give -o FILE with an ending such as .h or .json, or --format")
    kind = kind or format_of(str(output))
    named = {} if name is None else {"name": name}
    source = ExportSource(session, method, traced, samples, **named, overrides=overrides, gyros=gyros)
    source.check(kind)
    if output is None and BY_NAME[kind].holds == "samples":
        raise UsageError(f"--format {kind} needs -o FILE; -o - is standard output")
    checked = None if output in (None, STANDARD_OUTPUT) else check_output(Path(str(output)), force=force)
    with working(f"tracing {session.name}") if traced else nullcontext():
        if checked is None:
            remarks = _to_standard_output(source, kind)
        else:
            with replacing(checked) as beside:
                remarks = source.write(kind, beside)
    for remark in remarks:
        click.echo(f"{session}: {remark}", err=True)


def _to_standard_output(source: ExportSource, kind: str) -> list[str]:
    """Whole or not at all: what fails half-way has said nothing. Returns the remarks on the content."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "export"
        remarks = source.write(kind, path)
        with path.open("rb") as file:
            shutil.copyfileobj(file, sys.stdout.buffer)
        sys.stdout.flush()
    return remarks
