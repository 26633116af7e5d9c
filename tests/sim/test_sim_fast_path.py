"""Many frames at once give exactly what the same frames give one by one."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from adis_gonio.base.errors import UsageError
from adis_gonio.sim import SimulatedChip, World, WorldSettings
from sim.chip_rig import frames_apart, rd, wr

READABLE = [a for a in range(0x40) if a & ~1 != 0x3E]
# Everything that the chip can be told, the destructive things rarely: the interest is in what goes on.
WRITES = [
    *((a, d) for a in range(0x1A, 0x26) for d in (0x00, 0x55)),
    *((a, d) for a in (0x26, 0x27, 0x28, 0x29) for d in (0x10, 0x87)),
    *((a, d) for a in (0x2E, 0x2F) for d in (0x00, 0x54, 0x50, 0x25)),
    (0x2A, 7), (0x2C, 200), (0x34, 0x04), (0x34, 0x06), (0x35, 0x01), (0x35, 0x04), (0x36, 0x01),
    (0x36, 0x02), (0x36, 0x09), (0x38, 0x00), (0x38, 0x02), (0x38, 0x06), (0x39, 0x01),
    (0x39, 0x02), (0x39, 0x04),
    (0x3A, 0x01), (0x3E, 0x01), (0x3E, 0x04), (0x3E, 0x08), (0x32, 0x03), (0x33, 0x01), (0x16, 0x12),
]  # fmt: skip
DESTRUCTIVE = [(0x36, 0x0A), (0x36, 0x80), (0x3E, 0x02), (0x3E, 0x10), (0x3E, 0x80)]

reads = st.lists(st.sampled_from(READABLE), min_size=1, max_size=60).map(lambda a: [rd(x) for x in a])
sweep = st.integers(1, 40).map(lambda n: [rd(a) for a in (0x0A, 0x0C, 0x0E, 0x10)] * n)
status = st.just([rd(0x3C)])
writes = st.lists(st.sampled_from(WRITES), min_size=1, max_size=3).map(lambda w: [wr(a, d) for a, d in w])
destructive = st.sampled_from(DESTRUCTIVE).map(lambda w: [wr(*w)])
odd = st.lists(st.integers(0, 0xFFFF), min_size=1, max_size=3)
batch = st.lists(
    st.one_of(reads, sweep, sweep, status, writes, writes, st.one_of(reads, destructive, odd)),
    min_size=1,
    max_size=6,
).map(lambda parts: [word for part in parts for word in part])
timings = st.one_of(
    st.sampled_from([(1e6, 40e-6), (500e3, 45e-6), (250e3, 160e-6), (250e3, 1.3e-3), (300e3, 31e-3)]),
    st.sampled_from([(2e6, 39e-6), (16 / 31e-6, 40e-6), (16 / 32e-6, 40e-6), (3e6, 50e-6), (9e3, 2e-3)]),
    st.tuples(st.floats(1e5, 1e6), st.floats(180e-6, 3e-3)),
)
gaps = st.sampled_from([0.0, 1e-3, 0.02, 0.12, 0.3])
sessions = st.lists(st.tuples(batch, timings, gaps), min_size=1, max_size=5)
# At 4.75 and 5.25 V the noise makes a supply bit stand and fall from update to update.
supplies = st.sampled_from([5.0, 4.7501, 5.3, 4.75, 5.25])


def new_chip(seed, supply_v=5.0):
    given_ = WorldSettings(supply_v=supply_v, supply_noise_v=0.01, noise_mg=40.0)
    world = World(given_, seed=seed)
    world.stage.move_to(0.5, 90.0)
    return SimulatedChip(world, start_s=0.0)


def state_of(chip):
    memory = {
        name: chip.memory[name] for name in ("MSC_CTRL", "SMPL_PRD", "SENS_AVG", "XGYRO_OFF", "ENDURANCE")
    }
    return chip.state, chip.time_s, chip.aux_dac_v, memory


@given(session=sessions, seed=st.integers(0, 3), supply_v=supplies)
@settings(max_examples=120, deadline=None)
def test_batches_equal_single_frames_bit_for_bit(session, seed, supply_v):
    quick, slow = new_chip(seed, supply_v), new_chip(seed, supply_v)
    now = 0.2
    for words, (clock_hz, frame_s), gap in session:
        replies = frames_apart(
            quick, np.array(words, np.uint16), start_s=now, frame_s=frame_s, clock_hz=clock_hz
        )
        expected = [
            slow.frame(word, start_s=float(now + k * frame_s), clock_hz=clock_hz)
            for k, word in enumerate(words)
        ]
        assert replies.tolist() == expected
        now += len(words) * frame_s + gap + 20e-6
    assert quick.data_ready_edges(now) == slow.data_ready_edges(now)
    assert state_of(quick) == state_of(slow)


@pytest.mark.parametrize("m", [0, 2, 6])
def test_long_runs_over_many_updates_equal_single_frames(m):
    quick, slow = new_chip(5), new_chip(5)
    words = np.array([wr(0x38, m)] + [rd(a) for a in (2, 4, 6, 8, 10, 12, 14, 16, 0x36)] * 600, np.uint16)
    for frame_s in (160e-6, 1.7e-3):
        start = max(0.2, quick.time_s + 1e-3)
        replies = frames_apart(quick, words, start_s=start, frame_s=frame_s, clock_hz=250e3)
        single = [
            slow.frame(int(w), start_s=float(start + k * frame_s), clock_hz=250e3)
            for k, w in enumerate(words)
        ]
        assert replies.tolist() == single


def test_how_frames_are_grouped_changes_nothing():
    words = np.array([rd(a) for a in (0x0A, 0x0C, 0x0E, 0x04, 0x10)] * 2000, np.uint16)
    starts = 0.2 + np.arange(len(words)) * 160e-6
    whole = new_chip(7).frames_at(words, starts, clock_hz=250e3)
    for size in (3, 17, 1000):
        chip = new_chip(7)
        parts = [
            chip.frames_at(words[k : k + size], starts[k : k + size], clock_hz=250e3)
            for k in range(0, len(words), size)
        ]
        assert (np.concatenate(parts) == whole).all()


def test_an_idle_hour_is_lived_through_like_any_other():
    words = np.array([rd(0x0A)] * 10, np.uint16)
    patient, asked = new_chip(9), new_chip(9)
    for at_s in np.arange(0.3, 40.0, 0.37):
        asked.run_to(float(at_s))
    one = frames_apart(patient, words, start_s=40.0, frame_s=160e-6, clock_hz=250e3)
    other = frames_apart(asked, words, start_s=40.0, frame_s=160e-6, clock_hz=250e3)
    assert (one == other).all()


def test_an_empty_batch_is_nothing():
    chip = new_chip(1)
    assert (
        frames_apart(chip, np.empty(0, np.uint16), start_s=1.0, frame_s=1e-3, clock_hz=250e3).tolist() == []
    )


@pytest.mark.parametrize("gap_us", [5.0, 10.0, 30.0])
def test_a_frame_after_a_long_run_is_judged_by_the_run_s_last_frame(gap_us):
    """Too short a stall (5 us), too short a period (10 us after 16 us), neither (30 us)."""
    words = np.array([rd(a) for a in (0x0A, 0x36, 0x38)] * 30, np.uint16)
    quick, slow = new_chip(2), new_chip(2)
    run = frames_apart(quick, words, start_s=0.2, frame_s=60e-6, clock_hz=1e6)
    single = [slow.frame(int(w), start_s=0.2 + k * 60e-6, clock_hz=1e6) for k, w in enumerate(words)]
    assert run.tolist() == single
    at_s = 0.2 + (len(words) - 1) * 60e-6 + 16e-6 + gap_us * 1e-6
    replies = [chip.frame(rd(0x3C), start_s=at_s, clock_hz=1e6) for chip in (quick, slow)]
    assert replies[0] == replies[1] == {5.0: 0xFFFF, 10.0: 0x0001, 30.0: 0x0402}[gap_us]


def test_frames_before_the_time_of_the_chip_are_refused_in_a_batch_too():
    chip = new_chip(1)
    words = np.full(20, rd(0x0A), np.uint16)
    frames_apart(chip, words, start_s=1.0, frame_s=200e-6, clock_hz=250e3)
    with pytest.raises(UsageError, match="already simulated"):
        frames_apart(chip, words, start_s=0.9, frame_s=200e-6, clock_hz=250e3)
