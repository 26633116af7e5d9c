"""Sessions per second by the number of processes, and the cost of a summary."""

from __future__ import annotations

import os
import platform
import tempfile
import time
from pathlib import Path

import numpy as np

from adis_gonio.base.budget import Budget, within
from adis_gonio.fleet.fleet_run import Fleet, run_fleet, session_files
from adis_gonio.fleet.fleet_summary import summarise
from adis_gonio.fleet.session_record import COLUMNS, Options
from adis_gonio.fleet.store import IN_MEMORY, Store
from adis_gonio.fleet.workers import LocalPool, cores
from results.section import Effort, Section

STAGES, OPERATORS = 4, 3
POSITIONS, SAMPLES = 12, 200
TIMED = ("delta_k", "delta_phi", "bias_x", "bias_y")


def drawn(path: Path, number: int, rng: np.random.Generator) -> None:
    """One session by the planar model: gain, misalignment, biases, a fixture of 0.02°, 1 mg of noise."""
    gain, skew, bias = rng.normal(0, 0.004), np.radians(rng.normal(0, 0.3)), rng.normal(0, 8, 2)
    lines = [
        "# sensor: adis16354",
        "# accel_unit: mg",
        "# fixture_sigma_deg: 0.02",
        f"# serial: SN{number // 2}",
    ]
    lines += [f"# stage: stage {number % STAGES}", f"# operator: op {number % OPERATORS}"]
    lines += ["time_s,position,angle_deg,ax,ay"]
    for position in range(POSITIONS):
        angle = 360 * position / POSITIONS
        phi = np.radians(angle + rng.normal(0, 0.02))
        ideal = np.array([1000 * (1 + gain) * np.cos(phi), -1000 * np.sin(phi + skew)]) + bias
        for k, (x, y) in enumerate(ideal + rng.normal(size=(SAMPLES, 2))):
            lines.append(f"{10 * position + 0.01 * k:.2f},{position},{angle:g},{x:.4f},{y:.4f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def seconds(files: list[str], options: Options, workers: int) -> tuple[float, Fleet]:
    """Seconds per session, measured from the end of the first session to the end of the last."""
    marks: list[float] = []

    def mark(stage: str) -> None:
        if " of " in stage:
            marks.append(time.perf_counter())

    with LocalPool(workers) as pool, Store(IN_MEMORY) as store, within(Budget(tell=mark)):
        fleet = run_fleet(files, options, store, pool)
    return (marks[-1] - marks[0]) / (len(marks) - 1), fleet


def rows(rng: np.random.Generator, count: int) -> list[dict[str, object]]:
    """Rows of a fleet without files."""
    made = []
    for k in range(count):
        row: dict[str, object] = dict.fromkeys(COLUMNS)
        row |= {"path": f"{k:06d}", "serial": f"SN{k // 3}", "stage": f"stage {k % 20}", "status": "ok"}
        row |= {
            "operator": f"op {k % 7}",
            "traced": True,
            "effects": ["bias"] if k % 3 else [],
            "reason": "",
        }
        for name in TIMED:
            row |= {name: float(rng.normal()), f"{name}_u": 0.2, f"{name}_dof": 12.0}
        made.append(row)
    return made


def measured(files: list[str], options: Options, most: int) -> dict[str, float | int | bool]:
    """Compare one worker with one worker per core (two at least)."""
    one, calm = seconds(files, options, 1)
    many, other = seconds(files, options, most)
    same = calm.as_dict() == other.as_dict()
    return {
        "sessions": len(files),
        "failed": calm.failed,
        "one_per_s": 1 / one,
        "many_per_s": 1 / many,
        "workers": most,
        "ratio": one / many,
        "same_summary": same,
    }


def run(effort: Effort) -> Section:
    """Measure fits, traces and a summary."""
    count, traced, big = effort.sessions(1000, 4), effort.sessions(20, 2), effort.sessions(100_000, 1000)
    most = max(2, cores())
    with tempfile.TemporaryDirectory() as folder:
        rng = effort.generator()
        for k in range(count):
            drawn(Path(folder, f"{k:04d}.csv"), k, rng)
        files = session_files([folder])
        traces = measured(files[:traced], Options(trace=True), most)
        # A trace fits too, so a fast run starts no further processes for fits alone.
        fits = traces if effort.fast else measured(files, Options(trace=False), most)
    synthetic = rows(effort.generator(), big)
    begun = time.process_time()
    summarise(synthetic)
    summary_s = time.process_time() - begun
    machine = f"{platform.machine()}, {cores()} cores, Python {platform.python_version()}"
    document = {"machine": machine, "fits": fits, "traces": traces, "load": list(os.getloadavg())}
    document |= {"summary": {"rows": big, "processor_s": summary_s}}
    return Section(document)
