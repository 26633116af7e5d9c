"""Numbers with their nouns: one dwell, two dwells."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str = "") -> str:
    """`1 dwell`, `4 dwells`; a noun that takes more than an s brings its plural."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
