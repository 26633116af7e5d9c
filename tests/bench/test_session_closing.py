"""The closed loop: what has been measured asks for what is measured next."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.bench.advisor import Advice, TraceAdvisor
from adis_gonio.bench.events import (
    Advised,
    DwellDone,
    Event,
    ExtensionOffered,
    Finished,
    PositionAsked,
    Waiting,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.model.records import Session
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.plans import Plan, Position, plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings

SHORT = Settings(dwell_s=1.0, settle_s=0.1)
LONGER = Settings(dwell_s=2.0)
QUIET = "sim:?seed={}&bias_instability_mg=0&fixture_sigma_deg=0.002"
"""A stage of 0.002° and no slow noise: what is left is then white, as the trace supposes."""

TRACE = import_module("adis_gonio.tracing.trace")  # the package has a function of this name


class Scripted:
    """Asks for given rounds of positions, and keeps what it was told."""

    def __init__(self, *rounds: tuple[Position, ...]) -> None:
        self.rounds = list(rounds)
        self.seen: list[tuple[int, int, list[bool]]] = []

    def advise(self, session: Session, visited: int, reachable: Callable[[Position], bool]) -> Advice:
        wanted = self.rounds.pop(0) if self.rounds else ()
        self.seen.append((len(session.dwells), visited, [reachable(position) for position in wanted]))
        if not wanted:
            return Advice((), ended="nothing more")
        return Advice(wanted, tuple(f"because of {position}" for position in wanted))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.session"


def run(
    path: Path,
    advisor: object,
    made: Plan | None = None,
    url: str = "sim:?seed=3",
    *,
    settings: Settings = SHORT,
    answer: Callable[[SessionRunner, Event], None] | None = None,
    until: Callable[[Event], bool] = lambda event: False,
    resume: bool = False,
) -> list[Event]:
    """Run or resume a session, by itself or with answers, to its end or until an event."""
    events = []
    with open_sensor(url) as sensor:
        options = {"auto": answer is None, "advisor": advisor}
        world = sensor.bus.world.settings
        runner = (
            SessionRunner.resume(sensor, path, **options)
            if resume
            else SessionRunner.begin(
                sensor,
                path,
                made or plan("four-position"),
                settings,
                fixture_sigma_deg=world.fixture_sigma_deg,
                **options,
            )
        )
        steps = runner.run(so_far=False)
        for event in steps:
            events.append(event)
            if answer is not None:
                answer(runner, event)
            if until(event):
                break
        steps.close()
    return events


def of(events: list[Event], kind: type) -> list:
    return [event for event in events if isinstance(event, kind)]


def words(path: Path) -> list[tuple[float | None, int, bytes, bytes]]:
    return [
        (dwell.angle_deg, dwell.approach, dwell.accel.tobytes(), dwell.time_s.tobytes())
        for dwell in read_session(path).dwells
    ]


# -- the runner and any advisor -------------------------------------------------------------------------


def test_positions_that_an_advisor_asks_for_are_visited_and_archived_as_others(path):
    advisor = Scripted((Position(45.0), Position(200.0, -1)), (Position(10.0),))
    events = run(path, advisor)
    assert advisor.seen == [(4, 0, [True, True]), (6, 2, [True]), (7, 3, [])]
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0, 90, 180, 270, 45, 200, 10]
    assert [dwell.approach for dwell in session.dwells] == [1, 1, 1, 1, 1, -1, 1]
    assert session.facts["complete"]
    assert len(session.facts["plan"]["positions"]) == 7
    assert [(e["round"], e["planned"], e["positions"]) for e in session.facts["advised"]] == [
        (1, 4, 2), (2, 6, 1), (3, 7, 0),
    ]  # fmt: skip
    assert session.facts["advised"][-1]["ended"] == "nothing more"
    offers = of(events, ExtensionOffered)
    assert [offer.reasons for offer in offers] == [
        ("because of 45°", "because of 200° from above"),
        ("because of 10°",),
    ]
    finished = events[-1]
    assert isinstance(finished, Finished)
    assert (finished.complete, finished.done, finished.total) == (True, 7, 7)


def test_without_an_advisor_nothing_is_asked_for(path):
    events = run(path, None)
    assert not of(events, Advised)
    assert read_session(path).facts["advised"] == []


def test_two_positions_become_four_before_the_advisor_is_asked(path):
    advisor = Scripted()
    run(path, advisor, plan("two-position"))
    assert advisor.seen == [(4, 0, [])]


@pytest.mark.parametrize("cut", [4, 5, 6])
def test_a_session_killed_within_the_extension_goes_on_to_the_same_result(path, cut):
    rounds = ((Position(45.0), Position(200.0, -1, wait_s=20.0)), (Position(10.0),))
    run(path, Scripted(*rounds))
    other = path.with_name("b.session")
    run(other, Scripted(*rounds), until=lambda e: isinstance(e, DwellDone) and e.place == cut)
    # The extension is in the archive: what was asked for is done first, then a new advisor is asked.
    again = Scripted(*rounds[1:]) if cut < 6 else Scripted()
    run(other, again, resume=True)
    assert again.seen[0][:2] == ((6, 2) if cut < 6 else (7, 3))
    assert words(other) == words(path)


def test_an_extension_can_be_finished_without_an_advisor(path):
    run(path, Scripted((Position(45.0), Position(200.0))), until=lambda e: isinstance(e, ExtensionOffered))
    # The break came before the answer: nothing was added.
    assert len(read_session(path).facts["plan"]["positions"]) == 4
    run(
        path,
        Scripted((Position(45.0), Position(200.0))),
        resume=True,
        until=lambda e: isinstance(e, DwellDone) and e.place == 4,
    )
    run(path, None, resume=True)
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0, 90, 180, 270, 45, 200]


def test_a_wait_passes_before_the_dwell_and_is_told(path):
    events = run(path, Scripted((Position(45.0, wait_s=42.0),)))
    told = of(events, Waiting)
    assert told[0].elapsed_s == pytest.approx(0.0, abs=1e-6)
    assert {event.length_s for event in told} == {42.0}
    dwells = read_session(path).dwells
    usual = np.diff([dwell.time_s[0] for dwell in dwells[:4]]).max()
    assert 42.0 < dwells[4].time_s[0] - dwells[3].time_s[0] < 42.0 + usual + 5.0


def test_a_stop_during_a_wait_keeps_the_position_for_the_resumed_session(path):
    def answer(runner: SessionRunner, event: Event) -> None:
        if isinstance(event, PositionAsked):
            runner.answer("confirm")
        elif isinstance(event, ExtensionOffered):
            runner.answer("accept")
        elif isinstance(event, Waiting) and event.elapsed_s > 10:
            runner.stop()

    events = run(path, Scripted((Position(45.0, wait_s=60.0),)), answer=answer)
    assert events[-1].complete is False
    run(path, None, resume=True)
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0, 90, 180, 270, 45]


# -- an operator ----------------------------------------------------------------------------------------


def answering(offer: str, skip: frozenset[int] = frozenset()) -> Callable[[SessionRunner, Event], None]:
    def answer(runner: SessionRunner, event: Event) -> None:
        if isinstance(event, PositionAsked):
            runner.answer("skip" if event.place in skip else "confirm")
        elif isinstance(event, ExtensionOffered):
            runner.answer(offer)

    return answer


@pytest.mark.parametrize("offer", ["decline", "stop"])
def test_an_operator_who_has_enough_ends_the_session_with_all_of_it(path, offer):
    advisor = Scripted((Position(45.0),))
    events = run(path, advisor, answer=answering(offer))
    assert len(advisor.seen) == 1
    assert events[-1].complete
    assert len(read_session(path).dwells) == 4


def test_the_last_dwell_can_be_repeated_at_the_offer(path):
    answers = iter(["repeat", "accept"])

    def answer(runner: SessionRunner, event: Event) -> None:
        if isinstance(event, PositionAsked):
            runner.answer("confirm")
        elif isinstance(event, ExtensionOffered):
            runner.answer(next(answers))

    advisor = Scripted((Position(45.0),), (Position(30.0),))
    run(path, advisor, answer=answer)
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0, 90, 180, 270, 30]
    with ArchiveView(path) as view:
        assert [attempt.place for attempt in view.attempts()] == [0, 1, 2, 3, 3, 4]
    assert [seen[:2] for seen in advisor.seen] == [(4, 0), (4, 0), (5, 1)]


def test_what_was_skipped_cannot_be_reached_again(path):
    wanted = (Position(45.0), Position(30.0))
    advisor = Scripted(wanted, wanted)
    run(path, advisor, answer=answering("accept", frozenset({5, 7})))
    # A person can reach 30°, until they say that they will not.
    assert [seen[2] for seen in advisor.seen] == [[True, True], [True, False], []]
    with ArchiveView(path) as view:
        assert view.plan().positions[5].angle_deg == 30.0


def test_attitudes_in_space_are_asked_for_too(path):
    advisor = Scripted((Position(None, 0, direction=(0.0, -1.0, 0.0)),))
    run(path, advisor, plan("poses", 9))
    session = read_session(path)
    assert len(session.dwells) == 10
    last = session.dwells[-1].accel.mean(axis=0) * 0.4672
    assert last == pytest.approx([0.0, -1000.0, 0.0], abs=60)


# -- the trace as advisor -------------------------------------------------------------------------------


def test_a_session_that_cannot_be_traced_ends_the_loop_in_one_line(path):
    few = plan("poses", 9)
    events = run(path, TraceAdvisor(), replace(few, positions=few.positions[:3]))
    (said,) = of(events, Advised)
    assert said.ended.startswith("the session cannot be traced: ")
    assert "\n" not in said.ended
    assert events[-1].complete


# -- the loop as a whole --------------------------------------------------------------------------------


def test_a_drift_that_one_turn_in_order_takes_for_something_else_is_found(path):
    """In one turn in order time is angle; the positions that are asked for come back at another time.

    Over many sessions: scripts/trace_loop.py.
    """
    url = QUIET.format(3) + "&effects=bias_drift:drift_x=2"
    events = run(path, TraceAdvisor(), plan("mmpm"), url, settings=LONGER)
    first, *_, last = of(events, Advised)
    assert "bias_drift" not in first.summary["found"]
    assert "bias_drift" in last.summary["found"]
    assert last.ended
    assert last.positions == 0
    assert 1 <= len(read_session(path).dwells) - 9 <= 24


def test_a_session_that_answers_everything_asks_for_nothing(path):
    events = run(path, TraceAdvisor(), plan("tumble"), QUIET.format(5), settings=LONGER)
    (said,) = of(events, Advised)
    assert said.summary["adequate"]
    assert said.positions == 0
    assert said.ended == "the model is adequate, and no further position would decide anything more"
    assert len(read_session(path).dwells) == 24


def test_no_more_positions_than_allowed(path):
    url = QUIET.format(3) + "&effects=quadratic:k2_x=3"
    events = run(path, TraceAdvisor(most=1), url=url, settings=LONGER)
    assert len(read_session(path).dwells) == 5
    assert "limit" in of(events, Advised)[-1].ended or of(events, Advised)[-1].summary["adequate"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_a_loop_that_is_killed_in_its_extension_resumes_to_the_same_session(tmp_path):
    url = QUIET.format(3) + "&effects=quadratic:k2_x=3"
    whole, broken = tmp_path / "whole.session", tmp_path / "broken.session"
    command = [sys.executable, "-m", "adis_gonio", "calibrate", url, "--auto", "--trace", "--dwell", "2"]
    first = [*command, "--plan", "four-position", "-o"]
    done = subprocess.run([*first, str(whole)], capture_output=True, text=True, check=True, timeout=1800)
    assert "Closing the loop" in done.stdout
    process = subprocess.Popen(
        [*first, str(broken)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    dwells = 0
    for line in process.stderr:
        dwells += " mg  " in line
        if dwells == 5:
            process.send_signal(signal.SIGKILL)
            break
    process.wait(60)
    process.stderr.close()
    resumed = [*command, "--resume", "-o", str(broken)]
    subprocess.run(resumed, capture_output=True, check=True, timeout=1800)
    assert len(words(whole)) > 5
    assert words(broken) == words(whole)
