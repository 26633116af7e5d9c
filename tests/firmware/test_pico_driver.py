"""Driver, serial transport and the Pico's binary together, in simulated time."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from adis_gonio.base.errors import BusError, CannotOpenError, VariantError
from adis_gonio.device.bus import BusUrl, find_devices, serial as ports
from adis_gonio.device.bus.serial import SerialBus, open_from_url
from adis_gonio.device.sensor import Adis16354
from adis_gonio.sim.testing.bus_contract import BusContract, Rig as ContractRig, WireFrame
from firmware.board_tests import SEVEN, DriverTests, open_serial
from firmware.captures import compare, exercise
from firmware.pico_rig import PicoRig, PtyCable
from firmware.soak import soak

UP_X = [1000, 0, 0]


class TestDriver(DriverTests):
    board = "rp2040 E6614103E735292B"

    @pytest.fixture
    def rig(self, make_pico):
        return make_pico(accelMg=UP_X)


def test_another_variant_is_noticed(make_pico):
    with pytest.raises(VariantError):
        Adis16354(open_serial(make_pico(part="adis16350")))


def test_what_the_driver_writes_is_in_the_chip_and_in_its_flash(make_pico):
    rig = make_pico(accelMg=UP_X)
    with Adis16354(open_serial(rig)) as sensor:
        sensor.write("XACCL_OFF", 1000)
        assert rig.register("XACCL_OFF") == 1000
        rig.sleep_s(0.01)
        assert sensor.scan()["XACCL_OUT"] == pytest.approx(1000 + 1000 * 0.4672, abs=60)
        sensor.write("XACCL_OFF", -3)
        assert rig.register("XACCL_OFF") == 0xFFD
        assert rig.state["endurance"] == 0


@pytest.mark.parametrize("baud", [300, 9600, 500_000])
def test_times_do_not_depend_on_the_baud_rate_that_is_named(make_pico, baud):
    """A packet of scans is 0.3 ms on its way; at 300 baud it would be 8 s, at 9600 a quarter of one."""
    rig = make_pico(accelMg=UP_X)
    with Adis16354(SerialBus(rig.port, url="serial:rig", clock=rig, baud=baud)) as sensor:
        sensor.configure(smpl_prd=1, filter_m=0, data_ready=True)
        with sensor.stream(SEVEN) as scans:
            block = next(scans)
            behind_s = rig.now_s() - block.time_s[-1]
    assert 0 < behind_s < 0.030


def test_three_seconds_at_the_full_rate_lose_and_repeat_nothing_and_break_no_limit(make_pico):
    """A small run of scripts/rig_streams.py."""
    assert soak(make_pico(), 3.0).sound


# -- a serial port of the operating system ----------------------------------------------


@pytest.fixture
def cable(make_pico):
    cable = PtyCable(make_pico(accelMg=UP_X))
    yield cable
    cable.pull()


def open_pty(cable: PtyCable, options: str = "") -> SerialBus:
    return open_from_url(BusUrl.parse(f"serial:{cable.path}{options}"), clock=cable)


@pytest.mark.parametrize("options", ["", "?baud=9600"])
def test_the_sensor_is_found_by_pyserial_at_any_baud_rate(cable, options):
    with Adis16354(open_pty(cable, options)) as sensor:
        assert sensor.scan()["XACCL_OUT"] == pytest.approx(1000, abs=60)
        sensor.configure(smpl_prd=1, filter_m=0)
        with sensor.stream(SEVEN) as scans:
            blocks = [next(scans) for _ in range(2)]
    assert sum(block.lost for block in blocks) == 0
    assert all((block.words & 0x8000).all() for block in blocks)


def test_pulling_the_cable_is_a_typed_error_in_a_stream_and_in_a_request(cable):
    sensor = Adis16354(open_pty(cable))
    with pytest.raises(CannotOpenError, match="device is gone"), sensor.stream(SEVEN) as scans:  # noqa: PT012
        next(scans)
        cable.pull()
        for _ in scans:
            pass
    with pytest.raises(BusError):
        sensor.read("SMPL_PRD")
    with pytest.raises(BusError):
        open_pty(cable)
    sensor.close()


# -- the list of devices ------------------------------------------------------------------


def board_row(usb: dict[str, object], device: str) -> SimpleNamespace:
    """What pyserial tells of a port, from what the firmware told the host."""
    names = ("vid", "pid", "manufacturer", "product", "serial_number")
    return SimpleNamespace(device=device, description="x", **{name: usb[name] for name in names})


def test_the_list_of_devices_names_the_board_and_serial_alone_opens_it(make_pico, monkeypatch):
    pico = board_row(make_pico().state["usb"], "/dev/ttyACM0")
    other = SimpleNamespace(
        device="/dev/ttyUSB0",
        description="x",
        vid=0x1A86,
        pid=0x7523,
        manufacturer=None,
        product="USB Serial",
        serial_number=None,
    )
    monkeypatch.setattr(ports, "list_boards", lambda: [pico, other])
    rows = {row.url: row.description for row in find_devices()}
    assert rows["serial:/dev/ttyACM0"] == (
        "adis-gonio bridge (RP2040) (1209:0001, serial number E6614103E735292B)"
    )
    assert rows["serial:/dev/ttyUSB0"].endswith("if it has the adis-gonio firmware")
    opened = []
    monkeypatch.setattr(ports, "open_port", lambda place, *_: opened.append(place) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        open_from_url(BusUrl.parse("serial:"))
    assert opened == ["/dev/ttyACM0"]


# -- the contract of every bus ---------------------------------------------------------------


class PicoChip:
    """The emulated chip as the contract wants it: what its pins saw."""

    def __init__(self, rig: PicoRig) -> None:
        self._rig = rig

    @property
    def seen(self) -> list[WireFrame]:
        return [
            WireFrame(word, fall * 1e-9, hz, reply, (rise - fall) * 1e-9 - 16 / hz)
            for word, fall, rise, hz, reply in self._rig.frames()
        ]


class PicoTwin:
    """A second chip, alike in all, that is given frames by hand."""

    def __init__(self, rig: PicoRig) -> None:
        self._rig = rig

    def frame(self, word: int, *, start_s: float, clock_hz: float, cs_hold_s: float) -> int:
        rise_s = start_s + 16 / clock_hz + cs_hold_s
        return self._rig.twin_frame(word, start_s * 1e9, rise_s * 1e9)


class TestPicoBinary(BusContract):
    """The contract of every bus, with the Pico's binary between the bus and the pins."""

    @pytest.fixture
    def rig(self, make_pico):
        rig = make_pico()
        rig.keep_frames()
        bus = open_serial(rig)
        yield ContractRig(bus, PicoChip(rig), PicoTwin(rig), slowest_hz=20_000)
        bus.close()

    def make(self) -> ContractRig:
        raise NotImplementedError


def test_a_capture_of_the_pins_has_the_frames_and_words_of_the_host(make_pico, tmp_path):
    rig = make_pico(accelMg=UP_X)
    rig.capture(tmp_path / "pins.vcd")
    exercise(open_serial(rig), tmp_path / "host.rec")
    assert compare(tmp_path / "pins.vcd", tmp_path / "host.rec") > 100
