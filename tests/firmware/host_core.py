"""The C core on the host, as a shared library: the firmware without a board, in virtual time."""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

from firmware.make import make

HOST = Path(__file__).parents[2] / "firmware_proto" / "host"
FRAME = ctypes.CFUNCTYPE(ctypes.c_uint16, ctypes.c_uint16)
POLLS = 40


def missing() -> str:
    """What is missing to build the core; empty where nothing is."""
    for tool in ("gcc", "make"):
        if shutil.which(tool) is None:
            return f"{tool} is not installed (Debian: gcc make)"
    return ""


@cache
def build(folder: Path, target: str) -> Path:
    """A product of firmware_proto/host/Makefile."""
    make(HOST, folder, str(folder / target))
    return folder / target


class HostCore:
    """The core, its board, and a port for hosts.

    Attributes
    ----------
    frames : list of int
        Frames sent so far.
    answer : callable
        Gives the word shifted out during a frame; by default the number of the frame.
    """

    def __init__(self, library: Path) -> None:
        self._lib = ctypes.CDLL(str(library))
        self._lib.host_take.restype = ctypes.c_uint32
        self._lib.host_timing.restype = ctypes.c_uint32
        self._lib.host_falling.restype = ctypes.c_uint8
        self._lib.host_reset_us.restype = ctypes.c_uint32
        self._lib.host_lock_errors.restype = ctypes.c_uint32
        self.frames: list[int] = []
        self.answer: Callable[[int], int] = lambda word: len(self.frames) - 1
        self._hook = FRAME(self._frame)
        ctypes.c_void_p.in_dll(self._lib, "host_frame_hook").value = ctypes.cast(
            self._hook, ctypes.c_void_p
        ).value
        self.time_us = 0
        self._silent_reads = 0
        self._lib.host_start()

    def _frame(self, word: int) -> int:
        self.frames.append(word)
        return self.answer(word) & 0xFFFF

    # -- board -----------------------------------------------------------------------------------

    def set_time(self, time_us: int) -> None:
        self.time_us = time_us
        self._lib.host_set_time(ctypes.c_uint32(time_us & 0xFFFFFFFF))

    def edge(self, time_us: int | None = None) -> None:
        """An edge of data-ready, at a time."""
        if time_us is not None:
            self.set_time(time_us)
        self._lib.host_edge()

    def poll(self, times: int = POLLS) -> None:
        self._lib.host_poll(times)

    def limit_room(self, room: int) -> None:
        self._lib.host_limit_room(room)

    @property
    def timing(self) -> tuple[int, int, int]:
        stall, period = ctypes.c_uint32(), ctypes.c_uint32()
        clock = self._lib.host_timing(ctypes.byref(stall), ctypes.byref(period))
        return clock, stall.value, period.value

    @property
    def falling(self) -> bool:
        return bool(self._lib.host_falling())

    @property
    def reset_us(self) -> int:
        return int(self._lib.host_reset_us())

    @property
    def lock_errors(self) -> int:
        return int(self._lib.host_lock_errors())

    # -- port ------------------------------------------------------------------------------------

    def now_s(self) -> float:
        """A clock that runs while nothing comes."""
        return float(self._silent_reads)

    def send(self, data: bytes) -> None:
        self._lib.host_feed(data, len(data))

    def receive(self, wait_s: float) -> bytes:
        """What the firmware sends within a few rounds of its main loop."""
        self.poll()
        buffer = ctypes.create_string_buffer(4096)
        count = self._lib.host_take(buffer, 4096)
        self._silent_reads += not count
        return buffer.raw[:count]
