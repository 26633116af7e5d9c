"""Populations of weak effects, and what the population trace says of them.

    python scripts/population_statistics.py --populations 100 --units 200 --jobs 2 --seed 1

Sessions are drawn by the tests' own physics (tests/tracing: plans, noise and effects written apart from
the product). An effect is put into a share of the units at a multiple of each session's own detection
limit, as the trace of that session states it (`detectable`); signs and phases are common or random. As many
populations have no effect. Beside them: units whose noise is not what it should be (`scatter`), an
effect that the catalogue lacks (`foreign`), one gross session (`gross`).

With `--draw scores`, populations with and without an effect are drawn from the evidence of 300 simulated
sessions of as many benches: their scores are drawn anew (normal, with each session's own correlations),
effects added at their columns. That is a hundred times faster; `--draw sessions` makes every session from
its samples, and shows that both agree.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.fleet.population_trace import PopulationResult, trace_population
from adis_gonio.fleet.session_evidence import SessionEvidence, evidence_of
from adis_gonio.model.effects import effect
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.findings import detectable
from adis_gonio.tracing.linear_problem import linearise
from adis_gonio.tracing.model_search import Search, price
from adis_gonio.tracing.named_candidates import named_terms
from tracing.named_truth import Term, catalogued_term
from tracing.plans import Bench, Floats, draw_bench, draw_noise

EFFECTS = (
    "bias_temperature",
    "cubic",
    "stage_eccentricity",
    "hysteresis",
    "warm_up",
    "scale_temperature",
    "bias_drift",
    "supply_bias",
    "stage_ellipticity",
    "backlash",
    "asymmetry",
    "cross_axis",
)
KINDS = ("effect", "none", "scatter", "foreign", "gross")


@dataclass(frozen=True)
class Outcome:
    """One population and what was said of it."""

    kind: str
    seed: int
    truth: str
    axes: str
    sign: str
    found: tuple[tuple[str, ...], ...]
    unnamed: tuple[str, ...]
    share: float | None
    covered: bool | None
    p_value: float | None
    seconds: float

    @property
    def named(self) -> bool:
        """The truth by its very name."""
        return (self.truth,) in self.found

    @property
    def in_set(self) -> bool:
        """The truth by its name, or in a set that cannot be told apart."""
        return any(self.truth in names for names in self.found)

    @property
    def false(self) -> bool:
        """A name, or a set of names, that holds no truth."""
        return any(self.truth not in names for names in self.found)


def session_of(bench: Bench, samples_mg: Floats, serial: str) -> Session:
    """A session as a file would give it."""
    rows, starts = bench.samples, bench.starts
    dwells = []
    for k, check in enumerate(bench.check):
        own = slice(starts[k], starts[k + 1])
        dwells.append(
            Dwell(
                position=k,
                time_s=rows.time_s[own],
                accel=np.round(samples_mg[own], 4),
                angle_deg=float(np.rad2deg(rows.angle_rad[starts[k]])),
                approach=int(rows.approach[starts[k]]),
                use="check" if check else "fit",
                temperature_c=rows.temperature_c[own],
                supply_v=rows.supply_v[own],
            )
        )
    return Session(
        tuple(dwells), sensor="generic", accel_unit="mg", fixture_sigma_deg=bench.fixture_deg, serial=serial
    )


def measured(bench: Bench, terms: list[Term], rng: np.random.Generator, serial: str) -> Session:
    """Samples of a bench: base model, zeros, terms and noise."""
    rows = bench.samples
    slips = np.deg2rad(bench.fixture_deg) * rng.normal(size=len(bench.check))
    psi = bench.alpha - rows.angle_rad + np.repeat(slips, np.diff(bench.starts))
    for term in terms:
        if term.attitude:
            psi = psi + np.deg2rad(term.value(rows, bench.ideal_mg(psi)))
    ideal = bench.ideal_mg(psi)
    readings = ideal + sum((term.value(rows, ideal) for term in terms if not term.attitude), 0.0)
    return session_of(bench, readings + bench.zero_mg + draw_noise(rng, bench), serial)


def limits_of(session: Session) -> dict[str, float | None]:
    """Smallest amplitude of each effect that the trace of this session would show, beside its bias."""
    data = readings_of(session).training
    terms, missing = named_terms(data)
    bias = NamedTerm("bias", (), 0.0, effect("bias", ("x", "y")))
    fit = Fit.begin(data).with_terms((bias,), (np.zeros(2),)).refit()
    problem = linearise(fit, [term for term in terms if term.effect.name in {*EFFECTS, "bias"}])
    both = [k for k, term in enumerate(problem.terms) if term.name == "bias" and len(term.effect.axes) == 2]
    every = detectable(Search(problem, price(problem)), tuple(both), missing)
    return {name: every[name].amplitude for name in EFFECTS}


def draw_unit(
    rng: np.random.Generator, index: int, name: str, make, size: float, noise: float = 1.0
) -> SessionEvidence:  # type: ignore[no-untyped-def]
    """Evidence of one unit, with an effect of `size` detection limits where `name` says one."""
    while True:
        bench = draw_bench(rng)
        own = rng.spawn(1)[0]
        if noise != 1.0:
            bench = replace(bench, u_mg=bench.u_mg * noise)
        if not name:
            terms = make(bench, own) if make else []
            return evidence_of(measured(bench, terms, own, f"{index}"))
        limit = limits_of(measured(bench, [], rng.spawn(1)[0], ""))[name]
        if limit is not None:
            scaled = replace(make, coefficients=make.coefficients * size * limit)
            return evidence_of(measured(bench, [scaled], own, f"{index}"))


def truth_of(rng: np.random.Generator, name: str, axes: str) -> Term:
    """The effect at unit amplitude."""
    return catalogued_term(name, axes, float(np.exp(rng.uniform(np.log(60), np.log(400)))))


def signed(rng: np.random.Generator, term: Term, sign: str) -> Term:
    """With the sign of one unit; the two waves of a stage by a phase."""
    if term.attitude and len(term.coefficients) == 2:
        phase = 0.7 if sign == "common" else rng.uniform(0, 2 * np.pi)
        return replace(term, coefficients=np.array([np.cos(phase), np.sin(phase)]))
    signs = (
        np.ones(len(term.coefficients)) if sign == "common" else rng.choice([-1, 1], len(term.coefficients))
    )
    return replace(term, coefficients=term.coefficients * signs)


def population(
    kind: str, index: int, seed: int, units: int, share: float, size: float
) -> tuple[str, str, str, list[SessionEvidence]]:
    """Truth, axes, sign, and evidence of one population."""
    rng = np.random.default_rng((seed, KINDS.index(kind), index))
    if kind == "effect":
        name = EFFECTS[index % len(EFFECTS)]
        axes = ("x", "y", "xy")[int(rng.integers(3))]
        sign = ("common", "random")[int(rng.integers(2))]
        term = truth_of(rng, name, axes)
        hit = rng.permutation(units) < round(share * units)
        every = [
            draw_unit(rng, i, name if hit[i] else "", signed(rng, term, sign) if hit[i] else None, size)
            for i in range(units)
        ]
        return name, "" if term.attitude else axes, sign, every
    if kind == "none":
        return "", "", "", [draw_unit(rng, i, "", None, 0.0) for i in range(units)]
    if kind == "scatter":
        return "", "", "", [draw_unit(rng, i, "", wandering, 0.0) for i in range(units)]
    if kind == "foreign":
        form = int(rng.integers(3))
        make = [odd_harmonic, step_in_angle, hump_in_time][form]
        hit = rng.permutation(units) < round(share * units)
        return (
            "",
            make.__name__,
            "",
            [draw_unit(rng, i, "", make if hit[i] else None, 0.0) for i in range(units)],
        )
    name = EFFECTS[index % len(EFFECTS)]
    term = truth_of(rng, name, "xy")
    return (
        "",
        name,
        "",
        [draw_unit(rng, i, name if i == 0 else "", term if i == 0 else None, 10.0) for i in range(units)],
    )


POOL = 300
"""Benches whose sessions are drawn again."""


def pool_of(seed: int, count: int = POOL) -> list[tuple[SessionEvidence, dict[str, float | None]]]:
    """Evidence of sessions without an effect, and their detection limits."""
    rng = np.random.default_rng((seed, 99))
    out = []
    for index in range(count):
        session = measured(draw_bench(rng), [], rng, f"{index}")
        out.append((evidence_of(session), limits_of(session)))
    return out


def drawn_again(
    one: SessionEvidence, amplitudes: dict[str, float], index: int, rng: np.random.Generator
) -> SessionEvidence:
    """The same session on another day: fresh noise, and effects of some amplitude at its columns."""
    noise = rng.normal(size=len(one.directions))
    for key, amplitude in amplitudes.items():
        k = one.keys.index(key)
        noise = noise + one.directions[:, k] * (one.length[k] * amplitude)
    extra = sum((one.length[one.keys.index(key)] * a) ** 2 for key, a in amplitudes.items())
    total = sum(part.dof for part in one.scatter)
    scatter = tuple(
        part._replace(chi2=float(rng.chisquare(part.dof)) + extra * part.dof / total)
        for part in one.scatter
    )
    return replace(one, z=noise @ one.directions, scatter=scatter, digest=f"{index:06d}", serial=f"{index}")


def scored_population(
    kind: str, index: int, seed: int, units: int, share: float, size: float, pool
) -> tuple[str, str, str, list[SessionEvidence]]:  # type: ignore[no-untyped-def]
    """As `population`, from the pool."""
    rng = np.random.default_rng((seed, KINDS.index(kind), index, 7))
    if kind == "none":
        every = [drawn_again(pool[int(rng.integers(len(pool)))][0], {}, i, rng) for i in range(units)]
        return "", "", "", every
    name = EFFECTS[index % len(EFFECTS)]
    stage = name in {"stage_eccentricity", "stage_ellipticity", "backlash"}
    axes = "" if stage else ("x", "y", "xy")[int(rng.integers(3))]
    sign = ("common", "random")[int(rng.integers(2))]
    tau = float(rng.choice([56.2, 100, 178, 316]))
    variant = {"bias_temperature": "degree=1", "warm_up": f"tau={tau:g}"}.get(name, "")
    hit = rng.permutation(units) < round(share * units)
    every = []
    for i in range(units):
        while True:
            one, limits = pool[int(rng.integers(len(pool)))]
            keys = [key for key in one.keys if key.split("|")[:2] == [name, variant]]
            keys = [key for key in keys if stage or key.split("|")[2] in axes]
            if not hit[i] or (limits[name] is not None and len(keys) == (len(axes) or len(keys)) and keys):
                break
        weights = rng.choice([-1, 1], len(keys)) if sign == "random" else np.ones(len(keys))
        if stage and len(keys) == 2:
            phase = 0.7 if sign == "common" else rng.uniform(0, 2 * np.pi)
            weights = np.array([np.cos(phase), np.sin(phase)])
        limit = limits[name] or 0.0
        amplitudes = {key: size * limit * float(w) for key, w in zip(keys, weights, strict=True)}
        every.append(drawn_again(one, amplitudes if hit[i] else {}, i, rng))
    return name, axes, sign, every


def _in_bias(course: Floats, size: float, axis: int) -> Term:
    def basis(rows, ideal):  # type: ignore[no-untyped-def]
        out = np.zeros((1, *ideal.shape))
        out[0, :, axis] = course
        return out

    return Term("foreign", basis, np.array([size]))


def wandering(bench: Bench, rng: np.random.Generator) -> list[Term]:
    """Scatter from dwell to dwell of a size of its own, and a random walk of the zeros, in each unit."""
    count = np.diff(bench.starts)
    terms = []
    for axis in (0, 1):
        own = bench.u_mg[axis] * rng.uniform(0, 1.5) * rng.normal(size=len(count))
        walk = bench.u_mg[axis] * rng.uniform(0, 0.4) * np.cumsum(rng.normal(size=len(count)))
        terms.append(_in_bias(np.repeat(own + walk, count), 1.0, axis))
    return terms


def odd_harmonic(bench: Bench, rng: np.random.Generator) -> list[Term]:
    """The fifth harmonic of gravity's direction on x: 1.2 u of a reading."""
    psi = bench.alpha - bench.samples.angle_rad
    return [_in_bias(np.cos(5 * psi), 1.2 * float(bench.u_mg[0]), 0)]


def step_in_angle(bench: Bench, rng: np.random.Generator) -> list[Term]:
    """The zero of y jumps where x is between 0.3 g and 0.8 g."""
    x = bench.ideal_mg(bench.alpha - bench.samples.angle_rad)[:, 0] / 1000
    return [_in_bias(((x > 0.3) & (x < 0.8)) * 1.0, 1.8 * float(bench.u_mg[1]), 1)]


def hump_in_time(bench: Bench, rng: np.random.Generator) -> list[Term]:
    """The zero of x rises and falls again within the session."""
    x = bench.samples.time_s / bench.samples.time_s[-1]
    return [_in_bias(np.sin(np.pi * x) ** 2, 2.0 * float(bench.u_mg[0]), 0)]


_POOLS: dict[int, list[tuple[SessionEvidence, dict[str, float | None]]]] = {}


def judged(arguments: tuple[str, int, int, int, float, float, bool]) -> Outcome:
    """Draw and trace one population."""
    kind, index, seed, units, share, size, scores = arguments
    if scores and kind in {"effect", "none"}:
        if seed not in _POOLS:
            _POOLS[seed] = pool_of(seed, min(POOL, 5 * units))
        truth, axes, sign, evidence = scored_population(kind, index, seed, units, share, size, _POOLS[seed])
    else:
        truth, axes, sign, evidence = population(kind, index, seed, units, share, size)
    begin = time.process_time()
    result: PopulationResult = trace_population(evidence)
    seconds = time.process_time() - begin
    right = [one for one in (*result.found, *result.sets) if truth in one.effects]
    every = [*result.found, *result.sets, *result.unnamed]
    return Outcome(
        kind,
        index,
        truth,
        axes,
        sign,
        tuple(one.effects for one in (*result.found, *result.sets)),
        tuple(one.depends_on for one in result.unnamed),
        right[0].share["value"] if right else None,
        right[0].share["low"] <= share <= right[0].share["high"] if right else None,
        min((one.p_value for one in every), default=None),
        seconds,
    )


def counts(populations: int) -> dict[str, int]:
    """Populations of each kind: a hundred with an effect and a hundred without, some of the others."""
    few = max(populations // 5, 1)
    return {"effect": populations, "none": populations, "scatter": few, "foreign": few, "gross": few}


def outcomes(
    populations: int,
    units: int,
    seed: int,
    jobs: int,
    share: float = 0.3,
    size: float = 0.5,
    kinds: tuple[str, ...] = KINDS,
    scores: bool = True,
) -> list[Outcome]:
    """All populations."""
    work = [
        (kind, index, seed, units, share, size, scores)
        for kind, count in counts(populations).items()
        if kind in kinds
        for index in range(count)
    ]
    if jobs <= 1:
        return [judged(one) for one in work]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(judged, work))


def main() -> int:
    """Run and print; 1 where a target is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--populations", type=int, default=100)
    parser.add_argument("--units", type=int, default=200)
    parser.add_argument("--share", type=float, default=0.3, help="of the units that have the effect")
    parser.add_argument("--size", type=float, default=0.5, help="of each session's detection limit")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--draw", choices=["scores", "sessions"], default="scores")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    every = outcomes(
        options.populations,
        options.units,
        options.seed,
        options.jobs,
        options.share,
        options.size,
        tuple(options.kinds.split(",")),
        options.draw == "scores",
    )
    if options.json:
        print(json.dumps([asdict(one) for one in every], indent=1))
        return 0
    for one in every:
        print(one)
    some = [one for one in every if one.kind == "effect"]
    met = True
    if some:
        named, either = sum(one.named for one in some), sum(one.in_set for one in some)
        print(f"named {named}/{len(some)}, in a set or named {either}/{len(some)}")
        met = either >= 0.95 * len(some)
    wrong = [one for one in every if one.false]
    print(f"something false in {len(wrong)}/{len(every)}")
    return int(not met or len(wrong) > 0.01 * len(every))


if __name__ == "__main__":
    sys.exit(main())
