"""`record:FILE:URL` and `replay:FILE` - record every call of a bus, and play a recording back as a bus.

| URL | meaning |
|---|---|
| `record:FILE:URL` | opens URL and writes every call to the new file FILE; its name has no colon |
| `replay:FILE` | answers each call with the next recorded call that has the same frames |
| `replay:FILE?mode=strict` | raises an error at the first call that differs from the recording |

A file is text. Its first line is `MAGIC`, and each further line is one record: the CRC-32 (zlib) of the
rest of the line in eight hexadecimal digits, a blank, and a JSON object. Record 0 describes the recorded
bus: kind, url, timing, capabilities, edge_rises, unbroken_frames, virtual_time, and the methods and
settings of its helpers. Every other record is a `Call` without its number and without fields that are
None. Words are a text with four hexadecimal digits for each word, a block of a stream is an object with
shape, words, time_s and lost, and an error is a list of its class and its message.

Each record is written by one system call, so a crash of the program loses none and a power cut at most the
records that the system had not yet written. Reading ends at the first record that is incomplete or
damaged. If the disk is full, recording ends, the bus goes on, and `close` reports it.

Not in the file: the SPI clock of each frame. A recording has the times at which the host called the bus.
"""

from __future__ import annotations

import contextlib
import json
import threading
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base import errors
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError, DataError, OutputError, ProtocolError, UsageError
from adis_gonio.base.output import check_output
from adis_gonio.device.bus.contract import (
    Capability,
    ForwardingBus,
    FrameBlock,
    FrameStream,
    SpiBus,
    SpiTiming,
    Words,
)
from adis_gonio.device.bus.host import UrlOptions
from adis_gonio.device.bus.opening import BusUrl, open_bus

MAGIC = b"adis-gonio recording 2"

_EXPECTED = frozenset({"exchange", "configure", "stream", "block", "end_stream", "hard_reset"})
"""Calls that a strict replay must repeat; reads of clocks and counters may differ in number."""

T = TypeVar("T")


@dataclass(frozen=True)
class Call:
    """One recorded call of a bus.

    Attributes
    ----------
    number : int
        Number of the record in its file; the header is record 0.
    name : str
        Name of the method of the bus, `clock` for a look at the clock, or `block` for a block of a stream.
    begin_s, end_s : float
        Times of call and return on the clock of the bus.
    frames : (n,) uint16 or None
        Frames that were sent, a batch or the list of a stream; None for a call without frames.
    arguments : list
        Other arguments, as JSON values.
    result : object
        Replies (n,) of an exchange, a `FrameBlock`, or the JSON value that the call returned (None if it
        returned nothing).
    error : AdisGonioError or None
        Error that the call raised; None if it succeeded.
    """

    number: int
    name: str
    begin_s: float
    end_s: float
    frames: Words | None = None
    arguments: Sequence[Any] = ()
    result: Any = None
    error: AdisGonioError | None = None

    def __str__(self) -> str:
        return f"record {self.number} at {self.begin_s:.6f} s: {self.name} {_hexadecimal(self.frames)}"

    def read_words(self) -> tuple[Floats, NDArray[np.int64]]:
        """Return the time in s of each frame (n,), and the word that each frame read (n,).

        The chip shifts out the word of a frame during the next frame. The word of the last frame is
        therefore not recorded and is −1.
        """
        n = 0 if self.frames is None else len(self.frames)
        words = np.full(n, -1, np.int64)
        if self.result is not None:
            words[:-1] = self.result[1:]
        return np.linspace(self.begin_s, self.end_s, n, endpoint=False), words


# -- writing ---------------------------------------------------------------------------------------------


class _Writer:
    """Creates a file and appends records to it; may be used from several threads."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self.failure: OSError | None = None
        self._records = 0
        try:
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
        self._write(MAGIC + b"\n")

    def add(self, record: dict[str, Any]) -> None:
        """Append one record; do nothing after a failure or after `close`."""
        text = json.dumps(record, default=_plain, separators=(",", ":")).encode()
        with self._lock:
            if self.failure is None and not self._file.closed:
                self._write(b"%08x %s\n" % (zlib.crc32(text), text))

    def _write(self, record: bytes) -> None:
        begin = self._file.tell()
        try:
            rest = memoryview(record)
            while rest:
                rest = rest[self._file.write(rest) :]
            self._records += 1
        except OSError as error:
            self.failure = error
            with contextlib.suppress(OSError):
                self._file.truncate(begin)

    def close(self) -> None:
        """Close the file; raise `OutputError` if a record could not be written."""
        with self._lock:
            self._file.close()
        if self.failure is not None:
            raise OutputError(
                f"{self._path}: the recording ends after {max(0, self._records - 2)} calls:"
                f" {self.failure.strerror}; the bus itself went on"
            )


def _record(call: Call) -> dict[str, Any]:
    """Return the record of a call, from which `_call` makes the call again."""
    return {name: value for name, value in vars(call).items() if name != "number" and value is not None}


def _plain(value: object) -> Any:
    """Return the JSON form of words, of a block of a stream or of an error in a record."""
    if isinstance(value, np.ndarray) and value.dtype == np.uint16:
        return value.astype(">u2").tobytes().hex()
    if isinstance(value, FrameBlock):
        return vars(value) | {"shape": value.words.shape, "time_s": value.time_s.tolist()}
    if isinstance(value, AdisGonioError):
        return [type(value).__name__, str(value)]
    raise TypeError(f"{type(value).__name__} has no form in a recording")


class ObservedBus(ForwardingBus):
    """A bus that forwards every call to another bus and passes the finished call to a function.

    Parameters
    ----------
    inner : SpiBus
        The other bus; `close` also closes it.
    note : callable
        Called with the `Call` (number 0) after each call of the inner bus, also after a call that failed.
    """

    def __init__(self, inner: SpiBus, note: Callable[[Call], object]) -> None:
        super().__init__(inner)
        self._note = note
        self.stage, self.world = (self._helper(name) for name in _HELPERS)

    def _helper(self, name: str) -> Any:
        helper = getattr(self.inner, name, None)

        def call(method: str, *arguments: Any) -> Any:
            return self.forward(f"{name}.{method}", lambda: getattr(helper, method)(*arguments))

        return _stand_in(_describe(helper), call)

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return `observe()`, and note this value under `name` unless it is None, empty or false."""
        value = self.inner.witness(name, observe)
        if value:
            now = self.inner.now_s()
            self._note(Call(0, name, now, now, result=value))
        return value

    def now_s(self) -> float:
        """Return the time in s on the clock of the inner bus, and note it."""
        now = self.inner.now_s()
        self._note(Call(0, "clock", now, now, result=now))
        return now

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """Start a stream of the read frames `frames` on the inner bus and note its blocks.

        A block of the stream has about `block_scans` scans.
        """
        return _ObservedStream(self, super().stream(frames, block_scans=block_scans))

    def forward(
        self, name: str, action: Callable[[], T], frames: Words | None = None, arguments: Sequence[Any] = ()
    ) -> T:
        """Run `action`, which calls the inner bus, and return its result; note the call under `name`.

        `frames` and `arguments` are attributes of the noted `Call`.
        """
        begin_s = self.inner.now_s()
        try:
            result = action()
        except AdisGonioError as error:
            self._note(Call(0, name, begin_s, self.inner.now_s(), frames, arguments, error=error))
            raise
        noted: Any = None if isinstance(result, FrameStream) else result
        noted = asdict(noted) if isinstance(noted, SpiTiming) else noted
        self._note(Call(0, name, begin_s, self.inner.now_s(), frames, arguments, noted))
        return result


class _ObservedStream(FrameStream):
    """A running stream of the inner bus of an `ObservedBus`, which notes each block."""

    def __init__(self, bus: ObservedBus, inner: FrameStream) -> None:
        self._bus, self._inner = bus, inner
        self._closed = False

    def __next__(self) -> FrameBlock:
        return self._bus.forward("block", lambda: next(self._inner))

    def close(self) -> None:
        """Stop the stream and free the bus; may be called twice."""
        if not self._closed:
            self._closed = True
            self._bus.forward("end_stream", self._inner.close)


class RecordingBus(ObservedBus):
    """A bus that forwards every call to another bus and writes the call to a file.

    Parameters
    ----------
    inner : SpiBus
        The other bus; `close` also closes it.
    path : str or Path
        File to create.

    Raises
    ------
    UsageError
        The file exists.
    OutputError
        The file cannot be created. `close` raises it if a record could not be written.
    """

    def __init__(self, inner: SpiBus, path: str | Path) -> None:
        self.writer = _Writer(check_output(path, cure="choose another name for the recording"))
        super().__init__(inner, lambda call: self.writer.add(_record(call)))
        header = {
            "kind": inner.kind,
            "url": inner.url,
            "timing": asdict(inner.timing),
            "capabilities": sorted(inner.capabilities),
            "edge_rises": inner.edge_rises,
            "unbroken_frames": inner.unbroken_frames,
            "virtual_time": self.virtual_time,
            "helpers": {name: _describe(getattr(inner, name, None)) for name in _HELPERS},
        }
        self.writer.add(header)
        if self.writer.failure:
            self.writer.close()

    def _close(self) -> None:
        try:
            super()._close()
        finally:
            self.writer.close()


_HELPERS = ("stage", "world")
"""Names of the attributes of a bus that a session calls.

They are a stage that moves by program, and a simulated world.
"""


def _describe(helper: object) -> dict[str, Any] | None:
    """Describe an object as a JSON object with the entries `methods` and `settings`.

    `methods` has the names of its public methods. `settings` has the fields of its attribute `settings`, or
    None if it has no such attribute. The result is None if `helper` is None.
    """
    if helper is None:
        return None
    kind = type(helper)
    methods = [name for name in dir(kind) if name[0] != "_" and callable(getattr(kind, name))]
    settings = getattr(helper, "settings", None)
    return {"methods": methods, "settings": None if settings is None else vars(settings)}


def _stand_in(described: dict[str, Any] | None, call: Callable[..., Any]) -> Any:
    """Make an object with the methods and settings in `described`, a result of `_describe`.

    Each of its methods calls `call(name, *arguments)` with the name of the method. Return None if
    `described` is None.
    """
    if described is None:
        return None
    named = {name: lambda _, *given, name=name: call(name, *given) for name in described["methods"]}
    return type("StandIn", (), named | {"settings": SimpleNamespace(**described["settings"] or {})})()


# -- reading ---------------------------------------------------------------------------------------------


class BusRecording:
    """The calls of a recording.

    Parameters
    ----------
    path : str or Path
        The recording.

    Attributes
    ----------
    header : dict
        JSON object of record 0, which describes the recorded bus.
    damage : str
        Reason why reading ended before the end of the file; empty if all records could be read. It is known
        when the calls have been iterated.

    Raises
    ------
    DataError
        The file cannot be read or is no recording.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.damage = ""
        try:
            magic, *self._lines = self.path.read_bytes().split(b"\n")
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror}") from None
        if magic != MAGIC:
            raise DataError(
                f"{path}: is no recording; record: makes one, such as record:run.rec:sim:?seed=1"
            )
        header = next(self._records(), None)
        if header is None:
            raise DataError(f"{path}: the header of the recording is damaged")
        self.header = header

    def __iter__(self) -> Iterator[Call]:
        return (_call(number, facts) for number, facts in enumerate(self._records()) if number)

    def _records(self) -> Iterator[dict[str, Any]]:
        """Yield the undamaged records.

        Set `damage` if a damaged record or an incomplete last line remains.
        """
        for number, line in enumerate(self._lines):
            crc, _, text = line.partition(b" ")
            if number < len(self._lines) - 1 and crc == b"%08x" % zlib.crc32(text):
                yield json.loads(text)
            elif line:
                self.damage = f"ends at record {number}, because the rest is incomplete or damaged"
                return


def _call(number: int, facts: dict[str, Any]) -> Call:
    """Make the call that a record of this number describes."""
    result = facts.get("result")
    if "frames" in facts:
        facts["frames"] = _words(facts["frames"])
    if facts["name"] == "exchange" and result is not None:
        facts["result"] = _words(result)
    if facts["name"] == "block" and result is not None:
        words = _words(result["words"]).reshape(result["shape"])
        facts["result"] = FrameBlock(words, np.array(result["time_s"]), result["lost"])
    if "error" in facts:
        facts["error"] = _rebuild(*facts["error"])
    return Call(number, **facts)


def _words(text: str) -> Words:
    return np.frombuffer(bytes.fromhex(text), ">u2").astype(np.uint16)


def _rebuild(name: str, message: str) -> AdisGonioError:
    """Make an error of the class called `name`, or a `BusError` if this version does not know the class."""
    kind = getattr(errors, name, None)
    if isinstance(kind, type) and issubclass(kind, AdisGonioError):
        return kind(message)
    return errors.BusError(message)


class ReplayBus(SpiBus):
    """A bus that answers each call from a recording, with the recorded times; waits cost nothing.

    Parameters
    ----------
    path : str or Path
        The recording.
    strict : bool
        True raises `ProtocolError` at the first call that differs from the recording. False: the next
        recorded call with the same name and frames answers, and the calls before it are skipped.

    Raises
    ------
    DataError
        The file cannot be read or is no recording.
    ProtocolError
        A call has no further record that answers it. An error that was recorded is raised again.
    """

    replayed = True

    def __init__(self, path: str | Path, *, strict: bool = False) -> None:
        recording = BusRecording(path)
        header = recording.header
        super().__init__(SpiTiming(**header["timing"]))
        self.url = header["url"]
        self._path = path
        self.kind = header["kind"]
        self.virtual_time = header["virtual_time"]
        self.stage, self.world = (self._helper(name, header["helpers"][name]) for name in _HELPERS)
        self.capabilities = frozenset(map(Capability, header["capabilities"]))
        self.edge_rises = header["edge_rises"]
        self.unbroken_frames = header["unbroken_frames"]
        self._strict = strict
        self._calls = list(recording)
        self._damage = f" (it {recording.damage})" if recording.damage else ""
        self._next = 0
        self._now_s = self._calls[0].begin_s if self._calls else 0.0

    def now_s(self) -> float:
        """Return the recorded time in s if the next recorded call reads the clock.

        Otherwise return the time of the last clock read or the end of the last replayed call, whichever was
        later in the recording.
        """
        self._now_s = self.witness("clock", lambda: self._now_s)
        return self._now_s

    def sleep_s(self, seconds: float) -> None:
        """Return at once, without waiting."""
        self.witness("sleep_s", lambda: None)

    def witness(self, name: str, observe: Callable[[], T]) -> T:
        """Return the recorded value if the next recorded call has this name; otherwise `observe()`."""
        with self._lock:
            if self._next < len(self._calls) and self._calls[self._next].name == name:
                self._next += 1
                value: T = self._calls[self._next - 1].result
                return value
        return observe()

    def _helper(self, name: str, described: dict[str, Any] | None) -> Any:
        return _stand_in(described, lambda method, *_: self.answer(f"{name}.{method}").result)

    def count_events(self) -> tuple[int, float]:
        """Return the recorded data-ready edges since the last call, and the recorded time in s."""
        with self._lock:
            self._require(Capability.EVENT_COUNTER)
            count, time_s = self.answer("count_events").result
            return count, time_s

    def answer(self, name: str, frames: Words | None = None) -> Call:
        """Return the next recorded call of the method `name` with these frames; raise its recorded error.

        `frames` is None for a call without frames.

        It raises `ProtocolError` if no further record fits, or if a strict replay meets another call first.
        """
        for at in range(self._next, len(self._calls)):
            call = self._calls[at]
            if call.name == name and np.array_equal(_or_empty(call.frames), _or_empty(frames)):
                self._next, self._now_s = at + 1, call.end_s
                if call.error is not None:
                    raise call.error
                return call
            if self._strict and call.name in _EXPECTED:
                raise ProtocolError(
                    f"{self._path}: the recording goes on with {call}, not with {name}"
                    f" {_hexadecimal(frames)}"
                )
        raise ProtocolError(
            f"{self._path}: no further record answers this call ({name} {_hexadecimal(frames)}".rstrip()
            + f"); repeat the recorded command with its options{self._damage}"
        )

    def _exchange(self, frames: Words) -> Words:
        return np.asarray(self.answer("exchange", frames).result)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return SpiTiming(**self.answer("configure").result)

    def _start_stream(self, frames: Sequence[int], block_scans: int) -> FrameStream:
        self.answer("stream", np.array(frames, np.uint16))
        return _ReplayedStream(self)

    def _pull_reset(self) -> None:
        self.answer("hard_reset")

    def _count_edges(self) -> int:
        return int(self.answer("read_event_counter").result)

    def _close(self) -> None:
        self._calls = []


def _or_empty(frames: Words | None) -> Words:
    return np.empty(0, np.uint16) if frames is None else frames


def _hexadecimal(frames: Words | None) -> str:
    """Return the first eight frames in hexadecimal, and their number if there are more; empty for None."""
    shown = " ".join(f"{frame:04X}" for frame in _or_empty(frames)[:8])
    return shown if frames is None or len(frames) <= 8 else f"{shown} … ({len(frames)} frames)"


class _ReplayedStream(FrameStream):
    """A stream that delivers the recorded blocks."""

    def __init__(self, bus: ReplayBus) -> None:
        self._bus, self._open = bus, True

    def __next__(self) -> FrameBlock:
        if not self._open:
            raise StopIteration
        block: FrameBlock = self._bus.answer("block").result
        return block

    def close(self) -> None:
        """Stop the stream and free the bus; may be called twice."""
        if self._open:
            self._open = False
            self._bus.answer("end_stream")


# -- opening ---------------------------------------------------------------------------------------------


def open_recorder(url: BusUrl) -> RecordingBus:
    """Open `record:FILE:URL`; `UsageError` if a part is missing."""
    path, colon, inner = url.text.partition(":")[2].partition(":")
    if not path or not colon or not inner:
        raise UsageError(f"'{url.text}': write record:FILE:URL, such as record:run.rec:sim:?seed=1")
    bus = open_bus(inner)
    with bus.closed_on_error():
        return RecordingBus(bus, path)


def open_replay(url: BusUrl) -> ReplayBus:
    """Open `replay:FILE` or `replay:FILE?mode=strict`."""
    options = UrlOptions(url, ("mode",))
    if not url.place:
        raise UsageError(f"'{url.text}': write replay:FILE, such as replay:run.rec")
    return ReplayBus(url.place, strict=options.one_of("mode", ("order", "strict")) == "strict")
