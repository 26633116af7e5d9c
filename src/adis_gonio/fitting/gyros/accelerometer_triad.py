"""Directions of gravity by the accelerometers of a session, the reference of turns, with their uncertainty.

Gains, skews and biases are taken from a fit of the same session if it determines them, else from a
calibration of the part, else from a perfect triad with the spread of the family. An error of one of these
nine parameters changes the directions of all turns of a session at once, in its own way: a bias of Y adds
the same amount to the misalignments in every turn about X, and nothing in turns about Y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences, mean_direction, wrap_degrees
from adis_gonio.base.errors import AdisGonioError, UsageError
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.fitting.estimation.readings import Readings, readings_of
from adis_gonio.fitting.gyros.turn_integration import g_per_unit
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import SKEW_AXES, sensitivity
from adis_gonio.model.records import Session

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

Source = tuple[Mapping[str, float], Sequence[str], "Floats | None"]
"""Values by name as results state them (degrees, mg), and a covariance in the order of the names."""

GAINS = tuple(f"scale_{axis}" for axis in AXES)
SKEWS = tuple(f"skew_{AXES[i]}{AXES[j]}" for i, j in SKEW_AXES)
BIASES = tuple(f"bias_{axis}" for axis in AXES)
NAMES = (*GAINS, *SKEWS, *BIASES)
CONSISTENT = 4.0
"""Largest difference of the declared angle and the angle by gravity, in standard uncertainties, to
average both."""
UNKNOWN_SKEW_DEG = 0.25
UNKNOWN_BIAS_MG = 50.0
"""Of a part without a measurement: the one real ADIS16350 showed +57, −21, +46 mg. The default of 10 mg of
simulated parts is an estimate, and no limit."""
UNKNOWN_ACCEL_GAIN = 0.02
_NOMINAL = np.array([1.0] * 3 + [0.0] * 6)
_NATURAL = np.array([1.0] * 3 + [math.pi / 180] * 3 + [1.0] * 3)
"""Factors from the units of results to the units used here: skews from degrees to rad."""
_STEP = 0.01
_NOT_CALIBRATED = (
    "the accelerometers' biases are not determined: u of the directions of axes includes them;"
    " rest each arrow up and down"
)
_NOT_SQUARE = (
    "the angles between the accelerometers are not determined: u of the directions of axes includes"
    " them; rest the part with gravity shared between two axes"
)


@dataclass(frozen=True)
class Axes:
    """Scale factors, skews and biases of three accelerometers, with their covariance.

    Attributes
    ----------
    values : (9,) float
        Scale factors, skews in rad, biases in mg.
    factor : (9, k) float
        Factor of the covariance, which is factor factorᵀ.
    known : frozenset of str
        Names of the measured parameters.
    """

    values: Floats
    factor: Floats
    known: frozenset[str]

    @classmethod
    def of(cls, prior: tuple[float, float, float], *sources: Source) -> Axes:
        """Combine sources of the nine parameters; if several give a parameter, the first one counts.

        Parameters
        ----------
        prior : (float, float, float)
            Standard uncertainty of an unmeasured gain, skew in rad and bias in mg.
        """
        values = _NOMINAL.copy()
        covariance, known = np.diag(np.repeat(np.array(prior, dtype=float), 3) ** 2), set[str]()
        for found, order, matrix in sources:
            # Parameters that no earlier source has measured.
            new = [k for k, name in enumerate(NAMES) if name in found and name not in known]
            if matrix is None or not new:
                continue
            values[new] = [found[NAMES[k]] * _NATURAL[k] for k in new]
            rows = [list(order).index(NAMES[k]) for k in new]
            # Covariance of the new parameters, from the units of results to those used here.
            block = np.asarray(matrix)[np.ix_(rows, rows)] * np.outer(_NATURAL[new], _NATURAL[new])
            covariance[np.ix_(new, new)] = block
            known |= {NAMES[k] for k in new}
        # One column per independent error: eigenvectors times standard uncertainties.
        variance, vectors = np.linalg.eigh(covariance)
        return cls(values, vectors * np.sqrt(np.maximum(variance, 0.0)), frozenset(known))

    def direction(self, force_g: Floats) -> Floats:
        """Direction of gravity (…, 3) in the accelerometers' frame, from readings (…, 3) in g.

        The vectors are not normalized.
        """
        return _direction(self.values, force_g)

    def modes(self, force_g: Floats) -> Floats:
        """Change (3, k) of the direction that a reading shows, by each column of `factor`."""

        def unit(values: Floats) -> Floats:
            vector = _direction(values, force_g)
            return np.asarray(vector / np.linalg.norm(vector))

        return central_differences(unit, self.values, _STEP, self.factor.T)

    def u_rad(self) -> float:
        """Standard uncertainty in rad of a direction, along each of the two axes perpendicular to it.

        It is the mean over directions along the three axes.
        """
        # A direction has two components across it, so half of the squared length counts for each.
        sizes = [np.linalg.norm(self.modes(row)) for row in np.eye(3)]
        return float(np.sqrt(np.mean(np.square(sizes)) / 2))


def _direction(values: Floats, force_g: Floats) -> Floats:
    return np.asarray((force_g - 1e-3 * values[6:]) @ np.linalg.inv(sensitivity(values[:6])).T)


@dataclass(frozen=True)
class Triad:
    """Calibrated accelerometers of a session, which give the true rotation of each turn.

    Attributes
    ----------
    axes : Axes
        Direction of gravity by a reading, and its changes that all turns of the session share.
    u_rad : float
        Standard uncertainty of such a direction, each way across it.
    psi_deg : mapping or None
        On a stage: angle ψ of gravity in each dwell and its standard uncertainty, by position.
    gravity : mapping
        In space: direction of gravity (3,) in each dwell, by position.
    notes : tuple of str
        Remarks for the user.
    """

    axes: Axes
    u_rad: float
    psi_deg: dict[int, tuple[float, float]] | None
    gravity: dict[int, Floats]
    notes: tuple[str, ...] = ()


def triad_of(session: Session, calibration: Calibration | None = None) -> Triad:
    """Calibrate the accelerometers of a session by a fit to this session, as far as it determines them.

    Parameters
    ----------
    calibration : Calibration, optional
        Calibration of the same accelerometers, for parameters that the session does not determine.

    Raises
    ------
    UsageError
        The calibration states no uncertainties.
    """
    given: list[Source] = []
    if calibration is not None:
        if calibration.covariance is None:
            raise UsageError(
                "the calibration of the accelerometers states no uncertainties: fit one that does"
            )
        # Δφ of a calibration in the plane is the skew of X and Y.
        stated = ["skew_xy" if one.name == "delta_phi" else one.name for one in calibration.parameters]
        values = dict(zip(stated, calibration.values.tolist(), strict=True))
        given.append((values, stated, calibration.covariance))
    try:
        from adis_gonio.fitting import fit
        from adis_gonio.fitting.fit_result import calibration_as_recorded
        from adis_gonio.fitting.methods import fit_of

        readings = readings_of(session)
        # In space by gravity alone, because the turns will calibrate the gyros.
        result = fit(session, method="ml") if readings.planar else fit_of(readings, "ml")
        own = calibration_as_recorded(result) if readings.planar else None
    except AdisGonioError:
        return _triad_in_space(session, *given)
    u_mg = np.sqrt(np.diagonal(readings.covariance, axis1=1, axis2=2).mean(axis=0))
    if own is None:
        names = [one.name for one in result.parameters]
        found = {one.name: one.value for one in result.parameters}
        return _triad_in_space(
            session, (found, names, result.covariance), *given, noise_mg=float(u_mg.max())
        )
    shown = own.angle(readings.mean, reading_u=list(u_mg))
    biases_open = any(name.startswith("bias") for name in result.undetermined)
    unseen = math.degrees(UNKNOWN_BIAS_MG / session.gravity_mg) if biases_open else 0.0
    u = np.hypot(np.asarray(shown.u_deg), unseen)
    note = "the accelerometers' biases are not determined: u of the turns includes them"
    return replace(
        _triad_in_space(session, *given),
        psi_deg=_with_declared(readings, np.asarray(shown.angle_deg), u),
        notes=(note,) if biases_open else (),
    )


def _triad_in_space(session: Session, *sources: Source, noise_mg: float = 0.0) -> Triad:
    """Make the triad of a session in space from `sources` of its nine parameters.

    Parameters without a source have the spread that the data sheet gives for this family of sensors.
    """
    variant = VARIANTS.get(session.sensor)
    prior = (UNKNOWN_ACCEL_GAIN, math.radians(UNKNOWN_SKEW_DEG) / math.sqrt(3), UNKNOWN_BIAS_MG)
    if variant is not None:
        prior = (variant.performance.scale_error_typical, variant.performance.skew_u_rad, UNKNOWN_BIAS_MG)
    axes = Axes.of(prior, *sources)
    notes: tuple[str, ...] = ()
    if not axes.known.issuperset(BIASES):
        notes = (_NOT_CALIBRATED,)
    elif not axes.known.issuperset(SKEWS):
        notes = (_NOT_SQUARE,)
    per_g = g_per_unit(session)
    gravity = {
        dwell.position: axes.direction(per_g * dwell.accel.mean(axis=0))
        for dwell in session.dwells
        if dwell.accel.shape[1] == 3 and math.isfinite(per_g)
    }
    return Triad(axes, math.hypot(noise_mg / session.gravity_mg, axes.u_rad()), None, gravity, notes)


def _with_declared(readings: Readings, psi: Floats, u: Floats) -> dict[int, tuple[float, float]]:
    """Average declared angle and angle ψ by gravity of each dwell, weighted by uncertainties.

    Both are angles of one stage: ψ + θ is the start angle α for all dwells, apart from errors. Angles that
    disagree are not averaged.
    """
    sigma = math.degrees(readings.fixture_rad)
    theta = np.degrees(readings.angle_rad)
    if readings.fixture_stated and 0 < sigma < math.inf and np.isfinite(theta).all():
        alpha = math.degrees(mean_direction(np.radians(psi + theta)))
        off = wrap_degrees(psi + theta - alpha)
        agrees = np.abs(off) < CONSISTENT * np.hypot(u, sigma)
        # Weighted mean of both angles, only for dwells in which they agree.
        psi = psi - np.where(agrees, u**2 / (u**2 + sigma**2), 0.0) * off
        u = np.where(agrees, u * sigma / np.hypot(u, sigma), u)
    pairs = zip(psi.tolist(), u.tolist(), strict=True)
    return dict(zip(readings.position.tolist(), pairs, strict=True))
