"""Scans of registers: at data-ready edges, or polled.

A scan reads each register of a list once. All its words should belong to one update of the chip. Each word
has a bit ND (new data): an update sets it, and the read of this register clears it.

The module enables the chip's data-ready line for a stream or a session, and checks it before use. A bridge
may count edges although the line is not connected. The line is therefore used only if the bridge counts
about one edge for each update, and if no update falls into the scans that start at the edge. If there are
no edges, scans are polled.

The bits ND of a scan do not show if an update came during the scan, since each register is read only once.
A trial therefore reads the first register once more at the end of the scan. If the second read finds new
data, an update came within the scan.

One iterator of `ScanBlock` has two implementations:

* the bus streams at each data-ready edge (`Capability.STREAM`, and data-ready enabled);
* polling: the list of reads runs again and again, and the chip's ND bit marks new words. The number of
  missed updates follows from the time between scans. If the bus counts data-ready edges, their number
  corrects it, because the rate of the chip's updates may differ from the nominal rate.

Polling without mixing updates. An update may come between two reads of one pass through the list, so that
the pass has words of two updates. Polling therefore goes on until as many successive reads as the list is
long find no new data. Every register was then read after the last update, and the latest new word of each
register is from this update. These words are one scan. If the next update comes before, its words replace
the earlier ones, and the number of missed updates follows from the time. If a bus needs more than half an
update period for a pass, this is not possible, and each pass is a scan.
"""

from __future__ import annotations

import contextlib
import math
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base import Closing
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError, ChipError, ProtocolError, SilentChipError, VerifyError
from adis_gonio.device.bus import Capability, FrameStream, SpiBus, Words
from adis_gonio.device.sensor.registers import BY_NAME, IDLE, ND, Register, read_frames, write_frames
from adis_gonio.device.sensor.settings import ScanBlock

if TYPE_CHECKING:
    from adis_gonio.device.sensor.driver import Adis16354

USED_BY = frozenset({Capability.STREAM, Capability.EVENT_COUNTER})
"""Capabilities of a bus that make use of data-ready."""

_PERIODS = 2.5
"""Shortest time for which `edges_arrive` counts edges, in sample periods.

Two edges fall into this time.
"""
_COUNT_S = 0.1
"""Shortest time in s for which `edges_arrive` counts edges."""
_RATE_TOLERANCE = 0.25
"""Tolerance of the rate of data-ready edges, relative to the sample rate.

The chip's clock is off by some percent, and the host times a bridge without its own clock.
"""
_EDGES_TOLERANCE = 1.5
"""Tolerance of the number of data-ready edges, in edges, for the two ends of the count."""
_TRIAL_SCANS = (4, 32)
"""Smallest and largest number of scans in the trial of `edge_at_update`."""
_LEADS_SHARE = 0.9
"""Smallest share of trial scans without an update at which the edge counts as correct.

A correct data-ready edge has no update in any scan of a trial.
"""
_MOST_BEFORE = 30
"""Largest number of registers in a trial before the repeated one; the list of a bridge has 32."""

_ROW = BY_NAME["MSC_CTRL"]
_POLARITY = _ROW.field("polarity").mask
MASK = _ROW.field("data_ready").mask | _POLARITY | _ROW.field("line").mask
"""Bits of MSC_CTRL for the data-ready output: enable, polarity and line."""


def enabling_bits(bus: SpiBus, *, first: bool) -> int:
    """Return the bits of MSC_CTRL that enable data-ready on DIO1, the line wired to the bridges.

    The bus then starts scans at the first or, with `first` False, at the last edge of the pulse.
    """
    # A pulse that is high begins with a rising edge and ends with a falling one.
    return _ROW.field("data_ready").mask | (_POLARITY if bus.edge_rises == first else 0)


def edges_arrive(bus: SpiBus, period_s: float) -> bool:
    """Return True if data-ready edges come, one for each update, or if the bus cannot count edges.

    Return False if no edge comes. The count takes 0.1 s or 2.5 sample periods, whichever is longer;
    `period_s` is the sample period in s.

    Raises
    ------
    ChipError
        Edges come, but not at the rate of the chip's updates, so another device makes them.
    """
    if Capability.EVENT_COUNTER not in bus.capabilities:
        return True
    asked_s, wait_s = bus.now_s(), max(_PERIODS * period_s, _COUNT_S)
    _, begin_s = bus.count_events()
    bus.sleep_s(wait_s)
    edges, end_s = bus.count_events()
    # A busy host may be late before and after each count; only limits of the time between are sure.
    least = (1 - _RATE_TOLERANCE) * wait_s / period_s - _EDGES_TOLERANCE
    most = (1 + _RATE_TOLERANCE) * (bus.now_s() - asked_s) / period_s + _EDGES_TOLERANCE
    if edges and not least <= edges <= most:
        raise ChipError(
            f"{bus.url}: {edges / (end_s - begin_s):.4g} edges a second on the data-ready line, but the"
            f" sensor samples {1 / period_s:.4g} times a second: wire the line to DIO1 and to nothing else,"
            " or hold it high if there is no wire (docs/hardware.md)"
        )
    return edges > 0


def edge_at_update(bus: SpiBus, table: Sequence[Register], period_s: float) -> bool:
    """Return True if no update of the sensor happens during scans that start at the data-ready edge.

    `table` has the registers of a scan, `period_s` is the sample period in s. The trial takes 0.1 s or 4
    updates, whichever is longer.
    """
    least, most = _TRIAL_SCANS
    scans = min(max(least, math.ceil(_COUNT_S / period_s)), most)
    first = next(k for k, row in enumerate(table) if row.flags)
    # A list too long for the bridge is refused here as it would be in the stream.
    rows = table if len(table) > _MOST_BEFORE + 1 else [*table[first:], table[first]]
    frames = [int(frame) for frame in read_frames(rows)]
    with contextlib.closing(bus.stream(frames, block_scans=scans)) as stream:
        new = (next(stream).words[1:, [0, -1]] & ND).astype(bool)  # the first scan has no read before it
    takes_s = len(frames) * bus.timing.frame_s
    within = new[:, 1] if takes_s < period_s else np.zeros(len(new), bool)
    return bool((new[:, 0] & ~within).mean() >= _LEADS_SHARE)


class DataReadyLoan:
    """Enables data-ready on DIO1, the line wired to the bridges, until the old setting is restored.

    The pulse announces new data (MSC_CTRL[2], A). Its first edge is expected at the update (inferred,
    without support in data sheet or code, C); if the updates are found at the last edge, this edge is used.
    The polarity is chosen so that the bridge starts its scans there. Only the low byte of MSC_CTRL is
    written, and only its three bits of data-ready change.

    Parameters
    ----------
    sensor : Adis16354
        Sensor that drives the line.
    table : sequence of Register
        Registers of the scans.
    period_s : float
        Sample period in s.
    writes : bool
        False only checks data-ready as it is enabled now, and writes no register.

    Attributes
    ----------
    edge : {"first", "last"}
        Edge of the pulse that the bus uses.
    wired : bool
        False if no edge arrives; MSC_CTRL is then already restored.

    Raises
    ------
    VerifyError
        MSC_CTRL reads back another value.
    ChipError
        Edges arrive, but not at the chip's updates. MSC_CTRL is restored.
    """

    def __init__(
        self, sensor: Adis16354, table: Sequence[Register], period_s: float, *, writes: bool = True
    ) -> None:
        self._sensor, self._writes = sensor, writes
        self.edge = "first"
        self._before = sensor.read(_ROW) & MASK
        self._ours = self._before
        try:
            if writes:
                self._enable()
            self.wired = edges_arrive(sensor.bus, period_s)
            if self.wired:
                self._find_edge(table, period_s)
            else:
                self.give_back()
        except BaseException:
            with contextlib.suppress(AdisGonioError):  # the first error counts
                self.give_back()
            raise

    def give_back(self) -> None:
        """Restore the data-ready bits, unless another program has changed them; may be called twice."""
        if self._ours != self._before and self._sensor.read(_ROW) & MASK == self._ours:
            self._set(self._before)
        self._ours = self._before

    def _find_edge(self, table: Sequence[Register], period_s: float) -> None:
        """Select the end of the pulse at which updates happen: the first, or else the last.

        Raises `ChipError` if updates happen at neither end. Does nothing if the bus cannot stream. `table`
        has the registers of a scan, `period_s` is the sample period.
        """
        if Capability.STREAM not in self._sensor.bus.capabilities:
            return  # nothing starts at an edge
        for _ in range(2):
            if edge_at_update(self._sensor.bus, table, period_s):
                return
            if not self._writes:
                break
            self.edge = "last" if self.edge == "first" else "first"
            self._enable()
        raise ChipError(
            f"{self._sensor.bus.url}: the sensor's updates fall into scans that start at the data-ready"
            " edges (bit ND of a register read twice): the edges are not the updates', or MSC_CTRL[1]"
            " selects the wrong end of the pulse; check the line's wire (docs/hardware.md)"
        )

    def _enable(self) -> None:
        ours = enabling_bits(self._sensor.bus, first=self.edge == "first")
        if ours != self._ours:
            self._ours = ours  # before the write, which may be interrupted
            self._set(ours)

    def _set(self, bits: int) -> None:
        sensor = self._sensor
        word = sensor.read(_ROW) & ~MASK | bits
        sensor.bus.exchange_array(write_frames(_ROW, word & _ROW.write_mask, byte_mask=0x00FF))
        back = sensor.read(_ROW)
        if (back ^ word) & 0x00FF & _ROW.write_mask:
            raise VerifyError(f"MSC_CTRL: wrote 0x{word & 0xFF:02X}, read back 0x{back & 0xFF:02X}")


SILENT_PERIODS = 20
"""Number of successive missing updates after which the chip counts as silent."""

ALIGNABLE = 0.45
"""Longest pass through the list of registers, in sample periods, at which polling can separate updates.

Between two updates it leaves time for a pass of reads with new data, for as many reads without new data,
and for a margin of a tenth.
"""

LONGEST_EXCHANGE_S = 1.0
"""Longest exchange of a polled stream in s; short exchanges let a stop act soon."""

STUCK_HIGH = 0xFFFF
STUCK_SCANS, STUCK_REGISTERS = 8, 3
"""Number of scans and of output registers with all ones that prove a stuck data line.

By chance three registers would have to read -1 LSB together, with an error flag, although gravity acts.
"""

LEAST_PASSES = 4
"""Smallest number of passes in a batch, and number of passes kept for the next batch.

The words of an update, and the reads without new data that must follow them, take three passes.
"""


JUDGED_SCANS = 32
FRESH_SHARE = 0.75
"""Smallest share of the latest scans that must have new data.

`JUDGED_SCANS` is the number of these scans.
"""

COUNTER_SLACK = 2.0
"""Tolerance between counted edges and scans, in updates.

Some updates come between a scan and the reading of the counter.
"""


@dataclass(frozen=True)
class ScanLayout:
    """Registers of a scan, the data that decode them, and the action at the end of the stream.

    Attributes
    ----------
    table : sequence of Register
        Registers of a scan.
    variant, gyro_range_dps
        Name of the variant and gyro range in °/s that decode the words; the range is None if unknown.
    period_s : float
        Time in s between two updates of the chip.
    at_end : callable
        Called once, when the stream has stopped.
    """

    table: Sequence[Register]
    variant: str
    gyro_range_dps: int | None
    period_s: float
    at_end: Callable[[], object] = lambda: None


B = TypeVar("B")


class BlockStream(Closing, Generic[B]):
    """Iterator of blocks of samples until it is closed; a context manager.

    Attributes
    ----------
    how : str
        Description of the method, streaming or polling, for a report.
    """

    how: str = ""
    _closed = False

    def __iter__(self) -> Iterator[B]:
        return self

    def __next__(self) -> B:
        """Wait for the next block and return it; raise `BusError` or `ChipError` on failure."""
        if self._closed:
            raise StopIteration
        return self._next()

    def close(self) -> None:
        """Stop the stream; may be called twice."""
        if not self._closed:
            self._stop()
            self._closed = True  # only now, so that an interrupted stop is repeated

    @abstractmethod
    def _next(self) -> B: ...

    def _stop(self) -> None:
        """Stop the activity of the stream on the bus."""


class ScanStream(BlockStream[ScanBlock]):
    """Iterator of `ScanBlock` that restores the chip's settings when closed; a context manager."""

    @property
    def caveat(self) -> str:
        """Warning about the scans delivered so far, as text; empty if there is none."""
        return ""

    def __init__(self, layout: ScanLayout) -> None:
        self._layout = layout
        self._names = tuple(row.name for row in layout.table)
        self._period_s = layout.period_s
        self._last_s: float | None = None

    def close(self) -> None:
        """Stop the stream and restore the settings that it changed; may be called twice.

        Raises
        ------
        BusError, VerifyError
            The bus failed or a register reads back another value, so that data-ready may still be enabled.
        """
        if not self._closed:
            try:
                super().close()
            finally:
                self._layout.at_end()

    def __exit__(self, *error: object) -> None:
        # The first error counts: if the bus is gone, the restoration fails too.
        with contextlib.nullcontext() if error[0] is None else contextlib.suppress(AdisGonioError):
            self.close()

    def _block(
        self, words: Words, time_s: Floats, lost: int, missed: NDArray[np.int64] | None = None
    ) -> ScanBlock:
        layout = self._layout
        return ScanBlock(self._names, words, time_s, lost, layout.variant, layout.gyro_range_dps, missed)


class StreamedScans(ScanStream):
    """Stream of scans that the bridge makes at each data-ready edge, without the host."""

    how = "the bridge reads each sample at its data-ready edge"

    def __init__(self, stream: FrameStream, layout: ScanLayout) -> None:
        super().__init__(layout)
        self._stream = stream
        self._flags = np.array([row.flags for row in layout.table])
        self._judged: NDArray[np.bool_] = np.empty(0, bool)
        self._scans_of_ones = 0

    def _next(self) -> ScanBlock:
        block = next(self._stream)
        if block.words.shape != (len(block.time_s), len(self._names)):
            raise ProtocolError(
                f"the bus streams blocks of shape {block.words.shape}: {len(block.time_s)} times and"
                f" {len(self._names)} registers were expected"
            )
        self._refuse_stuck_line(block.words)
        # A scan with a word without ND repeats old data, at least in part: its edge was not an update.
        new: NDArray[np.bool_] = np.all(block.words[:, self._flags] & ND, axis=1)
        dropped = len(new) - int(new.sum())
        self._judged = np.append(self._judged, new)[-JUDGED_SCANS:]
        if len(self._judged) == JUDGED_SCANS and self._judged.mean() < FRESH_SHARE:
            raise ChipError(
                f"{JUDGED_SCANS - self._judged.sum()} of {JUDGED_SCANS} scans at data-ready edges found no"
                " new data (ND) in a register: the edges are not the chip's updates; check the line's wire"
                " and MSC_CTRL[2:0] (docs/hardware.md)"
            )
        return replace(self._block(block.words[new], block.time_s[new], block.lost), dropped=dropped)

    def _refuse_stuck_line(self, words: Words) -> None:
        """Raise `SilentChipError` if successive scans are all ones, which a stuck data line causes.

        All ones look like new data. `words` (n, k) are the scans that have just arrived.
        """
        if self._flags.sum() < STUCK_REGISTERS:
            return
        ones = (words[:, self._flags] == STUCK_HIGH).all(axis=1)
        # The run at the end of the earlier scans goes on; then the lengths of the runs between other scans.
        ones = np.append(np.ones(self._scans_of_ones, bool), ones)
        runs = np.diff(np.flatnonzero(~ones), prepend=-1, append=len(ones)) - 1
        self._scans_of_ones = int(runs[-1])
        if runs.max() >= STUCK_SCANS:
            raise SilentChipError(
                "nothing answers, scans at data-ready edges are all ones: the data line (MISO) is stuck"
                " high; check supply, chip select and wires"
            )

    def _stop(self) -> None:
        self._stream.close()


class PolledScans(ScanStream):
    """Stream of scans made by polling: the host reads the registers again and again and keeps new words.

    The chip marks a new word by its bit 15, ND. The module's text describes the method.
    """

    def __init__(self, bus: SpiBus, layout: ScanLayout, block_scans: int, *, counts_edges: bool) -> None:
        super().__init__(layout)
        self.how = "polling; missed samples are counted by " + (
            "the bridge's counter of data-ready edges" if counts_edges else "time"
        )
        self._bus = bus
        self._frames = read_frames(layout.table)
        self._flags = np.array([row.flags for row in layout.table])
        self._pass_s = len(self._frames) * bus.timing.frame_s
        self._block_scans = block_scans
        self._may_mix = self._late = False
        self._open = (np.empty((0, len(self._frames)), np.uint16), np.empty((0, len(self._frames))))
        self._missed = 0.0
        self._in_bursts = bus.unbroken_frames is not None
        self._polled_s = -np.inf
        self._way_s = np.inf
        self._edges: int | None = 0 if counts_edges else None
        self._accounted = 0
        self._ahead: float | None = None
        if counts_edges:
            begin_s = bus.now_s()
            bus.read_event_counter()
            self._ask_s = bus.now_s() - begin_s

    def _next(self) -> ScanBlock:
        silent_s = 0.0
        while True:
            words, times = self._poll()
            if self._pass_s < ALIGNABLE * self._period_s:
                block = self._match(words, times)
            else:
                self._may_mix = True
                fresh = (words[:, int(np.argmax(self._flags))] & ND).astype(bool)
                block = self._counted(words[fresh], times[fresh, 0])
            if len(block):
                self._accounted += len(block) + block.lost
                self._heed_counter()
                return block
            if silent_s > SILENT_PERIODS * self._period_s + 1.0:
                raise SilentChipError(
                    "no new data from the sensor: it sleeps, restarts or is not connected"
                    " (bit ND never came in any output register)"
                )
            # A busy host may stop between two reads of a poll, which then counts as a long one.
            silent_s += min(self._polled_s - float(times[0, 0]), LONGEST_EXCHANGE_S)

    @property
    def caveat(self) -> str:
        """Warning that a scan may mix words of two updates, if polling was too slow; else empty."""
        mixed = (
            "scans were polled too slowly to separate the sensor's updates: the words of a row may come"
            " from two or more neighbouring updates"
        )
        return mixed if self._may_mix else ""

    def _heed_counter(self) -> None:
        """Compare the scans and missed updates so far with the data-ready edges that the bus has counted.

        If they differ by more than `COUNTER_SLACK`, the difference is added to the missed updates of the
        next block.
        """
        if self._edges is None or self._last_s is None:
            return
        begin_s = self._bus.now_s()
        self._edges += self._bus.read_event_counter()
        end_s = self._bus.now_s()
        self._ask_s = min(self._ask_s, end_s - begin_s)
        if end_s - begin_s > self._ask_s + self._period_s:
            return  # the request was repeated or the host was busy: the time of the count is not known
        since = (end_s - self._ask_s / 2 - self._last_s) / self._period_s
        ahead = self._edges - since - self._accounted - self._missed
        if self._ahead is None:
            self._ahead = ahead  # edges before the first scan
        elif abs(ahead - self._ahead) > COUNTER_SLACK:
            self._missed += ahead - self._ahead

    def _poll(self) -> tuple[Words, Floats]:
        """Read all registers of the scan several times.

        Return the words and their times in s, both (passes, k).
        """
        # The reply to the last frame of a pass comes with the first of the next, so passes need no idle
        # frame between them, only one at the very end.
        scan_s = max(self._period_s, self._pass_s)
        passes = max(LEAST_PASSES, int(np.ceil(self._block_scans * scan_s / self._pass_s)))
        if self._polled_s == -np.inf:  # time a pass before a long batch: a bridge may be slow
            passes = LEAST_PASSES
        # A pass may take seconds on a slow bridge; no exchange of several passes lasts longer than this.
        passes = min(passes, max(1, int(LONGEST_EXCHANGE_S / self._pass_s)))
        if self._bus.unbroken_frames is not None:
            # One burst a batch: the board keeps the timing within one only.
            passes = min(passes, max(1, (self._bus.unbroken_frames - 1) // len(self._frames)))
        frames = np.append(np.tile(self._frames, passes), np.uint16(IDLE))
        before, self._open = self._open, (self._open[0][:0], self._open[1][:0])
        begin_s = self._bus.now_s()
        replies = self._bus.exchange_array(frames)  # a read that is lost has cleared ND of its word
        self._open = before
        end_s = self._bus.now_s()
        took_s = end_s - begin_s
        if self._in_bursts:  # the board keeps the timing; when in the exchange the frames ran is not known
            took_s = min(took_s, frames.size * self._bus.timing.frame_s)
        else:
            self._pass_s = took_s / passes  # real duration on the bus
        # Use the shortest delay of a frame; the additional time of a repeated request does not show when
        # the frames ran. Assume the earliest possible time, so that no update is counted as lost too early.
        self._way_s = min(self._way_s, (end_s - begin_s - took_s) / frames.size)
        # In bursts counts are right on the average only, and a late time does no harm.
        self._late = not self._in_bursts and begin_s + self._pass_s - self._polled_s > self._period_s
        self._polled_s = end_s
        times = begin_s + self._way_s * frames.size / 2 + took_s * np.arange(frames.size) / frames.size
        shape = (passes, len(self._frames))
        return replies[1:].reshape(shape), times[:-1].reshape(shape)

    def _match(self, words: Words, times: Floats) -> ScanBlock:
        """Assemble new words into scans, each with one word of each register from one update of the chip.

        `words` and `times` (in s) are (passes, k): the registers of a scan were read in several passes. A
        scan is complete when more successive reads than the scan has registers have found no new data.
        """
        held = len(self._open[0])
        words, times = np.concatenate([self._open[0], words]), np.concatenate([self._open[1], times])
        news = (words & ND).astype(bool)[:, self._flags]
        width = news.shape[1]
        # A gap of more than `width` reads without new data ends a row.
        at = np.flatnonzero(news)  # reads in their order
        ends = np.flatnonzero(np.diff(at, append=news.size) > width)
        # The latest fresh pass of each column up to each read with news, -1 before the first one.
        latest = np.full((at.size, width), -1)
        latest[np.arange(at.size), at % width] = at // width
        latest = np.maximum.accumulate(latest, axis=0)[ends]
        # A row is complete if every column has new data since the previous silence.
        begins = np.append(0, ends[:-1] + 1)[: ends.size]
        rows = latest[(latest >= (at[begins] // width)[:, np.newaxis]).all(axis=1)]
        left = at[ends[-1] + 1 :] if ends.size else at
        # Keep the passes with unfinished rows for the next batch.
        cut = max(left[0] // width, len(words) - LEAST_PASSES) if left.size else len(words)
        self._open = (words[cut:], times[cut:])
        if self._late:  # the first update was read late: its time does not show how many were missed
            rows = rows[rows.min(axis=1, initial=len(words)) > held]
        passes = np.empty((len(rows), len(self._frames)), np.int64)
        passes[:, self._flags] = rows
        passes[:, ~self._flags] = rows[:, :1]  # a register without ND goes with the first that has it
        columns = np.arange(len(self._frames))
        return self._counted(words[passes, columns], times[passes, columns][:, 0])

    def _counted(self, words: Words, time_s: Floats) -> ScanBlock:
        """Make a block of n scans; compute the missed updates from the times between the scans.

        `words` (n, k) are the words of the scans, `time_s` (n,) the times of the scans in s.
        """
        if not len(time_s):
            return self._block(words, time_s, 0)
        before = time_s[0] - self._period_s if self._last_s is None else self._last_s
        self._last_s = float(time_s[-1])
        # Number of periods between successive rows.
        gaps = np.diff(time_s, prepend=before) / self._period_s
        poll = self._pass_s / self._period_s
        if poll < ALIGNABLE and not self._in_bursts:  # known to less than half a period: the count is exact
            missed = np.rint(gaps) - 1
        elif poll < 1 and not self._in_bursts:  # only a lower bound is sure
            missed = np.floor(gaps - poll)
        else:  # right on the average
            missed = gaps - 1
        # In bursts the times jitter: an excess in one gap is missing in another.
        total = self._missed + np.cumsum(missed if self._in_bursts else np.maximum(missed, 0))
        # Whole missed updates up to each row; the fraction is carried to the next block.
        whole = np.floor(np.maximum.accumulate(np.maximum(total, 0))).astype(np.int64)
        self._missed = float(total[-1] - whole[-1])
        counts = np.diff(whole, prepend=0)
        return self._block(words, time_s, int(whole[-1]), counts)
