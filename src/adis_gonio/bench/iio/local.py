"""An IIO device of this machine: its attributes in sysfs, its scans from /dev (Linux).

Layout by the kernel's ABI (Documentation/ABI/testing/sysfs-bus-iio): `in_accel_x_raw`, `in_accel_scale`
(shared by a kind) or `in_accel_x_scale`, `scan_elements/in_accel_x_en|_index|_type`, `buffer/enable`,
`buffer/length`. While a buffer is open other channels are disabled; at its end all is set back.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
from pathlib import Path

from adis_gonio.base.errors import BusTimeoutError, CannotOpenError, ProtocolError
from adis_gonio.bench.iio.channels import ACCELS, IioChannel, SampleFormat, number_of
from adis_gonio.bench.iio.device import DeviceFacts

SYSFS = Path("sys/bus/iio/devices")
DEV = Path("dev")

_FILE = re.compile(r"in_(?P<id>[a-z]+\d*(?:_[a-z0-9]+)*)_(?P<what>raw|type)$")


class LocalDevice:
    """A device below /sys/bus/iio/devices.

    Parameters
    ----------
    name : str
        `iio:device0`, `device0`, or the name in its attribute `name`; empty takes the only accelerometer.
    root : path
        Where /sys and /dev are; another one than / is for containers and tests.

    Raises
    ------
    CannotOpenError
        No such device, more than one, or it cannot be read.
    """

    def __init__(self, name: str, root: Path = Path("/")) -> None:
        self.where = f"iio:{name}"
        self._folder = _find(self.where, name, root)
        self._node = root / DEV / self._folder.name
        self._descriptor: int | None = None
        self._found: list[tuple[Path, str]] = []

    def facts(self) -> DeviceFacts:
        """Read what the device says of itself."""
        files = {path.name for path in self._folder.iterdir()}
        scans = self._folder / "scan_elements"
        if scans.is_dir():
            files |= {path.name for path in scans.iterdir()}
        names = sorted({found["id"] for file in files if (found := _FILE.fullmatch(file))})
        channels = tuple(self._channel(name) for name in names)
        rate: dict[str, str] = {}
        for file in ("sampling_frequency", "in_accel_sampling_frequency", "in_accel_x_sampling_frequency"):
            if not rate and (text := self._text(file)) is not None:
                rate["sampling_frequency"] = text
        hz = number_of(rate, "sampling_frequency", 0.0, self.where)
        return DeviceFacts(self._folder.name, _name_of(self._folder), channels, hz or None)

    def _channel(self, name: str) -> IioChannel:
        kind = re.match(r"[a-z]+", name)
        shared = kind[0] if kind else name
        attributes = {
            what: text
            for what in ("scale", "offset")
            for text in [self._text(f"in_{name}_{what}") or self._text(f"in_{shared}_{what}")]
            if text is not None
        }
        scale = number_of(attributes, "scale", 1.0, self.where)
        offset = number_of(attributes, "offset", 0.0, self.where)
        kind_text = self._text(f"scan_elements/in_{name}_type")
        index_text = self._text(f"scan_elements/in_{name}_index")
        if kind_text is None or index_text is None:
            return IioChannel(name, scale=scale, offset=offset)
        index = number_of({"index": index_text}, "index", -1, self.where)
        return IioChannel(name, int(index), SampleFormat.parse(kind_text), scale, offset)

    def read_raw(self, channel: str) -> float:
        """Present raw number of a channel."""
        text = self._text(f"in_{channel}_raw")
        if text is None:
            raise ProtocolError(f"{self.where}: in_{channel}_raw cannot be read")
        return number_of({"raw": text}, "raw", 0.0, self.where)

    # -- the buffer -------------------------------------------------------------------------------

    def open_buffer(self, channels: tuple[IioChannel, ...], samples: int) -> None:
        """Begin to buffer scans of these channels."""
        if (self._text("buffer/enable") or "0").strip() == "1":
            raise CannotOpenError(f"{self.where}: its buffer is in use by another program")
        chosen = {f"in_{channel.id}_en" for channel in channels}
        try:
            for path in sorted((self._folder / "scan_elements").glob("*_en")):
                self._set(path, "1" if path.name in chosen else "0")
            self._set(self._folder / "buffer" / "length", str(samples))
            self._set(self._folder / "buffer" / "enable", "1")
            self._descriptor = os.open(self._node, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            self.close_buffer()
            raise CannotOpenError(
                f"{self.where}: the buffer cannot be opened: {error.filename or self._node}:"
                f" {error.strerror or error}{_hint(error)}"
            ) from error

    def read_buffer(self, size: int, timeout_s: float) -> bytes:
        """At most `size` bytes, as many as are there; waits for the first ones."""
        if self._descriptor is None:
            raise ProtocolError(f"{self.where}: no buffer is open")
        ready, _, _ = select.select([self._descriptor], [], [], timeout_s)
        if not ready:
            if not self._folder.exists():  # the kernel wakes no reader when a device is pulled out
                raise ProtocolError(f"{self.where}: the device is gone")
            raise BusTimeoutError(f"{self.where}: no scan in {timeout_s:.3g} s: is its trigger running?")
        try:
            data = os.read(self._descriptor, size)
        except BlockingIOError:
            return b""
        except OSError as error:
            raise ProtocolError(f"{self.where}: {self._node}: {error.strerror or error}") from error
        if not data:
            raise ProtocolError(f"{self.where}: {self._node} has ended: the device is gone")
        return data

    def close_buffer(self) -> None:
        """End buffering and set the attributes back; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        # The last first: while the buffer is enabled nothing else can be changed.
        while self._found:
            path, before = self._found.pop()
            with contextlib.suppress(OSError):
                path.write_text(before)

    def close(self) -> None:
        """End buffering."""
        self.close_buffer()

    def _set(self, path: Path, value: str) -> None:
        before = path.read_text().strip()
        if before != value:
            path.write_text(value)
            self._found.append((path, before))

    def _text(self, name: str) -> str | None:
        """Text of an attribute; None where it is missing or says nothing."""
        try:
            return (self._folder / name).read_text()
        except OSError:
            return None


def local_accelerometers(root: Path = Path("/")) -> list[tuple[str, str]]:
    """Id and name of the accelerometers of three axes of this machine."""
    return [(folder.name, _name_of(folder)) for folder in _folders(root) if _is_accelerometer(folder)]


def _folders(root: Path) -> list[Path]:
    folder = root / SYSFS
    return sorted(folder.glob("iio:device*")) if folder.is_dir() else []


def _find(where: str, name: str, root: Path) -> Path:
    folders = _folders(root)
    if name:
        found = [f for f in folders if name in (f.name, f.name.removeprefix("iio:"), _name_of(f))]
    else:
        found = [f for f in folders if _is_accelerometer(f)]
    if len(found) == 1:
        return found[0]
    there = ", ".join(f"{f.name} ({_name_of(f)})" for f in folders) or "none"
    what = "more than one device fits" if found else "no such IIO device"
    raise CannotOpenError(f"{where}: {what} on this machine; there are: {there}")


def _is_accelerometer(folder: Path) -> bool:
    return all(
        (folder / f"in_{axis}_raw").exists() or (folder / "scan_elements" / f"in_{axis}_en").exists()
        for axis in ACCELS
    )


def _name_of(folder: Path) -> str:
    try:
        return (folder / "name").read_text().strip()
    except OSError:
        return folder.name


def _hint(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "; the user needs leave to write there, or add ?poll=HZ to read single values"
    return "; does it need a trigger (trigger/current_trigger)? Or add ?poll=HZ to read single values"
