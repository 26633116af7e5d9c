"""The real binary at its pins: mode 3, 16 clocks, stall and period of every frame, from the edges."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from adis_gonio.bus.wire.protocol import (
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
from adis_gonio.sim import World
from firmware import avr_build
from firmware.client import Client
from firmware.pins import F_CPU, FAST, NORMAL, FrameEdges, PinLog

READABLE = tuple(address << 8 for address in range(0x00, 0x3E, 2))
OUTPUTS = tuple(address << 8 for address in range(0x02, 0x10, 2))
DATA_READY_ON = (0xB406, 0xB500)
SMPL_PRD_10 = (0xB60A,)


def words(values: object) -> np.ndarray:
    return np.array(values, np.uint16)


def connect(make_rig, seed: int = 3, **options: int):
    rig = make_rig(World(seed=seed), **options)
    rig.sleep_s(0.02)
    client = Client(rig.port)
    client.hello()
    return rig, client


def exchange(client: Client, frames: object) -> list[int]:
    frames = words(frames)
    writes = int(np.count_nonzero(frames & 0x8000))
    return client.request(ExchangeRequest(writes, frames), ExchangeReply).words.tolist()


def configure(client: Client, clock_hz: int, stall_us: int, period_us: int) -> ConfigureReply:
    return client.request(ConfigureRequest(clock_hz, stall_us, period_us), ConfigureReply)


def test_random_batches_arrive_bit_for_bit_both_ways(make_rig):
    rig, client = connect(make_rig)
    rig.log.keep_words = True
    rng = np.random.default_rng(5)
    sent: list[int] = []
    got: list[int] = []
    for k in range(24):
        configure(
            client, *((250_000, 75, 160), (1_000_000, 9, 40), (500_000, 9, 40), (125_000, 9, 40))[k % 4]
        )
        frames = rng.choice(READABLE, rng.integers(1, 33)) + rng.integers(0, 256)
        frames[0] = 0x9A00 | rng.integers(0, 256)  # a gyro's offset: the only writes
        sent += frames.tolist()
        got += exchange(client, frames)
    assert rig.log.words == sent
    assert rig.replies == got
    assert len(set(got)) > 50
    assert rig.log.fast_frames == rig.log.frames == len(sent)


def test_fast_mode_keeps_period_and_stall_and_wastes_little(make_rig):
    rig, client = connect(make_rig)
    configure(client, 1_000_000, 9, 40)
    for _ in range(10):
        exchange(client, [0x0200] * 32)
    assert 40 <= rig.log.least_us("period", "fast") < 43
    configure(client, 250_000, 9, 40)  # a slow clock: now the stall is what counts
    exchange(client, [0x0200])
    rig.log.forget()
    exchange(client, [0x0200] * 32)
    assert 9 <= rig.log.least_us("stall", "fast") < 13


def test_normal_mode_keeps_period_stall_and_clock_and_wastes_little(make_rig):
    rig, client = connect(make_rig)
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


def test_stall_and_period_hold_from_one_request_to_the_next(make_rig):
    rig, client = connect(make_rig)
    exchange(client, SMPL_PRD_10)
    for _ in range(60):
        exchange(client, [0x0200])
    # The hosts sends the next request only after the reply; the timer's wrap every 32.8 ms is met as well.
    for wait_us in range(100, 33_000, 1357):
        rig.sleep_s(wait_us * 1e-6)
        exchange(client, [0x0200, 0x0400])
    assert rig.log.frames > 100


def test_frames_stay_sound_while_bytes_pour_in_and_edges_interrupt(make_rig):
    rig, client = connect(make_rig)
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


def test_the_data_ready_input_holds_itself_high_where_no_wire_drives_it(make_rig):
    rig, client = connect(make_rig)
    assert rig.ready_wire == "Pull up"
    exchange(client, DATA_READY_ON)
    rig.sleep_s(0.1)
    assert rig.ready_wire in ("High", "Low"), "the chip drives it"
    edges = client.request(StatisticsRequest(), StatisticsReply).edges
    assert edges == pytest.approx(82, abs=4)


@pytest.mark.parametrize("clock_hz", [1_000_000, 500_000, 250_000, 125_000])
def test_chip_select_rises_right_behind_the_last_clock_whatever_interrupts(make_rig, clock_hz):
    rig, client = connect(make_rig)
    configure(client, clock_hz, 9, 40)
    rig.log.forget()
    rig.noise_on_ready(seed=clock_hz, mean_cycles=16 * 90)
    body = ExchangeRequest(0, words([0x0200] * 32))
    for k in range(25):
        client.send(body, 5000 + k)
        rig.port.send(bytes(64))
        # Noise may cost the firmware a byte in this rig; then the request is sent once more.
        client.answer(5000 + k, ExchangeReply)
    assert rig.log.frames > 500
    assert rig.log.longest_trail["fast"] / 16 < 1.0


def test_the_reset_line_is_low_for_its_time_and_the_chip_restarts(make_rig):
    rig, client = connect(make_rig)
    exchange(client, [0xB605])
    client.request(ResetRequest(40_000), ResetReply)
    ((low_s, high_s),) = rig.resets
    assert 0.040 <= high_s - low_s < 0.0401
    rig.sleep_s(0.3)
    assert exchange(client, [0x3600, 0x0000])[1] == 1


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


def test_seven_registers_at_the_full_rate_come_without_a_lost_or_repeated_scan(make_rig):
    rig, client = connect(make_rig)
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


def test_the_longest_list_keeps_the_full_rate(make_rig):
    """Sixteen frames, an idle one, and the CRC of a packet of 180 bytes fit between two updates."""
    rig, client = connect(make_rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    longest = [*OUTPUTS, *OUTPUTS, *OUTPUTS][:16]
    packets, totals = stream(rig, client, longest, 0.5)
    scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 16)
    assert len(scans) == totals.scans >= 408
    assert totals.lost == 0
    assert (scans[:, :7] & 0x8000).all()


def test_stamps_are_right_where_the_timer_wraps_under_the_interrupt(make_rig):
    rig, client = connect(make_rig)
    configure(client, 1_000_000, 9, 40)
    client.request(StreamRequest(Trigger.RISING, 1, 1, 0, words([0x0200])), StreamReply)

    def stamp(cycle: int) -> float:
        """What the firmware's clock is behind the simulation's at an edge, in µs."""
        rig.edge_at(cycle)
        while rig.now_s() * F_CPU < cycle + 16_000:
            client.poll(0.0005)
        (packet,) = client.take_scans()
        return cycle / 16 - packet.first_us

    wrap = 65_536 * 8  # cycles of the 16-bit timer at half a microsecond
    behind = stamp(wrap + wrap // 2)
    start = round(behind * 16)  # the cycle at which the timer began, but for the interrupt's latency
    stamps = [stamp((n + 2) * wrap + start + 10 * (n - 15)) for n in range(31)]
    assert np.abs(np.array(stamps) - behind).max() < 8


def test_streams_in_normal_mode_lose_nothing_either(make_rig):
    rig, client = connect(make_rig)
    exchange(client, [*DATA_READY_ON, *SMPL_PRD_10])
    packets, totals = stream(rig, client, READABLE[1:12], 1.0, trigger=Trigger.FALLING)
    scans = np.concatenate([packet.words for packet in packets]).reshape(-1, 11)
    assert 148 <= len(scans) == totals.scans <= 150
    assert totals.lost == 0
    assert (scans & 0x8000).all()


def test_edges_within_a_list_that_is_too_long_are_counted_to_the_one(make_rig):
    rig, client = connect(make_rig)
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


def test_a_line_that_is_too_slow_loses_whole_scans_and_counts_them(make_rig):
    rig, client = connect(make_rig, BAUD=250_000)
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


def test_the_firmwares_own_clock_triggers_evenly(make_rig):
    rig, client = connect(make_rig)
    configure(client, 1_000_000, 9, 40)
    packets, totals = stream(rig, client, OUTPUTS, 0.5, trigger=Trigger.PERIOD, period_us=1000)
    assert set(np.diff(trigger_times(packets, 7))) == {1000.0}
    assert totals.lost == 0
    assert 495 <= totals.scans <= 510


@pytest.mark.parametrize("baud", [500_000, 1_000_000])
def test_seven_registers_and_requests_in_between_at_both_baud_rates(make_rig, baud):
    rig, client = connect(make_rig, BAUD=baud)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    begun = client.request(StreamRequest(Trigger.RISING, 13, 1, 0, words(OUTPUTS)), StreamReply).now_us
    while rig.now_s() < begun * 1e-6 + 0.5:
        client.request(StatisticsRequest(), StatisticsReply)
    totals = client.request(StopRequest(), StopReply)
    assert totals.lost == 0
    assert totals.scans >= 408


def test_flash_and_ram_are_within_their_limits_and_the_stack_within_its_reserve(make_rig, avr_elf):
    told = avr_build.make(avr_elf().parent, "size")
    assert "of 16384 bytes" in told
    reserve = int(told.split(" stack")[0].rsplit(" ", 1)[1])
    symbols = subprocess.run(["avr-nm", str(avr_elf())], capture_output=True, text=True, check=True).stdout
    end = next(int(line.split()[0], 16) for line in symbols.splitlines() if line.endswith(" _end")) & 0xFFFF
    rig, client = connect(make_rig)
    rig.paint_stack(end)
    client.hello(7)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    exchange(client, [0x0200] * 32)
    client.request(ResetRequest(20), ResetReply)
    rig.sleep_s(0.3)
    exchange(client, DATA_READY_ON)
    client.request(StreamRequest(Trigger.RISING, 13, 1, 0, words(OUTPUTS)), StreamReply)
    for _ in range(100):
        client.request(StatisticsRequest(), StatisticsReply)
    client.request(StopRequest(), StopReply)
    stack = rig.deepest_stack(end)
    print(f"{told.strip()}; deepest stack {stack} bytes")  # noqa: T201
    assert 20 < stack <= reserve


# -- the judge itself ------------------------------------------------------------


def frame(fall: int, limits=FAST, half: int = 8, bits: int = 16, **changes) -> FrameEdges:
    edges = FrameEdges(limits, fall, True)
    edges.falling = [fall + 8 + 2 * half * k for k in range(bits)]
    edges.rising = [t + half for t in edges.falling]
    edges.data_changes = list(edges.falling)
    edges.rise, edges.clock_at_rise = edges.rising[-1] + 4, True
    for name, value in changes.items():
        setattr(edges, name, value)
    return edges


def verdict(*frames: FrameEdges) -> str:
    log = PinLog()
    for edges in frames:
        log.judge(edges)
    return "; ".join(log.violations)


def test_the_judge_accepts_frames_at_the_limits_and_refuses_those_beyond():
    length = frame(0).rise
    assert verdict(frame(0), frame(640)) == ""
    assert "period of 39.9375 us" in verdict(frame(0), frame(639))
    slow = frame(0, half=40)
    assert verdict(slow, frame(slow.rise + 144)) == ""
    assert "stall of 8.9375 us" in verdict(slow, frame(slow.rise + 143))
    normal = frame(0, NORMAL, half=27)
    assert verdict(normal, frame(2560, NORMAL, half=27)) == ""
    assert "period of 159.9375" in verdict(normal, frame(2559, NORMAL, half=27))
    assert "stall of 74.9375" in verdict(
        frame(0, NORMAL, half=80), frame(frame(0, half=80).rise + 1199, NORMAL, half=27)
    )
    assert "clock of 3.25 us" in verdict(frame(0, NORMAL, half=26))
    assert "clock of 0.375 us" in verdict(frame(0, half=3))
    assert "15 falling and 15 rising" in verdict(frame(0, bits=15))
    assert "idles low" in verdict(frame(0, clock_at_fall=False))
    edges = frame(0)
    edges.falling, edges.rising = edges.rising, edges.falling
    assert "not the falling one" in verdict(edges)
    assert "data change at the sampling edge" in verdict(frame(0, data_changes=[frame(0).rising[3]]))
    assert length < 640
    assert F_CPU == 16_000_000
