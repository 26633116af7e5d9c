from __future__ import annotations

import random
import sys
import zlib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from crccheck.crc import Crc32
from hypothesis import example, given, strategies as st

from adis_gonio.base.errors import NotInstalledError, ProtocolError
from adis_gonio.device.bus.wire import Body, Packet, Receiver, encode, load_cobs, protocol as wire

VECTORS = Path(__file__).parents[3] / "firmware_proto" / "vectors.txt"
BYTES = st.binary(max_size=700) | st.lists(st.sampled_from([0, 1, 254, 255]), max_size=700).map(bytes)
PACKETS = st.builds(
    Packet,
    st.sampled_from([int(kind) for kind in wire.PacketType]),
    st.integers(0, 0xFFFF),
    st.binary(max_size=wire.MAX_RAW - wire.HEADER_SIZE - wire.CRC_SIZE),
)


def vectors(kind: str) -> list[tuple[bytes, str]]:
    rows = [line.split() for line in VECTORS.read_text().splitlines() if line.startswith(f"{kind} ")]
    assert rows
    return [(b"" if left == "-" else bytes.fromhex(left), right) for _, left, right in rows]


# -- shared vectors ------------------------------------------------------------


@pytest.mark.parametrize(("data", "crc"), vectors("crc"))
def test_crc_vectors(data, crc):
    assert zlib.crc32(data) == int(crc, 16)


def test_the_check_value_of_the_crc():
    assert zlib.crc32(b"123456789") == 0xCBF43926


@pytest.mark.parametrize(("raw", "on_the_wire"), vectors("packet"))
def test_packet_vectors(raw, on_the_wire):
    packet = Packet(raw[0], int.from_bytes(raw[1:3], "little"), raw[3:])
    assert encode(packet) == b"\0" + bytes.fromhex(on_the_wire)
    expected = [packet] if packet.type in list(wire.PacketType) else []
    assert Receiver().feed(bytes.fromhex(on_the_wire)) == expected


@pytest.mark.parametrize(("data", "result"), vectors("wire"))
def test_what_vectors_of_bytes_are_counted_as(data, result):
    receiver = Receiver()
    assert len(receiver.feed(data + b"\0")) == (result == "packet")
    assert receiver.bad == Counter({result} - {"packet", "empty"})


# -- against other implementations ------------------------------------------------------------


def stuff(data: bytes) -> bytes:
    """Encode bytes by COBS, so that the result has no zero byte."""
    out, run = bytearray(), bytearray()
    for k, byte in enumerate(data):
        if byte:
            run.append(byte)
        if not byte or len(run) == 254:
            out += bytes([len(run) + 1]) + run
            run.clear()
            if byte and k == len(data) - 1:
                return bytes(out)
    return bytes(out + bytes([len(run) + 1]) + run)


def unstuff(data: bytes) -> bytes | None:
    """Decode bytes encoded by COBS; None if they are invalid."""
    out, k = bytearray(), 0
    while k < len(data):
        size = data[k]
        if not size or k + size > len(data):
            return None
        out += data[k + 1 : k + size]
        k += size
        if size < 255 and k < len(data):
            out.append(0)
    return bytes(out)


def decoded(data: bytes) -> bytes | None:
    """By the library; None where it refuses."""
    try:
        return load_cobs().decode(data)
    except load_cobs().DecodeError:
        return None


@given(BYTES)
def test_the_librarys_cobs_is_that_of_the_protocol(data):
    assert load_cobs().encode(data) == stuff(data)
    assert decoded(stuff(data)) == data


@pytest.mark.parametrize("length", [0, 1, 253, 254, 255, 507, 508, 509])
@pytest.mark.parametrize("end", [b"", b"\0", b"\0\0", b"\x01"])
def test_cobs_at_the_ends_of_its_runs(length, end):
    data = b"\x07" * length + end
    assert load_cobs().encode(data) == stuff(data)
    assert decoded(stuff(data)) == data


@given(BYTES.map(lambda data: data.replace(b"\0", b"\x02")))
@example(b"\x03\x01")
def test_the_library_refuses_what_the_protocol_refuses(data):
    assert decoded(data) == unstuff(data)


def test_a_packet_with_a_zero_within_is_refused_by_the_library():
    assert decoded(b"\x03\x00\x01") is None


def test_without_the_library_a_codec_names_the_extra(monkeypatch):
    load_cobs.cache_clear()
    monkeypatch.setitem(sys.modules, "cobs", None)
    for use in (Receiver, lambda: encode(Packet(wire.PacketType.STOP_REPLY, 7))):
        with pytest.raises(NotInstalledError, match=r"cobs is not installed.*\[serial\]"):
            use()


@given(BYTES)
def test_the_crc_is_that_of_an_independent_implementation(data):
    assert zlib.crc32(data) == Crc32.calc(data)


# -- packets ------------------------------------------------------------


@given(st.lists(PACKETS, max_size=8), st.randoms(use_true_random=False))
def test_packets_come_through_however_the_bytes_are_cut(packets, dice):
    stream = b"".join(encode(packet) for packet in packets)
    receiver, got, at = Receiver(), [], 0
    while at < len(stream):
        step = dice.randint(1, 40)
        got += receiver.feed(stream[at : at + step])
        at += step
    assert got == packets
    assert not receiver.bad


@given(PACKETS, st.data())
def test_a_changed_packet_is_never_taken(packet, data):
    good = encode(packet)
    bad = bytearray(good)
    at = data.draw(st.integers(0, len(good) - 1))
    bad[at] ^= 1 << data.draw(st.integers(0, 7))
    assert [got for got in Receiver().feed(bytes(bad)) if got != packet] == []


@given(PACKETS, st.binary(max_size=300))
def test_a_packet_behind_noise_is_found(packet, noise):
    assert Receiver().feed(noise + encode(packet))[-1] == packet


def test_a_million_random_bytes_raise_nothing_and_fill_no_memory():
    dice = random.Random(4)
    receiver = Receiver()
    accepted = []
    for _ in range(1000):
        accepted += receiver.feed(dice.randbytes(1000))
        assert len(receiver._rest) <= wire.MAX_RAW + 2
    assert receiver.bad.total() + len(accepted) > 3000
    for packet in accepted:
        assert packet.type in list(wire.PacketType)


def test_rubbish_without_an_end_is_dropped_as_one_packet_that_is_too_long():
    receiver = Receiver()
    for _ in range(10_000):
        assert receiver.feed(b"\x11" * 100) == []
    assert len(receiver._rest) <= wire.MAX_RAW + 2
    good = Packet(wire.PacketType.STOP_REPLY, 7, bytes(8))
    assert receiver.feed(encode(good)) == [good]
    assert receiver.bad == {"length": 1}


def test_a_sound_packet_of_an_unknown_type_is_counted_and_dropped():
    receiver = Receiver()
    assert receiver.feed(encode(Packet(0x6F, 1))) == []
    assert receiver.bad == {"type": 1}


@pytest.mark.parametrize(
    "packet", [Packet(1, 1, bytes(246)), Packet(256, 1), Packet(1, 65536), Packet(1, -1)]
)
def test_what_is_no_packet_cannot_be_encoded(packet):
    with pytest.raises(ValueError, match="packet"):
        encode(packet)


# -- bodies ------------------------------------------------------------

CLASSES = [
    item
    for item in vars(wire).values()
    if isinstance(item, type) and issubclass(item, Body) and item is not Body
]


@pytest.mark.parametrize("body", CLASSES)
@pytest.mark.parametrize("fill", [0x00, 0x41])
def test_every_body_survives_packing(body, fill):
    data = bytes([fill]) * (body.LAYOUT.size + (6 if body.TAIL else 0))
    assert body.unpack(data).pack() == data


@pytest.mark.parametrize("body", CLASSES)
def test_a_body_of_a_wrong_length_is_a_protocol_error(body):
    size = body.LAYOUT.size
    wrong = [size + 1] if body.TAIL != "text" else []
    for length in [*wrong, *([size - 1] if size else [])]:
        with pytest.raises(ProtocolError, match=body.__name__):
            body.unpack(bytes(length))


def test_every_body_has_a_type_of_its_own():
    assert sorted(int(body.TYPE) for body in CLASSES) == sorted(int(kind) for kind in wire.PacketType)


def test_words_come_out_as_native_arrays():
    words = wire.ExchangeReply.unpack(b"\x34\x12\xff\x80").words
    assert words.dtype == np.uint16
    assert words.tolist() == [0x1234, 0x80FF]


def test_text_that_is_no_ascii_does_not_raise():
    reply = wire.HelloReply.unpack(bytes(wire.HelloReply.LAYOUT.size) + b"a\xffb")
    assert reply.board.startswith("a")


def test_seven_registers_cost_at_most_1_15_times_their_payload():
    scans = 182 // 14
    words = np.arange(7 * scans, dtype=np.uint16) * 719 | 0x8000
    on_the_wire = encode(Packet.of(wire.Scans(1, 0, 12_345_678, 14_652, words), 5))[1:]
    ratio = len(on_the_wire) / (14 * scans)
    assert ratio <= 1.15
    assert ratio * 14 * 819.2 < wire.BAUD / 10
