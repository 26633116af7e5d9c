"""Rules by which data count as dead, each at its own limit, and what is said of limits of the range."""

from __future__ import annotations

from itertools import groupby

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import name_positions
from adis_gonio.fitting.estimation.screening import (
    Limit,
    dwells_at_limit,
    dwells_reading_alike,
    dwells_too_still,
    limit_notes,
    longest_runs,
    refuse_dead_data,
)
from adis_gonio.model.records import Dwell, Session


def dwell(rows: Floats, k: int = 0, angle: float | None = None) -> Dwell:
    return Dwell(k, 100.0 * k + np.arange(len(rows)) / 100, np.asarray(rows, dtype=float), angle)


def noisy(rng: np.random.Generator, n: int, run: int, k: int, axis: int = 0) -> Dwell:
    """Noise in which one axis repeats a word for `run` samples."""
    rows = rng.normal(500.0, 10.0, (n, 2))
    rows[3 : 3 + run, axis] = rows[3, axis]
    return dwell(rows, k)


def test_the_longest_run_is_the_longest_group_of_equal_words() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        rows = rng.integers(0, 2, (40, 3)).astype(float)
        longest = [max(len(list(group)) for _, group in groupby(rows[:, axis])) for axis in range(3)]
        assert longest_runs(rows).tolist() == longest


@pytest.mark.parametrize(
    ("n", "run", "stuck"), [(64, 32, True), (62, 31, False), (100, 50, True), (102, 50, False)]
)
def test_an_axis_that_stands_half_of_a_dwell_and_32_samples_is_stuck(n: int, run: int, stuck: bool) -> None:
    rng = np.random.default_rng(2)
    dwells = [noisy(rng, n, 1, 0), noisy(rng, n, run, 5), noisy(rng, n, 1, 6)]
    assert dwells_too_still(dwells) == ([5] if stuck else [])
    assert dwells_too_still(dwells[1:2]) == [], "there is no other to compare with"


@pytest.mark.parametrize(("other", "stuck"), [(25, True), (26, False)])
def test_a_dwell_is_stuck_if_it_stands_four_times_longer_than_any_other(other: int, stuck: bool) -> None:
    rng = np.random.default_rng(3)
    dwells = [noisy(rng, 150, other, 0), noisy(rng, 150, 103, 1), noisy(rng, 150, 1, 2)]
    assert dwells_too_still(dwells) == ([1] if stuck else [])


@pytest.mark.parametrize(
    ("angle", "stuck"),
    [(4.0, False), (6.0, True), (90.0, True), (354.0, True), (356.0, False), (360.0, False)],
)
def test_the_same_words_at_two_angles_are_stuck_from_five_degrees(angle: float, stuck: bool) -> None:
    same = np.tile([2000.0, 100.0], (20, 1))
    moved = dwell(np.random.default_rng(1).normal(0, 9, (20, 2)), 9, 45.0)
    dwells = [dwell(same, 3, 0.0), dwell(same, 4, angle), moved]
    assert dwells_reading_alike(dwells) == ([3, 4] if stuck else [])
    other = dwell(np.add(same, [0.0, 1.0]), 4, angle)
    assert dwells_reading_alike([dwells[0], other, moved]) == []


def test_dwells_that_are_all_alike_are_stuck_unless_they_stand_at_one_angle() -> None:
    same = np.tile([2000.0, 100.0], (20, 1))
    assert dwells_reading_alike([dwell(same, k) for k in range(3)]) == [0, 1, 2]
    assert dwells_reading_alike([dwell(same, k) for k in range(2)]) == []
    assert dwells_reading_alike([dwell(same, k, 30.0 + 360 * k) for k in range(3)]) == []
    assert dwells_reading_alike([dwell(same[:1], k, 2.0 * k) for k in range(3)]) == [0, 1, 2]
    assert dwells_reading_alike([dwell(same, 0, 0.0)]) == []


@pytest.mark.parametrize(
    ("samples", "axes", "refused"), [(256, 2, True), (255, 2, False), (512, 1, True), (511, 1, False)]
)
def test_words_of_the_chip_that_never_change_are_stuck_from_512_samples(
    samples: int, axes: int, refused: bool
) -> None:
    rows = np.tile([1900.0, 700.0], (samples, 1))
    if axes == 1:
        rows[:, 1] += np.arange(samples) % 5
    words = Session((dwell(rows, 7),), accel_unit="lsb")
    if refused:
        with pytest.raises(DataError, match=r"^stuck data in position 7: words repeat"):
            refuse_dead_data(words, (), 0.5)
    else:
        refuse_dead_data(words, (), 0.5)
    refuse_dead_data(Session((dwell(rows, 7),), accel_unit="mg"), (), 1.0)


@pytest.mark.parametrize(("step", "refused"), [(1.0, True), (4.0, False)])
def test_words_that_never_change_are_stuck_unless_lost_bits_hide_the_noise(
    step: float, refused: bool
) -> None:
    rng = np.random.default_rng(6)
    # Half a step rms is no livelier than the converter; twelve dwells tell its step beyond chance.
    quiet = 1900.0 + step * rng.integers(0, 2, (12, 512, 2))
    still = np.column_stack([np.full(512, 1900.0), quiet[0, :, 1]])
    words = Session(
        (*(dwell(rows, 20 + k) for k, rows in enumerate(quiet)), dwell(still, 7)), accel_unit="lsb"
    )
    if refused:
        with pytest.raises(DataError, match=r"^stuck data in position 7: words repeat"):
            refuse_dead_data(words, (), 0.5)
    else:
        refuse_dead_data(words, (), 0.5)


def test_a_dwell_of_nothing_but_zeros_is_named_with_its_file() -> None:
    rng = np.random.default_rng(4)
    dwells = (noisy(rng, 50, 1, 0), dwell(np.zeros((50, 2)), 5), dwell(np.zeros((0, 2)), 6))
    with pytest.raises(DataError, match=r"^own\.csv: all-zero accelerations in position 5; nothing"):
        refuse_dead_data(Session(dwells, source="own.csv"), (), 0.5)


@pytest.mark.parametrize(
    ("length", "positions", "gravity", "allowed"),
    [
        (1090.0, (1, 2), 1000.0, True),
        (1110.0, (1, 2), 1000.0, False),
        (1090.0, (1,), 1000.0, False),
        (1090.0, (1, 2), None, False),
    ],
)
def test_a_limit_that_several_reach_is_one_if_gravity_allows_the_reading(
    length: float, positions: tuple[int, ...], gravity: float | None, allowed: bool
) -> None:
    rows = np.tile([0.6 * length, 0.8 * length], (30, 1))
    limit = Limit(1, 0.8 * length, 30 * len(positions), 0, positions, positions)
    dwells = [dwell(rows, k) for k in (1, 2)] + [dwell(0.1 * rows, 3)]
    assert dwells_at_limit(dwells, [limit], gravity) == (set(positions) if allowed else set())


def test_limits_are_told_with_their_samples_and_what_they_spoil() -> None:
    whole = "1 sample of x are at the extreme value 990 mg (position 4): a limit was reached there"
    assert limit_notes([Limit(0, 990.0, 1, 0, (4,), ())], "mg") == [whole]
    (one,) = limit_notes([Limit(2, -990.0, 40, 0, (4, 5), (5,))], "mg")
    assert one.startswith("40 samples of z are at the extreme value -990 mg (positions 4, 5): a limit")
    assert one.endswith("position 5 takes no part in the fit")
    (two,) = limit_notes([Limit(1, 990.0, 40, 0, (4, 5), (4, 5))], "mg")
    assert two.endswith("positions 4, 5 take no part in the fit")


def test_of_many_positions_eight_are_named() -> None:
    assert name_positions([3]) == "position 3"
    assert name_positions(range(8)) == "positions 0, 1, 2, 3, 4, 5, 6, 7"
    assert name_positions(range(9)) == "positions 0, 1, 2, 3, 4, 5, 6, 7 and 1 more"
