"""The sensor of a session, its stage and, if it is simulated, its world."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from datetime import datetime
from typing import Any, Protocol

import numpy as np

from adis_gonio.base.errors import ChipError, SessionError, UsageError
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.archive_tables import Attempt, JsonDict, Move, utc_now
from adis_gonio.record.plans import Plan, Position
from adis_gonio.record.source import (
    ChipSource,
    Measuring,
    SampleSource,
    SampleStream,
    Settings,
    require_samples,
)
from adis_gonio.record.stillness import window_samples
from adis_gonio.record.write_journal import KIND

CHECKPOINT_S = 1e-3
"""Time in s without frames before a checkpoint, so that no frame spans the point of resuming."""


class MovableStage(Protocol):
    """A stage that the program can move; a bus may bring one as its attribute `stage`.

    A stage has at least `move_to`; a plan that needs another method is refused without it. The methods that
    begin a move return at once, so that the program can record the move while the clock advances by reading
    scans; they return the time in s on the bus's clock at which the move ends.
    """

    def move_to(self, angle_deg: float, approach: int = 1) -> object:
        """Go to an angle in degrees, in the direction `approach` (+1 or −1) at the end."""

    def orient(self, vector: Sequence[float]) -> object:
        """Turn the sensor to the attitude in which an ideal sensor would read this vector (3,)."""

    def begin_move(self, angle_deg: float, approach: int = 0) -> float:
        """Start a move to an angle in degrees; with `approach` 0 the direct way."""

    def begin_orient(self, vector: Sequence[float]) -> float:
        """Start a move to the attitude in which an ideal sensor reads this vector (3,)."""

    def begin_turn(self, angle_deg: float) -> float:
        """Start a turn about the vertical in degrees, counter-clockwise positive."""

    def turn_freely(self, turns: int = 1) -> float:
        """Start full turns in the plane, as slowly as a hand would."""


class SessionBench:
    """The sensor, the stage and the simulated world of a session, with their configuration.

    Parameters
    ----------
    sensor : Adis16354 or SampleSource
        Open sensor.
    settings : Settings
        Settings of the session.

    Attributes
    ----------
    configuration : Measuring
        Configuration of the sensor. This and the following attributes are known after `configure`.
    window : int
        Number of samples in a window of the stillness watch.
    period_s : float
        Period of the samples in s.
    settle_s : float
        Wait between stillness and a dwell in s, at least the settling time of the filter.
    source : SampleSource
        The sensor as a source of samples.
    stage, world : object or None
        Stage that the program can move, and simulated world, whose method `truth(time_s)` returns the true
        parameters by name, averaged over the times in s; None without them.
    simulated : bool
        True if the sensor is simulated, so that its true parameters are known.
    virtual_time : bool
        True for a simulated sensor with a clock that advances only during calls.
    replayed : bool
        True if a recording answers instead of a sensor, with the answers of the operator.
    scanning : dict of str to str
        Method by which scans are read, as texts `how` and `caveat`; empty before the first scan.
    """

    def __init__(self, sensor: Adis16354 | SampleSource, settings: Settings) -> None:
        self.source = source = ChipSource(sensor) if isinstance(sensor, Adis16354) else sensor
        self.settings = settings
        self.stage: MovableStage | None = source.stage
        self.world: Any = source.world
        self.simulated = source.world is not None
        bus = getattr(getattr(source, "sensor", None), "bus", None)
        self.virtual_time = bool(getattr(bus, "virtual_time", False))
        self.replayed = bool(getattr(bus, "replayed", False))
        self._stream: SampleStream | None = None
        self._moves_until_s = -math.inf
        self.scanning: JsonDict = {}
        self._held: dict[str, int] = {}

    @property
    def now_s(self) -> float:
        """Present time in s on the clock of the sensor's bus."""
        return self.source.now_s()

    def utc(self) -> str:
        """Return the present UTC time as ISO 8601 text."""
        return self.source.witness("utc", utc_now)

    def moment(self) -> tuple[str, float]:
        """Return the present UTC time, and the time in s on the clock of the sensor's bus."""
        return self.utc(), self.now_s

    def require_auto(self, plan: Plan) -> None:
        """Raise `UsageError` if a plan cannot be run without an operator."""
        if self.stage is None:
            raise UsageError(
                f"{self.source.url}: auto needs a stage that the program can move, such as sim: has;"
                " run it without auto"
            )
        free = any(position.angle_deg is None for position in plan.positions)
        if free and not hasattr(self.stage, "orient"):
            raise UsageError(f"plan '{plan.name}' needs an operator: this stage turns in a plane only")
        whole = any(position.turned_deg is not None for position in plan.positions)
        if whole and not hasattr(self.stage, "begin_turn"):
            raise UsageError(f"plan '{plan.name}' needs an operator: this stage does not turn a table")

    def can_reach(self, position: Position) -> bool:
        """Return True if the program can set a position without an operator."""
        return hasattr(self.stage, "move_to" if position.angle_deg is not None else "orient")

    def require_same_sensor(self, archive: ArchiveView) -> None:
        """Raise `SessionError` if a session was begun with another sensor."""
        path, header, url = archive.path, archive.header, self.source.url
        if self.source.part.name != header.variant:
            raise SessionError(
                f"{path}: began with an {header.variant.upper()}, this is an"
                f" {self.source.part.name.upper()}"
            )
        if header.simulated != self.simulated:
            kind = "simulated" if header.simulated else "real"
            raise SessionError(f"{path}: began with a {kind} sensor ({header.url}), not with {url}")
        if header.simulated and header.url != url:
            raise SessionError(f"{path}: began with {header.url}, not with {url}; open that one")

    # -- configuration ----------------------------------------------------------------------------

    def configure(self) -> tuple[dict[str, int], dict[str, int]]:
        """Configure the sensor by the settings; return the contents of all registers before and after."""
        settings = self.settings
        before = self.source.registers()
        self.configuration: Measuring = self.source.configure(settings)
        self.period_s = self.configuration.sample_period_s
        self.settle_s = max(settings.settle_s, self.configuration.settling_s)
        self.window = window_samples(self.configuration)
        require_samples(settings.dwell_s, self.period_s)
        after = self.source.registers()
        self.source.mark_restart()
        self._held = self.source.settings_held()
        return before, after

    def settings_lost(self) -> str:
        """Return a message with a remedy if the sensor's settings changed during the session; else empty.

        After a difference the settings are read again and checked, since a bus error may have caused it.
        """
        if self.source.settings_held() == self._held:
            return ""
        kept = "this dwell is kept, but not used"
        try:
            now = self.source.settings_held(checked=True)
        except ChipError as error:
            return f"{error}; {kept}; mend the line, then go on with --resume"
        changed = [f"{name} {then} → {now[name]}" for name, then in self._held.items() if now[name] != then]
        if not changed:
            return ""
        return (
            f"the sensor's settings changed since the dwell before ({', '.join(changed)}): it restarted, or"
            f" somebody wrote to it; {kept}; set the registers back, then go on with --resume"
        )

    def close(self) -> None:
        """End the stream and undo temporary changes of the sensor; may be called twice."""
        try:
            self.close_stream()
        finally:
            self.source.give_back()

    def require_same_settings(self, archive: ArchiveView, now: dict[str, int]) -> None:
        """Raise `SessionError` if a control register has changed since the session began.

        `now` has the present contents of all registers by name.
        """
        registers, measuring = archive.last("registers-configured"), archive.last("configuration")
        if registers is None:
            return
        before = self.source.identity(registers, measuring)
        for name, value in self.source.identity(now, self.configuration.as_dict()).items():
            if before.get(name) != value:
                undo = shlex.join(["adis-gonio", "write", str(archive.path), self.source.url, "--undo"])
                written = f" by {undo}," if archive.last(KIND) else ""
                raise SessionError(
                    f"{archive.path}: {name} was {before.get(name)} and is {value}: another sensor, or"
                    f" it was changed; set it back{written} or begin a new session"
                )

    def changes(self, before: dict[str, int], after: dict[str, int]) -> dict[str, tuple[int, int]]:
        """Return the control registers with different numbers `before` and `after`, with both numbers.

        Both arguments have the numbers of all registers by name.
        """
        names = self.source.identity(after, {})
        return {name: (before[name], after[name]) for name in names if before[name] != after[name]}

    # -- scans and moves --------------------------------------------------------------------------

    def scans(self) -> SampleStream:
        """Return the running stream of scans, which is opened at the first call.

        A block has half as many scans as a window of the stillness watch, but at least 8.
        """
        if self._stream is None:
            block_scans = max(8, self.window // 2)
            self._stream = self.source.samples(self.settings, block_scans)
        return self._stream

    def close_stream(self) -> None:
        """End the stream, so that registers can be read; may be called twice."""
        if self._stream is not None:
            stream = self._stream
            why = f"{self.source.why_polled}; " if self.source.why_polled else ""
            caveat = stream.caveat or self.scanning.get("caveat", "")
            self.scanning = {"how": f"{why}{stream.how}", "caveat": caveat}
            stream.close()
            self._stream = None  # only now, so that an interrupted end is repeated

    def move_to(self, position: Position) -> Move | None:
        """Move the stage to a position and return the move; None if no stage can do it."""
        # A move that was interrupted while it was scanned continues; wait for its end.
        if self._moves_until_s > self.now_s:
            self.source.sleep_s(self._moves_until_s - self.now_s)
        move = Move(self.now_s, position.angle_deg, position.approach, position.direction)
        return move if self._carry_out(move) else None

    def begin_turn(self, turned_deg: float) -> Move | None:
        """Start a turn of the stage about the vertical and return the move; None if the stage cannot do it.

        `turned_deg` is the angle, positive counter-clockwise seen from above.
        """
        move = Move(self.now_s, None, 0, turned_deg=turned_deg)
        return move if self._carry_out(move) else None

    def _carry_out(self, move: Move, *, watched: bool = True) -> bool:
        """Move the stage and return True; return False if there is no stage that can do it.

        If turns are recorded and `watched` is True, a stage that can move while scans are read only begins
        the move.
        """
        # Methods of the stage that make a move, or only begin it, with their arguments.
        makes, begins = "orient", "begin_orient"
        to: tuple[Any, ...] = (move.direction,)
        if move.turned_deg is not None:
            makes, begins, to = "begin_turn", "", (move.turned_deg,)
        elif move.angle_deg is not None:
            makes, begins, to = "move_to", "begin_move", (move.angle_deg, move.approach)
        if to[0] is None or not hasattr(self.stage, makes):
            return False
        if watched and self.settings.turns and hasattr(self.stage, begins):
            self._moves_until_s = getattr(self.stage, begins)(*to)
        else:
            getattr(self.stage, makes)(*to)
        return True

    # -- time -------------------------------------------------------------------------------------

    def clock_offset(self, archive: ArchiveView, bus_s: float) -> float:
        """Return the seconds to add to the present bus clock to get the time since the session began.

        `bus_s` is the present time on the bus's clock.
        """
        runs = archive.runs()
        if not runs:
            return -bus_s
        if self.virtual_time:
            return float(runs[0]["clock_offset_s"])
        # The clocks of two runs are related only by the wall clock, which may have been set back.
        since = datetime.fromisoformat(self.utc()) - datetime.fromisoformat(archive.header.created_utc)
        ends = [attempt.ended_bus_s + attempt.offset_s for attempt in archive.attempts()]
        return max([since.total_seconds(), *ends]) - bus_s

    def checkpoint(self) -> None:
        """Wait `CHECKPOINT_S` without frames, so that a simulated session can be resumed from this point.

        No frame then spans the time at which the resumed simulation continues.
        """
        self.source.sleep_s(CHECKPOINT_S)

    def bring_world_to(self, archive: ArchiveView, attempt: int) -> None:
        """Repeat the archived moves in a new simulated world, at their archived times.

        Parameters
        ----------
        archive : ArchiveView
            The session to resume.
        attempt : int
            Number of the last attempt to repeat; 0 for the end of the noise measurement.
        """
        ends = {a.number: a.ended_bus_s for a in archive.attempts()}
        end_s = ends[attempt] if attempt else archive.records("noise")[0]["bus_s"]
        for move in archive.moves_before(attempt):
            self._wait_until(move.bus_s)
            self._carry_out(move)
        if attempt:
            # STATUS was read at the end of the dwell, which clears it; a remaining bit would show as EA.
            self._wait_until(end_s - CHECKPOINT_S / 2)
            self.source.status()
        self._wait_until(end_s)

    def restore_position(self, archive: ArchiveView, attempt: int) -> None:
        """Move a new simulated sensor to the position in which the archived attempt `attempt` left it.

        Only the last move is repeated, at the present time: the sensor was powered on again, as on a real
        bench. `bring_world_to` instead repeats all moves at their archived times.
        """
        for move in archive.moves_before(attempt)[-1:]:
            self._carry_out(move, watched=False)

    def _wait_until(self, bus_s: float) -> None:
        source = self.source
        if bus_s - source.now_s() < -1e-6:
            raise SessionError(
                "the simulated sensor is later than it was when the session was recorded (by another"
                " version of the program?); begin a new session"
            )
        # The last step is short and therefore exact in float64: the clock has exactly the archived time.
        while (ahead := bus_s - source.now_s()) > 0:
            source.sleep_s(ahead if ahead < CHECKPOINT_S else ahead - CHECKPOINT_S / 2)

    def truth(self, dwells: Sequence[Attempt] = (), dwell_s: float = 0.0) -> dict[str, float] | None:
        """Return the true parameters of a simulation, averaged over the last `dwell_s` of each dwell.

        Returns None for a real sensor.
        """
        if self.world is None:
            return None
        spans = [np.linspace(a.ended_bus_s - dwell_s, a.ended_bus_s, 64) for a in dwells]
        times = np.concatenate(spans) if spans else None
        return dict(self.world.truth(times))
