"""How the answer is written: quantities with u, U and k in columns that fit a page of text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from adis_gonio.base.showing import shown_unit
from adis_gonio.base.values import Value

NAMES = {
    "delta_k": "ΔK",
    "delta_phi": "Δφ",
    "angle": "angle error, rms",
    "alpha": "α",
    "scale_x": "K_x",
    "scale_y": "K_y",
    "scale_z": "K_z",
}
"""Names as they stand in formulas."""
HEAD = ("quantity", "unit", "value", "u", "U (95 %)", "k")
UNKNOWN = "u unknown"


@dataclass(frozen=True)
class Line:
    """One quantity as texts: name, unit, value, u, U, k."""

    name: str
    unit: str
    value: str
    u: str
    expanded: str
    k: str

    @classmethod
    def of(cls, name: str, value: Value) -> Line:
        """Both rounded to two digits of u; `u unknown` where nothing tells it."""
        shown = NAMES.get(name, name)
        unit = shown_unit(value.unit)
        if value.u is None or value.U is None or value.k is None:
            return cls(shown, unit, _general(value.value), UNKNOWN, "–", "–")
        digits = decimals(value.u)
        return cls(
            shown,
            unit,
            "–" if math.isnan(value.value) else fixed(value.value, digits),
            fixed(value.u, digits),
            fixed(value.U, digits),
            f"{value.k:.2f}",
        )

    @property
    def cells(self) -> tuple[str, ...]:
        """All texts."""
        return (self.name, self.unit, self.value, self.u, self.expanded, self.k)


def decimals(u: float) -> int:
    """Decimals that show two digits of u."""
    return max(0, 1 - math.floor(math.log10(u))) if u > 0 else 6


def fixed(value: float, digits: int) -> str:
    """A number with a real minus sign; powers of ten where it would be a row of zeros."""
    return (f"{value:.{digits}f}" if digits <= 9 else f"{value:.1e}").replace("-", "−")


def _general(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.6g}".replace("-", "−")


def lines_as_text(lines: Sequence[Line], indent: int = 2) -> list[str]:
    """A table in plain text, numbers to the right."""
    rows = [HEAD, *(line.cells for line in lines)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEAD))]
    return [
        " " * indent
        + "  ".join(
            cell.ljust(width) if k < 2 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def wrapped(text: str, width: int, indent: int = 0) -> list[str]:
    """Lines of at most `width` columns."""
    margin = " " * indent
    return textwrap.wrap(text, width, initial_indent=margin, subsequent_indent=margin) or [""]
