"""Events that a running session yields to its front end, such as a question or the end of a dwell.

A `place` is the index of a position in the plan, from 0; accelerations are in mg, x, y, z.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal, dataclass_transform

from adis_gonio.record.plans import Plan, Position

Vector = tuple[float, float, float]
WatchState = Literal["idle", "measuring", "moving", "settling", "recording"]

GuardKind = Literal[
    "not_moved", "reversed", "wrong_axis", "wrong_angle", "upside_down", "shock",
    "drift", "stuck", "supply", "temperature", "over_range",
]  # fmt: skip
"""Kinds of probable error for which a guard stops a session."""


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """Base class of all events, by which a session informs its front end; each is a frozen dataclass."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    def as_dict(self) -> dict[str, Any]:
        """Return the event in JSON form, with its name as `event`."""
        return {"event": type(self).__name__} | asdict(self)


class Started(Event):
    """The session has begun: the archive is open.

    Attributes
    ----------
    path, url, variant : str
        Path of the archive, URL of the sensor, and its variant.
    plan : Plan
        Plan of the session, with its extensions.
    resumed : bool
        True if the session was begun by an earlier run.
    done : int
        Number of positions that were done before a resumed session.
    """

    path: str
    url: str
    variant: str
    plan: Plan
    resumed: bool
    done: int


class Configured(Event):
    """The sensor is configured by the session's settings.

    Attributes
    ----------
    configuration : dict
        JSON form of the sensor's configuration.
    changed : dict of str to (int, int)
        Control registers that this changed: numbers before and after, by name.
    why_polled : str
        Reason why scans are polled; empty if they start at the data-ready edges.
    """

    configuration: dict[str, Any]
    changed: dict[str, tuple[int, int]]
    why_polled: str


class NoiseMeasured(Event):
    """The noise of the sensor was measured, which sets the limits of stillness.

    Attributes
    ----------
    noise_mg : Vector
        Standard deviation of a sample at rest in mg, for each axis.
    """

    noise_mg: Vector


class PositionAsked(Event):
    """The sensor is to be put into a position. Answers: confirm, skip, repeat, undo, stop.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, from 0, and the position.
    number, total : int
        Number of positions done or skipped plus one, and number of positions in the plan.
    can_undo : bool
        True if there is an earlier dwell, which can be repeated or withdrawn.
    time_left_s : float
        Estimate of the remaining time in s, from the time of the dwells so far.
    """

    place: int
    position: Position
    number: int
    total: int
    can_undo: bool
    time_left_s: float = 0.0


class StageMoved(Event):
    """The program has moved the stage to a position."""

    position: Position


class Watching(Event):
    """Newest readings of the sensor; readings of a dwell come with its `DwellProgress`.

    Attributes
    ----------
    state : str
        `idle` during a question, `measuring` the noise, `moving`, `settling` when still, or `recording`.
    accel_mg : Vector
        Mean of the newest window in mg.
    spread_mg : Vector
        Standard deviation within the newest window in mg.
    angle_deg : float or None
        Live angle by gravity, counted like the stage's angles; None for free attitudes.
    target_deg : float or None
        Requested angle; None if no angle is requested.
    limit_mg : Vector or None
        Limit of `spread_mg` for a sensor at rest; None until the noise is known.
    waits_for : str
        Text that names what the session waits for; empty if it does not wait.
    temperature_c : float or None
        Temperature in the newest scan; None if scans have no temperature.
    lost : int
        Number of scans lost since the session was opened.
    tolerance_deg : float or None
        Distance from `target_deg` within which no guard questions `angle_deg`; None before the first dwell.
    """

    state: WatchState
    accel_mg: Vector
    spread_mg: Vector
    angle_deg: float | None = None
    target_deg: float | None = None
    limit_mg: Vector | None = None
    waits_for: str = ""
    temperature_c: float | None = None
    lost: int = 0
    tolerance_deg: float | None = None


class DwellProgress(Event):
    """A dwell is being recorded.

    Attributes
    ----------
    place : int
        Index of the position in the plan, from 0.
    elapsed_s, length_s : float
        Length of the dwell so far, and its full length, in s.
    newest : Watching
        Newest readings of the sensor, with the state `recording`.
    """

    place: int
    elapsed_s: float
    length_s: float
    newest: Watching


class DwellDone(Event):
    """A dwell is complete and on the disk.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, from 0, and the position.
    attempt : int
        Number of the attempt in the archive.
    samples, lost : int
        Number of samples of the dwell, and of scans lost within it.
    accel_mg : Vector
        Mean of the dwell in mg.
    alarms : int
        Number of scans with an error or alarm (EA).
    """

    place: int
    position: Position
    attempt: int
    samples: int
    lost: int
    accel_mg: Vector
    alarms: int


class DwellInterrupted(Event):
    """A dwell was interrupted; its samples are in the archive, marked as interrupted.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, from 0, and the position.
    attempt : int
        Number of the attempt in the archive.
    samples : int
        Number of samples of the dwell so far.
    reason : str
        Reason of the interruption.
    guarded : bool
        True if a guard interrupted the dwell; the guard asks its question next.
    """

    place: int
    position: Position
    attempt: int
    samples: int
    reason: str
    guarded: bool = False


class Problem(Event):
    """A problem that the operator should know; the session continues.

    Attributes
    ----------
    kind : {"status", "alarm", "lost", "dropped", "stillness"} or GuardKind
        Kind of the problem. The kind of a guard other than `supply` and `temperature` means that the guard
        could not ask, because there is no operator.
    message : str
        Sentence for the operator.
    place : int
        Index of the position in the plan, from 0.
    """

    kind: Literal["status", "alarm", "lost", "dropped", "stillness"] | GuardKind
    message: str
    place: int


RETAKE: tuple[str, ...] = ("retake", "keep", "skip")


@dataclass(frozen=True)
class Guard:
    """A question to the operator about a position or a dwell that seems wrong.

    Attributes
    ----------
    kind, message : GuardKind, str
        Kind of the probable error, and the question.
    values : dict of str to float
        Numbers in the message; names end in their unit.
    answers, default : tuple of str, str
        Names of the allowed answers, and the safe one among them.
    spoils : bool
        True if a result with this dwell, unchanged, would be wrong.
    """

    kind: GuardKind
    message: str
    values: dict[str, float] = field(default_factory=dict)
    answers: tuple[str, ...] = RETAKE
    default: str = "retake"
    spoils: bool = False

    @property
    def contradicts(self) -> bool:
        """True if either the position of the sensor or an earlier dwell must be wrong."""
        return self.kind in ("not_moved", "reversed", "wrong_axis", "wrong_angle")


class GuardRaised(Guard, Event):
    """A guard has found a probable error. Answers: one of `answers`, or stop.

    `retake` asks for the position again, `keep` continues without a change, so that the result will mention
    the doubt, and `reverse` reverses the sense of the whole session.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, from 0, and the position.
    """

    place: int = field(kw_only=True)
    position: Position = field(kw_only=True)


class TurnMeasured(Event):
    """Turn of the sensor since the position before, measured by gyro and gravity.

    Attributes
    ----------
    place : int
        Index of the present position in the plan, from 0.
    asked_deg : float or None
        Turn requested by the plan, counted like the stage's angles; None for free attitudes.
    gyro_deg, gyro_u_deg : float or None
        Integral of the gyro about the axis of rotation, and its standard uncertainty; None if the turn was
        not followed (the program moved the stage, or there is no gyro).
    gravity_deg : float or None
        Turn by gravity, within ±180°; for free attitudes the angle between the two directions.
    """

    place: int
    asked_deg: float | None
    gyro_deg: float | None
    gyro_u_deg: float | None
    gravity_deg: float | None


class TurnProgress(Event):
    """A turn is being recorded: a free turn, or whole turns on a table.

    Attributes
    ----------
    state : {"rest", "turn", "after"}
        Rest before the turns, the turns, and the rest after them.
    elapsed_s, length_s : float
        Time since the beginning and longest time of the recording, in s.
    samples, lost : int
        Number of samples so far, and of scans lost.
    turned_deg, rate_dps : float
        Turn since the beginning, and present rate, both counter-clockwise positive. The rate is a mean over
        the last seconds of a free turn (measured by gravity), or over the last block of whole turns
        (measured by the gyros).
    turn, turns : int
        Number of the present full turn, from 1, and number of full turns.
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


class TurnDone(Event):
    """A turn is complete and on the disk.

    Attributes
    ----------
    turned_deg : float
        Angle from the beginning to the end, counter-clockwise positive.
    length_s : float
        Length of the recording in s.
    samples, lost : int
        Number of samples, and of scans lost.
    turns : int
        Number of full turns in both directions.
    travelled_deg : float
        Sum of the turns in both directions, each counted as positive.
    """

    turned_deg: float
    length_s: float
    samples: int
    lost: int
    turns: int
    travelled_deg: float


class Running(Event):
    """Parameters fitted to the dwells so far.

    Attributes
    ----------
    parameters : dict
        Value, u and unit of each parameter by its name.
    method : str
        Method of the fit.
    dwells : int
        Number of dwells in the fit.
    """

    parameters: dict[str, dict[str, Any]]
    method: str
    dwells: int


class Paused(Event):
    """The session is paused: the stream is closed until the operator continues."""


class Unpaused(Event):
    """The session continues after a pause: the open question is asked again."""


class Noted(Event):
    """A remark of the operator (`text`) was written to the archive."""

    text: str


class Withdrawn(Event):
    """A dwell was withdrawn from the session; it stays in the archive, marked as withdrawn.

    Attributes
    ----------
    place, position : int, Position
        Index of the position in the plan, from 0, and the position.
    """

    place: int
    position: Position


class ExtensionOffered(Event):
    """The plan is done and an extension is offered. Answers: accept, decline, repeat, stop.

    Attributes
    ----------
    plan : Plan
        Extended plan; it begins with the present plan.
    reasons : tuple of str
        Reasons for more positions, one sentence each: a bias that the present plan cannot determine, or the
        reasons of the advisor.
    """

    plan: Plan
    reasons: tuple[str, ...]


class Advising(Event):
    """The advisor analyses the dwells so far, which may take seconds; `Advised` follows.

    Attributes
    ----------
    dwells : int
        Number of complete dwells so far.
    """

    dwells: int


class Advised(Event):
    """Result of asking the advisor; if it proposes positions, `ExtensionOffered` follows.

    Attributes
    ----------
    round : int
        Number of requests to the advisor so far, this one included.
    positions : int
        Number of positions that the advisor proposes.
    ended : str
        Reason why no position is proposed; empty if there are positions.
    summary : dict
        JSON form of the trace so far.
    """

    round: int
    positions: int
    ended: str
    summary: dict[str, Any]


class Waiting(Event):
    """Progress of a wait before a dwell that the plan requires.

    Attributes
    ----------
    place : int
        Index of the position in the plan, from 0.
    elapsed_s, length_s : float
        Time waited so far, and length of the wait, in s.
    """

    place: int
    elapsed_s: float
    length_s: float


class Finished(Event):
    """The session ends, complete or not; the file is closed.

    Attributes
    ----------
    path : str
        Path of the archive.
    complete : bool
        False if positions remain; the session can be resumed.
    done, skipped, total : int
        Number of positions with a dwell, of skipped positions, and of all positions in the plan.
    """

    path: str
    complete: bool
    done: int
    skipped: int
    total: int
