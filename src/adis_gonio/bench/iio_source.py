"""IIO accelerometers as sources of samples for a session, by `iio:` URLs.

A buffered device gives scans by its own clock, with times if it has a channel `timestamp`; lost scans show
as gaps in the times. `?poll=HZ` reads single values instead, by the host's clock.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Mapping
from dataclasses import field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.bench.iio_devices import (
    LOCAL,
    PORT,
    TIMESTAMP,
    IioDevice,
    choose_channels,
    local_accelerometers,
)
from adis_gonio.device.bus.host import UrlOptions
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.sensor.scanning import BlockStream
from adis_gonio.record.blocks import GENERIC, ValueBlock
from adis_gonio.record.source import KnownPart, Measuring, SampleSource, Settings

TYPICAL_NOISE_MG = 5.0
"""Estimate of a sample's noise in mg for an unknown accelerometer; ten times as much counts as motion."""

TYPICAL_BIAS_MG = 50.0
"""Estimate of an unknown accelerometer's bias in mg; consumer parts state 20 to 100 mg."""

PATIENCE_S = 5.0
"""Shortest time in s without a scan after which a device counts as silent."""

NO_FAULTS = "the sensor reports no errors or alarms, so a fault within a dwell is not detected"
"""Text for the user: IIO has no common interface for errors and alarms."""

_OPTIONS = ("poll", "rate")
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
        self.channels = choose_channels(device.channels, url)
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

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of a session that the blocks of samples have, in order."""
        return tuple(channel.column for channel in self.channels)

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

    def _values(self, numbers: Mapping[str, Any], time_s: Floats, lost: int) -> ValueBlock:
        channels = self._source.channels
        data = np.column_stack([channel.values(np.asarray(numbers[channel.id])) for channel in channels])
        return ValueBlock(self._source.columns, data, time_s, lost)


class BufferedSamples(IioStream):
    """Stream of scans that the device takes by its own clock and buffers."""

    def __init__(self, source: IioSource, block_samples: int) -> None:
        super().__init__(source, block_samples)
        stamp = source._time
        self._stamped = stamp is not None
        self.how = "scans by the device's own clock; " + (
            "lost ones show in their times" if stamp else "it gives no times, so lost ones cannot be seen"
        )
        self._first_ns: int | None = None
        self._last_ns: int | None = None
        self._begin_s = 0.0
        self._count = 0
        channels = [*source.channels, *([stamp] if stamp else [])]
        self._device.open_buffer(
            channels, block_samples, max(PATIENCE_S, 3 * block_samples * self._period_s)
        )

    def _next(self) -> ValueBlock:
        numbers = self._device.read_buffer()
        count = len(numbers[self._source.channels[0].id])
        if self._count == 0:
            self._begin_s = self._source.now_s() - count * self._period_s
        if self._stamped:
            time_s, lost = self._times(numbers[TIMESTAMP])
        else:
            places = np.arange(self._count, self._count + count, dtype=np.float64)
            time_s, lost = np.asarray(self._begin_s + self._period_s * places, np.float64), 0
        self._count += count
        return self._values(numbers, time_s, lost)

    def _times(self, stamps_ns: np.ndarray) -> tuple[Floats, int]:
        """Convert time stamps (n,) in ns to times on the source's clock in s, and count missing samples.

        Raises
        ------
        ProtocolError
            The time stamps do not increase.
        """
        if self._first_ns is None:
            self._first_ns = int(stamps_ns[0])
        before = stamps_ns[:1] if self._last_ns is None else np.array([self._last_ns])
        steps_s = np.diff(np.concatenate([before, stamps_ns])) * 1e-9
        # The first sample of a stream has no step before it.
        if (steps_s[1:] <= 0).any() or (self._last_ns is not None and steps_s[0] <= 0):
            raise ProtocolError(
                f"{self._source.url}: the times of the scans go back: let its current_timestamp_clock be"
                " monotonic"
            )
        self._last_ns = int(stamps_ns[-1])
        lost = int(np.maximum(np.rint(steps_s / self._period_s) - 1, 0).sum())
        since_s = (stamps_ns - self._first_ns).astype(np.float64) * 1e-9
        return np.asarray(self._begin_s + since_s, np.float64), lost

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
            rows.append([self._device.read_raw(channel.id) for channel in source.channels])
            behind = math.floor(max(0.0, (source.now_s() - self._due_s) / self._period_s - 1))
            lost += behind
            self._due_s += (1 + behind) * self._period_s
        columns = np.array(rows).T
        numbers = {channel.id: columns[k] for k, channel in enumerate(source.channels)}
        return self._values(numbers, np.array(times), lost)


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
    UrlOptions(url, _OPTIONS)  # refuses other options
    poll_hz, rate_hz = (_hertz(url, name) for name in ("poll", "rate"))
    context, name = LOCAL, url.place
    if url.place.startswith("ip:"):
        found = _NETWORK.fullmatch(url.place)
        if found is None or not 0 < int(found["port"] or PORT) < 1 << 16:
            raise UsageError(f"'{url.text}': write iio:ip:HOST/DEVICE or iio:ip:HOST:PORT/DEVICE")
        context, name = f"ip:{found['host']}:{found['port'] or PORT}", found["device"] or ""
    device = IioDevice(f"iio:{url.place}", context, name)
    try:
        return IioSource(url.text, device, poll_hz=poll_hz, rate_hz=rate_hz)
    except AdisGonioError:
        device.close()
        raise


def find_devices() -> list[Device]:
    """List the accelerometers of this machine; devices of other machines have to be named by address."""
    return [
        Device(f"iio:{name.removeprefix('iio:')}", f"IIO accelerometer {label}: samples, no registers")
        for name, label in local_accelerometers()
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
