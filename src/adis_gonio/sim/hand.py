"""A hand that turns the stage slowly, once or several times: where the part is, how fast, what shakes it.

What is known of hands, and how it stands here
    A hand turns as far as the wrist goes, stops, takes a new grip and goes on: segments of 40 to 120° with
    a minimum-jerk course each (Flash & Hogan 1985), pauses of 0.2 to 0.9 s between them. A slow movement is
    not even: submovements of 0.5 to 3 Hz change its speed by a tenth or two. Physiological tremor shakes at
    8 to 12 Hz whatever is held, and only while it is held. The axis of a bearing wobbles by hundredths of a
    degree, at one and two cycles a turn; a part that is held in the hand sways by degrees.

All courses are sums of smooth functions with exact derivatives, so that rates and accelerations belong to
the angle at every time. Figures are estimates (D).
"""

from __future__ import annotations

import numpy as np

from adis_gonio.sim.inputs import Floats
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.smooth import (
    PAUSE_S,
    SUBMOVEMENT_HZ,
    SWAY_HZ,
    TREMOR_HZ,
    Course,
    Sines,
    grips,
    hold,
    product,
)


class HandTurn:
    """Turns by hand; times are counted from their beginning.

    Parameters
    ----------
    settings : WorldSettings
        Those that begin with `hand_`, and `axis_wobble_deg`.
    rng : Generator
        Draws this hand.
    turns : int
        How often it goes as far as the settings say, in the time that they say; where they want it
        (`hand_returns`), every other time back.

    Attributes
    ----------
    total_rad : float
        From the beginning to the end, with its sign.
    length_s : float
    """

    def __init__(self, settings: WorldSettings, rng: np.random.Generator, turns: int = 1) -> None:
        self._settings = settings
        spans, ways = _grips(settings, rng, turns)
        pauses = rng.uniform(*PAUSE_S, len(spans)) * settings.hand_pauses
        moving_s = max(settings.hand_turn_s - float(pauses[:-1].sum()), 0.2 * settings.hand_turn_s)
        # Longer segments take longer, and no two are equally fast.
        shares = spans * rng.uniform(0.8, 1.25, len(spans))
        lengths = moving_s * shares / shares.sum()
        begins = np.concatenate([[0.0], np.cumsum(lengths + pauses)[:-1]])
        self._segments = list(zip(begins, lengths, np.radians(ways), strict=True))
        self.total_rad = float(np.radians(ways).sum())
        self.length_s = float(begins[-1] + lengths[-1])
        self._uneven = Sines.drawn(rng, SUBMOVEMENT_HZ)
        self._tremor = Sines.drawn(rng, TREMOR_HZ)
        self._shaking = [Sines.drawn(rng, TREMOR_HZ) for _ in range(3)]
        self._sway = Sines.drawn(rng, SWAY_HZ)
        self._wobble_phase = rng.uniform(0, 2 * np.pi, 2)
        speed = float(np.radians(np.abs(ways)).sum()) / self.length_s
        self._uneven_rad = settings.hand_unevenness * speed / np.sqrt(self._uneven.mean_square_rate)
        self._tremor_rad = np.radians(settings.hand_tremor_dps) / np.sqrt(self._tremor.mean_square_rate)

    def turned(self, time_s: Floats) -> Course:
        """Angle turned (n,) in rad, its rate and its acceleration."""
        angle, rate, acceleration = (np.zeros(len(time_s)) for _ in range(3))
        for begin, length, span in self._segments:
            x = np.clip((time_s - begin) / length, 0.0, 1.0)
            angle += span * x**3 * (10 - 15 * x + 6 * x**2)
            rate += span / length * 30 * x**2 * (1 - x) ** 2
            acceleration += span / length**2 * 60 * x * (1 - x) * (1 - 2 * x)
        held = hold(time_s, self.length_s)
        for lines, size in ((self._uneven, self._uneven_rad), (self._tremor, self._tremor_rad)):
            shaken = product(lines.at(time_s), held)
            angle += size * shaken[0]
            rate += size * shaken[1]
            acceleration += size * shaken[2]
        return angle, rate, acceleration

    def tilt(self, time_s: Floats, turned: Course) -> tuple[Floats, Floats]:
        """Tilt (n,) of the plane of X and Y out of the vertical in rad, and its rate."""
        angle, rate, _ = turned
        size = np.radians(self._settings.axis_wobble_deg)
        first, second = self._wobble_phase
        tilt = size * (np.cos(angle + first) + 0.5 * np.cos(2 * angle + second))
        slope = -size * rate * (np.sin(angle + first) + np.sin(2 * angle + second))
        sway = np.radians(self._settings.hand_sway_deg)
        swaying = product(self._sway.at(time_s), hold(time_s, self.length_s))
        return tilt + sway * swaying[0], slope + sway * swaying[1]

    def shaking_mg(self, time_s: Floats) -> Floats:
        """Linear vibration (n, 3) that the hand brings, in mg."""
        held = hold(time_s, self.length_s)[0]
        size = self._settings.hand_vibration_mg
        return np.stack([size * held * lines.at(time_s)[0] for lines in self._shaking], axis=1)


def _grips(settings: WorldSettings, rng: np.random.Generator, turns: int) -> tuple[Floats, Floats]:
    """Spans (k,) of the grips as they come, and how far (k,) each turns the part, in degrees."""
    turn_deg = settings.hand_turn_deg
    if not settings.hand_returns:
        spans = grips(turns * abs(turn_deg), rng)
        return spans, turns * turn_deg * spans / spans.sum()
    each = [grips(abs(turn_deg), rng) for _ in range(turns)]
    ways = [(-1) ** k * turn_deg * spans / spans.sum() for k, spans in enumerate(each)]
    return np.concatenate(each), np.concatenate(ways)
