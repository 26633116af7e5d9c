"""Small problems of the trace, made by hand: turns of a perfect part, candidates, what is believed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from adis_gonio.base.jsonable import ComputedOnce
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Term
from adis_gonio.model.effects import Conditions, Enters
from adis_gonio.tracing.linear_problem import LinearProblem
from adis_gonio.tracing.model_search import Model, Search, weigh
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.selection import Selection, select
from adis_gonio.tracing.session_blocks import SessionBlocks

G = 1000.0
U = 0.1
"""Standard uncertainty of a reading of the sessions below, in mg."""


def turn(n: int = 24, angles_deg: Sequence[float] | None = None, **others: Any) -> Conditions:
    """Surroundings of dwells a minute apart, by default over one turn in equal steps."""
    angles = np.arange(n) * 360.0 / n if angles_deg is None else np.asarray(angles_deg, dtype=float)
    n = len(angles)
    at = {"time_s": 60.0 * np.arange(n), "angle_rad": np.radians(angles), "order": np.arange(float(n))}
    return Conditions(**(at | others))


def ideal_mg(c: Conditions, slips_deg: np.ndarray | float = 0.0) -> np.ndarray:
    """Readings (n, 2) of a perfect part that stands at 3° when the stage shows 0."""
    psi = np.radians(3.0 + np.asarray(slips_deg)) - c.angle_rad
    return G * np.column_stack([np.cos(psi), np.sin(psi)])


def read(c: Conditions, mean: np.ndarray, u: float = U) -> Readings:
    """Readings of known noise at angles that are known, so that each is two rows of the linear problem."""
    return from_means(mean, np.tile(u**2 * np.eye(2), (len(mean), 1, 1)), c)


def noisy(c: Conditions, seed: int, u: float = U) -> Readings:
    """A perfect part with noise as declared."""
    ideal = ideal_mg(c)
    return read(c, ideal + np.random.default_rng(seed).normal(0, u, ideal.shape), u)


def surroundings(n: int = 24, seed: int = 1) -> Conditions:
    """A turn with everything recorded."""
    rng = np.random.default_rng(seed)
    c = turn(angles_deg=rng.permutation(np.arange(n) * 360.0 / n))
    temperature = 30 + 6 * np.sin(c.time_s / 200)
    return replace(
        c,
        approach=rng.choice([-1.0, 1.0], n),
        previous_angle_rad=np.concatenate([c.angle_rad[:1], c.angle_rad[:-1]]),
        temperature_c=temperature,
        supply_v=5 + 0.1 * rng.standard_normal(n),
        temperature_history=(c.time_s, temperature),
    )


def function(
    label: str, of: Any, covariates: tuple[str, ...] = ("time",), where: Any = "bias", **how: Any
) -> NamelessTerm:
    """A function without a name of the conditions, on x or at the angle."""
    axes = () if where == "angle" else (0,)
    basis = Basis(label, covariates, lambda c: of(c)[:, None], **how)
    return NamelessTerm(label, covariates, 5.0, where, axes, basis)


def labelled(data: Readings, *labels: str) -> list[Term]:
    """Candidates of the catalogue by their labels."""
    at_hand = {term.label: term for term in named_terms(data)[0]}
    return [at_hand[label] for label in labels]


def single(
    target: Sequence[float], columns: Sequence[Sequence[float]], terms: Sequence[Any]
) -> LinearProblem:
    """A linear problem of single columns of length 1, whose terms cost what they say, or nothing."""
    k = len(columns)
    return LinearProblem(
        terms=tuple(terms),
        shared=SessionBlocks(
            rows=len(target),
            place=np.arange(len(target))[None],
            base=np.zeros((1, len(target), 0)),
            columns=np.array(columns, dtype=float).T[None],
            width=np.ones(k, dtype=np.intp),
            seen=np.ones((1, k), dtype=bool),
            back=tuple(np.ones((1, 1, 1)) for _ in range(k)),
            prior=tuple(np.zeros((1, 1, 1)) for _ in range(k)),
        ),
        target=np.array(target, dtype=float),
        dof=len(target),
        column_price=np.zeros(k),
    )


def named(name: str | None, cost: float = 0.0, covariates: tuple[str, ...] = ()) -> Any:
    """As much of a term as names and sets look at."""
    constant = name == "bias"
    return SimpleNamespace(
        name=name,
        shown_as=name,
        covariates=covariates,
        dwell=None,
        cost=cost,
        constant=constant,
        prior_sd=None,
        forced=False,
    )


class _Believed(SimpleNamespace, ComputedOnce):
    """What the functions of the trace ask of a selection."""


def believed(problem: LinearProblem, weights: dict[Model, float], **others: Any) -> Any:
    """A selection whose models have these shares of the posterior, the first of them chosen."""
    scores = {model: math.log(share) for model, share in weights.items()}
    found = Search(problem, np.zeros(len(problem.terms)), scores=scores)
    verdict = replace(weigh(found), best=next(iter(weights)))
    return _Believed(problem=problem, found=found, verdict=verdict, inflation=1.0, **others)


def names_only(*names: str) -> LinearProblem:
    """Effects of one column each, all at right angles."""
    rows = np.eye(len(names) + 1)
    return single(9 * rows.sum(axis=0), rows[:-1], [named(name) for name in names])


def slipped(n: int = 24, by_deg: float = 15.0) -> Readings:
    """A turn whose second dwell stands elsewhere by a slip."""
    c = turn(n)
    return read(c, ideal_mg(c, by_deg * (np.arange(n) == 1)))


def base_and_bias(c: Conditions) -> np.ndarray:
    """Columns (n, 2, 6) of start angle, gains, misalignment and biases, by hand, in units of g."""
    psi = np.radians(3.0) - c.angle_rad
    zero, one = np.zeros(len(psi)), np.ones(len(psi))
    x = np.column_stack([-np.sin(psi), np.cos(psi), zero, zero, one, zero])
    y = np.column_stack([np.cos(psi), zero, np.sin(psi), np.cos(psi), zero, one])
    return np.stack([x, y], axis=1)


def chosen(data: Readings, terms: Sequence[Term], *models: tuple[Sequence[int], float]) -> Selection:
    """A selection with nothing but models of these terms, by share of the posterior, the first chosen."""
    bare = select(data, terms, 0)
    number = {term.label: k for k, term in enumerate(bare.problem.terms)}
    scores = {
        tuple(sorted(number[terms[k].label] for k in model)): math.log(share) for model, share in models
    }
    found = replace(bare.found, scores=scores, inflation=1.0)
    return replace(bare, found=found, verdict=weigh(found)).with_model(next(iter(scores)))


def biased(seed: int = 31, mg: Sequence[float] = (5.0, -3.0), u: float = U) -> Readings:
    """A turn in equal steps with a bias."""
    data = noisy(turn(supply_v=5 + 0.1 * np.random.default_rng(seed).standard_normal(24)), seed, u)
    return replace(data, mean=data.mean + np.asarray(mg))


def conditions(n: int = 24, shuffled: bool = True, seed: int = 3) -> Conditions:
    """Surroundings of n dwells over one turn: cycling temperature, wandering supply, both approaches."""
    rng = np.random.default_rng(seed)
    angle = np.deg2rad(np.arange(n) * 360.0 / n)
    if shuffled:
        angle = rng.permutation(angle)
    time = 30.0 + 60.0 * np.arange(n)
    history = np.linspace(0, 60.0 * n, 20 * n)

    def temperature(t: np.ndarray) -> np.ndarray:
        return 30 + 6 * np.sin(2 * np.pi * 1.7 * t / (60.0 * n) + 0.4)

    return Conditions(
        time_s=time,
        angle_rad=angle,
        order=np.arange(float(n)),
        approach=rng.choice([-1.0, 1.0], n),
        previous_angle_rad=np.concatenate([angle[:1], angle[:-1]]),
        temperature_c=temperature(time),
        supply_v=5 + 0.1 * rng.standard_normal(n),
        temperature_history=(history, temperature(history)),
    )


def observations(
    effects=(), added=None, turned=None, n=24, u=0.1, fixture_deg=0.005, seed=0, shuffled=True, check=0
) -> Readings:
    """Readings (n, 2) of a part with gains 1.01 and 0.99, Δφ 0.3° and effects (effect, values by name)."""
    rng = np.random.default_rng(seed)
    c = conditions(n, shuffled)
    psi = 0.05 - c.angle_rad + rng.normal(0, np.deg2rad(fixture_deg), n)
    made = [(e, e.defaults(values, others="zero")) for e, values in effects]
    for e, values in made:
        psi = psi + e.attitude_rad(values, c)
    if turned is not None:
        psi = psi + turned(c)
    ideal = np.column_stack([1.01 * G * np.cos(psi), 0.99 * G * np.sin(psi + np.deg2rad(0.3))])
    mean = ideal.copy()
    for e, values in made:
        if e.enters is Enters.READING:
            mean += e.reading(values, ideal, c)
    if added is not None:
        mean += added(c, ideal / G)
    mean += rng.normal(0, u, mean.shape)
    return from_means(
        mean,
        np.tile(u**2 * np.eye(2), (n, 1, 1)),
        c,
        gravity_mg=G,
        fixture_rad=float(np.deg2rad(fixture_deg)),
        dof=np.full(n, 1e4),
        check=np.arange(n) >= n - check,
    )
