"""At the position itself the same likelihood speaks: what the part did, not only that it is off."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.bench.guards import (
    Guard,
    GyroIntegral,
    PartPosition,
    add_diagnosis,
    diagnose_positions,
)
from adis_gonio.record.plans import PriorKnowledge

SPREAD = PriorKnowledge(bias_mg=10.0, reading_mg=0.5, fixture_deg=0.05)
OFF = Guard("wrong_angle", "off", {"off_deg": 1.0}, spoils=True)


def stands(stood_deg, asked_deg, *, sense=1, gyro=True, push_mg=(0.0, 0.0), seed=0):
    """Positions asked for and where the part stood, by the drawn axes; the last one is now."""
    rng = np.random.default_rng(seed)
    stood = np.asarray(stood_deg, float) + rng.normal(0, 0.03, len(stood_deg))
    psi = np.radians(1.0 - sense * stood)
    means = np.stack([1001 * np.cos(psi) + 6, 999 * np.sin(psi) - 4], axis=1) + rng.normal(
        0, 0.3, (len(psi), 2)
    )
    means[-1] += push_mg
    turned = [None, *(0.992 * sense * np.diff(stood))]
    return [
        PartPosition(
            float(asked),
            mean,
            None if angle is None or not gyro else GyroIntegral(np.array([0, 0, angle]), 1.0, 0.2),
        )
        for asked, mean, angle in zip(asked_deg, means, turned, strict=True)
    ]


ASKED = [0.0, 40.0, 80.0, 120.0, 160.0, 200.0]


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("seed", range(3))
def test_right_positions_raise_nothing(sense, seed):
    for n in range(2, 7):
        some = stands(ASKED[:n], ASKED[:n], sense=sense, seed=seed)
        assert add_diagnosis(None, diagnose_positions(some, SPREAD, sense), some, sense) is None


@pytest.mark.parametrize("sense", [1, -1])
def test_a_guard_says_how_far_off_the_part_stands_and_by_what(sense):
    some = stands([*ASKED[:5], 203.5], ASKED, sense=sense)
    guard = add_diagnosis(OFF, diagnose_positions(some, SPREAD, sense), some, sense)
    assert "by gravity and gyro the part is (+3." in guard.message
    assert guard.values["found_deg"] == pytest.approx(3.5, abs=0.3)
    assert guard.values["off_deg"] == 1.0


def test_a_part_that_was_pushed_is_not_called_turned_to_another_place():
    some = stands(ASKED, ASKED, push_mg=(35.0, 40.0))
    guard = add_diagnosis(OFF, diagnose_positions(some, SPREAD, 1), some, 1)
    assert "the gyro turned as requested" in guard.message


def test_an_exchanged_position_is_named_with_the_other():
    some = stands([0.0, 40.0, 160.0, 120.0, 80.0], [0.0, 40.0, 80.0, 120.0, 160.0])
    guard = add_diagnosis(None, diagnose_positions(some, SPREAD, 1), some, 1)
    assert guard.kind == "wrong_angle"
    assert "the place of 80°" in guard.message


def test_what_was_kept_against_a_guard_is_not_held_against_the_next_position():
    some = stands([0.0, 40.0, 87.0, 120.0, 160.0], [0.0, 40.0, 80.0, 120.0, 160.0])
    some[2] = PartPosition(None, some[2].mean_mg, some[2].turn)
    assert add_diagnosis(None, diagnose_positions(some, SPREAD, 1), some, 1) is None


def test_other_guards_stay_as_they_are():
    some = stands([*ASKED[:5], 160.0], ASKED)
    still = Guard("not_moved", "the part has not moved", {}, spoils=True)
    assert add_diagnosis(still, diagnose_positions(some, SPREAD, 1), some, 1) is still


@pytest.mark.parametrize("sense", [1, -1])
def test_nobody_has_typed_anything_at_the_bench(sense):
    some = stands([*ASKED[:5], 210.0], ASKED, sense=sense)
    guard = add_diagnosis(OFF, diagnose_positions(some, SPREAD, sense), some, sense)
    assert "mistyped" not in guard.message
