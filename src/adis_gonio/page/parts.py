"""What a page consists of: sections of words, figures and tables. Nothing here is HTML."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A plot with its caption.

    Attributes
    ----------
    svg : str
        Result of `adis_gonio.page.svg.plot`; put into the page as it is.
    caption : str
        Plain text.
    """

    svg: str
    caption: str = ""


@dataclass(frozen=True)
class KeyFigure:
    """A number that is read from across the bench, with its name above it.

    Attributes
    ----------
    name, value : str
        Such as `ΔK` and `0.0108 ± 0.0004`.
    note : str
        One line below it, in small print.
    """

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Table:
    """A table of texts; columns named in `numeric` are set to the right.

    Its first column names the rows. Two columns without a head are a list of names and their texts.

    Attributes
    ----------
    head : sequence of str
    rows : sequence of sequence of str
        As many cells as `head` has.
    caption : str
    numeric : collection of int
        Columns of numbers.
    strong : collection of int
        Rows to emphasise.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: tuple[int, ...] = ()
    strong: tuple[int, ...] = ()


@dataclass(frozen=True)
class Section:
    """A section; its parts stand in the order key figures, words, list, figures, tables, notes.

    Attributes
    ----------
    title : str
    words : sequence of str
        Paragraphs of plain text.
    points : sequence of str
        Items of a list.
    figures : sequence of Figure
        Side by side where there is room.
    tables : sequence of Table
    notes : sequence of str
        Small print.
    """

    title: str
    words: Sequence[str] = ()
    points: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    parts: Sequence[Section] = ()
    """Subsections."""
    key: Sequence[KeyFigure] = ()
    """The answer, in large numerals."""
    folded: bool = False
    """Closed on a screen until it is opened; on paper always open."""
