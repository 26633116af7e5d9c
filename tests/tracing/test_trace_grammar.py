"""What a form of the grammar says is what its columns are; where forms enter, and how likely they are."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.polynomial import Legendre

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import NamelessTerm
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import MeanRate, PlanarTurn
from adis_gonio.tracing.grammar import nameless_terms, step_places

N = 30
CONST = " + const"
T0, V0 = 25.0, 5.0


def surroundings(seed: int = 11) -> Conditions:
    """Thirty dwells over two turns, out of order, with all that can be recorded."""
    rng = np.random.default_rng(seed)
    time = 20.0 + 50.0 * np.arange(N)
    angle = rng.permutation(np.linspace(0.03, 4 * np.pi - 0.4, N))
    history = np.linspace(0, time[-1] + 100, 400)

    def temperature(t: Floats) -> Floats:
        return np.asarray(27 + 5 * np.sin(t / 210.0) + t / 400.0)

    return Conditions(
        time_s=time,
        angle_rad=angle,
        order=np.arange(float(N)),
        approach=rng.choice([-1.0, 1.0], N),
        previous_angle_rad=np.concatenate([[angle[0]], angle[:-1]]),
        temperature_c=temperature(time),
        supply_v=4.87 + 0.01 * rng.permutation(N),
        temperature_history=(history, temperature(history)),
    )


C = surroundings()


def turned() -> Readings:
    """Two axes of a part in one plane."""
    psi = 0.1 - C.angle_rad
    mean = np.stack([1000 * np.cos(psi), 1000 * np.sin(psi)], axis=1)
    return from_means(mean, np.tile(np.eye(2), (N, 1, 1)), C, measurement=PlanarTurn(1000.0))


def gyros() -> Readings:
    """Three gyros in poses, at rest and turned."""
    rng = np.random.default_rng(12)
    force = rng.normal(size=(N, 3))
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    c = Conditions(C.time_s, force_g=force, rate_dps=rng.normal(0, 20, (N, 3)))
    return from_means(rng.normal(size=(N, 3)), np.tile(np.eye(3), (N, 1, 1)), c, measurement=MeanRate())


TURNED, GYROS = turned(), gyros()


# -- the forms, read by themselves -----------------------------------------------------------------------


OWN: dict[str, Callable[[Floats], Floats]] = {
    "a⁴": lambda a: a * a * a * a,
    "a⁵": lambda a: a * a * a * a * a,
    "a⁶": lambda a: (a * a * a) ** 2,
    "a⁷": lambda a: a * (a * a * a) ** 2,
    "a|a|": lambda a: np.where(a > 0, a * a, -a * a),
    "|a|³": lambda a: np.where(a > 0, a**3, -(a**3)),
    "sign a": lambda a: np.where(a > 0, 1.0, -1.0),
    "√|a|": lambda a: np.where(a > 0, a, -a) ** 0.5,
    "sign a √|a|": lambda a: np.where(a > 0, 1.0, -1.0) * np.where(a > 0, a, -a) ** 0.5,
    "max(a, 0)²": lambda a: np.where(a > 0, a * a, 0.0),
    "min(a, 0)²": lambda a: np.where(a < 0, a * a, 0.0),
    "max(a, 0)³": lambda a: np.where(a > 0, a**3, 0.0),
    "min(a, 0)³": lambda a: np.where(a < 0, a**3, 0.0),
}
ACROSS: dict[str, Callable[[Floats, Floats], Floats]] = {
    "|a_p|": lambda a, p: np.where(p > 0, p, -p),
    "a_p³": lambda a, p: p * p * p,
    "a a_p²": lambda a, p: a * p * p,
    "a² a_p": lambda a, p: a * a * p,
    "a |a_p|": lambda a, p: a * np.where(p > 0, p, -p),
    "a_p |a|": lambda a, p: p * np.where(a > 0, a, -a),
    "sign a_p": lambda a, p: np.where(p > 0, 1.0, -1.0),
    "a_p⁴": lambda a, p: (p * p) ** 2,
    "a_p⁵": lambda a, p: p * (p * p) ** 2,
    "a² a_p²": lambda a, p: a * a * p * p,
    "a³ a_p": lambda a, p: a * a * a * p,
    "a a_p³": lambda a, p: a * p * p * p,
}
RATE: dict[str, Callable[[Floats], Floats]] = {
    "ω²": lambda w: w * w,
    "ω³": lambda w: w * w * w,
    "ω|ω|": lambda w: np.where(w > 0, w * w, -w * w),
    "sign ω": lambda w: np.where(w > 0, 1.0, -1.0),
    "|sign ω|": lambda w: np.where(w == 0, 0.0, 1.0),
}


def unit(values: Floats) -> Floats:
    """Values on the scale from −1 to 1 of what the session saw."""
    low, high = values.min(), values.max()
    return np.asarray((2 * values - low - high) / (high - low))


def late(tau_s: float) -> Floats:
    """T_lag − T by small steps of Euler's method."""
    times, warm = C.temperature_history
    fine = np.linspace(times[0], times[-1], 40_000)
    course = np.interp(fine, times, warm)
    lag, step = np.empty_like(course), fine[1] - fine[0]
    lag[0] = course[0]
    for k in range(1, len(fine)):
        lag[k] = lag[k - 1] + step / tau_s * (0.5 * (course[k] + course[k - 1]) - lag[k - 1])
    return np.asarray(np.interp(C.time_s, fine, lag - course))


def slope() -> Floats:
    """Temperature half a dwell's time ahead less that half of it before, by time."""
    times, warm = C.temperature_history
    apart = (C.time_s[-1] - C.time_s[0]) / (N - 1)
    ahead, behind = (np.interp(C.time_s + s * apart / 2, times, warm) for s in (1, -1))
    return np.asarray((ahead - behind) / apart)


def factor(word: str) -> tuple[Floats, float]:
    """Values of a factor of a product, and its zero."""
    return {
        "t": (C.time_s, 0.0),
        "(T − 25 °C)": (C.temperature_c, T0),
        "(V − 5 V)": (C.supply_v, V0),
        "approach": (C.approach, 0.0),
        "sin θ′": (np.sin(C.previous_angle_rad), 0.0),
        "time": (C.time_s, 0.0),
        "temperature": (C.temperature_c, T0),
        "supply": (C.supply_v, V0),
        "previous_angle": (np.sin(C.previous_angle_rad), 0.0),
    }[word]


def scalar(letter: str) -> Floats:
    """Values of a covariate by its letter."""
    return {"t": C.time_s, "T": C.temperature_c, "V": C.supply_v}[letter]


def bell(values: Floats, place: float, width: float) -> Floats:
    """A Gaussian bell."""
    return np.asarray(np.exp(-((values - place) ** 2) / (2 * width**2)))


def read(form: str, axis: int, driven: Floats) -> list[Floats]:
    """Columns that a form says, by its words alone."""
    if form.endswith(CONST):
        return [np.ones(N), *read(form.removesuffix(CONST), axis, driven)]
    theta, before, t = C.angle_rad, C.previous_angle_rad, C.time_s
    a = driven[:, axis]
    others = [driven[:, k] for k in range(driven.shape[1]) if k != axis]
    plain = {
        "θ (along all turns)": theta,
        "θ within a turn (saw-tooth)": (theta / np.pi) % 2 - 1,
        "number of the turn": (theta / (2 * np.pi)).astype(int).astype(float),
        "sign sin θ": np.where(np.sin(theta) > 0, 1.0, -1.0),
        "sign cos θ": np.where(np.cos(theta) > 0, 1.0, -1.0),
        "|sin θ|": np.sqrt(1 - np.cos(theta) ** 2),
        "|cos θ|": np.sqrt(1 - np.sin(theta) ** 2),
        "t": t,
        "t²": t * t,
        "t³": t * t * t,
        "√t": t**0.5,
        "approach": C.approach,
        "the move θ − θ′": theta - before,
        "|θ − θ′|": np.where(theta > before, theta - before, before - theta),
        "sign(θ − θ′)": (theta > before) * 1.0 - (theta < before),
        "dT/dt": slope(),
        "|dT/dt|": np.sqrt(slope() ** 2),
        "sign dT/dt": np.where(slope() > 0, 1.0, -1.0),
        "(dT/dt)²": slope() * slope(),
    }
    if form in plain:
        return [np.asarray(plain[form])]
    if form in OWN:
        return [OWN[form](a)]
    if form in ACROSS:
        return [ACROSS[form](a, p) for p in others]
    rules: list[tuple[str, Callable[..., list[Floats]]]] = [
        (r"max\(a − (\S+) g, 0\)", lambda k: [np.where(a > float(k), a - float(k), 0.0)]),
        (
            r"a smooth function of the reading \(degree (\d)\)",
            lambda d: [Legendre.basis(k)(a) for k in range(2, int(d) + 1)],
        ),
        (r"sin (\d)θ, cos \dθ", lambda k: [np.sin(int(k) * theta), np.cos(int(k) * theta)]),
        (r"sin (\d)θ", lambda k: [np.sin(int(k) * theta)]),
        (r"cos (\d)θ", lambda k: [np.cos(int(k) * theta)]),
        (
            r"a bump at θ = (\d+)° of width (\d+)°",
            lambda at, w: [
                np.exp(-2 * np.sin((theta - np.radians(float(at))) / 2) ** 2 / np.radians(float(w)) ** 2)
            ],
        ),
        (
            r"a smooth function of the angle \(harmonics to (\d)\)",
            lambda top: [f(k * theta) for k in range(2, int(top) + 1) for f in (np.sin, np.cos)],
        ),
        (r"a step at (\w) = (\S+)(?: s)?", lambda x, at: [np.where(scalar(x) > float(at), 1.0, 0.0)]),
        (
            r"a knee at (\w) = (\S+)(?: s)? \((above|after|below|before)\)",
            lambda x, at, side: [
                np.clip((scalar(x) - float(at)) * (1 if side in {"above", "after"} else -1), 0, None)
            ],
        ),
        (r"exp\((−|\+)t/(\S+) s\)", lambda s, tau: [np.exp({"−": -1, "+": 1}[s] * t / float(tau))]),
        (
            r"exp\((\S+) ([TV])\)",
            lambda rate, x: [np.exp(float(rate) * (scalar(x) - scalar(x).mean()))],
        ),
        (
            r"a bump at (\w) = (\S+)(?: s)? of width (\S+)(?: s)?",
            lambda x, at, w: [bell(scalar(x), float(at), float(w))],
        ),
        (
            r"an oscillation of period (\S+) in (\w)",
            lambda p, x: [
                f(2 * np.pi / float(p) * (scalar(x) - (scalar(x).max() + scalar(x).min()) / 2))
                for f in (np.sin, np.cos)
            ],
        ),
        (
            r"a smooth function of (time|temperature|supply) \(degree (\d)\)",
            lambda x, d: [Legendre.basis(k)(unit(factor(x)[0])) for k in range(1, int(d) + 1)],
        ),
        (r"\((\w) − (?:25 °C|5 V)\)", lambda x: [scalar(x) - {"T": T0, "V": V0}[x]]),
        (r"\((\w) − (?:25 °C|5 V)\)²", lambda x: [(scalar(x) - {"T": T0, "V": V0}[x]) ** 2]),
        (r"\((\w) − (?:25 °C|5 V)\)³", lambda x: [(scalar(x) - {"T": T0, "V": V0}[x]) ** 3]),
        (r"\|(\w) − (?:25 °C|5 V)\|", lambda x: [np.abs(scalar(x) - {"T": T0, "V": V0}[x])]),
        (r"T_lag − T with τ = (\S+) s", lambda tau: [late(float(tau))]),
        (
            r"sin (\d)θ′, cos \dθ′ of the previous position",
            lambda k: [np.sin(int(k) * before), np.cos(int(k) * before)],
        ),
        (r"sin (\d)θ′ of the previous position", lambda k: [np.sin(int(k) * before)]),
        (r"cos (\d)θ′ of the previous position", lambda k: [np.cos(int(k) * before)]),
        (
            r"a smooth function of the previous position \(harmonics to (\d)\)",
            lambda top: [f(k * before) for k in range(1, int(top) + 1) for f in (np.sin, np.cos)],
        ),
        (
            r"(.+) × \(sin (\d)θ, cos \dθ\)",
            lambda x, k: [
                (factor(x)[0] - factor(x)[1]) * f(int(k) * C.angle_rad) for f in (np.sin, np.cos)
            ],
        ),
        (
            r"(.+) × (.+), centred",
            lambda x, y: [unit(factor(x)[0]) * unit(factor(y)[0])],
        ),
        (
            r"(.+) × (.+)",
            lambda x, y: [(factor(x)[0] - factor(x)[1]) * (factor(y)[0] - factor(y)[1])],
        ),
        (
            r"a surface over (\w+) and (\w+)",
            lambda x, y: [
                unit(factor(x)[0]),
                unit(factor(y)[0]),
                unit(factor(x)[0]) * unit(factor(y)[0]),
            ],
        ),
        (
            r"a curved surface over (\w+) and (\w+)",
            lambda x, y: [
                np.ones(N),
                unit(factor(x)[0]),
                unit(factor(y)[0]),
                unit(factor(x)[0]) * unit(factor(y)[0]),
                unit(factor(x)[0]) ** 2,
                unit(factor(y)[0]) ** 2,
            ],
        ),
    ]
    for pattern, columns in rules:
        found = re.fullmatch(pattern, form)
        if found:
            return columns(*found.groups())
    raise AssertionError(f"nobody can read: {form}")


def read_of_gyros(form: str, axis: int) -> list[Floats]:
    """The same of gyros: functions of force and rate."""
    if form.endswith(CONST):
        return [np.ones(N), *read_of_gyros(form.removesuffix(CONST), axis)]
    force, rate = GYROS.conditions.force_g, GYROS.conditions.rate_dps[:, axis]
    if form in RATE:
        return [RATE[form](rate)]
    found = re.fullmatch(r"f_(.) f_(.)", form)
    if found:
        return [np.prod([force[:, "xyz".index(letter)] for letter in found.groups()], axis=0)]
    found = re.fullmatch(r"\(f_(.)² − f_(.)²\)/2", form)
    if found:
        one, two = (force[:, "xyz".index(letter)] for letter in found.groups())
        return [(one - two) * (one + two)]
    found = re.fullmatch(r"a smooth function of the force \(degree ([23])\)", form)
    if found:
        x, y, z = force.T
        second = [x * x, x * y, x * z, y * y, y * z]
        third = [x * x * x, x * x * y, x * x * z, x * y * y, x * y * z, y * y * y, y * y * z]
        return [x, y, z, *second, *(third if found[1] == "3" else [])]
    letter = re.search(r"f_(.)", form)
    assert letter is not None, form
    f = force[:, "xyz".index(letter[1])]
    simple = form.replace(letter[0], "f")
    up, down = np.where(f > 0, f, 0.0), np.where(f < 0, f, 0.0)
    return [
        {
            "f³": f * f * f,
            "|f|": up - down,
            "f|f|": up * up - down * down,
            "sign f": np.where(f > 0, 1.0, -1.0),
            "max(f, 0)": up,
            "max(f, 0)²": up * up,
            "min(f, 0)²": down * down,
        }[simple]
    ]


def alike(columns: Floats, said: Sequence[Floats]) -> bool:
    """True where columns (n, q) are the functions, but for a positive factor each."""
    if columns.shape[1] != len(said):
        return False
    cosines = [
        float(own @ other / np.linalg.norm(own) / np.linalg.norm(other))
        for own, other in zip(columns.T, said, strict=True)
    ]
    return min(cosines) > 1 - 2e-3


# -- tests -------------------------------------------------------------------------------------------------


def of_one_place(data: Readings, where: str) -> dict[str, NamelessTerm]:
    """Terms by their form that act on one axis (of the angle: all) in one place."""
    terms = [t for t in nameless_terms(data) if t.where == where and len(t.axes) <= 1]
    return {f"{t.basis.form} {t.axes}": t for t in terms}


def test_what_a_form_of_a_bias_says_is_what_its_columns_are() -> None:
    driven = TURNED.mean / 1000.0
    terms = of_one_place(TURNED, "bias")
    assert len(terms) > 800
    for term in terms.values():
        (axis,) = term.axes
        columns = term.columns(TURNED.mean, C)
        assert alike(columns[:, axis], read(term.basis.form, axis, driven)), term.basis.form
        assert not columns[:, 1 - axis].any()


def test_a_gain_is_that_times_the_reading_and_a_misalignment_times_the_other() -> None:
    driven = TURNED.mean / 1000.0
    for where, by in (("gain", lambda axis: axis), ("misalignment", lambda axis: 1 - axis)):
        terms = of_one_place(TURNED, where)
        assert len(terms) > 300
        for term in terms.values():
            (axis,) = term.axes
            said = [own * driven[:, by(axis)] for own in read(term.basis.form, axis, driven)]
            assert alike(term.columns(TURNED.mean, C)[:, axis], said), term.label


def test_at_the_angle_it_turns_the_part_by_milliradians() -> None:
    terms = of_one_place(TURNED, "angle")
    assert len(terms) > 150
    for term in terms.values():
        said = read(term.basis.form, 0, TURNED.mean / 1000.0)
        if "smooth function of the angle" in term.basis.form:
            said = [np.sin(C.angle_rad), np.cos(C.angle_rad), *said]
        columns = term.columns(TURNED.mean, C)
        assert alike(columns, said), term.label
        assert np.abs(columns).max() < 0.02


def test_where_a_component_of_force_stands_still_the_other_two_have_all_of_their_powers() -> None:
    # On a centrifuge the length of force is not 1 g: no square follows from the others.
    force = GYROS.conditions.force_g * [0.0, 2.0, 3.0]
    data = replace(GYROS, conditions=replace(GYROS.conditions, force_g=force))
    y, z = force[:, 1:].T
    expected = {2: [y, z, y * y, y * z, z * z]}
    expected[3] = [*expected[2], y**3, y * y * z, y * z * z, z**3]
    for degree, said in expected.items():
        form = f"a smooth function of the force (degree {degree})"
        (term,) = (t for t in nameless_terms(data) if t.basis.form == form and t.axes == (0,))
        assert alike(term.columns(data.mean, data.conditions)[:, 0], said)


def test_forms_of_force_and_rate_are_read_the_same_way() -> None:
    terms = [t for t in nameless_terms(GYROS) if len(t.axes) == 1 and t.where == "bias"]
    driven = [t for t in terms if set(t.covariates) & {"force", "rotation"}]
    assert Counter(t.covariates for t in driven) == {
        ("rotation",): 3 * 5,
        ("force",): 3 * (7 * 3 + 3 * 2 + 2),
    }
    for term in driven:
        (axis,) = term.axes
        assert alike(
            term.columns(GYROS.mean, GYROS.conditions)[:, axis], read_of_gyros(term.basis.form, axis)
        )


def test_gyros_that_were_never_turned_have_no_functions_of_the_rate() -> None:
    still = replace(
        GYROS, conditions=replace(C, force_g=GYROS.conditions.force_g, rate_dps=np.zeros((N, 3)))
    )
    assert any("rotation" in term.covariates for term in nameless_terms(GYROS))
    assert not any("rotation" in term.covariates for term in nameless_terms(still))


def test_places_of_steps_part_the_values_that_were_seen() -> None:
    for letter, covariate, most in (("t", "time", 60), ("T", "temperature", 12), ("V", "supply", 12)):
        forms = {t.basis.form for t in nameless_terms(TURNED) if t.covariates == (covariate,)}
        found = [re.fullmatch(r"a step at \w = (\S+)(?: s)?", form) for form in forms]
        places = sorted(float(one[1]) for one in found if one)
        below = [int((scalar(letter) < place).sum()) for place in places]
        if most >= N - 1:  # all but those that would part off one dwell, which is a slip or an outlier
            assert below == list(range(2, N - 1))
        else:
            assert len(places) >= most - 2
            # Even quantiles; two temperatures may be nearer than the digits of a form.
            assert np.ptp(np.diff(below)) <= (1 if letter == "V" else 3)


def test_of_many_values_steps_stand_at_even_quantiles_but_where_they_would_part_off_one_dwell() -> None:
    # 21 places between 22 values: of five each is five from the next.
    assert step_places(np.arange(22.0), 5) == [5.5, 10.5, 15.5]
    assert step_places(np.append(np.arange(22.0), [0.0, 21.0]), 5) == [0.5, 5.5, 10.5, 15.5, 20.5]
    assert step_places(np.arange(4.0), 5) == [1.5]
    assert step_places(np.zeros(4), 5) == []


def test_forms_of_the_angle_the_position_before_and_the_reading_are_these() -> None:
    forms: dict[tuple[str, ...], set[str]] = {}
    for term in nameless_terms(TURNED):
        forms.setdefault(term.covariates, set()).add(term.basis.form.removesuffix(CONST))

    def waves(orders: Sequence[int], angle: str, suffix: str = "") -> set[str]:
        return {
            f"{form}{suffix}"
            for k in orders
            for form in (f"sin {k}{angle}, cos {k}{angle}", f"sin {k}{angle}", f"cos {k}{angle}")
        }

    # One cycle of the angle is gain and misalignment.
    assert forms[("angle",)] == {
        *waves((2, 3, 4, 5, 6), "θ"),
        *(f"a bump at θ = {at}° of width {width}°" for at in range(0, 360, 15) for width in (8, 25)),
        *(f"a smooth function of the angle (harmonics to {top})" for top in (3, 4, 5, 6)),
        *("θ (along all turns)", "θ within a turn (saw-tooth)", "number of the turn"),
        *("sign sin θ", "sign cos θ", "|sin θ|", "|cos θ|"),
    }
    assert forms[("previous_angle",)] == {
        *waves((1, 2, 3), "θ′", " of the previous position"),
        *(f"a smooth function of the previous position (harmonics to {top})" for top in (2, 3, 4)),
        *("the move θ − θ′", "|θ − θ′|", "sign(θ − θ′)"),
    }
    # Of the reading itself the second and third power have names, and the modulus.
    assert forms[("reading",)] == {
        *("a⁴", "a⁵", "a⁶", "a⁷", "a|a|", "|a|³", "sign a", "√|a|", "sign a √|a|"),
        *("max(a, 0)²", "min(a, 0)²", "max(a, 0)³", "min(a, 0)³"),
        *(f"max(a − {knee} g, 0)" for knee in (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)),
        *("|a_p|", "a_p³", "a a_p²", "a² a_p", "a |a_p|", "a_p |a|", "sign a_p", "a_p⁴", "a_p⁵"),
        *("a² a_p²", "a³ a_p", "a a_p³"),
        *(f"a smooth function of the reading (degree {degree})" for degree in (4, 5, 6)),
    }


def test_of_gyros_which_have_a_constant_already_forms_of_time_are_those_without_one() -> None:
    turned, gyros = (
        {t.basis.form for t in nameless_terms(data) if t.covariates == ("time",) and t.where == "bias"}
        for data in (TURNED, GYROS)
    )
    assert {form for form in turned if form.endswith(CONST)}
    assert gyros == {form for form in turned if not form.endswith(CONST)}


def test_no_function_is_a_candidate_twice() -> None:
    # Else a cause would be two, each with its share of the prior and half of the posterior.
    terms = [term for term in of_one_place(TURNED, "bias").values() if term.axes == (0,)]
    seen = [np.linalg.qr(term.columns(TURNED.mean, C)[:, 0])[0] for term in terms]
    onto = np.array([(basis @ basis.T).ravel() for basis in seen])
    width = np.array([basis.shape[1] for basis in seen])
    alike = (onto @ onto.T > width[:, None] - 1e-6) & (width[:, None] == width)
    twice = {frozenset((terms[i].basis.form, terms[k].basis.form)) for i, k in np.argwhere(alike) if i < k}
    # The part stands at 6° when the stage shows 0, and no reading lies between.
    assert twice == {frozenset(("sign a", "sign cos θ"))}


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        (r"a bump at t = \S+ s of width (\S+) s", [0.15, 0.35]),
        (r"a bump at T = \S+ of width (\S+)", [0.2, 0.45]),
        (r"a bump at V = \S+ of width (\S+)", [0.2, 0.45]),
        (r"an oscillation of period (\S+) in t", list(4 * 0.5 ** (np.arange(7) / 1.5))[::-1]),
        (r"an oscillation of period (\S+) in T", list(4 * 0.5 ** (np.arange(5) / 1.5))[::-1]),
        (r"exp\(\+t/(\S+) s\)", list(0.2 * 20 ** (np.arange(6) / 5))),
    ],
)
def test_grids_reach_as_far_as_the_session(pattern: str, expected: list[float]) -> None:
    forms = {t.basis.form.removesuffix(CONST) for t in nameless_terms(TURNED)}
    found = {float(one[1]) for one in (re.fullmatch(pattern, form) for form in forms) if one}
    half = np.ptp(scalar("V" if " V" in pattern else "T" if " T" in pattern else "t")) / 2
    assert sorted(found) == pytest.approx([width * half for width in expected], rel=0.03)


def test_the_place_of_knees_bumps_and_lags() -> None:
    forms = {t.basis.form.removesuffix(CONST) for t in nameless_terms(TURNED)}

    def places(pattern: str, of: Floats) -> list[float]:
        found = {float(one[1]) for one in (re.fullmatch(pattern, form) for form in forms) if one}
        middle = (of.max() + of.min()) / 2
        return [(place - middle) / (np.ptp(of) / 2) for place in sorted(found)]

    for letter, side in (("t", "after"), ("t", "before"), ("T", "above"), ("T", "below"), ("V", "above")):
        knees = places(rf"a knee at {letter} = (\S+)(?: s)? \({side}\)", scalar(letter))
        assert knees == pytest.approx(np.linspace(-0.8, 0.8, 9), abs=0.02)
    bumps = places(r"a bump at t = (\S+) s of width \S+ s", C.time_s)
    assert bumps == pytest.approx(np.linspace(-0.75, 0.75, 7), abs=0.01)
    rates = sorted(
        float(one[1]) * np.ptp(C.temperature_c) / 2
        for one in (re.fullmatch(r"exp\((\S+) T\)", form) for form in forms)
        if one
    )
    assert rates == pytest.approx([-3, -1.5, 1.5, 3], rel=0.01)
    lags = sorted(
        float(one[1])
        for one in (re.fullmatch(r"T_lag − T with τ = (\S+) s", form) for form in forms)
        if one
    )
    assert lags == pytest.approx(np.geomspace(25.0, 1.5 * np.ptp(C.time_s), 7), rel=0.01)


def test_each_family_enters_where_no_name_of_the_catalogue_stands() -> None:
    of: dict[str, set[str]] = {}
    for term in nameless_terms(TURNED):
        of.setdefault(term.basis.form, set()).add(term.where)
    everywhere = {"bias", "gain", "misalignment", "angle"}
    assert of["t"] == {"misalignment", "angle"}  # bias_drift, scale_drift
    assert of["(T − 25 °C)"] == {"angle"}  # bias_, scale_, misalignment_temperature
    assert of["(V − 5 V)"] == {"misalignment", "angle"}  # supply_bias, supply_scale
    assert of["approach"] == {"gain"}  # hysteresis, backlash
    assert {form for form in of if form.startswith("T_lag − T")}
    for form, where in of.items():
        if form.endswith(CONST):
            assert where == {"bias"}, form
        elif form.startswith("T_lag − T") or form.startswith("exp(−t/"):
            assert where == everywhere - {"bias"}, form  # thermal_lag, warm_up
        elif re.fullmatch(r"a smooth function of temperature \(degree [23]\)", form):
            assert where == everywhere - {"bias"}, form  # bias_temperature
        elif re.search(r"surface over|oscillation|θ′|turn", form) and "×" not in form:
            assert where == {"bias", "gain", "angle"}, form
        elif form.startswith("a bump at θ"):
            assert where == {"bias", "angle"}, form
        elif re.search(r"× \(sin \dθ", form):
            assert where == {"angle"}, form
        elif re.match(r"a step at|a knee at|a bump at [tTV]|exp\(|.*×", form):
            assert where == everywhere, form


def test_shares_of_the_prior_are_those_of_families_and_smooth_functions() -> None:
    terms = nameless_terms(TURNED)
    share = {t.label: float(np.exp(-t.cost)) for t in terms}
    assert sum(share.values()) == pytest.approx(0.3)
    family: dict[tuple[str, ...], float] = {}
    smooth: dict[tuple[str, ...], float] = {}
    for term in terms:
        family[term.covariates] = family.get(term.covariates, 0.0) + share[term.label]
        says_so = re.match(r"a smooth function|a surface|a curved surface", term.basis.form)
        assert term.basis.approximates == bool(says_so), term.label
        if says_so:
            smooth[term.covariates] = smooth.get(term.covariates, 0.0) + share[term.label]
    one = {key: value for key, value in family.items() if len(key) == 1}
    common = {("reading",), ("angle",), ("time",), ("temperature",)}
    weight = {key: 1.0 if key in common else 0.7 for key in one}
    total = sum(weight.values()) + 0.7  # all products together
    for key, value in one.items():
        assert value == pytest.approx(0.3 * weight[key] / total)
    assert sum(v for key, v in family.items() if len(key) == 2) == pytest.approx(0.3 * 0.7 / total)
    for key in ("reading", "angle", "time", "temperature", "supply", "previous_angle"):
        assert smooth[(key,)] == pytest.approx(0.25 * family[(key,)])
    within = {
        round(share[t.label], 12) for t in terms if t.covariates == ("time",) and not t.basis.approximates
    }
    assert len(within) == 1, "members of a family share evenly"


def test_a_constant_is_known_as_such_and_no_step_parts_off_one_dwell_alone() -> None:
    steps = 0
    for term in nameless_terms(TURNED):
        form = term.basis.form
        assert term.basis.with_constant == form.endswith(CONST), form
        if "a step at" in form:
            assert 2 <= term.basis.over(C)[:, -1].sum() <= N - 2, form
            steps += 1
    assert steps
