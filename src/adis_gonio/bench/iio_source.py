"""IIO accelerometers as sources of samples for a session, by `iio:` URLs, through libiio 0.x.

A buffered device gives scans by its own clock, with times if it has a channel `timestamp`; lost scans show
as gaps in the times. `?poll=HZ` reads single values instead, by the host's clock. Devices are on this
machine or reached by network.

value = (raw + offset) * scale, in m/s², rad/s, milli-degree Celsius, millivolt. Source: the kernel's
Documentation/ABI/testing/sysfs-bus-iio.
"""

from __future__ import annotations

import contextlib
import math
import re
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from adis_gonio.base import Closing
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import (
    BusClosedError,
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    UsageError,
    install_extra,
)
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.device.bus.host import UrlOptions
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.sensor.scanning import BlockStream
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.blocks import GENERIC, ValueBlock
from adis_gonio.record.source import KnownPart, Measuring, SampleSource, Settings

COLUMNS: dict[str, tuple[str, float]] = {
    **{f"accel_{axis}": (f"a{axis}", 1000.0 / STANDARD_GRAVITY_MPS2) for axis in "xyz"},
    **{f"anglvel_{axis}": (f"g{axis}", 180.0 / np.pi) for axis in "xyz"},
    "temp": ("temp_c", 1e-3),
    "temp0": ("temp_c", 1e-3),
    "temp_x": ("temp_c", 1e-3),
    "voltage0_supply": ("supply_v", 1e-3),
}
"""Column of a session and factor from IIO's unit to the column's unit, by the channel's name.

If a device has several temperatures, the first one in this order is used.
"""

ACCELS = ("accel_x", "accel_y", "accel_z")


@dataclass(frozen=True)
class IioChannel:
    """A channel of an IIO device with its scale.

    Attributes
    ----------
    id : str
        Name such as `accel_x`, or with the label in the name of the kernel's file, `voltage0_supply`.
    dtype : numpy.dtype or None
        Type of its samples, in the byte order of the host; None if the channel cannot be buffered.
    scale, offset : float
        Conversion of a raw number to IIO's unit: value = (raw + offset) * scale.
    """

    id: str
    dtype: np.dtype[np.integer[Any]] | None = None
    scale: float = 1.0
    offset: float = 0.0

    @property
    def column(self) -> str:
        """Column of a session in which the channel is recorded; empty if there is none."""
        return COLUMNS.get(self.id, ("", 0.0))[0]

    def values(self, numbers: np.ndarray | float) -> Floats:
        """Convert raw numbers of any shape to values in the column's unit: mg, °/s, °C, V."""
        return np.asarray((numbers + self.offset) * (COLUMNS[self.id][1] * self.scale))


def choose_channels(channels: Sequence[IioChannel], where: str) -> tuple[IioChannel, ...]:
    """Choose the channels that a session records: one for each column, in the order of the columns.

    `where` names the device in error messages. Gyros are left out unless there are three.

    Raises
    ------
    CannotOpenError
        The device is not an accelerometer with three axes.
    """
    found = {channel.id: channel for channel in channels}
    if missing := [name for name in ACCELS if name not in found]:
        raise CannotOpenError(f"{where}: no accelerometer of three axes ({', '.join(missing)} missing)")
    chosen: dict[str, IioChannel] = {}
    for name, (column, _) in COLUMNS.items():
        if name in found:
            chosen.setdefault(column, found[name])
    gyros = {"gx", "gy", "gz"} <= chosen.keys()
    return tuple(channel for column, channel in chosen.items() if gyros or not column.startswith("g"))


def parse_number(text: str | None, name: str, default: float, where: str) -> float:
    """Return the number in the text of an attribute, or `default` if `text` is None.

    `name` and `where` name the attribute and the device in error messages.

    Raises
    ------
    CannotOpenError
        The text is no finite number.
    """
    if text is None:
        return default
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise CannotOpenError(f"{where}: {name} is '{text.strip()[:40]}', which is no finite number")
    return number


TIMESTAMP = "timestamp"
PORT = 30431
"""TCP port on which iiod listens."""

TIMEOUT_S = 5.0
LOCAL = "local:"
SYSFS = Path("/sys/bus/iio/devices")

T = TypeVar("T")


class IioDevice(Closing):
    """An IIO device of this machine or of a server, read through libiio.

    Parameters
    ----------
    where : str
        URL that names the device in error messages.
    context : str
        URI of libiio's context, `local:` or `ip:HOST:PORT`.
    name : str
        Id such as `iio:device0` or `device0`, or name of the device; empty takes the only accelerometer of
        three axes.
    timeout_s : float
        Longest time of an operation in s.

    Attributes
    ----------
    name : str
        Name of the device, such as `adxl345`.
    channels : tuple of IioChannel
        Input channels, with the timestamp if there is one.
    rate_hz : float or None
        Sample rate in Hz; None if the device does not state it.

    Raises
    ------
    NotInstalledError
        libiio or its Python package is missing.
    CannotOpenError
        No server answers, there is no such device, or there are several and no name is given.
    ProtocolError, BusTimeoutError
        The device or server fails while it is read.
    """

    def __init__(self, where: str, context: str, name: str, timeout_s: float = TIMEOUT_S) -> None:
        self.where = where
        self._timeout_s = timeout_s
        # Only this list keeps the buffer, so that libiio loses it before its context, even in
        # a garbage collection or at the end of the program.
        self._buffers: list[Any] = []
        weakref.finalize(self, self._buffers.clear)
        try:
            devices = self._within(timeout_s, lambda: _devices(context))
        except ProtocolError as error:
            raise CannotOpenError(f"{error}: is iiod or adis-gonio serve running there?") from error
        fits = [one for one in devices if _fits(one, name)]
        if len(fits) != 1:
            there = ", ".join(f"{one.id} ({one.name})" for one in devices) or "none"
            problem = "more than one device fits" if fits else "no such IIO device"
            raise CannotOpenError(f"{where}: {problem}; there are: {there}")
        self._device = fits[0]
        self._node = SYSFS / self._device.id if context == LOCAL else None
        self.name: str = self._device.name or self._device.id
        self._inputs = _inputs(self._device)
        self.channels, self.rate_hz = self._within(timeout_s, self._describe)

    def _describe(self) -> tuple[tuple[IioChannel, ...], float | None]:
        """Read the channels with their scales, and the rate of the device in Hz."""
        places = (self._device, self._inputs.get(ACCELS[0], self._device))
        rates = (self._number(place, "sampling_frequency", 0.0) for place in places)
        channels = []
        for name, one in self._inputs.items():
            scale, offset = self._number(one, "scale", 1.0), self._number(one, "offset", 0.0)
            dtype = self._dtype(name, one.data_format) if one.scan_element else None
            channels.append(IioChannel(name, dtype, scale, offset))
        return tuple(channels), next((rate for rate in rates if rate), None)

    def _number(self, place: Any, name: str, default: float) -> float:
        attribute = place.attrs.get(name)
        return parse_number(attribute and attribute.value, name, default, self.where)

    def _dtype(self, name: str, form: Any) -> np.dtype[np.integer[Any]]:
        whole = form.length in (8, 16, 32, 64) and form.bits > 0 and form.bits + form.shift <= form.length
        if not whole or form.repeat != 1:
            raise CannotOpenError(f"{self.where}: samples of the format of {name} are not read")
        return np.dtype(f"{'i' if form.is_signed else 'u'}{form.length // 8}")

    def read_raw(self, channel: str) -> float:
        """Read the present raw number of a channel."""
        one = self._inputs.get(channel)
        if one is None:
            raise BusClosedError(f"{self.where}: used after it was closed")
        if "raw" not in one.attrs:
            raise ProtocolError(f"{self.where}: {channel} has no single values")
        # The function keeps the channel, and with it libiio's context, until libiio returns.
        text = self._within(self._timeout_s, lambda: one.attrs["raw"].value)
        return parse_number(text, "raw", 0.0, self.where)

    # -- the buffer -------------------------------------------------------------------------------

    def open_buffer(self, channels: Sequence[IioChannel], samples: int, patience_s: float) -> None:
        """Start to buffer scans of these channels, which are read in blocks of `samples` scans.

        `patience_s` is the longest time in s for a block.

        Raises
        ------
        CannotOpenError
            The buffer is in use or cannot be opened.
        """
        wanted = {channel.id for channel in channels}
        for name, one in self._inputs.items():
            one.enabled = name in wanted
        device = self._device
        self._patience_s = patience_s
        # libiio gives a server half of this time for its part.
        device.ctx.set_timeout(math.ceil(2000 * patience_s))
        try:
            self._within(
                self._timeout_s, lambda: self._buffers.append(load_libiio().Buffer(device, samples))
            )
        except ProtocolError as error:
            raise CannotOpenError(
                f"{error}: the buffer cannot be opened; does another program read it, or does it need root"
                " or a trigger (trigger/current_trigger)? Add ?poll=HZ to read single values"
            ) from error

    def read_buffer(self) -> dict[str, np.ndarray]:
        """Wait for the next block; return its numbers (n,) int64 by the channel's name."""
        if not self._buffers:
            raise BusClosedError(f"{self.where}: used after it was closed")
        try:
            return self._within(self._patience_s, self._refill)
        except BusError as error:
            # The kernel does not wake a reader when a device is removed.
            if self._node is not None and not self._node.exists():
                raise ProtocolError(f"{self.where}: the device is gone") from error
            raise

    def _refill(self) -> dict[str, np.ndarray]:
        (buffer,) = self._buffers
        buffer.refill()
        return {
            one.id: np.frombuffer(self._inputs[one.id].read(buffer), one.dtype).astype(np.int64)
            for one in self.channels
            if self._inputs[one.id].enabled
        }

    def close_buffer(self) -> None:
        """End buffering; may be called twice."""
        if self._buffers:
            with contextlib.suppress(BusError):
                self._within(self._timeout_s, self._buffers.clear)

    def close(self) -> None:
        """End buffering and the connection; may be called twice."""
        self.close_buffer()
        self._inputs, self._device = {}, None

    def _within(self, seconds: float, call: Callable[[], T]) -> T:
        """Run a call of libiio, whose own time-outs are for single packets, with one deadline.

        After the deadline the call goes on in its thread, which keeps its objects.

        Raises
        ------
        BusTimeoutError, ProtocolError
            The call has not ended in time, or has failed.
        """
        outcome: Future[T] = Future()

        def run() -> None:
            try:
                outcome.set_result(call())
            except BaseException as error:
                # The frames of a traceback would keep objects of libiio.
                outcome.set_exception(error.with_traceback(None))

        threading.Thread(target=run, daemon=True).start()
        try:
            return outcome.result(seconds)
        except TimeoutError as error:
            raise BusTimeoutError(
                f"{self.where}: no answer in {seconds:.3g} s: is the server or the trigger running?"
            ) from error
        except (OSError, UnicodeError) as error:
            raise ProtocolError(f"{self.where}: {getattr(error, 'strerror', None) or error}") from error


def load_libiio() -> Any:
    """Import the Python package of libiio; raises `NotInstalledError` without it or without the library."""
    try:
        import iio
    except ImportError:
        raise NotInstalledError(f"iio: pylibiio is not installed: {install_extra('iio')}") from None
    except (AttributeError, OSError, TypeError):
        raise NotInstalledError("iio: libiio 0.x is not installed (Debian: apt install libiio0)") from None
    return iio


def _devices(context: str) -> list[Any]:
    if context == LOCAL and not SYSFS.is_dir():
        return []
    return list(load_libiio().Context(context).devices)


def _inputs(device: Any) -> dict[str, Any]:
    """Return the input channels of a device by their names, such as `accel_x` and `voltage0_supply`."""
    return {
        f"{one.id}_{one.name}" if one.name else one.id: one for one in device.channels if not one.output
    }


def _fits(device: Any, name: str) -> bool:
    if name:
        return name in (device.id, device.id.removeprefix("iio:"), device.name, device.label)
    return set(ACCELS) <= set(_inputs(device))


TYPICAL_NOISE_MG = 5.0
"""Estimate of a sample's noise in mg for an unknown accelerometer; ten times as much counts as motion."""

TYPICAL_BIAS_MG = 50.0
"""Estimate of an unknown accelerometer's bias in mg; consumer parts state 20 to 100 mg."""

PATIENCE_S = 5.0
"""Shortest time in s without a scan after which a device counts as silent."""

NO_FAULTS = "the sensor reports no errors or alarms, so a fault within a dwell is not detected"
"""Text for the user: IIO has no common interface for errors and alarms."""

_NETWORK = re.compile(r"ip:(?P<host>\[[^]]+\]|[^:/]+)(?::(?P<port>\d{1,5}))?(?:/(?P<device>.*))?")


class IioMeasuring(JsonRecord):
    """Configuration of an IIO device.

    Attributes
    ----------
    sample_rate_hz : float
        Number of samples a second.
    device : str
        Name of the device.
    buffered : bool
        False if single values are polled.
    scales, offsets : mapping of str to float
        Conversion of each channel by its name: value = (raw + offset) * scale, in IIO's units.
    settling_s : float
        Settling time of a filter: 0, because none is known.
    """

    sample_rate_hz: float
    device: str
    buffered: bool
    scales: Mapping[str, float] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)

    settling_s = 0.0

    @property
    def sample_period_s(self) -> float:
        """Time between two samples in s."""
        return 1.0 / self.sample_rate_hz


class IioSource(SampleSource):
    """An IIO accelerometer as a source of samples; use it as a context manager.

    Parameters
    ----------
    url : str
        URL by which the device was opened.
    device : IioDevice
        Open device; the source closes it.
    poll_hz : float or None
        Rate at which single values are read instead of scans; None reads scans from the buffer.
    rate_hz : float or None
        Sample rate in Hz of a device that does not state it; None takes the device's rate.

    Attributes
    ----------
    channels, columns : tuple
        Recorded channels, and the columns of a session that the blocks of samples have, in this order.
    next_s : float
        Earliest possible time of the next scan in s on the clock of `now_s`.

    Raises
    ------
    CannotOpenError
        The device is no accelerometer with three axes, or has no buffer or no rate.
    """

    kept = ("dwell_s", "settle_s", "still_timeout_s")

    def __init__(
        self, url: str, device: IioDevice, *, poll_hz: float | None = None, rate_hz: float | None = None
    ) -> None:
        self.url = url
        self._device = device
        self._zero_s = time.monotonic()
        self.next_s = 0.0
        self.channels = choose_channels(device.channels, url)
        self.columns = tuple(channel.column for channel in self.channels)
        self._time = next((c for c in device.channels if c.id == TIMESTAMP and c.dtype), None)
        if poll_hz is None and any(channel.dtype is None for channel in self.channels):
            raise CannotOpenError(f"{url}: {device.name} has no buffer for all of its axes: add ?poll=HZ")
        rate = poll_hz or rate_hz or device.rate_hz
        if rate is None:
            raise CannotOpenError(f"{url}: {device.name} lacks sampling_frequency: add ?rate=HZ")
        low, high = 1e-3, 1e6
        if not low <= rate <= high:
            raise CannotOpenError(
                f"{url}: {device.name} states {rate:g} samples a second; {low:g} to {high:g} can be read"
            )
        self.measuring = IioMeasuring(
            rate,
            device.name,
            poll_hz is None,
            {channel.id: channel.scale for channel in self.channels},
            {channel.id: channel.offset for channel in self.channels},
        )
        step_mg = max(abs(float(np.ptp(c.values(np.array([0, 1]))))) for c in self.channels[:3])
        self.part = KnownPart(GENERIC, TYPICAL_BIAS_MG, step_mg)

    def now_s(self) -> float:
        """Return the present time in s on the host's clock, 0 at opening."""
        return time.monotonic() - self._zero_s

    def sleep_s(self, seconds: float) -> None:
        """Wait for some seconds."""
        time.sleep(seconds)

    def configure(self, settings: Settings) -> Measuring:
        """Return the configuration of the device, which the settings cannot change."""
        return self.measuring

    def identity(self, registers: Mapping[str, Any], measuring: Mapping[str, Any]) -> dict[str, Any]:
        """Return name, rate and scales of the device, which must not change during a session.

        `measuring` is the configuration in JSON form; `registers` is not used.
        """
        return dict(measuring)

    def expected_noise_mg(self, measuring: Measuring) -> float:
        """Return an estimate of a sample's noise in mg, a rough value for any accelerometer."""
        return TYPICAL_NOISE_MG

    def samples(self, settings: Settings, block_samples: int) -> IioStream:
        """Start a stream of samples in blocks of `block_samples`; the settings have no effect on it."""
        if block_samples < 1:
            raise UsageError(f"block_samples is {block_samples}: take 1 or more")
        if not self.measuring.buffered:
            return PolledSamples(self, block_samples)
        return BufferedSamples(self, block_samples)

    def close(self) -> None:
        """Close the device."""
        self._device.close()


class IioStream(BlockStream[ValueBlock]):
    """Stream of blocks of samples until it is closed; use it as a context manager.

    Attributes
    ----------
    how, caveat : str
        Way in which samples are read, and their known limitation, as texts for the user.
    """

    caveat = NO_FAULTS

    def __init__(self, source: IioSource, block_samples: int) -> None:
        self._source = source
        self._device = source._device
        self._block = block_samples
        self._period_s = source.measuring.sample_period_s


class BufferedSamples(IioStream):
    """Stream of scans that the device takes by its own clock and buffers."""

    def __init__(self, source: IioSource, block_samples: int) -> None:
        super().__init__(source, block_samples)
        stamp = source._time
        self._stamped = stamp is not None
        self.how = "scans by the device's own clock; " + (
            "lost ones show in their times" if stamp else "it gives no times, so lost ones cannot be seen"
        )
        self._begun = False
        self._last_ns: int | None = None
        channels = [*source.channels, *([stamp] if stamp else [])]
        self._device.open_buffer(
            channels, block_samples, max(PATIENCE_S, 3 * block_samples * self._period_s)
        )

    def _next(self) -> ValueBlock:
        numbers, source = self._device.read_buffer(), self._source
        count = len(numbers[source.channels[0].id])
        if not self._begun:
            # A late first block makes all times of its stream late; the next stream begins after them.
            source.next_s = max(source.next_s, source.now_s() - count * self._period_s)
            self._begun = True
        if self._stamped:
            time_s, lost = self._times(numbers[TIMESTAMP])
        else:
            time_s, lost = source.next_s + self._period_s * np.arange(count, dtype=np.float64), 0
        source.next_s = float(time_s[-1]) + self._period_s
        data = np.column_stack([one.values(numbers[one.id]) for one in source.channels])
        return ValueBlock(source.columns, data, time_s, lost)

    def _times(self, stamps_ns: np.ndarray) -> tuple[Floats, int]:
        """Convert time stamps (n,) in ns to times on the source's clock in s, and count missing samples.

        Raises
        ------
        ProtocolError
            The time stamps do not increase.
        """
        if self._last_ns is None:  # no step comes before the first sample of a stream
            self._last_ns = int(stamps_ns[0]) - round(1e9 * self._period_s)
        steps_s = np.diff(stamps_ns, prepend=self._last_ns) * 1e-9
        if (steps_s <= 0).any():
            raise ProtocolError(
                f"{self._source.url}: the times of the scans go back: let its current_timestamp_clock be"
                " monotonic"
            )
        self._last_ns = int(stamps_ns[-1])
        lost = int(np.maximum(np.rint(steps_s / self._period_s) - 1, 0).sum())
        return np.asarray(self._source.next_s - self._period_s + np.cumsum(steps_s), np.float64), lost

    def _stop(self) -> None:
        self._device.close_buffer()


class PolledSamples(IioStream):
    """Stream of single values that the host reads one after another, by its own clock."""

    how = "single values by the host's clock"
    caveat = f"the axes of a sample are not simultaneous; {NO_FAULTS}"

    def __init__(self, source: IioSource, block_samples: int) -> None:
        super().__init__(source, block_samples)
        self._due_s = source.now_s()

    def _next(self) -> ValueBlock:
        source, rows, times, lost = self._source, [], [], 0
        for _ in range(self._block):
            source.sleep_s(max(0.0, self._due_s - source.now_s()))
            times.append(source.now_s())
            rows.append([one.values(self._device.read_raw(one.id)) for one in source.channels])
            behind = math.floor(max(0.0, (source.now_s() - self._due_s) / self._period_s - 1))
            lost += behind
            self._due_s += (1 + behind) * self._period_s
        return ValueBlock(source.columns, np.array(rows), np.array(times), lost)


def open_from_url(url: BusUrl) -> IioSource:
    """Open `iio:`, `iio:NAME`, `iio:ip:HOST/NAME` or `iio:ip:HOST:PORT/NAME`, with options `poll`, `rate`.

    NAME is `device0` or the name of the device; without it the only accelerometer is used.

    Raises
    ------
    UsageError
        An option is unknown, or the address is not valid.
    CannotOpenError
        There is no such device, it cannot be opened, or it is no accelerometer with three axes.
    """
    UrlOptions(url, ("poll", "rate"))  # refuses other options
    poll_hz, rate_hz = (_hertz(url, name) for name in ("poll", "rate"))
    context, name = LOCAL, url.place
    if url.place.startswith("ip:"):
        found = _NETWORK.fullmatch(url.place)
        if found is None or not 0 < int(found["port"] or PORT) < 1 << 16:
            raise UsageError(f"'{url.text}': write iio:ip:HOST/DEVICE or iio:ip:HOST:PORT/DEVICE")
        context, name = f"ip:{found['host']}:{found['port'] or PORT}", found["device"] or ""
    device = IioDevice(f"iio:{url.place}", context, name)
    with device.closed_on_error():
        return IioSource(url.text, device, poll_hz=poll_hz, rate_hz=rate_hz)


def find_devices() -> list[Device]:
    """List the accelerometers of this machine; devices of other machines have to be named by address."""
    return [
        Device(
            f"iio:{one.id.removeprefix('iio:')}",
            f"IIO accelerometer {one.name or one.id}: samples, no registers",
        )
        for one in _devices(LOCAL)
        if _fits(one, "")
    ]


def _hertz(url: BusUrl, name: str) -> float | None:
    text = url.options.get(name)
    if text is None:
        return None
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"'{url.text}': {name} is a rate in Hz above zero, not '{text}'")
    return value
