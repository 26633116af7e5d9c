"""The IIO device: units, XML and the bytes of a scan."""

import math
import threading
import time
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from adis_gonio.device.sensor import VARIANTS, Adis16354
from adis_gonio.device.sensor.registers import REGISTERS
from adis_gonio.device.sensor.settings import Configuration, low_pass_3db_hz, smpl_prd_for
from adis_gonio.faces.serve.iio_device import (
    Buffer,
    Sampler,
    ScanFormat,
    SensorState,
    ServedDevice,
    filter_for,
)
from adis_gonio.faces.serve.iiod_protocol import Errno, Refused
from adis_gonio.sim import SimBus, World


def state_of(**changes):
    settings = {"smpl_prd": 1, "filter_m": 2, "gyro_range_dps": 300}
    configuration = Configuration(**(settings | changes), data_ready=False, linear_g=False, origin=False)
    return SensorState(
        configuration, {row.name: k for k, row in enumerate(REGISTERS) if "_OFF" in row.name}, 0x0402
    )


def device_of(part="adis16354"):
    return ServedDevice(VARIANTS[part], 'a "sensor" & more')


def value(device, channel, name, state):
    return float(device.channel_value(device.channel(channel), name, state))


@pytest.mark.parametrize(("part", "one_g"), [("adis16354", 2140), ("adis16350", 397)])
def test_one_g_is_981_in_si_units_for_each_variant(part, one_g):
    scale = value(device_of(part), "accel_z", "scale", state_of())
    assert one_g * scale == pytest.approx(9.80665, rel=2e-3)


@pytest.mark.parametrize("dps", [300, 150, 75])
def test_the_gyros_scale_follows_the_range(dps):
    scale = value(device_of(), "anglvel_x", "scale", state_of(gyro_range_dps=dps, filter_m=4))
    # data sheet: 0.07326 °/s per LSB at ±300 °/s
    assert math.degrees(scale) == pytest.approx(0.07326 * dps / 300)


def test_temperature_is_millidegrees_and_supply_millivolts():
    device, state = device_of(), state_of()
    scale, offset = (value(device, "temp_x", name, state) for name in ("scale", "offset"))
    assert (0 + offset) * scale == pytest.approx(25_000)
    assert (100 + offset) * scale == pytest.approx(25_000 + 14_530)
    assert 2730 * value(device, "voltage0", "scale", state) == pytest.approx(5000, rel=1e-3)


def test_filter_frequencies_are_those_of_the_chips_table():
    table = [350, 149, 67.3, 32.9, 16.4, 8.17, 4.08]
    assert [low_pass_3db_hz(m, 819.2) for m in range(7)] == pytest.approx(table, rel=4e-3)
    device, state = device_of(), state_of(smpl_prd=0x03)
    offered = device.channel_value(
        device.channel("accel_x"), "filter_low_pass_3db_frequency_available", state
    )
    assert [filter_for(float(hz), state) for hz in offered.split()] == list(range(7))
    assert filter_for(1.0, state) == 6
    for hz in (0.0, -3.0, math.inf):
        with pytest.raises(Refused):
            filter_for(hz, state)


def test_every_rate_that_is_offered_is_one_that_the_part_has():
    device, state = device_of(), state_of()
    offered = device.device_value("sampling_frequency_available", state).split()
    for hz in map(float, offered):
        n = smpl_prd_for(hz)
        assert device.device_value("sampling_frequency", state_of(smpl_prd=n)) == f"{hz:.10g}"
    assert len(" ".join(offered)) < 1000  # libiio's buffers


def test_the_xml_names_what_can_be_asked_for():
    device, state = device_of(), state_of()
    root = ET.fromstring(device.xml(state))
    assert root.get("description") == 'a "sensor" & more'
    channels = root.findall("device/channel")
    assert [c.get("id") for c in channels] == [c.id for c in device.channels]
    assert [int(c.find("scan-element").get("index")) for c in channels] == list(range(len(channels)))
    for element in channels[:-1]:
        for attribute in element.findall("attribute"):
            if attribute.get("name") != "raw":
                device.channel_value(device.channel(element.get("id")), attribute.get("name"), state)
    files = {a.get("filename") for a in root.iter("attribute") if a.get("filename")}
    assert {
        "in_accel_x_calibbias",
        "in_voltage0_supply_raw",
        "in_temp_x_offset",
    } <= files
    assert "in_accel_filter_low_pass_3db_frequency" in files


@pytest.mark.parametrize(
    ("mask", "size", "offsets"),
    [
        ("00000001", 2, [0]),
        ("00000007", 6, [0, 2, 4]),
        ("00000101", 16, [0, 8]),  # a time after one sample: padded to its own size
        ("000001ff", 24, [0, 2, 4, 6, 8, 10, 12, 14, 16]),
    ],
)
def test_samples_are_aligned_as_libiio_expects(mask, size, offsets):
    dtype = ScanFormat.of_mask(device_of(), mask).dtype
    assert dtype.itemsize == size
    assert [dtype.fields[name][1] for name in dtype.names] == offsets


@pytest.mark.parametrize("mask", ["1", "00000000", "00000200", "0000000000000001", "0000001x"])
def test_a_mask_that_does_not_fit_is_refused(mask):
    with pytest.raises(Refused) as refused:
        ScanFormat.of_mask(device_of(), mask)
    assert refused.value.errno is Errno.EINVAL


def test_packed_scans_are_little_endian_numbers():
    packed = ScanFormat.of_mask(device_of(), "00000102").pack(
        np.array([[0, -2, 0, 0, 0, 0, 0, 0]], np.int32), np.array([5], np.int64)
    )
    assert packed.tobytes() == b"\xfe\xff" + b"\0" * 6 + b"\x05" + b"\0" * 7


def test_a_full_queue_loses_its_oldest_and_counts_them():
    buffer = Buffer(ScanFormat.of_mask(device_of(), "00000001"), 10)
    numbers, taken = np.repeat(np.arange(100, dtype=np.int32)[:, np.newaxis], 8, axis=1), []
    for k in range(0, 60, 6):
        buffer.put(numbers[k : k + 6], np.zeros(6, np.int64))
        if k == 24:
            taken += np.frombuffer(buffer.take(4), "<i2").tolist()
    taken += np.frombuffer(buffer.take(1000), "<i2").tolist()
    assert len(buffer) == 0
    assert taken == [20, 21, 22, 23, *range(50, 60)]
    assert buffer.lost == 60 - len(taken)


def test_times_of_scans_increase_after_a_stream_that_was_timed_too_late(monkeypatch):
    clock_ns, late_ns = time.time_ns, [10**12]
    monkeypatch.setattr(time, "time_ns", lambda: clock_ns() + (late_ns.pop() if late_ns else 0))
    times, came = [], threading.Semaphore(0)

    def on_scans(_, time_ns):
        times.append(time_ns)
        came.release()

    with Adis16354(SimBus(world=World(seed=1))) as sensor:
        sampler = Sampler(sensor, on_scans, times.append)
        sampler.want(True)
        for _ in range(3):
            assert came.acquire(timeout=60)
            sampler.submit(lambda sensor: None).result(60)
        assert came.acquire(timeout=60)
        sampler.stop()
    assert not late_ns
    assert (np.diff(np.concatenate(times)) > 0).all()
