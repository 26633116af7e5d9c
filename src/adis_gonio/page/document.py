"""Sections, tables and figures, and the self-contained HTML document made of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from adis_gonio.base import __version__
from adis_gonio.base.numbers import NO_BREAK


@dataclass(frozen=True)
class Figure:
    """A plot with its caption.

    Attributes
    ----------
    svg : str
        Result of `adis_gonio.page.svg.plot`; inserted into the page unchanged.
    caption : str
        Plain text.
    """

    svg: str
    caption: str = ""


@dataclass(frozen=True)
class KeyFigure:
    """A result shown in large numerals, with its name above it.

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
    """A table of texts; columns listed in `numeric` are aligned to the right.

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
    """A section of a page; it shows key figures, words, list, figures, tables and notes in this order.

    Attributes
    ----------
    title : str
    words : sequence of str
        Paragraphs of plain text.
    points : sequence of str
        Items of a list.
    figures : sequence of Figure
        Figures, side by side if there is room.
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
    """Main results of the section, shown in large numerals."""
    sheet: bool = False
    """True if the section fills the first printed page; the other sections follow on further pages."""
    folded: bool = False
    """True if the section is closed on a screen until it is opened; on paper it is always open."""


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Control characters that a page must not contain: C0, C1, and changes of the writing direction."""


def render(
    kind: str,
    title: str,
    *,
    shape: str,
    sections: Sequence[Section],
    closing: str,
    simulated: bool = False,
    begun: str = "",
    software: str = f"adis-gonio {__version__}",
) -> str:
    """Return a complete HTML page that loads nothing; every text is escaped and printable.

    A kind of page is, for example, `Calibration report`.

    Parameters
    ----------
    shape : str
        Subject, in the line below the title.
    begun : str
        ISO time in UTC, or nothing.
    closing : str
        Last sentence of the page.
    """
    environment = Environment(
        loader=PackageLoader("adis_gonio.page", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Figures are drawings of this package with escaped texts.
    environment.filters |= {"drawing": Markup, "number_kept": _number_kept, "unit_kept": _unit_kept}
    page = environment.get_template("page.html").render(
        kind=kind,
        title=title,
        shape=shape,
        simulated=simulated,
        begun=begun,
        software=software,
        sections=[section for section in sections if _filled(section)],
        closing=closing,
    )
    return _CONTROL.sub("?", page)


def _filled(section: Section) -> bool:
    return any(part for name, part in vars(section).items() if name not in ("title", "folded", "sheet"))


def _number_kept(cell: str) -> str:
    """Text of a number with unbreakable spaces, so that a line may break only before its uncertainty."""
    return cell.replace(" ", NO_BREAK).replace(f"{NO_BREAK}±", " ±")


def _unit_kept(head: str) -> str:
    """Text of a column head with an unbreakable space between the slash and the unit."""
    return head.replace(" / ", f" /{NO_BREAK}")
