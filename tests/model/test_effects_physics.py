"""What each effect adds, against formulas and closed solutions written out here."""

import numpy as np
import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import Conditions, Enters, effect
from adis_gonio.model.effects.base import lagged
from adis_gonio.model.effects.stage_terms import alike

TURN = 2 * np.pi * np.arange(48) / 48


def tumble(alpha: float = 0.0, angles: np.ndarray = TURN) -> np.ndarray:
    """Ideal planar readings U_x = G cos ψ, U_y = G sin ψ at ψ = α − θ."""
    psi = alpha - angles
    return 1000 * np.column_stack([np.cos(psi), np.sin(psi)])


def conditions_at(angles: np.ndarray = TURN, **more: np.ndarray) -> Conditions:
    return Conditions(time_s=60.0 * np.arange(len(angles)), angle_rad=angles, **more)


def readings(
    name: str, values: list[float], ideal: np.ndarray, conditions: Conditions, **choices
) -> np.ndarray:
    one = effect(name, ("x", "y", "z")[: ideal.shape[1]], **choices)
    return one.reading(np.array(values), ideal, conditions)


def in_plane(name: str, values: list[float]) -> np.ndarray:
    """What an effect adds to X over a turn, at t = 0 … 2π."""
    ideal = 1000 * np.column_stack([np.cos(TURN), np.sin(TURN)])
    return readings(name, values, ideal, conditions_at())[:, 0]


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("bias", [1, 0], {"mean": 1}),
        ("quadratic", [1, 0], {"mean": 1 / 2, "cos2": 1 / 2}),
        ("cross_quadratic", [1, 0], {"mean": 1 / 2, "cos2": -1 / 2}),
        ("cross_axis", [1, 0], {"sin2": 1 / 2}),
        ("cubic", [1, 0], {"cos1": 3 / 4, "cos3": 1 / 4}),
        ("misalignment", [np.degrees(1e-3), 0], {"sin1": 1}),
        ("scale", [1e-3, 0], {"cos1": 1}),
    ],
)
def test_harmonics_of_the_tumble_are_those_of_the_theory(name, values, expected):
    lines = np.fft.rfft(in_plane(name, values)) / len(TURN)
    found = {"mean": lines[0].real}
    for n in range(1, 8):
        found[f"cos{n}"], found[f"sin{n}"] = 2 * lines[n].real, -2 * lines[n].imag
    for key, value in found.items():
        assert value == pytest.approx(expected.get(key, 0), abs=1e-12), key


def test_asymmetry_is_a_gain_that_differs_by_sign():
    ideal = np.array([[500.0, 0.0], [-500.0, 0.0]])
    added = readings("asymmetry", [4.0, 0.0], ideal, Conditions(np.zeros(2)))
    assert added[:, 0] == pytest.approx([2.0, 2.0])
    gains = (ideal[:, 0] + added[:, 0]) / ideal[:, 0]
    assert gains == pytest.approx([1.004, 0.996])


def test_cross_terms_in_space_take_both_axes_across_in_the_order_of_their_names():
    ideal = np.array([[100.0, 200.0, 400.0]])
    one = effect("cross_quadratic", ("x", "y", "z"))
    names = [p.name for p in one.parameters]
    assert names == ["kpp_xy", "kpp_xz", "kpp_yx", "kpp_yz", "kpp_zx", "kpp_zy"]
    added = one.reading(np.array([1.0, 10.0, 0.0, 0.0, 100.0, 0.0]), ideal, Conditions(np.zeros(1)))
    assert added[0] == pytest.approx([0.04 + 1.6, 0.0, 1.0])


def span_residual(columns: np.ndarray, base: np.ndarray) -> float:
    """Largest part of unit columns that no combination of the base explains."""
    unit = columns / np.linalg.norm(columns, axis=0)
    left = unit - base @ np.linalg.lstsq(base, unit, rcond=None)[0]
    return float(np.linalg.norm(left, axis=0).max())


def base_columns() -> np.ndarray:
    """Derivatives of the planar base model by α, K_x, K_y, Δφ (Δφ = 0, unit gains)."""
    ideal = tumble(0.3)
    zero = np.zeros(len(ideal))
    x, y = ideal.T
    columns = [np.stack(c) for c in ([-y, x], [x, zero], [zero, y], [zero, x])]
    return np.array([c.ravel() for c in columns]).T


@pytest.mark.parametrize(
    ("name", "in_base"),
    [
        ("misalignment", True),
        ("scale", True),
        ("gravity", True),
        ("cross_axis", False),
        ("bias", False),
        ("quadratic", False),
        ("cubic", False),
        ("stage_eccentricity", False),
    ],
)
def test_planar_base_model_holds_the_linear_terms_and_only_those(name, in_base):
    one = effect(name)
    design = one.derivative(one.defaults(), tumble(0.3), conditions_at())
    if one.enters is Enters.ATTITUDE:
        x, y = tumble(0.3).T
        design = np.stack([-y, x], axis=1)[:, :, None] * design[:, None, :]
    columns = design.transpose(1, 0, 2).reshape(-1, design.shape[2])
    residual = span_residual(columns, base_columns())
    assert residual < 1e-12 if in_base else residual > 0.3


def test_in_one_plane_cross_quadratic_is_bias_minus_quadratic():
    difference = in_plane("cross_quadratic", [1, 0]) - (
        in_plane("bias", [1, 0]) - in_plane("quadratic", [1, 0])
    )
    assert np.abs(difference).max() < 1e-12


def test_gravity_scales_all_axes_alike():
    ideal = np.array([[300.0, -400.0, 800.0]])
    one = effect("gravity")
    assert one.axes == ()
    assert one.reading(np.array([0.002]), ideal, Conditions(np.zeros(1)))[0] == pytest.approx(
        [0.6, -0.8, 1.6]
    )


def test_axis_tilt_leaves_the_angle_and_the_modulus_and_lifts_z():
    ideal = np.column_stack([tumble(0.2), np.zeros(len(TURN))])
    one = effect("axis_tilt")
    tilted = ideal + one.reading(np.array([3.0]), ideal, conditions_at())
    np.testing.assert_allclose(np.linalg.norm(tilted, axis=1), 1000)
    np.testing.assert_allclose(tilted[:, 2], 1000 * np.sin(np.deg2rad(3)))
    np.testing.assert_allclose(
        np.arctan2(tilted[:, 1], tilted[:, 0]), np.arctan2(ideal[:, 1], ideal[:, 0]), atol=1e-12
    )
    np.testing.assert_allclose(np.hypot(tilted[:, 0], tilted[:, 1]), 1000 * np.cos(np.deg2rad(3)))


def test_axis_tilt_is_a_rotation_for_any_attitude_and_finite_along_the_axis():
    rng = np.random.default_rng(3)
    ideal = np.vstack([rng.normal(size=(20, 3)) * 500, [[0.0, 0.0, 1000.0]]])
    one = effect("axis_tilt")
    tilted = ideal + one.reading(np.array([5.0]), ideal, Conditions(np.zeros(21)))
    np.testing.assert_allclose(np.linalg.norm(tilted[:-1], axis=1), np.linalg.norm(ideal[:-1], axis=1))
    np.testing.assert_allclose(tilted[-1], [0, 0, 1000 * np.cos(np.deg2rad(5))])


def test_axis_tilt_of_a_planar_pair_is_second_order():
    one = effect("axis_tilt")
    assert not one.derivative(np.array([0.0]), tumble(), conditions_at()).any()
    added = one.reading(np.array([1.0]), tumble(), conditions_at())
    assert np.abs(added).max() == pytest.approx(0.1523, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "remount_deg", "sign"),
    [
        ("stage_eccentricity", 180, -1),
        ("stage_ellipticity", 180, +1),
        ("stage_ellipticity", 90, -1),
        ("quadratic", 180, +1),
        ("cross_axis", 180, +1),
        ("cubic", 90, +1),
    ],
)
def test_remounting_turns_stage_terms_against_the_sensors(name, remount_deg, sign):
    """At the same orientation ψ of the part, the stage stands `remount_deg` further on."""
    ideal = tumble(0.3)
    one = effect(name)
    values = one.defaults()
    before, after = conditions_at(TURN), conditions_at(TURN + np.deg2rad(remount_deg))
    if one.enters is Enters.ATTITUDE:
        first, second = one.attitude_rad(values, before), one.attitude_rad(values, after)
    else:
        first, second = one.reading(values, ideal, before), one.reading(values, ideal, after)
    np.testing.assert_allclose(second, sign * first, atol=1e-12)


def test_stage_harmonics_are_degrees_of_sine_and_cosine():
    one = effect("stage_eccentricity")
    angle = one.attitude_rad(np.array([0.1, 0.2]), conditions_at(np.deg2rad([0.0, 90.0, 180.0])))
    assert np.rad2deg(angle) == pytest.approx([0.2, 0.1, -0.2])
    two = effect("stage_ellipticity")
    angle = two.attitude_rad(np.array([0.1, 0.2]), conditions_at(np.deg2rad([0.0, 45.0, 90.0])))
    assert np.rad2deg(angle) == pytest.approx([0.2, 0.1, -0.2])


def test_periodic_error_repeats_its_cycles_in_a_turn():
    three = effect("stage_periodic", cycles=3)
    angle = three.attitude_rad(np.array([0.1, 0.2]), conditions_at(np.deg2rad([0.0, 30.0, 60.0])))
    assert np.rad2deg(angle) == pytest.approx([0.2, 0.1, -0.2])
    for fewer in (0, 1, 2):
        with pytest.raises(UsageError, match="stage_eccentricity, two are stage_ellipticity"):
            effect("stage_periodic", cycles=fewer)


@pytest.mark.parametrize(
    ("cycles", "others"), [(5, 7), (5, 17), (5, 19), (1, 11), (2, 10), (0, 12), (6, 18)]
)
def test_cycles_that_fold_to_the_same_at_equal_angles_are_alike_until_an_angle_stands_between(
    cycles, others
):
    equal = np.deg2rad(np.arange(12) * 30.0) + 0.3
    assert alike(cycles, others, equal)
    waves = [
        effect("stage_periodic", cycles=max(n, 3)).derivative(
            np.zeros(2), np.zeros((12, 2)), conditions_at(equal)
        )
        for n in (cycles, others)
    ]
    if cycles > 2:
        assert span_residual(waves[1], waves[0]) == pytest.approx(0, abs=1e-9)
    assert not alike(cycles, others, np.append(equal, np.deg2rad(47.0)))
    assert not alike(cycles, others + 1, equal)


def test_what_follows_gain_time_and_supply_changes_its_sign_with_the_reading():
    conditions = Conditions(np.array([0.0, 120.0]), supply_v=np.array([5.0, 4.9]))
    ideal = np.array([[1000.0, -500.0]] * 2)
    drift = readings("scale_drift", [300.0, 300.0], ideal, conditions)
    np.testing.assert_allclose(drift, [[0, 0], [0.6, -0.3]], atol=1e-12)
    supply = readings("supply_scale", [2000.0, 2000.0], ideal, conditions)
    np.testing.assert_allclose(supply, [[0, 0], [-0.2, 0.1]], atol=1e-12)


def test_lean_by_temperature_takes_a_degree_of_the_reading_across_for_each_degree():
    conditions = Conditions(np.zeros(2), temperature_c=np.array([25.0, 35.0]))
    ideal = np.array([[1000.0, 400.0]] * 2)
    added = readings("misalignment_temperature", [0.1, -0.1], ideal, conditions)
    one_degree = np.pi / 180
    np.testing.assert_allclose(added, [[0, 0], [400 * one_degree, -1000 * one_degree]], atol=1e-12)


def test_creep_lacks_the_change_of_the_load_and_makes_up_for_it_with_its_time_constant():
    """A part that rested at 0 is turned over within 1 µs to +1 g on X, half of it on Y, and stays."""
    history = (
        np.array([0.0, 100.0, 100.000001, 500.0]),
        np.array([[0.0, 0.0]] * 2 + [[1000.0, 500.0]] * 2),
    )
    time = np.array([50.0, 100.000001, 160.0, 400.0])
    ideal = np.array([[0.0, 0.0]] + [[1000.0, 500.0]] * 3)
    added = readings("creep", [4.0, 2.0, 60.0], ideal, Conditions(time, load_history=history))
    left = np.array([0.0, 1.0, np.exp(-1.0), np.exp(-5.0)])
    np.testing.assert_allclose(added, -left[:, None] * [4.0, 1.0], atol=1e-6)


def test_backlash_and_hysteresis_are_full_widths_between_the_approaches():
    approach = np.array([1.0, -1.0, 0.0])
    conditions = Conditions(np.zeros(3), approach=approach)
    angle = effect("backlash").attitude_rad(np.array([0.04]), conditions)
    assert np.rad2deg(angle) == pytest.approx([0.02, -0.02, 0])
    added = readings("hysteresis", [3.0, 1.0], np.zeros((3, 2)), conditions)
    np.testing.assert_allclose(added, [[1.5, 0.5], [-1.5, -0.5], [0, 0]])


def test_slip_and_outlier_touch_their_dwell_only():
    conditions = Conditions(np.zeros(4), order=np.array([0.0, 1.0, 2.0, 3.0]))
    slip = effect("position_slip", dwell=2).attitude_rad(np.array([0.5]), conditions)
    assert np.rad2deg(slip) == pytest.approx([0, 0, 0.5, 0])
    added = readings("outlier_dwell", [7.0, -2.0], np.zeros((4, 2)), conditions, dwell=1)
    np.testing.assert_allclose(added, [[0, 0], [7, -2], [0, 0], [0, 0]])


def test_temperature_terms_vanish_at_25_degrees_and_have_their_units():
    conditions = Conditions(np.zeros(3), temperature_c=np.array([15.0, 25.0, 45.0]))
    ideal = np.array([[1000.0, -500.0]] * 3)
    cubic = readings("bias_temperature", [0.5, 0.01, 1e-4, 0, 0, 0], ideal, conditions, degree=3)
    assert cubic[:, 0] == pytest.approx([-5 + 1 - 0.1, 0, 10 + 4 + 0.8])
    gain = readings("scale_temperature", [40.0, 40.0], ideal, conditions)
    np.testing.assert_allclose(gain, [[-0.4, 0.2], [0, 0], [0.8, -0.4]], atol=1e-12)


def test_supply_drift_and_vibration_have_their_units():
    ideal = np.zeros((2, 2))
    time = np.array([0.0, 90.0])
    assert readings("supply_bias", [5.0, 0.0], ideal, Conditions(time, supply_v=np.array([5.0, 5.2])))[
        :, 0
    ] == pytest.approx([0, 1])
    assert readings("bias_drift", [0.4, 0.0], ideal, Conditions(time))[:, 0] == pytest.approx([0, 0.6])
    shaken = Conditions(time, variance_mg2=np.array([[0.0, 0.0], [2500.0, 1e4]]))
    np.testing.assert_allclose(
        readings("vibration_rectification", [40.0, 20.0], ideal, shaken), [[0, 0], [0.1, 0.2]]
    )


def test_vibration_rectification_is_what_a_quadratic_does_to_the_mean():
    rng = np.random.default_rng(1)
    samples = np.column_stack([300 + 80 * rng.standard_normal(1000), np.zeros(1000)])
    mean, variance = samples.mean(axis=0, keepdims=True), samples.var(axis=0, keepdims=True)
    of_samples = readings("quadratic", [9.0, 0.0], samples, Conditions(np.zeros(1000))).mean(axis=0)
    at_mean = readings("quadratic", [9.0, 0.0], mean, Conditions(np.zeros(1)))
    rectified = readings(
        "vibration_rectification", [9.0, 0.0], mean, Conditions(np.zeros(1), variance_mg2=variance)
    )
    np.testing.assert_allclose(of_samples, (at_mean + rectified)[0])


def test_warm_up_and_settling_decay_with_their_own_clock():
    time = np.array([0.0, 100.0])
    one = readings("warm_up", [2.0, 0.0, 100.0], np.zeros((2, 2)), Conditions(time))
    assert one[:, 0] == pytest.approx([2, 2 / np.e])
    conditions = Conditions(time, time_in_dwell_s=np.array([3.0, 0.0]))
    two = readings("settling", [0.0, 4.0, 3.0], np.zeros((2, 2)), conditions)
    np.testing.assert_allclose(two, [[0, 4 / np.e], [0, 4]])


class TestLag:
    def test_step_held_by_fine_records_decays_with_the_time_constant(self):
        record_s = np.array([0.0, 1e-6, 1000.0])
        late, _ = lagged(record_s, np.array([20.0, 30.0, 30.0]), np.array([0.0, 50.0, 200.0]), 50.0)
        assert late == pytest.approx(30 - 10 * np.exp([0.0, -1.0, -4.0]), abs=1e-4)

    @pytest.mark.parametrize("seed", range(3))
    def test_ramp_on_uneven_records_is_solved_exactly(self, seed):
        rng = np.random.default_rng(seed)
        record_s = np.concatenate([[0.0], np.cumsum(rng.exponential(40.0, 37))])
        time = rng.uniform(0, record_s[-1], 30)
        tau, slope = 70.0, 0.03
        late, by_tau = lagged(record_s, 25 + slope * record_s, time, tau)
        decay = np.exp(-time / tau)
        np.testing.assert_allclose(late, 25 + slope * (time - tau * (1 - decay)), rtol=1e-12)
        np.testing.assert_allclose(by_tau, slope * (decay * (1 + time / tau) - 1), atol=1e-12)

    def test_agrees_with_a_fine_integration_of_the_differential_equation(self):
        rng = np.random.default_rng(8)
        record_s = np.cumsum(rng.uniform(1, 30, 60))
        record = 25 + np.cumsum(rng.normal(size=60))
        fine = np.arange(record_s[0], record_s[-1], 0.01)
        x = np.interp(fine, record_s, record)
        y, slow = x[0], np.empty(len(fine))
        for k, value in enumerate(x):
            slow[k] = y
            y += 0.01 / 45.0 * (value - y)
        late, _ = lagged(record_s, record, fine[::500], 45.0)
        np.testing.assert_allclose(late, slow[::500], atol=2e-3)

    def test_before_the_first_record_nothing_lags_and_after_the_last_it_settles(self):
        record_s, record = np.array([0.0, 10.0]), np.array([20.0, 30.0])
        late, by_tau = lagged(record_s, record, np.array([-5.0, 1e6]), 20.0)
        assert late == pytest.approx([20, 30])
        assert by_tau == pytest.approx([0, 0])

    def test_long_records_with_a_short_time_constant_do_not_overflow(self):
        record_s = np.arange(200_000.0)
        late, by_tau = lagged(record_s, np.sin(record_s / 1000), record_s, 0.01)
        assert np.isfinite(by_tau).all()
        np.testing.assert_allclose(late, np.sin(record_s / 1000), atol=2e-5)

    @pytest.mark.parametrize(
        ("times", "values", "tau"),
        [([0.0, 0.0], [1.0, 2.0], 1.0), ([], [], 1.0), ([0.0, 1.0], [1.0], 1.0), ([0.0], [1.0], 0.0)],
    )
    def test_impossible_input_is_refused(self, times, values, tau):
        with pytest.raises(UsageError):
            lagged(np.array(times), np.array(values), np.zeros(1), tau)

    def test_lag_and_line_of_equal_size_are_a_zero_that_follows_the_late_temperature(self):
        record_s = np.arange(0.0, 600.0, 5.0)
        temperature = 25 + 6 * np.sin(record_s / 60)
        conditions = Conditions(
            record_s, temperature_c=temperature, temperature_history=(record_s, temperature)
        )
        ideal = np.zeros((len(record_s), 2))
        both = readings("bias_temperature", [0.5, 0.0], ideal, conditions) + readings(
            "thermal_lag", [0.5, 0.0, 80.0], ideal, conditions
        )
        late, _ = lagged(record_s, temperature, record_s, 80.0)
        np.testing.assert_allclose(both[:, 0], 0.5 * (late - 25), atol=1e-12)


class TestSamples:
    conditions = Conditions(time_s=np.arange(4000) / 800)

    def change(self, name: str, values: list[float], samples: np.ndarray, axes=("x", "y")) -> np.ndarray:
        before = samples.copy()
        changed = effect(name, axes).samples_mg(
            np.array(values), samples, self.conditions, np.random.default_rng(0)
        )
        np.testing.assert_array_equal(samples, before)
        return changed

    def test_saturation_stops_samples_at_both_ends(self):
        samples = np.tile(np.linspace(-2000, 2000, 4000)[:, None], 2)
        changed = self.change("saturation", [1700.0], samples, ("x",))
        assert changed[:, 0].min() == -1700
        assert changed[:, 0].max() == 1700
        inside = np.abs(samples[:, 0]) <= 1700
        np.testing.assert_array_equal(changed[inside], samples[inside])
        np.testing.assert_array_equal(changed[:, 1], samples[:, 1])

    def test_quantization_stands_on_multiples_at_most_half_a_step_away(self):
        samples = np.random.default_rng(4).normal(300, 5, (4000, 2))
        changed = self.change("quantization", [0.4672], samples)
        steps = changed / 0.4672
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
        assert np.abs(changed - samples).max() <= 0.4672 / 2 + 1e-9
        np.testing.assert_array_equal(self.change("quantization", [0.0], samples), samples)

    def test_tone_is_one_line_at_its_frequency_with_its_phase(self):
        changed = self.change("tone", [5.0, -2.0, 50.0, 90.0], np.zeros((4000, 2)))
        expected = np.cos(2 * np.pi * 50 * self.conditions.time_s)
        np.testing.assert_allclose(changed, np.outer(expected, [5, -2]), atol=1e-9)

    def test_noise_change_joins_at_its_moment_and_adds_its_variance(self):
        changed = self.change("noise_change", [3.0, 6.0, 2.5], np.zeros((4000, 2)))
        late = self.conditions.time_s >= 2.5
        assert not changed[~late].any()
        assert changed[late].std(axis=0) == pytest.approx([3, 6], rel=0.06)

    def test_reading_has_no_derivative_by_what_changes_samples(self):
        one = effect("tone")
        with pytest.raises(UsageError, match="tone"):
            one.derivative(one.defaults(), np.zeros((4000, 2)), self.conditions)


@pytest.mark.parametrize(("name", "count"), [("stage_eccentricity", 2), ("stage_ellipticity", 4)])
def test_angles_that_show_one_phase_of_the_cycles_show_nothing_of_the_other(name, count):
    angle_rad = np.arange(count) * 2 * np.pi / count
    sine, cosine = effect(name).basis(Conditions(np.zeros(count), angle_rad=angle_rad))
    assert not sine.any()
    assert np.abs(cosine) == pytest.approx(np.ones(count))
