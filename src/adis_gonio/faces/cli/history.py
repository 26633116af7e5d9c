"""`adis-gonio history`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.remembering import remembered, sessions_of
from adis_gonio.faces.cli.show import check_page, console, print_json, write_page

if TYPE_CHECKING:
    from adis_gonio.fleet.sensor_history import History

_WIDTH = 80


@click.command("history")
@click.argument("serial")
@option.places
@option.output("Write a page with figures (extra: report).")
@click.option(
    "--run-length",
    type=click.FloatRange(min=10),
    metavar="N",
    help="One false alarm of the CUSUM in N sessions; by default h = 5 σ, which is one in 465.",
)
@option.index
@option.json
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
    from adis_gonio.fleet.control_charts import CUSUM_H, limit_for
    from adis_gonio.fleet.sensor_history import history_of

    check_page(output)
    h = CUSUM_H if run_length is None else limit_for(run_length)
    with remembered(places, index_path, trace=trace) as (store, _):
        found = history_of(serial, sessions_of(store, serial), h=h)
    if output is not None:
        from adis_gonio.fleet.fleet_pages import history_page

        write_page(output, history_page(found))
    if as_json:
        print_json(found.as_dict())
    else:
        _show(found)


def _show(found: History) -> None:
    from adis_gonio.fleet import sensor_history as words

    screen = console(most=_WIDTH)
    screen.print(f"Sensor {found.serial}: {words.headline(found)}", style="bold")
    for track in found.tracks.values():
        screen.print()
        screen.print(track.label, style="bold cyan")
        for line in words.chart_lines(track, min(screen.width, _WIDTH)):
            screen.print(line)
        for text in (*words.drift_sentences(track), *words.chart_sentences(track, found)):
            screen.print(f"  {text}")
    screen.print()
    screen.print("Effects found", style="bold cyan")
    for row in words.effect_table(found):
        screen.print(f"  {'  '.join(row)}")
    for record, reason in found.left_out:
        screen.print(f"left out: {record.path}: {reason}")
