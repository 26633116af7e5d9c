"""Table 1 and figure 3 from our sessions, and what a bias of 10 mg does to each method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord, json_object, key
from adis_gonio.handover.paper.crossing import rms
from adis_gonio.handover.paper.sessions import METHODS, Part, Results
from adis_gonio.handover.paper.truth import TABLE, Axis, TableRow, truth_of

BIAS_MG = 10.0
"""Standard deviation of an axis's bias in the sessions that ask what a bias does."""
COLUMNS = ("paper", "mmpm")
"""Methods of the table, which are fields of `TableRow` with the printed values."""


@dataclass(frozen=True)
class MethodSpread:
    """What a method gave over sessions.

    Attributes
    ----------
    mean, spread : float or None
        Mean and standard deviation over the sessions; None where the method does not determine it.
    u : float or None
        Standard uncertainty that the method states, rms over the sessions.
    error : float or None
        Distance from the truth, rms.
    sessions : int
        In which the method had an answer.
    """

    mean: float | None = None
    spread: float | None = None
    u: float | None = None
    error: float | None = None
    sessions: int = 0


@dataclass(frozen=True)
class Cell:
    """A row of table 1 with what our sessions give beside it, by method."""

    row: TableRow
    ours: Mapping[str, MethodSpread]

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return json_object(name=self.row.name, **asdict(self.row), sessions=self.ours)


@dataclass(frozen=True)
class Comparison(JsonRecord):
    """Table 1.

    Attributes
    ----------
    cells : tuple of Cell
        In the order of the table.
    gain : mapping of str to MethodSpread
        ΔK, which the table does not have and the method is about, by method; of column X.
    """

    cells: tuple[Cell, ...] = field(metadata=key("rows"))
    gain: Mapping[str, MethodSpread] = field(metadata=key("delta_k"))


def table_of(results: Mapping[Axis, Sequence[Results]]) -> Comparison:
    """Table 1 from the sessions of its two columns."""
    cells = []
    for row in TABLE:
        key = row.key if row.key == "non_orthogonality" else f"{row.key}_{row.axis}"
        cells.append(Cell(row, {m: spread_of(results[row.axis], m, key) for m in METHODS}))
    gain = {method: spread_of(results["x"], method, "delta_k") for method in METHODS}
    return Comparison(tuple(cells), gain)


def spread_of(results: Sequence[Results], method: str, key: str) -> MethodSpread:
    """Statistics of one quantity by one method."""
    values, uncertainties = [], []
    for one in results:
        found = one.found.get(method)
        value = None if found is None else found.values[key]
        if found is not None and value is not None:
            values.append((value, value - one.part.truth.values[key]))
            uncertainties.append(found.u[key])
    if not values:
        return MethodSpread()
    data = np.array(values, dtype=float)
    stated = [u for u in uncertainties if u is not None]
    return MethodSpread(
        float(data[:, 0].mean()),
        float(data[:, 0].std(ddof=1)) if len(data) > 1 else None,
        rms(np.array(stated)) if stated else None,
        rms(data[:, 1]),
        len(data),
    )


def parts_of_column(column: Axis, seeds: Sequence[int]) -> list[Part]:
    """Parts whose truth is a column of the table."""
    return [Part(seed, truth_of(column)) for seed in seeds]


def parts_with_bias(rng: np.random.Generator, count: int) -> list[Part]:
    """Parts of the table's gains and misalignment, with biases of standard deviation `BIAS_MG` an axis."""
    true = truth_of("x")
    hidden = (true.with_bias(BIAS_MG, rng) for _ in range(count))
    return [Part(seed=int(rng.integers(2**31)), truth=truth) for truth in hidden]


@dataclass(frozen=True)
class BiasError:
    """Error of Δφ with a bias, by method.

    Attributes
    ----------
    error_deg : mapping of str to float
        By method, rms.
    multiple : float
        Of the paper's over `ml`'s.
    low, high : float
        Its 95 % interval, by drawing sessions anew (bootstrap).
    median : float
        The same of the medians of |error|, which no single session decides.
    sessions : int
        In which the paper's method had an answer.
    refused : int
        In which it had none.
    """

    error_deg: Mapping[str, float]
    multiple: float
    low: float
    high: float
    median: float
    sessions: int
    refused: int

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"bias_mg": BIAS_MG, **asdict(self)}


def errors_with_bias(results: Sequence[Results], rng: np.random.Generator, draws: int = 2000) -> BiasError:
    """Compare the paper's error of Δφ with that of `ml` on sessions with a bias."""
    key = "non_orthogonality"
    answered = [one for one in results if "paper" in one.found and "ml" in one.found]
    theirs, ours = (_errors(answered, method) for method in ("paper", "ml"))
    index = rng.integers(0, len(ours), (draws, len(ours)))
    again = np.sqrt((theirs[index] ** 2).mean(axis=1) / (ours[index] ** 2).mean(axis=1))
    low, high = (float(q) for q in np.quantile(again, (0.025, 0.975)))
    by_method = {method: spread_of(results, method, key).error for method in METHODS}
    return BiasError(
        {method: error for method, error in by_method.items() if error is not None},
        rms(theirs) / rms(ours),
        low,
        high,
        float(np.median(np.abs(theirs)) / np.median(np.abs(ours))),
        len(answered),
        len(results) - len(answered),
    )


def _errors(results: Sequence[Results], method: str) -> Floats:
    """Errors of Δφ in degrees; NaN where a method does not determine it."""
    key = "non_orthogonality"
    values = [one.found[method].values[key] for one in results]
    true = [one.part.truth.values[key] for one in results]
    return np.array([math.nan if v is None else v - t for v, t in zip(values, true, strict=True)])


def printed_verdicts() -> dict[str, dict[str, Any]]:
    """Which method the table itself has nearer to its measured column, N with its sign and without."""
    verdicts = {}
    for row in TABLE:
        paper, mmpm = abs(row.paper - row.measured), abs(row.mmpm - row.measured)
        sizes = (abs(abs(row.paper) - abs(row.measured)), abs(abs(row.mmpm) - abs(row.measured)))
        verdicts[row.name] = {
            "paper": paper,
            "mmpm": mmpm,
            "nearer": "paper" if paper < mmpm else "mmpm",
            "nearer_without_sign": "paper" if sizes[0] < sizes[1] else "mmpm",
        }
    return verdicts
