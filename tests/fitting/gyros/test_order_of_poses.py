"""What the order of poses does not tell: a fit of gyros says it, for every course of the zero rate."""

import numpy as np

from adis_gonio import Dwell, Session, fit
from adis_gonio.base.uncertainty import effective_dof

DWELL_S = 10.0


def session_of(up, added_dps, rng) -> Session:
    """Dwells with an axis (n, 3) up and a rate (n,) added to every gyro."""
    dwells = []
    for k, (axis, rate) in enumerate(zip(up, added_dps, strict=True)):
        time = DWELL_S * 2 * k + np.arange(500) / 50
        accel = -1000 * np.asarray(axis) + rng.normal(0, 1, (500, 3))
        gyro = rate + 0.1 * np.array([1.0, 0.5, -1.0]) * axis[2] + rng.normal(0, 0.1, (500, 3))
        dwells.append(Dwell(k, time, accel, gyro=gyro))
    return Session(tuple(dwells), sensor="generic", accel_unit="mg", plane="none", fixture_sigma_deg=np.inf)


def order(session) -> list[str]:
    """Warnings of the fit that speak of the order of poses."""
    return [text for text in fit(session, part="gyro").warnings if "order of poses" in text]


def around(z) -> np.ndarray:
    """Directions (n, 3) of these heights, turned by the golden angle about Z."""
    turned = 2.4 * np.arange(len(z))
    level = np.sqrt(1 - z**2)
    return np.column_stack([level * np.cos(turned), level * np.sin(turned), z])


def test_a_force_that_only_grows_with_time_is_said_to_be_undetermined_beside_a_drift():
    told = order(session_of(around(np.linspace(-0.95, 0.95, 12)), np.zeros(12), np.random.default_rng(1)))
    drifts = [text for text in told if "drift with time" in text]
    assert len(drifts) == 1
    assert "g_sensitivity_xz, yz, zz cannot be determined" in drifts[0]
    assert "+0.000" not in drifts[0]


def test_a_warm_up_is_named_and_a_shuffled_order_without_one_is_not():
    rng = np.random.default_rng(2)
    z = rng.permutation(np.linspace(-0.95, 0.95, 14))
    z = np.sort(z)[::-1] + rng.normal(0, 0.15, 14)
    up = around(np.clip(z, -1, 1))
    warm = 0.4 * np.exp(-DWELL_S * 2 * np.arange(14) / 60)
    found = fit(session_of(up, warm, rng), part="gyro")
    assert any("a warm-up of the zero rates is in the model" in text for text in found.warnings)
    for axis in "xyz":
        zero = found[f"gyro_bias_{axis}"]
        assert zero.U < 0.05
        # Linear in the time constant, the zero rates would be off by more than 20 U.
        assert abs(zero.value - warm.mean()) < 2 * zero.U
    both = np.concatenate([np.eye(3), -np.eye(3)])
    mixed = np.concatenate([both, both[::-1], both[[2, 5, 0, 3, 1, 4]]])
    assert not order(session_of(mixed, np.zeros(18), rng))


def test_u_contains_a_typical_g_sensitivity_that_the_poses_do_not_show():
    # With each arrow up only, a zero rate may as well be a g-sensitivity alike along all axes.
    up = np.tile(np.eye(3), (3, 1))
    found = fit(session_of(up, np.zeros(9), np.random.default_rng(3)), part="gyro")
    assert found.undetermined
    for axis in "xyz":
        zero = found[f"gyro_bias_{axis}"]
        assert 0.05 < zero.U < 0.3
        assert abs(zero.value) < zero.U


def test_a_typical_size_is_known_and_adds_no_doubt_to_u():
    up, rng = np.tile(np.eye(3), (3, 1)), np.random.default_rng(3)
    found = fit(session_of(up, rng.normal(0, 0.05, 9), rng), part="gyro")
    assert min(found.inflation.values()) > 10
    # A zero rate is the mean of six dwells along two axes, each with an unknown g-sensitivity.
    typical = 2 * (0.05 / 2) ** 2
    for axis in "xyz":
        zero = found[f"gyro_bias_{axis}"]
        scatter = zero.u**2 - typical
        # By the residual of the gyro alone, or by all of them.
        assert effective_dof([(scatter, 9 - 2), (typical, np.inf)]) * 0.9 < zero.dof
        assert zero.dof < effective_dof([(scatter, 3 * (9 - 2)), (typical, np.inf)]) * 1.1
        assert zero.dof > 20
