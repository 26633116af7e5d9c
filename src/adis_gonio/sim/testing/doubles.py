"""Simulated sensors and boards for tests of host code, and a bus that expects given frames.

A sensor is the driver over a simulated chip, with access to its stage and world. A board has the project's
firmware and a chip behind a serial port that any program can open: it speaks the wire protocol of
`firmware_proto/PROTOCOL.md` on a pseudo-terminal of this machine (POSIX), in real time, so that a
host program in any language can use it like a real board.

Not simulated
    The modem lines (a pty has none: opening the port does not reset the board), the baud rate
    (bytes leave at the rate of `SimulatedFirmware`, whatever the host sets), USB.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from adis_gonio.base import Closing
from adis_gonio.base.errors import CannotOpenError, UsageError
from adis_gonio.device.bus.contract import SpiBus, SpiTiming, Words
from adis_gonio.device.bus.host import SAFE_TIMING
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.sim.bus import SimBus, SimStage, open_from_url as _open_bus
from adis_gonio.sim.testing.faults import Faults, FaultyBus, FaultyStream
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins, WorkClock
from adis_gonio.sim.world import World

DEFAULT_URL = "sim:?seed=1"


class SimulatedSensor(Adis16354):
    """The driver with a simulated chip; `open_simulated` or the fixture `simulated_sensor` opens it.

    Host code calls the methods of the driver. Time is virtual: moves, dwells and waits cost nothing.

    Attributes
    ----------
    faulty : FaultyBus
        Bus of the driver, which corrupts frames by its `faults`; `faults.seen` counts the faults.
    stage : SimStage
        Simulated stage: `move_to(angle_deg, approach)` in the plane, `orient((x, y, z))` in space.
    world : World
        The simulated world of the sensor; `bring_to` heats the sensor or sets the supply.
    chip : SimulatedChip
        Simulated chip of the sensor, for access without frames.
    """

    def __init__(self, bus: SimBus, *, check: bool = True) -> None:
        self.faulty = FaultyBus(bus)
        self.stage, self.world, self.chip = bus.stage, bus.world, bus.chip
        super().__init__(self.faulty, bus.world.variant, check=check)

    def truth(self) -> dict[str, float]:
        """Return the true parameters of the simulated sensor by the names that a fit uses.

        `World.truth` lists their units.
        """
        return self.world.truth()


def simulated_bus(url: str = DEFAULT_URL) -> SimBus:
    """Open a simulated bus by a URL of the simulator.

    Parameters
    ----------
    url : str
        URL of the simulator: `sim:?seed=3&delta_k=0.01&effects=quadratic:k2_x=2`.

    Raises
    ------
    UsageError
        The URL belongs to another bus, or has an unknown option.
    """
    parsed = BusUrl.parse(url)
    if parsed.scheme != "sim":
        raise UsageError(f"'{url}': a test double is simulated; give a URL such as {DEFAULT_URL}")
    return _open_bus(parsed)


def open_simulated(
    url: str = DEFAULT_URL, *, check: bool = True, faults: Faults | None = None
) -> SimulatedSensor:
    """Open a driver with a simulated chip; use it as a context manager.

    Parameters
    ----------
    url : str
        URL of the simulator, which also gives the variant; see `simulated_bus`.
    check : bool
        True checks on opening that the chip answers and reads 1 g at rest.
    faults : Faults or None
        Faults of the frames, see `FaultyBus`; they begin after opening, so that opening never fails. Each
        sensor draws from its own copy, because one pytest mark may give them to many tests.

    Raises
    ------
    UsageError
        The URL belongs to another bus, or has an unknown option.
    """
    sensor = SimulatedSensor(simulated_bus(url), check=check)
    sensor.faulty.faults = _own_copy(faults)
    return sensor


def _own_copy(faults: Faults | None) -> Faults:
    return Faults() if faults is None else replace(faults, seen=Counter())


_BUFFER = 65536
_UNREAD = 1 << 20
"""Number of bytes that may wait for a host which does not read; further bytes are lost.

Serial adapters have such a limit.
"""


class SimulatedBoard(Closing):
    """A simulated board: firmware that a thread runs behind a pseudo-terminal.

    Use it as a context manager.

    Parameters
    ----------
    firmware : SimulatedFirmware
        Firmware on a `WorkClock`; `open_board` makes the firmware from a URL.
    faults : Faults
        Faults of the line: `drop`, `duplicate`, `flip`, `delay`, `chunk` and `hang`.

    Attributes
    ----------
    path : str
        Name of the port that a program opens: a device such as `/dev/pts/3`.
    url : str
        Bus URL of the board, for functions of this package such as `open_sensor`.
    chip : SimulatedChip
        The simulated chip that is connected to the board.
    world : World
        The simulated world of the chip, if the chip has one; `open_board` gives it one.

    Raises
    ------
    CannotOpenError
        The machine has no free pseudo-terminal.
    """

    def __init__(self, firmware: SimulatedFirmware, faults: Faults | None = None) -> None:
        if not isinstance(firmware.pins.clock, WorkClock):
            raise UsageError("a board runs in real time: give its firmware a WorkClock")
        self.firmware, self.chip = firmware, firmware.pins.chip
        self.faults = faults or Faults()
        self.world = cast(World, self.chip.surroundings)
        self._clock = firmware.pins.clock
        try:
            self._line = _Pty()
        except (OSError, ImportError) as error:
            raise CannotOpenError(f"no pty on this machine for a simulated board: {error}") from None
        self.path = self._line.path
        self.url = f"serial:{self.path}"
        self.lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._pump, name="simulated board", daemon=True)
        self._thread.start()

    @property
    def stage(self) -> BoardStage:
        """Stage that moves the sensor."""
        return BoardStage(self)

    def truth(self) -> dict[str, float]:
        """Return the true parameters of the simulated sensor by the names that a fit uses.

        `World.truth` lists their units.
        """
        with self.lock:
            return self.world.truth()

    def now_s(self) -> float:
        """Return the time in s on the clock of the board, or the time of its chip if that is later.

        Take `lock` first if clock and chip must not advance meanwhile.
        """
        return max(self._clock.now_s(), self.chip.time_s)

    def close(self) -> None:
        """Close the board's port and stop its thread; may be called twice."""
        self._stop.set()
        self._thread.join(60.0)
        self._line.close()

    unplug = close

    # -- the thread ----------------------------------------------------------------------------------

    def _pump(self) -> None:
        there, back = FaultyStream(self.faults), FaultyStream(self.faults)
        unread = bytearray()
        while not self._stop.is_set():
            there.faults = back.faults = self.faults
            try:
                due = (there.next_s(), back.next_s(), self.firmware.next_event_s())
                now = self._clock.wall_s()
                waits = (max(0.0, due_s - now) for due_s in due if due_s is not None)
                data = self._line.receive(min([0.05, *waits]), writes=bool(unread))
                if data:
                    there.put(data, self._clock.wall_s())
                with self.lock:
                    self._work(there, back)
                unread += back.take(self._clock.wall_s(), _BUFFER)
                del unread[:-_UNREAD]
                del unread[: self._line.send(bytes(unread))]
            except OSError:
                return

    def _work(self, there: FaultyStream, back: FaultyStream) -> None:
        """Run the firmware up to the present time and move bytes between the firmware and the serial line.

        `there` has the bytes from the host, `back` the bytes to the host.
        """
        now, firmware = self._clock.wall_s(), self.firmware
        firmware.run(now)
        data = there.take(now, _BUFFER)
        if data and not self.faults.hangs(now):
            firmware.feed(data)
        elif firmware.next_event_s() is None:
            firmware.pins.data_ready_edges()  # so that a request never finds a chip far behind
        while firmware.out:
            ready_s, packet = firmware.out.popleft()
            back.put(packet, max(ready_s, now))


class BoardStage(SimStage):
    """The simulated stage of a board; `move_to` and other moves wait in real time until they have ended."""

    def __init__(self, board: SimulatedBoard) -> None:
        self._board, self._stage = board, board.world.stage

    def _begin(self, motion: Callable[..., float], *arguments: object) -> float:
        with self._board.lock:
            return motion(self._board.now_s(), *arguments)

    def _wait_until(self, end_s: float) -> None:
        clock = self._board._clock
        while (left := end_s - clock.wall_s()) > 0:
            clock.sleep_s(left)


def open_board(
    url: str = DEFAULT_URL, *, faults: Faults | None = None, boot_s: float = 0.0
) -> SimulatedBoard:
    """Open a simulated board; a URL of the simulator describes the chip and its world.

    Parameters
    ----------
    url : str
        URL of the simulator, such as `sim:?seed=3&delta_k=0.01&move_speed_dps=360`. A sensor that
        `open_simulated` opens with this URL has equal hidden parameters.
    faults : Faults or None
        Faults of the serial line, see `SimulatedBoard`; each board draws from its own copy.
    boot_s : float
        Silence in s at the beginning, as while a board boots.

    Raises
    ------
    UsageError, CannotOpenError
        The URL is not possible, or the machine has no free pseudo-terminal.
    """
    firmware = SimulatedFirmware(ChipPins(simulated_bus(url).chip, WorkClock()), boot_s=boot_s)
    return SimulatedBoard(firmware, _own_copy(faults))


class _Pty:
    """The board's end of a pseudo-terminal; its methods raise `OSError` if the terminal was closed."""

    def __init__(self) -> None:
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)

    def receive(self, wait_s: float, *, writes: bool) -> bytes:
        """Return the bytes that have arrived, after waiting at most `wait_s` seconds for some.

        With `writes` it also returns as soon as bytes can be sent.
        """
        ready = select.select([self._master], [self._master] if writes else [], [], wait_s)
        return os.read(self._master, 4096) if ready[0] else b""

    def send(self, data: bytes) -> int:
        """Send as many of the bytes as the terminal accepts; return their number."""
        if not data:
            return 0
        try:
            return os.write(self._master, data[:4096])
        except BlockingIOError:
            return 0

    def close(self) -> None:
        for end in (self._slave, self._master):
            with contextlib.suppress(OSError):
                os.close(end)
        self._slave = self._master = -1


class ExpectedFrames(SpiBus):
    """A bus that accepts only the expected frames, in their order, and gives their replies.

    Another frame, a missing frame at `close` and a frame after the last one raise `AssertionError`; the
    message names the line of the test that expected the frame. Time is virtual.

    Parameters
    ----------
    script : iterable of (frame, reply)
        Expected frames with their replies; messages name the line of this call. `expect` adds more frames.

    Examples
    --------
    >>> bus = ExpectedFrames()
    >>> bus.expect(0x3600, 0x0000)  # read SMPL_PRD; the reply belongs to the frame before
    >>> bus.expect(0x0000, 0x0001)
    >>> bus.exchange([0x3600, 0x0000])
    [0, 1]
    """

    def __init__(self, script: Iterable[tuple[int, int]] = ()) -> None:
        super().__init__(SAFE_TIMING)
        self.url = "expected:"
        place = _place_of_caller()
        self._script = [(frame, reply, place) for frame, reply in script]
        self._at = 0
        self._time_s = 0.0

    def expect(self, frame: int, reply: int) -> None:
        """Expect one more frame; the chip shifts `reply` out while it shifts the frame in."""
        self._script.append((frame, reply, _place_of_caller()))

    def now_s(self) -> float:
        """Return the virtual time in s."""
        return self._time_s

    def sleep_s(self, seconds: float) -> None:
        """Advance the virtual time by some seconds."""
        self._time_s += seconds

    def _exchange(self, frames: Words) -> Words:
        replies = []
        for frame in frames.tolist():
            if self._at == len(self._script):
                raise AssertionError(f"frame 0x{frame:04X} comes after all {self._at} expected frames")
            expected, reply, place = self._script[self._at]
            if frame != expected:
                raise AssertionError(
                    f"{place}: frame {self._at} is 0x{frame:04X}, expected 0x{expected:04X}"
                )
            replies.append(reply)
            self._at += 1
            self._time_s += self.timing.frame_s
        return np.array(replies, np.uint16)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return timing

    def _close(self) -> None:
        missing = self._script[self._at :]
        if missing:
            first, _, place = missing[0]
            raise AssertionError(f"{place}: frames never sent: {len(missing)}, first 0x{first:04X}")


def _place_of_caller() -> str:
    """Return file name and line of the test code that called a method of the bus."""
    frame = sys._getframe(2)
    return f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
