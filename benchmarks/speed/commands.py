"""Processor time of `fit` and `report` from the shell, against the import of numpy and scipy.optimize."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from speed.timing import Row, quartiles

PYTHON = (sys.executable, "-c")
BASELINE = "import numpy, scipy.optimize"
SESSION = ("calibrate", "sim:?seed=1", "--auto", "-o", "first.session", "--plan")
COMMANDS = {
    "fit": ("fit", "first.session"),
    "report": ("report", "first.session", "-o", "first.html", "--force"),
}


def run(*, fast: bool) -> list[Row]:
    """Rows of `fit` and `report` on a session of 24 dwells with recorded turns, of two if `fast`."""
    runs, plan = (1, "two-position") if fast else (5, "tumble")
    rows = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        _spent_s((sys.executable, "-m", "adis_gonio", *SESSION, plan), folder)
        for name, arguments in COMMANDS.items():
            pairs = [
                (
                    _spent_s((*PYTHON, BASELINE), folder),
                    _spent_s((sys.executable, "-m", "adis_gonio", *arguments), folder),
                )
                for _ in range(runs)
            ]
            low, middle, high = quartiles([theirs / own for theirs, own in pairs])
            times = f"{1 / middle:.2f} times the import"
            rows.append(Row(f"command {name}", BASELINE, middle, low, high, runs, "", times))
    return rows


def _spent_s(command: tuple[str, ...], folder: Path) -> float:
    """Processor time of a program and of the system for it, in s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, cwd=folder, check=True, capture_output=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
