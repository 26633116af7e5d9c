"""The polynomial of a calibration in double precision, by the formulas of the module, and its limits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio.base.errors import FitError
from adis_gonio.handover.fixed_point import (
    ATAN,
    PARTS,
    Polynomial,
    Scaled,
    cordic_table,
    polynomial_of,
    rate_polynomial_of,
)
from handover.calibrations import CURVED, EVERY, PLANE, SPACE, calibration, of_counts
from handover.gyros import EVERY as EVERY_GYRO, FULL, with_gyros

KINDS = {
    "plane": lambda: calibration(PLANE),
    "space": lambda: calibration(SPACE, {"quadratic": (6.1, -3.4, 2.2), "supply_bias": (7.3, -5.1, 1.0)}),
    "curved": lambda: calibration(PLANE, CURVED),
    "every": lambda: calibration(PLANE, EVERY),
    "counts": of_counts,
    "sibling": lambda: calibration(PLANE, CURVED, sensor="adis16350"),
}


def terms(made: Polynomial, readings: dict[str, np.ndarray]) -> np.ndarray:
    """Return the sum (n, axes) of the products of factors: inputs, readings and their moduli."""
    factors = readings | {f"|{name}|": np.abs(value) for name, value in readings.items()}
    total = np.zeros((len(readings["t"]), made.axes))
    for one in made.monomials:
        product = np.prod([factors[name] for name in one.factors], axis=0)
        total[:, one.axis] += one.coefficient * product
    return total


def inputs(made: Polynomial, **numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Convert numbers in 1/256 of a step to factors."""
    return {
        name: (numbers[name] - made.inputs[name].zero) * made.inputs[name].step
        for name in made.inputs
        if name in numbers
    }


@pytest.mark.parametrize("kind", KINDS)
def test_the_polynomial_gives_the_gravity_of_the_calibration(kind):
    own, n = KINDS[kind](), 200
    made = polynomial_of(own)
    rng = np.random.default_rng(1)
    step_mg = {"adis16354": 0.4672, "adis16350": 2.522}.get(own.provenance.sensor)
    reading = rng.uniform(-1.4, 1.4, (n, own.axes)) * 1000 * own.per_mg
    warm, volts = rng.uniform(-20, 70, n), rng.uniform(4.8, 5.2, n)
    scan = reading * PARTS / (step_mg or 1.0)
    zero_c, lsb_c, lsb_v = (25.0, 0.1453, 1.8315e-3) if step_mg else (0.0, 1.0, 1e-3)
    given = inputs(made, t=(warm - zero_c) / lsb_c * PARTS, v=volts / lsb_v * PARTS)
    assert made.words == (step_mg is not None)

    free = (scan - np.array(made.bias)) * np.array(made.step)
    ideal = free
    for _ in range(made.passes or 1):
        ideal = free - terms(made, given | dict(zip("xyz", ideal.T, strict=False)))
    wanted = own.apply(reading, warm, supply_v=volts)
    # The zero of the supply is rounded to 1/256 of a step, 7 µV.
    assert ideal @ made.matrix.T == pytest.approx(wanted, abs=4e-8 if "v" in made.needs else 2e-9)


def test_an_effect_of_no_reading_needs_no_passes_and_names_its_inputs():
    warm = calibration(PLANE, {"bias_temperature": (0.31, -0.62)})
    assert (polynomial_of(warm).passes, polynomial_of(warm).needs) == (0, ("t",))
    assert polynomial_of(calibration(PLANE)).needs == ()
    assert polynomial_of(calibration(PLANE, EVERY)).needs == ("t", "v")


def test_gains_and_effects_that_a_firmware_cannot_correct_are_refused():
    far = {**PLANE, "delta_phi": 0.0, "scale_y": 1.0}
    assert polynomial_of(calibration({**far, "scale_x": 0.51})).matrix[0, 0] == pytest.approx(
        1 / 0.51, rel=0.01
    )
    with pytest.raises(FitError, match="gains are too far from 1"):
        polynomial_of(calibration({**far, "scale_x": 0.49}))
    # A quadratic coefficient k in mg/g² has the slope 4 k and the size 4 k at 2 g.
    assert polynomial_of(calibration(PLANE, {"quadratic": (120.0, 0.0)})).passes == 16
    with pytest.raises(FitError, match="effects are too large"):
        polynomial_of(calibration(PLANE, {"quadratic": (126.0, 0.0)}))
    # 2³¹ in 1/256 of a count are 8 388 608 counts, of which 2 g at 2.5 counts/mg take 5060.
    assert polynomial_of(of_counts(8_383_000.0)).bias[0] == pytest.approx(8_383_000 * 256)
    with pytest.raises(FitError, match="exceed the 24 bits"):
        polynomial_of(of_counts(8_384_000.0))


@pytest.mark.parametrize("values", [FULL, EVERY_GYRO])
def test_the_polynomial_of_the_gyros_gives_the_rates_of_the_calibration(values):
    own, n = with_gyros(calibration(PLANE, CURVED), values), 200
    made = rate_polynomial_of(own, own.gyro)
    rng = np.random.default_rng(2)
    rate, force = rng.uniform(-300, 300, (n, 3)), rng.uniform(-1.5, 1.5, (n, 3))
    warm, volts = rng.uniform(-20, 70, n), rng.uniform(4.8, 5.2, n)
    scan = force * 1000 / 0.4672 * PARTS
    given = inputs(made, t=(warm - 25.0) / 0.1453 * PARTS, v=volts / 1.8315e-3 * PARTS)
    given |= inputs(made, fx=scan[:, 0], fy=scan[:, 1], fz=scan[:, 2])
    free = (rate * PARTS / 0.018315 - np.array(made.bias)) * np.array(made.step) - terms(made, given)
    free /= 1 + np.outer(given["t"], made.warm)
    wanted = own.gyro.correct(rate, force, warm, supply_v=volts)
    assert free @ made.matrix.T == pytest.approx(wanted, abs=2e-6)


@pytest.mark.parametrize(("gain", "allowed"), [(0.52, True), (0.48, False), (1.95, True), (2.05, False)])
def test_gains_of_gyros_are_between_a_half_and_two(gain, allowed):
    own = with_gyros(calibration(PLANE), {**FULL, "gyro_scale_y": gain})
    if allowed:
        rate_polynomial_of(own, own.gyro)
    else:
        with pytest.raises(FitError, match="gains of the gyros"):
            rate_polynomial_of(own, own.gyro)


def test_gyros_need_accelerometers_of_known_scale_and_a_gain_that_hardly_follows_the_temperature():
    own = with_gyros(of_counts(), FULL)
    with pytest.raises(FitError, match="counts of unknown scale"):
        rate_polynomial_of(own, own.gyro)
    for ppm, allowed in ((-3900.0, True), (-3910.0, False)):  # a half at 128 °C
        own = with_gyros(calibration(PLANE), {**FULL, "gyro_scale_temperature_z": ppm})
        if allowed:
            assert rate_polynomial_of(own, own.gyro).warm[2] == pytest.approx(-0.4992)
        else:
            with pytest.raises(FitError, match="follows the temperature too much"):
                rate_polynomial_of(own, own.gyro)


@pytest.mark.parametrize("value", [1.0, -1.0, 0.75, 3.999, 1e-6, -7e-8, 123.456, 2.0**-31])
def test_a_constant_has_thirty_bits_whatever_its_size(value):
    made = Scaled.of(value)
    assert 2**29 <= abs(made.number) <= 2**30
    assert math.ldexp(made.number, -made.shift) == pytest.approx(value, rel=2.0**-30)


def test_a_constant_far_below_the_range_is_zero():
    assert Scaled.of(0.0).number == Scaled.of(1e-20).number == 0
    assert Scaled.of(1e-9, 40) == Scaled(round(1e-9 * 2**40), 40)


def test_the_arc_tangent_has_its_stated_error():
    q = np.linspace(1e-3, math.tan(math.pi / 8), 1001)
    series = q + q**3 * np.polynomial.polynomial.polyval(q**2, ATAN)
    assert np.abs(series / np.arctan(q) - 1).max() < 3.2e-9
    table = np.array(cordic_table()) / 2.0**32
    assert table == pytest.approx(np.arctan(2.0 ** -np.arange(28)) / (2 * np.pi), abs=2.0**-33)
