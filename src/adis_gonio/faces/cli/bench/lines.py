"""Lines from standard input: waited for, or only looked for while a sensor is watched."""

from __future__ import annotations

import os
import select
import sys


def on_terminal() -> bool:
    """True where somebody types the lines; False for a pipe, a file or what only reads like one."""
    asks = getattr(sys.stdin, "isatty", None)
    return asks is not None and asks()


class Lines:
    """Standard input line by line."""

    def __init__(self) -> None:
        self._kept = b""
        self._ended = False
        try:
            self._file: int | None = None if os.name == "nt" else sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # no real file: only something with lines, or closed
            self._file = None

    def next(self, *, wait: bool) -> str | None:
        """The next line; None where there is none yet and nobody waits. `EOFError` after the last one.

        Where the system cannot look without waiting, it waits.
        """
        if self._file is None:
            line = sys.stdin.readline()
            if not line:
                raise EOFError
            return line.strip()
        while b"\n" not in self._kept and not self._ended:
            if not select.select([self._file], [], [], None if wait else 0.0)[0]:
                return None
            read = os.read(self._file, 4096)
            self._ended = not read
            self._kept += read
        if not self._kept:
            raise EOFError
        line_bytes, _, self._kept = self._kept.partition(b"\n")
        return line_bytes.decode(errors="replace").strip()
