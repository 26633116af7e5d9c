"""Closed forms step by step: positions, weights, derivatives, the pole, and what is left of a session."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError, SingularError
from adis_gonio.fitting import methods as module
from adis_gonio.fitting.determination import NoiseAssumptions
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, Unit, from_means, in_mg
from adis_gonio.fitting.fit_result import Origin
from adis_gonio.fitting.methods import (
    METHOD_TABLE,
    applicable_to,
    as_printed,
    default_method,
    fit_paper,
    fit_positions,
    fit_readings,
    rows_at,
    turn_parameters,
)
from adis_gonio.fitting.uncertainty import ShownAngle, gradient_of_base
from adis_gonio.model.effects import Conditions

G = 980.0
ALPHA, K_X, K_Y, PHI = math.radians(20.0), 1.02, 0.99, math.radians(0.3)
FOUR = (0.0, 90.0, 180.0, 270.0)


def turned(
    angles: tuple[float, ...],
    *,
    alpha: float = ALPHA,
    phi: float = PHI,
    bias: tuple[float, float] = (0.0, 0.0),
    noise: float = 0.0,
    own_u: float = 0.1,
    **more: object,
) -> Readings:
    """A part turned to these angles in degrees."""
    theta = np.radians(angles)
    psi = alpha - theta
    mean = G * np.stack([K_X * np.cos(psi), K_Y * np.sin(psi + phi)], axis=1) + bias
    mean = mean + noise * np.random.default_rng(3).standard_normal(mean.shape)
    n = len(theta)
    conditions = Conditions(time_s=np.arange(float(n)), angle_rad=theta, order=np.arange(float(n)))
    covariance = np.tile(own_u**2 * np.eye(2), (n, 1, 1))
    return from_means(mean, covariance, conditions, gravity_mg=G, **more)


def test_positions_are_found_to_half_a_degree_and_modulo_a_turn() -> None:
    data = turned((0.4, -0.4, 0.6, 359.7, 360.3, 90.45, 89.4, 450.0, 180.0))
    at_0, at_90, at_180, at_270 = rows_at(data, (0, 90, 180, 270))
    assert at_0.tolist() == [0, 1, 3, 4]
    assert at_90.tolist() == [5, 7]
    assert at_180.tolist() == [8]
    assert at_270.tolist() == []
    lost = replace(data, angle_rad=np.full(9, np.nan))
    assert [len(rows) for rows in rows_at(lost, (0, 90))] == [0, 0]


def linear(data: Readings, angles: tuple[int, ...] | None = None, *, bias: bool = True) -> module._Linear:
    return module._linear(data, "two-position", angles, bias=bias)


def test_dwells_of_one_position_share_its_weight() -> None:
    found = linear(turned((90.0, 0.0, 45.0, 0.0, 0.2)), (0, 90), bias=False)
    assert found.data.position.tolist() == [1, 3, 4, 0]
    np.testing.assert_allclose(found.weights, [[1 / 3, 1 / 3, 1 / 3, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("angles", "told"),
    [((0.0, 90.0, 180.0), "270 is missing"), ((0.0, 90.0), "180, 270 are missing")],
)
def test_positions_that_are_missing_are_named(angles: tuple[float, ...], told: str) -> None:
    with pytest.raises(FitError, match=f"needs dwells declared at 0, 90, 180, 270 degrees; {told}"):
        fit_positions(turned(angles), "four-position", (0, 90, 180, 270))


def test_counts_have_no_zero_for_two_positions_and_need_none_for_four() -> None:
    unit = Unit("counts", np.zeros(2), np.ones(2))
    with pytest.raises(FitError, match="needs readings with a known zero"):
        fit_positions(turned(FOUR, unit=unit), "two-position", (0, 90))
    found = fit_positions(turned(FOUR, unit=unit), "four-position", (0, 90, 180, 270))
    assert found["delta_k"].value == pytest.approx(K_X / K_Y - 1)


@pytest.mark.parametrize(("angles", "bias"), [((0.0, 90.0, 0.0), False), ((5.0, 80.0, 200.0, 310.0), True)])
def test_derivatives_are_the_slopes_of_the_parameters(angles: tuple[float, ...], bias: bool) -> None:
    data = turned(angles, bias=(9.0, -4.0) if bias else (0.0, 0.0), noise=1.0)
    used = None if bias else (0, 90)
    found = linear(data, used, bias=bias)
    chosen = found.data
    assert found.has_bias == bias
    for k in range(len(chosen)):
        for axis in range(2):
            step = np.zeros_like(chosen.mean)
            step[k, axis] = 1e-4
            high = linear(replace(chosen, mean=chosen.mean + step), used, bias=bias).beta
            low = linear(replace(chosen, mean=chosen.mean - step), used, bias=bias).beta
            slope = (high - low) / 2e-4 * G
            np.testing.assert_allclose(found.derivative[:, k, axis], slope, atol=1e-6)


def test_a_turn_gives_its_parameters_back() -> None:
    data = turned((10.0, 100.0, 230.0, 300.0), bias=(9.8, -4.9))
    found = linear(data)
    np.testing.assert_allclose(found.beta, [ALPHA, K_X, K_Y, PHI, 0.01, -0.005], atol=1e-12)
    assert turn_parameters(np.array([[-1.0, 0.1], [0.0, 1.0]]))[3] == pytest.approx(
        np.arctan2(0.1, -1.0) - math.pi + 2 * math.pi * (np.arctan2(0.1, -1.0) < 0)
    )


def test_angles_that_do_not_tell_a_turn_and_axes_that_do_not_follow_it_are_refused() -> None:
    close = turned((0.0, 0.01, 0.02, 90.0))
    with pytest.raises(SingularError, match="do not determine cosine, sine and zero"):
        linear(close.rows(np.arange(4) < 3))
    # Three angles d apart have a least singular value of about d²/√6: 1e-3 at 2.8°.
    with pytest.raises(SingularError, match="do not determine cosine, sine and zero"):
        linear(turned((0.0, 2.0, 4.0)))
    assert linear(turned((0.0, 4.0, 8.0))).has_bias
    dead = turned(FOUR)
    with pytest.raises(SingularError, match="an axis does not follow the rotation"):
        linear(replace(dead, mean=dead.mean * [1.0, 1e-4]))


def test_mmpm_is_least_squares_of_nine_positions_or_more() -> None:
    angles = tuple(40.0 * k for k in range(9))
    with pytest.raises(FitError, match="nine or more positions with a declared angle, there are 8"):
        fit_positions(turned(angles[:8]), "mmpm", None)
    data = turned(angles, noise=2.0, bias=(5.0, -3.0))
    found = fit_positions(data, "mmpm", None)
    theta = np.radians(angles)
    rows = np.column_stack([np.cos(theta), np.sin(theta), np.ones(9)])
    (ax, ay), (bx, by), zero = np.linalg.lstsq(rows, data.mean, rcond=None)[0]
    assert found["delta_k"].value == pytest.approx(math.hypot(ax, bx) / math.hypot(ay, by) - 1)
    assert found["alpha"].value == pytest.approx(math.degrees(math.atan2(bx, ax)))
    phi = math.atan2(ay, -by) - math.atan2(bx, ax)
    assert found["delta_phi"].value == pytest.approx(math.degrees(phi))
    assert found["bias_x"].value == pytest.approx(zero[0])
    assert found["bias_y"].value == pytest.approx(zero[1])
    assert found.dof == 18 - 6
    assert found.undetermined == ()


def test_chi2_of_mmpm_is_that_of_least_squares_however_large_the_noise() -> None:
    data = turned(tuple(40.0 * k for k in range(9)), noise=100.0, own_u=100.0, fixture_rad=0.0)
    theta = np.radians(40.0 * np.arange(9))
    rows = np.column_stack([np.cos(theta), np.sin(theta), np.ones(9)])
    left = np.linalg.lstsq(rows, data.mean, rcond=None)[1].sum()
    assert fit_positions(data, "mmpm", None).chi2 == pytest.approx(left / 100.0**2, rel=1e-6)


def refit(method: str, data: Readings) -> Fit:
    """The model of a method on these readings, whose angles are taken as exact."""
    noise = NoiseAssumptions(sigma_rad=0.0)
    return METHOD_TABLE[method].refit(noise.applied(data), Mock(spec=Origin))


@pytest.mark.parametrize("method", ["two-position", "paper", "four-position", "mmpm"])
@pytest.mark.parametrize("left", [(90.0, 180.0), (180.0, 270.0), (270.0, 0.0), (0.0, 90.0)])
def test_without_a_dwell_a_method_is_run_at_the_next_place_of_the_turn(
    method: str, left: tuple[float, float]
) -> None:
    angles = left if method in ("two-position", "paper") else (*left, *(a + 45 for a in left))
    # Equation 5 is exact where the first of the two positions is that of gravity along X.
    alpha = math.radians(left[0] + 0.05) if method == "paper" else ALPHA
    phi = math.radians(0.01) if method == "paper" else PHI
    if method == "four-position":
        angles = tuple(a for a in FOUR if a != left[0])
    model = refit(method, turned(angles, alpha=alpha, phi=phi))
    start, k_x, k_y, skew = model.values.base
    rough = 1e-5 if method == "paper" else 1e-9
    assert math.remainder(start - alpha, 2 * math.pi) == pytest.approx(0, abs=1e-9)
    assert k_x == pytest.approx(K_X, abs=1e-9)
    assert k_y == pytest.approx(K_Y, abs=rough)
    assert skew == pytest.approx(phi, abs=rough)


def test_two_positions_that_are_not_a_quarter_apart_leave_nothing() -> None:
    with pytest.raises(FitError, match="no two positions 90° apart are left for method paper"):
        refit("paper", turned((0.0, 180.0)))


def test_the_papers_equations_are_as_printed_and_their_slopes_too() -> None:
    x1, y1, x2, y2 = 0.95, 0.31, 0.33, -0.93
    gain = x1 / -y2
    a, b = y1 * gain / x1, y2 * gain / x2
    delta_k, phi = as_printed(x1, y1, x2, y2)
    assert delta_k == pytest.approx(gain - 1)
    assert math.sin(phi) == pytest.approx((1 + a * b) / (a + b))
    weights = np.array([[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]])
    values, slope = module._paper(np.array([x1, y1]), np.array([x2, y2]), weights)
    point = np.array([x1, y1, x2, y2])
    for k, one in enumerate(1e-6 * np.eye(4)):
        by_hand = (np.array(as_printed(*(point + one))) - np.array(as_printed(*(point - one)))) / 2e-6
        for row in range(3):
            np.testing.assert_allclose(
                slope[:, row, k % 2][weights[k // 2, row] > 0],
                (by_hand * weights[k // 2, row])[weights[k // 2, row] > 0],
                rtol=1e-6,
            )
    np.testing.assert_allclose(values, [delta_k, phi])


@pytest.mark.parametrize(
    ("alpha", "refused"), [(0.0, False), (40.0, False), (44.9, True), (45.0, True), (133.0, False)]
)
def test_paper_holds_where_the_angle_and_its_doubt_are_a_fifth_of_the_way_to_its_pole(
    alpha: float, refused: bool
) -> None:
    data = turned((0.0, 90.0), alpha=math.radians(alpha), phi=math.radians(0.3), fixture_rad=0.0)
    if refused:
        with pytest.raises(SingularError, match=f"singular here: α = {alpha:.2f}° brings a"):
            fit_paper(data)
    else:
        found = fit_paper(data)
        assert found.parameters.keys() == {"delta_k", "delta_phi", "alpha"}
        assert any("equation 5 is exact at α = 0° only" in line for line in found.warnings)


@pytest.mark.parametrize(("degrees", "refused"), [(11.0, False), (12.0, True)])
def test_paper_is_for_small_angles(degrees: float, refused: bool) -> None:
    # A fifth of cos Δφ, in radians: 11.2°.
    data = turned((0.0, 90.0), alpha=0.0, phi=math.radians(degrees), fixture_rad=0.0)
    if refused:
        with pytest.raises(SingularError, match=rf"Δφ would be \({degrees:.1f}"):
            fit_paper(data)
    else:
        assert fit_paper(data)["delta_phi"].value == pytest.approx(degrees, abs=0.3)


def test_what_a_bias_does_to_two_positions_is_its_slope() -> None:
    found = fit_positions(turned((0.0, 90.0)), "two-position", (0, 90))
    (told,) = [line for line in found.warnings if "a bias cannot be seen" in line]
    moved = [
        fit_positions(turned((0.0, 90.0), bias=tuple(one)), "two-position", (0, 90)) for one in np.eye(2)
    ]
    phi = [one["delta_phi"].value - found["delta_phi"].value for one in moved]
    k = [one["delta_k"].value - found["delta_k"].value for one in moved]
    assert (
        f"on X moves Δφ by {phi[0]:+.2g}° and ΔK by {k[0]:+.2g}, "
        f"on Y Δφ by {phi[1]:+.2g}° and ΔK by {k[1]:+.2g}," in told.replace("−", "-")
    )
    assert "the uncertainty does not include it" in told
    assert told.endswith("measure 180° and 270° too and use method four-position")
    assert found.undetermined == ("bias_x", "bias_y")
    assert found.dof == 0
    sheet = fit_positions(turned((0.0, 90.0), sensor="adis16354"), "two-position", (0, 90))
    assert any("the uncertainty includes the part's figure" in line for line in sheet.warnings)


# -- which method ----------------------------------------------------------------------------------------


def applicable(
    *angles: float, planar: bool = True, free: bool = False, known_zero: bool = True
) -> tuple[str, ...]:
    n, axes = len(angles), 2 if planar else 3
    readings = from_means(
        np.ones((n, axes)),
        np.tile(np.eye(axes), (n, 1, 1)),
        Conditions(time_s=np.arange(float(n)), angle_rad=np.radians(angles)),
        fixture_rad=math.inf if free else 0.0,
        unit=replace(in_mg(axes), name="mg" if known_zero else "counts"),
    )
    return applicable_to(readings)


def test_methods_follow_from_what_was_measured() -> None:
    nan = math.nan
    assert applicable(0, 90) == ("paper", "two-position", "ml")
    assert applicable(0, 270) == ("two-position", "ml")
    assert applicable(0, 180) == ("ml",)
    assert applicable(0.4, 89.6, 180.4, -89.6) == ("paper", "two-position", "four-position", "ml")
    assert applicable(0.6, 90) == ("ml",)
    assert applicable(0, 90, 180, 270, known_zero=False) == ("four-position", "ml")
    assert applicable(0, 270, known_zero=False) == ("ml",)
    assert applicable(0, 90, free=True) == ()
    assert applicable(0, 90, 180, free=True) == ("ml",)
    assert applicable(0, nan) == ()
    assert applicable(nan, nan, nan) == ("ml",)
    assert applicable(*range(10, 90, 9)) == ("mmpm", "ml")
    assert applicable(*range(10, 82, 9)) == ("ml",)
    assert applicable(10) == ()
    assert applicable(nan, nan, nan, planar=False) == ()
    assert applicable(nan, nan, nan, nan, planar=False) == ("ml",)


def test_two_positions_alone_are_the_closed_form_whichever_way_the_stage_turned() -> None:
    for measured, used in (((0.0, 270.0), (0, 270)), ((0.0, 90.0, 270.0), (0, 90))):
        found = fit_readings(turned(measured), "two-position")
        expected = fit_positions(turned(measured), "two-position", used)
        assert found["delta_phi"] == expected["delta_phi"]
    for missing in ((90.0, 270.0), (45.0, 270.0)):
        with pytest.raises(FitError, match="at 0, 90 degrees"):
            fit_readings(turned(missing), "two-position")
    assert default_method(turned((0.0, 90.0, 90.2))) == "two-position"
    assert default_method(turned((0.0, 270.0))) == "two-position"
    assert default_method(turned((0.0, 90.0, 180.0))) == "ml"
    assert default_method(turned((0.0, 0.1))) == "ml"
    assert default_method(turned((0.0, 90.0), fixture_rad=math.inf)) == "ml"
    assert default_method(turned((0.0, 90.0), unit=Unit("counts", np.zeros(2), np.ones(2)))) == "ml"
    back = fit_readings(turned((0.0, 270.0)), "two-position")
    assert back["delta_phi"].value == pytest.approx(0.3)
    assert back["delta_k"].value == pytest.approx(K_X / K_Y - 1)


def test_readings_that_are_too_rough_for_ml_have_the_closed_form_where_angles_are_declared() -> None:
    rough = turned((0.0, 90.0, 45.0), own_u=300.0)
    with pytest.raises(SingularError):
        fit_readings(rough, "ml")
    found = fit_readings(rough)
    assert found.method == "two-position"
    (a_x, a_y), (b_x, b_y), _ = rough.mean
    assert found["delta_k"].value == pytest.approx(math.hypot(a_x, b_x) / math.hypot(a_y, b_y) - 1)
    with pytest.raises(SingularError, match="cannot determine delta_k or delta_phi"):
        fit_readings(replace(rough, fixture_rad=math.inf))
    with pytest.raises(SingularError, match="cannot determine delta_k or delta_phi"):
        fit_readings(turned((0.0, 45.0, 60.0), own_u=300.0))


@pytest.mark.parametrize("angles", [(30.0,), (30.0, 30.0), (30.0, 390.0, 30.05)])
def test_one_position_is_no_calibration(angles: tuple[float, ...]) -> None:
    with pytest.raises(
        FitError, match=r"one position only \([123] dwells?\): .* two positions, 0° and 90°"
    ):
        fit_readings(turned(angles))
    lost = replace(turned(angles[:1]), angle_rad=np.full(1, np.nan))
    with pytest.raises(FitError, match="one position only"):
        fit_readings(lost)
    with pytest.raises(FitError, match="needs declared angles and here fixture_sigma_deg is free"):
        fit_readings(turned((0.0, 90.0), fixture_rad=math.inf), "two-position")


# -- the angle that is shown -----------------------------------------------------------------------------


def shown_deg(base: Floats, bias: Floats, reading: Floats) -> float:
    """α − ψ of a reading (of gravity 1), gains, misalignment and biases as they are taken to be."""
    alpha, k_x, k_y, skew = base
    u = (reading[0] - bias[0]) / k_x
    v = ((reading[1] - bias[1]) / k_y - u * math.sin(skew)) / math.cos(skew)
    return math.degrees(alpha - math.atan2(v, u))


def test_a_shown_angle_follows_parameters_and_reading_as_its_formula_does() -> None:
    base = np.array([0.4, 1.1, 0.9, 0.15])
    gradient = gradient_of_base(base, zero=True)
    places = 2 * math.pi * np.arange(72) / 72
    fit = module._fit(turned(FOUR), np.array([*base, 0.0, 0.0]), bias=True)
    around = ShownAngle.around(fit)
    np.testing.assert_allclose(around.gradient, gradient)
    for k in (0, 5, 17, 30, 50, 71):
        true = np.array([1.1 * math.cos(places[k]), 0.9 * math.sin(places[k] + 0.15)])
        whole = np.array([*base, 0.0, 0.0])
        for j, step in enumerate(1e-6 * np.eye(6)):
            ends = [shown_deg((whole + s * step)[:4], (whole + s * step)[4:], true) for s in (1, -1)]
            slope = math.remainder(ends[0] - ends[1], 360) / 2e-6
            assert gradient[k, j] == pytest.approx(slope, abs=1e-4)
        for axis, step in enumerate(1e-6 * np.eye(2)):
            ends = [shown_deg(base, np.zeros(2), true + s * step) for s in (1, -1)]
            slope = math.remainder(ends[0] - ends[1], 360) / 2e-6 / G
            assert around.reading[k, axis] == pytest.approx(slope, abs=1e-6)
    assert not gradient_of_base(base, zero=False)[:, 0].any()
    rng = np.random.default_rng(2)
    covariance, noise = rng.standard_normal((6, 6)), rng.standard_normal((2, 2))
    covariance, noise = covariance @ covariance.T, noise @ noise.T
    by_hand = [
        g @ covariance @ g + r @ noise @ r for g, r in zip(around.gradient, around.reading, strict=True)
    ]
    np.testing.assert_allclose(around.variances(covariance, noise), by_hand)
