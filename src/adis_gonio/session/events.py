"""What a running session tells its front end: typed events, in order; see `runner`.

Places are positions of the plan, counted from 0; accelerations are in mg, x, y, z.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from adis_gonio.session.plans import Blindness, Plan, Position

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Event:
    """Base of all events."""

    def as_dict(self) -> dict[str, Any]:
        """JSON form, with the event's name under `event`."""
        return {"event": type(self).__name__} | asdict(self)


@dataclass(frozen=True)
class Started(Event):
    """The archive is open.

    Attributes
    ----------
    done : int
        Positions done before, in a session that is resumed.
    """

    path: str
    url: str
    variant: str
    plan: Plan
    resumed: bool
    done: int


@dataclass(frozen=True)
class Configured(Event):
    """The sensor measures as the session's settings say.

    Attributes
    ----------
    configuration : dict
        JSON form of the sensor's configuration.
    changed : dict of str to (int, int)
        Control registers that this changed: number before and after.
    why_polled : str
        Why scans are polled; empty where they start at the data-ready edges.
    """

    configuration: dict[str, Any]
    changed: dict[str, tuple[int, int]]
    why_polled: str


@dataclass(frozen=True)
class NoiseMeasured(Event):
    """The limits of stillness are known, from the sensor's own noise.

    Attributes
    ----------
    noise_mg : Vector
        Standard deviation of a sample at rest.
    still_below_mg, stuck_below_mg : Vector
        A window with more than the first moves, one with less than the second is stuck.
    window_s : float
        Length of a window.
    """

    noise_mg: Vector
    still_below_mg: Vector
    stuck_below_mg: Vector
    window_s: float


@dataclass(frozen=True)
class PositionAsked(Event):
    """The part has to be brought to a position. Answers: confirm, skip, repeat, stop.

    Attributes
    ----------
    number, total : int
        Which one of how many, from 1.
    can_repeat : bool
        True where there is a dwell before it that can be repeated.
    """

    place: int
    position: Position
    number: int
    total: int
    can_repeat: bool


@dataclass(frozen=True)
class StageMoved(Event):
    """The program has moved the stage."""

    position: Position


@dataclass(frozen=True)
class Watching(Event):
    """A look at the sensor outside a dwell.

    Attributes
    ----------
    state : str
        `idle` while a question stands, `measuring` the noise, `moving`, or `settling` once still.
    spread_mg : Vector
        Standard deviation within the newest window.
    """

    state: Literal["idle", "measuring", "moving", "settling"]
    accel_mg: Vector
    spread_mg: Vector


@dataclass(frozen=True)
class DwellProgress(Event):
    """A dwell is under way.

    Attributes
    ----------
    accel_mg : Vector
        Mean of the newest window.
    """

    place: int
    elapsed_s: float
    length_s: float
    samples: int
    lost: int
    accel_mg: Vector


@dataclass(frozen=True)
class DwellDone(Event):
    """A dwell is complete and on the disk.

    Attributes
    ----------
    attempt : int
        Number of the attempt in the archive.
    accel_mg : Vector
        Mean of the dwell.
    alarms : int
        Scans in which an error or alarm stood (EA).
    """

    place: int
    position: Position
    attempt: int
    samples: int
    lost: int
    accel_mg: Vector
    alarms: int


@dataclass(frozen=True)
class DwellInterrupted(Event):
    """A dwell was broken off; its samples are in the archive, marked as interrupted."""

    place: int
    position: Position
    attempt: int
    samples: int
    reason: str


@dataclass(frozen=True)
class Problem(Event):
    """Something that the operator should know; the session goes on.

    Attributes
    ----------
    kind : {"status", "alarm", "supply", "lost", "dropped", "stillness"}
    """

    kind: Literal["status", "alarm", "supply", "lost", "dropped", "stillness"]
    message: str
    place: int


@dataclass(frozen=True)
class RepetitionOffered(Event):
    """The plan is done, but a fault or alarm stood in some dwells. Answers: accept, decline, repeat, stop.

    Accepted, the dwells are made again; declined, they are kept as they are, and not asked about again.

    Attributes
    ----------
    places, positions : tuple
        Where.
    """

    places: tuple[int, ...]
    positions: tuple[Position, ...]


@dataclass(frozen=True)
class ExtensionOffered(Event):
    """The plan is done but does not answer everything. Answers: accept, decline, repeat, stop.

    Attributes
    ----------
    plan : Plan
        Plan to go on with; it begins with what is done.
    blindness : Blindness or None
        What two positions cannot see; None where an advisor asks for more.
    reasons : tuple of str
        Why an advisor asks, one sentence each.
    """

    plan: Plan
    blindness: Blindness | None
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class Advising(Event):
    """The advisor looks at what has been measured, which may take seconds; `Advised` follows.

    Attributes
    ----------
    dwells : int
        Complete dwells so far.
    """

    dwells: int


@dataclass(frozen=True)
class Advised(Event):
    """What the advisor says; where it asks for positions, `ExtensionOffered` follows.

    Attributes
    ----------
    round : int
        Which time, from 1.
    positions : int
        How many it asks for.
    ended : str
        Why it asks for none; empty where it does.
    summary : dict
        JSON form of where the session stands.
    """

    round: int
    positions: int
    ended: str
    summary: dict[str, Any]


@dataclass(frozen=True)
class Waiting(Event):
    """A wait that the plan asks for, before a dwell."""

    place: int
    elapsed_s: float
    length_s: float


@dataclass(frozen=True)
class Finished(Event):
    """The session ends, complete or not; the file is closed.

    Attributes
    ----------
    complete : bool
        False where positions are still to be done; the session can be resumed.
    """

    path: str
    complete: bool
    done: int
    skipped: int
    total: int
