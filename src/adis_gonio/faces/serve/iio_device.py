"""The sensor as an IIO device: its channels and attributes, and the samples of its buffers.

One thread, the `Sampler`, reads the sensor, and a `Hub` distributes its scans to the open buffers of many
clients. The thread streams while a client has a buffer open. Other access to the sensor is a job, which the
thread runs between two scans. A bus that streams takes no other exchange, so the stream ends before a job
and begins again after it. `Sampler` therefore keeps the values of the attributes in `state` and `newest`,
so that reading them needs no job during a stream.

The channels, their attributes, the XML and the format of scans need no sensor; `SensorState` contains the
values of the attributes. Units as in Linux' IIO ABI: m/s², rad/s, milli-degree Celsius, millivolt; value =
(raw + offset) * scale. Axes and signs are the sensor's own: level with Z up, Z reads -9.8 m/s².
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.errors import AdisGonioError, SilentChipError
from adis_gonio.device.sensor import DEFAULT_SCAN, Adis16354, ScanBlock, registers as register_table
from adis_gonio.device.sensor.settings import Configuration, low_pass_3db_hz, sample_period_s, scales
from adis_gonio.faces.serve.iiod_protocol import Errno, Refused
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

T = TypeVar("T")

BLOCK_S = 0.04
"""Length of a block of scans in s, the longest delay of a scan in addition to the delay of the bus."""

MOST_BLOCK = 256

_CHECK = "SENS_AVG"
"""Register that is read before and after the outputs of a scan, to see that the sensor answers."""

_LONGEST_UNSOUND_S = 1.0
"""Time in s without a sound scan after which the stream has failed."""


class Sampler:
    """Thread that alone uses the sensor while it is served; it streams scans and runs jobs.

    Parameters
    ----------
    sensor : Adis16354
        The open sensor, which stays open afterwards.
    on_scans : callable
        Called in the thread of the sampler with new scans: the decoded contents (n, k) of the k registers,
        and the times (n,) in ns since 1970, by the host's clock at the begin of the stream and by the bus's
        clock after it.
    on_failure : callable
        Called in the thread of the sampler with the error that ends it.

    Attributes
    ----------
    state : SensorState
        Configuration and offsets that were read from the registers.
    newest : mapping of str to int, or None
        Decoded contents of the newest scan by register name during a stream; None without a stream.
    """

    def __init__(
        self,
        sensor: Adis16354,
        on_scans: Callable[[NDArray[np.int32], NDArray[np.int64]], object],
        on_failure: Callable[[Exception], object],
    ) -> None:
        self.newest: dict[str, int] | None = None
        self._sensor = sensor
        self._simulated = getattr(sensor.bus, "world", None) is not None
        self._on_scans = on_scans
        self._on_failure = on_failure
        self._thread = ThreadPoolExecutor(1, "sampler")
        self._waiting = deque[None]()
        """One entry for each job that has not begun, for which the stream ends."""
        self._wake = threading.Event()
        self._stopping = self._wanted = False
        self._last_ns = 0
        self.state = state_of(sensor)

    def stop(self) -> None:
        """End the stream, which restores the register that it changed, and end the thread."""
        self._stopping = True
        self._wake.set()
        self._thread.shutdown(cancel_futures=True)

    def want(self, wanted: bool) -> None:
        """Start or end streaming: `wanted` is True if at least one client needs scans."""
        begins = wanted and not self._wanted
        self._wanted = wanted
        self._wake.set()
        if begins:
            self._thread.submit(self._stream)

    def submit(self, job: Callable[[Adis16354], T], *, changes: bool = False) -> Future[T]:
        """Queue a job that uses the sensor; return the future of its result.

        The thread runs the job between two scans.

        Parameters
        ----------
        job : callable
            Called with the sensor.
        changes : bool
            True if the job writes registers, so that `state` has to be read again.
        """
        self._waiting.append(None)
        self._wake.set()
        return self._thread.submit(self._run_job, job, changes)

    # -- inside the thread --------------------------------------------------------------------------

    def read_output(self, row: register_table.Register) -> int:
        """Read an output register once; return its number. Raise `SilentChipError` if the check fails."""
        words = self._sensor.read_words([_CHECK, row, _CHECK])
        self._require_sound(words)
        return row.number(words[1])

    def _require_sound(self, words: Sequence[int]) -> None:
        """Raise `SilentChipError` if the first or last of `words` is not the known content of SENS_AVG."""
        known = self.state.sens_avg
        for word in (words[0], words[-1]):
            if word != known:
                raise SilentChipError(
                    f"{self._sensor.bus.url}: SENS_AVG reads 0x{word:04X}, not 0x{known:04X}: the sensor"
                    " has other settings, or is not connected; check supply, chip select and wires"
                )

    def _run_job(self, job: Callable[[Adis16354], T], changes: bool) -> T:
        self._waiting.popleft()
        try:
            return job(self._sensor)
        finally:
            if changes:  # a failed job may have changed some registers
                with contextlib.suppress(AdisGonioError):
                    self.state = state_of(self._sensor)

    def _stream(self) -> None:
        """Read scans until a job waits or no client wants them; go on after the jobs."""
        try:
            if not self._interrupted:
                self._read_scans()
        except Exception as error:  # of any kind, because no client may wait for scans that will not come
            self._on_failure(error)
            return
        if self._wanted and not self._stopping:
            self._thread.submit(self._stream)

    def _read_scans(self) -> None:
        sensor = self._sensor
        self._wake.clear()
        rate_hz = self.state.configuration.sample_rate_hz
        block_scans = min(MOST_BLOCK, max(1, round(BLOCK_S * rate_hz)))
        wall_s, bus_s = time.monotonic(), sensor.bus.now_s()
        # A busy host may have timed an earlier stream too late, or its clock was set back.
        since_1970_ns = max(time.time_ns(), self._last_ns) - round(bus_s * 1e9)
        self._sound_s = bus_s
        try:
            with sensor.stream((_CHECK, *DEFAULT_SCAN, _CHECK), block_scans=block_scans) as stream:
                for block in stream:
                    if self._simulated:  # its clock may run ahead, but clients expect the rate
                        self._wait_until(wall_s + float(block.time_s[-1]) - bus_s)
                    self._publish(block, since_1970_ns)
                    if self._interrupted:
                        break
        finally:
            self.newest = None

    @property
    def _interrupted(self) -> bool:
        return self._stopping or not self._wanted or bool(self._waiting)

    def _wait_until(self, monotonic_s: float) -> None:
        while (left_s := monotonic_s - time.monotonic()) > 0:
            self._wake.wait(left_s)
            self._wake.clear()
            if self._interrupted:
                return

    def _publish(self, block: ScanBlock, since_1970_ns: int) -> None:
        """Publish the scans of a block in which both words of SENS_AVG are right.

        `since_1970_ns` is the time in ns since 1970 at which the clock of the bus was 0.
        """
        if not len(block):
            return
        sound = (block.words[:, [0, -1]] == self.state.sens_avg).all(axis=1)
        if sound.any():
            self._sound_s = float(block.time_s[sound][-1])
            self._last_ns = round(self._sound_s * 1e9) + since_1970_ns
        elif block.time_s[-1] > self._sound_s + _LONGEST_UNSOUND_S:
            self._require_sound(block.words[-1])
        numbers = block.numbers()[sound, 1:-1]
        if len(numbers):
            self.newest = dict(zip(DEFAULT_SCAN, numbers[-1].tolist(), strict=True))
        time_ns = np.rint(block.time_s[sound] * 1e9).astype(np.int64) + since_1970_ns
        self._on_scans(numbers, time_ns)


def state_of(sensor: Adis16354) -> SensorState:
    """Read configuration and offsets of the sensor, from which the values of attributes are computed."""
    rows = register_table.registers([*register_table.ACCEL_OFF, *register_table.GYRO_OFF, _CHECK])
    words = sensor.read_checked(rows)
    offsets = {row.name: row.number(word) for row, word in zip(rows[:-1], words[:-1], strict=True)}
    return SensorState(sensor.configuration(), offsets, words[-1])


QUEUE_S = 30.0
"""Length of a client's queue in s; all channels at full rate fill it with 0.6 MB."""

CLIENT_BLOCKS = 4
"""Smallest capacity of a client's queue, in buffers of the client's size; the default of the kernel."""

MOST_QUEUED = 1 << 18
"""Largest number of scans in a client's queue, even if the client asks for more."""


class Buffer:
    """An open buffer of a client: the format of its scans, and a bounded queue of scans that wait for it.

    A full queue drops the oldest scans.

    Parameters
    ----------
    capacity : int
        Largest number of scans in the queue.

    Attributes
    ----------
    lost : int
        Number of dropped scans.
    news : asyncio.Event
        Set after new scans, or a failure of the sensor.
    """

    def __init__(self, scan_format: ScanFormat, capacity: int) -> None:
        self.format = scan_format
        self.lost = 0
        self.news = asyncio.Event()
        self._size = scan_format.dtype.itemsize
        self._room = capacity * self._size
        self._held = bytearray()

    def __len__(self) -> int:
        return len(self._held) // self._size

    def put(self, numbers: NDArray[np.int32], time_ns: NDArray[np.int64]) -> None:
        """Append scans in the format of the buffer, and drop the oldest ones that have no room."""
        self._held += self.format.pack(numbers, time_ns).tobytes()
        dropped = max(0, len(self._held) - self._room)
        del self._held[:dropped]
        self.lost += dropped // self._size
        self.news.set()

    def take(self, most: int) -> bytes:
        """Remove the oldest scans from the queue, at most `most`, and return them as bytes."""
        taken = bytes(self._held[: most * self._size])
        del self._held[: len(taken)]
        return taken


class Hub:
    """Distributes scans to the open buffers, in the thread of the event loop.

    Parameters
    ----------
    want : callable
        Called with True when a buffer opens, and with False when the last one closes.
    queue_s : float
        Smallest length of a client's queue in s.

    Attributes
    ----------
    failure : Exception or None
        Error that ended the sampling, after which buffers get no more scans; None while it works.
    """

    def __init__(self, want: Callable[[bool], object], queue_s: float = QUEUE_S) -> None:
        self.failure: Exception | None = None
        self._want = want
        self._queue_s = queue_s
        self._buffers: set[Buffer] = set()

    def open(self, scan_format: ScanFormat, samples: int, rate_hz: float) -> Buffer:
        """Open a buffer for a client; it gets all scans from now on.

        `samples` is the size of the client's buffer in scans, `rate_hz` the sample rate; both determine the
        size of the queue.
        """
        capacity = min(MOST_QUEUED, max(CLIENT_BLOCKS * samples, round(self._queue_s * rate_hz), 16))
        buffer = Buffer(scan_format, capacity)
        self._buffers.add(buffer)
        self._want(True)
        return buffer

    def close(self, buffer: Buffer) -> None:
        """Close a buffer; when the last one is closed, the sensor ends streaming."""
        self._buffers.discard(buffer)
        if not self._buffers:
            self._want(False)

    def publish(self, numbers: NDArray[np.int32], time_ns: NDArray[np.int64]) -> None:
        """Append new scans to the queue of every buffer, in the format of the buffer."""
        for buffer in self._buffers:
            buffer.put(numbers, time_ns)

    def fail(self, error: Exception) -> None:
        """Note that the sensor has failed, and wake all waiting clients."""
        self.failure = error
        for buffer in self._buffers:
            buffer.news.set()


DEVICE_ID = "iio:device0"
OFFSET_OF: dict[str, str] = dict(
    zip(
        (*register_table.ACCEL_OUT, *register_table.GYRO_OUT),
        (*register_table.ACCEL_OFF, *register_table.GYRO_OFF),
        strict=True,
    )
)
"""Offset register that is the calibbias of each output register."""

_IDS = {
    **{f"{axis}ACCL_OUT": f"accel_{axis.lower()}" for axis in "XYZ"},
    **{f"{axis}GYRO_OUT": f"anglvel_{axis.lower()}" for axis in "XYZ"},
    "XTEMP_OUT": "temp_x",
    "SUPPLY_OUT": "voltage0",
}

_SI: dict[register_table.Kind, float] = dict.fromkeys(register_table.Kind, 1000.0) | {
    register_table.Kind.ACCEL: STANDARD_GRAVITY_MPS2 / 1000.0,
    register_table.Kind.GYRO: math.pi / 180.0,
}
"""Factor from the unit of this program to IIO's unit: mg → m/s², °/s → rad/s, °C → m°C, V → mV."""

_RATES_OF = (1, 2, 3, 4, 5, 7, 9, 0x0A, 0x0F, 0x13, 0x1F, 0x3F, 0x7F, 0x80, 0x81, 0x83, 0x87, 0x8F, 0xFF)
"""Contents of SMPL_PRD of the offered rates; a client's rate is rounded to the nearest possible rate."""

FILTERS = range(7)
"""Possible filter sizes M."""


@dataclass(frozen=True)
class SensorState:
    """The configuration and offsets of the sensor, from which attributes are computed.

    Attributes
    ----------
    configuration : Configuration
        Sample rate, filter and range.
    offsets : mapping of str to int
        Content of each of the six offset registers.
    sens_avg : int
        Content of SENS_AVG.
    """

    configuration: Configuration
    offsets: Mapping[str, int]
    sens_avg: int


_FILTER = "filter_low_pass_3db_frequency"
_BIASED = ("raw", "scale", "calibbias", _FILTER, f"{_FILTER}_available")
_ATTRIBUTES = {
    register_table.Kind.ACCEL: _BIASED,
    register_table.Kind.GYRO: _BIASED,
    register_table.Kind.TEMPERATURE: ("raw", "scale", "offset"),
    register_table.Kind.SUPPLY: ("raw", "scale"),
}
"""Names of the attributes of a channel, by the kind of its register."""


@dataclass(frozen=True)
class Channel:
    """An IIO channel of the served device: an output register, or the time of a scan.

    Attributes
    ----------
    index : int
        Index of the channel in a scan, and its bit in a mask of channels.
    id : str
        Name of the channel in requests, such as `accel_x`.
    dtype : str
        Numpy type of a sample of the channel, such as `<i2`.
    format : str
        Format of a sample in IIO's notation, such as `le:s14/16>>0`. The sign of a sample is already
        extended to 16 bits.
    register : Register or None
        Output register; None for the time.
    attributes : tuple of str
        Names of the channel's attributes.
    """

    index: int
    id: str
    dtype: str
    format: str
    register: register_table.Register | None = None
    attributes: tuple[str, ...] = ()

    @classmethod
    def of(cls, index: int, row: register_table.Register) -> Channel:
        """Return the channel of an output register, with this index in a scan."""
        dtype, letter = ("<i2", "s") if row.signed else ("<u2", "u")
        sample = f"le:{letter}{row.bits}/16>>0"
        return cls(index, _IDS[row.name], dtype, sample, row, _ATTRIBUTES[row.kind])

    @property
    def label(self) -> str:
        """Suffix that file names of the Linux kernel add to the channel's name; empty for most channels."""
        return "supply" if self.id == "voltage0" else ""

    def filename(self, attribute: str) -> str:
        """Return the name of the file in which the Linux kernel would have an attribute of the channel.

        The attributes of the filter have the same file for all axes of a kind, such as acceleration.
        """
        stem = self.id + (f"_{self.label}" if self.label else "")
        if attribute.startswith("filter"):
            stem = self.id.partition("_")[0]
        return f"in_{stem}_{attribute}"


DEVICE_ATTRIBUTES = ("sampling_frequency", "sampling_frequency_available", "current_timestamp_clock")
WRITABLE = ("calibbias", _FILTER, "sampling_frequency")
"""Names of the attributes that a client may write if writes are allowed."""


class ServedDevice:
    """The sensor as an IIO device: its channels, its attributes, and its description as XML.

    Parameters
    ----------
    part : Variant
        Sensor type.
    description : str
        Text that describes the IIO context (the server and its devices) to a client.
    """

    def __init__(self, part: register_table.Variant, description: str) -> None:
        self.part = part
        self.description = description
        outputs = [Channel.of(*one) for one in enumerate(register_table.registers(DEFAULT_SCAN))]
        self.channels = (*outputs, Channel(len(outputs), "timestamp", "<i8", "le:S64/64>>0"))

    def require(self, device: str) -> None:
        """Raise `Refused` if `device` is neither the id nor the name of this device."""
        if device not in (DEVICE_ID, self.part.name):
            raise Refused(Errno.ENODEV)

    def channel(self, name: str) -> Channel:
        """Return the channel with the id `name`; raise `Refused` if there is none."""
        for channel in self.channels:
            if name == channel.id:
                return channel
        raise Refused(Errno.ENXIO)

    # -- values of attributes ---------------------------------------------------------------------

    def scale_and_offset(self, row: register_table.Register, state: SensorState) -> tuple[float, float]:
        """Return the scale in IIO's unit per LSB, and the offset added to the raw number before scaling.

        `row` is the output register of a channel.
        """
        lsb, zero, _ = scales([row], self.part, state.configuration.gyro_range_dps or 300)
        return float(lsb[0]) * _SI[row.kind], float(zero[0] / lsb[0])

    def channel_value(self, channel: Channel, name: str, state: SensorState) -> str:
        """Return the value of a channel's attribute as text.

        `name` is one of `channel.attributes`, except `raw`, which needs a scan.
        """
        row = channel.register
        assert row is not None  # the time has no attributes
        scale, offset = self.scale_and_offset(row, state)
        if name == "calibbias":
            return str(state.offsets[OFFSET_OF[row.name]])
        if name.endswith("_available"):
            return " ".join(_text(_filter_hz(m, state)) for m in FILTERS)
        frequency_hz = _filter_hz(state.configuration.filter_m, state)
        return _text({"scale": scale, "offset": offset}.get(name, frequency_hz))

    def device_value(self, name: str, state: SensorState) -> str:
        """Return the value of the device's attribute `name`, one of `DEVICE_ATTRIBUTES`, as text."""
        if name == "sampling_frequency":
            return _text(state.configuration.sample_rate_hz)
        if name == "sampling_frequency_available":
            return " ".join(_text(1.0 / sample_period_s(n)) for n in _RATES_OF)
        return "realtime"  # current_timestamp_clock

    # -- the context ------------------------------------------------------------------------------

    def xml(self, state: SensorState) -> str:
        """Return a description of the device as XML in the format of libiio."""
        lines = [
            '<?xml version="1.0" encoding="utf-8"?>',
            _DTD,
            f'<context name="network" description={quoteattr(self.description)} >',
            f'<device id="{DEVICE_ID}" name="{self.part.name}" >',
        ]
        for channel in self.channels:
            named = f' name="{channel.label}"' if channel.label else ""
            scale = ""
            if channel.register is not None:
                scale = f' scale="{_text(self.scale_and_offset(channel.register, state)[0])}"'
            element = f'<scan-element index="{channel.index}" format={quoteattr(channel.format)}{scale} />'
            attributes = "".join(
                f'<attribute name="{name}" filename="{channel.filename(name)}" />'
                for name in channel.attributes
            )
            lines.append(f'<channel id="{channel.id}"{named} type="input" >{element}{attributes}</channel>')
        lines += [f'<attribute name="{name}" />' for name in DEVICE_ATTRIBUTES]
        lines.append("</device></context>")
        return "".join(lines)


def filter_for(frequency_hz: float, state: SensorState) -> int:
    """Return the filter size M whose −3 dB frequency is nearest to `frequency_hz` on a logarithmic scale.

    `state` has the sample rate, on which the −3 dB frequencies depend.

    Raises
    ------
    Refused
        The frequency is not above zero.
    """
    if not (math.isfinite(frequency_hz) and frequency_hz > 0):
        raise Refused(Errno.EINVAL)
    return min(FILTERS, key=lambda m: abs(math.log(_filter_hz(m, state) / frequency_hz)))


def _filter_hz(filter_m: int, state: SensorState) -> float:
    return low_pass_3db_hz(filter_m, state.configuration.sample_rate_hz)


def _text(value: float) -> str:
    return f"{value:.10g}"


@dataclass(frozen=True)
class ScanFormat:
    """The channels that a client has enabled, and the layout of its scans.

    Attributes
    ----------
    mask : str
        Mask of the channels as the client wrote it.
    """

    channels: tuple[Channel, ...]
    mask: str

    @classmethod
    def of_mask(cls, device: ServedDevice, mask: str) -> ScanFormat:
        """Make the format for a mask of channels.

        `Refused` is raised for a mask of a wrong length, without a channel or with an unknown channel.
        """
        if re.fullmatch("[0-9a-fA-F]{8}", mask) is None:  # libiio's form for up to 32 channels
            raise Refused(Errno.EINVAL)
        bits = int(mask, 16)
        if not bits or bits >> len(device.channels):
            raise Refused(Errno.EINVAL)
        return cls(tuple(c for c in device.channels if bits >> c.index & 1), mask)

    @cached_property
    def dtype(self) -> np.dtype[np.void]:
        """Numpy type of one scan, with a field for each channel, in the layout of the kernel and libiio.

        Each sample begins at a multiple of its size, and the size of a scan is a multiple of its largest
        sample.
        """
        formats = [np.dtype(channel.dtype) for channel in self.channels]
        offsets, end = [], 0
        for one in formats:
            offsets.append(end + -end % one.itemsize)
            end = offsets[-1] + one.itemsize
        size = end + -end % max(one.itemsize for one in formats)
        names = [channel.id for channel in self.channels]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})

    def pack(self, numbers: NDArray[np.int32], time_ns: NDArray[np.int64]) -> NDArray[np.void]:
        """Pack `numbers` (n, registers of the device) and times (n,) into scans (n,) of this format."""
        scans = np.zeros(len(numbers), self.dtype)
        for channel in self.channels:
            scans[channel.id] = time_ns if channel.register is None else numbers[:, channel.index]
        return scans


_DTD = (
    "<!DOCTYPE context [<!ELEMENT context (device | context-attribute)*>"
    "<!ELEMENT context-attribute EMPTY>"
    "<!ELEMENT device (channel | attribute | debug-attribute | buffer-attribute)*>"
    "<!ELEMENT channel (scan-element?, attribute*)><!ELEMENT attribute EMPTY>"
    "<!ELEMENT scan-element EMPTY><!ELEMENT debug-attribute EMPTY><!ELEMENT buffer-attribute EMPTY>"
    "<!ATTLIST context name CDATA #REQUIRED description CDATA #IMPLIED>"
    "<!ATTLIST context-attribute name CDATA #REQUIRED value CDATA #REQUIRED>"
    "<!ATTLIST device id CDATA #REQUIRED name CDATA #IMPLIED label CDATA #IMPLIED>"
    "<!ATTLIST channel id CDATA #REQUIRED type (input|output) #REQUIRED name CDATA #IMPLIED>"
    "<!ATTLIST scan-element index CDATA #REQUIRED format CDATA #REQUIRED scale CDATA #IMPLIED>"
    "<!ATTLIST attribute name CDATA #REQUIRED filename CDATA #IMPLIED>"
    "<!ATTLIST debug-attribute name CDATA #REQUIRED><!ATTLIST buffer-attribute name CDATA #REQUIRED>]>"
)
