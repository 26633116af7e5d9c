"""A file's bytes as numbered lines of text, and its lines as cells and numbers.

Text is UTF-8, with or without a byte order mark, or UTF-16, as Excel's "Unicode text" has it. A byte that
is no UTF-8 is read as Windows-1252, where the degree sign and the superscript two of older programs stand:
digits are the same in both.

Cells are separated by what makes the header's names known. In a file separated by commas a fraction has a
point, as the format says. Elsewhere the numbers of the whole file have to prove it: `0,5` or `1234,5` can
only be a decimal comma and `1.2345` only a decimal point, while `1,234` may be either. A file without proof
is refused; a file that proves both is, too.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, cast

from adis_gonio.base.errors import DataError

CHUNK = 1 << 20
"""Bytes that are read at a time: what stands in memory as text is some twenty times that."""

_FOREIGN = {
    b"PK\x03\x04": "an Excel or LibreOffice workbook (or a zip): save the sheet as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel workbook: save the sheet as CSV",
    b"PAR1": "a Parquet file: write it as CSV",
    b"\x89HDF": "an HDF5 file: write it as CSV",
    b"%PDF": "a PDF file: take the file that it was printed from",
}
_HTML = re.compile(
    rb"(?>\xef\xbb\xbf|\s|<!--.*?-->|<\?xml.*?\?>)*+<(?:!doctype\s+html|html|head|body)\b",
    re.IGNORECASE | re.DOTALL,
)
"""The first tag of a page, after comments and an XML declaration."""
LONGEST_LINE = 1 << 16
"""Characters: rows have hundreds; a file without line ends would fill the memory."""
MOST_GROWTH, SMALL = 200, 1 << 24
"""Unpacked bytes for each byte of a gzip file, and unpacked bytes that are always allowed.

Samples pack to a tenth or a thirtieth of their size, equal rows to a thousandth.
"""
_REPLACEMENT = "�"


def _as_windows_1252(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeDecodeError):
        raise error
    rest = error.object[error.start : error.end]
    return rest.decode("cp1252", errors="replace"), error.end


codecs.register_error("adis_gonio.windows-1252", _as_windows_1252)


@dataclass(frozen=True)
class Chunk:
    """Neighbouring lines.

    Attributes
    ----------
    first : int
        Number of the first line, counted from 1.
    lines : list of str
        Without their ends.
    share : float
        Part of the file that has been read, 0 to 1.
    last : bool
    cut : bool
        True in the last chunk where the last line has no end.
    """

    first: int
    lines: list[str]
    share: float
    last: bool = False
    cut: bool = False


def chunks_of(path: Path) -> Iterator[Chunk]:
    """Lines of a file, chunk by chunk.

    Raises
    ------
    DataError
        Not readable, damaged gzip, empty, binary or another kind of file.
    """
    first, carry = 1, ""
    for text, share in _texts(path):
        # A carriage return at the end may be one half of a line's end.
        text = carry + text
        held = len(text) - len(text.rstrip("\r"))
        *lines, carry = _plain_ends(text[: len(text) - held]).split("\n")
        carry += "\r" * held
        _refuse_long(path, first, [*lines, carry])
        if lines:
            yield Chunk(first, lines, share)
            first += len(lines)
    *lines, rest = _plain_ends(carry).split("\n")
    _refuse_long(path, first, [*lines, rest])
    yield Chunk(first, [*lines, rest] if rest else lines, 1.0, last=True, cut=bool(rest))


def _refuse_long(path: Path, first: int, lines: list[str]) -> None:
    if max(map(len, lines)) > LONGEST_LINE:
        row = first + next(k for k, line in enumerate(lines) if len(line) > LONGEST_LINE)
        raise DataError(
            f"{path.name}, row {row}: has more than {LONGEST_LINE} characters; not a samples CSV"
        )


def _plain_ends(text: str) -> str:
    if "\r" not in text:
        return text
    # Text that was opened twice for translation ends its lines with two carriage returns.
    return text.replace("\r\r\n", "\n").replace("\r\n", "\n").replace("\r", "\n")


def _texts(path: Path) -> Iterator[tuple[str, float]]:
    try:
        with path.open("rb") as raw:
            size = max(path.stat().st_size, 1)
            zipped = raw.read(2) == b"\x1f\x8b"
            raw.seek(0)
            yield from _decoded(
                path, cast("IO[bytes]", gzip.GzipFile(fileobj=raw)) if zipped else raw, raw, size
            )
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise DataError(f"{path.name}: damaged or truncated gzip file ({error}); copy it again") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def _decoded(path: Path, file: IO[bytes], raw: IO[bytes], size: int) -> Iterator[tuple[str, float]]:
    data = file.read(CHUNK)
    for magic, kind in _FOREIGN.items():
        if data.startswith(magic):
            raise DataError(f"{path.name}: not a samples CSV: it is {kind}")
    if _HTML.match(data):
        raise DataError(
            f"{path.name}: not a samples CSV: it is an HTML page; download the file itself, not the page "
            "that shows it"
        )
    decoder = codecs.getincrementaldecoder(_encoding(data))("adis_gonio.windows-1252")
    blank, unpacked = True, 0
    while data:
        unpacked += len(data)
        if unpacked > MOST_GROWTH * raw.tell() + SMALL:
            raise DataError(
                f"{path.name}: not a samples CSV: it unpacks to more than {MOST_GROWTH} times its size, as "
                "equal rows do; unpack it first if these are samples"
            )
        text = decoder.decode(data)
        _refuse_binary(path, text)
        blank = blank and not text.strip()
        yield text, min(raw.tell() / size, 1.0)
        data = file.read(CHUNK)
    yield decoder.decode(b"", final=True), 1.0
    if blank:
        raise DataError(f"{path.name}: the file is empty")


def _encoding(head: bytes) -> str:
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    # ASCII as UTF-16 without a mark: every second byte is zero.
    for place, name in ((1, "utf-16-le"), (0, "utf-16-be")):
        if len(head) >= 4 and not any(head[place:200:2]) and all(head[1 - place : 200 : 2]):
            return name
    return "utf-8-sig"


def _refuse_binary(path: Path, text: str) -> None:
    if "\x00" in text or _REPLACEMENT in text:
        raise DataError(
            f"{path.name}: not a samples CSV: it holds binary data; give a .csv, a .csv.gz or a file "
            "written by calibrate or simulate"
        )


# -- cells and numbers ----------------------------------------------------------------------------

SPACE = " "
"""Stands for runs of white space."""
DELIMITERS = ("\t", ";", ",", SPACE)
_IN_WORDS = {"\t": "tab", ";": "semicolon", ",": "comma", SPACE: "space"}

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

    @property
    def delimiter_in_words(self) -> str:
        """Name of what separates the cells."""
        return _IN_WORDS.get(self.delimiter, f"'{self.delimiter}'")

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


def proved_mark(cells: Iterable[str]) -> str:
    """The mark that a cell proves to be decimal; empty where none does."""
    for cell in cells:
        text = cell.strip()
        if ("." not in text and "," not in text) or _UNDECIDED.fullmatch(text):
            continue
        for mark, other in ((".", ","), (",", ".")):
            plain, grouped = _FORMS[mark]
            if mark in text and plain.fullmatch(text):
                return mark
            # Two marks of a kind can only stand between thousands.
            if (mark in text or text.count(other) > 1) and grouped.fullmatch(text):
                return mark
    return ""
