"""The sensor of a session with its stage and, where it is simulated, its world."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Protocol

from adis_gonio.bus import Capability
from adis_gonio.errors import SessionError, UsageError
from adis_gonio.sensor.driver import Adis16354
from adis_gonio.sensor.registers import REGISTERS
from adis_gonio.sensor.scanning import ScanStream
from adis_gonio.session.plans import Plan, Position
from adis_gonio.session.rows import Move
from adis_gonio.session.settings import Settings
from adis_gonio.session.view import ArchiveView
from adis_gonio.session.watch import window_samples

CHECKPOINT_S = 1e-3
"""Silence at the end of a dwell, so that no frame's timing reaches over the point of resuming."""

_SETTINGS = tuple(
    row.name
    for row in REGISTERS
    if row.readable and row.writable and row.name not in ("GPIO_CTRL", "SLP_CNT")
)
"""Control registers that hold settings; the two left out hold levels of lines and a count that runs."""


class Stage(Protocol):
    """A stage that the program can move; a bus may bring one as its attribute `stage`."""

    def move_to(self, angle_deg: float, approach: int = 1) -> object:
        """Go to an angle, in the direction `approach` (+1 or -1) at the end."""


class World(Protocol):
    """The simulated surroundings of a sensor; a simulated bus brings one as its attribute `world`."""

    def truth(self) -> dict[str, float]:
        """What the simulation hides."""


class Bench:
    """What a session measures with.

    Parameters
    ----------
    sensor : Adis16354
        Open.
    settings : Settings
        How to measure.

    Attributes
    ----------
    configuration : Configuration
        How the sensor measures; known after `configure`, and so are the three that follow from it:
    window : int
        Samples of a window of the watch.
    settle_s : float
        Wait between stillness and a dwell; never less than the filter needs.
    """

    def __init__(self, sensor: Adis16354, settings: Settings) -> None:
        self.sensor = sensor
        self.settings = settings
        self.stage: Stage | None = getattr(sensor.bus, "stage", None)
        self.world: World | None = getattr(sensor.bus, "world", None)
        self._stream: ScanStream | None = None

    @property
    def simulated(self) -> bool:
        """True where the truth is known."""
        return self.world is not None

    @property
    def now_s(self) -> float:
        """Clock of the bus."""
        return self.sensor.bus.now_s()

    def require_auto(self, plan: Plan) -> None:
        """Raise `UsageError` where a plan cannot be run without an operator."""
        if self.stage is None:
            raise UsageError(
                f"{self.sensor.bus.url}: auto needs a stage that the program can move, such as sim: has;"
                " run it without auto"
            )
        if any(position.angle_deg is None for position in plan.positions):
            raise UsageError(f"plan '{plan.name}' needs an operator: its attitudes have no angle")

    def require_same_sensor(self, archive: ArchiveView) -> None:
        """Raise `SessionError` where a session was begun with another sensor."""
        path, header, url = archive.path, archive.header(), self.sensor.bus.url
        if self.sensor.variant.name != header.variant:
            raise SessionError(
                f"{path}: began with an {header.variant.upper()}, this is an"
                f" {self.sensor.variant.name.upper()}"
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
        before = self.sensor.read_all()
        streams = Capability.STREAM in self.sensor.bus.capabilities
        self.configuration = self.sensor.configure(
            smpl_prd=settings.smpl_prd,
            filter_m=settings.filter_m,
            gyro_range_dps=settings.gyro_range_dps,
            data_ready=streams if settings.data_ready is None else settings.data_ready,
        )
        self.period_s = self.configuration.sample_period_s
        self.settle_s = max(settings.settle_s, self.configuration.settling_s)
        self.window = window_samples(self.configuration)
        return before, self.sensor.read_all()

    def require_same_settings(self, archive: ArchiveView, now: dict[str, int]) -> None:
        """Raise `SessionError` where a control register is not what it was when the session began."""
        before = archive.last("registers-configured")
        if before is None:
            return
        for name in _SETTINGS:
            if before.get(name) != now[name]:
                raise SessionError(
                    f"{archive.path}: {name} was {before.get(name)} and is {now[name]}: another sensor, or"
                    " it was changed; set it back or begin a new session"
                )

    @staticmethod
    def changes(before: dict[str, int], after: dict[str, int]) -> dict[str, tuple[int, int]]:
        """Settings that differ: number before and after."""
        return {name: (before[name], after[name]) for name in _SETTINGS if before[name] != after[name]}

    # -- scans and moves --------------------------------------------------------------------------

    def scans(self) -> ScanStream:
        """The running stream of scans, opened when first needed; two blocks fill a window."""
        if self._stream is None:
            block_scans = max(8, self.window // 2)
            self._stream = self.sensor.stream(self.settings.registers, block_scans=block_scans)
        return self._stream

    def close_stream(self) -> None:
        """End the stream, so that registers can be read; may be called twice."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None

    def move_to(self, position: Position) -> Move | None:
        """Let the stage go to a position; None where there is nothing to move or no angle."""
        if self.stage is None or position.angle_deg is None:
            return None
        move = Move(self.now_s, position.angle_deg, position.approach)
        self.stage.move_to(move.angle_deg, move.approach)
        return move

    # -- time -------------------------------------------------------------------------------------

    def clock_offset(self, archive: ArchiveView, bus_s: float) -> float:
        """What makes times on this bus's clock seconds since the session began."""
        runs = archive.runs()
        if not runs:
            return -bus_s
        if self.simulated:
            return float(runs[0]["clock_offset_s"])
        # Clocks of two runs have nothing in common but the wall clock, which may have been set back.
        since = datetime.now(UTC) - datetime.fromisoformat(archive.header().created_utc)
        ends = [attempt.ended_bus_s + attempt.offset_s for attempt in archive.attempts()]
        return max([since.total_seconds(), *ends]) - bus_s

    def bring_world_to(self, archive: ArchiveView, attempt: int) -> None:
        """Let a new simulated world live through what the archived one did, up to an attempt's end."""
        end_s = next(a.ended_bus_s for a in archive.attempts() if a.number == attempt)
        for move in archive.moves_before(attempt):
            self._wait_until(move.bus_s)
            if self.stage is not None:
                self.stage.move_to(move.angle_deg, move.approach)
        self._wait_until(end_s)

    def _wait_until(self, bus_s: float) -> None:
        bus = self.sensor.bus
        if bus_s - bus.now_s() < -1e-6:
            raise SessionError(
                "the simulated sensor is later than it was when the session was recorded (by another"
                " version of the program?); begin a new session"
            )
        # The last step is short, hence exact in float64: the clock shows the archived time to the bit.
        while (ahead := bus_s - bus.now_s()) > 0:
            bus.sleep_s(ahead if ahead < CHECKPOINT_S else ahead - CHECKPOINT_S / 2)

    def truth(self) -> dict[str, Any] | None:
        """What the simulation hides; None for a real sensor."""
        return None if self.world is None else dict(self.world.truth())
