"""Calibrations: their coefficients with covariance, and readings converted to gravity and angle.

`Coefficients` is the common base of accelerometer and gyro calibrations. `Calibration` converts readings
to gravity and angle with the parameters of a fit or a trace.

In the convention of `model.measurement` a reading is U = diag(K) D g + b + Σ effects(diag(K) D g), with
gains K, the unit vectors of the sensor's axes as the rows of D, gravity g and biases b. Here this equation
is solved for g. Effects are small against the reading, so the fixed-point iteration a ← U − b − Σ
effects(a) converges in a few passes to the ideal reading a = diag(K) D g.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats, central_differences, wrap_radians
from adis_gonio.base.conformity import ErrorCurve
from adis_gonio.base.errors import DataError, FitError, UsageError
from adis_gonio.base.jsonable import HIDDEN, OPTIONAL, JsonRecord, json_object, json_text
from adis_gonio.base.numbers import counted, join_words
from adis_gonio.base.output import check_output, write_text
from adis_gonio.base.tables import ParameterTable
from adis_gonio.base.uncertainty import Value
from adis_gonio.model.effects import AXES, Conditions, Effect, catalogue, effect
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.model.measurement import FreeAttitude, Measurement, PlanarTurn
from adis_gonio.model.records import METADATA, MG_PER_MPS2
from adis_gonio.record.provenance import Covered, Provenance

if TYPE_CHECKING:
    from adis_gonio.calibrate.gyro_calibration import GyroCalibration

STEP = 0.01
"""Step of the central differences that propagate the covariance, in standard uncertainties of each
independent cause."""


VERSION = 1
"""Version of the format of calibration documents."""


class Coefficient(JsonRecord):
    """A parameter of a calibration, with its standard uncertainty.

    Attributes
    ----------
    name : str
        Name of the parameter.
    value, u, unit : float, float or None, str
        Value, standard uncertainty (None if unknown) and unit.
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
    """An effect of the catalogue that was found but that a calibration cannot correct, with the reason."""

    effect: str
    reason: str


class Coefficients(ParameterTable, eq=False, kw_only=True):
    """Base class of the calibrations, with parameters by name and propagation of their covariance.

    Attributes
    ----------
    schema : str
        Name of the document's format in its JSON entry `schema`.
    method : str
        Method that determined the parameters, such as `ml`, `trace` or `gyro`.
    parameters : tuple of Coefficient
        Determined parameters.
    covariance : (p, p) float or None
        Covariance of the parameters, in their order and units; None if the noise is unknown.
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
    `adis_gonio.tracing.trace_calibrations`. None before that: `load` then reads only calibration files."""

    def __getitem__(self, name: str) -> Coefficient:
        """Return the parameter of this name; `KeyError` if there is none."""
        return {one.name: one for one in self.parameters}[name]

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
    def needs(self) -> tuple[str, ...]:
        """Names of the conditions on which the calibration depends, such as `temperature_c`."""
        return ()

    @property
    def holds_at(self) -> str:
        """Text with the temperature and supply at which the values of the parameters hold."""
        at = {"temperature_c": f"{REFERENCE_C:g} °C", "supply_v": f"{REFERENCE_V:g} V"}
        return " and ".join(at[one] for one in at if one in self.needs) or "the session's mean conditions"

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
            The file is neither a calibration nor a session, is damaged, or has a newer version.
        FitError
            The file has no calibration of these sensors (accelerometers or gyros), or the session does not
            determine it.
        """
        if cls.of_session is not None:
            made: Self = cls.of_session(path)
            return made
        from adis_gonio.calibrate.calibration_document import any_calibration_in

        found = any_calibration_in(path)
        for one in (found, getattr(found, "gyro", None)):
            if isinstance(one, cls):
                return one
        raise DataError(f"{path}: is not this kind of calibration; fit a session by adis_gonio.fit")

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the calibration as JSON (`schema/calibration-1.json`); `load` gives equal numbers.

        `force` replaces an existing file.

        Raises
        ------
        UsageError
            The file exists and `force` is not set.
        OutputError
            The file cannot be written.
        """
        write_text(check_output(path, force=force), json_text(self.as_dict()))

    def _entries(self, where: Provenance | GyroCalibration) -> dict[str, Any]:
        """Return the entries that the JSON documents of accelerometer and gyro calibrations have in common.

        `where` has the conditions of the session and the contents of the offset registers.
        """
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

    def _condition(
        self,
        name: str,
        given: ArrayLike | None,
        n: int,
        covered: Covered | None,
        default: float | None = None,
        dies: int = 1,
    ) -> Floats | None:
        """Return a condition, such as a temperature, for each of n readings, (n, dies); None if unknown.

        Parameters
        ----------
        name : str
            Name of the condition.
        given : float, (n,) or (n, dies) float, optional
            Value for all readings, or one for each reading and each gyro die. If it is None, the result is
            the mean of the session (`covered`) if the calibration depends on this condition and the session
            recorded it, else `default`.

        Raises
        ------
        UsageError
            No numbers, wrong shape, NaN or infinity.
        """
        if covered is not None and name in self.needs:
            default = covered.mean
        if given is None:
            return None if default is None else np.full((n, dies), default)
        values = _numbers(name, given)
        if not np.isfinite(values).all():
            raise UsageError(f"{name} holds NaN or infinity")
        if values.ndim < 2 and values.size in (1, n):
            rows = values.reshape(-1, 1)
        elif dies > 1 and (values.shape == (n, dies) or (n == 1 and values.shape == (dies,))):
            rows = values.reshape(n, dies)
        else:
            raise UsageError(
                f"{name} has shape {values.shape}; give one number, or one for each of {n} readings"
            )
        return np.broadcast_to(rows, (n, dies)).copy()

    def _moved(self, by: Mapping[str, float]) -> tuple[Coefficient, ...]:
        """Return a copy of the parameters with the amounts `by` (by name) added to their values."""
        return tuple(replace(one, value=one.value + by.get(one.name, 0.0)) for one in self.parameters)

    def with_variance(
        self,
        function: Callable[[Floats], Floats],
        difference: Callable[[Floats, Floats], Floats] = np.subtract,
    ) -> tuple[Floats, Floats]:
        """Return the value of a function of the parameters (p,), and its variance from the covariance.

        The variance is NaN if there is no covariance. `difference` subtracts two results, such as angles on
        a circle.
        """
        return function(self.values), np.asarray((self._rises(function, difference) ** 2).sum(axis=-1))

    def _rises(
        self, function: Callable[[Floats], Floats], difference: Callable[[Floats, Floats], Floats]
    ) -> Floats:
        """Return the change (…, k) of a function of the parameters by each of k independent causes.

        Each cause changes the parameters by one standard uncertainty. NaN if there is no covariance.
        """
        if self.covariance is None:
            return np.full((*function(self.values).shape, 1), np.nan)
        changes = independent_changes(self.covariance)
        return central_differences(function, self.values, STEP, changes, difference)


def independent_changes(covariance: Floats) -> Floats:
    """Return p independent changes of p parameters, each by one standard uncertainty, as rows (p, p).

    The transpose times the result is the covariance (p, p), which may be singular.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(scale > 0, scale, 1.0)
    # Eigenvectors of the correlation matrix: parameters have different units.
    sizes, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    return np.asarray((vectors * np.sqrt(np.maximum(sizes, 0.0))).T * unit)


def left_to_temperature(
    part: str, corrected: Collection[str], ideal: Floats, here: Conditions, session: Covered | None
) -> Iterator[Floats]:
    """Yield the change (n, axes) of readings by each temperature effect that is not corrected.

    It is the change from the mean temperature of the session to the temperature of the reading, if the
    effect has its typical size. Nothing is yielded if the temperature of the session is unknown.

    Parameters
    ----------
    part : {"accelerometer", "gyro"}
        Sensors that give the readings.
    corrected : collection of str
        Names of the effects that the calibration corrects.
    ideal : (n, axes) float
        Ideal readings, in mg or °/s.
    here : Conditions
        Conditions of the readings, with their temperature.
    session : Covered or None
        Temperatures of the session in °C.
    """
    if session is None:
        return
    there = replace(here, temperature_c=np.full(len(ideal), session.mean), temperatures_c=None)
    for name, kind in catalogue(part).items():
        follows = "temperature_c" in kind.needs and not here.lacks(kind.needs)
        if name in corrected or not kind.correctable or not follows:
            continue
        one = effect(name, AXES[: ideal.shape[1]])
        for amplitude in (parameter for parameter in one.parameters if not parameter.shape):
            alone = one.defaults({amplitude.name: amplitude.typical}, others="zero")
            yield one.reading(alone, ideal, here) - one.reading(alone, ideal, there)


def _numbers(name: str, given: ArrayLike) -> Floats:
    """Convert the argument `given`, called `name` in messages, to an array; fail if it has no numbers."""
    try:
        return np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"{name} has to be numbers, not {type(given).__name__}") from None


def checked_rows(name: str, given: ArrayLike, columns: tuple[int, ...], unit: str) -> tuple[Floats, bool]:
    """Convert an argument to rows (n, k), and return True if it is a single reading (k,).

    Parameters
    ----------
    name, unit : str
        Name of the argument and unit of its numbers, for messages.
    columns : tuple of int
        Allowed numbers of columns; k is the smallest, and further columns are dropped.

    Raises
    ------
    UsageError
        No numbers, wrong shape, NaN or infinity.
    """
    values = _numbers(name, given)
    if values.ndim not in (1, 2) or values.shape[-1] not in columns:
        wanted = join_words([*map(str, columns)], "or")
        raise UsageError(
            f"{name} has shape {values.shape}; give (n, {wanted}) in {unit}, one row a reading"
        )
    rows = np.atleast_2d(values)[:, : min(columns)]
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        raise UsageError(f"{name}: reading {int(bad[0])} holds NaN or infinity; leave lost scans out")
    return rows, values.ndim == 1


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


_PASSES = 60
_SETTLED_MG = 1e-9

_SOURCE = ("title", *METADATA, "source", "sha256", "recorded_utc", "ended_utc", "software")

CURVE_PLACES = 72
"""Number of angles around the turn at which the error of the angle is computed; it has few harmonics of the
turn."""

TurnPlane = Literal["xy", "xz", "yz"]


@dataclass(frozen=True)
class EffectTerm:
    """An effect of the catalogue that the calibration corrects.

    Attributes
    ----------
    effect : Effect
        The effect.
    parameters : tuple of str
        Names of its values among the calibration's parameters, in the effect's order.
    """

    effect: Effect
    parameters: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the effect, one entry of `effects` in the document."""
        effect = self.effect
        choices = {choice: getattr(effect, choice) for choice in effect.choices()}
        return json_object(
            effect=effect.name, axes=effect.axes, choices=choices, parameters=self.parameters
        )


@dataclass(frozen=True)
class AngleReading:
    """Angles `angle_deg` (n,), −180 to 180 degrees, and their standard uncertainties `u_deg` (n,).

    An unknown uncertainty is NaN. One reading (axes,) gives arrays of zero dimensions, which can be used as
    numbers. If the caller gave no temperature, angle and u hold only at `assumed_c`, the mean temperature
    of the session in °C; it is None otherwise, and if the session did not record the temperature.
    """

    angle_deg: Floats
    u_deg: Floats
    assumed_c: float | None = None

    def __repr__(self) -> str:
        u_deg = np.atleast_1d(self.u_deg)
        known = u_deg[np.isfinite(u_deg)]
        u = f"{known.max():.4f}°" if known.size else "unknown"
        if self.assumed_c is not None:
            u += f" at {self.assumed_c:.1f} °C, give temperature_c for another"
        if np.ndim(self.angle_deg) == 0:
            return f"AngleReading({float(self.angle_deg):.4f}°, u {u})"
        return f"AngleReading({counted(len(self.angle_deg), 'angle')}, u up to {u})"


class Calibration(Coefficients, eq=False, kw_only=True):
    """Calibration of accelerometers, which converts readings to gravity and angle.

    Attributes
    ----------
    provenance : Provenance
        Sensor, plane, gravity and the known facts about the session.
    parameters : tuple of Coefficient
        Base parameters (gains, misalignment or skews, biases; in the plane also the start angle `alpha` if
        it is known), then the values of the effects.
    effects : tuple of EffectTerm
        Effects found by a trace, which depend on the reading, the temperature or the supply.
    counts_per_mg : tuple of float or None
        Rough scale of each axis for readings in counts; None for readings in mg.
    gyro : GyroCalibration or None
        Calibration of the gyros; None if the session gives none.
    ratio_dof : float or None
        Effective degrees of freedom of u of ΔK; None if the result does not state them.
    angle_dof : float or None
        Effective degrees of freedom of u of a calibrated angle (Welch–Satterthwaite); None if the result
        does not state them.
    """

    provenance: Provenance
    effects: tuple[EffectTerm, ...] = ()
    counts_per_mg: tuple[float, ...] | None = None
    gyro: GyroCalibration | None = None
    ratio_dof: float | None = None
    angle_dof: float | None = None
    schema: ClassVar[str] = "adis-gonio/calibration"

    # -- description --------------------------------------------------------------------------------

    @property
    def planar(self) -> bool:
        """True for a sensor that turns in the plane of x and y, False for any attitude in space."""
        return self.provenance.plane == "xy"

    @property
    def axes(self) -> int:
        """Number of accelerometer axes that the calibration uses: 2 in the plane, 3 in space."""
        return 2 if self.planar else 3

    @property
    def unit(self) -> str:
        """Unit of the readings that the calibration converts: mg or counts."""
        return "counts" if self.provenance.counts else "mg"

    @property
    def gravity_mg(self) -> float:
        """Local gravity at the place of the session, in mg."""
        return self.provenance.gravity_mps2 * MG_PER_MPS2

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the conditions on which the corrected effects depend."""
        return tuple(dict.fromkeys(name for term in self.effects for name in term.effect.needs))

    def __repr__(self) -> str:
        space = "in the plane xy" if self.planar else "in space"
        effects = "".join(f" + {term.effect.name}" for term in self.effects)
        lead = ", ".join(str(one) for one in self.listed if one.name in ("delta_k", "delta_phi", "skew_xy"))
        return f"Calibration({self.provenance.sensor} {space}, {self.method}{effects}, {lead})"

    @property
    def delta_k(self) -> Coefficient | None:
        """Relative difference ΔK = K_x/K_y − 1 of the two scale factors, with u; None in space.

        Its u is None if the covariance is unknown.
        """
        if not self.planar or "scale_x" not in self:
            return None

        def ratio(values: Floats) -> Floats:
            found = dict(zip(self.names, values, strict=True))
            return np.asarray(found["scale_x"] / found.get("scale_y", 1.0) - 1)

        value, variance = self.with_variance(ratio)
        u = None if self.covariance is None else math.sqrt(variance)
        return Coefficient("delta_k", float(value), u, "1", self.ratio_dof)

    @property
    def listed(self) -> tuple[Coefficient, ...]:
        """All parameters for a list; in the plane ΔK is the first."""
        return (*((self.delta_k,) if self.delta_k else ()), *self.parameters)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document of the calibration, in the format of `schema/calibration-1.json`."""
        where, ratio = self.provenance, self.delta_k
        return json_object(
            schema=self.schema,
            version=VERSION,
            method=self.method,
            sensor=where.sensor,
            plane=where.plane,
            unit=self.unit,
            counts_per_mg=self.counts_per_mg,
            gravity_mps2=where.gravity_mps2,
            derived={} if ratio is None else {"delta_k": ratio},
            angle_dof=self.angle_dof,
            effects=self.effects,
            **self._entries(where),
            source={name: getattr(where, name) for name in _SOURCE},
            **{} if self.gyro is None else {"gyro": self.gyro},
        )

    # -- use ---------------------------------------------------------------------------------------

    def apply(
        self, accel: ArrayLike, temperature_c: ArrayLike | None = None, *, supply_v: ArrayLike | None = None
    ) -> Floats:
        """Convert readings to gravity in the sensor's orthogonal frame, in units of local gravity.

        X of the frame is the sensor's X axis, Y lies in the plane of its X and Y.

        Parameters
        ----------
        accel : (n, 2), (n, 3), (2,) or (3,) float
            Readings in the unit of the calibration (mg or counts), such as `ScanBlock.accel_mg`; in the
            plane z is ignored.
        temperature_c, supply_v : (n,) float or float, optional
            Conditions, for effects that depend on them; the mean of the session by default.

        Returns
        -------
        (n, axes) or (axes,) float
            Gravity; NaN for a reading so large that the model has no inverse.

        Raises
        ------
        UsageError
            Wrong shape, another unit, NaN or infinity.
        """
        readings, single = checked_readings(accel, self)
        conditions = self._conditions(len(readings), temperature_c, supply_v)
        gravity = self._gravity(self.values, readings, conditions)
        return gravity[0] if single else gravity

    def readings_of(
        self, gravity: ArrayLike, temperature_c: float | None = None, *, supply_v: float | None = None
    ) -> Floats:
        """Return the readings (n, axes), in mg or counts, that the sensor gives for gravity (n, axes).

        This is the inverse of `apply`; gravity is in units of local gravity. The default of `temperature_c`
        and `supply_v` is the mean of the session.
        """
        gravity = np.asarray(gravity, dtype=float)
        base, bias = self.natural(self.values)
        # Matrix of the calibration, by its effect on unit vectors; its inverse gives ideal readings.
        matrix = self.measurement.calibrated(base, np.eye(self.axes))
        ideal = np.asarray(gravity @ np.linalg.inv(matrix))
        conditions = self._conditions(len(gravity), temperature_c, supply_v)
        effects = [e.reading(own, ideal, conditions) for e, own in self._terms(self.values)]
        return np.asarray((ideal + bias + sum(effects, np.zeros(ideal.shape))) * self.per_mg)

    def angle(
        self,
        accel: ArrayLike,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
        reading_u: float | Sequence[float] | None = None,
        plane: TurnPlane | None = None,
    ) -> AngleReading:
        """Compute the angle ψ of gravity in a plane from readings, with its standard uncertainty.

        ψ is measured from the plane's first axis towards its second axis. A positive turn of the stage by θ
        reduces ψ: ψ = α − θ with the start angle α. The method `stage_angle` returns θ.

        Parameters
        ----------
        accel, temperature_c, supply_v
            Readings (n, axes) or (axes,) in the unit of the calibration (mg or counts), and their
            temperature in °C and supply in V; the mean of the session by default.
        reading_u : float or sequence of float, optional
            Standard uncertainty of a reading, for all axes or for each axis, in the unit of the readings;
            by default the result has only the uncertainty of the calibration.
        plane : {"xy", "xz", "yz"}, optional
            Plane of the angle; required for a calibration in space, by default xy otherwise.

        Raises
        ------
        UsageError
            Wrong shape, another unit, NaN or infinity; a missing plane, or another than the calibrated one;
            a negative uncertainty.
        """
        shown = self._angle_of(*self._plane(plane))
        return self._with_u(shown, accel, temperature_c, supply_v, reading_u)

    def stage_angle(
        self,
        accel: ArrayLike,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
        reading_u: float | Sequence[float] | None = None,
    ) -> AngleReading:
        """Compute the angle θ of the stage from readings, with its standard uncertainty.

        θ is the start angle α minus the angle ψ of gravity, and is positive in the direction of the
        session's declared angles. `accel` are the readings (n, axes) or (axes,) in the unit of the
        calibration (mg or counts), and `reading_u` is their standard uncertainty; without it u is the
        uncertainty by the calibration alone. The default of `temperature_c` and `supply_v` is the mean of
        the session; u then has no part for another temperature.

        Raises
        ------
        UsageError
            Wrong shape, another unit, NaN or infinity; the calibration has no start angle.
        """
        if "alpha" not in self:
            raise UsageError("this calibration has no start angle: use `angle`, the angle by gravity")
        return self._with_u(self._angle_of(stage=True), accel, temperature_c, supply_v, reading_u)

    def error_curves(self, *, stage: bool = True) -> tuple[ErrorCurve | None, ErrorCurve]:
        """Return the error of the angle over the turn in the plane xy, without and with the calibration.

        The angle is the angle of the stage if `stage` is True and the calibration has a start angle, else
        the angle of gravity. The noise of single readings is not included. The first curve is None if the
        readings are in counts of unknown scale. Without `angle_dof`, the degrees of freedom are the least
        of any parameter.

        Raises
        ------
        FitError
            The uncertainties of the parameters are not known.
        """
        if self.covariance is None:
            raise FitError("the noise of the readings is not known, so conformity cannot be stated")
        psi = np.linspace(0, 2 * math.pi, CURVE_PLACES, endpoint=False)
        gravity = np.zeros((CURVE_PLACES, self.axes))
        gravity[:, 0], gravity[:, 1] = np.cos(psi), np.sin(psi)
        readings = self.readings_of(gravity)
        conditions = self._conditions(CURVE_PLACES, None, None)
        start = stage and "alpha" in self
        sign, zero = (-1.0, self["alpha"].value) if start else (1.0, 0.0)
        angle = self._angle_of(stage=start)
        roots = self._rises(lambda values: angle(values, readings, conditions), _turn_between)
        least = min((one.dof for one in self.parameters if one.dof is not None), default=math.inf)
        raw = np.degrees(sign * wrap_radians(np.arctan2(readings[:, 1], readings[:, 0]) - psi))
        angle_deg, dof = (zero + sign * np.degrees(psi)) % 360, self.angle_dof or least
        after = ErrorCurve(angle_deg, np.zeros(CURVE_PLACES), np.degrees(roots), dof)
        return None if self.provenance.counts else replace(after, error_deg=raw), after

    def with_offsets(self, offsets_lsb: Sequence[int]) -> Calibration:
        """Return the calibration for a sensor with other numbers in its offset registers.

        The sensor adds XACCL_OFF … to its outputs, so its biases change by the difference between the new
        and the old numbers. An axis without a bias among the parameters gets this difference as its bias,
        without an uncertainty.

        Raises
        ------
        UsageError
            The contents of the registers are unknown, or the sensor has no such registers.
        """
        from adis_gonio.device.sensor.registers import VARIANTS

        then = self.provenance.offsets_lsb
        if then is None or self.provenance.sensor not in VARIANTS or self.provenance.counts:
            raise UsageError(
                "the session does not state the contents of the offset registers while it was recorded"
            )
        now = checked_offsets(offsets_lsb)
        lsb_mg = VARIANTS[self.provenance.sensor].accel_mg_per_lsb
        added = {f"bias_{axis}": (now[k] - then[k]) * lsb_mg for k, axis in enumerate(AXES)}
        names = [f"bias_{axis}" for axis in AXES[: self.axes]]
        new = tuple(Coefficient(n, added[n], None, "mg") for n in names if added[n] and n not in self)
        covariance = None if self.covariance is None else np.pad(self.covariance, (0, len(new)))
        where = replace(self.provenance, offsets_lsb=now, written_lsb=None)
        # g-sensitivity of the gyros refers to the readings, which the offsets have moved.
        moved_g = (np.array(now) - np.array(then)) * lsb_mg / 1000
        gyro = None if self.gyro is None else self.gyro.with_force_moved(moved_g)
        return replace(
            self, parameters=self._moved(added) + new, covariance=covariance, provenance=where, gyro=gyro
        )

    def for_registers(
        self, offsets_lsb: Sequence[int] | None, gyro_offsets_lsb: Sequence[int] | None
    ) -> Calibration:
        """Return the calibration for readings taken while the offset registers had these contents.

        Parameters
        ----------
        offsets_lsb, gyro_offsets_lsb : three int or None
            Contents of XACCL_OFF … and XGYRO_OFF …, in LSB. The calibration of the accelerometers or of the
            gyros is returned unchanged if its contents are None, or if its own offsets are unknown.
        """
        moved = self
        if offsets_lsb is not None and self.provenance.offsets_lsb is not None:
            moved = moved.with_offsets(offsets_lsb)
        gyro = moved.gyro
        if gyro is not None and gyro.offsets_lsb is not None and gyro_offsets_lsb is not None:
            moved = replace(moved, gyro=gyro.with_offsets(gyro_offsets_lsb))
        return moved

    # -- computation ---------------------------------------------------------------------------------------

    @property
    def measurement(self) -> Measurement:
        """Base model that relates readings to gravity, in the plane or in space."""
        return PlanarTurn(self.gravity_mg) if self.planar else FreeAttitude(self.gravity_mg)

    @property
    def per_mg(self) -> Floats:
        """Counts per mg of each axis (axes,), or 1 if the readings are in mg."""
        return np.ones(self.axes) if self.counts_per_mg is None else np.array(self.counts_per_mg)

    def natural(self, values: Floats) -> tuple[Floats, Floats]:
        """Convert parameter values (p,) to base parameters in natural units and biases (axes,) in mg.

        Parameters that the calibration lacks have their nominal values.
        """
        at = {one.name: k for k, one in enumerate(self.parameters)}
        per_mg = self.per_mg
        base = self.measurement.nominal
        for k, parameter in enumerate(self.measurement.parameters):
            if parameter.name not in at:
                continue
            base[k] = values[at[parameter.name]] / parameter.per_natural
            if self.provenance.counts and parameter.name.startswith("scale"):
                base[k] /= per_mg[AXES.index(parameter.name[-1])] * MG_PER_MPS2
        names = [f"bias_{axis}" for axis in AXES[: self.axes]]
        return base, np.array([values[at[n]] if n in at else 0.0 for n in names]) / per_mg

    def _gravity(self, values: Floats, readings: Floats, conditions: Conditions) -> Floats:
        base, bias = self.natural(values)
        free = readings / self.per_mg - bias
        ideal = free
        terms = self._terms(values)
        if terms:
            with np.errstate(over="ignore", invalid="ignore"):
                ideal = _solved(free, terms, conditions)
        return self.measurement.calibrated(base, ideal)

    def _angle_of(
        self, i: int = 0, j: int = 1, *, stage: bool = False
    ) -> Callable[[Floats, Floats, Conditions], Floats]:
        """Return a function of parameters (p,), readings (n, axes) and conditions: the angles (n,) in rad.

        They are the angles of gravity from axis i towards axis j. If `stage` is True, they are the angles
        of the stage: the start angle `alpha` minus the angle of gravity.
        """
        k = self.names.index("alpha") if stage else None

        def angle_rad(values: Floats, readings: Floats, conditions: Conditions) -> Floats:
            gravity = self._gravity(values, readings, conditions)
            psi = np.arctan2(gravity[:, j], gravity[:, i])
            return np.asarray(psi if k is None else np.radians(values[k]) - psi)

        return angle_rad

    def _terms(self, values: Floats) -> list[tuple[Effect, Floats]]:
        names = self.names
        return [(t.effect, values[[names.index(n) for n in t.parameters]]) for t in self.effects]

    def _conditions(
        self, n: int, temperature_c: ArrayLike | None, supply_v: ArrayLike | None
    ) -> Conditions:
        where = self.provenance
        warm = self._condition("temperature_c", temperature_c, n, where.temperature_c)
        volts = self._condition("supply_v", supply_v, n, where.supply_v)
        rows = [None if found is None else found[:, 0] for found in (warm, volts)]
        return Conditions(time_s=np.zeros(n), temperature_c=rows[0], supply_v=rows[1])

    def _plane(self, plane: str | None) -> tuple[int, int]:
        planes = {"xy": (0, 1)} if self.planar else {"xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
        named = "xy" if plane is None and self.planar else plane
        if named not in planes:
            raise UsageError(
                f"plane is {plane}: angles of this calibration are in plane {', '.join(planes)}"
            )
        return planes[named]

    def _with_u(
        self,
        shown: Any,
        accel: ArrayLike,
        temperature_c: ArrayLike | None,
        supply_v: ArrayLike | None,
        reading_u: float | Sequence[float] | None,
    ) -> AngleReading:
        """Return an angle with its uncertainty by the calibration, the temperature and the reading.

        `shown` is the function that computes the angle in rad from parameters, readings and conditions.
        `reading_u` is the standard uncertainty of the reading, one number or one for each axis.
        """
        readings, single = checked_readings(accel, self)
        conditions = self._conditions(len(readings), temperature_c, supply_v)
        values = self.values
        angle, variance = self.with_variance(
            lambda values: shown(values, readings, conditions), _turn_between
        )
        if temperature_c is not None:
            corrected = {term.effect.name for term in self.effects}
            ideal, covered = readings / self.per_mg, self.provenance.temperature_c
            for change in left_to_temperature("accelerometer", corrected, ideal, conditions, covered):
                moved = shown(values, readings + change * self.per_mg, conditions)
                variance += _turn_between(moved, angle) ** 2
        if reading_u is not None:
            u = np.asarray(reading_u, dtype=float)
            if u.shape not in ((), (self.axes,)) or not np.isfinite(u).all() or (u < 0).any():
                raise UsageError(
                    f"reading_u is one number, or {self.axes}, none of them negative; not {reading_u}"
                )
            u = np.broadcast_to(u, (self.axes,))
            steps = np.maximum(STEP * u, 1e-6)
            # Derivative of the angle by the reading, for the noise of the reading.
            slopes = central_differences(
                lambda r: shown(values, r, conditions), readings, steps, np.eye(self.axes), _turn_between
            )
            variance += ((slopes * u) ** 2).sum(axis=1)
        angle_deg, u_deg = np.degrees(wrap_radians(angle)), np.degrees(np.sqrt(variance))
        covered = self.provenance.temperature_c
        assumed_c = covered.mean if covered is not None and temperature_c is None else None
        at = 0 if single else slice(None)
        return AngleReading(angle_deg[at], u_deg[at], assumed_c)


def _turn_between(up_rad: Floats, down_rad: Floats) -> Floats:
    """Return the differences (n,) of angles (n,) in rad, by the shorter way round the circle."""
    return wrap_radians(up_rad - down_rad)


def _solved(free: Floats, terms: Sequence[tuple[Effect, Floats]], conditions: Conditions) -> Floats:
    """Remove effects from readings minus bias, `free` (n, axes) in mg: return the ideal readings (n, axes).

    `terms` are the effects with the values of their parameters. The effects depend on the ideal readings a,
    so a + Σ effects(a) = `free` is solved by iteration. A row is NaN if the iteration does not converge.
    """
    ideal = free
    for _ in range(_PASSES):
        # Fixed point: subtract the effects at the current ideal readings.
        new = free - sum((e.reading(own, ideal, conditions) for e, own in terms), np.zeros(free.shape))
        moving = np.asarray(~(np.abs(new - ideal) <= _SETTLED_MG).all(axis=1))
        ideal = new
        if not moving.any():
            return ideal
    ideal[moving] = np.nan
    return ideal


LEAST_LENGTH = 0.02
"""Least length of readings in units of gravity. Readings of 1 g in g or in m/s² instead of mg are shorter
(0.001 and 0.0098)."""
MOST_LENGTH = 2.0
"""Largest median length of many readings in units of gravity. Readings of 1 g in LSB instead of mg are
longer (2140)."""
MANY = 8
"""Least number of readings for the test of their median length, so that a single shock does not change
it."""


def checked_readings(accel: ArrayLike, calibration: Calibration) -> tuple[Floats, bool]:
    """Check readings; return them as (n, axes), and True if a single reading (axes,) was given.

    Raises
    ------
    UsageError
        Wrong shape, no numbers, NaN or infinity, or another unit.
    """
    columns = (2, 3) if calibration.planar else (3,)
    readings, single = checked_rows("accel", accel, columns, calibration.unit)
    if not calibration.provenance.counts and len(readings):
        length_mg = float(np.median(np.linalg.norm(readings, axis=1)))
        length = length_mg / calibration.gravity_mg
        if length < LEAST_LENGTH or (length > MOST_LENGTH and len(readings) >= MANY):
            raise UsageError(
                f"readings are {length_mg:.4g} long, but gravity is about 1000: give mg (1 g = 1000,"
                " 1 m/s² = 101.97), not words of the sensor (ScanBlock.accel_mg)"
            )
    return readings, single
