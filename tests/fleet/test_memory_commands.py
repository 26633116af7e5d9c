"""`archive`, `history` and `due` on sessions recorded by the simulated sensor over years."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.faces.cli import main
from adis_gonio.fleet.sensor_history import Track, drift_of, drift_sentences
from adis_gonio.fleet.session_record import record_of
from fleet.recorded import recorded

YEARS = range(2016, 2023)
MOVED = 2020
ONE_POSE = (
    "# sensor: generic\n# accel_unit: mg\n# reading_u_mg: 0.5\n"
    "time_s,position,angle_deg,ax,ay,az\n"
    "0,0,0,1000,2,1\n1,1,90,1,-999,2\n2,2,180,-998,1,0\n3,3,270,2,1001,1\n"
)


@pytest.fixture(scope="module")
def sessions(tmp_path_factory):
    """A7 whose Δφ moves by 0.5° between 2019 and 2020, B2 with one session; a copy and two broken files."""
    folder = tmp_path_factory.mktemp("sessions")
    with pytest.MonkeyPatch.context() as patch:
        for year in YEARS:
            skew = 0.7 if year >= MOVED else 0.2
            url = f"sim:?seed={year}&delta_k=0.004&delta_phi_deg={skew}&bias_x_mg=5&bias_y_mg=2"
            when = f"{year}-03-01T09:00:00.000+00:00"
            recorded(folder / f"{year}.session", patch, when=when, url=url)
        other = folder / "other"
        other.mkdir()
        recorded(other / "b.session", patch, serial="B2", operator="Bo", stage="tilt 1")
    shutil.copy(folder / "2016.session", folder / "other" / "copy.session")
    (folder / "list.csv").write_text("what,price\nbread,2\n", "utf-8")
    (folder / "cut.session").write_bytes((folder / "2017.session").read_bytes()[:9000])
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
    assert re.search(r"thesamefile,countedonce:.*2016\.session.*copy\.session", said)
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


@pytest.mark.skipif(not shutil.which("setpriv"), reason="takes root's right to read everything")
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="rights of POSIX")
@pytest.mark.parametrize("words", [["archive"], ["fleet", "--no-trace"]])
def test_a_file_and_a_folder_without_the_right_to_read_are_said(tmp_path, words):
    file, folder = tmp_path / "shut.csv", tmp_path / "closed"
    file.write_text(ONE_POSE, "utf-8")
    folder.mkdir()
    (tmp_path / "open.csv").write_text(ONE_POSE, "utf-8")
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


def test_a_scatter_beyond_all_doubt_is_no_probability_of_zero():
    day, value = np.arange(8.0) * 90, np.array([0, 9, 1, 8, 0, 9, 1, 8.0])
    drift = drift_of(day, value, np.full(8, 0.01), "mg")
    track = Track("bias_x", "mg", tuple(range(8)), day, (), drift)
    assert "p < 10⁻¹²" in " ".join(drift_sentences(track)).replace("\N{NO-BREAK SPACE}", " ").replace(
        "\u202f", " "
    )


def test_history_dates_the_change_that_was_planted_and_sees_none_elsewhere(sessions, capsys):
    _, told = document(capsys, "history", "A7", sessions)
    assert len(told["sessions"]) == len(YEARS)
    charts = {name: q["chart"] for name, q in told["quantities"].items() if q["chart"]}
    assert {name for name, chart in charts.items() if chart["signal"] is not None} == {"delta_phi"}
    assert told["sessions"][charts["delta_phi"]["since"]]["when"].startswith(str(MOVED))
    first = told["quantities"]["delta_phi"]["values"][0]
    assert first == record_of(sessions / "2016.session").as_dict()["values"]["delta_phi"]


def test_history_fits_a_terminal_of_eighty_columns(sessions, capsys):
    assert main(["history", "A7", str(sessions)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert sum("±" in line and line.startswith("20") for line in lines) >= len(YEARS)
    assert any("CUSUM signals a change up since 2020-03-01" in line for line in lines)
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
