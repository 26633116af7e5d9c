"""A part that slips after the stage has arrived rested where it was declared: the gyro saw it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.fitting.gyros.turn_integration import Path, Sampling
from adis_gonio.fitting.slips import diagnose
from adis_gonio.fitting.slips.position_model import Halts, halts_of
from fitting.slips.arrays import angles

PERIOD_S = 0.01
AROUND = np.arange(12) * 30.0
SAMPLING = Sampling(PERIOD_S, 2, 300.0, 0.01 * np.eye(3), np.full(3, 0.015))


def path(*legs, zero_dps=0.7, seed=0):
    """Rates of rests (s, 0) and even turns (s, degrees) one after another, about z."""
    rng = np.random.default_rng(seed)
    rate = np.concatenate([np.full(round(s / PERIOD_S), deg / s) for s, deg in legs])
    time = PERIOD_S * np.arange(len(rate))
    rates = np.zeros((len(rate), 3)) + zero_dps + rng.normal(0, 0.1, (len(rate), 3))
    rates[:, 2] += rate
    rest = np.zeros((2, 3))
    return Path(time, rates, np.zeros_like(rates), np.full((2, 3), zero_dps), rest)


def test_every_rest_on_the_way_is_seen_with_what_was_still_to_turn():
    found = halts_of(path((1, 0), (1, 30), (0.5, 0), (1, -12), (0.6, 0), (0.5, 5), (1, 0)), SAMPLING)
    assert np.degrees(found.turned_rad) == pytest.approx(23.0, abs=0.5)
    assert np.degrees(found.left_rad) == pytest.approx([-7.0, 5.0], abs=0.5)


@pytest.mark.parametrize(
    "legs", [((1, 0), (2, 50), (1, 0)), ((2, 0),), ((1, 0), (1, 30), (0.05, 0), (1, 30))]
)
def test_a_move_without_a_rest_has_none(legs):
    assert not len(halts_of(path(*legs), SAMPLING).left_rad)


def with_halts(stood_deg, halts, *, seed=0):
    session = angles(stood_deg, AROUND, seed=seed)
    return replace(session, turns=replace(session.turns, halts=tuple(halts)))


def plain(stood_deg):
    """Each turn with one rest for a new grip half way."""
    turns = np.radians(np.diff(stood_deg))
    return [Halts(np.array([turn / 2]), float(turn)) for turn in turns]


@pytest.mark.parametrize(("slip", "first"), [(6.0, 1), (-9.0, 1), (7.0, 11)])
def test_a_slip_beside_the_first_or_last_position_is_told_by_the_rest_before_it(slip, first):
    """By whole degrees: by angles alone a wrong entry is as good."""
    stood = AROUND + np.where(np.arange(12) >= first, slip, 0.0)
    halts = plain(stood)
    turn = np.radians(stood[first] - stood[first - 1])
    halts[first - 1] = Halts(np.array([turn / 2, np.radians(slip + 0.05)]), float(turn))
    (one,) = diagnose(with_halts(stood, halts)).findings
    assert (one.finding, one.position) == ("slipped", first)
    (without,) = diagnose(with_halts(stood, plain(stood))).findings
    told, untold = (_share_of_slip(found) for found in (one, without))
    assert untold < 0.7
    assert told / (1.01 - told) > 10 * untold / (1 - untold)


def _share_of_slip(found):
    return sum(named.probability for named in found.names if named.name == "slipped")


@pytest.mark.parametrize("seed", range(4))
def test_rests_accuse_nobody(seed):
    """Hands rest anywhere, and near the mark before they correct themselves."""
    rng = np.random.default_rng(100 + seed)
    turn = np.radians(30.0)
    halts = [Halts(np.append(rng.uniform(0, turn), rng.normal(0, 0.02 * turn, 2)), turn) for _ in range(11)]
    assert not diagnose(with_halts(AROUND, halts, seed=seed)).findings


def test_a_rest_elsewhere_says_that_nothing_slipped_after_the_stage_had_arrived():
    rests = Halts(np.radians([15.0]), np.radians(36.0))
    at, elsewhere = rests.log_odds(np.radians([15.0, 6.0]), np.radians([0.05, 0.05]))
    assert at > 2.0
    assert elsewhere == pytest.approx(np.log(0.5))


@pytest.mark.parametrize("seed", range(3))
def test_of_all_places_and_names_the_most_probable_one_is_said(seed):
    """Not that of the place which two less probable names share."""
    stood = AROUND + np.where(np.arange(12) >= 1, 11.18 + seed, 0.0)
    halts = [Halts(np.zeros(0), float(turn)) for turn in np.radians(np.diff(stood))]
    (one,) = diagnose(with_halts(stood, halts, seed=seed)).findings
    assert (one.finding, (one.position,)) == (one.names[0].name, one.names[0].positions)
    assert sum(named.probability for named in one.names if named.positions != (one.position,)) > 0.5
