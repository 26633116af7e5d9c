"""Do plans reach what is predicted? Predicted and simulated uncertainties, and the gain of the best plans.

Sessions are drawn here, from the equations of docs/theory.md and not by the code that predicts: each has
its own start angle (±5°), gains, Δφ, biases (10 mg) and fixture errors; a dwell's mean has white noise and
the mean of 1/f noise over its time, drawn as a spectrum of lines h/f over eight times the session. They are
fitted by `fit`. A bias is compared with what it would be found as in a session twice as long, which is how
its uncertainty is defined.

With --chip the same plans are measured by the simulated chip, through driver, archive and reduction. With
--trace the rate of right names under an order that tells drift from the stage's eccentricity, and in turn.

    python scripts/plan_statistics.py                    # 4000 sessions a plan and fixture
    python scripts/plan_statistics.py --sessions 1000 --chip 20 --trace 10

Exits with 1 where a simulated uncertainty is off the predicted one by more than 5 % and three of its own
standard errors.
"""

from __future__ import annotations

import argparse
import math
import os
import secrets
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import FitResult
from adis_gonio.fitting.methods import fit_readings
from adis_gonio.fitting.uncertainty import ShownAngle
from adis_gonio.plan.optimal_plan import best_plan, even_plan
from adis_gonio.plan.prediction import Bench, expected_readings, predict_uncertainty
from adis_gonio.record.plans import Plan, plan

FIXTURES_DEG = (0.01, 0.05)
BIAS_MG = 10.0
START_DEG = 5.0
"""Half the span of the start angles that are drawn."""
PART = 500
"""Sessions of one seed, whatever the number of processes."""
PLACES = 72
STEP_S = 0.5
"""Grid of the 1/f noise: what is faster is averaged away in a dwell."""
CLOSE = 0.05
NAMES = ("delta_k", "delta_phi", "alpha", "scale_x", "scale_y", "bias_x", "bias_y", "angle")
"""`angle`: that of the fitted parameters, worst place of the turn."""


@dataclass(frozen=True)
class Case:
    """A plan with its bench."""

    name: str
    plan: Plan
    bench: Bench


@cache
def cases(fixtures: Sequence[float] = FIXTURES_DEG, most: int = 24, seed: int = 1) -> list[Case]:
    """The six plans of the target, and even ones to compare the best with; at most `most` positions."""
    out = []
    for fixture in fixtures:
        bench = Bench(fixture)
        plans = {
            "two-position": plan("two-position"),
            "four-position": plan("four-position"),
            "mmpm": plan("mmpm"),
            "tumble 12": plan("tumble", 6),
        }
        for count in (12, 24)[: 2 if most >= 24 else 1]:
            plans[f"even {count}"] = even_plan(count)
            plans[f"best {count}"] = best_plan(bench, count, seed=seed).plan
        out += [Case(name, made, bench) for name, made in plans.items()]
    return out


def flicker_means(rng: np.random.Generator, begin_s: Floats, length_s: float, floor: float) -> Floats:
    """Means (n + 1, 2) of 1/f noise over dwells; the last row over twice the session."""
    session = float(begin_s[-1]) + length_s
    size = 1 << math.ceil(math.log2(8 * session / STEP_S))
    frequency = np.arange(1, size // 2 + 1) / (size * STEP_S)
    # One-sided density h/f has the Allan variance 2 h ln 2. A line a cos + b sin has the variance of a and
    # of b, density × width; the inverse transform makes 2 Re of what it is given.
    sigma = np.sqrt(floor**2 / (2 * math.log(2)) / frequency / (size * STEP_S)) / 2
    lines = np.zeros((2, size // 2 + 1), dtype=complex)
    lines[:, 1:] = (rng.normal(size=(2, size // 2)) + 1j * rng.normal(size=(2, size // 2))) * sigma
    series = np.fft.irfft(lines, size) * size
    total = np.concatenate([np.zeros((2, 1)), np.cumsum(series, axis=1)], axis=1) * STEP_S
    grid = STEP_S * np.arange(size + 1)

    def mean(a: float, b: float) -> Floats:
        ends = [np.interp([a, b], grid, row) for row in total]
        return np.array([(high - low) / (b - a) for low, high in ends])

    dwells = [mean(float(b), float(b) + length_s) for b in begin_s]
    return np.array([*dwells, mean(0.0, 2 * session)])


def drawn(case: Case, rng: np.random.Generator, bare: Readings) -> tuple[Readings, Floats, Floats]:
    """Readings of one session like `bare`, its true values of `NAMES[:-1]`, and the base values behind."""
    bench = case.bench
    g = bench.gravity_mg
    theta = np.radians([position.angle_deg for position in case.plan.positions])
    alpha = math.radians(rng.uniform(-START_DEG, START_DEG))
    gain = 1 + rng.normal(0, 0.001, 2)
    phi = math.radians(rng.normal(0, 0.1))
    slow = flicker_means(rng, bench.begins_s(case.plan), bench.settings.dwell_s, bench.floor_mg)
    bias = rng.normal(0, BIAS_MG, 2)
    psi = alpha - theta + rng.normal(0, math.radians(bench.fixture_deg), len(theta))
    step = bench.part.accel_mg_per_lsb
    white = math.sqrt((bench.white_mg**2 + step**2 / 12) / bench.samples)
    mean = g * np.stack([gain[0] * np.cos(psi), gain[1] * np.sin(psi + phi)], axis=1)
    mean = mean + bias + slow[:-1] + rng.normal(0, white, mean.shape)
    bias = bias + slow[-1]
    truth = [gain[0] / gain[1] - 1, math.degrees(phi), math.degrees(alpha), *gain, *bias]
    readings = replace(bare, mean=mean)
    return readings, np.array(truth), np.array([alpha, *gain, phi, *bias])


def shown(base: Floats, u_mg: Floats, g: float) -> Floats:
    """Stage angles (m,) in rad that a goniometer with these values shows of readings (m, 2)."""
    alpha, k_x, k_y, phi, b_x, b_y = base
    u, w = (u_mg[:, 0] - b_x) / (g * k_x), (u_mg[:, 1] - b_y) / (g * k_y)
    return alpha - np.arctan2((w - u * math.sin(phi)) / math.cos(phi), u)


def errors(case: Case, sessions: int, seed: int) -> Floats:
    """Errors (sessions, 7 + PLACES): of `NAMES[:-1]`, and of the angle around the turn; NaN: not fitted."""
    rng = np.random.default_rng([seed, *case.name.encode()])
    g = case.bench.gravity_mg
    psi = np.linspace(0, 2 * math.pi, PLACES, endpoint=False)
    bare = expected_readings(case.plan, case.bench)
    out = np.full((sessions, 7 + PLACES), np.nan)
    for k in range(sessions):
        readings, truth, base = drawn(case, rng, bare)
        result = fit_readings(readings)
        found = np.array([result[n].value if n in result else np.nan for n in NAMES[:-1]])
        out[k, :7] = found - truth
        values = np.concatenate([[math.radians(found[2])], found[3:5], [math.radians(found[1])], found[5:]])
        values = np.where(np.isfinite(values), values, 0.0)  # a bias that is not seen is taken as zero
        exact = g * np.stack([base[1] * np.cos(psi), base[2] * np.sin(psi + base[3])], axis=1) + base[4:]
        off = shown(values, exact, g) - (base[0] - psi)
        out[k, 7:] = np.degrees((off + math.pi) % (2 * math.pi) - math.pi)
    return out


@dataclass(frozen=True)
class Line:
    """One quantity of one plan."""

    case: str
    fixture_deg: float
    name: str
    predicted: float
    simulated: float
    standard_error: float
    """Of the ratio simulated/predicted."""

    @property
    def ratio(self) -> float:
        """Simulated through predicted."""
        return self.simulated / self.predicted

    @property
    def missed(self) -> bool:
        """Off by more than 5 %, beyond doubt."""
        return abs(self.ratio - 1) > CLOSE + 3 * self.standard_error


def fitted_variance(result: FitResult) -> Floats:
    """Variance (m,) in degrees² of the shown angle around the turn, without a reading's own noise."""
    shown = ShownAngle.around(result.origin.fit)
    return (result.sources.roots(shown.gradient, shown.reading) ** 2).sum(axis=1)


def predicted_for(case: Case) -> tuple[dict[str, float], int]:
    """Uncertainties by `NAMES`, root mean square over the start angles that are drawn; the worst place."""
    variances: dict[str, list[float]] = {}
    worst = int(fitted_variance(fit_readings(expected_readings(case.plan, case.bench))).argmax())
    for start in np.linspace(-0.9, 0.9, 10) * START_DEG:
        result = fit_readings(expected_readings(case.plan, replace(case.bench, start_deg=float(start))))
        for name, one in result.parameters.items():
            variances.setdefault(name, []).append(float(one.u or math.nan) ** 2)
        variances.setdefault("angle", []).append(float(fitted_variance(result)[worst]))
    return {name: math.sqrt(float(np.mean(found))) for name, found in variances.items()}, worst


def compare(case: Case, off: Floats) -> list[Line]:
    """Root mean square errors beside the uncertainties that were predicted."""
    predicted, worst = predicted_for(case)
    rms = np.sqrt((off**2).mean(axis=0))
    simulated = dict(zip(NAMES, [*rms[:7], rms[7 + worst]], strict=True))
    fixture = case.bench.fixture_deg
    error = 1 / math.sqrt(2 * len(off))
    return [
        Line(case.name, fixture, name, predicted[name], float(simulated[name]), error)
        for name in NAMES
        if name in predicted
    ]


def _part(job: tuple[Case, int, int]) -> Floats:
    return errors(*job)


def run(
    sessions: int, seed: int, jobs: int = 1, fixtures: Sequence[float] = FIXTURES_DEG, most: int = 24
) -> list[Line]:
    """All plans of at most `most` positions."""
    lines = []
    with ProcessPoolExecutor(jobs) as pool:
        for case in cases(fixtures, most):
            sizes = [min(PART, sessions - done) for done in range(0, sessions, PART)]
            work = [(case, size, seed + k) for k, size in enumerate(sizes)]
            lines += compare(case, np.concatenate(list(pool.map(_part, work))))
    return lines


def through_the_chip(case: Case, sessions: int, seed: int) -> list[Line]:
    """ΔK and Δφ of sessions that the simulated chip has measured."""
    from adis_gonio.bench.runner import SessionRunner
    from adis_gonio.device.sensor import open_sensor
    from adis_gonio.fitting import fit
    from adis_gonio.record.loading import load_session

    off = []
    with tempfile.TemporaryDirectory() as folder:
        for k in range(sessions):
            path = Path(folder) / f"{k}.session"
            url = f"sim:?seed={seed + k}&fixture_sigma_deg={case.bench.fixture_deg}"
            with open_sensor(url) as sensor:
                runner = SessionRunner.begin(
                    sensor,
                    path,
                    case.plan,
                    case.bench.settings,
                    auto=True,
                    fixture_sigma_deg=case.bench.fixture_deg,
                )
                for _ in runner.run(so_far=False):
                    pass
            session = load_session(path)
            result, truth = fit(session), session.facts["truth"]
            off.append([result[name].value - truth[name] for name in ("delta_k", "delta_phi")])
            path.unlink()
    rms = np.sqrt((np.array(off) ** 2).mean(axis=0))
    reach = predict_uncertainty(case.plan, case.bench)
    error = 1 / math.sqrt(2 * sessions)
    return [
        Line(f"{case.name}, chip", case.bench.fixture_deg, name, float(u or 0), float(one), error)
        for name, one in zip(("delta_k", "delta_phi"), rms, strict=True)
        for u in (reach.parameters[name].u,)
    ]


APART = ("bias_drift", "stage_eccentricity")
TIMES = 1.5
"""Size of an effect in units of what the better plan sees."""


def names_found(positions: int, sessions: int, seed: int) -> dict[str, dict[str, list[int]]]:
    """By plan and effect: how often its name alone (beside a bias), and how often anything else."""
    from adis_gonio.plan.prediction import planned_terms, predict
    from adis_gonio.tracing.trace import trace_readings

    bench = Bench(0.01)
    made = {
        "best": best_plan(bench, positions, "tell-apart", APART).plan,
        "even": even_plan(positions),
    }
    sizes = predict(made["best"], bench).sight.detectable
    out: dict[str, dict[str, list[int]]] = {}
    for kind, one in made.items():
        out[kind] = {}
        case = Case(kind, one, bench)
        for which, name in enumerate(APART):
            rng = np.random.default_rng([seed, which])
            bare = expected_readings(one, bench)
            (term,) = planned_terms(bare, [name])
            right = wrong = 0
            for _ in range(sessions):
                readings, _, _ = drawn(case, rng, bare)
                values = np.zeros(len(term.effect.parameters))
                values[0] = TIMES * (sizes[name].amplitude or 0.0)
                added = term.added(values, readings.mean, readings.conditions)
                if term.enters_angle:
                    turned = np.stack([-readings.mean[:, 1], readings.mean[:, 0]], axis=1)
                    added = added[:, None] * turned
                found = {
                    f.effect for f in trace_readings(replace(readings, mean=readings.mean + added)).found
                }
                found -= {"bias"}
                right += found == {name}
                wrong += bool(found - {name})
            out[kind][name] = [right, wrong]
    return out


def main() -> int:
    """Print the tables; exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=4000)
    parser.add_argument("--chip", type=int, default=0, help="sessions through the simulated chip")
    parser.add_argument("--trace", type=int, default=0, help="traced sessions an effect and plan")
    parser.add_argument("--seed", type=int, default=secrets.randbits(31))
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    print(f"seed {options.seed}, {options.sessions} sessions a line")
    lines = run(options.sessions, options.seed, options.jobs)
    if options.chip:
        case = next(c for c in cases((0.05,)) if c.name == "best 12")
        lines += through_the_chip(case, options.chip, options.seed % 10**6)
    for line in lines:
        told = "MISSED" if line.missed else ""
        print(
            f"{line.case:<16} {line.fixture_deg:>5}° {line.name:<10} predicted {line.predicted:<10.3g} "
            f"simulated {line.simulated:<10.3g} ratio {line.ratio:.3f} ± {line.standard_error:.3f} {told}"
        )
    if options.trace:
        print(names_found(12, options.trace, options.seed))
    return int(any(line.missed for line in lines))


if __name__ == "__main__":
    sys.exit(main())
