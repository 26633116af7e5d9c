"""URLs: what opens, and what a wrong one says."""

import importlib.metadata

import pytest

from adis_gonio.base.errors import CapabilityError, NotInstalledError, UsageError
from adis_gonio.device.bus import BusUrl, SpiTiming, find_devices, open_bus
from fakes.buses import ConstantBus


def test_a_url_is_taken_apart():
    url = BusUrl.parse("serial:/dev/ttyUSB0?baud=500000&name=a%20b")
    assert (url.scheme, url.place) == ("serial", "/dev/ttyUSB0")
    assert url.options == {"baud": "500000", "name": "a b"}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no bus URL"),
        ("ttyUSB0", "no bus URL"),
        (":x", "no bus URL"),
        ("sim:?seed", "name=value"),
        ("sim:?seed=1&seed=2", "twice"),
        ("smi:?seed=1", "did you mean 'sim:'"),
        ("ioi:device0", "did you mean 'iio:'"),
        ("gopher://x", "known: cp2130:, iio:, mcp2210:, record:, replay:, serial:, sim:, spidev:"),
    ],
)
def test_a_wrong_url_says_what_is_wrong_in_one_line(text, says):
    with pytest.raises(UsageError) as caught:
        open_bus(text)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_bus_whose_library_is_missing_names_the_extra(monkeypatch):
    point = importlib.metadata.EntryPoint("hidden", "no_such_module_at_all:open", "adis_gonio.bus")
    monkeypatch.setattr("adis_gonio.device.bus.opening.entry_points", lambda group: [point])
    with pytest.raises(NotInstalledError, match=r"pip install '\.\[hidden\]'"):
        open_bus("hidden:")
    assert "no_such_module_at_all" in find_devices()[0].description


def test_another_package_adds_a_bus_by_an_entry_point(monkeypatch):
    point = importlib.metadata.EntryPoint("constant", "test_bus_opening:_open_constant", "adis_gonio.bus")
    monkeypatch.setattr("adis_gonio.device.bus.opening.entry_points", lambda group: [point])
    with open_bus("constant:0x1234") as bus:
        assert bus.exchange([0x0200]) == [0x1234]


def _open_constant(url: BusUrl) -> ConstantBus:
    return ConstantBus(int(url.place, 0))


def test_a_capability_that_a_bus_has_not_is_an_error_that_names_it():
    bus = ConstantBus(0)
    for call, name in ((bus.hard_reset, "hard-reset"), (bus.read_event_counter, "event-counter")):
        with pytest.raises(CapabilityError, match=name):
            call()
    with pytest.raises(CapabilityError, match="stream"):
        bus.stream([0x0A00])


@pytest.mark.parametrize("wrong", [(0, 9, 40), (1e6, -1, 40), (1e6, 9, -1), (float("nan"), 9, 40)])
def test_a_timing_that_cannot_be_is_refused(wrong):
    with pytest.raises(UsageError, match="not possible"):
        SpiTiming(*wrong)


def test_a_frame_takes_the_longer_of_its_period_and_its_clocks_plus_stall():
    assert SpiTiming(1e6, 9, 40).frame_s == pytest.approx(40e-6)
    assert SpiTiming(250e3, 100, 160).frame_s == pytest.approx(164e-6)
