"""Gains, skews and biases of the accelerometers with what is not known of them: where a direction leads.

Each of the nine is as a fit of the same session has it, else as a calibration of the part has it, else that
of a perfect triad within what parts of the family are. An error of one of them moves the directions of all
turns of a session at once, and in a way of its own: what a bias of Y adds to the misalignments is the same
in every turn about X, and nothing in those about Y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import UsageError
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import SKEW_AXES, sensitivity

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
