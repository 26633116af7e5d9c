"""Calibrations of accelerometers and gyros from sessions, by the final model of a trace or by a fit.

`load_calibration` and `load_gyro_calibration` read a JSON file, or fit a session.

Importing this module enables `Calibration.load` and `GyroCalibration.load` to fit a session; the classes
themselves are in a lower package than the fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError, DataError, FitError, SessionError, UsageError
from adis_gonio.base.output import ends_in
from adis_gonio.calibrate.calibration import Calibration, Coefficient, EffectTerm, NotCorrected
from adis_gonio.calibrate.calibration_document import (
    calibration_from,
    calibration_in,
    gyro_calibration_from,
    json_document,
)
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.fit_result import as_written, assumed_parameters, known_provenance
from adis_gonio.fitting.gyros.gyro_fit import (
    GyroEstimates,
    estimates_of_gyro_fit,
    fit_gyro,
    gyro_as_written,
    make_gyro_calibration,
    stated_parameters,
)
from adis_gonio.model.effects import AXES, catalogue, effect
from adis_gonio.model.measurement import BaseParameter
from adis_gonio.model.records import MG_PER_G, MG_PER_MPS2, Session
from adis_gonio.record.provenance import Provenance, provenance_of
from adis_gonio.tracing.averaging import AveragedFit, AveragedTerm, middle_s
from adis_gonio.tracing.findings import clock_at_middle, follows_clock
from adis_gonio.tracing.trace_result import TraceResult

_CLOCK = "follows the clock of the session, which no later reading shares"
_UNKNOWN = "is not known to be a function of the reading, the temperature or the supply"
_NAMELESS = "has no name, so it may not belong to the sensor"
_GYRO_NAMELESS = "has no name, so it may not belong to the gyros"
_GYRO_UNKNOWN = "is not known to be a function of the rate, the force, the temperature or the supply"


def calibration_of_trace(result: TraceResult) -> Calibration:
    """Return the calibration by a trace's final model: base parameters, and effects that can be corrected.

    Terms that depend only on the session's clock are evaluated at the middle of the session. Bias, gain and
    start angle refer to that time, which `not_corrected` states.

    Covariance and u come from the final model. Equivalent models may divide a bias differently among
    parameters, so the trace states a larger u for single parameters, but the angles are equal. Terms that
    cannot be corrected are left out. If one is a function of the reading, it may have absorbed a part of
    the bias, so the other terms are fitted again with a bias. This is done if an unnamed function of the
    reading is left out, if the model has no bias, or if an unnamed function replaces the bias.

    Raises
    ------
    UsageError
        The result was not made from a session (`trace_readings`).
    FitError
        The trace was not finished, or is of a single pose, which has no base model.
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
        if isinstance(term, NamedTerm) and term.effect.correctable and _is_corrected(term, result)
    ]
    others = [term for term in final.terms if term not in standing and not term.constant]
    left = [_reason_not_corrected(term, result, middle_s(final)) for term in others]
    if result.unnamed is not None and all(term.name is not None for term in final.terms):
        left.append(NotCorrected(f"unnamed: {result.unnamed.form}", _NAMELESS))
    fit, inflation = _refit_without(final, others, result.inflation)
    named = [term for term in fit.terms if isinstance(term, NamedTerm)]
    corrected = [term for term in named if term in standing]
    columns = _Columns(fit)
    for parameter in fit.data.model.parameters:
        columns.base(parameter)
    biased = columns.biases([term for term in named if term.constant])
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


def _may_hold_bias(term: Term, *, biased: bool) -> bool:
    """Return True if a term may have absorbed a part of the bias.

    This is possible for a function of the reading. In a model without a bias (`biased` is False) it is
    also possible for an unnamed function with an unknown value at the middle of the session.
    """
    unnamed = not biased and term.name is None and not follows_clock(term)
    return not term.enters_angle and (term.covariates == ("reading",) or unnamed)


def _refit_without(fit: Fit, terms: Sequence[Term], inflation: float) -> tuple[Fit, float]:
    """Refit a model with a bias, without the terms that may have absorbed a part of the bias.

    Returned are the fit and its factor on the noise variance, at least `inflation`. `terms` are the terms
    that the calibration cannot correct; `_may_hold_bias` selects those to remove. The fit stays unchanged
    if there is no term to remove, or if the model has a bias and only named terms would be removed.
    """
    biased = any(term.constant for term in fit.terms)
    terms = [term for term in terms if _may_hold_bias(term, biased=biased)]
    if not terms or (biased and all(term.name is not None for term in terms)):
        return fit, inflation
    pairs = zip(fit.terms, fit.values.terms, strict=True)
    kept = [(term, own) for term, own in pairs if term not in terms]
    if not biased:
        axes = fit.data.axes
        kept.append((NamedTerm("bias", (), 0.0, effect("bias", tuple(AXES[:axes]))), np.zeros(axes)))
    values = replace(fit.values, terms=tuple(own for _, own in kept))
    # A plain `Fit`: an `AveragedFit` would keep the covariance of its members.
    again = Fit(fit.data, tuple(term for term, _ in kept), values, fit.with_prior).refit()
    misfit = again.chi2 / again.dof if again.dof > 0 else 1.0
    return again, max(inflation, misfit)


class _Columns:
    """Collector of a calibration's parameters, each with its gradient by the parameters of a fit.

    Terms that depend on time alone are evaluated at the middle of the session.
    """

    def __init__(self, fit: Fit) -> None:
        self.fit = fit
        axes = fit.data.axes
        self.offset, self._slope = clock_at_middle(fit, np.zeros(axes))
        self.turn_rad, self.turn_slope = clock_at_middle(fit, np.zeros(axes), turned=True)
        self.unit = fit.data.unit
        self.covariance, self.offset_slope = fit.covariance, self._slope
        clocks = (follows_clock(term) for term in fit.terms if isinstance(term, AveragedTerm))
        if isinstance(fit, AveragedFit) and any(clocks):
            # The reading of an averaged term at the middle follows the parameters.
            self.covariance = fit.joint_covariance
            self.offset_slope = np.concatenate([self.offset_slope, np.eye(axes)], axis=1)
        self.rows: list[tuple[str, float, str, Floats]] = []
        """Name, value, unit and gradient (p,) or (p + axes,) of each collected parameter."""

    def _gain(self, axis: int) -> tuple[float, Floats]:
        """Return the factor by which terms that depend on time alone change an axis' gain at mid-session.

        The second result is its gradient by all parameters of the fit.
        """
        ideal_mg = np.zeros(self.fit.data.axes)
        ideal_mg[axis] = MG_PER_G
        full, slope = clock_at_middle(self.fit, ideal_mg)
        factor = 1 + (full[axis] - self.offset[axis]) / MG_PER_G
        return float(factor), self._padded(slope[axis] - self._slope[axis]) / MG_PER_G

    def _padded(self, slope: Floats) -> Floats:
        """Return a gradient with zeros appended for the parameters of the fit that it lacks, (p,)."""
        return np.pad(slope, (0, len(self.covariance) - len(slope)))

    def _gradient(self, place: int | None, factor: float = 1.0) -> Floats:
        gradient = np.zeros(len(self.covariance))
        if place is not None:
            gradient[place] = factor
        return gradient

    def base(self, parameter: BaseParameter) -> None:
        """Add a base parameter to the collection; the start angle only if the dwells determine it."""
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
            gradient += factor * self._padded(self.turn_slope)
        elif parameter.name.startswith("scale"):
            gain, slope = self._gain(AXES.index(parameter.name[-1]))
            gradient = gain * gradient + value * factor * slope
            value *= gain
        stated = parameter.stated(value) if unit == "deg" else value * factor
        self.rows.append((parameter.name, stated, unit, gradient))

    def biases(self, terms: Sequence[NamedTerm]) -> list[str]:
        """Add the bias of every axis to the collection; return the names of the biases that were fitted.

        A bias that was not fitted is zero.
        """
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
            self.rows.append((f"bias_{letter}", stated, self.unit.name, gradient))
        return list(at)

    def effect(self, term: NamedTerm) -> EffectTerm:
        """Add the parameters of an effect to the collection; return the effect with the parameter names."""
        index = self.fit.terms.index(term)
        start = self.fit.slice_of(index).start
        names = []
        for k, parameter in enumerate(term.effect.parameters):
            name = parameter.name
            while name in [row[0] for row in self.rows]:
                name += "_also"
            value = float(self.fit.values.terms[index][k])
            self.rows.append((name, value, parameter.unit, self._gradient(start + k)))
            names.append(name)
        return EffectTerm(term.effect, tuple(names))

    def stated(self, inflation: float) -> tuple[tuple[Coefficient, ...], Floats]:
        """Return the collected parameters with uncertainties, and their covariance matrix.

        `inflation` is the factor on the noise variance.
        """
        rows = np.stack([gradient for _, _, _, gradient in self.rows])
        # Covariance of functions of the parameters by their gradients.
        matrix = rows @ self.covariance @ rows.T * inflation
        sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        return tuple(
            Coefficient(name, value, float(size) if size > 0 else None, unit)
            for (name, value, unit, _), size in zip(self.rows, sizes, strict=True)
        ), matrix


def _is_corrected(term: NamedTerm, result: TraceResult) -> bool:
    """Return True if the calibration of a trace corrects an effect of its model.

    The calibration corrects it if the effect is a finding, or confounded only with other effects that are
    corrected.
    """
    if term.name in {finding.effect for finding in result.found}:
        return True
    rivals = {name for names in result.confounded if term.name in names for name in names}
    known = catalogue()
    correctable = {name for name, kind in known.items() if kind.correctable or name == "bias"}
    return bool(rivals) and rivals <= correctable


def _reason_not_corrected(term: Term, result: TraceResult, at_s: float) -> NotCorrected:
    if follows_clock(term):
        why = _CLOCK if term.name is not None else _NAMELESS
        of = "the start angle is that" if term.enters_angle else "bias and gain are those"
        return NotCorrected(
            term.shown_as, f"{why}; {of} of the session's middle, {at_s:.4g} s after its start"
        )
    if isinstance(term, NamedTerm) and term.effect.correctable:
        why = result.reasons.get(
            term.effect.name, "the session cannot tell it from an effect that is none of the sensor"
        )
        return NotCorrected(term.effect.name, f"did not stand as a finding: {why}")
    return _not_corrected(term, _NAMELESS, _UNKNOWN)


def estimates_of_gyro_trace(result: TraceResult) -> GyroEstimates:
    """Return the zero rates and the correctable effects of gyros, from the final model of a trace.

    Raises
    ------
    FitError
        The trace was not finished.
    """
    if not result.fits or (result.stopped is not None and not result.stopped.checked):
        raise FitError("the time limit ended the trace before its model was checked: trace with more time")
    final = result.fits[-1]
    kept = [term for term in final.terms if isinstance(term, NamedTerm) and term.effect.correctable]
    left = [_not_corrected(one, _GYRO_NAMELESS, _GYRO_UNKNOWN) for one in final.terms if one not in kept]
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


def _not_corrected(term: Term, nameless: str, unknown: str) -> NotCorrected:
    if not isinstance(term, NamedTerm):
        return NotCorrected(term.shown_as, nameless)
    return NotCorrected(term.effect.name, term.effect.not_corrected or unknown)


def _gyro_stated(
    fit: Fit, kept: Sequence[NamedTerm], inflation: float
) -> tuple[tuple[Coefficient, ...], Floats]:
    """Return the gyro parameters of a fit in the form of a calibration, and their covariance matrix.

    `kept` are the terms of effects that can be corrected, `inflation` the factor on the noise variance.
    """
    parameters = list(fit.data.model.parameters)
    units = [one.unit for one in parameters]
    names, places = [one.name for one in parameters], list(range(len(parameters)))
    for term in kept:
        start = fit.slice_of(fit.terms.index(term)).start
        for k, one in enumerate(term.effect.parameters):
            names.append(one.name)
            units.append(one.unit)
            places.append(start + k)
    covariance = fit.covariance[np.ix_(places, places)]
    stated, values, matrix = stated_parameters(names, fit.values.parameters[places], covariance)
    matrix = matrix * inflation
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return tuple(map(Coefficient, stated, values.tolist(), sizes.tolist(), units)), matrix


def with_gyros(calibration: Calibration, session: Session, *, traced: bool = False) -> Calibration:
    """Return a calibration with the gyro calibration of a session added; unchanged if the session has none.

    `traced` is True for the gyros' traced model with its effects.

    Raises
    ------
    SessionError
        A write of gyro offsets was interrupted, so that the current offsets are unknown.
    """
    try:
        gyro = gyro_calibration_of(session, traced=traced)
    except SessionError:
        raise
    except AdisGonioError:
        return calibration
    return replace(calibration, gyro=gyro)


def gyros_alone(session: Session) -> str:
    """Return advice for an error message if a session can calibrate only its gyros; else an empty text."""
    try:
        gyro_calibration_of(session)
    except AdisGonioError:
        return ""
    return (
        "; its gyros are calibrated: combine them with the accelerometers of another session of the part, "
        f"export OTHER --gyros {PurePath(session.source).name} -o both.json"
    )


def gyro_calibration_of(session: Session, *, traced: bool = False) -> GyroCalibration:
    """Return the calibration of a session's gyros, valid for the offsets that the sensor has after it.

    Parameters
    ----------
    traced : bool
        Use the traced model with its effects.

    Raises
    ------
    FitError
        The session has no gyros, or does not determine their zero rates.
    SessionError
        A write of gyro offsets was interrupted, so that the current offsets are unknown.
    """
    return gyro_as_written(gyros_as_recorded(session, traced=traced), provenance_of(session))


def gyros_as_recorded(session: Session, *, traced: bool = False) -> GyroCalibration:
    """Return the calibration of a session's gyros, valid for the offsets that they had while recording.

    `traced` is True for the traced model with its effects.
    """
    return make_gyro_calibration(gyro_estimates_of(session, traced=traced), provenance_of(session))


def gyro_estimates_of(session: Session, *, traced: bool = False) -> GyroEstimates:
    """Return the calibration parameters of a session's gyros, from the fit or (if `traced`) the trace.

    Raises
    ------
    DataError, FitError
        The session has no gyros of known unit, or no dwell.
    """
    if traced:
        from adis_gonio.tracing.trace import trace

        return estimates_of_gyro_trace(trace(session, part="gyro"))
    return estimates_of_gyro_fit(fit_gyro(session))


_FOR_OTHERS = (".h", ".hpp", ".xml", ".html", ".parquet")
"""Endings of files that `export` and `report` write for other programs, which contain no session."""


def load_calibration(path: str | Path, method: str | None = None) -> Calibration:
    """Load a calibration from a JSON file, or fit a session file and return its calibration.

    The first character of the file shows which of them it is.

    Parameters
    ----------
    method : str, optional
        Method of the fit if the file is a session; by default the recommended one.

    Raises
    ------
    DataError
        The file is neither, or is damaged.
    FitError
        The session does not determine a calibration.
    """
    made = calibration_in(path)
    if made is not None:
        return made
    from adis_gonio.fitting import fit
    from adis_gonio.record.loading import explain_refusal, load_session

    if ends_in(path, *_FOR_OTHERS):
        raise DataError(_made_for_others(path))
    try:
        session = load_session(path)
    except DataError as error:
        raise DataError(explain_refusal(str(error))) from None
    try:
        own = fit(session, method=method).calibration()
    except FitError as error:
        raise FitError(f"{error}{gyros_alone(session)}") from None
    return with_gyros(own, session)


def load_gyro_calibration(
    path: str | Path, part: Provenance | None = None, *, traced: bool = False
) -> GyroCalibration:
    """Load a gyro calibration from a JSON file, or fit the gyros of a session file.

    Parameters
    ----------
    part : Provenance, optional
        Origin of the accelerometers that the gyros will be combined with. Gyros of another sensor or
        serial number raise `UsageError`.
    traced : bool
        For a session, use the traced model of its gyros with its effects.
    """
    document = json_document(Path(path))
    if document is None:
        from adis_gonio.record.loading import load_session

        if ends_in(path, *_FOR_OTHERS):
            raise DataError(_made_for_others(path))
        session = load_session(path)
        _refuse_another_part(part, _named(provenance_of(session)), path)
        return gyro_calibration_of(session, traced=traced)
    schema = document.get("schema") if isinstance(document, dict) else None
    if schema == Calibration.schema:
        whole = calibration_from(document, str(path))
        _refuse_another_part(part, _named(whole.provenance), path)
        if whole.gyro is None:
            raise FitError(f"{path}: is a calibration without gyros")
        return whole.gyro
    if schema is None and isinstance(document, dict) and isinstance(document.get("gyro"), dict):
        # Export of a session that calibrates only its gyros, such as one of the plan gyro-turns.
        _refuse_another_part(part, _exported(document.get("session")), path)
        return gyro_calibration_from(document["gyro"], str(path))
    if schema != GyroCalibration.schema:
        raise DataError(f"{path}: is no gyro calibration; GyroCalibration.save makes one")
    return gyro_calibration_from(document, str(path))


def _made_for_others(path: str | Path) -> str:
    return f"{path}: is made for others to read; give a session, or the .json of export"


def _named(part: Provenance) -> tuple[str, str]:
    return part.sensor, part.serial


def _exported(session: Any) -> tuple[str, str]:
    """Return the sensor and serial number that an exported JSON session states; empty if missing."""
    about = session if isinstance(session, dict) else {}
    return str(about.get("sensor") or ""), str(about.get("serial") or "")


def _refuse_another_part(part: Provenance | None, other: tuple[str, str], path: str | Path) -> None:
    if part is None:
        return
    for here, there in zip((part.sensor, part.serial), other, strict=True):
        if here and there and here != there:
            raise UsageError(f"{path}: its gyros are of {there}, the accelerometers of {here}")


Calibration.of_session = load_calibration
GyroCalibration.of_session = load_gyro_calibration
