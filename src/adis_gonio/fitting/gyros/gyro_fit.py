"""Method `gyro`: weighted least squares for zero rates, g-sensitivity, scale factors and directions.

The model is the gyros' base model (`MeanRate`) with the effects of a physical calibration: `g_sensitivity`
if poses show it, `gyro_scale` and `gyro_misalignment` if turns show them. If the force along an axis
changes steadily in the order of the poses, a drift of the zero rate imitates a g-sensitivity. Models with
and without a drift (`DRIFTS`) are therefore compared by their prediction of left-out dwells. The result is
that of the best model, and its u includes the differences to the other models, weighted by their odds. A
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
from adis_gonio.base.errors import AdisGonioError, FitError, SessionError
from adis_gonio.base.jsonable import json_object
from adis_gonio.base.numbers import counted
from adis_gonio.base.tables import Entries, ParameterTable
from adis_gonio.base.uncertainty import INADEQUATE, Value
from adis_gonio.calibrate.calibration import NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration, gyro_directions
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.fitting.estimation.fit import Fit, adequacy
from adis_gonio.fitting.estimation.readings import GYRO, Readings, readings_of_part
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES, Effect, effect
from adis_gonio.model.measurement import SKEW_AXES
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import Provenance, provenance_of
from adis_gonio.record.write_journal import INTERRUPTED

if TYPE_CHECKING:
    from adis_gonio.calibrate.calibration import Calibration

METHOD = "gyro"
CALIBRATED = ("g_sensitivity", "gyro_scale", "gyro_misalignment")
"""Effects of the catalogue that a gyro calibration corrects."""
_EFFECTS = tuple(effect(name, AXES) for name in CALIBRATED)
DRIFTS = {
    "drift with time": effect("gyro_drift", AXES, steps=0),
    "drift from dwell to dwell": effect("gyro_drift", AXES, steps=1),
    "warm-up": effect("gyro_warm_up", AXES),
}
"""Drifts of the zero rate that may imitate a g-sensitivity, by the words for a message."""
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


@dataclass(frozen=True)
class GyroScore:
    """Errors with which one model predicts the dwells, in °/s by gyro axis.

    `rms_dps` has their root mean square and `max_dps` the largest size. Each dwell is predicted by a fit to
    all other dwells.
    """

    rms_dps: dict[str, float]
    max_dps: dict[str, float]

    @classmethod
    def of(cls, errors_dps: Floats) -> GyroScore:
        """Make the score from the errors (n, 3) of the dwells."""
        rms, most = np.sqrt((errors_dps**2).mean(axis=0)), np.abs(errors_dps).max(axis=0)
        return cls(
            *({axis: float(v) for axis, v in zip(AXES, values, strict=True)} for values in (rms, most))
        )

    def as_dict(self) -> dict[str, Any]:
        """Return one entry of the JSON key `scores`: rms over all axes, largest error, and rms by axis."""
        both = np.array(list(self.rms_dps.values()))
        return {
            "residual_rms_dps": float(np.sqrt((both**2).mean())),
            "residual_max_dps": max(self.max_dps.values()),
            "residual_rms_by_axis_dps": dict(self.rms_dps),
        }


class GyroFit(ParameterTable):
    """Result of a fit of the gyros: their parameters with covariance, residuals and warnings.

    Attributes
    ----------
    parameters : mapping of str to Value
        `gyro_bias_x …` (dps), and the determined ones of `g_sensitivity_xy …` (dps/g; the gyro, the axis of
        force), `gyro_scale_x …` (1 is perfect) and `gyro_misalignment_xy …` (deg; the gyro, the axis of
        misalignment).
    covariance : (p, p) float
        In the order and units of `parameters`.
    chi2, dof : float, int
        Weighted sum of the squared residuals by the measured noise, and its degrees of freedom.
    residual_dps : (n, 3) float
        Reading minus model of each interval (dwell or turn) used.
    positions : tuple of int
        Number of each dwell, or of the dwell in which a turn ends.
    turns : int
        Number of turns among the intervals.
    undetermined : tuple of str
        Parameters that the session does not determine; they are fixed at the values of perfect gyros.
    doubts : tuple of str
        Reasons to doubt the gyros, or that they were at rest; they are also in `warnings`.
    inflation : mapping of str to float
        Factor on the noise variance of each gyro, by its axis, that explains its residual; 1 if the
        residual agrees with the measured noise.
    reference_temperature_c : float or None
        Mean temperature of the fitted dwells; None if not recorded.
    provenance, overrides : Provenance or None, mapping
        Origin of the readings (None if no session was given), and values of its file that were overridden.
    fit : Fit or None
        The fitted model on its readings.
    scores : mapping of str to GyroScore
        Prediction errors of the models `zero rate`, `gyro` and `gyro` with a drift, on the same dwells,
        left out one by one.
    """

    parameters: dict[str, Value]
    covariance: Floats
    chi2: float
    dof: int
    residual_dps: Floats
    positions: tuple[int, ...]
    turns: int
    warnings: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()
    inflation: dict[str, float] = field(default_factory=dict)
    reference_temperature_c: float | None = None
    scores: dict[str, GyroScore] = field(default_factory=dict)
    provenance: Provenance | None = field(default=None, compare=False)
    overrides: dict[str, Any] = field(default_factory=dict)
    fit: Fit | None = field(default=None, compare=False)

    method = METHOD
    part = GYRO

    def __getitem__(self, name: str) -> Value:
        """Return the parameter of this name; `KeyError` if the session does not determine it."""
        return self.parameters[name]

    def __contains__(self, name: object) -> bool:
        return name in self.parameters

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
        shown = ", ".join(f"{name} {value}" for name, value in list(self.parameters.items())[:3])
        return f"GyroFit({self.held}, {shown})"

    @property
    def held(self) -> str:
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
        made = make_gyro_calibration(estimates_of_gyro_fit(self), self.provenance)
        return gyro_as_written(made, self.provenance)

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Return the caption of the table in notebooks, and the parameters by name.

        The caption names the method.
        """
        return f"fit by method {self.method}", self.as_dict()["parameters"].items()

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio fit --sensor-part gyro --json` prints."""
        return json_object(
            method=self.method,
            part=self.part,
            parameters=self.parameters,
            covariance={"names": list(self.parameters), "matrix": self.covariance},
            scores=self.scores,
            chi2=self.chi2,
            dof=self.dof,
            residual_rms_dps=self.residual_rms_dps,
            angle_error_deg=None,
            warnings=self.warnings,
            undetermined=self.undetermined,
            noise_inflation=self.inflation,
            reference_temperature_c=self.reference_temperature_c,
            positions_used=len(self.positions) - self.turns,
            turns_used=self.turns,
            time_base_u=TIME_BASE_U if self.turns else None,
            overrides=self.overrides,
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
    if accelerometers is not None:
        from adis_gonio.fitting.gyros.gyro_readings import gyro_readings_by

        return _fit_session(session, gyro_readings_by(session, accelerometers))
    return session.once(_fit_session)


def _fit_session(session: Session, readings: Readings | None = None) -> GyroFit:
    readings = readings_of_part(session, GYRO) if readings is None else readings
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
        drifts = {word: _Model.of(data, (*_EFFECTS, drift)) for word, drift in DRIFTS.items()}
        models |= {_with(word): one for word, one in drifts.items() if one.fit.dof > 0}
    # Errors (n, 3) with which models predict left-out dwells; a model is missing if it is not determined.
    tried = {"zero rate": _Model.of(data, ()), **models} if scored and len(data) > 2 else {}
    left = {name: _left_out(one) for name, one in tried.items()}
    errors = {name: own for name, own in left.items() if own is not None}
    candidates = {name: _Candidate.of(model) for name, model in models.items()}
    odds = _odds({name: errors[name] for name in models if name in errors})
    best = candidates[METHOD]
    # The best model that determines all that the model without a drift determines.
    for name in sorted(odds, key=lambda name: -odds[name]):
        if set(best.names) <= set(candidates[name].names):
            best = candidates[name]
            break
    names, values, covariance = best.names, best.values, best.covariance.copy()
    for name, share in odds.items():
        other = candidates[name].all_values
        apart = np.array([other[key] for key in names]) - values
        covariance += share / sum(odds.values()) * np.outer(apart, apart)
    fit, inflation = best.model.fit, best.inflation
    parameters = {
        name: Value(
            value,
            math.sqrt(max(covariance[k, k], 0.0)),
            _unit(name),
            inflation[_gyro_of(name)][1],
        )
        for k, (name, value) in enumerate(zip(names, values.tolist(), strict=True))
    }
    turned = data.conditions.rate_dps
    temperature = data.conditions.temperature_c
    return GyroFit(
        parameters=parameters,
        covariance=covariance,
        chi2=fit.chi2,
        dof=int(fit.dof),
        residual_dps=fit.misfit,
        positions=tuple(data.position.tolist()),
        turns=0 if turned is None else int(turned.any(axis=1).sum()),
        warnings=(
            *data.notes,
            *_warnings(data, best.model, inflation),
            *_drifting(candidates, best, covariance, errors),
        ),
        undetermined=tuple(best.model.lost),
        inflation={axis: own for axis, (own, _) in inflation.items()},
        reference_temperature_c=None if temperature is None else float(temperature.mean()),
        scores={name: GyroScore.of(one) for name, one in errors.items()},
        fit=fit,
    )


def _with(word: str) -> str:
    return f"{METHOD} with a {word}"


@dataclass(frozen=True)
class _Candidate:
    """A fitted model, with the parameters that a result by this model reports.

    Attributes
    ----------
    model : _Model
        The model.
    inflation : mapping
        Factor on the noise variance of each gyro and its degrees of freedom, by axis (`_inflation`).
    names, values, covariance : sequence of str, (p,) float, (p, p) float
        Names, values and covariance of the determined parameters. The covariance follows the residual if it
        is larger than the noise. If the model has a drift, a zero rate is its mean over the dwells.
    all_values : mapping of str to float
        Values by name, also of parameters fixed at perfect gyros.
    """

    model: _Model
    inflation: dict[str, tuple[float, float]]
    names: list[str]
    values: Floats
    covariance: Floats
    all_values: dict[str, float]

    @classmethod
    def of(cls, model: _Model) -> _Candidate:
        inflation = _inflation(model)
        # A large residual may leave parameters undetermined that the noise alone would determine.
        while (
            narrower := model.narrowed({axis: own for axis, (own, _) in inflation.items()})
        ) is not model:
            model, inflation = narrower, _inflation(narrower)
        factor = np.sqrt([inflation.get(_gyro_of(name), (1.0, 0.0))[0] for name in model.names])
        drifts = np.flatnonzero(~model.stated)
        # A zero rate is stated with the mean of its drift over the dwells.
        mean = np.eye(len(model.names))
        mean[:3, drifts] = model.fit.columns[model.rests].mean(axis=0)[:, drifts]
        values = mean @ model.fit.values.parameters
        covariance = mean @ (model.covariance * np.outer(factor, factor)) @ mean.T
        everything = stated_parameters(model.names, values, covariance, model.stated)
        names, found, covariance = stated_parameters(
            model.names, values, covariance, model.free & model.stated
        )
        # All gains share the error of the time base.
        gains = np.where([name.startswith("gyro_scale_") for name in names], TIME_BASE_U * found, 0.0)
        known = dict(zip(everything[0], everything[1].tolist(), strict=True))
        return cls(model, inflation, names, found, covariance + np.outer(gains, gains), known)


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
        whole = cls(data, terms, names, np.ones(len(names), dtype=bool))
        return whole.narrowed({})

    def narrowed(self, inflation: Mapping[str, float]) -> _Model:
        """Return a copy in which only parameters that the readings determine are free.

        `inflation` has the factor on the noise variance of a gyro, by its axis; 1 by default.
        """
        free = self._determined(inflation)
        return self if (free == self.free).all() else replace(self, free=free)

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

    @property
    def covariance(self) -> Floats:
        """Covariance (p, p) of all parameters; rows and columns of fixed parameters are zero."""
        return _covariance(self.fit, self.free)

    @cached_property
    def stated(self) -> NDArray[np.bool_]:
        """Mask (p,) of the parameters that a result states: all but those of a drift."""
        drifts = {
            p.name for term in self.terms if term.label not in CALIBRATED for p in term.effect.parameters
        }
        return np.array([name not in drifts for name in self.names])

    @property
    def rests(self) -> NDArray[np.intp]:
        """Rows of the dwells at rest."""
        rate = self.data.conditions.rate_dps
        return np.flatnonzero(np.ones(len(self.data), dtype=bool) if rate is None else ~rate.any(axis=1))

    @property
    def lost(self) -> list[str]:
        """Names of the parameters that the readings do not determine, as a result reports them."""
        return [_stated_name(self.names[k]) for k in np.flatnonzero(self.stated & ~self.free)]

    def _determined(self, inflation: Mapping[str, float]) -> NDArray[np.bool_]:
        """Return a mask (p,) of the parameters that the readings determine.

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
                return free
            free[int(u2.argmax())] = False


def _lacks(data: Readings, name: str) -> bool:
    return bool(data.conditions.lacks(effect(name, AXES).needs))


def _gyro_of(name: str) -> str:
    """Return the letter of the gyro to which a parameter belongs, such as x for `g_sensitivity_xy`.

    For a parameter that all gyros share the result is another letter, which is no axis.
    """
    return name.rsplit("_", 1)[-1][0]


def _natural(names: Sequence[str]) -> Floats:
    """Return the factor (p,) from the unit of `LIMIT` to the unit of each parameter: 180/π or 1."""
    return np.array([math.degrees(1.0) if "misalignment" in name else 1.0 for name in names])


def _covariance(fit: Fit, free: NDArray[np.bool_]) -> Floats:
    rows = fit.jacobian[:, free]
    # Invert with columns of unit length, because the parameters have very different sizes.
    size = np.linalg.norm(rows, axis=0)
    size[size == 0] = 1.0
    inverse = np.linalg.pinv((rows / size).T @ (rows / size), rcond=1e-14) / np.outer(size, size)
    out = np.zeros((len(free), len(free)))
    out[np.ix_(free, free)] = inverse
    return out


def _inflation(model: _Model) -> dict[str, tuple[float, float]]:
    """Return the factor on the noise variance of each gyro that explains its residual, by axis.

    Each entry is the factor and the degrees of freedom of the factor. The factor is 1 if the residual
    agrees with the measured noise; its degrees of freedom are then the noise's.
    """
    data, fit = model.data, model.fit
    out = {}
    for k, axis in enumerate(AXES):
        own = sum(
            bool(free) and _gyro_of(name) == axis
            for name, free in zip(model.names, model.free, strict=True)
        )
        chi2, dof = float((fit.residual[:, k] ** 2).sum()), len(data) - own
        agrees = dof <= 0 or adequacy(chi2, dof, data.noise_dof) >= INADEQUATE / len(AXES)
        out[axis] = (1.0, data.noise_dof) if agrees else (chi2 / dof, float(min(dof, data.noise_dof)))
    return out


# -- parameters of a result -------------------------------------------------------------------------------

_STATED = {"gyro_scale_error": "gyro_scale"}
"""Name of a parameter in results, by its name in the catalogue, if both differ."""


def _stated_name(name: str) -> str:
    stem, axes = name.rsplit("_", 1)
    return f"{_STATED.get(stem, stem)}_{axes}"


_UNITS = {"gyro_bias": "dps", "gyro_scale": "1", "gyro_misalignment": "deg", "g_sensitivity": "dps/g"}


def _unit(name: str) -> str:
    return _UNITS.get(name.rsplit("_", 1)[0], "1")


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


def _left_out(model: _Model) -> Floats | None:
    data, residuals = model.data, []
    for row in model.rests.tolist():
        kept = np.arange(len(data)) != row
        rest = replace(model, data=data.rows(kept))
        if rest.narrowed({}) is not rest:
            return None
        held = data.rows(~kept)
        residuals.append(replace(rest.fit, data=held, values=rest.fit.on(held).values).misfit[0])
    return np.array(residuals)


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


def _warnings(data: Readings, model: _Model, inflation: dict[str, tuple[float, float]]) -> list[str]:
    warnings = []
    lost = [name for name in CALIBRATED if _lacks(data, name)] + _kinds(model.lost)
    if lost:
        steps = []
        if any(name.startswith("g_") for name in model.lost) or _lacks(data, "g_sensitivity"):
            steps.append("measure poses with each axis up and down")
        if _lacks(data, "gyro_scale") or any("scale" in name or "mis" in name for name in model.lost):
            steps.append("turn the part by whole turns about each axis (plan gyro-turns)")
        text = "; ".join([*lost, *steps])
        warnings.append(f"not determined, fixed at perfect gyros: {text}")
    large = [f"{axis} {math.sqrt(own):.2g}" for axis, (own, _) in inflation.items() if own > 1]
    if large:
        warnings.append(
            f"the residual is larger than the measured noise ({', '.join(large)} times):"
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
    candidates: Mapping[str, _Candidate], best: _Candidate, covariance: Floats, errors: Mapping[str, Floats]
) -> list[str]:
    """Return warnings of a drift in the best model, and of g-sensitivities that a drift may imitate.

    `covariance` (p, p) of the parameters includes the uncertainty of the choice of the model. `errors` are
    the errors (n, 3) with which each model predicts left-out dwells, by name of the model.
    """
    warnings = []
    order = "in this order of poses force cannot be fully separated from a"
    for word in DRIFTS:
        one = candidates.get(_with(word))
        if one is None:
            continue
        open_ = [name for name in best.names if name.startswith("g_") and name not in one.names]
        if open_:
            warnings.append(
                f"{order} {word}: with one in the model {', '.join(_kinds(open_))} cannot be determined;"
                " repeat poses in another order"
            )
        if one is best:
            u = [float(np.sqrt((errors[name] ** 2).mean())) for name in (_with(word), METHOD)]
            warnings.append(
                f"a {word} of the zero rates is in the model, because it predicts left-out dwells best:"
                f" {u[0]:.2g} °/s, without it {u[1]:.2g} °/s; gyro_bias is the mean over the dwells"
            )
    # More than half of the variance is the choice.
    unsure = np.diagonal(covariance) > 2 * np.diagonal(best.covariance)
    moved = [name for name, one in zip(best.names, unsure, strict=True) if one and name.startswith("g_")]
    if moved:
        warnings.append(
            f"{order} drift of the zero rate: u of {', '.join(_kinds(moved))} includes the difference;"
            " repeat poses in another order"
        )
    return warnings


_STEM = "gyro_scale_"


@dataclass(frozen=True)
class Gains:
    """Scale factors of the gyros that follow from the turns between a session's positions.

    Attributes
    ----------
    values : mapping of str to Value
        Scale factors `gyro_scale_x …` of the gyros with a turn about their axis.
    turns : int
        Number of turns in the fit.
    """

    values: dict[str, Value]
    turns: int

    @property
    def line(self) -> str:
        """Text for the user, such as `gain of gyro Z by 3 turns between dwells: 1.0098 ± 0.0004`."""
        shown = ", ".join(
            f"{name.removeprefix(_STEM).upper()} {value}" for name, value in self.values.items()
        )
        gyros = "gyro" if len(self.values) == 1 else "gyros"
        return f"gain of {gyros} {shown}, by {counted(self.turns, 'turn')} (fit --sensor-part gyro)"

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object: scale factors by parameter name, and the number of turns."""
        return {name: value.as_dict() for name, value in self.values.items()} | {"turns_used": self.turns}


def gains_in(result: GyroFit) -> Gains | None:
    """Return the scale factors in a fit of the gyros; None if no turn determines a scale factor."""
    found = {name: value for name, value in result.parameters.items() if name.startswith(_STEM)}
    return Gains(found, result.turns) if found and result.turns else None


def gains_of(session: Session) -> Gains | None:
    """Fit the gyros of a session and return their scale factors; None if no turn determines one.

    None also if the fit fails.
    """
    try:
        if not any(turn.gyro is not None and len(turn) for turn in session.turns):
            return None
        return gains_in(fit_gyro_readings(readings_of_part(session, GYRO).training, scored=False))
    except AdisGonioError:
        return None


@dataclass(frozen=True)
class GyroEstimates:
    """Estimated parameters of the gyros, from a fit or a trace, as the input of a calibration.

    Attributes
    ----------
    method : str
        Name of the method, as a result has it.
    estimates : mapping of str to objects with `value`, `u`, `unit`
        Estimated parameters by name.
    covariance : (names, (p, p) float) or None
        Names of parameters and their covariance in this order; None if unknown.
    not_corrected : tuple of NotCorrected
        Effects that were found and that a calibration does not correct.
    doubts : tuple of str
        Reasons not to write offsets from these estimates to the chip, one line each; usually empty.
    remarks : tuple of str
        Warnings for the user.
    """

    method: str
    estimates: Mapping[str, Any]
    covariance: tuple[Sequence[str], Floats] | None = None
    not_corrected: tuple[NotCorrected, ...] = ()
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def estimates_of_gyro_fit(result: GyroFit) -> GyroEstimates:
    """Convert the result of `fit --sensor-part gyro` to `GyroEstimates`.

    A residual larger than the noise becomes a doubt.
    """
    large = [f"{axis} {math.sqrt(own):.2g}" for axis, own in result.inflation.items() if own > 1]
    doubts = [f"the gyros' residual is larger than their noise ({', '.join(large)} times)"] if large else []
    return GyroEstimates(
        result.method,
        dict(result.parameters),
        (list(result.parameters), result.covariance),
        doubts=(*doubts, *result.doubts),
        remarks=result.warnings,
    )


def make_gyro_calibration(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    """Return the calibration for the offset registers as they were while the session was recorded.

    `where` is the session that the estimates come from; None if unknown.
    """
    about: dict[str, Any] = {}
    if where is not None:
        about = {name: getattr(where, name) for name in ("temperature_c", "supply_v", "source")}
        about["offsets_lsb"] = where.gyro_offsets_lsb
    stated = found.estimates, found.covariance
    return GyroCalibration.of(*stated, method=found.method, not_corrected=found.not_corrected, **about)


def gyro_as_written(gyro: GyroCalibration, where: Provenance | None) -> GyroCalibration:
    """Return a calibration adapted to the offsets that were written to the chip after its session.

    Gyro offsets change the zero rates; accelerometer offsets change the measured force. The calibration is
    unchanged if its session `where` is unknown (None). Fails with `SessionError` if a write of gyro offsets
    was interrupted.
    """
    if where is None:
        return gyro
    if where.gyro_write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    if where.gyro_written_lsb is not None:
        gyro = gyro.with_offsets(where.gyro_written_lsb)
    if where.offsets_lsb is None or where.written_lsb is None or where.sensor not in VARIANTS:
        return gyro
    moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
    return gyro.with_force_moved(moved * VARIANTS[where.sensor].accel_mg_per_lsb / 1000)
