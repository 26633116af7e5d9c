"""From a fit or a trace to a `Calibration`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.calibration.calibration import (
    Calibration,
    Coefficient,
    EffectTerm,
    NotCorrected,
)
from adis_gonio.errors import FitError, SessionError, UsageError
from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.terms import NamedTerm, Term
from adis_gonio.fitting.result import Estimate, FitResult
from adis_gonio.model.effects import AXES, effect
from adis_gonio.model.measurement import BaseParameter, FreeAttitude, PlanarTurn
from adis_gonio.model.provenance import Provenance
from adis_gonio.model.records import MG_PER_G, MG_PER_MPS2, Floats
from adis_gonio.tracing.outcome.clock import clock_at_middle, follows_clock, middle_s
from adis_gonio.tracing.outcome.result import TraceResult
from adis_gonio.writeback.journal import INTERRUPTED

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


def calibration_of_fit(result: FitResult) -> Calibration:
    """Return the calibration by a fit, for the offsets that the sensor holds now.

    Raises
    ------
    UsageError, FitError
        As `calibration_as_recorded`.
    SessionError
        A write of offsets to the sensor was interrupted.
    """
    return _as_written(calibration_as_recorded(result))


def calibration_as_recorded(result: FitResult) -> Calibration:
    """Return the calibration by a fit, for the offsets in force while its session was recorded.

    Only this calibration may meet the session's own readings: a write since then changes the sensor and
    the coefficients, but not the readings.

    Raises
    ------
    UsageError
        The result was not made from a session (`fit_readings`).
    FitError
        The session does not determine what an angle needs.
    """
    where = _known(result.provenance)
    model = _model(where)
    estimates = {one.name: one for one in result.parameters}
    if where.plane == "xy" and "scale_x" not in estimates and "delta_k" in estimates:
        # Only the ratio is known, and an angle needs no more: Y is taken as the unit.
        ratio = estimates["delta_k"]
        estimates["scale_x"] = Estimate("scale_x", 1 + ratio.value, ratio.u, "1")
    names = [name for name in _names(model) if name in estimates]
    given = [one.name for one in result.parameters]
    rows = [given.index("delta_k" if name not in given else name) for name in names]
    matrix = None if result.covariance is None else result.covariance[np.ix_(rows, rows)]
    parameters = tuple(
        Coefficient(
            name,
            estimates[name].value,
            estimates[name].u,
            estimates[name].unit,
            getattr(estimates[name], "dof", None),
        )
        for name in names
    )
    assumed = _assumed(model, names)
    counts = (
        tuple(estimates[f"scale_{axis}"].value / MG_PER_MPS2 for axis in AXES[: model.axes])
        if (where.counts)
        else None
    )
    return Calibration(result.method, where, parameters, matrix, assumed=assumed, counts_per_mg=counts)


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
    where = _known(result.provenance)
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
    return _as_written(
        Calibration(
            method="trace",
            provenance=where,
            parameters=parameters,
            covariance=matrix if fit.data.noise_known or inflation != 1 else None,
            effects=effects,
            not_corrected=tuple(left),
            assumed=tuple(name for name in _assumed(fit.data.model, [*names, *biased]) if name != "alpha"),
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


def _as_written(calibration: Calibration) -> Calibration:
    """For the part as it is: what a write-back made the chip correct is not corrected again."""
    where = calibration.provenance
    if where.write_open:
        raise SessionError(f"{where.source}: {INTERRUPTED}")
    return calibration if where.written_lsb is None else calibration.with_offsets(where.written_lsb)


def _known(where: Provenance | None) -> Provenance:
    if where is None:
        raise UsageError("this result was made from readings: fit or trace a session to get a calibration")
    return where


def _model(where: Provenance) -> PlanarTurn | FreeAttitude:
    gravity_mg = where.gravity_mps2 * MG_PER_MPS2
    return PlanarTurn(gravity_mg) if where.plane == "xy" else FreeAttitude(gravity_mg)


def _names(model: PlanarTurn | FreeAttitude) -> list[str]:
    return [*model.names, *(f"bias_{axis}" for axis in AXES[: model.axes])]


def _assumed(model: object, names: Sequence[str]) -> tuple[str, ...]:
    """Parameters that stand at their nominal values.

    Raises
    ------
    FitError
        Among them is one without which there is no angle.
    """
    assert isinstance(model, PlanarTurn | FreeAttitude)
    missing = [name for name in _names(model) if name not in names]
    needed = [name for name in missing if not name.startswith(("bias", "alpha", "scale_y"))]
    if needed:
        raise FitError(f"the session does not determine {', '.join(needed)}: it gives no calibration")
    return tuple(missing)


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
