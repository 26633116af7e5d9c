"""The whitened linear problem in which effects are chosen, with a block of orthonormal columns per term.

About given parameter values, the readings minus the prediction and the columns of every term are whitened
and projected off the base model. Each term's block is made orthonormal, so that its score statistic is the
sum of its squared scores, and a search needs only dot products of columns.

Amplitudes have a normal prior with the width of the physical bounds. The prior acts like additional rows
below each block (target 0, a column 1/σ). Blocks do not share these rows, so they are not stored. A block
is orthonormal *together with* its prior rows; its products with other blocks contain only the readings.
Without the prior, a covariate that is constant except for noise would act as a second bias of unphysical
amplitude.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, amplitude_spreads
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.tracing.named_candidates import SplitEffect
from adis_gonio.tracing.session_blocks import (
    ModelBasis,
    SessionBlocks,
    by_session,
    columns_of,
    orthonormal,
    orthonormal_combinations,
    runs,
    session_bases,
    solve_small_systems,
)
from adis_gonio.tracing.thresholds import limits

_TINY = 1e-8
"""Least squared part of a column outside a model; a smaller part is a rounding error."""
_PAIR_PRODUCTS = 1 << 20
"""Number of products of columns by which gains of pairs are computed at once."""


@dataclass(frozen=True)
class LinearProblem:
    """The model linearised at given parameter values, with a block of columns for each candidate term.

    Attributes
    ----------
    terms : tuple of Term
        Candidate terms that this session can show.
    shared : SessionBlocks
        Columns of the first terms, with all rows as one session.
    target : (rows,) float
        Whitened readings minus prediction, projected off the base model.
    dof : int
        Rows minus the rank of the base model.
    column_price : (M,) float
        Price of the columns of each term: it lowers the log evidence, as `cost` does.
    inflation : float
        Factor on the noise variance contained in the prior of the blocks.
    joint : bool
        True for readings of several sessions. The search then adds pairs of named terms only if these have
        at most `limits.paired` columns.
    split : SessionBlocks or None
        Columns of the last terms, those with amplitudes of their own in each session; None if there are
        none.
    """

    terms: tuple[Term, ...]
    shared: SessionBlocks
    target: Floats
    dof: int
    column_price: Floats
    inflation: float = 1.0
    joint: bool = False
    split: SessionBlocks | None = None

    @cached_property
    def width(self) -> NDArray[np.intp]:
        """Number of columns (M,) of each term."""
        every = [self.shared.total] if self.split is None else [self.shared.total, self.split.total]
        return np.concatenate(every)

    @cached_property
    def cost(self) -> Floats:
        """Cost (M,) of each term, −ln of its share of the prior."""
        return np.array([term.cost for term in self.terms])

    @property
    def columns(self) -> Floats:
        """Columns (rows, P) of the first terms in order (`shared`); columns not seen are zero."""
        return np.asarray(self.shared.columns[0])

    @property
    def chi2(self) -> float:
        """χ² of the base model's residual."""
        return float(self.target @ self.target)

    @property
    def widest_bias(self) -> int | None:
        """Number of the bias term that acts on the most axes; None if no candidate is a bias.

        A bias with a stated prior of its size does not count.
        """
        biases = [k for k, term in enumerate(self.terms) if term.constant and term.prior_sd is None]
        return max(biases, key=lambda k: int(self.width[k]), default=None)

    def _home(self, term: int) -> tuple[SessionBlocks, int]:
        """Return the blocks with the columns of a term, and the number of the term in these blocks."""
        own = term - len(self.shared.width)
        return (self.shared, term) if self.split is None or own < 0 else (self.split, own)

    def block(self, term: int) -> Floats:
        """Return the columns (rows, width) of one term, given by its number."""
        blocks, own = self._home(term)
        return blocks.of_term(own)

    def back_of(self, term: int) -> Floats:
        """Return the matrix (d, width) that maps the coefficients of a term's block to its amplitudes."""
        blocks, own = self._home(term)
        return blocks.joined(blocks.back[own], own)

    def prior_of(self, term: int) -> Floats:
        """Return the Gram matrix (width, width) of the prior rows of a term's block."""
        blocks, own = self._home(term)
        return blocks.prior_of(own)

    def basis_of(self, model: Sequence[int], *, with_prior: bool = True) -> ModelBasis:
        """Return orthonormal columns of a model of several sessions; `model` has the numbers of its terms.

        `with_prior` includes the prior rows of the amplitudes (see `SessionBlocks.basis`).
        """
        assert self.split is not None
        count = len(self.shared.width)
        columns, gram = self.columns_and_gram([k for k in model if k < count])
        own = [k - count for k in model if k >= count]
        return self.split.basis(own, by_session(columns, self.split.place), gram, with_prior=with_prior)

    def off(self, model: Sequence[int], values: Floats) -> Floats:
        """Return the part (rows,) of values (rows,) that a model with free amplitudes cannot reproduce.

        The values must have no part in the base model; the target has none.
        """
        if self.split is None:
            basis = span(self, model)[0]
            return np.asarray(values - basis @ (basis.T @ values))
        model_basis = self.basis_of(model, with_prior=False)
        return self.split.by_row(model_basis.off(by_session(values, self.split.place)))

    @cached_property
    def dense(self) -> LinearProblem:
        """Problem with the columns of all terms in `columns`, so that `split` is None."""
        if self.split is None:
            return self
        every = range(len(self.terms))
        blocks = replace(
            self.shared,
            columns=np.concatenate([self.block(k) for k in every], axis=1)[None],
            width=self.width,
            seen=np.ones((1, int(self.width.sum())), dtype=bool),
            back=tuple(self.back_of(k)[None] for k in every),
            prior=tuple(self.prior_of(k)[None] for k in every),
        )
        return replace(self, shared=blocks.with_prior(), split=None)

    def gains(self, basis: Floats, residual: Floats) -> Floats:
        """Return the decrease of χ² (M,) by each term if it alone is added to a model.

        `basis` (rows, k) is an orthonormal basis of the model's columns, `residual` (rows,) the model's
        residual.
        """
        gains = self.gains_from_products(residual @ self.columns, basis.T @ self.columns)
        if self.split is None:
            return gains
        shared = np.concatenate([self.split.base, by_session(basis, self.split.place)], axis=2)
        model = ModelBasis(self.split.columns[..., :0], shared, basis.shape[1])
        return np.concatenate([gains, self.split.gains(model, by_session(residual, self.split.place))])

    def gains_from_products(self, z: Floats, inside: Floats) -> Floats:
        """Return the decrease of χ² (M',) by each added term, from products of all P columns.

        `z` (P,) are their products with the model's residual, `inside` (k, P) with an orthonormal basis of
        the model's columns.
        """
        first = self.shared.first
        if not len(first):
            return np.zeros(0)
        k = len(inside)
        if not k:
            return np.asarray(np.add.reduceat(z**2, first))
        # With A = basisᵀ · block, the gain of a block is zᵀ H z, H = ((1 + ε) 1 − AᵀA)⁻¹. The ridge ε
        # replaces a rank decision: along a direction inside the model z is zero too. The ridge loses 1e-4
        # of the gain, more than any price if the gain is a bias of hundreds of uncertainties; the
        # refinement step zᵀ(H + εH²)z reduces the loss to 1e-8.
        gains = []
        least, wide = 1 + limits.independent, len(first)
        for members, places, size in self._groups:
            if size >= k:
                wide = members.start
                break
            own = inside[:, places].reshape(k, -1, size)
            gram = least * np.eye(size)[:, :, None] - np.einsum("knv,knw->vwn", own, own)
            along = z[places].reshape(-1, size).T
            solved = solve_small_systems(gram, along)
            gains.append((along * solved + limits.independent * solved**2).sum(axis=0))
        if wide < len(first):
            gains.append(_gains_of_wide_blocks(z, inside, first[wide:]))
        return np.concatenate(gains)

    def pair_gains(self, z: Floats, inside: Floats, gram: Floats) -> Iterator[tuple[slice, Floats]]:
        """Yield the decrease of χ² by pairs of terms if both are added to a model.

        `z` (P,), `inside` (k, P) and `gram` (P, P) are the products of all columns with the model's
        residual, with an orthonormal basis of its columns and with each other. Each item has the numbers
        (m,) of first terms and their gains with these and all later terms, (m, M − number of the first).
        Only entries above the diagonal are valid; −∞ if the first term lies in the model.
        """
        # Orthonormalise the part of each block outside the model.
        z = z.copy()
        alone = np.zeros(len(self.shared.width))
        halves = []
        for members, places, size in self._groups:
            outside = inside[:, places].reshape(len(inside), members.stop - members.start, size)
            own = (1 + _TINY) * np.eye(size) - np.einsum("knv,knw->nvw", outside, outside)
            root = np.linalg.cholesky(own)
            seen = (np.diagonal(root, axis1=1, axis2=2) ** 2 > limits.independent).all(axis=1)
            halves.append(np.linalg.inv(root))
            turned = halves[-1] @ z[places].reshape(-1, size, 1)
            z[places] = turned.ravel()
            alone[members] = np.where(seen, (turned**2).sum(axis=(1, 2)), -np.inf)
        for group, (members, places, size) in enumerate(self._groups):
            step = max(1, _PAIR_PRODUCTS // (size * len(z)))
            for start in range(members.start, members.stop, step):
                chunk = slice(start, min(start + step, members.stop))
                first = places.start + size * (start - members.start)
                rows = slice(first, first + size * (chunk.stop - start))
                left = gram[rows, first:] - inside[:, rows].T @ inside[:, first:]
                turns = halves[group][start - members.start : chunk.stop - members.start]
                left = turns @ left.reshape(-1, size, left.shape[1])
                for (_, columns, wide), half in zip(self._groups[group:], halves[group:], strict=True):
                    own = left[..., max(0, columns.start - first) : columns.stop - first]
                    blocks = own.reshape(*own.shape[:2], -1, wide)
                    turned = np.einsum("nrmw,mvw->nrmv", blocks, half[-blocks.shape[2] :])
                    own[:] = turned.reshape(own.shape)
                # The gain of both is the gain of one, and of the other beyond it.
                along = left.transpose(1, 0, 2)
                rest = z[first:] - (z[rows].reshape(-1, size).T[:, :, None] * along).sum(axis=0)
                both = _gains_of_wide_blocks(rest, along, self.shared.first[start:] - first)
                yield chunk, both + alone[chunk, None]

    def subset(self, chosen: NDArray[np.intp]) -> LinearProblem:
        """Return the problem restricted to the terms with the numbers `chosen`, in ascending order."""
        count = len(self.shared.width)
        return replace(
            self,
            terms=tuple(self.terms[k] for k in chosen),
            shared=self.shared.subset(chosen[chosen < count]),
            column_price=self.column_price[chosen],
            split=None if self.split is None else self.split.subset(chosen[chosen >= count] - count),
        )

    def with_inflation(self, inflation: float) -> LinearProblem:
        """Return the problem with the measured noise variance multiplied by `inflation`.

        This changes the weight of the prior relative to the readings.
        """
        if inflation == self.inflation:
            return self
        factor = inflation / self.inflation
        split = None if self.split is None else self.split.with_prior(factor)
        return replace(self, shared=self.shared.with_prior(factor), split=split, inflation=inflation)

    def with_covariance(self, features: Floats) -> LinearProblem:
        """Return the problem with the covariance F Fᵀ of features F (rows, k) added to the noise."""
        if self.split is not None:
            return self.dense.with_covariance(features)
        values, vectors = np.linalg.eigh(features @ features.T)
        white = (vectors / np.sqrt(1 + np.maximum(values, 0.0))) @ vectors.T
        # The prior of an amplitude does not change.
        moved = replace(self.shared, columns=(white @ self.columns)[None])
        return replace(self, shared=moved.with_prior(), target=white @ self.target)

    @cached_property
    def _groups(self) -> list[tuple[slice, slice, int]]:
        """Terms in groups of equal width: slice of their numbers, slice of their columns, width."""
        return runs(self.shared.width)

    def gain(self, model: Sequence[int]) -> float:
        """Return the decrease of χ² by a model with its most probable amplitudes.

        The χ² of these amplitudes under their prior is subtracted.
        """
        columns, gram = self.columns_and_gram(model)
        along = self.target @ columns @ _full_combinations(gram)
        return float(along @ along)

    def columns_and_gram(self, model: Sequence[int]) -> tuple[Floats, Floats]:
        """Return the columns (rows, p) of a model, and their Gram matrix (p, p) with the prior rows."""
        columns = np.concatenate([self.columns[:, :0], *(self.block(k) for k in model)], axis=1)
        gram = columns.T @ columns
        start = 0
        for k in model:  # terms do not share prior rows
            own = slice(start, start + int(self.width[k]))
            gram[own, own] += self.prior_of(k)
            start = own.stop
        return columns, gram


def _gains_of_wide_blocks(z: Floats, inside: Floats, first: NDArray[np.intp]) -> Floats:
    """Return the decrease of χ² (…, M) by each added term, computed by systems of the size k of the model.

    By Woodbury's identity only the matrix (1 + ε) 1 − AAᵀ, (k, k), is inverted for each term, with its
    columns A of `inside` and ε = `limits.independent`. `z` (…, P) are the products of all columns with the
    residual, `inside` (k, …, P) with the model's basis; `first` (M,) are the first columns of the blocks.
    The function is for models with fewer columns than the blocks.
    """
    k, start = len(inside), int(first[0])
    z, inside, first = z[..., start:], inside[..., start:], first - start
    square = np.add.reduceat(z**2, first, axis=-1)
    along = np.add.reduceat(inside * z, first, axis=-1).reshape(k, -1)
    gram = np.add.reduceat(inside[:, None] * inside, first, axis=-1).reshape(k, k, -1)
    least = 1 + limits.independent
    solved = solve_small_systems(least * np.eye(k)[:, :, None] - gram, along)
    both = square + (along * solved).sum(axis=0).reshape(square.shape)
    twice = both + least * (solved**2).sum(axis=0).reshape(square.shape)
    return np.asarray(both / least + limits.independent * twice / least**2)


class Products:
    """Cache of scalar products between the columns of models and the columns of terms that may extend them.

    With these products, an extension of a model can be scored without using the rows.
    """

    def __init__(self, problem: LinearProblem, joining: LinearProblem) -> None:
        self._problem, self._joining = problem, joining
        self._target = problem.target @ joining.columns
        self._of: dict[int, Floats] = {}

    def extensions(self, model: Sequence[int]) -> tuple[float, int, Floats]:
        """Return a model's χ², its number of columns, and the decrease of χ² (M,) by each added term."""
        split = self._joining.split
        if split is None:
            chi2, z, inside = self.of_model(model)
            return chi2, len(inside), self._joining.gains_from_products(z, inside)
        basis, (target, columns) = self._problem.basis_of(model), self._by_session
        residual = basis.off(target)
        # χ² of amplitudes with their prior: the target times the residual.
        chi2 = float((target * residual).sum())
        own = basis.own.swapaxes(1, 2) @ columns
        shared = np.tensordot(basis.shared, columns, axes=((0, 1), (0, 1)))
        inside = np.concatenate([own.reshape(-1, own.shape[2]), shared])
        z = np.tensordot(residual, columns, axes=2)
        gains = self._joining.gains_from_products(z, inside)
        return chi2, basis.rank, np.concatenate([gains, split.gains(basis, residual)])

    @cached_property
    def _by_session(self) -> tuple[Floats, Floats]:
        """Target and joining columns, by session."""
        split = self._problem.split
        assert split is not None
        return by_session(self._problem.target, split.place), by_session(self._joining.columns, split.place)

    def of_model(self, model: Sequence[int]) -> tuple[float, Floats, Floats]:
        """Return the χ² of a model's residual, and two sets of products with all P candidate columns.

        The first set (P,) is with the model's residual, the second (k, P) with an orthonormal basis of the
        model's k columns.
        """
        problem = self._problem
        if not len(model):
            return problem.chi2, self._target, np.zeros((0, len(self._target)))
        for k in model:
            if k not in self._of:
                self._of[k] = problem.block(k).T @ self._joining.columns
        columns, gram = problem.columns_and_gram(model)
        half = _full_combinations(gram)
        along = problem.target @ columns @ half
        inside = half.T @ np.concatenate([self._of[k] for k in model])
        return problem.chi2 - float(along @ along), self._target - along @ inside, inside

    def pairs(self, model: Sequence[int]) -> tuple[float, int, Iterator[tuple[slice, Floats]]]:
        """Return a model's χ², its number of columns, and `LinearProblem.pair_gains` of the added terms."""
        if self._problem.split is not None:
            return self._dense.pairs(model)
        chi2, z, inside = self.of_model(model)
        return chi2, len(inside), self._joining.pair_gains(z, inside, self._gram)

    @cached_property
    def _dense(self) -> Products:
        return Products(self._problem.dense, self._joining.dense)

    @cached_property
    def _gram(self) -> Floats:
        columns = self._joining.columns
        return columns.T @ columns


def linearise(fit: Fit, terms: Sequence[Term]) -> LinearProblem:
    """Return the linear problem about the values of a fit, with these candidate terms.

    The model of the fit may already contain some of the terms.
    """
    base, target = reduced(fit)
    # The last terms have amplitudes of their own in each session.
    own = {} if _sessions_share_noise(fit) else _terms_of_sessions(fit, terms)
    shared = [term for k, term in enumerate(terms) if k not in own]
    # All rows as one session; its base model is projected out.
    place = np.arange(len(target))[None]
    numbers, blocks, prices = _blocks(fit, shared, place, (base[None], base[None, :, :0]))
    made = LinearProblem(
        terms=tuple(shared[k] for k in numbers),
        shared=blocks,
        target=target,
        dof=len(target) - base.shape[1],
        column_price=prices,
        joint=bool(fit.data.model.origins),
    )
    if own:
        made = _with_split(made, fit, [terms[k] for k in own], list(own.values()))
    for k, term in enumerate(made.terms):
        if term.constant and term.cost <= 0:
            made.column_price[k] = 0.0  # it is in every model
        elif term.prior_sd is not None:
            # A stated prior of the amplitudes: ½ ln |1 + Σ Xᵀ X|, with the columns X of the readings.
            made.column_price[k] = -0.5 * np.linalg.slogdet(made.prior_of(k))[1]
    return made


def _sessions_share_noise(fit: Fit) -> bool:
    """Return True if an error acts on the readings of several sessions, such as an error of their stage."""
    if fit.modes is None or not fit.data.model.origins:
        return False
    sessions = fit.data.conditions.covariate("session")
    session = np.repeat(sessions, len(fit.modes) // len(sessions))
    acts = [(fit.modes[session == k] != 0).any(axis=0) for k in np.unique(session)]
    return bool((np.sum(acts, axis=0) > 1).any())


def _terms_of_sessions(fit: Fit, terms: Sequence[Term]) -> dict[int, NamedTerm]:
    """Return the terms with amplitudes of their own in each session, as terms of a single session.

    The keys are their numbers among `terms`.
    """
    each = tuple(range(len(fit.data.model.origins)))
    found: dict[int, NamedTerm] = {}
    for k, term in enumerate(terms):
        if not isinstance(term, NamedTerm) or not isinstance(term.effect, SplitEffect):
            continue
        if term.effect.sharing.group == each:
            whole = term.effect.whole
            later = len(term.effect.parameters) - len(whole.parameters)
            found[k] = replace(term, effect=whole, shapes=tuple((i - later, tau) for i, tau in term.shapes))
    return found


def _with_split(
    problem: LinearProblem, fit: Fit, terms: Sequence[Term], of_one: Sequence[Term]
) -> LinearProblem:
    """Add terms with amplitudes of their own in each session to a problem.

    `of_one` are these terms for a single session.
    """
    data, rows = fit.data, len(problem.target)
    session = np.repeat(data.conditions.covariate("session").astype(np.intp), rows // len(data))
    members = [np.flatnonzero(session == k) for k in range(len(data.model.origins))]
    place = np.array([*itertools.zip_longest(*members, fillvalue=rows)]).T
    bases = session_bases(by_session(fit.white(fit.base_columns), place))
    numbers, split, prices = _blocks(fit, of_one, place, bases)
    return replace(
        problem,
        terms=(*problem.terms, *(terms[k] for k in numbers)),
        column_price=np.concatenate([problem.column_price, prices]),
        split=split,
    )


def _blocks(
    fit: Fit, terms: Sequence[Term], place: NDArray[np.intp], bases: tuple[Floats, Floats]
) -> tuple[list[int], SessionBlocks, Floats]:
    """Return the terms that the readings show, sorted by width, with their columns and prices.

    The first result are their indices in `terms`, the last one are the prices (M,) of their columns in
    nats. `place` and `bases` are as in `SessionBlocks.of`.
    """
    raw, width = fit.candidates(terms)
    spread = amplitude_spreads(fit.data.model, terms, width)
    numbers = np.argsort(width, kind="stable")
    index = columns_of(np.cumsum(width) - width, width, numbers)
    white = fit.white(raw)[:, index]
    del raw  # at 2000 dwells each of these arrays takes 600 MB
    blocks = SessionBlocks.of(
        len(white), place, bases, by_session(white, place), spread[index], width[numbers]
    )
    del white
    shown = np.flatnonzero(blocks.total).astype(np.intp)
    blocks = blocks.subset(shown)
    # The price of a column u of length 1 is ½ ln(1 + s² n): s is the prior standard deviation in units of
    # the noise, n = 1/Σ u⁴ the effective number of its rows.
    fourth = ((blocks.columns**2) ** 2).sum(axis=1)
    each = 0.5 * np.log1p(limits.prior_snr**2 * (fourth > 0) / np.maximum(fourth, 1e-300)).sum(axis=0)
    prices = np.add.reduceat(each, blocks.first) if len(shown) else np.zeros(0)
    return numbers[shown].tolist(), blocks.with_prior(), prices


def reduced(fit: Fit, further: Sequence[Term] = ()) -> tuple[Floats, Floats]:
    """Return an orthonormal basis of the whitened base model, and the target outside it.

    The target (rows,) contains the contributions of the fit's own terms, which are candidates like all
    others. The basis (rows, k) includes the columns of the terms `further`.
    """
    left = fit.declared_misfit
    for k in range(len(fit.terms)):
        left = left + fit.added(k)
    target = fit.white(left[:, :, None])[:, 0]
    every = [fit.base_columns, *(fit.candidate(term) for term in further)]
    base = orthonormal(fit.white(np.concatenate(every, axis=2)))
    return base, target - base @ (base.T @ target)


def span(problem: LinearProblem, model: Sequence[int]) -> tuple[Floats, Floats]:
    """Return an orthonormal basis (rows, k) of a model's columns, and the target's residual (rows,).

    Amplitudes are free: the prior is not applied.
    """
    if not len(model):
        return np.zeros((len(problem.target), 0)), problem.target
    u, s, _ = np.linalg.svd(np.concatenate([problem.block(k) for k in model], axis=1), full_matrices=False)
    basis = u[:, s > np.sqrt(limits.independent)]
    return basis, problem.target - basis @ (basis.T @ problem.target)


def _full_combinations(gram: Floats) -> Floats:
    """Return a matrix (p, k) that turns p columns with Gram matrix `gram` into k orthonormal columns."""
    half = orthonormal_combinations(gram)
    return half[:, half.any(axis=0)]


def amplitudes(problem: LinearProblem, model: Sequence[int]) -> list[Floats]:
    """Return the most probable amplitudes (d,) of each term of a model, by least squares with the prior."""
    columns, gram = problem.columns_and_gram(model)
    solved = np.linalg.lstsq(gram, columns.T @ problem.target, rcond=1e-12)[0]
    cuts = np.cumsum([0] + [int(problem.width[k]) for k in model])
    return [problem.back_of(k) @ solved[cuts[i] : cuts[i + 1]] for i, k in enumerate(model)]
