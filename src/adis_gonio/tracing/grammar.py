"""The grammar of nameless terms: where a cause enters × what it depends on.

Where: a bias of an axis, a gain of an axis, its misalignment against the others, the true angle. What: a
power, modulus or sign of the reading; a harmonic of the stage; temperature, time, supply, approach, the
previous position, the temperature's rate, products of two; by a line, a power, a step, a knee, an
exponential, a lag, an oscillation, a bump; and smooth functions (polynomials of growing degree), which
stand for everything that no formula names. What takes the place of the reading is a fact of the measurement
(`Measurement.driven_by`): of a gyro force and rotation.

Covariates are used in normal form: centred on the middle of what the session saw and scaled to ±1, except
where a zero means something (25 °C, 5 V, the session's start). A function whose zero means nothing also
stands with a constant beside it, so that its constant is not taken for a bias.

Shapes of the grammar: functions of one covariate in normal form (−1 to 1), made from their places.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Where
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.effects.base import lagged
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.tracing.thresholds import limits

Shape = Callable[[Floats], Floats]


def line_shape(u: Floats) -> Floats:
    """U."""
    return u


def power_shape(exponent: int) -> Shape:
    """Power of u."""

    def raised(u: Floats) -> Floats:
        out = u.copy()
        for _ in range(exponent - 1):
            out = out * u
        return out

    return raised


def step_shape(place: float) -> Shape:
    """0 up to a place, 1 beyond."""
    return lambda u: np.where(u > place, 1.0, 0.0)


def knee_shape(place: float, sign: float) -> Shape:
    """0 on one side of a place, a line on the other."""
    return lambda u: np.maximum(sign * (u - place), 0)


def growth_shape(rate: float) -> Shape:
    """exp(rate u), at most 1 inside."""
    return lambda u: np.exp(rate * u - abs(rate))


def approach_shape(time_constant: float, sign: float) -> Shape:
    """Exponential from (sign −1) or towards (sign 1) an end; in lengths of the session."""
    return lambda u: np.exp((sign * (u + 1) / 2 - (sign > 0)) / time_constant)


def bump_shape(place: float, width: float) -> Shape:
    """Gaussian bell."""
    return lambda u: np.exp(-0.5 * ((u - place) / width) ** 2)


def ring_bump(centre_rad: float, width_rad: float) -> Shape:
    """Bell on the circle."""
    return lambda t: np.exp((np.cos(t - centre_rad) - 1) / width_rad**2)


def multiple(function: Callable[..., Floats], times: int) -> Shape:
    """function(times · u)."""
    return lambda u: np.asarray(function(times * u))


def legendre(degree: int) -> Shape:
    """Legendre polynomial."""
    coefficients = np.zeros(degree + 1)
    coefficients[degree] = 1.0
    return lambda u: np.asarray(np.polynomial.legendre.legval(u, coefficients))


COMMON = ("reading", "force", "rotation", "angle", "time", "temperature")
"""Covariates of full weight; supply, approach, memory and products are less likely causes."""

EVERYWHERE: tuple[Where, ...] = ("bias", "gain", "misalignment", "angle")


@dataclass(frozen=True)
class _Made:
    """Basis functions with their place in the prior."""

    family: str
    smooth: bool
    basis: Basis
    places: tuple[Where, ...] = ("bias", "gain", "angle")


def nameless_terms(data: Readings) -> list[NamelessTerm]:
    """All nameless candidates of a session with their price."""
    made = list(_bases(data))
    families = sorted({m.family for m in made})
    weight = {family: 1.0 if family in COMMON else limits.family_weight for family in families}
    total = sum(weight.values())
    placed: dict[tuple[str, bool], list[tuple[_Made, Where, tuple[int, ...]]]] = {}
    subsets = [
        subset
        for size in range(1, data.axes + 1)
        for subset in itertools.combinations(range(data.axes), size)
    ]
    for m in made:
        for where in m.places:
            if where == "angle":
                if data.planar and m.basis.common is not None:
                    placed.setdefault((m.family, m.smooth), []).append((m, where, ()))
                continue
            for subset in subsets:
                placed.setdefault((m.family, m.smooth), []).append((m, where, subset))
    terms = []
    stimulus = data.model.stimulus
    marked = {id(m): replace(m.basis, approximates=m.smooth) for m in made}
    for (family, smooth), members in placed.items():
        both = (family, not smooth) in placed
        part = (limits.smooth_weight if smooth else 1 - limits.smooth_weight) if both else 1.0
        share = limits.nameless_share * weight[family] / total * part / len(members)
        for m, where, subset in members:
            if data.model.constant and m.basis.with_constant:
                continue  # the base model has the constant; the form without it keeps its own share
            axes = "".join("xyz"[k] for k in subset)
            label = f"{where}[{axes}]~{m.basis.form}" if axes else f"{where}~{m.basis.form}"
            terms.append(
                NamelessTerm(
                    label,
                    m.basis.covariates,
                    -math.log(share),
                    where,
                    subset,
                    marked[id(m)],
                    stimulus=stimulus,
                )
            )
    return terms


def _bases(data: Readings) -> Iterator[_Made]:
    conditions = data.conditions
    for covariate in data.model.driven_by:
        yield from _OF_COVARIATE[covariate](data)
    if conditions.angle_rad is not None:
        yield from _of_angle(data)
    yield from _of_time(data)
    if conditions.temperature_c is not None and np.ptp(conditions.temperature_c) > 0:
        yield from _of_scalar(
            "temperature", "T", "25 °C", lambda c: c.covariate("temperature_c"), REFERENCE_C, data
        )
        yield from _of_rate(data)
    if conditions.supply_v is not None and np.ptp(conditions.supply_v) > 0:
        yield from _of_scalar("supply", "V", "5 V", lambda c: c.covariate("supply_v"), REFERENCE_V, data)
    if conditions.approach is not None:
        yield from _of_approach()
    if conditions.previous_angle_rad is not None:
        yield from _of_memory(data)
    yield from _products(data)


def _column(function: Callable[[Conditions], Floats]) -> Callable[[Conditions], Floats]:
    return lambda conditions: function(conditions)[:, None]


def _of_rows(
    function: Shape, get: Callable[[Conditions], Floats], scale: float
) -> Callable[[Conditions], Floats]:
    return lambda conditions: function(get(conditions) / scale)


def _with_constant(function: Callable[[Conditions], Floats]) -> Callable[[Conditions], Floats]:
    def columns(conditions: Conditions) -> Floats:
        rows = function(conditions)
        rows = rows[:, None] if rows.ndim == 1 else rows
        return np.hstack([np.ones((len(rows), 1)), rows])

    return columns


def _both(
    family: str,
    covariates: tuple[str, ...],
    form: str,
    function: Callable[[Conditions], Floats],
    named: Sequence[str] = (),
) -> Iterator[_Made]:
    """A formula as it stands, and with a constant beside it where a constant is not in the base model.

    `named` are the places where the catalogue has this formula already.
    """
    basis = Basis(form, covariates, _column(function))
    if named:
        places: tuple[Where, ...] = tuple(place for place in EVERYWHERE if place not in named)
        yield _Made(family, False, basis, places)
        return
    yield _Made(family, False, basis, EVERYWHERE)
    yield _Made(
        family,
        False,
        replace(basis, form=form + " + const", common=_with_constant(function), with_constant=True),
        ("bias",),
    )


def _of_reading(data: Readings) -> Iterator[_Made]:
    def own(function: Callable[[Floats], Floats]) -> Callable[[Floats, int], Floats]:
        return lambda ideal, axis: function(ideal[:, axis])[:, None]

    def across(function: Callable[[Floats, Floats], Floats]) -> Callable[[Floats, int], Floats]:
        def columns(ideal: Floats, axis: int) -> Floats:
            others = [k for k in range(ideal.shape[1]) if k != axis]
            return np.stack([function(ideal[:, axis], ideal[:, k]) for k in others], axis=1)

        return columns

    single: dict[str, Callable[[Floats], Floats]] = {
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
    for form, function in single.items():
        yield _Made("reading", False, Basis(form, ("reading",), by_axis=own(function)), ("bias",))
    for knee in (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75):
        yield _Made(
            "reading",
            False,
            Basis(
                f"max(a − {knee:g} g, 0)",
                ("reading",),
                by_axis=own(knee_shape(knee, 1.0)),
            ),
            ("bias",),
        )
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
        yield _Made("reading", False, Basis(form, ("reading",), by_axis=across(pair)), ("bias",))
    # Up to the third degree every power has a name.
    for degree in (4, 5, 6):

        def powers(ideal: Floats, axis: int, degree: int = degree) -> Floats:
            a = ideal[:, axis]
            return np.stack([legendre(k)(a) for k in range(2, degree + 1)], axis=1)

        def powers_and_constant(ideal: Floats, axis: int, degree: int = degree) -> Floats:
            a = ideal[:, axis]
            return np.stack([legendre(k)(a) for k in [0, *range(2, degree + 1)]], axis=1)

        form = f"a smooth function of the reading (degree {degree})"
        basis = Basis(form, ("reading",), by_axis=powers)
        yield _Made("reading", True, basis, ("bias",))
        yield _Made(
            "reading",
            True,
            Basis(form + " + const", ("reading",), by_axis=powers_and_constant, with_constant=True),
            ("bias",),
        )


def _of_force(data: Readings) -> Iterator[_Made]:
    """Functions of what the accelerometers read; the components and their squares have names."""
    force = data.conditions.force_g
    if force is None:
        return

    def of(function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return lambda c: function(c.covariate("force_g"))[:, None]

    def one(k: int, function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return of(lambda f: function(f[:, k]))

    moving = [k for k in range(3) if np.ptp(force[:, k]) > 0]
    single: dict[str, Callable[[Floats], Floats]] = {
        "f³": lambda f: f**3,
        "|f|": np.abs,
        "f|f|": lambda f: f * np.abs(f),
        "sign f": np.sign,
        "max(f, 0)": lambda f: np.maximum(f, 0),
        "max(f, 0)²": lambda f: np.maximum(f, 0) ** 2,
        "min(f, 0)²": lambda f: np.minimum(f, 0) ** 2,
    }
    made = [
        (form.replace("f", f"f_{AXES[k]}"), one(k, function))
        for form, function in single.items()
        for k in moving
    ]
    for j, k in itertools.combinations(moving, 2):
        made.append((f"f_{AXES[j]} f_{AXES[k]}", _monomials([(j, k)])))
        made.append((f"(f_{AXES[j]}² − f_{AXES[k]}²)/2", _difference(j, k)))
    for form, function in made:
        yield _Made("force", False, Basis(form, ("force",), function), ("bias", "gain"))
    for degree in (2, 3):
        powers = _powers(moving, degree)
        if len(powers) < len(data):
            form = f"a smooth function of the force (degree {degree})"
            yield _Made("force", True, Basis(form, ("force",), _monomials(powers)), ("bias",))


def _difference(j: int, k: int) -> Callable[[Conditions], Floats]:
    """Half the difference of the squares of two components."""

    def column(c: Conditions) -> Floats:
        force = c.covariate("force_g")
        return (force[:, [j]] ** 2 - force[:, [k]] ** 2) / 2

    return column


def _powers(moving: Sequence[int], degree: int) -> list[tuple[int, ...]]:
    """Products of up to `degree` components; z² is left out where 1 g has it: x² + y² + z²."""
    made = [
        parts
        for count in range(1, degree + 1)
        for parts in itertools.combinations_with_replacement(moving, count)
    ]
    return [parts for parts in made if len(moving) < 3 or parts.count(2) < 2]


def _monomials(powers: Sequence[tuple[int, ...]]) -> Callable[[Conditions], Floats]:
    def columns(c: Conditions) -> Floats:
        force = c.covariate("force_g")
        return np.stack([force[:, list(parts)].prod(axis=1) for parts in powers], axis=1)

    return columns


def _of_rotation(data: Readings) -> Iterator[_Made]:
    """Functions of the rate about the axis itself; the line and the modulus have names."""
    if data.conditions.rate_dps is None or not np.abs(data.conditions.rate_dps).max() > 0:
        return
    curves: dict[str, Callable[[Floats], Floats]] = {
        "ω²": lambda w: w**2,
        "ω³": lambda w: w**3,
        "ω|ω|": lambda w: w * np.abs(w),
        "sign ω": np.sign,
        "|sign ω|": lambda w: np.abs(np.sign(w)),
    }

    def own(function: Callable[[Floats], Floats]) -> Callable[[Floats, int], Floats]:
        return lambda rate, axis: function(rate[:, axis])[:, None]

    for form, function in curves.items():
        yield _Made("rotation", False, Basis(form, ("rotation",), by_axis=own(function)), ("bias",))


_OF_COVARIATE: dict[str, Callable[[Readings], Iterator[_Made]]] = {
    "reading": _of_reading,
    "force": _of_force,
    "rotation": _of_rotation,
}
"""Functions of what a measurement is driven by (`Measurement.driven_by`)."""


def _of_angle(data: Readings) -> Iterator[_Made]:
    def harmonic(orders: tuple[int, ...]) -> Callable[[Conditions], Floats]:
        def columns(conditions: Conditions) -> Floats:
            theta = conditions.covariate("angle_rad")
            return np.stack([f(k * theta) for k in orders for f in (np.sin, np.cos)], axis=1)

        return columns

    def of_angle(function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return lambda c: function(c.covariate("angle_rad"))[:, None]

    # One cycle of an axis is gain and misalignment; cycles of the angle have names.
    for k in range(2, 7):
        yield _Made("angle", False, Basis(f"sin {k}θ, cos {k}θ", ("angle",), harmonic((k,))), ("bias",))
        for word, f in (("sin", np.sin), ("cos", np.cos)):
            yield _Made(
                "angle",
                False,
                Basis(f"{word} {k}θ", ("angle",), of_angle(multiple(f, k))),
                ("bias",),
            )
    turn = 2 * np.pi
    more: dict[str, Callable[[Floats], Floats]] = {
        "θ (along all turns)": lambda t: t / turn,
        "θ within a turn (saw-tooth)": lambda t: np.mod(t, turn) / np.pi - 1,
        "number of the turn": lambda t: np.floor(t / turn + 1e-9),
        "sign sin θ": lambda t: np.sign(np.round(np.sin(t), 9)),
        "sign cos θ": lambda t: np.sign(np.round(np.cos(t), 9)),
        "|sin θ|": lambda t: np.abs(np.sin(t)),
        "|cos θ|": lambda t: np.abs(np.cos(t)),
    }
    for form, function in more.items():
        yield _Made("angle", False, Basis(form, ("angle",), of_angle(function)))
    for centre in range(0, 360, 15):
        for width in (8.0, 25.0):
            form = f"a bump at θ = {centre}° of width {width:g}°"
            yield _Made(
                "angle",
                False,
                Basis(
                    form,
                    ("angle",),
                    of_angle(ring_bump(float(np.deg2rad(centre)), float(np.deg2rad(width)))),
                ),
                ("bias", "angle"),
            )
    # Two harmonics have names: of the stage, and as products of readings on an axis.
    for top in (3, 4, 5, 6):
        form = f"a smooth function of the angle (harmonics to {top})"
        yield _Made("angle", True, Basis(form, ("angle",), harmonic(tuple(range(2, top + 1)))), ("bias",))
        yield _Made("angle", True, Basis(form, ("angle",), harmonic(tuple(range(1, top + 1)))), ("angle",))


def _scaled(values: Floats) -> tuple[float, float]:
    middle, half = (values.max() + values.min()) / 2, max((values.max() - values.min()) / 2, 1e-12)
    return float(middle), float(half)


def _knots(values: Floats, count: int) -> list[float]:
    """Places between the values seen, at even quantiles, with two dwells on either side.

    What parts off one dwell is an outlier, which has a name.
    """
    seen = np.unique(values)
    between = (seen[1:] + seen[:-1]) / 2
    pick = np.unique(np.linspace(0, len(between) - 1, min(count, len(between))).round().astype(int))
    return [float(b) for b in between[pick] if 2 <= np.count_nonzero(values < b) <= len(values) - 2]


def _of_scalar(
    family: str,
    letter: str,
    zero: str,
    get: Callable[[Conditions], Floats],
    reference: float,
    data: Readings,
) -> Iterator[_Made]:
    """Lines, powers, steps, knees, exponentials, bumps and smooth functions of one covariate."""
    values = get(data.conditions)
    middle, half = _scaled(values)
    d = f"({letter} − {zero})"

    def about(function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return lambda c: function((get(c) - reference) / half)

    def inside(function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return lambda c: function((get(c) - middle) / half)

    covariates = (family,)
    named = data.model.named_forms.get(family, ())
    yield from _both(family, covariates, f"{d}", about(line_shape), named)
    curves: dict[str, Shape] = {
        f"{d}²": power_shape(2),
        f"{d}³": power_shape(3),
        f"|{letter} − {zero}|": np.abs,
    }
    for form, function in curves.items():
        yield from _both(family, covariates, form, about(function))
    for knot in _knots(values, 12):
        place = (knot - middle) / half
        yield from _both(family, covariates, f"a step at {letter} = {knot:.4g}", inside(step_shape(place)))
    for knot in np.linspace(middle - 0.8 * half, middle + 0.8 * half, 9):
        place = (knot - middle) / half
        for side, sign in (("above", 1.0), ("below", -1.0)):
            yield from _both(
                family,
                covariates,
                f"a knee at {letter} = {knot:.4g} ({side})",
                inside(knee_shape(place, sign)),
            )
    for rate in (-3.0, -1.5, 1.5, 3.0):
        yield from _both(
            family,
            covariates,
            f"exp({rate / half:+.3g} {letter})",
            inside(growth_shape(rate)),
        )
    for knot in np.linspace(middle - 0.75 * half, middle + 0.75 * half, 7):
        for width in (0.2, 0.45):
            place = (knot - middle) / half
            yield from _both(
                family,
                covariates,
                f"a bump at {letter} = {knot:.4g} of width {width * half:.2g}",
                inside(bump_shape(place, width)),
            )
    yield from _waves(family, letter, get, middle, half, 5)
    yield from _smooth(family, get, middle, half, len(np.unique(values)))


def _waves(
    family: str, letter: str, get: Callable[[Conditions], Floats], middle: float, half: float, count: int
) -> Iterator[_Made]:
    for cycles in np.geomspace(0.5, 0.5 * 2 ** ((count - 1) / 1.5), count):

        def columns(c: Conditions, cycles: float = float(cycles)) -> Floats:
            turn = np.pi * cycles * (get(c) - middle) / half
            return np.stack([np.sin(turn), np.cos(turn)], axis=1)

        form = f"an oscillation of period {2 * half / cycles:.3g} in {letter}"
        yield _Made(family, False, Basis(form, (family,), columns))


def _smooth(
    family: str, get: Callable[[Conditions], Floats], middle: float, half: float, levels: int
) -> Iterator[_Made]:
    for degree in (2, 3, 4, 5, 6, 8):
        if degree >= levels:
            continue

        def columns(c: Conditions, degree: int = degree) -> Floats:
            u = (get(c) - middle) / half
            return np.stack([legendre(k)(u) for k in range(1, degree + 1)], axis=1)

        form = f"a smooth function of {family} (degree {degree})"
        if family == "temperature" and degree <= 3:
            # On a bias the powers up to the third have a name.
            yield _Made(family, True, Basis(form, (family,), columns), ("gain", "misalignment", "angle"))
            continue
        yield _Made(family, True, Basis(form, (family,), columns), EVERYWHERE)
        yield _Made(
            family,
            True,
            Basis(form + " + const", (family,), _with_constant(columns), with_constant=True),
            ("bias",),
        )


def _of_time(data: Readings) -> Iterator[_Made]:
    time = data.conditions.time_s
    middle, half = _scaled(time)

    def get(c: Conditions) -> Floats:
        return c.time_s

    def inside(function: Callable[[Floats], Floats]) -> Callable[[Conditions], Floats]:
        return lambda c: function((c.time_s - middle) / half)

    covariates = ("time",)
    named = data.model.named_forms.get("time", ())
    yield from _both("time", covariates, "t", lambda c: c.time_s / (2 * half), named)
    yield from _both("time", covariates, "t²", lambda c: (c.time_s / (2 * half)) ** 2)
    yield from _both("time", covariates, "t³", lambda c: (c.time_s / (2 * half)) ** 3)
    yield from _both("time", covariates, "√t", lambda c: np.sqrt(np.maximum(c.time_s, 0) / (2 * half)))
    for knot in _knots(time, 60):
        place = (knot - middle) / half
        yield from _both("time", covariates, f"a step at t = {knot:.4g} s", inside(step_shape(place)))
    for knot in np.linspace(middle - 0.8 * half, middle + 0.8 * half, 9):
        place = (knot - middle) / half
        for side, sign in (("after", 1.0), ("before", -1.0)):
            yield from _both(
                "time",
                covariates,
                f"a knee at t = {knot:.4g} s ({side})",
                inside(knee_shape(place, sign)),
            )
    for tau in np.geomspace(0.1, 2.0, 6):
        for word, sign in (("−", -1.0), ("+", 1.0)):
            yield from _both(
                "time",
                covariates,
                f"exp({word}t/{2 * half * tau:.3g} s)",
                inside(approach_shape(float(tau), sign)),
                ("bias",) if sign < 0 else (),
            )
    for knot in np.linspace(middle - 0.75 * half, middle + 0.75 * half, 7):
        for width in (0.15, 0.35):
            place = (knot - middle) / half
            yield from _both(
                "time",
                covariates,
                f"a bump at t = {knot:.4g} s of width {width * half:.3g} s",
                inside(bump_shape(place, width)),
            )
    yield from _waves("time", "t", get, middle, half, 7)
    yield from _smooth("time", get, middle, half, len(time))


def _of_rate(data: Readings) -> Iterator[_Made]:
    """Rate of the temperature, and temperatures that lag, at the gains and the angle as well."""
    history = data.conditions.temperature_history
    if history is None or len(history[0]) < 2:
        return
    length = float(np.ptp(data.conditions.time_s))
    step = length / max(len(data) - 1, 1)
    named = data.model.named_forms.get("temperature_rate", ())
    for tau in np.geomspace(0.5 * step, max(1.5 * length, step), 7):

        def late(c: Conditions, tau: float = float(tau)) -> Floats:
            assert c.temperature_history is not None
            return lagged(*c.temperature_history, c.time_s, tau)[0] - c.covariate("temperature_c")

        yield from _both(
            "temperature_rate", ("temperature_rate",), f"T_lag − T with τ = {tau:.3g} s", late, named
        )

    def rate(c: Conditions) -> Floats:
        assert c.temperature_history is not None
        times, temperatures = c.temperature_history
        reach = max(step, 1e-9)
        ahead = np.interp(c.time_s + reach / 2, times, temperatures)
        return (ahead - np.interp(c.time_s - reach / 2, times, temperatures)) / reach

    middle, half = _scaled(rate(data.conditions))
    if half > 1e-9:
        curves: dict[str, Shape] = {
            "dT/dt": line_shape,
            "|dT/dt|": np.abs,
            "sign dT/dt": np.sign,
            "(dT/dt)²": power_shape(2),
        }
        for form, function in curves.items():
            scale = max(abs(middle) + half, 1e-12)
            yield from _both(
                "temperature_rate",
                ("temperature_rate",),
                form,
                _of_rows(function, rate, scale),
            )


def _of_approach() -> Iterator[_Made]:
    def side(c: Conditions) -> Floats:
        return c.covariate("approach")

    yield _Made("approach", False, Basis("approach", ("approach",), _column(side)), ("gain",))


def _of_memory(data: Readings) -> Iterator[_Made]:
    family, covariates = "previous_angle", ("previous_angle",)

    def previous(c: Conditions) -> Floats:
        return c.covariate("previous_angle_rad")

    def move(c: Conditions) -> Floats:
        return c.covariate("angle_rad") - previous(c)

    for k in (1, 2, 3):

        def pair(c: Conditions, k: int = k) -> Floats:
            return np.stack([np.sin(k * previous(c)), np.cos(k * previous(c))], axis=1)

        yield _Made(
            family, False, Basis(f"sin {k}θ′, cos {k}θ′ of the previous position", covariates, pair)
        )
        for word, f in (("sin", np.sin), ("cos", np.cos)):
            yield _Made(
                family,
                False,
                Basis(
                    f"{word} {k}θ′ of the previous position",
                    covariates,
                    _column(_of_rows(multiple(f, k), previous, 1.0)),
                ),
            )
    largest = max(float(np.abs(move(data.conditions)).max()), 1e-9)
    moves: dict[str, Shape] = {
        "the move θ − θ′": line_shape,
        "|θ − θ′|": np.abs,
        "sign(θ − θ′)": lambda u: np.sign(np.round(u, 9)),
    }
    for form, function in moves.items():
        yield _Made(
            family,
            False,
            Basis(form, covariates, _column(_of_rows(function, move, largest))),
        )
    for top in (2, 3, 4):

        def columns(c: Conditions, top: int = top) -> Floats:
            return np.stack(
                [f(k * previous(c)) for k in range(1, top + 1) for f in (np.sin, np.cos)], axis=1
            )

        form = f"a smooth function of the previous position (harmonics to {top})"
        yield _Made(family, True, Basis(form, covariates, columns))


@dataclass(frozen=True)
class _Factor:
    """A covariate of a product: its name, letter, values and the zero that means something."""

    name: str
    letter: str
    get: Callable[[Conditions], Floats]
    zero: float = 0.0


def _factors(conditions: Conditions) -> Iterator[_Factor]:
    """Covariates that may stand in a product."""
    yield _Factor("time", "t", lambda c: c.time_s)
    if conditions.temperature_c is not None:
        yield _Factor("temperature", "(T − 25 °C)", lambda c: c.covariate("temperature_c"), REFERENCE_C)
    if conditions.supply_v is not None:
        yield _Factor("supply", "(V − 5 V)", lambda c: c.covariate("supply_v"), REFERENCE_V)
    if conditions.approach is not None:
        yield _Factor("approach", "approach", lambda c: c.covariate("approach"))
    if conditions.angle_rad is not None and conditions.previous_angle_rad is not None:
        yield _Factor("previous_angle", "sin θ′", lambda c: np.sin(c.covariate("previous_angle_rad")))


def _products(data: Readings) -> Iterator[_Made]:
    conditions = data.conditions
    # One that hardly moves is a constant with noise, and a product with it the other factor.
    least = {"temperature": limits.least_range_c, "supply": limits.least_range_v}
    moving = [f for f in _factors(conditions) if np.ptp(f.get(conditions)) > least.get(f.name, 0.0)]
    for one, two in itertools.combinations(moving, 2):
        yield from _product(one, two, conditions)


def _product(one: _Factor, two: _Factor, conditions: Conditions) -> Iterator[_Made]:
    """Forms of two covariates together: their product, surfaces over both."""
    one_middle, one_half = _scaled(one.get(conditions))
    two_middle, two_half = _scaled(two.get(conditions))
    names = (one.name, two.name)

    def about(c: Conditions) -> Floats:
        return np.asarray((one.get(c) - one.zero) / one_half * (two.get(c) - two.zero) / two_half)

    def scaled(c: Conditions) -> tuple[Floats, Floats]:
        return (one.get(c) - one_middle) / one_half, (two.get(c) - two_middle) / two_half

    def centred(c: Conditions) -> Floats:
        u, v = scaled(c)
        return np.asarray(u * v)

    def surface(c: Conditions) -> Floats:
        u, v = scaled(c)
        return np.stack([u, v, u * v], axis=1)

    def curved(c: Conditions) -> Floats:
        u, v = scaled(c)
        return np.stack([u, v, u * v, u * u, v * v], axis=1)

    letters = f"{one.letter} × {two.letter}"
    yield from _both("products", names, letters, about)
    yield from _both("products", names, f"{letters}, centred", centred)
    form = f"a surface over {one.name} and {two.name}"
    yield _Made("products", True, Basis(form, names, surface))
    constant = Basis(form + " + const", names, _with_constant(surface), with_constant=True)
    yield _Made("products", True, constant, ("bias",))
    if "approach" not in names:
        bent = Basis("a curved " + form.removeprefix("a "), names, _with_constant(curved))
        yield _Made("products", True, bent)
