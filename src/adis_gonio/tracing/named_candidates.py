"""Candidate terms of the catalogue: every effect on every choice of axes, with its shapes on a grid.

In a joint trace the amplitudes of an effect may belong to all sessions, to the sessions on one stage or of
one part, or to each session. `sharings` lists these groupings, and `split_effect` makes an effect with
amplitudes for each group. Shape parameters such as time constants are common to all groups.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import Detectable
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, Parameter, catalogue
from adis_gonio.model.effects.stage_terms import LEAST_CYCLES, of_one_phase
from adis_gonio.model.measurement import SESSION_BIAS_MG, SessionOrigin
from adis_gonio.tracing.thresholds import limits


def choices_of_axes(axes: Sequence[Any], most: int | None = None) -> list[tuple[Any, ...]]:
    """Return all subsets of the axes with up to `most` axes (by default any number), smallest first."""
    sizes = range(1, (len(axes) if most is None else most) + 1)
    return [chosen for size in sizes for chosen in itertools.combinations(axes, size)]


def prior_weight(kind: type[Effect]) -> float:
    """Return the prior weight of an effect relative to an ordinary effect.

    Biases, curvatures and sensitivities to force are more common and have larger weights.
    """
    constant, curvature, force = limits.bias_weight, limits.quadratic_weight, limits.g_weight
    return {"constant": constant, "curvature": curvature, "force": force}.get(kind.prior, 1.0)


def named_terms(data: Readings) -> tuple[list[NamedTerm], dict[str, Detectable]]:
    """Return the candidate terms of all named effects, and an entry for each effect without candidates.

    A bias of all axes has nearly the whole prior, since each axis of a real part has a bias. Each other
    effect has a fixed share. Its forms (combinations of axes, dwell, degree and shape) divide it evenly;
    its numbers of cycles n divide it as 1/n, so that every octave has the same probability.
    """
    terms: list[NamedTerm] = []
    missing: dict[str, Detectable] = {}
    kinds = catalogue(data.model.part)
    for name, kind in kinds.items():
        if kind.enters is Enters.SAMPLES or kind.within_dwell:
            missing[name] = Detectable(None, "", "", "looked for within the dwells")
            continue
        lacking = data.conditions.lacks(kind.needs)
        if lacking:
            missing[name] = Detectable(None, "", "", f"{', '.join(lacking)} not recorded", lacking)
            continue
        if kind.enters is Enters.ATTITUDE and not data.planar:
            missing[name] = Detectable(None, "", "", "attitudes are free")
            continue
        variants = list(_variants(kind, data))
        parts = np.array([1 / getattr(effect, "cycles", 1) for effect, _ in variants])
        shares = limits.effect_share * prior_weight(kind) * parts / parts.sum()
        if kind.prior == "constant":
            whole = [len(effect.axes) == data.axes for effect, _ in variants]
            shares = np.where(whole, limits.bias_share, shares)
        for (effect, shapes), part in zip(variants, shares, strict=True):
            label = effect.name
            if effect.axes:
                label += "[" + "".join(effect.axes) + "]"
            label += "".join(f"({c}={getattr(effect, c)})" for c in effect.choices())
            label += "".join(f"<{value:.4g}>" for _, value in shapes)
            terms += _shared(NamedTerm(label, kind.covariates, -math.log(part), effect, shapes), data)
    return terms, missing


def _shared(term: NamedTerm, data: Readings) -> list[NamedTerm]:
    """Return a term with one amplitude for all sessions, and with amplitudes of each group of sessions.

    These forms share the prior of the term. An effect of a single dwell, and an effect that the base model
    contains, have only the first form; a bias has all. A bias that differs from session to session is
    normally distributed, with a standard deviation from a grid, since its size is unknown. Other effects
    rarely differ from session to session and get a small prior for it, unless time drives them: the start
    of a session changes such an effect.
    """
    kind, found = type(term.effect), [term]
    driven = "time" in kind.covariates or any(need.endswith("_history") for need in kind.needs)
    constant, weights, groups = kind.prior == "constant", [1.0], sharings(data.model.origins)
    if not groups or term.dwell is not None or (kind.in_base and not constant):
        return found
    for sharing in groups:
        effect = split_effect(term.effect, sharing)
        later = len(effect.parameters) - len(term.effect.parameters)
        split = replace(
            term,
            label=f"{term.label}@{sharing.by}",
            effect=effect,
            shapes=tuple((k + later, value) for k, value in term.shapes),
        )
        if constant and sharing.by == "session":
            sizes = SESSION_BIAS_MG * 3.0 ** np.arange(-4, 2)
            found += [replace(split, label=f"{split.label}<{s:.2g}>", prior_sd=float(s)) for s in sizes]
        else:
            found.append(split)
        own = sharing.by != "session" or constant or driven
        weights += [1.0 if own else limits.own_weight] * (len(found) - len(weights))
    costs = [term.cost - math.log(weight / sum(weights)) for weight in weights]
    if constant and len(term.effect.axes) == data.axes:
        # Every part has a bias: it is in every model, and costs nothing.
        costs[next((k for k, one in enumerate(found) if one.label.endswith("@part")), 0)] = 0.0
    return [replace(one, cost=cost) for one, cost in zip(found, costs, strict=True)]


def _variants(kind: type[Effect], data: Readings) -> Iterator[tuple[Effect, tuple[tuple[int, float], ...]]]:
    """Yield each form of an effect that is tried in a session: the effect with its axes, and its shapes.

    A shape is the index of a parameter in `effect.parameters` with a value from its grid.
    """
    letters = AXES[: data.axes]
    subsets: list[tuple[str, ...]] = [()]
    if kind.by_axis:
        subsets = choices_of_axes(letters, most=1 if kind.one_axis else None)
    choices = kind.choices()
    if (
        "dwell" in choices
        and kind.by_axis
        and data.model.freedom == 2
        and data.conditions.order is not None
    ):
        # A single reading with free attitude determines only the norm. The amplitude is assigned to the
        # axis nearest to gravity.
        nearest = np.abs(data.mean).argmax(axis=1)
        for k in np.flatnonzero(~data.check):
            choice = {"dwell": int(data.conditions.order[k])}
            yield kind((letters[nearest[k]],), **choice), ()
        return
    for axes in subsets:
        for option in _options(kind, data):
            effect = kind(axes, **option)
            shaped = [(k, p) for k, p in enumerate(effect.parameters) if p.shape]
            grids = [[(k, value) for value in _grid(p, data)] for k, p in shaped]
            for shapes in itertools.product(*grids):
                yield effect, shapes


def _options(kind: type[Effect], data: Readings) -> list[dict[str, int]]:
    """Return the values to try in this session for an effect's choices (dwell, degree, cycles, options)."""
    choices = kind.choices()
    options: list[dict[str, int]] = [{}]
    if "dwell" in choices and data.conditions.order is not None:
        # No check dwells: their columns would be empty.
        order = data.conditions.order[~data.check]  # a turn is numbered halfway between two dwells
        options = [{"dwell": int(k)} for k in order if float(k).is_integer()]
    elif "degree" in choices:
        levels = len(np.unique(np.round(data.conditions.covariate("temperature_c"), 1)))
        options = [{"degree": k} for k in (1, 2, 3) if k < max(2, levels)]
    elif "cycles" in choices:
        options = [{"cycles": k} for k in cycles_shown(data.conditions.covariate("angle_rad"))]
    for word, values in kind.options.items():
        options = [{**option, word: value} for option in options for value in values]
    return options


def cycles_shown(angle_rad: Floats, most: int | None = None) -> list[int]:
    """Return the numbers of cycles per turn, at least three, that the angles distinguish from each other.

    `angle_rad` (n,) are the angles of the dwells. The numbers go up to `most`, by default the limit of the
    trace. The angles also distinguish each of them from a constant and from one or two cycles.
    """
    most = limits.most_cycles if most is None else most
    one = of_one_phase(np.arange(2 * most + 1), angle_rad)
    shown = np.arange(LEAST_CYCLES)
    for cycles in range(LEAST_CYCLES, most + 1):
        if not (one[cycles - shown] | one[cycles + shown]).any():
            shown = np.append(shown, cycles)
    return [int(cycles) for cycles in shown[LEAST_CYCLES:]]


def _grid(parameter: Parameter, data: Readings) -> list[float]:
    """Return the values to try for a shape parameter: a grid of time constants, or its typical value.

    Time constants range from the spacing of the dwells to 1.5 times the length of a session. With a longer
    time constant the contribution is nearly constant, like a bias.
    """
    if parameter.unit != "s":
        return [parameter.typical]
    time = data.conditions.time_s
    length = max(float(np.ptp(time)), 1.0)
    sessions = max(len(data.model.origins), 1)
    low = max(parameter.low, length / max(len(time) / sessions - 1, 1))
    high = min(parameter.high, max(1.5 * length, 2 * low))
    return [float(value) for value in np.geomspace(low, high, limits.grid)]


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
        count, width = len(self.sharing.labels), int((~self._shapes).sum())
        places = [slice(k * width, (k + 1) * width) for k in range(count)]
        own = np.empty((count, len(self._shapes)))
        own[:, ~self._shapes] = [values[place] for place in places]
        own[:, self._shapes] = values[count * width :]
        return [(group == k, own[k], place) for k, place in enumerate(places)]

    def _by_group(
        self, values: Floats, conditions: Conditions, contribution: Callable[[Floats], Floats]
    ) -> Floats:
        """Return a contribution to readings or angles (n, …), on each row by the values of its group.

        `contribution` computes it on all rows from the values of one group.
        """
        parts = [(rows * contribution(own).T).T for rows, own, _ in self._groups(values, conditions)]
        return np.asarray(np.sum(parts, axis=0))

    def attitude_rad(self, values: Floats, conditions: Conditions) -> Floats:
        """Return the angle (n,) in rad added to the true angle, by the values of each row's group."""
        return self._by_group(values, conditions, lambda own: self.whole.attitude_rad(own, conditions))

    def reading(self, values: Floats, ideal: Floats, conditions: Conditions) -> Floats:
        """Return the terms added to the readings (n, axes), by the values of each row's group."""
        return self._by_group(values, conditions, lambda own: self.whole.reading(own, ideal, conditions))

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
