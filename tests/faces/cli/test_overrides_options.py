"""`--gravity --fixture --reverse --unit --sensor --columns`: mended at once, and said in what is made."""

import json

import pytest

from adis_gonio import load_session
from adis_gonio.faces.cli import main
from fakes import planar_session as planar


@pytest.fixture
def backwards(tmp_path):
    """A session whose stage turned the other way than declared, in m/s² that the file calls mg."""
    path = tmp_path / "backwards.csv"
    keys = ("accel_unit: mg", "sensor: generic", "fixture_sigma_deg: 0.01")
    path.write_text(planar.text(planar.rows(turned=-1, scale=9.80665e-3), *keys), encoding="utf-8")
    return path


MENDED = ["--reverse", "--unit", "mps2", "--gravity", "9.81", "--fixture", "0.05"]
RECORDED = {
    "gravity_mps2": {"old": 9.80665, "new": 9.81},
    "fixture_sigma_deg": {"old": 0.01, "new": 0.05},
    "accel_unit": {"old": "mg", "new": "mps2"},
    "reverse": {"old": False, "new": True},
}


def run(capsys, *arguments):
    status = main([*map(str, arguments)])
    return status, *capsys.readouterr()


@pytest.mark.parametrize("spelling", ["m/s²", "m/s^2", "M/S²"])
def test_metres_per_second_squared_may_be_written_as_people_do(capsys, backwards, spelling):
    arguments = [spelling if word == "mps2" else word for word in MENDED]
    status, out, _ = run(capsys, "fit", backwards, *arguments, "--json")
    assert status == 0
    assert json.loads(out)["overrides"] == RECORDED


def test_fit_without_them_names_the_remedy_and_with_them_is_right(capsys, backwards):
    status, _, err = run(capsys, "fit", backwards)
    assert status == 1
    assert "--unit mps2" in err
    status, _, err = run(capsys, "fit", backwards, "--unit", "mps2")
    assert status == 1
    assert "--reverse" in err
    status, out, _ = run(capsys, "fit", backwards, *MENDED, "--json")
    assert status == 0
    document = json.loads(out)
    assert document["overrides"] == RECORDED
    for name, truth in (("delta_k", planar.DELTA_K), ("delta_phi", planar.DELTA_PHI_DEG)):
        found = document["parameters"][name]
        assert abs(found["value"] - truth) < 4 * found["u"]


def test_the_screen_of_fit_names_them(capsys, backwards):
    status, out, _ = run(capsys, "fit", backwards, *MENDED)
    assert status == 0
    for words in ("gravity 9.81 m/s² instead of 9.80665", "in mps2, not in mg", "turned the other way"):
        assert words in " ".join(out.split())


def test_trace_and_report_record_them(capsys, backwards, tmp_path):
    status, out, _ = run(capsys, "trace", backwards, *MENDED, "--max-effects", "0", "--json")
    assert status == 0
    assert json.loads(out)["overrides"] == RECORDED
    page = tmp_path / "page.html"
    status, _, _ = run(capsys, "report", backwards, *MENDED, "--time-limit", "0.1", "-o", page)
    assert status == 0
    text = page.read_text(encoding="utf-8")
    assert "gravity 9.81 m/s² instead of 9.80665" in text
    assert "declared angles and approaches with the opposite sign" in text


def test_export_carries_the_corrected_values(capsys, backwards, tmp_path):
    mended = tmp_path / "mended.csv"
    assert run(capsys, "export", backwards, *MENDED, "--format", "csv", "-o", mended)[0] == 0
    session = load_session(mended)
    assert (session.accel_unit, session.gravity_mps2, session.fixture_sigma_deg) == ("mps2", 9.81, 0.05)
    assert [d.angle_deg for d in session.dwells] == [0.0, *(-45.0 * k for k in range(1, 8))]
    assert {d.approach for d in session.dwells} == {-1}
    assert any("overridden" in note for note in session.notes)
    assert run(capsys, "fit", mended)[0] == 0


def test_an_archive_takes_them_but_has_no_columns_to_name(capsys, tmp_path):
    archive = tmp_path / "a.session"
    begun = ["calibrate", "sim:?seed=1", "--plan", "four-position", "--auto", "--dwell", "1", "-o", archive]
    assert run(capsys, *begun)[0] == 0
    status, out, _ = run(capsys, "fit", archive, "--fixture", "0.2", "--json")
    assert status == 0
    assert json.loads(out)["overrides"]["fixture_sigma_deg"]["new"] == 0.2
    status, _, err = run(capsys, "fit", archive, "--columns", "ax=Acc_X")
    assert status == 2
    assert "columns are named for a CSV" in err


def test_columns_are_told_by_the_user(capsys, tmp_path):
    text = planar.text(planar.rows(), "accel_unit: mg", "sensor: generic")
    path = tmp_path / "own.csv"
    path.write_text(text.replace("time_s,", "when,").replace("ax,ay", "one,two"), encoding="utf-8")
    status, _, err = run(capsys, "fit", path)
    assert status == 1
    assert "column 'time_s' is missing" in err
    status, out, _ = run(capsys, "fit", path, "--columns", "time_s=when,ax=one,ay=two", "--json")
    assert status == 0
    assert json.loads(out)["overrides"]["columns"]["new"] == {"time_s": "when", "ax": "one", "ay": "two"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--gravity", "981"], "981 cm/s² (Gal) are 9.81 m/s²"),
        (["--gravity", "1.0"], "1 g are 9.80665 m/s²"),
        (["--gravity", "heavy"], "give m/s², such as 9.81"),
        (["--gravity", "nan"], "give m/s², such as 9.81"),
        (["--fixture", "-1"], "give degrees, 0 or more, or free"),
        (["--unit", "furlong"], "furlong"),
        (["--sensor", "adis16000"], "adis16000"),
        (["--columns", "ax"], "write name=column"),
        (["--columns", "ax=a,ax=b"], "twice"),
        (["--columns", "ax=nowhere"], "no column is called 'nowhere'"),
        (["--columns", "bx=ax"], "'bx' is no column of the format"),
    ],
)
def test_what_no_session_can_have_is_wrong_usage_in_one_line(capsys, tmp_path, options, words):
    path = tmp_path / "s.csv"
    path.write_text(planar.text(planar.rows(), "accel_unit: mg"), encoding="utf-8")
    status, out, err = run(capsys, "fit", path, *options)
    assert status == 2
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert words in err


def test_calibrate_refuses_such_a_gravity_before_anything_is_opened(capsys, tmp_path):
    output = tmp_path / "never.session"
    status, _, err = run(capsys, "calibrate", "sim:?seed=1", "--auto", "--gravity", "981", "-o", output)
    assert status == 2
    assert "981 cm/s² (Gal) are 9.81 m/s²" in err
    assert not output.exists()


def test_another_place_than_earth_is_said_by_writing_the_unit(capsys, tmp_path):
    path = tmp_path / "moon.csv"
    rows = planar.rows(scale=1.62 / 9.80665)
    path.write_text(planar.text(rows, "accel_unit: mg", "sensor: generic"), encoding="utf-8")
    status, out, _ = run(capsys, "fit", path, "--gravity", "1.62mps2", "--json")
    assert status == 0
    assert json.loads(out)["overrides"]["gravity_mps2"]["new"] == 1.62
