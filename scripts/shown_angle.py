"""How far off is the angle that a calibrated goniometer shows? Over a full turn, on fresh positions.

A session of a plan is drawn (white noise of 0.2 mg a reading, stated; declared angles off by the
fixture's error) from a part with hidden start angle, gains, misalignment and whatever its kind says;
every method that the plan allows and, where asked, the trace turn it into a calibration. The part then
stands, without any error of a stage, at 72 angles in the middle between those of common plans, and each
calibration shows its angle:

* `calibration`: of the readings without noise: what the calibration is to blame for, and no averaging
  lowers;
* `total`: of readings with the noise of a dwell.

The bound is that of the model the session was drawn from, effects of known form included
(`information_bound`), propagated to the shown angle at each place, for `total` with the noise of the
fresh reading. Where a plan cannot determine that model (two positions and a bias) there is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.errors import FitError
from adis_gonio.fitting import fit
from adis_gonio.fitting.methods import METHODS, applicable_methods
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.plans import plan
from adis_gonio.tracing.trace import trace
from information_bound import G_MG, Floats, angle_bound, planar_bound, planar_mg, shown_rad

READING_MG = 0.2
BIAS_MG = 10.0
EFFECT_MG = 2.0
PLACES_DEG = 2.5 + 5.0 * np.arange(72)
GREATEST_ALPHA_DEG = 20.0
"""Start angles: far enough from 45°, where method `paper` has its pole."""
KINDS = ("none", "bias", "quadratic", "quadratic, cubic")
PLANS: tuple[tuple[str, int | None], ...] = (
    ("two-position", None), ("four-position", None), ("mmpm", None), ("tumble", 12), ("tumble", 24),
)  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """A plan, a kind of part and a fixture.

    Attributes
    ----------
    positions : int or None
        Angles of the plan; None for its own.
    kind : str
        `none`: neither bias nor effect; else a bias of 10 mg on each axis, and `quadratic` (2 mg/g² on X)
        and `cubic` (2 mg/g³ on Y).
    traced : bool
        Whether the trace is asked too.
    """

    plan: str
    positions: int | None
    kind: str
    fixture_deg: float
    traced: bool = False

    @property
    def angles_deg(self) -> Floats:
        """Declared angles (n,)."""
        return np.array([position.angle_deg for position in plan(self.plan, self.positions).positions])

    @property
    def name(self) -> str:
        """Plan with its number of dwells."""
        return f"{self.plan}, {len(self.angles_deg)} dwells"


@dataclass(frozen=True)
class Draw:
    """Hidden parameters (8,), noise of the readings (n, 2) in mg and errors of the angles (n,) in rad."""

    truth: Floats
    noise_mg: Floats
    away_rad: Floats


@dataclass(frozen=True)
class Shown:
    """Errors in degrees by method.

    Attributes
    ----------
    calibration, total : mapping of str to (sessions, 72) float
        NaN rows where a method refused.
    bound : (sessions, 3, 72) float or None
        `bounds_deg` of each.
    """

    cell: Cell
    calibration: dict[str, Floats]
    total: dict[str, Floats]
    bound: Floats | None


@dataclass(frozen=True)
class Figures:
    """A method in a cell; degrees.

    Attributes
    ----------
    rms, median : float
        Root mean square over turn and sessions; over the turn, median of the sessions.
    largest : float
        Largest error over the turn, median of the sessions.
    bound : float or None
        Root of the mean variance that the bound allows.
    ratio : float or None
        Error over bound, by comparison with the estimator that attains it (see `efficiency.py`).
    half : float or None
        Half of the 95 % interval of the ratio.
    refused : int
        Sessions without an answer.
    """

    rms: float
    median: float
    largest: float
    bound: float | None
    ratio: float | None
    half: float | None
    refused: int


def with_effects_mg(parameters: Floats, psi: Floats) -> Floats:
    """Readings (n, 2) of the base model, K2 on X (mg/g²) and K3 on Y (mg/g³): parameters 7 and 8."""
    bias = parameters[4:6]
    ideal = planar_mg(np.concatenate([parameters[:4], np.zeros(2)]), psi)
    beyond = np.stack(
        [parameters[6] * (ideal[:, 0] / G_MG) ** 2, parameters[7] * (ideal[:, 1] / G_MG) ** 3], 1
    )
    return np.asarray(ideal + bias + beyond)


def shown_with_effects_rad(parameters: Floats, reading_mg: Floats) -> Floats:
    """Angle (n,) that a goniometer shows that knows these effects."""
    ideal = reading_mg - parameters[4:6]
    for _ in range(30):
        beyond = [parameters[6] * (ideal[:, 0] / G_MG) ** 2, parameters[7] * (ideal[:, 1] / G_MG) ** 3]
        ideal = reading_mg - parameters[4:6] - np.stack(beyond, 1)
    return shown_rad(np.concatenate([parameters[:4], np.zeros(2)]), ideal)


def truth_of(kind: str, rng: np.random.Generator) -> Floats:
    """Hidden parameters (8,)."""
    alpha = math.radians(rng.uniform(-GREATEST_ALPHA_DEG, GREATEST_ALPHA_DEG))
    signs = rng.choice([-1.0, 1.0], 4)
    bias = signs[:2] * BIAS_MG * (kind != "none")
    effects = signs[2:] * EFFECT_MG * np.array(["quadratic" in kind, "cubic" in kind])
    return np.array([alpha, *(1 + rng.normal(0, 0.005, 2)), rng.normal(0, 5e-3), *bias, *effects])


def bounds_deg(cell: Cell, draw: Draw) -> Floats | None:
    """Rows (3, 72) in degrees; None where the plan does not determine the model.

    Bound of the calibration's part, of the whole, and the errors that the estimator attaining the bound
    would have made of this session.
    """
    truth = draw.truth
    two = cell.plan == "two-position"
    if two and cell.kind != "none":
        return None
    # Two positions can be evaluated by the one model that they determine: without a bias.
    sees = np.array([True] * 4 + [not two] * 2 + ["quadratic" in cell.kind, "cubic" in cell.kind])
    angles = np.radians(cell.angles_deg)
    least = planar_bound(
        truth, angles, READING_MG, math.radians(cell.fixture_deg), sees=sees, model=with_effects_mg
    )
    own, reading, slope = angle_bound(
        truth,
        least.covariance,
        np.radians(PLACES_DEG),
        READING_MG,
        shown=shown_with_effects_rad,
        model=with_effects_mg,
    )
    away = draw.away_rad if cell.fixture_deg else np.zeros(0)
    attained = slope @ least.error(draw.noise_mg.ravel(), away)
    return np.degrees(np.stack([np.sqrt(own), np.sqrt(own + reading), attained]))


def draw_of(cell: Cell, rng: np.random.Generator) -> Draw:
    """A part and what happens in its session."""
    n = len(cell.angles_deg)
    truth = truth_of(cell.kind, rng)
    return Draw(truth, rng.normal(0, READING_MG, (n, 2)), rng.normal(0, math.radians(cell.fixture_deg), n))


def session_of(cell: Cell, draw: Draw) -> Session:
    """The session, of averaged readings whose uncertainty is stated."""
    approaches = [position.approach for position in plan(cell.plan, cell.positions).positions]
    angles = cell.angles_deg
    readings = with_effects_mg(draw.truth, draw.away_rad - np.radians(angles)) + draw.noise_mg
    dwells = tuple(
        Dwell(k, np.array([15.0 * k]), reading[None], float(angle), approach)
        for k, (reading, angle, approach) in enumerate(zip(readings, angles, approaches, strict=True))
    )
    return Session(
        dwells,
        sensor="generic",
        accel_unit="mg",
        fixture_sigma_deg=cell.fixture_deg,
        reading_u_mg=READING_MG,
    )


def measure(cell: Cell, sessions: int, seed: Sequence[int]) -> Shown:
    """Errors of every method."""
    rng = np.random.default_rng(seed)
    calibration: dict[str, list[Floats]] = {}
    total: dict[str, list[Floats]] = {}
    bounds = []
    for _ in range(sessions):
        draw = draw_of(cell, rng)
        session = session_of(cell, draw)
        exact = with_effects_mg(draw.truth, -np.radians(PLACES_DEG))
        fresh = np.concatenate([exact, exact + rng.normal(0, READING_MG, exact.shape)])
        bounds.append(bounds_deg(cell, draw))
        for method in (*applicable_methods(session), *(["trace"] if cell.traced else [])):
            error = _errors(session, method, fresh)
            calibration.setdefault(method, []).append(error[: len(exact)])
            total.setdefault(method, []).append(error[len(exact) :])
    known = [one for one in bounds if one is not None]
    return Shown(
        cell,
        {method: np.array(rows) for method, rows in calibration.items()},
        {method: np.array(rows) for method, rows in total.items()},
        np.array(known) if known else None,
    )


def _errors(session: Session, method: str, fresh_mg: Floats) -> Floats:
    """Shown minus true angle (144,) in degrees; NaN where the method refuses."""
    try:
        result = trace(session) if method == "trace" else fit(session, method)
        shown = result.calibration().stage_angle(fresh_mg).angle_deg
    except FitError:
        return np.full(len(fresh_mg), math.nan)
    return np.asarray((shown - np.tile(PLACES_DEG, 2) + 180) % 360 - 180)


def figures(shown: Shown, method: str, part: str = "calibration") -> Figures:
    """Error of a method against the bound."""
    whole = part == "total"
    errors = (shown.total if whole else shown.calibration)[method]
    there = np.isfinite(errors).all(axis=1)
    refused = int((~there).sum())
    if refused == len(errors):
        return Figures(math.nan, math.nan, math.nan, None, None, None, refused)
    errors = errors[there]
    squares = (errors**2).mean(axis=1)
    rms = math.sqrt(float(squares.mean()))
    median = math.sqrt(float(np.median(squares)))
    largest = float(np.median(np.abs(errors).max(axis=1)))
    if shown.bound is None:
        return Figures(rms, median, largest, None, None, None, refused)
    least = shown.bound[there]
    bound = math.sqrt(float((least[:, int(whole)] ** 2).mean()))
    # Beside the errors of the attaining estimator, whose mean square is the bound.
    beside = squares - (least[:, 2] ** 2 - least[:, 0] ** 2).mean(axis=1)
    ratio = math.sqrt(max(float(beside.mean()), 0.0)) / bound
    spread = float(beside.std(ddof=1)) if len(beside) > 1 else math.nan
    half = 1.96 * spread / math.sqrt(len(beside)) / (2 * max(ratio, 1e-9) * bound**2)
    return Figures(rms, median, largest, bound, ratio, half, refused)


def cells(fixtures_deg: Sequence[float], traced_at_deg: float) -> list[Cell]:
    """All plans, kinds and fixtures; effects only where a plan can tell them; the trace at one fixture."""
    found = []
    for name, positions in PLANS:
        many = name in ("mmpm", "tumble")
        for kind in KINDS if many else KINDS[:2]:
            found += [Cell(name, positions, kind, f, many and f == traced_at_deg) for f in fixtures_deg]
    return found


def _job(job: tuple[Cell, int, tuple[int, ...]]) -> Shown:
    return measure(*job)


def measure_all(chosen: Sequence[Cell], sessions: int, traced: int, seed: int, jobs: int) -> list[Shown]:
    """Errors of all cells, `traced` sessions where the trace is asked, in processes."""
    work = [(cell, traced if cell.traced else sessions, (seed, 7, k)) for k, cell in enumerate(chosen)]
    if jobs < 2:
        return [_job(one) for one in work]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(_job, work))


ORDER = (*METHODS, "trace")
"""Methods as they stand in tables."""
