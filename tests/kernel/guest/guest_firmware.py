"""The whole chain: pyserial, tty, ftdi_sio, xHCI, QEMU's FT232, the firmware's binary, its pins, chip."""

import os

import pytest

from adis_gonio.device.sensor import open_sensor
from adis_gonio.device.sensor.registers import ND

URL = "serial:?serial_number=FW1&boot_ms=60000"
"""On a busy host the guest reads a stream slowly: the answer to a hello waits behind scans."""
SCANS = 400


@pytest.fixture(autouse=True)
def _firmware() -> None:
    reason = os.environ.get("ADIS_GONIO_NO_FIRMWARE")
    if reason:
        pytest.skip(reason)


def test_the_driver_streams_at_the_full_rate_through_the_firmwares_binary() -> None:
    with open_sensor(URL) as sensor:
        assert sensor.quantity("SUPPLY_OUT").value == pytest.approx(5.0, abs=0.1)
        sensor.write("ALM_MAG1", 0x1234)
        assert sensor.read("ALM_MAG1") == 0x1234
        sensor.configure(sample_rate_hz=819.2)
        names = ["XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT"]
        scans = lost = 0
        with sensor.stream(names, block_scans=100) as stream:
            while scans < SCANS:
                block = next(stream)
                assert (block.words & ND).all()
                scans += len(block)
                lost += block.lost
        assert lost == 0
        assert sensor.configuration().data_ready is False, "the stream had enabled it for its time"
