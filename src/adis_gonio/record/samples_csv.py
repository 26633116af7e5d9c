"""The samples CSV: a session as text, one row a sample.

`read_samples_csv` reads what people have (`adis_gonio.record.samples`: delimiters, decimal marks,
encodings, names and units in the header), plain or gzipped, told apart by content and not by name.
`write_samples_csv` writes the format itself; what it writes is read back without a change.
`template_text` makes a file without readings, to be filled in by hand. A line `# note: text`, of which
there may be several, becomes one of `Session.notes`.

A file without the column `position` is one continuous recording: its dwells are found by stillness
(`adis_gonio.record.segmentation`), and `Session.notes` says what was found.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from adis_gonio.base.errors import DataError, SessionError, UsageError
from adis_gonio.base.numbers import counted
from adis_gonio.base.output import ends_in, exists_error
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, AccelUnit, Dwell, Session
from adis_gonio.record.overrides import Overrides
from adis_gonio.record.plans import MOST_POSITIONS, Plan
from adis_gonio.record.samples.columns import COLUMNS, KEYS, without_formulas
from adis_gonio.record.samples.table import SamplesTable, table_of
from adis_gonio.record.segmentation import segment_with_notes, shows_a_free_turn

MOST_DWELLS = MOST_POSITIONS
"""Positions of a file, as many as a plan has: the memory of a fit grows with their square."""


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
    if settings.get("plane") == "none" and table.series["accel"].shape[1] < 3:
        raise DataError(f"{path.name}: column 'az' is missing; plane 'none' needs ax, ay and az")
    recording: Dwell | None = None
    free, notes = False, list[str]()
    if "position" in table.runs:
        numbers, slices = _dwells_by_position(table)
    else:
        recording = _dwell(table, 0, slice(0, len(table)))
        slices, notes, free = _dwells_by_stillness(path.name, recording)
        numbers = list(range(len(slices)))
    said = _Remarks(len(slices))
    angle = _per_dwell(table, "angle_deg", slices, _angle, said)
    approach = _per_dwell(table, "approach", slices, _approach, said)
    use = _per_dwell(table, "use", slices, _use, said)
    dwells = tuple(
        _dwell(table, number, rows, angle_deg=angle[k], approach=approach[k] or 0, use=use[k] or "fit")
        for k, (number, rows) in enumerate(zip(numbers, slices, strict=True))
    )
    session = Session(
        dwells=dwells,
        source=str(path),
        notes=(*table.notes, *notes, *said.notes(free=free)),
        cut_by_stillness=recording is not None,
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
    names = _columns_to_write(dwells, path.name)
    if session.free_turn:  # without the column the file is one continuous recording
        names.remove("position")
    stated = {name: getattr(session, name, None) for name in KEYS}
    lines = _leading_lines({name: value for name, value in stated.items() if value not in (None, "")})
    lines += [f"# note: {without_formulas(' '.join(note.split()))}" for note in session.notes]
    data = _file_text(lines, names, chain.from_iterable(_rows(names, dwell) for dwell in dwells)).encode(
        "utf-8", "replace"
    )
    if ends_in(path, ".gz"):
        data = gzip.compress(data, compresslevel=6, mtime=0)
    path.write_bytes(data)


def _leading_lines(values: Mapping[str, Any]) -> list[str]:
    """Lines of keys; one without a value, to be filled in, for None or an empty text."""
    texts = {name: "" if value is None else KEYS[name].text(value) for name, value in values.items()}
    return [f"# {name}: {without_formulas(text)}".rstrip() for name, text in texts.items()]


def _file_text(leading: list[str], names: list[str], rows: Iterable[Iterable[str]]) -> str:
    return "\n".join([*leading, ",".join(names), *map(",".join, rows), ""])


def _columns_to_write(dwells: tuple[Dwell, ...], file: str) -> list[str]:
    """Columns in the file's order; those that no dwell has are left out."""
    columns = [dwell.columns() for dwell in dwells]
    first = [{name: COLUMNS[name].text(values[0]) for name, values in c.items()} for c in columns]
    names = []
    for name, column in COLUMNS.items():
        lacking = [
            dwell.position
            for dwell, texts in zip(dwells, first, strict=True)
            if texts.get(name, "") == column.default
        ]
        if len(lacking) == len(dwells):
            continue
        if lacking and not column.per_dwell:
            raise DataError(f"{file}: position {lacking[0]} has no '{name}', others have")
        names.append(name)
    return names


def _rows(names: list[str], dwell: Dwell) -> Iterator[tuple[str, ...]]:
    """Texts of the rows of a dwell."""
    columns, texts = dwell.columns(), []
    for name in names:
        column, values = COLUMNS[name], columns[name].tolist()
        if column.per_dwell:
            texts.append([column.text(values[0])] * len(values))
        else:
            texts.append(list(map(column.text, values)))
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
    accel_unit: AccelUnit = "mg",
    gravity_mps2: float = STANDARD_GRAVITY_MPS2,
    fixture_sigma_deg: float | None = None,
) -> str:
    """A file to fill in by hand, as text: keys, what they mean, and one row a position of a plan.

    Times and readings are left empty, and whoever fills them in changes nothing else.

    Raises
    ------
    UsageError
        Readings in LSB of a sensor whose LSB is not known.
    """
    if sensor == "generic" and accel_unit == "lsb":
        raise UsageError("a generic sensor has no LSB that is known: give --unit mg, g, mps2 or counts")
    planar = plan.plane == "xy"
    keys: dict[str, Any] = {
        **dict.fromkeys(("title", "operator", "serial", "stage")),
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


def write_template(path: Path, text: str) -> None:
    """Write a new file.

    Raises
    ------
    SessionError
        The file exists, or cannot be written.
    """
    try:
        with path.open("x", encoding="utf-8", newline="\n") as file:
            file.write(text)
    except FileExistsError:
        raise exists_error(path) from None
    except OSError as error:
        raise SessionError(f"{path}: cannot be written: {error.strerror or error}") from None


# -- dwells ---------------------------------------------------------------------------------------


def _dwell(table: SamplesTable, number: int, rows: slice, **declared: Any) -> Dwell:
    """Rows as a dwell; views, no copies."""
    return Dwell(
        position=number,
        first_row=table.line_of(rows.start),
        **declared | {name: values[rows] for name, values in table.series.items()},
    )


def _dwells_by_stillness(file: str, recording: Dwell) -> tuple[list[slice], list[str], bool]:
    """Dwells of a continuous recording, what was found, and whether it is a free turn."""
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
            raise table.fail(row, f"more than {counted(MOST_DWELLS, 'position')}: divide the file")
        seen[number] = table.line_of(row)
        numbers.append(number)
        starts.append(row)
    ends = [*starts[1:], len(table)]
    return numbers, [slice(a, b) for a, b in zip(starts, ends, strict=True)]


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
    table: SamplesTable,
    name: str,
    slices: list[slice],
    parse: Callable[[SamplesTable, str], Any],
    said: _Remarks,
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
    ends = [*(rows.start for rows in slices), len(table)]
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
    table: SamplesTable,
    name: str,
    texts: list[tuple[int, str]],
    parse: Callable[[SamplesTable, str], Any],
) -> Any:
    """Value of a dwell out of its texts; None without any."""
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


def _angle(table: SamplesTable, text: str) -> float:
    try:
        value = table.number("angle_deg", text)
    except ValueError:
        raise ValueError("is not an angle in degrees") from None
    if not abs(value) <= COLUMNS["angle_deg"].largest:
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
