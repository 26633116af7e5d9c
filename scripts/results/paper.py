"""The reproduced seed paper: its table."""

from __future__ import annotations

from adis_gonio.handover.paper_study import reproduce
from results.section import Effort, Section


def run(effort: Effort) -> Section:
    """Reproduce the paper."""
    document = reproduce(effort.seed, effort.sessions(20, 2)).as_dict()
    command = document.pop("command")
    return Section(document | {"of_the_command": command}, {})
