"""Speed against named baselines, as ratios, and the growth of cost."""

from __future__ import annotations

import bench
from results.section import Effort, Section

SAMPLES = 10**8
"""Samples of the full run through the segmentation: about five minutes."""


def run(effort: Effort) -> Section:
    """Measure all benchmarks with an installed baseline; `missing` lists the others."""
    names = [name for name in bench.BENCHMARKS if not bench.absent([name])]
    missing = bench.absent(list(bench.BENCHMARKS))
    samples = bench.SAMPLES_FAST if effort.fast else SAMPLES
    rows = bench.measure(names, effort.seed, fast=effort.fast, samples=samples)
    machine = bench.machine()
    document = {"machine": machine, "missing": missing, "rows": [row.as_dict() for row in rows]}
    return Section(document)
