"""`trace` and `report` as a shell user meets them."""

import json
from pathlib import Path

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.faces.cli import main
from recordings import recording


def written(path: Path, rows: str, **keys: str) -> Path:
    head = "".join(f"# {key}: {value}\n" for key, value in keys.items())
    path.write_text(head + rows, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def biased(tmp_path_factory):
    """A turn in steps of 20° with a bias, 0.1 mg a reading."""
    rng = np.random.default_rng(3)
    lines = ["time_s,position,angle_deg,ax,ay"]
    for k, angle in enumerate(np.arange(0, 720, 20)):
        psi = np.radians(10 - angle) + np.radians(0.003) * rng.standard_normal()
        x = 1000 * np.cos(psi) + 8 + 0.1 * rng.standard_normal()
        y = 1001 * np.sin(psi) - 5 + 0.1 * rng.standard_normal()
        lines.append(f"{20 * k},{k},{angle % 360},{x:.5f},{y:.5f}")
    keys = {"accel_unit": "mg", "reading_u_mg": "0.1", "fixture_sigma_deg": "0.003", "sensor": "generic"}
    return written(tmp_path_factory.mktemp("trace") / "turn.csv", "\n".join(lines) + "\n", **keys)


def test_json_is_the_result_and_nothing_else(capsys, biased):
    assert main(["trace", str(biased), "--json"]) == 0
    out = capsys.readouterr().out
    assert json.loads(out) == json.loads(json.dumps(trace(load_session(biased)).as_dict()))


def test_the_summary_says_what_how_sure_before_after_and_next(capsys, biased):
    assert main(["trace", str(biased)]) == 0
    out = capsys.readouterr().out.replace("\u00a0", " ")
    assert "One effect brings the residual down to the noise of the readings: bias (x, y)." in out
    assert "bias_x = 8.0" in out
    assert "as good as certain" in out
    headings = [
        "Effects found",
        "Error before and after",
        "What this session could not have seen",
        "What to measure next",
    ]
    at = [out.index(f"\n{heading}\n") for heading in headings]
    assert at == sorted(at)
    assert "base model" in out
    assert "+ bias" in out
    assert "`fit` leaves out one dwell at a time" in " ".join(out.split())


@pytest.mark.parametrize("width", [80, 120])
def test_no_line_is_wider_than_the_terminal(capsys, biased, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    assert main(["trace", str(biased)]) == 0
    assert max(len(line) for line in capsys.readouterr().out.splitlines()) <= 100


def test_no_more_effects_than_allowed_are_taken_on(capsys, biased):
    assert main(["trace", str(biased), "--max-effects", "0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["found"] == []


@pytest.mark.parametrize("command", ["trace", "report"])
def test_a_file_that_is_not_there_is_one_line(capsys, tmp_path, command):
    more = ["-o", str(tmp_path / "page.html")] if command == "report" else []
    assert main([command, str(tmp_path / "none.csv"), *more]) == 1
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "there is no such file" in err


def test_the_page_is_written_and_replaced(capsys, biased, tmp_path):
    page = tmp_path / "page.html"
    page.write_text("old", encoding="utf-8")
    assert main(["report", str(biased), "-o", str(page), "--force"]) == 0
    assert capsys.readouterr().out == ""
    text = page.read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>")
    assert "Step 1: bias" in text
    assert "One effect brings the residual down" in text


def test_a_page_never_takes_the_place_of_its_session(capsys, biased):
    before = biased.read_bytes()
    assert main(["report", str(biased), "-o", str(biased), "--force"]) == 2
    assert biased.read_bytes() == before
    assert "reads this file" in capsys.readouterr().err


def test_two_positions_have_a_page_that_says_why_there_is_no_more(tmp_path):
    rows = "time_s,position,angle_deg,ax,ay\n0,0,0,999,3\n60,1,90,4,-1001\n"
    session = written(tmp_path / "two.csv", rows, accel_unit="mg", reading_u_mg="0.1", sensor="generic")
    page = tmp_path / "page.html"
    assert main(["report", str(session), "-o", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert "two-position" in text
    assert "ΔK" in text


@pytest.mark.parametrize("name", ["thermal_cycle", "adis16350_xy_turn", "mpu9150_0_recording"])
def test_real_recordings_have_a_summary_and_a_page(capsys, tmp_path, name):
    assert main(["report", str(recording(name)), "-o", str(tmp_path / "page.html")]) == 0
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    found = {"thermal_cycle": "thermal_lag", "adis16350_xy_turn": "bias"}.get(name, "bias")
    assert f": {found}</h3>" in text
    assert text.count("<svg") >= 3
    capsys.readouterr()
