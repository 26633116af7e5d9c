"""Figures of the wire, as ratios taken in one run.

    python scripts/wire_figures.py [--seconds 20]

* bytes on the serial line for each scan of seven registers, against its 14 bytes of payload (<= 1.15);
* host CPU for each second of a full-rate stream of seven registers, from a tty to units (<= 3 % of a core);
* words a second of the vectorised decoder against a loop with struct (>= 100 times).

The stream is recorded from a fake firmware at 819.2 scans a second and played into a pty by a process of
its own, at its own pace, so that only the host's side is measured.
"""

from __future__ import annotations

import argparse
import os
import pickle
import struct
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.device.bus import BusUrl, SpiTiming
from adis_gonio.device.bus.serial import ClockMap, SerialBus, SerialStream, open_from_url, open_port
from adis_gonio.device.bus.wire import load_cobs
from adis_gonio.device.bus.wire.protocol import CRC_SIZE, HEADER_SIZE, Scans
from adis_gonio.device.sensor.registers import registers
from adis_gonio.device.sensor.scanning import ScanLayout, StreamedScans
from adis_gonio.device.sensor.settings import decode_numbers
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins
from fakes.serial_port import FakePort
from fakes.virtual_clock import VirtualClock

NAMES = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "XTEMP_OUT")
TABLE = registers(NAMES)
FRAMES = [row.address << 8 for row in TABLE]
RATE_HZ = 819.2
AROUND = HEADER_SIZE + Scans.LAYOUT.size + CRC_SIZE + 2
"""Bytes of a packet beside its words: header, fields, CRC, COBS, delimiter."""

PLAYER = """
import os, pickle, sys, time
fd, packets = int(sys.argv[1]), pickle.load(open(sys.argv[2], "rb"))
begin = time.monotonic() + 0.5
for at, data in packets:
    left = begin + at - time.monotonic()
    if left > 0:
        time.sleep(left)
    os.write(fd, data)
time.sleep(1.0)
"""


def record(seconds: float) -> tuple[list[tuple[float, bytes]], int]:
    """Packets of a stream with their times, and the number of scans in them."""
    clock = VirtualClock()
    chip = SimulatedChip(World(seed=1), start_s=-0.5)
    firmware = SimulatedFirmware(ChipPins(chip, clock))
    port = FakePort(firmware)
    packets: list[tuple[float, bytes]] = []
    put = firmware._put

    def note(data: bytes, ready_s: float | None = None) -> None:
        put(data, ready_s)
        packets.append((firmware.out[-1][0], data))

    with open_from_url(BusUrl.parse("serial:fake"), port=port, clock=clock) as bus:
        bus.configure(SpiTiming(1e6, 9.0, 40.0))
        bus.exchange([0xB404])
        begin_s = clock.now_s()
        with bus.stream(FRAMES, block_scans=82) as stream:
            firmware._put = note
            scans = 0
            while clock.now_s() - begin_s < seconds:
                block = next(stream)
                scans += len(block.time_s)
                assert not block.lost
    scans = sum((len(data) - AROUND) // 14 for _, data in packets)
    return [(at - begin_s, data) for at, data in packets], scans


def bytes_per_scan(packets: list[tuple[float, bytes]]) -> float:
    """Bytes on the line for each scan, against the 14 bytes of seven words."""
    # A byte more where COBS needs a second run; there are no such.
    full = [data for _, data in packets if len(data) > 100]
    scans = sum((len(data) - AROUND) // 14 for data in full)
    return sum(map(len, full)) / scans / 14


def host_cpu(packets: list[tuple[float, bytes]]) -> tuple[float, int, int]:
    """CPU seconds a second, scans and losses of a stream read from a tty by the whole chain."""
    master, slave = os.openpty()
    tty.setraw(slave)
    with tempfile.NamedTemporaryFile(suffix=".pickle") as file:
        pickle.dump(packets, file)
        file.flush()
        player = subprocess.Popen(
            [sys.executable, "-c", PLAYER, str(master), file.name], pass_fds=(master,)
        )
        bus = _listener(os.ttyname(slave))
        bus.byte_s = 20e-6
        stream_id = int.from_bytes(_unstuffed(packets[0][1])[1:3], "little")
        stream = SerialStream(bus, stream_id, len(FRAMES), 16, 82, ClockMap(0, time.monotonic()))
        scans = StreamedScans(stream, ScanLayout(TABLE, "adis16354", 300, 1 / RATE_HZ))
        lost = 0
        total = sum((len(data) - AROUND) // 14 for _, data in packets)
        first = next(scans)
        seen = len(first)
        cpu, wall = time.process_time(), time.monotonic()
        while seen < total - 100:
            block = next(scans)
            block.values()
            seen += len(block)
            lost += block.lost
        used, passed = time.process_time() - cpu, time.monotonic() - wall
        player.kill()
        player.wait()
    os.close(master)
    os.close(slave)
    return used / passed, seen, lost


def _unstuffed(data: bytes) -> bytes:
    return load_cobs().decode(data.rstrip(b"\0"))


class _Listener(SerialBus):
    """The serial bus's reading side; nobody answers on this tty."""

    def count_edges(self) -> int:
        """A figure that grows."""
        return time.monotonic_ns() & 0xFFFF_FFFF


def _listener(path: str) -> SerialBus:
    from adis_gonio.device.bus.contract import SpiBus
    from adis_gonio.device.bus.host import SAFE_TIMING, WALL
    from adis_gonio.device.bus.serial import SerialLink

    bus = _Listener.__new__(_Listener)
    SpiBus.__init__(bus, SAFE_TIMING)
    bus.url = f"serial:{path}"
    bus._clock = WALL
    bus._link = SerialLink(open_port(path, 500_000, bus.url), url=bus.url, clock=WALL)
    return bus


def decoder_ratio(words: int = 70_000) -> tuple[float, float]:
    """Words a second of the vectorised decoder, and its ratio to a loop over the same bytes."""
    rng = np.random.default_rng(1)
    data = rng.integers(0, 1 << 16, (words // 7, 7), dtype=np.uint16)
    raw = data.astype("<u2").tobytes()

    def vectorised() -> object:
        return decode_numbers(TABLE, np.frombuffer(raw, "<u2").reshape(-1, 7))

    def loop() -> list[int]:
        numbers = []
        bits = [row.bits for row in TABLE]
        for at in range(0, len(raw), 14):
            for word, size in zip(struct.unpack_from("<7H", raw, at), bits, strict=True):
                number = word & ((1 << size) - 1)
                if number >> (size - 1):
                    number -= 1 << size
                numbers.append(number)
        return numbers

    assert np.array_equal(np.asarray(vectorised()).ravel(), loop())
    fast, slow = [], []
    for _ in range(25):  # taken in turns, so that a busy machine slows both
        for times, work in (*[(fast, vectorised)] * 20, (slow, loop)):
            begin = time.perf_counter()
            work()
            times.append(time.perf_counter() - begin)
    return words / min(fast), min(slow) / min(fast)


def main() -> int:
    """Print the figures with their targets; exit 1 where one is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    seconds = parser.parse_args().seconds
    packets, _ = record(seconds)
    overhead = bytes_per_scan(packets)
    cpu, scans, lost = host_cpu(packets)
    speed, ratio = decoder_ratio()
    rows = (
        ("bytes on the wire a scan / 14 bytes of payload", f"{overhead:.3f}", "<= 1.15", overhead <= 1.15),
        ("host CPU / second of full-rate stream", f"{cpu * 100:.2f} %", "<= 3 %", cpu <= 0.03),
        (f"    scans lost of {scans}", f"{lost}", "0", lost == 0),
        (f"decoder ({speed / 1e6:.0f} M words/s) / struct loop", f"{ratio:.0f}", ">= 100", ratio >= 100),
    )
    for what, value, target, good in rows:
        print(f"{what:50} {value:>10}  {target:>8}  {'ok' if good else 'MISSED'}")
    return 0 if all(good for *_, good in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
