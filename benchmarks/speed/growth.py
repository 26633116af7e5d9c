"""How cost grows: positions of a fit, samples of a recording, results in a summary."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.fitting import fit_readings
from adis_gonio.record.segmentation import segment_with_notes
from speed.fits import planar, spatial
from speed.timing import Row, quartiles, require

POSITIONS = (1000, 10_000, 100_000)
LINEAR = 1.15
"""Largest exponent that is called linear: caches of 10⁵ positions cost something."""
RATE_HZ = 819.2
REST_S, MOVE_S = 50.0, 2.0
PIECE = 100_000
BYTES = 56
"""A sample: a time, three accelerations and three rates."""
FEW = 1_000_000
"""Samples that already fill every buffer."""
MEMORY = 1.1
"""Largest ratio of the peaks that is called constant."""
SUMMARY_LIMIT_S = 60.0
CORES = 2


def fitting(rng: np.random.Generator, *, fast: bool) -> list[Row]:
    """Growth exponent of `ml` from the smallest to the largest number of positions."""
    sizes, runs = (POSITIONS[:2], 1) if fast else (POSITIONS, 5)
    rows = []
    for name, make in (("plane", planar), ("space", spatial)):
        readings = [make(rng, n) for n in sizes]
        times: list[list[float]] = [[] for _ in sizes]
        for run in range(runs + 1):
            for k, data in enumerate(readings):
                began = time.process_time()
                fit_readings(data, "ml")
                if run:  # the first is the warm-up
                    times[k].append(time.process_time() - began)
        decades = math.log10(sizes[-1] / sizes[-2])
        exponents = [math.log10(b / a) / decades for a, b in zip(times[-2], times[-1], strict=True)]
        low, middle, high = quartiles(exponents)
        what = f"time grows as n^{middle:.2f} ({low:.2f} to {high:.2f})"
        note = f"{what}; n to {sizes[-1]}, linear is 1"
        found = {"exponent": middle, "low": low, "high": high, "positions": list(sizes)}
        rows.append(Row(f"growth: fit, {name}", "–", None, None, None, runs, "", note, found))
    return rows


def recording(samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A turn in rests of 50 s, 2 s of motion between them: times, three accelerations and three rates."""
    rng = np.random.default_rng(1)
    t, accel, gyro = np.arange(samples) / RATE_HZ, np.empty((samples, 3)), np.empty((samples, 3))
    for first in range(0, samples, PIECE):
        part = slice(first, first + PIECE)
        place, into = np.divmod(t[part], REST_S + MOVE_S)
        moving = into > REST_S
        angle = 0.3 * (place + np.clip((into - REST_S) / MOVE_S, 0, 1))
        turned = np.stack([np.cos(angle), np.sin(angle), np.full(len(angle), 0.1)], axis=1)
        accel[part] = 1000 * turned + rng.standard_normal((len(angle), 3)) * 2.0
        gyro[part] = rng.standard_normal((len(angle), 3)) * 0.3
        gyro[part, 2] += moving * math.degrees(0.3 / MOVE_S)
    return t, accel, gyro


def peak_mb() -> float:
    """Peak of this process' resident memory in MB (VmHWM)."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="utf-8"))
    if found is None:
        raise RuntimeError("/proc/self/status tells no VmHWM")
    return int(found.group(1)) / 1024


def segment_here(samples: int) -> dict[str, float]:
    """Dwells, processor time and peak memory of one recording, in this process."""
    whole = recording(samples)
    before, began = peak_mb(), time.process_time()
    slices, _ = segment_with_notes(*whole)
    spent = time.process_time() - began
    return {
        "dwells": len(slices),
        "samples": samples,
        "s": spent,
        "before_mb": before,
        "peak_mb": peak_mb(),
    }


def segmenting(samples: int) -> list[Row]:
    """Peak memory besides the samples, at `FEW` of them and at all, each in a process of its own."""
    few, many = (_child(f"segment_here({n})") for n in (min(FEW, samples // 2), samples))
    for found in (few, many):
        whole = int(found["samples"] / RATE_HZ // (REST_S + MOVE_S))
        require(whole <= found["dwells"] <= whole + 1, f"{found['dwells']} dwells, {whole} rests put in")
    peaks = [found["peak_mb"] - found["samples"] * BYTES / 2**20 for found in (few, many)]
    ratio = peaks[1] / peaks[0]
    exponent = math.log(many["s"] / few["s"]) / math.log(many["samples"] / few["samples"])
    constant = "constant" if ratio <= MEMORY else "NOT constant"
    note = (
        f"peak memory (VmHWM) besides the samples {ratio:.2f} times that of {few['samples']:.0e} samples: "
        f"{constant}; time grows as n^{exponent:.2f}"
    )
    found = {"samples": samples, "memory_ratio": ratio, "exponent": exponent, "dwells": many["dwells"]}
    agreement = f"every rest found, {many['dwells']:.0f}"
    return [
        Row(
            f"growth: segmentation, {samples:.0e} samples", "–", None, None, None, 1, agreement, note, found
        )
    ]


def rows_of_results(count: int) -> list[dict[str, Any]]:
    """Rows of a fleet: units with a history, stages, operators, random effects, one file in 500 broken."""
    from adis_gonio.fleet.session_record import COLUMNS

    rng = np.random.default_rng(2)
    numbers = [name for name, (kind, *_) in COLUMNS.items() if kind == "number"]
    drawn = rng.normal(0, 1, (count, len(numbers)))
    rows = []
    for k in range(count):
        row: dict[str, Any] = dict.fromkeys(COLUMNS)
        row |= dict(zip(numbers, drawn[k].tolist(), strict=True))
        row |= {name: abs(row[name]) + 0.1 for name in numbers if name.endswith(("_u", "_u95", "angle"))}
        row |= {
            "path": f"{k}.session", "sha256": f"{k:064x}", "data_sha256": f"{k:064x}",
            "serial": f"S{k % (count // 4):05d}", "operator": f"O{k % 12}", "stage": f"T{k % 7}",
            "sensor": "adis16354", "plan": "tumble", "when": "2026-01-01T00:00:00Z", "simulated": 1,
            "dwells": 24, "method": "ml", "model_effects": [], "traced": 1, "adequate": 1,
            "effects": ["bias"] * (rng.uniform() < 0.9) + ["quadratic"] * (rng.uniform() < 0.1),
            "doubts": "", "status": "ok", "reason": "", "software": "adis-gonio",
        }  # fmt: skip
        if k % 500 == 0:
            row |= {"status": "failed", "reason": "damaged"} | dict.fromkeys(numbers)
        rows.append(row)
    return rows


def summarise_here(count: int) -> dict[str, float]:
    """Wall time of a summary of so many results, in this process, and its counts."""
    from adis_gonio.fleet.fleet_summary import summarise

    rows = rows_of_results(count)
    began = time.perf_counter()
    found = summarise(rows).as_dict()["sessions"]
    return {"s": time.perf_counter() - began, "n": found["n"], "failed": found["failed"]}


def summarising(count: int) -> list[Row]:
    """A summary of archived results, as a share of the time that it may take on two cores."""
    name = f"growth: summary of {count:.0e} results"
    if find_spec("adis_gonio.fleet") is None:
        return [Row(name, "–", None, None, None, 0, "", "not there: no adis_gonio.fleet")]
    found = _child(f"summarise_here({count})")
    agreement = require(
        found["n"] == count and found["failed"] == math.ceil(count / 500),
        "every result and failure counted",
    )
    share = found["s"] / SUMMARY_LIMIT_S
    note = f"takes {100 * share:.0f} % of the {SUMMARY_LIMIT_S:g} s allowed on {CORES} cores"
    return [
        Row(name, "–", None, None, None, 1, agreement, note, {"results": count, "share_of_limit": share})
    ]


def _child(call: str) -> dict[str, float]:
    """What a call of this module gives in a fresh process, on at most two cores."""
    code = (
        "import json, os\n"
        "if hasattr(os, 'sched_setaffinity'):\n"
        f"    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:{CORES}])\n"
        f"from speed import growth\nprint(json.dumps(growth.{call}))"
    )
    path = [str(Path(__file__).parents[1]), *sys.path]
    program = f"import sys\nsys.path[:0] = {path!r}\n{code}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    answer: dict[str, float] = json.loads(done.stdout)
    return answer
