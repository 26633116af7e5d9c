"""The best plan for a number of positions, the fewest positions for a tolerance, and their text."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from adis_gonio.base.budget import check
from adis_gonio.base.conformity import Tolerance
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.base.numbers import (
    NAMES,
    count_decimals,
    counted,
    format_fixed,
    format_number,
    format_percent,
    format_unit,
    with_unit,
)
from adis_gonio.base.tables import align_columns, fold_text
from adis_gonio.base.uncertainty import Value
from adis_gonio.plan.plan_search import MEANING, Best, Candidates, Choice, Criterion, candidates, search
from adis_gonio.plan.prediction import (
    Bench,
    PlanUncertainty,
    Prediction,
    Sight,
    expected_readings,
    planned_terms,
    predict,
    predict_uncertainty,
)
from adis_gonio.record.plans import Plan, Position, plan

LEAST, MOST = 4, 100
"""Fewest and most positions of a searched plan: fewer do not determine a bias, and with more a search does
not improve the plan."""
DRAWN = 3
"""Random plans at the start of a search, in addition to even spacing in several orders and tumble."""
_GOLDEN = (3 - math.sqrt(5)) / 2
LEAST_GRID_DEG, WIDEST_GRID_DEG = 1.0, 60.0


class Gain(JsonRecord):
    """Comparison of the best plan with another plan of as many positions; one value of `gain` in JSON.

    Attributes
    ----------
    over : str
        The other plan.
    figure : float
        Criterion of the other plan, as the quantity that `MEANING` describes.
    criterion : float
        Figure of the other plan divided by the figure of the best plan (for `tell-apart` the inverse);
        above 1 if the best plan is better.
    u : dict of str to float
        Ratio of the standard uncertainties, the other plan to the best plan, for each parameter and the
        angle.
    """

    over: str = field(metadata=HIDDEN)
    figure: float
    criterion: float
    u: dict[str, float]


@dataclass(frozen=True)
class BestPlan:
    """The best plan with its prediction.

    Attributes
    ----------
    best : {"angle", "parameters", "tell-apart"}
    beware : tuple of str
        Effects that the session may have, which the plan shall detect.
    figure : float
        The criterion of the plan, as the quantity that `MEANING` describes.
    separations : dict of str to float
        For each amplitude of these effects, its typical size divided by its standard uncertainty.
    gains : tuple of Gain
        Comparison with even spacing, and with tumble if the number of positions is even.
    seed : int
    """

    prediction: Prediction
    best: Best
    beware: tuple[str, ...]
    figure: float
    separations: dict[str, float]
    gains: tuple[Gain, ...]
    seed: int
    grid_deg: float

    @property
    def plan(self) -> Plan:
        """The plan that the search found."""
        return self.prediction.plan

    def made_for(self) -> dict[str, Any]:
        """Return the settings and the result of the search, as they are stored in a plan file."""
        return {
            "best": self.best,
            "beware": list(self.beware),
            "criterion": MEANING[self.best],
            "figure": self.figure,
            "grid_deg": self.grid_deg,
            "seed": self.seed,
            "bench": self.prediction.bench.as_dict(),
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the prediction, the search and the comparison with other plans."""
        return {
            **self.prediction.as_dict(),
            **self.made_for(),
            "separations": dict(self.separations),
            "gain": {gain.over: gain.as_dict() for gain in self.gains},
        }


def best_plan(
    bench: Bench,
    positions: int,
    best: Best = "angle",
    beware: Sequence[str] = (),
    *,
    grid_deg: float = 5.0,
    seed: int = 1,
) -> BestPlan:
    """Search for the best plan with a number of positions, including their order and sides of approach.

    Parameters
    ----------
    beware : sequence of str
        Effects that a session may have: `tell-apart` distinguishes them; the other criteria add them to the
        fit.
    grid_deg : float
        Step of the searched angles.
    seed : int
        Seed of the search, which determines the plan.

    Raises
    ------
    UsageError
        An impossible number, criterion, grid or effect.
    """
    if best not in get_args(Best):
        raise UsageError(f"best is '{best}': take {', '.join(get_args(Best))}")
    if best == "tell-apart" and not beware:
        raise UsageError("best tell-apart needs effects to tell apart: name them with --beware")
    if not LEAST <= positions <= MOST:
        raise UsageError(f"positions is {positions}: the search takes {LEAST} to {MOST}")
    if not LEAST_GRID_DEG <= grid_deg <= WIDEST_GRID_DEG:
        raise UsageError(f"grid is {grid_deg:g}°: take {LEAST_GRID_DEG:g} to {WIDEST_GRID_DEG:g}°")
    beware = tuple(dict.fromkeys(beware))
    ground = candidates(bench, positions, beware, grid_deg)
    criterion = ground.criterion(best)
    rng = np.random.default_rng(seed)
    choice = search(ground, criterion, _starts(ground, positions, rng), rng).choice
    information = ground.information(choice)
    prediction = predict(ground.plan(f"{best}-{positions}", choice), bench)
    figure = criterion.figure(information)
    terms = planned_terms(expected_readings(_both_sides_plan(positions), bench), beware)
    amplitudes = [f"{t.name}.{t.effect.parameters[k].name}" for t in terms for k in t.amplitudes]
    separations = criterion.separations(information[None])[0].tolist()
    return BestPlan(
        prediction,
        best,
        beware,
        figure,
        dict(zip(amplitudes, separations, strict=True)),
        tuple(_gain(prediction, figure, other, ground, criterion) for other in _rivals(positions)),
        seed,
        grid_deg,
    )


def even_plan(positions: int) -> Plan:
    """Return a plan with this number of evenly spaced angles in one turn, in ascending order."""
    return Plan("even", tuple(Position(360.0 * k / positions) for k in range(positions)))


def _both_sides_plan(positions: int) -> Plan:
    """Return a plan of evenly spaced angles in which every second angle is approached from above."""
    return Plan(
        "even, both sides",
        tuple(Position(360.0 * k / positions, 1 if k % 2 == 0 else -1) for k in range(positions)),
    )


def interleaved_plan(positions: int) -> Plan:
    """Return a plan of evenly spaced angles, ordered in steps of about 0.38 turns (golden section).

    Slow changes with time are then not correlated with the angle.
    """
    # A step without a common divisor visits every position once.
    steps = [step for step in range(1, positions) if math.gcd(step, positions) == 1]
    step = min(steps, key=lambda one: abs(one / positions - _GOLDEN))
    places = [(k * step) % positions for k in range(positions)]
    return Plan("interleaved", tuple(Position(360.0 * k / positions) for k in places))


def _rivals(positions: int) -> tuple[Plan, ...]:
    """Return the usual plans with which the best plan is compared.

    These are even spacing and, for an even number of at least six positions, the tumble.
    """
    tumble = (plan("tumble", positions // 2),) if positions % 2 == 0 and positions >= 6 else ()
    return (even_plan(positions), *tumble)


def _starts(ground: Candidates, positions: int, rng: np.random.Generator) -> list[Choice]:
    known = (*_rivals(positions), _both_sides_plan(positions), interleaved_plan(positions))
    starts = [ground.nearest(other) for other in known]
    starts.append(rng.permutation(starts[0]))
    for _ in range(DRAWN):
        # Random candidates, repeated if there are fewer candidates than positions.
        drawn = rng.permutation(len(ground.angle_deg))
        starts.append(np.resize(drawn, positions).astype(np.intp))
    return starts


def _gain(ours: Prediction, figure: float, other: Plan, ground: Candidates, criterion: Criterion) -> Gain:
    """Compare the best plan with another plan: ratio of the criterion and of each uncertainty.

    The criterion of the other plan is computed at the nearest angles of the grid.
    """
    theirs = criterion.figure(ground.information(ground.nearest(other)))
    reach = predict_uncertainty(other, ours.bench)
    pairs = {name: (value.u, ours.reach.parameters.get(name)) for name, value in reach.parameters.items()}
    # Only parameters that both plans determine have a ratio.
    ratios = {name: (u or 0.0) / one.u for name, (u, one) in pairs.items() if one is not None and one.u}
    ratios["angle_worst"] = (reach.angle_worst.u or 0.0) / (ours.reach.angle_worst.u or math.inf)
    ratios["angle_worst_by_parameters"] = reach.fitted_deg / ours.reach.fitted_deg
    pair = (figure, theirs) if criterion.name == "tell-apart" else (theirs, figure)
    better = pair[0] / pair[1] if pair[1] > 0 else math.inf
    return Gain(other.name, theirs, better, ratios)


def fewest_positions(
    bench: Bench,
    tolerance: Tolerance,
    best: Best = "angle",
    beware: Sequence[str] = (),
    *,
    grid_deg: float = 5.0,
    seed: int = 1,
) -> BestPlan:
    """Search for the best plan with the fewest positions after which the angle conforms to a tolerance.

    The search begins with the smallest sufficient number of interleaved positions, and reduces the number
    as long as the best plan can decide.

    Raises
    ------
    UsageError
        A plan of `MOST` positions cannot decide.
    """
    count = _fewest_interleaved(bench, tolerance)
    found = best_plan(bench, count, best, beware, grid_deg=grid_deg, seed=seed)
    while count > LEAST:
        check()
        trial = best_plan(bench, count - 1, best, beware, grid_deg=grid_deg, seed=seed)
        if not _decides(trial.prediction.reach, tolerance):
            break
        found, count = trial, count - 1
    return found


def _decides(reach: PlanUncertainty, tolerance: Tolerance) -> bool:
    conformity = reach.conformity(tolerance)
    return conformity is not None and conformity.verdict == "pass"


def _fewest_interleaved(bench: Bench, tolerance: Tolerance) -> int:
    """Return the smallest number of interleaved positions that can decide, by bisection.

    In one slow turn, more positions can be worse than fewer: the 1/f noise of a longer session has the
    period of the turn. Interleaved positions avoid that.
    """

    def decides(count: int) -> bool:
        check()
        try:
            return _decides(predict_uncertainty(interleaved_plan(count), bench), tolerance)
        except FitError:
            return False

    if not decides(MOST):
        raise UsageError(
            f"{counted(MOST, 'position')} cannot decide on {tolerance}: take longer dwells, a better stage"
            " or a quieter part"
        )
    # `high` always decides, `low` does not.
    low, high = LEAST - 1, MOST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if decides(middle) else (middle, high)
    return high


def positions_in(bench: Bench, minutes: float) -> int:
    """Return the number of positions that fit into a time, by the time model of a session.

    Raises
    ------
    UsageError
        The time is too short for the fewest positions of a search, or too long for the most.
    """
    count = math.floor(60 * minutes / bench.each_s + 1e-9) if math.isfinite(minutes) else -1
    if LEAST <= count <= MOST:
        return count
    least, most = (number * bench.each_s / 60 for number in (LEAST, MOST))
    raise UsageError(
        f"minutes is {minutes:g}: a plan of {LEAST} to {counted(MOST, 'position')} lasts {least:.2g} to "
        f"{most:.3g} min at {bench.each_s:.3g} s each; give a time in between, or change --dwell"
    )


# -- text for the terminal, at most 80 columns wide ---------------------------------------------------

WIDTH = 80
_GAINED = {
    "delta_k": "u(ΔK)",
    "delta_phi": "u(Δφ)",
    "angle_worst_by_parameters": "angle, fitted",
    "angle_worst": "angle, all",
}
_ASKED: dict[Best, str] = {
    "angle": "best for the angle (G-optimal)",
    "parameters": "best for the parameters (D-optimal)",
    "tell-apart": "best to tell apart",
}
_FIGURE: dict[Best, str] = {
    "angle": "u of the angle by the fitted parameters, worst place: {:.2g}°",
    "parameters": "generalised u of the parameters: {:.2g}",
    "tell-apart": "an effect of typical size exceeds the others by at least {:.2g} standard uncertainties",
}


def prediction_lines(
    prediction: Prediction, found: BestPlan | None = None, tolerance: Tolerance | None = None
) -> Iterator[str]:
    """Yield the lines of text that describe a prediction and the search, starting with the headline."""
    yield headline(prediction)
    if tolerance is not None:
        yield from fold_text(_decision(prediction.reach, tolerance), WIDTH)
    if found is not None:
        beware = f" {', '.join(found.beware)}" if found.best == "tell-apart" else ""
        fitted = f", {', '.join(found.beware)} fitted beside" if found.beware and not beware else ""
        figure = _FIGURE[found.best].format(found.figure)
        yield from fold_text(f"{_ASKED[found.best]}{beware}{fitted}; {figure}", WIDTH)
    yield ""
    yield from _reach_lines(prediction.reach)
    if found is not None:
        yield ""
        yield "Gain: the other plan's uncertainty through this one's"
        rows = [["over", "criterion", *_GAINED.values()]]
        for gain in found.gains:
            ratios = [_ratio(gain.u.get(name)) for name in _GAINED]
            rows.append([gain.over, _ratio(gain.criterion), *ratios])
        yield from align_columns(rows, texts=1)
    yield ""
    yield from _sight_lines(prediction.sight)
    yield ""
    yield "Positions, in this order"
    positions = [f"{k:>3}  {position}" for k, position in enumerate(prediction.plan.positions, 1)]
    yield from _columns(positions, least=24)
    for note in prediction.reach.notes:
        yield from fold_text(note, WIDTH)


def headline(prediction: Prediction) -> str:
    """Return a line with the plan's number of positions, its duration and the predicted angle error."""
    minutes = f"{max(prediction.seconds / 60, 1):.0f} min"
    count = counted(len(prediction.plan), "position")
    u, expanded = prediction.reach.angle.u, prediction.reach.angle_worst.U
    if u is None or expanded is None:
        return f"{count}, {minutes}: they do not determine an angle at this fixture"
    digits = count_decimals(min(u, expanded))
    angle = f"u {format_fixed(u, digits)}° rms, U {format_fixed(expanded, digits)}° at the worst place"
    return f"{count}, {minutes}: angle {angle}"


def _decision(reach: PlanUncertainty, tolerance: Tolerance) -> str:
    conformity = reach.conformity(tolerance)
    if conformity is None:
        return f"cannot decide on {tolerance}: the plan does not determine the angle"
    can = "decides" if conformity.verdict == "pass" else "cannot decide"
    risk = format_percent(conformity.false_accept)
    return f"{can} on {tolerance}: expected risk of a false accept {risk}"


def _reach_lines(reach: PlanUncertainty) -> Iterator[str]:
    def row(name: str, value: Value) -> list[str]:
        digits = count_decimals(value.u or 0.0)
        return [name, format_unit(value.unit), format_fixed(value.u, digits), format_fixed(value.U, digits)]

    yield f"Predicted, by method {reach.method}"
    yield from align_columns(
        [
            ["quantity", "unit", "u", "U (95 %)"],
            row("angle, rms over the turn", reach.angle),
            row("angle, worst place", reach.angle_worst),
            *(row(NAMES.get(name, name), value) for name, value in reach.parameters.items()),
        ]
    )
    if reach.undetermined:
        yield from fold_text(f"not determined: {', '.join(reach.undetermined)}", WIDTH, 2)


def _ratio(ratio: float | None) -> str:
    if ratio is None or math.isnan(ratio):
        return "–"
    return f"× {ratio:.2f}" if ratio < 100 else "× > 100"


def _sight_lines(sight: Sight) -> Iterator[str]:
    cells = []
    blind = defaultdict(list)
    for name, one in sight.detectable.items():
        if one.amplitude is None:
            blind[one.reason].append(name)
        else:
            cells.append(f"{name} {with_unit(format_number(one.amplitude, 2), one.unit)}")
    if cells:
        yield "Sees from this size on (found in 90 of 100 sessions)"
        yield from _columns(cells)
    yield "Cannot see"
    for reason, names in blind.items():
        yield from fold_text(f"{', '.join(names)}: {reason}", WIDTH, 2)
    yield "Cannot tell apart"
    others = defaultdict(list)
    for pair in sight.confounded:
        others[pair.one].append(pair.other)
    for name, several in others.items():
        yield from fold_text(f"{name} from {', '.join(several)}", WIDTH, 2)
    if not others:
        yield "  nothing of what it sees"


def _columns(cells: Sequence[str], least: int = 38) -> Iterator[str]:
    """Yield lines in which text cells are arranged in as many columns as the width allows.

    The cells run down each column.
    """
    width = max(least, *(len(cell) for cell in cells)) if cells else least
    across = max(1, (WIDTH - 2) // width)
    down = -(-len(cells) // across)
    for row in range(down):
        yield "  " + "".join(cell.ljust(width) for cell in cells[row::down]).rstrip()
