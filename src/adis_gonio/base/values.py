"""A value with its uncertainty and unit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from adis_gonio.base.intervals import expanded
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_uncertain


@dataclass(frozen=True)
class Value:
    """A value, its standard uncertainty (None: not determined), unit and effective degrees of freedom."""

    value: float
    u: float | None
    unit: str
    dof: float = math.inf
    factor: float | None = None
    """Coverage factor, where the distribution is not Student's with `dof`."""

    def __str__(self) -> str:
        """Value ± standard uncertainty with unit, such as `1.08 ± 0.13 mg`."""
        return format_uncertain(self.value, self.u, self.unit)

    @property
    def k(self) -> float | None:
        """Coverage factor of 95 %, by `dof` where `factor` is None; None without an uncertainty."""
        return expanded(self.u, self.dof, self.factor)[0]

    @property
    def U(self) -> float | None:  # noqa: N802 (GUM)
        """Expanded uncertainty k·u: value ± U covers 95 %."""
        return expanded(self.u, self.dof, self.factor)[1]

    def as_dict(self) -> dict[str, Any]:
        """`{"value", "u", "dof", "k", "U", "unit"}`; `dof` None where unlimited or unknown."""
        k, expanded_u = expanded(self.u, self.dof, self.factor)
        return {
            "value": finite_or_none(self.value),
            "u": finite_or_none(self.u),
            "dof": finite_or_none(self.dof) if k is not None else None,
            "k": k,
            "U": expanded_u,
            "unit": self.unit,
        }


def finite_or_none(value: float | None) -> float | None:
    """JSON has no infinities and no NaN."""
    return None if value is None or not math.isfinite(value) else float(value)


@dataclass(frozen=True)
class Detectable(JsonRecord):
    """Smallest amplitude that the session would have shown; None where it can show none.

    The JSON document is one value of `detectable`.
    """

    amplitude: float | None
    unit: str
    parameter: str
    reason: str = ""
