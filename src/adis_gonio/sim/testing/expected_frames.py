"""A strict bus for tests of drivers: an ordered list of frames with their replies."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from adis_gonio.device.bus.contract import SpiBus, SpiTiming, Words
from adis_gonio.device.bus.host import SAFE_TIMING


class ExpectedFrames(SpiBus):
    """A bus that accepts only the expected frames, in their order, and gives their replies.

    Another frame, a missing frame at `close` and a frame after the last one raise `AssertionError`; the
    message names the line of the test that expected the frame. Time is virtual.

    Parameters
    ----------
    script : iterable of (frame, reply)
        Expected frames with their replies; messages name the line of this call. `expect` adds more frames.

    Examples
    --------
    >>> bus = ExpectedFrames()
    >>> bus.expect(0x3600, 0x0000)  # read SMPL_PRD; the reply belongs to the frame before
    >>> bus.expect(0x0000, 0x0001)
    >>> bus.exchange([0x3600, 0x0000])
    [0, 1]
    """

    def __init__(self, script: Iterable[tuple[int, int]] = ()) -> None:
        super().__init__(SAFE_TIMING)
        self.url = "expected:"
        place = _place_of_caller()
        self._script = [(frame, reply, place) for frame, reply in script]
        self._at = 0
        self._time_s = 0.0

    def expect(self, frame: int, reply: int) -> None:
        """Expect one more frame; the chip shifts `reply` out while it shifts the frame in."""
        self._script.append((frame, reply, _place_of_caller()))

    def now_s(self) -> float:
        """Return the virtual time in s."""
        return self._time_s

    def sleep_s(self, seconds: float) -> None:
        """Advance the virtual time by some seconds."""
        self._time_s += seconds

    def _exchange(self, frames: Words) -> Words:
        replies = []
        for frame in frames.tolist():
            if self._at == len(self._script):
                raise AssertionError(f"frame 0x{frame:04X} comes after all {self._at} expected frames")
            expected, reply, place = self._script[self._at]
            if frame != expected:
                raise AssertionError(
                    f"{place}: frame {self._at} is 0x{frame:04X}, expected 0x{expected:04X}"
                )
            replies.append(reply)
            self._at += 1
            self._time_s += self.timing.frame_s
        return np.array(replies, np.uint16)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return timing

    def _close(self) -> None:
        missing = self._script[self._at :]
        if missing:
            first, _, place = missing[0]
            raise AssertionError(f"{place}: frames never sent: {len(missing)}, first 0x{first:04X}")


def _place_of_caller() -> str:
    """Return file name and line of the test code that called a method of the bus."""
    frame = sys._getframe(2)
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
