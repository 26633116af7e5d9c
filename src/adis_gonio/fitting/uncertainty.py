"""Uncertainty of fitted parameters: its sources, the budget, and the angle that a goniometer shows.

**Sources.** A small change of the readings changes the fitted parameters by R = ∂parameter/∂reading. A
source of uncertainty has independent components. Each is a change of the readings by one standard
uncertainty, and these changes are the columns of a matrix P_s. The source therefore changes the parameters
by the columns of F_s = R P_s, and the covariance of the parameters is Σ F_s F_sᵀ over all sources (JCGM
100:2008, 5.1.2 and 5.2). Each column has the degrees of freedom of the estimate of noise that it comes
from, and columns from one estimate count as one (G.4.1).

**Missing effects.** If the residual is larger than the noise, some effect is missing, and it also moves the
fitted parameters. Each amplitude θ of the catalogue gets a normal prior about zero. Its standard deviation
is the typical size in the catalogue times one common factor s ≥ 1, which maximizes the likelihood of the
residual r:

    r ~ N(0, 1 + s² W Wᵀ),  W = whitened columns of typical size, without the part that the fit describes

The posterior of θ then has the second moment M + μ μᵀ with M = (s⁻² + Wᵀ W)⁻¹ and μ = M Wᵀ r. The fit
leaves the effects out, so the error that they cause has this second moment, and not the variance M alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord, key
from adis_gonio.base.numbers import format_span, join_words, signed
from adis_gonio.base.uncertainty import effective_dof
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.determination import NoiseAssumptions
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import typical_terms
from adis_gonio.model.effects import Enters
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

Kind = Literal["A", "B"]

REPEATABILITY, FLICKER, FIXTURE = "repeatability", "1/f noise", "fixture"
GRAVITY, QUANTIZATION, TEMPERATURE, MODEL = "gravity", "quantization", "temperature", "model choice"
LINKS = "gyro links"
"""Name of the source of uncertainty that a fit in space has in addition if it uses turns measured by the
gyros.
"""
_STATISTICAL: tuple[Kind, str] = ("A", "Student")
_STATED: tuple[Kind, str] = ("B", "normal")
"""Type and distribution of a source that is estimated from the session, and of one that is stated."""

GRAVITY_HALF_MPS2 = 0.027
"""Half the range of gravity on the surface of the Earth (9.780 to 9.834 m/s²), in which local gravity has a
rectangular distribution.
"""
_POOLED, _RESIDUAL, _FIXTURE, _UNSTATED, _EACH = 0, 3, 4, 5, 6
"""Numbers of the estimates that variances come from: samples of all dwells together (+ axis), the residual,
the scatter of the angles, the scatter of readings without a stated noise, the samples of one dwell (+ 3 n +
axis)."""


@dataclass(frozen=True)
class Source:
    """One source of uncertainty, and its effect on the fitted parameters and on one further reading.

    Attributes
    ----------
    name : str
        Name of the source: repeatability, flicker noise, fixture, gravity, quantization, temperature,
        effects that the model lacks, links.
    kind : {"A", "B"}
        `A` if evaluated by statistics of this session, `B` if by other knowledge (GUM 3.3.4).
    distribution : str
        `normal`, `Student` or `rectangular`.
    u : float or None
        Standard uncertainty of the source itself, in `unit`, rms over dwells and axes; None if unknown.
    moves : (p, k) float
        Change of the parameters, in natural units, by one standard uncertainty of each of the k independent
        components of the source.
    dof : float or (k,) float
        Degrees of freedom of the estimate of each component's variance; inf if it is not estimated.
    estimate : int or (k,) int
        Number of the estimate that each component's variance comes from; components with an equal number
        have a common error.
    reading_mg2 : (axes, axes) float or None
        Covariance that the source alone gives a further reading, which is averaged for as long as a dwell
        of the session; None if it adds no noise to it.
    note : str
        Remark on the source.
    by_definition : bool
        True if the parameters are stated relative to this source: it changes them, but u excludes it.
    acts_mg : (n, axes, k) float or None
        Change of the readings by k inputs that act on all dwells, at one standard uncertainty of each; None
        if the source has no such input.
    further_mg : (axes, k) float or None
        Direct effect of the components on a further reading, in addition to their effect on the parameters;
        None if there is none.
    unit : str
        Unit of `u`.
    """

    name: str
    kind: Kind
    distribution: str
    u: float | None
    moves: Floats
    note: str = ""
    dof: Floats | float = math.inf
    estimate: NDArray[np.intp] | int = _POOLED
    reading_mg2: Floats | None = None
    by_definition: bool = False
    acts_mg: Floats | None = None
    further_mg: Floats | None = None
    unit: str = "mg"

    def parts(self, gradient: Floats, reading: Floats | None = None) -> list[tuple[int, float, float]]:
        """Return the contributions of the source to the mean variance of m values, one for each component.

        Each contribution is (number of the estimate, degrees of freedom, variance). A further reading adds
        its own noise as another contribution.

        Parameters
        ----------
        gradient : (m, p) float
            Derivative of the m values by the parameters.
        reading : (m, axes) float, optional
            Derivative of the m values by one further reading, per mg; without it only the parameters count.
        """
        # Parts are independent: their mean squares over the m values add up.
        *variance, own = self.variances(gradient, reading).mean(axis=0).tolist()
        estimate, dof = (np.broadcast_to(one, len(variance)).tolist() for one in (self.estimate, self.dof))
        found = list(zip(estimate, dof, variance, strict=True))
        # The own noise of a further reading comes from the session's estimate of this noise.
        estimated = (part for part in found if math.isfinite(part[1]))
        where = max(estimated, key=lambda part: part[2], default=(_POOLED, math.inf, 0.0))
        return [*found, (where[0], where[1], own)] if own else found

    def _moved(self, gradient: Floats, reading: Floats | None) -> Floats:
        """Return the change (m, k) of m quantities by one standard uncertainty of each of k components.

        `gradient` (m, p) and `reading` (m, axes) are the derivatives of the quantities by the parameters
        and by a further reading; None leaves out the effect on a further reading.
        """
        moved = gradient @ self.moves
        if reading is not None and self.further_mg is not None:
            moved = moved + reading @ self.further_mg
        return np.asarray(moved)

    def variances(self, gradient: Floats, reading: Floats | None = None) -> Floats:
        """Return the variance (m, k + 1) of m quantities by each component and by a reading's own noise.

        `gradient` (m, p) and `reading` (m, axes) are the derivatives of the quantities by the parameters
        and by a further reading (None: the parameters alone).
        """
        own = np.zeros(len(gradient))
        if reading is not None and self.reading_mg2 is not None:
            own = np.einsum("ma,ab,mb->m", reading, self.reading_mg2, reading)
        return np.column_stack([self._moved(gradient, reading) ** 2, own])


@dataclass(frozen=True)
class Sources:
    """All sources that contribute to the uncertainty of a fit, in `each`."""

    each: tuple[Source, ...]

    @property
    def _counted(self) -> list[Source]:
        return [source for source in self.each if not source.by_definition]

    @property
    def covariance(self) -> Floats:
        """Total covariance (p, p) of the parameters in natural units."""
        moves = np.concatenate([source.moves for source in self._counted], axis=1)
        return np.asarray(moves @ moves.T)

    def parts(self, gradient: Floats, reading: Floats | None = None) -> list[tuple[int, float, float]]:
        """Return the contributions of all sources to the variance of m values, a mean over the values.

        `gradient` (m, p) are the derivatives of the values by the parameters, `reading` (m, axes) those by
        one further reading (None: the parameters alone). Each contribution is (number of the estimate,
        degrees of freedom, variance).
        """
        return [part for source in self._counted for part in source.parts(gradient, reading)]

    def by_place(self, gradient: Floats, reading: Floats | None = None) -> Floats:
        """Return the total variance (m,) of each of m quantities, such as m angles.

        `gradient` (m, p) and `reading` (m, axes) are the derivatives of the quantities by the parameters
        and by a further reading, to which the calibration is applied (None: the parameters alone).
        """
        return np.asarray(sum(one.variances(gradient, reading).sum(axis=1) for one in self._counted))

    def roots(self, gradient: Floats, reading: Floats) -> Floats:
        """Return the change (m, k) of m quantities by one standard uncertainty of each of k components.

        The k components belong to all sources; they are independent, so that the result times its
        transpose is the covariance of the quantities. `gradient` (m, p) and `reading` (m, axes) are the
        derivatives of the quantities by the parameters and by a further reading, to which the calibration
        is applied. An error of all readings, such as the effect of the supply, acts on the further reading
        too; its noise is not included.
        """
        return np.concatenate([source._moved(gradient, reading) for source in self._counted], axis=1)

    def uncertainty(self, gradient: Floats, reading: Floats | None = None) -> tuple[float, float]:
        """Return the standard uncertainty of m values together, with its effective degrees of freedom.

        It is the root mean square of the m standard uncertainties; for one value it is the value's own.
        `gradient` (m, p) are the derivatives of the values by the parameters, `reading` (m, axes) those by
        one further reading (None: the parameters alone).
        """
        parts = self.parts(gradient, reading)
        return math.sqrt(sum(part[2] for part in parts)), dof_of(parts)


def dof_of(parts: Sequence[tuple[int, float, float]]) -> float:
    """Return the effective degrees of freedom of a sum of variances (Welch–Satterthwaite).

    Each of `parts` is (number of an estimate, degrees of freedom, variance): a contribution to the
    variance, and the estimate of noise from which it was computed. Variances that come from one estimate
    are added first, because they have a common error.
    """
    by_estimate: dict[int, tuple[float, float]] = {}
    surely = sum(variance for _, dof, variance in parts if math.isinf(dof))
    for estimate, dof, variance in parts:
        if math.isfinite(dof):
            before, least = by_estimate.get(estimate, (0.0, math.inf))
            by_estimate[estimate] = before + variance, min(least, dof)
    return effective_dof([(surely, math.inf), *by_estimate.values()])


def response_of(fit: Fit, covariance: Floats, natural: Floats) -> Floats:
    """Return the derivative (p, n, axes) of the parameters by each reading, in natural units per mg.

    It is valid for weighted least squares.

    Parameters
    ----------
    covariance : (p, p) float
        Inverse of the Fisher information, in natural units.
    natural : (p,) float
        Size of the natural units in units of the fit.
    """
    return fit.by_reading((fit.jacobian * natural) @ covariance)


def by_rotation_of(fit: Fit, covariance: Floats, natural: Floats) -> Floats | None:
    """Return the derivative (p, m, 3) of the parameters by the rotation of each link.

    It is in natural units per rad; None if the fit has no links. `covariance` (p, p) is the inverse of the
    Fisher information in natural units, `natural` (p,) the size of these units in units of the fit.
    """
    if fit.data.links is None:
        return None
    return np.asarray(fit.by_rotation((fit.jacobian * natural) @ covariance).transpose(2, 0, 1))


def sources_of(
    data: Readings,
    noise: NoiseAssumptions,
    fit: Fit,
    response: Floats,
    held: Sequence[int] = (),
    rotation: Floats | None = None,
    unseen: Floats | None = None,
) -> Sources:
    """Return all sources that contribute to the uncertainty of fitted parameters.

    Parameters
    ----------
    data : Readings
        The fitted readings, before `noise` was estimated.
    noise : NoiseAssumptions
        Noise of readings and declared angles that the fit used.
    fit : Fit
        Fit of the readings with that noise.
    response : (p, n, axes) float
        Derivative of the parameters by each reading, in natural units per mg.
    held : sequence of int
        Indices of the biases and skews that were taken as zero, among base parameters and biases.
    rotation : (p, m, 3) float, optional
        Derivative of the parameters by the rotation of each link, in natural units per rad; None without
        links.
    unseen : (p, k) float, optional
        Changes of the parameters by one standard uncertainty along each undetermined direction, in natural
        units. A parameter that counts as determined may have a small part of them.
    """
    links = () if rotation is None else (_links(fit, rotation),)
    return Sources(
        (
            _repeatability(data, noise, response),
            _flicker(data, response),
            _fixture(data, noise, fit, response),
            _gravity(data, fit, len(response)),
            _quantization(data, response),
            _temperature(data, noise, fit, response),
            _model(data, noise, fit, response, held, unseen),
            *links,
        )
    )


def _links(fit: Fit, rotation: Floats) -> Source:
    """Return the source of uncertainty of the rotations between poses: noise and parameters of the gyros.

    `rotation` (p, m, 3) is the derivative of the parameters by the rotation of each link.
    """
    links = fit.data.links
    assert links is not None
    # Errors of each link, made independent by a root of their covariance, then errors that all links share.
    own = rotation.reshape(len(rotation), -1) @ np.linalg.cholesky(links.own_covariance)
    moves = np.concatenate([own, np.einsum("pma,maq->pq", rotation, links.modes_rad)], axis=1)
    spread = links.own_rad2 + links.modes_rad @ links.modes_rad.transpose(0, 2, 1)
    u = math.degrees(math.sqrt(float(np.trace(spread.mean(axis=0))) / 3))
    note = "turns between the poses: noise of the gyros and uncertainty of their parameters"
    return Source(LINKS, *_STATED, u, moves, note, unit="deg")


def _by_dwell(response: Floats, roots: Floats) -> Floats:
    """Return the changes (p, n·axes) of p parameters by independent errors of each of n dwells.

    The errors have the covariances root·rootᵀ for `roots` (n, axes, axes); `response` (p, n, axes) is the
    derivative of the parameters by each reading.
    """
    return np.asarray(np.einsum("pna,nab->pnb", response, roots).reshape(len(response), -1))


def _root(covariance: Floats) -> Floats:
    """Return roots (n, axes, axes) of n covariances: root times its transpose is the covariance."""
    axes = covariance.shape[1]
    diagonal = np.sqrt(np.maximum(np.einsum("naa->na", covariance), 0.0))
    if not covariance[:, ~np.eye(axes, dtype=bool)].any():
        return np.asarray(diagonal[:, :, None] * np.eye(axes))
    # A difference of covariances has eigenvalues of zero, or below by rounding: it has no Cholesky factor.
    size, axis = np.linalg.eigh(covariance)
    least = 1e-12 * np.maximum(np.abs(size).max(axis=1, keepdims=True), 1e-300)
    # Rebuild the covariance with positive eigenvalues.
    whole = np.einsum("nij,nj,nkj->nik", axis, np.maximum(size, least), axis)
    return np.asarray(np.linalg.cholesky(whole))


def _diagonal(variance: Floats) -> Floats:
    return np.asarray(variance[:, :, None] * np.eye(variance.shape[1]))


def _independent_noise(data: Readings, noise: NoiseAssumptions) -> Floats:
    """Return the covariance (n, axes, axes) of the mean readings from noise that averaging reduces.

    Quantization and 1/f noise are excluded.
    """
    own = data.own_covariance * noise.scale**2
    for part in (data.quantization, data.flicker):
        own = own if part is None else own - _diagonal(part)
    # If nothing else is there, rounding can leave a difference below 0.
    diagonal = np.einsum("nii->ni", own)
    return np.asarray(own + _diagonal(np.maximum(-diagonal, 0.0)))


def repeatability_of(data: Readings, noise: NoiseAssumptions) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Return roots of the covariance of the readings by noise that averaging reduces, and its origin.

    The results are the roots (n, axes, axes), with the covariance root · rootᵀ, the degrees of freedom (n,
    axes) of each variance, and the number (n, axes) of the estimate from which it comes; variances with
    equal numbers have a common error.
    """
    n, axes = data.mean.shape
    first = np.full(n, _POOLED) if data.pooled else 3 * np.arange(n) + _EACH
    dof = np.minimum(data.dof, noise.scale_dof)
    estimate = first[:, None] + np.arange(axes) if data.noise_known else np.full((n, axes), _UNSTATED)
    return _root(_independent_noise(data, noise)), np.repeat(dof[:, None], axes, axis=1), estimate


def _repeatability(data: Readings, noise: NoiseAssumptions, response: Floats) -> Source:
    roots, dof, estimate = repeatability_of(data, noise)
    stated = data.noise_known and bool(np.isinf(data.dof).all())
    mean, moves = _independent_noise(data, noise).mean(axis=0), _by_dwell(response, roots)
    u = float(np.sqrt(np.trace(mean) / data.axes))
    evaluated, note = (_STATED, "stated (reading_u_mg)") if stated else (_STATISTICAL, "")
    return Source(REPEATABILITY, *evaluated, u, moves, note, dof.ravel(), estimate.ravel(), mean)


def _flicker(data: Readings, response: Floats) -> Source:
    moves = np.einsum("pna,nak->pk", response, data.slow)
    variance = (data.slow**2).sum(axis=2).mean(axis=0)
    if data.flicker is not None and data.flicker.any():
        moves = np.concatenate([_by_dwell(response, _diagonal(np.sqrt(data.flicker))), moves], axis=1)
        variance = variance + data.flicker.mean(axis=0)
    kind: Kind = "A" if data.flicker_shown else "B"
    note = "none shown, no figure of the part"
    if variance.any():
        note = "shown by the dwells" if data.flicker_shown else "figure of the part"
    u = float(np.sqrt(variance.mean()))
    return Source(FLICKER, kind, "normal", u, moves, note, reading_mg2=np.diag(variance))


def _fixture(data: Readings, noise: NoiseAssumptions, fit: Fit, response: Floats) -> Source:
    """Return the source of uncertainty for the declared angles: fixture, and certificate of the stage."""
    sigma = np.where(np.isfinite(fit.data.fixture), fit.data.fixture, 0.0)
    if data.planar:
        moves = np.einsum("pna,na,n->pn", response, fit.tangent[:, :, 0], sigma)
    else:
        moves = np.zeros((len(response), 0))
    certified = np.einsum("pna,nak->pk", response, data.stage)
    u_rad = noise.sigma_rad
    if certified.shape[1]:
        # An error of the stage moves a reading by its length per rad.
        of_stage = (data.stage**2).sum(axis=(1, 2)) / (data.mean**2).sum(axis=1)
        u_rad = math.hypot(u_rad, math.sqrt(float(of_stage.mean())))
    free = not data.planar or data.free
    estimated = math.isfinite(noise.sigma_dof)
    note = "attitudes are free: none enters" if free else ""
    if not free and not data.fixture_stated:
        note = "estimated from the residual" if estimated else "not stated: angles count as exact"
    if certified.shape[1]:
        note = "; ".join(filter(None, ["errors of the stage by its certificate", note]))
    dof = np.repeat([noise.sigma_dof, np.inf], [moves.shape[1], certified.shape[1]])
    u, joined = None if free else math.degrees(u_rad), np.concatenate([moves, certified], axis=1)
    evaluated = _STATISTICAL if estimated else _STATED
    return Source(FIXTURE, *evaluated, u, joined, note, dof, _FIXTURE, unit="deg")


def _gravity(data: Readings, fit: Fit, parameters: int) -> Source:
    """Return the source of uncertainty for local gravity, which changes all scale factors by one factor.

    `parameters` is the number of parameters.
    """
    base = fit.values.base
    u = GRAVITY_HALF_MPS2 / math.sqrt(3)
    moves = np.zeros((parameters, 1))
    scales = [name.startswith("scale") for name in fit.data.model.names]
    moves[: len(base), 0] = -base * scales * u * 1000 / (data.gravity_mg * STANDARD_GRAVITY_MPS2)
    note = "all gains move alike: ratios and angles do not depend on it"
    return Source(GRAVITY, "B", "rectangular", u, moves, note, by_definition=True, unit="m/s²")


def _quantization(data: Readings, response: Floats) -> Source:
    variance = data.quantization
    if variance is None:
        variance = np.zeros(data.mean.shape)
    moves, u = _by_dwell(response, _diagonal(np.sqrt(variance))), float(np.sqrt(variance.mean()))
    note = "" if variance.any() else "the noise dithers it, or readings are averages"
    own = np.diag(variance.mean(axis=0))
    return Source(QUANTIZATION, "B", "rectangular", u, moves, note, reading_mg2=own)


def _temperature(data: Readings, noise: NoiseAssumptions, fit: Fit, response: Floats) -> Source:
    """Return the source of uncertainty for the unknown change of each bias with temperature.

    `response` (p, n, axes) is the derivative of the parameters by each reading. The size of the change is
    limited by the data sheet and by the residual.
    """
    axes = data.axes
    figure = VARIANTS[data.sensor].performance.bias_tempco_mg_per_c if data.sensor in VARIANTS else 0.0
    temperature = data.conditions.temperature_c
    moves, acts = np.zeros((len(response), axes)), None
    u, note = figure if figure else None, ""
    if temperature is None:
        note = "temperature not recorded"
    elif not figure:
        note = "no figure of the part: a coefficient is for trace to find"
    else:
        away = temperature - temperature.mean()
        columns = away[:, None, None] * np.eye(axes)
        # Part of the columns that the parameters do not explain, which the residual can show.
        _, left = _fitted(fit.white(columns), fit.jacobian)
        # Combine the prior of the data sheet with the information in the residual of this session.
        variance = 1 / (1 / figure**2 + (left**2).sum(axis=0))
        mean = variance * (fit.residual.ravel() @ left)
        # The fit leaves the change out, so it counts with its second moment; if the residual is larger than
        # the noise, the source of missing effects has the second moment of all effects.
        spread = np.sqrt(variance + (mean**2 if noise.extra_mg == 0 else 0.0))
        acts = columns * spread
        moves = np.einsum("pna,nab->pb", response, acts)
        u = float(np.sqrt((spread**2).mean()))
        note = f"dwells at {format_span(temperature.min(), temperature.max(), 1, '°C')}"
    return Source(TEMPERATURE, *_STATED, u, moves, note, acts_mg=acts, unit="mg/°C")


def _model(
    data: Readings,
    noise: NoiseAssumptions,
    fit: Fit,
    response: Floats,
    held: Sequence[int],
    unseen: Floats | None = None,
) -> Source:
    """Return the source of uncertainty for an incomplete model.

    `response` (p, n, axes) is the derivative of the parameters by each reading. The source covers a
    residual beyond the noise, the biases and skews with the indices `held`, which were taken as zero, and
    the `unseen` changes of the parameters along undetermined directions.
    """
    axes = data.axes
    extra = _by_dwell(response, np.tile(noise.extra_mg * np.eye(axes), (len(data), 1, 1)))
    figures = VARIANTS[data.sensor].performance if data.sensor in VARIANTS else None
    skew_u_rad = 0.0 if figures is None else figures.skew_u_rad
    # Indices of the biases among the axes, and of the skews among the base parameters.
    base = len(data.model.parameters)
    no_bias, no_skew = [k - base for k in held if k >= base], [k for k in held if k < base]
    offsets_mg = np.array(data.offset_mg[:axes])
    sizes = data.unseen_bias_mg
    biases = np.tile(np.diag(sizes)[:, no_bias], (len(data), 1, 1))
    skews = skew_u_rad * fit.base_columns[:, :, no_skew]
    missing = np.zeros((len(data), axes, 0))
    if noise.extra_mg > 0:
        missing = missing_effects(fit)
    acts = np.concatenate([biases, skews, missing], axis=2)
    # Change of the parameters by unseen biases, skews and missing effects.
    blind = np.einsum("pna,nak->pk", response, acts)
    notes, u, unstated = [], noise.extra_mg, "of a size that nothing states: not included"
    if noise.extra_mg > 0:
        notes.append("scatter beyond the noise within the dwells, and effects of the catalogue")
    if no_bias:
        letters = ", ".join("xyz"[axis] for axis in no_bias)
        size = f"{figures.initial_bias_mg:g} mg, figure of the part" if figures else unstated
        if offsets_mg[no_bias].any():
            numbers = join_words([f"{signed(mg, 1)} mg" for mg in offsets_mg[no_bias]])
            size += f"; offset registers {numbers}"
        notes.append(f"bias {letters} taken as zero ({size})")
    if no_skew:
        names = ", ".join(data.model.names[k].removeprefix("skew_") for k in no_skew)
        size = f"{figures.non_orthogonality_deg:g}° at most, figure of the part" if figures else unstated
        notes.append(f"skew {names} taken as zero ({size})")
    others = np.concatenate([skews, missing], axis=2)
    u = math.hypot(
        u, float(sizes[no_bias].max(initial=0.0)), math.sqrt(float((others**2).sum(axis=2).mean()))
    )
    statistical = noise.extra_mg > 0 and not acts.any()
    stated = figures is not None or not acts.shape[2]
    alone = np.zeros((len(response), 0)) if unseen is None else unseen
    widths = [extra.shape[1], acts.shape[2], alone.shape[1]]
    return Source(
        MODEL,
        *(_STATISTICAL if statistical else _STATED),
        u if stated or noise.extra_mg else None,
        np.concatenate([extra, blind, alone], axis=1),
        "; ".join(notes) or "the residual shows no more than the noise",
        np.repeat([noise.dof, np.inf, np.inf], widths),
        np.repeat([_RESIDUAL, _POOLED, _POOLED], widths),
        noise.extra_mg**2 * np.eye(axes),
        acts_mg=acts if acts.any() else None,
        # A further reading has the same biases; the influence of skews and effects depends on its pose.
        further_mg=np.pad(biases[0], ((0, 0), (extra.shape[1], others.shape[2] + alone.shape[1]))),
    )


ROUNDING = 1e-10
"""Contribution of a source to the standard uncertainty of a quantity, relative to this uncertainty, below
which the contribution is a rounding error and counts as zero."""


class BudgetRow(JsonRecord):
    """Contribution of one source to the uncertainty of one quantity.

    The JSON document is one row of `budget`.

    Attributes
    ----------
    source, kind, distribution : str
        Name, type (`A` or `B`) and distribution of the source.
    u, unit : float or None, str
        Standard uncertainty of the source itself and its unit; `u` is None if unknown.
    sensitivity : float or None
        `contribution` divided by `u` of the source. For a source with an independent error in each dwell it
        is the root of the sum of the squared sensitivities to each. None if `u` is unknown or zero.
    contribution : float
        Standard uncertainty of the quantity from this source, in the unit of the quantity.
    dof : float
        Effective degrees of freedom of the contribution; inf if unlimited.
    note : str
        Remark on the source; empty without one.
    share : float
        Share of the source in the variance of the quantity; the shares of a budget add up to 1.
    """

    source: str
    kind: str = field(metadata=key("type"))
    distribution: str
    u: float | None
    unit: str
    sensitivity: float | None
    contribution: float
    dof: float
    share: float
    note: str = ""


def budget_of(sources: Sources, gradient: Floats, reading: Floats | None = None) -> tuple[BudgetRow, ...]:
    """Return the uncertainty budget of one quantity: a row for each source with its share.

    Parameters
    ----------
    gradient : (m, p) float
        Derivative of m values by the parameters in natural units; the quantity is their root mean square.
    reading : (m, axes) float, optional
        Derivative of the m values by one further reading, per mg; without it only the parameters count.
    """
    total, _ = sources.uncertainty(gradient, reading)
    rows = []
    for source in sources.each:
        parts = source.parts(gradient, reading)
        contribution = math.sqrt(sum(part[2] for part in parts))
        if contribution < ROUNDING * total:
            contribution = 0.0
        of_source = source.name, source.kind, source.distribution, source.u, source.unit
        sensitivity = contribution / source.u if source.u else None
        share = 0.0 if source.by_definition or total == 0 else (contribution / total) ** 2
        rows.append(BudgetRow(*of_source, sensitivity, contribution, dof_of(parts), share, source.note))
    return tuple(rows)


_DESCRIBED = 1e-6
"""Residual of a column after a fit by the columns of the parameters, relative to the column, below which
the parameters describe it completely."""
_LARGEST_FACTOR = 1e4


def missing_effects(fit: Fit) -> Floats:
    """Return the changes (n, axes, k) of the readings by effects outside the model, in mg.

    Each of the k columns is one standard uncertainty of an independent combination of effects.

    Parameters
    ----------
    fit : Fit
        Fit of the incomplete model. The noise of its readings has to include the scatter of the residual,
        so that random scatter is considered as the alternative to missing effects.
    """
    columns, _, remaining = _shown_columns(fit, _columns(fit))
    if not columns.shape[2]:
        return columns
    _, residual = _fitted(fit.residual.ravel(), fit.jacobian)
    # In the basis of the singular vectors the amplitudes are independent.
    left, singular, right = np.linalg.svd(remaining, full_matrices=False)
    along = left.T @ residual
    factor = _factor(singular**2, along**2)
    # Directions of θ that the residual does not show keep the prior s².
    precision = factor**-2 + singular**2
    mean = right.T @ (singular * along / precision)
    # Second moment of the amplitudes in the basis of the columns.
    moment = factor**2 * np.eye(columns.shape[2])
    moment += (right.T * (1 / precision - factor**2)) @ right + np.outer(mean, mean)
    # Root of the second moment: independent inputs at one standard uncertainty each.
    values, vectors = np.linalg.eigh(moment)
    return np.asarray(columns @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def missing_curvature(fit: Fit, inflation: float = 1.0) -> Floats:
    """Return the covariance (p, p) of a fit's parameters by one effect of the reading that its model lacks.

    An effect too weak to be found still moves the parameters: a cubic of 0.5 mg/g³ moves a gain by 0.04 %,
    and several sessions know the gain better than that. The alternatives to the fitted model add one
    amplitude of the catalogue's effects of the reading. Even prior odds, divided evenly among the
    amplitudes, state that one is missing. The prior of an amplitude is normal about zero, with the typical
    size as its standard deviation. The parameters remain the values of the fitted model, so that each
    alternative counts with the second moment of its amplitude. Effects of time and temperature are left
    out, since the parameters describe the conditions of the session.

    Parameters
    ----------
    inflation : float
        Factor on the variance of the noise.
    """
    # A change of the readings by an amplitude of typical size moves the parameters.
    _, moved, remaining = _shown_columns(fit, _columns(fit, ("reading",)))
    if not remaining.shape[1]:
        return moved @ moved.T
    information = (remaining**2).sum(axis=0) / inflation
    score = remaining.T @ fit.residual.ravel() / inflation
    variance = 1 / (1 + information)
    # Bayes factor of each model with one more amplitude, against the fitted model.
    odds = np.exp(np.minimum(0.5 * score**2 * variance, 500.0)) * np.sqrt(variance) / len(score)
    moment = odds / (1 + odds.sum()) * (variance + (variance * score) ** 2)
    return np.asarray((moved * moment) @ moved.T)


def _columns(fit: Fit, covariates: tuple[str, ...] | None = None) -> Iterator[Floats]:
    """Yield the changes (n, axes, d) of the readings by each effect of the catalogue at its typical size.

    An effect has d amplitudes. Effects that cannot act on this session are omitted. With `covariates`, only
    effects of the sensor that depend on exactly these, and that the base model lacks, are included.
    """
    data = fit.data
    # A choice is a discrete number (a dwell, a degree): the scatter of the readings covers these.
    for term in typical_terms(data.model.part, data.axes, data.conditions, ("dwell", "cycles", "degree")):
        kind = type(term.effect)
        if covariates is not None and (
            kind.covariates != covariates or kind.in_base or kind.enters is not Enters.READING
        ):
            continue
        yield fit.candidate(term) * np.array([term.effect.parameters[k].typical for k in term.amplitudes])


def _shown_columns(fit: Fit, changes: Iterable[Floats]) -> tuple[Floats, Floats, Floats]:
    """Return the changes of the readings that the parameters of a fit do not describe completely.

    `changes` are arrays (n, axes, d). Returned are k of their columns (n, axes, k), the changes (p, k) of
    the parameters that describe them best, and the remaining part (rows, k), whitened.
    """
    columns = np.concatenate([*changes, np.zeros((*fit.data.mean.shape, 0))], axis=2)
    white = fit.white(columns)
    # Only the part that the parameters do not describe shows in the residual.
    moved, remaining = _fitted(white, fit.jacobian)
    shown = np.linalg.norm(remaining, axis=0) > _DESCRIBED * np.linalg.norm(white, axis=0)
    return columns[:, :, shown], moved[:, shown], remaining[:, shown]


def _fitted(rows: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Return the coefficients (p, …) of a fit of rows (m, …) by columns (m, p), and the residual."""
    found = np.asarray(np.linalg.lstsq(columns, rows, rcond=1e-9)[0], dtype=float)
    return found, rows - columns @ found


def _factor(strength: Floats, power: Floats) -> float:
    """Return the factor, 1 to 10⁴, on the prior sizes of independent amplitudes, by maximum likelihood.

    Parameters
    ----------
    strength, power : (k,) float
        Squares of the singular values of the effects' whitened columns, and of the residual along the
        singular vectors.
    """
    from scipy.optimize import minimize_scalar

    def deviance(log_factor: float) -> float:
        variance = 1 + math.exp(2 * log_factor) * strength
        return float((np.log(variance) + power / variance).sum())

    bounds = (0.0, math.log(_LARGEST_FACTOR))
    return math.exp(float(minimize_scalar(deviance, bounds=bounds, method="bounded").x))


PLACES = 72
"""Number of angles of a turn over which the uncertainty of the calibrated angle is averaged."""


@dataclass(frozen=True)
class ShownAngle:
    """Derivatives of the calibrated angle by the parameters and by a reading, at m angles of the turn.

    Attributes
    ----------
    gradient : (m, p) float
        Degrees per unit of the parameters: base parameters and biases in natural units if the constructor
        `around` made the object, all parameters in units of the fit if `at_dwells` did.
    reading : (m, 2) float
        Degrees per mg of the reading.
    """

    gradient: Floats
    reading: Floats

    @classmethod
    def around(cls, fit: Fit) -> ShownAngle:
        """Return the derivatives of the calibrated angle at angles all around the turn.

        They are the derivatives with respect to the base parameters and the biases of a fit. With readings
        U_x and U_y, gravity G and biases b, the angle ψ is atan2(v, u) with u = (U_x − b_x)/(G K_x) and
        v = ((U_y − b_y)/(G K_y) − u sin Δφ)/cos Δφ. The calibrated angle is α − ψ with the start angle α. A
        session without declared angles has no start angle, and the calibrated angle is then the angle
        between gravity and X.
        """
        gradient = gradient_of_base(fit.values.base, zero=bool(fit.data.visible[0]))
        return cls(gradient, -np.degrees(_by_reading(fit.values.base, _around()) / fit.data.gravity_mg))

    @classmethod
    def at_dwells(cls, fit: Fit) -> ShownAngle:
        """Return the derivatives of the calibrated angle at the dwells of a planar fit.

        They are the derivatives with respect to all parameters of the fit (base parameters, then the values
        of terms) and with respect to the reading.
        """
        psi = fit.values.base[0] + fit.turn_rad + fit.values.attitude
        slope = _by_reading(fit.values.base, psi) / fit.data.gravity_mg
        gradient = np.einsum("na,nap->np", slope, fit.columns)
        return cls(np.degrees(gradient), -np.degrees(slope))

    def variances(self, covariance: Floats, reading_mg2: Floats) -> Floats:
        """Return the variance (m,) of the calibrated angle in degrees² at each of the m angles.

        `covariance` (p, p) is of the parameters, and `reading_mg2` (2, 2) of a reading.
        """
        # gᵀ C g at each place, for the parameters and for the reading.
        by_parameters = np.einsum("mp,pq,mq->m", self.gradient, covariance, self.gradient)
        by_reading = np.einsum("ma,ab,mb->m", self.reading, reading_mg2, self.reading)
        return np.asarray(by_parameters + by_reading)


def gradient_of_base(base: Floats, *, zero: bool) -> Floats:
    """Return the derivative (PLACES, 6) of the calibrated angle by α, K_x, K_y, Δφ and both biases.

    It is in degrees per natural unit; the biases are in units of gravity.

    Parameters
    ----------
    base : (4,) float
        Base parameters of the plane: α, K_x, K_y, Δφ.
    zero : bool
        True if angles are declared, so that α is part of the calibrated angle; otherwise its derivative is
        0.
    """
    psi = _around()
    gradient = np.einsum("ma,map->mp", _by_reading(base, psi), columns_in_plane(base, psi - base[0]))
    if not zero:
        gradient[:, 0] = 0.0
    return np.asarray(np.degrees(gradient))


def columns_in_plane(base: Floats, turn_rad: Floats) -> Floats:
    """Return the derivative (m, 2, 6) of m readings of a turn by α, K_x, K_y, Δφ and both biases.

    Readings and biases are in local gravity, angles in rad. `base` (4,) are α, K_x, K_y and Δφ; the stage
    has turned the part by `turn_rad` (m,).
    """
    by_base = PlanarTurn(1.0).columns(base, np.zeros(len(turn_rad)), turn_rad)
    return np.concatenate([by_base, np.tile(np.eye(2), (len(turn_rad), 1, 1))], axis=2)


def _around() -> Floats:
    return np.linspace(0, 2 * math.pi, PLACES, endpoint=False)


def _by_reading(base: Floats, psi: Floats) -> Floats:
    """Return the derivative (m, 2) of the angle ψ (m,) by each reading, in rad per local gravity.

    `base` (4,) are the base parameters of the plane.
    """
    _, k_x, k_y, skew = base
    by_x = -(np.sin(psi) + np.cos(psi) * math.tan(skew)) / k_x
    return np.asarray(np.stack([by_x, np.cos(psi) / math.cos(skew) / k_y], axis=1))
