"""Constants and packet bodies of the wire protocol.

Generated from firmware_proto/protocol.toml by scripts/generate_protocol.py; do not edit.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import ClassVar

from adis_gonio.device.bus.contract import Words
from adis_gonio.device.bus.wire.body import Body

VERSION = 1
BAUD = 500_000
BAUD_FAST = 1_000_000

HEADER_SIZE = 3
CRC_SIZE = 4
MAX_RAW = 252
CRC_CHECK = 0xCBF43926
REPLY_BIT = 0x80

CLOCKS = 6
WRITE_BIT = 0x8000
RESERVED_BIT = 0x4000
IDLE_FRAME = 0x0000
RETRY_MS = 250

DEFAULT_CLOCK_HZ = 250_000
DEFAULT_STALL_US = 75
DEFAULT_PERIOD_US = 160


class PacketType(IntEnum):
    """Type of a packet: its first byte."""

    HELLO_REQUEST = 0x01
    HELLO_REPLY = 0x81
    CONFIGURE_REQUEST = 0x02
    CONFIGURE_REPLY = 0x82
    EXCHANGE_REQUEST = 0x03
    EXCHANGE_REPLY = 0x83
    STREAM_REQUEST = 0x04
    STREAM_REPLY = 0x84
    STOP_REQUEST = 0x05
    STOP_REPLY = 0x85
    RESET_REQUEST = 0x06
    RESET_REPLY = 0x86
    STATISTICS_REQUEST = 0x07
    STATISTICS_REPLY = 0x87
    SCANS = 0xC4
    ERROR = 0xFF


class FirmwareCapability(IntFlag):
    """What a firmware can do."""

    STREAM = 1 << 0
    """Runs a list of read frames by itself."""
    DATA_READY = 1 << 1
    """Can trigger on data-ready edges and counts them."""
    HARD_RESET = 1 << 2
    """Drives the chip's RST line."""
    USB = 1 << 3
    """Is a USB device itself: there is no baud rate."""


class Trigger(IntEnum):
    """What starts a scan of a stream."""

    RISING = 0
    """Rising edge of data-ready."""
    FALLING = 1
    """Falling edge of data-ready."""
    PERIOD = 2
    """The firmware's own clock, every period_us."""


class Refusal(IntEnum):
    """Why a request was refused."""

    NO_SESSION = 1
    """No hello since power-on: the firmware restarted."""
    UNKNOWN_REQUEST = 2
    """No such request."""
    BAD_LENGTH = 3
    """The body's length does not fit the request."""
    BUSY = 4
    """A stream is running; stop it first."""
    BAD_FRAME = 5
    """Bit 14 set, or the write bit in a stream's list; detail is the frame's index."""
    WRITE_COUNT = 6
    """The count of write frames does not fit the frames; detail is their number."""
    BAD_VALUE = 7
    """A value is out of range; detail is the offset of its field."""
    ID_REUSED = 8
    """The id of the last request with another content."""
    PROTOCOL_VERSION = 9
    """Another protocol version; detail is the firmware's."""


REFUSAL_TEXT = {
    Refusal.NO_SESSION: "no hello since power-on: the firmware restarted",
    Refusal.UNKNOWN_REQUEST: "no such request",
    Refusal.BAD_LENGTH: "the body's length does not fit the request",
    Refusal.BUSY: "a stream is running; stop it first",
    Refusal.BAD_FRAME: "bit 14 set, or the write bit in a stream's list; detail is the frame's index",
    Refusal.WRITE_COUNT: "the count of write frames does not fit the frames; detail is their number",
    Refusal.BAD_VALUE: "a value is out of range; detail is the offset of its field",
    Refusal.ID_REUSED: "the id of the last request with another content",
    Refusal.PROTOCOL_VERSION: "another protocol version; detail is the firmware's",
}


@dataclass(frozen=True)
class HelloRequest(Body):
    """Opens a session: stops a stream, sets the default timing, forgets the ids used before."""

    TYPE: ClassVar[PacketType] = PacketType.HELLO_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BI")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1)
    TAIL: ClassVar[str] = ""

    protocol: int
    """Version that the host speaks."""
    nonce: int
    """Drawn anew by the host for every session."""


@dataclass(frozen=True)
class HelloReply(Body):
    """Answers hello."""

    TYPE: ClassVar[PacketType] = PacketType.HELLO_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBBBHBBBHII6I")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 6)
    TAIL: ClassVar[str] = "text"

    protocol: int
    """Version that the firmware speaks."""
    major: int
    """Firmware version."""
    minor: int
    """Firmware version."""
    patch: int
    """Firmware version."""
    capabilities: int
    """Bits of [capabilities]."""
    max_frames: int
    """Frames in an exchange, at most."""
    max_list: int
    """Frames in a stream's list, at most."""
    max_scan_bytes: int
    """Bytes of scans in a stream packet, at most."""
    max_wait_us: int
    """Longest stall and period that can be configured."""
    now_us: int
    """Firmware's clock, wraps."""
    nonce: int
    """The request's nonce."""
    clocks_hz: tuple[int, ...]
    """SPI clocks, fastest first, 0 where unused."""
    board: str
    """Board, a blank, serial number; without the blank where it has none."""


@dataclass(frozen=True)
class ConfigureRequest(Body):
    """Sets the SPI timing. The fastest clock not above clock_hz is taken; none is bad_value."""

    TYPE: ClassVar[PacketType] = PacketType.CONFIGURE_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IHH")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1)
    TAIL: ClassVar[str] = ""

    clock_hz: int
    """Highest clock."""
    stall_us: int
    """Least time of chip select high."""
    period_us: int
    """Least time from frame start to frame start."""


@dataclass(frozen=True)
class ConfigureReply(Body):
    """Answers configure."""

    TYPE: ClassVar[PacketType] = PacketType.CONFIGURE_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IHH")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1)
    TAIL: ClassVar[str] = ""

    clock_hz: int
    """Clock in force."""
    stall_us: int
    """Stall in force."""
    period_us: int
    """Period in force."""


@dataclass(frozen=True)
class ExchangeRequest(Body):
    """Sends frames; the reply holds as many words. Refused whole or executed whole."""

    TYPE: ClassVar[PacketType] = PacketType.EXCHANGE_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<B")
    COUNTS: ClassVar[tuple[int, ...]] = (1,)
    TAIL: ClassVar[str] = "words"

    writes: int
    """How many of the frames have the write bit."""
    frames: Words
    """1 to max_frames frames."""


@dataclass(frozen=True)
class ExchangeReply(Body):
    """Answers exchange."""

    TYPE: ClassVar[PacketType] = PacketType.EXCHANGE_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")
    COUNTS: ClassVar[tuple[int, ...]] = ()
    TAIL: ClassVar[str] = "words"

    words: Words
    """Word shifted out during each frame."""


@dataclass(frozen=True)
class StreamRequest(Body):
    """Starts a stream; its packets carry this request's id."""

    TYPE: ClassVar[PacketType] = PacketType.STREAM_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHI")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1, 1)
    TAIL: ClassVar[str] = "words"

    trigger: int
    """Code of [triggers]."""
    scans: int
    """Scans in a packet, at least 1."""
    decimation: int
    """Every n-th trigger gives a scan, at least 1."""
    period_us: int
    """For the trigger `period`, else 0."""
    frames: Words
    """1 to max_list read frames."""


@dataclass(frozen=True)
class StreamReply(Body):
    """Answers stream."""

    TYPE: ClassVar[PacketType] = PacketType.STREAM_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    COUNTS: ClassVar[tuple[int, ...]] = (1,)
    TAIL: ClassVar[str] = ""

    now_us: int
    """Firmware's clock at the start."""


@dataclass(frozen=True)
class StopRequest(Body):
    """Ends the stream, whose last scans come before the reply; without one, the last totals."""

    TYPE: ClassVar[PacketType] = PacketType.STOP_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")
    COUNTS: ClassVar[tuple[int, ...]] = ()
    TAIL: ClassVar[str] = ""


@dataclass(frozen=True)
class StopReply(Body):
    """Answers stop."""

    TYPE: ClassVar[PacketType] = PacketType.STOP_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<II")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1)
    TAIL: ClassVar[str] = ""

    scans: int
    """Scans sent in all."""
    lost: int
    """Triggers that gave no scan."""


@dataclass(frozen=True)
class ResetRequest(Body):
    """Pulls the chip's RST line low; the host waits for the start-up."""

    TYPE: ClassVar[PacketType] = PacketType.RESET_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<H")
    COUNTS: ClassVar[tuple[int, ...]] = (1,)
    TAIL: ClassVar[str] = ""

    low_us: int
    """Time low, 10 to 50000."""


@dataclass(frozen=True)
class ResetReply(Body):
    """Answers reset."""

    TYPE: ClassVar[PacketType] = PacketType.RESET_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    COUNTS: ClassVar[tuple[int, ...]] = (1,)
    TAIL: ClassVar[str] = ""

    now_us: int
    """Firmware's clock at the release."""


@dataclass(frozen=True)
class StatisticsRequest(Body):
    """Counters since power-on; they wrap and are never set back, so reading them changes nothing."""

    TYPE: ClassVar[PacketType] = PacketType.STATISTICS_REQUEST
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<")
    COUNTS: ClassVar[tuple[int, ...]] = ()
    TAIL: ClassVar[str] = ""


@dataclass(frozen=True)
class StatisticsReply(Body):
    """Answers statistics."""

    TYPE: ClassVar[PacketType] = PacketType.STATISTICS_REPLY
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IIIIHHHHHHH")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1)
    TAIL: ClassVar[str] = ""

    now_us: int
    """Firmware's clock, wraps."""
    edges: int
    """Data-ready edges."""
    lost: int
    """Triggers that gave no scan, all streams."""
    frames: int
    """Frames sent to the chip."""
    packets: int
    """Sound packets received."""
    crc_errors: int
    """Packets with a wrong CRC."""
    cobs_errors: int
    """Packets with broken COBS."""
    length_errors: int
    """Packets too short or too long."""
    discarded: int
    """Sound packets thrown away: stale id or not a request."""
    repeated: int
    """Requests answered from memory."""
    receive_overruns: int
    """Bytes lost in the receiver."""


@dataclass(frozen=True)
class Scans(Body):
    """Scans of consecutive triggers of the stream whose request had this id."""

    TYPE: ClassVar[PacketType] = PacketType.SCANS
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IHII")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1, 1)
    TAIL: ClassVar[str] = "words"

    sequence: int
    """Scans sent in this stream before the first one here, wraps."""
    lost: int
    """Triggers lost in this stream before the first scan here, wraps."""
    first_us: int
    """Time of the first scan's trigger."""
    span_us: int
    """Time from the first scan's trigger to the last one's."""
    words: Words
    """Reply to each frame of the list, scan by scan."""


@dataclass(frozen=True)
class Error(Body):
    """Reply to a refused request: nothing was executed."""

    TYPE: ClassVar[PacketType] = PacketType.ERROR
    LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBH")
    COUNTS: ClassVar[tuple[int, ...]] = (1, 1, 1)
    TAIL: ClassVar[str] = ""

    request: int
    """The request's type."""
    code: int
    """Code of [errors]."""
    detail: int
    """See [errors]."""
