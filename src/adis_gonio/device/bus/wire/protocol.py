"""Constants and packet bodies of the wire protocol.

Generated from firmware_proto/protocol.toml by scripts/generate_protocol.py; do not edit.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag

from adis_gonio.device.bus.contract import Words
from adis_gonio.device.bus.wire.body import Body

VERSION = 1
BAUD = 500_000

HEADER_SIZE = 3
CRC_SIZE = 4
MAX_RAW = 252
REPLY_BIT = 0x80

WRITE_BIT = 0x8000
RETRY_MS = 250


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
    """Capabilities of a firmware."""

    STREAM = 1 << 0
    """Runs a list of read frames by itself."""
    DATA_READY = 1 << 1
    """Can trigger on data-ready edges and counts them."""
    HARD_RESET = 1 << 2
    """Drives the chip's RST line."""
    USB = 1 << 3
    """Is a USB device itself: there is no baud rate."""


class Trigger(IntEnum):
    """Start of a scan of a stream."""

    RISING = 0
    """Rising edge of data-ready."""
    FALLING = 1
    """Falling edge of data-ready."""
    PERIOD = 2
    """The firmware's own clock, every period_us."""


class Refusal(IntEnum):
    """Reason of a refused request."""

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


REFUSAL_TEXT: dict[int, str] = {
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


class HelloRequest(Body, type=PacketType.HELLO_REQUEST, layout="BI"):
    """Opens a session: stops a stream, sets the default timing, forgets the ids used before."""

    protocol: int
    """Version that the host speaks."""
    nonce: int
    """Random number that the host draws for each session."""


class HelloReply(Body, type=PacketType.HELLO_REPLY, layout="BBBBHBBBHII6I", tail="text"):
    """Reply to the request hello."""

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
    """Board, a blank, serial number; the board alone if it has none."""


class ConfigureRequest(Body, type=PacketType.CONFIGURE_REQUEST, layout="IHH"):
    """Sets the SPI timing. It takes the fastest clock not above clock_hz, or fails with bad_value."""

    clock_hz: int
    """Highest clock."""
    stall_us: int
    """Least time of chip select high."""
    period_us: int
    """Least time from frame start to frame start."""


class ConfigureReply(Body, type=PacketType.CONFIGURE_REPLY, layout="IHH"):
    """Reply to the request configure."""

    clock_hz: int
    """Clock in force."""
    stall_us: int
    """Stall in force."""
    period_us: int
    """Period in force."""


class ExchangeRequest(Body, type=PacketType.EXCHANGE_REQUEST, layout="B", tail="words"):
    """Sends frames; the reply has as many words. All are executed, or none if it is refused."""

    writes: int
    """How many of the frames have the write bit."""
    frames: Words
    """1 to max_frames frames."""


class ExchangeReply(Body, type=PacketType.EXCHANGE_REPLY, tail="words"):
    """Reply to the request exchange."""

    words: Words
    """Word shifted out during each frame."""


class StreamRequest(Body, type=PacketType.STREAM_REQUEST, layout="BBHI", tail="words"):
    """Starts a stream; its packets carry this request's id."""

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


class StreamReply(Body, type=PacketType.STREAM_REPLY, layout="I"):
    """Reply to the request stream."""

    now_us: int
    """Firmware's clock at the start."""


class StopRequest(Body, type=PacketType.STOP_REQUEST):
    """Ends the stream; its last scans come before the reply. If none runs, the last totals come."""


class StopReply(Body, type=PacketType.STOP_REPLY, layout="II"):
    """Reply to the request stop."""

    scans: int
    """Scans sent in all."""
    lost: int
    """Triggers that gave no scan."""


class ResetRequest(Body, type=PacketType.RESET_REQUEST, layout="H"):
    """Pulls the chip's RST line low; the host waits for the start-up."""

    low_us: int
    """Time low, 10 to 50000."""


class ResetReply(Body, type=PacketType.RESET_REPLY, layout="I"):
    """Reply to the request reset."""

    now_us: int
    """Firmware's clock at the release."""


class StatisticsRequest(Body, type=PacketType.STATISTICS_REQUEST):
    """Reads the counters since power-on, which wrap and are never reset, and changes nothing."""


class StatisticsReply(Body, type=PacketType.STATISTICS_REPLY, layout="IIIIHHHHHHH"):
    """Reply to the request statistics."""

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


class Scans(Body, type=PacketType.SCANS, layout="IHII", tail="words"):
    """Scans of consecutive triggers; the id is the id of the request that started the stream."""

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


class Error(Body, type=PacketType.ERROR, layout="BBH"):
    """Reply to a refused request: nothing was executed."""

    request: int
    """The request's type."""
    code: int
    """Code of [errors]."""
    detail: int
    """See [errors]."""
