"""`adis-gonio allan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli.overrides import load, override_options
from adis_gonio.faces.cli.show import console, json_option, print_json
from adis_gonio.faces.cli.working import working

if TYPE_CHECKING:
    from adis_gonio.fitting.allan import AllanResult
    from adis_gonio.fitting.allan.rests import Part
    from adis_gonio.record.overrides import Overrides

_ENDINGS = (".html", ".htm", ".svg")


@click.command("allan")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--sensor-part",
    "part",
    type=click.Choice(("gyro", "accelerometer")),
    default="gyro",
    show_default=True,
    help="Whose noise.",
)
@click.option(
    "--filter",
    "filter_m",
    type=click.IntRange(0, 6),
    metavar="M",
    help="The chip's filter was 2^M taps twice, where the file does not say it.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="Write a page with the Allan plot (.html), or the plot alone (.svg) (extra: report).",
)
@override_options
@json_option
def command(
    *,
    session: Path,
    part: Part,
    filter_m: int | None,
    output: Path | None,
    as_json: bool,
    overrides: Overrides,
) -> None:
    """Say the noise of a part at rest: random walks, bias instability, each with its uncertainty.

    From the dwells of a session, or the rests of a continuous recording, by maximum likelihood, beside the
    Allan deviation. Noise that is not there is said so, with its limit. How long to record: docs/allan.md.
    """
    from adis_gonio.base.output import check_output
    from adis_gonio.fitting.allan import fit_allan

    if output is not None:
        if output.suffix.lower() not in _ENDINGS:
            raise UsageError(f"{output}: its ending says the format: .html for the page, .svg for the plot")
        check_output(output, force=True)
        from adis_gonio.page.svg import require_matplotlib

        require_matplotlib()
    loaded = load(session, overrides)
    with working(f"noise of {session.name}"):
        found = fit_allan(loaded, part, filter_m=filter_m)
    if output is not None:
        _write(found, output)
    if as_json:
        print_json(found.as_dict())
    else:
        screen = console(most=80)
        for line in found.summary().splitlines():
            screen.print(line)


def _write(found: AllanResult, output: Path) -> None:
    from adis_gonio.base.output import replacing, write_utf8
    from adis_gonio.handover.report.allan import allan_page, allan_svg

    text = allan_svg(found) if output.suffix.lower() == ".svg" else allan_page(found)
    with replacing(output) as beside:
        size = write_utf8(beside, text)
    click.echo(f"{output}: {size // 1024 + 1} kB", err=True)
