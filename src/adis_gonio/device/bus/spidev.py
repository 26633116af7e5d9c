"""`spidev:/dev/spidev0.0` - SPI pins of a Raspberry Pi and other Linux boards; needs no package.

| option | meaning | default |
|---|---|---|
| `reset_gpio` | the chip's RST: name of a GPIO line, such as `GPIO17`, or `gpiochip0:17` | none |
| `cs_high_us` | time for which the kernel keeps CS high within a message | 10 |

A whole batch of frames is sent by one ioctl if the kernel can keep the stall (the pause between two
frames); otherwise each frame is sent by an ioctl of its own. The structures follow the kernel
(linux/spi/spidev.h, linux/gpio.h), with pointers of 64 bits on all systems.

Timing
    A message (SPI_IOC_MESSAGE) has one or more transfers. Between two transfers with `cs_change` the kernel
    raises CS (chip select) and keeps it high for 10 µs. The field `delay_usecs` acts *before* the rise, so
    that it cannot lengthen the stall, and spidev passes on no other delay. In the chip's fast mode, which
    needs a stall of 9 µs, the whole batch is one message. The clock is then so slow that 16 clocks and the
    10 µs fill the frame period. CS rises right after the last clock, as required by the chip's sleep
    command. In normal mode, which needs a stall of 75 µs, each frame is a message and the host waits
    between messages. If the device tree lengthens the 10 µs (`spi-cs-inactive-delay-ns`), set `cs_high_us`
    to the longer time; if it is at least 75 µs, batches are one message in normal mode too.
Sizes
    A message has at most 511 transfers because of the size field of the ioctl's number, and fewer if the
    driver's buffer (`bufsiz`, 4096 bytes) is short, since newer kernels round each transfer up to a cache
    line. A message that is too long is refused before anything is clocked (EMSGSIZE); it is then sent in
    halves, and the host keeps the stall between them.
Errors
    An ioctl has no time-out; the kernel's controller drivers have their own.
"""

from __future__ import annotations

import contextlib
import ctypes
import difflib
import errno
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.base.errors import BusError, BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus import host
from adis_gonio.device.bus.contract import FRAME_BITS, Capability, SpiTiming, Words
from adis_gonio.device.bus.opening import BusUrl, Device

_WRITE, _READ = 1, 2
_SIZE_BITS = 14


def _ioc(direction: int, kind: int, number: int, size: int) -> int:
    return direction << 30 | size << 16 | kind << 8 | number


class Transfer(ctypes.Structure):
    """Linux struct spi_ioc_transfer: one transfer of a message."""

    _fields_ = (
        ("tx_buf", ctypes.c_uint64),
        ("rx_buf", ctypes.c_uint64),
        ("len", ctypes.c_uint32),
        ("speed_hz", ctypes.c_uint32),
        ("delay_usecs", ctypes.c_uint16),
        ("bits_per_word", ctypes.c_uint8),
        ("cs_change", ctypes.c_uint8),
        ("tx_nbits", ctypes.c_uint8),
        ("rx_nbits", ctypes.c_uint8),
        ("word_delay_usecs", ctypes.c_uint8),
        ("pad", ctypes.c_uint8),
    )


TRANSFER_SIZE = ctypes.sizeof(Transfer)
MOST_TRANSFERS = ((1 << _SIZE_BITS) - 1) // TRANSFER_SIZE
"""Largest number of transfers that the size field of an ioctl number can hold: 511."""

_SPI = ord("k")
WR_MODE32 = _ioc(_WRITE, _SPI, 5, 4)
RD_MODE32 = _ioc(_READ, _SPI, 5, 4)
MODE_3 = MODE_BITS = 0b11
LSB_FIRST, THREE_WIRE, LOOP = 0x08, 0x10, 0x20
BENT_FRAMES = LSB_FIRST | THREE_WIRE | LOOP
"""Flags of the SPI mode that change the bits of a frame or their source, and so must be zero.

The other flags define the drive of CS and belong to the kernel: since 5.4 it sets SPI_CS_HIGH if CS is a
GPIO of any polarity.
"""


def message(count: int) -> int:
    """Return the number of the ioctl SPI_IOC_MESSAGE for `count` transfers."""
    return _ioc(_WRITE, _SPI, 0, count * TRANSFER_SIZE)


class _LineAttribute(ctypes.Structure):
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("padding", ctypes.c_uint32),
        ("value", ctypes.c_uint64),
        ("mask", ctypes.c_uint64),
    )


class LineRequest(ctypes.Structure):
    """Linux struct gpio_v2_line_request, a request for GPIO lines, with its configuration included."""

    _fields_ = (
        ("offsets", ctypes.c_uint32 * 64),
        ("consumer", ctypes.c_char * 32),
        ("flags", ctypes.c_uint64),
        ("num_attrs", ctypes.c_uint32),
        ("config_padding", ctypes.c_uint32 * 5),
        ("attrs", _LineAttribute * 10),
        ("num_lines", ctypes.c_uint32),
        ("event_buffer_size", ctypes.c_uint32),
        ("padding", ctypes.c_uint32 * 5),
        ("fd", ctypes.c_int32),
    )


class LineValues(ctypes.Structure):
    """Linux struct gpio_v2_line_values, levels of GPIO lines."""

    _fields_ = (("bits", ctypes.c_uint64), ("mask", ctypes.c_uint64))


class ChipInfo(ctypes.Structure):
    """Linux struct gpiochip_info, name and number of lines of a GPIO chip."""

    _fields_ = (("name", ctypes.c_char * 32), ("label", ctypes.c_char * 32), ("lines", ctypes.c_uint32))


class LineInfo(ctypes.Structure):
    """Linux struct gpio_v2_line_info, name and use of a GPIO line."""

    _fields_ = (
        ("name", ctypes.c_char * 32),
        ("consumer", ctypes.c_char * 32),
        ("offset", ctypes.c_uint32),
        ("num_attrs", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("attrs", ctypes.c_uint64 * 20),
        ("padding", ctypes.c_uint32 * 4),
    )


GET_CHIP_INFO = _ioc(_READ, 0xB4, 0x01, ctypes.sizeof(ChipInfo))
GET_LINE_INFO = _ioc(_READ | _WRITE, 0xB4, 0x05, ctypes.sizeof(LineInfo))
GET_LINE = _ioc(_READ | _WRITE, 0xB4, 0x07, ctypes.sizeof(LineRequest))
SET_VALUES = _ioc(_READ | _WRITE, 0xB4, 0x0F, ctypes.sizeof(LineValues))
LINE_OUTPUT, LINE_OPEN_DRAIN = 1 << 3, 1 << 6
ATTRIBUTE_VALUES = 2


class Kernel:
    """The system calls of Linux that this module uses; tests replace them.

    Raises
    ------
    ImportError
        This system has no `fcntl`.
    """

    def __init__(self) -> None:
        import fcntl

        self._fcntl = fcntl

    def open(self, path: str) -> int:
        """Open a device file for reading and writing; return its file descriptor."""
        return os.open(path, os.O_RDWR | os.O_CLOEXEC)

    def ioctl(self, fd: int, request: int, argument: Any) -> int:
        """Call ioctl(2) with a ctypes object that the kernel reads and writes; return its result."""
        result: int = self._fcntl.ioctl(fd, request, argument, True)
        return result

    def lock(self, fd: int) -> None:
        """Lock the file of a descriptor by flock(2), exclusively and without waiting."""
        self._fcntl.flock(fd, self._fcntl.LOCK_EX | self._fcntl.LOCK_NB)

    def close(self, fd: int) -> None:
        """Close a file descriptor by close(2)."""
        os.close(fd)


CS_HIGH_US = 10.0
"""CS-high time in µs between two transfers with cs_change; not confirmed by a document.

It is the default of the kernel's SPI core (`_spi_transfer_cs_change_delay`); a controller driver with its
own loop may differ.
"""

SLOWEST_HZ = 10_000
"""Slowest clock in Hz that may fill a frame period; below it frames are sent one by one."""


class SpidevBus(host.HostBus):
    """A bus over an open spidev file of the Linux kernel.

    Parameters
    ----------
    system : Kernel
        Object that makes the system calls.
    fd : int
        The open device file.
    url : str
        URL of the bus, used in messages.
    cs_high_us : float
        Time that the kernel keeps CS high between the transfers of a message.
    reset_fd : int or None
        Descriptor of the requested open-drain GPIO line on the chip's RST; None if none is wired.
    clock : Clock
        The bus's clock.

    Raises
    ------
    CannotOpenError
        The controller cannot do mode 3.
    BusError
        The file is no spidev, or another mode is read back.
    """

    def __init__(
        self,
        system: Kernel,
        fd: int,
        url: str,
        cs_high_us: float,
        reset_fd: int | None,
        clock: host.Clock = host.WALL,
    ) -> None:
        super().__init__(url, clock)
        self._system = system
        self._fd = fd
        self._cs_high_us = cs_high_us
        self._reset_fd = reset_fd
        self._most = MOST_TRANSFERS
        if reset_fd is not None:
            self.capabilities = frozenset({Capability.HARD_RESET})
        self._set_mode()
        self._timing = self._configure(host.SAFE_TIMING)

    # -- frames ------------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        if timing.clock_hz < 1:
            raise UsageError(f"{self.url}: a clock of {timing.clock_hz:g} Hz is not possible")
        return SpiTiming(float(int(self._clock_for(timing))), timing.stall_us, timing.period_us)

    def _clock_for(self, timing: SpiTiming) -> float:
        """Return the SPI clock in Hz at which a frame takes as long as the frame period of `timing`.

        The frames of one kernel message then keep the period without waits by the host. If the kernel
        cannot keep the stall of `timing`, or this clock would be faster than requested or below
        `SLOWEST_HZ`, the requested clock is returned.
        """
        if timing.stall_us > self._cs_high_us:
            return timing.clock_hz
        left_us = timing.period_us - self._cs_high_us
        filling = FRAME_BITS / left_us * 1e6 if left_us > 0 else timing.clock_hz
        return min(timing.clock_hz, filling) if filling >= SLOWEST_HZ else timing.clock_hz

    def _fills(self, timing: SpiTiming) -> bool:
        """Return True if the frames of one kernel message keep the stall and period of `timing`."""
        frame_us = FRAME_BITS / timing.clock_hz * 1e6 + self._cs_high_us
        return self._cs_high_us >= timing.stall_us and frame_us >= timing.period_us

    def _exchange(self, frames: Words) -> Words:
        replies = np.empty(len(frames), np.uint16)
        at = 0
        while at < len(frames):
            size = min(self._most, len(frames) - at) if self._fills(self._timing) else 1
            self._pace.wait(self._timing)
            try:
                replies[at : at + size] = self._message(frames[at : at + size])
            except OSError as error:
                if error.errno == errno.EMSGSIZE and size > 1:
                    self._most = size // 2  # refused before anything was clocked
                    continue
                raise self._typed(error) from error
            finally:
                self._pace.done(self._timing)
            at += size
        return replies

    def _message(self, frames: Words) -> Words:
        """Send n frames (n,) by one ioctl, each with chip select low by itself; return the replies (n,)."""
        count = len(frames)
        sent = frames.astype(">u2")
        received = np.zeros(count, ">u2")
        step = sent.itemsize
        transfers = (Transfer * count)()
        for j, transfer in enumerate(transfers):
            transfer.tx_buf = sent.ctypes.data + j * step
            transfer.rx_buf = received.ctypes.data + j * step
            transfer.len = step
            transfer.speed_hz = int(self._timing.clock_hz)
            transfer.bits_per_word = 8
            # On the last transfer cs_change would leave CS low.
            transfer.cs_change = j < count - 1
        clocked = self._system.ioctl(self._fd, message(count), transfers)
        if clocked != count * step:
            raise ProtocolError(f"{self.url}: {clocked} of {count * step} bytes were clocked")
        return received.astype(np.uint16)

    # -- optional capabilities -----------------------------------------------------------------------------

    def _pull_reset(self) -> None:
        for bit in (0, 1):
            self._call(self._reset_fd or 0, SET_VALUES, LineValues(bit, 1))
            self.sleep_s(host.RESET_PULSE_S)

    # -- calls ---------------------------------------------------------------------------------------------

    def _set_mode(self) -> None:
        mode = self._mode() & ~(MODE_BITS | BENT_FRAMES) | MODE_3
        try:
            self._system.ioctl(self._fd, WR_MODE32, ctypes.c_uint32(mode))
        except OSError as error:
            if error.errno == errno.EINVAL:
                raise CannotOpenError(
                    f"{self.url}: this controller cannot do SPI mode 3 (CPHA = 1), as the auxiliary SPI of"
                    " a Raspberry Pi (spidev1.x): wire the sensor to the main one (spidev0.x)"
                ) from error
            raise self._typed(error) from error
        got = self._mode() & (MODE_BITS | BENT_FRAMES)
        if got != MODE_3:
            raise ProtocolError(f"{self.url}: the SPI controller is in mode {got:#x}, not 3")

    def _mode(self) -> int:
        """Read the SPI mode and its flags from the kernel."""
        mode = ctypes.c_uint32()
        self._call(self._fd, RD_MODE32, mode)
        return mode.value

    def _call(self, fd: int, request: int, argument: Any) -> None:
        try:
            self._system.ioctl(fd, request, argument)
        except OSError as error:
            raise self._typed(error) from error

    def _typed(self, error: OSError) -> BusError:
        if error.errno in (errno.ENODEV, errno.ESHUTDOWN, errno.ENXIO):
            return host.gone_error(self.url)
        if error.errno == errno.ETIMEDOUT:
            return BusTimeoutError(f"{self.url}: the SPI controller does not finish a transfer")
        if error.errno == errno.ENOTTY:
            return ProtocolError(f"{self.url}: this is no spidev file")
        return ProtocolError(f"{self.url}: the SPI driver failed: {error.strerror or error}")


def open_from_url(
    url: BusUrl, *, system: Kernel | None = None, clock: host.Clock = host.WALL, folder: str = "/dev"
) -> SpidevBus:
    """Open a spidev device file by its URL (see the module's text).

    Parameters
    ----------
    system : Kernel
        Object that makes the system calls; None uses Linux.
    clock : Clock
        The bus's clock.
    folder : str
        Folder of the device files.

    Raises
    ------
    UsageError
        An unknown option, or several device files fit.
    CannotOpenError
        No such file, no permission, or another program has it.
    """
    options = host.UrlOptions(url, ("reset_gpio", "cs_high_us"))
    cs_high_us = options.number("cs_high_us", round(CS_HIGH_US), 0, 1_000_000)
    line = options.text("reset_gpio")
    if line.isdecimal():
        raise UsageError(
            f"'{url.text}': reset_gpio={line} could be on several GPIO chips;"
            f" name the line (GPIO{line}) or its chip (gpiochip0:{line})"
        )
    path = url.place
    if not path:
        found = find_devices(folder=folder)
        only = host.choose_board(
            url, "SPI device file (on a Raspberry Pi: dtparam=spi=on)", found, [], list
        )
        path = BusUrl.parse(only.url).place
    if system is None:
        try:
            system = Kernel()
        except ImportError:
            raise CannotOpenError(f"{url.text}: spidev is a part of Linux; this system has none") from None
    with contextlib.ExitStack() as stack:
        fd = _open(system, url.text, path, "spidev", folder)
        stack.callback(system.close, fd)
        try:
            system.lock(fd)
        except BlockingIOError:
            raise host.busy_error(url.text, path) from None
        reset_fd = None
        if line:
            reset_fd = _request_line(system, url.text, *_find_line(system, url.text, line, folder), folder)
            stack.callback(system.close, reset_fd)
        return SpidevBus(system, fd, url.text, cs_high_us, reset_fd, clock).take_over(stack)


def find_devices(*, folder: str = "/dev") -> list[Device]:
    """List the SPI device files (spidev) of this computer.

    `folder` is the folder of the device files.
    """
    return [
        Device(f"spidev:{path}", f"SPI pins of this machine{host.permission_note(str(path))}")
        for path in sorted(Path(folder).glob("spidev*"))
    ]


def _find_line(system: Kernel, url: str, line: str, folder: str) -> tuple[str, int]:
    """Find a GPIO line by `gpiochipN:OFFSET` or by its name; return the path of its chip and its offset.

    `folder` is the folder of the device files.
    """
    if written := re.fullmatch(r"(gpiochip\d+):(\d+)", line):
        return f"{folder}/{written[1]}", int(written[2])
    names: dict[str, list[tuple[str, int]]] = {}
    for path in map(str, sorted(Path(folder).glob("gpiochip*"))):
        chip = _open(system, url, path, "gpiochip", folder)
        try:
            about = ChipInfo()
            system.ioctl(chip, GET_CHIP_INFO, about)
            for offset in range(about.lines):
                info = LineInfo(offset=offset)
                system.ioctl(chip, GET_LINE_INFO, info)
                names.setdefault(info.name.decode(errors="replace"), []).append((path, offset))
        except OSError as error:
            raise _cannot_open(error, url, path, "gpiochip", folder) from error
        finally:
            system.close(chip)
    names.pop("", None)
    found = names.get(line, [])
    if len(found) == 1:
        return found[0]
    if found:
        places = " or ".join(f"{Path(path).name}:{offset}" for path, offset in found)
        raise UsageError(f"'{url}': {len(found)} GPIO lines are called '{line}'; choose {places}")
    near = difflib.get_close_matches(line, names, n=3)
    hint = f"did you mean {' or '.join(near)}?" if near else "gpioinfo lists the lines"
    raise UsageError(f"'{url}': no GPIO line is called '{line}'; {hint}")


def _open(system: Kernel, url: str, path: str, rule: str, folder: str) -> int:
    try:
        return system.open(path)
    except OSError as error:
        raise _cannot_open(error, url, path, rule, folder) from error


def _request_line(system: Kernel, url: str, path: str, offset: int, folder: str) -> int:
    chip = _open(system, url, path, "gpiochip", folder)
    # An open-drain output that is at first released.
    request = LineRequest(consumer=b"adis-gonio reset", flags=LINE_OUTPUT | LINE_OPEN_DRAIN)
    request.offsets[0] = offset
    request.num_lines = request.num_attrs = 1
    request.attrs[0].id = ATTRIBUTE_VALUES
    request.attrs[0].value = request.attrs[0].mask = 1
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
    def missing() -> BusError:
        what = f"{path} (on a Raspberry Pi: dtparam=spi=on)"
        return host.missing_error(url, what, find_devices(folder=folder))

    return host.opening_error(error, url, path, rule, missing)
