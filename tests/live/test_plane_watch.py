"""Turns out of the plane of X and Y, as the smoother detects them."""

import numpy as np
import pytest

from adis_gonio.live.motion_model import PlaneWatch

STEP_S = 0.02
FLAT = (600.0, -800.0, 0.0)
WAVE = np.tile([1.0, -1.0], 25)
"""One second of a standard deviation of 1."""


def watched(rates_dps, accels_mg, watch: PlaneWatch | None = None) -> PlaneWatch:
    watch = PlaneWatch(STEP_S) if watch is None else watch
    for rate, accel in zip(rates_dps, accels_mg, strict=True):
        watch.see(np.asarray(rate, dtype=float), np.asarray(accel, dtype=float))
    return watch


def rested(zero_dps=(2.0, -1.0, 0.5)) -> PlaneWatch:
    return watched([zero_dps] * 50, [FLAT] * 50)


@pytest.mark.parametrize(
    ("wave_dps", "wave_mg", "resting"),
    [(0.0, 0.0, True), (0.99, 9.9, True), (1.01, 0.0, False), (0.0, 10.1, False)],
)
def test_the_zero_rates_are_those_of_a_second_at_rest(wave_dps, wave_mg, resting):
    rates = [(5.0, -5.0 + wave_dps * one, 1.0) for one in WAVE]
    watch = watched(rates, [(1000.0 + wave_mg * one, 0.0, 0.0) for one in WAVE])
    # 5 °/s about X with gravity at 45° in the plane and out of it.
    error = watch.see(np.array([10.0, -5.0, 1.0]), np.array([1000.0, 0.0, 1000.0]))
    assert error == pytest.approx(5.0 if resting else 0.0)


def test_a_turn_out_of_the_plane_is_in_error_by_gravitys_part_out_of_it():
    rate = np.array([2.0 + 3.0, -1.0 + 4.0, 0.5 + 70.0])  # 3, 4 and 70 °/s besides the zeros
    for accel, error in (
        (FLAT, 0.0),
        ((600.0, 800.0, 100.0), 0.1 * (0.6 * 3 + 0.8 * 4)),
        ((600.0, -800.0, -100.0), 0.1 * (0.8 * 4 - 0.6 * 3)),
        ((0.0, 0.5, 1000.0), 0.0),  # the direction in the plane is unknown
    ):
        assert rested().see(rate, np.array(accel)) == pytest.approx(error)


@pytest.mark.parametrize(
    ("about_dps", "out"),
    [
        ((3.9, 0.0, 0.0), False),
        ((4.1, 0.0, 0.0), True),
        ((0.0, -4.1, 0.0), True),
        ((3.0, 3.0, 0.0), True),  # 4.2 °/s together
        ((8.9, 0.0, 50.0), False),  # a tenth of a fast turn comes from axes that are not square
        ((9.1, 0.0, -50.0), True),
    ],
)
def test_rates_about_x_and_y_tell_a_turn_out_of_the_plane(about_dps, out):
    zero = np.array([2.0, -1.0, 0.5])
    # A rate about Z that wavers is no rest, so that the zero rates stay.
    rates = [zero + about_dps + (0, 0, 1.5 * one) for one in WAVE]
    watch = watched(rates, [FLAT] * 50, rested(zero))
    assert watch.out_of_plane is out


@pytest.mark.parametrize(("z_mg", "out"), [(99.0, False), (102.0, True), (-102.0, True)])
def test_a_tenth_of_gravity_that_leaves_the_plane_is_a_turn_before_any_rest(z_mg, out):
    restless = [(30 * one, 0, 0) for one in WAVE]
    x_mg = np.sqrt(1000**2 - z_mg**2)
    watch = watched(restless, [(1000, 0, 0)] * 25 + [(x_mg, 0, z_mg)] * 25)
    assert watch.out_of_plane is out


def test_a_turn_out_of_the_plane_is_forgotten_after_a_gap_but_the_zero_rates_are_not():
    turning_dps = (11.0, -1.0, 0.5)
    watch = watched([turning_dps] * 50, [FLAT] * 50, rested())
    watch.forget()
    assert not watch.out_of_plane
    assert not watched([turning_dps] * 3, [FLAT] * 3, watch).out_of_plane  # too few steps
    assert watched([turning_dps], [FLAT], watch).out_of_plane
