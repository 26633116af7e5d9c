"""Remarks on offsets written after a recording, and the state of a sensor by its journal."""

from __future__ import annotations

import pytest

from adis_gonio.record.write_journal import (
    INTERRUPTED,
    describe_writes,
    flash_untouched,
    held_offsets,
    operations,
)

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


SAVING = SAVED[:4]
NULLED = ("saving", "saved", "done")


def in_journal(*writes, after: int = 11):
    """Operations as `journal` has them; ENDURANCE is 10 before a save and `after` behind it."""
    counts = {"saving": {"endurance": 10}, "saved": {"endurance_after": after}}
    return operations(record | counts.get(str(record["step"]), {}) for record in journal(*writes))


@pytest.mark.parametrize(
    ("writes", "now", "endurance", "registers", "saved", "says"),
    [
        ([], 5, 10, "untouched", None, "this session has not written XACCL_OFF"),
        ([("write", SAVED, 5, 9)], 9, 11, "new", True, "saved to flash"),
        ([("write", UNSAVED, 5, 9)], 9, 10, "new", False, "lost with the power"),
        ([("write", UNSAVED, 5, 9)], 5, 10, "old", None, "the power was off since"),
        # The program ended while the flash was written: only ENDURANCE tells if it still was.
        ([("write", SAVING, 5, 9)], 9, 10, "new", False, "broke off after 'saving'"),
        (
            [("write", SAVING, 5, 9)],
            9,
            11,
            "new",
            True,
            "saved to flash; the write broke off after 'saving'",
        ),
        ([("write", SAVING, 5, 9)], 5, 11, "old", None, "is not known"),
        (
            [("write", SAVED, 5, 9)],
            9,
            12,
            "new",
            None,
            "ENDURANCE is 12 and was 11 after the save: written",
        ),
        ([("write", SAVED, 5, 9)], 9, 3, "new", None, "another part"),
        ([("write", SAVED, 5, 9), ("undo", UNSAVED, 5, 9)], 5, 11, "old", False, "the others are in flash"),
        ([("write", SAVED, 5, 9), ("write", UNSAVED, 9, 12)], 9, 11, "old", True, "saved to flash"),
        ([("write", UNSAVED, 5, 9)], 7, 10, "other", False, "neither the old nor the new"),
        (
            [("write", UNSAVED[:1], -1, 256)],
            -256,
            10,
            "half",
            False,
            "XACCL_OFF half",
        ),  # 0FFF to 0100, by 0F00
        ([("write", UNSAVED[:1], -1, 256)], 256, 10, "new", False, "broke off after 'planned'"),
        ([("autonull", NULLED, 5, 9)], 9, 11, "new", True, "saved to flash"),
        ([("autonull", NULLED, 5, 9)], 7, 11, "other", False, "neither the old nor the new"),
        ([("autonull", ("saving",), 5, 5)], 9, 11, "new", True, "saved to flash"),
        ([("autonull", ("saving",), 5, 5)], 5, 10, "old", None, "broke off after 'saving'"),
    ],
)
def test_journal_registers_and_endurance_determine_the_state(
    writes, now, endurance, registers, saved, says
):
    state = held_offsets(in_journal(*writes), {"XACCL_OFF": now}, endurance)
    assert (state.registers, state.saved) == (registers, saved)
    assert says in state.text


@pytest.mark.parametrize(
    ("now", "registers", "each"),
    [
        ((9, 8), "new", ("new", "new")),
        ((5, 0), "old", ("old", "old")),
        ((9, 0), "half", ("new", "old")),
        ((5, 8), "half", ("old", "new")),
        ((9, 1), "other", ("new", "other")),
    ],
)
def test_each_register_has_a_state_and_all_together_one(now, registers, each):
    written = {"number": 1, "op": "write", "step": "planned", "save": False}
    names = ("XACCL_OFF", "YACCL_OFF")
    old, new, now = (dict(zip(names, numbers, strict=True)) for numbers in ((5, 0), (9, 8), now))
    state = held_offsets(operations([written | {"old": old, "new": new, "found": old}]), now, 10)
    assert (state.registers, tuple(state.axes.values())) == (registers, each)
    told = [f"{name} {one}" for name, one in zip(names, each, strict=True)]
    assert all(text in state.text for text in told) is (registers in ("half", "other"))


def test_a_save_of_the_gyros_also_saves_the_accelerometers():
    (own,) = in_journal(("write", UNSAVED, 5, 9))
    for beside, saved in ({"XACCL_OFF": 9}, True), ({"XACCL_OFF": 5}, False), ({}, None):
        other = {
            "number": 2,
            "op": "write",
            "save": True,
            "old": {"XGYRO_OFF": 0},
            "found": {"XGYRO_OFF": 0},
        }
        gyros = operations(
            other | {"step": step, "new": {"XGYRO_OFF": 3}, "beside": beside, "endurance_after": 11}
            for step in SAVED
        )
        assert held_offsets([own], {"XACCL_OFF": 9}, 11, gyros).saved is saved
        assert flash_untouched([own], {"XACCL_OFF": 9}, 11, gyros) is (beside == {"XACCL_OFF": 5})


@pytest.mark.parametrize(
    ("writes", "endurance", "untouched"),
    [
        ([], 10, True),
        ([("write", UNSAVED, 5, 9)], 10, True),
        ([("write", SAVED, 5, 9)], 11, False),
        ([("write", SAVING, 5, 9)], 11, False),
        ([("write", SAVED, 5, 9), ("undo", SAVED, 5, 9)], 11, True),
    ],
)
def test_the_flash_is_untouched_until_a_save_and_after_a_saved_undo(writes, endurance, untouched):
    assert flash_untouched(in_journal(*writes), {"XACCL_OFF": 9}, endurance) is untouched
