"""`template`: what it writes loads once it is filled in, whatever program filled it in."""

import io

import numpy as np
import pandas as pd
import pytest

from adis_gonio import fit, load_session
from adis_gonio.faces.cli import main
from adis_gonio.record.plans import PLAN_NAMES, plan
from fakes import planar_session as planar


def made(tmp_path, *options):
    path = tmp_path / "my.csv"
    assert main(["template", *options, "-o", str(path)]) == 0
    return path


def parted(path):
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    keys = [line for line in lines if line.startswith("#")]
    return "".join(keys), pd.read_csv(io.StringIO("".join(lines[len(keys) :])))


def fill(frame):
    rng = np.random.default_rng(1)
    frame["time_s"] = 30.0 * frame.index
    if "angle_deg" in frame:
        ideal = np.array([planar.readings(angle) for angle in frame["angle_deg"]])
    else:
        ideal = 1000 * np.array([p.direction for p in plan("poses").positions])
    for name, column in zip(("ax", "ay", "az"), ideal.T, strict=False):
        frame[name] = np.round(column + rng.normal(0, 0.1, len(frame)), 4)
    return frame


@pytest.mark.parametrize("name", PLAN_NAMES)
@pytest.mark.parametrize("excel", [False, True], ids=["plain", "German spreadsheet"])
def test_filled_in_it_loads_and_fits_without_another_change(tmp_path, name, excel):
    path = made(tmp_path, "--plan", name, "--sensor", "generic")
    keys, frame = parted(path)
    frame = fill(frame)
    if excel:
        padded = "".join(f"{line}{';' * (frame.shape[1] - 1)}\r\n" for line in keys.splitlines())
        body = frame.to_csv(sep=";", decimal=",", index=False, lineterminator="\r\n")
        path.write_bytes(("\ufeff" + padded + body).encode())
    else:
        path.write_text(keys + frame.to_csv(index=False), encoding="utf-8")
    session = load_session(path)
    assert session.notes == ()
    expected = plan(name)
    assert session.plane == expected.plane
    assert [d.angle_deg for d in session.dwells] == pytest.approx([p.angle_deg for p in expected.positions])
    assert [d.approach for d in session.dwells] == [p.approach for p in expected.positions]
    np.testing.assert_array_equal([d.accel[0, 0] for d in session.dwells], frame["ax"])
    result = fit(session)
    if expected.plane == "xy":
        assert result["delta_k"].value == pytest.approx(planar.DELTA_K, abs=1e-3)
        assert result["delta_phi"].value == pytest.approx(planar.DELTA_PHI_DEG, abs=0.05)


def test_keys_are_prefilled_and_those_left_empty_are_not_stated(tmp_path):
    options = [
        "--unit",
        "g",
        "--gravity",
        "9.81",
        "--fixture",
        "0.1",
        "--sensor",
        "adis16350",
        "--check",
        "2",
    ]
    path = made(tmp_path, "--plan", "four-position", *options)
    keys, frame = parted(path)
    assert list(frame["use"]).count("check") == 2
    frame = fill(frame)
    path.write_text(keys + frame.to_csv(index=False), encoding="utf-8")
    session = load_session(path)
    assert (session.sensor, session.accel_unit, session.gravity_mps2) == ("adis16350", "g", 9.81)
    assert (session.fixture_sigma_deg, session.reading_u_mg, session.operator) == (0.1, None, "")
    assert [d.use for d in session.dwells] == list(frame["use"])


def test_operator_serial_and_stage_come_back_and_are_written_again(tmp_path):
    from adis_gonio.record.samples_writer import write_samples_csv

    path = made(tmp_path)
    keys, frame = parted(path)
    for name, text in (("operator", "A. Nobody"), ("serial", "0042"), ("stage", "rotary table 3")):
        keys = keys.replace(f"# {name}:", f"# {name}: {text}")
    path.write_text(keys + fill(frame).to_csv(index=False), encoding="utf-8")
    again = tmp_path / "again.csv"
    write_samples_csv(load_session(path), again)
    for session in (load_session(path), load_session(again)):
        assert (session.operator, session.serial, session.stage) == ("A. Nobody", "0042", "rotary table 3")


def test_unfilled_it_is_refused_at_the_first_empty_cell(tmp_path, capsys):
    path = made(tmp_path, "--plan", "tumble")
    first = 1 + next(k for k, line in enumerate(path.read_text().splitlines()) if line[0] == ",")
    capsys.readouterr()
    assert main(["fit", str(path)]) == 1
    assert f"row {first}: column 'time_s': empty" in capsys.readouterr().err


def test_it_never_overwrites(tmp_path, capsys):
    path = made(tmp_path)
    before = path.read_bytes()
    assert main(["template", "-o", str(path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--plan", "tumbel"], "did you mean 'tumble'"),
        (["--sensor", "generic", "--unit", "lsb"], "no LSB that is known"),
        (["--gravity", "981"], "are 9.81 m/s²"),
        (["-o", "x.csv.gz"], "name it .csv"),
    ],
)
def test_wrong_usage_is_one_line_and_makes_no_file(tmp_path, capsys, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    assert main(["template", "-o", "y.csv", *options]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
