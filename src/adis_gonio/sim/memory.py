"""The registers of the simulated chip: words, flash copies, byte writes, and limits of the SPI port.

The letters A to D after a figure are its confidence (see `docs/glossary.md`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import BY_ADDRESS, BY_NAME, REGISTERS, Register, register

TOLERANCE_S = 1e-9
"""Tolerance in s when a stall or period is compared with its limit; it covers the rounding of float64."""

START_UP_S = 0.150
"""Duration in s of start-up (B) and of a reset, which the data sheet does not give (D)."""
FLASH_S = 0.100
"""Duration of a flash update in s (A)."""
SELF_TEST_S = 0.035
"""Duration of the internal self-test in s (B)."""
PRECISION_S = 30.0
"""Duration of the precision autonull in s (A: about 30 s)."""
WAKE_S = 0.003
"""Duration of the recovery from sleep in s (B)."""
SLEEP_UNIT_S = 0.5
"""Time in s of one LSB of SLP_CNT (B)."""
BASE_S = (1 / 1638.4, 31 / 1638.4)
"""Time bases of SMPL_PRD in s, fast and slow: 0.61035 and 18.921 ms (A)."""
FIRST_NORMAL = 0x0A
"""Smallest SMPL_PRD, time-base bit included, at which the SPI port is in normal mode, the slow one (A)."""


@dataclass(frozen=True)
class SerialLimits:
    """Limits of the SPI port in one speed mode of the chip: SPI clock in Hz, times in s.

    `clock_low_hz` and `clock_high_hz` are the ends of the permitted clock; `stall_s` and `period_s` are the
    shortest pause between frames and the shortest time from frame to frame.
    """

    name: str
    clock_low_hz: float
    clock_high_hz: float
    stall_s: float
    period_s: float
    sleep_cs_s: float
    """Longest time in s from the 16th clock to the rise of chip select at which SLP_CNT acts (B)."""

    def clock_ok(self, clock_hz: float) -> bool:
        """Return True if the chip can follow an SPI clock of this frequency in Hz in this mode."""
        return self.clock_low_hz * (1 - 1e-9) <= clock_hz <= self.clock_high_hz * (1 + 1e-9)


FAST = SerialLimits("fast", 10e3, 2e6, 9e-6, 40e-6, 10e-6)
NORMAL = SerialLimits("normal", 10e3, 300e3, 75e-6, 160e-6, 80e-6)


def serial_limits(smpl_prd: int) -> SerialLimits:
    """Return the limits of the SPI port that apply at a value of SMPL_PRD."""
    return FAST if smpl_prd & 0xFF < FIRST_NORMAL else NORMAL


def update_period_s(smpl_prd: int) -> float:
    """Return the time in s between internal updates for a value of SMPL_PRD.

    The forbidden value 0 is assumed to act as 1.
    """
    value = max(smpl_prd & 0xFF, 1)
    return BASE_S[value >> 7] * ((value & 0x7F) + 1)


ENDURANCE_WRAP = 32768


class Memory:
    """Contents of all registers, and the flash copies of some of them.

    Parameters
    ----------
    flash : mapping of str to int
        Words by register name that were saved before power-on; all other registers have their defaults.
    endurance : int
        Number of flash updates so far.

    Raises
    ------
    UsageError
        A name is unknown, or a word has bits without a flash copy.
    """

    changed: Callable[[], None] = staticmethod(lambda: None)
    """Function called after a register has changed in any way, so that the chip acts on the new content."""

    def __init__(self, flash: Mapping[str, int] | None = None, endurance: int = 0) -> None:
        self._flash = {row.name: row.default & row.flash_mask for row in REGISTERS if row.flash_mask}
        for name, word in (flash or {}).items():
            row = register(name)
            if word & ~row.flash_mask:
                raise UsageError(f"{row.name} has no flash copy of 0x{word & ~row.flash_mask:04X}")
            self._flash[row.name] = word
        self._words = {"ENDURANCE": endurance % ENDURANCE_WRAP}
        self.load()

    def __getitem__(self, name: str) -> int:
        return self._words[name]

    def __setitem__(self, name: str, word: int) -> None:
        self._words[name] = word & 0xFFFF
        self.changed()

    def at(self, address: int) -> int:
        """Return the 16-bit content of the register at an even or odd byte address.

        The result is 0 if no register is readable there.
        """
        row = BY_ADDRESS.get(address & ~1)
        return self._words[row.name] if row is not None and row.readable else 0

    def field(self, name: str, field: str) -> int:
        """Return the number in a field of a register, both given by name."""
        return BY_NAME[name].field(field).of(self._words[name])

    def write_byte(self, address: int, data: int) -> Register | None:
        """Write one byte of a register: the low byte at its even address, the high byte at the odd one.

        Only bits of the register's write mask change; COMMAND keeps nothing.

        Returns
        -------
        Register or None
            Register that was written; None for a read-only or reserved address.
        """
        row = BY_ADDRESS.get(address & ~1)
        if row is None or not row.writable:
            return None
        if row.readable:
            shift = 8 * (address & 1)
            mask = row.write_mask & (0xFF << shift)
            self[row.name] = (self._words[row.name] & ~mask) | ((data << shift) & mask)
        return row

    def load(self) -> None:
        """Load the registers from flash, as a reset does; bits without a flash copy take their defaults."""
        endurance = self._words["ENDURANCE"]
        for row in REGISTERS:
            self._words[row.name] = (row.default & ~row.flash_mask) | self._flash.get(row.name, 0)
        self._words["ENDURANCE"] = endurance
        self.changed()

    def save(self) -> None:
        """Copy the registers to flash and add one to ENDURANCE, the count of flash updates."""
        for name in self._flash:
            self._flash[name] = self._words[name] & BY_NAME[name].flash_mask
        self._words["ENDURANCE"] = (self._words["ENDURANCE"] + 1) % ENDURANCE_WRAP
