"""The driver against the simulated chip, and against buses that misbehave on purpose."""

import itertools
import math
import random
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from adis_gonio import open_bus, open_sensor
from adis_gonio.base.budget import Budget, within
from adis_gonio.base.errors import (
    AdisGonioError,
    BusError,
    ChipError,
    SilentChipError,
    StatusError,
    UsageError,
    VariantError,
    VerifyError,
)
from adis_gonio.device.bus import Capability
from adis_gonio.device.bus.contract import ForwardingBus
from adis_gonio.device.bus.recording import RecordingBus as FileRecordingBus
from adis_gonio.device.sensor import DEFAULT_SCAN, Adis16354, Alarm, driver
from adis_gonio.device.sensor.driver import Undo
from adis_gonio.device.sensor.registers import (
    ACCEL_OFF,
    ACCEL_OUT,
    BY_NAME,
    FAST,
    GYRO_OFF,
    ND,
    NORMAL,
    REGISTERS,
    read_frame,
)
from adis_gonio.record.source import ChipSource
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.chip import State
from adis_gonio.sim.sampling import OUTPUTS
from adis_gonio.testing import ExpectedFrames
from fakes.buses import ConstantBus, RecordingBus
from fakes.numbered_scans import Judge, NumberedChip

SIM = "sim:?seed=3"


@pytest.fixture
def sensor():
    with open_sensor(SIM) as sensor:
        yield sensor


def recorded(url: str = SIM, **options) -> tuple[Adis16354, RecordingBus]:
    bus = RecordingBus(open_bus(url))
    return Adis16354(bus, **options), bus


# -- what leaves the host ---------------------------------------------------------------------------

OPERATIONS = {
    "scan": lambda s, n: s.scan(),
    "status": lambda s, n: s.status(),
    "read_all": lambda s, n: s.read_all(),
    "offsets": lambda s, n: s.offsets(),
    "self_test": lambda s, n: s.self_test(),
    "configure_filter": lambda s, n: s.configure(filter_m=n % 7),
    "configure_rate": lambda s, n: s.configure(smpl_prd=1 + n % 255),
    "configure_range": lambda s, n: s.configure(gyro_range_dps=(300, 150, 75)[n % 3]),
    "data_ready": lambda s, n: s.configure(data_ready=bool(n % 2)),
    "accel_offset": lambda s, n: s.write("XACCL_OFF", n % 4096 - 2048),
    "gyro_offset": lambda s, n: s.write("YGYRO_OFF", n % 8192 - 4096),
    "flash": lambda s, n: s.save_to_flash(),
    "restore": lambda s, n: s.restore_factory(),
    "reset": lambda s, n: s.reset(),
    "alarm": lambda s, n: s.set_alarm(1 + n % 2, Alarm("ZACCL_OUT", -1.0 - n % 900, above=bool(n & 1))),
    "clear_alarm": lambda s, n: s.clear_alarm(1 + n % 2),
    "write": lambda s, n: s.write(REGISTERS[n % len(REGISTERS)], n),
    "sleep": lambda s, n: (s.sleep(0.5 + n % 3), s.wake()),
}
READ_ONLY = {"scan", "status", "read_all", "offsets"}


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(st.tuples(st.sampled_from(sorted(OPERATIONS)), st.integers(0, 0xFFFF)), max_size=6))
def test_no_random_operation_sends_0xffff_or_bit_14_or_a_write_that_was_not_asked_for(operations):
    sensor, bus = recorded()
    assert bus.writes == []
    for name, number in operations:
        before = len(bus.writes)
        try:
            OPERATIONS[name](sensor, number)
        except UsageError:
            assert len(bus.writes) == before or name in ("alarm", "configure_range", "accel_offsets")
        if name in READ_ONLY:
            assert len(bus.writes) == before
    assert 0xFFFF not in bus.frames
    assert not any(frame & 0x4000 for frame in bus.frames)
    # A chip whose timing was ever violated would answer nothing any more.
    assert sensor.read("SMPL_PRD") & 0xFF == sensor.configuration().smpl_prd


def test_the_bus_clock_follows_smpl_prd_and_is_slow_while_the_mode_changes():
    sensor, bus = recorded()
    assert bus.batches[0][0] == NORMAL  # the mode is unknown at first
    assert bus.timing == FAST
    sensor.configure(smpl_prd=0x0A)
    assert bus.timing == NORMAL
    for timing, batch in bus.batches:
        if any(int(frame) & 0xFF00 == 0xB600 for frame in batch):
            assert timing == NORMAL
    sensor.configure(smpl_prd=0x80)
    assert bus.timing == NORMAL
    sensor.configure(smpl_prd=0x09)
    assert bus.timing == FAST
    assert len(sensor.read_scans(3)) == 3


def test_a_reset_in_normal_mode_brings_the_fast_clock_back():
    sensor, bus = recorded()
    sensor.configure(smpl_prd=0x20)
    sensor.reset()
    assert bus.timing == FAST
    assert sensor.configuration().smpl_prd == 1


# -- opening ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("word", "level"), [(0x0000, "zeros"), (0xFFFF, "ones")])
def test_a_dead_line_is_not_taken_for_data(word, level):
    with pytest.raises(SilentChipError, match=level):
        Adis16354(ConstantBus(word))


def test_a_line_stuck_at_one_valid_word_is_found_silent_when_scanned():
    sensor = Adis16354(ConstantBus(0x0401), check=False)
    with pytest.raises(SilentChipError, match="ND never came"):
        sensor.scan()


@pytest.mark.parametrize("opened", ["adis16354", "adis16350", "adis16355"])
@pytest.mark.parametrize("real", ["adis16354", "adis16350", "adis16355"])
def test_the_variant_is_told_by_one_g_at_rest(real, opened):
    url = f"sim:?seed=4&variant={real}"
    if (real == "adis16354") == (opened == "adis16354"):
        with open_sensor(url, variant=opened) as sensor:
            assert 900 < np.linalg.norm([sensor.scan()[f"{axis}ACCL_OUT"] for axis in "XYZ"]) < 1100
    else:
        with pytest.raises(
            VariantError, match=f"open it as variant '{'adis16354' if '54' in real else 'adis16350'}'"
        ):
            open_sensor(url, variant=opened)


def test_the_variant_is_checked_unless_told_not_to():
    with open_bus("sim:?seed=4&variant=adis16350") as bus:
        with pytest.raises(VariantError):
            Adis16354(bus)
        Adis16354(bus, check=False)


@pytest.mark.parametrize("sign", ["positive", "negative"])
def test_a_manual_self_test_that_is_on_prevents_opening(sign):
    with open_bus(SIM) as bus:
        left = Adis16354(bus)
        left.write_fields("MSC_CTRL", **{sign: 1}, linear_g=1)
        word = left.read("MSC_CTRL")
        with pytest.raises(ChipError, match="manual self-test") as refused:
            Adis16354(bus)
        same = Adis16354(bus, check=False)
        assert same.read("MSC_CTRL") == word
        with pytest.raises(ChipError, match=re.escape(str(refused.value))):
            ChipSource(same).refuse_self_test()
        end = re.search(r"MSC_CTRL=(0x[0-9A-F]+) --no-check", str(refused.value))
        same.write("MSC_CTRL", int(end[1], 0))
        assert Adis16354(bus).read("MSC_CTRL") == 0x0080


def test_the_check_takes_seconds_at_the_slowest_sample_rate_too():
    with open_bus("sim:?seed=4&variant=adis16350") as bus:
        Adis16354(bus, check=False).configure(smpl_prd=0xFF)
        begin_s = bus.now_s()
        with pytest.raises(VariantError):
            Adis16354(bus)
        assert bus.now_s() - begin_s < 15.0


def just_powered(smpl_prd: int, filter_m: int) -> SimBus:
    """Return a bus whose chip has just got its supply and has these settings in flash."""
    bus = open_bus(SIM)
    sensor = Adis16354(bus)
    sensor.configure(smpl_prd=smpl_prd, filter_m=filter_m)
    sensor.save_to_flash()
    bus.chip.hard_reset(bus.now_s())
    return bus


@pytest.mark.parametrize(("smpl_prd", "filter_m"), [(0x0A, 6), (0xA0, 2), (0xFF, 1)])
def test_the_check_waits_for_a_filter_that_fills_after_power_on(smpl_prd, filter_m):
    Adis16354(just_powered(smpl_prd, filter_m)).close()


def test_a_wait_for_the_filter_is_told_within_seconds_and_how_long_it_takes():
    bus, told = just_powered(0xFF, 6), []
    begin_s = bus.now_s()
    with within(Budget(tell=lambda text: told.append((bus.now_s() - begin_s, text)))):
        sensor = Adis16354(bus)
        assert [text.rpartition(", ")[2] for _, text in told] == ["7 s", "5 min 8 s"]
        assert told[0][0] < 1 < told[1][0] < 15
        assert 308 < bus.now_s() - begin_s < 340
        sensor.configure(filter_m=5)
    assert told[2][1].endswith("2 min 33 s")


def test_the_check_waits_for_the_filter_once_if_the_length_of_the_reading_goes_on_growing(monkeypatch):
    bus, waits_s, lengths = open_bus(SIM), [], itertools.count(1)

    def growing(stream, count):
        assert len(waits_s) < 5, "it never ends"
        waits_s.append(bus.now_s())
        return SimpleNamespace(numbers=lambda: np.outer([1.0, 2.0], [0, 0, 20.0 * next(lengths)]))

    monkeypatch.setattr(driver, "_take", growing)
    with pytest.raises(ChipError):
        Adis16354(bus)
    assert len(waits_s) == 2


@pytest.mark.parametrize(("smpl_prd", "filter_m"), [(0x90, 2), (0xA0, 3), (0xFF, 3)])
def test_a_recording_of_an_opening_that_read_32_scans_without_a_wait_is_replayed(
    tmp_path, monkeypatch, smpl_prd, filter_m
):
    with monkeypatch.context() as earlier:
        check = "_check_variant"
        earlier.setattr(Adis16354, check, lambda s, _: s.read_scans(32, ACCEL_OUT, data_ready=False))
        with Adis16354(FileRecordingBus(just_powered(smpl_prd, filter_m), tmp_path / "old.rec")) as sensor:
            expected = sensor.read_scans(2)
    with open_sensor(f"replay:{tmp_path / 'old.rec'}") as sensor:
        assert np.array_equal(sensor.read_scans(2).words, expected.words)


def test_a_failed_opening_closes_the_bus(monkeypatch):
    bus = ConstantBus(0)
    monkeypatch.setattr("adis_gonio.device.sensor.driver.open_bus", lambda url: bus)
    with pytest.raises(SilentChipError):
        open_sensor("constant:")
    assert bus.closed


# -- registers --------------------------------------------------------------------------------------


def checked_reading(*steps: tuple[int, int]) -> list[tuple[int, int]]:
    """Return a script of two successive readings of registers with SENS_AVG before and behind them.

    A step is a read frame and its word; a reply comes one frame late.
    """
    rows = [(0x3800, 0x0402), *steps, (0x3800, 0x0402)]
    replies = [0x0000, *(word for _, word in rows)]
    return [*zip([*(frame for frame, _ in rows), 0x0000], replies, strict=True)] * 2


CONFIGURATION = checked_reading((0x3600, 0x0001), (0x3800, 0x0402), (0x3400, 0x0000))


def test_the_frames_of_a_verified_write_are_the_data_sheets():
    script = [
        *CONFIGURATION,
        (0xA034, 0x0000), (0xA102, 0x0000),  # XACCL_OFF low, high
        (0x2000, 0x0000), (0x0000, 0x0234),  # read back, one frame late
    ]  # fmt: skip
    with Adis16354(ExpectedFrames(script), check=False) as sensor:
        sensor.write("XACCL_OFF", 0x234)


def test_a_write_that_does_not_stick_is_an_error():
    script = [
        *CONFIGURATION,
        (0xA034, 0), (0xA102, 0), (0x2000, 0), (0x0000, 0x0034),
    ]  # fmt: skip
    sensor = Adis16354(ExpectedFrames(script), check=False)
    with pytest.raises(VerifyError, match="XACCL_OFF: wrote 0x0234, read back 0x0034"):
        sensor.write("XACCL_OFF", 0x234)


@pytest.mark.parametrize(
    "row",
    [row for row in REGISTERS if row.writable and row.readable and row.name != "SLP_CNT"],
    ids=lambda row: row.name,
)
def test_every_writable_register_keeps_what_was_written(sensor, row):
    low, high = row.range
    values = [number for number in (low, high, 1, 0) if row.word(number) & ~row.write_mask == 0]
    if row.name == "SMPL_PRD":
        values = [1, 9, 10, 255]
    if row.name == "SENS_AVG":
        values = [0x0400, 0x0203, 0x0106]
    if row.name == "MSC_CTRL":
        values = [0x00C7, 0x0000]
    for number in values or [row.write_mask & 0x5555]:
        sensor.write(row, number)
        assert sensor.read(row) == number


def test_writes_that_would_harm_are_refused_before_anything_is_sent():
    sensor, bus = recorded()
    for name, number in [
        ("STATUS", 0), ("COMMAND", 0x80), ("SLP_CNT", 4), ("SMPL_PRD", 0), ("SMPL_PRD", 0x100),
        ("SENS_AVG", 0x0302), ("SENS_AVG", 0x0101), ("SENS_AVG", 0x0407), ("XACCL_OFF", 2048),
    ]:  # fmt: skip
        with pytest.raises(UsageError):
            sensor.write(name, number)
    assert bus.writes == []


def test_the_range_of_the_gyros_changes_alone(sensor):
    sensor.configure(filter_m=4)
    now = sensor.configure(gyro_range_dps=75)
    assert (now.gyro_range_dps, now.filter_m) == (75, 4)


def test_changing_a_field_leaves_the_others(sensor):
    sensor.configure(linear_g=True, origin=True)
    sensor.configure(data_ready=True)
    assert sensor.read("MSC_CTRL") == 0x00C4
    sensor.self_test()
    assert sensor.read("MSC_CTRL") == 0x00C4  # a 16-bit write for the self-test would have cleared it
    with pytest.raises(UsageError, match="0 to 1"):
        sensor.write_fields("MSC_CTRL", data_ready=2)


def test_the_gyro_scale_follows_the_range():
    with open_sensor("sim:?seed=3&gyro_bias_z_dps=0") as sensor:
        # The same rate is twice the number at half the range.
        for name in GYRO_OFF:
            sensor.write(name, round(10.0 / 0.018315))
        for dps in (300, 150, 75):
            sensor.configure(gyro_range_dps=dps, filter_m=6)
            assert sensor.read_scans(200).gyro_dps.mean() == pytest.approx(10.0, abs=2.0)


def test_registers_are_set_back_and_those_that_cannot_be_are_named():
    sensor, bus = recorded()
    rows = [BY_NAME[name] for name in ("XACCL_OFF", "ALM_MAG1", "SENS_AVG")]
    undo = Undo(sensor, rows)
    given = Undo(sensor, rows[:1], {"XACCL_OFF": 0xF005, "SENS_AVG": 0})
    sensor.write("XACCL_OFF", 12)
    sensor.configure(gyro_range_dps=75, filter_m=5)
    exchange, tries = bus.exchange_array, []

    def fail(frames):
        tries.append(frames)
        raise BusError("the line is dead")

    bus.exchange_array = fail
    undo.put_back()
    assert undo.unrestored == ("XACCL_OFF", "ALM_MAG1", "SENS_AVG")
    assert len(tries) > 1, "it is tried again"
    bus.exchange_array = exchange
    undo.put_back()
    assert undo.unrestored == ()
    assert [sensor.read(name) for name in ("XACCL_OFF", "SENS_AVG")] == [0, 0x0402]
    assert sensor.configuration().gyro_range_dps == 300
    addresses = {frame >> 8 & 0x3E for frame in bus.writes}
    assert BY_NAME["ALM_MAG1"].address not in addresses, "it has not changed"
    given.put_back()
    assert sensor.read("XACCL_OFF") == 5, "as far as the register can be written"


def test_ctrl_c_while_registers_are_set_back_is_raised_when_they_are():
    sensor, bus = recorded()
    undo = Undo(sensor, [BY_NAME["XACCL_OFF"]])
    sensor.write("XACCL_OFF", 12)
    exchange, pressed = bus.exchange_array, iter([True])

    def press(frames):
        if next(pressed, False):
            raise KeyboardInterrupt
        return exchange(frames)

    bus.exchange_array = press
    with pytest.raises(KeyboardInterrupt):
        undo.put_back()
    assert undo.unrestored == ()
    assert sensor.read("XACCL_OFF") == 0


# -- scans ------------------------------------------------------------------------------------------


def data_bits(block):
    return block.numbers()


@pytest.mark.parametrize("names", [DEFAULT_SCAN, ("XACCL_OUT",), ("ZACCL_OUT", "ENDURANCE", "XGYRO_OUT")])
@pytest.mark.parametrize("smpl_prd", [1, 9, 10])
def test_polling_and_streaming_find_the_same_scans_untorn_and_none_lost(names, smpl_prd):
    found = {}
    for way in ("0", "1"):
        with open_sensor(f"{SIM}&stream={way}") as sensor:
            assert (Capability.STREAM in sensor.bus.capabilities) == (way == "1")
            sensor.configure(smpl_prd=smpl_prd, filter_m=0, data_ready=True)
            block = sensor.read_scans(600, names)
            found[way] = block
            assert block.lost == 0
            np.testing.assert_allclose(
                np.diff(block.time_s).mean(), sensor.configuration().sample_period_s, rtol=1e-3
            )
    polled, streamed = found["0"].numbers(), found["1"].numbers()
    # Both chips are the same; the two ways only begin at different updates.
    offsets = [k for k in range(-140, 41) if np.array_equal(polled[150:500], streamed[150 + k : 500 + k])]
    assert len(offsets) == 1


class MisreadBus(ForwardingBus):
    """Clears the flag ND of one word of YACCL_OUT, as a disturbed line may."""

    left = 0

    def _exchange(self, frames):
        replies = super()._exchange(frames)
        for k in np.flatnonzero(frames[:-1] == read_frame(BY_NAME["YACCL_OUT"])):
            if replies[k + 1] & ND:
                self.left -= 1
                if not self.left:
                    replies[k + 1] ^= ND
        return replies


def test_an_update_with_a_misread_flag_is_counted_as_lost_and_not_completed_with_older_words():
    bus = MisreadBus(open_bus(f"{SIM}&stream=0"))
    with Adis16354(bus) as sensor:
        bus.left = 40
        block = sensor.read_scans(200, ACCEL_OUT)
    assert bus.left < 0
    assert block.lost == 1
    assert (block.words & ND).all()


def test_a_pause_of_the_host_is_counted_as_lost_scans_and_does_not_tear_the_rows():
    with open_sensor(f"{SIM}&stream=0") as sensor, sensor.stream(block_scans=50) as stream:
        period = sensor.configuration().sample_period_s
        got, lost, times = 0, 0, []
        for k, block in enumerate(stream):
            got += len(block)
            lost += block.lost
            times += list(block.time_s)
            if k == 12:
                break
            if k % 3 == 2:
                sensor.bus.sleep_s(10 * period)
        updates = round((times[-1] - times[0]) / period) + 1
        assert lost >= 36
        assert got + lost == updates


class SlowBus(RecordingBus):
    """A bus that needs a millisecond a frame, as a HID bridge does."""

    wait_s = 0.001

    def _exchange(self, frames):
        replies = np.empty_like(frames)
        for k in range(frames.size):
            self.inner.sleep_s(self.wait_s)
            replies[k] = self.inner.exchange_array(frames[k : k + 1])[0]
        return replies


class HesitatingBus(RecordingBus):
    """A bus whose host is held up between two frames of a batch now and then, for some updates."""

    def __init__(self, inner, seed):
        super().__init__(inner)
        self.dice = random.Random(seed)

    def _exchange(self, frames):
        replies = []
        for part in np.split(frames, np.flatnonzero([self.dice.random() < 3e-4 for _ in frames])):
            replies.append(self.inner.exchange_array(part))
            if len(frames) > 100:  # not in the first batch, by which the bus is judged
                self.inner.sleep_s(self.dice.uniform(0.0, 0.1))
        return np.concatenate(replies)


@pytest.mark.parametrize("seed", range(3))
def test_a_host_that_is_held_up_within_a_batch_gets_no_row_of_two_updates(seed):
    inner = SimBus(world=World(seed=1), chip=NumberedChip(), stream=False)
    sensor = Adis16354(HesitatingBus(inner, seed), check=False)
    sensor.configure(sample_rate_hz=50.0)
    names = [row.name for row in OUTPUTS[1:8]]
    judge = Judge(names, slack=None)
    with sensor.stream(names, block_scans=4) as stream:
        while judge.found["gaps"] < 50:
            judge.look(next(stream))
        assert stream.caveat == ""
    assert judge.sound, judge.found
    assert judge.found["scans"] > 100
    # When within its batch a scan came is not known then: each pause may be miscounted by one.
    assert abs(judge.off) <= judge.found["gaps"]


def test_a_bus_slower_than_the_sensor_delivers_scans_and_counts_what_it_missed():
    sensor = Adis16354(SlowBus(open_bus(f"{SIM}&stream=0")))
    block = sensor.read_scans(200)
    updates = (block.time_s[-1] - block.time_s[0]) / sensor.configuration().sample_period_s
    assert len(block) == 200
    assert len(block) + block.lost == pytest.approx(updates, rel=0.03)
    assert block.lost > 800


def test_rows_that_may_mix_updates_say_so_and_those_that_cannot_do_not():
    with open_sensor(f"{SIM}&stream=0") as quick, quick.stream(block_scans=20) as stream:
        next(stream)
        assert stream.caveat == ""
    bus = SlowBus(open_bus(f"{SIM}&stream=0"))
    with Adis16354(bus).stream(block_scans=20) as stream:
        next(stream)
        assert "two or more neighbouring updates" in stream.caveat
        bus.wait_s = 0.0
        for _ in range(3):
            next(stream)
        assert stream.caveat, "it holds for the rows that were delivered"


@pytest.mark.parametrize("url", [SIM, f"{SIM}&stream=0"], ids=["streamed", "polled"])
def test_a_stream_stops_cleanly_and_leaves_the_bus_usable(url):
    sensor, bus = recorded(url)
    sensor.configure(data_ready=True)
    with sensor.stream(block_scans=16) as stream:
        assert len(next(stream)) > 0
    assert next(stream, None) is None
    assert sensor.read("SMPL_PRD") == 1
    sent = len(bus.batches)
    stream.close()
    assert len(bus.batches) == sent, "a second close does nothing"


def test_a_block_may_have_one_scan(sensor):
    with sensor.stream(block_scans=1) as stream:
        assert len(next(stream)) >= 1
    with pytest.raises(UsageError, match="block_scans"):
        sensor.stream(block_scans=0)


def test_a_scan_needs_an_output_register(sensor):
    with pytest.raises(UsageError, match="output register"):
        sensor.read_scans(1, ("ENDURANCE", "STATUS"))
    with pytest.raises(UsageError, match="count"):
        sensor.read_scans(0)


# -- offsets, flash, health -------------------------------------------------------------------------


def test_offsets_are_added_to_the_outputs_and_read_back_in_units(sensor):
    sensor.configure(filter_m=6)
    before = sensor.read_scans(400).accel_mg.mean(axis=0)
    for name, mg in zip(ACCEL_OFF, (100.0, -50.0, 25.0), strict=True):
        sensor.write(name, round(mg / 0.4672))
    after = sensor.read_scans(400).accel_mg.mean(axis=0)
    np.testing.assert_allclose(sensor.offsets().accel_mg, [100.0, -50.0, 25.0], atol=0.2336)
    np.testing.assert_allclose(after - before, [100.0, -50.0, 25.0], atol=1.0)


def test_saved_offsets_survive_a_reset_and_unsaved_ones_do_not(sensor):
    sensor.write("XACCL_OFF", 107)
    written = sensor.read("ENDURANCE")
    assert sensor.save_to_flash() == written + 1
    sensor.write("XACCL_OFF", 171)
    sensor.reset()
    assert sensor.offsets().accel_mg[0] == pytest.approx(50.0, abs=0.25)
    assert not any(sensor.restore_factory().accel_mg)
    assert sensor.read("ENDURANCE") == written + 2


def test_a_flash_update_that_was_not_done_is_found_by_the_counter():
    script = [
        *CONFIGURATION,
        *checked_reading((0x0000, 7)),  # before
        (0x2600, 0), (0x2800, 0), (0x0000, 0),  # no alarm level has the mark of a session
        (0xBE08, 0), *checked_reading((0x0000, 7)),  # the command, and the counter stands still
    ]  # fmt: skip
    sensor = Adis16354(ExpectedFrames(script), check=False)
    with pytest.raises(VerifyError, match="ENDURANCE was 7 and is 7"):
        sensor.save_to_flash()


def test_a_flash_update_that_the_chip_reports_as_failed_is_an_error_although_it_was_counted():
    script = [
        *CONFIGURATION,
        *checked_reading((0x0000, 7)),
        (0x2600, 0), (0x2800, 0), (0x0000, 0),
        (0xBE08, 0), *checked_reading((0x0000, 8)),
        (0x3C00, 0), (0x0000, 0x0004),  # STATUS[2]: the flash update failed
    ]  # fmt: skip
    with (
        Adis16354(ExpectedFrames(script), check=False) as sensor,
        pytest.raises(StatusError, match="a flash update failed"),
    ):
        sensor.save_to_flash()


def test_a_factory_restore_that_leaves_an_offset_is_an_error():
    left = [0, 0, 0, 0, 0x0FFF, 0]  # YACCL_OFF is -1
    offsets = [0x1A00, 0x1C00, 0x1E00, 0x2000, 0x2200, 0x2400]
    script = [
        *CONFIGURATION,
        *checked_reading((0x0000, 7)),
        (0x2600, 0), (0x2800, 0), (0x0000, 0),
        (0xBE02, 0), *checked_reading((0x0000, 8)),
        (0x3C00, 0), (0x0000, 0),
        *zip([*offsets, 0x0000], [0, *left], strict=True),
    ]  # fmt: skip
    with (
        Adis16354(ExpectedFrames(script), check=False) as sensor,
        pytest.raises(VerifyError, match="offsets are not zero"),
    ):
        sensor.restore_factory()


def test_the_flash_is_written_ten_thousand_times_and_no_more():
    world = World(seed=3)
    bus = SimBus(world=world, chip=SimulatedChip(world, start_s=-0.5, endurance=9_999))
    with Adis16354(bus, check=False) as sensor:
        assert sensor.save_to_flash() == 10_000
        with pytest.raises(ChipError, match="lasts 10000"):
            sensor.save_to_flash()
        assert sensor.endurance() == 10_000


def test_the_self_test_passes_on_a_sound_chip(sensor):
    assert sensor.self_test().self_test_failures == ()


# -- nulling of the gyros ------------------------------------------------------------------------------

BIASED = "sim:?seed=3&gyro_bias_x_dps=4&gyro_bias_y_dps=-2.5&gyro_bias_z_dps=0.8&gyro_instability_dps=0"
GYRO_BIAS_DPS = (4.0, -2.5, 0.8)
NULLING = {  # how long it takes by the bus's clock, and how far the mean may be off afterwards
    # One filtered output (M = 4 leaves 0.204 of 0.6 °/s rms) and half an LSB of the output and the offset.
    "autonull": (0.3, 5 * 0.204 * 0.6 + 0.05),
    # Mean of 30 s: 0.6 / sqrt(24 576) is 0.004 °/s; half an LSB of the offset, and of the check itself.
    "precision_autonull": (30.0, 0.05),
}


def gyro_means(sensor):
    return sensor.read_scans(1600).gyro_dps.mean(axis=0)


@pytest.mark.parametrize("kind", NULLING)
def test_a_null_of_the_gyros_takes_their_bias_out_writes_flash_once_and_survives_a_reset(kind):
    takes_s, off_dps = NULLING[kind]
    with open_sensor(BIASED) as sensor:
        sensor.configure(filter_m=4)
        # The world adds effects of gravity and supply to the bias, so it is measured.
        before = gyro_means(sensor)
        assert np.abs(before).max() > 2
        accel = sensor.read_scans(400).accel_mg.mean(axis=0)
        written, begin_s = sensor.read("ENDURANCE"), sensor.bus.now_s()
        offsets = getattr(sensor, kind)()
        assert sensor.bus.now_s() - begin_s > takes_s
        assert sensor.read("ENDURANCE") == written + 1
        assert offsets.gyro_dps == pytest.approx(-before, abs=off_dps)
        assert offsets.accel_mg == (0, 0, 0), "there is no null of the accelerometers"
        assert gyro_means(sensor) == pytest.approx(np.zeros(3), abs=off_dps)
        assert sensor.read_scans(400).accel_mg.mean(axis=0) == pytest.approx(accel, abs=2)
        assert sensor.status().word == 0
        sensor.reset()
        assert sensor.offsets() == offsets


@pytest.mark.parametrize("kind", NULLING)
def test_a_null_replaces_the_offsets_that_stood_and_is_not_added_to_them(kind):
    with open_sensor(BIASED) as sensor:
        sensor.configure(filter_m=4)
        bias = gyro_means(sensor)
        for name in GYRO_OFF:
            sensor.write(name, round(5.0 / 0.018315))
        offsets = getattr(sensor, kind)()
        assert offsets.gyro_dps == pytest.approx(-bias, abs=NULLING[kind][1])


def test_the_precision_null_is_the_more_precise_one():
    spread = {}
    for kind in NULLING:
        found = []
        for seed in range(8):
            with open_sensor(f"sim:?seed={seed}&gyro_instability_dps=0") as sensor:
                sensor.configure(filter_m=0)
                bias = gyro_means(sensor)
                found.append(np.array(getattr(sensor, kind)().gyro_dps) + bias)
        spread[kind] = np.std(found)
    assert spread["precision_autonull"] < 0.03
    assert 0.3 < spread["autonull"] < 0.9  # one unfiltered output: 0.6 °/s


@pytest.mark.parametrize("kind", NULLING)
def test_nothing_is_sent_while_a_null_runs(kind):
    sensor, bus = recorded(BIASED)
    sent = []
    sleep_s = bus.sleep_s
    bus.sleep_s = lambda seconds: (sent.append(len(bus.frames)), sleep_s(seconds))[1]
    bus.batches.clear()
    getattr(sensor, kind)()
    (bit,) = [frame & 0xFF for frame in bus.writes]
    assert bit == {"autonull": 0x01, "precision_autonull": 0x10}[kind]
    command = next(k for k, frame in enumerate(bus.frames) if frame & 0x8000)
    assert sent == [command + 1], "one wait, right behind the command"
    assert bus.inner.chip.state is State.RUNNING


@pytest.mark.parametrize("kind", NULLING)
def test_a_null_at_low_supply_is_found_by_the_counter(kind):
    with open_sensor("sim:?seed=3&supply_v=4.6") as sensor:
        with pytest.raises(VerifyError, match="null was not done: ENDURANCE was 0 and is 0"):
            getattr(sensor, kind)()
        sensor.reset()
        assert sensor.offsets().gyro_dps == (0, 0, 0)


@pytest.mark.parametrize("kind", NULLING)
def test_a_worn_flash_is_not_nulled(kind):
    world = World(seed=3)
    bus = RecordingBus(SimBus(world=world, chip=SimulatedChip(world, start_s=-0.5, endurance=10_000)))
    sensor = Adis16354(bus)
    with pytest.raises(ChipError, match="ENDURANCE is 10000"):
        getattr(sensor, kind)()
    assert not bus.writes


def test_an_alarm_shows_in_ea_and_status_in_words(sensor):
    level = sensor.read_scans(100).accel_mg.mean(axis=0)
    axis = int(np.argmax(np.abs(level)))
    name = f"{'XYZ'[axis]}ACCL_OUT"
    sensor.set_alarm(1, Alarm(name, level[axis] / 2, above=level[axis] > 0))
    sensor.bus.sleep_s(0.1)
    assert sensor.read_scans(5).alarm.any()
    assert "alarm 1 is active" in str(sensor.status())
    sensor.clear_alarm(1)
    sensor.bus.sleep_s(0.1)
    sensor.status()
    sensor.bus.sleep_s(0.1)
    assert str(sensor.status()) == "no fault, no alarm"


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("distance_mg", [-60.0, 60.0])
def test_an_alarm_is_raised_on_its_own_side_of_the_threshold_only(sensor, above, distance_mg):
    level = sensor.read_scans(100).accel_mg[:, 2].mean()
    sensor.set_alarm(2, Alarm("ZACCL_OUT", level + distance_mg, above=above))
    sensor.bus.sleep_s(0.1)
    sensor.status()
    sensor.bus.sleep_s(0.1)
    flags = sensor.status().flags
    assert flags["alarm2"] is (above == (distance_mg < 0))
    assert not flags["alarm1"]


def test_an_alarm_looks_at_up_to_255_samples_filtered_if_asked_and_more_are_refused(sensor):
    for samples in (1, 255):
        sensor.set_alarm(1, Alarm("XACCL_OUT", 100.0, rate_samples=samples))
        assert sensor.read("ALM_SMPL1") == samples
        assert not BY_NAME["ALM_CTRL"].field("filtered").of(sensor.read("ALM_CTRL")), "unless asked for"
    sensor.set_alarm(1, Alarm("XACCL_OUT", 100.0, rate_samples=255, filtered=True))
    assert BY_NAME["ALM_CTRL"].field("filtered").of(sensor.read("ALM_CTRL"))
    for samples in (-1, 256):
        with pytest.raises(UsageError, match=f"rate_samples is {samples}: 0"):
            sensor.set_alarm(1, Alarm("XACCL_OUT", 100.0, rate_samples=samples))
    assert sensor.read("ALM_SMPL1") == 255


def test_a_rate_alarm_stands_above_its_change_a_sample_however_many_samples_it_looks_at(sensor):
    lsb = sensor.variant.accel_mg_per_lsb
    world = sensor.bus.world
    sample, slope_s = world.sample, 819.2 * 3 * lsb  # three LSB a sample

    def ramp(time_s):
        inputs = sample(time_s)
        accel = np.array(inputs.accel_mg)
        accel[:, 1] = slope_s * (time_s - begin_s) - 600
        return replace(inputs, accel_mg=accel)

    for threshold_lsb, expected in ((2.0, True), (4.0, False)):
        sensor.clear_alarm(1)
        sensor.set_alarm(1, Alarm("YACCL_OUT", threshold_lsb * lsb, rate_samples=50))
        sensor.configure(sample_rate_hz=819.2)  # empties the taps
        sensor.bus.sleep_s(0.2)
        begin_s = sensor.bus.now_s()
        world.sample = ramp
        sensor.bus.sleep_s(0.2)
        sensor.status()  # the jump to the ramp's beginning
        sensor.bus.sleep_s(0.3)
        assert sensor.status().flags["alarm1"] is expected
        world.sample = sample


def test_a_rate_alarm_too_slow_for_the_register_is_refused_and_nothing_is_written():
    sensor, bus = recorded()
    before = len(bus.writes)
    with pytest.raises(UsageError, match=r"the least is 0\.4672 mg a sample"):
        sensor.set_alarm(1, Alarm("YACCL_OUT", 0.2, rate_samples=50))
    assert len(bus.writes) == before


@pytest.mark.parametrize(
    ("alarm", "words"),
    [
        # 15 °C above the zero of the register at 25 °C, in steps of 0.1453 °C
        (Alarm("YTEMP_OUT", 40.0), (0x8000 | 103, 0, 0x0900)),
        (Alarm("YTEMP_OUT", 10.0, above=False), (0x0FFF & -103, 0, 0x0900)),
        # a change has no zero
        (Alarm("YTEMP_OUT", 1.453, rate_samples=20), (0x8000 | 10, 20, 0x0940)),
        (Alarm("XGYRO_OUT", -73.26, filtered=True), (0x8000 | 0x3FFF & -1000, 0, 0x0210)),
        (Alarm("SUPPLY_OUT", 0.0, above=False), (0, 0, 0x0100)),
    ],
)
def test_an_alarm_is_written_in_the_format_of_its_source(sensor, alarm, words):
    sensor.set_alarm(1, alarm)
    assert tuple(sensor.read_words(["ALM_MAG1", "ALM_SMPL1", "ALM_CTRL"])) == words


def test_alarms_that_the_chip_does_not_have_are_refused(sensor):
    lsb = sensor.variant.accel_mg_per_lsb
    for threshold in (8191 * lsb, -8192 * lsb):
        sensor.set_alarm(2, Alarm("XACCL_OUT", threshold))
    for threshold in (8192 * lsb, -8193 * lsb):
        with pytest.raises(UsageError, match="outside the range of XACCL_OUT"):
            sensor.set_alarm(2, Alarm("XACCL_OUT", threshold))
    with pytest.raises(UsageError, match="ENDURANCE cannot raise an alarm"):
        sensor.set_alarm(2, Alarm("ENDURANCE", 1.0))
    for number in (0, 3):
        with pytest.raises(UsageError, match=f"alarm {number} does not exist"):
            sensor.set_alarm(number, Alarm("XACCL_OUT", 1.0))
        with pytest.raises(UsageError, match=f"alarm {number} does not exist"):
            sensor.clear_alarm(number)


def test_a_sleeping_part_wakes_at_a_pulse_and_works_on(sensor):
    sensor.sleep(5.0)
    sensor.bus.sleep_s(1.0)
    sensor.wake()
    assert len(sensor.read_scans(10)) == 10


@pytest.mark.parametrize(("seconds", "halves"), [(0.5, 1), (5.0, 10), (127.5, 255)])
def test_the_time_of_a_sleep_is_counted_in_half_seconds(seconds, halves):
    sensor, bus = recorded()
    sensor.sleep(seconds)
    assert bus.writes[-1] == 0xBA00 | halves
    for beyond in (0.2, 128.0, math.nan, math.inf):
        with pytest.raises(UsageError, match=r"sleeps 0\.5 to 127\.5 s"):
            sensor.sleep(beyond)


def test_every_error_of_the_driver_is_one_line():
    for call in (
        lambda: open_sensor("sim:?seed=4", variant="adis16350"),
        lambda: Adis16354(ConstantBus(0)),
        lambda: open_sensor("sim:?seed=x"),
        lambda: open_sensor("sim:?sed=1"),
    ):
        with pytest.raises(AdisGonioError) as caught:
            call()
        assert "\n" not in str(caught.value)


def test_the_whole_table_is_read_in_one_batch(sensor):
    everything = sensor.read_all()
    assert list(everything) == [row.name for row in REGISTERS if row.readable]
    assert everything["SENS_AVG"] == BY_NAME["SENS_AVG"].default
