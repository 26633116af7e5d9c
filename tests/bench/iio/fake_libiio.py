"""A stand-in for pylibiio (module `iio`) with an accelerometer of this machine.

Names and behaviour are those of pylibiio 0.25: errors are OSError with an errno, numbers are texts, and
`Channel.read` gives the samples of a block in the format of the host.
"""

import errno
import os
import threading
import time
from types import SimpleNamespace

import numpy as np

NAME = "adxl345"
SCALE = 0.0383  # m/s² per LSB
OFFSET = 3
RAW = {"accel_x": 5, "accel_y": -7, "accel_z": -260, "temp": 230}
FORMATS = {**dict.fromkeys(RAW, (16, 13)), "timestamp": (64, 64)}  # storage, bits


class Attribute:
    def __init__(self, text):
        self.text = text

    @property
    def value(self):
        return self.text


class FakeChannel:
    output = False
    name = None
    enabled = False

    def __init__(self, device, id, buffered):
        self.device, self.id, self.scan_element = device, id, buffered
        length, bits = FORMATS[id]
        self.data_format = SimpleNamespace(length=length, bits=bits, shift=0, is_signed=True, repeat=1)
        self.attrs = {}
        if id in RAW:
            scale, offset = ("100", "20") if id == "temp" else (f"{SCALE}", f"{OFFSET}")
            self.attrs = {name: Attribute(text) for name, text in (("scale", scale), ("offset", offset))}
            self.attrs["raw"] = Attribute(f"{RAW[id]}")
        if id.startswith("accel"):
            self.attrs["sampling_frequency"] = Attribute(f"{device.rate_hz}")

    def read(self, buffer):
        assert self.enabled
        if self.id == "timestamp":
            numbers = 10**18 + np.array(buffer.numbers) * round(1e9 / self.device.rate_hz)
        else:
            noise = np.random.default_rng(1).normal(0, 1.5, len(buffer.numbers)).round()
            numbers = RAW[self.id] + noise * self.id.startswith("accel")
        return bytearray(np.asarray(numbers, f"i{self.data_format.length // 8}").tobytes())


class FakeDevice:
    """Faults to set: `busy` (errno at opening), `silent`, `gone` (errno of a read), `lost` scan numbers.

    `late_s` delays the next block, as a busy host does.
    """

    id, name, label = "iio:device0", NAME, None

    def __init__(self, buffered=True, rate_hz=100.0):
        self.rate_hz, self.attrs = rate_hz, {}
        self.timeout_ms, self.buffers = None, 0
        self.busy = self.gone = 0
        self.late_s = 0.0
        self.silent, self.lost = threading.Event(), ()
        names = (*RAW, "timestamp") if buffered else tuple(RAW)
        self.channels = [FakeChannel(self, name, buffered) for name in names]
        self.ctx = self

    def set_timeout(self, milliseconds):
        self.timeout_ms = milliseconds

    def channel(self, name):
        return next(channel for channel in self.channels if channel.id == name)


class FakeBuffer:
    def __init__(self, device, samples):
        if device.busy:
            raise OSError(device.busy, os.strerror(device.busy))
        self.device, self.samples, self.count, self.numbers = device, samples, 0, []
        self.begin_s = time.monotonic()
        device.buffers += 1

    def __del__(self):
        if hasattr(self, "begin_s"):
            self.device.buffers -= 1

    def refill(self):
        if self.device.silent.is_set():
            time.sleep(self.device.timeout_ms / 1000)
            raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        if self.device.gone:
            raise OSError(self.device.gone, os.strerror(self.device.gone))
        self.numbers = []
        while len(self.numbers) < self.samples:
            self.count += 1
            if self.count not in self.device.lost:
                self.numbers.append(self.count)
        due_s = self.begin_s + self.count / self.device.rate_hz
        time.sleep(max(0.0, due_s - time.monotonic()) + self.device.late_s)
        self.device.late_s = 0.0


class FakeLibiio:
    """The module: `Context` knows the local devices, `Buffer` reads them."""

    Buffer = FakeBuffer

    def __init__(self, *devices):
        self.devices = list(devices)

    def Context(self, uri):  # noqa: N802 (pylibiio's name)
        assert uri == "local:"
        return SimpleNamespace(devices=self.devices)
