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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import with_progress
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import finite
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
    def quantity(self) -> str:
        """Name of the row's quantity in `true_values`; the rows of X and Y share the angle between them."""
        return self.key if self.key == "non_orthogonality" else f"{self.key}_{self.axis}"


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

_FROM_FIT = {
    "scale_error_x": ("scale_x", 1.0, 1.0),
    "scale_error_y": ("scale_y", 1.0, 1.0),
    "offset_x": ("bias_x", 1e-3, 0.0),
    "offset_y": ("bias_y", 1e-3, 0.0),
    "non_orthogonality": ("delta_phi", 1.0, 0.0),
    "delta_k": ("delta_k", 1.0, 0.0),
}
"""Parameter of `fit`, factor and zero for each quantity of the paper: (value − zero) · factor."""


def true_values(column: Axis) -> dict[str, float]:
    """Return the true values of the seed paper's quantities in the sessions simulated for one axis.

    The paper's table has a column for each axis.

    They are the relative scale errors, the offsets in g, the non-orthogonality in degrees, and ΔK. `column`
    decides the value of the non-orthogonality.
    """
    rows = (row for row in TABLE if row.key != "non_orthogonality" or row.axis == column)
    true = {row.quantity: row.measured for row in rows}
    return true | {"delta_k": (1 + true["scale_error_x"]) / (1 + true["scale_error_y"]) - 1}


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
    true = true_values(column)
    return {
        "scale_y": 1 + true["scale_error_y"],
        "delta_k": true["delta_k"],
        "delta_phi_deg": true["non_orthogonality"],
        "bias_x_mg": 1000 * true["offset_x"],
        "bias_y_mg": 1000 * true["offset_y"],
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


Quantities = Mapping[str, tuple[float | None, float | None]]
"""Value and standard uncertainty of each quantity of `true_values`; None if a method does not give it."""


def quantities(result: FitResult | TraceResult) -> Quantities:
    """Return the result of a fit or a trace in the quantities of the paper.

    The paper's method gives ΔK and Δφ only. Its scales follow from them: the scale of X from equation 6
    (the length of (U_x1, U_x2)), the scale of Y from the scale of X and ΔK.
    """
    found: dict[str, tuple[float | None, float | None]]
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
    taken = {}
    for quantity, (name, factor, zero) in _FROM_FIT.items():
        value, u = found.get(name, (None, None))
        taken[quantity] = (
            None if value is None else (value - zero) * factor,
            None if u is None else u * factor,
        )
    return taken


Results = Mapping[str, Quantities]
"""Values and uncertainties by method for one simulated sensor; a method without a result is missing."""


def results_of(url: str, traced: bool = False) -> Results:
    """Record the sessions of one simulated sensor and apply every method; `traced` adds the trace."""
    sessions = {name: measured(url, name) for name in set(USES.values())}
    found: dict[str, Quantities] = {}
    for method, used in USES.items():
        with suppress(FitError):
            found[method] = quantities(fit(sessions[used], method))
    if traced:
        found[TRACED] = quantities(trace(sessions["mmpm"]))
    return found


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


def propagated_errors(
    fixture_deg: float, bias_mg: float, noise_mg: float
) -> dict[str, tuple[float, float]]:
    """Return the errors of ΔK and of Δφ (rad), each by the paper's method and by MMPM.

    They follow by linear propagation from the standard deviations of a declared angle (`fixture_deg`), of
    the bias of an axis (`bias_mg`) and of a reading (`noise_mg`). In the paper's method, from two
    positions, the error of a declared angle contributes to ΔK with the factor √2 tan α (α is the start
    angle) and to Δφ with the factor √2. In MMPM, from nine positions, both factors are √(2/9).
    """
    true = true_values("x")
    gain = 1 + (true["scale_error_x"] + true["scale_error_y"]) / 2
    noise, bias = 1e-3 * noise_mg / gain, 1e-3 * bias_mg / gain
    fixture = math.radians(fixture_deg)
    two, nine = 2 * (noise**2 + bias**2), 4 / 9 * noise**2 + 2 / 9 * fixture**2
    return {
        "delta_k": (math.sqrt(two + 2 * _MEAN_SQUARE_TANGENT * fixture**2), math.sqrt(nine)),
        "delta_phi": (math.sqrt(two + 2 * fixture**2), math.sqrt(nine)),
    }


def crossing_deg(bias_mg: float, noise_mg: float) -> float:
    """Return the error of a declared angle above which the paper's method is better than MMPM.

    The result is a standard deviation in degrees. The better method has the smaller error of ΔK. `bias_mg`
    and `noise_mg` are the standard deviations of a bias and of a reading.
    """
    two, nine = propagated_errors(0.0, bias_mg, noise_mg)["delta_k"]
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

    def spread(self, axis: Axis, method: str, quantity: str) -> MethodSpread:
        """Return the statistics of a quantity by a method, over the sensors of the column `axis`.

        All fields but `sessions` are None if the method does not determine the quantity.
        """
        rows = [one[method][quantity] for one in self.results[axis] if method in one]
        values = np.array([value for value, _ in rows if value is not None])
        stated = np.array([u for value, u in rows if value is not None and u is not None])
        if not values.size:
            return MethodSpread()
        return MethodSpread(
            float(values.mean()),
            float(values.std(ddof=1)) if len(values) > 1 else None,
            rms(stated) if stated.size else None,
            rms(values - true_values(axis)[quantity]),
            len(values),
        )

    def ours(self, axis: Axis, quantity: str) -> dict[str, MethodSpread]:
        """Return the statistics of a quantity by each method, over the sensors of the column `axis`."""
        return {method: self.spread(axis, method, quantity) for method in METHODS}

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON document that `adis-gonio paper --json` prints."""
        rows = [
            {"name": row.name, **asdict(row), "sessions": self.ours(row.axis, row.quantity)}
            for row in TABLE
        ]
        document = {
            "command": f"{self.command} --json",
            "software": f"adis-gonio {__version__}",
            "seed": self.seed,
            "sessions": self.sessions,
            "dwell_s": DWELL_S,
            "truth": {f"column_{column}": settings_of(column) for column in AXES},
            "table_1": {
                "rows": rows,
                "delta_k": self.ours("x", "delta_k"),
                "rmsd_of_the_specification": RMSD,
            },
            "crossing_of_delta_k": [
                {"bias_mg": bias, "noise_mg": noise, "fixture_deg": crossing_deg(bias, noise)}
                for noise in NOISES_MG
                for bias in BIASES_MG
            ],
        }
        found: dict[str, Any] = finite(document)
        return found


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
    angle = next(row for row in TABLE if row.key == "non_orthogonality")
    theirs, nine = (format_number(done.spread("x", method, angle.quantity).error, 2) for method in COLUMNS)
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
            one = done.spread(row.axis, method, row.quantity)
            spread = f"{NO_BREAK}({format_fixed(one.spread or 0.0, 4)})"
            texts += [
                format_fixed(getattr(row, method), 4),
                "not determined" if one.mean is None else format_fixed(one.mean, 4) + spread,
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
    for name, printed, unit in dict.fromkeys((row.key, row.printed, row.unit) for row in TABLE):
        rows = [row for row in TABLE if row.key == name]
        at = [
            (2.5 * k + place, row, method, done.spread(row.axis, method, row.quantity))
            for k, row in enumerate(rows)
            for place, method in enumerate(COLUMNS)
        ]
        series = [
            Series(
                [x - 0.12 for x, *_ in at],
                [getattr(row, method) - row.measured for _, row, method, _ in at],
                "printed",
                role="before",
            ),
            Series(
                [x + 0.12 for x, *_ in at],
                [(ours.mean or 0.0) - row.measured for _, row, _, ours in at],
                "our sessions",
                error=[ours.spread or 0.0 for *_, ours in at],
                role="after",
            ),
        ]
        svg = plot(
            series,
            "",
            label_quantity(f"difference of {printed}", unit),
            title=f"Differences of {printed}",
            description=f"Printed and simulated differences of {printed} for X and Y by both methods.",
            x_ticks={0.0: "X, paper", 1.0: "X, MMPM", 2.5: "Y, paper", 3.5: "Y, MMPM"},
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
