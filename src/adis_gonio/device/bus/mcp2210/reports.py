"""Reports of the MCP2210: 64 bytes each way, little endian; bytes here, no device.

Every parser takes any bytes and either returns what they mean or raises `ProtocolError`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import IntEnum

from adis_gonio.base.errors import ProtocolError

VENDOR_ID, PRODUCT_ID = 0x04D8, 0x00DE
REPORT = 64
PINS = 9
BASE_HZ = 12_000_000
SLOWEST_HZ = 1_500
FRAME_BYTES = 2

STARTS_WITHOUT_DATA = True
"""[M] The answer that accepts a transfer carries no data, even where the bytes are already through; the
data come with the next one. Holds by the maker's example; a board that differs shows as the error
"data before the transfer has started"."""

EVENT_PIN = 6
"""GP6, the only pin that can count."""
COUNT_RISING_EDGES = 0b010
"""[M] Chip settings, bits 3:1: what GP6 counts."""
EVENT_MODE_MASK = 0b1110


ECHO = 2
"""[M] Byte of the answer to an EEPROM read that repeats the address. The address is the only thing that
this chip repeats of a harmless request, and so serves as a mark in the order of answers."""


class Command(IntEnum):
    """Commands that this package sends; none writes to NVRAM or EEPROM."""

    CANCEL = 0x11
    EVENTS = 0x12
    GET_CHIP = 0x20
    SET_CHIP = 0x21
    SET_GPIO_VALUES = 0x30
    GET_GPIO_VALUES = 0x31
    SET_GPIO_DIRECTIONS = 0x32
    GET_GPIO_DIRECTIONS = 0x33
    SET_SPI = 0x40
    GET_SPI = 0x41
    TRANSFER = 0x42
    READ_EEPROM = 0x50


class AnswerStatus(IntEnum):
    """Second byte of an answer."""

    DONE = 0x00
    NOT_OWNED = 0xF7
    BUSY = 0xF8
    UNKNOWN = 0xF9
    WRITE_FAILED = 0xFA
    ACCESS_1 = 0xFB
    ACCESS_2 = 0xFC
    ACCESS_3 = 0xFD


STATUS_WORDS = {
    AnswerStatus.NOT_OWNED: "another master has the SPI bus",
    AnswerStatus.BUSY: "the SPI engine is busy",
    AnswerStatus.UNKNOWN: "the command is unknown: is this an MCP2210?",
    AnswerStatus.WRITE_FAILED: "a write failed",
    AnswerStatus.ACCESS_1: "access denied: the settings are protected",
    AnswerStatus.ACCESS_2: "access denied: the settings are protected",
    AnswerStatus.ACCESS_3: "access denied: the settings are protected",
}


class Engine(IntEnum):
    """State of the transfer engine, fourth byte of a transfer's answer."""

    FINISHED = 0x10
    STARTED = 0x20
    RUNNING = 0x30


class Designation(IntEnum):
    """What a pin is."""

    GPIO = 0
    CS = 1
    DEDICATED = 2


_CHIP = struct.Struct("<9sHHB")
_SPI = struct.Struct("<IHHHHHHB")
_WORD = struct.Struct("<H")


def request(command: Command, body: bytes = b"") -> bytes:
    """A report to the device, without a report id."""
    return (bytes([command]) + body).ljust(REPORT, b"\0")


def status_of(answer: bytes, command: Command) -> int:
    """Status byte of an answer to a command.

    Raises
    ------
    ProtocolError
        Not 64 bytes, or the answer to another command.
    """
    if len(answer) != REPORT:
        raise ProtocolError(f"MCP2210: an answer of {len(answer)} bytes instead of {REPORT}")
    if answer[0] != command:
        raise ProtocolError(f"MCP2210: answer to 0x{answer[0]:02X} where 0x{command:02X} was asked")
    return answer[1]


def status_words(status: int) -> str:
    """What a status means."""
    try:
        return STATUS_WORDS[AnswerStatus(status)]
    except (ValueError, KeyError):
        return f"status 0x{status:02X}"


def mark(number: int) -> bytes:
    """Request whose answer carries a number (u8): a read of the EEPROM, thrown away."""
    return request(Command.READ_EEPROM, bytes([number]))


def is_mark(answer: bytes, number: int) -> bool:
    """True for the answer to `mark(number)`."""
    return len(answer) == REPORT and answer[0] == Command.READ_EEPROM and answer[ECHO] == number


@dataclass(frozen=True)
class ChipSettings:
    """Pins in RAM (commands 0x20, 0x21): nine designations, default outputs and directions, flags."""

    designations: tuple[int, ...]
    outputs: int
    directions: int
    flags: int

    @classmethod
    def parse(cls, answer: bytes) -> ChipSettings:
        """Read an answer to `GET_CHIP`."""
        if status_of(answer, Command.GET_CHIP):
            raise ProtocolError(f"MCP2210: chip settings not read: {status_words(answer[1])}")
        designations, outputs, directions, flags = _CHIP.unpack_from(answer, 4)
        if any(kind > Designation.DEDICATED for kind in designations):
            raise ProtocolError("MCP2210: a pin's designation is none of GPIO, CS, dedicated")
        return cls(tuple(designations), outputs, directions, flags)

    def with_pin(self, pin: int, kind: Designation) -> ChipSettings:
        """The same with another designation of one pin."""
        designations = list(self.designations)
        designations[pin] = kind
        return replace(self, designations=tuple(designations))

    def request(self) -> bytes:
        """`SET_CHIP`."""
        body = _CHIP.pack(bytes(self.designations), self.outputs, self.directions, self.flags)
        return request(Command.SET_CHIP, bytes(3) + body)


@dataclass(frozen=True)
class SpiSettings:
    """SPI side in RAM (commands 0x40, 0x41); times are zero, the host keeps them (see the bus)."""

    bit_rate_hz: int
    idle_cs: int
    active_cs: int
    times_100us: tuple[int, int, int]
    transaction: int
    mode: int

    @classmethod
    def for_frames(cls, clock_hz: float, cs: int) -> SpiSettings:
        """Frames of two bytes in mode 3, CS on one GP.

        The chip divides 12 MHz, so the rate is the largest such one that is not above `clock_hz`.
        """
        rate = BASE_HZ // -int(-BASE_HZ // clock_hz)
        idle = (1 << PINS) - 1
        return cls(rate, idle, idle & ~(1 << cs), (0, 0, 0), FRAME_BYTES, 3)

    @classmethod
    def parse(cls, answer: bytes) -> SpiSettings:
        """Read an answer to `GET_SPI`."""
        if status_of(answer, Command.GET_SPI):
            raise ProtocolError(f"MCP2210: SPI settings not read: {status_words(answer[1])}")
        rate, idle, active, lead, hold, between, transaction, mode = _SPI.unpack_from(answer, 4)
        return cls(rate, idle, active, (lead, hold, between), transaction, mode)

    def request(self) -> bytes:
        """`SET_SPI`."""
        body = _SPI.pack(
            self.bit_rate_hz, self.idle_cs, self.active_cs, *self.times_100us, self.transaction, self.mode
        )
        return request(Command.SET_SPI, bytes(3) + body)


def transfer(data: bytes = b"") -> bytes:
    """Start a transaction, or ask for what came in."""
    return request(Command.TRANSFER, bytes([len(data), 0, 0]) + data)


@dataclass(frozen=True)
class Progress:
    """An answer to a transfer that was accepted."""

    engine: Engine
    data: bytes

    @classmethod
    def parse(cls, answer: bytes) -> Progress:
        """Read an answer with status DONE."""
        if status_of(answer, Command.TRANSFER):
            raise ProtocolError(f"MCP2210: transfer refused: {status_words(answer[1])}")
        count = answer[2]
        if count > FRAME_BYTES:
            raise ProtocolError(f"MCP2210: {count} bytes came in for a frame of {FRAME_BYTES}")
        try:
            engine = Engine(answer[3])
        except ValueError:
            raise ProtocolError(f"MCP2210: engine state 0x{answer[3]:02X} is not defined") from None
        if engine is Engine.STARTED and count:
            raise ProtocolError("MCP2210: data before the transfer has started")
        return cls(engine, answer[4 : 4 + count])

    @classmethod
    def of_poll(cls, answer: bytes) -> Progress:
        """Read the answer to a transfer without data.

        The engine refuses those too while it clocks (0xF8, data sheet DS22288A, figure 3-23): not yet.
        """
        if status_of(answer, Command.TRANSFER) == AnswerStatus.BUSY:
            return cls(Engine.STARTED, b"")
        return cls.parse(answer)


def parse_events(answer: bytes) -> int:
    """Count of an answer to `EVENTS`."""
    if status_of(answer, Command.EVENTS):
        raise ProtocolError(f"MCP2210: event counter not read: {status_words(answer[1])}")
    return int(_WORD.unpack_from(answer, 4)[0])


def parse_pins(answer: bytes, command: Command) -> int:
    """Nine bits of an answer to a GPIO command."""
    if status_of(answer, command):
        raise ProtocolError(f"MCP2210: GPIO not read: {status_words(answer[1])}")
    return int(_WORD.unpack_from(answer, 4)[0]) & (1 << PINS) - 1


def pins_request(command: Command, bits: int) -> bytes:
    """Set values or directions (1 is an input) of the nine pins."""
    return request(command, bytes(3) + _WORD.pack(bits))
