"""The Pico's UF2 in an emulated RP2040: image, boot, pins, and what it does on USB.

`make_pico` judges every rig at its end: no frame broke a limit, and nothing was done that the silicon does
not bear (blocks in reset, clocks, the USB controller's rules).
"""

from __future__ import annotations

import importlib.util
import re
import subprocess

import numpy as np
import pytest

from adis_gonio.device.bus.wire import Packet, encode
from adis_gonio.device.bus.wire.protocol import (
    ExchangeReply,
    ExchangeRequest,
    FirmwareCapability,
    PacketType,
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
from firmware import pico_build
from firmware.board_tests import (
    DATA_READY_ON,
    OUTPUTS,
    READABLE,
    PinTests,
    configure,
    connect,
    exchange,
    stream,
    trigger_times,
    words,
)
from firmware.client import Client

SYSTEM_HZ = 125e6
STACK_LIMIT = 4096
"""Of link.ld."""


class TestPins(PinTests):
    clocks_hz = (1_000_000, 500_000, 250_000, 125_000, 50_000, 20_000)

    @pytest.fixture
    def rig(self, make_pico):
        return make_pico(seed=3)

    @pytest.fixture
    def slow_rig(self, make_pico):
        rig = make_pico(seed=3)
        rig.host(in_every=53)  # 64 bytes every 3.2 ms
        return rig


@pytest.fixture
def rig(make_pico):
    return make_pico(seed=3)


def test_each_clock_that_the_board_tells_is_the_one_at_its_pins(rig):
    client = connect(rig)
    told = [hz for hz in client.hello(2).clocks_hz if hz]
    rig.log.keep_words = True
    for hz in told:
        assert configure(client, hz, 9, 40).clock_hz == hz
        exchange(client, [0x3600])
    assert [frame[3] for frame in rig.frames()] == told


@pytest.mark.parametrize("clock_hz", [1_000_000, 500_000, 250_000, 125_000])
def test_chip_select_rises_right_behind_the_last_clock_whatever_interrupts(rig, clock_hz):
    client = connect(rig)
    configure(client, clock_hz, 9, 40)
    rig.forget()
    rig.noise_on_ready(mean_us=90)
    body = ExchangeRequest(0, words([0x0200] * 32))
    for number in range(5000, 5020):
        client.send(body, number)
        rig.host(baud=number)  # control transfers while the frames run
        rig.port.send(bytes(300))  # empty packets
        client.answer(number, ExchangeReply)
    assert rig.log.frames > 500
    client.next_id = number
    assert client.request(StatisticsRequest(), StatisticsReply).edges > 100
    assert rig.state["most_ns"]["hold"] < 1000


def test_packets_that_leave_while_frames_run_delay_no_chip_select(rig):
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    rig.forget()
    rig.host(in_every=5)  # a packet of the host's every 0.3 ms: most fall into a scan of 0.7 ms
    packets, totals = stream(rig, client, READABLE[1:17], 0.5)
    assert len(packets) > 60
    assert totals.lost == 0
    assert rig.state["most_ns"]["hold"] < 1000


# -- image and boot -----------------------------------------------------------------


@pytest.fixture(scope="module")
def uf2_script():
    spec = importlib.util.spec_from_file_location("uf2", pico_build.PORT / "uf2.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_checksum_is_the_boot_roms(uf2_script):
    assert uf2_script.crc32(b"123456789") == 0x0376E6E7  # the check value of CRC-32/MPEG-2
    flash = uf2_script.image(b"\x01\x02", b"app")
    assert flash[:2] == b"\x01\x02"
    assert flash[256:] == b"app"
    assert uf2_script.crc32(flash[:252]) == int.from_bytes(flash[252:256], "little")


@pytest.mark.parametrize("size", [0, 253])
def test_a_second_stage_that_does_not_fit_is_refused(uf2_script, size):
    with pytest.raises(ValueError, match=f"boot2 has {size} bytes"):
        uf2_script.image(bytes(size), b"")


@pytest.mark.parametrize(
    ("at", "why"),
    [(32 + 3, "checksum"), (28, "block 0"), (512 + 20, "block 1"), (-1, "block")],
    ids=["boot2", "family", "number", "magic"],
)
def test_an_image_with_one_wrong_byte_does_not_start(pico_uf2, make_pico, tmp_path, at, why):
    image = bytearray(pico_uf2().read_bytes())
    image[at] ^= 0x10
    wrong = tmp_path / "wrong.uf2"
    wrong.write_bytes(image)
    with pytest.raises(RuntimeError, match=why):
        make_pico(wrong)


def test_flash_and_ram_are_within_their_limits_and_the_stack_is_far_from_its_own(pico_uf2, make_pico):
    image = pico_uf2()
    told = pico_build.make(image.parent, "size")
    assert re.fullmatch(r"flash \d+ of 16384 bytes, RAM \d+ of 16384 bytes\n", told)
    for limit in ("FLASH_LIMIT", "RAM_LIMIT"):
        with pytest.raises(RuntimeError, match="of 5000 bytes"):
            pico_build.make(image.parent, "size", f"{limit}=5000")
    symbols = subprocess.run(
        ["arm-none-eabi-nm", str(image.with_suffix(".elf"))],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout
    end = next(int(line.split()[0], 16) for line in symbols.splitlines() if line.endswith(" __bss_end"))
    rig = make_pico(seed=3)
    rig.paint_stack(end)
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    exchange(client, [0x0200] * 32)
    client.request(StreamRequest(Trigger.RISING, 13, 1, 0, words(OUTPUTS)), StreamReply)
    for _ in range(100):
        client.request(StatisticsRequest(), StatisticsReply)
    client.request(StopRequest(), StopReply)
    client.request(ResetRequest(20), ResetReply)
    rig.host(baud=1200)
    rig.sleep_s(0.1)
    stack = rig.deepest_stack(end)
    print(f"{told.strip()}; deepest stack {stack} bytes")  # noqa: T201
    assert 100 < stack < STACK_LIMIT / 4


def test_the_rigs_judge_and_chip_pass_their_own_tests(pico_uf2):
    run = subprocess.run(
        ["node", "--test", "judge.test.js"],
        cwd=pico_build.RIG,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert run.returncode == 0, run.stdout
    assert re.search(r"^# pass [1-9]", run.stdout, re.MULTILINE)


# -- data-ready and sleep --------------------------------------------------------------


@pytest.mark.parametrize("in_every", [1, 5])
def test_stamps_are_those_of_the_edges_to_the_microsecond(rig, in_every):
    """With a slow host its packets' interrupts fall on edges too, which go first."""
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    rig.host(in_every=in_every)
    packets, totals = stream(rig, client, OUTPUTS, 0.5, scans=1)
    edges_us = np.array(rig.edges_ns) / 1000
    stamps = [packet.first_us for packet in packets]
    late = [stamp - edges_us[np.searchsorted(edges_us, stamp + 1) - 1] for stamp in stamps]
    assert len(late) == totals.scans > 400
    assert min(late) >= -1
    assert max(late) < 2


def test_a_stream_by_period_begins_its_scans_on_time_although_the_processor_sleeps(rig):
    client = connect(rig)
    configure(client, 1_000_000, 9, 40)
    rig.log.keep_words = True
    packets, totals = stream(rig, client, [0x0200], 0.3, trigger=Trigger.PERIOD, period_us=1000)
    falls_us = np.array([frame[1] for frame in rig.frames()])[::2] / 1000
    begun = np.concatenate([trigger_times([packet], 1) for packet in packets])
    assert totals.lost == 0
    late = falls_us[: len(begun)] - begun
    assert late.min() >= 0
    assert late.max() < 10


def test_the_processor_sleeps_while_there_is_nothing_to_do(rig):
    client = connect(rig)
    before = rig.state["cycles"]
    rig.sleep_s(0.5)
    assert rig.state["cycles"] - before < 0.01 * 0.5 * SYSTEM_HZ
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    before = rig.state["cycles"]
    _, totals = stream(rig, client, OUTPUTS, 0.5)
    assert totals.lost == 0
    # eight frames of 40 µs in 1221 µs are 26 %, and the packets come on top
    assert 0.2 < (rig.state["cycles"] - before) / (0.5 * SYSTEM_HZ) < 0.4


# -- USB -----------------------------------------------------------------------------


def test_the_host_learns_who_made_the_board_and_which_one_it_is(rig):
    usb = rig.state["usb"]
    assert (usb["vid"], usb["pid"]) == (0x1209, 0x0001)
    assert usb["manufacturer"] == "adis-gonio"
    assert usb["product"] == "adis-gonio bridge (RP2040)"
    hello = connect(rig).hello(9)
    assert hello.board == f"rp2040 {usb['serial_number']}"
    assert hello.board == "rp2040 E6614103E735292B"  # the number in the emulated flash
    assert hello.capabilities == sum(FirmwareCapability)


def test_the_host_that_comes_with_the_emulator_gets_on_with_it_too(make_pico):
    client = connect(make_pico(stock_host=True))
    configure(client, 1_000_000, 9, 40)
    for _ in range(5):
        assert exchange(client, [0x3600] * 32)[1:] == [1] * 31


def test_a_maker_builds_with_their_own_numbers(pico_uf2, make_pico):
    usb = make_pico(pico_uf2(VID="0x2E8A", PID="0x1234")).state["usb"]
    assert (usb["vid"], usb["pid"]) == (0x2E8A, 0x1234)


def test_the_baud_rate_changes_nothing(rig):
    client = connect(rig)
    for baud in (300, 115_200, 4_000_000):
        rig.host(baud=baud)
        before = rig.now_s()
        assert exchange(client, [0x3600, 0])[1] == 1
        assert rig.now_s() - before < 0.01


def test_replies_that_fill_a_packet_arrive_at_once(rig):
    """31 and 33 bytes lie behind a first reply and leave as one packet of 64: an empty one must follow."""
    client = connect(rig)
    rig.host(in_every=300)
    requests = [(5001, 1), (5002, 11), (5003, 12)]
    for number, count in requests:
        client.send(ExchangeRequest(0, words([0x3600] * count)), number)
    end = rig.now_s() + 0.5
    answers = []
    while rig.now_s() < end:
        answers += client.poll(0.01)
    assert [(packet.id, packet.type, len(packet.body) // 2) for packet in answers] == [
        (number, PacketType.EXCHANGE_REPLY, count) for number, count in requests
    ]


def test_a_host_that_stops_reading_loses_scans_which_are_counted_and_the_stream_goes_on(rig):
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    client.request(StreamRequest(Trigger.RISING, 13, 1, 0, words(OUTPUTS)), StreamReply)
    rig.sleep_s(0.2)
    rig.host(in_every=5000)  # 0.3 s without a read
    rig.sleep_s(0.5)
    rig.host(in_every=1)
    rig.sleep_s(0.2)
    totals = client.request(StopRequest(), StopReply)
    packets = client.take_scans()
    scans = sum(packet.words.size for packet in packets) // 7
    assert totals.scans == scans
    assert 300 < totals.lost < 450
    gaps = np.rint(np.diff(trigger_times(packets, 7)) * 819.2e-6).astype(int) - 1
    assert gaps.sum() == packets[-1].lost == totals.lost


def test_a_new_program_finds_a_board_that_still_streams_for_one_that_died(rig):
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    client.request(StreamRequest(Trigger.RISING, 13, 1, 0, words(OUTPUTS)), StreamReply)
    rig.host(in_every=100_000)  # nobody reads
    rig.sleep_s(0.5)
    rig.host(in_every=1, baud=115_200)
    second = Client(rig.port)
    assert second.hello(nonce=2).board.startswith("rp2040")
    assert exchange(second, [0x3600, 0])[1] == 1
    frames = rig.log.frames
    rig.sleep_s(0.1)
    assert rig.log.frames == frames


def test_cleared_endpoints_begin_anew_without_a_loss(rig):
    client = connect(rig)
    exchange(client, DATA_READY_ON)
    configure(client, 1_000_000, 9, 40)
    client.request(StreamRequest(Trigger.RISING, 1, 1, 0, words(OUTPUTS)), StreamReply)
    for _ in range(20):
        rig.sleep_s(0.0137)
        rig.host(clear_halt=1)
        client.request(StatisticsRequest(), StatisticsReply)
    totals = client.request(StopRequest(), StopReply)
    assert totals.lost == 0
    assert len(client.take_scans()) == totals.scans > 200
    assert client.retries == 0


def test_noise_is_no_request_and_the_next_request_is_answered(rig):
    client = connect(rig)
    before = rig.log.frames
    noise = np.random.default_rng(8).bytes(20_000)
    for at in range(0, len(noise), 500):
        rig.port.send(noise[at : at + 500])
        client.poll(0.01)
    rig.port.send(b"\0")
    counts = client.request(StatisticsRequest(), StatisticsReply)
    assert counts.receive_overruns == 0
    assert counts.cobs_errors + counts.crc_errors + counts.length_errors > 50
    assert rig.log.frames == before
    assert exchange(client, [0x3600, 0])[1] == 1


def test_a_request_longer_than_the_firmwares_buffers_holds_the_host_off_and_loses_nothing(rig):
    """62 ms of frames run while seven more requests lie in the host's queue."""
    client = connect(rig)
    configure(client, 125_000, 9, 2000)
    requests = range(6000, 6008)
    client.next_id = 6100
    for number in requests:
        client.send(ExchangeRequest(0, words(READABLE[:31])), number)
    for number in requests:
        client.answer(number, ExchangeReply)
    assert client.request(StatisticsRequest(), StatisticsReply).packets == 2 + len(requests) + 1


def test_a_powered_board_without_a_session_says_so(rig):
    client = Client(rig.port)
    rig.port.send(encode(Packet.of(StatisticsRequest(), 77)))
    (packet,) = client.poll(0.05)
    assert (packet.id, packet.type, packet.body[1]) == (77, PacketType.ERROR, 1)
