"""Samples CSVs as loggers and people keep them: angles once a dwell, ISO times, text before the header."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import DataError
from adis_gonio.fleet import record_of
from adis_gonio.model.records import Session
from adis_gonio.record.samples_reader import read_samples_csv
from adis_gonio.record.samples_writer import write_samples_csv

RATE_HZ = 50
DWELL_S, MOVE_S = 2, 1
STEP_DEG = 60
DWELLS = 6

Row = dict[str, str]


def recording(noted: Callable[[int, int, int], bool]) -> list[Row]:
    """Rows of a turn with rests, without `position`.

    Parameters
    ----------
    noted : callable
        Whether a row states the dwell's angle: number of the dwell, row of the dwell, rows of the dwell.
    """
    rng = np.random.default_rng(1)
    rows: list[Row] = []

    def add(angle_deg: float, stated: str, use: str = "") -> None:
        x, y = 1000 * np.cos(np.radians(angle_deg)), -1000 * np.sin(np.radians(angle_deg))
        x, y = np.array([x, y]) + rng.normal(0, 1.5, 2)
        time_s = f"{len(rows) / RATE_HZ:.2f}"
        rows.append({"time_s": time_s, "angle_deg": stated, "ax": f"{x:.3f}", "ay": f"{y:.3f}", "use": use})

    for dwell in range(DWELLS):
        for k in range(MOVE_S * RATE_HZ if dwell else 0):
            add(STEP_DEG * (dwell - 1 + (k + 1) / (MOVE_S * RATE_HZ)), "")
        count = DWELL_S * RATE_HZ
        for k in range(count):
            stated = noted(dwell, k, count)
            add(STEP_DEG * dwell, str(STEP_DEG * dwell) * stated, "check" if stated and dwell == 2 else "")
    return rows


def write(path: Path, rows: list[Row], before: str = "") -> Path:
    lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
    path.write_text(before + "# accel_unit: mg\n" + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def on_first(dwell: int, k: int, count: int) -> bool:
    return k == 0


def angles(session: Session) -> list[float | None]:
    return [dwell.angle_deg for dwell in session.dwells]


def note(session: Session, word: str) -> str:
    (found,) = [text for text in session.notes if word in text]
    return found


DECLARED = [STEP_DEG * k for k in range(DWELLS)]


def test_values_on_the_first_row_of_each_dwell_are_filled_down_and_it_is_said(tmp_path):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(on_first)))
    assert angles(session) == DECLARED
    assert [dwell.use for dwell in session.dwells] == ["fit", "fit", "check", "fit", "fit", "fit"]
    said = note(session, "filled down")
    assert "angle_deg in 6 of 6 dwells" in said
    assert "use in 1 of 6" in said


def test_values_in_the_middle_of_a_dwell_count_for_all_of_it(tmp_path):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(lambda _, k, count: k == count // 2)))
    assert angles(session) == DECLARED
    assert "angle_deg" in note(session, "other rows")


def test_values_in_every_row_need_no_note(tmp_path):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(lambda *_: True)))
    assert angles(session) == DECLARED
    assert not [text for text in session.notes if "angle_deg" in text]


def test_values_on_the_last_row_of_each_dwell_go_to_no_other_dwell(tmp_path):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(lambda _, k, count: k == count - 1)))
    assert angles(session) == [None] * DWELLS
    assert "angle_deg" in note(session, "not used")


def test_a_dwell_without_a_value_has_none(tmp_path):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(lambda d, k, _: k == 0 and d != 3)))
    assert angles(session) == [None if k == 3 else angle for k, angle in enumerate(DECLARED)]
    assert "5 of 6" in note(session, "filled down")


def test_a_value_where_no_dwell_was_found_is_counted(tmp_path):
    rows = recording(on_first)
    rows[-1]["angle_deg"] = "360"
    assert "1 value " in note(read_samples_csv(write(tmp_path / "a.csv", rows)), "no dwell was found")


def test_two_values_within_a_dwell_are_refused(tmp_path):
    rows = recording(lambda _, k, __: k in (0, 50))
    rows[51]["angle_deg"] = "7"
    with pytest.raises(DataError, match=r"row 54: angle_deg changes within a dwell from 0.0 to 7.0"):
        read_samples_csv(write(tmp_path / "a.csv", rows))


def test_empty_cells_of_a_position_have_its_value(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_s,position,angle_deg,ax,ay\n0,0,10,1,2\n1,0,,1,2\n2,1,90,1,2\n3,1,,1,2\n")
    session = read_samples_csv(path)
    assert angles(session) == [10, 90]
    assert "angle_deg" in note(session, "other rows")


def test_an_empty_temperature_is_named_with_its_row(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_s,position,ax,ay,temp_c\n0,0,1,2,25\n1,0,1,2,\n")
    with pytest.raises(
        DataError, match="row 3: column 'temp_c': empty; fill it, or drop its row or column"
    ):
        read_samples_csv(path)


@pytest.mark.parametrize(
    "form",
    [
        "{:%Y-%m-%d %H:%M:%S.%f}",
        "{:%Y-%m-%dT%H:%M:%S.%f}",
        "{:%Y-%m-%dT%H:%M:%S.%f}Z",
        "{:%Y-%m-%d %H:%M:%S.%f}+02:00",
        "{:%Y-%m-%d %H:%M:%S.%f} +0200",
    ],
)
def test_times_of_the_wall_clock_are_read(tmp_path, form):
    rows = recording(lambda *_: True)
    plain = read_samples_csv(write(tmp_path / "a.csv", rows))
    began = datetime(2026, 11, 24, 23, 59, 58, 123_000)
    for row in rows:
        row["time_s"] = form.format(began + timedelta(seconds=float(row["time_s"])))
    session = read_samples_csv(write(tmp_path / "b.csv", rows))
    for here, there in zip(session.dwells, plain.dwells, strict=True):
        np.testing.assert_allclose(here.time_s, there.time_s, rtol=0, atol=1e-9)
    assert "2026-11-24 23:59:58.123" in note(session, "counted from")
    hours = 2 if "+02" in form else 0
    utc = (began - timedelta(hours=hours)).replace(tzinfo=UTC)
    assert record_of(tmp_path / "b.csv").when == utc.isoformat(timespec="seconds")  # a history needs it
    assert record_of(tmp_path / "a.csv").when is None


def test_times_of_the_wall_clock_in_a_file_with_decimal_commas(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "Zeit (UTC);position;ax;ay\n2026-11-24T10:00:00,5;0;1,25;2,5\n2026-11-24T10:00:01,75;0;1,25;2,5\n"
    )
    assert read_samples_csv(path).dwells[0].time_s.tolist() == [0.0, 1.25]


@pytest.mark.parametrize("wrong", ["2026-11-24T10:00:01Z", "1.5", "2026-11-24", "2026-13-24T10:00:01"])
def test_a_time_of_another_kind_is_named_with_its_row(tmp_path, wrong):
    path = tmp_path / "a.csv"
    path.write_text(f"time,position,ax,ay\n2026-11-24T10:00:00,0,1,2\n{wrong},0,1,2\n")
    with pytest.raises(DataError, match=rf"row 3: column 'time_s': '{re.escape(wrong)}'"):
        read_samples_csv(path)


def test_repeated_times_are_counted_and_the_first_is_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time_s,position,ax,ay\n0,0,1,2\n1,0,1,2\n1,0,1,2\n2,0,1,2\n2,0,1,2\n")
    said = note(read_samples_csv(path), "time of the row before")
    assert "2 of 5 rows" in said
    assert "row 4" in said


@pytest.mark.parametrize(
    "before",
    [
        "ADIS16354 ready\nCalibrating...\n",
        ".012,3,1000\n",
        "\n\nrst:0x1 (POWERON), boot: 0x13\nax\n",
        "0 1 2\n",
    ],
)
def test_text_before_the_header_is_skipped_and_shown(tmp_path, before):
    rows = recording(lambda *_: True)
    plain = read_samples_csv(write(tmp_path / "a.csv", rows))
    session = read_samples_csv(write(tmp_path / "b.csv", rows, before))
    assert angles(session) == angles(plain)
    assert session.accel_unit == "mg"
    said = note(session, "before the header")
    assert before.strip().splitlines()[0] in said
    assert f"row {before.count(chr(10)) + 2}" in said


def test_rows_keep_their_numbers_behind_a_preamble(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("ADIS16354 ready\ntime_s,position,ax,ay\n0,0,1,2\n1,0,x,2\n")
    with pytest.raises(DataError, match="row 4: column 'ax'"):
        read_samples_csv(path)


@pytest.mark.parametrize(
    "before",
    [
        "\n <!DOCTYPE html>\n",
        "<!-- saved from url=(0031)https://example.org/log -->\n<!-- x -->\n",
        '<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE html PUBLIC "-//W3C//DTD XHTML">\n',
    ],
)
def test_a_web_page_is_called_one(tmp_path, before):
    path = tmp_path / "a.csv"
    path.write_text(f"{before}<html><body>time_s,ax,ay</body></html>\n")
    with pytest.raises(DataError, match="HTML page"):
        read_samples_csv(path)


SIGNS = "=+-@＝＋－＠"


@pytest.mark.parametrize(
    "text",
    [
        "a,=1+1",
        'x","=1',
        "a;@SUM(A1)",
        "a, '-1",
        "a,''=1",
        "=1",
        "a,\t=1",
        "a,=b,=c",
        "a|+1",
        "-1, it's",
        ",＝1",
    ],
)
def test_no_exported_line_begins_a_formula_and_the_text_comes_back(tmp_path, text):
    session = read_samples_csv(write(tmp_path / "a.csv", recording(lambda *_: True)))
    session = Session(session.dwells, accel_unit="mg", title=text, notes=(text,))
    path = tmp_path / "b.csv"
    write_samples_csv(session, path)
    head = [line for line in path.read_text("utf-8").splitlines() if line.startswith("#")]
    for delimiter in ",;\t|":
        for cells in csv.reader(head, delimiter=delimiter):
            assert not [cell for cell in cells if cell.strip(" \"'") and cell.lstrip()[:1] in SIGNS]
    again = read_samples_csv(path)
    plain = " ".join(text.split())
    assert (again.title, again.notes[0]) == (plain, plain)
