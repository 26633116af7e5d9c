"""Wrong positions are named with the angle they really had, and nothing innocent is accused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from adis_gonio.fitting.slips.position_model import possible_entries
from adis_gonio.fitting.slips.session_positions import diagnose, listed, sentences_of
from detectable_slips import detectable_deg
from fitting.slips.arrays import angles

AROUND = np.arange(12) * 30.0


def changed(values, **at):
    out = np.array(values, dtype=float)
    for key, value in at.items():
        out[int(key[1:])] = value
    return out


@pytest.mark.parametrize("gyro", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_a_good_session_accuses_nothing(gyro, seed):
    found = diagnose(*angles(AROUND, AROUND, seed=seed, gyro=gyro, fixture_deg=0.02 * 3**seed))
    assert not found
    assert not sentences_of(found)


@pytest.mark.parametrize(("k", "typed", "meant"), [(4, 210.0, 120.0), (7, 201.0, 210.0), (9, 90.0, 270.0)])
def test_a_mistyped_angle_is_named_with_the_angle_that_was_meant(k, typed, meant):
    found = diagnose(*angles(AROUND, changed(AROUND, **{f"d{k}": typed})))
    (one,) = found
    assert (one.finding, one.position, one.declared_deg) == ("mistyped", k, pytest.approx(typed))
    assert one.meant_deg == meant
    assert one.correction == f"{k}={meant:g}"
    for angle in (one.gravity_deg, one.gyro_deg, one.angle_deg):
        assert abs((angle[0] - meant + 180) % 360 - 180) < 4 * np.hypot(angle[1], 0.05)
    assert f"declared {typed:g}°" in one.sentence
    assert f"--angles {k}={meant:g}" in one.sentence


def test_gravity_alone_sees_a_mistyped_angle_too_and_says_so():
    (one,) = diagnose(*angles(AROUND, changed(AROUND, d4=210.0), gyro=False))
    assert (one.finding, one.position, one.gyro_deg) == ("mistyped", 4, None)
    assert " by gravity: " in one.sentence
    assert "gyro" not in one.sentence


def test_an_odd_angle_in_one_position_may_be_the_stage_as_well_as_the_entry():
    stood = changed(AROUND, d4=123.37)
    (one,) = diagnose(*angles(stood, AROUND, fixture_deg=0.02))
    assert one.finding == "misset"
    assert one.error_deg[0] == pytest.approx(3.37, abs=0.1)


@pytest.mark.parametrize("gyro", [True, False])
def test_two_exchanged_entries_are_a_swap_and_not_two_mistakes(gyro):
    found = diagnose(*angles(AROUND, changed(AROUND, d3=240.0, d8=90.0), gyro=gyro))
    assert [(one.finding, one.position, one.others) for one in found] == [
        ("swapped", 3, (8,)),
        ("swapped", 8, (3,)),
    ]
    assert found[0].correction == "3=90,8=240"
    assert len(sentences_of(found)) == 1


@pytest.mark.parametrize("gyro", [True, False])
@pytest.mark.parametrize("slip", [-17.3, 1.2])
def test_a_slip_that_lasts_is_told_from_a_wrong_entry(gyro, slip):
    stood = AROUND + np.where(np.arange(12) >= 6, slip, 0.0)
    (one,) = diagnose(*angles(stood, AROUND, gyro=gyro))
    assert (one.finding, one.position, one.others) == ("slipped", 6, (7, 8, 9, 10, 11))
    assert abs(one.error_deg[0] - slip) < 4 * one.error_deg[1]
    assert one.correction is None


def test_an_error_of_the_first_position_may_be_a_slip_after_it_and_the_set_says_so():
    stood = changed(AROUND, d0=5.21)
    (one,) = diagnose(*angles(stood, AROUND))
    said = {(named.name, named.positions) for named in one.names}
    assert {("misset", (0,)), ("slipped", (1,))} <= said
    assert one.finding == "slipped"
    assert "positions 1 to 11 are (−5.2" in one.sentence
    assert "before position 1, or position 0 alone by (+5.2" in one.sentence


def test_a_stage_that_counts_the_other_way_from_somewhere_on():
    stood = AROUND.copy()
    stood[7:] = stood[6] - (AROUND[7:] - AROUND[6])
    (one,) = diagnose(*angles(stood, AROUND))
    assert (one.finding, one.position) == ("reversed", 7)
    assert one.correction is None
    assert one.sentence.endswith("correct the file or repeat them")


def test_a_pushed_reading_is_gravity_that_is_wrong_where_the_gyro_agrees_with_the_plan():
    (one,) = diagnose(*angles(AROUND, AROUND, push_mg={5: (40.0, 60.0)}))
    assert (one.finding, one.position) == ("gravity_wrong", 5)
    assert one.correction is None
    assert abs(one.gyro_deg[0] - 150.0) < 1.0
    assert abs(one.gravity_deg[0] - 150.0) > 1.5


@pytest.mark.parametrize("lost", [{5: -70.0}, {3: 25.0, 8: -4.0}, dict.fromkeys(range(1, 12), 77.0)])
def test_a_gyro_that_lost_turns_accuses_nobody(lost):
    assert not diagnose(*angles(AROUND, AROUND, gyro_error_deg=lost))


def test_a_wrong_entry_is_found_though_the_gyro_lost_another_turn():
    found = diagnose(*angles(AROUND, changed(AROUND, d4=210.0), gyro_error_deg={9: 31.0}))
    assert [(one.finding, one.position) for one in found] == [("mistyped", 4)]


@pytest.mark.parametrize("lost", [{3: 25.0, 8: -4.0}, dict.fromkeys(range(1, 12), 77.0)])
def test_a_wrong_entry_is_corrected_by_gravity_alone_if_the_gyro_is_useless(lost):
    (one,) = diagnose(*angles(AROUND, changed(AROUND, d4=210.0), gyro_error_deg=lost))
    assert one.gyro_deg is None
    assert one.correction == "4=120"
    assert abs(one.gravity_deg[0] - 120.0) < 3 * one.gravity_deg[1] < 0.3


def test_the_gain_of_a_gyro_is_a_nuisance_and_no_threshold():
    """3 % off is three of its standard deviations: 0.9° a turn, many times the noise of a turn."""
    assert not diagnose(*angles(AROUND, AROUND, gain=1.03))


def test_two_mistakes_in_one_session_are_both_named():
    stood = AROUND + np.where(np.arange(12) >= 9, 6.4, 0.0)
    found = diagnose(*angles(stood, changed(AROUND, d3=190.0)))
    assert [(one.finding, one.position) for one in found] == [("mistyped", 3), ("slipped", 9)]


def test_backlash_there_and_back_is_no_slip():
    there = np.concatenate([np.arange(8) * 45.0, np.arange(8)[::-1] * 45.0])
    approach = np.repeat([1.0, -1.0], 8)
    assert not diagnose(*angles(there + 0.15 * approach, there, fixture_deg=0.03, approach=approach))


@pytest.mark.parametrize("gyro", [True, False])
def test_of_two_positions_only_a_gyro_is_a_witness(gyro):
    found = diagnose(*angles([0.0, 80.0], [0.0, 90.0], gyro=gyro))
    assert bool(found) == gyro


def test_gravity_alone_cannot_tell_a_small_push_from_a_turn_where_its_length_stays():
    """Along the circle: of this reading only the gyro knows that the part was not turned."""
    psi = np.radians(2.5 - 150.0)
    push = {5: tuple(30.0 * np.array([-np.sin(psi), np.cos(psi)]))}
    names = []
    for gyro in (True, False):
        (one,) = diagnose(*angles(AROUND, AROUND, push_mg=push, gyro=gyro))
        names.append({named.name for named in one.names})
    assert names[0] == {"gravity_wrong"}
    assert names[1] >= {"gravity_wrong", "misset"}


def test_what_a_session_could_show_is_said_and_holds():
    least = detectable_deg(*angles(AROUND, AROUND), "slipped")
    assert set(least) == set(range(1, 12))
    assert 0.1 < least[6] < 2.0
    for seed in range(6):
        stood = AROUND + np.where(np.arange(12) >= 6, 1.05 * least[6], 0.0)
        (one,) = diagnose(*angles(stood, AROUND, seed=seed))
        assert (one.finding, one.position) == ("slipped", 6)


@pytest.mark.parametrize("gyro", [True, False], ids=["with gyro", "gravity alone"])
def test_a_part_that_turns_by_and_by_has_not_slipped_and_one_that_slips_has(gyro):
    around = np.arange(24) * 15.0
    gone = np.linspace(0, 1, 24)
    courses = {"line": gone, "bends": gone**2, "settles": 1 - np.exp(-4 * gone), "step": 1.0 * (gone > 0.5)}
    said = {name: [] for name in courses}
    for name, course in courses.items():
        for seed in range(4 if name == "step" else 8):
            found = diagnose(*angles(around + 0.9 * course, around, seed=seed, gyro=gyro))
            said[name].append([one.finding for one in found])
    assert [said[name].count([]) for name in ("line", "bends", "settles")] == [8, 8, 8]
    assert said["step"].count(["slipped"]) >= 3


def test_the_zero_of_an_axis_that_moves_by_and_by_accuses_no_position():
    around = np.arange(24) * 15.0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        pushed = dict(enumerate(np.cumsum(rng.normal(0, 2.0 / np.sqrt(24), (24, 2)), axis=0)))
        assert diagnose(*angles(around, around, seed=seed, gyro=False, push_mg=pushed)) == ()


def test_an_angle_that_nobody_declared_is_not_accused():
    declared = changed(AROUND, d5=np.nan)
    assert not diagnose(*angles(AROUND, declared))


def test_findings_are_plain_json_and_nothing_where_there_are_none():
    found = diagnose(*angles(AROUND, changed(AROUND, d4=210.0)))
    document = json.loads(json.dumps(listed(found)))
    (entry,) = document["positions"]
    assert {"position", "declared_deg", "gravity_deg", "gyro_deg", "finding", "probability"} <= set(entry)
    assert entry["probability"] > 0.99
    assert listed(()) == {}


@pytest.mark.parametrize(
    ("declared", "meant"),
    [
        (12.0, 120.0),
        (210.0, 120.0),
        (-30.0, 30.0),
        (90.0, 270.0),
        (27.0, 270.0),
        (225.0, 22.5),
        (115.0, 15.0),
    ],
)
def test_what_hands_do_to_numbers(declared, meant):
    assert meant in possible_entries(declared)
    assert declared not in possible_entries(declared, [declared])
