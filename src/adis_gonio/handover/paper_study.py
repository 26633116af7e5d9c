"""The paper behind this program repeated with simulated sessions: its table 1, its figure 3, and a page.

| printed | read as |
|---|---|
| SF | relative error of an axis's scale: K − 1 |
| Δφ, "g/deg/s" | offset of zeros of equation 2, in g |
| N | misalignment Δφ of equation 3, the angle between X and Y away from 90°, in degrees |

A turn in one plane has one angle between X and Y, but the table prints N for each axis. The values are
read as two determinations of one angle, each the truth of a set of sessions: Δφ = 0.0612° for column X,
0.0673° for column Y. Both sets have the scales and offsets of both axes.

Sessions are recorded through chip and driver, as by `adis-gonio simulate`. Every sensor is measured twice
on its stage: at four positions, every 90°, and at nine, every 40°. The paper's method, the closed form
and `four-position` use the first session, MMPM, `ml` and the trace the second.

The page shows table 1, figure 3, and other methods on the same sessions.
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
from typing import Any, Literal

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import with_progress
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import JsonRecord, json_object, key
from adis_gonio.base.numbers import NO_BREAK, counted, format_fixed, format_number, label_quantity
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.model.records import Session
from adis_gonio.page.document import Figure, Section, Series, Table, plot, render
from adis_gonio.record.loading import load_session
from adis_gonio.record.plans import plan
from adis_gonio.record.source import Settings
from adis_gonio.sim.world import GREATEST_ALPHA_DEG
from adis_gonio.tracing.trace import trace
from adis_gonio.tracing.trace_result import TraceResult

Axis = Literal["x", "y"]
AXES: tuple[Axis, ...] = ("x", "y")


@dataclass(frozen=True)
class TableRow:
    """One row of table 1 of the paper for one axis, as printed.

    Attributes
    ----------
    key, printed, unit : str
        Name of the parameter in this package and in the paper, and the unit in which the row is read here.
    axis : {"x", "y"}
        Axis of the row.
    measured, paper, mmpm, specification : float
        Columns of the table: the measured value, the results by the paper's method and by MMPM, and the
        specification.
    """

    key: str
    printed: str
    unit: str
    axis: Axis
    measured: float
    paper: float
    mmpm: float
    specification: float

    @property
    def name(self) -> str:
        """Name of the parameter and its axis, such as `SF, X`."""
        return f"{self.printed}, {self.axis.upper()}"

    @property
    def label(self) -> str:
        """Name with the unit, such as `N, X / °`."""
        return label_quantity(self.name, self.unit)


TABLE: tuple[TableRow, ...] = (
    TableRow("scale_error", "SF", "1", "x", 0.0214, 0.0116, 0.0128, 0.0),
    TableRow("scale_error", "SF", "1", "y", 0.021, 0.0121, 0.0129, 0.0),
    TableRow("offset", "Δφ", "g", "x", -0.003, -0.0025, -0.003, -0.001),
    TableRow("offset", "Δφ", "g", "y", -0.0029, -0.0023, -0.003, -0.001),
    TableRow("non_orthogonality", "N", "deg", "x", 0.0612, 0.051, -0.057, 0.05),
    TableRow("non_orthogonality", "N", "deg", "y", 0.0673, 0.0514, -0.055, 0.05),
)
"""Rows of table 1 of the paper, which are mean values."""

RMSD = {"SF": 0.0033, "Δφ": 0.001}
"""Root mean square deviations that the paper prints with the specifications, by printed name."""


def row_of(key: str, axis: Axis) -> TableRow:
    """Return the row of the paper's table for a parameter and an axis.

    `key` is the name of the parameter in this package.
    """
    return next(row for row in TABLE if (row.key, row.axis) == (key, axis))


class Truth(JsonRecord):
    """True parameters of the sensor in simulated sessions.

    Attributes
    ----------
    scale_x, scale_y : float
        Gains, 1 is perfect.
    delta_phi_deg : float
        Misalignment of Y in the plane.
    bias_x_mg, bias_y_mg : float
        Biases of the axes.
    """

    document_keys = ("scale_x", "scale_y", "delta_k", "delta_phi_deg", "bias_x_mg", "bias_y_mg")

    scale_x: float
    scale_y: float
    delta_phi_deg: float
    bias_x_mg: float
    bias_y_mg: float

    @property
    def delta_k(self) -> float:
        """True gain ratio ΔK = K_x/K_y − 1."""
        return self.scale_x / self.scale_y - 1

    @property
    def values(self) -> dict[str, float]:
        """True values of the paper's quantities, by name.

        They are relative scale errors, offsets in g, the non-orthogonality in degrees, and ΔK.
        """
        return {
            "scale_error_x": self.scale_x - 1,
            "scale_error_y": self.scale_y - 1,
            "offset_x": self.bias_x_mg / 1000,
            "offset_y": self.bias_y_mg / 1000,
            "non_orthogonality": self.delta_phi_deg,
            "delta_k": self.delta_k,
        }


def truth_of(column: Axis) -> Truth:
    """Return the true parameters for the sessions of one column of the table.

    They are the table's measured values; `column` decides the value of Δφ.
    """
    return Truth(
        1 + row_of("scale_error", "x").measured,
        1 + row_of("scale_error", "y").measured,
        row_of("non_orthogonality", column).measured,
        1000 * row_of("offset", "x").measured,
        1000 * row_of("offset", "y").measured,
    )


DWELL_S = 1.0
PLANS = ("four-position", "mmpm")
USES = {
    "paper": "four-position",
    "two-position": "four-position",
    "four-position": "four-position",
    "mmpm": "mmpm",
    "ml": "mmpm",
}
"""Plan of the session on which each method is applied; `ml` uses the nine dwells of MMPM."""
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
        True parameters of the sensor.
    settings : mapping of str to float
        Further settings of the simulation by name.
    effects : str
        Effects of the catalogue in the notation of a simulator's URL; empty for none.
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
        """Return the command line of `adis-gonio simulate` that records a session of this sensor.

        `plan_name` is the plan, `output` the file of the session.
        """
        words = ["adis-gonio", "simulate", "--plan", plan_name, "--dwell", f"{DWELL_S:g}"]
        words += ["--seed", str(self.seed)]
        for name, value in self._pairs().items():
            words += ["--set", f"{name}={float(value)!r}"]
        if self.effects:
            words += ["--effect", self.effects]
        return shlex.join([*words, "-o", output])


def measured(part: Part, plan_name: str) -> Session:
    """Record one session of a simulated sensor with the named plan, and return it."""
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
        for _ in runner.run(so_far=False):
            pass
        return load_session(path)


@dataclass(frozen=True)
class MethodValues:
    """Results of one method for one simulated sensor.

    Attributes
    ----------
    values, u : mapping of str to float or None
        Values and standard uncertainties by `scale_error_x`, `scale_error_y`, `offset_x`, `offset_y` (g),
        `non_orthogonality` (degree) and `delta_k`; None for values that the method does not determine.
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
"""Parameter of `fit`, factor and zero for each quantity of the paper: (value − zero) · factor."""


def quantities(result: FitResult | TraceResult) -> MethodValues:
    """Return the result of a fit or a trace in the quantities of the paper.

    The paper's method gives ΔK and Δφ only. Its scales follow from them: the scale of X from equation 6
    (the length of (U_x1, U_x2)), the scale of Y from the scale of X and ΔK.
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
    """Results of every method for one simulated sensor.

    Attributes
    ----------
    part : Part
        The simulated sensor.
    found : mapping of str to MethodValues
        Values by method.
    refused : mapping of str to str
        Reason for each method that gave no result.
    """

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
    """Return the results of many simulated sensors in order, each given with a flag for the trace.

    `jobs` is the number of processes.
    """
    if jobs <= 1:
        return [results_of(*one) for one in with_progress(parts)]
    # Only the parent handles Ctrl-C, so that the processes print no tracebacks.
    with ProcessPoolExecutor(
        jobs, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        done = pool.map(results_of, *zip(*parts, strict=True))
        return [one for one, _ in zip(done, with_progress(parts), strict=True)]


def facts_of(results: Results) -> dict[str, Any]:
    """Return the JSON object of the results of one simulated sensor."""
    return {
        "seed": results.part.seed,
        "values": {method: dict(found.values) for method, found in results.found.items()},
        "u": {method: dict(found.u) for method, found in results.found.items()},
        "refused": dict(results.refused),
    }


COLUMNS = ("paper", "mmpm")
"""Methods that the table compares; their printed values are the fields of `TableRow` with these names."""


@dataclass(frozen=True)
class MethodSpread:
    """Statistics of one quantity by one method over many sessions.

    Attributes
    ----------
    mean, spread : float or None
        Mean and standard deviation of the quantity; None if the method does not determine it.
    u : float or None
        Standard uncertainty that the method states, rms over the sessions; None if it states none.
    error : float or None
        Deviation of the quantity from its true value, rms over the sessions; None without a result.
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
    """A row of the paper's table 1, with statistics of the simulated sessions for each method.

    Attributes
    ----------
    row : TableRow
        Row of the table as printed.
    ours : mapping of str to MethodSpread
        Statistics of the simulated sessions by method.
    """

    row: TableRow
    ours: Mapping[str, MethodSpread]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the row."""
        return json_object(name=self.row.name, **asdict(self.row), sessions=self.ours)


class Comparison(JsonRecord):
    """The paper's table 1 with the statistics of simulated sessions.

    Attributes
    ----------
    cells : tuple of Cell
        Rows of the table, in its order.
    gain : mapping of str to MethodSpread
        ΔK by method for column X, which the printed table lacks although the paper's method determines it.
    """

    cells: tuple[Cell, ...] = field(metadata=key("rows"))
    gain: Mapping[str, MethodSpread] = field(metadata=key("delta_k"))


def table_of(results: Mapping[Axis, Sequence[Results]]) -> Comparison:
    """Return table 1 of the paper computed from the results of simulated sessions.

    `results` has, for each column of the table (axis X or Y), one entry per simulated sensor: the results
    of all methods for the sessions of that sensor.
    """
    cells = []
    for row in TABLE:
        key = row.key if row.key == "non_orthogonality" else f"{row.key}_{row.axis}"
        cells.append(Cell(row, {m: spread_of(results[row.axis], m, key) for m in METHODS}))
    gain = {method: spread_of(results["x"], method, "delta_k") for method in METHODS}
    return Comparison(tuple(cells), gain)


def spread_of(results: Sequence[Results], method: str, key: str) -> MethodSpread:
    """Return the statistics of the quantity `key` by one method, over the sessions.

    All fields but `sessions` are None if the method does not determine the quantity.
    """
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


def rms(values: Floats) -> float:
    """Return the root mean square of the finite values; NaN if no value is finite."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else math.nan


def printed_verdicts() -> dict[str, dict[str, Any]]:
    """Return for each row of the paper's table which printed method is nearer to the measured value.

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


BIASES_MG = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
NOISES_MG = (0.05, 0.16, 0.5, 1.6)
"""Biases of an axis, and standard uncertainties of a reading, on the map of errors, in mg.
A dwell of 1 s of the ADIS16354 has 0.16 mg."""
_MEAN_SQUARE_TANGENT = math.tan(math.radians(GREATEST_ALPHA_DEG)) / math.radians(GREATEST_ALPHA_DEG) - 1
"""Mean of tan²α over start angles α that are uniform within the range of the simulator."""


def propagated_errors(
    fixture_deg: float, bias_mg: float, noise_mg: float
) -> dict[str, tuple[float, float]]:
    """Return the errors of ΔK and of Δφ (rad), each by the paper's method and by MMPM.

    They follow by linear propagation from the standard deviations of a declared angle (`fixture_deg`), of
    the bias of an axis (`bias_mg`) and of a reading (`noise_mg`). The error of a declared angle enters ΔK
    of two positions by √2 tan α, and Δφ by √2; it enters both by √(2/9) in MMPM.
    """
    gain = (truth_of("x").scale_x + truth_of("x").scale_y) / 2
    noise, bias = 1e-3 * noise_mg / gain, 1e-3 * bias_mg / gain
    fixture = math.radians(fixture_deg)
    two, nine = 2 * (noise**2 + bias**2), 4 / 9 * noise**2 + 2 / 9 * fixture**2
    return {
        "delta_k": (math.sqrt(two + 2 * _MEAN_SQUARE_TANGENT * fixture**2), math.sqrt(nine)),
        "delta_phi": (math.sqrt(two + 2 * fixture**2), math.sqrt(nine)),
    }


def crossing_deg(bias_mg: float, noise_mg: float) -> float:
    """Return the standard deviation of a declared angle above which the paper's method is better.

    It is in degrees; better is the method (the paper's or MMPM) with the smaller error of ΔK. `bias_mg` and
    `noise_mg` are the standard deviations of a bias and of a reading.
    """
    two, nine = propagated_errors(0.0, bias_mg, noise_mg)["delta_k"]
    return math.degrees(math.sqrt((two**2 - nine**2) / (2 / 9 - 2 * _MEAN_SQUARE_TANGENT)))


SESSIONS = 10
LEAST_SESSIONS, MOST_SESSIONS = 2, 10_000
TRACED_SHARE = 5
"""One of this many simulated sensors is traced, but at least one for each column of the table."""
_MOST_JOBS = 8


@dataclass(frozen=True)
class Study:
    """Results of the study that repeats the paper with simulated sensors.

    Attributes
    ----------
    seed, sessions : int
        Seed of all random numbers, and number of simulated sensors for each column of the table.
    table : Comparison
        The paper's table with the statistics of the simulated sessions.
    results : mapping of str to sequence of Results
        Results of the simulated sensors of the table's columns `x` and `y`.
    """

    seed: int
    sessions: int
    table: Comparison
    results: Mapping[Axis, Sequence[Results]]

    @property
    def command(self) -> str:
        """Command line that repeats this study with its seed."""
        return f"adis-gonio paper --seed {self.seed} --sessions {self.sessions}"

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio paper --json` prints."""
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
            "crossing_of_delta_k": [
                {"bias_mg": bias, "noise_mg": noise, "fixture_deg": crossing_deg(bias, noise)}
                for noise in NOISES_MG
                for bias in BIASES_MG
            ],
            "parts": {
                kind: [facts_of(one) | {"command": one.part.command("mmpm")} for one in done]
                for kind, done in self.results.items()
            },
        }


def reproduce(seed: int = 0, sessions: int = SESSIONS, jobs: int | None = None) -> Study:
    """Repeat the paper's study with simulated sensors.

    Parameters
    ----------
    seed : int
        Seed of all random numbers, not negative.
    sessions : int
        Number of simulated sensors for each column of the table.
    jobs : int, optional
        Number of processes; by default one per core.

    Raises
    ------
    UsageError
        The seed or the number of sessions is out of range.
    """
    if seed < 0:
        raise UsageError(f"--seed is {seed}: take 0 or more")
    if not LEAST_SESSIONS <= sessions <= MOST_SESSIONS:
        raise UsageError(f"--sessions is {sessions}: take {LEAST_SESSIONS} to {MOST_SESSIONS}")
    (stream,) = np.random.SeedSequence(seed).spawn(1)
    rng = np.random.default_rng(stream)
    traced = max(1, sessions // TRACED_SHARE)
    work = [
        (Part(int(part_seed), truth_of(column)), k < traced)
        for column in AXES
        for k, part_seed in enumerate(rng.integers(2**31, size=sessions))
    ]
    done = all_results(work, jobs or min(os.cpu_count() or 1, _MOST_JOBS))
    results = {column: done[k * sessions : (k + 1) * sessions] for k, column in enumerate(AXES)}
    return Study(seed, sessions, table_of(results), results)


NAMES = {
    "paper": "paper's method",
    "two-position": "two-position",
    "four-position": "four-position",
    "mmpm": "MMPM",
    "ml": "ml",
    TRACED: "traced model",
}
POSITIONS = {"paper": 2, "two-position": 2, "four-position": 4, "mmpm": 9, "ml": 9, TRACED: 9}
_GRAPHS = {"scale_error": ("SF", "1"), "offset": ("Δφ", "g"), "non_orthogonality": ("N", "°")}


def build_page(done: Study) -> str:
    """Return the study as one HTML page that loads nothing."""
    return render(
        "The seed paper reproduced",
        "two positions against nine",
        shape=f"{counted(done.sessions, 'simulated part')} of each kind, adis16354, seed {done.seed}",
        simulated=True,
        sections=sections(done),
        closing=f"This page is made by {done.command} -o PAGE.html and can be made again by it.",
    )


def sections(done: Study) -> tuple[Section, ...]:
    """Return the sections of the HTML page of the study."""
    return (
        _summary(done),
        _table(done),
        _figure_3(done),
        _others(done),
        _map(done),
        _again(done),
    )


def verdicts(done: Study) -> tuple[str, ...]:
    """Return sentences that state the results of the study."""
    printed = printed_verdicts().values()
    signed = sum(verdict["nearer"] == "paper" for verdict in printed)
    unsigned = sum(verdict["nearer_without_sign"] == "paper" for verdict in printed)
    angle = next(cell for cell in done.table.cells if cell.row.key == "non_orthogonality")
    theirs, nine = (_error(angle.ours[method]) for method in COLUMNS)
    return (
        f"For ΔK the paper's method overtakes MMPM from a fixture error of {crossing_deg(0, 0.16):.2g}°"
        f" without bias, and of {crossing_deg(10, 0.16):.2g}° with biases of 10 mg.",
        f"For {angle.row.name} the paper's method is off by {theirs}° (rms), MMPM by {nine}°.",
        f"The printed table has the paper's method nearer to its own measured column in {signed} of"
        f" {len(TABLE)} rows, the rows of N, in which MMPM's values have the other sign. By sizes alone it"
        f" is nearer in {unsigned or 'none'}.",
    )


def _summary(done: Study) -> Section:
    return Section("Results", words=verdicts(done), notes=(f"Command: {done.command} -o PAGE.html",))


def _cell(spread: MethodSpread) -> str:
    if spread.mean is None:
        return "not determined"
    return f"{format_fixed(spread.mean, 4)}{NO_BREAK}({format_fixed(spread.spread or 0.0, 4)})"


def _table(done: Study) -> Section:
    head = (
        "row",
        "measured",
        "paper's method, printed",
        "ours",
        "u",
        "MMPM, printed",
        "ours",
        "u",
        "specification",
    )
    rows = [_row(cell) for cell in done.table.cells]
    return Section(
        "Table 1",
        words=(
            "Measured is the truth of the simulated parts. Next to each printed value is the result of our"
            " sessions: mean (standard deviation) over the sessions, and u, the standard uncertainty"
            " that the method states for one session. SF is a relative error, Δφ an offset in g, N an angle"
            " in degrees.",
            "Two positions do not determine an offset, the paper's Δφ, so that the printed offset cannot"
            " follow from its equations. The u of its N is large because it includes a bias of 10 mg, which"
            " a part may have but these sessions do not.",
        ),
        tables=(Table(head, rows, numeric=tuple(range(1, len(head)))),),
        notes=(
            f"Specifications are averages; RMSDs are printed for SF, {RMSD['SF']}, and Δφ, {RMSD['Δφ']}.",
            f"Command: {done.command} --json (table_1)",
        ),
    )


def _row(cell: Cell) -> list[str]:
    row = cell.row
    texts = [row.label, format_fixed(row.measured, 4)]
    for method in COLUMNS:
        spread = cell.ours[method]
        texts += [
            format_fixed(getattr(row, method), 4),
            _cell(spread),
            "–" if spread.u is None else format_fixed(spread.u, 4),
        ]
    return [*texts, format_fixed(row.specification, 4)]


def _figure_3(done: Study) -> Section:
    return Section(
        "Figure 3: differences to the measured value",
        words=(
            "Printed values less the measured column, and ours less the truth: mean over the sessions, bars"
            " the standard deviation. Two positions do not determine the offset; it is taken as zero, and"
            " its whole size is drawn as the paper's difference.",
        ),
        figures=[Figure(svg, caption) for svg, caption in figures_3(done).values()],
        notes=(f"Command: {done.command} --json (table_1: sessions)",),
    )


def figures_3(done: Study) -> dict[str, tuple[str, str]]:
    """Return the three graphs of the paper's figure 3 as SVG with captions, by parameter."""
    made = {}
    for name, (printed, unit) in _GRAPHS.items():
        cells = [cell for cell in done.table.cells if cell.row.key == name]
        label = f"difference of {printed}" + (f" / {unit}" if unit != "1" else "")
        at = [
            (2.5 * k + place, cell.row.measured, getattr(cell.row, method), cell.ours[method])
            for k, cell in enumerate(cells)
            for place, method in enumerate(COLUMNS)
        ]
        series = [
            Series(
                [x - 0.12 for x, *_ in at],
                [value - measured for _, measured, value, _ in at],
                "printed",
                role="before",
            ),
            Series(
                [x + 0.12 for x, *_ in at],
                [(ours.mean or 0.0) - measured for _, measured, _, ours in at],
                "our sessions",
                error=[ours.spread or 0.0 for *_, ours in at],
                role="after",
            ),
        ]
        ticks = {0.0: "X, paper", 1.0: "X, MMPM", 2.5: "Y, paper", 3.5: "Y, MMPM"}
        svg = plot(
            series,
            "",
            label,
            title=f"Differences of {printed}",
            description=f"Printed and simulated differences of {printed} for X and Y by both methods.",
            x_ticks=ticks,
            x_range=(-0.6, 4.1),
            zero=True,
        )
        made[name] = (svg, f"{printed}: by the paper's method and by MMPM.")
    return made


def _others(done: Study) -> Section:
    head = ["row", *(NAMES[method] for method in METHODS)]
    rows = []
    for cell in done.table.cells:
        rows.append([cell.row.label, *(_error(cell.ours[method]) for method in METHODS)])
    rows.append(["ΔK, column X", *(_error(done.table.gain[method]) for method in METHODS)])
    rows.append(["positions", *(str(POSITIONS[method]) for method in METHODS)])
    traced = max(cell.ours[TRACED].sessions for cell in done.table.cells)
    return Section(
        "The other methods on the same sessions",
        words=(
            "Error about the truth, rms over the sessions. Each part is measured at four positions,"
            " of which the paper's method and its closed form use the first two, and at MMPM's nine, which"
            f" ml and the traced model also use. The traced model is of {counted(traced, 'part')} of each"
            " column: it has to find the bias before it corrects it.",
        ),
        tables=(Table(head, rows, numeric=tuple(range(1, len(head)))),),
        notes=(f"Command: {done.command} --json (table_1: sessions, error)",),
    )


def _error(spread: MethodSpread) -> str:
    return "–" if spread.error is None else format_number(spread.error, 2)


def _map(done: Study) -> Section:
    return Section(
        "Where the paper's method overtakes MMPM",
        words=(
            "Errors by linear propagation, for a start angle within ±5°. MMPM uses the declared angles:"
            " their errors enter its gains by √(2/9), but the gains of two positions at a small start angle"
            " only by √2 tan α. In Δφ it is the reverse: √(2/9) for MMPM, √2 for two positions. The bias,"
            " which two positions cannot determine, moves the crossing up.",
        ),
        figures=[_crossing_figure(), _ratio_figure()],
        notes=(f"Command: {done.command} --json (crossing_of_delta_k)",),
    )


def _crossing_figure() -> Figure:
    biases = [bias for bias in BIASES_MG if bias]
    lines = [
        Series(
            biases, [crossing_deg(bias, noise) for bias in biases], f"{noise:g} mg of noise", style="line"
        )
        for noise in NOISES_MG
    ]
    title = "Crossing of the paper's method and MMPM in ΔK"
    svg = plot(lines, "bias of an axis / mg", "fixture error / °", title=title, x_log=True, y_log=True)
    return Figure(svg, "ΔK: above its line the paper's method is better, below it MMPM.")


def _ratio_figure() -> Figure:
    fixtures = np.geomspace(0.005, 2.0, 40)
    curves = [Series([0.005, 2.0], [1.0, 1.0], role="model", style="line")]
    for name, label in (("delta_k", "ΔK"), ("delta_phi", "Δφ")):
        for bias in (0.0, 3.0):
            pairs = [propagated_errors(float(f), bias, NOISES_MG[1])[name] for f in fixtures]
            ratio = [two / nine for two, nine in pairs]
            curves.append(Series(fixtures, ratio, f"{label}, {bias:g} mg of bias", style="line"))
    title = "Error of the paper's method over the error of MMPM"
    svg = plot(curves, "fixture error / °", "error over MMPM's error", title=title, x_log=True, y_log=True)
    return Figure(svg, f"Below one the paper's method is better, {NOISES_MG[1]:g} mg of noise.")


def _again(done: Study) -> Section:
    part = done.results["x"][0].part
    return Section(
        "Repeat the numbers",
        words=(
            f"The whole page: {done.command} -o PAGE.html. All numbers as one document: {done.command}"
            " --json; its parts state the command that records each session. Dwells last"
            f" {DWELL_S:g} s. The first part of column X at its nine positions, and MMPM of it:",
        ),
        points=(part.command("mmpm"), "adis-gonio fit one.session --method mmpm"),
    )
