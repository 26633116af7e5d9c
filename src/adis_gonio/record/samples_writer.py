"""Sessions as samples CSV and JSON objects, templates to fill in, and a recording that grows as measured.

Numbers are written with the fewest digits that give the same float again, so that a file is read back
unchanged.
"""

from __future__ import annotations

import gzip
import io
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base import Closing
from adis_gonio.base.errors import OutputError, UsageError
from adis_gonio.base.output import ends_in, exists_error
from adis_gonio.model import records
from adis_gonio.record.blocks import GENERIC, Block, block_series
from adis_gonio.record.plans import Plan
from adis_gonio.record.samples_columns import COLUMNS, KEYS, without_formulas


def write_samples_csv(session: records.Session, path: str | Path) -> None:
    """Write a session as samples CSV, gzipped if the name ends in `.gz`.

    Numbers are written with the fewest digits that give the same float again. Columns that no dwell has are
    left out. Samples between two dwells are rows without a position.

    Raises
    ------
    DataError
        Dwells differ in their columns (only some have gyros), or the session has no dwell.
    """
    path = Path(path)
    turns = {turn.position: turn for turn in session.turns if len(turn)}
    declared = {number: turn.turned_deg for number, turn in turns.items()}
    dwells = tuple(replace(d, turned_deg=declared.get(d.position, d.turned_deg)) for d in session.dwells)
    columns = replace(session, dwells=dwells).columns()
    names = [name for name in COLUMNS if name in columns]
    stated = {name: getattr(session, name, None) for name in KEYS}
    lines = _leading_lines({name: value for name, value in stated.items() if value not in (None, "")})
    lines += _note_lines(session.notes)
    data = _file_text(lines, names, _all_rows(names, columns, session.sampled, turns)).encode(
        "utf-8", "replace"
    )
    if ends_in(path, ".gz"):
        data = gzip.compress(data, compresslevel=6, mtime=0)
    path.write_bytes(data)


def _leading_lines(values: Mapping[str, Any]) -> list[str]:
    """Return lines `# key: value` for the top of a file; None or an empty text leaves the value blank."""
    texts = {name: "" if value is None else KEYS[name].text(value) for name, value in values.items()}
    return [f"# {name}: {without_formulas(text)}".rstrip() for name, text in texts.items()]


def _note_lines(notes: Iterable[str]) -> list[str]:
    return [f"# note: {without_formulas(' '.join(note.split()))}" for note in notes]


def _file_text(leading: list[str], names: list[str], rows: Iterable[Iterable[str]]) -> str:
    return "\n".join([*leading, ",".join(names), *map(",".join, rows), ""])


def _all_rows(
    names: list[str],
    columns: Mapping[str, list[NDArray[Any]]],
    dwells: Sequence[records.Dwell],
    turns: Mapping[int, records.Turn],
) -> Iterator[tuple[str, ...]]:
    """Yield the rows of all dwells and of the turns between them, one after another.

    `names` are the columns of the file, `columns` has the values of each dwell by column, and `turns` has
    each turn by the number of the dwell after it.
    """
    series = {name for name in names if not COLUMNS[name].per_dwell}
    for k, dwell in enumerate(dwells):
        if k and dwell.position in turns:
            turn = turns[dwell.position]
            inside = (turn.time_s > dwells[k - 1].time_s[-1]) & (turn.time_s < dwell.time_s[0])
            part = records.Dwell(0, **turn.series(inside)).columns()
            # A turn that lacks a column of the file, such as the gyros, is left out.
            if series <= part.keys():
                yield from _rows(names, {name: part[name] for name in series})
        yield from _rows(names, {name: parts[k] for name, parts in columns.items()})


def _rows(names: list[str], columns: Mapping[str, NDArray[Any]]) -> Iterator[tuple[str, ...]]:
    """Yield rows as texts, one text for each named column.

    `columns` has the values by name. A column that is not in `columns` is left empty: samples between
    dwells have no angle or approach.
    """
    count, texts = len(columns["time_s"]), []
    for name in names:
        column = COLUMNS[name]
        if name not in columns:
            texts.append([""] * count)
        elif column.per_dwell:
            texts.append([column.text(columns[name][0])] * count)
        else:
            texts.append(list(map(column.text, columns[name].tolist())))
    return zip(*texts, strict=True)


# No line of help has a colon: it would be a key.
_HELP = (
    "-- One row is one averaged reading; for more samples repeat the row with its position and angle.",
    "-- time_s is the time of the reading in seconds from any origin, row after row later.",
    "-- accel_unit is lsb, mg, g, mps2 or counts; reading_u_mg the standard uncertainty of a reading.",
    "-- fixture_sigma_deg is the standard uncertainty of a stage angle in degrees; empty is not stated.",
    "-- Columns that the format does not know may be added; they are ignored. A spreadsheet may save it.",
)


def template_text(
    plan: Plan,
    *,
    sensor: str = "adis16354",
    accel_unit: records.AccelUnit = "mg",
    gravity_mps2: float = records.STANDARD_GRAVITY_MPS2,
    fixture_sigma_deg: float | None = None,
) -> str:
    """Return a CSV file to fill in by hand: keys, their meaning, and a row for each position of a plan.

    Only times and readings are left empty.

    Parameters
    ----------
    sensor : str
        Variant of the sensor, or `generic`.
    accel_unit : str
        Unit of the readings to enter.
    gravity_mps2 : float
        Local gravity in m/s².
    fixture_sigma_deg : float or None
        Standard uncertainty of a stage angle in degrees; None leaves it blank.

    Raises
    ------
    UsageError
        Readings are in LSB of a sensor of unknown LSB.
    """
    if sensor == "generic" and accel_unit == "lsb":
        raise UsageError("a generic sensor has no LSB that is known: give --unit mg, g, mps2 or counts")
    planar = plan.plane == "xy"
    keys: dict[str, Any] = {
        **dict.fromkeys(("title", *records.METADATA)),
        "sensor": sensor,
        "accel_unit": accel_unit,
        "gravity_mps2": gravity_mps2,
        "fixture_sigma_deg": fixture_sigma_deg if planar else math.inf,
        "plane": plan.plane,
        "reading_u_mg": None,
    }
    names = ["time_s", "position"]
    names += ["angle_deg", "approach", "ax", "ay"] if planar else ["ax", "ay", "az"]
    names += ["use"] if any(position.use == "check" for position in plan.positions) else []
    rows = []
    for number, position in enumerate(plan.positions):
        angle = math.nan if position.angle_deg is None else float(f"{position.angle_deg:.10g}")
        values = {
            "position": number, "angle_deg": angle, "approach": position.approach, "use": position.use
        }  # fmt: skip
        rows.append([COLUMNS[name].text(values[name]) if name in values else "" for name in names])
    return _file_text([*_leading_lines(keys), *(f"# {line}" for line in _HELP)], names, rows)


def session_dict(session: records.Session) -> dict[str, Any]:
    """Return a session without its samples in JSON form; a `fixture_sigma_deg` of inf is "free"."""
    stated = {name: getattr(session, name) for name in KEYS if hasattr(session, name)}
    if session.free_attitudes:
        stated["fixture_sigma_deg"] = "free"
    if session.stage_curve is not None:
        stated["stage_curve"] = session.stage_curve.as_dict()
    return {
        **stated,
        "source": session.source,
        "notes": list(session.notes),
        "facts": session.facts,
    }


class SamplesRecorder(Closing):
    """Writes scans to a samples CSV, one row for each scan; use it as a context manager.

    Accelerations are written in LSB of the sensor (of a generic sensor in mg), rates in °/s, temperatures
    in °C, the supply in V. Registers without a column in the format are left out.

    Parameters
    ----------
    variant : str
        Variant of the sensor, or `generic`.
    gravity_mps2 : float
        Local gravity in m/s², for the head of the file.
    title : str
        Title for the head of the file; empty for a general title.
    filter_m : int or None
        Exponent M of the chip's filter, for the head of the file; None for another sensor.
    force : bool
        True: the first block replaces an existing file.

    Attributes
    ----------
    path : Path
        Path of the file, which ends in .csv or .csv.gz.
    rows : int
        Number of scans written so far.
    notes : list of str
        Remarks for the reader of the file, written before its first row.

    Raises
    ------
    UsageError
        The file exists or has another ending, or the scans lack an accelerometer.
    """

    def __init__(
        self,
        path: Path,
        variant: str,
        *,
        gravity_mps2: float = records.STANDARD_GRAVITY_MPS2,
        title: str = "",
        filter_m: int | None = None,
        force: bool = False,
    ) -> None:
        if path.exists() and not force:
            raise exists_error(path)
        if not ends_in(path, ".csv", ".csv.gz"):
            raise UsageError(f"{path}: a recording is named .csv or .csv.gz")
        self.path = path
        self.rows = 0
        self._mode = "wb" if force else "xb"
        self._size = 0
        self.notes: list[str] = []
        stated = {
            "title": title.strip() or "continuous recording",
            "sensor": variant,
            "accel_unit": "mg" if variant == GENERIC else "lsb",
            "gravity_mps2": float(f"{gravity_mps2:.6g}"),
            "fixture_sigma_deg": math.inf,
            "plane": "none",
        }
        self._header = _leading_lines(stated if filter_m is None else {**stated, "filter_m": filter_m})
        self._file: IO[bytes] = io.BytesIO()
        """The open file; until the first block an empty one in memory, so that an old file stays."""

    def add(self, block: Block) -> None:
        """Append the samples of a block to the file, which the first block creates.

        Raises
        ------
        UsageError
            The file has come to exist since the recorder was made, and `force` is not set.
        OutputError
            The file cannot be written.
        """
        columns, text = records.Dwell(0, block.time_s, **block_series(block)).columns(), io.StringIO()
        del columns["position"]
        if not self._size:
            head = [*self._header, *_note_lines(self.notes)]
            text.write(_file_text(head, [*columns], ()))
        whole = block.variant != GENERIC
        own = {"time_s": "%.6f"} | (dict.fromkeys(("ax", "ay", "az"), "%d") if whole else {})
        table = np.column_stack([*columns.values()])
        np.savetxt(text, table, fmt=[own.get(name, "%.6g") for name in columns], delimiter=",")
        data = text.getvalue().encode("utf-8", "replace")
        # Each block is a gzip member of its own, so that the file is complete after every block.
        data = gzip.compress(data, mtime=0) if ends_in(self.path, ".gz") else data
        try:
            if not self._size:
                self._file = self.path.open(self._mode)
            self._file.write(data)
            self._file.flush()
        except FileExistsError:
            raise exists_error(self.path) from None
        except OSError as error:
            # Close the file, and remove the rows of the failed block.
            with suppress(OSError):
                self._file.close()
            with suppress(OSError):
                os.truncate(self.path, self._size)
            kept = f"its {self.rows} rows from before are complete"
            raise OutputError(f"{self.path}: {error.strerror or error}; {kept}") from error
        self._size += len(data)
        self.rows += len(block)

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()
