"""The MCP2210 transport over a fake module hid, down to reports."""

import contextlib
import struct

import pytest
from hypothesis import given, settings, strategies as st

from adis_gonio.base.errors import (
    BusError,
    BusTimeoutError,
    CannotOpenError,
    NotInstalledError,
    ProtocolError,
)
from adis_gonio.device.bus import BusUrl, SpiTiming, mcp2210 as r
from adis_gonio.device.bus.mcp2210 import find_devices, open_from_url
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import BusContract, Rig
from adis_gonio.sim.testing.faults import Faults
from fakes.benches import Mcp2210Bench as Bench
from fakes.mcp2210_device import CHIP_SETTINGS, SETTINGS


class TestMcp2210(BusContract):
    latency_s = 0.5e-3
    url = "mcp2210:?reset_gpio=3&event_counter=1"

    def make(self) -> Rig:
        bench = Bench(latency_s=self.latency_s)
        self.bench = bench
        bus = bench.open(self.url)

        faults = {
            "an answer too short": (lambda: setattr(bench.device, "short", True), ProtocolError),
            "busy for ever": (lambda: setattr(bench.device, "busy", 2), CannotOpenError),
            "hung": (bench.silence, BusTimeoutError),
        }
        twin = SimulatedChip(World(seed=Bench.seed), start_s=-0.5)
        return Rig(bus, bench.chip, twin, faults, slowest_hz=1_500)


class TestMcp2210OnAnImpossiblyFastCable(TestMcp2210):
    """The stall must not rest upon USB being slow."""

    latency_s = 1e-7
    url = "mcp2210:A1"


def test_a_frame_is_one_transaction_of_two_bytes_in_mode_3_with_cs_on_the_pin_that_was_named():
    bench = Bench()
    bench.device.cs_pin = 4
    with bench.open("mcp2210:?cs=4") as bus:
        bus.configure(SpiTiming(1e6, 9, 40))
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    spi = bench.device.spi
    assert (spi.transaction, spi.mode, spi.idle_cs, spi.active_cs) == (2, 3, 0x1FF, 0x1EF)
    assert (spi.cs_to_data, spi.last_to_cs, spi.between) == (0, 0, 0)


@pytest.mark.parametrize(("report_s", "scans_per_s"), [(1e-3, 62), (1.5e-3, 42)])
def test_scans_of_four_registers_come_at_the_rates_that_the_documentation_has(report_s, scans_per_s):
    """500 and 333 commands a second."""
    bench = Bench(latency_s=report_s)
    with bench.open() as bus:
        bus.configure(SpiTiming(1e6, 9, 40))
        before = bench.clock.now_s()
        bus.exchange([0x0A00, 0x0C00, 0x0E00, 0x0400] * 50)
        assert 50 / (bench.clock.now_s() - before) == pytest.approx(scans_per_s, abs=1)


def test_other_pins_and_settings_stay_as_the_board_had_them():
    bench = Bench()
    bench.device.designations[7] = 2
    bench.device.flags = 0b10001
    bench.device.outputs, bench.device.directions = 0x0AA, 0x155
    bench.open("mcp2210:?cs=1&reset_gpio=3").close()
    assert bytes(bench.device.designations) == bytes([0, 1, 0, 0, 0, 0, 0, 2, 0])
    assert bench.device.flags == 0b10001
    assert (bench.device.outputs, bench.device.directions) == (0x0AA, 0x155 | 1 << 3)


def test_neither_nvram_nor_eeprom_is_ever_written():
    bench = Bench(faults=Faults(seed=3, drop=0.02, busy=0.05, stuck=0.02, short=0.02))
    for _ in range(20):
        with _anything(), bench.open("mcp2210:?reset_gpio=3") as bus:
            for _ in range(30):
                with _anything():
                    bus.exchange([0x3800] * 5)
            with _anything():
                bus.hard_reset()
    used = {report[0] for report in bench.board.sent}
    assert used <= {0x11, 0x12, 0x20, 0x21, 0x30, 0x31, 0x32, 0x33, 0x40, 0x41, 0x42, 0x50}
    assert bench.device.nvram_writes == 0


class _anything:  # noqa: N801
    """Lets typed errors of the bus pass, and nothing else."""

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        return kind is not None and issubclass(kind, BusError)


# -- which board ------------------------------------------------------------------------------------


def test_a_failed_opening_gives_the_board_back():
    bench = Bench()
    bench.board.faults = Faults(drop=1.0)
    with pytest.raises(BusTimeoutError):
        bench.open()
    bench.board.faults = Faults()
    bench.open().close()


def test_without_permission_the_message_carries_the_udev_rule(monkeypatch):
    bench = Bench()
    monkeypatch.setattr("adis_gonio.device.bus.host.permission_note", lambda path: ", no permission")
    with pytest.raises(CannotOpenError, match=r'no permission.*devices --udev.*"04d8"') as caught:
        bench.open()
    assert "\n" not in str(caught.value)
    assert "no permission" in find_devices(hid=bench.hid)[0].description


def test_a_module_hid_of_another_package_is_named(monkeypatch):
    monkeypatch.setattr("importlib.import_module", lambda name: object())
    with pytest.raises(NotInstalledError, match="pip uninstall hid"):
        open_from_url(BusUrl.parse("mcp2210:"))


def test_without_hidapi_the_extra_is_named(monkeypatch):
    def refuse(name):
        raise ImportError(name)

    monkeypatch.setattr("importlib.import_module", refuse)
    with pytest.raises(NotInstalledError, match=r"\[hid\]"):
        open_from_url(BusUrl.parse("mcp2210:"))
    with pytest.raises(NotInstalledError, match=r"\[hid\]"):
        find_devices()


# -- failures ----------------------------------------------------------------------------------------


def test_a_refused_transfer_is_cancelled_and_tried_once_more():
    bench = Bench()
    bus = bench.open()
    for arm in (lambda: setattr(bench.device, "busy", 1), lambda: setattr(bench.device, "stuck", True)):
        arm()
        cancels = bench.device.cancels
        before = len(bench.chip.seen)
        assert bus.exchange([0x3800, 0])[1] == 0x0402
        assert bench.device.cancels == cancels + 1
        assert len(bench.chip.seen) == before + 2, "what was refused was not clocked"
    bus.close()


def test_opening_frees_an_engine_that_another_program_left_stuck():
    bench = Bench()
    bench.device.stuck = True
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_after_a_cancel_the_stall_counts_from_there_because_it_may_have_raised_cs():
    bench = Bench()
    with bench.open() as bus:
        bus.configure(SpiTiming(1e6, 50_000.0, 50_000.0))
        bus.exchange([0])
        bench.clock.sleep_s(1.0)
        bench.device.stuck = True
        before = bench.clock.now_s()
        bus.exchange([0])
        assert bench.chip.seen[-1].start_s - before >= 50e-3


@pytest.mark.parametrize(("count", "error"), [(10, None), (100, ProtocolError)])
def test_answers_of_others_are_thrown_away_but_not_for_ever(count, error):
    bench = Bench()
    with bench.open() as bus:
        write, foreign = bench.board.write, bytes([0x61]) + bytes(63)

        def crowded(report):
            bench.board.answers.extend([(bench.clock.now_s() + 1e-6, foreign)] * count)
            return write(report)

        bench.board.write = crowded
        if error is None:
            assert bus.exchange([0x3800, 0])[1] == 0x0402
        else:
            with pytest.raises(error, match="only answers to other commands"):
                bus.exchange([0x3800, 0])
        bench.board.write = write
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def spoiled(bench, command, change):
    """Let every answer to a command pass through `change`."""
    report = bench.device.report
    bench.device.report = lambda request: (
        change(bytearray(report(request))) if request[0] == command else report(request)
    )


@pytest.mark.parametrize(
    ("at", "value"),
    [(4, 0x91), (6, 0xFF), (8, 0xFE), (10, 0xFD), (12, 1), (14, 1), (16, 1), (18, 4), (20, 0)],
)
def test_settings_that_read_back_otherwise_are_refused(at, value):
    """Rate, idle and active CS, the three delays, the transaction's length, the mode."""
    bench = Bench()

    def change(answer):
        answer[at] = value
        return bytes(answer)

    spoiled(bench, 0x41, change)
    with pytest.raises(ProtocolError, match="did not take its settings"):
        bench.open()


def test_a_bit_rate_of_zero_is_refused():
    bench = Bench()
    spoiled(bench, 0x41, lambda answer: bytes(answer[:4]) + bytes(4) + bytes(answer[8:]))
    with pytest.raises(ProtocolError, match="did not take its settings"):
        bench.open()


def test_data_in_the_answer_that_accepts_a_transfer_are_an_error():
    for engine in (0x10, 0x20, 0x30):
        bench = Bench()
        with bench.open() as bus:
            spoiled(
                bench, 0x42, lambda answer, engine=engine: bytes([0x42, 0, 2, engine, 0x12, 0x34]).ljust(64)
            )
            with pytest.raises(ProtocolError, match="data before the transfer has started"):
                bus.exchange([0])


def test_the_event_counter_counts_rising_edges_from_the_opening_on():
    bench = Bench()
    bench.device.flags = 0b11111
    with bench.open("mcp2210:?event_counter=1") as bus:
        assert bench.device.flags == 0b10101
        bus.exchange([0xB404])
    bench.clock.sleep_s(2.0)
    with bench.open("mcp2210:?event_counter=1") as bus:
        assert bus.read_event_counter() < 100


def test_another_master_on_the_bus_is_said():
    bench = Bench()
    bus = bench.open()
    bench.device.external_owner = True
    with pytest.raises(CannotOpenError, match="another master"):
        bus.exchange([0])
    bench.device.external_owner = False
    assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_every_failure_ends_in_a_cancel():
    bench = Bench()
    bus = bench.open()
    bench.device.short = True
    cancels = bench.device.cancels
    with pytest.raises(ProtocolError, match="1 of 2 bytes"):
        bus.exchange([0, 0])
    assert bench.device.cancels == cancels + 1


def test_an_accepted_frame_is_never_sent_again():
    bench = Bench()
    bus = bench.open()
    bench.device.slow_polls = 10**4
    with pytest.raises(BusTimeoutError, match="does not finish"):
        bus.exchange([0xA012, 0])
    assert [f.word for f in bench.chip.seen] == [0xA012]
    bench.device.slow_polls = 0


@pytest.mark.parametrize("polls", [1, 2, 7])
def test_a_poll_that_is_answered_by_transfer_in_progress_is_repeated_and_the_frame_is_not(polls):
    bench = Bench()
    with bench.open() as bus:
        for word in (0x3800, 0x3600):
            bench.device.busy_polls = polls
            cancels, sent = bench.device.cancels, len(bench.chip.seen)
            assert bus.exchange([word, 0])[1] == {0x3800: 0x0402, 0x3600: 0x0001}[word]
            assert bench.device.busy_polls == 0
            assert bench.device.cancels == cancels
            assert [frame.word for frame in bench.chip.seen[sent:]] == [word, 0]


def test_a_transfer_in_progress_without_end_is_a_time_out_and_a_cancel_frees_the_bus():
    bench = Bench()
    with bench.open("mcp2210:?timeout_ms=100") as bus:
        bench.device.busy_polls = 10**4
        before, cancels = bench.clock.now_s(), bench.device.cancels
        with pytest.raises(BusTimeoutError, match=r"does not finish a frame within 0\.1 s"):
            bus.exchange([0xA012, 0])
        assert 0.1 <= bench.clock.now_s() - before < 0.12
        assert bench.device.cancels == cancels + 1
        bench.device.busy_polls = 0
        assert [frame.word for frame in bench.chip.seen] == [0xA012]
        assert bus.exchange([0x3800, 0])[1] == 0x0402


def test_a_poll_that_is_refused_for_another_master_is_no_transfer_in_progress():
    bench = Bench()
    with bench.open() as bus:
        report = bench.device.report

        def lose_the_bus(request):
            answer = report(request)
            bench.device.external_owner = request[0] == 0x42
            return answer

        bench.device.report = lose_the_bus
        with pytest.raises(ProtocolError, match="another master"):
            bus.exchange([0])


def test_the_late_answer_of_an_earlier_cancel_is_not_taken_for_that_of_the_last():
    bench = Bench()
    bus = bench.open()
    board, write = bench.board, bench.board.write
    # What becomes of each request: its answer is late by so much, lost, or it does not even arrive.
    fates = ["lost", 0.35, 0.4, 0.05, "not sent", 0.0]

    def fateful(report):
        fate = fates.pop(0) if fates else 0.0
        if fate == "not sent":
            return True
        write(report)
        arrival, answer = board.answers.pop()
        if fate != "lost":
            board.answers.append((arrival + fate, answer))
        return True

    board.write = fateful
    for frame in (0x3800, 0x3600, 0x3800):
        with _anything():
            assert bus.exchange([frame, 0])[1] == {0x3800: 0x0402, 0x3600: 0x0001}[frame]
    assert bus.exchange([0x3600, 0])[1] == 0x0001


# -- parsers ------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(st.binary(max_size=70))
def test_parsers_take_any_bytes(data):
    with contextlib.suppress(ProtocolError):
        r.progress(data)
    for layout in (CHIP_SETTINGS, SETTINGS):
        with contextlib.suppress(ProtocolError):
            r.unpack(data, r.Command.EVENTS, layout)


@settings(deadline=None)
@given(st.binary(min_size=63, max_size=63))
def test_a_progress_never_carries_more_than_a_frame(data):
    with contextlib.suppress(ProtocolError):
        assert len(r.progress(b"\x42" + data)[1]) <= 2


def test_parsers_refuse_what_is_not_theirs():
    bench = Bench()
    bench.device.designations[8] = 3
    with pytest.raises(ProtocolError, match="designation"):
        bench.open()
    with pytest.raises(ProtocolError, match=r"0x12 .* 0x42"):
        r.progress(bytes([0x12]).ljust(64, b"\0"))
    word, layout = bytes([0x31, 0, 0, 0, 0xFE, 0x01]).ljust(64), struct.Struct("<H")
    assert r.unpack(word, r.Command.GET_GPIO_VALUES, layout) == (0x1FE,)
    with pytest.raises(ProtocolError, match="GET_GPIO_VALUES is refused: the SPI engine is busy"):
        r.unpack(word.replace(b"\x31\x00", b"\x31\xf8"), r.Command.GET_GPIO_VALUES, layout)
    assert r.is_mark(bytes([0x50, 0, 7]).ljust(64), 7)
    assert not r.is_mark(bytes([0x12, 0, 7]).ljust(64), 7)


def test_a_device_that_takes_no_report_is_a_time_out_and_nothing_more_is_sent_to_it():
    bench = Bench()
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
        tried = []

        def refuse(data):
            tried.append(data)
            bus.sleep_s(5.0)  # the kernel's limit
            return -1

        takes, bus._device.write = bus._device.write, refuse
        with pytest.raises(BusTimeoutError, match="takes no report"):
            bus.exchange([0x3800, 0])
        assert len(tried) == 1
        bus._device.write = lambda data: -1
        with pytest.raises(CannotOpenError, match="gone"):
            bus.exchange([0x3800, 0])
        bus._device.write = takes
        assert bus.exchange([0x3800, 0])[1] == 0x0402
