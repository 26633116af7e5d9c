"""The loop on a live session: what is found after the plan, and after the positions that tracing asked for.

    python scripts/trace_loop.py --seeds 10 --jobs 2

Each session is `adis-gonio calibrate URL --auto --trace` on a simulated sensor on a good stage (0.002°),
without slow noise, dwells of 2 s. An effect counts as found where it is called so, and as named where the
report says that it cannot be told from another that was called found. Other names beside the bias are wrong
unless the report says the same of them.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

URL = "sim:?seed={seed}&bias_instability_mg=0&fixture_sigma_deg=0.002"
NINE = ("--plan", "mmpm", "--positions", "9")
CASES: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "four positions, curved axis": (("--plan", "four-position"), {"quadratic": "k2_x=3"}),
    "four positions, drift": (("--plan", "four-position"), {"bias_drift": "drift_y=5"}),
    "nine in order, curved axis": (NINE, {"quadratic": "k2_x=3"}),
    "nine in order, drift": (NINE, {"bias_drift": "drift_y=2"}),
    "nine in order, asymmetry": (NINE, {"asymmetry": "asymmetry_y=3"}),
    "nine in order, backlash": (NINE, {"backlash": "backlash=0.05"}),
    "nine, curved axis and drift": (NINE, {"quadratic": "k2_x=3", "bias_drift": "drift_y=2"}),
    "24 there and back, nothing": (("--plan", "tumble"), {}),
}
"""Options of `calibrate`, and the effects of the world."""


@dataclass(frozen=True)
class Loop:
    """One session.

    Attributes
    ----------
    first, last : bool
        Whether all effects were found after the plan, and after the loop.
    named : bool
        The same with what the report says that it cannot tell from what was found.
    added : int
        Positions beyond the plan.
    wrong : tuple of str
        Names that are not so.
    """

    first: bool
    last: bool
    named: bool
    added: int
    wrong: tuple[str, ...]
    adequate: bool
    angle_deg: float


def run(case: str, seed: int) -> Loop:
    """Calibrate with the trace, in this process."""
    from adis_gonio.faces.cli import main as command

    options, effects = CASES[case]
    url = URL.format(seed=seed)
    if effects:
        url += "&effects=" + ";".join(f"{name}:{value}" for name, value in effects.items())
    out = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
        path = str(Path(folder) / "loop.session")
        with contextlib.redirect_stdout(out):
            command(["calibrate", url, *options, "--auto", "--trace", "--dwell", "2", "--json", "-o", path])
    document: dict[str, Any] = json.loads(out.getvalue())
    rounds, trace = document["rounds"], document["trace"]
    truth = set(effects)
    claimed = [entry["effect"] for entry in trace["found"]]
    groups = [set(group) for group in trace["confounded"]]
    instead = {name for group in groups if group & truth for name in group}
    return Loop(
        first=truth <= set(rounds[0]["summary"]["found"]),
        last=truth <= set(claimed),
        named=truth <= {*claimed, *(n for group in groups if group & set(claimed) for n in group)},
        added=rounds[-1]["planned"] - rounds[0]["planned"],
        wrong=tuple(name for name in claimed if name not in {*truth, "bias", *instead}),
        adequate=bool(trace["adequate"]),
        angle_deg=float(trace["error"]["after"]["angle_rms_deg"] or np.nan),
    )


def main() -> int:
    """Run and print one line a case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--case", choices=[*CASES, "all"], default="all")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    print(
        f"{'session':30} {'plan':>6} {'loop':>6} {'named':>6}  {'added':>8} {'adequate':>9} "
        f"{'angle':>8}  wrong"
    )
    with ProcessPoolExecutor(options.jobs) as pool:
        for case in CASES if options.case == "all" else (options.case,):
            loops = list(pool.map(partial(run, case), range(1, options.seeds + 1)))
            n = len(loops)
            added = sorted(loop.added for loop in loops)
            wrong = ", ".join(name for loop in loops for name in loop.wrong) or "none"
            print(
                f"{case:30} {sum(q.first for q in loops):3}/{n:<2} {sum(q.last for q in loops):3}/{n:<2} "
                f"{sum(q.named for q in loops):3}/{n:<2}  {added[0]:2} to {added[-1]:<2} "
                f"{sum(q.adequate for q in loops):6}/{n:<2} "
                f"{np.nanmedian([q.angle_deg for q in loops]):7.4f}°  {wrong}",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
