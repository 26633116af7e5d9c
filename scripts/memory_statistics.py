"""Statistics of the memory by simulation: coverage of the U of a drift, run lengths, time of a summary.

python scripts/memory_statistics.py --seed 1 [--sessions N] [--fast]
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

import numpy as np

from adis_gonio.base.uncertainty import Value
from adis_gonio.fleet.fleet_summary import summarise
from adis_gonio.fleet.sensor_history import CUSUM_H, control_chart, cusum, drift_of
from adis_gonio.fleet.session_record import SessionRecord
from adis_gonio.fleet.store import Store


def coverage(rng: np.random.Generator, trials: int, sessions: int, between: float) -> tuple[float, float]:
    """Shares of trials whose slope ± U holds the true one, and of those without drift with p < 0.05."""
    inside = false = 0
    for _ in range(trials):
        day = np.sort(rng.uniform(0, 3000, sessions))
        u = rng.uniform(0.5, 1.5, sessions)
        noise = rng.normal(0, np.hypot(u, between))
        slope = rng.normal(0, 3e-3)
        found = drift_of(day, slope * day + noise, u, "mg")
        none = drift_of(day, noise, u, "mg")
        assert found is not None
        assert none is not None
        inside += abs(found.slope.value - slope * 365.25) <= (found.slope.U or 0.0)
        false += none.p_value < 0.05
    return inside / trials, false / trials


def run_length(rng: np.random.Generator, trials: int, shift: float) -> tuple[float, float]:
    """Mean number of values until the two-sided CUSUM signals, and its standard error."""
    lengths = []
    for _ in range(trials):
        z = np.empty(0)
        while True:  # over a longer and longer series
            z = np.concatenate([z, rng.normal(shift, 1.0, max(len(z), 200))])
            over = np.flatnonzero(np.maximum(*cusum(z)) > CUSUM_H)
            if len(over):
                lengths.append(int(over[0]) + 1)
                break
    return float(np.mean(lengths)), float(np.std(lengths) / math.sqrt(trials))


def alarms(rng: np.random.Generator, trials: int, sessions: int, between: float) -> float:
    """Share of sensors that do not change whose chart of so many sessions signals."""
    u = np.full(sessions, 1.0)
    charts = (control_chart(rng.normal(0, np.hypot(u, between)), u) for _ in range(trials))
    return sum(chart.signal is not None for chart in charts) / trials


def summary_seconds(rng: np.random.Generator, records: int) -> tuple[float, float]:
    """Seconds to fill an index with results, and to open, check and summarise it."""
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        with Store(Path(folder) / "index") as index:
            index.keep(*(_record(rng, n) for n in range(records)))
        filled = time.perf_counter()
        with Store(Path(folder) / "index") as index:
            assert summarise([one.row() for one in index.records()]).sessions["n"] == records
    return filled - begun, time.perf_counter() - filled


def _record(rng: np.random.Generator, n: int) -> SessionRecord:
    names = {"delta_k": "1", "delta_phi": "deg", "bias_x": "mg", "bias_y": "mg", "angle": "deg"}
    values = {name: Value(float(rng.normal()), 0.1, unit, 40.0) for name, unit in names.items()}
    return SessionRecord(
        path=f"/none/{n}.session",
        sha256=f"{n:064x}",
        data_sha256=f"{n:064x}",
        serial=f"S{n % 5000}",
        operator=f"O{n % 12}",
        stage=f"T{n % 7}",
        when=f"{2010 + n % 15}-05-01T00:00:00+00:00",
        method="ml",
        values=values,
    )


def main() -> None:
    """Print every figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--sessions", type=int, default=100_000, help="results in the index")
    parser.add_argument("--fast", action="store_true")
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    trials = 300 if chosen.fast else 4000
    for between in (0.0, 1.0, 3.0):
        for sessions in (4, 8, 20):
            inside, false = coverage(rng, trials, sessions, between)
            print(
                f"drift, {sessions} sessions, between {between:g} u: inside U {100 * inside:.1f} %, "
                f"false {100 * false:.1f} %; signals {100 * alarms(rng, trials, sessions, between):.1f} %"
            )
    for shift in (0.0, 0.5, 1.0, 2.0):
        mean, u = run_length(rng, trials // 4, shift)
        print(f"CUSUM, shift {shift:g}: {mean:.2f} ± {2 * u:.2f}")
    filled, read = summary_seconds(rng, 2000 if chosen.fast else chosen.sessions)
    print(f"index filled in {filled:.1f} s, summarised in {read:.2f} s")


if __name__ == "__main__":
    main()
