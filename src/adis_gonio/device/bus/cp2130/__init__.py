"""`cp2130:` - a board with Silicon Labs' CP2130, by pyusb (extra `usb`).

`cp2130:` where one board is connected, `cp2130:SERIAL` where there are several. Options:

| option | meaning | default |
|---|---|---|
| `cs` | GPIO that is chip select, 0 to 10; the board must have made it one | 0 |
| `reset_gpio` | GPIO on the chip's RST | none |
| `event_counter` | 1: data-ready is wired to the event counter, GPIO.4 | 0 |
| `timeout_ms` | time for one transfer | 250 |
| `bus`, `address` | where it is, if serial numbers do not tell boards apart | |
"""

from __future__ import annotations

import contextlib
import errno
from typing import Any

from adis_gonio.base.errors import BusError, NotInstalledError, ProtocolError
from adis_gonio.device.bus.cp2130.bus import TIMEOUT_S, Cp2130Bus
from adis_gonio.device.bus.cp2130.requests import PRODUCT_ID, VENDOR_ID
from adis_gonio.device.bus.host import WALL, Clock, UrlOptions, busy, gone, missing, no_permission, several
from adis_gonio.device.bus.opening import BusUrl, Device

__all__ = ["Cp2130Bus", "find_devices", "open_from_url"]

_OPTIONS = ("cs", "reset_gpio", "event_counter", "timeout_ms", "bus", "address")
_INTERFACE = 0


def open_from_url(url: BusUrl, *, backend: Any = None, clock: Clock = WALL) -> Cp2130Bus:
    """Open a board (see the module's text).

    Parameters
    ----------
    backend : usb.backend.IBackend
        In place of libusb.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several boards fit.
    NotInstalledError
        pyusb or libusb-package is not installed.
    CannotOpenError
        No such board, no permission, or another program has it.
    """
    options = UrlOptions(url, _OPTIONS)
    cs = options.number("cs", 0, 0, 10)
    reset_gpio = options.number_or_none("reset_gpio", 0, 10)
    event_counter = options.switch("event_counter")
    timeout_ms = options.number("timeout_ms", round(TIMEOUT_S * 1000), 10, 10_000)
    place = options.number_or_none("bus", 0, 999), options.number_or_none("address", 0, 255)
    usb = _load()
    boards = _boards(usb, backend)
    fits = [
        board
        for board in boards
        if place[0] in (None, board.bus)
        and place[1] in (None, board.address)
        and (not url.place or _serial(usb, board) == url.place)
    ]
    if not fits:
        denied = [board for board in boards if _serial(usb, board) is None]
        if denied:
            raise no_permission(url.text, _node(denied[0]), "usb 87a0")
        raise missing(url.text, "such CP2130" if boards else "CP2130", _devices(usb, boards))
    if len(fits) > 1:
        raise several(url.text, _devices(usb, fits))
    device = fits[0]

    def claim() -> None:
        usb.util.claim_interface(device, _INTERFACE)

    with contextlib.ExitStack() as stack:
        stack.callback(usb.util.dispose_resources, device)
        try:
            with contextlib.suppress(NotImplementedError):
                if device.is_kernel_driver_active(_INTERFACE):
                    device.detach_kernel_driver(_INTERFACE)
            claim()
            endpoints = _endpoints(usb, url.text, device)
        except usb.core.USBError as error:
            raise _cannot_open(url.text, device, error) from error
        kept = contextlib.ExitStack()
        bus = Cp2130Bus(
            device,
            usb.core.USBError,
            claim=claim,
            release=kept.close,
            endpoints=endpoints,
            url=url.text,
            cs=cs,
            reset_gpio=reset_gpio,
            event_counter=event_counter,
            timeout_s=timeout_ms / 1000,
            clock=clock,
        )
        kept.push(stack.pop_all())
    return bus


def find_devices(*, backend: Any = None) -> list[Device]:
    """Boards that are connected, with the URL of each."""
    usb = _load()
    return _devices(usb, _boards(usb, backend))


def _load() -> Any:
    try:
        import usb.core
        import usb.util
    except ImportError:
        raise NotInstalledError("cp2130: pyusb is not installed: pip install 'adis-gonio[usb]'") from None
    return usb


def _libusb() -> Any:
    """Libusb of libusb-package, else the system's."""
    try:
        import libusb_package
    except ImportError:
        import usb.backend.libusb1

        return usb.backend.libusb1.get_backend()
    return libusb_package.get_libusb1_backend()


def _boards(usb: Any, backend: Any) -> list[Any]:
    backend = backend or _libusb()
    if backend is None:
        raise NotInstalledError("cp2130: libusb is not installed: pip install 'adis-gonio[usb]'")
    try:
        found = usb.core.find(find_all=True, backend=backend, idVendor=VENDOR_ID, idProduct=PRODUCT_ID)
        return sorted(found, key=lambda board: (board.bus or 0, board.address or 0))
    except usb.core.USBError as error:
        raise ProtocolError(f"cp2130: USB devices cannot be listed: {error.strerror or error}") from error


def _endpoints(usb: Any, url: str, device: Any) -> tuple[int, int]:
    """Bulk endpoints out and in by the board's descriptors.

    They are 0x01 and 0x82, or 0x02 and 0x81 where the board's OTP gives reading the higher priority.
    """
    interface = usb.util.find_descriptor(
        device.get_active_configuration(), bInterfaceNumber=_INTERFACE, bAlternateSetting=0
    )
    bulk = [
        endpoint.bEndpointAddress
        for endpoint in interface or ()
        if usb.util.endpoint_type(endpoint.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
    ]
    out = [address for address in bulk if address < usb.util.ENDPOINT_IN]
    back = [address for address in bulk if address >= usb.util.ENDPOINT_IN]
    if len(out) != 1 or len(back) != 1:
        raise ProtocolError(f"{url}: this board has no pair of bulk endpoints: is it a CP2130?")
    return out[0], back[0]


def _serial(usb: Any, board: Any) -> str | None:
    """Serial number, which only an opened device tells; None without permission."""
    try:
        return str(board.serial_number or "")
    except (usb.core.USBError, ValueError, NotImplementedError):
        return None
    finally:
        usb.util.dispose_resources(board)


def _node(board: Any) -> str:
    return f"/dev/bus/usb/{board.bus or 0:03d}/{board.address or 0:03d}"


def _devices(usb: Any, boards: list[Any]) -> list[Device]:
    serials = [_serial(usb, board) for board in boards]
    devices = []
    for board, serial in zip(boards, serials, strict=True):
        unique = serial and serial.isalnum() and serials.count(serial) == 1
        place = serial if unique else f"?bus={board.bus}&address={board.address}"
        denied = ", no permission (adis-gonio devices --udev)" if serial is None else ""
        devices.append(Device(f"cp2130:{place}", f"CP2130, USB to SPI, {_node(board)}{denied}"))
    return devices


def _cannot_open(url: str, device: Any, error: Any) -> BusError:
    if error.errno == errno.EACCES:
        return no_permission(url, _node(device), "usb 87a0")
    if error.errno == errno.EBUSY:
        return busy(url, _node(device))
    if error.errno in (errno.ENODEV, errno.ENOENT):
        return gone(url)
    return ProtocolError(f"{url}: the CP2130 cannot be opened: {error.strerror or error}")
