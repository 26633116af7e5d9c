"""Figures of `trace` on blind sessions, against their targets.

    python scripts/trace_statistics.py --kind all --sessions 500 --jobs 2

Sessions are written by one process and traced from their files by another (tests/tracing). Each figure
stands with its 95 % Wilson interval; the exit status is 1 where one misses its target. A second table says
what was claimed for each truth. With `--only-names` the tracer is told that every cause has a name: what is
missed then, no choice among the catalogue's names can find.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.base.uncertainty import wilson
from tracing.blind import KINDS
from tracing.rounds import crew, rounds, trace_file
from tracing.space import SPACE
from tracing.verdict import Verdict


def trace_names(path: str) -> dict[str, Any]:
    """The answer of a tracer for which functions without a name have no prior."""
    from adis_gonio.tracing.thresholds import limits  # only the tracing process loads the product

    limits.nameless_share = 1e-12
    return trace_file(path)


@dataclass(frozen=True)
class Figure:
    """One line of the table; `met` is None for a figure without a target."""

    kind: str
    what: str
    value: str
    target: str
    met: bool | None


def rate(
    kind: str, what: str, hits: Iterable[bool], least: float | None = None, most: float | None = None
) -> Figure:
    """A rate against its least or largest value."""
    every = [bool(hit) for hit in hits]
    count, n = sum(every), len(every)
    if not n:
        return Figure(kind, what, "no session", "", None)
    low, high = wilson(count, n)
    value = f"{count / n:7.1%}  [{low:6.1%}, {high:6.1%}]  {count}/{n}"
    if least is not None:
        return Figure(kind, what, value, f"≥ {least:.0%}", count / n >= least)
    if most is not None:
        return Figure(kind, what, value, f"≤ {most:.0%}", count / n <= most)
    return Figure(kind, what, value, "", None)


def between(kind: str, what: str, hits: Iterable[bool], low: float, high: float) -> Figure:
    """A rate within bounds."""
    every = list(hits)
    figure = rate(kind, what, every)
    met = low <= np.mean(every) <= high if every else None
    return Figure(kind, what, figure.value, f"{low:.0%} – {high:.0%}", met)


def against_oracle(kind: str, verdicts: Sequence[Verdict], most: float = 1.1) -> Figure:
    """Median of the held-out error over the oracle's, of the sessions that have check dwells."""
    ratios = [v.heldout_ratio for v in verdicts if not np.isnan(v.heldout_ratio)]
    median, high = np.quantile(ratios, [0.5, 0.95])
    value = f"{median:7.3f}  (95 % of sessions below {high:.3f}; {len(ratios)} with check dwells)"
    what = "held-out error over oracle's, median"
    return Figure(kind, what, value, f"≤ {most:.2f}", bool(median <= most))


def figures(kind: str, verdicts: Sequence[Verdict]) -> list[Figure]:
    """All figures of a kind."""
    some = [v for v in verdicts if not np.isnan(v.heldout_ratio)]
    folds = [v.fold_ratio for v in verdicts if not np.isnan(v.fold_ratio)]
    lines: list[Figure] = []
    if kind == "none":
        lines.append(
            rate(kind, "something found", (bool(v.claimed) or v.unnamed for v in verdicts), most=0.01)
        )
        lines.append(rate(kind, "called adequate", (v.adequate for v in verdicts)))
    elif kind == "one":
        lines.append(rate(kind, "found", (v.found for v in verdicts), least=0.97))
        lines.append(rate(kind, "found alone", (v.exact for v in verdicts), least=0.95))
        lines.append(rate(kind, "alone, by the very name", (v.strict and not v.unnamed for v in verdicts)))
        lines.append(
            rate(kind, "axes as put in", (v.axes_right for v in verdicts if v.axes_right is not None))
        )
        covered = [c for v in verdicts for c in v.covered]
        lines.append(between(kind, "truth in the 95 % interval", (c[1] for c in covered), 0.93, 0.97))
    elif kind == "two":
        lines.append(rate(kind, "both and nothing else", (v.exact for v in verdicts), least=0.9))
        lines.append(rate(kind, "by the very names", (v.strict and not v.unnamed for v in verdicts)))
        lines.append(rate(kind, "a wrong name", (bool(v.wrong) for v in verdicts)))
    else:
        strict = kind == "uncatalogued"
        lines.append(
            rate(
                kind,
                "unnamed, right covariate",
                (v.covariate for v in verdicts),
                least=0.9 if strict else 0.6,
            )
        )
        lines.append(
            rate(kind, "a wrong name", (bool(v.wrong) for v in verdicts), most=0.05 if strict else 0.15)
        )
        lines.append(rate(kind, "something unnamed", (v.unnamed for v in verdicts)))
        if strict:
            lines.append(rate(kind, "by its form", (v.covariate and v.form for v in verdicts)))
        paired = [v for v in verdicts if len(v.truth) > 1]
        lines.append(rate(kind, "named partner found, where there is one", (v.found for v in paired)))
    if some:
        lines.append(against_oracle(kind, some))
    if folds:
        median = float(np.median(folds))
        value = f"{median:7.3f}  ({len(folds)} sessions; the oracle leaves out dwell by dwell)"
        lines.append(Figure(kind, "the same by folds, median", value, "", None))
    lines.append(
        rate(kind, "held-out error > 5 % worse than before", (v.worse > 1.05 for v in verdicts), most=0)
    )
    oracle = (v.oracle_worse > 1.05 for v in verdicts if not np.isnan(v.oracle_worse))
    lines.append(rate(kind, "the oracle's > 5 % worse than before", oracle))
    lines.append(rate(kind, "trace raised", (bool(v.failure) for v in verdicts), most=0))
    spent = [v.seconds for v in verdicts]
    value = f"{np.median(spent):7.2f}  (max {max(spent):.2f})"
    lines.append(Figure(kind, "seconds a session, file included", value, "", None))
    return lines


def confusion(verdicts: Sequence[Verdict]) -> list[str]:
    """What was claimed for each truth: the right answers as a share, the others one by one."""
    groups: dict[str, list[Verdict]] = defaultdict(list)
    for v in verdicts:
        groups[v.truth[0] if v.truth else "nothing"].append(v)
    lines = []
    for truth, group in sorted(groups.items()):
        claims = Counter()
        for v in group:
            answer = " + ".join(sorted(v.claimed)) or "–"
            claims[answer + (f" (unnamed {v.said})" if v.unnamed else "")] += 1
        good = sum(v.exact and (v.covariate or v.kind not in {"uncatalogued", "beyond"}) for v in group)
        told = "; ".join(f"{count}× {claim}" for claim, count in claims.most_common(6))
        lines.append(f"{truth:28} {good:3}/{len(group):<3} right | {told}")
    return lines


def main() -> int:
    """Run and print; 1 where a target is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=[*KINDS, "all"], default="all")
    parser.add_argument("--sessions", type=int, default=500, help="sessions of each kind (default 500)")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--space", action="store_true", help="poses in space with free attitudes")
    parser.add_argument("--only-names", action="store_true", help="told that every cause has a name")
    parser.add_argument("--no-confusion", action="store_true", help="leave out the second table")
    options = parser.parse_args()

    lines: list[Figure] = []
    tables: list[str] = []
    every: list[Verdict] = []
    with crew(options.jobs) as pools:
        for kind in KINDS if options.kind == "all" else (options.kind,):
            begin = time.perf_counter()
            tracer = trace_names if options.only_names else trace_file
            world = SPACE * options.space + kind
            verdicts = rounds(world, range(options.sessions), options.seed, pools, tracer)
            print(f"{kind}: {len(verdicts)} in {time.perf_counter() - begin:.0f} s", file=sys.stderr)
            lines += figures(kind, verdicts)
            broken = [v.failure for v in verdicts if v.failure]
            if broken:
                print(
                    f"{kind}: trace raised on {len(broken)} sessions, first\n{broken[0]}", file=sys.stderr
                )
            every += verdicts
            tables += [f"-- {kind}", *confusion(verdicts)]
    if options.kind == "all":
        lines.append(against_oracle("all", every))
    for line in lines:
        mark = {None: " ", True: "✓", False: "✗"}[line.met]
        print(f"{mark} {line.kind:13} {line.what:42} {line.value:40} {line.target}")
    if not options.no_confusion:
        print("\nTruth, right answers, what was said\n" + "\n".join(tables))
    return int(any(line.met is False for line in lines))


if __name__ == "__main__":
    sys.exit(main())
