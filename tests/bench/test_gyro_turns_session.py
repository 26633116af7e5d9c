"""Recording whole turns: plan, prompts, guards, break and resume, command line."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.bench.dialogue import KEPT_S
from adis_gonio.bench.events import (
    ExtensionOffered,
    GuardRaised,
    Paused,
    PositionAsked,
    TurnDone,
    TurnProgress,
    Watching,
)
from adis_gonio.bench.gyro_turns import gyro_turns_plan
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.device.sensor import open_sensor
from adis_gonio.device.sensor.settings import sample_period_s
from adis_gonio.faces.cli import app, main
from adis_gonio.fitting import fit
from adis_gonio.fitting.gyros.gyro_readings import rate_intervals
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan as plan_by_name
from adis_gonio.record.source import Settings
from bench.hand_bench import Hand, hand_sensor

URL = (
    "sim:?seed=11&hand_moves=1&move_speed_dps=80&gyro_scale_x=1.01&gyro_scale_y=0.985&gyro_scale_z=1.004"
    "&gyro_misalignment_xy_deg=0.5&gyro_misalignment_yx_deg=-0.5&gyro_noise_dps=0.3&gyro_instability_dps=0.005"
)
QUICK = Settings(dwell_s=1.5, settle_s=0.1)
PLAN = gyro_turns_plan(1)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("gyros") / "turns.session"
    options = ["--turns", "1", "--dwell", "1.5", "--settle", "0.1"]
    answer = CliRunner().invoke(
        app, ["calibrate", URL, "--plan", "gyro-turns", *options, "--auto", "-o", str(path), "--json"]
    )
    assert answer.exit_code == 0, answer.output
    return path, json.loads(answer.stdout), answer.stderr


# -- plan and prompts ------------------------------------------------------------------------------


def test_plans_without_turns_are_written_as_before():
    assert "turned_deg" not in plan_by_name("mmpm").as_dict()["positions"][0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--plan", "gyro-turns", "--trace"], "--trace: not with --plan gyro-turns"),
        (["--plan", "gyro-turns", "--duration", "60"], "--duration: not with --plan gyro-turns"),
        (["--plan", "mmpm", "--turns", "2"], "--turns: not with --plan mmpm"),
        (["--plan", "gyro-turns", "--turns", "99"], "take 1 to 20 each way"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(options, message, tmp_path):
    answer = CliRunner().invoke(app, ["calibrate", "sim:?seed=1", *options, "-o", str(tmp_path / "a")])
    assert isinstance(answer.exception, UsageError)
    assert message in str(answer.exception)


def test_auto_is_refused_where_the_stage_turns_no_table():
    class Planar:
        def move_to(self, angle_deg: float, approach: int = 1) -> None: ...

        def orient(self, vector: object) -> None: ...

    with open_sensor("sim:?seed=1") as sensor:
        bench = SessionBench(sensor, QUICK)
        bench.stage = Planar()
        with pytest.raises(UsageError, match="does not turn a table"):
            bench.require_auto(PLAN)


# -- a session -------------------------------------------------------------------------------------


def test_calibrate_states_gains_and_directions_within_their_u(recorded):
    _, document, said = recorded
    truth = {"gyro_scale_x": 1.01, "gyro_scale_y": 0.985, "gyro_scale_z": 1.004}
    truth |= {"gyro_misalignment_xy": 0.5, "gyro_misalignment_yx": -0.5, "gyro_misalignment_zx": 0.0}
    for name, true in truth.items():
        one = document["parameters"][name]
        assert abs(one["value"] - true) < 4 * one["u"], name
        assert one["u"] < (0.003 if "scale" in name else 0.5), name
    assert document["turns_used"] == 6
    assert document["positions_used"] == 12
    turned = document["triad"]["triad_rotation_z"]
    assert abs(turned["value"] - 0.5) < 4 * turned["u"]
    assert "1 full turn, " in said


def test_it_is_fitted_again_from_its_file(recorded):
    path, document, _ = recorded
    answer = CliRunner().invoke(app, ["fit", str(path), "--sensor-part", "gyro", "--json"])
    assert json.loads(answer.stdout)["parameters"] == document["parameters"]


def test_turns_are_read_when_asked_for_and_cost_a_fit_without_gyros_nothing(recorded, monkeypatch):
    from adis_gonio.record import session_reader as reading

    asked = []
    real = reading.read_turns
    monkeypatch.setattr(reading, "read_turns", lambda *given: asked.append(1) or real(*given))
    session = load_session(recorded[0])
    from adis_gonio.fitting.estimation.readings import readings_of

    readings_of(session)
    assert not asked
    assert len(session.turns) == 11
    assert session.turns is session.turns
    assert asked == [1]


def test_each_whole_turn_is_three_hundred_and_sixty_degrees_by_its_mark(recorded):
    found = rate_intervals(load_session(recorded[0]))
    angle = np.linalg.norm(found.column("rotation_dps") * found.column("length_s")[:, None], axis=1)[
        found.column("turn")
    ]
    assert angle == pytest.approx(np.full(6, 360.0))
    assert not found.refused
    axis = (
        found.column("rotation_dps")[found.column("turn")]
        / np.linalg.norm(found.column("rotation_dps")[found.column("turn")], axis=1)[:, None]
    )
    u = np.sqrt(
        np.einsum(
            "ni,nij,nj->n", axis, found.column("rotation_covariance_dps2")[found.column("turn")], axis
        )
    )
    # Two marks a turn, the one in the middle shared by both turns.
    assert u * found.column("length_s")[found.column("turn")] == pytest.approx(
        np.full(6, np.sqrt(3) * 0.05)
    )


def test_a_session_that_is_stopped_within_a_turn_resumes_to_the_same_result(recorded, tmp_path):
    path = tmp_path / "broken.session"
    # The length of a scan decides when the next dwell begins.
    scanned = load_session(recorded[0]).facts["settings"]["registers"]
    settings = replace(QUICK, registers=tuple(scanned))
    with open_sensor(URL) as sensor:
        runner = SessionRunner.begin(sensor, path, PLAN, settings, auto=True, fixture_sigma_deg=0.05)
        for event in runner.run(so_far=False):
            if isinstance(event, TurnProgress) and event.state == "turn" and _dwells(path) == 5:
                runner.stop()
    assert _dwells(path) == 5
    answer = CliRunner().invoke(app, ["calibrate", URL, "--resume", "--auto", "-o", str(path), "--json"])
    assert answer.exit_code == 0, answer.output
    assert len(load_session(path).turns) == 11
    one, other = load_session(path), load_session(recorded[0])
    for mine, theirs in zip(one.dwells, other.dwells, strict=True):
        assert np.array_equal(mine.gyro, theirs.gyro)
    assert json.loads(answer.stdout)["parameters"].keys() == recorded[1]["parameters"].keys()
    for name, value in json.loads(answer.stdout)["parameters"].items():
        assert abs(value["value"] - recorded[1]["parameters"][name]["value"]) < 0.5 * value["u"], name


def _dwells(path) -> int:
    with ArchiveView(path) as view:
        return len(view.dwells())


def test_plain_prompts_lead_through_it_by_enter_alone(tmp_path):
    path = tmp_path / "plain.session"
    options = ["--positions", "3", "--turns", "1", "--dwell", "1", "--settle", "0.1", "-o", str(path)]
    url = "sim:?seed=2&move_speed_dps=150"
    answer = CliRunner().invoke(app, ["calibrate", url, "--plan", "gyro-turns", *options], input="\n" * 12)
    assert answer.exit_code == 0, answer.output
    assert "flat on the table, against the mark, with its Y arrow up and press Enter" in answer.stderr
    assert "turn it once clockwise, seen from above" in answer.stderr
    assert answer.stderr.count("1 full turn, ") == 6
    assert "gyro_scale_z" in answer.stdout
    assert "triad_rotation_x" in answer.stdout


# -- by hand ---------------------------------------------------------------------------------------


class Turner:
    """An operator at a table who turns the part as far as they like."""

    def __init__(
        self, sensor, turned=lambda event, times: event.position.turned_deg, axis=None, faces=None
    ):
        self.bus, self.stage = sensor.bus, sensor.bus.inner.world.stage
        self._turned = turned or (lambda event, times: event.position.turned_deg)
        self._axis, self._faces = axis, faces or {}
        self._asked, self._times, self._waits = None, {}, False
        self.guards: list[GuardRaised] = []

    def see(self, runner: SessionRunner, event) -> None:
        now = max(self.bus.inner.now_s(), self.stage.still_at_s)
        if isinstance(event, PositionAsked):
            times = self._times[event.place] = self._times.get(event.place, -1) + 1
            self._asked = event
            if event.position.turned_deg is None:
                self.stage.orient(
                    now, np.array(self._faces.get((event.place, times), event.position.direction))
                )
                self._waits = True
            else:
                runner.answer("confirm")
        elif isinstance(event, Watching) and self._waits and self.bus.inner.now_s() > self.stage.still_at_s:
            self._waits = False
            runner.answer("confirm")
        elif isinstance(event, TurnProgress) and event.state == "turn" and self._asked is not None:
            asked, self._asked = self._asked, None
            by = self._turned(asked, self._times[asked.place])
            self.stage.turn_about(now, by, self._axis)
        elif isinstance(event, GuardRaised):
            self.guards.append(event)
            runner.answer(event.default)


def by_hand(tmp_path, until, url="sim:?seed=3&move_speed_dps=120", **turner):
    """Run a session by hand until so many dwells are done, or a guard stops; events, operator, session."""
    path = tmp_path / "hand.session"
    events = []
    with hand_sensor(url) as sensor:
        runner = SessionRunner.begin(sensor, path, PLAN, QUICK)
        operator = Turner(sensor, **turner)
        for event in runner.run(so_far=False):
            events.append(event)
            operator.see(runner, event)
            reached = isinstance(event, PositionAsked) and event.place == until
            if reached or (until is None and operator.guards):
                runner.stop()
    return events, operator, load_session(path)


def test_a_turn_that_is_not_whole_is_asked_again_and_the_new_one_counts(tmp_path):
    events, operator, session = by_hand(
        tmp_path, 2, turned=lambda event, times: event.position.turned_deg - 60.0 * (times == 0)
    )
    assert [guard.kind for guard in operator.guards] == ["wrong_angle"]
    assert "off a whole number of turns" in operator.guards[0].message
    assert operator.guards[0].values["off_deg"] == pytest.approx(-60, abs=5)
    assert [round(event.turned_deg, -1) for event in events if isinstance(event, TurnDone)] == [300, 360]
    assert np.abs(session.turns[0].gyro).max() > 100
    found = rate_intervals(session)
    assert (found.column("mean_dps") * found.column("length_s")[:, None])[
        found.column("turn"), 0
    ] == pytest.approx(360, abs=25)


def test_a_turn_the_other_way_is_asked_again(tmp_path):
    def turned(event, times):
        return -360.0 if event.place == 1 and times == 0 else event.position.turned_deg

    _, operator, session = by_hand(tmp_path, 3, turned=turned)
    assert [guard.kind for guard in operator.guards] == ["reversed"]
    assert operator.guards[0].default == "retake"
    found = rate_intervals(session)
    angle = (found.column("rotation_dps") * found.column("length_s")[:, None])[found.column("turn"), 0]
    assert angle == pytest.approx([360, -360], abs=1)


def test_a_turn_about_another_axis_stops_with_its_axis(tmp_path):
    _, operator, _ = by_hand(tmp_path, None, axis=np.array([0.7, 0.0, 0.72]))
    assert operator.guards[0].kind == "wrong_axis"
    assert "not about the vertical" in operator.guards[0].message


def test_a_turn_beyond_the_range_stops_with_its_rate(tmp_path):
    _, operator, _ = by_hand(tmp_path, None, url="sim:?seed=3&move_speed_dps=230")
    assert operator.guards[0].kind == "over_range"
    assert "beyond its range of ±300 °/s" in operator.guards[0].message


def test_gyros_that_show_no_turn_end_an_automatic_session_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("adis_gonio.bench.gyro_turns.PATIENCE_S", 15.0)
    with open_sensor("sim:?seed=3") as sensor:
        sample = sensor.bus.world.sample

        def dead(time_s):
            inputs = sample(time_s)
            return replace(inputs, gyro_dps=np.zeros_like(inputs.gyro_dps))

        sensor.bus.world.sample = dead
        runner = SessionRunner.begin(sensor, tmp_path / "dead.session", PLAN, QUICK, auto=True)
        with pytest.raises(SessionError, match="no whole turn within 15 s; check the table and the gyros"):
            list(runner.run(so_far=False))


def test_a_part_on_the_wrong_face_is_asked_again(tmp_path):
    _, operator, session = by_hand(tmp_path, 1, faces={(0, 0): (0.0, 0.0, -1.0)})
    assert [guard.kind for guard in operator.guards] == ["upside_down"]
    assert "the X arrow does not point up" in operator.guards[0].message
    assert session.dwells[0].accel.mean(axis=0)[0] < -2000


# -- turns of sessions on the stage ------------------------------------------------------------------


STAGE_URL = "sim:?seed=1&hand_moves=1&gyro_scale_z=1.01&gyro_instability_dps=0.003"


def on_stage(path, *options):
    plan = ["--plan", "four-position", "--dwell", "2", "--auto", "-o", str(path)]
    answer = CliRunner().invoke(app, ["calibrate", STAGE_URL, *plan, *options])
    assert answer.exit_code == 0, answer.output
    return answer.stdout


def test_calibrate_keeps_the_moves_which_give_the_gain(tmp_path):
    path = tmp_path / "stage.session"
    on_stage(path)
    gyros = CliRunner().invoke(app, ["fit", str(path), "--sensor-part", "gyro", "--json"])
    fitted = json.loads(gyros.stdout)
    assert fitted["turns_used"] == 3
    gain = fitted["parameters"]["gyro_scale_z"]
    assert abs(gain["value"] - 1.01) < 4 * gain["u"]
    assert gain["u"] < 0.003
    page = inside(CliRunner(), path, tmp_path / "report.html")
    told = html.unescape(page).replace("\u00a0", " ")
    assert re.search(r">gain<.*?1\.0\d+ ± 0\.00", told, re.DOTALL)


def inside(runner, path, page):
    assert runner.invoke(app, ["report", str(path), "-o", str(page)]).exit_code == 0
    return page.read_text("utf-8")


def test_moves_are_left_out_where_that_is_wanted(tmp_path):
    path = tmp_path / "stage.session"
    on_stage(path, "--no-record-turns")
    session = load_session(path)
    assert "turns" not in session.facts["settings"]
    assert not rate_intervals(session).column("turn").any()


def test_the_option_of_earlier_versions_asks_for_what_is_the_default_now(tmp_path):
    paths = tmp_path / "default.session", tmp_path / "asked.session"
    for path, options in zip(paths, ([], ["--record-turns"]), strict=True):
        on_stage(path, *options)
    one, other = map(load_session, paths)
    assert one.facts["settings"] == other.facts["settings"]
    assert all(np.array_equal(a.gyro, b.gyro) for a, b in zip(one.turns, other.turns, strict=True))


def test_a_move_that_is_broken_off_while_it_is_kept_is_made_again(tmp_path):
    path, stopped, asked = tmp_path / "broken.session", False, 0
    settings = Settings(dwell_s=0.5, settle_s=0.1, turns=True)
    with open_sensor("sim:?seed=1&move_speed_dps=20") as sensor:
        runner = SessionRunner.begin(
            sensor, path, plan_by_name("two-position"), settings, fixture_sigma_deg=0
        )
        for event in runner.run(so_far=False):
            if isinstance(event, PositionAsked):
                asked += 1
                runner.answer("confirm")
            elif isinstance(event, Watching) and event.state == "moving" and asked == 2 and not stopped:
                stopped = True
                runner.pause()
            elif isinstance(event, Paused):
                runner.unpause()
            elif isinstance(event, (GuardRaised, ExtensionOffered)):
                runner.answer(event.default if isinstance(event, GuardRaised) else "decline")
    assert stopped
    assert asked == 3
    assert len(load_session(path).dwells) == 2


def test_a_session_whose_turns_are_recorded_resumes_to_the_same_samples(tmp_path):
    whole, broken = tmp_path / "whole.session", tmp_path / "broken.session"
    settings = Settings(dwell_s=0.5, settle_s=0.1, turns=True)
    for path, until in ((whole, 9), (broken, 2)):
        with open_sensor("sim:?seed=1&hand_moves=1") as sensor:
            runner = SessionRunner.begin(sensor, path, plan_by_name("four-position"), settings, auto=True)
            for event in runner.run(so_far=False):
                if isinstance(event, PositionAsked) and event.place == until:
                    runner.stop()
    with open_sensor("sim:?seed=1&hand_moves=1") as sensor:
        list(SessionRunner.resume(sensor, broken, auto=True).run(so_far=False))
    one, other = load_session(broken), load_session(whole)
    for mine, theirs in zip((*one.dwells, *one.turns[2:]), (*other.dwells, *other.turns[2:]), strict=True):
        assert np.array_equal(mine.gyro, theirs.gyro)


def test_turns_by_hand_are_kept_where_that_is_wanted_and_only_there(tmp_path):
    held = {}
    for wanted in (True, False):
        path = tmp_path / f"{wanted}.session"
        with hand_sensor() as sensor:
            settings = Settings(dwell_s=0.5, settle_s=0.1, turns=wanted)
            runner = SessionRunner.begin(
                sensor, path, plan_by_name("four-position"), settings, fixture_sigma_deg=0.02
            )
            operator = Hand(sensor)
            for event in runner.run(so_far=False):
                operator.see(runner, event)
        held[wanted] = load_session(path)
    found = rate_intervals(held[True])
    angle = (found.column("rotation_dps") * found.column("length_s")[:, None])[found.column("turn"), 2]
    assert angle == pytest.approx([90, 90, 90], abs=1)
    missing = rate_intervals(held[False])
    assert not missing.column("turn").any()
    assert missing.refused == ("turns to dwell 1–3: the part was turned while nothing was recorded",)
    assert "turns" not in held[False].facts["settings"]
    for kept, bare in zip(held[True].dwells, held[False].dwells, strict=True):
        assert np.array_equal(kept.accel, bare.accel)
        assert np.array_equal(kept.time_s, bare.time_s)
    rows = {wanted: session_rows(session) for wanted, session in held.items()}
    assert rows[True] == rows[False]
    documents = {wanted: fit(session).as_dict() for wanted, session in held.items()}
    assert documents[True]["parameters"] == documents[False]["parameters"]


def session_rows(session):
    """What `export --format csv` writes of its samples."""
    return session.to_pandas().to_csv()


def test_a_long_question_costs_the_file_two_minutes_of_scans_and_no_more(tmp_path):
    sizes, slow = {}, 0x30
    for wanted in (False, True):
        path = tmp_path / f"{wanted}.session"
        with hand_sensor() as sensor:
            settings = Settings(dwell_s=1, settle_s=0.1, smpl_prd=slow, turns=wanted)
            runner = SessionRunner.begin(sensor, path, plan_by_name("two-position"), settings)
            operator, asked_s = Hand(sensor), 0.0
            for event in runner.run(so_far=False):
                if isinstance(event, PositionAsked):
                    asked_s = sensor.bus.now_s()
                idle = isinstance(event, Watching) and event.state == "idle"
                if not idle or sensor.bus.now_s() > asked_s + KEPT_S + 60.0:
                    operator.see(runner, event)
        sizes[wanted] = path.stat().st_size
    kept = 2 * (KEPT_S / sample_period_s(slow)) * (8 * 2 + 8)  # words of eight registers, and the time
    assert 0.9 < (sizes[True] - sizes[False]) / kept < 1.2


def test_a_session_whose_file_has_gone_has_no_turns_and_is_fitted_all_the_same(tmp_path):
    path = tmp_path / "gone.session"
    assert main(["calibrate", "sim:?seed=4", "--plan", "four-position", "--auto", "-o", str(path)]) == 0
    gone = load_session(path)
    path.unlink()
    assert gone.turns == ()
    assert fit(gone)["delta_k"].u > 0
