"""IIO devices: their channels and sample formats, and access to devices of this machine or by network.

A format is written `[be|le]:[s|u]BITS/STORAGE[Xrepeat]>>SHIFT`; a capital letter means that the number
fills its storage. value = (raw + offset) * scale, in m/s², rad/s, milli-degree Celsius, millivolt. Source:
the kernel's Documentation/ABI/testing/sysfs-bus-iio.

A local device has attributes in sysfs and scans in /dev: `in_accel_x_raw`, `in_accel_scale` (shared by a
kind) or `in_accel_x_scale`, `scan_elements/in_accel_x_en|_index|_type`, `buffer/enable`, `buffer/length`.
While a buffer is open, other channels are disabled; when it is closed, all attributes are restored. A
device of another machine is read by the text protocol of iiod (libiio 0.x).
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import socket
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import (
    BusClosedError,
    BusTimeoutError,
    CannotOpenError,
    ProtocolError,
    UsageError,
)
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

_FORMAT = re.compile(r"(be|le):([suSU])(\d+)/(\d+)(?:[Xx](\d+))?>>(\d+)")

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
class SampleFormat:
    """Storage format of a channel's samples in a scan, as IIO describes it.

    Attributes
    ----------
    big_endian, signed : bool
        Byte order of the stored word, and True if the number is signed.
    bits, storage : int
        Number of bits of the number, and of the stored word.
    shift : int
        Number of bits of the word below the number.
    """

    big_endian: bool
    signed: bool
    bits: int
    storage: int
    shift: int

    @classmethod
    def parse(cls, text: str) -> SampleFormat:
        """Parse the text of a format, such as `le:s12/16>>4`.

        Raises
        ------
        CannotOpenError
            The text is not a format, or an unsupported one (repeated or odd-sized samples).
        """
        found = _FORMAT.fullmatch(text.strip())
        if found is None:
            raise CannotOpenError(f"'{text}' is no format of an IIO sample")
        end, sign, bits, storage, repeat, shift = found.groups()
        parsed = cls(end == "be", sign in "sS", int(bits), int(storage), int(shift))
        whole = parsed.storage in (8, 16, 32, 64) and parsed.bits > 0
        if not whole or parsed.bits + parsed.shift > parsed.storage or repeat not in (None, "1"):
            raise CannotOpenError(f"'{text}': samples of this format are not read")
        return parsed

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """Data type of the stored word in numpy."""
        return np.dtype(f"{'>' if self.big_endian else '<'}u{self.storage // 8}")

    def numbers(self, words: np.ndarray) -> np.ndarray:
        """Convert stored words (n,) to numbers (n,) int64: shifted, masked, sign extended."""
        left = 64 - self.bits - self.shift
        wide = words.astype(np.uint64) << np.uint64(left)
        down = np.uint64(64 - self.bits)
        return wide.view(np.int64) >> np.int64(down) if self.signed else (wide >> down).astype(np.int64)


@dataclass(frozen=True)
class IioChannel:
    """A channel of an IIO device, with its scale and its place in a scan.

    Attributes
    ----------
    id : str
        Name such as `accel_x`, or with the label in the name of the kernel's file, `voltage0_supply`.
    index : int
        Place of its sample in a scan; −1 if the channel cannot be buffered.
    format : SampleFormat or None
        Storage format of its samples; None if the channel cannot be buffered.
    scale, offset : float
        Conversion of a raw number to IIO's unit: value = (raw + offset) * scale.
    """

    id: str
    index: int = -1
    format: SampleFormat | None = None
    scale: float = 1.0
    offset: float = 0.0

    @property
    def column(self) -> str:
        """Column of a session in which the channel is recorded; empty if there is none."""
        return COLUMNS.get(self.id, ("", 0.0))[0]

    def values(self, numbers: np.ndarray) -> Floats:
        """Convert raw numbers (n,) to values (n,) in the column's unit: mg, °/s, °C, V."""
        factor = COLUMNS[self.id][1] * self.scale
        values: Floats = (numbers + self.offset) * factor
        return values


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
    gyros = [column for column in ("gx", "gy", "gz") if column in chosen]
    if len(gyros) < 3:
        for column in gyros:
            del chosen[column]
    return tuple(chosen.values())


def aligned_dtype(samples: Mapping[str, DTypeLike]) -> np.dtype[np.void]:
    """Return the type of a scan with these samples in order, in the layout of the kernel and libiio.

    Each sample begins at a multiple of its size, and the size of a scan is a multiple of its largest
    sample. `samples` has the type of each sample by the name of its channel.
    """
    formats = [np.dtype(one) for one in samples.values()]
    offsets, end = [], 0
    for one in formats:
        offsets.append(end + -end % one.itemsize)
        end = offsets[-1] + one.itemsize
    size = end + -end % max(one.itemsize for one in formats)
    return np.dtype({"names": list(samples), "formats": formats, "offsets": offsets, "itemsize": size})


class BufferLayout:
    """Positions of the samples of enabled channels in a scan, ordered by the index of their channel.

    Attributes
    ----------
    channels : tuple of IioChannel
        Channels in the order of a scan.
    size : int
        Size of a scan in bytes.
    """

    def __init__(self, channels: Sequence[IioChannel]) -> None:
        self.channels = tuple(sorted(channels, key=lambda channel: channel.index))
        samples: dict[str, DTypeLike] = {}
        for channel in self.channels:
            if channel.format is None or channel.index < 0:
                raise UsageError(f"{channel.id} cannot be buffered")
            samples[channel.id] = channel.format.dtype
        self._dtype = aligned_dtype(samples)
        self.size = self._dtype.itemsize

    def numbers(self, data: bytes) -> dict[str, np.ndarray]:
        """Decode the bytes of n whole scans: numbers (n,) int64 by the channel's name."""
        scans = np.frombuffer(data, self._dtype)
        return {
            channel.id: channel.format.numbers(scans[channel.id])
            for channel in self.channels
            if channel.format is not None
        }


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


def channel_of(name: str, texts: Mapping[str, str | None], where: str) -> IioChannel:
    """Make a channel from the texts of its attributes `scale`, `offset`, `index` and `format`.

    An attribute that is missing or None has a default. `name` is the channel's name, `where` names the
    device in error messages.
    """
    scale = parse_number(texts.get("scale"), "scale", 1.0, where)
    offset = parse_number(texts.get("offset"), "offset", 0.0, where)
    index = int(parse_number(texts.get("index"), "index", -1, where))
    form = texts.get("format")
    if index < 0 or form is None:
        return IioChannel(name, scale=scale, offset=offset)
    return IioChannel(name, index, SampleFormat.parse(form), scale, offset)


TIMESTAMP = "timestamp"


@dataclass(frozen=True)
class DeviceFacts:
    """Facts of a device, read when it is opened.

    Attributes
    ----------
    id, name : str
        Id and name of the device, such as `iio:device0` and `adxl345`.
    channels : tuple of IioChannel
        Input channels, with the timestamp if there is one.
    rate_hz : float or None
        Sample rate in Hz; None if the device does not state it.
    """

    id: str
    name: str
    channels: tuple[IioChannel, ...]
    rate_hz: float | None


SYSFS = Path("sys/bus/iio/devices")
DEV = Path("dev")

_FILE = re.compile(r"in_(?P<id>[a-z]+\d*(?:_[a-z0-9]+)*)_(?P<what>raw|type)$")


class LocalDevice:
    """An IIO device of this machine, below /sys/bus/iio/devices.

    Parameters
    ----------
    name : str
        Id such as `iio:device0` or `device0`, or the name in the device's attribute `name`; empty takes the
        only accelerometer.
    root : path
        Folder with /sys and /dev; another folder than / is for containers and tests.

    Raises
    ------
    CannotOpenError
        There is no such device or more than one, or it cannot be read.
    """

    def __init__(self, name: str, root: Path = Path("/")) -> None:
        self.where = f"iio:{name}"
        self._folder = _find(self.where, name, root)
        self._node = root / DEV / self._folder.name
        self._descriptor: int | None = None
        self._found: list[tuple[Path, str]] = []

    def facts(self) -> DeviceFacts:
        """Read the name, the channels and the rate of the device."""
        files = {path.name for path in self._folder.iterdir()}
        scans = self._folder / "scan_elements"
        if scans.is_dir():
            files |= {path.name for path in scans.iterdir()}
        names = sorted({found["id"] for file in files if (found := _FILE.fullmatch(file))})
        channels = tuple(self._channel(name) for name in names)
        rates = (self._text(f"{kind}sampling_frequency") for kind in ("", "in_accel_", "in_accel_x_"))
        rate = next((text for text in rates if text is not None), None)
        hz = parse_number(rate, "sampling_frequency", 0.0, self.where)
        return DeviceFacts(self._folder.name, _name_of(self._folder), channels, hz or None)

    def _channel(self, name: str) -> IioChannel:
        kind = re.match(r"[a-z]+", name)
        shared = kind[0] if kind else name
        texts = {
            "scale": self._text(f"in_{name}_scale") or self._text(f"in_{shared}_scale"),
            "offset": self._text(f"in_{name}_offset") or self._text(f"in_{shared}_offset"),
            "index": self._text(f"scan_elements/in_{name}_index"),
            "format": self._text(f"scan_elements/in_{name}_type"),
        }
        return channel_of(name, texts, self.where)

    def read_raw(self, channel: str) -> float:
        """Read the present raw number of a channel."""
        text = self._text(f"in_{channel}_raw")
        if text is None:
            raise ProtocolError(f"{self.where}: in_{channel}_raw cannot be read")
        return parse_number(text, "raw", 0.0, self.where)

    # -- the buffer -------------------------------------------------------------------------------

    def open_buffer(self, channels: tuple[IioChannel, ...], samples: int) -> None:
        """Start to buffer scans of these channels; the buffer has room for `samples` scans.

        Raises
        ------
        CannotOpenError
            The buffer is in use or cannot be opened.
        """
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
        """Wait for bytes for at most `timeout_s`, then read the available bytes, at most `size`."""
        if self._descriptor is None:
            raise ProtocolError(f"{self.where}: no buffer is open")
        ready, _, _ = select.select([self._descriptor], [], [], timeout_s)
        if not ready:
            if not self._folder.exists():  # the kernel does not wake a reader when a device is removed
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
        """End buffering and restore the changed attributes; may be called twice."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None
        # In reverse order: while the buffer is enabled, no other attribute can be changed.
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
        """Read the text of the attribute in the file `name`; None if it is missing or cannot be read."""
        try:
            return (self._folder / name).read_text()
        except OSError:
            return None


def local_accelerometers(root: Path = Path("/")) -> list[tuple[str, str]]:
    """Return id and name of each accelerometer with three axes on this machine.

    `root` is the folder with /sys and /dev.
    """
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


PORT = 30431
"""TCP port on which iiod listens."""

TIMEOUT_S = 5.0
LINE_LIMIT = 1024
_RECEIVED = 1 << 16
_SHORTEST_WAIT_S = 1e-6
XML_LIMIT = 1 << 22
"""Largest size in bytes of the XML that describes a server's devices; hundreds of devices need less."""

_ERRNO = {1: "not permitted", 2: "no such attribute", 5: "input/output error", 13: "permission denied"}
_ERRNO |= {16: "busy", 19: "no such device", 22: "invalid", 110: "timed out"}
BUSY = -16


class NetworkDevice:
    """An IIO device of another machine, read through its iiod server.

    Parameters
    ----------
    host, port : str, int
        Address of the server.
    name : str
        Id or name of the device; empty takes the only accelerometer of three axes.
    timeout_s : float
        Longest time for the answer to a request in s.

    Raises
    ------
    CannotOpenError
        No server answers, it has no such device, or it has several and no name is given.
    ProtocolError, BusTimeoutError
        The server does not speak the protocol of iiod.
    """

    def __init__(self, host: str, port: int, name: str, timeout_s: float = TIMEOUT_S) -> None:
        self.where = f"iio:ip:{host}:{port}/{name}"
        self._buffered = False
        self._mask = ""
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except OSError as error:
            why = "no answer" if isinstance(error, TimeoutError) else error.strerror or str(error)
            raise CannotOpenError(
                f"{self.where}: {why}: is iiod or adis-gonio serve running there?"
            ) from error
        self._received = bytearray()
        self._timeout_s = timeout_s
        self._deadline_s = math.inf
        try:
            self._element = self._find(name)
            self._id = self._element.get("id", "")
            self._ask(f"TIMEOUT {round(timeout_s * 1000)}")
        except BaseException:
            self.close()
            raise

    # -- the device -------------------------------------------------------------------------------

    def facts(self) -> DeviceFacts:
        """Read the name, the channels and the rate of the device."""
        rate = self._attributes_named(self._element, "", ("sampling_frequency",)).get("sampling_frequency")
        channels = []
        for element in self._element.findall("channel"):
            if element.get("type") != "input":
                continue
            attributes = self._attributes_named(
                element, f"INPUT {element.get('id')} ", ("scale", "offset", "sampling_frequency")
            )
            if element.get("id", "").startswith("accel"):
                rate = rate or attributes.get("sampling_frequency")
            channels.append(self._channel(element, attributes))
        hz = parse_number(rate, "sampling_frequency", 0.0, self.where)
        name = self._element.get("name") or self._id
        return DeviceFacts(self._id, name, tuple(channels), hz or None)

    def _channel(self, element: ET.Element, attributes: Mapping[str, str]) -> IioChannel:
        label = element.get("name")
        name = element.get("id", "") + (f"_{label}" if label else "")
        scan = element.find("scan-element")
        buffered = {} if scan is None else {"format": "", **dict(scan.items())}
        return channel_of(name, {**attributes, **buffered}, self.where)

    def _attributes_named(self, element: ET.Element, prefix: str, names: tuple[str, ...]) -> dict[str, str]:
        there = {attribute.get("name") for attribute in element.findall("attribute")}
        return {name: self._read(f"{prefix}{name}") for name in names if name in there}

    def _find(self, name: str) -> ET.Element:
        content = self._counted("PRINT", XML_LIMIT)
        try:
            # Entities are not needed and may expand without limit.
            if b"<!ENTITY" in content:
                raise ProtocolError(f"{self.where}: the context's XML has entities")
            context = ET.fromstring(content.decode("utf-8"))
        except (ET.ParseError, UnicodeDecodeError) as error:
            raise ProtocolError(f"{self.where}: the context is no XML: {error}") from error
        devices = context.findall("device")
        if name:
            found = [d for d in devices if name in (d.get("id"), d.get("name"), d.get("label"))]
        else:
            found = [d for d in devices if _accelerometer(d)]
        if len(found) == 1:
            return found[0]
        there = ", ".join(f"{d.get('id')} ({d.get('name')})" for d in devices) or "none"
        what = "more than one device fits" if found else "no such device"
        raise CannotOpenError(f"{self.where}: {what}; there are: {there}")

    def read_raw(self, channel: str) -> float:
        """Read the present raw number of a channel."""
        return parse_number(self._read(f"INPUT {self._id_of(channel)} raw"), "raw", 0.0, self.where)

    def _id_of(self, channel: str) -> str:
        """Return the id by which the server knows a channel, such as `voltage0` for `voltage0_supply`."""
        for element in self._element.findall("channel"):
            if channel in (element.get("id"), f"{element.get('id')}_{element.get('name')}"):
                return element.get("id", "")
        return channel

    # -- the buffer -------------------------------------------------------------------------------

    def open_buffer(self, channels: tuple[IioChannel, ...], samples: int) -> None:
        """Start to buffer scans of these channels; the buffer has room for `samples` scans.

        Raises
        ------
        CannotOpenError
            The server refuses to open the buffer.
        """
        order = [element.get("id", "") for element in self._element.findall("channel")]
        bits = sum(1 << order.index(self._id_of(channel.id)) for channel in channels)
        words = -(-len(order) // 32)
        self._mask = f"{bits:0{8 * words}x}"
        answer = self._number(f"OPEN {self._id} {samples} {self._mask}")
        if answer < 0:
            hint = "; another program reads it" if answer == BUSY else "; ?poll=HZ reads single values"
            raise CannotOpenError(f"{self.where}: the buffer cannot be opened: {_words(answer)}{hint}")
        self._buffered = True

    def read_buffer(self, size: int, timeout_s: float) -> bytes:
        """Read `size` bytes of whole scans; `timeout_s` is the longest time for it."""
        data, length = b"", self._number(f"READBUF {self._id} {size}", max(timeout_s, self._timeout_s))
        while length > 0:
            if not data and (mask := self._line()).lower() != self._mask:
                raise ProtocolError(f"{self.where}: scans of mask {mask} instead of {self._mask}")
            data += self._exactly(min(length, size))
            if len(data) >= size:
                return data
            length = self._integer()
        if length == 0 and data:
            return data
        raise (BusTimeoutError if length == -110 else ProtocolError)(
            f"{self.where}: no scans: {_words(length)}"
        )

    def close_buffer(self) -> None:
        """End buffering; may be called twice."""
        if self._buffered:
            self._buffered = False
            # After an interrupted answer the remaining bytes are lost; then only closing the connection
            # works.
            with contextlib.suppress(BusTimeoutError, ProtocolError, BusClosedError):
                self._number(f"CLOSE {self._id}")

    def close(self) -> None:
        """End the connection; may be called twice."""
        self._socket.close()

    # -- the protocol -----------------------------------------------------------------------------

    def _read(self, what: str) -> str:
        return self._counted(f"READ {self._id} {what}", 1 << 16).rstrip(b"\0").decode("utf-8", "replace")

    def _ask(self, line: str) -> int:
        answer = self._number(line)
        if answer < 0:
            raise ProtocolError(f"{self.where}: '{line}' is answered by {_words(answer)}")
        return answer

    def _counted(self, line: str, limit: int) -> bytes:
        length = self._ask(line)
        if length > limit:
            raise ProtocolError(f"{self.where}: an answer of {length} bytes to '{line}'")
        return self._exactly(length + 1)[:-1]

    def _number(self, line: str, timeout_s: float | None = None) -> int:
        """Send the request `line` and return the number that the server answers.

        The whole answer, with the bytes after this number, must come within `timeout_s` (None: the time
        limit of the device).
        """
        self._deadline_s = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        with self._typed():
            self._socket.sendall(f"{line}\r\n".encode())
        return self._integer()

    def _integer(self) -> int:
        line = self._line()
        try:
            return int(line)
        except ValueError:
            raise ProtocolError(f"{self.where}: expected a number, not '{line[:40]}'") from None

    def _line(self) -> str:
        while (end := self._received.find(b"\n")) < 0:
            if len(self._received) > LINE_LIMIT:
                raise ProtocolError(f"{self.where}: a line of more than {LINE_LIMIT} bytes")
            self._receive()
        return self._taken(end + 1).decode("ascii", "replace").strip()

    def _exactly(self, size: int) -> bytes:
        while len(self._received) < size:
            self._receive()
        return self._taken(size)

    def _taken(self, size: int) -> bytes:
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    def _receive(self) -> None:
        """Wait for more bytes from the server, at most until the deadline of the operation."""
        with self._typed():
            data = self._socket.recv(_RECEIVED)
        if not data:
            raise ProtocolError(f"{self.where}: the server has ended the connection")
        self._received += data

    @contextlib.contextmanager
    def _typed(self) -> Iterator[None]:
        """Context for the use of the socket: sets the remaining time, and converts errors to `BusError`."""
        try:
            # A time-out of 0 would make the socket non-blocking.
            self._socket.settimeout(max(self._deadline_s - time.monotonic(), _SHORTEST_WAIT_S))
            yield
        except TimeoutError as error:
            raise BusTimeoutError(f"{self.where}: the server does not answer") from error
        except OSError as error:
            if self._socket.fileno() < 0:
                raise BusClosedError(f"{self.where}: used after it was closed") from error
            raise ProtocolError(f"{self.where}: {error.strerror or error}") from error


def _accelerometer(element: ET.Element) -> bool:
    ids = {channel.get("id") for channel in element.findall("channel") if channel.get("type") == "input"}
    return {"accel_x", "accel_y", "accel_z"} <= ids


def _words(answer: int) -> str:
    return f"error {-answer} ({_ERRNO.get(-answer, 'see errno.h')})" if answer < 0 else "nothing"


IioDevice = LocalDevice | NetworkDevice
"""A device that can be read; every method raises `BusError` on failure."""
