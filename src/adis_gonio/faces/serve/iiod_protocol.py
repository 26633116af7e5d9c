r"""The text protocol of iiod, the server of libiio 0.x: requests as lines of words, and answers.

A client sends lines; the line of a written attribute is followed by a counted number of bytes. A numeric
answer is one line; a negative number is `-errno` of Linux on every operating system.

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

import asyncio
from enum import IntEnum
from typing import NamedTuple

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
    ETIMEDOUT = 110


class Refused(Exception):  # noqa: N818 - an answer, not a failure of this program
    """Raised to answer a request with an error number.

    Attributes
    ----------
    errno : Errno
        Error number of the answer.
    """

    def __init__(self, errno: Errno) -> None:
        super().__init__(errno.name)
        self.errno = errno


class Request(NamedTuple):
    """A request of a client: the words of its line, and the value that follows the line of a `WRITE`.

    The first word, the verb, is in capitals.
    """

    words: tuple[str, ...]
    value: bytes = b""


async def read_request(reader: asyncio.StreamReader) -> Request | Errno:
    """Read the next request of a client, or the error number that answers a line that is no request.

    Lines without a word are skipped. After `E2BIG` the begin of the next request is unknown, so that the
    connection has to end. `reader` has to have the limit `LINE_LIMIT`.

    Raises
    ------
    asyncio.IncompleteReadError
        The client has left.
    """
    words: tuple[str, ...] = ()
    try:
        while not words:
            words = tuple((await reader.readuntil(b"\n")).decode("ascii").split())
        if not all(word.isprintable() for word in words):
            return Errno.EINVAL
        words = (words[0].upper(), *words[1:])
        size = count(words[-1]) if words[0] == "WRITE" else 0
        if size > VALUE_LIMIT:
            return Errno.E2BIG
        return Request(words, await reader.readexactly(size))
    except asyncio.LimitOverrunError:
        return Errno.E2BIG
    except UnicodeDecodeError:
        return Errno.EINVAL
    except Refused as refused:
        return refused.errno


def count(text: str) -> int:
    """Parse a word as a number of at most 18 digits; raise `Refused` if it is none."""
    if not text.isdigit() or len(text) > 18:
        raise Refused(Errno.EINVAL)
    return int(text)


def counted(content: bytes) -> bytes:
    """Format the value of an attribute or the XML as an answer: length, content, line feed."""
    return b"%d\n%b\n" % (len(content), content)


def error(errno: Errno) -> bytes:
    """Format an error number as an answer."""
    return b"%d\n" % -errno
