"""Ctrl-C between two steps, so that what is counted is what was written; and Ctrl-C that cannot be lost."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType


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


class Insistent:
    """While entered, Ctrl-C is raised again until it comes through.

    An exception that a handler of signals raises is lost where Python is called by something that cannot
    pass it on, as the start of a compiled module or a destructor: the work would go on to its end. For work
    that has nothing to put back: what undoes itself in steps must not be broken off a second time.
    """

    AGAIN_S = 0.5

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = False
        self._timer: threading.Timer | None = None

    def __enter__(self) -> Insistent:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.getsignal(signal.SIGINT)
            if self._before is signal.default_int_handler:
                self._inside = True
                signal.signal(signal.SIGINT, self._raised)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        entered, self._inside = self._inside, False
        with self._lock:
            pass  # what `_again` has begun is over, and finds nobody inside
        if entered:
            signal.signal(signal.SIGINT, self._before)
        if self._timer is not None:
            self._timer.cancel()

    def _raised(self, number: int, frame: FrameType | None) -> None:
        if not self._inside:
            return
        self._timer = threading.Timer(self.AGAIN_S, self._again)
        self._timer.daemon = True
        self._timer.start()
        raise KeyboardInterrupt

    def _again(self) -> None:
        with self._lock:
            if self._inside:
                _thread.interrupt_main()
