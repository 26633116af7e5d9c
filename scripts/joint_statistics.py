"""Joint traces of simulated fleets against traces of their single sessions.

    python scripts/joint_statistics.py --fleets 60 --sessions 6 --seed 1
    python scripts/joint_statistics.py --fleets 50 --sessions 12 --seed 1 --coverage
    python scripts/joint_statistics.py --time 40

Each fleet has sessions of 24 dwells on one stage, of one part or of as many parts as sessions, with one
weak effect or none. A name other than the true one and `bias` is false. Coverage counts the statements
value ± U that hold the truth: parameters of the part, and amplitudes of the effect.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from adis_gonio.base.uncertainty import wilson
from adis_gonio.model.effects import effect
from adis_gonio.tracing.joint_trace import JointResult, trace_stacked
from adis_gonio.tracing.trace import trace_readings

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from tracing.joint_fleets import draw_part, draw_session, origins

EFFECTS = {
    "quadratic": ("x", [0.25]),
    "cubic": ("y", [0.35]),
    "asymmetry": ("x", [0.25]),
    "bias_drift": ("y", [0.012]),
    "backlash": ("", [0.012]),
    "stage_eccentricity": ("", [0.006, -0.008]),
    "hysteresis": ("x", [0.12]),
}
"""Effects at sizes that one session rarely shows: axis, amplitudes."""


def fleet(rng: np.random.Generator, count: int, parts: int, name: str):  # type: ignore[no-untyped-def]
    """Readings, names and true parameters of a fleet; `name` is empty for a fleet without an effect."""
    axis, values = EFFECTS.get(name, ("", []))
    present = [(effect(name, tuple(axis)), values)] if name else []
    every = [draw_part(rng) for _ in range(parts)]
    readings = [draw_session(rng, every[k % parts], present) for k in range(count)]
    truth = {}
    for k, (gains, _) in enumerate(every):
        end = f"@part{k}" if parts > 1 else ""
        truth |= {
            f"delta_k{end}": gains[0] / gains[1] - 1,
            f"delta_phi{end}": math.degrees(gains[2]),
            f"scale_x{end}": gains[0],
            f"scale_y{end}": gains[1],
        }
    amplitudes = {q.name: v for q, v in zip(present[0][0].parameters, values, strict=True)} if name else {}
    return readings, origins(count, parts), truth, amplitudes


def covered(
    result: JointResult, truth: dict[str, float], amplitudes: dict[str, float], hits: Counter
) -> None:
    """Count the statements of a result that hold the truth."""
    for name, value in truth.items():
        one = result.base[name]
        hits["part", bool(one.U is not None and abs(one.value - value) <= one.U)] += 1
    for finding in result.found:
        for name, one in finding.parameters.items():
            stem = name.partition("@")[0]
            if stem in amplitudes and one.U:
                kind = "session" if "@" in name else "shared"
                hits[kind, abs(one.value - amplitudes[stem]) <= one.U] += 1


def rate(hits: int, of: int) -> str:
    """A rate with its 95 % interval."""
    low, high = wilson(hits, of)
    return f"{hits} of {of}: {hits / max(of, 1):.1%} ({low:.1%} to {high:.1%})"


def main() -> None:
    """Draw fleets, trace them, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--fleets", type=int, default=60)
    parser.add_argument("--sessions", type=int, default=6)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--coverage", action="store_true", help="no traces of single sessions")
    parser.add_argument("--time", type=int, default=0, help="only compare the time for this many sessions")
    options = parser.parse_args()
    if options.time:
        return compare_time(options.time, options.seed)
    hits: Counter = Counter()
    found: Counter = Counter()
    names = ["", *EFFECTS]
    for index in range(options.fleets):
        rng = np.random.default_rng((options.seed, index))
        name = names[index % len(names)]
        parts = 1 if index // len(names) % 2 else options.sessions
        readings, where, truth, amplitudes = fleet(rng, options.sessions, parts, name)
        joint = trace_stacked(readings, where)
        said = {finding.effect for finding in joint.found} - {"bias"}
        each = [] if options.coverage else readings
        single = [{f.effect for f in trace_readings(one).found} - {"bias"} for one in each]
        for kind, claims in (("joint", [said]), ("single", single)):
            for claim in claims:
                found[kind, "asked"] += bool(name)
                found[kind, "named"] += bool(name) and name in claim
                found[kind, "traces"] += 1
                found[kind, "false"] += bool(claim - {name})
        covered(joint, truth, amplitudes, hits)
        print(dict(hits), end=" ")
        print(
            index, name or "–", parts, sorted(said), Counter(n for one in single for n in one), flush=True
        )
    for kind in ("joint", "single"):
        print(f"{kind}: named {rate(found[kind, 'named'], found[kind, 'asked'])};", end=" ")
        print(f"with a false name {rate(found[kind, 'false'], found[kind, 'traces'])}")
    for kind in ("part", "shared", "session"):
        print(f"coverage, {kind}: {rate(hits[kind, True], hits[kind, True] + hits[kind, False])}")
    return None


def compare_time(count: int, seed: int) -> None:
    """Print the processor time of one joint trace, and of the traces of its sessions one by one."""
    rng = np.random.default_rng(seed)
    for parts in (1, count):
        readings, where, _, _ = fleet(rng, count, parts, "quadratic")
        begun = time.process_time()
        result = trace_stacked(readings, where)
        joint = time.process_time() - begun
        for one in readings:
            trace_readings(one)
        alone = time.process_time() - begun - joint
        said = [finding.effect for finding in result.found]
        print(
            f"{count} sessions of {parts} parts: joint {joint:.1f} s, alone {alone:.1f} s: {said}",
            flush=True,
        )


if __name__ == "__main__":
    main()
