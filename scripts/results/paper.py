"""The reproduced seed paper: its table."""

from __future__ import annotations

from adis_gonio.handover.paper_study import reproduce
from results.section import Effort, Section


def run(effort: Effort) -> Section:
    """Reproduce the paper."""
    done = reproduce(effort.seed, effort.sessions(20, 2), effort.jobs)
    # Each part of the sessions is in the document of the command: here it would be a megabyte.
    document = {key: value for key, value in done.as_dict().items() if key not in ("parts", "command")}
    return Section(document | {"of_the_command": f"{done.command} --json"}, {})
