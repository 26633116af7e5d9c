"""Repetition of the study in the paper behind this program (table 1, figure 3), with simulated sessions.

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

The page shows table 1, figure 3, and the errors of a fixture above which the paper's method is better. The
JSON document has the results of all methods.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import with_progress
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord, json_object
from adis_gonio.base.numbers import NO_BREAK, counted, format_fixed, format_number, label_quantity
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.methods import fit
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


class TableRow(JsonRecord):
    """One row of table 1 of the paper for one axis, as printed.

    Attributes
    ----------
    parameter, printed, unit : str
        Parameter of `fit`, its name in the paper, and the unit in which the row is read here.
    axis : {"x", "y"}
        Axis of the row.
    measured, paper, mmpm, specification : float
        Columns of the table: the measured value, the results by the paper's method and by MMPM, and the
        specification.
    factor, zero : float
        The row has (value − zero) · factor of a value that `fit` determines.
    """

    parameter: str
    printed: str
    unit: str
    axis: Axis
    measured: float
    paper: float
    mmpm: float
    specification: float
    factor: float = 1.0
    zero: float = 0.0

    @property
    def name(self) -> str:
        """Name of the parameter and its axis, such as `SF, X`."""
        return f"{self.printed}, {self.axis.upper()}"


TABLE: tuple[TableRow, ...] = (
    TableRow("scale_x", "SF", "1", "x", 0.0214, 0.0116, 0.0128, 0.0, zero=1.0),
    TableRow("scale_y", "SF", "1", "y", 0.021, 0.0121, 0.0129, 0.0, zero=1.0),
    TableRow("bias_x", "Δφ", "g", "x", -0.003, -0.0025, -0.003, -0.001, factor=1e-3),
    TableRow("bias_y", "Δφ", "g", "y", -0.0029, -0.0023, -0.003, -0.001, factor=1e-3),
    TableRow("delta_phi", "N", "deg", "x", 0.0612, 0.051, -0.057, 0.05),
    TableRow("delta_phi", "N", "deg", "y", 0.0673, 0.0514, -0.055, 0.05),
)
"""Rows of table 1 of the paper, which are mean values."""

_MEASURED = {row.name: row.measured for row in TABLE}
_RATIO = (1 + _MEASURED["SF, X"]) / (1 + _MEASURED["SF, Y"]) - 1
DELTA_K = TableRow("delta_k", "ΔK", "1", "x", _RATIO, math.nan, math.nan, math.nan)
"""Row of ΔK, which the paper does not print; the measured value follows from the scales."""

RMSD = {"SF": 0.0033, "Δφ": 0.001}
"""Root mean square deviations that the paper prints with the specifications, by printed name."""

DWELL_S = 1.0
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


def settings_of(column: Axis) -> dict[str, float]:
    """Return the true parameters of the sensors of a column of the table, as settings of the simulator."""
    return {
        "scale_y": 1 + _MEASURED["SF, Y"],
        "delta_k": DELTA_K.measured,
        "delta_phi_deg": _MEASURED[f"N, {column.upper()}"],
        "bias_x_mg": 1000 * _MEASURED["Δφ, X"],
        "bias_y_mg": 1000 * _MEASURED["Δφ, Y"],
    }


def url_of(seed: int, column: Axis) -> str:
    """Return the URL of a simulated sensor on its stage, with the true parameters of a column of the table.

    `seed` decides the start angle within ±5°, the noise and the errors of the stage.
    """
    return f"sim:?seed={seed}" + "".join(f"&{name}={v!r}" for name, v in settings_of(column).items())


def measured(url: str, plan_name: str) -> Session:
    """Record one session of a simulated sensor with the named plan, and return it."""
    with tempfile.TemporaryDirectory() as folder, open_sensor(url) as sensor:
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


Estimates = Mapping[str, tuple[float, float]]
"""Value and standard uncertainty (NaN if it is not stated) of each parameter that a method determines."""


def estimates_of(result: FitResult | TraceResult) -> Estimates:
    """Return the parameters of a fit or a trace, with the parameters that the paper's method implies.

    The paper's method states ΔK and Δφ only. The scale of X follows from equation 6 (the length of
    (U_x1, U_x2)), the scale of Y from the scale of X and ΔK.
    """
    stated: dict[str, Any]
    if isinstance(result, TraceResult):
        stated = dict(result.base)
        for finding in result.found:
            stated |= finding.parameters if finding.effect == "bias" else {}
    else:
        stated = dict(result.parameters)
    found = {name: (one.value, math.nan if one.u is None else one.u) for name, one in stated.items()}
    if isinstance(result, FitResult) and result.method == "paper" and result.origin is not None:
        k_x, k_y = result.origin.fit.values.base[1:3].tolist()
        found |= {"scale_x": (k_x, math.nan), "scale_y": (k_y, math.nan)}
    return found


Results = Mapping[str, Estimates]
"""Values and uncertainties by method for one simulated sensor; a method without a result is missing."""


def results_of(url: str, traced: bool = False) -> Results:
    """Record the sessions of one simulated sensor and apply every method; `traced` adds the trace."""
    sessions = {name: measured(url, name) for name in set(USES.values())}
    found: dict[str, Estimates] = {}
    for method, used in USES.items():
        with suppress(FitError):
            found[method] = estimates_of(fit(sessions[used], method))
    if traced:
        found[TRACED] = estimates_of(trace(sessions["mmpm"]))
    return found


COLUMNS = ("paper", "mmpm")
"""Methods that the table compares; their printed values are the fields of `TableRow` with these names."""


class MethodSpread(JsonRecord):
    """Statistics of one parameter by one method over many sessions; NaN without a result.

    Attributes
    ----------
    mean, spread : float
        Mean and standard deviation of the parameter.
    u : float
        Standard uncertainty that the method states, rms over the sessions; NaN if it states none.
    error : float
        Deviation of the parameter from its true value, rms over the sessions.
    sessions : int
        Number of sessions with a result.
    """

    mean: float = math.nan
    spread: float = math.nan
    u: float = math.nan
    error: float = math.nan
    sessions: int = 0


def rms(values: Floats) -> float:
    """Return the root mean square of the finite values; NaN if no value is finite."""
    finite_values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite_values**2))) if finite_values.size else math.nan


BIASES_MG = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
NOISES_MG = (0.05, 0.16, 0.5, 1.6)
"""Biases of an axis, and standard uncertainties of a reading, on the map of errors, in mg.
A dwell of 1 s of the ADIS16354 has 0.16 mg."""
_MEAN_SQUARE_TANGENT = math.tan(math.radians(GREATEST_ALPHA_DEG)) / math.radians(GREATEST_ALPHA_DEG) - 1
"""Mean of tan²α over start angles α that are uniform within the range of the simulator."""


def propagated_errors(fixture_deg: float, bias_mg: float, noise_mg: float) -> tuple[float, float]:
    """Return the error of ΔK by the paper's method and by MMPM.

    They follow by linear propagation from the standard deviations of a declared angle (`fixture_deg`), of
    the bias of an axis (`bias_mg`) and of a reading (`noise_mg`). In the paper's method, from two
    positions, the error of a declared angle contributes with the factor √2 tan α (α is the start angle). In
    MMPM, from nine positions, the factor is √(2/9).
    """
    gain = 1 + (_MEASURED["SF, X"] + _MEASURED["SF, Y"]) / 2
    noise, bias, fixture = 1e-3 * noise_mg / gain, 1e-3 * bias_mg / gain, math.radians(fixture_deg)
    two = 2 * (noise**2 + bias**2) + 2 * _MEAN_SQUARE_TANGENT * fixture**2
    return math.sqrt(two), math.sqrt(4 / 9 * noise**2 + 2 / 9 * fixture**2)


def crossing_deg(bias_mg: float, noise_mg: float) -> float:
    """Return the error of a declared angle above which the paper's method is better than MMPM.

    The result is a standard deviation in degrees. The better method has the smaller error of ΔK. `bias_mg`
    and `noise_mg` are the standard deviations of a bias and of a reading.
    """
    two, nine = propagated_errors(0.0, bias_mg, noise_mg)
    return math.degrees(math.sqrt((two**2 - nine**2) / (2 / 9 - 2 * _MEAN_SQUARE_TANGENT)))


SESSIONS = 10
TRACED_SHARE = 5
"""One of this many simulated sensors is traced, but at least one for each column of the table."""


@dataclass(frozen=True)
class Study:
    """Results of the study that repeats the paper with simulated sensors.

    Attributes
    ----------
    seed, sessions : int
        Seed of all random numbers, and number of simulated sensors for each column of the table.
    results : mapping of str to sequence of Results
        Results of the simulated sensors of the table's columns `x` and `y`.
    """

    seed: int
    sessions: int
    results: Mapping[Axis, Sequence[Results]]

    @property
    def command(self) -> str:
        """Command line that repeats this study with its seed."""
        return f"adis-gonio paper --seed {self.seed} --sessions {self.sessions}"

    def spread(self, row: TableRow, method: str) -> MethodSpread:
        """Return the statistics of the parameter of a row by a method, in the unit of the row."""
        tried = [one[method] for one in self.results[row.axis] if method in one]
        stated = np.array([one[row.parameter] for one in tried if row.parameter in one])
        if not stated.size:
            return MethodSpread()
        values, u = (stated[:, 0] - row.zero) * row.factor, stated[:, 1] * row.factor
        sd = float(values.std(ddof=1)) if len(values) > 1 else math.nan
        return MethodSpread(float(values.mean()), sd, rms(u), rms(values - row.measured), len(values))

    def by_method(self, row: TableRow) -> dict[str, MethodSpread]:
        """Return the statistics of the parameter of a row by each method."""
        return {method: self.spread(row, method) for method in METHODS}

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio paper --json` prints."""
        return json_object(
            command=f"{self.command} --json",
            software=f"adis-gonio {__version__}",
            seed=self.seed,
            sessions=self.sessions,
            dwell_s=DWELL_S,
            truth={f"column_{column}": settings_of(column) for column in AXES},
            table_1={
                "rows": [
                    {"name": row.name, **row.as_dict(), "sessions": self.by_method(row)} for row in TABLE
                ],
                "delta_k": self.by_method(DELTA_K),
                "rmsd_of_the_specification": RMSD,
            },
            crossing_of_delta_k=[
                {"bias_mg": bias, "noise_mg": noise, "fixture_deg": crossing_deg(bias, noise)}
                for noise in NOISES_MG
                for bias in BIASES_MG
            ],
        )


def reproduce(seed: int = 0, sessions: int = SESSIONS) -> Study:
    """Repeat the paper's study with simulated sensors.

    Parameters
    ----------
    seed : int
        Seed of all random numbers, not negative.
    sessions : int
        Number of simulated sensors for each column of the table, at least 2.
    """
    (stream,) = np.random.SeedSequence(seed).spawn(1)
    rng = np.random.default_rng(stream)
    traced = max(1, sessions // TRACED_SHARE)
    work = [
        (url_of(int(part_seed), column), k < traced)
        for column in AXES
        for k, part_seed in enumerate(rng.integers(2**31, size=sessions))
    ]
    done = [results_of(*one) for one in with_progress(work)]
    return Study(seed, sessions, {"x": done[:sessions], "y": done[sessions:]})


# -- the page -----------------------------------------------------------------------------------------


def build_page(done: Study) -> str:
    """Return the study as one HTML page that needs no other file."""
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
    results = Section("Results", words=verdicts(done), notes=(f"Command: {done.command} -o PAGE.html",))
    return results, _table(done), _figure_3(done), _map(done)


def verdicts(done: Study) -> tuple[str, ...]:
    """Return sentences that state the results of the study."""
    nearer = sum(abs(row.paper - row.measured) < abs(row.mmpm - row.measured) for row in TABLE)
    angle = TABLE[4]
    theirs, nine = (format_number(done.spread(angle, method).error, 2) for method in COLUMNS)
    return (
        f"For ΔK the paper's method overtakes MMPM from a fixture error of {crossing_deg(0, 0.16):.2g}°"
        f" without bias, and of {crossing_deg(10, 0.16):.2g}° with biases of 10 mg.",
        f"For {angle.name} the paper's method is off by {theirs}° (rms), MMPM by {nine}°.",
        f"The printed table has the paper's method nearer to its own measured column in {nearer} of"
        f" {len(TABLE)} rows, the rows of N, in which MMPM's values have the other sign.",
    )


def _table(done: Study) -> Section:
    head = ["row", "measured"]
    for title in ("paper's method", "MMPM"):
        head += [f"{title}, printed", "ours", "u"]
    rows = []
    for row in TABLE:
        texts = [label_quantity(row.name, row.unit), format_fixed(row.measured, 4)]
        for method in COLUMNS:
            one = done.spread(row, method)
            ours = f"{format_fixed(one.mean, 4)}{NO_BREAK}({format_fixed(one.spread, 4)})"
            texts += [
                format_fixed(getattr(row, method), 4),
                ours if one.sessions else "not determined",
                format_fixed(one.u, 4),
            ]
        rows.append([*texts, format_fixed(row.specification, 4)])
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
        tables=(Table((*head, "specification"), rows, numeric=tuple(range(1, len(head) + 1))),),
        notes=(
            f"Specifications are averages; RMSDs are printed for SF, {RMSD['SF']}, and Δφ, {RMSD['Δφ']}.",
            f"Command: {done.command} --json (table_1)",
        ),
    )


def _figure_3(done: Study) -> Section:
    figures = []
    at = np.array([0.0, 1.0, 2.5, 3.5])  # both methods of X, then of Y
    for rows in zip(TABLE[::2], TABLE[1::2], strict=True):
        printed, pairs = rows[0].printed, [(row, method) for row in rows for method in COLUMNS]
        ours = [done.spread(row, method) for row, method in pairs]
        theirs = [getattr(row, method) - row.measured for row, method in pairs]
        mean = np.nan_to_num([one.mean for one in ours]) - [row.measured for row, _ in pairs]
        spread = np.nan_to_num([one.spread for one in ours])
        series = [
            Series(at - 0.12, theirs, "printed", role="before"),
            Series(at + 0.12, mean, "our sessions", error=spread, role="after"),
        ]
        svg = plot(
            series,
            "",
            label_quantity(f"difference of {printed}", rows[0].unit),
            title=f"Differences of {printed}",
            description=f"Printed and simulated differences of {printed} for X and Y by both methods.",
            x_ticks=dict(zip(at, ("X, paper", "X, MMPM", "Y, paper", "Y, MMPM"), strict=True)),
            x_range=(-0.6, 4.1),
            zero=True,
        )
        figures.append(Figure(svg, f"{printed}: by the paper's method and by MMPM."))
    return Section(
        "Figure 3: differences to the measured value",
        words=(
            "Printed values less the measured column, and ours less the truth: mean over the sessions, bars"
            " the standard deviation. Two positions do not determine the offset; it is taken as zero, and"
            " its whole size is drawn as the paper's difference.",
        ),
        figures=figures,
        notes=(f"Command: {done.command} --json (table_1: sessions)",),
    )


def _map(done: Study) -> Section:
    biases = [bias for bias in BIASES_MG if bias]
    lines = [
        Series(
            biases, [crossing_deg(bias, noise) for bias in biases], f"{noise:g} mg of noise", style="line"
        )
        for noise in NOISES_MG
    ]
    title = "Crossing of the paper's method and MMPM in ΔK"
    svg = plot(lines, "bias of an axis / mg", "fixture error / °", title=title, x_log=True, y_log=True)
    return Section(
        "Where the paper's method overtakes MMPM",
        words=(
            "Errors by linear propagation, for a start angle within ±5°. MMPM uses the declared angles:"
            " their errors enter its gains by √(2/9), but the gains of two positions at a small start angle"
            " only by √2 tan α. In Δφ it is the reverse: √(2/9) for MMPM, √2 for two positions. The bias,"
            " which two positions cannot determine, moves the crossing up.",
        ),
        figures=[Figure(svg, "ΔK: above its line the paper's method is better, below it MMPM.")],
        notes=(f"Command: {done.command} --json (crossing_of_delta_k)",),
    )
