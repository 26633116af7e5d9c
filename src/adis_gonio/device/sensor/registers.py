"""Variants of the sensor, and the table of its registers.

The table of variants has all differences between the parts of the family, one row for each part. The
register table of the ADIS16350 family has one row for each register. Functions make read and write frames.

Sources: DS is the data sheet of the ADIS16350/ADIS16355, Rev. B. A letter from A to D is the
confidence that a statement is valid for the ADIS16354: A is the highest, D an estimate (`CONFIDENCES`).

A frame is bit 15 write, bit 14 zero, bits 13:8 byte address, bits 7:0 data (DS, A). Replies are pipelined:
the word of frame k is shifted out during frame k + 1. Only `write_frames` sets the write bit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Literal, cast

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.device.bus import SpiTiming, Words

Confidence = Literal["A", "B", "C", "D"]
CONFIDENCES: dict[Confidence, str] = {
    "A": "the data sheet of the ADIS16350 and independent code for this part agree",
    "B": "the data sheet of the ADIS16350 only",
    "C": "derived, or code only",
    "D": "an estimate",
}
"""Evidence for a row of the register table, by the letter of its confidence."""


class Kind(StrEnum):
    """Meaning of a register's content, such as an acceleration; with the variant it determines the LSB."""

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
    """A bit field of a control register: name, numbers of its highest and lowest bit, meaning."""

    name: str
    high: int
    low: int
    meaning: str

    @classmethod
    def parse(cls, line: str) -> Field:
        """Read a field from a line of the table, such as `15:12 source2 0 off, 1 supply`."""
        bits, name, meaning = line.split(maxsplit=2)
        high, _, low = bits.partition(":")
        return cls(name, int(high), int(low or high), meaning)

    @property
    def mask(self) -> int:
        """Bit mask of the field within its register."""
        return ((1 << (self.high - self.low + 1)) - 1) << self.low

    def of(self, word: int) -> int:
        """Extract the value of the field from the content of its register."""
        return (word & self.mask) >> self.low


@dataclass(frozen=True)
class Register:
    """A register of the chip: address, data format, access, meaning, and the source of these facts.

    Attributes
    ----------
    address : int
        Byte address of the low byte; the high byte is at `address + 1`.
    bits : int
        Width of the number in bits; it is right-justified in the 16-bit word.
    signed : bool
        True if the number is in two's complement.
    flags : bool
        True for output registers: bit 15 is ND (new data), bit 14 EA (error or alarm).
    flash_mask : int
        Bits that have a flash copy. Only a flash update (bit 3 of COMMAND) saves them.
    write_mask : int
        Bits that a write can change.
    """

    name: str
    address: int
    bits: int
    signed: bool
    access: Literal["r", "rw", "w"]
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
        return self.access != "w"

    @property
    def writable(self) -> bool:
        """True if the register may be written."""
        return self.access != "r"

    def number(self, word: int) -> int:
        """Return the integer in a word of the register: flags and unused bits removed, sign extended."""
        data = word & self.data_mask
        return data - (1 << self.bits) if self.signed and data >> (self.bits - 1) else data

    def word(self, number: int) -> int:
        """Return the word to write for an integer; `UsageError` if the register cannot hold the integer."""
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


_TABLE = """
ENDURANCE  00 u16 r  count        0000 0000 0000 A flash writes so far, wraps at 32768; made for 10 000
SUPPLY_OUT 02 u12 r  supply       0000 0000 0000 A supply voltage
XGYRO_OUT  04 s14 r  gyro         0000 0000 0000 A rate of turn about X
YGYRO_OUT  06 s14 r  gyro         0000 0000 0000 A rate of turn about Y
ZGYRO_OUT  08 s14 r  gyro         0000 0000 0000 A rate of turn about Z
XACCL_OUT  0A s14 r  accel        0000 0000 0000 A acceleration along X; level with Z up, Z reads −1 g
YACCL_OUT  0C s14 r  accel        0000 0000 0000 A acceleration along Y; level with Z up, Z reads −1 g
ZACCL_OUT  0E s14 r  accel        0000 0000 0000 A acceleration along Z; level with Z up, Z reads −1 g
XTEMP_OUT  10 s12 r  temperature  0000 0000 0000 A temperature of the die of gyro X, 0 = 25 °C
YTEMP_OUT  12 s12 r  temperature  0000 0000 0000 A temperature of the die of gyro Y, 0 = 25 °C
ZTEMP_OUT  14 s12 r  temperature  0000 0000 0000 A temperature of the die of gyro Z, 0 = 25 °C
AUX_ADC    16 u12 r  aux-adc      0000 0000 0000 A auxiliary input
XGYRO_OFF  1A s13 rw gyro-offset  1FFF 1FFF 0000 A added to the output of gyro X
YGYRO_OFF  1C s13 rw gyro-offset  1FFF 1FFF 0000 A added to the output of gyro Y
ZGYRO_OFF  1E s13 rw gyro-offset  1FFF 1FFF 0000 A added to the output of gyro Z
XACCL_OFF  20 s12 rw accel-offset 0FFF 0FFF 0000 C added to the output of accelerometer X (layout A, LSB C)
YACCL_OFF  22 s12 rw accel-offset 0FFF 0FFF 0000 C added to the output of accelerometer Y (layout A, LSB C)
ZACCL_OFF  24 s12 rw accel-offset 0FFF 0FFF 0000 C added to the output of accelerometer Z (layout A, LSB C)
ALM_MAG1   26 u16 rw fields       BFFF BFFF 0000 B threshold of alarm 1
    15    greater            1 alarm above the threshold, 0 below
    13:0  threshold          in the format of the source
ALM_MAG2   28 u16 rw fields       BFFF BFFF 0000 B threshold of alarm 2
    15    greater            1 alarm above the threshold, 0 below
    13:0  threshold          in the format of the source
ALM_SMPL1  2A u16 rw fields       00FF 00FF 0000 B samples for the rate of change of alarm 1
    7:0   samples            number of samples
ALM_SMPL2  2C u16 rw fields       00FF 00FF 0000 B samples for the rate of change of alarm 2
    7:0   samples            number of samples
ALM_CTRL   2E u16 rw fields       FFD7 FFD7 0000 B control of both alarms
    15:12 source2            0 off, 1 supply, 2-4 gyro XYZ, 5-7 accel XYZ, 8-10 temperature XYZ, 11 aux
    11:8  source1            0 off, 1 supply, 2-4 gyro XYZ, 5-7 accel XYZ, 8-10 temperature XYZ, 11 aux
    7     rate2              1 alarm 2 on rate of change
    6     rate1              1 alarm 1 on rate of change
    4     filtered           1 compare filtered data
    2     output             1 drive a DIO line
    1     polarity           1 active high
    0     line               1 DIO2, 0 DIO1
AUX_DAC    30 u12 rw aux-dac      0FFF 0000 0000 B auxiliary output, taken over by COMMAND[2]
GPIO_CTRL  32 u16 rw fields       0303 0000 0000 A DIO lines as general inputs and outputs
    9     level2             level of DIO2
    8     level1             level of DIO1
    1     output2            1 DIO2 is an output
    0     output1            1 DIO1 is an output
MSC_CTRL   34 u16 rw fields       07C7 00C7 0000 A self-test, data-ready, compensation
    10    self_test          1 start the internal self-test; clears itself
    9     negative           1 manual self-test, negative
    8     positive           1 manual self-test, positive
    7     linear_g           1 compensate the gyros' g-sensitivity by factory data
    6     origin             1 compensate turns at the accelerometers' positions
    2     data_ready         1 data-ready on a DIO line
    1     polarity           1 active high
    0     line               1 DIO2, 0 DIO1
SMPL_PRD   36 u16 rw fields       00FF 00FF 0001 A period of the internal update: base * (N + 1)
    7     slow               time base 0 0.61035 ms, 1 18.921 ms
    6:0   n                  N; 1 is the least that is allowed
SENS_AVG   38 u16 rw fields       0707 0707 0402 A gyro range and filter (SENS/AVG of the data sheet)
    10:8  range              4 ±300, 2 ±150, 1 ±75 °/s
    2:0   m                  two boxcars of 2^M taps, M from 0 to 6
SLP_CNT    3A u16 rw fields       00FF 0000 0000 B sleep for a count of 0.5 s
    7:0   halves             time in 0.5 s
STATUS     3C u16 r  fields       0000 0000 0000 A faults and alarms; a read clears all bits
    15    accel_z_self_test  accelerometer Z failed its self-test
    14    accel_y_self_test  accelerometer Y failed its self-test
    13    accel_x_self_test  accelerometer X failed its self-test
    12    gyro_z_self_test   gyro Z failed its self-test
    11    gyro_y_self_test   gyro Y failed its self-test
    10    gyro_x_self_test   gyro X failed its self-test
    9     alarm2             alarm 2 is active
    8     alarm1             alarm 1 is active
    5     self_test          the self-test failed
    4     over_range         a sensor is over its range
    3     spi                an SPI transfer failed
    2     flash              a flash update failed
    1     supply_high        supply above 5.25 V
    0     supply_low         supply below 4.75 V
COMMAND    3E u16 w  fields       009F 0000 0000 A commands, each starts by writing its bit
    7     reset              software reset
    4     precision_autonull null the gyros over about 30 s without motion
    3     flash_update       save to flash, about 100 ms
    2     latch_dac          take over AUX_DAC
    1     restore            factory restore: zero the six offsets
    0     autonull           null the gyros
"""
"""Text with a line for each register.

A line has name, byte address (hexadecimal), width of its number (`s` signed, `u` not), access, kind,
writable bits, bits with a flash copy, default (all hexadecimal), confidence, and meaning. Indented lines
are its bit fields: bits, name, meaning.
"""
_OUTPUTS = (Kind.SUPPLY, Kind.GYRO, Kind.ACCEL, Kind.TEMPERATURE, Kind.AUX_ADC)


def _parse(table: str) -> Iterator[Register]:
    for block in re.split(r"\n(?=\w)", table.strip()):
        line, *parts = block.splitlines()
        name, address, width, access, kind, *words, confidence, meaning = line.split(maxsplit=9)
        writable, flash, default = (int(word, 16) for word in words)
        fields = [Field.parse(part) for part in parts]
        source = "DS; LSB from code" if kind == Kind.ACCEL_OFFSET else "DS"
        yield Register(
            name, int(address, 16), int(width[1:]), width[0] == "s", cast(Any, access), Kind(kind), meaning,
            default, kind in _OUTPUTS, writable, flash, tuple(fields), source, cast(Confidence, confidence),
        )  # fmt: skip


REGISTERS: tuple[Register, ...] = tuple(_parse(_TABLE))
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
"""Bits that shift or scale a reading: offsets, rate, range, filter, compensations and manual self-test.

They are bit masks by register name; -1 is all bits.
"""


def changed_settings(then: Mapping[str, int], now: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Return the old and new contents of the registers with changes that shift or scale the readings.

    `then` and `now` map register names to contents at an earlier and a later time. Only the bits in
    `READING_BITS` are compared, and only these bits are returned. A register that is missing in `then` or
    `now` is not compared.
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
    """Return the register with this name, in any case (also `SENS/AVG`).

    An unknown name raises `UsageError`, which suggests a similar name.
    """
    if isinstance(name, Register):
        return name
    key = name.strip().upper().replace("/", "_")
    try:
        return BY_NAME[key]
    except KeyError:
        hint = suggest(key, BY_NAME, "see `adis-gonio registers`")
        raise UsageError(f"no register is called '{name}'; {hint}") from None


def registers(names: Iterable[str | Register]) -> tuple[Register, ...]:
    """Return the registers with these names; `UsageError` for an unknown name."""
    return tuple(register(name) for name in names)


IDLE = 0x0000
"""Idle frame: a harmless read of ENDURANCE.

Never use ones: 0xFFFF looks like a write to COMMAND.
"""

FAST = SpiTiming(clock_hz=1_000_000, stall_us=9.0, period_us=40.0)
"""SPI timing in fast mode, SMPL_PRD <= 0x09 (DS, A).

The chip allows up to 2 MHz, with a frame period of at least 40 µs and a stall of at least 9 µs.
"""

NORMAL = SpiTiming(clock_hz=250_000, stall_us=75.0, period_us=160.0)
"""SPI timing in normal mode, SMPL_PRD >= 0x0A (DS, A).

The chip allows up to 300 kHz, with a frame period of at least 160 µs and a stall of at least 75 µs. This
timing also keeps the limits of fast mode, so it is safe if the mode is unknown.
"""

SUPPLY_LIMITS_V = (4.75, 5.25)
"""Lower and upper limit of the specified supply voltage in V (DS, B)."""

TEMPERATURE_LIMITS_C = (-40.0, 85.0)
"""Lower and upper limit of the range of operation in °C (DS, B)."""

FAST_UP_TO = 0x09
"""Largest SMPL_PRD, time-base bit included, at which the chip runs in fast mode (DS, A)."""


def timing_for(smpl_prd: int) -> SpiTiming:
    """Return the SPI timing that the chip needs at a value of SMPL_PRD.

    The whole byte counts, including the time-base bit.
    """
    return FAST if (smpl_prd & 0xFF) <= FAST_UP_TO else NORMAL


def addressed(frame: int) -> tuple[Register | None, bool]:
    """Return the register that a frame addresses, and True if it addresses the high byte.

    The register is None if no register has the address.
    """
    address = frame >> 8 & 0x3F
    return BY_ADDRESS.get(address & ~1), bool(address & 1)


def read_frame(register: Register) -> int:
    """Return the 16-bit frame that reads this register; `UsageError` if it is write-only."""
    if not register.readable:
        raise UsageError(f"{register.name} cannot be read")
    return (register.address & 0x3F) << 8


def read_frames(registers: Sequence[Register]) -> Words:
    """Return the frames (k,) uint16 that read k registers; each reply comes one frame after its request."""
    return np.array([read_frame(register) for register in registers], np.uint16)


def write_frames(register: Register, word: int, *, byte_mask: int = 0xFFFF) -> Words:
    """Return the frames (k,) uint16 that write a register: low byte first, then high byte.

    Bytes in which the register has no writable bit are left out, and so are bytes outside `byte_mask`
    (0x00FF low, 0xFF00 high).

    Raises
    ------
    UsageError
        The register is read-only, or `word` sets a bit that the register cannot write.
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


GYRO_LSB_DPS: dict[int, float] = {300: 0.07326, 150: 0.03663, 75: 0.018315}
"""Rate of turn in °/s of one LSB of a gyro output, by gyro range in °/s (DS, A)."""

RANGE_CODE: dict[int, int] = {300: 4, 150: 2, 75: 1}
"""Content of SENS_AVG[10:8] by gyro range in °/s (DS, A)."""

LEAST_M: dict[int, int] = {300: 0, 150: 2, 75: 4}
"""Smallest filter size M that a gyro range in °/s allows (DS, A)."""


@dataclass(frozen=True)
class Performance:
    """Typical errors of a sensor, for the simulator; for the ADIS16354 all are estimates (confidence D).

    Attributes
    ----------
    noise_mg, bias_instability_mg, initial_bias_mg : float
        Noise of an unfiltered accelerometer sample (rms), floor of the Allan deviation, and standard
        deviation of the bias between sensors, in mg.
    scale_error_typical : float
        Standard deviation of the relative error of an axis's sensitivity.
    non_orthogonality_deg : float
        Largest deviation of the angle between two axes from 90°, in degrees.
    bias_tempco_mg_per_c, scale_tempco_ppm_per_c : float
        Temperature coefficients of bias and sensitivity of an accelerometer.
    gyro_noise_dps : float
        Noise of an unfiltered gyro sample (rms) in °/s.
    gyro_g_sensitivity_dps_per_g, gyro_supply_sensitivity_dps_per_v : float
        Sensitivity of a gyro's zero rate to acceleration and to the supply voltage.
    gyro_instability_dps : float
        Floor of the gyros' Allan deviation in °/s.
    """

    noise_mg: float
    bias_instability_mg: float
    initial_bias_mg: float
    scale_error_typical: float
    non_orthogonality_deg: float
    bias_tempco_mg_per_c: float
    scale_tempco_ppm_per_c: float
    gyro_noise_dps: float = 0.6
    gyro_g_sensitivity_dps_per_g: float = 0.05
    gyro_supply_sensitivity_dps_per_v: float = 0.25
    gyro_instability_dps: float = 0.015

    @property
    def noise(self) -> Floats:
        """White noise (rms) of an unfiltered sample: (6,), accelerometers in mg, gyros in °/s."""
        return np.array([self.noise_mg] * 3 + [self.gyro_noise_dps] * 3)

    @property
    def floor(self) -> Floats:
        """Floor of the Allan deviation of the six axes: (6,), accelerometers in mg, gyros in °/s."""
        return np.array([self.bias_instability_mg] * 3 + [self.gyro_instability_dps] * 3)

    @property
    def skew_u_rad(self) -> float:
        """Standard uncertainty in rad of an unmeasured skew.

        The skew is taken as uniform within ± the non-orthogonality.
        """
        return math.radians(self.non_orthogonality_deg) / math.sqrt(3)


@dataclass(frozen=True)
class Variant:
    """A sensor type of the family: scale and range of its accelerometers, and its typical errors.

    `source` and `confidence` are the origin of the scale and the trust in it (A to D).
    """

    name: str
    accel_mg_per_lsb: float
    accel_range_g: float
    source: str
    confidence: str
    performance: Performance

    @property
    def one_g_lsb(self) -> float:
        """Accelerometer reading in LSB at standard gravity."""
        return 1000.0 / self.accel_mg_per_lsb

    def lsb(self, kind: Kind, gyro_range_dps: int = 300) -> tuple[float, float, str]:
        """Return the scale of a kind of register: value of an LSB, value of the number 0, and unit.

        A register that contains the number N has the value of 0 plus N times the value of an LSB.
        `gyro_range_dps` matters only for gyros.
        """
        if kind is Kind.GYRO:
            return GYRO_LSB_DPS[gyro_range_dps], 0.0, "°/s"
        if kind in (Kind.ACCEL, Kind.ACCEL_OFFSET):
            return self.accel_mg_per_lsb, 0.0, "mg"
        return _LSB[kind]


_LSB: dict[Kind, tuple[float, float, str]] = {
    Kind.GYRO_OFFSET: (0.018315, 0.0, "°/s"),
    Kind.TEMPERATURE: (0.1453, 25.0, "°C"),
    Kind.SUPPLY: (1.8315e-3, 0.0, "V"),
    Kind.AUX_ADC: (0.6105e-3, 0.0, "V"),
    Kind.AUX_DAC: (2.5 / 4095, 0.0, "V"),
    Kind.COUNT: (1.0, 0.0, ""),
    Kind.FIELDS: (1.0, 0.0, ""),
}

VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(
            "adis16354", 0.4672, 1.7, "three independent public code bases", "A",
            Performance(4.7, 0.1, 10.0, 0.001, 0.25, 0.5, 40.0),
        ),
        Variant(
            "adis16350", 2.522, 10.0, "DS", "A",
            Performance(35.0, 0.7, 40.0, 0.01, 0.25, 4.0, 100.0),
        ),
        Variant(
            "adis16355", 2.522, 10.0, "DS", "A",
            Performance(35.0, 0.7, 40.0, 0.01, 0.25, 0.5, 40.0),
        ),
    )
}  # fmt: skip


def variant(name: str | Variant) -> Variant:
    """Return the variant with this name (`adis16354`, also `16354`).

    An unknown name raises `UsageError`, which lists the known variants.
    """
    if isinstance(name, Variant):
        return name
    key = name.strip().lower()
    found = VARIANTS.get(key) or VARIANTS.get(f"adis{key}")
    if found is None:
        raise UsageError(f"no variant is called '{name}'; known: {', '.join(VARIANTS)}")
    return found
