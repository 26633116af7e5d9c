from __future__ import annotations

import itertools

import numpy as np
import pytest

from adis_gonio.device.bus.wire.protocol import (
    ConfigureReply,
    ConfigureRequest,
    ExchangeReply,
    ExchangeRequest,
    HelloReply,
    Refusal,
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
from firmware.client import Client, RefusedError
from firmware.host_core import HostCore

LIST = (0x0400, 0x0600, 0x0800)
PERIOD = 1221


def start(
    client: Client, scans: int = 4, decimation: int = 1, trigger: int = Trigger.RISING, period: int = 0
):
    client.request(ConfigureRequest(1_000_000, 9, 40), ConfigureReply)
    body = StreamRequest(trigger, scans, decimation, period, np.array(LIST, np.uint16))
    return client.request(body, StreamReply)


def run(core: HostCore, client: Client, first: int, count: int) -> list[Scans]:
    """So many edges, one PERIOD apart from number `first` on."""
    for k in range(first, first + count):
        core.edge(10_000 + k * PERIOD)
        client.poll()
    return client.take_scans()


def stop(client: Client) -> StopReply:
    return client.request(StopRequest(), StopReply)


def times(packet: Scans) -> list[int]:
    n = packet.words.size // len(LIST)
    return [packet.first_us + (i * packet.span_us // (n - 1) if i else 0) for i in range(n)]


def test_each_edge_runs_the_list_and_an_idle_frame_and_pipelining_is_undone(core, client):
    start(client, scans=2)
    core.answer = lambda word: 0x8000 + len(core.frames)
    packets = run(core, client, 0, 2)
    assert core.frames == [*LIST, 0, *LIST, 0]
    assert [hex(word) for word in packets[0].words] == [
        "0x8002",
        "0x8003",
        "0x8004",
        "0x8006",
        "0x8007",
        "0x8008",
    ]


def test_packets_hold_the_scans_asked_for_with_sequence_and_times(core, client):
    start(client, scans=4)
    packets = run(core, client, 0, 12)
    assert [(p.sequence, p.lost, p.words.size) for p in packets] == [(0, 0, 12), (4, 0, 12), (8, 0, 12)]
    assert [t for p in packets for t in times(p)] == [10_000 + k * PERIOD for k in range(12)]
    assert stop(client) == StopReply(12, 0)


def test_times_wrap_and_the_sequence_goes_on_beyond_16_bits(core, client):
    start(client, scans=1)
    begin = 2**32 - 2 * PERIOD
    seen = []
    for k in range(4):
        core.edge(begin + k * PERIOD)
        client.poll()
        seen += client.take_scans()
    assert [p.first_us for p in seen] == [(begin + k * PERIOD) % 2**32 for k in range(4)]
    for k in range(65_534):
        core.edge((5 + k) * PERIOD % 2**32)
        core.receive(0)
    assert [p.sequence for p in run(core, client, 70_000, 1)] == [65_534 + 4]
    assert stop(client) == StopReply(65_539, 0)


def test_stop_sends_the_scans_that_are_left_before_its_reply(core, client):
    start(client, scans=4)
    assert len(run(core, client, 0, 6)) == 1
    assert stop(client) == StopReply(6, 0)
    last = client.take_scans()
    assert [(p.sequence, p.words.size) for p in last] == [(4, 6)]
    assert stop(client) == StopReply(6, 0)
    assert run(core, client, 6, 3) == []
    assert len(core.frames) == 6 * 4


def test_triggers_lost_on_a_line_that_is_too_slow_are_counted_to_the_one(core, client):
    start(client, scans=2)
    packets = run(core, client, 0, 4)
    core.limit_room(0)
    packets += run(core, client, 4, 9)  # two go into the packet, the seven behind wait in vain
    core.limit_room(255)
    packets += run(core, client, 13, 6)
    totals = stop(client)
    packets += client.take_scans()
    sent = sum(p.words.size for p in packets) // len(LIST)
    assert sent == totals.scans
    assert totals.scans + totals.lost == 19
    assert totals.lost >= 6
    taken = [t for p in packets for t in times(p)]
    assert len(set(taken)) == len(taken)
    assert all((t - 10_000) % PERIOD == 0 for t in taken)
    for before, after in itertools.pairwise(packets):
        n = before.words.size // len(LIST)
        gap = (after.first_us - before.first_us - before.span_us) // PERIOD - 1
        assert after.sequence == before.sequence + n
        assert after.lost - before.lost == gap


def test_a_packet_is_closed_where_a_trigger_is_lost_so_its_scans_are_consecutive(core, client):
    start(client, scans=6)
    run(core, client, 0, 2)
    core.edge(10_000 + 2 * PERIOD)
    core.edge(10_000 + 3 * PERIOD)  # the main loop was away: number 2 is given up
    core.poll()
    packets = run(core, client, 4, 2)
    assert stop(client) == StopReply(5, 1)
    packets += client.take_scans()
    assert [(p.sequence, p.lost, p.words.size // 3) for p in packets] == [(0, 0, 2), (2, 1, 3)]
    assert times(packets[1]) == [10_000 + k * PERIOD for k in (3, 4, 5)]


def during(core: HostCore, frame: int, edges: list[int]) -> None:
    """Edges at some times while frame number `frame` runs."""

    def answer(word: int) -> int:
        if len(core.frames) - 1 == frame:
            for time in edges:
                core.edge(time)
        return 0x8000

    core.answer = answer


def test_triggers_within_a_scan_that_is_longer_than_their_distance_are_lost_and_the_scan_stands(
    core, client
):
    start(client, scans=1)
    during(core, 2, [10_080, 10_090])
    packets = run(core, client, 0, 1)
    assert [p.first_us for p in packets] == [10_000]
    packets = run(core, client, 1, 1)
    assert [(p.sequence, p.lost, p.first_us) for p in packets] == [(1, 2, 10_000 + PERIOD)]
    assert stop(client) == StopReply(2, 2)


def test_a_scan_that_saw_a_trigger_only_because_it_was_late_may_be_torn_and_is_given_up(core, client):
    start(client, scans=1)
    core.edge(10_000)
    core.set_time(10_200)  # begun at once, it would have been over by 10 160
    during(core, 2, [10_300])
    core.poll()
    client.poll()
    packets = client.take_scans()
    assert [(p.sequence, p.lost, p.first_us) for p in packets] == [(0, 1, 10_300)]
    assert stop(client) == StopReply(1, 1)


def test_a_late_scan_that_saw_no_trigger_stands(core, client):
    start(client, scans=1)
    core.edge(10_000)
    core.set_time(10_900)
    client.poll()
    assert [(p.lost, p.first_us) for p in client.take_scans()] == [(0, 10_000)]


def test_decimation_takes_every_nth_trigger_and_counts_only_those(core, client):
    start(client, scans=2, decimation=5)
    packets = run(core, client, 0, 40)
    assert [t for p in packets for t in times(p)] == [10_000 + k * PERIOD for k in range(4, 40, 5)]
    assert stop(client) == StopReply(8, 0)
    assert client.request(StatisticsRequest(), StatisticsReply).edges == 40


def test_the_firmwares_own_clock_triggers_from_the_start_on(core, client):
    core.set_time(5_000)
    begun = start(client, scans=1, trigger=Trigger.PERIOD, period=2_000).now_us
    seen = []
    for k in range(1, 8):
        core.set_time(begun + k * 2_000 + 7)
        core.edge()  # edges are no triggers now
        client.poll()
        seen += client.take_scans()
    assert [p.first_us for p in seen] == [begun + k * 2_000 for k in range(1, 8)]
    core.set_time(begun + 20_100)  # six more are due: five are lost
    client.poll()
    assert [(p.lost, p.first_us) for p in client.take_scans()] == [(2, begun + 20_000)]
    assert stop(client) == StopReply(8, 2)


@pytest.mark.parametrize(("trigger", "falling"), [(Trigger.RISING, False), (Trigger.FALLING, True)])
def test_the_edge_is_the_one_asked_for(core, client, trigger, falling):
    start(client, trigger=trigger)
    assert core.falling is falling


@pytest.mark.parametrize(
    "body",
    [
        ExchangeRequest(0, np.zeros(1, np.uint16)),
        ConfigureRequest(250_000, 75, 160),
        ResetRequest(1000),
        StreamRequest(0, 1, 1, 0, np.zeros(1, np.uint16)),
    ],
)
def test_what_would_disturb_a_stream_is_refused_while_it_runs(core, client, body):
    start(client, scans=1)
    with pytest.raises(RefusedError) as caught:
        client.request(body, ResetReply)
    assert caught.value.error.code == Refusal.BUSY
    assert len(run(core, client, 0, 3)) == 3
    stop(client)
    client.request(ExchangeRequest(0, np.zeros(1, np.uint16)), ExchangeReply)


def test_statistics_are_answered_in_a_stream_and_disturb_nothing(core, client):
    start(client, scans=1)
    for k in range(20):
        core.edge(10_000 + k * PERIOD)
        assert client.request(StatisticsRequest(), StatisticsReply).edges == k + 1
    assert [p.sequence for p in client.take_scans()] == list(range(20))
    assert stop(client) == StopReply(20, 0)


def test_a_new_session_ends_the_stream_and_drops_what_is_left(core, client):
    start(client, scans=4)
    run(core, client, 0, 2)
    assert isinstance(client.hello(99), HelloReply)
    assert run(core, client, 2, 8) == []
    assert len(core.frames) == 2 * 4


def test_scans_carry_the_id_of_their_streams_request(core, client):
    start(client, scans=1)
    wanted = client.next_id
    core.edge(10_000)
    client.poll()
    assert [packet.id for packet in client.scans] == [wanted]


def test_a_second_stream_counts_anew(core, client):
    start(client, scans=1)
    core.edge(10_000)
    core.edge(10_001)
    core.poll()
    assert stop(client) == StopReply(1, 1)
    client.take_scans()
    start(client, scans=1)
    assert [(p.sequence, p.lost) for p in run(core, client, 1, 2)] == [(0, 0), (1, 0)]
