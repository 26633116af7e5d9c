"""A serial port to the simulated firmware in virtual time."""

from __future__ import annotations

from adis_gonio.base.errors import CannotOpenError
from adis_gonio.sim.testing.faults import Faults, FaultyStream
from adis_gonio.sim.testing.firmware import SimulatedFirmware

BUFFER = 65536


class FakePort:
    """An open port in virtual time, as the link of the transport needs it.

    Time-outs cost nothing, so that a hundred thousand requests over a bad line take a minute.
    """

    def __init__(self, firmware: SimulatedFirmware, faults: Faults | None = None) -> None:
        self.firmware = firmware
        self.clock = firmware.pins.clock
        self.closed = False
        self.plugged = True
        self.sent: list[bytes] = []
        self._faults = faults or Faults()
        self._there = FaultyStream(self._faults, firmware.byte_s)
        self._back = FaultyStream(self._faults)

    @property
    def faults(self) -> Faults:
        return self._faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self._faults = self._there.faults = self._back.faults = faults

    def receive(self, wait_s: float, /) -> bytes:
        self._check()
        end_s = self.clock.now_s() + wait_s
        while True:
            self._work()
            if self.clock.now_s() > end_s:
                return b""  # the firmware was at work for longer than the host waits
            data = self._back.take(self.clock.now_s(), BUFFER)
            if data or self.clock.now_s() == end_s:
                return data
            times = (self._there.next_s(), self._back.next_s(), self.firmware.next_event_s())
            self.clock.advance_to(min([end_s, *(t for t in times if t is not None)]))

    def send(self, data: bytes, /) -> None:
        self._check()
        self.sent.append(data)
        self._work()
        self._there.put(data, self.clock.now_s())

    def close(self) -> None:
        self.closed = True

    def _check(self) -> None:
        if self.plugged and self._faults.happens("unplug"):
            self.plugged = False
        if self.closed or not self.plugged:
            raise CannotOpenError("fake port: the device is gone")

    def _work(self) -> None:
        """Let the firmware catch up with the clock."""
        clock, firmware = self.clock, self.firmware
        now = clock.now_s()
        firmware.run(now)
        data = self._there.take(now, BUFFER)
        if data and not self._faults.hangs(now):
            firmware.feed(data)
        while firmware.out:
            ready_s, packet = firmware.out.popleft()
            self._back.put(packet, max(ready_s, clock.now_s()))
