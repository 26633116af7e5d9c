"""What no gyro at rest reads: such zero rates, or the same number throughout.

How the gyros' triad stands to that of the accelerometers, and how square it is in itself.

The directions D of the gyros (rows, in the accelerometers' frame) are a rotation of the whole and what the
three axes are misaligned with one another: D = S R with a symmetric S (polar decomposition). The rotation
vector is what a part's mounting or its board does; the angles between the axes, as skews (90° minus the
angle), are those of the triad itself and do not depend on the frame.

Method `gyro`: zero rates, g-sensitivity, gains and directions of the gyros, by weighted least squares.

The model is the gyros' base model (`MeanRate`) with the effects of a physical calibration:
`g_sensitivity` where poses show it, `gyro_scale` and `gyro_misalignment` where turns do. Each gyro is
determined by itself, since no parameter belongs to two. What the intervals do not determine is held at that
of a perfect gyro, and said. Of gains and misalignments a result states K and D of rate = K D ω, however
large they are.

Gains of the gyros that the moves between a session's positions gave: the line that says so.

A turn between two rests calibrates the gain of the gyro about its axis for nothing; whoever fits the
accelerometers is told what came out.

From a fit of the gyros to a `GyroCalibration`.
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
from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.base.tables import Entries, ParameterTable
from adis_gonio.base.uncertainty import INADEQUATE, Value
from adis_gonio.calibrate.coefficients import NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.fit import Fit, Values, adequacy
from adis_gonio.fitting.estimation.readings import GYRO, Readings, readings_of_part
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES, Effect, effect
from adis_gonio.model.measurement import SKEW_AXES
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import Provenance, provenance_of
from adis_gonio.record.write_journal import INTERRUPTED

if TYPE_CHECKING:
    from adis_gonio.calibrate.calibration import Calibration
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

LARGEST_DPS = 10.0
"""Zero rate beyond which something else is likelier: ten times that of parts of this class (D)."""


def implausible(session: Session, zero_dps: Sequence[float]) -> tuple[str, ...]:
    """Why the gyros of a session are to be doubted, a line each; empty where they are not.

    Parameters
    ----------
    zero_dps : (3,) float
        Zero rates that were found, in °/s.
    """
    said = []
    for axis, zero in zip(AXES, zero_dps, strict=True):
        if abs(zero) > LARGEST_DPS:
            said.append(
                f"gyro_bias_{axis} is {zero:.4g} °/s, and gyros of this class have about 1 °/s: did the"
                f" part turn, is the gyro broken, or the unit another (here {session.gyro_unit})?"
            )
    samples = [dwell.gyro for dwell in session.dwells if dwell.gyro is not None and len(dwell) > 1]
    for k, axis in enumerate(AXES):
        if samples and np.ptp(np.concatenate([rows[:, k] for rows in samples])) == 0:
            said.append(
                f"gyro {axis} reads {samples[0][0, k]:g} in every sample, without any noise: is it"
                " connected, and the column that of a gyro?"
            )
    return tuple(said)


MISALIGNMENTS = tuple((k, j) for k in range(3) for j in range(3) if k != j)
_STEP_DEG = 1e-4


def directions(misalignment_deg: Floats) -> Floats:
    """Unit vectors (3, 3) of the gyros by the misalignment (3, 3) of each towards the others' axes."""
    sines = np.sin(np.radians(misalignment_deg)) * (1 - np.eye(3))
    return np.asarray(sines + np.diag(np.sqrt(1 - (sines**2).sum(axis=1))))


def rotation_and_skews_deg(misalignment_deg: Floats) -> Floats:
    """Rotation vector (3) of the triad and its three skews xy, xz, yz, in degrees."""
    rows = directions(misalignment_deg)
    left, _, right = np.linalg.svd(rows)
    # Rows of the nearest square triad; as a rotation of the frame's axes onto them its transpose.
    turned = (left @ right).T
    axial = np.array(
        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(axial)) / 2, (float(np.trace(turned)) - 1) / 2
    angle = math.atan2(sine, cosine)
    vector = axial / 2 * (angle / sine if sine > 1e-12 else 1.0)
    skews = [math.asin(float(rows[i] @ rows[j])) for i, j in SKEW_AXES]
    return np.asarray(np.degrees(np.concatenate([vector, skews])))


def alignment(
    parameters: Mapping[str, Value], covariance: Floats, names: Sequence[str]
) -> dict[str, Value] | None:
    """`triad_rotation_x…` and `gyro_skew_xy…` in degrees with u, from the gyros' misalignments.

    Parameters
    ----------
    parameters : mapping of str to Value
        Of a gyro fit.
    covariance : (p, p) float
        Of them, in the order of `names`.

    Returns
    -------
    mapping or None
        None unless all six misalignments are determined.
    """
    names_of_angles = [f"gyro_misalignment_{AXES[k]}{AXES[j]}" for k, j in MISALIGNMENTS]
    if any(name not in parameters for name in names_of_angles):
        return None
    rows = [list(names).index(name) for name in names_of_angles]
    misalignments = np.zeros((3, 3))
    for (k, j), name in zip(MISALIGNMENTS, names_of_angles, strict=True):
        misalignments[k, j] = parameters[name].value
    own = np.zeros((len(MISALIGNMENTS), 3, 3))
    for row, place in enumerate(MISALIGNMENTS):
        own[row][place] = 1.0
    slope = central_differences(rotation_and_skews_deg, misalignments, _STEP_DEG, own)
    variance = slope @ covariance[np.ix_(rows, rows)] @ slope.T
    dof = min(parameters[name].dof or math.inf for name in names_of_angles)
    found = rotation_and_skews_deg(misalignments)
    stated = [f"triad_rotation_{axis}" for axis in AXES]
    stated += [f"gyro_skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES]
    return {
        name: Value(float(found[k]), math.sqrt(max(float(variance[k, k]), 0.0)), "deg", dof)
        for k, name in enumerate(stated)
    }


METHOD = "gyro"
CALIBRATED = ("g_sensitivity", "gyro_scale", "gyro_misalignment")
"""Effects of a physical calibration, the first to be given up last."""
DRIFTS = {
    "drift with time": effect("gyro_drift", AXES, steps=0),
    "drift from dwell to dwell": effect("gyro_drift", AXES, steps=1),
    "warm-up": effect("gyro_warm_up", AXES),
}
"""Courses of the zero rate beside which a g-sensitivity is looked at again."""
SCORED = ("drift with time", "drift from dwell to dwell")
"""Those that are scored on dwells that took no part; a warm-up is not linear: the trace scores that."""
BEGIN_TAU = 1 / 3
"""Time constant from which a warm-up is fitted, in lengths of the session."""
LIMIT = 0.1
"""Largest standard uncertainty of a parameter that counts as determined, in 1 dps/g, a gain of 1, 1 rad."""
_NOTHING = 1e-14
"""Information in a direction, against the most in any, that is none but rounding."""
TIME_BASE_U = 50e-6 / math.sqrt(3)
"""Relative standard uncertainty of the samples' times: a crystal of ±50 ppm, uniform (an estimate, D; the
chip's own clock does not count, since times are the host's). An angle is rate times time: it is the same in
all gains."""


@dataclass(frozen=True)
class GyroScore:
    """Residuals of the dwells, each left out of the fit in turn, by axis in °/s."""

    rms_dps: dict[str, float]
    max_dps: dict[str, float]

    def as_dict(self) -> dict[str, Any]:
        """One entry of `scores`; the residual is that of all axes together."""
        both = np.array(list(self.rms_dps.values()))
        return {
            "residual_rms_dps": float(np.sqrt((both**2).mean())),
            "residual_max_dps": max(self.max_dps.values()),
            "residual_rms_by_axis_dps": dict(self.rms_dps),
        }


@dataclass(frozen=True)
class GyroFit(ParameterTable):
    """Parameters of the gyros with covariance.

    Attributes
    ----------
    parameters : mapping of str to Value
        `gyro_bias_x …` (dps) and what is determined of `g_sensitivity_xy …` (dps/g; the gyro, the axis of
        force), `gyro_scale_x …` (1 is perfect), `gyro_misalignment_xy …` (deg; the gyro, the axis towards
        which it is misaligned).
    covariance : (p, p) float
        In the order and units of `parameters`.
    chi2, dof : float, int
        Residual against the measured noise.
    residual_dps : (n, 3) float
        Reading minus model of each interval used.
    positions : tuple of int
        Number of the dwell of each, or of the dwell in which a turn ends.
    turns : int
        Intervals that are turns.
    undetermined : tuple of str
    doubts : tuple of str
        Those of the warnings that say that these are hardly gyros at rest.
    inflation : mapping of str to float
        Factor on the noise variance of each gyro that its residual demanded; 1 where it agrees.
    scores : mapping of str to GyroScore
        `zero rate`, `gyro` and models with a drift on the same dwells, left out one by one.
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
        """Parameter by name; `KeyError` where the session does not determine it."""
        return self.parameters[name]

    def __contains__(self, name: object) -> bool:
        return name in self.parameters

    @cached_property
    def triad(self) -> dict[str, Value] | None:
        """`triad_rotation_x…` against the accelerometers, `gyro_skew_xy…`, in deg; None where not seen."""
        return alignment(self.parameters, self.covariance, list(self.parameters))

    @property
    def residual_rms_dps(self) -> float:
        """Root mean square of the residuals in °/s."""
        return float(np.sqrt((self.residual_dps**2).mean()))

    def __repr__(self) -> str:
        told = ", ".join(
            f"{name} {format_uncertain(self[name].value, self[name].u, self[name].unit)}"
            for name in list(self.parameters)[:3]
        )
        return f"GyroFit({self.held}, {told})"

    @property
    def held(self) -> str:
        """`14 dwells and 3 turns`."""
        dwells = counted(len(self.positions) - self.turns, "dwell")
        return f"{dwells} and {counted(self.turns, 'turn')}" if self.turns else dwells

    def calibration(self) -> GyroCalibration:
        """What turns readings of the gyros into rates of turn, for the part as it is.

        Raises
        ------
        FitError
            A zero rate is not determined.
        SessionError
            A write of gyro offsets was interrupted, so that only the sensor can tell.
        """
        return gyro_calibration_as_it_is(estimates_of_gyro_fit(self), self.provenance)

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Method, and the parameters by name."""
        return f"fit by method {self.method}", self.as_dict()["parameters"].items()

    def as_dict(self) -> dict[str, Any]:
        """JSON document of `fit --sensor-part gyro`."""
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
    """Parameters of a session's gyros with their covariance; check dwells take no part.

    Parameters
    ----------
    accelerometers : Calibration, optional
        Of the same part: what the session does not determine of the directions of its accelerometers is
        taken from there.

    Raises
    ------
    DataError
        The session has no gyros, or their unit is not known.
    FitError
        There is no dwell for fitting.
    UsageError
        The calibration is of another part, or states no uncertainties.
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
    doubts = implausible(session, [result[f"gyro_bias_{axis}"].value for axis in AXES])
    return replace(
        result,
        doubts=doubts,
        warnings=(*session.notes, *doubts, *result.warnings),
        overrides=session.facts.get("overrides", {}),
        provenance=provenance_of(session),
    )


def fit_gyro_readings(data: Readings, *, scored: bool = True) -> GyroFit:
    """The same of readings; without `scored` no dwell is left out, which costs most of the time."""
    if len(data) < 1:
        raise FitError("no dwell holds samples of the gyros")
    model = _Model.of(data, _calibrated())
    fit = model.fit
    inflation = _inflation(model)
    factor = np.sqrt([inflation[_gyro_of(name)][0] for name in model.names])
    names, values, covariance = stated_parameters(
        model.names, fit.values.parameters, model.covariance * np.outer(factor, factor), model.free
    )
    gains = np.where([name.startswith("gyro_scale_") for name in names], TIME_BASE_U * values, 0.0)
    covariance = covariance + np.outer(gains, gains)
    parameters = {
        name: Value(value, math.sqrt(max(covariance[k, k], 0.0)), _unit(name), inflation[_gyro_of(name)][1])
        for k, (name, value) in enumerate(zip(names, values.tolist(), strict=True))
    }
    turned = data.conditions.rate_dps
    turns = 0 if turned is None else int(turned.any(axis=1).sum())
    scores = _scores(data, model) if scored else {}
    temperature = data.conditions.temperature_c
    return GyroFit(
        parameters=parameters,
        covariance=covariance,
        chi2=fit.chi2,
        dof=int(fit.dof),
        residual_dps=fit.misfit,
        positions=tuple(data.position.tolist()),
        turns=turns,
        warnings=(*data.notes, *_warnings(data, model, parameters, inflation)),
        undetermined=tuple(model.lost),
        inflation={axis: own for axis, (own, _) in inflation.items()},
        reference_temperature_c=None if temperature is None else float(temperature.mean()),
        scores=scores,
        fit=fit,
    )


# -- what is determined -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Model:
    """Terms of a calibration on readings, and which of their parameters are free.

    Attributes
    ----------
    names : tuple of str
        Base parameters and those of the terms.
    free : (p,) bool
    """

    data: Readings
    terms: tuple[NamedTerm, ...]
    names: tuple[str, ...]
    free: NDArray[np.bool_]

    @classmethod
    def of(cls, data: Readings, effects: Sequence[Effect]) -> _Model:
        """The effects whose conditions were recorded, with what the readings determine of them."""
        seen = [one for one in effects if not data.conditions.lacks(one.needs)]
        terms = tuple(NamedTerm(one.name, (), 0.0, one) for one in seen)
        names = (*data.model.names, *(p.name for term in terms for p in term.effect.parameters))
        whole = cls(data, terms, names, np.ones(len(names), dtype=bool))
        return replace(whole, free=whole._determined())

    @cached_property
    def begun(self) -> Fit:
        """All parameters at those of perfect gyros."""
        base = Fit.begin(self.data, with_prior=False)
        tau = max(BEGIN_TAU * float(np.ptp(self.data.conditions.time_s)), 1.0)
        values = [[tau if p.shape else 0.0 for p in term.effect.parameters] for term in self.terms]
        return base.with_terms(self.terms, [np.array(own) for own in values])

    @cached_property
    def fit(self) -> Fit:
        """Fitted in the free parameters."""
        return self.begun.refit(within=np.eye(len(self.names))[:, self.free])

    @property
    def covariance(self) -> Floats:
        """Of all parameters (p, p), zero for those that are held."""
        return _covariance(self.fit, self.free)

    @property
    def lost(self) -> list[str]:
        """Parameters that are not determined, as a result states them."""
        return [_stated_name(name) for name, free in zip(self.names, self.free, strict=True) if not free]

    def _determined(self) -> NDArray[np.bool_]:
        """Parameters (p,) that the readings determine, each gyro by itself.

        The one of the largest uncertainty is given up until all but the zero rate, which is stated however
        large its own is, are within `LIMIT`.
        """
        free = np.ones(len(self.names), dtype=bool)
        rows = self.begun.jacobian * _natural(self.names)
        for axis in AXES:
            own = np.array([_gyro_of(name) == axis for name in self.names])
            base = len(self.data.model.parameters)
            while True:
                index = np.flatnonzero(own & free)
                values, vectors = np.linalg.eigh(rows[:, index].T @ rows[:, index])
                known = np.maximum(values, _NOTHING * max(float(values.max(initial=0.0)), 1.0))
                u2 = np.where(index >= base, (vectors**2 / known).sum(axis=1), 0.0)
                if not u2.max(initial=0.0) > LIMIT**2:
                    break
                free[index[int(u2.argmax())]] = False
        return free


def _calibrated() -> tuple[Effect, ...]:
    return tuple(effect(name, AXES) for name in CALIBRATED)


def _with_drift(word: str) -> tuple[Effect, ...]:
    return (*_calibrated(), DRIFTS[word])


def _lacks(data: Readings, name: str) -> bool:
    return bool(data.conditions.lacks(effect(name, AXES).needs))


def _gyro_of(name: str) -> str:
    """The gyro's letter: the first of those at the end of a name; no axis where all share the parameter."""
    return name.rsplit("_", 1)[-1][0]


def _natural(names: Sequence[str]) -> Floats:
    """Size (p,) of each parameter in which `LIMIT` is stated."""
    return np.array([math.degrees(1.0) if "misalignment" in name else 1.0 for name in names])


def _covariance(fit: Fit, free: NDArray[np.bool_]) -> Floats:
    rows = fit.jacobian[:, free]
    size = np.linalg.norm(rows, axis=0)
    size[size == 0] = 1.0
    inverse = np.linalg.pinv((rows / size).T @ (rows / size), rcond=1e-14) / np.outer(size, size)
    out = np.zeros((len(free), len(free)))
    out[np.ix_(free, free)] = inverse
    return out


def _inflation(model: _Model) -> dict[str, tuple[float, float]]:
    """Factor on the noise variance of each gyro that its residual demands, and its degrees of freedom."""
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


# -- what is stated ---------------------------------------------------------------------------------------

_STATED = {"gyro_scale_error": "gyro_scale"}
"""Parameters that are stated otherwise than effects have them."""
_UNITS = {"gyro_bias": "dps", "gyro_scale": "1", "gyro_misalignment": "deg", "g_sensitivity": "dps/g"}


def _stated_name(name: str) -> str:
    stem, axes = name.rsplit("_", 1)
    return f"{_STATED.get(stem, stem)}_{axes}"


def _unit(name: str) -> str:
    return _UNITS.get(name.rsplit("_", 1)[0], "1")


def stated_parameters(
    names: Sequence[str], values: Floats, covariance: Floats, free: NDArray[np.bool_] | None = None
) -> tuple[list[str], Floats, Floats]:
    """Names, values and covariance of the free parameters, with gains K and misalignments of D.

    Parameters
    ----------
    values, covariance : (p,) float, (p, p) float
        Of the base model and the effects.
    free : (p,) bool, optional
        Parameters that are determined; by default all.
    """
    kept = np.flatnonzero(np.ones(len(values)) if free is None else free).tolist()
    step = 1e-6
    slope = np.zeros((len(values), len(values)))
    for k in kept:
        change = step * np.eye(len(values))[k]
        rise = gains_and_directions(names, values + change) - gains_and_directions(names, values - change)
        slope[:, k] = rise / (2 * step)
    moved = slope @ covariance @ slope.T
    stated = gains_and_directions(names, values)
    return [_stated_name(names[k]) for k in kept], stated[kept], moved[np.ix_(kept, kept)]


def gains_and_directions(names: Sequence[str], values: Floats) -> Floats:
    """The parameters (p,) with gains K and misalignments of D in place of the terms of the effects.

    A gyro that adds e Ω_i + Σ sin m_p Ω_p − (1 − c) Ω_i, c² = 1 − Σ sin² m_p, to Ω_i has the row
    (c + e, sin m_p, …) of K D: K is its length, the misalignments are those of its direction.
    """
    out = values.copy()
    at = {name: k for k, name in enumerate(names)}
    for axis in AXES:
        scale = at.get(f"gyro_scale_error_{axis}")
        if scale is None:
            continue
        angles = [k for name, k in at.items() if name.startswith(f"gyro_misalignment_{axis}")]
        sines = np.sin(np.radians(values[angles]))
        along = math.sqrt(max(1 - float(sines @ sines), 0.0)) + float(values[scale])
        out[scale] = gain = math.hypot(along, float(np.hypot.reduce(sines)))
        out[angles] = np.degrees(np.arcsin(sines / gain))
    return out


# -- how good it is, and what is said ---------------------------------------------------------------------


def _scores(data: Readings, model: _Model) -> dict[str, GyroScore]:
    """Each dwell left out in turn: of the zero rate alone, of the calibration, and with drifts besides."""
    if len(data) < 3:
        return {}
    models = {"zero rate": _Model.of(data, ()), METHOD: model}
    models |= {f"{METHOD} with a {word}": _Model.of(data, _with_drift(word)) for word in SCORED}
    rest = _at_rest(data)
    found = {name: _left_out(one, rest) for name, one in models.items()}
    return {name: score for name, score in found.items() if score is not None}


def _at_rest(data: Readings) -> NDArray[np.intp]:
    rate = data.conditions.rate_dps
    return np.flatnonzero(np.ones(len(data), dtype=bool) if rate is None else ~rate.any(axis=1))


def _left_out(model: _Model, rows: NDArray[np.intp]) -> GyroScore | None:
    """Residuals of rows that are left out one by one; None where the others do not determine the model."""
    data, left = model.data, []
    for row in rows.tolist():
        kept = np.arange(len(data)) != row
        rest = replace(model, data=data.rows(kept))
        if not (rest._determined() == model.free).all():
            return None
        there = replace(rest.fit, data=data.rows(~kept), values=_rate_of(rest.fit, data.rows(~kept)))
        left.append(there.misfit[0])
    size = np.abs(np.array(left))
    rms, most = np.sqrt((size**2).mean(axis=0)), size.max(axis=0)
    return GyroScore(
        *({axis: float(v) for axis, v in zip(AXES, values, strict=True)} for values in (rms, most))
    )


def _rate_of(fit: Fit, data: Readings) -> Values:
    """Values of a fit for other readings, whose true rates are their own."""
    return fit.on(data).values


def _warnings(
    data: Readings, model: _Model, parameters: dict[str, Value], inflation: dict[str, tuple[float, float]]
) -> list[str]:
    out = []
    lost = [name for name in CALIBRATED if _lacks(data, name)] + _kinds(model.lost)
    if lost:
        what = "; ".join(lost)
        out.append(f"not determined, taken as of perfect gyros: {what}; {_remedy(data, model)}")
    large = {axis: math.sqrt(own) for axis, (own, _) in inflation.items() if own > 1}
    if large:
        times = ", ".join(f"{axis} {own:.2g}" for axis, own in large.items())
        out.append(
            f"the residual is larger than the noise that was measured ({times} times): uncertainties are"
            " stated by the residual; trace --sensor-part gyro says what is missing"
        )
    return out + _drifting(data, model, parameters)


def _kinds(names: Sequence[str]) -> list[str]:
    """`gyro_misalignment_xy, xz`: names of one kind together."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem, axes = name.rsplit("_", 1)
        groups.setdefault(stem, []).append(axes)
    return [f"{stem}_{', '.join(axes)}" for stem, axes in groups.items()]


def _remedy(data: Readings, model: _Model) -> str:
    """What would show what this session does not."""
    out = []
    if any(name.startswith("g_") for name in model.lost) or _lacks(data, "g_sensitivity"):
        out.append("measure poses with each axis up and down")
    if _lacks(data, "gyro_scale") or any("scale" in name or "mis" in name for name in model.lost):
        out.append("turn the part by whole turns about each axis (plan gyro-turns)")
    return "; ".join(out)


def _drifting(data: Readings, model: _Model, parameters: dict[str, Value]) -> list[str]:
    """g-sensitivities that a drift would change by more than their own standard uncertainty."""
    out = []
    for word in DRIFTS:
        with_drift = _Model.of(data, _with_drift(word))
        if with_drift.fit.dof <= 0:
            continue
        moved, open_ = [], []
        rows = zip(with_drift.names, with_drift.fit.values.parameters, with_drift.free, strict=True)
        for name, value, free in rows:
            known = parameters.get(name)
            if known is None or not name.startswith("g_") or known.u is None:
                continue
            if not free:
                open_.append(name)
            elif abs(float(value) - known.value) > known.u:
                moved.append(f"{name} {known.value:+.3f} to {float(value):+.3f}")
        told = [f"with one in the model {', '.join(moved)} °/s/g"] if moved else []
        told += [f"beside one {', '.join(_kinds(open_))} cannot be determined"] if open_ else []
        if told:
            out.append(
                f"in this order of poses force is not wholly told from a {word}: {'; '.join(told)}; "
                "repeat poses in another order"
            )
    return out


_STEM = "gyro_scale_"


@dataclass(frozen=True)
class Gains:
    """What turns tell of the gyros' gains.

    Attributes
    ----------
    values : mapping of str to Value
        `gyro_scale_x …` of the gyros whose axis was turned about.
    turns : int
    """

    values: dict[str, Value]
    turns: int

    @property
    def line(self) -> str:
        """`gain of gyro Z by 3 turns between dwells: 1.0098 ± 0.0004`."""
        told = ", ".join(
            f"{name.removeprefix(_STEM).upper()} {format_uncertain(value.value, value.u, value.unit)}"
            for name, value in self.values.items()
        )
        gyros = "gyro" if len(self.values) == 1 else "gyros"
        return f"gain of {gyros} {told}, by {counted(self.turns, 'turn')} (fit --sensor-part gyro)"

    def as_dict(self) -> dict[str, Any]:
        """JSON: the parameters by name, and `turns_used`."""
        return {name: value.as_dict() for name, value in self.values.items()} | {"turns_used": self.turns}


def gains_in(result: GyroFit) -> Gains | None:
    """Gains in a fit of the gyros; None where no turn tells one."""
    found = {name: value for name, value in result.parameters.items() if name.startswith(_STEM)}
    return Gains(found, result.turns) if found and result.turns else None


def gains_of(session: Session) -> Gains | None:
    """Gains by a session's turns; None where it has none, or they tell none."""
    try:
        if not any(turn.gyro is not None and len(turn) for turn in session.turns):
            return None
        return gains_in(fit_gyro_readings(readings_of_part(session, GYRO).training, scored=False))
    except AdisGonioError:
        return None


@dataclass(frozen=True)
class GyroEstimates:
    """What a fit or a trace of the gyros found.

    Attributes
    ----------
    method : str
    estimates : mapping of str to objects with `value`, `u`, `unit`
    covariance : (names, (p, p) float) or None
    not_corrected : tuple of NotCorrected
    doubts : tuple of str
        Why it is no sound base for the chip, one line each; empty where it is.
    remarks : tuple of str
        What is to be said of it.
    """

    method: str
    estimates: Mapping[str, Any]
    covariance: tuple[Sequence[str], Floats] | None = None
    not_corrected: tuple[NotCorrected, ...] = ()
    doubts: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def estimates_of_gyro_fit(result: GyroFit) -> GyroEstimates:
    """Of `fit --sensor-part gyro`; a residual beyond the noise is a doubt."""
    large = [f"{axis} {math.sqrt(own):.2g}" for axis, own in result.inflation.items() if own > 1]
    doubts = [f"the gyros' residual is larger than their noise ({', '.join(large)} times)"] if large else []
    doubts += result.doubts
    names = list(result.parameters)
    return GyroEstimates(
        result.method,
        dict(result.parameters),
        (names, result.covariance),
        doubts=tuple(doubts),
        remarks=tuple(result.warnings),
    )


def gyro_calibration_as_it_is(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    """Return the calibration for the offsets that the sensor holds now; see `gyro_as_written`."""
    made = make_gyro_calibration(found, where)
    return made if where is None else gyro_as_written(made, where)


def make_gyro_calibration(found: GyroEstimates, where: Provenance | None) -> GyroCalibration:
    """Return the calibration for the offsets in force while its session was recorded."""
    about: dict[str, Any] = {}
    if where is not None:
        about = {
            "temperature_c": where.temperature_c,
            "supply_v": where.supply_v,
            "offsets_lsb": where.gyro_offsets_lsb,
            "source": where.source,
        }
    return GyroCalibration.of(
        found.estimates,
        found.covariance,
        method=found.method,
        not_corrected=found.not_corrected,
        **about,
    )


def gyro_as_written(gyro: GyroCalibration, where: Provenance) -> GyroCalibration:
    """For the part as it is: what was written since is corrected by the chip, and moves the force."""
    if where.gyro_write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    if where.gyro_written_lsb is not None:
        gyro = gyro.with_offsets(where.gyro_written_lsb)
    if where.offsets_lsb is None or where.written_lsb is None or where.sensor not in VARIANTS:
        return gyro
    moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
    return gyro.with_force_moved(moved * VARIANTS[where.sensor].accel_mg_per_lsb / 1000)
