"""Bring-up steps on the part at rest: noise, filter, offsets, self-tests, STATUS and flash.

All writes are undone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import ChipError
from adis_gonio.bench.bringup.bringup_step import (
    Answer,
    BringupBench,
    Ending,
    NotMeasuredError,
    Outcome,
    StepResult,
    Verdict,
    Z,
    highest_bin,
    variance_ratio,
)
from adis_gonio.bench.bringup.chip_rows import BY_QUESTION, RecordedChip
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_NAME,
    EA,
    GYRO_OUT,
    Variant,
    registers,
)
from adis_gonio.device.sensor.settings import (
    Alarm,
    filter_response,
    rounding_spectrum,
    scales,
    sens_avg_word,
    white_noise_gain,
)

_NOISE_SCANS = 4096
_SCANS = 512
_STEP = 1000

_OVER_RANGE = BY_NAME["STATUS"].field("over_range").mask
_ALARM = BY_NAME["STATUS"].field("alarm1").mask
BANDS = 6
HANN_WIDTH = 35 / 18
"""Number of bins of a periodogram with Hann's window that count as one independent bin in a mean."""


def flicker(floor: Floats, frequency_hz: Floats, rate_hz: float) -> Floats:
    """Return the level (n, k) of flicker (1/f) noise in a periodogram of k axes at n frequencies.

    `floor` (k,) is the floor of the Allan deviation of each axis, `frequency_hz` has the frequencies (n,),
    and `rate_hz` is the sample rate. The one-sided density of flicker is floor² / (2 ln 2 f); white noise
    has 2 σ² / rate and the level σ² in each bin.
    """
    return np.asarray(floor**2 / (2 * math.log(2) * frequency_hz[:, None]) * rate_hz / 2)


def spectrum(values: Floats) -> tuple[Floats, Floats]:
    """Return frequencies (cycles per sample) and periodogram of k series of n values, with Hann's window.

    White noise of variance σ² has the mean σ² in every bin.
    """
    from scipy.signal import detrend, periodogram

    cycles, density = periodogram(detrend(values, axis=0), window="hann", detrend=False, axis=0)
    # The density is one-sided: twice the power of a bin.
    return np.asarray(cycles, np.float64), np.asarray(density / 2, np.float64)


def measure_noise(bench: BringupBench, found: StepResult) -> Ending:
    """Record 4096 scans of accelerometers and gyros at rest: rms, bands of the spectrum, tones.

    The noise of all axes is compared with the figures of the variant, and its spectrum with the filter.
    """
    sensor = bench.sensor
    configuration = sensor.configuration()
    names = (*ACCEL_OUT, *GYRO_OUT)
    if configuration.gyro_range_dps is None:
        raise NotMeasuredError("SENS_AVG holds no valid range of the gyros")
    block = bench.scans(_NOISE_SCANS, names, gaps=False)
    m, rate = configuration.filter_m, configuration.sample_rate_hz
    lsb, _, units = scales(registers(names), sensor.variant, configuration.gyro_range_dps)
    expected = sensor.variant.performance.noise
    numbers = block.numbers().astype(np.float64)
    if stuck := [name for name, column in zip(names, numbers.T, strict=True) if not np.ptp(column)]:
        return Verdict.FAULT, f"{', '.join(stuck)} never changes: the axis does not work"
    judged = _by_spectrum(sensor.variant, numbers, m, rate, expected / lsb)
    sigma, u = judged.sigma * lsb, judged.u * lsb
    for name, s, d, e, unit in zip(names, sigma, u, expected, units, strict=True):
        found.measure(f"noise of {name}, unfiltered", s, unit, d, e)
    found.measure("scans", len(block))
    _answer_noise(found, judged.level_off)
    if judged.tones:
        text = "; ".join(
            f"a tone of {math.sqrt(2) * rms * lsb[k]:.2g} {units[k]} at {hz:.1f} Hz on {names[k]}"
            for k, hz, rms in judged.tones
        )
        return Verdict.FAULT, f"{text}: hum or a vibrating table"
    if judged.shape_off:
        wrong = ", ".join(names[k] for k in judged.shape_off)
        return Verdict.DIFFERS, f"the spectrum of {wrong} is not the filter's"
    if off := [k for k in range(6) if judged.level_off[k]]:
        texts = (f"{names[k]}: {sigma[k]:.3g} {units[k]} rms, the table says {expected[k]:g}" for k in off)
        return Verdict.DIFFERS, "; ".join(texts)
    mean_mg, mean_dps = float(np.mean(sigma[:3])), float(np.mean(sigma[3:]))
    return Verdict.OK, (
        f"{mean_mg:.2f} mg and {mean_dps:.3f} °/s rms unfiltered, as the table says, white behind the"
        " filter"
    )


class _Judged:
    """Noise of k axes, with the axes that deviate from the variant's figures.

    Attributes
    ----------
    sigma, u : (k,) float
        Standard deviation before the filter in LSB, and its standard uncertainty.
    level_off : list of bool
        True for each axis with other noise than the variant's.
    shape_off : list of int
        Axes with a spectrum of another shape than the filter.
    tones : list of (int, float, float)
        Axis, frequency in Hz and rms in LSB of each single tone.
    """

    def __init__(self, sigma: Floats, u: Floats) -> None:
        self.sigma = sigma
        self.u = u
        self.level_off = [False] * len(sigma)
        self.shape_off: list[int] = []
        self.tones: list[tuple[int, float, float]] = []


def _by_spectrum(part: Variant, numbers: Floats, m: int, rate_hz: float, expected: Floats) -> _Judged:
    """Judge the noise of scans without gaps by their spectrum: level, shape and single tones.

    `numbers` are the scans (n, k) of the first k of the six axes in LSB, `m` is the filter setting,
    `rate_hz` the sample rate, and `expected` the noise (k,) in LSB by the figures of the variant `part`.
    Only frequencies are used at which white noise exceeds rounding and flicker noise.
    """
    cycles, power = spectrum(numbers)
    gain = filter_response(m, cycles)
    axes = slice(len(expected))
    floor = part.performance.floor[axes] * expected / part.performance.noise[axes]
    # Frequency above which flicker adds at most a tenth to the white noise of every axis.
    lowest_hz = float(np.max(flicker(floor, np.ones(1), rate_hz)[0] / (0.1 * expected**2)))
    used = cycles * rate_hz >= max(lowest_hz, 4 * rate_hz / len(numbers))
    rounded = np.stack([rounding_spectrum(m, sigma, cycles) for sigma in expected], axis=1)
    used &= np.all(gain[:, None] * expected**2 >= rounded, axis=1)
    used[-1] = False  # the last bin is real and has another distribution
    rest = gain[used, None] * flicker(floor, cycles[used] * rate_hz, rate_hz) + rounded[used]
    relative = (power[used] - rest) / gain[used, None]
    # The scatter of a bin includes flicker and rounding: weight it by the share of the white noise.
    share = gain[used, None] * expected**2 / (gain[used, None] * expected**2 + rest)
    # Weighted mean of the levels of the bins, and its number of independent bins.
    level = np.sum(share**2 * relative, axis=0) / np.sum(share**2, axis=0)
    effective = np.sum(share**2, axis=0) / HANN_WIDTH
    sigma = np.sqrt(np.maximum(level, 1e-12))
    judged = _Judged(sigma, sigma / (2 * np.sqrt(effective)))
    model = gain[used, None] * np.maximum(level, 1e-12) + rest
    ratio = power[used] / model
    hz = cycles[used] * rate_hz
    for k in range(len(sigma)):
        low, high = variance_ratio(2 * effective[k])
        judged.level_off[k] = not low <= level[k] / expected[k] ** 2 <= high
        highest = int(np.argmax(ratio[:, k]))
        if ratio[highest, k] > highest_bin(len(ratio)):
            # A line of rms r gives about n r² / 3 in its highest bin with Hann's window.
            rms = math.sqrt(3 * power[used][highest, k] / gain[used][highest] / len(numbers))
            judged.tones.append((k, float(hz[highest]), rms))
        # The shape is judged by the means over bands of the spectrum.
        bands = [band for band in np.array_split(ratio[:, k], BANDS) if len(band)]
        for band in bands:
            low, high = variance_ratio(2 * len(band) / HANN_WIDTH)
            if not low <= float(np.mean(band)) <= high and k not in judged.shape_off:
                judged.shape_off.append(k)
    return judged


def _answer_noise(found: StepResult, off: Sequence[bool]) -> None:
    """Answer the questions on the noise by the first six figures of `found`, one figure for each axis.

    `off` has for each axis True if its noise differs from the variant's.
    """
    for question, axes in (("accel_noise", slice(0, 3)), ("gyro_noise", slice(3, 6))):
        figures = found.figures[axes]
        text = f"{', '.join(f'{figure.value:.3g}' for figure in figures)} {figures[0].unit}"
        text += f" where the table says {figures[0].expected:g}"
        found.check(question, not any(off[axes]), text, *figures)


_FILTER_SCANS = 2048


def measure_filter(bench: BringupBench, found: StepResult) -> Ending:
    """Write M = 0 … 6 in SENS_AVG and measure the noise of the accelerometers at each.

    The noise at rest with each M is compared with the noise at M = 0.
    """
    bench.sample_quickly()
    part, rate = bench.sensor.variant, bench.sensor.configuration().sample_rate_hz
    expected = part.performance.noise[:3] / part.accel_mg_per_lsb
    wrong, first, u_first = [], 0.0, 0.0
    for m in range(7):
        bench.sensor.write("SENS_AVG", sens_avg_word(300, m))
        bench.bus.sleep_s(bench.sensor.configuration().settling_s)
        block = bench.scans(_FILTER_SCANS, ACCEL_OUT, gaps=False)
        judged = _by_spectrum(part, block.numbers().astype(np.float64), m, rate, expected)
        # Noise of an axis before the filter, for the gain of the table, and relative u.
        noise = float(judged.sigma.mean())
        u = float(np.linalg.norm(judged.u)) / len(judged.u) / noise
        if m == 0:
            if judged.tones:
                raise NotMeasuredError("the table vibrates, see the step 'noise'")
            first, u_first = noise, u
            continue
        ratio, u = noise / first, math.hypot(u, u_first)
        gain = white_noise_gain(m)
        found.measure(f"noise gain at M = {m}", gain * ratio, "1", gain * ratio * u, gain)
        # Without a filter the noise is white within 2 %.
        if abs(ratio - 1) > Z * u + 0.02:
            wrong.append(f"M = {m}: {gain * ratio:.3f} instead of {gain:.3f}")
    text = f"noise gains {'; '.join(wrong)}" if wrong else "two boxcars of 2^M taps, as the table says"
    found.check("filter_gain", not wrong, text, *found.figures)
    return found.by_answers()


def measure_offsets(bench: BringupBench, found: StepResult) -> Ending:
    """Write +1000 to XACCL_OFF, YACCL_OFF, ZACCL_OFF and look how far the outputs move.

    Reads the outputs without an offset, with it and without it; then changes an offset once more, with the
    longest filter: a change before the filter appears in the output over 127 samples, and a change after
    the filter at once.
    """
    sensor = bench.sensor
    bench.sample_quickly()
    held = [sensor.read(name) for name in ACCEL_OFF]
    highest = BY_NAME[ACCEL_OFF[0]].range[1]
    moved = [value + (_STEP if value + _STEP <= highest else -_STEP) for value in held]
    bench.scans(_SCANS, ACCEL_OUT)
    for numbers in (moved, held):
        for name, number in zip(ACCEL_OFF, numbers, strict=True):
            sensor.write(name, number)
        bench.wait_updates()
        bench.scans(_SCANS, ACCEL_OUT)
    sensor.write("SENS_AVG", sens_avg_word(300, 6))
    bench.wait_updates()
    bench.scans(16, ACCEL_OUT[:1])
    sensor.write(ACCEL_OFF[0], moved[0])
    bench.bus.sleep_s(2 * sensor.configuration().sample_period_s)
    bench.repeated(ACCEL_OUT[0], 2)
    sensor.write(ACCEL_OFF[0], held[0])
    chip = RecordedChip(bench.bus.calls)
    for name in ("accel_offset_lsb", "offset_after_filter"):
        finding = BY_QUESTION[name].judge([*BY_QUESTION[name].observe(chip, sensor.variant)])
        text = "the replies do not show it"
        if finding.observations:
            table = f", the table says {finding.question.table}"
            said = "" if finding.outcome is Outcome.CONFIRMS else table
            text = f"{finding.question.text} {finding.best}{said} ({finding.seen})"
        found.answers[name] = Answer(finding.outcome, text, finding.measured)
    return found.by_answers()


def _mean_u(bench: BringupBench, count: int) -> Floats:
    """Return the standard uncertainty (6,) in LSB of the means of all axes over `count` scans.

    It is computed from white noise, flicker noise and rounding, with the figures of the sensor variant.
    """
    part = bench.sensor.variant
    lsb, _, _ = scales(registers((*ACCEL_OUT, *GYRO_OUT)), part, 300)
    white, floor = part.performance.noise / lsb, part.performance.floor / lsb
    return np.asarray(np.sqrt(white**2 / count + 2 * floor**2 + 1 / 12 / count))


def run_self_tests(bench: BringupBench, found: StepResult) -> Ending:
    """Run the internal self-test, then the manual one with the positive and the negative stimulus.

    The change of the outputs of all six axes is measured by means without, with +, without, with − and
    without stimulus.
    """
    sensor = bench.sensor
    internal = sensor.self_test()
    bench.sample_quickly()
    bench.wait_updates()
    names = (*ACCEL_OUT, *GYRO_OUT)
    means = []
    for sign in ("", "positive", "", "negative", ""):
        sensor.write_fields("MSC_CTRL", positive=int(sign == "positive"), negative=int(sign == "negative"))
        bench.bus.sleep_s(0.04)  # the duration of the internal test is enough for the elements
        bench.wait_updates()
        means.append(bench.means(_SCANS // 2, names))
    zero, up, between, down, end = means
    lsb, _, units = scales(registers(names), sensor.variant, sensor.configuration().gyro_range_dps)
    # Each stimulus is compared with the means without stimulus before and after it.
    plus, minus = up - (zero + between) / 2, down - (between + end) / 2
    range_scale = np.array([1.0] * 3 + [0.07326 / lsb[3]] * 3)
    u = _mean_u(bench, _SCANS // 2) * math.sqrt(1.5) * range_scale
    limit = Z * u
    for sign, values in (("positive", plus), ("negative", minus)):
        for name, value, s, size, unit in zip(names, values, u, lsb, units, strict=True):
            found.measure(f"{name}, {sign} stimulus", value * size, unit, s * size)
    wrong = list(internal.self_test_failures)
    wrong += [
        f"{name} does not answer to the positive stimulus"
        for k, name in enumerate(names)
        if abs(plus[k]) <= limit[k]
    ]
    # Answer of each axis to the negative stimulus: 0 none, 1 as to the positive one, −1 the opposite.
    answers = np.where(np.abs(minus) > limit, np.sign(plus * minus), 0)
    for question, axes, right in (("self_test_accel", slice(0, 3), 0), ("self_test_gyro", slice(3, 6), -1)):
        if len({*answers[axes]}) > 1:
            wrong.append(f"{', '.join(names[axes])} answer differently to the negative stimulus")
        answer = answers[axes][0]
        text = f"{', '.join(names[axes])} answer {_ANSWERS[answer]}"
        found.check(question, answer == right, text, *found.figures[axes], *found.figures[6:][axes])
    return (Verdict.FAULT, "; ".join(wrong)) if wrong else found.by_answers()


_ANSWERS = {
    -1: "to both signs of the stimulus",
    0: "to the positive sign only",
    1: "in the same direction to both signs",
}


def check_status(bench: BringupBench, found: StepResult) -> Ending:
    """Raise an alarm and over-range by registers alone, end them, and look at EA and STATUS.

    Tests if the alarm bit stays until STATUS is read, and if the over-range bit clears.
    """
    bench.sample_quickly()
    bench.sensor.read("STATUS")
    bench.wait_updates()
    if standing := bench.sensor.read("STATUS"):
        raise NotMeasuredError(f"STATUS is 0x{standing:04X} already")
    bench.sensor.set_alarm(1, Alarm("SUPPLY_OUT", threshold=1.0))
    bench.wait_updates()
    # EA of an output shows it; a read of STATUS would clear the bit.
    raised = bool(bench.sensor.read_words(["XACCL_OUT"])[0] & EA)
    bench.sensor.clear_alarm(1)
    bench.wait_updates()
    stays = bool(bench.sensor.read("STATUS") & _ALARM)
    bench.wait_updates()
    kept = bool(bench.sensor.read("STATUS") & _ALARM)
    if raised:
        until = "until STATUS is read" if stays else "not until STATUS is read"
        found.check("alarm_stays", stays, f"the bit of an alarm stays {until}")
    try:
        _over_range(bench, found)
    except NotMeasuredError as reason:
        found.answers["over_range_falls"] = Answer(Outcome.NOT_MEASURED, str(reason))
    if not raised:
        return Verdict.DIFFERS, "an alarm on the supply above 1 V does not show as EA"
    if kept:
        return Verdict.DIFFERS, "an alarm's bit is not cleared by a read of STATUS"
    return found.by_answers()


def _over_range(bench: BringupBench, found: StepResult) -> None:
    """Drive one axis over its range by its offset register and back; see if the bit of STATUS falls.

    The axis is the one along which gravity is largest.

    Raises
    ------
    NotMeasuredError
        The offset register cannot drive the axis over its range.
    """
    sensor = bench.sensor
    part = sensor.variant
    mean = bench.means(64, ACCEL_OUT)
    axis = int(np.argmax(np.abs(mean)))
    name = ACCEL_OFF[axis]
    held = sensor.read(name)
    low, high = BY_NAME[name].range
    end = high if mean[axis] > 0 else low
    rest = float(mean[axis]) - held
    reached_mg = abs(rest + end) * part.accel_mg_per_lsb
    # The condition has to be true in every sample, even with the largest noise.
    needed_mg = 1000 * part.accel_range_g + Z * part.performance.noise_mg
    if reached_mg < needed_mg:
        raise NotMeasuredError(
            f"with its offset {ACCEL_OUT[axis]} reaches {reached_mg:.0f} mg only of {needed_mg:.0f}:"
            " turn the part so that an axis points along gravity"
        )

    def bit_after(number: int) -> bool:
        sensor.write(name, number)
        bench.wait_updates()
        return bool(sensor.read("STATUS") & _OVER_RANGE)

    bit_after(end)
    if not bit_after(end):
        raise NotMeasuredError(f"{reached_mg:.0f} mg by the offset raise no over-range")
    bench.wait_updates()  # the read cleared the bit, and the condition sets it again
    stays = bit_after(held)
    text = f"after its condition has ended, the bit of over-range {'stays' if stays else 'falls'}"
    found.check("over_range_falls", not stays, text)


def check_flash_count(bench: BringupBench, found: StepResult) -> Ending:
    """Reset the part, so that registers have the flash's numbers, and save them: ENDURANCE + 1.

    The save changes none of the numbers.
    """
    if not bench.supply_ok:
        raise NotMeasuredError("the supply is outside its limits, so that a flash update may fail")
    used = {"AUX_DAC": 0x0FFF, "GPIO_CTRL": 0x0003}  # a voltage, lines that are outputs
    if in_use := [name for name, bits in used.items() if bench.sensor.read(name) & bits]:
        raise NotMeasuredError(f"{' and '.join(in_use)} is in use, which a reset would drop")
    before = bench.sensor.read("ENDURANCE")
    bench.sensor.reset()
    try:
        after = bench.sensor.save_to_flash()
    except ChipError as error:
        found.check("flash_count", False, str(error))
        return Verdict.FAULT, str(error)
    found.measure("ENDURANCE before", before)
    found.measure("ENDURANCE after", after, expected=before + 1)
    found.check("flash_count", True, f"ENDURANCE went from {before} to {after}", *found.figures)
    return found.by_answers()
