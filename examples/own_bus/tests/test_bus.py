"""The bus keeps the contract, and adis-gonio finds and opens it by its URL."""

import json
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest

from adis_gonio import open_sensor
from adis_gonio.base.errors import CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus import SpiTiming, open_bus
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.testing import BusContract, Rig, WatchedChip

SEED = 5


class Bridge:
    """The bridge's firmware as a model: a thread behind a TCP port, with a simulated chip at its pins."""

    def __init__(self, chip_bus: SimBus) -> None:
        self.bus = chip_bus
        self.spoil = ""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.place = f"127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        line, _ = self._server.accept()
        self._server.close()
        with line, line.makefile("rw", encoding="ascii", newline="\n") as file:
            for request in file:
                file.write(self._answer(request) + "\n")
                file.flush()

    def _answer(self, request: str) -> str:
        spoilt, self.spoil = self.spoil, ""
        if spoilt:
            return spoilt
        kind, *words = request.split()
        if kind == "C":
            self.bus.configure(SpiTiming(*map(float, words)))
            return "OK"
        replies = self.bus.exchange_array(np.array([int(word, 16) for word in words], np.uint16))
        return "= " + " ".join(f"{reply:04X}" for reply in replies)


class TestHexline(BusContract):
    def make(self) -> Rig:
        world = World(seed=SEED)
        chip = WatchedChip(world, start_s=-0.5)
        inner = SimBus(world=world, chip=chip)
        bridge = Bridge(inner)
        bus = open_bus(f"hexline:{bridge.place}")
        # The bridge's time is simulated: whoever waits, waits on its clock.
        bus.now_s, bus.sleep_s = inner.now_s, inner.sleep_s

        def says(answer):
            return lambda: setattr(bridge, "spoil", answer)

        faults = {
            "refused": (says("! overcurrent"), ProtocolError),
            "noise": (says("?#"), ProtocolError),
            "short": (says("= 0000"), ProtocolError),
            "no word": (says("= 0000 GGGG"), ProtocolError),
        }
        return Rig(bus, chip, SimulatedChip(World(seed=SEED), start_s=-0.5), faults)


def test_the_driver_reads_through_it():
    bridge = Bridge(SimBus(World(seed=SEED)))
    with open_sensor(f"hexline:{bridge.place}") as sensor:
        assert sensor.read("SMPL_PRD") == 1


def test_it_is_listed():
    command = [sys.executable, "-m", "adis_gonio", "devices", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert "hexline:HOST:PORT" in [row["url"] for row in json.loads(done.stdout)["devices"]]


@pytest.mark.parametrize(
    ("url", "error"),
    [
        ("hexline:nowhere", UsageError),
        ("hexline:a:1?x=2", UsageError),
        ("hexline:127.0.0.1:1", CannotOpenError),
    ],
)
def test_what_cannot_be_opened_is_said_with_its_url(url, error):
    with pytest.raises(error, match=url.partition("?")[0]):
        open_bus(url)
