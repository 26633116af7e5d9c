"""The commands `archive`, `history`, `due` and `fleet`, which work on many sessions together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, date as date_type, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option, show

if TYPE_CHECKING:
    from adis_gonio.base.conformity import Tolerance
    from adis_gonio.fleet.fleet_run import Fleet
    from adis_gonio.fleet.session_record import SessionRecord
    from adis_gonio.fleet.store import Store

_HEAD = ("file", "serial", "operator", "stage", "date", "plan", "ΔK", "Δφ / °", "angle / °", "effects")


@contextmanager
def _indexed(
    places: Sequence[Path], index_path: Path | None, *, trace: bool
) -> Iterator[tuple[Store, Fleet]]:
    """Context with the open index of sessions, to which all sessions in the folders were added.

    It yields the index and the records of the sessions in the folders. `places` are the folders (none: the
    current one); `index_path` is None for the usual place of the index; `trace` is True if new sessions are
    also traced.
    """
    from adis_gonio.fleet.fleet_run import scan
    from adis_gonio.fleet.store import Store

    places = places or (Path(),)
    with Store.of(places, index_path) as store:
        with show.report_progress(f"reading {', '.join(map(str, places))}"):
            found = scan(store, places, trace=trace)
        yield store, found


def _records_of(store: Store, serial: str) -> list[SessionRecord]:
    """Return the records of the sessions of the sensor `serial`, sorted by time.

    Files with equal samples, and sensors with a similar serial number, are reported on standard error.
    Raises `UsageError`, which names the most similar serial number, if the sensor has no session.
    """
    from adis_gonio.fleet.sensor_history import alike, known_serial

    known = store.serials()
    found = store.records(known_serial(serial, known))
    for one in store.copies(serial):
        show.say(f"{one.path} holds the same samples as {one.same_as}: counted once")
    for other in alike(serial, known):
        show.say(f"sessions of '{other}' are not included with '{serial}': another sensor?")
    return found


@option.command("archive")
@option.places
@click.option("--serial", help="Only sessions of the sensor with this serial number.")
@click.option("--operator", help="Only sessions of this operator.")
@click.option("--stage", help="Only sessions on this stage.")
@option.index
@option.json
def archive_command(
    *, places: tuple[Path, ...], index_path: Path | None, trace: bool, as_json: bool, **asked: str | None
) -> None:
    """List the sessions in folders and their subfolders: archives and samples CSV.

    An index keeps the results, so that only new or changed files are computed. Files that cannot be used
    are listed with the reason. The index still lists a session after its file is gone.
    """
    with _indexed(places, index_path, trace=trace) as (store, scan):
        rows = store.rows(**asked)
        broken = [row for row in rows if row["status"] != "ok"]
        if not any(asked.values()):
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
        }
    if as_json:
        show.print_json(document)
        return
    screen = show.console(most=160)
    if good:
        show.print_table(screen, _HEAD, [_archive_cells(row) for row in good], texts={0, 1, 2, 3, 4, 5, 9})
    for row in good:
        if row["copies"]:
            screen.print(f"the same file, counted once: {', '.join([row['path'], *row['copies']])}")
    for row in broken:
        screen.print(f"not used: {row['path']}: {row['reason'].removeprefix(row['path'] + ': ')}")
    screen.print(
        f"{counted(len(good), 'session')}, {counted(len(broken), 'file')} not used; "
        f"{scan.computed} computed now, {scan.known} known before ({store.path})"
    )


def _archive_cells(row: Mapping[str, Any]) -> list[str]:
    from adis_gonio.fleet.session_record import format_quantity

    path, here = Path(row["path"]), Path.cwd()
    return [
        str(path.relative_to(here) if path.is_relative_to(here) else path)
        + (" (gone)" if row["gone"] else "")
        + (" (doubtful)" if row["doubts"] else ""),
        *(row[name] or "–" for name in ("serial", "operator", "stage")),
        (row["when"] or "–")[:16].replace("T", " "),
        row["plan"] or "–",
        *(
            "–" if row[name] is None else format_quantity(name, row[name], row[f"{name}_u95"])
            for name in ("delta_k", "delta_phi", "angle")
        ),
        row["effects"] or ("none" if row["traced"] else "not traced"),
    ]


@option.command("history")
@click.argument("serial")
@option.places
@option.output("Write a page with figures (extra: report).")
@option.index
@option.json
def history_command(*, serial: str, output: Path | None, as_json: bool, **indexed: Any) -> None:
    """Show ΔK, Δφ, biases and the angle error of a sensor over its sessions, with U.

    The command tests for drift between sessions, keeps a control chart (CUSUM, and 3σ limits from u and the
    scatter between sessions), and lists the effects found each time. The page of -o shows the charts.
    """
    from adis_gonio.fleet.fleet_pages import history_page, history_sections
    from adis_gonio.fleet.sensor_history import history_of

    show.check_page(output)
    with _indexed(**indexed) as (store, _):
        found = history_of(serial, _records_of(store, serial))
    if output is not None:
        show.write_page(output, history_page(found))
    sections = history_sections(found, figures=False)
    show.print_result(found, f"Sensor {found.serial}", sections, as_json=as_json)


@option.command("due")
@click.argument("serial")
@option.places
@option.tolerance("Permissible error of an angle for your use (default: assume 0.1°).")
@option.with_default(
    "--first", "first_days", type=option.parse_positive, default=365.25, metavar="DAYS",
    help="Interval of a sensor without a known history.",
)  # fmt: skip
@option.index
@option.json
def due_command(
    *, serial: str, tolerance: Tolerance | None, first_days: float, as_json: bool, **indexed: Any
) -> None:
    """Compute when a sensor's next calibration is due, with the rule and the reason (ILAC-G24 / OIML D 10).

    Staircase: the interval grows if the previous calibration was still good, and shrinks if it was not.
    Control chart: the last day on which the error by drift conforms to the tolerance. The earlier date
    counts.
    """
    from adis_gonio.fleet.calibration_due import DEFAULT_TOLERANCE, Rules, due_of
    from adis_gonio.fleet.sensor_history import history_of

    limits = Rules(tolerance or DEFAULT_TOLERANCE, tolerance is None, first_days)
    with _indexed(**indexed) as (store, _):
        history = history_of(serial, _records_of(store, serial))
    for record, reason in history.left_out:
        show.say(f"left out: {record.path}: {reason.removeprefix(record.path + ': ')}")
    found = due_of(history, limits)
    if as_json:
        show.print_json(found.as_dict())
        return
    screen = show.console(most=100)
    date = f"{found.date}, by the {found.by}" if found.date else "unknown"
    late = (datetime.now(UTC).date() - date_type.fromisoformat(found.date)).days if found.date else 0
    if late > 0:
        date += f": overdue by {counted(late, 'day')}"
    screen.print(f"Next calibration of {found.serial}: {date}", style="bold")
    for rule in found.rules:
        show.print_indented(screen, f"{rule.method}: {rule.date or 'no date'}: {rule.why}")
        if rule.assumes:
            show.print_indented(screen, f"assumes: {rule.assumes}", 4)
    if found.limits.assumed:
        assumed = f"{found.limits.tolerance} is assumed as tolerance: set yours with --tolerance"
        show.print_indented(screen, assumed)


@option.command("fleet")
@click.argument(
    "files",
    type=click.Path(path_type=Path, readable=False),  # an unreadable file becomes a row of the result
    nargs=-1,
    required=True,
    metavar="FILES…",
)
@click.option(
    "--trace/--no-trace", default=True, help="Also look for effects (the default): seconds per session."
)
@click.option(
    "--workers", type=click.IntRange(min=1), metavar="N",
    help="Number of processes (default: one per core).",
)  # fmt: skip
@click.option(
    "--scheduler", metavar="ADDRESS", help="Use a dask cluster, such as tcp://10.0.0.1:8786 (extra: fleet)."
)
@option.output(
    "Summary to write: .html for a page, .json, .parquet with a row per session; may be repeated.",
    name="outputs", paths=lambda outputs: outputs, multiple=True,
)  # fmt: skip
@option.file(
    "--journal", help="File that keeps the results during the work (default: next to the first -o)."
)
@option.flag("--population", help="Name effects that many sessions share, even if each is too weak in one.")
@option.json
def fleet_command(
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
    """Fit and trace many sessions, and summarise parameters, effects and outliers.

    FILES are sessions or folders of sessions. With -o or --journal, each result is kept as soon as it is
    there: after Ctrl-C, a crash or a full disk, the same command continues. The exit status is 1 if a
    session failed.
    """
    from adis_gonio.fleet.fleet_pages import fleet_sections
    from adis_gonio.fleet.fleet_run import ENDINGS, check_outputs, run_fleet, session_files
    from adis_gonio.fleet.fleet_summary import headline
    from adis_gonio.fleet.session_record import Options
    from adis_gonio.fleet.workers import Cluster, LocalPool

    if workers is not None and scheduler is not None:
        raise UsageError("--workers and --scheduler: the one is for this machine, the other for a cluster")
    names = session_files(files)
    if not names:
        where = ", ".join(map(str, files))
        raise UsageError(
            f"there is no session in {where}: give files, or folders with {', '.join(ENDINGS)}"
        )
    check_outputs(outputs, names)
    if journal is None and outputs:
        journal = outputs[0].with_name(f"{outputs[0].name}.journal")
    with _journal(journal) as store, show.report_progress(f"fleet of {counted(len(names), 'file')}"):
        with LocalPool(workers) if scheduler is None else Cluster(scheduler) as pool:
            fleet = run_fleet(names, Options(trace=trace, evidence=population), store, pool)
        for path in outputs:
            fleet.write(path)
    sections = fleet_sections(fleet.summary, fleet.repeated, fleet.population_lines, figures=False)
    show.print_result(fleet, headline(fleet.summary), sections, as_json=as_json, most=0)
    for path in outputs:
        show.report_written(path, counted(len(fleet.records), "session"))
    if fleet.failed:
        show.say(f"{counted(fleet.failed, 'session')} of {len(fleet.records)} failed")
    return 1 if fleet.failed else 0


@contextmanager
def _journal(path: Path | None) -> Iterator[Store]:
    """Context with the open store that keeps each result at once; after Ctrl-C it reports their number.

    `path` is the file of the store; None keeps the results in memory.
    """
    from adis_gonio.fleet.store import IN_MEMORY, Store

    with Store(path or IN_MEMORY, strict=True) as store:
        try:
            yield store
        except KeyboardInterrupt:
            if path is not None:
                done = counted(store.sessions, "session")
                show.say(f"{path} keeps {done}: the same command continues from there")
            raise
