"""How often a part went all around: on and on, or forth and back."""

from __future__ import annotations

REVERSED_DEG = 10.0
"""Going back by less is the hand's unevenness."""
NEARLY_DEG = 5.0
"""What may be wanting: nobody sees where exactly a turn is full."""


class Sweeps:
    """Follows an angle that is seen bit by bit.

    Attributes
    ----------
    angle_deg : float
        Where it is, from the start on, with its sign.
    span_deg : float
        From the least angle to the greatest.
    """

    def __init__(self) -> None:
        self.angle_deg = 0.0
        self._least = self._greatest = 0.0
        self._gone = 0.0
        self._from = self._farthest = 0.0

    def see(self, angle_deg: float) -> None:
        """Take the next angle, unwrapped."""
        self.angle_deg = angle_deg
        self._least, self._greatest = min(self._least, angle_deg), max(self._greatest, angle_deg)
        on = self._farthest - self._from
        if (angle_deg - self._farthest) * (on or angle_deg - self._farthest) >= 0:
            self._farthest = angle_deg
        elif abs(angle_deg - self._farthest) > REVERSED_DEG:
            self._gone += abs(on)
            self._from, self._farthest = self._farthest, angle_deg

    @property
    def span_deg(self) -> float:
        """From the least angle to the greatest."""
        return self._greatest - self._least

    @property
    def travelled_deg(self) -> float:
        """All the way, there and back; what a hand trembles does not count."""
        return self._gone + abs(self._farthest - self._from)

    @property
    def full(self) -> int:
        """Full turns that were made; a way back over a full turn is one too."""
        if self.span_deg < 360.0 - NEARLY_DEG:
            return 0
        return int((self.travelled_deg + NEARLY_DEG) // 360.0)
