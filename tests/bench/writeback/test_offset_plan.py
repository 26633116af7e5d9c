"""The plan of a write-back: numbers, words, limits of the registers, and doubts about the fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.base.errors import SessionError
from adis_gonio.base.uncertainty import Value
from adis_gonio.bench.writeback.offset_plan import plan_gyro_offsets, plan_offsets, recorded_offsets
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.model.records import Session

LSB_MG, LSB_DPS = 0.4672, 0.018315
ACCEL, GYRO = ([f"{axis}{kind}_OFF" for axis in "XYZ"] for kind in ("ACCL", "GYRO"))


def recorded(accel=(20, 0, 0), gyro=(0, 0, 0), **facts) -> Session:
    """Return a session that was recorded with these numbers in the offset registers."""
    held = dict(zip((*ACCEL, *GYRO), (*accel, *gyro), strict=True))
    return Session(
        (), sensor="adis16354", source="a.session", facts={"registers": {"configured": held}, **facts}
    )


def fitted(u: float | None = 0.1, extra_mg: float = 0.0, **biases: float) -> FitResult:
    """Return a fit with these biases in mg, each with the standard uncertainty u."""
    values = {name: Value(bias, u, "mg") for name, bias in biases.items()}
    return FitResult(
        method="ml", parameters=values, covariance=None, chi2=30.0, dof=4, residual_mg=np.zeros((1, 2)),
        positions=(0,), extra_mg=extra_mg,
    )  # fmt: skip


class Gyro(dict):
    """Zero rates by name, as a calibration has them."""

    method = "turns"

    @classmethod
    def of(cls, *rates_dps: float) -> Gyro:
        names = (f"gyro_bias_{axis}" for axis in "xyz")
        return cls({name: Value(rate, 0.001, "dps") for name, rate in zip(names, rates_dps, strict=True)})


def test_the_new_number_cancels_the_bias_that_the_recorded_number_left():
    now = {"XACCL_OFF": 5, "YACCL_OFF": 0}
    plan = plan_offsets(recorded(), fitted(bias_x=10.1, bias_y=-4.0), now)
    assert (plan.new, plan.now, plan.changes) == ({"XACCL_OFF": -2, "YACCL_OFF": 9}, now, True)
    x, y = plan.axes
    assert (x.axis, x.register, x.unit, x.clipped, y.axis) == ("x", "XACCL_OFF", "mg", False, "y")
    assert x.bias_now == pytest.approx(10.1 - 15 * LSB_MG)
    assert x.effect == pytest.approx(-7 * LSB_MG)
    assert x.bias_after == pytest.approx(10.1 - 22 * LSB_MG)
    document = x.as_dict()
    assert (document["now_word"], document["new_word"]) == (0x005, 0xFFE)
    assert document["bias_after_mg"] == x.bias_after
    after = plan.carried_out
    assert (after.now, after.changes) == (plan.new, False)
    assert after.axes[0].bias_now == pytest.approx(x.bias_after)


@pytest.mark.parametrize(("bias_mg", "new"), [(5000.0, -2048), (-5000.0, 2047)])
def test_a_number_beyond_the_register_of_twelve_bits_is_clipped(bias_mg, new):
    (axis,) = plan_offsets(recorded(), fitted(bias_x=bias_mg), {"XACCL_OFF": 20}).axes
    assert (axis.new, axis.clipped) == (new, True)
    assert axis.bias_after == pytest.approx(bias_mg + (new - 20) * LSB_MG)


@pytest.mark.parametrize(
    ("fit", "facts", "doubt"),
    [
        (fitted(bias_x=10.0), {}, None),
        (fitted(bias_x=10.0, extra_mg=0.5), {}, "the model lacks 0.5 mg a reading"),
        (fitted(None, bias_x=10.0), {}, "nothing states the uncertainty of bias_x"),
        (fitted(10.1, bias_x=10.0), {}, "even its sign is open"),
        (fitted(10.1, bias_x=-10.0), {}, "even its sign is open"),
        (fitted(9.9, bias_x=-10.0), {}, None),
        (fitted(10.1, bias_x=0.2), {}, None),  # half an LSB: the register does not change
        (fitted(bias_x=10.0), {"doubts": [{"kind": "registers", "message": "changed"}]}, "changed"),
        (
            fitted(bias_x=10.0),
            {"advised": [{"summary": {"tested": True, "adequate": True}},
                         {"summary": {"tested": True, "adequate": False}}]},
            "found the model not adequate",
        ),
        (
            fitted(bias_x=10.0),
            {"advised": [{"summary": {"tested": True, "adequate": False}},
                         {"summary": {"tested": True, "adequate": True}}]},
            None,
        ),
        (fitted(bias_x=10.0), {"advised": [{"summary": {"tested": False, "adequate": False}}]}, None),
        (fitted(bias_x=10.0), {"advised": [{}]}, None),
    ],
)  # fmt: skip
def test_a_fit_that_need_not_be_right_is_doubted(fit, facts, doubt):
    doubts = plan_offsets(recorded(**facts), fit, {"XACCL_OFF": 20}).doubts
    assert len(doubts) == (doubt is not None)
    assert all(doubt in text for text in doubts)


def test_a_session_without_bias_or_without_the_registers_of_a_chip_has_no_plan():
    with pytest.raises(SessionError, match="gives no bias"):
        plan_offsets(recorded(), fitted(delta_k=0.01), {})
    session = recorded()
    assert recorded_offsets(session) == {"XACCL_OFF": 20, "YACCL_OFF": 0, "ZACCL_OFF": 0}
    few = {"registers": {"configured": {"XACCL_OFF": 20}}}
    for other in (
        replace(session, sensor="generic"),
        replace(session, facts={}),
        replace(session, facts=few),
    ):
        with pytest.raises(SessionError, match="offset registers"):
            recorded_offsets(other)


def test_zero_rates_are_cancelled_in_the_steps_of_the_gyros_registers():
    now = dict.fromkeys(GYRO, 0)
    plan = plan_gyro_offsets(recorded(gyro=(100, 0, 0)), Gyro.of(1.0, -2.0, 0.0), now, ("drift",))
    assert list(plan.new.values()) == [100 - 55, 109, 0]
    x = plan.axes[0]
    assert (x.axis, x.unit, plan.method, plan.doubts) == ("x", "dps", "turns", ("drift",))
    assert x.as_dict()["bias_now_dps"] == pytest.approx(1.0 - 100 * LSB_DPS)


def test_a_zero_rate_beyond_the_register_of_a_gyro_is_an_error():
    limit = 4096.4 * LSB_DPS
    assert (
        plan_gyro_offsets(recorded(), Gyro.of(0.0, limit, 0.0), dict.fromkeys(GYRO, 0), ()).axes[1].new
        == -4096
    )
    with pytest.raises(
        SessionError, match=r"gyro_bias_y is 80 °/s, and YGYRO_OFF holds -4096 to 4095 \(-75.0 to 75.0"
    ):
        plan_gyro_offsets(recorded(), Gyro.of(0.0, 80.0, 0.0), dict.fromkeys(GYRO, 0), ())


def test_a_doubtful_zero_rate_is_named_with_its_unit():
    rates = Gyro.of(1.0, 1.0, 1.0)
    rates["gyro_bias_z"] = Value(1.0, 1.5, "dps")
    rates["gyro_bias_y"] = Value(1.0, math.nan, "dps")
    doubts = plan_gyro_offsets(recorded(), rates, dict.fromkeys(GYRO, 0), ()).doubts
    assert doubts == (
        "nothing states the uncertainty of gyro_bias_y",
        "gyro_bias_z is 1 °/s with u = 1.5 °/s: even its sign is open",
    )
