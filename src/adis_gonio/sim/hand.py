"""Movements by hand: slow turns all around, and moves from one position to the next.

Known facts about hands, and their model here
    A hand turns as far as the wrist goes, stops, takes a new grip and goes on: segments of 40 to 120°, each
    with a minimum-jerk profile (Flash & Hogan 1985), and pauses of 0.2 to 0.9 s between them. A slow
    movement is not even: submovements of 0.5 to 3 Hz change its speed by a tenth or two. Physiological
    tremor shakes the sensor at 8 to 12 Hz, but only while the hand holds it. A bearing's axis wobbles by
    hundredths of a degree, at one and two cycles a turn; a sensor held in the hand sways by degrees.

    A movement to a mark is one grip or several, each a minimum-jerk profile, with rests between them. The
    last grip misses the mark by a few hundredths of its length (Meyer et al. 1988), and after 0.1 to 0.4 s
    one or two small corrections of 0.3 to 0.6 s follow. If a mark must be reached from one side, the hand
    stops short of it and creeps up. No two movements are equally fast. A sensor held in the hand also
    turns about the vertical, and strays from the shortest way by degrees.

All movements are sums of smooth functions with exact derivatives, so that the rate belongs to the angle at
every time. All figures are estimates (confidence D).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.sim.settings import WorldSettings

Course = tuple[Floats, Floats]
"""Values (n,) of a function at n times, and its derivatives (n,) per s."""

PAUSE_S = (0.2, 0.9)
"""Shortest and longest pause in s between two grips."""
TREMOR_HZ = (8.0, 12.0)
SWAY_HZ = (0.05, 0.5)
RISE_S = 0.5
"""Time in s in which the hand takes hold of the sensor, or lets go."""
_LINES = 12


@dataclass(frozen=True)
class Sines:
    """Random motion as a sum of sines with random frequencies and phases; its rms is 1.

    `omega` (k,) is in rad/s, `phase` (k,) in rad.
    """

    omega: Floats
    phase: Floats

    @classmethod
    def drawn(cls, rng: np.random.Generator, band_hz: tuple[float, float]) -> Sines:
        """Draw sines with random phases, and with random frequencies between the two limits `band_hz`."""
        omega = 2 * np.pi * rng.uniform(*band_hz, _LINES)
        return cls(omega, rng.uniform(0, 2 * np.pi, _LINES))

    def at(self, time_s: Floats) -> Course:
        """Return the sum of sines (n,) at times (n,) in s, and its derivative (n,) per s."""
        value, rate = np.zeros(len(time_s)), np.zeros(len(time_s))
        size = np.sqrt(2 / _LINES)
        for omega, phase in zip(self.omega, self.phase, strict=True):
            value += size * np.sin(omega * time_s + phase)
            rate += size * omega * np.cos(omega * time_s + phase)
        return value, rate

    @property
    def mean_square_rate(self) -> float:
        """Mean square of the first derivative of the sum of sines, in 1/s²."""
        return float((self.omega**2).mean())


def grips(turn_deg: float, rng: np.random.Generator) -> Floats:
    """Draw the angle turned in each of k successive grips of a hand, (k,) in degrees.

    The angles are positive and add up to at least `turn_deg`.
    """
    spans: list[float] = []
    while sum(spans) < turn_deg:
        spans.append(float(rng.uniform(40.0, 120.0)))
    return np.array(spans)


def minimum_jerk(time_s: Floats, begin_s: float, length_s: float, span: float) -> Course:
    """Return a smooth movement from 0 to `span` at times (n,) in s, with its derivative.

    The movement begins at `begin_s` and takes `length_s`, both in s (Flash & Hogan 1985).
    """
    value, slope = rise((time_s - begin_s) / length_s)
    return span * value, span / length_s * slope


def hold(time_s: Floats, length_s: float) -> Course:
    """Return the firmness of a grip at times (n,) in s, with its derivative.

    It rises smoothly from 0 to 1 after the hand takes hold at 0 s, and has fallen to 0 when the hand lets
    go at `length_s`.
    """
    scale = 1 / RISE_S
    (up, rising), (down, falling) = rise(time_s / RISE_S), rise((length_s - time_s) / RISE_S)
    return product((up, rising * scale), (down, -falling * scale))


def rise(x: Floats) -> Course:
    """Return a step of minimum jerk from 0 at x = 0 to 1 at x = 1, (n,), with its derivative (n,) by x."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2


def product(f: Course, g: Course) -> Course:
    """Return the product (n,) of two functions of time, with its derivative (n,) by the product rule."""
    return f[0] * g[0], f[1] * g[0] + f[0] * g[1]


class _Hand:
    """A movement by hand in pieces, with an uneven speed, tremor and sway.

    Parameters
    ----------
    pieces : list of (float, float, float)
        Begin and length in s, and signed angle in rad, of each grip (a piece is one grip).
    length_s : float
        Time from the begin of the first piece to the end of the last one.
    turned_rad : float
        Sum of the angles of the pieces without their signs, for the mean speed.
    """

    def __init__(
        self,
        settings: WorldSettings,
        rng: np.random.Generator,
        pieces: list[tuple[float, float, float]],
        length_s: float,
        turned_rad: float,
    ) -> None:
        self._settings = settings
        self._pieces, self.length_s = pieces, length_s
        self._uneven, self._tremor = Sines.drawn(rng, (0.5, 3.0)), Sines.drawn(rng, TREMOR_HZ)
        self._shaking = [Sines.drawn(rng, TREMOR_HZ) for _ in range(3)]
        self._sway = Sines.drawn(rng, SWAY_HZ)
        speed = turned_rad / length_s
        self._uneven_rad = settings.hand_unevenness * speed / np.sqrt(self._uneven.mean_square_rate)
        self._tremor_rad = np.radians(settings.hand_tremor_dps) / np.sqrt(self._tremor.mean_square_rate)

    def turned(self, time_s: Floats) -> Course:
        """Return the angle (n,) in rad turned at each time, and its rate (n,) in rad/s."""
        course = np.zeros(len(time_s)), np.zeros(len(time_s))
        for piece in self._pieces:
            _add(course, minimum_jerk(time_s, *piece))
        _add(course, self._while_held(self._uneven, time_s), self._uneven_rad)
        _add(course, self._while_held(self._tremor, time_s), self._tremor_rad)
        return course

    def _while_held(self, lines: Sines, time_s: Floats) -> Course:
        """Return a motion (n,) while the hand holds the sensor, else 0, and its derivative (n,) per s."""
        if self._has_let_go(time_s):
            return np.zeros(len(time_s)), np.zeros(len(time_s))
        return product(lines.at(time_s), hold(time_s, self.length_s))

    def _has_let_go(self, time_s: Floats) -> bool:
        """Return whether the hand holds the sensor at none of the increasing times (n,) in s."""
        return len(time_s) > 0 and bool(time_s[0] >= self.length_s)

    def shaking_mg(self, time_s: Floats) -> Floats:
        """Return the acceleration (n, 3) in mg by which the hand shakes the sensor at times (n,) in s."""
        if self._has_let_go(time_s):
            return np.zeros((len(time_s), 3))
        held = self._settings.hand_vibration_mg * hold(time_s, self.length_s)[0]
        return np.stack([held * lines.at(time_s)[0] for lines in self._shaking], axis=1)


class HandTurn(_Hand):
    """Full turns of the stage by hand; times count from their beginning.

    Parameters
    ----------
    settings : WorldSettings
        Settings of the world; names that begin with `hand_`, and `axis_wobble_deg`, are used.
    rng : Generator
        Draws the speed, pauses and tremor of this hand.
    turns : int
        Number of turns of `hand_turn_deg`, all within `hand_turn_s`; with `hand_returns` every second turn
        goes back.

    Attributes
    ----------
    total_rad : float
        Signed angle from the beginning to the end.
    length_s : float
        Duration in s of all turns.
    """

    def __init__(self, settings: WorldSettings, rng: np.random.Generator, turns: int = 1) -> None:
        # Each turn back ends a row of grips; otherwise one row covers all turns. The angles of the sensor
        # differ from the grips', because they are scaled to exact turns.
        rows = [1] * turns if settings.hand_returns else [turns]
        each = [grips(count * abs(settings.hand_turn_deg), rng) for count in rows]
        degrees = [(-1) ** k * count * settings.hand_turn_deg for k, count in enumerate(rows)]
        ways = np.concatenate([turn * own / own.sum() for turn, own in zip(degrees, each, strict=True)])
        spans = np.concatenate(each)
        pauses = rng.uniform(*PAUSE_S, len(spans)) * settings.hand_pauses
        moving_s = max(settings.hand_turn_s - float(pauses[:-1].sum()), 0.2 * settings.hand_turn_s)
        # Longer segments take longer, and no two are equally fast.
        shares = spans * rng.uniform(0.8, 1.25, len(spans))
        lengths = moving_s * shares / shares.sum()
        # Each segment begins after the segment and the pause before it.
        begins = np.concatenate([[0.0], np.cumsum(lengths + pauses)[:-1]])
        pieces = list(zip(begins, lengths, np.radians(ways), strict=True))
        turned_rad = float(np.radians(np.abs(ways)).sum())
        super().__init__(settings, rng, pieces, float(begins[-1] + lengths[-1]), turned_rad)
        self.total_rad = float(np.radians(ways).sum())
        self._wobble_phase = rng.uniform(0, 2 * np.pi, 2)

    def tilt(self, time_s: Floats, turned: Course) -> tuple[Floats, Floats]:
        """Return the angle (n,) in rad of the sensor's X-Y plane to the vertical, and its rate in rad/s.

        `turned` is the angle of the turn with its rate, see `turned()`.
        """
        angle, rate = turned
        size = np.radians(self._settings.axis_wobble_deg)
        first, second = self._wobble_phase
        tilt = size * (np.cos(angle + first) + 0.5 * np.cos(2 * angle + second))
        slope = -size * rate * (np.sin(angle + first) + np.sin(2 * angle + second))
        sway = np.radians(self._settings.hand_sway_deg)
        swaying = self._while_held(self._sway, time_s)
        return tilt + sway * swaying[0], slope + sway * swaying[1]


class HandMove(_Hand):
    """One movement by hand from one angle to another; times count from its beginning.

    Parameters
    ----------
    settings : WorldSettings
        Settings of the world; names that begin with `hand_`, and `move_speed_dps`, are used.
    rng : Generator
        Draws the grips, speed and errors of this movement.
    span_rad : float
        Signed angle from rest to rest; not 0.
    one_way : bool
        True if the mark must be reached from the side on which the movement begins.
    free : bool
        True if only the hand holds the sensor, so that it also turns about the vertical and strays.

    Attributes
    ----------
    span_rad, length_s : float
        Signed angle in rad, and duration in s.
    twist_rad : float
        Additional turn about the vertical; 0 unless free.
    """

    def __init__(
        self,
        settings: WorldSettings,
        rng: np.random.Generator,
        span_rad: float,
        *,
        one_way: bool = False,
        free: bool = False,
    ) -> None:
        self.span_rad = span_rad
        size = abs(float(np.degrees(span_rad)))
        spans = grips(size, rng)
        spans *= size / spans.sum()
        speed = settings.move_speed_dps * rng.uniform(0.7, 1.4)
        # No grip is shorter than 0.4 s.
        lengths = np.maximum(spans / speed * rng.uniform(0.8, 1.25, len(spans)), 0.4)
        pauses = settings.hand_pauses * rng.uniform(*PAUSE_S, len(spans))
        # Overshoot after the last grip and after the first correction; one way never passes the mark.
        drawn = settings.hand_miss * spans[-1] * rng.standard_normal()
        misses = np.array([drawn, drawn * 0.2 * rng.standard_normal()])
        misses = -np.abs(misses) if one_way else misses
        reactions = settings.hand_pauses * rng.uniform(0.1, 0.4, 2)  # in s
        corrections = rng.uniform(0.3, 0.6, 2)  # in s
        if settings.hand_miss:
            spans[-1] += misses[0]
            spans = np.concatenate([spans, np.diff([*misses, 0.0])])
            lengths = np.concatenate([lengths, corrections])
            pauses = np.concatenate([pauses[:-1], reactions, [0.0]])
        # Grips and corrections follow each other with rests between them.
        ends = np.cumsum(lengths) + np.concatenate([[0.0], np.cumsum(pauses)[:-1]])
        ways = np.sign(span_rad) * np.radians(spans)
        pieces = list(zip(ends - lengths, lengths, ways, strict=True))
        super().__init__(settings, rng, pieces, float(ends[-1]), abs(span_rad))
        axis = rng.standard_normal(3)
        self._stray_axis = axis / np.linalg.norm(axis)
        self._stray_rad = float(np.radians(settings.hand_stray_deg)) if free else 0.0
        twist = settings.hand_twist_deg * float(rng.standard_normal())
        self.twist_rad = float(np.radians(twist)) if free else 0.0

    def add_stray(self, time_s: Floats, direction: Floats, rate: Floats) -> tuple[Floats, Floats]:
        """Add the stray and the twist of an unguided hand to a movement.

        Parameters
        ----------
        time_s : (n,) float
            Times in s since the movement began.
        direction, rate : (n, 3) float
            Direction of gravity and rate of turn in rad/s, both in the sensor's frame, from the movement
            alone.

        Returns
        -------
        direction, rate : (n, 3) float
            Direction and rate including the stray (a turn about an axis of the sensor) and the twist about
            the vertical.
        """
        if self._stray_rad:
            stray, straying = self._while_held(self._sway, time_s)
            axis = self._stray_axis
            direction = turned_back(direction, axis, self._stray_rad * stray)
            rate = turned_back(rate, axis, self._stray_rad * stray)
            rate = rate + self._stray_rad * straying[:, None] * axis
        if self.twist_rad:
            _, twisting = minimum_jerk(time_s, 0.0, self.length_s, self.twist_rad)
            rate = rate - twisting[:, None] * direction
        return direction, rate


def _add(course: Course, more: Course, size: float = 1.0) -> None:
    for whole, part in zip(course, more, strict=True):
        whole += size * part


def turned_back(vector: Floats, axis: Floats, angle: Floats) -> Floats:
    """Return vectors that are fixed in space, as seen by a sensor that has turned.

    `vector` (n, 3) has their components in the sensor's frame before the turn. `angle` (n,) is the angle in
    rad by which the sensor was turned about `axis` (3,) of its frame. The result (n, 3) has the components
    after the turn.
    """
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    # The sum is written out, because a matrix product may round differently for another number of rows.
    along = (vector[:, 0] * axis[0] + vector[:, 1] * axis[1] + vector[:, 2] * axis[2])[:, None] * axis
    return np.asarray(along + cosine * (vector - along) - sine * np.cross(axis, vector))
