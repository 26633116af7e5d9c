"""Effects that the catalogue does not have, for the blind sessions.

`GRAMMAR` holds those which a line "where it enters × what drives it" expresses; `BEYOND` holds shapes that
no such line expresses. Each entry draws a `Term` of unit size with the covariates that drive it, the
catalogue names that are the leading part of the same cause, and words by which a report shows its form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tracing.named_truth import Basis, Term, on_axes
from tracing.plans import Floats, Rows

Draw = Callable[[np.random.Generator, Rows], Term]


def _axes(rng: np.random.Generator) -> str:
    return str(rng.choice(["x", "y", "xy"]))


def _sizes(rng: np.random.Generator, axes: str) -> Floats:
    return rng.choice([-1, 1], len(axes)) * rng.uniform(0.5, 1, len(axes))


def _biased(
    rng: np.random.Generator,
    name: str,
    course: Callable[[Rows], Floats],
    covariates: str,
    form: str,
    leading: str = "",
    needs: str = "",
) -> Term:
    """Term of the zero of one axis or two."""
    axes = _axes(rng)
    basis = on_axes(axes, lambda r, a, i: course(r))
    return _made(name, basis, _sizes(rng, axes), covariates, form, leading, needs)


def _gain(
    rng: np.random.Generator,
    name: str,
    course: Callable[[Rows], Floats],
    covariates: str,
    form: str,
    leading: str = "",
    needs: str = "",
) -> Term:
    """Term of the gain of one axis or two."""
    axes = _axes(rng)
    basis = on_axes(axes, lambda r, a, i: course(r) * a[:, i] / 1000)
    made = _made(name, basis, _sizes(rng, axes), covariates, form, leading, needs)
    return replace(made, also=("reading",))


def _response(
    rng: np.random.Generator,
    name: str,
    curve: Callable[[Floats, Floats], Floats],
    form: str,
    leading: str = "",
) -> Term:
    """Term of an axis's response: `curve` of its own and the other reading in g."""
    axes = _axes(rng)
    basis = on_axes(axes, lambda r, a, i: curve(a[:, i] / 1000, a[:, 1 - i] / 1000))
    return _made(name, basis, _sizes(rng, axes), "reading", form, leading)


def _turned(
    name: str,
    waves: Callable[[Rows], Floats],
    covariates: str,
    form: str,
    leading: str = "",
    needs: str = "",
) -> Term:
    """Term of the true angle, one column."""
    made = _made(name, lambda r, a: waves(r)[None], np.ones(1), covariates, form, leading, needs)
    return replace(made, attitude=True)


def _made(
    name: str,
    basis: Basis,
    sizes: Floats,
    covariates: str,
    form: str,
    leading: str = "",
    needs: str = "",
) -> Term:
    return Term(
        name,
        basis,
        sizes,
        covariates=tuple(covariates.split()),
        leading=tuple(leading.split()),
        form=form,
        needs=tuple(needs.split()),
    )


def _within(rng: np.random.Generator, values: Floats, low: float = 0.25, high: float = 0.75) -> float:
    """A value between two quantiles of `values`."""
    return float(np.quantile(values, rng.uniform(low, high)))


def _bias_jump(rng: np.random.Generator, rows: Rows) -> Term:
    when = _within(rng, rows.time_s)
    return _biased(rng, "bias_jump", lambda r: (r.time_s > when) * 1.0, "time", "(bias|zero).*(step|jump)")


def _gain_jump(rng: np.random.Generator, rows: Rows) -> Term:
    when = _within(rng, rows.time_s)
    return _gain(rng, "gain_jump", lambda r: (r.time_s > when) * 1.0, "time", "(gain|scale).*(step|jump)")


def _stage_jump(rng: np.random.Generator, rows: Rows) -> Term:
    when = _within(rng, rows.time_s)
    return _turned("stage_jump", lambda r: (r.time_s > when) * 1.0, "time", "(angle|ψ).*(step|jump)")


def _memory_sine(rng: np.random.Generator, rows: Rows) -> Term:
    phase = rng.uniform(0, 2 * np.pi)
    return _biased(
        rng, "memory_bias", lambda r: np.sin(r.previous_rad + phase), "previous", "(bias|zero).*prev"
    )


def _memory_turn(rng: np.random.Generator, rows: Rows) -> Term:
    phase = rng.uniform(0, 2 * np.pi)
    return _turned("memory_turn", lambda r: np.cos(r.previous_rad + phase), "previous", "(angle|ψ).*prev")


def _temperature_knee(rng: np.random.Generator, rows: Rows) -> Term:
    knee = _within(rng, rows.temperature_c, 0.3, 0.7)
    return _biased(
        rng,
        "temperature_knee",
        lambda r: np.maximum(r.temperature_c - knee, 0),
        "temperature",
        "(bias|zero).*(knee|hinge|max)",
        "bias_temperature",
        "surroundings",
    )


def _gain_temperature_knee(rng: np.random.Generator, rows: Rows) -> Term:
    knee = _within(rng, rows.temperature_c, 0.3, 0.7)
    return _gain(
        rng,
        "gain_temperature_knee",
        lambda r: np.maximum(r.temperature_c - knee, 0),
        "temperature",
        "(gain|scale).*(knee|hinge|max)",
        "scale_temperature",
        "surroundings",
    )


def _supply_temperature(rng: np.random.Generator, rows: Rows) -> Term:
    return _biased(
        rng,
        "supply_times_temperature",
        lambda r: (r.supply_v - 5) * (r.temperature_c - 25),
        "supply temperature",
        "×|\\*|·|product",
        "supply_bias bias_temperature",
        "surroundings",
    )


def _supply_square(rng: np.random.Generator, rows: Rows) -> Term:
    return _biased(
        rng,
        "supply_square",
        lambda r: (r.supply_v - 5) ** 2,
        "supply",
        "²|\\^2|\\*\\*2|square|power",
        "supply_bias",
        "surroundings",
    )


def _gain_approach(rng: np.random.Generator, rows: Rows) -> Term:
    return _gain(
        rng, "gain_approach", lambda r: r.approach, "approach", "(gain|scale).*approach", needs="approach"
    )


def _turn_temperature(rng: np.random.Generator, rows: Rows) -> Term:
    return _turned(
        "turn_temperature",
        lambda r: r.temperature_c - 25,
        "temperature",
        "(angle|ψ).*[~ ]\\(?(T|temp)",
        needs="surroundings",
    )


def _turn_time(rng: np.random.Generator, rows: Rows) -> Term:
    return _turned("turn_time", lambda r: r.time_s / 60, "time", "(angle|ψ).*[~ ](t|time)$")


def _turn_supply(rng: np.random.Generator, rows: Rows) -> Term:
    return _turned(
        "turn_supply",
        lambda r: r.supply_v - 5,
        "supply",
        "(angle|ψ).*[~ ]\\(?(V|supply)",
        needs="surroundings",
    )


def _lean_time(rng: np.random.Generator, rows: Rows) -> Term:
    axis = str(rng.choice(["x", "y"]))
    basis = on_axes(axis, lambda r, a, i: a[:, 1 - i] / 1000 * r.time_s / 60)
    made = _made("lean_time", basis, _sizes(rng, axis), "time", "cross|lean|misal")
    return replace(made, also=("reading",))


def _quintic(rng: np.random.Generator, rows: Rows) -> Term:
    return _response(rng, "quintic", lambda a, p: a**5, "5|⁵|quintic", "cubic")


def _cross_cubic(rng: np.random.Generator, rows: Rows) -> Term:
    return _response(rng, "cross_cubic", lambda a, p: p**3, "3|³|cub")


def _cross_modulus(rng: np.random.Generator, rows: Rows) -> Term:
    return _response(rng, "cross_modulus", lambda a, p: np.abs(p), r"\||abs|mod")


def _drift_square(rng: np.random.Generator, rows: Rows) -> Term:
    return _biased(
        rng, "drift_square", lambda r: r.time_s**2, "time", "²|\\^2|square|power|quad", "bias_drift"
    )


def _drift_knee(rng: np.random.Generator, rows: Rows) -> Term:
    when = _within(rng, rows.time_s, 0.3, 0.7)
    return _biased(
        rng,
        "drift_knee",
        lambda r: np.maximum(r.time_s - when, 0),
        "time",
        "(bias|zero).*(knee|hinge|max)",
        "bias_drift",
    )


GRAMMAR: dict[str, Draw] = {
    "bias_jump": _bias_jump,
    "memory_bias": _memory_sine,
    "temperature_knee": _temperature_knee,
    "supply_times_temperature": _supply_temperature,
    "quintic": _quintic,
    "stage_jump": _stage_jump,
    "gain_approach": _gain_approach,
    "turn_temperature": _turn_temperature,
    "memory_turn": _memory_turn,
    "supply_square": _supply_square,
    "gain_jump": _gain_jump,
    "cross_cubic": _cross_cubic,
    "gain_temperature_knee": _gain_temperature_knee,
    "cross_modulus": _cross_modulus,
    "turn_time": _turn_time,
    "turn_supply": _turn_supply,
    "lean_time": _lean_time,  # an axis that turns against the other
    "drift_square": _drift_square,
    "drift_knee": _drift_knee,
}


# Beyond the grammar ------------------------------------------------------------------------------------


def _smooth_draw(
    rng: np.random.Generator, low: float, high: float, length: float
) -> Callable[[Floats], Floats]:
    """A draw of a Gaussian process of unit variance with squared-exponential kernel on [low, high]."""
    knots = np.linspace(low, high, 200)
    kernel = np.exp(-0.5 * ((knots[:, None] - knots) / (length * (high - low))) ** 2)
    values = np.linalg.cholesky(kernel + 1e-8 * np.eye(200)) @ rng.normal(size=200)
    return lambda x: np.interp(x, knots, values)


def _periodic_draw(rng: np.random.Generator, width: float) -> Callable[[Floats], Floats]:
    """A smooth periodic draw of the angle."""
    grid = np.linspace(0, 2 * np.pi, 241)
    kernel = np.exp(-2 * np.sin((grid[:, None] - grid) / 2) ** 2 / width**2)
    weight, vectors = np.linalg.eigh(kernel)
    values = vectors @ (np.sqrt(np.maximum(weight, 0)) * rng.normal(size=241))
    return lambda x: np.interp(np.mod(x, 2 * np.pi), grid, values)


def _gp_angle_bias(rng: np.random.Generator, rows: Rows) -> Term:
    f = _periodic_draw(rng, rng.uniform(0.4, 0.7))
    return _biased(rng, "smooth_of_angle", lambda r: f(r.angle_rad), "angle", "")


def _gp_angle_turn(rng: np.random.Generator, rows: Rows) -> Term:
    f = _periodic_draw(rng, rng.uniform(0.35, 0.6))
    leading = "stage_eccentricity stage_ellipticity stage_periodic"
    return _turned("smooth_turn_of_angle", lambda r: f(r.angle_rad), "angle", "", leading)


def _gp_temperature(rng: np.random.Generator, rows: Rows) -> Term:
    t = rows.temperature_c
    f = _smooth_draw(rng, t.min() - 0.1, t.max() + 0.1, rng.uniform(0.15, 0.3))
    return _biased(
        rng,
        "smooth_of_temperature",
        lambda r: f(r.temperature_c),
        "temperature",
        "",
        "bias_temperature",
        "surroundings",
    )


def _gp_time(rng: np.random.Generator, rows: Rows) -> Term:
    f = _smooth_draw(rng, 0.0, rows.time_s[-1], rng.uniform(0.12, 0.25))
    return _biased(rng, "smooth_of_time", lambda r: f(r.time_s), "time", "", "bias_drift warm_up")


def _chirp(rng: np.random.Generator, rows: Rows) -> Term:
    span, rate = rows.time_s[-1], rng.uniform(1.5, 2.5)
    phase = rng.uniform(0, 2 * np.pi)
    return _biased(
        rng,
        "chirp_of_time",
        lambda r: np.sin(2 * np.pi * rate * (r.time_s / span) ** 2 + phase),
        "time",
        "",
        "bias_drift warm_up",
    )


def _wavy_turn(rng: np.random.Generator, rows: Rows) -> Term:
    phase, depth = rng.uniform(0, 2 * np.pi), rng.uniform(1.0, 2.0)
    return _turned(
        "wavy_turn",
        lambda r: np.sin(3 * r.angle_rad + depth * np.sin(r.angle_rad + phase)),
        "angle",
        "",
        "stage_eccentricity stage_ellipticity stage_periodic",
    )


def _tooth(rng: np.random.Generator, rows: Rows) -> Term:
    at, width = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.6)

    def dip(r: Rows) -> Floats:
        away = np.mod(r.angle_rad - at + np.pi, 2 * np.pi) - np.pi
        return np.maximum(1 - np.abs(away) / width, 0)

    return _turned("worn_tooth", dip, "angle", "")


def _saturating_product(rng: np.random.Generator, rows: Rows) -> Term:
    cold, late = rows.temperature_c.min(), rows.time_s[-1]
    warm = rows.temperature_c.max() - cold + 1e-9

    def course(r: Rows) -> Floats:
        return 1 - np.exp(-6 * (r.temperature_c - cold) / warm * r.time_s / late)

    return _biased(
        rng,
        "saturating_temperature_time",
        course,
        "temperature|time",
        "",
        "bias_temperature bias_drift warm_up",
        "surroundings",
    )


def _bump_temperature(rng: np.random.Generator, rows: Rows) -> Term:
    at = _within(rng, rows.temperature_c, 0.25, 0.75)
    width = 0.15 * (np.ptp(rows.temperature_c) + 1e-9)
    return _biased(
        rng,
        "resonance_in_temperature",
        lambda r: np.exp(-0.5 * ((r.temperature_c - at) / width) ** 2),
        "temperature",
        "",
        "bias_temperature",
        "surroundings",
    )


def _window(rng: np.random.Generator, rows: Rows) -> Term:
    begin = _within(rng, rows.time_s, 0.15, 0.5)
    end = begin + rng.uniform(0.2, 0.35) * rows.time_s[-1]
    return _biased(
        rng, "window_of_time", lambda r: ((r.time_s > begin) & (r.time_s < end)) * 1.0, "time", ""
    )


def _supply_sigmoid(rng: np.random.Generator, rows: Rows) -> Term:
    at, width = _within(rng, rows.supply_v, 0.35, 0.65), 0.06 * (np.ptp(rows.supply_v) + 1e-9)
    return _biased(
        rng,
        "supply_dropout",
        lambda r: np.tanh((r.supply_v - at) / width),
        "supply",
        "",
        "supply_bias",
        "surroundings",
    )


def _gain_wander(rng: np.random.Generator, rows: Rows) -> Term:
    f = _smooth_draw(rng, 0.0, rows.time_s[-1], rng.uniform(0.15, 0.3))
    return _gain(rng, "gain_wanders", lambda r: f(r.time_s), "time", "", "scale_drift")


def _two_slopes(rng: np.random.Generator, rows: Rows) -> Term:
    edge = rng.uniform(0.3, 0.5)
    return _response(rng, "two_slopes", lambda a, p: np.clip(a, -edge, edge), "", "cubic")


def _one_sided(rng: np.random.Generator, rows: Rows) -> Term:
    edge = rng.uniform(0.2, 0.6)
    return _response(
        rng,
        "one_sided_bend",
        lambda a, p: np.maximum(a - edge, 0) ** 1.5,
        "",
        "quadratic asymmetry cubic",
    )


def _lean_wanders(rng: np.random.Generator, rows: Rows) -> Term:
    f = _smooth_draw(rng, 0.0, rows.time_s[-1], rng.uniform(0.15, 0.3))
    axes = _axes(rng)
    basis = on_axes(axes, lambda r, a, i: a[:, 1 - i] / 1000 * f(r.time_s))
    made = _made("lean_wanders", basis, _sizes(rng, axes), "time", "", "")
    return replace(made, also=("reading",))


def _growing_play(rng: np.random.Generator, rows: Rows) -> Term:
    rate = rng.uniform(1.0, 4.0) / rows.time_s[-1]
    return _turned(
        "growing_play",
        lambda r: r.approach * (1 - np.exp(-rate * r.time_s)),
        "approach time",
        "",
        "backlash",
        "approach",
    )


BEYOND: dict[str, Draw] = {
    "smooth_of_angle": _gp_angle_bias,
    "smooth_of_temperature": _gp_temperature,
    "smooth_of_time": _gp_time,
    "smooth_turn_of_angle": _gp_angle_turn,
    "chirp_of_time": _chirp,
    "wavy_turn": _wavy_turn,
    "worn_tooth": _tooth,
    "saturating_temperature_time": _saturating_product,
    "resonance_in_temperature": _bump_temperature,
    "window_of_time": _window,
    "supply_dropout": _supply_sigmoid,
    "gain_wanders": _gain_wander,
    "two_slopes": _two_slopes,
    "one_sided_bend": _one_sided,
    "lean_wanders": _lean_wanders,
    "growing_play": _growing_play,
}
