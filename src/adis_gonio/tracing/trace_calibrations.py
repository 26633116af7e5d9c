"""Calibrations of accelerometers and gyros from sessions, by the final model of a trace or by a fit.

`load_calibration` and `load_gyro_calibration` read a JSON file, or fit a session.

Importing this module enables `Calibration.load` and `GyroCalibration.load` to fit a session; the classes
themselves are in a lower package than the fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, wrap_degrees
from adis_gonio.base.errors import AdisGonioError, DataError, FitError, SessionError, UsageError
from adis_gonio.base.output import ends_in
from adis_gonio.calibrate.calibration import Calibration, Coefficient, EffectTerm, NotCorrected
from adis_gonio.calibrate.calibration_document import any_calibration_in, calibration_in
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.fitting.determination import determine, is_determined
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.fit_result import as_written, assumed_parameters, known_provenance, outputs_of
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro, stated_parameters
from adis_gonio.model.effects import AXES, catalogue
from adis_gonio.model.records import MG_PER_G, Session
from adis_gonio.record.provenance import Provenance, provenance_of
from adis_gonio.tracing.averaging import AveragedFit, AveragedTerm, middle_s
from adis_gonio.tracing.findings import bias_places, clock_at_middle, follows_clock
from adis_gonio.tracing.trace_result import TraceResult

_CLOCK = "follows the clock of the session, which no later reading shares"
_UNKNOWN = "is not known to be a function of the readings, the temperature or the supply"
_NAMELESS = "has no name, so it may not belong to the sensor"


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
    final = _checked_fit(result)
    standing = [
        term
        for term in final.terms
        if isinstance(term, NamedTerm) and term.effect.correctable and _is_corrected(term, result)
    ]
    others = [term for term in final.terms if term not in standing and not term.constant]
    left = [_reason_not_corrected(term, result, middle_s(final)) for term in others] + _unnamed_part(result)
    fit, inflation = _refit_without(final, others, result.inflation)
    corrected = [term for term in fit.terms if isinstance(term, NamedTerm) and term in standing]
    rows, matrix = _stated_with_covariance(fit, corrected, inflation)
    # Plain fits give the share of the unseen biases; an `AveragedFit` has the covariance of its members.
    plain = Fit(fit.data, fit.terms, fit.values, fit.with_prior)
    wider, unseen = _with_unseen_biases(plain)
    more, less = (_stated_with_covariance(one, corrected, inflation)[1] for one in (wider, plain))
    matrix = matrix + more - less
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    parameters = tuple(
        Coefficient(name, value, u if u > 0 else None, unit, result.dof)
        for (name, value, unit), u in zip(rows, sizes.tolist(), strict=True)
    )
    # The parameters of the effects are last, in the order of the effects.
    last = iter(parameters[len(rows) - sum(len(term.effect.parameters) for term in corrected) :])
    effects = tuple(
        EffectTerm(term.effect, tuple(next(last).name for _ in term.effect.parameters))
        for term in corrected
    )
    names = {one.name for one in parameters if one.u is not None} | {*_biases(fit), "alpha"}
    return as_written(
        Calibration(
            method="trace",
            provenance=where,
            parameters=parameters,
            covariance=matrix if fit.data.noise_known or inflation != 1 else None,
            effects=effects,
            not_corrected=tuple(left),
            assumed=assumed_parameters(fit.data.model, sorted(names - unseen)),
            counts_per_mg=None if fit.data.unit.known else tuple(fit.data.unit.per_mg.tolist()),
            ratio_dof=result.dof,
        )
    )


def _checked_fit(result: TraceResult) -> Fit:
    """Return the fit of the final model; raise `FitError` if the trace ended before it was validated."""
    if result.stopped is not None and not result.stopped.checked:
        raise FitError("the time limit ended the trace before its model was checked: trace with more time")
    return result.fits[-1]


def _unnamed_part(result: TraceResult) -> list[NotCorrected]:
    """Return the unnamed part as not corrected; empty if a term of the model is unnamed."""
    if result.unnamed is None or any(term.name is None for term in result.fits[-1].terms):
        return []
    return [NotCorrected(f"unnamed: {result.unnamed.form}", _NAMELESS)]


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
        kept.append((NamedTerm.offset(AXES[: fit.data.axes]), np.zeros(fit.data.axes)))
    values = replace(fit.values, terms=tuple(own for _, own in kept))
    # A plain `Fit`: an `AveragedFit` would keep the covariance of its members.
    again = Fit(fit.data, tuple(term for term, _ in kept), values, fit.with_prior).refit()
    misfit = again.chi2 / again.dof if again.dof > 0 else 1.0
    return again, max(inflation, misfit)


def _with_unseen_biases(fit: Fit) -> tuple[Fit, set[str]]:
    """Add the biases that the readings do not determine: zero, with the uncertainty of an unknown part.

    Returned are the fit and the names of these biases. An error of such a bias moves the other parameters,
    too. A bias of a size that nothing states is not added.
    """
    found, sizes = determine(fit.data), fit.data.unseen_bias_mg
    ways = np.eye(len(found.free))[-len(sizes) :]  # the biases are the last parameters
    lost = [k for k, way in enumerate(ways) if not (way @ found.free and is_determined(way, found.null))]
    added = [k for k in lost if sizes[k] and AXES[k] not in bias_places(fit)]
    terms = [NamedTerm.offset(AXES[k], sizes[k]) for k in added]
    if terms:
        values = replace(fit.values, terms=(*fit.values.terms, *(np.zeros(1) for _ in terms)))
        fit = Fit(fit.data, (*fit.terms, *terms), values, fit.with_prior)
    return fit, {f"bias_{AXES[k]}" for k in added}


def _stated_with_covariance(
    fit: Fit, corrected: Sequence[NamedTerm], inflation: float
) -> tuple[list[tuple[str, float, str]], Floats]:
    """Return the parameters of a calibration as in `_stated`, and their covariance matrix.

    `inflation` is the factor on the noise variance.
    """
    at, covariance = fit.values.parameters, fit.covariance
    clocks = (follows_clock(term) for term in fit.terms if isinstance(term, AveragedTerm))
    if isinstance(fit, AveragedFit) and any(clocks):
        # The reading of an averaged term at the middle of the session follows the parameters.
        at, covariance = np.concatenate([at, np.zeros(fit.data.axes)]), fit.joint_covariance

    def values(moved: Floats) -> Floats:
        return np.array([value for _, value, _ in _stated(fit, corrected, moved)])

    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = _stated(fit, corrected, at)
    turned = np.array([name == "alpha" for name, _, _ in rows])

    def difference(one: Floats, other: Floats) -> Floats:
        return np.where(turned, wrap_degrees(one - other), one - other)

    slope = central_differences(values, at, np.where(u > 0, 1e-4 * u, 1e-4), subtract=difference)
    return rows, slope @ covariance @ slope.T * inflation


def _stated(fit: Fit, corrected: Sequence[NamedTerm], at: Floats) -> list[tuple[str, float, str]]:
    """Return name, value and unit of each parameter of a calibration: base, biases, then effects.

    Terms that depend on time alone are evaluated at the middle of the session. The start angle is omitted
    if the dwells do not determine it. A bias that was not fitted is zero.

    Parameters
    ----------
    corrected : sequence of NamedTerm
        Terms of the effects that the calibration corrects.
    at : (p,) or (p + axes,) float
        Values of the fit's parameters. Further values are added to the biases.
    """
    p, axes = len(fit.values.parameters), fit.data.axes
    pieces = np.split(at[:p], [fit.slice_of(k).start for k in range(len(fit.terms))])
    fit = replace(fit, values=replace(fit.values, base=pieces[0], terms=tuple(pieces[1:])))
    offset, turn = (clock_at_middle(fit, np.zeros(axes), turned=turned)[0] for turned in (False, True))
    base, further = fit.values.base.copy(), at[p:] if len(at) > p else np.zeros(axes)
    names = [parameter.name for parameter in fit.data.model.parameters]
    for k, name in enumerate(names):
        if name == "alpha":
            base[k] += turn
        elif name.startswith("scale"):
            axis = AXES.index(name[-1])
            # Terms that depend on time alone change the gain by this factor.
            full = clock_at_middle(fit, MG_PER_G * np.eye(axes)[axis])[0]
            base[k] *= 1 + float(full[axis] - offset[axis]) / MG_PER_G
    biases = [f"bias_{letter}" for letter in AXES[:axes]]
    zeros = np.array([_biases(fit).get(name, 0.0) for name in biases]) + offset + further
    stated = {one.name: one for one in outputs_of(fit.data, np.concatenate([base, zeros]))}
    shown = [name for name, seen in zip(names, fit.data.visible, strict=True) if seen or name != "alpha"]
    rows = [(name, stated[name].value, stated[name].unit) for name in (*shown, *biases)]
    for term in corrected:
        for one, value in zip(term.effect.parameters, fit.value_of(term).tolist(), strict=True):
            name = one.name
            while name in [row[0] for row in rows]:
                name += "_also"
            rows.append((name, value, one.unit))
    return rows


def _biases(fit: Fit) -> dict[str, float]:
    """Return the biases that were fitted, in mg, by name."""
    values = fit.values.parameters
    return {f"bias_{letter}": float(values[place]) for letter, place in bias_places(fit).items()}


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
    """Return the entry of a calibration that states why it does not correct a term.

    `at_s` is the middle of the session, in s after its start.
    """
    if follows_clock(term):
        why = _CLOCK if term.name is not None else _NAMELESS
        of = "the start angle is that" if term.enters_angle else "bias and gain are those"
        at_middle = f"{of} of the session's middle, {at_s:.4g} s after its start"
        return NotCorrected(term.shown_as, f"{why}; {at_middle}")
    if isinstance(term, NamedTerm) and term.effect.correctable:
        why = result.reasons.get(
            term.effect.name, "the session cannot tell it from an effect that is none of the sensor"
        )
        return NotCorrected(term.effect.name, f"did not stand as a finding: {why}")
    return _not_corrected(term)


def gyro_calibration_of_trace(result: TraceResult) -> GyroCalibration:
    """Return the calibration by the final model of a gyro trace, for the sensor's present offsets.

    It has the zero rates and the correctable effects.

    Raises
    ------
    FitError
        The trace was not finished.
    SessionError
        A write of gyro offsets was interrupted.
    """
    final = _checked_fit(result)
    kept = [term for term in final.terms if isinstance(term, NamedTerm) and term.effect.correctable]
    left = [_not_corrected(one) for one in final.terms if one not in kept]
    left += _unnamed_part(result)
    base = final.data.model.parameters
    shown = [(one.name, one.unit) for one in base]
    shown += [(one.name, one.unit) for term in kept for one in term.effect.parameters]
    # Places of the base parameters, then of the parameters of each kept effect.
    places = np.r_[: len(base), *(final.slice_of(final.terms.index(term)) for term in kept)]
    covariance = final.covariance[np.ix_(places, places)]
    stated, values, matrix = stated_parameters(
        [name for name, _ in shown], final.values.parameters[places], covariance
    )
    matrix = matrix * result.inflation
    sizes = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    rows = map(Coefficient, stated, values.tolist(), sizes.tolist(), [unit for _, unit in shown])
    made = GyroCalibration.of(
        dict(zip(stated, rows, strict=True)),
        (stated, matrix),
        method="trace",
        where=result.provenance,
        not_corrected=tuple(left),
    )
    return made.as_written(result.provenance)


def _not_corrected(term: Term) -> NotCorrected:
    if not isinstance(term, NamedTerm):
        return NotCorrected(term.shown_as, _NAMELESS)
    return NotCorrected(term.effect.name, term.effect.not_corrected or _UNKNOWN)


def with_gyros(calibration: Calibration, session: Session, *, traced: bool = False) -> Calibration:
    """Return a calibration with the gyro calibration of a session added; unchanged if it has no gyros.

    If the session does not calibrate its gyros, `not_corrected` gets the reason. `traced` is True for the
    gyros' traced model with its effects.

    Raises
    ------
    SessionError
        A write of gyro offsets was interrupted, so that the current offsets are unknown.
    """
    try:
        gyro = gyro_calibration_of(session, traced=traced)
    except SessionError:
        raise
    except AdisGonioError as error:
        if all(dwell.gyro is None for dwell in session.dwells):
            return calibration
        lost = NotCorrected("gyros", str(error))
        return replace(calibration, not_corrected=(*calibration.not_corrected, lost))
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
    if traced:
        from adis_gonio.tracing.trace import trace

        return gyro_calibration_of_trace(trace(session, part="gyro"))
    return fit_gyro(session).calibration()


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
    from adis_gonio.fitting.methods import fit
    from adis_gonio.record.loading import explain_refusal, load_session

    _refuse_other_exports(path)
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
    made = any_calibration_in(path)
    if made is None:
        from adis_gonio.record.loading import load_session

        _refuse_other_exports(path)
        session = load_session(path)
        _refuse_another_part(part, provenance_of(session), path)
        return gyro_calibration_of(session, traced=traced)
    if isinstance(made, GyroCalibration):
        return made
    _refuse_another_part(part, made.provenance, path)
    if made.gyro is None:
        raise FitError(f"{path}: is a calibration without gyros")
    return made.gyro


def _refuse_other_exports(path: str | Path) -> None:
    if ends_in(path, *_FOR_OTHERS):
        raise DataError(f"{path}: is made for others to read; give a session, or the .json of export")


def _refuse_another_part(part: Provenance | None, other: Provenance, path: str | Path) -> None:
    if part is None:
        return
    for here, there in ((part.sensor, other.sensor), (part.serial, other.serial)):
        if here and there and here != there:
            raise UsageError(f"{path}: its gyros are of {there}, the accelerometers of {here}")


Calibration.of_session = load_calibration
GyroCalibration.of_session = load_gyro_calibration
