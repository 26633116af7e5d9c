"""Numbers with their nouns: one dwell, two dwells; and many numbers in few words."""

from __future__ import annotations

from collections.abc import Sequence


def counted(number: int, noun: str, plural: str = "") -> str:
    """`1 dwell`, `4 dwells`; a noun that takes more than an s brings its plural."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def runs(numbers: Sequence[int]) -> str:
    """Numbers with neighbours together, such as `1–4, 7, 9, 10`."""
    rows: list[list[int]] = []
    for number in sorted(set(numbers)):
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    told = [[f"{row[0]}–{row[-1]}"] if len(row) > 2 else [str(number) for number in row] for row in rows]
    return ", ".join(text for texts in told for text in texts)
