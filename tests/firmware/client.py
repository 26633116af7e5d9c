"""Plain host: one request at a time, over the codec."""

from __future__ import annotations

from typing import Any, TypeVar

from adis_gonio.device.bus.wire import Body, Packet, Receiver, encode
from adis_gonio.device.bus.wire.protocol import (
    RETRY_MS,
    VERSION,
    Error,
    HelloReply,
    HelloRequest,
    PacketType,
    Scans,
)

Reply = TypeVar("Reply", bound=Body)


TRIES = 40
"""Beside a dense stream the simulated UART loses bytes that a real one would not (see rig.py): on a full
line most requests."""


LATER_S = 0.0371
"""Each try waits longer, so that it falls elsewhere between two scans: 0.25 s are 204.8 of them."""


class RefusedError(Exception):
    """The firmware answered with an error."""

    def __init__(self, error: Error) -> None:
        super().__init__(f"request 0x{error.request:02X}: code {error.code}, detail {error.detail}")
        self.error = error


class Client:
    """Requests over a port with `send`, `receive` and `now_s`."""

    def __init__(self, port: Any, timeout_s: float = RETRY_MS / 1000) -> None:
        self.port = port
        self.receiver = Receiver()
        self.next_id = 100
        self.scans: list[Packet] = []
        self.late: list[Packet] = []
        self.retries = 0
        self._timeout_s = timeout_s

    def hello(self, nonce: int = 1) -> HelloReply:
        return self.request(HelloRequest(VERSION, nonce), HelloReply)

    def request(self, body: Body, reply: type[Reply]) -> Reply:
        """A request with a new id, repeated with that id until it is answered."""
        self.next_id = (self.next_id + 1) & 0xFFFF
        for k in range(TRIES - 1):
            self.send(body, self.next_id)
            try:
                return self.answer(self.next_id, reply, k * LATER_S)
            except TimeoutError:
                self.retries += 1
        self.send(body, self.next_id)
        return self.answer(self.next_id, reply)

    def send(self, body: Body, request_id: int) -> None:
        self.port.send(encode(Packet.of(body, request_id)))

    def answer(self, request_id: int, reply: type[Reply], more_s: float = 0.0) -> Reply:
        """The reply with an id; `RefusedError`, or `TimeoutError`."""
        end = self.port.now_s() + self._timeout_s + more_s
        while self.port.now_s() < end:
            answer = None
            for packet in self.poll():
                if packet.id == request_id and packet.type in (reply.TYPE, PacketType.ERROR):
                    answer = packet
                else:
                    self.late.append(packet)
            if answer is not None:
                if answer.type == PacketType.ERROR:
                    raise RefusedError(Error.unpack(answer.body))
                return reply.unpack(answer.body)
        raise TimeoutError(f"no answer to request {request_id}")

    def poll(self, wait_s: float = 0.001) -> list[Packet]:
        """Packets but scans, which are kept aside."""
        packets = self.receiver.feed(self.port.receive(wait_s))
        self.scans += [packet for packet in packets if packet.type == PacketType.SCANS]
        return [packet for packet in packets if packet.type != PacketType.SCANS]

    def take_scans(self) -> list[Scans]:
        taken, self.scans = self.scans, []
        return [Scans.unpack(packet.body) for packet in taken]
