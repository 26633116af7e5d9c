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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit, amplitude_spreads
from adis_gonio.fitting.estimation.terms import ROUNDING, Term
from adis_gonio.tracing.thresholds import limits

_RANK = 1e-7
"""Least squared length of a column outside the other columns of its term; a shorter column is dropped."""
_TINY = 1e-8
"""Least squared part of a column outside a model; a smaller part is a rounding error."""


@dataclass(frozen=True)
class LinearProblem:
    """The model linearised at given parameter values, with a block of columns for each candidate term.

    Attributes
    ----------
    terms : tuple of Term
        Candidate terms that this session can show.
    columns : (rows, P) float
        Columns of all terms in order. The columns Q of one term (its block) have QᵀQ + `prior` = 1.
    first, width : (M,) int
        First column and number of columns of each of the M terms; the numbers ascend.
    target : (rows,) float
        Whitened readings minus prediction, projected off the base model.
    dof : int
        Rows minus the rank of the base model.
    back : tuple of (d, width) float
        Matrices that map the coefficients of a block to the amplitudes of its term.
    cost, column_price : (M,) float
        −ln of each term's share of the prior, and the price of its columns: both lower the log evidence.
    hidden : tuple of Term
        Candidates that the session cannot show, since the base model reproduces their columns.
    prior : tuple of (width, width) float
        Gram matrix of each block's prior rows, in units of the noise.
    inflation : float
        Factor on the noise variance contained in `prior`.
    joint : bool
        True for readings of several sessions. The search then adds pairs of named terms only if these have
        at most `limits.paired` columns.
    """

    terms: tuple[Term, ...]
    columns: Floats
    first: NDArray[np.intp]
    width: NDArray[np.intp]
    target: Floats
    dof: int
    back: tuple[Floats, ...]
    hidden: tuple[Term, ...]
    cost: Floats
    column_price: Floats
    prior: tuple[Floats, ...]
    inflation: float = 1.0
    joint: bool = False

    @property
    def chi2(self) -> float:
        """χ² of the base model's residual."""
        return float(self.target @ self.target)

    def block(self, term: int) -> Floats:
        """Return the columns (rows, width) of one term, given by its number."""
        return self.columns[:, self.first[term] : self.first[term] + self.width[term]]

    def gains(self, basis: Floats, residual: Floats) -> Floats:
        """Return the decrease of χ² (M,) by each term if it alone is added to a model.

        `basis` (rows, k) is an orthonormal basis of the model's columns, `residual` (rows,) the model's
        residual.
        """
        return self.gains_from_products(residual @ self.columns, basis.T @ self.columns)

    def gains_from_products(self, z: Floats, inside: Floats) -> Floats:
        """Return the decrease of χ² (M,) by each added term, from products of all P columns.

        `z` (P,) are their products with the model's residual, `inside` (k, P) with an orthonormal basis of
        the model's columns.
        """
        if not len(self.first):
            return np.zeros(0)
        k = len(inside)
        if not k:
            return np.asarray(np.add.reduceat(z**2, self.first))
        # With A = basisᵀ · block, the gain of a block is zᵀ H z, H = ((1 + ε) 1 − AᵀA)⁻¹. The ridge ε
        # replaces a rank decision: along a direction inside the model z is zero too. The ridge loses 1e-4
        # of the gain, more than any price if the gain is a bias of hundreds of uncertainties; the
        # refinement step zᵀ(H + εH²)z reduces the loss to 1e-8.
        gains = []
        least, wide = 1 + limits.independent, len(self.first)
        for members, places, size in self._groups:
            if size >= k:
                wide = members.start
                break
            own = inside[:, places].reshape(k, -1, size)
            gram = least * np.eye(size)[:, :, None] - np.einsum("knv,knw->vwn", own, own)
            along = z[places].reshape(-1, size).T
            solved = _solve_small_systems(gram, along)
            gains.append((along * solved + limits.independent * solved**2).sum(axis=0))
        if wide < len(self.first):
            gains.append(_gains_of_wide_blocks(z, inside, self.first[wide:]))
        return np.concatenate(gains)

    def pair_gains(self, z: Floats, inside: Floats, gram: Floats) -> Floats:
        """Return the decrease of χ² (M, M) by each pair of terms if both are added to a model.

        `z` (P,), `inside` (k, P) and `gram` (P, P) are the products of all columns with the model's
        residual, with an orthonormal basis of its columns and with each other. Only entries above the
        diagonal are valid; −∞ if the first term lies in the model.
        """
        # Orthonormalise the part of each block outside the model.
        z, left = z.copy(), gram - inside.T @ inside
        alone = np.zeros(len(self.first))
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
        for _ in range(2):  # rows, then columns
            for (_, places, size), half in zip(self._groups, halves, strict=True):
                left[places] = (half @ left[places].reshape(-1, size, len(z))).reshape(-1, len(z))
            left = np.ascontiguousarray(left.T)
        # The gain of both is the gain of one, and of the other beyond it.
        both = np.full((len(self.first), len(self.first)), -np.inf)
        for members, places, size in self._groups:
            along = left[places, places.start :].reshape(-1, size, len(z) - places.start).transpose(1, 0, 2)
            own = z[places].reshape(-1, size).T[:, :, None]
            rest = z[places.start :] - (own * along).sum(axis=0)
            first = self.first[members.start :] - places.start
            both[members, members.start :] = _gains_of_wide_blocks(rest, along, first)
        return both + alone[:, None]

    def subset(self, chosen: NDArray[np.intp]) -> LinearProblem:
        """Return the problem restricted to the terms with the numbers `chosen`, in ascending order."""
        index = np.array(
            [column for k in chosen for column in range(self.first[k], self.first[k] + self.width[k])],
            dtype=np.intp,
        )
        width = self.width[chosen]
        return replace(
            self,
            terms=tuple(self.terms[k] for k in chosen),
            columns=np.ascontiguousarray(self.columns[:, index]),
            first=(np.cumsum(width) - width).astype(np.intp),
            width=width,
            back=tuple(self.back[k] for k in chosen),
            cost=self.cost[chosen],
            column_price=self.column_price[chosen],
            prior=tuple(self.prior[k] for k in chosen),
        )

    def with_inflation(self, inflation: float) -> LinearProblem:
        """Return the problem with the measured noise variance multiplied by `inflation`.

        This changes the weight of the prior relative to the readings.
        """
        if inflation == self.inflation:
            return self
        factor = inflation / self.inflation
        return self._with_prior([factor * own for own in self.prior], inflation)

    def with_covariance(self, features: Floats) -> LinearProblem:
        """Return the problem with the covariance F Fᵀ of features F (rows, k) added to the noise."""
        values, vectors = np.linalg.eigh(features @ features.T)
        white = (vectors / np.sqrt(1 + np.maximum(values, 0.0))) @ vectors.T
        # The prior of an amplitude does not change.
        moved = replace(self, columns=white @ self.columns, target=white @ self.target)
        return moved._with_prior(self.prior, self.inflation)

    def _with_prior(self, prior: Sequence[Floats], inflation: float) -> LinearProblem:
        """Return the problem with another Gaussian prior of the amplitudes of each of the M terms.

        `prior` holds for each term the precision matrix (d, d) of its d amplitudes, multiplied by the noise
        variance; this variance already contains the factor `inflation`.
        """
        columns = np.empty_like(self.columns)
        back: list[Floats] = []
        turned: list[Floats] = []
        for members, places, size in self._groups:
            stack = self.columns[:, places].reshape(len(columns), -1, size).transpose(1, 0, 2)
            # Orthonormalise each block again, together with its new prior rows.
            held = np.array(prior[members])
            gram = stack.transpose(0, 2, 1) @ stack + held
            turn = np.linalg.inv(np.linalg.cholesky(gram)).transpose(0, 2, 1)
            columns[:, places] = (stack @ turn).transpose(1, 0, 2).reshape(len(columns), -1)
            back.extend(own @ half for own, half in zip(self.back[members], turn, strict=True))
            turned.extend(turn.transpose(0, 2, 1) @ held @ turn)
        return replace(self, columns=columns, back=tuple(back), prior=tuple(turned), inflation=inflation)

    @cached_property
    def _groups(self) -> tuple[tuple[slice, slice, int], ...]:
        """Terms in groups of equal width: slice of their numbers, slice of their columns, width."""
        groups = []
        begin = 0
        for size, count in zip(*np.unique(self.width, return_counts=True), strict=True):
            start, end = int(self.first[begin]), begin + int(count)
            groups.append((slice(begin, end), slice(start, start + int(size * count)), int(size)))
            begin = end
        return tuple(groups)

    def gain(self, model: Sequence[int]) -> float:
        """Return the decrease of χ² by a model with its most probable amplitudes.

        The χ² of these amplitudes under their prior is subtracted.
        """
        if not len(model):
            return 0.0
        columns, gram = self.columns_and_gram(model)
        along = self.target @ columns @ _orthonormal_combinations(gram)
        return float(along @ along)

    def columns_and_gram(self, model: Sequence[int]) -> tuple[Floats, Floats]:
        """Return the columns (rows, p) of a model, and their Gram matrix (p, p) with the prior rows."""
        columns = np.concatenate([self.block(k) for k in model], axis=1)
        gram = columns.T @ columns
        start = 0
        # Each block is orthonormal together with its prior rows, so its own part is the identity.
        for k in model:
            own = slice(start, start + int(self.width[k]))
            gram[own, own] = np.eye(int(self.width[k]))
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
    solved = _solve_small_systems(least * np.eye(k)[:, :, None] - gram, along)
    both = square + (along * solved).sum(axis=0).reshape(square.shape)
    twice = both + least * (solved**2).sum(axis=0).reshape(square.shape)
    return np.asarray(both / least + limits.independent * twice / least**2)


def _solve_small_systems(gram: Floats, right: Floats) -> Floats:
    """Solve M small positive definite systems by elimination: (k, k, M) and (k, M) → (k, M).

    Each elimination step is vectorised over all systems; factorising each system alone would be slower.
    `gram` are the matrices, `right` the right-hand sides.
    """
    gram, solved = gram.copy(), right.copy()
    k = len(right)
    for i in range(k - 1):
        factor = gram[i + 1 :, i] / gram[i, i]
        gram[i + 1 :, i + 1 :] -= factor[:, None] * gram[i, i + 1 :]
        solved[i + 1 :] -= factor * solved[i]
    for i in reversed(range(k)):
        solved[i] = (solved[i] - (gram[i, i + 1 :] * solved[i + 1 :]).sum(axis=0)) / gram[i, i]
    return solved


class Products:
    """Cache of scalar products between the columns of models and those of terms that may extend them.

    With these products, an extension of a model can be scored without using the rows.
    """

    def __init__(self, problem: LinearProblem, joining: LinearProblem) -> None:
        self._problem, self._joining = problem, joining
        self._target = problem.target @ joining.columns
        self._of: dict[int, Floats] = {}

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
        inside = np.concatenate([self._of[k] for k in model])
        if len(model) > 1:  # a single block is already orthonormal
            columns, gram = problem.columns_and_gram(model)
            half = _orthonormal_combinations(gram)
            along, inside = problem.target @ columns @ half, half.T @ inside
        else:
            along = problem.target @ problem.block(model[0])
        return problem.chi2 - float(along @ along), self._target - along @ inside, inside

    def pairs(self, model: Sequence[int]) -> tuple[float, int, Floats]:
        """Return a model's χ², its number of columns, and the decrease of χ² (M, M) by pairs of terms."""
        chi2, z, inside = self.of_model(model)
        return chi2, len(inside), self._joining.pair_gains(z, inside, self._gram)

    @cached_property
    def _gram(self) -> Floats:
        columns = self._joining.columns
        return columns.T @ columns


def linearise(fit: Fit, terms: Sequence[Term]) -> LinearProblem:
    """Return the linear problem about the values of a fit, with these candidate terms.

    The model of the fit may already contain some of the terms.
    """
    # The target contains the contributions of the fit's own terms, which are candidates like all others.
    left = fit.declared_misfit
    for k in range(len(fit.terms)):
        left = left + fit.added(k)
    y = fit.white(left[:, :, None])[:, 0]

    base = orthonormal(fit.white(fit.base_columns))
    y = y - base @ (base.T @ y)

    raw, widths = fit.candidates(terms)
    columns, length = project_off_base(base, fit.white(raw), widths)
    spread = amplitude_spreads(fit.data.model, terms, widths)
    chosen, width, together, back, prior = _orthonormal_blocks(columns, length, spread, widths)
    first = (np.cumsum(width) - width).astype(np.intp)
    seen = set(chosen)
    prices = _column_prices(together, first)
    for k, own in enumerate(prior):
        term = terms[chosen[k]]
        if term.constant and term.cost <= 0:
            prices[k] = 0.0  # it is in every model
        elif term.prior_sd is not None:
            # A stated prior of the amplitudes: ½ ln |1 + Σ Xᵀ X|, with the columns X of the readings.
            prices[k] = 0.5 * np.linalg.slogdet(np.eye(len(own)) + np.linalg.inv(own))[1]
    free = LinearProblem(
        terms=tuple(terms[k] for k in chosen),
        columns=together,
        first=first,
        width=width,
        target=y,
        dof=len(y) - base.shape[1],
        back=back,
        hidden=tuple(term for k, term in enumerate(terms) if k not in seen),
        cost=np.array([terms[k].cost for k in chosen]),
        column_price=prices,
        prior=tuple(np.zeros((size, size)) for size in width.tolist()),
        joint=bool(fit.data.model.origins),
    )
    return free._with_prior(prior, 1.0)


def project_off_base(base: Floats, columns: Floats, widths: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return the part of each column outside the base model, scaled to length 1, and its original length.

    A column that the base model reproduces becomes zero and has 1 as its length. The lengths are (P,).

    Parameters
    ----------
    base : (rows, k) float
        Orthonormal basis of the base model's whitened columns.
    columns : (rows, P) float
        Whitened columns of all terms.
    widths : (M,) int
        Number of columns of each term.
    """
    before = np.linalg.norm(columns, axis=0)
    # A column of rounding errors (the sixth harmonic's sine on a grid of 30°) is set to zero.
    starts = np.cumsum(widths) - widths
    longest = np.repeat(np.maximum.reduceat(before, starts), widths) if len(before) else before
    before = np.where(before > ROUNDING * longest, before, 0.0)
    columns = columns * np.where(before > 0, 1 / np.where(before > 0, before, 1.0), 0.0)
    # Unit length before the projection, so that the length after it is the part outside the base model.
    columns = columns - base @ (base.T @ columns)
    after = np.linalg.norm(columns, axis=0)
    seen = after**2 > limits.independent
    columns = columns * np.where(seen, 1 / np.where(seen, after, 1.0), 0.0)
    return columns, np.where(seen, before * after, 1.0)


def _orthonormal_blocks(
    columns: Floats, length: Floats, spread: Floats, widths: NDArray[np.intp]
) -> tuple[list[int], NDArray[np.intp], Floats, tuple[Floats, ...], tuple[Floats, ...]]:
    """Orthonormalise the columns of each term; return the terms that the session shows, and their blocks.

    The result is: terms, widths (M,), blocks (rows, P), back maps and prior Gram matrices. Blocks of equal
    width are adjacent and computed at once. A back map converts the coefficients of a block
    to amplitudes. A prior Gram matrix (width, width) follows from the prior standard deviation `spread`
    (P,) of each column's amplitude. `length` (P,) is the length of each column before it was scaled.
    """
    starts = np.cumsum(widths) - widths
    found: dict[int, list[tuple[int, Floats, Floats, Floats]]] = {}
    for size in np.unique(widths).tolist():
        members = np.flatnonzero(widths == size)
        index = starts[members, None] + np.arange(size)
        stack = columns[:, index].transpose(1, 0, 2)
        # Cholesky for blocks of full rank; eigenvectors for the others, without the missing directions.
        gram = stack.transpose(0, 2, 1) @ stack
        root = np.linalg.cholesky(gram + 1e-10 * np.eye(size))
        whole = np.all(np.diagonal(root, axis1=1, axis2=2) ** 2 > _RANK, axis=1)
        halves = np.linalg.inv(root[whole]).transpose(0, 2, 1)
        own = (
            members[whole].tolist(),
            stack[whole] @ halves,
            *_back_maps(halves, index[whole], length, spread),
        )
        found.setdefault(size, []).extend(zip(*own, strict=True))
        for k in np.flatnonzero(~whole).tolist():
            values, vectors = np.linalg.eigh(gram[k])
            seen = values > _RANK
            if seen.any():
                half = vectors[:, seen] / np.sqrt(values[seen])
                rest = int(members[k]), stack[k] @ half, *_back_maps(half, index[k], length, spread)
                found.setdefault(half.shape[1], []).append(rest)
    blocks = [block for size in sorted(found) for block in sorted(found[size], key=lambda own: own[0])]
    return (
        [member for member, _, _, _ in blocks],
        np.array([block.shape[1] for _, block, _, _ in blocks], dtype=np.intp),
        np.concatenate([np.zeros((len(columns), 0)), *(block for _, block, _, _ in blocks)], axis=1),
        tuple(back for _, _, back, _ in blocks),
        tuple(prior for _, _, _, prior in blocks),
    )


def _back_maps(
    half: Floats, index: NDArray[np.intp], length: Floats, spread: Floats
) -> tuple[Floats, Floats]:
    """Return matrices that convert block coefficients to amplitudes, and Gram matrices of the prior.

    Parameters
    ----------
    half : (…, d, width) float
        Combinations of a term's d columns that form its block.
    index : (…, d) int
        Numbers of these columns.
    length, spread : (P,) float
        Length of each column before scaling, and prior standard deviation of its amplitude.
    """
    back = half / length[index][..., None]
    away = back / spread[index][..., None]
    return back, away.swapaxes(-1, -2) @ away


def _column_prices(columns: Floats, first: NDArray[np.intp]) -> Floats:
    """Return the price of each term's columns, ½ Σ ln(1 + s² n) in nats: the loss of log evidence.

    The sum is over the columns u of the term; s is the prior standard deviation in units of the noise; n =
    1/Σ u⁴ is the effective number of rows of a column. `first` are the numbers of the terms' first columns.
    """
    if not len(first):
        return np.zeros(0)
    price = 0.5 * np.log1p(limits.prior_snr**2 / np.maximum(((columns**2) ** 2).sum(axis=0), 1e-300))
    blocks: Floats = np.add.reduceat(price, first)
    return blocks


def orthonormal(columns: Floats) -> Floats:
    """Return an orthonormal basis (rows, k) of the span of columns (rows, p) of any lengths.

    Directions that consist of rounding errors are dropped.
    """
    u, s, _ = np.linalg.svd(
        columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False
    )
    return u[:, s > 1e-8 * s[0]]


def span(problem: LinearProblem, model: Sequence[int]) -> tuple[Floats, Floats]:
    """Return an orthonormal basis (rows, k) of a model's columns, and the target's residual (rows,).

    Amplitudes are free: the prior is not applied.
    """
    if not len(model):
        return np.zeros((len(problem.target), 0)), problem.target
    u, s, _ = np.linalg.svd(np.concatenate([problem.block(k) for k in model], axis=1), full_matrices=False)
    basis = u[:, s > np.sqrt(limits.independent)]
    return basis, problem.target - basis @ (basis.T @ problem.target)


def _orthonormal_combinations(gram: Floats) -> Floats:
    """Return a matrix (p, k) that turns p columns with this Gram matrix into k orthonormal columns."""
    values, vectors = np.linalg.eigh(gram)
    seen = values > limits.independent
    half: Floats = vectors[:, seen] / np.sqrt(values[seen])
    return half


def amplitudes(problem: LinearProblem, model: Sequence[int]) -> list[Floats]:
    """Return the most probable amplitudes of each term of a model, by least squares with the prior."""
    if not len(model):
        return []
    if len(model) == 1:
        return [problem.back[model[0]] @ (problem.target @ problem.block(model[0]))]
    columns, gram = problem.columns_and_gram(model)
    solved = np.linalg.lstsq(gram, columns.T @ problem.target, rcond=1e-12)[0]
    cuts = np.cumsum([0] + [int(problem.width[k]) for k in model])
    return [problem.back[k] @ solved[cuts[i] : cuts[i + 1]] for i, k in enumerate(model)]
