"""The best plan of a number of positions, and the fewest positions for an asked error of the angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.budget import check
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import HIDDEN, JsonRecord
from adis_gonio.base.numbers import counted
from adis_gonio.plan.candidates import Candidates, Choice, candidates
from adis_gonio.plan.criteria import CRITERIA, MEANING, Best, Criterion
from adis_gonio.plan.imagined import Bench
from adis_gonio.plan.prediction import PlanUncertainty, Prediction, predict, reach_of
from adis_gonio.plan.search import search
from adis_gonio.record.plans import Plan, Position, plan

LEAST, MOST = 4, 100
"""Positions of a plan that is searched for: fewer determine no bias, more are no matter of choice."""
DRAWN = 3
"""Random plans that the search begins with, beside even spacing in several orders and tumble."""
_GOLDEN = (3 - math.sqrt(5)) / 2
LEAST_GRID_DEG, WIDEST_GRID_DEG = 1.0, 60.0


@dataclass(frozen=True)
class Gain(JsonRecord):
    """What the best plan gains over another of as many positions.

    The JSON document is one value of `gain`.

    Attributes
    ----------
    over : str
        The other plan.
    figure : float
        The criterion of the other, in the units of `criteria.MEANING`.
    criterion : float
        The other's figure through the best one's (for `tell-apart` the inverse): above 1 is a gain.
    u : dict of str to float
        The other's standard uncertainty through that of the best one, for each parameter and the angle.
    """

    over: str = field(metadata=HIDDEN)
    figure: float
    criterion: float
    u: dict[str, float]


@dataclass(frozen=True)
class BestPlan:
    """The best plan with what it will reach.

    Attributes
    ----------
    best : {"angle", "parameters", "tell-apart"}
    beware : tuple of str
        Effects that were minded.
    figure : float
        Its criterion, in the units of `criteria.MEANING`.
    separations : dict of str to float
        Of each amplitude to beware of, of typical size: standard uncertainties beside all else.
    gains : tuple of Gain
        Over even spacing, and over tumble where the number is even.
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
        """The plan itself."""
        return self.prediction.plan

    def made_for(self) -> dict[str, Any]:
        """What a plan file keeps of how it was found."""
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
        """JSON form: the prediction, and how the plan was found."""
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
    """The best plan of a number of positions, order and sides of approach among it.

    Parameters
    ----------
    beware : sequence of str
        Effects that a session may have: `tell-apart` is about them; the others fit them beside.
    grid_deg : float
        Distance of the angles that are tried.
    seed : int
        Of the search: the same seed gives the same plan.

    Raises
    ------
    UsageError
        A number, a criterion, a grid or an effect that is not possible.
    """
    _check(positions, best, beware, grid_deg)
    beware = tuple(dict.fromkeys(beware))
    ground = candidates(bench, positions, beware, grid_deg)
    criterion = ground.criterion(best)
    rng = np.random.default_rng(seed)
    choice = search(ground, criterion, _starts(ground, positions, rng), rng).choice
    made = ground.plan(f"{best}-{positions}", choice)
    prediction = predict(made, bench)
    figure = criterion.figure(ground.information(choice))
    gains = tuple(_gain(prediction, figure, other, ground, criterion) for other in rivals(positions))
    apart = criterion.separations(ground.information(choice)[None])[0]
    return BestPlan(
        prediction,
        best,
        beware,
        figure,
        dict(zip(_amplitudes(bench, positions, beware), apart.tolist(), strict=True)),
        gains,
        seed,
        grid_deg,
    )


def _check(positions: int, best: str, beware: Sequence[str], grid_deg: float) -> None:
    if best not in CRITERIA:
        raise UsageError(f"best is '{best}': take {', '.join(CRITERIA)}")
    if best == "tell-apart" and not beware:
        raise UsageError("best tell-apart needs effects to tell apart: name them with --beware")
    if not LEAST <= positions <= MOST:
        raise UsageError(f"positions is {positions}: the search takes {LEAST} to {MOST}")
    if not LEAST_GRID_DEG <= grid_deg <= WIDEST_GRID_DEG:
        raise UsageError(f"grid is {grid_deg:g}°: take {LEAST_GRID_DEG:g} to {WIDEST_GRID_DEG:g}°")


def _amplitudes(bench: Bench, positions: int, beware: Sequence[str]) -> list[str]:
    from adis_gonio.plan.imagined import imagined
    from adis_gonio.plan.sight import plain_terms

    readings = imagined(turns(positions), bench)
    terms = plain_terms(readings, beware)
    return [f"{t.name}.{t.effect.parameters[k].name}" for t in terms for k in t.amplitudes]


def even(positions: int) -> Plan:
    """Evenly spaced angles in one turn, in order."""
    return Plan("even", tuple(Position(360.0 * k / positions) for k in range(positions)))


def turns(positions: int) -> Plan:
    """Evenly spaced angles, every second one from above."""
    return Plan(
        "even, both sides",
        tuple(Position(360.0 * k / positions, 1 if k % 2 == 0 else -1) for k in range(positions)),
    )


def interleaved(positions: int) -> Plan:
    """Evenly spaced angles, each about a golden section of the turn from the one before.

    What changes slowly with time is then nothing that changes with the angle.
    """
    steps = [step for step in range(1, positions) if math.gcd(step, positions) == 1]
    step = min(steps, key=lambda one: abs(one / positions - _GOLDEN))
    places = [(k * step) % positions for k in range(positions)]
    return Plan("interleaved", tuple(Position(360.0 * k / positions) for k in places))


def rivals(positions: int) -> tuple[Plan, ...]:
    """Plans of as many positions that a best one is compared with: even spacing, and tumble."""
    tumble = (plan("tumble", positions // 2),) if positions % 2 == 0 and positions >= 6 else ()
    return (even(positions), *tumble)


def _starts(ground: Candidates, positions: int, rng: np.random.Generator) -> list[Choice]:
    starts = [
        ground.nearest(other) for other in (*rivals(positions), turns(positions), interleaved(positions))
    ]
    starts.append(rng.permutation(starts[0]))
    for _ in range(DRAWN):
        drawn = rng.permutation(len(ground.angle_deg))
        starts.append(np.resize(drawn, positions).astype(np.intp))
    return starts


def _gain(ours: Prediction, figure: float, other: Plan, ground: Candidates, criterion: Criterion) -> Gain:
    """What ours gains over another; its criterion is that of the search, at the grid's angles."""
    theirs = criterion.figure(ground.information(ground.nearest(other)))
    reach = reach_of(other, ours.bench)
    pairs = {name: (value.u, ours.reach.parameters.get(name)) for name, value in reach.parameters.items()}
    ratios = {name: (u or 0.0) / one.u for name, (u, one) in pairs.items() if one is not None and one.u}
    ratios["angle_worst"] = (reach.angle_worst.u or 0.0) / (ours.reach.angle_worst.u or math.inf)
    ratios["angle_worst_by_parameters"] = reach.fitted_deg / ours.reach.fitted_deg
    pair = (figure, theirs) if criterion.name == "tell-apart" else (theirs, figure)
    better = pair[0] / pair[1] if pair[1] > 0 else math.inf
    return Gain(other.name, theirs, better, ratios)


def fewest(
    bench: Bench,
    angle_deg: float,
    best: Best = "angle",
    beware: Sequence[str] = (),
    *,
    grid_deg: float = 5.0,
    seed: int = 1,
) -> BestPlan:
    """The best plan with the fewest positions whose angle error (rms over the turn) is as asked.

    From the fewest interleaved ones downwards, as long as a search finds a plan that still holds.

    Raises
    ------
    UsageError
        One reading alone is less sure than that, or `MOST` positions are.
    """
    if not (math.isfinite(angle_deg) and angle_deg > 0):
        raise UsageError(f"angle-error is {angle_deg:g}°: take an angle above 0°")
    count = _fewest_interleaved(bench, angle_deg)
    found = best_plan(bench, count, best, beware, grid_deg=grid_deg, seed=seed)
    while count > LEAST:
        check()
        trial = best_plan(bench, count - 1, best, beware, grid_deg=grid_deg, seed=seed)
        if _error(trial.prediction.reach) > angle_deg:
            break
        found, count = trial, count - 1
    return found


def _error(reach: PlanUncertainty) -> float:
    return math.inf if reach.angle.u is None else reach.angle.u


def _fewest_interleaved(bench: Bench, angle_deg: float) -> int:
    """Fewest interleaved positions that hold an angle; by bisection.

    In one slow turn more positions may be worse than fewer: the 1/f noise of a longer session has the
    period of the turn. Interleaved it has none.
    """

    def error(count: int) -> float:
        check()
        try:
            return _error(reach_of(interleaved(count), bench))
        except FitError:
            return math.inf

    if error(MOST) > angle_deg:
        raise UsageError(
            f"angle-error is {angle_deg:g}°: {counted(MOST, 'position')} reach {error(MOST):.2g}°, most of "
            "which is a single reading's own; take longer dwells or a quieter part"
        )
    low, high = LEAST - 1, MOST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if error(middle) <= angle_deg else (middle, high)
    return high


def within(bench: Bench, minutes: float) -> int:
    """How many positions there is time for, by the time model of a session.

    Raises
    ------
    UsageError
        Less time than the fewest positions of a search take, or more than the most.
    """
    count = math.floor(60 * minutes / bench.each_s + 1e-9) if math.isfinite(minutes) else -1
    if LEAST <= count <= MOST:
        return count
    least, most = (number * bench.each_s / 60 for number in (LEAST, MOST))
    raise UsageError(
        f"minutes is {minutes:g}: a search takes {LEAST} to {counted(MOST, 'position')}, {least:.2g} to "
        f"{most:.3g} min at {bench.each_s:.3g} s each; take a time between, or another --dwell"
    )
