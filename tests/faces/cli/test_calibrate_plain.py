"""The plain face: every line that a person may type, and what the end says."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys

import pytest

from adis_gonio.base.errors import BusTimeoutError
from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.line_prompts import Lines
from adis_gonio.record.loading import load_session
from bench.hand_bench import HandBus
from programs import running

SIM = "sim:?seed=3"


@pytest.fixture
def bench(monkeypatch, tmp_path, capsys):
    """Run `calibrate` on a sensor that nothing moves, with typed lines; status, what was said, the file."""
    from adis_gonio.device.bus import opening

    real = opening.open_bus

    def run(typed: str, *options: str, still: bool = False, url: str = SIM):
        if still:
            from adis_gonio.device.sensor import driver

            monkeypatch.setattr(driver, "open_bus", HandBus)
        else:
            monkeypatch.setattr(opening, "open_bus", real)
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        path = tmp_path / "a.session"
        status = main(["calibrate", url, "--dwell", "0.5", "-o", str(path), "--plain", *options])
        return status, capsys.readouterr(), path

    return run


def test_four_enters_without_turning_end_in_status_1_and_say_so_at_once(bench):
    status, said, path = bench("\n\n\n\n\n", "--plan", "four-position", still=True)
    assert status == 1
    assert "the part has not moved" in said.err
    assert "delta_k" not in said.out
    assert len(load_session(path).dwells) == 1  # the data stay


def test_no_turn_is_told_from_where_the_part_may_not_lie(bench):
    """After a wrong turn by -90° the words of a turn by +90° would lead back to where it came from."""
    _, said, _ = bench("\n\n\n", "--plan", "four-position", still=True)
    asked = [line for line in said.err.splitlines() if line.startswith("2 of 4")]
    assert len(asked) == 2
    assert "turn the part +90° (counter-clockwise) to 90°" in asked[0]
    assert "turn the part to 90°" in asked[1]


def test_kept_nevertheless_the_end_says_that_the_result_cannot_be_right(bench):
    status, said, path = bench(
        "\n" + "\nk\n" * 3, "--plan", "four-position", "--fixture", "0.02", "--json", still=True
    )
    assert status == 1
    assert said.err.count("the result cannot be right: the part has not moved") == 3
    assert "the data stay in" in said.err
    if said.out:
        assert len(json.loads(said.out)["doubts"]) == 3
    assert len(load_session(path).dwells) == 4


def test_undo_note_pause_repeat_skip_and_nonsense_are_all_answers_that_lead_on(bench):
    typed = "\n\nn loose clamp\nn\nthe lamp\nxyzzy\nu\np\n\n\nr\ns\n\nn\n"
    status, said, path = bench(typed, "--plan", "four-position")
    assert status == 0
    assert "'xyzzy' is no answer" in said.err
    (listed,) = (line for line in said.err.splitlines() if "'xyzzy' is no answer" in line)
    assert {"n", "u", "p", "q"} <= set(re.split(r"[ ,]+", listed))
    assert "90° withdrawn" in said.err
    assert "paused" in said.err
    assert said.err.count("  noted\n") == 2
    assert "noted: " not in said.err  # an open question would end in it
    assert re.search(r"so far: ΔK \S+\s±\s\S+, Δφ \(\S+\s±\s\S+\)° \(± U, 95 %\)", said.err)
    session = load_session(path)
    assert [remark["text"] for remark in session.facts["remarks"]] == ["loose clamp", "the lamp"]
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 90.0, 270.0]


def test_the_end_of_the_input_ends_the_session_and_resume_goes_on_with_its_own_plan_alone(bench):
    status, said, _ = bench("\n", "--plan", "four-position")
    assert status == 1
    assert "--resume -o" in said.err
    status, said, path = bench("", "--plan", "tumble", "--resume")
    assert status == 2
    assert "has the plan four-position with 4 positions" in said.err
    # The same command again, with --resume, goes on; so it does with the plan's number of positions.
    status, said, _ = bench("\n", "--plan", "four-position", "--resume")
    assert status == 1
    assert "1 of 4 positions done" in said.err
    status, said, path = bench("\n\n", "--positions", "4", "--resume")
    assert status == 0
    assert "2 of 4 positions done" in said.err
    assert len(load_session(path).dwells) == 4
    # Of a complete session too, another plan is refused and its own is not.
    status, said, _ = bench("", "--plan", "tumble", "--resume")
    assert status == 2
    assert "has the plan four-position with 4 positions" in said.err
    status, said, _ = bench("", "--plan", "four-position", "--resume")
    assert status == 0
    assert "complete" in said.err


def test_an_extended_session_resumes_with_the_plan_that_it_began_with(bench):
    begun = ("--plan", "two-position")
    status, said, _ = bench("", "--auto", "--extend", *begun)
    assert status == 0
    status, said, path = bench("", "--resume", *begun)
    assert status == 0
    assert "complete" in said.err
    assert len(load_session(path).dwells) == 4


def test_ctrl_c_while_the_text_of_a_note_is_awaited_ends_the_session(bench, monkeypatch):
    typed = iter(["", "n"])

    def next_line(_, *, wait):
        for line in typed:
            return line
        signal.raise_signal(signal.SIGINT)
        pytest.fail("Ctrl-C did not end the wait")

    monkeypatch.setattr(Lines, "next", next_line)
    status, said, path = bench("", "--plan", "four-position")
    assert status == 1
    assert "nothing noted" not in said.err
    assert f"go on with adis-gonio calibrate '{SIM}' --resume -o {path}" in said.err
    assert len(load_session(path).dwells) == 1


def test_the_loss_of_a_device_ends_with_the_command_that_resumes_the_session(bench, monkeypatch):
    def lost(_):
        raise BusTimeoutError("the bridge does not answer")

    with monkeypatch.context() as patch:
        patch.setattr("adis_gonio.faces.cli.line_prompts.PlainBench.run", lost)
        status, said, path = bench("", "--plan", "four-position")
    assert status == 1
    assert "the bridge does not answer" in said.err
    assert f"go on with adis-gonio calibrate '{SIM}' --resume -o {path}" in said.err
    status, said, _ = bench("", "--plan", "four-position", "--resume", "--auto")
    assert status == 0
    assert "--resume -o" not in said.err


def test_metadata_is_not_asked_of_a_pipe_and_is_kept_where_it_is_given(bench, capsys):
    status, said, path = bench("", "--auto", "--operator", "A. B.", "--serial", "17", "--stage", "disc")
    assert status == 0
    assert "serial number of the part" not in said.err
    session = load_session(path)
    assert (session.operator, session.serial, session.stage) == ("A. B.", "17", "disc")
    assert main(["fit", str(path)]) == 0
    assert "operator A. B., serial 17, stage disc" in capsys.readouterr().out


@pytest.mark.parametrize(("gravity", "unit"), [("980.7", "Gal"), ("1", "1 g are"), ("0", "m/s²")])
def test_gravity_out_of_range_is_refused_before_anything_is_made(bench, gravity, unit):
    status, said, path = bench("", "--auto", "--gravity", gravity)
    assert status == 2
    assert unit in said.err
    assert not path.exists()


def test_a_simulation_on_the_wall_clock_can_be_resumed(bench):
    url = "sim:?seed=3&realtime=1"
    status, _, _ = bench("\n", url=url)
    assert status == 1
    status, said, path = bench("\nn\n", "--resume", url=url)
    assert status == 0
    assert "begin a new session" not in said.err
    session = load_session(path)
    assert len(session.dwells) == 2
    assert session.dwells[1].time_s[0] > session.dwells[0].time_s[-1]


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
def test_on_a_terminal_metadata_is_asked_once_and_enter_leaves_it_empty(tmp_path):
    import pty

    ours, theirs = pty.openpty()
    path = tmp_path / "a.session"
    command = [sys.executable, "-m", "adis_gonio", "calibrate", SIM, "--dwell", "0.5", "-o", str(path)]
    environment = os.environ | {"TERM": "dumb"}
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE}
    with running([*command, "--plain"], stdin=theirs, env=environment, **pipes) as program:
        os.close(theirs)
        os.write(ours, "A. Müller\n\ndisc\n\n\nn\n".encode())
        said = program.communicate(timeout=120)[1]
    os.close(ours)
    assert program.returncode == 0, said
    session = load_session(path)
    assert (session.operator, session.serial, session.stage) == ("A. Müller", "", "disc")
    assert said.count("serial number of the part") == 1


# -- lines from the input ---------------------------------------------------------------------------------


def test_lines_are_taken_one_by_one_and_nobody_waits_where_there_is_none(monkeypatch):
    read, write = os.pipe()
    with os.fdopen(read) as stdin, os.fdopen(write, "wb", buffering=0) as typed:
        monkeypatch.setattr("sys.stdin", stdin)
        lines = Lines()
        assert lines.next(wait=False) is None
        typed.write(b"one\ntwo\nthr")
        assert [lines.next(wait=False), lines.next(wait=False), lines.next(wait=False)] == [
            "one",
            "two",
            None,
        ]
        typed.write(b"ee")
        typed.close()
        assert lines.next(wait=True) == "three"
        with pytest.raises(EOFError):
            lines.next(wait=False)
