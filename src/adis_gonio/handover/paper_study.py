"""The study of the seed paper, repeated with simulated sessions: table 1, map, effect of a bias.

Sessions are recorded through chip and driver, as by `adis-gonio simulate`. Every sensor is measured twice
on its stage: at four positions, every 90°, and at nine, every 40°. The paper's method, the closed form
and `four-position` use the first session, MMPM, `ml` and the trace the second.
"""

from __future__ import annotations

import math
import os
import shlex
import signal
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current, with_progress
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import JsonRecord, json_object, key
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.handover.paper_map import (
    AXES,
    DRAWS,
    RMSD,
    TABLE,
    Axis,
    Draws,
    Map,
    TableRow,
    Truth,
    map_of,
    rms,
    truth_of,
)
from adis_gonio.model.records import Session
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.settings import Settings
from adis_gonio.tracing.trace import trace
from adis_gonio.tracing.trace_result import TraceResult

DWELL_S = 1.0
PLANS = ("four-position", "mmpm")
USES = {
    "paper": "four-position",
    "two-position": "four-position",
    "four-position": "four-position",
    "mmpm": "mmpm",
    "ml": "mmpm",
}
"""Plan of the session for each method; `ml` uses the nine dwells of MMPM."""
TRACED = "traced"
METHODS = (*USES, TRACED)


@dataclass(frozen=True)
class Part:
    """A simulated sensor on its stage.

    Attributes
    ----------
    seed : int
        Seed of the simulator: start angle within ±5°, noise and the stage's errors.
    truth : Truth
    settings : mapping of str to float
        Further settings of the simulated world.
    effects : str
        Effects of the catalogue, as in a URL.
    """

    seed: int
    truth: Truth
    settings: Mapping[str, float] = field(default_factory=dict)
    effects: str = ""

    def _pairs(self) -> dict[str, float]:
        truth = self.truth
        return {
            "scale_y": truth.scale_y,
            "delta_k": truth.delta_k,
            "delta_phi_deg": truth.delta_phi_deg,
            "bias_x_mg": truth.bias_x_mg,
            "bias_y_mg": truth.bias_y_mg,
            **self.settings,
        }

    @property
    def url(self) -> str:
        """URL by which `open_sensor` opens the simulated sensor."""
        settings = "".join(f"&{name}={float(value)!r}" for name, value in self._pairs().items())
        return f"sim:?seed={self.seed}{settings}" + (f"&effects={self.effects}" if self.effects else "")

    def command(self, plan_name: str, output: str = "one.session") -> str:
        """Command line of `adis-gonio simulate` that records a session of this sensor."""
        words = ["adis-gonio", "simulate", "--plan", plan_name, "--dwell", f"{DWELL_S:g}"]
        words += ["--seed", str(self.seed)]
        for name, value in self._pairs().items():
            words += ["--set", f"{name}={float(value)!r}"]
        if self.effects:
            words += ["--effect", self.effects]
        return shlex.join([*words, "-o", output])


def measured(part: Part, plan_name: str) -> Session:
    """Record one session of a simulated sensor with the named plan, and load it."""
    with tempfile.TemporaryDirectory() as folder, open_sensor(part.url) as sensor:
        world = sensor.bus.world  # type: ignore[attr-defined]  # the simulator's bus has one
        path = Path(folder) / "one.session"
        runner = SessionRunner.begin(
            sensor,
            path,
            plan(plan_name),
            Settings(dwell_s=DWELL_S),
            auto=True,
            gravity_mps2=world.settings.gravity_mps2,
            fixture_sigma_deg=world.settings.fixture_sigma_deg,
        )
        for _ in runner.run():
            pass
        return load_session(path)


@dataclass(frozen=True)
class MethodValues:
    """Values by one method for one simulated sensor; None for values that it does not determine.

    Attributes
    ----------
    values, u : mapping of str to float or None
        Values and standard uncertainties by `scale_error_x`, `scale_error_y`, `offset_x`, `offset_y` (g),
        `non_orthogonality` (degree) and `delta_k`.
    """

    values: Mapping[str, float | None]
    u: Mapping[str, float | None] = field(default_factory=dict)


_FROM_FIT = {
    "scale_error_x": ("scale_x", 1.0, 1.0),
    "scale_error_y": ("scale_y", 1.0, 1.0),
    "offset_x": ("bias_x", 1e-3, 0.0),
    "offset_y": ("bias_y", 1e-3, 0.0),
    "non_orthogonality": ("delta_phi", 1.0, 0.0),
    "delta_k": ("delta_k", 1.0, 0.0),
}
"""Parameter of `fit`, factor and zero of each quantity of the paper: (value − zero) · factor."""


def quantities(result: FitResult | TraceResult) -> MethodValues:
    """Convert the result of a fit or a trace to the quantities of the paper.

    The paper gives ΔK and Δφ only. Its scales follow from them: the scale of X from equation 6 (the
    length of (U_x1, U_x2)), the scale of Y from the scale of X and ΔK.
    """
    if isinstance(result, TraceResult):
        stated = dict(result.base)
        for finding in result.found:
            stated |= finding.parameters if finding.effect == "bias" else {}
        found = {name: (value.value, value.u) for name, value in stated.items()}
    else:
        found = {estimate.name: (estimate.value, estimate.u) for estimate in result.parameters}
        if result.method == "paper" and result.origin is not None:
            k_x, k_y = (float(k) for k in result.origin.fit.values.base[1:3])
            found |= {"scale_x": (k_x, None), "scale_y": (k_y, None)}
    values: dict[str, float | None] = {}
    u: dict[str, float | None] = {}
    for quantity, (name, factor, zero) in _FROM_FIT.items():
        value, spread = found.get(name, (None, None))
        values[quantity] = None if value is None else (value - zero) * factor
        u[quantity] = None if spread is None else spread * factor
    return MethodValues(values, u)


@dataclass(frozen=True)
class Results:
    """Values of every method for one simulated sensor, and the reasons of methods that gave no result."""

    part: Part
    found: Mapping[str, MethodValues]
    refused: Mapping[str, str] = field(default_factory=dict)


def results_of(part: Part, traced: bool = False) -> Results:
    """Record the sessions of one simulated sensor and apply every method; `traced` adds the trace."""
    sessions = {name: measured(part, name) for name in PLANS}
    found: dict[str, MethodValues] = {}
    refused: dict[str, str] = {}
    for method, used in USES.items():
        try:
            found[method] = quantities(fit(sessions[used], method))
        except FitError as error:
            refused[method] = str(error)
    if traced:
        found[TRACED] = quantities(trace(sessions["mmpm"]))
    return Results(part, found, refused)


def all_results(parts: Sequence[tuple[Part, bool]], jobs: int = 1) -> list[Results]:
    """Results of many simulated sensors, each given with a flag for the trace; the order is kept."""
    if jobs <= 1:
        return [results_of(*one) for one in with_progress(parts)]
    # Only the parent handles Ctrl-C, so that the processes print no tracebacks.
    with ProcessPoolExecutor(
        jobs, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        done = pool.map(results_of, *zip(*parts, strict=True))
        return [one for one, _ in zip(done, with_progress(parts), strict=True)]


def facts_of(results: Results) -> dict[str, Any]:
    """JSON form of the results of one simulated sensor."""
    return {
        "seed": results.part.seed,
        "values": {method: dict(found.values) for method, found in results.found.items()},
        "u": {method: dict(found.u) for method, found in results.found.items()},
        "refused": dict(results.refused),
    }


BIAS_MG = 10.0
"""Standard deviation of an axis's bias in the sessions with a bias."""
COLUMNS = ("paper", "mmpm")
"""Methods of the table; their printed values are the fields of `TableRow` with these names."""


@dataclass(frozen=True)
class MethodSpread:
    """Statistics of one quantity by one method over many sessions.

    Attributes
    ----------
    mean, spread : float or None
        Mean and standard deviation of the quantity; None if the method does not determine it.
    u : float or None
        Standard uncertainty that the method states, rms over the sessions.
    error : float or None
        Deviation from the truth, rms.
    sessions : int
        Number of sessions with a result.
    """

    mean: float | None = None
    spread: float | None = None
    u: float | None = None
    error: float | None = None
    sessions: int = 0


@dataclass(frozen=True)
class Cell:
    """A row of the paper's table 1, with statistics of the simulated sessions for each method."""

    row: TableRow
    ours: Mapping[str, MethodSpread]

    def as_dict(self) -> dict[str, Any]:
        """JSON form of the row."""
        return json_object(name=self.row.name, **asdict(self.row), sessions=self.ours)


class Comparison(JsonRecord):
    """The paper's table 1 with the statistics of simulated sessions.

    Attributes
    ----------
    cells : tuple of Cell
        In the order of the table.
    gain : mapping of str to MethodSpread
        ΔK by method for column X, which the printed table lacks although the paper's method determines it.
    """

    cells: tuple[Cell, ...] = field(metadata=key("rows"))
    gain: Mapping[str, MethodSpread] = field(metadata=key("delta_k"))


def table_of(results: Mapping[Axis, Sequence[Results]]) -> Comparison:
    """Compute table 1 of the paper from the results of simulated sessions, for both of its columns."""
    cells = []
    for row in TABLE:
        key = row.key if row.key == "non_orthogonality" else f"{row.key}_{row.axis}"
        cells.append(Cell(row, {m: spread_of(results[row.axis], m, key) for m in METHODS}))
    gain = {method: spread_of(results["x"], method, "delta_k") for method in METHODS}
    return Comparison(tuple(cells), gain)


def spread_of(results: Sequence[Results], method: str, key: str) -> MethodSpread:
    """Statistics of the quantity `key` by one method, over the sessions."""
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


def parts_with_bias(rng: np.random.Generator, count: int) -> list[Part]:
    """Draw simulated sensors with random biases of standard deviation `BIAS_MG`.

    Gains and misalignment are taken from the paper's table.
    """
    true = truth_of("x")
    hidden = (true.with_bias(BIAS_MG, rng) for _ in range(count))
    return [Part(seed=int(rng.integers(2**31)), truth=truth) for truth in hidden]


class BiasError(JsonRecord):
    """Errors of Δφ, by method, on sessions of sensors that have a bias.

    Attributes
    ----------
    error_deg : mapping of str to float
        Error by method, rms.
    multiple : float
        Error of the paper's method over the error of `ml`.
    low, high : float
        95 % interval of `multiple`, by bootstrap over sessions.
    median : float
        Ratio of the medians of |error|, which does not depend on a single session.
    sessions : int
        Number of sessions with a result of the paper's method.
    refused : int
        Number of sessions without such a result.
    """

    error_deg: Mapping[str, float]
    multiple: float
    low: float
    high: float
    median: float
    sessions: int
    refused: int
    bias_mg: float = BIAS_MG


def errors_with_bias(results: Sequence[Results], rng: np.random.Generator, draws: int = 2000) -> BiasError:
    """Compare the errors of Δφ by the paper's method and by `ml` on sessions of sensors with a bias."""
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
    """Errors of Δφ in degrees, one per session (n,); NaN if the method does not determine it."""
    key = "non_orthogonality"
    values = [one.found[method].values[key] for one in results]
    true = [one.part.truth.values[key] for one in results]
    return np.array([math.nan if v is None else v - t for v, t in zip(values, true, strict=True)])


def printed_verdicts() -> dict[str, dict[str, Any]]:
    """For each row of the paper's table, state which printed method is nearer to the measured value.

    The methods are compared twice: by their values, and by their absolute values. The second comparison
    ignores the sign of the non-orthogonality N, which is negative for MMPM.
    """
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


SESSIONS = 10
LEAST_SESSIONS, MOST_SESSIONS = 2, 10_000
TRACED_SHARE = 5
"""One of this many simulated sensors is traced, but at least one of each kind."""
_TRACED = (*AXES, "bias")
_MOST_JOBS = 8


@dataclass(frozen=True)
class Study:
    """Results of the study that repeats the paper with simulated sensors.

    Attributes
    ----------
    seed, sessions : int
        Seed of all random numbers, and number of simulated sensors of each kind.
    results : mapping of str to sequence of Results
        Results of the simulated sensors of the table's columns `x` and `y`, and of those with a `bias`.
    """

    seed: int
    sessions: int
    table: Comparison
    map: Map
    bias: BiasError
    results: Mapping[str, Sequence[Results]]

    @property
    def command(self) -> str:
        """Command line that repeats this study with its seed."""
        return f"adis-gonio paper --seed {self.seed} --sessions {self.sessions}"

    def as_dict(self) -> dict[str, Any]:
        """The document that `adis-gonio paper --json` prints."""
        truths = {f"column_{column}": truth_of(column).as_dict() for column in AXES}
        return {
            "command": f"{self.command} --json",
            "software": f"adis-gonio {__version__}",
            "seed": self.seed,
            "sessions": self.sessions,
            "dwell_s": DWELL_S,
            "truth": truths,
            "table_1": {**self.table.as_dict(), "rmsd_of_the_specification": RMSD},
            "as_printed": printed_verdicts(),
            "map": self.map.as_dict(),
            "bias": self.bias.as_dict(),
            "parts": {
                kind: [facts_of(one) | {"command": one.part.command("mmpm")} for one in done]
                for kind, done in self.results.items()
            },
        }


def reproduce(
    seed: int = 0, sessions: int = SESSIONS, jobs: int | None = None, *, draws: int = DRAWS
) -> Study:
    """Repeat the paper's study with simulated sensors.

    Parameters
    ----------
    seed : int
        Seed of all random numbers, not negative.
    sessions : int
        Number of simulated sensors of each kind: for column X, for column Y, and with a bias.
    jobs : int, optional
        Number of processes; by default one per core.
    draws : int
        Number of sessions at each point of the map.

    Raises
    ------
    UsageError
        The seed or the number of sessions is out of range.
    """
    if seed < 0:
        raise UsageError(f"--seed is {seed}: take 0 or more")
    if not LEAST_SESSIONS <= sessions <= MOST_SESSIONS:
        raise UsageError(f"--sessions is {sessions}: take {LEAST_SESSIONS} to {MOST_SESSIONS}")
    tell = current().tell
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6)]
    seeding, mapping, biased, _, again, _ = streams
    tell("the map, by readings")
    mapped = map_of(truth_of("x"), Draws.of(mapping, draws))
    kinds: dict[str, list[Part]] = {
        column: [Part(int(s), truth_of(column)) for s in seeding.integers(2**31, size=sessions)]
        for column in AXES
    }
    kinds["bias"] = parts_with_bias(biased, sessions)
    tell("sessions through chip and driver")
    results = _measured(
        kinds, max(1, sessions // TRACED_SHARE), jobs or min(os.cpu_count() or 1, _MOST_JOBS)
    )
    columns: dict[Axis, Sequence[Results]] = {axis: results[axis] for axis in AXES}
    return Study(
        seed, sessions, table_of(columns), mapped, errors_with_bias(results["bias"], again), results
    )


def _measured(kinds: Mapping[str, Sequence[Part]], traced: int, jobs: int) -> dict[str, Sequence[Results]]:
    """Compute the results of all simulated sensors, by kind.

    The first sensors of each kind in `_TRACED` are also traced.
    """
    work = [
        (part, k < traced and kind in _TRACED)
        for kind, parts in kinds.items()
        for k, part in enumerate(parts)
    ]
    done = iter(all_results(work, jobs))
    return {kind: [next(done) for _ in parts] for kind, parts in kinds.items()}
