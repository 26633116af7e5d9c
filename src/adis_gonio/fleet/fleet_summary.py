"""Summary of a fleet, computed column by column to be quick: parameters, effects, outlying groups."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import (
    NAMES,
    count_decimals,
    counted,
    format_fixed,
    format_number,
    format_p,
    format_percent,
    format_unit,
    with_unit,
)
from adis_gonio.base.uncertainty import OUTLYING, wilson
from adis_gonio.fleet.fleet_statistics import (
    FEWEST,
    FEWEST_UNITS,
    Codes,
    Distribution,
    FamilyOfTests,
    Test,
    by_rank,
    by_share,
    by_unit,
    outlying,
    unshared_u,
)
from adis_gonio.fleet.session_record import QUANTITIES
from adis_gonio.fleet.session_table import Row, Table, table_of

FORMAT = "adis-gonio fleet summary 1"
KINDS = ("unit", "stage", "operator")
GROUPS = {"unit": "serial", "stage": "stage", "operator": "operator"}
"""Name of the table's column that names the groups, by kind of group."""
_RMS = "angle"
"""Name of the quantity that is the rms error of the angle.

Its logarithm is compared between groups. It has no standard uncertainty here, because the stated u is that
of a displayed angle.
"""


class Frequency(JsonRecord):
    """Number of traced sessions in which an effect was found, and number of all traced sessions."""

    document_keys = ("effect", "found", "traced", "share", "wilson_95")

    effect: str
    found: int
    traced: int

    @property
    def share(self) -> float:
        """Share of the traced sessions in which the effect was found."""
        return self.found / self.traced

    @property
    def wilson_95(self) -> tuple[float, float]:
        """Both ends of the 95 % interval of the share of sessions with the effect, by Wilson's method."""
        return wilson(self.found, self.traced)


class Outlying(JsonRecord):
    """A sensor, stage or operator with sessions that differ significantly from the others.

    The JSON document is one entry of `outlying.found`.

    Attributes
    ----------
    kind : {"unit", "stage", "operator"}
        Kind of group; a unit is one sensor.
    name : str
        Name of the group; the path of a session without a serial number.
    quantity, unit : str
        Parameter with its unit, or `effect NAME`.
    z, p_value, adjusted_p : float
        Difference from the others as robust z or normal deviate, its p-value, and the p-value times the
        number of tests.
    value, others : float
        Median of the parameter in the group and in the others; for an effect the share of sessions or
        sensors that show it.
    n : int
        Number of sessions of the unit, or of units of the stage or operator.
    """

    kind: str
    name: str
    quantity: str
    unit: str
    z: float
    p_value: float
    adjusted_p: float
    value: float
    others: float
    n: int


@dataclass(frozen=True)
class Summary:
    """Statistics of a fleet: counts, parameters, effects, and outlying groups.

    Attributes
    ----------
    sessions : mapping of str to int
        Number of sessions: all (`n`), with a result (`ok`), `failed`, `traced`, with an `adequate` model,
        and with doubts about the result (`doubted`); and number of sensors (`units`), `stages` and
        `operators`.
    failures : tuple of (str, str)
        Path of each failed session, and the reason.
    parameters : tuple of Distribution
        Statistics of each quantity.
    effects : tuple of Frequency
        Number of sessions with each effect, the most frequent first.
    tests : int
        Number of comparisons of a group with the others.
    outlying : tuple of Outlying
        Outlying groups, the smallest p-value first.
    """

    sessions: dict[str, int]
    failures: tuple[tuple[str, str], ...]
    parameters: tuple[Distribution, ...]
    effects: tuple[Frequency, ...]
    tests: int
    outlying: tuple[Outlying, ...]
    table: Table = field(repr=False, compare=False, default_factory=dict)
    """Columns of the table of all sessions, for figures."""

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document of the summary."""
        return {
            "format": FORMAT,
            "software": f"adis-gonio {__version__}",
            "sessions": self.sessions,
            "failures": [{"path": path, "reason": reason} for path, reason in self.failures],
            "parameters": {one.name: one.as_dict() for one in self.parameters},
            "effects": [one.as_dict() for one in self.effects],
            "outlying": {
                "level": OUTLYING,
                "tests": self.tests,
                "found": [one.as_dict() for one in self.outlying],
            },
        }


def summarise(rows: Sequence[Row]) -> Summary:
    """Summarise the fleet with the sessions in rows, in any order.

    Each row has the columns `session_table.COLUMNS`.
    """
    table = table_of(rows)
    ok = table["status"] == "ok"
    failed = np.flatnonzero(~ok)
    # Equal names get equal numbers, and an empty name gets -1.
    groups = {
        kind: np.where(table[column] == "", -1, np.unique(table[column], return_inverse=True)[1])
        for kind, column in GROUPS.items()
    }
    traced = ok & (table["traced"] == 1)
    frequencies = [Frequency(name, int(flags.sum()), int(traced.sum())) for name, flags in _effects(table)]
    tests, found = outlying(_comparisons(table, groups, traced))
    return Summary(
        _counts(table, groups, ok, traced),
        tuple((str(table["path"][k]), str(table["reason"][k])) for k in failed),
        tuple(Distribution.of(name, QUANTITIES[name], table[name]) for name in _quantities(table)),
        tuple(sorted(frequencies, key=lambda one: (-one.found, one.effect))),
        tests,
        tuple(_named(test, tests, table, groups) for test in found),
        table,
    )


def _counts(table: Table, groups: dict[str, Codes], ok: Any, traced: Any) -> dict[str, int]:
    counts = {
        "n": len(ok),
        "ok": ok.sum(),
        "failed": (~ok).sum(),
        "traced": traced.sum(),
        "adequate": (traced & (table["adequate"] == 1)).sum(),
        "doubted": (table["doubts"] != "").sum(),
        **{f"{kind}s": len(np.unique(codes[codes >= 0])) for kind, codes in groups.items()},
        "without_serial": (ok & (groups["unit"] < 0)).sum(),
    }
    return {name: int(count) for name, count in counts.items()}


def _quantities(table: Table) -> list[str]:
    return [name for name in QUANTITIES if name in table and np.isfinite(table[name]).any()]


def _own_u(table: Table, name: str) -> Floats:
    """Return the standard uncertainties (n,) of a quantity for comparisons of sessions; NaN if unknown.

    If all sessions have the certificate of one stage, its errors are left out, since they change all values
    together. `name` is the quantity.
    """
    if name == _RMS:
        return np.full(len(table[name]), np.nan)
    u = table[f"{name}_u"].copy()
    rows = np.isfinite(u) & np.isfinite(table[name])
    if rows.any():
        u[rows] = unshared_u(u[rows], table["stage_curve"][rows], table[f"{name}_stage"][rows])
    return u


def _effects(table: Table) -> list[tuple[str, Any]]:
    """List the effects found in any session by name, each with a mask (n,) of the sessions that show it."""
    names, index = np.unique(table["effect_name"], return_inverse=True)
    shown = []
    for k, name in enumerate(names):
        flags = np.zeros(len(table["path"]), dtype=bool)
        flags[table["effect_row"][index == k]] = True
        shown.append((str(name), flags))
    return shown


def _comparisons(table: Table, groups: dict[str, Codes], traced: Any) -> list[FamilyOfTests]:
    """Make the tests of every sensor, stage and operator against the others.

    They cover all parameters and effects. `groups` has the number of each session's group by kind; `traced`
    (n,) is True for a traced session.
    """
    unit = groups["unit"]
    made = []
    for name in _quantities(table):
        values = table[name]
        if name == _RMS:
            values = np.log(values, out=np.full(len(values), np.nan), where=values > 0)
        made.append(by_unit(name, values, _own_u(table, name), unit))
        made += [by_rank(kind, name, values, groups[kind], unit) for kind in KINDS[1:]]
    for effect, shown in _effects(table):
        made += [by_share(kind, effect, shown, np.where(traced, groups[kind], -1), unit) for kind in KINDS]
    return made


def _named(test: Test, tests: int, table: Table, groups: dict[str, Codes]) -> Outlying:
    if test.code >= 0:
        name = str(table[GROUPS[test.kind]][groups[test.kind] == test.code][0])
    else:  # a session without a serial number counts as a unit
        name = str(table["path"][-1 - test.code])
    known = {field: value for field, value in vars(test).items() if field != "code"}
    if test.quantity == _RMS:  # compared by its logarithm
        known |= {"value": math.exp(test.value), "others": math.exp(test.others)}
    unit = "1" if test.quantity.startswith("effect ") else QUANTITIES[test.quantity]
    return Outlying(**known, name=name, unit=unit, adjusted_p=min(1.0, tests * test.p_value))


PARAMETER_HEAD = ["quantity", "unit", "sessions", "median", "5 %", "95 %", "mean", "robust sd"]
PARAMETER_NOTES = ("angle: error of the angle, rms over held-out dwells.",)
EFFECT_HEAD = ["effect", "sessions", "share", "95 % interval"]
OUTLYING_HEAD = ["group", "quantity", "here", "the others", "z", "p × tests", "of"]


def headline(summary: Summary) -> str:
    """Return the first sentence of a summary of the fleet.

    An example is `998 of 1000 sessions have a result, of 334 units on 4 stages.`.
    """
    n = summary.sessions
    verb = "has" if 1 in (n["ok"], n["n"]) else "have"
    text = f"{n['ok']} of {counted(n['n'], 'session')} {verb} a result"
    who = [
        f"of {counted(n['units'], 'unit')}" if n["units"] else "",
        f"on {counted(n['stages'], 'stage')}" if n["stages"] else "",
        f"by {counted(n['operators'], 'operator')}" if n["operators"] else "",
    ]
    known = " ".join(filter(None, who))
    return f"{text}, {known}." if known else f"{text}."


def remarks(summary: Summary) -> list[str]:
    """Return sentences on the numbers of failed, traced, doubtful and unnamed sessions.

    An unnamed session has no serial number.
    """
    n = summary.sessions
    sentences = []
    if n["failed"]:
        sentences.append(f"{counted(n['failed'], 'session')} failed.")
    if n["traced"]:
        sentences.append(f"{n['traced']} were traced; the model is adequate in {n['adequate']} of them.")
    else:
        sentences.append("No session was traced: effects are not known.")
    if n["doubted"]:
        sentences.append(
            f"{counted(n['doubted'], 'session')} contain readings that the operator kept against a warning."
        )
    if n["without_serial"]:
        sentences.append(
            f"{counted(n['without_serial'], 'session')} without a serial number: each counts as a unit."
        )
    return sentences


def parameter_rows(summary: Summary) -> list[list[str]]:
    """Return the rows of the table of parameters, with the columns `PARAMETER_HEAD`."""
    rows = []
    for one in summary.parameters:
        q, sd = one.quantiles, one.robust_sd
        values = (q["50"], q["5"], q["95"], one.mean)
        rows.append(
            [
                NAMES.get(one.name, one.name),
                format_unit(one.unit),
                str(one.n),
                # As many decimals as show two digits of the standard deviation.
                *(format_fixed(v, count_decimals(sd)) if sd > 1e-6 else format_number(v) for v in values),
                format_number(sd if one.n > 1 else None, 2),
            ]
        )
    return rows


def effect_rows(summary: Summary) -> list[list[str]]:
    """Return the rows of the table of effects, with the columns `EFFECT_HEAD`."""
    rows = []
    for one in summary.effects:
        share, low, high = map(format_percent, (one.share, *one.wilson_95))
        rows.append([one.effect, f"{one.found} of {one.traced}", share, f"{low} to {high}"])
    return rows


def outlying_rows(summary: Summary) -> list[list[str]]:
    """Return the rows of the table of outlying groups, with the columns `OUTLYING_HEAD`."""
    rows = []
    for one in summary.outlying:
        values = [with_unit(format_number(value), one.unit) for value in (one.value, one.others)]
        if one.quantity.startswith("effect "):
            values = [format_percent(one.value), format_percent(one.others)]
        p = format_number(one.adjusted_p, 2)
        if one.adjusted_p < 1e-12:
            p = format_p(one.adjusted_p).split("p\u00a0")[1]
        count = counted(one.n, "session" if one.kind == "unit" else "unit")
        quantity = NAMES.get(one.quantity, one.quantity)
        rows.append([f"{one.kind} {one.name}", quantity, *values, format_fixed(one.z, 1), p, count])
    return rows


def outlying_text(summary: Summary) -> str:
    """Return a sentence on the number of comparisons and the probability of naming a group by chance."""
    if not summary.tests:
        return (
            f"Nothing could be compared: a comparison needs {FEWEST_UNITS} units, or {FEWEST} units on a"
            f" stage or with an operator and {FEWEST} elsewhere."
        )
    found = "" if summary.outlying else " No group is outlying."
    return (
        f"{counted(summary.tests, 'comparison')} of units, stages and operators with the rest of the fleet;"
        f" the probability of any false name is at most {format_percent(OUTLYING)} in all"
        f" (Bonferroni).{found}"
    )
