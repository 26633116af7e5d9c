"""Sections into one self-contained HTML document."""

from __future__ import annotations

import re
from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from adis_gonio.base.numbers import NO_BREAK
from adis_gonio.base.version import __version__
from adis_gonio.page.parts import Section

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")
"""Characters of control that have no place in a page: C0, C1, and those that turn the sense of writing."""


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
    """A page of a kind (`Calibration report`) that loads nothing; every text is escaped and printable.

    Parameters
    ----------
    shape : str
        What it is about, in the line below the title.
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
    # Figures are the package's own drawings, whose texts are escaped already.
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
    return any(
        (
            section.key,
            section.words,
            section.points,
            section.figures,
            section.tables,
            section.notes,
            section.parts,
        )
    )


def _number_kept(cell: str) -> str:
    """A number's text, which a narrow column may break before its uncertainty only."""
    return cell.replace(" ", NO_BREAK).replace(f"{NO_BREAK}±", " ±")


def _unit_kept(head: str) -> str:
    """A column's head, never broken between slash and unit."""
    return head.replace(" / ", f" /{NO_BREAK}")
