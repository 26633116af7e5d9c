"""iiod's grammar: what libiio's own client sends, cut anywhere, and what nobody should send."""

import asyncio
import random

import pytest
from hypothesis import given, strategies as st

from adis_gonio.faces.serve import iiod_protocol as protocol
from adis_gonio.faces.serve.iiod_protocol import Errno, Request, read_request

LINES = [
    (b"VERSION\r\n", Request(("VERSION",))),
    (b"print\n", Request(("PRINT",))),
    (b"TIMEOUT 2500\r\n", Request(("TIMEOUT", "2500"))),
    (
        b"READ iio:device0 INPUT accel_x raw\r\n",
        Request(("READ", "iio:device0", "INPUT", "accel_x", "raw")),
    ),
    (
        b"WRITE iio:device0 INPUT accel_x calibbias 4\r\n-12\0",
        Request(("WRITE", "iio:device0", "INPUT", "accel_x", "calibbias", "4"), b"-12\0"),
    ),
    (b"WRITE d a 3\nX\nY", Request(("WRITE", "d", "a", "3"), b"X\nY")),
    (b"OPEN iio:device0 256 000001ff\r\n", Request(("OPEN", "iio:device0", "256", "000001ff"))),
    (b"EXIT\r\n", Request(("EXIT",))),
]


def requests_in(pieces):
    """The requests in the bytes of a connection that arrive in these pieces, and the reader at its end."""

    async def read():
        reader, requests = asyncio.StreamReader(limit=protocol.LINE_LIMIT), []

        async def listen():
            while Errno.E2BIG not in requests:
                requests.append(await read_request(reader))

        task = asyncio.create_task(listen())
        for piece in pieces:
            reader.feed_data(piece)
            await asyncio.sleep(0)
        reader.feed_eof()
        await asyncio.gather(task, return_exceptions=True)
        assert task.exception() is None or isinstance(task.exception(), asyncio.IncompleteReadError)
        return requests

    return asyncio.run(read())


@pytest.mark.parametrize(("line", "request_"), LINES, ids=lambda v: v[:24] if isinstance(v, bytes) else "")
def test_each_request_of_libiio_is_understood(line, request_):
    assert requests_in([line]) == [request_]


@given(st.lists(st.integers(1, 40), max_size=60))
def test_it_does_not_matter_where_the_network_cuts(cuts):
    data, pieces = b"".join(line for line, _ in LINES), []
    for cut in cuts:
        pieces.append(data[:cut])
        data = data[cut:]
    assert requests_in([*pieces, data]) == [request for _, request in LINES]


@pytest.mark.parametrize("line", [b"WRITE iio:device0 a x", b"READ d\x00 a", b"READ \xff\xfe a"])
def test_a_malformed_line_is_one_error_and_the_next_line_is_understood(line):
    assert requests_in([line + b"\nVERSION\n"]) == [Errno.EINVAL, Request(("VERSION",))]


def test_an_empty_line_has_no_answer():
    assert requests_in([b"\r\n\n \t\nVERSION\n"]) == [Request(("VERSION",))]


@pytest.mark.parametrize("data", [b"A" * 2000, b"A" * 2000 + b"\n", b"WRITE d a 99999\nabc"])
def test_where_the_next_request_begins_is_not_guessed(data):
    assert requests_in([data, b"\nVERSION\n"]) == [Errno.E2BIG]


def test_200_kb_of_noise_does_not_raise():
    noise = random.Random(7)
    for _ in range(50):
        requests_in([noise.randbytes(512) for _ in range(8)])
