import gzip
import math
import time

import numpy as np
import pytest

from adis_gonio import fit
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.loading import Overrides, load_session
from adis_gonio.record.samples_reader import read_samples_csv
from adis_gonio.record.samples_writer import write_samples_csv

HEADER = "time_s,position,angle_deg,ax,ay"
ROWS = ["0,0,0,2000,100", "0.1,0,0,2001,101", "0.2,1,90,99,-2002", "0.3,1,90,98,-2001"]


def write(tmp_path, *lines, name="s.csv"):
    path = tmp_path / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def refused(path):
    with pytest.raises(DataError) as caught:
        load_session(path)
    message = str(caught.value)
    assert "\n" not in message
    assert path.name in message
    return message


def test_defaults_are_those_of_the_format(tmp_path):
    session = read_samples_csv(write(tmp_path, HEADER, *ROWS))
    assert (session.sensor, session.accel_unit, session.gyro_unit, session.plane) == (
        "adis16354", "lsb", "dps", "xy",
    )  # fmt: skip
    assert session.gravity_mps2 == 9.80665
    assert session.fixture_sigma_deg is None
    assert session.reading_u_mg is None
    assert session.notes == ()
    first, second = session.dwells
    assert (first.position, first.angle_deg, first.use, first.approach) == (0, 0.0, "fit", 0)
    assert (second.position, second.angle_deg) == (1, 90.0)
    np.testing.assert_array_equal(first.accel, [[2000, 100], [2001, 101]])
    np.testing.assert_array_equal(second.time_s, [0.2, 0.3])
    assert first.gyro is None


def test_rows_without_a_position_are_the_turns_between_the_dwells(tmp_path):
    assert read_samples_csv(write(tmp_path, HEADER, *ROWS)).turns == ()
    between = [f"{time},,,1500,-900" for time in (0.13, 0.16)]
    session = read_samples_csv(write(tmp_path, HEADER, *ROWS[:2], *between, *ROWS[2:]))
    (turn,) = session.turns
    assert (turn.before, turn.position) == (0, 1)
    np.testing.assert_array_equal(turn.time_s, [0.13, 0.16])
    np.testing.assert_array_equal(turn.accel, [[1500, -900]] * 2)
    write_samples_csv(session, tmp_path / "again.csv")
    (again,) = read_samples_csv(tmp_path / "again.csv").turns
    np.testing.assert_array_equal(again.time_s, turn.time_s)
    np.testing.assert_array_equal(again.accel, turn.accel)


def test_every_key_and_column_is_read(tmp_path):
    session = read_samples_csv(
        write(
            tmp_path,
            "# title: a title: with a colon",
            "#sensor:generic",
            "# just a remark",
            "# gravity_mps2: 9.81",
            "# fixture_sigma_deg: free",
            "# plane: none",
            "# accel_unit: counts",
            "# gyro_unit: radps",
            "# reading_u_mg: 0.25",
            "# bias_instability_mg: 0.04",
            "# colour: red",
            "use,time_s,position,angle_deg,approach,ax,ay,az,gx,gy,gz,temp_c,supply_v",
            "fit,0,7,,+1,1,2,3,4,5,6,25,5",
            "check,1,8,-90.5,-1,1,2,3,4,5,6,26,5.1",
            ",2,9,1,,1,2,3,4,5,6,26,5.1",
        )
    )
    assert (session.title, session.sensor, session.plane) == ("a title: with a colon", "generic", "none")
    assert session.gravity_mps2 == 9.81
    assert math.isinf(session.fixture_sigma_deg)
    assert session.free_attitudes
    assert (session.accel_unit, session.gyro_unit) == ("counts", "radps")
    assert (session.reading_u_mg, session.bias_instability_mg) == (0.25, 0.04)
    assert len(session.notes) == 1
    assert "colour" in session.notes[0]
    a, b, c = session.dwells
    assert (a.position, a.angle_deg, a.approach, a.use) == (7, None, 1, "fit")
    assert (b.position, b.angle_deg, b.approach, b.use) == (8, -90.5, -1, "check")
    assert (c.approach, c.use) == (0, "fit")
    np.testing.assert_array_equal(b.gyro, [[4, 5, 6]])
    assert b.temperature_c[0] == 26
    assert b.supply_v[0] == 5.1


@pytest.mark.parametrize(
    ("line", "row", "words"),
    [
        ("0.1,0,0,abc,101", 3, "'abc' is not a number"),
        ("0.1,0,0,,101", 3, "empty"),
        ("0.1,0,0,nan,101", 3, "not a finite number"),
        ("0.1,0,0,inf,101", 3, "not a finite number"),
        ("0.1,0,0,1_000,101", 3, "'1_000' is not a number"),
        ("-0.1,0,0,2000,101", 3, "time_s goes back"),
        ("0.1,0,0,2000", 3, "4 values where the header has 5"),
        ("", 3, "empty row"),
        ("0.1,0,5,2000,101", 3, "angle_deg changes within a dwell"),
        ("0.1,0,x,2000,101", 3, "is not an angle"),
        ("0.1,zero,0,2000,101", 3, "is not an integer"),
        ("0.1,1e300,0,2000,101", 3, "is not an integer"),
        ("0.1,0,1e300,2000,101", 3, "is not an angle"),
        ("0.1,0,0,-1e308,101", 3, "too large"),
        ("0.1,0,0,-1e11,101", 3, "too large"),
    ],
)
def test_a_bad_row_is_named(tmp_path, line, row, words):
    message = refused(write(tmp_path, HEADER, ROWS[0], line, *ROWS[2:]))
    assert f"row {row}:" in message
    assert words in message


def test_a_dwell_with_rows_of_no_position_inside_is_named(tmp_path):
    lines = [f"{k / 10},{p},0,1,2" for k, p in enumerate([0, 0, "", 0, 1])]
    message = refused(write(tmp_path, HEADER, *lines))
    assert "row 5: position 0 occurs again" in message


def test_shuffled_positions_are_named(tmp_path):
    lines = [f"{k / 10},{p},{90 * p},1,2" for k, p in enumerate([0, 0, 1, 0, 1])]
    message = refused(write(tmp_path, HEADER, *lines))
    assert "row 5: position 0 " in message
    assert "contiguous" in message


def test_use_that_changes_within_a_dwell_is_refused(tmp_path):
    message = refused(write(tmp_path, HEADER + ",use", "0,0,0,1,2,fit", "1,0,0,1,2,check"))
    assert "row 3: use changes" in message
    assert "neither 'fit' nor" in refused(write(tmp_path, HEADER + ",use", "0,0,0,1,2,later"))


def test_an_angle_written_in_two_ways_is_the_same_angle(tmp_path):
    session = read_samples_csv(write(tmp_path, HEADER, "0,0,90,1,2", "1,0,90.0,3,2"))
    assert session.dwells[0].angle_deg == 90


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("sensor", "adis16000"),
        ("plane", "yz"),
        ("accel_unit", "furlong"),
        ("gyro_unit", "rpm"),
        ("gravity_mps2", "heavy"),
        ("gravity_mps2", "-9.8"),
        ("fixture_sigma_deg", "-1"),
        ("fixture_sigma_deg", "loose"),
        ("reading_u_mg", "0"),
        ("reading_u_mg", "1e300"),
        ("bias_instability_mg", "0"),
        ("gravity_mps2", "1e-300"),
        ("fixture_sigma_deg", "1e300"),
    ],
)
def test_an_unknown_value_of_a_key_is_named(tmp_path, key, value):
    message = refused(write(tmp_path, "# title: x", f"# {key}: {value}", HEADER, *ROWS))
    assert f"row 2: {key} '{value}' is not known" in message


@pytest.mark.parametrize("missing", ["time_s", "ax", "ay"])
def test_a_missing_column_is_named(tmp_path, missing):
    names = HEADER.split(",")
    keep = [k for k, name in enumerate(names) if name != missing]
    lines = [",".join(line.split(",")[k] for k in keep) for line in [HEADER, *ROWS]]
    assert f"column '{missing}' is missing" in refused(write(tmp_path, *lines))


def test_space_needs_az_and_a_generic_sensor_a_unit(tmp_path):
    assert "column 'az' is missing" in refused(write(tmp_path, "# plane: none", HEADER, *ROWS))
    assert "accel_unit 'lsb'" in refused(write(tmp_path, "# sensor: generic", HEADER, *ROWS))


def test_unknown_columns_are_ignored_by_name_and_doubled_ones_refused(tmp_path):
    session = load_session(write(tmp_path, HEADER + ",colour", "0,0,0,1,2,red"))
    assert session.notes == ("columns that were ignored: colour",)
    assert "'ax' occurs twice" in refused(write(tmp_path, HEADER + ",ax", "0,0,0,1,2,3"))


def test_of_two_columns_for_one_the_formats_own_name_counts_or_the_user_has_to_say(tmp_path):
    for header in ("time_ms,time_s,ax,ay,position", "time_s,time_ms,ax,ay,position"):
        (dwell,) = load_session(write(tmp_path, header, "0.5,0.5,1,2,0", "0.75,0.75,1,2,0")).dwells
        np.testing.assert_array_equal(dwell.time_s, [0.5, 0.75])
    doubled = write(tmp_path, "time_ms,t [s],ax,ay,position", "500,0.5,1,2,0", "750,0.75,1,2,0")
    assert "both 'time_ms' and 't [s]' may be time_s; say which: --columns" in refused(doubled)
    for name in ("time", "time_s"):  # the header states the unit, whatever the user calls the column
        for column in ("time_ms", "t [s]"):
            (dwell,) = load_session(doubled, Overrides(columns={name: column})).dwells
            np.testing.assert_allclose(dwell.time_s, [0.5, 0.75])


def test_axes_that_the_user_exchanges_keep_the_units_of_their_columns(tmp_path):
    path = write(tmp_path, "time_s,ay_mg,ax_mg,position", "0,1,2,0", "1,1,2,0")
    exchanged = load_session(path, Overrides(columns={"ax": "ay_mg", "ay": "ax_mg"}))
    assert exchanged.accel_unit == "mg"
    np.testing.assert_array_equal(exchanged.dwells[0].accel, [[1, 2]] * 2)


def test_files_of_another_kind_are_refused(tmp_path):
    binary = tmp_path / "x.bin"
    binary.write_bytes(bytes(range(256)) * 20)
    assert "not a samples CSV" in refused(binary)
    nul = tmp_path / "n.csv"
    nul.write_bytes(b"time_s,ax,ay\n\x00\x00\n")
    assert "binary" in refused(nul)
    empty = tmp_path / "empty.csv"
    empty.write_bytes(b"")
    assert "empty" in refused(empty)
    assert "not a samples CSV" in refused(write(tmp_path, '{"json": 1}', "x"))
    assert "followed by no sample" in refused(write(tmp_path, HEADER))
    assert "no header" in refused(write(tmp_path, "# title: nothing"))
    with pytest.raises(DataError, match="no such file"):
        load_session(tmp_path / "absent.csv")
    with pytest.raises(DataError, match="folder"):
        load_session(tmp_path)


def test_damaged_gzip_is_refused(tmp_path):
    whole = gzip.compress(("\n".join([HEADER, *ROWS * 1]) + "\n").encode())
    cut = tmp_path / "cut.csv.gz"
    cut.write_bytes(whole[:-12])
    assert "damaged or truncated gzip" in refused(cut)
    broken = tmp_path / "broken.csv.gz"
    broken.write_bytes(whole[:20] + b"\xff\xff" + whole[22:])
    assert "damaged or truncated gzip" in refused(broken)


def test_bom_and_crlf_do_no_harm(tmp_path):
    path = tmp_path / "dos.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(["# sensor: adis16350", HEADER, *ROWS]).encode())
    session = read_samples_csv(path)
    assert session.sensor == "adis16350"
    assert len(session.dwells) == 2


@pytest.mark.parametrize("name", ["r.csv", "r.csv.gz"])
def test_what_is_written_is_read_back_unchanged(tmp_path, name):
    rng = np.random.default_rng(1)

    def dwell(k, **more):
        return Dwell(
            position=3 * k,
            time_s=k * 10 + np.cumsum(rng.uniform(1e-3, 2e-3, 50)),
            accel=rng.normal(0, 1000, (50, 3)),
            gyro=rng.normal(0, 1, (50, 3)),
            temperature_c=rng.normal(25, 1, 50),
            supply_v=rng.normal(5, 0.01, 50),
            **more,
        )

    session = Session(
        dwells=(
            dwell(0, angle_deg=0.1, approach=1),
            dwell(1, angle_deg=None, approach=-1),
            dwell(2, angle_deg=-720.25, use="check"),
        ),
        sensor="adis16355",
        accel_unit="mg",
        gyro_unit="radps",
        gravity_mps2=9.80123,
        fixture_sigma_deg=0.05,
        reading_u_mg=0.123,
        plane="none",
        title="round trip",
    )
    path = tmp_path / name
    write_samples_csv(session, path)
    again = load_session(path)
    for key in ("sensor", "accel_unit", "gyro_unit", "gravity_mps2", "fixture_sigma_deg", "plane", "title"):
        assert getattr(again, key) == getattr(session, key)
    assert again.reading_u_mg == 0.123
    assert again.notes == ()
    for mine, theirs in zip(session.dwells, again.dwells, strict=True):
        assert (mine.position, mine.angle_deg, mine.approach, mine.use) == (
            theirs.position, theirs.angle_deg, theirs.approach, theirs.use,
        )  # fmt: skip
        for series in ("time_s", "accel", "gyro", "temperature_c", "supply_v"):
            np.testing.assert_array_equal(getattr(mine, series), getattr(theirs, series))


def test_words_are_written_as_integers_and_absent_columns_left_out(tmp_path):
    dwell = Dwell(0, np.array([0.0, 0.5]), np.array([[1.0, -2.0], [3.0, 4.0]]))
    write_samples_csv(Session(dwells=(dwell,), fixture_sigma_deg=math.inf), tmp_path / "w.csv")
    text = (tmp_path / "w.csv").read_text(encoding="utf-8")
    assert text.endswith("time_s,position,ax,ay\n0,0,1,-2\n0.5,0,3,4\n")
    assert "# fixture_sigma_deg: free\n" in text


def test_a_session_that_mixes_columns_cannot_be_written(tmp_path):
    plain = Dwell(0, np.array([0.0]), np.ones((1, 2)))
    warm = Dwell(1, np.array([1.0]), np.ones((1, 2)), temperature_c=np.array([25.0]))
    with pytest.raises(DataError, match="position 0 has no 'temp_c'"):
        write_samples_csv(Session(dwells=(plain, warm)), tmp_path / "m.csv")
    with pytest.raises(DataError, match="no dwell"):
        write_samples_csv(Session(dwells=()), tmp_path / "m.csv")


def test_a_hundred_thousand_rows_load_in_bulk(tmp_path):
    n = 100_000
    t = np.arange(n) / 819.2
    lines = [f"{a:.4f},{k // 10000},{90 * (k // 10000)},{k % 99},{-k % 77},7" for k, a in enumerate(t)]
    path = write(tmp_path, HEADER + ",az", *lines)
    began = time.process_time()
    session = read_samples_csv(path)
    # About 0.25 s; walking the rows one by one takes several seconds.
    assert time.process_time() - began < 1.5
    assert [len(dwell) for dwell in session.dwells] == [10000] * 10


def test_a_continuous_file_becomes_dwells_with_a_note(tmp_path):
    rng = np.random.default_rng(2)
    t = np.arange(3000) / 100
    angle = np.interp(t, [0, 9, 11, 19, 21, 30], [0, 0, 1, 1, 2, 2])
    accel = 1000 * np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 2, (3000, 2))
    lines = [f"{a:.2f},{x:.3f},{y:.3f}" for a, (x, y) in zip(t, accel, strict=True)]
    session = read_samples_csv(write(tmp_path, "# accel_unit: mg", "time_s,ax,ay", *lines))
    assert len(session.dwells) == 3
    assert "3 dwells found by stillness" in session.notes[0]
    assert session.dwells[0].angle_deg is None


def test_a_continuous_file_without_rest_says_so(tmp_path):
    rng = np.random.default_rng(3)
    lines = [f"{k / 100},{x:.3f},{y:.3f}" for k, (x, y) in enumerate(rng.normal(0, 1, (50, 2)))]
    assert "no dwell found" in refused(write(tmp_path, "# accel_unit: mg", "time_s,ax,ay", *lines))


def test_a_continuous_file_that_never_changes_is_named(tmp_path):
    lines = [f"{k / 100},3,4" for k in range(500)]
    assert "stuck data" in refused(write(tmp_path, "# accel_unit: mg", "time_s,ax,ay", *lines))


# -- poses in space without a key ------------------------------------------------------------------

SPACE = [(0.6, 0.0, 0.8), (-0.8, 0.6, 0.0), (0.0, -0.6, -0.8), (0.48, 0.64, -0.6), (0.0, 0.0, 1.0)]


def poses(tmp_path, *keys, readings=SPACE, angles=None):
    """A file with one row per pose; `readings` in g, with declared angles if they are given."""
    rows = [
        f"{k},{k},{1000 * x},{1000 * y},{1000 * z}" + ("" if angles is None else f",{angles[k]}")
        for k, (x, y, z) in enumerate(readings)
    ]
    head = "time_s,position,ax,ay,az" + ("" if angles is None else ",angle_deg")
    return write(tmp_path, "# accel_unit: mg", *keys, head, *rows)


def test_poses_in_space_are_seen_without_the_key_and_said(tmp_path):
    session = load_session(poses(tmp_path))
    assert session.plane == "none"
    assert "poses in space (plane none): az changes" in session.notes[-1]


@pytest.mark.parametrize(
    ("keys", "angles"),
    [(("# plane: xy",), None), ((), [0, 10, 20, 30, 40]), (("# plane: xy",), [0, 1, 2, 3, 4])],
)
def test_a_stated_plane_is_kept_and_the_contradiction_said(tmp_path, keys, angles):
    path = poses(tmp_path, *keys, angles=angles)
    session = load_session(path)
    assert session.plane == "xy"
    assert "write '# plane: none'" in session.notes[-1]
    with pytest.raises(DataError, match=r"lies flat.*write '# plane: none' for poses in space"):
        fit(session)


@pytest.mark.parametrize("drift_g", [0.0, 0.2])
def test_a_turn_in_the_plane_stays_one_though_z_drifts_or_the_part_is_skewed(tmp_path, drift_g):
    angles = np.radians(np.arange(0, 360, 45))
    turn = [(np.cos(a), np.sin(a), 0.2 * np.sin(a) + drift_g * k / 8) for k, a in enumerate(angles)]
    assert load_session(poses(tmp_path, readings=turn)).plane == "xy"
    resting = [(0.0, 1.0, drift_g * k / 8) for k in range(8)]
    assert load_session(poses(tmp_path, readings=resting)).plane == "xy"


def test_prose_above_unknown_columns_is_not_taken_for_the_header(tmp_path):
    prose = ["My log of Tuesday, made with a very good logger", "Operator, Jane Doe, at the bench"]
    path = write(tmp_path, *prose, "t,X,Y,which", "0,9.215,3.354,0", "60,3.355,-9.214,1")
    with pytest.raises(DataError, match=r"row 3: .*--columns 'ax=X,ay=Y'"):
        read_samples_csv(path)
    wanted = {"time_s": "t", "ax": "X", "ay": "YY"}
    with pytest.raises(UsageError, match="there are 't', 'X', 'Y', 'which'"):
        read_samples_csv(path, Overrides(columns=wanted))
