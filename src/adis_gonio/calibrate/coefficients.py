"""Parameters with their covariance: the half that calibrations of accelerometers and gyros share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.numbers import format_uncertain
from adis_gonio.base.tables import ParameterTable

STEP = 0.01
"""Of the central difference along each axis of the covariance, in standard uncertainties."""


@dataclass(frozen=True)
class Coefficient:
    """A parameter: value, standard uncertainty (None: not known) and unit.

    Attributes
    ----------
    dof : float or None
        Effective degrees of freedom of u, where the result states them.
    """

    name: str
    value: float
    u: float | None
    unit: str
    dof: float | None = None

    @classmethod
    def of(cls, name: str, estimate: Any) -> Coefficient:
        """Coefficient of an estimate, an object with `value`, `u`, `unit` (and `dof`)."""
        u, dof = estimate.u, getattr(estimate, "dof", None)
        return cls(name, float(estimate.value), None if u is None else float(u), estimate.unit, dof)

    def __str__(self) -> str:
        return f"{self.name} {format_uncertain(self.value, self.u, self.unit)}"


@dataclass(frozen=True)
class NotCorrected:
    """What the model holds and no later reading can be corrected for, with the reason."""

    effect: str
    reason: str


class Coefficients(ParameterTable):
    """Base of the calibrations: parameters by name, and what follows from their covariance.

    Attributes
    ----------
    parameters : tuple of Coefficient
    covariance : (p, p) float or None
        In the order and units of `parameters`; None where no noise is known.
    """

    method: str
    parameters: tuple[Coefficient, ...]
    covariance: Floats | None
    of_session: ClassVar[Callable[[str | Path], Any] | None] = None
    """Reads a file that may be a session; set by `adis_gonio.tracing.trace_calibrations`."""

    def __getitem__(self, name: str) -> Coefficient:
        """Parameter by name; `KeyError` without it."""
        for one in self.parameters:
            if one.name == name:
                return one
        raise KeyError(name)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __eq__(self, other: object) -> bool:
        return isinstance(other, type(self)) and self.as_dict() == other.as_dict()

    def __hash__(self) -> int:
        return hash((self.method, self.parameters))

    @property
    def names(self) -> list[str]:
        """Names of the parameters."""
        return [one.name for one in self.parameters]

    @property
    def values(self) -> Floats:
        """Values (p,) of the parameters."""
        return np.array([one.value for one in self.parameters])

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Calibration of a JSON file (`save`, `adis-gonio export`), or of a session, which is fitted.

        Raises
        ------
        DataError
            The file is neither, is damaged, or is of a newer version.
        FitError
            The file holds no calibration of this part, or the session does not determine it.
        """
        if cls.of_session is not None:
            made: Self = cls.of_session(path)
            return made
        from adis_gonio.calibrate.files import calibration_in

        found = calibration_in(path)
        for one in (found, None if found is None else found.gyro):
            if isinstance(one, cls):
                return one
        raise DataError(f"{path}: is no such calibration; fit a session by adis_gonio.fit")

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write it as JSON (`schema/calibration-1.json`), bit-exact.

        Raises
        ------
        UsageError
            The file exists and `force` is not set.
        OutputError
            The file cannot be written.
        """
        from adis_gonio.calibrate.document import save_document

        save_document(self.as_dict(), path, force=force)

    def _moved(self, by: Mapping[str, float]) -> tuple[Coefficient, ...]:
        """Parameters with something added to the values of some."""
        return tuple(replace(one, value=one.value + by.get(one.name, 0.0)) for one in self.parameters)

    def _with_variance(
        self,
        function: Callable[[Floats], Floats],
        difference: Callable[[Floats, Floats], Floats] = np.subtract,
    ) -> tuple[Floats, Floats]:
        """Function of the parameters (p,), and its variance by their covariance, NaN if none is known."""
        value = function(self.values)
        if self.covariance is None:
            return value, np.full(value.shape, np.nan)
        variance = np.zeros(value.shape)
        for direction in _directions(self.covariance):
            step = STEP * direction
            rise = difference(function(self.values + step), function(self.values - step))
            variance += (rise / (2 * STEP)) ** 2
        return value, variance


def _directions(covariance: Floats) -> Floats:
    """Principal axes (k, p) of a covariance, each as long as its standard uncertainty."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    sizes, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray((vectors * np.sqrt(np.maximum(sizes, 0.0))).T * unit)


def checked_numbers(name: str, given: ArrayLike, *, plural: bool = False) -> Floats:
    """Argument of a method as an array.

    Raises
    ------
    UsageError
        No numbers.
    """
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        verb = "have" if plural else "has"
        raise UsageError(f"{name} {verb} to be numbers, not {type(given).__name__}") from None


def checked_offsets(offsets_lsb: Sequence[int]) -> tuple[int, int, int]:
    """Numbers of three offset registers.

    Raises
    ------
    UsageError
        They are not three.
    """
    if len(offsets_lsb) != 3:
        raise UsageError(f"offsets are three numbers (x, y, z), not {len(offsets_lsb)}")
    x, y, z = (int(number) for number in offsets_lsb)
    return x, y, z
