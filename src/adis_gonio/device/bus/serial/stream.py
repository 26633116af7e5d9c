"""A stream of the firmware: packets of scans to blocks, with what was lost counted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from adis_gonio.base.errors import BusTimeoutError, ProtocolError
from adis_gonio.device.bus.contract import FrameBlock, FrameStream
from adis_gonio.device.bus.serial.clocks import ClockMap
from adis_gonio.device.bus.wire import Packet
from adis_gonio.device.bus.wire import protocol as wire

SILENCE_S = 3.0
"""Without an edge for so long the chip is not sampling: its slowest rate has one every 2.42 s."""
_POLL_S = 0.5
_PACKETS_MISSED = 4
"""Packets that the edges counted should have filled; where none of so many arrives the line is no good."""
_AROUND = wire.HEADER_SIZE + wire.CRC_SIZE + 2
"""Bytes on the line beside a packet's body: header, CRC, COBS, delimiter."""


class StreamOwner(Protocol):
    """What a stream needs of its bus."""

    url: str

    def next_scans(self, wait_s: float) -> tuple[Packet, float] | None:
        """Next packet of scans and its arrival; None where none came in time."""

    def count_edges(self) -> int:
        """Data-ready edges that the firmware has counted (u32)."""

    def now_s(self) -> float:
        """The bus's clock."""


class SerialStream(FrameStream):
    """Blocks of a running firmware stream.

    Parameters
    ----------
    owner : StreamOwner
        The bus.
    stream_id : int
        Id of the request that started it; packets of other streams are thrown away.
    width : int
        Frames in the list.
    packet_scans : int
        Scans in a full packet.
    block_scans : int
        Scans that a block has at least, unless the stream is slow.
    clock : ClockMap
        For times.
    byte_s : float
        Time of a byte on the line.
    stop : callable
        Ends the stream and frees the bus.
    """

    def __init__(
        self,
        owner: StreamOwner,
        *,
        stream_id: int,
        width: int,
        packet_scans: int,
        block_scans: int,
        clock: ClockMap,
        byte_s: float,
        stop: Callable[[], None],
    ) -> None:
        self._owner = owner
        self._id = stream_id
        self._width = width
        self._packet_scans = packet_scans
        self._block = block_scans
        self._clock = clock
        self._byte_s = byte_s
        self._stop = stop
        self._open = True
        self._next_sequence = 0
        self._lost = 0

    def __next__(self) -> FrameBlock:
        """Next block.

        Raises
        ------
        BusTimeoutError
            No data-ready edges, the firmware is silent, or no packet comes through whole.
        CannotOpenError
            The board was unplugged.
        """
        parts: list[FrameBlock] = []
        have = 0
        while have < self._block:
            if not self._open:
                if parts:
                    break
                raise StopIteration
            part = self._part()
            if part is not None:
                parts.append(part)
                have += len(part.time_s)
        return FrameBlock(
            np.concatenate([part.words for part in parts]),
            np.concatenate([part.time_s for part in parts]),
            sum(part.lost for part in parts),
        )

    def close(self) -> None:
        """Stop; the bus is free again."""
        if self._open:
            self._open = False
            self._stop()

    def _part(self) -> FrameBlock | None:
        """Scans of the next packet that belongs here and is sound."""
        packet, arrival_s = self._packet()
        if packet.id != self._id:
            return None
        try:
            scans = wire.Scans.unpack(packet.body)
        except ProtocolError:
            return None
        count, rest = divmod(len(scans.words), self._width)
        if not count or rest:
            return None
        missed = (scans.sequence - self._next_sequence) & 0xFFFF_FFFF
        if missed > 0x8000_0000:
            return None  # a packet from before: a repetition on the line
        lost = missed + ((scans.lost - self._lost) & 0xFFFF)
        self._next_sequence = (scans.sequence + count) & 0xFFFF_FFFF
        self._lost = scans.lost
        left_s = arrival_s - (len(packet.body) + _AROUND) * self._byte_s
        times = self._clock.times(scans.first_us, scans.span_us, count, left_s)
        return FrameBlock(scans.words.reshape(count, self._width), times, lost)

    def _packet(self) -> tuple[Packet, float]:
        """Next packet of scans; asks the firmware for its edges while none comes."""
        owner = self._owner
        first: int | None = None
        edges: int | None = None
        begin_s = since_s = owner.now_s()
        while True:
            found = owner.next_scans(_POLL_S)
            if found is not None:
                return found
            now_edges = owner.count_edges()
            first = now_edges if first is None else first
            unheard = (now_edges - first) & 0xFFFF_FFFF
            if unheard > _PACKETS_MISSED * self._packet_scans and owner.now_s() - begin_s > SILENCE_S:
                raise BusTimeoutError(
                    f"{owner.url}: {unheard} data-ready edges, but no packet of scans came through whole in"
                    f" {owner.now_s() - begin_s:.1f} s: check the cable and the baud rate"
                )
            if now_edges != edges:
                edges, since_s = now_edges, owner.now_s()
            elif owner.now_s() - since_s > SILENCE_S:
                raise BusTimeoutError(
                    f"{owner.url}: no data-ready edge in {SILENCE_S:g} s: enable the line in MSC_CTRL[2],"
                    " and check the wire from the chip's DIO1 to the board"
                )
