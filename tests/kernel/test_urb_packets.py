"""The URB server without a kernel: packets as vhci-hcd sends them, on a plain socket."""

import errno
import random
import socket
import struct
from collections.abc import Iterator

import pytest

from kernel.boards import BulkBoard
from kernel.echoes import EchoBulk
from kernel.urb import connect

TIME_OUT_S = 5


class Host:
    """Speaks the kernel's side."""

    def __init__(self, board: BulkBoard) -> None:
        self.plug = connect(board)
        self.plug.settimeout(TIME_OUT_S)
        self.number = 0

    def submit(
        self, endpoint: int, *, data: bytes = b"", length: int = 0, setup: bytes = bytes(8), into: bool
    ) -> int:
        self.number += 1
        header = struct.pack(">5I", 1, self.number, 0x10001, into, endpoint)
        body = struct.pack(">IiiiI8s", 0, len(data) or length, 0, 0, 0, setup)
        self.plug.sendall(header + body + data)
        return self.number

    def unlink(self, victim: int) -> int:
        self.number += 1
        self.plug.sendall(struct.pack(">5I", 2, self.number, 0x10001, 0, 0) + struct.pack(">I24x", victim))
        return self.number

    def answer(self, *, into: bool = False) -> tuple[int, int, int, int, bytes]:
        """Command, number, status, length and data of the next packet."""
        command, number, _, _, _, status, actual = struct.unpack(">5Iii20x", self.take(48))
        return command, number, status, actual, self.take(actual) if into and command == 3 else b""

    def take(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.plug.recv(count - len(data))
            if not part:
                raise EOFError
            data += part
        return data


@pytest.fixture
def board() -> BulkBoard:
    return BulkBoard(EchoBulk(), "RIG-1")


@pytest.fixture
def host(board: BulkBoard) -> Iterator[Host]:
    host = Host(board)
    yield host
    host.plug.close()


def test_descriptors_are_read_as_far_as_asked(host: Host) -> None:
    setup = struct.pack("<BBHHH", 0x80, 6, 0x0100, 0, 8)
    number = host.submit(0, length=8, setup=setup, into=True)
    assert host.answer(into=True) == (3, number, 0, 8, bytes([18, 1, 0, 2, 0, 0, 0, 64]))
    host.submit(0, length=255, setup=struct.pack("<BBHHH", 0x80, 6, 0x0303, 0x0409, 255), into=True)
    assert host.answer(into=True)[4] == b"\x0c\x03" + "RIG-1".encode("utf-16-le")


def test_data_waits_for_requests_and_requests_for_data(host: Host) -> None:
    early = host.submit(2, length=64, into=True)
    out = host.submit(1, data=b"abc", into=False)
    first, second = host.answer(into=True), host.answer()
    assert first == (3, early, 0, 3, b"abc")
    assert second == (3, out, 0, 3, b"")
    host.submit(1, data=b"defg", into=False)
    host.answer()
    host.submit(2, length=3, into=True)
    assert host.answer(into=True)[4] == b"def"
    host.submit(2, length=64, into=True)
    assert host.answer(into=True)[4] == b"g"


def test_a_request_that_waits_can_be_taken_back_and_one_that_was_answered_cannot(host: Host) -> None:
    waiting = host.submit(2, length=64, into=True)
    number = host.unlink(waiting)
    assert host.answer()[:3] == (4, number, -errno.ECONNRESET)
    number = host.unlink(waiting)
    assert host.answer()[:3] == (4, number, 0)


def test_a_halted_endpoint_refuses_until_it_is_cleared(host: Host, board: BulkBoard) -> None:
    waiting = host.submit(2, length=64, into=True)
    host.submit(0, length=2, setup=struct.pack("<BBHHH", 0x80, 0, 0, 0, 2), into=True)
    assert host.answer(into=True)[4] == b"\0\0"
    board.stall(0x82)
    assert host.answer()[:3] == (3, waiting, -errno.EPIPE)
    host.submit(2, length=64, into=True)
    assert host.answer()[2] == -errno.EPIPE
    host.submit(0, setup=struct.pack("<BBHHH", 0x02, 1, 0, 0x82, 0), into=False)
    assert host.answer()[2] == 0
    host.submit(1, data=b"ab", into=False)
    host.answer()
    host.submit(2, length=64, into=True)
    assert host.answer(into=True)[2:] == (0, 2, b"ab")


def test_requests_that_the_model_does_not_know_are_stalled(host: Host) -> None:
    host.submit(0, length=4, setup=struct.pack("<BBHHH", 0xC0, 0x77, 0, 0, 4), into=True)
    assert host.answer()[2] == -errno.EPIPE


def test_random_bytes_end_the_link_and_nothing_else(board: BulkBoard) -> None:
    for seed in range(20):
        host = Host(board)
        try:
            host.plug.sendall(random.Random(seed).randbytes(4096))
            host.plug.shutdown(socket.SHUT_WR)
            while host.plug.recv(4096):
                pass
        except (ConnectionError, BrokenPipeError):
            pass
        host.plug.close()
