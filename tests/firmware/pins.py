"""What the pins must do: every frame is measured from its edges and held against the chip's limits.

The limits stand here as the data sheet gives them, apart from those of the simulated chip.
"""

import itertools
from dataclasses import dataclass, field
from statistics import median

F_CPU = 16_000_000
LAST_FAST = 0x09


@dataclass(frozen=True)
class Limits:
    """Limits of one of the chip's modes, in CPU cycles of 62.5 ns."""

    name: str
    stall: int
    period: int
    clock_period: float
    trail: int
    """Chip select is high so soon behind the last clock, or SLP_CNT does not act."""


FAST = Limits("fast", 9 * 16, 40 * 16, F_CPU / 2e6, 10 * 16)
NORMAL = Limits("normal", 75 * 16, 160 * 16, F_CPU / 300e3, 80 * 16)


@dataclass
class FrameEdges:
    """Edges of one frame; times in cycles."""

    limits: Limits
    fall: int
    clock_at_fall: bool
    falling: list[int] = field(default_factory=list)
    rising: list[int] = field(default_factory=list)
    data_changes: list[int] = field(default_factory=list)
    word_in: int = 0
    rise: int = 0
    clock_at_rise: bool = False

    @property
    def bits(self) -> int:
        return len(self.rising)

    @property
    def shortest_clock(self) -> float:
        """Least mean period of four clocks in a row, in cycles.

        yasimavr makes an edge at the end of the instruction that it falls into, so single ones are up to
        three cycles late.
        """
        edges = (self.falling, self.rising)
        return min((b - a for row in edges for a, b in zip(row, row[4:], strict=False)), default=0) / 4

    @property
    def usual_clock(self) -> float:
        """Median clock period in cycles, which those late edges leave alone."""
        edges = (self.falling, self.rising)
        return median([b - a for row in edges for a, b in itertools.pairwise(row)] or [F_CPU // 1_000_000])


@dataclass
class PinLog:
    """Judges frames as they end; keeps the tightest values and every violation."""

    frames: int = 0
    fast_frames: int = 0
    writes: int = 0
    violations: list[str] = field(default_factory=list)
    least: dict[str, float] = field(default_factory=dict)
    longest_trail: dict[str, int] = field(default_factory=dict)
    words: list[int] = field(default_factory=list)
    keep_words: bool = False
    _last_fall: int | None = None
    _last_rise: int | None = None

    def judge(self, frame: FrameEdges) -> None:
        self.frames += 1
        limits = frame.limits
        self.fast_frames += limits is FAST
        self.writes += frame.word_in >> 15
        if self.keep_words:
            self.words.append(frame.word_in)
        self._require(frame.clock_at_fall and frame.clock_at_rise, "the clock idles low: not mode 3", frame)
        self._require(
            len(frame.falling) == len(frame.rising) == 16,
            f"{len(frame.falling)} falling and {len(frame.rising)} rising edges of the clock, not 16",
            frame,
        )
        in_turn = all(low < high for low, high in zip(frame.falling, frame.rising, strict=False)) and all(
            high < low for high, low in zip(frame.rising, frame.falling[1:], strict=False)
        )
        self._require(in_turn, "the first edge of a clock is not the falling one: not mode 3", frame)
        # Mode 3 samples at the rising edge: data stand there for a cycle (62.5 ns) before and behind,
        # which is more than t_DSU = 24.4 ns and t_DHD = 48.8 ns.
        unstable = {t for t in frame.data_changes for high in frame.rising if abs(t - high) < 1}
        self._require(not unstable, f"the data change at the sampling edge ({unstable})", frame)
        if in_turn and frame.bits:  # t_CS = 48.8 ns is less than a cycle
            self._at_least("lead", frame.falling[0] - frame.fall, 1, frame)
            trail = frame.rise - frame.rising[-1]
            self._at_least("trail", trail, 1, frame)
            self.longest_trail[limits.name] = max(trail, self.longest_trail.get(limits.name, 0))
            self._require(trail <= limits.trail, f"trail of {trail / 16} us: too late for a sleep", frame)
        self._at_least("clock", frame.shortest_clock, limits.clock_period, frame)
        if self._last_fall is not None and self._last_rise is not None:
            self._at_least("stall", frame.fall - self._last_rise, limits.stall, frame)
            self._at_least("period", frame.fall - self._last_fall, limits.period, frame)
        self._last_fall, self._last_rise = frame.fall, frame.rise

    def forget(self) -> None:
        """Start the tightest values anew."""
        self.least.clear()
        self.longest_trail.clear()

    def tightest_us(self) -> dict[str, float]:
        """Tightest values of each mode, in µs."""
        return {name: value / 16 for name, value in self.least.items()}

    def least_us(self, what: str, mode: str) -> float:
        """Tightest stall, period or clock period seen in a mode, in µs."""
        return self.least[f"{mode} {what}"] / 16

    def _at_least(self, what: str, value: float, limit: float, frame: FrameEdges) -> None:
        key = f"{frame.limits.name} {what}"
        self.least[key] = min(value, self.least.get(key, value))
        self._require(value >= limit, f"{what} of {value / 16} us, at least {limit / 16:.2f}", frame)

    def _require(self, right: bool, what: str, frame: FrameEdges) -> None:
        if not right:
            self.violations.append(
                f"frame {self.frames - 1} (0x{frame.word_in:04X}, {frame.limits.name} mode,"
                f" {frame.fall / F_CPU:.6f} s): {what}"
            )
