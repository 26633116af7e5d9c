"""Programs that tests start: each ends, whatever it does with a signal."""

from __future__ import annotations

import signal
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

LONGEST_S = 600
"""No test's program works that long; one that hangs is killed then, and the test sees its end."""


@contextmanager
def running(
    command: Sequence[str], *, longest_s: float = LONGEST_S, **options: Any
) -> Iterator[subprocess.Popen[str]]:
    """A program with pipes as `subprocess.Popen` has them; killed at the end and after `longest_s`.

    Ctrl-C means to it what it means in a terminal, even where the tests were started with it ignored, as
    `nohup` and a shell's `&` do.
    """
    restored = (lambda: signal.signal(signal.SIGINT, signal.default_int_handler)) if _posix() else None
    # Between fork and exec it sets a signal and nothing else, which no lock of a thread can hold up.
    program = subprocess.Popen(command, text=True, preexec_fn=restored, **options)  # noqa: PLW1509
    watchdog = threading.Timer(longest_s, program.kill)
    watchdog.daemon = True
    watchdog.start()
    try:
        yield program
        program.wait(longest_s)
    finally:
        watchdog.cancel()
        program.kill()
        program.wait(30)
        for pipe in (program.stdin, program.stdout, program.stderr):
            if pipe is not None:
                pipe.close()


def _posix() -> bool:
    return hasattr(signal, "SIGKILL")
