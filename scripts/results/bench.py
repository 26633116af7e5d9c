"""Speed against named baselines, as ratios; how cost grows."""

from __future__ import annotations

import bench
from results.section import Effort, Section

SAMPLES = 10**8
"""The full run streams so many samples through the segmentation: about five minutes."""

_TEXT = """\
{what}

A ratio is the baseline's time over ours, measured in turn in one run: median, and in brackets the
quartiles of the runs. Above 1 we are faster. Before anything is timed the answers are compared; the
table says how far they agree. Times are of the processor; of the archive, which waits for the disk, of
the wall clock. Nothing here is an absolute time: they differ from machine to machine, the ratios much
less.

{table}

* **Fit.** Every side gets the means of the dwells with their noise. `ml` also gives expanded
  uncertainties, sources, χ² and what is not determined; the hand-written fit and lmfit give values and
  their covariance, Tedaldi's and Ferraris' methods values alone. Ferraris' method trusts that faces are
  placed exactly, which a hand cannot; that is where its error of the angle comes from, so its speed
  buys nothing.
* **Trace.** The peers are told the noise and choose among the catalogue's columns; `trace` estimates
  the noise from the samples, weighs nameless causes against names, leaves dwells out, looks inside the
  dwells and fits the full model. That is its time. Something false: a wrong name, or a nameless cause
  where none was put in.
* **Archive.** Ours writes checksums and refuses changes besides; both sides write the same words and
  times.

Versions and machine: {machine}.
"""


def run(effort: Effort) -> Section:
    """All benchmarks whose baselines are installed; what is left out is said."""
    names = [name for name in bench.BENCHMARKS if not bench.absent([name])]
    missing = bench.absent(list(bench.BENCHMARKS))
    what = "`python scripts/bench.py` measures it." + (
        f" Left out, since not installed: {', '.join(missing)} (extra `baselines`)." if missing else ""
    )
    samples = bench.SAMPLES_FAST if effort.fast else SAMPLES
    rows = bench.measure(names, effort.seed, fast=effort.fast, samples=samples)
    machine = bench.machine()
    listed = ", ".join(f"{key} {value}" for key, value in machine.items())
    text = _TEXT.format(what=what, table=bench.table(rows), machine=listed)
    document = {"machine": machine, "missing": missing, "rows": [row.as_dict() for row in rows]}
    return Section("Speed", text, document)
