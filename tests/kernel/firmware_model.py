"""The firmware's fake as a board on a serial line, in real time."""

from __future__ import annotations

import threading
from collections.abc import Callable

from adis_gonio.sim.testing.firmware import SimulatedFirmware

IDLE_S = 0.05


class FirmwareModel:
    """Lets the firmware live in a thread: bytes in from the line, packets out to it."""

    def __init__(self, firmware: SimulatedFirmware) -> None:
        self._firmware = firmware
        self._arrived = bytearray()
        self._news = threading.Condition()
        self._powered = True

    def connect(self, send: Callable[[bytes], None]) -> None:
        """Power on; bytes for the host go to `send`."""
        threading.Thread(target=self._live, args=(send,), daemon=True).start()

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        with self._news:
            self._arrived += data
            self._news.notify()

    def close(self) -> None:
        """Power off."""
        with self._news:
            self._powered = False
            self._news.notify()

    def _live(self, send: Callable[[bytes], None]) -> None:
        firmware, clock = self._firmware, self._firmware.pins.clock
        while True:
            event = firmware.next_event_s()
            wait = IDLE_S if event is None else min(IDLE_S, max(0.0, event - clock.now_s()))
            with self._news:
                if not self._arrived:
                    self._news.wait(wait)
                if not self._powered:
                    return
                data, self._arrived = bytes(self._arrived), bytearray()
            firmware.run(clock.now_s())
            if data:
                firmware.feed(data)
            else:
                firmware.pins.data_ready_edges()  # so that a request never finds a chip far behind
            while firmware.out:
                send(firmware.out.popleft()[1])
