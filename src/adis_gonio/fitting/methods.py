"""Fitting methods by name: the table `METHOD_TABLE`, and `fit`, which runs one of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, solvable, wrap_degrees, wrap_radians
from adis_gonio.base.budget import current
from adis_gonio.base.errors import FitError, SingularError, UsageError
from adis_gonio.fitting.closed_form import (
    FOUR,
    LEAST_MMPM,
    TWO,
    fit_mmpm,
    fit_paper,
    fit_positions,
    refit_four,
    refit_mmpm,
    refit_two,
    rows_at,
)
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import (
    FitResult,
    Origin,
)
from adis_gonio.fitting.linked import linked_readings
from adis_gonio.fitting.maximum_likelihood import fit_ml, refit_ml
from adis_gonio.fitting.slips.session_positions import failure_message, positions_of
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration


FREE_TURN = "free-turn"
"""The method of a continuous recording (`adis_gonio.fitting.free_turn`), which has no positions."""

_TWO_REVERSED = (0, 270)
"""The two positions if the stage turned the other way than declared."""


@solvable
def fit(session: Session, method: str | None = None, gyros: GyroCalibration | None = None) -> FitResult:
    """Fit a method to a session, and return the parameters with their covariance.

    Parameters
    ----------
    session : Session
        Session to fit; its `check` dwells are not used.
    method : str, optional
        One of `METHODS`, or `free-turn` for a continuous recording. The default is the best method for the
        session: `ml`, or `two-position` if there are only 0° and 90°.
    gyros : GyroCalibration, optional
        Calibration of the session's gyros from another session. Recorded turns between poses in space then
        give more precise equations than with the data sheet.

    Raises
    ------
    UsageError
        Unknown method, or a calibration of gyros that the session cannot use.
    DataError
        Unusable samples: all zero, stuck, not finite.
    FitError
        The session lacks positions or angles that the method needs.
    SingularError
        The session does not determine the parameters of the method.
    """
    if method is not None and method not in (known := (*METHOD_TABLE, FREE_TURN)):
        raise UsageError(f"no method is called '{method}'; known: {', '.join(known)}")
    if method == FREE_TURN or (session.free_turn and method is None):
        from adis_gonio.fitting.free_turn import fit_free_turn

        return fit_free_turn(session)
    if session.free_turn and not session.dwells:
        raise FitError(
            f"{session.source or 'session'}: method {method} needs positions; this is one continuous turn:"
            " use method free-turn"
        )
    readings, links = linked_readings(session, gyros)
    current().tell(f"method {method}" if method else "the best method")
    try:
        result = fit_of(readings, method)
    except FitError as error:
        raise type(error)(failure_message(session, error)) from error
    positions = positions_of(session)
    notes = (*session.notes, *positions.sentences)
    return replace(
        result,
        warnings=(*result.doubts, *notes, *result.warnings),
        session=readings,
        session_notes=notes,
        position_findings=positions.findings,
        overrides=session.facts.get("overrides", {}),
        provenance=provenance_of(session),
        links=links,
    )


def fit_of(readings: Readings, method: str | None = None) -> FitResult:
    """Like `fit_readings`, without the `check` dwells; the result is kept for reuse."""
    if method is not None:
        return readings.once(_fit_training, method)
    return _by_default(readings.training, lambda name: fit_of(readings, name))


def _fit_training(readings: Readings, method: str) -> FitResult:
    return fit_readings(readings.training, method)


def fit_readings(readings: Readings, method: str | None = None) -> FitResult:
    """Fit a method to readings, like `fit` to a session: three axes in space, two in the plane."""
    _refuse_one_position(readings)
    if method is None:
        return _by_default(readings, lambda name: fit_readings(readings, name))
    if method != "ml" and not readings.planar:
        raise FitError(f"method {method} needs a plane of rotation; this session has none: use method ml")
    if method != "ml" and readings.free:
        raise FitError(
            f"method {method} needs declared angles and here fixture_sigma_deg is free: use method ml"
        )
    return METHOD_TABLE[method].fit(readings)


def _by_default(readings: Readings, fit_by: Callable[[str], FitResult]) -> FitResult:
    """Fit by the default method, or by `two-position` if `ml` is singular."""
    try:
        return fit_by(default_method(readings))
    except SingularError:
        has_two = all(len(rows) for rows in rows_at(readings, _two(readings)))
        if not readings.planar or readings.free or not has_two:
            raise
        return fit_by("two-position")


def applicable_methods(session: Session) -> tuple[str, ...]:
    """Methods that the positions of a session allow; a fit may still find a parameter undetermined."""
    if session.free_turn:
        return (FREE_TURN,)
    session = session.used_for("fit")
    angles = np.array([np.nan if d.angle_deg is None else d.angle_deg for d in session.dwells])
    return _applicable(
        angles,
        planar=session.plane != "none",
        free=session.free_attitudes,
        known_zero=session.accel_unit != "counts",
    )


def applicable_to(readings: Readings) -> tuple[str, ...]:
    """Methods that the positions of these readings allow."""
    return _applicable(
        np.degrees(readings.angle_rad),
        planar=readings.planar,
        free=math.isinf(readings.fixture_rad),
        known_zero=readings.unit.known,
    )


def _applicable(angles: Floats, *, planar: bool, free: bool, known_zero: bool) -> tuple[str, ...]:
    if not planar:
        return ("ml",) if len(angles) > 3 else ()
    declared = np.isfinite(angles)
    held = [bool((np.abs(wrap_degrees(angles[declared] - a)) <= 0.5).any()) for a in FOUR]
    dwells = _Dwells(len(angles), int(declared.sum()), tuple(held), free=free, known_zero=known_zero)
    return tuple(name for name, method in METHOD_TABLE.items() if method.suits(dwells))


@dataclass(frozen=True)
class _Dwells:
    """Numbers of dwells of a planar session.

    `held` has True for each of 0°, 90°, 180°, 270° that is measured.
    """

    count: int
    declared: int
    held: tuple[bool, ...]
    free: bool
    known_zero: bool

    def hold(self, *quarters: int) -> bool:
        """True if the session has declared angles and all these quarter turns (0 to 3) are measured."""
        return not self.free and all(self.held[k] for k in quarters)

    @property
    def has_enough(self) -> bool:
        """True if there are enough dwells for a fit that uses all positions."""
        return self.count >= (2 if self.declared == self.count and not self.free else 3)


def _two(readings: Readings) -> tuple[int, int]:
    """Angles in degrees of the two positions for the method `two-position`: 0 and 90, or 0 and 270.

    Its equations are exact for any two positions a quarter turn apart.
    """
    at_0, at_90, at_270 = map(len, rows_at(readings, (0, 90, 270)))
    return _TWO_REVERSED if at_0 and at_270 and not at_90 else TWO


def default_method(readings: Readings) -> str:
    """Name of the default method: `ml`, or `two-position` if only 0° and 90° are measured."""
    return "two-position" if readings.planar and _only_two(readings) else "ml"


def _only_two(readings: Readings) -> bool:
    rows = rows_at(readings, _two(readings))
    return (
        not readings.free
        and readings.unit.known
        and all(len(r) for r in rows)
        and sum(map(len, rows)) == len(readings)
    )


def _refuse_one_position(readings: Readings) -> None:
    n, spatial = len(readings), not readings.planar
    declared = readings.angle_rad[np.isfinite(readings.angle_rad)]
    alike = len(declared) == n and bool(np.abs(wrap_radians(declared - declared[0])).max() < 1e-3)
    if n == 1 or (alike and not spatial):
        needs = "six positions in space" if spatial else "two positions, 0° and 90°, better four"
        raise FitError(
            f"one position only (position {readings.position[0]}): a calibration needs at least {needs}"
        )


@dataclass(frozen=True)
class Method:
    """A fitting method: its name, its function, and the readings that it needs.

    Attributes
    ----------
    fit : callable
        From `Readings` to a `FitResult`; raises `FitError` or `SingularError`.
    refit : callable
        Repeats a fit: from other readings of all or some of the dwells, and the `Origin` of an earlier
        result, to a `Fit` of these readings with the noise of that result; raises `FitError`. Used to leave
        dwells out in the comparison of methods, and for Monte Carlo trials.
    suits : callable
        True if the session has the positions that the method needs.
    """

    fit: Callable[[Readings], FitResult]
    refit: Callable[[Readings, Origin], Fit]
    suits: Callable[[_Dwells], bool]


METHOD_TABLE = {
    "paper": Method(fit_paper, partial(refit_two, "paper"), lambda d: d.known_zero and d.hold(0, 1)),
    "two-position": Method(
        lambda r: fit_positions(r, "two-position", _two(r)),
        partial(refit_two, "two-position"),
        lambda d: d.known_zero and (d.hold(0, 1) or d.hold(0, 3)),
    ),
    "four-position": Method(
        lambda r: fit_positions(r, "four-position", FOUR), refit_four, lambda d: d.hold(0, 1, 2, 3)
    ),
    "mmpm": Method(fit_mmpm, refit_mmpm, lambda d: not d.free and d.declared >= LEAST_MMPM),
    "ml": Method(fit_ml, refit_ml, lambda d: d.has_enough),
}
"""All methods of a plane by name. `ml` also fits poses in space."""
METHODS = tuple(METHOD_TABLE)
"""Names of the methods."""
