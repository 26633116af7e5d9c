"""`serve` at the simulated bench: its event loop, its thread and its clients in virtual time.

The server is the real one. The loop waits by advancing the clock of the bench, connections are pipes in
memory, and the thread that reads the sensor runs only while the loop waits: it gives way when it has news
for the loop or waits for an event. The order of all actions thus follows from the seed alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import selectors
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np

from adis_gonio.device.sensor import DEFAULT_SCAN
from adis_gonio.device.sensor.registers import BY_NAME
from adis_gonio.faces.serve import iio_device, iio_server
from simulated_bench.disk import Killed, OvertimeError

if TYPE_CHECKING:
    from simulated_bench.bench import Bench

LONGEST_ANSWER_S = 60.0
"""No request may wait longer: the slowest bridge of a story takes 20 s for a batch."""
CROWD = 64
CHANNELS = {name: iio_device.Channel.of(0, BY_NAME[name]).id for name in DEFAULT_SCAN}
TIME_BIT = len(DEFAULT_SCAN)
DEVICE = "iio:device0"


# -- the thread ----------------------------------------------------------------------------------------


class _Thread:
    """A thread that runs only while the loop lets it; takes the place of `threading.Thread`."""

    def __init__(self, loop: VirtualLoop, *, target: Callable[[], object], **_: object) -> None:
        self._loop, self._target = loop, target
        self._go, self._done = threading.Semaphore(0), threading.Semaphore(0)
        self._real = threading.Thread(target=self._run, daemon=True)
        self._error: BaseException | None = None
        self._ready: Callable[[], bool] = lambda: True
        self._abandoned = False
        self.ended = False

    @property
    def ready(self) -> bool:
        """True if the thread does not wait for an event."""
        return not self.ended and self._ready()

    @property
    def running(self) -> bool:
        """True if this thread asks."""
        return threading.current_thread() is self._real

    def start(self) -> None:
        self._loop.thread = self
        self._real.start()

    def finish(self) -> None:
        while not self.ended:
            if not self.ready:
                raise OvertimeError("the thread of the sampler waits for ever")
            self.resume()

    def resume(self) -> None:
        """Let the thread run until it gives way; raise the error that ended it, if any."""
        self._go.release()
        self._done.acquire()
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def give_way(self, ready: Callable[[], bool] = lambda: True) -> None:
        """Let the loop run until `ready` returns True."""
        if self._abandoned:
            raise Killed
        self._ready = ready
        self._done.release()
        self._go.acquire()
        if self._abandoned:
            raise Killed

    def abandon(self) -> None:
        """End the thread, as the end of the process does."""
        self._abandoned = True
        with contextlib.suppress(BaseException):
            if not self.ended:
                self.resume()

    def _run(self) -> None:
        self._go.acquire()
        try:
            if not self._abandoned:
                self._target()
        except BaseException as error:
            self._error = error
        finally:
            self.ended = True
            self._done.release()


class _Event:
    """Takes the place of `threading.Event` for the thread."""

    def __init__(self, loop: VirtualLoop) -> None:
        self._loop, self._set = loop, False

    def set(self) -> None:
        self._set = True

    def clear(self) -> None:
        self._set = False

    def wait(self) -> None:
        if not self._set and self._loop.thread is not None:
            self._loop.thread.give_way(lambda: self._set)


class _Executor:
    """Takes the place of `ThreadPoolExecutor` with its one thread."""

    def __init__(self, loop: VirtualLoop, *_: object) -> None:
        self._loop = loop
        self._tasks: deque[Callable[[], object]] = deque()
        self._ending = False
        self._thread = _Thread(loop, target=self._work)
        self._thread.start()

    def submit(self, function: Callable[..., Any], *arguments: object) -> Future[Any]:
        future: Future[Any] = Future()

        def task() -> None:
            try:
                result = function(*arguments)
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)

        self._tasks.append(task)
        return future

    def shutdown(self, *, cancel_futures: bool) -> None:
        self._ending = True
        self._tasks.clear()
        self._thread.finish()

    def _work(self) -> None:
        while self._tasks or not self._ending:
            if self._tasks:
                self._tasks.popleft()()
            else:
                self._thread.give_way(lambda: bool(self._tasks) or self._ending)


# -- the loop ------------------------------------------------------------------------------------------


class _Selector(selectors.SelectSelector):
    """Waits by letting the thread run, or else the clock of the bench."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self.loop: VirtualLoop | None = None

    def select(self, timeout=None):
        bench, thread = self.bench, self.loop.thread if self.loop else None
        bench.require_alive()
        bench.pass_to(bench.now_s)  # Ctrl-C may have come while the thread ran
        if timeout is not None and timeout <= 0:
            return []
        if thread is not None and thread.ready:
            thread.resume()
        elif (until_s := bench.next_event_s(timeout)) < np.inf:
            bench.advance(max(0.0, until_s - bench.now_s))
        else:
            raise OvertimeError("the server waits for ever")
        return []


class VirtualLoop(asyncio.SelectorEventLoop):
    """An event loop on the clock of the bench, with the connections of one server."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.thread: _Thread | None = None
        self.going: asyncio.Task[None] | None = None
        self.accept: Callable[..., Coroutine[Any, Any, None]] | None = None
        selector = _Selector(bench)
        super().__init__(selector)
        selector.loop = self

    def time(self) -> float:
        return self.bench.now_s

    def call_soon_threadsafe(self, *args, **options):
        handle = super().call_soon_threadsafe(*args, **options)
        if self.thread is not None and self.thread.running:
            self.thread.give_way()
        return handle

    def run_in_executor(self, executor, func, *args):
        done = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:
            done.set_exception(error)
        return done

    def connect(self, name: str) -> tuple[asyncio.StreamReader, _Pipe] | None:
        """Connect a client; None if no server listens."""
        if self.accept is None:
            return None
        theirs, ours = asyncio.StreamReader(loop=self), asyncio.StreamReader(1 << 15, loop=self)
        to_server, to_client = _Pipe(theirs, name), _Pipe(ours, name)
        to_server.other, to_client.other = to_client, to_server
        task = self.create_task(self.accept(theirs, to_client))
        task.add_done_callback(self._report)
        return ours, to_server

    def _report(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and task.exception() is not None:
            self.call_exception_handler({"message": "connection", "exception": task.exception()})

    def leave(self) -> None:
        """Forget all that a killed process leaves behind."""
        if self.thread is not None:
            self.thread.abandon()
        asyncio.set_event_loop(self)  # else a coroutine that is closed makes a loop of its own
        for task in asyncio.all_tasks(self):
            task._log_destroy_pending = False
            with contextlib.suppress(BaseException):
                task.get_coro().close()
        asyncio.set_event_loop(None)
        self.close()


class _Pipe:
    """One direction of a connection; takes the place of `asyncio.StreamWriter` and of its transport."""

    other: _Pipe

    def __init__(self, reader: asyncio.StreamReader, name: str) -> None:
        self._reader, self._name = reader, name
        self._room = asyncio.Event()
        self._room.set()
        self._closed = self.lost = False
        self.transport = self
        reader.set_transport(self)

    def pause_reading(self) -> None:
        self._room.clear()

    def resume_reading(self) -> None:
        self._room.set()

    def write(self, data: bytes) -> None:
        if data and not self._closed and not self.lost:
            self._reader.feed_data(data)

    async def drain(self) -> None:
        while not (self.lost or self._room.is_set()):
            await asyncio.sleep(0.01)
        if self.lost:
            raise ConnectionResetError

    def close(self) -> None:
        """End this direction; the other side reads what is on its way, and then the end."""
        if not self._closed:
            self._closed = True
            self._reader.feed_eof()

    def abort(self) -> None:
        self.close()
        self.other.lose()

    async def wait_closed(self) -> None:
        await self.drain()

    def lose(self) -> None:
        """Nobody reads this direction any more."""
        self.lost = True
        self._room.set()

    def get_extra_info(self, name: str) -> Any:
        return {"socket": SimpleNamespace(setsockopt=lambda *_: None), "peername": (self._name, 0)}[name]


class _Listening:
    """Takes the place of `asyncio.Server`."""

    def __init__(self, loop: VirtualLoop, host: str, port: int) -> None:
        self._loop = loop
        self.sockets = [SimpleNamespace(getsockname=lambda: (host, port))]

    def close(self) -> None:
        self._loop.accept = None


# -- the clients ---------------------------------------------------------------------------------------


@dataclass
class Client:
    """A client of the server, and what it got.

    Attributes
    ----------
    raws : list of (float, str, int)
        Readings, each with the time in s of the answer and its register.
    scans : list of (names, numbers, times)
        Pieces of buffers: registers, numbers (n, k), times (n,) in s on the clock of the bench.
    complaint : str
        What the server did wrong, or empty.
    said : list of str
        What happened, for the story.
    """

    number: int
    kind: str
    rng: np.random.Generator
    bench: Bench
    loop: VirtualLoop
    raws: list[tuple[float, str, int]] = field(default_factory=list)
    scans: list[tuple[list[str], np.ndarray, np.ndarray]] = field(default_factory=list)
    complaint: str = ""
    said: list[str] = field(default_factory=list)
    heard: Any = field(default_factory=hashlib.sha256)

    async def live(self) -> None:
        """Come at some time, do what clients of this kind do, and go."""
        await asyncio.sleep(float(self.rng.uniform(0, 3)))
        if not self._connect():
            return self.say("is too late")
        try:
            await KINDS[self.kind](self)
            self.say("is content")
        except _RefusedError as error:
            self.say(f"gets {error}")
        except (EOFError, ConnectionError):
            self.say("is cut off")
        except Exception as error:
            self.complaint = f"client {self.number} does not understand the server: {error!r}"
        finally:
            self._pipe.close()
            self._pipe.other.lose()

    def say(self, what: str) -> None:
        self.said.append(f"{self.bench.now_s:.1f} s: client {self.number} ({self.kind}) {what}")

    @property
    def told(self) -> str:
        """Line for the story, with a digest of all bytes that came."""
        got = f"{len(self.raws)} readings, {sum(len(times) for *_, times in self.scans)} scans"
        return f"{'; '.join(self.said)}: {got}, {self.heard.hexdigest()[:8]}"

    def _connect(self) -> bool:
        both = self.loop.connect(f"client {self.number}")
        if both is not None:
            self._reader, self._pipe = both
        return both is not None

    async def _await(self, answer: Awaitable[bytes], what: str) -> bytes:
        try:
            got = await asyncio.wait_for(answer, LONGEST_ANSWER_S)
        except TimeoutError:
            self.complaint = f"client {self.number}: no answer to '{what}' for {LONGEST_ANSWER_S:g} s"
            raise ConnectionAbortedError from None
        except asyncio.IncompleteReadError as error:
            raise EOFError from error
        if not got:
            raise EOFError
        self.heard.update(got)
        return got

    async def ask(self, line: str, content: bytes = b"") -> int:
        self._pipe.write(line.encode() + b"\r\n" + content)
        await self._pipe.drain()
        return await self.number_of(line)

    async def number_of(self, line: str) -> int:
        got = await self._await(self._reader.readline(), line)
        if not got.endswith(b"\n"):
            raise EOFError
        return int(got)

    async def text(self, line: str) -> str:
        length = await self.ask(line)
        if length < 0:
            raise _RefusedError(length)
        return (await self._await(self._reader.readexactly(length + 1), line)).rstrip(b"\0\n").decode()

    # -- kinds ---------------------------------------------------------------------------------------

    async def attributes(self) -> None:
        """Read attributes now and then; an error is an answer."""
        for _ in range(int(self.rng.integers(3, 20))):
            name = str(self.rng.choice(DEFAULT_SCAN))
            attribute = str(self.rng.choice(["raw", "raw", "raw", "scale"]))
            try:
                text = await self.text(f"READ {DEVICE} INPUT {CHANNELS[name]} {attribute}")
                if attribute == "raw":
                    self.raws.append((self.bench.now_s, name, int(text)))
            except _RefusedError as error:
                self.say(f"gets {error}")
            await asyncio.sleep(float(self.rng.choice([0.01, 0.1, 1.0])))

    async def _open(self, bits: int) -> tuple[list[str], np.dtype]:
        if (error := await self.ask(f"OPEN {DEVICE} 256 {bits:08x}")) < 0:
            raise _RefusedError(error)
        names = [name for k, name in enumerate(DEFAULT_SCAN) if bits >> k & 1]
        types = [(name, "<i2" if BY_NAME[name].signed else "<u2") for name in names]
        return names, np.dtype([*types, ("time", "<i8")], align=True)

    async def _read(self, names: list[str], layout: np.dtype, count: int) -> None:
        line = f"READBUF {DEVICE} {count * layout.itemsize}"
        self._pipe.write(line.encode() + b"\r\n")
        first = True
        while count > 0:
            if (length := await self.number_of(line)) < 0:
                raise _RefusedError(length)
            if first:
                await self._await(self._reader.readline(), line)
                first = False
            piece = np.frombuffer(await self._await(self._reader.readexactly(length), line), layout)
            count -= len(piece)
            numbers = np.stack([piece[name].astype(np.int64) for name in names], axis=1)
            self.scans.append((names, numbers, (piece["time"] - self.bench.begin_ns) / 1e9))

    async def buffer(self) -> None:
        """Read a buffer, some channels with the time."""
        bits = int(self.rng.integers(1, 1 << TIME_BIT)) | 1 << TIME_BIT
        opened = await self._open(bits)
        for _ in range(int(self.rng.integers(1, 8))):
            await self._read(*opened, int(self.rng.choice([1, 100, 1000])))
        if await self.ask(f"CLOSE {DEVICE}") < 0:
            self.complaint = f"client {self.number}: the buffer cannot be closed"

    async def slow(self) -> None:
        """Ask for many scans and read them late."""
        _, layout = await self._open((2 << TIME_BIT) - 1)
        self._pipe.write(f"READBUF {DEVICE} {5000 * layout.itemsize}\r\n".encode())
        await asyncio.sleep(float(self.rng.choice([1.0, 10.0])))
        self.heard.update(await self._await(self._reader.read(1 << 16), "READBUF"))

    async def vanish(self) -> None:
        """Be gone in the middle of a buffer."""
        _, layout = await self._open((2 << TIME_BIT) - 1)
        self._pipe.write(f"READBUF {DEVICE} {100_000 * layout.itemsize}\r\n".encode())
        await asyncio.sleep(float(self.rng.uniform(0, 1)))

    async def wrong(self) -> None:
        """Send lines that are no requests; each has an answer, or ends the connection."""
        lines = [
            "READ",
            f"OPEN {DEVICE} 0 1",
            f"READBUF {DEVICE} 64",
            "\x01\x02",
            f"WRITE {DEVICE} x 9999999",
        ]
        for line in self.rng.permutation(lines):
            if await self.ask(str(line)) >= 0:
                self.complaint = f"client {self.number}: '{line!r}' is accepted"

    async def writer(self) -> None:
        """Try to write to a server that does not allow it."""
        if await self.ask(f"WRITE {DEVICE} INPUT accel_x calibbias 4", b"100\0") != -1:
            self.complaint = f"client {self.number}: a read-only server has written"

    async def crowd(self) -> None:
        """Take all connections and do nothing; after a minute another client has to get in."""
        idle = [self.loop.connect(f"idle {k}") for k in range(CROWD)]
        await asyncio.sleep(iio_server.IDLE_S + 1.0)
        self._pipe.close()
        if not self._connect():
            return
        await self.text(f"READ {DEVICE} sampling_frequency")
        for one in idle:
            if one is not None:
                one[1].close()


class _RefusedError(Exception):
    """The server answered with an error number."""


KINDS: dict[str, Callable[[Client], Awaitable[None]]] = {
    "attributes": Client.attributes,
    "buffer": Client.buffer,
    "slow": Client.slow,
    "vanish": Client.vanish,
    "wrong": Client.wrong,
    "writer": Client.writer,
    "crowd": Client.crowd,
}
"""What a client does, by its kind."""
SHARES = (0.3, 0.3, 0.1, 0.1, 0.08, 0.07, 0.05)


@contextmanager
def virtual_serving(bench: Bench, draw: int) -> Iterator[None]:
    """Let `serve` run in the time of the bench, with one to four clients that `draw` draws."""
    rng = np.random.default_rng([draw, 37])
    loop = VirtualLoop(bench)
    bench.clients = []

    def run(main: Coroutine[Any, Any, None]) -> None:
        with asyncio.Runner(loop_factory=lambda: loop) as runner:
            runner.run(main)

    async def listen(connected, host, port, limit):
        loop.accept = connected
        kinds = rng.choice([*KINDS], size=rng.integers(1, 5), p=SHARES)
        bench.clients = [
            Client(k, str(kind), np.random.default_rng([draw, 38, k]), bench, loop)
            for k, kind in enumerate(kinds, 1)
        ]
        living = [loop.create_task(client.live()) for client in bench.clients]
        loop.going = loop.create_task(_go_after(living, bench))
        return _Listening(loop, host, port)

    threads = SimpleNamespace(Event=partial(_Event, loop))
    clock = SimpleNamespace(
        monotonic=lambda: bench.now_s, time_ns=lambda: bench.begin_ns + round(bench.now_s * 1e9)
    )
    with ExitStack() as stack:
        stack.callback(loop.leave)
        for target, name, new in (
            (asyncio, "run", run),
            (asyncio, "start_server", listen),
            (iio_device, "threading", threads),
            (iio_device, "ThreadPoolExecutor", partial(_Executor, loop)),
            (iio_device, "time", clock),
            (iio_server, "time", clock),
        ):
            stack.enter_context(mock.patch.object(target, name, new))
        yield


async def _go_after(living: list[asyncio.Task[None]], bench: Bench) -> None:
    """The operator presses Ctrl-C when all clients have gone."""
    await asyncio.wait(living)
    bench.interrupt_in(0.5)
