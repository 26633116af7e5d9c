"""`adis-gonio fit`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.errors import UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import WIDTH, console, print_json, table_of, working

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from adis_gonio.base.values import Value
    from adis_gonio.fitting import FitResult
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.fitting.monte_carlo import MonteCarlo
    from adis_gonio.model.records import Session
    from adis_gonio.record.loading import Overrides


@click.command("fit")
@option.session
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
@option.shown("--seed", type=int, default=1, help="Of the trials' random numbers.")
@option.part()
@option.file(
    "--calibration",
    metavar="FILE",
    help="With --sensor-part gyro: calibration of the same part's accelerometers, or a session of theirs.",
)
@option.file(
    "--gyros",
    help="Poses in space: gyros of another session of this part (plan gyro-turns), or of a calibration"
    " file.",
)
@option.overrides
@option.json
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
        if everything or trials is not None:
            raise UsageError(
                "--all and --monte-carlo are of the accelerometers' methods: gyros have one, gyro"
            )
        show_gyro_fit(option.load(session, overrides), method, as_json=as_json, calibration=calibration)
        return
    if calibration is not None:
        raise UsageError("--calibration is that of the accelerometers, for --sensor-part gyro")
    from adis_gonio.faces.api import fit
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.model.records import METADATA

    loaded = option.load(session, overrides)
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
    written = [f"{name} {getattr(loaded, name)}" for name in METADATA if getattr(loaded, name)]
    head = [f"{title}{what}, {loaded.sensor}", *([f"  {', '.join(written)}"] if written else [])]
    head += [f"  {note}" for note in loaded.notes]
    # Of positions `calibrate` alone shows what a simulation hid.
    truth = loaded.facts.get("truth") if loaded.free_turn else None
    print_answer(answer, truth, head, shown=loaded.notes, everything=everything)
    print_gains(loaded)
    if run is not None:
        _print_monte_carlo(screen, run)


def print_answer(
    answer: Answer,
    truth: Mapping[str, float] | None = None,
    head: Sequence[str] = (),
    shown: Collection[str] = (),
    *,
    everything: bool = False,
) -> None:
    """Show the one answer, its parameters in full and the other methods by a line each.

    Parameters
    ----------
    truth : mapping of str to float, optional
        Of a simulation, shown beside the parameters.
    head : sequence of str
        Lines about the session, below the doubts about the model, which come first.
    shown : collection of str
        Warnings that were printed already.
    everything : bool
        All methods in full.
    """
    screen = _screen()
    width = min(screen.width, WIDTH)
    for line in answer.doubt_lines(width):
        screen.print(line, style="bold")
    for k, line in enumerate(head):
        screen.print(line, style=None if k else "bold")
    screen.print()
    for k, line in enumerate(answer.headline(width)):
        screen.print(line, style=None if k else "bold")
    screen.print()
    if truth is not None or answer.has_more:
        screen.print(_parameters(answer, truth))
    for line in answer.facts():
        screen.print(f"  {line}")
    _budget(screen, answer)
    _others(screen, answer)
    if everything:
        _print_all(screen, answer.comparison.results)
    for text in answer.warnings(everything=everything):
        if text not in shown:
            screen.print(text)


def print_gains(session: Session) -> None:
    """Say what the moves between the dwells give of the gyros' gains; nothing where they give none."""
    from adis_gonio.fitting.gyros.gyro_fit import gains_of

    gains = gains_of(session)
    if gains is not None:
        _screen().print(gains.line, markup=False)


def _screen() -> Console:
    return console(most=WIDTH)


_PARAMETER_HEAD = ("parameter", "unit", "value", "u", "U (95 %)", "k", "ν")


def _parameters(answer: Answer, truth: Mapping[str, float] | None) -> Table:
    head, rows = list(_PARAMETER_HEAD), [list(row) for row in answer.parameter_rows()]
    if truth is not None:
        head.insert(2, "truth")
        for row in rows:
            row.insert(2, f"{truth[row[0]]:.6g}" if row[0] in truth else "")
    return table_of(head, rows, (0, 1), bold=("delta_k", "delta_phi"))


def _budget(screen: Console, answer: Answer) -> None:
    head, rows = answer.budget_rows()
    if not rows:
        return
    screen.print()
    screen.print("Uncertainty budget: shares of the variance")
    screen.print(table_of(head, rows, range(4)))


def _others(screen: Console, answer: Answer) -> None:
    head, rows = answer.score_rows()
    if len(rows) < 2 and not answer.comparison.failures:
        return
    screen.print()
    screen.print(answer.scored_on)
    if len(head) > 1:
        screen.print(table_of(head, rows, bold=rows[0][:1] if rows else ()))
    for method, reason in answer.comparison.failures.items():
        screen.print(f"no result by {method}: {reason}")


def _print_all(screen: Console, results: Sequence[FitResult]) -> None:
    """Every method in full, as many beside each other as the screen is wide."""
    from adis_gonio.fitting.answer import method_tables

    narrow = {"no_wrap": True}
    for head, rows in method_tables(results, screen.width):
        screen.print()
        screen.print(table_of(head, rows, (0, 1), number=narrow, text=narrow))


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
    screen.print(table_of(*run.rows(), (0, 1)))
    for line in run.remarks:
        screen.print(f"  {line}")


def show_gyro_fit(
    session: Session, method: str | None, *, as_json: bool, calibration: Path | None = None
) -> None:
    """Fit the gyros of a session and show the result."""
    from adis_gonio.faces.api import fit

    accelerometers = None
    if calibration is not None:
        from adis_gonio.tracing.trace_calibrations import load_calibration

        accelerometers = load_calibration(calibration)
    with working("fitting the gyros"):
        result = fit(session, method, part="gyro", accelerometers=accelerometers)
    if as_json:
        print_json(result.as_dict())
        return
    screen = console(most=WIDTH)
    title = f"{session.title}: " if session.title else ""
    screen.print(f"{title}gyros, {result.held}, {session.sensor}", style="bold", markup=False)
    screen.print()
    screen.print(_gyro_parameters(result.parameters))
    screen.print()
    if result.triad is not None:
        screen.print("The gyros' triad: rotation against the accelerometers', and 90° minus its angles")
        screen.print(_gyro_parameters(result.triad))
        screen.print()
    screen.print(
        f"  residual {result.residual_rms_dps:.3g} °/s rms, χ² {result.chi2:.1f} at {result.dof} degrees of"
        " freedom"
    )
    if result.scores:
        screen.print()
        screen.print("Each dwell left out in turn, error of its rate in °/s, rms")
        scores = [
            (name, *(f"{v:.3f}" for v in score.rms_dps.values())) for name, score in result.scores.items()
        ]
        screen.print(table_of(("model", *"xyz"), scores))
    for text in result.warnings:
        screen.print(text, markup=False)


def _gyro_parameters(parameters: dict[str, Value]) -> Table:
    from adis_gonio.fitting.answer import parameter_row

    rows = [parameter_row(name, value) for name, value in parameters.items()]
    return table_of(_PARAMETER_HEAD, rows, (0, 1))
