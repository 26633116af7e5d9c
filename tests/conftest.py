"""Settings of all tests: the level of each, no deadline for an example, and no skip in CI."""

import gc
import os
from pathlib import PurePosixPath

import pytest
from hypothesis import settings

from levels import ORDER, TESTS, is_quick, level_of

# A busy machine is slow, not wrong: hypothesis' limit of time for an example would fail it.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")


# The collected tests are a million objects that live to the end. The garbage collector would visit them
# again and again, which takes 40 % of the time of the collection.
gc.disable()


def pytest_collection_finish() -> None:
    """Leave the collected tests out of all later runs of the garbage collector, and have it run seldom.

    With its own threshold of 700 objects it takes a tenth of the time of the tests.
    """
    gc.freeze()
    gc.set_threshold(20_000, 10, 10)
    gc.enable()


@pytest.hookimpl(tryfirst=True)  # before `-m` selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test with its level, and run the levels with the longest tests first."""
    rank = {}
    levels = {}
    for item in items:
        if item.path not in levels and item.path.is_relative_to(TESTS):
            file = PurePosixPath(item.path.relative_to(TESTS).as_posix())
            levels[item.path] = level_of(file), is_quick(file)
        if item.path not in levels:
            continue
        level, quick = levels[item.path]
        item.add_marker(level)
        if level == "unit" and not quick:
            item.add_marker("slow")
        rank[item] = (ORDER.index(level), quick)
    items.sort(key=lambda item: rank.get(item, (len(ORDER), True)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Name what was skipped where nothing may be."""
    if _skipped_in_ci(terminalreporter):
        terminalreporter.section("skipped in CI, which counts as failed", red=True)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a skipped rig is a failure: what is not run is not shown."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and _skipped_in_ci(reporter) and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _skipped_in_ci(reporter: pytest.TerminalReporter) -> bool:
    return os.environ.get("CI") == "true" and bool(reporter.stats.get("skipped"))
