"""The same of recorded sessions: by fit, trace, report and command line, corrected by `--angles`."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio import load_session, trace
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.faces.cli import main
from adis_gonio.fitting import fit
from adis_gonio.fitting.answer import Answer
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.slips.session_positions import angles_of, failure_message, positions_of
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.loading import Overrides
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.trace import correct_slips, restrict_candidates
from bench.hand_bench import QUICK, by_hand, hand_sensor
from fakes import planar_session as planar
from slip_oracle import answer
from slip_statistics import LAW, session_of
from tracing.blind import draw, write
from tracing.test_trace_sceptic import written

AROUND = np.arange(12) * 30.0


@pytest.fixture(scope="module")
def mistyped():
    """A session by hand with gyros, one entry wrong, and the truth."""
    return session_of(22, "mistyped")


def test_the_gyro_between_the_dwells_of_a_recording_is_its_true_turn():
    session, _ = session_of(5, None)
    readings, turns = angles_of(session)
    declared = np.diff(np.degrees(readings.angle_rad))
    turned = np.degrees(turns.angle_rad)
    assert turns.turn.tolist() == list(range(1, len(readings)))
    left = (turned - declared + 180) % 360 - 180
    # The gain of 1 % and the fixture twice are what is between them.
    allowed = 4 * np.hypot(
        0.01 * turned, np.hypot(np.degrees(turns.u_rad), 1.5 * session.fixture_sigma_deg)
    )
    assert (np.abs(left) < allowed + 0.1).all()


def test_a_session_without_turns_is_judged_by_gravity_alone(mistyped):
    session, truth = mistyped
    still = replace(session, recording=None)
    assert not len(angles_of(still)[1].turn)
    (one,) = positions_of(still)
    assert (one.position, one.gyro_deg) == (truth.positions[0], None)


def test_the_oracle_answers_a_session_that_no_fault_comes_near():
    session, _ = session_of(5, None)
    dwells = [replace(dwell, angle_deg=37.0 * k**2) for k, dwell in enumerate(session.dwells)]
    assert 0 < answer(replace(session, dwells=tuple(dwells)), LAW).probability <= 1


def test_a_fit_that_fails_says_which_position_is_wrong(mistyped):
    session, truth = mistyped
    told = failure_message(replace(session, source="a.csv"), FitError("nothing is determined"))
    assert told.startswith(f"a.csv: nothing is determined; position {truth.positions[0]}: declared ")
    assert "\n" not in told


def test_a_fit_says_which_position_is_wrong_and_the_override_mends_it(mistyped):
    session, truth = mistyped
    wrong = fit(session)
    (one,) = positions_of(session)
    assert one.sentence in wrong.warnings
    assert wrong.as_dict()["positions"][0]["position"] == truth.positions[0]
    (k,) = truth.positions
    change = {k: one.meant_deg}
    mended = fit(Overrides(angles=change).apply(session))
    assert "positions" not in mended.as_dict()
    old = session.dwells[k].angle_deg
    assert mended.overrides["angles"] == {"old": {str(k): old}, "new": {str(k): one.meant_deg}}


def test_an_oracle_that_shares_no_code_says_the_same(mistyped):
    """Its evidence is of the readings themselves, its priors those of the sessions' maker."""
    session, truth = mistyped
    (one,) = positions_of(session)
    said = answer(session, LAW)
    assert (said.name, said.positions) == (one.finding, (one.position,)) == ("mistyped", truth.positions)
    assert said.error_deg == pytest.approx(truth.error_deg)
    assert said.probability > 0.99


def test_a_session_file_has_its_gyros_as_witnesses(tmp_path):
    path = tmp_path / "bench.session"
    with hand_sensor() as sensor:
        by_hand(sensor, path, settings=replace(QUICK, turns=True))
    session = load_session(path)
    readings, turns = angles_of(session)
    assert turns.turn.tolist() == list(range(1, len(readings)))
    assert not positions_of(session)
    wrong = load_session(path, Overrides(angles={2: 108.0}))
    (one,) = positions_of(wrong)
    assert (one.finding, one.position, one.meant_deg) == ("mistyped", 2, 180.0)
    assert abs(one.gyro_deg[0] - 180.0) < 4 * one.gyro_deg[1]


@pytest.fixture
def file(tmp_path):
    """A file without gyros in which one angle is mistyped."""
    declared = AROUND.copy()
    declared[7] = 120.0
    return written(tmp_path / "typed.csv", declared, AROUND)


def run(capsys, *arguments):
    status = main([*map(str, arguments)])
    return status, *capsys.readouterr()


def test_fit_names_it_and_with_the_advice_taken_says_nothing_more(capsys, file):
    status, out, _ = run(capsys, "fit", file, "--json")
    assert status == 0
    document = json.loads(out)
    (entry,) = document["positions"]
    assert (entry["position"], entry["finding"], entry["angles"]) == (7, "mistyped", "7=210")
    assert entry["sentence"] in document["warnings"]
    status, out, _ = run(capsys, "fit", file, "--json", "--angles", entry["angles"])
    document = json.loads(out)
    assert "positions" not in document
    assert document["overrides"] == {"angles": {"old": {"7": 120.0}, "new": {"7": 210.0}}}
    status, out, _ = run(capsys, "fit", file)
    assert " ".join(entry["sentence"].split()) in " ".join(out.split())


def test_a_trace_tells_the_same_story(capsys, file):
    """Its `position_slip` is of that dwell and size, and its first advice is the correction."""
    status, out, _ = run(capsys, "trace", file, "--json")
    assert status == 0
    document = json.loads(out)
    (entry,) = document["positions"]
    (slip,) = [one for one in document["found"] if one["effect"] == "position_slip"]
    assert slip["parameters"]["dwell"]["value"] == entry["position"] == 7
    # ψ = α − θ: what stands further on by e has a slip of −e.
    assert slip["parameters"]["slip"]["value"] == pytest.approx(-entry["error_deg"], abs=0.1)
    assert "--angles 7=210" in document["next"][0]
    assert not any("repeat position 7" in text for text in document["next"])


def test_a_slip_that_lasts_is_traced_as_the_part_stood(tmp_path, capsys):
    stood = AROUND + np.where(np.arange(12) >= 5, 8.0, 0.0)
    file = written(tmp_path / "slipped.csv", AROUND, stood)
    status, out, _ = run(capsys, "trace", file, "--json")
    assert status == 0
    document = json.loads(out)
    assert [one["finding"] for one in document["positions"]] == ["slipped"]
    assert document["adequate"]
    assert {one["effect"] for one in document["found"]} == {"bias"}
    assert any("traced as the part stood" in note for note in document["notes"])


def test_what_slipped_with_the_last_dwells_is_not_taken_out_once_more(tmp_path):
    around = np.arange(24) * 15.0
    stood = around + np.where(np.arange(24) >= 22, 8.0, 0.0)
    session = load_session(written(tmp_path / "slipped.csv", around, stood))
    data = readings_of(session)
    said = positions_of(session)
    assert [(one.position, one.finding, one.others) for one in said] == [(22, "slipped", (23,))]
    left = restrict_candidates(named_terms(data)[0], correct_slips(data, said), said)
    assert not any(term.begins for term in left)


def test_two_swapped_entries_are_one_doubt_about_the_answer(tmp_path):
    declared = AROUND.copy()
    declared[[3, 8]] = AROUND[[8, 3]]
    result = fit(load_session(written(tmp_path / "swapped.csv", declared, AROUND)))
    assert [one.position for one in result.position_findings] == [3, 8]
    assert len([doubt for doubt in Answer.of(result).doubts if "swapped" in doubt]) == 1


def test_a_slip_that_a_line_reaches_stays_in_the_readings_as_a_step_of_the_true_angle(tmp_path):
    stood = AROUND + np.where(np.arange(12) >= 5, 0.4, 0.0)
    result = trace(load_session(written(tmp_path / "slipped.csv", AROUND, stood)))
    assert [one.finding for one in result.position_findings] == ["slipped"]
    assert not any("traced as the part stood" in note for note in result.notes)
    assert result.adequate
    assert result.unnamed.covariates == ("time",)
    assert "true angle follows a step" in result.unnamed.form


def test_a_part_that_turns_by_and_by_is_no_periodic_error_of_the_stage(tmp_path):
    # Two slips that last would stand near it. A dial that was moved by these would stand off its 48 places,
    # at which 48 cycles a turn show nothing.
    path = tmp_path / "leaning.csv"
    write(path, *draw("uncatalogued", 274912422, 187))
    result = trace(load_session(path))
    assert result.position_findings == ()
    assert [one.effect for one in result.found] == ["bias"]
    assert "misalignment[x]~t" in result.as_dict()["rivals"][0]["terms"]


def test_a_dial_stays_where_it_was_when_the_part_has_slipped_on_it(tmp_path):
    stood = AROUND + np.where(np.arange(12) >= 5, 8.0, 0.0)
    session = load_session(written(tmp_path / "slipped.csv", AROUND, stood))
    data = readings_of(session)
    moved = correct_slips(data, positions_of(session))
    assert np.degrees(moved.angle_rad - data.angle_rad) == pytest.approx(stood - AROUND, abs=0.2)
    assert moved.conditions is data.conditions


def test_a_good_file_says_nothing_of_positions(tmp_path, capsys):
    file = written(tmp_path / "good.csv", AROUND)
    status, out, _ = run(capsys, "fit", file, "--json")
    assert status == 0
    assert "positions" not in json.loads(out)


def test_the_report_shows_the_three_angles(file):
    from adis_gonio.handover.calibration_report import build_page

    session = load_session(file)
    page = build_page(session, [fit(session)], "not traced here")
    assert "Wrong positions" in page
    assert "210.0" in page
    good = fit(load_session(file, Overrides(angles={7: 210.0})))
    assert "Wrong positions" not in build_page(session, [good], "not traced here")


# -- the override ----------------------------------------------------------------------------------------


def test_angles_are_set_before_a_session_is_reversed(tmp_path):
    path = tmp_path / "s.csv"
    path.write_text(planar.text(planar.rows(), "accel_unit: mg", "sensor: generic"), encoding="utf-8")
    plain = load_session(path)
    session = load_session(path, Overrides(angles={1: 100.0}, reverse=True))
    before = [dwell.angle_deg for dwell in plain.dwells]
    after = [dwell.angle_deg for dwell in session.dwells]
    assert after[1:3] == [-100.0, -before[2]]
    assert set(session.facts["overrides"]) == {"angles", "reverse"}
    assert any("position 1 100° instead of" in note for note in session.notes)


def test_a_position_that_is_not_there_is_refused(file):
    with pytest.raises(
        UsageError, match=r"--angles 44=1: there is no such position; numbers go from 0 to 11"
    ):
        load_session(file, Overrides(angles={44: 1.0}))


def test_a_stage_that_counted_the_other_way_from_somewhere_on_is_mended_by_angles(tmp_path, capsys):
    stood = np.where(np.arange(12) >= 7, 2 * AROUND[6] - AROUND, AROUND)
    file = written(tmp_path / "back.csv", AROUND, stood)
    _, out, _ = run(capsys, "fit", file, "--json")
    (entry,) = json.loads(out)["positions"]
    assert (entry["finding"], entry["position"], entry["angles"]) == ("reversed", 7, None)
    angles = ",".join(f"{k}={stood[k]:g}" for k in range(7, 12))
    status, out, _ = run(capsys, "fit", file, "--json", "--angles", angles)
    document = json.loads(out)
    assert status == 0
    assert "positions" not in document
    assert document["overrides"]["angles"]["new"] == {str(k): stood[k] for k in range(7, 12)}
    _, out, _ = run(capsys, "fit", written(tmp_path / "good.csv", stood, stood), "--json")
    good = json.loads(out)["parameters"]
    for name, entry in document["parameters"].items():
        assert entry["value"] == pytest.approx(good[name]["value"], abs=0.1 * good[name]["u"])


@pytest.mark.parametrize("text", ["7", "7=x", "=3", "7-9=3", "7=inf", "a=3", "7==3", "7+=3", "7=1,7=2"])
def test_what_is_no_correction_is_refused_in_one_line(capsys, file, text):
    status, _, err = run(capsys, "fit", file, "--angles", text)
    assert status == 2
    assert "Traceback" not in err


def read_once(stood_deg: np.ndarray) -> Session:
    """Positions declared at `AROUND`, one averaged reading each, with the part at other angles."""
    rng = np.random.default_rng(4)
    psi = np.radians(20.0 - stood_deg - 0.02 * rng.standard_normal(len(stood_deg)))
    mean = 1000 * np.stack([1.01 * np.cos(psi), np.sin(psi + 0.01)], axis=1) + rng.normal(0, 0.3, (12, 2))
    dwells = tuple(
        Dwell(k, np.array([20.0 * k]), mean[k : k + 1], angle) for k, angle in enumerate(AROUND.tolist())
    )
    return Session(dwells, accel_unit="mg", sensor="generic", fixture_sigma_deg=0.02, reading_u_mg=0.3)


def test_a_wrong_position_is_named_before_the_numbers_that_it_spoils():
    session = read_once(np.where(AROUND == 90.0, 60.0, AROUND))
    result = fit(session)
    first, *rest = Answer.of(result).text(400).splitlines()
    assert first.startswith("position 3: declared 90°, ")
    assert not any("position 3" in line for line in rest)
    assert not any("position 3" in line for line in Answer.of(result).warnings())
