"""What stands for a cause without a name: formulas and smooth functions, averaged by their evidence.

Which formula is the right one is seldom certain, and where none is, a smooth function is nearer. All
models that have the same named effects as the chosen one, and Gaussian processes in its nameless terms'
place, are fitted; the mean of what they add, weighted by their evidence, is what the corrected model adds
(Hoeting, Madigan, Raftery and Volinsky, Bayesian model averaging, Statistical Science 14, 1999). What is
*reported* is the formula of the best one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, nameless_spread
from adis_gonio.fitting.estimation.terms import Basis, NamelessTerm, Term, Where
from adis_gonio.model.effects import Conditions
from adis_gonio.tracing.linear_problem import orthonormal
from adis_gonio.tracing.selection import Selection
from adis_gonio.tracing.smooth_candidates import Process, evidence, processes
from adis_gonio.tracing.thresholds import limits

Member = tuple[float, NamelessTerm, Floats]


@dataclass(frozen=True)
class AveragedTerm(NamelessTerm):
    """Mean of fitted nameless terms: a fixed function, without a parameter of its own.

    Attributes
    ----------
    members : tuple of (weight, term, values)
        All of them enter the angle, or none does.
    """

    members: tuple[Member, ...] = ()

    @property
    def form(self) -> str:
        """Form of the member with the largest weight."""
        return max(self.members, key=lambda member: member[0])[1].form

    def added(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Weighted mean of what the members add."""
        parts = [weight * term.added(own, ideal, conditions) for weight, term, own in self.members]
        total: Floats = np.sum(parts, axis=0)
        return total

    def columns(self, ideal: Floats, conditions: Conditions) -> Floats:
        """No columns."""
        n, axes = ideal.shape
        return np.zeros((n, 0) if self.enters_angle else (n, axes, 0))


@dataclass(frozen=True)
class AveragedFit(Fit):
    """A fit whose uncertainty is that within and between the members of an average.

    Attributes
    ----------
    mixed_covariance : (p, p) float
        Of base and named parameters.
    mixed_used : float
        Degrees of freedom that base, names and members use, weighted.
    """

    mixed_covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    mixed_used: float = 0.0

    @property
    def covariance(self) -> Floats:
        """As `mixed_covariance`."""
        return self.mixed_covariance

    @property
    def used(self) -> float:
        """As `mixed_used`."""
        return self.mixed_used


@dataclass(frozen=True)
class Averaged:
    """A model whose nameless part is an average.

    Attributes
    ----------
    fit : Fit
        Named terms, then at most one averaged term at the angle and one at the readings; base and named
        terms are refitted beside it.
    smooth : NamelessTerm
        Most probable process.
    weight : float
        Probability of all processes together.
    candidates : tuple of Process
        Most promising processes.
    """

    fit: AveragedFit
    smooth: NamelessTerm
    weight: float
    candidates: tuple[Process, ...]

    @property
    def named(self) -> tuple[Term, ...]:
        """Terms that have a name."""
        return tuple(term for term in self.fit.terms if term.name is not None)


def average(selection: Selection, candidates: Sequence[Process] | None = None) -> Averaged | None:
    """Average over what may stand beside the named effects; None where nothing nameless is called for.

    Where no formula is adequate a process may be: first all are weighed under the measured noise, and only
    if their average is not adequate either under the noise that the best formula leaves. Under that noise a
    formula that is wrong by many uncertainties would beat the process that is right.

    Parameters
    ----------
    candidates : sequence of Process, optional
        Processes to try; by default all.
    """
    if selection.data.noise_known and selection.inflation > 1:
        measured = _average(replace(selection, inflation=1.0), candidates)
        if measured is not None and selection.with_fit(measured.fit).adequate:
            return measured
    return _average(selection, candidates)


def _average(selection: Selection, candidates: Sequence[Process] | None) -> Averaged | None:
    data, terms, best = selection.data, selection.problem.terms, selection.verdict.best
    named = tuple(k for k in best if terms[k].name is not None)
    nameless = len(named) < len(best)
    if not nameless and (selection.adequate or not data.noise_known):
        return None
    base, _, target = selection.fit.linear()
    fixed = np.concatenate([base, *_named_columns(selection.fit)], axis=1)
    beside = orthonormal(fixed)
    left = target - beside @ (beside.T @ target)
    candidates = processes(data) if candidates is None else candidates
    smooth = evidence(selection.fit, beside, left, candidates, selection.inflation)
    promising = tuple(candidates[k] for k in np.argsort(-smooth)[: limits.promising])
    pool: list[tuple[float, tuple[NamelessTerm, ...]]] = [
        (float(smooth[k]), (candidates[k].term,)) for k in np.argsort(-smooth)[: limits.promising]
    ]
    if nameless:
        pool += _formulas(selection, named, candidates)
    else:
        pool.append((0.0, ()))
    weights = np.exp(np.array([score for score, _ in pool]) - max(score for score, _ in pool))
    weights = np.where(weights >= limits.counted * weights.sum(), weights, 0.0)
    weights /= weights.sum()
    if weights[-1] > 0.5 and not pool[-1][1]:
        return None
    members, covariance, used = _fitted(selection, fixed, target, pool, weights)
    averaged = _terms(members)
    own = [
        (term, values)
        for term, values in zip(selection.fit.terms, selection.fit.values.terms, strict=True)
        if term.name is not None
    ]
    fit = selection.fit.having(
        [*(term for term, _ in own), *averaged], [*(v for _, v in own), *(np.zeros(0) for _ in averaged)]
    ).refit()
    weight = float(weights[: len(promising)].sum())
    # A fixed function has no freedom of its own: what its members used is spent all the same.
    spent = AveragedFit(
        fit.data, fit.terms, fit.values, fit.with_prior, mixed_covariance=covariance, mixed_used=used
    )
    return Averaged(spent, promising[0].term, weight, promising)


def _named_columns(fit: Fit) -> list[Floats]:
    """Whitened columns of all parameters of the named terms."""
    return [
        fit.jacobian[:, fit.slice_of(index)]
        for index, term in enumerate(fit.terms)
        if term.name is not None
    ]


def _by_process(term: NamelessTerm, covered: set[tuple[Where, tuple[str, ...]]]) -> bool:
    """True for a polynomial that only approximates, where processes of the same place and covariates are.

    Both bend as the readings ask, but beyond them a polynomial runs off.
    """
    return term.basis.approximates and (term.where, term.covariates) in covered


def _formulas(
    selection: Selection, named: tuple[int, ...], candidates: Sequence[Process]
) -> list[tuple[float, tuple[NamelessTerm, ...]]]:
    """Nameless parts of the models with these named terms, with their evidence against the named alone."""
    problem, found = selection.problem, selection.found

    def score(model: tuple[int, ...]) -> float:
        explained = 0.5 * problem.gain(model) / selection.inflation
        return explained - float(sum(found.prices[k] for k in model))

    covered = {(process.term.where, process.term.covariates) for process in candidates}
    near = {m for m in found.near(limits.averaged) if tuple(k for k in m if k in named) == named}
    alone = score(named)
    pool = []
    for model in sorted({*near, tuple(selection.verdict.best)}):
        rest = tuple(problem.terms[k] for k in model if k not in named)
        if rest and all(isinstance(t, NamelessTerm) and not _by_process(t, covered) for t in rest):
            pool.append((score(model) - alone, tuple(t for t in rest if isinstance(t, NamelessTerm))))
    return pool


def _fitted(
    selection: Selection,
    fixed: Floats,
    target: Floats,
    pool: Sequence[tuple[float, tuple[NamelessTerm, ...]]],
    weights: Floats,
) -> tuple[list[Member], Floats, float]:
    """Members with their values; of the fixed parameters the covariance (k, k) within and between members.

    The last is the number of degrees of freedom that the members use, weighted.
    """
    members: list[Member] = []
    means, within, used = [], np.zeros((fixed.shape[1], fixed.shape[1])), 0.0
    likely = np.flatnonzero(weights).tolist()
    solutions = {k: _ridge(selection, fixed, target, pool[k][1]) for k in likely}
    seen = {k: solution[3] >= limits.visible for k, solution in solutions.items()}
    if any(seen.values()):
        weights = np.array([weight * seen.get(k, 0) for k, weight in enumerate(weights)])
        weights /= weights.sum()
    for k in np.flatnonzero(weights).tolist():
        weight, terms = float(weights[k]), pool[k][1]
        solved, covariance, freedom, _ = solutions[k]
        used += float(weight) * freedom
        means.append((weight, solved[: fixed.shape[1]]))
        within += weight * covariance[: fixed.shape[1], : fixed.shape[1]]
        cut = fixed.shape[1]
        for term in terms:
            width = _width(selection.fit, term)
            members.append((float(weight), term, solved[cut : cut + width]))
            cut += width
    mean = np.sum([w * m for w, m in means], axis=0)
    between = np.sum([w * np.outer(m - mean, m - mean) for w, m in means], axis=0)
    return members, within + between / selection.inflation, used


def _width(fit: Fit, term: NamelessTerm) -> int:
    return int(term.columns(fit.ideal, fit.data.conditions).shape[-1])


def _ridge(
    selection: Selection, fixed: Floats, target: Floats, terms: Sequence[NamelessTerm]
) -> tuple[Floats, Floats, float, float]:
    """Values of all parameters, their covariance in units of the noise, degrees of freedom, visible part.

    The last is the share of what the terms add that the fixed columns could not have added: 1 without terms
    and for processes, whose priors keep them small.
    """
    fit = selection.fit
    blocks = [fit.white(fit.candidate(term)) for term in terms]
    columns = np.concatenate([fixed, *blocks], axis=1)
    priors = [np.zeros(fixed.shape[1])]
    for term, block in zip(terms, blocks, strict=True):
        held = np.sqrt(selection.inflation) / (term.shrinkage or nameless_spread(fit.data.model, term))
        priors.append(np.full(block.shape[1], held))
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
    if all(term.shrinkage is None for term in terms) and added.any():
        beside = orthonormal(fixed)
        left = added - beside @ (beside.T @ added)
        visible = float(np.linalg.norm(left) / np.linalg.norm(added))
    return solved, half @ half.T, float(((columns @ half) ** 2).sum()), visible


def _terms(members: Sequence[Member]) -> list[AveragedTerm]:
    """One term for the members at the readings, one for those at the angle."""
    made = []
    for angle in (False, True):
        mine = tuple(member for member in members if member[1].enters_angle == angle)
        if not mine:
            continue
        first = max(mine, key=lambda member: member[0])[1]
        covariates = tuple(dict.fromkeys(c for c in first.covariates))
        axes = tuple(sorted({axis for _, term, _ in mine for axis in term.axes}))
        made.append(
            AveragedTerm(
                label="average at the angle" if angle else "average at the readings",
                covariates=covariates,
                cost=0.0,
                where="angle" if angle else "bias",
                axes=axes,
                basis=Basis(first.basis.form, covariates),
                members=mine,
            )
        )
    return made
