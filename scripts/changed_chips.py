"""Record chips with one changed rule, and test that `bringup --from` names this rule alone.

    python scripts/changed_chips.py [--seeds 3] [--sound 20] [--jobs 2] [--only WORD]

For each change of tests/fakes/changed_chips.py and seed, a bring-up and a service session are recorded, and
`bringup --from` judges both files together. Ends with status 1 if fewer than 95 % of the changes that the
recordings exercise are named by their row, or if a row is named on a sound chip.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.bench.bringup import Outcome
from adis_gonio.bench.bringup.chip_rows import judge_recordings
from adis_gonio.device.sensor.registers import VARIANTS
from fakes.changed_chips import CHANGES, record_bringup, record_service


def contradicted(name: str, seed: int) -> tuple[str, int, bool, tuple[str, ...]]:
    """Name, seed, True if the recordings exercise the changed row, and names of the contradicted rows."""
    change = CHANGES.get(name)
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, "bringup.rec"), Path(folder, "service.rec")]
        record_bringup(change, seed, files[0])
        record_service(change, seed, files[1])
        findings = judge_recordings(files, VARIANTS["adis16354"])
    rule = change.rule if change else ""
    exercised = any(one.name == rule and one.observations for one in findings)
    accused = tuple(one.name for one in findings if one.outcome is Outcome.CONTRADICTS)
    return name, seed, exercised, accused


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sound", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="changes with this word, and no sound chips")
    given = parser.parse_args()
    jobs = [(name, seed) for name in CHANGES if given.only in name for seed in range(given.seeds)]
    jobs += [("", seed) for seed in range(given.sound)] if not given.only else []
    total = named = alone = sound = 0
    print(f"{'change':46}{'seed':>5} {'row':20} contradicted")
    with ProcessPoolExecutor(given.jobs) as pool:
        for name, seed, exercised, accused in pool.map(contradicted, *zip(*jobs, strict=True)):
            rule = CHANGES[name].rule if name else "–"
            if name and exercised:
                total, named, alone = total + 1, named + (rule in accused), alone + (accused == (rule,))
            sound += not name and bool(accused)
            note = "" if exercised or not name else " (not exercised)"
            print(
                f"{name or 'sound':46}{seed:5} {rule:20} {', '.join(accused) or 'none'}{note}", flush=True
            )
    print(
        f"the changed rule is named: {named} of {total}; alone: {alone}; rows named on sound chips: {sound}"
    )
    return 0 if named >= 0.95 * total and not sound else 1


if __name__ == "__main__":
    sys.exit(main())
