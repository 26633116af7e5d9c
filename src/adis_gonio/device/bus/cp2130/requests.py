"""Requests of the CP2130 (AN792): bytes here, no device.

Every parser takes any bytes and either returns what they mean or raises `ProtocolError`.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from adis_gonio.base.errors import ProtocolError

VENDOR_ID, PRODUCT_ID = 0x10C4, 0x87A0
TYPE_OUT, TYPE_IN = 0x40, 0xC0
PACKET = 64
CHANNELS = 11
FRAME_BYTES = 2

CLOCKS_HZ = (12e6, 6e6, 3e6, 1.5e6, 750e3, 375e3, 187.5e3, 93.75e3)
"""SPI clocks by their code."""

CS_LOW_FOR_A_WHOLE_COMMAND = True
"""[M] Chip select stays low for one bulk command, and the chip's own "CS toggle" works per byte: so a
frame is one WriteRead of two bytes with the toggle off. Where a scope shows CS rising between the two
bytes, the delay mask in `delay_request` is the place to mend."""

CPHA_BIT, CPOL_BIT, PUSH_PULL_BIT = 5, 4, 3
"""[M] Bits of the SPI word beside the clock code in bits 2:0."""

EVENT_PIN = 4
"""GPIO.4, the only pin that can count."""
COUNTER_MODES = (4, 5, 6, 7)
"""[M] Modes of the event counter that count: edges rising and falling, pulses negative and positive.
The pin's duty is programmed at the factory or once by its owner (OTP), never by this package."""

PIN_BITS = (3, 4, 5, 6, 7, 8, 10, 11, 12, 13, 14)
"""[M] Bits of GPIO.0 to GPIO.10 in a word of pins. The answer about chip selects has a word of channels,
which count from bit 0, and a word of pins: those whose function is a chip select and which are on."""


class ControlRequest(IntEnum):
    """Control requests that this package sends; those of the OTP memory are not among them."""

    SET_GPIO_MODE = 0x23
    GET_CHIP_SELECT = 0x24
    SET_CHIP_SELECT = 0x25
    GET_SPI_WORD = 0x30
    SET_SPI_WORD = 0x31
    SET_SPI_DELAY = 0x33
    GET_EVENT_COUNTER = 0x44


class GpioMode(IntEnum):
    """What drives a pin."""

    INPUT = 0
    OPEN_DRAIN = 1
    PUSH_PULL = 2


_THIS_ONE_ONLY = 2
_WRITE_READ = 2
_HEADER = struct.Struct("<HBBI")
_COUNTER = struct.Struct(">BH")
_SELECTS = struct.Struct(">HH")


def clock_code(clock_hz: float) -> int | None:
    """Code of the fastest clock that is not above `clock_hz`; None where all are."""
    return next((code for code, clock in enumerate(CLOCKS_HZ) if clock <= clock_hz), None)


def spi_word(code: int) -> int:
    """SPI word of a channel: mode 3, chip select push-pull, a clock."""
    return 1 << CPHA_BIT | 1 << CPOL_BIT | 1 << PUSH_PULL_BIT | code


def spi_word_request(channel: int, word: int) -> bytes:
    """Data of `SET_SPI_WORD`."""
    return bytes((channel, word))


def parse_spi_words(data: bytes) -> tuple[int, ...]:
    """SPI words of all channels, the answer to `GET_SPI_WORD`."""
    if len(data) != CHANNELS:
        raise ProtocolError(f"CP2130: {len(data)} SPI words instead of {CHANNELS}")
    return tuple(data)


def select_request(channel: int) -> bytes:
    """Data of `SET_CHIP_SELECT`: this channel and no other."""
    return bytes((channel, _THIS_ONE_ONLY))


def parse_selects(data: bytes) -> tuple[frozenset[int], frozenset[int]]:
    """Channels and pins whose chip select is on, the answer to `GET_CHIP_SELECT`."""
    if len(data) != _SELECTS.size:
        raise ProtocolError(f"CP2130: chip selects of {len(data)} bytes instead of {_SELECTS.size}")
    channels, pins = _SELECTS.unpack(data)
    return (
        frozenset(channel for channel in range(CHANNELS) if channels >> channel & 1),
        frozenset(pin for pin, bit in enumerate(PIN_BITS) if pins >> bit & 1),
    )


def delay_request(channel: int) -> bytes:
    """Data of `SET_SPI_DELAY`: no delays and no CS toggle; the host keeps the times between frames."""
    return bytes((channel, 0)) + bytes(6)


def gpio_request(pin: int, mode: GpioMode, level: int) -> bytes:
    """Data of `SET_GPIO_MODE`."""
    return bytes((pin, mode, level))


def frame_command(frame: int) -> bytes:
    """Bulk command that sends one frame and reads as much."""
    return _HEADER.pack(0, _WRITE_READ, 0, FRAME_BYTES) + frame.to_bytes(FRAME_BYTES, "big")


def parse_frame(data: bytes) -> int:
    """Word that came in during a frame."""
    if len(data) != FRAME_BYTES:
        raise ProtocolError(f"CP2130: {len(data)} bytes came in for a frame of {FRAME_BYTES}")
    return int.from_bytes(data, "big")


def parse_counter(data: bytes) -> tuple[int, int]:
    """Mode and count (u16, wraps), the answer to `GET_EVENT_COUNTER`."""
    if len(data) != _COUNTER.size:
        raise ProtocolError(f"CP2130: an event counter of {len(data)} bytes instead of {_COUNTER.size}")
    mode, count = _COUNTER.unpack(data)
    return mode & 7, count
