"""An attempt at a dwell while it is being made: which of its scans count, and when it is complete."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

from adis_gonio.base.arrays import Floats
from adis_gonio.record.archive_tables import Attempt, Move, Outcome, Phase
from adis_gonio.record.blocks import Block, cut, join
from adis_gonio.record.plans import Position


@dataclass
class Recording:
    """Scans of one attempt, in order; all are kept, those between `begin` and `stop` are the dwell.

    The dwell begins `settle_s` after the end of the first window that is still, and lasts `dwell_s`. It is
    complete once a still window covers its last sample.

    Attributes
    ----------
    dwell_s, settle_s, period_s : float
        Length of the dwell, wait before it, period of the samples, in s.
    earlier : sequence of Block
        Scans from before the attempt that are kept with it: the turn that led to it.
    rested_mg : (3,) float or None
        Where the part rested when the dwell began.
    """

    place: int
    position: Position
    started_utc: str
    started_bus_s: float
    dwell_s: float
    settle_s: float
    period_s: float
    earlier: Sequence[Block] = ()
    moves: list[Move] = field(default_factory=list)
    begin: int | None = None
    timed_out: bool = False
    why_moving: str = "no data"
    rested_mg: Floats | None = None
    _blocks: list[Block] = field(default_factory=list)
    # Samples until the end of each block, and scans lost until there.
    _ends: list[int] = field(default_factory=lambda: [0])
    _lost: list[int] = field(default_factory=lambda: [0])
    _still_s: float | None = None
    _begin_s: float = 0.0
    _stop: int | None = None

    @property
    def begun(self) -> bool:
        """True once the dwell has begun."""
        return self.begin is not None

    @property
    def is_still(self) -> bool:
        """True while the part is still and the dwell waits for it to settle."""
        return self._still_s is not None

    @property
    def samples(self) -> int:
        """Samples of the dwell so far."""
        if self.begin is None:
            return 0
        return (self._count if self._stop is None else self._stop) - self.begin

    @property
    def lost(self) -> int:
        """Scans lost within the dwell: what every block lost that holds a sample of it."""
        if self.begin is None or not self.samples:
            return 0
        first = bisect_right(self._ends, self.begin) - 1
        last = bisect_left(self._ends, self.begin + self.samples)
        return self._lost[last] - self._lost[first]

    @property
    def waited_s(self) -> float:
        """Time from the first scan to the newest one."""
        return self._samples_time(self._count - 1) - self._samples_time(0) if self._count else 0.0

    @property
    def elapsed_s(self) -> float:
        """Length of the dwell so far."""
        return min(self._samples_time(self._count - 1) - self._begin_s, self.dwell_s) if self.begun else 0.0

    def add(self, block: Block) -> None:
        """Take the next scans."""
        if not len(block):
            return
        self._blocks.append(block)
        self._ends.append(self._count + len(block))
        self._lost.append(self._lost[-1] + block.lost)
        if self.begun and self._stop is None:
            self._find_stop()

    def moving(self, why: str) -> None:
        """A window before the dwell moves: wait on."""
        self._still_s = None
        self.why_moving = why

    def still(self, end: int) -> None:
        """A window that ends before sample `end` is still."""
        if self._still_s is None:
            self._still_s = self._samples_time(end - 1)

    def try_begin(self) -> bool:
        """Begin the dwell where the part has settled; True when this call began it."""
        if self.begun or self._still_s is None:
            return False
        first = self._first_sample(self._still_s + self.settle_s)
        if first is None:
            return False
        self.begin = first
        self._begin_s = self._samples_time(first)
        self._find_stop()
        return True

    def complete(self, checked: int) -> bool:
        """True where the dwell's last sample has come and windows up to sample `checked` were still."""
        return self._stop is not None and checked >= self._stop

    def scans(self) -> Block:
        """The dwell's scans as one block."""
        return join([block for phase, block in self._pieces() if phase == "dwell"])

    def attempt(
        self, outcome: Outcome, ended_bus_s: float, reason: str = "", status: int | None = None
    ) -> Attempt:
        """What the archive keeps."""
        return Attempt(
            self.place,
            self.position,
            outcome,
            self.started_utc,
            self.started_bus_s,
            ended_bus_s,
            [*(("before", block) for block in self.earlier), *self._pieces()],
            self.moves,
            reason,
            status,
        )

    @property
    def _count(self) -> int:
        """Samples so far."""
        return self._ends[-1]

    def _find_stop(self) -> None:
        # Half a period early, so that rounding of times cannot add or drop a sample.
        self._stop = self._first_sample(self._begin_s + self.dwell_s - 0.5 * self.period_s)

    def _first_sample(self, at_s: float) -> int | None:
        """Index of the first sample at or after a time; None where it has not come yet."""
        index = self._count
        for block in reversed(self._blocks):
            index -= len(block)
            if block.time_s[0] < at_s:
                inside = int((block.time_s < at_s).sum())
                return None if index + inside == self._count else index + inside
        return 0 if self._count else None

    def _samples_time(self, sample: int) -> float:
        at = bisect_right(self._ends, sample) - 1
        return float(self._blocks[at].time_s[sample - self._ends[at]])

    def _pieces(self) -> list[tuple[Phase, Block]]:
        """Blocks cut where the dwell begins and ends; what a cut block lost is counted to the dwell."""
        begin = self._count if self.begin is None else self.begin
        stop = self._count if self._stop is None else self._stop
        pieces: list[tuple[Phase, Block]] = []
        index = 0
        for block in self._blocks:
            edges = [min(max(edge - index, 0), len(block)) for edge in (0, begin, stop, self._count)]
            parts: list[tuple[Phase, int, int]] = [
                ("before", edges[0], edges[1]),
                ("dwell", edges[1], edges[2]),
                ("after", edges[2], edges[3]),
            ]
            parts = [part for part in parts if part[2] > part[1]]
            lossy = "dwell" if any(part[0] == "dwell" for part in parts) else parts[0][0]
            for phase, low, high in parts:
                pieces.append((phase, cut(block, low, high, counted=phase == lossy)))
            index += len(block)
        return pieces
