"""Links: known rotations of the sensor between two poses, as equations of a `Fit` in space.

A pose in space gives one equation, because its attitude u is unknown. A known rotation Φ from one pose to
the next gives two more: u' = exp(ε×) Φ u, with the attitude u' after the turn and a small rotation error ε
(`fitting.linked`). Let P(u) be two directions normal to u, and ũ the attitudes that fit the readings best
at some parameters. The rows of a link are

    y = P(ũ')ᵀ (ũ' − Φ ũ) = T' e' − F T e + K ε,    F = P(ũ')ᵀ Φ P(ũ),    K = −P(ũ')ᵀ [Φ ũ]×,

with the noise e and e' of the readings before and after the turn. The noise e moves ũ by T e with T = (tᵀ
C⁻¹ t)⁻¹ tᵀ C⁻¹, the covariance C of the reading and its tangent t (the derivative by the attitude). T e is
not correlated with the norm of the reading, so the rows of links are independent of the other rows of a
fit.

ε has two parts: the link's own error (noise, zero rate; neighbouring links share a dwell), and the effect
of the gyros' gains, directions and g-sensitivities on all links. The second part consists of modes of unit
variance, a prior that is estimated with the fit. The covariance of all link rows without the modes is
block-tridiagonal, because only neighbouring links share a dwell.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.model.measurement import across


@dataclass(frozen=True)
class Links:
    """Rotations that the gyros measured between readings, linearised at assumed gyro parameters.

    Attributes
    ----------
    before, after : (m,) int
        Rows of the readings (one for each dwell) before and after the turn, `after` increasing.
    rotation : (m, 3, 3) float
        Φ: converts components of a direction in the sensor before the turn to components after it.
    offset_rad : (m, 3) float
        Mean of the rotation error ε; not zero if Φ was computed at other gyro parameters than the centre of
        their prior.
    own_rad2 : (m, 3, 3) float
        Covariance of the part of ε that is the link's own error (noise, zero rate).
    next_rad2 : (m, 3, 3) float
        Covariance of the link's own error with the own error of the next link, if the next link begins in
        the dwell in which this link ends.
    modes_rad : (m, 3, q) float
        Contribution to ε of each of q independent modes of unit variance, which act on all links.
    """

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    rotation: Floats
    offset_rad: Floats
    own_rad2: Floats
    next_rad2: Floats
    modes_rad: Floats

    def __len__(self) -> int:
        return len(self.before)

    @cached_property
    def joined(self) -> NDArray[np.bool_]:
        """Mask (m − 1,) of the links that end in the dwell in which the next link begins."""
        return np.asarray(self.after[:-1] == self.before[1:])

    def only(self, links: NDArray[np.bool_] | NDArray[np.intp]) -> Links:
        """Return a copy with the selected links, in their order."""
        return Links(*(getattr(self, one.name)[links] for one in fields(self)))

    def rows(self, kept: NDArray[np.intp]) -> Links | None:
        """Return the links between two kept readings, with new numbers of the readings; None without any.

        `kept` are the rows of the kept readings. `before` and `after` of the result are positions in
        `kept`.
        """
        # New number of each kept reading, −1 for the others.
        place = np.full(
            max(int(self.after.max(initial=0)), int(kept.max(initial=0))) + 1, -1, dtype=np.intp
        )
        place[kept] = np.arange(len(kept))
        before, after = place[self.before], place[self.after]
        whole = (before >= 0) & (after >= 0)
        if not whole.any():
            return None
        return replace(self.only(whole), before=before[whole], after=after[whole])

    def moved(self, by_rad: Floats) -> Links:
        """Return a copy with `by_rad` (m, 3) added to the mean of ε, the rotation error of each link."""
        return replace(self, offset_rad=self.offset_rad + by_rad)

    def drawn(self, rng: np.random.Generator) -> Links:
        """Return a copy with random rotation errors ε added to their mean, for simulations."""
        own = np.linalg.cholesky(self.own_covariance) @ rng.standard_normal(3 * len(self))
        shared = self.modes_rad @ rng.standard_normal(self.modes_rad.shape[2])
        return self.moved(own.reshape(-1, 3) + shared)

    @cached_property
    def own_covariance(self) -> Floats:
        """Covariance (3 m, 3 m) in rad² of all rotation errors, without errors that all links share."""
        return _block_tridiagonal(self.own_rad2, self.next_rad2[:-1] * self.joined[:, None, None])


@dataclass(frozen=True)
class LinkRows:
    """Equations that links (known rotations between readings) add to a fit, two for each link.

    They are linearised at given attitudes. The symbols T, y, F and K are explained at the top of the
    module.

    Attributes
    ----------
    links : Links
        The links.
    estimator : (n, 2, axes) float
        T of each reading: change of the fitted attitude by an error of the reading, rad per mg.
    misclosure : (m, 2) float
        y of each link: direction of gravity after the turn, minus the direction before it after the
        rotation of the link, in rad. The effect of the mean rotation error is subtracted.
    carried : (m, 2, 2) float
        F: derivative of the attitude after a link by the attitude before it.
    turned : (m, 2, 3) float
        K: derivative of y by the rotation error ε.
    whitener : (2 m, 2 m) float
        Inverse Cholesky factor of the covariance of the equations, without errors that all links share.
    """

    links: Links
    estimator: Floats
    misclosure: Floats
    carried: Floats
    turned: Floats
    whitener: Floats

    @classmethod
    def at(cls, links: Links, attitude: Floats, tangent: Floats, root: Floats) -> LinkRows:
        """Make the equations of links, linearised at the attitudes (n, 3) of the dwells.

        Parameters
        ----------
        tangent : (n, axes, 2) float
            Derivative of the reading by the attitude along the two directions `across(attitude)`.
        root : (n, axes, axes) float
            Inverse Cholesky factor of the covariance of the readings.
        """
        before, after = links.before, links.after
        whitened = root @ tangent
        gram = whitened.transpose(0, 2, 1) @ whitened
        trace = np.trace(gram, axis1=1, axis2=2)[:, None, None]
        # Covariance of the fitted attitude; a small ridge keeps a pose with one tangent invertible.
        spread = np.linalg.inv(gram + (1e-12 * trace + 1e-300) * np.eye(2))
        estimator = spread @ whitened.transpose(0, 2, 1) @ root
        directions = across(attitude)
        there = directions[after].transpose(0, 2, 1)
        # Attitude after the turn, carried from before by the gyros.
        came = (links.rotation @ attitude[before][:, :, None])[:, :, 0]
        carried = there @ links.rotation @ directions[before]
        # Matrices of the cross product x ↦ came × x.
        turned = -there @ np.cross(np.eye(3), came[:, None, :])
        misclosure = (there @ (attitude[after] - came)[:, :, None])[:, :, 0]
        # Subtract the expected error of the rotation.
        misclosure = misclosure - (turned @ links.offset_rad[:, :, None])[:, :, 0]
        # Diagonal blocks: noise of both readings and the own error of the link.
        own = spread[after] + carried @ spread[before] @ carried.transpose(0, 2, 1)
        own = own + turned @ links.own_rad2 @ turned.transpose(0, 2, 1)
        # Blocks between neighbouring links: the shared dwell and the shared error of the gyros.
        shared = turned[:-1] @ links.next_rad2[:-1] @ turned[1:].transpose(0, 2, 1)
        shared = shared - spread[after[:-1]] @ carried[1:].transpose(0, 2, 1)
        covariance = _block_tridiagonal(own, shared * links.joined[:, None, None])
        whitener = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        return cls(links, estimator, misclosure, carried, turned, whitener)

    def white(self, columns: Floats) -> Floats:
        """Return the effect (2 m, d) of d changes of the readings on the equations, two for each link.

        `columns` (n, axes, d) are the changes. The result is scaled so that the errors of the equations
        have unit covariance, without errors that all links share.
        """
        moved = self.estimator @ columns
        rows = moved[self.links.after] - self.carried @ moved[self.links.before]
        return np.asarray(self.whitener @ rows.reshape(-1, columns.shape[2]))

    @property
    def residual(self) -> Floats:
        """Misclosure (2 m,) of the links, scaled to unit covariance.

        The misclosure of a link is the direction of gravity after it, minus the direction before it after
        the rotation of the link.
        """
        return np.asarray(self.whitener @ self.misclosure.ravel())

    @property
    def modes(self) -> Floats:
        """Effect (2 m, q) on the scaled equations of q independent errors that all links share.

        Each error has its standard deviation as size.
        """
        rows = self.turned @ self.links.modes_rad
        return np.asarray(self.whitener @ rows.reshape(-1, rows.shape[2]))

    def by_reading(self, slope: Floats) -> Floats:
        """Return the derivative (d, n, axes) of d weighted sums of the scaled equations by each reading.

        The weights are the columns of `slope` (2 m, d).
        """
        rows = (self.whitener.T @ slope).reshape(len(self.links), 2, -1)
        moved = np.zeros((len(self.estimator), 2, slope.shape[1]))
        np.add.at(moved, self.links.after, rows)
        np.add.at(moved, self.links.before, -self.carried.transpose(0, 2, 1) @ rows)
        return np.asarray(np.einsum("nkd,nka->dna", moved, self.estimator))

    def by_rotation(self, slope: Floats) -> Floats:
        """Return the derivative (m, 3, d) of d weighted sums of the scaled equations by rotation errors.

        There are m rotation errors ε, one for each link. The weights are the columns of `slope` (2 m, d).
        """
        rows = (self.whitener.T @ slope).reshape(len(self.links), 2, -1)
        return np.asarray(self.turned.transpose(0, 2, 1) @ rows)


def _block_tridiagonal(own: Floats, shared: Floats) -> Floats:
    """Return a covariance (m d, m d) with the blocks `own` (m, d, d) on its diagonal.

    `shared` (m − 1, d, d) are the blocks to the right of the diagonal.
    """
    m, d = own.shape[:2]
    k = np.arange(m)
    whole = np.zeros((m, d, m, d))
    whole[k, :, k] = own
    whole[k[:-1], :, k[1:]] = shared
    whole[k[1:], :, k[:-1]] = shared.transpose(0, 2, 1)
    return whole.reshape(m * d, m * d)
