"""`adis-gonio allan`: table, JSON, page and plot, errors."""

import json
import re

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from allan_statistics import CASES, Case, samples

CASE = Case({"white": 0.05, "flicker": 0.02}, 1 << 14, 2)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A CSV of one dwell with gyros and accelerometers."""
    path = tmp_path_factory.mktemp("allan") / "rest.csv"
    gyro = samples(CASE, 1)
    accel = np.rint(np.random.default_rng(1).normal([0, 0, -2140], 10, gyro.shape))
    time_s = 0.01 * np.arange(len(gyro))
    rows = np.column_stack([time_s, np.zeros(len(gyro)), accel, gyro])
    head = "# sensor: adis16354\n# title: left alone\n# plane: none\ntime_s,position,ax,ay,az,gx,gy,gz"
    np.savetxt(path, rows, "%.8g", ",", header=head, comments="")
    return path


def run(capsys, *words):
    status = main([*map(str, words)])
    told = capsys.readouterr()
    return status, told.out, told.err


def test_the_table_fits_80_columns_and_names_value_u_and_limits(recording, capsys):
    status, out, _ = run(capsys, "allan", recording, "--filter", 2)
    assert status == 0
    assert max(map(len, out.splitlines())) <= 80
    assert "Noise at rest of the gyros of left alone (adis16354)" in out
    assert re.search(r"angle random walk +0\.0\d+ +\S+ +\S+ … \S+ +\S+ +°/s/√Hz", out)
    assert re.search(r"bias instability +0\.0\d+ ", out)
    text = " ".join(out.replace("\xa0", " ").split())
    assert re.search(r"rate random walk: not separately detected, at most 0\.0\d+ °/s/√s", text)


def test_accelerometers_have_their_own_names(recording, capsys):
    status, out, _ = run(capsys, "allan", recording, "--sensor-part", "accelerometer", "--filter", 0)
    assert status == 0
    assert "velocity random walk" in out
    assert "acceleration random walk: not separately" in out


def test_the_json_is_one_document_and_nothing_else(recording, capsys):
    status, out, _ = run(capsys, "allan", recording, "--json", "--filter", 2)
    assert status == 0
    document = json.loads(out)
    assert document["part"] == "gyro"
    assert document["filter_m"] == 2
    assert document["sample_rate_hz"] == pytest.approx(100)
    assert set(document["axes"]) == {"x", "y", "z"}
    for axis in document["axes"].values():
        assert list(axis["parameters"]) == ["angle_random_walk", "bias_instability", "rate_random_walk"]
        assert len(axis["allan"]["tau_s"]) == len(axis["allan"]["model"]) > 8


def test_the_page_stands_alone(recording, capsys, tmp_path):
    status, _, err = run(capsys, "allan", recording, "--filter", 2, "-o", tmp_path / "noise.html")
    assert status == 0
    assert "noise.html, " in err
    page = (tmp_path / "noise.html").read_text("utf-8")
    assert "gyros of left alone" in page
    assert page.count("<svg") == 3
    assert not re.search(r'(src|href)="https?:', page)
    assert "fitted noise" in page


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        (["no.csv"], 1, "there is no such file"),
        (["rest.csv"], 1, "add '# filter_m: M' or give --filter M"),
        (["rest.csv", "--sensor-part", "mag"], 2, "'gyro', 'accelerometer'"),
        (["accel.csv"], 1, "there are no gyros (gx, gy, gz): give --sensor-part accelerometer"),
        (["short.csv"], 1, "no rest has 128 samples"),
        (["means.csv"], 1, "one averaged sample each"),
    ],
)
def test_what_cannot_be_done_is_one_line(recording, capsys, tmp_path, monkeypatch, words, status, told):
    monkeypatch.chdir(tmp_path)
    lines = recording.read_text("utf-8").splitlines()
    (tmp_path / "rest.csv").write_text("\n".join(lines), "utf-8")
    (tmp_path / "short.csv").write_text("\n".join(lines[:90]), "utf-8")
    bare = [",".join(line.split(",")[:5]) for line in lines[:600]]
    (tmp_path / "accel.csv").write_text("\n".join(bare), "utf-8")
    means = ["time_s,position,ax,ay,az,gx,gy,gz", "0,0,1,2,-2140,1,2,3", "1,1,3,1,-2139,2,1,1"]
    (tmp_path / "means.csv").write_text("\n".join(["# plane: none", *means]), "utf-8")
    got, out, err = run(capsys, "allan", *words)
    assert (got, out) == (status, "")
    assert told in err
    assert err.strip().count("\n") == 0


def test_the_statistic_has_a_case_for_each_mixture_and_filter():
    mixtures = {tuple(sorted(case.truth)) for case in CASES.values()}
    assert {("white",), ("flicker", "white"), ("walk", "white"), ("flicker", "walk", "white")} <= mixtures
    assert {case.filter_m for case in CASES.values()} == {0, 2, 6}
    assert any(case.simulator for case in CASES.values())
