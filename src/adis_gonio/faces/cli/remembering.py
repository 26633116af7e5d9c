"""What `archive`, `history` and `due` share: folders, the store of results, and its problems."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from adis_gonio.faces.cli.working import working

if TYPE_CHECKING:
    from adis_gonio.fleet.record import SessionRecord
    from adis_gonio.fleet.run import Scan
    from adis_gonio.fleet.store import Store

F = TypeVar("F", bound=Callable[..., Any])

places_argument = click.argument(
    "places", type=click.Path(path_type=Path, readable=False), nargs=-1, metavar="[DIR]..."
)
_INDEX = click.option(
    "--index",
    "index_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Where results are kept; by default adis-gonio.index in the first folder.",
)
_TRACE = click.option(
    "--trace", is_flag=True, help="Look for effects too: seconds to half a minute a session, once."
)


def index_options(function: F) -> F:
    """Add `--index` and `--trace`."""
    return _INDEX(_TRACE(function))


@contextmanager
def remembered(
    places: Sequence[Path], index_path: Path | None, *, trace: bool
) -> Iterator[tuple[Store, Scan]]:
    """The store with the results of all sessions in the folders; reports problems of its file."""
    from adis_gonio.fleet.run import scan
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
    from adis_gonio.fleet.memory.history import alike, known_serial

    known = store.serials()
    found = store.records(known_serial(serial, known))
    for other in alike(serial, known):
        click.echo(f"sessions of '{other}' are not those of '{serial}': another sensor?", err=True)
    return found
