"""`adis-gonio fit --sensor-part gyro`: what is shown of a fit of the gyros."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.faces.cli.show import WIDTH, console, print_json
from adis_gonio.faces.cli.working import working

if TYPE_CHECKING:
    from pathlib import Path

    from rich.table import Table

    from adis_gonio.base.values import Value
    from adis_gonio.fitting.gyros.fit import GyroFit
    from adis_gonio.model.records import Session


def show_gyro_fit(
    session: Session, method: str | None, *, as_json: bool, calibration: Path | None = None
) -> None:
    """Fit the gyros of a session and show the result."""
    from adis_gonio.faces.api import fit

    accelerometers = None
    if calibration is not None:
        from adis_gonio.tracing.loading import load_calibration

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
    screen.print(_parameters(result.parameters))
    screen.print()
    if result.triad is not None:
        screen.print("The gyros' triad: rotation against the accelerometers', and 90° minus its angles")
        screen.print(_parameters(result.triad))
        screen.print()
    screen.print(
        f"  residual {result.residual_rms_dps:.3g} °/s rms, χ² {result.chi2:.1f} at {result.dof} degrees of"
        " freedom"
    )
    if result.scores:
        screen.print()
        screen.print("Each dwell left out in turn, error of its rate in °/s, rms")
        screen.print(_scores(result))
    for text in result.warnings:
        screen.print(text, markup=False)


def _parameters(parameters: dict[str, Value]) -> Table:
    from rich.table import Table

    from adis_gonio.fitting.tables import parameter_row

    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in ("parameter", "unit", "value", "u", "U (95 %)", "k", "ν"):
        table.add_column(name, justify="left" if name in ("parameter", "unit") else "right")
    for name, value in parameters.items():
        table.add_row(*parameter_row(name, value))
    return table


def _scores(result: GyroFit) -> Table:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("model")
    for axis in "xyz":
        table.add_column(axis, justify="right")
    for name, score in result.scores.items():
        table.add_row(name, *(f"{value:.3f}" for value in score.rms_dps.values()))
    return table
