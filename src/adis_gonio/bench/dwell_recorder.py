"""Recorder of dwells: from the move to a position until the dwell is complete, abandoned or skipped."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import SessionError
from adis_gonio.base.numbers import counted, use_minus
from adis_gonio.bench.dialogue import Questions, Reply
from adis_gonio.bench.events import (
    DwellDone,
    DwellInterrupted,
    DwellProgress,
    Event,
    Guard,
    Problem,
    StageMoved,
    Watching,
    WatchState,
)
from adis_gonio.bench.guards import drift_guard, judge_dwell, judge_shift
from adis_gonio.bench.recorder import BROKEN_STREAM, Recorder
from adis_gonio.bench.session_state import vector
from adis_gonio.device.sensor.registers import SUPPLY_LIMITS_V, TEMP_OUT, TEMPERATURE_LIMITS_C
from adis_gonio.device.sensor.settings import ScanBlock, Status
from adis_gonio.record.archive_tables import Attempt, Move, Outcome, Phase
from adis_gonio.record.blocks import WITHOUT_NEWS, Block, count_alarms, cut, find_alarms, join
from adis_gonio.record.plans import Position
from adis_gonio.record.stillness import Look


@dataclass
class Recording:
    """Scans of one attempt to record a dwell; the dwell is the part of length `dwell_s` from `begin` on.

    The dwell begins `settle_s` after the end of the first still window and lasts `dwell_s`. It is complete
    when a still window covers its last sample.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, and the position.
    began : (str, float)
        Beginning of the attempt by the wall clock (ISO 8601) and by the bus's clock in s.
    dwell_s, settle_s, period_s : float
        Length of the dwell, wait before it, period of the samples, in s.
    earlier : sequence of Block
        Scans of the turn before the attempt, which are kept with it.
    moves : list of Move
        Moves of the stage for this attempt.
    begin : int or None
        Number of the dwell's first sample; None before the dwell.
    timed_out : bool
        True if the sensor did not come to rest in time.
    why_moving : str
        Reason why the newest window before the dwell counts as moving.
    rested_mg : (3,) float or None
        Reading of the sensor when its dwell first began, before a disturbance; None before.
    status, settings_lost : Status or None, str
        STATUS after the dwell, and the message of `SessionBench.settings_lost`.
    """

    place: int
    position: Position
    began: tuple[str, float]
    dwell_s: float
    settle_s: float
    period_s: float
    earlier: Sequence[Block] = ()
    moves: list[Move] = field(default_factory=list)
    begin: int | None = None
    timed_out: bool = False
    why_moving: str = "no data"
    rested_mg: Floats | None = None
    status: Status | None = None
    settings_lost: str = ""
    _blocks: list[Block] = field(default_factory=list)
    _times: Floats = field(default_factory=lambda: np.empty(0))
    _still_s: float | None = None

    @property
    def begun(self) -> bool:
        """True if the dwell has begun, after the sensor has settled."""
        return self.begin is not None

    @property
    def is_still(self) -> bool:
        """True if the sensor is still, although it may not have settled yet."""
        return self._still_s is not None

    @property
    def samples(self) -> int:
        """Number of samples of the dwell so far."""
        begin, stop = np.searchsorted(self._times, self._span_s)
        return int(stop - begin)

    @property
    def waited_s(self) -> float:
        """Time from the first scan to the newest scan, in s."""
        return float(self._times[-1] - self._times[0]) if len(self._times) else 0.0

    @property
    def elapsed_s(self) -> float:
        """Length of the dwell so far, in s."""
        return min(float(self._times[-1]) - self._span_s[0], self.dwell_s) if self.begun else 0.0

    def add(self, block: Block) -> None:
        """Add the next block of scans."""
        if len(block):
            self._blocks.append(block)
            self._times = np.concatenate([self._times, block.time_s])

    def moving(self, why: str) -> None:
        """Note that the sensor moved in a window before the dwell; `why` states the reason."""
        self._still_s = None
        self.why_moving = why

    def still(self, end: int) -> None:
        """Note that the sensor was still in a window that ends before sample `end`."""
        if self._still_s is None:
            self._still_s = float(self._times[end - 1])

    def try_begin(self) -> bool:
        """Begin the dwell if the sensor has settled; return True if this call began it."""
        if self.begun or self._still_s is None:
            return False
        first = int(np.searchsorted(self._times, self._still_s + self.settle_s))
        if first < len(self._times):
            self.begin = first
        return self.begun

    def complete(self, checked: int) -> bool:
        """Return True if the last sample was read, and the sensor was checked to be still up to it.

        `checked` is the number of samples that were checked.
        """
        stop = int(np.searchsorted(self._times, self._span_s[1]))
        return stop < len(self._times) and checked >= stop

    def scans(self) -> Block:
        """Return the scans of the dwell as one block."""
        return join([block for phase, block in self._pieces() if phase == "dwell"])

    def attempt(self, outcome: Outcome, ended_bus_s: float, reason: str = "") -> Attempt:
        """Make the record of this attempt for the archive.

        `ended_bus_s` is its end on the bus's clock in s, and `reason` the reason of an interruption.
        """
        status = None if self.status is None else self.status.word
        blocks: list[tuple[Phase, Block]] = [("before", block) for block in self.earlier]
        blocks += self._pieces()
        return Attempt(
            self.place, self.position, outcome, *self.began, ended_bus_s, blocks, self.moves, reason, status
        )

    @property
    def _span_s(self) -> tuple[float, float]:
        """Times in s at which the dwell begins and ends; infinite before it has begun."""
        if self.begin is None:
            return math.inf, math.inf
        begin_s = float(self._times[self.begin])
        # Half a period early, so that rounding of times cannot add or drop a sample.
        return begin_s, begin_s + self.dwell_s - 0.5 * self.period_s

    def _pieces(self) -> list[tuple[Phase, Block]]:
        """Return the blocks, split at the begin and the end of the dwell, each part with its phase.

        The phases are `before`, `dwell` and `after`. All scans lost in a block that is split count as lost
        in the dwell.
        """
        phases: tuple[Phase, ...] = ("before", "dwell", "after")
        pieces: list[tuple[Phase, Block]] = []
        for block in self._blocks:
            begin, stop = np.searchsorted(block.time_s, self._span_s).tolist()
            edges = pairwise((0, begin, stop, len(block)))
            parts = [
                (phase, low, high) for phase, (low, high) in zip(phases, edges, strict=True) if high > low
            ]
            lossy = "dwell" if stop > begin else parts[0][0]
            pieces += [(phase, cut(block, low, high, counted=phase == lossy)) for phase, low, high in parts]
        return pieces


WINDOWS_TO_STILLNESS = 4
"""Number of windows before the stillness watch gives its first result; their time extends the time-out."""


@dataclass(frozen=True)
class _Broken:
    """The reason why a dwell was interrupted, as text, and the guard that asks the operator about it.

    `guard` is None if the operator need not be asked.
    """

    reason: str
    guard: Guard | None = None


class DwellRecorder(Recorder):
    """Records dwells: moves the stage, waits for stillness, reads the scans, asks about disturbances."""

    def __init__(self, questions: Questions) -> None:
        super().__init__(questions)
        # Of the present dwell: kinds of guards that the operator overruled, and doubts about the result.
        self._kept_kinds: set[str] = set()
        self._doubts: list[Guard] = []

    def take(self, place: int) -> Iterator[Event]:
        """Record the dwell of the position at index `place` of the plan; a disturbed dwell is restarted.

        Raises
        ------
        SessionError
            No dwell is possible, and there is no operator to ask.
        """
        recording = self._new_recording(place)
        self._kept_kinds, self._doubts = set(), []
        if self._knowledge.judge is not None:
            self._knowledge.judge.withdraw(place)  # a repeated dwell is not judged by the one it replaces
        if not (yield from self._go_to(recording)):
            return
        restarts = 0
        while (broken := (yield from self._record(recording))) is not None:
            yield self._interrupted(recording, broken.reason, guarded=broken.guard is not None)
            if self._questions.interrupted:
                return
            guard, restarts, rested_mg = broken.guard, restarts + 1, recording.rested_mg
            if guard is None and (recording.timed_out or restarts == 5):
                self._bench.close_stream()
                guard = self._gave_up(recording, broken.reason, restarts)
                if guard is None:
                    # The noise may have grown since it was measured.
                    self._knowledge.limits = None
                    message = f"{recording.position}: {broken.reason}; no dwell was possible"
                    yield self._ledger.problem(Problem("stillness", message, place))
                    return
            if guard is not None:
                if not (yield from self._ask(guard, place)):
                    return
                restarts, rested_mg = 0, None
            recording = self._new_recording(place, rested_mg)
        yield from self._complete(recording)

    def _gave_up(self, recording: Recording, reason: str, restarts: int) -> Guard | None:
        """Return the guard that asks the operator after `restarts` disturbances of a dwell.

        `reason` is the last disturbance. Returns None if the sensor never came to rest.

        Raises
        ------
        SessionError
            The settings of the sensor have changed, or there is no operator to ask.
        """
        if lost := self._bench.settings_lost():
            raise SessionError(f"{recording.position}: {lost}")
        if self._questions.auto:
            raise SessionError(
                f"{recording.position}: {reason}; no dwell was possible;"
                " find the cause of the motion and resume the session"
            )
        if recording.timed_out:
            return None
        text = f"{counted(restarts, 'dwell')} in a row were disturbed: {reason}"
        return Guard("shock", f"{text}; find the cause of the disturbance", {"times": float(restarts)})

    def _go_to(self, recording: Recording) -> Generator[Event, None, bool]:
        """Move the stage to a position; return False if the operator interrupted."""
        position = recording.position
        move = self._bench.move_to(position)
        if move is not None:
            recording.moves.append(move)
            yield StageMoved(position)
        if (yield from self._questions.wait(recording.place, position.wait_s)):
            # An attempt without scans keeps the move, which a resumed simulation has to repeat.
            yield self._interrupted(recording, self._questions.why_interrupted)
            return False
        return True

    def _new_recording(self, place: int, rested_mg: Floats | None = None) -> Recording:
        bench = self._bench
        return Recording(
            place,
            self._ledger.plan.positions[place],
            bench.moment(),
            bench.settings.dwell_s,
            bench.settle_s,
            bench.period_s,
            self._questions.take_scanned(),
            rested_mg=rested_mg,
        )

    def _record(self, recording: Recording) -> Generator[Event, None, _Broken | None]:
        """Wait for stillness, record the dwell and check the sensor.

        If an error ends it, the scans so far are archived. Returns None, or the reason if the dwell was
        interrupted.
        """
        with self._archiving(lambda why: self._interrupted(recording, why)):
            broken = yield from self._scan(recording)
            if broken is None:
                recording.status, recording.settings_lost = self._check_sensor()
                self._bench.checkpoint()
        return broken

    def _scan(self, recording: Recording) -> Generator[Event, None, _Broken | None]:
        """Wait for stillness, then read the dwell; return None, or the reason if it was interrupted."""
        bench, questions, knowledge = self._bench, self._questions, self._knowledge
        watch = knowledge.watch()
        patience_s = bench.settings.still_timeout_s + WINDOWS_TO_STILLNESS * bench.window * bench.period_s
        look: Look | None = None
        for block in bench.scans():
            recording.add(block)
            knowledge.see(block)
            for look in watch.feed(block.accel_mg):
                disturbed = self._disturbance(recording, look)
                if disturbed is not None:
                    return disturbed
            if recording.try_begin() and look is not None:
                watch.anchor(recording.begin)
                guard = yield from self._settled(recording, look.mean_mg)
                if guard is not None:
                    return _Broken(guard.message, guard)
            if questions.interrupted:
                return _Broken(questions.why_interrupted)
            yield from questions.remarks(recording.place)
            if look is None:
                continue
            if recording.complete(look.end):
                return None
            yield self._look_event(recording, look)
            if not recording.begun and recording.waited_s > patience_s:
                recording.timed_out = True
                return _Broken(f"not still within {recording.waited_s:.0f} s ({recording.why_moving})")
        return _Broken(BROKEN_STREAM)

    def _look_event(self, recording: Recording, look: Look) -> Watching | DwellProgress:
        """Return the event that shows the newest window, before the dwell or during it."""
        state: WatchState = "settling" if recording.is_still else "moving"
        waits_for = "the part to settle" if recording.is_still else f"rest: {recording.why_moving}"
        if recording.begun:
            state, waits_for = "recording", "the dwell to end"
        newest = self._knowledge.watching(
            state, look.mean_mg, look.spread_mg, recording.position.angle_deg, waits_for
        )
        if not recording.begun:
            return newest
        return DwellProgress(recording.place, recording.elapsed_s, recording.dwell_s, newest)

    def _disturbance(self, recording: Recording, look: Look) -> _Broken | None:
        """Judge a window of the stillness watch; return the disturbance if it ends a dwell, else None."""
        auto = self._questions.auto
        if look.state == "stuck":
            if auto:
                raise SessionError(look.why)
            guard = Guard("stuck", look.why, answers=("retake", "skip"), spoils=True)
            return _Broken(look.why, guard)
        if look.state == "still":
            recording.still(look.end)
        elif recording.begun:
            moved_on = look.shifted and not auto and "drift" not in self._kept_kinds
            return _Broken(look.why, drift_guard(look.why) if moved_on else None)
        else:
            recording.moving(look.why)
        return None

    def _interrupted(self, recording: Recording, reason: str, *, guarded: bool = False) -> DwellInterrupted:
        attempt = recording.attempt("interrupted", self._bench.now_s, reason)
        number = self._ledger.archive.add_attempt(attempt)
        return DwellInterrupted(
            recording.place, recording.position, number, recording.samples, reason, guarded
        )

    def _complete(self, recording: Recording) -> Iterator[Event]:
        bench, ledger = self._bench, self._ledger
        if recording.settings_lost:
            yield self._interrupted(recording, recording.settings_lost)
            raise SessionError(f"{recording.position}: {recording.settings_lost}")
        attempt = recording.attempt("complete", bench.now_s)
        number = ledger.archive.add_attempt(attempt)
        place, scans = recording.place, recording.scans()
        for guard in self._doubts:
            ledger.note("doubt", {"attempt": number, "kind": guard.kind, "message": guard.message})
        ledger.use_attempt(place, number)
        if self._knowledge.judge is not None:
            self._knowledge.judge.done(place, recording.position, scans, doubted=bool(self._doubts))
        mean = vector(scans.accel_mg.mean(axis=0))
        yield DwellDone(
            place, recording.position, number, len(scans), scans.lost, mean, count_alarms(scans)
        )
        found = problems(place, scans, recording.status)
        for problem in found:
            yield ledger.problem(problem)
        yield from self._within(recording, scans, found)
        running = self._knowledge.running()
        if running is not None and ledger.done.get(place) == number:
            yield running

    # -- guards ---------------------------------------------------------------------------------------

    def _ask(self, guard: Guard, place: int) -> Generator[Event, None, bool]:
        """Ask the operator the question of a guard; return True if the dwell is kept or continues.

        `place` is the index in the plan of the position that the guard questions.
        """
        ledger = self._ledger
        answer = yield from self._questions.ask_guard(guard, place)
        if answer is Reply.KEEP:
            self._keep(guard)
        elif answer is Reply.REVERSE:
            self._knowledge.reverse()
        elif answer is Reply.SKIP:
            ledger.skip(place)
            if guard.contradicts and ledger.done:
                taken = sorted(ledger.done.values())
                doubt = {"place": place, "dwells": taken, "kind": guard.kind, "message": guard.message}
                ledger.note("contradiction", doubt)
        return answer in (Reply.KEEP, Reply.REVERSE)

    def _settled(self, recording: Recording, mean_mg: Floats) -> Generator[Event, None, Guard | None]:
        """Check the position of the sensor at rest; return the guard that doubts it, or None.

        `mean_mg` is the present reading. Without an operator the doubt is recorded as a problem, and None
        is returned.
        """
        judge, limits, place = self._knowledge.judge, self._knowledge.limits, recording.place
        rested_mg = recording.rested_mg
        recording.rested_mg = mean_mg if rested_mg is None else rested_mg
        if judge is None or limits is None:
            return None
        turned = judge.turned(place, recording.position, mean_mg)
        if turned is not None:
            yield turned
        guard = judge.settled(place, recording.position, mean_mg)
        if guard is None and rested_mg is not None and not self._questions.auto:
            guard = judge_shift(mean_mg, rested_mg, limits.upper)
        if guard is None or guard.kind in self._kept_kinds:
            return None
        if not self._questions.auto:
            return guard
        self._keep(guard)
        yield self._tell_problem(guard, recording)
        return None

    def _within(self, recording: Recording, scans: Block, found: list[Problem]) -> Iterator[Event]:
        """Ask the operator whether to keep a dwell with alarms, a wrong supply or a change of temperature.

        `scans` are the scans of the dwell, and `found` the problems that `problems` listed for it; the list
        is not changed. Yields the events of the questions. If the operator does not keep the dwell, or ends
        the session at the question, it is withdrawn. Without an operator each doubt that `found` lacks is
        recorded as a problem.
        """
        ledger, place = self._ledger, recording.place
        kinds = {problem.kind for problem in found}
        for guard in judge_dwell(scans, found):
            if self._questions.auto:
                if guard.kind not in kinds and not (guard.kind == "over_range" and "alarm" in kinds):
                    yield self._tell_problem(guard, recording)
                continue
            if not (yield from self._ask(guard, place)):
                skipped = place in ledger.skipped
                yield self._knowledge.withdraw(place)
                if skipped:
                    ledger.skipped.add(place)
                return

    def _keep(self, guard: Guard) -> None:
        self._kept_kinds.add(guard.kind)
        if guard.spoils:
            self._doubts.append(guard)

    def _tell_problem(self, guard: Guard, recording: Recording) -> Problem:
        problem = Problem(guard.kind, f"{recording.position}: {guard.message}", recording.place)
        return self._ledger.problem(problem)


_RANGES: dict[str, tuple[Literal["supply", "temperature"], tuple[float, float], str]] = {
    "SUPPLY_OUT": ("supply", SUPPLY_LIMITS_V, "V"),
    **dict.fromkeys(TEMP_OUT, ("temperature", TEMPERATURE_LIMITS_C, "°C")),
}
"""Kind of problem, limits and unit of a reading outside its limits, by register."""


def problems(place: int, scans: Block, status: Status | None) -> list[Problem]:
    """List the problems of a dwell for the operator: STATUS, alarms, supply, temperature, lost scans.

    `place` is the index of its position in the plan; `status` is None without a register STATUS.
    """
    messages = () if status is None else status.messages
    found = [Problem("status", f"STATUS: {message}", place) for message in messages]
    alarms = find_alarms(scans)
    if alarms is not None:
        why = "" if messages else "; it has passed: the bits of over-range and supply clear automatically"
        found.append(Problem("alarm", f"{alarms}{why}", place))
    for name, (kind, (low, high), unit) in _RANGES.items():
        if isinstance(scans, ScanBlock) and name in scans.registers:
            values = scans.column(name)
            if values.min() < low or values.max() > high:
                text = f"the {kind} ({name}) was between {values.min():.3f} and {values.max():.3f} {unit}"
                text += f"; the part needs {low:g} to {high:g} {unit}"
                found.append(Problem(kind, use_minus(text), place))
    gaps: tuple[tuple[Literal["lost", "dropped"], int, str], ...] = (
        ("lost", scans.lost, "lost on the bus"),
        ("dropped", scans.dropped, f"left out: {WITHOUT_NEWS}"),
    )
    for gap, count, what in gaps:
        if count:
            share = 100.0 * count / (len(scans) + count)
            found.append(Problem(gap, f"{counted(count, 'scan')} ({share:.2g} %) {what}", place))
    return found
