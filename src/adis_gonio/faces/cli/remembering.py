"""What `archive`, `history` and `due` share: folders, the store of results, and its problems."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.faces.cli.show import working

if TYPE_CHECKING:
    from adis_gonio.fleet.fleet_run import Scan
    from adis_gonio.fleet.session_record import SessionRecord
    from adis_gonio.fleet.store import Store


@contextmanager
def remembered(
    places: Sequence[Path], index_path: Path | None, *, trace: bool
) -> Iterator[tuple[Store, Scan]]:
    """The store with the results of all sessions in the folders; reports problems of its file."""
    from adis_gonio.fleet.fleet_run import scan
    from adis_gonio.fleet.store import Store

    places = places or (Path(),)
    with Store.of(places, index_path) as store:
        with working(f"reading {', '.join(map(str, places))}"):
            found = scan(store, places, trace=trace)
        for problem in store.problems:
            click.echo(problem, err=True)
        yield store, found


def sessions_of(store: Store, serial: str) -> list[SessionRecord]:
    """Records of a sensor, in the order of time.

    Raises
    ------
    UsageError
        No session has this serial number; the message lists those like it.
    """
    from adis_gonio.fleet.sensor_history import alike, known_serial

    known = store.serials()
    found = store.records(known_serial(serial, known))
    for other in alike(serial, known):
        click.echo(f"sessions of '{other}' are not those of '{serial}': another sensor?", err=True)
    return found
