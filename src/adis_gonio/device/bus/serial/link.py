"""Requests and replies over a serial port: ids, retries, resynchronisation (firmware_proto/PROTOCOL.md).

A request is repeated with its own id until it is answered or its tries are used up; the firmware executes
an id once, so that repeating is safe for writes too. A reply with another id is late and is discarded.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

from adis_gonio.base.errors import BusTimeoutError, ProtocolError
from adis_gonio.device.bus.host import Clock
from adis_gonio.device.bus.wire import Body, Packet, Receiver, encode, protocol as wire

RETRY_S = wire.RETRY_MS / 1000
TRIES = 5
"""Number of times that a request is sent before the firmware counts as silent."""
HELLO_EVERY_S = 0.3

# Opening a port resets many boards. Their boot loader then listens at another baud rate (Optiboot: 115 200)
# and interprets the bytes as commands, such as to erase a page. It leaves at once, though, if the second
# byte of a command is no blank, and zeros at our rate can never look like the command to erase: it has
# neighbouring bits that are set, but zeros are high only for a stop bit of 2 us in 20.
ZEROS = bytes(1)
"""An empty packet for the firmware; for a loader a byte that is no command, and the next one no blank after
it: two of them make it leave. Without gaps between them a run of zeros keeps some loaders in step."""
ZEROS_EVERY_S = 0.02
ZEROS_FIRST_S = 0.24
"""A loader listens 70 ms after the reset, 90 at most (start-up 65 ms, B)."""
ZEROS_AGAIN_S = 0.06
LEAVE_S = 0.16
"""Silence after the zeros: a loader needs 16 ms to leave (its watchdog), and a start-up follows."""
EARLY_HELLOS = 2
"""Hellos before a loader's own time is over: the first for boards that did not reset, the second for
loaders that blink before they listen (Optiboot: 0.4 s), by which the first is lost."""
LOADER_S = 2.0
"""Longest wait of a boot loader; most wait a second. One that does not heed zeros hears nothing more until
then."""

B = TypeVar("B", bound=Body)


class Port(Protocol):
    """A serial port as the link uses it; its failures are errors of this package."""

    def receive(self, wait_s: float, /) -> bytes:
        """Return the bytes that have arrived, after waiting at most `wait_s` seconds for the first."""

    def send(self, data: bytes, /) -> None:
        """Send all the bytes."""

    def close(self) -> None:
        """Close the port."""


class RefusedError(Exception):
    """The firmware refused a request and did not execute the refused copy.

    Attributes
    ----------
    code : int
        Reason of the refusal, one of `wire.Refusal`.
    once : bool
        The request was sent only once, so no earlier copy can have been executed.
    """

    def __init__(self, request: str, error: wire.Error, *, once: bool) -> None:
        try:
            text = wire.REFUSAL_TEXT[wire.Refusal(error.code)]
        except ValueError:
            text = f"code {error.code}"
        super().__init__(f"the firmware refused {request}: {text} ({error.detail})")
        self.code = error.code
        self.once = once


@dataclass
class LinkCounts:
    """Numbers of requests, repeated requests and late replies on a serial link."""

    requests: int = 0
    retries: int = 0
    late: int = 0


class SerialLink:
    """The host's side of the serial protocol: sends requests and sorts the packets that arrive.

    Parameters
    ----------
    port : Port
        Open.
    url : str
        For messages.
    clock : Clock
        Time for waits.
    dice : random.Random
        Draws nonces and the first id.

    Attributes
    ----------
    scans : deque of (Packet, float)
        Packets of streams with their times of arrival, in order.
    """

    def __init__(self, port: Port, *, url: str, clock: Clock, dice: random.Random | None = None) -> None:
        self.port = port
        self.url = url
        self.counts = LinkCounts()
        self.receiver = Receiver()
        self.scans: deque[tuple[Packet, float]] = deque()
        self._clock = clock
        self._dice = dice or random.Random()
        # Ids continue over sessions on this port, so that a late packet of an old session has an old id.
        self._id = self._dice.randrange(1 << 16)
        self._replies: deque[Packet] = deque()

    # -- requests ---------------------------------------------------------------------------------------

    def hello(self, wait_s: float) -> wire.HelloReply:
        """Open a session with the firmware; try for `wait_s` seconds, because a board may be booting.

        Zeros are sent before each hello, so that a listening boot loader leaves instead of reading it.

        Raises
        ------
        BusTimeoutError
            No firmware answered.
        ProtocolError
            It speaks another version.
        """
        nonce = self._dice.randrange(1 << 32)
        packet = self._packet(wire.HelloRequest(wire.VERSION, nonce))
        end_s = self._clock.now_s() + wait_s
        bad = self.receiver.counts.bad
        quiet_s = end_s - max(wait_s - LOADER_S, HELLO_EVERY_S)

        def again(sent: int) -> bool:
            if sent and self._clock.now_s() >= end_s:
                return False
            if sent == EARLY_HELLOS:
                self._listen(quiet_s - self._clock.now_s())
            self._send_zeros(ZEROS_AGAIN_S if sent else ZEROS_FIRST_S)
            return True

        answer, _ = self._converse(packet, wire.HelloReply, HELLO_EVERY_S, again, nonce)
        if isinstance(answer, wire.HelloReply):
            if answer.protocol != wire.VERSION:
                raise self._other_version(answer.protocol)
            return answer
        if answer is not None:
            if answer.code == wire.Refusal.PROTOCOL_VERSION:
                raise self._other_version(answer.detail)
            raise ProtocolError(f"{self.url}: {RefusedError('hello', answer, once=True)}")
        noise = ", only noise (another baud rate?)" if self.receiver.counts.bad > bad else ""
        raise BusTimeoutError(
            f"{self.url}: no adis-gonio firmware answers within {wait_s:g} s{noise}; is it flashed, and is"
            " this its port (docs/hardware.md)?"
        )

    def request(self, body: Body, reply: type[B], runs_s: float = 0.0) -> B:
        """Send a request and return its reply.

        Parameters
        ----------
        runs_s : float
            Time that the firmware needs to execute it.

        Raises
        ------
        RefusedError
            The firmware refused the request.
        BusTimeoutError
            No answer to any try.
        """
        packet = self._packet(body)
        self.counts.requests += 1
        wait_s = RETRY_S + 1.1 * runs_s
        answer, sent = self._converse(packet, reply, wait_s, lambda sent: sent < TRIES)
        if isinstance(answer, wire.Error):
            raise RefusedError(type(body).__name__, answer, once=sent == 1)
        if answer is None:
            raise BusTimeoutError(
                f"{self.url}: no answer from the firmware to {TRIES} tries of {type(body).__name__}"
            )
        return answer

    @property
    def last_id(self) -> int:
        """Id of the request that was sent last."""
        return self._id

    def pump(self, wait_s: float) -> bool:
        """Receive packets and sort them into scans and replies; return False if nothing arrived in time."""
        data = self.port.receive(wait_s)
        if not data:
            return False
        arrival_s = self._clock.now_s()
        for packet in self.receiver.feed(data):
            if packet.type == wire.PacketType.SCANS:
                self.scans.append((packet, arrival_s))
            else:
                self._replies.append(packet)
        return True

    def _listen(self, wait_s: float) -> None:
        """Receive packets for `wait_s` seconds without sending."""
        end_s = self._clock.now_s() + wait_s
        while (left := end_s - self._clock.now_s()) > 0:
            self.pump(left)

    def _send_zeros(self, length_s: float) -> None:
        end_s = self._clock.now_s() + length_s
        while self._clock.now_s() < end_s:
            self.port.send(ZEROS)
            self._listen(ZEROS_EVERY_S)
        self._listen(LEAVE_S)

    # -- packets ----------------------------------------------------------------------------------------

    def _packet(self, body: Body) -> bytes:
        self._id = (self._id + 1) & 0xFFFF
        return encode(Packet.of(body, self._id))

    def _converse(
        self,
        packet: bytes,
        reply: type[B],
        wait_s: float,
        again: Callable[[int], bool],
        nonce: int | None = None,
    ) -> tuple[B | wire.Error | None, int]:
        """Send a request until it is answered; return the reply or refusal, and the number of copies sent.

        The reply is None if no answer came. `again(copies sent)` decides if one more copy may be sent.
        """
        sent = 0
        while again(sent):
            self.port.send(packet)
            sent += 1
            answer = self._await(reply, wait_s, nonce)
            if answer is not None:
                return answer, sent
            self.counts.retries += 1
        return None, sent

    def _await(self, reply: type[B], wait_s: float, nonce: int | None) -> B | wire.Error | None:
        end_s = self._clock.now_s() + wait_s
        while True:
            while self._replies:
                answer = self._judge(self._replies.popleft(), reply)
                if isinstance(answer, wire.HelloReply) and answer.nonce != nonce:
                    answer = None
                if answer is not None:
                    return answer
                self.counts.late += 1
            left = end_s - self._clock.now_s()
            if left <= 0:
                return None
            self.pump(left)

    def _judge(self, packet: Packet, reply: type[B]) -> B | wire.Error | None:
        """Decode a packet as the reply to the last request; None if it is invalid or not that reply."""
        if packet.id != self._id:
            return None
        try:
            if packet.type == reply.TYPE:
                return reply.unpack(packet.body)
            if packet.type == wire.PacketType.ERROR:
                error = wire.Error.unpack(packet.body)
                return error if error.request | wire.REPLY_BIT == reply.TYPE else None
        except ProtocolError:
            pass
        return None

    def _other_version(self, version: int) -> ProtocolError:
        return ProtocolError(
            f"{self.url}: the firmware speaks protocol version {version}, this package {wire.VERSION}:"
            " flash the firmware of this release (docs/hardware.md)"
        )
