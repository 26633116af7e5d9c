"""Bring-up steps that write registers: offsets, self-test, STATUS, flash. All writes are undone."""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.errors import ChipError
from adis_gonio.bench.bringup.bringup_step import (
    Answer,
    BringupBench,
    BringupStep,
    Floats,
    Measured,
    Outcome,
    SideEffect,
    StepResult,
)
from adis_gonio.device.sensor import registers as table
from adis_gonio.device.sensor.registers import ACCEL_OFF, ACCEL_OUT, BY_NAME, GYRO_OUT
from adis_gonio.device.sensor.settings import Alarm, scales, sens_avg_word

_SCANS = 512
_STEP = 1000
_MOST_M = 6

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
        """Compare the means with an offset and without it; means before and after it cancel a drift."""
        sensor = bench.sensor
        bench.sample_quickly()
        held = [sensor.read(name) for name in ACCEL_OFF]
        steps = [_STEP if value + _STEP <= BY_NAME[ACCEL_OFF[0]].range[1] else -_STEP for value in held]
        before = bench.means(_SCANS, ACCEL_OUT)
        self._write(bench, [value + step for value, step in zip(held, steps, strict=True)])
        bench.wait_updates()
        moved = bench.means(_SCANS, ACCEL_OUT)
        self._write(bench, held)
        bench.wait_updates()
        after = bench.means(_SCANS, ACCEL_OUT)
        # The mean of before and after cancels a linear drift.
        ratio = (moved - (before + after) / 2) / np.array(steps)
        u = _mean_u(bench, _SCANS)[:3] * math.sqrt(1.5) / _STEP
        for out, name, r, s in zip(ACCEL_OUT, ACCEL_OFF, ratio, u, strict=True):
            found.measure(f"step of {out} / step of {name}", r, "1", s, 1.0)
        off = [k for k in range(3) if abs(ratio[k] - 1) > bench.budget.z() * u[k]]
        filtered = self._behind_filter(bench, held[0], steps[0], float(ratio[0]))
        for name, value in zip(ACCEL_OFF, held, strict=True):
            # A low byte alone, for a recording: does it act without the high byte?
            word = BY_NAME[name].word(value) ^ 0x40
            bench.bus.exchange_array(table.write_frames(BY_NAME[name], word, byte_mask=0x00FF))
            sensor.read(name)
        text = f"the outputs moved by {', '.join(f'{r:.4f}' for r in ratio)} LSB for each LSB of the offset"
        found.check("accel_offset_lsb", not off, text, *found.figures)
        found.answers["offset_after_filter"] = filtered
        if off:
            return found.differs(f"{text} registers: their LSB is not the output's")
        return found.ok(f"{text} registers")

    @staticmethod
    def _write(bench: BringupBench, values: list[int]) -> None:
        for name, value in zip(ACCEL_OFF, values, strict=True):
            bench.sensor.write(name, value)

    @staticmethod
    def _behind_filter(bench: BringupBench, held: int, step: int, ratio: float) -> Answer:
        """Test if a change of an offset acts before or after the filter.

        With the longest filter, a change before the filter appears in the output over 127 samples, and a
        change after the filter at once. The offset is that of X: `held` is its present number, `step` the
        change, and `ratio` the change of the output for one LSB of the offset.
        """
        sensor = bench.sensor
        sensor.write("SENS_AVG", sens_avg_word(300, _MOST_M))
        bench.wait_updates()
        before = bench.means(16, ACCEL_OUT[:1])[0]
        sensor.write(ACCEL_OFF[0], held + step)
        bench.bus.sleep_s(2 * sensor.configuration().sample_period_s)
        begin_s = bench.bus.now_s()
        words, _ = bench.repeated(ACCEL_OUT[0], 2)
        passed = 2 + (bench.bus.now_s() - begin_s) / sensor.configuration().sample_period_s
        row = BY_NAME[ACCEL_OUT[0]]
        share = (row.number(int(words[0])) - before) / (step * ratio)
        sensor.write(ACCEL_OFF[0], held)
        taps = 1 << _MOST_M
        ramp = min(passed, taps) ** 2 / 2 / taps**2
        figures = (
            Measured("share of the step that is there at once", float(share), "1"),
            Measured("the same if it went through the filter", float(ramp), "1"),
        )
        if ramp > 0.4:
            return Answer(Outcome.NOT_MEASURED, "this bridge reads too late to see it", figures)
        after = share > (0.5 + ramp / 2)
        return Answer(
            Outcome.MEASURED,
            f"{'after' if after else 'before'} the filter: {100 * share:.0f} % of the step came with the"
            f" next reading at M = {_MOST_M}",
            figures,
        )


def _mean_u(bench: BringupBench, count: int) -> Floats:
    """Return the standard uncertainty (6,) in LSB of the means of all axes over `count` scans.

    It is computed from white noise, flicker noise and rounding, with the figures of the sensor variant.
    """
    part = bench.sensor.variant
    lsb, _, _ = scales(table.registers((*ACCEL_OUT, *GYRO_OUT)), part, 300)
    white, floor = part.performance.noise / lsb, part.performance.floor / lsb
    result: Floats = np.sqrt(white**2 / count + 2 * floor**2 + 1 / 12 / count)
    return result


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
        limit = np.array([bench.budget.z() for _ in names]) * u
        for sign, values in (("positive", plus), ("negative", minus)):
            for name, value, s, size, unit in zip(names, values, u, lsb, units, strict=True):
                found.measure(f"{name}, {sign} stimulus", value * size, unit, s * size)
        _answer_self_test(found, plus, minus, limit)
        wrong = list(internal.failures)
        wrong += [
            f"{name} does not answer to the positive stimulus"
            for k, name in enumerate(names)
            if abs(plus[k]) <= limit[k]
        ]
        if wrong:
            return found.fault("; ".join(wrong))
        if off := found.contradictions():
            return found.differs(off)
        return found.ok(
            f"passed; the positive stimulus moves the accelerometers by"
            f" {', '.join(f'{v:.0f}' for v in (plus * lsb)[:3])} mg and the gyros by"
            f" {', '.join(f'{v:.0f}' for v in (plus * lsb)[3:])} °/s"
        )


def _answer_self_test(found: StepResult, plus: Floats, minus: Floats, limit: Floats) -> None:
    figures = found.figures
    both = [abs(minus[k]) > limit[k] and plus[k] * minus[k] < 0 for k in (3, 4, 5)]
    deaf = ", ".join(axis for axis, answers in zip("XYZ", both, strict=True) if not answers)
    who = f"gyro {deaf} does not answer" if deaf else "the gyros answer"
    of_gyros = [figure for figure in figures if "GYRO" in figure.name]
    found.check("self_test_gyro", all(both), f"{who} to both signs, opposite ways", *of_gyros)
    still = (abs(minus[:3]) <= limit[:3]).all()
    text = "do not move at the negative stimulus" if still else "answer to the negative stimulus as well"
    of_accels = [figure for figure in figures if "ACCL" in figure.name]
    found.check("self_test_accel", still, f"the accelerometers {text}", *of_accels)


class StatusBits(BringupStep):
    """Tests if bits of STATUS clear when their condition ends, and measures the over-range threshold."""

    name = "status"
    does = "raises an alarm and over-range by registers alone, ends them, and looks at EA and STATUS"
    effect = SideEffect.WRITES
    question = "Write ALM_MAG1, ALM_CTRL and an accelerometer's offset (a second each)?"
    settles = ("alarm_stays", "over_range_falls", "over_range_threshold")
    _halvings = 9

    def run(self, bench: BringupBench, found: StepResult) -> StepResult:
        """Test if the alarm bit stays until STATUS is read, and if the over-range bit clears."""
        bench.sample_quickly()
        bench.status()
        bench.wait_updates()
        if standing := bench.status():
            return found.not_measured(f"STATUS is 0x{standing:04X} already")
        self._alarm(bench, found)
        self._over_range(bench, found)
        if off := found.contradictions():
            return found.differs(off)
        texts = (found.answers[name].text for name in ("alarm_stays", "over_range_falls"))
        return found.ok("; ".join(texts))

    @staticmethod
    def _alarm(bench: BringupBench, found: StepResult) -> None:
        bench.sensor.set_alarm(1, Alarm("SUPPLY_OUT", threshold=1.0))
        bench.wait_updates()
        raised = bench.alarm_stands()
        bench.sensor.clear_alarm(1)
        bench.wait_updates()
        stays = bench.alarm_stands()
        read = bool(bench.status() & _ALARM)
        bench.wait_updates()
        cleared = not bench.status() & _ALARM
        text = "an alarm's bit stays until STATUS is read, which clears it"
        if not raised:
            text = "an alarm on the supply above 1 V does not show as EA"
        elif not cleared:
            text = "an alarm's bit is not cleared by a read of STATUS"
        elif not (stays and read):
            text = "an alarm's bit clears automatically when its condition ends"
        found.check("alarm_stays", raised and stays and read and cleared, text)

    def _over_range(self, bench: BringupBench, found: StepResult) -> None:
        """Drive one axis over its range by its offset register, and find the threshold by bisection.

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
        needed_mg = 1000 * part.accel_range_g + bench.budget.z() * part.performance.noise_mg

        def unknown(why: str) -> None:
            for question in ("over_range_falls", "over_range_threshold"):
                found.answer(question, Outcome.NOT_MEASURED, f"not measured: {why}")

        if reached_mg < needed_mg:
            unknown(
                f"with its offset {ACCEL_OUT[axis]} reaches {reached_mg:.0f} mg only of {needed_mg:.0f}:"
                " turn the part so that an axis points along gravity"
            )
            return

        def over(number: int) -> bool:
            bench.wait_updates()  # a bit that the last read cleared is set again
            sensor.write(name, number)
            bench.wait_updates()
            bench.status()
            bench.wait_updates(16)
            return bool(bench.status() & _OVER_RANGE)

        if not over(end):
            unknown(f"{reached_mg:.0f} mg by the offset raise no over-range: it is judged without")
            return
        bench.wait_updates()
        stood = bench.alarm_stands()
        sensor.write(name, held)
        bench.wait_updates(8)
        fell = not bench.alarm_stands()
        word = bench.status()
        falls = fell and not word & _OVER_RANGE
        if stood:
            text = "automatically when its condition ends" if falls else "only when STATUS is read"
            verb = "clears" if falls else "does not clear automatically,"
            found.check("over_range_falls", falls, f"over-range {verb} {text}")
        else:
            why = "not measured: over-range came and went before its condition ended"
            found.answer("over_range_falls", Outcome.NOT_MEASURED, why)
        inside, outside = held, end
        for _ in range(self._halvings):
            middle = (inside + outside) // 2
            inside, outside = (inside, middle) if over(middle) else (middle, outside)
        over(held)
        threshold = abs(rest + (inside + outside) / 2) * part.accel_mg_per_lsb
        # One sample over the limit is enough: noise raises the bit some standard deviations below it.
        u = math.hypot(2 * part.performance.noise_mg, abs(outside - inside) * part.accel_mg_per_lsb)
        figure = found.measure("over-range threshold", threshold, "mg", u, 1000 * part.accel_range_g)
        text = f"{threshold:.0f} mg on {ACCEL_OUT[axis]}, judged with its offset; the range is"
        text += f" {1000 * part.accel_range_g:.0f} mg"
        found.answer("over_range_threshold", Outcome.MEASURED, text, figure)


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
        return found.settle("flash_count", f"ENDURANCE went from {before} to {after}", differs=False)
