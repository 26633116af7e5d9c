r"""The text protocol of iiod, libiio's server (libiio 0.x), without any I/O.

A client sends lines; some are followed by a counted number of bytes. `Parser` takes bytes as they come and
returns typed requests; the functions below write the answers. A number is answered as one line, negative
ones are `-errno` of Linux, whatever the machine that this runs on.

| request | answer |
|---|---|
| `VERSION`, `HELP` | a line, or text |
| `PRINT` | length of the XML, the XML, a line feed |
| `TIMEOUT ms`, `SET dev BUFFERS_COUNT n` | 0 |
| `OPEN dev samples mask [CYCLIC]`, `CLOSE dev` | 0 |
| `READ dev [DEBUG \| BUFFER \| INPUT chn \| OUTPUT chn] [attr]` | length, value, a line feed |
| `WRITE dev [as above] [attr] length` and so many bytes | number of bytes taken |
| `READBUF dev bytes` | length, the mask once, the bytes; again until all were sent |
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
"""Longest request line; libiio's own buffer."""

VALUE_LIMIT = 4096
"""Longest value of an attribute that a client may write."""


class Errno(IntEnum):
    """Linux' numbers of the errors that are answered."""

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


class Refused(Exception):  # noqa: N818 - it is an answer, not a failure of this program
    """A request is answered with an error number.

    Attributes
    ----------
    errno : Errno
    """

    def __init__(self, errno: Errno, why: str = "") -> None:
        super().__init__(why or errno.name)
        self.errno = errno


Kind = Literal["device", "debug", "buffer", "input", "output"]


@dataclass(frozen=True)
class Target:
    """Whose attribute it is: a device's, or with a channel's id one of a channel."""

    device: str
    kind: Kind = "device"
    channel: str = ""


@dataclass(frozen=True)
class Request:
    """Base of all requests."""


@dataclass(frozen=True)
class Exit(Request):
    """End of the connection."""


@dataclass(frozen=True)
class Help(Request):
    """What commands there are."""


@dataclass(frozen=True)
class Version(Request):
    """Which version answers."""


@dataclass(frozen=True)
class Print(Request):
    """The context as XML."""


@dataclass(frozen=True)
class Timeout(Request):
    """How long an answer may take; 0 for ever."""

    milliseconds: int


@dataclass(frozen=True)
class Open(Request):
    """Begin to buffer; `mask` is hexadecimal, 8 digits a word, the last word holds channels 0 to 31."""

    device: str
    samples: int
    mask: str
    cyclic: bool = False


@dataclass(frozen=True)
class Close(Request):
    """End buffering."""

    device: str


@dataclass(frozen=True)
class ReadAttribute(Request):
    """Value of an attribute; an empty name asks for all of them."""

    target: Target
    name: str


@dataclass(frozen=True)
class WriteAttribute(Request):
    """A new value of an attribute."""

    target: Target
    name: str
    value: bytes


@dataclass(frozen=True)
class ReadBuffer(Request):
    """So many bytes of scans."""

    device: str
    size: int


@dataclass(frozen=True)
class WriteBuffer(Request):
    """Announces so many bytes of scans to put out."""

    device: str
    size: int


@dataclass(frozen=True)
class GetTrigger(Request):
    """Which trigger drives a device."""

    device: str


@dataclass(frozen=True)
class SetTrigger(Request):
    """Which trigger shall drive a device; None unsets it."""

    device: str
    trigger: str | None


@dataclass(frozen=True)
class SetBuffers(Request):
    """Number of the kernel's buffers, of which there are none here."""

    device: str
    count: int


@dataclass(frozen=True)
class Malformed(Request):
    """No request of this protocol.

    Attributes
    ----------
    errno : Errno
        Its answer.
    fatal : bool
        True where it cannot be told where the next request begins: the connection has to end.
    """

    why: str
    errno: Errno = Errno.EINVAL
    fatal: bool = False


class Parser:
    """Bytes in, requests out; never raises, and holds no more than one line or one value."""

    def __init__(self) -> None:
        self._held = bytearray()
        self._value_of: WriteAttribute | None = None
        self._missing = 0
        self._dead = False

    def feed(self, data: bytes) -> list[Request]:
        """Requests that these bytes complete, in order.

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
        """Next request; None where bytes are missing."""
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
    """A write whose value follows."""

    of: WriteAttribute
    size: int


_NOTHING = Request()
"""An empty line, which has no answer."""

_KINDS: dict[str, Kind] = {"DEBUG": "debug", "BUFFER": "buffer", "INPUT": "input", "OUTPUT": "output"}


def parse_line(line: bytes) -> Request:
    """Request of one line without its line feed."""
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
"""Requests by their verb: of no word more, of a device, of a device and a number of bytes."""


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
            return _announced(device, rest, _count(size))
        case _:
            return Malformed(f"no request of {1 + len(words)} words begins with {verb[:16]}")


def _announced(device: str, words: Sequence[str], size: int) -> Request:
    if size > VALUE_LIMIT:
        why = f"a value of {size} bytes; the limit is {VALUE_LIMIT}"
        return Malformed(why, Errno.E2BIG, fatal=True)
    return _Announced(WriteAttribute(*_attribute(device, words), b""), size)


def _attribute(device: str, words: Sequence[str]) -> tuple[Target, str]:
    """Whose attribute, and its name; the name may be missing."""
    kind: Kind = _KINDS.get(words[0].upper(), "device") if words else "device"
    rest = list(words[1:] if kind != "device" else words)
    channel = ""
    if kind in ("input", "output"):
        if not rest:
            raise ValueError("a channel is missing")
        channel = rest.pop(0)
    if len(rest) > 1:
        raise ValueError(f"{len(rest)} words where the name of an attribute is expected")
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
    """A number; negative is an error."""
    return f"{value}\n".encode()


def error(errno: Errno) -> bytes:
    """The answer of a refusal."""
    return integer(-errno)


def counted(content: bytes) -> bytes:
    """Length, content, line feed: an attribute's value or the XML."""
    return integer(len(content)) + content + b"\n"


def all_values(values: Sequence[bytes]) -> bytes:
    """Several attributes in one answer: each a length (big-endian, 32 bits) and padding to 4 bytes."""
    parts = []
    for value in values:
        parts.append(len(value).to_bytes(4, "big") + value + b"\0" * (-len(value) % 4))
    return counted(b"".join(parts))


def version(major: int, minor: int, tag: str) -> bytes:
    """Version; the tag has exactly seven characters, as a commit's short name has."""
    return f"{major}.{minor}.{tag:7.7}\n".encode()


HELP = (
    b"VERSION, PRINT, TIMEOUT ms, OPEN dev samples mask, CLOSE dev, READ dev [INPUT chn] attr,\n"
    b"WRITE dev [INPUT chn] attr length, READBUF dev bytes, EXIT; see libiio's iiod\n"
)
