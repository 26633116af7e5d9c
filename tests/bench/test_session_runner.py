from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError, SessionError, UsageError
from adis_gonio.bench.events import (
    Configured,
    DwellDone,
    DwellInterrupted,
    DwellProgress,
    Event,
    ExtensionOffered,
    Finished,
    GuardRaised,
    NoiseMeasured,
    PositionAsked,
    Problem,
    Running,
    StageMoved,
    Started,
    Watching,
)
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.device.sensor import Adis16354, open_sensor
from adis_gonio.device.sensor.registers import EA
from adis_gonio.device.sensor.scanning import ScanStream, StreamedScans
from adis_gonio.device.sensor.settings import ScanBlock, join
from adis_gonio.record.archive import Archive, ArchiveView
from adis_gonio.record.plans import Plan, plan
from adis_gonio.record.session_reader import read_session
from adis_gonio.record.source import Settings
from bench.hand_bench import HandBus

URL = "sim:?seed=3"
SHORT = Settings(dwell_s=1.0, settle_s=0.1)
RECORDED = (
    Started,
    Configured,
    NoiseMeasured,
    PositionAsked,
    StageMoved,
    DwellDone,
    ExtensionOffered,
    Finished,
)


@pytest.fixture
def sensor() -> Iterator[Adis16354]:
    with open_sensor(URL) as opened:
        yield opened


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "a.session"


def auto(path: Path, made: Plan | None = None, settings: Settings = SHORT, url: str = URL) -> list[Event]:
    with open_sensor(url) as opened:
        return list(
            SessionRunner.begin(opened, path, made or plan(), settings, auto=True).run(so_far=False)
        )


def of(events: list[Event], *kinds: type[Event]) -> list[Event]:
    return [event for event in events if isinstance(event, kinds)]


class Altered(ScanStream):
    """A stream whose blocks are changed on the way; `change` gets the block and its number."""

    def __init__(self, inner: ScanStream, change: Callable[[ScanBlock, int], ScanBlock]) -> None:
        self.inner, self.change, self.count = inner, change, 0

    def __next__(self) -> ScanBlock:
        self.count += 1
        return self.change(next(self.inner), self.count - 1)

    def _next(self) -> ScanBlock:
        raise NotImplementedError

    def close(self) -> None:
        self.inner.close()


def alter(
    sensor: Adis16354, monkeypatch: pytest.MonkeyPatch, change: Callable[[ScanBlock, int], ScanBlock]
) -> None:
    stream = sensor.stream
    monkeypatch.setattr(sensor, "stream", lambda *a, **k: Altered(stream(*a, **k), change))


def same_dwells(first: Path, second: Path) -> bool:
    a, b = read_session(first).dwells, read_session(second).dwells
    return len(a) == len(b) and all(
        (x.position, x.angle_deg, x.approach) == (y.position, y.angle_deg, y.approach)
        and np.array_equal(x.accel, y.accel)
        and np.array_equal(x.time_s, y.time_s)
        for x, y in zip(a, b, strict=True)
    )


# -- a session that runs by itself ----------------------------------------------------------------------


def test_an_automatic_session_tells_its_steps_in_order(path):
    events = auto(path)
    names = [type(event).__name__ for event in of(events, *RECORDED)]
    dwell = ["PositionAsked", "StageMoved", "DwellDone"]
    assert names == [
        "Started", "Configured", "NoiseMeasured", *dwell, *dwell, "ExtensionOffered", "Finished",
    ]  # fmt: skip
    finished = events[-1]
    assert isinstance(finished, Finished)
    assert finished.complete
    assert (finished.done, finished.total) == (2, 2)


def test_the_archive_holds_all_that_surrounded_the_dwells(path):
    events = auto(path, plan("four-position"), Settings(dwell_s=1.0, filter_m=4, gyro_range_dps=75))
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 90.0, 180.0, 270.0]
    assert {dwell.approach for dwell in session.dwells} == {1}
    assert {len(dwell) for dwell in session.dwells} == {819}
    facts = session.facts
    assert facts["complete"]
    assert facts["url"] == URL
    assert facts["configuration"]["filter_m"] == 4
    assert facts["registers"]["before"]["SENS_AVG"] == 0x0402
    assert facts["registers"]["configured"]["SENS_AVG"] == 0x0104
    assert facts["registers"]["after"]["SENS_AVG"] == 0x0104
    assert set(facts["registers"]["after"]) == set(facts["registers"]["before"])
    assert facts["software"].startswith("adis-gonio ")
    with open_sensor(URL) as opened:
        assert facts["truth"]["delta_k"] == pytest.approx(opened.bus.world.truth()["delta_k"], rel=1e-6)
    assert session.notes == ()
    (configured,) = of(events, Configured)
    assert configured.changed["SENS_AVG"] == (0x0402, 0x0104)
    for done, dwell in zip(of(events, DwellDone), session.dwells, strict=True):
        assert done.accel_mg == pytest.approx(dwell.accel.mean(axis=0) * 0.4672)
        assert done.samples == len(dwell)


def test_readings_are_those_of_the_stage(path):
    auto(path, plan("four-position"), url="sim:?seed=3&alpha_deg=0&bias_x_mg=0&bias_y_mg=0&noise_mg=2")
    means = [dwell.accel.mean(axis=0) * 0.4672 for dwell in read_session(path).dwells]
    expected = [(1000, 0), (0, -1000), (-1000, 0), (0, 1000)]
    for mean, (x, y) in zip(means, expected, strict=True):
        assert mean[:2] == pytest.approx([x, y], abs=20)


def test_every_scan_that_was_read_is_in_the_archive_without_a_gap(path):
    auto(path)
    period = 1 / 819.202
    with ArchiveView(path) as view:
        for stored in view.attempts():
            times = np.concatenate([block.time_s for block in view.blocks(stored)])
            assert np.diff(times) == pytest.approx(np.full(len(times) - 1, period), rel=1e-3)
            dwell = np.concatenate([block.time_s for block in view.blocks(stored, "dwell")])
            assert len(dwell) == 819
            assert times[0] < dwell[0]
            assert times[-1] > dwell[-1]


def test_a_dwell_begins_only_after_the_move_and_the_ringing(path):
    auto(path, url="sim:?seed=3&vibration_mg=100&vibration_decay_s=0.8")
    for dwell in read_session(path).dwells:
        spread = (dwell.accel * 0.4672).std(axis=0)
        assert (spread < 3.0).all()
    with ArchiveView(path) as view:
        before = [np.concatenate([b.accel_mg for b in view.blocks(a, "before")]) for a in view.attempts()]
    assert all(part[:100, :2].std() > 10 for part in before)


def test_settling_covers_the_filter(sensor):
    bench = SessionBench(sensor, Settings(settle_s=0.0, filter_m=6))
    bench.configure()
    assert bench.settle_s == pytest.approx(127 * bench.period_s)
    bench = SessionBench(sensor, Settings(settle_s=0.7, filter_m=6))
    bench.configure()
    assert bench.settle_s == 0.7


def test_a_polled_bus_gives_the_same_kind_of_session(path):
    events = auto(path, url="sim:?seed=3&stream=0")
    assert isinstance(events[-1], Finished)
    assert read_session(path).facts["configuration"]["data_ready"] is False
    assert {len(dwell) for dwell in read_session(path).dwells} == {819}


def test_a_part_that_starts_in_motion_is_waited_for(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True)
    rest = 0
    for event in runner.run(so_far=False):
        if isinstance(event, Watching) and event.state == "measuring" and rest < 12:
            rest += 1
            sensor.bus.stage.move_to(5.0 * (rest % 3))
        if isinstance(event, NoiseMeasured):
            assert max(event.noise_mg) < 3.0
            assert rest == 12
    assert read_session(path).facts["complete"]


# -- what goes wrong ------------------------------------------------------------------------------------


def test_motion_breaks_a_dwell_off_and_it_begins_anew(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True)
    events, nudged = [], False
    for event in runner.run(so_far=False):
        events.append(event)
        if isinstance(event, DwellProgress) and not nudged and event.elapsed_s > 0.4:
            nudged = True
            sensor.bus.stage.move_to(0.5)
    (broken,) = of(events, DwellInterrupted)
    assert "varies by" in broken.reason or "shifted" in broken.reason
    assert broken.samples > 300
    assert len(of(events, DwellDone)) == 2
    session = read_session(path)
    assert len(session.dwells) == 2
    with ArchiveView(path) as view:
        assert [a.outcome for a in view.attempts()] == ["interrupted", "complete", "complete"]
        kept = view.blocks(view.attempts()[0], "dwell")
        assert sum(len(block) for block in kept) == broken.samples
    assert session.dwells[0].accel.std(axis=0).max() * 0.4672 < 3.0


def test_a_part_that_never_rests_ends_an_automatic_session_in_one_line(sensor, path, monkeypatch):
    settings = Settings(dwell_s=1.0, still_timeout_s=3.0)
    runner = SessionRunner.begin(sensor, path, plan(), settings, auto=True)
    shaking = False

    def shake(block: ScanBlock, number: int) -> ScanBlock:
        words = block.words.copy()
        if shaking:
            words[::2, 0] = (words[::2, 0] + 40) & 0x3FFF
        return ScanBlock(block.registers, words, block.time_s, block.lost)

    alter(sensor, monkeypatch, shake)
    run = runner.run(so_far=False)
    for event in run:
        if isinstance(event, NoiseMeasured):
            shaking = True
            break
    with pytest.raises(SessionError, match=r"0°: not still within \d+ s \(x varies by .* resume") as caught:
        list(run)
    assert "\n" not in str(caught.value)
    with ArchiveView(path) as view:
        assert [a.outcome for a in view.attempts()] == ["interrupted"]
        assert view.blocks(view.attempts()[0])


def test_a_part_that_never_rests_is_asked_for_again_where_there_is_an_operator(sensor, path, monkeypatch):
    settings = Settings(dwell_s=1.0, still_timeout_s=1.0)
    runner = SessionRunner.begin(sensor, path, plan(), settings)
    shaking = False

    def shake(block: ScanBlock, number: int) -> ScanBlock:
        words = block.words.copy()
        if shaking:
            words[::2, 1] = (words[::2, 1] + 40) & 0x3FFF
        return ScanBlock(block.registers, words, block.time_s, block.lost)

    alter(sensor, monkeypatch, shake)
    asked = []
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            asked.append(event.place)
            shaking = len(asked) == 1
            runner.answer("confirm")
        if isinstance(event, ExtensionOffered):
            runner.answer("decline")
    assert asked == [0, 0, 1]
    assert any(entry["kind"] == "stillness" for entry in read_session(path).facts["problems"])


def test_a_bench_that_stays_noisier_than_at_the_begin_is_measured_anew(sensor, path, monkeypatch):
    settings = Settings(dwell_s=1.0, still_timeout_s=1.0)
    runner = SessionRunner.begin(sensor, path, plan(), settings)
    noise = np.random.default_rng(8)
    noisy = False

    def shake(block: ScanBlock, number: int) -> ScanBlock:
        words = block.words.copy()
        if noisy:
            added = noise.normal(scale=6.0, size=len(words)).round().astype(words.dtype)
            words[:, 1] = (words[:, 1] + added) & 0x3FFF
        return ScanBlock(block.registers, words, block.time_s, block.lost)

    alter(sensor, monkeypatch, shake)
    asked, measured = [], []
    for event in runner.run(so_far=False):
        if isinstance(event, NoiseMeasured):
            measured.append(event.noise_mg)
        if isinstance(event, PositionAsked):
            noisy = True
            asked.append(event.place)
            runner.answer("confirm")
        if isinstance(event, ExtensionOffered):
            runner.answer("decline")
    assert asked == [0, 0, 1]
    before, after = np.array(measured)
    assert after[1] > 1.5 * before[1]
    np.testing.assert_allclose(after[[0, 2]], before[[0, 2]], rtol=0.5)
    assert len(read_session(path).dwells) == 2


@pytest.mark.parametrize("when", ["measuring", "dwell"])
def test_a_stuck_axis_is_an_error_not_stillness(sensor, path, monkeypatch, when):
    stuck = when == "measuring"

    def freeze(block: ScanBlock, number: int) -> ScanBlock:
        words = block.words.copy()
        if stuck:
            words[:, 1] = 0x0123 | 0x8000
        return ScanBlock(block.registers, words, block.time_s, block.lost)

    alter(sensor, monkeypatch, freeze)
    run = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True).run(so_far=False)
    for event in run:
        if isinstance(event, DwellProgress) or stuck:
            break
    stuck = True
    with pytest.raises(SessionError, match=r"^accelerometer y is stuck at 136\.0 mg"):
        list(run)
    with ArchiveView(path) as view:
        reasons = [stored.reason for stored in view.attempts()]
    # The jump to the stuck value looks like motion first.
    assert len(reasons) == (2 if when == "dwell" else 0)
    assert all(reason.startswith("accelerometer y is stuck") for reason in reasons[1:])


def test_a_bus_that_fails_within_a_dwell_keeps_the_samples(sensor, path, monkeypatch):
    seen = []

    def fail(block: ScanBlock, number: int) -> ScanBlock:
        seen.append(number)
        if len(seen) == 40:
            raise BusTimeoutError("sim: no answer")
        return block

    alter(sensor, monkeypatch, fail)
    with pytest.raises(BusTimeoutError):
        list(SessionRunner.begin(sensor, path, plan(), Settings(dwell_s=5), auto=True).run(so_far=False))
    with ArchiveView(path) as view:
        (stored,) = view.attempts()
        assert (stored.outcome, stored.reason) == ("interrupted", "sim: no answer")
        assert sum(len(block) for block in view.blocks(stored, "dwell")) > 500


def test_a_front_end_that_goes_away_keeps_the_samples(sensor, path):
    run = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True).run(so_far=False)
    for event in run:
        if isinstance(event, DwellProgress) and event.elapsed_s > 0.5:
            break
    run.close()
    with ArchiveView(path) as view:
        (stored,) = view.attempts()
        assert (stored.outcome, stored.reason) == ("interrupted", "the program ended")
    assert sensor.status() is not None  # the stream is closed, the bus is free


@pytest.mark.parametrize("at", [-8, -7, -4])
def test_a_ctrl_c_at_the_end_leaves_no_register_changed(path, at):
    """The last calls of a session give back data-ready and the mark; Ctrl-C interrupts one of them."""

    def session(path, last):
        with open_sensor(URL) as sensor:
            before = sensor.read_all()
            exchange, calls = sensor.bus.exchange_array, []

            def interrupted(frames):
                calls.append(1)
                replies = exchange(frames)
                if len(calls) == last:
                    raise KeyboardInterrupt
                return replies

            runner = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True)
            sensor.bus.exchange_array = interrupted
            with contextlib.suppress(KeyboardInterrupt):
                list(runner.run(so_far=False))
            sensor.bus.exchange_array = exchange
            return len(calls), {
                name: (before[name], sensor.read(name)) for name in ("MSC_CTRL", "ALM_MAG2")
            }

    count, _ = session(path, None)
    _, registers = session(path.with_name("b.session"), count + 1 + at)
    assert registers == {"MSC_CTRL": (0, 0), "ALM_MAG2": (0, 0)}


@pytest.mark.parametrize("begin", [(ScanStream, "close"), (StreamedScans, "_stop")])
def test_a_ctrl_c_as_a_stream_begins_to_close_leaves_no_register_changed(sensor, path, monkeypatch, begin):
    kind, name = begin
    close, calls = getattr(kind, name), []

    def interrupted(stream):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        close(stream)

    monkeypatch.setattr(kind, name, interrupted)
    before = sensor.read("MSC_CTRL")
    with pytest.raises(KeyboardInterrupt):
        list(SessionRunner.begin(sensor, path, plan(), SHORT, auto=True).run(so_far=False))
    assert sensor.read("MSC_CTRL") == before


@pytest.mark.parametrize("created", ["2026-05-06T10:00:00", "2026-05-06", "yesterday"])
def test_a_session_refuses_a_beginning_without_a_time_zone(sensor, path, created):
    with pytest.raises(UsageError, match=f"created_utc is '{created}': expected a time such as"):
        SessionRunner.begin(sensor, path, plan(), created_utc=created)
    assert not path.exists()


def test_a_ctrl_c_after_the_last_scan_of_a_dwell_keeps_its_samples(sensor, path, monkeypatch):
    def interrupted(bench):
        if sensor.bus.now_s() > 3.0:
            raise KeyboardInterrupt

    monkeypatch.setattr(SessionBench, "checkpoint", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(SessionRunner.begin(sensor, path, plan(), SHORT, auto=True).run(so_far=False))
    with ArchiveView(path) as view:
        (attempt,) = view.attempts()
        assert (attempt.outcome, attempt.reason) == ("interrupted", "the program ended")
        assert sum(len(block) for block in view.blocks(attempt, "dwell")) == 819


def test_lost_scans_are_counted_and_told(sensor, path, monkeypatch):
    def lose(block: ScanBlock, number: int) -> ScanBlock:
        return ScanBlock(block.registers, block.words, block.time_s, 1)

    alter(sensor, monkeypatch, lose)
    events = list(SessionRunner.begin(sensor, path, plan(), SHORT, auto=True).run(so_far=False))
    for done in of(events, DwellDone):
        assert 5 <= done.lost <= 12
    shown = [event.lost for event in of(events, Watching)]
    assert shown[0] == 1  # one block so far
    assert shown == sorted(shown)
    assert shown[-1] > sum(done.lost for done in of(events, DwellDone))
    problems = of(events, Problem)
    assert [problem.kind for problem in problems] == ["lost", "lost"]
    session = read_session(path)
    assert [entry["lost"] for entry in session.facts["dwells"]] == [d.lost for d in of(events, DwellDone)]
    assert "lost on the bus" in session.notes[0]


def test_a_low_supply_is_told_by_value_and_by_status(path):
    events = auto(path, url="sim:?seed=3&supply_v=4.6")
    problems = of(events, Problem)
    assert {problem.kind for problem in problems} == {"status", "alarm", "supply"}
    text = " ".join(problem.message for problem in problems)
    assert "supply below 4.75 V" in text
    assert "between 4.6" in text or "between 4.59" in text
    facts = read_session(path).facts
    assert len(facts["problems"]) == len(problems)
    assert all(entry["status"] & 1 for entry in facts["dwells"])


# -- operator -------------------------------------------------------------------------------------------


def test_a_question_stands_until_it_is_answered_and_the_sensor_is_watched_meanwhile(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT)
    watched, question = 0, None
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked | ExtensionOffered):
            watched, question = 0, event
        if isinstance(event, Watching) and event.state == "idle":
            watched += 1
            assert abs(np.linalg.norm(event.accel_mg) - 1000) < 60
            if watched == 5:
                runner.answer("confirm" if isinstance(question, PositionAsked) else "decline")
    assert watched == 5
    assert len(read_session(path).dwells) == 2


def test_answers_may_come_from_another_thread(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT)
    asked: list[Event] = []

    def answer() -> None:
        runner.answer("confirm" if isinstance(asked[-1], PositionAsked) else "decline")

    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked | ExtensionOffered):
            asked.append(event)
            thread = threading.Thread(target=answer)
            thread.start()
            thread.join(600)
    assert len(asked) == 3
    assert isinstance(event, Finished)


def test_skip_leaves_a_position_out_for_good(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT)
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            runner.answer("skip" if event.place == 1 else "confirm")
    assert isinstance(event, Finished)
    assert (event.done, event.skipped, event.complete) == (3, 1, True)
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 180.0, 270.0]
    assert "90°" in session.notes[0]


def test_repeat_does_the_last_dwell_again_and_keeps_both(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT)
    repeated = False
    order = []
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            if event.place == 2 and not repeated:
                repeated = True
                runner.answer("repeat")
            else:
                runner.answer("confirm")
        if isinstance(event, DwellDone):
            order.append(event.place)
    assert order == [0, 1, 1, 2, 3]
    with ArchiveView(path) as view:
        assert len(view.attempts()) == 5
        assert [a.number for a in view.dwells()] == [1, 3, 4, 5]
    assert [dwell.angle_deg for dwell in read_session(path).dwells] == [0.0, 90.0, 180.0, 270.0]


def test_repeat_is_not_offered_before_the_first_dwell(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT)
    for event in runner.run(so_far=False):
        if isinstance(event, PositionAsked):
            assert not event.can_undo
            with pytest.raises(UsageError, match="open question"):
                runner.answer("repeat")
            runner.stop()
    with pytest.raises(UsageError):
        runner.answer("confirm")


def test_stop_within_a_dwell_keeps_it_as_interrupted_and_the_session_resumes(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True)
    events = []
    for event in runner.run(so_far=False):
        events.append(event)
        if isinstance(event, DwellProgress) and event.place == 1:
            runner.stop()
    assert isinstance(event, Finished)
    assert not event.complete
    assert of(events, DwellInterrupted)[0].reason == "stopped by the operator"
    assert "unfinished session: 1 of 2" in read_session(path).notes[0]
    with open_sensor(URL) as again:
        last = list(SessionRunner.resume(again, path, auto=True).run(so_far=False))[-1]
    assert isinstance(last, Finished)
    assert last.complete


def test_a_resumed_session_tells_the_result_so_far_before_it_asks(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT, auto=True)
    for event in runner.run(so_far=False):
        if isinstance(event, DwellDone) and event.place == 2:
            runner.stop()
    with open_sensor(URL) as again:
        for event in SessionRunner.resume(again, path, auto=True).run():
            if isinstance(event, Running):
                assert event.dwells == 3
                return
            assert not isinstance(event, PositionAsked)


# -- extension ------------------------------------------------------------------------------------------


def test_after_two_positions_the_session_says_what_it_cannot_see_and_goes_on_to_four(path):
    with open_sensor(URL) as opened:
        runner = SessionRunner.begin(opened, path, plan(), SHORT, auto=True)
        offered = None
        places = []
        for event in runner.run(so_far=False):
            if isinstance(event, ExtensionOffered):
                offered = event
                runner.answer("accept")
            if isinstance(event, DwellDone):
                places.append(event.position.angle_deg)
    assert offered is not None
    assert "2 positions cannot see a bias: 10 mg on each axis would put 0.81° into Δφ" in offered.reasons[0]
    assert places == [0.0, 90.0, 180.0, 270.0]
    session = read_session(path)
    assert session.facts["plan"]["name"] == "four-position"
    assert session.facts["complete"]
    auto(path.with_name("four.session"), plan("four-position"))
    assert same_dwells(path, path.with_name("four.session"))


def test_extend_accepts_by_itself_and_without_it_an_automatic_session_declines(sensor, path):
    list(SessionRunner.begin(sensor, path, plan(), SHORT, auto=True, extend=True).run(so_far=False))
    assert len(read_session(path).dwells) == 4
    other = path.with_name("b.session")
    auto(other)
    assert len(read_session(other).dwells) == 2


# -- resuming -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stop_after", "stream"), [(0, 1), (1, 1), (3, 1), (0, 0), (2, 0)])
def test_a_resumed_simulated_session_equals_the_undisturbed_one_to_the_bit(tmp_path, stop_after, stream):
    whole, parts = tmp_path / "whole.session", tmp_path / "parts.session"
    made = plan("tumble", 3)
    url = f"sim:?seed=5&fixture_sigma_deg=0.1&backlash_deg=0.05&self_heating_c=5&stream={stream}"
    auto(whole, made, url=url)
    with open_sensor(url) as opened:
        run = SessionRunner.begin(opened, parts, made, SHORT, auto=True).run(so_far=False)
        done = 0
        for event in run:
            done += isinstance(event, DwellDone)
            if done == stop_after and isinstance(event, DwellProgress) and event.elapsed_s > 0.3:
                break
        run.close()
    with Archive.open_existing(parts) as archive:
        assert len(archive.dwells()) == stop_after
    with open_sensor(url) as opened:
        events = list(SessionRunner.resume(opened, parts, auto=True).run(so_far=False))
    assert len(of(events, DwellDone)) == 6 - stop_after
    assert isinstance(events[0], Started)
    assert events[0].resumed
    assert events[0].done == stop_after
    assert same_dwells(whole, parts)
    assert read_session(parts).notes == ()


def test_a_fault_that_had_passed_does_not_come_back_with_resuming(tmp_path):
    """The supply rises over its limit within the first dwell; the second one has no EA, resumed or not."""
    url = "sim:?seed=5&supply_v=4.735&supply_drift_v_per_h=12&supply_noise_v=0"
    whole, parts = tmp_path / "whole.session", tmp_path / "parts.session"
    made = plan("four-position")
    settings = Settings(dwell_s=4.0, settle_s=0.1)
    assert {p.kind for p in of(auto(whole, made, settings, url=url), Problem)} == {"alarm", "supply"}
    with open_sensor(url) as opened:
        run = SessionRunner.begin(opened, parts, made, settings, auto=True).run(so_far=False)
        next(event for event in run if isinstance(event, DwellDone))
        run.close()
    with open_sensor(url) as opened:
        list(SessionRunner.resume(opened, parts, auto=True).run(so_far=False))

    def words(path: Path) -> list[np.ndarray]:
        with ArchiveView(path) as view:
            return [join(view.blocks(a, "dwell")).words for a in view.dwells()]

    for ours, theirs in zip(words(parts), words(whole), strict=True):
        assert np.array_equal(ours, theirs)
    assert (words(whole)[0] & EA).any()
    assert not (words(whole)[1] & EA).any()


def test_twice_resumed_after_motion_equals_the_undisturbed_one(tmp_path):
    def run(path: Path, breaks: list[int], url: str = "sim:?seed=6&fixture_sigma_deg=0.1") -> None:
        runs = 0
        while True:
            with open_sensor(url) as opened:
                make = SessionRunner.resume if path.exists() else SessionRunner.begin
                args = () if path.exists() else (plan("four-position"), SHORT)
                events = make(opened, path, *args, auto=True).run(so_far=False)
                finished = False
                for event in events:
                    # The same knock in every life: the world line with an interruption in it.
                    knock = isinstance(event, DwellProgress) and event.place == 1
                    if knock and abs(event.elapsed_s - 0.5) < 0.07 and not knocked(opened):
                        opened.bus.stage.move_to(90.4)
                    if runs < len(breaks) and isinstance(event, DwellDone) and event.place == breaks[runs]:
                        break
                    finished = isinstance(event, Finished)
                events.close()
                runs += 1
            if finished:
                return

    def knocked(opened: Adis16354) -> bool:
        return opened.bus.stage.angle_deg == pytest.approx(90.4)

    run(tmp_path / "a", [])
    with ArchiveView(tmp_path / "a") as view:
        assert [a.outcome for a in view.attempts()].count("interrupted") == 1
    run(tmp_path / "b", [0, 2])
    with ArchiveView(tmp_path / "b") as view:
        assert len(view.runs()) == 3
    a, b = (read_session(tmp_path / name).dwells for name in "ab")
    # Replaying knows the runner's own moves, not the hand that knocked: equal up to the knock, and still
    # the same positions after it.
    assert np.array_equal(a[0].accel, b[0].accel)
    assert np.array_equal(a[1].accel, b[1].accel)
    assert [dwell.angle_deg for dwell in a] == [dwell.angle_deg for dwell in b]


def test_a_finished_session_has_nothing_to_resume(path):
    auto(path, plan("four-position"))
    before = read_session(path)
    with open_sensor(URL) as opened:
        events = list(SessionRunner.resume(opened, path, auto=True).run(so_far=False))
    assert not of(events, DwellDone)
    assert isinstance(events[-1], Finished)
    assert events[-1].complete
    assert len(read_session(path).dwells) == len(before.dwells)


def test_a_declined_extension_is_offered_again_when_resumed(path):
    auto(path)
    with open_sensor(URL) as opened:
        list(SessionRunner.resume(opened, path, auto=True, extend=True).run(so_far=False))
    assert len(read_session(path).dwells) == 4


def test_resuming_with_another_sensor_is_one_line(path):
    auto(path)
    with (
        open_sensor("sim:?seed=3&variant=adis16350", variant="adis16350") as other,
        pytest.raises(SessionError, match="began with an ADIS16354, this is an ADIS16350"),
    ):
        SessionRunner.resume(other, path)
    with (
        open_sensor("sim:?seed=4") as other,
        pytest.raises(SessionError, match=r"began with sim:\?seed=3, not with sim:\?seed=4"),
    ):
        SessionRunner.resume(other, path)


def test_resuming_a_sensor_whose_offsets_were_changed_is_one_line(path):
    run_until(path, 1)
    with open_sensor(URL) as opened:
        opened.write("XACCL_OFF", 12)
        runner = SessionRunner.resume(opened, path, auto=True)
        with pytest.raises(SessionError, match="XACCL_OFF was 0 and is 12"):
            list(runner.run(so_far=False))
    with ArchiveView(path) as view:
        assert len(view.runs()) == 1


def run_until(path: Path, dwells: int) -> None:
    with open_sensor(URL) as opened:
        run = SessionRunner.begin(opened, path, plan("four-position"), SHORT, auto=True).run(so_far=False)
        done = 0
        for event in run:
            done += isinstance(event, DwellDone)
            if done == dwells:
                break
        run.close()


class PlaneStage:
    """A stage that turns about one axis only."""

    def move_to(self, angle_deg: float, approach: int = 1) -> None:
        """Never called."""


def test_a_real_sensor_goes_on_with_time_that_increases(path):
    """The second life's clock starts earlier than the first one ended, as after a reboot."""
    with Adis16354(HandBus(URL, starts_at_s=5000.0, virtual_time=False)) as opened:
        runner = SessionRunner.begin(opened, path, plan(), SHORT)
        for event in runner.run(so_far=False):
            if isinstance(event, PositionAsked):
                runner.answer("confirm" if event.place == 0 else "stop")
    with Adis16354(HandBus(URL, starts_at_s=3.0, virtual_time=False)) as opened:
        opened.bus.inner.stage.move_to(90.0)
        runner = SessionRunner.resume(opened, path)
        for event in runner.run(so_far=False):
            if isinstance(event, PositionAsked):
                assert event.place == 1
                runner.answer("confirm")
            if isinstance(event, ExtensionOffered):
                runner.answer("decline")
    session = read_session(path)
    assert [dwell.angle_deg for dwell in session.dwells] == [0.0, 90.0]
    assert session.dwells[0].time_s[0] < 10
    assert session.dwells[1].time_s[0] > session.dwells[0].time_s[-1]
    assert "truth" not in session.facts
    with open_sensor(URL) as simulated, pytest.raises(SessionError, match="began with a real sensor"):
        SessionRunner.resume(simulated, path)


def test_poses_are_recorded_without_angle_and_resume_to_the_bit(path):
    made = plan("poses", 10, check=1)
    auto(path, made)
    session = read_session(path)
    assert session.plane == "none"
    assert session.free_attitudes
    assert [dwell.angle_deg for dwell in session.dwells] == [None] * 11
    means = np.array([dwell.accel.mean(axis=0) * 0.4672e-3 for dwell in session.dwells])
    wanted = np.array([position.direction for position in made.positions])
    assert np.abs(means - wanted).max() < 0.06
    parts = path.with_name("b.session")
    with open_sensor(URL) as opened:
        run = SessionRunner.begin(opened, parts, made, SHORT, auto=True).run(so_far=False)
        for event in run:
            if isinstance(event, DwellDone) and event.place == 3:
                break
        run.close()
    with open_sensor(URL) as opened:
        list(SessionRunner.resume(opened, parts, auto=True).run(so_far=False))
    assert same_dwells(path, parts)


def test_an_operator_may_hold_the_part_in_any_pose(path):
    rng = np.random.default_rng(2)
    with Adis16354(HandBus(URL, starts_at_s=0.0, virtual_time=False)) as opened:
        runner = SessionRunner.begin(opened, path, plan("poses", 9), SHORT)
        for event in runner.run(so_far=False):
            if isinstance(event, PositionAsked):
                opened.bus.inner.stage.orient(rng.standard_normal(3))
                runner.answer("confirm")
            if isinstance(event, GuardRaised):
                assert event.kind == "upside_down"
                runner.answer(event.default)
    norms = [np.linalg.norm(dwell.accel.mean(axis=0) * 0.4672) for dwell in read_session(path).dwells]
    assert norms == pytest.approx([1000.0] * 9, abs=60)


# -- wrong use ------------------------------------------------------------------------------------------


def test_auto_needs_a_stage_and_leaves_no_file(path):
    with (
        Adis16354(HandBus(URL, starts_at_s=0.0, virtual_time=False)) as opened,
        pytest.raises(UsageError, match="auto needs a stage"),
    ):
        SessionRunner.begin(opened, path, plan(), SHORT, auto=True)
    with open_sensor(URL) as opened:
        opened.bus.stage = PlaneStage()
        with pytest.raises(UsageError, match="needs an operator"):
            SessionRunner.begin(opened, path, plan("poses"), SHORT, auto=True)
    assert not path.exists()


def test_a_session_is_never_begun_over_another(path):
    auto(path)
    content = path.read_bytes()
    with open_sensor(URL) as opened, pytest.raises(UsageError, match="exists already"):
        SessionRunner.begin(opened, path, plan(), SHORT, auto=True)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"dwell_s": 0.0}, "dwell_s is 0"),
        ({"dwell_s": float("nan")}, "dwell_s is nan"),
        ({"dwell_s": 0.01}, "take 0.0195 s or more"),
        ({"settle_s": -1.0}, "settle_s"),
        ({"smpl_prd": 0}, "smpl_prd is 0"),
        ({"filter_m": 7}, "filter_m is 7"),
        ({"gyro_range_dps": 75, "filter_m": 2}, "needs filter_m >= 4"),
        ({"registers": ("XACCL_OUT",)}, "lacks YACCL_OUT, ZACCL_OUT"),
    ],
)
def test_settings_that_cannot_be_are_one_line(change, words):
    with pytest.raises(UsageError, match=words):
        Settings(**change)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gravity_mps2": 0.0}, "gravity is 0: give m/s²"),
        ({"gravity_mps2": 980.7}, r"are 9\.807 m/s²"),
        ({"fixture_sigma_deg": -0.1}, "fixture_sigma_deg"),
    ],
)
def test_circumstances_that_cannot_be_are_one_line(sensor, path, change, words):
    with pytest.raises(UsageError, match=words):
        SessionRunner.begin(sensor, path, plan(), SHORT, auto=True, **change)
    assert not path.exists()


def test_a_runner_runs_once(sensor, path):
    runner = SessionRunner.begin(sensor, path, plan(), SHORT, auto=True)
    list(runner.run(so_far=False))
    with pytest.raises(UsageError, match="runs once"):
        next(runner.run(so_far=False))


def test_events_become_json(path):
    import json

    for event in auto(path):
        assert json.loads(json.dumps(event.as_dict()))["event"] == type(event).__name__
