"""IIO devices: their channels, and access to devices of this machine or by network through libiio 0.x.

value = (raw + offset) * scale, in m/s², rad/s, milli-degree Celsius, millivolt. Source: the kernel's
Documentation/ABI/testing/sysfs-bus-iio.
"""

from __future__ import annotations

import contextlib
import math
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import (
    BusClosedError,
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    install_extra,
)
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

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

    def values(self, numbers: np.ndarray) -> Floats:
        """Convert raw numbers (n,) to values (n,) in the column's unit: mg, °/s, °C, V."""
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
    missing = [name for name in ACCELS if name not in found]
    if missing:
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


class IioDevice:
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


def local_accelerometers() -> list[tuple[str, str]]:
    """Return id and name of each accelerometer with three axes on this machine."""
    return [(one.id, one.name or one.id) for one in _devices(LOCAL) if _fits(one, "")]


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
