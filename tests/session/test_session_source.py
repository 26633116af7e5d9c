"""The seam between a session and its sensor: the chip's driver, and blocks of values."""

import numpy as np
import pytest

from adis_gonio.errors import SessionError, UsageError
from adis_gonio.sensor import open_sensor
from adis_gonio.session import SessionRunner, Settings, plan
from adis_gonio.session.archive import Archive, Attempt, Header
from adis_gonio.session.blocks import ValueBlock, cut, join, session_columns
from adis_gonio.session.events import DwellDone
from adis_gonio.session.plans import Position
from adis_gonio.session.source import has_frames, open_source

SHORT = Settings(dwell_s=0.5)
URL = "sim:?seed=3"


def values(count, lost=0, start=0.0):
    data = np.random.default_rng(count).normal(size=(count, 4)) * 1000 / 3
    return ValueBlock(("ax", "ay", "az", "temp_c"), data, start + np.arange(count) / 7, lost)


def test_a_session_is_not_resumed_on_a_chip_whose_offset_was_changed(tmp_path):
    path = tmp_path / "a.session"
    with open_sensor(URL) as sensor:
        runner = SessionRunner.begin(sensor, path, plan("four-position"), SHORT, auto=True)
        for event in runner.run():
            if isinstance(event, DwellDone):
                runner.stop()
    with open_sensor(URL) as sensor:
        sensor.write("XACCL_OFF", 5)
        runner = SessionRunner.resume(sensor, path, auto=True)
        with pytest.raises(SessionError, match=r"XACCL_OFF was 0 and is 5"):
            list(runner.run())


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
    assert list(session_columns(whole)) == ["ax", "ay", "az", "temp_c"]


def test_a_recording_without_accelerometers_is_refused():
    with open_sensor(URL) as sensor, pytest.raises(UsageError, match="YACCL_OUT, ZACCL_OUT"):
        session_columns(sensor.read_scans(5, ["XACCL_OUT", "SUPPLY_OUT"]))


def test_a_bus_is_opened_as_the_chip_behind_it():
    assert has_frames(URL)
    assert not has_frames("iio:device0")
    with open_source(URL, variant="adis16354") as source:
        assert source.part.name == "adis16354"
        assert source.part.step_mg == 0.4672
        assert source.stage is source.sensor.bus.stage
