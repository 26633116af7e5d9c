"""Tables of results as lines of plain text, as HTML for notebooks, and as data frames."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adis_gonio.base.errors import NotInstalledError, install_extra
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import format_uncertain

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]
Entries = Iterable[tuple[str, Row]]
"""Pairs of a parameter's name and its entry in a JSON document; a name may occur twice (two effects)."""


def align_columns(rows: Sequence[Sequence[str]], texts: int = 2) -> list[str]:
    """Format table rows, column headings first, as lines of plain text with aligned columns.

    The first `texts` columns are aligned to the left, the others to the right. Each line is indented by two
    blanks.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  "
        + "  ".join(
            cell.ljust(width) if k < texts else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def fold_text(text: str, width: int, indent: int = 0) -> list[str]:
    """Wrap text to lines of at most `width` columns, each indented by `indent` blanks."""
    margin = " " * indent
    return textwrap.wrap(text, width, initial_indent=margin, subsequent_indent=margin) or [""]


def lines_of(entries: Entries) -> list[str]:
    """Format the parameters of a JSON document as indented lines: name, value ± U and unit."""
    return [f"  {name}: {format_uncertain(one['value'], one['U'], one['unit'])}" for name, one in entries]


def html_table(title: str, entries: Entries) -> str:
    """Format the parameters of a JSON document as an HTML table with a title, for notebooks.

    All texts are escaped.
    """
    rows = [{"parameter": name, **one} for name, one in entries]
    columns = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    cells = [[row.get(name, "") for name in columns] for row in rows]
    texts = [[f"{one:.6g}" if isinstance(one, float) else str(one) for one in row] for row in cells]
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(one)}</td>" for one in row) + "</tr>" for row in texts
    )
    return (
        f"<table><caption>{html.escape(title)}</caption>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


class ParameterTable(JsonRecord):
    """Base class of results with parameters: notebooks show it as a table of the parameters."""

    def caption_and_parameters(self) -> tuple[str, Entries]:
        """Return the table's caption, and the parameters' names and entries, one for each row."""
        return repr(self), self.as_dict()["parameters"].items()

    def _repr_html_(self) -> str:
        return html_table(*self.caption_and_parameters())

    def to_pandas(self) -> pd.DataFrame:
        """Convert the parameters to a pandas data frame with one row for each (needs the extra `pandas`).

        The columns are value, u and unit, and for fits also dof, k and U.

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
    """Return a pandas data frame made from columns by name, or from a list of rows."""
    try:
        import pandas
    except ImportError:
        raise NotInstalledError(f"data frames need pandas: {install_extra('pandas')}") from None
    return pandas.DataFrame(columns)
