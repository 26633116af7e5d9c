"""How a session shows itself: on the bench screen where the terminal can, else by plain prompts."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
from typing import TYPE_CHECKING, Protocol

import click

if TYPE_CHECKING:
    from adis_gonio.bench.runner import SessionRunner

LEAST_COLUMNS, LEAST_ROWS = 80, 24
"""The screen's; kept here too so that asking costs no import (a test compares them)."""


class Face(Protocol):
    """Runs a session and asks its operator."""

    def run(self) -> bool:
        """Run the session; return True where it is complete."""


def choose_face(runner: SessionRunner, prompts: Face, *, plain: bool, resume_by: str) -> Face:
    """The screen where it is wanted and possible, else the plain prompts; says why where that is news.

    Parameters
    ----------
    runner : SessionRunner
        Not run yet.
    prompts : Face
        Plain prompts for the same runner.
    plain : bool
        True where the screen is not wanted: `--plain`, or nobody is asked anything.
    resume_by : str
        Command that goes on with the session.
    """
    if plain or not _is_terminal():
        return prompts
    why_not = _why_not()
    if why_not:
        click.echo(f"plain prompts: {why_not}", err=True)
        return prompts
    from adis_gonio.faces.tui.face import ScreenFace

    return ScreenFace(runner, resume_by)


def _is_terminal() -> bool:
    """True where both ends are a terminal that can place its cursor and show the screen's signs."""
    from adis_gonio.faces.cli.plain import on_terminal

    if not (on_terminal() and sys.stderr.isatty()):
        return False
    encoding = (sys.stderr.encoding or "").lower().replace("-", "")
    return os.environ.get("TERM", "") not in ("", "dumb", "unknown") and encoding == "utf8"


def _why_not() -> str:
    """What the screen lacks in this terminal; empty where nothing."""
    if importlib.util.find_spec("textual") is None:
        return "the bench screen needs pip install 'adis-gonio[bench]'"
    size = shutil.get_terminal_size()
    if size.columns < LEAST_COLUMNS or size.lines < LEAST_ROWS:
        return (
            f"the bench screen needs {LEAST_COLUMNS} × {LEAST_ROWS} characters,"
            f" this terminal has {size.columns} × {size.lines}"
        )
    return ""
