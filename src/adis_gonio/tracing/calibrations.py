"""From a trace to a calibration of accelerometers or gyros; the gyros of a session, fitted or traced."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import AdisGonioError, FitError, SessionError
from adis_gonio.calibrate.calibration import Calibration, Coefficient, EffectTerm, NotCorrected
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.fitting.calibrations import as_written, assumed_parameters, known_provenance
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.gyros.calibrations import (
    GyroEstimates,
    estimates_of_gyro_fit,
    gyro_as_written,
    gyro_calibration_as_it_is,
    make_gyro_calibration,
)
from adis_gonio.model.effects import AXES, effect
from adis_gonio.model.measurement import BaseParameter
from adis_gonio.model.records import MG_PER_G, MG_PER_MPS2, Session
from adis_gonio.record.provenance import provenance_of
from adis_gonio.tracing.outcome.clock import clock_at_middle, follows_clock, middle_s
from adis_gonio.tracing.outcome.result import TraceResult

CORRECTABLE = frozenset(
    {
        "scale", "misalignment", "cross_axis", "quadratic", "cubic", "asymmetry", "cross_quadratic",
        "bias_temperature", "scale_temperature", "misalignment_temperature", "supply_bias", "supply_scale",
    }
)  # fmt: skip
"""Effects that are functions of the reading, the temperature and the supply: a goniometer knows these."""

_CLOCK = "follows the clock of the session, which no later reading shares"
_STAGE = "belongs to the stage, not to the sensor"
_MEMORY = "depends on what was before the reading, which a single reading does not show"
_DWELL = "belongs to a dwell of the session"
_REASONS = {
    "scale_drift": "follows the clock of the session; the gain is that of its start",
    "warm_up": "follows the clock of the session; the bias is that of the warm part",
    "thermal_lag": _MEMORY,
    "creep": _MEMORY,
    "hysteresis": _MEMORY,
    "stage_eccentricity": _STAGE,
    "stage_ellipticity": _STAGE,
    "stage_periodic": _STAGE,
    "backlash": _STAGE,
    "axis_tilt": _STAGE,
    "gravity": "belongs to the place: state its gravity; no angle depends on it",
    "position_slip": _DWELL,
    "outlier_dwell": _DWELL,
    "noise_change": _DWELL,
    "vibration_rectification": "follows the variance of many samples, which a single reading does not show",
}
_UNKNOWN = "is not known to be a function of the reading, the temperature or the supply"
_NAMELESS = "has no name, so that nobody knows whether it belongs to the sensor"
GYRO_CORRECTABLE = frozenset(
    {
        "g_sensitivity", "g2_sensitivity", "gyro_scale", "gyro_misalignment", "gyro_bias_temperature",
        "gyro_scale_temperature", "gyro_supply",
    }
)  # fmt: skip
"""Effects that are functions of the rate, the force, the temperature or the supply."""
_GYRO_REASONS = {
    "gyro_drift": "follows the clock of the session; the zero rate is that of its start",
    "gyro_warm_up": "follows the clock of the session; the zero rate is that of the warm part",
    "gyro_asymmetry": "differs between the two senses of turning, which no gain corrects",
}
_GYRO_NAMELESS = "has no name, so that nobody knows whether it belongs to the gyros"
_GYRO_UNKNOWN = "is not known to be a function of the rate, the force, the temperature or the supply"


def calibration_of_trace(result: TraceResult) -> Calibration:
    """Calibration by the final model of a trace: base parameters, and effects that can be corrected.

    What follows the clock alone is taken at the middle of the session: bias, gain and start angle are
    those of that time, which `not_corrected` states.

    Covariance and u are those of the final model. Models that predict the same readings may share a bias
    out in other ways, so that the trace states a larger u of single parameters; angles do not differ by it.
    Where functions of the reading are left out and one has no name, or no bias stands beside them, or a
    function of anything without a name stands in its place, the others are fitted anew with a bias: what
    these carried of it would else stand nowhere.

    Raises
    ------
    UsageError
        The result was not made from a session (`trace_readings`).
    FitError
        The trace was not finished, or is one of a single pose, which has no base model.
    """
    where = known_provenance(result.provenance)
    if not result.fits:
        raise FitError("one pose determines no calibration: measure at least four positions")
    if result.stopped is not None and not result.stopped.checked:
        raise FitError("the time limit ended the trace before its model was checked: trace with more time")
    final = result.fits[-1]
    standing = [
        term
        for term in final.terms
        if isinstance(term, NamedTerm) and term.name in CORRECTABLE and _stands(term, result)
    ]
    others = [term for term in final.terms if term not in standing and term.name != "bias"]
    left = [_left_out(term, result, middle_s(final)) for term in others]
    if result.unnamed is not None and all(term.name is not None for term in final.terms):
        left.append(NotCorrected(f"unnamed: {result.unnamed.form}", _NAMELESS))
    fit, inflation = _without(final, others, result.inflation)
    named = [term for term in fit.terms if isinstance(term, NamedTerm)]
    corrected = [term for term in named if term in standing]
    columns = _Columns(fit)
    for parameter in fit.data.model.parameters:
        columns.base(parameter)
    biased = columns.biases([term for term in named if term.name == "bias"])
    effects = tuple(columns.effect(term) for term in corrected)
    parameters, matrix = columns.stated(inflation)
    names = [one.name for one in parameters if one.u is not None]
    return as_written(
        Calibration(
            method="trace",
            provenance=where,
            parameters=parameters,
            covariance=matrix if fit.data.noise_known or inflation != 1 else None,
            effects=effects,
            not_corrected=tuple(left),
            assumed=tuple(
                one for one in assumed_parameters(fit.data.model, [*names, *biased]) if one != "alpha"
            ),
            counts_per_mg=None if fit.data.unit.known else tuple(fit.data.unit.per_mg.tolist()),
        )
    )


def _of_reading(term: Term) -> bool:
    """True for what follows the reading and nothing else."""
    return not term.enters_angle and term.covariates == ("reading",)


def _holds_bias(term: Term) -> bool:
    """True for a function without a name in the place of a bias, of which no value at one time is known."""
    return term.name is None and not term.enters_angle and not follows_clock(term)


def _without(fit: Fit, terms: Sequence[Term], inflation: float) -> tuple[Fit, float]:
    """The terms that stay and a bias fitted anew; the factor on the variance by which u holds the rest."""
    biased = any(term.name == "bias" for term in fit.terms)
    terms = [term for term in terms if _of_reading(term) or (not biased and _holds_bias(term))]
    if not terms or (biased and all(term.name is not None for term in terms)):
        return fit, inflation
    pairs = zip(fit.terms, fit.values.terms, strict=True)
    kept = [(term, own) for term, own in pairs if term not in terms]
    if not biased:
        axes = fit.data.axes
        kept.append((NamedTerm("bias", (), 0.0, effect("bias", tuple(AXES[:axes]))), np.zeros(axes)))
    values = replace(fit.values, terms=tuple(own for _, own in kept))
    # Not what `fit` makes of itself: an average over functions keeps the covariance of its members.
    again = Fit(fit.data, tuple(term for term, _ in kept), values, fit.with_prior).refit()
    misfit = again.chi2 / again.dof if again.dof > 0 else 1.0
    return again, max(inflation, misfit)


class _Columns:
    """Values of a fit with their places among its parameters, in the units that results are stated in.

    What follows the clock is taken at the middle of the session.
    """

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        axes = fit.data.axes
        self.offset, self.offset_slope = clock_at_middle(fit, np.zeros(axes))
        self.turn_rad, self.turn_slope = clock_at_middle(fit, np.zeros(axes), turned=True)
        self.unit = fit.data.unit
        self.names: list[str] = []
        self.values: list[float] = []
        self.units: list[str] = []
        self.rows: list[Floats] = []

    def _add(self, name: str, value: float, unit: str, gradient: Floats) -> None:
        self.names.append(name)
        self.values.append(value)
        self.units.append(unit)
        self.rows.append(gradient)

    def _gain(self, axis: int) -> tuple[float, Floats]:
        """Factor on the gain of an axis at the middle, and its gradient (p,)."""
        ideal_mg = np.zeros(self.fit.data.axes)
        ideal_mg[axis] = MG_PER_G
        full, slope = clock_at_middle(self.fit, ideal_mg)
        factor = 1 + (full[axis] - self.offset[axis]) / MG_PER_G
        return float(factor), (slope[axis] - self.offset_slope[axis]) / MG_PER_G

    def _gradient(self, place: int | None, factor: float = 1.0) -> Floats:
        gradient = np.zeros(len(self.fit.values.parameters))
        if place is not None:
            gradient[place] = factor
        return gradient

    def base(self, parameter: BaseParameter) -> None:
        """A base parameter; the start angle only where the dwells show it."""
        k = self.fit.data.model.index(parameter.name)
        if parameter.name == "alpha" and not self.fit.data.visible[k]:
            return
        factor, unit = parameter.per_natural, parameter.unit
        value = float(self.fit.values.base[k])
        if parameter.name.startswith("scale") and not self.unit.known:
            factor = float(self.unit.per_mg[AXES.index(parameter.name[-1])]) * MG_PER_MPS2
            unit = "counts/(m/s²)"
        gradient = self._gradient(k, factor)
        if parameter.name == "alpha":
            value += float(self.turn_rad)
            gradient += factor * self.turn_slope
        elif parameter.name.startswith("scale"):
            gain, slope = self._gain(AXES.index(parameter.name[-1]))
            gradient = gain * gradient + value * factor * slope
            value *= gain
        stated = parameter.stated(value) if unit == "deg" else value * factor
        self._add(parameter.name, stated, unit, gradient)

    def biases(self, terms: Sequence[NamedTerm]) -> list[str]:
        """Bias of every axis, zero where the model has none; names of those that it has a term for."""
        at: dict[str, int] = {}
        for term in terms:
            start = self.fit.slice_of(self.fit.terms.index(term)).start
            at |= {one.name: start + k for k, one in enumerate(term.effect.parameters)}
        for axis, letter in enumerate(AXES[: self.fit.data.axes]):
            place = at.get(f"bias_{letter}")
            factor = float(self.unit.per_mg[axis])
            value = 0.0 if place is None else float(self.fit.values.parameters[place])
            stated = float(self.unit.zero[axis]) + (value + float(self.offset[axis])) * factor
            gradient = self._gradient(place, factor) + factor * self.offset_slope[axis]
            self._add(f"bias_{letter}", stated, self.unit.name, gradient)
        return list(at)

    def effect(self, term: NamedTerm) -> EffectTerm:
        """Values of an effect."""
        index = self.fit.terms.index(term)
        start = self.fit.slice_of(index).start
        names = []
        for k, parameter in enumerate(term.effect.parameters):
            name = parameter.name
            while name in self.names:
                name += "_also"
            value = float(self.fit.values.terms[index][k])
            self._add(name, value, parameter.unit, self._gradient(start + k))
            names.append(name)
        return EffectTerm(term.effect, tuple(names))

    def stated(self, inflation: float) -> tuple[tuple[Coefficient, ...], Floats]:
        """Parameters, and their covariance (p, p)."""
        rows = np.stack(self.rows)
        matrix = rows @ self.fit.covariance @ rows.T * inflation
        sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        return tuple(
            Coefficient(name, value, float(size) if size > 0 else None, unit)
            for name, value, size, unit in zip(self.names, self.values, sizes, self.units, strict=True)
        ), matrix


def _stands(term: NamedTerm, result: TraceResult) -> bool:
    """True for a finding, and for an effect that is confounded with nothing but its like."""
    if term.name in {finding.effect for finding in result.found}:
        return True
    rivals = {name for names in result.confounded if term.name in names for name in names}
    return bool(rivals) and rivals <= CORRECTABLE | {"bias"}


def _left_out(term: Term, result: TraceResult, at_s: float) -> NotCorrected:
    name = term.name
    if follows_clock(term):
        why = _CLOCK if name is not None else _NAMELESS
        of = "the start angle is that" if term.enters_angle else "bias and gain are those"
        return NotCorrected(
            term.shown_as, f"{why}; {of} of the session's middle, {at_s:.4g} s after its start"
        )
    if name is None:
        return NotCorrected(term.shown_as, _NAMELESS)
    if name in CORRECTABLE:
        why = result.reasons.get(
            name, "the session cannot tell it from an effect that is none of the sensor"
        )
        return NotCorrected(name, f"did not stand as a finding: {why}")
    return NotCorrected(name, _REASONS.get(name, _UNKNOWN))


def estimates_of_gyro_trace(result: TraceResult) -> GyroEstimates:
    """Of `trace --sensor-part gyro`: zero rates and the effects that can be corrected, by its final model.

    Raises
    ------
    FitError
        The trace was not finished.
    """
    if not result.fits or (result.stopped is not None and not result.stopped.checked):
        raise FitError("the time limit ended the trace before its model was checked: trace with more time")
    final = result.fits[-1]
    kept = [term for term in final.terms if isinstance(term, NamedTerm) and term.name in GYRO_CORRECTABLE]
    left = [_gyro_left_out(term) for term in final.terms if term not in kept]
    if result.unnamed is not None and all(term.name is not None for term in final.terms):
        left.append(NotCorrected(f"unnamed: {result.unnamed.form}", _GYRO_NAMELESS))
    doubts = () if result.adequacy != "not adequate" else ("the gyros' trace found its model not adequate",)
    coefficients, matrix = _gyro_stated(final, kept, result.inflation)
    return GyroEstimates(
        "trace",
        {one.name: one for one in coefficients},
        ([one.name for one in coefficients], matrix),
        tuple(left),
        doubts,
    )


def _gyro_left_out(term: Term) -> NotCorrected:
    if term.name is None:
        return NotCorrected(term.shown_as, _GYRO_NAMELESS)
    return NotCorrected(term.name, _GYRO_REASONS.get(term.name, _GYRO_UNKNOWN))


def _gyro_stated(
    fit: Fit, kept: Sequence[NamedTerm], inflation: float
) -> tuple[tuple[Coefficient, ...], Floats]:
    """Parameters with gains K and misalignments of D, and their covariance."""
    names, units, places = [], [], []
    for k, parameter in enumerate(fit.data.model.parameters):
        names.append(parameter.name)
        units.append(parameter.unit)
        places.append(k)
    for term in kept:
        start = fit.slice_of(fit.terms.index(term)).start
        for k, one in enumerate(term.effect.parameters):
            names.append(one.name)
            units.append(one.unit)
            places.append(start + k)
    own = fit.values.parameters[places]
    slope = central_differences(lambda values: _gains(names, values), own, 1e-6)
    matrix = slope @ fit.covariance[np.ix_(places, places)] @ slope.T * inflation
    stated = [name.replace("gyro_scale_error", "gyro_scale") for name in names]
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return tuple(
        Coefficient(name, float(value), float(u), u_of)
        for name, value, u, u_of in zip(stated, _gains(names, own), sizes, units, strict=True)
    ), np.asarray(matrix)


def _gains(names: Sequence[str], values: Floats) -> Floats:
    """The same with what effects add to a perfect gyro turned into its gain and its misalignments.

    A gyro that adds e Ω_i + Σ sin m_p Ω_p − (1 − c) Ω_i to Ω_i, c² = 1 − Σ sin² m_p, has the row
    (c + e, sin m_p, …) of K D, whose length is K.
    """
    out = np.array(values, dtype=float)
    for axis in AXES:
        angles = [k for k, name in enumerate(names) if name.startswith(f"gyro_misalignment_{axis}")]
        sines = np.sin(np.radians(out[angles]))
        along = math.sqrt(max(1 - float(sines @ sines), 0.0))
        scale = f"gyro_scale_error_{axis}"
        if scale not in names:
            continue
        gain = math.hypot(along + float(out[names.index(scale)]), *sines)
        out[names.index(scale)] = gain
        out[angles] = np.degrees(np.arcsin(sines / gain))
    return out


def with_gyros(calibration: Calibration, session: Session, *, traced: bool = False) -> Calibration:
    """The calibration with the session's gyros in it; as it was where these cannot be calibrated.

    Raises
    ------
    SessionError
        As `gyro_calibration_of`.
    """
    try:
        gyro = gyro_calibration_of(session, traced=traced)
    except SessionError:
        raise
    except AdisGonioError:
        return calibration
    return replace(calibration, gyro=gyro)


def gyros_alone(session: Session) -> str:
    """What to do where a session calibrates its gyros and not its accelerometers; else nothing."""
    try:
        gyro_calibration_of(session)
    except AdisGonioError:
        return ""
    return (
        "; its gyros are calibrated: put them beside the accelerometers of another session of the part, "
        f"export OTHER --gyros {PurePath(session.source).name} -o both.json"
    )


def gyro_calibration_of(session: Session, *, traced: bool = False) -> GyroCalibration:
    """Calibration of a session's gyros, for the part as it is: with the offsets that were written since.

    Parameters
    ----------
    traced : bool
        By the traced model, with its effects.

    Raises
    ------
    FitError
        The session has no gyros, or does not determine their zero rates.
    SessionError
        A write of gyro offsets was interrupted, so that only the sensor can tell.
    """
    return gyro_as_written(gyros_as_recorded(session, traced=traced), provenance_of(session))


def gyros_as_recorded(session: Session, *, traced: bool = False) -> GyroCalibration:
    """As `gyro_calibration_of`, for the offsets that stood while the session was recorded."""
    return make_gyro_calibration(gyro_estimates_of(session, traced=traced), provenance_of(session))


def calibration_of_gyro_trace(result: TraceResult) -> GyroCalibration:
    """Calibration by the final model of a trace of the gyros, for the part as it is.

    Raises
    ------
    FitError
        The trace was not finished, or a zero rate is not determined.
    SessionError
        As `gyro_calibration_of`.
    """
    return gyro_calibration_as_it_is(estimates_of_gyro_trace(result), result.provenance)


def gyro_estimates_of(session: Session, *, traced: bool = False) -> GyroEstimates:
    """Parameters of a session's gyros by name.

    Raises
    ------
    DataError, FitError
        The session has no gyros, or none whose unit is known, or no dwell.
    """
    if traced:
        from adis_gonio.tracing.trace import trace

        return estimates_of_gyro_trace(trace(session, part="gyro"))
    from adis_gonio.fitting.gyros.fit import fit_gyro

    return estimates_of_gyro_fit(fit_gyro(session))
