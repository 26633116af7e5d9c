"""A continuous recording written to a samples CSV while it is measured.

The file has no column `position`: the dwells are found by stillness when it is read. Every block is
flushed, so that a recording that is cut off is a shorter recording.
"""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import IO, Self

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.base.output import ends_in, exists_error
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.blocks import GENERIC, Block, session_columns


class SamplesRecorder:
    """Writes scans to a samples CSV (`.csv` or `.csv.gz`), a row a scan; use it as a context manager.

    Accelerometers are written in LSB, as the sensor gave them (of a generic one in mg); gyros in °/s,
    temperature in °C, supply in V. Registers that the format has no column for are left out.

    Attributes
    ----------
    path : Path
    notes : list of str
        What the reader of the file has to know; written with its header, before the first row.

    Raises
    ------
    UsageError
        The file exists, or the scans lack an accelerometer.
    """

    def __init__(
        self,
        path: Path,
        variant: str,
        *,
        gravity_mps2: float = STANDARD_GRAVITY_MPS2,
        title: str = "",
    ) -> None:
        if path.exists():
            raise exists_error(path)
        if not ends_in(path, ".csv", ".csv.gz"):
            raise UsageError(f"{path}: a recording is named .csv or .csv.gz")
        self.path = path
        self.rows = 0
        self.lost = 0
        self.notes: list[str] = []
        self._header = [
            f"# title: {' '.join(title.split()) or 'continuous recording'}",
            f"# sensor: {variant}",
            f"# accel_unit: {'mg' if variant == GENERIC else 'lsb'}",
            f"# gravity_mps2: {gravity_mps2:.6g}",
            "# fixture_sigma_deg: free",
            "# plane: none",
        ]
        self._named = False
        self._file: IO[str] = (
            gzip.open(path, "xt", encoding="utf-8")  # noqa: SIM115 (closed by `close`)
            if ends_in(path, ".gz")
            else path.open("x", encoding="utf-8")
        )

    def add(self, block: Block) -> None:
        """Append the scans of a block."""
        columns = session_columns(block)
        if not self._named:
            notes = [f"# note: {' '.join(note.split())}" for note in self.notes]
            self._file.write("\n".join([*self._header, *notes, ",".join(["time_s", *columns]), ""]))
            self._named = True
        whole = block.variant != GENERIC
        formats = ["%d" if whole and name in ("ax", "ay", "az") else "%.6g" for name in columns]
        table = np.column_stack([block.time_s, *columns.values()])
        np.savetxt(self._file, table, fmt=["%.6f", *formats], delimiter=",")
        self._file.flush()
        self.rows += len(block)
        self.lost += block.lost

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
