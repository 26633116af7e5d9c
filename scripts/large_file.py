"""Time and memory that loading and fitting a large CSV take, in a process of its own.

python scripts/large_file.py [--rows 5000000] [--keep FOLDER]

Two files are made of seven columns (time, three accelerations, three rates) at 819.2 Hz: one continuous
recording, whose dwells are found by stillness, and one with positions. For each the peak of the resident
memory and the time of `load_session` and of `fit` are shown.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

RATE_HZ = 819.2
POSITIONS = 24
_BLOCK = 100_000
_CHILD = """
import json, re, resource, sys, time
def peak():
    try:  # of this program alone: what started it counts in ru_maxrss
        with open("/proc/self/status") as status:
            return int(re.search(r"VmHWM:\\s+(\\d+) kB", status.read()).group(1)) / 1024
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
from adis_gonio.record.loading import load_session
from adis_gonio.fitting import fit
import scipy.optimize, scipy.stats
imported, began = peak(), time.perf_counter()
session = load_session(sys.argv[1])
loaded, middle = peak(), time.perf_counter()
result = fit(session)
print(json.dumps({
    "imported_mb": imported, "loaded_mb": loaded, "fitted_mb": peak(), "dwells": len(session.dwells),
    "samples": sum(map(len, session.dwells)), "load_s": middle - began,
    "fit_s": time.perf_counter() - middle,
    "delta_k": result["delta_k"].value if "delta_k" in result else None,
}))
"""


def write(path: Path, rows: int, *, positions: bool) -> None:
    """A turn in `POSITIONS` steps; between them the stage moves for two seconds."""
    rng = np.random.default_rng(1)
    each = rows // POSITIONS
    move = min(int(2 * RATE_HZ), each // 4)
    with path.open("w", encoding="utf-8") as file:
        file.write("# accel_unit: mg\n# sensor: generic\n# fixture_sigma_deg: 0.05\n")
        own = "position,angle_deg," if positions else ""
        file.write(f"time_s,{own}ax,ay,az,gx,gy,gz\n")
        for start in range(0, rows, _BLOCK):
            k = np.arange(start, min(start + _BLOCK, rows))
            place = np.minimum(k // each, POSITIONS - 1)
            into = k - place * each
            step = 360 / POSITIONS
            moving = np.zeros(len(k)) if positions else np.clip(into / move, 0, 1) - 1
            angle = np.radians(step * (place + np.where(place > 0, moving, 0)))
            ideal = [1010 * np.cos(0.3 - angle), 1000 * np.sin(0.31 - angle), np.full(len(k), 5.0)]
            accel = np.stack(ideal, axis=1) + rng.normal(0, 2.0, (len(k), 3))
            turning = (moving < 0) & (place > 0)
            gyro = rng.normal(0, 0.3, (len(k), 3)) + np.outer(turning * step / (move / RATE_HZ), [0, 0, 1])
            table = np.column_stack([k / RATE_HZ, accel, gyro])
            if positions:
                table = np.column_stack([table[:, :1], place, step * place, table[:, 1:]])
            form = "%.4f," + ("%d,%g," if positions else "") + "%.3f,%.3f,%.3f,%.4f,%.4f,%.4f\n"
            file.write((form * len(k)) % tuple(table.ravel().tolist()))


def measure(path: Path) -> dict[str, float]:
    """Figures of a process that loads and fits a file."""
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(path)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        sys.exit(done.stderr)
    return json.loads(done.stdout)


def main() -> None:
    """Make the files, measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=5_000_000)
    parser.add_argument("--keep", type=Path, help="Folder for the files; else they are removed.")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(exist_ok=True)
        for positions in (False, True):
            name = "positions" if positions else "continuous"
            path = folder / f"{name}_{options.rows}.csv"
            if not path.exists():
                write(path, options.rows, positions=positions)
            figures = measure(path)
            print(f"{name}, {options.rows} rows, {path.stat().st_size / 1e6:.0f} MB of text:")
            for key, value in figures.items():
                print(f"  {key:<12}{value:.6g}")


if __name__ == "__main__":
    main()
