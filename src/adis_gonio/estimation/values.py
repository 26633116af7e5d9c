"""A value with its uncertainty and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Value:
    """A value with its standard uncertainty (None: not determined) and unit."""

    value: float
    u: float | None
    unit: str

    def as_dict(self) -> dict[str, Any]:
        """`{"value", "u", "unit"}`."""
        return {"value": finite_or_none(self.value), "u": finite_or_none(self.u), "unit": self.unit}


def finite_or_none(value: float | None) -> float | None:
    """JSON has no infinities and no NaN."""
    return None if value is None or not math.isfinite(value) else float(value)


@dataclass(frozen=True)
class Detectable:
    """Smallest amplitude that the session would have shown; None where it can show none."""

    amplitude: float | None
    unit: str
    parameter: str
    reason: str = ""

    def as_dict(self) -> dict[str, Any]:
        """One value of `detectable`."""
        return {
            "amplitude": finite_or_none(self.amplitude),
            "unit": self.unit,
            "parameter": self.parameter,
            "reason": self.reason,
        }
