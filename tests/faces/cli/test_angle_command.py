"""`adis-gonio angle`: one line on a terminal, lines elsewhere, NDJSON for programs."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import pytest

from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.live_commands import format_angle
from adis_gonio.live.live_angle import LiveAngle, Smoothed
from programs import running

URL = "sim:?seed=1"
PROGRAM = [sys.executable, "-m", "adis_gonio", "angle"]


def test_json_is_one_object_a_line_ten_a_second(capsys):
    assert main(["angle", URL, "--seconds", "2", "--json"]) == 0
    captured = capsys.readouterr()
    readings = [json.loads(line) for line in captured.out.splitlines()]
    assert len(readings) == 20
    assert list(readings[0]) == [
        "time_s", "angle_deg", "corrected_deg", "u_deg", "still", "spread_mg", "temperature_c", "lost",
        "smoothed_deg", "smoothed_u_deg", "lag_s", "rate_dps", "gyro_zero_dps", "gyro_zero_u_dps", "notes",
    ]  # fmt: skip
    assert all(0.09 < b["time_s"] - a["time_s"] < 0.11 for a, b in itertools.pairwise(readings))
    assert readings[-1]["still"] is True
    assert readings[-1]["corrected_deg"] is None
    assert captured.err.startswith(f"{URL}: 819.2 samples/s")


def test_the_smoothed_angle_comes_once_its_lag_is_over(capsys):
    assert main(["angle", URL, "--seconds", "2", "--json", "--lag", "1"]) == 0
    readings = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [reading["smoothed_deg"] is None for reading in readings] == [True] * 10 + [False] * 10
    assert readings[0]["notes"] == []
    last = readings[-1]
    assert 1.0 < last["lag_s"] < 1.1
    assert abs(last["smoothed_deg"] - last["angle_deg"]) < 4 * last["u_deg"]


def test_by_gravity_alone_nothing_is_smoothed(capsys):
    assert main(["angle", URL, "--seconds", "1", "--json", "--no-gyro"]) == 0
    readings = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert all(reading["smoothed_deg"] is None and reading["lag_s"] is None for reading in readings)
    assert all(reading["u_deg"] > 0 for reading in readings)


@pytest.mark.parametrize("option", ["--poll", "--no-gyro"])
def test_an_error_in_status_is_a_note_of_every_angle(option, capsys):
    for supply_v, note in ((4.6, ["alarm"]), (5.0, [])):
        assert main(["angle", f"sim:?seed=1&supply_v={supply_v}", "--seconds", "1", "--json", option]) == 0
        shown = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert shown
        assert all(one["notes"] == note for one in shown)


def test_a_lag_that_means_nothing_is_refused(capsys):
    assert main(["angle", URL, "--seconds", "1", "--lag", "-1"]) == 2
    assert "take 0 to 10" in capsys.readouterr().err


def test_elsewhere_each_reading_is_a_line(capsys):
    assert main(["angle", URL, "--seconds", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert all("°" in line and " ± " in line and "\x1b" not in line for line in lines)


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_on_a_terminal_one_line_changes_in_place():
    inner, outer = os.openpty()
    with running([*PROGRAM, URL, "--seconds", "0.5"], stdout=outer, stderr=subprocess.PIPE) as program:
        os.close(outer)
        shown = b""
        try:
            while piece := os.read(inner, 4096):
                shown += piece
        except OSError:
            pass  # Linux ends a terminal without a program so
        os.close(inner)
        assert "Traceback" not in program.stderr.read()
    text = shown.decode()
    assert program.returncode == 0
    assert text.count("\n") == 1
    assert text.endswith("\n")
    assert text.count("\r") >= 5
    assert all(len(line.removesuffix("\x1b[K")) < 80 for line in text.strip().split("\r"))


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("seconds", "status"), [(None, 0), ("3600", 130)])
def test_ctrl_c_ends_it_in_order(seconds, status):
    limit = [] if seconds is None else ["--seconds", seconds]
    url = f"{URL}&realtime=1"
    with running(
        [*PROGRAM, url, "--json", *limit], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as program:
        assert json.loads(program.stdout.readline())
        program.send_signal(signal.SIGINT)
        out, err = program.communicate(timeout=300)
    assert program.returncode == status
    assert err.count("\n") == 1
    assert all(json.loads(line) for line in out.splitlines()), "no line is cut"


def test_a_reader_that_goes_away_ends_it_quietly():
    with running([*PROGRAM, URL, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        program.stdout.readline()
        program.stdout.close()
        err = program.stderr.read()
    assert err.count("\n") == 1
    assert "Traceback" not in err


def test_a_time_that_is_none_is_refused(capsys):
    assert main(["angle", URL, "--seconds", "0"]) == 2
    assert "--seconds': '0': give a number above 0" in capsys.readouterr().err


READING = LiveAngle(12.0, -170.5, -170.123, 0.0123, True, 2.25, 24.5, 3)


def test_the_smoothed_angle_leads_and_what_happened_is_in_words():
    smoothed = Smoothed(-170.2, 0.0456, 0.55, 3.0, 0.1, 0.01, ("gap", "saturated"))
    assert format_angle(replace(READING, smoothed=smoothed)) == (
        " −170.200 ± 0.089°   gap, too fast for the gyro   gravity  −170.123°   raw  −170.500°"
        "   still  (2.2 mg)   24.5 °C   3 lost"
    )


@pytest.mark.parametrize("width", [10, 20, 40, 60, 79])
def test_a_line_fits_and_keeps_the_angle_first(width):
    text = format_angle(READING, width)
    assert len(text) <= width
    assert text.startswith(" −170.123"[:width])


def test_all_is_said_where_there_is_room():
    assert (
        format_angle(READING) == " −170.123 ± 0.024°   raw  −170.500°   still  (2.2 mg)   24.5 °C   3 lost"
    )


def test_a_session_corrects_what_is_shown(tmp_path, capsys):
    path = tmp_path / "a.session"
    assert (
        main(["calibrate", URL, "--plan", "four-position", "--dwell", "1", "--auto", "-o", str(path)]) == 0
    )
    capsys.readouterr()
    assert main(["angle", URL, "--cal", str(path), "--seconds", "0.3", "--json"]) == 0
    readings = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert all(abs(reading["corrected_deg"]) < 0.5 for reading in readings), "the stage stands at 0°"
    assert all(abs(reading["angle_deg"]) > 1.0 for reading in readings)
    assert all(reading["u_deg"] > 0 for reading in readings)
    assert all(reading["u_deg"] < 0.1 for reading in readings[1:]), (
        "the first has too little data to see rest"
    )


@pytest.mark.parametrize("alone", [[], ["--no-gyro"]])
def test_a_calibration_of_another_part_is_reported_before_any_angle(alone, tmp_path, capfd):
    path = tmp_path / "a.session"
    other = "sim:?seed=10&bias_x_mg=-40&bias_y_mg=50"
    assert (
        main(["calibrate", URL, "--plan", "four-position", "--dwell", "1", "--auto", "-o", str(path)]) == 0
    )
    capfd.readouterr()
    fitting, alien = [
        main(["angle", url, "--cal", str(path), "--seconds", "1", *alone]) for url in (URL, other)
    ]
    assert (fitting, alien) == (0, 1)
    out, err = capfd.readouterr()
    assert err.count("contradicts gravity at rest") == 1
    assert out.count("\n") == 20  # ten a second, the first ones included
    assert out.count("does not fit") >= 5
    late = tmp_path / "both"
    with late.open("w") as both, contextlib.redirect_stdout(both), contextlib.redirect_stderr(both):
        main(["angle", other, "--cal", str(path), "--seconds", "1", *alone])
    assert "contradicts" in late.read_text().splitlines()[1]


def test_a_calibration_that_is_not_there_is_one_line(capsys):
    assert main(["angle", URL, "--cal", "nothing.json"]) == 1
    assert capsys.readouterr().err == "adis-gonio: nothing.json: there is no such file\n"
