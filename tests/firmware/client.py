"""Plain host: one request at a time, over the codec, without retries."""

from __future__ import annotations

from typing import Any, TypeVar

from adis_gonio.bus.wire import Body, Packet, Receiver, encode
from adis_gonio.bus.wire.protocol import VERSION, Error, HelloReply, HelloRequest, PacketType, Scans

Reply = TypeVar("Reply", bound=Body)


class Refused(Exception):
    """The firmware answered with an error."""

    def __init__(self, error: Error) -> None:
        super().__init__(f"request 0x{error.request:02X}: code {error.code}, detail {error.detail}")
        self.error = error


class Client:
    """Requests over a port that looks like pyserial's."""

    def __init__(self, port: Any, timeout_s: float = 0.5, clock: Any = None) -> None:
        self.port = port
        self.receiver = Receiver()
        self.next_id = 100
        self.scans: list[Packet] = []
        self.late: list[Packet] = []
        self._timeout_s = timeout_s
        self._now_s = clock or port.now_s

    def hello(self, nonce: int = 1) -> HelloReply:
        return self.request(HelloRequest(VERSION, nonce), HelloReply)

    def request(self, body: Body, reply: type[Reply]) -> Reply:
        self.next_id = (self.next_id + 1) & 0xFFFF
        self.send(body, self.next_id)
        return self.answer(self.next_id, reply)

    def send(self, body: Body, request_id: int) -> None:
        self.port.write(encode(Packet.of(body, request_id)))

    def answer(self, request_id: int, reply: type[Reply]) -> Reply:
        """The reply with an id; `Refused`, or `TimeoutError`."""
        end = self._now_s() + self._timeout_s
        while self._now_s() < end:
            answer = None
            for packet in self.poll():
                if packet.id == request_id and packet.type in (reply.TYPE, PacketType.ERROR):
                    answer = packet
                else:
                    self.late.append(packet)
            if answer is not None:
                if answer.type == PacketType.ERROR:
                    raise Refused(Error.unpack(answer.body))
                return reply.unpack(answer.body)
        raise TimeoutError(f"no answer to request {request_id}")

    def poll(self, wait_s: float = 0.001) -> list[Packet]:
        """Packets but scans, which are kept aside."""
        self.port.timeout = wait_s
        data = self.port.read(max(1, self.port.in_waiting))
        packets = self.receiver.feed(data)
        self.scans += [packet for packet in packets if packet.type == PacketType.SCANS]
        return [packet for packet in packets if packet.type != PacketType.SCANS]

    def take_scans(self) -> list[Scans]:
        taken, self.scans = self.scans, []
        return [Scans.unpack(packet.body) for packet in taken]
