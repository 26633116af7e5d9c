#!/usr/bin/env python3
"""Send noise to the IIO server of a simulated sensor: nothing may stop, and nothing may be written.

Half of the bytes are random, half are words of the protocol in random order, with wrong lengths and cut
lines. Clients come and go; a well-behaved one asks all the time. The server is read-only. Counted are write
frames that reach the chip: the stream's own to the low byte of MSC_CTRL (data-ready) are known, any other
one fails the run.

    python scripts/fuzz_iiod.py --bytes 10000000 --seed 1
"""

from __future__ import annotations

import argparse
import random
import socket
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.serve import IioServer
from adis_gonio.sim import World
from fakes.counting_bus import CountingBus

VERBS = ("VERSION", "PRINT", "HELP", "TIMEOUT", "OPEN", "CLOSE", "READ", "WRITE", "READBUF", "WRITEBUF")
MORE_VERBS = ("GETTRIG", "SETTRIG", "SET", "BUFFERS_COUNT", "CYCLIC", "INPUT", "OUTPUT", "DEBUG", "BUFFER")
PLACES = (
    "iio:device0",
    "adis16354",
    "iio:device1",
    "accel_x",
    "anglvel_z",
    "temp_x",
    "voltage0",
    "timestamp",
)
NAMES = ("raw", "scale", "calibbias", "sampling_frequency", "filter_low_pass_3db_frequency")
NUMBERS = (
    "000001ff",
    "00000001",
    "ffffffff",
    "0",
    "1",
    "2",
    "4",
    "16",
    "24",
    "100",
    "4096",
    "9" * 20,
    "-1",
)
WORDS = (*VERBS, *MORE_VERBS, *PLACES, *NAMES, *NUMBERS, "-1", "x", "\0", "\x7f")
CHUNK = 4096


def main() -> int:
    """Run; exit status 1 where something was written, stopped or raised."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bytes", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    bus = CountingBus(World(seed=options.seed))
    begin_s = time.monotonic()
    with Adis16354(bus) as sensor:
        registers = {name: value for name, value in sensor.read_all().items() if "_OUT" not in name}
        sent, connections, answers, failures = fuzz(sensor, options.bytes, options.seed)
        after = {name: value for name, value in sensor.read_all().items() if "_OUT" not in name}
    changed = [name for name in registers if registers[name] != after[name]]
    print(
        f"{sent} bytes in {connections} connections, {answers} answers to the well-behaved client,"
        f" {len(bus.asked_for)} forbidden write frames, registers changed: {changed or 'none'},"
        f" failures: {failures or 'none'}, {time.monotonic() - begin_s:.0f} s"
    )
    return 1 if bus.asked_for or changed or failures else 0


def fuzz(sensor: Adis16354, size: int, seed: int) -> tuple[int, int, int, list[str]]:
    """Bytes sent, connections made, answers that a well-behaved client had, what failed."""
    failures: list[str] = []
    ports: list[int] = []
    ready = threading.Event()

    def taken(host: str, port: int) -> None:
        ports.append(port)
        ready.set()

    server = IioServer(sensor, port=0, ready=taken)

    def run() -> None:
        try:
            server.run()
        except BaseException as error:
            failures.append(f"server: {error!r}")

    thread = threading.Thread(target=run)
    thread.start()
    ready.wait(60)
    sent = connections = answers = 0
    dice = random.Random(seed)
    with socket.create_connection(("127.0.0.1", ports[0]), timeout=60) as good:
        lines = good.makefile("rb")
        while sent < size and not failures:
            connections += 1
            sent += one_client(ports[0], dice, min(dice.randrange(1, 100_000), size - sent))
            good.sendall(b"TIMEOUT 1000\r\n")
            if lines.readline() != b"0\n":
                failures.append("the well-behaved client had no answer")
            answers += 1
    server.stop()
    thread.join(60)
    if thread.is_alive():
        failures.append("the server does not end")
    return sent, connections, answers, failures


def one_client(port: int, dice: random.Random, size: int) -> int:
    """Send about `size` bytes of one kind of noise, while answers are thrown away; return what was sent."""
    sent = 0
    make = pure if dice.random() < 0.5 else spoken
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.setblocking(False)
        rest = b""
        while sent < size:
            rest = rest or make(dice)
            try:
                count = client.send(rest)
                sent, rest = sent + count, rest[count:]
            except BlockingIOError:
                time.sleep(0.001)
                if dice.random() < 0.02:
                    break  # it waits for scans, or for room
            except OSError:
                break  # the server has ended what it could not understand
            try:
                while client.recv(1 << 16):
                    pass
            except OSError:
                pass
    return sent


def pure(dice: random.Random) -> bytes:
    """Random bytes."""
    return dice.randbytes(dice.randrange(1, CHUNK))


def spoken(dice: random.Random) -> bytes:
    """Lines of the protocol's words, some with rubbish between them."""
    lines = []
    for _ in range(dice.randrange(1, 60)):
        words = dice.choices(WORDS, k=dice.randrange(1, 7))
        lines.append(" ".join(words).encode() + dice.choice([b"\n", b"\r\n", b"\n", b"", b"\0\n"]))
        if dice.random() < 0.1:
            lines.append(dice.randbytes(dice.randrange(1, 40)))
    return b"".join(lines)


if __name__ == "__main__":
    sys.exit(main())
