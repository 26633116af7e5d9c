"""Speed against named baselines, as ratios taken in one run; and how cost grows.

    python scripts/speed_ratios.py                          # all, a table
    python scripts/speed_ratios.py fit decode --fast        # only these, few runs
    python scripts/speed_ratios.py segment --samples 2e7    # 2·10⁷ samples through the segmentation

A ratio is the baseline's time over ours, median and quartiles of interleaved runs: above 1 we are faster.
Before anything is timed both sides give their answers, and what does not agree is an error. The baselines
are packages of the extra `baselines`. Exits with 1 where answers differ.
"""

from __future__ import annotations

import argparse
import os
import platform
import secrets
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: one thread on every side

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import numpy as np

from speed import commands, fits, growth, selection, streams
from speed.timing import DisagreementError, Row

NEEDS = {"fit": ("lmfit", "imucal"), "trace": ("sklearn", "pysindy", "statsmodels")}
PACKAGES = ("numpy", "scipy", "lmfit", "imucal", "scikit-learn", "pysindy", "statsmodels")
SAMPLES, SAMPLES_FAST = 10**7, 200_000
RESULTS, RESULTS_FAST = 10**5, 2000

Benchmark = Callable[[int, bool, int], list[Row]]
BENCHMARKS: dict[str, Benchmark] = {
    "fit": lambda seed, fast, samples: fits.run(np.random.default_rng(seed), fast=fast),
    "trace": lambda seed, fast, samples: selection.run(seed, fast=fast),
    "decode": lambda seed, fast, samples: streams.decoding(np.random.default_rng(seed), fast=fast),
    "archive": lambda seed, fast, samples: streams.archiving(np.random.default_rng(seed), fast=fast),
    "growth": lambda seed, fast, samples: growth.fitting(np.random.default_rng(seed), fast=fast),
    "segment": lambda seed, fast, samples: growth.segmenting(samples),
    "commands": lambda seed, fast, samples: commands.run(fast=fast),
    "summary": lambda seed, fast, samples: growth.summarising(RESULTS_FAST if fast else RESULTS),
}


def machine() -> dict[str, str]:
    """What the ratios were taken on, without the machine's name."""
    found = {
        "processor": platform.machine(),
        "cores": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
        "system": platform.system(),
        "Python": platform.python_version(),
    }
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def absent(names: Sequence[str]) -> list[str]:
    """Packages that these benchmarks need and that are not installed."""
    return [package for name in names for package in NEEDS.get(name, ()) if find_spec(package) is None]


def measure(names: Sequence[str], seed: int, *, fast: bool, samples: int) -> list[Row]:
    """Rows of benchmarks by name.

    Raises
    ------
    DisagreementError
        Two sides give different answers.
    """
    return [row for name in names for row in BENCHMARKS[name](seed, fast, samples)]


def table(rows: Sequence[Row]) -> str:
    """Markdown table of rows."""
    lines = [
        "| benchmark | baseline | its time over ours | runs | answers agree | also |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        ratio = "–"
        if row.ratio is not None:
            ratio = f"**{row.ratio:.3g}** ({row.low:.3g} to {row.high:.3g})"
        cells = (row.benchmark, row.baseline, ratio, str(row.runs), row.agreement or "–", row.note or "–")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> int:
    """Print the table; exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--fast", action="store_true", help="few runs and small sizes")
    parser.add_argument("--samples", type=float, help=f"samples of `segment` (default {SAMPLES:.0e})")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    options = parser.parse_args()
    unknown = sorted(set(options.names) - set(BENCHMARKS))
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}")
    names = options.names or list(BENCHMARKS)
    missing = absent(names)
    if missing:
        print(f"{', '.join(missing)} not installed: pip install 'adis-gonio[baselines]'", file=sys.stderr)
        return 2
    samples = int(options.samples or (SAMPLES_FAST if options.fast else SAMPLES))
    try:
        rows = measure(names, options.seed, fast=options.fast, samples=samples)
    except DisagreementError as error:
        print(error, file=sys.stderr)
        return 1
    print(", ".join(f"{key} {value}" for key, value in machine().items()), f"seed {options.seed}", sep="; ")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
