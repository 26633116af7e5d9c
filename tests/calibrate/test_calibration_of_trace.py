"""A traced calibration corrects what belongs to the sensor, and says what it leaves alone and why."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio.base.errors import FitError
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import Basis, NamedTerm, NamelessTerm
from adis_gonio.model.effects import effect
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing.findings import finding_of
from adis_gonio.tracing.trace import TraceRun
from adis_gonio.tracing.trace_result import Stopped
from adis_gonio.tracing.what_if import AskedModel
from calibrate.sessions import planar_session, plane_axes, read_mg, turn

PSI = np.linspace(-179.0, 179.0, 91)
TRUTH = {"gains": (1.01, 0.99), "axes": plane_axes(0.4), "bias": (12.0, -7.0), "k2": (9.0, -6.0)}


@pytest.fixture(scope="module")
def session():
    """A turn of a curved sensor on a stage that holds 1 arc minute."""
    return planar_session(np.random.default_rng(21), k2=TRUTH["k2"])


@pytest.fixture(scope="module")
def traced(session):
    """The model that a trace of the session ends with, without the search for it."""
    run = TraceRun(readings_of(session), 6, (), AskedModel(("bias", "quadratic"), only=True))
    result = run.traced()
    found = tuple(finding_of(run.selection, name) for name in ("bias", "quadratic"))
    return replace(result, found=found, provenance=provenance_of(session))


def error_deg(calibration, accel):
    return (np.asarray(calibration.angle(accel).angle_deg - PSI) + 180) % 360 - 180


def test_what_the_trace_found_is_corrected_at_angles_that_were_not_measured(session):
    traced = adis_gonio.trace(session)
    accel = read_mg(turn(PSI), **TRUTH)
    plain = error_deg(adis_gonio.fit(session, method="ml").calibration(), accel)
    calibration = traced.calibration()
    assert [term.effect.name for term in calibration.effects] == ["quadratic"]
    better = error_deg(calibration, accel)
    assert np.abs(plain).max() > 0.2
    assert np.abs(better).max() < 0.01
    # Its u holds its error, though the trace leaves open whether a bias or a K_pp shares in it.
    assert np.sqrt(np.mean((better / calibration.angle(accel).u_deg) ** 2)) < 2.0
    assert (calibration.angle(accel).u_deg < 0.02).all()


def with_effect(traced, kind, value):
    fit = traced.fits[-1]
    term = NamedTerm("one more", kind.covariates, 0.0, kind)
    both = fit.with_terms((*fit.terms, term), (*fit.values.terms, np.full(len(kind.parameters), value)))
    return replace(traced, fits=(*traced.fits[:-1], both))


@pytest.mark.parametrize(
    ("kind", "why"),
    [
        (effect("stage_ellipticity"), "belongs to the stage"),
        (effect("bias_drift", ["x"]), "follows the clock of the session"),
        (effect("outlier_dwell", ["x"], dwell=3), "belongs to a dwell"),
    ],
)
def test_what_belongs_to_the_bench_is_left_alone_and_named(traced, kind, why):
    calibration = with_effect(traced, kind, 0.02).calibration()
    reasons = {one.effect: one.reason for one in calibration.not_corrected}
    assert why in reasons[kind.name]
    assert [term.effect.name for term in calibration.effects] == ["quadratic"]
    accel = read_mg(turn(PSI), **TRUTH)
    own = calibration.angle(accel).angle_deg
    # The drift of 0.02 mg/min moves the bias of the session's middle by 0.02 mg, an angle by 0.001°.
    allowed = 0.002 if kind.name == "bias_drift" else 0.0
    assert np.abs(own - traced.calibration().angle(accel).angle_deg).max() <= allowed


def test_an_effect_that_may_be_the_stage_s_is_not_corrected(traced):
    calibration = replace(traced, found=(), confounded=(("quadratic", "stage_eccentricity"),)).calibration()
    assert calibration.effects == ()
    assert "quadratic" in {one.effect for one in calibration.not_corrected}
    like = replace(traced, found=(), confounded=(("quadratic", "cross_quadratic"),))
    assert [term.effect.name for term in like.calibration().effects] == ["quadratic"]


def test_an_unfinished_trace_gives_no_calibration(traced):
    stopped = Stopped(1.0, 1.2, ("everything",), checked=False)
    with pytest.raises(FitError, match="before its model was checked"):
        replace(traced, stopped=stopped).calibration()
    with pytest.raises(FitError, match="one pose"):
        replace(traced, fits=()).calibration()


def test_a_traced_calibration_survives_its_file_bit_by_bit(traced, tmp_path):
    calibration = traced.calibration()
    calibration.save(tmp_path / "c.json")
    back = adis_gonio.Calibration.load(tmp_path / "c.json")
    accel = read_mg(turn(PSI), **TRUTH)
    assert back == calibration
    assert np.array_equal(back.angle(accel).angle_deg, calibration.angle(accel).angle_deg)
    assert np.array_equal(back.angle(accel).u_deg, calibration.angle(accel).u_deg)


def test_a_nameless_function_that_is_left_out_takes_no_bias_with_it(session, traced):
    """What it carried is carried by a bias again: no worse than without a trace, and u says so."""
    fit = traced.fits[-1]
    basis = Basis(
        "max(a + 0.5 g, 0)",
        ("reading",),
        by_axis=lambda ideal, axis: np.maximum(ideal[:, [axis]] + 0.5, 0.0),
    )
    nameless = NamelessTerm("a knee", ("reading",), 1.0, "bias", (0, 1), basis)
    only = fit.with_terms([nameless], [np.array([20.0, -10.0])]).refit()
    assert not any(term.name == "bias" for term in only.terms)
    calibration = replace(traced, fits=(*traced.fits[:-1], only), found=(), confounded=()).calibration()
    assert [one.effect.startswith("unnamed") for one in calibration.not_corrected] == [True]
    accel = read_mg(turn(PSI), **TRUTH)
    plain = error_deg(adis_gonio.fit(session, method="ml").calibration(), accel)
    error = error_deg(calibration, accel)
    assert np.abs(error).max() < 1.2 * np.abs(plain).max()
    assert np.sqrt(np.mean((error / calibration.angle(accel).u_deg) ** 2)) < 5.0


@pytest.mark.parametrize(
    ("kind", "values", "at_middle"),
    [
        (effect("bias_drift", ["x", "y"]), (3.0, -1.5), lambda t: (3.0 * t / 60, -1.5 * t / 60, 0.0)),
        (effect("warm_up", ["x"]), (8.0, 40.0), lambda t: (8.0 * math.exp(-t / 40.0), 0.0, 0.0)),
        (effect("scale_drift", ["x"]), (900.0,), lambda t: (0.0, 0.0, 1e-6 * 900.0 * t / 60)),
    ],
    ids=["bias_drift", "warm_up", "scale_drift"],
)
def test_bias_and_gain_are_those_of_the_session_s_middle(session, traced, kind, values, at_middle):
    """What follows the clock stands in the sum at half the time between first and last dwell."""
    plain = traced.calibration()
    fit = traced.fits[-1]
    term = NamedTerm("one more", kind.covariates, 0.0, kind)
    both = fit.with_terms((*fit.terms, term), (*fit.values.terms, np.array(values)))
    moved = replace(traced, fits=(*traced.fits[:-1], both)).calibration()
    middle_s = float(np.mean([session.dwells[k].time_s.mean() for k in (0, -1)]))
    assert middle_s == pytest.approx(56.0, abs=0.1)
    bias_x, bias_y, gain_x = at_middle(middle_s)
    assert moved["bias_x"].value - plain["bias_x"].value == pytest.approx(bias_x, abs=1e-9)
    assert moved["bias_y"].value - plain["bias_y"].value == pytest.approx(bias_y, abs=1e-9)
    assert moved["scale_x"].value / plain["scale_x"].value == pytest.approx(1 + gain_x, abs=1e-9)
    (why,) = [one.reason for one in moved.not_corrected if one.effect == kind.name]
    assert f"{middle_s:.4g} s after" in why


def test_a_bias_that_moves_with_time_is_stated_at_the_middle_and_not_called_zero():
    """Bias of x 2 mg at the start and 25 mg at the end: the middle's within what u states."""
    session = drifting(np.random.default_rng(5), lambda minutes: 6.0 * minutes)
    traced = adis_gonio.trace(session)
    calibration = traced.calibration()
    middle_min = (session.dwells[0].time_s.mean() + session.dwells[-1].time_s.mean()) / 2 / 60
    bias_x = calibration["bias_x"]
    assert calibration.assumed == ()
    assert bias_x.u < 2.0
    assert abs(bias_x.value - 2.0 - 6.0 * middle_min) < 2 * bias_x.u


@pytest.mark.parametrize("width_s", [25.0, 50.0])
def test_a_bias_on_an_s_shaped_course_has_a_value_and_u_at_the_middle(width_s):
    """From 2 to 26 mg, half of it in 2.2 widths: many functions of time fit it, and u holds them all."""

    def course(minutes):
        return 24.0 / (1.0 + np.exp((116.0 - 60.0 * minutes) / width_s))

    calibration = adis_gonio.trace(drifting(np.random.default_rng(5), course)).calibration()
    bias_x = calibration["bias_x"]
    assert calibration.assumed == ("bias_y",)
    assert 0.02 < bias_x.u < 1.0
    assert abs(bias_x.value - 14.0) < 2.5 * bias_x.u
    # An angle that the bias moves by 0.057° for each mg has this uncertainty too.
    known = {"gains": (1.01, 0.99), "axes": plane_axes(0.4), "bias": (14.0, 0.0)}
    (moved_deg,) = calibration.angle(read_mg(turn(np.array([90.0])), **known)).u_deg
    assert moved_deg > 0.055 * bias_x.u


def drifting(rng, course):
    """A turn there and one back, on which the bias of x is a function (mg) of the time in minutes."""
    angles = (*range(0, 360, 30), *range(345, -15, -30))
    plain = planar_session(rng, bias=(2.0, 0.0), angles_deg=tuple(map(float, angles)))
    moved = [d.accel + np.outer(course(d.time_s / 60), [1.0, 0.0]) for d in plain.dwells]
    dwells = zip(plain.dwells, moved, strict=True)
    return replace(plain, dwells=tuple(replace(d, accel=accel) for d, accel in dwells))
