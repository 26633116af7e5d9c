"""`simulate` says what it recorded, and not what it was asked for."""

import signal
import subprocess
import sys

import pytest

from adis_gonio import load_session
from adis_gonio.faces.cli import main
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
