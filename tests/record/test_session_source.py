"""The seam between a session and its sensor: the chip's driver, and blocks of values."""

import numpy as np
import pytest

from adis_gonio.base.errors import SessionError, UsageError
from adis_gonio.bench.dwell_recorder import problems
from adis_gonio.bench.events import DwellDone, Problem
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.record.archive import Archive
from adis_gonio.record.archive_tables import Attempt, Header
from adis_gonio.record.blocks import ValueBlock, block_series, count_alarms, cut, join
from adis_gonio.record.plans import Position, plan
from adis_gonio.record.source import ChipSource, Settings, has_frames, open_source

SHORT = Settings(dwell_s=0.5)
URL = "sim:?seed=3"


def values(count, lost=0, start=0.0):
    data = np.random.default_rng(count).normal(size=(count, 4)) * 1000 / 3
    return ValueBlock(("ax", "ay", "az", "temp_c"), data, start + np.arange(count) / 7, lost)


def test_a_session_is_not_resumed_on_a_chip_whose_offset_was_changed(tmp_path):
    path = tmp_path / "a.session"
    with open_sensor(URL) as sensor:
        runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT, auto=True)
        for event in runner.run(so_far=False):
            if isinstance(event, DwellDone):
                runner.stop()
    with open_sensor(URL) as sensor:
        sensor.write("XACCL_OFF", 5)
        runner = SessionRunner.resume(sensor, path, auto=True)
        with pytest.raises(SessionError, match=r"XACCL_OFF was 0 and is 5"):
            list(runner.run(so_far=False))


def test_values_come_back_from_the_archive_to_the_last_bit(tmp_path):
    block, more = values(50, lost=2), values(30, lost=1, start=50 / 7)
    header = Header("iio:device0", "generic", plan("poses"), {"dwell_s": 1.0}, 9.81, None)
    with Archive.create(tmp_path / "a.session", header) as archive:
        archive.begin_run(0.0, 0.0)
        blocks = [("before", block), ("dwell", more)]
        archive.add_attempt(Attempt(0, Position(None), "complete", "2026-01-01", 0.0, 12.0, blocks))
        (stored,) = archive.attempts()
        again = archive.blocks(stored)
    assert [part.lost for part in again] == [2, 1]
    assert again[0].registers == block.registers
    assert np.array_equal(again[0].data, block.data)
    assert np.array_equal(again[1].time_s, more.time_s)


def test_blocks_of_values_are_cut_and_joined():
    whole = values(40, lost=3)
    parts = [cut(whole, 0, 10, counted=False), cut(whole, 10, 40, counted=True)]
    again = join(parts)
    assert np.array_equal(again.data, whole.data)
    assert again.lost == 3
    assert len(parts[0]) == 10
    assert whole.units == ("mg", "mg", "mg", "°C")
    assert list(block_series(whole)) == ["accel", "temperature_c"]


def test_a_recording_without_accelerometers_is_refused():
    with open_sensor(URL) as sensor, pytest.raises(UsageError, match="YACCL_OUT, ZACCL_OUT"):
        block_series(sensor.read_scans(5, ["XACCL_OUT", "SUPPLY_OUT"]))


def test_a_bus_is_opened_as_the_chip_behind_it():
    assert has_frames(URL)
    assert not has_frames("iio:device0")
    with open_source(URL, variant="adis16354") as source:
        assert isinstance(source, ChipSource)
        assert source.part.name == "adis16354"
        assert source.part.step_mg == 0.4672
        assert source.stage is source.sensor.bus.stage


def test_what_the_chip_borrows_for_a_session_is_set_back_however_often_it_was_configured():
    with open_source(URL) as source:
        source.sensor.configure(linear_g=True)
        before = source.registers()["MSC_CTRL"]
        source.configure(SHORT)
        source.configure(SHORT)
        assert source.why_polled == ""
        borrowed = source.registers()
        assert borrowed["MSC_CTRL"] & ~before
        with source.samples(SHORT, 64) as stream:
            assert "data-ready edge" in stream.how
        source.give_back()
        source.give_back()
        after = source.registers()
        assert after["MSC_CTRL"] == before
        # The wire may come off between two runs of a session: that is no other sensor.
        assert source.identity(borrowed, {}) == source.identity(after, {})


def test_a_session_that_forbids_data_ready_polls_and_says_why():
    with open_source(URL) as source:
        before = source.registers()["MSC_CTRL"]
        source.configure(Settings(dwell_s=0.5, data_ready=False))
        assert source.registers()["MSC_CTRL"] == before
        assert "switched off" in source.why_polled
        with source.samples(SHORT, 64) as stream:
            assert "polling" in stream.how


def test_a_sensor_without_words_of_status_is_judged_by_its_losses_alone():
    data = np.tile([0.0, 0.0, 1000.0, 3.3], (40, 1))
    block = ValueBlock(("ax", "ay", "az", "supply_v"), data, np.arange(40) / 100, lost=10)
    assert count_alarms(block) == 0
    assert problems(2, block, None) == [Problem("lost", "10 scans (20 %) lost on the bus", 2)]
