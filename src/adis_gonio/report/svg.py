"""Line and point plots as inline SVG, without any library.

Every series has a shape or a dash of its own besides its colour, so that a page printed in black and white
stays readable. Colours are CSS variables with a fallback: a page's style sheet adapts them to light and
dark, and an SVG that stands alone is drawn on a transparent ground by the fallback.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Style = Literal["points", "line", "steps"]
Role = Literal["before", "after", "third", "fourth", "model"]

ROLES: tuple[Role, ...] = ("before", "after", "third", "fourth")
_COLOURS: dict[str, str] = {
    "before": "#b8500c",
    "after": "#0b5cad",
    "third": "#2d7a2d",
    "fourth": "#8a3ffc",
    "model": "#6b6b6b",
}
_DASHES: dict[str, str] = {
    "before": "6 3",
    "after": "",
    "third": "2 3",
    "fourth": "9 3 2 3",
    "model": "4 3",
}
_MOST_MARKERS = 400
"""Up to so many points have markers with error bars; more are dots."""
_MOST_POINTS = 2000
_CHARACTER = 6.9
"""Mean width of a character at the size of the labels, in units of the drawing."""


@dataclass(frozen=True)
class Series:
    """Points or a line.

    Attributes
    ----------
    x, y : (n,) float
        Points that are not finite (or not positive on a logarithmic axis) are left out.
    label : str
        For the legend; without it the series is not in the legend.
    error : (n,) float, optional
        Half length of the error bars, in the unit of y.
    role : str, optional
        `before` (hollow circle), `after` (disc), `third` (square), `fourth` (triangle) or `model` (thin
        dashed line without legend's marker); by default in this order.
    style : {"points", "line", "steps"}
    """

    x: ArrayLike
    y: ArrayLike
    label: str = ""
    error: ArrayLike | None = None
    role: Role | None = None
    style: Style = "points"


@dataclass(frozen=True)
class _Axis:
    """One axis: from data to the drawing."""

    low: float
    high: float
    start: float
    end: float
    log: bool

    def __call__(self, value: float) -> float:
        low, high = (math.log10(self.low), math.log10(self.high)) if self.log else (self.low, self.high)
        at = math.log10(value) if self.log else value
        return self.start + (at - low) / (high - low) * (self.end - self.start)


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
    y_range: tuple[float, float] | None = None,
    zero: bool = False,
    width: int = 460,
    height: int = 300,
) -> str:
    """Plot as one `<svg>` element.

    Parameters
    ----------
    series : sequence of Series
    x_label, y_label : str
        With the unit, such as `residual of x / mg`.
    title, description : str
        What a screen reader says; they are not drawn (a page has captions).
    x_log, y_log : bool
        Logarithmic axes.
    x_ticks : mapping of float to str, optional
        Ticks by hand, such as `{-1: "from above", 1: "from below"}`.
    x_range, y_range : (float, float), optional
        Limits; by default from the data.
    zero : bool
        Draw the line y = 0 and let the axis hold it.
    width, height : int
        Size of the drawing; it scales with its place in the page.

    Returns
    -------
    str
        Safe to put into a page: all text is escaped.
    """
    drawn = [_clean(one, ROLES[k % len(ROLES)], x_log, y_log) for k, one in enumerate(series)]
    x_low, x_high = x_range or _limits([d.x for d in drawn], x_log, hold=tuple(x_ticks or ()))
    spread = [np.concatenate([d.y - d.error, d.y + d.error]) for d in drawn]
    if y_log:
        spread = [d.y for d in drawn]
    y_low, y_high = y_range or _limits(spread, y_log, hold=(0.0,) if zero and not y_log else ())
    legend = _legend(drawn, width)
    ticks_y = _ticks(y_low, y_high, y_log, 5)
    left = 26 + _CHARACTER * max((len(text) for _, text in ticks_y), default=1)
    top = 8 + 18 * len(legend)
    x_axis = _Axis(x_low, x_high, left, width - 12, x_log)
    y_axis = _Axis(y_low, y_high, height - 42, top + 4, y_log)
    if x_ticks is None:
        ticks_x = _ticks(x_low, x_high, x_log, 6)
    else:
        ticks_x = [(value, text) for value, text in x_ticks.items() if x_low <= value <= x_high]
    body = [_frame(x_axis, y_axis, ticks_x, ticks_y, x_label, y_label, height, zero=zero and not y_log)]
    body += [_row(row, k) for k, row in enumerate(legend)]
    body += [_drawing(one, x_axis, y_axis) for one in drawn]
    name = "f" + hashlib.sha256("".join((title, description, *body)).encode()).hexdigest()[:10]
    described = f'<desc id="{name}d">{escape(description)}</desc>' if description else ""
    labelled = f"{name}t {name}d" if description else f"{name}t"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="plot" viewBox="0 0 {width} {height}" role="img" '
        f'aria-labelledby="{labelled}" font-family="inherit" font-size="12" fill="currentColor">'
        f'<title id="{name}t">{escape(title)}</title>{described}{"".join(body)}</svg>'
    )


@dataclass(frozen=True)
class _Drawn:
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    error: NDArray[np.float64]
    label: str
    role: str
    style: Style

    @property
    def colour(self) -> str:
        return f"var(--{self.role}, {_COLOURS[self.role]})"


def _clean(one: Series, role: Role, x_log: bool, y_log: bool) -> _Drawn:
    x, y = np.asarray(one.x, dtype=float).ravel(), np.asarray(one.y, dtype=float).ravel()
    error = np.zeros(len(y)) if one.error is None else np.asarray(one.error, dtype=float).ravel()
    error = np.where(np.isfinite(error), error, 0.0)
    keep = np.isfinite(x) & np.isfinite(y)
    if x_log:
        keep &= x > 0
    if y_log:
        keep &= y > 0
    x, y, error = x[keep], y[keep], error[keep]
    if len(x) > _MOST_POINTS:
        index = np.linspace(0, len(x) - 1, _MOST_POINTS).astype(np.intp)
        x, y, error = x[index], y[index], error[index]
    return _Drawn(x, y, error, one.label, one.role or role, one.style)


def _limits(
    parts: Sequence[NDArray[np.float64]], log: bool, hold: tuple[float, ...] = ()
) -> tuple[float, float]:
    values = np.concatenate([*parts, np.array(hold, dtype=float)]) if parts or hold else np.zeros(0)
    if not values.size:
        return (0.1, 10.0) if log else (-1.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        if high / low < 10:
            middle = math.sqrt(low * high)
            low, high = min(low, middle / 3.2), max(high, middle * 3.2)
        return low / 1.15, high * 1.15
    if high - low <= 1e-12 * max(abs(low), abs(high)):
        margin = abs(high) * 0.1 or 1.0
    else:
        margin = 0.06 * (high - low)
    return low - margin, high + margin


def _ticks(low: float, high: float, log: bool, about: int) -> list[tuple[float, str]]:
    if log:
        low = max(low, 1e-12 * high, 1e-300)  # what is not above zero has no place on the scale
        high = max(high, 10 * low)
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
        mantissas = (1, 2, 5) if last - first <= 2 else (1,)
        step = max(1, math.ceil((last - first) / 8))
        values = [m * 10.0**e for e in range(first, last + 1, step) for m in mantissas]
        return [(v, _number(v)) for v in values if low <= v <= high]
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step_size = next(m * power for m in (1, 2, 5, 10) if m * power >= raw * 0.75)
    for degrees in (15.0, 30.0, 45.0, 60.0, 90.0):
        # A turn in degrees reads best in parts of a right angle.
        if 300 <= high - low <= 800 and step_size >= 50 and degrees * about >= (high - low) * 0.8:
            step_size = degrees
            break
    digits = max(0, -math.floor(math.log10(step_size) + 1e-9))
    first = math.ceil(low / step_size - 1e-9)
    last = math.floor(high / step_size + 1e-9)
    values = [k * step_size for k in range(first, last + 1)]
    if step_size >= 1e5 or digits > 7 or (digits > 4 and max(abs(low), abs(high)) < 1e-2):
        return [(v, _number(v)) for v in values]
    return [(v, f"{v + 0.0:.{digits}f}".replace("-", "−")) for v in values]


def _number(value: float) -> str:
    """Short number; powers of ten where digits would be many."""
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)) + 1e-12)
    if -4 < exponent < 5:
        return f"{value:.4g}".replace("-", "−")
    mantissa = value / 10.0**exponent
    power = "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return power if abs(mantissa - 1) < 1e-9 else f"{mantissa:.3g}·{power}".replace("-", "−")


def _legend(drawn: Sequence[_Drawn], width: int) -> list[list[tuple[_Drawn, float]]]:
    """Rows of (series, x)."""
    rows: list[list[tuple[_Drawn, float]]] = []
    at = float(width)
    for one in drawn:
        if not one.label:
            continue
        need = 34 + _CHARACTER * len(one.label)
        if at + need > width:
            rows.append([])
            at = 12.0
        rows[-1].append((one, at))
        at += need
    return rows


def _row(row: Sequence[tuple[_Drawn, float]], number: int) -> str:
    y = 14 + 18 * number
    out = []
    for one, x in row:
        if one.style == "points":
            out.append(_marker(one, x + 8, y - 4))
        else:
            out.append(f'<path d="M{x:.1f} {y - 4}h16" {_stroke(one)}/>')
        out.append(f'<text x="{x + 21:.1f}" y="{y}">{escape(one.label)}</text>')
    return "".join(out)


def _frame(
    x_axis: _Axis,
    y_axis: _Axis,
    ticks_x: Sequence[tuple[float, str]],
    ticks_y: Sequence[tuple[float, str]],
    x_label: str,
    y_label: str,
    height: int,
    zero: bool,
) -> str:
    left, right, bottom, top = x_axis.start, x_axis.end, y_axis.start, y_axis.end
    grid = "".join(
        [f"M{x_axis(v):.1f} {bottom:.1f}V{top:.1f}" for v, _ in ticks_x]
        + [f"M{left:.1f} {y_axis(v):.1f}H{right:.1f}" for v, _ in ticks_y]
    )
    out = [
        f'<path d="{grid}" fill="none" stroke="currentColor" stroke-opacity=".14"/>',
        f'<path d="M{left:.1f} {top:.1f}V{bottom:.1f}H{right:.1f}" fill="none" stroke="currentColor" '
        'stroke-opacity=".7"/>',
    ]
    if zero:
        out.append(
            f'<path d="M{left:.1f} {y_axis(0):.1f}H{right:.1f}" stroke="currentColor" '
            'stroke-opacity=".55"/>'
        )
    out += [
        f'<text x="{x_axis(v):.1f}" y="{bottom + 16:.1f}" text-anchor="middle">{escape(text)}</text>'
        for v, text in ticks_x
    ]
    out += [
        f'<text x="{left - 6:.1f}" y="{y_axis(v) + 4:.1f}" text-anchor="end">{escape(text)}</text>'
        for v, text in ticks_y
    ]
    middle = (top + bottom) / 2
    out.append(
        f'<text x="{(left + right) / 2:.1f}" y="{height - 7}" text-anchor="middle">{escape(x_label)}</text>'
    )
    out.append(
        f'<text transform="translate(13 {middle:.1f}) rotate(-90)" text-anchor="middle">'
        f"{escape(y_label)}</text>"
    )
    return "".join(out)


def _stroke(one: _Drawn) -> str:
    dash = f' stroke-dasharray="{_DASHES[one.role]}"' if _DASHES[one.role] else ""
    thick = 1.1 if one.role == "model" else 1.8
    # A style, not an attribute: attributes know no variables.
    return f'fill="none" style="stroke:{one.colour}" stroke-width="{thick}"{dash} stroke-linejoin="round"'


def _drawing(one: _Drawn, x_axis: _Axis, y_axis: _Axis) -> str:
    inside = (one.x >= x_axis.low) & (one.x <= x_axis.high) & (one.y >= y_axis.low) & (one.y <= y_axis.high)
    points = [
        (x_axis(float(x)), y_axis(float(y))) for x, y in zip(one.x[inside], one.y[inside], strict=True)
    ]
    if not points:
        return ""
    if one.style != "points":
        return f'<path d="{_path(points, one.style)}" {_stroke(one)}/>'
    if len(points) > _MOST_MARKERS:
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points)
        return (
            f'<path d="{dots}" style="stroke:{one.colour}" stroke-width="2" stroke-linecap="round" '
            'stroke-opacity=".55" fill="none"/>'
        )
    bars = []
    for (x, _), y, error in zip(points, one.y[inside], one.error[inside], strict=True):
        if error > 0:
            low, high = max(y - error, y_axis.low), min(y + error, y_axis.high)
            bars.append(f"M{x:.1f} {y_axis(float(low)):.1f}V{y_axis(float(high)):.1f}")
    out = f'<path d="{"".join(bars)}" style="stroke:{one.colour}" stroke-width="1.2"/>' if bars else ""
    return out + "".join(_marker(one, x, y) for x, y in points)


def _path(points: Sequence[tuple[float, float]], style: Style) -> str:
    if style == "line":
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    corners = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    corners += [f"H{x:.1f}V{y:.1f}" for x, y in points[1:]]
    return "".join(corners)


def _marker(one: _Drawn, x: float, y: float) -> str:
    return _MARKERS.get(one.role, _MARKERS["after"])(x, y, one.colour)


_MARKERS: dict[str, Callable[[float, float, str], str]] = {
    "before": lambda x, y, c: (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.6" style="stroke:{c};fill:var(--ground, none)" '
        'stroke-width="1.5"/>'
    ),
    "after": lambda x, y, c: f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" style="fill:{c}"/>',
    "third": lambda x, y, c: (
        f'<rect x="{x - 3:.1f}" y="{y - 3:.1f}" width="6" height="6" style="fill:{c}"/>'
    ),
    "fourth": lambda x, y, c: f'<path d="M{x:.1f} {y - 4:.1f}l4 7h-8z" style="fill:{c}"/>',
}
