"""`adis-gonio paper`."""

from __future__ import annotations

from pathlib import Path

import click

from adis_gonio.faces.cli.show import json_option, print_json
from adis_gonio.faces.cli.working import working


@click.command("paper")
@click.option(
    "-o", "--output", type=click.Path(path_type=Path),
    help="Where to write the page; a page that is there is replaced.",
)  # fmt: skip
@json_option
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of all that is random.")
@click.option("--sessions", type=int, default=10, show_default=True, help="Simulated parts of each kind.")
def command(*, output: Path | None, as_json: bool, seed: int, sessions: int) -> None:
    """Reproduce the seed paper: its table 1, its figure 3, and where its method overtakes MMPM.

    Sessions are simulated through chip and driver, from parts whose truth is the table's measured column.
    Takes a minute or two on two cores. Without -o and --json what came out is printed.
    """
    from adis_gonio.base.output import check_output, replacing
    from adis_gonio.handover.paper import reproduce
    from adis_gonio.page.svg import require_matplotlib

    if output is not None:
        check_output(output, force=True)
        require_matplotlib()
    with working("the seed paper"):
        done = reproduce(seed, sessions)
    if output is not None:
        from adis_gonio.handover.paper.page import build_page

        page = build_page(done)
        with replacing(output) as beside:
            beside.write_text(page, encoding="utf-8")
        click.echo(f"{output}: {len(page.encode()) // 1024 + 1} kB", err=True)
    if as_json:
        print_json(done.as_dict())
    elif output is None:
        from adis_gonio.handover.paper.page import verdicts

        for sentence in verdicts(done):
            click.echo(sentence)
