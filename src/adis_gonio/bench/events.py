"""What a running session tells its front end: typed events, in order; see `runner`.

Places are positions of the plan, counted from 0; accelerations are in mg, x, y, z.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from adis_gonio.record.plans import Blindness, Plan, Position

Vector = tuple[float, float, float]

GuardKind = Literal[
    "not_moved",
    "reversed",
    "wrong_axis",
    "wrong_angle",
    "upside_down",
    "shock",
    "drift",
    "stuck",
    "supply",
    "temperature",
    "over_range",
]
"""What a guard can stop at."""


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
    """The part has to be brought to a position. Answers: confirm, skip, repeat, undo, stop.

    Attributes
    ----------
    number, total : int
        Which one of how many, from 1.
    can_repeat : bool
        True where there is a dwell before it that can be repeated.
    time_left_s : float
        Estimate of how long the rest takes, from how long the dwells so far took.
    can_undo : bool
        True where there is a dwell that can be withdrawn.
    """

    place: int
    position: Position
    number: int
    total: int
    can_repeat: bool
    time_left_s: float = 0.0
    can_undo: bool = False


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
    angle_deg : float or None
        Live angle by gravity, as the stage counts; None with free attitudes.
    target_deg : float or None
        Angle that was asked for; None where none is.
    limit_mg : Vector or None
        What `spread_mg` has to stay below; None until the noise is known.
    waits_for : str
        What is waited for, in words; empty where nothing is.
    temperature_c : float or None
        Of the newest scan; None where it is not in the scan.
    lost : int
        Scans lost since the session was opened.
    tolerance_deg : float or None
        Distance from `target_deg` within which a guard does not question `angle_deg`; None before the
        first dwell.
    """

    state: Literal["idle", "measuring", "moving", "settling"]
    accel_mg: Vector
    spread_mg: Vector
    angle_deg: float | None = None
    target_deg: float | None = None
    limit_mg: Vector | None = None
    waits_for: str = ""
    temperature_c: float | None = None
    lost: int = 0
    tolerance_deg: float | None = None


@dataclass(frozen=True)
class DwellProgress(Event):
    """A dwell is under way.

    Attributes
    ----------
    lost : int
        Scans lost within this dwell.
    accel_mg : Vector
        Mean of the newest window.
    spread_mg, angle_deg, target_deg, limit_mg, waits_for, temperature_c
        As in `Watching`.
    """

    place: int
    elapsed_s: float
    length_s: float
    samples: int
    lost: int
    accel_mg: Vector
    spread_mg: Vector | None = None
    angle_deg: float | None = None
    target_deg: float | None = None
    limit_mg: Vector | None = None
    waits_for: str = ""
    temperature_c: float | None = None


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
    kind : {"status", "alarm", "supply", "lost", "dropped", "stillness"} or GuardKind
        With a kind of a guard: what a guard would have asked, where nobody is there to answer.
    """

    kind: Literal["status", "alarm", "supply", "lost", "dropped", "stillness"] | GuardKind
    message: str
    place: int


@dataclass(frozen=True)
class GuardRaised(Event):
    """Something cannot be right, or not be wanted. Answers: those of `answers`, and stop.

    `retake` asks for the position again, `keep` goes on with it as it is, `reverse` takes the whole
    session as turned the other way.

    Attributes
    ----------
    values : dict of str to float
        The numbers behind the message, by names that end in their unit.
    answers : tuple of str
        Names of `Answer`; `runner.answer(name)` gives one.
    default : str
        The one of them that is safe.
    """

    kind: GuardKind
    message: str
    place: int
    position: Position
    values: dict[str, float]
    answers: tuple[str, ...]
    default: str


@dataclass(frozen=True)
class TurnMeasured(Event):
    """How far the part was turned since the position before.

    Attributes
    ----------
    asked_deg : float or None
        Turn that the plan asks for, as the stage counts; None with free attitudes.
    gyro_deg, gyro_u_deg : float or None
        Integral of the gyro about the axis of rotation, and its standard uncertainty; None where the turn
        was not watched (the program moved the stage, or there is no gyro).
    gravity_deg : float or None
        The same by gravity, within ±180°; with free attitudes the angle between the two directions.
    """

    place: int
    asked_deg: float | None
    gyro_deg: float | None
    gyro_u_deg: float | None
    gravity_deg: float | None


@dataclass(frozen=True)
class TurnProgress(Event):
    """A free turn is being recorded.

    Attributes
    ----------
    state : {"rest", "turn", "after"}
        Rest before the turns, the turns, and what comes once all were made: rest.
    turned_deg, rate_dps : float
        By gravity, counter-clockwise positive: since the beginning, and over the last seconds.
    turn, turns : int
        Which full turn is under way, from 1, of how many.
    rest_s : float
        How long it has rested by now, where whole turns are followed by the gyros.
    peak_dps : float
        Largest rate of any gyro so far, where they are followed.
    """

    state: Literal["rest", "turn", "after"]
    elapsed_s: float
    length_s: float
    samples: int
    lost: int
    turned_deg: float
    rate_dps: float
    turn: int = 1
    turns: int = 1
    rest_s: float = 0.0
    peak_dps: float = 0.0


@dataclass(frozen=True)
class TurnDone(Event):
    """A free turn is complete and on the disk.

    Attributes
    ----------
    turned_deg : float
        From where it began to where it ended.
    turns : int
        Full turns, those back included.
    travelled_deg : float
        All the way, there and back.
    """

    attempt: int
    turned_deg: float
    length_s: float
    samples: int
    lost: int
    turns: int
    travelled_deg: float


@dataclass(frozen=True)
class Running(Event):
    """What the dwells so far give.

    Attributes
    ----------
    parameters : dict
        As in the JSON form of a fit: name to value, u and unit.
    """

    parameters: dict[str, dict[str, Any]]
    method: str
    dwells: int


@dataclass(frozen=True)
class Paused(Event):
    """The stream is closed and nothing is judged until the operator goes on."""

    place: int | None


@dataclass(frozen=True)
class Unpaused(Event):
    """The session goes on: the question is put again."""

    place: int | None


@dataclass(frozen=True)
class Noted(Event):
    """A remark of the operator is in the archive."""

    text: str


@dataclass(frozen=True)
class Withdrawn(Event):
    """A dwell does not count any more; it stays in the archive, marked."""

    place: int
    position: Position
    attempt: int


@dataclass(frozen=True)
class RepetitionOffered(Event):
    """The plan is done, but a fault or alarm stood in some dwells. Answers: accept, decline, repeat, stop.

    Accepted, their positions are asked for one by one and measured again; declined, they are kept as they
    are, and not asked about again.

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
