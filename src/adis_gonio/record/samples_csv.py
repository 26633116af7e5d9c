"""The samples CSV: a session as text, one row a sample.

`read_samples_csv` reads what people have (`adis_gonio.record.samples`: delimiters, decimal marks,
encodings, names and units in the header), plain or gzipped, told apart by content and not by name.
`write_samples_csv` writes the format itself; what it writes is read back without a change. A line
`# note: text`, of which there may be several, becomes one of `Session.notes`.

A file without the column `position` is one continuous recording: its dwells are found by stillness
(`adis_gonio.record.segmentation`), and `Session.notes` says what was found.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in
from adis_gonio.model.records import METADATA, Dwell, Session, Use
from adis_gonio.record.overrides import Overrides
from adis_gonio.record.plans import MOST_POSITIONS
from adis_gonio.record.samples.keys import without_formulas
from adis_gonio.record.samples.names import AXES, GYROS
from adis_gonio.record.samples.table import SamplesTable, table_of
from adis_gonio.record.segmentation import segment_with_notes, shows_a_free_turn


def read_samples_csv(path: str | Path, overrides: Overrides | None = None) -> Session:
    """Session of a samples CSV.

    Rows are named by the number of their line in the file, counted from 1, comment lines included. What was
    left out, and what the file calls otherwise than the format, stands in `Session.notes`.

    Raises
    ------
    DataError
        In one line with file and row: not text, damaged gzip, empty, unknown value of a key, missing
        column, unit that is not known, text in a number, numbers that may be read in two ways, NaN or
        infinity, time that goes back, a position whose rows are not contiguous, an angle, approach or use
        that changes within a dwell.
    UsageError
        `overrides` names a column that is not there.
    """
    path, overrides = Path(path), overrides or Overrides()
    table = table_of(path, dict(overrides.columns))
    settings = table.head.settings(unit_told=overrides.accel_unit is not None)
    if settings.get("plane") == "none" and table.accel.shape[1] < 3:
        raise DataError(f"{path.name}: column 'az' is missing; plane 'none' needs ax, ay and az")
    by_position = "position" in table.runs
    recording = None if by_position else _whole(table)
    notes: tuple[str, ...] = ()
    if by_position:
        numbers, slices = _dwells_by_position(table)
    else:
        slices, notes = _dwells_by_stillness(table, recording)
        numbers = list(range(len(slices)))

    free = recording is not None and shows_a_free_turn(recording, slices)
    if free:
        notes = (*notes, "one continuous turn without declared angles: taken as a free turn")
    said = _Remarks(len(slices))
    angle = _per_dwell(table, "angle_deg", slices, partial(_angle, table), said)
    approach = _per_dwell(table, "approach", slices, _approach, said)
    use = _per_dwell(table, "use", slices, _use, said)
    dwells = tuple(
        Dwell(
            position=number,
            time_s=table.time_s[rows],
            accel=table.accel[rows],
            angle_deg=angle[k],
            approach=approach[k] or 0,
            use=cast("Use", use[k] or "fit"),
            gyro=None if table.gyro is None else table.gyro[rows],
            temperature_c=None if table.temperature_c is None else table.temperature_c[rows],
            supply_v=None if table.supply_v is None else table.supply_v[rows],
            first_row=table.line_of(rows.start),
        )
        for k, (number, rows) in enumerate(zip(numbers, slices, strict=True))
    )
    session = Session(
        dwells=dwells,
        source=str(path),
        notes=(*table.notes, *notes, *said.notes(free=free)),
        cut_by_stillness=not by_position,
        recording=recording,
        free_turn=free,
        **settings,
    )
    session = overrides.apply(session)
    if session.sensor == "generic" and session.accel_unit == "lsb":
        raise DataError(
            f"{path.name}: accel_unit 'lsb' needs a sensor whose LSB is known; for a generic one add a "
            "line '# accel_unit: mg' (or g, mps2, counts), or give --unit"
        )
    return session


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
    dwells = session.sampled
    if not dwells:
        raise DataError(f"{path.name}: the session has no dwell to write")
    parts = _columns_of(dwells, path.name)
    if session.free_turn:  # without the column the file is one continuous recording
        del parts["position"]
    lines = [f"# {key}: {without_formulas(value)}" for key, value in _keys_of(session).items()]
    lines += [f"# note: {without_formulas(' '.join(note.split()))}" for note in session.notes]
    lines.append(",".join(parts))
    texts = [chain.from_iterable(map(texts_of, dwells)) for texts_of in parts.values()]
    lines.extend(map(",".join, zip(*texts, strict=True)))
    data = ("\n".join(lines) + "\n").encode("utf-8", "replace")
    if ends_in(path, ".gz"):
        data = gzip.compress(data, compresslevel=6, mtime=0)
    path.write_bytes(data)


MOST_DWELLS = MOST_POSITIONS
"""Positions of a file, as many as a plan has: the memory of a fit grows with their square."""
_LARGEST_DEG = 1e6
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
    texts = {name: " ".join(getattr(session, name).split()) for name in ("title", *METADATA)}
    keys = {name: text for name, text in texts.items() if text}
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


def _whole(table: SamplesTable) -> Dwell:
    """All rows as one recording; views, no copies."""
    return Dwell(
        0, table.time_s, table.accel, gyro=table.gyro, temperature_c=table.temperature_c,
        supply_v=table.supply_v, first_row=table.line_of(0),
    )  # fmt: skip


def _dwells_by_stillness(
    table: SamplesTable, recording: Dwell | None
) -> tuple[list[slice], tuple[str, ...]]:
    """Dwells of a continuous recording, and what was found."""
    try:
        slices, found = segment_with_notes(table.time_s, table.accel, table.gyro)
    except DataError as error:
        raise DataError(f"{table.path.name}: {error}") from error
    if not slices and not (recording is not None and shows_a_free_turn(recording, slices)):
        raise DataError(
            f"{table.path.name}: no dwell found: {'; '.join(found) or 'the sensor never rests'}; "
            "add a column 'position' or record at least one second at rest in each position"
        )
    return slices, tuple(found)


def _dwells_by_position(table: SamplesTable) -> tuple[list[int], list[slice]]:
    numbers: list[int] = []
    starts: list[int] = []
    seen: dict[int, int] = {}
    for row, text in table.runs["position"]:
        number = _position(table, row, text)
        if numbers and numbers[-1] == number:
            continue
        if number in seen:
            raise table.fail(
                row,
                f"position {number} comes back after another one (first in row {seen[number]}); "
                "the rows of a dwell must be contiguous: give a second visit a number of its own",
            )
        if len(numbers) == MOST_DWELLS:
            raise table.fail(row, f"more than {MOST_DWELLS} positions: divide the file")
        seen[number] = table.line_of(row)
        numbers.append(number)
        starts.append(row)
    ends = [*starts[1:], len(table.time_s)]
    return numbers, [slice(a, b) for a, b in zip(starts, ends, strict=True)]


def _position(table: SamplesTable, row: int, text: str) -> int:
    try:
        # A spreadsheet may write an integer as 3.0 or 3,0.
        value = table.number("position", text)
    except ValueError:
        value = math.nan
    if not (value.is_integer() and abs(value) < 1e9):
        raise table.fail(row, f"column 'position': '{text.strip()}' is not an integer of at most 9 digits")
    return int(value)


@dataclass
class _Remarks:
    """Remarks on columns with one value a dwell.

    Attributes
    ----------
    dwells : int
    given : list of str
        Columns with a value in any row.
    taken : dict of str to int
        Dwells whose value was noted before their first row, by column.
    filled, unused : list of str
        Columns with empty cells within a dwell, and columns of which no dwell has a value.
    lost : list of str
        Values without a dwell, in words.
    """

    dwells: int
    given: list[str] = field(default_factory=list)
    taken: dict[str, int] = field(default_factory=dict)
    filled: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def notes(self, *, free: bool) -> tuple[str, ...]:
        """One line each."""
        notes = []
        unused = self.given if free else self.unused
        if unused:
            why = "a free turn has no dwells" if free else "no dwell that was found goes with its values"
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
    table: SamplesTable, name: str, slices: list[slice], parse: Callable[[str], Any], said: _Remarks
) -> list[Any]:
    """Values of a column that has one value a dwell; None for a dwell without a value.

    Cells of a dwell may be empty if another cell of the dwell has the value. If all of them are empty, the
    last value between the dwell and the one before counts: a dwell that is found by stillness begins some
    rows after the row where somebody noted the angle.
    """
    if name not in table.runs:
        return [None] * len(slices)
    said.given += [name] if any(text.strip() for _, text in table.runs[name]) else []
    inside = [_stated(table, name, rows) for rows in slices]
    edges = [0, *(rows.stop for rows in slices)]
    ends = [*(rows.start for rows in slices), len(table.time_s)]
    gaps = [_stated(table, name, slice(a, b)) for a, b in zip(edges, ends, strict=True)]
    # Values noted on the last row of each dwell would all go to the dwell after.
    before = bool(gaps[0]) or not gaps[-1] or not slices or bool(inside[0])
    values, taken = [], 0
    last: list[tuple[int, str]] = []
    for k, (rows, texts) in enumerate(zip(slices, inside, strict=True)):
        if not texts and before:
            # Two dwells without a row between them are one that was split at a step.
            texts = gaps[k][-1:] or (last if rows.start == edges[k] else [])
            taken += bool(texts)
            last = texts
        elif texts and any(not text.strip() for _, text in table.texts(name, rows)):
            said.filled += [name] if name not in said.filled else []
        values.append(_one_value(table, name, texts, parse))
    if taken:
        said.taken[name] = taken
        unused = sum(len(gap) - 1 for gap in gaps[:-1] if gap) + len(gaps[-1])
        where = f"{name}: {counted(unused, 'value')} given where no dwell was found"
        said.lost += [where] if unused else []
    elif any(gaps) and not any(inside):
        said.unused.append(name)
    return values


def _stated(table: SamplesTable, name: str, rows: slice) -> list[tuple[int, str]]:
    """Texts of a column within rows that are not empty, each with the row where it begins."""
    if rows.start >= rows.stop:
        return []
    return [(row, text.strip()) for row, text in table.texts(name, rows) if text.strip()]


def _one_value(
    table: SamplesTable, name: str, texts: list[tuple[int, str]], parse: Callable[[str], Any]
) -> Any:
    """Value of a dwell out of its texts; None without any."""
    value = None
    for k, (row, text) in enumerate(texts):
        try:
            found = parse(text)
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


def _angle(table: SamplesTable, text: str) -> float | None:
    if not text:
        return None
    try:
        value = table.number("angle_deg", text)
    except ValueError:
        raise ValueError("is not an angle in degrees") from None
    if not abs(value) <= _LARGEST_DEG:
        raise ValueError("is no angle of a stage; leave it empty if it is unknown")
    return value


def _approach(text: str) -> Literal[1, -1] | None:
    if not text or text == "0":
        return None
    if text.replace(",", ".") in ("+1", "1", "+1.0", "1.0"):
        return 1
    if text.replace(",", ".").replace("−", "-") in ("-1", "-1.0"):
        return -1
    raise ValueError("is neither +1 nor -1")


def _use(text: str) -> str | None:
    if text.lower() in ("", "fit", "check"):
        return text.lower() or None
    raise ValueError("is neither 'fit' nor 'check'")
