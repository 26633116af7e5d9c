"""The CP2130 transport over the real pyusb on a fake backend, down to transfers."""

import contextlib
import errno
import struct
from types import SimpleNamespace
from typing import ClassVar

import pytest
from hypothesis import given, settings, strategies as st

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
    UsageError,
)
from adis_gonio.device.bus import SpiTiming, cp2130 as r
from adis_gonio.device.bus.cp2130 import find_devices
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import BusContract, Rig
from adis_gonio.sim.testing.faults import Faults
from fakes.benches import Cp2130Bench as Bench
from fakes.cp2130_device import OPEN_DRAIN, PUSH_PULL, READ_FIRST

usb_error = pytest.importorskip("fakes.cp2130_usb", reason="pyusb is not installed").usb_error


class TestCp2130(BusContract):
    latency_s = 0.1e-3
    url = "cp2130:?reset_gpio=5&event_counter=1"
    otp: ClassVar[dict] = {}

    def make(self) -> Rig:
        bench = Bench(latency_s=self.latency_s, **self.otp)
        bus = bench.open(self.url)

        faults = {
            "a reply too short": (lambda: setattr(bench.device, "short", True), ProtocolError),
            "stuck": (lambda: setattr(bench.device, "stuck", True), BusTimeoutError),
            "hung": (bench.silence, BusTimeoutError),
        }
        twin = SimulatedChip(World(seed=Bench.seed), start_s=-0.5)
        return Rig(bus, bench.chip, twin, faults, slowest_hz=93_750)


class TestCp2130OnAnImpossiblyFastCable(TestCp2130):
    """The stall must not rest upon USB being slow."""

    latency_s = 1e-7
    url = "cp2130:A1"


class TestCp2130WithHighPriorityRead(TestCp2130):
    """Its OTP swaps the endpoints."""

    otp: ClassVar[dict] = {"endpoints": READ_FIRST, "tells_all": True}


def test_a_frame_is_one_write_read_of_two_bytes_on_the_channel_that_was_named():
    bench = Bench()
    bench.device.cs_pin = 3
    with bench.open("cp2130:?cs=3") as bus:
        bus.configure(SpiTiming(1e6, 9, 40))
        before = bench.board.out_transfers
        assert bus.exchange([0x3800, 0x3600, 0])[1:] == [0x0402, 0x0001]
        assert bench.board.out_transfers == before + 3
    assert bench.device.words[3] == 0b111100
    assert bench.device.selected == [int(k == 3) for k in range(11)]
    assert bench.device.delays[3] == bytes(7)


@pytest.mark.parametrize(("transfer_s", "least", "most"), [(1e-3, 120, 125), (0.125e-3, 819.2, 1000)])
def test_scans_of_four_registers_come_at_the_rates_that_the_documentation_has(transfer_s, least, most):
    """A frame's two transfers in 2 ms; in 0.25 ms, which is faster than the chip samples."""
    bench = Bench(latency_s=transfer_s)
    with bench.open() as bus:
        bus.configure(SpiTiming(1e6, 9, 40))
        before = bench.clock.now_s()
        bus.exchange([0x0A00, 0x0C00, 0x0E00, 0x0400] * 50)
        assert least < 50 / (bench.clock.now_s() - before) < most


def test_a_clock_below_the_slowest_is_refused_and_the_old_one_stays():
    with Bench().open() as bus:
        before = bus.timing
        with pytest.raises(UsageError, match="slowest clock"):
            bus.configure(SpiTiming(50e3, 9, 40))
        assert bus.timing == before
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_the_otp_memory_is_never_touched():
    bench = Bench(faults=Faults(seed=2, drop=0.02, busy=0.05, stuck=0.02, short=0.02))
    for _ in range(20):
        with contextlib.suppress(BusError), bench.open("cp2130:?reset_gpio=5&event_counter=1") as bus:
            for _ in range(30):
                with contextlib.suppress(BusError):
                    bus.exchange([0x3800] * 5)
            bus.hard_reset()
    assert bench.device.otp_requests == 0


# -- which board ---------------------------------------------------------------------------------------


def test_a_failed_opening_gives_the_board_back():
    bench = Bench()
    bench.device.counter_mode = bench.device._mode = 0
    with pytest.raises(UsageError, match="event counter"):
        bench.open("cp2130:?event_counter=1")
    assert not bench.board.claimed
    bench.open().close()


@pytest.mark.parametrize("url", ["cp2130:", "cp2130:A1"])
def test_without_permission_the_message_carries_the_udev_rule(url):
    bench = Bench()
    bench.board.permitted = False
    with pytest.raises(CannotOpenError, match=r'no permission for /dev/bus/usb/001/005.*"87a0"') as caught:
        bench.open(url)
    assert "\n" not in str(caught.value)
    listed = find_devices(backend=bench.backend)[0]
    assert listed.url == "cp2130:?bus=1&address=5"
    assert "no permission" in listed.description


def test_without_libusb_the_extra_is_named(monkeypatch):
    monkeypatch.setattr("adis_gonio.device.bus.cp2130._libusb", lambda: None)
    with pytest.raises(NotInstalledError, match=r"\[usb\]"):
        find_devices()


def test_a_board_without_a_pair_of_bulk_endpoints_is_said_and_given_back():
    bench = Bench()
    describe = bench.backend.get_endpoint_descriptor

    def interrupt(*where):
        return SimpleNamespace(**vars(describe(*where)) | {"bmAttributes": 3})

    bench.backend.get_endpoint_descriptor = interrupt
    with pytest.raises(ProtocolError, match="no pair of bulk endpoints"):
        bench.open()
    assert not bench.board.claimed


# -- pins ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tells_all", [False, True])
@pytest.mark.parametrize("function", [OPEN_DRAIN, PUSH_PULL, 4])
@pytest.mark.parametrize("cs", [0, 3, 10])
def test_a_pin_that_is_no_chip_select_is_refused_by_name(cs, function, tells_all):
    bench = Bench(tells_all=tells_all)
    bench.device.cs_pin = cs
    bench.open(f"cp2130:?cs={cs}").close()
    bench.device.functions[cs] = function
    with pytest.raises(CannotOpenError, match=rf"GPIO\.{cs} .*no chip select.*\?cs=") as caught:
        bench.open(f"cp2130:?cs={cs}")
    assert "\n" not in str(caught.value)
    assert not bench.board.claimed
    bench.device.cs_pin = 1
    with bench.open("cp2130:?cs=1") as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402


@pytest.mark.parametrize("channels", [[], [1], [0, 1]])
def test_chip_selects_that_read_back_otherwise_are_refused(channels):
    bench = Bench()
    control_out = bench.device.control_out

    def ignore(request, value, index, data):
        control_out(request, value, index, data)
        if request == 0x25:
            bench.device.selected = [int(k in channels) for k in range(11)]

    bench.device.control_out = ignore
    with pytest.raises(ProtocolError, match="did not take its chip select"):
        bench.open()
    assert not bench.chip.seen


def test_the_event_counter_is_gpio_4_which_can_have_no_other_duty():
    for url in ("cp2130:?cs=4&event_counter=1", "cp2130:?reset_gpio=4&event_counter=1"):
        with pytest.raises(UsageError, match=r"GPIO\.4"):
            Bench().open(url)
    Bench().open("cp2130:?reset_gpio=4").close()
    bench = Bench(counter_mode=0)
    bench.device.cs_pin = 4
    with bench.open("cp2130:?cs=4") as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    with pytest.raises(UsageError, match=r"GPIO\.4 of this board is no event counter"):
        bench.open("cp2130:?event_counter=1")


def test_the_event_counter_goes_on_behind_its_overflow():
    bench = Bench()
    with bench.open("cp2130:?event_counter=1") as bus:
        bus.exchange([0xB404])
        seen = 0
        for _ in range(4):
            bus.sleep_s(30.0)
            seen += bus.read_event_counter()
        assert bench.device.control_in(0x44, 0, 0, 3)[0] & 0x80
        assert seen == pytest.approx(120 * 819.2, rel=0.05)
    with bench.open("cp2130:?event_counter=1") as bus:
        bus.sleep_s(1.0)
        assert bus.read_event_counter() == pytest.approx(819.2, rel=0.05)


@pytest.mark.parametrize("mode", [4, 5, 6, 7])
def test_the_event_counter_may_count_edges_or_pulses_of_either_kind(mode):
    bench = Bench(counter_mode=mode)
    with bench.open("cp2130:?event_counter=1") as bus:
        bus.exchange([0xB404])
        bus.sleep_s(1.0)
        assert bus.read_event_counter() == pytest.approx(819.2, rel=0.05)


# -- failures -------------------------------------------------------------------------------------------


def test_after_a_time_out_the_port_is_reset_and_set_up_anew():
    bench = Bench()
    bus = bench.open()
    bus.configure(SpiTiming(1e6, 9, 40))
    bench.device.stuck = True
    with pytest.raises(BusTimeoutError):
        bus.exchange([0])
    assert bench.board.resets == 1
    assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.chip.seen[-1].clock_hz == 750e3


@pytest.mark.parametrize("count", [1, 5, 30])
def test_replies_that_another_program_left_in_the_pipe_are_thrown_away_on_opening(count):
    bench = Bench()
    bench.board._waiting.extend([(0.0, b"\x12\x34")] * count)
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_replies_without_end_are_said():
    bench = Bench()
    bench.board.bulk_in = lambda size, timeout_ms: b"\x12\x34"
    with pytest.raises(ProtocolError, match="unexpected replies"):
        bench.open()
    assert not bench.board.claimed


@pytest.mark.parametrize(
    ("code", "error", "says"),
    [
        (errno.ENODEV, CannotOpenError, "gone"),
        (errno.ENOENT, CannotOpenError, "gone"),
        (errno.ESHUTDOWN, CannotOpenError, "gone"),
        (errno.EACCES, CannotOpenError, "permission"),
        (errno.ETIMEDOUT, BusTimeoutError, "no answer to a reply within"),
        (10060, BusTimeoutError, "no answer to a reply within"),  # as libusb0 says it on Windows
        (errno.EIO, ProtocolError, "a reply failed"),
    ],
)
def test_what_libusb_says_becomes_a_typed_error(code, error, says):
    bench = Bench()
    bus = bench.open()
    bulk_in = bench.board.bulk_in

    def fail(size, timeout_ms):
        bench.board.bulk_in = bulk_in
        raise usb_error(code, "x")

    bench.board.bulk_in = fail
    with pytest.raises(error, match=says):
        bus.exchange([0])
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_a_halt_of_the_pipe_out_is_ended_after_the_failure():
    bench = Bench()
    bus = bench.open()
    bench.board.out_is_halted = True
    with pytest.raises(ProtocolError, match="a frame failed"):
        bus.exchange([0])
    assert not bench.chip.seen
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_a_spi_word_that_reads_back_otherwise_is_refused():
    bench = Bench()
    control_out = bench.device.control_out
    bench.device.control_out = lambda request, *rest: (
        None if request == 0x31 else control_out(request, *rest)
    )
    with pytest.raises(ProtocolError, match="did not take its SPI word"):
        bench.open()


def test_a_command_that_left_in_part_is_an_error():
    bench = Bench()
    bus = bench.open()
    bulk_out = bench.board.bulk_out
    bench.board.bulk_out = lambda data, timeout_ms: bulk_out(data, timeout_ms) - 1
    with pytest.raises(ProtocolError, match="9 of 10 bytes"):
        bus.exchange([0])
    bench.board.bulk_out = bulk_out
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_after_a_port_reset_pins_counter_and_pace_are_as_they_were():
    bench = Bench()
    bus = bench.open("cp2130:?reset_gpio=5&event_counter=1")
    bus.configure(SpiTiming(1e6, 50_000.0, 50_000.0))
    bus.exchange([0xB404])
    bus.sleep_s(0.5)
    bench.device.functions[5], bench.device.stuck = 0, True
    with pytest.raises(BusTimeoutError):
        bus.exchange([0])
    at = bench.clock.now_s()
    assert bench.device.functions[5] == OPEN_DRAIN
    assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.chip.seen[-2].start_s - at >= 40e-3
    assert bus.read_event_counter() < 100, "edges from before the reset are not counted twice"
    bench.device.short = True
    with pytest.raises(ProtocolError):
        bus.exchange([0])
    assert bench.board.resets == 1, "for the time-out alone"


def test_a_frame_is_never_sent_again():
    bench = Bench()
    bus = bench.open()
    bench.board.faults = Faults(seed=1, short=1.0)
    with pytest.raises(ProtocolError, match="1 bytes"):
        bus.exchange([0xA012, 0])
    assert [f.word for f in bench.chip.seen] == [0xA012]


@pytest.mark.parametrize("layout", [">H", ">BH", ">HH", "11B"])
def test_a_reply_has_its_own_length_alone(layout):
    layout = struct.Struct(layout)
    assert set(r.unpack(bytes(layout.size), layout, "a reply")) == {0}
    for wrong in (layout.size - 1, layout.size + 1):
        with pytest.raises(ProtocolError, match=f"a reply of {wrong} bytes"):
            r.unpack(bytes(wrong), layout, "a reply")


@settings(deadline=None)
@given(st.binary(max_size=70))
def test_parsers_take_any_bytes(data):
    for layout in (">H", ">BH", ">HH", "11B"):
        with contextlib.suppress(ProtocolError):
            r.unpack(data, struct.Struct(layout), "a reply")
