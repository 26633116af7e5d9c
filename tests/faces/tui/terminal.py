"""A real terminal with a program in it (tmux): keys go in, lines of the screen come out."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

PATIENCE_S = 300.0
"""A busy machine takes its time to start a program."""


def tmux() -> str | None:
    """The program, where there is one."""
    return shutil.which("tmux")


class Terminal:
    """A terminal of its own, with a shell; a context manager.

    Parameters
    ----------
    folder : Path
        For the socket.
    columns, rows : int
    environment : mapping
        Added to this process' own.
    """

    def __init__(self, folder: Path, columns: int, rows: int, environment: Mapping[str, str]) -> None:
        self._command = [tmux() or "tmux", "-f", "/dev/null", "-S", str(folder / "tmux")]
        self._environment = {**os.environ, **environment, "PS1": "ready> ", "LC_ALL": "C.UTF-8"}
        self._environment.pop("TMUX", None)
        # As of a shell that exports them: what starts in it must ask the terminal itself.
        self._environment |= {"COLUMNS": str(columns), "LINES": str(rows)}
        size = ["-x", str(columns), "-y", str(rows)]
        self._tmux(
            "new-session", "-d", *size, "env", "TERM=screen-256color", "bash", "--norc", "--noprofile"
        )
        self.wait_for(r"ready> ")

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *error: object) -> None:
        self._tmux("kill-server")

    def _tmux(self, *arguments: str) -> str:
        return subprocess.run(
            [*self._command, *arguments],
            env=self._environment, check=True, capture_output=True, text=True, timeout=PATIENCE_S,
        ).stdout  # fmt: skip

    def run(self, command: Sequence[str]) -> None:
        """Type a command and Enter."""
        self._tmux("send-keys", "-l", f"clear; {shlex.join(command)}; echo status=$?")
        self.press("Enter")

    def press(self, *keys: str) -> None:
        """Press keys, by tmux's names."""
        self._tmux("send-keys", *keys)

    def resize(self, columns: int, rows: int) -> None:
        """Make it another size."""
        self._tmux("resize-window", "-x", str(columns), "-y", str(rows))

    def kill_program(self) -> None:
        """Send SIGTERM to the program that runs in the shell."""
        shell = int(self._tmux("display-message", "-p", "#{pane_pid}"))
        for child in Path(f"/proc/{shell}/task/{shell}/children").read_text().split():
            os.kill(int(child), signal.SIGTERM)

    def screen(self, *, history: bool = False) -> str:
        """What is seen, with what has scrolled away where `history`."""
        return self._tmux("capture-pane", "-p", "-J", *(["-S", "-"] if history else []))

    def wait_for(self, pattern: str) -> str:
        """The screen once it shows what fits a pattern; fails with the screen after `PATIENCE_S`."""
        end_s = time.monotonic() + PATIENCE_S
        while not re.search(pattern, text := self.screen(), re.MULTILINE):
            assert time.monotonic() < end_s, f"never seen: {pattern}\n{text}"
            time.sleep(0.1)
        return text

    def wait_until_gone(self, text: str) -> None:
        """Wait until a text is no longer seen."""
        end_s = time.monotonic() + PATIENCE_S
        while text in (screen := self.screen()):
            assert time.monotonic() < end_s, f"still there: {text}\n{screen}"
            time.sleep(0.1)

    def status(self) -> int:
        """Exit status of the command, once it has ended."""
        text = self.wait_for(r"^status=\d+")
        return int(re.findall(r"^status=(\d+)", text, re.MULTILINE)[-1])
