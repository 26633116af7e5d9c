"""`adis-gonio bringup`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import json_text, print_json

if TYPE_CHECKING:
    from adis_gonio.bench.bringup import Bringup, Row


@click.command("bringup")
@option.url
@option.output("Write FILE.html and FILE.json.", metavar="FILE")
@click.option("--allow-writes", "--writes", is_flag=True, help="Also do the steps that write registers.")
@click.option("--flash", is_flag=True, help="With --allow-writes: also write the flash once.")
@click.option("--yes", is_flag=True, help="Answer the question of each step that writes with yes.")
@click.option("--leave-registers", is_flag=True, help="Write nothing, not even data-ready while scans run.")
@option.variant
@option.json
def command(
    *,
    url: str,
    output: Path | None,
    allow_writes: bool,
    flash: bool,
    yes: bool,
    leave_registers: bool,
    variant: str,
    as_json: bool,
) -> int:
    """Check a new board step by step, harmless first, and say what it tells about the part.

    Lay the part still, best with one axis along gravity. Link, bit errors, supply, variant, sample rate,
    data-ready and noise are only looked at (data-ready is enabled meanwhile, as in a stream). With
    --allow-writes follow the steps that settle open questions of the register table; each asks first, and
    all that is written is undone and read back, at Ctrl-C too. Exit status 1 where a step found a fault.
    """
    if (flash or yes) and not allow_writes:
        raise UsageError(f"--{'flash' if flash else 'yes'} goes with --allow-writes")
    if allow_writes and leave_registers:
        raise UsageError("--leave-registers writes nothing, so it excludes --allow-writes")
    if allow_writes and not yes and not sys.stdin.isatty():
        raise UsageError("--allow-writes asks before each step, and nobody is there to answer: add --yes")
    files = () if output is None else _files(output)
    from adis_gonio.bench.bringup import Permission, bring_up
    from adis_gonio.device.bus import open_bus
    from adis_gonio.device.sensor.variants import variant as known

    part = known(variant)
    permission = Permission(
        allow_writes, flash, not leave_registers, lambda question: yes or _ask(question)
    )
    with open_bus(url) as bus:
        found = bring_up(
            bus, variant=part, permission=permission, tell=lambda row: _tell(row, as_json=as_json)
        )
    if files:
        _write(found, *files)
        click.echo(f"written: {files[0]}, {files[1]}", err=True)
    if as_json:
        print_json(found.as_dict())
    else:
        click.echo(f"\n{found.headline} Writes: {found.undone}.")
    if found.stopped:
        raise KeyboardInterrupt
    return 0 if found.sound else 1


def _files(output: Path) -> tuple[Path, Path]:
    """Page and JSON beside each other."""
    if output.suffix.lower() not in ("", ".html", ".json"):
        raise UsageError(f"{output}: bringup writes a page and a JSON: name it {output.stem}.html")
    from adis_gonio.base.output import check_output

    page, document = output.with_suffix(".html"), output.with_suffix(".json")
    return check_output(page, force=True), check_output(document, force=True)


def _write(found: Bringup, page: Path, document: Path) -> None:
    from adis_gonio.base.output import replacing
    from adis_gonio.bench.bringup.bringup_page import build_page

    for path, text in ((document, json_text(found.as_dict()) + "\n"), (page, build_page(found))):
        with replacing(path) as beside:
            beside.write_text(text, encoding="utf-8")


def _ask(question: str) -> bool:
    try:
        return click.confirm(question, default=False, err=True)
    except click.Abort:
        raise KeyboardInterrupt from None


def _tell(row: Row, *, as_json: bool) -> None:
    click.echo(f"{row.result.verdict:13} {row.name:15} {row.result.text}", err=as_json)
