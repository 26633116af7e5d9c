"""The program and its terminal: letters that a character set lacks, one-line messages, and Ctrl-C.

Files are always UTF-8; the character sets here belong to standard output and standard error. The module
imports neither numpy nor rich, so that `adis-gonio --help` answers at once.
"""

from __future__ import annotations

import codecs
import signal
import sys
import threading
import unicodedata
from collections.abc import Iterator
from types import FrameType
from typing import TypeVar

from adis_gonio.base.errors import one_line

T = TypeVar("T")

_ERRORS = "adis-gonio-readable"

ASCII_FORMS = {
    "Δ": "d", "∂": "d", "δ": "delta", "φ": "phi", "Φ": "Phi", "α": "alpha", "β": "beta", "ε": "eps",
    "θ": "theta", "λ": "lambda", "µ": "u", "μ": "u", "ν": "nu", "π": "pi", "ρ": "rho", "σ": "sigma",
    "Σ": "sum", "τ": "tau", "χ": "chi", "ψ": "psi", "ω": "omega", "Ω": "Ohm",
    "°": "deg", "±": "+-", "∓": "-+", "−": "-", "–": "-", "—": "-", "×": "x", "·": "*", "√": "sqrt",
    "∞": "inf", "≈": "~", "≤": "<=", "≥": ">=", "≠": "!=", "→": "->", "←": "<-", "…": "...", "′": "'",
    "“": "'", "”": "'", "„": "'", "‘": "'", "’": "'", "½": "1/2", "²": "^2", "³": "^3", "ᵀ": "^T",
    "─": "-", "━": "-", "│": "|", "┘": "+", "└": "+", "╱": "/", "╸": "-", "╺": "-", "•": "*", "ß": "ss",
    "●": "o", "○": "o", "▶": ">", "◀": "<", "▲": "^", "▼": "v", "✓": "ok", "✗": "x",
}  # fmt: skip
"""ASCII text for each letter that a character set may lack; none of it can end a JSON string."""


def ascii_form(letter: str) -> str:
    """Return ASCII text that replaces a letter: from `ASCII_FORMS`, else its base letter, else `?`."""
    if letter in ASCII_FORMS:
        return ASCII_FORMS[letter]
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode("ascii")
    return plain or ("" if unicodedata.combining(letter) else "?")


def on_terminal() -> bool:
    """Return True if standard input is a terminal, so that an operator can answer questions."""
    return sys.stdin is not None and sys.stdin.isatty()


LONGEST_MESSAGE = 600
"""Largest number of characters of a message.

The program's own messages are shorter; only text from a file can exceed it.
"""


def format_message(text: str) -> str:
    """Return a message as one printable line of about `LONGEST_MESSAGE` characters.

    A longer message loses its middle, because it names the file at its beginning and the remedy at its end.
    """
    line, half = one_line(text), LONGEST_MESSAGE // 2
    return line if len(line) <= LONGEST_MESSAGE else f"{line[:half]}…{line[-half:]}"


def replace_missing_letters() -> None:
    """Make standard output and standard error replace letters that their character set lacks.

    The replacements are ASCII forms, see `ascii_form`. A stream without `reconfigure`, such as a test's
    replacement, stays as it is. Click writes UTF-8 to a stream of plain ASCII, because it takes ASCII for a
    misconfigured machine.
    """
    codecs.register_error(_ERRORS, _replace_letters)
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "encoding", None) is not None and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors=_ERRORS)


def _replace_letters(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    if all(0xDC80 <= ord(letter) <= 0xDCFF for letter in letters):
        # Bytes of a file name that could not be decoded are written back unchanged.
        return bytes(ord(letter) - 0xDC00 for letter in letters), error.end
    return "".join(ascii_form(letter) for letter in letters), error.end


class Interrupt:
    """Context in which the first Ctrl-C only sets `asked` to True, so that the present step can end.

    While `steps` waits for its next item, the first Ctrl-C also ends the wait. A second Ctrl-C always
    raises `KeyboardInterrupt`. In a thread other than the main thread the context does nothing.
    """

    def __init__(self) -> None:
        self.asked = False
        self._waiting = False
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Interrupt:
        if self._main:
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._before)

    def steps(self, items: Iterator[T]) -> Iterator[T]:
        """Yield items until there are no more, or until Ctrl-C, which sets `asked`."""
        while True:
            try:
                self._waiting = True
                if self.asked:
                    return
                item = next(items)
            except (StopIteration, KeyboardInterrupt):
                return
            finally:
                self._waiting = False
            yield item

    def _note(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked, True
        if again or self._waiting:
            raise KeyboardInterrupt
