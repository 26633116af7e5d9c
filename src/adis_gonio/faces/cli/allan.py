"""`adis-gonio allan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import check_page, console, print_json, working, write_page

if TYPE_CHECKING:
    from adis_gonio.fitting.allan.allan_fit import Part
    from adis_gonio.record.loading import Overrides

_ENDINGS = (".html", ".htm", ".svg")


@click.command("allan")
@option.session
@option.part("gyro", "Whose noise.")
@click.option(
    "--filter",
    "filter_m",
    type=click.IntRange(0, 6),
    metavar="M",
    help="The chip's filter was 2^M taps twice, where the file does not say it.",
)
@option.output("Write a page with the Allan plot (.html), or the plot alone (.svg) (extra: report).")
@option.overrides
@option.json
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
    Allan deviation. Noise that is not there is said so, with its limit. How long to record: docs/noise.md.
    """
    from adis_gonio.fitting.allan import fit_allan

    if output is not None and output.suffix.lower() not in _ENDINGS:
        raise UsageError(f"{output}: its ending says the format: .html for the page, .svg for the plot")
    check_page(output)
    loaded = option.load(session, overrides)
    with working(f"noise of {session.name}"):
        found = fit_allan(loaded, part, filter_m=filter_m)
    if output is not None:
        from adis_gonio.handover.gyro_report import allan_page, allan_svg

        drawn = allan_svg if output.suffix.lower() == ".svg" else allan_page
        write_page(output, drawn(found))
    if as_json:
        print_json(found.as_dict())
    else:
        screen = console(most=80)
        for line in found.summary().splitlines():
            screen.print(line)
