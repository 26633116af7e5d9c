"""Gains, skews and biases of the accelerometers with what is not known of them: where a direction leads.

Each of the nine is as a fit of the same session has it, else as a calibration of the part has it, else that
of a perfect triad within what parts of the family are. An error of one of them moves the directions of all
turns of a session at once, and in a way of its own: what a bias of Y adds to the misalignments is the same
in every turn about X, and nothing in those about Y.

Gravity in the dwells by the accelerometers as the session calibrates them: the reference of a turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, mean_direction, wrap_degrees
from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, mg_per_unit, readings_of
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import SKEW_AXES, sensitivity
from adis_gonio.model.records import Session

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

GAINS = tuple(f"scale_{axis}" for axis in AXES)
SKEWS = tuple(f"skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES)
BIASES = tuple(f"bias_{axis}" for axis in AXES)
NAMES = (*GAINS, *SKEWS, *BIASES)
_NOMINAL = np.array([1.0] * 3 + [0.0] * 6)
_NATURAL = np.array([1.0] * 3 + [math.pi / 180] * 3 + [1.0] * 3)
"""Units inside: 1, rad, mg; results state skews in degrees."""
_STEP = 0.01


@dataclass(frozen=True)
class Prior:
    """Standard uncertainty of what nobody has measured: of gains, skews in rad, biases in mg."""

    gain: float
    skew_rad: float
    bias_mg: float


@dataclass(frozen=True)
class Axes:
    """The nine with their covariance.

    Attributes
    ----------
    values : (9,) float
        Gains, skews in rad, biases in mg.
    factor : (9, k) float
        Directions of one standard uncertainty: the covariance is factor factorᵀ.
    known : frozenset of str
        Names that something has measured.
    """

    values: Floats
    factor: Floats
    known: frozenset[str]

    @classmethod
    def of(cls, prior: Prior, *sources: tuple[Mapping[str, float], Sequence[str], Floats | None]) -> Axes:
        """The nine by sources, the first that has one counts.

        Parameters
        ----------
        sources : (values, names, covariance)
            Values by name as results state them (degrees, mg); covariance in the order of `names`.
        """
        values = _NOMINAL.copy()
        spread = np.repeat(np.array([prior.gain, prior.skew_rad, prior.bias_mg], dtype=float), 3)
        covariance, known = np.diag(spread**2), set[str]()
        for found, order, matrix in sources:
            new = [k for k, name in enumerate(NAMES) if name in found and name not in known]
            if matrix is None or not new:
                continue
            values[new] = [found[NAMES[k]] * _NATURAL[k] for k in new]
            rows = [list(order).index(NAMES[k]) for k in new]
            block = np.asarray(matrix)[np.ix_(rows, rows)] * np.outer(_NATURAL[new], _NATURAL[new])
            covariance[np.ix_(new, new)] = block
            known |= {NAMES[k] for k in new}
        variance, vectors = np.linalg.eigh(covariance)
        return cls(values, vectors * np.sqrt(np.maximum(variance, 0.0)), frozenset(known))

    def knows(self, names: Sequence[str]) -> bool:
        """True where all of them were measured."""
        return self.known.issuperset(names)

    def direction(self, force_g: Floats) -> Floats:
        """Gravity (…, 3) of readings (…, 3) in g, in the accelerometers' frame, any length."""
        return _direction(self.values, force_g)

    def modes(self, force_g: Floats) -> Floats:
        """Change (3, k) of the unit direction of a reading by each of the factor's directions."""
        return central_differences(
            lambda values: _unit(_direction(values, force_g)), self.values, _STEP, self.factor.T
        )

    def u_rad(self) -> float:
        """Of a direction, each way across it: the mean over the axes' own."""
        sizes = [np.linalg.norm(self.modes(row)) for row in np.eye(3)]
        return float(np.sqrt(np.mean(np.square(sizes)) / 2))


def _direction(values: Floats, force_g: Floats) -> Floats:
    inverse = np.linalg.inv(sensitivity(values[:6]))
    return np.asarray((force_g - 1e-3 * values[6:]) @ inverse.T)


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector))


def source_of_calibration(
    names: Sequence[str], values: Floats, covariance: Floats | None
) -> tuple[dict[str, float], list[str], Floats | None]:
    """A calibration's parameters as a source; Δφ of one in the plane is skew_xy.

    Raises
    ------
    UsageError
        It states no uncertainties.
    """
    if covariance is None:
        raise UsageError("the calibration of the accelerometers states no uncertainties: fit one that does")
    stated = ["skew_xy" if name == "delta_phi" else name for name in names]
    return dict(zip(stated, values.tolist(), strict=True)), stated, covariance


Source = tuple[Mapping[str, float], Sequence[str], "Floats | None"]

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
UNKNOWN_SKEW_DEG = 0.25
UNKNOWN_BIAS_MG = 50.0
"""Of a part that nobody has measured: the one real ADIS16350 showed +57, −21, +46 mg. The figure of 10 mg
that simulated parts have by default is an estimate, and no limit."""
UNKNOWN_ACCEL_GAIN = 0.02


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
    modes : callable or None
        (3,) readings in g → changes (3, k) of the unit direction, one standard uncertainty each, that are
        the same for all turns of the session.
    """

    direction: Callable[[Floats], Floats]
    u_rad: float
    psi_deg: dict[int, tuple[float, float]] | None
    gravity: dict[int, Floats]
    notes: tuple[str, ...] = ()
    modes: Callable[[Floats], Floats] | None = None


def triad_of(session: Session, calibration: Calibration | None = None) -> Triad:
    """The accelerometers of a session by its own fit, as read where there can be none.

    Parameters
    ----------
    calibration : Calibration, optional
        Of the same part's accelerometers: what the session does not determine itself is taken from there.
    """
    given: list[Source] = []
    if calibration is not None:
        names = [one.name for one in calibration.parameters]
        given.append(source_of_calibration(names, calibration.values, calibration.covariance))
    try:
        readings = readings_of(session)
    except AdisGonioError:
        return _as_read(session, *given)
    try:
        from adis_gonio.fitting import fit
        from adis_gonio.fitting.fit_result import calibration_as_recorded
        from adis_gonio.fitting.methods import fit_of

        # In space by gravity alone: the turns are what these gyros are to be calibrated by.
        result = fit(session, method="ml") if readings.planar else fit_of(readings, "ml")
    except AdisGonioError:
        return _as_read(session, *given)
    u_mg = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2).mean(axis=0))
    held = any(name.startswith("bias") for name in result.undetermined)
    g = session.gravity_mg
    if readings.planar:
        try:
            calibration = calibration_as_recorded(result)
        except AdisGonioError:
            return _as_read(session)
        shown = calibration.angle(readings.mean, reading_u=list(u_mg))
        unseen = math.degrees(UNKNOWN_BIAS_MG / g) if held else 0.0
        u = np.hypot(np.asarray(shown.u_deg), unseen)
        psi = _with_declared(readings, np.asarray(shown.angle_deg), u)
        notes = (
            ("the accelerometers' biases are not determined: u of the turns holds what they may be",)
            if held
            else ()
        )
        rough = _as_read(session, *given)
        return Triad(rough.direction, rough.u_rad, psi, rough.gravity, notes, rough.modes)
    found = {one.name: one.value for one in result.parameters}
    own = (found, [one.name for one in result.parameters], result.covariance)
    return _spatial(session, Axes.of(_prior(session), own, *given), readings)


def _spatial(session: Session, axes: Axes, readings: Readings | None) -> Triad:
    """In space, by the nine as far as they are known."""
    noise = 0.0
    if readings is not None:
        noise = float(np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2).mean(axis=0)).max())
    told: tuple[str, ...] = ()
    if not axes.knows(BIASES):
        told = (_NOT_CALIBRATED,)
    elif not axes.knows(SKEWS):
        told = (_NOT_SQUARE,)
    u_rad = math.hypot(noise / session.gravity_mg, axes.u_rad())
    gravity = {
        position: axes.direction(force) for position, force in _forces(session).items() if len(force) == 3
    }
    return Triad(axes.direction, u_rad, None, gravity, told, axes.modes)


def _with_declared(readings: Readings, psi: Floats, u: Floats) -> dict[int, tuple[float, float]]:
    """ψ of each dwell; where declared angles agree with it they count by the fixture's uncertainty.

    Both are angles of the same stage: ψ + θ is α, alike for all dwells but for their errors.
    """
    sigma = math.degrees(readings.fixture_rad)
    theta = np.degrees(readings.angle_rad)
    shown = dict(zip(readings.position.tolist(), zip(psi.tolist(), u.tolist(), strict=True), strict=True))
    if not readings.fixture_stated or not 0 < sigma < math.inf or not np.isfinite(theta).all():
        return shown
    alpha = math.degrees(mean_direction(np.radians(psi + theta)))
    off = wrap_degrees(psi + theta - alpha)
    agrees = np.abs(off) < CONSISTENT * np.hypot(u, sigma)
    weight = np.where(agrees, u**2 / (u**2 + sigma**2), 0.0)
    better = psi - weight * off
    better_u = np.where(agrees, u * sigma / np.hypot(u, sigma), u)
    return dict(
        zip(readings.position.tolist(), zip(better.tolist(), better_u.tolist(), strict=True), strict=True)
    )


def _as_read(session: Session, *given: Source) -> Triad:
    """The accelerometers without a fit of the session; u is what a part's biases and axes may be."""
    return _spatial(session, Axes.of(_prior(session), *given), None)


def _forces(session: Session) -> dict[int, Floats]:
    """What the accelerometers read in g, by position; nothing of counts."""
    if session.accel_unit == "counts":
        return {}
    per_g = 1e-3 * mg_per_unit(session)
    return {dwell.position: per_g * dwell.accel.mean(axis=0) for dwell in session.dwells}


def _prior(session: Session) -> Prior:
    """Of what nobody has measured: gains, skews (uniform within the sheet's limit), biases."""
    variant = VARIANTS.get(session.sensor)
    if variant is None:
        return Prior(UNKNOWN_ACCEL_GAIN, math.radians(UNKNOWN_SKEW_DEG) / math.sqrt(3), UNKNOWN_BIAS_MG)
    figures = variant.performance
    return Prior(figures.scale_error_typical, figures.skew_u_rad, UNKNOWN_BIAS_MG)
