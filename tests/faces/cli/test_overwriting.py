"""One policy for files that exist: refused with status 2, replaced with --force, and named."""

from __future__ import annotations

import os

import pytest

from adis_gonio import open_sensor
from adis_gonio.faces.cli import COMMANDS, app, live_commands, main
from adis_gonio.record.loading import load_session
from adis_gonio.record.samples_writer import SamplesRecorder

SIM = "sim:?seed=1"
OUTPUTS = {
    "bringup": (["bringup", SIM], "x.html"),
    "calibrate": (["calibrate", SIM, "--auto", "--dwell", "0.5"], "x.session"),
    "stream": (["stream", SIM, "--seconds", "0.1"], "x.csv"),
    "report": (["report", "SESSION"], "x.html"),
    "allan": (["allan", "SESSION"], "x.html"),
    "plan": (["plan", "--plan", "two-position", "--fixture", "0.02"], "x.json"),
    "history": (["history", "17", "."], "x.html"),
    "fleet": (["fleet", "SESSION", "--no-trace"], "x.json"),
    "export": (["export", "SESSION"], "x.txt"),
    "template": (["template"], "x.csv"),
    "simulate": (["simulate", "--plan", "two-position", "--dwell", "0.5"], "x.csv"),
    "paper": (["paper", "--sessions", "2"], "x.html"),
}
QUICK = ("stream", "plan", "export", "template", "simulate", "fleet")


@pytest.fixture
def session(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["simulate", "--plan", "four-position", "--dwell", "0.5", "-o", "today.session"]
    assert main(command) == 0
    return tmp_path / "today.session"


def commands_with_output():
    for name in COMMANDS:
        command = app.get_command(None, name)
        if "--output" in [flag for option in command.params for flag in option.opts]:
            yield name, command


def test_every_command_with_an_output_is_in_the_table_and_has_force():
    found = dict(commands_with_output())
    assert set(found) == set(OUTPUTS)
    for name, command in found.items():
        assert "--force" in [flag for option in command.params for flag in option.opts], name


def run(name, *more):
    words, output = OUTPUTS[name]
    return main([word.replace("SESSION", "today.session") for word in (*words, "-o", output, *more)])


@pytest.mark.parametrize("name", OUTPUTS)
def test_a_file_that_exists_is_refused_before_the_work_and_left_alone(name, session, capsys):
    kept = session.parent / OUTPUTS[name][1]
    kept.write_text("mine")
    capsys.readouterr()
    assert run(name) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert str(kept.name) in line
    assert "--force" in line
    assert kept.read_text() == "mine"


@pytest.mark.parametrize("name", QUICK)
def test_force_replaces_it_and_the_file_is_named_on_standard_error(name, session, capsys):
    kept = session.parent / OUTPUTS[name][1]
    kept.write_text("mine")
    capsys.readouterr()
    assert run(name, "--force") == 0
    assert kept.read_bytes() != b"mine"
    assert kept.name in capsys.readouterr().err


def test_a_forced_session_leaves_the_measurements_of_the_old_one(session, capsys):
    before = session.read_bytes()
    command = ["calibrate", SIM, "--auto", "--dwell", "0.5", "-o", "today.session", "--force"]
    assert main(command) == 0
    assert "today.1.session" in capsys.readouterr().err
    assert (session.parent / "today.1.session").read_bytes() == before
    assert len(load_session(session).dwells) == 2


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.json", "a.html", "a.h"])
def test_a_session_with_the_ending_of_another_format_is_refused(name, tmp_path, capsys):
    assert main(["calibrate", SIM, "--auto", "-o", str(tmp_path / name)]) == 2
    assert ".session" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_no_command_writes_over_the_file_that_it_reads(session, capsys):
    before = session.read_bytes()
    assert main(["export", "today.session", "-o", "today.session", "--format", "json", "--force"]) == 2
    assert session.read_bytes() == before


def test_a_missing_folder_of_a_fleet_is_refused(tmp_path, capsys):
    assert main(["fleet", str(tmp_path / "none")]) == 2
    assert capsys.readouterr().out == ""


def test_force_replaces_a_file_by_a_simulated_session(tmp_path):
    path = tmp_path / "old.session"
    path.write_text("mine")
    command = ["simulate", "--plan", "two-position", "--dwell", "0.5", "-o", str(path)]
    assert main(command) == 2
    assert path.read_text() == "mine"
    assert main([*command, "--force"]) == 0
    assert len(load_session(path).dwells) == 2


def test_scans_that_are_dropped_keep_the_old_file_until_the_first_row(tmp_path):
    class Blocks(list):
        caveat = ""

    old = tmp_path / "old.csv"
    old.write_text("mine")
    with open_sensor(SIM) as sensor:
        scans = sensor.read_scans(8)
    with SamplesRecorder(old, "adis16354", force=True) as recorder:
        live_commands.ShownStream(8, recorder).run(Blocks([scans.first(0)]), None)
        assert old.read_text() == "mine"
        live_commands.ShownStream(8, recorder).run(Blocks([scans]), None)
    rows = [line for line in old.read_text("utf-8").splitlines() if line[0].isdigit()]
    assert len(rows) == 8


@pytest.mark.parametrize(
    "command",
    [
        ["stream", "serial:/dev/no-such-port", "-o", "old.csv"],
        ["stream", SIM, "--sensor", "adis16350", "-o", "old.csv"],
        ["stream", SIM, "--registers", "XGYRO_OUT", "--seconds", "0.5", "-o", "old.csv"],
        ["simulate", "--effect", "no_such_effect", "-o", "old.session"],
        ["simulate", "--set", "no_such_setting=1", "-o", "old.session"],
        ["simulate", "--like", "old.json", "-o", "old.csv"],
    ],
)
def test_force_keeps_the_old_file_if_a_command_measures_nothing(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    old = tmp_path / command[-1]
    (tmp_path / "old.json").write_text("no session")
    old.write_text("mine")
    assert main([*command, "--force"]) != 0
    assert old.read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"old.json", old.name}


def test_a_forced_simulation_does_not_replace_a_pipe(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("a.session")
    assert main(["simulate", "-o", "a.session", "--force"]) == 2
    assert "a.session: exists already" in capsys.readouterr().err
    assert (tmp_path / "a.session").is_fifo()


def test_a_stream_does_not_replace_a_file_that_came_to_exist_since_it_began(tmp_path, monkeypatch, capsys):
    out = tmp_path / "a.csv"
    open_stream = live_commands._open_stream

    def slow(*arguments):
        out.write_text("of another program")
        return open_stream(*arguments)

    monkeypatch.setattr(live_commands, "_open_stream", slow)
    assert main(["stream", SIM, "--seconds", "0.1", "-o", str(out)]) == 2
    assert "a.csv: exists already" in capsys.readouterr().err
    assert out.read_text() == "of another program"
