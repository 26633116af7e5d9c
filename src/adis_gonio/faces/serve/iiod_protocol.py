r"""The text protocol of iiod, the server of libiio 0.x, without any I/O.

A client sends lines; some are followed by a counted number of bytes. `Parser` takes bytes in any pieces and
returns typed requests; the functions at the end format the answers. A numeric answer is one line; a
negative number is `-errno` of Linux on every operating system.

| request | answer |
|---|---|
| `VERSION`, `HELP` | a line, or text |
| `PRINT` | length of the XML, the XML, a line feed |
| `TIMEOUT ms`, `SET dev BUFFERS_COUNT n` | 0 |
| `OPEN dev samples mask [CYCLIC]`, `CLOSE dev` | 0 |
| `READ dev [DEBUG \| BUFFER \| INPUT chn \| OUTPUT chn] [attr]` | length, value, a line feed |
| `WRITE dev [as above] [attr] length` and so many bytes | number of bytes taken |
| `READBUF dev bytes` | length, the mask once, the bytes; repeated until all were sent |
| `WRITEBUF dev bytes` | refused: a sensor has no output |
| `GETTRIG dev`, `SETTRIG dev [trigger]` | no such thing |
| `EXIT` | the connection ends |

Source: iiod's grammar (`iiod/parser.y`, `iiod/ops.c`) and the client's side of it (`iiod-client.c`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

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


Kind = Literal["device", "debug", "buffer", "input", "output"]


@dataclass(frozen=True)
class Target:
    """The device or channel to which a requested attribute belongs.

    `device` is the id or name of the device, `kind` the kind of attribute. `channel` is the id of the
    channel; it is empty for an attribute of the device.
    """

    device: str
    kind: Kind = "device"
    channel: str = ""


@dataclass(frozen=True)
class Request:
    """Base class of all requests of a client."""


@dataclass(frozen=True)
class Exit(Request):
    """Request to end the connection."""


@dataclass(frozen=True)
class Help(Request):
    """Request for a list of the commands."""


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
    """Base class of the requests on the buffer or the trigger of a device."""

    device: str


@dataclass(frozen=True)
class Open(BufferRequest):
    """Request to open a buffer of `samples` scans for the channels in `mask`.

    The mask is hexadecimal with 8 digits per 32 channels; the last 8 digits are for channels 0 to 31.
    """

    samples: int
    mask: str
    cyclic: bool = False


@dataclass(frozen=True)
class Close(BufferRequest):
    """Request to close the buffer of a device."""


@dataclass(frozen=True)
class ReadAttribute(Request):
    """Request to read an attribute; an empty name reads all attributes of the target."""

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
class WriteBuffer(BufferRequest):
    """Request to put out `size` bytes of scans; the server refuses it, since a sensor has no outputs."""

    size: int


@dataclass(frozen=True)
class GetTrigger(BufferRequest):
    """Request for the name of a device's trigger."""


@dataclass(frozen=True)
class SetTrigger(BufferRequest):
    """Request to set the trigger of a device; a trigger of None removes it."""

    trigger: str | None


@dataclass(frozen=True)
class SetBuffers(BufferRequest):
    """Request to set the number of kernel buffers; it has no effect on this server."""

    count: int


@dataclass(frozen=True)
class Malformed(Request):
    """Bytes of a client that are no request of this protocol.

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

_KINDS: dict[str, Kind] = {"DEBUG": "debug", "BUFFER": "buffer", "INPUT": "input", "OUTPUT": "output"}


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


_ALONE: dict[str, Callable[[], Request]] = {
    "EXIT": Exit,
    "QUIT": Exit,
    "HELP": Help,
    "VERSION": Version,
    "PRINT": Print,
}
_OF_DEVICE: dict[str, Callable[[str], Request]] = {"CLOSE": Close, "GETTRIG": GetTrigger}
_OF_SIZE: dict[str, Callable[[str, int], Request]] = {"READBUF": ReadBuffer, "WRITEBUF": WriteBuffer}
"""Request classes with a device and a number of bytes, by their verb.

Other tables have the requests without arguments and those with a device alone.
"""


def _parse(verb: str, words: list[str]) -> Request:
    match verb, words:
        case _, [] if verb in _ALONE:
            return _ALONE[verb]()
        case _, [device] if verb in _OF_DEVICE:
            return _OF_DEVICE[verb](device)
        case _, [device, size] if verb in _OF_SIZE:
            return _OF_SIZE[verb](device, _count(size))
        case "TIMEOUT", [number]:
            return Timeout(_count(number))
        case "OPEN", [device, samples, mask, *rest] if [word.upper() for word in rest] in ([], ["CYCLIC"]):
            return Open(device, _count(samples), _hexadecimal(mask), cyclic=bool(rest))
        case "SETTRIG", ([device] | [device, _]):
            return SetTrigger(device, words[1] if len(words) > 1 else None)
        case "SET", [device, name, count] if name.upper() == "BUFFERS_COUNT":
            return SetBuffers(device, _count(count))
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

    `device` is the id or name of the device. The name is empty if the request has none.
    """
    kind: Kind = _KINDS.get(words[0].upper(), "device") if words else "device"
    rest = list(words[1:] if kind != "device" else words)
    channel = ""
    if kind in ("input", "output"):
        if not rest:
            raise ValueError("a channel is missing")
        channel = rest.pop(0)
    if len(rest) > 1:
        raise ValueError(f"{len(rest)} words instead of the name of an attribute")
    return Target(device, kind, channel), rest[0] if rest else ""


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


def all_values(values: Sequence[bytes]) -> bytes:
    """Format several values as one answer.

    Each value has its length before it (big-endian, 32 bits) and is padded to 4 bytes.
    """
    parts = []
    for value in values:
        parts.append(len(value).to_bytes(4, "big") + value + b"\0" * (-len(value) % 4))
    return counted(b"".join(parts))


def version(major: int, minor: int, tag: str) -> bytes:
    """Format the version `major.minor` as an answer; the tag is cut or padded to seven characters."""
    return f"{major}.{minor}.{tag:7.7}\n".encode()


HELP = (
    b"VERSION, PRINT, TIMEOUT ms, OPEN dev samples mask, CLOSE dev, READ dev [INPUT chn] attr,\n"
    b"WRITE dev [INPUT chn] attr length, READBUF dev bytes, EXIT; see libiio's iiod\n"
)
