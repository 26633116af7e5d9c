"""The register table of the ADIS16350 family, one row for each register, and read and write frames.

Sources: DS is the data sheet of the ADIS16350/ADIS16355, Rev. B. The confidence rates the validity of a row
for the ADIS16354 (`CONFIDENCES`).

A frame is bit 15 write, bit 14 zero, bits 13:8 byte address, bits 7:0 data (DS, A). Replies are
pipelined: the word of frame k is shifted out during frame k + 1. Only `write_frames` sets the write bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from adis_gonio.base.errors import UsageError
from adis_gonio.device.bus import SpiTiming, Words

Confidence = Literal["A", "B", "C", "D"]
CONFIDENCES: dict[Confidence, str] = {
    "A": "the siblings' data sheet and independent code for this part agree",
    "B": "the siblings' data sheet only",
    "C": "derived, or code only",
    "D": "an estimate",
}
"""Evidence for a row of the table, by letter."""


class Access(StrEnum):
    """Access that a register allows: read, write, or both."""

    READ = "r"
    READ_WRITE = "rw"
    WRITE = "w"


class Kind(StrEnum):
    """Meaning of a register's content; the variant gives the LSB that belongs to it."""

    ACCEL = "accel"
    GYRO = "gyro"
    TEMPERATURE = "temperature"
    SUPPLY = "supply"
    AUX_ADC = "aux-adc"
    ACCEL_OFFSET = "accel-offset"
    GYRO_OFFSET = "gyro-offset"
    AUX_DAC = "aux-dac"
    COUNT = "count"
    FIELDS = "fields"


@dataclass(frozen=True)
class Field:
    """A bit field of a control register: name, highest and lowest bit, meaning."""

    name: str
    high: int
    low: int
    meaning: str

    @property
    def mask(self) -> int:
        """Bit mask of the field within its register."""
        return ((1 << (self.high - self.low + 1)) - 1) << self.low

    def of(self, word: int) -> int:
        """Extract the value of the field from the content of its register."""
        return (word & self.mask) >> self.low


@dataclass(frozen=True)
class Register:
    """A register of the chip: address, data format, access and meaning.

    Attributes
    ----------
    address : int
        Byte address of the low byte; the high byte is at `address + 1`.
    bits : int
        Width of the number, right-justified in the 16-bit word.
    signed : bool
        True if the number is in two's complement.
    flags : bool
        True for output registers: bit 15 is ND (new data), bit 14 EA (error or alarm).
    flash_mask : int
        Bits that have a flash copy, saved by COMMAND[3] alone.
    write_mask : int
        Bits that a write can change.
    """

    name: str
    address: int
    bits: int
    signed: bool
    access: Access
    kind: Kind
    meaning: str
    default: int = 0
    flags: bool = False
    write_mask: int = 0
    flash_mask: int = 0
    fields: tuple[Field, ...] = ()
    source: str = "DS"
    confidence: Confidence = "A"

    @property
    def data_mask(self) -> int:
        """Bit mask of the data bits in a word read from the register."""
        return (1 << self.bits) - 1

    @property
    def readable(self) -> bool:
        """True if the register may be read."""
        return self.access is not Access.WRITE

    @property
    def writable(self) -> bool:
        """True if the register may be written."""
        return self.access is not Access.READ

    def number(self, word: int) -> int:
        """Decode a word read from the register: flags and unused bits removed, sign extended."""
        data = word & self.data_mask
        return data - (1 << self.bits) if self.signed and data >> (self.bits - 1) else data

    def word(self, number: int) -> int:
        """Encode an integer as the word to write; `UsageError` if it does not fit."""
        low, high = self.range
        if not low <= number <= high:
            raise UsageError(f"{self.name} takes {low} to {high}, not {number}")
        return number & self.data_mask

    @property
    def range(self) -> tuple[int, int]:
        """Smallest and largest integer that the register can contain."""
        if self.signed:
            return -(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1
        return 0, self.data_mask

    def field(self, name: str) -> Field:
        """Return the bit field with this name; `KeyError` if there is none."""
        for entry in self.fields:
            if entry.name == name:
                return entry
        raise KeyError(f"{self.name} has no field '{name}'")


_AXES = "XYZ"


def _outputs() -> list[Register]:
    rows = [
        Register(
            "ENDURANCE", 0x00, 16, False, Access.READ, Kind.COUNT,
            "flash writes so far, wraps at 32768; the part is made for 10 000",
        ),
        Register(
            "SUPPLY_OUT", 0x02, 12, False, Access.READ, Kind.SUPPLY, "supply voltage", flags=True
        ),
    ]  # fmt: skip
    for kind, stem, base, bits, meaning in (
        (Kind.GYRO, "GYRO", 0x04, 14, "rate of turn about {0}"),
        (Kind.ACCEL, "ACCL", 0x0A, 14, "acceleration along {0}; level with Z up, Z reads −1 g"),
        (Kind.TEMPERATURE, "TEMP", 0x10, 12, "temperature of the die of gyro {0}, 0 = 25 °C"),
    ):
        for k, axis in enumerate(_AXES):
            rows.append(
                Register(
                    f"{axis}{stem}_OUT", base + 2 * k, bits, True, Access.READ, kind,
                    meaning.format(axis), flags=True,
                )
            )  # fmt: skip
    rows.append(
        Register("AUX_ADC", 0x16, 12, False, Access.READ, Kind.AUX_ADC, "auxiliary input", flags=True)
    )
    return rows


def _offsets() -> list[Register]:
    rows = []
    for k, axis in enumerate(_AXES):
        rows.append(
            Register(
                f"{axis}GYRO_OFF", 0x1A + 2 * k, 13, True, Access.READ_WRITE, Kind.GYRO_OFFSET,
                f"added to the output of gyro {axis}", write_mask=0x1FFF, flash_mask=0x1FFF,
            )
        )  # fmt: skip
    for k, axis in enumerate(_AXES):
        rows.append(
            Register(
                f"{axis}ACCL_OFF", 0x20 + 2 * k, 12, True, Access.READ_WRITE, Kind.ACCEL_OFFSET,
                f"added to the output of accelerometer {axis}; layout A, its LSB on the 16354 is C",
                write_mask=0x0FFF, flash_mask=0x0FFF, source="DS; LSB from code", confidence="C",
            )
        )  # fmt: skip
    return rows


_ALARM_SOURCES = "0 off, 1 supply, 2-4 gyro XYZ, 5-7 accel XYZ, 8-10 temperature XYZ, 11 aux"


def _control() -> list[Register]:
    def row(
        name: str,
        address: int,
        meaning: str,
        write_mask: int,
        flash_mask: int,
        fields: tuple[Field, ...] = (),
        *,
        bits: int = 16,
        access: Access = Access.READ_WRITE,
        kind: Kind = Kind.FIELDS,
        default: int = 0,
        confidence: Confidence = "B",
    ) -> Register:
        return Register(
            name, address, bits, False, access, kind, meaning, default, False,
            write_mask, flash_mask, fields, "DS", confidence,
        )  # fmt: skip

    rows = []
    for k in (1, 2):
        rows.append(
            row(
                f"ALM_MAG{k}", 0x24 + 2 * k, f"threshold of alarm {k}", 0xBFFF, 0xBFFF,
                (
                    Field("greater", 15, 15, "1 alarm above the threshold, 0 below"),
                    Field("threshold", 13, 0, "in the format of the source"),
                ),
            )
        )  # fmt: skip
    for k in (1, 2):
        rows.append(
            row(
                f"ALM_SMPL{k}", 0x28 + 2 * k, f"samples for the rate of change of alarm {k}",
                0x00FF, 0x00FF, (Field("samples", 7, 0, "number of samples"),),
            )
        )  # fmt: skip
    return [
        *rows,
        row(
            "ALM_CTRL", 0x2E, "control of both alarms", 0xFFD7, 0xFFD7,
            (
                Field("source2", 15, 12, _ALARM_SOURCES),
                Field("source1", 11, 8, _ALARM_SOURCES),
                Field("rate2", 7, 7, "1 alarm 2 on rate of change"),
                Field("rate1", 6, 6, "1 alarm 1 on rate of change"),
                Field("filtered", 4, 4, "1 compare filtered data"),
                Field("output", 2, 2, "1 drive a DIO line"),
                Field("polarity", 1, 1, "1 active high"),
                Field("line", 0, 0, "1 DIO2, 0 DIO1"),
            ),
        ),
        row(
            "AUX_DAC", 0x30, "auxiliary output, taken over by COMMAND[2]", 0x0FFF, 0,
            bits=12, kind=Kind.AUX_DAC,
        ),
        row(
            "GPIO_CTRL", 0x32, "DIO lines as general inputs and outputs", 0x0303, 0,
            (
                Field("level2", 9, 9, "level of DIO2"),
                Field("level1", 8, 8, "level of DIO1"),
                Field("output2", 1, 1, "1 DIO2 is an output"),
                Field("output1", 0, 0, "1 DIO1 is an output"),
            ),
            confidence="A",
        ),
        row(
            "MSC_CTRL", 0x34, "self-test, data-ready, compensation", 0x07C7, 0x00C7,
            (
                Field("self_test", 10, 10, "1 start the internal self-test; clears itself"),
                Field("negative", 9, 9, "1 manual self-test, negative"),
                Field("positive", 8, 8, "1 manual self-test, positive"),
                Field("linear_g", 7, 7, "1 compensate the gyros' g-sensitivity by factory data"),
                Field("origin", 6, 6, "1 compensate turns at the accelerometers' positions"),
                Field("data_ready", 2, 2, "1 data-ready on a DIO line"),
                Field("polarity", 1, 1, "1 active high"),
                Field("line", 0, 0, "1 DIO2, 0 DIO1"),
            ),
            confidence="A",
        ),
        row(
            "SMPL_PRD", 0x36, "period of the internal update: base * (N + 1)", 0x00FF, 0x00FF,
            (
                Field("slow", 7, 7, "time base 0 0.61035 ms, 1 18.921 ms"),
                Field("n", 6, 0, "N; 1 is the least that is allowed"),
            ),
            default=0x0001, confidence="A",
        ),
        row(
            "SENS_AVG", 0x38, "gyro range and filter (SENS/AVG of the data sheet)", 0x0707, 0x0707,
            (
                Field("range", 10, 8, "4 ±300, 2 ±150, 1 ±75 °/s"),
                Field("m", 2, 0, "two boxcars of 2^M taps, M from 0 to 6"),
            ),
            default=0x0402, confidence="A",
        ),
        row(
            "SLP_CNT", 0x3A, "sleep for a count of 0.5 s", 0x00FF, 0,
            (Field("halves", 7, 0, "time in 0.5 s"),),
        ),
        row(
            "STATUS", 0x3C, "faults and alarms; a read clears all bits", 0, 0,
            (
                Field("accel_z_self_test", 15, 15, "accelerometer Z failed its self-test"),
                Field("accel_y_self_test", 14, 14, "accelerometer Y failed its self-test"),
                Field("accel_x_self_test", 13, 13, "accelerometer X failed its self-test"),
                Field("gyro_z_self_test", 12, 12, "gyro Z failed its self-test"),
                Field("gyro_y_self_test", 11, 11, "gyro Y failed its self-test"),
                Field("gyro_x_self_test", 10, 10, "gyro X failed its self-test"),
                Field("alarm2", 9, 9, "alarm 2 is active"),
                Field("alarm1", 8, 8, "alarm 1 is active"),
                Field("self_test", 5, 5, "the self-test failed"),
                Field("over_range", 4, 4, "a sensor is over its range"),
                Field("spi", 3, 3, "an SPI transfer failed"),
                Field("flash", 2, 2, "a flash update failed"),
                Field("supply_high", 1, 1, "supply above 5.25 V"),
                Field("supply_low", 0, 0, "supply below 4.75 V"),
            ),
            access=Access.READ, confidence="A",
        ),
        row(
            "COMMAND", 0x3E, "commands, each starts by writing its bit", 0x009F, 0,
            (
                Field("reset", 7, 7, "software reset"),
                Field("precision_autonull", 4, 4, "null the gyros over about 30 s without motion"),
                Field("flash_update", 3, 3, "save to flash, about 100 ms"),
                Field("latch_dac", 2, 2, "take over AUX_DAC"),
                Field("restore", 1, 1, "factory restore: zero the six offsets"),
                Field("autonull", 0, 0, "null the gyros"),
            ),
            access=Access.WRITE, confidence="A",
        ),
    ]  # fmt: skip


REGISTERS: tuple[Register, ...] = (*_outputs(), *_offsets(), *_control())
"""All registers in order of their address; 0x18 is reserved."""

BY_NAME: dict[str, Register] = {register.name: register for register in REGISTERS}
BY_ADDRESS: dict[int, Register] = {register.address: register for register in REGISTERS}

ACCEL_OUT = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT")
GYRO_OUT = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT")
TEMP_OUT = ("XTEMP_OUT", "YTEMP_OUT", "ZTEMP_OUT")
ACCEL_OFF = ("XACCL_OFF", "YACCL_OFF", "ZACCL_OFF")
GYRO_OFF = ("XGYRO_OFF", "YGYRO_OFF", "ZGYRO_OFF")

READING_BITS: dict[str, int] = {
    **dict.fromkeys((*ACCEL_OFF, *GYRO_OFF), -1),
    "SMPL_PRD": 0xFF,
    "SENS_AVG": 0x0707,
    "MSC_CTRL": 0x03C0,
}
"""Bits that shift or scale a reading: offsets, rate, range, filter, compensations and manual self-test."""


def changed_settings(then: Mapping[str, int], now: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Registers of `READING_BITS` that differ between two readings, each with old and new content.

    A register that is missing on one side is not compared.
    """
    pairs = {
        name: (then[name] & bits, now[name] & bits)
        for name, bits in READING_BITS.items()
        if name in then and name in now
    }
    return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}


ND = 1 << 15
EA = 1 << 14
WRITE = 1 << 15


def register(name: str | Register) -> Register:
    """Return the register with this name, in any case (also `SENS/AVG`); `UsageError` suggests a name."""
    if isinstance(name, Register):
        return name
    key = name.strip().upper().replace("/", "_")
    try:
        return BY_NAME[key]
    except KeyError:
        import difflib

        near = difflib.get_close_matches(key, BY_NAME, n=1)
        hint = f"did you mean {near[0]}?" if near else "see `adis-gonio registers`"
        raise UsageError(f"no register is called '{name}'; {hint}") from None


def registers(names: Iterable[str | Register]) -> tuple[Register, ...]:
    """Return the registers with these names."""
    return tuple(register(name) for name in names)


IDLE = 0x0000
"""Idle frame: a harmless read of ENDURANCE. Never idle with ones: 0xFFFF looks like a write to COMMAND."""

FAST = SpiTiming(clock_hz=1_000_000, stall_us=9.0, period_us=40.0)
"""Fast mode, SMPL_PRD <= 0x09: up to 2 MHz, frame period at least 40 µs, stall at least 9 µs (DS, A)."""

NORMAL = SpiTiming(clock_hz=250_000, stall_us=75.0, period_us=160.0)
"""Normal mode, SMPL_PRD >= 0x0A: up to 300 kHz, period at least 160 µs, stall at least 75 µs (DS, A).

It also keeps the limits of fast mode, so it is safe if the mode is unknown."""

FAST_UP_TO = 0x09
"""Largest SMPL_PRD, time-base bit included, that runs in fast mode (DS, A)."""


def timing_for(smpl_prd: int) -> SpiTiming:
    """SPI timing that the chip needs at a value of SMPL_PRD; the whole byte counts, not only N."""
    return FAST if (smpl_prd & 0xFF) <= FAST_UP_TO else NORMAL


def read_frame(register: Register) -> int:
    """16-bit frame that reads this register."""
    if not register.readable:
        raise UsageError(f"{register.name} cannot be read")
    return (register.address & 0x3F) << 8


def read_frames(registers: Sequence[Register]) -> Words:
    """Frames (k,) uint16 that read k registers; each reply comes one frame later than its request."""
    return np.array([read_frame(register) for register in registers], np.uint16)


def write_frames(register: Register, word: int, *, byte_mask: int = 0xFFFF) -> Words:
    """Frames (k,) uint16 that write a register: low byte first, then high byte.

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
