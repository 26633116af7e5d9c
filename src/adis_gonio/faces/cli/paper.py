"""`adis-gonio paper`."""

from __future__ import annotations

from pathlib import Path

import click

from adis_gonio.faces.cli import options as option
from adis_gonio.faces.cli.show import check_page, print_json, working, write_page


@click.command("paper")
@option.output("Where to write the page; a page that is there is replaced.")
@option.json
@option.shown("--seed", type=int, default=0, help="Seed of all that is random.")
@option.shown("--sessions", type=int, default=10, help="Simulated parts of each kind.")
def command(*, output: Path | None, as_json: bool, seed: int, sessions: int) -> None:
    """Reproduce the seed paper: its table 1, its figure 3, and where its method overtakes MMPM.

    Sessions are simulated through chip and driver, from parts whose truth is the table's measured column.
    Takes a minute or two on two cores. Without -o and --json what came out is printed.
    """
    from adis_gonio.handover.paper_study import reproduce

    check_page(output)
    with working("the seed paper"):
        done = reproduce(seed, sessions)
    if output is not None:
        from adis_gonio.handover.paper_page import build_page

        write_page(output, build_page(done))
    if as_json:
        print_json(done.as_dict())
    elif output is None:
        from adis_gonio.handover.paper_page import verdicts

        for sentence in verdicts(done):
            click.echo(sentence)
