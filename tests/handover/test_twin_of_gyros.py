"""The twin of a session whose gyros are calibrated has their faults; of one without gyros it has none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.calibrate import GyroCalibration
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.handover.digital_twin import gyro_settings, simulate_like
from adis_gonio.model.effects import effect
from adis_gonio.record.loading import load_session
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World
from adis_gonio.tracing.trace_calibrations import gyros_as_recorded
from bench.writeback.gyro_rig import FAULTS
from bench.writeback.rig import new_bus, record
from handover.gyros import FULL, estimates


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    path = record(tmp_path_factory.mktemp("twin") / "poses.session", new_bus(3, **FAULTS), "poses")
    return load_session(path)


def modelled(session):
    """The base model with a bias, fitted: what a trace of this session ends with."""
    data = readings_of(session)
    bias = NamedTerm("bias", (), 0.0, effect("bias", ("x", "y", "z")[: data.axes]))
    return Fit.begin(data).with_terms([bias], [np.zeros(data.axes)]).refit()


def test_the_twin_s_gyros_are_found_with_the_faults_of_the_session_s(measured):
    own = gyros_as_recorded(measured)
    twin = simulate_like(measured, modelled(measured), seed=4)
    again = gyros_as_recorded(twin)
    for one in own.parameters:
        if one.name.startswith(("gyro_bias", "g_sensitivity")):
            other = again[one.name]
            # Each has its own noise, and the supply's ripple and 1/f noise of its own.
            limit = 5 * np.hypot(one.u, other.u)
            assert abs(one.value - other.value) < limit, one.name
    assert abs(own["gyro_bias_x"].value - FAULTS["gyro_bias_x_dps"]) < 0.15
    assert abs(own["g_sensitivity_yx"].value - 0.24) < 0.05


def test_a_session_without_gyros_has_a_twin_without(measured):
    bare = replace(measured, dwells=tuple(replace(dwell, gyro=None) for dwell in measured.dwells))
    twin = simulate_like(bare, modelled(bare), seed=4)
    assert all(dwell.gyro is None for dwell in twin.dwells)


def test_the_settings_of_a_calibration_make_a_world_that_the_calibration_corrects():
    made = GyroCalibration.of(estimates(FULL))
    bias_mg = np.array([40.0, -25.0, 60.0])
    quiet = {
        "noise_mg": 0.0, "bias_instability_mg": 0.0, "gyro_noise_dps": 0.0, "gyro_instability_dps": 0.0,
        "vibration_mg": 0.0, "fixture_sigma_deg": 0.0, "delta_k": 0.0, "delta_phi_deg": 0.0,
        "scale_y": 1.0, "scale_z": 1.0, "skew_xz_deg": 0.0, "skew_yz_deg": 0.0,
    }  # fmt: skip
    for k, axis in enumerate("xyz"):
        quiet |= {
            f"bias_{axis}_mg": float(bias_mg[k]),
            f"bias_tempco_{axis}_mg_per_c": 0.0,
            f"scale_tempco_{axis}_ppm_per_c": 0.0,
        }
    world = World(WorldSettings(**quiet, **gyro_settings(made, bias_mg)), seed=2)
    time_s = np.arange(0.0, 5.0, 1 / 819.2)
    world.stage.move_to(0.0, 120.0, 1)
    seen = world.sample(time_s)
    true = world.stage.at(time_s).rate_dps
    assert np.abs(true).max() > 20
    assert np.abs(seen.gyro_dps - true).max() > 1.0
    assert np.abs(made.correct(seen.gyro_dps, seen.accel_mg / 1000) - true).max() < 2e-3
