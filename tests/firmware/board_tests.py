"""What every board's firmware has to show at its pins, in whatever rig it runs.

A rig has `port`, `now_s`, `sleep_s`, `log` (a `PinLog` or what acts like one), `replies`, `resets`,
`edges_before` and `register`; subclass `PinTests` and `DriverTests` with a fixture `rig`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pytest

from adis_gonio.device.bus import Capability
from adis_gonio.device.bus.serial import SerialBus
from adis_gonio.device.bus.wire.protocol import (
    ConfigureReply,
    ConfigureRequest,
    ExchangeReply,
    ExchangeRequest,
    ResetReply,
    ResetRequest,
    Scans,
    StatisticsReply,
    StatisticsRequest,
    StopReply,
    StopRequest,
    StreamReply,
    StreamRequest,
    Trigger,
)
from adis_gonio.device.sensor import Adis16354
from firmware.client import Client

READABLE = tuple(address << 8 for address in range(0x00, 0x3E, 2))
OUTPUTS = tuple(address << 8 for address in range(0x02, 0x10, 2))
DATA_READY_ON = (0xB406, 0xB500)
SMPL_PRD_10 = (0xB60A,)
SEVEN = ("XGYRO_OUT", "YGYRO_OUT", "ZGYRO_OUT", "XACCL_OUT", "YACCL_OUT", "ZACCL_OUT", "SUPPLY_OUT")


def connect(rig: Any) -> Client:
    client = Client(rig.port)
    client.hello()
    return client


def words(values: object) -> np.ndarray:
    return np.array(values, np.uint16)


def exchange(client: Client, frames: object) -> list[int]:
    frames = words(frames)
    writes = int(np.count_nonzero(frames & 0x8000))
    return client.request(ExchangeRequest(writes, frames), ExchangeReply).words.tolist()


def configure(client: Client, clock_hz: int, stall_us: int, period_us: int) -> ConfigureReply:
    return client.request(ConfigureRequest(clock_hz, stall_us, period_us), ConfigureReply)


def stream(
    rig, client: Client, frames: object, seconds: float, **options: int
) -> tuple[list[Scans], StopReply]:
    body = StreamRequest(
        options.get("trigger", Trigger.RISING),
        options.get("scans", 182 // (2 * len(words(frames)))),
        options.get("decimation", 1),
        options.get("period_us", 0),
        words(frames),
    )
    client.request(body, StreamReply)
    end = rig.now_s() + seconds
    while rig.now_s() < end:
        client.poll(0.005)
    totals = client.request(StopRequest(), StopReply)
    return client.take_scans(), totals


def trigger_times(packets: list[Scans], width: int) -> np.ndarray:
    parts = []
    for packet in packets:
        n = packet.words.size // width
        parts.append(packet.first_us + np.linspace(0, packet.span_us, n))
    return np.concatenate(parts)


def open_serial(rig: Any) -> SerialBus:
    """The serial transport on a rig's port and clock."""
    return SerialBus(rig.port, url="serial:rig", clock=rig)


class PinTests(ABC):
    """The binary at its pins: mode 3, 16 clocks, stall and period of every frame.

    Attributes
    ----------
    clocks_hz : tuple of int
        Clocks that the board has.
    """

    clocks_hz: tuple[int, ...]

    @pytest.fixture
    @abstractmethod
    def rig(self) -> Any:
        """A board that has started."""

    @pytest.fixture
    @abstractmethod
    def slow_rig(self) -> Any:
        """One whose line to the host carries some 20 kB/s."""

    def test_random_batches_arrive_bit_for_bit_both_ways(self, rig):
        client = connect(rig)
        rig.log.keep_words = True
        rng = np.random.default_rng(5)
        n = len(self.clocks_hz)
        sent: list[int] = []
        got: list[int] = []
        for k in range(24):
            configure(client, *((250_000, 75, 160), *((hz, 9, 40) for hz in self.clocks_hz))[k % (n + 1)])
            frames = rng.choice(READABLE, rng.integers(1, 33)) + rng.integers(0, 256)
            frames[0] = 0x9A00 | rng.integers(0, 256)  # a gyro's offset: the only writes
            sent += frames.tolist()
            got += exchange(client, frames)
        assert rig.log.words == sent
        assert rig.replies == got
        assert len(set(got)) > 50
        assert rig.log.fast_frames == rig.log.frames == len(sent)

    def test_fast_mode_keeps_period_and_stall_and_wastes_little(self, rig):
        client = connect(rig)
        configure(client, 1_000_000, 9, 40)
        for _ in range(10):
            exchange(client, [0x0200] * 32)
        assert 40 <= rig.log.least_us("period", "fast") < 43
        configure(client, 250_000, 9, 40)  # a slow clock: now the stall is what counts
        exchange(client, [0x0200])
        rig.log.forget()
        exchange(client, [0x0200] * 32)
        assert 9 <= rig.log.least_us("stall", "fast") < 13

    def test_normal_mode_keeps_period_stall_and_clock_and_wastes_little(self, rig):
        client = connect(rig)
        exchange(client, SMPL_PRD_10)
        for _ in range(10):
            exchange(client, [0x0200] * 32)
        assert rig.log.frames - rig.log.fast_frames >= 320
        assert 160 <= rig.log.least_us("period", "normal") < 164
        assert 3.8 <= rig.log.least_us("clock", "normal") <= 4.0
        configure(client, 250_000, 100, 160)
        exchange(client, [0x0200])
        rig.log.forget()
        exchange(client, [0x0200] * 32)
        assert 100 <= rig.log.least_us("stall", "normal") < 105

    def test_stall_and_period_hold_from_one_request_to_the_next(self, rig):
        client = connect(rig)
        exchange(client, SMPL_PRD_10)
        for _ in range(60):
            exchange(client, [0x0200])
        # The host sends the next request only after the reply. The ATmega's timer wraps every 32.8 ms.
        for wait_us in range(100, 33_000, 1357):
            rig.sleep_s(wait_us * 1e-6)
            exchange(client, [0x0200, 0x0400])
        assert rig.log.frames > 100

    def test_frames_stay_sound_while_bytes_pour_in_and_edges_interrupt(self, rig):
        client = connect(rig)
        exchange(client, DATA_READY_ON)
        configure(client, 1_000_000, 9, 40)
        rig.log.keep_words = True
        body = ExchangeRequest(0, words([0x0200, 0x0400, 0x3600, 0x0000] * 8))
        for k in range(20):
            client.send(body, 5000 + k)
            rig.port.send(bytes(60))  # empty packets fill the receiver while the batch runs
            assert client.answer(5000 + k, ExchangeReply).words.size == 32
        assert rig.replies[0::4][1:] != rig.replies[2::4][1:]
        assert set(rig.replies[3::4]) == {1}  # SMPL_PRD

    def test_the_reset_line_is_low_for_its_time_and_the_chip_restarts(self, rig):
        client = connect(rig)
        exchange(client, [0xB605])
        client.request(ResetRequest(40_000), ResetReply)
        ((low_s, high_s),) = rig.resets
        assert 0.040 <= high_s - low_s < 0.0401
        rig.sleep_s(0.3)
        assert exchange(client, [0x3600, 0x0000])[1] == 1

    def test_seven_registers_at_the_full_rate_come_without_a_lost_or_repeated_scan(self, rig):
        client = connect(rig)
        exchange(client, DATA_READY_ON)
        configure(client, 1_000_000, 9, 40)
        packets, totals = stream(rig, client, OUTPUTS, 1.0)
        scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 7)
        assert len(scans) == totals.scans >= 818
        assert totals.lost == 0
        assert (scans & 0x8000).all(), "a word without ND is a repeated one"
        times = trigger_times(packets, 7)
        assert np.abs(np.diff(times) - 1e6 / 819.2).max() < 15
        assert abs(np.ptp(times) - (len(scans) - 1) * 1e6 / 819.2) < 15
        # Stamps are those of the chip's updates, by the firmware's clock, which began with the simulation.
        late = times * 1e-6 - np.floor(times * 1e-6 * 819.2) / 819.2
        assert np.ptp(late) < 15e-6
        counts = client.request(StatisticsRequest(), StatisticsReply)
        assert abs(counts.edges - rig.edges_before(counts.now_us)) <= 1
        assert counts.receive_overruns == 0

    def test_the_longest_list_keeps_the_full_rate(self, rig):
        """Sixteen frames, an idle one, and the CRC of a packet of 180 bytes fit between two updates."""
        client = connect(rig)
        exchange(client, DATA_READY_ON)
        configure(client, 1_000_000, 9, 40)
        longest = [*OUTPUTS, *OUTPUTS, *OUTPUTS][:16]
        packets, totals = stream(rig, client, longest, 0.5)
        scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 16)
        assert len(scans) == totals.scans >= 408
        assert totals.lost == 0
        assert (scans[:, :7] & 0x8000).all()

    def test_streams_in_normal_mode_lose_nothing_either(self, rig):
        client = connect(rig)
        exchange(client, [*DATA_READY_ON, *SMPL_PRD_10])
        packets, totals = stream(rig, client, READABLE[1:12], 1.0, trigger=Trigger.FALLING)
        scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 11)
        assert 148 <= len(scans) == totals.scans <= 150
        assert totals.lost == 0
        assert (scans & 0x8000).all()

    def test_edges_within_a_list_that_is_too_long_are_counted_to_the_one(self, rig):
        client = connect(rig)
        exchange(client, DATA_READY_ON)
        edges = client.request(StatisticsRequest(), StatisticsReply).edges
        packets, totals = stream(
            rig, client, READABLE[:16], 0.5
        )  # 17 frames of 160 µs: two edges a scan are lost
        new = client.request(StatisticsRequest(), StatisticsReply).edges - edges
        assert totals.scans > 100
        assert totals.lost > 200
        assert 0 <= new - (totals.scans + totals.lost) <= 20  # those before the start and after the stop
        times = trigger_times(packets, 16)
        gaps = np.rint(np.diff(times) * 819.2e-6).astype(int) - 1
        told = np.diff([packet.lost for packet in packets])
        assert packets[-1].lost <= totals.lost <= packets[-1].lost + 2
        assert gaps.sum() == told.sum()
        assert all(packet.words.size == 16 for packet in packets)

    def test_a_line_that_is_too_slow_loses_whole_scans_and_counts_them(self, slow_rig):
        rig = slow_rig
        client = connect(rig)
        exchange(client, DATA_READY_ON)
        configure(client, 1_000_000, 9, 40)
        packets, totals = stream(rig, client, READABLE[:16], 0.5)
        scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 16)
        assert len(scans) == totals.scans
        assert totals.lost > 25
        times = trigger_times(packets, 16)
        gaps = np.rint(np.diff(times) * 819.2e-6).astype(int) - 1
        assert gaps.sum() == packets[-1].lost - packets[0].lost
        assert (gaps >= 0).all()
        first = [packet.sequence for packet in packets]
        assert first == np.cumsum([0, *(packet.words.size // 16 for packet in packets[:-1])]).tolist()

    def test_the_firmwares_own_clock_triggers_evenly(self, rig):
        client = connect(rig)
        configure(client, 1_000_000, 9, 40)
        packets, totals = stream(rig, client, OUTPUTS, 0.5, trigger=Trigger.PERIOD, period_us=1000)
        assert set(np.diff(trigger_times(packets, 7))) == {1000.0}
        assert totals.lost == 0
        assert 495 <= totals.scans <= 510


class DriverTests(ABC):
    """Driver, serial transport and binary together, in simulated time; X points up."""

    board: str

    @pytest.fixture
    @abstractmethod
    def rig(self) -> Any:
        """A board that has started."""

    def test_the_sensor_is_identified_and_every_register_reads_what_the_chip_holds(self, rig):
        with Adis16354(open_serial(rig)) as sensor:
            assert sensor.bus.firmware.board == self.board
            assert {
                Capability.STREAM,
                Capability.HARD_RESET,
                Capability.EVENT_COUNTER,
            } <= sensor.bus.capabilities
            for name, value in sensor.read_all().items():
                if not name.endswith("_OUT") and name not in ("STATUS", "AUX_ADC"):
                    assert value == rig.register(name), name
            assert sensor.scan()["XACCL_OUT"] == pytest.approx(1000, abs=60)
        assert rig.log.fast_frames == rig.log.frames > 30
        assert rig.log.writes == 0

    def test_the_clock_follows_the_chips_mode_and_back(self, rig):
        with Adis16354(open_serial(rig)) as sensor:
            sensor.configure(smpl_prd=0x0A)
            slow = rig.log.frames
            sensor.scan()
            assert rig.log.frames - slow >= 8
            normal = rig.log.frames - rig.log.fast_frames
            assert normal > 8
            sensor.configure(smpl_prd=1)
            sensor.scan()
            assert rig.log.frames - rig.log.fast_frames - normal <= 4
        assert rig.log.least_us("period", "fast") < 43

    def test_seven_registers_at_the_full_rate_reach_the_user_without_a_gap(self, rig):
        with Adis16354(open_serial(rig)) as sensor:
            sensor.configure(smpl_prd=1, filter_m=0, data_ready=True)
            with sensor.stream(SEVEN) as stream:
                blocks = [next(stream) for _ in range(4)]
        times = np.concatenate([block.time_s for block in blocks])
        assert len(times) >= 4 * 200
        assert sum(block.lost for block in blocks) == 0
        assert np.abs(np.diff(times) * 819.2 - 1).max() < 0.05
        assert all((block.words & 0x8000).all() for block in blocks)

    def test_a_stream_enables_data_ready_by_itself_and_sets_it_back(self, rig):
        with Adis16354(open_serial(rig)) as sensor:
            sensor.configure(smpl_prd=1, filter_m=0, linear_g=True)
            with pytest.raises(KeyboardInterrupt), sensor.stream(SEVEN) as stream:  # noqa: PT012
                block = next(stream)
                assert rig.register("MSC_CTRL") == 0x84
                raise KeyboardInterrupt
            assert len(block) >= 200
            assert block.lost == 0
            assert rig.register("MSC_CTRL") == 0x80
            with sensor.stream(SEVEN, leave_registers=True) as stream:
                assert "polling" in stream.how
                assert len(next(stream)) > 0
            assert rig.register("MSC_CTRL") == 0x80

    def test_a_hard_reset_brings_back_what_is_saved(self, rig):
        with Adis16354(open_serial(rig)) as sensor:
            sensor.write("XACCL_OFF", 100)
            sensor.bus.hard_reset()
            rig.sleep_s(0.3)
            assert sensor.read("XACCL_OFF") == 0
        ((low_s, high_s),) = rig.resets
        assert high_s - low_s == pytest.approx(1e-3, rel=0.05)
