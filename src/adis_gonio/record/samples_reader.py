"""The samples CSV as a session: its rows as arrays, chunk by chunk, and the dwells in them.

A chunk is converted in bulk. Only if that fails are its rows read one by one: comments, empty rows at the
end and an incomplete last row are left out, and any other irregularity is an error that names the row.
Columns with one value for each dwell are kept as runs of equal text, so that memory is used for little but
the numbers.

A file without the column `position` is one continuous recording: its dwells are found by stillness
(`adis_gonio.record.segmentation`), and `Session.notes` describes them.
"""

from __future__ import annotations

import math
import re
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record import samples_header
from adis_gonio.record.loading import Overrides
from adis_gonio.record.plans import MOST_POSITIONS
from adis_gonio.record.samples_columns import AXES, COLUMNS, GYROS, SAME
from adis_gonio.record.segmentation import segment_with_notes, shows_a_free_turn

_WALL_CLOCK = re.compile(
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d+)?)?\s*(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII
)
"""Pattern of a time in ISO 8601 with its date, as loggers write it, with or without Z or an offset."""
_SLOWEST_S = 2.0
"""Median step of the rows in s from which a time without a unit may be in ms, so that it is refused."""


@dataclass(frozen=True)
class SamplesTable:
    """The rows of a samples file as arrays of numbers, in the units of the format.

    Attributes
    ----------
    head : Head
        Keys, header and remarks of the file.
    dialect : Dialect
        Delimiter and decimal mark of the rows.
    series : dict of str to (n,), (n, 2) or (n, 3) float
        Samples by the fields of a `Dwell`, without fields that the file lacks.
    runs : dict of str to list of (int, str)
        Columns with one value for each dwell: first row and text of each run of equal text.
    lines : list of (int, int)
        Pairs of a row and its line number; the rows up to the next pair follow line by line.
    notes : tuple of str
        Remarks on the head and on rows that were left out.
    """

    head: samples_header.Head
    dialect: samples_header.Dialect
    series: dict[str, Floats]
    runs: dict[str, list[tuple[int, str]]]
    lines: list[tuple[int, int]]
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.series["time_s"])

    @property
    def path(self) -> Path:
        """Path of the file that was read."""
        return self.head.path

    def line_of(self, row: int) -> int:
        """Return the line number in the file, from 1, of a row of the table."""
        at, line = self.lines[bisect_right(self.lines, (row, 1 << 62)) - 1]
        return line + row - at

    def fail(self, row: int, message: str) -> DataError:
        """Return a `DataError` with a message about a row; it names file and line."""
        return DataError(f"{self.path.name}, row {self.line_of(row)}: {message}")

    def number(self, name: str, text: str) -> float:
        """Convert the text of a cell to a number in the format's unit.

        `name` is a column that has one value for each dwell.
        """
        multiply, divide, add = self.head.columns[name].scale
        return self.dialect.number(text) * multiply / divide + add

    def texts(self, name: str, rows: slice) -> Iterator[tuple[int, str]]:
        """Yield the successive texts in a column, within some rows, each with the first row of its run.

        The column is one with a value for each dwell, such as the position.
        """
        runs = self.runs[name]
        at = bisect_right(runs, rows.start, key=lambda run: run[0]) - 1
        while at < len(runs) and runs[at][0] < rows.stop:
            yield max(runs[at][0], rows.start), runs[at][1]
            at += 1


class _Reader:
    """Collects the rows of a samples file in growing arrays.

    `head` has the columns of the file; `dialect` is its delimiter and decimal mark.
    """

    def __init__(self, head: samples_header.Head, dialect: samples_header.Dialect) -> None:
        self.head, self.dialect = head, dialect
        self.place = {name: column.place for name, column in head.columns.items()}
        self.series = [name for name in COLUMNS if name in self.place and not COLUMNS[name].per_dwell]
        fields = {"time_s": ("time_s",), "accel": AXES, "gyro": GYROS}
        fields |= {"temperature_c": ("temp_c",), "supply_v": ("supply_v",)}
        present = {name: [m for m in members if m in self.place] for name, members in fields.items()}
        self.fields = {name: members for name, members in present.items() if members}
        # Arrays that grow at their end without a copy, row after row.
        self.numbers = {name: array("d") for name in self.fields}
        self.runs: dict[str, list[tuple[int, str]]] = {
            name: [] for name in self.place if COLUMNS[name].per_dwell
        }
        self.lines: list[tuple[int, int]] = []
        self.notes: list[str] = []
        self.n, self.latest_s = 0, -math.inf
        self._began: datetime | None = None
        """Time of the first row; None unless the file has times of the wall clock."""
        self._repeated, self._first_repeated = 0, 0
        self._joined = ""
        """Note on marks between thousands; empty if there are none."""
        self._waiting: tuple[int, str, str] | None = None
        """Line allowed only at the end: its number, the error elsewhere, the note at the end; or None."""

    def fail(self, line: int, message: str) -> DataError:
        return DataError(f"{self.head.path.name}, row {line}: {message}")

    def take(self, chunk: samples_header.Chunk) -> None:
        """Add the next chunk of lines: all rows at once if they are regular, else row by row."""
        if self._waiting is None:
            cells = self._regular(chunk)
            if cells is not None:
                try:
                    columns = {name: self._numbers(name, cells[self.place[name]]) for name in self.series}
                except ValueError:
                    pass  # reading row by row names the fault
                else:
                    self._add([(0, chunk.first)], cells, columns)
                    return
        self._walk(chunk)

    def _regular(self, chunk: samples_header.Chunk) -> list[list[str]] | None:
        """Return the cells of a chunk by column if all rows have a simple, equal form; else None.

        Rows with quotes or comments are not simple.
        """
        delimiter, lines = self.dialect.delimiter, chunk.lines
        if delimiter == samples_header.SPACE or not lines or chunk.cut:
            return None
        more = lines[0].count(delimiter)
        if more < self.head.width - 1 or any(line.count(delimiter) != more for line in lines):
            return None
        text = delimiter.join(lines)
        if '"' in text or "#" in text or "−" in text:
            return None
        cells = text.split(delimiter)
        columns = [cells[k :: more + 1] for k in range(more + 1)]
        if any(any(column) for column in columns[self.head.width :]):
            return None
        return columns

    def _numbers(self, name: str, cells: list[str]) -> Floats:
        """Convert the cells of the column `name` to numbers (n,).

        Raises
        ------
        ValueError
            A cell has no plain number.
        """
        if name == "time_s" and (self._began or (not self.n and _WALL_CLOCK.fullmatch(cells[0].strip()))):
            return np.array([self._since_beginning(cell) for cell in cells])
        text = "\n".join(cells)
        if self.dialect.decimal == ",":
            if "." in text:
                raise ValueError
            cells = text.replace(",", ".").split("\n")
        values = np.fromiter(map(float, cells), dtype=np.float64, count=len(cells))
        if "_" in text or not (np.abs(values) <= COLUMNS[name].largest).all():
            raise ValueError
        return values

    def _since_beginning(self, cell: str) -> float:
        """Convert a cell with date and time to s since the time of the first row.

        Raises
        ------
        ValueError
            The cell has no date with a time, or only some rows have an offset from UTC.
        """
        text = cell.strip()
        if not _WALL_CLOCK.fullmatch(text):
            raise ValueError(text)
        at = datetime.fromisoformat(text.replace(" +", "+").replace(" -", "-").replace(" Z", "Z"))
        if self._began is None:
            self._began = at
        if (at.tzinfo is None) != (self._began.tzinfo is None):
            raise ValueError(text)
        return (at - self._began).total_seconds()

    def _walk(self, chunk: samples_header.Chunk) -> None:
        """Add a chunk row by row, which is slow but allows an error to name the wrong cell."""
        kept: list[list[str]] = []
        numbers: list[int] = []
        for number, line in enumerate(chunk.lines, chunk.first):
            if line.startswith(("#", '"#')):
                continue
            cells = self._cells(number, line)
            if cells is not None:
                kept.append(cells)
                numbers.append(number)
        if not kept:
            return
        if chunk.cut and numbers[-1] == chunk.first + len(chunk.lines) - 1 and not self._whole(kept[-1]):
            self.notes.append(_cut_note(numbers.pop()))
            kept.pop()
            if not kept:
                return
        columns = [list(column) for column in zip(*kept, strict=True)]
        values = {
            name: self._numbers_one_by_one(name, columns[self.place[name]], numbers) for name in self.series
        }
        jumps = [k for k, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1]
        self._add([(k, numbers[k]) for k in (0, *jumps)], columns, values)

    def _cells(self, number: int, line: str) -> list[str] | None:
        """Return the cells of a row, as many as the header has; None if the row is incomplete.

        `number` is the line number. An incomplete row is an error, unless it is the last one.
        """
        width = self.head.width
        try:
            cells = self.dialect.cells(line)
        except ValueError as error:
            cells = []
            wrong = (f"{error}", _cut_note(number))
        else:
            there = f"{len(cells)} values where the header has {width}"
            wrong = (there, _cut_note(number))
            if not any(cell.strip() for cell in cells):
                wrong = ("empty row", "")
                cells = []
            elif len(cells) > width and any(cells[width:]):
                raise self.fail(number, there + self._hint(len(cells)))
        if self._waiting is not None and (wrong[1] or cells):
            raise self.fail(self._waiting[0], self._waiting[1])
        if len(cells) < width:
            if self._waiting is None:
                self._waiting = (number, *wrong)
            return None
        return cells[:width]

    def _hint(self, cells: int) -> str:
        if self.dialect.delimiter == "," and cells > self.head.width + 1:
            return "; if its numbers have decimal commas, save the file with semicolons between the cells"
        return f" (cells are separated by {self.dialect.delimiter_in_words}s)"

    def _whole(self, cells: list[str]) -> bool:
        try:
            for name in self.series:
                self._one(name, cells[self.place[name]])
        except ValueError:
            return False
        return True

    def _one(self, name: str, cell: str) -> float:
        value = self.dialect.number(cell)
        if not abs(value) <= COLUMNS[name].largest:
            raise ValueError(cell)
        if not self._joined and ("." if self.dialect.decimal == "," else ",") in cell:
            self._joined = f"marks between thousands were left out, as in '{cell.strip()}' = {value:.12g}"
        return value

    def _numbers_one_by_one(self, name: str, cells: list[str], lines: list[int]) -> Floats:
        try:
            return self._numbers(name, cells)
        except ValueError:
            values = np.empty(len(cells))
        for row, cell in enumerate(cells):
            try:
                clock = name == "time_s" and self._began is not None
                values[row] = self._since_beginning(cell) if clock else self._one(name, cell)
            except ValueError:
                what = self._what(name, cell.strip())
                if name == "time_s" and self._began is not None:
                    what = f"'{cell.strip()}' is not a time like '{self._began.isoformat(' ')}' before it"
                raise self.fail(lines[row], f"column '{name}': {what}") from None
        return values

    def _what(self, name: str, cell: str) -> str:
        """Describe why a cell of the column `name` is not a number that can be used."""
        if not cell:
            return "empty"
        try:
            value = float(cell)
        except ValueError:
            value = 0.0
        if not math.isfinite(value):
            return f"{cell} is not a finite number; leave such rows out"
        if abs(value) > COLUMNS[name].largest:
            return f"{cell} is too large for a measurement; leave such rows out"
        own, other = ("comma", ".") if self.dialect.decimal == "," else ("point", ",")
        try:
            self.dialect.with_decimal(other, proved=True).number(cell)
        except ValueError:
            return f"'{cell}' is not a number"
        return f"'{cell}' is not a number in a file with decimal {own}s"

    def _add(self, lines: list[tuple[int, int]], cells: list[list[str]], values: dict[str, Floats]) -> None:
        """Add rows to the arrays.

        `lines` has pairs of a row (from 0 within these rows) and its line number, `cells` the texts by
        column place, `values` the numbers by column name.
        """
        for row, line in lines:
            if not self.lines or self._next_line(self.n + row) != line:
                self.lines.append((self.n + row, line))
        for name, series in values.items():
            scale = self.head.columns[name].scale
            if scale != SAME and not (name == "time_s" and self._began):
                values[name] = series * scale[0] / scale[1] + scale[2]
        time = values["time_s"]
        self._refuse_backwards(time)
        for name, members in self.fields.items():
            rows = np.column_stack([values[member] for member in members])
            self.numbers[name].frombytes(rows.tobytes())
        for name, runs in self.runs.items():
            column = cells[self.place[name]]
            if not runs or runs[-1][1] != column[0]:
                runs.append((self.n, column[0]))
            runs.extend((self.n + k, b) for k, (a, b) in enumerate(pairwise(column), 1) if a != b)
        self.n += len(time)
        self.latest_s = float(time[-1])

    def _next_line(self, row: int) -> int:
        at, line = self.lines[-1]
        return line + row - at

    def _refuse_backwards(self, time: Floats) -> None:
        before = np.concatenate([[self.latest_s], time[:-1]])
        same = np.flatnonzero(time == before)
        if same.size and not self._repeated:
            self._first_repeated = self._next_line(self.n + int(same[0]))
        self._repeated += same.size
        backwards = np.flatnonzero(time < before)
        if backwards.size:
            k = int(backwards[0])
            row = self.n + k
            raise self.fail(
                self._next_line(row), f"time_s goes back from {before[k]:g} to {time[k]:g}; sort by time"
            )

    def done(self) -> SamplesTable:
        """Return the finished table, after the last chunk."""
        if self._waiting is not None and self._waiting[2]:
            self.notes.append(self._waiting[2])
        if not self.n:
            raise DataError(
                f"{self.head.path.name}: the header in row {self.head.line} is followed by no sample"
            )
        self.notes += [self._joined] if self._joined else []
        if self._began is not None:
            self.notes.append(f"time_s is counted from {self._began.isoformat(' ')}")
        if self._repeated:
            of = f"{self._repeated} of {self.n} rows have the time of the row before"
            self.notes.append(f"{of}, first in row {self._first_repeated}: a coarse clock, or rows twice")
        series = {name: np.frombuffer(numbers) for name, numbers in self.numbers.items()}
        for name in {"accel", "gyro"} & series.keys():
            series[name] = series[name].reshape(self.n, -1)
        table = SamplesTable(
            head=self.head,
            dialect=self.dialect,
            series=series,
            runs=self.runs,
            lines=self.lines,
            notes=(*self.head.notes, *self.notes),
        )
        if self._began is None:
            _refuse_unclear_time(table)
        return table


def read_table(path: Path, wanted: dict[str, str]) -> SamplesTable:
    """Read the rows of a samples CSV.

    `wanted` maps a column of the format to a column of the header, as the user assigned them.

    Raises
    ------
    DataError
        The file is no samples CSV, or a row has a value that cannot be used; see `read_samples_csv`.
    UsageError
        `wanted` names a column that does not exist.
    """
    head = samples_header.read_head(path, wanted)
    reader = _Reader(head, _with_decimal_mark(head))
    tell: Callable[[str], Any] = current().tell
    for chunk in _rows_of(head):
        tell(f"{chunk.share:.0%}")
        reader.take(chunk)
    return reader.done()


def _cut_note(number: int) -> str:
    return f"row {number} is the last one and was cut short: it was ignored"


def _rows_of(head: samples_header.Head) -> Iterator[samples_header.Chunk]:
    """Yield the lines of the file below the header, in chunks."""
    for chunk in samples_header.read_chunks(head.path):
        skip = max(head.line + 1 - chunk.first, 0)
        lines = chunk.lines[skip:] if skip else chunk.lines
        if lines:
            yield samples_header.Chunk(chunk.first + skip, lines, chunk.share, chunk.last, chunk.cut)


def _with_decimal_mark(head: samples_header.Head) -> samples_header.Dialect:
    """Return the file's dialect with the decimal mark that a key states or that some number proves."""
    stated = head.keys.get("decimal")
    if stated is not None:
        return head.dialect.with_decimal(stated, proved=True)
    undecided: tuple[int, str] | None = None
    for chunk in _rows_of(head):
        if head.dialect.delimiter == "," and not any('"' in line for line in chunk.lines):
            if undecided is None:
                return head.dialect.with_decimal(".", proved=False)
            continue
        proof, seen = _proof_in(head, chunk)
        if proof:
            return head.dialect.with_decimal(proof, proved=True)
        undecided = undecided or seen
    if undecided is None:
        return head.dialect.with_decimal(".", proved=False)
    line, cell = undecided
    bare, as_fraction = cell.replace(".", "").replace(",", ""), cell.replace(",", ".")
    raise DataError(
        f"{head.path.name}, row {line}: '{cell}' may be {as_fraction} or {bare}, and no number of the file "
        "decides it; put a line '# decimal: comma' or '# decimal: point' at the top"
    )


def _proof_in(head: samples_header.Head, chunk: samples_header.Chunk) -> tuple[str, tuple[int, str] | None]:
    """Return the decimal mark that a chunk of lines proves (or "") and its first ambiguous number.

    The number is a pair of line number and text; None if no number is ambiguous or the mark is proved.
    """
    places = [column.place for name, column in head.columns.items() if name not in ("approach", "use")]
    undecided: tuple[int, str] | None = None
    for number, line in enumerate(chunk.lines, chunk.first):
        if ("." not in line and "," not in line) or line.startswith(("#", '"#')):
            continue
        try:
            cells = head.dialect.cells(line)
        except ValueError:
            continue
        own = [cells[k].strip() for k in places if k < len(cells)]
        proof = samples_header.find_decimal_mark(own)
        if proof:
            return proof, None
        if undecided is None:
            marked = [
                cell for cell in own if ("." in cell or "," in cell) and not _WALL_CLOCK.fullmatch(cell)
            ]
            undecided = (number, marked[0]) if marked else None
    return "", undecided


def _refuse_unclear_time(table: SamplesTable) -> None:
    """Raise `DataError` if the time has no unit and steps so long that they may be milliseconds."""
    column = table.head.columns["time_s"]
    if column.plain or column.unit or len(table) < 2:
        return
    step = float(np.median(np.diff(table.series["time_s"][: 1 << 16])))
    if step >= _SLOWEST_S:
        raise DataError(
            f"{table.path.name}, row {table.head.line}: column '{column.text}' states no unit and its rows "
            f"are {step:g} apart: call it time_s or time_ms, or say --columns time_ms={column.text}"
        )


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
    table = read_table(path, dict(overrides.columns))
    settings = table.head.settings(unit_told=overrides.accel_unit is not None)
    if settings.get("plane") == "none" and table.series["accel"].shape[1] < 3:
        raise DataError(f"{path.name}: column 'az' is missing; plane 'none' needs ax, ay and az")
    recording: Dwell | None = None
    free, notes = False, list[str]()
    by_position = "position" in table.runs
    if by_position:
        numbers, slices = _dwells_by_position(table)
        if sum(rows.stop - rows.start for rows in slices) < len(table):
            recording = _dwell(table, 0, slice(0, len(table)))
    else:
        recording = _dwell(table, 0, slice(0, len(table)))
        slices, notes, free = _dwells_by_stillness(path.name, recording)
        numbers = list(range(len(slices)))
    remarks = _Remarks(len(slices))
    angle = _per_dwell(table, "angle_deg", slices, _angle, remarks)
    approach = _per_dwell(table, "approach", slices, _approach, remarks)
    use = _per_dwell(table, "use", slices, _use, remarks)
    turned = _per_dwell(table, "turned_deg", slices, partial(_angle, name="turned_deg"), remarks)
    dwells = tuple(
        _dwell(
            table, number, rows,
            angle_deg=angle[k], approach=approach[k] or 0, use=use[k] or "fit", turned_deg=turned[k],
        )
        for k, (number, rows) in enumerate(zip(numbers, slices, strict=True))
    )  # fmt: skip
    session = Session(
        dwells=dwells,
        source=str(path),
        notes=(*table.notes, *notes, *remarks.notes(free=free)),
        cut_by_stillness=not by_position,
        recording=recording,
        free_turn=free,
        **settings,
    )
    session = overrides.apply(session)
    if session.sensor == "generic" and session.accel_unit == "lsb":
        raise DataError(
            f"{path.name}: accel_unit 'lsb' needs a sensor with a known LSB; for a generic one add a "
            "line '# accel_unit: mg' (or g, mps2, counts), or give --unit"
        )
    return session


# -- dwells ---------------------------------------------------------------------------------------


def _dwell(table: SamplesTable, number: int, rows: slice, **declared: Any) -> Dwell:
    """Return the dwell `number` of some rows of the table; its arrays are views, not copies.

    `declared` has other fields of the `Dwell`, such as its angle.
    """
    return Dwell(
        position=number,
        first_row=table.line_of(rows.start),
        **declared | {name: values[rows] for name, values in table.series.items()},
    )


def _dwells_by_stillness(file: str, recording: Dwell) -> tuple[list[slice], list[str], bool]:
    """Find the dwells of a continuous recording: their rows, remarks, and True if it is a free turn.

    `file` is the file's name for messages.
    """
    try:
        slices, notes = segment_with_notes(recording.time_s, recording.accel, recording.gyro)
    except DataError as error:
        raise DataError(f"{file}: {error}") from error
    free = shows_a_free_turn(recording, slices)
    if not slices and not free:
        raise DataError(
            f"{file}: no dwell found: {'; '.join(notes) or 'the sensor never rests'}; "
            "add a column 'position' or record at least one second at rest in each position"
        )
    if free:
        notes.append("one continuous turn without declared angles: taken as a free turn")
    return slices, notes, free


def _dwells_by_position(table: SamplesTable) -> tuple[list[int], list[slice]]:
    """Return number and rows of each dwell; rows without a position lie between two dwells."""
    numbers: list[int] = []
    slices: list[slice] = []
    seen: dict[int, int] = {}
    runs = table.runs["position"]
    ends = [*(row for row, _ in runs[1:]), len(table)]
    for (row, text), end in zip(runs, ends, strict=True):
        if not text.strip():
            continue
        number = _position(table, row, text)
        if numbers and numbers[-1] == number and slices[-1].stop == row:
            slices[-1] = slice(slices[-1].start, end)
            continue
        if number in seen:
            raise table.fail(
                row,
                f"position {number} occurs again after another one (first in row {seen[number]}); "
                "the rows of a dwell must be contiguous: give a second visit a number of its own",
            )
        if len(numbers) == MOST_DWELLS:
            raise table.fail(row, f"more than {counted(MOST_DWELLS, 'position')}: divide the file")
        seen[number] = table.line_of(row)
        numbers.append(number)
        slices.append(slice(row, end))
    if not numbers:
        raise table.fail(0, "column 'position' is empty: number the dwells, or remove the column")
    return numbers, slices


def _position(table: SamplesTable, row: int, text: str) -> int:
    try:
        # A spreadsheet may write an integer as 3.0 or 3,0.
        value = table.number("position", text)
    except ValueError:
        value = math.nan
    if not (value.is_integer() and abs(value) < COLUMNS["position"].largest):
        raise table.fail(row, f"column 'position': '{text.strip()}' is not an integer of at most 9 digits")
    return int(value)


@dataclass
class _Remarks:
    """Remarks on columns that have one value for each dwell.

    Attributes
    ----------
    dwells : int
        Number of dwells.
    given : list of str
        Columns with a value in any row.
    taken : dict of str to int
        Number of dwells with a value that was noted before their first row, by column.
    filled, unused : list of str
        Columns with empty cells within a dwell, and columns without a value in any dwell.
    lost : list of str
        Sentences on values that belong to no dwell.
    """

    dwells: int
    given: list[str] = field(default_factory=list)
    taken: dict[str, int] = field(default_factory=dict)
    filled: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def notes(self, *, free: bool) -> tuple[str, ...]:
        """Return all remarks on the columns, one line each; `free` is True if the file is a free turn."""
        notes = []
        unused = self.given if free else self.unused
        if unused:
            why = "a free turn has no dwells" if free else "no dwell belongs to its values"
            notes.append(
                f"not used: {', '.join(unused)}: {why}; add a column 'position', or fill in every row"
            )
        if self.taken and not free:
            of = ", ".join(
                f"{name} in {n} of {counted(self.dwells, 'dwell')}" for name, n in self.taken.items()
            )
            notes.append(f"given once a dwell, filled down: {of}")
        if self.filled:
            notes.append(f"empty cells have the value of the dwell's other rows: {', '.join(self.filled)}")
        return (*notes, *(() if free else self.lost))


def _per_dwell(
    table: SamplesTable,
    name: str,
    slices: list[slice],
    parse: Callable[[SamplesTable, str], Any],
    remarks: _Remarks,
) -> list[Any]:
    """Return the value of a column for each dwell (`slices` has their rows); None without a value.

    `parse` converts the text of a cell, and `remarks` collects remarks on the column.

    Cells of a dwell may be empty if another cell of the dwell has the value. If all of them are empty, the
    last value between this dwell and the dwell before is used: a dwell that is found by stillness begins
    some rows after the row with the noted angle.
    """
    if name not in table.runs:
        return [None] * len(slices)
    remarks.given += [name] if any(text.strip() for _, text in table.runs[name]) else []
    inside = [_stated(table, name, rows) for rows in slices]
    edges = [0, *(rows.stop for rows in slices)]
    ends = [*(rows.start for rows in slices), len(table)]
    gaps = [_stated(table, name, slice(a, b)) for a, b in zip(edges, ends, strict=True)]
    # If values were noted on the last row of each dwell, they would all go to the next dwell.
    before = bool(gaps[0]) or not gaps[-1] or not slices or bool(inside[0])
    values, taken = [], 0
    last: list[tuple[int, str]] = []
    for k, (rows, texts) in enumerate(zip(slices, inside, strict=True)):
        if not texts and before:
            # Two dwells without a row between them are parts of one dwell that was split at a step.
            texts = gaps[k][-1:] or (last if rows.start == edges[k] else [])
            taken += bool(texts)
            last = texts
        elif texts and any(not text.strip() for _, text in table.texts(name, rows)):
            remarks.filled += [name] if name not in remarks.filled else []
        values.append(_one_value(table, name, texts, parse))
    if taken:
        remarks.taken[name] = taken
        unused = sum(len(gap) - 1 for gap in gaps[:-1] if gap) + len(gaps[-1])
        where = f"{name}: {counted(unused, 'value')} given where no dwell was found"
        remarks.lost += [where] if unused else []
    elif any(gaps) and not any(inside):
        remarks.unused.append(name)
    return values


def _stated(table: SamplesTable, name: str, rows: slice) -> list[tuple[int, str]]:
    """Return the non-empty texts of a column within some rows, each with the first row of its run."""
    if rows.start >= rows.stop:
        return []
    return [(row, text.strip()) for row, text in table.texts(name, rows) if text.strip()]


def _one_value(
    table: SamplesTable, name: str, texts: list[tuple[int, str]], parse: Callable[[SamplesTable, str], Any]
) -> Any:
    """Return the value that all texts of a dwell agree on; None if there are no texts.

    `texts` are pairs of row and text; `parse` converts a text to the value.
    """
    value = None
    for k, (row, text) in enumerate(texts):
        try:
            found = parse(table, text)
        except ValueError as error:
            raise table.fail(row, f"column '{name}': '{text}' {error}") from None
        if k and found != value:
            raise table.fail(
                row,
                f"{name} changes within a dwell from '{texts[0][1]}' to '{text}'; a new setting is a new "
                "position",
            )
        value = found
    return value


def _angle(table: SamplesTable, text: str, name: str = "angle_deg") -> float:
    try:
        value = table.number(name, text)
    except ValueError:
        raise ValueError("is not an angle in degrees") from None
    if not abs(value) <= COLUMNS[name].largest:
        raise ValueError("is no angle of a stage; leave it empty if it is unknown")
    return value


def _approach(_: SamplesTable, text: str) -> int | None:
    signs = {"0": None, "+1": 1, "1": 1, "+1.0": 1, "1.0": 1, "-1": -1, "-1.0": -1}
    try:
        return signs[text.replace(",", ".").replace("−", "-")]
    except KeyError:
        raise ValueError("is neither +1 nor -1") from None


def _use(_: SamplesTable, text: str) -> str:
    if text.lower() not in ("fit", "check"):
        raise ValueError("is neither 'fit' nor 'check'")
    return text.lower()
