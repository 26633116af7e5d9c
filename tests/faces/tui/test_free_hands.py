"""A simulated part that only keys move: on the screen, in plain lines, and on its board."""

from __future__ import annotations

import io
import sys
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from adis_gonio.bench import events
from adis_gonio.bench.guidance import drawing
from adis_gonio.faces import bench_words
from adis_gonio.faces.cli import main
from adis_gonio.faces.cli.line_prompts import PlainBench
from adis_gonio.faces.free_hands import Hands, free_hands
from adis_gonio.faces.tui.bench_state import BenchState
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from faces.tui.screens import shown
from faces.tui.states import NOT_MOVED, PLAN, THREE, asked, look
from faces.tui.test_screen_keys import TypedRunner

ASKED = [*THREE, asked(3), look(angle=180.0, target=180.0)]


class Stage:
    """A stage that notes where it goes."""

    def __init__(self) -> None:
        self.angle_deg = 10.0
        self.gone: list[float] = []

    def move_to(self, angle_deg: float, approach: int = 0) -> None:
        self.gone.append(angle_deg)
        self.angle_deg = angle_deg


def wait_until(done) -> None:
    end_s = time.monotonic() + 60
    while not done():
        assert time.monotonic() < end_s
        time.sleep(0.01)


def test_the_screen_turns_and_bumps_the_part_and_answers_nothing():
    stage = Stage()
    text, _, runner = shown(ASKED, keys=["m", *"-30", "enter"], hands=Hands(stage))
    wait_until(lambda: stage.gone == [-20.0])
    assert runner.told == []
    assert "m move" in text
    shown(ASKED, keys=["b"], hands=Hands(stage))
    wait_until(lambda: len(stage.gone) == 3)
    assert stage.angle_deg == -20.0, "a bump comes back"


def test_without_such_a_part_the_keys_do_nothing():
    text, _, runner = shown(ASKED, keys=["m", "b"])
    assert runner.told == []
    assert "m move" not in text
    assert "Turn the part" not in text


@pytest.mark.parametrize(
    ("typed", "gone"),
    [("m 45", [55.0]), ("m\n45", [55.0]), ("m", []), ("m far", []), ("m 1e9", [])],
)
def test_plain_lines_turn_it_too(typed, gone, monkeypatch, capsys):
    stage = Stage()
    runner = TypedRunner([*THREE[:4], asked(3)])
    monkeypatch.setattr("sys.stdin", io.StringIO(f"{typed}\n"))
    PlainBench(runner, auto=False, hands=Hands(stage)).run()
    wait_until(lambda: stage.gone == gone)
    assert runner.told == ["stop"]


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_the_board_of_the_url_is_moved_and_any_other_url_is_left():
    with free_hands("sim:?seed=1&hands=free&move_speed_dps=720") as (url, hands):
        assert url.startswith("serial:")
        assert hands is not None
        hands.move("−30")
        wait_until(lambda: abs(hands._stage.angle_deg + 30.0) < 1e-9)
    for other in ("sim:?seed=1", "serial:"):
        with free_hands(other) as opened:
            assert opened == (other, None)


@pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")
def test_its_session_states_its_url_and_that_the_sensor_is_simulated(tmp_path, monkeypatch, capsys):
    """Else a report on an evening of practice would look like the certificate of a part."""
    url, path = "sim:?seed=1&hands=free", tmp_path / "free.session"
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))  # one dwell, then nobody is there
    main(["calibrate", url, "--plain", "--dwell", "0.5", "-o", str(path)])
    session = load_session(path)
    assert len(session.dwells) == 1
    assert (session.facts["url"], session.facts["simulated"]) == (url, True)
    assert "truth" not in session.facts
    capsys.readouterr()
    assert main(["write", str(path), url, "--status"]) == 0
    assert main(["registers", url]) == 2
    assert "only calibrate and write know hands=free" in capsys.readouterr().err


def test_every_key_is_on_a_screen_of_80_columns_with_help_last():
    text, _, _ = shown(ASKED, hands=Hands(Stage()))
    assert text.splitlines()[-1].split()[-4:] == ["q", "quit", "?", "help"]
    assert "u undo" in text


def test_the_result_of_a_withdrawn_dwell_is_not_shown_any_longer():
    state = BenchState()
    for event in THREE:
        state.take(event)
    assert state.latest(events.Running) is not None
    state.take(events.Withdrawn(2, PLAN.positions[2]))
    assert state.latest(events.Running) is None


def test_a_paused_session_on_hardware_waits_for_its_operator(monkeypatch):
    class Late(io.StringIO):
        def readline(self, *_):
            time.sleep(0.2)
            return "\n"

    class Session(TypedRunner):
        bench = SimpleNamespace(virtual_time=False, replayed=False)

        def run(self, *, so_far=True):
            yield from THREE[:4]
            yield events.Paused()
            told_at_once.extend(self.told)

    told_at_once: list[str] = []
    monkeypatch.setattr("sys.stdin", Late())
    PlainBench(Session([]), auto=False).run()
    assert told_at_once == ["unpause"]


def test_the_message_of_a_guard_is_said_once(capsys, monkeypatch):
    message = NOT_MOVED.message
    broken = events.DwellInterrupted(1, PLAN.positions[1], 2, 900, message, guarded=True)
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    PlainBench(TypedRunner([*THREE[:4], broken, NOT_MOVED]), auto=False).run()
    assert "".join(capsys.readouterr().err.split()).count("".join(message.split())) == 1
    shaken = events.DwellInterrupted(1, PLAN.positions[1], 2, 900, "x varies by 31 mg")
    assert "x varies by 31 mg" in bench_words.lines_about(shaken)[0][0]


def test_the_moving_line_of_plain_prompts_has_the_stillness_and_the_live_angle(monkeypatch):
    notes: list[str] = []
    monkeypatch.setattr("rich.progress.Progress.update", lambda *_, note="", **__: notes.append(note))
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    PlainBench(TypedRunner([THREE[0], look("moving", angle=-6.26, spread=55.3)]), auto=True).run()
    assert [note for note in notes if note] == ["MOVING  55.30 of at most 7.90 mg  −6.26°"]


@pytest.mark.parametrize("name", ["four-position", "poses"])
def test_a_drawing_has_room_in_a_dialog_and_on_a_line(name):
    assert max(map(len, drawing(plan(name)))) <= 72
