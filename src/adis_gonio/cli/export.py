"""`adis-gonio export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from adis_gonio.cli.overrides import load, override_options
from adis_gonio.errors import UsageError

if TYPE_CHECKING:
    from adis_gonio.session.overrides import Overrides


@click.command("export")
@click.argument("session", type=click.Path(path_type=Path))
@click.option("--format", "kind", type=click.Choice(["csv", "json"]), required=True)
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), help="File to make; JSON may go to the screen."
)
@click.option("--method", help="JSON: method of the coefficients; the best one unless told.")
@click.option("--samples", is_flag=True, help="JSON: every sample too.")
@override_options
def command(
    *,
    session: Path,
    kind: str,
    output: Path | None,
    method: str | None,
    samples: bool,
    overrides: Overrides,
) -> None:
    """Write a session's data and coefficients for other programs.

    csv is the samples CSV, which `adis-gonio fit` reads back. json holds the coefficients with their
    covariance and what is known of the session; --samples adds the data.
    """
    from adis_gonio.cli.show import json_text
    from adis_gonio.session import export_csv
    from adis_gonio.session.export import session_dict

    loaded = load(session, overrides)
    if kind == "csv":
        if output is None:
            raise UsageError("--format csv needs -o FILE.csv or FILE.csv.gz")
        if method is not None or samples:
            raise UsageError("--method and --samples go with --format json: a CSV holds the samples only")
        export_csv(loaded, output)
        return
    from adis_gonio.fitting import fit

    document = session_dict(loaded)
    if not samples:
        del document["dwells"]
    document = {"coefficients": fit(loaded, method=method).as_dict(), "session": document}
    if output is None:
        click.echo(json_text(document))
        return
    if output.exists():
        raise UsageError(f"{output}: exists already; choose another name")
    output.write_text(json_text(document) + "\n", encoding="utf-8")
