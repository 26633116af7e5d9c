"""A calibration gives back the gravity that the readings were made of, with an honest u."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import adis_gonio
from adis_gonio import Calibration
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.calibrate import Coefficient, EffectTerm
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.handover.register_offsets import offset_words
from adis_gonio.model.effects import effect
from adis_gonio.record.provenance import Covered, Provenance
from adis_gonio.tracing.averaging import AveragedFit
from calibrate.sessions import (
    directions,
    planar_session,
    plane_axes,
    read_mg,
    space_axes,
    spatial_session,
    turn,
)

PSI = np.linspace(-179.0, 179.0, 57)


def wrapped(angle_deg: np.ndarray) -> np.ndarray:
    return (np.asarray(angle_deg) + 180.0) % 360.0 - 180.0


def known(effects: dict[str, tuple[float, ...]] | None = None, **base: float) -> Calibration:
    """A calibration with exact parameters: no fit takes part."""
    values = {"scale_x": 1.01, "scale_y": 0.99, "delta_phi": 0.4, "bias_x": 12.0, "bias_y": -7.0} | base
    units = {"delta_phi": "deg", "bias_x": "mg", "bias_y": "mg"}
    parameters = [Coefficient(name, value, 0.0, units.get(name, "1")) for name, value in values.items()]
    terms = []
    for name, own in (effects or {}).items():
        kind = effect(name)
        names = tuple(one.name for one in kind.parameters)
        terms.append(EffectTerm(kind, names))
        parameters += [
            Coefficient(n, v, 0.0, one.unit) for n, v, one in zip(names, own, kind.parameters, strict=True)
        ]
    where = Provenance("adis16354", "xy", 9.80665, temperature_c=Covered(30.0, 29.0, 31.0))
    p = len(parameters)
    return Calibration(
        method="ml",
        provenance=where,
        parameters=tuple(parameters),
        covariance=np.zeros((p, p)),
        effects=tuple(terms),
    )


def test_gravity_comes_back_from_the_readings_of_a_skewed_sensor():
    g = turn(PSI)
    accel = read_mg(g, gains=(1.01, 0.99), axes=plane_axes(0.4), bias=(12.0, -7.0))
    assert np.abs(known().apply(accel) - g).max() < 1e-12
    assert np.abs(wrapped(known().angle(accel).angle_deg - PSI)).max() < 1e-10


def test_u_contains_the_effects_of_temperature_that_the_calibration_does_not_correct():
    readings = [700.0, -700.0]
    plain = known()
    for away_c in (0.0, 4.0, -16.0):
        u_deg = float(plain.angle(readings, 30.0 + away_c).u_deg)
        # Typical coefficients: 0.5 mg/°C and 40 ppm/°C on each axis, 0.002 °/°C of one axis to another.
        across = math.hypot(0.5, 40e-6 * 700) * away_c / 1000
        skew = math.radians(0.002) * away_c / 2
        assert u_deg == pytest.approx(math.degrees(math.hypot(across, skew, skew)), rel=0.05)
    corrected = known({"bias_temperature": (0.5, 0.5), "scale_temperature": (0.0, 0.0)})
    assert float(corrected.angle(readings, 14.0).u_deg) < 0.1 * float(plain.angle(readings, 14.0).u_deg)
    # Only the misalignments of the accelerometers remain: no effect of the gyros, in °/s, takes part.
    left = float(corrected.angle(readings, 14.0).u_deg)
    assert left == pytest.approx(math.hypot(*[0.002 * 16 / 2] * 2), rel=0.02)
    assert float(plain.angle(readings).u_deg) == 0.0, "the temperature of the session stands in"


def test_u_in_every_plane_contains_the_misalignments_by_temperature():
    """The typical misalignment is 0.002 °/°C of one axis to another, in each of the three planes."""
    units = {"scale": "1", "skew": "deg"}
    names = ("scale_x", "scale_y", "scale_z", "skew_xy", "skew_xz", "skew_yz")
    parameters = [Coefficient(n, float("scale" in n), 0.0, units[n[:-2].rstrip("_xyz")]) for n in names]
    effects = [effect(name, "xyz") for name in ("bias_temperature", "scale_temperature")]
    parameters += [Coefficient(p.name, 0.0, 0.0, p.unit) for one in effects for p in one.parameters]
    space = Calibration(
        method="ml",
        provenance=Provenance("adis16354", "none", 9.80665, temperature_c=Covered(30.0, 29.0, 31.0)),
        parameters=tuple(parameters),
        covariance=np.zeros((len(parameters),) * 2),
        effects=tuple(EffectTerm(one, tuple(p.name for p in one.parameters)) for one in effects),
    )
    for k, plane in enumerate(("xy", "xz", "yz")):
        reading = np.array([[700.0, 700.0, 0.0], [700.0, 0.0, 700.0], [0.0, 700.0, 700.0]])[k]
        u_deg = float(space.angle(reading, 20.0, plane=plane).u_deg)
        assert u_deg == pytest.approx(math.hypot(*[0.002 * 10 / 2] * 2), rel=0.02)


def test_effects_of_reading_and_temperature_are_corrected_at_the_temperature_given():
    g = turn(PSI)
    truth = {"k2": (8.0, -5.0), "tempco": (0.6, -0.4), "scale_tempco": (300.0, -200.0)}
    accel = read_mg(
        g, gains=(1.01, 0.99), axes=plane_axes(0.4), bias=(12.0, -7.0), temperature_c=41.0, **truth
    )
    calibration = known(
        {
            "quadratic": truth["k2"],
            "bias_temperature": truth["tempco"],
            "scale_temperature": (300.0, -200.0),
        }
    )
    assert np.abs(calibration.apply(accel, 41.0) - g).max() < 1e-11
    assert np.abs(calibration.apply(accel, np.full(len(g), 41.0)) - g).max() < 1e-11
    # Without a temperature that of the session stands in.
    assert np.array_equal(calibration.apply(accel), calibration.apply(accel, 30.0))
    assert np.abs(calibration.apply(accel) - g).max() > 1e-3


def test_a_fitted_calibration_finds_the_angles_of_new_readings_within_its_u():
    rng = np.random.default_rng(11)
    pulls = []
    for _ in range(12):
        calibration = adis_gonio.fit(planar_session(rng), method="ml").calibration()
        clean = read_mg(turn(PSI), gains=(1.01, 0.99), axes=plane_axes(0.4), bias=(12.0, -7.0))
        shown = calibration.angle(clean)
        pulls.append(wrapped(shown.angle_deg - PSI) / shown.u_deg)
    rms = float(np.sqrt(np.mean(np.square(pulls))))
    assert 0.6 < rms < 1.5


def test_u_is_that_of_a_monte_carlo_through_a_solver_of_its_own():
    """GUM Supplement 1: parameters drawn from the covariance, angles by plain trigonometry."""
    rng = np.random.default_rng(5)
    result = adis_gonio.fit(planar_session(rng, noise_mg=2.0), method="ml")
    calibration = result.calibration()
    names = [one.name for one in calibration.parameters]
    draws = rng.multivariate_normal(calibration.values, calibration.covariance, size=40_000)
    at = {name: draws[:, k] for k, name in enumerate(names)}
    noise = (1.5, 0.5)
    accel = np.array([[640.0, 750.0], [-20.0, -990.0], [980.0, 100.0]])
    shown = calibration.angle(accel, reading_u=noise)
    for k, (x, y) in enumerate(accel):
        u_x = (x + noise[0] * rng.standard_normal(len(draws)) - at["bias_x"]) / at["scale_x"]
        u_y = (y + noise[1] * rng.standard_normal(len(draws)) - at["bias_y"]) / at["scale_y"]
        phi = np.radians(at["delta_phi"])
        psi = np.degrees(np.arctan2(u_y - u_x * np.sin(phi), u_x * np.cos(phi)))
        assert shown.u_deg[k] == pytest.approx(psi.std(), rel=0.02)
        assert shown.angle_deg[k] == pytest.approx(psi.mean(), abs=0.03 * psi.std())


def test_readings_without_noise_have_the_u_of_the_parameters():
    calibration = adis_gonio.fit(planar_session(np.random.default_rng(1), noise_mg=2.0)).calibration()
    accel = np.array([[640.0, 750.0], [-20.0, -990.0]])
    quiet, plain = calibration.angle(accel, reading_u=0.0).u_deg, calibration.angle(accel).u_deg
    assert quiet == pytest.approx(plain)
    # At 90° a reading of X turns the angle, and a reading of Y does not.
    by_axis = [calibration.angle([0.0, 1000.0], reading_u=u).u_deg for u in ((1.0, 0.0), (0.0, 1.0))]
    still = calibration.angle([0.0, 1000.0]).u_deg
    assert np.sqrt(by_axis[0] ** 2 - still**2) == pytest.approx(math.degrees(1e-3), rel=0.05)  # gains
    assert by_axis[1] == pytest.approx(still, rel=0.2)  # biases


def test_angles_of_the_stage_are_the_declared_ones():
    session = planar_session(np.random.default_rng(2))
    calibration = adis_gonio.fit(session, method="ml").calibration()
    means = np.array([dwell.accel.mean(axis=0) for dwell in session.dwells])
    declared = np.array([dwell.angle_deg for dwell in session.dwells])
    shown = calibration.stage_angle(means)
    assert np.abs(wrapped(shown.angle_deg - declared)).max() < 0.01
    assert (shown.u_deg < 0.01).all()


def test_an_angle_without_a_temperature_names_the_temperature_that_it_assumes():
    calibration = known()  # 29 to 31 °C, without a temperature coefficient
    assumed, warm = (calibration.angle([1000.0, 2.0], at) for at in (None, 41.0))
    assert assumed.assumed_c == 30.0
    assert "at 30.0 °C, give temperature_c" in repr(assumed)
    assert warm.assumed_c is None
    assert "°C" not in repr(warm)
    assert warm.u_deg > assumed.u_deg


@pytest.mark.parametrize("stage", [True, False])
def test_the_error_without_a_calibration_is_the_error_of_the_arctangent_of_the_readings(stage):
    calibration = known(alpha=30.0)
    before, after = calibration.error_curves(stage=stage)
    assert not after.error_deg.any()
    assert (before.angle_deg == after.angle_deg).all()
    # The stage turns against gravity: at its angle θ gravity is at 30° − θ.
    sign, zero = (-1, 30.0) if stage else (1, 0.0)
    psi = sign * (before.angle_deg - zero)
    accel = read_mg(turn(psi), gains=(1.01, 0.99), axes=plane_axes(0.4), bias=(12.0, -7.0))
    plain = wrapped(sign * (np.degrees(np.arctan2(accel[:, 1], accel[:, 0])) - psi))
    assert np.abs(plain).max() > 1
    assert before.error_deg == pytest.approx(plain, abs=1e-9)


def test_space_gives_gravity_back_and_an_angle_in_a_named_plane():
    rng = np.random.default_rng(3)
    gains, skews, bias = (1.02, 0.98, 1.01), (0.5, -0.3, 0.2), (20.0, -30.0, 5.0)
    session = spatial_session(rng, gains=gains, skews_deg=skews, bias=bias)
    calibration = adis_gonio.fit(session).calibration()
    g = directions(rng, 50)
    accel = read_mg(g, gains=gains, axes=space_axes(*skews), bias=bias)
    assert np.abs(calibration.apply(accel) - g).max() < 5e-4
    with pytest.raises(UsageError, match=r"plane is None: .* in plane xy, xz, yz"):
        calibration.angle(accel)
    for plane, (i, j) in {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}.items():
        steep = np.hypot(g[:, i], g[:, j]) > 0.5
        shown = calibration.angle(accel[steep], plane=plane)
        truth = np.degrees(np.arctan2(g[steep, j], g[steep, i]))
        assert np.abs(wrapped(shown.angle_deg - truth)).max() < 0.06
        assert np.isfinite(shown.u_deg).all()


def test_counts_of_unknown_scale_and_zero_give_the_same_angles():
    calibration = adis_gonio.fit(
        planar_session(np.random.default_rng(4), unit="counts"), method="ml"
    ).calibration()
    assert calibration.unit == "counts"
    accel = read_mg(turn(PSI), gains=(1.01, 0.99), axes=plane_axes(0.4), bias=(12.0, -7.0)) * 2.5 + 300.0
    assert np.abs(wrapped(calibration.angle(accel).angle_deg - PSI)).max() < 0.02


@pytest.mark.parametrize("method", ["paper", "two-position"])
def test_two_positions_say_which_bias_was_assumed_and_give_angles_by_the_ratio(method):
    session = planar_session(
        np.random.default_rng(6), alpha_deg=0.0, delta_phi_deg=0.05, bias=(0.0, 0.0), angles_deg=(0, 90)
    )
    result = adis_gonio.fit(session, method=method)
    calibration = result.calibration()
    assert {"bias_x", "bias_y"} <= set(calibration.assumed)
    assert calibration.delta_k.dof == result["delta_k"].dof < math.inf
    assert method != "paper" or calibration["scale_x"].dof == result["delta_k"].dof
    accel = read_mg(turn(PSI), gains=(1.01, 0.99), axes=plane_axes(0.05), bias=(0.0, 0.0))
    assert np.abs(wrapped(calibration.angle(accel).angle_deg - PSI)).max() < 0.05


@pytest.mark.parametrize("method", ["paper", "two-position", "trace"])
def test_u_of_an_angle_from_two_positions_covers_the_biases_that_they_do_not_show(method):
    rng = np.random.default_rng(7)
    parts = []
    for _ in range(40):
        bias = tuple(10.0 * rng.standard_normal(2))  # initial bias of the ADIS16354, 1 sigma (D)
        session = planar_session(rng, alpha_deg=5.0, delta_phi_deg=0.05, bias=bias, angles_deg=(0, 90))
        part = replace(session, sensor="adis16354")
        result = adis_gonio.trace(part) if method == "trace" else adis_gonio.fit(part, method=method)
        accel = read_mg(turn(PSI), gains=(1.01, 0.99), axes=plane_axes(0.05), bias=bias)
        calibration = result.calibration()
        assert {"bias_x", "bias_y"} <= set(calibration.assumed)
        shown = calibration.angle(accel)
        parts.append(wrapped(shown.angle_deg - PSI) / shown.u_deg)
    rms = np.sqrt(np.mean(np.square(parts), axis=0))
    # 80 draws: a standard deviation is known to 11 % at best.
    assert np.all((rms > 0.6) & (rms < 1.5))


def test_u_of_a_bias_that_drifts_unnamed_contains_the_drift_and_the_unseen_bias():
    """The average of unnamed functions of time leaves the bias at the middle of two positions uncertain."""
    whole = planar_session(np.random.default_rng(1), noise_mg=2.0, samples=60, angles_deg=(0, 90) * 10)
    moved = [
        replace(one, accel=one.accel + np.array([math.sin(0.45 * k), math.cos(0.35 * k)]) * 8)
        for k, one in enumerate(whole.dwells)
    ]
    result = adis_gonio.trace(replace(whole, dwells=tuple(moved), sensor="adis16354"))
    (final,) = result.fits[-1:]
    assert isinstance(final, AveragedFit)
    drift = np.sqrt(np.diag(final.joint_covariance)[-2:])
    assert drift.min() > 1.0
    calibration = result.calibration()
    for name, own in zip(("bias_x", "bias_y"), drift, strict=True):
        # The initial bias of the ADIS16354 is 10 mg (D).
        assert calibration[name].u == pytest.approx(math.hypot(own, 10.0), rel=0.01)


def test_offsets_for_the_registers_are_refused_if_the_biases_were_taken_as_zero():
    session = replace(planar_session(np.random.default_rng(7), angles_deg=(0, 90)), sensor="adis16354")
    with pytest.raises(FitError, match="does not determine bias_x"):
        offset_words(adis_gonio.fit(session, method="two-position").calibration())


def test_one_reading_gives_one_angle_and_z_of_a_planar_part_takes_no_part():
    one = known().angle([700.0, 710.0])
    assert one.angle_deg.shape == ()
    assert float(known().angle([700.0, 710.0, 55.0]).angle_deg) == float(one.angle_deg)
    assert known().apply([700.0, 710.0]).shape == (2,)
    assert known().apply(np.zeros((0, 2))).shape == (0, 2)


def test_without_a_known_noise_u_is_not_a_number_and_never_a_small_one():
    bare = replace(known(), covariance=None)
    assert np.isnan(bare.angle([[700.0, 710.0]]).u_deg).all()
    assert np.isnan(bare.angle([[700.0, 710.0]], reading_u=1.0).u_deg).all()
    assert "u unknown" in repr(bare.angle([700.0, 710.0]))


@pytest.mark.parametrize(
    ("accel", "says"),
    [
        (np.zeros((3, 4)), r"shape \(3, 4\)"),
        (1000.0, r"shape \(\)"),
        (np.zeros((2, 2, 2)), "shape"),
        ([[1000.0, np.nan]], "reading 0 holds NaN"),
        ([[1000.0, 0.0], [np.inf, 0.0]], "reading 1 holds NaN or infinity"),
        ([[1.0, 0.05]], "give mg"),  # g
        ([[9.8, 0.5]], "give mg"),  # m/s²
        (np.tile([2140.0, 80.0], (8, 1)), "not words of the sensor"),  # LSB
        ([["a", "b"]], "has to be numbers"),
    ],
)
def test_misuse_is_named(accel, says):
    for call in (known().apply, known().angle):
        with pytest.raises(UsageError, match=says):
            call(accel)


def test_a_shock_of_a_few_readings_is_no_misuse():
    assert np.isfinite(known().apply(np.tile([2140.0, 80.0], (7, 1)))).all()


def test_misuse_of_conditions_and_planes_is_named():
    with pytest.raises(UsageError, match="temperature_c has to be numbers, not str"):
        known().apply([1000.0, 2.0], temperature_c="warm")
    calibration = known({"bias_temperature": (0.5, 0.5)})
    accel = np.tile([1000.0, 0.0], (3, 1))
    with pytest.raises(UsageError, match="temperature_c has shape"):
        calibration.apply(accel, [20.0, 21.0])
    with pytest.raises(UsageError, match="temperature_c holds NaN"):
        calibration.apply(accel, np.nan)
    with pytest.raises(UsageError, match=r"plane is xz: .* in plane xy$"):
        calibration.angle(accel, plane="xz")
    for reading_u in (-1.0, (1.0, -1.0), math.nan, math.inf, (1.0, 1.0, 1.0)):
        with pytest.raises(UsageError, match="reading_u"):
            calibration.angle(accel, reading_u=reading_u)
    with pytest.raises(UsageError, match="no start angle"):
        calibration.stage_angle(accel)


def test_readings_beyond_the_model_are_not_a_number():
    far = known({"cubic": (90.0, 90.0)}).apply([[9000.0, 0.0], [900.0, 0.0]])
    assert np.isnan(far[0]).any()
    assert np.isfinite(far[1]).all()


def test_what_the_chip_corrects_now_is_not_corrected_again():
    lsb = 0.4672
    then = replace(known(), provenance=replace(known().provenance, offsets_lsb=(10, 0, 0)))
    now = then.with_offsets((10 - 26, 15, 0))  # −12.1472 and +7.008 mg more than while it was measured
    assert now["bias_x"].value == pytest.approx(12.0 - 26 * lsb)
    assert now["bias_y"].value == pytest.approx(-7.0 + 15 * lsb)
    accel = np.array([[712.0, 650.0]])
    shifted = accel + np.array([-26 * lsb, 15 * lsb])
    assert now.angle(shifted).angle_deg == pytest.approx(then.angle(accel).angle_deg, abs=1e-9)
    # Counts of an unknown scale cannot be moved by registers in steps of 0.4672 mg.
    counts = replace(then, provenance=replace(then.provenance, counts=True))
    for unknown in (known(), counts):
        with pytest.raises(UsageError, match="does not state the contents of the offset"):
            unknown.with_offsets((0, 0, 0))


def test_a_coefficient_is_shown_with_the_coverage_factor_of_its_degrees_of_freedom():
    # Student's t at 95 %: 3.182 for 3 degrees of freedom; 1.960 without any limit.
    assert "3.2" in str(Coefficient("bias_x", 100.0, 1.0, "mg", 3.0))
    assert "2.0" in str(Coefficient("bias_x", 100.0, 1.0, "mg"))


def test_a_result_of_readings_has_no_session_to_be_calibrated_from():
    with pytest.raises(UsageError, match="made from readings"):
        fit_readings(readings_of(planar_session(np.random.default_rng(1))).training).calibration()


def test_a_session_that_lacks_a_gain_gives_no_calibration():
    session = planar_session(np.random.default_rng(1), angles_deg=(0, 90))
    result = adis_gonio.fit(session, method="two-position")
    kept = {name: one for name, one in result.parameters.items() if name not in ("delta_phi", "delta_k")}
    with pytest.raises(FitError, match="does not determine delta_phi"):
        replace(result, parameters=kept, covariance=None, sources=None).calibration()


def test_reprs_are_for_people():
    session = replace(planar_session(np.random.default_rng(1)), title="bench 3")
    calibration = adis_gonio.fit(session, method="ml").calibration()
    assert repr(calibration).startswith("Calibration(generic in the plane xy, ml, ")
    assert "array(" not in repr(calibration)
    assert repr(calibration.angle([[1000.0, 0.0]])).startswith("AngleReading(1 angle, u up to")
    assert math.isfinite(float(calibration.angle([1000.0, 0.0]).u_deg))
