"""Whole sessions in a real terminal: a person who turns the part, wrong moves, retake, quit, resume."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("textual", reason="the extra 'bench' is not installed")

from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from faces.tui.terminal import PATIENCE_S, Terminal, tmux

pytestmark = pytest.mark.skipif(tmux() is None, reason="tmux is not installed (scripts/install_rigs.sh)")

HERE = Path(__file__).parent
WORLD = "seed=5&alpha_deg=12&delta_k=0.01&delta_phi_deg=0.8&bias_x_mg=10&bias_y_mg=-8&fixture_sigma_deg=0"


class Operator:
    """Somebody at the bench: turns the part and presses keys."""

    def __init__(self, terminal: Terminal, folder: Path) -> None:
        self.terminal = terminal
        self.session = folder / "today.session"
        self.control = folder / "moves"
        self.control.write_text("")
        self.url = f"hand:?{WORLD}&control={self.control}"

    def turn(self, angle_deg: float) -> None:
        self._write(f"{angle_deg:g}")

    def unplug(self) -> None:
        self._write("unplug")

    def _write(self, line: str) -> None:
        with self.control.open("a") as file:
            file.write(f"{line}\n")

    def start(self, *options: str) -> None:
        self.control.write_text("")
        program = [sys.executable, "-m", "adis_gonio", "calibrate", self.url, "-o", str(self.session)]
        self.terminal.run([*program, *options])

    def sees(self, pattern: str) -> str:
        return self.terminal.wait_for(pattern)

    def has_recorded(self, dwells: int) -> None:
        """Wait until so many dwells were taken, those that another has replaced among them."""
        end_s = time.monotonic() + PATIENCE_S
        while self.complete() < dwells:
            assert time.monotonic() < end_s, self.terminal.screen()
            time.sleep(0.1)

    def complete(self) -> int:
        with ArchiveView(self.session) as view:
            return sum(attempt.outcome == "complete" for attempt in view.attempts())

    def is_asked(self, number: int, angle_deg: float) -> None:
        self.terminal.wait_until_gone("Enter takes ▶")
        self.sees(rf"{number} of \d+: (turn|leave) the part")
        self.sees(rf"▶ now +{angle_deg:g}°")

    def take(self, number: int, angle_deg: float) -> None:
        """Turn to the position that is asked for, see the angle there, take it."""
        if number == 1:
            self.sees("How the part is held")
            self.terminal.press("Enter")
            self.terminal.wait_until_gone("How the part is held")
        self.is_asked(number, angle_deg)
        self.turn(angle_deg)
        if number > 1:
            # Gravity knows the angle to a degree or two before biases and gains are known.
            self.sees(r"target .*(● within|turn [+−][0-2]\.\d°)")
        self.terminal.press("Enter")


@pytest.fixture
def operator(tmp_path: Path) -> Iterator[Operator]:
    plugin = tmp_path / "plugins" / "hand-1.dist-info"
    plugin.mkdir(parents=True)
    (plugin / "METADATA").write_text("Metadata-Version: 2.1\nName: hand\nVersion: 1\n")
    (plugin / "entry_points.txt").write_text("[adis_gonio.bus]\nhand = hand_bus:open_from_url\n")
    paths = [str(plugin.parent), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {"PYTHONPATH": os.pathsep.join(paths), "OPENBLAS_NUM_THREADS": "1"}
    with Terminal(tmp_path, 80, 24, environment) as terminal:
        yield Operator(terminal, tmp_path)


OPTIONS = ["--plan", "four-position", "--dwell", "1", "--settle", "0.1", "--fixture", "0.05"]
OPTIONS += ["--operator", "A. Nonymous", "--serial", "17", "--stage", "hand"]


def test_whole_turns_on_a_table_are_asked_for_by_lines(operator):
    operator.start("--plan", "gyro-turns", "--turns", "1", *OPTIONS[2:])
    operator.sees(r"1 of 12 .*: lay the part flat on the table")
    assert "▶ now" not in operator.terminal.screen()


def test_from_start_to_result_with_wrong_moves_a_retake_a_quit_and_a_resume(operator):
    terminal = operator.terminal
    operator.start(*OPTIONS)
    operator.take(1, 0)
    # Forgotten to turn.
    operator.is_asked(2, 90)
    terminal.press("Enter")
    operator.sees(r"▶ r  go back: ask for the position again \(default\)")
    terminal.press("Enter")
    # Turned the wrong way.
    operator.is_asked(2, 90)
    operator.turn(-90)
    operator.sees("turn [+−]1[78]")
    terminal.press("Enter")
    operator.sees(r"v  the stage counts the other way")
    terminal.press("r")
    operator.take(2, 90)
    # Taken again.
    operator.is_asked(3, 180)
    terminal.press("r")
    operator.has_recorded(3)
    operator.is_asked(3, 180)
    terminal.press("q")
    operator.sees("--resume -o")
    terminal.press("q")
    assert terminal.status() == 1
    assert "go on with adis-gonio calibrate" in terminal.screen(history=True)
    operator.start("--resume")
    operator.sees(r"✓ done +90°")
    operator.take(3, 180)
    operator.take(4, 270)
    assert terminal.status() == 0
    told = terminal.screen(history=True)
    assert "delta_k" in told or "ΔK" in told
    left = terminal.screen()
    assert "Answer by method" in left, "the answer is not above the visible lines"
    assert "more: adis-gonio fit | report" in left
    assert "Traceback" not in told
    session = load_session(operator.session)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 90.0, 180.0, 270.0]
    assert operator.complete() == 5, "the dwell that was taken again is still in the file"
    result = session_result(operator.session)
    assert result["delta_k"]["value"] == pytest.approx(0.01, abs=5 * result["delta_k"]["u"])
    assert result["delta_phi"]["value"] == pytest.approx(0.8, abs=5 * result["delta_phi"]["u"])


def session_result(path: Path) -> dict[str, dict[str, float]]:
    from adis_gonio import fit

    return fit(load_session(path), method="ml").as_dict()["parameters"]


def test_a_cable_that_is_pulled_leaves_the_terminal_as_it_was_and_can_be_resumed(operator):
    terminal = operator.terminal
    operator.start(*OPTIONS)
    operator.take(1, 0)
    operator.is_asked(2, 90)
    operator.unplug()
    assert terminal.status() == 1
    told = terminal.screen(history=True)
    assert "no answer; the cable?" in " ".join(told.split())
    assert "go on with adis-gonio calibrate" in told
    assert "Traceback" not in told
    assert "▶ now" not in terminal.screen(), "the screen has gone"
    terminal.run(["echo", "still here"])
    operator.sees("^still here")
    operator.start("--resume")
    operator.is_asked(2, 90)
    terminal.press("C-c")
    assert terminal.status() == 1


@pytest.mark.parametrize("how", ["C-c", "TERM"])
def test_an_end_from_outside_keeps_all_and_leaves_the_terminal_as_it_was(operator, how):
    terminal = operator.terminal
    operator.start(*OPTIONS)
    operator.take(1, 0)
    operator.is_asked(2, 90)
    if how == "TERM":
        terminal.kill_program()
        assert terminal.status() == 130
    else:
        terminal.press("C-c")
        assert terminal.status() == 1
    told = terminal.screen(history=True)
    assert "Traceback" not in told
    assert "▶ now" not in terminal.screen()
    with ArchiveView(operator.session) as view:
        assert len(view.dwells()) == 1


def test_the_screen_follows_the_terminals_size(operator):
    terminal = operator.terminal
    operator.start(*OPTIONS)
    operator.sees("How the part is held")
    terminal.press("Enter")
    terminal.wait_until_gone("How the part is held")
    operator.is_asked(1, 0)  # the screen stands: a change of size while it is being built may be lost
    terminal.resize(60, 20)
    operator.sees("needs 80 × 24, the")
    terminal.resize(120, 40)
    operator.is_asked(1, 0)
    terminal.press("q")
    operator.sees("Quit the session")
    terminal.press("q")
    terminal.status()


def test_a_small_terminal_starts_with_prompts(operator):
    operator.terminal.resize(60, 20)
    operator.start(*OPTIONS)
    operator.sees("plain prompts: the bench screen needs 80 × 24")
    operator.sees("turn the part to 0°")
    operator.terminal.press("q", "Enter")
    operator.terminal.status()
