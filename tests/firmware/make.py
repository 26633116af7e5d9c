"""Running make with its products in a folder of the tests."""

import subprocess
from pathlib import Path

TIME_OUT_S = 300


def make(makefile_folder: Path, products: Path, *arguments: str) -> str:
    """Run make; returns what it printed.

    Raises
    ------
    RuntimeError
        It failed; the text is its output.
    """
    run = subprocess.run(
        ["make", "-s", "-C", str(makefile_folder), f"BUILD={products}", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=TIME_OUT_S,
    )
    if run.returncode:
        raise RuntimeError(f"make failed:\n{run.stdout}{run.stderr}")
    return run.stdout
