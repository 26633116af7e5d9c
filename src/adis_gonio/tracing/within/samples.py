"""What the second pass works on: the samples of each dwell in mg.

What the second pass reports: findings inside the dwells, and where they stand.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, OPTIONAL, JsonRecord
from adis_gonio.base.numbers import name_positions
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.converter import steps_of
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.robust import MAD_TO_SD
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Session

_LEAST_LEVEL = 100
"""Samples from which a dwell's scatter is known well enough by itself."""


@dataclass(frozen=True)
class Samples:
    """Samples of d dwells that have at least two each.

    Attributes
    ----------
    position : (d,) int
        Numbers of the dwells in the file.
    time_s : d arrays (n,)
        Time of each sample in the session's time.
    values : d arrays (n, axes)
        Samples in mg.
    quantum : (axes,) float
        Step of the converter in mg; of numbers with many digits the smallest difference seen.
    reading : (d, axes) float
        Mean of each dwell in mg, as it was recorded.
    """

    position: NDArray[np.intp]
    time_s: tuple[Floats, ...]
    values: tuple[Floats, ...]
    quantum: Floats
    reading: Floats

    def __len__(self) -> int:
        return len(self.values)

    @property
    def axes(self) -> int:
        """Axes of a sample."""
        return len(self.quantum)

    @property
    def letters(self) -> tuple[str, ...]:
        """Letters of the axes."""
        return AXES[: self.axes]

    @property
    def counts(self) -> NDArray[np.intp]:
        """Samples of each dwell (d,)."""
        return np.array([len(rows) for rows in self.values], dtype=np.intp)

    @property
    def period_s(self) -> float:
        """Median time between samples; nan where all times are alike."""
        steps = np.concatenate([np.diff(time) for time in self.time_s])
        steps = steps[steps > 0]
        return float(np.median(steps)) if steps.size else float("nan")

    def elapsed_s(self, dwell: int) -> Floats:
        """Time since the first sample of a dwell (n,)."""
        return np.asarray(self.time_s[dwell] - self.time_s[dwell][0], dtype=np.float64)

    def with_values(self, values: list[Floats]) -> Samples:
        """The same dwells with other samples."""
        return replace(self, values=tuple(values))

    def rows(self, chosen: NDArray[np.bool_]) -> Samples:
        """Some of the dwells."""
        kept = np.flatnonzero(chosen).tolist()
        return replace(
            self,
            position=self.position[chosen],
            time_s=tuple(self.time_s[k] for k in kept),
            values=tuple(self.values[k] for k in kept),
            reading=self.reading[chosen],
        )


def samples_of(session: Session, data: Readings) -> Samples | None:
    """Samples in mg of the dwells that have at least two; None where there are none.

    Parameters
    ----------
    session : Session
    data : Readings
        Of the same session.
    """
    used = set(data.position.tolist())
    dwells = [dwell for dwell in session.dwells if dwell.position in used]
    many = np.array([len(dwell) > 1 for dwell in dwells])
    if not many.any():
        return None
    kept = [dwell for dwell, use in zip(dwells, many, strict=True) if use]
    values = tuple(data.unit.mg(dwell.accel) for dwell in kept)
    return Samples(
        position=np.array([dwell.position for dwell in kept], dtype=np.intp),
        time_s=tuple(dwell.time_s for dwell in kept),
        values=values,
        quantum=steps_of([rows[:1000] for rows in values]),
        reading=data.mean[many],
    )


def deviation(rows: Floats, axis: int = 0) -> Floats:
    """Standard deviation by the median absolute deviation, which few wild values do not move."""
    middle = np.median(rows, axis=axis, keepdims=True)
    spread: Floats = MAD_TO_SD * np.median(np.abs(rows - middle), axis=axis)
    return spread


def scatter(samples: Samples) -> Floats:
    """Standard deviation of single samples in each dwell (d, axes).

    Short dwells take the middle one of all. Never below what the converter's step makes of any value.
    """
    own = np.array([deviation(rows) for rows in samples.values])
    plain = np.array([rows.std(axis=0) for rows in samples.values])
    # A coarse converter shows so few values that their median deviation says nothing.
    own = np.where(own < 2 * samples.quantum, np.maximum(own, np.minimum(plain, samples.quantum)), own)
    short = samples.counts < _LEAST_LEVEL
    typical = np.sqrt(np.median(plain**2, axis=0))
    least = np.maximum(samples.quantum / np.sqrt(12), 1e-9)
    chosen: Floats = np.maximum(np.where(short[:, None], typical, own), least)
    return chosen


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
