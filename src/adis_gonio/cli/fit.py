"""`adis-gonio fit`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import click

from adis_gonio.cli.show import console, json_option, print_json, with_uncertainty
from adis_gonio.cli.working import working


@click.command("fit")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--method",
    help="paper, two-position, four-position, mmpm or ml; without it the best that the session supports.",
)
@json_option
def command(*, session: Path, method: str | None, as_json: bool) -> None:
    """Compute ΔK, Δφ and the other parameters of a recorded session, with standard uncertainties.

    Without --method the screen compares every method that the session supports; --json gives the best one.
    """
    from adis_gonio.fitting import fit, fit_every
    from adis_gonio.session import load_session

    with working(f"reading {session.name}"):
        loaded = load_session(session)
    with working(f"fitting {len(loaded.dwells)} dwells of {session.name}"):
        every = fit_every(loaded) if method is None and not as_json else ([fit(loaded, method=method)], {})
    results, failures = every
    if as_json:
        print_json(results[0].as_dict())
        return
    screen = console()
    title = f"{loaded.title}: " if loaded.title else ""
    screen.print(f"{title}{len(loaded.dwells)} dwells, {loaded.sensor}", style="bold", markup=False)
    for note in loaded.notes:
        screen.print(f"  {note}", markup=False)
    print_results([result.as_dict() for result in results], shown=loaded.notes, failures=failures)


def print_results(
    documents: list[dict[str, Any]],
    truth: Mapping[str, float] | None = None,
    shown: Collection[str] = (),
    failures: Mapping[str, str] | None = None,
) -> None:
    """Show fits side by side, a column a method, with the truth of a simulation where there is one.

    `shown` are lines that were printed already and need not come again as warnings; `failures` says why
    other methods give nothing.
    """
    from rich.table import Table

    screen = console()
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("")
    table.add_column("unit")
    if truth is not None:
        table.add_column("truth", justify="right")
    for document in documents:
        table.add_column(document["method"], justify="right")
    names = list(dict.fromkeys(name for document in documents for name in document["parameters"]))
    for name in names:
        entries = [document["parameters"].get(name) for document in documents]
        first = next(entry for entry in entries if entry is not None)
        row = [name, first["unit"]]
        if truth is not None:
            row.append(f"{truth[name]:.6g}" if name in truth else "")
        for entry in entries:
            row.append("" if entry is None else with_uncertainty(entry["value"], entry["u"]))
        table.add_row(*row, style="bold" if name in ("delta_k", "delta_phi") else None)
    table.add_section()
    empty = [""] if truth is not None else []
    for label, unit, cell in _SUMMARY:
        table.add_row(label, unit, *empty, *(cell(document) for document in documents))
    screen.print(table)
    for warning, methods in _warnings(documents).items():
        if warning not in shown:
            screen.print(f"{', '.join(methods)}: {warning}", markup=False)
    for method, reason in (failures or {}).items():
        screen.print(f"no result by {method}: {reason}", markup=False)


def _warnings(documents: list[dict[str, Any]]) -> dict[str, list[str]]:
    """Each warning with the methods that give it."""
    said: dict[str, list[str]] = {}
    for document in documents:
        for warning in document["warnings"]:
            said.setdefault(warning, []).append(document["method"])
    return said


def _number(value: float | None, spec: str) -> str:
    return "–" if value is None else format(value, spec)


def _chi2(document: dict[str, Any]) -> str:
    return (
        f"{_number(document['chi2'], '.1f')} / {document['dof']}" if document["dof"] else "no freedom left"
    )


_SUMMARY: tuple[tuple[str, str, Callable[[dict[str, Any]], str]], ...] = (
    ("residual, rms", "mg", lambda document: _number(document["residual_rms_mg"], ".3f")),
    ("χ² / dof", "", _chi2),
    (
        "error of the angle, rms",
        "°",
        lambda document: _number((document["angle_error_deg"] or {}).get("rms"), ".4f"),
    ),
)
