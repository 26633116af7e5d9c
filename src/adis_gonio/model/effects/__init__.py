"""The catalogue of effects by name: the effects of this package, and the effects of other packages.

An effect is a named physical term that the base model lacks; other packages add effects by entry
points.

>>> from adis_gonio.model.effects import parse_effect
>>> effect, values = parse_effect("quadratic:k2_x=2.5")
>>> effect.name, [p.name for p in effect.parameters], values.tolist()
('quadratic', ['k2_x', 'k2_y'], [2.5, 0.0])
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.model.effects import gyro_terms, sensor_terms, stage_terms
from adis_gonio.model.effects.base import (
    AXES,
    COVARIATES,
    Conditions,
    Effect,
    Enters,
    Parameter,
)

ENTRY_POINT_GROUP = "adis_gonio.effects"

BUILT_IN: dict[str, type[Effect]] = {
    kind.name: kind
    for module in (sensor_terms, stage_terms, gyro_terms)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, Effect)
    if kind.__module__ == module.__name__ and "cause" in vars(kind)
}
"""Effect classes of this package by name, in the order of their definition."""


def catalogue(part: str | None = None) -> dict[str, type[Effect]]:
    """Return the classes of all installed effects by name, first the built-in effects.

    Parameters
    ----------
    part : str, optional
        `accelerometer` or `gyro`: return only the effects of this part of the sensor; all by default.

    Raises
    ------
    UsageError
        An entry point of another package cannot be loaded, is no effect, differs in name from its effect,
        or has a name that exists; or its effect declares no covariates or an unknown covariate.
    """
    found = dict(BUILT_IN)
    for point in _installed(tuple(sys.path)):
        try:
            kind = point.load()
        except Exception as error:  # a foreign module may raise anything on import
            raise UsageError(f"effect '{point.name}' of {point.value} cannot be loaded: {error}") from error
        if not (isinstance(kind, type) and issubclass(kind, Effect)):
            raise UsageError(f"effect '{point.name}': {point.value} is no subclass of Effect")
        own = getattr(kind, "name", None)
        if own != point.name:
            raise UsageError(f"effect '{point.name}': {point.value} has another name, {own!r}")
        if not hasattr(kind, "covariates"):
            raise UsageError(
                f"effect '{point.name}' of {point.value} declares neither covariates nor needs that "
                f"name one: give it covariates, some of {', '.join(COVARIATES)}, or () for a constant"
            )
        unknown = [word for word in kind.covariates if word not in COVARIATES]
        if unknown:
            raise UsageError(
                f"effect '{point.name}' of {point.value}: no covariate is called '{unknown[0]}'; "
                f"name some of {', '.join(COVARIATES)}"
            )
        if point.name in found and found[point.name] is not kind:
            raise UsageError(f"effect '{point.name}' of {point.value}: the name is taken")
        found[point.name] = kind
    if part is None:
        return found
    if part in gyro_terms.OfGyro.parts:
        found["outlier_dwell"] = gyro_terms.GyroOutlierDwell
    return {name: kind for name, kind in found.items() if part in kind.parts}


@cache
def _installed(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the entry points of effects in the packages on an import path.

    The result is cached, because reading it takes long.
    """
    return tuple(entry_points(group=ENTRY_POINT_GROUP))


def effect(name: str, axes: Sequence[str] = ("x", "y"), **choices: int) -> Effect:
    """Create an effect by its name, with its axes and choices.

    Parameters
    ----------
    name : str
        One of `catalogue()`.
    axes : sequence of str
        Axes of the effect; ignored for an effect without a choice of axes, such as one of the stage.
    choices : int
        Other fields of the effect than its axes: `dwell` of `position_slip` and `outlier_dwell`, `degree`
        of `bias_temperature`, `cycles` of `stage_periodic`.

    Raises
    ------
    UsageError
        No effect has this name (the message has the nearest), or axes or choices are not possible.
    """
    kind = BUILT_IN.get(name) or _kind(name)
    wrong = [choice for choice in choices if choice not in kind.choices()]
    if wrong:
        raise UsageError(f"{name} has no choice '{wrong[0]}'; it has {', '.join(kind.choices()) or 'none'}")
    return kind(tuple(axes) if kind.by_axis else (), **choices)


def constant_effect(axes: Sequence[str]) -> Effect:
    """Return the effect that adds a constant offset to each of these axes: the catalogue's bias."""
    return next(kind for kind in BUILT_IN.values() if kind.prior == "constant")(tuple(axes))


def _kind(name: str) -> type[Effect]:
    known = catalogue()
    if name not in known:
        raise UsageError(f"no effect is called '{name}'; {suggest(name, sorted(known))}")
    return known[name]


def parse_effect(text: str, axes: Sequence[str] = ("x", "y")) -> tuple[Effect, Floats]:
    """Return an effect and its parameter values from the text of a command-line option.

    Without values, as in `quadratic`, all parameters have their typical size. `quadratic:k2_x=2.5` sets the
    named parameters; other amplitudes are zero, shapes (such as time constants) stay typical. Choices are
    given in the same list, such as `dwell` in `position_slip:dwell=3,slip=0.1`. A parameter of the z axis
    adds z to the axes of the effect.

    Parameters
    ----------
    text : str
        `name` or `name:parameter=value,parameter=value`.
    axes : sequence of str
        Axes of the effect.

    Returns
    -------
    effect : Effect
        The effect with its axes and choices.
    values : (p,) float
        Values of `effect.parameters`, in their order and units.

    Raises
    ------
    UsageError
        Unknown effect or parameter (the message lists the known ones), a value that is no number, is given
        twice, or is outside its physical bounds.
    """
    name, colon, listed = (part.strip() for part in text.partition(":"))
    kind = BUILT_IN.get(name) or _kind(name)
    given: dict[str, float] = {}
    choices: dict[str, int] = {}
    for item in listed.split(",") if colon else ():
        key, equals, value = (part.strip() for part in item.partition("="))
        if not (key and equals and value):
            raise UsageError(f"effect '{text}': write {name}:parameter=value, not '{item.strip()}'")
        if key in given or key in choices:
            raise UsageError(f"effect '{text}': {key} is given twice")
        try:
            if key in kind.choices():
                choices[key] = int(value)
            else:
                given[key] = float(value)
        except ValueError:
            wanted = "whole number" if key in kind.choices() else "number"
            raise UsageError(f"effect '{text}': {key} is a {wanted}, not '{value}'") from None

    made = effect(name, axes, **choices)
    if kind.by_axis and any(key not in _names(made) for key in given):
        in_space = effect(name, AXES, **choices)
        if all(key in _names(in_space) for key in given):
            made = in_space
    return made, made.defaults(given, others="zero" if given else "typical")


def _names(made: Effect) -> set[str]:
    return {parameter.name for parameter in made.parameters}


__all__ = [
    "AXES",
    "BUILT_IN",
    "COVARIATES",
    "ENTRY_POINT_GROUP",
    "Conditions",
    "Effect",
    "Enters",
    "Parameter",
    "catalogue",
    "effect",
    "parse_effect",
]
