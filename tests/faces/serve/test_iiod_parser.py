"""iiod's grammar: what libiio's own client sends, cut anywhere, and what nobody should send."""

import random

import pytest
from hypothesis import given, strategies as st

from adis_gonio.faces.serve import iiod_protocol as protocol
from adis_gonio.faces.serve.iiod_protocol import (
    Close,
    Errno,
    Exit,
    Malformed,
    Open,
    Parser,
    Print,
    ReadAttribute,
    ReadBuffer,
    Target,
    Timeout,
    Version,
    WriteAttribute,
)

LINES = [
    (b"VERSION\r\n", Version()),
    (b"PRINT\r\n", Print()),
    (b"print\n", Print()),
    (b"TIMEOUT 2500\r\n", Timeout(2500)),
    (
        b"READ iio:device0 sampling_frequency\r\n",
        ReadAttribute(Target("iio:device0"), "sampling_frequency"),
    ),
    (
        b"READ iio:device0 INPUT accel_x raw\r\n",
        ReadAttribute(Target("iio:device0", "accel_x"), "raw"),
    ),
    (
        b"WRITE iio:device0 INPUT accel_x calibbias 4\r\n-12\0",
        WriteAttribute(Target("iio:device0", "accel_x"), "calibbias", b"-12\0"),
    ),
    (b"WRITE d a 3\nX\nY", WriteAttribute(Target("d"), "a", b"X\nY")),
    (b"OPEN iio:device0 256 000001ff\r\n", Open("iio:device0", 256, "000001ff")),
    (b"READBUF iio:device0 6144\r\n", ReadBuffer("iio:device0", 6144)),
    (b"WRITEBUF iio:device0 6144\r\n", protocol._NEVER["WRITEBUF"]),
    (b"GETTRIG iio:device0\r\n", protocol._NEVER["GETTRIG"]),
    (b"CLOSE iio:device0\r\n", Close("iio:device0")),
    (b"EXIT\r\n", Exit()),
]


@pytest.mark.parametrize(("line", "request_"), LINES, ids=lambda v: v[:24] if isinstance(v, bytes) else "")
def test_each_request_of_libiio_is_understood(line, request_):
    assert Parser().feed(line) == [request_]


@given(st.lists(st.integers(1, 40), max_size=60))
def test_it_does_not_matter_where_the_network_cuts(cuts):
    data, parser, requests = b"".join(line for line, _ in LINES), Parser(), []
    for cut in cuts:
        requests += parser.feed(data[:cut])
        data = data[cut:]
    requests += parser.feed(data)
    assert requests == [request for _, request in LINES]


@pytest.mark.parametrize(
    "line",
    [
        b"HELLO",
        b"OPEN iio:device0",
        b"OPEN iio:device0 many 000001ff",
        b"OPEN iio:device0 256 xyz",
        b"OPEN iio:device0 256 000001ff CYCLIC",
        b"READBUF iio:device0 -1",
        b"READBUF iio:device0 1e9",
        b"READ",
        b"READ iio:device0",
        b"READ iio:device0 DEBUG clients",
        b"READ iio:device0 INPUT accel_x",
        b"READ iio:device0 INPUT accel_x raw more",
        b"WRITE iio:device0 a x",
        b"TIMEOUT",
        b"SET iio:device0 BUFFERS 4",
        b"READ d\x00 a",
        b"READ \xff\xfe a",
        b"BINARY",
        b"ZPRINT",
    ],
)
def test_a_malformed_line_is_one_error_and_the_next_line_is_understood(line):
    requests = Parser().feed(line + b"\nVERSION\n")
    assert len(requests) == 2
    assert isinstance(requests[0], Malformed)
    assert requests[0].errno is Errno.EINVAL
    assert not requests[0].fatal
    assert requests[1] == Version()


def test_an_empty_line_has_no_answer():
    assert Parser().feed(b"\r\n\n \t\nVERSION\n") == [Version()]


@pytest.mark.parametrize("data", [b"A" * 2000, b"A" * 2000 + b"\n", b"WRITE d a 99999\nabc"])
def test_where_the_next_request_begins_is_not_guessed(data):
    parser = Parser()
    *_, last = parser.feed(data)
    assert isinstance(last, Malformed)
    assert last.fatal
    assert parser.feed(b"\nVERSION\n") == []
    assert len(parser._held) == 0


def test_200_kb_of_noise_neither_raises_nor_is_held():
    noise = random.Random(7)
    for _ in range(50):
        parser = Parser()
        for _ in range(8):
            parser.feed(noise.randbytes(512))
            assert len(parser._held) <= max(protocol.LINE_LIMIT, protocol.VALUE_LIMIT)
