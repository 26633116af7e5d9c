"""The serial transport: protocol, retries, sessions and streams over a fake firmware; and a real pty."""

import contextlib
import errno
import random
import sys
import time

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    UsageError,
)
from adis_gonio.device.bus import BusUrl, Capability, SpiTiming, open_bus, serial as ports
from adis_gonio.device.bus.serial import ClockMap, SerialLink, find_devices, open_from_url
from adis_gonio.device.bus.wire import Packet, Receiver, encode, load_cobs, protocol as wire
from adis_gonio.device.sensor import Adis16354
from adis_gonio.device.sensor.registers import ND
from adis_gonio.device.sensor.settings import ScanBlock
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.sampling import OUTPUTS
from adis_gonio.sim.testing.bus_contract import DATA_READY_ON, BusContract, Rig, WatchedChip
from adis_gonio.sim.testing.doubles import SimulatedBoard
from adis_gonio.sim.testing.faults import Faults
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins, WorkClock
from fakes.benches import SerialBench as Bench
from fakes.boot_loader import BootingBoard, BootLoader
from fakes.numbered_scans import Judge, NumberedChip, words_of
from fakes.serial_port import FakePort
from fakes.virtual_clock import VirtualClock

FAST = SpiTiming(1e6, 9.0, 40.0)
SEVEN = [0x0400, 0x0600, 0x0800, 0x0A00, 0x0C00, 0x0E00, 0x1000]


class TestSerial(BusContract):
    def make(self) -> Rig:
        bench = Bench()
        bus = bench.open()

        twin = SimulatedChip(World(seed=Bench.seed), start_s=-0.5)
        return Rig(bus, bench.chip, twin, {"hung": (bench.silence, BusTimeoutError)}, slowest_hz=125_000)


needs_pty = pytest.mark.skipif(sys.platform == "win32", reason="a pty needs POSIX")


@needs_pty
class TestSerialOverAPty(BusContract):
    """The real pyserial on a real tty without modem lines, in real time."""

    @pytest.fixture
    def rig(self):
        clock = WorkClock()
        chip = WatchedChip(World(seed=Bench.seed), start_s=-0.5)
        with SimulatedBoard(SimulatedFirmware(ChipPins(chip, clock))) as board:
            bus = open_bus(f"serial:{board.path}")
            try:
                yield Rig(
                    bus, chip, SimulatedChip(World(seed=Bench.seed), start_s=-0.5), slowest_hz=125_000
                )
            finally:
                bus.close()

    def make(self) -> Rig:
        raise NotImplementedError

    def test_the_event_counter_counts_edges_since_the_last_call(self, rig):
        """As in the contract, but a loaded machine may sleep longer than it was asked to."""
        bus = rig.bus
        assert bus.read_event_counter() == 0
        begin = bus.now_s()
        bus.exchange([DATA_READY_ON])
        bus.sleep_s(0.3)
        first = bus.read_event_counter()
        assert 0.3 * 819.2 * 0.98 <= first <= (bus.now_s() - begin) * 819.2 + 3


# -- sessions -----------------------------------------------------------------------------------------


def test_opening_learns_what_the_board_can_do():
    with Bench(board="ATmega328P 0042").open() as bus:
        assert bus.firmware.board == "ATmega328P 0042"
        assert bus.capabilities == {
            Capability.STREAM,
            Capability.EVENT_COUNTER,
            Capability.HARD_RESET,
        }
    assert Bench(capabilities=0).open().capabilities == frozenset()
    assert Bench(capabilities=2).open().capabilities == {Capability.EVENT_COUNTER}


def test_a_board_that_boots_after_opening_is_waited_for():
    bench = Bench(boot_s=2.0)
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert 2.0 < bench.clock.now_s() < 3.0


def test_events_are_timed_by_the_firmware_s_own_clock_over_its_wrap():
    bench = Bench(drift=0.02, start_us=(1 << 32) - 700_000)
    with bench.open() as bus:
        bus.exchange([DATA_READY_ON])
        bus.count_events()
        _, begin_s = bus.count_events()
        real_s = bench.clock.now_s()
        bus.sleep_s(0.5)
        edges, end_s = bus.count_events()
        assert end_s - begin_s == pytest.approx(1.02 * (bench.clock.now_s() - real_s), rel=2e-3)
        assert edges == pytest.approx(819.2 * (bench.clock.now_s() - real_s), abs=2)


# A hello of this id and nonce, and a loader that begins to listen so long after the hello's first bit.
MISREAD = [
    (34307, 2032524895, 161.3e-6),
    (6091, 3407726845, 102.1e-6),
    (51195, 4200015072, 101.1e-6),
    (34846, 2575487805, 200.7e-6),
]


@pytest.mark.parametrize(("request_id", "nonce", "offset_s"), MISREAD)
def test_a_bare_hello_can_make_a_boot_loader_erase_a_page(request_id, nonce, offset_s):
    """What the opening has to avoid; the fake shows it, so its silence below means something."""
    loader = BootLoader(0.0, wire.BAUD, start_s=0.3 + offset_s)
    hello = encode(Packet.of(wire.HelloRequest(wire.VERSION, nonce), request_id))
    for k in range(4):
        for n, byte in enumerate(hello):
            loader.hear(byte, 0.3 * (k + 1) + (n + 1) * 20e-6)
    loader.run(2.0)
    assert loader.erased == 1
    assert loader.overheard > 0


class BootingBench(Bench):
    """A board that is reset by the opening."""

    def __init__(self, **loader):
        self.clock = VirtualClock()
        self.chip = SimulatedChip(World(seed=Bench.seed), start_s=-0.5)
        self.firmware = BootingBoard(ChipPins(self.chip, self.clock), **loader)
        self.port = FakePort(self.firmware)


@pytest.mark.parametrize("blinks_s", [0.0, 0.375])
@pytest.mark.parametrize("start_s", [0.002, 0.0651, 0.0697, 0.09])
def test_opening_makes_a_boot_loader_leave_without_a_byte_that_it_could_obey(start_s, blinks_s):
    bench = BootingBench(start_s=start_s, blinks_s=blinks_s)
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    loader = bench.firmware.loader
    assert (loader.erased, loader.overheard) == (0, 0)
    assert loader.left_s < 0.6, "sooner than its own time, which is a second"
    assert bench.clock.now_s() < (1.0 if blinks_s else 0.5)


def test_boot_loaders_are_never_spoken_to_whenever_they_begin_to_listen():
    dice = random.Random(11)
    for _ in range(250):
        bench = BootingBench(start_s=dice.uniform(0.001, 0.09), blinks_s=dice.choice([0.0, 0.19, 0.375]))
        link = SerialLink(bench.port, url="serial:fake", clock=bench.clock, dice=dice)
        link.hello(3.0)
        loader = bench.firmware.loader
        assert (loader.erased, loader.overheard) == (0, 0)


def test_a_loader_that_does_not_heed_zeros_is_waited_out_in_silence():
    bench = BootingBench(stubborn=True, start_s=0.07, blinks_s=0.6)
    with bench.open():
        pass
    assert bench.firmware.loader.left_s > 1.6
    assert bench.clock.now_s() < 3.0
    # Two hellos went out before, in case there was no loader at all.
    packets = [data for data in bench.port.sent if any(data)]
    assert len(packets) == 3 + 2  # the third is answered; configure and statistics follow


def test_opening_a_board_that_does_not_reset_costs_less_than_half_a_second():
    bench = Bench()
    with bench.open():
        assert bench.clock.now_s() < 0.45
    assert bench.firmware.counters["packets"] == 3, "the zeros are no packets"
    assert not any(bench.firmware.counters[name] for name in ("crc", "cobs", "length"))


def test_a_silent_port_says_what_to_look_at():
    bench = Bench(boot_s=1e9)
    with pytest.raises(BusTimeoutError, match=r"within 3 s; is it flashed.*docs/hardware\.md"):
        bench.open()
    assert bench.port.closed


def test_noise_alone_suggests_the_baud_rate():
    bench = Bench(boot_s=1e9)
    bench.port._back.put(b"\x12\x34\x00\x81\x55\x00" * 5, 0.5)
    with pytest.raises(BusTimeoutError, match="another baud rate"):
        bench.open()


def test_another_protocol_version_is_said():
    with pytest.raises(ProtocolError, match="speaks protocol version 2, this package 1"):
        Bench(version=2).open()


def test_a_firmware_that_restarts_gets_a_session_and_its_timing_again():
    bench = Bench()
    bus = bench.open()
    bus.configure(FAST)
    bench.firmware.restart()
    assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.chip.seen[-1].clock_hz == 1e6
    assert bench.chip.seen[-1].start_s - bench.chip.seen[-2].start_s == pytest.approx(40e-6)


def test_after_a_restart_within_a_request_its_frames_are_not_sent_again():
    bench = Bench()
    bus = bench.open()
    send = bench.firmware.send

    def die_before_the_reply(kind, request_id, body):
        send(kind, request_id, body)
        if kind == 0x83:
            bench.firmware.send = send
            bench.firmware.restart()

    bench.firmware.send = die_before_the_reply
    with pytest.raises(ProtocolError, match="restarted during a request"):
        bus.exchange([0xA012])
    assert [f.word for f in bench.chip.seen] == [0xA012]
    assert bus.exchange([0x2000, 0])[1] & 0xFF == 0x12


def test_a_stream_that_was_left_running_is_stopped_by_the_next_request():
    bench = Bench()
    bus = bench.open()
    bus.configure(FAST)
    bus.exchange([DATA_READY_ON])
    stream = bus.stream(SEVEN)
    next(stream)
    bench.port.faults = Faults(drop=1.0)
    stream.close()
    bench.port.faults = Faults()
    assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.chip.seen[-1].clock_hz == 1e6


# -- requests -----------------------------------------------------------------------------------------


def test_a_request_whose_reply_is_lost_is_repeated_and_executed_once():
    bench = Bench()
    bus = bench.open()
    take = bench.port._back.take
    lost = []

    def lose_one(now, size):
        data = take(now, size)
        if data and not lost:
            lost.append(data)
            return b""
        return data

    bench.port._back.take = lose_one
    bus.exchange([0xA012, 0x2000])
    assert lost
    assert bench.firmware.counters["repeated"] == 1
    assert [f.word for f in bench.chip.seen] == [0xA012, 0x2000]


def test_every_copy_of_a_request_has_its_id_and_the_next_one_another():
    bench = Bench()
    bus = bench.open()
    bench.port.sent.clear()
    bench.port.faults = Faults(drop=1.0)
    with pytest.raises(BusTimeoutError, match="no answer from the firmware"):
        bus.exchange([0])
    assert len(bench.port.sent) == 5
    assert len(set(bench.port.sent)) == 1


def test_long_batches_go_in_several_requests_and_keep_the_timing():
    bench = Bench()
    with bench.open() as bus:
        bus.configure(FAST)
        assert bus.exchange([0x3800] * 333)[1:] == [0x0402] * 332
    assert len(bench.chip.seen) == 333


def test_a_slow_batch_is_not_repeated_while_it_runs():
    bench = Bench()
    with bench.open() as bus:
        bus.configure(SpiTiming(125e3, 1000, 20_000))
        bus.exchange([0x3800] * 90)
    assert bus._link.retries == 0


def test_waits_that_the_board_cannot_keep_are_refused():
    with Bench().open() as bus:
        before = bus.timing
        with pytest.raises(UsageError, match="at most 65000"):
            bus.configure(SpiTiming(1e6, 9, 1e6))
        with pytest.raises(UsageError, match="slowest clock is 125000 Hz"):
            bus.configure(SpiTiming(1e5, 9, 40))
        assert bus.timing == before


def test_fractions_of_a_microsecond_are_rounded_up():
    with Bench().open() as bus:
        assert bus.configure(SpiTiming(1e6, 9.2, 40.5)) == SpiTiming(1e6, 10.0, 41.0)


# -- faults -------------------------------------------------------------------------------------------


def test_late_replies_are_discarded_and_counted():
    bench = Bench()
    bus = bench.open()
    bus._link._tries = 1
    for k in range(60):
        bench.port.faults = Faults(seed=k, delay=0.05, delay_s=0.4)
        with contextlib.suppress(BusError):
            replies = bus.exchange([0x3800, 0x3600, 0] if k % 2 else [0x3600, 0x3800, 0])
            assert replies[1:] == ([0x0402, 0x0001] if k % 2 else [0x0001, 0x0402])
    assert bus._link.late > 3


def test_unplugging_within_a_stream_is_a_clear_error():
    bench = Bench()
    bus = bench.open()
    bus.exchange([DATA_READY_ON])
    with bus.stream(SEVEN) as stream:
        next(stream)
        bench.port.plugged = False
        with pytest.raises(CannotOpenError, match="gone"):
            next(stream)
    bus.close()


# -- streams ------------------------------------------------------------------------------------------


def streamed(bench, blocks, *, block_scans=64, frames=SEVEN, options="", before=None):
    with bench.open(options) as bus:
        bus.configure(FAST)
        bus.exchange([DATA_READY_ON])
        if before:
            before(bus)
        with bus.stream(frames, block_scans=block_scans) as stream:
            return [next(stream) for _ in range(blocks)]


def test_a_stream_loses_and_repeats_nothing_at_the_full_rate():
    bench = Bench(watched=False)
    blocks = streamed(bench, 40, block_scans=82)
    times = np.concatenate([block.time_s for block in blocks])
    words = np.concatenate([block.words for block in blocks])
    assert sum(block.lost for block in blocks) == 0
    assert len(times) >= 3280
    assert np.diff(times) == pytest.approx(1 / 819.2, rel=0.03)
    assert times[-1] - times[0] == pytest.approx((len(times) - 1) / 819.2, abs=0.01)
    assert (words >> 15 == 1).all(), "every word is new"


def test_scans_lost_on_the_wire_are_counted_to_the_last_one():
    bench = Bench(watched=False)

    def spoil(bus):
        bench.port.faults = Faults(seed=4, flip=0.001, drop=0.001)

    blocks = streamed(bench, 25, frames=[0x0A00, 0x0C00], before=spoil)
    first, rest = blocks[0], blocks[1:]
    scans = sum(len(block.time_s) for block in rest)
    lost = sum(block.lost for block in rest)
    assert lost > 100
    span_s = rest[-1].time_s[-1] - first.time_s[-1]
    assert scans + lost == pytest.approx(span_s * 819.2, abs=8)  # the times are those of the host
    assert bench.firmware.all_lost == 0


def numbered(capabilities=7, slack=0, width=7):
    """A driver on a board whose chip numbers its updates, the names of a scan, and a judge of them."""
    bench = Bench(capabilities=capabilities)
    bench.chip = NumberedChip(start_s=-0.5)
    bench.firmware.pins.chip = bench.chip
    names = [row.name for row in OUTPUTS[1 : 1 + width]]
    return bench, Adis16354(bench.open(), check=False), names, Judge(names, slack)


@pytest.mark.parametrize(("width", "scans", "rate"), [(3, 4, 0.01), (7, 16, 0.001)])
def test_on_a_bad_line_every_row_of_a_stream_is_of_one_update_and_every_gap_is_counted(width, scans, rate):
    """scripts/wire_faults.py --only stream does it for a hundred thousand packets."""
    bench, sensor, names, judge = numbered(width=width)
    with sensor.stream(names, block_scans=scans) as stream:
        rates = dict.fromkeys(("drop", "duplicate", "flip", "delay", "chunk"), rate)
        bench.port.faults = Faults(seed=5, delay_s=0.001, **rates)
        while bench.firmware.scan_packets < 1500:
            judge.look(next(stream))
        bench.port.faults = Faults()
    assert judge.sound, judge.found
    assert judge.found["gaps"] > 100
    assert judge.found["scans"] > 500


@pytest.mark.parametrize("width", [3, 7])
@pytest.mark.parametrize("rate", [0.0, 0.001])
@pytest.mark.parametrize("capabilities", [0, 2], ids=["by time", "by the edge counter"])
def test_polled_rows_are_of_one_update_and_lost_ones_are_counted(capabilities, rate, width):
    """scripts/wire_faults.py --only polled does it for a hundred thousand batches."""
    bench, sensor, names, judge = numbered(capabilities, slack=None, width=width)
    with sensor.stream(names, block_scans=16) as stream:
        rates = dict.fromkeys(("drop", "duplicate", "flip", "delay", "chunk"), rate)
        failed = 0
        for n in range(160):
            bench.port.faults = Faults(seed=n, delay_s=0.001, **rates) if 10 <= n < 150 else Faults()
            try:
                judge.look(next(stream))
            except BusTimeoutError:
                failed += 1
            assert judge.off >= -4, "counted as lost before it was"
        assert not stream.caveat
    assert judge.sound, judge.found
    assert judge.found["scans"] > 300
    assert abs(judge.off) <= 4  # the updates of one exchange
    assert (failed > 0) == (rate > 0)


def test_polling_over_a_serial_line_misses_none_of_slow_samples():
    _, sensor, names, judge = numbered(capabilities=0)
    sensor.configure(sample_rate_hz=50.0)
    with sensor.stream(names, block_scans=4) as stream:
        while judge.found["scans"] < 400:
            judge.look(next(stream))
    assert judge.sound, judge.found
    assert judge.found["gaps"] == 0


def test_the_judge_of_scans_sees_a_mixed_row_a_repeated_one_and_a_wrong_count():
    names = [row.name for row in OUTPUTS]
    words = words_of(np.arange(70_000, 70_010), names)

    def found(words, lost=0):
        judge = Judge(names)
        judge.look(ScanBlock(tuple(names), words_of(np.array([69_999]), names), np.zeros(1)))
        judge.look(ScanBlock(tuple(names), words, np.zeros(len(words)), lost))
        assert judge.sound == (lost == 0 and words is sound)
        return judge.found

    sound = words | ND
    assert found(sound)["scans"] == 11
    mixed = words.copy()
    mixed[4, 5] = words[3, 5]
    assert found(mixed)["mixed"] == 1
    assert found(words[[0, 1, 1, 2]])["backwards"] == 1
    assert found(words, lost=1)["wrong counts"] == 1


def test_triggers_that_the_firmware_lost_are_counted():
    bench = Bench(watched=False)
    frames = SEVEN * 4  # 29 frames of 56 µs and more: longer than an update
    blocks = streamed(bench, 8, frames=frames, before=lambda bus: bus.configure(SpiTiming(1e6, 9, 56)))
    scans = sum(len(block.time_s) for block in blocks)
    assert sum(block.lost for block in blocks) == pytest.approx(scans, abs=4)


def test_times_follow_a_board_whose_clock_is_off_and_wraps():
    bench = Bench(watched=False, drift=0.005, start_us=2**32 - 4_000_000)
    blocks = streamed(bench, 100, block_scans=82, frames=[0x0A00])
    times = np.concatenate([block.time_s for block in blocks])
    late = times[-1] - bench.clock.now_s()
    assert -0.05 < late < 0.005
    rate = (len(times) - 4000 - 1) / (times[-1] - times[4000])
    assert rate == pytest.approx(819.2, rel=5e-4)


WORDS_S = 82 * 2 * 20e-6  # a byte takes 20 µs at 500 000 baud


@pytest.mark.parametrize(
    ("board", "earliest_s", "latest_s"),
    [({}, -WORDS_S - 2e-3, -WORDS_S), ({"capabilities": 15, "baud": 10_000_000}, -1e-3, 0.0)],
    ids=["serial line", "native USB"],
)
def test_a_scan_is_older_than_its_arrival_by_the_time_of_its_packet_on_the_line(
    board, earliest_s, latest_s
):
    bench = Bench(watched=False, **board)
    times = streamed(bench, 2, block_scans=82, frames=[0x0A00])[-1].time_s
    assert earliest_s < times[-1] - bench.clock.now_s() < latest_s


def test_a_slow_stream_comes_in_small_packets_without_a_time_out():
    bench = Bench(watched=False)

    def slow(bus):
        bus.configure(SpiTiming(250e3, 75, 160))
        bus.exchange([0xB6FF])  # 0.413 samples a second

    blocks = streamed(bench, 2, block_scans=2, before=slow)
    assert sum(len(block.time_s) for block in blocks) == 4
    assert np.diff(np.concatenate([b.time_s for b in blocks])) == pytest.approx(2.42, rel=0.03)


def test_a_line_on_which_no_packet_of_scans_comes_through_is_a_time_out_and_no_wait_for_ever():
    bench = Bench(watched=False)
    send = bench.firmware.send
    with bench.open() as bus:
        bus.configure(FAST)
        bus.exchange([DATA_READY_ON])
        with bus.stream(SEVEN, block_scans=16) as stream:
            next(stream)
            bench.firmware.send = lambda kind, number, body, ready_s=None: (
                bench.firmware._put(b"\1\0", ready_s) if kind == 0xC4 else send(kind, number, body, ready_s)
            )
            begin = bench.clock.now_s()
            with pytest.raises(BusTimeoutError, match="no packet of scans came through whole"):
                next(stream)
            assert bench.clock.now_s() - begin < 5


def test_a_packet_that_ends_within_a_scan_counts_as_lost_scans():
    bench = Bench(watched=False)
    send, cut = bench.firmware.send, []

    def shortened(kind, number, body, ready_s=None):
        if kind == 0xC4 and not cut:
            cut.append(wire.Scans.unpack(body))
            body = body[:-2]
        send(kind, number, body, ready_s)

    with bench.open() as bus:
        bus.configure(FAST)
        bus.exchange([DATA_READY_ON])
        with bus.stream(SEVEN, block_scans=16) as stream:
            next(stream)
            bench.firmware.send = shortened
            later = [next(stream) for _ in range(6)]
    assert sum(block.lost for block in later) == len(cut[0].words) // len(SEVEN)


def test_a_rising_edge_can_be_asked_for():
    bench = Bench(watched=False)
    streamed(bench, 1, options="?edge=rising")
    triggers = [raw[3] for raw in bench.firmware.executed if raw[0] == 4]
    assert triggers == [0]


def test_a_firmware_that_restarts_within_a_stream_is_an_error():
    bench = Bench()
    with bench.open() as bus:
        bus.exchange([DATA_READY_ON])
        with bus.stream(SEVEN) as stream:
            next(stream)
            bench.firmware.restart()
            with pytest.raises(ProtocolError, match="restarted"):
                next(stream)
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_closing_the_bus_stops_the_stream():
    bench = Bench()
    bus = bench.open()
    bus.exchange([DATA_READY_ON])
    bus.stream(SEVEN)
    bus.close()
    assert bench.firmware._stream is None
    assert bench.port.closed


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0.001, 0.3), st.floats(0, 0.05)), min_size=2, max_size=60))
def test_the_map_of_clocks_never_runs_backwards(steps):
    clock = ClockMap(0, 100.0)
    at = 0.0
    last = 0.0
    for span, delay in steps:
        times = clock.times(round(at * 1e6), round(span * 1e6), 5, 100.0 + at + span + delay)
        assert times[0] >= last - 1e-9
        assert (np.diff(times) > 0).all()
        last = times[-1]
        at += span + 0.001


def answered_late(ask, clock, late_s):
    """Return a function like `ask` after which the host is busy for `late_s` seconds."""

    def late(*request):
        reply = ask(*request)
        clock.sleep_s(late_s)
        return reply

    return late


def test_scans_of_a_stream_follow_those_of_a_stream_whose_start_was_answered_late(monkeypatch):
    bench = Bench()
    bus = bench.open()
    bus.exchange([DATA_READY_ON])
    ask, times = bus._ask, []
    for late_s in (0.2, 0.0, 0.1, 0.0):
        with monkeypatch.context() as patch:
            patch.setattr(bus, "_ask", answered_late(ask, bench.clock, late_s))
            stream = bus.stream(SEVEN, block_scans=16)
        times += [next(stream).time_s for _ in range(12)]
        stream.close()
    assert (np.diff(np.concatenate(times)) > 0).all()


# -- ports --------------------------------------------------------------------------------------------


@needs_pty
def test_a_port_is_opened_for_one_program_alone():
    with SimulatedBoard(SimulatedFirmware(ChipPins(SimulatedChip(World(seed=1)), WorkClock()))) as board:
        bus = open_bus(f"serial:{board.path}")
        with pytest.raises(CannotOpenError, match="busy"):
            open_bus(f"serial:{board.path}")
        bus.close()
        open_bus(f"serial:{board.path}").close()


@needs_pty
def test_unplugging_a_real_tty_is_a_clear_error():
    with SimulatedBoard(SimulatedFirmware(ChipPins(SimulatedChip(World(seed=1)), WorkClock()))) as board:
        bus = open_bus(f"serial:{board.path}")
        board.unplug()
        before = time.monotonic()
        with pytest.raises((CannotOpenError, BusTimeoutError)):
            bus.exchange([0])
        assert time.monotonic() - before < 60.0
        bus.close()


class Comport:
    def __init__(self, device, serial_number, vid=0x2341):
        self.device, self.serial_number, self.vid, self.pid = device, serial_number, vid, 0x43
        self.product, self.description = "Arduino Uno", "tty"


@pytest.fixture
def comports(monkeypatch):
    found = []
    serial = pytest.importorskip("serial.tools.list_ports")
    monkeypatch.setattr(serial, "comports", lambda: found)
    return found


def test_usb_ports_are_listed_with_their_serial_numbers_and_not_opened(comports):
    comports += [
        Comport("/dev/ttyACM1", "B2"),
        Comport("/dev/ttyACM0", "A1"),
        Comport("/dev/ttyS0", "", None),
    ]
    rows = find_devices()
    assert [row.url for row in rows] == ["serial:/dev/ttyACM0", "serial:/dev/ttyACM1"]
    assert "serial number A1" in rows[0].description


def test_with_two_ports_none_is_taken_and_a_serial_number_chooses(comports, monkeypatch):
    comports += [Comport("/dev/ttyACM0", "A1"), Comport("/dev/ttyACM1", "B2")]
    with pytest.raises(UsageError, match="ttyACM0 or serial:/dev/ttyACM1"):
        open_bus("serial:")
    opened = []
    monkeypatch.setattr(ports, "open_port", lambda place, baud, url: opened.append(place) or Bench().port)
    bench = Bench()
    monkeypatch.setattr(ports, "open_port", lambda place, baud, url: opened.append(place) or bench.port)
    open_from_url(BusUrl.parse("serial:?serial_number=B2"), clock=bench.clock).close()
    assert opened == ["/dev/ttyACM1"]


def test_without_a_port_the_message_says_so(comports):
    with pytest.raises(CannotOpenError, match=r"^serial: no USB serial port is connected"):
        open_bus("serial:")
    with pytest.raises(CannotOpenError, match="no port with serial number Z"):
        open_bus("serial:?serial_number=Z")


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (errno.EACCES, 'no permission for /dev/x.*SUBSYSTEM=="tty".*GROUP="dialout"'),
        (errno.EBUSY, "busy"),
        (errno.ENOENT, "no port /dev/x is connected"),
    ],
)
def test_what_cannot_be_opened_says_who_must_act(comports, monkeypatch, code, says):
    serial = pytest.importorskip("serial")

    def refuse(*args, **options):
        raise serial.SerialException(code, "could not open port")

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(CannotOpenError, match=says) as caught:
        open_bus("serial:/dev/x")
    assert "\n" not in str(caught.value)


def test_a_port_that_windows_denies_is_busy_and_no_udev_rule_is_named(comports, monkeypatch):
    serial = pytest.importorskip("serial")

    def refuse(*args, **options):  # pyserial's own words there, without a code
        raise serial.SerialException(
            "could not open port 'COM3': PermissionError(13, 'Access is denied.', None, 5)"
        )

    monkeypatch.setattr(serial, "serial_for_url", refuse)
    with pytest.raises(CannotOpenError, match=r"COM3 is busy: close the other program") as caught:
        open_bus("serial:COM3")
    assert "udev" not in str(caught.value)


def test_without_pyserial_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(NotInstalledError, match=r"\[serial\]"):
        open_bus("serial:/dev/x")


def test_without_cobs_the_extra_is_named_and_no_port_is_opened(monkeypatch):
    serial = pytest.importorskip("serial")
    opened = []
    monkeypatch.setattr(serial, "serial_for_url", lambda *args, **options: opened.append(args))
    monkeypatch.setitem(sys.modules, "cobs", None)
    load_cobs.cache_clear()
    with pytest.raises(NotInstalledError, match=r"cobs is not installed.*\[serial\]"):
        open_bus("serial:/dev/x")
    assert not opened


def test_a_module_serial_of_another_package_is_named(monkeypatch):
    serial = pytest.importorskip("serial")
    monkeypatch.delattr(serial, "serial_for_url")
    with pytest.raises(NotInstalledError, match="pip uninstall serial"):
        open_bus("serial:/dev/x")


# -- parsers ------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.binary(max_size=600), st.integers(0, 1000))
def test_the_receiver_takes_any_bytes(data, seed):
    receiver = Receiver()
    dice = random.Random(seed)
    at = 0
    while at < len(data):
        size = dice.randrange(1, 60)
        receiver.feed(data[at : at + size])
        at += size
    assert len(receiver.feed(b"\0")) <= 1


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_random_bytes_make_the_firmware_send_no_frame_but_what_was_asked(data):
    bench = Bench(watched=True)
    bus = bench.open()
    bench.port._there.put(data, bench.clock.now_s())
    assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert [f.word for f in bench.chip.seen] == [0x3800, 0]
