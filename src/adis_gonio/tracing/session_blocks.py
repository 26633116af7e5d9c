"""Columns of terms, orthonormal by term, arranged session by session.

Terms with amplitudes common to all sessions have all rows as one session. The columns of a term with
amplitudes of its own in each session are zero in the rows of all other sessions, so products of columns are
sums over sessions of small products. Parameters of the base model that belong to one session (the start
angle) are projected out of the columns of this session. The other base parameters are the columns
`SessionBlocks.base`; they count as part of every model.

A model has columns D of single sessions and shared columns F (the base included). D is made orthonormal in
each session, and F after its projection off D. An added term then changes χ² by zᵀ (Δ − LᵀL)⁻¹ z, with the
products z of its columns with the residual, L with the orthonormal F, and a matrix Δ that is block diagonal
by session (Woodbury's identity).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.terms import ROUNDING
from adis_gonio.tracing.thresholds import limits

_RANK = 1e-7
"""Least squared length of a column outside the other columns of its term; a shorter column is dropped."""


@dataclass(frozen=True)
class ModelBasis:
    """Orthonormal columns of a model over S sessions of at most n rows.

    Attributes
    ----------
    own : (S, n, d) float
        Columns of single sessions: column j of session s is zero in the other sessions.
    shared : (S, n, f) float
        Columns over all sessions; they include the shared columns of the base model.
    rank : int
        Number of columns of the model, without the base model.
    """

    own: Floats
    shared: Floats
    rank: int

    def off(self, values: Floats) -> Floats:
        """Return the part of values (S, n) outside the model."""
        own = (self.own @ (self.own.swapaxes(1, 2) @ values[..., None]))[..., 0]
        shared = self.shared @ np.einsum("snf,sn->f", self.shared, values)
        return np.asarray(values - own - shared)


@dataclass(frozen=True)
class SessionBlocks:
    """Columns of M terms in each of S sessions, which have at most n rows.

    Attributes
    ----------
    rows : int
        Number of rows of all sessions.
    place : (S, n) int
        Number of each row of a session; `rows` where a session has fewer than n.
    base : (S, n, b) float
        Orthonormal columns of the base parameters that several sessions share; none for a single session.
    columns : (S, n, P) float
        Columns of all terms in order. The columns Q of one term in one session have QᵀQ + prior = 1.
    width : (M,) int
        Number of columns of each term in one session; terms of equal width are adjacent.
    seen : (S, P) bool
        True for the columns that the session shows; the others are zero.
    back, prior : tuple of (S, width, width) float
        For each session and term, the map of coefficients to amplitudes and the Gram matrix of the prior.
    """

    rows: int
    place: NDArray[np.intp]
    base: Floats
    columns: Floats
    width: NDArray[np.intp]
    seen: NDArray[np.bool_]
    back: tuple[Floats, ...]
    prior: tuple[Floats, ...]

    @classmethod
    def of(
        cls,
        rows: int,
        place: NDArray[np.intp],
        base: tuple[Floats, Floats],
        columns: Floats,
        spread: Floats,
        width: NDArray[np.intp],
    ) -> SessionBlocks:
        """Make the blocks from whitened columns (S, n, P) of terms in ascending order of width.

        The columns are orthonormal without the prior; `with_prior` makes them so together with it.

        `base` are the orthonormal base columns of single sessions and of several sessions, (S, n, k) and
        (S, n, b); `spread` (P,) are the prior standard deviations of the amplitudes.
        """
        own, shared = base
        columns, length = project_off_base(own, columns, width)
        seen = np.zeros(length.shape, dtype=bool)
        back: list[Floats] = []
        prior: list[Floats] = []
        for _, places, size in runs(width):
            stack = _by_term(columns[..., places], size)
            # Make the columns of each term orthonormal, by a triangular matrix if they are independent.
            gram = stack.swapaxes(-1, -2) @ stack
            root = np.linalg.cholesky(gram + 1e-10 * np.eye(size))
            whole = np.all(np.diagonal(root, axis1=-2, axis2=-1) ** 2 > _RANK, axis=-1)
            half = np.empty_like(gram)
            half[whole] = np.linalg.inv(root[whole]).swapaxes(-1, -2)
            half[~whole] = orthonormal_combinations(gram[~whole], _RANK)
            columns[..., places] = _by_row(stack @ half)
            seen[:, places] = _by_row(half).any(axis=1)
            half = half / _by_term(length[:, None, places], size).swapaxes(-1, -2)
            away = half / spread[places].reshape(-1, 1, size, 1)
            back.extend(half)
            prior.extend(away.swapaxes(-1, -2) @ away)
        return cls(rows, place, shared, columns, width, seen, tuple(back), tuple(prior))

    def by_row(self, values: Floats) -> Floats:
        """Arrange values (S, n, …) of all sessions as rows (rows, …)."""
        out = np.zeros((self.rows + 1, *values.shape[2:]))
        out[self.place] = values
        return out[:-1]

    @cached_property
    def first(self) -> NDArray[np.intp]:
        """First column (M,) of each term."""
        return (np.cumsum(self.width) - self.width).astype(np.intp)

    def places(self, term: int) -> slice:
        """Return the slice of the columns of one term."""
        return slice(self.first[term], self.first[term] + self.width[term])

    @cached_property
    def total(self) -> NDArray[np.intp]:
        """Number of columns (M,) of each term that the sessions show, added up over the sessions."""
        shown = self.seen.sum(axis=0)
        return np.add.reduceat(shown, self.first) if len(self.first) else shown

    def of_term(self, term: int) -> Floats:
        """Return the columns (rows, S · width) of one term, without the columns that no session shows."""
        own, seen = self.columns[..., self.places(term)], self.seen[:, self.places(term)].ravel()
        sessions, _, width = own.shape
        if sessions == 1:
            return np.asarray(own[0] if seen.all() else own[0][:, seen])
        out = np.zeros((self.rows + 1, sessions, width))
        out[self.place, np.arange(sessions)[:, None]] = own
        flat = out[:-1].reshape(self.rows, -1)[:, seen]
        base = self.by_row(self.base)
        return np.asarray(flat - base @ (base.T @ flat))

    def joined(self, blocks: Floats, term: int) -> Floats:
        """Arrange matrices (S, d, width) of one term on the diagonal of a matrix (S · d, columns)."""
        sessions, d, width = blocks.shape
        out = np.zeros((sessions, d, sessions, width))
        each = np.arange(sessions)
        out[each, :, each] = blocks
        return out.reshape(sessions * d, -1)[:, self.seen[:, self.places(term)].ravel()]

    def prior_of(self, term: int) -> Floats:
        """Return the Gram matrix of the prior of all columns of one term."""
        return self.joined(self.prior[term], term)[self.seen[:, self.places(term)].ravel()]

    def subset(self, chosen: NDArray[np.intp]) -> SessionBlocks:
        """Return the blocks of the chosen terms, in ascending order."""
        index = columns_of(self.first, self.width, chosen)
        return replace(
            self,
            columns=np.ascontiguousarray(self.columns[..., index]),
            seen=self.seen[:, index],
            width=self.width[chosen],
            back=tuple(self.back[k] for k in chosen),
            prior=tuple(self.prior[k] for k in chosen),
        )

    def with_prior(self, factor: float = 1.0) -> SessionBlocks:
        """Return the blocks orthonormal together with their prior, which is multiplied by a factor."""
        columns = self.columns.copy()
        back: list[Floats] = []
        prior: list[Floats] = []
        for members, places, size in runs(self.width):
            stack, held = _by_term(columns[..., places], size), factor * np.array(self.prior[members])
            # Columns of zeros stay as they are.
            hidden = ~self.seen[:, places].reshape(len(columns), -1, 1, size).swapaxes(0, 1)
            gram = stack.swapaxes(-1, -2) @ stack + held + hidden * np.eye(size)
            turn = np.linalg.inv(np.linalg.cholesky(gram)).swapaxes(-1, -2)
            columns[..., places] = _by_row(stack @ turn)
            back.extend(own @ half for own, half in zip(self.back[members], turn, strict=True))
            prior.extend(turn.swapaxes(-1, -2) @ held @ turn)
        return replace(self, columns=columns, back=tuple(back), prior=tuple(prior))

    def basis(
        self, own: Sequence[int], shared: Floats, together: Floats, *, with_prior: bool = True
    ) -> ModelBasis:
        """Return orthonormal columns of a model: of the terms `own` in each session, and of `shared`.

        Parameters
        ----------
        shared : (S, n, k) float
            Columns of the model over all sessions, projected off the base model.
        together : (k, k) float
            Their Gram matrix together with their prior.
        with_prior : bool
            True: the columns are orthonormal together with the priors. False: amplitudes are free.
        """
        each = [self.columns[..., self.places(k)] for k in own]
        columns = np.concatenate([self.columns[..., :0], *each], axis=2)
        gram = columns.swapaxes(1, 2) @ columns
        if with_prior:
            start = 0
            for k in own:
                end = start + int(self.width[k])
                gram[:, start:end, start:end] += self.prior[k]
                start = end
        half = orthonormal_combinations(gram)
        columns = columns @ half
        # Project the shared columns off the columns of single sessions.
        every = np.concatenate([self.base, shared], axis=2)
        across = columns.swapaxes(1, 2) @ every
        held = self.base.shape[2]
        gram = np.tensordot(every, every, axes=((0, 1), (0, 1)))
        if with_prior:
            gram[held:, held:] = together
        gram -= np.tensordot(across, across, axes=((0, 1), (0, 1)))
        # A common bias is nearly a combination of the sessions' own biases: only the prior separates them.
        turn = orthonormal_combinations(gram, _RANK)
        turn = turn[:, turn.any(axis=0)]
        rank = int(half.any(axis=1).sum()) + turn.shape[1] - held
        return ModelBasis(columns, (every - columns @ across) @ turn, rank)

    def gains(self, basis: ModelBasis, residual: Floats) -> Floats:
        """Return the decrease of χ² (M,) by each term if it alone is added to a model.

        `basis` are the columns of the model, `residual` (S, n) is its residual. A small ridge replaces a
        decision on the rank, as in `LinearProblem.gains_from_products`.
        """
        ridge, sessions = limits.independent, len(self.columns)
        inside = basis.own.swapaxes(1, 2) @ self.columns
        # Products with the residual first, then with the shared columns.
        right = np.concatenate([residual[:, None], basis.shared.swapaxes(1, 2)], axis=1) @ self.columns
        found = [np.zeros(0)]
        for members, places, size in runs(self.width):
            count = members.stop - members.start
            along = inside[..., places].reshape(sessions, -1, count, size)
            delta = (1 + ridge) * np.eye(size)[:, :, None, None]
            delta = delta - np.einsum("sdmv,sdmw->vwsm", along, along)
            given = right[..., places].reshape(sessions, -1, count, size).transpose(3, 1, 0, 2)
            solved = solve_small_systems(
                delta.reshape(size, size, -1), given.reshape(size, -1, sessions * count)
            ).reshape(given.shape)
            left, turned = (
                one.transpose(3, 1, 0, 2).reshape(count, -1, size * sessions) for one in (given, solved)
            )
            products = left @ turned.swapaxes(1, 2)
            direct, shared = products[:, 0, 0], products[:, 1:, 0]
            rest = np.linalg.solve(np.eye(shared.shape[1]) - products[:, 1:, 1:], shared[..., None])
            coefficients = turned[:, 0] + (rest.swapaxes(1, 2) @ turned[:, 1:])[:, 0]
            gain = direct + (shared * rest[..., 0]).sum(axis=1)
            found.append(gain + ridge * (coefficients**2).sum(axis=1))
        return np.concatenate(found)


def by_session(rows: Floats, place: NDArray[np.intp]) -> Floats:
    """Arrange rows (rows, …) by session: (S, n, …), with zeros where a session has fewer rows.

    `place` (S, n) has the row numbers, as in `SessionBlocks`.
    """
    return np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])[place]


def session_bases(columns: Floats) -> tuple[Floats, Floats]:
    """Return orthonormal columns of the base parameters of single and of several sessions.

    `columns` (S, n, p) are the whitened columns of all base parameters. The results are (S, n, k), of each
    session by itself, and (S, n, b), over all sessions and outside the first.
    """
    lengths = np.sqrt((columns**2).sum(axis=1))
    total = np.sqrt((lengths**2).sum(axis=0))
    columns = columns / np.where(total > 0, total, 1.0)
    single = (lengths > 0).sum(axis=0) == 1
    # The columns of each session by itself come first, as many as any session has.
    alone = (lengths > 0) & single
    width = int(alone.sum(axis=1).max(initial=0))
    order = np.argsort(~alone, axis=1, kind="stable")[:, None, :width]
    own = _directions(np.take_along_axis(columns * alone[:, None], order, axis=2))
    shared = columns[..., ~single & (total > 0)]
    shared = shared - own @ (own.swapaxes(1, 2) @ shared)
    sessions, n, count = shared.shape
    rows = _directions(shared.reshape(sessions * n, count))
    rows = rows[:, rows.any(axis=0)]
    return own, rows.reshape(sessions, n, rows.shape[1])


def _directions(columns: Floats) -> Floats:
    """Return orthonormal columns (…, rows, k) of the span of columns of length 1 (…, rows, p).

    Columns are zero for directions that consist of rounding errors.
    """
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(u * (s > 1e-8)[..., None, :])


def _by_term(columns: Floats, size: int) -> Floats:
    """Arrange columns (S, n, M · size) by term: (M, S, n, size)."""
    return columns.reshape(*columns.shape[:2], -1, size).transpose(2, 0, 1, 3)


def _by_row(stack: Floats) -> Floats:
    """Arrange columns (M, S, n, size) of terms by row: (S, n, M · size)."""
    return stack.transpose(1, 2, 0, 3).reshape(*stack.shape[1:3], -1)


def columns_of(
    first: NDArray[np.intp], width: NDArray[np.intp], chosen: Sequence[int] | NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return the numbers of the columns of chosen terms, from the first column and width of every term."""
    chosen = np.asarray(chosen, dtype=np.intp)
    own = width[chosen]
    ends = np.cumsum(own)
    return np.asarray(np.repeat(first[chosen] - ends + own, own) + np.arange(own.sum()))


def runs(width: NDArray[np.intp]) -> list[tuple[slice, slice, int]]:
    """Group adjacent terms of equal width: slice of their numbers, slice of their columns, width."""
    found = []
    begin = start = 0
    for size, members in itertools.groupby(width.tolist()):
        end = begin + len(list(members))
        stop = start + size * (end - begin)
        found.append((slice(begin, end), slice(start, stop), size))
        begin, start = end, stop
    return found


def project_off_base(base: Floats, columns: Floats, widths: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return the part of each column outside the base model, scaled to length 1, and its original length.

    A column that the base model reproduces becomes zero and has 1 as its length. The lengths are (…, P).

    Parameters
    ----------
    base : (…, rows, k) float
        Orthonormal basis of the base model's whitened columns; of each session, or of all rows.
    columns : (…, rows, P) float
        Whitened columns of all terms.
    widths : (M,) int
        Number of columns of each term.
    """
    before = np.linalg.norm(columns, axis=-2)
    # A column of rounding errors (the sixth harmonic's sine on a grid of 30°) is set to zero.
    starts = np.cumsum(widths) - widths
    longest = np.maximum.reduceat(before, starts, axis=-1) if len(widths) else before
    before = np.where(before > ROUNDING * np.repeat(longest, widths, axis=-1), before, 0.0)
    columns = columns * np.where(before > 0, 1 / np.where(before > 0, before, 1.0), 0.0)[..., None, :]
    # Unit length before the projection, so that the length after it is the part outside the base model.
    columns = columns - base @ (base.swapaxes(-1, -2) @ columns)
    after = np.linalg.norm(columns, axis=-2)
    seen = after**2 > limits.independent
    columns = columns * np.where(seen, 1 / np.where(seen, after, 1.0), 0.0)[..., None, :]
    return columns, np.where(seen, before * after, 1.0)


def orthonormal(columns: Floats) -> Floats:
    """Return an orthonormal basis (rows, k) of the span of columns (rows, p) of any lengths.

    Directions that consist of rounding errors are dropped.
    """
    u, s, _ = np.linalg.svd(
        columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False
    )
    return u[:, s > 1e-8 * s[0]]


def orthonormal_combinations(gram: Floats, least: float = limits.independent) -> Floats:
    """Return matrices (…, p, p) that turn p columns with these Gram matrices into orthonormal columns.

    Columns of the result are zero for combinations with a squared length of at most `least`.
    """
    values, vectors = np.linalg.eigh(gram)
    seen = values > least
    scale: Floats = np.where(seen, 1 / np.sqrt(np.where(seen, values, 1.0)), 0.0)
    return np.asarray(scale[..., None, :] * vectors)


def solve_small_systems(gram: Floats, right: Floats) -> Floats:
    """Solve M small positive definite systems by elimination: (k, k, M) and (k, …, M) → (k, …, M).

    Each elimination step is vectorised over all systems; factorising each system alone would be slower.
    `gram` are the matrices, `right` one or several right-hand sides of each.
    """
    gram, solved = gram.copy(), right.copy()
    k = len(right)
    wide = (slice(None), *(None,) * (right.ndim - 2))
    for i in range(k - 1):
        factor = gram[i + 1 :, i] / gram[i, i]
        gram[i + 1 :, i + 1 :] -= factor[:, None] * gram[i, i + 1 :]
        solved[i + 1 :] -= factor[wide] * solved[i]
    for i in reversed(range(k)):
        solved[i] = (solved[i] - (gram[i, i + 1 :][wide] * solved[i + 1 :]).sum(axis=0)) / gram[i, i]
    return solved
