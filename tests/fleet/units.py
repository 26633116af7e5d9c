"""Units of a population: sessions drawn by the tests' own physics, and evidence drawn at its columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from adis_gonio.fleet.session_evidence import SessionEvidence, evidence_of
from adis_gonio.model.records import Dwell, Session
from tracing.named_truth import Term
from tracing.plans import Bench, draw_bench, draw_noise


def session_with(bench: Bench, rng: np.random.Generator, terms: Sequence[Term]) -> Session:
    """A session of a bench with its zeros, terms that add to the readings, and noise."""
    rows, starts = bench.samples, bench.starts
    slips = np.deg2rad(bench.fixture_deg) * rng.normal(size=len(bench.check))
    ideal = bench.ideal_mg(bench.alpha - rows.angle_rad + np.repeat(slips, np.diff(starts)))
    added = sum((term.value(rows, ideal) for term in terms), bench.zero_mg)
    samples = ideal + added + draw_noise(rng, bench)
    dwells = [
        Dwell(
            k,
            rows.time_s[own],
            samples[own],
            float(np.rad2deg(rows.angle_rad[starts[k]])),
            int(rows.approach[starts[k]]),
            "check" if bench.check[k] else "fit",
            temperature_c=rows.temperature_c[own],
            supply_v=rows.supply_v[own],
        )
        for k, own in enumerate(map(slice, starts[:-1], starts[1:]))
    ]
    return Session(tuple(dwells), sensor="generic", accel_unit="mg", fixture_sigma_deg=bench.fixture_deg)


def evidence_with(rng: np.random.Generator, terms: Sequence[Term]) -> SessionEvidence:
    """Evidence of a session on a bench of its own."""
    return evidence_of(session_with(draw_bench(rng), rng, terms))


@cache
def pool() -> tuple[SessionEvidence, ...]:
    """Evidence of sessions on thirty benches."""
    rng = np.random.default_rng(77)
    return tuple(evidence_with(rng, []) for _ in range(30))


def drawn(
    rng: np.random.Generator, count: int, key: str = "", sizes: Sequence[float] = (), noise: float = 1.0
) -> list[SessionEvidence]:
    """Sessions of the pool's benches with fresh scores; `sizes` in u of the column `key`, unit by unit."""
    able = [one for one in pool() if not key or key in one.keys]
    out = []
    for i in range(count):
        one = able[int(rng.integers(len(able)))]
        white = noise * rng.normal(size=len(one.directions))
        if i < len(sizes):
            white = white + one.directions[:, one.keys.index(key)] * sizes[i]
        scatter = tuple(
            part._replace(chi2=noise**2 * float(rng.chisquare(part.dof))) for part in one.scatter
        )
        out.append(
            replace(one, z=white @ one.directions, scatter=scatter, digest=f"{i:05d}", source=f"{i}.csv")
        )
    return out


def estimate(evidence: SessionEvidence, key: str) -> tuple[float, float]:
    """Amplitude of one column by least squares without others, and its standard uncertainty."""
    k = evidence.keys.index(key)
    return float(evidence.z[k] / evidence.length[k]), float(1 / evidence.length[k])
