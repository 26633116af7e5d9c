"""The calibration report: one self-contained HTML page with inline SVG.

`build_page` makes the page, `plot` one figure; `Section`, `KeyFigure`, `Figure` and `Table` are what a page
consists of, so that other packages add sections without writing HTML.
"""

from __future__ import annotations

from adis_gonio.report.parts import Figure, KeyFigure, Section, Table
from adis_gonio.report.svg import Series, plot

__all__ = ["Figure", "KeyFigure", "Section", "Series", "Table", "plot"]
