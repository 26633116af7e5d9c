"""One dwell in one pose, sample by sample: what the zero follows while the part stands still.

A pose cannot show gains, angles or a bias, so the base model is a constant an axis and the effects are
those that move in time: temperature (to the third power), its lag, drift, warm-up, supply. Neighbouring
samples are no independent witnesses, so that nothing here rests on their noise: an effect is added where
it lowers the error in blocks of time that took no part in its fit, in most blocks (t-test over blocks,
family-wise 1 %).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adis_gonio.errors import FitError
from adis_gonio.model.effects import AXES, Conditions, Effect, effect
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Floats, Session
from adis_gonio.sensor.variants import VARIANTS
from adis_gonio.tracing.result import Detectable, ErrorFigures, Finding, Step, TraceResult, Value

BLOCKS = 10
LEAST_ROWS = 200
LEVEL = 0.01
LEAST_GAIN = 0.02
"""Least relative fall of the held-out error for another effect."""
DEGREES = (1, 2, 3)
TAUS = 14


@dataclass(frozen=True)
class _Candidate:
    """An effect with its shape on the grid, and its columns (n, d) of one axis."""

    effect: Effect
    shape: float | None
    columns: Floats


def trace_series(session: Session, max_effects: int = 6) -> TraceResult:
    """Trace the samples of a session of one pose.

    Raises
    ------
    FitError
        Too few samples, or nothing recorded beside them that they could follow.
    """
    dwell = next(dwell for dwell in session.dwells if len(dwell))
    where = f"{session.source}: " if session.source else ""
    if len(dwell) < LEAST_ROWS:
        raise FitError(
            f"{where}one position with {len(dwell)} samples shows nothing to trace; measure at least two "
            f"positions, or at least {LEAST_ROWS} samples while the temperature changes"
        )
    if dwell.temperature_c is None:
        raise FitError(
            f"{where}one position only and no temperature: nothing that the readings could follow; measure "
            "at least two positions"
        )
    readings = dwell.accel * _mg(session, dwell)
    conditions = _conditions(dwell)
    blocks = np.arange(len(readings)) * BLOCKS // len(readings)
    candidates = _candidates(conditions, readings.shape[1])
    model: list[list[_Candidate]] = []
    losses = _held_out(readings, [], blocks)
    history = [("base", _figures(readings, [], blocks))]
    tests: list[float] = []
    while len(model) < max_effects:
        chosen, p, better = _best_addition(readings, model, candidates, blocks, losses)
        if chosen is None:
            break
        # A higher degree takes the place of the lower one.
        model = [m for m in model if m[0].effect.name != chosen[0].effect.name] + [chosen]
        losses = better
        tests.append(p)
        history.append((chosen[0].effect.name, _figures(readings, model, blocks)))
    steps = [(name, error) for name, error in history[1:]]
    last: dict[str, int] = {name: k for k, (name, _) in enumerate(steps)}
    kept = [steps[k] for k in sorted(last.values())]
    findings = tuple(_finding(readings, model, k, blocks, tests) for k in range(len(model)))
    by_axis = np.sqrt(_held_out(readings, model, blocks).sum(axis=0) / len(readings))
    return TraceResult(
        adequate=False,
        found=findings,
        steps=tuple(Step(name, error) for name, error in kept),
        confounded=(),
        unnamed=None,
        before=history[0][1],
        after=history[-1][1],
        detectable=_detectable(readings, model, blocks),
        advice=(
            "one pose cannot tell a change of zero from a change of gain: repeat the cycle with the part "
            "turned over (each axis once up and once down)",
        ),
        notes=(
            "one pose, traced sample by sample; adequacy cannot be tested, since the noise of neighbouring "
            "samples is not independent",
            f"held-out rms by axis, {BLOCKS} blocks of time: "
            + ", ".join(f"{AXES[k]} {value:.2f} mg" for k, value in enumerate(by_axis)),
        ),
        heldout_design=f"{BLOCKS} blocks of time",
    )


def _mg(session: Session, dwell: Dwell) -> float:
    if session.accel_unit == "lsb":
        return VARIANTS[session.sensor].accel_mg_per_lsb
    if session.accel_unit == "counts":
        return session.gravity_mg / max(float(np.linalg.norm(dwell.accel.mean(axis=0))), 1e-12)
    return {"mg": 1.0, "g": 1000.0, "mps2": 1000.0 / STANDARD_GRAVITY_MPS2}[session.accel_unit]


def _conditions(dwell: Dwell) -> Conditions:
    time = dwell.time_s - dwell.time_s[0]
    assert dwell.temperature_c is not None
    return Conditions(
        time_s=time,
        temperature_c=dwell.temperature_c,
        supply_v=dwell.supply_v,
        temperature_history=(time, dwell.temperature_c) if (np.diff(time) > 0).all() else None,
    )


def _candidates(conditions: Conditions, axes: int) -> list[list[_Candidate]]:
    """Groups of variants: one is added at a time, the shape chosen axis by axis inside the fit."""
    ideal = np.ones((len(conditions), axes))
    length = float(np.ptp(conditions.time_s))
    groups = []
    letters = AXES[:axes]
    for degree in DEGREES:
        made = effect("bias_temperature", letters, degree=degree)
        columns = made.derivative(np.zeros(degree * axes), ideal, conditions)[:, 0, :degree]
        groups.append([_Candidate(made, None, columns)])
    if conditions.temperature_history is not None:
        groups.append(_shaped("thermal_lag", letters, ideal, conditions, length))
    groups.append(_shaped("warm_up", letters, ideal, conditions, length))
    for name in ("bias_drift", "supply_bias"):
        made = effect(name, letters)
        if not conditions.lacks(made.needs):
            columns = made.derivative(np.zeros(axes), ideal, conditions)[:, 0, :1]
            if np.ptp(columns) > 0:
                groups.append([_Candidate(made, None, columns)])
    return groups


def _shaped(
    name: str, letters: tuple[str, ...], ideal: Floats, conditions: Conditions, length: float
) -> list[_Candidate]:
    made = effect(name, letters)
    out = []
    for tau in np.geomspace(length / 500, length / 3, TAUS):
        values = np.zeros(len(letters) + 1)
        values[-1] = tau
        out.append(_Candidate(made, float(tau), made.derivative(values, ideal, conditions)[:, 0, :1]))
    return out


def _design(n: int, model: list[list[_Candidate]], pick: tuple[int, ...]) -> Floats:
    columns = [np.ones((n, 1)), *(group[k].columns for group, k in zip(model, pick, strict=True))]
    design = np.concatenate(columns, axis=1)
    scaled: Floats = design / np.maximum(np.abs(design).max(axis=0), 1e-300)
    return scaled


def _picks(model: list[list[_Candidate]]) -> list[tuple[int, ...]]:
    """Choices of shapes: every combination; of several grids, every third value of each."""
    several = sum(len(group) > 1 for group in model) > 1
    grids = [range(0, len(group), 3 if several else 1) for group in model]
    return list(itertools.product(*grids))


def _held_out(readings: Floats, model: list[list[_Candidate]], blocks: NDArray[np.intp]) -> Floats:
    """Held-out sums of squares (blocks, axes); shapes chosen on the other blocks only.

    Normal equations are summed block by block once a choice of shapes, so that leaving a block out is a
    subtraction.
    """
    n, axes = readings.shape
    picks = _picks(model)
    loss = np.full((len(picks), BLOCKS, axes), np.inf)
    inside = np.full((len(picks), BLOCKS, axes), np.inf)
    centred = readings - readings.mean(axis=0)
    for j, pick in enumerate(picks):
        design = _design(n, model, pick)
        parts = [design[blocks == b] for b in range(BLOCKS)]
        values = [centred[blocks == b] for b in range(BLOCKS)]
        gram = np.array([p.T @ p for p in parts])
        cross = np.array([p.T @ v for p, v in zip(parts, values, strict=True)])
        square = np.array([(v**2).sum(axis=0) for v in values])
        for b in range(BLOCKS):
            g, c = gram.sum(axis=0) - gram[b], cross.sum(axis=0) - cross[b]
            solved = np.linalg.lstsq(g, c, rcond=1e-12)[0]
            inside[j, b] = (square.sum(axis=0) - square[b]) - (c * solved).sum(axis=0)
            loss[j, b] = ((values[b] - parts[b] @ solved) ** 2).sum(axis=0)
    # One shape for all axes, as the effects have it; the logarithm lets each axis count alike.
    best = np.log(np.maximum(inside, 1e-300)).sum(axis=2).argmin(axis=0)
    chosen: Floats = loss[best, np.arange(BLOCKS)]
    return chosen


def _best_addition(
    readings: Floats,
    model: list[list[_Candidate]],
    candidates: list[list[_Candidate]],
    blocks: NDArray[np.intp],
    losses: Floats,
) -> tuple[list[_Candidate] | None, float, Floats]:
    """Group whose addition lowers the held-out error most, if the gain is real."""
    from scipy import stats

    inside = {m[0].effect for m in model}
    scale = losses.sum(axis=0)
    best: tuple[float, list[_Candidate] | None, float, Floats] = (0.0, None, 1.0, losses)
    for group in candidates:
        if group[0].effect in inside:
            continue
        trial = [m for m in model if m[0].effect.name != group[0].effect.name] + [group]
        new = _held_out(readings, trial, blocks)
        gains = np.log(losses / np.maximum(new, 1e-300))
        relative = 1 - float(np.sqrt((new.sum(axis=0) / scale).mean()))
        p = float(stats.ttest_1samp(gains.mean(axis=1), 0.0, alternative="greater").pvalue)
        # Blocks differ much in how much they have to gain, so that the sum over blocks counts as well.
        if p < LEVEL * 10 / len(candidates) and relative > max(LEAST_GAIN, best[0]):
            best = (relative, group, p, new)
    return best[1], best[2], best[3]


def _figures(readings: Floats, model: list[list[_Candidate]], blocks: NDArray[np.intp]) -> ErrorFigures:
    fitted, _ = _fitted(readings, model)
    return ErrorFigures(
        residual_rms_mg=float(np.sqrt(((readings - fitted) ** 2).mean())),
        heldout_rms_mg=float(np.sqrt(_held_out(readings, model, blocks).sum() / readings.size)),
        angle_rms_deg=None,
        chi2_per_dof=None,
    )


def _fitted(
    readings: Floats, model: list[list[_Candidate]]
) -> tuple[Floats, list[tuple[tuple[int, ...], Floats]]]:
    """Fitted values (n, axes), and for each axis its shapes and coefficients (constant first)."""
    best: tuple[float, tuple[int, ...], Floats, Floats] | None = None
    for pick in _picks(model):
        columns = [np.ones((len(readings), 1)), *(g[k].columns for g, k in zip(model, pick, strict=True))]
        design = np.concatenate(columns, axis=1)
        size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        solved = np.linalg.lstsq(design / size, readings, rcond=None)[0]
        fitted = design / size @ solved
        loss = float(np.log(np.maximum(((readings - fitted) ** 2).sum(axis=0), 1e-300)).sum())
        if best is None or loss < best[0]:
            best = (loss, pick, solved / size[:, None], fitted)
    assert best is not None
    return best[3], [(best[1], best[2][:, axis]) for axis in range(readings.shape[1])]


def _finding(
    readings: Floats,
    model: list[list[_Candidate]],
    which: int,
    blocks: NDArray[np.intp],
    tests: list[float],
) -> Finding:
    made = model[which][0].effect
    _, per_axis = _fitted(readings, model)
    spread = _spread(readings, model, which, blocks)
    prototypes = [p for p in made.parameters if not p.shape]
    shape = next((p for p in made.parameters if p.shape), None)
    width = len(prototypes) // readings.shape[1]
    at = 1 + sum(group[0].columns.shape[1] for group in model[:which])
    parameters: dict[str, Value] = {}
    for axis, (pick, coefficients) in enumerate(per_axis):
        for k in range(width):
            prototype = prototypes[axis * width + k]
            parameters[prototype.name] = Value(
                float(coefficients[at + k]), float(spread[axis, k]), prototype.unit
            )
        chosen = model[which][pick[which]]
        if shape is not None and chosen.shape is not None:
            parameters[shape.name] = Value(chosen.shape, None, shape.unit)
    without = [m for k, m in enumerate(model) if k != which]
    base = float(_held_out(readings, [], blocks).sum())
    gain = float(_held_out(readings, without, blocks).sum() - _held_out(readings, model, blocks).sum())
    return Finding(
        effect=made.name,
        axes=made.axes,
        parameters=parameters,
        p_value=min(1.0, max(tests) if tests else 1.0),
        explains=float(np.clip(gain / base, 0, 1)),
        probability=1.0,
        cause=made.cause,
    )


def _spread(
    readings: Floats, model: list[list[_Candidate]], which: int, blocks: NDArray[np.intp]
) -> Floats:
    """Standard uncertainties (axes, width) by leaving out a block at a time (jackknife)."""
    at = 1 + sum(group[0].columns.shape[1] for group in model[:which])
    width = model[which][0].columns.shape[1]
    _, whole = _fitted(readings, model)
    values = np.zeros((BLOCKS, readings.shape[1], width))
    for axis, (pick, _) in enumerate(whole):
        columns = [np.ones((len(readings), 1)), *(g[k].columns for g, k in zip(model, pick, strict=True))]
        design = np.concatenate(columns, axis=1)
        size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
        for b in range(BLOCKS):
            rows = blocks != b
            solved = np.linalg.lstsq(design[rows] / size, readings[rows, axis], rcond=None)[0] / size
            values[b, axis] = solved[at : at + width]
    spread: Floats = np.sqrt((BLOCKS - 1) * values.var(axis=0))
    return spread


def _detectable(
    readings: Floats, model: list[list[_Candidate]], blocks: NDArray[np.intp]
) -> dict[str, Detectable]:
    out = {}
    for which, group in enumerate(model):
        spread = _spread(readings, model, which, blocks)
        parameter = group[0].effect.parameters[0]
        out[group[0].effect.name] = Detectable(
            float((2.58 + 1.28) * spread[:, 0].max()), parameter.unit, parameter.name
        )
    return out
