"""`mcp2210:` - a board with Microchip's MCP2210, by hidapi (extra `hid`).

`mcp2210:` where one board is connected, `mcp2210:SERIAL` where there are several. Options:

| option | meaning | default |
|---|---|---|
| `cs` | GP that is chip select, 0 to 8 | 0 |
| `reset_gpio` | GP on the chip's RST | none |
| `event_counter` | 1: data-ready is wired to GP6 | 0 |
| `timeout_ms` | time for one answer | 250 |
| `backend` | `hidraw` or `libusb`, on Linux | hidraw |
| `path` | the device's path as hidapi names it, where serial numbers do not tell boards apart | |
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from typing import Any
from urllib.parse import quote

from adis_gonio.base.errors import NotInstalledError
from adis_gonio.device.bus.host import (
    WALL,
    Clock,
    UrlOptions,
    busy,
    claimed,
    missing,
    no_permission,
    readable_and_writable,
    several,
)
from adis_gonio.device.bus.mcp2210.bus import TIMEOUT_S, Mcp2210Bus
from adis_gonio.device.bus.mcp2210.reports import PRODUCT_ID, VENDOR_ID
from adis_gonio.device.bus.mcp2210.writes import HidDevice, TimedWrites
from adis_gonio.device.bus.opening import BusUrl, Device

__all__ = ["Mcp2210Bus", "find_devices", "open_from_url"]

_OPTIONS = ("cs", "reset_gpio", "event_counter", "timeout_ms", "backend", "path")
_BACKENDS = ("hidraw", "libusb")


def open_from_url(url: BusUrl, *, hid: Any = None, clock: Clock = WALL) -> Mcp2210Bus:
    """Open a board (see the module's text).

    Parameters
    ----------
    hid : module
        In place of hidapi's; its writes must not block.
    clock : Clock
        The bus's clock.

    Raises
    ------
    UsageError
        An unknown option, or several boards fit.
    NotInstalledError
        hidapi is not installed.
    CannotOpenError
        No such board, no permission, or another program has it.
    """
    options = UrlOptions(url, _OPTIONS)
    backend = options.one_of("backend", _BACKENDS)
    cs = options.number("cs", 0, 0, 8)
    reset_gpio = options.number_or_none("reset_gpio", 0, 8)
    event_counter = options.switch("event_counter")
    timeout_ms = options.number("timeout_ms", round(TIMEOUT_S * 1000), 10, 10_000)
    blocks = hid is None
    hid = hid or _load(backend)
    boards = _boards(hid)
    wanted = options.text("path")
    fits = [
        board
        for board in boards
        if (not wanted or _path(board) == wanted) and (not url.place or _serial(board) == url.place)
    ]
    if not fits:
        raise missing(url.text, "such MCP2210" if boards else "MCP2210", _devices(boards))
    if len(fits) > 1:
        raise several(url.text, _devices(fits))
    with contextlib.ExitStack() as stack:
        device: HidDevice = _open(hid, url.text, fits[0], stack)
        if blocks:
            device = TimedWrites(device)
        stack.callback(device.close)
        kept = contextlib.ExitStack()
        bus = Mcp2210Bus(
            device,
            url=url.text,
            cs=cs,
            reset_gpio=reset_gpio,
            event_counter=event_counter,
            timeout_s=timeout_ms / 1000,
            clock=clock,
            release=kept.close,
        )
        kept.push(stack.pop_all())
    return bus


def find_devices(*, hid: Any = None) -> list[Device]:
    """Boards that are connected, with the URL of each."""
    return _devices(_boards(hid or _load(_BACKENDS[0])))


def _load(backend: str) -> Any:
    """Hidapi's module: on Linux it has two, one a backend."""
    names = ["hidraw", "hid"] if sys.platform == "linux" and backend == "hidraw" else ["hid"]
    for name in names:
        with contextlib.suppress(ImportError):
            module = importlib.import_module(name)
            if hasattr(module, "device"):
                return module
            raise NotInstalledError(
                "mcp2210: module 'hid' belongs to package hid, not hidapi: pip uninstall hid;"
                " pip install --force-reinstall hidapi"
            )
    raise NotInstalledError("mcp2210: hidapi is not installed: pip install 'adis-gonio[hid]'")


def _open(hid: Any, url: str, board: dict[str, Any], stack: contextlib.ExitStack) -> HidDevice:
    path = _path(board)
    node = _node(path)
    if not readable_and_writable(node):
        raise no_permission(url, node, f"{'hidraw' if 'hidraw' in node else 'usb'} 04d8")
    stack.enter_context(claimed(node, url))
    device = hid.device()
    try:
        device.open_path(board["path"])
    except OSError:
        # hidapi says no more than "open failed": ask what it may have been.
        if not any(_path(other) == path for other in _boards(hid)):
            raise missing(url, "MCP2210 any more") from None
        raise busy(url, node) from None
    opened: HidDevice = device
    return opened


def _boards(hid: Any) -> list[dict[str, Any]]:
    found = hid.enumerate(VENDOR_ID, PRODUCT_ID)
    return sorted(found, key=lambda board: (_serial(board), _path(board)))


def _path(board: dict[str, Any]) -> str:
    path = board["path"]
    return path.decode(errors="replace") if isinstance(path, bytes) else str(path)


def _serial(board: dict[str, Any]) -> str:
    return str(board.get("serial_number") or "")


def _node(path: str) -> str:
    """Device file behind a path of hidapi: itself, or for libusb the node of the port it names."""
    if path.startswith("/"):
        return path
    from pathlib import Path

    port = Path("/sys/bus/usb/devices") / path.partition(":")[0]
    try:
        bus, number = (int((port / name).read_text()) for name in ("busnum", "devnum"))
    except (OSError, ValueError):
        return path
    return f"/dev/bus/usb/{bus:03d}/{number:03d}"


def _devices(boards: list[dict[str, Any]]) -> list[Device]:
    serials = [_serial(board) for board in boards]
    devices = []
    for board, serial in zip(boards, serials, strict=True):
        path = _path(board)
        unique = serial.isalnum() and serials.count(serial) == 1
        place = serial if unique else f"?path={quote(path, safe='/')}"
        denied = "" if readable_and_writable(_node(path)) else ", no permission (adis-gonio devices --udev)"
        name = board.get("product_string") or "MCP2210"
        devices.append(Device(f"mcp2210:{place}", f"{name}, HID to SPI, {path}{denied}"))
    return devices
