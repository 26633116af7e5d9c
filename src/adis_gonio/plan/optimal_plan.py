"""The best plan for a number of positions, and the fewest positions for a tolerance.

A search exchanges candidate positions to increase a criterion, computed from the information matrix of the
plan.

The information matrix M (p, p) has rows for start angle, gains, Δφ and biases in natural units (1 rad, 1,
local gravity), then for the amplitudes of the possible effects, each in units of its typical size on a
bench. An amplitude has a prior about zero with a standard deviation of `TYPICALS` of these units. V = M⁻¹
is the covariance, V_b its block of start angle, gains, Δφ and biases, and V_ee the variance of one
amplitude.

| name | maximised | known as |
|---|---|---|
| `angle` | −max over the turn of ln gᵀ V_b g, g the gradient of the calibrated angle | G-optimality |
| `parameters` | −ln det V_b, divided by the number of parameters | D-optimality; D_s with effects |
| `tell-apart` | min over amplitudes of ln(1/V_ee − 1/prior²), plus their mean/100 | maximin D_s, s = 1 |

1/V_ee − 1/prior² is the information on one amplitude that neither the base model nor another effect takes
away: the square of the number of standard uncertainties by which an effect of typical size is detected.
Smith 1918, Kiefer and Wolfowitz 1960 (G and D); Atkinson, Donev and Tobias 2007 (D_s); Chaloner and
Verdinelli 1995 (with a prior).

Coordinate exchange (Meyer and Nachtsheim, Technometrics 37, 1995) after Fedorov (1972): each dwell in turn
takes the best position given the other dwells; then the dwells are exchanged in pairs, because the order
matters for the shared noise and for changes with time. Two consecutive dwells never have the same angle,
because a stage that was not turned repeats its error.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.budget import check
from adis_gonio.base.conformity import Tolerance
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import HIDDEN, INLINE, KEYED_BY_NAME, JsonRecord, key
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
from adis_gonio.fitting.determination import natural_units
from adis_gonio.fitting.estimation.fit import Fit, Values
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.uncertainty import ShownAngle
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.plan.prediction import (
    Bench,
    PlanUncertainty,
    Prediction,
    Sight,
    expected_readings,
    ideal_mg,
    planned_terms,
    predict,
    predict_uncertainty,
)
from adis_gonio.record.plans import Approach, Plan, Position, plan
from adis_gonio.tracing.proposals import TYPICALS

Best = Literal["angle", "parameters", "tell-apart"]
MEANING: dict[Best, str] = {
    "angle": "u of the angle by the fitted parameters, worst place of the turn, in degrees",
    "parameters": "geometric mean of the u along the axes of the parameters' covariance, in natural units",
    "tell-apart": "least separation of a typical effect from all others, in standard uncertainties",
}
"""Quantity that each criterion of a search describes, as the user sees it (`Candidates.figure`)."""
Choice = NDArray[np.intp]
"""Plan as an array (n,): the index of a candidate position for each dwell."""
_MEAN_WEIGHT = 0.01
"""Weight of the mean separation of the effects relative to the smallest separation, in the score
`tell-apart`. The mean decides between plans with equal smallest separations."""
_NOTHING = 1e-12
"""Squared separation of an effect (`separations`) below which a plan has no information on the effect."""
_LOOSE = 1.0
"""Prior standard deviation of a base parameter in natural units, so large that it has no influence."""
_HIDDEN = 1e-6
"""Part of an effect's column that the base model cannot imitate, relative to the column, up to which no
plan shows the effect."""
_LEAST_GAIN = 1e-7
"""Smallest increase of a criterion that counts as an improvement and not as a rounding error."""
_MOST_SWEEPS = 50
_WORK = 240
"""Limit of the number of improved starts times the number of dwells; for long plans only the best starts
are improved."""
_PAIRS = 300
"""Largest number of swaps of two dwells that are tried in a pass; if there are more pairs, they are
sampled."""
SIMPLER = 1e-3
"""Decrease of a plan's score (a logarithm) that is accepted for positions in the order of their angles."""


@dataclass(frozen=True)
class Candidates:
    """Derivatives and noise of the readings for each of m candidate positions in each of n dwells.

    Plans from these positions are scored by the criterion `best`, from their information matrices.

    Attributes
    ----------
    best : {"angle", "parameters", "tell-apart"}
        Quantity that a plan is scored by: the largest u of the angle over the turn, the geometric mean of
        the u along the axes of the parameters' covariance, or the least separation of a typical effect from
        all others, in standard uncertainties.
    angle_deg, approach : (m,) float
        Angle and side of approach of each candidate position; the side is 0 if no effect depends on it.
    columns : (n, m, 2, p) float
        Derivative in mg of each reading by each of p parameters: base parameters in natural units,
        amplitudes of effects in units of their typical size.
    noise : (m, 2, 2) float
        Covariance in mg² of a reading by its noise and the fixture's errors, without noise that dwells
        share.
    own : (n, 2) float
        Additional variance in mg² of a reading in each dwell, which depends on its time.
    shared : (2 n, 2 n) float
        Covariance in mg² of the noise that dwells share, in the order dwell by dwell and axis by axis.
    base : int
        Number of parameters of the base model and biases, the first of the p.
    gradient : (k, base) float
        Derivative of the calibrated angle in degrees by the base parameters, at k angles around the turn.
    amplitudes : tuple of str
        Names of the amplitudes of effects, the last of the p parameters.
    """

    best: Best
    angle_deg: Floats
    approach: Floats
    columns: Floats
    noise: Floats
    own: Floats
    shared: Floats
    base: int
    gradient: Floats
    amplitudes: tuple[str, ...]

    @property
    def precision(self) -> Floats:
        """Inverse prior variance of each parameter, (p,).

        Base parameters are in natural units, amplitudes of effects in units of their typical size.
        """
        precision = np.full(self.columns.shape[3], 1 / TYPICALS**2)
        precision[: self.base] = 1 / _LOOSE**2
        return precision

    def scores(self, information: Floats) -> Floats:
        """Return the scores (k,) of k plans by their information matrices (k, p, p); larger is better.

        The matrices include the prior. Logarithms make the scores additive and independent of the units.
        """
        if self.best == "tell-apart":
            apart = np.log(self.separations(information) ** 2 + _NOTHING)
            return np.asarray(apart.min(axis=1) + _MEAN_WEIGHT * apart.mean(axis=1))
        covariance = np.linalg.inv(information)[:, : self.base, : self.base]
        if self.best == "parameters":
            return np.asarray(-np.linalg.slogdet(covariance)[1] / self.base)
        # Variance gᵀ V g at each angle, with the gradient g: the largest of the turn.
        variance = np.einsum("mp,kpq,mq->km", self.gradient, covariance, self.gradient).max(axis=1)
        return np.asarray(-np.log(variance))

    def score(self, choice: Choice) -> float:
        """Return the score of the plan with the position choice[k] in dwell k; larger is better."""
        return float(self.scores(self.information(choice)[None])[0])

    def repeats(self, choice: Choice) -> bool:
        """Return True if two consecutive dwells of a plan are at an equal angle."""
        return bool((np.diff(self.angle_deg[choice]) == 0).any())

    def separations(self, information: Floats) -> Floats:
        """Return the typical size of each of q amplitudes divided by its standard uncertainty, (k, q).

        `information` (k, p, p) are the information matrices of k plans, which include the prior.
        """
        # Diagonal of each covariance matrix, for the amplitudes.
        variance = np.einsum("kpp->kp", np.linalg.inv(information))[:, self.base :]
        return np.asarray(np.sqrt(np.maximum(1 / variance - self.precision[self.base :], 0.0)))

    def figure(self, information: Floats) -> float:
        """Return the quantity by which the criterion judges a plan, for people instead of as a score.

        It is the largest u of the angle in degrees, the geometric mean of the u along the principal axes of
        the covariance V of the b base parameters (in natural units, (det V)^(1/2b)), or the least number of
        standard uncertainties by which an effect of typical size is detected. `information` (p, p) is the
        plan's information matrix, which includes the prior.
        """
        if self.best == "tell-apart":
            return float(self.separations(information[None]).min())
        return float(np.exp(-0.5 * self.scores(information[None])[0]))

    def _covariance(self, choice: Choice) -> Floats:
        """Return the covariance (2 n, 2 n) in mg² of the readings of the plan `choice` with n dwells."""
        n = len(choice)
        covariance = self.shared.copy()
        each = np.arange(n)
        # Add each dwell's own noise to the 2 × 2 blocks on the diagonal.
        own = self.noise[choice] + self.own[:, :, None] * np.eye(2)
        covariance.reshape(n, 2, n, 2)[each, :, each, :] += own
        return covariance

    def information(self, choice: Choice) -> Floats:
        """Return the information matrix (p, p) of the plan with the position choice[k] in dwell k.

        The numbers in `choice` are indices of candidate positions. The matrix includes the prior.
        """
        n, p = len(self.columns), self.columns.shape[3]
        # Rows of the plan's Jacobian, J; the information is Jᵀ C⁻¹ J.
        rows = self.columns[np.arange(n), choice].reshape(2 * n, p)
        solved = np.linalg.solve(self._covariance(choice), rows)
        return np.asarray(rows.T @ solved + np.diag(self.precision))

    def exchanged(self, choice: Choice, dwell: int) -> Floats:
        """Return the information matrices (m, p, p) of the plans with one dwell moved to each position.

        `choice` is the present plan, `dwell` the index of the moved dwell. The information of the plan is
        the information of the readings r of all other dwells plus the information of the readings i of this
        dwell, given r. With the Jacobian J and the covariance C of the readings, and B = C_ir C_rr⁻¹, the
        latter is (J_i − B J_r)ᵀ (C_ii − B C_ri)⁻¹ (J_i − B J_r).
        """
        n, p = len(self.columns), self.columns.shape[3]
        rows = self.columns[np.arange(n), choice].reshape(2 * n, p)
        # Mask of the two rows of this dwell.
        here = np.zeros(2 * n, dtype=bool)
        here[2 * dwell : 2 * dwell + 2] = True
        covariance = self._covariance(choice)
        across = self.shared[np.ix_(~here, here)]
        # C_rr⁻¹ applied to J_r and to C_ri at once.
        solved = np.linalg.solve(
            covariance[np.ix_(~here, ~here)], np.concatenate([rows[~here], across], axis=1)
        )
        rest = rows[~here].T @ solved[:, :p] + np.diag(self.precision)
        # J_i − B J_r and C_ii − B C_ri for each candidate position, (m, 2, p) and (m, 2, 2).
        innovation = self.columns[dwell] - across.T @ solved[:, :p]
        own = self.noise + np.diag(self.own[dwell]) + self.shared[np.ix_(here, here)]
        given = own - across.T @ solved[:, p:]
        return np.asarray(rest + innovation.transpose(0, 2, 1) @ np.linalg.solve(given, innovation))

    def plan(self, name: str, choice: Choice) -> Plan:
        """Return a plan of this name from a choice of candidate positions (one index for each dwell).

        If no effect depends on the side of approach, all positions are approached from below: an unexpected
        backlash of the stage then changes only the start angle.
        """
        places = zip(self.angle_deg[choice].tolist(), self.approach[choice], strict=True)
        return Plan(name, tuple(Position(angle, -1 if side < 0 else 1) for angle, side in places))

    def nearest(self, plan: Plan) -> Choice:
        """Return the candidate positions (n,) that are nearest to the positions of a plan."""
        choice = []
        for position in plan.positions:
            # The nearest angle; among equal angles the one with the right side of approach.
            off = np.abs(wrap_degrees(self.angle_deg - (position.angle_deg or 0.0)))
            choice.append(int((off + 1e-3 * (self.approach != position.approach)).argmin()))
        return np.array(choice, dtype=np.intp)


def candidates(
    bench: Bench, dwells: int, beware: Sequence[str], grid_deg: float, best: Best = "angle"
) -> Candidates:
    """Return the candidate positions of a search: on a grid of angles and at even spacing.

    The grid has steps of `grid_deg`; the plan has `dwells` positions and is scored by the criterion `best`.

    If an effect in `beware` depends on the side of approach, each angle is a candidate from both sides.

    Raises
    ------
    UsageError
        `beware` names an effect that the positions do not influence, or that no plan can show.
    """
    # The grid and the even spacing, without duplicates.
    even = 360.0 * np.arange(dwells) / dwells
    angles = np.unique(np.round(np.concatenate([np.arange(0.0, 360.0 - 1e-9, grid_deg), even]), 9))
    readings = expected_readings(even_plan(dwells, both_sides=True), bench)
    terms = planned_terms(readings, beware)
    sided = any("approach" in term.effect.needs for term in terms)
    sides = [1.0, -1.0] if sided else [0.0]
    place, side = np.tile(angles, len(sides)), np.repeat(sides, len(angles))
    fit = _fit_everywhere(bench, readings, place, np.where(side == 0, 1.0, side))
    natural = natural_units(fit.data)
    # Columns of the base model in natural units, then of each effect in its typical size.
    columns = [fit.columns * natural]
    for term in terms:
        typical = np.array([term.effect.parameters[k].typical for k in term.amplitudes])
        columns.append(fit.candidate(term) * np.abs(typical))
        _refuse_hidden(term, columns[0], columns[-1])
    m, n, base = len(place), len(readings), len(natural)
    # Change of a reading by the angle; it carries the fixture's error into the noise.
    tangent = fit.tangent[:m, :, 0]
    flicker = readings.flicker
    assert flicker is not None  # expected readings state it, even if it is zero
    white = float(readings.own_covariance[0, 0, 0] - flicker[0, 0])
    slow = readings.slow.reshape(2 * n, readings.slow.shape[2])
    return Candidates(
        best=best,
        angle_deg=place,
        approach=side,
        columns=np.concatenate(columns, axis=2).reshape(dwells, m, 2, -1),
        noise=white * np.eye(2) + readings.fixture_rad**2 * tangent[:, :, None] * tangent[:, None, :],
        own=flicker,
        shared=np.asarray(slow @ slow.T),
        base=base,
        gradient=ShownAngle.around(fit).gradient,
        amplitudes=tuple(f"{t.name}.{t.effect.parameters[k].name}" for t in terms for k in t.amplitudes),
    )


def _fit_everywhere(bench: Bench, readings: Readings, place: Floats, side: Floats) -> Fit:
    """Return the base model with biases of an ideal sensor at all m positions in each dwell.

    The positions have the angles `place` (m,) in degrees and the sides of approach `side` (m,).
    """
    n, m = len(readings), len(place)
    angle = np.radians(np.tile(place, n))
    conditions = Conditions(
        time_s=np.repeat(readings.conditions.time_s, m),
        angle_rad=angle,
        order=np.repeat(np.arange(n, dtype=float), m),
        approach=np.tile(side, n),
    )
    data = from_means(
        ideal_mg(angle, bench),
        np.tile(np.eye(2), (n * m, 1, 1)),
        conditions,
        gravity_mg=readings.gravity_mg,
        fixture_rad=readings.fixture_rad,
        fitted=np.ones(len(readings.model.parameters), dtype=bool),
    )
    bias = NamedTerm.offset(AXES[:2])
    base = data.model.nominal
    base[data.model.index("alpha")] = np.radians(bench.start_deg)
    return Fit(data, (bias,), Values(base, np.zeros(n * m), (np.zeros(2),)), with_prior=False)


def _refuse_hidden(term: NamedTerm, base: Floats, columns: Floats) -> None:
    """Raise a `UsageError` if no plan can show the effect, because the base model already contains it.

    `columns` are the derivatives of the readings by the effect, `base` by the base model.
    """
    rows = columns.reshape(-1, columns.shape[2])
    within = base.reshape(len(rows), -1)
    size = np.maximum(np.linalg.norm(within, axis=0), 1e-300)
    # Residual of the term's columns after a projection onto the base model.
    outside = rows - (within / size) @ np.linalg.lstsq(within / size, rows, rcond=1e-10)[0]
    if (np.linalg.norm(outside, axis=0) <= _HIDDEN * np.linalg.norm(rows, axis=0)).any():
        raise UsageError(
            f"beware: no plan can be made for '{term.name}': it lies in the model that every session fits"
        )


def search(ground: Candidates, starts: Sequence[Choice], rng: np.random.Generator) -> Choice:
    """Return the plan with the highest score that a search reaches from several starting plans.

    Its positions are put in ascending or descending order if the score remains the same within `SIMPLER`.

    Parameters
    ----------
    starts : sequence of (n,) int
        Plans to begin with; the result is at least as good as each of them.
    rng : numpy.random.Generator
        Generator for the order of the exchanges.
    """
    highest = sorted(starts, key=ground.score, reverse=True)[: max(_WORK // len(ground.columns), 1)]
    best = max([_improved(ground, one, rng) for one in highest], key=ground.score)
    # These positions in the order of their angles, forwards or backwards.
    simple = best[np.lexsort((ground.approach[best], ground.angle_deg[best]))]
    for choice in (simple, simple[::-1]):
        if ground.score(choice) >= ground.score(best) - SIMPLER and not ground.repeats(choice):
            return choice
    return best


def _improved(ground: Candidates, start: Choice, rng: np.random.Generator) -> Choice:
    """Exchange positions and swap dwells of a plan until the score no longer rises."""
    choice, score = start.copy(), ground.score(start)
    for _ in range(_MOST_SWEEPS):
        before = score
        # Move each dwell in turn to the position with the highest score.
        for dwell in rng.permutation(len(choice)).tolist():
            check()
            scores = ground.scores(ground.exchanged(choice, dwell))
            # Positions at the angle of the dwell before or after are not allowed.
            for near in (dwell - 1, dwell + 1):
                if 0 <= near < len(choice):
                    scores[ground.angle_deg == ground.angle_deg[choice[near]]] = -np.inf
            best = int(scores.argmax())
            if scores[best] > score + _LEAST_GAIN:
                choice[dwell], score = best, float(scores[best])
        # Swap pairs of dwells if this raises the score.
        pairs = np.array(list(itertools.combinations(range(len(choice)), 2)))
        for pair in rng.permutation(pairs)[:_PAIRS].tolist():
            check()
            trial = choice.copy()
            trial[pair] = trial[pair[::-1]]
            reached = -math.inf if ground.repeats(trial) else ground.score(trial)
            if reached > score + _LEAST_GAIN:
                choice, score = trial, reached
        if score < before + _LEAST_GAIN:
            break
    return choice


LEAST, MOST = 4, 100
"""Fewest and most positions of a searched plan: fewer do not determine a bias, and with more a search does
not improve the plan."""
DRAWN = 3
"""Number of random plans at the start of a search, in addition to even spacing in several orders and the
plan `tumble`."""
_GOLDEN = (3 - math.sqrt(5)) / 2
LEAST_GRID_DEG, WIDEST_GRID_DEG = 1.0, 60.0


class Gain(JsonRecord):
    """Comparison of the best plan with another plan of as many positions; an entry of `gain` in JSON.

    Attributes
    ----------
    name : str
        Name of the other plan.
    figure : float
        Quantity by which the criterion judges the other plan, such as the u of the angle in degrees.
    criterion : float
        The other plan's `figure` divided by the figure of the best plan, for `tell-apart` inverted; above 1
        if the best plan is better.
    u : dict of str to float
        For each parameter and the angle: standard uncertainty with the other plan divided by standard
        uncertainty with the best plan; NaN for the angle if one of the plans does not determine it.
    """

    name: str = field(metadata=HIDDEN)
    figure: float
    criterion: float
    u: dict[str, float]


class BestPlan(JsonRecord):
    """The best plan with its prediction.

    Attributes
    ----------
    prediction : Prediction
        The plan, with its predicted uncertainties and detectable effects.
    best : {"angle", "parameters", "tell-apart"}
        Criterion of the search.
    beware : tuple of str
        Effects that the session may have, which the plan shall detect or include in the fit.
    figure : float
        Quantity by which the criterion judges the plan, such as the largest u of the angle in degrees.
    separations : dict of str to float
        Typical size of each amplitude of these effects, divided by its standard uncertainty.
    gains : tuple of Gain
        Comparison with even spacing, and with tumble if the number of positions is even.
    seed : int
        Seed of the search.
    grid_deg : float
        Step of the searched angles.
    """

    document_keys = (
        *("prediction", "best", "beware", "criterion", "figure"),
        *("grid_deg", "seed", "separations", "gains"),
    )

    prediction: Prediction = field(metadata=INLINE)
    best: Best
    beware: tuple[str, ...]
    figure: float
    separations: dict[str, float]
    gains: tuple[Gain, ...] = field(metadata=KEYED_BY_NAME | key("gain"))
    seed: int
    grid_deg: float

    @property
    def plan(self) -> Plan:
        """The plan that the search found."""
        return self.prediction.plan

    @property
    def criterion(self) -> str:
        """Meaning of `figure` in words."""
        return MEANING[self.best]

    def made_for(self) -> dict[str, Any]:
        """Return the settings and the result of the search, as they are stored in a plan file."""
        document = self.as_dict()
        names = ("best", "beware", "criterion", "figure", "grid_deg", "seed", "bench")
        return {name: document[name] for name in names}


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
    bench : Bench
        Noise, stage and sensor of the sessions that are planned.
    positions : int
        Number of positions of the plan.
    best : {"angle", "parameters", "tell-apart"}
        Criterion: smallest u of the angle, smallest u of the parameters, or best distinction of the effects
        in `beware`.
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
        `positions`, `best`, `beware` or `grid_deg` has an impossible value.
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
    ground = candidates(bench, positions, beware, grid_deg, best)
    rng = np.random.default_rng(seed)
    choice = search(ground, _starts(ground, positions, rng), rng)
    information = ground.information(choice)
    prediction = predict(ground.plan(f"{best}-{positions}", choice), bench)
    figure = ground.figure(information)
    separations = ground.separations(information[None])[0].tolist()
    return BestPlan(
        prediction,
        best,
        beware,
        figure,
        dict(zip(ground.amplitudes, separations, strict=True)),
        tuple(_gain(prediction, figure, other, ground) for other in _rivals(positions)),
        seed,
        grid_deg,
    )


def even_plan(positions: int, *, both_sides: bool = False) -> Plan:
    """Return a plan with this number of evenly spaced angles in one turn, in ascending order.

    With `both_sides`, every second angle is approached from above.
    """
    sides: tuple[Approach, Approach] = (1, -1) if both_sides else (1, 1)
    return Plan("even", tuple(Position(360.0 * k / positions, sides[k % 2]) for k in range(positions)))


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

    They are even spacing and, for an even number of at least six positions, the plan `tumble`.
    """
    tumble = (plan("tumble", positions // 2),) if positions % 2 == 0 and positions >= 6 else ()
    return (even_plan(positions), *tumble)


def _starts(ground: Candidates, positions: int, rng: np.random.Generator) -> list[Choice]:
    known = (even_plan(positions, both_sides=True), interleaved_plan(positions))
    starts = [ground.nearest(other) for other in (*_rivals(positions), *known)]
    starts.append(rng.permutation(starts[0]))
    # Random candidates, repeated if there are fewer candidates than positions.
    drawn = [rng.permutation(len(ground.angle_deg)) for _ in range(DRAWN)]
    return starts + [np.resize(one, positions).astype(np.intp) for one in drawn]


def _gain(ours: Prediction, figure: float, other: Plan, ground: Candidates) -> Gain:
    """Compare the best plan with another plan: ratio of the criterion and of each uncertainty.

    `ours` is the prediction for the best plan, and `figure` the quantity by which the criterion judges it
    (`Candidates.figure`). This quantity of the other plan is computed at the nearest angles of the grid.
    """
    theirs = ground.figure(ground.information(ground.nearest(other)))
    reach = predict_uncertainty(other, ours.bench)
    pairs = {name: (value.u, ours.reach.parameters.get(name)) for name, value in reach.parameters.items()}
    # Only parameters that both plans determine have a ratio.
    ratios = {name: (u or 0.0) / one.u for name, (u, one) in pairs.items() if one is not None and one.u}
    ratios["angle_worst"] = (reach.angle_worst.u or math.nan) / (ours.reach.angle_worst.u or math.nan)
    ratios["angle_worst_by_parameters"] = reach.fitted_deg / ours.reach.fitted_deg
    pair = (figure, theirs) if ground.best == "tell-apart" else (theirs, figure)
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
    as long as a session with the best plan would show that the angle conforms.

    `best` is the criterion, `beware` has effects that the session may have, `grid_deg` is the step of the
    searched angles, and `seed` determines the search.

    Raises
    ------
    FitError
        A plan of `MOST` positions cannot show that the angle conforms.
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
    """Return the smallest number of interleaved positions that can show conformity, by bisection.

    Interleaved positions follow each other in steps of about 0.38 turns (`interleaved_plan`). With
    positions in ascending order more can be worse than fewer: the 1/f noise of a longer session resembles
    an error with the period of the turn.
    """

    def decides(count: int) -> bool:
        check()
        try:
            return _decides(predict_uncertainty(interleaved_plan(count), bench), tolerance)
        except FitError:
            return False

    if not decides(MOST):
        raise FitError(
            f"{counted(MOST, 'position')} cannot decide on {tolerance}: take longer dwells, a better stage"
            " or a quieter part"
        )
    return LEAST + bisect_left(range(LEAST, MOST), True, key=decides)


def positions_in(bench: Bench, minutes: float) -> int:
    """Return the number of positions that fit into a time in minutes, by the time model of a session.

    Raises
    ------
    UsageError
        The time is too short for `LEAST` positions, or too long for `MOST` positions.
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


def prediction_lines(
    prediction: Prediction, found: BestPlan | None = None, tolerance: Tolerance | None = None
) -> Iterator[str]:
    """Yield the lines of text that describe a prediction, starting with the headline.

    `found` adds the search that gave the plan, `tolerance` the conformity of the angle; None omits them.
    """
    yield headline(prediction)
    if tolerance is not None:
        conformity = prediction.reach.conformity(tolerance)
        decision = f"cannot decide on {tolerance}: the plan does not determine the angle"
        if conformity is not None:
            can = "decides" if conformity.verdict == "pass" else "cannot decide"
            risk = format_percent(conformity.false_accept)
            decision = f"{can} on {tolerance}: expected risk of a false accept {risk}"
        yield from fold_text(decision, WIDTH)
    if found is not None:
        beware = f" {', '.join(found.beware)}" if found.best == "tell-apart" else ""
        fitted = f", {', '.join(found.beware)} also fitted" if found.beware and not beware else ""
        figure = f"{MEANING[found.best]}: {found.figure:.2g}"
        yield from fold_text(f"{_ASKED[found.best]}{beware}{fitted}; {figure}", WIDTH)
    yield ""
    yield from _reach_lines(prediction.reach)
    if found is not None:
        yield ""
        yield "Gain: the other plan's uncertainty divided by this one's"
        rows = [["over", "criterion", *_GAINED.values()]]
        for gain in found.gains:
            ratios = [_ratio(gain.u.get(name)) for name in _GAINED]
            rows.append([gain.name, _ratio(gain.criterion), *ratios])
        yield from align_columns(rows, texts=1)
    yield ""
    yield from _sight_lines(prediction.sight)
    yield ""
    yield "Positions, in this order"
    positions = [f"{k:>3}  {position}" for k, position in enumerate(prediction.plan.positions, 1)]
    yield from arrange_in_columns(positions, least=24)
    for note in prediction.reach.notes:
        yield from fold_text(note, WIDTH)


def headline(prediction: Prediction) -> str:
    """Return a line with the plan's number of positions, its duration and the predicted u of the angle."""
    minutes = f"{max(prediction.seconds / 60, 1):.0f} min"
    count = counted(len(prediction.plan), "position")
    u, expanded = prediction.reach.angle.u, prediction.reach.angle_worst.U
    if u is None or expanded is None:
        return f"{count}, {minutes}: they do not determine an angle at this fixture"
    digits = count_decimals(min(u, expanded))
    angle = f"u {format_fixed(u, digits)}° rms, U {format_fixed(expanded, digits)}° at the worst place"
    return f"{count}, {minutes}: angle {angle}"


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
            blind["not predicted" if one.lacking else one.reason].append(name)
        else:
            cells.append(f"{name} {with_unit(format_number(one.amplitude, 2), one.unit)}")
    if cells:
        yield "Shows effects from these sizes on (found in 90 of 100 sessions)"
        yield from arrange_in_columns(cells)
    yield "Cannot show"
    for reason, names in blind.items():
        yield from fold_text(f"{', '.join(names)}: {reason}", WIDTH, 2)
    yield "Cannot tell apart"
    others = defaultdict(list)
    for pair in sight.confounded:
        others[pair.effects[0]].append(pair.effects[1])
    for name, several in others.items():
        yield from fold_text(f"{name} from {', '.join(several)}", WIDTH, 2)
    if not others:
        yield "  every effect that it shows differs from the others"


def arrange_in_columns(cells: Sequence[str], least: int = 38) -> Iterator[str]:
    """Yield lines in which text cells are arranged in as many columns as the width allows.

    A column has at least `least` characters; the cells run down each column.
    """
    width = max(least, *(len(cell) for cell in cells)) if cells else least
    across = max(1, (WIDTH - 2) // width)
    down = -(-len(cells) // across)
    for row in range(down):
        yield "  " + "".join(cell.ljust(width) for cell in cells[row::down]).rstrip()
