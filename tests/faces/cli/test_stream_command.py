"""`adis-gonio stream` over the firmware's protocol on a tty: modes, Ctrl-C, unplugging."""

import os
import re
import signal
import subprocess
import sys
import threading
import time

import pytest

from adis_gonio import load_session
from adis_gonio.faces.cli import main
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.doubles import SimulatedBoard
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins, WorkClock
from programs import running

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")

ACCEL = ["--registers", "XACCL_OUT,YACCL_OUT,ZACCL_OUT", "--no-check"]
SLOW = 0x05
"""SMPL_PRD of 273 samples a second, which the fake keeps on a busy machine too."""


@pytest.fixture
def board():
    chip = SimulatedChip(World(seed=3), start_s=-0.5)
    chip.frame(0xB600 | SLOW, start_s=0.0, clock_hz=1e6)
    with SimulatedBoard(SimulatedFirmware(ChipPins(chip, WorkClock()))) as board:
        yield board


def registers_of(board: SimulatedBoard) -> int:
    return board.firmware.pins.chip.memory["MSC_CTRL"]


def counted(text: str) -> tuple[int, int]:
    """Scans and lost ones of the line that sums up."""
    words = next(line for line in text.splitlines() if " scans, " in line).split()
    return int(words[0]), int(words[2])


def test_the_firmware_streams_and_the_register_is_set_back(board, capsys, tmp_path):
    out = tmp_path / "rest.csv"
    assert main(["stream", f"serial:{board.path}", *ACCEL, "--seconds", "1", "-o", str(out)]) == 0
    captured = capsys.readouterr()
    first, last = captured.err.splitlines()
    assert (
        first
        == f"serial:{board.path}: 273.1 samples/s, the bridge reads each sample at its data-ready edge"
    )
    assert last.endswith(f"rows in {out}")
    scans, lost = counted(captured.err)
    assert scans + lost == pytest.approx(273, rel=0.05)  # by the host's clock
    assert sum(not line.startswith("#") for line in out.read_text().splitlines()) == scans + 1
    assert registers_of(board) == 0
    assert any(raw[0] == 4 for raw in board.firmware.executed)


def test_registers_can_be_left_alone(board, capsys, tmp_path):
    url, out = f"serial:{board.path}", tmp_path / "rest.csv"
    words = ["stream", url, *ACCEL, "--seconds", "0.5", "--leave-registers", "-o", str(out)]
    assert main(words) == 0
    captured = capsys.readouterr()
    assert "polling; missed samples are counted by time" in captured.err
    assert counted(captured.err)[0] > 10
    assert not any(raw[0] == 3 and raw[3] for raw in board.firmware.executed), "a write frame"
    assert main(["stream", url, "--leave-registers", "--rate", "100"]) == 2
    assert "--leave-registers" in capsys.readouterr().err


def read_all(inner: int, shown: list[bytes]) -> None:
    """What a terminal shows, piece by piece; the last one is empty."""
    with open(inner, "rb", buffering=0) as terminal:
        try:
            while piece := terminal.read(1 << 16):
                shown.append(piece)
        except OSError:
            pass  # Linux ends a terminal without a program so
    shown.append(b"")


@pytest.mark.parametrize(
    ("piped", "number"),
    [(True, signal.SIGINT), (False, signal.SIGINT), (True, signal.SIGTERM), (True, signal.SIGHUP)],
)
def test_ctrl_c_or_a_request_to_end_ends_it_with_the_register_set_back(board, tmp_path, piped, number):
    out = tmp_path / "rest.csv"
    command = [sys.executable, "-m", "adis_gonio", "stream", f"serial:{board.path}", *ACCEL, "-o", str(out)]
    inner, outer = (None, subprocess.PIPE) if piped else os.openpty()
    shown: list[bytes] = []
    if not piped:
        # A terminal takes what is written; one that nobody reads would stop the program when it is full.
        threading.Thread(target=read_all, args=(inner, shown), daemon=True).start()
    with running(command, stdout=outer, stderr=subprocess.PIPE) as program:
        wait_until(lambda: out.exists() and out.read_text().count("\n") > 100)
        assert registers_of(board) == 4
        program.send_signal(number)
        screen, told = program.communicate(timeout=300)
    if not piped:
        os.close(outer)
        wait_until(lambda: b"" in shown)
        screen = b"".join(shown).decode()
    assert program.returncode == 0, told
    assert "XACCL/mg" in screen
    assert screen.count(" (") % 3 == 0
    scans, _ = counted(told)
    assert sum(not line.startswith("#") for line in out.read_text().splitlines()) == scans + 1
    assert "Traceback" not in told
    assert registers_of(board) == 0


def test_unplugging_is_one_line_and_what_came_before_it_is_kept(board, capsys, tmp_path):
    out = tmp_path / "rest.csv"

    def unplug() -> None:
        try:
            wait_until(lambda: out.exists() and out.read_text().count("\n") > 100)
        finally:
            board.unplug()

    thread = threading.Thread(target=unplug)
    thread.start()
    assert main(["stream", f"serial:{board.path}", *ACCEL, "-o", str(out)]) == 1
    thread.join(600)
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 3, told
    assert told[2].startswith(f"adis-gonio: serial:{board.path}: ")
    scans, _ = counted(told[1])
    assert scans > 90
    assert sum(not line.startswith("#") for line in out.read_text().splitlines()) == scans + 1


def test_a_reader_that_goes_away_ends_it_cleanly(board):
    command = [sys.executable, "-m", "adis_gonio", "stream", f"serial:{board.path}", *ACCEL]
    with running(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        assert "XACCL/mg" in program.stdout.readline()
        program.stdout.close()
        told = program.stderr.read()
    assert "Traceback" not in told
    assert registers_of(board) == 0


def wait_until(condition) -> None:
    end_s = time.monotonic() + 300  # a busy machine takes its time to start a program
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.02)


@pytest.mark.parametrize("name", ["full.csv", "full.csv.gz"])
def test_a_full_disk_leaves_whole_rows_and_names_the_file_with_their_number(tmp_path, name):
    out, room = tmp_path / name, 20_000
    code = f"import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({room}, {room})); "
    code += "from adis_gonio.faces.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "stream", "sim:?seed=1", "--seconds", "20", "-o", str(out)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 1
    last = ended.stderr.splitlines()[-1]
    assert str(out) in last
    rows = int(re.search(r"(\d+) rows", last)[1])
    assert 0 < rows < 20 * 819
    if name.endswith(".csv"):
        text = out.read_text()
        assert text.endswith("\n")
        assert len([line for line in text.splitlines() if line[0].isdigit()]) == rows


def test_a_recording_keeps_the_filter(tmp_path, capsys):
    out = tmp_path / "rest.csv.gz"
    words = ["stream", "sim:?seed=1", "--filter", "4", "--rate", "100", "--seconds", "6", "-o", str(out)]
    assert main(words) == 0
    assert load_session(out).filter_m == 4
    assert main(["allan", str(out)]) == 0
    assert "filter M = 4" in capsys.readouterr().out
    session = tmp_path / "a.session"
    words = ["simulate", "--plan", "two-position", "--filter", "3", "--dwell", "1"]
    assert main([*words, "-o", str(session)]) == 0
    assert main(["export", str(session), "--format", "csv", "-o", str(tmp_path / "a.csv")]) == 0
    assert load_session(tmp_path / "a.csv").filter_m == load_session(session).filter_m == 3
