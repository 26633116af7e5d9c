"""The rig itself: the kernel's USB, HID and tty stacks carry bytes to the boards and back, with faults."""

import errno
import os
import select
import time
from collections.abc import Callable
from typing import Any

import hid
import hidraw
import libusb_package
import pytest
import serial
import usb.core

from kernel.bench import Bench, node, serials

REPORT = bytes(range(1, 65))


def read_node(handle: int, seconds: float) -> bytes:
    ready, _, _ = select.select([handle], [], [], seconds)
    return os.read(handle, 64) if ready else b""


def bulk_device(serial_number: str) -> usb.core.Device:
    backend = libusb_package.get_libusb1_backend()
    found = usb.core.find(
        idVendor=0x10C4,
        idProduct=0x87A0,
        backend=backend,
        custom_match=lambda d: d.serial_number == serial_number,
    )
    assert found is not None
    return found


def test_the_kernel_reads_the_descriptors_and_binds_its_drivers(bench: Bench) -> None:
    for kind in ("hid", "bulk", "serial"):
        bench.plug(f"echo-{kind}", f"RIG-{kind}")
    ids = {
        name: (path / "idVendor").read_text().strip() + ":" + (path / "idProduct").read_text().strip()
        for name, path in serials().items()
        if name.startswith("RIG-")
    }
    assert ids == {"RIG-hid": "04d8:00de", "RIG-bulk": "10c4:87a0", "RIG-serial": "2341:0043"}
    assert node("RIG-hid", "hidraw").exists()
    assert node("RIG-serial", "tty").exists()
    assert node("RIG-bulk", "usb").exists()
    assert (serials()["RIG-hid"] / "product").read_text().strip() == "MCP2210 USB-to-SPI Master"


def test_a_report_comes_back_through_hidraw(bench: Bench) -> None:
    bench.plug("echo-hid", "RIG-1")
    handle = os.open(node("RIG-1", "hidraw"), os.O_RDWR)
    try:
        os.write(handle, b"\0" + REPORT)
        assert read_node(handle, 2) == REPORT
    finally:
        os.close(handle)


@pytest.mark.parametrize("library", [hid, hidraw], ids=["libusb", "hidraw"])
def test_a_report_comes_back_through_each_backend_of_hidapi(
    bench: Bench, library: Any, record_property: Callable[[str, object], None]
) -> None:
    bench.plug("echo-hid", "RIG-1")
    (found,) = library.enumerate(0x04D8, 0x00DE)
    assert found["serial_number"] == "RIG-1"
    device = library.device()
    device.open_path(found["path"])
    try:
        start = time.monotonic()
        for _ in range(20):
            assert device.write(b"\0" + REPORT) == 65
            assert bytes(device.read(64, 1000)) == REPORT
        record_property("round_trip_ms", f"{(time.monotonic() - start) / 20 * 1e3:.1f}")
    finally:
        device.close()


def test_bulk_and_control_transfers_come_back(bench: Bench) -> None:
    bench.plug("echo-bulk", "RIG-1")
    device = bulk_device("RIG-1")
    device.set_configuration()
    device.ctrl_transfer(0x40, 0x30, 0, 0, b"\1\2\3")
    assert bytes(device.ctrl_transfer(0xC0, 0x31, 0, 0, 16)) == b"\1\2\3"
    for size in (2, 64, 130):
        data = bytes(k % 251 for k in range(size))
        assert device.write(0x01, data, 1000) == size
        assert bytes(device.read(0x82, size, 1000)) == data
    with pytest.raises(usb.core.USBError) as refused:
        device.ctrl_transfer(0x40, 0x66, 0, 0, b"")
    assert refused.value.errno == errno.EPIPE
    usb.util.dispose_resources(device)


def test_a_stalled_endpoint_works_again_once_cleared(bench: Bench) -> None:
    port = bench.plug("echo-bulk", "RIG-1")
    device = bulk_device("RIG-1")
    device.set_configuration()
    bench.stall(port, 0x01)
    with pytest.raises(usb.core.USBError) as refused:
        device.write(0x01, b"ab", 1000)
    assert refused.value.errno == errno.EPIPE
    device.clear_halt(0x01)
    assert device.write(0x01, b"ab", 1000) == 2
    assert bytes(device.read(0x82, 2, 1000)) == b"ab"
    usb.util.dispose_resources(device)


def test_an_endpoint_that_never_answers_is_given_up_in_time(bench: Bench) -> None:
    port = bench.plug("echo-bulk", "RIG-1")
    device = bulk_device("RIG-1")
    device.set_configuration()
    bench.refuse(port, 0x01)
    start = time.monotonic()
    with pytest.raises(usb.core.USBTimeoutError):
        device.write(0x01, b"ab", 300)
    assert time.monotonic() - start < 2
    usb.util.dispose_resources(device)


def test_bytes_come_back_through_the_tty_and_the_board_sees_the_line(bench: Bench) -> None:
    port = bench.plug("echo-serial", "RIG-1")
    with serial.Serial(str(node("RIG-1", "tty")), 500_000, timeout=2) as line:
        for size in (1, 64, 700):
            data = bytes(k % 251 for k in range(size))
            line.write(data)
            assert line.read(size) == data
        assert bench.state(port)["baud_rate"] == 500_000
        assert bench.state(port)["line_state"] == 3
        line.dtr = False
        assert bench.state(port)["line_state"] == 2


def test_a_cable_pulled_in_the_middle_is_seen_at_once(bench: Bench) -> None:
    port = bench.plug("echo-serial", "RIG-1")
    with serial.Serial(str(node("RIG-1", "tty")), 500_000, timeout=2) as line:
        bench.unplug_after(port, 3)
        start = time.monotonic()
        with pytest.raises((OSError, serial.SerialException)):  # noqa: PT012 - which call sees it is open
            for _ in range(10):
                line.write(b"x")
                line.read(1)
        assert time.monotonic() - start < 5
