"""Does `ml` use all that readings tell? Mean square error of every parameter against the Cramér–Rao bound.

Sessions with hidden start angle, gains, misalignment and biases, in the plane with declared angles that are
off by the fixture's error, and in space with attitudes that nobody declares; fitted by the public `fit`.
The bound (`information_bound.py`) knows nothing of the package. Efficiency is bound / mean square error, so
that a bias of the estimate counts as well. Kinds of readings:

* `stated`: averaged readings with white noise of 0.2 mg whose uncertainty is stated;
* `samples`: dwells of 400 samples with white noise: the fit has to find its size;
* `flicker`: the same with the simulator's 1/f noise of the ADIS16354, which dwells share; the bias is that
  of the session (its own and the mean of the 1/f noise over the dwells).

Two intervals of 95 % are given. The plain one knows errors only: 1.96 √(2/N). The other compares, session
by session, with the errors that the estimator attaining the bound would have made of the same draws: its
mean square is the bound, exactly, so that only what `ml` does otherwise is left to chance (control
variate).

    python scripts/efficiency.py                          # 2000 sessions a line, a fresh seed
    python scripts/efficiency.py --sessions 200 --seed 1 --kind flicker
    python scripts/efficiency.py --json efficiency.json

Exits with 1 where an efficiency is below 0.98 beyond doubt, a bias is more than 0.1 of the root of the
bound beyond doubt, or the uncertainty that the fit states of readings with a stated one is off the bound
by more than 1 % in the middle one of the sessions.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from adis_gonio.fitting import FitResult, fit
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim.noise import Flicker
from information_bound import (
    SPATIAL,
    Bound,
    Floats,
    planar_bound,
    planar_mg,
    slopes,
    spatial_bound,
    spatial_mg,
)

REPORTED = ("delta_k", "delta_phi", "alpha", "scale_x", "scale_y", "bias_x", "bias_y")
POSITIONS = (12, 24, 48)
FIXTURES_DEG = (0.0, 0.01, 0.03, 0.1)
TARGET = 0.98
READING_MG = 0.2
"""A dwell of 819 samples of 4.7 mg."""
SAMPLES, RATE_HZ = 400, 40.0
FLICKER_MG = 0.1
"""Bias instability of the ADIS16354, an estimate (`device/sensor/registers.py`)."""
TRUTHS = 20
"""Hidden values that the sessions of a line share out among them: the bound is computed once for each."""


@dataclass(frozen=True)
class Case:
    """One line: kind of readings, positions, fixture in degrees (None: poses in space)."""

    kind: str
    positions: int
    fixture_deg: float | None

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that are looked at."""
        return SPATIAL if self.fixture_deg is None else REPORTED


CASES = {
    "stated": [
        *(Case("stated", n, f) for n in POSITIONS for f in FIXTURES_DEG),
        *(Case("stated", n, None) for n in POSITIONS),
    ],
    "samples": [*(Case("samples", n, f) for n in (12, 24) for f in (0.0, 0.03)), Case("samples", 24, None)],
    "flicker": [Case("flicker", n, 0.03) for n in (12, 24)],
}


@dataclass(frozen=True)
class Line:
    """One parameter of one case.

    Attributes
    ----------
    efficiency, low, high : float
        Bound over mean square error, and its interval of 95 % by comparison with the attaining estimator.
    plain, plain_half : float
        The same by the errors alone, and half of its interval.
    bias, bias_half : float
        Mean error in roots of the bound, and half of its interval, by comparison too.
    stated : float
        Median of u² that the fit states, over the bound. With 1/f noise u of a bias holds half its Allan
        variance more: the bias of another day (`fitting/estimation/spectrum.py`).
    """

    case: Case
    parameter: str
    sessions: int
    efficiency: float
    low: float
    high: float
    plain: float
    plain_half: float
    bias: float
    bias_half: float
    stated: float

    @property
    def missed(self) -> list[str]:
        """Targets that it misses beyond doubt."""
        found = []
        if self.high < TARGET:
            found.append("efficiency")
        if abs(self.bias) - self.bias_half > 0.1:
            found.append("bias")
        if self.case.kind == "stated" and abs(self.stated - 1) > 0.01:
            found.append("stated")
        return found


def flicker_covariance(begin_s: Floats, length_s: float, floor_mg: float, step_s: float = 1 / 16) -> Floats:
    """Covariance (n, n) of the means of dwells by the simulator's 1/f noise, written out anew.

    First-order processes of equal variance floor²/2 with corners an octave apart: a process of corner c
    has the autocovariance exp(−2π c |t|), whose mean over two intervals is an integral in closed form.
    """
    octaves = int(np.floor(np.log2(0.15 / (step_s * 2.0**-15)))) + 1
    gap = np.abs(begin_s[:, None] - begin_s[None, :])
    total = np.zeros_like(gap)
    for corner in 2.0**-15 * 2.0 ** np.arange(octaves):
        a = 2 * math.pi * corner
        own = 2 * (a * length_s + math.expm1(-a * length_s)) / (a * length_s) ** 2
        apart = np.exp(-a * gap) * (2 * math.cosh(a * length_s) - 2) / (a * length_s) ** 2
        total += np.where(gap == 0, own, apart)
    return np.asarray(floor_mg**2 / 2 * total)


class Planar:
    """Sessions of one hidden truth, evenly spaced over the turn."""

    def __init__(self, case: Case, rng: np.random.Generator) -> None:
        self.case, n = case, case.positions
        self.sigma = math.radians(case.fixture_deg or 0.0)
        self.angles = np.arange(n) * 2 * math.pi / n
        self.truth = np.array(
            [
                rng.uniform(-math.pi, math.pi),
                *(1 + rng.normal(0, 0.005, 2)),
                rng.normal(0, 5e-3),
                *rng.normal(0, 20, 2),
            ]
        )
        self.length_s = SAMPLES / RATE_HZ
        self.begin_s = np.arange(n) * (self.length_s + 5.0)
        self.flicker = None
        if case.kind == "flicker":
            self.flicker = flicker_covariance(self.begin_s, self.length_s, FLICKER_MG)
        bound = planar_bound(self.truth, self.angles, READING_MG, self.sigma, flicker_mg2=self.flicker)
        self.bound = _through(bound, slopes(_reported, self.truth))

    def draw(self, rng: np.random.Generator) -> tuple[Session, Floats, Floats]:
        """Session, true `REPORTED`, and the errors of the estimator that attains the bound."""
        n, case = self.case.positions, self.case
        away = rng.normal(0, self.sigma, n) if self.sigma else np.zeros(0)
        clean = planar_mg(self.truth, (away if self.sigma else 0.0) - self.angles)
        samples, noise, slow = _samples(case.kind, clean, self.begin_s, rng)
        truth = _reported(self.truth + np.array([0, 0, 0, 0, *slow.mean(axis=0)]))
        nuisance = np.concatenate([away, slow.T.ravel()]) if self.flicker is not None else away
        session = _session(case, samples, self.begin_s, np.degrees(self.angles), case.fixture_deg or 0.0)
        return session, truth, self.bound.error(noise.ravel(), nuisance)


class Spatial:
    """The same in space: poses spread over the sphere, turned at random as a whole."""

    def __init__(self, case: Case, rng: np.random.Generator) -> None:
        self.case, n = case, case.positions
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        self.gravity = spread_over_sphere(n) @ turn
        self.begin_s = np.arange(n) * (SAMPLES / RATE_HZ + 5.0)
        self.truth = np.concatenate(
            [1 + rng.normal(0, 0.005, 3), rng.normal(0, 5e-3, 3), rng.normal(0, 20, 3)]
        )
        self.unit = np.array([1.0] * 3 + [180 / math.pi] * 3 + [1.0] * 3)
        self.bound = _through(spatial_bound(self.truth, self.gravity, READING_MG), np.diag(self.unit))

    def draw(self, rng: np.random.Generator) -> tuple[Session, Floats, Floats]:
        """Session, true `SPATIAL`, and the errors of the estimator that attains the bound."""
        clean = spatial_mg(self.truth, self.gravity)
        samples, noise, _ = _samples(self.case.kind, clean, self.begin_s, rng)
        session = _session(self.case, samples, self.begin_s, None, math.inf)
        return session, self.truth * self.unit, self.bound.error(noise.ravel(), np.zeros(2 * len(clean)))


def spread_over_sphere(n: int) -> Floats:
    """Directions (n, 3), evenly by a spiral of the golden angle."""
    height = 1 - (2 * np.arange(n) + 1) / n
    turn = math.pi * (3 - math.sqrt(5)) * np.arange(n)
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def _reported(p: Floats) -> Floats:
    alpha, k_x, k_y, phi, b_x, b_y = p
    return np.array([k_x / k_y - 1, math.degrees(phi), math.degrees(alpha), k_x, k_y, b_x, b_y])


def _through(bound: Bound, rows: Floats) -> Bound:
    """Of functions of the parameters with these slopes."""
    return Bound(rows @ bound.covariance @ rows.T, rows @ bound.gain, rows @ bound.carried)


def _samples(
    kind: str, clean: Floats, begin_s: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, Floats]:
    """Samples (n, m, axes) in mg; white noise (n, axes) and 1/f noise (n, axes) of their means."""
    n, axes = clean.shape
    slow = np.zeros((n, axes))
    if kind == "stated":
        noise = rng.normal(0, READING_MG, (n, axes))
        return (clean + noise)[:, None, :], noise, slow
    white = rng.normal(0, READING_MG * math.sqrt(SAMPLES), (n, SAMPLES, axes))
    samples = clean[:, None, :] + white
    if kind == "flicker":
        times = begin_s[:, None] + np.arange(SAMPLES) / RATE_HZ
        wander = Flicker(np.full(axes, FLICKER_MG), rng).at(times.ravel()).reshape(n, SAMPLES, axes)
        samples, slow = samples + wander, wander.mean(axis=1)
    return samples, white.mean(axis=1), slow


def _session(
    case: Case, samples: Floats, begin_s: Floats, angles_deg: Floats | None, fixture_deg: float
) -> Session:
    stated = case.kind == "stated"
    dwells = tuple(
        Dwell(
            k,
            begin_s[k] + np.arange(samples.shape[1]) / RATE_HZ,
            samples[k],
            None if angles_deg is None else float(angles_deg[k]),
        )
        for k in range(len(samples))
    )
    return Session(
        dwells,
        sensor="adis16354" if case.kind == "flicker" else "generic",
        accel_unit="mg",
        fixture_sigma_deg=fixture_deg,
        plane="none" if angles_deg is None else "xy",
        reading_u_mg=READING_MG if stated else None,
    )


def run(case: Case, sessions: int, seed: Sequence[int], method: str = "ml") -> Floats:
    """Errors of a method and of the attaining estimator, u, root of the bound, (sessions, 4, names)."""
    rng = np.random.default_rng(seed)
    rows = np.empty((sessions, 4, len(case.names)))
    make: Callable[[Case, np.random.Generator], Planar | Spatial]
    make = Spatial if case.fixture_deg is None else Planar
    each = -(-sessions // TRUTHS)
    for k in range(sessions):
        if k % each == 0:
            bench = make(case, rng)
        session, truth, attained = bench.draw(rng)
        result = fit(session, method)
        rows[k] = (
            _values(result, case.names) - truth,
            attained,
            [result[name].u for name in case.names],
            np.sqrt(np.diag(bench.bound.covariance)),
        )
    if "alpha" in case.names:
        turn = case.names.index("alpha")
        rows[:, 0, turn] = (rows[:, 0, turn] + 180) % 360 - 180
    return rows


def _values(result: FitResult, names: Sequence[str]) -> Floats:
    return np.array([result[name].value for name in names])


def lines(case: Case, rows: Floats) -> list[Line]:
    """Figures of each parameter."""
    n = len(rows)
    found = []
    for k, name in enumerate(case.names):
        error, attained, u, bound = rows[:, :, k].T
        squares = (error / bound) ** 2
        beside = (error**2 - attained**2) / bound**2
        excess, half = float(beside.mean()), 1.96 * float(beside.std(ddof=1)) / math.sqrt(n)
        other = (error - attained) / bound
        other_day = FLICKER_MG**2 / 2 if case.kind == "flicker" and name.startswith("bias") else 0.0
        found.append(
            Line(
                case,
                name,
                n,
                efficiency=1 / (1 + excess),
                low=1 / (1 + excess + half),
                high=1 / (1 + excess - half),
                plain=1 / float(squares.mean()),
                plain_half=1.96 * float(squares.std(ddof=1)) / math.sqrt(n) / float(squares.mean()) ** 2,
                bias=float(other.mean()),
                bias_half=1.96 * float(other.std(ddof=1)) / math.sqrt(n),
                stated=float(np.median((u**2 - other_day) / bound**2)),
            )
        )
    return found


def pooled(rows: Sequence[Floats]) -> list[tuple[float, float]]:
    """Plain efficiency of each parameter over all sessions of some cases, with half its interval."""
    squares = np.concatenate([(one[:, 0] / one[:, 3]) ** 2 for one in rows])
    mean = squares.mean(axis=0)
    half = 1.96 * squares.std(axis=0, ddof=1) / math.sqrt(len(squares)) / mean**2
    return list(zip((1 / mean).tolist(), half.tolist(), strict=True))


def together(found: Sequence[Line]) -> tuple[float, float, float]:
    """Efficiency of one parameter over several lines by comparison, with its interval."""
    weight = np.array([line.sessions for line in found], dtype=float)
    weight /= weight.sum()
    excess = float(weight @ np.array([1 / line.efficiency - 1 for line in found]))
    half = float(np.linalg.norm(weight * np.array([(1 / line.low - 1 / line.high) / 2 for line in found])))
    return 1 / (1 + excess), 1 / (1 + excess + half), 1 / (1 + excess - half)


def _job(job: tuple[Case, int, tuple[int, ...]]) -> Floats:
    return run(*job)


def run_all(cases: Sequence[Case], sessions: int, seed: int, jobs: int) -> list[Floats]:
    """What `run` gives of each case, in processes; kinds other than `stated` get half the sessions."""
    work = [
        (case, sessions if case.kind == "stated" else -(-sessions // 2), (seed, number))
        for number, case in enumerate(cases)
    ]
    if jobs < 2:
        return [_job(one) for one in work]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(_job, work))


HEAD = (
    f"{'kind':<8} {'n':>3} {'fixture':>8} {'parameter':<10} {'efficiency':>10} {'95 %':>17} {'plain':>15} "
    f"{'bias':>16} {'u²/bound':>9}"
)


def in_words(line: Line) -> str:
    """One line of the table."""
    case = line.case
    fixture = "space" if case.fixture_deg is None else f"{case.fixture_deg:g}°"
    return (
        f"{case.kind:<8} {case.positions:>3} {fixture:>8} {line.parameter:<10} {line.efficiency:>10.4f} "
        f"{line.low:>8.4f}–{line.high:.4f} {line.plain:>7.3f} ± {line.plain_half:.3f} "
        f"{line.bias:>7.4f} ± {line.bias_half:.4f} {line.stated:>9.4f}"
        f"{'  MISSED: ' + ', '.join(line.missed) if line.missed else ''}"
    )


def main() -> int:
    """Run the table; exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=2000, help="of each line")
    parser.add_argument("--seed", type=int, help="by default a fresh one, which is printed")
    parser.add_argument("--jobs", type=int, default=1, help="processes at most")
    parser.add_argument("--kind", choices=sorted(CASES), action="append", help="by default all")
    parser.add_argument("--json", type=Path, help="write the lines there as well")
    options = parser.parse_args()
    seed = secrets.randbits(32) if options.seed is None else options.seed
    cases = [case for kind in options.kind or CASES for case in CASES[kind]]
    print(f"seed {seed}, {options.sessions} sessions a line\n{HEAD}", flush=True)
    rows = run_all(cases, options.sessions, seed, options.jobs)
    found = [line for case, one in zip(cases, rows, strict=True) for line in lines(case, one)]
    for line in found:
        print(in_words(line))
    if options.json:
        document = {"seed": seed, "lines": [asdict(line) for line in found]}
        options.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return int(any(line.missed for line in found))


if __name__ == "__main__":
    sys.exit(main())
