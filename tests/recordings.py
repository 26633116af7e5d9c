"""Measured recordings of real sensors: those of the clone, and larger ones that may be missing."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT / "examples" / "measured"
LARGER = Path(os.environ.get("ADIS_GONIO_DATA", ROOT.parent / "shared" / "data"))


RUNS_AT_REST = tuple(f"adis16405/run{number}_10s_means" for number in range(1, 7))
LARGER_NAMES = frozenset(
    (
        *(f"mpu9150_{number}_recording" for number in (1, 2, 3, 4)),
        *(f"mimu4444/exp{number}_imu4" for number in (6, 7, 8, 9)),
        *(f"mimu4444/exp{number}_imu1" for number in range(4, 10)),
        "adis16405/run4_first_hour",
        *RUNS_AT_REST,
    )
)
"""Recordings that are no part of the clone; a test of any other never skips."""


def recording(name: str) -> Path:
    """Return the path of a recording; skip the test if it is a larger file that is missing.

    Raises
    ------
    FileNotFoundError
        If a recording that belongs to the clone is missing.
    """
    path = MEASURED / f"{name}.csv.gz"
    if path.exists():
        return path
    if name not in LARGER_NAMES:
        raise FileNotFoundError(f"{path} belongs to the clone: restore it from git")
    path = LARGER / f"{name}.csv.gz"
    if path.exists():
        return path
    pytest.skip(
        f"no {name}.csv.gz in {LARGER}: set ADIS_GONIO_DATA (sources in examples/measured/README.md)"
    )
