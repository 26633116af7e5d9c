"""The real binary at its pins: mode 3, 16 clocks, stall and period of every frame, from the edges."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from adis_gonio.device.bus.wire.protocol import (
    ExchangeReply,
    ExchangeRequest,
    ResetReply,
    ResetRequest,
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
from firmware.board_tests import DATA_READY_ON, OUTPUTS, PinTests, configure, exchange, words
from firmware.client import Client
from firmware.pins import F_CPU, FAST, NORMAL, FrameEdges, PinLog


def started(make_rig, **options: int):
    rig = make_rig(World(seed=3), **options)
    rig.sleep_s(0.02)
    return rig


def connect(make_rig, **options: int):
    rig = started(make_rig, **options)
    client = Client(rig.port)
    client.hello()
    return rig, client


class TestPins(PinTests):
    clocks_hz = (1_000_000, 500_000, 250_000, 125_000)

    @pytest.fixture
    def rig(self, make_rig):
        return started(make_rig)

    @pytest.fixture
    def slow_rig(self, make_rig):
        return started(make_rig, BAUD=250_000)


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
    symbols = subprocess.run(
        ["avr-nm", str(avr_elf())], capture_output=True, text=True, check=True, timeout=60
    ).stdout
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
