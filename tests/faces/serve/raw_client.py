"""A served sensor in this process, and a plain client of iiod's protocol that knows no IIO."""

import contextlib
import socket
import threading

from adis_gonio.device.sensor import Adis16354, open_sensor
from adis_gonio.faces.serve import IioServer

WAIT_S = 300.0
"""A busy machine is slow; what hangs is seen all the same."""


@contextlib.contextmanager
def served(url="sim:?seed=1", sensor=None, **settings):
    """Yield (server's port, sensor, lines that it told); the server ends with the block."""
    with sensor or open_sensor(url) as sensor:
        ready, told, failure = threading.Event(), [], []
        port = []

        def taken(host, number):
            port.append(number)
            ready.set()

        server = IioServer(sensor, port=0, **settings, tell=told.append, ready=taken)

        def run():
            try:
                server.run()
            except Exception as error:
                failure.append(error)
            finally:
                ready.set()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            assert ready.wait(WAIT_S)
            yield Served(port[0], sensor, told, failure, thread)
        finally:
            server.stop()
            thread.join(WAIT_S)
            assert not thread.is_alive(), "the server does not end"


class Served:
    def __init__(self, port: int, sensor: Adis16354, told: list, failure: list, thread) -> None:
        self.port, self.sensor, self.told, self.failure, self.thread = port, sensor, told, failure, thread

    def client(self) -> "RawClient":
        return RawClient(self.port)


class RawClient:
    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=WAIT_S)
        self.file = self.socket.makefile("rb")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self) -> None:
        self.file.close()
        self.socket.close()

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def number(self) -> int:
        line = self.file.readline()
        assert line.endswith(b"\n"), f"the connection ended, {line!r} was left"
        return int(line)

    def ask(self, line: str, payload: bytes = b"") -> int:
        self.send(line.encode() + b"\r\n" + payload)
        return self.number()

    def text(self, line: str) -> str:
        length = self.ask(line)
        assert length >= 0, f"{line}: error {length}"
        value = self.file.read(length + 1)
        assert value[-1:] == b"\n"
        return value[:-1].rstrip(b"\0").decode()

    def write(self, what: str, value: str) -> int:
        content = value.encode() + b"\0"
        return self.ask(f"WRITE {what} {len(content)}", content)

    def open(self, mask: int, samples: int = 64) -> int:
        return self.ask(f"OPEN iio:device0 {samples} {mask:08x}")

    def scans(self, size: int, count: int) -> bytes:
        """`count` scans of `size` bytes by one READBUF."""
        self.send(f"READBUF iio:device0 {size * count}\r\n".encode())
        data, first = b"", True
        while len(data) < size * count:
            length = self.number()
            assert length > 0, f"error {length}"
            if first:
                assert len(self.file.readline()) == 9
                first = False
            data += self.file.read(length)
        return data
