"""An accelerometer by HID's sensor usages, through /dev/uhid: the kernel makes an IIO device of it.

Debian's kernel has no `iio_dummy`, but hid-sensor-hub and hid-sensor-accel-3d. What is written here to
/dev/uhid comes out of the kernel's IIO core as of any accelerometer: attributes, triggered buffer, device
node. Usages: HID Sensor Usages (HUTRR39); events: the kernel's linux/uhid.h.
"""

from __future__ import annotations

import os
import select
import struct
import threading
import time
from collections.abc import Collection
from pathlib import Path
from typing import Self

UHID = Path("/dev/uhid")
NAME = "accel_3d"
"""As the kernel's driver calls every accelerometer."""
MG_PER_LSB = 0.1
INTERVAL_MS = 20

DESTROY, OPEN, CLOSE, GET_REPORT, GET_REPLY, CREATE, INPUT, SET_REPORT, SET_REPLY = (
    *(1, 4, 5, 9, 10, 11, 12, 13, 14),
)
EVENT_SIZE = 4380
FEATURE_TYPE, INPUT_TYPE = 0, 2
REPORT_ID = 1
USB, VENDOR, PRODUCT = 3, 0x16C0, 0x05DF

FEATURE = struct.Struct("<BBBIH")
"""Report id, reporting state, power state, interval in ms, sensitivity."""
DATA = struct.Struct("<BiiiQ")
"""Report id, axes, time in µs."""
ALL_EVENTS, FULL_POWER = 2, 2
"""Places of the usages 0841 and 0851 in their lists, from 1."""

DESCRIPTOR = bytes.fromhex(
    "05 20 09 73 A1 00 85 01"  # sensor page, accelerometer 3D, physical collection, report 1
    # reporting state and power state: one of six usages each
    "0A 16 03 15 01 25 06 75 08 95 01 A1 02"
    "0A 40 08 0A 41 08 0A 42 08 0A 43 08 0A 44 08 0A 45 08 B1 00 C0"
    "0A 19 03 15 01 25 06 75 08 95 01 A1 02"
    "0A 50 08 0A 51 08 0A 52 08 0A 53 08 0A 54 08 0A 55 08 B1 00 C0"
    "0A 0E 03 15 00 27 FF FF FF 7F 75 20 95 01 55 00 B1 02"  # interval, ms
    "0A 52 14 15 00 26 FF 7F 75 10 95 01 55 0C B1 02"  # change of acceleration that is reported
    # axes in g by 10^-4, time in s by 10^-6
    "17 01 00 00 80 27 FF FF FF 7F 75 20 95 01 55 0C"
    "0A 53 04 81 02 0A 54 04 81 02 0A 55 04 81 02"
    "0A 29 05 15 00 26 FF 00 75 08 95 08 55 0A 81 02 C0"
)


class HidAccelerometer:
    """The device; a thread answers the kernel and, when it is asked for all events, reports.

    The n-th report says (n, -n, -10000 + n) and n intervals as its time, so that what a reader gets tells
    which reports it has seen. `without` are numbers of reports that get lost on their way.
    """

    def __init__(self, without: Collection[int] = ()) -> None:
        self._without = frozenset(without)
        self._feature = [1, 1, INTERVAL_MS, 0]
        self._count = 0
        self._due_s = 0.0
        self._stop = threading.Event()
        self._handle = os.open(UHID, os.O_RDWR)
        head = struct.pack("<I128s64s64s", CREATE, b"adis-gonio test sensor", b"", b"")
        ids = struct.pack("<HHIIII", len(DESCRIPTOR), USB, VENDOR, PRODUCT, 1, 0)
        os.write(self._handle, head + ids + DESCRIPTOR)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull it out; may be called twice."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join(60)
            os.write(self._handle, struct.pack("<I", DESTROY))
            os.close(self._handle)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def _run(self) -> None:
        while not self._stop.is_set():
            if select.select([self._handle], [], [], 0.005)[0]:
                self._answer(os.read(self._handle, EVENT_SIZE))
            reports = self._feature[0] == ALL_EVENTS and self._feature[1] == FULL_POWER
            if reports and time.monotonic() >= self._due_s:
                self._due_s = time.monotonic() + self._feature[2] / 1000
                self._count += 1
                if self._count not in self._without:
                    self._write(struct.pack("<IH", INPUT, DATA.size) + self._data())

    def _data(self) -> bytes:
        n = self._count
        return DATA.pack(REPORT_ID, n, -n, -10_000 + n, n * self._feature[2] * 1000)

    def _answer(self, event: bytes) -> None:
        (kind,) = struct.unpack_from("<I", event)
        if kind == GET_REPORT:
            request, _, report = struct.unpack_from("<IBB", event, 4)
            data = self._data() if report == INPUT_TYPE else FEATURE.pack(REPORT_ID, *self._feature)
            self._write(struct.pack("<IIHH", GET_REPLY, request, 0, len(data)) + data)
        elif kind == SET_REPORT:
            request, _, report, size = struct.unpack_from("<IBBH", event, 4)
            data = event[12 : 12 + size]
            if report == FEATURE_TYPE and size == FEATURE.size:
                self._feature = list(FEATURE.unpack(data)[1:])
            self._write(struct.pack("<IIH", SET_REPLY, request, 0))

    def _write(self, event: bytes) -> None:
        os.write(self._handle, event)
