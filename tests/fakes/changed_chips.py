"""Simulated chips with one rule of the register table changed, and sessions that exercise the rules.

Each chip is written from the description of the part, with its facts and doubts, and not from the code that
looks for the changes. `rule` is the name of the changed row.

Further chips go into a module of their own, with one dictionary `CHANGES: dict[str, Change]`, and
`scripts/changed_chips.py --list MODULE` runs them. The key says in a few words what the chip does
differently. A `Change` has:

* `rule`: the row of the register table that says otherwise, for example `flash_time`. The command
  `adis-gonio bringup --from FILE` prints the names of all rows, and `rows()` returns each name with the
  table's statement. If two rows describe the changed property, write both with a comma between them: either
  counts as named.
* `kind`: a subclass of `adis_gonio.sim.SimulatedChip` that behaves differently in this one property and is
  right in all others. Its methods are the places to change: `_answer` (the reply to a frame), `_read` and
  `_fast` (reads, one by one and in bulk: a chip that changes `_read` for output registers has to return 0
  from `_fast`, so that every read takes the slow way), `_control_word` (the content of a control register
  as it is read), `_write`, `_command` (a byte written to COMMAND), `_finish` (the end of a busy time),
  `_save` (the flash update), `_restart_sampling` (the period), `_memory` (`sim.memory.Memory`: registers
  and flash) and `_sampler` (`sim.sampling.SignalChain`: scale, offsets, filter and self-test of the
  signals).
* `options`: further arguments of the chip's constructor, `settings`: fields of `sim.WorldSettings`, for
  example the noise.
* `parts`: number of parts whose recordings are judged together, if one part does not decide the row.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.bringup import Permission, bring_up
from adis_gonio.bench.bringup.chip_rows import ROWS
from adis_gonio.device.bus.recording import RecordingBus
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_ADDRESS,
    BY_NAME,
    GYRO_OFF,
    GYRO_OUT,
    ND,
)
from adis_gonio.device.sensor.settings import Alarm
from adis_gonio.sim import SimBus, SimulatedChip, World, WorldSettings, sampling
from adis_gonio.sim.chip import State
from adis_gonio.sim.sampling import ACCEL_COLUMNS, ALARM_BITS, GYRO_COLUMNS, SignalChain

# -- words on the wire -----------------------------------------------------------------------------------


class _AfterWrite(SimulatedChip):
    """Shifts out something else than zeros after a write."""

    def _after(self, word: int) -> int:
        raise NotImplementedError

    def _answer(self, word, bits, clock_hz, cs_hold_s, stall, period):
        before = self._reply
        reply = super()._answer(word, bits, clock_hz, cs_hold_s, stall, period)
        if word >> 15 and bits == 16 and self.state is not State.STARTING:
            self._last = before
            self._reply = self._after(word)
        return reply


class WriteEcho(_AfterWrite):
    def _after(self, word):
        return word


class WriteContent(_AfterWrite):
    def _after(self, word):
        return self.memory.at(word >> 8 & 0x3F)


class WriteStale(_AfterWrite):
    def _after(self, word):
        return self._last


class ReservedOnes(SimulatedChip):
    def _control_word(self, address):
        row = BY_ADDRESS.get(address & ~1)
        word = super()._control_word(address)
        if row is None or row.name in ("ENDURANCE", "STATUS") or row.signed:
            return word
        return word | ~row.write_mask & 0xFFFF


class ReservedMirror(SimulatedChip):
    """Registers of one byte show it twice."""

    def _control_word(self, address):
        row = BY_ADDRESS.get(address & ~1)
        word = super()._control_word(address)
        return word | (word & 0xFF) << 8 if row is not None and row.write_mask == 0xFF else word


class OffsetsExtended(SimulatedChip):
    def _control_word(self, address):
        row = BY_ADDRESS.get(address & ~1)
        word = super()._control_word(address)
        return row.number(word) & 0xFFFF if row is not None and row.signed else word


class OffsetsOnes(SimulatedChip):
    def _control_word(self, address):
        row = BY_ADDRESS.get(address & ~1)
        word = super()._control_word(address)
        return word | ~row.data_mask & 0xFFFF if row is not None and row.signed else word


# -- flags and STATUS ------------------------------------------------------------------------------------


class StatusClearedByAnyRead(SimulatedChip):
    def _read(self, address):
        word = super()._read(address)
        self._status = 0
        return word

    def _fast(self, *args):
        return 0


class AlarmFalls(SimulatedChip):
    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self._falling |= ALARM_BITS[0] | ALARM_BITS[1]


class NewNever(SimulatedChip):
    def _read(self, address):
        word = super()._read(address)
        return word & ~ND if BY_ADDRESS.get(address & ~1, BY_NAME["STATUS"]).flags else word

    def _fast(self, *args):
        return 0


# -- flash, reset, busy times ----------------------------------------------------------------------------


class CountsTwice(SimulatedChip):
    def _save(self):
        super()._save()
        self.memory["ENDURANCE"] = self.memory["ENDURANCE"] + 1


class CountsNever(SimulatedChip):
    def _save(self):
        before = self.memory["ENDURANCE"]
        super()._save()
        self.memory["ENDURANCE"] = before


class _Slow(SimulatedChip):
    begun = State.FLASHING
    length_s = 0.0

    def _command(self, data, now):
        super()._command(data, now)
        if self.state is self.begun:
            self._until = now + self.length_s


class FlashSlow(_Slow):
    length_s = 0.25


class FlashVerySlow(_Slow):
    length_s = 1.0


class PrecisionSlow(_Slow):
    begun, length_s = State.NULLING, 60.0


class ResetSlow(_Slow):
    """Frames that come too early are lost, but do not harm."""

    begun, length_s = State.STARTING, 0.5

    def _command(self, data, now):
        super()._command(data, now)
        if self.state is State.STARTING:
            self._restart_sampling(self._until, empty=True)

    def _refusal(self, bits, clock_hz, stall, limits):
        if self.state is State.STARTING:
            return self.floating_word
        return super()._refusal(bits, clock_hz, stall, limits)


class ResetDead(ResetSlow):
    """Frames that come too early silence the chip."""

    def _refusal(self, bits, clock_hz, stall, limits):
        return SimulatedChip._refusal(self, bits, clock_hz, stall, limits)


class _TestSlow(SimulatedChip):
    length_s = 0.0

    def _write(self, *args):
        before = self.state
        super()._write(*args)
        if self.state is State.TESTING and before is not State.TESTING:
            self._until = self._last_rise + self.length_s


class SelfTestSlow(_TestSlow):
    length_s = 0.2


class SelfTestBitStays(SimulatedChip):
    def _finish(self, now):
        tested = self.state is State.TESTING
        super()._finish(now)
        if tested:
            self.memory["MSC_CTRL"] = self.memory["MSC_CTRL"] | BY_NAME["MSC_CTRL"].field("self_test").mask


# -- signals ---------------------------------------------------------------------------------------------


class _OtherChain(SimulatedChip):
    chain_kind = SignalChain

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self._sampler.__class__ = self.chain_kind
        self._sampler.configure(self.memory)


def _with_chain(chain: type[SignalChain]) -> type[SimulatedChip]:
    return type(chain.__name__ + "Chip", (_OtherChain,), {"chain_kind": chain})


def _offset_factor(columns: slice, factor: float) -> type[SimulatedChip]:
    class Chain(SignalChain):
        def configure(self, memory):
            super().configure(memory)
            self._offset[columns] = np.rint(self._offset[columns] * factor).astype(np.int64)

    return _with_chain(Chain)


class OffsetBeforeFilter(SignalChain):
    def _scaled(self, inputs):
        return super()._scaled(inputs) + self._offset

    def _numbers(self, sums, extra_bits):
        kept, self._offset = self._offset, np.zeros_like(self._offset)
        try:
            return super()._numbers(sums, extra_bits)
        finally:
            self._offset = kept

    def update(self, inputs):
        updates = super().update(inputs)
        return replace(updates, unfiltered=updates.unfiltered - self._offset)


class GyrosPositiveOnly(SignalChain):
    def _scaled(self, inputs):
        kept = self._manual_test
        values = super()._scaled(inputs)
        if kept < 0:
            self._manual_test = 0.0
            values[:, GYRO_COLUMNS] = super()._scaled(inputs)[:, GYRO_COLUMNS]
            self._manual_test = kept
        return values


class GyrosSameWay(SignalChain):
    def _scaled(self, inputs):
        kept = self._manual_test
        values = super()._scaled(inputs)
        if kept < 0:
            self._manual_test = 1.0
            values[:, GYRO_COLUMNS] = super()._scaled(inputs)[:, GYRO_COLUMNS]
            self._manual_test = kept
        return values


class AccelsBothSigns(SignalChain):
    def _scaled(self, inputs):
        values = super()._scaled(inputs)
        if self._manual_test < 0:
            values[:, ACCEL_COLUMNS] -= np.rint(
                sampling.SELF_TEST_ACCEL_MG * self._gain[ACCEL_COLUMNS]
            ).astype(np.int64)
        return values


class _OtherFilter(SignalChain):
    """Another window than the triangle of two boxcars of 2^M taps."""

    @staticmethod
    def window(m: int) -> np.ndarray:
        raise NotImplementedError

    def update(self, inputs):
        window = self.window(self.m)
        early = self.__dict__.get("early")
        new = self._scaled(inputs)
        before = early if early is not None else np.zeros((1024, new.shape[1]), np.int64)
        samples = np.concatenate([before, new])
        self.early = samples[-1024:]
        mean = np.stack(
            [np.convolve(column, window / window.sum(), "valid")[-len(new) :] for column in samples.T],
            axis=1,
        )
        without = super().update(inputs)
        numbers = np.floor((mean + self._offset) / 1024 + 0.5).astype(np.int64)
        np.clip(numbers, sampling._LOW, sampling._HIGH, out=numbers)
        words = numbers & sampling._MASK
        words[:, sampling._NARROW] |= without.words[:, sampling._NARROW] & 0x3000
        return replace(without, words=words.astype(np.uint16))


class OneBoxcar(_OtherFilter):
    @staticmethod
    def window(m):
        return np.ones(1 << m)


class TwiceTheTaps(_OtherFilter):
    @staticmethod
    def window(m):
        n = 1 << m + 1 if m else 1
        return np.convolve(np.ones(n), np.ones(n))


class MTaps(_OtherFilter):
    """M + 1 taps instead of 2^M."""

    @staticmethod
    def window(m):
        return np.convolve(np.ones(m + 1), np.ones(m + 1))


class _OtherPeriod(SimulatedChip):
    def _period_s(self, code: int) -> float:
        raise NotImplementedError

    def _restart_sampling(self, now, *, empty=False):
        super()._restart_sampling(now, empty=empty)
        self.update_period_s = self._period_s(self.memory["SMPL_PRD"] & 0xFF or 1)


class PeriodOfN(_OtherPeriod):
    def _period_s(self, code):
        return (0.61035e-3, 18.921e-3)[code >> 7] * max(code & 0x7F, 1)


class OneTimeBase(_OtherPeriod):
    def _period_s(self, code):
        return 0.61035e-3 * ((code & 0x7F) + 1)


class SlowBaseOf16(_OtherPeriod):
    """The slow base is 16 times the fast one instead of 31 times."""

    def _period_s(self, code):
        return 0.61035e-3 * (1, 16)[code >> 7] * ((code & 0x7F) + 1)


def _truncating(step: int) -> type[SimulatedChip]:
    class Chain(SignalChain):
        def null_offset(self, mean_unfiltered):
            low, high = BY_NAME[GYRO_OFF[0]].range
            per_lsb = {300: 4, 150: 2, 75: 1}[self.gyro_range_dps]
            exact = [-value * per_lsb / 1024 for value in mean_unfiltered]
            return [int(min(max(step * int(value / step), low), high)) for value in exact]

    return _with_chain(Chain)


# -- the list --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Change:
    """One changed rule: the name of its row, and how to make the chip and the world; see the module."""

    rule: str
    kind: type[SimulatedChip] = SimulatedChip
    options: dict = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    parts: int = 1


CHANGES: dict[str, Change] = {
    "a write is echoed": Change("reply_to_write", WriteEcho),
    "a write returns the content": Change("reply_to_write", WriteContent),
    "a write repeats the last reply": Change("reply_to_write", WriteStale),
    "reserved bits read ones": Change("reserved_bits", ReservedOnes),
    "one byte is read twice": Change("reserved_bits", ReservedMirror),
    "offsets are sign-extended": Change("offset_upper_bits", OffsetsExtended),
    "upper bits of offsets are ones": Change("offset_upper_bits", OffsetsOnes),
    "a flash update takes 0.25 s": Change("flash_time", FlashSlow),
    "a flash update takes 1 s": Change("flash_time", FlashVerySlow),
    "a precise null takes 60 s": Change("precision_time", PrecisionSlow),
    "a reset takes 0.5 s": Change("reset_time", ResetSlow),
    "a reset of 0.5 s ends in silence": Change("reset_time", ResetDead),
    "the self-test takes 0.2 s": Change("self_test_time", SelfTestSlow),
    "the self-test's bit stays": Change("self_test_time", SelfTestBitStays),
    "accelerometer offsets count 2": Change("accel_offset_lsb", _offset_factor(ACCEL_COLUMNS, 2)),
    "accelerometer offsets count 1/2": Change("accel_offset_lsb", _offset_factor(ACCEL_COLUMNS, 0.5)),
    "accelerometer offsets as the sibling's": Change(
        "accel_offset_lsb", _offset_factor(ACCEL_COLUMNS, 2.522 / 0.4672)
    ),
    "accelerometer offsets are subtracted": Change("accel_offset_lsb", _offset_factor(ACCEL_COLUMNS, -1)),
    "gyro offsets count 4": Change("gyro_offset_lsb", _offset_factor(GYRO_COLUMNS, 4)),
    "gyro offsets are subtracted": Change("gyro_offset_lsb", _offset_factor(GYRO_COLUMNS, -1)),
    "offsets act before the filter": Change("offset_after_filter", _with_chain(OffsetBeforeFilter)),
    "the pulse ends at the update": Change("data_ready_edge", options={"update_edge": "last"}),
    "a pulse of 0.2 ms ends at the update": Change(
        "data_ready_edge", options={"update_edge": "last", "data_ready_pulse_s": 200e-6}
    ),
    "an autonull truncates to its LSB": Change("autonull_rounding", _truncating(1), parts=20),
    "an autonull truncates to the output's LSB": Change("autonull_rounding", _truncating(4)),
}
"""Changed chips by the change."""

OF_STEPS: dict[str, Change] = {
    "an alarm's bit falls": Change("alarm_stays", AlarmFalls),
    "any read clears STATUS": Change("alarm_stays", StatusClearedByAnyRead),
    "a flash update counts two": Change("flash_count", CountsTwice),
    "a flash update counts nothing": Change("flash_count", CountsNever),
    "gyros are deaf to the negative test": Change("self_test_gyro", _with_chain(GyrosPositiveOnly)),
    "gyros answer the same way": Change("self_test_gyro", _with_chain(GyrosSameWay)),
    "accelerometers answer to both": Change("self_test_accel", _with_chain(AccelsBothSigns)),
    "the period is base times N": Change("sample_period", PeriodOfN),
    "there is one time base": Change("sample_period", OneTimeBase),
    "the slow base is 16 fast ones": Change("sample_period", SlowBaseOf16),
    "the filter is one boxcar": Change("filter_gain", _with_chain(OneBoxcar)),
    "the filter has twice the taps": Change("filter_gain", _with_chain(TwiceTheTaps)),
    "the filter has M + 1 taps": Change("filter_gain", _with_chain(MTaps)),
}
"""Chips that a step of the bring-up contradicts; `rule` is the question that the step answers."""

DIRECTIONS = ((0, 0, -1), (0, 1, 0), (-1, 0, 0), (0.6, 0.0, -0.8))


def open_chip(change: Change | None, seed: int) -> SimBus:
    """A bus to a chip with a change, or to a sound chip; seed draws bias, attitude and saved registers."""
    dice = np.random.default_rng([seed, 91])
    change = change or Change("")
    biases = {f"gyro_bias_{axis}_dps": float(dice.uniform(-2, 2)) for axis in "xyz"}
    world = World(WorldSettings(**biases | change.settings), seed=seed)
    flash = {
        "SENS_AVG": 0x0400 | int(dice.choice([0, 2, 2, 4])),
        "MSC_CTRL": int(dice.choice([0x00, 0x04, 0x80])),
        "YACCL_OFF": BY_NAME["YACCL_OFF"].word(int(dice.integers(-200, 200))),
    }
    chip = change.kind(
        world, start_s=-0.5, flash=flash, endurance=int(dice.integers(0, 50)), **change.options
    )
    bus = SimBus(world=world, chip=chip, url=f"sim:?seed={seed}")
    bus.stage.orient(DIRECTIONS[seed % len(DIRECTIONS)])
    bus.sleep_s(2.0)
    return bus


def record_bringup(change: Change | None, seed: int, path: Path) -> None:
    """Record a bring-up that may write everything."""
    with contextlib.closing(RecordingBus(open_chip(change, seed), path)) as bus:
        bring_up(bus, permission=Permission(writes=True, flash=True))


def rows() -> dict[str, str]:
    """Return the statement of the register table by the name of the row."""
    return {row.question.name: f"{row.question.text} {row.alternatives[0]}" for row in ROWS}


def record_nulls(change: Change | None, seed: int, path: Path) -> None:
    """Record four precise autonulls, each with a rest behind it."""
    with contextlib.closing(RecordingBus(open_chip(change, seed), path)) as bus:
        for act in (_offsets, *[_precise] * 4):
            act(Adis16354(bus, check=False))


def record_service(change: Change | None, seed: int, path: Path) -> None:
    """Record a session with the commands that a bring-up leaves out: nulls, restore, reset."""
    with contextlib.closing(RecordingBus(open_chip(change, seed), path)) as bus:
        for act in SERVICE:
            with contextlib.suppress(AdisGonioError):
                sensor = Adis16354(bus, check=False)
                act(sensor)


def _rest(sensor: Adis16354, count: int = 512) -> None:
    sensor.read_scans(count, (*ACCEL_OUT, *GYRO_OUT), data_ready=False)


def _offsets(sensor: Adis16354) -> None:
    _rest(sensor)
    for k, name in enumerate((*GYRO_OFF, *ACCEL_OFF)):
        sensor.write(name, (-1) ** k * (200 + 50 * k))
    sensor.bus.sleep_s(sensor.configuration().settling_s)
    _rest(sensor)


def _reset(sensor: Adis16354) -> None:
    sensor.write("AUX_DAC", 0x123)
    for name in (*ACCEL_OFF, "ALM_MAG2"):
        sensor.write(name, 77)
    sensor.save_to_flash()
    sensor.write("AUX_DAC", 0x321)
    for name in (*ACCEL_OFF, "ALM_MAG2"):
        sensor.write(name, 123)
    sensor.read_all()
    sensor.reset()
    sensor.read_all()


def _restore(sensor: Adis16354) -> None:
    sensor.write("XACCL_OFF", 99)
    sensor.write("ZGYRO_OFF", -99)
    sensor.restore_factory()
    sensor.read_all()


def _alarm(sensor: Adis16354) -> None:
    sensor.set_alarm(1, Alarm("SUPPLY_OUT", threshold=1.0))
    sensor.bus.sleep_s(sensor.configuration().settling_s)
    _rest(sensor, 64)
    sensor.clear_alarm(1)
    sensor.bus.sleep_s(sensor.configuration().settling_s)
    _rest(sensor, 64)
    for _ in range(2):
        sensor.status()
        sensor.bus.sleep_s(sensor.configuration().settling_s)


def _null(sensor: Adis16354) -> None:
    sensor.autonull()
    sensor.read_all()


def _precise(sensor: Adis16354) -> None:
    sensor.precision_autonull()
    sensor.read_all()
    _rest(sensor, 6_000)


SERVICE: tuple[Callable[[Adis16354], None], ...] = (
    _offsets,
    _alarm,
    _reset,
    _reset,
    _restore,
    _null,
    _precise,
    _precise,
    _precise,
    _precise,
)
"""Acts of the session of `record_service`; an error ends one of them, and the next begins."""
