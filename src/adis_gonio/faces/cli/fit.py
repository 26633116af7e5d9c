"""`adis-gonio fit`."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli.overrides import load, override_options, part_option
from adis_gonio.faces.cli.show import WIDTH, console, json_option, print_json
from adis_gonio.faces.cli.working import working

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from adis_gonio.fitting import FitResult
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.fitting.monte_carlo import MonteCarlo
    from adis_gonio.model.records import Session
    from adis_gonio.record.overrides import Overrides


@click.command("fit")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--method",
    help="paper, two-position, four-position, mmpm or ml, of one continuous turn free-turn; without it"
    " the one that is recommended.",
)
@click.option("--all", "everything", is_flag=True, help="Every method in full, beside each other.")
@click.option(
    "--monte-carlo",
    "trials",
    type=click.IntRange(min=100),
    metavar="N",
    help="Propagate the input distributions by N trials too (GUM Supplement 1).",
)
@click.option("--seed", type=int, default=1, show_default=True, help="Of the trials' random numbers.")
@part_option
@click.option(
    "--calibration",
    "calibration",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="With --sensor-part gyro: calibration of the same part's accelerometers, or a session of theirs.",
)
@click.option(
    "--gyros",
    type=click.Path(path_type=Path),
    help="Poses in space: gyros of another session of this part (plan gyro-turns), or of a calibration"
    " file.",
)
@override_options
@json_option
def command(
    *,
    session: Path,
    method: str | None,
    part: str,
    calibration: Path | None,
    gyros: Path | None,
    everything: bool,
    trials: int | None,
    seed: int,
    as_json: bool,
    overrides: Overrides,
) -> None:
    """Compute ΔK, Δφ and the other parameters of a recorded session, with their uncertainties.

    Shows the recommended method in full and the others by their score on the same readings: every dwell of
    the session, left out of the fit where it was in it. --sensor-part gyro: zero rates, g-sensitivity, and
    gains and directions where the part was turned between dwells. Poses in space gain equations by turns
    that were recorded between them (calibrate --record-turns).
    """
    if part == "gyro" and gyros is not None:
        raise UsageError("--gyros goes with the accelerometers: leave out --sensor-part gyro")
    if part == "gyro":
        from adis_gonio.faces.cli.gyro_fit import show_gyro_fit

        if everything or trials is not None:
            raise UsageError(
                "--all and --monte-carlo are of the accelerometers' methods: gyros have one, gyro"
            )
        show_gyro_fit(load(session, overrides), method, as_json=as_json, calibration=calibration)
        return
    if calibration is not None:
        raise UsageError("--calibration is that of the accelerometers, for --sensor-part gyro")
    from adis_gonio.faces.api import fit
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.model.records import METADATA

    loaded = load(session, overrides)
    what = "a free turn" if loaded.free_turn else counted(len(loaded.dwells), "dwell")
    with working(f"fitting {what} of {session.name}"):
        answer = Answer.of(fit(loaded, method=method, gyros=gyros), own=method is not None)
        document = answer.as_dict()
    run = _monte_carlo(answer.result, trials, seed)
    if as_json:
        print_json(document if run is None else {**document, "monte_carlo": run.as_dict()})
        return
    screen = _screen()
    title = f"{loaded.title}: " if loaded.title else ""
    screen.print(f"{title}{what}, {loaded.sensor}", style="bold")
    written = [f"{name} {getattr(loaded, name)}" for name in METADATA if getattr(loaded, name)]
    if written:
        screen.print(f"  {', '.join(written)}")
    for note in loaded.notes:
        screen.print(f"  {note}")
    # Of positions `calibrate` alone shows what a simulation hid.
    truth = loaded.facts.get("truth") if loaded.free_turn else None
    print_answer(answer, truth, shown=loaded.notes, everything=everything)
    print_gains(loaded)
    if run is not None:
        _print_monte_carlo(screen, run)


def print_answer(
    answer: Answer,
    truth: Mapping[str, float] | None = None,
    shown: Collection[str] = (),
    *,
    everything: bool = False,
) -> None:
    """Show the one answer, its parameters in full and the other methods by a line each.

    Parameters
    ----------
    truth : mapping of str to float, optional
        Of a simulation, shown beside the parameters.
    shown : collection of str
        Warnings that were printed already.
    everything : bool
        All methods in full.
    """
    screen = _screen()
    screen.print()
    style: str | None = "bold"  # to the line that names the method
    for line in answer.text(min(screen.width, WIDTH)).splitlines():
        screen.print(line, style=style)
        style = None if line.startswith("Answer") else style
    screen.print()
    if truth is not None or answer.has_more:
        screen.print(_parameters(answer, truth))
    for line in answer.facts():
        screen.print(f"  {line}")
    _budget(screen, answer)
    _others(screen, answer)
    if everything:
        _print_all(screen, answer.standing.results)
    for text in answer.warnings(everything=everything):
        if text not in shown:
            screen.print(text)


def print_gains(session: Session) -> None:
    """Say what the moves between the dwells give of the gyros' gains; nothing where they give none."""
    from adis_gonio.fitting.gyros.gains import gains_of

    gains = gains_of(session)
    if gains is not None:
        _screen().print(gains.line, markup=False)


def _screen() -> Console:
    return console(most=WIDTH)


def _table(
    head: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1, bold: str | None = None
) -> Table:
    """A table: `texts` columns to the left, numbers to the right; the row named `bold` stands out."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for k, name in enumerate(head):
        table.add_column(name, justify="right" if k >= texts else "left")
    for row in rows:
        table.add_row(*row, style="bold" if bold is not None and row[0] == bold else None)
    return table


def _parameters(answer: Answer, truth: Mapping[str, float] | None) -> Table:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    head = [
        "parameter",
        "unit",
        *(["truth"] if truth is not None else []),
        "value",
        "u",
        "U (95 %)",
        "k",
        "ν",
    ]
    for name in head:
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for name, unit, *cells in answer.parameter_rows():
        true = [] if truth is None else [f"{truth[name]:.6g}" if name in truth else ""]
        table.add_row(name, unit, *true, *cells, style="bold" if name in ("delta_k", "delta_phi") else None)
    return table


def _budget(screen: Console, answer: Answer) -> None:
    head, rows = answer.budget_rows()
    if not rows:
        return
    screen.print()
    screen.print("Uncertainty budget: shares of the variance")
    screen.print(_table(head, rows, texts=4))


def _others(screen: Console, answer: Answer) -> None:
    head, rows = answer.score_rows()
    if len(rows) < 2 and not answer.standing.failures:
        return
    screen.print()
    screen.print(answer.scored_on)
    if len(head) > 1:
        screen.print(_table(head, rows, bold=rows[0][0] if rows else None))
    for method, reason in answer.standing.failures.items():
        screen.print(f"no result by {method}: {reason}")


def _print_all(screen: Console, results: Sequence[FitResult]) -> None:
    """Every method in full, as many beside each other as the screen is wide."""
    from adis_gonio.fitting.tables import blocks

    for head, rows in blocks(results, screen.width):
        from rich.table import Table

        screen.print()
        table = Table(box=None, padding=(0, 2, 0, 0))
        for k, name in enumerate(head):
            table.add_column(name, justify="left" if k < 2 else "right", no_wrap=True)
        for row in rows:
            table.add_row(*row)
        screen.print(table)


def _monte_carlo(result: FitResult, trials: int | None, seed: int) -> MonteCarlo | None:
    if trials is None:
        return None
    import numpy as np

    from adis_gonio.fitting.monte_carlo import monte_carlo

    with working(f"{trials} Monte Carlo trials"):
        return monte_carlo(result, trials, np.random.default_rng(seed))


def _print_monte_carlo(screen: Console, run: MonteCarlo) -> None:
    screen.print()
    screen.print(f"Monte Carlo, {run.trials} trials (GUM Supplement 1)", style="bold")
    screen.print(_table(*run.rows(), texts=2))
    for line in run.remarks:
        screen.print(f"  {line}")
