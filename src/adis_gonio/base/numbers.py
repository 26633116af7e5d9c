"""Numbers as text for people: quantities with u and unit, percentages, p-values, durations, lists.

Text for people has the minus sign U+2212, and no-break spaces inside a quantity, so that no line ends
between a number and its unit. Numbers in files for programs (CSV, JSON, C) have the ASCII hyphen; other
modules write them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from adis_gonio.base.uncertainty import Value

NO_BREAK = "\u00a0"
"""No-break space: a line must not end here."""
DASH = "–"
"""Text for a missing value."""
UNKNOWN = "u unknown"
NAMES = {
    "delta_k": "ΔK",
    "delta_phi": "Δφ",
    "angle": "angle error, rms",
    "alpha": "α",
    "scale_x": "K_x",
    "scale_y": "K_y",
    "scale_z": "K_z",
}
"""Symbols of parameters in formulas, by the names of the parameters."""
HEAD = ("quantity", "unit", "value", "u", "U (95 %)", "k")
"""Column headings of a table with rows of `QuantityRow`."""


def format_number(value: float | None, digits: int = 3) -> str:
    """Format a value with a number of significant digits; None, NaN and infinity become a dash."""
    if value is None or not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -5 < exponent < 6:
        return use_minus(f"{value:.{max(0, digits - 1 - exponent)}f}")
    return use_minus(f"{value / 10.0**exponent:.{digits - 1}f}") + f"·{power_of_ten(exponent)}"


def format_fixed(value: float | None, decimals: int) -> str:
    """Format a value with a number of decimals; None, NaN and infinity become a dash."""
    if value is None or not math.isfinite(value):
        return DASH
    return use_minus(f"{value:z.{decimals}f}") if decimals <= 9 else format_number(value, 2)


def signed(value: float | None, decimals: int | None = None, *, digits: int = 0) -> str:
    """Format a value with its sign, `+1.50` or `−1.50`; None, NaN and infinity become a dash.

    Parameters
    ----------
    decimals : int or None
        Number of decimals; None to use `digits`.
    digits : int
        Number of significant digits if `decimals` is None; 0 for as many as needed, at most six.
    """
    if value is None or not math.isfinite(value):
        return DASH
    text = f"{value:.{digits or 6}g}"
    text = format_number(value, digits or 6) if "e" in text else text
    text = text if decimals is None else format_fixed(value, decimals)
    text = use_minus(text)
    return text if text.startswith("−") else f"+{text}"


def format_span(low: float, high: float, decimals: int, unit: str) -> str:
    """Format a range such as `24.4 to 24.9 °C`; a single value if both ends have the same text.

    Both ends have `decimals` decimals; the unit is stated once, at the end.
    """
    ends = dict.fromkeys(format_fixed(end, decimals) for end in (low, high))
    return f"{' to '.join(ends)}{NO_BREAK}{unit}"


def use_minus(text: str) -> str:
    """Replace the hyphen in a formatted number by the minus sign."""
    return text.replace("-", "−")


def count_decimals(u: float) -> int:
    """Return the number of decimals that show a standard uncertainty `u` with two significant digits."""
    return max(0, 1 - math.floor(math.log10(u))) if u > 0 else 6


def format_uncertain(value: float, expanded: float | None, unit: str = "", *, sign: bool = False) -> str:
    """Format value ± expanded uncertainty U with two digits of U, such as `1.08 ± 0.13 mg`.

    With `sign`, a positive value has a plus sign. If U is unknown (None, NaN), the text ends in
    `u unknown`; if U is zero, it is not shown.
    """
    if expanded is None or not math.isfinite(expanded):
        return f"{with_unit(format_number(value, 4), unit)}, {UNKNOWN}"
    if expanded <= 0 or expanded < 1e-12 * abs(value):
        return with_unit(format_number(value, 4), unit)
    power = 0
    if expanded < 1e-5:
        power = math.floor(math.log10(max(abs(value), expanded)))
        value, expanded = value / 10.0**power, expanded / 10.0**power
    decimals = count_decimals(expanded)
    value = round(value, decimals) + 0.0  # no minus sign before zero
    plus = "+" if sign else ""
    text = use_minus(f"{value:{plus}.{decimals}f}{NO_BREAK}±{NO_BREAK}{expanded:.{decimals}f}")
    return with_unit(f"({text})·{power_of_ten(power)}" if power else text, unit)


def format_unit(unit: str) -> str:
    """Format a unit from names and documents for people: deg as °, dps/g as °/s/g, 1 as nothing."""
    degrees = unit.replace("dps", "°/s").replace("degC", "°C").replace("deg", "°")
    return {"1": "", "us": "µs"}.get(unit, degrees)


def with_unit(text: str, unit: str) -> str:
    """Append a unit to text; the unit `1` adds nothing, and degrees become the sign °."""
    unit = "" if text == DASH else format_unit(unit)
    if unit == "°":
        return f"({text})°" if "±" in text else f"{text}°"
    return f"{text}{NO_BREAK}{unit}" if unit else text


def label_quantity(name: str, unit: str) -> str:
    """Return the heading of a table column: the quantity's symbol and its unit, such as `Δφ / °`."""
    unit = format_unit(unit)
    return NAMES.get(name, name) + (f" / {unit}" if unit else "")


def format_p(p: float) -> str:
    """Format a p-value: `p = 0.004`, or `p < 10⁻¹²` for smaller values."""
    if p < 1e-12:
        return f"p{NO_BREAK}<{NO_BREAK}10⁻¹²"
    if p < 1e-3:
        return f"p{NO_BREAK}<{NO_BREAK}{power_of_ten(math.ceil(math.log10(p)))}"
    return f"p{NO_BREAK}={NO_BREAK}{p:.2g}"


def format_percent(fraction: float) -> str:
    """Format a fraction (0 to 1) as a percentage; near the ends as `> 99.9 %` or `< 0.1 %`."""
    if fraction >= 0.9995:
        return f">{NO_BREAK}99.9{NO_BREAK}%"
    if fraction < 0.0005:
        return f"<{NO_BREAK}0.1{NO_BREAK}%"
    decimals = 1 if fraction >= 0.985 or fraction < 0.095 else 0
    return f"{100 * fraction:.{decimals}f}{NO_BREAK}%"


def format_reduction(before: float | None, after: float | None) -> str:
    """Format a reduction from `before` to `after`, such as ` (36 times less)`.

    The text is empty if the reduction is less than 15 % or a value is None.
    """
    if before is None or after is None or after <= 0 or before < 1.15 * after:
        return ""
    ratio = before / after
    return f" ({ratio:.0f} times less)" if ratio >= 9.5 else f" ({ratio:.1f} times less)"


def format_duration(seconds: float) -> str:
    """Format a duration such as `40 s`, `1 min 30 s` or `1 h 05 min`; no seconds from ten minutes on."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes >= 10:
        hours, minutes = divmod(round(seconds / 60), 60)
        return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min"
    return " ".join([f"{minutes} min"] * (minutes > 0) + [f"{rest} s"] * (rest > 0 or minutes == 0))


def counted(number: int, noun: str, plural: str = "") -> str:
    """Format a number with its noun, such as `1 dwell` or `4 dwells`; `plural` is for irregular nouns."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def name_positions(positions: Sequence[int], most: int = 8) -> str:
    """Format position numbers: `position 7`, or `positions 3, 4, 9 and 2 more` if more than `most`."""
    more = f" and {len(positions) - most} more" if len(positions) > most else ""
    return f"position{'' if len(positions) == 1 else 's'} {', '.join(map(str, positions[:most]))}{more}"


def format_ranges(numbers: Sequence[int]) -> str:
    """Format integers as a list such as `1–4, 7, 9, 10`: three or more successive ones form a range."""
    rows: list[list[int]] = []
    for number in sorted(set(numbers)):
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    return ", ".join(f"{row[0]}–{row[-1]}" if len(row) > 2 else ", ".join(map(str, row)) for row in rows)


def join_words(words: Sequence[str], last: str = "and", comma: str = ", ") -> str:
    """Join words to an enumeration: `a`, `a and b`, or `a, b and c`; `last` replaces `and`."""
    return f" {last} ".join(filter(None, [comma.join(words[:-1]), *words[-1:]]))


class QuantityRow(NamedTuple):
    """Table row of one quantity: a text for each column of `HEAD`.

    Attributes
    ----------
    name, unit, value : str
        Name of the quantity, its unit and its value.
    u : str
        Standard uncertainty, or `u unknown`.
    expanded : str
        Expanded uncertainty U (95 %); a dash if unknown.
    k : str
        Coverage factor; a dash if unknown.
    """

    name: str
    unit: str
    value: str
    u: str
    expanded: str
    k: str

    @classmethod
    def of(cls, name: str, value: Value) -> QuantityRow:
        """Format a quantity as a row; value, u and U have so many decimals that u has two digits.

        Without an uncertainty, u is the text `u unknown`. `name` is the parameter's name.
        """
        shown, unit = NAMES.get(name, name), format_unit(value.unit)
        if value.u is None or value.U is None or value.k is None:
            return cls(shown, unit, format_number(value.value, 6), UNKNOWN, DASH, DASH)
        decimals = count_decimals(value.u)
        value_, u, expanded = (format_fixed(each, decimals) for each in (value.value, value.u, value.U))
        return cls(shown, unit, value_, u, expanded, f"{value.k:.2f}")


def power_of_ten(exponent: int) -> str:
    """Format a power of ten, such as `10⁻⁶`."""
    return f"10{str(exponent).translate(str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹'))}"
