"""What the second pass reports: findings inside the dwells, and where they stand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, OPTIONAL, JsonRecord
from adis_gonio.base.numbers import name_positions
from adis_gonio.base.uncertainty import Value

Kind = Literal[
    "drift", "settling", "step", "disturbance", "tone", "spikes", "stuck", "noise_change", "limit", "coarse"
]

SEARCHES = 6
"""Searches that share `FOUND_WITHIN`: spikes, stuck values, tones, variance, courses common to the dwells,
events in single dwells."""


@dataclass(frozen=True)
class Place(JsonRecord):
    """One dwell and axis in which something stands.

    The JSON document is one entry of `places`.

    Attributes
    ----------
    position : int
        Number of the dwell in the file.
    axis : str
    time_s : float or None
        Moment in the session's time.
    value : Value or None
        Size there (height of a step, samples of a run, …).
    shift_mg : float or None
        By how much it moves the dwell's mean; None where that is not known.
    """

    position: int
    axis: str
    time_s: float | None = None
    value: Value | None = None
    shift_mg: float | None = None


@dataclass(frozen=True)
class View:
    """What a figure of a finding shows.

    Attributes
    ----------
    x, y : (n,) float
        Points.
    model_x, model_y : (m,) float
        What the finding says of them.
    x_label, y_label, caption, model_label : str
    y_log : bool
    points : bool
        True where y are single points rather than a course.
    """

    x: Floats
    y: Floats
    model_x: Floats
    model_y: Floats
    x_label: str
    y_label: str
    caption: str
    model_label: str = "fitted"
    y_log: bool = False
    points: bool = False


@dataclass(frozen=True)
class WithinFinding(JsonRecord):
    """Something that the samples inside the dwells show.

    The JSON document is one entry of `within`.

    Attributes
    ----------
    kind : str
        drift, settling, step, disturbance, tone, spikes, stuck, noise_change, limit or coarse.
    effect : str or None
        Name in the catalogue, where its form is the catalogue's.
    axes : tuple of str
    positions : tuple of int
        Numbers of the dwells in which it stands.
    parameters : mapping of str to Value
    p_value : float
        Multiplied by the number of tests of its search and of `SEARCHES`, at most 1.
    sentence : str
    places : tuple of Place
        Single dwells and axes; empty where all of `positions` share the parameters.
    advice : str
        What to do about it; empty where nothing has to be done.
    aliases_hz : tuple of float or None
        Other frequencies that the samples show as this line; None if this is no tone.
    view : View or None
        For a figure; no part of the document nor of a comparison.
    """

    kind: Kind
    effect: str | None
    axes: tuple[str, ...]
    positions: tuple[int, ...]
    parameters: dict[str, Value]
    p_value: float
    sentence: str
    places: tuple[Place, ...] = ()
    advice: str = ""
    aliases_hz: tuple[float, ...] | None = field(default=None, metadata=OPTIONAL)
    view: View | None = field(default=None, repr=False, compare=False, metadata=HIDDEN)


def corrected(p_value: float, tests: float) -> float:
    """p-value times the tests of its search and the number of searches, at most 1."""
    return min(1.0, float(p_value) * max(tests, 1.0) * SEARCHES)


def positions_text(positions: tuple[int, ...], dwells: int, most: int = 12) -> str:
    """`all 24 dwells`, `position 7` or `positions 3, 4, 9`."""
    if len(positions) == dwells and dwells > 1:
        return f"all {dwells} dwells"
    return name_positions(positions, most)
