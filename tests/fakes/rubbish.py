"""Rubbish instead of answers, for every transport: bridges that work, and whose answers arrive spoiled.

Each `fuzz_…` function feeds a transport so many bytes and returns what came of it. It raises where the
transport fails with anything but a typed error, where a frame reaches the chip that nobody asked for, or
where a wrong word is accepted although the protocol has something that can show it. `spoil` makes answers
that are random, right ones with some bytes changed, cut or lengthened; `damage` one byte of the header or
the length, which a transport must notice.
"""

from __future__ import annotations

import ctypes
import errno
import random
import struct
from collections import Counter
from collections.abc import Callable

from adis_gonio.base.errors import BusError, ProtocolError
from adis_gonio.device.bus import (
    BusUrl,
    Capability,
    SpiBus,
    SpiTiming,
    cp2130,
    cp2130 as cp2130_requests,
    mcp2210,
    mcp2210 as mcp2210_reports,
    serial,
    spidev,
)
from adis_gonio.device.bus.wire import protocol as wire
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.cp2130_device import Cp2130Device
from fakes.cp2130_usb import FakeUsbBackend, UsbBoard
from fakes.mcp2210_device import CHIP_SETTINGS, SETTINGS, Mcp2210Device
from fakes.mcp2210_hid import FakeHid, HidBoard
from fakes.spidev_kernel import MESSAGE, RD_MODE32, TRANSFER, FakeSpidevKernel
from fakes.virtual_clock import VirtualClock

FAST = SpiTiming(1e6, 9.0, 40.0)
VALUES = {0x1A00 + 0x200 * k: 0x123 + 0x111 * k for k in range(6)}
"""Words by the frames that read them."""
LONGEST = 70
RIGHT = 0.6
"""Part of the answers that is left alone and not counted, so that rubbish meets every state."""
CYCLE = 40
"""Calls until a bus is closed and opened anew."""


class Rubbish:
    """Spoils answers, and counts their bytes."""

    def __init__(self, seed: int) -> None:
        self.dice = random.Random(seed)
        self.fed = 0
        self.on = True
        self.only_what_shows = False

    def answer(self, right: bytes, header: int) -> bytes:
        """What arrives instead of an answer."""
        if not self.on or self.dice.random() < RIGHT:
            return right
        spoilt = self.damage(right, header) if self.only_what_shows else self.spoil(right)
        self.fed += len(spoilt)
        return spoilt

    def spoil(self, right: bytes) -> bytes:
        """Random bytes, or a right answer that was cut, lengthened or changed."""
        dice = self.dice
        kind = dice.randrange(8)
        if kind == 0 or len(right) < kind:  # a short answer has little to change
            return dice.randbytes(dice.randrange(LONGEST))
        if kind == 1:
            return dice.randbytes(len(right))
        if kind == 2:
            return right[: dice.randrange(len(right) + 1)]
        if kind == 3:
            return right + dice.randbytes(dice.randrange(1, LONGEST))
        spoilt = bytearray(right)
        for _ in range(dice.randrange(1, 5)):
            if spoilt:
                spoilt[dice.randrange(min(len(spoilt), dice.choice((4, 16, 64))))] = dice.randrange(256)
        return bytes(spoilt)

    def damage(self, right: bytes, header: int) -> bytes:
        """One byte of the header changed, or the length."""
        dice = self.dice
        kind = dice.randrange(4 if header else 2)
        if kind == 0:
            return right[: dice.randrange(len(right))]
        if kind == 1:
            return right + dice.randbytes(dice.randrange(1, LONGEST))
        at = dice.randrange(header)
        change = dice.choice((1 << dice.randrange(8), dice.randrange(1, 256)))
        return right[:at] + bytes([right[at] ^ change]) + right[at + 1 :]


class ReadOnlyChip:
    """A chip of registers that do not change, which takes reads alone; quick, for there are millions."""

    time_s = 0.0

    def __init__(self) -> None:
        self._reply = 0

    def frame(
        self, word: int, *, start_s: float, clock_hz: float, bits: int = 16, cs_hold_s: float = 0.0
    ) -> int:
        assert not word & 0xC000, f"frame 0x{word:04X} reached the chip"
        assert bits == 16, f"a frame of {bits} bits reached the chip"
        reply, self._reply = self._reply, VALUES.get(word, 0)
        return reply

    def data_ready_edges(self, time_s: float) -> int:
        return int(time_s * 819.2)


class _Bench:
    """A chip on a bridge's pins, and rubbish between bridge and transport."""

    def __init__(self, seed: int, most: int = 5) -> None:
        self.clock = VirtualClock()
        self.most = most
        self.rubbish = Rubbish(seed)
        self.pins = ChipPins(ReadOnlyChip(), self.clock)
        self.found: Counter = Counter()

    def run(self, open_bus: Callable[[], SpiBus], count: int) -> Counter:
        """Use buses until so many bytes went in."""
        dice = self.rubbish.dice
        while self.rubbish.fed < count:
            self.rubbish.only_what_shows = dice.random() < 0.4
            try:
                self.rubbish.on = dice.random() < 0.3  # seldom an opening survives rubbish
                bus = open_bus()
            except BusError as error:
                self.found[f"opening: {type(error).__name__}"] += 1
                continue
            self.rubbish.on = True
            with bus:
                for _ in range(CYCLE):
                    self._use(bus)
                self.rubbish.on = False
            self.rubbish.on = True
        return self.found

    def _use(self, bus: SpiBus) -> None:
        dice = self.rubbish.dice
        try:
            kind = dice.randrange(10)
            if kind == 0:
                bus.configure(FAST)
            elif kind == 1 and Capability.EVENT_COUNTER in bus.capabilities:
                assert 0 <= bus.read_event_counter() < 1 << 32
            else:
                ask = [dice.choice(list(VALUES)) for _ in range(dice.randrange(1, self.most))]
                replies = bus.exchange([*ask, 0])
                wrong = [k for k, word in zip(ask, replies[1:], strict=True) if word != VALUES[k]]
                self.found["answered"] += 1
                if self.rubbish.only_what_shows:
                    assert not wrong, "a wrong word was accepted"
                self.found["unseen"] += bool(wrong)
        except BusError as error:
            self.found[type(error).__name__] += 1


def fuzz_mcp2210(count: int, seed: int) -> Counter:
    """Reports: the four bytes at their head and their length show damage, the data have no check."""
    bench = _Bench(seed)
    device = Mcp2210Device(bench.pins)
    report = device.report
    device.report = lambda request: bench.rubbish.answer(report(request), header=4)
    hid = FakeHid(HidBoard(device))
    url = BusUrl.parse("mcp2210:?event_counter=1")
    found = bench.run(lambda: mcp2210.open_from_url(url, hid=hid, clock=bench.clock), count)
    assert not device.nvram_writes
    assert not any(device.eeprom)
    return found


def fuzz_cp2130(count: int, seed: int) -> Counter:
    """Bulk replies and control answers: the length shows damage, there is no header."""
    bench = _Bench(seed)
    device = Cp2130Device(bench.pins)
    control, bulk = device.control_in, device.bulk_in
    device.control_in = lambda request, value, index, length: bench.rubbish.answer(
        control(request, value, index, length), header=0
    )[:length]

    def bulk_in() -> bytes | None:
        packet = bulk()
        return None if packet is None else bench.rubbish.answer(packet, header=0)

    device.bulk_in = bulk_in
    backend = FakeUsbBackend(UsbBoard(device))
    url = BusUrl.parse("cp2130:")
    found = bench.run(lambda: cp2130.open_from_url(url, backend=backend, clock=bench.clock), count)
    assert not device.otp_requests
    return found


class _SpoiltKernel(FakeSpidevKernel):
    """Results of ioctl that are not those of the call, and buffers that were not filled as they should."""

    rubbish: Rubbish

    def ioctl(self, fd: int, request: int, argument: object) -> int:
        result = super().ioctl(fd, request, argument)
        rubbish, dice = self.rubbish, self.rubbish.dice
        if not rubbish.on:
            return result
        if request == RD_MODE32:
            rubbish.fed += 4
            if dice.random() < 0.3:
                ctypes.memmove(ctypes.addressof(argument), dice.randbytes(4), 4)
        elif request & ~0x3FFF0000 == MESSAGE:
            transfers = list(TRANSFER.iter_unpack(bytes(argument)))
            if not rubbish.only_what_shows and dice.random() > 0.1:
                rubbish.fed += sum(length for _, _, length, *_ in transfers)
                for _, place, length, *_ in transfers:
                    ctypes.memmove(place, dice.randbytes(length), length)
            if dice.random() < 0.2:
                other = dice.choice((-1, 0, 1, result - 1, result + 1, dice.randrange(1 << 31)))
                return other if other != result else -2
        if dice.random() < 0.05:
            code = dice.choice(list(errno.errorcode))
            raise OSError(code, "rubbish")
        return result


def fuzz_spidev(count: int, seed: int) -> Counter:
    """Results, error numbers and received buffers of ioctl: the number of bytes shows damage."""
    bench = _Bench(seed, most=400)
    kernel = _SpoiltKernel({"/dev/spidev0.0": bench.pins})
    kernel.rubbish = bench.rubbish
    url = BusUrl.parse("spidev:/dev/spidev0.0")
    return bench.run(lambda: spidev.open_from_url(url, system=kernel, clock=bench.clock), count)


class QuickPort:
    """A port without times: what the firmware sends is there at once."""

    def __init__(self, firmware: SimulatedFirmware) -> None:
        self._firmware = firmware
        self._clock = firmware.pins.clock
        firmware.out.clear()

    def send(self, data: bytes, /) -> None:
        self._firmware.feed(data)

    def receive(self, wait_s: float, /) -> bytes:
        data = b"".join(packet for _, packet in self._firmware.out)
        self._firmware.out.clear()
        if not data:
            self._clock.sleep_s(wait_s)
        return data

    def close(self) -> None:
        pass


def fuzz_link(count: int, seed: int) -> Counter:
    """The firmware's packets: rubbish with a right CRC, which nothing else guards, and broken ones."""
    bench = _Bench(seed)
    rubbish = bench.rubbish
    firmware = SimulatedFirmware(bench.pins)
    send, put = firmware.send, firmware._put

    def send_rubbish(kind: int, number: int, body: bytes, ready_s: float | None = None) -> None:
        if rubbish.on and not rubbish.only_what_shows and rubbish.dice.random() < 0.5:
            kind, number = rubbish.dice.choice(((kind, number), (rubbish.dice.randrange(256), number)))
            body = rubbish.spoil(body)
            rubbish.fed += len(body)
        send(kind, number, body, ready_s)

    def put_broken(packet: bytes, ready_s: float | None = None) -> None:
        if rubbish.only_what_shows and len(packet) > 2:
            packet = rubbish.answer(packet[:-1], header=len(packet) - 1) + b"\0"
        put(packet, ready_s)

    firmware.send, firmware._put = send_rubbish, put_broken
    url = BusUrl.parse("serial:fake")
    return bench.run(lambda: serial.open_from_url(url, port=QuickPort(firmware), clock=bench.clock), count)


REPLIES = (
    wire.HelloReply,
    wire.ConfigureReply,
    wire.ExchangeReply,
    wire.StreamReply,
    wire.StopReply,
    wire.ResetReply,
    wire.StatisticsReply,
)
PARSERS: dict[str, Callable[[bytes], object]] = {
    "MCP2210 chip settings": lambda data: mcp2210_reports.unpack(
        data, mcp2210_reports.Command.GET_CHIP, CHIP_SETTINGS
    ),
    "MCP2210 SPI settings": lambda data: mcp2210_reports.unpack(
        data, mcp2210_reports.Command.GET_SPI, SETTINGS
    ),
    "MCP2210 transfer": mcp2210_reports.progress,
    "MCP2210 mark": lambda data: mcp2210_reports.is_mark(data, 7),
    "CP2130 chip selects": lambda data: cp2130_requests.unpack(data, struct.Struct(">HH"), "chip selects"),
    **{f"wire {body.__name__}": body.unpack for body in (*REPLIES, wire.Scans, wire.Error)},
}
HEADS = (0x11, 0x12, 0x20, 0x31, 0x41, 0x42, 0x50)


def fuzz_parser(name: str, count: int, seed: int) -> Counter:
    """Bytes straight into one parser, with lengths and heads that let some of them through."""
    parse, dice = PARSERS[name], random.Random(seed)
    found: Counter = Counter()
    fed = 0
    while fed < count:
        data = bytearray(dice.randbytes(dice.choice((64, 64, 64, 11, 4, 3, 2, dice.randrange(LONGEST)))))
        if len(data) == 64 and dice.random() < 0.9:
            data[0], data[1] = dice.choice(HEADS), dice.choice((0, 0, 0xF7, 0xF8, data[1]))
            data[2:4] = bytes((dice.randrange(4), dice.choice((0x10, 0x20, 0x30, data[3]))))
            if dice.random() < 0.5:
                data[4:13] = bytes(value % 3 for value in data[4:13])
        fed += len(data)
        try:
            parse(bytes(data))
            found["taken"] += 1
        except ProtocolError:
            found["ProtocolError"] += 1
    return found


FUZZERS = {
    "mcp2210": fuzz_mcp2210,
    "cp2130": fuzz_cp2130,
    "spidev": fuzz_spidev,
    "serial": fuzz_link,
}
