"""A bias is judged where the session knows it, and stated in the unit of the readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import effect
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.findings import differs_from_zero, finding_of, zeros_of
from adis_gonio.tracing.trace import ZERO_OF_COUNTS, trace
from calibrate.sessions import planar_session
from tracing.small_problems import U, chosen, noisy, turn

BIAS_MG = (8.0, -8.0)


def traded():
    """A bias of 8 mg beside a warm-up of a time constant far beyond the session: only their sum shows."""
    rng = np.random.default_rng(7)
    data = noisy(replace(turn(), angle_rad=rng.permutation(turn().angle_rad)), 7)
    data = replace(data, mean=data.mean + np.array(BIAS_MG))
    tau_s = 50 * float(np.ptp(data.conditions.time_s))
    bias = NamedTerm("bias[xy]", (), 1.0, effect("bias"))
    warm_up = effect("warm_up")
    at_grid = ((len(warm_up.parameters) - 1, min(tau_s, 36000.0)),)
    terms = [bias, NamedTerm("warm_up[xy]", warm_up.covariates, 1.0, warm_up, at_grid)]
    return chosen(data, terms, ((0, 1), 1.0))


def test_a_bias_that_trades_with_a_warm_up_is_told_from_zero_by_its_value_in_the_middle():
    found = finding_of(traded(), "bias")
    assert differs_from_zero(found)
    for name, truth in zip(("bias_x", "bias_y"), BIAS_MG, strict=True):
        value = found.parameters[name]
        assert value.value == pytest.approx(truth, abs=4 * value.u)
        assert value.u < 3 * U  # of 24 readings, of which each has u = U


@pytest.fixture(scope="module")
def warming():
    """A bias of (12, −7) mg with a warm-up of 3 and −2 mg whose time constant is as long as the session."""
    session = planar_session(np.random.default_rng(2))
    size, tau_s = np.array([3.0, -2.0]), 110.0
    dwells = [
        replace(dwell, accel=dwell.accel + np.exp(-dwell.time_s[:, None] / tau_s) * size)
        for dwell in session.dwells
    ]
    return trace(replace(session, dwells=tuple(dwells))), np.array([12.0, -7.0]) + size * np.exp(-0.5)


def test_a_bias_that_drifts_is_stated_at_the_middle_as_in_the_calibration(warming):
    result, truth = warming
    (bias,) = (one for one in result.found if one.effect == "bias")
    calibration = result.calibration()
    for name, true in zip(("bias_x", "bias_y"), truth, strict=True):
        assert bias.parameters[name].value == pytest.approx(calibration[name].value, abs=1e-6)
        assert bias.parameters[name].value == pytest.approx(true, abs=bias.parameters[name].U)


def test_a_bias_at_the_middle_has_the_uncertainty_of_all_courses_of_time():
    """A warm-up as a rival puts another value there, although a line alone determines it well."""
    data = traded().data
    minutes = data.conditions.time_s / 60
    data = replace(data, mean=data.mean + 40 * U * (minutes / minutes.max())[:, None])
    terms = [
        NamedTerm("bias[xy]", (), 1.0, effect("bias")),
        NamedTerm("bias_drift[xy]", ("time",), 1.0, effect("bias_drift")),
        NamedTerm("warm_up[xy]", ("time",), 1.0, effect("warm_up"), ((2, 300.0),)),
    ]
    alone = finding_of(chosen(data, terms[:2], ((0, 1), 1.0)), "bias").parameters["bias_x"]
    both = finding_of(chosen(data, terms, ((0, 1), 0.6), ((0, 2), 0.4)), "bias").parameters["bias_x"]
    assert both.value == pytest.approx(alone.value)
    assert both.u > 1.2 * alone.u


def test_the_zero_of_counts_is_stated_as_the_bias_that_a_fit_finds():
    """Readings are 2.5 counts per mg from 300 counts, the bias 12 and −7 mg."""
    session = planar_session(np.random.default_rng(3), unit="counts")
    result = adis_gonio.trace(session)
    fitted = adis_gonio.fit(session, method="ml").parameters
    assert "bias" not in {finding.effect for finding in result.found}
    for name, truth in (("bias_x", 330.0), ("bias_y", 282.5)):
        value = result.base[name]
        assert value.unit == "counts"
        assert value.value == pytest.approx(truth, abs=4 * value.u)
        assert (value.value, value.u) == pytest.approx((fitted[name].value, fitted[name].u), rel=1e-4)
    assert result.detectable["bias"] == ZERO_OF_COUNTS


@pytest.mark.parametrize("axes", ["", "x", "y", "xy"])
def test_every_axis_in_counts_has_a_zero_with_u_whichever_biases_the_model_has(axes):
    """The rough zero of an axis without a bias is no result: it is fitted, and has an uncertainty."""
    data = readings_of(planar_session(np.random.default_rng(3), unit="counts"))
    terms = [NamedTerm(f"bias[{axes}]", (), 1.0, effect("bias", tuple(axes)))] if axes else []
    selection = chosen(data, terms, (tuple(range(len(terms))), 1.0))
    zeros = zeros_of(selection)
    assert list(zeros) == ["bias_x", "bias_y"]
    for name, truth in (("bias_x", 330.0), ("bias_y", 282.5)):
        assert zeros[name].u
        assert zeros[name].value == pytest.approx(truth, abs=4 * zeros[name].u)


def test_a_bias_in_mg_stays_out_of_the_base_parameters():
    result = adis_gonio.trace(planar_session(np.random.default_rng(3), bias=(0.0, 0.0)))
    assert not any(name.startswith("bias") for name in result.base)
    assert result.detectable["bias"].amplitude is not None


def twin(seed: int) -> Session:
    """24 poses that show z from below only once, with the noise understated by a factor of five.

    The twin of a recording by hand in whose folds without that face the search dropped the bias.
    """
    rng = np.random.default_rng((seed, 1))
    turn = np.arange(18) * 2 * np.pi / 22 + 0.1
    cone = np.stack([np.cos(turn), np.sin(turn), np.full(18, 0.5)], axis=1)
    poses = np.concatenate([np.eye(3), -np.eye(3), cone]) + rng.normal(0, 0.03, (24, 3))
    poses /= np.linalg.norm(poses, axis=1, keepdims=True)
    rng.shuffle(poses)
    matrix = np.eye(3) + np.tril(rng.normal(0, 0.004, (3, 3)))
    bias = np.array([4.0, 4.0, 25.0]) * rng.choice([-1, 1], 3) * rng.uniform(0.7, 1.3, 3)
    means = 1000 * poses @ matrix.T + bias + rng.normal(0, 0.6, (24, 3))
    dwells = [
        Dwell(k, 90.0 * k + 0.1 * np.arange(200), mean + rng.normal(0, 1.5, (200, 3)))
        for k, mean in enumerate(means)
    ]
    return Session(tuple(dwells), accel_unit="mg", plane=None, sensor="generic")


def test_a_fold_without_a_face_keeps_the_bias_as_every_part_has_one():
    result = adis_gonio.trace(twin(0))
    assert any(one.effect == "bias" and "z" in one.axes for one in result.found)
    anew, with_effects = result.after.heldout_rms, result.after.heldout_kept
    assert anew <= 1.5 * (with_effects or anew)
    assert anew < 0.3 * result.before.heldout_rms


def test_the_zero_of_counts_is_a_base_parameter_and_no_finding() -> None:
    # An effect on the readings lets the search take a bias beside it, at the rough zero of the first step.
    session = planar_session(np.random.default_rng(3), unit="counts")
    dwells = [
        replace(dwell, accel=dwell.accel + 40.0 * np.sin(0.8 * k)) for k, dwell in enumerate(session.dwells)
    ]
    result = trace(replace(session, dwells=tuple(dwells)))
    assert "bias" not in {finding.effect for finding in result.found}
    assert {"bias_x", "bias_y"} <= set(result.base)
    assert result.detectable["bias"] == ZERO_OF_COUNTS
