"""The five methods by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees, wrap_radians
from adis_gonio.base.budget import current
from adis_gonio.base.errors import FitError, SingularError, UsageError
from adis_gonio.fitting.closed_form import (
    FOUR,
    LEAST_MMPM,
    TWO,
    fit_mmpm,
    fit_paper,
    fit_positions,
    rows_at,
)
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.likelihood import fit_ml
from adis_gonio.fitting.linked import linked_readings
from adis_gonio.fitting.result import FitResult
from adis_gonio.fitting.slips.session_positions import in_context, positions_of
from adis_gonio.fitting.solvable import solvable
from adis_gonio.model.records import Session
from adis_gonio.record.provenance import provenance_of

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

FREE_TURN = "free-turn"
"""The method of a continuous recording (`adis_gonio.fitting.free_turn`), which has no positions."""

_TWO_REVERSED = (0, 270)
"""The two positions where the stage turned the other way than declared."""


@solvable
def fit(session: Session, method: str | None = None, gyros: GyroCalibration | None = None) -> FitResult:
    """Parameters of a session with their covariance.

    Parameters
    ----------
    session : Session
        Dwells; those for checking take no part.
    method : str, optional
        One of `METHODS`, or `free-turn` of a continuous recording; by default the best that the
        session supports: `ml`, or `two-position` where
        there is nothing but 0° and 90°.
    gyros : GyroCalibration, optional
        Of the session's gyros, made of another session: poses in space between which the part was turned on
        record gain equations by them; by default their data sheet counts.

    Raises
    ------
    UsageError
        No such method; a calibration of gyros that the session cannot use.
    DataError
        Samples that cannot be used: all zero, stuck, not finite.
    FitError
        The session lacks what the method needs.
    SingularError
        The session does not determine what the method gives.
    """
    if method is not None and method not in (*METHODS, FREE_TURN):
        raise UsageError(f"no method is called '{method}'; known: {', '.join((*METHODS, FREE_TURN))}")
    if method == FREE_TURN or (session.free_turn and method is None):
        from adis_gonio.fitting.free_turn import fit_free_turn

        return fit_free_turn(session)
    if session.free_turn and not session.dwells:
        raise FitError(
            f"{session.source or 'session'}: method {method} needs positions; this is one continuous turn:"
            " use method free-turn"
        )
    readings, links = linked_readings(session, readings_of(session), gyros)
    current().tell(f"method {method}" if method else "the best method")
    try:
        result = fit_of(readings, method)
    except FitError as error:
        raise type(error)(in_context(session, error)) from error
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
    """The same of a session's readings, `check` dwells left out; worked out once and kept with them."""
    kept: dict[str | None, FitResult] = vars(readings).setdefault("_fits", {})
    if method not in kept:
        kept[method] = fit_readings(readings.training, method)
        kept.setdefault(kept[method].method, kept[method])
    return kept[method]


def fit_readings(readings: Readings, method: str | None = None) -> FitResult:
    """Same as `fit`, of readings: three axes are fitted in space, two in the plane."""
    spatial = not readings.planar
    _refuse_one_position(readings, spatial=spatial)
    if spatial:
        if method not in (None, "ml"):
            raise FitError(
                f"method {method} needs a plane of rotation; this session has none: use method ml"
            )
        return fit_ml(readings)
    if method not in (None, "ml") and readings.free:
        raise FitError(
            f"method {method} needs declared angles and fixture_sigma_deg is free here: use method ml"
        )
    if method is not None:
        return _BY_NAME[method](readings)
    if default_method(readings) == "two-position":
        return fit_positions(readings, "two-position", _two(readings))
    try:
        return fit_ml(readings)
    except SingularError:
        if not readings.free and all(len(rows) for rows in rows_at(readings, _two(readings))):
            return fit_positions(readings, "two-position", _two(readings))
        raise


def applicable_methods(session: Session) -> tuple[str, ...]:
    """Methods whose positions the session has; whether they are determined only a fit can tell."""
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
    """The same of readings that may be fitted."""
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
    return tuple(method.name for method in _METHODS if method.suits(dwells))


@dataclass(frozen=True)
class _Dwells:
    """Dwells of a planar session: their number, declared angles, and those of 0°, 90°, 180°, 270° held."""

    count: int
    declared: int
    held: tuple[bool, ...]
    free: bool
    known_zero: bool

    def hold(self, *quarters: int) -> bool:
        """True if angles are worth something and all these quarter turns are held."""
        return not self.free and all(self.held[k] for k in quarters)

    @property
    def has_two(self) -> bool:
        """True if two positions a quarter turn apart determine ΔK and Δφ."""
        return self.known_zero and (self.hold(0, 1) or self.hold(0, 3))

    @property
    def has_four(self) -> bool:
        """True if opposite positions cancel the biases."""
        return self.hold(0, 1, 2, 3)

    @property
    def has_enough(self) -> bool:
        """True if there are enough dwells for a fit of all positions."""
        return self.count >= (2 if self.declared == self.count and not self.free else 3)


@dataclass(frozen=True)
class Method:
    """Method of a planar fit.

    Attributes
    ----------
    fit : callable
        From `Readings` to a `FitResult`; raises `FitError` or `SingularError`.
    suits : callable
        True if the session has the positions that the method needs.
    """

    name: str
    fit: Callable[[Readings], FitResult]
    suits: Callable[[_Dwells], bool]


_METHODS = (
    Method("paper", fit_paper, lambda d: d.known_zero and d.hold(0, 1)),
    Method("two-position", lambda r: fit_positions(r, "two-position", _two(r)), lambda d: d.has_two),
    Method(
        "four-position", lambda r: fit_positions(r, "four-position", FOUR), lambda d: d.hold(0, 1, 2, 3)
    ),
    Method("mmpm", fit_mmpm, lambda d: not d.free and d.declared >= LEAST_MMPM),
    Method("ml", fit_ml, lambda d: d.has_enough),
)
METHODS = tuple(method.name for method in _METHODS)
"""Names of the methods."""
_BY_NAME = {method.name: method.fit for method in _METHODS}


def _two(readings: Readings) -> tuple[int, int]:
    """Angles of the two positions: the closed form is exact for any pair a quarter turn apart."""
    at_0, at_90, at_270 = map(len, rows_at(readings, (0, 90, 270)))
    return _TWO_REVERSED if at_0 and at_270 and not at_90 else TWO


def default_method(readings: Readings) -> str:
    """What is used where nothing tells methods apart: `ml`, of nothing but 0° and 90° `two-position`."""
    return "two-position" if readings.planar and _only_two(readings) else "ml"


def _only_two(readings: Readings) -> bool:
    rows = rows_at(readings, _two(readings))
    return (
        not readings.free
        and readings.unit.known
        and all(len(r) for r in rows)
        and sum(map(len, rows)) == len(readings)
    )


def _refuse_one_position(readings: Readings, *, spatial: bool) -> None:
    n = len(readings)
    declared = readings.angle_rad[np.isfinite(readings.angle_rad)]
    alike = len(declared) == n and bool(np.abs(wrap_radians(declared - declared[0])).max() < 1e-3)
    if n == 1 or (alike and not spatial):
        needs = "six positions in space" if spatial else "two positions, 0° and 90°, better four"
        raise FitError(
            f"one position only (position {readings.position[0]}): a calibration needs at least {needs}"
        )
