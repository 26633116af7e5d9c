"""The simulated board as a process: its pty, its clock, its reports."""

from __future__ import annotations

import json
import mmap
import selectors
import struct
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Self

PATIENCE_S = 60.0
"""Wall time without an answer, or without progress, after which the process is given up."""


class Board:
    """A running rig (see rig.c).

    Parameters
    ----------
    program, elf : Path
        The rig and the firmware that it runs.
    options : float or Path
        Options of rig.c, and parameters of the chip; `vcd` is the file of a capture of the pins.

    Attributes
    ----------
    port : str
        The pty.
    """

    def __init__(self, program: Path, elf: Path, **options: float | Path) -> None:
        self._clock_file = tempfile.NamedTemporaryFile(prefix="rig-clock-")  # noqa: SIM115
        self._clock_file.write(bytes(8))
        self._clock_file.flush()
        self._clock = mmap.mmap(self._clock_file.fileno(), 8, prot=mmap.PROT_READ)
        self._seen_s, self._moved_s = 0.0, time.monotonic()
        words = [
            f"{name}={value if isinstance(value, Path) else format(value, '.12g')}"
            for name, value in options.items()
        ]
        self._process = subprocess.Popen(
            [str(program), f"elf={elf}", f"clock={self._clock_file.name}", *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self._selector = selectors.DefaultSelector()
        assert self._process.stdout is not None
        self._selector.register(self._process.stdout, selectors.EVENT_READ)
        try:
            self.port = self._line()
        except BaseException:
            self.close()
            raise

    # -- the board's clock, as adis_gonio.device.bus.host.Clock ---

    def now_s(self) -> float:
        """Time of the simulated board in s; fails where it stands still, so that no wait is for ever."""
        now_s, wall_s = float(struct.unpack("q", self._clock[:8])[0]) * 1e-12, time.monotonic()
        if now_s != self._seen_s:
            self._seen_s, self._moved_s = now_s, wall_s
        elif wall_s - self._moved_s > PATIENCE_S:
            raise RuntimeError(f"the board stands still at {now_s:.3f} s")
        return now_s

    def sleep_s(self, seconds: float) -> None:
        """Wait until the board is so much further."""
        end_s = self.now_s() + seconds
        while (now_s := self.now_s()) < end_s:
            time.sleep(min(max(end_s - now_s, 0.0002), 0.02))
            if self._process.poll() is not None:
                raise RuntimeError(f"the board ended at {now_s:.3f} s")

    # -- its reports ---------------------------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """Counters, violations, extremes: see `report` in rig.c."""
        found: dict[str, Any] = json.loads(self._ask("report"))
        return found

    def set(self, name: str, value: float) -> None:
        """Set a parameter of the chip."""
        self._do(f"set {name} {value:.12g}")

    def input(self, name: str, value: float) -> None:
        """Set what the chip measures: supply, gyro_x, accl_x, temp_x, aux, …"""
        self._do(f"input {name} {value:.12g}")

    def forget_extremes(self) -> None:
        """Let the tightest times begin anew."""
        self._do("forget x 0")

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            try:
                self._process.communicate("quit\n", timeout=10)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait(60)
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._selector.close()
        self._clock.close()
        self._clock_file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _do(self, order: str) -> None:
        answer = self._ask(order)
        if answer != "done":
            raise ValueError(f"'{order}': {answer}")

    def _ask(self, order: str) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(order + "\n")
        return self._line()

    def _line(self) -> str:
        assert self._process.stdout is not None
        if not self._selector.select(PATIENCE_S):
            raise RuntimeError("the rig does not answer")
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"the rig ended with status {self._process.wait(10)}")
        return line.strip()


def violations(report: dict[str, Any]) -> dict[str, int]:
    """Kinds of violations that occurred, with their counts."""
    return {kind: count for kind, count in report["violations"].items() if count}
