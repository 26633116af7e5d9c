"""Numbers large enough to be read from the stage: five rows of blocks, or ten."""

from __future__ import annotations

from adis_gonio.base.numbers import DASH, format_fixed

ROWS = 5

_GLYPHS = {
    "0": ("████", "█  █", "█  █", "█  █", "████"),
    "1": ("  █ ", " ██ ", "  █ ", "  █ ", " ███"),
    "2": ("████", "   █", "████", "█   ", "████"),
    "3": ("████", "   █", " ███", "   █", "████"),
    "4": ("█  █", "█  █", "████", "   █", "   █"),
    "5": ("████", "█   ", "████", "   █", "████"),
    "6": ("████", "█   ", "████", "█  █", "████"),
    "7": ("████", "   █", "  █ ", "  █ ", "  █ "),
    "8": ("████", "█  █", "████", "█  █", "████"),
    "9": ("████", "█  █", "████", "   █", "████"),
    "+": ("   ", " █ ", "███", " █ ", "   "),
    "−": ("   ", "   ", "███", "   ", "   "),
    ".": (" ", " ", " ", " ", "█"),
    "°": ("███", "█ █", "███", "   ", "   "),
    "–": ("    ", "    ", "████", "    ", "    "),
    " ": ("  ", "  ", "  ", "  ", "  "),
}


def large(text: str, scale: int = 1) -> list[str]:
    """Rows of a number; `scale` 2 is twice as wide and as high.

    Raises
    ------
    KeyError
        A character that is no part of a number.
    """
    rows = []
    for row in range(ROWS):
        thin = " ".join(_GLYPHS[character][row] for character in text)
        wide = "".join(character * scale for character in thin)
        rows += [wide] * scale
    return rows


def angle(value_deg: float | None) -> str:
    """An angle with its sign, to a hundredth; a dash for None."""
    return DASH if value_deg is None else f"{format_fixed(value_deg, 2, sign=True)}°"
