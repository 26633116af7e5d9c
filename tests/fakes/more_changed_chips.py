"""Further simulated chips with one rule changed, and sound chips in unusual circumstances.

The changes are like those between revisions, clones and siblings of a chip. They are written from the
description of the part and from the simulated chip alone, by a hand that has not seen the program that
looks for them. `changed_chips` has the form of a change and the two sessions that exercise it.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import BY_ADDRESS, BY_NAME, REGISTERS
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.chip import State
from adis_gonio.sim.memory import BASE_S
from adis_gonio.sim.sampling import ACCEL_COLUMNS, ALARM_BITS, STATUS, Inputs, SignalChain, Updates
from fakes.changed_chips import (
    Change,
    _AfterWrite,
    _offset_factor,
    _OtherFilter,
    _OtherPeriod,
    _Slow,
    _TestSlow,
    _with_chain,
)

# -- words on the wire -----------------------------------------------------------------------------------


class WriteReturnsOld(_AfterWrite):
    """The reply to a write is the word that the register had before the write."""

    def _answer(self, word, *details):
        self._old = self.memory.at(word >> 8 & 0x3F)
        return super()._answer(word, *details)

    def _after(self, word):
        return self._old


class SensAvgBitThree(SimulatedChip):
    """The reserved bit next to the field M of SENS_AVG always reads one."""

    def _control_word(self, address):
        word = super()._control_word(address)
        return word | 0x0008 if address & ~1 == BY_NAME["SENS_AVG"].address else word


class OffsetsOfFourteenBits(SimulatedChip):
    """Offsets read in the format of the outputs: sign-extended to 14 bits, with zeros in bits 15:14."""

    def _control_word(self, address):
        row = BY_ADDRESS.get(address & ~1)
        word = super()._control_word(address)
        return row.number(word) & 0x3FFF if row is not None and row.signed else word


# -- flags and STATUS ------------------------------------------------------------------------------------


class AlarmOffClears(SimulatedChip):
    """An alarm's bit of STATUS also falls when the alarm is switched off."""

    def _write(self, address, *details):
        super()._write(address, *details)
        row = BY_NAME["ALM_CTRL"]
        if address & ~1 == row.address:
            for k, bit in enumerate(ALARM_BITS, 1):
                if not row.field(f"source{k}").of(self.memory[row.name]):
                    self._status &= ~bit


class OverRangeStays(SimulatedChip):
    """The over-range bit stays until a read.

    The bit follows the output words, offsets included: the data sheet gives no threshold.
    """

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self._sampler.__class__ = OverRangeOfOutputs
        self._falling &= ~STATUS.field("over_range").mask


class OverRangeOfOutputs(SignalChain):
    def update(self, inputs: Inputs) -> Updates:
        updates = super().update(inputs)
        limit = 1000 * self._variant.accel_range_g * self._gain[ACCEL_COLUMNS] / 1024
        # Sign-extend the 14-bit numbers of the accelerometers.
        numbers = (updates.words[:, ACCEL_COLUMNS].astype(np.int64) & 0x3FFF ^ 0x2000) - 0x2000
        over = (np.abs(numbers) > limit).any(axis=1)
        return replace(updates, status=updates.status | over * STATUS.field("over_range").mask)


# -- flash, reset, busy times ----------------------------------------------------------------------------


class CountsChangesOnly(SimulatedChip):
    """A flash update that would change nothing spares the flash and is not counted."""

    def _save(self):
        memory = self.memory
        rows = [row for row in REGISTERS if row.flash_mask]
        if any((memory[row.name] & row.flash_mask) != memory._flash[row.name] for row in rows):
            super()._save()


class SelfTestOf70Ms(_TestSlow):
    length_s = 0.070


class PrecisionOf45S(_Slow):
    begun, length_s = State.NULLING, 45.0


# -- signals ---------------------------------------------------------------------------------------------


class HalfSecondBoxcar(_OtherFilter):
    """The second boxcar has half as many taps as the first one."""

    @staticmethod
    def window(m):
        n = 1 << m
        return np.convolve(np.ones(n), np.ones(max(n // 2, 1)))


class SlowBaseOf32(_OtherPeriod):
    """The slow time base is 32 times the fast one (19.53 ms) instead of 31 times."""

    def _period_s(self, code):
        return BASE_S[0] * (1, 32)[code >> 7] * ((code & 0x7F) + 1)


# -- sound chips in unusual circumstances ----------------------------------------------------------------


class MachineTable:
    """A world on the table of a machine: three harmonics of a rotor, about 30 mg rms on each axis."""

    ROTOR_HZ = 24.7
    AMPLITUDES_MG = ((32.0, 18.0, 9.0), (24.0, -21.0, 12.0), (-35.0, 12.0, 15.0))

    def __init__(self, world: World) -> None:
        self._world = world
        self.electronics = world.electronics

    def sample(self, time_s: Floats) -> Inputs:
        inputs = self._world.sample(time_s)
        phases = 2 * np.pi * self.ROTOR_HZ * np.outer(time_s, (1, 2, 3))
        shaking = np.sin(phases) @ np.array(self.AMPLITUDES_MG).T
        return replace(inputs, accel_mg=inputs.accel_mg + shaking)


class OnMachine(SimulatedChip):
    def __init__(self, surroundings, *args, **options):
        super().__init__(MachineTable(surroundings), *args, **options)


class SavedOtherwise(SimulatedChip):
    """Saved: 273 SPS, ±150 °/s, M = 3, g compensation, six offsets, and an alarm that is always active."""

    SAVED = MappingProxyType(
        {
            "SMPL_PRD": 0x05,
            "SENS_AVG": 0x0203,
            "MSC_CTRL": 0x87,
            "XGYRO_OFF": BY_NAME["XGYRO_OFF"].word(-71),
            "ZGYRO_OFF": BY_NAME["ZGYRO_OFF"].word(38),
            "XACCL_OFF": BY_NAME["XACCL_OFF"].word(-122),
            "ZACCL_OFF": BY_NAME["ZACCL_OFF"].word(98),
            "ALM_MAG2": 0x8000 | 2184,  # SUPPLY_OUT above 4 V
            "ALM_CTRL": 0x1000,
        }
    )

    def __init__(self, *args, flash=None, **options):
        super().__init__(*args, flash={**(flash or {}), **self.SAVED}, **options)


# -- the lists -------------------------------------------------------------------------------------------

CHANGES: dict[str, Change] = {
    "a write returns the old content": Change("reply_to_write", WriteReturnsOld),
    "bit 3 of SENS_AVG reads one": Change("reserved_bits", SensAvgBitThree),
    "offsets read as 14-bit numbers": Change("offset_upper_bits", OffsetsOfFourteenBits),
    "the self-test takes 70 ms": Change("self_test_time", SelfTestOf70Ms),
    "a precise null takes 45 s": Change("precision_time", PrecisionOf45S),
    "accelerometer offsets count 1/4": Change("accel_offset_lsb", _offset_factor(ACCEL_COLUMNS, 0.25)),
}
"""Further changed chips by the change."""

OF_STEPS: dict[str, Change] = {
    "an alarm switched off clears its bit": Change("alarm_stays", AlarmOffClears),
    "over-range stays until a read": Change("over_range_falls", OverRangeStays),
    "a flash update without a change is not counted": Change("flash_count", CountsChangesOnly),
    "the slow base is 32 fast ones": Change("sample_period", SlowBaseOf32),
    "the second boxcar has half the taps": Change("filter_gain", _with_chain(HalfSecondBoxcar)),
}
"""Further chips that a step of the bring-up contradicts."""

SOUND: dict[str, Change] = {
    "on a machine's table": Change("", OnMachine),
    "cold start in a warming room": Change(
        "",
        settings={
            "powered_s": 10.0,
            "self_heating_c": 12.0,
            "self_heating_tau_s": 90.0,
            "ambient_c": 8.0,
            "ambient_drift_c_per_h": 60.0,
            "bias_tempco_x_mg_per_c": 2.0,
            "bias_tempco_y_mg_per_c": -1.5,
            "bias_tempco_z_mg_per_c": 1.0,
            "gyro_bias_tempco_x_dps_per_c": 0.03,
            "gyro_bias_tempco_y_dps_per_c": -0.02,
            "supply_v": 4.85,
        },
    ),
    "large biases and another saved configuration": Change(
        "",
        SavedOtherwise,
        settings={
            "bias_x_mg": 57.0,
            "bias_y_mg": -46.0,
            "bias_z_mg": 71.0,
            "gyro_bias_x_dps": 5.5,
            "gyro_bias_y_dps": -4.2,
            "gyro_bias_z_dps": 2.9,
        },
    ),
}
"""Chips that obey the description entirely, in circumstances that are unusual but permitted."""
