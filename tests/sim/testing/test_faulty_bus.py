"""Faults of frames: none by default, by seed else, at the rates that were asked for."""

import numpy as np
import pytest

from adis_gonio.base.errors import BusTimeoutError, ProtocolError, UsageError
from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.testing import BusContract, Faults, FaultyBus, Rig, WatchedChip

SEED = 11
PRODUCT = np.full(20_000, 0x3800, np.uint16)


class TestFaultyBusWithoutFaults(BusContract):
    """It is a bus like any other, and passes on what it has."""

    def make(self) -> Rig:
        world = World(seed=SEED)
        chip = WatchedChip(world, start_s=-0.5)
        bus = FaultyBus(SimBus(world=world, chip=chip))

        def busy():
            bus.faults = Faults(busy=1.0)
            inner = bus._exchange

            def once(frames):
                try:
                    return inner(frames)
                finally:
                    bus.faults = Faults()

            bus._exchange = once

        twin = SimulatedChip(World(seed=SEED), start_s=-0.5)
        return Rig(bus, chip, twin, {"busy": (busy, ProtocolError)})


class Echo(SimBus):
    """Answers each frame with itself, so that every change is a fault's."""

    def _exchange(self, frames):
        super()._exchange(frames)
        return frames.copy()


def spoilt(faults: Faults, frames=PRODUCT, batch=None):
    bus = FaultyBus(Echo(World()), faults)
    parts = np.split(frames, range(batch, len(frames), batch)) if batch else [frames]
    return bus, np.concatenate([bus.exchange_array(part) for part in parts])


def test_one_bit_turns_in_a_reply_at_its_rate():
    bus, words = spoilt(Faults(seed=3, flip=0.016))
    turned = np.unpackbits((words ^ PRODUCT).view(np.uint8)).reshape(-1, 16).sum(axis=1)
    assert set(turned.tolist()) == {0, 1}
    assert turned.sum() == bus.faults.seen["flip"]
    assert abs(turned.mean() - 0.016) < 5 * np.sqrt(0.016 / len(PRODUCT))
    places = np.log2((words ^ PRODUCT)[turned == 1])
    assert set(places.tolist()) == set(range(16))


def test_the_same_seed_gives_the_same_faults_and_another_seed_others():
    first, again, other = (
        spoilt(Faults(seed=seed, flip=0.016, drop=0.01, duplicate=0.01))[1] for seed in (1, 1, 2)
    )
    assert (first == again).all()
    assert (first != other).any()


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_faults_hit_the_same_frames_however_they_are_grouped(batch):
    rates = {"flip": 0.016, "drop": 0.01, "duplicate": 0.01}
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 0x4000, 2000).astype(np.uint16)
    whole, parts = spoilt(Faults(seed=1, **rates), frames), spoilt(Faults(seed=1, **rates), frames, batch)
    assert (whole[1] == parts[1]).all()


def test_a_lost_frame_never_reaches_the_chip_and_reads_as_the_idle_word():
    chip = WatchedChip(World(seed=1), start_s=-0.5)
    bus = FaultyBus(SimBus(world=World(seed=1), chip=chip), Faults(seed=2, drop=0.05))
    replies = bus.exchange_array(PRODUCT[:4000])
    lost = bus.faults.seen["drop"]
    assert len(chip.seen) == 4000 - lost
    assert (replies == 0xFFFF).sum() == lost
    assert 100 < lost < 300


def test_a_repeated_reply_takes_the_place_of_the_next():
    frames = np.arange(1000, dtype=np.uint16)
    bus, words = spoilt(Faults(seed=4, duplicate=0.01), frames)
    wrong = np.flatnonzero(words != frames)
    assert len(wrong) == bus.faults.seen["duplicate"] > 1
    assert (words[wrong] == frames[wrong] - 1).all()


@pytest.mark.parametrize(("kind", "error"), [("busy", ProtocolError), ("hang", BusTimeoutError)])
def test_a_batch_fails_with_its_typed_error_and_the_bus_stays_usable(kind, error):
    bus = FaultyBus(SimBus(World(seed=1)), Faults(**{kind: 1.0}))
    with pytest.raises(error, match="by seed"):
        bus.exchange([0x3800, 0])
    bus.faults = Faults()
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_scans_that_a_stream_loses_are_counted():
    bus = FaultyBus(SimBus(World(seed=1)))
    bus.exchange([0xB404])
    bus.faults = Faults(seed=5, drop=0.02)
    with bus.stream([0x0A00, 0x0C00], block_scans=500) as stream:
        blocks = [next(stream) for _ in range(4)]
    missing = 2000 - sum(len(block.words) for block in blocks)
    assert missing == sum(block.lost for block in blocks)
    assert 40 < missing < 130


@pytest.mark.parametrize(
    ("rates", "says"),
    [
        ({"flip": 2}, "flip is 2: take a probability from 0 to 1"),
        ({"busy": float("nan")}, "busy is nan"),
    ],
)
def test_what_is_no_rate_is_refused(rates, says):
    with pytest.raises(UsageError, match=says):
        Faults(**rates)
