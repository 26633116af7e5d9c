"""Is this the session's part, and did the write do what was planned: dwells at rest against the session.

At a declared angle the session's fit predicts both readings; without one only the length of gravity. All
uncertainties go in: of the parameters (with their covariance), of the dwell, of the angle, of the noise
that wanders between then and now, and of a temperature that is another one.

The chip's own null of its gyros against the zero rates that a session knows.

The chip takes its gyros' outputs of a moment for zero rates: noise of that moment, and what force adds in
this pose, go into its offsets. In the same pose the session predicts the same sum, with u; beyond the
uncertainty of both, one of them is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats, central_differences
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import NAMED_BY_UNIT, JsonRecord
from adis_gonio.bench.writeback.plan import BIASES, UNITS, WritePlan
from adis_gonio.bench.writeback.rest import Rest
from adis_gonio.device.sensor.registers import GYRO_OFF
from adis_gonio.device.sensor.variants import Variant, variant
from adis_gonio.model.effects.base import AXES
from adis_gonio.model.measurement import FreeAttitude, PlanarTurn
from adis_gonio.model.records import Session
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.bench.writeback.parts import Gyros
    from adis_gonio.fitting import FitResult

SIGMAS = 4.0
"""Limit of a difference in standard uncertainties: a sound part is accused once in 16 000 comparisons."""
SET_ANEW_U_DEG = 0.05
"""Standard uncertainty of an angle that is set anew where the session states none: a few positions of a
session cannot estimate it, and a vernier is read no better."""
LEAST_SHARE = 0.5
"""Least share of gravity in the session's plane for its length there to say anything."""


@dataclass(frozen=True)
class Agreement(JsonRecord):
    """Measured against expected.

    Attributes
    ----------
    what : str
        What was compared, in words.
    names : tuple of str
        One a figure, such as `X`.
    measured, expected, u : (k,) float
        `u` is that of the difference.
    unit : str
        `mg` or `dps`.
    """

    document_keys = ("what", "names", "measured", "expected", "u", "agrees")

    what: str
    names: tuple[str, ...]
    measured: Floats = field(metadata=NAMED_BY_UNIT)
    expected: Floats = field(metadata=NAMED_BY_UNIT)
    u: Floats = field(metadata=NAMED_BY_UNIT)
    unit: str = "mg"

    @property
    def off(self) -> Floats:
        """Differences (k,) in their standard uncertainties."""
        return np.asarray((self.measured - self.expected) / self.u)

    @property
    def agrees(self) -> bool:
        """True where no difference is beyond `SIGMAS`."""
        return bool((np.abs(self.off) <= SIGMAS).all())

    def __str__(self) -> str:
        unit, places = UNITS[self.unit], 2 if self.unit == "mg" else 3
        figures = [
            f"{name} {m:.{places}f} {unit}, expected {e:.{places}f} {unit} (u {u:.2g} {unit})"
            for name, m, e, u in zip(self.names, self.measured, self.expected, self.u, strict=True)
        ]
        return f"{self.what}: {'; '.join(figures)}"


def against_session(
    session: Session, result: FitResult, plan: WritePlan, rest: Rest, angle_deg: float | None
) -> Agreement:
    """A dwell at rest against what the session says of the part, with the offsets that are in it now.

    Parameters
    ----------
    angle_deg : float or None
        Declared angle of the stage; None (or a session without angles) compares the length of gravity.

    Raises
    ------
    FitError
        The fit lacks what is needed, or the part does not stand in the session's plane.
    """
    bias = _Biased(session, result, plan, rest)
    angled = session.plane == "xy" and angle_deg is not None and "alpha" in result
    if angled and angle_deg is not None and math.isfinite(result.fixture_sigma_deg or 0.0):
        return _at_angle(bias, math.radians(angle_deg))
    return _by_length(bias)


def bias_found(
    session: Session, result: FitResult, plan: WritePlan, rest: Rest, angle_deg: float
) -> tuple[Floats, Floats]:
    """Biases (2,) in mg that a dwell at a declared angle shows by itself, and their standard uncertainties.

    The fit's gains and angles enter, its biases do not.
    """
    bias = _Biased(session, result, plan, rest)
    turn = math.radians(angle_deg)

    def left(values: Floats, mean: Floats) -> Floats:
        return np.asarray(mean[:2] - bias.ideal_mg(values, turn))

    return bias.propagated(left, bias.fixture_u(turn))


def effect_of(plan: WritePlan, before: Rest, after: Rest) -> Agreement:
    """How far the outputs moved between two dwells in the same place, against the plan."""
    part = variant(plan.variant)
    rows = [AXES.index(axis.axis) for axis in plan.axes]
    # Between neighbouring dwells the bias wanders by the floor of its Allan deviation, and with the warmth.
    wander = math.hypot(
        math.sqrt(2) * part.performance.bias_instability_mg,
        part.performance.bias_tempco_mg_per_c * (after.temperature_c - before.temperature_c),
    )
    u = np.sqrt(before.u_mg**2 + after.u_mg**2 + wander**2)[rows]
    return Agreement(
        "the write moved the outputs by",
        tuple(axis.axis.upper() for axis in plan.axes),
        (after.mean_mg - before.mean_mg)[rows],
        np.array([axis.effect for axis in plan.axes]),
        u,
    )


class _Biased:
    """The fit as a function of its parameters, with what they and a dwell are uncertain by."""

    def __init__(self, session: Session, result: FitResult, plan: WritePlan, rest: Rest) -> None:
        self.session, self.result, self.rest = session, result, rest
        self.planar = session.plane == "xy"
        self.model = PlanarTurn(session.gravity_mg) if self.planar else FreeAttitude(session.gravity_mg)
        axes = AXES[: self.model.axes]
        self.names = [*self.model.names, *(f"bias_{axis}" for axis in axes)]
        if "alpha" not in result and self.planar:
            self.names.remove("alpha")
        # Skews that a session in space did not show are zero in its fit, biases too.
        self.known = [name for name in self.names if name in result]
        missing = [name for name in self.names if name.startswith("scale") and name not in result]
        if missing or result.covariance is None:
            raise FitError(
                f"{session.source}: the fit does not give {', '.join(missing) or 'uncertainties'}"
            )
        self.values = np.array([result[name].value for name in self.known])
        order = [[e.name for e in result.parameters].index(name) for name in self.known]
        self.covariance = np.asarray(result.covariance)[np.ix_(order, order)]
        moved = {axis.axis: (axis.now - axis.recorded) * axis.lsb for axis in plan.axes}
        self.moved_mg = np.array([moved.get(axis, 0.0) for axis in axes])
        self.u_mg = self._reading_u(variant(plan.variant))

    def _reading_u(self, part: Variant) -> Floats:
        """Standard uncertainty (axes,) of a dwell as a sample of what the session saw."""
        axes = self.model.axes
        then = [float(d.temperature_c.mean()) for d in self.session.dwells if d.temperature_c is not None]
        warmer = self.rest.temperature_c - float(np.mean(then)) if then else 0.0
        shared = math.hypot(
            math.sqrt(2) * part.performance.bias_instability_mg,
            part.performance.bias_tempco_mg_per_c * warmer,
            self.result.extra_mg,
        )
        return np.hypot(self.rest.u_mg[:axes], shared)

    def base(self, values: Floats) -> Floats:
        """Base parameters in natural units."""
        held = dict(zip(self.known, values, strict=True))
        return np.array(
            [held[p.name] / p.per_natural if p.name in held else p.nominal for p in self.model.parameters]
        )

    def bias_mg(self, values: Floats) -> Floats:
        """Biases (axes,) with the offsets of now."""
        held = dict(zip(self.known, values, strict=True))
        found = [held.get(name, 0.0) for name in BIASES[: self.model.axes]]
        return np.asarray(np.array(found) + self.moved_mg)

    def ideal_mg(self, values: Floats, angle_rad: float) -> Floats:
        """What gravity alone gives (2,) at a declared angle."""
        ideal: Floats = self.model.ideal(self.base(values), np.zeros(1), np.array([-angle_rad]))[0]
        return ideal

    def fixture_u(self, angle_rad: float) -> Floats:
        """What the uncertainty of the declared angle makes of a reading (2,)."""
        unstated = self.session.fixture_sigma_deg is None
        more = SET_ANEW_U_DEG if unstated else 0.0
        sigma = math.radians(math.hypot(self.result.fixture_sigma_deg or 0.0, more))
        tangent = self.model.tangent(self.base(self.values), np.zeros(1), np.array([-angle_rad]))
        return np.asarray(sigma * np.abs(tangent[0, :, 0]))

    def propagated(
        self, function: Callable[[Floats, Floats], Floats], more_u: Floats
    ) -> tuple[Floats, Floats]:
        """Value (k,) of a function of parameters and mean, and its standard uncertainty."""
        mean = self.rest.mean_mg
        by_parameter = _slopes(lambda v: function(v, mean), self.values)
        by_reading = _slopes(lambda m: function(self.values, m), mean[: self.model.axes])
        variance = np.einsum("kp,pq,kq->k", by_parameter, self.covariance, by_parameter)
        variance = variance + (by_reading**2) @ self.u_mg**2 + more_u**2
        return function(self.values, mean), np.sqrt(variance)


def _at_angle(bias: _Biased, angle_rad: float) -> Agreement:
    def left(values: Floats, mean: Floats) -> Floats:
        return np.asarray(mean[:2] - bias.ideal_mg(values, angle_rad) - bias.bias_mg(values))

    value, u = bias.propagated(left, bias.fixture_u(angle_rad))
    predicted = bias.ideal_mg(bias.values, angle_rad) + bias.bias_mg(bias.values)
    where = f"readings at {math.degrees(angle_rad):g}° against the session"
    return Agreement(where, ("X", "Y"), predicted + value, predicted, u)


def _by_length(bias: _Biased) -> Agreement:
    gravity = bias.session.gravity_mg

    def length(values: Floats, mean: Floats) -> Floats:
        free = (mean[: bias.model.axes] - bias.bias_mg(values))[None, :]
        return np.asarray(gravity * np.linalg.norm(bias.model.calibrated(bias.base(values), free), axis=1))

    value, u = bias.propagated(length, np.zeros(1))
    if value[0] < LEAST_SHARE * gravity:
        raise FitError(
            f"X and Y read {value[0]:.0f} mg of gravity together: set the part up as in the session, its"
            " plane of rotation vertical"
        )
    return Agreement(
        "gravity's length by the session's calibration", ("|g|",), value, np.array([gravity]), u
    )


def _slopes(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """∂f/∂x (k, p); the functions here are smooth on the scale of a thousandth."""
    return central_differences(function, at, 1e-4 * np.maximum(1.0, np.abs(at)))


PRECISE_S = 30.0
"""Length of the mean that a precision autonull takes (DS, A: about 30 s)."""


@dataclass(frozen=True)
class AutonullFound:
    """Zero rates (3,) in °/s in this pose, at the offsets of the recording, by the chip and by the session.

    Attributes
    ----------
    new : dict of str to int
        Numbers that the chip put into its registers.
    chip_dps, u_chip_dps : (3,) float
    session_dps, u_session_dps : (3,) float
    force_dps : (3,) float
        Part of the session's that force makes in this pose, and that the chip takes for a zero rate.
    """

    new: dict[str, int]
    chip_dps: Floats
    u_chip_dps: Floats
    session_dps: Floats
    u_session_dps: Floats
    force_dps: Floats

    @property
    def off_dps(self) -> Floats:
        """Chip less session (3,)."""
        return np.asarray(self.chip_dps - self.session_dps)

    @property
    def u_dps(self) -> Floats:
        """Standard uncertainty of that (3,)."""
        return np.hypot(self.u_chip_dps, self.u_session_dps)

    @property
    def agrees(self) -> bool:
        """True where no gyro is off by more than `SIGMAS` standard uncertainties."""
        return bool((np.abs(self.off_dps) <= SIGMAS * self.u_dps).all())

    @property
    def by(self) -> str:
        """By how much each gyro is off that is off too far."""
        return ", ".join(
            f"{axis.upper()} {off:+.3f} °/s (u {u:.2g} °/s)"
            for axis, off, u in zip(AXES, self.off_dps, self.u_dps, strict=True)
            if abs(off) > SIGMAS * u
        )

    def __str__(self) -> str:
        figures = [
            f"{axis.upper()} {c:+.3f} °/s (u {uc:.2g}), session {s:+.3f} °/s"
            f" (u {us:.2g}, {f:+.3f} by force)"
            for axis, c, uc, s, us, f in zip(
                AXES,
                self.chip_dps,
                self.u_chip_dps,
                self.session_dps,
                self.u_session_dps,
                self.force_dps,
                strict=True,
            )
        ]
        return f"zero rates in this pose by the chip against the session: {'; '.join(figures)}"

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        arrays = ("chip_dps", "u_chip_dps", "session_dps", "u_session_dps", "force_dps", "off_dps", "u_dps")
        return {
            "new": dict(self.new),
            **{name: getattr(self, name).tolist() for name in arrays},
            "agrees": self.agrees,
        }


def compared(
    part: Gyros, plan: WritePlan, rest: Rest, nulled: Numbers, samples: float | None
) -> AutonullFound:
    """The chip's offsets against the session's zero rates in the pose of a dwell.

    Parameters
    ----------
    rest : Rest
        A dwell in the same pose, with gyros.
    nulled : mapping of str to int
        Numbers that the chip put into its registers.
    samples : float or None
        Updates that a precision autonull takes the mean of; None for the other one, which takes what the
        filter has.

    Raises
    ------
    UsageError
        The dwell has no gyros.
    """
    if rest.sample_dps is None or rest.u_dps is None:
        raise UsageError("an autonull is compared in a dwell with gyros")
    zero, u = part.zero(rest)
    recorded = {axis.register: axis.recorded for axis in plan.axes}
    lsb = plan.axes[0].lsb
    chip = np.array([(recorded[name] - nulled[name]) * lsb for name in GYRO_OFF])
    # White noise goes into a mean as the root of its length; the dwell before tells its size.
    noise = rest.sample_dps if samples is None else rest.u_dps * np.sqrt(rest.samples / samples)
    return AutonullFound(
        dict(nulled),
        chip,
        np.sqrt(noise**2 + lsb**2 / 12),
        zero,
        np.hypot(u, part.wander(rest)),
        part.by_force(rest)[0],
    )
