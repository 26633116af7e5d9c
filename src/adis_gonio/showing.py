"""How results show themselves in Python: numbers with u, lines of text, tables, data frames."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adis_gonio.errors import NotInstalledError

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]


def with_u(value: float, u: float | None, unit: str) -> str:
    """A value to the second digit of its u, such as `1.08 mg (u 0.13 mg)`."""
    sign = {"deg": "°", "1": ""}.get(unit, f" {unit}")
    if u is None or not math.isfinite(u):
        return f"{value:.6g}{sign} (u unknown)"
    digits = max(0, 1 - math.floor(math.log10(u))) if u > 0 else 9
    return f"{value:.{digits}f}{sign} (u {u:.{digits}f}{sign})"


def parameter_rows(entries: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a table from a document's `parameters`."""
    return [{"parameter": name, **entry} for name, entry in entries.items()]


def lines_of(entries: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Indented lines, one a parameter of a document."""
    return [f"  {name}: {with_u(one['value'], one['u'], one['unit'])}" for name, one in entries.items()]


def html_table(title: str, rows: Sequence[Row]) -> str:
    """A plain table with its title, for notebooks."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(_cell(row.get(name)))}</td>" for name in columns) + "</tr>"
        for row in rows
    )
    return (
        f"<table><caption>{html.escape(title)}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def frame(columns: Mapping[str, Any] | Sequence[Row]) -> pd.DataFrame:
    """Data frame of columns or rows.

    Raises
    ------
    NotInstalledError
        pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise NotInstalledError("data frames need pandas: pip install 'adis-gonio[pandas]'") from None
    return pandas.DataFrame(columns)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
