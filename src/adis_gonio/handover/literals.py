"""Literals and comments of C."""

from __future__ import annotations

import numpy as np


def shift_text(text: str, bits: int, name: str) -> str:
    """A 64-bit expression divided by 2^bits and rounded, by the header's own function."""
    return f"{name}_shifted_({text}, {bits})"


def factor_text(factor: str) -> str:
    """A factor as C has it: a name, or the modulus of one."""
    if factor.startswith("|"):
        letter = factor.strip("|")
        return f"({letter} < 0 ? -{letter} : {letter})"
    return factor


def whole(number: int) -> str:
    """Literal of C; 32 bits in a long, else 64. A minus sign goes into brackets."""
    text = f"{abs(number)}{'L' if abs(number) < 2**31 else 'LL'}"
    return text if number >= 0 else f"(-{text})"


def single(value: float) -> str:
    """Literal of C that is read as this number in single precision: nine digits say it exactly."""
    text = f"{float(np.float32(value)):.9g}"
    text = f"{text}f" if any(mark in text for mark in ".e") else f"{text}.0f"
    return f"({text})" if text.startswith("-") else text


_ASCII = str.maketrans(
    {
        "²": "2",
        "³": "3",
        "°": "deg",
        "Δ": "d",
        "φ": "phi",
        "µ": "u",
        "±": "+-",
        "−": "-",
        "·": "*",
        "θ": "theta",
    }
)


def comment(text: str) -> str:
    """Text that ends no comment and holds ASCII alone, as old compilers want it."""
    plain = " ".join(text.translate(_ASCII).split(" ")).replace("*/", "* /").replace("/*", "/ *")
    return "".join(c if " " <= c < "\x7f" else "?" for c in plain).replace("??", "? ?").rstrip("\\")
