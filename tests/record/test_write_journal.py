"""Remarks on offsets written after a recording, by the content of the registers and of the flash."""

from __future__ import annotations

import pytest

from adis_gonio.record.write_journal import INTERRUPTED, describe_writes, operations

RECORDED = {"XACCL_OFF": 5, "XGYRO_OFF": 0}
UNSAVED = ("planned", "written", "verified", "done")
SAVED = ("planned", "written", "verified", "saving", "saved", "done")


def journal(*writes: tuple[str, tuple[str, ...], int, int]) -> list[dict[str, object]]:
    """Records of operations (op, steps, old and new number in XACCL_OFF)."""
    return [
        {"number": number, "op": op, "step": step, "save": "saved" in steps}
        | {"old": {"XACCL_OFF": old}, "new": {"XACCL_OFF": new}, "found": {"XACCL_OFF": old}}
        for number, (op, steps, old, new) in enumerate(writes, 1)
        for step in steps
    ]


@pytest.mark.parametrize(
    ("writes", "changed", "lost"),
    [
        ([("write", SAVED, 5, 9)], "5 → 9", None),
        ([("write", UNSAVED, 5, 9)], "5 → 9", 5),
        ([("write", SAVED, 5, 9), ("write", UNSAVED, 9, 12)], "5 → 12", 9),
        ([("write", SAVED, 5, 9), ("undo", SAVED, 5, 9), ("write", UNSAVED, 5, 12)], "5 → 12", 5),
        ([("write", UNSAVED, 5, 9), ("write", SAVED, 9, 12)], "5 → 12", None),
    ],
)
def test_a_remark_names_the_change_and_the_number_that_a_power_cycle_brings_back(writes, changed, lost):
    (remark,) = describe_writes(operations(journal(*writes)), RECORDED)
    assert f"XACCL_OFF {changed}" in remark
    assert "biases" in remark
    assert ("saved to flash" in remark and "power cycle" not in remark) is (lost is None)
    assert (f"brings back XACCL_OFF {lost}," in remark) is (lost is not None)


@pytest.mark.parametrize(
    "writes",
    [[], [("write", SAVED, 5, 9), ("undo", SAVED, 5, 9)], [("write", (*UNSAVED[:2], "set-back"), 5, 9)]],
)
def test_a_part_that_holds_the_recorded_numbers_gets_no_remark(writes):
    assert describe_writes(operations(journal(*writes)), RECORDED) == ()


def test_an_interrupted_write_is_the_only_remark():
    begun = journal(("write", UNSAVED, 5, 7), ("write", ("planned", "written"), 7, 9))
    assert describe_writes(operations(begun), RECORDED) == (INTERRUPTED,)
