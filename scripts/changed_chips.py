"""Record chips with one changed rule, and test that `bringup --from` names this rule alone.

    python scripts/changed_chips.py [--first 0] [--seeds 3] [--sound 20] [--jobs 2] [--only WORD]
        [--list MODULE]

For each change of tests/fakes/changed_chips.py (or of another module of tests/fakes in the same form) and
seed, a bring-up and a service session are recorded, and `bringup --from` judges both files together. If a
row needs several parts, the autonulls of further parts are recorded too. A module may also have `SOUND`, a
dictionary of chips that obey the table in unusual circumstances. Ends with status 1 if fewer than 95 % of
the changes that the recordings exercise are named by their row, or if a row is named on a sound chip.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from adis_gonio.bench.bringup import Outcome
from adis_gonio.bench.bringup.chip_rows import judge_recordings
from adis_gonio.device.sensor.registers import VARIANTS
from fakes.changed_chips import Change, record_bringup, record_nulls, record_service


def changes_of(module: str) -> dict[str, Change]:
    """The changes of a module of tests/fakes, and its sound chips, which have no rule."""
    chips = importlib.import_module(f"fakes.{module}")
    return {**chips.CHANGES, **getattr(chips, "SOUND", {})}


def contradicted(module: str, name: str, seed: int) -> tuple[bool, tuple[str, ...]]:
    """True if the recordings exercise the changed row, and names of the contradicted rows."""
    change = changes_of(module).get(name)
    parts = change.parts if change else 1
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder, f"{k}.rec") for k in range(parts + 1)]
        record_bringup(change, seed, files[0])
        record_service(change, seed, files[1])
        for k, file in enumerate(files[2:], 1):
            record_nulls(change, seed + 1000 * k, file)
        findings = judge_recordings(files, VARIANTS["adis16354"])
    exercised = {one.name for one in findings if one.observations}
    accused = tuple(one.name for one in findings if one.outcome is Outcome.CONTRADICTS)
    return change is not None and not exercised.isdisjoint(change.rule.split(", ")), accused


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sound", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="changes with this word, and no sound chips")
    parser.add_argument("--list", default="changed_chips", help="module of tests/fakes with the changes")
    given = parser.parse_args()
    changes = changes_of(given.list)
    first = given.first
    chosen = [name for name in changes if given.only in name]
    jobs = [(name, seed) for name in chosen for seed in range(first, first + given.seeds)]
    jobs += [("", seed) for seed in range(first, first + given.sound)] if not given.only else []
    total = named = alone = idle = sound = 0
    print(f"{'change':46}{'seed':>5} {'row':20} contradicted")
    with ProcessPoolExecutor(given.jobs) as pool:
        results = pool.map(contradicted, [given.list] * len(jobs), *zip(*jobs, strict=True))
        for (name, seed), (exercised, accused) in zip(jobs, results, strict=True):
            rule = changes[name].rule if name else ""
            if exercised:
                right = [one for one in accused if one in rule.split(", ")]
                total, named = total + 1, named + bool(right)
                alone += len(right) == len(accused) > 0
            idle += bool(rule) and not exercised
            sound += not rule and bool(accused)
            note = "" if exercised or not rule else " (not exercised)"
            print(
                f"{name or 'sound':46}{seed:5} {rule or '–':20} {', '.join(accused) or 'none'}{note}",
                flush=True,
            )
    print(
        f"the changed rule is named: {named} of {total}; alone: {alone}; not exercised: {idle};"
        f" sound chips with a named row: {sound}"
    )
    return 0 if named >= 0.95 * total and not sound else 1


if __name__ == "__main__":
    sys.exit(main())
