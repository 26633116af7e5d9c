"""Settings of the sensor, and decoding of its words.

Configuration, offsets, alarms and status as data; the digital filter of the sensor; and the conversion of
the words of many scans to numbers and units, vectorised. A letter after DS (data sheet) is the confidence
that the figure is valid for this sensor, see `registers.CONFIDENCES`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import ChipError, UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.bus import Words
from adis_gonio.device.sensor.registers import (
    ACCEL_OUT,
    BY_NAME,
    EA,
    GYRO_OUT,
    LEAST_M,
    RANGE_CODE,
    TEMP_OUT,
    Kind,
    Register,
    Variant,
    registers,
    variant,
)


def filter_weights(m: int) -> Floats:
    """Return the weights (2·2^M − 1,) of the chip's filter of size M = `m`; their sum is 1.

    The filter is two cascaded moving averages over 2^M samples (data sheet, confidence A). M above 6 acts
    as 6.
    """
    box = np.full(1 << min(m, 6), 1.0 / (1 << min(m, 6)))
    return np.convolve(box, box)


def white_noise_gain(m: int) -> float:
    """Return the rms of white noise behind the chip's filter of size M, divided by its rms before it.

    It is 1, 0.612, 0.415 … for sizes M = 0, 1, 2 … (data sheet, confidence A).
    """
    return float(np.sqrt(np.sum(filter_weights(m) ** 2)))


def mean_at_rest(values: Floats, lsb: float | Floats, m: int) -> tuple[Floats, Floats]:
    """Return the means (k,) of samples `values` (n, k) at rest, and their standard uncertainties (k,).

    `lsb` is the step of the samples, a number or (k,), and `m` the size M of the filter. The filter does
    not reduce noise at the lowest frequencies, so a mean is as uncertain as the mean of unfiltered
    noise. Rounding is random only if the noise exceeds an LSB.
    """
    deviation = values.std(axis=0, ddof=1)
    spread = deviation / white_noise_gain(m)
    rounding = lsb / np.sqrt(12) * np.where(deviation > lsb, 1 / np.sqrt(len(values)), 1.0)
    return values.mean(axis=0), np.hypot(spread / np.sqrt(len(values)), rounding)


def filter_response(m: int, frequency: Floats) -> Floats:
    """Return the power response |H|² of the chip's filter of size `m`, in the shape of `frequency`.

    `frequency` has frequencies in cycles per sample.
    """
    taps = 1 << m
    with np.errstate(invalid="ignore", divide="ignore"):
        box = np.sin(np.pi * frequency * taps) / (taps * np.sin(np.pi * frequency))
    return np.where(frequency == 0, 1.0, box**4)


def rounding_covariance(m: int, sigma: float) -> Floats:
    """Return the autocovariance (lags,) in LSB² of the error that rounding adds to filtered noise.

    The chip filters white noise and rounds the result to whole LSB. The lags are 0, 1, 2 … samples, one for
    each weight of the filter; at greater lags the autocovariance is taken as 0.

    Filtered noise changes slowly, so that successive samples have similar rounding errors. If ρ is the
    autocorrelation of the filtered noise at a lag and σ its rms in LSB, the autocovariance of the error is
    Σ exp(−4π²n²σ²(1 − ρ)) / (2π²n²) over n = 1, 2, … (Widrow and Kollár, Quantization Noise, for Gaussian
    signals with an rms of half an LSB or more).

    Parameters
    ----------
    m : int
        Size M of the filter.
    sigma : float
        Rms of the white noise before the filter, in LSB.
    """
    weights = filter_weights(m)
    rho = np.correlate(weights, weights, "full")[len(weights) - 1 :]
    turn = (2 * np.pi * sigma * white_noise_gain(m)) ** 2 * (1 - rho / rho[0])
    order = np.arange(1, 65)[:, None]
    error = np.sum(np.exp(-(order**2) * turn) / (2 * np.pi**2 * order**2), axis=0)
    error[0] = 1 / 12
    return np.asarray(error, np.float64)


def rounding_spectrum(m: int, sigma: float, frequency: Floats) -> Floats:
    """Return the power (n,) in LSB² that rounding to whole LSB adds to a periodogram of filtered noise.

    A white error of variance v would add v at each frequency.

    Parameters
    ----------
    m : int
        Size M of the filter.
    sigma : float
        Rms of the white noise before the filter, in LSB.
    frequency : (n,) float
        Frequencies in cycles a sample.
    """
    error = rounding_covariance(m, sigma)
    level: Floats = (
        error[0] + 2 * np.cos(2 * np.pi * np.outer(frequency, np.arange(1, len(error)))) @ error[1:]
    )
    return np.maximum(level, 0.0)


FAST_BASE_S = 0.61035e-3
SLOW_BASE_S = 18.921e-3
"""Slow time base of SMPL_PRD in s, used if bit 7 is set (DS, A).

`FAST_BASE_S` is the fast time base in s, used otherwise.
"""

ANALOG_POLE_HZ = 350.0
"""Frequency in Hz at which the analog front end of the sensor has -3 dB (DS, A)."""

_RANGE_OF_CODE = {code: dps for dps, code in RANGE_CODE.items()}


def sample_period_s(smpl_prd: int) -> float:
    """Return the time in s between two updates of the chip's outputs at a value of SMPL_PRD.

    It is the time base times (N + 1), where N is in the bits 6:0 of SMPL_PRD, and bit 7 selects
    `SLOW_BASE_S` instead of `FAST_BASE_S` (data sheet, confidence A).
    """
    base = SLOW_BASE_S if smpl_prd & 0x80 else FAST_BASE_S
    return base * ((smpl_prd & 0x7F) + 1)


def smpl_prd_for(sample_rate_hz: float) -> int:
    """Return the value of SMPL_PRD that gives the sample rate nearest to the requested rate.

    Raises
    ------
    UsageError
        The rate is outside 0.413 to 819.2 samples a second.
    """
    choices = [n for n in range(256) if n & 0x7F or n & 0x80]
    least, most = 1 / sample_period_s(0xFF), 1 / sample_period_s(0x01)
    if not 0.99 * least <= sample_rate_hz <= 1.01 * most:
        raise UsageError(f"sample_rate_hz is {sample_rate_hz:g}: choose {least:.3f} to {most:.1f}")
    return min(choices, key=lambda n: abs(1 / sample_period_s(n) - sample_rate_hz))


def filter_settling_samples(filter_m: int) -> int:
    """Return the number of samples in which the chip's filter of size M settles: 2·2^M − 1 (data sheet)."""
    return int(2 * 2**filter_m - 1)


def low_pass_3db_hz(filter_m: int, sample_rate_hz: float) -> float:
    """Return the frequency in Hz at which the chip's filter of size M halves the power.

    It is the −3 dB column of the data sheet's table (confidence A). Without the filter (M = 0), only the
    pole of the analog front end remains.
    """
    if filter_m == 0:
        return ANALOG_POLE_HZ
    from scipy.optimize import brentq

    def above_half(cycles: float) -> float:
        return float(filter_response(filter_m, np.array(cycles))) - 0.5

    # The response falls from 1 to its first zero, at one cycle in 2^M samples.
    return sample_rate_hz * float(brentq(above_half, 0.0, 0.5**filter_m))


@dataclass(frozen=True)
class Configuration:
    """Configuration of the chip, decoded from its registers.

    Attributes
    ----------
    smpl_prd : int
        Content of SMPL_PRD[7:0], which sets the sample rate.
    filter_m : int
        M of the Bartlett filter: two boxcars of 2^M taps.
    gyro_range_dps : int or None
        Full scale of the gyros: 300, 150 or 75 °/s; None if SENS_AVG has an undefined code.
    data_ready : bool
        True if the chip gives data-ready pulses on a DIO line.
    linear_g, origin : bool
        True if the chip compensates the gyros for acceleration (MSC_CTRL[7]), and if it compensates the
        accelerometers for their positions in the package (MSC_CTRL[6]).
    """

    smpl_prd: int
    filter_m: int
    gyro_range_dps: int | None
    data_ready: bool
    linear_g: bool
    origin: bool

    @classmethod
    def from_words(cls, smpl_prd: int, sens_avg: int, msc_ctrl: int) -> Configuration:
        """Decode the configuration from the contents of SMPL_PRD, SENS_AVG and MSC_CTRL."""
        sens, misc = BY_NAME["SENS_AVG"], BY_NAME["MSC_CTRL"]
        return cls(
            smpl_prd & 0xFF,
            sens.field("m").of(sens_avg),
            _RANGE_OF_CODE.get(sens.field("range").of(sens_avg)),
            bool(misc.field("data_ready").of(msc_ctrl)),
            bool(misc.field("linear_g").of(msc_ctrl)),
            bool(misc.field("origin").of(msc_ctrl)),
        )

    @property
    def sample_period_s(self) -> float:
        """Time in s between internal updates."""
        return sample_period_s(self.smpl_prd)

    @property
    def sample_rate_hz(self) -> float:
        """Number of internal updates a second."""
        return 1.0 / self.sample_period_s

    @property
    def allowed(self) -> bool:
        """True if the chip allows the rate, and the filter with the gyro range (data sheet, A)."""
        least = LEAST_M.get(self.gyro_range_dps or 0, 7)
        return self.smpl_prd > 0 and least <= self.filter_m <= 6

    @property
    def settling_s(self) -> float:
        """Time in s until the output of the filter has settled after a change of its input."""
        return filter_settling_samples(self.filter_m) * self.sample_period_s

    def as_dict(self) -> dict[str, Any]:
        """Return the configuration in JSON form, with the sample rate in Hz."""
        return asdict(self) | {"sample_rate_hz": self.sample_rate_hz}


def compensations(configuration: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the compensations that the chip applies to its readings, one text each.

    Parameters
    ----------
    configuration : mapping
        JSON form of a `Configuration`. The configuration of another sensor lacks these entries and gives no
        text.
    """
    known = {
        "linear_g": "gyros for linear acceleration (MSC_CTRL[7])",
        "origin": "accelerometers for their places (MSC_CTRL[6])",
    }
    return tuple(words for name, words in known.items() if configuration.get(name))


def sens_avg_word(gyro_range_dps: int, filter_m: int) -> int:
    """Return the content of SENS_AVG for a gyro range in °/s and a filter size M.

    Raises
    ------
    UsageError
        No such range or filter, or a range that needs more filtering: ±150 °/s needs M >= 2, ±75 °/s
        M >= 4 (data sheet, confidence A).
    """
    if gyro_range_dps not in RANGE_CODE:
        raise UsageError(f"gyro_range_dps is {gyro_range_dps}: choose 300, 150 or 75")
    if not 0 <= filter_m <= 6:
        raise UsageError(f"filter_m is {filter_m}: choose 0 to 6")
    if filter_m < LEAST_M[gyro_range_dps]:
        raise UsageError(
            f"gyro range ±{gyro_range_dps} °/s needs filter_m >= {LEAST_M[gyro_range_dps]}, not {filter_m}"
        )
    return RANGE_CODE[gyro_range_dps] << 8 | filter_m


class Offsets(JsonRecord):
    """Contents of the six offset registers in °/s and mg; the chip adds each to the output of its axis.

    The LSB of the accelerometers' offsets on the ADIS16354 has confidence C: check it once on hardware.
    """

    gyro_dps: tuple[float, float, float]
    accel_mg: tuple[float, float, float]


@dataclass(frozen=True)
class Status:
    """Content of STATUS at the time of reading, which cleared the register."""

    word: int

    @property
    def flags(self) -> Mapping[str, bool]:
        """True or False for each bit of STATUS, by its name in the register table."""
        return {field.name: bool(field.of(self.word)) for field in BY_NAME["STATUS"].fields}

    @property
    def messages(self) -> tuple[str, ...]:
        """Meanings of the errors and alarms that are set in STATUS, one line of text each."""
        return tuple(field.meaning for field in BY_NAME["STATUS"].fields if field.of(self.word))

    @property
    def self_test_failures(self) -> tuple[str, ...]:
        """Failures of a self-test, one line of text each: bit 5 (error), bits 15:10 (one for each axis)."""
        fields = [field for field in BY_NAME["STATUS"].fields if field.name.endswith("self_test")]
        return tuple(field.meaning for field in fields if field.of(self.word))

    def __str__(self) -> str:
        return "; ".join(self.messages) or "no fault, no alarm"


ALARM_SOURCES: dict[str, int] = {
    name: code
    for code, name in enumerate(
        (
            "SUPPLY_OUT",
            "XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT",
            "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT",
            "XTEMP_OUT", "YTEMP_OUT", "ZTEMP_OUT",
            "AUX_ADC",
        ),
        start=1,
    )
}  # fmt: skip
"""Code of ALM_CTRL that selects the register watched by an alarm, by register name (DS, B)."""


@dataclass(frozen=True)
class Alarm:
    """Setting of one of the two alarms, in the units of the register that it watches.

    Attributes
    ----------
    source : str
        Register that is watched, such as `XACCL_OUT`.
    threshold : float
        Limit of the value in mg, °/s, °C or V. If `rate_samples` is not 0, limit of the change of the value
        in this unit per sample.
    above : bool
        True alarms above the threshold, False below.
    rate_samples : int
        0: the alarm compares the value. 1 to 255: it compares the mean change per sample over this number
        of samples (data sheet p. 20, confidence B).
    filtered : bool
        True compares filtered data; ALM_CTRL[4], shared by both alarms.
    """

    source: str
    threshold: float
    above: bool = True
    rate_samples: int = 0
    filtered: bool = False


_IN_CACHE = 32_768
"""Number of words decoded in one step.

It is long enough for numpy's inner loops and short enough for the cache.
"""


def decode_numbers(table: Sequence[Register], words: Words) -> NDArray[np.int32]:
    """Decode words to integers: flags and unused bits removed, sign extended.

    Parameters
    ----------
    table : sequence of k Register
        Register of each column.
    words : (n, k) uint16
        Words as read.

    Returns
    -------
    (n, k) int32
        Integers.
    """
    width = words.shape[1]
    masks, signs = _masks_and_signs(tuple((row.bits, row.signed) for row in table))
    scans = len(masks) // width
    bits = np.empty(scans * width, np.uint16)
    numbers = np.empty(words.shape, np.int32)
    for at in range(0, words.shape[0], scans):
        part = words[at : at + scans].reshape(-1)
        size = part.size
        held = bits[:size]
        np.bitwise_and(part, masks[:size], out=held)
        np.bitwise_xor(held, signs[:size], out=held)
        np.subtract(held, signs[:size], out=held)
        numbers[at : at + scans].reshape(-1)[:] = held.view(np.int16)
    for k, row in enumerate(table):
        if row.bits == 16 and not row.signed:  # the only kind that is not a signed number of 16 bits
            numbers[:, k] &= 0xFFFF
    return numbers


@lru_cache(maxsize=64)
def _masks_and_signs(layout: tuple[tuple[int, bool], ...]) -> tuple[Words, Words]:
    """Return data masks and sign bits, each (s·k,), for the s scans of k words decoded in one step.

    `layout` has for each of the k columns the number of bits, and True if the number is signed.
    (word & mask ^ sign) - sign masks the flags off and extends the sign; sign is 0 for unsigned registers.
    """
    mask = np.array([(1 << bits) - 1 for bits, _ in layout], np.uint16)
    sign = np.array([1 << bits - 1 if signed else 0 for bits, signed in layout], np.uint16)
    scans = max(1, _IN_CACHE // len(layout))
    return np.tile(mask, scans), np.tile(sign, scans)


def scales(
    table: Sequence[Register], part: Variant, gyro_range_dps: int | None
) -> tuple[Floats, Floats, tuple[str, ...]]:
    """Return the scales of k registers: value of an LSB (k,), value of the content 0 (k,), and units.

    `part` is the sensor type, `gyro_range_dps` the range of the gyros, None if unknown.

    Raises
    ------
    ChipError
        A gyro is among the registers, but the gyro range is unknown (None).
    """
    lsb, zero, units = [], [], []
    for row in table:
        if row.kind is Kind.GYRO and gyro_range_dps is None:
            raise ChipError(
                f"{row.name}: SENS_AVG has no valid gyro range, so its scale is unknown;"
                " set one (option --range 300, or configure(gyro_range_dps=300))"
            )
        a, b, unit = part.lsb(row.kind, gyro_range_dps or 300)
        lsb.append(a)
        zero.append(b)
        units.append(unit)
    return np.array(lsb), np.array(zero), tuple(units)


_table_of = cache(registers)


@dataclass(frozen=True)
class ScanBlock:
    """Successive scans of the same registers, with their times.

    Attributes
    ----------
    registers : tuple of str
        Names of the k registers.
    words : (n, k) uint16
        Words as read, including flags.
    time_s : (n,) float
        Time of each scan on the bus's clock, in s.
    lost : int
        Number of missed updates of the chip from the end of the previous block to the end of this one.
    variant, gyro_range_dps
        Name of the variant and gyro range in °/s that decode the words; the range is None if unknown.
    missed : (n,) int or None
        Number of missed updates just before each scan; None if unknown.
    dropped : int
        Number of scans that were left out because a word in them was not new (bit ND clear): the
        data-ready edge that started such a scan was no update.
    """

    registers: tuple[str, ...]
    words: Words
    time_s: Floats
    lost: int = 0
    variant: str = "adis16354"
    gyro_range_dps: int | None = 300
    missed: NDArray[np.int64] | None = None
    dropped: int = 0

    def __len__(self) -> int:
        return len(self.words)

    @property
    def table(self) -> tuple[Register, ...]:
        """Descriptions of the registers, one for each column."""
        return _table_of(self.registers)

    def numbers(self) -> NDArray[np.int32]:
        """Return the decoded register contents (n, k) as signed integers, without flags and unused bits."""
        return decode_numbers(self.table, self.words)

    def values(self) -> Floats:
        """Return the measured values (n, k) in the units of `units` (mg, °/s, °C, V)."""
        lsb, zero, _ = scales(self.table, variant(self.variant), self.gyro_range_dps)
        values: Floats = zero + lsb * self.numbers()
        return values

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of the values in each column, such as mg."""
        return scales(self.table, variant(self.variant), self.gyro_range_dps)[2]

    def column(self, name: str) -> Floats:
        """Return the measured values (n,) of one register in its unit."""
        return self.select((name,)).values()[:, 0]

    def select(self, names: Sequence[str]) -> ScanBlock:
        """Return a copy of the block with only the named registers; `UsageError` if one was not scanned."""
        try:
            columns = [self.registers.index(name) for name in names]
        except ValueError:
            missing = next(name for name in names if name not in self.registers)
            raise UsageError(f"{missing} was not scanned; scanned: {', '.join(self.registers)}") from None
        return replace(self, registers=tuple(names), words=self.words[:, columns])

    def first(self, count: int) -> ScanBlock:
        """Return a copy of the first `count` scans, in which `lost` counts the missed updates before them.

        If `missed` is None, it is not known where updates were missed, and `lost` is unchanged.
        """
        missed = None if self.missed is None else self.missed[:count]
        return replace(
            self,
            words=self.words[:count],
            time_s=self.time_s[:count],
            lost=self.lost if missed is None else int(missed.sum()),
            missed=missed,
        )

    @property
    def accel_mg(self) -> Floats:
        """Uncalibrated acceleration (n, 3) along X, Y and Z in mg (thousandths of 9.80665 m/s²)."""
        return self.select(ACCEL_OUT).values()

    @property
    def gyro_dps(self) -> Floats:
        """Rate of turn (n, 3) about X, Y and Z in °/s."""
        return self.select(GYRO_OUT).values()

    @property
    def temperature_c(self) -> Floats:
        """Mean (n,) in °C of those die temperatures (one for each gyro) that were scanned."""
        names = tuple(name for name in TEMP_OUT if name in self.registers)
        mean: Floats = self.select(names or TEMP_OUT).values().mean(axis=1)
        return mean

    @property
    def supply_v(self) -> Floats:
        """Supply voltage (n,) in V."""
        return self.column("SUPPLY_OUT")

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """For each scan (n,): True if a flag EA reports an error or alarm in STATUS."""
        outputs = [k for k, row in enumerate(self.table) if row.flags]
        flags: NDArray[np.bool_] = np.any((self.words[:, outputs] & EA).astype(bool), axis=1)
        return flags


def join(blocks: Sequence[ScanBlock]) -> ScanBlock:
    """Join successive blocks of the same registers to one block; `lost` and `dropped` are summed."""
    first = blocks[0]
    missed = [block.missed for block in blocks if block.missed is not None]
    return replace(
        first,
        words=np.concatenate([block.words for block in blocks]),
        time_s=np.concatenate([block.time_s for block in blocks]),
        lost=sum(block.lost for block in blocks),
        missed=np.concatenate(missed) if len(missed) == len(blocks) else None,
        dropped=sum(block.dropped for block in blocks),
    )
