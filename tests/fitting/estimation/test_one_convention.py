"""One model, one convention: `fit`, `trace` and the simulator's truth say the same of one session."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio import FitResult, TraceResult, fit, trace
from adis_gonio.model.measurement import (
    FreeAttitude,
    PlanarTurn,
    axes_matrix,
    axes_matrix_derivatives,
    gains_and_skews,
    sensitivity,
)
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.world import World

G_MG = 1000.0


def worlds(seed: int, space: bool) -> tuple[World, Session]:
    """A simulated part, and readings of what its ideal axes feel: averaged, with little noise."""
    world = World(WorldSettings(fixture_sigma_deg=0.002), seed=seed)
    rng = np.random.default_rng(seed)
    truth = world.truth()
    bias = [truth[f"bias_{axis}"] for axis in "xyz"]
    if space:
        directions = rng.normal(size=(30, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        angles: list[float | None] = [None] * 30
    else:
        theta = np.arange(0.0, 720.0, 30.0)
        psi = np.radians(truth["alpha"] - theta + 0.002 * rng.standard_normal(len(theta)))
        directions = np.stack([np.cos(psi), np.sin(psi), np.zeros(len(psi))], axis=1)
        angles = theta.tolist()
    # The world's own method: the rows of its sensitivity times the direction of gravity.
    readings = world._ideal(directions) + bias + 0.05 * rng.standard_normal((len(directions), 3))
    axes = 3 if space else 2
    dwells = tuple(
        Dwell(k, np.array([20.0 * k]), readings[k : k + 1, :axes], angle_deg=angle)
        for k, angle in enumerate(angles)
    )
    return world, Session(
        dwells,
        accel_unit="mg",
        sensor="generic",
        reading_u_mg=0.05,
        plane="none" if space else "xy",
        fixture_sigma_deg=np.inf if space else 0.002,
    )


@pytest.mark.parametrize("space", [False, True])
def test_fit_trace_and_the_simulated_truth_agree_on_every_shared_name(space: bool) -> None:
    """Thirty sessions are fitted; the first three are also traced, which must state the same values."""
    off: dict[str, list[float]] = {}
    both: set[str] = set()
    for seed in range(30):
        world, session = worlds(seed, space)
        truth = world.truth()
        by_fit = fit(session, method="ml")
        if seed < 3:
            both |= agreed(trace(session, max_effects=1), by_fit)
        for name, estimate in by_fit.parameters.items():
            if estimate.u:
                z = (estimate.value - truth[name]) / estimate.u
                off.setdefault(name, []).append(z)
    assert {"scale_x", "scale_y"} <= both <= set(off)
    for name in both:
        z = np.array(off[name])
        assert np.mean(np.abs(z) < 1.96) > 0.8, name  # thirty intervals of 95 %
        assert abs(np.mean(z)) < 0.6, name


def agreed(result: TraceResult, by_fit: FitResult) -> set[str]:
    """Names that a trace and a fit of one session both state, after a check that they agree."""
    traced = dict(result.base)
    for finding in result.found:
        traced |= finding.parameters
    shared = set(traced) & by_fit.parameters.keys()
    assert {"scale_x", "scale_y"} <= shared
    for name in shared:
        estimate, value = by_fit[name], traced[name]
        assert value.unit == estimate.unit, name
        if "bias" in {finding.effect for finding in result.found}:
            assert value.value == pytest.approx(estimate.value, abs=0.25 * estimate.U + 1e-9), name
    return shared


def test_the_plane_is_the_spatial_model_seen_from_the_plane() -> None:
    base = np.array([0.3, 1.02, 0.97, 0.01])
    psi = base[0] + np.linspace(0, 6, 11)
    planar = PlanarTurn(G_MG).ideal(base, np.zeros(11), psi - base[0])
    unit = np.stack([np.cos(psi), np.sin(psi), np.zeros(11)], axis=1)
    space = FreeAttitude(G_MG).ideal(np.array([1.02, 0.97, 1.1, 0.01, -0.02, 0.03]), unit, np.zeros(11))
    np.testing.assert_allclose(planar, space[:, :2], atol=1e-9)


def test_a_skew_is_ninety_degrees_minus_the_angle_between_two_axes() -> None:
    skews = np.array([0.02, -0.03, 0.05])
    axes = axes_matrix(skews)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=1), 1.0)
    cosines = [axes[0] @ axes[1], axes[0] @ axes[2], axes[1] @ axes[2]]
    np.testing.assert_allclose(np.pi / 2 - np.arccos(cosines), skews, atol=1e-12)
    made = sensitivity(np.array([1.1, 0.9, 1.2, *skews]))
    gains, again = gains_and_skews(made @ made.T)
    np.testing.assert_allclose(gains, [1.1, 0.9, 1.2])
    np.testing.assert_allclose(again, skews, atol=1e-12)


def test_derivatives_of_the_axes_are_those_of_differences() -> None:
    skews = np.array([0.1, -0.07, 0.05])
    for k, derivative in enumerate(axes_matrix_derivatives(skews)):
        step = 1e-6 * np.eye(3)[k]
        difference = (axes_matrix(skews + step) - axes_matrix(skews - step)) / 2e-6
        np.testing.assert_allclose(derivative, difference, atol=1e-8)


@pytest.mark.parametrize("model", [PlanarTurn(G_MG), FreeAttitude(G_MG)])
def test_columns_and_tangents_of_a_measurement_are_those_of_differences(model) -> None:
    rng = np.random.default_rng(4)
    n = 7
    base = model.nominal + 0.02 * rng.standard_normal(len(model.parameters))
    turn = rng.uniform(-3, 3, n) if model.axes == 2 else np.zeros(n)
    unit = rng.normal(size=(n, 3))
    attitude = 0.01 * rng.standard_normal(n)
    if model.axes == 3:
        attitude = unit / np.linalg.norm(unit, axis=1, keepdims=True)
    columns = model.columns(base, attitude, turn)
    for k in range(len(base)):
        step = 1e-6 * np.eye(len(base))[k]
        up, down = (model.ideal(base + s, attitude, turn) for s in (step, -step))
        np.testing.assert_allclose(columns[:, :, k], (up - down) / 2e-6, atol=1e-4)
    tangent = model.tangent(base, attitude, turn)
    for k in range(model.freedom):
        step = np.zeros((n, model.freedom))
        step[:, k] = 1e-6
        up, down = (model.ideal(base, model.moved(attitude, s), turn) for s in (step, -step))
        np.testing.assert_allclose(tangent[:, :, k], (up - down) / 2e-6, atol=1e-3)


@pytest.mark.parametrize("model", [PlanarTurn(G_MG), FreeAttitude(G_MG)])
def test_a_calibrated_sensor_computes_the_gravity_that_it_was_in(model) -> None:
    rng = np.random.default_rng(5)
    base = model.nominal + 0.03 * rng.standard_normal(len(model.parameters))
    unit = rng.normal(size=(9, model.axes))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    if model.axes == 3:
        reading = model.ideal(base, unit, np.zeros(9))
    else:
        psi = np.arctan2(unit[:, 1], unit[:, 0])
        reading = model.ideal(base, psi - base[0], np.zeros(9))
        np.testing.assert_allclose(np.cos(model.angle_rad(base, reading) - psi), 1.0)
    np.testing.assert_allclose(model.calibrated(base, reading), unit, atol=1e-9)
