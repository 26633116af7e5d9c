"""`serial:/dev/ttyUSB0` - a board with the project's firmware (firmware_proto/), by pyserial.

`serial:` where one USB serial port is there, or one that names itself (a Raspberry Pi Pico);
`serial:socket://host:port` and pyserial's other URLs too.

| option | meaning | default |
|---|---|---|
| `baud` | 500000, or 1000000 where the firmware was built so; a Pico has none | 500000 |
| `edge` | edge of data-ready that starts a scan: `falling` or `rising` | falling |
| `boot_ms` | how long the firmware is waited for after opening | 3000 |
| `serial_number` | USB serial number, instead of a port | |
"""

from __future__ import annotations

from adis_gonio.device.bus.host import WALL, Clock, UrlOptions, missing, several
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.bus.serial.bus import BOOT_S, SerialBus
from adis_gonio.device.bus.serial.link import Port, SerialLink
from adis_gonio.device.bus.serial.ports import devices, list_boards, names_itself, open_port
from adis_gonio.device.bus.wire import load_cobs
from adis_gonio.device.bus.wire import protocol as wire

__all__ = ["Port", "SerialBus", "SerialLink", "find_devices", "open_from_url"]

_OPTIONS = ("baud", "edge", "boot_ms", "serial_number")


def open_from_url(url: BusUrl, *, port: Port | None = None, clock: Clock = WALL) -> SerialBus:
    """Open a board (see the module's text).

    Parameters
    ----------
    port : Port
        An open port, in place of pyserial's.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several ports fit.
    NotInstalledError
        pyserial or cobs is not installed.
    CannotOpenError
        No such port, no permission, or another program has it.
    BusTimeoutError
        No firmware answers.
    """
    options = UrlOptions(url, _OPTIONS)
    baud = options.number("baud", wire.BAUD, 300, 4_000_000)
    trigger = wire.Trigger[options.one_of("edge", ("falling", "rising")).upper()]
    boot_ms = options.number("boot_ms", round(BOOT_S * 1000), 100, 60_000)
    number = options.text("serial_number")
    load_cobs()  # what is missing is said before a port is opened, which resets many boards
    if port is None:
        port = open_port(_place(url, number), baud, url.text)
    try:
        return SerialBus(port, url=url.text, clock=clock, boot_s=boot_ms / 1000, trigger=trigger, baud=baud)
    except BaseException:
        port.close()
        raise


def find_devices() -> list[Device]:
    """USB serial ports; whether the firmware is on a board only opening it tells."""
    return devices(list_boards())


def _place(url: BusUrl, number: str) -> str:
    if url.place:
        return url.place
    boards = list_boards()
    fits = [board for board in boards if not number or board.serial_number == number]
    if not fits:
        what = f"port with serial number {number}" if number else "USB serial port"
        raise missing(url.text, what, devices(boards))
    if len(fits) > 1:
        fits = [board for board in fits if names_itself(board)] or fits
    if len(fits) > 1:
        raise several(url.text, devices(fits))
    return str(fits[0].device)
