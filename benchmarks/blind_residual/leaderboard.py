"""The leaderboard in Markdown."""

from pathlib import Path


def write(truths: Path, answered: Path, names: list[str], output: Path, records: Path | None) -> None:
    """Write it."""
    raise NotImplementedError
