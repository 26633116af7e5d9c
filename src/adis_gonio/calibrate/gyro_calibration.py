"""`GyroCalibration`: what the three gyros of a part are wrong by, and the rate of turn without it.

In the frame of the accelerometers a gyro reads, in °/s,

    rate = (1 + κ ΔT) K D ω + b + β ΔT + β₂ ΔT² + β₃ ΔT³ + G f + G₂ f² + s ΔV,

with ω the true rate, K gains and D unit directions (`sensitivity` = K D), b the zero rate, f what the
accelerometers **read** in g (level with Z up: z = −1), ΔT = T − 25 °C, ΔV = V − 5 V. f is the reading
itself, with the accelerometers' own bias in it: nobody corrects these before the gyros are calibrated.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.calibrate.coefficients import (
    Coefficient,
    Coefficients,
    NotCorrected,
    checked_numbers,
    checked_offsets,
)
from adis_gonio.device.sensor.registers import Kind
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.model.effects import AXES
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.record.provenance import Covered

GYRO_OFFSET_DPS = VARIANTS["adis16354"].lsb(Kind.GYRO_OFFSET)[0]
"""LSB of XGYRO_OFF …, the same at every range (DS, A)."""

_ONE, _PAIR, _OTHER = "one axis", "two axes", "two different axes"
_KINDS: dict[str, tuple[str, str]] = {
    "gyro_bias": (_ONE, "dps"),
    "gyro_scale": (_ONE, "1"),
    "gyro_misalignment": (_OTHER, "deg"),
    "g_sensitivity": (_PAIR, "dps/g"),
    "g2_sensitivity": (_PAIR, "dps/g²"),
    "gyro_bias_temperature": (_ONE, "dps/°C"),
    "gyro_bias_temperature2": (_ONE, "dps/°C²"),
    "gyro_bias_temperature3": (_ONE, "dps/°C³"),
    "gyro_scale_temperature": (_ONE, "ppm/°C"),
    "gyro_supply": (_ONE, "dps/V"),
}
"""Parameters by what stands before their axes: how many axes, and the unit."""
_NAME = re.compile(r"(?P<kind>[a-z0-9_]+)_(?P<axes>[xyz]{1,2})")
LEAST_DETERMINANT = 0.1
"""Of gains and directions; three gyros that work have about 1."""


@dataclass(frozen=True)
class Rates:
    """Rates of turn (n, 3) in °/s with their standard uncertainties (n, 3), NaN where not known."""

    rate_dps: Floats
    u_dps: Floats


@dataclass(frozen=True)
class _Values:
    """Values by what they do; arrays (3,) and (3, 3), gyro by row."""

    bias: Floats
    sensitivity: Floats
    per_g: Floats
    per_g2: Floats
    per_c: tuple[Floats, Floats, Floats]
    scale_per_c: Floats
    per_v: Floats


@dataclass(frozen=True, eq=False)
class GyroCalibration(Coefficients):
    """What turns readings of the three gyros into the rate of turn in the accelerometers' frame.

    Attributes
    ----------
    method : str
        What determined it: `gyro` (the fit), `trace`, or another's name.
    parameters : tuple of Coefficient
        `gyro_bias_x …` (dps), and what was determined of `gyro_scale_x …` (1), `gyro_misalignment_xy …`
        (deg; the gyro, and the axis towards which it is misaligned), `g_sensitivity_xy …` (dps/g; the
        gyro, and the axis of force), `g2_sensitivity_xy …` (dps/g²), `gyro_bias_temperature_x …` (dps/°C;
        …2, …3 of its square and cube), `gyro_scale_temperature_x …` (ppm/°C), `gyro_supply_x …` (dps/V).
    covariance : (p, p) float or None
        In the order and units of `parameters`; None where no noise is known.
    assumed : tuple of str
        Parameters that were not determined and stand at their nominal values.
    not_corrected : tuple of NotCorrected
        What was found and no single reading shows, such as a drift by the session's clock.
    temperature_c, supply_v : Covered or None
        What the session covered.
    offsets_lsb : tuple of int or None
        Numbers in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF with which the biases hold; None where unknown.
    source : str
        File of the session, without its folder; empty where it is none.
    """

    method: str
    parameters: tuple[Coefficient, ...]
    covariance: Floats | None = None
    assumed: tuple[str, ...] = ()
    not_corrected: tuple[NotCorrected, ...] = ()
    temperature_c: Covered | None = None
    supply_v: Covered | None = None
    offsets_lsb: tuple[int, int, int] | None = None
    source: str = ""

    @classmethod
    def of(
        cls,
        estimates: Mapping[str, Any],
        covariance: tuple[Sequence[str], Floats] | None = None,
        *,
        method: str = "gyro",
        **about: Any,
    ) -> GyroCalibration:
        """Calibration of parameters by name, as a fit or a trace of the gyros gives them.

        Parameters
        ----------
        estimates : mapping of str to objects with `value`, `u`, `unit` (and `dof`)
            Names that are no parameters of a gyro are left alone.
        covariance : (names, (p, p) float), optional
            Of more parameters, in any order; by default that of the u.
        about
            Further attributes.

        Raises
        ------
        FitError
            A gyro has no zero rate, a parameter another unit than it has to have, or gains and directions
            are those of no three gyros.
        """
        known = [name for name in estimates if kind_of(name) and _determined(estimates[name])]
        missing = [f"gyro_bias_{axis}" for axis in AXES if f"gyro_bias_{axis}" not in known]
        if missing:
            raise FitError(
                f"the session does not determine {', '.join(missing)}: its gyros are not calibrated"
            )
        known.sort(key=_order)
        parameters = tuple(Coefficient.of(name, estimates[name]) for name in known)
        matrix = _taken(known, parameters, covariance)
        made = cls(method, parameters, matrix, assumed=_assumed(known), **about)
        made.check()
        return made

    def check(self) -> None:
        """Refuse what no three gyros are: `FitError`."""
        for one in self.parameters:
            kind = kind_of(one.name)
            if kind is None or one.unit != _KINDS[kind][1]:
                raise FitError(f"{one.name} in {one.unit} is no parameter of a gyro")
        misalignment = self._matrix("gyro_misalignment", self._stated())
        if (np.abs(misalignment) >= 45).any() or abs(np.linalg.det(self.sensitivity)) < LEAST_DETERMINANT:
            raise FitError(
                "gains and directions are those of no three gyros: one hardly turns with the part"
            )

    # -- what it is ---------------------------------------------------------------------------------

    def __repr__(self) -> str:
        biases = ", ".join(str(self[f"gyro_bias_{axis}"]) for axis in AXES)
        return f"GyroCalibration({self.method}, {biases})"

    @property
    def bias_dps(self) -> Floats:
        """Zero rates (3,) in °/s without force, at 25 °C and 5 V."""
        return self._values(self.values).bias

    @property
    def sensitivity(self) -> Floats:
        """Gains times directions (3, 3), a row a gyro; the identity where they are perfect."""
        return self._values(self.values).sensitivity

    @property
    def g_sensitivity_dps_per_g(self) -> Floats:
        """What force adds (3, 3) in °/s/g: row the gyro, column the axis of force."""
        return self._values(self.values).per_g

    @property
    def needs(self) -> tuple[str, ...]:
        """Conditions that it depends on: `force_g`, `temperature_c`, `supply_v`."""
        found = {kind_of(one.name) for one in self.parameters}
        wanted = {
            "force_g": {"g_sensitivity", "g2_sensitivity"},
            "temperature_c": {kind for kind in _KINDS if "temperature" in kind},
            "supply_v": {"gyro_supply"},
        }
        return tuple(name for name, kinds in wanted.items() if found & kinds)

    def summary(self) -> str:
        """What it holds in lines of text."""
        lines = [f"gyros by method {self.method}", *(f"  {one}" for one in self.parameters)]
        lines += [f"  not determined, taken as nominal: {', '.join(self.assumed)}"] if self.assumed else []
        lines += [f"  not corrected: {one.effect}: {one.reason}" for one in self.not_corrected]
        return "\n".join(lines)

    def as_dict(self) -> dict[str, Any]:
        """JSON document."""
        from adis_gonio.calibrate.document import gyro_document_of

        return gyro_document_of(self)

    # -- use ----------------------------------------------------------------------------------------

    def correct(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Floats:
        """True rate of turn in the accelerometers' frame.

        Parameters
        ----------
        rate_dps : (n, 3) or (3,) float
            Readings of the gyros in °/s (`ScanBlock.gyro_dps`).
        force_g : (n, 3) or (3,) float, optional
            What the accelerometers read then, in g; needed where a g-sensitivity is known.
        temperature_c : float, (n,) or (n, 3) float, optional
            One, or one for each gyro's die ((3,) of one reading); without it the session's mean.
        supply_v : float or (n,) float, optional
            Without it the session's mean.

        Returns
        -------
        (n, 3) or (3,) float
            °/s.

        Raises
        ------
        UsageError
            Wrong shape, NaN or infinity, or no force where it counts.
        """
        rate, single = _rows("rate_dps", rate_dps)
        conditions = self._conditions(len(rate), force_g, temperature_c, supply_v)
        corrected = _corrected(self._values(self.values), rate, *conditions)
        return corrected[0] if single else corrected

    def rates(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Rates:
        """As `correct`, with the standard uncertainty that the calibration lends to each rate."""
        return self._rates(_corrected, rate_dps, (force_g, temperature_c, supply_v))

    def readings_of(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Rates:
        """What the gyros read of a true rate, with u: `correct` undone; the zero rate of a rate of zero."""
        return self._rates(_read, rate_dps, (force_g, temperature_c, supply_v))

    def _rates(
        self,
        function: Callable[..., Floats],
        rate_dps: ArrayLike,
        felt: tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None],
    ) -> Rates:
        """A function of the parameters and the rates, with the u that the parameters lend to it."""
        rate, single = _rows("rate_dps", rate_dps)
        conditions = self._conditions(len(rate), *felt)
        value, u = self._with_u(lambda values: function(self._values(values), rate, *conditions))
        return Rates(value[0], u[0]) if single else Rates(value, u)

    def force_part(self, force_g: ArrayLike) -> tuple[Floats, Floats]:
        """What force (3,) in g adds to the zero rates (3,) in °/s, and its standard uncertainty."""
        force = _spread("force_g", force_g, 1)
        value, u = self._with_u(
            lambda values: np.asarray(
                force @ self._values(values).per_g.T + force**2 @ self._values(values).per_g2.T
            )
        )
        return value[0], u[0]

    def with_offsets(self, offsets_lsb: Sequence[int]) -> GyroCalibration:
        """The same for a part whose XGYRO_OFF … hold other numbers than while it was calibrated.

        The part adds them to its outputs, so that what the chip corrects now has left the zero rate.

        Raises
        ------
        UsageError
            The session does not say what the registers held.
        """
        if self.offsets_lsb is None:
            raise UsageError("the session does not say which gyro offsets stood in the chip")
        now = checked_offsets(offsets_lsb)
        moved = GYRO_OFFSET_DPS * (np.array(now) - np.array(self.offsets_lsb))
        return replace(self._with_bias_moved(moved), offsets_lsb=now)

    def with_force_moved(self, moved_g: ArrayLike) -> GyroCalibration:
        """The same where the accelerometers read so much more (3,) in g, as by their offset registers."""
        moved = np.asarray(moved_g, dtype=float)
        return self._with_bias_moved(-self.g_sensitivity_dps_per_g @ moved)

    def _with_bias_moved(self, by_dps: Floats) -> GyroCalibration:
        added = {f"gyro_bias_{axis}": float(by) for axis, by in zip(AXES, by_dps, strict=True)}
        return replace(self, parameters=self._moved(added))

    # -- how ----------------------------------------------------------------------------------------

    def _stated(self) -> dict[str, float]:
        return {one.name: one.value for one in self.parameters}

    def _vector(self, kind: str, held: Mapping[str, float], nominal: float = 0.0) -> Floats:
        return np.array([held.get(f"{kind}_{axis}", nominal) for axis in AXES])

    def _matrix(self, kind: str, held: Mapping[str, float]) -> Floats:
        return np.array([[held.get(f"{kind}_{i}{j}", 0.0) for j in AXES] for i in AXES])

    def _values(self, values: Floats) -> _Values:
        held = {one.name: float(v) for one, v in zip(self.parameters, values, strict=True)}
        misalignment = np.sin(np.radians(self._matrix("gyro_misalignment", held)))
        own = np.sqrt(np.maximum(1 - (misalignment**2).sum(axis=1), 0.0))
        gains = self._vector("gyro_scale", held, 1.0)
        return _Values(
            bias=self._vector("gyro_bias", held),
            sensitivity=gains[:, None] * (misalignment + np.diag(own)),
            per_g=self._matrix("g_sensitivity", held),
            per_g2=self._matrix("g2_sensitivity", held),
            per_c=(
                self._vector("gyro_bias_temperature", held),
                self._vector("gyro_bias_temperature2", held),
                self._vector("gyro_bias_temperature3", held),
            ),
            scale_per_c=1e-6 * self._vector("gyro_scale_temperature", held),
            per_v=self._vector("gyro_supply", held),
        )

    def _conditions(
        self, n: int, force_g: ArrayLike | None, temperature_c: ArrayLike | None, supply_v: ArrayLike | None
    ) -> tuple[Floats, Floats, Floats]:
        """Force (n, 3), temperature above 25 °C (n, 3), supply above 5 V (n, 1)."""
        needs = self.needs
        if force_g is None and "force_g" in needs:
            raise UsageError("these gyros feel force: give force_g, what the accelerometers read in g")
        force = np.zeros((n, 3)) if force_g is None else _spread("force_g", force_g, n)
        warm = _condition("temperature_c", temperature_c, n, self.temperature_c, REFERENCE_C, needs)
        volts = _condition("supply_v", supply_v, n, self.supply_v, REFERENCE_V, needs)
        return force, warm - REFERENCE_C, volts - REFERENCE_V

    def _with_u(self, function: Callable[[Floats], Floats]) -> tuple[Floats, Floats]:
        value, variance = self._with_variance(function)
        return value, np.sqrt(variance)


def kind_of(name: str) -> str | None:
    """What stands before the axes of a gyro's parameter; None for other names."""
    match = _NAME.fullmatch(name)
    if match is None or match["kind"] not in _KINDS:
        return None
    axes, wanted = match["axes"], _KINDS[match["kind"]][0]
    if len(axes) != (1 if wanted is _ONE else 2) or (wanted is _OTHER and axes[0] == axes[1]):
        return None
    return match["kind"]


def _order(name: str) -> tuple[int, str]:
    kind = kind_of(name)
    return list(_KINDS).index(kind or ""), name


def _assumed(known: Sequence[str]) -> tuple[str, ...]:
    pairs = [i + j for i in AXES for j in AXES]
    wanted = [f"gyro_scale_{axis}" for axis in AXES]
    wanted += [f"gyro_misalignment_{pair}" for pair in pairs if pair[0] != pair[1]]
    wanted += [f"g_sensitivity_{pair}" for pair in pairs]
    return tuple(name for name in wanted if name not in known)


def _determined(estimate: Any) -> bool:
    """False where a result states a value that its session does not determine."""
    return bool(np.isfinite(estimate.value)) and (estimate.u is None or bool(np.isfinite(estimate.u)))


def _taken(
    names: Sequence[str],
    parameters: Sequence[Coefficient],
    covariance: tuple[Sequence[str], Floats] | None,
) -> Floats | None:
    """Covariance (p, p) of the parameters of these names."""
    if any(one.u is None for one in parameters):
        return None
    if covariance is None:
        return np.diag([float(one.u or 0.0) ** 2 for one in parameters])
    given, matrix = list(covariance[0]), np.asarray(covariance[1], dtype=float)
    taken: Floats = np.diag([float(one.u or 0.0) ** 2 for one in parameters])
    inside = [k for k, name in enumerate(names) if name in given]
    rows = [given.index(names[k]) for k in inside]
    taken[np.ix_(inside, inside)] = (matrix[np.ix_(rows, rows)] + matrix[np.ix_(rows, rows)].T) / 2
    return taken


def _corrected(v: _Values, rate: Floats, force: Floats, warm: Floats, volts: Floats) -> Floats:
    free = (rate - _zero(v, force, warm, volts)) / (1 + v.scale_per_c * warm)
    return np.asarray(free @ np.linalg.inv(v.sensitivity).T)


def _read(v: _Values, rate: Floats, force: Floats, warm: Floats, volts: Floats) -> Floats:
    return np.asarray((1 + v.scale_per_c * warm) * (rate @ v.sensitivity.T) + _zero(v, force, warm, volts))


def _zero(v: _Values, force: Floats, warm: Floats, volts: Floats) -> Floats:
    """What is read of no turn (n, 3)."""
    by_warmth = sum((c * warm ** (k + 1) for k, c in enumerate(v.per_c)), np.zeros(warm.shape))
    return np.asarray(v.bias + force @ v.per_g.T + force**2 @ v.per_g2.T + by_warmth + v.per_v * volts)


def _rows(name: str, given: ArrayLike) -> tuple[Floats, bool]:
    values = _numbers(name, given)
    if values.ndim not in (1, 2) or values.shape[-1] != 3:
        raise UsageError(f"{name} has shape {values.shape}; give (n, 3), one row a reading")
    return np.atleast_2d(values), values.ndim == 1


def _spread(name: str, given: ArrayLike, n: int) -> Floats:
    rows, _ = _rows(name, given)
    if len(rows) not in (1, n):
        raise UsageError(f"{name} has {len(rows)} rows for {n} readings")
    return np.broadcast_to(rows, (n, 3))


def _condition(
    name: str,
    given: ArrayLike | None,
    n: int,
    covered: Covered | None,
    nominal: float,
    needs: Sequence[str],
) -> Floats:
    """Condition (n, 3) as given, else the session's mean where it counts, else the nominal one."""
    if given is None:
        return np.full((n, 3), covered.mean if covered is not None and name in needs else nominal)
    values = _numbers(name, given)
    if values.shape in ((), (1,)):
        return np.full((n, 3), float(values.reshape(-1)[0]))
    if values.shape == (3,) and n == 1 and name == "temperature_c":
        return values[None, :]
    if values.shape == (n,):
        return np.repeat(values[:, None], 3, axis=1)
    if values.shape != (n, 3) or name != "temperature_c":
        raise UsageError(
            f"{name} has shape {values.shape}; give one number, or one for each of {n} readings"
        )
    return values


def _numbers(name: str, given: ArrayLike) -> Floats:
    values = checked_numbers(name, given)
    if not np.isfinite(values).all():
        raise UsageError(f"{name} holds NaN or infinity")
    return values
