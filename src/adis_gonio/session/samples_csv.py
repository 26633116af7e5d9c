"""The samples CSV: a session as text, one row a sample.

`read_samples_csv` reads `.csv` and `.csv.gz` (told apart by content, not by name) in bulk; only where the
bulk conversion fails are the rows walked one by one, so that the message names the first bad one.
`write_samples_csv` writes the same format; what it writes is read back without a change. A line
`# note: text`, of which there may be several, becomes one of `Session.notes`.

A file without the column `position` is one continuous recording: its dwells are found by stillness
(`adis_gonio.session.stillness`), and `Session.notes` says what was found.
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from adis_gonio.errors import DataError
from adis_gonio.model.records import METADATA, STANDARD_GRAVITY_MPS2, Dwell, Floats, Session, Use
from adis_gonio.session.stillness import segment_with_notes

SENSORS = ("adis16354", "adis16350", "adis16355", "generic")
PLANES = ("xy", "none")
ACCEL_UNITS = ("lsb", "mg", "g", "mps2", "counts")
GYRO_UNITS = ("dps", "radps", "counts")

AXES = ("ax", "ay", "az")
GYROS = ("gx", "gy", "gz")
COLUMNS = ("time_s", "position", "angle_deg", "approach", *AXES, *GYROS, "temp_c", "supply_v", "use")


@dataclass(frozen=True)
class _Table:
    """Header of a file and its rows as lists of text, by column."""

    path: Path
    keys: dict[str, tuple[str, int]]
    notes: tuple[str, ...]
    columns: dict[str, list[str]]
    first_line: int
    """Number, counted from 1, of the line that holds the first row."""

    def fail(self, row: int, message: str) -> DataError:
        return DataError(f"{self.path.name}, row {self.first_line + row}: {message}")


def read_samples_csv(path: str | Path) -> Session:
    """Session of a samples CSV.

    Rows are named by the number of their line in the file, counted from 1, comment lines included.

    Raises
    ------
    DataError
        In one line with file and row: not text, damaged gzip, empty, unknown value of a key, missing or
        unknown column, text in a number, NaN or infinity, time that goes back, a position whose rows are
        not contiguous, an angle, approach or use that changes within a dwell.
    """
    path = Path(path)
    table = _split(path, _text(path))
    settings = _settings(table)
    names = set(table.columns)
    if settings["plane"] == "none" and "az" not in names:
        raise DataError(f"{path.name}: column 'az' is missing; plane 'none' needs ax, ay and az")
    time = _numbers(table, "time_s")
    backwards = np.flatnonzero(np.diff(time) < 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise table.fail(row, f"time_s goes back from {time[row - 1]:g} to {time[row]:g}; sort by time")
    accel = np.stack([_numbers(table, name) for name in AXES if name in names], axis=1)
    gyro = _gyro(table)
    temperature = _numbers(table, "temp_c") if "temp_c" in names else None
    supply = _numbers(table, "supply_v") if "supply_v" in names else None

    if "position" in names:
        numbers, slices = _dwells_by_position(table)
        notes: tuple[str, ...] = ()
    else:
        try:
            slices, found = segment_with_notes(time, accel, gyro)
        except DataError as error:
            raise DataError(f"{path.name}: {error}") from error
        numbers, notes = list(range(len(slices))), tuple(found)
        if not slices:
            raise DataError(
                f"{path.name}: no dwell found: {'; '.join(found) or 'the sensor never rests'}; "
                "add a column 'position' or record at least one second at rest in each position"
            )

    angle = _constant(table, "angle_deg", slices, _angle)
    approach = _constant(table, "approach", slices, _approach)
    use = _constant(table, "use", slices, _use)
    dwells = tuple(
        Dwell(
            position=number,
            time_s=time[rows],
            accel=accel[rows],
            angle_deg=angle[k],
            approach=approach[k] or 0,
            use=cast("Use", use[k] or "fit"),
            gyro=None if gyro is None else gyro[rows],
            temperature_c=None if temperature is None else temperature[rows],
            supply_v=None if supply is None else supply[rows],
            first_row=table.first_line + rows.start,
        )
        for k, (number, rows) in enumerate(zip(numbers, slices, strict=True))
    )
    return Session(
        dwells=dwells,
        source=str(path),
        notes=table.notes + notes,
        cut_by_stillness="position" not in names,
        **settings,
    )


def write_samples_csv(session: Session, path: str | Path) -> None:
    """Write a session as samples CSV, gzipped where the name ends in `.gz`.

    Numbers are written with the fewest digits that give the same float again. Columns that no dwell has
    are left out.

    Raises
    ------
    DataError
        If dwells differ in their columns (one has gyros, another has not) or the session has no dwell.
    """
    path = Path(path)
    dwells = session.dwells
    if not dwells:
        raise DataError(f"{path.name}: the session has no dwell to write")
    parts = _columns_of(dwells, path.name)
    lines = [f"# {key}: {value}" for key, value in _keys_of(session).items()]
    lines += [f"# note: {' '.join(note.split())}" for note in session.notes]
    lines.append(",".join(parts))
    texts = [chain.from_iterable(map(texts_of, dwells)) for texts_of in parts.values()]
    lines.extend(map(",".join, zip(*texts, strict=True)))
    data = ("\n".join(lines) + "\n").encode()
    if path.name.endswith(".gz"):
        data = gzip.compress(data, compresslevel=6, mtime=0)
    path.write_bytes(data)


_Column = Callable[[Dwell], list[str]]
"""Texts (n,) that a column of the file holds for a dwell of n samples."""


def _columns_of(dwells: Sequence[Dwell], file: str) -> dict[str, _Column]:
    """Columns in the file's order; those that no dwell has are left out."""
    columns: dict[str, _Column] = {
        "time_s": lambda d: _texts_of(d.time_s),
        "position": lambda d: [str(d.position)] * len(d),
    }
    if any(dwell.angle_deg is not None for dwell in dwells):
        columns["angle_deg"] = lambda d: ["" if d.angle_deg is None else _text_of(d.angle_deg)] * len(d)
    if any(dwell.approach for dwell in dwells):
        columns["approach"] = lambda d: [f"{d.approach:+d}" if d.approach else ""] * len(d)
    series: dict[str, Callable[[Dwell], Floats | None]] = {
        **{name: partial(_axis_of, name="accel", axis=k) for k, name in enumerate(AXES)},
        **{name: partial(_axis_of, name="gyro", axis=k) for k, name in enumerate(GYROS)},
        "temp_c": lambda d: d.temperature_c,
        "supply_v": lambda d: d.supply_v,
    }
    for name, get in series.items():
        lacking = [dwell.position for dwell in dwells if get(dwell) is None]
        if not lacking:
            columns[name] = partial(_texts_by, get)
        elif len(lacking) < len(dwells):
            raise DataError(f"{file}: position {lacking[0]} has no '{name}', others have")
    if any(dwell.use != "fit" for dwell in dwells):
        columns["use"] = lambda d: [d.use] * len(d)
    return columns


def _axis_of(dwell: Dwell, name: Literal["accel", "gyro"], axis: int) -> Floats | None:
    """One axis (n,) of a dwell; None where it was not recorded."""
    values: Floats | None = getattr(dwell, name)
    return None if values is None or axis >= values.shape[1] else values[:, axis]


def _texts_by(get: Callable[[Dwell], Floats | None], dwell: Dwell) -> list[str]:
    values = get(dwell)
    return [] if values is None else _texts_of(values)


def _keys_of(session: Session) -> dict[str, str]:
    written = {name: " ".join(getattr(session, name).split()) for name in ("title", *METADATA)}
    keys = {name: text for name, text in written.items() if text}
    keys |= {
        "sensor": session.sensor,
        "accel_unit": session.accel_unit,
        "gyro_unit": session.gyro_unit,
        "gravity_mps2": repr(float(session.gravity_mps2)),
        "plane": session.plane,
    }
    if session.fixture_sigma_deg is not None:
        sigma = session.fixture_sigma_deg
        keys["fixture_sigma_deg"] = "free" if math.isinf(sigma) else _text_of(sigma)
    if session.reading_u_mg is not None:
        keys["reading_u_mg"] = _text_of(session.reading_u_mg)
    return keys


def _text_of(value: float) -> str:
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)


def _texts_of(values: Floats) -> list[str]:
    numbers: list[float] = np.asarray(values, dtype=float).tolist()
    return [_text_of(number) for number in numbers]


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.decompress(data)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise DataError(
                f"{path.name}: damaged or truncated gzip file ({error}); copy it again"
            ) from error
    if not data.strip():
        raise DataError(f"{path.name}: the file is empty")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path.name}: not a samples CSV: byte {error.start} is not UTF-8 text; give a .csv, a .csv.gz "
            "or a file written by calibrate or simulate"
        ) from error
    if "\x00" in text:
        raise DataError(f"{path.name}: not a samples CSV: it holds binary data")
    return text


def _split(path: Path, text: str) -> _Table:
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    while lines and not lines[-1].strip():
        lines.pop()
    keys, notes, start = _keys(path, lines)
    if start == len(lines):
        raise DataError(f"{path.name}: no header row; expected one like 'time_s,position,angle_deg,ax,ay'")
    header = [name.strip() for name in lines[start].split(",")]
    _check_header(path, header, start + 1)
    rows = lines[start + 1 :]
    if not rows:
        raise DataError(f"{path.name}: the header in row {start + 1} is followed by no sample")
    commas = len(header) - 1
    for number, line in enumerate(rows):
        if line.count(",") != commas:
            what = f"{line.count(',') + 1} values where the header has {commas + 1}"
            raise DataError(
                f"{path.name}, row {start + 2 + number}: {what if line.strip() else 'empty row'}"
            )
    cells = ",".join(rows).split(",")
    columns = {name: cells[k :: commas + 1] for k, name in enumerate(header)}
    return _Table(path, keys, tuple(notes), columns, start + 2)


def _keys(path: Path, lines: list[str]) -> tuple[dict[str, tuple[str, int]], list[str], int]:
    """Keys with their rows, notes, and the line after them."""
    keys: dict[str, tuple[str, int]] = {}
    notes: list[str] = []
    start = 0
    while start < len(lines) and (lines[start].startswith("#") or not lines[start].strip()):
        name, colon, value = lines[start].lstrip("#").partition(":")
        name, start = name.strip().lower(), start + 1
        if not colon:
            continue
        if name == "note":
            notes.append(value.strip())
            continue
        if name in keys:
            raise DataError(f"{path.name}, row {start}: key '{name}' stands there twice")
        keys[name] = (value.strip(), start)
        if name not in _KEYS:
            notes.append(f"key '{name}' in row {start} is not known and was ignored")
    return keys, notes, start


def _check_header(path: Path, header: list[str], row: int) -> None:
    known = [name for name in header if name in COLUMNS]
    if not known:
        raise DataError(
            f"{path.name}, row {row}: not a samples CSV: no known column in the header; "
            "expected time_s, ax, ay and others"
        )
    for name in header:
        if header.count(name) > 1:
            raise DataError(f"{path.name}, row {row}: column '{name}' stands there twice")
        if name not in COLUMNS:
            raise DataError(f"{path.name}, row {row}: unknown column '{name}'; known: {', '.join(COLUMNS)}")
    for name in ("time_s", "ax", "ay"):
        if name not in header:
            raise DataError(f"{path.name}, row {row}: column '{name}' is missing")
    gyros = [name for name in GYROS if name in header]
    if gyros and len(gyros) < 3:
        missing = next(name for name in GYROS if name not in header)
        raise DataError(f"{path.name}, row {row}: column '{missing}' is missing beside '{gyros[0]}'")


def _choice(allowed: Sequence[str]) -> Callable[[str], str]:
    def parse(text: str) -> str:
        if text.lower() not in allowed:
            raise ValueError(f"expected one of {', '.join(allowed)}")
        return text.lower()

    return parse


def _positive(text: str) -> float:
    value = _float(text)
    if not (math.isfinite(value) and value > 0):
        raise ValueError("expected a number above zero")
    return value


def _sigma(text: str) -> float:
    if text.lower() == "free":
        return math.inf
    value = _float(text)
    if not (math.isfinite(value) and value >= 0):
        raise ValueError("expected degrees, not negative, or 'free'")
    return value


_KEYS: dict[str, Callable[[str], Any]] = {
    "sensor": _choice(SENSORS),
    "gravity_mps2": _positive,
    "fixture_sigma_deg": _sigma,
    "plane": _choice(PLANES),
    "accel_unit": _choice(ACCEL_UNITS),
    "gyro_unit": _choice(GYRO_UNITS),
    "reading_u_mg": _positive,
    "title": str,
    **dict.fromkeys(METADATA, str),
}


def _settings(table: _Table) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "sensor": "adis16354",
        "accel_unit": "lsb",
        "gyro_unit": "dps",
        "gravity_mps2": STANDARD_GRAVITY_MPS2,
        "plane": "xy",
    }
    for name, (text, line) in table.keys.items():
        if name not in _KEYS:
            continue
        try:
            settings[name] = _KEYS[name](text)
        except ValueError as error:
            reason = str(error) if str(error).startswith("expected") else "expected a number"
            raise DataError(
                f"{table.path.name}, row {line}: {name} '{text}' is not known: {reason}"
            ) from error
    if settings["sensor"] == "generic" and settings["accel_unit"] == "lsb":
        raise DataError(
            f"{table.path.name}: accel_unit 'lsb' needs a sensor whose LSB is known; "
            "for a generic one say mg, g, mps2 or counts"
        )
    return settings


def _float(text: str) -> float:
    # Python's float takes '1_000', which no instrument writes.
    if "_" in text:
        raise ValueError(text)
    return float(text)


def _numbers(table: _Table, name: str) -> Floats:
    cells = table.columns[name]
    try:
        values = np.array(list(map(float, cells)))
    except ValueError:
        values = None
    if values is not None and np.isfinite(values).all() and "_" not in "".join(cells):
        return values
    for row, cell in enumerate(cells):
        try:
            value = _float(cell)
        except ValueError:
            what = f"'{cell.strip()}' is not a number" if cell.strip() else "empty"
            raise table.fail(row, f"column '{name}': {what}") from None
        if not math.isfinite(value):
            raise table.fail(
                row, f"column '{name}': {cell.strip()} is not a finite number; leave such rows out"
            )
    raise AssertionError("unreachable: one of the cells is bad")  # pragma: no cover


def _gyro(table: _Table) -> Floats | None:
    if not all(name in table.columns for name in GYROS):
        return None
    return np.stack([_numbers(table, name) for name in GYROS], axis=1)


def _dwells_by_position(table: _Table) -> tuple[list[int], list[slice]]:
    cells = table.columns["position"]
    code = _codes(cells)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(code)) + 1])
    ends = np.append(starts[1:], len(cells))
    numbers: list[int] = []
    seen: dict[int, int] = {}
    for start in starts.tolist():
        try:
            number = int(cells[start])
        except ValueError:
            raise table.fail(start, f"column 'position': '{cells[start]}' is not an integer") from None
        if number in seen:
            raise table.fail(
                start,
                f"position {number} comes back after another one (first in row {seen[number]}); "
                "the rows of a dwell must be contiguous: give a second visit a number of its own",
            )
        seen[number] = table.first_line + start
        numbers.append(number)
    return numbers, [slice(a, b) for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]


def _codes(cells: list[str]) -> NDArray[np.intp]:
    """Number of each distinct text, (n,) int."""
    book: dict[str, int] = {}
    return np.fromiter(
        (book.setdefault(cell, len(book)) for cell in cells), dtype=np.intp, count=len(cells)
    )


def _constant(table: _Table, name: str, slices: list[slice], parse: Callable[[str], Any]) -> list[Any]:
    """Value of a column that must not change within a dwell; None where it is empty or absent."""
    if name not in table.columns:
        return [None] * len(slices)
    cells = table.columns[name]
    code = _codes(cells)
    values = []
    for rows in slices:
        try:
            value = parse(cells[rows.start].strip())
        except ValueError as error:
            raise table.fail(
                rows.start, f"column '{name}': '{cells[rows.start].strip()}' {error}"
            ) from None
        for row in _firsts_of_other_texts(code, rows):
            try:
                same = parse(cells[row].strip()) == value
            except ValueError as error:
                raise table.fail(row, f"column '{name}': '{cells[row].strip()}' {error}") from None
            if not same:
                raise table.fail(
                    row,
                    f"{name} changes within a dwell from '{cells[rows.start].strip()}' to "
                    f"'{cells[row].strip()}'; a new setting is a new position",
                )
        values.append(value)
    return values


def _firsts_of_other_texts(code: NDArray[np.intp], rows: slice) -> list[int]:
    other = np.flatnonzero(code[rows] != code[rows.start])
    _, first = np.unique(code[rows][other], return_index=True)
    return sorted((rows.start + other[first]).tolist())


def _angle(text: str) -> float | None:
    if not text:
        return None
    try:
        value = _float(text)
    except ValueError:
        raise ValueError("is not an angle in degrees") from None
    if not math.isfinite(value):
        raise ValueError("is not a finite angle; leave it empty where it is unknown")
    return value


def _approach(text: str) -> Literal[1, -1] | None:
    if not text or text == "0":
        return None
    if text in ("+1", "1", "+1.0", "1.0"):
        return 1
    if text in ("-1", "-1.0"):
        return -1
    raise ValueError("is neither +1 nor -1")


def _use(text: str) -> str | None:
    if text.lower() in ("", "fit", "check"):
        return text.lower() or None
    raise ValueError("is neither 'fit' nor 'check'")
