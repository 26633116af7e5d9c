"""An effect that a user writes as a formula in the covariates, such as `mine_x = (T - 25)**2 * gx`.

The formula has one amplitude for each axis on its left side. Python's `ast` module parses the right side,
and each node of the tree is translated by a table of allowed nodes. No formula is executed as Python,
so no name in it reaches a Python object.

>>> from adis_gonio.model.effects.formula import formula_effect
>>> made = formula_effect("mine_x = (T - 25)**2 * gx", "mg")
>>> made.name, made.axes, made.needs, [parameter.name for parameter in made.parameters]
('mine', ('x',), ('temperature_c',), ['mine_x'])
"""

from __future__ import annotations

import ast
import functools
import math
import operator
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.model.effects.base import AXES, Conditions, LinearAxisEffect, Parameter
from adis_gonio.model.records import MG_PER_G

Column = Callable[[Floats, Conditions], Floats]
"""Function of ideal readings (n, axes) and conditions of n rows; its value is (n,) or a constant."""


COVARIATES_OF_FORMULAS: dict[str, tuple[str, str, float]] = {
    **dict.fromkeys(("gx", "gy", "gz"), ("reading", "", 0.0)),
    "angle": ("angle", "angle_rad", 180 / math.pi),
    "t": ("time", "time_s", 1 / 60),
    "T": ("temperature", "temperature_c", 1.0),
    "V": ("supply", "supply_v", 1.0),
    "approach": ("approach", "approach", 1.0),
}
"""Covariates by their names in formulas: word of `COVARIATES`, field of `Conditions`, factor to the unit of
the formula (degrees, minutes, °C, V). gx, gy and gz are the components of g."""


def _covariate(name: str) -> Column:
    """Return the function that gives a covariate of a formula by its name.

    It raises `UsageError` if the session did not record the covariate. A component of g is the ideal
    reading in g; gyros have the readings of the accelerometers among their conditions instead.
    """
    _, field, scale = COVARIATES_OF_FORMULAS[name]

    def value(ideal: Floats, conditions: Conditions) -> Floats:
        if field:
            return scale * conditions.covariate(field)
        g = ideal / MG_PER_G if conditions.force_g is None else conditions.force_g
        axis = AXES.index(name[1])
        if axis >= g.shape[1]:
            raise UsageError(f"the session does not record {name}")
        return np.asarray(g[:, axis])

    return value


_FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "exp", "log", "sqrt", "sign")},
    "abs": np.abs,
}
_OF_SEVERAL: dict[str, Callable[[Any, Any], Any]] = {"min": np.minimum, "max": np.maximum}
_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: np.divide,
    ast.Pow: np.power,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
_KNOWN = (*COVARIATES_OF_FORMULAS, "pi", *_FUNCTIONS, *_OF_SEVERAL)
_MOST_CHARACTERS = 200
EXAMPLE = "write NAME_AXIS = FORMULA, such as 'mine_x = (T - 25)**2 * gx'"


@dataclass(frozen=True)
class FormulaEffect(LinearAxisEffect):
    """Base class of the effects that formulas define: amplitude times formula, for each axis."""

    not_corrected = "is a formula of the user, which a calibration cannot name"
    formula: ClassVar[str]
    value: ClassVar[Column]

    def __reduce__(self) -> tuple[Any, ...]:
        return formula_effect, (self.formula, self.coefficients[0].unit)

    def basis(self, axis: int, ideal: Floats, conditions: Conditions) -> tuple[Floats, ...]:
        """Return the value (n,) of the formula, equal on every axis; NaN or infinite if undefined."""
        with np.errstate(all="ignore"):
            value = type(self).value(ideal, conditions)
        return (np.broadcast_to(np.asarray(value, dtype=float), len(ideal)),)


def formula_effect(text: str, unit: str) -> FormulaEffect:
    """Return the effect that a formula `NAME_AXIS = EXPRESSION` adds to the readings of its axes.

    Parameters
    ----------
    text : str
        Formula. AXIS is one letter of x, y, z or several. The expression has the covariates
        `COVARIATES_OF_FORMULAS`, numbers, pi, + - * / **, and sin, cos (of radians), exp, log, sqrt, abs,
        sign, min, max.
    unit : str
        Unit of the readings. It is also stated as the unit of the amplitude, as for a dimensionless
        expression.

    Raises
    ------
    UsageError
        `text` is no such formula; the message has the place of the error.
    """
    if len(text) > _MOST_CHARACTERS:
        raise UsageError(f"formula '{text[:20]}…' has {len(text)} characters: at most {_MOST_CHARACTERS}")
    if not text.isprintable():
        raise UsageError(f"formula {text!a}: it holds a character that cannot be printed")
    left, _, right = text.partition("=")
    found = re.fullmatch(r"([A-Za-z][A-Za-z0-9_]*)_([xyz]{1,3})", left.strip())
    if found is None or len(set(found[2])) < len(found[2]):
        raise UsageError(f"formula '{text}': '{left.strip()}' names no axis; {EXAMPLE}")
    source = _Source(text, len(left) + 1 + len(right) - len(right.lstrip()))
    value = source.translated(source.parsed())
    name, axes = found[1], tuple(found[2])
    used = [COVARIATES_OF_FORMULAS[word] for word in source.names]
    kind = type(
        name,
        (FormulaEffect,),
        {
            "name": name,
            "cause": f"Formula of the user: {text.strip()}.",
            "formula": text,
            "covariates": tuple(dict.fromkeys(word for word, _, _ in used)),
            "needs": tuple(field for _, field, _ in used if field not in ("", "time_s")),
            "coefficients": (Parameter(name, unit, -math.inf, math.inf, 1.0),),
            "value": staticmethod(value),
            "__module__": __name__,
        },
    )
    made: FormulaEffect = kind(axes)
    return made


class _Source:
    """Translator of a formula: its text, the start of the expression, and the covariates found in it."""

    def __init__(self, text: str, begin: int) -> None:
        self.text, self.begin, self.names = text, begin, dict[str, None]()

    def parsed(self) -> ast.expr:
        """Parse the expression and return its syntax tree."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return ast.parse(self.text[self.begin :], mode="eval").body
        except SyntaxError as error:
            raise self.error("this is no expression", (error.offset or 1) - 1) from None
        except (ValueError, MemoryError, RecursionError):
            raise self.error("this cannot be parsed", 0) from None

    def error(self, why: str, place: int | ast.AST) -> UsageError:
        """Return the error to raise for the reason `why`, with the number of the character in its message.

        `place` is the index of the character in the expression, or the node of the syntax tree.
        """
        if isinstance(place, ast.AST):
            # Nodes count bytes of UTF-8.
            before = self.text[self.begin :].encode()[: getattr(place, "col_offset", 0)]
            place = len(before.decode(errors="ignore"))
        return UsageError(f"formula '{self.text}': {why} (character {self.begin + place + 1})")

    def translated(self, node: ast.expr) -> Column:
        """Return the function that computes the value of a node of the syntax tree."""
        match node:
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return self.constant(number)
            case ast.Name(id="pi"):
                return self.constant(math.pi)
            case ast.Name(id=name) if name in COVARIATES_OF_FORMULAS:
                self.names[name] = None
                return _covariate(name)
            case ast.Name(id=name):
                raise self.error(f"no covariate is called '{name}'; {suggest(name, _KNOWN)}", node)
            case ast.UnaryOp(op=sign, operand=inner) if type(sign) in _OPERATORS:
                return self.applied(_OPERATORS[type(sign)], inner)
            case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
                return self.applied(_OPERATORS[type(sign)], left, right)
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self.called(node, name, arguments)
        allowed = f"use numbers, + - * / ** and {', '.join(_KNOWN)}"
        raise self.error(f"'{ast.unparse(node)}' is not allowed: {allowed}", node)

    def constant(self, number: float) -> Column:
        """Return the function that computes a constant: it returns `number`."""
        value = np.float64(number)  # an integer of 200 characters is below the largest
        return lambda ideal, conditions: np.asarray(value)

    def called(self, node: ast.expr, name: str, arguments: list[ast.expr]) -> Column:
        """Return the function that computes a call in the expression, such as `sin(t)` or `max(gx, 0)`."""
        if name in _FUNCTIONS and len(arguments) == 1:
            return self.applied(_FUNCTIONS[name], arguments[0])
        if name in _OF_SEVERAL and len(arguments) > 1:
            of_two = _OF_SEVERAL[name]
            return self.applied(lambda *values: functools.reduce(of_two, values), *arguments)
        if name in _FUNCTIONS or name in _OF_SEVERAL:
            many = "one argument" if name in _FUNCTIONS else "two arguments or more"
            raise self.error(f"{name} takes {many}, not {len(arguments)}", node)
        raise self.error(f"no function is called '{name}'; {suggest(name, _KNOWN)}", node)

    def applied(self, function: Callable[..., Any], *nodes: ast.expr) -> Column:
        """Return the function that applies `function` to the values of the nodes."""
        parts = [self.translated(node) for node in nodes]
        return lambda ideal, conditions: function(*(part(ideal, conditions) for part in parts))
