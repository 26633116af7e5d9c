"""The real firmware binary behind a socket: what QEMU's USB serial adapter is wired to.

Runs on the host, because the guest computes many times slower. Simulated time never runs ahead of the
wall's; where the host is slow or the line idle it falls behind, which a serial line allows.

Arguments: the firmware's ELF, the path of the socket to listen on. It ends when QEMU goes.
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import time
from pathlib import Path

from adis_gonio.sim import World
from firmware.rig import Rig

SLICE_S = 0.001
MOST_BEHIND_S = 0.05
"""A longer pause than this is not made up for: the host stood still."""
IDLE_S = 2.0
"""After so long without a byte either way the firmware's time stands still: emulating it costs a core."""


def serve(rig: Rig, line: socket.socket) -> None:
    """Carry bytes both ways until the other end closes."""
    zero_s = time.monotonic() - rig.now_s()
    last_s = time.monotonic()
    while True:
        idle = time.monotonic() - last_s > IDLE_S
        if select.select([line], [], [], None if idle else 0)[0]:
            data = line.recv(4096)
            if not data:
                return
            rig.port.send(data)
            last_s = time.monotonic()
        rig.sleep_s(SLICE_S)
        answer = rig.port.receive(0.0)
        if answer:
            line.sendall(answer)
            last_s = time.monotonic()
        ahead_s = rig.now_s() - (time.monotonic() - zero_s)
        if ahead_s > 0:
            time.sleep(ahead_s)
        elif ahead_s < -MOST_BEHIND_S:
            zero_s = time.monotonic() - rig.now_s()


def main(elf: str, place: str) -> None:
    """Listen before the firmware starts, so that QEMU finds the socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as server:
        server.bind(place)
        server.listen(1)
        sys.stdout.write("listening\n")
        sys.stdout.flush()
        rig = Rig(Path(elf), World(seed=1))
        line, _ = server.accept()
        with line, contextlib.suppress(ConnectionError):  # QEMU may end while an answer is on its way
            serve(rig, line)
    rig.check()
    sys.stdout.write(f"firmware: {rig.log.frames} frames on the pins, tightest {rig.log.least}\n")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
