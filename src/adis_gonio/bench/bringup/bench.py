"""What the steps share: the sensor, what is known by now, and reading without gaps.

Where every limit of the bring-up comes from: one probability of a false alarm for a whole board.

A sound board is to be accused less often than once in 10 000. The probability is divided by the largest
number of comparisons of a run (Bonferroni), so that the comparisons need not be independent. Each limit
is the quantile of the distribution that the compared figure has on a sound board: normal for means,
chi-square for variances, exponential for the bins of a periodogram. What is not random on a sound board
(a stuck line, a lost edge) has no limit: there one occurrence is enough.

A bus that never clocks faster than the link was found to be free of errors.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from adis_gonio.bench.bringup.result import StepResult, Verdict
from adis_gonio.device.bus import Capability, FrameStream, SpiBus, SpiTiming, Words
from adis_gonio.device.sensor.decoding import ScanBlock, join
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.device.sensor.registers import BY_NAME, EA, IDLE, Register, register, registers
from adis_gonio.device.sensor.scanning import PolledScans, ScanLayout, ScanStream


class ClockCeiling(SpiBus):
    """Passes everything on to another bus; `ceiling_hz` limits the clock from the next `configure` on."""

    def __init__(self, inner: SpiBus, ceiling_hz: float) -> None:
        super().__init__(inner.timing)
        self.inner = inner
        self.ceiling_hz = ceiling_hz
        self.url = inner.url
        self.capabilities = inner.capabilities
        self.edge_rises = inner.edge_rises
        self.unbroken_frames = inner.unbroken_frames

    def now_s(self) -> float:
        """Monotonic time of the bus in s."""
        return self.inner.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait on the bus's clock."""
        self.inner.sleep_s(seconds)

    def stream(self, frames: Sequence[int], *, block_scans: int = 256) -> FrameStream:
        """As the bus."""
        return self.inner.stream(frames, block_scans=block_scans)

    def hard_reset(self) -> None:
        """As the bus."""
        self.inner.hard_reset()

    def read_event_counter(self) -> int:
        """As the bus."""
        return self.inner.read_event_counter()

    def _exchange(self, frames: Words) -> Words:
        return self.inner.exchange_array(frames)

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        return self.inner.configure(replace(timing, clock_hz=min(timing.clock_hz, self.ceiling_hz)))

    def _close(self) -> None:
        self.inner.close()


FALSE_ALARM = 1e-4
"""Probability that a sound board is accused of anything."""
MOST_TESTS = 256
"""Comparisons that a run may make."""


class AlarmBudget:
    """Shares the probability of a false alarm out."""

    def __init__(self, total: float = FALSE_ALARM, tests: int = MOST_TESTS) -> None:
        self.total = total
        self.tests = tests
        self.spent = 0

    def alpha(self) -> float:
        """Probability of a false alarm of one more comparison.

        Raises
        ------
        RuntimeError
            All are spent: the number of tests is a promise about the code.
        """
        if self.spent >= self.tests:
            raise RuntimeError(f"more than {self.tests} comparisons: the false alarm rate does not hold")
        self.spent += 1
        return self.total / self.tests

    def z(self) -> float:
        """Limit of |x − μ| / u, two-sided, of a normal figure."""
        from scipy.special import ndtri

        return float(-ndtri(self.alpha() / 2))

    def variance_ratio(self, dof: float) -> tuple[float, float]:
        """Limits of s²/σ² with `dof` degrees of freedom, two-sided."""
        from scipy.special import gammainccinv, gammaincinv

        tail, shape = self.alpha() / 2, dof / 2
        return float(gammaincinv(shape, tail)) / shape, float(gammainccinv(shape, tail)) / shape

    def highest_bin(self, bins: int) -> float:
        """Limit of the largest of `bins` bins of a periodogram over their mean."""
        return math.log(bins / self.alpha())


def at_most(errors: int, trials: int, confidence: float = 0.95) -> float:
    """Upper limit of a probability after `errors` in `trials` (Clopper and Pearson)."""
    from scipy.special import betaincinv

    return 1.0 if errors >= trials else float(betaincinv(errors + 1, trials - errors, confidence))


Floats = NDArray[np.float64]

HOST_CLOCK_U = 100e-6 / np.sqrt(3)
"""Relative standard uncertainty of a computer's clock: quartz, within 100 ppm."""
BOARD_CLOCK_U = 5e-3 / np.sqrt(3)
"""The same of a bridge that times frames itself: a ceramic resonator, within 0.5 %."""


LONGEST_S = 40.0
"""No run of scans takes longer, for slow bridges and slow sample rates, …"""
FEWEST = 16
"""… unless there are not even so many scans."""


class SideEffect(StrEnum):
    """What a step does to the part."""

    READS = "reads"
    LENDS = "lends data-ready"
    """Enables data-ready while it runs, as a stream does, and sets MSC_CTRL back."""
    WRITES = "writes, undone"
    FLASH = "flash write"


class BringupStep(ABC):
    """A step of the bring-up.

    Attributes
    ----------
    name : str
        Names the row.
    does : str
        One line: what is done.
    effect : SideEffect
    question : str
        What is asked before something is written.
    settles : tuple of str
        Questions about the part that it answers.
    """

    name: str
    does: str
    effect: SideEffect = SideEffect.READS
    question: str = ""
    settles: tuple[str, ...] = ()

    @abstractmethod
    def run(self, bench: BringupBench) -> StepResult:
        """Do it; `AdisGonioError` where the part or the bridge fails."""


@dataclass
class BringupBench:
    """The bench of one run.

    Attributes
    ----------
    lends : bool
        Data-ready may be enabled.
    blocked : str
        Why nothing more can be measured; empty while something can.
    clock : float
        Measured period of the update over its nominal one; 1 where it is not known.
    data_ready : bool
        Edges were seen to belong to the updates.
    supply_ok : bool
        The supply allows a flash update.
    """

    bus: ClockCeiling
    sensor: Adis16354
    budget: AlarmBudget = field(default_factory=AlarmBudget)
    lends: bool = True
    blocked: str = ""
    clock: float = 1.0
    clock_known: bool = False
    data_ready: bool = False
    supply_ok: bool = True
    constants: dict[str, int] = field(default_factory=dict)

    def has(self, capability: Capability) -> bool:
        """True where the bridge offers a capability."""
        return capability in self.bus.capabilities

    def refresh(self) -> None:
        """Set the clock that the present mode and the ceiling allow."""
        self.sensor._follow()

    # -- reading --------------------------------------------------------------------------------------

    def repeated(self, name: str | Register, count: int) -> tuple[Words, float]:
        """Words (count,) of the same register one right after the other, and the time of a frame in s.

        Longer than what a bridge runs without a pause they are not: then fewer words come.
        """
        if self.bus.unbroken_frames is not None:
            count = min(count, self.bus.unbroken_frames - 1)
        frame = (register(name).address & 0x3F) << 8
        frames = np.full(count + 1, frame, np.uint16)
        frames[-1] = IDLE
        begin_s = self.bus.now_s()
        replies = self.bus.exchange_array(frames)
        took_s = (self.bus.now_s() - begin_s) / (count + 1)
        timed = self.bus.unbroken_frames is not None
        return replies[1:], self.bus.timing.frame_s if timed else took_s

    def scans(self, count: int, names: Sequence[str]) -> tuple[ScanBlock, bool]:
        """Scans (at most `count`, no longer than `LONGEST_S`), and whether they follow without a gap.

        The bridge streams where data-ready may be lent and was found to work, else it polls. Where there
        are gaps the longest run without one is returned if it is long enough, else all scans.
        """
        blocks: list[ScanBlock] = []
        have, begin_s = 0, self.bus.now_s()
        with self._stream(names, min(count, 256)) as stream:
            for block in stream:
                blocks.append(block)
                have += len(block)
                late = self.bus.now_s() - begin_s > LONGEST_S
                if have >= count or (late and have >= FEWEST):
                    break
        whole = join(blocks).first(count)
        run = _longest_run(blocks, count)
        return (run, True) if len(run) >= count // 2 else (whole, False)

    def _stream(self, names: Sequence[str], block_scans: int) -> ScanStream:
        if self.lends and self.data_ready:
            return self.sensor.stream(names, block_scans=block_scans)
        # Data-ready may be enabled and not be wired: polling needs none.
        now = self.sensor.configuration()
        layout = ScanLayout(
            registers(names), self.sensor.variant.name, now.gyro_range_dps, now.sample_period_s
        )
        return PolledScans(self.bus, layout, max(4, min(block_scans, round(0.5 / now.sample_period_s))))

    def means(self, count: int, names: Sequence[str]) -> Floats:
        """Means of the registers' numbers over `count` scans."""
        block, _ = self.scans(count, names)
        return np.asarray(block.numbers().mean(axis=0), np.float64)

    def sample_quickly(self) -> None:
        """The fastest sample rate, for steps that write anyway."""
        if self.sensor.read("SMPL_PRD") & 0xFF != 0x01:
            self.sensor.write("SMPL_PRD", 0x01)
            self.wait_updates()

    # -- flags ------------------------------------------------------------------------------------------

    def alarm_stands(self) -> bool:
        """EA, as it comes with a word that is read; STATUS is not touched."""
        return bool(self.sensor.read_words(["XACCL_OUT"])[0] & EA)

    def status(self) -> int:
        """STATUS, which is cleared."""
        return self.sensor.read("STATUS")

    def wait_updates(self, count: int = 4) -> None:
        """Let some updates pass, and the filter settle."""
        now = self.sensor.configuration()
        self.bus.sleep_s(now.settling_s + count * now.sample_period_s)


def _longest_run(blocks: Sequence[ScanBlock], count: int) -> ScanBlock:
    """The longest piece without a missed update; a block whose gaps have no place counts as broken."""
    whole = join(blocks)
    breaks: list[int] = [0]
    at = 0
    for block in blocks:
        if block.missed is not None:
            breaks += [at + int(k) for k in np.flatnonzero(block.missed)]
        elif block.lost:
            breaks += range(at, at + len(block))
        at += len(block)
    breaks = sorted({*breaks, len(whole)})
    lengths = np.diff(breaks)
    if not len(lengths):
        return whole.first(0)
    best = int(np.argmax(lengths))
    cut = slice(breaks[best], min(breaks[best + 1], breaks[best] + count))
    return replace(whole, words=whole.words[cut], time_s=whole.time_s[cut], lost=0, missed=None)


def not_measured(why: str) -> StepResult:
    """A step that could not measure."""
    return StepResult(Verdict.NOT_MEASURED, f"not measured: {why}")


def writable() -> tuple[Register, ...]:
    """Registers that are noted before anything is written, and compared after it.

    SLP_CNT sends the part to sleep, and the levels of GPIO_CTRL follow the wires: no step touches them.
    """
    return tuple(
        row
        for row in BY_NAME.values()
        if row.writable and row.readable and row.name not in ("SLP_CNT", "GPIO_CTRL")
    )
