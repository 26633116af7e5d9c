"""A tree like /sys/bus/iio/devices and /dev with an accelerometer, by the kernel's IIO ABI.

The node in /dev is a FIFO: `feed` writes scans into it as a driver would, laid out by what is enabled.
"""

import os
import threading
import time
from pathlib import Path

import numpy as np

NAME = "adxl345"
SCALE = 0.0383  # m/s² per LSB
OFFSET = 3


class SysfsTree:
    """Three axes of 13 bits, left by 3 bits in big-endian words, a temperature, a time."""

    def __init__(self, root: Path, *, buffered: bool = True, rate_hz: float = 100.0) -> None:
        self.root, self.rate_hz = root, rate_hz
        self.device = root / "sys/bus/iio/devices/iio:device0"
        self.node = root / "dev/iio:device0"
        self.device.mkdir(parents=True)
        self.node.parent.mkdir()
        self.write("name", NAME)
        self.write("in_accel_scale", f"{SCALE:.6f}")
        self.write("in_accel_offset", f"{OFFSET}")
        self.write("in_accel_sampling_frequency", f"{rate_hz}")
        for axis, raw in zip("xyz", (5, -7, -260), strict=True):
            self.write(f"in_accel_{axis}_raw", f"{raw}")
        self.write("in_temp_raw", "230")
        self.write("in_temp_scale", "100")
        self.write("in_temp_offset", "20")
        self._stop = threading.Event()
        self._thread = None
        self.lose_after = None
        if buffered:
            os.mkfifo(self.node)
            for index, axis in enumerate("xyz"):
                self.scan_element(f"accel_{axis}", index, "be:s13/16>>3")
            self.scan_element("temp", 3, "le:s12/16>>0")
            self.scan_element("timestamp", 4, "le:s64/64>>0")
            self.write("buffer/enable", "0")
            self.write("buffer/length", "2")

    def write(self, name: str, text: str) -> None:
        path = self.device / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"{text}\n")

    def read(self, name: str) -> str:
        return (self.device / name).read_text().strip()

    def scan_element(self, name: str, index: int, form: str) -> None:
        for what, text in (("en", "0"), ("index", f"{index}"), ("type", form)):
            self.write(f"scan_elements/in_{name}_{what}", text)

    def state(self) -> dict[str, str]:
        return {
            str(p.relative_to(self.device)): p.read_text().strip() for p in self.device.rglob("*_en")
        } | {name: self.read(name) for name in ("buffer/enable", "buffer/length")}

    # -- the driver's side ------------------------------------------------------------------------

    def start(self) -> None:
        self._thread = threading.Thread(target=self._feed, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(30)

    def _enabled(self, name: str) -> bool:
        return self.read(f"scan_elements/in_{name}_en") == "1"

    def _feed(self) -> None:
        noise, count = np.random.default_rng(1), 0
        while not self._stop.wait(0.01):
            if self.read("buffer/enable") != "1":
                continue
            try:
                node = os.open(self.node, os.O_WRONLY | os.O_NONBLOCK)
            except OSError:
                continue  # nobody reads yet
            begin = time.monotonic()
            try:
                while not self._stop.is_set() and self.read("buffer/enable") == "1":
                    count += 1
                    due = begin + count / self.rate_hz
                    time.sleep(max(0, due - time.monotonic()))
                    if self.lose_after is not None and self.lose_after <= count < self.lose_after + 3:
                        continue
                    os.write(node, self._scan(count, noise))
            except BlockingIOError:
                pass
            except BrokenPipeError:
                pass
            finally:
                os.close(node)

    def _scan(self, count: int, noise: np.random.Generator) -> bytes:
        out = b""
        for axis, raw in zip("xyz", (5, -7, -260), strict=True):
            if self._enabled(f"accel_{axis}"):
                value = raw + round(noise.normal(0, 1.5))
                out += ((value << 3) & 0xFFFF | 5).to_bytes(2, "big")  # rubbish in the bits below
        if self._enabled("temp"):
            out += (230).to_bytes(2, "little")
        if self._enabled("timestamp"):
            out += b"\xee" * (-len(out) % 8) + round(1e18 + count * 1e9 / self.rate_hz).to_bytes(
                8, "little"
            )
        return out
