"""The recording of a dwell: the samples that belong to it, and the time at which it is complete."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adis_gonio.bench.dwell_recorder import Recording, problems
from adis_gonio.bench.guards import judge_dwell
from adis_gonio.device.sensor.registers import ACCEL_OUT, TEMP_OUT
from adis_gonio.device.sensor.settings import ScanBlock, Status
from adis_gonio.record.blocks import ValueBlock
from adis_gonio.record.plans import Position


def recording(seconds: float, *, still_at: int | None = None) -> Recording:
    """Return a recording at 100 Hz in blocks of 60 samples, of which each misses two samples.

    The dwell lasts 1 s and begins 0.5 s after a still window, which ends before sample `still_at`.
    """
    made = Recording(3, Position(90.0), ("2026-05-04T10:00:00Z", 7.0), 1.0, 0.5, 0.01)
    count = round(100 * seconds)
    for begin in range(0, count, 60):
        numbers = np.arange(begin, min(begin + 60, count))
        data = np.column_stack([numbers, numbers, numbers]).astype(float)
        made.add(ValueBlock(("ax", "ay", "az"), data, 7.0 + numbers / 100, 2))
        if still_at is not None and begin + 60 >= still_at:
            made.still(still_at)
            made.try_begin()
    return made


def test_a_dwell_has_the_samples_of_its_length_from_the_end_of_settling_on():
    made = recording(3.0, still_at=100)  # the last still sample is 99, so that the dwell begins at 149
    assert made.begin == 149
    assert made.samples == 100
    assert made.scans().accel_mg[:, 0].tolist() == list(range(149, 249))
    assert (made.waited_s, made.elapsed_s) == (pytest.approx(2.99), 1.0)


@pytest.mark.parametrize(
    ("seconds", "checked", "complete"),
    [(2.49, 249, False), (2.5, 249, True), (2.5, 248, False), (2.0, 200, False)],
)
def test_a_dwell_is_complete_when_its_last_sample_was_checked_and_the_next_has_come(
    seconds, checked, complete
):
    assert recording(seconds, still_at=100).complete(checked) == complete


def test_a_dwell_waits_for_a_still_window_and_for_the_settling_after_it():
    assert not recording(5.0).begun
    assert not recording(1.49, still_at=100).begun
    made = recording(1.5, still_at=100)
    assert (made.begun, made.samples, made.elapsed_s) == (True, 1, 0.0)
    assert not made.try_begin(), "it has begun"
    made = recording(1.0, still_at=100)
    assert made.is_still
    made.moving("x varies")
    assert (made.is_still, made.why_moving, made.try_begin()) == (False, "x varies", False)


def test_samples_are_archived_before_in_and_after_the_dwell_and_lost_ones_count_once():
    blocks = recording(3.0, still_at=100).attempt("complete", 10.0).blocks
    assert [(phase, len(block), block.lost) for phase, block in blocks] == [
        ("before", 60, 2),
        ("before", 60, 2),
        ("before", 29, 0),
        ("dwell", 31, 2),
        ("dwell", 60, 2),
        ("dwell", 9, 2),
        ("after", 51, 0),
    ]
    never = recording(1.2).attempt("interrupted", 8.2, "not still")
    assert [(phase, len(block), block.lost) for phase, block in never.blocks] == [("before", 60, 2)] * 2
    assert (never.reason, never.place, never.outcome) == ("not still", 3, "interrupted")


# -- problems of a dwell ----------------------------------------------------------------------------------

EA = 0x4000
SUPPLY_STEP_V = 1.8315e-3


def scans(*supply_v: float, alarms: int = 0, lost: int = 0, dropped: int = 0) -> ScanBlock:
    """Return scans with these supplies at 10 Hz, of which the first `alarms` have the flag EA."""
    words = np.zeros((len(supply_v), 4), np.uint16)
    words[:, 3] = np.rint(np.array(supply_v) / SUPPLY_STEP_V)
    words[:alarms] |= EA
    names = ("XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")
    return ScanBlock(names, words, np.arange(len(words)) / 10, lost, dropped=dropped)


def test_a_good_dwell_has_no_problems():
    assert problems(0, scans(5.0, 4.76, 5.24), Status(0)) == []
    assert problems(0, scans(5.0), None) == []


@pytest.mark.parametrize("wrong_v", [4.74, 5.26])
def test_a_supply_out_of_range_in_one_scan_is_told_with_its_limits(wrong_v):
    (found,) = problems(3, scans(5.0, wrong_v, 5.0), None)
    assert (found.kind, found.place) == ("supply", 3)
    assert f"between {min(5.0, wrong_v):.2f}" in found.message
    assert found.message.endswith("the part needs 4.75 to 5.25 V")


@pytest.mark.parametrize(("wrong_c", "limit"), [(130.0, "85"), (-45.0, "−40")])
@pytest.mark.parametrize("name", TEMP_OUT)
def test_a_temperature_out_of_range_on_one_die_is_told_and_asked_about_once(name, wrong_c, limit):
    names = (*ACCEL_OUT, *TEMP_OUT)
    words = np.zeros((20, 6), np.uint16)  # 25 °C
    words[10:, names.index(name)] = round((wrong_c - 25) / 0.1453) & 0x0FFF
    block = ScanBlock(names, words, np.arange(20) / 10)
    (found,) = problems(3, block, None)
    assert (found.kind, found.place) == ("temperature", 3)
    assert name in found.message
    assert limit in found.message
    (guard,) = judge_dwell(block, [found])
    assert (guard.kind, guard.message) == ("temperature", found.message)
    words[:, 3:] = round((84.0 - 25) / 0.1453)
    assert problems(3, replace(block, words=words), None) == []


@pytest.mark.parametrize(
    ("lost", "dropped", "told"),
    [(1, 0, ["1 scan (20 %) lost"]), (0, 6, ["6 scans (60 %) left out"]), (4, 4, ["4 scans", "4 scans"])],
)
def test_lost_scans_are_told_as_a_share_of_all(lost, dropped, told):
    found = problems(1, scans(*[5.0] * 4, lost=lost, dropped=dropped), None)
    assert len(found) == len(told)
    assert all(words in problem.message for words, problem in zip(told, found, strict=True))


def test_an_alarm_that_status_does_not_explain_has_passed_and_the_guard_counts_its_scans():
    block = scans(*[5.0] * 5, alarms=2)
    (passed,) = problems(1, block, Status(0))
    assert passed.kind == "alarm"
    assert "it has passed" in passed.message
    status, stands = problems(1, block, Status(0x0010))
    assert (status.kind, stands.kind) == ("status", "alarm")
    assert "it has passed" not in stands.message
    (guard,) = judge_dwell(block, [passed])
    assert (guard.kind, guard.values) == ("over_range", {"scans": 2.0})
