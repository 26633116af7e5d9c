"""Differential test: the frame-level simulator against the line-level chip, on random frame sequences.

`scripts/differential_chip.py` does the same with a million sequences.
"""

from __future__ import annotations

import pytest

from rig_simavr.differential import OPTIONS, Life, run_lives

SEQUENCES = 50
LIVES = 100


@pytest.mark.parametrize("block", range(4))
def test_both_chips_answer_alike_in_every_bit_that_the_sheet_settles(rig_libraries, block):
    seeds = range(block * LIVES, (block + 1) * LIVES)
    tally = run_lives(rig_libraries / "libchip.so", seeds, SEQUENCES, **OPTIONS)
    assert [str(difference) for difference in tally.differences] == []
    assert tally.sequences > 0.98 * LIVES * SEQUENCES
    assert tally.bits > 10 * tally.frames


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("accl_off_lsb_mg", 2.522),
        ("ea_at_update", 1),
        ("flash_ms", 101),
        ("latch_next", 1),
        ("offset_after_filter", 0),
        ("short_frame_status", 0),
        ("stall_locks", 0),
        ("unused_bits_stick", 1),
        ("wake_ms", 3.1),
    ],
)
def test_a_chip_that_is_another_in_one_point_is_told_apart(rig_libraries, name, value):
    for seed in range(40):
        life = Life(rig_libraries / "libchip.so", seed, **OPTIONS, choices={name: value})
        try:
            if life.run(SEQUENCES).differences:
                return
        finally:
            life.close()
    pytest.fail(f"{name} = {value} makes no difference")
