"""All sessions of an index in figures, by columns: 10⁵ results in seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import Record
from adis_gonio.fleet.memory.index import Index
from adis_gonio.fleet.memory.record import COLUMNS

_SHARES = (0.05, 0.5, 0.95)
_BY = ("serial", "operator", "stage")


@dataclass(frozen=True)
class Spread(Record):
    """How a quantity is spread over sessions: how many, mean, standard deviation, 5 %, 50 % and 95 %."""

    sessions: int
    mean: float
    sd: float
    quantiles: tuple[float, ...]
    mean_u95: float


@dataclass(frozen=True)
class Summary(Record):
    """What an index holds.

    Attributes
    ----------
    sessions, failed, traced : int
    quantities : mapping of str to Spread
    counts : mapping of str to mapping of str to int
        Sessions by serial number, by operator and by stage; nobody's under the empty text.
    effects : mapping of str to int
        In how many traced sessions an effect was found.
    """

    sessions: int
    failed: int
    traced: int
    quantities: dict[str, Spread]
    counts: dict[str, dict[str, int]]
    effects: dict[str, int]


def summarised(index: Index) -> Summary:
    """Figures of all sessions of an index."""
    status, traced, effects = index.columns(("status", "traced", "effects"))
    good = np.array([one == "ok" for one in status], dtype=bool)
    found = Counter(name for text in effects for name in (text or "").split())
    texts = dict(zip(_BY, index.columns(_BY), strict=True))
    return Summary(
        sessions=int(good.sum()),
        failed=int((~good).sum()),
        traced=sum(map(bool, traced)),
        quantities=_spreads(index),
        counts={name: dict(Counter(one or "" for one in column)) for name, column in texts.items()},
        effects=dict(found.most_common()),
    )


def _spreads(index: Index) -> dict[str, Spread]:
    found = {}
    for name in COLUMNS:
        value, u95 = map(_numbers, index.columns((name, f"{name}_u95")))
        held = value[np.isfinite(value)]
        if len(held):
            sd = float(held.std(ddof=1)) if len(held) > 1 else 0.0
            shares = tuple(float(one) for one in np.quantile(held, _SHARES))
            known = u95[np.isfinite(u95)]
            mean_u95 = float(known.mean()) if len(known) else float("nan")
            found[name] = Spread(len(held), float(held.mean()), sd, shares, mean_u95)
    return found


def _numbers(column: Sequence[float | None]) -> Floats:
    return np.array(column, dtype=float)  # None becomes NaN
