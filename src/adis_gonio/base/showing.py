"""How results show themselves in Python: numbers with u, lines of text, tables, data frames."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import NotInstalledError

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]
Entries = Iterable[tuple[str, Row]]
"""Names and their entries in a document; two effects may share a name."""


def shown_unit(unit: str) -> str:
    """A unit of names and documents as people read it: ° for deg, °/s/g for dps/g, nothing for 1."""
    return {"deg": "°", "1": ""}.get(unit, unit.replace("dps", "°/s"))


def with_u(value: float, u: float | None, unit: str) -> str:
    """A value to the second digit of its u, such as `1.08 mg (u 0.13 mg)`."""
    sign = shown_unit(unit)
    sign = f" {sign}" if sign not in ("", "°") else sign
    if u is None or not math.isfinite(u):
        return f"{value:.6g}{sign} (u unknown)"
    digits = max(0, 1 - math.floor(math.log10(u))) if u > 0 else 9
    return f"{value:.{digits}f}{sign} (u {u:.{digits}f}{sign})"


def lines_of(entries: Entries) -> list[str]:
    """Indented lines, one a parameter of a document."""
    return [f"  {name}: {with_u(one['value'], one['u'], one['unit'])}" for name, one in entries]


class ParameterTable:
    """Base of results that show their parameters as a table in notebooks and as a data frame."""

    def as_dict(self) -> dict[str, Any]:
        """JSON document."""
        raise NotImplementedError

    @property
    def _title(self) -> str:
        return repr(self)

    @property
    def _entries(self) -> Entries:
        entries: Entries = self.as_dict()["parameters"].items()
        return entries

    def _repr_html_(self) -> str:
        """The parameters as a table, for notebooks."""
        return html_table(self._title, self._entries)

    def to_pandas(self) -> pd.DataFrame:
        """Parameters by name as a data frame: value, u, unit and what else is stated (extra: pandas)."""
        return parameter_frame(self._entries)


def html_table(title: str, entries: Entries) -> str:
    """Parameters of a document as a plain table with its title, for notebooks; everything escaped."""
    rows = [{"parameter": name, **one} for name, one in entries]
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


def parameter_frame(entries: Entries) -> pd.DataFrame:
    """Parameters of a document as a data frame, one row each, by name; what is unknown is NaN.

    Raises
    ------
    NotInstalledError
        As `frame`.
    """
    table = frame([{"parameter": name, **one} for name, one in entries]).set_index("parameter")
    return table.astype({name: float for name in table.columns if name != "unit"})


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
