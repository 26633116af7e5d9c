"""Whether a test notices each number of the trace at half and at twice its value.

    python scripts/trace_numbers.py
    python scripts/trace_numbers.py --numbers told,worse

For each number of `adis_gonio.tracing.thresholds` that is no effort (or those of `--numbers`) the tests
that are marked with it (`pytest.mark.number`, all in `tests/tracing/test_trace_numbers.py`) run as it is,
halved and doubled. Printed: a row a number with the first test that fails at half and at twice, or a dash.
Exit status 1 where a number goes unnoticed, or a test fails with the numbers as they are.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from adis_gonio.tracing.thresholds import Limits, limits

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests" / "tracing" / "test_trace_numbers.py"
NUMBERS = {field.name: field for field in dataclasses.fields(Limits)}


def first_failure(items: Sequence[pytest.Item], name: str, factor: float) -> str:
    """Name of the first of some tests that fails with a number changed; empty if all pass."""
    usual = getattr(limits, name)
    setattr(limits, name, type(usual)(usual * factor))
    try:
        for item in items:
            if any(report.failed for report in runtestprotocol(item, log=False)):
                return item.name
    finally:
        setattr(limits, name, usual)
    return ""


class Changing:
    """Runs tests with numbers changed, in the place of pytest's own loop."""

    def __init__(self, wanted: Sequence[str]) -> None:
        self.wanted, self.wrong = wanted, 0

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Print a row a number."""
        print("\n| number | at half | at twice |\n|---|---|---|", flush=True)
        for name in self.wanted:
            items = [i for i in session.items if name in {m.args[0] for m in i.iter_markers("number")}]
            usual, *told = (first_failure(items, name, factor) for factor in (1, 0.5, 2))
            self.wrong += bool(usual) + told.count("")
            row = " | ".join(f"`{test}`" if test else "–" for test in told)
            print(f"| `{name}` | {row} |" + f" fails as it is: {usual}" * bool(usual), flush=True)
        return True


def main() -> int:
    """Run and print; 1 where a number goes unnoticed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--numbers", default="", help="names, by default all that are no effort")
    options = parser.parse_args()
    wanted = [name for name in options.numbers.split(",") if name] or [
        name for name, field in NUMBERS.items() if field.metadata["origin"] != "effort"
    ]
    unknown = [name for name in wanted if name not in NUMBERS]
    if unknown:
        parser.error(f"{unknown[0]} is no number of the trace; known: {', '.join(NUMBERS)}")
    changing = Changing(wanted)
    quiet = ["-s", "-qq", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml")]
    # The package has a plugin of its own, which is imported here already.
    quiet += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    status = pytest.main([*quiet, str(TESTS)], plugins=[changing])
    collected = status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED)
    return int(changing.wrong > 0 or not collected)


if __name__ == "__main__":
    sys.exit(main())
