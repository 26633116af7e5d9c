"""Measured recordings of real sensors: those of the clone, and larger ones that may be missing."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT / "examples" / "measured"
LARGER = Path(os.environ.get("ADIS_GONIO_DATA", ROOT.parent / "shared" / "data"))


def recording(name: str) -> Path:
    """Return the path of a recording; skip the test if it is a larger file that is missing."""
    for folder in (MEASURED, LARGER):
        path = folder / f"{name}.csv.gz"
        if path.exists():
            return path
    pytest.skip(
        f"no {name}.csv.gz in {LARGER}: set ADIS_GONIO_DATA (sources in examples/measured/README.md)"
    )
