"""Sections of docs/results/: `python scripts/results` makes the pages."""

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
"""Modules beside this one, each with `run(effort) -> Section`, in the order of the index."""
