"""`spidev:/dev/spidev0.0` - SPI pins of a Raspberry Pi and other Linux boards; needs no package.

| option | meaning | default |
|---|---|---|
| `reset_gpio` | the chip's RST: `17` on gpiochip0, or `gpiochip4:17` | none |
| `cs_high_us` | time that the kernel keeps CS high within a message | 10 |
"""

from __future__ import annotations

import contextlib
import errno
import re
from pathlib import Path

from adis_gonio.base.errors import BusError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus.host import (
    WALL,
    Clock,
    UrlOptions,
    busy,
    missing,
    no_permission,
    readable_and_writable,
    several,
)
from adis_gonio.device.bus.opening import BusUrl, Device
from adis_gonio.device.bus.spidev.bus import CS_HIGH_US, SpidevBus
from adis_gonio.device.bus.spidev.kernel import GET_LINE, Kernel, LinuxKernel, open_drain_line

__all__ = ["SpidevBus", "find_devices", "open_from_url"]

_OPTIONS = ("reset_gpio", "cs_high_us")
_LINE = re.compile(r"(?:(gpiochip\d+):)?(\d+)")


def open_from_url(
    url: BusUrl, *, system: Kernel | None = None, clock: Clock = WALL, folder: str = "/dev"
) -> SpidevBus:
    """Open a device file (see the module's text).

    Parameters
    ----------
    system : Kernel
        System calls, in place of Linux's.
    clock : Clock
        The bus's clock.
    folder : str
        Where device files are looked for.

    Raises
    ------
    UsageError
        An unknown option, or several device files fit.
    CannotOpenError
        No such file, no permission, or another program has it.
    """
    options = UrlOptions(url, _OPTIONS)
    cs_high_us = options.number("cs_high_us", round(CS_HIGH_US), 0, 1_000_000)
    line = _line(url, options)
    path = url.place
    if not path:
        devices = find_devices(folder=folder)
        if len(devices) > 1:
            raise several(url.text, devices)
        if not devices:
            raise missing(url.text, "SPI device file (on a Raspberry Pi: dtparam=spi=on)")
        path = BusUrl.parse(devices[0].url).place
    if system is None:
        try:
            system = LinuxKernel()
        except ImportError:
            raise CannotOpenError(f"{url.text}: spidev is Linux's; this system has none") from None
    with contextlib.ExitStack() as stack:
        fd = _open(system, url.text, path, "spidev", folder)
        stack.callback(system.close, fd)
        try:
            system.lock(fd)
        except BlockingIOError:
            raise busy(url.text, path) from None
        reset_fd = None
        if line is not None:
            reset_fd = _request_line(system, url.text, f"{folder}/{line[0]}", line[1], folder)
            stack.callback(system.close, reset_fd)
        kept = contextlib.ExitStack()
        bus = SpidevBus(
            system,
            fd,
            release=kept.close,
            url=url.text,
            cs_high_us=cs_high_us,
            reset_fd=reset_fd,
            clock=clock,
        )
        kept.push(stack.pop_all())
    return bus


def find_devices(*, folder: str = "/dev") -> list[Device]:
    """SPI device files of this machine."""
    devices = []
    for path in sorted(Path(folder).glob("spidev*")):
        denied = "" if readable_and_writable(str(path)) else ", no permission (adis-gonio devices --udev)"
        devices.append(Device(f"spidev:{path}", f"SPI pins of this machine{denied}"))
    return devices


def _line(url: BusUrl, options: UrlOptions) -> tuple[str, int] | None:
    text = options.text("reset_gpio")
    if not text:
        return None
    found = _LINE.fullmatch(text)
    if found is None:
        raise UsageError(f"'{url.text}': reset_gpio is a line such as 17 or gpiochip4:17")
    return found[1] or "gpiochip0", int(found[2])


def _open(system: Kernel, url: str, path: str, rule: str, folder: str) -> int:
    try:
        return system.open(path)
    except OSError as error:
        raise _cannot_open(error, url, path, rule, folder) from error


def _request_line(system: Kernel, url: str, path: str, offset: int, folder: str) -> int:
    chip = _open(system, url, path, "gpiochip", folder)
    request = open_drain_line(offset)
    try:
        system.ioctl(chip, GET_LINE, request)
    except OSError as error:
        if error.errno == errno.EINVAL:
            raise UsageError(f"{url}: {path} has no line {offset}") from error
        raise _cannot_open(error, url, f"line {offset} of {path}", "gpiochip", folder) from error
    finally:
        system.close(chip)
    return int(request.fd)


def _cannot_open(error: OSError, url: str, path: str, rule: str, folder: str) -> BusError:
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return missing(url, f"{path} (on a Raspberry Pi: dtparam=spi=on)", find_devices(folder=folder))
    if error.errno in (errno.EACCES, errno.EPERM):
        return no_permission(url, path, rule)
    if error.errno == errno.EBUSY:
        return busy(url, path)
    return ProtocolError(f"{url}: {path} cannot be opened: {error.strerror or error}")
