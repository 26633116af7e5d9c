"""`adis-gonio fleet` and `archive` as programs that a person starts and ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from fleet.sessions import kept_in, write_fleet, write_session
from programs import running

FLEET = (sys.executable, "-m", "adis_gonio", "fleet", "--no-trace")
SOON_S = 120


def until(journal: Path, sessions: int, program: subprocess.Popen[str]) -> None:
    """Wait for a journal to hold so many sessions, which the program writes."""
    limit = time.monotonic() + SOON_S
    while len(kept_in(journal)) < sessions:
        assert time.monotonic() < limit, "no results come in"
        assert program.poll() is None, program.communicate(timeout=SOON_S)
        time.sleep(0.05)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="sends signals as POSIX does")
def test_ctrl_c_ends_it_and_the_same_command_goes_on_to_the_same_summary(tmp_path):
    write_fleet(tmp_path / "fleet", 12, seed=6)
    out, calm = tmp_path / "a.json", tmp_path / "calm.json"
    command = [*FLEET, str(tmp_path / "fleet"), "--workers", "1", "-o"]
    with running([*command, str(out)], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        until(tmp_path / "a.json.journal", 3, program)
        program.send_signal(signal.SIGINT)
        _, said = program.communicate(timeout=SOON_S)
    assert program.returncode == 130
    assert "from there" in said
    assert not out.exists()
    kept = kept_in(tmp_path / "a.json.journal")
    assert 3 <= len(kept) < 12
    with running([*command, str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as program:
        program.communicate(timeout=SOON_S)
    assert program.returncode == 0
    assert kept.items() <= (whole := kept_in(tmp_path / "a.json.journal")).items()
    assert len(whole) == 12
    assert main(["fleet", "--no-trace", str(tmp_path / "fleet"), "--workers", "2", "-o", str(calm)]) == 0
    assert out.read_bytes() == calm.read_bytes()


def no_scheduler(address: str, folder: Path) -> subprocess.CompletedProcess[str]:
    pytest.importorskip("distributed")
    command = [*FLEET, *write_fleet(folder, 1, seed=9), "--scheduler", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=SOON_S, check=False)


def test_no_scheduler_at_an_address_is_one_line(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    done = no_scheduler(address, tmp_path)
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"adis-gonio: no scheduler answers at {address}")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("address", ["nowhere", "gopher://x:1"])
def test_an_address_that_is_none_is_one_line(address, tmp_path):
    done = no_scheduler(address, tmp_path)
    assert done.returncode == 2
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(f"adis-gonio: --scheduler {address}: ")
    assert last.endswith("an address is such as tcp://10.0.0.1:8786")
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(not shutil.which("setpriv"), reason="takes root's right to read everything")
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
@pytest.mark.parametrize("words", [["archive"], ["fleet", "--no-trace"]])
def test_a_file_and_a_folder_without_the_right_to_read_are_said(tmp_path, words):
    folder = tmp_path / "closed"
    folder.mkdir()
    rng = np.random.default_rng(1)
    _, file = (write_session(tmp_path / name, rng) for name in ("open.csv", "shut.csv"))
    rights = "-dac_override,-dac_read_search"
    less = ["setpriv", f"--bounding-set={rights}", f"--inh-caps={rights}"] if os.geteuid() == 0 else []
    file.chmod(0)
    folder.chmod(0)
    try:
        done = subprocess.run(
            [*less, sys.executable, "-m", "adis_gonio", *words, "--json", str(tmp_path), str(file)],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
    finally:
        folder.chmod(0o755)
    document = json.loads(done.stdout)
    failed = document["failed" if words == ["archive"] else "failures"]
    reasons = {Path(row["path"]).name: row["reason"] for row in failed}
    assert set(reasons) == {"shut.csv", "closed"}, done.stderr
    assert all("cannot be read: Permission denied" in reason for reason in reasons.values())
