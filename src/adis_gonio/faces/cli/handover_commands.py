"""The commands `export` and `paper`: coefficients for other programs, and study of the seed paper."""

from __future__ import annotations

import shutil
import sys
import tempfile
from contextlib import nullcontext
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option, show
from adis_gonio.handover.formats import BY_NAME, FORMATS, format_of


@option.command(
    "export",
    "--output --format --method",
    {"Content": "--trace --name --gyros", "Conformity": "--tolerance --rule --risk"},
)
@option.session
@click.option(
    "--format", "kind", type=click.Choice(list(BY_NAME)),
    help="Format (default: by the ending of the file).",
)  # fmt: skip
@option.output(
    "File to write; - is standard output.",
    paths=lambda given: () if given == option.STANDARD_OUTPUT else (given,),
)
@click.option("--method", help="Method of the coefficients (default: the recommended one).")
@option.flag("--trace", "traced", help="Export the coefficients of the traced model.")
@click.option("--name", help="C header: prefix of every name in it.  [default: adis_gonio]")
@option.file(
    "--gyros", help="Another session of this part (plan gyro-turns), or a calibration file of its gyros."
)
@option.tolerance("Certificate: state if the angle error is within this tolerance.")
@option.overrides
def export_command(*, session: Path, kind: str | None, output: Path | None, **options: Any) -> None:
    """Export a session's coefficients or data for other programs.

    \b
    FORMATS

    If the registers changed during a session, only its json contains coefficients, in the fit. SESSION may
    be a calibration file for c-header, dcc and registers.
    """  # noqa: D301 - click keeps the lines of a paragraph with this character
    from adis_gonio.base.output import replacing
    from adis_gonio.handover.session_export import ExportSource

    to_file = output is not None and output != option.STANDARD_OUTPUT
    if kind is None and not to_file:
        raise UsageError(
            "no file and no format: give -o FILE with an ending such as .h or .json, or --format"
        )
    kind = kind or format_of(str(output))
    traced = options["traced"]
    source = ExportSource(session, **{name: one for name, one in options.items() if one is not None})
    foreign = {name for one in FORMATS for name in one.options} - set(BY_NAME[kind].options)
    if BY_NAME[kind].holds == "samples":
        foreign |= {"method", "traced", "gyros"}
    option.refuse(sorted(foreign), f"not with --format {kind}")
    option.refuse(("method",) if traced else (), "not with --trace, which has its own model")
    if output is None and BY_NAME[kind].holds == "samples":
        raise UsageError(f"--format {kind} needs -o FILE; -o - is standard output")
    shown = traced or sys.stderr.isatty()  # a log has no use for work of seconds
    what = f"{'tracing' if traced else 'exporting'} {session.name}"
    with show.report_progress(what) if shown else nullcontext():
        if output is not None and to_file:
            with replacing(output) as temporary:
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
        show.say(f"{session}: {remark}")
    if output is not None and to_file:
        show.report_written(output, kind)


_LISTED = [f"{one.name:<9} {' '.join(one.endings[:2]):<14} {one.meaning}" for one in FORMATS]
export_command.help = cleandoc(export_command.help or "").replace("FORMATS", "\n".join(_LISTED))


@option.command("paper")
@option.output("Page to write.")
@option.json
@option.seed()
@option.with_default(
    "--sessions", type=click.IntRange(2, 10_000), default=10, help="Simulated parts of each kind."
)
def paper_command(*, output: Path | None, as_json: bool, seed: int, sessions: int) -> None:
    """Reproduce the seed paper: its table 1, its figure 3, and when its method beats MMPM.

    Sessions are simulated through chip and driver, with the table's measured column as the true parameters.
    This takes about a minute. Without -o and --json the conclusions are printed.
    """
    from adis_gonio.handover.paper_study import build_page, reproduce, verdicts

    show.check_page(output)
    with show.report_progress("the seed paper"):
        done = reproduce(seed, sessions)
    if output is not None:
        show.write_page(output, build_page(done))
    if as_json:
        show.print_json(done.as_dict())
    elif output is None:
        for sentence in verdicts(done):
            show.say(sentence, err=False)
