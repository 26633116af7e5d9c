"""`export`: formats by ending or by name, never a half file, never a lost old one."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from dataclasses import replace
from importlib import resources

import jsonschema
import numpy as np
import pytest

from adis_gonio import Calibration, fit, load_session
from adis_gonio.faces.cli import main, show
from adis_gonio.handover.formats import FORMATS
from adis_gonio.tracing.trace_calibrations import load_calibration

SCHEMA = json.loads(
    resources.files("adis_gonio.calibrate").joinpath("schema/calibration-1.json").read_text("utf-8")
)
SIM = "sim:?seed=1"
FIRST = {
    "c.h": b"/* adis_gonio.h",
    "c.hpp": b"/* adis_gonio.h",
    "c.json": b'{\n  "schema": "adis-gonio/calibration"',
    "c.csv": b"# sensor: adis16354",
    "c.csv.gz": b"\x1f\x8b",
    "c.parquet": b"PAR1",
    "c.xml": b'<?xml version="1.0" encoding="UTF-8"?>\n<dcc:digitalCalibrationCertificate',
    "c.txt": b"# Offsets that remove the bias",
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("session") / "four.session"
    assert (
        main(["calibrate", SIM, "--plan", "four-position", "--auto", "--dwell", "1", "-o", str(path)]) == 0
    )
    return path


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def failed(capsys, *arguments):
    status = main(["export", *map(str, arguments)])
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("adis-gonio: ")
    assert err.count("\n") == 1
    return status, err


@pytest.mark.parametrize("name", FIRST)
def test_the_ending_says_the_format(recorded, tmp_path, name):
    assert main(["export", str(recorded), "-o", str(tmp_path / name)]) == 0
    assert list(files(tmp_path)) == [name]
    assert files(tmp_path)[name].startswith(FIRST[name])


def test_a_format_by_name_wins_over_the_ending(recorded, tmp_path):
    assert main(["export", str(recorded), "--format", "json", "-o", str(tmp_path / "c.h")]) == 0
    assert json.loads((tmp_path / "c.h").read_text())["version"] == 1


@pytest.mark.parametrize("kind", [one.name for one in FORMATS])
def test_standard_output_holds_the_same_bytes_as_a_file(recorded, tmp_path, capsysbinary, kind):
    command = ["export", str(recorded), "--format", kind, "-o"]
    assert main([*command, str(tmp_path / "a")]) == 0
    capsysbinary.readouterr()
    assert main([*command, "-"]) == 0
    assert tuple(capsysbinary.readouterr()) == ((tmp_path / "a").read_bytes(), b"")


def test_a_pipe_gets_the_same_bytes_as_a_file(recorded, tmp_path):
    command = ["export", str(recorded), "--format", "parquet", "-o"]
    assert main([*command, str(tmp_path / "a")]) == 0
    done = subprocess.run(
        [sys.executable, "-m", "adis_gonio", *command, "-"], capture_output=True, check=True, timeout=600
    )
    assert (done.stdout, done.stderr) == ((tmp_path / "a").read_bytes(), b"")


def test_json_is_a_calibration_file_with_fit_and_session(recorded, tmp_path):
    path = tmp_path / "c.json"
    assert main(["export", str(recorded), "-o", str(path)]) == 0
    document = json.loads(path.read_text())
    jsonschema.Draft202012Validator(SCHEMA).validate(document)
    result = fit(load_session(recorded))
    loaded = Calibration.load(path)
    assert replace(loaded, gyro=None) == result.calibration()
    assert loaded.gyro == load_calibration(recorded).gyro  # its archive has gyros at rest
    assert document["coefficients"]["parameters"] == json.loads(json.dumps(result.as_dict()["parameters"]))
    assert "dwells" not in document["session"]


def test_method_and_name_are_followed(recorded, tmp_path):
    path = tmp_path / "c.json"
    assert main(["export", str(recorded), "--method", "four-position", "-o", str(path)]) == 0
    assert json.loads(path.read_text())["method"] == "four-position"
    assert main(["export", str(recorded), "--name", "bench3", "-o", str(tmp_path / "b.h")]) == 0
    assert "bench3_angle_udeg" in (tmp_path / "b.h").read_text()


def test_a_trace_says_meanwhile_what_it_is_at(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(show, "report_times_s", lambda: iter([0.0]))
    assert main(["export", str(recorded), "--trace", "-o", str(tmp_path / "traced.json")]) == 0
    out, err = capsys.readouterr()
    assert err.startswith("tracing four.session")
    assert out == ""


def test_trace_gives_the_traced_model(recorded, tmp_path):
    path = tmp_path / "c.json"
    assert main(["export", str(recorded), "--trace", "-o", str(path)]) == 0
    document = json.loads(path.read_text())
    assert document["method"] == "trace"
    assert "found" in document["coefficients"]
    jsonschema.Draft202012Validator(SCHEMA).validate(document)


def test_a_calibration_file_is_exported_on(recorded, tmp_path, capsys):
    assert main(["export", str(recorded), "-o", str(tmp_path / "c.json")]) == 0
    assert main(["export", str(tmp_path / "c.json"), "-o", str(tmp_path / "a.h")]) == 0
    assert main(["export", str(recorded), "-o", str(tmp_path / "b.h")]) == 0
    assert (tmp_path / "a.h").read_bytes() == (tmp_path / "b.h").read_bytes()
    capsys.readouterr()
    assert "needs a session" in failed(capsys, tmp_path / "c.json", "-o", tmp_path / "x.csv")[1]
    assert (
        "calibration already" in failed(capsys, tmp_path / "c.json", "--trace", "-o", tmp_path / "x.h")[1]
    )


def test_parquet_holds_every_sample_with_units_and_what_is_known(recorded, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "s.parquet"
    assert main(["export", str(recorded), "-o", str(path)]) == 0
    table = parquet.read_table(path)
    session = load_session(recorded)
    assert table.num_rows == sum(len(dwell) for dwell in session.dwells)
    for k, name in enumerate(("ax", "ay", "az")):
        column = np.concatenate([dwell.accel[:, k] for dwell in session.dwells])
        assert np.array_equal(table[name].to_numpy(), column)
    assert table.schema.field("ax").metadata[b"unit"] == b"lsb"
    about = json.loads(table.schema.metadata[b"adis_gonio"])
    assert about["gravity_mps2"] == session.gravity_mps2
    assert table["angle_deg"].unique().to_pylist() == [dwell.angle_deg for dwell in session.dwells]


def test_without_pyarrow_the_extra_is_named_and_nothing_is_left(recorded, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    status, said = failed(capsys, recorded, "-o", tmp_path / "s.parquet")
    assert status == 1
    assert "pip install '.[parquet]'" in said
    assert files(tmp_path) == {}


def test_nothing_is_replaced_unless_forced(recorded, tmp_path, capsys):
    for name in FIRST:
        (tmp_path / name).write_bytes(b"mine")
        status, said = failed(capsys, recorded, "-o", tmp_path / name)
        assert status == 2
        assert "exists already" in said
        assert "--force" in said
    assert set(files(tmp_path).values()) == {b"mine"}
    assert main(["export", str(recorded), "-o", str(tmp_path / "c.csv.gz"), "--force"]) == 0
    assert gzip.decompress((tmp_path / "c.csv.gz").read_bytes()).startswith(b"# sensor")


@pytest.mark.parametrize("name", FIRST)
def test_an_export_that_fails_half_way_leaves_the_old_file_alone(
    recorded, tmp_path, capsys, monkeypatch, name
):
    from adis_gonio.handover.session_export import ExportSource

    def half(source, kind, path):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ExportSource, "write", half)
    (tmp_path / name).write_bytes(b"mine")
    status, said = failed(capsys, recorded, "-o", tmp_path / name, "--force")
    assert status == 1
    assert f"{name}: cannot be written: No space left" in said
    assert files(tmp_path) == {name: b"mine"}


def test_a_session_that_lacks_what_a_format_needs_leaves_no_file(tmp_path, capsys):
    two = tmp_path / "two.session"
    assert main(["calibrate", SIM, "--auto", "--dwell", "0.5", "-o", str(two)]) == 0
    capsys.readouterr()
    status, said = failed(capsys, two, "-o", tmp_path / "c.txt")
    assert status == 1
    assert "does not determine bias_x" in said
    assert list(files(tmp_path)) == ["two.session"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((), "or --format"),
        (("-o", "-"), "or --format"),
        (("-o", "a.doc"), "no format has this ending"),
        (("--format", "csv"), "needs -o FILE"),
        (("--format", "parquet"), "needs -o FILE"),
        (("-o", "a.csv", "--method", "ml"), "--method: not with --format csv"),
        (("-o", "a.parquet", "--trace"), "--trace: not with --format parquet"),
        (("-o", "a.json", "--name", "x"), "--name: not with --format json"),
        (("-o", "a.h", "--name", "2x"), "is no name for C"),
        (("-o", "a.json", "--trace", "--method", "ml"), "--method: not with --trace"),
        (("-o", "a.json", "--method", "nosuch"), "no method is called"),
        (("--format", "nosuch"), "nosuch"),
    ],
)
def test_wrong_usage_is_named_before_any_work(recorded, tmp_path, capsys, monkeypatch, arguments, says):
    monkeypatch.chdir(tmp_path)
    status, said = failed(capsys, recorded, *arguments)
    assert status == 2
    assert says in said
    assert files(tmp_path) == {}
