"""Speed against named baselines, as ratios; how cost grows."""

from __future__ import annotations

import bench
from results.section import Effort, Section

SAMPLES = 10**8
"""The full run streams so many samples through the segmentation: about five minutes."""


def run(effort: Effort) -> Section:
    """All benchmarks whose baselines are installed; what is left out is said."""
    names = [name for name in bench.BENCHMARKS if not bench.absent([name])]
    missing = bench.absent(list(bench.BENCHMARKS))
    samples = bench.SAMPLES_FAST if effort.fast else SAMPLES
    rows = bench.measure(names, effort.seed, fast=effort.fast, samples=samples)
    machine = bench.machine()
    document = {"machine": machine, "missing": missing, "rows": [row.as_dict() for row in rows]}
    return Section(document)
