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

SLOW = frozenset(
    [
        "allan/test_allan_command.py",
        "allan/test_allan_fit.py",
        "benchmark/test_challenge_scores.py",
        "bringup/test_bringup_boards.py",
        "bringup/test_bringup_bridges.py",
        "calibration/test_gyros_of_sessions.py",
        "cli/test_calibrate_plain.py",
        "cli/test_character_sets.py",
        "cli/test_closing_command.py",
        "cli/test_export_command.py",
        "cli/test_long_work.py",
        "cli/test_simulate_command.py",
        "cli/test_trace_command.py",
        "docs",
        "examples",
        "fleet/test_fleet_command.py",
        "fleet/test_fleet_processes.py",
        "free_turn",
        "gyros/test_axes_of_accelerometers.py",
        "gyros/test_gyro_fit_and_trace.py",
        "gyros/test_gyro_turns_session.py",
        "gyros/test_links.py",
        "gyros/test_three_thermometers.py",
        "gyros/test_vertical_of_a_turn.py",
        "handover/test_gyro_exports.py",
        "memory/test_memory_commands.py",
        "paper",
        "planning/test_plan_prediction.py",
        "planning/test_plan_search.py",
        "population",
        "report/test_report_page.py",
        "session/test_changed_registers.py",
        "session/test_faults_below_the_driver.py",
        "session/test_files_from_strangers.py",
        "session/test_large_files.py",
        "session/test_session_closing.py",
        "session/test_session_guards.py",
        "session/test_session_kill.py",
        "session/test_smoothed_live_angle.py",
        "slips",
        "smoothing/test_angle_smoother.py",
        "smoothing/test_disturbance.py",
        "smoothing/test_linear_model.py",
        "test_double/test_plugin.py",
        "test_double/test_simulated_board.py",
        "tracing/test_blind_sessions.py",
        "tracing/test_trace_engine.py",
        "tracing/test_trace_gates.py",
        "tracing/test_trace_proposals.py",
        "tracing/test_trace_sceptic.py",
        "tracing/test_trace_simulated.py",
        "tracing/test_trace_small_sessions.py",
        "tracing/test_trace_smooth.py",
        "tracing/test_trace_time_limit.py",
        "tui/test_arrow.py",
        "twin",
        "writeback/test_power_cut.py",
        "writeback/test_write_gyros.py",
        "writeback/test_write_keeps_results.py",
        "writeback/test_write_offsets.py",
        "writeback/test_write_over_bridges.py",
    ]
)
"""Folders and files of level `unit` that take more than some seconds: a quick run leaves them out."""

_LEVEL_OF = {entry: level for level, entries in LEVELS.items() for entry in entries}


def level_of(file: PurePosixPath) -> str:
    """Return the level of a test file; `file` is relative to this folder. Files directly in it are `unit`.

    Raises
    ------
    KeyError
        If neither the file nor its folder has an entry in `LEVELS`.
    """
    level = "unit" if len(file.parts) == 1 else _LEVEL_OF.get(str(file)) or _LEVEL_OF.get(file.parts[0])
    if level is None:
        raise KeyError(f"tests/{file}: give its folder a level in tests/levels.py")
    return level


def is_quick(file: PurePosixPath) -> bool:
    """Return whether the tests of a file are part of a quick run."""
    return level_of(file) == "unit" and SLOW.isdisjoint([str(file), file.parts[0]])
