"""Simulated sessions for the comparison: through chip and driver, as `adis-gonio simulate` records them.

Every part is measured twice on its stage: at four positions, every 90°, and at nine, every 40°. The
paper's method, the closed form and `four-position` use the first, MMPM, `ml` and the trace the second.

Table 1 and figure 3 from our sessions, and what a bias of 10 mg does to each method.

What the paper leaves open: the reading chosen, why, and what another reading would give.

Numbers are computed from noise-free readings of the planar model with the table's gains and Δφ, except
where the question is about noise, or about a cause that the simulated world has.

All of it: sessions, table, map, bias, ambiguities, from one seed.
"""

from __future__ import annotations

import math
import os
import shlex
import signal
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import current, told
from adis_gonio.base.errors import FitError, UsageError
from adis_gonio.base.jsonable import JsonRecord, json_object, key
from adis_gonio.base.version import __version__
from adis_gonio.bench.runner import SessionRunner
from adis_gonio.device.sensor import open_sensor
from adis_gonio.fitting import fit
from adis_gonio.fitting.closed_form import FOUR, as_printed
from adis_gonio.fitting.result import FitResult
from adis_gonio.handover.paper_map import (
    AXES,
    DRAWS,
    MMPM_ANGLES_DEG,
    RMSD,
    TABLE,
    Axis,
    Draws,
    Map,
    TableRow,
    Truth,
    by_positions,
    map_of,
    readings,
    rms,
    row_of,
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
"""Method → the plan whose session it is applied to; `ml` on MMPM's own nine dwells."""
TRACED = "traced"
METHODS = (*USES, TRACED)


@dataclass(frozen=True)
class Part:
    """A simulated part on its stage.

    Attributes
    ----------
    seed : int
        Of the simulator: start angle within ±5°, noise and the stage's errors.
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
            "bias_x_mg": truth.bias_mg[0],
            "bias_y_mg": truth.bias_mg[1],
            **self.settings,
        }

    @property
    def url(self) -> str:
        """Of the simulated sensor."""
        settings = "".join(f"&{name}={float(value)!r}" for name, value in self._pairs().items())
        return f"sim:?seed={self.seed}{settings}" + (f"&effects={self.effects}" if self.effects else "")

    def command(self, plan_name: str, output: str = "one.session") -> str:
        """The `simulate` that records the same session."""
        words = ["adis-gonio", "simulate", "--plan", plan_name, "--dwell", f"{DWELL_S:g}"]
        words += ["--seed", str(self.seed)]
        for name, value in self._pairs().items():
            words += ["--set", f"{name}={float(value)!r}"]
        if self.effects:
            words += ["--effect", self.effects]
        return shlex.join([*words, "-o", output])


def measured(part: Part, plan_name: str) -> Session:
    """Record one session of a part."""
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
    """What a method gives for one part; None where it does not determine it.

    Attributes
    ----------
    values, u : mapping of str to float or None
        By `scale_error_x`, `scale_error_y`, `offset_x`, `offset_y` (g), `non_orthogonality` (degree) and
        `delta_k`, with standard uncertainties.
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
"""The paper's quantities: (name − zero) · factor of a parameter of `fit`."""


def quantities(result: FitResult | TraceResult) -> MethodValues:
    """The paper's parameters from a result.

    The paper gives ΔK and Δφ only. Its scales are those that go with them: X's from equation 6, the
    length of (U_x1, U_x2), and Y's from that and ΔK.
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
    """What each method gave for one part; a method that refused is not there, its reason in `refused`."""

    part: Part
    found: Mapping[str, MethodValues]
    refused: Mapping[str, str] = field(default_factory=dict)


def results_of(part: Part, traced: bool = False) -> Results:
    """Measure a part and apply every method."""
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
    """Results of many parts in their order; each with whether it is traced too."""
    if jobs <= 1:
        return [results_of(*one) for one in told(parts)]
    # Ctrl-C is the parent's to answer: it ends the pool in order, without a traceback from each process.
    with ProcessPoolExecutor(
        jobs, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN)
    ) as pool:
        done = pool.map(results_of, *zip(*parts, strict=True))
        return [one for one, _ in zip(done, told(parts), strict=True)]


def facts_of(results: Results) -> dict[str, Any]:
    """JSON form of one part's results."""
    return {
        "seed": results.part.seed,
        "values": {method: dict(found.values) for method, found in results.found.items()},
        "u": {method: dict(found.u) for method, found in results.found.items()},
        "refused": dict(results.refused),
    }


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


ALPHA_DEG = 5.0
"""Start angle of the examples: the largest that the simulated stage draws."""
K2_MG = 3.0
"""Quadratic term of X in mg/g² for the question of the static load."""
_NOISE_G = 1e-4
_DRAWS = 20_000


@dataclass(frozen=True)
class LabelledValue:
    """A number with its words: `as read`, or `with the other reading`."""

    name: str
    value: float | None
    unit: str


@dataclass(frozen=True)
class Ambiguity(JsonRecord):
    """An open question of the paper.

    Attributes
    ----------
    what : str
        The question in a few words.
    reading, why : str
        The reading chosen, and the reason.
    values : tuple of LabelledValue
        By the reading chosen and by others.
    """

    what: str
    reading: str
    why: str
    values: tuple[LabelledValue, ...] = ()


def two_readings(alpha_deg: float, *, turn: int = 1) -> Floats:
    """U_x1, U_y1, U_x2, U_y2 without noise and bias; `turn` −1: the stage turned the other way."""
    at = readings(
        truth_of("x"), [0.0, 90.0 * turn], np.radians([alpha_deg]), np.zeros((1, 2)), np.zeros((1, 2, 2))
    )
    return np.asarray(at[0].ravel())


def load_parts(seed: int) -> tuple[Part, Part]:
    """The same part without and with a gain that depends on the load, same noise in both."""
    part = Part(seed, truth_of("x"))
    return part, replace(part, effects=f"quadratic:k2_x={K2_MG:g}")


def ambiguities(rng: np.random.Generator, load: Sequence[Results]) -> tuple[Ambiguity, ...]:
    """All of them.

    Parameters
    ----------
    rng : Generator
        Draws the noise at 45°.
    load : sequence of two Results
        Of `load_parts`.
    """
    return (
        _other_axis(),
        _sense(),
        _equation_10(),
        _pole(rng),
        _units(),
        _sign_of_n(),
        _two_angles(),
        _static_load(load),
        Ambiguity(
            "The part's name",
            "ADIS16354",
            "The paper writes ADIS16534 in places; no part is called so.",
        ),
    )


def _other_axis() -> Ambiguity:
    x1, y1, x2, y2 = two_readings(ALPHA_DEG)
    return Ambiguity(
        "U_x′ in equation 5, ΔK = U_x/U_x′ − 1",
        "What the other axis reads in the place where X was: −U_y2.",
        "Only so does the quotient compare two gains. The other candidates depend on the start angle"
        " first.",
        (
            LabelledValue("ΔK, true", truth_of("x").delta_k, "1"),
            LabelledValue("ΔK with U_x′ = −U_y2", x1 / -y2 - 1, "1"),
            LabelledValue("ΔK with U_x′ = U_x2 (X itself after the turn)", x1 / x2 - 1, "1"),
            LabelledValue("ΔK with U_x′ = U_y1 (Y before the turn)", x1 / y1 - 1, "1"),
        ),
    )


def _sense() -> Ambiguity:
    right, wrong = two_readings(ALPHA_DEG), two_readings(ALPHA_DEG, turn=-1)
    with np.errstate(invalid="ignore"):
        values = [as_printed(*reading) for reading in (right, wrong)]
    return Ambiguity(
        "The sign of the turn",
        "Equation 6 fixes it: at 90° X reads K_x G sin α and Y reads −K_y G cos(Δφ + α).",
        "The figure does not show it. Turned the other way both readings change their sign, and equation 5"
        " compares a gain with its negative.",
        (
            LabelledValue("ΔK with this sense", float(values[0][0]), "1"),
            LabelledValue("ΔK of a stage that turns the other way", float(values[1][0]), "1"),
            LabelledValue("Δφ with this sense", math.degrees(values[0][1]), "deg"),
            LabelledValue("Δφ of a stage that turns the other way", math.degrees(values[1][1]), "deg"),
        ),
    )


def _equation_10() -> Ambiguity:
    x1, y1, x2, y2 = two_readings(ALPHA_DEG)
    gain = x1 / -y2
    a, b = gain * y1 / x1, gain * y2 / x2
    alpha = math.radians(ALPHA_DEG)
    literal = (1 + alpha * b) / (alpha + b)
    return Ambiguity(
        "Equation 10 as printed mixes α and a, and has an equals sign too many",
        "sin Δφ = (1 + ab)/(a + b), a = U_y1/U_x1, b = U_y2/U_x2.",
        "Equations 11 and 12 follow from this form and from no other.",
        (
            LabelledValue("Δφ, true", truth_of("x").delta_phi_deg, "deg"),
            LabelledValue("Δφ with a", math.degrees(math.asin((1 + a * b) / (a + b))), "deg"),
            LabelledValue(
                "Δφ with α (in radians) in the place of a", math.degrees(math.asin(literal)), "deg"
            ),
        ),
    )


def _pole(rng: np.random.Generator) -> Ambiguity:
    values = []
    noise = _NOISE_G * rng.standard_normal((_DRAWS, 2, 2))
    for alpha in (5.0, 30.0, 44.0, 45.0):
        at = readings(
            truth_of("x"), FOUR[:2], np.full(_DRAWS, math.radians(alpha)), np.zeros((_DRAWS, 2)), noise
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            phi = as_printed(at[:, 0, 0], at[:, 0, 1], at[:, 1, 0], at[:, 1, 1])[1]
        finite = np.degrees(phi[np.isfinite(phi)])
        # Half the width of the middle 68 %: at the pole there is no variance.
        low, high = np.quantile(finite, (0.1587, 0.8413))
        values.append(LabelledValue(f"spread of Δφ at α = {alpha:g}°", float(high - low) / 2, "deg"))
    exact = np.degrees(by_positions(FOUR[:2], at, bias=False)[:, 3])
    values.append(LabelledValue("the same at 45° by two-position", float(exact.std()), "deg"))
    return Ambiguity(
        "The singularity at 45°",
        "The method is applied as printed, and refused where a + b of equation 12 nearly vanishes.",
        "The paper does not mention it. The closed form of the same four readings has no such place. Here a"
        f" reading has a noise of {_NOISE_G:g} G; the spread is half the width of the middle 68 %.",
        tuple(values),
    )


def _units() -> Ambiguity:
    two_sigma = math.degrees(math.sqrt(2) * 0.16e-3)
    return Ambiguity(
        "The table's units: Δφ in “g/deg/s”, SF and N without",
        "Δφ is the offset of zeros of equation 2 in g, N the angle of equation 3 in degrees, SF the"
        " relative error K − 1.",
        "The paper uses Δφ twice. As an angle in degrees the table's −0.003 would be far below what two"
        " readings can show; N in radians would be beyond any part. Whether “after” is what a method gives"
        " or what it leaves is not said either: as what is left, each would leave more than half of SF.",
        (
            LabelledValue(
                "standard deviation of Δφ from two readings with a noise of 0.16 mg", two_sigma, "deg"
            ),
            LabelledValue("the table's Δφ of X, were it an angle", row_of("offset", "x").measured, "deg"),
            LabelledValue(
                "the table's N of X, were it in radians",
                math.degrees(row_of("non_orthogonality", "x").measured),
                "deg",
            ),
        ),
    )


def _sign_of_n() -> Ambiguity:
    angles = [-a for a in MMPM_ANGLES_DEG]
    at = readings(truth_of("x"), angles, np.radians([ALPHA_DEG]), np.zeros((1, 9)), np.zeros((1, 9, 2)))
    phi = float(np.degrees(by_positions(MMPM_ANGLES_DEG, at, bias=True)[0, 3]))
    folded = (phi + 90.0) % 180.0 - 90.0
    verdicts = printed_verdicts()
    signed = sum(v["nearer"] == "paper" for v in verdicts.values())
    sizes = sum(v["nearer_without_sign"] == "paper" for v in verdicts.values())
    return Ambiguity(
        "The jump of sign of N: measured and the paper's positive, MMPM's negative",
        "The table's numbers are shown as printed; a sense of turn that differs between the two is the"
        " likely cause.",
        "MMPM finds −Δφ (beside a gain of Y of the other sign) where the stage turned against what was"
        " declared, and the printed sizes are alike. On the sign alone rests that the paper's method is"
        " nearer to the measured column anywhere in its table.",
        (
            LabelledValue(
                "N by MMPM of X's truth, turned as declared",
                row_of("non_orthogonality", "x").measured,
                "deg",
            ),
            LabelledValue("N by MMPM, turned the other way (modulo 180°)", folded, "deg"),
            LabelledValue("N by MMPM as printed", row_of("non_orthogonality", "x").mmpm, "deg"),
            LabelledValue(f"of {len(TABLE)} rows as printed, the paper's method is nearer in", signed, ""),
            LabelledValue("of as many without signs", sizes, ""),
        ),
    )


def _two_angles() -> Ambiguity:
    x, y = (row_of("non_orthogonality", axis).measured for axis in ("x", "y"))
    return Ambiguity(
        "Two values of N, one angle between X and Y",
        "Two determinations of the same angle: sessions of column X have Δφ = 0.0612°, of column Y"
        " 0.0673°.",
        "A turn in one plane cannot tell how each axis leans, only how far their angle is from 90°; in each"
        " column of the table but the first the two values are the same within 0.002°.",
        (
            LabelledValue("Δφ, column X", x, "deg"),
            LabelledValue("Δφ, column Y", y, "deg"),
            LabelledValue("Δφ if each were the lean of its axis towards the other", x + y, "deg"),
        ),
    )


def _static_load(load: Sequence[Results]) -> Ambiguity:
    values = []
    for method, quantity, name, unit in (
        ("paper", "delta_k", "ΔK", "1"),
        ("paper", "non_orthogonality", "Δφ", "deg"),
        ("mmpm", "delta_k", "ΔK", "1"),
        ("mmpm", "offset_x", "offset of X", "g"),
    ):
        before, after = (one.found[method].values[quantity] for one in load)
        moved = None if before is None or after is None else after - before
        values.append(LabelledValue(f"{name} by {method} moves by", moved, unit))
    return Ambiguity(
        "A “static load” that moves gain and zero",
        "Gravity along the axis is the load: a quadratic term of the response, part of which is read as"
        " gain and part as zero.",
        "Nothing else in a goniometer loads the part. A load on the stage would bend it and turn the part,"
        " which is an error of the angle and no property of the sensor. Here X has"
        f" {K2_MG:g} mg/g², the session with and without it, through chip and driver.",
        tuple(values),
    )


SESSIONS = 10
LEAST_SESSIONS, MOST_SESSIONS = 2, 10_000
TRACED_SHARE = 5
"""One part of so many is traced, at least one, of each column and of those with a bias."""
_TRACED = (*AXES, "bias")
_MOST_JOBS = 8


@dataclass(frozen=True)
class Study:
    """The paper reproduced.

    Attributes
    ----------
    seed, sessions : int
        What it was asked for: seed of all that is random, parts of each kind.
    results : mapping of str to sequence of Results
        Parts of column `x` and `y` of the table, and those with `bias`.
    """

    seed: int
    sessions: int
    table: Comparison
    map: Map
    bias: BiasError
    ambiguities: tuple[Ambiguity, ...]
    results: Mapping[str, Sequence[Results]]

    @property
    def command(self) -> str:
        """The command that makes it again."""
        return f"adis-gonio paper --seed {self.seed} --sessions {self.sessions}"

    def as_dict(self) -> dict[str, Any]:
        """The JSON document of `paper`."""
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
            "ambiguities": [one.as_dict() for one in self.ambiguities],
            "parts": {
                kind: [facts_of(one) | {"command": one.part.command("mmpm")} for one in done]
                for kind, done in self.results.items()
            },
        }


def reproduce(
    seed: int = 0, sessions: int = SESSIONS, jobs: int | None = None, *, draws: int = DRAWS
) -> Study:
    """Reproduce the paper.

    Parameters
    ----------
    seed : int
        Everything that is drawn comes from here; not negative.
    sessions : int
        Parts of each kind: of either column, and with a bias.
    jobs : int, optional
        Processes; by default one a core.
    draws : int
        Sessions by readings at each point of the map.

    Raises
    ------
    UsageError
        A seed or a number of sessions that is not possible.
    """
    if seed < 0:
        raise UsageError(f"--seed is {seed}: take 0 or more")
    if not LEAST_SESSIONS <= sessions <= MOST_SESSIONS:
        raise UsageError(f"--sessions is {sessions}: take {LEAST_SESSIONS} to {MOST_SESSIONS}")
    tell = current().tell
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6)]
    seeding, mapping, biased, _, again, at_pole = streams
    tell("the map, by readings")
    mapped = map_of(truth_of("x"), Draws.of(mapping, draws))
    kinds: dict[str, list[Part]] = {
        column: parts_of_column(column, [int(s) for s in seeding.integers(2**31, size=sessions)])
        for column in AXES
    }
    kinds["bias"] = parts_with_bias(biased, sessions)
    kinds["load"] = list(load_parts(int(seeding.integers(2**31))))
    tell("sessions through chip and driver")
    results = _measured(
        kinds, max(1, sessions // TRACED_SHARE), jobs or min(os.cpu_count() or 1, _MOST_JOBS)
    )
    columns: dict[Axis, Sequence[Results]] = {axis: results[axis] for axis in AXES}
    return Study(
        seed,
        sessions,
        table_of(columns),
        mapped,
        errors_with_bias(results["bias"], again),
        ambiguities(at_pole, results["load"]),
        results,
    )


def _measured(kinds: Mapping[str, Sequence[Part]], traced: int, jobs: int) -> dict[str, Sequence[Results]]:
    """Results by kind; the first parts of the kinds `_TRACED` are traced too."""
    work = [
        (part, k < traced and kind in _TRACED)
        for kind, parts in kinds.items()
        for k, part in enumerate(parts)
    ]
    done = iter(all_results(work, jobs))
    return {kind: [next(done) for _ in parts] for kind, parts in kinds.items()}
