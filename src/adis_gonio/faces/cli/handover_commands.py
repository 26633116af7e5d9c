"""`export` and `paper`: coefficients for other programs, and the reproduction of the seed paper."""

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
from adis_gonio.faces.cli.show import check_page, print_json, report_progress, write_page
from adis_gonio.handover.formats import BY_NAME, format_of

if TYPE_CHECKING:
    from adis_gonio.base.conformity import Tolerance
    from adis_gonio.record.loading import Overrides

STANDARD_OUTPUT = "-"


@option.command(
    "export",
    "--output --format --method",
    {"Content": "--trace --samples --name --gyros", "Conformity": "--tolerance --rule --risk"},
)
@option.session
@click.option(
    "--format", "kind", type=click.Choice(list(BY_NAME)),
    help="Format (default: by the ending of the file).",
)  # fmt: skip
@click.option("--output", "-o", metavar="FILE", help="File to write; - is standard output.")
@click.option("--method", help="Method of the coefficients (default: the recommended one).")
@option.flag("--trace", "traced", help="Export the coefficients of the traced model.")
@option.flag("--samples", help="JSON: also write every sample.")
@click.option("--name", help="C header: prefix of every name in it.  [default: adis_gonio]")
@option.file(
    "--gyros", help="Another session of this part (plan gyro-turns), or a calibration file of its gyros."
)
@option.flag("--force", help="Replace an existing file.")
@option.tolerance("Certificate: state if the angle error is within this tolerance.")
@option.overrides
def export_command(
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
    tolerance: Tolerance | None,
    overrides: Overrides,
) -> None:
    """Export a session's coefficients or data for other programs.

    \b
    c-header   .h              gravity and angle in C, fixed point and float
    json       .json           calibration, fit or trace, facts of the session
    csv        .csv .csv.gz    samples, which adis-gonio fit reads back
    parquet    .parquet        samples (extra: parquet)
    dcc        .xml            digital calibration certificate
    registers  .txt            offsets, which adis-gonio registers takes

    If the registers changed during a session, only its json contains coefficients, in the fit. SESSION may
    be a calibration file for c-header, dcc and registers.
    """  # noqa: D301 - click keeps the lines of a paragraph with this character
    from adis_gonio.base.output import check_output, replacing
    from adis_gonio.handover.session_export import ExportSource

    if kind is None and output in (None, STANDARD_OUTPUT):
        raise UsageError(
            "no file and no format: give -o FILE with an ending such as .h or .json, or --format"
        )
    kind = kind or format_of(str(output))
    named = {} if name is None else {"name": name}
    source = ExportSource(
        session, method, traced, samples, **named, overrides=overrides, gyros=gyros, tolerance=tolerance
    )
    source.check(kind)
    if output is None and BY_NAME[kind].holds == "samples":
        raise UsageError(f"--format {kind} needs -o FILE; -o - is standard output")
    checked = None if output in (None, STANDARD_OUTPUT) else check_output(Path(str(output)), force=force)
    with report_progress(f"tracing {session.name}") if traced else nullcontext():
        if checked is not None:
            with replacing(checked) as temporary:
                remarks = source.write(kind, temporary)
        else:
            # Standard output gets the whole export or, after a failure, nothing.
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "export"
                remarks = source.write(kind, path)
                with path.open("rb") as file:
                    shutil.copyfileobj(file, sys.stdout.buffer)
                sys.stdout.flush()
    for remark in remarks:
        click.echo(f"{session}: {remark}", err=True)


@option.command("paper")
@option.output("Page to write; an existing page is replaced.")
@option.json
@option.with_default("--seed", type=int, default=0, help="Seed of all random numbers.")
@option.with_default("--sessions", type=int, default=10, help="Simulated parts of each kind.")
def paper_command(*, output: Path | None, as_json: bool, seed: int, sessions: int) -> None:
    """Reproduce the seed paper: its table 1, its figure 3, and where its method overtakes MMPM.

    Sessions are simulated through chip and driver, with the table's measured column as the true parameters.
    This takes a minute or two on two cores. Without -o and --json the conclusions are printed.
    """
    from adis_gonio.handover.paper_page import build_page, verdicts
    from adis_gonio.handover.paper_study import reproduce

    check_page(output)
    with report_progress("the seed paper"):
        done = reproduce(seed, sessions)
    if output is not None:
        write_page(output, build_page(done))
    if as_json:
        print_json(done.as_dict())
    elif output is None:
        for sentence in verdicts(done):
            click.echo(sentence)
