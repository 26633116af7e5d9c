"""What the transports of all bridges have in common: choosing a board, faults, time-outs, options.

The contract of all buses is proved in each transport's own file, with what only that bridge has.
"""

import contextlib
import itertools
from functools import partial

import numpy as np
import pytest

from adis_gonio.base.errors import BusError, BusTimeoutError, CannotOpenError, UsageError
from adis_gonio.device.bus import Capability, SpiTiming
from adis_gonio.sim.testing.bus_contract import DATA_READY_ON
from adis_gonio.sim.testing.faults import Faults

pytest.importorskip("usb", reason="pyusb is not installed")
from fakes.benches import Cp2130Bench, Mcp2210Bench, SerialBench, SpidevBench, StoppedHost

FAST = SpiTiming(1e6, 9.0, 40.0)
USB = {"cp2130": Cp2130Bench, "mcp2210": Mcp2210Bench}
BENCHES = {**USB, "serial": SerialBench, "spidev": SpidevBench}
FAILURES = {
    "cp2130": ("drop", "delay", "busy", "stuck", "short"),
    "mcp2210": ("drop", "duplicate", "flip", "delay", "busy", "stuck", "short"),
    "serial": ("drop", "duplicate", "flip", "delay", "chunk"),
    "spidev": ("drop", "hang", "busy", "short"),
}
"""What can go wrong on the way to each bridge, at 1 % of the transfers each."""
each_usb = pytest.mark.parametrize("bridge", USB)


# -- which board --------------------------------------------------------------------------------------


@each_usb
def test_boards_are_listed_and_told_apart_by_serial_number(bridge):
    bench = USB[bridge](("A1", "B2"))
    assert bench.urls() == [f"{bridge}:A1", f"{bridge}:B2"]
    with bench.open(f"{bridge}:B2") as bus:
        bus.exchange([0])
    assert len(bench.boards[1].device.pins.chip.seen) == 1
    assert not bench.boards[0].device.pins.chip.seen


@each_usb
def test_with_two_boards_the_first_one_is_never_taken(bridge):
    bench = USB[bridge](("A1", "B2"))
    with pytest.raises(UsageError, match=f"{bridge}:A1 or {bridge}:B2"):
        bench.open()
    used = "claimed" if bridge == "cp2130" else "sent"
    assert not any(getattr(board, used) for board in bench.boards)


@pytest.mark.parametrize(
    ("bridge", "urls"),
    [
        ("cp2130", ["cp2130:?bus=1&address=5", "cp2130:?bus=1&address=6"]),
        ("mcp2210", ["mcp2210:?path=1-1%3A1.0", "mcp2210:?path=1-2%3A1.0"]),
    ],
)
def test_boards_of_the_same_serial_number_are_told_apart_by_their_place(bridge, urls):
    bench = USB[bridge](("A1", "A1"))
    assert bench.urls() == urls
    with bench.open(urls[1]) as bus:
        bus.exchange([0])
    assert len(bench.boards[1].device.pins.chip.seen) == 1


@each_usb
def test_a_missing_board_is_said_with_what_is_there(bridge):
    with pytest.raises(CannotOpenError, match=f"no {bridge.upper()} is connected"):
        USB[bridge](()).open()
    there = f"no such {bridge.upper()} is connected; connected: {bridge}:A1"
    with pytest.raises(CannotOpenError, match=there):
        USB[bridge]().open(f"{bridge}:ZZ")


@each_usb
def test_a_board_in_use_is_busy_and_is_free_after_closing(bridge):
    bench = USB[bridge]()
    bus = bench.open()
    with pytest.raises(CannotOpenError, match="busy"):
        bench.open()
    bus.close()
    bench.open().close()
    if bridge == "cp2130":
        assert not bench.board.claimed


# -- options ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bridge", "options"),
    [
        *(
            ("cp2130", f"cp2130:?{one}")
            for one in ("cs=11", "speed=1", "cs=2&reset_gpio=2", "timeout_ms=x")
        ),
        *(("mcp2210", f"mcp2210:?{one}") for one in ("cs=9", "cs=x", "chip=1", "backend=usb")),
        *(("mcp2210", f"mcp2210:?{one}") for one in ("timeout_ms=0", "cs=3&reset_gpio=3")),
        ("mcp2210", "mcp2210:?cs=6&event_counter=1"),
        *(("serial", f"?{one}") for one in ("baud=x", "edge=both", "speed=1", "boot_ms=1")),
        *(("spidev", f"?{one}") for one in ("reset_gpio=17", "cs_high_us=-1", "speed=1")),
    ],
)
def test_a_wrong_option_is_refused_and_leaves_the_board_free(bridge, options):
    bench = BENCHES[bridge]()
    with pytest.raises(UsageError):
        bench.open(options)
    bench.open().close()


@pytest.mark.parametrize(("bridge", "reset_gpio"), [("cp2130", 5), ("mcp2210", 3)])
def test_capabilities_are_those_that_were_wired(bridge, reset_gpio):
    assert USB[bridge]().open().capabilities == frozenset()
    both = USB[bridge]().open(f"{bridge}:?reset_gpio={reset_gpio}&event_counter=1").capabilities
    assert both == {Capability.HARD_RESET, Capability.EVENT_COUNTER}


@pytest.mark.parametrize(
    ("bridge", "asked", "kept"),
    [
        *(("cp2130", *both) for both in ((1e6, 750e3), (250e3, 187.5e3), (1.5e6, 1.5e6), (93_751, 93_750))),
        *(("mcp2210", *both) for both in ((1e6, 1e6), (300e3, 300e3), (7e5, 12e6 // 18), (1999, 1998))),
    ],
)
def test_the_clock_is_the_fastest_that_is_not_above_the_one_asked_for(bridge, asked, kept):
    with USB[bridge]().open() as bus:
        assert bus.configure(SpiTiming(asked, 9, 40)).clock_hz == kept


# -- faults -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bridge", BENCHES)
def test_under_faults_no_wrong_word_is_accepted(bridge, seed):
    bench = BENCHES[bridge](**({"watched": False} if bridge == "serial" else {}))
    bus = bench.open()
    bus.configure(FAST)
    rates = {"hang": 0.001, **dict.fromkeys(FAILURES[bridge], 0.01)}
    faults = Faults(seed=seed, progress=0.05 if bridge == "mcp2210" else 0.0, **rates)
    bench.set_faults(faults)
    good = bad = 0
    for k in range(400):
        # Two batches by turns, so that a late reply to one is not right for the other.
        asked, right = ([0x3800, 0x3600, 0x3A00, 0], [0x0402, 0x0001, 0x0000])
        if k % 2:
            asked, right = [0x3600, 0x3800, 0x3800, 0], [0x0001, 0x0402, 0x0402]
        try:
            replies = bus.exchange(asked)
        except BusError:
            bad += 1
            continue
        good += 1
        assert replies[1:] == right
    # On USB and serial about half get through; the kernel of spidev does not repeat and seldom fails.
    assert good > {"cp2130": 200, "spidev": 240}.get(bridge, 400 / 3)
    assert bad > {"spidev": 16}.get(bridge, 5)
    if bridge == "mcp2210":
        assert faults.seen["progress"] > 100
    if bridge == "serial":
        assert bus._link.retries > 100
    bench.set_faults(Faults())
    bench.clock.sleep_s(2.0)
    assert bus.exchange([0x3800, 0])[1] == 0x0402


@pytest.mark.parametrize("seed", range(3))
@each_usb
def test_a_bus_opens_over_a_bad_cable_within_a_few_tries(bridge, seed):
    rates = {"hang": 0.001, **dict.fromkeys(FAILURES[bridge], 0.01)}
    bench = USB[bridge](faults=Faults(seed=seed, **rates))
    for _ in range(20):
        with contextlib.suppress(BusError):
            bench.open().close()
            break
    else:
        pytest.fail("not one of twenty tries opened the bus")


@each_usb
def test_a_late_answer_is_not_taken_for_the_next_one(bridge):
    bench = USB[bridge]()
    bus = bench.open()
    bus.exchange([0x3600, 0])
    bench.set_faults(Faults(delay=1.0, delay_s=0.2, seed=1))
    for _ in range(40):
        with contextlib.suppress(BusError):
            assert bus.exchange([0x3800, 0x3600, 0])[1:] == [0x0402, 0x0001]
    bench.set_faults(Faults())
    bench.clock.sleep_s(2.0 if bridge == "mcp2210" else 0.0)
    assert bus.exchange([0x3800, 0x3600, 0])[1:] == [0x0402, 0x0001]


@pytest.mark.parametrize("bridge", [*USB, "serial"])
def test_unplugging_is_a_clear_error_and_plugging_in_again_works(bridge):
    bench = BENCHES[bridge]()
    bus = bench.open()
    bench.unplug()
    for _ in range(2):
        with pytest.raises(CannotOpenError, match="gone"):
            bus.exchange([0])
    bus.close()
    bench.plug_in()
    with bench.open() as again:
        assert again.exchange([0x3800, 0])[1] == 0x0402


@pytest.mark.parametrize("after", range(1, 9))
@each_usb
def test_an_interruption_by_the_operator_leaves_no_answer_to_the_next_request(bridge, after):
    bench = USB[bridge]()
    with bench.open() as bus:
        (owner, name), calls = bench.reader(bus), []
        read = getattr(owner, name)

        def interrupted(size, timeout_ms=0):
            calls.append(timeout_ms)
            if len(calls) == after:
                raise KeyboardInterrupt
            return read(size, timeout_ms)

        setattr(owner, name, interrupted)
        with contextlib.suppress(KeyboardInterrupt):
            bus.exchange([0x3800, 0x3600, 0, 0x3800, 0x3600, 0, 0x3600, 0])
        setattr(owner, name, read)
        assert len(calls) == after
        assert bus.exchange([0x3600, 0x3800, 0])[1:] == [0x0001, 0x0402]


@pytest.mark.parametrize(("bridge", "most_s"), [("cp2130", 0.35), ("mcp2210", 0.25)])
def test_a_silent_device_fails_within_its_time_out(bridge, most_s):
    bench = USB[bridge]()
    bus = bench.open(f"{bridge}:?timeout_ms=100")
    bench.set_faults(Faults(drop=1.0))
    before = bench.clock.now_s()
    with pytest.raises(BusTimeoutError, match=r"0\.1 s"):
        bus.exchange([0] * 100)
    assert bench.clock.now_s() - before < most_s


@pytest.mark.parametrize("bridge", BENCHES)
def test_a_host_that_stops_at_any_time_still_gets_the_answers_that_came_meanwhile(bridge):
    for at in itertools.count(1):
        bench = BENCHES[bridge]()
        work = int
        if bridge == "serial":
            work = bench.port._work
        elif bridge == "mcp2210":
            engine = vars(bench.boards[0].device)
            work = partial(engine.update, busy_polls=0)
        bench.clock = StoppedHost(bench.clock, at, work)
        with bench.open() as bus:
            if bridge == "mcp2210":
                engine["busy_polls"] = 1
            assert bus.exchange([0x3600, 0x3800, 0])[1:] == [0x0001, 0x0402], at
        if bench.clock.looks < at:
            break
    assert at > 9


def test_a_host_that_stops_at_any_time_of_a_slow_stream_does_not_take_the_part_for_silent():
    for at in itertools.count(1):
        bench = SerialBench(watched=False)
        with bench.open() as bus:
            bus.exchange([DATA_READY_ON, 0xB6FF])  # a sample in 2.42 s
            clock = StoppedHost(bench.clock, at, bench.port._work)
            bus._clock = bus._link._clock = clock
            with bus.stream([0x0400], block_scans=1) as stream:
                steps_s = np.diff([next(stream).time_s[0] for _ in range(4)])
            assert steps_s == pytest.approx(2.42, rel=0.03), at
        if clock.looks < at:
            break
    assert at > 100
