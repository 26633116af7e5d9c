"""Effects of several sessions: one amplitude for all sessions, or amplitudes of each group of sessions.

The amplitudes of an effect may belong to all sessions, to the sessions on one stage or of one part, or to
each session. `sharings` lists these groupings, and `split_effect` makes an effect with amplitudes for each
group. Shape parameters such as time constants are common to all groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.model.effects import Conditions, Effect, Enters, Parameter
from adis_gonio.model.measurement import SessionOrigin


@dataclass(frozen=True)
class Sharing:
    """A grouping of sessions, whose groups have amplitudes of their own.

    Attributes
    ----------
    by : str
        `stage`, `part` or `session`.
    labels : tuple of str
        Names of the groups.
    group : tuple of int
        Number of the group of each session.
    """

    by: str
    labels: tuple[str, ...]
    group: tuple[int, ...]


def sharings(origins: Sequence[SessionOrigin]) -> list[Sharing]:
    """List the groupings of sessions by stage, by part, and by session.

    A grouping is omitted if it has only one group, or the groups of an earlier grouping.
    """
    found: list[Sharing] = []
    for by, names in (
        ("stage", [one.stage for one in origins]),
        ("part", [one.part for one in origins]),
        ("session", [one.label for one in origins]),
    ):
        labels = tuple(dict.fromkeys(names))
        group = tuple(labels.index(name) for name in names)
        if len(labels) > 1 and all(one.group != group for one in found):
            found.append(Sharing(by, labels, group))
    return found


class SplitEffect(Effect):
    """Effect of the catalogue whose amplitudes belong to groups of sessions.

    Its parameters are the amplitudes of the first group, of the second group, …, then the shapes.
    """

    kind: ClassVar[type[Effect]]
    sharing: ClassVar[Sharing]

    @cached_property
    def whole(self) -> Effect:
        """The effect with one amplitude for all sessions."""
        return self.kind(self.axes, **{choice: getattr(self, choice) for choice in self.choices()})

    @cached_property
    def _shapes(self) -> NDArray[np.bool_]:
        return np.array([one.shape for one in self.whole.parameters])

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Amplitudes of each group, named `drift_z@group`, then the shape parameters."""
        inner = self.whole.parameters
        own = [
            replace(one, name=f"{one.name}@{label}")
            for label in self.sharing.labels
            for one in inner
            if not one.shape
        ]
        return (*own, *(one for one in inner if one.shape))

    def _groups(
        self, values: Floats, conditions: Conditions
    ) -> list[tuple[NDArray[np.bool_], Floats, slice]]:
        """Return for each group the mask (n,) of its rows, its values, and the slice of its amplitudes."""
        group = np.array(self.sharing.group)[conditions.covariate("session").astype(np.intp)]
        width = int((~self._shapes).sum())
        found = []
        for k in range(len(self.sharing.labels)):
            place = slice(k * width, (k + 1) * width)
            own = np.empty(len(self._shapes))
            own[~self._shapes], own[self._shapes] = (
                values[place],
                values[len(self.sharing.labels) * width :],
            )
            found.append((group == k, own, place))
        return found

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle (n,) in rad added to the true angle, by the values of each row's group."""
        parts = [
            rows * self.whole.attitude_rad(own, conditions)
            for rows, own, _ in self._groups(values, conditions)
        ]
        return np.asarray(np.sum(parts, axis=0))

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the terms added to the readings (n, axes), by the values of each row's group."""
        parts = [
            rows[:, None] * self.whole.reading(own, ideal, conditions)
            for rows, own, _ in self._groups(values, conditions)
        ]
        return np.asarray(np.sum(parts, axis=0))

    def derivative(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the derivative by the amplitudes of all groups, zero on rows of other groups."""
        shapes, last = self._shapes, len(values) - int(self._shapes.sum())
        shape = (len(conditions),) if self.enters is Enters.ATTITUDE else ideal.shape
        out = np.zeros((*shape, len(values)))
        slope, at = None, np.zeros(0)
        for rows, own, place in self._groups(values, conditions):
            # Without shapes the derivative is independent of the values.
            if slope is None or (shapes.any() and not np.array_equal(own, at)):
                slope, at = self.whole.derivative(own, ideal, conditions), own
            out[rows, ..., place] = slope[rows][..., ~shapes]
            out[rows, ..., last:] = slope[rows][..., shapes]
        return out


@cache
def _split_kind(kind: type[Effect], sharing: Sharing) -> type[Effect]:
    made: Any = type(
        f"{kind.__name__}By{sharing.by}", (SplitEffect, kind), {"kind": kind, "sharing": sharing}
    )
    return made  # type: ignore[no-any-return]


def split_effect(effect: Effect, sharing: Sharing) -> Effect:
    """Return an effect with amplitudes for each group of sessions."""
    choices = {choice: getattr(effect, choice) for choice in effect.choices()}
    return _split_kind(type(effect), sharing)(effect.axes, **choices)
