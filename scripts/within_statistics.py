"""False findings and power of the pass inside the dwells, by the likelihood-ratio gain of what is hidden.

    python scripts/within_statistics.py --sessions 300 --seed 1 --jobs 2

Samples of 10 to 48 dwells (60 to 350 samples, filters of 1 to 127 taps, noise from a third of the
converter's step) hold nothing, a `tone`, a `settling` or a `noise_change` of an amplitude whose gain
2Δ ln L, for somebody who knows noise, form and place, is drawn between 16 and 300. Printed is how often it
is listed, and how often called found.

    python scripts/within_statistics.py --stated 100

puts into the samples of a session without anything what it said it would have seen with 90 %
(`detectable`), and a third of it, and prints how often each is found.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from scipy import linalg, optimize

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.tracing.within.second_pass import counts_as_found, look_within
from tracing.dwell_samples import bartlett, draw
from tracing.stated import EFFECTS, SORTS, finder

HIDDEN = ("tone", "settling", "noise_change")
BINS = (16.0, 30.0, 50.0, 100.0, 300.0)
PERIOD_S = 0.01
LSB_MG = 0.4672


def weights(n: int, filter_m: int, noise_mg: float) -> np.ndarray:
    """Inverse covariance (n, n) of a dwell's samples about their mean, in 1/mg²."""
    window = bartlett(filter_m)
    lags = np.correlate(window, window, "full")[len(window) - 1 :]
    row = np.zeros(n)
    row[: min(n, len(lags))] = lags[:n]
    covariance = noise_mg**2 * linalg.toeplitz(row) + np.eye(n) * LSB_MG**2 / 12
    centre = np.eye(n) - 1 / n
    return np.asarray(centre @ linalg.pinvh(centre @ covariance @ centre) @ centre)


def session(kind: str, seed: int, index: int) -> tuple[float, list[tuple[str, bool]]]:
    """Gain of what was hidden; names of the findings, and whether each counts as found."""
    rng = np.random.default_rng([seed, (*HIDDEN, "none").index(kind), index])
    dwells, n = int(rng.integers(10, 49)), int(rng.integers(60, 351))
    filter_m = int(rng.integers(0, 7))
    noise_mg = float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))) * LSB_MG * 2 ** (filter_m / 2)
    gain = float(np.exp(rng.uniform(np.log(BINS[0]), np.log(BINS[-1]))))
    inverse = weights(n, filter_m, noise_mg)
    t = np.arange(n) * PERIOD_S
    axis = int(rng.integers(2))
    unit = np.eye(2)[axis]
    if kind == "tone":
        frequency = rng.uniform(6 / (n * PERIOD_S), 0.25 / PERIOD_S)
        phases = rng.uniform(0, 2 * np.pi, dwells)
        shape = np.sin(2 * np.pi * frequency * t + phases[:, None])
    else:
        shape = np.tile(np.exp(-t / (rng.uniform(0.05, 0.5) * n * PERIOD_S)), (dwells, 1))
    size = float(np.sqrt(gain / np.einsum("ki,ij,kj->", shape, inverse, shape)))
    begin = int(rng.uniform(0.3, 0.7) * dwells)
    if kind == "noise_change":
        eigen = np.tile(np.maximum(np.linalg.eigvalsh(inverse), 0.0), dwells - begin)

        def missing(log_size: float) -> float:
            more = eigen * np.exp(2 * log_size)
            return float(np.sum(more - np.log1p(more))) - gain

        size = float(np.exp(optimize.brentq(missing, -15, 10)))

    def added(k: int, time_s: np.ndarray, dice: np.random.Generator) -> np.ndarray:
        if kind == "noise_change":
            return dice.normal(0, size, (n, 1)) * unit * (k >= begin)
        return size * shape[k][:, None] * unit * (kind != "none")

    samples = draw(
        rng,
        dwells=dwells,
        n=n,
        filter_m=filter_m,
        noise_mg=noise_mg,
        lsb_mg=LSB_MG,
        period_s=PERIOD_S,
        added=added,
    )
    return gain, [
        (finding.effect or finding.kind, counts_as_found(finding)) for finding in look_within(samples)[0]
    ]


def stated(count: int, seed: int, case: tuple[str, str]) -> str:
    """Row of the table of an effect in a sort of session."""
    hits = {1.0: 0, 1 / 3: 0}
    found = finder(*case)
    for one in range(1000 * seed, 1000 * seed + count):
        for share in hits:
            hits[share] += found(share, one)
    return f"| {case[0]} | {case[1]} | {count} | {hits[1.0]} | {hits[1 / 3]} |"


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=300, help="of each kind (default 300)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--stated", type=int, default=0, help="sessions of what is stated, instead")
    options = parser.parse_args()
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        if options.stated:
            print("| effect | sessions | number | found | found of a third |\n" + "|---" * 5 + "|")
            cases = itertools.product(EFFECTS, SORTS)
            for row in pool.map(partial(stated, options.stated, options.seed), cases):
                print(row)
            return 0
        print("| hidden | gain | sessions | listed | found | something else found |")
        print("|" + "---|" * 6)
        for kind in ("none", *HIDDEN):
            draws = range(options.sessions)
            rows = list(pool.map(partial(session, kind, options.seed), draws, chunksize=4))
            bins = [(BINS[0], BINS[-1])] if kind == "none" else list(itertools.pairwise(BINS))
            for low, high in bins:
                own = [found for gain, found in rows if low <= gain < high]
                said: Counter[str] = Counter()
                for found in own:
                    said["listed"] += any(kind in {name, "none"} for name, _ in found)
                    said["found"] += any(sure and name == kind for name, sure in found)
                    said["else"] += any(sure and name != kind for name, sure in found)
                label = "" if kind == "none" else f"{low:g}–{high:g}"
                figures = " | ".join(str(said[word]) for word in ("listed", "found", "else"))
                print(f"| {kind} | {label} | {len(own)} | {figures} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
