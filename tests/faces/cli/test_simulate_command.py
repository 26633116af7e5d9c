"""`simulate` says what it recorded, and not what it was asked for."""

import re
import signal
import subprocess
import sys

import pytest

from adis_gonio import load_session
from adis_gonio.faces.cli import main
from adis_gonio.model.effects import parse_effect
from adis_gonio.record.samples_writer import write_samples_csv
from programs import running


def interrupted(output, after: int) -> tuple[list[str], int]:
    """Lines on standard error and status of a simulation that Ctrl-C ends after some dwells."""
    command = [sys.executable, "-m", "adis_gonio", "simulate", "--plan", "tumble", "-o", str(output)]
    lines, seen = [], -1
    with running(command, stderr=subprocess.PIPE) as program:
        for line in program.stderr:
            lines.append(line.rstrip("\n"))
            seen += "noise at rest" in line or " mg  " in line
            if seen == after:
                program.send_signal(signal.SIGINT)
                seen += 100
        program.wait(60)
    return lines, program.returncode


@pytest.mark.skipif(sys.platform == "win32", reason="signals need POSIX")
@pytest.mark.parametrize("name", ["part.session", "part.csv"])
def test_ctrl_c_tells_how_many_dwells_the_file_has(tmp_path, name):
    lines, status = interrupted(tmp_path / name, after=4)
    assert status == 130
    done = len(load_session(tmp_path / name).dwells)
    assert 4 <= done < 24
    assert f"{tmp_path / name}: {done} of 24 dwells" in lines


@pytest.mark.skipif(sys.platform == "win32", reason="signals need POSIX")
def test_ctrl_c_before_the_first_dwell_makes_no_csv_and_says_so(tmp_path):
    lines, status = interrupted(tmp_path / "none.csv", after=0)
    assert status == 130
    assert f"{tmp_path / 'none.csv'}: 0 of 24 dwells" in lines
    assert not (tmp_path / "none.csv").exists()


def test_a_whole_session_tells_its_dwells(capsys, tmp_path):
    path = tmp_path / "all.session"
    assert main(["simulate", "--plan", "two-position", "--dwell", "0.5", "-o", str(path)]) == 0
    assert capsys.readouterr().err.splitlines()[-1] == f"written: {path}, 2 dwells"


def test_each_date_is_another_session_of_one_part_and_a_copy_of_its_samples_counts_once(tmp_path, capsys):
    words = ["simulate", "--seed", "5", "--serial", "A1", "--dwell", "0.5", "-o"]
    for day in ("2023-05-31", "2024-05-31"):
        assert main([*words, str(tmp_path / f"{day}.session"), "--date", day]) == 0
    first, other = (load_session(path) for path in sorted(tmp_path.glob("*.session")))
    hidden = ("delta_k", "delta_phi", "scale_y", "skew_xz")
    one, two = ([session.facts["truth"][name] for name in hidden] for session in (first, other))
    assert one == pytest.approx(two, rel=1e-4)  # at the temperature of each session
    assert (first.dwells[0].accel[:100] != other.dwells[0].accel[:100]).any()
    write_samples_csv(other, tmp_path / "copy.csv")
    capsys.readouterr()
    assert main(["due", "A1", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "copy.csv holds the same samples as " in said.err
    assert re.search(r"Next calibration of A1: 2\d{3}-\d\d-\d\d, by .*: overdue by \d+ days", said.out)
    assert main(["history", "A1", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("Sensor A1\n")
    assert "2 sessions;" in shown


@pytest.mark.parametrize("given", ["31.05.2024", "2024/5/31", "soon"])
def test_a_date_in_another_form_is_refused_with_the_accepted_forms(tmp_path, capsys, given):
    assert main(["simulate", "--date", given, "-o", str(tmp_path / "a.session")]) == 2
    said = capsys.readouterr().err
    assert f"'{given}' does not match the formats '%Y-%m-%d'" in said
    assert said.count("\n") == 1


def test_an_effect_without_a_value_gets_its_typical_size_and_tells_it(tmp_path, capsys):
    path = tmp_path / "planted.session"
    words = ["simulate", "--plan", "two-position", "--dwell", "0.5", "-o", str(path)]
    assert main([*words, "--effect", "stage_eccentricity"]) == 0
    effect, values = parse_effect("stage_eccentricity")
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("effect "))
    assert line.startswith(f"effect stage_eccentricity: {effect.parameters[0].name} {values[0]:g}°")
    truth = load_session(path).facts["truth"]
    assert truth[f"stage_eccentricity.{effect.parameters[0].name}"] == values[0]


def test_a_stated_size_of_an_effect_is_kept_and_told(tmp_path, capsys):
    words = ["simulate", "--plan", "two-position", "--dwell", "0.5", "-o", str(tmp_path / "a.session")]
    assert main([*words, "--effect", "quadratic:k2_x=0.01"]) == 0
    assert "effect quadratic: k2_x 0.01 mg/g², k2_y 0 mg/g²" in capsys.readouterr().err
