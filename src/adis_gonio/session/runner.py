"""The live session as a state machine without a screen.

A front end iterates over `run()`, which yields typed events (see `events`) and asks by events too:

    runner = SessionRunner.begin(sensor, "a.session", plan("four-position"))
    for event in runner.run():
        if isinstance(event, PositionAsked):
            input(f"Turn the part to {event.position} and press Enter")
            runner.confirm()

A question stands until it is answered. Taking the next event without an answer makes the runner look at
the sensor once and yield `Watching`: a plain front end prompts and answers before it goes on, a full
screen goes on and answers from its key handler, in another thread if it likes. `stop()` is heard at any
time. With `auto` the runner answers for itself, which needs a stage that the program can move.

A simulated sensor's time is virtual and its world depends on nothing but the seed, the time and the moves
of the stage. A resumed session brings a new world to the point where the last complete dwell ended, by the
archived moves at their archived times, and goes on from there as if nothing had happened: the result is
the same to the last bit.
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.errors import AdisGonioError, SessionError, UsageError
from adis_gonio.model.gravity import checked_gravity_mps2
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Floats
from adis_gonio.sensor.driver import Adis16354
from adis_gonio.session.answers import Answer, Operator
from adis_gonio.session.archive import Archive, Header, read_session, utc_now
from adis_gonio.session.bench import Bench
from adis_gonio.session.blocks import Block, count_alarms, join
from adis_gonio.session.closing import Advisor
from adis_gonio.session.events import (
    Advised,
    Advising,
    Configured,
    DwellDone,
    DwellInterrupted,
    Event,
    ExtensionOffered,
    Finished,
    GuardRaised,
    NoiseMeasured,
    Noted,
    Paused,
    PositionAsked,
    Problem,
    RepetitionOffered,
    StageMoved,
    Started,
    Unpaused,
    Waiting,
    Watching,
    Withdrawn,
)
from adis_gonio.session.expectation import Spread
from adis_gonio.session.faults import problems
from adis_gonio.session.guards import (
    Guard,
    drift_guard,
    insistent,
    judge_dwell,
    judge_shift,
    shock_guard,
    stuck_guard,
)
from adis_gonio.session.judge import Judge
from adis_gonio.session.live import LiveView, vector
from adis_gonio.session.plans import Plan, Position, blindness, extended, extension
from adis_gonio.session.recording import Recording
from adis_gonio.session.running import RunningFit
from adis_gonio.session.settings import Settings, expected_each_s
from adis_gonio.session.source import SampleSource
from adis_gonio.session.stillness import StillnessLimits, limits_from_noise
from adis_gonio.session.watch import SETTLINGS_PER_WINDOW, Look, NoiseMeter, StillnessWatch

MOST_RESTARTS = 5
"""Interruptions of one dwell after which somebody has to look."""

WINDOWS_TO_STILLNESS = 4
"""Windows that the watch needs before it can say anything; waited for besides the time-out."""

LEAST_BIAS_MG = 10.0
"""Spread of a bias of which a source knows nothing: the ADIS16354's estimate (CHIP, D)."""

WARMING_S = 600.0
"""Wait for another temperature, where the program sets it."""

PAUSE_STEP_S = 0.1
"""Between two looks for remarks during a pause, on the wall clock."""

WAIT_STEP_S = 1.0
"""Between two looks at the clock and the operator during a wait."""


class SessionRunner(Operator):
    """Runs a session; made by `begin` or `resume`.

    Answers may be given from another thread than the one that iterates over `run()`.
    """

    def __init__(
        self,
        bench: Bench,
        archive: Archive,
        *,
        auto: bool,
        extend: bool,
        resumed: bool,
        advisor: Advisor | None = None,
    ) -> None:
        super().__init__()
        self._bench = bench
        self._archive = archive
        self._header = archive.header()
        self._plan = archive.plan()
        self._auto = auto
        self._extend = extend
        self._resumed = resumed
        self._advisor = advisor
        self._done = {attempt.place: attempt.number for attempt in archive.dwells()}
        self._skipped = archive.skipped()
        self._faulty = {attempt.place for attempt in archive.faulty()}
        self._last_place = max(self._done, key=self._done.__getitem__, default=None)
        self._limits: StillnessLimits | None = None
        self._noise_mg: Floats = np.zeros(3)
        self._ran = False
        self._view = LiveView()
        self._running = RunningFit(self._header)
        self._judge: Judge | None = None
        self._reversed = bool(archive.last("reversed"))
        self._asked_kinds: set[str] = set()
        self._doubts: list[Guard] = []
        self._stops: Counter[int] = Counter()
        self._first_asked_s: float | None = None
        self._taken = 0
        self._scanning: dict[str, Any] = archive.last("scanning") or {}

    @classmethod
    def begin(
        cls,
        sensor: Adis16354 | SampleSource,
        path: str | Path,
        plan: Plan,
        settings: Settings | None = None,
        *,
        auto: bool = False,
        extend: bool = False,
        gravity_mps2: float = STANDARD_GRAVITY_MPS2,
        fixture_sigma_deg: float | None = None,
        title: str = "",
        note: str = "",
        operator: str = "",
        serial: str = "",
        stage: str = "",
        advisor: Advisor | None = None,
    ) -> SessionRunner:
        """Begin a new session in a new file.

        Parameters
        ----------
        sensor : Adis16354 or SampleSource
            Open; stays open afterwards.
        path : path
            File to make; an existing session is never overwritten.
        auto : bool
            Answer all questions; needs a stage that the program can move.
        extend : bool
            With `auto`: accept the extension of the plan that a two-position session offers.
        gravity_mps2 : float
            Local gravity in m/s².
        fixture_sigma_deg : float or None
            Standard uncertainty of a declared angle in degrees; None where it is not stated.
        title, note, operator, serial, stage : str
            What the operator wants to keep with it: who measures, the part's serial number, the stage.
        advisor : Advisor or None
            Asked for further positions when the plan is done, until it has none.

        Raises
        ------
        UsageError
            `auto` without a stage, or gravity or fixture out of range.
        SessionError
            The file exists, or cannot be made.
        """
        checked_gravity_mps2(gravity_mps2, anywhere=True)
        if fixture_sigma_deg is not None and not fixture_sigma_deg >= 0:
            raise UsageError(f"fixture_sigma_deg is {fixture_sigma_deg}: take 0° or more")
        settings = settings or Settings()
        bench = Bench(sensor, settings)
        source = bench.source
        if auto:
            bench.require_auto(plan)
        header = Header(
            url=source.url,
            variant=source.part.name,
            plan=plan,
            settings={k: v for k, v in settings.as_dict().items() if k in source.kept},
            gravity_mps2=gravity_mps2,
            fixture_sigma_deg=math.inf if plan.plane == "none" else fixture_sigma_deg,
            title=title,
            note=note,
            operator=operator.strip(),
            serial=serial.strip(),
            stage=stage.strip(),
            simulated=bench.simulated,
        )
        archive = Archive.create(path, header)
        return cls(bench, archive, auto=auto, extend=extend, resumed=False, advisor=advisor)

    @classmethod
    def resume(
        cls,
        sensor: Adis16354 | SampleSource,
        path: str | Path,
        *,
        auto: bool = False,
        extend: bool = False,
        advisor: Advisor | None = None,
    ) -> SessionRunner:
        """Go on with the positions of a session that are not done yet, with the settings that it has.

        These may be positions that an advisor asked for; a new advisor is asked when they are done.

        Raises
        ------
        UsageError
            `auto` without a stage.
        DataError
            Not a session file, damaged, truncated or newer than this program.
        SessionError
            The file cannot be written, or the sensor is not the one that the session began with.
        """
        archive = Archive.open_existing(path)
        try:
            bench = Bench(sensor, Settings.from_dict(archive.header().settings))
            if auto:
                bench.require_auto(archive.plan())
            bench.require_same_sensor(archive)
            return cls(bench, archive, auto=auto, extend=extend, resumed=True, advisor=advisor)
        except BaseException:
            archive.close()
            raise

    @property
    def reversed(self) -> bool:
        """True where the session is taken as turned the other way."""
        return self._reversed

    @property
    def one_recording(self) -> bool:
        """True where the session is one continuous recording and visits no positions."""
        return False

    @property
    def _recorded_s(self) -> float:
        """How long a dwell is."""
        return self._bench.settings.dwell_s

    @property
    def virtual_time(self) -> bool:
        """True where the sensor's time stands still while nobody takes the next event."""
        return self._bench.virtual_time

    # -- the machine ------------------------------------------------------------------------------

    def run(self) -> Iterator[Event]:
        """Run the session to its end; can be used once.

        Yields
        ------
        Event
            The last one is `Finished`, and by then the file is closed.

        Raises
        ------
        SessionError
            The sensor is stuck, does not come to rest (`auto`), or the archive cannot be written.
        BusError, ChipError
            As the sensor raises them. Whatever was complete before is in the archive.
        """
        if self._ran:
            raise UsageError("a runner runs once; resume the session with a new one")
        self._ran = True
        try:
            yield from self._prepare()
            yield from self._visit()
            finished = self._finish()
        except BaseException:
            with contextlib.suppress(AdisGonioError):  # the first error counts; the bus may be gone
                self._bench.close()
            raise
        finally:
            self._archive.close()
        yield finished

    def _prepare(self) -> Iterator[Event]:
        bench, archive = self._bench, self._archive
        began_s = bench.now_s
        yield Started(
            str(archive.path),
            bench.source.url,
            self._header.variant,
            self._plan,
            self._resumed,
            len(self._done),
        )
        before, after = bench.configure()
        bench.require_same_settings(archive, after)
        last = max(self._done.values(), default=0)
        archive.begin_run(began_s, bench.clock_offset(archive, began_s), last)
        configuration = bench.configuration.as_dict()
        self._note("registers-before", before)
        self._note("configuration", configuration)
        self._note("registers-configured", after)
        self._note("truth", bench.truth())
        yield Configured(configuration, bench.changes(before, after), bench.why_polled)
        noise = archive.last("noise")
        if noise is None:
            noise = yield from self._measure_noise()
        elif bench.virtual_time:
            bench.bring_world_to(archive, last)
        elif bench.simulated:
            bench.take_up(archive, last)
        if noise is not None:
            yield self._limit(noise)

    def _measure_noise(self) -> Generator[Event, None, list[float] | None]:
        bench = self._bench
        noise: Floats | None = None
        while noise is None and not self._stopping.is_set():
            yield from self._heed(None)
            noise = yield from self._meter_noise()
        bench.close_stream()
        self._tell_scanning()
        if noise is None:
            return None
        measured = [float(value) for value in noise]
        bench.checkpoint()
        self._note("noise", measured)
        return measured

    def _meter_noise(self) -> Generator[Event, None, Floats | None]:
        """The noise at rest; None where the operator stops or pauses, or has to be told what is wrong."""
        bench = self._bench
        expected = bench.source.expected_noise_mg(bench.configuration)
        meter = NoiseMeter(bench.window, expected)
        deadline = bench.now_s + bench.settings.still_timeout_s + meter.least_samples * bench.period_s
        for block in bench.scans():
            noise = meter.feed(block.accel_mg)
            self._view.see(block)
            yield self._view.watching(
                "measuring", meter.mean_mg, meter.spread_mg, None, "the part to lie still"
            )
            if noise is not None or self._stopping.is_set() or self._pausing.is_set():
                return noise
            if bench.now_s > deadline:
                message = (
                    f"the sensor does not come to rest: a sample varies by {max(meter.spread_mg):.3g} mg,"
                    f" its noise should be about {expected:.2g} mg; put it on a quiet support"
                )
                if self._auto:
                    raise SessionError(f"{message} and resume")
                yield self._problem(Problem("stillness", message, self._next_place() or 0))
                return None
        return None

    def _limit(self, noise: list[float]) -> NoiseMeasured:
        bench = self._bench
        quantum = bench.source.part.step_mg
        limits = limits_from_noise(np.array(noise), bench.window, quantum)
        self._limits = limits
        self._view.limit_mg = vector(limits.upper)
        self._noise_mg = np.maximum(noise, quantum / math.sqrt(12))
        self._judge = self._view.judge = self._new_judge(float(self._noise_mg.max()))
        return NoiseMeasured(
            vector(noise), vector(limits.upper), vector(limits.lower), bench.window * bench.period_s
        )

    def _new_judge(self, noise_mg: float) -> Judge | None:
        """Who judges where the part is, with the dwells of a resumed session; None with a loose fixture."""
        bench, header = self._bench, self._header
        planar = self._plan.plane != "none"
        fixture = header.fixture_sigma_deg
        if planar and fixture is not None and math.isinf(fixture):
            return None
        spread = Spread(
            max(bench.source.part.initial_bias_mg, LEAST_BIAS_MG),
            noise_mg / math.sqrt(SETTLINGS_PER_WINDOW),
            fixture,
            1000.0 * header.gravity_mps2 / STANDARD_GRAVITY_MPS2,
        )
        gap_s = bench.window * bench.period_s
        judge = Judge(spread, planar=planar, sense=-1 if self._reversed else 1, longest_gap_s=gap_s)
        doubted = {doubt["attempt"] for doubt in self._archive.doubts()}
        for attempt in self._archive.dwells():
            scans = join(self._archive.blocks(attempt, "dwell"))
            judge.done(attempt.place, attempt.position, scans, doubted=attempt.number in doubted)
            self._running.add(attempt.place, attempt.position, scans)
        judge.forget_turn()
        return judge

    def _visit(self) -> Iterator[Event]:
        while not self._stopping.is_set():
            place = self._next_place()
            yield from self._heed(place)
            if place is None and self._faulty:
                answer = yield from self._offer_repetition()
            elif place is None:
                answer = yield from self._offer_extension()
            else:
                answer = yield from self._ask_position(place)
            if not (yield from self._carry_out(answer, place)):
                return

    def _carry_out(self, answer: Answer, place: int | None) -> Generator[Event, None, bool]:
        """Do what was answered; False where that ends the session."""
        if answer is Answer.REPEAT and self._last_place is not None:
            yield from self._dwell(self._last_place)
        elif answer is Answer.UNDO and self._last_place is not None:
            yield self._withdraw(self._last_place)
        elif answer is Answer.CONFIRM and place is not None:
            yield from self._dwell(place)
        elif answer is Answer.SKIP and place is not None:
            self._skip(place)
        else:
            return answer is Answer.ACCEPT
        return True

    def _ask_position(self, place: int) -> Generator[Event, None, Answer]:
        position = self._plan.positions[place]
        asked = PositionAsked(
            place,
            position,
            min(len(self._done) + len(self._skipped) + 1, len(self._plan)),
            len(self._plan),
            self._last_place is not None,
            self._time_left_s(),
            self._last_place is not None,
        )
        self._view.target = position
        return (yield from self._ask(asked, {Answer.CONFIRM, Answer.SKIP}, Answer.CONFIRM, place))

    def _skip(self, place: int) -> None:
        self._note("skipped", place)
        self._skipped.add(place)

    def _withdraw(self, place: int) -> Withdrawn:
        """Take a dwell out of the session: it stays in the archive, marked."""
        number = self._done.pop(place)
        self._note("withdrawn", number)
        self._faulty.discard(place)
        self._running.withdraw(place)
        if self._judge is not None:
            self._judge.withdraw(place)
        self._last_place = max(self._done, key=self._done.__getitem__, default=None)
        return Withdrawn(place, self._plan.positions[place], number)

    def _time_left_s(self) -> float:
        """How long the positions that are left take, by how long those of this run took."""
        bench, left = self._bench, len(self._plan) - len(self._done) - len(self._skipped)
        if self._first_asked_s is None:
            self._first_asked_s = bench.now_s
        each = expected_each_s(bench.settle_s, bench.settings.dwell_s)
        if self._taken:
            each = (bench.now_s - self._first_asked_s) / self._taken
        open_places = (k for k in range(len(self._plan)) if k not in self._done and k not in self._skipped)
        return left * each + sum(self._plan.positions[k].wait_s for k in open_places)

    def _next_place(self) -> int | None:
        places = range(len(self._plan))
        return next((k for k in places if k not in self._done and k not in self._skipped), None)

    def _ask(
        self, question: Event, answers: set[Answer], default: Answer, place: int | None = None
    ) -> Generator[Event, None, Answer]:
        """Put a question until it is answered; after a pause it is put again."""
        if self._last_place is not None and not isinstance(question, GuardRaised):
            answers = answers | {Answer.REPEAT, Answer.UNDO}
        idle: _Idle | None = None
        try:
            while not self._stopping.is_set():
                self._open(frozenset(answers))
                yield question
                while not (self._stopping.is_set() or self._pausing.is_set()):
                    if (answer := self._given()) is not None:
                        return answer
                    if self._auto:
                        return default
                    yield from self._keep_remarks(place)
                    idle = idle or _Idle(self._bench, self._view, self._see)
                    yield idle.look()
                idle = None
                yield from self._heed(place)
            return Answer.STOP
        finally:
            self._open(frozenset())
            self._bench.close_stream()

    def _ask_guard(self, guard: Guard, place: int) -> Generator[Event, None, bool]:
        """Put what a guard stopped at to the operator; True where the dwell is to go on or to stay."""
        self._stops[place] += 1
        shown = insistent(guard, self._stops[place] if self._done else 1)
        raised = GuardRaised(
            guard.kind,
            shown.message,
            place,
            self._plan.positions[place],
            shown.values,
            guard.answers,
            guard.default,
        )
        allowed = {Answer(name) for name in guard.answers}
        answer = yield from self._ask(raised, allowed, Answer(guard.default), place)
        self._note(
            "guard", {"place": place, "kind": guard.kind, "message": guard.message, "answer": answer}
        )
        if answer is Answer.KEEP:
            self._asked_kinds.add(guard.kind)
            if guard.spoils:
                self._doubts.append(guard)
        elif answer is Answer.REVERSE:
            self._reverse()
        elif answer is Answer.SKIP:
            self._skip(place)
            if guard.contradicts and self._done:
                taken = sorted(self._done.values())
                doubt = {"place": place, "dwells": taken, "kind": guard.kind, "message": guard.message}
                self._note("contradiction", doubt)
        return answer in (Answer.KEEP, Answer.REVERSE)

    def _reverse(self) -> None:
        """Take the session as turned the other way: all angles count backwards from here on."""
        self._reversed = not self._reversed
        self._note("reversed", self._reversed)
        if self._judge is not None:
            self._judge.reverse()

    def _heed(self, place: int | None) -> Iterator[Event]:
        """Keep what the operator has remarked, and pause where that was asked for."""
        yield from self._keep_remarks(place)
        if not self._pausing.is_set():
            return
        self._open(frozenset())
        self._bench.close_stream()
        self._note("paused", place)
        yield Paused(place)
        while self._pausing.is_set() and not self._stopping.is_set():
            yield from self._keep_remarks(place)
            self._going_on.wait(PAUSE_STEP_S)
        self._note("unpaused", {"place": place})
        yield Unpaused(place)

    def _keep_remarks(self, place: int | None) -> Iterator[Event]:
        for remark in self._said():
            self._note("remark", {"text": remark.text, "utc": remark.utc, "place": place})
            yield Noted(remark.text)

    def _offer_repetition(self) -> Generator[Event, None, Answer]:
        """Ask about dwells with a fault: repeat them, or keep them as they are, which is recorded."""
        places = sorted(self._faulty)
        where = tuple(self._plan.positions[place] for place in places)
        offer = RepetitionOffered(tuple(places), where)
        answer = yield from self._ask(offer, {Answer.ACCEPT, Answer.DECLINE}, Answer.DECLINE)
        if answer is Answer.DECLINE:
            self._keep_faulty(places)
            return Answer.ACCEPT
        if answer is Answer.ACCEPT:
            for place in places:
                other = yield from self._take_again(place)
                if other is not None:
                    return other
        return answer

    def _take_again(self, place: int) -> Generator[Event, None, Answer | None]:
        """Ask for a position that has a dwell until there is a new one; what else was answered, if so.

        Skipped, the dwell that it has is kept as it is.
        """
        before = self._done.get(place)
        while self._done.get(place) == before and not self._stopping.is_set():
            answer = yield from self._ask_position(place)
            if answer is Answer.CONFIRM:
                yield from self._dwell(place)
            if answer is Answer.SKIP or (place in self._skipped and self._done.get(place) == before):
                self._skipped.discard(place)
                self._keep_faulty([place])
                return None
            if answer not in (Answer.CONFIRM, Answer.SKIP):
                return answer
        return None

    def _keep_faulty(self, places: list[int]) -> None:
        """Keep dwells with a fault in them as they are, and ask no more about them."""
        self._note("kept", [self._done[place] for place in places])
        self._faulty.difference_update(places)

    def _offer_extension(self) -> Generator[Event, None, Answer]:
        longer = extension(self._plan, len(self._done))
        typical_mg = self._bench.source.part.initial_bias_mg
        gravity_mg = 1000.0 * self._header.gravity_mps2 / STANDARD_GRAVITY_MPS2
        blind = blindness(self._plan, typical_mg, gravity_mg)
        if longer is None or blind is None:
            return (yield from self._ask_advisor())
        wanted = self._extend or self._advisor is not None
        return (yield from self._offer(ExtensionOffered(longer, blind), wanted))

    def _offer(self, offer: ExtensionOffered, wanted: bool) -> Generator[Event, None, Answer]:
        """Offer a longer plan; it is in the archive before its first position is asked for."""
        default = Answer.ACCEPT if wanted else Answer.DECLINE
        answer = yield from self._ask(offer, {Answer.ACCEPT, Answer.DECLINE}, default)
        if answer is Answer.ACCEPT:
            self._note("plan", offer.plan.as_dict())
            self._plan = offer.plan
        return answer

    def _ask_advisor(self) -> Generator[Event, None, Answer]:
        """Let the advisor see the archive, and offer what it asks for."""
        if self._advisor is None or not self._done:
            return Answer.STOP
        yield Advising(len(self._done))
        rounds = [record.value for record in self._archive.records("advised")]
        visited = len(self._plan) - rounds[0]["planned"] if rounds else 0
        advice = self._advisor.advise(read_session(self._archive.path), visited, self._reachable)
        count, number = len(advice.positions), len(rounds) + 1
        self._note(
            "advised",
            {
                "round": number,
                "planned": len(self._plan),
                "positions": count,
                "reasons": list(advice.reasons),
                "ended": advice.ended,
                "summary": advice.summary,
            },
        )
        yield Advised(number, count, advice.ended, advice.summary)
        if not advice.positions:
            return Answer.STOP
        longer = extended(self._plan, advice.positions)
        return (yield from self._offer(ExtensionOffered(longer, None, advice.reasons), True))

    def _reachable(self, position: Position) -> bool:
        """True where somebody, or the program alone with `auto`, can and will bring the part there."""
        refused = {replace(self._plan.positions[place], wait_s=0.0) for place in self._skipped}
        if replace(position, wait_s=0.0) in refused:
            return False
        return not self._auto or self._bench.can_reach(position)

    # -- a dwell ----------------------------------------------------------------------------------

    def _dwell(self, place: int) -> Iterator[Event]:
        recording = self._new_recording(place)
        self._asked_kinds, self._doubts = set(), []
        if not (yield from self._go_to(recording)):
            return
        restarts, rested_mg = 0, None
        while (broken := (yield from self._record_or_keep(recording, rested_mg))) is not None:
            yield self._interrupted(recording, broken.reason)
            if self._stopping.is_set() or self._pausing.is_set():
                return
            guard, restarts = broken.guard, restarts + 1
            rested_mg = recording.rested_mg if rested_mg is None else rested_mg
            if guard is None and (recording.timed_out or restarts == MOST_RESTARTS):
                self._bench.close_stream()
                guard = self._gave_up(recording, broken.reason, restarts)
                if guard is None:
                    message = f"{recording.position}: {broken.reason}; no dwell was possible"
                    yield self._problem(Problem("stillness", message, place))
                    return
            if guard is not None:
                if not (yield from self._ask_guard(guard, place)):
                    return
                restarts, rested_mg = 0, None
            recording = self._new_recording(place)
        yield from self._complete(recording)

    def _gave_up(self, recording: Recording, reason: str, restarts: int) -> Guard | None:
        """What to ask after so many disturbances; None where the part never came to rest.

        Raises
        ------
        SessionError
            Nobody is there to ask.
        """
        if self._auto:
            raise SessionError(
                f"{recording.position}: {reason}; no dwell was possible;"
                " find what moves the part and resume the session"
            )
        return None if recording.timed_out else shock_guard(reason, restarts)

    def _go_to(self, recording: Recording) -> Generator[Event, None, bool]:
        """Bring about what the position asks for, as far as the program can; False where it was stopped."""
        place, position = recording.place, recording.position
        if self._bench.sets_conditions and self._bench.wants_conditions(position):
            wanted = {"temperature_c": position.temperature_c, "supply_v": position.supply_v}
            # The record's time is the one at which the change begins: nothing may come between.
            self._note("conditions", wanted)
            self._bench.set_conditions(**wanted)
            if position.temperature_c is not None and (yield from self._wait(place, WARMING_S)):
                return False
        move = self._bench.move_to(position)
        if move is not None:
            recording.moves.append(move)
            yield StageMoved(position)
        if (yield from self._wait(place, position.wait_s)):
            # An attempt without scans keeps the move, which a resumed simulation has to live through.
            yield self._interrupted(recording, self._why_ended())
            return False
        return True

    def _wait(self, place: int, length_s: float) -> Generator[Event, None, bool]:
        """Wait before a dwell; True where the operator stopped or paused it."""
        end_s = self._bench.now_s + length_s
        while length_s > 0 and (left := end_s - self._bench.now_s) > 0:
            if self._stopping.is_set() or self._pausing.is_set():
                return True
            yield from self._keep_remarks(place)
            yield Waiting(place, length_s - left, length_s)
            self._bench.source.sleep_s(min(left, WAIT_STEP_S))
        return False

    def _why_ended(self) -> str:
        return f"{'stopped' if self._stopping.is_set() else 'paused'} by the operator"

    def _new_recording(self, place: int) -> Recording:
        bench = self._bench
        return Recording(
            place,
            self._plan.positions[place],
            utc_now(),
            bench.now_s,
            bench.settings.dwell_s,
            bench.settle_s,
            bench.period_s,
        )

    def _record_or_keep(
        self, recording: Recording, rested_mg: Floats | None
    ) -> Generator[Event, None, _Broken | None]:
        """Record; where that breaks off with an error, keep what there is."""
        try:
            return (yield from self._record(recording, rested_mg))
        except BaseException as error:
            why = str(error) if isinstance(error, AdisGonioError) else "the program ended"
            self._interrupted(recording, why)
            raise

    def _record(
        self, recording: Recording, rested_mg: Floats | None
    ) -> Generator[Event, None, _Broken | None]:
        """Wait for stillness, then record; return None when complete, else what interrupted it."""
        watch = self._watch()
        window_s = self._bench.window * self._bench.period_s
        patience_s = self._bench.settings.still_timeout_s + WINDOWS_TO_STILLNESS * window_s
        look: Look | None = None
        for block in self._bench.scans():
            recording.add(block)
            self._see(block)
            for look in watch.feed(block.accel_mg):
                disturbed = self._disturbance(recording, look)
                if disturbed is not None:
                    return disturbed
            if recording.try_begin() and look is not None:
                watch.anchor(recording.begin)
                broken = yield from self._judge_place(recording, look.mean_mg, rested_mg)
                if broken is not None:
                    return broken
            if self._stopping.is_set() or self._pausing.is_set():
                return _Broken(self._why_ended())
            yield from self._keep_remarks(recording.place)
            if look is None:
                continue
            if recording.complete(look.end):
                return None
            yield self._view.dwell(recording, look.mean_mg, look.spread_mg, self._bench.settings.dwell_s)
            if not recording.begun and recording.waited_s > patience_s:
                recording.timed_out = True
                return _Broken(f"not still within {recording.waited_s:.0f} s ({recording.why_moving})")
        return _Broken("the stream of scans ended")

    def _see(self, block: Block) -> None:
        self._view.see(block)
        if self._judge is not None:
            self._judge.turning.see(block)

    def _disturbance(self, recording: Recording, look: Look) -> _Broken | None:
        """Tell the recording what was seen of the part; return what disturbed a dwell that had begun."""
        if look.state == "stuck":
            if self._auto:
                raise SessionError(look.why)
            return _Broken(look.why, stuck_guard(look.why))
        if look.state == "still":
            recording.still(look.end)
        elif recording.begun:
            moved_on = look.shifted and not self._auto and "drift" not in self._asked_kinds
            return _Broken(look.why, drift_guard(look.why) if moved_on else None)
        else:
            recording.moving(look.why)
        return None

    def _judge_place(
        self, recording: Recording, mean_mg: Floats, rested_mg: Floats | None
    ) -> Generator[Event, None, _Broken | None]:
        """Whether the part may be where it has come to rest; with nobody to ask a problem is told."""
        judge, place, limits = self._judge, recording.place, self._limits
        recording.rested_mg = mean_mg
        if judge is None or limits is None:
            return None
        turned = judge.turned(place, recording.position, mean_mg)
        if turned is not None:
            yield turned
        guard = judge.settled(recording.position, mean_mg)
        if guard is None and rested_mg is not None and not self._auto:
            guard = judge_shift(mean_mg, rested_mg, limits.upper)
        if guard is None or guard.kind in self._asked_kinds:
            return None
        if not self._auto:
            return _Broken(guard.message, guard)
        self._asked_kinds.add(guard.kind)
        if guard.spoils:
            self._doubts.append(guard)
        yield self._problem(Problem(guard.kind, f"{recording.position}: {guard.message}", place))
        return None

    def _watch(self) -> StillnessWatch:
        if self._limits is None:
            raise UsageError("the limits of stillness are not known")
        return StillnessWatch(self._limits, self._noise_mg)

    def _interrupted(self, recording: Recording, reason: str) -> DwellInterrupted:
        attempt = recording.attempt("interrupted", self._bench.now_s, reason)
        number = self._archive.add_attempt(attempt)
        return DwellInterrupted(recording.place, recording.position, number, recording.samples, reason)

    def _complete(self, recording: Recording) -> Iterator[Event]:
        bench = self._bench
        bench.close_stream()
        self._tell_scanning()
        status = bench.source.status()
        bench.checkpoint()
        attempt = recording.attempt("complete", bench.now_s, status=None if status is None else status.word)
        number = self._archive.add_attempt(attempt)
        place, scans = recording.place, recording.scans()
        self._faulty.discard(place)
        alarms = count_alarms(scans)
        if attempt.status or alarms:
            self._faulty.add(place)
        self._learn(recording, scans, number)
        mean = vector(scans.accel_mg.mean(axis=0))
        yield DwellDone(place, recording.position, number, len(scans), scans.lost, mean, alarms)
        found = problems(place, scans, status)
        for problem in found:
            yield self._problem(problem)
        yield from self._judge_dwell(recording, scans, found)
        running = self._running.result(self._plan, reverse=self._reversed)
        if running is not None and self._done.get(place) == number:
            yield running

    def _learn(self, recording: Recording, scans: Block, number: int) -> None:
        """Count a complete dwell, with what was doubted of it and kept."""
        place = recording.place
        for guard in self._doubts:
            self._note("doubt", {"attempt": number, "kind": guard.kind, "message": guard.message})
        self._done[place] = number
        self._taken += 1
        self._stops.clear()
        self._skipped.discard(place)
        self._last_place = place
        self._running.add(place, recording.position, scans)
        if self._judge is not None:
            self._judge.done(place, recording.position, scans, doubted=bool(self._doubts))

    def _judge_dwell(self, recording: Recording, scans: Block, found: list[Problem]) -> Iterator[Event]:
        """Ask about what happened within a dwell; with nobody to ask a problem is told."""
        place = recording.place
        told = {problem.kind for problem in found}
        for guard in judge_dwell(scans, found):
            if self._auto:
                if guard.kind not in told and not (guard.kind == "over_range" and "alarm" in told):
                    yield self._problem(
                        Problem(guard.kind, f"{recording.position}: {guard.message}", place)
                    )
                continue
            stays = yield from self._ask_guard(guard, place)
            if self._stopping.is_set():
                return
            if not stays:
                skipped = place in self._skipped
                yield self._withdraw(place)
                if skipped:
                    self._skipped.add(place)
                return
            if place in self._faulty:
                self._note("kept", [self._done[place]])
                self._faulty.discard(place)

    def _tell_scanning(self) -> None:
        """Record how scans are got, where that is new."""
        now = self._bench.scanning
        if now != self._scanning:
            self._scanning = now
            self._note("scanning", now)

    def _problem(self, problem: Problem) -> Problem:
        self._note("problem", problem.as_dict())
        return problem

    def _note(self, kind: str, value: Any) -> None:
        """Write a record, where there is something to write."""
        if value is not None:
            self._archive.add_record(kind, value, self._bench.now_s)

    def _finish(self) -> Finished:
        complete = self._next_place() is None
        for _ in self._keep_remarks(None):
            pass
        self._bench.close()  # what was changed for the scans alone is set back first
        self._note("registers-after", self._bench.source.registers())
        self._note("truth", self._bench.truth(self._archive.dwells(), self._recorded_s))
        self._note("finished", {"complete": complete})
        return Finished(
            str(self._archive.path), complete, len(self._done), len(self._skipped), len(self._plan)
        )


@dataclass(frozen=True)
class _Broken:
    """Why a dwell was broken off, and what has to be asked about it."""

    reason: str
    guard: Guard | None = None


class _Idle:
    """The newest samples while a question stands."""

    def __init__(self, bench: Bench, view: LiveView, see: Callable[[Block], None]) -> None:
        self._stream = bench.scans()
        self._window = bench.window
        self._view = view
        self._see = see
        self._kept = np.empty((0, 3))

    def look(self) -> Watching:
        for block in self._stream:
            self._see(block)
            self._kept = np.concatenate([self._kept, block.accel_mg])[-self._window :]
            if len(self._kept) > 1:
                break
        target = self._view.target
        return self._view.watching(
            "idle",
            self._kept.mean(axis=0),
            self._kept.std(axis=0, ddof=1),
            None if target is None else target.angle_deg,
            "an answer",
        )


__all__ = ["Answer", "SessionRunner"]
