"""The server: clients over TCP, one sensor behind them."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from adis_gonio.base import __version__
from adis_gonio.base.errors import CannotOpenError
from adis_gonio.base.numbers import counted
from adis_gonio.device.sensor import DEFAULT_SCAN, Adis16354
from adis_gonio.faces.serve.client import ClientSession
from adis_gonio.faces.serve.device import ServedDevice
from adis_gonio.faces.serve.hub import QUEUE_S, Hub
from adis_gonio.faces.serve.port import AttributePort
from adis_gonio.faces.serve.sampler import FreshScans, Sampler

PORT = 30431
"""iiod's port."""

MOST_CLIENTS = 64
"""Connections at a time; a context of libiio has one, and one more for each open buffer."""

SEND_BUFFER = 1 << 15
"""Bytes that the system holds for a client: more than a second of all channels at full rate."""


@dataclass(frozen=True)
class ServeSettings:
    """How a sensor is served.

    Attributes
    ----------
    host, port
        Where to listen; port 0 takes a free one.
    allow_writes : bool
        Let clients write attributes.
    registers : tuple of str
        Output registers that become channels, in order.
    queue_s : float
        Time of no reading after which a client begins to lose its oldest scans.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    allow_writes: bool = False
    registers: tuple[str, ...] = DEFAULT_SCAN
    queue_s: float = QUEUE_S


class IioServer:
    """Serves a sensor until it is told to stop, or the sensor fails.

    Parameters
    ----------
    sensor : Adis16354
        Open; stays open afterwards. Nobody else may use it while the server runs.
    tell : callable
        Takes a line on what happens.
    ready : callable
        Takes host and port once clients can connect.

    Raises
    ------
    UsageError
        A register that IIO has no channel for.
    """

    def __init__(
        self,
        sensor: Adis16354,
        settings: ServeSettings,
        *,
        tell: Callable[[str], object] = lambda line: None,
        ready: Callable[[str, int], object] = lambda host, port: None,
    ) -> None:
        self._settings = settings
        self._tell = tell
        self._ready = ready
        description = f"{sensor.variant.name.upper()} at {sensor.bus.url}, adis-gonio {__version__}"
        self._device = ServedDevice(sensor.variant, settings.registers, description)
        names = [row.name for row in self._device.table]
        self._sampler = Sampler(sensor, names, self._scans_came, self._sensor_failed)
        self._hub = Hub(self._sampler.want, settings.queue_s)
        self._port = AttributePort(self._device, self._sampler, settings.allow_writes, self._hub.counts)
        self._clients: set[asyncio.Task[None]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end = asyncio.Event()

    def run(self) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; the sensor is then as a stream leaves it.

        Raises
        ------
        CannotOpenError
            The address cannot be listened on.
        BusError, ChipError
            The sensor failed; clients that waited had an error as answer.
        """
        asyncio.run(self._serve())

    def stop(self) -> None:
        """End `run`; may be called from any thread."""
        self._call(self._end.set)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(_report)
        host, port = self._settings.host, self._settings.port
        try:
            server = await asyncio.start_server(self._connected, host, port)
        except OSError as error:
            raise CannotOpenError(
                f"cannot listen on {host}, port {port} ({error.strerror or error}):"
                " give another --iio PORT or --listen ADDRESS"
            ) from error
        self._sampler.start()
        try:
            with self._ended_by_signals():
                place = server.sockets[0].getsockname()
                self._ready(place[0], place[1])
                await self._end.wait()
        finally:
            server.close()
            for task in self._clients:
                task.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)
            await asyncio.to_thread(self._sampler.stop)
        if self._hub.failure is not None:
            raise self._hub.failure

    @contextlib.contextmanager
    def _ended_by_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield  # signals are the main thread's business
            return
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = [signal.signal(number, lambda *_: self.stop()) for number in numbers]
        try:
            yield
        finally:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        name = _name_of(writer)
        if self._hub.clients >= MOST_CLIENTS:
            self._tell(f"{name}: refused, {MOST_CLIENTS} connections are open")
            writer.close()
            return
        if (task := asyncio.current_task()) is None:
            return  # asyncio runs this in a task
        self._clients.add(task)
        self._hub.clients += 1
        _prepare(writer)
        client = ClientSession(reader, writer, self._device, self._port, self._hub)
        begin_s = time.monotonic()
        try:
            # The end of the server cancels; a cancelled task of a connection would be logged as an error.
            with contextlib.suppress(asyncio.CancelledError):
                await client.run()
        finally:
            self._hub.clients -= 1
            self._clients.discard(task)
            if client.sent or client.lost:
                self._tell(
                    f"{name}: left after {time.monotonic() - begin_s:.1f} s,"
                    f" {counted(client.sent, 'scan')} sent, {client.lost} lost because it was slow"
                )

    # -- from the sampler's thread ------------------------------------------------------------------

    def _scans_came(self, scans: FreshScans) -> None:
        self._call(lambda: self._hub.publish(scans))

    def _sensor_failed(self, error: Exception) -> None:
        def fail() -> None:
            self._hub.fail(error)
            # One turn of the loop later, so that whoever waits for scans is answered first.
            asyncio.get_running_loop().call_later(0.2, self._end.set)

        self._call(fail)

    def _call(self, action: Callable[[], object]) -> None:
        """Do something in the event loop's thread, as long as there is one."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(action)


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Leave out that a connection broke where nobody waited for it any more: its end is what ended it."""
    if not isinstance(context.get("exception"), ConnectionError):
        loop.default_exception_handler(context)


def _prepare(writer: asyncio.StreamWriter) -> None:
    """Notice a client that vanished, and let little pile up for one that does not read."""
    endpoint = writer.get_extra_info("socket")
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)


def _name_of(writer: asyncio.StreamWriter) -> str:
    peer = writer.get_extra_info("peername")
    return f"{peer[0]}:{peer[1]}" if peer else "a client"
