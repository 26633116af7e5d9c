"""The whole chain: pyserial, tty, ftdi_sio, xHCI, QEMU's FT232, the firmware's binary, its pins, chip."""

import os
import time

import pytest
import serial

from adis_gonio.bus.wire.protocol import HelloReply
from firmware.client import Client
from kernel.bench import node

SERIAL = "FW1"


@pytest.fixture(autouse=True)
def _firmware() -> None:
    reason = os.environ.get("ADIS_GONIO_NO_FIRMWARE")
    if reason:
        pytest.skip(reason)


def test_the_firmware_answers() -> None:
    with serial.Serial(str(node(SERIAL, "tty")), 500_000, timeout=1) as port:
        client = Client(port, timeout_s=5, clock=time.monotonic)
        hello = client.hello()
        assert isinstance(hello, HelloReply)
