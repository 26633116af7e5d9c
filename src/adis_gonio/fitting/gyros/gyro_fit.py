"""Method `gyro`: weighted least squares for zero rates, g-sensitivity, scale factors and directions.

The model is the gyros' base model (`MeanRate`) with the effects of a physical calibration: `g_sensitivity`
if poses show it, `gyro_scale` and `gyro_misalignment` if turns show them. If the force along an axis
changes steadily in the order of the poses, a drift of the zero rate imitates a g-sensitivity. Models with
and without a drift (`DRIFTS`) are therefore compared by their prediction of left-out dwells. The result
comes from the best model; its u includes the differences to the other models, weighted by their odds. A
parameter that the dwells and turns do not determine is fixed at the value of a perfect gyro and is listed
in the result. A result states gains and misalignments as the scale factors K and directions D in rate = K D
ω, with the true rate of turn ω, however large the errors are.

The directions D of the gyros (rows, in the accelerometers' frame) are a rotation of the whole triad and the
misalignment of the three axes with one another: D = S R with a symmetric S (polar decomposition). The
mounting of a part or its board causes the rotation vector. The skews (90° minus the angle between two
axes) belong to the triad itself and do not depend on the frame.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, central_differences, solvable
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import Value, effective_dof
from adis_gonio.calibrate.gyro_calibration import UNIT_OF, GyroCalibration, gyro_directions
from adis_gonio.fitting import determination
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import GYRO, Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fitting.fit_result import FittedParameters
from adis_gonio.fitting.gyros.gyro_readings import gyro_readings_of
from adis_gonio.model.effects import AXES, Effect, effect
from adis_gonio.model.measurement import SKEW_AXES
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate.calibration import Calibration

METHOD = "gyro"
CALIBRATED = ("g_sensitivity", "gyro_scale", "gyro_misalignment")
"""Effects of the catalogue that a gyro calibration corrects."""
_EFFECTS = tuple(effect(name, AXES) for name in CALIBRATED)
DRIFTS = {
    "gyro with a drift with time": effect("gyro_drift", AXES, steps=0),
    "gyro with a drift from dwell to dwell": effect("gyro_drift", AXES, steps=1),
    "gyro with a warm-up": effect("gyro_warm_up", AXES),
}
"""Drifts of the zero rate that may imitate a g-sensitivity, by the name of the model with the drift."""
BEGIN_TAU = 1 / 3
"""Time constant of a warm-up, as a share of the session's length."""
LIMIT = 0.1
"""Largest standard uncertainty with which a parameter counts as determined: 0.1 dps/g of a g-sensitivity,
0.1 of a gain (1 is perfect), 0.1 rad of a misalignment."""
_NOTHING = 1e-14
"""Smallest eigenvalue of the information matrix, relative to the largest, that is not a rounding error."""
TIME_BASE_U = 50e-6 / math.sqrt(3)
"""Relative standard uncertainty of the samples' times: a crystal of ±50 ppm, uniform (an estimate, D).
Times are the host's, so the chip's own clock does not count. An angle is rate times time: all gains
share this error."""
LARGEST_SCATTER = 1e4
"""Largest factor on the variance of the noise by which dwells may scatter, by the prior (D)."""
LARGEST_DPS = 10.0
"""Zero rate in °/s above which another cause than the gyro is more probable: ten times the typical zero
rate of this class (D)."""


def gyro_doubts(session: Session, zero_dps: Sequence[float]) -> tuple[str, ...]:
    """Return reasons to doubt the gyros of a session: large zero rates, or constant samples.

    Parameters
    ----------
    zero_dps : (3,) float
        Fitted zero rates, in °/s.
    """
    doubts = []
    for axis, zero in zip(AXES, zero_dps, strict=True):
        if abs(zero) > LARGEST_DPS:
            doubts.append(
                f"gyro_bias_{axis} is {zero:.4g} °/s, and gyros of this class have about 1 °/s: did the"
                f" part turn, is the gyro broken, or the unit another (here {session.gyro_unit})?"
            )
    samples = [dwell.gyro for dwell in session.dwells if dwell.gyro is not None and len(dwell) > 1]
    for k, axis in enumerate(AXES):
        if samples and np.ptp(np.concatenate([rows[:, k] for rows in samples])) == 0:
            doubts.append(
                f"gyro {axis} reads {samples[0][0, k]:g} in every sample, without any noise: is it"
                " connected, and is the column a gyro?"
            )
    return tuple(doubts)


MISALIGNMENTS = tuple((k, j) for k in range(3) for j in range(3) if k != j)


def rotation_and_skews_deg(misalignment_deg: Floats) -> Floats:
    """Return the rotation vector of the gyro triad and its three skews xy, xz, yz, in degrees, (6,).

    The argument (3, 3) is the misalignment of each gyro (row) towards each axis (column), in degrees.
    """
    from scipy.spatial.transform import Rotation

    rows = gyro_directions(misalignment_deg)
    left, _, right = np.linalg.svd(rows)
    # Rows of the nearest square triad; its transpose rotates the axes of the frame onto it.
    vector = Rotation.from_matrix((left @ right).T).as_rotvec()
    skews = [math.asin(float(rows[i] @ rows[j])) for i, j in SKEW_AXES]
    return np.asarray(np.degrees(np.concatenate([vector, skews])))


def alignment(parameters: Mapping[str, Value], covariance: Floats) -> dict[str, Value] | None:
    """Return rotation and skews of the gyro triad in degrees with u, from the gyros' misalignments.

    The names are `triad_rotation_x …` and `gyro_skew_xy …`.

    Parameters
    ----------
    parameters : mapping of str to Value
        Parameters of a gyro fit, by name.
    covariance : (p, p) float
        Covariance of these parameters, in their order.

    Returns
    -------
    mapping or None
        None unless all six misalignments are determined.
    """
    names = [f"gyro_misalignment_{AXES[k]}{AXES[j]}" for k, j in MISALIGNMENTS]
    if any(name not in parameters for name in names):
        return None
    rows = [list(parameters).index(name) for name in names]
    # Unit matrices of the six elements off the diagonal, in the order of the names.
    own = np.eye(9).reshape(9, 3, 3)[[3 * k + j for k, j in MISALIGNMENTS]]
    misalignments = np.einsum("p,pij->ij", [parameters[name].value for name in names], own)
    slope = central_differences(rotation_and_skews_deg, misalignments, 1e-4, own)
    # Propagate the covariance of the six angles to rotation and skews.
    variance = np.diag(slope @ covariance[np.ix_(rows, rows)] @ slope.T)
    dof = min(parameters[name].dof or math.inf for name in names)
    stated = [f"triad_rotation_{axis}" for axis in AXES]
    stated += [f"gyro_skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES]
    found = zip(stated, rotation_and_skews_deg(misalignments).tolist(), variance.tolist(), strict=True)
    return {name: Value(value, math.sqrt(max(u2, 0.0)), "deg", dof) for name, value, u2 in found}


class GyroFit(FittedParameters, kw_only=True):
    """Result of a fit of the gyros: their parameters with covariance, residuals and warnings.

    The parameters are `gyro_bias_x …` (dps), and the determined ones of `g_sensitivity_xy …` (dps/g; the
    gyro, the axis of force), `gyro_scale_x …` (1 is perfect) and `gyro_misalignment_xy …` (deg; the gyro,
    the axis of misalignment). Undetermined ones are fixed at the values of perfect gyros.

    Attributes
    ----------
    residual_dps : (n, 3) float
        Reading minus model of each interval (dwell or turn) used.
    turns : int
        Number of turns among the intervals.
    doubts : tuple of str
        Reasons to doubt the gyros, or that they were at rest; they are also in `warnings`.
    inflation : mapping of str to float
        Factor on the noise variance of each gyro by its residual, by its axis (`scatter_factors`).
    fit : Fit or None
        The fitted model on its readings.
    scores : mapping of str to mapping
        Prediction errors in °/s of the models `zero rate`, `gyro` and `gyro` with a drift, on the same
        dwells, left out one by one: rms over all axes, largest error, and rms by axis, as in JSON.
    """

    method: str = METHOD
    covariance: Floats
    residual_dps: Floats
    turns: int
    doubts: tuple[str, ...] = ()
    inflation: dict[str, float] = field(default_factory=dict)
    scores: dict[str, dict[str, Any]] = field(default_factory=dict)
    fit: Fit | None = field(default=None, compare=False)

    part = GYRO

    @cached_property
    def triad(self) -> dict[str, Value] | None:
        """Rotation of the gyro triad against the accelerometers and skews between the gyros, in degrees.

        The names are `triad_rotation_x …` and `gyro_skew_xy …`. None if a misalignment is undetermined.
        """
        return alignment(self.parameters, self.covariance)

    @property
    def residual_rms_dps(self) -> float:
        """Root mean square of the residuals of all intervals and axes, in °/s."""
        return float(np.sqrt((self.residual_dps**2).mean()))

    def __repr__(self) -> str:
        shown = ", ".join(f"{name} {self[name]}" for name in self.names[:3])
        return f"GyroFit({self.extent}, {shown})"

    @property
    def extent(self) -> str:
        """Text with the numbers of fitted dwells and turns, such as `14 dwells and 3 turns`."""
        dwells = counted(len(self.positions) - self.turns, "dwell")
        return f"{dwells} and {counted(self.turns, 'turn')}" if self.turns else dwells

    def calibration(self) -> GyroCalibration:
        """Return the calibration that converts readings to rates of turn, for the chip's present offsets.

        Raises
        ------
        FitError
            A zero rate is not determined.
        SessionError
            A write of gyro offsets was interrupted, so that only the sensor knows its offsets.
        """
        return self.calibration_as_recorded().as_written(self.provenance)

    def calibration_as_recorded(self) -> GyroCalibration:
        """Return the calibration for the offsets of the gyros while the session was recorded."""
        return GyroCalibration.of(self.parameters, (self.names, self.covariance), where=self.provenance)

    @property
    def doubts_of_offsets(self) -> tuple[str, ...]:
        """Reasons not to write offsets by this fit: `doubts`, and a residual above the noise."""
        large = _larger(self.inflation)
        own = (f"the gyros' residual is larger than their noise ({large})",) if large else ()
        return (*own, *self.doubts)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio fit --sensor-part gyro --json` prints."""
        return super().as_dict() | json_object(
            part=self.part,
            scores=self.scores,
            residual_rms_dps=self.residual_rms_dps,
            angle_error_deg=None,
            noise_inflation=self.inflation,
            positions_used=len(self.positions) - self.turns,
            turns_used=self.turns,
            time_base_u=TIME_BASE_U if self.turns else None,
            **{} if self.triad is None else {"triad": self.triad},
        )


@solvable
def fit_gyro(session: Session, accelerometers: Calibration | None = None) -> GyroFit:
    """Fit the gyros of a session to all its dwells and turns except `check` dwells.

    Parameters
    ----------
    accelerometers : Calibration, optional
        Calibration of the accelerometers of the session's sensor, for directions of gravity that the
        session does not determine.

    Raises
    ------
    DataError
        The session has no gyros, or their unit is not known.
    FitError
        There is no dwell for fitting.
    UsageError
        The calibration is of another sensor, or states no uncertainties.
    """
    return session.once(_fit_session) if accelerometers is None else _fit_session(session, accelerometers)


def _fit_session(session: Session, accelerometers: Calibration | None = None) -> GyroFit:
    readings = gyro_readings_of(session, accelerometers)
    try:
        result = fit_gyro_readings(readings.training)
    except FitError as error:
        raise FitError(f"{session.source}: {error}" if session.source else str(error)) from error
    doubts = gyro_doubts(session, [result[f"gyro_bias_{axis}"].value for axis in AXES])
    return replace(
        result,
        doubts=doubts,
        warnings=(*session.notes, *doubts, *result.warnings),
        overrides=session.facts.get("overrides", {}),
        provenance=provenance_of(session),
    )


def fit_gyro_readings(data: Readings, *, scored: bool = True) -> GyroFit:
    """Fit the gyro model to readings; `scored=False` omits the models with a drift and the scores.

    The scores are the errors with which a model predicts dwells left out of the fit one at a time. They
    take most of the time.
    """
    if len(data) < 1:
        raise FitError("no dwell holds samples of the gyros")
    models = {METHOD: _Model.of(data, _EFFECTS)}
    if scored:
        drifts = {name: _Model.of(data, (*_EFFECTS, drift)) for name, drift in DRIFTS.items()}
        models |= {name: one for name, one in drifts.items() if one.fit.dof > 0}
    many = scored and len(data) > 2
    errors = _left_out({"zero rate": _Model.of(data, ()), **models}) if many else {}
    models = {name: one.settled() for name, one in models.items()}
    odds = _odds({name: errors[name] for name in models if name in errors})
    best = models[METHOD]
    # The best model that determines all that the model without a drift determines.
    for name in sorted(odds, key=lambda name: -odds[name]):
        if set(best.determined[0]) <= set(models[name].determined[0]):
            best = models[name]
            break
    names, values, covariance, known = best.determined
    for name, share in odds.items():
        other = dict(zip(*models[name].reported[:2], strict=True))
        apart = np.array([other[key] for key in names]) - values
        covariance = covariance + share / sum(odds.values()) * np.outer(apart, apart)
    fit, inflation = best.fit, {axis: own for axis, (own, _) in best.inflation.items()}
    variances = np.column_stack([np.maximum(np.diag(covariance), known), known])
    parameters = {}
    for name, value, (whole, sure) in zip(names, values.tolist(), variances.tolist(), strict=True):
        dof = effective_dof([(whole - sure, best.inflation[_gyro_of(name)][1]), (sure, math.inf)])
        parameters[name] = Value(value, math.sqrt(whole), UNIT_OF[name], dof)
    temperature = data.conditions.temperature_c
    return GyroFit(
        parameters=parameters,
        covariance=covariance,
        chi2=fit.chi2,
        dof=int(fit.dof),
        residual_dps=fit.misfit,
        positions=tuple(data.position.tolist()),
        turns=len(data) - len(best.rests),
        warnings=(
            *data.notes,
            *_warnings(data, best.lost, inflation),
            *_drifting(models, best, covariance, errors),
        ),
        undetermined=tuple(best.lost),
        inflation=inflation,
        reference_temperature_c=None if temperature is None else float(temperature.mean()),
        scores={name: _score(one) for name, one in errors.items()},
        fit=fit,
    )


# -- determined parameters --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Model:
    """Terms of a gyro calibration, the readings to fit, and a mask of the free parameters.

    Attributes
    ----------
    data, terms : Readings, tuple of NamedTerm
        Readings to fit, and effects in addition to the zero rates.
    names : tuple of str
        Names of the base parameters, then of the parameters of the terms.
    free : (p,) bool
        True for parameters that are fitted; the others are fixed at the values of perfect gyros.
    """

    data: Readings
    terms: tuple[NamedTerm, ...]
    names: tuple[str, ...]
    free: NDArray[np.bool_]

    @classmethod
    def of(cls, data: Readings, effects: Sequence[Effect]) -> _Model:
        """Build the model from the effects with recorded conditions, and find its free parameters."""
        seen = [one for one in effects if not data.conditions.lacks(one.needs)]
        terms = tuple(NamedTerm(one.name, (), 0.0, one) for one in seen)
        names = (*data.model.names, *(p.name for term in terms for p in term.effect.parameters))
        return cls(data, terms, names, np.ones(len(names), dtype=bool)).narrowed({})

    def narrowed(self, inflation: Mapping[str, float]) -> _Model:
        """Return a copy in which only parameters that the readings determine are free.

        `inflation` has the factor on the noise variance of a gyro, by its axis; 1 by default. The parameter
        with the largest uncertainty is fixed, and the others are examined again, until all uncertainties
        are below `LIMIT`. A fixed parameter may still be wrong by `LIMIT`, so that another parameter is not
        determined either if only their sum is. The zero rates are always free. All gyros are examined
        together, because the error of a turn's reference is common to them.
        """
        free = self.free.copy()
        # Columns scaled so that `LIMIT` holds for all of them alike.
        rows = self.begun.jacobian * _natural(self.names)
        factor = np.array([inflation.get(_gyro_of(name), 1.0) for name in self.names])
        examined = np.arange(len(self.names)) >= len(self.data.model.parameters)
        while True:
            held = np.where(free, 0.0, factor / LIMIT**2)
            # Variances of the parameters are the diagonal of the inverse information, by its eigenvalues.
            values, vectors = np.linalg.eigh(rows.T @ rows + np.diag(held))
            known = np.maximum(values, _NOTHING * max(float(values.max(initial=0.0)), 1.0))
            u2 = np.where(free & examined, factor * (vectors**2 / known).sum(axis=1), 0.0)
            if not u2.max(initial=0.0) > LIMIT**2:
                return self if (free == self.free).all() else replace(self, free=free)
            free[int(u2.argmax())] = False

    @cached_property
    def begun(self) -> Fit:
        """Starting point of the fit: all parameters have the values of perfect gyros."""
        base = Fit.begin(self.data, with_prior=False)
        tau = max(BEGIN_TAU * float(np.ptp(self.data.conditions.time_s)), 1.0)
        values = [[tau if p.shape else 0.0 for p in term.effect.parameters] for term in self.terms]
        return base.with_terms(self.terms, [np.array(own) for own in values])

    @cached_property
    def fit(self) -> Fit:
        """The model with its free parameters fitted to the readings."""
        return self.begun.refit(within=np.eye(len(self.names))[:, self.free])

    def settled(self) -> _Model:
        """Return a copy in which parameters are fixed that the noise determines but not the residual."""
        narrower = self.narrowed({axis: own for axis, (own, _) in self.inflation.items()})
        return self if narrower is self else narrower.settled()

    @cached_property
    def inflation(self) -> dict[str, tuple[float, float]]:
        """Factor on the noise variance of each gyro by the residuals, and its dof, by axis."""
        axes = np.array([_gyro_of(name) for name in self.names])[self.free]
        dof = len(self.data) - np.array([(axes == axis).sum() for axis in AXES])
        found = scatter_factors((self.fit.residual**2).sum(axis=0), np.maximum(dof, 0))
        limit = self.data.noise_dof
        return {axis: (own, min(free, limit)) for axis, (own, free) in zip(AXES, found, strict=True)}

    @cached_property
    def reported(self) -> tuple[list[str], Floats, Floats, Floats]:
        """Names, values (p,), covariance (p, p) and known variances (p,) of the parameters of a result.

        The covariance follows the residual if it is larger than the noise. If the model has a drift, a zero
        rate is its mean over the dwells. Fixed parameters have the values of perfect gyros. The covariance
        includes the known variances, which the readings do not estimate: those by the typical sizes of
        fixed parameters and by the time base.
        """
        factor = np.sqrt([self.inflation.get(_gyro_of(name), (1.0, 0.0))[0] for name in self.names])
        mean = np.eye(len(self.names))
        mean[:3, ~self.stated] = self.fit.columns[self.rests].mean(axis=0)[:, ~self.stated]
        information = self.fit.jacobian.T @ self.fit.jacobian
        covariance = determination.covariance(information, self.free, np.zeros((len(mean), 0)))
        own = [(p.typical, not p.shape) for term in self.terms for p in term.effect.parameters]
        typical, linear = np.array([(0.0, True)] * (len(mean) - len(own)) + own).T
        # Shift of the free parameters if a fixed parameter has its typical size.
        shift = mean @ covariance @ (information * np.where(self.free | ~self.stated, 0.0, typical))
        covariance = mean @ (covariance * np.outer(factor, factor)) @ mean.T
        # A drift is proportional to its amplitudes, and not to its time constant.
        values = mean @ (self.fit.values.parameters * linear)
        names, stated, covariance = stated_parameters(self.names, values, covariance, self.stated)
        _, _, known = stated_parameters(self.names, values, shift @ shift.T, self.stated)
        # All gains share the error of the time base.
        gains = np.where([name.startswith("gyro_scale_") for name in names], TIME_BASE_U * stated, 0.0)
        known += np.outer(gains, gains)
        return names, stated, covariance + known, np.diag(known)

    @cached_property
    def determined(self) -> tuple[list[str], Floats, Floats, Floats]:
        """The entries of `reported` for the parameters that the readings determine."""
        names, values, covariance, known = self.reported
        kept = np.flatnonzero(self.free[self.stated])
        return [names[k] for k in kept], values[kept], covariance[np.ix_(kept, kept)], known[kept]

    @cached_property
    def stated(self) -> NDArray[np.bool_]:
        """Mask (p,) of the parameters that a result states: all except the parameters of a drift."""
        own = [term.label in CALIBRATED for term in self.terms for _ in term.effect.parameters]
        return np.array([True] * (len(self.names) - len(own)) + own)

    @property
    def rests(self) -> NDArray[np.intp]:
        """Rows of the dwells at rest."""
        rate = self.data.conditions.rate_dps
        return np.flatnonzero(np.ones(len(self.data), dtype=bool) if rate is None else ~rate.any(axis=1))

    @property
    def lost(self) -> list[str]:
        """Names of the parameters that the readings do not determine, as a result reports them."""
        return [_stated_name(self.names[k]) for k in np.flatnonzero(self.stated & ~self.free)]


def _gyro_of(name: str) -> str:
    """Return the letter of the gyro to which a parameter belongs, such as x for `g_sensitivity_xy`.

    For a parameter that all gyros share the result is another letter, which is no axis.
    """
    return name.rsplit("_", 1)[-1][0]


def _natural(names: Sequence[str]) -> Floats:
    """Return the factor (p,) from the unit of `LIMIT` to the unit of each parameter: 180/π or 1."""
    return np.array([math.degrees(1.0) if "misalignment" in name else 1.0 for name in names])


# -- parameters of a result -------------------------------------------------------------------------------

_STATED = {"gyro_scale_error": "gyro_scale"}
"""Name of a parameter in results, by its name in the catalogue, if both differ."""


def _stated_name(name: str) -> str:
    stem, axes = name.rsplit("_", 1)
    return f"{_STATED.get(stem, stem)}_{axes}"


def stated_parameters(
    names: Sequence[str], values: Floats, covariance: Floats, free: NDArray[np.bool_] | None = None
) -> tuple[list[str], Floats, Floats]:
    """Return names, values and covariance of the free parameters, as a result reports them.

    Scale errors become scale factors K, misalignments become directions D.

    Parameters
    ----------
    values, covariance : (p,) float, (p, p) float
        Fitted parameters of the base model and the effects, in the order of `names`.
    free : (p,) bool, optional
        True for determined parameters; by default for all.
    """
    kept = np.flatnonzero(np.ones(len(values)) if free is None else free)
    slope = central_differences(
        lambda changed: gains_and_directions(names, changed), values, 1e-6, np.eye(len(values))[kept]
    )
    stated = slope @ covariance[np.ix_(kept, kept)] @ slope.T
    found = gains_and_directions(names, values)
    return [_stated_name(names[int(k)]) for k in kept], found[kept], stated[np.ix_(kept, kept)]


def gains_and_directions(names: Sequence[str], values: Floats) -> Floats:
    """Convert fitted scale errors and misalignments to scale factors K and misalignments of D.

    `values` (p,) are all parameters; the others are unchanged.

    Gyro i with the fitted scale error e and misalignments m_p towards the other axes p reads (c + e) Ω_i +
    Σ sin m_p Ω_p, with the true rates Ω and c² = 1 − Σ sin² m_p. The length of the vector (c + e, sin m_p,
    …) is its scale factor K, and the direction of this vector gives its misalignments.
    """
    out = values.copy()
    at = {name: k for k, name in enumerate(names)}
    for axis in AXES:
        scale = at.get(f"gyro_scale_error_{axis}")
        if scale is None:
            continue
        angles = [k for name, k in at.items() if name.startswith(f"gyro_misalignment_{axis}")]
        sines = np.sin(np.radians(values[angles]))
        # Length and direction of the row (c + e, sin m_p, …).
        along = math.sqrt(max(1 - float(sines @ sines), 0.0)) + float(values[scale])
        out[scale] = gain = math.hypot(along, float(np.hypot.reduce(sines)))
        out[angles] = np.degrees(np.arcsin(sines / gain))
    return out


# -- scores and warnings ----------------------------------------------------------------------------------


def _left_out(models: Mapping[str, _Model]) -> dict[str, Floats]:
    """Return the errors (n, 3) with which models of the same readings predict left-out dwells.

    A model is missing if the other dwells do not determine it.
    """
    first, errors = models[METHOD], {name: np.zeros((0, 3)) for name in models}
    for row in first.rests.tolist():
        apart = np.arange(len(first.data)) == row
        rest, held = first.data.rows(~apart), first.data.rows(apart)
        for name in list(errors):
            model = replace(models[name], data=rest)
            if model.narrowed({}) is not model:
                del errors[name]
                continue
            error = replace(model.fit, data=held, values=model.fit.on(held).values).misfit
            errors[name] = np.concatenate([errors[name], error])
    return errors


def _score(errors_dps: Floats) -> dict[str, Any]:
    """Return the entry of `GyroFit.scores` for the errors (n, 3) with which a model predicts the dwells."""
    squares = (errors_dps**2).mean(axis=0)
    return {
        "residual_rms_dps": float(np.sqrt(squares.mean())),
        "residual_max_dps": float(np.abs(errors_dps).max()),
        "residual_rms_by_axis_dps": dict(zip(AXES, np.sqrt(squares).tolist(), strict=True)),
    }


def _odds(errors: Mapping[str, Floats]) -> dict[str, float]:
    """Return the odds of each model against the model that predicts best, from their errors (n, 3).

    The predictive density of a dwell is normal, with the root mean square of the model's errors as standard
    deviation. The logarithms of the densities are added over the dwells. The difference of the sums of two
    models, with its standard error from the scatter between dwells, gives the probability that the other
    model predicts better (Vehtari et al. 2017, Statistics and Computing 27, 1413).
    """
    from scipy.special import ndtr

    scale = {name: np.sqrt((one**2).mean(axis=0)) + 1e-300 for name, one in errors.items()}
    density = {k: -(np.log(scale[k]) + (one / scale[k]) ** 2 / 2).sum(axis=1) for k, one in errors.items()}
    best = max(density.values(), key=np.sum, default=None)
    odds = {}
    for name, own in density.items():
        behind = best - own
        spread = math.sqrt(len(own)) * float(behind.std(ddof=1))
        p = float(ndtr(-behind.sum() / spread)) if spread > 0 else 0.5
        odds[name] = p / (1 - p)
    return odds


def scatter_factors(chi2: Floats, dof: NDArray[np.intp]) -> list[tuple[float, float]]:
    """Return the factor on each gyro's noise variance that the residuals show, and its degrees of freedom.

    With the probability ½ there is only the noise. With ¼ dwells scatter in addition by one factor for all
    gyros, with ¼ each gyro scatters or not (½) by its own factor. A factor has a log-uniform prior from 1
    to `LARGEST_SCATTER`. The posterior of the precision, 1/factor, is replaced by the gamma distribution
    with its mean and variance, so that the parameters have t distributions.

    `chi2` (3,) and `dof` (3,) are χ² of the residuals by the noise, and its degrees of freedom.
    """
    from scipy.special import expit, gammainc, gammaln, softmax

    # Each gyro, then all together.
    shape, rate = np.append(dof, dof.sum()) / 2, np.append(chi2, chi2.sum()) / 2
    shown = (shape > 0) & (gammainc(shape, rate) > 0)
    shape, rate = np.where(shown, [shape, rate], 1.0)
    below = gammainc(shape + np.arange(3)[:, None], rate)
    evidence = gammaln(shape) + np.log(below[0]) - shape * np.log(rate) + rate
    evidence = np.where(shown, evidence - math.log(math.log(LARGEST_SCATTER)), -np.inf)
    # Mean and mean square of the precision, if there is scatter.
    moments = np.array([shape, shape * (shape + 1)]) / np.array([rate, rate**2]) * below[1:] / below[0]
    each = expit(evidence[:3])
    apart = float((np.logaddexp(0, evidence[:3]) - math.log(2)).sum())
    noise, own, common = softmax([math.log(2), apart, evidence[3]])
    mean, square = noise + own * (1 - each + each * moments[:, :3]) + common * moments[:, 3:]
    free = np.maximum(2 * mean**2 / np.maximum(square - mean**2, 1e-12), 1.0)
    return list(zip((1 / mean).tolist(), free.tolist(), strict=True))


def _larger(inflation: Mapping[str, float]) -> str:
    """Return the ratio of residual to noise of each gyro that is clearly above 1, as text; often empty."""
    large = [f"{axis} {math.sqrt(own):.2g}" for axis, own in inflation.items() if own > 2]
    return f"{', '.join(large)} times" if large else ""


def _warnings(data: Readings, lost: Sequence[str], inflation: Mapping[str, float]) -> list[str]:
    """Return warnings of the undetermined parameters `lost`, and of a residual above the noise."""
    warnings = []
    lacking = [one.name for one in _EFFECTS if data.conditions.lacks(one.needs)] + _kinds(lost)
    if lacking:
        steps = []
        if any(name.startswith("g_") for name in lacking):
            steps.append("measure poses with each axis up and down")
        if any(not name.startswith("g_") for name in lacking):
            steps.append("turn the part by whole turns about each axis (plan gyro-turns)")
        warnings.append("not determined, fixed at perfect gyros: " + "; ".join([*lacking, *steps]))
    if large := _larger(inflation):
        warnings.append(
            f"the residual is larger than the measured noise ({large}):"
            " uncertainties are stated by the residual; trace --sensor-part gyro reports the missing effect"
        )
    return warnings


def _kinds(names: Sequence[str]) -> list[str]:
    """Return shortened parameter names: `gyro_misalignment_xy, xz` instead of two full names."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem, axes = name.rsplit("_", 1)
        groups.setdefault(stem, []).append(axes)
    return [f"{stem}_{', '.join(axes)}" for stem, axes in groups.items()]


def _drifting(
    models: Mapping[str, _Model], best: _Model, covariance: Floats, errors: Mapping[str, Floats]
) -> list[str]:
    """Return warnings of a drift in the best model, and of g-sensitivities that a drift may imitate.

    `covariance` (p, p) of the parameters includes the uncertainty of the choice of the model. `errors` are
    the errors (n, 3) with which each model predicts left-out dwells, by name of the model.
    """
    names, order = best.determined[0], "in this order of poses force cannot be fully separated from a"
    warnings, again = [], "repeat poses in another order"
    sensitivities = [name for name in names if name.startswith("g_")]
    for name in [name for name in DRIFTS if name in models]:
        one, drift = models[name], name.removeprefix(f"{METHOD} with a ")
        if open_ := [name for name in sensitivities if name not in one.determined[0]]:
            lost = ", ".join(_kinds(open_))
            warnings.append(f"{order} {drift}: with one in the model {lost} cannot be determined; {again}")
        if one is best:
            u = [float(np.sqrt((errors[key] ** 2).mean())) for key in (name, METHOD)]
            warnings.append(
                f"a {drift} of the zero rates is in the model, because it predicts left-out dwells best:"
                f" {u[0]:.2g} °/s, without it {u[1]:.2g} °/s; gyro_bias is the mean over the dwells"
            )
    # More than half of the variance is the choice.
    unsure = np.diagonal(covariance) > 2 * np.diagonal(best.determined[2])
    if moved := _kinds([name for name in sensitivities if unsure[names.index(name)]]):
        u_of = ", ".join(moved)
        warnings.append(f"{order} drift of the zero rate: u of {u_of} includes the difference; {again}")
    return warnings
