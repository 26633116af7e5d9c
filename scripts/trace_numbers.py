"""Whether a test notices each number of the trace at half and at twice its value.

    python scripts/trace_numbers.py --work /tmp/numbers
    python scripts/trace_numbers.py --numbers told,worse --work /tmp/numbers

For each number of `adis_gonio.tracing.thresholds` that is no effort (or those of `--numbers`) the quick
tests of the trace run twice, until the first that fails. Printed: a row a number with the test that fails
at half and at twice, or a dash. A run that was broken off goes on where it was.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

from adis_gonio.tracing.thresholds import Limits

ROOT = Path(__file__).resolve().parents[1]
TESTS = tuple(
    f"tests/tracing/test_trace_{name}.py"
    for name in (
        "numbers",
        "engine",
        "gates",
        "sets",
        "openings",
        "proposals",
        "left_out",
        "small_sessions",
        "smooth",
        "shared_noise",
        "sceptic",
    )
)
CHANGED = "ADIS_GONIO_TRACE_NUMBER"
PLUGIN = f'''
import os
from adis_gonio.tracing.thresholds import limits
name, value = os.environ["{CHANGED}"].split("=")
setattr(limits, name, type(getattr(limits, name))(float(value)))
'''
"""A number is changed before any test is collected."""


def first_failure(folder: Path, name: str, value: float) -> str:
    """Name of the first test that fails with a number changed; empty if all pass.

    Raises
    ------
    RuntimeError
        pytest could not run.
    """
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "changed_number"]
    environment = os.environ | {
        CHANGED: f"{name}={value!r}",
        "PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]),
        "OPENBLAS_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [*command, "-rf", *TESTS],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=3600,
        check=False,
    )
    if done.returncode == pytest_passed():
        return ""
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED ")]
    if not failed:
        raise RuntimeError(f"{name} = {value}: {done.stdout[-500:]}{done.stderr[-500:]}")
    return failed[0].split(" ")[1].rsplit("::", 1)[1]


def pytest_passed() -> int:
    """Exit status of a run without a failure."""
    import pytest

    return int(pytest.ExitCode.OK)


def main() -> int:
    """Run and print; 1 where a number goes unnoticed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--numbers", default="", help="names, by default all that are no effort")
    parser.add_argument("--work", type=Path, default=Path("/tmp/trace_numbers"), help="what is done")
    options = parser.parse_args()
    fields = {field.name: field for field in dataclasses.fields(Limits)}
    wanted = [name for name in options.numbers.split(",") if name] or [
        name for name, field in fields.items() if field.metadata["origin"] != "effort"
    ]
    unknown = [name for name in wanted if name not in fields]
    if unknown:
        parser.error(f"{unknown[0]} is no number of the trace; known: {', '.join(fields)}")
    options.work.mkdir(parents=True, exist_ok=True)
    (options.work / "changed_number.py").write_text(PLUGIN, encoding="utf-8")
    kept = options.work / "done.json"
    done: dict[str, str] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    print("| number | at half | at twice |\n|---|---|---|", flush=True)
    missed = 0
    for name in wanted:
        told = []
        for factor in (0.5, 2):
            value = fields[name].default * factor
            key = f"{name}={value!r}"
            if key not in done:
                done[key] = first_failure(options.work, name, value)
                kept.write_text(json.dumps(done, indent=1), encoding="utf-8")
            missed += not done[key]
            told.append(f"`{done[key]}`" if done[key] else "–")
        print(f"| `{name}` | {' | '.join(told)} |", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
