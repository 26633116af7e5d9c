"""The sensor of a session with its stage and, where it is simulated, its world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Protocol, runtime_checkable

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import ChipError, SessionError, UsageError
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.record.archive import ArchiveView
from adis_gonio.record.archive_tables import JsonDict, Move, Record, StoredAttempt
from adis_gonio.record.plans import Plan, Position
from adis_gonio.record.settings import LEAST_SAMPLES, Settings
from adis_gonio.record.source import Measuring, SampleSource, SampleStream, as_source
from adis_gonio.record.stillness import window_samples

CHECKPOINT_S = 1e-3
"""Silence that ends in a checkpoint, so that no frame's timing reaches over the point of resuming."""


class MovableStage(Protocol):
    """A stage that the program can move; a bus may bring one as its attribute `stage`."""

    def move_to(self, angle_deg: float, approach: int = 1) -> object:
        """Go to an angle, in the direction `approach` (+1 or -1) at the end."""


@runtime_checkable
class SpatialStage(MovableStage, Protocol):
    """A stage that can also turn the part to any attitude in space."""

    def orient(self, vector: Sequence[float]) -> object:
        """Go where an ideal sensor reads along a vector (3,)."""


class SimulatedWorld(Protocol):
    """The simulated surroundings of a sensor; a simulated bus brings one as its attribute `world`."""

    def truth(self, time_s: Floats | None = None) -> dict[str, float]:
        """What the simulation hides, as it was in the mean of some times where these are given."""


@runtime_checkable
class WatchedStage(SpatialStage, Protocol):
    """A stage whose moves can be looked on at: the clock goes on by what is scanned meanwhile."""

    def begin_move(self, angle_deg: float, approach: int = 0) -> float:
        """Begin to go to an angle; return the time at which it ends."""

    def begin_orient(self, vector: Sequence[float]) -> float:
        """Begin to go where an ideal sensor reads along a vector (3,)."""


@runtime_checkable
class TurnTable(MovableStage, Protocol):
    """A stage that can also turn the part about the vertical, while others look on."""

    def begin_turn(self, angle_deg: float) -> float:
        """Begin to turn, counter-clockwise positive; return the time at which it ends."""


@runtime_checkable
class ControlledWorld(SimulatedWorld, Protocol):
    """Surroundings whose temperature and supply a program can set."""

    def bring_to(
        self, time_s: float, temperature_c: float | None = None, supply_v: float | None = None
    ) -> None:
        """Heat or cool the part, or set the supply, from a time on."""


class SessionBench:
    """What a session measures with.

    Parameters
    ----------
    sensor : Adis16354 or SampleSource
        Open.
    settings : Settings
        How to measure.

    Attributes
    ----------
    configuration : Measuring
        How the sensor measures; known after `configure`, and so are the three that follow from it:
    window : int
        Samples of a window of the watch.
    settle_s : float
        Wait between stillness and a dwell; never less than the filter needs.
    """

    def __init__(self, sensor: Adis16354 | SampleSource, settings: Settings) -> None:
        self.source = source = as_source(sensor)
        self.settings = settings
        self.stage: MovableStage | None = source.stage
        self.world: SimulatedWorld | None = source.world
        self._stream: SampleStream | None = None
        self._moves_until_s = -math.inf
        self._scanning: JsonDict = {}
        self._held: dict[str, int] = {}

    @property
    def simulated(self) -> bool:
        """True where the truth is known."""
        return self.world is not None

    @property
    def virtual_time(self) -> bool:
        """True where time runs only as far as something is asked of the sensor: a simulated one."""
        sensor = getattr(self.source, "sensor", None)
        return bool(getattr(getattr(sensor, "bus", None), "virtual_time", False))

    @property
    def now_s(self) -> float:
        """Clock of the source."""
        return self.source.now_s()

    def require_auto(self, plan: Plan) -> None:
        """Raise `UsageError` where a plan cannot be run without an operator."""
        if self.stage is None:
            raise UsageError(
                f"{self.source.url}: auto needs a stage that the program can move, such as sim: has;"
                " run it without auto"
            )
        free = any(position.angle_deg is None for position in plan.positions)
        if free and self._spatial is None:
            raise UsageError(f"plan '{plan.name}' needs an operator: this stage turns in a plane only")
        whole = any(position.turned_deg is not None for position in plan.positions)
        if whole and not isinstance(self.stage, TurnTable):
            raise UsageError(f"plan '{plan.name}' needs an operator: this stage does not turn a table")

    def can_reach(self, position: Position) -> bool:
        """True where the program alone can bring the part to a position and its conditions."""
        if self.wants_conditions(position) and not self.sets_conditions:
            return False
        return self.stage is not None if position.angle_deg is not None else self._spatial is not None

    @property
    def sets_conditions(self) -> bool:
        """True where the program can set temperature and supply."""
        return isinstance(self.world, ControlledWorld)

    @staticmethod
    def wants_conditions(position: Position) -> bool:
        """True where a position comes with a temperature or a supply."""
        return position.temperature_c is not None or position.supply_v is not None

    def set_conditions(self, temperature_c: float | None, supply_v: float | None) -> None:
        """Set temperature and supply, from now on."""
        if isinstance(self.world, ControlledWorld):
            self.world.bring_to(self.now_s, temperature_c, supply_v)

    def require_same_sensor(self, archive: ArchiveView) -> None:
        """Raise `SessionError` where a session was begun with another sensor."""
        path, header, url = archive.path, archive.header(), self.source.url
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
        """Set the sensor up as the settings say; return all registers before and after."""
        settings = self.settings
        before = self.source.registers()
        self.configuration: Measuring = self.source.configure(settings)
        self.period_s = self.configuration.sample_period_s
        self.settle_s = max(settings.settle_s, self.configuration.settling_s)
        self.window = window_samples(self.configuration)
        if settings.dwell_s < LEAST_SAMPLES * self.period_s:
            raise UsageError(
                f"dwell_s is {settings.dwell_s:g}: at {1 / self.period_s:.4g} samples a second"
                f" take {LEAST_SAMPLES * self.period_s:.3g} s or more"
            )
        after = self.source.registers()
        self.source.mark_restart()
        self._held = self.source.settings_held()
        return before, after

    def settings_lost(self) -> str:
        """Say which settings are no longer as configured, and what to do; empty if all of them are.

        A difference is read again and checked, because the bus may have falsified the first replies.
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

    @property
    def why_polled(self) -> str:
        """Why scans are polled, in words; empty where they are not."""
        return self.source.why_polled

    @property
    def scanning(self) -> JsonDict:
        """How scans are got: `how` in words, and a `caveat` where the rows need one; once one was got."""
        return dict(self._scanning)

    def close(self) -> None:
        """End the stream and set back what was borrowed for the session; may be called twice."""
        try:
            self.close_stream()
        finally:
            self.source.give_back()

    def require_same_settings(self, archive: ArchiveView, now: dict[str, int]) -> None:
        """Raise `SessionError` where a control register is not what it was when the session began."""
        registers, measuring = archive.last("registers-configured"), archive.last("configuration")
        if registers is None:
            return
        before = self.source.identity(registers, measuring)
        for name, value in self.source.identity(now, self.configuration.as_dict()).items():
            if before.get(name) != value:
                raise SessionError(
                    f"{archive.path}: {name} was {before.get(name)} and is {value}: another sensor, or"
                    " it was changed; set it back or begin a new session"
                )

    def changes(self, before: dict[str, int], after: dict[str, int]) -> dict[str, tuple[int, int]]:
        """Settings that differ: number before and after."""
        names = self.source.identity(after, {})
        return {name: (before[name], after[name]) for name in names if before[name] != after[name]}

    # -- scans and moves --------------------------------------------------------------------------

    def scans(self) -> SampleStream:
        """The running stream of scans, opened when first needed; two blocks fill a window."""
        if self._stream is None:
            block_scans = max(8, self.window // 2)
            self._stream = self.source.samples(self.settings, block_scans)
        return self._stream

    def close_stream(self) -> None:
        """End the stream, so that registers can be read; may be called twice."""
        if self._stream is not None:
            stream, self._stream = self._stream, None
            why = f"{self.why_polled}; " if self.why_polled else ""
            caveat = stream.caveat or (self._scanning or {}).get("caveat", "")
            self._scanning = {"how": f"{why}{stream.how}", "caveat": caveat}
            stream.close()

    def move_to(self, position: Position) -> Move | None:
        """Let the stage go to a position; None where nothing can be moved there."""
        # A move that was broken off while it was watched goes on, and a stage makes one at a time.
        if self._moves_until_s > self.now_s:
            self.source.sleep_s(self._moves_until_s - self.now_s)
        move = Move(self.now_s, position.angle_deg, position.approach, position.direction)
        return move if self._carry_out(move) else None

    def begin_turn(self, turned_deg: float) -> Move | None:
        """Let the stage begin to turn about the vertical; None where nothing can be turned."""
        move = Move(self.now_s, None, 0, turned_deg=turned_deg)
        return move if self._carry_out(move) else None

    def _carry_out(self, move: Move, *, watched: bool = True) -> bool:
        if move.turned_deg is not None:
            if not isinstance(self.stage, TurnTable):
                return False
            self.stage.begin_turn(move.turned_deg)
            return True
        if watched and self.settings.turns and isinstance(self.stage, WatchedStage):
            return self._begin(self.stage, move)
        if self.stage is not None and move.angle_deg is not None:
            self.stage.move_to(move.angle_deg, move.approach)
            return True
        if self._spatial is not None and move.direction is not None:
            self._spatial.orient(move.direction)
            return True
        return False

    def _begin(self, stage: WatchedStage, move: Move) -> bool:
        """Begin a move that is scanned."""
        if move.angle_deg is not None:
            self._moves_until_s = stage.begin_move(move.angle_deg, move.approach)
        elif move.direction is not None:
            self._moves_until_s = stage.begin_orient(move.direction)
        return move.angle_deg is not None or move.direction is not None

    @property
    def _spatial(self) -> SpatialStage | None:
        return self.stage if isinstance(self.stage, SpatialStage) else None

    # -- time -------------------------------------------------------------------------------------

    def clock_offset(self, archive: ArchiveView, bus_s: float) -> float:
        """What makes times on this bus's clock seconds since the session began."""
        runs = archive.runs()
        if not runs:
            return -bus_s
        if self.virtual_time:
            return float(runs[0]["clock_offset_s"])
        # Clocks of two runs have nothing in common but the wall clock, which may have been set back.
        since = datetime.now(UTC) - datetime.fromisoformat(archive.header().created_utc)
        ends = [attempt.ended_bus_s + attempt.offset_s for attempt in archive.attempts()]
        return max([since.total_seconds(), *ends]) - bus_s

    def checkpoint(self) -> None:
        """Make the present a point from which a simulated session can go on: silence before it."""
        self.source.sleep_s(CHECKPOINT_S)

    def bring_world_to(self, archive: ArchiveView, attempt: int) -> None:
        """Let a new simulated world live through what the archived one did.

        Parameters
        ----------
        attempt : int
            Up to the end of this attempt; 0 up to the end of the measurement of the noise.
        """
        ends = {a.number: a.ended_bus_s for a in archive.attempts()}
        end_s = ends[attempt] if attempt else archive.records("noise")[-1].bus_s
        # What is set at the time of a move was set before it: a stable sort keeps it so.
        happened: list[Move | Record] = [*archive.conditions_before(attempt)]
        happened += archive.moves_before(attempt)
        for event in sorted(happened, key=lambda event: event.bus_s):
            self._wait_until(event.bus_s)
            if isinstance(event, Move):
                self._carry_out(event)
            else:
                self.set_conditions(event.value["temperature_c"], event.value["supply_v"])
        if attempt:
            # At its end the dwell's STATUS was read, which clears it: a bit that is left would show as EA.
            self._wait_until(end_s - CHECKPOINT_S / 2)
            self.source.status()
        self._wait_until(end_s)

    def take_up(self, archive: ArchiveView, attempt: int) -> None:
        """Let a simulated part that follows the wall clock lie where an attempt left it.

        Unlike `bring_world_to` this is another power-on at another time, as with a real bench.
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
        # The last step is short, hence exact in float64: the clock shows the archived time to the bit.
        while (ahead := bus_s - source.now_s()) > 0:
            source.sleep_s(ahead if ahead < CHECKPOINT_S else ahead - CHECKPOINT_S / 2)

    def truth(self, dwells: Sequence[StoredAttempt] = (), dwell_s: float = 0.0) -> dict[str, float] | None:
        """What the simulation hides, as it was in the last `dwell_s` of dwells; None for a real sensor."""
        if self.world is None:
            return None
        spans = [np.linspace(a.ended_bus_s - dwell_s, a.ended_bus_s, 64) for a in dwells]
        times = np.concatenate(spans) if spans else None
        return dict(self.world.truth(times))
