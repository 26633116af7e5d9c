"""`serial:/dev/ttyUSB0` - a board with the project's firmware (firmware_proto/), by pyserial.

`serial:` if there is one USB serial port, or one with the name of this firmware (a Raspberry Pi Pico);
`serial:socket://host:port` and pyserial's other URLs too.

| option | meaning | default |
|---|---|---|
| `baud` | 500000, or 1000000 if the firmware was built with it; a Pico has none | 500000 |
| `edge` | edge of data-ready that starts a scan: `falling` or `rising` | falling |
| `boot_ms` | longest wait for the firmware after opening | 3000 |
| `serial_number` | USB serial number, instead of a port | |
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import Any

from adis_gonio.base.errors import BusError, BusTimeoutError, NotInstalledError, UsageError, install_extra
from adis_gonio.device.bus import host
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.bus.serial.bus import BOOT_S, Port, SerialBus, SerialLink
from adis_gonio.device.bus.wire import load_cobs, protocol as wire

SLICE_S = 0.05
"""Longest single wait in s of a read; it is constant, because a change would configure the port again."""
WRITE_S = 1.0
BUFFER = 65536
PRODUCT = "adis-gonio"
"""Beginning of the product name by which a board with this firmware is recognised.

The firmware is then a USB device, with any VID:PID.
"""


def load() -> Any:
    """Import pyserial and return its module.

    Raises
    ------
    NotInstalledError
        pyserial is missing, or another package has its name.
    """
    try:
        import serial
        import serial.tools.list_ports
    except ImportError:
        raise NotInstalledError(f"serial: pyserial is not installed: {install_extra('serial')}") from None
    if not hasattr(serial, "serial_for_url"):
        raise NotInstalledError(
            "serial: module 'serial' belongs to package serial, not pyserial: pip uninstall serial;"
            " pip install --force-reinstall pyserial"
        )
    return serial


class SerialPort:
    """Adapter from an open port of pyserial to `adis_gonio.device.bus.serial.bus.Port`.

    The modem lines are not used, so a port without them (a pty, many sockets) also works.
    """

    def __init__(self, serial: Any, port: Any, url: str) -> None:
        self._serial = serial
        self._port = port
        self._url = url
        # pyserial's socket reports at most one waiting byte, and reading single bytes is too slow for a
        # stream.
        self._whole = not type(port).__module__.endswith(".protocol_socket")

    def receive(self, wait_s: float, /) -> bytes:
        """Return the bytes that have arrived, after waiting at most `wait_s` seconds for the first."""
        end_s = time.monotonic() + wait_s
        try:
            while True:
                waiting = self._port.in_waiting
                data: bytes = self._port.read(waiting or 1)
                if data or time.monotonic() >= end_s:
                    return data if self._whole or not data else data + self._rest()
        except (OSError, TypeError, AttributeError) as error:
            # pyserial raises TypeError if another thread closes the port during a read.
            raise host.gone_error(self._url) from error

    def _rest(self) -> bytes:
        """Return the further bytes that a socket has ready, without waiting for more."""
        self._port.timeout = 0
        try:
            rest: bytes = self._port.read(BUFFER)
        finally:
            self._port.timeout = SLICE_S
        return rest

    def send(self, data: bytes, /) -> None:
        """Send all bytes of `data`; raise `BusTimeoutError` if the port does not take them in time."""
        try:
            self._port.write(data)
        except self._serial.SerialTimeoutException as error:
            raise BusTimeoutError(f"{self._url}: the port takes no bytes within {WRITE_S:g} s") from error
        except (OSError, TypeError, AttributeError) as error:
            raise host.gone_error(self._url) from error

    def close(self) -> None:
        """Close the port. Linux waits up to 30 s if a hanging board has not taken all bytes."""
        with contextlib.suppress(OSError):
            self._port.close()


def open_port(place: str, baud: int, url: str) -> SerialPort:
    """Open a serial port, locked against other programs.

    Parameters
    ----------
    place : str
        Device file, COM port, or a URL of pyserial such as `socket://host:port`.
    baud : int
        Baud rate.
    url : str
        URL of the bus, used in messages.

    Raises
    ------
    CannotOpenError
        The port is missing, busy or not permitted.
    """
    serial = load()
    options: dict[str, Any] = {} if "://" in place else {"exclusive": True}
    try:
        port = serial.serial_for_url(
            place, baudrate=baud, timeout=SLICE_S, write_timeout=WRITE_S, **options
        )
    except ValueError as error:
        raise UsageError(f"{url}: {error}") from error
    except OSError as error:
        raise _cannot_open(error, place, url) from error
    return SerialPort(serial, port, url)


def list_boards() -> list[Any]:
    """Return the USB serial ports of pyserial's list, sorted by device file."""
    ports = load().tools.list_ports.comports()
    return sorted((port for port in ports if port.vid is not None), key=lambda port: str(port.device))


def names_itself(port: Any) -> bool:
    """Return True if a port's USB strings identify this package's firmware.

    They do on the Raspberry Pi Pico.
    """
    return str(port.product or "").startswith(PRODUCT)


def devices(ports: Sequence[Any]) -> list[Device]:
    """Convert ports of pyserial to devices for a list, without opening them.

    Opening a port would reset many boards.
    """
    rows = []
    for port in ports:
        name = port.product or port.description or "serial port"
        number = f", serial number {port.serial_number}" if port.serial_number else ""
        text = f"{name} ({port.vid:04x}:{port.pid:04x}{number})"
        if not names_itself(port):
            text += ", if it has the adis-gonio firmware"
        rows.append(Device(f"serial:{port.device}", text))
    return rows


def _cannot_open(error: OSError, place: str, url: str) -> BusError:
    def missing() -> BusError:
        return host.missing_error(url, f"port {place}", devices(list_boards()))

    if "FileNotFoundError" in str(error):
        return missing()
    # Windows reports a port in use as "access denied", which pyserial gives as text only.
    if any(word in str(error) for word in ("exclusively lock", "PermissionError")):
        return host.busy_error(url, place)
    return host.opening_error(error, url, place, "tty", missing)


__all__ = ["Port", "SerialBus", "SerialLink", "find_devices", "open_from_url"]


def open_from_url(url: BusUrl, *, port: Port | None = None, clock: host.Clock = host.WALL) -> SerialBus:
    """Open a board with the project's firmware by its URL (see the module's text).

    Parameters
    ----------
    port : Port
        An open port to use; None opens the port of the URL by pyserial.
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
    options = host.UrlOptions(url, ("baud", "edge", "boot_ms", "serial_number"))
    baud = options.number("baud", wire.BAUD, 300, 4_000_000)
    trigger = wire.Trigger[options.one_of("edge", ("falling", "rising")).upper()]
    boot_ms = options.number("boot_ms", round(BOOT_S * 1000), 100, 60_000)
    number = options.text("serial_number")
    load_cobs()  # report a missing package before opening the port, which resets many boards
    if port is None:
        port = open_port(_place(url, number), baud, url.text)
    try:
        return SerialBus(port, url=url.text, clock=clock, boot_s=boot_ms / 1000, trigger=trigger, baud=baud)
    except BaseException:
        port.close()
        raise


def find_devices() -> list[Device]:
    """List the USB serial ports; opening one shows if its board runs the firmware."""
    return devices(list_boards())


def _place(url: BusUrl, number: str) -> str:
    if url.place:
        return url.place
    boards = list_boards()
    fits = [board for board in boards if not number or board.serial_number == number]
    if len(fits) > 1:
        fits = [board for board in fits if names_itself(board)] or fits
    what = f"port with serial number {number}" if number else "USB serial port"
    return str(host.choose_board(url, what, fits, boards, devices).device)
