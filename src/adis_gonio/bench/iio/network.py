"""An IIO device of another machine, by the text protocol of iiod (libiio 0.x)."""

from __future__ import annotations

import contextlib
import math
import socket
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping

from adis_gonio.base.errors import BusClosedError, BusTimeoutError, CannotOpenError, ProtocolError
from adis_gonio.bench.iio.channels import IioChannel, SampleFormat, number_of
from adis_gonio.bench.iio.device import DeviceFacts

PORT = 30431
"""iiod's port."""

TIMEOUT_S = 5.0
LINE_LIMIT = 1024
_RECEIVED = 1 << 16
_SHORTEST_WAIT_S = 1e-6
XML_LIMIT = 1 << 22
"""A context of hundreds of devices is smaller."""

_ERRNO = {1: "not permitted", 2: "no such attribute", 5: "input/output error", 13: "permission denied"}
_ERRNO |= {16: "busy", 19: "no such device", 22: "invalid", 110: "timed out"}
BUSY = -16


class NetworkDevice:
    """A device behind an iiod server.

    Parameters
    ----------
    host, port
        The server.
    name : str
        Id or name of the device; empty takes the only accelerometer of three axes.

    Raises
    ------
    CannotOpenError
        No server answers there, it has no such device, or more than one where no name is given.
    ProtocolError, BusTimeoutError
        The server answers, but not as iiod does.
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
            with self._within(timeout_s):
                self._element = self._find(name)
                self._id = self._element.get("id", "")
                self._ask(f"TIMEOUT {round(timeout_s * 1000)}")
        except BaseException:
            self.close()
            raise

    # -- what there is ----------------------------------------------------------------------------

    def facts(self) -> DeviceFacts:
        """Read what the device says of itself."""
        with self._within(self._timeout_s):
            return self._facts()

    def _facts(self) -> DeviceFacts:
        rate = self._attributes_named(self._element, "", ("sampling_frequency",))
        channels = []
        for element in self._element.findall("channel"):
            if element.get("type") != "input":
                continue
            attributes = self._attributes_named(
                element, f"INPUT {element.get('id')} ", ("scale", "offset", "sampling_frequency")
            )
            if element.get("id", "").startswith("accel"):
                rate = rate or {k: v for k, v in attributes.items() if k == "sampling_frequency"}
            channels.append(self._channel(element, attributes))
        hz = number_of(rate, "sampling_frequency", 0.0, self.where)
        name = self._element.get("name") or self._id
        return DeviceFacts(self._id, name, tuple(channels), hz or None)

    def _channel(self, element: ET.Element, attributes: Mapping[str, str]) -> IioChannel:
        label = element.get("name")
        name = element.get("id", "") + (f"_{label}" if label else "")
        scan = element.find("scan-element")
        scale = number_of(attributes, "scale", 1.0, self.where)
        offset = number_of(attributes, "offset", 0.0, self.where)
        if scan is None:
            return IioChannel(name, scale=scale, offset=offset)
        index = number_of(dict(scan.items()), "index", -1, self.where)
        return IioChannel(name, int(index), SampleFormat.parse(scan.get("format", "")), scale, offset)

    def _attributes_named(self, element: ET.Element, prefix: str, names: tuple[str, ...]) -> dict[str, str]:
        there = {attribute.get("name") for attribute in element.findall("attribute")}
        return {name: self._read(f"{prefix}{name}") for name in names if name in there}

    def _find(self, name: str) -> ET.Element:
        content = self._counted("PRINT", XML_LIMIT)
        try:
            # Entities are not needed and could expand without end.
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
        """Present raw number of a channel."""
        with self._within(self._timeout_s):
            text = self._read(f"INPUT {self._id_of(channel)} raw")
        return number_of({"raw": text}, "raw", 0.0, self.where)

    def _id_of(self, channel: str) -> str:
        """Id in requests; a label is no part of it."""
        for element in self._element.findall("channel"):
            if channel in (element.get("id"), f"{element.get('id')}_{element.get('name')}"):
                return element.get("id", "")
        return channel

    # -- the buffer -------------------------------------------------------------------------------

    def open_buffer(self, channels: tuple[IioChannel, ...], samples: int) -> None:
        """Begin to buffer scans of these channels."""
        order = [element.get("id", "") for element in self._element.findall("channel")]
        bits = sum(1 << order.index(self._id_of(channel.id)) for channel in channels)
        words = -(-len(order) // 32)
        self._mask = f"{bits:0{8 * words}x}"
        with self._within(self._timeout_s):
            answer = self._number(f"OPEN {self._id} {samples} {self._mask}")
        if answer < 0:
            hint = "; another program reads it" if answer == BUSY else "; ?poll=HZ reads single values"
            raise CannotOpenError(f"{self.where}: the buffer cannot be opened: {_words(answer)}{hint}")
        self._buffered = True

    def read_buffer(self, size: int, timeout_s: float) -> bytes:
        """Read `size` bytes of whole scans."""
        with self._within(max(timeout_s, self._timeout_s)):
            data, length = b"", self._number(f"READBUF {self._id} {size}")
            while length > 0:
                if not data and (mask := self._line()).lower() != self._mask:
                    raise ProtocolError(f"{self.where}: scans of mask {mask} where {self._mask} was asked")
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
            # A break in the middle of an answer leaves bytes behind: only the connection's end is sure.
            with (
                contextlib.suppress(BusTimeoutError, ProtocolError, BusClosedError),
                self._within(self._timeout_s),
            ):
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

    def _number(self, line: str) -> int:
        with self._typed():
            self._socket.sendall(f"{line}\r\n".encode())
        return self._integer()

    def _integer(self) -> int:
        line = self._line()
        try:
            return int(line)
        except ValueError:
            raise ProtocolError(f"{self.where}: '{line[:40]}' where a number is expected") from None

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
        """Wait for more bytes, until the operation's deadline."""
        with self._typed():
            data = self._socket.recv(_RECEIVED)
        if not data:
            raise ProtocolError(f"{self.where}: the server has ended the connection")
        self._received += data

    @contextlib.contextmanager
    def _within(self, seconds: float) -> Iterator[None]:
        """Give an operation one deadline, however many requests and bytes it takes."""
        self._deadline_s = time.monotonic() + seconds
        try:
            yield
        finally:
            self._deadline_s = math.inf

    @contextlib.contextmanager
    def _typed(self) -> Iterator[None]:
        """Use the socket for the time that the operation has left; errors are of this package."""
        try:
            # A time-out of 0 would mean a socket that does not wait at all.
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
