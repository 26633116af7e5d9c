"""The spidev transport over a fake kernel, down to the structures of ioctl."""

import ctypes
import errno
import sys

import pytest

from adis_gonio.base.errors import BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus import BusUrl, Capability, SpiTiming, spidev as k
from adis_gonio.device.bus.spidev import find_devices, open_from_url
from adis_gonio.sim import SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import BusContract, Rig, assert_timing
from adis_gonio.sim.testing.faults import Faults
from fakes.benches import SPIDEV_PATH, SpidevBench as Bench
from fakes.spidev_kernel import (
    CPHA,
    CS_HIGH,
    KNOWN_FLAGS,
    LOOP,
    LSB_FIRST,
    THREE_WIRE,
    CsFlag,
)

FAST = SpiTiming(1e6, 9.0, 40.0)


class TestSpidev(BusContract):
    options = "?reset_gpio=gpiochip0:17"

    def make(self) -> Rig:
        bench = Bench(**self.machine())

        def once(**rates):
            def arm():
                bench.kernel.faults = Faults(**rates)
                happens = bench.kernel.faults.happens

                def first_only(kind):
                    hit = happens(kind)
                    if hit:
                        bench.kernel.faults = Faults()
                    return hit

                bench.kernel.faults.happens = first_only

            return arm

        faults = {
            "time-out": (once(hang=1.0), BusTimeoutError),
            "failed": (once(drop=1.0), ProtocolError),
            "busy": (once(busy=1.0), ProtocolError),
            "short": (once(short=1.0), ProtocolError),
        }
        twin = SimulatedChip(World(seed=Bench.seed), start_s=-0.5)
        return Rig(bench.open(self.options), bench.chip, twin, faults)

    def machine(self):
        return {}


class TestSpidevOnAnArm64WithAShortBuffer(TestSpidev):
    """Each transfer counts as a cache line against bufsiz: 32 in a message."""

    options = ""

    def machine(self):
        return {"align": 128, "call_s": 0.0}


class TestSpidevWithALongerCsHighTime(TestSpidev):
    options = "?cs_high_us=100"

    def machine(self):
        return {"cs_high_s": 100e-6, "call_s": 0.0}


def test_structures_are_as_large_as_the_kernels():
    assert ctypes.sizeof(k.Transfer) == 32
    assert ctypes.sizeof(k.LineRequest) == 592
    assert ctypes.sizeof(k.LineValues) == 16
    assert (k.message(1), k.WR_MODE32, k.GET_LINE) == (0x40206B00, 0x40046B05, 0xC250B407)


# -- the mode and its flags -------------------------------------------------------------------------------


@pytest.mark.parametrize("flag", CsFlag)
def test_a_chip_select_of_any_kind_of_any_kernel_reaches_the_chip(flag):
    bench = Bench(cs_flag=flag)
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.kernel.modes[SPIDEV_PATH] == 3 | (0 if flag is CsFlag.NATIVE else CS_HIGH)


def test_flags_of_the_device_tree_stay_and_those_that_change_the_bits_of_a_frame_go():
    no_cs, ready = 0x40, 0x80
    bench = Bench(mode=no_cs | ready | LSB_FIRST | THREE_WIRE | LOOP | CPHA)
    with bench.open() as bus:
        assert bus.exchange([0x3800, 0])[1] == 0x0402
    assert bench.kernel.modes[SPIDEV_PATH] == no_cs | ready | CS_HIGH | 3


@pytest.mark.parametrize("wrong", [0, 1, 2, 3 | LSB_FIRST, 3 | THREE_WIRE, 3 | LOOP])
def test_a_mode_that_reads_back_otherwise_is_refused(wrong):
    bench = Bench()
    bench.kernel._set_mode = lambda path, mode: bench.kernel.modes.update({path: wrong | CS_HIGH})
    with pytest.raises(ProtocolError, match=f"mode {wrong:#x}, not 3"):
        bench.open()
    assert not bench.kernel.files


def test_a_controller_without_cpha_1_is_said_with_what_to_use_instead():
    """As spi-bcm2835aux: the auxiliary SPI of a Raspberry Pi."""
    bench = Bench(supports=KNOWN_FLAGS & ~CPHA)
    with pytest.raises(CannotOpenError, match=r"cannot do SPI mode 3 .*spidev1\.x.*spidev0\.x") as caught:
        bench.open()
    assert "Invalid argument" not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not bench.kernel.files


# -- batches ----------------------------------------------------------------------------------------------


def test_a_batch_in_fast_mode_is_one_ioctl():
    bench = Bench()
    with bench.open() as bus:
        bus.configure(FAST)
        bench.kernel.messages.clear()
        bus.exchange([0x3800] * 300)
    assert bench.kernel.messages == [300]


def test_the_clock_fills_the_period_so_that_cs_rises_right_after_the_last_bit():
    bench = Bench()
    with bench.open() as bus:
        kept = bus.configure(FAST)
        assert kept.clock_hz == pytest.approx(16 / 30e-6, rel=1e-5)
        bus.exchange([0] * 3)
    starts = [frame.start_s for frame in bench.chip.seen[-3:]]
    assert starts[1] - starts[0] == pytest.approx(40e-6, rel=1e-3)


def test_in_normal_mode_each_frame_is_a_message_because_the_kernel_cannot_keep_the_stall():
    bench = Bench()
    with bench.open() as bus:
        bench.kernel.messages.clear()
        bus.exchange([0x3800] * 5)
    assert bench.kernel.messages == [1] * 5


@pytest.mark.parametrize(
    ("timing", "clock_hz", "messages"),
    [
        (SpiTiming(1e6, 10.0, 40.0), 16 / 30e-6, [3]),  # the kernel's own time is just enough
        (SpiTiming(1e6, 10.5, 40.0), 1e6, [1, 1, 1]),
        (SpiTiming(1e6, 9.0, 1000.0), 16 / 990e-6, [3]),
        (SpiTiming(1e6, 9.0, 2000.0), 1e6, [1, 1, 1]),  # that would be 8 kHz, below the chip's 10 kHz
        (SpiTiming(100e3, 9.0, 40.0), 100e3, [3]),
    ],
)
def test_the_clock_fills_a_period_only_where_the_kernel_keeps_the_stall_and_the_chip_the_clock(
    timing, clock_hz, messages
):
    bench = Bench()
    with bench.open() as bus:
        assert bus.configure(timing).clock_hz == pytest.approx(clock_hz, rel=1e-3)
        bench.kernel.messages.clear()
        bus.exchange([0] * 3)
    assert bench.kernel.messages == messages
    assert_timing(bench.chip.seen[-3:], timing)


def test_a_clock_below_1_hz_is_refused_for_the_kernel_would_take_0_for_its_own():
    with Bench().open() as bus, pytest.raises(UsageError, match=r"0\.5 Hz"):
        bus.configure(SpiTiming(0.5, 9.0, 40.0))


def test_long_batches_are_split_at_511_and_keep_the_stall():
    bench = Bench(bufsiz=65536)
    with bench.open() as bus:
        bus.configure(FAST)
        bench.kernel.messages.clear()
        assert bus.exchange([0x3800] * 1200)[1:] == [0x0402] * 1199
    assert bench.kernel.messages == [511, 511, 178]


def test_a_short_buffer_is_found_once_and_remembered():
    bench = Bench(align=128)
    with bench.open() as bus:
        bus.configure(FAST)
        for _ in range(2):
            bench.kernel.messages.clear()
            assert bus.exchange([0x3800] * 300)[1:] == [0x0402] * 299
            assert max(bench.kernel.messages) <= 32
            assert sum(bench.kernel.messages) == 300
            assert len(bench.kernel.messages) == 17, "after 300, 150, 75 and 37 the 18 that fit"


def test_a_buffer_that_takes_not_even_one_frame_is_an_error():
    bench = Bench(bufsiz=4)
    ioctl, calls = bench.kernel.ioctl, []

    def few(fd, request, argument):
        calls.append(request)
        assert len(calls) < 20, "tried for ever"
        return ioctl(fd, request, argument)

    bench.kernel.ioctl = few
    with bench.open() as bus, pytest.raises(ProtocolError, match="Message too long"):
        bus.exchange([0])


def test_a_file_that_another_has_is_busy_and_free_after_closing():
    bench = Bench()
    bus = bench.open()
    with pytest.raises(CannotOpenError, match="busy"):
        bench.open()
    bus.close()
    bench.open().close()
    assert not bench.kernel.files


def test_a_failed_opening_gives_everything_back():
    bench = Bench()
    bench.kernel.reset_line = 3
    with pytest.raises(CannotOpenError, match="busy"):
        bench.open("?reset_gpio=gpiochip0:17")
    with pytest.raises(UsageError, match="no line 99"):
        bench.open("?reset_gpio=gpiochip0:99")
    with pytest.raises(CannotOpenError, match="no /dev/gpiochip4 "):
        bench.open("?reset_gpio=gpiochip4:3")
    assert not bench.kernel.files


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (errno.ENOENT, "dtparam=spi=on"),
        (errno.EACCES, 'no permission.*devices --udev.*SUBSYSTEM=="spidev"'),
        (errno.EBUSY, "busy"),
    ],
)
def test_what_cannot_be_opened_says_who_must_act(code, says):
    bench = Bench()
    bench.kernel.refuse_open = code
    with pytest.raises(CannotOpenError, match=says) as caught:
        bench.open()
    assert "\n" not in str(caught.value)


def test_files_are_listed_and_with_two_none_is_taken(tmp_path):
    for name in ("spidev0.0", "spidev0.1"):
        (tmp_path / name).touch()
    urls = [d.url for d in find_devices(folder=str(tmp_path))]
    assert urls == [f"spidev:{tmp_path}/spidev0.0", f"spidev:{tmp_path}/spidev0.1"]
    with pytest.raises(UsageError, match=r"spidev0\.0 or spidev:"):
        open_from_url(BusUrl.parse("spidev:"), system=Bench().kernel, folder=str(tmp_path))


def test_without_any_file_the_message_says_what_to_enable(tmp_path):
    with pytest.raises(CannotOpenError, match="dtparam"):
        open_from_url(BusUrl.parse("spidev:"), system=Bench().kernel, folder=str(tmp_path))


@pytest.mark.skipif(sys.platform != "linux", reason="a real ioctl needs Linux")
def test_a_file_that_is_no_spidev_is_said_by_the_real_kernel():
    with pytest.raises(ProtocolError, match="no spidev file"):
        open_from_url(BusUrl.parse("spidev:/dev/null"))


@pytest.mark.parametrize("code", [errno.ENODEV, errno.ESHUTDOWN, errno.ENXIO])
def test_the_controller_going_away_is_a_clear_error(code):
    bench = Bench()
    with bench.open() as bus:

        def unbound(*call):
            raise OSError(code, "")

        bench.kernel.ioctl = unbound
        with pytest.raises(CannotOpenError, match="gone"):
            bus.exchange([0])


def open_with_line(tmp_path, line, kernel):
    """Open and close a bus on a machine with the GPIO chips of this kernel."""
    for name in kernel.chips:
        (tmp_path / name).touch()
    url = BusUrl.parse(f"spidev:{next(iter(kernel.pins))}?reset_gpio={line}")
    open_from_url(url, system=kernel, folder=str(tmp_path)).close()
    assert not kernel.files


# On some boards gpiochip0 is another chip, and the lines of the header are on gpiochip4.
BOARD = {"gpiochip0": ["ID_SDA", "", "GPIO20"], "gpiochip4": [f"GPIO{k}" for k in range(5, 30)]}


def test_a_reset_line_is_found_by_its_name_on_any_chip(tmp_path):
    kernel = Bench().kernel
    kernel.chips, kernel.reset_line = BOARD, 12
    open_with_line(tmp_path, "GPIO17", kernel)
    assert kernel.requested == [("gpiochip4", 12)]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("17", r"GPIO17.*gpiochip0:17"),
        ("GPIO20", "gpiochip0:2 or gpiochip4:15"),
        ("GPI017", "did you mean GPIO17"),
        ("RESET", "no GPIO line is called 'RESET'"),
    ],
)
def test_an_ambiguous_or_unknown_reset_line_drives_nothing(tmp_path, line, says):
    kernel = Bench().kernel
    kernel.chips = BOARD
    with pytest.raises(UsageError, match=says):
        open_with_line(tmp_path, line, kernel)
    assert not kernel.requested
    assert not kernel.files


def test_only_a_wired_reset_is_a_capability():
    assert Bench().open().capabilities == frozenset()
    assert Bench().open("?reset_gpio=gpiochip0:17").capabilities == {Capability.HARD_RESET}
