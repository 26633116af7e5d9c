"""What to measure next: positions and conditions at which rivals differ most, in words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from adis_gonio.model.effects import AXES, Conditions, catalogue
from adis_gonio.model.records import Floats
from adis_gonio.tracing.observations import Observations
from adis_gonio.tracing.result import Detectable
from adis_gonio.tracing.state import Refit, State, predict, settle
from adis_gonio.tracing.terms import Term

Fitted = tuple[Sequence[Term], Refit]


def advise(
    data: Observations,
    rivals: Sequence[Fitted],
    confounded: Sequence[Sequence[str]],
    detectable: dict[str, Detectable],
    adequate: bool,
) -> tuple[str, ...]:
    """Advice, the most informative first."""
    lines: list[str] = []
    if len(rivals) > 1:
        where = _separating(data, rivals)
        if where:
            lines.append(where)
    kinds = catalogue()
    for names in confounded:
        for name in names:
            if name in kinds:
                line = f"{name}: {kinds[name].separated_by}"
                if line not in lines:
                    lines.append(line)
    lines += _coverage(data, detectable)
    if not adequate and not lines:
        lines.append(
            "the residual is larger than the noise within the dwells and no single cause explains it: "
            "repeat each position at another time and from the other side"
        )
    return tuple(lines)


def _separating(data: Observations, rivals: Sequence[Fitted]) -> str:
    """Position and conditions at which the best model and its nearest rivals predict most apart."""
    if data.planar and data.conditions.angle_rad is None:
        return ""
    options, words = _options(data)
    predictions = []
    for model, fitted in rivals[:4]:
        predictions.append(_predicted(options, model, fitted.state))
    apart = np.zeros(len(options))
    for one, two in itertools.combinations(predictions, 2):
        apart = np.maximum(apart, np.linalg.norm(one - two, axis=1))
    # Differences beyond any sensor come from directions that the session does not determine at all.
    apart = np.where(np.isfinite(apart) & (apart < 1e3), apart, 0.0)
    if apart.max() <= 0:
        return ""
    noise = float(np.sqrt(np.trace(data.covariance, axis1=1, axis2=2).mean() / data.axes))
    ranked = np.argsort(-apart)
    best = [int(ranked[0])]
    for k in ranked[1:]:
        # Further positions that are not the same place again.
        if len(best) < 3 and all(words[k][0] != words[j][0] for j in best):
            best.append(int(k))
    labels = [", ".join(part for part in words[k] if part) for k in best]
    names = " or ".join(" + ".join(term.label for term in model) or "base model" for model, _ in rivals[:3])
    return (
        f"to tell {names} apart, measure at {'; '.join(labels)}: there they differ by up to "
        f"{apart[best[0]]:.2g} mg ({apart[best[0]] / max(noise, 1e-12):.1f} standard uncertainties of a "
        "reading)"
    )


def _options(data: Observations) -> tuple[Observations, list[tuple[str, ...]]]:
    """Imagined dwells after the session's last one."""
    c = data.conditions
    later = float(c.time_s.max() + np.ptp(c.time_s) / max(len(data) - 1, 1))
    waits = (0.0, float(np.ptp(c.time_s)))
    temperatures: list[float | None] = [None]
    if c.temperature_c is not None:
        low, high = float(c.temperature_c.min()), float(c.temperature_c.max())
        temperatures = [low - 5, (low + high) / 2, high + 5]
    supplies: list[float | None] = [None]
    if c.supply_v is not None:
        supplies = [float(c.supply_v.min()), float(c.supply_v.max())]
    sides = (1.0, -1.0) if c.approach is not None else (0.0,)
    places: list[tuple[str, Floats]] = []
    if data.planar:
        places = [(f"{a}°", np.array([np.deg2rad(a)])) for a in range(0, 360, 15)]
    else:
        for v in itertools.product((-1, 0, 1), repeat=3):
            if any(v):
                unit = np.array(v, dtype=float) / np.linalg.norm(v)
                word = " ".join(f"{'+' if s > 0 else '−'}{AXES[k]}" for k, s in enumerate(v) if s)
                places.append((f"gravity along {word}", unit))
    rows = list(itertools.product(places, waits, temperatures, supplies, sides))
    n = len(rows)
    time = np.array([later + wait for _, wait, _, _, _ in rows])
    angle = np.array([p[1][0] for p, *_ in rows]) if data.planar else None
    temperature = None if c.temperature_c is None else np.array([t for _, _, t, _, _ in rows], dtype=float)
    history = c.temperature_history
    conditions = Conditions(
        time_s=time,
        angle_rad=angle,
        order=None if c.order is None else np.full(n, c.order.max() + 1),
        approach=None if c.approach is None else np.array([s for *_, s in rows]),
        previous_angle_rad=None if c.previous_angle_rad is None else np.zeros(n),
        temperature_c=temperature,
        supply_v=None if c.supply_v is None else np.array([v for *_, v, _ in rows], dtype=float),
        temperature_history=history,
        variance_mg2=None if c.variance_mg2 is None else np.tile(c.variance_mg2.mean(axis=0), (n, 1)),
    )
    mean = np.zeros((n, data.axes))
    if not data.planar:
        mean = data.gravity_mg * np.array([p[1] for p, *_ in rows])
    words: list[tuple[str, ...]] = []
    for (place, _), wait, t, volts, side in rows:
        words.append(
            (
                place,
                "" if wait == 0 else f"{wait / 60:.0f} min later",
                "" if t is None else f"at {t:.0f} °C",
                "" if volts is None else f"at {volts:.2f} V",
                "" if side == 0 else f"approached from {'below' if side > 0 else 'above'}",
            )
        )
    options = Observations(
        mean_mg=mean,
        covariance=np.tile(data.covariance.mean(axis=0), (n, 1, 1)),
        noise_dof=data.noise_dof,
        known=data.known,
        conditions=conditions,
        gravity_mg=data.gravity_mg,
        fixture_rad=data.fixture_rad,
        check=np.zeros(n, dtype=bool),
        position=np.arange(n),
        zero_unknown=data.zero_unknown,
    )
    return options, words


def _predicted(options: Observations, model: Sequence[Term], fitted: State) -> Floats:
    """Predictions (n, axes) in the plane; in space the norm's excess over G (n, 1), attitude unknown."""
    n = len(options)
    if options.planar:
        state = State(fitted.base, np.zeros(n), np.zeros((n, 0)), fitted.values)
        return predict(options, model, state).predicted_mg
    unit = options.mean_mg / np.linalg.norm(options.mean_mg, axis=1, keepdims=True)
    state = State(fitted.base, np.zeros(n), unit, fitted.values)
    # Only what is across the tangents can be seen: the prediction's part along the reading.
    at = predict(options, model, settle(options, model, state, passes=0))
    along: Floats = (at.predicted_mg * unit).sum(axis=1, keepdims=True)
    return along


def _coverage(data: Observations, detectable: dict[str, Detectable]) -> list[str]:
    """What the session could not show at all, with what would show it."""
    lines = []
    c = data.conditions
    if data.planar and c.angle_rad is not None:
        places = len(np.unique(np.round(np.mod(c.angle_rad, 2 * np.pi), 3)))
        if places < 9:
            order = (places - 1) // 2
            lines.append(
                f"{places} different angles show harmonics up to {order} only; a quadratic needs 5 angles, "
                "a cubic 7, an asymmetry 9: add positions between (every 40° or closer)"
            )
        if c.approach is None or len(np.unique(c.approach)) < 2:
            lines.append("approach several positions from both sides: backlash and hysteresis need it")
        order_of = (
            np.corrcoef(c.time_s, c.angle_rad)[0, 1] if len(data) > 2 and np.ptp(c.angle_rad) else 0.0
        )
        if abs(order_of) > 0.95:
            lines.append(
                "positions came in order, so that time is angle: repeat some in another order to see drift "
                "apart from the stage"
            )
    if c.temperature_c is None:
        lines.append("no temperature was recorded: terms in temperature cannot be looked for")
    elif np.ptp(c.temperature_c) < 1.0:
        lines.append(
            f"the temperature moved by {np.ptp(c.temperature_c):.1f} °C only: repeat positions at two "
            "temperatures"
        )
    del detectable
    return lines
