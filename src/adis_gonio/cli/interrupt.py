"""Ctrl-C that ends work between two steps, so that what is counted is what was written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """While entered, Ctrl-C is noted in `asked`; only where it finds the work `waiting` it breaks in.

    A second Ctrl-C always does. In threads that get no signals nothing changes.
    """

    def __init__(self) -> None:
        self.asked = False
        self._waiting = False
        self._main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> Interrupt:
        if self._main:
            self._before = signal.signal(signal.SIGINT, self._noted)
        return self

    def __exit__(self, *error: object) -> None:
        if self._main:
            signal.signal(signal.SIGINT, self._before)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """A step that may be broken off: nothing of it is kept then.

        Raises
        ------
        KeyboardInterrupt
            Ctrl-C came before or comes now.
        """
        self._waiting = True
        try:
            if self.asked:
                raise KeyboardInterrupt
            yield
        finally:
            self._waiting = False

    def _noted(self, number: int, frame: FrameType | None) -> None:
        again, self.asked = self.asked, True
        if again or self._waiting:
            raise KeyboardInterrupt
