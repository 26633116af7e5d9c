"""CSV that people have: whoever wrote it, the numbers are the same, or the true cause is named."""

import csv
import gzip
import io
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings, strategies as st

from adis_gonio.base.errors import DataError
from adis_gonio.record.loading import Overrides, load_session
from adis_gonio.record.samples_columns import recognise_column

FRAME = pd.DataFrame(
    {
        "time_s": [0.0, 0.125, 1000.5, 1000.625],
        "position": [0, 0, 1, 1],
        "angle_deg": [0.0, 0.0, 90.0, 90.0],
        "approach": [1, 1, -1, -1],
        "ax": [1234.567, 1234.5, 1.234, -0.25],
        "ay": [-12.0, 1e-3, 998.001, 1.0],
    }
)


def assert_is_frame(session, frame=FRAME):
    names = list(frame.groupby("position", sort=False).groups)
    assert [d.position for d in session.dwells] == names
    for dwell, (_, rows) in zip(session.dwells, frame.groupby("position", sort=False), strict=True):
        np.testing.assert_allclose(dwell.time_s, rows["time_s"], rtol=1e-15)
        np.testing.assert_array_equal(dwell.accel, rows[["ax", "ay"]])
        assert dwell.angle_deg == pytest.approx(rows["angle_deg"].iloc[0], rel=1e-14)
        assert dwell.approach == rows["approach"].iloc[0]


def saved(tmp_path, data, name="s.csv"):
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


def refusal(path, overrides=None):
    with pytest.raises(DataError) as caught:
        load_session(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert path.name in message
    return message


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "cp1252"])
@pytest.mark.parametrize(("sep", "decimal"), [(",", "."), (";", ","), (";", "."), ("\t", ","), ("\t", ".")])
def test_what_pandas_writes(tmp_path, sep, decimal, encoding):
    path = tmp_path / "p.csv"
    FRAME.to_csv(path, sep=sep, decimal=decimal, index=False, encoding=encoding, lineterminator="\r\n")
    assert_is_frame(load_session(path))


@pytest.mark.parametrize("quoting", [csv.QUOTE_ALL, csv.QUOTE_NONNUMERIC, csv.QUOTE_MINIMAL])
@pytest.mark.parametrize(("sep", "decimal"), [(",", "."), (",", ","), (";", ",")])
def test_quoted_cells_with_decimal_commas_between_commas_too(tmp_path, sep, decimal, quoting):
    path = tmp_path / "q.csv"
    texts = FRAME.astype(object).map(lambda cell: str(cell).replace(".", decimal))
    texts.to_csv(path, sep=sep, index=False, quoting=quoting)
    assert_is_frame(load_session(path))


def test_the_index_column_that_pandas_adds_is_ignored_and_named(tmp_path):
    path = tmp_path / "i.csv"
    FRAME.to_csv(path)
    session = load_session(path)
    assert_is_frame(session)
    assert session.notes == ("columns that were ignored: column 1",)


def test_aligned_by_spaces_and_what_numpy_savetxt_writes(tmp_path):
    aligned = tmp_path / "a.txt"
    aligned.write_text(FRAME.to_string(index=False) + "\n", encoding="utf-8")
    again = pd.read_csv(io.StringIO(FRAME.to_string(index=False)), sep=r"\s+")
    assert_is_frame(load_session(aligned), again)
    plain = tmp_path / "n.txt"
    np.savetxt(plain, FRAME.to_numpy(), header=" ".join(FRAME.columns), fmt="%.17g")
    assert_is_frame(load_session(plain))


EXCEL = (
    "sep=;\r\n"
    '# title: Prüfling 7; zweiter Tag;;;\r\n"# operator: A; B";;;;;\r\n'
    "# gravity_mps2: 9,81;;;;;\r\n# fixture_sigma_deg:;;;;;\r\n"
    "Zeit [ms];POS;Winkel (°);approach;Acc_X (m/s²);Acc_Y (m/s²)\r\n"
    "0;0;0,0;1;9,81;0,01\r\n"
    "125;0;0,0;1;9,79;0,02\r\n"
    "1000500;1;90,0;-1;0,1;-9,8\r\n" + ";;;;;\r\n" * 3000
)


@pytest.mark.parametrize("gap", [" ", "   ", "\t "])
@pytest.mark.parametrize("mark", ["", '"'])
def test_quoted_names_with_blanks_between_blanks(tmp_path, gap, mark):
    names = ("time [s]", "position", "angle (deg)", "acc x [mg]", "acc y [mg]")
    rows = [(0.01 * k, k // 4, 90 * (k // 4), 1000.0 + k, 2.0 * k) for k in range(8)]
    lines = [gap.join(f'"{name}"' for name in names)]
    lines += [gap.join(f"{mark}{cell}{mark}" for cell in row) for row in rows]
    session = load_session(saved(tmp_path, "\n".join(lines).encode() + b"\n"))
    assert [dwell.angle_deg for dwell in session.dwells] == [0, 90]
    assert np.concatenate([d.accel for d in session.dwells]).tolist() == [[x, y] for *_, x, y in rows]


def test_a_german_excel_file(tmp_path):
    session = load_session(saved(tmp_path, EXCEL.encode("cp1252")))
    assert (session.accel_unit, session.gravity_mps2, session.fixture_sigma_deg) == ("mps2", 9.81, None)
    assert session.operator == "A; B"
    first, second = session.dwells
    np.testing.assert_array_equal(first.time_s, [0.0, 0.125])
    np.testing.assert_array_equal(first.accel, [[9.81, 0.01], [9.79, 0.02]])
    assert (second.time_s[0], second.angle_deg, second.approach) == (1000.5, 90.0, -1)
    assert any(
        "time_s from 'Zeit [ms]'" in note and "ax from 'Acc_X (m/s²)'" in note for note in session.notes
    )


@pytest.mark.parametrize("sign", ["1,0", "1.0", "+1"])
@pytest.mark.parametrize("mark", [",", "."])
def test_a_sign_may_have_either_decimal_mark(tmp_path, sign, mark):
    text = f"time [ms];position;approach;ax;ay\n0;1;{sign};2000{mark}5;5\n1;2;-{sign.lstrip('+')};3;2005\n"
    assert [dwell.approach for dwell in load_session(saved(tmp_path, text.encode())).dwells] == [1, -1]


@pytest.mark.parametrize("celsius", ["299", "1e6", "-999"])
def test_a_temperature_of_no_part_is_refused_with_its_likely_cause(tmp_path, celsius):
    text = f"time_s,position,ax,ay,temp_c\n0,1,1000,5,25\n1,2,3,1000,{celsius}\n"
    with pytest.raises(DataError, match=r"row 3: column 'temp_c': .* °C is no temp.*kelvin .*'temp \[K\]'"):
        load_session(saved(tmp_path, text.encode()))
    kelvin = text.replace("temp_c", "temp [K]").replace(celsius, "299").replace(",25\n", ",298.15\n")
    warm = load_session(saved(tmp_path, kelvin.encode())).dwells[1].temperature_c
    np.testing.assert_allclose(warm, 25.85)


def test_a_unit_in_the_header_that_contradicts_its_key_is_refused_unless_the_user_gives_it(tmp_path):
    text = "# accel_unit: mg\n# sensor: generic\ntime_s,position,ax [g],ay [g]\n0,1,1,0\n1,2,0,1\n"
    message = refusal(saved(tmp_path, text))
    assert (
        "row 3: the header says accelerations in g, the line '# accel_unit: mg' states another" in message
    )
    assert load_session(saved(tmp_path, text), Overrides(accel_unit="g")).accel_unit == "g"
    assert load_session(saved(tmp_path, text.replace(": mg", ": g"))).accel_unit == "g"
    rates = "# gyro_unit: dps\ntime_s,position,ax,ay,gx [rad/s],gy [rad/s],gz [rad/s]\n0,1,1,0,0,0,0\n"
    message = refusal(saved(tmp_path, rates), Overrides(accel_unit="g"))
    assert "row 2: the header says rates in radps" in message


def test_extra_columns_are_ignored_with_a_note_that_names_them(tmp_path):
    text = "time_s,Temp. [bar],ax,ay,position,comment\n0,1,2,3,0,hello\n1,1,2,4,0,\n"
    session = load_session(saved(tmp_path, text))
    assert session.notes[0] == "columns that were ignored: Temp. [bar], comment" or any(
        "Temp. [bar]" in note and "ignored" in note for note in session.notes
    )
    assert any("comment" in note for note in session.notes)


def test_a_position_in_mm_is_no_number_of_a_dwell(tmp_path):
    rng = np.random.default_rng(1)
    rows = "".join(
        f"{k / 100},7,{x},{y}\n" for k, (x, y) in enumerate(rng.normal(1, 0.01, (300, 2)).tolist())
    )
    session = load_session(saved(tmp_path, "Time_s,Position [mm],ax [g],ay [g]\n" + rows))
    assert "column 'Position [mm]' was ignored: position has no unit" in session.notes
    assert session.cut_by_stillness


@pytest.mark.parametrize("name", ["Time_s", "TIME_S"])
def test_a_time_in_seconds_in_capitals_states_its_unit(tmp_path, name):
    session = load_session(saved(tmp_path, f"{name},position,AX,AY\n0,0,1,2\n60,0,3,4\n"))
    assert session.notes == ()


def test_a_near_miss_among_ignored_columns_is_asked_about(tmp_path):
    session = load_session(saved(tmp_path, "time_s,position,angel_deg,ax,ay\n0,0,90,1,2\n"))
    assert "is the ignored column 'angel_deg' meant to be angle_deg?" in session.notes


@pytest.mark.parametrize("end", ["", "\n"])
@pytest.mark.parametrize("tail", ["2,0,5", "2,0", "2"])
def test_a_cut_last_line_is_ignored_with_a_note(tmp_path, tail, end):
    session = load_session(saved(tmp_path, "time_s,position,ax,ay\n0,0,1,2\n1,0,3,4\n" + tail + end))
    assert len(session.dwells[0]) == 2
    assert session.notes == ("row 4 is the last one and was cut short: it was ignored",)


@pytest.mark.parametrize("tail", ["2,0,5,", "2,0,5,-", "2,0,5,1e", '2,0,5,"6', "2,0,5,6.5E+"])
def test_a_last_line_that_ends_within_a_number_is_cut_too(tmp_path, tail):
    session = load_session(saved(tmp_path, "time_s,position,ax,ay\n0,0,1,2\n1,0,3,4\n" + tail))
    assert len(session.dwells[0]) == 2
    assert session.notes == ("row 4 is the last one and was cut short: it was ignored",)


def test_a_short_line_that_is_not_the_last_is_refused(tmp_path):
    assert "row 3: 2 values where the header has 4" in refusal(
        saved(tmp_path, "time_s,position,ax,ay\n0,0,1,2\n1,0\n2,0,3,4\n")
    )


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r", "\r\r\n"])
def test_every_line_end_trailing_commas_comments_and_empty_rows_at_the_end(tmp_path, ends):
    lines = [
        "# accel_unit: mg", "time_s,position,ax,ay,", "0,0,1,2,", "# a remark", "1,0,3,4,,,", "2,0,5,6", "",
        ",,,", "",
    ]  # fmt: skip
    session = load_session(saved(tmp_path, ends.join(lines).encode()))
    np.testing.assert_array_equal(session.dwells[0].accel, [[1, 2], [3, 4], [5, 6]])
    assert session.notes == ()


def test_a_row_is_named_by_its_line_however_many_were_skipped(tmp_path):
    text = "time_s,position,ax,ay\n0,0,1,2\n# a\n# b\n1,0,3,4\n#c\n2,0,x,4\n"
    assert "row 7: column 'ax': 'x' is not a number" in refusal(saved(tmp_path, text))
    session = load_session(saved(tmp_path, text.replace("2,0,x", "2,1,5")))
    assert [len(d) for d in session.dwells] == [2, 1]


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("time_s", 1),
        ("Time (s)", 1),
        ("time [ms]", 1e3),
        ("t / µs", 1e6),
        ("time_ms", 1e3),
        ("Zeit [ns]", 1e9),
        ("time [min]", 1 / 60),
    ],
)
def test_units_of_time(tmp_path, header, factor):
    text = f"{header},position,ax,ay\n{0.25 * factor!r},0,1,2\n{0.5 * factor!r},0,3,4\n"
    np.testing.assert_array_equal(load_session(saved(tmp_path, text)).dwells[0].time_s, [0.25, 0.5])


@pytest.mark.parametrize(
    ("header", "cell", "field", "value"),
    [
        ("temp [°C]", "25.85", "temperature_c", 25.85),
        ("temp [K]", "299", "temperature_c", 25.85),
        ("Temperature (°F)", "77", "temperature_c", 25.0),
        ("VDD [mV]", "4990", "supply_v", 4.99),
        ("Winkel / rad", "0.5235987755982988", "angle_deg", 30.0),
        ("turned [rad]", "-0.7853981633974483", "turned_deg", -45.0),
    ],
)
def test_units_of_other_columns(tmp_path, header, cell, field, value):
    text = f"time_s,position,{header},ax,ay\n0,0,{cell},1,2\n"
    (dwell,) = load_session(saved(tmp_path, text)).dwells
    np.testing.assert_allclose(getattr(dwell, field), value, rtol=1e-12)


def test_a_time_without_a_unit_that_may_be_in_ms_is_refused_with_the_remedy(tmp_path):
    path = saved(tmp_path, "time,position,ax,ay\n" + "".join(f"{10 * k},0,{k},2\n" for k in range(20)))
    assert "--columns time_ms=time" in refusal(path)
    session = load_session(path, Overrides(columns={"time_ms": "time"}))
    assert session.dwells[0].time_s[1] == 0.01
    assert load_session(path, Overrides(columns={"time_s": "time"})).dwells[0].time_s[1] == 10
    # Loggers of one row a second are usual, and 2 ms are a usual period of samples in ms.
    for step, refused in ((1, False), (2, True)):
        path = saved(
            tmp_path, "time,position,ax,ay\n" + "".join(f"{step * k},0,{k},2\n" for k in range(20))
        )
        if refused:
            assert "time_ms" in refusal(path)
        else:
            assert load_session(path).dwells[0].time_s[1] == step


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("m/s²", "mps2"), ("m/s^2", "mps2"), ("g", "g"), ("mg", "mg"), ("LSB", "lsb"), ("counts", "counts")],
)
@pytest.mark.parametrize("style", ["ax [{}]", "Acc_X ({})", "ACCEL X [{}]", "a_x / ({})", '"ax ({})"'])
def test_units_of_accelerations_in_the_header(tmp_path, unit, expected, style):
    names = [style.format(unit), style.format(unit).replace("x", "y").replace("X", "Y")]
    text = f"time_s;position;{';'.join(names)}\n0;0;1;2\n1;0;3;4\n"
    session = load_session(saved(tmp_path, text))
    assert session.accel_unit == expected
    assert any(note.startswith("columns were read as") for note in session.notes)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("time_s,position,ax [ft/s²],ay [ft/s²]", "unit 'ft/s²' of column 'ax [ft/s²]' is not known"),
        ("time_s,position,ax [g],ay [mg]", "do not have one unit"),
        ("time_s,position,ax [g],ay", "do not have one unit"),
        ("time_s,position,acc_x,ay,accel_x", "--columns 'ax=accel_x'"),
        ("a,b,c,d", "say which are which, such as --columns 'time=a,ax=b,ay=c'"),
        ("0,0,1,2", "no header row"),
        ("time_s,position,x,y", "--columns 'ax=x,ay=y'"),
    ],
)
def test_a_header_that_does_not_say_it_is_refused_with_what_to_write(tmp_path, header, words):
    cells = header.count(",") + 1
    rows = "".join(",".join([str(k)] * cells) + "\n" for k in range(3))
    assert words in refusal(saved(tmp_path, f"{header}\n{rows}"))


def test_prose_gets_no_proposal_of_columns(tmp_path):
    prose = (
        "Driver and tool for the sensor in a goniometer, a\ndevice that measures, by gravity, its tilt\n"
    )
    assert "--columns" not in refusal(saved(tmp_path, prose))


# --- one reading of a number, or none ------------------------------------------------------------------


def numbers(*cells, sep=";"):
    rows = [sep.join([str(k), "0", cell, "7"]) for k, cell in enumerate(cells)]
    return sep.join(["time_s", "position", "ax", "ay"]) + "\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (["1,234", "0,5"], [1.234, 0.5]),
        (["1.234", "0.5"], [1.234, 0.5]),
        (["1.234", "12.3456"], [1.234, 12.3456]),
        (["1234", "5"], [1234, 5]),
        (["1,5E3", "−2"], [1500, -2]),
    ],
)
def test_the_decimal_mark_is_what_the_whole_file_proves(tmp_path, cells, expected):
    session = load_session(saved(tmp_path, numbers(*cells)))
    np.testing.assert_array_equal(session.dwells[0].accel[:, 0], expected)


@pytest.mark.parametrize(
    ("cells", "wrong"),
    [
        (["1.234", "0,5"], "row 2: column 'ax': '1.234' is not a number in a file with decimal commas"),
        (["1,234", "0.5"], "row 2: column 'ax': '1,234' is not a number in a file with decimal points"),
        (["0.5", "1,234.5"], "row 3: column 'ax': '1,234.5' is not a number in a file with decimal points"),
        (["1.234,5", "1.234"], "row 2: column 'ax': '1.234,5' is not a number in a file with decimal"),
        (["1,234,567", "1,234"], "row 2: column 'ax': '1,234,567' is not a number"),
    ],
)
def test_marks_between_thousands_are_refused_with_row_and_cell(tmp_path, cells, wrong):
    assert wrong in refusal(saved(tmp_path, numbers(*cells)))


@pytest.mark.parametrize("mark", [".", ","])
def test_a_file_without_proof_is_refused_with_the_remedy(tmp_path, mark):
    message = refusal(saved(tmp_path, numbers(f"1{mark}234", f"12{mark}500")))
    assert f"row 2: '1{mark}234' may be 1.234 or 1234" in message
    assert "with decimal points, and with commas between the cells" in message
    assert load_session(saved(tmp_path, numbers("1.234", "12.500", sep=",")))


def test_proof_of_both_marks_is_refused_at_the_first_row_that_disagrees(tmp_path):
    assert "row 3: column 'ax': '2.5' is not a number in a file with decimal commas" in refusal(
        saved(tmp_path, numbers("1,5", "2.5"))
    )


def test_proof_at_the_beginning_of_the_file_counts_to_its_end(tmp_path, monkeypatch):
    monkeypatch.setattr("adis_gonio.record.samples_header.CHUNK", 64)
    assert "row 21: column 'ax': '2,5' is not a number in a file with decimal points" in refusal(
        saved(tmp_path, numbers("1.5", *["7"] * 18, "2,5"))
    )


def test_proof_far_down_the_file_counts(tmp_path, monkeypatch):
    monkeypatch.setattr("adis_gonio.record.samples_header.CHUNK", 1024)
    undecided = ["1,234"] * 200
    session = load_session(saved(tmp_path, numbers(*undecided, "0,5")))
    assert session.dwells[0].accel[0, 0] == 1.234


def test_decimal_commas_between_commas_are_named_as_the_cause(tmp_path):
    message = refusal(saved(tmp_path, "time_s,position,ax,ay\n0,5,0,1,5,2,5\n"))
    assert "decimal commas" in message
    assert "semicolons" in message


# --- what is no CSV ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"PK\x03\x04" + bytes(100), "workbook"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "old Excel workbook"),
        (b"PAR1aaaa", "Parquet"),
        (b"\r\n\r\n;;;\n", "no header row"),
        (b"   \n\t\n", "empty"),
    ],
)
def test_other_kinds_of_files_are_named(tmp_path, data, words):
    assert words in refusal(saved(tmp_path, data))


# --- properties ----------------------------------------------------------------------------------------

_STYLES = {
    "format": ("time_s", "position", "angle_deg", "approach", "a?"),
    "brackets": ("time [s]", "position", "angle [deg]", "approach", "Acc_? [mg]"),
    "round": ("Time (ms)", "Position", "Winkel (°)", "Approach", "Accel ? (mg)"),
    "slash": ("t/s", "pos", "theta / °", "APPROACH", "a_?/mg"),
    "suffix": ("time_ms", "POSITION", "angle", "approach", "a?_mg"),
}
_FLOATS = st.floats(-1e6, 1e6, allow_subnormal=False).map(lambda x: float(f"{x:.6g}"))


@st.composite
def sessions(draw):
    """Rows of a session: time in ms (whole), position, angle, approach, three accelerations."""
    rows, time = [], 0
    for position in range(draw(st.integers(1, 4))):
        angle, approach = draw(st.integers(-360, 360)) / 4, draw(st.sampled_from([1, -1]))
        for _ in range(draw(st.integers(1, 5))):
            time += draw(st.integers(1, 1000))
            rows.append([time, position, angle, approach, *draw(st.tuples(_FLOATS, _FLOATS, _FLOATS))])
    return rows


def _fixed(x: float) -> str:
    """Decimal digits without an exponent, as a spreadsheet has them."""
    text = f"{x:.9f}".rstrip("0").rstrip(".")
    return text if float(text) == x else repr(x)


@settings(max_examples=150)
@given(
    rows=sessions(),
    delimiter=st.sampled_from([",", ";", "\t", " "]),
    decimal=st.sampled_from([".", ","]),
    style=st.sampled_from(sorted(_STYLES)),
    end=st.sampled_from(["\n", "\r\n", "\r", "\r\r\n"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    quoted=st.booleans(),
    zipped=st.booleans(),
    tail=st.integers(0, 3),
)
@example(  # a comma in every number, three digits behind it
    rows=[[1001, 0, 0.0, 1, 1.001, 2.002, 3.003]], delimiter=";", decimal=",", style="round", end="\n",
    encoding="utf-8", quoted=False, zipped=False, tail=0,
)  # fmt: skip
def test_a_session_in_any_dialect_loads_to_the_same_numbers(
    tmp_path_factory, rows, delimiter, decimal, style, end, encoding, quoted, zipped, tail
):
    if delimiter == "," and decimal == ",":
        quoted = True
    if delimiter == " ":  # names and cells cannot hold spaces then
        quoted, style = False, {"round": "brackets", "slash": "suffix"}.get(style, style)
    *first, accel = _STYLES[style]
    names = [*first, *(accel.replace("?", axis) for axis in "xyz")]
    in_ms = "ms" in names[0]
    lines = ["# accel_unit: mg", "# sensor: generic"]
    cells = [names] + [
        [
            str(row[0]) if in_ms else _fixed(row[0] / 1000).replace(".", decimal),
            str(row[1]),
            *(_fixed(x).replace(".", decimal) for x in (row[2], float(row[3]))),
            *(_fixed(x).replace(".", decimal) for x in row[4:]),
        ]
        for row in rows
    ]
    mark = '"' if quoted else ""
    lines += [delimiter.join(f"{mark}{cell}{mark}" for cell in row) for row in cells]
    lines += ["" if delimiter == " " else delimiter * (len(names) - 1)] * tail
    data = (end.join(lines) + end).encode(encoding)
    path = tmp_path_factory.mktemp("d") / "d.csv"
    path.write_bytes(gzip.compress(data) if zipped else data)
    try:
        session = load_session(path)
    except DataError as error:
        # A file in which nothing but 1,234 and the like has a fraction is refused.
        if "no number of the file decides it" not in str(error):
            raise
        return
    got = [
        [t, dwell.position, dwell.angle_deg, dwell.approach, *a]
        for dwell in session.dwells
        for t, a in zip(dwell.time_s, dwell.accel, strict=True)
    ]
    assert got == [[row[0] / 1000, *row[1:]] for row in rows]
    assert session.accel_unit == "mg"


@settings(max_examples=200)
@given(
    mark=st.sampled_from([".", ","]),
    values=st.lists(st.integers(1000, 99_999_999), min_size=1, max_size=8),
    digits=st.integers(0, 4),
)
def test_a_number_is_read_as_it_was_meant_or_refused(tmp_path_factory, mark, values, digits):
    """Whatever digits stand behind the mark: never another number without an error."""
    meant = [value / 10**digits for value in values]
    cells = [f"{x:.{digits}f}".replace(".", mark) for x in meant]
    path = saved(tmp_path_factory.mktemp("n"), numbers(*cells))
    try:
        session = load_session(path)
    except DataError:
        if digits != 3:
            raise
        return
    np.testing.assert_array_equal(session.dwells[0].accel[:, 0], [float(f"{x:.{digits}f}") for x in meant])


def loaded_or_refused(path):
    """Finite numbers, or one line that says why there are none; any other error fails the test."""
    message = ""
    try:
        session = load_session(path)
    except DataError as error:
        message = str(error)
    else:
        assert all(math.isfinite(x) for dwell in session.dwells for x in dwell.accel.ravel())
    assert "\n" not in message


@settings(max_examples=300)
@given(
    data=st.one_of(
        st.binary(max_size=400), st.text(max_size=300).map(lambda t: t.encode("utf-8", "replace"))
    )
)
@example(data=b"time_s,ax,ay\n")
@example(data=b'time_s,ax,ay\n"')
@example(data=b"sep=\ntime_s,ax,ay\n1,2,3")
@example(data=b'sep="\ntime_s,ax,ay\n1,2,3')
@example(data=b"time_s,ax,ay,position\n1e400,2,3,1\n")
@example(data=b"time_s,ax,ay,position\n1,2,3,1e400\n2,3,4,nan\n")
@example(data=b"\xff\xfe\x00\xd8")
@example(data=b"\x1f\x8b\x08\x00")
def test_rubbish_is_refused_in_one_line(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("r") / "r.csv"
    path.write_bytes(data)
    loaded_or_refused(path)


_SOUND = EXCEL[: EXCEL.index(";;;;;\r\n;")].encode("utf-8")


@settings(max_examples=300)
@given(
    place=st.integers(0, len(_SOUND)),
    drop=st.integers(0, 40),
    put=st.one_of(
        st.binary(max_size=6),
        st.text(alphabet='0123456789.,;-+eE"# \n\r\t\x00naif', max_size=8).map(str.encode),
    ),
)
def test_damage_to_a_sound_file_never_ends_in_a_traceback(tmp_path_factory, place, drop, put):
    path = tmp_path_factory.mktemp("m") / "m.csv"
    path.write_bytes(_SOUND[:place] + put + _SOUND[place + drop :])
    loaded_or_refused(path)


def test_a_single_t_is_a_time_or_by_its_unit_a_temperature():
    assert recognise_column("T [°C]") == ("temp_c", "°C", False)
    assert recognise_column("t [K]") == ("temp_c", "K", False)
    assert recognise_column("t [ms]") == ("time_s", "ms", False)
    assert recognise_column("t") == ("time_s", "", False)
