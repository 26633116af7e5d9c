"""Sections of docs/results/: `python scripts/results` measures them and writes the page."""

SECTIONS: tuple[str, ...] = (
    "paper",
    "angle",
    "plan",
    "free_turn",
    "gyros",
    "links",
    "slips",
    "smoother",
    "allan",
    "population",
    "fleet",
    "bench",
)
"""Modules of this package, each with `run(effort) -> Section`."""
