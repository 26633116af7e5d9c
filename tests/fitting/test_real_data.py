"""Recordings of real sensors, by others; see the table of sources in the documentation."""

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import FitError
from adis_gonio.fitting import fit
from adis_gonio.model.measurement import sensitivity
from adis_gonio.record.loading import load_session
from recordings import recording


def load(name):
    return load_session(recording(name))


@pytest.fixture(scope="module")
def xy_turn():
    return load("adis16350_xy_turn")


@pytest.mark.parametrize(
    ("method", "delta_k", "delta_phi"),
    [("paper", 0.0340, -4.333), ("two-position", 0.0346, -4.332), ("four-position", 0.0011, 0.072)],
)
def test_xy_turn_by_the_closed_methods(xy_turn, method, delta_k, delta_phi):
    result = fit(xy_turn, method)
    assert result["delta_k"].value == pytest.approx(delta_k, abs=5e-5)
    assert result["delta_phi"].value == pytest.approx(delta_phi, abs=5.1e-4)
    blind = [w for w in result.warnings if "bias cannot be seen in two positions" in w]
    assert bool(blind) == (method != "four-position")
    # The reason for -4.3° instead of 0.07° is part of the answer.
    assert all("a bias of +57.3 mg on X and −20.6 mg on Y" in w for w in blind)
    assert all("moves Δφ by −4.3°" in w for w in blind)


def test_xy_turn_bias_of_four_positions(xy_turn):
    result = fit(xy_turn, "four-position")
    assert result["bias_x"].value == pytest.approx(57.3, abs=0.05)
    assert result["bias_y"].value == pytest.approx(-20.6, abs=0.05)


def test_xy_turn_by_likelihood_agrees_with_four_positions(xy_turn):
    four, ml = fit(xy_turn, "four-position"), fit(xy_turn)
    assert ml.method == "ml"
    for name in ("delta_k", "delta_phi", "bias_x", "bias_y"):
        assert abs(ml[name].value - four[name].value) < 3 * four[name].u


def test_fourteen_poses():
    result = fit(load("adis16350_14_poses"), "ml")
    assert result["bias_x"].value == pytest.approx(57, abs=1)
    assert result["bias_y"].value == pytest.approx(-21, abs=1)
    assert result["bias_z"].value == pytest.approx(46, abs=1)
    assert result.residual_rms_mg == pytest.approx(2.0, abs=0.1)
    assert any("does not describe this session" in w for w in result.warnings)
    assert "delta_k" not in result


def test_xsens_dwells_and_scale_are_found():
    session = load("xsens_mti_recording")
    assert 36 <= len(session.dwells) <= 40
    assert any("dwells found by stillness" in note for note in session.notes)
    result = fit(session)
    # The published gains are along squared-up axes (an upper triangular matrix), ours along the axes' own.
    gains = [result[f"scale_{axis}"].value for axis in "xyz"]
    skews = np.radians([result[f"skew_{pair}"].value for pair in ("xy", "xz", "yz")])
    axes = sensitivity(np.array([*gains, *skews]))
    squared_up = np.diag(np.linalg.cholesky((axes @ axes.T)[::-1, ::-1]))[::-1]
    assert squared_up == pytest.approx([414.4, 412.0, 414.6], abs=0.1)
    assert gains == pytest.approx([414.4, 412.0, 414.6], abs=0.2)
    for name, value in (("bias_x", 33123.9), ("bias_y", 33275.1), ("bias_z", 32364.5)):
        assert result[name].value == pytest.approx(value, abs=0.5)
    assert result.residual_rms_mg <= 0.11


@pytest.mark.parametrize("number", range(5))
def test_mpu9150_is_left_with_its_noise(number):
    session = load(f"mpu9150_{number}_recording")
    assert 20 <= len(session.dwells) <= 26
    alone = fit(replace(session, turns_from=lambda: ()))
    assert alone.residual_rms_mg <= 0.28
    assert alone.extra_mg == 0
    # The recording's turns agree with gravity and are used: nine parameters no longer follow its noise.
    result = fit(session)
    assert result.links.used >= 15
    assert result.residual_rms_mg <= 0.3
    for name, one in result.parameters.items():
        assert abs(one.value - alone[name].value) <= 2 * alone[name].u
    assert result.extra_mg == 0


def test_one_pose_through_a_chamber_is_one_position():
    with pytest.raises(FitError, match="one position only"):
        fit(load("thermal_cycle"))
