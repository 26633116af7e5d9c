"""Methods of a fit by name (`METHOD_TABLE`, `fit`).

The method `ml` fits the base model and a bias by maximum likelihood, in the plane and in space. The closed
forms are `paper`, `two-position`, `four-position` and `mmpm`. All but `paper` are one linear fit for each
axis, because by the addition theorem, with the declared angle θ,
U_x = A_x cos θ + B_x sin θ + b_x with A_x = K_x G cos α, B_x = K_x G sin α, and
U_y = A_y cos θ + B_y sin θ + b_y with A_y = K_y G sin(α + Δφ), B_y = −K_y G cos(α + Δφ).
With 0° and 90° and no bias this is the closed form Δφ = atan2(U_y1, −U_y2) − atan2(U_x2, U_x1). With 0°,
90°, 180° and 270° the differences of opposite positions are used, which are free of bias. With nine or more
angles the fit is by least squares, and the declared angles are taken as exact (`mmpm`). The fits do not
weight the readings, but the covariance of their results contains the noise of the readings and the
fixture's uncertainty.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, solvable, wrap_degrees, wrap_radians
from adis_gonio.base.budget import current
from adis_gonio.base.errors import AdisGonioError, FitError, SingularError, UsageError
from adis_gonio.base.numbers import counted, format_fixed, signed, with_unit
from adis_gonio.base.uncertainty import Value
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.determination import (
    TYPICAL,
    Determination,
    NoiseAssumptions,
    covariance,
    format_directions,
    is_determined,
    natural_units,
    settle,
    shift_by_held,
)
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.fit_result import FitResult, Origin, Output, outputs_of, result_of
from adis_gonio.fitting.linked import linked_readings
from adis_gonio.fitting.slips.session_positions import failure_message, positions_of, sentences_of
from adis_gonio.fitting.uncertainty import (
    Sources,
    by_rotation_of,
    columns_in_plane,
    response_of,
    sources_of,
)
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration


def fit_ml(readings: Readings) -> FitResult:
    """Fit the base model (attitude, gains, misalignments) and a bias of each axis by maximum likelihood.

    This is the method `ml`.

    Raises
    ------
    SingularError
        The session determines neither delta_k nor delta_phi, or in space none of the parameters.
    """
    settled = settle(readings)
    determination, noise = settled.determination, settled.noise
    fit = determination.fit
    names, null = determination.names, determination.null
    held = [names[k] for k in determination.held]
    unseen = ["alpha"] if readings.planar and not fit.data.visible[0] else []
    outputs = [o for o in outputs_of(fit.data, fit.values.parameters) if o.name not in (*held, *unseen)]
    reported = [o for o in outputs if is_determined(o.gradient, null)]
    lost = [o.name for o in outputs if not is_determined(o.gradient, null)]
    wanted = ("delta_k", "delta_phi") if readings.planar else names
    if not any(o.name in wanted for o in reported):
        directions = "; ".join(format_directions(null, names))
        advice = advise_positions(lost)
        if readings.planar and not np.isfinite(readings.angle_rad).any():
            advice = "declare the stage's angle of each position (column angle_deg)"
        raise SingularError(
            f"{counted(len(readings), 'position')} cannot determine {' or '.join(wanted[:2])}: they "
            f"contain no information on {directions}; {advice}"
        )
    warnings = [*readings.notes, *noise.notes, *_warnings(determination, held, lost, reported)]
    sources = None
    if noise.known:
        inverse = covariance(determination.fisher, determination.free, null)
        natural = natural_units(fit.data)
        response, rotation = response_of(fit, inverse, natural), by_rotation_of(fit, inverse, natural)
        sources = sources_of(readings, noise, fit, response, determination.held, rotation, TYPICAL * null)
    made, open_ = Origin(readings, noise, fit, determination), (*unseen, *held, *lost)
    about: dict[str, Any] = {"chi2": settled.chi2, "dof": settled.dof, "undetermined": open_}
    return result_of(made, reported, sources, warnings, method="ml", **about)


def _warnings(
    determination: Determination, held: list[str], lost: list[str], reported: list[Output]
) -> list[str]:
    """Return warnings on the parameters that the positions do not determine.

    `held` are the names of parameters that were taken as zero, `lost` the names of quantities that are
    missing from the result, and `reported` its quantities.
    """
    warnings = []
    names = determination.names
    for name, k in zip(held, determination.held, strict=True):
        shift = shift_by_held(determination, k)
        # Effect of 1 mg of bias, or of a tenth of a degree of skew.
        one = 1 / determination.fit.data.gravity_mg if name.startswith("bias") else math.radians(0.1)
        moves = [
            f"{o.name} by {with_unit(signed(float(o.gradient @ shift) * one, digits=2), o.unit)}"
            for o in reported
            if o.name in ("delta_k", "delta_phi") or o.name.startswith("bias")
        ]
        step = "1 mg" if name.startswith("bias") else "0.1°"
        moved = f": {step} of it moves {', '.join(moves)}" if moves else ""
        warnings.append(
            f"{name} cannot be seen in these positions and was taken as zero{moved}; "
            f"{advise_positions([name])}"
        )
    if determination.null.shape[1]:
        for direction in format_directions(determination.null, names):
            warnings.append(f"not determined by these positions: {direction}")
        warnings.append(f"left out because not determined: {', '.join(lost)}; {advise_positions(lost)}")
    return warnings


def advise_positions(names: list[str]) -> str:
    """Return advice on positions that determine the parameters with these names."""
    if any(name.startswith("skew") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure positions that share gravity between the two axes"
    axes = sorted({name[-1] for name in names if name.startswith(("bias", "scale"))})
    if any(name.endswith("_z") for name in names):
        return f"measure positions with axis {', '.join(axes) or 'z'} up and down"
    if any(name.startswith("bias") for name in names) and not any(n.startswith("scale") for n in names):
        return "measure the opposite positions too (180° and 270°)"
    return "measure positions all around the turn (0°, 90°, 180°, 270°)"


def refit_ml(readings: Readings, made: Origin) -> Fit:
    """Repeat the fit of the method `ml` on other readings, or on a subset of the dwells.

    The fit starts from the values of the original fit in `made`.

    Raises
    ------
    FitError
        If these dwells do not determine the parameters that all dwells determine.
    """
    found = made.determination
    assert found is not None
    row = {position: k for k, position in enumerate(made.fit.data.position.tolist())}
    attitude = made.fit.values.attitude[[row[position] for position in readings.position.tolist()]]
    readings = replace(readings, fitted=made.fit.data.fitted)
    start = replace(made.fit, data=readings, values=replace(made.fit.values, attitude=attitude))
    # Along a direction without information a refit runs for many steps, so this is checked before it.
    if not found.determined_by(start):
        raise FitError("the other dwells do not determine the parameters")
    return replace(found, fit=start).refitted(readings)


ALPHA, SCALE_X, SCALE_Y, DELTA_PHI, BIAS_X, BIAS_Y = range(6)
"""Indices of the parameters in the order of `determination.names_of`, in natural units: a bias in local
gravity."""

TOLERANCE_DEG = 0.5
"""Largest difference, in degrees, between a declared angle and 0, 90, 180 or 270° (modulo 360°) at which
the dwell counts as that position.
"""

TWO, FOUR = (0, 90), (0, 90, 180, 270)
"""Declared angles in degrees that the methods `two-position` and `four-position` use."""

LEAST_MMPM = 9
"""Fewest positions with a declared angle for the method `mmpm`, by its definition."""

_FAR_FROM_POLE = 0.5
"""Value of |cos(2α + Δφ)| above which the pole of equation 12 at 45° is not the reason why method `paper`
fails."""
_NEAR_POLE = 0.2
_LEAST_READING = 1e-6
"""Size of the readings U_x1 and U_y2, as a fraction of local gravity, below which equations 5 and 12 count
as a division by zero."""


@dataclass(frozen=True)
class _Linear:
    """Linear fit of the dwells that a closed form uses.

    Attributes
    ----------
    data : Readings
        The n dwells.
    weights : (angles, n) float
        Weight of each dwell in the mean reading at each angle.
    beta : (6,) float
        α, K_x, K_y, Δφ (rad and 1) and both biases in local gravity.
    derivative : (6, n, 2) float
        Derivative of `beta` by the readings in local gravity.
    has_bias : bool
        False if the biases were taken as zero.
    """

    data: Readings
    weights: Floats
    beta: Floats
    derivative: Floats
    has_bias: bool


def rows_at(readings: Readings, angles_deg: tuple[int, ...]) -> list[NDArray[np.intp]]:
    """Return the rows of the dwells declared at each angle in degrees (modulo 360°), possibly none."""
    degrees = np.degrees(readings.angle_rad)
    with np.errstate(invalid="ignore"):
        return [np.flatnonzero(np.abs(wrap_degrees(degrees - a)) <= TOLERANCE_DEG) for a in angles_deg]


def fit_positions(readings: Readings, method: str, angles_deg: tuple[int, ...] | None) -> FitResult:
    """Fit the method `two-position` (0°, 90°), `four-position` (0°, 90°, 180°, 270°) or `mmpm`.

    Dwells at the same position are averaged. `mmpm` has no `angles_deg`: it is the unweighted least-squares
    fit to all dwells with a declared angle.

    Raises
    ------
    FitError
        A position is missing, there are fewer than nine for `mmpm`, or the readings are in counts, which
        have no known zero.
    SingularError
        The dwells are at fewer than three different angles.
    """
    declared = int(np.isfinite(readings.angle_rad).sum())
    if angles_deg is None and declared < LEAST_MMPM:
        raise FitError(
            f"method mmpm needs nine or more positions with a declared angle, there are {declared}; "
            "use method ml, or leave the method open"
        )
    linear = _linear(readings, method, angles_deg, bias=angles_deg is None or len(angles_deg) > 2)
    warnings = [] if linear.has_bias else _blind_to_bias(readings, linear)
    return _finish(linear, method, settle(readings).noise, warnings)


def refit_turn(method: str, readings: Readings, made: Origin) -> Fit:
    """Repeat the fit of `four-position` or `mmpm` on other readings, or on a subset of the dwells.

    Dwells at three of the four positions suffice. `method` is the name of the method; `made`, the earlier
    result, is not used.
    """
    groups = zip(FOUR, rows_at(readings, FOUR), strict=True)
    present = tuple(angle for angle, rows in groups if len(rows)) if method == "four-position" else None
    return _fit(readings, _linear(readings, method, present, bias=True).beta, bias=True)


def refit_two(method: str, readings: Readings, made: Origin) -> Fit:
    """Repeat the fit of `paper` or `two-position` on other readings, at the first two positions 90° apart.

    `method` is the name of the method; `made`, the earlier result, is not used.

    Raises
    ------
    FitError
        The readings have no two positions 90° apart.
    """
    for quarter in range(4):
        turned = replace(readings, angle_rad=readings.angle_rad - quarter * math.pi / 2)
        if all(len(rows) for rows in rows_at(turned, TWO)):
            linear = _linear(turned, method, TWO, bias=False)
            if method == "paper":
                try:
                    linear = _by_paper(linear)
                except SingularError:
                    continue
            beta = linear.beta.copy()
            beta[ALPHA] += quarter * math.pi / 2
            return _fit(readings, beta, bias=False)
    raise FitError(f"no two positions 90° apart are left for method {method}")


def fit_paper(readings: Readings) -> FitResult:
    """Fit the method `paper`: equations 5 to 12 as printed, which first correct the readings of Y by ΔK.

    With the readings U_x1, U_y1 at 0° and U_x2, U_y2 at 90°, ΔK = U_x1/(−U_y2) − 1, a = U_y1(1 + ΔK)/U_x1,
    b = U_y2(1 + ΔK)/U_x2 and sin Δφ = (1 + ab)/(a + b).

    Raises
    ------
    FitError
        If 0° or 90° is missing.
    SingularError
        The start angle α is near 45°, where a + b vanishes, because the result without noise is Δφ/cos(2α +
        Δφ). The method fails if Δφ and the uncertainty of 2α + Δφ together exceed a fifth of |cos(2α +
        Δφ)|: the result is then not linear in either, and no uncertainty is valid. It also fails if a
        reading in a denominator is nearly zero.
    """
    exact = _linear(readings, "paper", TWO, bias=False)
    noise = settle(readings).noise
    spread = _sources(replace(exact, data=replace(exact.data, sensor="generic")), noise).covariance
    alpha, phi = float(exact.beta[ALPHA]), float(exact.beta[DELTA_PHI])
    at = 2 * alpha + phi
    # Uncertainty of 2α + Δφ; its cosine is the distance from the pole.
    gradient = np.zeros(6)
    gradient[ALPHA], gradient[DELTA_PHI] = 2.0, 1.0
    u_at = math.sqrt(max(float(gradient @ spread @ gradient), 0.0))
    distance = abs(math.cos(at))
    if math.hypot(phi, u_at) > _NEAR_POLE * distance:
        if distance > _FAR_FROM_POLE:
            found = Value(math.degrees(phi), math.degrees(u_at), "deg")
            raise SingularError(
                f"method paper is not valid here: Δφ would be {found}, and its"
                " equations are for small angles; use two-position"
            )
        times = f"{1 / distance:.0f} times" if distance > 1e-6 else "more than a million times"
        raise SingularError(
            f"method paper is singular here: α = {format_fixed(math.degrees(alpha), 2)}° brings a + b of"
            f" equation 12 near zero, so that noise and Δφ itself appear {times} enlarged against α = 0°;"
            " use method two-position, or start at another angle"
        )
    linear = _by_paper(exact)
    warnings = _blind_to_bias(readings, linear)
    off_k = _ratio(linear.beta) - _ratio(exact.beta)
    off_phi = math.degrees(linear.beta[DELTA_PHI] - phi)
    warnings.append(
        f"equation 5 is exact at α = 0° only: at {format_fixed(math.degrees(alpha), 2)}° this result is off"
        f" by {signed(off_k, digits=2)} in ΔK and {signed(off_phi, digits=2)}° in Δφ from method"
        " two-position on the same readings, and its uncertainty does not include this"
    )
    return _finish(linear, "paper", noise, warnings, ("delta_k", "delta_phi", "alpha"))


def _by_paper(exact: _Linear) -> _Linear:
    """Return the fit by the method `paper`, with ΔK and Δφ by equations 5 to 12.

    The start angle and the scale of X are those in `exact`, the closed form of the same dwells.

    Raises
    ------
    SingularError
        A denominator of equation 5 or 12 vanishes.
    """
    first, second = exact.weights @ (exact.data.mean / exact.data.gravity_mg)
    if min(abs(first[0]), abs(second[1])) < _LEAST_READING:
        raise SingularError(
            "method paper divides by the first reading of X and the second of Y, and one is zero here; "
            "use method two-position"
        )
    values, derivative = _paper(first, second, exact.weights)
    beta = exact.beta.copy()
    beta[DELTA_PHI] = values[1]
    beta[SCALE_Y] = beta[SCALE_X] / (1 + values[0])
    # Derivatives of Δφ and K_y = K_x/(1 + ΔK) by the printed equations replace the exact ones.
    derivatives = exact.derivative.copy()
    derivatives[DELTA_PHI] = derivative[1]
    derivatives[SCALE_Y] = (
        exact.derivative[SCALE_X] / (1 + values[0]) - beta[SCALE_X] * derivative[0] / (1 + values[0]) ** 2
    )
    return replace(exact, beta=beta, derivative=derivatives)


def _ratio(beta: Floats) -> float:
    """Return K_x/K_y, which is 1 + ΔK, from the parameters (6,) of a linear fit."""
    return float(beta[SCALE_X] / beta[SCALE_Y])


def as_printed(x1: Any, y1: Any, x2: Any, y2: Any) -> tuple[Any, Any]:
    """Return ΔK and Δφ in rad by the paper's equations 5 to 12.

    `x1` and `y1` are the readings of X and Y at 0°, `x2` and `y2` at 90°: numbers or arrays, also complex.
    A result is NaN if sin Δφ would exceed 1, and infinite or NaN if a denominator of the equations is 0.
    """
    gain = x1 / -y2
    # Equation 12 with numerator and denominator times U_x1 U_x2, which allows U_x2 = 0 at α = 0.
    sine = (x1 * x2 + gain * gain * y1 * y2) / (gain * (y1 * x2 + y2 * x1))
    return gain - 1, np.arcsin(sine)


def _paper(first: Floats, second: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return ΔK and Δφ (rad) by the paper's printed equations, and their derivatives by the readings.

    The derivatives are (2, n, 2). `first` and `second` (2,) are the mean readings at 0° and 90°, `weights`
    (2, n) the share of each dwell in them.
    """
    # Complex step: the imaginary part over the step is the derivative without cancellation.
    point = np.array([first[0], first[1], second[0], second[1]], dtype=np.complex128)
    values = np.array(as_printed(*point.tolist()), dtype=np.complex128)
    stepped = [np.array(as_printed(*(point + 1e-30j * unit).tolist())) for unit in np.eye(4)]
    by_reading = np.stack([values.imag / 1e-30 for values in stepped], axis=1)
    derivative = np.einsum("pka,kn->pna", by_reading.reshape(2, 2, 2), weights)
    return values.real, derivative


def turn_parameters(harmonics: Floats) -> Floats:
    """Return α, K_x, K_y, Δφ and both biases (6,) from cosine, sine and constant of each axis.

    Angles are in rad, biases in local gravity.

    Parameters
    ----------
    harmonics : (3, 2) or (2, 2) float
        Amplitudes A (cosine) and B (sine) of X and Y in local gravity, then the biases if the fit has them;
        otherwise the biases are 0.
    """
    (a_x, a_y), (b_x, b_y), *bias = harmonics.tolist()
    alpha, alpha_y = math.atan2(b_x, a_x), math.atan2(a_y, -b_y)
    gains = math.hypot(a_x, b_x), math.hypot(a_y, b_y)
    return np.array([alpha, *gains, wrap_radians(alpha_y - alpha), *(bias[0] if bias else (0.0, 0.0))])


def _linear(readings: Readings, method: str, angles_deg: tuple[int, ...] | None, *, bias: bool) -> _Linear:
    """Fit cosine, sine and (with `bias`) a constant to the mean readings of each axis at each angle.

    The dwells declared at `angles_deg` are used; None uses each dwell with a declared angle. Messages name
    the `method`.

    Raises
    ------
    FitError
        An angle has no dwell, or the readings are in counts, which have no known zero, at two angles.
    SingularError
        The angles do not determine the fit, or an axis does not follow the rotation.
    """
    if angles_deg is None:
        groups = list(np.flatnonzero(np.isfinite(readings.angle_rad))[:, None])
    else:
        groups = rows_at(readings, angles_deg)
        missing = [str(a) for a, rows in zip(angles_deg, groups, strict=True) if not len(rows)]
        if missing:
            raise FitError(
                f"method {method} needs dwells declared at {', '.join(map(str, angles_deg))} degrees; "
                f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing"
            )
        if not readings.unit.known and len(angles_deg) == 2:
            raise FitError(
                f"method {method} needs readings with a known zero; counts have none: use method ml"
            )
    chosen = readings.rows(np.concatenate(groups))
    group = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    # Mean over the dwells of each group.
    weights = (np.arange(len(groups))[:, None] == group) / np.bincount(group)[:, None]
    # Mean declared angle of each group, as the direction of the mean unit vector.
    theta = np.angle(weights @ np.exp(1j * chosen.angle_rad))
    columns = [np.cos(theta), np.sin(theta)] + ([np.ones_like(theta)] if bias else [])
    design = np.stack(columns, axis=1)
    if np.linalg.svd(design, compute_uv=False)[-1] < 1e-3:
        raise SingularError(
            "the declared angles do not determine cosine, sine and zero of a turn; spread the positions "
            "over it (0°, 90°, 180°, 270°)"
        )
    beta = turn_parameters(np.linalg.pinv(design) @ weights @ (chosen.mean / chosen.gravity_mg))
    if min(beta[SCALE_X], beta[SCALE_Y]) < 1e-3:
        raise SingularError("an axis does not follow the rotation; check the declared angles and the plane")
    # The parameters follow the mean readings by the pseudo-inverse of the readings' derivatives.
    fitted = 6 if bias else BIAS_X
    slopes = columns_in_plane(beta[:BIAS_X], -theta)[:, :, :fitted]
    by_mean = np.linalg.pinv(slopes.reshape(-1, fitted)).reshape(fitted, -1, 2)
    derivative = np.zeros((6, len(chosen), 2))
    derivative[:fitted] = np.einsum("pka,kn->pna", by_mean, weights)
    return _Linear(chosen, weights, beta, derivative, bias)


def _fit(data: Readings, beta: Floats, *, bias: bool) -> Fit:
    """Return the base model, with or without a bias, at the parameters `beta` of `_Linear`.

    Angles are as declared; nothing is fitted.
    """
    term = NamedTerm.offset("xy")
    fit = Fit.begin(data, with_prior=False)
    values = replace(fit.values, base=beta[:BIAS_X].copy())
    terms, own = ((term,), (beta[BIAS_X:] * data.gravity_mg,)) if bias else ((), ())
    return replace(fit, values=values).with_terms(terms, own)


def _sources(linear: _Linear, noise: NoiseAssumptions) -> Sources:
    """Return the sources of the uncertainty of α, the gains, Δφ and the biases in natural units.

    An error of a declared angle acts along the tangent of the circle of readings.
    """
    data = linear.data
    fit = _fit(noise.applied(data), linear.beta, bias=linear.has_bias)
    held = () if linear.has_bias or not data.unit.known else (BIAS_X, BIAS_Y)
    return sources_of(data, noise, fit, linear.derivative / data.gravity_mg, held)


def _blind_to_bias(readings: Readings, linear: _Linear) -> list[str]:
    """Return a warning that an unknown bias changes a result from two positions, with advice.

    `linear` is the result from the two positions; `readings` are the whole session.
    """
    # A bias of 1 mg adds to all readings of an axis.
    moved = linear.derivative.sum(axis=1) / readings.gravity_mg
    phi = np.degrees(moved[DELTA_PHI])
    k = (moved[SCALE_X] - moved[SCALE_Y] * _ratio(linear.beta)) / linear.beta[SCALE_Y]
    stated = "includes the part's figure for it" if readings.sensor in VARIANTS else "does not include it"
    remedy = _bias_of_four(readings)
    if remedy is None:
        remedy = (
            "methods mmpm and ml see it in this session"
            if np.count_nonzero(np.isfinite(readings.angle_rad)) >= LEAST_MMPM
            else "measure 180° and 270° too and use method four-position"
        )
    return [
        "a bias cannot be seen in two positions: 1 mg on X moves"
        f" {_pair(k[0], phi[0])}, on Y {_pair(k[1], phi[1])}, and the uncertainty {stated}; {remedy}"
    ]


def _bias_of_four(readings: Readings) -> str | None:
    """Describe the bias that four positions show, and the error that it causes in a fit of two.

    Returns
    -------
    str or None
        A clause with the bias and the change of delta_phi and delta_k that it makes; None if the session
        does not have the four positions, or if they do not determine a bias.
    """
    if not all(len(rows) for rows in rows_at(readings, FOUR)):
        return None
    try:
        bias = _linear(readings, "four-position", FOUR, bias=True).beta[BIAS_X:] * readings.gravity_mg
        free = replace(readings, mean=readings.mean - bias)
        two = partial(_linear, method="two-position", angles_deg=TWO, bias=False)
        with_bias, without = two(readings).beta, two(free).beta
    except SingularError:
        return None
    phi = math.degrees(wrap_radians(float(with_bias[DELTA_PHI] - without[DELTA_PHI])))
    k = _ratio(with_bias) - _ratio(without)
    x, y = bias
    return (
        f"method four-position finds a bias of {signed(x, 1)} mg on X and {signed(y, 1)} mg on Y in this"
        f" session, which moves {_pair(k, phi)} here: use method four-position or ml"
    )


def _pair(delta_k: float, delta_phi_deg: float) -> str:
    """Format the changes of ΔK and Δφ by a bias, such as `Δφ by −0.058° and ΔK by +0.00097`."""
    return f"Δφ by {signed(delta_phi_deg, digits=2)}° and ΔK by {signed(delta_k, digits=2)}"


def _finish(
    linear: _Linear,
    method: str,
    noise: NoiseAssumptions,
    warnings: list[str],
    only: tuple[str, ...] | None = None,
) -> FitResult:
    """Return the result of a closed form; with `only`, of the parameters with these names."""
    chosen, unseen = linear.data, () if linear.has_bias else ("bias_x", "bias_y")
    outputs = [
        output
        for output in outputs_of(chosen, linear.beta * np.array([1, 1, 1, 1, *[chosen.gravity_mg] * 2]))
        if output.name not in unseen and (only is None or output.name in only)
    ]
    assumed = NoiseAssumptions(scale=noise.scale, sigma_rad=noise.sigma_rad).applied(chosen)
    fit = _fit(assumed, linear.beta, bias=linear.has_bias)
    dof = 2 * len(chosen) - (6 if linear.has_bias else 4)
    # Residuals of an unweighted fit are not χ² distributed; the smallest χ² of this model is.
    chi2 = fit.refit(200, 1e-12).chi2 if dof else 0.0
    made, sources = Origin(chosen, noise, fit), _sources(linear, noise) if noise.known else None
    warnings = [*warnings, *chosen.notes, *noise.notes]
    return result_of(
        made, outputs, sources, warnings, method=method, chi2=chi2, dof=dof, undetermined=unseen
    )


FREE_TURN = "free-turn"
"""Name of the method for a continuous recording (`adis_gonio.fitting.free_turn`), which has no
positions."""


@solvable
def fit(session: Session, method: str | None = None, gyros: GyroCalibration | None = None) -> FitResult:
    """Fit a method to a session, and return the parameters with their covariance.

    Parameters
    ----------
    session : Session
        Session to fit; its `check` dwells are not used.
    method : str, optional
        One of `METHODS`, or `free-turn` for a continuous recording. The default is the best method for the
        session: `ml`, or `two-position` if there are only 0° and 90°.
    gyros : GyroCalibration, optional
        Calibration of the session's gyros from another session. Recorded turns between poses in space then
        give more precise equations than with the data sheet.

    Raises
    ------
    UsageError
        Unknown method, or a calibration of gyros that the session cannot use.
    DataError
        Unusable samples: all zero, stuck, not finite.
    FitError
        The session lacks positions or angles that the method needs.
    SingularError
        The session does not determine the parameters of the method.
    """
    if method is not None and method not in (known := (*METHOD_TABLE, FREE_TURN)):
        raise UsageError(f"no method is called '{method}'; known: {', '.join(known)}")
    if method == FREE_TURN or (session.free_turn and method is None):
        from adis_gonio.fitting.free_turn import fit_free_turn

        return fit_free_turn(session)
    if session.free_turn and not session.dwells:
        raise FitError(
            f"{session.source or 'session'}: method {method} needs positions; this is one continuous turn:"
            " use method free-turn"
        )
    readings, links = session.once(linked_readings, gyros)
    current().tell(f"method {method}" if method else "the best method")
    try:
        result = fit_of(readings, method)
    except FitError as error:
        raise type(error)(failure_message(session, error)) from error
    positions = positions_of(session)
    notes = (*session.notes, *sentences_of(positions))
    return replace(
        result,
        warnings=(*result.doubts, *notes, *result.warnings),
        session=readings,
        session_notes=notes,
        position_findings=positions,
        overrides=session.facts.get("overrides", {}),
        provenance=provenance_of(session),
        links=links,
    )


def fit_of(readings: Readings, method: str | None = None) -> FitResult:
    """Fit a method to readings without their `check` dwells; the result is kept for reuse.

    Without `method`, use the default method of these readings.
    """
    return readings.training.once(fit_readings, method)


def fit_readings(readings: Readings, method: str | None = None) -> FitResult:
    """Fit a method to readings of three axes in space, or of two axes in the plane.

    Without `method`, use the default method of these readings, or `two-position` if that is singular.
    """
    n, spatial = len(readings), not readings.planar
    declared = readings.angle_rad[np.isfinite(readings.angle_rad)]
    alike = len(declared) == n and bool(np.abs(wrap_radians(declared - declared[0])).max() < 1e-3)
    if n == 1 or (alike and not spatial):
        needs = "six positions in space" if spatial else "two positions, 0° and 90°, better four"
        raise FitError(f"one position only ({counted(n, 'dwell')}): a calibration needs at least {needs}")
    if method is None:
        try:
            return readings.once(fit_readings, default_method(readings))
        except SingularError:
            if not readings.planar or not has_positions(readings, _two(readings)):
                raise
            return readings.once(fit_readings, "two-position")
    if method != "ml" and not readings.planar:
        raise FitError(f"method {method} needs a plane of rotation; this session has none: use method ml")
    if method != "ml" and readings.free:
        raise FitError(
            f"method {method} needs declared angles and here fixture_sigma_deg is free: use method ml"
        )
    return METHOD_TABLE[method].fit(readings)


def applicable_methods(session: Session) -> tuple[str, ...]:
    """Return the methods that the positions of a session allow.

    A fit may still find a parameter undetermined. If the readings are unusable, the result is `ml`; a fit
    then raises an error with the reason.
    """
    if session.free_turn:
        return (FREE_TURN,)
    try:
        return applicable_to(readings_of(session).training)
    except AdisGonioError:
        return ("ml",)


def applicable_to(readings: Readings) -> tuple[str, ...]:
    """Return the methods that the positions of these readings allow."""
    if not readings.planar:
        return ("ml",) if len(readings) > 3 else ()
    return tuple(name for name, method in METHOD_TABLE.items() if method.suits(readings))


def has_positions(readings: Readings, angles_deg: tuple[int, ...]) -> bool:
    """Return True if the stage's angles are known and each of these angles (modulo 360°) is measured."""
    return not readings.free and all(len(rows) for rows in rows_at(readings, angles_deg))


def has_enough(readings: Readings) -> bool:
    """Return True if there are enough dwells for the method `ml`, which uses all positions."""
    declared = bool(np.isfinite(readings.angle_rad).all())
    return len(readings) >= (2 if declared and not readings.free else 3)


def _two(readings: Readings) -> tuple[int, int]:
    """Return the angles in degrees of the two positions for the method `two-position`: (0, 90) or (0, 270).

    Its equations are exact for any two positions a quarter turn apart. There are 0° and 270° if the stage
    turned opposite to the declared sense.
    """
    at_0, at_90, at_270 = map(len, rows_at(readings, (0, 90, 270)))
    return (0, 270) if at_0 and at_270 and not at_90 else TWO


def default_method(readings: Readings) -> str:
    """Return the default method: `ml`, or `two-position` if only two positions 90° apart are measured."""
    if not readings.planar or not readings.unit.known:
        return "ml"
    two = _two(readings)
    used = sum(map(len, rows_at(readings, two)))
    return "two-position" if used == len(readings) and has_positions(readings, two) else "ml"


@dataclass(frozen=True)
class Method:
    """A fitting method: its name, its function, and the readings that it needs.

    Attributes
    ----------
    fit : callable
        Fits `Readings` and returns a `FitResult`; raises `FitError` or `SingularError`.
    refit : callable
        Function of `Readings` and the `Origin` of an earlier result, which repeats the fit of that result
        on these readings and returns a `Fit`; raises `FitError`. The readings are all or some of the
        dwells, with the noise that the earlier result used. It serves to leave dwells out in the comparison
        of methods, and for Monte Carlo trials.
    suits : callable
        Returns True if `Readings` in a plane have the positions that the method needs.
    """

    fit: Callable[[Readings], FitResult]
    refit: Callable[[Readings, Origin], Fit]
    suits: Callable[[Readings], bool]


METHOD_TABLE = {
    "paper": Method(
        fit_paper, partial(refit_two, "paper"), lambda r: r.unit.known and has_positions(r, TWO)
    ),
    "two-position": Method(
        lambda r: fit_positions(r, "two-position", _two(r)),
        partial(refit_two, "two-position"),
        lambda r: r.unit.known and has_positions(r, _two(r)),
    ),
    "four-position": Method(
        lambda r: fit_positions(r, "four-position", FOUR),
        partial(refit_turn, "four-position"),
        lambda r: has_positions(r, FOUR),
    ),
    "mmpm": Method(
        lambda r: fit_positions(r, "mmpm", None),
        partial(refit_turn, "mmpm"),
        lambda r: not r.free and int(np.isfinite(r.angle_rad).sum()) >= LEAST_MMPM,
    ),
    "ml": Method(fit_ml, refit_ml, has_enough),
}
"""All methods for a session of positions, by name. Only `ml` also fits poses in space."""
METHODS = tuple(METHOD_TABLE)
"""Names of the methods for a session of positions."""
