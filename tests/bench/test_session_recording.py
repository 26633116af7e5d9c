from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.bench.dwell_recorder import Recording
from adis_gonio.device.sensor.registers import ACCEL_OUT
from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.record.plans import Position

PERIOD = 0.01


def blocks(count: int, length: int, lost: dict[int, int] | None = None) -> list[ScanBlock]:
    """Scans whose words are their own number, at times number * PERIOD."""
    numbers = np.arange(count * length).reshape(count, length)
    return [
        ScanBlock(
            ACCEL_OUT,
            np.repeat(row.astype(np.uint16)[:, None], 3, axis=1),
            row * PERIOD,
            (lost or {}).get(k, 0),
        )
        for k, row in enumerate(numbers)
    ]


def recording(dwell_s: float = 1.0, settle_s: float = 0.5) -> Recording:
    return Recording(0, Position(0.0), ("2026-01-01T00:00:00+00:00", 0.0), dwell_s, settle_s, PERIOD)


def test_the_dwell_begins_one_settling_after_the_first_still_window():
    made = recording()
    made.add(blocks(1, 100)[0])
    made.still(30)  # samples 0 to 29, the last one at 0.29 s
    assert made.try_begin()
    assert made.begin == 79
    assert not made.try_begin()


def test_motion_before_the_dwell_starts_the_wait_anew():
    made = recording()
    parts = blocks(3, 50)
    made.add(parts[0])
    made.still(30)
    assert not made.try_begin()
    made.moving("knock")
    made.add(parts[1])
    assert not made.try_begin()
    made.still(90)
    assert made.is_still
    assert not made.try_begin()
    made.add(parts[2])
    assert made.try_begin()
    assert made.begin == 139


def test_a_dwell_has_the_samples_of_its_length_and_all_others_are_kept():
    for length in (7, 33, 400):
        made = recording()
        parts = blocks(400 // length + 1, length)
        for part in parts:
            made.add(part)
            if made.samples == 0:
                made.still(7)
                made.try_begin()
        assert made.complete(10**6)
        assert made.begin is not None
        dwell = made.scans()
        assert len(dwell) == 100
        assert dwell.words[0, 0] == made.begin
        attempt = made.attempt("complete", 9.0)
        kept = np.concatenate([block.words[:, 0] for _, block in attempt.blocks])
        assert np.array_equal(kept, np.concatenate([part.words[:, 0] for part in parts]))
        assert [phase for phase, _ in attempt.blocks] == sorted(
            [phase for phase, _ in attempt.blocks], key=["before", "dwell", "after"].index
        )


def test_a_dwell_is_complete_only_once_the_watch_has_seen_its_end():
    made = recording()
    made.add(blocks(1, 300)[0])
    made.still(10)
    made.try_begin()
    stop = (made.begin or 0) + 100
    assert not made.complete(stop - 1)
    assert made.complete(stop)


def test_scans_lost_within_the_dwell_are_counted_and_others_are_not():
    made = recording()
    for part in blocks(20, 20, {0: 5, 6: 2, 19: 9}):
        made.add(part)
    made.still(10)
    made.try_begin()
    assert made.scans().lost == 2
    assert sum(block.lost for _, block in made.attempt("complete", 1.0).blocks) == 16


@pytest.mark.parametrize("length", [1, 7, 20, 33])
def test_a_recording_waits_as_long_as_its_blocks_last(length):
    made = recording()
    parts = blocks(400 // length, length)
    for part in parts:
        made.add(part)
        made.add(ScanBlock(ACCEL_OUT, np.empty((0, 3), np.uint16), np.empty(0)))
        assert made.waited_s == part.time_s[-1] - parts[0].time_s[0]


def test_empty_blocks_do_no_harm():
    made = recording()
    empty = ScanBlock(ACCEL_OUT, np.empty((0, 3), np.uint16), np.empty(0))
    made.add(empty)
    assert made.waited_s == 0.0
    assert not made.try_begin()
    for part in blocks(4, 100):
        made.add(part)
        made.add(empty)
    made.still(10)
    assert made.try_begin()
    assert len(made.scans()) == 100
