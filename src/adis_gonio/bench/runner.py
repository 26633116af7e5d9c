"""The live session as a state machine without a screen.

A front end iterates over `run()`, which yields typed events (see `events`); questions are events too:

    runner = SessionRunner.begin(sensor, "a.session", plan("four-position"))
    for event in runner.run():
        if isinstance(event, PositionAsked):
            input(f"Turn the part to {event.position} and press Enter")
            runner.answer("confirm")

A question is open until it is answered. If the next event is taken without an answer, the runner reads the
sensor once and yields `Watching`: a plain front end prompts and answers before it continues, a full screen
continues and answers from its key handler, possibly in another thread. `stop()` works at any time. With
`auto` the runner answers its own questions, which needs a stage that the program can move.

The time of a simulated sensor is virtual, and its world depends only on the seed, the time and the moves of
the stage. A resumed session brings a new world to the end of the last complete dwell, by the archived moves
at their archived times, and continues from there: the result is identical to the last bit.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError, SessionError, UsageError
from adis_gonio.base.shapes import ShapeError, moment
from adis_gonio.bench.advisor import TraceAdvisor
from adis_gonio.bench.dialogue import Operator, Questions, Reply
from adis_gonio.bench.dwell_recorder import DwellRecorder
from adis_gonio.bench.events import (
    Advised,
    Advising,
    Configured,
    Event,
    ExtensionOffered,
    Finished,
    PositionAsked,
    Problem,
    Started,
)
from adis_gonio.bench.gyro_turns import GyroTurnsRecorder
from adis_gonio.bench.recorder import FreeTurnRecorder, Recorder
from adis_gonio.bench.session_bench import SessionBench
from adis_gonio.bench.session_state import Knowledge, Ledger
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, StageCurve, checked_gravity_mps2
from adis_gonio.record.archive import Archive
from adis_gonio.record.archive_tables import Header, utc_now
from adis_gonio.record.plans import GYRO_TURNS, Plan, Position, blindness, extension
from adis_gonio.record.session_reader import FREE_TURN, read_session
from adis_gonio.record.source import SampleSource, Settings, expected_each_s
from adis_gonio.record.stillness import NoiseMeter

RECORDERS: dict[str, type[Recorder]] = {GYRO_TURNS: GyroTurnsRecorder, FREE_TURN: FreeTurnRecorder}
"""Recorder by the name of the plan; other plans take a `DwellRecorder`."""


class SessionRunner(Operator):
    """Runs a session; create it by `begin` or `resume`.

    Answers may be given from another thread than the thread that iterates over `run()`.

    Attributes
    ----------
    bench : SessionBench
        Sensor and stage of the session.
    judges_places : bool
        True if each position is checked by gravity.
    """

    def __init__(
        self,
        bench: SessionBench,
        archive: Archive,
        *,
        auto: bool,
        extend: bool,
        resumed: bool,
        advisor: TraceAdvisor | None = None,
    ) -> None:
        super().__init__()
        self.bench = bench
        self._archive = archive
        archive.utc = bench.utc
        self._resumed = resumed
        self._ran = False
        self._ledger = Ledger(archive, lambda: bench.now_s)
        self._recorder_type = RECORDERS.get(self._ledger.plan.name, DwellRecorder)
        self.judges_places = self._recorder_type.judges_places
        self._knowledge = Knowledge(bench, self._ledger, judging=self.judges_places)
        self._questions = Questions(self, bench, self._ledger, self._knowledge, auto=auto)
        self._recorder = self._recorder_type(self._questions)
        self._extend, self._advisor = extend, advisor
        self._first_asked_s: float | None = None

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
        stage_curve: StageCurve | None = None,
        advisor: TraceAdvisor | None = None,
        **metadata: str,
    ) -> SessionRunner:
        """Begin a new session in a new file.

        Parameters
        ----------
        sensor : Adis16354 or SampleSource
            Open sensor; it stays open.
        path : str or Path
            File of the new session; an existing session is never overwritten.
        plan : Plan
            Positions to visit.
        settings : Settings or None
            Settings of the session; None for the defaults.
        auto : bool
            True to answer each question by its default; needs a stage that the program can move.
        extend : bool
            With `auto`: True to accept the extension that a two-position session offers.
        gravity_mps2 : float
            Local gravity in m/s².
        fixture_sigma_deg : float or None
            Standard uncertainty of a declared angle in degrees; None if it is not stated.
        stage_curve : StageCurve or None
            Errors of the stage according to its certificate, which correct the declared angles; None
            without one.
        advisor : TraceAdvisor or None
            Source of further positions when the plan is done; None if there is none.
        metadata : str
            Texts to keep with the session: `title`, `note` and the names in
            `adis_gonio.model.records.METADATA`; or `created_utc`, the time of its begin in ISO 8601 with
            its time zone (default: now).

        Raises
        ------
        UsageError
            `auto` is set without a stage, gravity or fixture is out of range, `created_utc` is no time with
            a time zone, or the certificate of the stage does not cover the plan.
        SessionError
            The file exists, or cannot be created.
        """
        checked_gravity_mps2(gravity_mps2, anywhere=True)
        try:
            moment(metadata.get("created_utc") or utc_now())
        except ShapeError as error:
            raise UsageError(f"created_utc{error}") from None
        if fixture_sigma_deg is not None and not fixture_sigma_deg >= 0:
            raise UsageError(f"fixture_sigma_deg is {fixture_sigma_deg}: take 0° or more")
        if stage_curve is not None:
            stage_curve.check(position.angle_deg for position in plan.positions)
        settings = settings or Settings()
        bench = SessionBench(sensor, settings)
        source = bench.source
        if auto:
            bench.require_auto(plan)
        stated = math.inf if plan.plane == "none" else fixture_sigma_deg
        header = Header(
            url=source.url,
            variant=source.part.name,
            plan=plan,
            settings={k: v for k, v in settings.as_dict().items() if k in source.kept},
            gravity_mps2=gravity_mps2,
            fixture_sigma_deg=fixture_sigma_deg if plan.name == GYRO_TURNS else stated,
            stage_curve=None if stage_curve is None else stage_curve.as_dict(),
            simulated=bench.simulated,
            **{"created_utc": bench.utc()} | {name: t.strip() for name, t in metadata.items() if t.strip()},
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
        advisor: TraceAdvisor | None = None,
    ) -> SessionRunner:
        """Continue with the remaining positions of a session, with the session's own settings.

        The remaining positions may be positions that an advisor requested; `advisor` is asked when they are
        done.

        Parameters
        ----------
        sensor : Adis16354 or SampleSource
            Open sensor, the one of the session; it stays open.
        path : str or Path
            File of the session.
        auto : bool
            True to answer each question by its default; needs a stage that the program can move.
        extend : bool
            With `auto`: True to accept the extension that a two-position session offers.
        advisor : TraceAdvisor or None
            Source of further positions when the plan is done; None if there is none.

        Raises
        ------
        UsageError
            `auto` is set without a stage.
        DataError
            The file is no session file, damaged, truncated or newer than this program.
        SessionError
            The file cannot be written, or the session began with another sensor.
        """
        archive = Archive.open_existing(path)
        with archive.closed_on_error():
            bench = SessionBench(sensor, Settings.from_dict(archive.header.settings))
            if auto:
                bench.require_auto(archive.plan())
            bench.require_same_sensor(archive)
            return cls(bench, archive, auto=auto, extend=extend, resumed=True, advisor=advisor)

    @property
    def reversed(self) -> bool:
        """True if the angles of the session are counted the other way than declared."""
        return self._knowledge.reversed

    @property
    def fastest_dps(self) -> float:
        """Largest mean rate of a turn in °/s that suits the gyros' range; known after configuration."""
        # A hand is faster between two grips than in the mean.
        return 0.6 * float(self.bench.configuration.as_dict().get("gyro_range_dps") or 300.0)

    def run(self, *, so_far: bool = True) -> Iterator[Event]:
        """Run the session to its end; can be used once.

        Parameters
        ----------
        so_far : bool
            True to fit the dwells so far after each dwell (`Running` events), which takes the time of a
            fit.

        Yields
        ------
        Event
            Events of the session; the last one is `Finished`, and by then the file is closed.

        Raises
        ------
        SessionError
            The sensor is stuck, does not come to rest (`auto`), or the archive cannot be written.
        BusError, ChipError
            The sensor failed. All dwells completed before are in the archive.
        """
        if self._ran:
            raise UsageError("a runner runs once; resume the session with a new one")
        self._ran = True
        self._knowledge.fits_dwells = so_far
        try:
            yield from self._prepare()
            yield from self._visit()
            finished = self._finish()
        except BaseException:
            with contextlib.suppress(AdisGonioError):  # the first error counts; the bus may be gone
                self.bench.close()
            raise
        finally:
            self._archive.close()
        yield finished

    def _prepare(self) -> Iterator[Event]:
        """Configure the sensor, archive the begin of a run, and yield the events before the first position.

        If the session is resumed and its noise is known, a simulated sensor is restored, too.
        """
        bench, archive, ledger = self.bench, self._archive, self._ledger
        began_s = bench.now_s
        yield Started(
            str(archive.path),
            bench.source.url,
            ledger.header.variant,
            ledger.plan,
            self._resumed,
            len(ledger.done),
        )
        before, after = bench.configure()
        bench.require_same_settings(archive, after)
        last = max(ledger.done.values(), default=0)
        archive.begin_run(began_s, bench.clock_offset(archive, began_s), last)
        configuration = bench.configuration.as_dict()
        ledger.note("registers-before", before)
        ledger.note("configuration", configuration)
        ledger.note("registers-configured", after)
        ledger.note("truth", bench.truth())
        yield Configured(configuration, bench.changes(before, after), bench.source.why_polled)
        noise = archive.last("noise")
        if noise is None:
            return
        if bench.virtual_time:
            bench.bring_world_to(archive, last)
        elif bench.simulated:
            bench.restore_position(archive, last)
        yield self._knowledge.take_noise(noise)
        running = self._knowledge.running() if self._resumed else None
        if running is not None:
            yield running

    # -- positions --------------------------------------------------------------------------------------

    def _visit(self) -> Iterator[Event]:
        """Visit the positions of the plan until it is done or the operator stops.

        The noise at rest is measured first if it is not known, or if the sensor no longer comes to rest by
        the noise that was measured before.
        """
        while not self._questions.stopped:
            if self._knowledge.limits is None:
                noise = yield from _measure_noise(self._questions)
                if noise is None:
                    return
                yield self._knowledge.take_noise(noise)
            place = self._ledger.next_place
            yield from self._questions.handle_pause(place)
            if place is None:
                answer = yield from self._offer_extension()
            else:
                answer = yield from self._ask_position(place)
            if not (yield from self._carry_out(answer, place)):
                return

    def _carry_out(self, answer: Reply, place: int | None) -> Generator[Event, None, bool]:
        """Do what the operator's answer requests; return False if the answer ends the session.

        `place` is the index of the position that the operator was asked to set; None if the program offered
        something else (more positions).
        """
        last = self._ledger.last_place
        if answer is Reply.REPEAT and last is not None:
            yield from self._recorder.take(last)
        elif answer is Reply.UNDO and last is not None:
            yield self._knowledge.withdraw(last)
        elif answer is Reply.CONFIRM and place is not None:
            yield from self._recorder.take(place)
        elif answer is Reply.SKIP and place is not None:
            self._ledger.skip(place)
        else:
            return answer is Reply.ACCEPT
        return True

    def _ask_position(self, place: int) -> Generator[Event, None, Reply]:
        ledger = self._ledger
        position = ledger.plan.positions[place]
        asked = PositionAsked(
            place,
            position,
            min(len(ledger.done) + len(ledger.skipped) + 1, len(ledger.plan)),
            len(ledger.plan),
            ledger.last_place is not None,
            self._time_left_s(),
        )
        self._knowledge.target = position
        return (yield from self._questions.ask(asked, {Reply.CONFIRM, Reply.SKIP}, Reply.CONFIRM, place))

    def _time_left_s(self) -> float:
        """Return an estimate of the time in s for the remaining positions, by the time spent so far."""
        bench, ledger = self.bench, self._ledger
        left = len(ledger.plan) - len(ledger.done) - len(ledger.skipped)
        if self._first_asked_s is None:
            self._first_asked_s = bench.now_s
        each = expected_each_s(bench.settle_s, bench.settings.dwell_s)
        if ledger.taken:
            each = (bench.now_s - self._first_asked_s) / ledger.taken
        return left * each + sum(ledger.plan.positions[k].wait_s for k in ledger.open_places)

    def _offer_extension(self) -> Generator[Event, None, Reply]:
        ledger = self._ledger
        longer = extension(ledger.plan, len(ledger.done))
        typical_mg = self.bench.source.part.initial_bias_mg
        gravity_mg = 1000.0 * ledger.header.gravity_mps2 / STANDARD_GRAVITY_MPS2
        blind = blindness(ledger.plan, typical_mg, gravity_mg)
        if longer is None or blind is None:
            return (yield from self._ask_advisor())
        wanted = self._extend or self._advisor is not None
        reason = (
            f"2 positions cannot see a bias: {typical_mg:g} mg on each axis would put"
            f" {math.degrees(blind):.2f}° into Δφ and {blind:.4f} into ΔK; the opposite positions cancel it"
        )
        return (yield from self._offer(ExtensionOffered(longer, (reason,)), wanted))

    def _offer(self, offer: ExtensionOffered, wanted: bool) -> Generator[Event, None, Reply]:
        """Offer a longer plan and return the answer; an accepted plan is archived before the next position.

        `wanted` is True if the offer is to be accepted when there is no operator.
        """
        default = Reply.ACCEPT if wanted else Reply.DECLINE
        answer = yield from self._questions.ask(offer, {Reply.ACCEPT, Reply.DECLINE}, default)
        if answer is Reply.ACCEPT:
            self._ledger.extend(offer.plan)
        return answer

    def _ask_advisor(self) -> Generator[Event, None, Reply]:
        """Ask the advisor for further positions, and offer these to the operator."""
        ledger = self._ledger
        if self._advisor is None or not ledger.done:
            return Reply.STOP
        yield Advising(len(ledger.done))
        rounds = ledger.archive.values("advised")
        visited = len(ledger.plan) - rounds[0]["planned"] if rounds else 0
        advice = self._advisor.advise(read_session(ledger.archive.path), visited, self._reachable)
        count, number = len(advice.positions), len(rounds) + 1
        ledger.note(
            "advised",
            {
                "round": number,
                "planned": len(ledger.plan),
                "positions": count,
                "reasons": list(advice.reasons),
                "ended": advice.ended,
                "summary": advice.summary,
            },
        )
        yield Advised(number, count, advice.ended, advice.summary)
        if not advice.positions:
            return Reply.STOP
        longer = replace(ledger.plan, positions=(*ledger.plan.positions, *advice.positions))
        return (yield from self._offer(ExtensionOffered(longer, advice.reasons), True))

    def _reachable(self, position: Position) -> bool:
        """Return True if the operator can place the sensor there, or with `auto` the program can."""
        ledger = self._ledger
        refused = {replace(ledger.plan.positions[place], wait_s=0.0) for place in ledger.skipped}
        if replace(position, wait_s=0.0) in refused:
            return False
        return not self._questions.auto or self.bench.can_reach(position)

    # -- end --------------------------------------------------------------------------------------------

    def _finish(self) -> Finished:
        bench, ledger = self.bench, self._ledger
        complete = ledger.next_place is None
        for _ in self._questions.remarks(None):
            pass
        bench.close()  # first undo temporary changes of the registers
        ledger.note("registers-after", bench.source.registers())
        ledger.note(
            "truth", bench.truth(self._archive.dwells(), ledger.recorded_s or bench.settings.dwell_s)
        )
        ledger.note("finished", {"complete": complete})
        return Finished(
            str(self._archive.path), complete, len(ledger.done), len(ledger.skipped), len(ledger.plan)
        )


def _measure_noise(questions: Questions) -> Generator[Event, None, list[float] | None]:
    """Measure the noise of the sensor at rest and record it in the archive.

    If the sensor does not come to rest in time, a problem is shown and the measurement is repeated.

    Returns
    -------
    list of float or None
        Standard deviation of a sample on each axis in mg; None if the operator stopped.

    Raises
    ------
    SessionError
        The sensor does not come to rest, and there is no operator.
    """
    bench, ledger = questions.bench, questions.ledger
    noise: Floats | None = None
    while noise is None and not questions.stopped:
        yield from questions.handle_pause(None)
        noise = yield from _meter_noise(questions)
    bench.close_stream()
    ledger.scanning(bench.scanning)
    if noise is None:
        return None
    measured = [float(value) for value in noise]
    bench.checkpoint()
    ledger.note("noise", measured)
    return measured


def _meter_noise(questions: Questions) -> Generator[Event, None, Floats | None]:
    """Measure the noise (3,) of a sample at rest in mg.

    Returns None if the operator stops or pauses, or if the sensor does not come to rest.
    """
    bench, ledger, knowledge = questions.bench, questions.ledger, questions.knowledge
    expected = bench.source.expected_noise_mg(bench.configuration)
    meter = NoiseMeter(bench.window, expected)
    deadline = bench.now_s + bench.settings.still_timeout_s + meter.least_samples * bench.period_s
    for block in bench.scans():
        noise = meter.feed(block.accel_mg)
        knowledge.see(block)
        yield knowledge.watching("measuring", meter.mean_mg, meter.spread_mg, None, "the part to be still")
        if noise is not None or questions.interrupted:
            return noise
        if bench.now_s > deadline:
            message = (
                f"the sensor does not come to rest: a sample varies by {max(meter.spread_mg):.3g} mg,"
                f" its noise should be about {expected:.2g} mg; put it on a quiet support"
            )
            if questions.auto:
                raise SessionError(f"{message} and resume")
            yield ledger.problem(Problem("stillness", message, ledger.next_place or 0))
            return None
    return None
