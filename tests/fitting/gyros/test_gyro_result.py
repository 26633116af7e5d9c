"""What a fit of gyros says of itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.determination import covariance
from adis_gonio.fitting.estimation.readings import from_means, known_part
from adis_gonio.fitting.gyros import gyro_fit as module
from adis_gonio.fitting.gyros.gyro_fit import GyroFit, fit_gyro
from fitting.gyros.test_doubtful_gyros import session

VALUES = {
    "gyro_bias_x": Value(0.4, 0.013, "dps"),
    "gyro_scale_x": Value(0.99, 0.02, "1"),
    "gyro_scale_z": Value(1.00984, 0.00041, "1"),
}
RESULT = GyroFit(
    parameters=VALUES, covariance=np.eye(3), chi2=3.0, dof=2,
    residual_dps=np.array([[3.0, 0.0, 0.0], [0.0, 4.0, 0.0]]), positions=tuple(range(17)), turns=3,
)  # fmt: skip


def test_dwells_and_turns_are_counted_apart() -> None:
    assert RESULT.extent == "14 dwells and 3 turns"
    assert replace(RESULT, turns=1).extent == "16 dwells and 1 turn"
    assert replace(RESULT, turns=0, positions=(0,)).extent == "1 dwell"
    assert repr(RESULT).startswith(
        "GyroFit(14 dwells and 3 turns, gyro_bias_x 0.400\u00a0±\u00a00.025\u00a0°/s, "
    )
    document = RESULT.as_dict()
    assert (document["positions_used"], document["turns_used"]) == (14, 3)
    assert document["residual_rms_dps"] == pytest.approx(5 / np.sqrt(6))
    assert document["time_base_u"] > 0
    assert replace(RESULT, turns=0).as_dict()["time_base_u"] is None
    assert "gyro_scale_z" in RESULT
    assert "gyro_scale_y" not in RESULT


def test_a_score_of_all_axes_is_their_root_mean_square_and_largest() -> None:
    document = module._score(np.array([[3.0, -6.0, 0.1], [-5.0, 2.0, 0.0]]))
    assert document["residual_rms_dps"] == pytest.approx(np.sqrt((9 + 36 + 0.01 + 25 + 4) / 6))
    assert document["residual_max_dps"] == 6.0
    assert document["residual_rms_by_axis_dps"]["x"] == pytest.approx(np.sqrt(17))


def test_an_error_names_the_session() -> None:
    whole = session(rows=5)
    checks = replace(whole, dwells=tuple(replace(dwell, use="check") for dwell in whole.dwells))
    with pytest.raises(FitError, match=r"^every dwell is for checking"):
        fit_gyro(checks)
    with pytest.raises(FitError, match=r"^bench\.csv: every dwell is for checking"):
        fit_gyro(replace(checks, source="bench.csv"))


def test_no_reading_at_all_is_refused() -> None:
    empty = from_means(np.zeros((0, 3)), np.zeros((0, 3, 3)), SimpleNamespace(angle_rad=None))
    with pytest.raises(FitError, match="no dwell holds samples of the gyros"):
        module.fit_gyro_readings(empty)


def test_the_covariance_holds_whatever_the_units_of_the_parameters() -> None:
    rows = np.random.default_rng(1).standard_normal((12, 4)) * [1.0, 1e9, 1e-3, 0.0]
    free = np.array([True, True, True, False])
    found = covariance(rows.T @ rows, free, np.zeros((4, 0)))
    assert not found[3].any()
    size = np.array([1.0, 1e9, 1e-3])
    unit = rows[:, :3] / size
    np.testing.assert_allclose(
        found[:3, :3], np.linalg.inv(unit.T @ unit) / np.outer(size, size), rtol=1e-6
    )


def test_a_sensor_has_the_parts_that_it_has() -> None:
    assert known_part("gyro") == "gyro"
    with pytest.raises(UsageError, match="no part 'compass'; it has accelerometer, gyro"):
        known_part("compass")


def test_three_dwells_are_scored_by_what_two_say_of_the_third() -> None:
    whole = session()
    three = replace(whole, dwells=whole.dwells[:3])
    means = np.array([dwell.gyro.mean(axis=0) for dwell in three.dwells])
    off = np.abs([means[k] - np.delete(means, k, axis=0).mean(axis=0) for k in range(3)])
    found = fit_gyro(three).scores["zero rate"]
    # Where 1/f noise is to be expected the nearer dwell counts a little more.
    rms = list(found["residual_rms_by_axis_dps"].values())
    assert rms == pytest.approx(np.sqrt((off**2).mean(axis=0)), rel=0.02)
    assert found["residual_max_dps"] == pytest.approx(off.max(), rel=0.02)
    assert fit_gyro(replace(whole, dwells=whole.dwells[:2])).scores == {}
