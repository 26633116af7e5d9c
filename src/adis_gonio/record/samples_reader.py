"""The samples CSV as a session: its rows as arrays, chunk by chunk, and the dwells in them.

The numbers of a column are converted in bulk. Only if that fails they are read one by one, so that an error
names the row. In a file separated by commas a fraction has a point, as the format requires, or the cell is
quoted. In other files the numbers have to prove the decimal mark (point or comma): `0,5` or `1234,5` can
only have a decimal comma, while the comma of `1,234` may also separate thousands. A file without proof is
refused, and so is a number with another mark.

Comments, empty rows at the end and an incomplete last row are left out. Columns with one value for each
dwell are kept as runs of equal text, so that memory is used for little but the numbers.

A file without the column `position` is one continuous recording: its dwells are found by stillness
(`adis_gonio.record.segmentation`), and `Session.notes` describes them.
"""

from __future__ import annotations

import math
import re
from array import array
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.model.records import SERIES, Dwell, Session
from adis_gonio.record import samples_header
from adis_gonio.record.loading import Overrides
from adis_gonio.record.plans import MOST_POSITIONS
from adis_gonio.record.samples_columns import COLUMNS, SAME
from adis_gonio.record.segmentation import segment_with_notes, shows_a_free_turn

_WALL_CLOCK = re.compile(
    r"[12]\d{3}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?\s*(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII
)
"""Pattern of a time in ISO 8601 with its date, as loggers write it, with or without Z or an offset."""
# Possessive quantifiers (++) prevent backtracking, which takes hours in a cell of thousands of digits.
_NUMBER = re.compile(r"[+-]?(?:\d++\.?\d*+|\.\d+)(?:[eE][+-]?\d+)?")
_UNDECIDED = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
"""Pattern of a number with a mark that may be the decimal mark or separate thousands."""
_SWAPPED = str.maketrans(",.", ".,")
"""Exchange of point and comma, after which only a number with a decimal comma is one of Python's."""
_SLOWEST_S = 2.0
"""Median step of the rows in s from which a time without a unit may be in ms, so that it is refused."""
_HOTTEST_C = 225.0
"""Largest magnitude of a temperature in °C: no sensor works above it, and −48 °C are 225 K."""
Runs = list[tuple[int, Any]]
"""Values of a column with one value for each dwell, each with the first row of its run; None if empty."""


class SamplesTable:
    """The rows of a samples file as arrays of numbers, in the units of the format.

    Parameters
    ----------
    path : Path
        File to read.
    wanted : mapping of str to str
        Column of the format → column of the header, as the user assigned them.

    Attributes
    ----------
    head : Head
        Keys, header, delimiter and remarks of the file.
    series : dict of str to (n,), (n, 2) or (n, 3) float
        Samples by the fields of a `Dwell`, without fields that the file lacks.
    runs : dict of str to list of (int, value)
        Columns with one value for each dwell: first row and value of each run of equal text, None if it is
        empty.
    notes : list of str
        Remarks on the head and on rows that were left out.
    lines : array of int
        Line number in the file, from 1, of each row of the table.
    began : datetime or None
        Time of the first row; None unless the file has times of the wall clock.

    Raises
    ------
    DataError
        The file is no samples CSV, or a row has a value that cannot be used; see `read_samples_csv`.
    UsageError
        `wanted` names a column that does not exist.
    """

    def __init__(self, path: Path, wanted: Mapping[str, str]) -> None:
        self.head = head = samples_header.read_head(path, wanted)
        self.notes = list(head.notes)
        self.series: dict[str, Floats] = {}
        self.runs: dict[str, Runs] = {name: [] for name in head.columns if COLUMNS[name].per_dwell}
        present = {name: [m for m in members if m in head.columns] for name, members in SERIES.items()}
        # Arrays that grow at their end without a copy, row after row.
        self._numbers = {name: (members, array("d")) for name, members in present.items() if members}
        self._rows, self._latest_s = 0, -math.inf
        self.lines = array("I")
        self._decimal, self._proved = ".", False
        """Decimal mark, and whether a number has proved it."""
        self._doubtful: tuple[str, str, int] | None = None
        """Column, text and line of the first number with a mark; None before it."""
        self.began: datetime | None = None
        self._repeated, self._first_repeated = 0, 0
        self._waiting: tuple[int, str, str] | None = None
        """Line allowed only at the end: its number, the error elsewhere, the note at the end; or None."""
        tell: Callable[[str], Any] = current().tell
        for chunk in samples_header.read_chunks(path, after=head.line):
            tell(f"{chunk.share:.0%}")
            self._take(chunk)
        self._finish()

    def __len__(self) -> int:
        return self._rows

    def fail(self, line: int, message: str) -> DataError:
        """Return a `DataError` with a message about a line of the file, by its number; it names both."""
        return DataError(f"{self.head.path.name}, row {line}: {message}")

    def _plain_number(self, cell: str) -> float:
        text = cell.strip().replace("−", "-")
        text = text.translate(_SWAPPED) if self._decimal == "," else text
        if not _NUMBER.fullmatch(text) and text.lower().lstrip("+-") not in ("nan", "inf", "infinity"):
            raise ValueError(cell)
        return float(text)

    def values(self, name: str, rows: slice) -> Runs:
        """Return the runs of equal texts in a column within some rows, each as its first row and its value.

        `name` is a column with a value for each dwell, such as the angle.
        """
        runs = self.runs[name]
        first = bisect_right(runs, rows.start, key=lambda run: run[0]) - 1
        last = bisect_left(runs, rows.stop, key=lambda run: run[0])
        return [(max(row, rows.start), value) for row, value in runs[first:last]]

    def _declared_value(self, name: str, text: str) -> Any:
        """Read a cell of a column with one value for each dwell.

        Raises
        ------
        ValueError
            The cell is wrong; the message is the reason.
        """
        if name == "use":
            if text.lower() not in ("fit", "check"):
                raise ValueError("is neither 'fit' nor 'check'")
            return text.lower()
        if name == "approach":  # it may have the other decimal mark, because it does not settle the mark
            text = text.removesuffix(".0").removesuffix(",0")
        multiply, divide, add = self.head.columns[name].scale
        try:
            value = self._plain_number(text) * multiply / divide + add
        except ValueError:
            value = math.nan
        # A spreadsheet may write an integer as 3.0 or 3,0.
        if name == "approach" and value not in (-1, 0, 1):
            raise ValueError("is neither +1 nor -1")
        if name == "position" and not (value.is_integer() and abs(value) < COLUMNS[name].largest):
            raise ValueError("is not an integer of at most 9 digits")
        if not abs(value) <= COLUMNS[name].largest:
            raise ValueError("is not an angle of a stage in degrees; leave it empty if it is unknown")
        return value if name in ("angle_deg", "turned_deg") else int(value)

    # -- rows -----------------------------------------------------------------------------------------

    def _take(self, chunk: samples_header.Chunk) -> None:
        """Add the rows in the next chunk of the file's lines to the table."""
        rows, lines = [], []
        for number, line in enumerate(chunk.lines, chunk.first):
            if not line.startswith(("#", '"#')):
                cells = self._cells(number, line)
                if cells is not None:
                    rows.append(cells)
                    lines.append(number)
        if rows and not self._proved:
            self._settle_decimal(rows, lines)
        if chunk.cut and lines and lines[-1] == chunk.first + len(chunk.lines) - 1:
            try:
                self._values(rows[-1:], lines[-1:])
            except DataError:
                rows.pop()
                self.notes.append(_cut_note(lines.pop()))
        if rows:
            self._add(rows, lines)

    def _settle_decimal(self, rows: list[list[str]], lines: list[int]) -> None:
        """Take the decimal mark from the first number that has a mark, until a number proves one."""
        places = {c.place: name for name, c in self.head.columns.items() if name not in ("approach", "use")}
        for row, line in zip(rows, lines, strict=True):
            for place, name in places.items():
                text = row[place].strip()
                mark = "," if "," in text else "."
                if mark not in text or _WALL_CLOCK.fullmatch(text):
                    continue
                if self._doubtful is None:
                    self._decimal, self._doubtful = mark, (name, text, line)
                if (mark == "." and self.head.delimiter == ",") or not _UNDECIDED.fullmatch(text):
                    differs = mark != self._decimal
                    self._decimal, self._proved = mark, True
                    if differs:
                        self._number(*self._doubtful)
                    return

    def _cells(self, number: int, line: str) -> list[str] | None:
        """Return the cells of a row, as many as the header has; None for an empty or incomplete row.

        `number` is the line number. An empty or incomplete row is allowed only at the end of the file: a
        later row with content raises an error that names it.
        """
        width, cells = self.head.width, list[str]()
        wrong, note = "", _cut_note(number)
        try:
            cells = samples_header.split_cells(line, self.head.delimiter)
        except ValueError as error:
            wrong = str(error)
        else:
            there = f"{len(cells)} values where the header has {width}"
            if not any(cell.strip() for cell in cells):
                wrong, note = "empty row", ""
            elif len(cells) < width:
                wrong = there
            elif len(cells) > width and any(cells[width:]):
                raise self.fail(number, there + self._hint(len(cells)))
        if self._waiting is not None and note:
            raise self.fail(*self._waiting[:2])
        if wrong:
            self._waiting = self._waiting or (number, wrong, note)
            return None
        return cells[:width]

    def _hint(self, cells: int) -> str:
        delimiter = self.head.delimiter
        if delimiter == "," and cells > self.head.width + 1:
            return "; if its numbers have decimal commas, save the file with semicolons between the cells"
        return f" (cells are separated by {samples_header.DELIMITERS.get(delimiter, repr(delimiter))}s)"

    def _add(self, rows: list[list[str]], lines: list[int]) -> None:
        """Add rows of cells, each with its line number, to the arrays."""
        self.lines.extend(lines)
        values = self._values(rows, lines)
        time = values["time_s"]
        before = np.concatenate([[self._latest_s], time[:-1]])
        for k in np.flatnonzero(time < before)[:1].tolist():
            text = f"time_s goes back from {before[k]:g} to {time[k]:g}; sort by time"
            raise self.fail(lines[k], text)
        same = np.flatnonzero(time == before)
        if same.size and not self._repeated:
            self._first_repeated = lines[int(same[0])]
        self._repeated += same.size
        for members, numbers in self._numbers.values():
            numbers.frombytes(np.column_stack([values[member] for member in members]).tobytes())
        for name, runs in self.runs.items():
            place = self.head.columns[name].place
            column = [row[place] for row in rows]
            if not runs or runs[-1][1] != column[0]:
                runs.append((self._rows, column[0]))
            runs.extend((self._rows + k, b) for k, (a, b) in enumerate(pairwise(column), 1) if a != b)
        self._rows += len(time)
        self._latest_s = float(time[-1])

    def _values(self, rows: list[list[str]], lines: list[int]) -> dict[str, Floats]:
        """Return the numbers (n,) of n rows by column name, in the units of the format.

        `lines` are the line numbers of the rows in the file, for messages.
        """
        columns, values = list(zip(*rows, strict=True)), {}
        for members, _ in self._numbers.values():
            for name in members:
                column = self.head.columns[name]
                numbers = self._column(name, columns[column.place], lines)
                if column.scale != SAME and not (name == "time_s" and self.began):
                    numbers = numbers * column.scale[0] / column.scale[1] + column.scale[2]
                wrong = np.flatnonzero((name == "temp_c") & (np.abs(numbers) > _HOTTEST_C))
                for k in wrong[:1].tolist():
                    text = (
                        f"{numbers[k]:g} °C is no temperature of a part; kelvin need the header 'temp [K]'"
                    )
                    raise self.fail(lines[k], f"column 'temp_c': {text}")
                values[name] = numbers
        return values

    def _column(self, name: str, cells: Sequence[str], lines: Sequence[int]) -> Floats:
        """Convert the cells of column `name` to numbers (n,), at once if all are plain, else one by one.

        `lines` are the line numbers of the cells in the file, for messages.
        """
        each = zip(cells, lines, strict=True)
        if name == "time_s" and (self.began or (not len(self) and _WALL_CLOCK.fullmatch(cells[0].strip()))):
            return np.array([self._since_beginning(*one) for one in each])
        text = "\n".join(cells)
        if "_" not in text:
            with suppress(ValueError):
                plain = cells
                if self._decimal == ",":
                    plain = text.translate(_SWAPPED).split("\n")
                values = np.fromiter(map(float, plain), dtype=np.float64, count=len(cells))
                if (np.abs(values) <= COLUMNS[name].largest).all():
                    return values
        return np.array([self._number(name, *one) for one in each])

    def _since_beginning(self, cell: str, line: int) -> float:
        """Convert a cell with date and time to s since the time of the first row."""
        text = cell.strip()
        with suppress(ValueError):
            if _WALL_CLOCK.fullmatch(text):
                at = datetime.fromisoformat(text.replace(" +", "+").replace(" -", "-").replace(" Z", "Z"))
                self.began = self.began or at
                if (at.tzinfo is None) == (self.began.tzinfo is None):
                    return (at - self.began).total_seconds()
        like = f"a time like '{self.began.isoformat(' ')}' before it" if self.began else "a number"
        raise self.fail(line, f"column 'time_s': '{text}' is not {like}")

    def _number(self, name: str, cell: str, line: int) -> float:
        cell = cell.strip()
        try:
            value = self._plain_number(cell)
        except ValueError:
            other, own = (".", "comma") if self._decimal == "," else (",", "point")
            wrong = f"'{cell}' is not a number" if cell else "empty; fill it, or drop its row or column"
            wrong += f" in a file with decimal {own}s" if other in cell else ""
        else:
            if abs(value) <= COLUMNS[name].largest:
                return value
            kind = "too large for a measurement" if math.isfinite(value) else "not a finite number"
            wrong = f"{cell} is {kind}; leave such rows out"
        raise self.fail(line, f"column '{name}': {wrong}")

    def _finish(self) -> None:
        """Make the arrays after the last chunk, and add remarks on the rows.

        Raises
        ------
        DataError
            There is no row, no number proves the decimal mark, or the time has no unit and steps so long
            that they may be milliseconds.
        """
        if not len(self):
            raise DataError(
                f"{self.head.path.name}: the header in row {self.head.line} is followed by no sample"
            )
        if self._doubtful is not None and not self._proved:
            _, cell, line = self._doubtful
            bare, as_fraction = cell.replace(self._decimal, ""), cell.replace(",", ".")
            raise self.fail(
                line,
                f"'{cell}' may be {as_fraction} or {bare}, and no number of the file decides it; save it"
                " with decimal points, and with commas between the cells",
            )
        self.notes += [note for note in (self._waiting or ())[2:] if note]
        if self.began is not None:
            self.notes.append(f"time_s is counted from {self.began.isoformat(' ')}")
        if self._repeated:
            of = f"{self._repeated} of {len(self)} rows have the time of the row before"
            self.notes.append(f"{of}, first in row {self._first_repeated}: a coarse clock, or rows twice")
        for name, runs in self.runs.items():
            for k, (row, text) in enumerate(runs):
                text = text.strip()
                try:
                    runs[k] = row, self._declared_value(name, text) if text else None
                except ValueError as error:
                    raise self.fail(self.lines[row], f"column '{name}': '{text}' {error}") from None
        for name, (_, numbers) in self._numbers.items():
            rows = np.frombuffer(numbers)
            self.series[name] = rows.reshape(len(self), -1) if name in ("accel", "gyro") else rows
        column, time_s = self.head.columns["time_s"], self.series["time_s"][: 1 << 16]
        step = float(np.median(np.diff(time_s))) if len(self) > 1 else 0.0
        if step >= _SLOWEST_S and not (self.began or column.plain or column.unit):
            raise self.fail(
                self.head.line,
                f"column '{column.text}' states no unit and its rows are {step:g} apart: call it time_s or "
                f"time_ms, or say --columns time_ms={column.text}",
            )


def _cut_note(number: int) -> str:
    return f"row {number} is the last one and was cut short: it was ignored"


MOST_DWELLS = MOST_POSITIONS
"""Largest number of positions in a file, as in a plan: the memory of a fit grows with their square."""


def read_samples_csv(path: str | Path, overrides: Overrides | None = None) -> Session:
    """Read a samples CSV and return its session.

    Messages name rows by the line number in the file, counted from 1 with comment lines. `Session.notes`
    lists the parts that were left out and the columns with other names.

    Raises
    ------
    DataError
        One line with file and row: not text, damaged gzip, empty, unknown value of a key, missing column,
        unknown unit, text in place of a number, ambiguous numbers, NaN or infinity, decreasing time, a
        position with rows that are not contiguous, an angle, approach or use that changes within a dwell.
    UsageError
        `overrides` names a column that does not exist.
    """
    path, overrides = Path(path), overrides or Overrides()
    table = SamplesTable(path, overrides.columns)
    settings = table.head.settings(unit_given=overrides.accel_unit is not None)
    if table.began is not None:
        # A time without a zone is taken as UTC.
        utc = table.began.replace(tzinfo=table.began.tzinfo or UTC).astimezone(UTC)
        ended = utc + timedelta(seconds=float(table.series["time_s"][-1]))
        instants = {"started_utc": utc.isoformat(), "ended_utc": ended.isoformat()}
        settings["facts"] = settings.get("facts", {}) | instants
    if settings.get("plane") == "none" and table.series["accel"].shape[1] < 3:
        raise DataError(f"{path.name}: column 'az' is missing; plane 'none' needs ax, ay and az")
    recording: Dwell | None = _dwell(table, 0, slice(0, len(table)))
    free, notes = False, list[str]()
    by_position = "position" in table.runs
    if by_position:
        numbers, slices = _dwells_by_position(table)
        if sum(rows.stop - rows.start for rows in slices) == len(table):
            recording = None
    else:
        assert recording is not None
        slices, notes, free = _dwells_by_stillness(path.name, recording, table.head.keys.get("filter_m", 0))
        numbers = list(range(len(slices)))
    declared, remarks = _declared(table, slices, free=free)
    dwells = tuple(
        _dwell(table, number, rows, **values)
        for number, rows, values in zip(numbers, slices, declared, strict=True)
    )
    session = Session(
        dwells=dwells,
        source=str(path),
        notes=(*table.notes, *notes, *remarks),
        cut_by_stillness=not by_position,
        recording=recording,
        free_turn=free,
        **settings,
    )
    session = _with_plane(overrides.apply(session), stated="plane" in settings)
    if session.sensor == "generic" and session.accel_unit == "lsb":
        raise DataError(
            f"{path.name}: accel_unit 'lsb' needs a sensor with a known LSB; for a generic one add a "
            "line '# accel_unit: mg' (or g, mps2, counts), or give --unit"
        )
    return session


_OUT_OF_PLANE = 0.25
"""Least change of Z between dwells, relative to gravity, that no turn in the plane of X and Y explains."""


def _with_plane(session: Session, *, stated: bool) -> Session:
    """Return the session, as poses in space if Z changes between its dwells like X and Y.

    A session with declared angles, and a file that states its plane (`stated`), keep the plane and get a
    note instead.
    """
    means = np.array([dwell.accel.mean(axis=0) for dwell in session.dwells if len(dwell)])
    if session.plane == "none" or means.ndim < 2 or means.shape[1] < 3:
        return session
    x, y, z = np.ptp(means, axis=0)
    # Counts have an unknown zero, so that the length of their mean is not gravity.
    gravity = 0.0 if session.accel_unit == "counts" else np.median(np.linalg.norm(means, axis=1))
    if z <= max(x, y) / 2 or z <= _OUT_OF_PLANE * gravity:
        return session
    if stated or any(dwell.angle_deg is not None for dwell in session.dwells):
        note = "az changes between dwells: for poses in space, write '# plane: none' and no angle_deg"
        return replace(session, notes=(*session.notes, note))
    note = "poses in space (plane none): az changes between dwells, and no angle or plane is stated"
    return replace(session, plane="none", notes=(*session.notes, note))


# -- dwells ---------------------------------------------------------------------------------------


def _dwell(table: SamplesTable, number: int, rows: slice, **declared: Any) -> Dwell:
    """Return the dwell `number` of some rows of the table; its arrays are views, not copies.

    `declared` has other fields of the `Dwell`, such as its angle.
    """
    return Dwell(number, **declared | {name: values[rows] for name, values in table.series.items()})


def _dwells_by_stillness(file: str, recording: Dwell, filter_m: int) -> tuple[list[slice], list[str], bool]:
    """Find the dwells of a continuous recording: their rows, remarks, and True if it is a free turn.

    `file` is the file's name for messages, `filter_m` the exponent of the chip's filter (0 if unknown).
    """
    try:
        slices, notes = segment_with_notes(recording.time_s, recording.accel, recording.gyro, filter_m)
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    free = shows_a_free_turn(recording, slices)
    if not slices and not free:
        raise DataError(
            f"{file}: no dwell found: {'; '.join(notes) or 'the sensor never rests'}; "
            "add a column 'position' or let the part rest longer in each position"
        )
    if free:
        notes.append("one continuous turn without declared angles: taken as a free turn")
    return slices, notes, free


def _dwells_by_position(table: SamplesTable) -> tuple[list[int], list[slice]]:
    """Return number and rows of each dwell; rows without a position lie between two dwells."""
    slices: dict[int, slice] = {}
    latest: int | None = None
    runs = table.runs["position"]
    ends = [*(row for row, _ in runs[1:]), len(table)]
    for (row, number), end in zip(runs, ends, strict=True):
        if number is None:
            continue
        if number == latest and slices[number].stop == row:
            slices[number] = slice(slices[number].start, end)
            continue
        if number in slices:
            raise table.fail(
                table.lines[row],
                f"position {number} occurs again after another one (first in row "
                f"{table.lines[slices[number].start]}); "
                "the rows of a dwell must be contiguous: give a second visit a number of its own",
            )
        if len(slices) == MOST_DWELLS:
            raise table.fail(
                table.lines[row], f"more than {counted(MOST_DWELLS, 'position')}: divide the file"
            )
        latest, slices[number] = number, slice(row, end)
    if not slices:
        raise table.fail(
            table.lines[0], "column 'position' is empty: number the dwells, or remove the column"
        )
    return list(slices), list(slices.values())


_DECLARED: dict[str, Any] = {"angle_deg": None, "approach": 0, "use": "fit", "turned_deg": None}
"""Columns, apart from `position`, with one value for each dwell, and the value that an empty cell means."""


def _declared(
    table: SamplesTable, slices: Sequence[slice], *, free: bool
) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the declared values of each dwell by column, and remarks on the columns.

    Cells of a dwell may be empty if another cell of the dwell has the value. If all of them are empty, the
    last value between this dwell and the dwell before is used: a dwell that is found by stillness begins
    some rows after the row with the noted angle. `slices` are the rows of the dwells; `free` is True if the
    file is a free turn, which has no declared values.
    """
    declared: list[dict[str, Any]] = [dict(_DECLARED) for _ in slices]
    given, unused, taken, filled, lost = (list[str]() for _ in range(5))
    edges = [0, *(rows.stop for rows in slices)]
    ends = [*(rows.start for rows in slices), len(table)]
    for name in (name for name in _DECLARED if name in table.runs):
        given += [name] if _stated(table, name, slice(0, len(table))) else []
        inside = [_stated(table, name, rows) for rows in slices]
        gaps = [_stated(table, name, slice(a, b)) for a, b in zip(edges, ends, strict=True)]
        # If values were noted on the last row of each dwell, they would all go to the next dwell.
        before = bool(gaps[0]) or not gaps[-1] or not slices or bool(inside[0])
        count = 0
        for k, (rows, stated) in enumerate(zip(slices, inside, strict=True)):
            if not stated and before:
                stated = gaps[k][-1:]
                count += bool(stated)
            elif stated and name not in filled and len(stated) < len(table.values(name, rows)):
                filled.append(name)
            if stated:
                declared[k][name] = _one_value(table, name, stated)
        if count:
            taken.append(f"{name} in {count} of {counted(len(slices), 'dwell')}")
            spare = sum(len(gap) - 1 for gap in gaps[:-1] if gap) + len(gaps[-1])
            where = f"{name}: {counted(spare, 'value')} given where no dwell was found"
            lost += [where] if spare else []
        elif any(gaps) and not any(inside):
            unused.append(name)
    if free:
        taken, lost, unused = [], [], given
    notes = []
    if unused:
        why = "a free turn has no dwells" if free else "no dwell belongs to its values"
        names = ", ".join(unused)
        notes.append(f"not used: {names}: {why}; add a column 'position', or fill in every row")
    notes += [f"given once a dwell, filled down: {', '.join(taken)}"] if taken else []
    notes += (
        [f"empty cells have the value of the dwell's other rows: {', '.join(filled)}"] if filled else []
    )
    return declared, notes + lost


def _stated(table: SamplesTable, name: str, rows: slice) -> Runs:
    """Return the values of a column within some rows without the empty ones."""
    return [run for run in table.values(name, rows) if run[1] is not None]


def _one_value(table: SamplesTable, name: str, stated: Runs) -> Any:
    """Return the value that a dwell states in all of its rows; raise `DataError` if they differ."""
    value = stated[0][1]
    for row, other in stated:
        if other != value:
            change = f"changes within a dwell from {value} to {other}"
            raise table.fail(table.lines[row], f"{name} {change}; a new setting is a new position")
    return value
