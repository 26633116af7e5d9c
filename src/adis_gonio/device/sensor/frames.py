"""Read and write frames. The only place where the write bit can be set is `write_frames`.

A frame is bit 15 write, bit 14 zero, bits 13:8 byte address, bits 7:0 data (DS, A). Replies are
pipelined: the word of frame k is shifted out during frame k + 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.device.bus import SpiTiming, Words
from adis_gonio.device.sensor.registers import WRITE, Register

IDLE = 0x0000
"""Read of ENDURANCE, harmless. Never idle with ones: 0xFFFF looks like a write to COMMAND."""

FAST = SpiTiming(clock_hz=1_000_000, stall_us=9.0, period_us=40.0)
"""Fast mode, SMPL_PRD <= 0x09: up to 2 MHz, frame period at least 40 µs, stall at least 9 µs (DS, A)."""

NORMAL = SpiTiming(clock_hz=250_000, stall_us=75.0, period_us=160.0)
"""Normal mode, SMPL_PRD >= 0x0A: up to 300 kHz, period at least 160 µs, stall at least 75 µs (DS, A).

It keeps the limits of fast mode as well, so it is safe while the mode is unknown."""

FAST_UP_TO = 0x09
"""Largest SMPL_PRD, time-base bit included, that runs in fast mode (DS, A)."""


def timing_for(smpl_prd: int) -> SpiTiming:
    """Timing that a value of SMPL_PRD asks for; the whole byte counts, not only N."""
    return FAST if (smpl_prd & 0xFF) <= FAST_UP_TO else NORMAL


def read_frame(register: Register) -> int:
    """Frame that reads a register."""
    if not register.readable:
        raise UsageError(f"{register.name} cannot be read")
    return (register.address & 0x3F) << 8


def read_frames(registers: Sequence[Register]) -> Words:
    """Frames (k,) uint16 that read registers; one more frame is needed to fetch the last reply."""
    return np.array([read_frame(register) for register in registers], np.uint16)


def write_frames(register: Register, word: int, *, byte_mask: int = 0xFFFF) -> Words:
    """Frames that write a register: low byte, then high byte.

    Bytes in which the register has no writable bit are left out, and so are bytes outside `byte_mask`
    (0x00FF low, 0xFF00 high).

    Raises
    ------
    UsageError
        The register is read-only, or `word` sets bits that it has not.
    """
    if not register.writable:
        raise UsageError(f"{register.name} is read-only")
    if word & ~register.write_mask:
        raise UsageError(
            f"{register.name} has no bits 0x{word & ~register.write_mask:04X}"
            f" (writable: 0x{register.write_mask:04X})"
        )
    frames = []
    for shift in (0, 8):
        if (register.write_mask & byte_mask) >> shift & 0xFF:
            address = (register.address & 0x3F) + (shift >> 3)
            frames.append(WRITE | address << 8 | word >> shift & 0xFF)
    return np.array(frames, np.uint16)
