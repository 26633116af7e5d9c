"""Speed against named baselines, as ratios, and the growth of cost."""

from __future__ import annotations

import speed_ratios
from results.section import Effort, Section


def run(effort: Effort) -> Section:
    """Measure all benchmarks with an installed baseline; `missing` lists the others."""
    names = [name for name in speed_ratios.BENCHMARKS if not speed_ratios.absent([name])]
    missing = speed_ratios.absent(list(speed_ratios.BENCHMARKS))
    samples = speed_ratios.SAMPLES_FAST if effort.fast else speed_ratios.SAMPLES
    rows = speed_ratios.measure(names, effort.seed, fast=effort.fast, samples=samples)
    machine = speed_ratios.machine()
    document = {"machine": machine, "missing": missing, "rows": [row.as_dict() for row in rows]}
    return Section(document)
