"""Faults of frames: none by default, by seed else, at the rates that were asked for."""

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError, ProtocolError, UsageError
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.testing import BusContract, BusFaults, FaultyBus, Rig, WatchedChip

SEED = 11
PRODUCT = np.full(20_000, 0x3800, np.uint16)


class TestFaultyBusWithoutFaults(BusContract):
    """It is a bus like any other, and passes on what it has."""

    def make(self) -> Rig:
        world = World(seed=SEED)
        chip = WatchedChip(world, start_s=-0.5)
        bus = FaultyBus(SimBus(world=world, chip=chip))

        def busy():
            bus.faults = BusFaults(busy=1.0)
            inner = bus._exchange

            def once(frames):
                try:
                    return inner(frames)
                finally:
                    bus.faults = BusFaults()

            bus._exchange = once

        twin = SimulatedChip(World(seed=SEED), start_s=-0.5)
        return Rig(bus, chip, twin, {"busy": (busy, ProtocolError)})


class Echo(SimBus):
    """Answers each frame with itself, so that every change is a fault's."""

    def _exchange(self, frames):
        super()._exchange(frames)
        return frames.copy()


def spoilt(faults: BusFaults, frames=PRODUCT, batch=None):
    bus = FaultyBus(Echo(World()), faults)
    parts = np.split(frames, range(batch, len(frames), batch)) if batch else [frames]
    return bus, np.concatenate([bus.exchange_array(part) for part in parts])


def turned_bits(words) -> int:
    return int(np.unpackbits((words ^ PRODUCT[: len(words)]).view(np.uint8)).sum())


def test_bits_turn_at_their_rate():
    bus, words = spoilt(BusFaults(seed=3, bit_errors=1e-3))
    bits = 16 * len(PRODUCT)
    assert turned_bits(words) == bus.seen["bit_errors"]
    assert abs(turned_bits(words) / bits - 1e-3) < 5 * np.sqrt(1e-3 / bits)


def test_the_same_seed_gives_the_same_faults_and_another_seed_others():
    first, again, other = (
        spoilt(BusFaults(seed=seed, bit_errors=1e-3, lost_frames=0.01, stuck_words=0.01))[1]
        for seed in (1, 1, 2)
    )
    assert (first == again).all()
    assert (first != other).any()


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_faults_hit_the_same_frames_however_they_are_grouped(batch):
    faults = BusFaults(seed=1, bit_errors=1e-3, lost_frames=0.01, stuck_words=0.01, stuck_frames=3)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 0x4000, 2000).astype(np.uint16)
    assert (spoilt(faults, frames)[1] == spoilt(faults, frames, batch)[1]).all()


def test_one_kind_leaves_the_dice_of_another_alone():
    bits = BusFaults(seed=1, bit_errors=1e-3)
    both = BusFaults(seed=1, bit_errors=1e-3, lost_frames=0.01, idle_word=0x3800)
    assert (spoilt(bits)[1] == spoilt(both)[1]).all()


def test_a_lost_frame_never_reaches_the_chip_and_reads_as_the_idle_word():
    chip = WatchedChip(World(seed=1), start_s=-0.5)
    bus = FaultyBus(SimBus(world=World(seed=1), chip=chip), BusFaults(seed=2, lost_frames=0.05))
    replies = bus.exchange_array(PRODUCT[:4000])
    lost = bus.seen["lost_frames"]
    assert len(chip.seen) == 4000 - lost
    assert (replies == 0xFFFF).sum() == lost
    assert 100 < lost < 300


def test_a_stuck_reply_comes_again_so_many_times():
    frames = np.arange(1000, dtype=np.uint16)
    bus, words = spoilt(BusFaults(seed=4, stuck_words=0.01, stuck_frames=3), frames)
    wrong = np.flatnonzero(words != frames)
    assert bus.seen["stuck_words"] >= len(wrong) / 3 > 1
    first = wrong[0]
    assert (words[first : first + 3] == first - 1).all()
    assert words[first + 3] == first + 3


@pytest.mark.parametrize(("kind", "error"), [("busy", ProtocolError), ("silent", BusTimeoutError)])
def test_a_batch_fails_with_its_typed_error_and_the_bus_stays_usable(kind, error):
    bus = FaultyBus(SimBus(World(seed=1)), BusFaults(**{kind: 1.0}))
    with pytest.raises(error, match="by seed"):
        bus.exchange([0x3800, 0])
    bus.faults = BusFaults()
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_scans_that_a_stream_loses_are_counted():
    bus = FaultyBus(SimBus(World(seed=1)), BusFaults(seed=5, lost_frames=0.02))
    bus.exchange([0xB404])
    bus.faults = BusFaults(seed=5, lost_frames=0.02)
    bus.seen.clear()
    with bus.stream([0x0A00, 0x0C00], block_scans=500) as stream:
        blocks = [next(stream) for _ in range(4)]
    missing = 2000 - sum(len(block.words) for block in blocks)
    assert missing == sum(block.lost for block in blocks)
    assert 40 < missing < 130


@pytest.mark.parametrize(
    ("rates", "says"),
    [
        ({"bit_errors": 2}, "bit_errors is 2: take a probability from 0 to 1"),
        ({"busy": float("nan")}, "busy is nan"),
        ({"stuck_frames": 0}, "stuck_frames is 0: take 1 or more"),
        ({"idle_word": 70000}, "idle_word is 70000"),
    ],
)
def test_what_is_no_rate_is_refused(rates, says):
    with pytest.raises(UsageError, match=says):
        BusFaults(**rates)
