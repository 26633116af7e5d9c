"""The level of each test, and the tests that a quick run leaves out.

`conftest.py` gives every test its level as a mark, so that `pytest -m rig` and `pytest -m "not kernel"`
select by it. A new folder gets an entry in `LEVELS`, and so does a file that differs from its folder.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

TESTS = Path(__file__).parent

ORDER = ("kernel", "browser", "rig", "statistics", "unit")
"""The levels in the order in which they run: the longest tests first, so that no worker ends with one."""

LEVELS = {
    # One process, or commands of the package as processes; no tool besides Python packages.
    "unit": (
        *("allan", "answer", "benchmark", "bringup", "bus", "calibration", "cli", "contract", "docs"),
        *("estimation", "examples", "fitting", "fleet", "free_turn"),
        *("gyros", "handover", "house", "memory", "model", "paper", "planning", "population", "report"),
        *("sensor", "session", "sim", "slips", "smoothing"),
        *("test_double", "tracing", "tui", "twin", "wire", "writeback"),
        "kernel/test_urb_packets.py",
        *("test_every_module_imports.py", "test_output_files.py", "test_python_interface.py"),
    ),
    # Rates over many drawn sessions, operators or files.
    "statistics": (
        "allan/test_allan_boundary.py",
        "bringup/test_bringup_limits.py",
        "cli/test_clumsy_typist.py",
        *("fitting/test_efficiency.py", "fitting/test_fit_statistics.py"),
        "fitting/test_information_bound.py",
        *("fitting/test_missing_effects.py", "fitting/test_shared_noise.py"),
        "fitting/test_wide_fixture.py",
        "results_pages",
        *("session/test_clumsy_operators.py", "session/test_fuzzed_files.py"),
        "session/test_session_false_alarms.py",
        "session/test_session_faults.py",
        *("tracing/test_blind_rounds.py", "tracing/test_planted_effects.py", "tracing/test_within.py"),
        *("tracing/test_within_sensitivity.py", "tracing/test_within_sessions.py"),
        "writeback/test_verification_rates.py",
    ),
    # Another program at the other end: firmware in an emulator, a compiler, a client, a terminal.
    "rig": (
        "docs/test_documentation_site.py",
        "firmware",
        "fleet/test_fleet_cluster.py",
        "handover/test_c_header.py",
        "iio_source",
        "rig_simavr",
        "serve",
        "tui/test_terminal_sessions.py",
    ),
    "kernel": ("kernel",),
    "browser": ("report/test_memory_pages_in_browser.py", "report/test_report_in_browser.py"),
}
"""Folders of tests and, where a file differs from its folder, files."""

SLOW = frozenset(["writeback/test_power_cut.py"])
"""Files of level `unit` that take more than some seconds of processor time: a quick run leaves them out."""

_LEVEL_OF = {entry: level for level, entries in LEVELS.items() for entry in entries}


def level_of(file: PurePosixPath) -> str:
    """Return the level of a test file; `file` is relative to this folder.

    Raises
    ------
    KeyError
        If neither the file nor its folder has an entry in `LEVELS`.
    """
    level = _LEVEL_OF.get(str(file)) or _LEVEL_OF.get(file.parts[0])
    if level is None:
        raise KeyError(f"tests/{file}: give its folder a level in tests/levels.py")
    return level


def is_quick(file: PurePosixPath) -> bool:
    """Return whether the tests of a file are part of a quick run."""
    return level_of(file) == "unit" and str(file) not in SLOW
