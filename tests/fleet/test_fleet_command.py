"""`adis-gonio fleet` as a person runs it."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from adis_gonio import __version__
from adis_gonio.faces.cli import main
from adis_gonio.fleet.fleet_run import session_files
from adis_gonio.fleet.session_record import Options, work
from adis_gonio.record.loading import load_session
from adis_gonio.record.provenance import digest_of_file
from adis_gonio.record.samples_writer import write_samples_csv
from fleet.sessions import kept_in, write_fleet
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


def test_a_damaged_file_is_a_row_and_the_rest_is_there(tmp_path, capsys):
    files = write_fleet(tmp_path / "fleet", 3, seed=7)
    bad = Path(files[1])
    bad.write_bytes(bad.read_bytes()[: bad.stat().st_size // 2] + b"\x00\xff rubbish")
    assert main(["fleet", *files, "--no-trace", "--json"]) == 1
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    assert document["sessions"]["ok"] == 2
    reasons = {Path(one["path"]).name: one["reason"] for one in document["failures"]}
    assert sorted(reasons) == ["001.csv"]
    assert "1 session of 3 failed" in printed.err


@pytest.mark.parametrize("name", ["none.csv", "none", "none.session"])
def test_a_file_or_folder_that_is_missing_is_refused_in_one_line(tmp_path, capsys, name):
    files = write_fleet(tmp_path / "fleet", 1, seed=7)
    missing = tmp_path / name
    assert main(["fleet", *files, str(missing), "-o", str(tmp_path / "a.json")]) == 2
    assert capsys.readouterr().err == f"adis-gonio: {missing}: there is no such file or folder\n"
    assert not list(tmp_path.glob("a.json*"))


def test_the_tables_on_the_terminal_say_what_the_json_says(tmp_path, capsys):
    files = write_fleet(tmp_path / "fleet", 4, seed=8)
    assert main(["fleet", *files, "--no-trace", "--workers", "1"]) == 0
    said = capsys.readouterr().out
    assert "4 of 4 sessions have a result, of 2 units on 4 stages by 3 operators." in said
    assert "ΔK" in said
    assert "No session was traced" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "Missing argument 'FILES…'"),
        (["."], "there is no session in .: give files, or folders with .session, .csv, .csv.gz"),
        (["a.csv", "--workers", "2", "--scheduler", "tcp://x:1"], "--workers and --scheduler"),
        (["a.csv", "--workers", "0"], "0 is not in the range"),
        (["a.csv", "-o", "b.csv"], ".parquet, .json, .html"),
        (["a.json", "-o", "a.json", "--force"], "is one of the sessions"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    given = [Path(name) for name in arguments[:1] if name != "."]
    for path in given:
        path.touch()
    assert main(["fleet", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == [path.name for path in given]


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


FOREIGN = "clock,Acc_X,Acc_Y\n" + "".join(f"{k / 100},{k % 7},{900 + k % 5}\n" for k in range(300))


def test_advice_is_of_what_the_file_can_say_and_of_no_option_that_a_fleet_lacks(tmp_path, capsys):
    path = tmp_path / "logger.csv"
    path.write_text(FOREIGN)
    assert main(["fit", str(path)]) == 1
    assert "--columns" in capsys.readouterr().err
    assert main(["fleet", str(path), "--no-trace", "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)["failures"]
    assert "has to be in the file" in row["reason"]
    assert main(["archive", str(tmp_path), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["failed"]
    assert "has to be in the file" in row["reason"]


def test_of_one_session_that_failed_the_sentence_is_right(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("nothing\n")
    main(["fleet", str(tmp_path / "a.csv"), "--no-trace"])
    assert capsys.readouterr().out.startswith("0 of 1 session has a result.\n")


def test_names_in_capitals_are_sessions_too(tmp_path, capsys):
    (path,) = write_fleet(tmp_path / "fleet", 1, seed=9)
    shouted = tmp_path / "FLEET" / "A.CSV"
    shouted.parent.mkdir()
    write_samples_csv(load_session(path), shouted)
    packed = tmp_path / "FLEET" / "B.CSV.GZ"
    write_samples_csv(load_session(path), packed)
    assert packed.read_bytes().startswith(b"\x1f\x8b")  # gzip
    assert [Path(x).name for x in session_files([tmp_path / "FLEET"])] == ["A.CSV", "B.CSV.GZ"]
    assert main(["fleet", str(shouted.parent), "--no-trace", "-o", str(tmp_path / "OUT.JSON")]) == 0
    assert (
        json.loads((tmp_path / "OUT.JSON").read_text("utf-8"))["sessions"]["ok"] == 1
    )  # both are one session


def test_a_simulated_session_that_is_named_as_a_csv_in_capitals_is_one(tmp_path):
    out = tmp_path / "S.CSV"
    assert main(["simulate", "--plan", "two-position", "--dwell", "0.5", "-o", str(out)]) == 0
    assert "time_s,position" in out.read_text("utf-8")


def test_a_session_is_read_once_for_record_and_evidence(tmp_path, monkeypatch):
    (path,) = write_fleet(tmp_path / "fleet", 1, seed=9)
    read = []
    monkeypatch.setattr(
        "adis_gonio.record.loading.load_session", lambda *a: read.append(a) or load_session(*a)
    )
    record = work(path, digest_of_file(path), Options(trace=False, evidence=True).as_dict(), __version__)
    assert record.status == "ok"
    assert record.evidence is not None
    assert len(read) == 1
