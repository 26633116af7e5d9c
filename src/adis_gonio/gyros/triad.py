"""Gravity in the dwells by the accelerometers as the session calibrates them: the reference of a turn."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adis_gonio.errors import AdisGonioError
from adis_gonio.estimation.readings import Readings, mg_per_unit, readings_of
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.records import Floats, Session
from adis_gonio.sensor.variants import VARIANTS

CONSISTENT = 4.0
"""Standard uncertainties within which a declared turn and gravity's may be averaged."""
_NOT_CALIBRATED = (
    "the accelerometers' biases are not determined: u of the directions of axes holds what they may be;"
    " rest each arrow up and down"
)
_NOT_SQUARE = (
    "the angles between the accelerometers are not determined: u of the directions of axes holds what they"
    " may be; rest the part with gravity shared between two axes"
)
UNKNOWN_LEAN_DEG = 0.25
UNKNOWN_BIAS_MG = 50.0
"""Of a sensor without figures (one real ADIS16350 showed +57 mg)."""


@dataclass(frozen=True)
class Triad:
    """The accelerometers as far as they are calibrated.

    Attributes
    ----------
    direction : callable
        (3,) readings in g → direction of gravity (3,) in the accelerometers' frame, any length.
    u_rad : float
        Standard uncertainty of such a direction, each way across it.
    psi_deg : mapping or None
        On a stage: angle ψ of gravity in each dwell and its standard uncertainty, by position.
    gravity : mapping
        In space: direction of gravity (3,) in each dwell, by position.
    notes : tuple of str
        What is to be said of it.
    """

    direction: Callable[[Floats], Floats]
    u_rad: float
    psi_deg: dict[int, tuple[float, float]] | None
    gravity: dict[int, Floats]
    notes: tuple[str, ...] = ()


def triad_of(session: Session) -> Triad | None:
    """The accelerometers of a session by its own fit, as read where there can be none.

    None where even the readings cannot be had.
    """
    try:
        readings = readings_of(session)
    except AdisGonioError:
        return _as_read(session)
    try:
        from adis_gonio.fitting import fit
        from adis_gonio.fitting.methods import fit_of

        # In space by gravity alone: the turns are what these gyros are to be calibrated by.
        result = fit(session, method="ml") if readings.planar else fit_of(readings, "ml")
    except AdisGonioError:
        return _as_read(session)
    u_mg = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2).mean(axis=0))
    held = any(name.startswith("bias") for name in result.undetermined)
    g = session.gravity_mg
    if readings.planar:
        try:
            calibration = result.calibration()
        except AdisGonioError:
            return _as_read(session)
        shown = calibration.angle(readings.mean, reading_u=list(u_mg))
        unseen = math.degrees(_bias_mg(session) / g) if held else 0.0
        u = np.hypot(np.asarray(shown.u_deg), unseen)
        psi = _with_declared(readings, np.asarray(shown.angle_deg), u)
        notes = (
            ("the accelerometers' biases are not determined: u of the turns holds what they may be",)
            if held
            else ()
        )
        rough = _as_read(session)
        return Triad(rough.direction, rough.u_rad, psi, rough.gravity, notes)
    found = {one.name: one.value for one in result.parameters}
    base = np.array([found.get(p.name, p.nominal) / p.per_natural for p in readings.model.parameters])
    bias = np.array([found.get(f"bias_{axis}", 0.0) for axis in AXES])

    def direction(force_mg: Floats) -> Floats:
        return readings.model.calibrated(base, force_mg - bias)

    u_rad = float(np.linalg.norm(u_mg)) / g
    told: tuple[str, ...] = ()
    if sum(name.startswith("bias") for name in found) < len(AXES):
        u_rad = math.hypot(u_rad, _rough_u_rad(session))
        told = (_NOT_CALIBRATED,)
    elif sum(name.startswith("skew") for name in found) < len(AXES):
        u_rad = math.hypot(u_rad, _lean_rad(session))
        told = (_NOT_SQUARE,)
    gravity = dict(zip(readings.position.tolist(), direction(readings.mean), strict=True))
    return Triad(lambda force: direction(1e3 * force), u_rad, None, gravity, told)


def _with_declared(readings: Readings, psi: Floats, u: Floats) -> dict[int, tuple[float, float]]:
    """ψ of each dwell; where declared angles agree with it they count by the fixture's uncertainty.

    Both are angles of the same stage: ψ + θ is α, alike for all dwells but for their errors.
    """
    sigma = math.degrees(readings.fixture_rad)
    theta = np.degrees(readings.angle_rad)
    shown = dict(zip(readings.position.tolist(), zip(psi.tolist(), u.tolist(), strict=True), strict=True))
    if not readings.fixture_stated or not 0 < sigma < math.inf or not np.isfinite(theta).all():
        return shown
    turn = np.angle(np.exp(1j * np.radians(psi + theta)))
    alpha = float(np.degrees(np.angle(np.exp(1j * turn).mean())))
    off = (psi + theta - alpha + 180.0) % 360.0 - 180.0
    agrees = np.abs(off) < CONSISTENT * np.hypot(u, sigma)
    weight = np.where(agrees, u**2 / (u**2 + sigma**2), 0.0)
    better = psi - weight * off
    better_u = np.where(agrees, u * sigma / np.hypot(u, sigma), u)
    return dict(
        zip(readings.position.tolist(), zip(better.tolist(), better_u.tolist(), strict=True), strict=True)
    )


def _as_read(session: Session) -> Triad:
    """The accelerometers without calibration; u is what a part's biases and axes may be."""
    gravity: dict[int, Floats] = {}
    if session.accel_unit != "counts":
        per_g = 1e-3 * mg_per_unit(session)
        gravity = {
            d.position: per_g * d.accel.mean(axis=0) for d in session.dwells if d.accel.shape[1] == 3
        }
    return Triad(lambda force: force, _rough_u_rad(session), None, gravity, (_NOT_CALIBRATED,))


def _rough_u_rad(session: Session) -> float:
    return math.hypot(_bias_mg(session) / session.gravity_mg, _lean_rad(session))


def _lean_rad(session: Session) -> float:
    """Of axes that nobody has measured; uniform within the sheet's limit."""
    variant = VARIANTS.get(session.sensor)
    limit = UNKNOWN_LEAN_DEG if variant is None else variant.performance.non_orthogonality_deg
    return math.radians(limit) / math.sqrt(3)


def _bias_mg(session: Session) -> float:
    variant = VARIANTS.get(session.sensor)
    return UNKNOWN_BIAS_MG if variant is None else variant.performance.initial_bias_mg
