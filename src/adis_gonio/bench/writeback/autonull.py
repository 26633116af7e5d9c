"""The chip's own null of its gyros against the zero rates that a session knows.

The chip takes its gyros' outputs of a moment for zero rates: noise of that moment, and what force adds in
this pose, go into its offsets. In the same pose the session predicts the same sum, with u; beyond the
uncertainty of both, one of them is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.writeback.checks import SIGMAS
from adis_gonio.bench.writeback.plan import WritePlan
from adis_gonio.bench.writeback.rest import Rest
from adis_gonio.device.sensor.registers import GYRO_OFF
from adis_gonio.model.effects.base import AXES
from adis_gonio.record.write_journal import Numbers

if TYPE_CHECKING:
    from adis_gonio.bench.writeback.parts import Gyros

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
