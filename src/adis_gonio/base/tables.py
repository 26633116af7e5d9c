"""Tables of results: lines of plain text, HTML for notebooks, data frames."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import NotInstalledError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_uncertain

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]
Entries = Iterable[tuple[str, Row]]
"""Names and their entries in a document; two effects may share a name."""


def align_columns(rows: Sequence[Sequence[str]], texts: int = 2, indent: int = 2) -> list[str]:
    """Lines of plain text from rows and their head; the first `texts` columns to the left, others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        " " * indent
        + "  ".join(
            cell.ljust(width) if k < texts else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def fold_text(text: str, width: int, indent: int = 0) -> list[str]:
    """Lines of at most `width` columns."""
    margin = " " * indent
    return textwrap.wrap(text, width, initial_indent=margin, subsequent_indent=margin) or [""]


def lines_of(entries: Entries) -> list[str]:
    """Indented lines, one for each parameter of a document."""
    return [f"  {name}: {format_uncertain(one['value'], one['u'], one['unit'])}" for name, one in entries]


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


class ParameterTable(JsonRecord):
    """Base class of a result that shows its parameters as a table in notebooks and as a data frame."""

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Caption of the table, and its rows by name."""
        return repr(self), self.as_dict()["parameters"].items()

    def _repr_html_(self) -> str:
        return html_table(*self.caption_and_parameters())

    def to_pandas(self) -> pd.DataFrame:
        """Data frame with a row for each parameter: value, u, unit, and for fits dof, k, U (extra: pandas).

        An unknown number is NaN.

        Raises
        ------
        NotInstalledError
            pandas is not installed.
        """
        rows = [{"parameter": name, **one} for name, one in self.caption_and_parameters()[1]]
        table = frame(rows).set_index("parameter")
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
