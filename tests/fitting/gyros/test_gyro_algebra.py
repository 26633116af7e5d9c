"""A fit of gyros against plain linear algebra on readings that are put in."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.calibrate.gyro_calibration import UNIT_OF
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.gyros import gyro_fit as module
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro_readings
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate

BIAS = np.array([0.4, -1.1, 0.2])
FORCE_ON = np.array([[0.05, -0.02, 0.03], [0.01, 0.04, -0.03], [-0.02, 0.02, 0.06]])
"""°/s/g of each gyro by force along each axis."""


def poses(n: int, seed: int = 1) -> Floats:
    force = np.random.default_rng(seed).standard_normal((n, 3))
    return force / np.linalg.norm(force, axis=1, keepdims=True)


def at_rest(
    force: Floats, noise: float = 0.01, *, seed: int = 2, beside: Floats | float = 0.0, **more: object
) -> Readings:
    """Dwells at rest under these forces (n, 3) in g."""
    n = len(force)
    rng = np.random.default_rng(seed)
    mean = BIAS + force @ FORCE_ON.T + noise * rng.standard_normal((n, 3)) + beside
    conditions = Conditions(time_s=10.0 * np.arange(n), order=np.arange(float(n)), force_g=force)
    covariance = np.tile(noise**2 * np.eye(3), (n, 1, 1))
    facts: dict[str, object] = {"measurement": MeanRate(), "fixture_rad": math.inf}
    return from_means(mean, covariance, conditions, **{**facts, **more})


def design(force: Floats) -> Floats:
    return np.column_stack([np.ones(len(force)), force])


def test_zero_rates_and_what_force_adds_are_those_of_linear_least_squares() -> None:
    force = poses(10)
    data = at_rest(force)
    result = fit_gyro_readings(data, scored=False)
    rows = design(force)
    best = np.linalg.lstsq(rows, data.mean, rcond=None)[0]
    u = 0.01 * np.sqrt(np.diagonal(np.linalg.inv(rows.T @ rows)))
    for k, axis in enumerate("xyz"):
        names = [f"gyro_bias_{axis}", *(f"g_sensitivity_{axis}{other}" for other in "xyz")]
        for j, name in enumerate(names):
            assert result[name].value == pytest.approx(best[j, k], abs=1e-9)
            assert result[name].u == pytest.approx(u[j] * math.sqrt(result.inflation[axis]), rel=1e-6)
            assert result[name].unit == ("dps" if j == 0 else "dps/g")
    left = data.mean - rows @ best
    assert result.chi2 == pytest.approx((left**2).sum() / 0.01**2)
    assert result.dof == 30 - 12
    assert result.turns == 0
    assert all(1 <= factor < 1.1 for factor in result.inflation.values())
    assert result.undetermined == ()
    np.testing.assert_allclose(result.residual_dps, left, atol=1e-9)
    (told,) = [line for line in result.warnings if "not determined" in line]
    assert told == (
        "not determined, fixed at perfect gyros: gyro_scale; gyro_misalignment; "
        "turn the part by whole turns about each axis (plan gyro-turns)"
    )


def test_a_gyro_whose_residual_is_too_large_is_less_sure_by_it_and_the_others_are_not() -> None:
    force = poses(12)
    away = np.zeros((12, 3))
    away[:, 1] = 0.05 * np.random.default_rng(5).standard_normal(12)
    data = at_rest(force, beside=away, dof=np.full(12, 5.0))
    result = fit_gyro_readings(data, scored=False)
    rows = design(force)
    left = data.mean - rows @ np.linalg.lstsq(rows, data.mean, rcond=None)[0]
    factor = (left[:, 1] ** 2).sum() / 0.01**2 / 8
    assert result.inflation["y"] == pytest.approx(factor, rel=1e-3)
    u = 0.01 * math.sqrt(np.linalg.inv(rows.T @ rows)[0, 0])
    assert u <= result["gyro_bias_x"].u < 1.2 * u
    assert result["gyro_bias_y"].u == pytest.approx(u * math.sqrt(factor), rel=1e-3)
    # The smaller of twelve dwells less four parameters, and of the five of the noise.
    assert result["gyro_bias_y"].dof == result["gyro_bias_x"].dof == 5
    assert any(f"(y {math.sqrt(factor):.2g} times)" in line for line in result.warnings)


def posterior_by_sampling(chi2: Floats, dof: Floats) -> Floats:
    """Mean and mean square (2, 3) of the precision of each gyro, by draws from the prior of the factors."""
    rng, n = np.random.default_rng(4), 2_000_000
    common = np.repeat(rng.uniform(0, math.log(module.LARGEST_SCATTER), (n, 1)), 3, axis=1)
    own = rng.uniform(0, math.log(module.LARGEST_SCATTER), (n, 3)) * (rng.random((n, 3)) < 0.5)
    which = rng.random((n, 1))
    factor = np.exp(np.where(which < 0.5, 0.0, np.where(which < 0.75, common, own)))
    log_likelihood = (-0.5 * dof * np.log(factor) - 0.5 * chi2 / factor).sum(axis=1)
    weight = np.exp(log_likelihood - log_likelihood.max())
    return np.array([weight @ factor**-power / weight.sum() for power in (1, 2)])


@pytest.mark.parametrize(
    "ratio", [(1.0, 0.8, 1.2), (1.0, 0.8, 5.0), (4.0, 5.0, 3.0), (20.0, 2.0, 0.5), (0.1, 0.2, 0.1)]
)
@pytest.mark.parametrize("dof", [(2, 2, 2), (5, 6, 4)])
def test_the_factor_of_a_scatter_is_the_posterior_by_its_prior(ratio, dof) -> None:
    chi2 = np.array(ratio) * dof
    mean, square = posterior_by_sampling(chi2, np.array(dof))
    found = np.array(module.scatter_factors(chi2, np.array(dof)))
    np.testing.assert_allclose(found[:, 0], 1 / mean, rtol=0.01)
    np.testing.assert_allclose(found[:, 1], np.maximum(2 * mean**2 / (square - mean**2), 1), rtol=0.03)


def test_a_gyro_without_degrees_of_freedom_has_the_factor_of_the_others_if_all_scatter() -> None:
    found = module.scatter_factors(np.array([400.0, 500.0, 0.0]), np.array([10, 10, 0]))
    assert found[0][0] == pytest.approx(40, rel=0.2)
    assert found[2][0] > 10
    assert found[2][1] == 1.0
    assert module.scatter_factors(np.zeros(3), np.zeros(3, int)) == [(1.0, pytest.approx(2e12))] * 3


def turning(gains: Floats, directions: Floats, noise: float = 1e-7) -> Readings:
    """Rests, and turns both ways about each axis and between axes."""
    rate = np.concatenate([np.zeros((3, 3)), 90 * np.eye(3), -90 * np.eye(3), 60 * poses(4, seed=9)])
    mean = BIAS + rate @ (gains[:, None] * directions).T
    conditions = Conditions(
        time_s=10.0 * np.arange(len(rate)), order=np.arange(float(len(rate))), rate_dps=rate
    )
    covariance = np.tile(noise**2 * np.eye(3), (len(rate), 1, 1))
    return from_means(mean, covariance, conditions, measurement=MeanRate(), fixture_rad=math.inf)


def test_gains_and_directions_are_length_and_direction_of_each_row() -> None:
    gains = np.array([1.1, 0.95, 1.002])
    directions = np.eye(3) + np.array([[0, 0.03, -0.02], [0.01, 0, 0.04], [-0.05, 0.02, 0]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    result = fit_gyro_readings(turning(gains, directions), scored=False)
    for k, axis in enumerate("xyz"):
        gain = result[f"gyro_scale_{axis}"]
        assert gain.value == pytest.approx(gains[k], rel=1e-6)
        # Nothing but the samples' clock: ±50 ppm, uniform.
        assert gain.u == pytest.approx(50e-6 / math.sqrt(3) * gains[k], rel=1e-3)
        for j, other in enumerate("xyz"):
            if other != axis:
                angle = result[f"gyro_misalignment_{axis}{other}"]
                assert angle.value == pytest.approx(math.degrees(math.asin(directions[k, j])), abs=1e-5)
                assert angle.unit == "deg"
                assert angle.u < 1e-5
    assert result.turns == 10
    assert result.extent == "3 dwells and 10 turns"
    (told,) = [line for line in result.warnings if "not determined" in line]
    assert told.endswith("g_sensitivity; measure poses with each axis up and down")


def test_slopes_of_gains_and_angles_carry_the_noise() -> None:
    noise = 0.05
    data = turning(np.array([1.1, 0.95, 1.0]), np.eye(3), noise)
    result = fit_gyro_readings(data, scored=False)
    rate = data.conditions.rate_dps
    rows = np.column_stack([np.ones(len(rate)), rate])
    inverse = noise**2 * np.linalg.inv(rows.T @ rows)
    clock = 50e-6 / math.sqrt(3) * 1.1
    assert result["gyro_scale_x"].u == pytest.approx(math.hypot(math.sqrt(inverse[1, 1]), clock), rel=1e-3)
    across = math.degrees(math.sqrt(inverse[2, 2])) / 1.1  # of a direction: the part across over the length
    assert result["gyro_misalignment_xy"].u == pytest.approx(across, rel=1e-3)
    assert result["gyro_bias_x"].u == pytest.approx(math.sqrt(inverse[0, 0]), rel=1e-3)


@pytest.mark.parametrize(("u", "determined"), [(0.097, True), (0.103, False)])
def test_what_a_force_adds_counts_as_determined_up_to_a_tenth(u: float, determined: bool) -> None:
    force = np.zeros((6, 3))
    force[:, 2] = 0.9 * np.array([1, -1, 1, -1, 1, -1])
    force[:, :2] = 1e-9  # the other axes show nothing
    data = at_rest(force, u * 0.9 * math.sqrt(6))
    result = fit_gyro_readings(data, scored=False)
    assert ("g_sensitivity_xz" in result) == determined
    assert {"g_sensitivity_xx", "g_sensitivity_zy"} <= set(result.undetermined)
    assert ("g_sensitivity_xz" in result.undetermined) != determined
    if determined:
        assert result["g_sensitivity_xz"].u == pytest.approx(u, rel=0.02)
    (told,) = [line for line in result.warnings if line.startswith("not determined")]
    assert "g_sensitivity_xx, xy" in told
    assert "measure poses with each axis up and down; turn the part by whole turns" in told


@pytest.mark.parametrize("u", [0.097, 0.103, 0.5])
def test_what_a_force_of_one_g_up_and_down_adds_counts_alike_although_the_zero_rate_is_as_uncertain(
    u: float,
) -> None:
    force = np.zeros((6, 3))
    force[:, 2] = [1, -1, 1, -1, 1, -1]
    result = fit_gyro_readings(at_rest(force, u * math.sqrt(6)), scored=False)
    assert ("g_sensitivity_xz" in result) == (u < 0.1)
    assert result["gyro_bias_x"].u == pytest.approx(u, rel=0.02)
    assert {"g_sensitivity_xx", "g_sensitivity_xy"} <= set(result.undetermined)


def test_a_direction_of_the_gyros_is_measured_in_radians() -> None:
    assert module._natural(["gyro_misalignment_xy", "gyro_scale_x"]).tolist() == [180 / math.pi, 1.0]
    assert [module._gyro_of(name) for name in ("gyro_bias_x", "g_sensitivity_yz")] == ["x", "y"]
    assert module._kinds(["gyro_scale_x", "g_sensitivity_xz", "gyro_scale_z"]) == [
        "gyro_scale_x, z", "g_sensitivity_xz",
    ]  # fmt: skip
    assert module._stated_name("gyro_scale_error_y") == "gyro_scale_y"
    assert [UNIT_OF[name] for name in ("gyro_bias_x", "gyro_scale_y", "gyro_misalignment_xy")] == [
        "dps", "1", "deg",
    ]  # fmt: skip


def test_dwells_left_out_miss_by_what_the_hat_matrix_says() -> None:
    force = poses(9)
    data = at_rest(force)
    scores = fit_gyro_readings(data).scores
    for name, rows in (("zero rate", np.ones((9, 1))), ("gyro", design(force))):
        hat = rows @ np.linalg.pinv(rows)
        left = (data.mean - hat @ data.mean) / (1 - np.diagonal(hat))[:, None]
        for k, axis in enumerate("xyz"):
            rms = scores[name]["residual_rms_by_axis_dps"][axis]
            assert rms == pytest.approx(math.sqrt((left[:, k] ** 2).mean()), rel=1e-6)
        assert scores[name]["residual_max_dps"] == pytest.approx(np.abs(left).max(), rel=1e-6)
    assert set(scores) == {
        "zero rate", "gyro", "gyro with a drift with time", "gyro with a drift from dwell to dwell",
        "gyro with a warm-up",
    }  # fmt: skip
    assert fit_gyro_readings(data.rows(np.arange(9) < 2)).scores == {}


IN_ORDER = np.array(
    [
        *[[-0.03, -0.95, 0.31], [0.56, -0.60, 0.53], [0.91, -0.38, -0.05], [0.54, -0.60, -0.63]],
        *[[-0.03, -0.95, -0.40], [-0.61, -0.60, -0.61], [-0.97, -0.36, -0.02], [-0.59, -0.59, 0.54]],
        *[[-0.36, -0.02, 0.90], [0.35, -0.03, 0.88], [0.57, 0.57, 0.52], [0.91, 0.36, -0.06]],
        *[[0.55, 0.56, -0.64], [0.31, -0.02, -0.99], [-0.39, -0.01, -0.98], [-0.62, 0.57, -0.61]],
        *[[-0.96, 0.36, -0.04], [-0.60, 0.55, 0.55], [-0.02, 0.93, 0.32], [-0.03, 0.93, -0.40]],
    ]
)
"""Forces (20, 3) of the poses of a real session: faces of an icosahedron, from below to above along Y."""


def misses(seeds: int, course: Floats | float, *, scored: bool) -> tuple[Floats, Floats]:
    """Errors (seeds, 9) of the g-sensitivities and their u, for zero rates with a course in time."""
    off, u = [], []
    for seed in range(seeds):
        result = fit_gyro_readings(at_rest(IN_ORDER, 0.004, seed=seed, beside=course), scored=scored)
        found = [result[f"g_sensitivity_{i}{j}"] for i in "xyz" for j in "xyz"]
        off.append([one.value for one in found] - FORCE_ON.ravel())
        u.append([one.u or 0.0 for one in found])
    return np.array(off), np.array(u)


def test_g_sensitivity_comes_from_the_model_that_predicts_left_out_dwells_best() -> None:
    time = np.linspace(0, 1, 20)[:, None]
    # As in experiment 6 of MIMU4444: 0.16 °/s in the session, in the order of the poses.
    for course in (0.16 * time, 0.16 * np.exp(-3 * time), 0.0 * time):
        off, u = misses(20, course, scored=True)
        assert np.mean(np.abs(off) < 2 * u) > 0.92
        assert np.sqrt((off**2).mean()) < 0.005
        blind = np.sqrt((misses(5, course, scored=False)[0][:, 1::3] ** 2).mean())
        assert (blind > 0.04) == course.any()


def test_a_drift_in_the_model_is_reported_and_its_zero_rate_is_the_mean_over_the_dwells() -> None:
    n = 12
    course = np.linspace(-1, 1, n)
    # The force along z nearly runs with time.
    along = np.column_stack([np.cos(7 * course), np.sin(7 * course), course + 0.3 * np.sin(11 * course)])
    result = fit_gyro_readings(at_rest(along, 0.001, beside=0.3 * course[:, None]))
    assert any(
        "a drift" in line and "predicts left-out dwells best: 0.00" in line for line in result.warnings
    )
    for axis, bias in zip("xyz", BIAS, strict=True):
        assert result[f"gyro_bias_{axis}"].value == pytest.approx(bias, abs=0.003)
    assert not any("drift" in name for name in (*result.parameters, *result.undetermined))
    again = np.concatenate([along, along[::-1]])
    assert not [
        line for line in fit_gyro_readings(at_rest(again, 0.001)).warnings if "in this order" in line
    ]


def test_the_reference_is_the_mean_temperature() -> None:
    data = at_rest(poses(6))
    warm = replace(data, conditions=replace(data.conditions, temperature_c=20.0 + np.arange(6.0)))
    assert fit_gyro_readings(warm, scored=False).reference_temperature_c == pytest.approx(22.5)
    assert fit_gyro_readings(data, scored=False).reference_temperature_c is None
