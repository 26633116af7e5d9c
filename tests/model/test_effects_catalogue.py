"""The catalogue as a whole: names, bounds, derivatives, covariates; every effect is walked."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import effects_page
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects import BUILT_IN, Conditions, Effect, Enters, Parameter, effect

NAMES = [
    "bias",
    "scale",
    "misalignment",
    "cross_axis",
    "quadratic",
    "cubic",
    "asymmetry",
    "cross_quadratic",
    "bias_temperature",
    "scale_temperature",
    "misalignment_temperature",
    "thermal_lag",
    "bias_drift",
    "scale_drift",
    "warm_up",
    "supply_bias",
    "supply_scale",
    "hysteresis",
    "creep",
    "backlash",
    "stage_eccentricity",
    "stage_ellipticity",
    "stage_periodic",
    "axis_tilt",
    "gravity",
    "saturation",
    "quantization",
    "vibration_rectification",
    "tone",
    "settling",
    "position_slip",
    "outlier_dwell",
    "noise_change",
]
GYRO_NAMES = [
    "gyro_bias_temperature",
    "g_sensitivity",
    "g2_sensitivity",
    "gyro_scale",
    "gyro_scale_temperature",
    "gyro_misalignment",
    "gyro_drift",
    "gyro_warm_up",
    "gyro_supply",
    "gyro_asymmetry",
]
NAMES += GYRO_NAMES

PER_DWELL = 50
ROOT = Path(__file__).resolve().parents[2]


def made(name: str, axes: tuple[str, ...] = ("x", "y", "z")) -> Effect:
    return effect(name, axes, **({"degree": 3} if name.endswith("bias_temperature") else {}))


def bench(dwells: int = 12, columns: int = 3) -> tuple[np.ndarray, Conditions]:
    """Samples of a session: ideal readings constant within a dwell, covariates that move slowly."""
    rng = np.random.default_rng(5)
    order = np.repeat(np.arange(dwells), PER_DWELL)
    time = np.arange(order.size) * 0.2 + 5.0 * order
    angles = rng.uniform(0, 2 * np.pi, dwells)
    vector = rng.normal(size=(dwells, 3))
    ideal = 1000 * vector / np.linalg.norm(vector, axis=1)[:, None]
    rate = rng.uniform(-200, 200, (dwells, 3))[order]
    history = np.arange(0.0, time[-1] + 5.0, 2.0)
    ends = (np.arange(dwells)[:, None] * (0.2 * PER_DWELL + 5.0) + [0.0, 0.2 * PER_DWELL]).ravel()

    def temperature(t: np.ndarray) -> np.ndarray:
        return 25 + 8 * np.sin(2 * np.pi * t / 150)

    return ideal[order][:, :columns], Conditions(
        time_s=time,
        angle_rad=angles[order],
        order=order.astype(float),
        approach=rng.choice([-1.0, 1.0], dwells)[order],
        previous_angle_rad=np.roll(angles, 1)[order],
        time_in_dwell_s=np.tile(np.arange(PER_DWELL) * 0.2, dwells),
        temperature_c=temperature(time),
        supply_v=5 + 0.05 * np.sin(time / 40),
        temperature_history=(history, temperature(history)),
        load_history=(ends, np.repeat(ideal, 2, axis=0)),
        variance_mg2=rng.uniform(10, 500, (dwells, 3))[order],
        temperatures_c=temperature(time)[:, None] + [0.0, 1.0, -2.0],
        force_g=ideal[order] / 1000,
        rate_dps=rate,
        abs_rate_dps=np.abs(rate),
    )


def by_dwell(rows: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, PER_DWELL, *rows.shape[1:]).mean(axis=1)


def readings_of(conditions: Conditions) -> Conditions:
    """The conditions of the readings: means over each dwell, as a session's readings have them."""
    means = {
        field.name: by_dwell(getattr(conditions, field.name))
        for field in dataclasses.fields(conditions)
        if not field.name.endswith("_history") and getattr(conditions, field.name) is not None
    }
    return Conditions(
        **means,
        temperature_history=conditions.temperature_history,
        load_history=conditions.load_history,
    )


def value_of(one: Effect, values: np.ndarray, ideal: np.ndarray, conditions: Conditions) -> np.ndarray:
    if one.enters is Enters.ATTITUDE:
        return one.attitude_rad(values, conditions)
    return one.reading(values, ideal, conditions)


SMOOTH = [name for name in NAMES if BUILT_IN[name].enters is not Enters.SAMPLES]


def test_every_name_of_the_formats_is_there_and_nothing_else():
    assert sorted(BUILT_IN) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_effect_describes_itself(name):
    one = made(name)
    assert one.name == name
    for text in (
        one.cause,
        effects_page.paragraph(type(one), "Formula"),
        effects_page.paragraph(type(one), "Separated by"),
    ):
        assert text
        assert "\n" not in text
    assert one.cause.endswith(".")
    assert type(one).__doc__
    assert set(one.needs) <= {field.name for field in dataclasses.fields(Conditions)}


@pytest.mark.parametrize("name", NAMES)
def test_parameters_have_units_bounds_around_their_typical_size_and_distinct_names(name):
    parameters = made(name).parameters
    assert parameters
    assert len({p.name for p in parameters}) == len(parameters)
    for p in parameters:
        assert p.unit
        assert p.low <= p.typical <= p.high
        assert p.low < p.high
        if not p.shape:
            assert p.low <= 0 <= p.high, "an amplitude can be absent"
            assert p.typical != 0


@pytest.mark.parametrize("name", NAMES)
def test_effects_are_frozen_and_equal_by_what_they_are(name):
    assert made(name) == made(name)
    assert hash(made(name)) == hash(made(name))
    with pytest.raises(dataclasses.FrozenInstanceError):
        made(name).axes = ()


@pytest.mark.parametrize("name", SMOOTH)
@pytest.mark.parametrize("columns", [2, 3])
def test_derivative_agrees_with_central_differences(name, columns):
    one = made(name, ("x", "y", "z")[:columns])
    ideal, conditions = bench(columns=columns)
    rng = np.random.default_rng(2)
    values = one.defaults() * rng.uniform(0.6, 1.7, len(one.parameters))
    exact = one.derivative(values, ideal, conditions)
    numeric = Effect.derivative(one, values, ideal, conditions)
    rows = (len(conditions),) if one.enters is Enters.ATTITUDE else ideal.shape
    assert exact.shape == (*rows, len(one.parameters))
    assert type(one).derivative is not Effect.derivative, "the derivative is analytic"
    for k in range(len(one.parameters)):
        size = np.abs(exact[..., k]).max()
        np.testing.assert_allclose(exact[..., k], numeric[..., k], atol=2e-6 * size, rtol=0)
        assert size > 0 or (name == "axis_tilt" and columns == 2)


@pytest.mark.parametrize("name", SMOOTH)
def test_effect_with_zero_amplitudes_adds_nothing(name):
    one = made(name)
    ideal, conditions = bench()
    values = np.array([p.typical if p.shape else 0.0 for p in one.parameters])
    assert not value_of(one, values, ideal, conditions).any()


@pytest.mark.parametrize("name", SMOOTH)
def test_effect_at_its_typical_size_adds_something_on_every_one_of_its_axes(name):
    one = made(name)
    ideal, conditions = bench()
    added = value_of(one, one.defaults(), ideal, conditions)
    assert np.isfinite(added).all()
    assert (np.abs(added).max(axis=0) > 0).all()


@pytest.mark.parametrize("name", [n for n in SMOOTH if BUILT_IN[n].by_axis])
def test_effect_of_one_axis_leaves_the_others_alone(name):
    one = made(name, ("y",))
    ideal, conditions = bench()
    added = one.reading(one.defaults(), ideal, conditions)
    assert np.abs(added[:, 1]).max() > 0
    assert not added[:, [0, 2]].any()


@pytest.mark.parametrize("name", [n for n in SMOOTH if not BUILT_IN[n].within_dwell])
def test_mean_of_the_samples_is_the_reading_for_slow_covariates(name):
    one = made(name)
    ideal, conditions = bench()
    values = one.defaults()
    of_samples = by_dwell(value_of(one, values, ideal, conditions))
    of_readings = value_of(one, values, by_dwell(ideal), readings_of(conditions))
    # What is left is the curvature of the covariate within a dwell of 10 s against its range.
    np.testing.assert_allclose(of_readings, of_samples, rtol=0, atol=0.02 * np.abs(of_samples).max())


def test_settling_is_no_slow_covariate_and_says_so():
    one = made("settling", ("x",))
    ideal, conditions = bench()
    of_samples = by_dwell(one.reading(one.defaults(), ideal, conditions))[:, 0]
    of_readings = one.reading(one.defaults(), by_dwell(ideal), readings_of(conditions))[:, 0]
    assert one.within_dwell
    assert of_samples.max() > 3 * of_readings.max()


@pytest.mark.parametrize("name", SMOOTH)
def test_rows_are_independent_of_each_other_to_the_last_bit(name):
    one = made(name)
    ideal, conditions = bench()
    chosen = np.arange(len(conditions))[::7]
    whole = value_of(one, one.defaults(), ideal, conditions)
    part = value_of(one, one.defaults(), ideal[chosen], conditions.rows(chosen))
    np.testing.assert_array_equal(part, whole[chosen])


@pytest.mark.parametrize("name", [n for n in SMOOTH if BUILT_IN[n].needs])
def test_missing_covariate_is_named_in_the_error(name):
    one = made(name)
    ideal, conditions = bench()
    for need in one.needs:
        poorer = dataclasses.replace(conditions, **{need: None})
        assert poorer.lacks(one.needs) == (need,)
        with pytest.raises(UsageError, match=need):
            value_of(one, one.defaults(), ideal, poorer)


@pytest.mark.parametrize("name", [n for n in SMOOTH if not BUILT_IN[n].needs])
def test_effect_without_needs_runs_on_time_alone(name):
    one = made(name)
    ideal, conditions = bench()
    assert value_of(one, one.defaults(), ideal, Conditions(conditions.time_s)).any()


@pytest.mark.parametrize("name", [n for n in NAMES if BUILT_IN[n].by_axis])
def test_z_without_a_column_is_refused(name):
    one = made(name)
    ideal, conditions = bench(columns=2)
    rng = (np.random.default_rng(0),) if one.enters is Enters.SAMPLES else ()
    run = one.samples_mg if rng else one.reading
    with pytest.raises(UsageError, match="z was not recorded"):
        run(one.defaults(), ideal, conditions, *rng)


@pytest.mark.parametrize("axes", [("x", "x"), ("w",), ()])
def test_impossible_axes_are_refused(axes):
    with pytest.raises(UsageError, match="bias"):
        BUILT_IN["bias"](axes)


def test_stage_effect_takes_no_axes():
    assert effect("backlash", ("x",)).axes == ()
    with pytest.raises(UsageError, match="backlash"):
        BUILT_IN["backlash"](("x",))


def test_conditions_of_different_lengths_are_refused():
    with pytest.raises(UsageError, match="supply_v has 2 rows"):
        Conditions(time_s=np.zeros(3), supply_v=np.zeros(2))


def test_parameter_outside_its_bounds_is_refused():
    bounded = Parameter("k", "mg", -1, 1, 0.5)
    assert bounded.check(1.0) == 1.0
    for value in (1.001, -2.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match=r"-1 to 1 mg"):
            bounded.check(value)


def test_page_of_the_effects_is_up_to_date():
    text = effects_page.render()
    assert effects_page.PAGE.read_text(encoding="utf-8") == text, "run python scripts/effects_page.py"
    for name in NAMES:
        assert f"### `{name}`" in text
