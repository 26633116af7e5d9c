"""Rubbish from every bridge; scripts/fuzz_wire.py does it with ten million bytes each."""

import pytest

from adis_gonio.device.bus import mcp2210 as reports
from fakes import rubbish
from fakes.rubbish import FUZZERS, PARSERS, fuzz_parser

BYTES = 60_000


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("transport", FUZZERS)
def test_a_transport_fed_with_rubbish_raises_typed_errors_and_sends_no_write(transport, seed):
    found = FUZZERS[transport](BYTES, seed)
    assert found["answered"] > 10
    assert found["ProtocolError"] > 10


@pytest.mark.parametrize("parser", PARSERS)
def test_a_parser_takes_any_bytes(parser):
    found = fuzz_parser(parser, 20 * BYTES, 1)
    assert found["taken"] > 0


def test_a_transport_that_does_not_look_at_its_answers_is_noticed(monkeypatch):
    """The fuzzer itself: a transport that takes a short frame, and one whose parser fails otherwise."""
    progress = reports.progress

    def careless(answer: bytes) -> tuple[reports.Engine, bytes]:
        engine, data = progress(answer)
        return engine, data.ljust(2, b"\0") if engine is reports.Engine.FINISHED else data

    monkeypatch.setattr(rubbish.mcp2210, "progress", careless)
    with pytest.raises(AssertionError, match="wrong word"):
        FUZZERS["mcp2210"](20 * BYTES, 1)
    monkeypatch.setattr(rubbish.mcp2210, "progress", lambda answer: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        FUZZERS["mcp2210"](BYTES, 1)
