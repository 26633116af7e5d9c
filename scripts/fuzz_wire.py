"""Rubbish into every parser: the wire protocol's on both sides, and each bridge's of the host.

Ten million bytes each unless told otherwise:
* the C core under ASan and UBSan: random bytes, sound packets of random content, damaged requests;
* the Python receiver of the wire protocol: random bytes with many delimiters;
* the transports mcp2210, cp2130, spidev and serial over fakes whose answers arrive as rubbish: random,
  mutated, cut or lengthened (tests/fakes/rubbish.py);
* each function that takes an answer apart, by itself.
Exit 1 where something but a typed error came out, where a frame with the write bit or bit 14 reached the
chip's pins that nobody asked for, or where a wrong word was accepted that the protocol's checks can see.

    python scripts/fuzz_wire.py --bytes 10000000 --seed 1 [--only core,receiver,mcp2210,…,parsers]
"""

from __future__ import annotations

import argparse
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.device.bus.wire import Receiver
from fakes.rubbish import FUZZERS, PARSERS, fuzz_parser

HOST = Path(__file__).parents[1] / "firmware_proto" / "host"
CHUNK = 4096


def fuzz_core(count: int, seed: int) -> bool:
    """The C core: random bytes, sound packets of random content, damaged requests."""
    with tempfile.TemporaryDirectory() as folder:
        program = f"{folder}/fuzz"
        subprocess.run(["make", "-s", "-C", HOST, f"BUILD={folder}", program], check=True)
        done = subprocess.run([program, str(count), str(seed)], check=False)
    return done.returncode == 0


def fuzz_receiver(count: int, seed: int) -> bool:
    """The Python receiver: random bytes with many delimiters."""
    dice = random.Random(seed)
    receiver, begin = Receiver(), time.perf_counter()
    for _ in range(-(-count // CHUNK)):
        receiver.feed(dice.randbytes(CHUNK // 2) + dice.randbytes(CHUNK // 2).replace(b"\x01", b"\0"))
    print(f"Python: {count} bytes in {time.perf_counter() - begin:.1f} s, discarded: {dict(receiver.bad)}")
    return receiver.bad.total() > 0


def fuzz_transport(name: str, count: int, seed: int) -> bool:
    """A transport whose bridge's answers are spoiled."""
    begin = time.perf_counter()
    found = FUZZERS[name](count, seed)
    print(f"{name}: {count} bytes in {time.perf_counter() - begin:.1f} s, {dict(found)}", flush=True)
    return found["answered"] > 0  # a transport that answers nothing proves nothing


def fuzz_parsers(count: int, seed: int) -> bool:
    """Every function that takes an answer apart."""
    sound = True
    for name in PARSERS:
        found = fuzz_parser(name, count, seed)
        print(f"{name}: {count} bytes, {dict(found)}", flush=True)
        sound &= found["taken"] > 0
    return sound


def main() -> int:
    """Run them; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bytes", type=int, default=10_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parts: dict[str, Callable[[int, int], bool]] = {"core": fuzz_core, "receiver": fuzz_receiver}
    for name in FUZZERS:
        parts[name] = partial(fuzz_transport, name)
    parts["parsers"] = fuzz_parsers
    parser.add_argument("--only", default=",".join(parts))
    options = parser.parse_args()
    sound = [parts[name](options.bytes, options.seed) for name in options.only.split(",")]
    return 0 if all(sound) else 1


if __name__ == "__main__":
    sys.exit(main())
