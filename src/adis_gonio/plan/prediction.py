"""What a plan will reach: uncertainties of parameters and angle, before anything is measured.

The imagined readings go through `fit` itself, so that a predicted uncertainty is what the fit of such a
session states: with the fixture, the 1/f noise that dwells share, and the part's figure of a bias that the
plan cannot see.

Few positions leave it to the stage where gravity stood, and then what they tell depends on how the stage is
off: of four positions a tilt of the axes by Δφ moves the gains by Δφ²/2, which the fixture makes something
where it is wide. There the median of sessions with stages off at random is given.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.values import Value
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.fitting.uncertainty import ShownAngle
from adis_gonio.plan.imagined import Bench, imagined
from adis_gonio.plan.sight import Sight, sight_of
from adis_gonio.record.plans import Plan

_STAGES = 16
_ALIKE = 0.05
"""Share of an uncertainty by which it may depend on how the stage is off."""
_DEPENDS = (
    "what so few positions reach depends on how the stage is off: the figures are medians of "
    f"{_STAGES} imagined sessions"
)


@dataclass(frozen=True)
class PlanUncertainty:
    """Uncertainties that a plan reaches; the values are those of no part, and NaN.

    Attributes
    ----------
    method : str
        By which they are had.
    parameters : dict of str to Value
        Those that the plan determines.
    angle, angle_worst : Value
        The angle that the calibrated goniometer shows of a reading as long as a dwell, in degrees: root
        mean square over the turn, and at its worst place; without an uncertainty where the plan leaves
        part of it undetermined.
    fitted_deg : float
        The part of `angle_worst` that the fitted parameters have, as a standard uncertainty: what a plan
        can lower; NaN where the angle is not determined.
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
    reach: PlanUncertainty
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
    return Prediction(plan, bench, reach_of(plan, bench), sight_of(imagined(plan, bench).training))


def reach_of(plan: Plan, bench: Bench) -> PlanUncertainty:
    """Uncertainties alone; see `predict`."""
    stages = np.random.default_rng(0).normal(0.0, bench.fixture_deg, (_STAGES, len(plan)))
    exact = _reach(fit_readings(imagined(plan, bench).training))
    if _agree(exact, _off(plan, bench, stages[0])):
        return exact
    return _median(exact, [_off(plan, bench, stage) for stage in stages])


def _off(plan: Plan, bench: Bench, stage_deg: Floats) -> PlanUncertainty | None:
    """The same of a stage that is off by (n,) degrees; None where such a session determines nothing."""
    try:
        return _reach(fit_readings(imagined(plan, bench, stage_deg).training))
    except FitError:
        return None


def _agree(one: PlanUncertainty, other: PlanUncertainty | None) -> bool:
    if other is None or one.undetermined != other.undetermined:
        return False
    pairs = [(value.u, other.parameters[name].u) for name, value in one.parameters.items()]
    return all(a is None or b is None or abs(b - a) <= _ALIKE * a for a, b in pairs)


def _median(exact: PlanUncertainty, stages: Sequence[PlanUncertainty | None]) -> PlanUncertainty:
    """Medians over sessions; without an uncertainty what fewer than half of them determine."""

    def middle(value: Value, of: Callable[[PlanUncertainty], float | None]) -> Value:
        found = [None if stage is None else of(stage) for stage in stages]
        u = float(np.median([math.inf if u is None else u for u in found]))
        return replace(value, u=u if math.isfinite(u) else None)

    names = dict.fromkeys(name for stage in stages if stage is not None for name in stage.parameters)
    known = {name: value for stage in (exact, *stages) if stage for name, value in stage.parameters.items()}
    parameters = {
        name: middle(known[name], lambda stage, name=name: _u_of(stage, name))  # type: ignore[misc]
        for name in (*exact.parameters, *(name for name in names if name not in exact.parameters))
    }
    sure = {name: value for name, value in parameters.items() if value.u is not None}
    fitted = middle(exact.angle, lambda stage: stage.fitted_deg if stage.angle.u is not None else None)
    return replace(
        exact,
        parameters=sure,
        angle=middle(exact.angle, lambda stage: stage.angle.u),
        angle_worst=middle(exact.angle_worst, lambda stage: stage.angle_worst.u),
        fitted_deg=math.nan if fitted.u is None else fitted.u,
        undetermined=tuple(name for name in (*parameters, *exact.undetermined) if name not in sure),
        notes=(*exact.notes, _DEPENDS),
    )


def _u_of(reach: PlanUncertainty, name: str) -> float | None:
    return reach.parameters[name].u if name in reach.parameters else None


def _reach(result: FitResult) -> PlanUncertainty:
    made = result.origin
    assert made is not None
    assert made.sources is not None  # the imagined noise is known
    shown = ShownAngle.around(made.fit)
    angle = result.shown_angle
    assert angle is not None  # a turn in the plane
    whole = float(np.sqrt(made.sources.by_place(shown.gradient, shown.reading).max()))
    fitted = float(np.sqrt(fitted_variance(result).max()))
    sure = angle.u is not None
    return PlanUncertainty(
        result.method,
        {one.name: replace(one.stated, value=math.nan) for one in result.parameters},
        angle,
        Value(math.nan, whole if sure else None, "deg"),
        fitted if sure else math.nan,
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
