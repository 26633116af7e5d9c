"""The head of a samples file: text encoding, number format, keys, and the meaning of each column.

Text is UTF-8, with or without a byte order mark, or UTF-16, as Excel's "Unicode text" has it. A byte that
is no UTF-8 is read as Windows-1252, in which older programs write the degree sign and the superscript two;
digits are the same in both encodings.

The delimiter between cells is the one with which most names of the header are known.
"""

from __future__ import annotations

import codecs
import csv
import difflib
import gzip
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, checked_gravity_mps2
from adis_gonio.record.samples_columns import (
    AXES,
    COLUMNS,
    GYROS,
    KEYS,
    CsvColumn,
    recognise_column,
    split_unit,
    with_formulas,
)

CHUNK = 1 << 20
"""Bytes that are read at a time; their text takes some twenty times as much memory."""

_FOREIGN = {
    b"PK\x03\x04": "an Excel or LibreOffice workbook (or a zip): save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook: save the sheet as CSV",
    b"PAR1": "a Parquet file: write it as CSV",
    b"\x89HDF": "an HDF5 file: write it as CSV",
    b"%PDF": "a PDF file: take the file that it was printed from",
}
_HTML = re.compile(
    rb"(?>\xef\xbb\xbf|\s|<!--.*?-->|<\?xml.*?\?>)*+<(?:!doctype\s+html|html|head|body)\b",
    re.IGNORECASE | re.DOTALL,
)
"""Pattern of the first tag of an HTML page, after comments and an XML declaration."""
LONGEST_LINE = 1 << 19
"""Largest number of characters in a line; rows have hundreds, a stage's certificate may have 10⁵.

A file without line ends would fill the memory.
"""
MOST_GROWTH, SMALL = 200, 1 << 24
"""Limits of unpacking a gzip file: bytes for each byte of the file, and bytes that are always allowed.

Samples pack to a tenth or a thirtieth of their size, equal rows to a thousandth.
"""
_REPLACEMENT = "�"


def _as_windows_1252(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError):
        raise error
    return error.object[error.start : error.end].decode("cp1252", errors="replace"), error.end


codecs.register_error("adis_gonio.windows-1252", _as_windows_1252)


class Chunk(NamedTuple):
    """Consecutive lines of a file.

    Attributes
    ----------
    first : int
        Number of the first line, counted from 1.
    lines : list of str
        Lines without line ends.
    share : float
        Share of the file that has been read, 0 to 1.
    cut : bool
        True if the last line is the last one of the file and has no line end.
    """

    first: int
    lines: list[str]
    share: float
    cut: bool


def read_chunks(path: Path, after: int = 0) -> Iterator[Chunk]:
    """Read the lines of a file and yield them chunk by chunk, without the first `after` lines.

    Raises
    ------
    DataError
        The file is not readable, empty, binary or of another kind, or its gzip data is damaged.
    """
    first, carry = 1, ""
    for text, share, last in _texts(path):
        text = carry + text
        # A carriage return at the end may be the first half of a line end.
        held = "" if last else "\r" * (len(text) - len(text.rstrip("\r")))
        # A program that translates line ends twice writes two carriage returns.
        plain = text[: len(text) - len(held)].replace("\r\r\n", "\n").replace("\r\n", "\n")
        *lines, carry = plain.replace("\r", "\n").split("\n")
        lengths = [len(line) for line in (*lines, carry)]
        if max(lengths) > LONGEST_LINE:
            row = first + next(k for k, length in enumerate(lengths) if length > LONGEST_LINE)
            raise DataError(
                f"{path.name}, row {row}: has more than {LONGEST_LINE} characters; not a samples CSV"
            )
        cut = last and carry != ""
        lines += [carry] if cut else []
        carry += held
        skip = max(after + 1 - first, 0)
        if lines[skip:]:
            yield Chunk(first + skip, lines[skip:], share, cut)
        first += len(lines)


def _texts(path: Path) -> Iterator[tuple[str, float, bool]]:
    """Yield the text of a file in parts, each with the share read so far, and True for the last part."""
    blank, unpacked = True, 0
    try:
        with path.open("rb") as raw:
            size = max(path.stat().st_size, 1)
            zipped = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            file = cast("IO[bytes]", gzip.GzipFile(fileobj=raw)) if zipped else raw
            data = file.read(CHUNK)
            kinds = [kind for magic, kind in _FOREIGN.items() if data.startswith(magic)]
            if _HTML.match(data):
                kinds = ["an HTML page; download the file itself, not the page that shows it"]
            if kinds:
                raise _no_samples(path, f"it is {kinds[0]}")
            decoder = codecs.getincrementaldecoder(_encoding(data))("adis_gonio.windows-1252")
            while data:
                unpacked += len(data)
                if unpacked > MOST_GROWTH * raw.tell() + SMALL:
                    raise _no_samples(
                        path,
                        f"it unpacks to more than {MOST_GROWTH} times its size, as equal rows do; unpack "
                        "it first if these are samples",
                    )
                text = decoder.decode(data)
                if "\x00" in text or _REPLACEMENT in text:
                    raise _no_samples(
                        path,
                        "it has binary data; give a .csv, a .csv.gz or a file written by calibrate or "
                        "simulate",
                    )
                blank = blank and not text.strip()
                yield text, min(raw.tell() / size, 1.0), False
                data = file.read(CHUNK)
            yield decoder.decode(b"", final=True), 1.0, True
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise DataError(f"{path.name}: damaged or truncated gzip file ({error}); copy it again") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if blank:
        raise DataError(f"{path.name}: the file is empty")


def _no_samples(path: Path, why: str) -> DataError:
    return DataError(f"{path.name}: not a samples CSV: {why}")


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    # ASCII as UTF-16 without a mark: every second byte is zero.
    for place, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(head) >= 4 and not any(head[place:200:2]) and all(head[1 - place : 200 : 2]):
            return name
    return "utf-8-sig"


# -- cells and numbers ----------------------------------------------------------------------------

SPACE = " "
"""Delimiter that means any run of white space."""
DELIMITERS = {"\t": "tab", ";": "semicolon", ",": "comma", SPACE: "space"}
"""Delimiters that are recognised, with their names for messages."""

_TOKENS = re.compile(r"\s+(?![\[(])")


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into its cells, without quotation marks.

    Raises
    ------
    ValueError
        A quotation mark is not closed.
    """
    if '"' not in line:
        return line.split(None if delimiter == SPACE else delimiter)
    if delimiter == SPACE:
        line = " ".join(line.split())
    try:
        return next(csv.reader([line], delimiter=delimiter, strict=True, skipinitialspace=True))
    except (csv.Error, StopIteration):
        raise ValueError("a quotation mark does not end, or is within a cell") from None


def header_cells(line: str, delimiter: str) -> list[str]:
    """Split a header line into cells; if spaces separate cells, a unit in brackets stays with its name."""
    if delimiter == SPACE and '"' not in line:
        return _TOKENS.split(line.strip())
    try:
        cells = [cell.strip() for cell in split_cells(line, delimiter)]
    except ValueError:
        cells = [cell.strip().strip('"') for cell in line.split(delimiter)]
    while cells and not cells[-1]:
        cells.pop()
    return cells


_SEPARATORS = ("\t", ";", ",", "|", ":", "^", "~")
"""Delimiters that a first line `sep=…`, which Excel writes, may state."""
_EXPECTED = "time_s,position,angle_deg,ax,ay"
MOST_HEAD_LINES = 10_000
MOST_HEAD_CHARACTERS = 10_000_000
"""Largest numbers of lines and of characters above the first row."""
MOST_COLUMNS = 1000
_PREAMBLE_LINES = 200
"""Number of lines in which a header is searched; a logger may print other text when it starts."""

Lines = list[tuple[int, str]]
"""Lines with their numbers in the file."""


@dataclass(frozen=True)
class Head:
    """Contents of a file above its rows: keys, header, delimiter and remarks.

    Attributes
    ----------
    path : Path
        Path of the file.
    line : int
        Number of the last line of the head, from 1; the rows follow.
    width : int
        Number of cells in the header.
    delimiter : str
        One of `DELIMITERS`, or a delimiter that the file states.
    columns : dict of str to CsvColumn
        Columns to read, by the format's names.
    keys : dict of str to object
        Values of the lines `# key: value`, by key.
    notes : tuple of str
        Remarks on the leading lines and the header.
    """

    path: Path
    line: int
    width: int
    delimiter: str
    columns: dict[str, CsvColumn]
    keys: dict[str, Any]
    notes: tuple[str, ...]

    def settings(self, *, unit_given: bool) -> dict[str, Any]:
        """Return the fields of a `Session` that the head states by its keys and by units in its header.

        `unit_given` is True if the user has given the unit of the accelerations.

        Raises
        ------
        DataError
            Header and key state different units, and the user has not given the unit.
        """
        values = {name: value for name, value in self.keys.items() if name != "filter_m"}
        if "filter_m" in self.keys:
            values["facts"] = {"configuration": {"filter_m": self.keys["filter_m"]}}
        for key, axes, table in (("accel_unit", AXES, "accelerations"), ("gyro_unit", GYROS, "rates")):
            unit = next((c.unit for c in self.columns.values() if c.name in axes), "")
            if not unit:
                continue
            if values.get(key, unit) != unit and not (key == "accel_unit" and unit_given):
                raise DataError(
                    f"{self.path.name}, row {self.line}: the header says {table} in {unit}, the line "
                    f"'# {key}: {values[key]}' states another unit; remove one of them"
                )
            values.setdefault(key, unit)
        return values


def read_head(path: Path, wanted: Mapping[str, str]) -> Head:
    """Read the part of a samples file above its rows.

    The header is the first line without `#` that names a time and two accelerations, or a column that the
    user assigned. It is searched only in the first lines: a logger prints text when it starts, and a log
    may begin in the middle of a row. If there is none, the first line is taken, so that the error shows it.

    Parameters
    ----------
    path : Path
        File to read.
    wanted : mapping of str to str
        Column of the format → column of the header, as the user assigned them.

    Raises
    ------
    DataError
        The header is missing, or a column is missing, occurs twice or has an unknown unit.
    UsageError
        `wanted` names a column that does not exist.
    """
    row, delimiter, cells, comments, skipped = _find_header(path, wanted)
    if not row or not cells:
        raise DataError(f"{path.name}: no header row; expected one like '{_EXPECTED}'")
    if len(cells) > MOST_COLUMNS:
        raise DataError(f"{path.name}, row {row}: a header of {len(cells)} columns; not a samples CSV")
    columns, notes = _Assignment(path, row, cells).columns(wanted)
    if skipped:
        shown = ", ".join(f"'{other[:40].strip()}'" for _, other in skipped[:3])
        more = ", …" if len(skipped) > 3 else ""
        notes.append(f"rows before the header in row {row} were skipped: {shown}{more}")
    keys, remarks = _read_keys(path.name, comments, delimiter, len(cells))
    return Head(path, row, len(cells), delimiter, columns, keys, (*remarks, *notes))


_NUMBERS = re.compile(r"[\s\d.,;:+\-/eETZ\"]+")
"""Pattern of a line that has only numbers and times of the wall clock."""


def _find_header(path: Path, wanted: Mapping[str, str]) -> tuple[int, str, list[str], Lines, Lines]:
    """Find the header of a file; return its line number, delimiter and cells, and the lines above it.

    The lines above it are in two lists, comment lines and other lines. If the file has no line, the number
    is 0 and there are no cells. `wanted` maps a column of the format to a column of the header, as the user
    assigned them.
    """
    separator: str | None = None
    comments: Lines = []
    others: Lines = []
    for number, line in _first_lines(path):
        bare = line.strip()
        if bare.lower().startswith("sep="):
            separator = line[4:5] if line[4:5] in _SEPARATORS else None
        elif bare.startswith(("#", '"#')):
            comments.append((number, bare))
        elif bare.strip(';,\t" '):
            delimiter, cells = _split(line, separator, wanted)
            named = {found[0] for found in map(recognise_column, cells) if found}
            assigned = any(_is_called(cell, text.strip()) for cell in cells for text in wanted.values())
            if assigned or {"time_s", "ax", "ay"} <= named:
                return number, delimiter, cells, comments, others
            others.append((number, line))
        if others and number >= others[0][0] + _PREAMBLE_LINES:
            break
    # Text above the first row of numbers is the header; prose may be above it.
    texts = list(takewhile(lambda other: not _NUMBERS.fullmatch(other[1]), others))
    header = len(texts) - 1 if 0 < len(texts) < len(others) else 0
    row, line = others[header] if others else (0, "")
    comments = [comment for comment in comments if not row or comment[0] < row]
    delimiter, cells = _split(line, separator, wanted)
    if comments and not wanted and not any(map(recognise_column, cells)):
        # A header behind a comment sign, as numpy.savetxt writes it.
        found = _split(comments[-1][1].lstrip("# "), separator, wanted)
        if sum(recognise_column(cell) is not None for cell in found[1]) > 1:
            return comments[-1][0], *found, comments[:-1], []
    return row, delimiter, cells, comments, others[:header]


def _first_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a file with their numbers; raise `DataError` after as many as a head may have."""
    characters = 0
    for chunk in read_chunks(path):
        for number, line in enumerate(chunk.lines, chunk.first):
            characters += len(line.strip())
            if number > MOST_HEAD_LINES or characters > MOST_HEAD_CHARACTERS:
                raise DataError(
                    f"{path.name}: no header within {MOST_HEAD_LINES} lines and {MOST_HEAD_CHARACTERS} "
                    f"characters; expected one like '{_EXPECTED}'"
                )
            yield number, line


def _split(line: str, separator: str | None, wanted: Mapping[str, str]) -> tuple[str, list[str]]:
    """Split a header by the delimiter that gives the most known names; return the delimiter and the cells.

    `separator` is a delimiter that the file states, which is then used, or None. `wanted` maps a column of
    the format to a column of the header, as the user assigned them.
    """
    if separator is not None:
        return separator, header_cells(line, separator)
    named = {text.strip().lower() for text in wanted.values()}

    def quality(split: tuple[str, list[str]]) -> tuple[int, int]:
        delimiter, cells = split
        known = sum((recognise_column(cell) is not None) + (cell.lower() in named) for cell in cells)
        return known, len(cells) if delimiter != SPACE else 0

    return max(((delimiter, header_cells(line, delimiter)) for delimiter in DELIMITERS), key=quality)


def _read_keys(file: str, lines: Lines, delimiter: str, columns: int) -> tuple[dict[str, Any], list[str]]:
    """Return the values of the lines `# key: value`, and remarks on them.

    A spreadsheet writes these lines like rows, with the file's delimiter and as many columns as the header
    (`columns`).

    Raises
    ------
    DataError
        A key occurs twice or has an unknown value.
    """
    values: dict[str, Any] = {}
    notes: list[str] = []
    for number, line in lines:
        name, colon, text = _comment_text(line, delimiter, columns).partition(":")
        name, text = name.strip().lower(), with_formulas(text.strip())
        if not colon:
            continue
        if name == "note":
            notes.append(text)
        elif name not in KEYS:
            notes.append(f"key '{name}' in row {number} is not known and was ignored")
        elif name in values:
            raise DataError(f"{file}, row {number}: key '{name}' occurs twice")
        elif text:
            try:
                values[name] = KEYS[name].read(text)
            except ValueError as error:
                reason = str(error)
                if not reason.startswith("expected"):
                    reason = "expected a number, with a decimal point"
                raise DataError(f"{file}, row {number}: {name} '{text}' is not known: {reason}") from error
    try:
        checked_gravity_mps2(values.get("gravity_mps2", STANDARD_GRAVITY_MPS2))
    except UsageError as error:
        notes.append(f"gravity_mps2 is used as stated, but {str(error).split(';')[0]}")
    return values, notes


def _comment_text(line: str, delimiter: str, columns: int) -> str:
    """Return a comment line without `#` and without quotes and delimiters that a spreadsheet added.

    `columns` is the number of cells of the header.
    """
    if line.startswith('"'):
        try:
            line = split_cells(line, delimiter)[0]
        except (ValueError, IndexError):
            line = line.strip('"')
    elif delimiter != SPACE and (line.endswith(2 * delimiter) or line.count(delimiter) == columns - 1):
        line = line.rstrip(delimiter)
    return line.lstrip("#")


_LONGEST_NAME = 40
"""Largest number of characters in the name of a column; longer text is a sentence."""


@dataclass(frozen=True)
class _Assignment:
    """Assigns the cells of a header to the columns of the format.

    Attributes
    ----------
    path : Path
        Path of the file, for messages.
    line : int
        Line number of the header.
    cells : list of str
        Texts of the header's cells.
    """

    path: Path
    line: int
    cells: list[str]

    def _fail(self, message: str) -> DataError:
        return DataError(f"{self.path.name}, row {self.line}: {message}")

    def columns(self, wanted: Mapping[str, str]) -> tuple[dict[str, CsvColumn], list[str]]:
        """Return the columns by the format's names, and remarks.

        `wanted` maps a column of the format to a column of the header, as the user assigned them.
        """
        assigned = dict(self._named_column(name, called) for name, called in wanted.items())
        found = assigned | self._by_name(assigned)
        chosen, notes = self._with_units(found)
        self._refuse_missing(chosen)
        gyros = [name for name in GYROS if name in chosen]
        if gyros and len(gyros) < 3:
            missing = next(name for name in GYROS if name not in chosen)
            if any(chosen[name].plain for name in gyros):
                raise self._fail(f"column '{missing}' is missing, but there is '{gyros[0]}'")
            notes.append(f"rates about {', '.join(gyros)} alone were ignored: '{missing}' is missing")
            chosen = {name: column for name, column in chosen.items() if name not in GYROS}
        renamed = [f"{c.name} from '{c.text}'" for c in chosen.values() if c.text.strip().lower() != c.name]
        read_as = [f"columns were read as: {', '.join(renamed)}"] if renamed else []
        return chosen, [*self._ignored(found), *read_as, *notes]

    def _named_column(self, name: str, called: str) -> tuple[str, CsvColumn]:
        """Return the column `name` of the format, read from the file's column that is called `called`."""
        known = recognise_column(name)
        if known is None:
            raise UsageError(f"columns: '{name}' is no column of the format; known: {', '.join(COLUMNS)}")
        there = [k for k, cell in enumerate(self.cells) if cell == called] or [
            k for k, cell in enumerate(self.cells) if _is_called(cell, called)
        ]
        if len(there) != 1:
            what = "no column is called" if not there else "several columns are called"
            shown = ", ".join(f"'{cell}'" for cell in self.cells)
            raise UsageError(f"columns: {what} '{called}' in {self.path.name}; there are {shown}")
        cell = self.cells[there[0]]
        own = recognise_column(cell)
        # The name of another axis also states a unit: the user may exchange axes.
        stated = own[1] if own and own[1] in COLUMNS[known[0]].units else split_unit(cell)[1]
        unit = known[1] or stated
        return known[0], CsvColumn(known[0], there[0], cell, unit, plain=name.endswith("_s"))

    def _by_name(self, assigned: Mapping[str, CsvColumn]) -> dict[str, CsvColumn]:
        """Return the columns that the header names itself, without the columns that the user assigned."""
        taken = {column.place for column in assigned.values()}
        found: dict[str, CsvColumn] = {}
        for k, cell in enumerate(self.cells):
            known = None if k in taken else recognise_column(cell)
            if known is None or known[0] in assigned:
                continue
            column = CsvColumn(known[0], k, cell, known[1], known[2])
            other = found.get(column.name)
            if other is not None and other.plain == column.plain:
                if column.plain:
                    raise self._fail(f"column '{cell}' occurs twice")
                raise self._fail(
                    f"both '{other.text}' and '{cell}' may be {column.name}; say which: "
                    f"--columns '{column.name}={cell}'"
                )
            if other is None or column.plain:
                found[column.name] = column
        return found

    def _with_units(self, found: Mapping[str, CsvColumn]) -> tuple[dict[str, CsvColumn], list[str]]:
        """Return the columns with standard spellings of their units, and remarks.

        `found` has the columns by the format's names. Optional columns of unknown unit are left out; an
        unknown unit of time or acceleration is an error.
        """
        chosen: dict[str, CsvColumn] = {}
        notes = []
        for name, column in found.items():
            known_unit = COLUMNS[name].unit(column.unit)
            known = ", ".join(COLUMNS[name].units)
            if known_unit is not None:
                chosen[name] = replace(column, unit=known_unit[0], scale=known_unit[1])
            elif name in ("time_s", *AXES):
                raise self._fail(
                    f"unit '{column.unit}' of column '{column.text}' is not known; known are {known}: "
                    "convert, or name the column without it"
                )
            else:
                why = f"its unit is not one of {known}" if known else f"{name} has no unit"
                notes.append(f"column '{column.text}' was ignored: {why}")
        for axes in (AXES, GYROS):
            alike = [column for name, column in chosen.items() if name in axes]
            if len({column.unit for column in alike}) > 1:
                listed = ", ".join(f"'{column.text}'" for column in alike)
                raise self._fail(f"columns {listed} do not have one unit; convert them to the same one")
        return chosen, notes

    def _refuse_missing(self, chosen: Mapping[str, CsvColumn]) -> None:
        missing = [name for name in ("time_s", "ax", "ay") if name not in chosen]
        if not missing:
            return
        if set(GYROS) <= set(chosen) and not set(AXES) & set(chosen):
            raise self._fail(
                "gyros without accelerometers: a fit of the gyros needs ax, ay and az too, for the vertical"
                " and the g-sensitivity; add these columns"
            )
        spare = [cell for cell in self.cells if cell and recognise_column(cell) is None]
        if not chosen and spare and all(map(_NUMBERS.fullmatch, spare)):
            raise self._fail(
                f"no header row: the first row has numbers; put a row such as '{_EXPECTED}' above it"
            )
        what = f"column '{missing[0]}' is missing"
        if not chosen:
            what = f"not a samples CSV: no known column in the header; expected {_EXPECTED}"
        shown = ", ".join(f"'{cell[:_LONGEST_NAME]}'" for cell in spare[:12])
        what += f"; not known are {shown}" if spare else ""
        names = [cell for cell in spare if len(cell) <= _LONGEST_NAME]
        if len(names) < len(missing):  # nothing, or prose
            raise self._fail(what)
        likely = [_likely_column(name, names) for name in missing]
        pairs = zip(missing, names if None in likely else likely, strict=False)
        example = ",".join(f"{name.removesuffix('_s')}={cell}" for name, cell in pairs)
        raise self._fail(f"{what}: say which are which, such as --columns '{example}'")

    def _ignored(self, found: Mapping[str, CsvColumn]) -> list[str]:
        taken = {column.place for column in found.values()}
        left = [cell or f"column {k + 1}" for k, cell in enumerate(self.cells) if k not in taken]
        notes = [f"columns that were ignored: {', '.join(left)}"] if left else []
        for cell in left:
            near = difflib.get_close_matches(cell.lower(), set(COLUMNS) - set(found), n=1, cutoff=0.8)
            notes += [f"is the ignored column '{cell}' meant to be {near[0]}?"] if near else []
        return notes


def _likely_column(name: str, spare: Sequence[str]) -> str | None:
    """Return the cell among `spare` that the user may have meant for the column `name`; None if none is."""
    for cell in spare:
        text = split_unit(cell)[0].lower()
        if text.endswith(name[1]) if name in AXES else text.startswith(("t", "z")):
            return cell
    return None


def _is_called(cell: str, name: str) -> bool:
    return name.lower() in (cell.lower(), split_unit(cell)[0].lower())
