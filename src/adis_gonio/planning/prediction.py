"""What a plan will reach: uncertainties of parameters and angle, before anything is measured.

The imagined readings go through `fit` itself, so that a predicted uncertainty is what the fit of such a
session states: with the fixture, the 1/f noise that dwells share, and the part's figure of a bias that the
plan cannot see.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adis_gonio.estimation.shown import ShownAngle
from adis_gonio.estimation.values import Value
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.fitting.result import FitResult
from adis_gonio.model.records import Floats
from adis_gonio.planning.imagined import Bench, imagined
from adis_gonio.planning.sight import Sight, sight_of
from adis_gonio.session.plans import Plan


@dataclass(frozen=True)
class Reach:
    """Uncertainties that a plan reaches; the values are those of no part, and NaN.

    Attributes
    ----------
    method : str
        By which they are had.
    parameters : dict of str to Value
        Those that the plan determines.
    angle, angle_worst : Value
        The angle that the calibrated goniometer shows of a reading as long as a dwell, in degrees: root
        mean square over the turn, and at its worst place.
    fitted_deg : float
        The part of `angle_worst` that the fitted parameters have, as a standard uncertainty: what a plan
        can lower.
    undetermined : tuple of str
        Parameters that the plan cannot determine.
    notes : tuple of str
        What the fit has to say of such a session.
    """

    method: str
    parameters: dict[str, Value]
    angle: Value
    angle_worst: Value
    fitted_deg: float
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "method": self.method,
            "parameters": {name: _told(value) for name, value in self.parameters.items()},
            "angle": _told(self.angle),
            "angle_worst": _told(self.angle_worst),
            "angle_worst_by_parameters_u_deg": self.fitted_deg,
            "undetermined": list(self.undetermined),
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class Prediction:
    """What a plan will reach and see."""

    plan: Plan
    bench: Bench
    reach: Reach
    sight: Sight

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.bench.seconds(self.plan)

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "positions": len(self.plan),
            "seconds": self.seconds,
            "bench": self.bench.as_dict(),
            **self.reach.as_dict(),
            **self.sight.as_dict(),
        }


def predict(plan: Plan, bench: Bench) -> Prediction:
    """Everything that is to be said of a plan beforehand.

    Raises
    ------
    UsageError
        The plan does not turn in a plane.
    FitError
        It has too few positions, or determines neither ΔK nor Δφ.
    """
    readings = imagined(plan, bench).training
    return Prediction(plan, bench, _reach(fit_readings(readings)), sight_of(readings))


def reach_of(plan: Plan, bench: Bench) -> Reach:
    """Uncertainties alone; see `predict`."""
    return _reach(fit_readings(imagined(plan, bench).training))


def _reach(result: FitResult) -> Reach:
    made = result.origin
    assert made is not None
    assert made.sources is not None  # the imagined noise is known
    shown = ShownAngle.around(made.fit)
    whole = made.sources.by_place(shown.gradient, shown.reading)
    angle = result.shown_angle
    assert angle is not None  # a turn in the plane
    return Reach(
        result.method,
        {one.name: replace(one.stated, value=math.nan) for one in result.parameters},
        angle,
        Value(math.nan, float(np.sqrt(whole.max())), "deg"),
        float(np.sqrt(fitted_variance(result).max())),
        result.undetermined,
        result.warnings,
    )


def fitted_variance(result: FitResult) -> Floats:
    """Variance (m,) in degrees² of the shown angle around the turn, beside that reading's own noise."""
    made = result.origin
    assert made is not None
    assert made.sources is not None
    shown = ShownAngle.around(made.fit)
    own = sum(source.reading_mg2 for source in made.sources.each)
    noise = np.einsum("ma,ab,mb->m", shown.reading, own, shown.reading)
    return np.asarray(made.sources.by_place(shown.gradient, shown.reading) - noise)


def _told(value: Value) -> dict[str, Any]:
    told = value.as_dict()
    del told["value"]
    return told
