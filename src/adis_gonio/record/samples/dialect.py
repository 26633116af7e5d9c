"""How a file separates its cells and writes its fractions.

Cells are separated by what makes the header's names known. In a file separated by commas a fraction has a
point, as the format says. Elsewhere the numbers of the whole file have to prove it: `0,5` or `1234,5` can
only be a decimal comma and `1.2345` only a decimal point, while `1,234` may be either. A file without proof
is refused; a file that proves both is, too.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

SPACE = " "
"""Stands for runs of white space."""
DELIMITERS = ("\t", ";", ",", SPACE)
IN_WORDS = {"\t": "tab", ";": "semicolon", ",": "comma", SPACE: "space"}

# Possessive (++): digits are never tried again in another split, which takes hours in a cell of thousands.
_NUMBER = r"[+-]?(?:\d++{0}?\d*+|{0}\d+)(?:[eE][+-]?\d+)?"
_GROUPED = r"[+-]?[1-9]\d{{0,2}}(?:{1}\d{{3}})+(?:{0}\d*)?"
_FORMS = {
    mark: (
        re.compile(_NUMBER.format(re.escape(mark))),
        re.compile(_GROUPED.format(re.escape(mark), re.escape(other))),
    )
    for mark, other in ((".", ","), (",", "."))
}
_UNDECIDED = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
_TOKENS = re.compile(r"\s+(?![\[(])")


@dataclass(frozen=True)
class Dialect:
    """How a file writes its rows.

    Attributes
    ----------
    delimiter : str
        One of `DELIMITERS`.
    decimal : str
        Point or comma.
    grouped : bool
        True where it is proved, so that the other mark may stand between thousands.
    """

    delimiter: str = ","
    decimal: str = "."
    grouped: bool = False

    def cells(self, line: str) -> list[str]:
        """Cells of one line, without quotes.

        Raises
        ------
        ValueError
            A quote that does not end.
        """
        if self.delimiter == SPACE:
            return line.split()
        if '"' not in line:
            return line.split(self.delimiter)
        try:
            return next(csv.reader([line], delimiter=self.delimiter, strict=True, skipinitialspace=True))
        except (csv.Error, StopIteration):
            raise ValueError("a quotation mark does not end, or stands within a cell") from None

    def number(self, cell: str) -> float:
        """Number of a cell.

        Raises
        ------
        ValueError
            It is none in this dialect.
        """
        text = cell.strip().replace("−", "-")
        plain, grouped = _FORMS[self.decimal]
        if self.grouped and grouped.fullmatch(text):
            text = text.replace("," if self.decimal == "." else ".", "")
        elif not plain.fullmatch(text) and text.lower().lstrip("+-") not in ("nan", "inf", "infinity"):
            raise ValueError(text)
        return float(text.replace(",", "."))

    def with_decimal(self, mark: str, *, proved: bool) -> Dialect:
        """The same with the mark of its fractions."""
        return replace(self, decimal=mark, grouped=proved)


def header_cells(line: str, delimiter: str) -> list[str]:
    """Cells of a header; where white space separates, a unit in brackets stays with its name."""
    if delimiter == SPACE:
        return [cell.strip('"') for cell in _TOKENS.split(line.strip())]
    try:
        cells = [cell.strip() for cell in Dialect(delimiter).cells(line)]
    except ValueError:
        cells = [cell.strip().strip('"') for cell in line.split(delimiter)]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def proof_of(cells: Iterable[str]) -> tuple[str, int] | None:
    """The mark that a cell proves to be decimal, and which cell that is; None where none does."""
    for place, cell in enumerate(cells):
        text = cell.strip()
        if ("." not in text and "," not in text) or _UNDECIDED.fullmatch(text):
            continue
        for mark, other in ((".", ","), (",", ".")):
            plain, grouped = _FORMS[mark]
            if mark in text and plain.fullmatch(text):
                return mark, place
            # Two marks of a kind can only stand between thousands.
            if (mark in text or text.count(other) > 1) and grouped.fullmatch(text):
                return mark, place
    return None


def marks_in(cells: Sequence[str]) -> str:
    """Which of point and comma stand in the cells."""
    text = "\n".join(cells)
    return "".join(mark for mark in ".," if mark in text)
