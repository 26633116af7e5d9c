"""Bring-up steps that write registers: offsets, self-test, STATUS, flash. All writes are undone."""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.errors import ChipError
from adis_gonio.bench.bringup.bringup_step import (
    BringupBench,
    BringupStep,
    Floats,
    Outcome,
    SideEffect,
    StepResult,
    Z,
)
from adis_gonio.bench.bringup.chip_rows import BY_QUESTION
from adis_gonio.bench.bringup.recorded_chip import RecordedChip
from adis_gonio.device.sensor import registers as table
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, BY_NAME, GYRO_OUT
from adis_gonio.device.sensor.settings import Alarm, scales, sens_avg_word

_SCANS = 512
_STEP = 1000

_OVER_RANGE = BY_NAME["STATUS"].field("over_range").mask
_ALARM = BY_NAME["STATUS"].field("alarm1").mask


class Offset(BringupStep):
    """Measures the LSB of the offset registers, and tests if offsets act before or after the filter."""

    name = "offset"
    does = f"writes {_STEP:+d} to XACCL_OFF, YACCL_OFF, ZACCL_OFF and looks how far the outputs move"
    effect = SideEffect.WRITES
    question = f"Write XACCL_OFF, YACCL_OFF and ZACCL_OFF ({_STEP:+d} LSB for a second)?"
    settles = ("accel_offset_lsb", "offset_after_filter")

    def run(self, bench: BringupBench, found: StepResult) -> StepResult:
        """Read the outputs without an offset, with it and without it; then change an offset once more.

        The last change is made with the longest filter: a change before the filter appears in the output
        over 127 samples, and a change after the filter at once.
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
        for name in self.settles:
            finding = BY_QUESTION[name].judge([*BY_QUESTION[name].observe(chip, sensor.variant)])
            text = "the replies do not show it"
            if finding.observations:
                table = f", the table says {finding.question.table}"
                said = "" if finding.outcome is Outcome.CONFIRMS else table
                text = f"{finding.question.text} {finding.best}{said} ({finding.seen})"
            found.answer(name, finding.outcome, text, *finding.measured)
        return found.by_answers()


def _mean_u(bench: BringupBench, count: int) -> Floats:
    """Return the standard uncertainty (6,) in LSB of the means of all axes over `count` scans.

    It is computed from white noise, flicker noise and rounding, with the figures of the sensor variant.
    """
    part = bench.sensor.variant
    lsb, _, _ = scales(table.registers((*ACCEL_OUT, *GYRO_OUT)), part, 300)
    white, floor = part.performance.noise / lsb, part.performance.floor / lsb
    return np.asarray(np.sqrt(white**2 / count + 2 * floor**2 + 1 / 12 / count))


class SelfTests(BringupStep):
    """Runs the internal self-test, and the manual self-test with both signs of the stimulus."""

    name = "self-test"
    does = "runs the internal self-test, then the manual one with the positive and the negative stimulus"
    effect = SideEffect.WRITES
    question = "Run the self-tests (MSC_CTRL[10:8], about 3 s, volatile)?"
    settles = ("self_test_gyro", "self_test_accel")

    def run(self, bench: BringupBench, found: StepResult) -> StepResult:
        """Measure the change of the outputs of all six axes by each stimulus.

        The means are taken without, with +, without, with − and without stimulus.
        """
        internal = bench.sensor.self_test()
        bench.sample_quickly()
        bench.wait_updates()
        names = (*ACCEL_OUT, *GYRO_OUT)
        means = []
        for sign in ("", "positive", "", "negative", ""):
            bench.sensor.write_fields(
                "MSC_CTRL", positive=int(sign == "positive"), negative=int(sign == "negative")
            )
            bench.bus.sleep_s(0.04)  # the duration of the internal test is enough for the elements
            bench.wait_updates()
            means.append(bench.means(_SCANS // 2, names))
        zero, up, between, down, end = means
        lsb, _, units = scales(
            table.registers(names), bench.sensor.variant, bench.sensor.configuration().gyro_range_dps
        )
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
        for question, axes, right in (
            ("self_test_accel", slice(0, 3), 0),
            ("self_test_gyro", slice(3, 6), -1),
        ):
            if len({*answers[axes]}) > 1:
                wrong.append(f"{', '.join(names[axes])} answer differently to the negative stimulus")
            answer = answers[axes][0]
            text = f"{', '.join(names[axes])} answer {_ANSWERS[answer]}"
            found.check(question, answer == right, text, *found.figures[axes], *found.figures[6:][axes])
        return found.fault("; ".join(wrong)) if wrong else found.by_answers()


_ANSWERS = {
    -1: "to both signs of the stimulus",
    0: "to the positive sign only",
    1: "in the same direction to both signs",
}


class StatusBits(BringupStep):
    """Tests if bits of STATUS clear when their condition ends."""

    name = "status"
    does = "raises an alarm and over-range by registers alone, ends them, and looks at EA and STATUS"
    effect = SideEffect.WRITES
    question = "Write ALM_MAG1, ALM_CTRL and an accelerometer's offset (a second each)?"
    settles = ("alarm_stays", "over_range_falls")

    def run(self, bench: BringupBench, found: StepResult) -> StepResult:
        """Test if the alarm bit stays until STATUS is read, and if the over-range bit clears."""
        bench.sample_quickly()
        bench.sensor.read("STATUS")
        bench.wait_updates()
        if standing := bench.sensor.read("STATUS"):
            return found.not_measured(f"STATUS is 0x{standing:04X} already")
        bench.sensor.set_alarm(1, Alarm("SUPPLY_OUT", threshold=1.0))
        bench.wait_updates()
        raised = bench.alarm_stands()
        bench.sensor.clear_alarm(1)
        bench.wait_updates()
        stays = bool(bench.sensor.read("STATUS") & _ALARM)
        bench.wait_updates()
        kept = bool(bench.sensor.read("STATUS") & _ALARM)
        if raised:
            until = "until STATUS is read" if stays else "not until STATUS is read"
            found.check("alarm_stays", stays, f"the bit of an alarm stays {until}")
        self._over_range(bench, found)
        if not raised:
            return found.differs("an alarm on the supply above 1 V does not show as EA")
        if kept:
            return found.differs("an alarm's bit is not cleared by a read of STATUS")
        return found.by_answers()

    def _over_range(self, bench: BringupBench, found: StepResult) -> None:
        """Drive one axis over its range by its offset register and back; see if the bit of STATUS falls.

        The axis is the one along which gravity is largest.
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

        def unknown(why: str) -> None:
            found.answer("over_range_falls", Outcome.NOT_MEASURED, why)

        if reached_mg < needed_mg:
            unknown(
                f"with its offset {ACCEL_OUT[axis]} reaches {reached_mg:.0f} mg only of {needed_mg:.0f}:"
                " turn the part so that an axis points along gravity"
            )
            return

        def bit_after(number: int) -> bool:
            sensor.write(name, number)
            bench.wait_updates()
            return bool(sensor.read("STATUS") & _OVER_RANGE)

        bit_after(end)
        if not bit_after(end):
            unknown(f"{reached_mg:.0f} mg by the offset raise no over-range")
            return
        bench.wait_updates()  # the read cleared the bit, and the condition sets it again
        stays = bit_after(held)
        text = f"after its condition has ended, the bit of over-range {'stays' if stays else 'falls'}"
        found.check("over_range_falls", not stays, text)


class FlashCount(BringupStep):
    """Tests if the register ENDURANCE counts a flash update by one."""

    name = "flash count"
    does = "resets the part, so that the registers have the flash's numbers, and saves them: ENDURANCE + 1"
    effect = SideEffect.FLASH
    question = "Reset the part and write the flash once (10 000 writes are its life)?"
    settles = ("flash_count",)

    def run(self, bench: BringupBench, found: StepResult) -> StepResult:
        """Save the present numbers to flash, which changes none, and compare ENDURANCE before and after."""
        if not bench.supply_ok:
            return found.not_measured("the supply is outside its limits, so that a flash update may fail")
        used = {"AUX_DAC": 0x0FFF, "GPIO_CTRL": 0x0003}  # a voltage, lines that are outputs
        in_use = [name for name, bits in used.items() if bench.sensor.read(name) & bits]
        if in_use:
            return found.not_measured(f"{' and '.join(in_use)} is in use, which a reset would drop")
        before = bench.sensor.read("ENDURANCE")
        bench.sensor.reset()
        try:
            after = bench.sensor.save_to_flash()
        except ChipError as error:
            found.answer("flash_count", Outcome.CONTRADICTS, str(error))
            return found.fault(str(error))
        found.measure("ENDURANCE before", before)
        found.measure("ENDURANCE after", after, expected=before + 1)
        found.check("flash_count", True, f"ENDURANCE went from {before} to {after}", *found.figures)
        return found.by_answers()
