"""`GyroCalibration`: errors of the three gyros of a sensor, and the corrected rate of turn.

In the frame of the accelerometers a gyro reads, in °/s,

    rate = (1 + κ ΔT) K D ω + b + β ΔT + β₂ ΔT² + β₃ ΔT³ + G f + G₂ f² + s ΔV,

with the true rate ω, gains K and unit directions D (`sensitivity` = K D), the relative change κ of the
gains per °C, the zero rate b, its coefficients β, β₂, β₃ of the temperature and s of the supply voltage,
the sensitivities G to force and G₂ to squared force, the force f that the accelerometers **read** in g
(level with Z up: z = −1), ΔT = T − 25 °C and ΔV = V − 5 V. f is the uncorrected reading, including the bias
of the accelerometers, because gyros may be calibrated before accelerometers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from adis_gonio.base.arrays import Floats, unit_directions
from adis_gonio.base.errors import FitError, SessionError, UsageError
from adis_gonio.base.jsonable import json_object
from adis_gonio.calibrate.calibration import (
    VERSION,
    Coefficient,
    Coefficients,
    checked_offsets,
    checked_rows,
    left_to_temperature,
)
from adis_gonio.device.sensor.registers import VARIANTS, Kind
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.model.effects.sensor_terms import REFERENCE_C, REFERENCE_V
from adis_gonio.record.provenance import Covered, Provenance
from adis_gonio.record.write_journal import INTERRUPTED

GYRO_OFFSET_DPS = VARIANTS["adis16354"].lsb(Kind.GYRO_OFFSET)[0]
"""Size in °/s of the LSB of the registers XGYRO_OFF …, equal at every range (data sheet, A)."""

PAIRS = tuple(i + j for i in AXES for j in AXES)
_KINDS: dict[str, tuple[Sequence[str], str]] = {
    "gyro_bias": (AXES, "dps"),
    "gyro_scale": (AXES, "1"),
    "gyro_misalignment": (tuple(pair for pair in PAIRS if pair[0] != pair[1]), "deg"),
    "g_sensitivity": (PAIRS, "dps/g"),
    "g2_sensitivity": (PAIRS, "dps/g²"),
    "gyro_bias_temperature": (AXES, "dps/°C"),
    "gyro_bias_temperature2": (AXES, "dps/°C²"),
    "gyro_bias_temperature3": (AXES, "dps/°C³"),
    "gyro_scale_temperature": (AXES, "ppm/°C"),
    "gyro_supply": (AXES, "dps/V"),
}
"""Letters with which the names of the parameters of a kind end, and their unit, by kind of parameter."""
KIND_OF = {f"{kind}_{letters}": kind for kind, (ends, _) in _KINDS.items() for letters in ends}
"""Kind of each gyro parameter by its name, such as `gyro_scale` of `gyro_scale_x`, in the usual order."""
UNIT_OF = {name: _KINDS[kind][1] for name, kind in KIND_OF.items()}
"""Unit of each gyro parameter by its name."""
_EXPECTED = ("gyro_scale", "gyro_misalignment", "g_sensitivity")
"""Kinds of parameters that a calibration lists as assumed if the session does not determine them."""
LEAST_DETERMINANT = 0.1
"""Smallest determinant of the matrix of gains times directions that is accepted; three working gyros have
about 1."""


@dataclass(frozen=True)
class Rates:
    """Rates of turn `rate_dps` (n, 3) in °/s and their standard uncertainties `u_dps` (n, 3).

    An unknown uncertainty is NaN.
    """

    rate_dps: Floats
    u_dps: Floats


ByKind = Mapping[str, Floats]
"""Parameters by kind, as a vector (3,) by gyro or a matrix (3, 3) with a row for each gyro."""


class GyroCalibration(Coefficients, eq=False, kw_only=True):
    """Calibration of the gyros, which converts readings to rates of turn in the accelerometers' frame.

    Attributes
    ----------
    parameters : tuple of Coefficient
        `gyro_bias_x …` (dps), and if determined `gyro_scale_x …` (1), `gyro_misalignment_xy …` (deg),
        `g_sensitivity_xy …` (dps/g), `g2_sensitivity_xy …` (dps/g²), `gyro_bias_temperature_x …` (dps/°C),
        `gyro_bias_temperature2_x …` and `…3_x …` for the square and the cube, `gyro_scale_temperature_x …`
        (ppm/°C) and `gyro_supply_x …` (dps/V). The first letter is the gyro. The second letter is the axis
        towards which the gyro is misaligned, or the axis of the force.
    temperature_c, supply_v : Covered or None
        Range of the temperature and of the supply voltage in the session; None if not recorded.
    offsets_lsb : tuple of int or None
        Numbers in XGYRO_OFF, YGYRO_OFF, ZGYRO_OFF for which the biases are valid; None if unknown.
    source : str
        Name of the session's file without its folder; empty without a file.
    """

    temperature_c: Covered | None = None
    supply_v: Covered | None = None
    offsets_lsb: tuple[int, int, int] | None = None
    source: str = ""
    schema: ClassVar[str] = "adis-gonio/gyro-calibration"

    @classmethod
    def of(
        cls,
        estimates: Mapping[str, Any],
        covariance: tuple[Sequence[str], Floats] | None = None,
        *,
        method: str = "gyro",
        where: Provenance | None = None,
        **about: Any,
    ) -> GyroCalibration:
        """Make a calibration from parameters by name, as a fit or a trace of the gyros gives them.

        Parameters
        ----------
        estimates : mapping of str to objects with `value`, `u`, `unit` (and `dof`)
            Estimated parameters by name. Other names than parameters of a gyro are ignored.
        method : str
            Name of the method that determined the parameters.
        covariance : (names, (p, p) float), optional
            Names of parameters, and their covariance in this order; it may contain other parameters. By
            default it is diagonal, from u.
        where : Provenance, optional
            Session that the estimates come from: the calibration is for its offset registers.
        about
            Further attributes of the calibration, such as `not_corrected`.

        Raises
        ------
        FitError
            A gyro has no zero rate, a parameter has a wrong unit, or gains and directions are impossible
            for three gyros.
        """
        known = [
            name
            for name in KIND_OF
            if name in estimates and np.isfinite([estimates[name].value, estimates[name].u or 0.0]).all()
        ]
        parameters = tuple(Coefficient.of(name, estimates[name]) for name in known)
        if where is not None:
            about |= {name: getattr(where, name) for name in ("temperature_c", "supply_v", "source")}
            about["offsets_lsb"] = where.gyro_offsets_lsb
        made = cls(
            method=method,
            parameters=parameters,
            covariance=_taken(parameters, covariance),
            assumed=tuple(n for n, kind in KIND_OF.items() if kind in _EXPECTED and n not in known),
            **about,
        )
        made.check()
        return made

    def check(self) -> None:
        """Raise `FitError` for a missing zero rate, a wrong unit, or impossible gains or directions."""
        missing = [f"gyro_bias_{axis}" for axis in AXES if f"gyro_bias_{axis}" not in self]
        if missing:
            raise FitError(f"{', '.join(missing)} not determined: the gyros are not calibrated")
        for one in self.parameters:
            if one.unit != UNIT_OF.get(one.name):
                raise FitError(f"{one.name} in {one.unit} is no parameter of a gyro")
        misalignment = self.by_kind(self.values)["gyro_misalignment"]
        if (np.abs(misalignment) >= 45).any() or abs(np.linalg.det(self.sensitivity)) < LEAST_DETERMINANT:
            raise FitError(
                "gains and directions are impossible for three gyros: one hardly responds to a turn"
            )

    # -- description ---------------------------------------------------------------------------------

    def __repr__(self) -> str:
        biases = ", ".join(str(self[f"gyro_bias_{axis}"]) for axis in AXES)
        return f"GyroCalibration({self.method}, {biases})"

    @property
    def bias_dps(self) -> Floats:
        """Readings (3,) of the gyros at rest in °/s (zero rates), without force, at 25 °C and 5 V."""
        return self.by_kind(self.values)["gyro_bias"]

    @property
    def sensitivity(self) -> Floats:
        """Matrix (3, 3) of scale factor times unit vector along the sensitive axis, one row for each gyro.

        Perfect gyros have the identity.
        """
        return sensitivity_of(self.by_kind(self.values))

    @property
    def g_sensitivity_dps_per_g(self) -> Floats:
        """g-sensitivity (3, 3) in °/s/g: one row for each gyro, one column for each axis of force."""
        return self.by_kind(self.values)["g_sensitivity"]

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the conditions that `correct` needs, from `force_g`, `temperature_c` and `supply_v`."""
        found = {KIND_OF[one.name] for one in self.parameters}
        wanted = {
            "force_g": {"g_sensitivity", "g2_sensitivity"},
            "temperature_c": {kind for kind in _KINDS if "temperature" in kind},
            "supply_v": {"gyro_supply"},
        }
        return tuple(name for name, kinds in wanted.items() if found & kinds)

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document of the calibration.

        The values under `derived` are computed from the parameters.
        """
        derived = ("bias_dps", "sensitivity", "g_sensitivity_dps_per_g")
        return json_object(
            schema=self.schema,
            version=VERSION,
            method=self.method,
            unit="dps",
            derived={name: getattr(self, name) for name in derived},
            **self._entries(self),
            source=self.source,
        )

    # -- use ----------------------------------------------------------------------------------------

    def correct(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Floats:
        """Convert readings of the gyros to the true rate of turn in the accelerometers' frame.

        Parameters
        ----------
        rate_dps : (n, 3) or (3,) float
            Readings of the gyros in °/s (`ScanBlock.gyro_dps`).
        force_g : (n, 3) or (3,) float, optional
            Readings of the accelerometers in g; required if a g-sensitivity is known.
        temperature_c : float, (n,) or (n, 3) float, optional
            One value, or one for each gyro's die ((3,) for one reading); the mean of the session by
            default.
        supply_v : float or (n,) float, optional
            Supply voltage; the mean of the session by default.

        Returns
        -------
        (n, 3) or (3,) float
            Rate of turn in °/s.

        Raises
        ------
        UsageError
            Wrong shape, NaN or infinity, or a required force is missing.
        """
        rate, single = checked_rows("rate_dps", rate_dps, (3,), "°/s")
        conditions = self._conditions(len(rate), force_g, temperature_c, supply_v)
        corrected = _corrected(self.by_kind(self.values), rate, *conditions)
        return corrected[0] if single else corrected

    def rates(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Rates:
        """Convert readings of the gyros to true rates of turn with their standard uncertainties.

        The uncertainty comes from the parameters of the calibration and, at a given temperature, from the
        temperature effects that it does not correct. `rate_dps` are the readings, `force_g` the readings of
        the accelerometers (required if a g-sensitivity is known). The default of `temperature_c` and
        `supply_v` is the mean of the session; u then has no part for another temperature.
        """
        return self._rates(_corrected, rate_dps, (force_g, temperature_c, supply_v))

    def readings_of(
        self,
        rate_dps: ArrayLike,
        force_g: ArrayLike | None = None,
        temperature_c: ArrayLike | None = None,
        *,
        supply_v: ArrayLike | None = None,
    ) -> Rates:
        """Return the readings that the gyros give at a true rate `rate_dps`, with u as of `rates`.

        This is the inverse of `correct`. `force_g` are the readings of the accelerometers (required if a
        g-sensitivity is known). The default of `temperature_c` and `supply_v` is the mean of the session.
        """
        return self._rates(_read, rate_dps, (force_g, temperature_c, supply_v))

    def _rates(
        self,
        function: Callable[..., Floats],
        rate_dps: ArrayLike,
        felt: tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None],
    ) -> Rates:
        """Evaluate a function of the parameters at given rates and conditions, with its uncertainty.

        `function` takes the parameters by kind, rates (n, 3) and the results of `_conditions`, and returns
        (n, 3). `felt` are the force in g, the temperature and the supply voltage; each may be None.
        """
        rate, single = checked_rows("rate_dps", rate_dps, (3,), "°/s")
        conditions = self._conditions(len(rate), *felt)
        value, variance = self.with_variance(
            lambda values: function(self.by_kind(values), rate, *conditions)
        )
        if felt[1] is not None:
            die_c, time_s = conditions[1] + REFERENCE_C, np.zeros(len(rate))
            here = Conditions(time_s, temperature_c=die_c.mean(axis=1), temperatures_c=die_c, rate_dps=rate)
            corrected = {KIND_OF[name] for name in self.names}
            # Gains are near 1: readings and corrected rates change alike.
            for change in left_to_temperature("gyro", corrected, rate, here, self.temperature_c):
                variance += change**2
        at = 0 if single else slice(None)
        return Rates(value[at], np.sqrt(variance)[at])

    def force_part(self, force_g: ArrayLike) -> Floats:
        """Return the zero rate (3,) in °/s that a force (3,) in g causes in each gyro."""
        return np.asarray(_by_force(self.by_kind(self.values), _forces(force_g, 1))[0])

    def with_offsets(self, offsets_lsb: Sequence[int]) -> GyroCalibration:
        """Return the calibration for a chip with other numbers in the offset registers XGYRO_OFF ….

        The chip adds these numbers to its outputs, so its zero rates change by the difference between the
        new and the old numbers. The other parameters of the returned calibration are unchanged.

        Raises
        ------
        UsageError
            The contents of the registers during the session are unknown.
        """
        if self.offsets_lsb is None:
            raise UsageError("the session does not state the contents of the gyro offset registers")
        now = checked_offsets(offsets_lsb)
        moved = GYRO_OFFSET_DPS * (np.array(now) - np.array(self.offsets_lsb))
        added = {f"gyro_bias_{axis}": float(by) for axis, by in zip(AXES, moved, strict=True)}
        return replace(self, parameters=self._moved(added), offsets_lsb=now)

    def as_written(self, where: Provenance | None) -> GyroCalibration:
        """Return a calibration adapted to the offsets that were written to the chip after its session.

        Gyro offsets change the zero rates; accelerometer offsets change the measured force. The calibration
        is unchanged if its session `where` is unknown (None).

        Raises
        ------
        SessionError
            A write of gyro offsets was interrupted.
        """
        if where is None:
            return self
        if where.gyro_write_open:
            raise SessionError(f"{where.source}: {INTERRUPTED}")
        gyro = self if where.gyro_written_lsb is None else self.with_offsets(where.gyro_written_lsb)
        if where.offsets_lsb is None or where.written_lsb is None or where.sensor not in VARIANTS:
            return gyro
        moved = np.array(where.written_lsb) - np.array(where.offsets_lsb)
        return gyro.with_force_moved(moved * VARIANTS[where.sensor].accel_mg_per_lsb / 1000)

    def with_force_moved(self, moved_g: ArrayLike) -> GyroCalibration:
        """Return the calibration for accelerometers that now read `moved_g` (3,) more, in g.

        This happens when their offset registers change. The measured force f then includes `moved_g` = m,
        so G (f − m) + G₂ (f − m)² has to be the same function of f: the zero rates change by −G m + G₂ m²,
        and G changes by −2 G₂ m. The covariance follows, since this is linear in the parameters.
        """
        moved = np.asarray(moved_g, dtype=float)
        if not moved.any():
            return self
        names = [n for n in KIND_OF if n in self or n.replace("g_sens", "g2_sens") in self]

        def changed(values: Floats) -> Floats:
            old = self.by_kind(values)
            new = {
                **old,
                "gyro_bias": old["gyro_bias"] + _by_force(old, -moved),
                "g_sensitivity": old["g_sensitivity"] - 2 * old["g2_sensitivity"] * moved,
            }
            at = [tuple(map(AXES.index, name.rpartition("_")[2])) for name in names]
            return np.array([new[KIND_OF[name]][place] for name, place in zip(names, at, strict=True)])

        covariance, u = None, [self[name].u if name in self else None for name in names]
        if self.covariance is not None:
            by_old = np.array([changed(one) for one in np.eye(len(self.names))]).T
            covariance = by_old @ self.covariance @ by_old.T
            u = np.sqrt(np.diag(covariance)).tolist()
        parameters = tuple(
            Coefficient(name, value, of_value, UNIT_OF[name], self[name].dof if name in self else None)
            for name, value, of_value in zip(names, changed(self.values).tolist(), u, strict=True)
        )
        assumed = tuple(name for name in self.assumed if name not in names)
        return replace(self, parameters=parameters, covariance=covariance, assumed=assumed)

    # -- computation ------------------------------------------------------------------------------

    def by_kind(self, values: Floats) -> ByKind:
        """Arrange values (p,) of the parameters by kind; a perfect gyro's value replaces a missing one."""
        held = dict(zip(self.names, values.tolist(), strict=True))
        made = {}
        for kind, (ends, _) in _KINDS.items():
            nominal = 1.0 if kind == "gyro_scale" else 0.0
            letters = AXES if ends is AXES else PAIRS
            rows = np.array([held.get(f"{kind}_{end}", nominal) for end in letters])
            made[kind] = rows if ends is AXES else rows.reshape(3, 3)
        return made

    def _conditions(
        self, n: int, force_g: ArrayLike | None, temperature_c: ArrayLike | None, supply_v: ArrayLike | None
    ) -> tuple[Floats, Floats, Floats]:
        """Check the conditions and expand them to one row for each of n readings.

        A temperature or supply of None takes the mean of the session, a force of None counts as zero if no
        gyro is sensitive to force.

        Return the force (n, 3) in g, degrees above 25 °C (n, 3) and volts above 5 V (n, 1).
        """
        if force_g is None and "force_g" in self.needs:
            raise UsageError(
                "these gyros are sensitive to force: give force_g, the readings of the accelerometers in g"
            )
        force = np.zeros((n, 3)) if force_g is None else _forces(force_g, n)
        warm = self._condition("temperature_c", temperature_c, n, self.temperature_c, REFERENCE_C, 3)
        volts = self._condition("supply_v", supply_v, n, self.supply_v, REFERENCE_V)
        # With a default there is always a value.
        assert warm is not None
        assert volts is not None
        return force, warm - REFERENCE_C, volts - REFERENCE_V


def _taken(
    parameters: Sequence[Coefficient], covariance: tuple[Sequence[str], Floats] | None
) -> Floats | None:
    """Return the covariance (p, p) of the parameters; None if any u is unknown.

    `covariance` has the names of these and perhaps other parameters, and their covariance matrix. If it is
    None, the parameters are uncorrelated and have the variance u².
    """
    if any(one.u is None for one in parameters):
        return None
    if covariance is None:
        return np.diag([float(one.u or 0.0) ** 2 for one in parameters])
    rows = [list(covariance[0]).index(one.name) for one in parameters]
    taken = np.asarray(covariance[1], dtype=float)[np.ix_(rows, rows)]
    return np.asarray((taken + taken.T) / 2)


def gyro_directions(misalignment_deg: Floats) -> Floats:
    """Return unit vectors (3, 3) along the sensitive axes of the gyros, one row for each gyro.

    `misalignment_deg` (3, 3) has the angle of each gyro (row) towards each other axis (column).
    """
    return unit_directions(np.sin(np.radians(misalignment_deg)))


def sensitivity_of(v: ByKind) -> Floats:
    """Return the matrix (3, 3) of scale factor times direction, one row for each gyro.

    `v` are the parameters by kind (`GyroCalibration.by_kind`).
    """
    return np.asarray(v["gyro_scale"][:, None] * gyro_directions(v["gyro_misalignment"]))


def _corrected(v: ByKind, rate: Floats, force: Floats, warm: Floats, volts: Floats) -> Floats:
    # Solve the equation of the module docstring for the true rate.
    free = (rate - _zero(v, force, warm, volts)) / _warm_gain(v, warm)
    return np.asarray(free @ np.linalg.inv(sensitivity_of(v)).T)


def _read(v: ByKind, rate: Floats, force: Floats, warm: Floats, volts: Floats) -> Floats:
    return np.asarray(_warm_gain(v, warm) * (rate @ sensitivity_of(v).T) + _zero(v, force, warm, volts))


def _warm_gain(v: ByKind, warm: Floats) -> Floats:
    return np.asarray(1 + 1e-6 * v["gyro_scale_temperature"] * warm)


def _by_force(v: ByKind, force: Floats) -> Floats:
    return np.asarray(force @ v["g_sensitivity"].T + force**2 @ v["g2_sensitivity"].T)


def _zero(v: ByKind, force: Floats, warm: Floats, volts: Floats) -> Floats:
    """Return the zero rates (n, 3) in °/s at n forces in g, temperatures and voltages.

    `v` are the values of the parameters by kind. `warm` are temperatures minus 25 °C, and `volts` are
    supply voltages minus 5 V.
    """
    powers = (v[f"gyro_bias_temperature{power}"] * warm ** int(power or 1) for power in ("", "2", "3"))
    by_warmth = sum(powers, np.zeros(warm.shape))
    return np.asarray(v["gyro_bias"] + _by_force(v, force) + by_warmth + v["gyro_supply"] * volts)


def _forces(given: ArrayLike, n: int) -> Floats:
    rows, _ = checked_rows("force_g", given, (3,), "g")
    if len(rows) not in (1, n):
        raise UsageError(f"force_g has {len(rows)} rows for {n} readings")
    return np.broadcast_to(rows, (n, 3))
