"""What a session can tell apart: whitened readings seen past the base model.

The base model's six columns (start angle, two gains, Δφ, two zeros) are projected out of everything after
whitening with the reading noise and the fixture's share along the tangent. The *noncentrality* of an effect
is the sum of squares of what is left of it: the excess of χ² that it causes.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tracing.named_truth import Term, alternatives
from tracing.plans import G_MG, Bench, Floats, Rows

TELLABLE = 16.0
"""Noncentrality of a difference below which two explanations are equivalent in a session: the better of the
two by likelihood is then wrong in Φ(−√16/2) = 2.3 % of sessions even for a judge who knows both forms."""


class Lens:
    """Readings (of the dwells in `use`, else of those that may be fitted), past the base model."""

    def __init__(self, bench: Bench, use: NDArray[np.bool_] | None = None) -> None:
        self.bench = bench
        fit = ~bench.check if use is None else use
        dwells = bench.dwells
        self.rows = Rows(
            *(getattr(dwells, f)[fit] for f in list(Rows.__dataclass_fields__)[:-2]),
            history=dwells.history,
            loads=dwells.loads,
        )
        psi = bench.alpha - self.rows.angle_rad
        self.ideal = bench.ideal_mg(psi)
        self.slope = bench.slope_mg(psi)
        cover = np.deg2rad(bench.fixture_deg) ** 2 * np.einsum("ni,nj->nij", self.slope, self.slope)
        self.white = np.linalg.inv(np.linalg.cholesky(cover + np.diag(bench.u_mg**2)))
        turn = np.zeros_like(self.ideal)
        turn[:, 1] = G_MG * bench.gains[1] * np.cos(psi + bench.dphi)
        gains, zeros = (values * np.eye(2)[:, None, :] for values in (self.ideal, np.ones_like(turn)))
        self.base_mg = np.stack([self.slope, *gains, turn, *zeros])
        self.base = np.linalg.qr(self.whiten(self.base_mg).T)[0]

    def whiten(self, columns_mg: Floats) -> Floats:
        """From (k, n, 2) in mg to (k, 2n) in standard uncertainties."""
        return np.einsum("nij,knj->kni", self.white, columns_mg).reshape(len(columns_mg), -1)

    def past_base(self, columns: Floats) -> Floats:
        """Whitened columns (k, 2n) without what the base model explains."""
        return columns - (columns @ self.base) @ self.base.T

    def plain(self, term: Term) -> Floats:
        """Columns (k, n, 2) of a term in mg."""
        basis = term.basis(self.rows, self.ideal)
        return np.deg2rad(basis)[:, :, None] * self.slope if term.attitude else basis

    def columns(self, term: Term) -> Floats:
        """Whitened columns (k, 2n) of a term past the base model."""
        return self.past_base(self.whiten(self.plain(term)))

    def contribution(self, term: Term) -> Floats:
        """Whitened contribution (2n,) of a term past the base model."""
        return term.coefficients @ self.columns(term)

    def peak(self, term: Term) -> float:
        """Largest contribution to a dwell past the base model, in standard uncertainties of a reading."""
        return float(np.abs(self.contribution(term)).max())

    def unexplained(self, target: Floats, columns: Iterable[Floats]) -> float:
        """Noncentrality of `target` (2n,) that the columns leave."""
        return float(np.sum(remainder(target, list(columns)) ** 2))

    def unexplained_by_names(
        self, target: Floats, names: Iterable[str], beside: Iterable[Floats] = ()
    ) -> float:
        """The same for catalogue names, each with the time constant, dwell or degree that suits best.

        Choices are made one name after the other, those without any first.
        """
        taken = list(beside)
        options = sorted((alternatives(name, self.rows) for name in names), key=len)
        for terms in options:
            tried = [self.columns(term) for term in terms]
            left = [np.sum(remainder(target, [*taken, columns]) ** 2) for columns in tried]
            taken.append(tried[int(np.argmin(left))])
        return float(np.sum(remainder(target, taken) ** 2))


def remainder(target: Floats, columns: list[Floats]) -> Floats:
    if not columns:
        return target
    matrix = np.concatenate(columns)
    norms = np.linalg.norm(matrix, axis=1)
    matrix = matrix[norms > 1e-9] / norms[norms > 1e-9, None]
    if not len(matrix):
        return target
    u, s, _ = np.linalg.svd(matrix.T, full_matrices=False)
    kept = u[:, s > 1e-5 * s[0]]
    return target - kept @ (kept.T @ target)
