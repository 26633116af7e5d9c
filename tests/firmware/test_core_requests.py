from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.device.bus.wire import Body, Packet, encode
from adis_gonio.device.bus.wire.protocol import (
    VERSION,
    ConfigureReply,
    ConfigureRequest,
    ExchangeReply,
    ExchangeRequest,
    FirmwareCapability,
    HelloReply,
    HelloRequest,
    PacketType,
    Refusal,
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
from firmware.client import Client, RefusedError
from firmware.host_core import HostCore

DEFAULT = (250_000, 75, 160)
"""Clock in Hz, stall and period in µs after a hello, as in firmware_proto/protocol.toml."""


def words(*values: int) -> np.ndarray:
    return np.array(values, np.uint16)


READ = ExchangeRequest(0, words(0x0200, 0x0400, 0x0000))
WRITE = ExchangeRequest(2, words(0xB406, 0xB500))
STREAM = StreamRequest(Trigger.RISING, 2, 1, 0, words(0x0400, 0x0600))
REQUESTS: list[tuple[Body, type[Body]]] = [
    (ConfigureRequest(1_000_000, 9, 40), ConfigureReply),
    (READ, ExchangeReply),
    (WRITE, ExchangeReply),
    (STREAM, StreamReply),
    (StopRequest(), StopReply),
    (ResetRequest(1000), ResetReply),
    (StatisticsRequest(), StatisticsReply),
]


def outside(core: HostCore) -> Client:
    return Client(core, timeout_s=5)


def statistics(client: Client) -> StatisticsReply:
    return client.request(StatisticsRequest(), StatisticsReply)


def refusal(client: Client, body: Body) -> tuple[Refusal, int]:
    with pytest.raises(RefusedError) as caught:
        client.request(body, ExchangeReply)
    assert caught.value.error.request == body.TYPE
    return Refusal(caught.value.error.code), caught.value.error.detail


def test_hello_tells_versions_limits_clocks_and_the_board(core):
    reply = outside(core).hello(nonce=0xDEADBEEF)
    assert (reply.protocol, reply.nonce, reply.board) == (VERSION, 0xDEADBEEF, "host TEST1")
    assert reply.clocks_hz == (2_000_000, 1_000_000, 250_000, 0, 0, 0)
    assert (reply.max_frames, reply.max_list, reply.max_scan_bytes) == (32, 16, 182)
    assert reply.capabilities == sum(FirmwareCapability) - FirmwareCapability.USB


def test_another_protocol_version_is_refused_with_the_firmwares_own(core):
    client = outside(core)
    with pytest.raises(RefusedError) as caught:
        client.request(HelloRequest(VERSION + 1, 1), HelloReply)
    assert (caught.value.error.code, caught.value.error.detail) == (Refusal.PROTOCOL_VERSION, VERSION)
    assert refusal(client, READ)[0] is Refusal.NO_SESSION


@pytest.mark.parametrize(("body", "reply"), REQUESTS)
def test_before_the_hello_every_request_is_refused_and_nothing_is_done(core, body, reply):
    assert refusal(outside(core), body)[0] is Refusal.NO_SESSION
    assert (core.frames, core.reset_us, core.timing) == ([], 0, DEFAULT)


def test_an_exchange_sends_its_frames_in_order_and_returns_a_word_for_each(core, client):
    core.answer = lambda word: word ^ 0x1234
    assert client.request(READ, ExchangeReply).words.tolist() == [0x0200 ^ 0x1234, 0x0400 ^ 0x1234, 0x1234]
    client.request(WRITE, ExchangeReply)
    assert core.frames == [0x0200, 0x0400, 0x0000, 0xB406, 0xB500]


def test_as_many_frames_as_the_hello_tells_and_not_one_more(core, client):
    most = client.hello(2).max_frames
    assert len(client.request(ExchangeRequest(0, words(*[0x0200] * most)), ExchangeReply).words) == most
    client.send(ExchangeRequest(0, words(*[0x0200] * (most + 1))), 5000)
    with pytest.raises(TimeoutError):  # it does not even fit the receiver
        client.answer(5000, ExchangeReply)
    assert statistics(client).length_errors == 1
    assert len(core.frames) == most


@pytest.mark.parametrize(("body", "reply"), REQUESTS)
def test_a_repeated_request_gets_the_same_answer_and_nothing_is_done_twice(core, client, body, reply):
    client.send(body, 500)
    first = client.answer(500, reply)
    before = list(core.frames), core.reset_us, core.timing
    core.set_time(core.time_us + 10_000)
    for _ in range(3):
        client.send(body, 500)
        again = client.answer(500, reply)
        assert again.pack() == first.pack()
    assert (core.frames, core.reset_us, core.timing) == before
    client.next_id = 500
    if body is STREAM:
        client.request(StopRequest(), StopReply)
    assert statistics(client).repeated == 3


def test_a_repeated_refusal_is_the_same_refusal(core, client):
    for _ in range(2):
        client.send(ExchangeRequest(0, words(0x4000)), 500)
        with pytest.raises(RefusedError) as caught:
            client.answer(500, ExchangeReply)
        assert caught.value.error.code == Refusal.BAD_FRAME
    assert core.frames == []


def test_an_id_with_other_content_is_refused_and_the_stored_reply_stays(core, client):
    client.send(READ, 500)
    first = client.answer(500, ExchangeReply)
    client.send(WRITE, 500)
    with pytest.raises(RefusedError) as caught:
        client.answer(500, ExchangeReply)
    assert caught.value.error.code == Refusal.ID_REUSED
    client.send(READ, 500)
    assert client.answer(500, ExchangeReply).words.tolist() == first.words.tolist()
    assert core.frames == READ.frames.tolist()


@pytest.mark.parametrize("behind", [1, 2, 100, 32768])
def test_a_late_duplicate_is_discarded_and_counted(core, client, behind):
    client.next_id = 20_000
    client.request(READ, ExchangeReply)
    core.frames.clear()
    late = (client.next_id - behind) % 65_536
    client.send(WRITE, late)
    with pytest.raises(TimeoutError):
        client.answer(late, ExchangeReply)
    assert core.frames == []
    assert statistics(client).discarded == 1


def test_ids_go_round(core, client):
    client.next_id = 30_000
    client.request(READ, ExchangeReply)
    client.next_id = 60_000
    for _ in range(2):
        client.request(READ, ExchangeReply)
        client.next_id = 65_535
    assert client.request(READ, ExchangeReply).words.size == 3
    assert client.next_id == 0


def test_a_hello_of_the_running_session_obeys_the_ids_and_a_new_one_starts_over(core, client):
    client.request(ConfigureRequest(2_000_000, 9, 40), ConfigureReply)
    old = client.next_id - 1
    client.send(HelloRequest(VERSION, 1), old)  # a late duplicate of the first hello
    with pytest.raises(TimeoutError):
        client.answer(old, HelloReply)
    assert core.timing == (2_000_000, 9, 40)
    client.send(HelloRequest(VERSION, 2), old)  # another host, whose ids are behind
    assert client.answer(old, HelloReply).nonce == 2
    assert core.timing == DEFAULT
    client.send(READ, old + 1)
    assert client.answer(old + 1, ExchangeReply).words.size == 3


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (ExchangeRequest(0, words()), (Refusal.BAD_LENGTH, 0)),
        (ExchangeRequest(0, words(0x0200, 0x4200)), (Refusal.BAD_FRAME, 1)),
        (ExchangeRequest(1, words(0xC200)), (Refusal.BAD_FRAME, 0)),
        (ExchangeRequest(0, words(0x0200, 0xB406)), (Refusal.WRITE_COUNT, 1)),
        (ExchangeRequest(1, words(0x0200)), (Refusal.WRITE_COUNT, 0)),
        (ConfigureRequest(249_999, 9, 40), (Refusal.BAD_VALUE, 0)),
        (ConfigureRequest(250_000, 4001, 40), (Refusal.BAD_VALUE, 4)),
        (ConfigureRequest(250_000, 9, 4001), (Refusal.BAD_VALUE, 6)),
        (ResetRequest(9), (Refusal.BAD_VALUE, 0)),
        (ResetRequest(50_001), (Refusal.BAD_VALUE, 0)),
        (StreamRequest(0, 1, 1, 0, words()), (Refusal.BAD_LENGTH, 0)),
        (StreamRequest(0, 1, 1, 0, words(*[0] * 17)), (Refusal.BAD_LENGTH, 17)),
        (StreamRequest(0, 1, 1, 0, words(0x0200, 0x8200)), (Refusal.BAD_FRAME, 1)),
        (StreamRequest(0, 1, 1, 0, words(0x4200)), (Refusal.BAD_FRAME, 0)),
        (StreamRequest(0, 1, 1, 0, words(0xFFFF)), (Refusal.BAD_FRAME, 0)),
        (StreamRequest(3, 1, 1, 0, words(0)), (Refusal.BAD_VALUE, 0)),
        (StreamRequest(0, 0, 1, 0, words(0)), (Refusal.BAD_VALUE, 1)),
        (StreamRequest(0, 14, 1, 0, words(*[0] * 7)), (Refusal.BAD_VALUE, 1)),
        (StreamRequest(0, 255, 1, 0, words(*[0] * 16)), (Refusal.BAD_VALUE, 1)),
        (StreamRequest(0, 1, 0, 0, words(0)), (Refusal.BAD_VALUE, 2)),
        (StreamRequest(0, 1, 1, 1000, words(0)), (Refusal.BAD_VALUE, 4)),
        (StreamRequest(2, 1, 1, 99, words(0)), (Refusal.BAD_VALUE, 4)),
        (StreamRequest(2, 1, 1, 1_000_000_001, words(0)), (Refusal.BAD_VALUE, 4)),
    ],
)
def test_what_is_wrong_is_refused_with_its_place_and_nothing_is_sent(core, client, body, reason):
    assert refusal(client, body) == reason
    core.edge(1000)
    core.poll()
    assert (core.frames, core.reset_us, core.timing) == ([], 0, DEFAULT)


@pytest.mark.parametrize("kind", [0, 8, 0x20, 0x7F])
def test_unknown_requests_are_refused(core, client, kind):
    core.send(encode(Packet(kind, 900, b"\x01\x02")))
    with pytest.raises(RefusedError) as caught:
        client.answer(900, StopReply)
    assert caught.value.error.code == Refusal.UNKNOWN_REQUEST


@pytest.mark.parametrize("kind", [k for k in PacketType if k < 0x80])
def test_a_body_of_a_wrong_length_is_refused(core, client, kind):
    length = {PacketType.EXCHANGE_REQUEST: 10, PacketType.STREAM_REQUEST: 9}.get(kind, 20)
    core.send(encode(Packet(kind, 900, b"\x01" * length)))
    with pytest.raises(RefusedError) as caught:
        client.answer(900, StopReply)
    assert caught.value.error.code == Refusal.BAD_LENGTH


def test_the_fastest_clock_that_is_allowed_is_taken(core, client):
    for asked, given in ((4e9, 2_000_000), (1_999_999, 1_000_000), (300_000, 250_000)):
        reply = client.request(ConfigureRequest(int(asked), 9, 40), ConfigureReply)
        assert (reply.clock_hz, *core.timing) == (given, given, 9, 40)


def test_no_single_bit_error_is_ever_executed(core, client):
    wire = encode(Packet.of(WRITE, 700))
    for k in range(len(wire) * 8):
        bad = bytearray(wire)
        bad[k // 8] ^= 1 << k % 8
        if bytes(bad).strip(b"\0") == wire.strip(b"\0"):
            continue
        core.send(bytes(bad) + b"\0")
        core.poll()
    broken = len(core.frames)
    client.next_id = 700
    client.request(WRITE, ExchangeReply)
    assert (broken, core.frames) == (0, WRITE.frames.tolist())
    counts = statistics(client)
    assert counts.crc_errors > 50
    assert counts.cobs_errors > 20


def test_noise_before_a_request_costs_the_noise_only(core, client):
    core.send(b"\x07noise without an end")
    assert client.request(READ, ExchangeReply).words.size == 3
    assert statistics(client).cobs_errors + statistics(client).crc_errors >= 1


def test_an_echo_is_discarded(core, client):
    core.send(encode(Packet.of(StopReply(1, 2), client.next_id + 1)))
    core.poll()
    assert statistics(client).discarded == 1


def test_the_request_after_a_full_transmitter_is_answered_when_there_is_room(core, client):
    core.limit_room(10)
    client.send(READ, 800)
    client.send(StopRequest(), 801)
    core.poll()
    assert core.receive(0) == b""
    core.limit_room(255)
    assert [(packet.id, len(packet.body)) for packet in client.poll()] == [(800, 6), (801, 8)]


def test_the_reset_line_is_pulled_for_the_time_asked(core, client):
    client.request(ResetRequest(1000), ResetReply)
    assert core.reset_us == 1000
