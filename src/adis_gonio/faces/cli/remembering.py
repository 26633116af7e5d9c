"""What `archive`, `history` and `due` share: folders, the index, and what is said of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.faces.cli.show import working

if TYPE_CHECKING:
    from adis_gonio.fleet.memory.index import Index, Scan
    from adis_gonio.fleet.memory.record import SessionRecord


@contextmanager
def remembered(
    places: Sequence[Path], index_path: Path | None, *, trace: bool
) -> Iterator[tuple[Index, Scan]]:
    """The index with all that the folders hold; what is wrong with its file is said on standard error."""
    from adis_gonio.fleet.memory.index import Index

    places = places or (Path(),)
    with Index.of(places, index_path) as index:
        with working(f"reading {', '.join(map(str, places))}"):
            scan = index.scan(places, trace=trace)
        for problem in index.problems:
            click.echo(problem, err=True)
        yield index, scan


def sessions_of(index: Index, serial: str) -> list[SessionRecord]:
    """Records of a sensor, in the order of time.

    Raises
    ------
    UsageError
        No session has this serial number; the message lists those like it.
    """
    from adis_gonio.fleet.memory.history import alike, known_serial

    known = index.serials()
    found = index.records(known_serial(serial, known))
    for other in alike(serial, known):
        click.echo(f"sessions of '{other}' are not those of '{serial}': another sensor?", err=True)
    return found
