"""The commands `fit` and `allan`: parameters and noise of a recorded session."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.base.numbers import count_decimals, counted, format_fixed
from adis_gonio.faces.cli import options as option, show
from adis_gonio.fitting.methods import METHOD_TABLE
from adis_gonio.record.session_reader import FREE_TURN

if TYPE_CHECKING:
    from rich.console import Console

    from adis_gonio.base.conformity import Tolerance
    from adis_gonio.base.uncertainty import Value
    from adis_gonio.fitting.allan.allan_fit import Part
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.fitting.monte_carlo import MonteCarlo
    from adis_gonio.model.records import Session
    from adis_gonio.record.loading import Overrides


@option.command(
    "fit",
    "--method --all --json",
    {
        "Uncertainty": "--monte-carlo --seed",
        "Conformity": "--tolerance --rule --risk",
        "Gyros": "--sensor-part --calibration --gyros",
    },
)
@option.session
@click.option(
    "--method",
    help=f"{', '.join(METHOD_TABLE)}; {FREE_TURN} for a continuous turn (default: the recommended method).",
)
@option.flag("--all", "everything", help="Show every method in full.")
@click.option(
    "--monte-carlo", "trials", type=click.IntRange(min=100), metavar="N",
    help="Also propagate the input distributions by N trials (GUM Supplement 1).",
)  # fmt: skip
@option.seed(1, "Seed of the trials.")
@option.part()
@option.file(
    "--calibration",
    help="With --sensor-part gyro: calibration or session of the same part's accelerometers.",
)  # fmt: skip
@option.file(
    "--gyros",
    help="For poses in space: another session of this part (plan gyro-turns), or its gyros' calibration.",
)
@option.tolerance("State if the angle error is within this tolerance, such as 0.1deg.")
@option.overrides
@option.json
def fit_command(
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
    tolerance: Tolerance | None,
    overrides: Overrides,
) -> None:
    """Compute ΔK, Δφ and the other parameters of a recorded session, with their uncertainties.

    The command shows the recommended method in full, and a score of each other method. A score is the error
    on all dwells of the session; each dwell is left out of the fit that predicts it. --sensor-part gyro
    fits zero rates and g-sensitivity, also gains and directions if the part was turned between dwells.
    Recorded turns between poses in space add equations (calibrate --record-turns).
    """
    other = ("gyros", "everything", "trials", "tolerance") if part == "gyro" else ("calibration",)
    option.refuse(other, f"not with --sensor-part {part}")
    if part == "gyro":
        show_gyro_fit(option.load(session, overrides), method, as_json=as_json, calibration=calibration)
        return
    from adis_gonio.base.conformity import state_conformity
    from adis_gonio.faces.api import fit
    from adis_gonio.fitting.answer import Answer
    from adis_gonio.model.records import METADATA

    loaded = option.load(session, overrides)
    what = "a free turn" if loaded.free_turn else counted(len(loaded.dwells), "dwell")
    with show.report_progress(f"fitting {what} of {session.name}"):
        answer = Answer.of(fit(loaded, method=method, gyros=gyros), own=method is not None)
        document = answer.as_dict()
    stated = None if tolerance is None else state_conformity(tolerance, answer.error_curves())
    if stated is not None:
        document |= {"conformity": stated.as_dict()}
    run = None
    if trials is not None:
        import numpy as np

        from adis_gonio.fitting.monte_carlo import monte_carlo

        with show.report_progress(f"{trials} Monte Carlo trials"):
            run = monte_carlo(answer.result, trials, np.random.default_rng(seed))
    if as_json:
        show.print_json(document if run is None else {**document, "monte_carlo": run.as_dict()})
        return
    title = f"{loaded.title}: " if loaded.title else ""
    written = [f"{name} {getattr(loaded, name)}" for name in METADATA if getattr(loaded, name)]
    head = [f"{title}{what}, {loaded.sensor}", *([", ".join(written)] if written else []), *loaded.notes]
    # `calibrate` shows the truth of simulated positions, `fit` the truth of a simulated free turn.
    truth = loaded.facts.get("truth") if loaded.free_turn else None
    print_answer(answer, truth, head, shown=loaded.notes, everything=everything)
    if stated is not None:
        for k, line in enumerate(stated.lines):
            show.say(f"  {line}" if k else f"\n{line}", err=False, hang=4)
    if run is not None:
        _print_monte_carlo(show.console(most=show.WIDTH), run)


def print_answer(
    answer: Answer,
    truth: Mapping[str, float] | None = None,
    head: Sequence[str] = (),
    shown: Collection[str] = (),
    *,
    everything: bool = False,
) -> None:
    """Show the answer of a fit: its parameters in full, and one line for each other method.

    Parameters
    ----------
    truth : mapping of str to float, optional
        True parameters of a simulation, shown next to the estimates.
    head : sequence of str
        Lines about the session, printed below the doubts about the model; the first one in bold.
    shown : collection of str
        Warnings that were printed already.
    everything : bool
        True shows all methods in full.
    """
    screen = show.console(most=show.WIDTH)
    for line in answer.doubt_lines(screen.width):
        screen.print(line, style="bold")
    if head:
        screen.print(head[0], style="bold")
        for line in head[1:]:
            show.print_indented(screen, line)
        screen.print()
    for k, line in enumerate(answer.headline(screen.width)):
        screen.print(line, style=None if k else "bold")
    screen.print()
    if truth is not None or len(answer.parameters) > len(answer.values.keys() - {"angle"}):
        _print_parameters(screen, answer.parameters, truth)
    for line in answer.facts():
        screen.print(f"  {line}")
    names, rows = answer.budget_rows()
    if rows:
        screen.print("\nUncertainty budget: shares of the variance")
        show.print_table(screen, names, rows, range(4))
    _print_scores(screen, answer, everything=everything)
    for text in answer.warnings(everything=everything):
        if text not in shown and text not in answer.doubts:
            screen.print(text)


def _print_parameters(
    screen: Console, parameters: Mapping[str, Value], truth: Mapping[str, float] | None = None
) -> None:
    from adis_gonio.fitting.answer import parameter_row

    columns = ["parameter", "unit", "value", "u", "U (95 %)", "k", "ν"]
    rows = [parameter_row(name, value) for name, value in parameters.items()]
    if truth is not None:
        columns.insert(2, "truth")
        for row, (name, value) in zip(rows, parameters.items(), strict=True):
            true = format_fixed(truth[name], count_decimals(value.u or 0.0)) if name in truth else ""
            row.insert(2, true)
    show.print_table(screen, columns, rows, (0, 1), bold=("ΔK", "Δφ"))


def _print_scores(screen: Console, answer: Answer, *, everything: bool) -> None:
    """Show the scores of the methods; with `everything`, show each method in full.

    A score is the error on the dwells of the session; each dwell is left out of the fit that predicts it.
    """
    from adis_gonio.fitting.answer import method_tables

    head, rows = answer.score_rows()
    failures = answer.comparison.failures
    if len(rows) > 1 or failures:
        screen.print(f"\n{answer.scored_on}")
        if len(head) > 1:
            show.print_table(screen, head, rows, bold=rows[0][:1] if rows else ())
    for method, reason in failures.items():
        screen.print(f"no result by {method}: {reason}")
    most = max(1, (screen.width - 26) // 24)  # the column of a method is 24 characters wide
    for block_head, block in method_tables(answer.comparison.results, most) if everything else ():
        screen.print()
        show.print_table(screen, block_head, block, (0, 1))


def _print_monte_carlo(screen: Console, run: MonteCarlo) -> None:
    screen.print(f"\nMonte Carlo, {run.trials} trials (GUM Supplement 1)", style="bold")
    show.print_table(screen, *run.rows(), (0, 1))
    for line in run.remarks:
        screen.print(f"  {line}")


def show_gyro_fit(
    session: Session, method: str | None, *, as_json: bool, calibration: Path | None = None
) -> None:
    """Fit the gyros of a session and show the result.

    `method` is None for the only method; `calibration` is the file of the accelerometers' calibration, None
    for none. `as_json` prints a JSON document instead of text.
    """
    from adis_gonio.faces.api import fit

    accelerometers = None
    if calibration is not None:
        from adis_gonio.tracing.trace_calibrations import load_calibration

        accelerometers = load_calibration(calibration)
    with show.report_progress("fitting the gyros"):
        result = fit(session, method, part="gyro", accelerometers=accelerometers)
    if as_json:
        show.print_json(result.as_dict())
        return
    screen = show.console(most=show.WIDTH)
    title = f"{session.title}: " if session.title else ""
    screen.print(f"{title}gyros, {result.extent}, {session.sensor}\n", style="bold")
    _print_parameters(screen, result.parameters, session.facts.get("truth"))
    screen.print()
    if result.triad is not None:
        screen.print("The gyros' triad: rotation against the accelerometers', and 90° minus its angles")
        _print_parameters(screen, result.triad)
        screen.print()
    screen.print(
        f"  residual {result.residual_rms_dps:.3g} °/s rms, χ² {result.chi2:.1f} at {result.dof} degrees of"
        " freedom"
    )
    if result.scores:
        screen.print("\nEach dwell left out in turn, error of its rate in °/s, rms")
        scores = [
            (name, *(f"{v:.3f}" for v in score["residual_rms_by_axis_dps"].values()))
            for name, score in result.scores.items()
        ]
        show.print_table(screen, ("model", *"xyz"), scores)
    for text in result.warnings:
        screen.print(text)


@option.command("allan", "--output --sensor-part --json")
@option.session
@option.part("gyro")
@click.option(
    "--filter", "filter_m", type=click.IntRange(0, 6), metavar="M",
    help="Filter of the chip, two passes of 2^M taps, if the file does not contain it.",
)  # fmt: skip
@option.output("Write a page with the Allan plot (extra: report).")
@option.overrides
@option.json
def allan_command(
    *,
    session: Path,
    part: Part,
    filter_m: int | None,
    output: Path | None,
    as_json: bool,
    overrides: Overrides,
) -> None:
    """Estimate the noise of a part at rest: random walks and bias instability, with uncertainties.

    The estimate is by maximum likelihood, from the dwells of a session or the rests of a continuous
    recording; the Allan deviation is shown next to it. A kind of noise that is not found gets an upper
    limit. docs/gyros.md explains how long to record.
    """
    from adis_gonio.fitting.allan import fit_allan
    from adis_gonio.handover.gyro_report import allan_page, section_of, title_of

    show.check_page(output)
    loaded = option.load(session, overrides)
    with show.report_progress(f"noise of {session.name}"):
        found = fit_allan(loaded, part, filter_m=filter_m)
    if output is not None:
        show.write_page(output, allan_page(found))
    title = f"Noise at rest of the {title_of(found)} ({found.sensor})"
    show.print_result(found, title, [section_of(found, figures=False)], as_json=as_json)
