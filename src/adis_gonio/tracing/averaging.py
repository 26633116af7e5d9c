"""Average over formulas and smooth functions for the part of the residual that no named effect explains.

It is seldom certain which formula is right, and if none is right a smooth function is closer. Models with
the named effects of the chosen model are fitted, with formulas or Gaussian processes as their unnamed part.
The corrected model adds the mean of these unnamed parts, weighted by their evidence (Hoeting, Madigan,
Raftery and Volinsky, Bayesian model averaging, Statistical Science 14, 1999). The *report* shows only the
function with the largest weight.

A Gaussian process with kernel k is a linear term with one column for each feature of its kernel, φ(u)·φ(u′)
= k(u, u′), and a normal prior on the amplitudes (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, sections 2.1 and 5.4). The evidence chooses the length scale and the amplitude of the
process, so it bends only as much as the readings require. Outside the range of the readings it returns to a
straight line, while a polynomial diverges.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, nameless_spread
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Where
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.tracing.named_candidates import choices_of_axes
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.session_blocks import orthonormal
from adis_gonio.tracing.thresholds import limits

Member = tuple[float, NamelessTerm, Floats]


@dataclass(frozen=True)
class RidgeSolution:
    """Fit of one member of an average: base model, named terms, and the unnamed terms of this member.

    The members are the alternatives (formulas, Gaussian processes) over which the average is taken.

    Attributes
    ----------
    terms : tuple of NamelessTerm
        Unnamed terms of the member.
    places : tuple of slice
        Slice of `values` with the amplitudes of each of these terms.
    values : (p,) float
        Fitted amplitudes: of the base and named parameters (the fixed columns), then of `terms`.
    half : (p, k) float
        Root of the covariance of `values`: the covariance is the root times its transpose, times the
        variance of the whitened noise.
    used : float
        Degrees of freedom that the fit uses.
    visible : float
        Share (0 to 1) of the contribution of `terms` that the fixed columns could not reproduce. It is 1 if
        `terms` is empty and for Gaussian processes, since their priors keep them small.
    weight : float
        Posterior weight of the member in an average.
    """

    terms: tuple[NamelessTerm, ...]
    places: tuple[slice, ...]
    values: Floats
    half: Floats
    used: float
    visible: float
    weight: float = 1.0

    def columns(self, there: Fit, width: int) -> Floats:
        """Return the whitened columns (rows, p) of base model, named terms and this member's terms.

        `there` is a fit to the dwells for which the columns are computed. The first `width` columns of its
        Jacobian belong to the base model and the named terms.
        """
        own = [there.white(there.candidate(term)) for term in self.terms]
        return np.concatenate([there.jacobian[:, :width], *own], axis=1)


@dataclass(frozen=True)
class AveragedTerm(NamelessTerm):
    """Weighted mean of fitted unnamed functions, as a term that has no parameters to fit.

    Attributes
    ----------
    members : tuple of (weight, term, values)
        Weight, unnamed term and fitted amplitudes of each averaged function. Either all of them change the
        angle, or all of them change the readings.
    """

    members: tuple[Member, ...] = ()

    @property
    def form(self) -> str:
        """Formula of the averaged function with the largest weight."""
        return max(self.members, key=lambda member: member[0])[1].form

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the weighted mean of the members' contributions to readings (n, axes) or angle (n,).

        `ideal` (n, axes) are the readings of an ideal sensor. `values` is not used.
        """
        parts = [weight * term.added(own, ideal, conditions) for weight, term, own in self.members]
        total: Floats = np.sum(parts, axis=0)
        return total

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """Return an array (n, axes, 0) or, for the angle, (n, 0): there are no parameters to fit."""
        n, axes = ideal.shape
        return np.zeros((n, 0) if self.enters_angle else (n, axes, 0))


@dataclass(frozen=True, kw_only=True)
class AveragedFit(Fit):
    """Fit of a model with named effects, to which the mean of several unnamed functions is added.

    Its terms are the named terms, then at most two averaged terms: one changes the angle, one the readings.
    The base and named parameters were fitted again with these averaged terms. Its standard uncertainties
    include the differences between the unnamed functions.

    Attributes
    ----------
    solutions : tuple of RidgeSolution
        Fit of each averaged alternative (member); their weights sum to 1.
    inflation : float
        Factor on the variance of the noise with which the members were fitted.
    selected : Fit
        Fit of the selected model, whose unnamed terms the average replaces.
    smooth : NamelessTerm
        The most probable Gaussian process among the averaged functions.
    weight : float
        Total probability of all Gaussian processes, as opposed to formulas or no function.
    promising : tuple of NamelessTerm
        The Gaussian processes with the highest evidence.
    """

    solutions: tuple[RidgeSolution, ...]
    inflation: float
    selected: Fit
    smooth: NamelessTerm
    weight: float
    promising: tuple[NamelessTerm, ...]

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (p, p) of the base and named parameters over all members."""
        return mixed_covariance(self.solutions, len(self.values.parameters), self.inflation)

    @cached_property
    def used(self) -> float:
        """Mean degrees of freedom of the members (base, named and unnamed terms), by their weights."""
        return sum(one.weight * one.used for one in self.solutions)

    @property
    def joint_covariance(self) -> Floats:
        """Covariance (p + axes, p + axes) of the p parameters and of the averaged terms at mid-session.

        An averaged term is stated as its contribution to the reading of each axis without acceleration;
        only terms that depend on nothing but time are included, other terms have zeros.
        """
        width, stated = len(self.values.parameters), []
        middle, still = Conditions(time_s=np.array([middle_s(self)])), np.zeros((1, self.data.axes))
        for one in self.solutions:
            rows = np.zeros((width + self.data.axes, len(one.values)))
            rows[:width, :width] = np.eye(width)
            # An unnamed function of the angle, or of more than time, moves no reading here.
            for term, place in zip(one.terms, one.places, strict=True):
                if term.covariates == ("time",) and not term.enters_angle:
                    rows[width:, place] = term.columns(still, middle)[0]
            stated.append(replace(one, values=rows @ one.values, half=rows @ one.half))
        return mixed_covariance(stated, width + self.data.axes, self.inflation)

    def carried(self, there: Fit) -> Floats:
        """Return a root (rows, k) of the covariance of predicted whitened readings.

        `there` is a fit with the dwells to predict. The covariance is the root times its transpose, in
        units of the noise variance times `inflation`. It includes the uncertainty of each member and the
        differences between members.
        """
        width = len(self.values.parameters)
        weights = np.sqrt([one.weight for one in self.solutions])
        columns = [(one, one.columns(there, width)) for one in self.solutions]
        within = [weight * own @ one.half for weight, (one, own) in zip(weights, columns, strict=True)]
        each = np.stack([own @ one.values for one, own in columns], axis=1)
        between = weights * (each - each @ weights[:, None] ** 2) / np.sqrt(self.inflation)
        return np.concatenate([*within, between], axis=1)

    def can_predict(self, data: Readings, most: float) -> NDArray[np.bool_]:
        """Return a mask (n,) of the dwells that the selected model predicts with sufficient certainty.

        An average has no columns that could decide this.
        """
        return self.selected.can_predict(data, most)


def average(selection: Selection, candidates: Sequence[NamelessTerm] | None = None) -> AveragedFit | None:
    """Return a model with the mean of unnamed functions in addition to the named effects of a selection.

    The result is None if no unnamed function is needed to explain the readings.

    The candidates (formulas and Gaussian processes) are first weighed with the measured noise. If their
    mean does not agree with this noise, they are weighed again with a larger noise, which explains the
    residual of the best formula. The measured noise comes first, because with the larger noise a wrong
    formula may outweigh the right process.

    Parameters
    ----------
    selection : Selection
        Chosen model, with its named effects.
    candidates : sequence of NamelessTerm, optional
        Gaussian processes to try; all by default.
    """
    if selection.data.noise_known and selection.inflation > 1:
        measured = _average(replace(selection, inflation=1.0), candidates)
        if measured is not None and selection.with_fit(measured).adequate:
            return measured
    return _average(selection, candidates)


def _average(selection: Selection, candidates: Sequence[NamelessTerm] | None) -> AveragedFit | None:
    """Return the average with the noise of a selection (`inflation`); None if no function is needed.

    `candidates` are the Gaussian processes to try; None tries all.
    """
    data, terms, best = selection.data, selection.problem.terms, selection.verdict.best
    named = tuple(k for k in best if terms[k].name is not None)
    nameless = len(named) < len(best)
    if not nameless and (selection.adequate or not data.noise_known):
        return None
    # Evidence of each process for the part of the target that base and named effects do not explain.
    fit, jacobian = selection.fit, selection.fit.jacobian
    own = [index for index, term in enumerate(fit.terms) if term.name is not None]
    _, _, target = fit.linear()
    fixed = np.concatenate(
        [jacobian[:, : len(fit.values.base)], *(jacobian[:, fit.slice_of(index)] for index in own)], axis=1
    )
    others = orthonormal(fixed)
    left = target - others @ (others.T @ target)
    candidates = processes(data) if candidates is None else candidates
    smooth = evidence(fit, others, left, candidates, selection.inflation)
    ranked = np.argsort(-smooth)[: limits.promising].tolist()
    promising = tuple(candidates[k] for k in ranked)
    pool: list[tuple[float, tuple[NamelessTerm, ...]]] = [
        (float(smooth[k]), (candidates[k],)) for k in ranked
    ]
    if nameless:
        pool += _formulas(selection, named, candidates)
    else:
        pool.append((0.0, ()))
    # Posterior weights of all members; negligible weights are dropped.
    weights = np.exp(np.array([score for score, _ in pool]) - max(score for score, _ in pool))
    weights = np.where(weights >= limits.counted * weights.sum(), weights, 0.0)
    weights /= weights.sum()
    # The last member of the pool may be "no unnamed part".
    if weights[-1] > 0.5 and not pool[-1][1]:
        return None
    solutions = fit_members(selection, fixed, target, pool, weights)
    # Each unnamed term with the weight of its member; the base and named parameters come first.
    averaged = _averaged_terms(
        [
            (one.weight, term, one.values[place])
            for one in solutions
            for term, place in zip(one.terms, one.places, strict=True)
        ]
    )
    fit = fit.with_terms(
        [*(fit.terms[index] for index in own), *averaged],
        [*(fit.values.terms[index] for index in own), *(np.zeros(0) for _ in averaged)],
    ).refit()
    # A fixed function has no parameters, but the degrees of freedom of its members are used.
    return AveragedFit(
        *(fit.data, fit.terms, fit.values, fit.with_prior),
        solutions=solutions,
        inflation=selection.inflation,
        selected=selection.fit,
        smooth=promising[0],
        weight=float(weights[: len(promising)].sum()),
        promising=promising,
    )


def _covered_by_process(term: NamelessTerm, covered: set[tuple[Where, tuple[str, ...]]]) -> bool:
    """Return True if an unnamed term approximates a function that a Gaussian process also describes.

    `covered` has the place and covariates of each process. Such a term is omitted: it is a polynomial,
    which fits the readings as well as the process but diverges outside their range.
    """
    return term.basis.approximates and (term.where, term.covariates) in covered


def _formulas(
    selection: Selection, named: tuple[int, ...], candidates: Sequence[NamelessTerm]
) -> list[tuple[float, tuple[NamelessTerm, ...]]]:
    """Return the unnamed terms of each probable model that has exactly the named terms `named`.

    Each entry begins with the log evidence of its model minus the log evidence of the named terms alone.
    Terms that approximate a function which a process in `candidates` also describes are omitted.
    """
    problem, found = selection.problem, selection.found

    def score(model: tuple[int, ...]) -> float:
        explained = 0.5 * problem.gain(model) / selection.inflation
        return explained - float(sum(found.prices[k] for k in model))

    covered = {(process.where, process.covariates) for process in candidates}
    near = {m for m in found.near(limits.averaged) if tuple(k for k in m if k in named) == named}
    alone = score(named)
    pool = []
    for model in sorted({*near, tuple(selection.verdict.best)}):
        rest = tuple(problem.terms[k] for k in model if k not in named)
        nameless = tuple(term for term in rest if isinstance(term, NamelessTerm))
        twice = any(_covered_by_process(term, covered) for term in nameless)
        if rest and len(nameless) == len(rest) and not twice:
            pool.append((score(model) - alone, nameless))
    return pool


def fit_members(
    selection: Selection,
    fixed: Floats,
    target: Floats,
    pool: Sequence[tuple[float, tuple[NamelessTerm, ...]]],
    weights: Floats,
) -> tuple[RidgeSolution, ...]:
    """Fit each member of a pool that has a weight; return the fits, whose weights sum to 1.

    Parameters
    ----------
    fixed : (rows, width) float
        Whitened columns of the base model and the named terms.
    target : (rows,) float
        Whitened readings minus the prediction at the values where the model is linearised.
    pool : sequence of (float, tuple of NamelessTerm)
        Log evidence and unnamed terms of each member.
    weights : (m,) float
        Posterior weight of each member; 0 drops it.
    """
    solved = [
        replace(solve_ridge(selection, fixed, target, pool[k][1]), weight=float(weights[k]))
        for k in np.flatnonzero(weights).tolist()
    ]
    # Members that base and named terms could imitate are dropped, unless this would drop all of them.
    seen = [member for member in solved if member.visible >= limits.visible] or solved
    total = sum(member.weight for member in seen)
    return tuple(replace(member, weight=member.weight / total) for member in seen)


def mixed_covariance(solutions: Sequence[RidgeSolution], width: int, inflation: float) -> Floats:
    """Return the covariance (width, width) of the first `width` values of the members' fits.

    It contains the uncertainty within each member and the differences between members, both in units of the
    noise variance times `inflation`. The weights of `solutions` add up to 1.
    """
    mean = np.sum([one.weight * one.values[:width] for one in solutions], axis=0)
    covariance = np.zeros((width, width))
    for one in solutions:
        half, away = one.half[:width], one.values[:width] - mean
        covariance += one.weight * (half @ half.T + np.outer(away, away) / inflation)
    return covariance


def middle_s(fit: Fit) -> float:
    """Return the time halfway between the first and last dwell, in s since the start of the session."""
    time_s = fit.data.conditions.time_s
    return float(time_s.min() + time_s.max()) / 2


def solve_ridge(
    selection: Selection, fixed: Floats, target: Floats, terms: Sequence[NamelessTerm]
) -> RidgeSolution:
    """Fit one member: base model, named terms and the unnamed `terms` (their amplitudes have priors).

    Parameters
    ----------
    fixed : (rows, width) float
        Whitened columns of the base model and the named terms, which have no priors.
    target : (rows,) float
        Whitened readings minus the prediction at the values where the model is linearised.
    """
    fit = selection.fit
    blocks = [fit.white(fit.candidate(term)) for term in terms]
    columns = np.concatenate([fixed, *blocks], axis=1)
    priors = [np.zeros(fixed.shape[1])]
    for term, block in zip(terms, blocks, strict=True):
        held = np.sqrt(selection.inflation) / (term.prior_sd or nameless_spread(fit.data.model, term))
        priors.append(np.full(block.shape[1], held))
    # Least squares with one prior row for each shrunk amplitude, columns scaled to unit length.
    precision = np.concatenate(priors)
    stacked = np.concatenate([columns, np.diag(precision)[precision > 0]])
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0] = 1.0
    u, s, vt = np.linalg.svd(stacked / size, full_matrices=False)
    keep = s > 1e-9 * s[0]
    half = (vt[keep].T / s[keep]) / size[:, None]
    solved = half @ (u[: len(target), keep].T @ target)
    added = columns[:, fixed.shape[1] :] @ solved[fixed.shape[1] :]
    visible = 1.0
    if all(term.prior_sd is None for term in terms) and added.any():
        others = orthonormal(fixed)
        left = added - others @ (others.T @ added)
        visible = float(np.linalg.norm(left) / np.linalg.norm(added))
    cuts = np.cumsum([fixed.shape[1], *(block.shape[1] for block in blocks)]).tolist()
    places = tuple(itertools.starmap(slice, itertools.pairwise(cuts)))
    return RidgeSolution(tuple(terms), places, solved, half, float(((columns @ half) ** 2).sum()), visible)


def _averaged_terms(members: Sequence[Member]) -> list[AveragedTerm]:
    """Return the averaged terms of these members: at most one for the readings, one for the angle."""
    made = []
    places: tuple[tuple[Where, str], ...] = (("bias", "readings"), ("angle", "angle"))
    for where, place in places:
        mine = tuple(member for member in members if member[1].enters_angle == (where == "angle"))
        if mine:
            first = max(mine, key=lambda member: member[0])[1]
            axes = tuple(sorted({axis for _, term, _ in mine for axis in term.axes}))
            label, basis = f"average at the {place}", Basis(first.basis.form, first.covariates)
            made.append(AveragedTerm(label, first.covariates, 0.0, where, axes, basis, members=mine))
    return made


# -- smooth candidates ------------------------------------------------------------------------------------

LENGTHS = (0.1, 0.18, 0.32, 0.56, 1.0)
"""Correlation lengths ℓ of a kernel that are tried, in units of the covariate's range."""
RING = (0.25, 0.4, 0.65, 1.0)
"""Widths w of the periodic kernel exp(−2 sin²(Δ/2)/w²) that are tried."""
AMPLITUDES = (2.0, 4.0, 8.0, 16.0)
"""Prior standard deviations of a process that are tried, in standard uncertainties of a reading."""

_HARMONICS = 16
_BEYOND = 0.1
"""Fraction of its fitted range by which a covariate counts beyond this range; it is clipped there."""

Get = Callable[[Conditions], Floats]


def processes(data: Readings) -> list[NamelessTerm]:
    """Return all Gaussian processes to try in a session, as candidates for an unnamed function.

    There is one for each place in the model, covariate, length and amplitude. Its basis functions are the
    kernel's features, and its attribute `prior_sd` is the amplitude of the process.
    """
    reading_u = float(np.sqrt(data.variance_of_mean.mean()))
    subsets = choices_of_axes(range(data.axes))
    made: list[NamelessTerm] = []
    for basis, placed in _bases(data):
        for where in placed:
            if where == "angle" and not data.planar:
                continue
            for axes in [()] if where == "angle" else subsets:
                term = NamelessTerm("", basis.covariates, 0.0, where, axes, basis)
                made.append(replace(term, stimulus=data.model.stimulus))
    members = Counter(term.covariates for term in made)
    weight = {c: limits.pair_weight if len(c) > 1 or c == ("previous_angle",) else 1.0 for c in members}
    total = sum(weight.values())
    out = []
    for term, amplitude in itertools.product(made, AMPLITUDES):
        own = term.covariates
        share = limits.nameless_share * weight[own] / total / members[own] / len(AMPLITUDES)
        label = f"{term.where}[{''.join('xyz'[k] for k in term.axes)}]~{term.basis.form} ({amplitude:g} u)"
        out.append(replace(term, prior_sd=amplitude * reading_u, cost=-math.log(share), label=label))
    return out


def evidence(
    fit: Fit,
    others: Floats,
    target: Floats,
    candidates: Sequence[NamelessTerm],
    inflation: float = 1.0,
) -> Floats:
    """Return the log evidence of each of m processes plus its log prior probability, (m,) in nats.

    `candidates` are the processes, each a possible unnamed function.

    Parameters
    ----------
    fit : Fit
        Fit about which the processes are linear.
    others : (rows, k) float
        Orthonormal whitened columns of the other terms of the model; their amplitudes have flat priors.
    target : (rows,) float
        Whitened readings minus their projection on `others`.
    inflation : float
        Factor on the measured noise variance.
    """
    scores = np.zeros(len(candidates))
    spectra: dict[tuple[int, Where, tuple[int, ...]], tuple[Floats, Floats]] = {}
    for k, term in enumerate(candidates):
        key = (id(term.basis), term.where, term.axes)
        if key not in spectra:
            # Processes that differ in amplitude only share the spectrum of their whitened features.
            white = fit.white(fit.candidate(term))
            white = white - others @ (others.T @ white)
            values, vectors = np.linalg.eigh(white.T @ white)
            spectra[key] = np.maximum(values, 0.0), (vectors.T @ (white.T @ target)) ** 2
        values, scores2 = spectra[key]
        assert term.prior_sd is not None
        # ½ Σ (s²/(1 + s²λ) · score² − ln(1 + s²λ)) over the eigenvalues λ.
        prior = term.prior_sd**2 / inflation
        grown = 1 + prior * values
        scores[k] = 0.5 * float((prior * scores2 / inflation / grown - np.log(grown)).sum()) - term.cost
    return scores


def _bases(data: Readings) -> Iterator[tuple[Basis, tuple[Where, ...]]]:
    """Yield basis functions for every kernel, each with the places in the model that they may enter."""
    c = data.conditions
    scalars, rings = _lines_and_rings(c, data.model.driven_by)
    for name, get in scalars.items():
        for length in LENGTHS:
            basis = Basis(f"a smooth function of {name}", (name,), _line(get, get(c), length))
            yield basis, ("bias", "gain", "misalignment", "angle")
    for name, get in rings.items():
        for width in RING:
            basis = Basis(f"a smooth function of {name.replace('_', ' ')}", (name,), _ring(get, width))
            yield basis, ("bias", "angle")
    for length in LENGTHS[1:] if "reading" in data.model.driven_by else ():
        form = "a smooth function of the reading"
        yield Basis(form, ("reading",), by_axis=_of_reading(length)), ("bias",)
    slow = [item for item in scalars.items() if not item[0].startswith("force")]
    for (one, f), (two, g) in itertools.combinations(slow, 2):
        for length in LENGTHS[2::2]:
            both = _product(_line(f, f(c), length), _line(g, g(c), length))
            form = f"a smooth function of {one} and {two}"
            yield Basis(form, (one, two), both), ("bias", "gain", "angle")


def _lines_and_rings(c: Conditions, driven_by: Sequence[str]) -> tuple[dict[str, Get], dict[str, Get]]:
    """Return two groups of covariates by name: covariates on a line, and covariates that are angles.

    `driven_by` are the covariates that drive the measurement, such as the force for gyros.
    """
    lines: dict[str, Get] = {"time": lambda k: k.time_s}
    if "force" in driven_by and c.force_g is not None:
        lines |= {f"force_{letter}": _component(axis) for axis, letter in enumerate(AXES)}
    fields = {"temperature": "temperature_c", "supply": "supply_v", "line_frequency": "line_hz"}
    lines |= {name: _recorded(own) for name, own in fields.items() if getattr(c, own) is not None}
    fields = {"angle": "angle_rad", "previous_angle": "previous_angle_rad"}
    rings = {name: _recorded(own) for name, own in fields.items() if getattr(c, own) is not None}
    return {name: get for name, get in lines.items() if np.ptp(get(c)) > 0}, rings


def _recorded(name: str) -> Get:
    return lambda k: k.covariate(name)


def _component(axis: int) -> Get:
    return lambda k: k.covariate("force_g")[:, axis]


def _inducing(low: float, high: float, length: float) -> Callable[[Floats], Floats]:
    """Return a function of values (n,) that gives basis functions (n, k) for the kernel exp(−½ Δ²/ℓ²).

    ℓ is `length`. Nyström's method uses k points, at most 0.6 ℓ apart, from `low` to `high`.
    """
    points = np.linspace(low, high, max(int(np.ceil((high - low) / (0.6 * length))) + 1, 4))

    def kernel(u: Floats) -> Floats:
        return np.asarray(np.exp(-0.5 * ((u[:, None] - points) / length) ** 2))

    # Features K(u, points) L⁻ᵀ with K(points, points) = L Lᵀ reproduce the kernel.
    root = np.linalg.cholesky(kernel(points) + 1e-6 * np.eye(len(points)))
    return lambda u: np.asarray(np.linalg.solve(root, kernel(u).T).T)


def _line(get: Get, seen: Floats, length: float) -> Get:
    """Return basis functions (n, k) for a constant, a line and the kernel exp(−½ Δ²/ℓ²) of a covariate.

    `get` returns the covariate, `seen` are its values in the fitted dwells, ℓ is `length` in units of their
    range. The covariate is clipped shortly beyond this range.
    """
    low, size = float(seen.min()), float(np.ptp(seen))
    curve = _inducing(-_BEYOND, 1 + _BEYOND, length)

    def features(conditions: Conditions) -> Floats:
        u = np.clip((get(conditions) - low) / size, -_BEYOND, 1 + _BEYOND)
        return np.column_stack([np.ones(len(u)), 2 * u - 1, curve(u)])

    return features


def _product(one: Get, two: Get) -> Get:
    """Return the basis functions of the product of two kernels, from the basis functions of each kernel."""

    def features(conditions: Conditions) -> Floats:
        left, right = one(conditions), two(conditions)
        return (left[:, :, None] * right[:, None, :]).reshape(len(left), -1)

    return features


def _ring(get: Get, width: float) -> Get:
    """Return basis functions (n, k) for the periodic kernel exp(−2 sin²(Δ/2)/w²) of an angle.

    Its Fourier coefficients are modified Bessel functions I_k(1/w²). `get` returns the angle in rad, w is
    `width`.
    """
    order = np.arange(_HARMONICS + 1)
    weight = special.ive(order, 1 / width**2) * np.where(order == 0, 1.0, 2.0)
    order, root = order[weight > 1e-4], np.sqrt(weight[weight > 1e-4])

    def features(conditions: Conditions) -> Floats:
        turned = get(conditions)[:, None] * order
        return np.concatenate([root * np.cos(turned), root[1:] * np.sin(turned[:, 1:])], axis=1)

    return features


def _of_reading(length: float) -> Callable[[Floats, int], Floats]:
    """Return basis functions (n, k) for the kernel 1 + exp(−½ Δ²/ℓ²) of each axis's own reading in g.

    ℓ is `length` times the range of the reading, 2 g.
    """
    curve = _inducing(-1.1, 1.1, 2 * length)

    def features(ideal: Floats, axis: int) -> Floats:
        return np.column_stack([np.ones(len(ideal)), curve(np.clip(ideal[:, axis], -1.1, 1.1))])

    return features
