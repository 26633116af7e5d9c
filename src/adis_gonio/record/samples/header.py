"""The head of a file: its leading lines, its header row, and which column is which."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.record.samples import names
from adis_gonio.record.samples.dialect import DELIMITERS, IN_WORDS, SPACE, Dialect, header_cells
from adis_gonio.record.samples.keys import Keys, keys_of
from adis_gonio.record.samples.lines import chunks_of
from adis_gonio.record.samples.names import AXES, COLUMNS, GYROS, CsvColumn

_SEPARATORS = ("\t", ";", ",", "|", ":", "^", "~")
"""What Excel's first line `sep=…` may state."""
_EXPECTED = "time_s,position,angle_deg,ax,ay"
MOST_HEAD_LINES = 10_000
MOST_HEAD_CHARACTERS = 10_000_000
"""Before the first row."""
MOST_COLUMNS = 1000
_PREAMBLE_LINES = 200
"""Lines in which a header is looked for, behind what a logger prints when it starts."""


@dataclass(frozen=True)
class Head:
    """What stands before the rows.

    Attributes
    ----------
    path : Path
    line : int
        Number of the last line of the head; rows follow.
    width : int
        Cells of the header.
    dialect : Dialect
        Its decimal mark is still to be decided where `keys` does not state it.
    columns : dict of str to CsvColumn
        Those that are read, by the format's names.
    keys : Keys
    notes : tuple of str
        What has to be said of the header.
    """

    path: Path
    line: int
    width: int
    dialect: Dialect
    columns: dict[str, CsvColumn]
    keys: Keys
    notes: tuple[str, ...]

    def settings(self, *, unit_told: bool) -> dict[str, Any]:
        """Fields of the `Session`; units of the header go with those of the keys.

        Raises
        ------
        DataError
            Header and key state different units, and the user has not told the right one.
        """
        values = {name: value for name, value in self.keys.values.items() if name != "decimal"}
        for key, axes, table in (("accel_unit", AXES, "accelerations"), ("gyro_unit", GYROS, "rates")):
            unit = next((c.unit for c in self.columns.values() if c.name in axes), "")
            if not unit:
                continue
            if values.get(key, unit) != unit and not (key == "accel_unit" and unit_told):
                raise DataError(
                    f"{self.path.name}, row {self.line}: the header says {table} in {unit}, the line "
                    f"'# {key}: {values[key]}' says otherwise; take one of them out"
                )
            values.setdefault(key, unit)
        return values


def head_of(path: Path, wanted: Mapping[str, str]) -> Head:
    """Head of a file.

    Parameters
    ----------
    path : Path
    wanted : mapping of str to str
        Column of the format → column of the header, as told by the user.

    Raises
    ------
    DataError
        No header, a column that is missing, stands there twice or has a unit that is not known.
    UsageError
        `wanted` names a column that is not there.
    """
    comments, line, text, forced, skipped = _leading(path, wanted)
    delimiter, cells = _split(text, forced, wanted)
    if not _known(cells) and not wanted and comments:
        # A header behind a comment sign, as numpy.savetxt writes it.
        under = comments[-1][1].lstrip("# ")
        other, names_there = _split(under, forced, wanted)
        if len(_known(names_there)) > 1:
            delimiter, cells, line = other, names_there, comments[-1][0]
            comments = comments[:-1]
    if not line or not cells:
        raise DataError(f"{path.name}: no header row; expected one like '{_EXPECTED}'")
    if len(cells) > MOST_COLUMNS:
        raise DataError(f"{path.name}, row {line}: a header of {len(cells)} columns; not a samples CSV")
    columns, notes = _Assignment(path, line, cells).columns(wanted)
    if skipped:
        shown = ", ".join(f"'{other[:40].strip()}'" for _, other in skipped[:3])
        more = ", …" if len(skipped) > 3 else ""
        notes.append(f"rows before the header in row {line} were skipped: {shown}{more}")
    dialect = Dialect(delimiter)
    keys = keys_of(path.name, comments, dialect, len(cells))
    return Head(path, line, len(cells), dialect, columns, keys, tuple(notes))


def _leading(
    path: Path, wanted: Mapping[str, str]
) -> tuple[list[tuple[int, str]], int, str, str | None, list[tuple[int, str]]]:
    """Lines with `#`, number and text of the header, the delimiter that `sep=` states, skipped lines.

    The header is the first other line that names a time and two accelerations, if one of the first does:
    a logger prints text when it starts, and a log may begin in the middle of a row. Else it is the first
    line, for an error that shows it.
    """
    comments: list[tuple[int, str]] = []
    others: list[tuple[int, str]] = []
    forced: str | None = None
    held = 0
    for chunk in chunks_of(path):
        for number, line in enumerate(chunk.lines, chunk.first):
            bare = line.strip()
            held += len(bare)
            if number > MOST_HEAD_LINES or held > MOST_HEAD_CHARACTERS:
                raise DataError(
                    f"{path.name}: no header within {MOST_HEAD_LINES} lines and {MOST_HEAD_CHARACTERS} "
                    f"characters; expected one like '{_EXPECTED}'"
                )
            if bare.lower().startswith("sep="):
                forced = line[4:5] if line[4:5] in _SEPARATORS else None
            elif bare.startswith(("#", '"#')):
                comments.append((number, bare))
            elif bare.strip(';,\t" '):
                if _names_samples(line, forced, wanted):
                    return comments, number, line, forced, others
                others.append((number, line))
            if others and number >= others[0][0] + _PREAMBLE_LINES:
                return _without_header(comments, others, forced)
    return _without_header(comments, others, forced)


def _without_header(
    comments: list[tuple[int, str]], others: list[tuple[int, str]], forced: str | None
) -> tuple[list[tuple[int, str]], int, str, str | None, list[tuple[int, str]]]:
    """The first line in the place of a header that was not found, with the comments above it."""
    number, line = others[0] if others else (0, "")
    above = [comment for comment in comments if not number or comment[0] < number]
    return above, number, line, forced, []


def _names_samples(line: str, forced: str | None, wanted: Mapping[str, str]) -> bool:
    """True if the line names a time and two accelerations, or one of the columns that the user names."""
    _, cells = _split(line, forced, wanted)
    told = {text.strip().lower() for text in wanted.values()}
    if any(_alike(cell, text) for cell in cells for text in told):
        return True
    known = {found[0] for found in map(names.recognised, cells) if found is not None}
    return {"time_s", "ax", "ay"} <= known


def _split(line: str, forced: str | None, wanted: Mapping[str, str]) -> tuple[str, list[str]]:
    """Delimiter and cells of a header: those that make most names known."""
    if forced is not None:
        return forced, header_cells(line, forced)
    told = {text.strip().lower() for text in wanted.values()}

    def known(cells: Sequence[str]) -> int:
        return len(_known(cells)) + sum(cell.lower() in told for cell in cells)

    split = [(delimiter, header_cells(line, delimiter)) for delimiter in DELIMITERS]
    return max(split, key=lambda one: (known(one[1]), len(one[1]) if one[0] != SPACE else 0))


def _known(cells: Sequence[str]) -> list[str]:
    return [cell for cell in cells if names.recognised(cell)]


@dataclass(frozen=True)
class _Assignment:
    """Cells of a header on their way to columns."""

    path: Path
    line: int
    cells: list[str]

    def _fail(self, message: str) -> DataError:
        return DataError(f"{self.path.name}, row {self.line}: {message}")

    def columns(self, wanted: Mapping[str, str]) -> tuple[dict[str, CsvColumn], list[str]]:
        told = dict(self._told(mine, theirs) for mine, theirs in wanted.items())
        found = told | self._by_name(told)
        if not found:
            raise self._unknown()
        chosen, notes = self._with_units(found)
        self._refuse_missing(chosen)
        gyros = [name for name in GYROS if name in chosen]
        if gyros and len(gyros) < 3:
            missing = next(name for name in GYROS if name not in chosen)
            if any(chosen[name].plain for name in gyros):
                raise self._fail(f"column '{missing}' is missing beside '{gyros[0]}'")
            notes.append(f"rates about {', '.join(gyros)} alone were ignored: '{missing}' is missing")
            chosen = {name: column for name, column in chosen.items() if name not in GYROS}
        return chosen, [*self._ignored(found), *_renamed(chosen), *notes]

    def _told(self, mine: str, theirs: str) -> tuple[str, CsvColumn]:
        """A column that the user names."""
        known = names.recognised(mine)
        if known is None:
            raise UsageError(f"columns: '{mine}' is no column of the format; known: {', '.join(COLUMNS)}")
        there = [k for k, cell in enumerate(self.cells) if cell == theirs] or [
            k for k, cell in enumerate(self.cells) if _alike(cell, theirs)
        ]
        if len(there) != 1:
            what = "no column is called" if not there else "several columns are called"
            shown = ", ".join(f"'{cell}'" for cell in self.cells)
            raise UsageError(f"columns: {what} '{theirs}' in {self.path.name}; there are {shown}")
        unit = known[1] or names.unit_in(self.cells[there[0]])
        return known[0], CsvColumn(
            known[0], there[0], self.cells[there[0]], unit, plain=mine.endswith("_s")
        )

    def _by_name(self, told: Mapping[str, CsvColumn]) -> dict[str, CsvColumn]:
        taken = {column.place for column in told.values()}
        found: dict[str, CsvColumn] = {}
        for k, cell in enumerate(self.cells):
            known = None if k in taken else names.recognised(cell)
            if known is None or known[0] in told:
                continue
            column = CsvColumn(known[0], k, cell, known[1], known[2])
            other = found.get(column.name)
            if other is not None and other.plain == column.plain:
                if column.plain:
                    raise self._fail(f"column '{cell}' stands there twice")
                raise self._fail(
                    f"both '{other.text}' and '{cell}' may be {column.name}; say which: "
                    f"--columns {column.name}={cell}"
                )
            if other is None or column.plain:
                found[column.name] = column
        return found

    def _with_units(self, found: Mapping[str, CsvColumn]) -> tuple[dict[str, CsvColumn], list[str]]:
        """Columns with the format's spelling of their units; what is optional and unknown is left out."""
        chosen: dict[str, CsvColumn] = {}
        notes = []
        for name, column in found.items():
            unit = column.unit
            if unit and name in (*AXES, *GYROS):
                spelled = names.unit_of(name, unit)
            else:
                spelled = unit if names.scale_of(name, unit) is not None else None
            if spelled is not None:
                chosen[name] = CsvColumn(name, column.place, column.text, spelled, column.plain)
                continue
            known = ", ".join(names.known_units(name))
            if name in ("time_s", *AXES):
                raise self._fail(
                    f"unit '{unit}' of column '{column.text}' is not known; known are {known}: convert, or "
                    f"name the column without it"
                )
            why = f"its unit is not one of {known}" if known else f"{name} has no unit"
            notes.append(f"column '{column.text}' was ignored: {why}")
        for axes in (AXES, GYROS):
            units = {column.unit for name, column in chosen.items() if name in axes}
            if len(units) > 1:
                listed = ", ".join(f"'{c.text}'" for name, c in chosen.items() if name in axes)
                raise self._fail(f"columns {listed} do not have one unit; convert them to the same one")
        return chosen, notes

    def _refuse_missing(self, chosen: Mapping[str, CsvColumn]) -> None:
        missing = [name for name in ("time_s", "ax", "ay") if name not in chosen]
        if not missing:
            return
        spare = [cell for cell in self.cells if cell and names.recognised(cell) is None]
        hint = ""
        if spare:
            likely = ",".join(f"{name}={_likely(name, spare)}" for name in missing)
            shown = ", ".join(f"'{cell[:40]}'" for cell in spare[:12])
            hint = f"; not known are {shown}: say which it is, such as --columns '{likely}'"
        raise self._fail(f"column '{missing[0]}' is missing{hint}")

    def _unknown(self) -> DataError:
        cells = [cell for cell in self.cells if cell]
        if cells and all(_numeric(cell) for cell in cells):
            return self._fail(
                f"no header row: the first row holds numbers; put a row such as '{_EXPECTED}' above it"
            )
        shown = ", ".join(f"'{cell[:40]}'" for cell in cells[:12])
        example = ",".join(f"{n}={c[:40]}" for n, c in zip(("time", "ax", "ay"), cells, strict=False))
        return self._fail(
            f"not a samples CSV: no known column in the header ({shown}); expected time_s, ax, ay and "
            f"others; say which are which, such as --columns '{example}'"
        )

    def _ignored(self, found: Mapping[str, CsvColumn]) -> list[str]:
        taken = {column.place for column in found.values()}
        left = [cell or f"column {k + 1}" for k, cell in enumerate(self.cells) if k not in taken]
        if not left:
            return []
        notes = [f"columns that were ignored: {', '.join(left)}"]
        for cell in left:
            near = difflib.get_close_matches(cell.lower(), set(COLUMNS) - set(found), n=1, cutoff=0.8)
            notes += [f"is the ignored column '{cell}' meant to be {near[0]}?"] if near else []
        return notes


def _likely(name: str, spare: Sequence[str]) -> str:
    """The unknown column that ends as an axis does, or begins as a time does; dots where there is none."""
    for cell in spare:
        text = names.without_unit(cell).lower()
        if text.endswith(name[1]) if name in AXES else text.startswith(("t", "z")):
            return cell
    return "…"


def _alike(cell: str, theirs: str) -> bool:
    return theirs.lower() in (cell.lower(), names.without_unit(cell).lower())


def _numeric(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return False
    return True


def _renamed(chosen: Mapping[str, CsvColumn]) -> list[str]:
    """What stands for what, where the file has names of its own."""
    own = [column for column in chosen.values() if column.text.strip().lower() != column.name]
    if not own:
        return []
    listed = ", ".join(f"{column.name} from '{column.text}'" for column in own)
    return [f"columns were read as: {listed}"]


def delimiter_in_words(dialect: Dialect) -> str:
    """Name of what separates the cells."""
    return IN_WORDS.get(dialect.delimiter, f"'{dialect.delimiter}'")
