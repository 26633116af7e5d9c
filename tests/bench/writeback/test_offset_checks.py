"""Comparisons of a write-back: their uncertainties by the figures of the part, and their limit."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.bench.writeback.offset_checks import (
    Accelerometers,
    Agreement,
    Gyros,
    Rest,
    compare_effect,
    measure,
)
from adis_gonio.bench.writeback.offset_plan import AxisPlan, WritePlan
from adis_gonio.device.sensor import open_sensor
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.source import LEAST_SAMPLES
from adis_gonio.record.stillness import window_samples
from handover.gyros import ZERO, gyros as calibrated

SESSION = Session(())


def rest(accel_mg, rates_dps, u, temperature_c=25.0, supply_v=5.0) -> Rest:
    u = np.full(3, u)
    return Rest(
        np.array(accel_mg), u, temperature_c, supply_v, 1000, np.array(rates_dps), u / 10, np.full(3, 25.0)
    )


def plan(unit: str, lsb: float, **new: int) -> WritePlan:
    """Return a plan that moves the registers of some axes from −2 to new numbers."""
    kind = "ACCL" if unit == "mg" else "GYRO"
    axes = [
        AxisPlan(axis, f"{axis.upper()}{kind}_OFF", 1.0, 0.1, 0, -2, number, lsb, False, unit)
        for axis, number in new.items()
    ]
    return WritePlan("a.session", "adis16354", "ml", tuple(axes))


def test_the_effect_of_a_write_is_compared_axis_by_axis_with_the_drift_that_the_part_may_have():
    before = rest([1.0, 2.0, 990.0], [0.1, 0.2, 0.3], 0.1)
    after = rest([5.0, 0.0, 992.0], [0.1, 0.4, 0.1], 0.2, temperature_c=27.0, supply_v=5.1)

    found = compare_effect(Accelerometers(SESSION, None, None), plan("mg", 0.5, x=5, z=2), before, after)
    assert found.names == ("X", "Z")
    assert found.measured == pytest.approx([4.0, 2.0])
    assert found.expected == pytest.approx([3.5, 2.0])
    # Estimates for the ADIS16354: floor of the Allan deviation 0.1 mg, 0.5 mg/°C.
    assert found.u == pytest.approx(math.sqrt(0.1**2 + 0.2**2 + 2 * 0.1**2 + (2 * 0.5) ** 2))

    found = compare_effect(Gyros(SESSION), plan("dps", 0.02, y=8), before, after)
    assert (found.names, found.unit) == (("Y",), "dps")
    assert (found.measured, found.expected) == (pytest.approx([0.2]), pytest.approx([0.2]))
    # 0.015 °/s, 0.02 °/s/°C, and 0.25 °/s/V of supply.
    wander = 2 * 0.015**2 + (2 * 0.02) ** 2 + (0.1 * 0.25) ** 2
    assert found.u == pytest.approx(math.sqrt(0.01**2 + 0.02**2 + wander))


@pytest.mark.parametrize(("off", "agrees"), [(0.0, True), (-3.99, True), (4.01, False), (-4.01, False)])
def test_figures_agree_within_four_standard_uncertainties(off, agrees):
    expected, u = np.array([10.0, -5.0]), np.array([2.0, 0.5])
    found = Agreement("readings", ("X", "Y"), expected + np.array([0.0, off * 0.5]), expected, u)
    assert found.agrees == agrees
    assert found.off == pytest.approx([0.0, off])
    assert bool(found.excess) != agrees
    assert "X" not in found.excess


# -- a dwell against the session --------------------------------------------------------------------------


def part(angle_deg: float) -> np.ndarray:
    """Return the reading (2,) in mg of the sensor of the session at a stage angle."""
    psi = np.radians(20.0 - angle_deg)
    return np.array([1020.0 * np.cos(psi) + 5.0, 1000.0 * np.sin(psi + math.radians(0.3)) - 3.0])


def session(stated: bool = True) -> Session:
    """Return an exact session of the sensor at eight angles, at 25 °C."""
    warm = np.array([25.0])
    dwells = tuple(
        Dwell(k, np.array([10.0 * k]), part(angle)[None], float(angle), temperature_c=warm)
        for k, angle in enumerate(range(0, 360, 45))
    )
    sigma = 0.02 if stated else None
    return Session(dwells, accel_unit="mg", sensor="adis16354", reading_u_mg=0.1, fixture_sigma_deg=sigma)


MOVED = plan("mg", 0.5, x=5, y=-2)
"""Offsets now −2, recorded 0: both outputs are moved by −1 mg."""


@pytest.mark.parametrize(
    ("angle_deg", "off", "agrees"), [(30.0, 0.0, True), (30.0, 5.0, False), (33.0, 0.0, False)]
)
def test_a_dwell_at_a_declared_angle_has_the_readings_of_the_fit_and_of_the_offsets_now(
    angle_deg, off, agrees
):
    seen = rest([*(part(30.0) - 1.0 + [off, 0.0]), 0.0], [0.0] * 3, 0.1)
    found = Accelerometers(session(), "ml", angle_deg).expected(MOVED, seen)
    assert (found.names, found.agrees) == (("X", "Y"), agrees)
    assert found.measured == pytest.approx(seen.mean_mg[:2])
    assert found.expected == pytest.approx(part(angle_deg) - 1.0, abs=0.1)
    # The angle is set again with u = 0.02°; the bias may have drifted by the floor of 0.1 mg, twice.
    across = np.radians(0.02) * np.abs(part(angle_deg + 90.0))
    least = np.sqrt(0.1**2 + 2 * 0.1**2 + across**2)
    assert (found.u > 0.95 * least).all()
    assert (found.u < 1.5 * least).all()


def test_an_angle_without_a_stated_uncertainty_is_read_on_a_vernier_to_a_twentieth_of_a_degree():
    seen = rest([*(part(30.0) - 1.0), 0.0], [0.0] * 3, 0.1)
    found = Accelerometers(session(stated=False), "ml", 30.0).expected(MOVED, seen)
    across = np.radians(0.05) * np.abs(part(30.0 + 90.0))
    assert found.u == pytest.approx(np.sqrt(0.1**2 + 2 * 0.1**2 + across**2), rel=0.3)


def test_another_temperature_makes_the_comparison_as_uncertain_as_the_part_s_coefficient():
    us = [
        Accelerometers(session(), "ml", 30.0)
        .expected(MOVED, rest([*part(30.0), 0.0], [0.0] * 3, 0.1, temperature_c=celsius))
        .u
        for celsius in (25.0, 35.0)
    ]
    assert np.sqrt(us[1] ** 2 - us[0] ** 2) == pytest.approx([5.0, 5.0])


@pytest.mark.parametrize(("share", "agrees"), [(1.0, True), (1.02, False)])
def test_without_an_angle_the_length_of_gravity_is_compared(share, agrees):
    seen = rest([*(share * (part(77.0) - [5.0, -3.0]) + [5.0, -3.0] - 1.0), 0.0], [0.0] * 3, 0.1)
    found = Accelerometers(session(), "ml", None).expected(MOVED, seen)
    assert (found.names, found.agrees) == (("|g|",), agrees)
    assert found.measured == pytest.approx([1000.0 * share], abs=0.1)
    assert found.expected == pytest.approx([1000.0])


def test_a_part_whose_plane_lies_flat_is_not_compared():
    upright = rest([*(0.51 * part(0.0)), 800.0], [0.0] * 3, 0.1)
    assert not Accelerometers(session(), "ml", None).expected(MOVED, upright).agrees
    with pytest.raises(FitError, match="plane of rotation vertical"):
        Accelerometers(session(), "ml", None).expected(
            MOVED, rest([*(0.48 * part(0.0)), 800.0], [0.0] * 3, 0.1)
        )


def test_differences_are_named_with_their_unit_and_figures_have_two_decimals_in_mg():
    found = Agreement(
        "readings", ("X", "Y"), np.array([10.0, -5.0]), np.array([1.0, -5.0]), np.array([2.0, 0.5])
    )
    assert (
        str(found)
        == "readings: X 10.00 mg, expected 1.00 mg (u 2.0 mg); Y −5.00 mg, expected −5.00 mg (u 0.50 mg)"
    )
    found = Agreement("rates", ("Z",), np.array([0.1]), np.array([-0.4]), np.array([0.1]), "dps")
    assert found.excess == "Z +0.500 °/s (u 0.10 °/s)"
    assert str(found).startswith("rates: Z 0.100 °/s, expected −0.400 °/s")


def test_a_dwell_has_its_length_at_least_16_samples_and_a_window_of_the_stillness_watch():
    with open_sensor("sim:?seed=1") as sensor:
        now = sensor.configuration()
        least_s = LEAST_SAMPLES * now.sample_period_s
        with pytest.raises(UsageError, match=f"take {least_s:.3g} s or more"):
            measure(sensor, 0.99 * least_s, 5.0)
        short = measure(sensor, least_s, 5.0)
        assert short.samples >= max(window_samples(now), LEAST_SAMPLES)
        found = measure(sensor, 1.0, 5.0, gyros=True)
    assert found.samples == pytest.approx(819, abs=window_samples(now))
    assert np.linalg.norm(found.mean_mg) == pytest.approx(1000, abs=40)
    assert np.isnan(short.mean_dps).all()
    assert np.isfinite(found.temperatures_c).all()


# -- gyros against the session ----------------------------------------------------------------------------


def gyros(*needs: str) -> Gyros:
    """Return gyros whose calibration at 25 °C and 5 V predicts 0.1, 0.2 and 0.3 °/s (u 0.01 °/s)."""
    made = Gyros(SESSION)
    made.gyro = SimpleNamespace(
        needs=needs,
        temperature_c=SimpleNamespace(mean=25.0),
        supply_v=SimpleNamespace(mean=5.0),
        readings_of=lambda rates, force, warm, supply_v: SimpleNamespace(
            rate_dps=np.array([0.1, 0.2, 0.3]), u_dps=np.full(3, 0.01)
        ),
        force_part=lambda force_g: 0.05 * force_g,
    )
    return made


WARM = rest([0.0, 0.0, -1000.0], [0.1, 0.2, 0.3], 0.1, temperature_c=35.0, supply_v=5.1)
FLOOR, WARMER, VOLTS = math.sqrt(2) * 0.015, 10 * 0.02, 0.1 * 0.25
NULLED = {"XGYRO_OFF": -5, "YGYRO_OFF": -10, "ZGYRO_OFF": -15}


@pytest.mark.parametrize(
    ("needs", "wander"), [((), math.hypot(FLOOR, VOLTS)), (("temperature_c", "supply_v"), FLOOR)]
)
def test_a_zero_rate_wanders_by_the_supply_if_its_calibration_does_not_know_it(needs, wander):
    assert gyros(*needs).wander_since(WARM) == pytest.approx(wander)


def test_another_temperature_than_the_session_s_counts_once_in_the_u_of_a_zero_rate():
    made = Gyros(SESSION)
    made.gyro = replace(calibrated(ZERO), supply_v=None)
    mean_c = made.gyro.temperature_c.mean
    still, warm = (
        replace(WARM, temperature_c=t, temperatures_c=np.full(3, t)) for t in (mean_c, mean_c + 10)
    )
    here, there = (made.expected(plan("dps", 0.02, x=0, y=0, z=0), one) for one in (still, warm))
    assert there.expected == pytest.approx(here.expected)
    assert there.u == pytest.approx(np.hypot(here.u, WARMER))


def test_zero_rates_at_rest_are_those_of_the_session_moved_by_the_offsets_now():
    found = gyros().expected(plan("dps", 0.02, x=0, y=0, z=0), WARM)
    assert found.expected == pytest.approx([0.06, 0.16, 0.26])
    assert found.measured == pytest.approx([0.1, 0.2, 0.3])
    assert found.u == pytest.approx([math.hypot(0.01, 0.01, FLOOR, VOLTS)] * 3)


def test_an_autonull_is_compared_with_the_session_by_its_noise_and_its_step():
    found = gyros().compare_autonull(plan("dps", 0.02, x=0, y=0, z=0), WARM, NULLED, 250.0)
    assert found.agrees
    assert found.measured == pytest.approx([0.1, 0.2, 0.3])
    # The dwell has 1000 samples: the mean of 250 has twice its noise.
    step = 0.02 / math.sqrt(12)
    assert found.u == pytest.approx([math.hypot(0.02, step, 0.01, FLOOR, VOLTS)] * 3)
    assert "(+0.000, +0.000, −0.050 °/s of it by force)" in found.what
    wrong = {name: -number for name, number in NULLED.items()}
    assert (
        not gyros("temperature_c")
        .compare_autonull(plan("dps", 0.02, x=0, y=0, z=0), WARM, wrong, 250)
        .agrees
    )
