"""Compare the JSON of `fit` and `trace` of two source trees, session by session.

    python scripts/compare_answers.py OLD NEW [--sessions 100] [--seed 1] [--data FOLDER ...]

OLD and NEW are folders that hold the package `adis_gonio` (`src` of two checkouts). The sessions are the
recordings in `examples/measured/` and in each FOLDER, and simulated ones that OLD makes by seed. Each tree
runs in a process of its own. A number may differ by one part in 10⁹; every other difference is printed, and
the exit status is 1.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TOLERANCE = 1e-9
PLANS = ("tumble", "four-position", "mmpm", "poses", "two-position")
EFFECTS = ("none", "bias", "quadratic", "bias_temperature", "hysteresis", "stage_eccentricity", "scale")

MAKE = """
import sys
import adis_gonio.{cli} as cli
for line in sys.stdin:
    cli.main(line.split())
"""
ANSWER = """
import json, sys
import adis_gonio
from adis_gonio import fit, load_session, trace
for line in sys.stdin:
    path, found = line.strip(), {}
    jobs = {"fit": fit, "gyro": lambda s: fit(s, part="gyro"), "trace": trace}
    for name, make in jobs.items():
        try:
            found[name] = make(load_session(path)).as_dict()
        except Exception as error:
            found[name] = f"{type(error).__name__}: {error}"
    print(json.dumps(found), flush=True)
"""


def main() -> int:
    """Print every difference."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--data", type=Path, nargs="*", default=[])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        simulated = simulate(options.old, Path(place), options.sessions, options.seed)
        recorded = [
            p for f in (ROOT / "examples" / "measured", *options.data) for p in sorted(f.rglob("*.csv*"))
        ]
        paths = [*recorded, *simulated]
        runs = [answers(tree, paths) for tree in (options.old, options.new)]
        differing = 0
        for path, old, new in zip(paths, *runs, strict=True):
            found = list(differences(json.loads(old), json.loads(new), path.name))
            differing += bool(found)
            for text in found[:5]:
                print(text)
    print(f"{len(paths)} sessions ({len(recorded)} recorded), {differing} with a difference")
    return 1 if differing else 0


def simulate(tree: Path, folder: Path, count: int, seed: int) -> list[Path]:
    """Sessions of plans and effects in turn, each with a seed of its own."""
    paths, lines = [], []
    for k in range(count):
        effect = EFFECTS[k % len(EFFECTS)]
        paths.append(folder / f"{k}.session")
        line = f"simulate -o {paths[-1]} --plan {PLANS[k % len(PLANS)]} --seed {seed + k} --dwell 1"
        lines.append(line + ("" if effect == "none" else f" --effect {effect}"))
    run(tree, MAKE.format(cli="cli" if (tree / "adis_gonio" / "cli").exists() else "faces.cli"), lines)
    return [path for path in paths if path.exists()]


def answers(tree: Path, paths: list[Path]) -> list[str]:
    """JSON documents of a tree, one line a session."""
    return run(tree, ANSWER, [str(path) for path in paths]).splitlines()


def run(tree: Path, program: str, lines: list[str]) -> str:
    """Output of a program that sees the package of a tree alone."""
    program = program.replace(
        "from adis_gonio import faces.cli as cli", "import adis_gonio.faces.cli as cli"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        input="\n".join(lines) + "\n",
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        check=True,
        timeout=36_000,
        env=os.environ | {"PYTHONPATH": str(tree.resolve()), "OPENBLAS_NUM_THREADS": "1"},
        cwd=tempfile.gettempdir(),
    )
    return done.stdout


def differences(old: Any, new: Any, where: str) -> Any:
    """Lines that say where two documents differ."""
    if isinstance(old, dict) and isinstance(new, dict) and old.keys() == new.keys():
        for key, value in old.items():
            yield from differences(value, new[key], f"{where} {key}")
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, pair in enumerate(zip(old, new, strict=True)):
            yield from differences(*pair, f"{where}[{k}]")
    elif not alike(old, new):
        yield f"{where}: {str(old)[:60]} | {str(new)[:60]}"


def alike(old: Any, new: Any) -> bool:
    """True if two values are equal, numbers to rounding."""
    if isinstance(old, float) and isinstance(new, float):
        return math.isclose(old, new, rel_tol=TOLERANCE, abs_tol=1e-12) or (
            math.isnan(old) and math.isnan(new)
        )
    return bool(old == new)


if __name__ == "__main__":
    raise SystemExit(main())
