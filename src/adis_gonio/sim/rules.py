"""Limits of the serial port: what the chip demands of the frames that it is sent (CHIP.md, A)."""

from __future__ import annotations

from dataclasses import dataclass

TOLERANCE_S = 1e-9
"""A stall or a period is called too short beyond this; covers the rounding of times in float64."""

START_UP_S = 0.150
"""Start-up, and recovery of a reset, which the data sheet does not give (B; the reset D)."""
FLASH_S = 0.100
"""Flash update (A)."""
SELF_TEST_S = 0.035
"""Internal self-test (B)."""
PRECISION_S = 30.0
"""Precision autonull (A: about 30 s)."""
WAKE_S = 0.003
"""Recovery from sleep (B)."""
SLEEP_UNIT_S = 0.5
"""LSB of SLP_CNT (B)."""
BASE_S = (1 / 1638.4, 31 / 1638.4)
"""Time bases of SMPL_PRD: 0.61035 and 18.921 ms (A)."""
FIRST_NORMAL = 0x0A
"""SMPL_PRD from here on, time-base bit included, needs the slow serial port (A)."""


@dataclass(frozen=True)
class SerialLimits:
    """Limits of one mode: clock in Hz, times in s."""

    name: str
    clock_low_hz: float
    clock_high_hz: float
    stall_s: float
    period_s: float
    sleep_cs_s: float
    """CS must be high so soon after the 16th clock for SLP_CNT to act (B)."""

    def clock_ok(self, clock_hz: float) -> bool:
        """True where the chip can follow the clock."""
        return self.clock_low_hz * (1 - 1e-9) <= clock_hz <= self.clock_high_hz * (1 + 1e-9)


FAST = SerialLimits("fast", 10e3, 2e6, 9e-6, 40e-6, 10e-6)
NORMAL = SerialLimits("normal", 10e3, 300e3, 75e-6, 160e-6, 80e-6)


def serial_limits(smpl_prd: int) -> SerialLimits:
    """Limits that hold for a value of SMPL_PRD."""
    return FAST if smpl_prd & 0xFF < FIRST_NORMAL else NORMAL


def update_period_s(smpl_prd: int) -> float:
    """Time between internal updates in s; SMPL_PRD = 0, which is not allowed, acts as 1 (D)."""
    value = smpl_prd & 0xFF
    if value == 0:
        value = 1
    return BASE_S[value >> 7] * ((value & 0x7F) + 1)
