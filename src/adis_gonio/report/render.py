"""Sections into one self-contained HTML document."""

from __future__ import annotations

from collections.abc import Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from adis_gonio.report.parts import Section


def render(
    kind: str,
    title: str,
    *,
    shape: str,
    simulated: bool,
    begun: str,
    software: str,
    sections: Sequence[Section],
    closing: str,
) -> str:
    """A page of a kind (`Calibration report`) that loads nothing; every text is escaped.

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
        loader=PackageLoader("adis_gonio.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Figures are the package's own drawings, whose texts are escaped already.
    environment.filters["drawing"] = Markup
    return environment.get_template("page.html").render(
        kind=kind,
        title=title,
        shape=shape,
        simulated=simulated,
        begun=begun,
        software=software,
        sections=[section for section in sections if _filled(section)],
        closing=closing,
    )


def _filled(section: Section) -> bool:
    return any(
        (section.words, section.points, section.figures, section.tables, section.notes, section.parts)
    )
