"""`archive`, `history`, `due` and `fleet` on the sessions of years."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.fleet.fleet_run import session_files
from adis_gonio.fleet.session_record import record_of
from adis_gonio.record.loading import load_session
from adis_gonio.record.samples_writer import write_samples_csv
from fleet.recorded import recorded
from fleet.sessions import write_fleet

YEARS = range(2012, 2023)
MOVED = 2019
ONE_POSE = (
    "# sensor: generic\n# accel_unit: mg\n# reading_u_mg: 0.5\n"
    "time_s,position,angle_deg,ax,ay,az\n"
    "0,0,0,1000,2,1\n1,1,90,1,-999,2\n2,2,180,-998,1,0\n3,3,270,2,1001,1\n"
)


def year(path: Path, when: int, skew_deg: float) -> Path:
    """A session of A7 in a March: four positions on a stage with 0.02°, Δφ as given, noise 0.1 mg."""
    rng = np.random.default_rng(when)
    lines = ["# accel_unit: mg", "# fixture_sigma_deg: 0.02", "# serial: A7", "# operator: Ada"]
    lines += ["# stage: rotary 3", "time,position,angle_deg,ax,ay"]
    for position in range(4):
        angle = math.radians(90 * position + rng.normal(0, 0.02))
        x = 1004 * math.cos(angle) + 5 + rng.normal(0, 0.1, 6)
        y = -1000 * math.sin(angle - math.radians(skew_deg)) + 2 + rng.normal(0, 0.1, 6)
        for k in range(6):
            time = f"{when}-03-01T09:00:{10 * position + k:02d}Z"
            lines.append(f"{time},{position},{90 * position},{x[k]:.3f},{y[k]:.3f}")
    path.write_text("\n".join(lines) + "\n", "utf-8")
    return path


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """A7 whose Δφ moves by 0.5° between 2018 and 2019, B2 with one session; a copy and two broken files."""
    folder = tmp_path_factory.mktemp("sessions")
    for when in YEARS:
        year(folder / f"{when}.csv", when, 0.7 if when >= MOVED else 0.2)
    other = folder / "other"
    other.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        recorded(other / "b.session", patch, serial="B2", operator="Bo", stage="tilt 1")
    shutil.copy(folder / "2012.csv", other / "copy.csv")
    (folder / "list.csv").write_text("what,price\nbread,2\n", "utf-8")
    (folder / "cut.session").write_bytes((other / "b.session").read_bytes()[:9000])
    return folder


def document(capsys, *words):
    status = main([*map(str, words), "--json"])
    out = capsys.readouterr().out
    return status, json.loads(out)


def test_archive_lists_by_serial_number_counts_a_copy_once_and_tells_what_is_broken(sessions, capsys):
    status, listed = document(capsys, "archive", sessions)
    assert status == 0
    assert [row["serial"] for row in listed["sessions"]] == ["A7"] * len(YEARS) + ["B2"]
    assert [row["when"][:4] for row in listed["sessions"][:-1]] == [str(year) for year in YEARS]
    assert [len(row["copies"]) for row in listed["sessions"]] == [1, *[0] * len(YEARS)]
    reasons = {row["path"].rsplit("/", 1)[-1]: row["reason"] for row in listed["failed"]}
    assert set(reasons) == {"list.csv", "cut.session"}
    assert "truncated" in reasons["cut.session"]


def test_a_second_call_computes_nothing_and_says_the_same(sessions, capsys, monkeypatch):
    _, first = document(capsys, "archive", sessions)
    monkeypatch.setattr(
        "adis_gonio.fleet.fleet_run.record_of", lambda *_, **__: pytest.fail("computed again")
    )
    _, second = document(capsys, "archive", sessions)
    assert second["computed"] == 0
    assert second["sessions"] == first["sessions"]


@pytest.mark.parametrize(
    ("option", "value"), [("--serial", "B2"), ("--operator", "Bo"), ("--stage", "tilt 1")]
)
def test_archive_filters(sessions, capsys, option, value):
    _, listed = document(capsys, "archive", sessions, option, value)
    assert [row["serial"] for row in listed["sessions"]] == ["B2"]


def test_archive_in_words_names_the_copy_and_the_broken_files(sessions, capsys):
    assert main(["archive", str(sessions)]) == 0
    said = re.sub(r"\s", "", capsys.readouterr().out)  # long paths are folded
    assert re.search(r"thesamefile,countedonce:.*2012\.csv.*copy\.csv", said)
    assert re.search(r"notused:.*list\.csv", said)
    assert f"{len(YEARS) + 1}sessions,2filesnotused" in said


def test_archive_shows_names_of_files_whole_and_a_link_that_leads_nowhere(tmp_path, capsys):
    folder = tmp_path / ("long " * 30)
    folder.mkdir()
    (folder / "the-very-name.csv").write_text(ONE_POSE, "utf-8")
    (folder / "lost.session").symlink_to("nowhere.session")
    assert main(["archive", str(folder)]) == 0
    said = capsys.readouterr().out
    # Folded over lines, the other columns between.
    assert "…" not in said
    assert re.search(r"not used: .*lost\.session: cannot be read: No such file", " ".join(said.split()))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes of POSIX")
def test_a_pipe_is_no_session_and_is_said(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    assert main(["archive", str(tmp_path / "pipe")]) == 0
    assert "is no regular file: save the data" in " ".join(capsys.readouterr().out.split())


def test_a_serial_number_in_other_capitals_is_another_sensor_and_is_said(tmp_path, capsys):
    for name, serial in (("a", "A7"), ("b", "a7"), ("c", "a 7"), ("d", "B")):
        text = f"# serial: {serial}\n# title: {name}\n" + ONE_POSE.replace("1000", f"100{ord(name) % 10}")
        (tmp_path / f"{name}.csv").write_text(text, "utf-8")
    assert main(["history", "A7", str(tmp_path), "--json"]) == 0
    printed = capsys.readouterr()
    assert [one["path"][-5:] for one in json.loads(printed.out)["left_out"]] == ["a.csv"]
    said = [line for line in printed.err.splitlines() if "another sensor" in line]
    assert [line.split("'")[1] for line in said] == ["a 7", "a7"]
    assert main(["history", "A8", str(tmp_path)]) == 2
    assert "known: A7, B, a 7, a7" in capsys.readouterr().err


def test_history_dates_the_change_that_was_planted_and_sees_none_elsewhere(sessions, capsys):
    _, told = document(capsys, "history", "A7", sessions)
    assert len(told["sessions"]) == len(YEARS)
    charts = {name: q["chart"] for name, q in told["quantities"].items() if q["chart"]}
    assert {name for name, chart in charts.items() if chart["signal"] is not None} == {"delta_phi"}
    assert told["sessions"][charts["delta_phi"]["since"]]["when"].startswith(str(MOVED))
    first = told["quantities"]["delta_phi"]["values"][0]
    assert first == record_of(sessions / "2012.csv").as_dict()["values"]["delta_phi"]


def test_history_fits_a_terminal_of_eighty_columns(sessions, capsys):
    assert main(["history", "A7", str(sessions)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert sum("±" in line and line.startswith("20") for line in lines) >= len(YEARS)
    assert any("CUSUM signals a change up since 2019-03-01" in line for line in lines)
    assert any("not traced" in line for line in lines)


def test_history_writes_a_page_with_figures_that_is_the_same_twice(sessions, tmp_path, capsys):
    pages = [tmp_path / "one.html", tmp_path / "two.html"]
    for page in pages:
        assert main(["history", "A7", str(sessions), "-o", str(page)]) == 0
    text = pages[0].read_text("utf-8")
    assert text == pages[1].read_text("utf-8")
    assert text.count("<svg") >= 9  # five quantities over time, four with a chart
    assert "http://" not in text.replace("http://www.w3.org", "")


def test_due_names_rule_reason_and_assumption_and_that_the_limit_is_assumed(sessions, capsys):
    _, told = document(capsys, "due", "A7", sessions)
    assert told["tolerance_assumed"] is True
    assert (told["tolerance_deg"], told["rule"], told["risk"]) == (0.1, "guarded", 0.025)
    assert {rule["method"] for rule in told["rules"]} == {"staircase", "control chart"}
    assert all(rule["why"] and rule["assumes"] for rule in told["rules"])
    moved = next(stair for stair in told["stairs"] if stair["when"].startswith(str(MOVED)))
    assert moved["response"] == "shorter"
    assert moved["error_deg"] == pytest.approx(0.5, abs=0.1)
    assert main(["due", "A7", str(sessions), "--tolerance", "2deg"]) == 0
    assert "assumed" not in capsys.readouterr().out


def test_due_names_the_sessions_that_take_no_part(tmp_path, capsys):
    year(tmp_path / "dated.csv", 2012, 0.2)
    undated = year(tmp_path / "undated.csv", 2013, 0.2)
    undated.write_text(
        undated.read_text("utf-8").replace("2013-03-01T09:00:", "").replace("Z,", ","), "utf-8"
    )
    code, told = document(capsys, "due", "A7", tmp_path)
    assert (code, told["date"]) == (0, "2013-03-01")
    assert main(["due", "A7", str(tmp_path)]) == 0
    (line,) = [one for one in capsys.readouterr().err.splitlines() if "left out" in one]
    assert f"{undated}: no date" in line


def test_due_of_one_session_says_what_is_lacking(sessions, capsys):
    assert main(["due", "B2", str(sessions)]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "only one session" in said
    assert "needs 3 sessions" in said


@pytest.mark.parametrize("command", ["history", "due"])
def test_an_unknown_serial_number_is_one_line(sessions, capsys, command):
    assert main([command, "A77", str(sessions)]) == 2
    error = capsys.readouterr().err
    assert "A7" in error.splitlines()[-1]


def test_a_folder_that_is_not_there_is_one_line(tmp_path, capsys):
    assert main(["archive", str(tmp_path / "nowhere")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == f"adis-gonio: {tmp_path / 'nowhere'}: there is no such file or folder"


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
