"""The server of iiod's protocol: many clients over TCP, one sensor."""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from typing import Any, TypeVar

from adis_gonio.base import __version__, numbers
from adis_gonio.base.errors import AdisGonioError, CannotOpenError, UsageError
from adis_gonio.device.sensor import Adis16354
from adis_gonio.faces.serve import iio_device
from adis_gonio.faces.serve.iio_device import Channel
from adis_gonio.faces.serve.iiod_protocol import (
    LINE_LIMIT,
    Errno,
    Refused,
    Request,
    count,
    counted,
    error,
    read_request,
)

T = TypeVar("T")

PORT = 30431
"""Default TCP port of iiod."""

MOST_CLIENTS = 64
"""Largest number of connections.

A context of libiio has one connection, and one more for each open buffer.
"""

IDLE_S = 60.0
"""Time in s without a request after which a connection without a buffer gives way to a new one."""

SEND_BUFFER = 1 << 15
"""Size in bytes of the system's send buffer: more than a second of all channels at full rate."""


def _number(value: bytes) -> float:
    """Parse the text of an attribute, which libiio sends with a terminating zero, as a number."""
    text = value.split(b"\0", 1)[0].strip()
    try:
        number = math.nan if b"_" in text else float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise Refused(Errno.EINVAL)
    return number


MOST_PENDING = 32
"""Largest number of requests that a client may send ahead; further bytes wait in the network."""

MOST_SENT = 1024
"""Largest number of scans in one piece of an answer."""

NEVER = {"WRITEBUF": Errno.EPERM, "GETTRIG": Errno.ENOENT, "SETTRIG": Errno.ENOENT}
"""Errors that answer requests of outputs and triggers, which a sensor does not have."""

VERSION = b"0.24.gonio-1\n"
"""Version of libiio with this protocol, and a tag of seven letters that names this server."""


class ClientSession:
    """Answers the requests of one client until it disconnects.

    One task reads the network and another one answers, so that a disconnected client is noticed while an
    answer waits for scans. A client that does not read its answers holds up nothing but itself.

    Attributes
    ----------
    sent, lost : int
        Number of scans that were sent, and of scans that were lost because the client was too slow.
    """

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, server: IioServer
    ) -> None:
        self.sent = 0
        self._reader = reader
        self._writer = writer
        self._device, self._sampler, self._hub = server.device, server.sampler, server.hub
        self._allow_writes = server.allow_writes
        self._buffer: iio_device.Buffer | None = None
        self._lost_before = 0
        self._timeout_s: float | None = None
        self._gone = False
        self._last_s = time.monotonic()
        self._pending: asyncio.Queue[Request | Errno] = asyncio.Queue(MOST_PENDING)

    @property
    def lost(self) -> int:
        """Number of scans that were lost because this client read too slowly."""
        return self._lost_before + (0 if self._buffer is None else self._buffer.lost)

    @property
    def idle_s(self) -> float:
        """Time in s since the last request; 0 while a buffer is open."""
        return 0.0 if self._buffer is not None else time.monotonic() - self._last_s

    async def run(self) -> None:
        """Answer requests until the client leaves, sends EXIT, or sends a malformed request.

        Only malformed requests that make the next request unreadable end the connection.
        """
        tasks = [asyncio.create_task(self._listen()), asyncio.create_task(self._answer_all())]
        try:
            await tasks[1]
        except (ConnectionError, TimeoutError):
            pass  # the client is gone
        finally:
            for task in tasks:
                task.cancel()
            self._close()
            self._writer.close()
            try:
                await asyncio.gather(*tasks, return_exceptions=True)
                with contextlib.suppress(ConnectionError, TimeoutError):
                    await self._writer.wait_closed()
            finally:
                # The end of the server may also cancel here, while the client has not read all answers.
                self._writer.transport.abort()

    async def _listen(self) -> None:
        """Read requests into the queue until the connection ends."""
        with contextlib.suppress(ConnectionError, TimeoutError, asyncio.IncompleteReadError):
            while True:
                request = await read_request(self._reader)
                self._last_s = time.monotonic()
                await self._pending.put(request)
                if request is Errno.E2BIG:
                    return
        self._gone = True
        if self._buffer is not None:
            self._buffer.news.set()
        await self._pending.put(Request(("EXIT",)))

    async def _answer_all(self) -> None:
        while (request := await self._pending.get()) not in (Request(("EXIT",)), Request(("QUIT",))):
            try:
                answer = error(request) if isinstance(request, Errno) else await self._answer(request)
            except Refused as refused:
                answer = error(refused.errno)
            self._writer.write(answer)
            await self._writer.drain()
            if request is Errno.E2BIG:
                return

    async def _answer(self, request: Request) -> bytes:
        """Carry out a request and return the answer; raise `Refused` to answer with an error number."""
        match request.words:
            case ["VERSION"]:
                return VERSION
            case ["PRINT"]:
                return counted(self._device.xml(self._sampler.state).encode())
            case ["TIMEOUT", milliseconds]:
                self._timeout_s = count(milliseconds) / 1000.0 or None
            case ["READ", device, *attribute]:
                return counted((await self._read(*self._attribute(device, attribute))).encode() + b"\0")
            case ["WRITE", device, *attribute, size]:
                await self._write(*self._attribute(device, attribute), request.value)
                return f"{size}\n".encode()
            case ["OPEN", device, samples, mask]:
                self._device.require(device)
                self._open(count(samples), mask)
            case ["CLOSE", device]:
                self._require_buffer(device)
                self._close()
            case ["READBUF", device, size]:
                return await self._send_scans(self._require_buffer(device), count(size))
            case [verb, *_]:
                raise Refused(NEVER.get(verb, Errno.EINVAL))
        return b"0\n"

    # -- attributes -------------------------------------------------------------------------------

    def _attribute(self, device: str, words: Sequence[str]) -> tuple[Channel | None, str]:
        """Return channel and name of an attribute from the words of a request; None for the device's.

        `device` is the id or name of the device. `Refused` is raised if there is no such attribute.
        """
        channel = None
        match words:
            case [kind, channel_id, name] if kind.upper() == "INPUT":
                self._device.require(device)
                channel = self._device.channel(channel_id)
            case [name]:
                self._device.require(device)
            case _:
                raise Refused(Errno.EINVAL)
        if name not in (iio_device.DEVICE_ATTRIBUTES if channel is None else channel.attributes):
            raise Refused(Errno.ENOENT)
        return channel, name

    async def _read(self, channel: Channel | None, name: str) -> str:
        """Read an attribute as text, if possible without interrupting the stream.

        `channel` is None for an attribute of the device. `Refused` is raised if the sensor fails.
        """
        sampler = self._sampler
        if channel is None:
            return self._device.device_value(name, sampler.state)
        row = channel.register
        if name != "raw" or row is None:
            return self._device.channel_value(channel, name, sampler.state)
        if sampler.newest is not None:  # the sensor streams
            return str(sampler.newest[row.name])
        return str(await _result(sampler.submit(lambda _: sampler.read_output(row))))

    async def _write(self, channel: Channel | None, name: str, value: bytes) -> None:
        """Write an attribute; raise `Refused` if that is not allowed, or the value is not possible.

        `channel` is None for an attribute of the device; `value` is the text from the client.
        """
        if name not in iio_device.WRITABLE:
            raise Refused(Errno.EACCES)
        if not self._allow_writes:
            raise Refused(Errno.EPERM)
        number = _number(value)
        if name == "sampling_frequency":
            await self._change(lambda sensor: sensor.configure(sample_rate_hz=number))
        elif name == "calibbias" and channel is not None and channel.register is not None:
            if not number.is_integer():
                raise Refused(Errno.EINVAL)
            offset = iio_device.OFFSET_OF[channel.register.name]
            await self._change(lambda sensor: sensor.write(offset, int(number)))
        else:
            taps = iio_device.filter_for(number, self._sampler.state)
            await self._change(lambda sensor: sensor.configure(filter_m=taps))

    async def _change(self, job: Callable[[Adis16354], object]) -> None:
        await _result(self._sampler.submit(job, changes=True))

    # -- scans ------------------------------------------------------------------------------------

    def _require_buffer(self, device: str) -> iio_device.Buffer:
        self._device.require(device)
        if self._buffer is None:
            raise Refused(Errno.EBADF)
        return self._buffer

    def _open(self, samples: int, mask: str) -> None:
        if self._buffer is not None:
            raise Refused(Errno.EBUSY)
        if not samples:
            raise Refused(Errno.EINVAL)
        if self._hub.failure is not None:
            raise Refused(Errno.EIO)
        scan_format = iio_device.ScanFormat.of_mask(self._device, mask)
        rate_hz = self._sampler.state.configuration.sample_rate_hz
        self._buffer = self._hub.open(scan_format, samples, rate_hz)

    def _close(self) -> None:
        if self._buffer is not None:
            self._lost_before = self.lost
            self._hub.close(self._buffer)
            self._buffer = None

    async def _send_scans(self, buffer: iio_device.Buffer, size: int) -> bytes:
        """Send `size` bytes of scans from a buffer in pieces as they come.

        Return the bytes that end the answer.
        """
        scan_size = buffer.format.dtype.itemsize
        wanted, mask = size // scan_size, f"{buffer.format.mask}\n".encode()
        while wanted:
            if not len(buffer):
                await self._news(buffer)
                continue
            scans = buffer.take(min(wanted, MOST_SENT))
            self._writer.write(b"%d\n%b%b" % (len(scans), mask, scans))
            await self._writer.drain()
            wanted, mask = wanted - len(scans) // scan_size, b""
            self.sent += len(scans) // scan_size
        # A zero ends the answer if the remaining size is less than a scan.
        return b"0\n" if size % scan_size or not size else b""

    async def _news(self, buffer: iio_device.Buffer) -> None:
        """Wait for new scans in the buffer; raise `Refused` if no scan comes.

        No scan comes after a failure of the sensor, or within the client's time-out.
        """
        if self._hub.failure is not None:
            raise Refused(Errno.EIO)
        if self._gone:
            raise ConnectionResetError
        buffer.news.clear()
        try:
            await asyncio.wait_for(buffer.news.wait(), self._timeout_s)
        except TimeoutError:
            raise Refused(Errno.ETIMEDOUT) from None


async def _result(future: Future[T]) -> T:
    """Wait for the result of a job of the sampler; raise `Refused` if the job failed."""
    try:
        return await asyncio.wrap_future(future)
    except UsageError as reason:
        raise Refused(Errno.EINVAL) from reason
    except AdisGonioError as reason:
        raise Refused(Errno.EIO) from reason


class IioServer:
    """Serves a sensor until it is stopped, or the sensor fails.

    Parameters
    ----------
    sensor : Adis16354
        The open sensor, which stays open afterwards; the server must be its only user.
    host, port : str, int
        Address to listen on; port 0 takes a free one.
    allow_writes : bool
        True lets clients write attributes.
    queue_s : float
        Time without a read after which a client begins to lose its oldest scans.
    tell : callable
        Called with one-line messages.
    ready : callable
        Called with host and port once clients can connect.
    """

    def __init__(
        self,
        sensor: Adis16354,
        host: str = "127.0.0.1",
        port: int = PORT,
        *,
        allow_writes: bool = False,
        queue_s: float = iio_device.QUEUE_S,
        tell: Callable[[str], object] = lambda line: None,
        ready: Callable[[str, int], object] = lambda host, port: None,
    ) -> None:
        self.allow_writes = allow_writes
        self._address = host, port
        self._tell = tell
        self._ready = ready
        description = f"{sensor.variant.name.upper()} at {sensor.bus.url}, adis-gonio {__version__}"
        self.device = iio_device.ServedDevice(sensor.variant, description)
        self.sampler = iio_device.Sampler(
            sensor, lambda *scans: self._call(self.hub.publish, *scans), self._sensor_failed
        )
        self.hub = iio_device.Hub(self.sampler.want, queue_s)
        self._clients: dict[ClientSession, asyncio.Task[None]] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end = asyncio.Event()

    def run(self) -> None:
        """Serve until SIGINT, SIGTERM or `stop`; the sensor's registers are then restored.

        Raises
        ------
        CannotOpenError
            The server cannot listen on the address.
        BusError, ChipError
            The sensor failed; waiting clients got an error.
        """
        asyncio.run(self._serve())

    def stop(self) -> None:
        """End the method `run`; may be called from any thread."""
        self._call(self._end.set)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(_report)
        host, port = self._address
        try:
            server = await asyncio.start_server(self._connected, host, port, limit=LINE_LIMIT)
        except (OSError, UnicodeError) as error:  # a UnicodeError for a name that no host can have
            raise CannotOpenError(
                f"cannot listen on {host}, port {port} ({getattr(error, 'strerror', None) or error}):"
                " give another --iio PORT or --listen ADDRESS"
            ) from error
        try:
            with self._ended_by_signals():
                place = server.sockets[0].getsockname()
                self._ready(place[0], place[1])
                await self._end.wait()
        finally:
            server.close()
            tasks = list(self._clients.values())
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.to_thread(self.sampler.stop)
        if self.hub.failure is not None:
            raise self.hub.failure

    @contextlib.contextmanager
    def _ended_by_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield  # only the main thread handles signals
            return
        numbers = (signal.SIGINT, signal.SIGTERM)
        before = [signal.signal(number, lambda *_: self.stop()) for number in numbers]
        try:
            yield
        finally:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("peername")
        name = f"{peer[0]}:{peer[1]}" if peer else "a client"
        if len(self._clients) >= MOST_CLIENTS:
            # The connection that was idle longest ends, if it was idle for `IDLE_S`.
            idlest = max(self._clients, key=lambda client: client.idle_s)
            if idlest.idle_s < IDLE_S:
                self._tell(f"{name}: refused, {MOST_CLIENTS} connections are in use")
                writer.close()
                return
            self._clients.pop(idlest).cancel()
        if (task := asyncio.current_task()) is None:
            return  # asyncio runs this in a task
        # Detect a vanished client, and limit the unread data kept for it.
        endpoint = writer.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        client = ClientSession(reader, writer, self)
        self._clients[client] = task
        begin_s = time.monotonic()
        try:
            # The end of the server cancels the task; asyncio would log a cancelled connection as an error.
            with contextlib.suppress(asyncio.CancelledError):
                await client.run()
        finally:
            self._clients.pop(client, None)
            if client.sent or client.lost:
                self._tell(
                    f"{name}: left after {time.monotonic() - begin_s:.1f} s,"
                    f" {numbers.counted(client.sent, 'scan')} sent, {client.lost} lost because it was slow"
                )

    # -- from the sampler's thread ------------------------------------------------------------------

    def _sensor_failed(self, error: Exception) -> None:
        def fail() -> None:
            self.hub.fail(error)
            # A little later, so that waiting clients get their answer first.
            asyncio.get_running_loop().call_later(0.2, self._end.set)

        self._call(fail)

    def _call(self, action: Callable[..., object], *arguments: object) -> None:
        """Call `action` with the arguments in the thread of the event loop, if the loop still runs."""
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(action, *arguments)


def _report(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report the unhandled error in `context`, unless it is only a broken connection."""
    if not isinstance(context.get("exception"), ConnectionError):
        loop.default_exception_handler(context)
