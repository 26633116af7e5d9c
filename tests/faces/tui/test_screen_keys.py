"""What the keys do: each answer reaches the runner once, and none that was not meant does."""

import io
import re
import threading
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from textual.geometry import Size

from adis_gonio.base.errors import BusTimeoutError, SessionError
from adis_gonio.bench import events
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.faces import bench_words
from adis_gonio.faces.cli import line_prompts as choosing
from adis_gonio.faces.tui import bench_screen, screen_text
from adis_gonio.faces.tui.bench_screen import run_screen
from adis_gonio.faces.tui.bench_state import BenchState, Mark
from faces.tui.screens import RESUME, PlayedRunner, shown
from faces.tui.states import (
    DWELL,
    EXTENSION,
    OPEN,
    REVERSED,
    STATES,
    THREE,
    TWO,
    asked,
    done,
    look,
    started,
)

ASKED = [*THREE, asked(3), look(angle=180.0, target=180.0)]


@pytest.mark.parametrize(
    ("key", "told"),
    [
        ("enter", ["confirm"]),
        ("r", ["repeat"]),
        ("s", ["skip"]),
        ("u", ["undo"]),
        ("p", ["pause"]),
        ("x", []),
        ("ctrl+c", ["stop"]),
    ],
)
def test_a_key_answers_the_position_that_is_asked_for(key, told):
    assert shown(ASKED, keys=[key])[2].told == told


@pytest.mark.parametrize("script", [ASKED, [*THREE, EXTENSION]], ids=["position", "dialog"])
@pytest.mark.parametrize("key", ["x", "m", "f5", "pageup"])
def test_a_key_that_means_nothing_changes_nothing_and_the_keys_stay_listed(script, key):
    text, _, runner = shown(script, keys=[key])
    assert runner.told == []
    assert text.splitlines()[-1] == shown(script)[0].splitlines()[-1]


def test_a_second_press_of_enter_answers_nothing():
    text, _, runner = shown(ASKED, keys=["enter", "enter"])
    assert runner.told == ["confirm"]
    assert "no position is asked for now" in text


@pytest.mark.parametrize("key", ["enter", "r", "s", "u"])
def test_within_a_dwell_nothing_is_answered(key):
    text, _, runner = shown([*THREE, DWELL], keys=[key])
    assert runner.told == []
    assert "no position is asked for now" in text


@pytest.mark.parametrize("key", ["r", "u"])
def test_at_the_first_position_there_is_nothing_to_take_back(key):
    text, _, runner = shown([*OPEN, asked(0)], keys=["x", key])
    assert runner.told == []
    assert "there is no dwell before this one" in text


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (["enter"], ["retake"]),
        (["r"], ["retake"]),
        (["v"], ["reverse"]),
        (["k"], ["keep"]),
        (["down", "enter"], ["reverse"]),
        (["up", "enter"], ["stop"]),
        (["tab", "tab", "enter"], ["keep"]),
        (["q"], ["stop"]),
        (["s", "u", "p", "escape", "x"], []),
        (["enter", "enter"], ["retake"]),
    ],
)
def test_a_guard_takes_its_answers_and_no_others(keys, told):
    assert shown([*THREE, REVERSED], keys=keys)[2].told == told


class TypedRunner(PlayedRunner):
    """A runner for plain prompts, whose answers end the run."""

    fastest_dps = 180.0
    bench = SimpleNamespace(virtual_time=True, replayed=False)

    def run(self, *, so_far=True):
        for step in self._script:
            yield step
            if self.told:
                return

    def stop(self) -> None:
        if not self.told:
            self.told.append("stop")


ASKING = [*(name for name in STATES if name.startswith(("guard", "rep", "ext"))), "turn_more"]


@pytest.mark.parametrize("name", ASKING)
def test_the_screen_and_the_plain_prompts_have_one_key_map(name, monkeypatch):
    script = STATES[name][0]
    question = next(e for e in reversed(script) if isinstance(e, bench_words.Question))
    # Without the earlier questions of the script, which would take the letter.
    asks = [e for e in script if e is question or not isinstance(e, bench_words.Question)]
    typed = {}
    for letter in "rskuvyn" if isinstance(question, events.ExtensionOffered) else "rskuvy":
        runner = TypedRunner(asks)
        monkeypatch.setattr("sys.stdin", io.StringIO(f"{letter}\n"))
        choosing.PlainBench(runner, auto=False).run()
        typed[letter] = [] if runner.told == ["stop"] else runner.told
    answers = [letter for letter, told in typed.items() if told]
    assert len(answers) >= 2
    for letter in answers:
        assert shown(script, keys=[letter])[2].told == typed[letter], letter
    assert shown(script, keys=[letter for letter in typed if letter not in answers])[2].told == []


def test_a_guard_of_a_turn_is_answered_in_its_own_words():
    turn = gyro_turns_plan(5).positions[1]
    message = "turned −1800°, clockwise; counter-clockwise was requested"
    answers = ("retake", "keep", "skip")
    raised = events.GuardRaised("reversed", message, {}, answers, place=1, position=turn)
    known = bench_words.answers_to(raised)
    assert list(known) == [*answers, "stop"]
    assert known["retake"].meaning == "go back to the mark and turn again"


def test_a_guard_stays_until_it_is_answered():
    text, _, _ = shown([*THREE, REVERSED], keys=["escape", "x", "p"])
    assert "Enter takes ▶" in text


def test_an_extension_that_is_accepted_is_the_plan():
    script = [started(name="two-position"), *OPEN[1:], done(0, TWO), done(1, TWO), EXTENSION]
    text, app, runner = shown(script, keys=["enter"])
    assert runner.told == ["accept"]
    assert len(app.state.plan) == 4
    assert "270°" in text
    assert shown(script, keys=["n"])[2].told == ["decline"]


def test_an_answer_that_comes_too_late_is_told_and_does_no_harm():
    runner = PlayedRunner(ASKED)
    runner.deaf = True
    text, _, _ = shown(ASKED, keys=["enter"], runner=runner)
    assert "nothing was answered" in text


def test_a_question_does_not_take_the_enter_of_a_note():
    """A guard that rises while somebody types waits until the note is done."""
    script = [*ASKED]

    def rise(app: bench_screen.BenchApp) -> None:
        app.state.take(REVERSED)
        app.tick()

    text, _, runner = shown(script, keys=["n", *"a b"], before=rise)
    assert runner.told == []
    assert "Enter takes it" in text
    assert "Enter takes ▶" not in text


@pytest.mark.parametrize("opened", [[], ["question_mark"], ["q"]])
def test_two_keys_at_once_close_a_dialog_once(opened):
    from textual.events import Key

    def twice(app: bench_screen.BenchApp) -> None:
        for _ in range(2):
            app.screen.post_message(Key("q", "q"))

    text, app, _ = shown(ASKED if opened else [*THREE, REVERSED], keys=opened, before=twice)
    assert app.crash is None
    assert "any key" not in text
    assert "Enter takes ▶" not in text


def test_a_question_that_has_gone_takes_its_dialog_along():
    def go_on(app: bench_screen.BenchApp) -> None:
        app.state.take(events.Paused())
        app.tick()

    text, _, runner = shown([*THREE, REVERSED], before=go_on)
    assert "PAUSED" in text
    assert "Enter takes ▶" not in text
    assert runner.told == []


def test_a_note_is_kept_and_can_be_given_up():
    assert shown(ASKED, keys=["n", *"door", "enter"])[2].told == ["note door"]
    assert shown(ASKED, keys=["n", *"door", "escape"])[2].told == []
    assert shown(ASKED, keys=["n", "enter"])[2].told == []


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (["q", "y"], ["stop"]),
        (["q", "q"], ["stop"]),
        (["q", "enter"], []),
        (["q", "up", "enter"], ["stop"]),
        (["q", "n"], []),
    ],
)
def test_quitting_is_asked_and_staying_is_the_default(keys, told):
    assert shown(ASKED, keys=keys)[2].told == told


def test_quitting_says_how_to_go_on():
    text, _, _ = shown(ASKED, keys=["q"])
    assert RESUME in text


def test_pause_goes_on_with_the_same_key():
    assert shown([*ASKED, events.Paused()], keys=["p"])[2].told == ["unpause"]


@pytest.mark.parametrize("opened", ["q", "n", "question_mark"])
def test_ctrl_c_ends_the_session_whatever_is_open(opened):
    assert shown(ASKED, keys=[opened, "ctrl+c"])[2].told == ["stop"]


def test_any_key_closes_the_help():
    text, _, runner = shown(ASKED, keys=["question_mark", "s"])
    assert runner.told == []
    assert "Keys and signs" not in text


def test_the_first_position_shows_how_the_part_is_held_and_any_key_goes_on():
    text, _, _ = shown([*OPEN, asked(0)])
    assert "How the part is held" in text
    assert "Positive is counter-clockwise" in text
    assert shown([*OPEN, asked(0)], keys=["enter"])[2].told == []
    assert shown([*OPEN, asked(0)], keys=["enter", "enter"])[2].told == ["confirm"]
    assert "How the part is held" not in shown(ASKED)[0]
    assert "How the part is held" in shown(ASKED, keys=["d"])[0]


# -- what holds in every state --------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in STATES if name.startswith(("guard", "rep", "ext"))])
def test_every_question_has_a_default_that_is_told_apart_without_colour(name):
    text, _, _ = shown(STATES[name][0])
    (line,) = [line for line in text.splitlines() if "(default)" in line]
    assert "▶" in line
    assert len(shown(STATES[name][0], keys=["enter"])[2].told) == 1


def test_marks_are_told_apart_by_sign_and_by_word():
    assert len({mark.value[0] for mark in Mark}) == len(Mark)
    assert len({mark.value[1] for mark in Mark}) == len(Mark)
    assert max(len(mark.value[1]) for mark in Mark) <= 7


@pytest.mark.parametrize("height", [3, 5, 10, 40])
@pytest.mark.parametrize("place", [0, 17, 35])
def test_the_position_in_hand_is_always_in_sight(height, place):
    state = BenchState()
    for event in STATES["long_plan"][0][:-1]:
        state.take(event)
    state.place = place
    rows = screen_text.plan_rows(state, height)
    assert len(rows) <= max(height, 3)
    assert any("▶ now" in line for line, _ in rows)


def test_a_small_terminal_says_what_it_needs_and_the_session_goes_on():
    text, _, runner = shown(ASKED, size=(70, 20))
    assert "needs 80 × 24, the terminal has 70 × 20" in text
    assert runner.told == []
    assert shown(ASKED, size=(70, 20), keys=["q", "q"])[2].told == ["stop"]


def test_the_longest_time_of_a_turn_is_not_shown_as_its_length():
    state = BenchState()
    state.take(events.TurnProgress("turn", 1.2, 300.0, 983, 0, 45.0, 90.0, 1, 5))
    assert screen_text.progress(state, 0) == "+45°, +90.0 °/s, time limit  1 of 300 s "


def test_silence_is_told():
    def hush(app: bench_screen.BenchApp) -> None:
        app._news_s = time.monotonic() - 42

    text, _, _ = shown([*THREE, DWELL], before=hush)
    (seconds,) = re.findall(r"NO NEWS for (\d+) s", text)
    assert int(seconds) >= 42


def test_earlier_work_is_remembered():
    state = BenchState()
    for event in [started(resumed=True), *OPEN[1:]]:
        state.take(event)
    state.remember(done=[0, 1, 2], skipped={3})
    assert [state.mark(place) for place in range(5)] == [*[Mark.DONE] * 3, Mark.SKIPPED, Mark.OPEN]


def test_a_change_of_size_that_no_signal_told_of_is_seen(monkeypatch):
    def shrink(app: bench_screen.BenchApp) -> None:
        monkeypatch.setattr(bench_screen.BenchApp, "terminal_size", lambda self: Size(60, 20))
        app.tick()

    text, app, _ = shown(ASKED, before=shrink)
    assert app.size == (60, 20)
    assert "the terminal has 60 × 20" in " ".join(text.split())


# -- the ends ---------------------------------------------------------------------------------------------


class Headless(bench_screen.BenchApp):
    """A screen that draws nowhere."""

    def run(self, **options: object) -> None:
        super().run(headless=True, size=(80, 24))


@pytest.fixture
def headless(monkeypatch):
    monkeypatch.setattr("adis_gonio.faces.tui.bench_screen.BenchApp", Headless)
    monkeypatch.setattr("adis_gonio.faces.tui.bench_screen.remember", lambda *_: None)


@pytest.mark.usefixtures("headless")
@pytest.mark.parametrize("complete", [True, False])
def test_the_end_is_told_after_the_screen(capsys, complete):
    finished = events.Finished("today.session", complete, 3, 0, 12)
    runner = PlayedRunner([*THREE, finished], ends=True)
    assert run_screen(runner, RESUME) is complete
    told = capsys.readouterr().err
    assert re.search(r"x +\+1010\.40 .*120°", told), "what was said stays in the terminal"
    assert ("not complete: 3 of 12" in told) is not complete


@pytest.mark.usefixtures("headless")
def test_a_bus_that_fails_ends_the_screen_with_its_error():
    runner = PlayedRunner([*THREE, BusTimeoutError("serial:/dev/ttyACM0: no answer")])
    with pytest.raises(BusTimeoutError, match="no answer"):
        run_screen(runner, RESUME)


@pytest.mark.usefixtures("headless")
def test_a_screen_that_fails_stops_the_session_and_is_one_line(capsys, monkeypatch):
    monkeypatch.setattr(screen_text, "task", lambda state: 1 / 0)
    runner = PlayedRunner(THREE)
    with pytest.raises(SessionError, match=r"the screen failed .*ZeroDivisionError") as caught:
        run_screen(runner, RESUME)
    assert f"{RESUME} --plain" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "stop" in runner.told
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err + captured.out


@pytest.mark.usefixtures("headless")
def test_a_second_ctrl_c_leaves_a_session_that_does_not_end(monkeypatch):
    class Hangs(PlayedRunner):
        def stop(self) -> None:
            self.told.append("stop")

    runner = Hangs(THREE)
    pressed = threading.Event()

    def press(self: bench_screen.BenchApp) -> None:
        tick(self)
        if runner.played.is_set() and not pressed.is_set():
            pressed.set()
            self.action_stop_now()
            self.action_stop_now()

    tick = bench_screen.BenchApp.tick
    monkeypatch.setattr(Headless, "tick", press)
    with pytest.raises(KeyboardInterrupt):
        run_screen(runner, RESUME)
    runner.release()


# -- screen or prompts ------------------------------------------------------------------------------------


@pytest.fixture
def terminal(monkeypatch):
    ends = {
        end: SimpleNamespace(isatty=lambda: True, encoding="UTF-8", fileno=lambda: 0)
        for end in ("stdin", "stderr")
    }
    system = SimpleNamespace(**ends)
    for module in ("line_prompts", "terminal"):
        monkeypatch.setattr(f"adis_gonio.faces.cli.{module}.sys", system)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("LINES", "24")
    return monkeypatch


def test_a_terminal_that_can_gets_the_screen(terminal):
    assert choosing.can_show_screen()


@pytest.mark.parametrize("term", ["dumb", "", "unknown"])
def test_a_dumb_terminal_gets_prompts(terminal, term, capsys):
    terminal.setenv("TERM", term)
    assert not choosing.can_show_screen()
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("end", ["stdin", "stderr"])
def test_a_pipe_gets_prompts(terminal, end):
    getattr(choosing.sys, end).isatty = lambda: False
    assert not choosing.can_show_screen()


def test_an_encoding_without_the_signs_gets_prompts(terminal):
    choosing.sys.stderr.encoding = "cp1252"
    assert not choosing.can_show_screen()


def test_a_small_terminal_gets_prompts_and_is_told(terminal, capsys):
    terminal.setenv("COLUMNS", "79")
    assert not choosing.can_show_screen()
    assert "needs 80 × 24 characters, this terminal has 79 × 24" in capsys.readouterr().err


def test_without_the_extra_there_are_prompts_and_the_name_of_it(terminal, capsys):
    terminal.setattr(choosing.importlib.util, "find_spec", lambda name: None)
    assert not choosing.can_show_screen()
    assert "pip install '.[bench]'" in capsys.readouterr().err
