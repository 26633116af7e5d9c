r"""The text protocol of iiod, the server of libiio 0.x, without any I/O.

A client sends lines; some are followed by a counted number of bytes. `Parser` takes bytes in any pieces and
returns typed requests; the functions at the end format the answers. A numeric answer is one line; a
negative number is `-errno` of Linux on every operating system.

| request | answer |
|---|---|
| `VERSION` | a line |
| `PRINT` | length of the XML, the XML, a line feed |
| `TIMEOUT ms` | 0 |
| `OPEN dev samples mask`, `CLOSE dev` | 0 |
| `READ dev [INPUT chn] attr` | length, value, a line feed |
| `WRITE dev [INPUT chn] attr length` and so many bytes | number of bytes taken |
| `READBUF dev bytes` | length, the mask once, the bytes; repeated until all were sent |
| `WRITEBUF dev bytes`, `GETTRIG dev`, `SETTRIG dev [trigger]` | refused: no outputs, no triggers |
| `EXIT` | the connection ends |

Other requests of iiod, and attributes for debugging, of a buffer or of an output, are refused.

Source: iiod's grammar (`iiod/parser.y`, `iiod/ops.c`) and the client's side of it (`iiod-client.c`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

LINE_LIMIT = 1024
"""Longest request line in bytes, the size of libiio's own buffer."""

VALUE_LIMIT = 4096
"""Longest value in bytes of an attribute that a client may write."""


class Errno(IntEnum):
    """Error numbers of Linux that are used in answers."""

    EPERM = 1
    ENOENT = 2
    EIO = 5
    ENXIO = 6
    E2BIG = 7
    EBADF = 9
    EACCES = 13
    EBUSY = 16
    ENODEV = 19
    EINVAL = 22
    ENOSYS = 38
    ETIMEDOUT = 110


class Refused(Exception):  # noqa: N818 - an answer, not a failure of this program
    """Raised to answer a request with an error number.

    Attributes
    ----------
    errno : Errno
        Error number of the answer.
    """

    def __init__(self, errno: Errno, why: str = "") -> None:
        super().__init__(why or errno.name)
        self.errno = errno


@dataclass(frozen=True)
class Target:
    """The device or channel to which a requested attribute belongs.

    `device` is the id or name of the device. `channel` is the id of the channel; it is empty for an
    attribute of the device.
    """

    device: str
    channel: str = ""


@dataclass(frozen=True)
class Request:
    """Base class of all requests of a client."""


@dataclass(frozen=True)
class Exit(Request):
    """Request to end the connection."""


@dataclass(frozen=True)
class Version(Request):
    """Request for the version of the server."""


@dataclass(frozen=True)
class Print(Request):
    """Request for the description of all devices as XML."""


@dataclass(frozen=True)
class Timeout(Request):
    """Request to set the longest time in ms for an answer; 0 sets no limit."""

    milliseconds: int


@dataclass(frozen=True)
class BufferRequest(Request):
    """Base class of the requests on the buffer of a device."""

    device: str


@dataclass(frozen=True)
class Open(BufferRequest):
    """Request to open a buffer of `samples` scans for the channels in `mask`.

    The mask is hexadecimal with 8 digits per 32 channels; the last 8 digits are for channels 0 to 31.
    """

    samples: int
    mask: str


@dataclass(frozen=True)
class Close(BufferRequest):
    """Request to close the buffer of a device."""


@dataclass(frozen=True)
class ReadAttribute(Request):
    """Request to read the attribute `name` of the target."""

    target: Target
    name: str


@dataclass(frozen=True)
class WriteAttribute(Request):
    """Request to write `value` as the attribute `name` of the target."""

    target: Target
    name: str
    value: bytes


@dataclass(frozen=True)
class ReadBuffer(BufferRequest):
    """Request for `size` bytes of scans from the buffer."""

    size: int


@dataclass(frozen=True)
class Malformed(Request):
    """Bytes of a client that are no request of this protocol, or a request that this server never fulfils.

    Attributes
    ----------
    errno : Errno
        Error number of the answer.
    why : str
        Reason, for a person.
    fatal : bool
        True if the begin of the next request is unknown, so that the connection has to end.
    """

    why: str
    errno: Errno = Errno.EINVAL
    fatal: bool = False


class Parser:
    """Converts received bytes to requests; it never raises, and keeps at most one line or one value."""

    def __init__(self) -> None:
        self._held = bytearray()
        self._value_of: WriteAttribute | None = None
        self._missing = 0
        self._dead = False

    def feed(self, data: bytes) -> list[Request]:
        """Return the requests that these bytes complete, in the order of arrival.

        After a fatal `Malformed` all further bytes are ignored.
        """
        if self._dead:
            return []
        self._held += data
        requests: list[Request] = []
        while (request := self._next()) is not None:
            if isinstance(request, Malformed) and request.fatal:
                self._dead = True
                self._held.clear()
                return [*requests, request]
            if request is not _NOTHING:
                requests.append(request)
        return requests

    def _next(self) -> Request | None:
        """Return the next complete request; None if more bytes are needed."""
        if self._value_of is not None:
            return self._value()
        end = self._held.find(b"\n")
        if end < 0 and len(self._held) <= LINE_LIMIT:
            return None
        if end < 0 or end > LINE_LIMIT:
            return Malformed(f"a line of more than {LINE_LIMIT} bytes", Errno.E2BIG, fatal=True)
        line = bytes(self._held[:end])
        del self._held[: end + 1]
        request = parse_line(line)
        if isinstance(request, _Announced):
            self._value_of, self._missing = request.of, request.size
            return self._value()
        return request

    def _value(self) -> Request | None:
        if self._value_of is None or len(self._held) < self._missing:
            return None
        value = bytes(self._held[: self._missing])
        del self._held[: self._missing]
        announced, self._value_of = self._value_of, None
        return WriteAttribute(announced.target, announced.name, value)


@dataclass(frozen=True)
class _Announced(Request):
    """A write request that is incomplete: its value of `size` bytes follows the line."""

    of: WriteAttribute
    size: int


_NOTHING = Request()
"""Result of parsing an empty line, which has no answer."""


def parse_line(line: bytes) -> Request:
    """Parse one line of the protocol, given without its line feed, as a request."""
    try:
        words = line.decode("ascii").split()
    except UnicodeDecodeError:
        return Malformed("a byte that is not ASCII")
    if not words:
        return _NOTHING
    if any(not word.isprintable() for word in words):
        return Malformed("a control character")
    try:
        return _parse(words[0].upper(), words[1:])
    except ValueError as error:
        return Malformed(f"{words[0][:16]}: {error}")


_ALONE: dict[str, Callable[[], Request]] = {"EXIT": Exit, "QUIT": Exit, "VERSION": Version, "PRINT": Print}
"""Classes of the requests without arguments, by their verb."""

_NEVER = {
    "WRITEBUF": Malformed("a sensor has no outputs", Errno.EPERM),
    **dict.fromkeys(("GETTRIG", "SETTRIG"), Malformed("the sensor's own updates drive it", Errno.ENOENT)),
}


def _parse(verb: str, words: list[str]) -> Request:
    match verb, words:
        case _, [] if verb in _ALONE:
            return _ALONE[verb]()
        case _, _ if verb in _NEVER:
            return _NEVER[verb]
        case "CLOSE", [device]:
            return Close(device)
        case "READBUF", [device, size]:
            return ReadBuffer(device, _count(size))
        case "TIMEOUT", [number]:
            return Timeout(_count(number))
        case "OPEN", [device, samples, mask]:
            return Open(device, _count(samples), _hexadecimal(mask))
        case "READ", [device, *rest]:
            return ReadAttribute(*_attribute(device, rest))
        case "WRITE", [device, *rest, size]:
            return _announce(device, rest, _count(size))
        case _:
            return Malformed(f"no request of {1 + len(words)} words begins with {verb[:16]}")


def _announce(device: str, words: Sequence[str], size: int) -> Request:
    if size > VALUE_LIMIT:
        why = f"a value of {size} bytes; the limit is {VALUE_LIMIT}"
        return Malformed(why, Errno.E2BIG, fatal=True)
    return _Announced(WriteAttribute(*_attribute(device, words), b""), size)


def _attribute(device: str, words: Sequence[str]) -> tuple[Target, str]:
    """Return target and name of an attribute from the words of a request.

    `device` is the id or name of the device.
    """
    match words:
        case [kind, channel, name] if kind.upper() == "INPUT":
            return Target(device, channel), name
        case [name]:
            return Target(device), name
        case _:
            raise ValueError("'[INPUT channel] attribute' is expected")


def _count(text: str) -> int:
    if not text.isdigit() or len(text) > 18:
        raise ValueError(f"'{text[:20]}' is no count")
    return int(text)


def _hexadecimal(text: str) -> str:
    if any(letter not in "0123456789abcdefABCDEF" for letter in text):
        raise ValueError("the mask is not hexadecimal")
    return text


# -- answers --------------------------------------------------------------------------------------


def integer(value: int) -> bytes:
    """Format a number as an answer; clients take a negative number as an error."""
    return f"{value}\n".encode()


def error(errno: Errno) -> bytes:
    """Format an error number as an answer."""
    return integer(-errno)


def counted(content: bytes) -> bytes:
    """Format the value of an attribute or the XML as an answer: length, content, line feed."""
    return integer(len(content)) + content + b"\n"


def version(major: int, minor: int, tag: str) -> bytes:
    """Format the version `major.minor` as an answer; the tag is cut or padded to seven characters."""
    return f"{major}.{minor}.{tag:7.7}\n".encode()
