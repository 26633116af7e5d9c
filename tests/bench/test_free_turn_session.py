"""Recording a free turn: archive, break and resume, CSV, command line."""

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from adis_gonio.base.errors import CannotOpenError, DataError
from adis_gonio.bench.events import Finished, Problem, TurnDone, TurnProgress
from adis_gonio.bench.recorder import free_turn_plan
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.faces.cli import app
from adis_gonio.fitting import fit
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import Plan
from adis_gonio.record.provenance import digest_of
from adis_gonio.record.samples_writer import write_samples_csv
from adis_gonio.record.source import Settings

URL = "sim:?seed=4&lever_x_mm=30&gyro_scale_z=1.01&hand_turn_s=30"


def runner(sensor, path, **settings):
    return SessionRunner.begin(
        sensor, path, free_turn_plan(), Settings(dwell_s=60.0, **settings), auto=True
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("turn") / "turn.session"
    answer = CliRunner().invoke(
        app, ["calibrate", URL, "--plan", "free-turn", "--auto", "-o", str(path), "--json"]
    )
    assert answer.exit_code == 0, answer.output
    assert "2 full turns, 730° in all" in answer.stderr
    return path, json.loads(answer.stdout)


def test_calibrate_records_a_turn_and_answers(recorded):
    path, document = recorded
    assert document["method"] == "free-turn"
    assert document["complete"]
    for name in ("delta_k", "delta_phi"):
        one = document["parameters"][name]
        assert abs(one["value"] - document["truth"][name]) < 4 * one["u"]
    again = CliRunner().invoke(app, ["fit", str(path), "--json"])
    assert json.loads(again.stdout)["parameters"] == document["parameters"]


def test_the_recording_is_continuous_and_ends_with_the_rest_after_two_full_turns(recorded):
    session = load_session(recorded[0])
    whole = session.recording
    assert session.free_turn
    assert not session.dwells
    assert np.diff(whole.time_s).max() < 1.5 * np.median(np.diff(whole.time_s))
    assert 33.0 < whole.time_s[-1] - whole.time_s[0] < 45.0
    assert whole.gyro is not None
    assert whole.temperature_c is not None
    assert whole.supply_v is not None


def test_every_parameter_stands_beside_its_truth(recorded):
    """The truth is that of the recording: a gyro's bias walks, and the length is not the longest one."""
    path, document = recorded
    assert "truth" in CliRunner().invoke(app, ["fit", str(path)]).stdout
    assert not set(document["parameters"]) - set(document["truth"])
    for name, one in document["parameters"].items():
        assert abs(one["value"] - document["truth"][name]) < 4.5 * one["u"], name


def test_fewer_turns_than_asked_for_are_used_and_said_in_a_line(tmp_path):
    """A stage that can turn once only: the recording goes on to its time."""
    path = tmp_path / "once.session"
    with open_sensor(URL) as sensor:
        running = SessionRunner.begin(
            sensor, path, free_turn_plan(2, 45.0), Settings(dwell_s=45.0), auto=True
        )
        stage = running.bench.stage
        running.bench.stage = OneTurn(stage)
        events = list(running.run())
    done = next(event for event in events if isinstance(event, TurnDone))
    assert done.turns == 1
    assert done.length_s == pytest.approx(45.0, abs=0.5)
    said = [event.message for event in events if isinstance(event, Problem)]
    assert any("1 of 2 turns seen" in line for line in said)
    result = fit(load_session(path))
    assert any(line.startswith("1 of 2 turns seen: u(Δφ) is ") for line in result.warnings)


class OneTurn:
    """A stage whose cable lets it turn once."""

    def __init__(self, stage):
        self.move_to, self._turn = stage.move_to, stage.turn_freely

    def turn_freely(self, turns=1):
        return self._turn(1)


def test_forth_and_back_is_two_turns(tmp_path):
    path = tmp_path / "back.session"
    with open_sensor(URL + "&hand_returns=1") as sensor:
        events = list(runner(sensor, path).run())
    done = next(event for event in events if isinstance(event, TurnDone))
    assert done.turns == 2
    assert done.turned_deg == pytest.approx(0.0, abs=1.0)
    assert done.length_s < 45.0
    told = [event.turn for event in events if isinstance(event, TurnProgress)]
    assert sorted(set(told)) == [1, 2]
    result = fit(load_session(path))
    truth = load_session(path).facts["truth"]
    for name in ("delta_k", "delta_phi", "bias_x", "bias_y"):
        assert abs(result[name].value - truth[name]) < 4 * result[name].u


def test_a_plan_keeps_its_turns_and_one_of_before_had_none():
    plan = free_turn_plan(3)
    assert Plan.from_dict(json.loads(json.dumps(plan.as_dict()))) == plan
    assert "turns" not in Plan("tumble", plan.positions).as_dict()
    old = {key: value for key, value in plan.as_dict().items() if key != "turns"}
    assert Plan.from_dict(old).turns == 0


def test_trace_and_report_of_it_say_what_they_can(recorded, tmp_path):
    path = str(recorded[0])
    traced = CliRunner().invoke(app, ["trace", path])
    assert "calibrate --plan tumble" in str(traced.exception or traced.output)
    page = tmp_path / "page.html"
    assert CliRunner().invoke(app, ["report", path, "-o", str(page)]).exit_code == 0
    text = page.read_text("utf-8")
    assert "one free turn" in text
    assert "free-turn" in text
    assert "Δφ" in text


def test_a_csv_of_it_without_positions_is_fitted_alike(recorded, tmp_path):
    session = load_session(recorded[0])
    write_samples_csv(session, tmp_path / "turn.csv")
    back = load_session(tmp_path / "turn.csv")
    assert (
        "position" not in (tmp_path / "turn.csv").read_text("utf-8").split("time_s", 1)[1].splitlines()[0]
    )
    assert back.free_turn
    ours, theirs = fit(session), fit(back)
    assert theirs.method == "free-turn"
    assert theirs["delta_phi"].value == pytest.approx(
        ours["delta_phi"].value, abs=0.2 * ours["delta_phi"].u
    )
    # A fleet counts sessions with equal digests once.
    another = replace(session, recording=replace(session.recording, accel=-session.recording.accel))
    assert digest_of(back) == digest_of(session) != digest_of(another)


def test_every_export_of_samples_holds_the_turn(recorded, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    session = load_session(recorded[0])
    scans = len(session.recording)
    answer = CliRunner().invoke(app, ["export", str(recorded[0]), "-o", str(tmp_path / "turn.parquet")])
    assert answer.exit_code == 0, answer.output
    table = parquet.read_table(tmp_path / "turn.parquet")
    assert table.num_rows == scans
    assert "position" not in table.column_names
    assert len(session.to_pandas()) == scans
    assert f"a free turn, {scans} samples" in repr(session)


def test_a_turn_that_is_stopped_is_kept_said_and_taken_anew(tmp_path):
    path = tmp_path / "stopped.session"
    with open_sensor(URL) as sensor:
        running = runner(sensor, path)
        for event in running.run():
            if isinstance(event, TurnProgress) and event.elapsed_s > 12:
                running.stop()
    session = load_session(path)
    assert session.recording.time_s[-1] - session.recording.time_s[0] == pytest.approx(12.0, abs=0.5)
    assert any("broken off after 12 s: stopped by the operator" in note for note in session.notes)
    with open_sensor(URL) as sensor:
        events = list(SessionRunner.resume(sensor, path, auto=True).run())
    done = next(event for event in events if isinstance(event, TurnDone))
    assert done.turned_deg == pytest.approx(730.0, abs=1.0)
    assert isinstance(events[-1], Finished)
    assert events[-1].complete
    assert not any("broken off" in note for note in load_session(path).notes)


def test_a_program_that_dies_loses_a_piece_at_most(tmp_path):
    path = tmp_path / "died.session"
    with open_sensor(URL) as sensor:
        events = runner(sensor, path).run()
        for event in events:
            if isinstance(event, TurnProgress) and event.elapsed_s > 18:
                break
        with ArchiveView(path) as view:  # nothing after this line was written by the dying program
            length = sum(len(block) for a in view.attempts() for block in view.blocks(a))
        assert length * 1.22e-3 > 18 - 5.5
        events.close()
    assert load_session(path).recording.time_s[-1] > 18


def test_nothing_recorded_is_said(tmp_path):
    path = tmp_path / "empty.session"
    with open_sensor(URL) as sensor:
        running = runner(sensor, path)
        running.stop()
        list(running.run())
    with pytest.raises(DataError, match="no turn yet; resume"):
        load_session(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--plan", "free-turn", "--positions", "4"], "--positions: not with --plan free-turn"),
        (["--plan", "free-turn", "--trace"], "--trace: not with --plan free-turn"),
        (["--plan", "tumble", "--duration", "30"], "--duration: not with --plan tumble"),
        (["--plan", "tumble", "--turns", "2"], "--turns: not with --plan tumble"),
        (["--plan", "free-turn", "--turns", "0"], "take 1 or more"),
        (["--plan", "free-turn", "--turns", "8"], "8 turns in 60 s, rests included, cannot be slow"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(options, message, tmp_path):
    answer = CliRunner().invoke(
        app, ["calibrate", URL, "--auto", "-o", str(tmp_path / "a.session"), *options]
    )
    assert answer.exit_code != 0
    assert message in str(answer.exception)


def test_a_cable_that_is_pulled_after_the_turn_loses_none_of_its_scans(tmp_path, monkeypatch):
    path, events = tmp_path / "pulled.session", []
    with open_sensor(URL) as sensor:
        running = runner(sensor, path)

        def pulled():
            raise CannotOpenError("the device is gone")

        monkeypatch.setattr(sensor, "status", pulled)
        with pytest.raises(CannotOpenError, match="is gone"):
            events.extend(running.run(so_far=False))
    with ArchiveView(path) as view:
        attempts = view.attempts()
        assert attempts[-1].reason == "the device is gone"
        assert sum(len(block) for one in attempts for block in view.blocks(one)) == events[-1].samples
