"""Conversion of analog inputs to output words: scaling, filter, offsets, limits, alarms, STATUS bits.

Some behaviour of the chip is not known. These are estimates (confidence D):

* the filter works at a resolution of 1/1024 LSB, and its output is rounded once;
* offsets are added after the filter; the filter is emptied if range or M changes;
* an illegal range acts as ±300 °/s, M = 7 as 6, and an M below the minimum of the range as this minimum;
* over-range means a sample beyond the nominal range.

The compensations of MSC_CTRL[7:6] act on each sample before the filter. The compensation of the gyros uses
the readings of the chip's own accelerometers. `Electronics` has the size of the compensations, the
saturation of the gyros and the gains of the ranges. The data sheet describes these functions but not how
well they work, so all these figures are estimates too.

The digital filter is a Bartlett window made of two cascaded boxcars (data sheet, confidence A). Samples are
integers in fixed point, so that sums are exact however a run of samples is divided.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor import registers
from adis_gonio.sim.memory import PRECISION_S, Memory


@dataclass(frozen=True)
class Inputs:
    """Physical quantities at the chip for n internal updates, with the signs that the registers have.

    Attributes
    ----------
    accel_mg : (n, 3) float
        Accelerations x, y, z in mg (thousandths of 9.80665 m/s²); level with Z up, z is -1000.
    gyro_dps : (n, 3) float
        Rates of turn in °/s, right-handed about the axes of the sensor.
    temperature_c : (n, 3) float
        Temperatures of the dies of the three gyros in °C.
    supply_v, aux_v : (n,) float
        Supply and auxiliary input in V.
    place_mg : (n, 3) float or None
        Part of `accel_mg` that turns cause because the accelerometers are at different positions within
        the sensor; None if there is none.
    """

    accel_mg: Floats
    gyro_dps: Floats
    temperature_c: Floats
    supply_v: Floats
    aux_v: Floats
    place_mg: Floats | None = None


class Surroundings(Protocol):
    """The surroundings of a chip, which give the physical quantities that it measures."""

    def sample(self, time_s: Floats) -> Inputs:
        """Return the physical inputs at increasing times (n,) in s; each call continues after the last one.

        The values must not depend on how the updates are divided into calls.
        """


@dataclass(frozen=True)
class Electronics:
    """Properties of a chip's electronics: gains of the gyro ranges, saturation, compensations, autonulls.

    Attributes
    ----------
    range_gain : mapping of int to float
        Gain of the gyros by range in °/s, relative to ±300 °/s; 1 for other ranges.
    gyro_saturation : float
        Saturation of the gyros in units of the range; the registers end at twice the range.
    g_compensation : (3, 3) float or None
        Compensation of the gyros by MSC_CTRL[7], in °/s per g as read by the chip's own accelerometers;
        None uses the figure of the family for each gyro's own axis.
    origin_compensation : float
        Share of the effect of the accelerometers' positions that MSC_CTRL[6] removes.
    autonull_s, precision_autonull_s : float
        Averaging times in s of the autonull and the precision autonull; 0 uses the present output of the
        filter.
    """

    range_gain: dict[int, float] = field(default_factory=dict)
    gyro_saturation: float = math.inf
    g_compensation: Floats | None = None
    origin_compensation: float = 1.0
    autonull_s: float = 0.0
    precision_autonull_s: float = PRECISION_S


IDEAL = Electronics()


Integers = NDArray[np.int64]

MOST_M = 6


def taps(m: int) -> int:
    """Return the number N = 2^m of samples that each of the filter's two moving averages adds up."""
    return 1 << m


def history_rows(m: int) -> int:
    """Return the number of earlier samples that the filter's output depends on: 2N − 2, N = 2^m."""
    return 2 * taps(m) - 2


def bartlett_sums(samples: Integers, m: int) -> Integers:
    """Return moving sums with triangular (Bartlett) weights: N² times the filter's output.

    Parameters
    ----------
    samples : (2N - 2 + n, k) int
        Samples, the first 2N - 2 of them history.
    m : int
        Filter setting M (the bits SENS_AVG[2:0]); N = 2^m.

    Returns
    -------
    (n, k) int
        Sums with weights 1, 2, … N, … 2, 1.
    """
    n = taps(m)
    return _boxcar(_boxcar(samples, n), n)


def _boxcar(samples: Integers, n: int) -> Integers:
    # Moving sum of n samples as a difference of cumulative sums.
    total = np.cumsum(samples, axis=0)
    sums = total[n - 1 :].copy()
    sums[1:] -= total[:-n]
    return sums


OUTPUTS: tuple[registers.Register, ...] = tuple(row for row in registers.REGISTERS if row.flags)
"""Output registers in order of address, which are the columns of all arrays in this module."""
GYRO_COLUMNS = slice(1, 4)
ACCEL_COLUMNS = slice(4, 7)

SELF_TEST_ACCEL_MG = 250.0
SELF_TEST_GYRO_DPS = 50.0
"""Change of a gyro output in °/s under the stimulus of the manual self-test (D).

`SELF_TEST_ACCEL_MG` is the change of an accelerometer output in mg (D).
"""

FRACTION_BITS = 10
_ONE = 1 << FRACTION_BITS
_HISTORY = 256
_LOW = np.array([row.range[0] for row in OUTPUTS], np.int64)
_HIGH = np.array([row.range[1] for row in OUTPUTS], np.int64)
_MASK = np.array([row.data_mask for row in OUTPUTS], np.int64)
_NARROW = np.array([k for k, row in enumerate(OUTPUTS) if row.bits == 12])
_GYRO_OFF_PER_LSB = {300: 4, 150: 2, 75: 1}
_LARGEST = float(1 << 30)

# Columns of the sources that ALM_CTRL numbers: 1 supply, 2-4 gyros, 5-7 accelerometers, 8-10
# temperatures, 11 auxiliary input: the order of the output registers.

STATUS = registers.BY_NAME["STATUS"]
ALARM_BITS = (STATUS.field("alarm1").mask, STATUS.field("alarm2").mask)
_OVER_RANGE = STATUS.field("over_range").mask
_SUPPLY_LOW = STATUS.field("supply_low").mask
_SUPPLY_HIGH = STATUS.field("supply_high").mask


@dataclass(frozen=True)
class AlarmSetting:
    """Setting of one alarm, decoded from the registers.

    Attributes
    ----------
    bit : int
        STATUS bit of the alarm.
    column : int
        Column of `OUTPUTS` that the alarm watches.
    greater : bool
        True alarms above the threshold, False below it.
    threshold : int
        Limit in the number format of the watched register; with `samples`, the limit of its change per
        sample.
    samples : int
        Number of updates over which the mean change per sample is computed; 0 compares the value.
    filtered : bool
        True compares filtered data.
    """

    bit: int
    column: int
    greater: bool
    threshold: int
    samples: int
    filtered: bool


@dataclass(frozen=True)
class Updates:
    """Outputs of n internal updates, with a column for each of `OUTPUTS`.

    Attributes
    ----------
    words : (n, 11) uint16
        Output words without ND and EA.
    status : (n,) int
        STATUS bits of the conditions that are true at each update.
    unfiltered : (n, 11) int
        Samples before filter and offset, in 1/1024 LSB.
    """

    words: NDArray[np.uint16]
    status: Integers
    unfiltered: Integers


class SignalChain:
    """The chip's processing from physical inputs to output registers: filter, offsets, range, alarms."""

    def __init__(
        self, variant: registers.Variant, memory: Memory, electronics: Electronics = IDEAL
    ) -> None:
        self._variant = variant
        self._electronics = electronics
        own = np.eye(3) * variant.performance.gyro_g_sensitivity_dps_per_g
        self._per_g = own if electronics.g_compensation is None else electronics.g_compensation
        self.gyro_range_dps = 0
        self.m = -1
        self.clear()
        self.configure(memory)

    # -- settings -------------------------------------------------------------------------------

    def configure(self, memory: Memory) -> None:
        """Read the settings from the registers; empty the filter if gyro range or filter size changed."""
        code = memory.field("SENS_AVG", "range")
        gyro_range = next((dps for dps, known in registers.RANGE_CODE.items() if known == code), 300)
        m = min(max(memory.field("SENS_AVG", "m"), registers.LEAST_M[gyro_range]), MOST_M)
        if (gyro_range, m) != (self.gyro_range_dps, self.m):
            self.clear()
        self.gyro_range_dps, self.m = gyro_range, m
        sizes = [self._variant.lsb(row.kind, gyro_range) for row in OUTPUTS]
        self._gain = np.array([_ONE / lsb for lsb, _, _ in sizes])
        self._zero = np.array([zero for _, zero, _ in sizes])
        offset = np.zeros(len(OUTPUTS), np.int64)
        for k, name in enumerate(registers.GYRO_OFF):
            number = registers.BY_NAME[name].number(memory[name])
            offset[GYRO_COLUMNS.start + k] = number * _ONE // _GYRO_OFF_PER_LSB[gyro_range]
        for k, name in enumerate(registers.ACCEL_OFF):
            offset[ACCEL_COLUMNS.start + k] = registers.BY_NAME[name].number(memory[name]) * _ONE
        self._offset = offset
        self._manual_test = float(
            memory.field("MSC_CTRL", "positive") - memory.field("MSC_CTRL", "negative")
        )
        self._compensate = bool(memory.field("MSC_CTRL", "linear_g"))
        self._align = bool(memory.field("MSC_CTRL", "origin"))
        self._gyro_gain = self._electronics.range_gain.get(gyro_range, 1.0)
        self._gyro_limit = self._electronics.gyro_saturation * gyro_range
        self._alarms = _alarms(memory)

    def clear(self) -> None:
        """Empty the filter and the history of samples, as a reset does."""
        self._samples = np.zeros((_HISTORY, len(OUTPUTS)), np.int64)
        self._filtered = np.zeros((_HISTORY, len(OUTPUTS)), np.int64)
        self._taken = 0

    def null_offset(self, mean_unfiltered: Floats) -> list[int]:
        """Return the contents of the three gyro offset registers that cancel mean gyro samples.

        `mean_unfiltered` is (3,) in 1/1024 LSB.
        """
        low, high = registers.BY_NAME[registers.GYRO_OFF[0]].range
        scale = _GYRO_OFF_PER_LSB[self.gyro_range_dps]
        return [int(min(max(round(-value * scale / _ONE), low), high)) for value in mean_unfiltered]

    def gyro_mean(self) -> Floats:
        """Return the latest gyro outputs (3,) of the filter in 1/1024 LSB.

        The offset registers are not added.
        """
        sums = bartlett_sums(self._samples[_HISTORY - history_rows(self.m) - 1 :], self.m)
        return np.asarray(sums[-1, GYRO_COLUMNS] / taps(self.m) ** 2, np.float64)

    # -- updates --------------------------------------------------------------------------------

    def update(self, inputs: Inputs) -> Updates:
        """Process the inputs of n updates; return the output registers and STATUS bits of each update."""
        new = self._scaled(inputs)
        n = len(new)
        samples = np.concatenate([self._samples, new])
        # Filter the new samples with as many rows of history as the window needs.
        sums = bartlett_sums(samples[_HISTORY - history_rows(self.m) :], self.m)
        numbers = self._numbers(sums, 2 * self.m)
        words = numbers & _MASK
        # Bits 13:12 of a 12-bit register are not used. Their real content is not known; they are never zero
        # here, so that a driver that does not mask them fails.
        words[:, _NARROW] |= 0x1000 | ((numbers[:, _NARROW] & 1) << 13)
        low, high = registers.SUPPLY_LIMITS_V
        over = np.abs(inputs.accel_mg).max(axis=1) > 1000.0 * self._variant.accel_range_g
        over |= np.abs(inputs.gyro_dps).max(axis=1) > self.gyro_range_dps
        status = np.asarray(over * _OVER_RANGE, np.int64)
        status |= (inputs.supply_v < low) * _SUPPLY_LOW
        status |= (inputs.supply_v > high) * _SUPPLY_HIGH
        filtered = np.concatenate([self._filtered, numbers])
        for alarm in self._alarms:
            source = filtered if alarm.filtered else self._numbers(samples, 0)
            status |= np.where(self._alarming(alarm, source[:, alarm.column], n), alarm.bit, 0)
        self._samples = samples[-_HISTORY:]
        self._filtered = filtered[-_HISTORY:]
        self._taken += n
        return Updates(words.astype(np.uint16), status, new)

    def _scaled(self, inputs: Inputs) -> Integers:
        values = np.empty((len(inputs.supply_v), len(OUTPUTS)))
        values[:, 0] = inputs.supply_v
        values[:, 1:4] = np.clip(inputs.gyro_dps * self._gyro_gain, -self._gyro_limit, self._gyro_limit)
        values[:, 4:7] = inputs.accel_mg
        if self._align and inputs.place_mg is not None:
            values[:, 4:7] -= self._electronics.origin_compensation * inputs.place_mg
        values[:, 7:10] = inputs.temperature_c
        values[:, 10] = inputs.aux_v
        if self._compensate:
            for (k, j), per_g in np.ndenumerate(self._per_g):
                values[:, GYRO_COLUMNS.start + k] -= per_g * 1e-3 * values[:, ACCEL_COLUMNS.start + j]
        if self._manual_test:
            values[:, GYRO_COLUMNS] += self._manual_test * SELF_TEST_GYRO_DPS
            # The accelerometers answer to the positive stimulus alone (DS p. 19, B).
            values[:, ACCEL_COLUMNS] += max(self._manual_test, 0.0) * SELF_TEST_ACCEL_MG
        # Convert to fixed point: 1/1024 LSB.
        values -= self._zero
        values *= self._gain
        np.rint(values, out=values)
        np.clip(values, -_LARGEST, _LARGEST, out=values)
        return values.astype(np.int64)

    def _numbers(self, sums: Integers, extra_bits: int) -> Integers:
        shift = FRACTION_BITS + extra_bits
        # Add offset and half an LSB, then divide by the weights with a shift.
        numbers = (sums + ((self._offset << extra_bits) + (1 << (shift - 1)))) >> shift
        np.clip(numbers, _LOW, _HIGH, out=numbers)
        return numbers

    def _alarming(self, alarm: AlarmSetting, source: Integers, n: int) -> NDArray[np.bool_]:
        value, threshold = source[_HISTORY:], alarm.threshold
        known = np.ones(n, bool)
        if alarm.samples:
            # The mean change a sample, (1/N)·Σ(y(n+1) − y(n)) (DS p. 20, B), without dividing.
            value = value - source[_HISTORY - alarm.samples : len(source) - alarm.samples]
            threshold *= alarm.samples
            known = self._taken + np.arange(1, n + 1) > alarm.samples
        return known & (value > threshold if alarm.greater else value < threshold)


def _alarms(memory: Memory) -> list[AlarmSetting]:
    alarms = []
    for k in (1, 2):
        source = memory.field("ALM_CTRL", f"source{k}")
        if not 1 <= source <= len(OUTPUTS):
            continue
        magnitude, row = memory[f"ALM_MAG{k}"], OUTPUTS[source - 1]
        rate = bool(memory.field("ALM_CTRL", f"rate{k}"))
        data = magnitude & row.data_mask
        signed = row.signed or rate
        threshold = data - (1 << row.bits) if signed and data >> (row.bits - 1) else data
        samples = max(memory[f"ALM_SMPL{k}"] & 0xFF, 1) if rate else 0
        filtered = bool(memory.field("ALM_CTRL", "filtered"))
        greater = bool(magnitude >> 15)
        alarms.append(AlarmSetting(ALARM_BITS[k - 1], source - 1, greater, threshold, samples, filtered))
    return alarms
