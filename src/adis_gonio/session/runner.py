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

import math
import queue
import threading
from collections.abc import Generator, Iterator
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from adis_gonio.bus import Capability
from adis_gonio.errors import AdisGonioError, SessionError, UsageError
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Floats
from adis_gonio.sensor.decoding import ScanBlock
from adis_gonio.sensor.driver import Adis16354
from adis_gonio.sensor.registers import REGISTERS
from adis_gonio.sensor.scanning import ScanStream
from adis_gonio.session.archive import Archive, Header, Move, utc_now
from adis_gonio.session.events import (
    Configured,
    DwellDone,
    DwellInterrupted,
    DwellProgress,
    Event,
    ExtensionOffered,
    Finished,
    NoiseMeasured,
    PositionAsked,
    Problem,
    StageMoved,
    Started,
    Vector,
    Watching,
)
from adis_gonio.session.plans import Plan, Position, blindness, extension
from adis_gonio.session.recording import Recording
from adis_gonio.session.settings import LEAST_SAMPLES, Settings
from adis_gonio.session.stillness import StillnessLimits, limits_from_noise
from adis_gonio.session.watch import Look, NoiseMeter, StillnessWatch, white_noise_gain, window_samples

CHECKPOINT_S = 1e-3
"""Silence at the end of a dwell, so that no frame's timing reaches over the point of resuming."""

MOST_RESTARTS = 5
"""Interruptions of one dwell after which somebody has to look."""

SUPPLY_LIMITS_V = (4.75, 5.25)
"""Specified supply (DS, B)."""

_NOT_COMPARED = ("GPIO_CTRL", "SLP_CNT")
"""Control registers that hold levels of lines or a count that runs, not settings."""


class Stage(Protocol):
    """A stage that the program can move; a bus may bring one as its attribute `stage`."""

    def move_to(self, angle_deg: float, approach: int = 1) -> object:
        """Go to an angle, in the direction `approach` (+1 or -1) at the end."""


class World(Protocol):
    """The simulated surroundings of a sensor; a simulated bus brings one as its attribute `world`."""

    def truth(self) -> dict[str, Any]:
        """What the simulation hides, as JSON."""


class Answer(StrEnum):
    """Answers to a question."""

    CONFIRM = "confirm"
    SKIP = "skip"
    REPEAT = "repeat"
    ACCEPT = "accept"
    DECLINE = "decline"
    STOP = "stop"


class SessionRunner:
    """Runs a session; made by `begin` or `resume`.

    Answers may be given from another thread than the one that iterates over `run()`.
    """

    def __init__(
        self, sensor: Adis16354, archive: Archive, *, auto: bool, extend: bool, resumed: bool
    ) -> None:
        self._sensor = sensor
        self._bus = sensor.bus
        self._archive = archive
        self._header = archive.header()
        self._plan = archive.plan()
        self._settings = Settings.from_dict(self._header.settings)
        self._auto = auto
        self._extend = extend
        self._resumed = resumed
        self._stage: Stage | None = getattr(sensor.bus, "stage", None)
        self._world: World | None = getattr(sensor.bus, "world", None)
        self._done = {attempt.place: attempt.number for attempt in archive.dwells()}
        self._skipped = archive.skipped()
        self._last_place = max(self._done, key=self._done.__getitem__, default=None)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._allowed: frozenset[Answer] = frozenset()
        self._stopping = threading.Event()
        self._stream: ScanStream | None = None
        self._idle: _IdleWindow | None = None
        self._ran = False
        if auto:
            _require_auto(sensor, self._plan)

    @classmethod
    def begin(
        cls,
        sensor: Adis16354,
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
    ) -> SessionRunner:
        """Begin a new session in a new file.

        Parameters
        ----------
        sensor : Adis16354
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
        title, note : str
            What the operator wants to keep with it.

        Raises
        ------
        UsageError
            `auto` without a stage, or settings that the sensor cannot have.
        SessionError
            The file exists, or cannot be made.
        """
        settings = settings or Settings()
        if not (math.isfinite(gravity_mps2) and gravity_mps2 > 0):
            raise UsageError(f"gravity_mps2 is {gravity_mps2}: take local gravity in m/s², about 9.81")
        if fixture_sigma_deg is not None and not fixture_sigma_deg >= 0:
            raise UsageError(f"fixture_sigma_deg is {fixture_sigma_deg}: take 0° or more")
        if auto:
            _require_auto(sensor, plan)
        if plan.plane == "none":
            fixture_sigma_deg = math.inf
        header = Header(
            url=sensor.bus.url,
            variant=sensor.variant.name,
            plan=plan,
            settings=settings.as_dict(),
            gravity_mps2=gravity_mps2,
            fixture_sigma_deg=fixture_sigma_deg,
            title=title,
            note=note,
            simulated=getattr(sensor.bus, "world", None) is not None,
        )
        archive = Archive.create(path, header)
        return cls._made(sensor, archive, auto=auto, extend=extend, resumed=False)

    @classmethod
    def resume(
        cls, sensor: Adis16354, path: str | Path, *, auto: bool = False, extend: bool = False
    ) -> SessionRunner:
        """Go on with the positions of a session that are not done yet.

        Raises
        ------
        DataError
            Not a session file, damaged, truncated or newer than this program.
        SessionError
            The file cannot be written, or the sensor is not the one that the session began with.
        """
        archive = Archive.open_existing(path)
        return cls._made(sensor, archive, auto=auto, extend=extend, resumed=True)

    @classmethod
    def _made(
        cls, sensor: Adis16354, archive: Archive, *, auto: bool, extend: bool, resumed: bool
    ) -> SessionRunner:
        try:
            runner = cls(sensor, archive, auto=auto, extend=extend, resumed=resumed)
            runner._require_same_sensor()
        except BaseException:
            archive.close()
            raise
        return runner

    # -- answers ----------------------------------------------------------------------------------

    def confirm(self) -> None:
        """The part is (or the stage may go) where it was asked to be."""
        self._answer(Answer.CONFIRM)

    def skip(self) -> None:
        """Leave this position out."""
        self._answer(Answer.SKIP)

    def repeat(self) -> None:
        """Do the last dwell again; the new one takes its place, the old one stays in the archive."""
        self._answer(Answer.REPEAT)

    def accept(self) -> None:
        """Go on with the extension that was offered."""
        self._answer(Answer.ACCEPT)

    def decline(self) -> None:
        """End with the plan as it was."""
        self._answer(Answer.DECLINE)

    def stop(self) -> None:
        """End the session now; a dwell in hand is archived as interrupted. It can be resumed."""
        self._stopping.set()

    def _answer(self, answer: Answer) -> None:
        if answer not in self._allowed:
            asked = ", ".join(sorted(self._allowed)) or "nothing"
            raise UsageError(f"'{answer}' answers no question that stands (open: {asked})")
        self._answers.put(answer)

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
        finally:
            self._close_stream()
            self._archive.close()
        yield finished

    def _prepare(self) -> Iterator[Event]:
        began_s = self._bus.now_s()
        yield Started(
            str(self._archive.path),
            self._bus.url,
            self._header.variant,
            self._plan,
            self._resumed,
            len(self._done),
        )
        settings = self._settings
        streams = Capability.STREAM in self._bus.capabilities
        before = self._sensor.read_all()
        configuration = self._sensor.configure(
            smpl_prd=settings.smpl_prd,
            filter_m=settings.filter_m,
            gyro_range_dps=settings.gyro_range_dps,
            data_ready=streams if settings.data_ready is None else settings.data_ready,
        )
        least_s = LEAST_SAMPLES * configuration.sample_period_s
        if settings.dwell_s < least_s:
            raise UsageError(
                f"dwell_s is {settings.dwell_s:g}: at {configuration.sample_rate_hz:.4g} samples a second"
                f" take {least_s:.3g} s or more"
            )
        self._period_s = configuration.sample_period_s
        self._settle_s = max(settings.settle_s, configuration.settling_s)
        self._window = window_samples(configuration)
        self._block_scans = max(8, self._window // 2)
        configured = self._sensor.read_all()
        self._require_same_settings(configured)
        last = max(self._done.values(), default=0)
        self._archive.begin_run(began_s, self._clock_offset(began_s), last)
        now = self._bus.now_s()
        self._archive.add_record("registers-before", before, now)
        self._archive.add_record("configuration", configuration.as_dict(), now)
        self._archive.add_record("registers-configured", configured, now)
        self._record_truth()
        changed = {
            row.name: (before[row.name], configured[row.name])
            for row in REGISTERS
            if row.readable and row.writable and before[row.name] != configured[row.name]
        }
        yield Configured(configuration.as_dict(), changed)
        if self._world is not None and last:
            self._bring_world_to(last)
        yield from self._know_noise(settings.filter_m)

    def _know_noise(self, filter_m: int) -> Iterator[Event]:
        noise = self._archive.last("noise")
        if noise is None:
            expected = self._sensor.variant.performance.noise_mg * white_noise_gain(filter_m)
            meter = NoiseMeter(self._window, expected)
            deadline = (
                self._bus.now_s() + self._settings.still_timeout_s + 20 * self._window * self._period_s
            )
            measured: Floats | None = None
            for block in self._scans():
                measured = meter.feed(block.accel_mg)
                yield Watching("measuring", _vector(meter.mean_mg), _vector(meter.spread_mg))
                if measured is not None or self._stopping.is_set():
                    break
                if self._bus.now_s() > deadline:
                    raise SessionError(
                        f"the sensor does not come to rest: a sample varies by"
                        f" {max(meter.spread_mg):.3g} mg, its noise should be about {expected:.2g} mg;"
                        " put it on a quiet support and resume the session"
                    )
            self._close_stream()
            if measured is None:
                return
            noise = [float(value) for value in measured]
            self._archive.add_record("noise", noise, self._bus.now_s())
        quantum = self._sensor.variant.accel_mg_per_lsb
        self._limits = limits_from_noise(np.array(noise), self._window, quantum)
        yield NoiseMeasured(
            _vector(noise),
            _vector(self._limits.upper),
            _vector(self._limits.lower),
            self._window * self._period_s,
        )

    _limits: StillnessLimits
    _period_s: float
    _settle_s: float
    _window: int
    _block_scans: int

    def _visit(self) -> Iterator[Event]:
        while not self._stopping.is_set():
            place = self._next_place()
            if place is None:
                answer = yield from self._offer_extension()
            else:
                answer = yield from self._ask(
                    PositionAsked(
                        place,
                        self._plan.positions[place],
                        len(self._done) + len(self._skipped) + 1,
                        len(self._plan),
                        self._last_place is not None,
                    ),
                    {Answer.CONFIRM, Answer.SKIP} | self._repeatable(),
                    Answer.CONFIRM,
                )
            if answer is Answer.REPEAT and self._last_place is not None:
                place = self._last_place
            elif answer is Answer.SKIP and place is not None:
                self._archive.add_record("skipped", place, self._bus.now_s())
                self._skipped.add(place)
                continue
            elif answer is Answer.ACCEPT:
                continue
            elif answer is not Answer.CONFIRM:
                return
            if place is not None:
                yield from self._dwell(place)

    def _next_place(self) -> int | None:
        places = range(len(self._plan))
        return next((k for k in places if k not in self._done and k not in self._skipped), None)

    def _repeatable(self) -> set[Answer]:
        return set() if self._last_place is None else {Answer.REPEAT}

    def _ask(
        self, question: Event, allowed: set[Answer], default: Answer
    ) -> Generator[Event, None, Answer]:
        self._allowed = frozenset(allowed)
        yield question
        try:
            while not self._stopping.is_set():
                try:
                    return self._answers.get_nowait()
                except queue.Empty:
                    if self._auto:
                        return default
                yield self._look_idle()
            return Answer.STOP
        finally:
            self._allowed = frozenset()
            self._idle = None
            self._close_stream()

    def _look_idle(self) -> Watching:
        if self._idle is None:
            self._idle = _IdleWindow(self._scans(), self._window)
        return self._idle.look()

    def _offer_extension(self) -> Generator[Event, None, Answer]:
        longer = extension(self._plan, len(self._done))
        typical_mg = self._sensor.variant.performance.initial_bias_mg
        gravity_mg = 1000.0 * self._header.gravity_mps2 / STANDARD_GRAVITY_MPS2
        blind = blindness(self._plan, typical_mg, gravity_mg)
        if longer is None or blind is None:
            return Answer.STOP
        answer = yield from self._ask(
            ExtensionOffered(longer, blind),
            {Answer.ACCEPT, Answer.DECLINE} | self._repeatable(),
            Answer.ACCEPT if self._extend else Answer.DECLINE,
        )
        if answer is Answer.ACCEPT:
            self._archive.add_record("plan", longer.as_dict(), self._bus.now_s())
            self._plan = longer
        return answer

    # -- a dwell ----------------------------------------------------------------------------------

    def _dwell(self, place: int) -> Iterator[Event]:
        position = self._plan.positions[place]
        recording = self._new_recording(place)
        if self._stage is not None and position.angle_deg is not None:
            recording.moves.append(Move(self._bus.now_s(), position.angle_deg, position.approach))
            self._stage.move_to(position.angle_deg, position.approach)
            yield StageMoved(position)
        for restart in range(MOST_RESTARTS + 1):
            if restart:
                recording = self._new_recording(place)
            try:
                reason = yield from self._record(recording)
            except (AdisGonioError, GeneratorExit) as error:
                # Nobody may be left to hear of it, but the samples are kept.
                why = str(error) if isinstance(error, AdisGonioError) else "the program ended"
                self._archive.add_attempt(recording.attempt("interrupted", self._bus.now_s(), why))
                raise
            if reason is None:
                yield from self._complete(recording)
                return
            number = self._archive.add_attempt(recording.attempt("interrupted", self._bus.now_s(), reason))
            yield DwellInterrupted(place, position, number, recording.samples, reason)
            if self._stopping.is_set():
                break
            if recording.timed_out:
                restart = MOST_RESTARTS
            if restart == MOST_RESTARTS:
                message = f"{position}: {reason}; no dwell was possible"
                if self._auto:
                    raise SessionError(f"{message}; find what moves the part and resume the session")
                yield Problem("stillness", message, place)
                break
        self._close_stream()

    def _new_recording(self, place: int) -> Recording:
        return Recording(
            place,
            self._plan.positions[place],
            utc_now(),
            self._bus.now_s(),
            self._settings.dwell_s,
            self._settle_s,
            self._period_s,
        )

    def _record(self, recording: Recording) -> Generator[Event, None, str | None]:
        """Wait for stillness, then record; return None when complete, else what interrupted it."""
        watch = StillnessWatch(self._limits)
        look: Look | None = None
        for block in self._scans():
            recording.add(block)
            for look in watch.feed(block.accel_mg):
                if look.state == "stuck":
                    raise SessionError(look.why)
                if look.state == "moving":
                    if recording.begun:
                        return look.why
                    recording.moving(look.why)
                else:
                    recording.still(look.end)
            if recording.try_begin():
                watch.anchor(recording.begin)
            if self._stopping.is_set():
                return "stopped by the operator"
            if look is None:
                continue
            if not recording.begun:
                state = "settling" if recording.is_still else "moving"
                yield Watching(state, _vector(look.mean_mg), _vector(look.spread_mg))  # type: ignore
                if recording.waited_s > self._settings.still_timeout_s + 4 * self._window * self._period_s:
                    recording.timed_out = True
                    return f"not still within {recording.waited_s:.0f} s ({recording.why_moving})"
            elif recording.complete(look.end):
                return None
            else:
                yield DwellProgress(
                    recording.place,
                    recording.elapsed_s,
                    self._settings.dwell_s,
                    recording.samples,
                    recording.lost,
                    _vector(look.mean_mg),
                )
        return "the stream of scans ended"

    def _complete(self, recording: Recording) -> Iterator[Event]:
        self._close_stream()
        status = self._sensor.status()
        # The same silence before a dwell's end and before a resumed session goes on.
        self._bus.sleep_s(CHECKPOINT_S)
        attempt = recording.attempt("complete", self._bus.now_s(), status=status.word)
        number = self._archive.add_attempt(attempt)
        place, scans = recording.place, recording.scans()
        self._done[place] = number
        self._skipped.discard(place)
        self._last_place = place
        yield DwellDone(
            place,
            recording.position,
            number,
            len(scans),
            recording.lost,
            _vector(scans.accel_mg.mean(axis=0)),
        )
        for problem in self._problems(place, scans, status.messages):
            self._archive.add_record("problem", problem.as_dict(), self._bus.now_s())
            yield problem

    def _problems(self, place: int, scans: ScanBlock, status: tuple[str, ...]) -> list[Problem]:
        problems = [Problem("status", f"STATUS: {message}", place) for message in status]
        if "SUPPLY_OUT" in scans.registers:
            supply = scans.supply_v
            low, high = SUPPLY_LIMITS_V
            if supply.min() < low or supply.max() > high:
                problems.append(
                    Problem(
                        "supply",
                        f"the supply was between {supply.min():.3f} and {supply.max():.3f} V;"
                        f" the part needs {low} to {high} V",
                        place,
                    )
                )
        if scans.lost:
            share = 100.0 * scans.lost / (len(scans) + scans.lost)
            problems.append(
                Problem("lost", f"{scans.lost} scans ({share:.2g} %) were lost on the bus", place)
            )
        return problems

    # -- sensor and world -------------------------------------------------------------------------

    def _scans(self) -> ScanStream:
        """The running stream of scans, opened when first needed."""
        if self._stream is None:
            self._stream = self._sensor.stream(self._settings.registers, block_scans=self._block_scans)
        return self._stream

    def _close_stream(self) -> None:
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def _clock_offset(self, bus_s: float) -> float:
        runs = self._archive.runs()
        if not runs:
            return -bus_s
        if self._world is not None:
            return float(runs[0]["clock_offset_s"])
        # Clocks of two runs have nothing in common but the wall clock, which may have been set back.
        since = datetime.now(UTC) - datetime.fromisoformat(self._header.created_utc)
        ends = [attempt.ended_bus_s + attempt.offset_s for attempt in self._archive.attempts()]
        return max([since.total_seconds(), *ends]) - bus_s

    def _bring_world_to(self, attempt: int) -> None:
        """Let a new simulated world live through what the archived one did, up to an attempt's end."""
        end = next(a.ended_bus_s for a in self._archive.attempts() if a.number == attempt)
        for move in self._archive.moves_before(attempt):
            self._wait_until(move.bus_s)
            if self._stage is not None:
                self._stage.move_to(move.angle_deg, move.approach)
        self._wait_until(end)

    def _wait_until(self, bus_s: float) -> None:
        if bus_s - self._bus.now_s() < -1e-6:
            raise SessionError(
                f"{self._archive.path}: the simulated sensor starts later than it did when the session was"
                " recorded (another version of the program?); begin a new session"
            )
        # The last step is short, hence exact in float64: the clock shows the archived time to the bit.
        while (ahead := bus_s - self._bus.now_s()) > 0:
            self._bus.sleep_s(ahead if ahead < 1e-3 else ahead - 5e-4)

    def _require_same_sensor(self) -> None:
        path, header = self._archive.path, self._header
        if self._sensor.variant.name != header.variant:
            raise SessionError(
                f"{path}: began with an {header.variant.upper()}, this is an"
                f" {self._sensor.variant.name.upper()}"
            )
        if header.simulated != (self._world is not None):
            kind = "simulated" if header.simulated else "real"
            raise SessionError(f"{path}: began with a {kind} sensor ({header.url}), not {self._bus.url}")
        if header.simulated and header.url != self._bus.url:
            raise SessionError(f"{path}: began with {header.url}, not {self._bus.url}; open that one")

    def _require_same_settings(self, now: dict[str, int]) -> None:
        before = self._archive.last("registers-configured")
        if before is None:
            return
        names = [row.name for row in REGISTERS if row.readable and row.writable]
        for name in names:
            if name not in _NOT_COMPARED and before.get(name) != now[name]:
                raise SessionError(
                    f"{self._archive.path}: {name} was {before.get(name)} and is {now[name]}: the sensor is"
                    " another one or was changed; set it back or begin a new session"
                )

    def _record_truth(self) -> None:
        if self._world is not None:
            self._archive.add_record("truth", self._world.truth(), self._bus.now_s())

    def _finish(self) -> Finished:
        complete = self._next_place() is None
        now = self._bus.now_s()
        self._archive.add_record("registers-after", self._sensor.read_all(), now)
        self._record_truth()
        self._archive.add_record("finished", {"complete": complete}, now)
        return Finished(
            str(self._archive.path), complete, len(self._done), len(self._skipped), len(self._plan)
        )


def _require_auto(sensor: Adis16354, plan: Plan) -> None:
    if getattr(sensor.bus, "stage", None) is None:
        raise UsageError(
            f"{sensor.bus.url}: auto needs a stage that the program can move, such as sim: has;"
            " run it without auto"
        )
    if any(position.angle_deg is None for position in plan.positions):
        raise UsageError(f"plan '{plan.name}' needs an operator: its attitudes have no angle")


class _IdleWindow:
    """The newest samples while a question stands."""

    def __init__(self, stream: ScanStream, window: int) -> None:
        self._stream = stream
        self._window = window
        self._kept = np.empty((0, 3))

    def look(self) -> Watching:
        for block in self._stream:
            self._kept = np.concatenate([self._kept, block.accel_mg])[-self._window :]
            if len(self._kept) > 1:
                break
        spread = self._kept.std(axis=0, ddof=1) if len(self._kept) > 1 else np.zeros(3)
        mean = self._kept.mean(axis=0) if len(self._kept) else np.zeros(3)
        return Watching("idle", _vector(mean), _vector(spread))


def _vector(values: Any) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


__all__ = ["Answer", "Position", "SessionRunner", "Stage", "World"]
