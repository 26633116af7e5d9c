"""Comparisons of a write-back: their uncertainties by the figures of the part, and their limit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adis_gonio.bench.writeback.offset_checks import Accelerometers, Agreement, Gyros, Rest, compare_effect
from adis_gonio.bench.writeback.offset_plan import AxisPlan, WritePlan
from adis_gonio.model.records import Session

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
