"""A page of a result: sections, tables and plots in one HTML document that loads nothing.

Plots of lines and points are inline SVG, drawn by matplotlib. Every series has its own shape or dash in
addition to its colour, so that a page printed in black and white is readable. Colours are CSS variables
with a fallback: the style sheet of a page adapts them to light and dark; a separate SVG uses the fallback
on a transparent ground. Labels are text in the SVG, not outlines. A plot of the same data has the same
bytes on every computer, independent of the user's matplotlibrc.

Matplotlib writes a complete file: its ids clash with the ids of the next figure, its style sheet would
apply to the whole page, and its black does not follow a dark page.
`inline_svg` makes an element of a page from it.

Matplotlib is installed with the extra `report`, and is imported when the first plot is drawn.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from adis_gonio.base import __version__
from adis_gonio.base.errors import NotInstalledError, install_extra
from adis_gonio.base.numbers import NO_BREAK, format_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing
    from matplotlib.lines import Line2D

_NAMESPACE = re.compile(r"\{[^}]*\}")


def inline_svg(drawing: str, colours: Mapping[str, str], *, title: str, description: str = "") -> str:
    """Convert an SVG file of matplotlib to one `<svg>` element for a page.

    Parameters
    ----------
    drawing : str
        Text of the file, written with `svg.fonttype: none` and a fixed `svg.hashsalt`.
    colours : mapping of str to str
        Replacements for the colours of the file, such as `{"#000000": "currentColor"}`.
    title, description : str
        Text for screen readers.

    Returns
    -------
    str
        The element. All text is escaped, coordinates are rounded to a tenth, and every id begins with a
        hash of the content.
    """
    root = ET.fromstring(drawing)
    box = root.get("viewBox", "")
    root.attrib.clear()
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        element.text = element.text if element.tag == "text" else None
        element.tail = None
        _attributes(element, colours)
        for child in list(element):
            if child.tag.endswith(("metadata", "style")):
                element.remove(child)
    name = "f" + hashlib.sha256(ET.tostring(root) + f"{title}\0{description}".encode()).hexdigest()[:10]
    # Two figures of a page must not share an id.
    for element in root.iter():
        if "id" in element.attrib:
            element.set("id", f"{name}{element.attrib['id']}")
        if "href" in element.attrib:
            element.set("href", f"#{name}{element.attrib['href'][1:]}")
    root.attrib = {
        "xmlns": "http://www.w3.org/2000/svg",
        "class": "plot",
        "viewBox": box,
        "role": "img",
        "aria-labelledby": f"{name}t {name}d" if description else f"{name}t",
        "font-family": "inherit",
        "font-size": "12",
        "fill": "currentColor",
        "stroke-linejoin": "round",
    }
    for tag, text in (("desc", description), ("title", title)):
        if text:
            said = ET.Element(tag, {"id": f"{name}{tag[0]}"})
            said.text = text
            root.insert(0, said)
    return ET.tostring(root, encoding="unicode")


def _attributes(element: ET.Element, colours: Mapping[str, str]) -> None:
    """Replace colours and other attributes of an SVG element so that they suit a page."""
    given = {_NAMESPACE.sub("", key): value for key, value in element.attrib.items()}
    if element.tag == "g":
        given.pop("id", None)
    for key in {"d", "x", "y", "transform"} & given.keys():
        text = " ".join(given[key].split())
        given[key] = re.sub(
            r"-?\d+\.\d+", lambda found: f"{float(found[0]) + 0.0:.1f}".removesuffix(".0"), text
        )
    if "d" in given:
        letters_alone = re.sub(r" ?([A-Za-z]) ?", r"\1", given["d"])
        given["d"] = re.sub(r"M([^A-Z]+)L\1(?=M|$)", r"M\1h0", letters_alone)
    if "style" in given:
        rules = dict(rule.strip().split(": ", 1) for rule in given["style"].split(";") if rule.strip())
        if element.tag == "text":  # size and family are the page's
            rules = {key: value for key, value in rules.items() if not key.startswith("font")}
        given["style"] = ";".join(f"{key}:{colours.get(value, value)}" for key, value in rules.items())
    element.attrib = given


Style = Literal["points", "line", "steps"]
Role = Literal["before", "after", "third", "fourth", "model"]
Points = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

ROLES: tuple[Role, ...] = ("before", "after", "third", "fourth")
_GROUND = "#fefefe"
_LOOKS: dict[Role, tuple[str, Any, str, float]] = {
    "before": ("#b8500c", (0, (3.5, 1.7)), "o", 7.2),
    "after": ("#0b5cad", "-", "o", 6.4),
    "third": ("#2d7a2d", (0, (1.1, 1.7)), "s", 6.0),
    "fourth": ("#8a3ffc", (0, (5, 1.7, 1.1, 1.7)), "^", 7.5),
    "model": ("#6b6b6b", (0, (3.5, 2.7)), "o", 4.0),
}
"""Colour, style of a line, marker, and size of the marker in points of each role."""
_MOST_MARKERS = 400
"""Largest number of points of a series with markers and error bars; more points are drawn as dots."""
_MOST_POINTS = 2000
_CHARACTER = 6.9
"""Mean width of a character of a label, in points of the drawing."""
_DIGIT = 8.0
"""Width of the widest digit or sign of a tick, in points of the drawing."""
_SETTINGS: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "adis-gonio",
    "text.parse_math": False,
    "path.simplify": False,
    "font.size": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-5, 6),
    "axes.xmargin": 0.06,
    "axes.ymargin": 0.06,
}


@dataclass(frozen=True)
class Series:
    """A series of points or a line in a plot.

    Attributes
    ----------
    x, y : (n,) float
        Coordinates. Points that are not finite (or not positive on a logarithmic axis) are left out.
    label : str
        Name in the legend; without it the series is not in the legend.
    error : (n,) float, optional
        Half length of the error bars, in the unit of y; with a line, half width of a band around it.
    role : str, optional
        `before` (hollow circle), `after` (disc), `third` (square), `fourth` (triangle) or `model` (thin
        dashed line). Series without a role take these roles one after another.
    style : {"points", "line", "steps"}
        Markers, a line through the points, or a line in steps.
    """

    x: ArrayLike
    y: ArrayLike
    label: str = ""
    error: ArrayLike | None = None
    role: Role | None = None
    style: Style = "points"


def require_matplotlib() -> None:
    """Check that matplotlib is installed, before the data for plots are computed.

    Raises
    ------
    NotInstalledError
        Matplotlib cannot be imported.
    """
    try:
        importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise NotInstalledError(
            f"the figures of a report need {error.name or error}: {install_extra('report')}"
        ) from error


def plot(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    title: str,
    description: str = "",
    x_log: bool = False,
    y_log: bool = False,
    x_ticks: Mapping[float, str] | None = None,
    x_range: tuple[float, float] | None = None,
    zero: bool = False,
    width: int = 400,
    height: int = 265,
) -> str:
    """Draw a plot and return it as one `<svg>` element.

    Parameters
    ----------
    series : sequence of Series
        Data to draw.
    x_label, y_label : str
        Names of the axes with the unit, such as `residual of x / mg`.
    title, description : str
        Text for screen readers; not drawn (a page has captions).
    x_log, y_log : bool
        True for a logarithmic axis.
    x_ticks : mapping of float to str, optional
        Positions and texts of the ticks, such as `{-1: "from above", 1: "from below"}`; by default from the
        data.
    x_range : (float, float), optional
        Limits of the x axis; by default from the data. Points outside are left out.
    zero : bool
        True to draw the line y = 0 and include it in the axis.
    width, height : int
        Size of the drawing in points; it scales with the page.

    Returns
    -------
    str
        The element, safe to put into a page: all text is escaped, every id begins with a hash.

    Raises
    ------
    NotInstalledError
        Matplotlib is not installed.
    """
    require_matplotlib()
    import matplotlib as mpl
    from matplotlib.figure import Figure as Drawing

    drawing = io.StringIO()
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_SETTINGS)
        figure = Drawing(figsize=(width / 72, height / 72))
        axes = figure.add_subplot()
        axes.set(xscale="log" if x_log else "linear", yscale="log" if y_log else "linear")
        axes.set(xlabel=x_label, ylabel=y_label)
        if zero:
            axes.axhline(0, color="black", alpha=0.55, linewidth=1, clip_on=False)
        lines = [
            _draw(axes, one, _clean(one, x_log, y_log, x_range), one.role or ROLES[k % len(ROLES)])
            for k, one in enumerate(series)
        ]
        _scale(axes, x_range, x_ticks)
        rows = _legend(figure, [line for one, line in zip(series, lines, strict=True) if one.label], width)
        _fit_margins(figure, axes, rows)
        axes.grid(color="black", alpha=0.14, linewidth=1, clip_on=False)
        axes.spines[["left", "bottom"]].set(alpha=0.7, linewidth=1)
        axes.tick_params(length=0, pad=6)
        figure.savefig(drawing, format="svg", transparent=True)
    colours = {colour: f"var(--{role}, {colour})" for role, (colour, *_) in _LOOKS.items()}
    colours |= {"#000000": "currentColor", _GROUND: "var(--ground, none)"}
    return inline_svg(drawing.getvalue(), colours, title=title, description=description)


def _clean(one: Series, x_log: bool, y_log: bool, x_range: tuple[float, float] | None) -> Points:
    """Return the points of a series that can be drawn: x, y and error, each (n,).

    They are finite, within `x_range` (None: no limit), and positive on an axis that is logarithmic
    (`x_log`, `y_log`).
    """
    x, y = np.asarray(one.x, dtype=float).ravel(), np.asarray(one.y, dtype=float).ravel()
    error = np.zeros(len(y)) if one.error is None else np.asarray(one.error, dtype=float).ravel()
    low, high = x_range or (-math.inf, math.inf)
    keep = np.isfinite(x) & np.isfinite(y) & (x >= low) & (x <= high)
    keep &= ((x > 0) | (not x_log)) & ((y > 0) | (not y_log))
    index = np.flatnonzero(keep)
    if len(index) > _MOST_POINTS:
        index = index[np.linspace(0, len(index) - 1, _MOST_POINTS).astype(np.intp)]
    return x[index], y[index], np.where(np.isfinite(error), error, 0.0)[index]


def _draw(axes: Axes, one: Series, points: Points, role: Role) -> Line2D:
    """Draw a series into the axes; return the line that represents it in the legend."""
    x, y, error = points
    colour, dashes, marker, size = _LOOKS[role]
    alike: dict[str, Any] = {"color": colour, "clip_on": False}
    if one.style != "points":
        stepped = "steps-post" if one.style == "steps" else "default"
        if error.any():
            band = np.concatenate([y - error, (y + error)[::-1]])
            axes.fill(np.concatenate([x, x[::-1]]), band, alpha=0.22, linewidth=0, **alike)
        alike |= {"linestyle": dashes, "linewidth": 1.1 if role == "model" else 1.8}
        return axes.plot(x, y, label=one.label, drawstyle=stepped, **alike)[0]
    shape: dict[str, Any] = {"marker": marker, "markersize": size, "markeredgewidth": 0}
    if role == "before":  # a hollow circle
        shape |= {"markerfacecolor": _GROUND, "markeredgewidth": 1.5}
    marked: dict[str, Any] = {"label": one.label, "linestyle": "none", **shape, **alike}
    if len(x) > _MOST_MARKERS:
        # Strokes without length in one path take a third of the bytes of markers.
        dots: dict[str, Any] = {"alpha": 0.55, "linewidth": 2, "solid_capstyle": "round"}
        axes.plot(*_upright(x, y, y), **dots, **alike)
        return axes.plot([], [], **marked)[0]
    bars = error > 0
    low, high = (y - error)[bars], (y + error)[bars]
    if axes.get_yscale() == "log":
        low = np.maximum(low, y[bars] / 10)
    axes.plot(*_upright(x[bars], low, high), linewidth=1.2, solid_capstyle="butt", **alike)
    return axes.plot(x, y, **marked)[0]


def _upright(
    x: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return vertical strokes at x from `low` to `high`, all (n,), joined to one line with gaps, (3n,)."""
    gap = np.full(len(x), np.nan)
    return np.stack([x, x, gap], axis=1).ravel(), np.stack([low, high, gap], axis=1).ravel()


def _scale(axes: Axes, x_range: tuple[float, float] | None, x_ticks: Mapping[float, str] | None) -> None:
    """Set the limits and the ticks of both axes; None leaves them to the data."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    if x_range is not None:
        axes.set_xlim(*x_range)
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        if axis.get_scale() == "log":
            middle = math.sqrt(low * high)
            axis.set_view_interval(middle / 3.2, middle * 3.2)  # only widens the axis
            axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 300 * low else (1,), numticks=8))
            axis.set_major_formatter(FuncFormatter(lambda value, _: format_number(value, 1)))
            axis.set_minor_locator(NullLocator())
    if x_ticks is not None:
        axes.set_xticks(list(x_ticks), list(x_ticks.values()))


def _legend(figure: Drawing, lines: Sequence[Line2D], width: int) -> int:
    """Add a legend above the axes, with as many columns as fit into the width; return its rows."""
    if not lines:
        return 0
    column = 34 + _CHARACTER * max(len(str(line.get_label())) for line in lines)
    columns = max(1, min(len(lines), int(width // column)))
    figure.legend(
        handles=list(lines),
        loc="upper left",
        ncols=columns,
        frameon=False,
        borderpad=0,
        borderaxespad=0.2,
        handlelength=1.6,
        handletextpad=0.5,
        columnspacing=1.2,
    )
    return math.ceil(len(lines) / columns)


def _fit_margins(figure: Drawing, axes: Axes, rows: int) -> None:
    """Leave space around the axes for the labels and for the rows of the legend.

    Matplotlib's layout engines measure all text three times, which takes longer than the drawing.
    """
    x, y = (
        max(map(len, axis.get_major_formatter().format_ticks(list(axis.get_majorticklocs()))), default=0)
        for axis in (axes.xaxis, axes.yaxis)
    )
    width, height = 72 * figure.get_size_inches()
    half = _CHARACTER * x / 2  # of the longest label of x, in case it is the first or the last
    factor = bool(axes.yaxis.get_major_formatter().get_offset())  # a power of ten above the axis
    left, below, above = max(32 + _DIGIT * y, half), 40, 8 + 17 * rows + 10 * factor
    figure.subplots_adjust(left / width, below / height, 1 - (4 + half) / width, 1 - above / height)


@dataclass(frozen=True)
class Figure:
    """A plot with its caption.

    Attributes
    ----------
    svg : str
        Result of `adis_gonio.page.document.plot`; inserted into the page unchanged.
    caption : str
        Plain text below the plot.
    """

    svg: str
    caption: str = ""


@dataclass(frozen=True)
class KeyFigure:
    """A result shown in large numerals, with its name above it.

    Attributes
    ----------
    name, value : str
        Texts such as `ΔK` and `0.0108 ± 0.0004`.
    note : str
        One line of small print below the value.
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
        Names of the columns.
    rows : sequence of sequence of str
        Cells of each row; `ValueError` is raised unless they are as many as in `head`.
    caption : str
        Plain text for the table.
    numeric : collection of int
        Numbers (from 0) of the columns that hold numbers.
    strong : collection of int
        Numbers (from 0) of the rows to emphasise.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    numeric: tuple[int, ...] = ()
    strong: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.head):
                raise ValueError(f"table of {len(self.head)} heads, but {len(row)} cells in a row: {row}")


@dataclass(frozen=True)
class Section:
    """A section of a page; it shows key figures, words, list, figures, tables and notes in this order.

    Tables without rows and subsections without contents are left out.

    Attributes
    ----------
    title : str
        Heading of the section.
    words : sequence of str
        Paragraphs of plain text.
    points : sequence of str
        Items of a list.
    figures : sequence of Figure
        Figures, side by side if there is room.
    tables : sequence of Table
        Tables, one below the other.
    notes : sequence of str
        Sentences in small print.
    """

    title: str
    words: Sequence[str] = ()
    points: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    parts: Sequence[Section] = ()
    """Subsections of the section."""
    key: Sequence[KeyFigure] = ()
    """Main results of the section, shown in large numerals."""
    sheet: bool = False
    """True if the section fills the first printed page; the other sections follow on further pages."""
    folded: bool = False
    """True if the section is closed on a screen until it is opened; on paper it is always open."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "tables", [table for table in self.tables if table.rows])
        object.__setattr__(self, "parts", [part for part in self.parts if part.filled])

    @property
    def filled(self) -> bool:
        """True if the section has contents in addition to its title."""
        return any((self.words, self.points, self.figures, self.tables, self.notes, self.parts, self.key))


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

    The kind of page, `kind`, is for example `Calibration report`.

    Parameters
    ----------
    shape : str
        Text in the line below the title, which states the subject of the page.
    begun : str
        Start of the session as ISO time in UTC; empty if unknown.
    sections : sequence of Section
        Contents of the page; sections without contents are left out.
    closing : str
        Last sentence of the page.
    simulated : bool
        True to mark the page as the result of a simulation.
    software : str
        Name and version of the program.
    """
    environment = Environment(
        loader=PackageLoader("adis_gonio.page", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Figures are drawings of this package with escaped texts.
    environment.filters |= {"drawing": Markup}
    # Numbers and units keep together; a line may break only before an uncertainty.
    environment.filters["number_kept"] = lambda cell: cell.replace(" ", NO_BREAK).replace(
        f"{NO_BREAK}±", " ±"
    )
    environment.filters["unit_kept"] = lambda head: head.replace(" / ", f" /{NO_BREAK}")
    page = environment.get_template("page.html").render(
        kind=kind,
        title=title,
        shape=shape,
        simulated=simulated,
        begun=begun,
        software=software,
        sections=[section for section in sections if section.filled],
        closing=closing,
    )
    return _CONTROL.sub("?", page)
