"""Figures of `trace --sensor-part gyro` on blind sessions, against the accelerometers' targets.

    python scripts/gyro_trace_statistics.py --kind all --sessions 300 --seed 20261122 --jobs 2

Sessions (poses in space, and a table with whole turns) come from tests/tracing/gyro_blind.py, whose physics
is its own. Each rate stands with its 95 % Wilson interval; the exit status is 1 where one misses its
target.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.base.uncertainty import wilson
from tracing.gyro_blind import KINDS, Verdict, answer_of, draw, judge


def one(kind: str, seed: int, index: int) -> Verdict | str:
    """Verdict on one session, or what went wrong."""
    begin = time.perf_counter()
    try:
        blind = draw(kind, seed, index)
        return judge(blind, answer_of(blind), time.perf_counter() - begin)
    except Exception:  # any failure is an answer, and counts as a wrong one
        return f"{kind} {seed}/{index}\n{traceback.format_exc()}"


def rate(what: str, hits: Iterable[bool], low: float = 0.0, high: float = 1.0) -> tuple[str, bool]:
    """A line of the table, and whether the rate lies within its target."""
    every = [bool(hit) for hit in hits]
    if not every:
        return f"| {what} | no session | |", True
    count, n = sum(every), len(every)
    below, above = wilson(count, n)
    target = "" if (low, high) == (0.0, 1.0) else f"{low:.0%} to {high:.0%}"
    text = f"| {what} | {count / n:.1%} ({below:.1%}–{above:.1%}), {count} of {n} | {target} |"
    return text, low <= count / n <= high


def figures(kind: str, verdicts: Sequence[Verdict], failed: int) -> list[tuple[str, bool]]:
    """Lines of a kind."""
    lines = []
    if kind == "none":
        lines.append(
            rate("none: something found", [bool(v.claimed or v.said) for v in verdicts], high=0.01)
        )
    if kind == "one":
        lines.append(rate("one: found", [v.found for v in verdicts], low=0.97))
        lines.append(rate("one: found alone", [v.exact for v in verdicts], low=0.95))
        inside = [hit for v in verdicts for _, hit in v.covered]
        lines.append(rate("one: truth in the 95 % interval", inside, 0.94, 0.96))
    if kind == "two":
        lines.append(rate("two: both and nothing else", [v.exact for v in verdicts], low=0.90))
        lines.append(rate("two: a wrong name", [bool(v.wrong) for v in verdicts]))
    if kind == "uncatalogued":
        lines.append(
            rate("uncatalogued: right covariate, unnamed", [v.covariate for v in verdicts], low=0.90)
        )
        lines.append(rate("uncatalogued: a wrong name", [bool(v.wrong) for v in verdicts], high=0.05))
    ratios = [v.ratio for v in verdicts if np.isfinite(v.ratio)]
    if ratios:
        median = float(np.median(ratios))
        lines.append(
            (f"| {kind}: held-out error over the oracle's, median | {median:.3f} | ≤ 1.10 |", median <= 1.1)
        )
    lines.append((f"| {kind}: raised | {failed} | 0 |", not failed))
    return lines


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kind", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--sessions", type=int, default=300, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--misses", action="store_true", help="list sessions that were not judged right")
    chosen = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    met = True
    with ProcessPoolExecutor(chosen.jobs, multiprocessing.get_context("spawn")) as pool:
        for kind in KINDS if chosen.kind == "all" else (chosen.kind,):
            answers = list(pool.map(partial(one, kind, chosen.seed), range(chosen.sessions)))
            verdicts = [v for v in answers if isinstance(v, Verdict)]
            failures = [v for v in answers if isinstance(v, str)]
            for text, good in figures(kind, verdicts, len(failures)):
                print(text, "" if good else "**not met**", flush=True)
                met &= good
            seconds = np.median([v.seconds for v in verdicts]) if verdicts else float("nan")
            print(f"  {kind}: median {seconds:.1f} s a session", flush=True)
            _list(kind, answers, failures, misses=chosen.misses)
    return 0 if met else 1


def _list(kind: str, answers: Sequence[Verdict | str], failures: Sequence[str], *, misses: bool) -> None:
    for text in failures[:3]:
        print(text)
    if not misses:
        return
    wrong = Counter()
    for index, verdict in enumerate(answers):
        if isinstance(verdict, str):
            continue
        good = verdict.covariate and not verdict.wrong if kind == "uncatalogued" else verdict.exact
        if not good:
            said = f"; unnamed {verdict.said}" if verdict.said else ""
            print(
                f"  {index}: {', '.join(verdict.truth)} → {', '.join(verdict.claimed) or 'nothing'}{said}"
            )
        for name, hit in verdict.covered:
            wrong[name] += not hit
    print("  outside the interval:", dict(wrong))


if __name__ == "__main__":
    sys.exit(main())
