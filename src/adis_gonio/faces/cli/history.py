"""`adis-gonio history`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.numbers import label_quantity
from adis_gonio.faces.cli.remembering import index_options, places_argument, remembered, sessions_of
from adis_gonio.faces.cli.show import console, json_option, print_json

if TYPE_CHECKING:
    from adis_gonio.fleet.memory.history import History

_WIDTH = 80


@click.command("history")
@click.argument("serial")
@places_argument
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="Write a page with figures (extra: report)."
)
@click.option(
    "--run-length",
    type=click.FloatRange(min=10),
    metavar="N",
    help="One false alarm of the CUSUM in N sessions; by default h = 5 σ, which is one in 465.",
)
@index_options
@json_option
def command(
    *,
    serial: str,
    places: tuple[Path, ...],
    output: Path | None,
    run_length: float | None,
    index_path: Path | None,
    trace: bool,
    as_json: bool,
) -> None:
    """Show ΔK, Δφ, biases and the error of the angle of a sensor over its sessions, with U.

    Tests for drift between sessions, keeps a control chart (CUSUM, and 3σ limits from u and the scatter
    between sessions), and lists the effects found each time.
    """
    from adis_gonio.base.output import check_output
    from adis_gonio.fleet.memory.control_chart import CUSUM_H, limit_for
    from adis_gonio.fleet.memory.history import history_of

    if output is not None:
        check_output(output, force=True)
        from adis_gonio.page.svg import require_matplotlib

        require_matplotlib()
    h = CUSUM_H if run_length is None else limit_for(run_length)
    with remembered(places, index_path, trace=trace) as (index, _):
        found = history_of(serial, sessions_of(index, serial), h=h)
    if output is not None:
        _write(found, output)
    if as_json:
        print_json(found.as_dict())
    else:
        _show(found)


def _write(found: History, output: Path) -> None:
    from adis_gonio.base.output import replacing, write_utf8
    from adis_gonio.fleet.memory.history_page import history_page

    page = history_page(found)
    with replacing(output) as beside:
        size = write_utf8(beside, page)
    click.echo(f"{output}: {size // 1024 + 1} kB", err=True)


def _show(found: History) -> None:
    from adis_gonio.fleet.memory import words

    screen = console(most=_WIDTH)
    screen.print(f"Sensor {found.serial}: {words.headline(found)}", style="bold")
    for track in found.tracks.values():
        screen.print()
        screen.print(label_quantity(track.name, track.unit), style="bold cyan")
        for line in words.chart_lines(track, min(screen.width, _WIDTH)):
            screen.print(line)
        for text in (*words.of_drift(track), *words.of_chart(track, found)):
            screen.print(f"  {text}")
    screen.print()
    screen.print("Effects found", style="bold cyan")
    for row in words.of_effects(found):
        screen.print(f"  {'  '.join(row)}")
    for record, reason in found.left_out:
        screen.print(f"left out: {record.path}: {reason}")
