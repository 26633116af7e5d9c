"""One connection: requests in order, an answer to each.

Reading the network and answering are two tasks, so that a client that leaves is noticed while an answer
waits for scans. A client that does not read its answers holds up nothing but itself.
"""

from __future__ import annotations

import asyncio
import contextlib

from adis_gonio.faces.serve import protocol
from adis_gonio.faces.serve.device import ScanFormat, ServedDevice
from adis_gonio.faces.serve.hub import Buffer, Hub
from adis_gonio.faces.serve.port import AttributePort
from adis_gonio.faces.serve.protocol import Errno, Parser, Refused, Request

MOST_PENDING = 32
"""Requests that a client may send ahead; then its bytes wait in the network."""

MOST_SENT = 1024
"""Scans in one piece of an answer."""

VERSION = (0, 24, "gonio-1")
"""Version of libiio whose protocol this is, and a tag of seven letters."""

_READ = 1 << 16


class ClientSession:
    """Answers one client until it leaves.

    Attributes
    ----------
    sent, lost : int
        Scans that it was sent, and that it was too slow for.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        device: ServedDevice,
        port: AttributePort,
        hub: Hub,
    ) -> None:
        self.sent = 0
        self._reader = reader
        self._writer = writer
        self._device = device
        self._port = port
        self._hub = hub
        self._buffer: Buffer | None = None
        self._lost_before = 0
        self._timeout_s: float | None = None
        self._gone = False
        self._pending: asyncio.Queue[Request] = asyncio.Queue(MOST_PENDING)

    @property
    def lost(self) -> int:
        """Scans that this client was too slow for."""
        return self._lost_before + (self._buffer.queue.lost if self._buffer else 0)

    async def run(self) -> None:
        """Serve until the client leaves, says EXIT, or sends what cannot be understood any more."""
        tasks = [asyncio.create_task(self._listen()), asyncio.create_task(self._answer_all())]
        try:
            await tasks[1]
        except (ConnectionError, TimeoutError):
            pass  # the client is gone; nobody is left to be told
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
                # The server's end may cancel here, too, while the client has not taken what was sent.
                self._writer.transport.abort()

    async def _listen(self) -> None:
        """Bytes to requests, until there are no more."""
        parser = Parser()
        with contextlib.suppress(ConnectionError, TimeoutError):
            while data := await self._reader.read(_READ):
                for request in parser.feed(data):
                    await self._pending.put(request)
        self._gone = True
        if self._buffer is not None:
            self._buffer.news.set()
        await self._pending.put(protocol.Exit())

    async def _answer_all(self) -> None:
        while not isinstance(request := await self._pending.get(), protocol.Exit):
            try:
                answer = await self._answer(request)
            except Refused as refused:
                answer = protocol.error(refused.errno)
            self._writer.write(answer)
            await self._writer.drain()
            if isinstance(request, protocol.Malformed) and request.fatal:
                return

    async def _answer(self, request: Request) -> bytes:
        """Answer to a request; `Refused` is one as well."""
        match request:
            case protocol.Version():
                return protocol.version(*VERSION)
            case protocol.Help():
                return protocol.HELP
            case protocol.Print():
                return protocol.counted(self._device.xml(self._port.sampler.state).encode())
            case protocol.Timeout():
                self._timeout_s = request.milliseconds / 1000.0 or None
                return protocol.integer(0)
            case protocol.Malformed():
                raise Refused(request.errno, request.why)
            case protocol.ReadAttribute() | protocol.WriteAttribute():
                return await self._answer_attribute(request)
            case (
                protocol.Open()
                | protocol.Close()
                | protocol.ReadBuffer()
                | protocol.WriteBuffer()
                | protocol.GetTrigger()
                | protocol.SetTrigger()
                | protocol.SetBuffers()
            ):
                self._require_device(request.device)
                return await self._answer_buffer(request)
            case _:
                raise Refused(Errno.EINVAL)

    async def _answer_attribute(self, request: Request) -> bytes:
        match request:
            case protocol.ReadAttribute(target, ""):
                values = [await self._port.read(target, name) for name in self._port.names(target)]
                return protocol.all_values([value.encode() for value in values])
            case protocol.ReadAttribute(target, name):
                return protocol.counted((await self._port.read(target, name)).encode() + b"\0")
            case protocol.WriteAttribute(target, name, value) if name:
                await self._port.write(target, name, value)
                return protocol.integer(len(value))
            case _:
                raise Refused(Errno.ENOSYS, "attributes are written one at a time")

    async def _answer_buffer(self, request: Request) -> bytes:
        match request:
            case protocol.Open():
                self._open(request)
                return protocol.integer(0)
            case protocol.Close():
                self._require_buffer()
                self._close()
                return protocol.integer(0)
            case protocol.ReadBuffer():
                return await self._send_scans(self._require_buffer(), request.size)
            case protocol.WriteBuffer():
                raise Refused(Errno.EPERM, "a sensor has no outputs")
            case protocol.SetBuffers():
                return protocol.integer(0) if request.count else protocol.error(Errno.EINVAL)
            case _:
                raise Refused(Errno.ENOENT, "there are no triggers: the sensor's own updates drive it")

    def _require_device(self, device: str) -> None:
        if not self._device.knows(device):
            raise Refused(Errno.ENODEV, f"no device {device}")

    def _require_buffer(self) -> Buffer:
        if self._buffer is None:
            raise Refused(Errno.EBADF, "no buffer is open")
        return self._buffer

    def _open(self, request: protocol.Open) -> None:
        if self._buffer is not None:
            raise Refused(Errno.EBUSY, "a buffer is open")
        if request.cyclic or not request.samples:
            raise Refused(Errno.EINVAL, "a buffer has samples, and a sensor's is not cyclic")
        if self._hub.failure is not None:
            raise Refused(Errno.EIO, str(self._hub.failure))
        scan_format = ScanFormat.of_mask(self._device, request.mask)
        rate_hz = self._port.sampler.state.configuration.sample_rate_hz
        self._buffer = self._hub.open(scan_format, request.samples, rate_hz)

    def _close(self) -> None:
        if self._buffer is not None:
            self._lost_before = self.lost
            self._hub.close(self._buffer)
            self._buffer = None

    async def _send_scans(self, buffer: Buffer, size: int) -> bytes:
        """Send pieces as scans come; return what ends the answer."""
        scan_size = buffer.format.dtype.itemsize
        wanted, first = size // scan_size, True
        while wanted:
            if not len(buffer.queue):
                await self._news(buffer)
                continue
            scans = buffer.queue.take(min(wanted, MOST_SENT))
            count = len(scans) // scan_size
            mask = f"{buffer.format.mask}\n".encode() if first else b""
            self._writer.write(protocol.integer(len(scans)) + mask + scans)
            await self._writer.drain()
            wanted, first = wanted - count, False
            self.sent += count
        # A zero says that the rest, less than a scan, will not come.
        return protocol.integer(0) if size % scan_size or not size else b""

    async def _news(self, buffer: Buffer) -> None:
        """Wait for scans; `Refused` where none will come."""
        if self._hub.failure is not None:
            raise Refused(Errno.EIO, str(self._hub.failure))
        if self._gone:
            raise ConnectionResetError
        buffer.news.clear()
        try:
            await asyncio.wait_for(buffer.news.wait(), self._timeout_s)
        except TimeoutError:
            raise Refused(Errno.ETIMEDOUT, "no scan came in time") from None
