"""Which serial port `serial:` means: boards that name themselves, and those that cannot."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from adis_gonio.base.errors import UsageError
from adis_gonio.device.bus import BusUrl, serial as ports
from adis_gonio.device.bus.serial import open_from_url


def row(device: str, product: str | None, number: str | None = None) -> SimpleNamespace:
    return SimpleNamespace(
        device=device, product=product, serial_number=number, description="n/a", vid=0x1209, pid=1
    )


PICO = row("/dev/ttyACM0", "adis-gonio bridge (RP2040)", "A1")
SECOND = row("/dev/ttyACM1", "adis-gonio bridge (RP2040)", "B2")
UNO = row("/dev/ttyUSB0", "USB Serial")
NAMELESS = row("COM3", None)


class OpenedError(Exception):
    """Says which port would have been opened."""


@pytest.fixture
def connected(monkeypatch):
    def connect(*rows: SimpleNamespace) -> None:
        monkeypatch.setattr(ports, "list_boards", lambda: list(rows))

    def refuse(place: str, *_: object) -> None:
        raise OpenedError(place)

    monkeypatch.setattr(ports, "open_port", refuse)
    return connect


def test_only_a_port_that_does_not_name_itself_is_listed_with_a_doubt():
    pico, uno = ports.devices([PICO, UNO])
    assert str(pico.url) == "serial:/dev/ttyACM0"
    assert "serial number A1" in pico.description
    assert "if it has" not in pico.description
    assert uno.description.endswith("if it has the adis-gonio firmware")


@pytest.mark.parametrize(
    ("rows", "url", "place"),
    [
        ((UNO,), "serial:", "/dev/ttyUSB0"),
        ((UNO, PICO, NAMELESS), "serial:", "/dev/ttyACM0"),
        ((PICO, SECOND, UNO), "serial:?serial_number=B2", "/dev/ttyACM1"),
        ((PICO,), "serial:/dev/ttyUSB7", "/dev/ttyUSB7"),
        ((NAMELESS,), "serial:", "COM3"),
    ],
)
def test_the_port_that_is_meant_is_opened(connected, rows, url, place):
    connected(*rows)
    with pytest.raises(OpenedError, match=f"^{place}$"):
        open_from_url(BusUrl.parse(url))


@pytest.mark.parametrize(
    ("rows", "listed"),
    [((PICO, SECOND, UNO), ("ttyACM0", "ttyACM1")), ((UNO, NAMELESS), ("ttyUSB0", "COM3"))],
)
def test_where_several_fit_alike_they_are_listed(connected, rows, listed):
    connected(*rows)
    with pytest.raises(UsageError) as caught:
        open_from_url(BusUrl.parse("serial:"))
    assert all(name in str(caught.value) for name in listed)
    assert ("ttyUSB0" in str(caught.value)) == ("ttyUSB0" in listed)
