"""Values as tables of other programs: HTML of a notebook, a data frame."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

from adis_gonio.answer.wording import HEAD, Line
from adis_gonio.errors import NotInstalledError
from adis_gonio.estimation.values import Value, finite_or_none

if TYPE_CHECKING:
    from pandas import DataFrame


def html_table(title: str, values: Sequence[tuple[str, Value]]) -> str:
    """A plain table with a caption; everything escaped."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in HEAD)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in Line.of(name, value).cells) + "</tr>"
        for name, value in values
    )
    return f"<table><caption>{html.escape(title)}</caption><tr>{head}</tr>{body}</table>"


def data_frame(values: Sequence[tuple[str, Value]]) -> DataFrame:
    """One row a quantity: value, u, dof, k, U, unit.

    Raises
    ------
    NotInstalledError
        pandas is not installed (extra: pandas).
    """
    try:
        import pandas
    except ImportError:
        raise NotInstalledError("data frames need pandas: pip install 'adis-gonio[pandas]'") from None
    rows = {
        name: {
            "value": value.value,
            "u": value.u,
            "dof": finite_or_none(value.dof),
            "k": value.k,
            "U": value.U,
            "unit": value.unit,
        }
        for name, value in values
    }
    frame = pandas.DataFrame.from_dict(
        rows, orient="index", columns=["value", "u", "dof", "k", "U", "unit"]
    )
    return frame.astype(dict.fromkeys(("value", "u", "dof", "k", "U"), float))
