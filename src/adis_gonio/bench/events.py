"""Events of a running session for its front end; see `runner`.

Places are positions of the plan, counted from 0; accelerations are in mg, x, y, z.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, dataclass_transform

from adis_gonio.record.plans import Blindness, Plan, Position

Vector = tuple[float, float, float]

GuardKind = Literal[
    "not_moved", "reversed", "wrong_axis", "wrong_angle", "upside_down", "shock",
    "drift", "stuck", "supply", "temperature", "over_range",
]  # fmt: skip
"""Reasons for which a guard stops a session."""


@dataclass_transform(frozen_default=True)
@dataclass(frozen=True)
class Event:
    """Base class of all events, by which a session informs its front end; each is a frozen dataclass."""

    def __init_subclass__(cls) -> None:
        dataclass(frozen=True)(cls)

    def as_dict(self) -> dict[str, Any]:
        """JSON form, with the name of the event as `event`."""
        return {"event": type(self).__name__} | asdict(self)


class Started(Event):
    """The session has begun: the archive is open.

    Attributes
    ----------
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
        Control registers that were changed: numbers before and after.
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
        Standard deviation of a sample at rest.
    still_below_mg, stuck_below_mg : Vector
        A window with more than the first limit moves; an axis with less than the second is stuck.
    window_s : float
        Length of a window.
    """

    noise_mg: Vector
    still_below_mg: Vector
    stuck_below_mg: Vector
    window_s: float


class PositionAsked(Event):
    """The sensor is to be put into a position. Answers: confirm, skip, repeat, undo, stop.

    Attributes
    ----------
    number, total : int
        Number of the position, from 1, and number of positions.
    can_repeat : bool
        True if there is an earlier dwell that can be repeated.
    time_left_s : float
        Estimate of the remaining time, from the time of the dwells so far.
    can_undo : bool
        True if there is a dwell that can be withdrawn.
    """

    place: int
    position: Position
    number: int
    total: int
    can_repeat: bool
    time_left_s: float = 0.0
    can_undo: bool = False


class StageMoved(Event):
    """The program has moved the stage to a position."""

    position: Position


class Watching(Event):
    """Newest readings of the sensor outside a dwell.

    Attributes
    ----------
    state : str
        `idle` during a question, `measuring` the noise, `moving`, or `settling` when still.
    spread_mg : Vector
        Standard deviation within the newest window.
    angle_deg : float or None
        Live angle by gravity in the sense of the stage; None for free attitudes.
    target_deg : float or None
        Requested angle, if any.
    limit_mg : Vector or None
        Limit of `spread_mg` for a part at rest; None until the noise is known.
    waits_for : str
        Text that names the next step of a wait, or empty.
    temperature_c : float or None
        Temperature in the newest scan; None if scans have no temperature.
    lost : int
        Scans lost since the session was opened.
    tolerance_deg : float or None
        Distance from `target_deg` within which no guard questions `angle_deg`; None before the first dwell.
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


class DwellProgress(Event):
    """A dwell is being recorded.

    Attributes
    ----------
    lost : int
        Scans lost within this dwell.
    accel_mg : Vector
        Mean of the newest window.
    spread_mg, angle_deg, target_deg, limit_mg, waits_for, temperature_c
        See `Watching`.
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


class DwellDone(Event):
    """A dwell is complete and on the disk.

    Attributes
    ----------
    attempt : int
        Number of the attempt in the archive.
    accel_mg : Vector
        Mean of the dwell.
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

    A guard that interrupted it asks its question next (`guarded`).
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
    kind : {"status", "alarm", "supply", "lost", "dropped", "stillness"} or GuardKind
        A kind of a guard means a guard that could not ask, because there is no operator.
    """

    kind: Literal["status", "alarm", "supply", "lost", "dropped", "stillness"] | GuardKind
    message: str
    place: int


class GuardRaised(Event):
    """A guard has found a probable error. Answers: one of `answers`, or stop.

    `retake` asks for the position again, `keep` continues without a change, `reverse` reverses the sense of
    the whole session.

    Attributes
    ----------
    values : dict of str to float
        Numbers in the message, by names that end in their unit.
    answers : tuple of str
        Names of the allowed answers, for `runner.answer(name)`.
    default : str
        The safe answer.
    """

    kind: GuardKind
    message: str
    place: int
    position: Position
    values: dict[str, float]
    answers: tuple[str, ...]
    default: str


class TurnMeasured(Event):
    """Turn of the sensor since the position before, measured by gyro and gravity.

    Attributes
    ----------
    asked_deg : float or None
        Turn requested by the plan, in the sense of the stage; None for free attitudes.
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
    """A free turn is being recorded.

    Attributes
    ----------
    state : {"rest", "turn", "after"}
        Rest before the turns, the turns, and the rest after them.
    turned_deg, rate_dps : float
        Turn since the beginning and rate over the last seconds, by gravity, counter-clockwise positive.
    turn, turns : int
        Number of the present full turn, from 1, and number of full turns.
    rest_s : float
        Duration of the present rest, if whole turns are followed by the gyros.
    peak_dps : float
        Largest rate of any gyro so far, if the gyros are followed.
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


class TurnDone(Event):
    """A free turn is complete and on the disk.

    Attributes
    ----------
    turned_deg : float
        Turn from the beginning to the end.
    turns : int
        Full turns in both directions.
    travelled_deg : float
        Sum of the turns in both directions.
    """

    attempt: int
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
        Value, u and unit by name, as in the JSON form of a fit.
    """

    parameters: dict[str, dict[str, Any]]
    method: str
    dwells: int


class Paused(Event):
    """The session is paused: the stream is closed until the operator continues."""

    place: int | None


class Unpaused(Event):
    """The session continues after a pause: the open question is asked again."""

    place: int | None


class Noted(Event):
    """A remark of the operator was written to the archive."""

    text: str


class Withdrawn(Event):
    """A dwell was withdrawn from the session; it stays in the archive, marked as withdrawn."""

    place: int
    position: Position
    attempt: int


class RepetitionOffered(Event):
    """The plan is done, but some dwells have a fault or alarm. Answers: accept, decline, repeat, stop.

    If accepted, their positions are asked for one by one and measured again. If declined, the dwells are
    kept and not asked about again.

    Attributes
    ----------
    places, positions : tuple
        Places and positions of these dwells.
    """

    places: tuple[int, ...]
    positions: tuple[Position, ...]


class ExtensionOffered(Event):
    """The plan is done and an extension is offered. Answers: accept, decline, repeat, stop.

    Attributes
    ----------
    plan : Plan
        Extended plan; it begins with the present plan.
    blindness : Blindness or None
        Effect of an undetectable bias; None if an advisor asks for more positions.
    reasons : tuple of str
        Reasons of the advisor, one sentence each.
    """

    plan: Plan
    blindness: Blindness | None
    reasons: tuple[str, ...] = ()


class Advising(Event):
    """The advisor analyses the dwells so far, which may take seconds; `Advised` follows.

    Attributes
    ----------
    dwells : int
        Complete dwells so far.
    """

    dwells: int


class Advised(Event):
    """Result of asking the advisor; if it proposes positions, `ExtensionOffered` follows.

    Attributes
    ----------
    round : int
        Number of the round, from 1.
    positions : int
        Number of requested positions.
    ended : str
        Reason why no position is requested, or empty.
    summary : dict
        JSON form of the result so far.
    """

    round: int
    positions: int
    ended: str
    summary: dict[str, Any]


class Waiting(Event):
    """Progress of a wait before a dwell that the plan requires."""

    place: int
    elapsed_s: float
    length_s: float


class Finished(Event):
    """The session ends, complete or not; the file is closed.

    Attributes
    ----------
    complete : bool
        False if positions remain; the session can be resumed.
    """

    path: str
    complete: bool
    done: int
    skipped: int
    total: int
