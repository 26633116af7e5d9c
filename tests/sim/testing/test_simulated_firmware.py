"""The model of the firmware by its packets, as PROTOCOL.md and protocol.toml have them."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from cobs import cobs

from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.firmware import SimulatedFirmware
from adis_gonio.sim.testing.pins import ChipPins, WorkClock
from fakes.virtual_clock import VirtualClock

NO_SESSION, UNKNOWN, LENGTH, BUSY, FRAME, WRITES, VALUE, REUSED, VERSION = range(1, 10)
HELLO, CONFIGURE, EXCHANGE, STREAM, STOP, RESET, STATISTICS = range(1, 8)
ERROR, SCANS = 0xFF, 0xC4


class Host:
    """Sends packets to the model and decodes its answers."""

    def __init__(self, **options) -> None:
        self.clock = VirtualClock(0.5)
        self.chip = SimulatedChip(World(seed=1), start_s=0.0)
        self.firmware = SimulatedFirmware(ChipPins(self.chip, self.clock), **options)
        self.id = 100

    def send(self, kind: int, body: bytes = b"", number: int | None = None) -> list[tuple[int, int, bytes]]:
        """Send a request under the next id, or under `number`; return the packets that come."""
        self.id = self.id + 1 if number is None else number
        raw = struct.pack("<BH", kind, self.id) + body
        self.firmware.feed(b"\0" + cobs.encode(raw + struct.pack("<I", zlib.crc32(raw))) + b"\0")
        return self.received()

    def received(self) -> list[tuple[int, int, bytes]]:
        packets = []
        while self.firmware.out:
            ready_s, data = self.firmware.out.popleft()
            self.clock.advance_to(ready_s)
            raw = cobs.decode(data[:-1])
            assert data.endswith(b"\0")
            assert zlib.crc32(raw[:-4]) == struct.unpack("<I", raw[-4:])[0]
            packets.append((*struct.unpack("<BH", raw[:3]), raw[3:-4]))
        return packets

    def asked(self, kind: int, body: bytes = b"") -> bytes:
        """Body of the reply to a request."""
        ((reply, number, answer),) = self.send(kind, body)
        assert (reply, number) == (kind | 0x80, self.id)
        return answer

    def refused(self, kind: int, body: bytes = b"", number: int | None = None) -> tuple[int, int]:
        """Code and detail of the refusal of a request."""
        ((reply, _, answer),) = self.send(kind, body, number)
        asked, code, detail = struct.unpack("<BBH", answer)
        assert (reply, asked) == (ERROR, kind)
        return code, detail


def hello(nonce: int = 7, version: int = 1) -> bytes:
    return struct.pack("<BI", version, nonce)


@pytest.fixture
def host() -> Host:
    made = Host()
    made.asked(HELLO, hello())
    return made


def test_a_hello_tells_version_limits_clocks_and_board():
    host = Host(start_us=2**32 - 100, drift=0.01, board="F1 0001")
    body = host.asked(HELLO, hello(nonce=9))
    version, _, _, _, capabilities, *rest = struct.unpack("<BBBBHBBBHII6I", body[:-7])
    assert (version, capabilities, body[-7:]) == (1, 0b111, b"F1 0001")
    assert rest[:4] == [100, 32, 230, 65_000]
    assert rest[4] == round(0.5e6 * 1.01) - 100, "the clock wraps at 2³²"
    assert rest[5:] == [9, 2_000_000, 1_000_000, 500_000, 250_000, 125_000, 0]


def test_a_request_without_a_session_and_another_version_are_refused():
    host = Host()
    assert host.refused(STOP) == (NO_SESSION, 0)
    assert host.refused(HELLO, hello(version=2)) == (VERSION, 1)
    assert host.refused(HELLO, b"\1") == (NO_SESSION, 0)
    host.asked(HELLO, hello())
    host.asked(STOP)
    host.firmware.restart()
    assert host.refused(STOP) == (NO_SESSION, 0)


@pytest.mark.parametrize(
    ("kind", "body", "code", "detail"),
    [
        (0, b"", UNKNOWN, 0),
        (9, b"", UNKNOWN, 0),
        (CONFIGURE, b"", LENGTH, 0),
        (CONFIGURE, struct.pack("<IHH", 124_999, 75, 160), VALUE, 0),
        (CONFIGURE, struct.pack("<IHH", 250_000, 65_001, 160), VALUE, 4),
        (CONFIGURE, struct.pack("<IHH", 250_000, 75, 65_001), VALUE, 6),
        (EXCHANGE, b"\0", LENGTH, 0),
        (EXCHANGE, b"\0\0", LENGTH, 0),
        (EXCHANGE, b"\0" + bytes(202), LENGTH, 0),
        (EXCHANGE, struct.pack("<BHH", 0, 0x3800, 0x4000), FRAME, 1),
        (EXCHANGE, struct.pack("<BHH", 0, 0xA011, 0xA111), WRITES, 2),
        (STREAM, struct.pack("<BBHI", 1, 4, 1, 0), LENGTH, 0),
        (STREAM, struct.pack("<BBHI33H", 1, 1, 1, 0, *[0x0A00] * 33), LENGTH, 0),
        (STREAM, struct.pack("<BBHIHH", 1, 4, 1, 0, 0x0A00, 0xA000), FRAME, 1),
        (STREAM, struct.pack("<BBHIH", 2, 4, 1, 0, 0x0A00), VALUE, 0),
        (STREAM, struct.pack("<BBHIH", 1, 0, 1, 0, 0x0A00), VALUE, 1),
        (STREAM, struct.pack("<BBHIH", 1, 116, 1, 0, 0x0A00), VALUE, 1),
        (STREAM, struct.pack("<BBHIH", 1, 4, 2, 0, 0x0A00), VALUE, 2),
        (STREAM, struct.pack("<BBHIH", 1, 4, 1, 1000, 0x0A00), VALUE, 4),
        (STOP, b"\0", LENGTH, 0),
        (RESET, b"\1", LENGTH, 0),
        (RESET, struct.pack("<H", 9), VALUE, 0),
        (RESET, struct.pack("<H", 50_001), VALUE, 0),
        (STATISTICS, b"\0", LENGTH, 0),
    ],
)
def test_a_request_that_cannot_be_is_refused_with_its_code_and_detail(host, kind, body, code, detail):
    assert host.refused(kind, body) == (code, detail)


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (EXCHANGE, b"\0" + 100 * struct.pack("<H", 0x3800)),
        (STREAM, struct.pack("<BBHI32H", 1, 1, 1, 0, *[0x0A00] * 32)),
        (STREAM, struct.pack("<BBHIH", 0, 115, 1, 0, 0x0A00)),
        (RESET, struct.pack("<H", 10)),
    ],
)
def test_a_request_at_its_limit_is_executed(host, kind, body):
    host.asked(kind, body)


def test_a_clock_that_is_not_offered_becomes_the_next_slower_one(host):
    assert host.asked(CONFIGURE, struct.pack("<IHH", 999_999, 9, 65_000)) == struct.pack(
        "<IHH", 500_000, 9, 65_000
    )
    assert struct.unpack("<I", host.asked(CONFIGURE, struct.pack("<IHH", 125_000, 65_000, 0))[:4]) == (
        125_000,
    )


def test_frames_are_exchanged_in_their_order_and_time(host):
    begin_s = host.clock.now_s()
    words = host.asked(EXCHANGE, struct.pack("<BHHHH", 1, 0x3800, 0xA011, 0x2000, 0))
    assert struct.unpack("<4H", words) == (0, 0x0402, 0, 0x0011)
    # The default: a frame every 160 µs at 250 kHz, then the reply of 19 bytes at 500 000 baud.
    frames_s = 3 * 160e-6 + 16 / 250e3
    assert host.clock.now_s() - begin_s == pytest.approx(frames_s + 17 * 10 / 500e3, abs=5e-5)
    assert struct.unpack_from("<IIII", host.asked(STATISTICS))[3] == 4, "frames in all"


@pytest.mark.parametrize(("stall_us", "period_us", "step_s"), [(5000, 0, 5.016e-3), (9, 7000, 7e-3)])
def test_frames_keep_the_stall_and_the_period(host, stall_us, period_us, step_s):
    host.asked(CONFIGURE, struct.pack("<IHH", 1_000_000, stall_us, period_us))
    begin_s = host.clock.now_s()
    host.asked(EXCHANGE, struct.pack("<B5H", 0, *[0x3800] * 5))
    assert host.clock.now_s() - begin_s == pytest.approx(4 * step_s, rel=0.1)


def test_a_repeated_request_gets_its_reply_again_and_is_not_executed_again(host):
    body = struct.pack("<BHH", 1, 0xA011, 0)
    (first,) = host.send(EXCHANGE, body)
    assert host.send(EXCHANGE, body, host.id) == [first]
    assert host.firmware.frames == 2
    assert host.refused(STOP, b"", host.id) == (REUSED, 0)
    assert host.send(STOP, b"", host.id - 1) == [], "an older id is a late duplicate"
    assert host.send(STOP | 0x80) == [], "the wrong direction"
    ((kind, _, body),) = host.send(STATISTICS, b"", 102 + 32_767)
    figures = struct.unpack_from("<7H", body, 16)
    assert kind == STATISTICS | 0x80
    # packets, CRC, COBS, length, discarded, repeated, overruns; the hello was the first packet
    assert figures == (7, 0, 0, 0, 2, 1, 0)
    assert host.send(STOP, b"", host.id - 32_768 & 0xFFFF) == []


def test_unsound_packets_are_counted_and_not_answered(host):
    for data in (
        b"\x05ab\0",  # no COBS
        cobs.encode(bytes(6)) + b"\0",  # too short
        cobs.encode(b"\3" * 253) + b"\0",  # too long
        cobs.encode(bytes(range(20))) + b"\0",  # wrong CRC
        b"\0\0",  # nothing
    ):
        host.firmware.feed(data)
    assert host.received() == []
    packets, crc, not_cobs, length = struct.unpack_from("<4H", host.asked(STATISTICS), 16)
    assert (packets, crc, not_cobs, length) == (2, 1, 1, 2)


def test_a_hello_with_a_new_nonce_is_new_whatever_its_id(host):
    host.asked(CONFIGURE, struct.pack("<IHH", 1_000_000, 9, 40))
    ((kind, number, _),) = host.send(HELLO, hello(nonce=8), 5)
    assert (kind, number) == (HELLO | 0x80, 5)
    begin_s = host.clock.now_s()
    host.asked(EXCHANGE, struct.pack("<BHH", 0, 0x3800, 0))
    assert host.clock.now_s() - begin_s > 160e-6, "the timing is the default again"


def test_a_reset_pulls_the_line_for_its_time(host):
    begin_s = host.clock.now_s()
    host.asked(RESET, struct.pack("<H", 50_000))
    assert host.clock.now_s() - begin_s > 0.05
    host.clock.sleep_s(0.2)
    words = host.asked(EXCHANGE, struct.pack("<BHH", 0, 0x3800, 0))
    assert struct.unpack("<HH", words)[1] == 0x0402


def test_a_stream_sends_scans_of_consecutive_updates_with_their_times_and_totals(host):
    host.asked(CONFIGURE, struct.pack("<IHH", 1_000_000, 9, 40))
    host.asked(EXCHANGE, struct.pack("<BHH", 1, 0xB404, 0))
    list_of_two = struct.pack("<BBHIHH", 1, 4, 1, 0, 0x0A00, 0x0E00)
    host.asked(STREAM, list_of_two)
    number = host.id
    for kind, body in ((CONFIGURE, struct.pack("<IHH", 250_000, 75, 160)), (STREAM, list_of_two)):
        assert host.refused(kind, body) == (BUSY, 0)
    host.firmware.run(host.clock.now_s() + 10.5 / 819.2)
    packets = host.received()
    assert [(kind, own) for kind, own, _ in packets] == [(SCANS, number)] * 2
    heads = [struct.unpack_from("<IHII", body) for _, _, body in packets]
    assert [head[:2] for head in heads] == [(0, 0), (4, 0)]
    assert [head[3] for head in heads] == pytest.approx([3e6 / 819.2] * 2, abs=2)
    assert heads[1][2] - heads[0][2] == pytest.approx(4e6 / 819.2, abs=2)
    words = np.frombuffer(packets[0][2][14:], "<u2").reshape(4, 2)
    assert (words & 0x8000).all(), "each word is new"
    *rest, (kind, _, totals) = host.send(STOP)
    assert [kind for kind, _, _ in rest] == [SCANS]
    sent = 8 + (len(rest[0][2]) - 14) // 4
    assert (kind, struct.unpack("<II", totals)) == (STOP | 0x80, (sent, 0))
    assert struct.unpack("<II", host.asked(STOP)) == (sent, 0), "the last totals come again"


@pytest.mark.parametrize("falling", [0, 1])
def test_a_scan_starts_at_the_edge_that_was_asked_for(host, falling):
    host.asked(CONFIGURE, struct.pack("<IHH", 1_000_000, 9, 40))
    host.asked(EXCHANGE, struct.pack("<BHH", 1, 0xB404, 0))  # data-ready is low for 50 µs after an update
    (begin_us,) = struct.unpack("<I", host.asked(STREAM, struct.pack("<BBHIH", falling, 1, 1, 0, 0x0A00)))
    assert begin_us == pytest.approx(1e6 * host.clock.now_s(), abs=1000)
    update_s = host.chip.next_update_s(host.clock.now_s())
    trigger_s = host.firmware.next_event_s()
    assert trigger_s - update_s == pytest.approx(0.0 if falling else 50e-6, abs=1e-9)
    host.firmware.run(trigger_s)
    ((_, _, body),) = host.received()
    assert struct.unpack_from("<IHII", body)[2] == pytest.approx(1e6 * trigger_s, abs=1)
    # Two frames of 40 and 16 µs begin some µs after the edge; 25 bytes follow at 500 000 baud.
    assert host.clock.now_s() - trigger_s == pytest.approx(60e-6 + 25 * 20e-6, abs=20e-6)


def test_a_line_that_is_too_slow_for_the_scans_loses_triggers_and_counts_them():
    host = Host(baud=20_000)
    host.asked(HELLO, hello())
    host.asked(EXCHANGE, struct.pack("<BHH", 1, 0xB404, 0))
    host.asked(STREAM, struct.pack("<BBHIH", 1, 1, 1, 0, 0x0A00))  # 25 bytes take 12.5 ms, an update 1.2 ms
    host.firmware.run(host.clock.now_s() + 0.2)
    assert len(host.received()) == pytest.approx(0.2 / 12.5e-3, abs=2)
    sent, lost = struct.unpack("<II", host.send(STOP)[-1][2])
    assert sent + lost == pytest.approx(0.2 * 819.2, abs=8)  # it began before its reply had come


def test_a_list_that_takes_longer_than_an_update_loses_every_other_trigger(host):
    host.asked(EXCHANGE, struct.pack("<BHH", 1, 0xB404, 0))
    host.asked(STREAM, struct.pack("<BBHI10H", 1, 4, 1, 0, *[0x0A00] * 10))  # 11 frames of 160 µs
    host.firmware.run(host.clock.now_s() + 20.5 / 819.2)
    heads = [struct.unpack_from("<IHII", body) for _, _, body in host.received()]
    assert [head[:2] for head in heads] == [(k, k) for k in range(len(heads))]
    assert {head[3] for head in heads} == {0}, "a packet has one scan, which ends before the next trigger"
    sent, lost = struct.unpack("<II", host.send(STOP)[-1][2])
    assert lost == pytest.approx(sent, abs=1)
    assert sent >= 9


def test_the_board_is_silent_until_it_has_started():
    host = Host(boot_s=1.0)
    assert host.send(HELLO, hello()) == []
    host.clock.sleep_s(1.0)
    assert host.send(HELLO, hello())[0][0] == HELLO | 0x80


# -- the pins ---------------------------------------------------------------------------------------------


def test_a_transfer_takes_its_time_and_follows_the_one_before():
    clock = VirtualClock(1.0)
    pins = ChipPins(SimulatedChip(World(seed=1)), clock)
    pins.transfer(b"\x38\x00", clock_hz=250e3, cs_hold_s=1e-3)
    assert clock.now_s() - 1.0 == pytest.approx(1.064e-3)
    reply = pins.transfer(b"\0\0", clock_hz=250e3, start_s=clock.now_s() + 1e-3)
    assert reply == b"\x04\x02"
    assert clock.now_s() - 1.0 == pytest.approx(2.128e-3)
    pins.transfer(b"\0\0", clock_hz=250e3, start_s=1.0)
    assert clock.now_s() - 1.0 == pytest.approx(2.192e-3), "not before the transfer before has ended"
    pins.transfer(b"\0\0", clock_hz=250e3, start_s=1.1, selected=False)
    pins.transfer(b"\0\0", clock_hz=250e3, start_s=1.1)
    assert clock.now_s() - 1.1 == pytest.approx(128e-6), "nor before one without chip select"
    assert pins.transfers == 5


def test_a_clock_of_work_runs_ahead_of_the_wall_and_never_back():
    clock = WorkClock()
    assert clock.now_s() < 5.0
    clock.advance_to(1000.0)
    clock.advance_to(5.0)
    assert clock.now_s() == 1000.0
    assert clock.wall_s() < 100.0
    clock.sleep_s(-1.0)


@pytest.mark.parametrize(
    "wrong", [{"mode": 0}, {"selected": False}, {"data": b"\x38"}, {"data": b"\x38\0\0"}, {"clock_hz": 5e6}]
)
def test_wrong_use_of_the_pins_gives_wrong_replies(wrong):
    pins = ChipPins(SimulatedChip(World(seed=1)), VirtualClock(1.0))
    pins.transfer(b"\x38\x00", clock_hz=250e3)
    pins.clock.sleep_s(1e-3)
    options = {"data": b"\0\0", "clock_hz": 250e3} | wrong
    reply = pins.transfer(options.pop("data"), **options)
    assert reply[:2] != b"\x04\x02"
    assert len(reply) == len(wrong.get("data", b"\0\0"))
