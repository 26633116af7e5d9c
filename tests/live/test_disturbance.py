"""What disturbs gravity, against processes that are known."""

import numpy as np
import pytest

from adis_gonio.live.motion_model import START_MG, coloured, disturbance_of


def white(rng: np.random.Generator, n: int, sigma: float) -> np.ndarray:
    return sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n))


def process(rng: np.random.Generator, n: int, first: float, second: float, drive: float) -> np.ndarray:
    found, noise = np.zeros(n + 200, complex), white(rng, n + 200, drive)
    for k in range(2, n + 200):
        found[k] = first * found[k - 1] + second * found[k - 2] + noise[k]
    return found[200:]


def test_the_sensors_noise_alone_is_no_disturbance():
    rng = np.random.default_rng(1)
    found = [disturbance_of(1000 + white(rng, 75, 1.2), 50, 1.44) for _ in range(200)]
    assert np.mean([one.coloured_mg2 == 0 for one in found]) > 0.9
    assert np.mean([one.white_mg2 for one in found]) == pytest.approx(1.44, rel=0.1)


# A ringing at 0.13 and at 0.25 cycles a step.
@pytest.mark.parametrize(("first", "second"), [(1.2, -0.8), (0.0, -0.6)])
def test_a_tremor_is_found_with_its_size_and_colour(first, second):
    rng = np.random.default_rng(2)
    variance = process(rng, 100_000, first, second, 3.0).real.var()
    made = [process(rng, 75, first, second, 3.0) + white(rng, 75, 1.0) + 1000 for _ in range(200)]
    found = [disturbance_of(level, 50, 1.0) for level in made]
    assert np.mean([one.coloured_mg2 for one in found]) == pytest.approx(variance, rel=0.15)
    assert np.mean([one.first for one in found]) == pytest.approx(first, abs=0.1)
    assert np.mean([one.second for one in found]) == pytest.approx(second, abs=0.1)


def test_a_gyros_zero_is_no_disturbance():
    rng = np.random.default_rng(3)
    slope = 1j * 0.5 * np.arange(75)
    found = disturbance_of(1000 + slope + white(rng, 75, 1.0), 40, 1.0)
    assert found.coloured_mg2 == 0


def test_a_shock_counts_in_its_own_step_alone():
    rng = np.random.default_rng(4)
    level = 1000 + white(rng, 75, 1.0)
    level[30] += 60.0
    assert disturbance_of(level, 30, 1.0).white_mg2 > 1000
    assert disturbance_of(level, 29, 1.0).white_mg2 < 2
    assert disturbance_of(level, 29, 1.0).coloured_mg2 < 1


@pytest.mark.parametrize("place", [5, 30, 74])
def test_a_hard_shock_leaves_the_other_steps_as_they_were(place):
    # A shock of 500 mg anywhere in the span shifts mean and slope of 75 steps by many times their noise.
    rng = np.random.default_rng(6)
    level = 1000 + white(rng, 75, 1.0)
    struck = level.copy()
    struck[place] += 500.0
    for at in (place - 3, place - 1):
        one, other = disturbance_of(level, at, 1.0), disturbance_of(struck, at, 1.0)
        assert other.coloured_mg2 == 0
        assert other.white_mg2 == pytest.approx(one.white_mg2, rel=0.05)
    # Half of the square, for one of two components.
    assert disturbance_of(struck, place, 1.0).white_mg2 == pytest.approx(500**2 / 2, rel=0.02)


def test_a_shock_does_not_change_the_colour_of_a_tremor():
    rng = np.random.default_rng(5)
    level = 1000 + process(rng, 75, 1.2, -0.8, 3.0) + white(rng, 75, 1.0)
    struck = level.copy()
    struck[40] += 100.0
    one, other = disturbance_of(level, 20, 1.0), disturbance_of(struck, 20, 1.0)
    for name in ("coloured_mg2", "first", "second"):
        assert getattr(other, name) == pytest.approx(getattr(one, name), rel=0.2)


def test_before_there_is_enough_to_see_a_hand_is_supposed():
    assert disturbance_of(np.full(5, 1000 + 0j), 2, 1.0).coloured_mg2 == START_MG**2


@pytest.mark.parametrize(("first", "second"), [(1.5, 0.2), (-2.0, 2.0), (0.9, -0.9), (0.0, 0.0)])
def test_no_process_runs_away(first, second):
    made = coloured(1.0, 100.0, first, second)
    roots = np.roots([1, -made.first, -made.second])
    assert np.abs(roots).max() < 1
    # In its steady state it has the variance that it was given.
    spread = np.diag([100.0, 100.0])
    f = np.array([[made.first, made.second], [1.0, 0.0]])
    for _ in range(3000):
        spread = f @ spread @ f.T + np.diag([made.drive_mg2, 0.0])
    assert spread[0, 0] == pytest.approx(100.0, rel=1e-3)


@pytest.mark.parametrize(("first", "second"), [(1.2, -0.8), (0.0, -0.6), (0.9, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize("steps", [1, 2, 5, 40])
def test_the_mean_of_steps_has_the_variance_of_correlated_values(first, second, steps):
    rng = np.random.default_rng(7)
    long = process(rng, 200_000, first, second, 3.0) + white(rng, 200_000, 2.0)
    r1 = first / (1 - second)
    variance = process(rng, 200_000, first, second, 3.0).real.var()
    made = coloured(4.0, variance, r1, first * r1 + second)
    means = long.reshape(-1, steps).mean(axis=1)
    assert made.variance_of_mean(steps) == pytest.approx(means.real.var(), rel=0.1)


def test_noise_of_an_unknown_sensor_leaves_no_correlation_on_average():
    rng = np.random.default_rng(8)
    found = [disturbance_of(1000 + white(rng, 50, 1.2), 49, 0.0) for _ in range(2000)]
    assert np.mean([one.variance_of_mean(5) for one in found]) == pytest.approx(1.44 / 5, rel=0.05)
