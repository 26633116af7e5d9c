"""Numbers as a person reads them: two digits of the uncertainty, real minus signs, units without "1"."""

from __future__ import annotations

import math

from adis_gonio.base.showing import shown_unit

SPACE = "\u00a0"
"""No line ends between a number and its unit."""
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float | None, digits: int = 3) -> str:
    """Value to some significant digits; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -5 < exponent < 6:
        return f"{value:.{max(0, digits - 1 - exponent)}f}".replace("-", "−")
    return f"{value / 10.0**exponent:.{digits - 1}f}·10{str(exponent).translate(_RAISED)}".replace("-", "−")


def uncertain(value: float, u: float | None) -> str:
    """Value ± standard uncertainty, both to two digits of the uncertainty."""
    if u is None or not math.isfinite(u) or u <= 0 or u < 1e-12 * abs(value):
        return number(value, 4)
    exponent = math.floor(math.log10(u))
    if exponent < -5:
        power = math.floor(math.log10(max(abs(value), u)))
        scaled, spread = value / 10.0**power, u / 10.0**power
        digits = max(0, 1 - math.floor(math.log10(spread)))
        text = f"{scaled:.{digits}f}{SPACE}±{SPACE}{spread:.{digits}f}".replace("-", "−")
        return f"({text})·10{str(power).translate(_RAISED)}"
    digits = max(0, 1 - exponent)
    return f"{value:.{digits}f}{SPACE}±{SPACE}{u:.{digits}f}".replace("-", "−")


def with_unit(text: str, unit: str) -> str:
    """Text with its unit; `1` is none, degrees are a sign."""
    if unit in ("", "1"):
        return text
    if unit in ("deg", "°"):
        return f"({text})°" if "±" in text else f"{text}°"
    return f"{text}{SPACE}{shown_unit(unit)}"


def p_text(p: float) -> str:
    """`p = 0.004`, or `p < 10⁻¹²` where digits mean nothing."""
    if p < 1e-12:
        return f"p{SPACE}<{SPACE}10⁻¹²"
    if p < 1e-3:
        return f"p{SPACE}<{SPACE}10{str(math.ceil(math.log10(p))).translate(_RAISED)}"
    return f"p{SPACE}={SPACE}{p:.2g}"


def percent(fraction: float) -> str:
    """Percentage that never claims a round 0 or 100 that is none."""
    if fraction >= 0.9995:
        return f">{SPACE}99.9{SPACE}%"
    if fraction < 0.0005:
        return f"<{SPACE}0.1{SPACE}%"
    digits = 1 if fraction >= 0.985 or fraction < 0.095 else 0
    return f"{100 * fraction:.{digits}f}{SPACE}%"


def times(before: float | None, after: float | None) -> str:
    """` (36 times less)`, nothing where that says nothing."""
    if before is None or after is None or after <= 0 or before < 1.15 * after:
        return ""
    ratio = before / after
    return f" ({ratio:.0f} times less)" if ratio >= 9.5 else f" ({ratio:.1f} times less)"


def listed(words: list[str]) -> str:
    """`a`, `a and b`, `a, b and c`."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
