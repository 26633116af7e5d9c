"""What a session knows of its part: the noise, where it is, which way it turns, what the dwells give."""

from __future__ import annotations

import math

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.bench.bench import SessionBench
from adis_gonio.bench.events import NoiseMeasured, Running, Withdrawn
from adis_gonio.bench.judge import Judge
from adis_gonio.bench.ledger import Ledger
from adis_gonio.bench.live import LiveView, vector
from adis_gonio.bench.running import RunningFit
from adis_gonio.live.smoothed import SmoothedMeter, sensing_of
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.record.blocks import Block, join
from adis_gonio.record.expectation import PriorKnowledge
from adis_gonio.record.plans import Position
from adis_gonio.record.stillness import StillnessLimits, limits_from_noise
from adis_gonio.record.watch import SETTLINGS_PER_WINDOW, StillnessWatch

LEAST_BIAS_MG = 10.0
"""Spread of a bias of which a source knows nothing: the ADIS16354's estimate (CHIP, D)."""


class Knowledge:
    """Learns from scans and dwells; begins with the dwells of the archive.

    Parameters
    ----------
    bench : SessionBench
    ledger : Ledger
    judging : bool
        False where no place is declared that the part could be at.

    Attributes
    ----------
    view : LiveView
        What a front end sees of it.
    judge : Judge or None
        None before the noise is known, and where places are not judged.
    limits : StillnessLimits or None
        None before the noise is known.
    reversed : bool
        True where the session is taken as turned the other way.
    """

    def __init__(self, bench: SessionBench, ledger: Ledger, *, judging: bool) -> None:
        self._bench = bench
        self._ledger = ledger
        self._judging = judging
        self._noise_mg: Floats = np.zeros(3)
        self._running = RunningFit(ledger.header)
        self.view = LiveView()
        self.judge: Judge | None = None
        self.limits: StillnessLimits | None = None
        self.reversed = bool(ledger.archive.last("reversed"))

    def take_noise(self, noise: list[float]) -> NoiseMeasured:
        """Set the limits of stillness by the noise at rest (mg), and begin to judge."""
        bench = self._bench
        quantum = bench.source.part.step_mg
        limits = limits_from_noise(np.array(noise), bench.window, quantum)
        self.limits = limits
        self.view.limit_mg = vector(limits.upper)
        self._noise_mg = np.maximum(noise, quantum / math.sqrt(12))
        largest_mg = float(self._noise_mg.max())
        self.judge = self.view.judge = self._new_judge(largest_mg)
        if self.judge is not None and not bench.virtual_time:  # else nobody sees the part while it turns
            sensing = sensing_of(bench.configuration, bench.source.part.name, largest_mg)
            self.view.smoother = SmoothedMeter(sensing, lag_s=0.0)
        return NoiseMeasured(
            vector(noise), vector(limits.upper), vector(limits.lower), bench.window * bench.period_s
        )

    def _new_judge(self, noise_mg: float) -> Judge | None:
        """Who judges where the part is, with the dwells of a resumed session; None with a loose fixture."""
        bench, ledger = self._bench, self._ledger
        planar = ledger.plan.plane != "none"
        fixture = ledger.header.fixture_sigma_deg
        if not self._judging or (planar and fixture is not None and math.isinf(fixture)):
            return None
        spread = PriorKnowledge(
            max(bench.source.part.initial_bias_mg, LEAST_BIAS_MG),
            noise_mg / math.sqrt(SETTLINGS_PER_WINDOW),
            fixture,
            1000.0 * ledger.header.gravity_mps2 / STANDARD_GRAVITY_MPS2,
        )
        gap_s = bench.window * bench.period_s
        judge = Judge(spread, planar=planar, sense=-1 if self.reversed else 1, longest_gap_s=gap_s)
        archive = ledger.archive
        doubted = {doubt["attempt"] for doubt in archive.doubts()}
        for attempt in archive.dwells():
            scans = join(archive.blocks(attempt, "dwell"))
            judge.done(attempt.place, attempt.position, scans, doubted=attempt.number in doubted)
            self._running.add(attempt.place, attempt.position, scans)
        judge.forget_turn()
        return judge

    def watch(self) -> StillnessWatch:
        """A watch over stillness; `UsageError` before the noise is known."""
        if self.limits is None:
            raise UsageError("the limits of stillness are not known")
        return StillnessWatch(self.limits, self._noise_mg)

    def see(self, block: Block) -> None:
        """Take scans."""
        self.view.see(block)
        if self.judge is not None:
            self.judge.turning.see(block)

    def learn(self, place: int, position: Position, scans: Block, *, doubted: bool) -> None:
        """Take a complete dwell."""
        self._running.add(place, position, scans)
        if self.judge is not None:
            self.judge.done(place, position, scans, doubted=doubted)

    def withdraw(self, place: int) -> Withdrawn:
        """Take a dwell out of the session and forget it."""
        withdrawn = self._ledger.withdraw(place)
        self._running.withdraw(place)
        if self.judge is not None:
            self.judge.withdraw(place)
        return withdrawn

    def reverse(self) -> None:
        """Take the session as turned the other way: all angles count backwards from here on."""
        self.reversed = not self.reversed
        self._ledger.note("reversed", self.reversed)
        if self.judge is not None:
            self.judge.reverse()

    def running(self) -> Running | None:
        """What the dwells give so far; None where they do not allow a fit, or the last one still serves."""
        return self._running.result(self._ledger.plan, reverse=self.reversed)


__all__ = ["Knowledge"]
