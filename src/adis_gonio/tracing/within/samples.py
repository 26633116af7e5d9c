"""Samples of the dwells in mg, and the records of findings inside the dwells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, robust_sd
from adis_gonio.base.jsonable import OPTIONAL, JsonRecord
from adis_gonio.base.numbers import name_positions
from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.screening import steps_of
from adis_gonio.model.effects import AXES
from adis_gonio.model.records import Session

_LEAST_LEVEL = 100
"""Number of samples above which a dwell alone determines the scatter of its samples."""


@dataclass(frozen=True)
class Samples:
    """Samples of d dwells with at least two samples each.

    Attributes
    ----------
    position : (d,) int
        Numbers of the dwells in the file.
    time_s : d arrays (n,)
        Time of each sample in s since the beginning of the session.
    values : d arrays (n, axes)
        Samples in mg.
    quantum : (axes,) float
        Step of the converter on each axis in mg; for values with many digits the smallest difference.
    reading : (d, axes) float
        Recorded mean of each dwell in mg.
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
        """Number of axes of a sample."""
        return len(self.quantum)

    @property
    def letters(self) -> tuple[str, ...]:
        """Letters of the axes of a sample, such as x and y."""
        return AXES[: self.axes]

    @property
    def counts(self) -> NDArray[np.intp]:
        """Number of samples of each dwell, (d,)."""
        return np.array([len(rows) for rows in self.values], dtype=np.intp)

    @property
    def period_s(self) -> float:
        """Median time between samples in s; NaN if all times are equal."""
        steps = np.concatenate([np.diff(time) for time in self.time_s])
        steps = steps[steps > 0]
        return float(np.median(steps)) if steps.size else float("nan")

    @property
    def u_of_means(self) -> Floats:
        """Least u (d,) in mg of the mean readings of each dwell on any axis, as for white noise."""
        return np.array([rows.std(axis=0).min() / np.sqrt(len(rows)) for rows in self.values])

    def elapsed_s(self, dwell: int) -> Floats:
        """Return the time (n,) in s of each sample of a dwell since its first sample."""
        return np.asarray(self.time_s[dwell] - self.time_s[dwell][0], dtype=np.float64)

    def place(
        self,
        dwell: int,
        axis: int,
        value: float,
        u: float | None = None,
        unit: str = "mg",
        at: int | None = None,
        shift: float | None = None,
    ) -> Place:
        """Return the record of a place: a dwell and an axis by their indices, with the size of the finding.

        Parameters
        ----------
        value, u, unit : float, float or None, str
            Size of the finding with its standard uncertainty (None if unknown) and unit.
        at : int or None
            Index of the sample; None if the finding has no time.
        shift : float or None
            Resulting shift of the dwell's mean in mg; None if unknown.
        """
        time = None if at is None else float(self.time_s[dwell][at])
        size = Value(float(value), u, unit)
        return Place(int(self.position[dwell]), self.letters[axis], time, size, shift)

    def with_values(self, values: list[Floats]) -> Samples:
        """Return the dwells with their samples replaced by `values`."""
        return replace(self, values=tuple(values))


def samples_of(session: Session, data: Readings) -> Samples | None:
    """Return the samples in mg of all dwells with at least two samples; None if there is no such dwell.

    Parameters
    ----------
    session : Session
    data : Readings
        Readings of the session; `data.unit` converts the samples to mg.
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


def scatter(samples: Samples) -> Floats:
    """Return the standard deviation of single samples in each dwell (d, axes).

    Dwells with fewer than `_LEAST_LEVEL` samples use the median over all dwells. The result is never below
    the rounding of the converter.
    """
    own = np.array([[robust_sd(column) for column in rows.T] for rows in samples.values])
    plain = np.array([rows.std(axis=0) for rows in samples.values])
    # With a coarse converter there are too few different values for a median deviation.
    own = np.where(own < 2 * samples.quantum, np.maximum(own, np.minimum(plain, samples.quantum)), own)
    short = samples.counts < _LEAST_LEVEL
    typical = np.sqrt(np.median(plain**2, axis=0))
    least = np.maximum(samples.quantum / np.sqrt(12), 1e-9)
    return np.asarray(np.maximum(np.where(short[:, None], typical, own), least))


Kind = Literal[
    "drift", "settling", "step", "disturbance", "tone", "spikes", "stuck", "noise_change", "limit", "coarse"
]

POWER = 0.9
"""Probability with which a search finds the smallest detectable amplitude of an effect."""
SEARCHES = 6
"""Number of searches that share the error probability `FOUND_WITHIN`: spikes, stuck values, tones,
variance, courses shared by the dwells, events in single dwells."""


class Place(JsonRecord):
    """A dwell and axis in which a finding occurs.

    The JSON document is one entry of `places`.

    Attributes
    ----------
    position : int
        Number of the dwell in the file.
    axis : str
        Letter of the axis.
    time_s : float or None
        Time in s within the session; None if the finding has no time.
    value : Value or None
        Size of the finding (height of a step, samples of a run, …); None if it has no size.
    shift_mg : float or None
        Resulting shift of the dwell's mean in mg; None if unknown.
    """

    position: int
    axis: str
    time_s: float | None = None
    value: Value | None = None
    shift_mg: float | None = None


class WithinFinding(JsonRecord, kw_only=True):
    """A finding in the samples inside the dwells.

    The JSON document is one entry of `within`.

    Attributes
    ----------
    kind : str
        drift, settling, step, disturbance, tone, spikes, stuck, noise_change, limit or coarse.
    effect : str or None
        Name in the catalogue if the finding has the form of a named effect, else None.
    axes : tuple of str
        Letters of the affected axes.
    positions : tuple of int
        Numbers of the affected dwells.
    parameters : mapping of str to Value
        Sizes of the finding by name.
    p_value : float
        p-value times the number of tests of its search and the number of searches, at most 1.
    sentence : str
        The finding in words.
    places : tuple of Place
        Dwells and axes with their own sizes; empty if all of `positions` share the parameters.
    advice : str
        Recommended action against the cause; empty if none is needed.
    aliases_hz : tuple of float or None
        Other frequencies in Hz that sampling would show at the frequency of a tone; None for other kinds.
    """

    kind: Kind
    effect: str | None = None
    axes: tuple[str, ...] = ()
    positions: tuple[int, ...]
    parameters: dict[str, Value]
    p_value: float = 1.0
    sentence: str
    places: tuple[Place, ...] = ()
    advice: str = ""
    aliases_hz: tuple[float, ...] | None = field(default=None, metadata=OPTIONAL)


def corrected(p_value: float, tests: float) -> float:
    """Return a p-value corrected for multiple tests (Bonferroni), at most 1.

    `p_value` is multiplied by `tests`, the number of tests in the search that gave it, and by the number of
    kinds of searches within the dwells.
    """
    return min(1.0, float(p_value) * max(tests, 1.0) * SEARCHES)


def axes_and_positions(places: Sequence[Place]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Return the sorted axes and the sorted positions that occur in some places, without repetition."""
    return tuple(sorted({p.axis for p in places})), tuple(sorted({p.position for p in places}))


def positions_text(positions: tuple[int, ...], dwells: int, most: int = 12) -> str:
    """Name positions in a text, such as `all 24 dwells`, `position 7` or `positions 3, 4, 9`.

    `dwells` is the number of all dwells; at most `most` positions are listed.
    """
    if len(positions) == dwells and dwells > 1:
        return f"all {dwells} dwells"
    return name_positions(positions, most)
