"""Summary of a fleet, computed column by column to be quick: parameters, effects, outlying groups.

A *unit* is one sensor, known by its serial number. It is compared with the other units by a robust z: its
distance from the median of the units, divided by the distance that scatter and its own u explain. A *stage*
or an *operator* is compared by ranks (normal scores) of a quantity over its units, and by the number of
units with an effect (hypergeometric distribution). All tests of a fleet share one probability of naming a
group by chance (Bonferroni). The most outlying group is named and removed before the others are compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri, stdtr
from scipy.stats import hypergeom, rankdata

from adis_gonio.base import __version__
from adis_gonio.base.arrays import MAD_TO_SD, Floats, robust_sd
from adis_gonio.base.jsonable import HIDDEN, JsonRecord, json_object
from adis_gonio.base.numbers import counted
from adis_gonio.base.uncertainty import OUTLYING, wilson
from adis_gonio.fleet.session_record import ANGLE, QUANTITIES, Row

PROBABILITIES = (0.025, 0.05, 0.25, 0.5, 0.75, 0.95, 0.975)

_LEAST_SHARE = 1e-6
"""Smallest share of the variance of a value that is taken as not shared by sessions on one stage."""


def unshared_u(u: Floats, curves: Iterable[str], influence: Iterable[Sequence[float]]) -> Floats:
    """Return the standard uncertainties (n,) of the values of n sessions without the part that all share.

    They apply to differences between the sessions. `u` (n,) are the full standard uncertainties. A part is
    shared if all sessions have the certificate of one stage: `curves` (n,) are digests of the certificates,
    `influence` (n, k) the change of each value by one standard uncertainty of each of the k independent
    errors of the certificate. Otherwise `u` is returned unchanged.
    """
    if len(set(curves)) > 1 or not all(map(len, influence)):
        return u
    moves = np.array(list(influence), dtype=float)  # (n, k)
    common = moves.mean(axis=0)
    variance = u**2 - (moves**2).sum(axis=1) + ((moves - common) ** 2).sum(axis=1)
    return np.asarray(np.sqrt(np.maximum(variance, _LEAST_SHARE * u**2)))


class Distribution(JsonRecord):
    """Statistics of the values of one quantity over the fleet.

    The JSON document is one value of `parameters`.

    Attributes
    ----------
    name, unit : str
        Name and unit of the quantity.
    n : int
        Number of sessions with the quantity.
    mean, sd, robust_sd : float
        Mean, standard deviation (NaN for one value), and standard deviation from the median absolute
        deviation.
    quantiles : mapping of str to float
        Quantiles by probability in percent, such as `50`.
    low, high : float
        Smallest and largest value.
    values : (n,) float
        The values, for figures.
    """

    name: str = field(metadata=HIDDEN)
    unit: str
    n: int
    mean: float
    sd: float
    robust_sd: float
    quantiles: dict[str, float]
    low: float
    high: float
    values: Floats = field(metadata=HIDDEN, repr=False, compare=False)

    @classmethod
    def of(cls, name: str, unit: str, values: Floats) -> Distribution:
        """Compute the statistics of values (m,), NaN if unknown; at least one is finite."""
        values = values[np.isfinite(values)]
        probable = np.quantile(values, PROBABILITIES)
        quantiles = {f"{100 * p:g}": float(q) for p, q in zip(PROBABILITIES, probable, strict=True)}
        sd = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        middle, low, high = (float(find(values)) for find in (np.mean, np.min, np.max))
        return cls(name, unit, len(values), middle, sd, robust_sd(values), quantiles, low, high, values)


FEWEST_UNITS = 5
"""Smallest number of sensors in a fleet for a test for outlying sensors."""
FEWEST = 3
"""Smallest number of sessions or sensors that a group, and the rest of the fleet, must have for a test."""
_MAD_DOF = 0.42
"""Degrees of freedom of a robust z of n normal values, divided by n − ½.

Student's distribution then has the tails of z: simulated values exceed its quantiles of 10⁻³ to 3·10⁻⁵ at
most 1.1 times as often as stated, for n of 5 to 60.
"""

Codes = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Outlying(JsonRecord):
    """A sensor, stage or operator with sessions that differ significantly from the others.

    The JSON document is one entry of `outlying.found`.

    Attributes
    ----------
    kind : {"unit", "stage", "operator"}
        Kind of group; a unit is one sensor.
    code : int
        Number of the group (sensor, stage or operator), not in the JSON.
    quantity, unit : str
        Parameter with its unit, or `effect NAME`.
    z : float
        Robust z of the group (sensors), or the normal deviate that corresponds to the p-value.
    p_value : float
        Probability of at least this difference by chance: two-sided for parameters, one-sided (as many or
        more) for effects.
    value, others : float
        Median of the parameter in the group and in the others; for an effect the share of sessions or
        sensors that show it.
    n : int
        Number of sessions of the unit, or of units of the stage or operator.
    name : str
        Name of the group; the path of a session without a serial number.
    adjusted_p : float
        The p-value times the number of tests.
    """

    document_keys = (
        *("kind", "name", "quantity", "unit", "z"),
        *("p_value", "adjusted_p", "value", "others", "n"),
    )

    kind: str
    code: int
    quantity: str
    z: float
    p_value: float
    value: float
    others: float
    n: int
    name: str = ""
    unit: str = "1"
    adjusted_p: float = 1.0


@dataclass(frozen=True)
class FamilyOfTests:
    """Tests of all groups of one kind (sensors, stages or operators) for one quantity.

    Attributes
    ----------
    count : int
        Number of tests.
    find : callable
        Function that takes a significance level and returns the tests with a p-value below this level.
    """

    count: int
    find: Callable[[float], list[Outlying]]


def outlying(comparisons: Sequence[FamilyOfTests]) -> tuple[int, list[Outlying]]:
    """Count all tests, and list the significant tests, the smallest p-value first.

    The probability that any of all tests is significant by chance is at most 1 % (`OUTLYING`). Each entry
    of `comparisons` has the tests of one kind of group for one quantity.
    """
    total = sum(one.count for one in comparisons)
    passed = [test for one in comparisons if one.count for test in one.find(OUTLYING / total)]
    return total, sorted(
        passed, key=lambda test: (test.p_value, -abs(test.z), test.kind, test.quantity, test.code)
    )


def by_unit(quantity: str, values: Floats, u: Floats, unit: Codes) -> FamilyOfTests:
    """Test every sensor (by its serial number) against all sensors, by the median of its sessions.

    Parameters
    ----------
    quantity : str
        Name of the quantity.
    values, u, unit : (n,)
        Value of the quantity, its standard uncertainty, and the number of the sensor of each session.
    """
    good = np.isfinite(values)
    names, index, count = np.unique(unit[good], return_inverse=True, return_counts=True)

    def find(level: float) -> list[Outlying]:
        # One value per unit, with the root mean square of its u.
        median = _medians(values[good], index)
        # Sessions of a unit may share their error, so its u is not reduced by their number.
        doubt = np.sqrt(np.bincount(index, np.nan_to_num(u[good]) ** 2) / count)
        z, centre = robust_z(median, doubt)
        p = 2 * stdtr(_MAD_DOF * (len(names) - 0.5), -np.abs(z))
        return [
            Outlying("unit", int(names[k]), quantity, z[k], p[k], median[k], centre, int(count[k]))
            for k in np.flatnonzero(p < level)
        ]

    return FamilyOfTests(len(names) if len(names) >= FEWEST_UNITS else 0, find)


def robust_z(values: Floats, u: Floats) -> tuple[Floats, float]:
    """Return the robust z (n,) of values, and their median.

    z is the distance of each value from the median divided by √(τ² + u²), with the standard uncertainties
    `u` (n,). The scatter τ is chosen so that the median of |z| is 0.67, as in a normal distribution. It is
    practically 0 if u alone explains the distances.
    """
    centre = float(np.median(values))
    away = np.abs(values - centre)

    def unusual(tau: float) -> float:
        return float(np.median(away / np.sqrt(tau**2 + u**2))) - 1 / MAD_TO_SD

    # τ is at most the robust scatter without any u.
    most = robust_sd(values)
    least = 1e-6 * most
    explained = most == 0.0 or unusual(least) <= 0
    tau = least if explained else float(brentq(unusual, least, 1.001 * most))
    scale = np.sqrt(tau**2 + u**2)
    return np.divide(values - centre, scale, out=np.zeros_like(values), where=scale > 0), centre


def by_rank(kind: str, quantity: str, values: Floats, group: Codes, unit: Codes) -> FamilyOfTests:
    """Test each stage or operator against the others, by the ranks of the medians of its sensors.

    `kind` is `stage` or `operator`; `values`, `group` and `unit` are (n,): value of the quantity in each
    session, number of the group (negative if unknown), and number of the sensor.
    """
    good = np.isfinite(values) & (group >= 0)
    x, code = _by_unit(values[good], group[good], unit[good])
    return _stepwise(kind, quantity, x, code, _normal_scores, np.median)


def by_share(kind: str, effect: str, found: Flags, group: Codes, unit: Codes) -> FamilyOfTests:
    """Test every group by the number of its sensors with an effect in at least half of their sessions.

    If `kind` is `unit`, the sessions of each sensor are counted instead. `found` (n,) is True for a session
    that shows the effect; `group` (n,) is the number of its group, negative if unknown, and `unit` (n,) the
    number of its sensor.
    """
    good = group >= 0
    shown, code = found[good].astype(float), group[good]
    if kind != "unit":
        shown, code = _by_unit(shown, code, unit[good])
        shown = (shown >= 0.5).astype(float)
    return _stepwise(kind, f"effect {effect}", shown, code, _hypergeometric, np.mean)


def _by_unit(values: Floats, group: Codes, unit: Codes) -> tuple[Floats, Codes]:
    """Return the median of the values of each sensor in each group (m,), and the group of each median (m,).

    Many sessions of a sensor therefore count as one value. `values`, `group` and `unit` are (n,): the value
    of each session, and the numbers of its group and its sensor.
    """
    if not len(values):
        return values, group
    # Every pair of group and unit is one value.
    pairs, index = np.unique(np.stack([group, unit]), axis=1, return_inverse=True)
    return _medians(values, np.asarray(index).ravel()), pairs[0]


def _medians(values: Floats, index: Codes) -> Floats:
    """Return the median of the values (n,) of each group; `index` (n,) numbers the groups from 0.

    The numbers have no gaps.
    """
    return np.asarray(ndimage.median(values, index, np.arange(index.max() + 1)))


def _normal_scores(values: Floats, index: Codes, count: Codes) -> tuple[Floats, Floats]:
    """Return z and two-sided p-value of each group by Van der Waerden's test against the rest.

    `index` (n,) is the group of each value, `count` the number of values of each group.
    """
    n = len(values)
    score = ndtri(rankdata(values) / (n + 1))
    score -= score.mean()
    # Variance of the sum of `count` scores drawn without replacement.
    variance = count * (n - count) / (n * (n - 1)) * float(score @ score)
    z = np.divide(
        np.bincount(index, score), np.sqrt(variance), out=np.zeros(len(count)), where=variance > 0
    )
    return z, 2 * ndtr(-np.abs(z))


def _hypergeometric(values: Floats, index: Codes, count: Codes) -> tuple[Floats, Floats]:
    """Test if a group has more members with an effect than the rest, by the hypergeometric distribution.

    `values` (n,) is 1 for a member with the effect, `index` (n,) its group, `count` the size of each group.
    Returns, for each group, the normal deviate and the probability of as many members or more by chance.
    """
    here = np.bincount(index, values)
    p = np.minimum(hypergeom.sf(here - 1, len(values), int(values.sum()), count), 1.0)
    return -ndtri(np.maximum(p, 1e-300)), p


def _stepwise(
    kind: str,
    quantity: str,
    values: Floats,
    code: Codes,
    score: Callable[[Floats, Codes, Codes], tuple[Floats, Floats]],
    middle: Callable[[Floats], Any],
) -> FamilyOfTests:
    """Test each group against the rest, remove the most outlying group, and repeat without it.

    `values` (n,) are compared by their group `code` (n,). `score` returns z and p-value of each group,
    `middle` the figure that is reported for the values of a group, such as their median. `kind` and
    `quantity` name the kind of group and the compared quantity.
    """

    def find(level: float) -> list[Outlying]:
        x, groups = values, code
        tests: list[Outlying] = []
        while True:
            names, index, count = np.unique(groups, return_inverse=True, return_counts=True)
            able = _able(count)
            if not able.any():
                return tests
            z, p = score(x, index, count)
            # Of two groups that differ only from each other, the smaller one is the outlier.
            k = int(np.lexsort((names, count, np.where(able, p, 2.0)))[0])
            if not p[k] < level:
                return tests
            own = index == k
            middles = float(middle(x[own])), float(middle(x[~own]))
            tests.append(Outlying(kind, int(names[k]), quantity, z[k], p[k], *middles, int(count[k])))
            x, groups = x[~own], groups[~own]

    return FamilyOfTests(int(_able(np.unique(code, return_counts=True)[1]).sum()), find)


def _able(count: Codes) -> Flags:
    return np.asarray((count >= FEWEST) & (count.sum() - count >= FEWEST))


FORMAT = "adis-gonio fleet summary 1"
KINDS = ("unit", "stage", "operator")
GROUPS = {"unit": "serial", "stage": "stage", "operator": "operator"}
"""Name of the table's column that names the groups, by kind of group."""


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

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document of the summary."""
        return json_object(
            format=FORMAT,
            software=f"adis-gonio {__version__}",
            sessions=self.sessions,
            failures=[{"path": path, "reason": reason} for path, reason in self.failures],
            parameters={one.name: one for one in self.parameters},
            effects=self.effects,
            outlying={"level": OUTLYING, "tests": self.tests, "found": self.outlying},
        )


def summarise(rows: Sequence[Row]) -> Summary:
    """Summarise the fleet with the sessions in rows, in any order.

    Each row has the columns `session_record.COLUMNS`.
    """
    rows = sorted(rows, key=lambda row: row["path"] or "")
    known = {kind: _texts(rows, column) for kind, column in GROUPS.items()}
    # A session without a serial number is a unit of its own, which has the name of the file.
    named = known | {"unit": np.where(known["unit"] == "", _texts(rows, "path"), known["unit"])}
    names, groups = {}, {}
    for kind, texts in named.items():
        names[kind], codes = np.unique(texts, return_inverse=True)
        groups[kind] = np.where(texts == "", -1, codes)
    ok = _texts(rows, "status") == "ok"
    traced = ok & (_numbers(rows, "traced") == 1)
    counts = {
        "n": len(rows),
        "ok": ok.sum(),
        "failed": (~ok).sum(),
        "traced": traced.sum(),
        "adequate": (traced & (_numbers(rows, "adequate") == 1)).sum(),
        "doubted": (_texts(rows, "doubts") != "").sum(),
        **{f"{kind}s": len({*texts.tolist()} - {""}) for kind, texts in known.items()},
        "without_serial": (ok & (known["unit"] == "")).sum(),
    }
    values = {name: _numbers(rows, name) for name in QUANTITIES}
    values = {name: x for name, x in values.items() if np.isfinite(x).any()}
    effects = _effects(rows)
    frequencies = [Frequency(name, int(flags.sum()), int(traced.sum())) for name, flags in effects.items()]
    comparisons = [
        test for name, x in values.items() for test in _comparisons(name, x, _own_u(rows, name, x), groups)
    ]
    for effect, shown in effects.items():
        for kind in KINDS:
            group = np.where(traced & (known[kind] != ""), groups[kind], -1)
            comparisons.append(by_share(kind, effect, shown, group, groups["unit"]))
    tests, found = outlying(comparisons)
    return Summary(
        {name: int(count) for name, count in counts.items()},
        tuple((row["path"], row["reason"]) for row, good in zip(rows, ok, strict=True) if not good),
        tuple(Distribution.of(name, QUANTITIES[name], x) for name, x in values.items()),
        tuple(sorted(frequencies, key=lambda one: (-one.found, one.effect))),
        tests,
        tuple(_named(test, tests, str(names[test.kind][test.code])) for test in found),
    )


def _texts(rows: Sequence[Row], name: str) -> NDArray[np.str_]:
    """Return a column of the table as texts (n,), empty if unknown."""
    return np.array([row.get(name) or "" for row in rows], dtype=str)


def _numbers(rows: Sequence[Row], name: str) -> Floats:
    """Return a column of the table as numbers (n,), NaN if unknown."""
    return np.array([row.get(name) for row in rows], dtype=float)


def _effects(rows: Sequence[Row]) -> dict[str, Flags]:
    """Return a mask (n,) of the sessions that show it, for each effect found in any session."""
    shown: dict[str, Flags] = {}
    for k, row in enumerate(rows):
        for name in row.get("effects") or ():
            shown.setdefault(name, np.zeros(len(rows), dtype=bool))[k] = True
    return dict(sorted(shown.items()))


def _own_u(rows: Sequence[Row], name: str, values: Floats) -> Floats:
    """Return the standard uncertainties (n,) of a quantity for comparisons of sessions; NaN if unknown.

    If all sessions have the certificate of one stage, its errors are left out, since they change all values
    together. The error of the angle has no u here, because the stated u belongs to a displayed angle.
    `name` is the quantity with the values `values` (n,).
    """
    if name == ANGLE:
        return np.full(len(rows), np.nan)
    u = _numbers(rows, f"{name}_u")
    known = np.isfinite(u) & np.isfinite(values)
    if known.any():
        own = [row for row, there in zip(rows, known, strict=True) if there]
        stages = [row.get("stage_curve") or "" for row in own]
        u[known] = unshared_u(u[known], stages, [row.get(f"{name}_stage") or () for row in own])
    return u


def _comparisons(name: str, values: Floats, u: Floats, groups: Mapping[str, Codes]) -> list[FamilyOfTests]:
    """Make the tests of every sensor, stage and operator against the others for one quantity.

    `values`, `u` (n,) are the values of the quantity `name` and their standard uncertainties. `groups` has
    the number of each session's group by kind.
    """
    if name == ANGLE:  # it is positive, and scatters by a factor
        values = np.log(values, out=np.full(len(values), np.nan), where=values > 0)
    unit = groups["unit"]
    ranks = [by_rank(kind, name, values, groups[kind], unit) for kind in KINDS[1:]]
    return [by_unit(name, values, u, unit), *ranks]


def _named(test: Outlying, tests: int, name: str) -> Outlying:
    """Return one of `tests` tests with the name of the group, its unit and the adjusted p-value."""
    if test.quantity == ANGLE:  # compared by its logarithm
        test = replace(test, value=math.exp(test.value), others=math.exp(test.others))
    unit = QUANTITIES.get(test.quantity, "1")  # a share has no unit
    return replace(test, name=name, unit=unit, adjusted_p=tests * test.p_value)


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
