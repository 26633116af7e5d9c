"""Output in character sets that lack Δ, φ or °: letters give way to readable ones, never to a traceback.

Files are UTF-8 wherever they are written; this is about standard output and standard error alone.
"""

from __future__ import annotations

import codecs
import sys
import unicodedata

from adis_gonio.base.errors import one_line

_ERRORS = "adis-gonio-readable"
_ASCII = "adis-gonio-ascii"

READABLE = {
    "Δ": "d", "∂": "d", "δ": "delta", "φ": "phi", "Φ": "Phi", "α": "alpha", "β": "beta", "ε": "eps",
    "θ": "theta", "λ": "lambda", "µ": "u", "μ": "u", "ν": "nu", "π": "pi", "ρ": "rho", "σ": "sigma",
    "Σ": "sum", "τ": "tau", "χ": "chi", "ψ": "psi", "ω": "omega", "Ω": "Ohm",
    "°": "deg", "±": "+-", "∓": "-+", "−": "-", "–": "-", "—": "-", "×": "x", "·": "*", "√": "sqrt",
    "∞": "inf", "≈": "~", "≤": "<=", "≥": ">=", "≠": "!=", "→": "->", "←": "<-", "…": "...", "′": "'",
    "“": "'", "”": "'", "„": "'", "‘": "'", "’": "'", "½": "1/2", "²": "^2", "³": "^3", "ᵀ": "^T",
    "─": "-", "━": "-", "│": "|", "┘": "+", "└": "+", "╱": "/", "╸": "-", "╺": "-", "•": "*", "ß": "ss",
    "●": "o", "○": "o", "▶": ">", "◀": "<", "▲": "^", "▼": "v", "✓": "ok", "✗": "x",
}  # fmt: skip
"""What stands for a letter that a character set lacks; never what would end a string of JSON."""


def readable(letter: str) -> str:
    """ASCII that stands for a letter; its base letter where there is one, else a question mark."""
    if letter in READABLE:
        return READABLE[letter]
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode("ascii")
    return plain or ("" if unicodedata.combining(letter) else "?")


LONGEST_MESSAGE = 600
"""Characters of a message; messages of this program have fewer, so that only text from a file is cut."""


def message_line(text: str) -> str:
    """Return a message as one printable line of about `LONGEST_MESSAGE` characters.

    A longer one loses its middle: the file stands at its beginning, the cure at its end.
    """
    line, half = one_line(text), LONGEST_MESSAGE // 2
    return line if len(line) <= LONGEST_MESSAGE else f"{line[:half]}…{line[-half:]}"


def make_readable() -> None:
    """Let standard output and standard error write what their character set lacks in readable letters.

    A stream that cannot be set up anew, as one that a test has put there, stays as it is.
    """
    codecs.register_error(_ERRORS, _replaced)
    codecs.register(_find)
    for stream in (sys.stdout, sys.stderr):
        encoding = getattr(stream, "encoding", None)
        if encoding is None or not hasattr(stream, "reconfigure"):
            continue
        # click takes plain ASCII for a mistake of the machine and writes UTF-8 around it: not by this name.
        if codecs.lookup(encoding).name == "ascii":
            stream.reconfigure(encoding=_ASCII)
        stream.reconfigure(errors=_ERRORS)


def _replaced(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    letters = error.object[error.start : error.end]
    if all(0xDC80 <= ord(letter) <= 0xDCFF for letter in letters):
        # Bytes of a file's name that were no text when they came in go out as they came.
        return bytes(ord(letter) - 0xDC00 for letter in letters), error.end
    return "".join(readable(letter) for letter in letters), error.end


class _Encoder(codecs.IncrementalEncoder):
    """ASCII by another name."""

    def encode(self, text: str, final: bool = False) -> bytes:
        return text.encode("ascii", self.errors)


def _find(name: str) -> codecs.CodecInfo | None:
    if name.replace("_", "-") != _ASCII:
        return None
    ascii_ = codecs.lookup("ascii")
    return codecs.CodecInfo(
        ascii_.encode,
        ascii_.decode,
        incrementalencoder=_Encoder,
        incrementaldecoder=ascii_.incrementaldecoder,
        name=_ASCII,
    )
