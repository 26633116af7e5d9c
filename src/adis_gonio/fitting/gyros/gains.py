"""Gains of the gyros that the moves between a session's positions gave: the line that says so.

A turn between two rests calibrates the gain of the gyro about its axis for nothing; whoever fits the
accelerometers is told what came out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.base.numbers import counted, format_uncertain
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.parts import GYRO, readings_of_part
from adis_gonio.fitting.gyros.fit import GyroFit, fit_gyro_readings
from adis_gonio.model.records import Session

_STEM = "gyro_scale_"


@dataclass(frozen=True)
class Gains:
    """What turns tell of the gyros' gains.

    Attributes
    ----------
    values : mapping of str to Value
        `gyro_scale_x …` of the gyros whose axis was turned about.
    turns : int
    """

    values: dict[str, Value]
    turns: int

    @property
    def line(self) -> str:
        """`gain of gyro Z by 3 turns between dwells: 1.0098 ± 0.0004`."""
        told = ", ".join(
            f"{name.removeprefix(_STEM).upper()} {format_uncertain(value.value, value.u, value.unit)}"
            for name, value in self.values.items()
        )
        gyros = "gyro" if len(self.values) == 1 else "gyros"
        return f"gain of {gyros} {told}, by {counted(self.turns, 'turn')} (fit --sensor-part gyro)"

    def as_dict(self) -> dict[str, Any]:
        """JSON: the parameters by name, and `turns_used`."""
        return {name: value.as_dict() for name, value in self.values.items()} | {"turns_used": self.turns}


def gains_in(result: GyroFit) -> Gains | None:
    """Gains in a fit of the gyros; None where no turn tells one."""
    found = {name: value for name, value in result.parameters.items() if name.startswith(_STEM)}
    return Gains(found, result.turns) if found and result.turns else None


def gains_of(session: Session) -> Gains | None:
    """Gains by a session's turns; None where it has none, or they tell none."""
    try:
        if not any(turn.gyro is not None and len(turn) for turn in session.turns):
            return None
        return gains_in(fit_gyro_readings(readings_of_part(session, GYRO).training, scored=False))
    except AdisGonioError:
        return None
