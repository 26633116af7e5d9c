"""The reproduced seed paper: its table, and the fixtures for which its method beats MMPM."""

from __future__ import annotations

from adis_gonio.handover.paper_page import map_figures
from adis_gonio.handover.paper_study import reproduce
from results.section import Effort, Section


def run(effort: Effort) -> Section:
    """Reproduce the paper."""
    done = reproduce(
        effort.seed,
        effort.sessions(20, 2),
        effort.jobs,
        **({"draws": 100} if effort.fast else {}),
    )
    # Each part of the sessions is in the document of the command: here it would be a megabyte.
    document = {key: value for key, value in done.as_dict().items() if key not in ("parts", "command")}
    document["of_the_command"] = f"{done.command} --json"

    svg, _ = map_figures(done)["ratio"]
    return Section(document, {"ratio": svg})
