"""The grammar of unnamed terms: each combines a place in the model with a function of covariates.

Places: the bias of an axis, its gain, its misalignment against the other axes, the true angle. Functions:
a power, modulus or sign of the reading; a harmonic of the stage; of temperature, time, supply, approach,
previous position, rate of the temperature, or a product of two, a line, a power, a step, a knee, an
exponential, a lag, an oscillation or a bump; few cycles of the stage times one of these covariates. Smooth
functions (polynomials of increasing degree) cover dependences without a formula. The measurement decides
which covariates replace the reading (`Measurement.driven_by`): for a gyro force and rotation.

Covariates are normalised: centred on the middle of the session's range and scaled to ±1, unless their zero
has a meaning (25 °C, 5 V, start of the session). A function with an arbitrary zero is also a candidate with
an added constant, so that its constant is not mistaken for a bias.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Where
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.tracing.named_candidates import choices_of_axes
from adis_gonio.tracing.thresholds import limits

Shape = Callable[[Floats], Floats]
"""Function of one covariate that is scaled to the range −1 … 1."""
Columns = Callable[[Conditions], Floats]
"""Function that computes one or q columns, (n,) or (n, q), from the conditions of n dwells."""

COMMON = ("reading", "force", "rotation", "angle", "time", "temperature")
"""Covariates with full prior weight; other covariates and products are less probable."""


def line_shape(u: Floats) -> Floats:
    """Return `u` (n,) unchanged: the shape of a straight line."""
    return u


def power_shape(exponent: int) -> Shape:
    """Return the function u → u^exponent, with a whole exponent."""
    return lambda u: np.asarray(np.prod([u] * exponent, axis=0))


def step_shape(place: float) -> Shape:
    """Return a step function of u: 0 up to `place`, 1 beyond it."""
    return lambda u: np.where(u > place, 1.0, 0.0)


def knee_shape(place: float, sign: float) -> Shape:
    """Return a function of u with a knee: 0 on one side of `place`, a straight line on the other.

    The line is on the upper side for `sign` 1, on the lower side for −1.
    """
    return lambda u: np.maximum(sign * (u - place), 0)


def growth_shape(rate: float) -> Shape:
    """Return the function u → exp(rate · u), scaled so that its maximum over −1 … 1 is 1."""
    return lambda u: np.exp(rate * u - abs(rate))


def approach_shape(time_constant: float, sign: float) -> Shape:
    """Return an exponential function of time that decays from the start (sign −1) or rises to the end (1).

    The time u is −1 at the start of the session and 1 at its end; the unit of `time_constant` is the length
    of the session.
    """
    return lambda u: np.exp((sign * (u + 1) / 2 - (sign > 0)) / time_constant)


def bump_shape(place: float, width: float) -> Shape:
    """Return a Gaussian bell curve of u with its centre at `place` and a standard deviation of `width`."""
    return lambda u: np.exp(-0.5 * ((u - place) / width) ** 2)


def ring_bump(centre_rad: float, width_rad: float) -> Shape:
    """Return a periodic bell curve (von Mises distribution) of an angle in rad.

    `centre_rad` is its maximum, with the value 1. Near it, `width_rad` is the standard deviation.
    """
    return lambda t: np.exp((np.cos(t - centre_rad) - 1) / width_rad**2)


def multiple(function: Callable[..., Floats], times: int) -> Shape:
    """Return the function u → function(times · u)."""
    return lambda u: np.asarray(function(times * u))


def legendre(degrees: Sequence[int]) -> Shape:
    """Return a function of u with the Legendre polynomials of these degrees, (n, len(degrees))."""
    one = np.eye(max(degrees) + 1)
    return lambda u: np.stack([np.polynomial.legendre.legval(u, one[k]) for k in degrees], axis=1)


def harmonics(orders: Sequence[int]) -> Shape:
    """Return a function of an angle with sines and cosines of its multiples, (n, 2 len(orders))."""
    return lambda t: np.stack([f(k * t) for k in orders for f in (np.sin, np.cos)], axis=1)


@dataclass(frozen=True)
class _Made:
    """An unnamed function as a candidate: its basis functions, and its possible places in the model.

    `family` is the covariate, or the group of covariates, whose functions share one part of the prior.
    """

    family: str
    basis: Basis
    places: tuple[Where, ...]


def nameless_terms(data: Readings) -> list[NamelessTerm]:
    """Return all unnamed candidate terms of a session; the cost of each is −ln of its prior probability."""
    made = list(_bases(data))
    weight = {m.family: 1.0 if m.family in COMMON else limits.family_weight for m in made}
    total = sum(weight[family] for family in sorted(weight))
    placed: dict[tuple[str, bool], list[tuple[Basis, Where, tuple[int, ...]]]] = {}
    subsets = choices_of_axes(range(data.axes))
    letters = {subset: f"[{''.join(AXES[k] for k in subset)}]" for subset in subsets} | {(): ""}
    for m in made:
        members = placed.setdefault((m.family, m.basis.approximates), [])
        for where in m.places:
            if where != "angle":
                members += [(m.basis, where, subset) for subset in subsets]
            elif data.planar and m.basis.common is not None:
                members.append((m.basis, where, ()))
    terms, stimulus = [], data.model.stimulus
    # Families share the prior by weight, then formulas against smooth functions, then evenly.
    for (family, smooth), members in placed.items():
        both = placed.get((family, not smooth))
        part = (limits.smooth_weight if smooth else 1 - limits.smooth_weight) if both else 1.0
        for basis, where, subset in members:
            if data.model.constant and basis.with_constant:
                continue  # the base model contains the constant; the form without it keeps its share
            share = limits.nameless_share * weight[family] / total * part / len(members)
            label, cost = f"{where}{letters[subset]}~{basis.form}", -math.log(share)
            own = NamelessTerm(label, basis.covariates, cost, where, subset, basis, stimulus=stimulus)
            terms.append(own)
    return terms


def _bases(data: Readings) -> Iterator[_Made]:
    """Yield all candidate functions that a session can show, one family of covariates after another."""
    conditions = data.conditions
    driving = {"reading": _of_reading, "force": _of_force, "rotation": _of_rotation}
    for covariate in data.model.driven_by:
        yield from driving[covariate](data)
    if conditions.angle_rad is not None:
        yield from _of_angle()
    yield from _of_time(data)
    if conditions.temperature_c is not None and np.ptp(conditions.temperature_c) > 0:
        yield from _of_scalar(
            "temperature", "T", "25 °C", _over("temperature_c", line_shape), REFERENCE_C, data
        )
        yield from _of_rate(data)
    if conditions.supply_v is not None and np.ptp(conditions.supply_v) > 0:
        yield from _of_scalar("supply", "V", "5 V", _over("supply_v", line_shape), REFERENCE_V, data)
    if conditions.line_hz is not None and np.ptp(conditions.line_hz) > 0:
        middle = float(conditions.line_hz.mean())
        zero, get = f"{middle:.4g} Hz", _over("line_hz", line_shape)
        yield from _of_scalar("line_frequency", "f", zero, get, middle, data)
    if conditions.approach is not None:
        yield _formula("approach", "approach", _over("approach", line_shape), ("gain",))
    if conditions.previous_angle_rad is not None:
        yield from _of_memory(data)
    yield from _products(data)


def _over(covariate: str, function: Shape) -> Columns:
    """Return a function of the conditions that applies `function` to the field `covariate` of them."""
    return lambda c: function(c.covariate(covariate))


def _formula(
    family: str,
    form: str,
    columns: Columns,
    places: Sequence[Where] = ("bias", "gain", "angle"),
    *,
    covariates: tuple[str, ...] = (),
    smooth: bool = False,
) -> _Made:
    """Return a candidate made from a function of the conditions.

    Parameters
    ----------
    family : str
        Covariate or group that shares one part of the prior.
    form : str
        Text for the function.
    columns : callable
        Function that computes the columns.
    places : sequence of str
        Places in the model that the function may enter.
    covariates : tuple of str
        Covariates of the function; by default `family`.
    smooth : bool
        True if the function approximates one without a formula, False for a formula.
    """

    def matrix(conditions: Conditions) -> Floats:
        rows = columns(conditions)
        return rows[:, None] if rows.ndim == 1 else rows

    return _Made(family, Basis(form, covariates or (family,), matrix, None, smooth), tuple(places))


def _with_constant(made: _Made) -> _Made:
    """Return a candidate that is a function of the conditions plus a constant bias, its first column."""

    def matrix(conditions: Conditions) -> Floats:
        assert made.basis.common is not None
        rows = made.basis.common(conditions)
        return np.hstack([np.ones((len(rows), 1)), rows])

    form = f"{made.basis.form} + const"
    return _Made(made.family, replace(made.basis, form=form, common=matrix, with_constant=True), ("bias",))


def _both(
    family: str, form: str, columns: Columns, named: Sequence[str] = (), **others: Any
) -> Iterator[_Made]:
    """Yield a formula as a candidate and, if no named effect has it, the formula plus a constant bias.

    `named` lists the places where the catalogue already contains this formula. The other parameters are as
    in `_formula`.
    """
    places = [place for place in get_args(Where) if place not in named]
    made = _formula(family, form, columns, places, **others)
    yield made
    if not named:
        yield _with_constant(made)


def _of_own(
    family: str, form: str, function: Shape, *, smooth: bool = False, constant: bool = False
) -> _Made:
    """Return a candidate that is a function of each axis's own reading, or of the rate about this axis.

    `family` is the covariate, `form` the text for the function; `smooth` is True if it only approximates a
    function, `constant` if it contains a constant.
    """

    def columns(driven: Floats, axis: int) -> Floats:
        rows = function(driven[:, axis])
        return rows[:, None] if rows.ndim == 1 else rows

    return _Made(family, Basis(form, (family,), None, columns, smooth, constant), ("bias",))


def _of_reading(data: Readings) -> Iterator[_Made]:
    """Yield functions of each axis's own reading a in g, and of the readings a_p of the other axes."""
    single: dict[str, Shape] = {
        "a⁴": lambda a: a**4,
        "a⁵": lambda a: a**5,
        "a⁶": lambda a: a**6,
        "a⁷": lambda a: a**7,
        "a|a|": lambda a: a * np.abs(a),
        "|a|³": lambda a: np.abs(a) ** 3,
        "sign a": np.sign,
        "√|a|": lambda a: np.sqrt(np.abs(a)),
        "sign a √|a|": lambda a: np.sign(a) * np.sqrt(np.abs(a)),
        "max(a, 0)²": lambda a: np.maximum(a, 0) ** 2,
        "min(a, 0)²": lambda a: np.minimum(a, 0) ** 2,
        "max(a, 0)³": lambda a: np.maximum(a, 0) ** 3,
        "min(a, 0)³": lambda a: np.minimum(a, 0) ** 3,
    }
    for knee in (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75):
        single[f"max(a − {knee:g} g, 0)"] = knee_shape(knee, 1.0)
    yield from (_of_own("reading", form, function) for form, function in single.items())
    cross: dict[str, Callable[[Floats, Floats], Floats]] = {
        "|a_p|": lambda a, p: np.abs(p),
        "a_p³": lambda a, p: p**3,
        "a a_p²": lambda a, p: a * p**2,
        "a² a_p": lambda a, p: a**2 * p,
        "a |a_p|": lambda a, p: a * np.abs(p),
        "a_p |a|": lambda a, p: np.abs(a) * p,
        "sign a_p": lambda a, p: np.sign(p),
        "a_p⁴": lambda a, p: p**4,
        "a_p⁵": lambda a, p: p**5,
        "a² a_p²": lambda a, p: (a * p) ** 2,
        "a³ a_p": lambda a, p: a**3 * p,
        "a a_p³": lambda a, p: a * p**3,
    }
    for form, pair in cross.items():

        def columns(ideal: Floats, axis: int, pair: Callable[[Floats, Floats], Floats] = pair) -> Floats:
            others = [k for k in range(ideal.shape[1]) if k != axis]
            return np.stack([pair(ideal[:, axis], ideal[:, k]) for k in others], axis=1)

        yield _Made("reading", Basis(form, ("reading",), by_axis=columns), ("bias",))
    # All powers up to the third degree are named effects.
    for degree in (4, 5, 6):
        form = f"a smooth function of the reading (degree {degree})"
        yield _of_own("reading", form, legendre(range(2, degree + 1)), smooth=True)
        with_constant = legendre([0, *range(2, degree + 1)])
        yield _of_own("reading", f"{form} + const", with_constant, smooth=True, constant=True)


def _of_force(data: Readings) -> Iterator[_Made]:
    """Yield functions of the accelerometer readings (the force) as candidates for a gyro.

    The components and their squares are omitted, because they are named effects.
    """
    if data.conditions.force_g is None:
        return

    def component(k: int, function: Shape) -> Columns:
        return _over("force_g", lambda f: function(f[:, k]))

    def difference(j: int, k: int) -> Columns:
        return _over("force_g", lambda f: (f[:, j] ** 2 - f[:, k] ** 2) / 2)

    moving = np.flatnonzero(np.ptp(data.conditions.force_g, axis=0) > 0).tolist()
    single: dict[str, Shape] = {
        "f³": lambda f: f**3,
        "|f|": np.abs,
        "f|f|": lambda f: f * np.abs(f),
        "sign f": np.sign,
        "max(f, 0)": lambda f: np.maximum(f, 0),
        "max(f, 0)²": lambda f: np.maximum(f, 0) ** 2,
        "min(f, 0)²": lambda f: np.minimum(f, 0) ** 2,
    }
    made = [
        (form.replace("f", f"f_{AXES[k]}"), component(k, function))
        for form, function in single.items()
        for k in moving
    ]
    for j, k in itertools.combinations(moving, 2):
        made.append((f"f_{AXES[j]} f_{AXES[k]}", _monomials([(j, k)])))
        made.append((f"(f_{AXES[j]}² − f_{AXES[k]}²)/2", difference(j, k)))
    yield from (_formula("force", form, columns, ("bias", "gain")) for form, columns in made)
    for degree in (2, 3):
        powers = [
            parts
            for count in range(1, degree + 1)
            for parts in itertools.combinations_with_replacement(moving, count)
            # If all components vary, x² + y² + z² = 1 g² makes products with z² redundant.
            if len(moving) < 3 or parts.count(2) < 2
        ]
        if len(powers) < len(data):
            form = f"a smooth function of the force (degree {degree})"
            yield _formula("force", form, _monomials(powers), ("bias",), smooth=True)


def _monomials(powers: Sequence[tuple[int, ...]]) -> Columns:
    return _over(
        "force_g", lambda f: np.stack([f[:, list(parts)].prod(axis=1) for parts in powers], axis=1)
    )


def _of_rotation(data: Readings) -> Iterator[_Made]:
    """Yield functions of the rate about a gyro's own axis as candidates.

    The straight line and the modulus are omitted, because they are named effects.
    """
    if data.conditions.rate_dps is None or not np.abs(data.conditions.rate_dps).max() > 0:
        return
    curves: dict[str, Shape] = {
        "ω²": lambda w: w**2,
        "ω³": lambda w: w**3,
        "ω|ω|": lambda w: w * np.abs(w),
        "sign ω": np.sign,
        "|sign ω|": lambda w: np.abs(np.sign(w)),
    }
    yield from (_of_own("rotation", form, function) for form, function in curves.items())


def _of_angle() -> Iterator[_Made]:
    """Yield functions of the stage's angle θ: harmonics, square waves, bumps, smooth functions."""

    def of_angle(form: str, function: Shape, *places: Where, smooth: bool = False) -> _Made:
        return _formula("angle", form, _over("angle_rad", function), places or ("bias",), smooth=smooth)

    # One cycle on an axis is gain and misalignment; cycles of the angle are named effects.
    for k in range(2, 7):
        yield of_angle(f"sin {k}θ, cos {k}θ", harmonics((k,)))
        yield of_angle(f"sin {k}θ", multiple(np.sin, k))
        yield of_angle(f"cos {k}θ", multiple(np.cos, k))
    turn = 2 * np.pi
    more: dict[str, Shape] = {
        "θ (along all turns)": lambda t: t / turn,
        "θ within a turn (saw-tooth)": lambda t: np.mod(t, turn) / np.pi - 1,
        "number of the turn": lambda t: np.floor(t / turn + 1e-9),
        "sign sin θ": lambda t: np.sign(np.round(np.sin(t), 9)),
        "sign cos θ": lambda t: np.sign(np.round(np.cos(t), 9)),
        "|sin θ|": lambda t: np.abs(np.sin(t)),
        "|cos θ|": lambda t: np.abs(np.cos(t)),
    }
    yield from (of_angle(form, function, "bias", "gain", "angle") for form, function in more.items())
    for centre, width in itertools.product(range(0, 360, 15), (8.0, 25.0)):
        bell = ring_bump(float(np.deg2rad(centre)), float(np.deg2rad(width)))
        yield of_angle(f"a bump at θ = {centre}° of width {width:g}°", bell, "bias", "angle")
    # Two harmonics are named effects: of the stage, and as products of readings on an axis.
    for top in (3, 4, 5, 6):
        form = f"a smooth function of the angle (harmonics to {top})"
        yield of_angle(form, harmonics(range(2, top + 1)), smooth=True)
        yield of_angle(form, harmonics(range(1, top + 1)), "angle", smooth=True)


def _scaled(values: Floats) -> tuple[float, float]:
    middle, half = (values.max() + values.min()) / 2, max((values.max() - values.min()) / 2, 1e-12)
    return float(middle), float(half)


def step_places(values: Floats, count: int) -> list[float]:
    """Return at most `count` values between the observed values of a covariate, as places for a step.

    They are at even quantiles, with at least two dwells on either side, because a step that separates a
    single dwell is an outlier, which is a named effect.
    """
    seen = np.unique(values)
    between = (seen[1:] + seen[:-1]) / 2
    pick = np.unique(np.linspace(0, len(between) - 1, min(count, len(between))).round().astype(int))
    return [float(b) for b in between[pick] if 2 <= np.count_nonzero(values < b) <= len(values) - 2]


@dataclass(frozen=True)
class _Course:
    """One covariate of the session, with methods that yield candidate functions of it.

    Attributes
    ----------
    family, letter, unit : str
        Name of the covariate, and its symbol and unit in the text for a function.
    sides : tuple of str
        Words for the upper and the lower side of a knee.
    get : callable
        Function that returns the covariate (n,) from the conditions.
    middle, half : float
        Middle of its range and half of the range.
    """

    family: str
    letter: str
    unit: str
    sides: tuple[str, str]
    get: Columns
    middle: float
    half: float

    def inside(self, function: Shape) -> Columns:
        """Return a function that computes `function` of the covariate scaled to −1 … 1."""
        return lambda c: function((self.get(c) - self.middle) / self.half)

    def steps_and_knees(self, knots: Sequence[float]) -> Iterator[_Made]:
        """Yield step functions with a step at each value in `knots`, and knees on an even grid."""
        for knot in knots:
            form = f"a step at {self.letter} = {knot:.4g}{self.unit}"
            yield from _both(self.family, form, self.inside(step_shape((knot - self.middle) / self.half)))
        for knot in np.linspace(self.middle - 0.8 * self.half, self.middle + 0.8 * self.half, 9):
            for side, sign in zip(self.sides, (1.0, -1.0), strict=True):
                form = f"a knee at {self.letter} = {knot:.4g}{self.unit} ({side})"
                shape = knee_shape((knot - self.middle) / self.half, sign)
                yield from _both(self.family, form, self.inside(shape))

    def bumps(self, widths: Sequence[float], digits: int) -> Iterator[_Made]:
        """Yield bell curves of each width, with centres on an even grid of the covariate.

        `widths` are in units of half the covariate's range; `digits` is the precision of the width in the
        text.
        """
        for knot in np.linspace(self.middle - 0.75 * self.half, self.middle + 0.75 * self.half, 7):
            for width in widths:
                size = f"{width * self.half:.{digits}g}{self.unit}"
                form = f"a bump at {self.letter} = {knot:.4g}{self.unit} of width {size}"
                shape = bump_shape((knot - self.middle) / self.half, width)
                yield from _both(self.family, form, self.inside(shape))

    def waves(self, count: int) -> Iterator[_Made]:
        """Yield `count` oscillations along the covariate, with geometrically spaced periods."""
        for cycles in np.geomspace(0.5, 0.5 * 2 ** ((count - 1) / 1.5), count).tolist():

            def columns(c: Conditions, cycles: float = cycles) -> Floats:
                turn = np.pi * cycles * (self.get(c) - self.middle) / self.half
                return np.stack([np.sin(turn), np.cos(turn)], axis=1)

            form = f"an oscillation of period {2 * self.half / cycles:.3g} in {self.letter}"
            yield _formula(self.family, form, columns)

    def polynomials(self, levels: int) -> Iterator[_Made]:
        """Yield polynomials of the covariate.

        Their degrees are less than `levels`, the number of values of the covariate in the session.
        """
        for degree in (2, 3, 4, 5, 6, 8):
            if degree < levels:
                form = f"a smooth function of {self.family} (degree {degree})"
                # On a bias, powers of the temperature up to the third are named effects.
                named = ("bias",) if self.family == "temperature" and degree <= 3 else ()
                columns = self.inside(legendre(range(1, degree + 1)))
                yield from _both(self.family, form, columns, named, smooth=True)


def _of_scalar(
    family: str, letter: str, zero: str, get: Columns, reference: float, data: Readings
) -> Iterator[_Made]:
    """Yield all candidate functions of one covariate, such as the temperature.

    They are lines, powers, steps, knees, exponentials, bumps, waves and polynomials.

    Parameters
    ----------
    family, letter : str
        Name of the covariate, and its symbol in formulas.
    zero : str
        Text for its reference value, such as `25 °C`.
    get : callable
        Function that returns the covariate (n,) from the conditions.
    reference : float
        Reference value, at which powers of the covariate are zero.
    """
    values = get(data.conditions)
    course = _Course(family, letter, "", ("above", "below"), get, *_scaled(values))
    half = course.half
    curves: dict[str, Shape] = {
        f"({letter} − {zero})": line_shape,
        f"({letter} − {zero})²": power_shape(2),
        f"({letter} − {zero})³": power_shape(3),
        f"|{letter} − {zero}|": np.abs,
    }
    named = data.model.named_forms.get(family, ())

    def about(function: Shape) -> Columns:
        return lambda c: function((get(c) - reference) / half)

    for form, function in curves.items():
        yield from _both(family, form, about(function), named if function is line_shape else ())
    yield from course.steps_and_knees(step_places(values, 12))
    for rate in (-3.0, -1.5, 1.5, 3.0):
        yield from _both(family, f"exp({rate / half:+.3g} {letter})", course.inside(growth_shape(rate)))
    yield from course.bumps((0.2, 0.45), 2)
    yield from course.waves(5)
    yield from course.polynomials(len(np.unique(values)))


def _of_time(data: Readings) -> Iterator[_Made]:
    """Yield functions of the time t since the start of the session, in units of the session's length."""
    time = data.conditions.time_s
    course = _Course("time", "t", " s", ("after", "before"), lambda c: c.time_s, *_scaled(time))
    length = 2 * course.half
    named = data.model.named_forms.get("time", ())
    yield from _both("time", "t", lambda c: c.time_s / length, named)
    yield from _both("time", "t²", lambda c: (c.time_s / length) ** 2)
    yield from _both("time", "t³", lambda c: (c.time_s / length) ** 3)
    yield from _both("time", "√t", lambda c: np.sqrt(np.maximum(c.time_s, 0) / length))
    yield from course.steps_and_knees(step_places(time, 60))
    for tau in np.geomspace(0.1, 2.0, 6).tolist():
        decay, growth = (course.inside(approach_shape(tau, sign)) for sign in (-1.0, 1.0))
        yield from _both("time", f"exp(−t/{length * tau:.3g} s)", decay, ("bias",))
        yield from _both("time", f"exp(+t/{length * tau:.3g} s)", growth)
    yield from course.bumps((0.15, 0.35), 3)
    yield from course.waves(7)
    yield from course.polynomials(len(time))


def _of_rate(data: Readings) -> Iterator[_Made]:
    """Yield functions of the temperature's rate of change and of lagged temperatures as candidates.

    They may also enter the gains and the angle.
    """
    history = data.conditions.temperature_history
    if history is None or len(history[0]) < 2:
        return
    length = float(np.ptp(data.conditions.time_s))
    step = length / max(len(data) - 1, 1)
    named = data.model.named_forms.get("temperature_rate", ())
    for tau in np.geomspace(0.5 * step, max(1.5 * length, step), 7).tolist():

        def late(c: Conditions, tau: float = tau) -> Floats:
            return c.late("temperature_history", None, tau)[0] - c.covariate("temperature_c")

        yield from _both("temperature_rate", f"T_lag − T with τ = {tau:.3g} s", late, named)

    def rate(c: Conditions) -> Floats:
        assert c.temperature_history is not None
        times, temperatures = c.temperature_history
        reach = max(step, 1e-9)
        ahead = np.interp(c.clock_s + reach / 2, times, temperatures)
        return (ahead - np.interp(c.clock_s - reach / 2, times, temperatures)) / reach

    middle, half = _scaled(rate(data.conditions))
    scale = max(abs(middle) + half, 1e-12)
    curves: dict[str, Shape] = {
        "dT/dt": line_shape,
        "|dT/dt|": np.abs,
        "sign dT/dt": np.sign,
        "(dT/dt)²": power_shape(2),
    }

    def scaled(function: Shape) -> Columns:
        return lambda c: function(rate(c) / scale)

    for form, function in curves.items() if half > 1e-9 else ():
        yield from _both("temperature_rate", form, scaled(function))


def _of_memory(data: Readings) -> Iterator[_Made]:
    """Yield functions of the previous angle θ′ of the stage, and of the move θ − θ′ from it."""

    def previous(form: str, function: Shape, smooth: bool = False) -> _Made:
        return _formula("previous_angle", form, _over("previous_angle_rad", function), smooth=smooth)

    def move(c: Conditions) -> Floats:
        return c.covariate("angle_rad") - c.covariate("previous_angle_rad")

    def of_move(function: Shape) -> Columns:
        return lambda c: function(move(c) / largest)

    largest = max(float(np.abs(move(data.conditions)).max()), 1e-9)
    for k in (1, 2, 3):
        yield previous(f"sin {k}θ′, cos {k}θ′ of the previous position", harmonics((k,)))
        yield previous(f"sin {k}θ′ of the previous position", multiple(np.sin, k))
        yield previous(f"cos {k}θ′ of the previous position", multiple(np.cos, k))
    moves: dict[str, Shape] = {
        "the move θ − θ′": line_shape,
        "|θ − θ′|": np.abs,
        "sign(θ − θ′)": lambda u: np.sign(np.round(u, 9)),
    }
    for form, function in moves.items():
        yield _formula("previous_angle", form, of_move(function))
    for top in (2, 3, 4):
        form = f"a smooth function of the previous position (harmonics to {top})"
        yield previous(form, harmonics(range(1, top + 1)), smooth=True)


@dataclass(frozen=True)
class _Factor:
    """A covariate that may be multiplied by another one.

    Attributes
    ----------
    name, letter : str
        Name of the covariate, and its symbol in formulas.
    get : callable
        Function that returns its values (n,) from the conditions.
    zero : float
        Value that counts as zero in a product, such as 25 °C.
    """

    name: str
    letter: str
    get: Columns
    zero: float = 0.0


def _factors(conditions: Conditions) -> Iterator[_Factor]:
    """Yield the recorded covariates that may be multiplied by each other."""
    yield _Factor("time", "t", lambda c: c.time_s)
    if conditions.temperature_c is not None:
        yield _Factor("temperature", "(T − 25 °C)", _over("temperature_c", line_shape), REFERENCE_C)
    if conditions.supply_v is not None:
        yield _Factor("supply", "(V − 5 V)", _over("supply_v", line_shape), REFERENCE_V)
    if conditions.approach is not None:
        yield _Factor("approach", "approach", _over("approach", line_shape))
    if conditions.angle_rad is not None and conditions.previous_angle_rad is not None:
        yield _Factor("previous_angle", "sin θ′", _over("previous_angle_rad", np.sin))


def _products(data: Readings) -> Iterator[_Made]:
    """Yield functions of two covariates; a covariate that hardly changes is omitted."""
    conditions = data.conditions
    # A covariate that hardly changes is a constant with noise: a product with it equals the other factor.
    least = {"temperature": limits.least_range_c, "supply": limits.least_range_v}
    moving = [f for f in _factors(conditions) if np.ptp(f.get(conditions)) > least.get(f.name, 0.0)]
    for one, two in itertools.combinations(moving, 2):
        yield from _product(one, two, conditions)
    if conditions.angle_rad is not None:
        for factor in moving:
            if factor.name in {"time", "temperature", "approach"}:
                yield from _cycles_times(factor, conditions)


def _cycles_times(factor: _Factor, conditions: Conditions) -> Iterator[_Made]:
    """Yield stage errors with one to three cycles per turn and an amplitude proportional to a covariate.

    In some orders of positions they look like errors of many cycles per turn and constant amplitude.
    """
    _, half = _scaled(factor.get(conditions))
    for cycles in (1, 2, 3):

        def columns(c: Conditions, cycles: int = cycles) -> Floats:
            waves = harmonics((cycles,))(c.covariate("angle_rad"))
            return np.asarray(waves * (factor.get(c) - factor.zero)[:, None] / half)

        form = f"{factor.letter} × (sin {cycles}θ, cos {cycles}θ)"
        yield _formula("products", form, columns, ("angle",), covariates=(factor.name, "angle"))


def _product(one: _Factor, two: _Factor, conditions: Conditions) -> Iterator[_Made]:
    """Yield candidate functions of two covariates: their product, and surfaces over both."""
    one_middle, one_half = _scaled(one.get(conditions))
    two_middle, two_half = _scaled(two.get(conditions))
    names = (one.name, two.name)

    def about(c: Conditions) -> Floats:
        return np.asarray((one.get(c) - one.zero) / one_half * (two.get(c) - two.zero) / two_half)

    def of(function: Callable[[Floats, Floats], Floats]) -> Columns:
        """Return columns that apply a function to both covariates, each scaled to −1 … 1."""
        return lambda c: function(
            (one.get(c) - one_middle) / one_half, (two.get(c) - two_middle) / two_half
        )

    letters = f"{one.letter} × {two.letter}"
    yield from _both("products", letters, about, covariates=names)
    yield from _both("products", f"{letters}, centred", of(np.multiply), covariates=names)
    form = f"a surface over {one.name} and {two.name}"
    surface = of(lambda u, v: np.stack([u, v, u * v], axis=1))
    made = _formula("products", form, surface, covariates=names, smooth=True)
    yield from (made, _with_constant(made))
    if "approach" not in names:
        curved = of(lambda u, v: np.stack([np.ones_like(u), u, v, u * v, u * u, v * v], axis=1))
        bent = "a curved " + form.removeprefix("a ")
        yield _formula("products", bent, curved, covariates=names, smooth=True)
