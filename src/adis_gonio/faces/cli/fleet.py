"""`adis-gonio fleet`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import console, print_json, print_table, working

if TYPE_CHECKING:
    from adis_gonio.fleet.fleet_pages import FleetResult
    from adis_gonio.fleet.store import Store
    from adis_gonio.fleet.workers import Cluster, LocalPool


@click.command("fleet")
@click.argument(
    "files",
    type=click.Path(path_type=Path, readable=False),  # what cannot be read is a row
    nargs=-1,
    required=True,
    metavar="FILES…",
)
@click.option(
    "--trace/--no-trace", default=True, help="Look for effects too (the default): seconds a session."
)
@click.option(
    "--workers", type=click.IntRange(min=1), metavar="N", help="Processes; by default one a core."
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Have a dask cluster do it, such as tcp://10.0.0.1:8786 (extra: fleet).",
)
@option.file(
    "-o",
    "--output",
    "outputs",
    multiple=True,
    help="Summary to write: .html a page, .json, .parquet a row a session; may be repeated.",
)
@option.file(
    "--journal",
    help="Where results are kept as they come; by default beside the first -o.",
)
@click.option(
    "--population", is_flag=True, help="Name what many sessions have in common, though too weak in each."
)
@option.json
def command(
    *,
    files: tuple[Path, ...],
    trace: bool,
    workers: int | None,
    scheduler: str | None,
    outputs: tuple[Path, ...],
    journal: Path | None,
    population: bool,
    as_json: bool,
) -> int:
    """Fit and trace many sessions, and summarise parameters, effects and outlying groups.

    FILES are sessions, or folders of them. With -o or --journal results are kept as they come: after
    Ctrl-C, a crash or a full disk the same command goes on where it stopped. The exit status is 1 where a
    session failed.
    """
    from adis_gonio.base.budget import current
    from adis_gonio.fleet.fleet_pages import FleetResult, check_outputs
    from adis_gonio.fleet.fleet_run import files_of, run_fleet, survey
    from adis_gonio.fleet.session_record import Options

    if workers is not None and scheduler is not None:
        raise UsageError("--workers and --scheduler: the one is for this machine, the other for a cluster")
    names = files_of(files)
    check_outputs(outputs, names)
    if journal is None and outputs:
        journal = outputs[0].with_name(f"{outputs[0].name}.journal")
    options = Options(trace=trace, evidence=population)
    with _kept(journal) as held, working(f"fleet of {counted(len(names), 'file')}"):
        tell = current().tell
        tell("reading")
        found = survey(names, current().share)
        tell("waiting for workers")
        with _workers(workers, scheduler) as hands:
            fleet = run_fleet(found, options, hands, held, lambda progress: tell(str(progress)))
        tell("summary")
        outcome = FleetResult(fleet, options)
        for path in outputs:
            outcome.write(path)
    if as_json:
        print_json(outcome.as_dict())
    else:
        _show(outcome)
    for path in outputs:
        click.echo(f"{path}: {counted(len(outcome.rows), 'session')}", err=True)
    if fleet.failed:
        click.echo(f"{counted(fleet.failed, 'session')} of {len(outcome.rows)} failed", err=True)
    return 1 if fleet.failed else 0


@contextmanager
def _kept(journal: Path | None) -> Iterator[Store]:
    """The store of the results, and a word of it where the work is broken off."""
    from adis_gonio.fleet.store import IN_MEMORY, Store

    with Store(journal or IN_MEMORY, strict=True) as held:
        try:
            yield held
        except KeyboardInterrupt:
            if journal is not None:
                done = counted(held.sessions, "session")
                click.echo(f"{journal} holds {done}: the same command goes on from there", err=True)
            raise


def _workers(workers: int | None, scheduler: str | None) -> AbstractContextManager[LocalPool | Cluster]:
    from adis_gonio.fleet.workers import Cluster, LocalPool

    return LocalPool(workers) if scheduler is None else Cluster(scheduler)


def _show(outcome: FleetResult) -> None:
    from adis_gonio.fleet import fleet_summary as words

    screen = console()
    summary = outcome.summary
    screen.print(words.headline(summary), style="bold")
    for line in words.remarks(summary):
        screen.print(line)
    _table("Parameters", words.PARAMETER_HEAD, words.parameter_rows(summary))
    _table("Effects by frequency", words.EFFECT_HEAD, words.effect_rows(summary))
    screen.print()
    screen.print(words.outlying_text(summary))
    _table("Outlying groups", words.OUTLYING_HEAD, words.outlying_rows(summary))
    if outcome.population_lines:
        screen.print()
    for line in outcome.population_lines:
        screen.print(line)
    _table("Failed", ["file", "reason"], [list(failure) for failure in summary.failures], texts=2)
    repeated = [[one.path, one.same_as] for one in outcome.fleet.repeated]
    _table("Count once", ["file", "same session as"], repeated, texts=2)


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]], texts: int = 1) -> None:
    if not rows:
        return
    screen = console()
    screen.print()
    screen.print(title, style="bold cyan")
    print_table(screen, head, rows[:_MOST_ROWS], range(texts))
    if len(rows) > _MOST_ROWS:
        screen.print(f"{len(rows) - _MOST_ROWS} more: in the JSON document")


_MOST_ROWS = 40
"""Rows of a table on the terminal."""
