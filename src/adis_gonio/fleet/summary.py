"""What a fleet says: parameters, effects, and who stands out; by columns, so that 100 000 rows are quick.

>>> from adis_gonio.fleet import read_parquet, summarise
>>> summarise(read_parquet("fleet.parquet")).as_dict()["sessions"]  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import HIDDEN, INLINE, JsonRecord, key
from adis_gonio.base.uncertainty import OUTLYING, wilson
from adis_gonio.fleet.columns import Row, Table, table_of
from adis_gonio.fleet.outlying import (
    Codes,
    FamilyOfTests,
    Test,
    by_rank,
    by_share,
    by_unit,
    outlying,
)
from adis_gonio.fleet.record import QUANTITIES
from adis_gonio.fleet.statistics import Beyond, Distribution, Repeats, beyond, repeats

FORMAT = "adis-gonio fleet summary 1"
KINDS = ("unit", "stage", "operator")
GROUPS = {"unit": "serial", "stage": "stage", "operator": "operator"}
"""Column that names the groups of a kind."""
_ALIKE = 0.9
"""Share of common sessions from which on two groups are the same to a fleet."""
_RMS = "angle"
"""A root mean square: its logarithm is compared, and its u is that of an angle, not its own."""


@dataclass(frozen=True)
class QuantitySummary(JsonRecord):
    """One quantity over all sessions that determine it.

    The JSON document is one value of `parameters`.

    Attributes
    ----------
    name, unit : str
    distribution : Distribution
    beyond : Beyond or None
        None where fewer than three sessions state a u.
    repeats : Repeats or None
        None where no unit has two sessions.
    """

    name: str = field(metadata=HIDDEN)
    unit: str
    distribution: Distribution = field(metadata=INLINE)
    beyond: Beyond | None = field(metadata=key("beyond_u"))
    repeats: Repeats | None


@dataclass(frozen=True)
class Frequency:
    """How many of the traced sessions showed an effect."""

    effect: str
    found: int
    traced: int

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of 95 % for the share."""
        return wilson(self.found, self.traced)

    def as_dict(self) -> dict[str, Any]:
        """One entry of `effects`."""
        share = self.found / self.traced
        counts = {"found": self.found, "traced": self.traced, "share": share}
        return {"effect": self.effect, **counts, "wilson_95": list(self.interval)}


@dataclass(frozen=True)
class Outlying(JsonRecord):
    """A unit, a stage or an operator that stands out.

    The JSON document is one entry of `outlying.found`.

    Attributes
    ----------
    kind : {"unit", "stage", "operator"}
    name : str
        Of a session without a serial number its path.
    quantity, unit : str
        Parameter with its unit, or `effect NAME`.
    z, p_value, adjusted_p : float
        Robust z (or normal deviate), its p-value, and that times the number of tests.
    value, others : float
        Median here and of the others; for an effect the share that shows it.
    n : int
        Sessions of the unit; units that the stage or the operator had.
    same_sessions_as : tuple of str
        Other groups of which the fleet cannot tell whether it is they.
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
    same_sessions_as: tuple[str, ...] = ()


@dataclass(frozen=True)
class Summary:
    """Summary of a fleet.

    Attributes
    ----------
    sessions : mapping of str to int
        Counts: `n`, `ok`, `failed`, `traced`, `adequate`, `doubted`, `units`, `stages`, `operators`.
    failures : tuple of (str, str)
        Path and reason.
    parameters : tuple of QuantitySummary
    effects : tuple of Frequency
        The most frequent first.
    tests : int
        Comparisons among which those in `outlying` were found.
    outlying : tuple of Outlying
        The oddest first.
    """

    sessions: dict[str, int]
    failures: tuple[tuple[str, str], ...]
    parameters: tuple[QuantitySummary, ...]
    effects: tuple[Frequency, ...]
    tests: int
    outlying: tuple[Outlying, ...]
    table: Table = field(repr=False, compare=False, default_factory=dict)
    """What it was made of, for figures."""

    def as_dict(self) -> dict[str, Any]:
        """The JSON document."""
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


def summarise(rows: Sequence[Row] | Any) -> Summary:
    """Summary of rows (`adis_gonio.fleet.columns.COLUMNS`) or of a pyarrow table with these columns.

    The same whatever the order of the rows.
    """
    table = table_of(rows)
    ok = table["status"] == "ok"
    failed = np.flatnonzero(~ok)
    groups = {kind: _codes(table[column]) for kind, column in GROUPS.items()}
    traced = ok & (table["traced"] == 1)
    tests, found = outlying(_comparisons(table, groups, traced))
    return Summary(
        _counts(table, groups, ok, traced),
        tuple((str(table["path"][k]), str(table["reason"][k])) for k in failed),
        tuple(_parameters(table, groups["unit"])),
        tuple(_frequencies(table, int(traced.sum()))),
        tests,
        tuple(_named(test, tests, table, groups) for test in found),
        table,
    )


def _codes(names: Any) -> Codes:
    """Number of each name; -1 where there is none."""
    _, codes = np.unique(names, return_inverse=True)
    return np.where(names == "", -1, codes)


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


def _doubt(table: Table, name: str) -> Floats:
    """Standard uncertainty (n,) of the values themselves; NaN where nothing states it."""
    return np.full(len(table[name]), np.nan) if name == _RMS else table[f"{name}_u"]


def _parameters(table: Table, unit: Codes) -> list[QuantitySummary]:
    found = []
    for name in _quantities(table):
        values, u, dof = table[name], _doubt(table, name), table[f"{name}_dof"]
        dof = np.where(np.isfinite(dof), dof, np.inf)
        known = values[np.isfinite(values)]
        by_u = beyond(values, u, dof), repeats(values, u, dof, unit)
        found.append(QuantitySummary(name, QUANTITIES[name], Distribution.of(known), *by_u))
    return found


def _effects(table: Table) -> list[tuple[str, Any]]:
    """Each effect found with the rows (n,) that show it, by name."""
    names, index = np.unique(table["effect_name"], return_inverse=True)
    shown = []
    for k, name in enumerate(names):
        flags = np.zeros(len(table["path"]), dtype=bool)
        flags[table["effect_row"][index == k]] = True
        shown.append((str(name), flags))
    return shown


def _frequencies(table: Table, traced: int) -> list[Frequency]:
    found = [Frequency(name, int(flags.sum()), traced) for name, flags in _effects(table)]
    return sorted(found, key=lambda one: (-one.found, one.effect))


def _comparisons(table: Table, groups: dict[str, Codes], traced: Any) -> list[FamilyOfTests]:
    """All units, stages and operators by all parameters and effects."""
    unit = groups["unit"]
    made = []
    for name in _quantities(table):
        values = _compared(name, table[name])
        made.append(by_unit(name, values, _doubt(table, name), unit))
        made += [by_rank(kind, name, values, groups[kind], unit) for kind in KINDS[1:]]
    for effect, shown in _effects(table):
        made += [by_share(kind, effect, shown, np.where(traced, groups[kind], -1), unit) for kind in KINDS]
    return made


def _compared(name: str, values: Floats) -> Floats:
    if name != _RMS:
        return values
    return np.log(values, out=np.full(len(values), np.nan), where=values > 0)


def _named(test: Test, tests: int, table: Table, groups: dict[str, Codes]) -> Outlying:
    codes = groups[test.kind]
    rows = np.flatnonzero(codes == test.code) if test.code >= 0 else np.array([-1 - test.code])
    name = str(table[GROUPS[test.kind] if test.code >= 0 else "path"][rows[0]])
    value, others = (
        (float(np.exp(one)) if test.quantity == _RMS else float(one)) for one in (test.value, test.others)
    )
    return Outlying(
        test.kind,
        name,
        test.quantity,
        "1" if test.quantity.startswith("effect ") else QUANTITIES[test.quantity],
        float(test.z),
        float(test.p_value),
        min(1.0, tests * float(test.p_value)),
        value,
        others,
        test.n,
        _twins(test.kind, rows, table, groups) if len(rows) > 1 else (),
    )


def _twins(kind: str, rows: Any, table: Table, groups: dict[str, Codes]) -> tuple[str, ...]:
    """Groups of another kind that consist of nearly the same sessions."""
    found = []
    for other in KINDS:
        codes = groups[other]
        here, count = np.unique(codes[rows], return_counts=True)
        for code, common in zip(here, count, strict=True):
            union = len(rows) + int((codes == code).sum()) - common
            if other != kind and code >= 0 and common >= _ALIKE * union:
                found.append(f"{other} {table[GROUPS[other]][codes == code][0]}")
    return tuple(found)
