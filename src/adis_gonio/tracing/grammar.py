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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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


def harmonics(orders: Sequence[float]) -> Shape:
    """Return a function of an angle with sines and cosines of its multiples, (n, 2 len(orders))."""
    return lambda t: np.stack([f(k * t) for k in orders for f in (np.sin, np.cos)], axis=1)


@dataclass(frozen=True)
class _Function:
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


def _bases(data: Readings) -> Iterator[_Function]:
    """Yield all candidate functions that a session can show, one family of covariates after another."""
    conditions = data.conditions
    driving = {"reading": _of_reading, "force": _of_force, "rotation": _of_rotation}
    for covariate in data.model.driven_by:
        yield from driving[covariate](data)
    if conditions.angle_rad is not None:
        yield from _of_angle()
    recorded = _recorded(conditions)
    named = data.model.named_forms
    yield from _of_time(recorded["time"], named.get("time", ()))
    for name in ("temperature", "supply", "line_frequency"):
        if name in recorded and np.ptp(recorded[name].seen) > 0:
            yield from _of_scalar(recorded[name], named.get(name, ()))
            if name == "temperature":
                yield from _of_rate(data)
    if "approach" in recorded:
        yield _formula("approach", "approach", _over("approach"), ("gain",))
    if conditions.previous_angle_rad is not None:
        yield from _of_memory(data)
    yield from _products(recorded, conditions)


def _over(covariate: str, function: Shape = np.asarray) -> Columns:
    """Return a function of the conditions that applies `function` to the field `covariate` of them."""
    return lambda c: function(c.covariate(covariate))


def _as_columns(rows: Floats) -> Floats:
    """Return values (n,) as a column (n, 1), and columns (n, q) unchanged."""
    return rows.reshape(len(rows), -1)


def _formula(
    family: str,
    form: str,
    columns: Columns,
    places: Sequence[Where] = ("bias", "gain", "angle"),
    *,
    covariates: tuple[str, ...] = (),
    smooth: bool = False,
) -> _Function:
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
    basis = Basis(form, covariates or (family,), lambda c: _as_columns(columns(c)), None, smooth)
    return _Function(family, basis, tuple(places))


def _with_constant(plain: _Function) -> _Function:
    """Return a candidate that is a function of the conditions plus a constant bias, its first column."""

    def matrix(conditions: Conditions) -> Floats:
        assert plain.basis.common is not None
        rows = plain.basis.common(conditions)
        return np.hstack([np.ones((len(rows), 1)), rows])

    form = f"{plain.basis.form} + const"
    basis = replace(plain.basis, form=form, common=matrix, with_constant=True)
    return _Function(plain.family, basis, ("bias",))


def _variants(
    family: str, form: str, columns: Columns, named: Sequence[str] = (), **others: Any
) -> Iterator[_Function]:
    """Yield a formula as a candidate and, if no named effect has it, the formula plus a constant bias.

    `named` lists the places where the catalogue already contains this formula. The other parameters are as
    in `_formula`.
    """
    places = [place for place in get_args(Where) if place not in named]
    made = _formula(family, form, columns, places, **others)
    yield made
    if not named:
        yield _with_constant(made)


def _of_own_axis(
    family: str, form: str, function: Shape, *, smooth: bool = False, constant: bool = False
) -> _Function:
    """Return a candidate that is a function of each axis's own reading, or of the rate about this axis.

    `family` is the covariate, `form` the text for the function; `smooth` is True if it only approximates a
    function, `constant` if it contains a constant.
    """
    return _Function(
        family,
        Basis(form, (family,), None, lambda a, k: _as_columns(function(a[:, k])), smooth, constant),
        ("bias",),
    )


def _of_reading(data: Readings) -> Iterator[_Function]:
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
    yield from (_of_own_axis("reading", form, function) for form, function in single.items())
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

        yield _Function("reading", Basis(form, ("reading",), by_axis=columns), ("bias",))
    # All powers up to the third degree are named effects.
    for degree in (4, 5, 6):
        form = f"a smooth function of the reading (degree {degree})"
        yield _of_own_axis("reading", form, legendre(range(2, degree + 1)), smooth=True)
        with_constant = legendre([0, *range(2, degree + 1)])
        yield _of_own_axis("reading", f"{form} + const", with_constant, smooth=True, constant=True)


def _of_force(data: Readings) -> Iterator[_Function]:
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


def _of_rotation(data: Readings) -> Iterator[_Function]:
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
    yield from (_of_own_axis("rotation", form, function) for form, function in curves.items())


def _of_angle() -> Iterator[_Function]:
    """Yield functions of the stage's angle θ: harmonics, square waves, bumps, smooth functions."""

    def of_angle(form: str, function: Shape, *places: Where, smooth: bool = False) -> _Function:
        return _formula("angle", form, _over("angle_rad", function), places or ("bias",), smooth=smooth)

    # One cycle on an axis is gain and misalignment; cycles of the angle are named effects.
    yield from _waves("angle", "θ", range(2, 7), ("bias",))
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


def _waves(
    family: str, angle: str, orders: Sequence[int], places: Sequence[Where], ending: str = ""
) -> Iterator[_Function]:
    """Yield harmonics of an angle: sine and cosine of each multiple together, then each of them alone.

    `family` is the covariate, `angle` its symbol; `ending` follows the text for each function.
    """
    for k in orders:
        for form, function in (
            (f"sin {k}{angle}, cos {k}{angle}", harmonics((k,))),
            (f"sin {k}{angle}", multiple(np.sin, k)),
            (f"cos {k}{angle}", multiple(np.cos, k)),
        ):
            yield _formula(family, form + ending, _over(f"{family}_rad", function), places)


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
class _Covariate:
    """One covariate of the session.

    Attributes
    ----------
    name, letter : str
        Name of the covariate, and its symbol in the text for a function.
    distance : str
        Text for its difference from `zero`.
    get : callable
        Function that returns the covariate (n,) from the conditions.
    seen : (n,) float
        Its values in the session.
    zero : float
        Value that counts as zero in powers and products.
    """

    name: str
    letter: str
    distance: str
    get: Columns
    seen: Floats
    zero: float = 0.0

    @cached_property
    def middle(self) -> float:
        """Middle of the range of the values."""
        return float((self.seen.max() + self.seen.min()) / 2)

    @cached_property
    def half(self) -> float:
        """Half of the range of the values."""
        return float(max((self.seen.max() - self.seen.min()) / 2, 1e-12))

    def scaled(self, c: Conditions) -> Floats:
        """Return the covariate (n,) scaled to −1 … 1 over the session."""
        return (self.get(c) - self.middle) / self.half

    def inside(self, function: Shape) -> Columns:
        """Return a function that computes `function` of the covariate scaled to −1 … 1."""
        return lambda c: function(self.scaled(c))

    def from_zero(self, c: Conditions) -> Floats:
        """Return the difference (n,) of the covariate from its zero, in units of half the range."""
        return (self.get(c) - self.zero) / self.half


def _recorded(c: Conditions) -> dict[str, _Covariate]:
    """Return the recorded covariates that are not driven by an axis, by name."""
    hz = 0.0 if c.line_hz is None else float(c.line_hz.mean())
    before = None if c.angle_rad is None or c.previous_angle_rad is None else np.sin(c.previous_angle_rad)
    every = [
        ("time", "t", "t", _over("time_s"), c.time_s, 0.0),
        ("temperature", "T", "(T − 25 °C)", _over("temperature_c"), c.temperature_c, REFERENCE_C),
        ("supply", "V", "(V − 5 V)", _over("supply_v"), c.supply_v, REFERENCE_V),
        ("line_frequency", "f", f"(f − {hz:.4g} Hz)", _over("line_hz"), c.line_hz, hz),
        ("approach", "approach", "approach", _over("approach"), c.approach, 0.0),
        ("previous_angle", "θ′", "sin θ′", _over("previous_angle_rad", np.sin), before, 0.0),
    ]
    return {
        name: _Covariate(name, letter, distance, get, seen, zero)
        for name, letter, distance, get, seen, zero in every
        if seen is not None
    }


def _of_scalar(one: _Covariate, named: Sequence[str]) -> Iterator[_Function]:
    """Yield all candidate functions of one covariate, such as the temperature.

    `named` lists the places where a line is a named effect.
    """
    yield from _variants(one.name, one.distance, one.from_zero, named)
    yield from _variants(one.name, f"{one.distance}²", lambda c: one.from_zero(c) ** 2)
    yield from _variants(one.name, f"{one.distance}³", lambda c: one.from_zero(c) ** 3)
    yield from _variants(one.name, f"|{one.distance.strip('()')}|", lambda c: np.abs(one.from_zero(c)))
    for rate in (-3.0, -1.5, 1.5, 3.0):
        form = f"exp({rate / one.half:+.3g} {one.letter})"
        yield from _variants(one.name, form, one.inside(growth_shape(rate)))
    yield from _shapes_of(one, "", ("above", "below"), steps=12, widths=(0.2, 0.45), waves=5)


def _of_time(time: _Covariate, named: Sequence[str]) -> Iterator[_Function]:
    """Yield functions of the time t since the start of the session, in units of the session's length.

    `named` lists the places where a line is a named effect.
    """
    length = 2 * time.half
    yield from _variants("time", "t", lambda c: time.from_zero(c) / 2, named)
    yield from _variants("time", "t²", lambda c: (time.from_zero(c) / 2) ** 2)
    yield from _variants("time", "t³", lambda c: (time.from_zero(c) / 2) ** 3)
    yield from _variants("time", "√t", lambda c: np.sqrt(np.maximum(time.from_zero(c), 0) / 2))
    for tau in np.geomspace(0.1, 2.0, 6).tolist():
        decay, growth = (time.inside(approach_shape(tau, sign)) for sign in (-1.0, 1.0))
        yield from _variants("time", f"exp(−t/{length * tau:.3g} s)", decay, ("bias",))
        yield from _variants("time", f"exp(+t/{length * tau:.3g} s)", growth)
    yield from _shapes_of(time, " s", ("after", "before"), steps=60, widths=(0.15, 0.35), waves=7)


def _shapes_of(
    one: _Covariate,
    unit: str,
    sides: tuple[str, str],
    *,
    steps: int,
    widths: Sequence[float],
    waves: int,
) -> Iterator[_Function]:
    """Yield steps, knees, bumps, oscillations and polynomials of a covariate.

    Parameters
    ----------
    unit, sides : str, tuple of 2 str
        Unit of the covariate in a text; words for the upper and the lower side of a knee.
    steps, waves : int
        Largest number of steps, and the number of oscillations.
    widths : sequence of float
        Widths of bumps in units of half the covariate's range.
    """
    name, letter = one.name, one.letter
    for place in step_places(one.seen, steps):
        shape = step_shape((place - one.middle) / one.half)
        yield from _variants(name, f"a step at {letter} = {place:.4g}{unit}", one.inside(shape))
    for place in np.linspace(one.middle - 0.8 * one.half, one.middle + 0.8 * one.half, 9):
        for side, sign in zip(sides, (1.0, -1.0), strict=True):
            shape = knee_shape((place - one.middle) / one.half, sign)
            form = f"a knee at {letter} = {place:.4g}{unit} ({side})"
            yield from _variants(name, form, one.inside(shape))
    for place in np.linspace(one.middle - 0.75 * one.half, one.middle + 0.75 * one.half, 7):
        for width in widths:
            form = f"a bump at {letter} = {place:.4g}{unit} of width {width * one.half:.3g}{unit}"
            yield from _variants(name, form, one.inside(bump_shape((place - one.middle) / one.half, width)))
    # Oscillations with geometrically spaced periods.
    for cycles in np.geomspace(0.5, 0.5 * 2 ** ((waves - 1) / 1.5), waves).tolist():
        form = f"an oscillation of period {2 * one.half / cycles:.3g} in {letter}"
        yield _formula(name, form, one.inside(harmonics((np.pi * cycles,))))
    for degree in (2, 3, 4, 5, 6, 8):
        if degree < len(np.unique(one.seen)):
            # On a bias, powers of the temperature up to the third are named effects.
            named = ("bias",) if name == "temperature" and degree <= 3 else ()
            form = f"a smooth function of {name} (degree {degree})"
            shape = legendre(range(1, degree + 1))
            yield from _variants(name, form, one.inside(shape), named, smooth=True)


def _of_rate(data: Readings) -> Iterator[_Function]:
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

        yield from _variants("temperature_rate", f"T_lag − T with τ = {tau:.3g} s", late, named)

    def rate(c: Conditions) -> Floats:
        assert c.temperature_history is not None
        times, temperatures = c.temperature_history
        reach = max(step, 1e-9)
        ahead = np.interp(c.clock_s + reach / 2, times, temperatures)
        return (ahead - np.interp(c.clock_s - reach / 2, times, temperatures)) / reach

    seen = rate(data.conditions)
    scale = max(float(np.abs(seen).max()), 1e-12)
    curves: dict[str, Shape] = {
        "dT/dt": np.asarray,
        "|dT/dt|": np.abs,
        "sign dT/dt": np.sign,
        "(dT/dt)²": np.square,
    }

    def scaled(function: Shape) -> Columns:
        return lambda c: function(rate(c) / scale)

    for form, function in curves.items() if np.ptp(seen) > 2e-9 else ():
        yield from _variants("temperature_rate", form, scaled(function))


def _of_memory(data: Readings) -> Iterator[_Function]:
    """Yield functions of the previous angle θ′ of the stage, and of the move θ − θ′ from it."""

    def move(c: Conditions) -> Floats:
        return c.covariate("angle_rad") - c.covariate("previous_angle_rad")

    def of_move(function: Shape) -> Columns:
        return lambda c: function(move(c) / largest)

    largest = max(float(np.abs(move(data.conditions)).max()), 1e-9)
    family = "previous_angle"
    yield from _waves(family, "θ′", (1, 2, 3), ("bias", "gain", "angle"), " of the previous position")
    moves: dict[str, Shape] = {
        "the move θ − θ′": np.asarray,
        "|θ − θ′|": np.abs,
        "sign(θ − θ′)": lambda u: np.sign(np.round(u, 9)),
    }
    for form, function in moves.items():
        yield _formula(family, form, of_move(function))
    for top in (2, 3, 4):
        form = f"a smooth function of the previous position (harmonics to {top})"
        yield _formula(family, form, _over(f"{family}_rad", harmonics(range(1, top + 1))), smooth=True)


def _products(recorded: Mapping[str, _Covariate], conditions: Conditions) -> Iterator[_Function]:
    """Yield functions of two `recorded` covariates; a covariate that hardly changes is omitted."""
    # A covariate that hardly changes is a constant with noise: a product with it equals the other factor.
    least = {"temperature": limits.least_range_c, "supply": limits.least_range_v, "line_frequency": np.inf}
    moving = [one for one in recorded.values() if np.ptp(one.seen) > least.get(one.name, 0.0)]
    for one, two in itertools.combinations(moving, 2):
        yield from _product(one, two)
    if conditions.angle_rad is not None:
        for factor in moving:
            if factor.name in {"time", "temperature", "approach"}:
                yield from _cycles_times(factor)


def _cycles_times(factor: _Covariate) -> Iterator[_Function]:
    """Yield stage errors with one to three cycles per turn and an amplitude proportional to a covariate.

    In some orders of positions they look like errors of many cycles per turn and constant amplitude.
    """
    for cycles in (1, 2, 3):

        def columns(c: Conditions, cycles: int = cycles) -> Floats:
            waves = harmonics((cycles,))(c.covariate("angle_rad"))
            return np.asarray(waves * factor.from_zero(c)[:, None])

        form = f"{factor.distance} × (sin {cycles}θ, cos {cycles}θ)"
        yield _formula("products", form, columns, ("angle",), covariates=(factor.name, "angle"))


def _product(one: _Covariate, two: _Covariate) -> Iterator[_Function]:
    """Yield candidate functions of two covariates: their product, and surfaces over both."""
    names = (one.name, two.name)

    def of(function: Callable[[Floats, Floats], Floats]) -> Columns:
        """Return columns that apply a function to both covariates, each scaled to −1 … 1."""
        return lambda c: function(one.scaled(c), two.scaled(c))

    letters = f"{one.distance} × {two.distance}"
    yield from _variants(
        "products", letters, lambda c: one.from_zero(c) * two.from_zero(c), covariates=names
    )
    yield from _variants("products", f"{letters}, centred", of(np.multiply), covariates=names)
    form = f"a surface over {one.name} and {two.name}"
    surface = of(lambda u, v: np.stack([u, v, u * v], axis=1))
    made = _formula("products", form, surface, covariates=names, smooth=True)
    yield from (made, _with_constant(made))
    if "approach" not in names:
        curved = of(lambda u, v: np.stack([np.ones_like(u), u, v, u * v, u * u, v * v], axis=1))
        bent = "a curved " + form.removeprefix("a ")
        yield _formula("products", bent, curved, covariates=names, smooth=True)
