"""Serial ports to a fake firmware: one in virtual time, and a pty for the real pyserial."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import tty

from adis_gonio.errors import CannotOpenError
from fakes.faults import Faults, FaultyStream
from fakes.firmware import FakeFirmware

BUFFER = 65536


class FakePort:
    """An open port in virtual time, as the link of the transport needs it.

    Time-outs cost nothing, so that a hundred thousand requests over a bad line take a minute.
    """

    def __init__(self, firmware: FakeFirmware, faults: Faults | None = None) -> None:
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


class PtyBoard:
    """The firmware, on a `WorkClock`, behind a pty and pumped by a thread; `path` opens with pyserial.

    A pty has no modem lines, so that RTS and DTR fail as they do on such ports.
    """

    def __init__(self, firmware: FakeFirmware, faults: Faults | None = None) -> None:
        self.firmware = firmware
        self.faults = faults or Faults()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def _pump(self) -> None:
        there, back = FaultyStream(self.faults), FaultyStream(self.faults)
        clock, firmware = self.firmware.pins.clock, self.firmware
        while not self._stop.is_set():
            now = clock.wall_s()
            times = [t for t in (there.next_s(), back.next_s(), firmware.next_event_s()) if t is not None]
            wait = min([0.05, *(max(0.0, t - now) for t in times)])
            try:
                if select.select([self._master], [], [], wait)[0]:
                    there.put(os.read(self._master, 4096), clock.wall_s())
                now = clock.wall_s()
                firmware.run(now)
                data = there.take(now, BUFFER)
                if data and not self.faults.hangs(now):
                    firmware.feed(data)
                elif firmware.next_event_s() is None:
                    firmware.pins.data_ready_edges()  # so that a request never finds a chip far behind
                while firmware.out:
                    ready_s, packet = firmware.out.popleft()
                    back.put(packet, max(ready_s, now))
                data = back.take(clock.wall_s(), BUFFER)
                if data:
                    os.write(self._master, data)
            except OSError:
                return

    def unplug(self) -> None:
        """The port goes away."""
        self._stop.set()
        self._thread.join(60)
        with contextlib.suppress(OSError):
            os.close(self._slave)
        with contextlib.suppress(OSError):
            os.close(self._master)

    def __enter__(self) -> PtyBoard:
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()
