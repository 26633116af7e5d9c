"""`Fit`: a model with parameter values and readings, and every quantity derived from them.

Base parameters and terms are fitted together. The attitudes of the dwells are nuisance parameters: in the
plane the deviation δ ~ N(0, σ_f²) from the declared angle, in space any unit vector. They are eliminated in
each dwell by its whitening matrix (I − β û ûᵀ) L⁻¹. Here C = L Lᵀ is the covariance of the reading, t is
its tangent (the derivative by the attitude), û is the unit vector along L⁻¹ t, and β = 1 − (1 + σ_f² |L⁻¹
t|²)^(−1/2). The matrix is the inverse root of C + σ_f² t tᵀ. For σ_f → ∞ it becomes the projection that
removes the direction t. σ_f = 0 is least squares with declared angles, and σ_f = ∞ is the fit of an
ellipse; neither limit needs special code.

Dwells may share noise, such as 1/f noise, with the covariance Φ Φᵀ over all readings. With all whitening
matrices in one matrix W, the whitened rows then have the covariance 1 + A Aᵀ with A = W Φ. They are
multiplied by its symmetric inverse root 1 − A g(Aᵀ A) Aᵀ, g(λ) = 1/(r (r + 1)) with r = √(1 + λ). This root
changes the rows less than any other root, so that a row still belongs to its dwell.

Known rotations between poses in space (links, `estimation.links`) add two rows each, and add columns to Φ
for the errors that all links share.

Without links the cost is linear in the number of dwells.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.fitting.estimation.links import LinkRows
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm, Term, Where, join_columns
from adis_gonio.model.measurement import Measurement
from adis_gonio.model.records import MG_PER_G

NAMELESS_SPREAD = 0.1
"""Prior standard deviation of an amplitude of an unnamed term, as a share of `Measurement.full` (100 mg;
100 mrad for an angle). Without it a difference of covariates that are collinear, such as time and the
previous position, would cancel against a gain of twenty."""
_RUN_AWAY = 1e100
"""Largest derivative of whitened readings that a fit accepts; above this it would overflow when squared."""
_LEAST_GAIN = 1e-6
"""Decrease of χ² in an iteration below which a refit has converged."""


@dataclass(frozen=True)
class Values:
    """Values of all parameters of a model, and the attitudes of the dwells.

    Attributes
    ----------
    base : (p,) float
        Base parameters in the order of `Measurement.parameters`, natural units.
    attitude : (n, …) float
        Attitude of each dwell, in the form that the measurement uses: in the plane the deviation from the
        declared angle, in space a unit vector.
    terms : tuple of (q,) float
        Values of each term.
    """

    base: Floats
    attitude: Floats
    terms: tuple[Floats, ...] = ()

    @property
    def parameters(self) -> Floats:
        """One array of all parameters: the base parameters, then the values of all terms."""
        return np.concatenate([self.base, *self.terms])


@dataclass(frozen=True)
class Fit:
    """A model (base model and terms) with parameter values, applied to the readings of a session.

    Attributes
    ----------
    data : Readings
        Readings of the session.
    terms : tuple of Term
        Terms that are added to the base model.
    values : Values
        Values of all parameters, and attitudes of the dwells.
    with_prior : bool
        True if a prior keeps base parameters and unnamed amplitudes near values that sensors have. With few
        positions some directions are undetermined, and a fit without a prior would run to gains of twenty.
    """

    data: Readings
    terms: tuple[Term, ...]
    values: Values
    with_prior: bool = True

    # -- making ------------------------------------------------------------------------------------

    @classmethod
    def begin(cls, data: Readings, *, with_prior: bool = True) -> Fit:
        """Return the base model at starting values, not yet fitted to the readings.

        `with_prior` adds the prior that keeps parameters near values that sensors have.
        """
        base, attitude = data.model.begin(data.mean, data.angle_rad, data.conditions)
        return cls(data, (), Values(base, attitude), with_prior)

    def with_terms(self, terms: Sequence[Term], values: Sequence[Floats]) -> Fit:
        """Return a copy with these terms, each at the given values (q,); nothing is fitted."""
        return replace(self, terms=tuple(terms), values=replace(self.values, terms=tuple(values)))

    def value_of(self, term: Term) -> Floats:
        """Return the fitted values (q,) of one of the terms."""
        return self.values.terms[self.terms.index(term)]

    def slice_of(self, index: int) -> slice:
        """Return the slice of the parameter array with the values of the term with this index."""
        start = len(self.values.base) + sum(len(own) for own in self.values.terms[:index])
        return slice(start, start + len(self.values.terms[index]))

    # -- prediction --------------------------------------------------------------------------------

    @cached_property
    def turn_rad(self) -> Floats:
        """Angle (n,) in rad by which the stage has turned the sensor, including fitted errors of the stage.

        The sign is opposite to the declared angle.
        """
        turn = self.data.turn_rad
        for term, own in zip(self.terms, self.values.terms, strict=True):
            if term.enters_angle:
                turn = turn + term.added(own, self.data.mean, self.data.conditions)
        return turn

    @cached_property
    def ideal(self) -> Floats:
        """Readings (n, axes) by the base model at the fitted attitudes, without biases and other terms.

        They include the scale factors and misalignments.
        """
        return self.data.model.ideal(self.values.base, self.values.attitude, self.turn_rad)

    @cached_property
    def tangent(self) -> Floats:
        """Derivative (n, axes, freedom) of the ideal readings by the attitude, per rad."""
        return self.data.model.tangent(self.values.base, self.values.attitude, self.turn_rad)

    @cached_property
    def predicted(self) -> Floats:
        """Readings (n, axes) in mg that the model predicts at the fitted attitudes, with all terms."""
        return self._predicted(self.ideal)

    def _predicted(self, ideal: Floats) -> Floats:
        """Return the readings (n, axes) that the model predicts: ideal readings plus all terms."""
        predicted = ideal
        for term, own in zip(self.terms, self.values.terms, strict=True):
            if not term.enters_angle:
                predicted = predicted + term.added(own, ideal, self.data.conditions)
        return predicted

    @property
    def misfit(self) -> Floats:
        """Residual (n, axes) in mg of each reading: reading minus prediction at the fitted attitude."""
        return self.data.mean - self.predicted

    @cached_property
    def declared_misfit(self) -> Floats:
        """Reading minus prediction (n, axes) at the declared angle instead of the fitted attitude, in mg.

        It is computed to first order in the deviation of the angle.
        """
        deviation = self.data.model.deviation_rad(self.values.attitude)
        return self.misfit + (self.tangent @ deviation[:, :, None])[:, :, 0]

    @cached_property
    def gravity(self) -> Floats:
        """Gravity (n, axes) that the calibrated sensor shows in each dwell, as a share of local gravity."""
        added = np.zeros(self.data.mean.shape)
        for index, term in enumerate(self.terms):
            if not term.enters_angle:
                added = added + self.added(index)
        return self.data.model.calibrated(self.values.base, self.data.mean - added)

    def added(self, index: int) -> Floats:
        """Return the contribution (n, axes) of the term with this index to the readings.

        If the term is an error of the angle, the contribution is computed to first order.
        """
        term, own = self.terms[index], self.values.terms[index]
        added = term.added(own, self.ideal, self.data.conditions)
        return self.as_readings(term, added[..., None])[:, :, 0]

    # -- whitening ---------------------------------------------------------------------------------

    @cached_property
    def whitener(self) -> Floats:
        """Matrix (n, rows, axes) for each dwell that converts its residual to unit covariance.

        The covariance includes the uncertainty of the declared angle; if the angle is free, the direction
        in which it moves the reading is removed.
        """
        root = self.data.own_root
        along = root @ self.tangent
        if along.shape[2] == 0:
            return root
        if along.shape[2] == 2:
            # With two unknown attitude angles one direction remains: normal to both whitened tangents.
            normal = np.cross(along[:, :, 0], along[:, :, 1])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            return normal[:, None, :] @ root
        along = along[:, :, 0]
        size = np.linalg.norm(along, axis=1, keepdims=True)
        unit = along / np.maximum(size, 1e-300)
        if self.data.free:
            # A free angle uses up the direction of the tangent: keep only the direction across it.
            across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
            return across[:, None, :] @ root
        with np.errstate(divide="ignore"):
            # Shrink the direction of the tangent by the variance of the declared angle (module docstring).
            beta = 1 - 1 / np.sqrt(1 + (self.data.fixture[:, None] * size) ** 2)
        return np.asarray(root - (beta * unit)[:, :, None] * (unit[:, None, :] @ root))

    @cached_property
    def link_rows(self) -> LinkRows | None:
        """Equations of the links (known rotations between poses) at the fitted attitudes; else None."""
        if self.data.links is None:
            return None
        return LinkRows.at(self.data.links, self.values.attitude, self.tangent, self.data.own_root)

    @cached_property
    def modes(self) -> Floats | None:
        """Effect (rows, k) on the whitened rows of k independent errors that several dwells share.

        Each error has its standard deviation as size. The errors by 1/f noise of the readings come first,
        then the errors by the gyros that measured the links. None without such errors.
        """
        links = self.link_rows
        found = [self._white_separately(self.data.shared)] if self.data.shared.shape[2] else []
        if links is not None:
            own = links.modes
            # Modes of the gyros do not act on the rows of dwells, which come first.
            rest = np.zeros((len(self.data) * self.whitener.shape[1], own.shape[1]))
            found.append(np.concatenate([rest, own]))
        return np.concatenate(found, axis=1) if found else None

    @cached_property
    def _shared(self) -> tuple[Floats, Floats] | None:
        """Factors of the symmetric inverse root of 1 + A Aᵀ, the covariance with shared noise.

        The first factor is A (rows, k), the shared modes on the whitened rows. The second is V g(λ) Vᵀ (k,
        k) with Aᵀ A = V λ Vᵀ and the function g of the module's docstring. None without shared noise.
        """
        if self.data.model.freedom == 0 and self.data.links is None:
            # Without an attitude, all fits to these readings share the factors.
            return self.data.once(_fixed_factors)
        return _factors(self.modes)

    def white(self, columns: Floats) -> Floats:
        """Whiten d changes of the readings: scale and mix them so that the noise has unit covariance.

        `columns` (n, axes, d) are the changes. The result (rows, d) has the rows of the dwells, then the
        rows of the links.
        """
        return self._without_shared(self._white_separately(columns))

    def _white_separately(self, columns: Floats) -> Floats:
        """Whiten d changes of the readings as `white` does, but ignore noise that several dwells share."""
        whitened = self.white_by_dwell(columns)
        flat: Floats = whitened.reshape(whitened.shape[0] * whitened.shape[1], columns.shape[2])
        links = self.link_rows
        return flat if links is None else np.concatenate([flat, links.white(columns)])

    def _without_shared(self, flat: Floats) -> Floats:
        if self._shared is None:
            return flat
        rows, middle = self._shared
        return flat - rows @ (middle @ (rows.T @ flat))

    def white_by_dwell(self, columns: Floats) -> Floats:
        """Whiten d changes of the readings in each dwell alone; `columns` (n, axes, d) are the changes.

        The result (n, rows, d) has a few rows for each dwell. Noise that several dwells share is ignored.
        """
        return np.asarray(self.whitener @ columns)

    def by_reading(self, slope: Floats) -> Floats:
        """Return the derivative (d, n, axes) of d weighted sums of the whitened rows by each reading.

        The whitened rows are the result of `white`. The weights are the columns of `slope` (rows, d).
        """
        slope = self._without_shared(slope)
        of_dwells = len(self.data) * self.whitener.shape[1]
        # Transpose `_white_separately`: split the rows of dwells from the rows of links, and whiten back.
        by_dwell = slope[:of_dwells].reshape(len(self.data), -1, slope.shape[1])
        found = np.asarray(np.einsum("nrd,nra->dna", by_dwell, self.whitener))
        links = self.link_rows
        return found if links is None else found + links.by_reading(slope[of_dwells:])

    def by_rotation(self, slope: Floats) -> Floats:
        """Return the derivative (m, 3, d) of d weighted sums of the whitened rows by each link's rotation.

        The derivative is per rad of rotation error. The weights are the columns of `slope` (rows, d).
        """
        links = self.link_rows
        assert links is not None
        return links.by_rotation(self._without_shared(slope)[-2 * len(links.links) :])

    @cached_property
    def residual(self) -> Floats:
        """Residuals (n, rows) scaled to unit covariance.

        With links this is a flat array: first the rows of the dwells, then the rows of the links.
        """
        if self.data.links is None:
            return self.white(self.declared_misfit[:, :, None]).reshape(len(self.data), -1)
        return self._without_shared(self.unshared_residual[:, None])[:, 0]

    @property
    def unshared_residual(self) -> Floats:
        """Residuals (rows,) scaled to unit covariance, ignoring noise that several rows share."""
        flat = self._white_separately(self.declared_misfit[:, :, None])[:, 0]
        if self.link_rows is not None:
            # Links have a misclosure of their own, in addition to the effect of the misfits.
            flat[-2 * len(self.link_rows.links) :] += self.link_rows.residual
        return flat

    # -- columns -----------------------------------------------------------------------------------

    def as_readings(self, term: Term, columns: Floats) -> Floats:
        """Return d changes of the readings (n, axes, d) by a term, from its own changes `columns`.

        Changes of the angle (n, d) in rad are multiplied by the derivative of the reading by the angle;
        changes of the readings are returned as they are.
        """
        if not term.enters_angle:
            return columns
        if not self.data.model.planar:
            return np.zeros((*self.ideal.shape, columns.shape[1]))
        return self.tangent * columns[:, None, :]

    def candidate(self, term: Term) -> Floats:
        """Return the derivative (n, axes, d) of the readings by the amplitudes of a new term, at 0."""
        return self.as_readings(term, term.columns(self.ideal, self.data.conditions))

    def candidates(self, terms: Sequence[Term]) -> tuple[Floats, NDArray[np.intp]]:
        """Return the derivatives of the readings by the amplitudes of M terms, side by side.

        The first result (n, axes, P) has a column for each amplitude. The second (M,) is the number of
        columns of each term. Unnamed terms with an equal basis share their columns of an axis, which are
        computed once.
        """
        conditions = self.data.conditions
        driven = self.data.model.stimulus(self.ideal, conditions)
        of_axis: dict[tuple[int, Where, int], Floats] = {}
        blocks: list[tuple[int | slice, Floats]] = []
        widths = np.zeros(len(terms), dtype=np.intp)
        for k, term in enumerate(terms):
            if not isinstance(term, NamelessTerm) or term.enters_angle:
                own = self.candidate(term)
                blocks.append((slice(None), own))
                widths[k] = own.shape[-1]
                continue
            for axis in term.axes:
                # Terms that share a basis have equal columns on an axis.
                key = (id(term.basis), term.where, axis)
                if key not in of_axis:
                    of_axis[key] = term.on_axis(axis, driven, conditions)
                blocks.append((axis, of_axis[key]))
                widths[k] += of_axis[key].shape[-1]
        return join_columns(blocks, self.ideal.shape), widths

    @cached_property
    def base_columns(self) -> Floats:
        """Derivative (n, axes, p) of the readings by the base parameters.

        It is zero for parameters that these dwells do not determine.
        """
        columns = self.data.model.columns(self.values.base, self.values.attitude, self.turn_rad)
        columns[:, :, ~self.data.visible] = 0.0
        return columns

    @cached_property
    def columns(self) -> Floats:
        """Derivative (n, axes, p + q) of the readings by all p + q parameters."""
        blocks = [self.base_columns]
        for term, own in zip(self.terms, self.values.terms, strict=True):
            blocks.append(self.as_readings(term, term.derivative(own, self.ideal, self.data.conditions)))
        return np.concatenate(blocks, axis=2)

    @cached_property
    def jacobian(self) -> Floats:
        """Derivative (rows, p + q) of the whitened readings by all parameters."""
        return self.white(self.columns)

    def linear(self) -> tuple[Floats, list[Floats], Floats]:
        """Return the linear least-squares problem in which terms are chosen, whitened (`white`).

        The results are the derivatives (rows, p) by the base parameters, the derivatives (rows, d) by the d
        amplitudes of each term, and the values (rows,) to explain: the residual plus the contributions of
        the terms.
        """
        target = self.residual.ravel()
        blocks = []
        for index, (term, own) in enumerate(zip(self.terms, self.values.terms, strict=True)):
            derivative = term.derivative(own, self.ideal, self.data.conditions)
            blocks.append(self.white(self.as_readings(term, derivative[..., term.amplitude_index(own)])))
            target = target + self.white(self.added(index)[:, :, None])[:, 0]
        return self.white(self.base_columns), blocks, target

    # -- goodness of fit ----------------------------------------------------------------------------------

    @property
    def chi2(self) -> float:
        """Sum of the squared whitened residuals (χ²) of the readings, and of the links if there are any."""
        return float((self.residual**2).sum())

    @cached_property
    def equations(self) -> int:
        """Number of whitened residuals, minus one for each dwell with an unknown angle."""
        by_angle = self.data.model.freedom == 1 and not self.data.free
        return self.residual.size - int(np.isinf(self.data.fixture).sum()) * by_angle

    @cached_property
    def _covariance_root(self) -> Floats:
        """Root (p + q, k) of the covariance of all parameters: root · rootᵀ is the covariance."""
        # Scale columns to unit length first: parameters have different units.
        scaled = self._with_prior(self.jacobian)
        size = np.linalg.norm(scaled, axis=0)
        size[size == 0] = 1.0
        _, s, vt = np.linalg.svd(scaled / size, full_matrices=False)
        # Directions without information get no variance instead of an infinite one.
        keep = s > 1e-9 * (s[0] if s.size else 1.0)
        return np.asarray((vt[keep].T / s[keep]) / size[:, None])

    @cached_property
    def covariance(self) -> Floats:
        """Covariance (p + q, p + q) of the base parameters and the values of the terms."""
        return np.asarray(self._covariance_root @ self._covariance_root.T)

    @cached_property
    def used(self) -> float:
        """Effective number of fitted parameters.

        A parameter with an informative prior counts less than 1.
        """
        used = float(((self.jacobian @ self._covariance_root) ** 2).sum())
        if all(term.prior_sd is None for term in self.terms):
            used = float(round(used))  # the base's prior is wide: a parameter counts fully or not at all
        return used

    @property
    def dof(self) -> float:
        """Degrees of freedom of χ²: number of equations minus effective number of fitted parameters."""
        return self.equations - self.used

    # -- priors ------------------------------------------------------------------------------------

    @cached_property
    def _prior(self) -> tuple[Floats, Floats]:
        """Prior of each parameter: 1/σ (p + q,), zero without a prior, and its mean (p + q,)."""
        model = self.data.model
        spreads = [np.array([parameter.spread for parameter in model.parameters])]
        for term, own in zip(self.terms, self.values.terms, strict=True):
            loose = nameless_spread(model, term) if term.name is None else np.inf
            spreads.append(np.full(len(own), loose if term.prior_sd is None else term.prior_sd))
        precision = 1 / np.concatenate(spreads) if self.with_prior else np.zeros(sum(map(len, spreads)))
        centre = np.zeros(len(precision))
        centre[: len(model.parameters)] = model.nominal
        return precision, centre

    @cached_property
    def _prior_distance(self) -> Floats:
        """Distance (p + q,) of each parameter from its prior mean, in standard deviations of the prior."""
        precision, centre = self._prior
        return np.asarray(precision * (self.values.parameters - centre))

    @cached_property
    def loss(self) -> float:
        """Quantity that the fit minimizes: χ² of the readings plus squared distances from the prior means.

        Distances are in standard deviations of the prior.
        """
        return self.chi2 + float((self._prior_distance**2).sum())

    def _with_prior(self, rows: Floats) -> Floats:
        """Append one row for each parameter with a prior to the whitened derivatives `rows` (rows, p + q).

        Such a row is 1/σ of the prior in the column of the parameter, and 0 elsewhere.
        """
        precision, _ = self._prior
        return np.concatenate([rows, np.diag(precision)[precision > 0]])

    def base_step(self, left: Floats) -> Floats:
        """Return the least-squares changes (p, k) of the base parameters that explain k sets of residuals.

        `left` (rows, k) are whitened residuals, one set in each column. The priors of the base parameters
        count as further rows.
        """
        count = len(self.values.base)
        held = self._prior[0][:count] > 0
        # A prior is one further row 1/σ with the target (centre − value)/σ.
        rows = np.concatenate([self.jacobian[:, :count], np.diag(self._prior[0][:count])[held]])
        to_centre = -self._prior_distance[:count, None][held]
        right = np.concatenate([left, np.repeat(to_centre, left.shape[1], axis=1)])
        size = np.linalg.norm(rows, axis=0)
        size[size == 0] = 1.0
        return np.asarray(np.linalg.lstsq(rows / size, right, rcond=1e-9)[0] / size[:, None])

    # -- refitting ---------------------------------------------------------------------------------

    def settled(self, passes: int = 2) -> Fit:
        """Return a copy in which the attitude of each dwell is fitted again, with unchanged parameters.

        `passes` is the number of Gauss–Newton steps.
        """
        data, model = self.data, self.data.model
        freedom = model.freedom
        fixed = data.fixture == 0
        if not freedom or (freedom == 1 and fixed.all()):
            return self
        precision = data.fixture_precision
        attitude = self.values.attitude
        for _ in range(passes):
            at = self.values.base, attitude, self.turn_rad
            # One Gauss–Newton step of each attitude, whitened by the covariance of its reading.
            along = data.root @ model.tangent(*at)
            left = data.root @ (data.mean - self._predicted(model.ideal(*at)))[:, :, None]
            # Normal equations of each attitude, 2 × 2 in space.
            pull = precision[:, None] * model.deviation_rad(attitude)
            right = (along.transpose(0, 2, 1) @ left)[:, :, 0] - pull
            gram = along.transpose(0, 2, 1) @ along + precision[:, None, None] * np.eye(freedom)
            # If an axis has no gain, a pose has only one tangent and the matrix is singular.
            trace = np.trace(gram, axis1=1, axis2=2)[:, None, None]
            gram = gram + (1e-12 * trace + 1e-300) * np.eye(freedom)
            step = np.linalg.solve(gram, right[:, :, None])[:, :, 0]
            # An exact declared angle leaves no freedom.
            step[fixed] = 0.0
            attitude = model.moved(attitude, step)
        return replace(self, values=replace(self.values, attitude=attitude))

    def refit(
        self, iterations: int = 15, tolerance: float = _LEAST_GAIN, within: Floats | None = None
    ) -> Fit:
        """Fit base parameters and terms to the readings by nonlinear least squares (Gauss–Newton).

        The model contains effects that depend on the ideal reading, but the derivative neglects this
        dependence. Steps therefore converge linearly, with a factor of about the size of the effect over 1
        g.

        Parameters
        ----------
        iterations : int
            Largest number of steps.
        tolerance : float
            Decrease of χ² below which the iteration ends; if χ² is above 1000, as a share of χ²/1000.
        within : (p + q, k) float, optional
            Orthonormal directions in which parameters may move; all by default.
        """
        fit = self.settled()
        for _ in range(iterations):
            rows = fit._with_prior(fit.jacobian)
            held = fit._prior[0] > 0
            # Residuals of the readings, then of the priors.
            left = np.concatenate([fit.residual.ravel(), -fit._prior_distance[held]])
            if within is not None:
                rows = rows @ within
            size = np.linalg.norm(rows, axis=0)
            size[size == 0] = 1.0
            step = np.linalg.lstsq(rows / size, left, rcond=1e-9)[0] / size
            least = tolerance * max(1.0, 1e-3 * fit.loss)
            # Decrease of χ² that the linear model predicts for this step.
            if left @ left - np.square(left - rows @ step).sum() < least:
                break  # the expected decrease of χ² is below the tolerance
            if within is not None:
                step = within @ step
            # Take the largest of these step lengths that does not increase χ².
            for damping in (1.0, 0.5, 0.2, 0.05, 0.01):
                trial = fit._stepped(damping * step)
                if trial is not fit and trial.loss <= fit.loss * (1 + 1e-12):
                    break
            else:
                break
            gain, fit = fit.loss - trial.loss, trial
            if gain < least:
                break
        return fit

    def _stepped(self, step: Floats) -> Fit:
        """Return the fit after a step of its parameters; unchanged if the model fails at the new values."""
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                terms = []
                for index, (term, own) in enumerate(zip(self.terms, self.values.terms, strict=True)):
                    terms.append(term.limited(own, own + step[self.slice_of(index)]))
                base = self.values.base + step[: len(self.values.base)]
                if self.with_prior:
                    # With a prior, also keep the parameters within physical bounds.
                    parameters = self.data.model.parameters
                    base = np.clip(base, [p.low for p in parameters], [p.high for p in parameters])
                values = Values(base, self.values.attitude, tuple(terms))
                trial = replace(self, values=values).settled()
                sound = math.isfinite(trial.loss) and bool((np.abs(trial.jacobian) < _RUN_AWAY).all())
        except (UsageError, np.linalg.LinAlgError):
            return self
        return trial if sound else self

    def again(self, data: Readings) -> Fit:
        """Fit these terms to other readings, with the base model from new starting values.

        Amplitudes start at zero if the other readings give no information on them.
        """
        values = []
        for term, old in zip(self.terms, self.values.terms, strict=True):
            slopes = term.derivative(old, data.mean, data.conditions)
            # Amplitudes with columns of zeros on these readings.
            unseen = [k for k in term.amplitude_index(old) if not slopes[..., k].any()]
            own = old.copy()
            own[unseen] = 0.0
            values.append(own)
        return Fit.begin(data, with_prior=self.with_prior).with_terms(self.terms, values).refit(8)

    # -- dwells that were not fitted ------------------------------------------------------------------

    def on(self, data: Readings) -> Fit:
        """Return a copy with these parameters for other dwells, of which only the attitudes are fitted."""
        return self._placed_on(data).settled(4)

    def _placed_on(self, data: Readings) -> Fit:
        model = data.model
        _, attitude = model.begin(data.mean, data.angle_rad, data.conditions)
        if model.planar:
            # Start an undeclared dwell at the angle of its reading, a declared one at its declared angle.
            shown = np.arctan2(data.mean[:, 1], data.mean[:, 0]) - model.start_rad(self.values.base)
            attitude = np.where(np.isfinite(data.angle_rad), 0.0, shown)
        return replace(self, data=data, values=replace(self.values, attitude=attitude))

    def angle_error_rad(self, data: Readings) -> Floats | None:
        """Return the calibrated minus the declared angle (n,) of the dwells in `data`.

        None in space, or if an angle is not declared.
        """
        if not data.model.planar or data.conditions.angle_rad is None:
            return None
        # A stage at a larger angle than declared has turned ψ = α − θ the other way.
        return -self._placed_on(replace(data, fixture_rad=np.inf)).settled(4).values.attitude

    def carried(self, there: Fit) -> Floats:
        """Return a root (rows, k) of the covariance of predictions from this fit's uncertain parameters.

        `there` has the parameters of this fit and the dwells to predict; the rows are whitened readings of
        these dwells, and the root times its transpose is the covariance.
        """
        return np.asarray(there.jacobian @ self._covariance_root)

    def can_predict(self, data: Readings, most: float) -> NDArray[np.bool_]:
        """Return a mask (n,) of the dwells in `data` that this fit predicts with sufficient certainty.

        The variance of the prediction must be at most `most` times the variance of the noise.
        """
        there = self.on(data)
        rest = self.white_by_dwell(self.columns)
        return predictable_dwells(
            rest.reshape(-1, rest.shape[2]), there.white_by_dwell(there.columns), most
        )


def _factors(modes: Floats | None) -> tuple[Floats, Floats] | None:
    """Return the factors that `Fit._shared` describes, from the shared modes (rows, k).

    None without modes.
    """
    if modes is None:
        return None
    values, vectors = np.linalg.eigh(modes.T @ modes)
    # g(λ) = 1/(r (r + 1)) with r = √(1 + λ) gives the symmetric inverse root of 1 + A Aᵀ.
    root = np.sqrt(1 + np.maximum(values, 0.0))
    return modes, (vectors / (root * (root + 1))) @ vectors.T


def _fixed_factors(data: Readings) -> tuple[Floats, Floats] | None:
    return _factors(Fit.begin(data).modes)


def adequacy(chi2: float, dof: float, noise_dof: float) -> float:
    """Return the p-value of χ² for a model fitted with measured noise: small if the model is inadequate.

    `chi2` and `dof` are χ² and its degrees of freedom; `noise_dof` are the degrees of freedom of the
    measured noise (inf if it is known exactly).
    """
    from scipy.special import chdtrc, fdtrc

    if dof <= 0:
        return 1.0
    if np.isinf(noise_dof):
        return float(chdtrc(dof, chi2))
    return float(fdtrc(dof, max(noise_dof, 1.0), chi2 / dof))


def nameless_spread(model: Measurement, term: Term) -> float:
    """Return the prior standard deviation of each amplitude of an unnamed term, in the term's unit."""
    return NAMELESS_SPREAD * (MG_PER_G if term.enters_angle else model.full)


def amplitude_spreads(model: Measurement, terms: Sequence[Term], widths: NDArray[np.intp]) -> Floats:
    """Return the prior standard deviations (P,) of the amplitudes of M terms, one after another.

    `widths` (M,) are the numbers of amplitudes of the terms.
    """
    spread = np.repeat([nameless_spread(model, term) for term in terms], widths)
    for term, end in zip(terms, np.cumsum(widths).tolist(), strict=True):
        if isinstance(term, NamedTerm):
            spread[end - len(term.amplitudes) : end] = term.amplitude_spread
    return spread


def predictable_dwells(rest: Floats, left: Floats, most: float) -> NDArray[np.bool_]:
    """Return a mask (n,) of dwells that a fit to other dwells predicts with sufficient certainty.

    The variance of the prediction, including the noise of the reading, must be at most `most` times the
    variance of the noise. `left` (n, r, p) are the whitened derivatives of these dwells' readings by the p
    parameters, and `rest` (m, p) the whitened derivatives of the fitted readings. In units of the noise,
    the prediction of a dwell with derivatives X_b (r, p) has the covariance 1 + X_b (Xᵀ X)⁻¹ X_bᵀ with X =
    `rest` (Cook and Weisberg, Residuals and Influence in Regression, 1982).
    """
    if not len(rest):
        return np.zeros(len(left), dtype=bool)
    # Scaled columns, so that the rank of the other rows is judged without units.
    size = np.linalg.norm(rest, axis=0)
    size = np.where(size > 0, size, 1.0)
    _, s, vt = np.linalg.svd(rest / size, full_matrices=False)
    seen = s > 1e-8 * s[0]
    scaled = left / size
    # An amplitude that the fitted rows hardly show is uncertain without limit; its square may not overflow.
    carried = np.clip(scaled @ (vt[seen].T / s[seen]), -1e100, 1e100)
    # Part of a held-out row outside the space of the other rows: such a row cannot be predicted.
    missing = np.abs(scaled - scaled @ vt[seen].T @ vt[seen]).max(axis=2) > 1e-6
    return np.asarray(((1 + (carried**2).sum(axis=2) <= most) & ~missing).all(axis=1))
