"""Parameters with their covariance: the common base of accelerometer and gyro calibrations."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError, UsageError
from adis_gonio.base.jsonable import HIDDEN, OPTIONAL, JsonRecord
from adis_gonio.base.output import check_output, replacing, write_utf8
from adis_gonio.base.tables import ParameterTable
from adis_gonio.base.uncertainty import Value
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.record.provenance import Provenance

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

STEP = 0.01
"""Step of central differences along each axis of the covariance, in standard uncertainties."""


VERSION = 1
"""Version of the format of calibration documents."""


def json_text(document: Mapping[str, Any]) -> str:
    """Format a JSON document as text; numbers have as many digits as are needed to restore them exactly."""
    return json.dumps(document, ensure_ascii=False, indent=2, allow_nan=False) + "\n"


class Coefficient(JsonRecord):
    """A parameter of a calibration: value, standard uncertainty (None if unknown) and unit.

    Attributes
    ----------
    dof : float or None
        Effective degrees of freedom of u; None if the result does not state them.
    """

    name: str = field(metadata=HIDDEN)
    value: float
    u: float | None
    unit: str
    dof: float | None = field(default=None, metadata=OPTIONAL)

    @classmethod
    def of(cls, name: str, estimate: Any) -> Coefficient:
        """Make a coefficient from an estimate, an object with `value`, `u`, `unit` and perhaps `dof`."""
        u, dof = estimate.u, getattr(estimate, "dof", None)
        return cls(name, float(estimate.value), None if u is None else float(u), estimate.unit, dof)

    def __str__(self) -> str:
        dof = {} if self.dof is None else {"dof": self.dof}
        return f"{self.name} {Value(self.value, self.u, self.unit, **dof)}"


@dataclass(frozen=True)
class NotCorrected:
    """An effect that was found but that a calibration cannot correct, with the reason."""

    effect: str
    reason: str


class Coefficients(ParameterTable, eq=False, kw_only=True):
    """Base class of the calibrations, with parameters by name and propagation of their covariance.

    Attributes
    ----------
    method : str
        Method that determined the parameters, such as `ml`, `trace` or `gyro`.
    parameters : tuple of Coefficient
    covariance : (p, p) float or None
        In the order and units of `parameters`; None if the noise is unknown.
    not_corrected : tuple of NotCorrected
        Effects that a calibration cannot correct, such as errors of the bench or a drift in time.
    assumed : tuple of str
        Parameters that were not determined; they keep their nominal values.
    """

    schema: ClassVar[str]
    method: str
    parameters: tuple[Coefficient, ...]
    covariance: Floats | None = None
    not_corrected: tuple[NotCorrected, ...] = ()
    assumed: tuple[str, ...] = ()
    of_session: ClassVar[Callable[[str | Path], Any] | None] = None
    """Function that loads a calibration file or fits a session; set by
    `adis_gonio.tracing.trace_calibrations`."""

    def __getitem__(self, name: str) -> Coefficient:
        """Return the parameter of this name; `KeyError` if there is none."""
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
        """Names of the parameters, in their order."""
        return [one.name for one in self.parameters]

    @property
    def values(self) -> Floats:
        """Values (p,) of the parameters."""
        return np.array([one.value for one in self.parameters])

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Load a calibration from a JSON file (`save`, `adis-gonio export`), or fit a session file.

        Raises
        ------
        DataError
            The file is neither of these, is damaged, or has a newer version.
        FitError
            The file has no calibration of these sensors (accelerometers or gyros), or the session does not
            determine it.
        """
        if cls.of_session is not None:
            made: Self = cls.of_session(path)
            return made
        from adis_gonio.calibrate.calibration_document import calibration_in

        found = calibration_in(path)
        for one in (found, None if found is None else found.gyro):
            if isinstance(one, cls):
                return one
        raise DataError(f"{path}: is not this kind of calibration; fit a session by adis_gonio.fit")

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write it as JSON (`schema/calibration-1.json`); `load` gives exactly the same numbers.

        Raises
        ------
        UsageError
            The file exists and `force` is not set.
        OutputError
            The file cannot be written.
        """
        with replacing(check_output(path, force=force)) as temporary:
            write_utf8(temporary, json_text(self.as_dict()))

    def _entries(self, where: Provenance | GyroCalibration) -> dict[str, Any]:
        """Entries of the JSON document that accelerometer and gyro calibrations have in common."""
        covariance = {"names": self.names, "matrix": self.covariance}
        return {
            "parameters": {one.name: one for one in self.parameters},
            "covariance": None if self.covariance is None else covariance,
            "not_corrected": self.not_corrected,
            "assumed": self.assumed,
            "reference": {
                "temperature_c": REFERENCE_C,
                "supply_v": REFERENCE_V,
                "session_temperature_c": where.temperature_c,
                "session_supply_v": where.supply_v,
            },
            "offsets_lsb": where.offsets_lsb,
        }

    def _moved(self, by: Mapping[str, float]) -> tuple[Coefficient, ...]:
        """Copy of the parameters in which the values that `by` names are increased by its amounts."""
        return tuple(replace(one, value=one.value + by.get(one.name, 0.0)) for one in self.parameters)

    def _with_variance(
        self,
        function: Callable[[Floats], Floats],
        difference: Callable[[Floats, Floats], Floats] = np.subtract,
    ) -> tuple[Floats, Floats]:
        """Value of a function of the parameters (p,) and its variance, from the covariance.

        The variance is NaN if there is no covariance. `difference` subtracts two results.
        """
        value = function(self.values)
        if self.covariance is None:
            return value, np.full(value.shape, np.nan)
        return value, np.asarray((self._rises(function, difference) ** 2).sum(axis=0))

    def _rises(
        self, function: Callable[[Floats], Floats], difference: Callable[[Floats, Floats], Floats]
    ) -> Floats:
        """Changes (k, …) of a function of the parameters by one u of each of k independent causes."""
        assert self.covariance is not None
        steps = STEP * _directions(self.covariance)
        rises = [difference(function(self.values + step), function(self.values - step)) for step in steps]
        return np.asarray(rises) / (2 * STEP)


def _directions(covariance: Floats) -> Floats:
    """Independent changes (k, p) of the parameters, each by one standard uncertainty.

    They are the principal axes of the covariance.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    # Eigenvectors of the correlation matrix: parameters have different units.
    sizes, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray((vectors * np.sqrt(np.maximum(sizes, 0.0))).T * unit)


def checked_numbers(name: str, given: ArrayLike, *, plural: bool = False) -> Floats:
    """Convert an argument to an array of numbers.

    Raises
    ------
    UsageError
        The argument has no numbers.
    """
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        verb = "have" if plural else "has"
        raise UsageError(f"{name} {verb} to be numbers, not {type(given).__name__}") from None


def finite_numbers(name: str, given: ArrayLike) -> Floats:
    """Convert an argument to an array of finite numbers.

    Raises
    ------
    UsageError
        The argument has no numbers, NaN or infinity.
    """
    values = checked_numbers(name, given)
    if not np.isfinite(values).all():
        raise UsageError(f"{name} holds NaN or infinity")
    return values


def checked_condition(
    name: str, given: ArrayLike | None, n: int, default: float | None, dies: int = 1
) -> Floats | None:
    """Convert a condition, such as a temperature, to one value for each of n readings.

    Parameters
    ----------
    given : float, (n,) or (n, dies) float, optional
        If it is None, all readings get the default.

    Returns
    -------
    (n, dies) float or None
        None if neither it nor a default is given.

    Raises
    ------
    UsageError
        No numbers, wrong shape, NaN or infinity.
    """
    if given is None:
        return None if default is None else np.full((n, dies), default)
    values = finite_numbers(name, given)
    if values.ndim < 2 and values.size in (1, n):
        rows = values.reshape(-1, 1)
    elif dies > 1 and (values.shape == (n, dies) or (n == 1 and values.shape == (dies,))):
        rows = values.reshape(n, dies)
    else:
        raise UsageError(
            f"{name} has shape {values.shape}; give one number, or one for each of {n} readings"
        )
    return np.broadcast_to(rows, (n, dies)).copy()


def checked_offsets(offsets_lsb: Sequence[int]) -> tuple[int, int, int]:
    """Check the contents of three offset registers, and return them as integers.

    Raises
    ------
    UsageError
        There are not three numbers.
    """
    if len(offsets_lsb) != 3:
        raise UsageError(f"offsets are three numbers (x, y, z), not {len(offsets_lsb)}")
    x, y, z = (int(number) for number in offsets_lsb)
    return x, y, z
