"""From a fit or a trace of the gyros to parameters by name, as `GyroCalibration.of` takes them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.calibration.calibration import Coefficient, NotCorrected
from adis_gonio.errors import FitError
from adis_gonio.estimation.fit import Fit
from adis_gonio.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Floats

if TYPE_CHECKING:
    from adis_gonio.fitting.gyro import GyroFit
    from adis_gonio.tracing.outcome.result import TraceResult

CORRECTED = frozenset(
    {
        "g_sensitivity", "g2_sensitivity", "gyro_scale", "gyro_misalignment", "gyro_bias_temperature",
        "gyro_scale_temperature", "gyro_supply",
    }
)  # fmt: skip
"""Effects that are functions of the rate, the force, the temperature or the supply."""
_REASONS = {
    "gyro_drift": "follows the clock of the session; the zero rate is that of its start",
    "gyro_warm_up": "follows the clock of the session; the zero rate is that of the warm part",
    "gyro_asymmetry": "differs between the two senses of turning, which no gain corrects",
}
_OTHERWISE = "is not known to be a function of the rate, the force, the temperature or the supply"
_NAMELESS = "has no name, so that nobody knows whether it belongs to the gyros"


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
    kept = [term for term in final.terms if isinstance(term, NamedTerm) and term.name in CORRECTED]
    left = [_left_out(term) for term in final.terms if term not in kept]
    if result.unnamed is not None and all(term.name is not None for term in final.terms):
        left.append(NotCorrected(f"unnamed: {result.unnamed.form}", _NAMELESS))
    doubts = () if result.adequacy != "not adequate" else ("the gyros' trace found its model not adequate",)
    coefficients, matrix = _stated(final, kept, result.inflation)
    return GyroEstimates(
        "trace",
        {one.name: one for one in coefficients},
        ([one.name for one in coefficients], matrix),
        tuple(left),
        doubts,
    )


def _left_out(term: Term) -> NotCorrected:
    if term.name is None:
        return NotCorrected(term.shown_as, _NAMELESS)
    return NotCorrected(term.name, _REASONS.get(term.name, _OTHERWISE))


def _stated(
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
    step = 1e-6
    unit = np.eye(len(own)) * step
    slope = np.stack(
        [(_gains(names, own + row) - _gains(names, own - row)) / (2 * step) for row in unit], axis=1
    )
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
