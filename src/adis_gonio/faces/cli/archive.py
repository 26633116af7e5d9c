"""`adis-gonio archive`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.remembering import remembered
from adis_gonio.faces.cli.show import console, print_json, print_table

_HEAD = ("serial", "operator", "stage", "date", "plan", "ΔK", "Δφ / °", "angle / °", "effects", "file")


@click.command("archive")
@option.places
@click.option("--serial", help="Only sessions of the sensor with this serial number.")
@click.option("--operator", help="Only sessions of this operator.")
@click.option("--stage", help="Only sessions on this stage.")
@option.index
@option.json
def command(
    *,
    places: tuple[Path, ...],
    serial: str | None,
    operator: str | None,
    stage: str | None,
    index_path: Path | None,
    trace: bool,
    as_json: bool,
) -> int:
    """List the sessions in folders and below: archives and samples CSV, by serial number, stage and date.

    Results are kept in an index: only files that are new or have changed are computed. Files that cannot be
    used are listed with the reason. What was indexed once is remembered when its file is gone.
    """
    with remembered(places, index_path, trace=trace) as (store, scan):
        rows = store.rows(serial=serial, operator=operator, stage=stage)
        broken = [row for row in rows if row["status"] != "ok"]
        if not (serial or operator or stage):
            broken += [record.row() | {"copies": [], "gone": False} for record in scan.unreadable]
        good = [row for row in rows if row["status"] == "ok"]
        for row in (*good, *broken):
            row |= {name: " ".join(row[name]) for name in ("effects", "model_effects")}
        document = {
            "index": str(store.path),
            "computed": scan.computed,
            "known": scan.known,
            "sessions": good,
            "failed": broken,
            "problems": list(store.problems),
        }
    if as_json:
        print_json(document)
    else:
        _show(good, broken, document)
    return 1 if document["problems"] else 0


def _show(
    good: Sequence[Mapping[str, Any]], broken: Sequence[Mapping[str, Any]], said: Mapping[str, Any]
) -> None:
    screen = console(most=160)
    if good:
        print_table(screen, _HEAD, [_cells(row) for row in good], texts={0, 1, 2, 3, 4, 8, 9})
    for row in good:
        if row["copies"]:
            screen.print(f"the same file, counted once: {', '.join([row['path'], *row['copies']])}")
    for row in broken:
        screen.print(f"not used: {row['path']}: {row['reason'].removeprefix(row['path'] + ': ')}")
    screen.print(
        f"{counted(len(good), 'session')}, {counted(len(broken), 'file')} not used; "
        f"{said['computed']} computed now, {said['known']} known before ({said['index']})"
    )


def _cells(row: Mapping[str, Any]) -> list[str]:
    def value(name: str) -> str:
        return "–" if row[name] is None else format_uncertain(row[name], row[f"{name}_u95"])

    effects = row["effects"] or ("none" if row["traced"] else "not traced")
    return [
        *(row[name] or "–" for name in ("serial", "operator", "stage")),
        (row["when"] or "–")[:16].replace("T", " "),
        row["plan"] or "–",
        value("delta_k"),
        value("delta_phi"),
        value("angle"),
        effects,
        row["path"] + (" (gone)" if row["gone"] else "") + (" (doubtful)" if row["doubts"] else ""),
    ]
