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
        *(
            "base",
            "bench",
            "benchmark",
            "calibrate",
            "device",
            "docs",
            "examples",
            "faces",
            "fitting",
            "fleet",
        ),
        *(
            "handover",
            "house",
            "live",
            "model",
            "page",
            "plan",
            "record",
            "sim",
            "simulated_bench",
            "tracing",
        ),
        "kernel/test_urb_packets.py",
    ),
    # Rates over many drawn sessions, operators or files.
    "statistics": (
        "fitting/allan/test_allan_boundary.py",
        "bench/bringup/test_bringup_limits.py",
        "faces/cli/test_clumsy_typist.py",
        *("fitting/test_efficiency.py", "fitting/test_fit_statistics.py"),
        "fitting/test_information_bound.py",
        *("fitting/test_missing_effects.py", "fitting/test_shared_noise.py"),
        "fitting/test_wide_fixture.py",
        "results_pages",
        *("bench/test_clumsy_operators.py", "record/test_fuzzed_files.py"),
        "bench/test_session_false_alarms.py",
        "bench/test_session_faults.py",
        *("tracing/test_blind_rounds.py", "tracing/test_planted_effects.py", "tracing/test_within.py"),
        *("tracing/test_within_sensitivity.py", "tracing/test_within_sessions.py"),
        "bench/writeback/test_verification_rates.py",
    ),
    # Another program at the other end: firmware in an emulator, a compiler, a client, a terminal.
    "rig": (
        "docs/test_documentation_site.py",
        "firmware",
        "fleet/test_fleet_cluster.py",
        "handover/test_c_header.py",
        "bench/iio/test_iio_network.py",
        "rig_simavr",
        "faces/serve/test_libiio_clients.py",
        "faces/tui/test_terminal_sessions.py",
    ),
    "kernel": ("kernel",),
    "browser": ("handover/test_memory_pages_in_browser.py", "handover/test_report_in_browser.py"),
}
"""Folders of tests and, where a file differs from its folder, files."""

SLOW = frozenset(
    [
        "bench/bringup/test_bringup_boards.py",
        "bench/bringup/test_bringup_bridges.py",
        "bench/bringup/test_chip_rows.py",
        "bench/iio/test_iio_local.py",
        "bench/test_changed_registers.py",
        "bench/test_faults_below_the_driver.py",
        "bench/test_free_turn_session.py",
        "bench/test_gyro_turns_session.py",
        "bench/test_session_closing.py",
        "bench/test_session_guards.py",
        "bench/test_session_kill.py",
        "bench/writeback/test_power_cut.py",
        "bench/writeback/test_write_gyros.py",
        "bench/writeback/test_write_keeps_results.py",
        "bench/writeback/test_write_offsets.py",
        "bench/writeback/test_write_over_bridges.py",
        "benchmark/test_challenge_scores.py",
        "calibrate/test_gyros_of_sessions.py",
        "docs",
        "examples",
        "faces/cli/test_calibrate_plain.py",
        "faces/cli/test_character_sets.py",
        "faces/cli/test_closing_command.py",
        "faces/cli/test_imports_of_commands.py",
        "faces/cli/test_long_work.py",
        "faces/cli/test_simulate_command.py",
        "faces/cli/test_trace_command.py",
        "faces/serve/test_iiod_server.py",
        "faces/tui/test_arrow.py",
        "faces/tui/test_clumsy_screen.py",
        "fitting/allan/test_allan_fit.py",
        "fitting/allan/test_line_that_moves.py",
        "fitting/estimation/test_one_convention.py",
        "fitting/gyros/test_axes_of_accelerometers.py",
        "fitting/gyros/test_brisk_turns.py",
        "fitting/gyros/test_gyro_fit_and_trace.py",
        "fitting/gyros/test_links.py",
        "fitting/gyros/test_three_thermometers.py",
        "fitting/gyros/test_turns_in_csv.py",
        "fitting/gyros/test_vertical_of_a_turn.py",
        "fitting/slips",
        "fitting/test_flicker.py",
        "fitting/test_free_turn.py",
        "fitting/test_uncertainty.py",
        "fleet/test_fleet_command.py",
        "fleet/test_fleet_processes.py",
        "fleet/test_population_evidence.py",
        "fleet/test_population_trace.py",
        "handover/test_digital_twin.py",
        "handover/test_gyro_exports.py",
        "handover/test_paper_equations.py",
        "handover/test_paper_page.py",
        "handover/test_report_page.py",
        "live/test_angle_smoother.py",
        "live/test_disturbance.py",
        "live/test_linear_model.py",
        "live/test_smoothed_live_angle.py",
        "plan/test_plan_prediction.py",
        "plan/test_plan_search.py",
        "record/test_files_from_strangers.py",
        "record/test_large_files.py",
        "sim/testing/test_plugin.py",
        "sim/testing/test_simulated_board.py",
        "simulated_bench",
        "tracing/test_blind_sessions.py",
        "tracing/test_further_terms.py",
        "tracing/test_joint_trace.py",
        "tracing/test_moving_lines.py",
        "tracing/test_trace_aliases.py",
        "tracing/test_trace_engine.py",
        "tracing/test_trace_gates.py",
        "tracing/test_trace_proposals.py",
        "tracing/test_trace_real_data.py",
        "tracing/test_trace_sceptic.py",
        "tracing/test_trace_search.py",
        "tracing/test_trace_simulated.py",
        "tracing/test_trace_small_sessions.py",
        "tracing/test_trace_smooth.py",
        "tracing/test_trace_time_limit.py",
        "tracing/test_what_if.py",
    ]
)
"""Folders and files of level `unit` that take more than some seconds: a quick run leaves them out."""

_LEVEL_OF = {entry: level for level, entries in LEVELS.items() for entry in entries}


def level_of(file: PurePosixPath) -> str:
    """Return the level of a test file; `file` is relative to this folder. Files directly in it are `unit`.

    Raises
    ------
    KeyError
        If neither the file nor a folder that holds it has an entry in `LEVELS`.
    """
    for entry in (file, *file.parents[:-1]):
        if str(entry) in _LEVEL_OF:
            return _LEVEL_OF[str(entry)]
    if len(file.parts) > 1:
        raise KeyError(f"tests/{file}: give its folder a level in tests/levels.py")
    return "unit"


def is_quick(file: PurePosixPath) -> bool:
    """Return whether the tests of a file are part of a quick run."""
    return level_of(file) == "unit" and SLOW.isdisjoint(map(str, (file, *file.parents)))
