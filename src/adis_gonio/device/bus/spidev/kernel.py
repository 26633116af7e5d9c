"""Calls of Linux's spidev and GPIO character devices: layouts as the kernel has them, 64-bit safe.

All pointers are u64 in these structures, on 32-bit systems too (linux/spi/spidev.h, linux/gpio.h).
"""

from __future__ import annotations

import ctypes
import os
from typing import Any, Protocol

_WRITE, _READ = 1, 2
_SIZE_BITS = 14


def _ioc(direction: int, kind: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | kind << 8 | number


class Transfer(ctypes.Structure):
    """struct spi_ioc_transfer."""

    _fields_ = (
        ("tx_buf", ctypes.c_uint64),
        ("rx_buf", ctypes.c_uint64),
        ("len", ctypes.c_uint32),
        ("speed_hz", ctypes.c_uint32),
        ("delay_usecs", ctypes.c_uint16),
        ("bits_per_word", ctypes.c_uint8),
        ("cs_change", ctypes.c_uint8),
        ("tx_nbits", ctypes.c_uint8),
        ("rx_nbits", ctypes.c_uint8),
        ("word_delay_usecs", ctypes.c_uint8),
        ("pad", ctypes.c_uint8),
    )


TRANSFER_SIZE = ctypes.sizeof(Transfer)
MOST_TRANSFERS = ((1 << _SIZE_BITS) - 1) // TRANSFER_SIZE
"""Transfers that fit the size field of an ioctl number: 511."""

_SPI = ord("k")
WR_MODE32 = _ioc(_WRITE, _SPI, 5, 4)
RD_MODE32 = _ioc(_READ, _SPI, 5, 4)
MODE_3 = MODE_BITS = 0b11
LSB_FIRST, THREE_WIRE, LOOP = 0x08, 0x10, 0x20
BENT_FRAMES = LSB_FIRST | THREE_WIRE | LOOP
"""Flags of the mode that change the bits of a frame or where they come from. The others say how CS is
driven and are not ours: kernels since 5.4 set SPI_CS_HIGH where CS is a GPIO, whatever its polarity."""


def message(count: int) -> int:
    """SPI_IOC_MESSAGE(count)."""
    return _ioc(_WRITE, _SPI, 0, count * TRANSFER_SIZE)


class _LineAttribute(ctypes.Structure):
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("padding", ctypes.c_uint32),
        ("value", ctypes.c_uint64),
        ("mask", ctypes.c_uint64),
    )


class LineRequest(ctypes.Structure):
    """struct gpio_v2_line_request with its configuration unrolled."""

    _fields_ = (
        ("offsets", ctypes.c_uint32 * 64),
        ("consumer", ctypes.c_char * 32),
        ("flags", ctypes.c_uint64),
        ("num_attrs", ctypes.c_uint32),
        ("config_padding", ctypes.c_uint32 * 5),
        ("attrs", _LineAttribute * 10),
        ("num_lines", ctypes.c_uint32),
        ("event_buffer_size", ctypes.c_uint32),
        ("padding", ctypes.c_uint32 * 5),
        ("fd", ctypes.c_int32),
    )


class LineValues(ctypes.Structure):
    """struct gpio_v2_line_values."""

    _fields_ = (("bits", ctypes.c_uint64), ("mask", ctypes.c_uint64))


GET_LINE = _ioc(_READ | _WRITE, 0xB4, 0x07, ctypes.sizeof(LineRequest))
SET_VALUES = _ioc(_READ | _WRITE, 0xB4, 0x0F, ctypes.sizeof(LineValues))
LINE_OUTPUT, LINE_OPEN_DRAIN = 1 << 3, 1 << 6
ATTRIBUTE_VALUES = 2


def open_drain_line(offset: int) -> LineRequest:
    """Request for one line as an open-drain output that is not pulled."""
    request = LineRequest()
    request.offsets[0] = offset
    request.consumer = b"adis-gonio reset"
    request.flags = LINE_OUTPUT | LINE_OPEN_DRAIN
    request.num_attrs = 1
    request.attrs[0].id = ATTRIBUTE_VALUES
    request.attrs[0].value = request.attrs[0].mask = 1
    request.num_lines = 1
    return request


class Kernel(Protocol):
    """System calls that are used; tests put their own in place."""

    def open(self, path: str) -> int:
        """File descriptor of a device file, for reading and writing; `OSError`."""

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """Call with a ctypes object that the kernel reads and writes; `OSError`."""

    def lock(self, fd: int) -> None:
        """Advisory lock; `BlockingIOError` where another program has it."""

    def close(self, fd: int) -> None:
        """Give a descriptor back."""


class LinuxKernel:
    """The real one.

    Raises
    ------
    ImportError
        This system has no `fcntl`.
    """

    def __init__(self) -> None:
        import fcntl

        self._fcntl = fcntl

    def open(self, path: str) -> int:
        """File descriptor of a device file."""
        return os.open(path, os.O_RDWR | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """ioctl(2)."""
        result: int = self._fcntl.ioctl(fd, request, argument, True)
        return result

    def lock(self, fd: int) -> None:
        """flock(2), exclusive and without waiting."""
        self._fcntl.flock(fd, self._fcntl.LOCK_EX | self._fcntl.LOCK_NB)

    def close(self, fd: int) -> None:
        """close(2)."""
        os.close(fd)
