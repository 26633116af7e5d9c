"""Faults on the wire: many requests over the byte-level fake of each bridge, with seeded faults.

Shows that no wrong word is accepted, that every failure is a typed error within its time-out, and that the
bus is usable afterwards. The fakes live in virtual time, so that time-outs cost nothing.

    python scripts/wire_faults.py [--requests 100000] [--seed 1] [--only serial,stream,mcp2210,…]

`stream` and `polled` are the driver's continuous scans over the bad serial line, at the data-ready edge
and without it: as many packets of scans or polled batches, short and long, at the full rates and at parts
of them. Every word says which update of the chip it is of, so that each row that is delivered is judged:
all of its words of one update, none twice. Each gap that is counted is judged too: of streams block by
block; of polled scans, whose times a repeated request leaves open, when the line is quiet again.

Rates: 1 % of each fault a byte on the serial line (drop, duplicate, flip, delay, chunk) and 0.1 % hangs a
delivery. On USB the unit is a packet, as the cable's own CRC and sequence bits guard its bytes: 1 % each of
lost, late, refused, stuck and short ones, of duplicates and of flips in each byte of the four that head
an MCP2210 report; behind every tenth report some of its polls are "in progress". Bytes of data that a
bridge's protocol leaves to USB's CRC are not flipped. Every bus is unplugged and reopened now and then.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import random
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.base.errors import BusError, CannotOpenError
from adis_gonio.device.bus import BusUrl, SpiBus, SpiTiming, cp2130, mcp2210, serial, spidev
from adis_gonio.device.sensor import Adis16354
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.sampling import OUTPUTS
from adis_gonio.sim.testing.faults import Faults
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.cp2130_device import Cp2130Device
from fakes.cp2130_usb import FakeUsbBackend, UsbBoard
from fakes.mcp2210_device import Mcp2210Device
from fakes.mcp2210_hid import FakeHid, HidBoard
from fakes.numbered_scans import Judge, NumberedChip
from fakes.serial_port import FakePort
from fakes.spidev_kernel import FakeSpidevKernel
from fakes.virtual_clock import VirtualClock

FAST = SpiTiming(1e6, 9.0, 40.0)
UNPLUG = 2e-4
LONGEST_S = 8.0
"""Longest that one exchange may take, repetitions, recovery and a new session included."""

OFFSETS = tuple(range(0x1A, 0x26, 2))
"""Registers that only writes change; each is given a value of its own."""


class Rig(ABC):
    """A fake with a chip that answers every register with a number of its own."""

    def __init__(self, seed: int) -> None:
        self.clock = VirtualClock()
        self.chip = SimulatedChip(World(seed=1), start_s=-0.5)
        self.pins = ChipPins(self.chip, self.clock)
        self.quiet = Faults(seed=seed)
        self.faults = self.quiet

    @abstractmethod
    def open(self) -> SpiBus:
        """A bus on the fake."""

    @abstractmethod
    def set(self, faults: Faults) -> None:
        """Let other faults happen from now on."""

    @abstractmethod
    def replug(self) -> None:
        """Out and in again."""


class SerialRig(Rig):
    """The firmware behind a bad line."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.firmware = SimulatedFirmware(self.pins)
        self.port = FakePort(self.firmware)

    def open(self) -> SpiBus:  # noqa: D102
        return serial.open_from_url(BusUrl.parse("serial:fake"), port=self.port, clock=self.clock)

    def set(self, faults: Faults) -> None:  # noqa: D102
        self.faults = self.port.faults = faults

    def replug(self) -> None:  # noqa: D102
        self.firmware.restart()
        self.port = FakePort(self.firmware, self.faults)


class Mcp2210Rig(Rig):
    """An MCP2210 behind hidapi."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.board = HidBoard(Mcp2210Device(self.pins))
        self.hid = FakeHid(self.board)

    def open(self) -> SpiBus:  # noqa: D102
        return mcp2210.open_from_url(BusUrl.parse("mcp2210:"), hid=self.hid, clock=self.clock)

    def set(self, faults: Faults) -> None:  # noqa: D102
        self.faults = self.board.faults = faults

    def replug(self) -> None:  # noqa: D102
        self.board.replug()


class Cp2130Rig(Rig):
    """A CP2130 behind pyusb."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.board = UsbBoard(Cp2130Device(self.pins))
        self.backend = FakeUsbBackend(self.board)

    def open(self) -> SpiBus:  # noqa: D102
        return cp2130.open_from_url(BusUrl.parse("cp2130:"), backend=self.backend, clock=self.clock)

    def set(self, faults: Faults) -> None:  # noqa: D102
        self.faults = self.board.faults = faults

    def replug(self) -> None:  # noqa: D102
        self.board.replug()


class SpidevRig(Rig):
    """SPI pins behind ioctl."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.kernel = FakeSpidevKernel({"/dev/spidev0.0": self.pins})

    def open(self) -> SpiBus:  # noqa: D102
        url = BusUrl.parse("spidev:/dev/spidev0.0")
        return spidev.open_from_url(url, system=self.kernel, clock=self.clock)

    def set(self, faults: Faults) -> None:  # noqa: D102
        self.faults = self.kernel.faults = faults

    def replug(self) -> None:  # noqa: D102
        self.kernel.unplugged = False


BYTES = dict.fromkeys(("drop", "duplicate", "flip", "delay", "chunk"), 0.01) | {"hang": 0.001}
REPORTS = dict.fromkeys(("drop", "duplicate", "flip", "delay", "busy", "stuck", "short"), 0.01)
POLLS = {"progress": 0.1}
TRANSFERS = dict.fromkeys(("drop", "delay", "busy", "stuck", "short"), 0.01)
CALLS = dict.fromkeys(("drop", "hang", "busy", "short"), 0.01)
RIGS: dict[str, tuple[Callable[[int], Rig], dict[str, float]]] = {
    "serial": (SerialRig, BYTES),
    "mcp2210": (Mcp2210Rig, REPORTS | POLLS | {"hang": 0.001}),
    "cp2130": (Cp2130Rig, TRANSFERS | {"hang": 0.001}),
    "spidev": (SpidevRig, CALLS),
}


def reopen(rig: Rig) -> SpiBus:
    """Plug in again and open, for as long as it takes."""
    while True:
        rig.replug()
        with contextlib.suppress(BusError):
            bus = rig.open()
            try:
                bus.configure(FAST)
            except BusError:
                bus.close()
            else:
                return bus


def run(name: str, requests: int, seed: int) -> dict[str, object]:
    """Many requests with faults; raises where a promise is broken."""
    build, rates = RIGS[name]
    rig = build(seed)
    bus = rig.open()
    bus.configure(FAST)
    values = {}
    for k, address in enumerate(OFFSETS):
        value = (0x123 + 0x111 * k) & 0x7FF
        bus.exchange([0x8000 | address << 8 | value & 0xFF, 0x8000 | address + 1 << 8 | value >> 8])
        values[address << 8] = value
    assert [bus.exchange([frame, 0])[1] for frame in values] == list(values.values())
    rig.set(Faults(seed=seed, unplug=UNPLUG, **rates))
    dice = random.Random(seed)
    outcome: Counter[str] = Counter()
    longest = 0.0
    for _ in range(requests):
        ask = [dice.choice(list(values)) for _ in range(dice.randrange(1, 5))]
        begin = rig.clock.now_s()
        try:
            replies = bus.exchange([*ask, 0])
        except BusError as error:
            outcome[type(error).__name__] += 1
            if isinstance(error, CannotOpenError) and "gone" in str(error):
                bus.close()
                bus = reopen(rig)
                begin = rig.clock.now_s()
        else:
            outcome["answered"] += 1
            wrong = [(a, r) for a, r in zip(ask, replies[1:], strict=True) if r != values[a]]
            if wrong:
                outcome["WRONG"] += 1
        longest = max(longest, rig.clock.now_s() - begin)
    happened = dict(rig.faults.seen)
    rig.set(Faults(seed=seed))
    rig.clock.sleep_s(5.0)
    with contextlib.suppress(BusError):
        bus.exchange([0, 0])  # a fault that lay ready for the next frame may still strike
    usable = [bus.exchange([frame, 0])[1] for frame in values] == list(values.values())
    return {
        "requests": requests,
        "outcome": dict(outcome),
        "faults": happened,
        "longest_s": round(longest, 2),
        "usable": usable,
        "passed": usable and not outcome["WRONG"] and longest < LONGEST_S,
    }


# -- continuous scans --------------------------------------------------------------------------------------


STREAM_DELAY_S = 0.001
"""Mean delay of a delayed byte in streams; with longer ones the line would carry less than is sent."""
CYCLE = 1000
"""Packets or batches until a stream is closed and another begun."""
QUIET_BLOCKS = 10
"""Blocks without faults, after which the count of polled scans is judged."""
POLLED_SLACK = 4
"""Scans by which it may be off then: the board's answer takes some updates, and when in that time the
frames ran is not known."""


@dataclass(frozen=True)
class Way:
    """A way to get scans over the line."""

    capabilities: int
    registers: int
    scans: int
    part: float
    """Of the full rates of faults."""


WAYS = {
    "stream": (Way(7, 3, 4, 1.0), Way(7, 7, 16, 1.0), Way(7, 7, 16, 0.1)),
    "polled": (Way(2, 3, 4, 0.1), Way(2, 7, 16, 0.1), Way(0, 3, 4, 0.01), Way(0, 7, 16, 0.1)),
}
"""The first use data-ready; of the others the first two have its counter alone, the last none."""


class ScanRig(SerialRig):
    """The firmware with a chip whose words are numbers of its updates."""

    def __init__(self, seed: int, way: Way) -> None:
        super().__init__(seed)
        self.chip = NumberedChip(start_s=-0.5)
        self.pins = ChipPins(self.chip, self.clock)
        self.firmware = SimulatedFirmware(self.pins, capabilities=way.capabilities)
        self.port = FakePort(self.firmware)

    @property
    def work(self) -> int:
        """Packets of scans and requests so far."""
        return self.firmware.scan_packets + len(self.firmware.executed)


def run_scans(name: str, work: int, seed: int) -> dict[str, object]:
    """So many packets of scans or polled batches over a bad line."""
    outcome: Counter[str] = Counter()
    happened: Counter[str] = Counter()
    done, longest, most_off, sound, usable = 0, 0.0, 0, True, True
    for cycle in itertools.count():
        if done >= work:
            break
        way = WAYS[name][cycle % len(WAYS[name])]
        rig = ScanRig(seed, way)
        names = [row.name for row in OUTPUTS[1 : 1 + way.registers]]
        judge = Judge(names, 0 if name == "stream" else None)
        rates = {kind: rate * way.part for kind, rate in BYTES.items()}
        faults = Faults(seed=seed * 100_000 + cycle, delay_s=STREAM_DELAY_S, unplug=UNPLUG, **rates)
        # Numbers are no accelerations: the driver must not look at |a|.
        sensor, gone = Adis16354(rig.open(), check=False), False
        with contextlib.suppress(BusError), sensor.stream(names, block_scans=way.scans) as stream:
            judge.look(next(stream))
            rig.set(faults)
            while rig.work < CYCLE:
                begin = rig.clock.now_s()
                try:
                    judge.look(next(stream))
                except BusError as error:
                    outcome[type(error).__name__] += 1
                    gone = isinstance(error, CannotOpenError)
                    # A stream ends with its first error, as its callers do; polling may go on.
                    if gone or name == "stream":
                        raise
                longest = max(longest, rig.clock.now_s() - begin)
            rig.set(rig.quiet)
            for _ in range(QUIET_BLOCKS):
                judge.look(next(stream))
            most_off = max(most_off, abs(judge.off))
        rig.set(rig.quiet)
        if gone:
            rig.replug()
            sensor = Adis16354(rig.open(), check=False)
        usable &= sensor.read("ENDURANCE") == 0
        done += rig.work
        outcome.update(judge.found)
        happened.update(faults.seen)
        sound &= judge.sound
    passed = sound and usable and most_off <= POLLED_SLACK and longest < LONGEST_S
    return {
        "work": done,
        "outcome": dict(outcome),
        "faults": dict(happened),
        "most_off": most_off,
        "longest_s": round(longest, 2),
        "usable": usable,
        "passed": passed and outcome["scans"] > 0,
    }


def main() -> int:
    """Run the rigs and print what happened."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--requests", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default=",".join([*RIGS, *WAYS]))
    options = parser.parse_args()
    good = True
    for name in options.only.split(","):
        begin = time.perf_counter()
        if name in WAYS:
            result = run_scans(name, options.requests, options.seed)
        else:
            result = run(name, options.requests, options.seed)
        good &= bool(result["passed"])
        print(f"{name} ({time.perf_counter() - begin:.0f} s)")
        for key, value in result.items():
            print(f"    {key:10} {value}")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
