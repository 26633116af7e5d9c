"""The promises of every bus as a class of pytest tests: subclass `BusContract` and give it a `Rig`.

A package that adds a bus needs only a class `TestMyBus(BusContract)` with a method `make`. The text of
`adis_gonio.device.bus.contract` describes the contract; the name of a failing test repeats the sentence of
this text that the bus breaks.

The rig connects the bus under test to a simulated chip that records all frames on its pins, so that replies
and timing are judged by the wire and not by the reports of the bus.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import BusClosedError, BusError, CapabilityError, UsageError
from adis_gonio.device.bus import Capability, SpiBus, SpiTiming, Words
from adis_gonio.sim.chip import SimulatedChip

TIMINGS = (
    SpiTiming(250e3, 75.0, 160.0),
    SpiTiming(1e6, 9.0, 40.0),
    SpiTiming(100e3, 20.0, 0.0),
    SpiTiming(300e3, 100.0, 500.0),
    SpiTiming(16 / 31e-6, 9.0, 40.0),
)
OUTPUTS = (0x02, 0x04, 0x06, 0x08, 0x0A, 0x0C, 0x0E, 0x10, 0x12, 0x14, 0x16)
DATA_READY_ON = 0xB404
SLACK_S = 2e-9


@dataclass(frozen=True)
class WireFrame:
    """A frame as recorded at the chip's pins: word, start, SPI clock, reply, hold time of chip select.

    The hold time is from the last clock to the rise of chip select.
    """

    word: int
    start_s: float
    clock_hz: float
    reply: int
    cs_hold_s: float

    @property
    def rise_s(self) -> float:
        """Time in s at which chip select rises and the frame ends."""
        return self.start_s + 16 / self.clock_hz + self.cs_hold_s


class WatchedChip(SimulatedChip):
    """A simulated chip that records every frame as a `WireFrame` in the list `seen`."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.seen: list[WireFrame] = []
        super().__init__(*args, **options)

    def frame(
        self, word: int, *, start_s: float, clock_hz: float, bits: int = 16, cs_hold_s: float = 0.0
    ) -> int:
        """Take a frame, record it in `seen`, and return the word that the chip shifts out.

        It takes the arguments of `SimulatedChip.frame`.
        """
        reply = super().frame(word, start_s=start_s, clock_hz=clock_hz, bits=bits, cs_hold_s=cs_hold_s)
        self.seen.append(WireFrame(word, start_s, clock_hz, reply, cs_hold_s))
        return reply

    def frames_at(self, words: Words, starts_s: Floats, *, clock_hz: float) -> Words:
        """Take frames at increasing times (n,) in s one by one; return the replies.

        Each frame is recorded in `seen`. `clock_hz` is the SPI clock.
        """
        return np.array(
            [
                self.frame(int(word), start_s=float(start), clock_hz=clock_hz)
                for word, start in zip(words, starts_s, strict=True)
            ],
            np.uint16,
        )


@dataclass
class Rig:
    """A bus under test with the simulated chip at its pins.

    Attributes
    ----------
    bus : SpiBus
        Bus under test, freshly opened.
    chip : WatchedChip
        Simulated chip at the pins of the bus.
    twin : SimulatedChip
        An identical chip without a bus; its replies are the reference.
    faults : mapping of str to (callable, error)
        Functions that make the next exchange fail, each with the expected error, by name.
    slowest_hz : float
        Slowest clock of the bridge, below which a timing is refused; 0 for no limit.
    """

    bus: SpiBus
    chip: WatchedChip
    twin: SimulatedChip
    faults: Mapping[str, tuple[Callable[[], None], type[BusError]]] = field(default_factory=dict)
    slowest_hz: float = 0.0


class BusContract(ABC):
    """Tests of the bus contract; a subclass has a name that begins with `Test` and implements `make`.

    A test of a capability that the bus lacks passes without a check; another test proves that the bus
    refuses this capability by name. The test of a clock limit passes without a check if the rig has no
    limit.
    """

    @abstractmethod
    def make(self) -> Rig:
        """Return a new bus with its chips for one test; the fixture `rig` closes the bus."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        """Fixture: the bus and chips of one test; the bus is closed after the test."""
        rig = self.make()
        yield rig
        rig.bus.close()

    # -- frames ------------------------------------------------------------------------------------

    @pytest.mark.parametrize("seed", range(4))
    def test_replies_are_those_that_the_chip_gives_frame_by_frame(self, rig: Rig, seed: int) -> None:
        rng = np.random.default_rng(seed)
        for batch in random_batches(rng, 12):
            sent = len(rig.chip.seen)
            replies = rig.bus.exchange(batch)
            wire = rig.chip.seen[sent:]
            assert [frame.word for frame in wire] == batch
            expected = [
                rig.twin.frame(
                    one.word, start_s=one.start_s, clock_hz=one.clock_hz, cs_hold_s=one.cs_hold_s
                )
                for one in wire
            ]
            assert replies == expected
            assert all(type(reply) is int for reply in replies)

    def test_arrays_and_lists_give_the_same(self, rig: Rig) -> None:
        words = [address << 8 for address in OUTPUTS] * 3
        replies = rig.bus.exchange_array(np.array(words, np.uint16))
        assert replies.dtype == np.uint16
        assert replies.shape == (33,)
        assert replies.tolist() == [f.reply for f in rig.chip.seen[-33:]]

    def test_an_empty_batch_sends_nothing(self, rig: Rig) -> None:
        before = len(rig.chip.seen)
        assert rig.bus.exchange([]) == []
        assert len(rig.chip.seen) == before

    @pytest.mark.parametrize(
        "batch",
        [[0x4000], [0, 0, 0x7FFF], [0xFFFF], [0, 0xC000], [0x10000], [-1], [0, 1.0], [True], ["0"]],
    )
    def test_bit_14_and_what_is_no_frame_is_refused_and_nothing_is_sent(
        self, rig: Rig, batch: list[Any]
    ) -> None:
        before = len(rig.chip.seen)
        with pytest.raises(UsageError):
            rig.bus.exchange(batch)
        assert len(rig.chip.seen) == before
        assert rig.bus.exchange([0x3800, 0])[1] == 0x0402

    def test_arrays_of_another_kind_are_refused(self, rig: Rig) -> None:
        before = len(rig.chip.seen)
        two_dimensional, bit_14 = np.zeros((2, 2), np.uint16), np.full(3, 0x4000, np.uint16)
        wrongs: list[Any] = [np.zeros(3, np.int64), two_dimensional, bit_14]
        for wrong in wrongs:
            with pytest.raises(UsageError):
                rig.bus.exchange_array(wrong)
        assert len(rig.chip.seen) == before

    # -- timing ------------------------------------------------------------------------------------

    @pytest.mark.parametrize("timing", TIMINGS)
    def test_timing_is_kept_within_and_across_batches(self, rig: Rig, timing: SpiTiming) -> None:
        if timing.clock_hz < rig.slowest_hz:
            return  # refused: the test below
        rig.bus.configure(timing)
        sent = len(rig.chip.seen)
        for size in (1, 5, 2, 40, 1):
            rig.bus.exchange([0] * size)
        assert_timing(rig.chip.seen[sent:], timing)

    @pytest.mark.parametrize("slow", [SpiTiming(200e3, 300.0, 1000.0), SpiTiming(200e3, 900.0, 0.0)])
    def test_a_new_timing_holds_from_the_last_frame_on(self, rig: Rig, slow: SpiTiming) -> None:
        rig.bus.configure(TIMINGS[1])
        rig.bus.exchange([0] * 3)
        sent = len(rig.chip.seen)
        rig.bus.configure(slow)
        rig.bus.exchange([0] * 3)
        assert_timing(rig.chip.seen[sent - 1 :], slow, clock_from=1)

    @pytest.mark.parametrize("timing", TIMINGS)
    def test_configure_never_answers_with_a_faster_timing(self, rig: Rig, timing: SpiTiming) -> None:
        if timing.clock_hz < rig.slowest_hz:
            return
        kept = rig.bus.configure(timing)
        assert kept.clock_hz <= timing.clock_hz
        assert kept.stall_us >= timing.stall_us
        assert kept.period_us >= timing.period_us
        assert rig.bus.timing == kept

    def test_a_clock_below_the_bridges_slowest_is_refused_and_the_old_timing_stays(self, rig: Rig) -> None:
        if not rig.slowest_hz:
            return
        before, sent = rig.bus.timing, len(rig.chip.seen)
        words = rf"slowest clock is {rig.slowest_hz:g} Hz, not {rig.slowest_hz - 1:g}"
        with pytest.raises(UsageError, match=words):
            rig.bus.configure(SpiTiming(rig.slowest_hz - 1, 9.0, 40.0))
        assert rig.bus.timing == before
        assert len(rig.chip.seen) == sent
        rig.bus.exchange([0] * 3)
        assert_timing(rig.chip.seen[sent:], before)
        assert rig.bus.configure(SpiTiming(rig.slowest_hz, 9.0, 40.0)).clock_hz == rig.slowest_hz

    def test_an_impossible_timing_cannot_be_made_and_leaves_the_old_one(self, rig: Rig) -> None:
        before = rig.bus.timing
        for wrong in ((0.0, 9.0, 40.0), (1e6, -1.0, 40.0), (1e6, 9.0, -1.0), (float("nan"), 9.0, 40.0)):
            with pytest.raises(UsageError):
                rig.bus.configure(SpiTiming(*wrong))
        assert rig.bus.timing == before

    def test_a_fresh_bus_is_slow_enough_for_both_modes(self, rig: Rig) -> None:
        timing = rig.bus.timing
        assert 10e3 <= timing.clock_hz <= 300e3
        assert timing.stall_us >= 75.0
        assert timing.period_us >= 160.0

    def test_time_runs_forward_and_sleep_takes_it(self, rig: Rig) -> None:
        bus = rig.bus
        before = bus.now_s()
        bus.exchange([0] * 10)
        after = bus.now_s()
        assert after - before >= 9 * bus.timing.period_us * 1e-6
        bus.sleep_s(0.01)
        assert bus.now_s() - after >= 0.01 - SLACK_S
        bus.sleep_s(0.0)

    # -- errors, threads, closing ---------------------------------------------------------------------

    def test_a_failed_exchange_raises_its_typed_error_and_leaves_the_bus_usable(self, rig: Rig) -> None:
        for name, (arm, expected) in rig.faults.items():
            arm()
            with pytest.raises(expected):
                rig.bus.exchange([0x3800, 0])
            assert rig.bus.exchange([0x3800, 0])[1] == 0x0402, name

    def test_batches_of_two_threads_do_not_interleave(self, rig: Rig) -> None:
        mark = {name: address << 8 for name, address in (("a", 0x1A), ("b", 0x20), ("c", 0x36))}
        failures: list[Exception] = []

        def work(word: int) -> None:
            try:
                for size in range(1, 25):
                    rig.bus.exchange([word] * size)
            except Exception as error:
                failures.append(error)

        threads = [threading.Thread(target=work, args=(word,)) for word in mark.values()]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(30)
        assert not failures
        words = [frame.word for frame in rig.chip.seen]
        left = {word: list(range(1, 25)) for word in mark.values()}
        at = 0
        while at < len(words):
            size = left[words[at]].pop(0)
            assert words[at : at + size] == [words[at]] * size
            at += size
        assert not any(left.values())
        assert_timing(rig.chip.seen, rig.bus.timing)

    def test_closing_twice_is_allowed(self, rig: Rig) -> None:
        assert not rig.bus.closed
        rig.bus.close()
        rig.bus.close()
        assert rig.bus.closed

    def test_any_use_after_closing_raises(self, rig: Rig) -> None:
        bus = rig.bus
        bus.close()
        sent = len(rig.chip.seen)
        uses: list[Callable[[], object]] = [
            lambda: bus.exchange([0]),
            lambda: bus.exchange([]),
            lambda: bus.exchange_array(np.zeros(2, np.uint16)),
            lambda: bus.configure(TIMINGS[0]),
        ]
        optional = optional_calls(bus)
        for use in [*uses, *(optional[capability] for capability in bus.capabilities)]:
            with pytest.raises(BusClosedError):
                use()
        assert len(rig.chip.seen) == sent

    def test_a_with_block_closes(self, rig: Rig) -> None:
        with rig.bus as bus:
            assert bus is rig.bus
        assert rig.bus.closed

    def test_the_bus_knows_its_url(self, rig: Rig) -> None:
        assert ":" in rig.bus.url

    # -- optional capabilities --------------------------------------------------------------------------

    def test_a_capability_that_is_not_there_is_refused_by_name(self, rig: Rig) -> None:
        for capability in set(Capability) - rig.bus.capabilities:
            with pytest.raises(CapabilityError, match=capability.value):
                optional_calls(rig.bus)[capability]()

    def test_a_stream_gives_each_register_its_own_word_at_each_data_ready_edge(self, rig: Rig) -> None:
        if Capability.STREAM not in rig.bus.capabilities:
            return
        rig.bus.configure(TIMINGS[1])
        rig.bus.exchange([DATA_READY_ON])
        addresses = [0x0A, 0x36, 0x0E, 0x38]
        with rig.bus.stream([a << 8 for a in addresses], block_scans=16) as stream:
            blocks = [next(stream) for _ in range(3)]
        times = np.concatenate([block.time_s for block in blocks])
        words = np.concatenate([block.words for block in blocks])
        assert words.dtype == np.uint16
        assert words.shape == (len(times), 4)
        assert len(times) >= 3
        assert (words[:, 1] == 0x0001).all()
        assert (words[:, 3] == 0x0402).all()
        assert (words[:, [0, 2]] >> 15 == 1).all(), "at an edge every output is new"
        assert (words[:, 0] & 0x3FFF != words[:, 2] & 0x3FFF).all()
        assert np.diff(times) == pytest.approx(1 / 819.2, rel=0.2)
        assert sum(block.lost for block in blocks) == 0
        assert_timing(rig.chip.seen[1:], TIMINGS[1])

    def test_while_a_stream_runs_the_bus_belongs_to_it(self, rig: Rig) -> None:
        if Capability.STREAM not in rig.bus.capabilities:
            return
        rig.bus.exchange([DATA_READY_ON])
        stream = rig.bus.stream([0x0A00], block_scans=4)
        next(stream)
        with pytest.raises(UsageError):
            rig.bus.exchange([0])
        with pytest.raises(UsageError):
            rig.bus.stream([0x0A00])
        stream.close()
        stream.close()
        with pytest.raises(StopIteration):
            next(stream)
        assert rig.bus.exchange([0x3800, 0])[1] == 0x0402

    @pytest.mark.parametrize("frames", [[], [0xA055], [0x0A00, 0xBE80]])
    def test_a_stream_takes_reads_alone(self, rig: Rig, frames: list[int]) -> None:
        if Capability.STREAM not in rig.bus.capabilities:
            return
        rig.bus.exchange([DATA_READY_ON])
        sent = len(rig.chip.seen)
        with pytest.raises(UsageError):
            rig.bus.stream(frames)
        assert len(rig.chip.seen) == sent

    def test_a_stream_without_edges_raises_a_bus_error(self, rig: Rig) -> None:
        if Capability.STREAM not in rig.bus.capabilities:
            return
        with pytest.raises(BusError), rig.bus.stream([0x0A00]) as stream:
            next(stream)

    def test_a_hard_reset_empties_what_was_not_saved(self, rig: Rig) -> None:
        if Capability.HARD_RESET not in rig.bus.capabilities:
            return
        rig.bus.exchange([0xA055])
        assert rig.bus.exchange([0x2000, 0])[1] == 0x0055
        rig.bus.hard_reset()
        rig.bus.sleep_s(0.3)
        assert rig.bus.exchange([0x2000, 0])[1] == 0

    def test_the_event_counter_counts_edges_since_the_last_call(self, rig: Rig) -> None:
        if Capability.EVENT_COUNTER not in rig.bus.capabilities:
            return
        rig.bus.sleep_s(0.2)
        assert rig.bus.read_event_counter() == 0
        rig.bus.exchange([DATA_READY_ON])
        rig.bus.sleep_s(0.5)
        first = rig.bus.read_event_counter()
        assert first == pytest.approx(0.5 * 819.2, rel=0.05)
        rig.bus.sleep_s(0.1)
        assert rig.bus.read_event_counter() == pytest.approx(0.1 * 819.2, rel=0.05)


def optional_calls(bus: SpiBus) -> dict[Capability, Callable[[], object]]:
    """Return a call of each optional function of a bus, by the capability that it needs."""
    return {
        Capability.STREAM: lambda: bus.stream([0]),
        Capability.HARD_RESET: bus.hard_reset,
        Capability.EVENT_COUNTER: bus.read_event_counter,
    }


def random_batches(rng: np.random.Generator, count: int) -> list[list[int]]:
    """Draw `count` batches of 16-bit frames, of very different lengths: reads and harmless writes."""
    batches = []
    for _ in range(count):
        batch: list[int] = []
        for _ in range(int(rng.integers(1, 5))):
            kind = rng.integers(4)
            if kind == 0:
                address, data = int(rng.integers(0x1A, 0x26)), int(rng.integers(256))
                batch.append(0x8000 | address << 8 | data)
            elif kind == 1:
                batch.append(0x3C00)
            else:
                size = int(rng.integers(1, 60))
                batch += [int(address) << 8 for address in rng.integers(0, 0x3A, size)]
        batches.append(batch)
    return batches


def assert_timing(frames: list[WireFrame], timing: SpiTiming, clock_from: int = 0) -> None:
    """Assert that the stall and the period before each frame are not shorter than `timing` demands.

    The SPI clock is checked from frame `clock_from` on.
    """
    assert len(frames) > 1
    assert all(frame.clock_hz <= timing.clock_hz for frame in frames[clock_from:])
    for before, after in pairwise(frames):
        assert after.start_s - before.rise_s >= timing.stall_us * 1e-6 - SLACK_S
        assert after.start_s - before.start_s >= timing.period_us * 1e-6 - SLACK_S
