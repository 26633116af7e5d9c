"""Linux's spidev and GPIO files at the level of ioctl, as the kernel's SPI core treats them.

Memory is read and written at the addresses that the structures name. The order of things is the core's:
transfer, `delay_usecs`, rise of CS where `cs_change` is set, 10 µs, fall of CS; at the end of a message CS
rises unless the last transfer asked to keep it.

Where chip select is a GPIO, newer cores set SPI_CS_HIGH although the wire is active low, for the polarity
is the GPIO descriptor's. Kernels differ in what they make of the flag (`CsFlag`).
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from enum import Enum

from adis_gonio.sim.testing.faults import Faults
from adis_gonio.sim.testing.pins import ChipPins

TRANSFER = struct.Struct("<QQIIHBBBBBB")
MESSAGE = 0x40006B00
WR_BITS, WR_SPEED, WR_MODE32, RD_MODE32 = 0x40016B03, 0x40046B04, 0x40046B05, 0x80046B05
GET_LINE, SET_VALUES = 0xC250B407, 0xC010B40F
CHIP_INFO, LINE_INFO = 0x8044B401, 0xC100B405
CS_HIGH_S = 10e-6
CPHA, CPOL, CS_HIGH, LSB_FIRST, THREE_WIRE, LOOP = 1, 2, 4, 8, 0x10, 0x20
KNOWN_FLAGS = 0x7FFF


class CsFlag(Enum):
    """What becomes of SPI_CS_HIGH."""

    NATIVE = "the controller drives CS itself: the flag is the caller's"
    FORCED = "CS is a GPIO: set whatever is written, and read back (from commit 138c9c32f090, 5.6, on)"
    HIDDEN = "CS is a GPIO: set whatever is written, and not read back (from commit 7dbfa445ff73, 6.2, on)"
    TRUSTED = (
        "CS is a GPIO: set at first and read back, and lost where a mode without it is written (before)"
    )


def os_error(code: int) -> OSError:
    return OSError(code, os.strerror(code))


def _turned(data: bytes) -> bytes:
    return bytes(int(f"{byte:08b}"[::-1], 2) for byte in data)


class FakeSpidevKernel:
    """A machine with spidev files.

    Parameters
    ----------
    pins : mapping of path to ChipPins
        What hangs on each file.
    bufsiz : int
        Module parameter of spidev.
    align : int
        What a transfer is rounded up to against `bufsiz` (ARCH_DMA_MINALIGN).
    cs_flag : CsFlag
        How this kernel treats SPI_CS_HIGH.
    supports : int
        Flags of the mode that the controller can do; others are EINVAL.
    mode : int
        What the file was left with by the device tree or another program.
    """

    def __init__(
        self,
        pins: dict[str, ChipPins],
        *,
        bufsiz: int = 4096,
        align: int = 8,
        cs_high_s: float = CS_HIGH_S,
        faults: Faults | None = None,
        call_s: float = 5e-6,
        cs_flag: CsFlag = CsFlag.FORCED,
        supports: int = KNOWN_FLAGS,
        mode: int = 0,
    ) -> None:
        self.pins = pins
        self.bufsiz = bufsiz
        self.align = align
        self.cs_high_s = cs_high_s
        self.faults = faults or Faults()
        self.call_s = call_s
        self.cs_flag = cs_flag
        self.supports = supports
        self.refuse_open: int | None = None
        self.unplugged = False
        self.reset_line = 17
        self.chips = {"gpiochip0": [f"GPIO{k}" for k in range(54)]}
        self.requested: list[tuple[str, int]] = []
        self.locked: set[str] = set()
        self.files: dict[int, str] = {}
        high = 0 if cs_flag is CsFlag.NATIVE else CS_HIGH
        self.modes = dict.fromkeys(pins, mode | high)
        self.messages: list[int] = []
        self.line_low = False
        self._next = 100

    # -- calls ------------------------------------------------------------------------------------------

    def open(self, path: str) -> int:
        if self.refuse_open is not None:
            raise os_error(self.refuse_open)
        if path not in self.pins and path.rpartition("/")[2] not in self.chips:
            raise os_error(errno.ENOENT)
        return self._new(path)

    def lock(self, fd: int) -> None:
        path = self.files[fd]
        if path in self.locked:
            raise BlockingIOError(errno.EWOULDBLOCK, "Resource temporarily unavailable")
        self.locked.add(path)

    def close(self, fd: int) -> None:
        path = self.files.pop(fd)
        if path not in self.files.values():
            self.locked.discard(path)

    def ioctl(self, fd: int, request: int, argument) -> int:
        path = self.files[fd]
        size = request >> 16 & 0x3FFF
        assert size == ctypes.sizeof(argument), "the size in the number is the argument's"
        if path == "line":
            return self._set_line(request, bytes(argument))
        if (names := self.chips.get(path.rpartition("/")[2])) is not None:
            if request == GET_LINE:
                self.requested.append(
                    (path.rpartition("/")[2], struct.unpack_from("<I", bytes(argument))[0])
                )
            return self._ask_chip(names, request, argument)
        if self.unplugged:
            raise os_error(errno.ESHUTDOWN)
        if request & ~0x3FFF0000 == MESSAGE:
            return self._message(path, bytes(argument), size)
        if request == WR_MODE32:
            self._set_mode(path, struct.unpack("<I", bytes(argument))[0])
        elif request == RD_MODE32:
            hidden = CS_HIGH if self.cs_flag is CsFlag.HIDDEN else 0
            ctypes.memmove(ctypes.addressof(argument), struct.pack("<I", self.modes[path] & ~hidden), 4)
        elif request not in (WR_BITS, WR_SPEED):
            raise os_error(errno.ENOTTY)
        return 0

    def _set_mode(self, path: str, mode: int) -> None:
        if self.cs_flag in (CsFlag.FORCED, CsFlag.HIDDEN):
            mode |= CS_HIGH
        if mode & ~self.supports:
            raise os_error(errno.EINVAL)
        self.modes[path] = mode

    def _chip_sees_its_select(self, path: str) -> bool:
        """CS of the chip is active low; on a GPIO the flag says that the descriptor's polarity holds."""
        return bool(self.modes[path] & CS_HIGH) is (self.cs_flag is not CsFlag.NATIVE)

    def _new(self, path: str) -> int:
        self._next += 1
        self.files[self._next] = path
        return self._next

    # -- SPI ---------------------------------------------------------------------------------------------

    def _message(self, path: str, data: bytes, size: int) -> int:
        pins, faults = self.pins[path], self.faults
        clock = pins.clock
        clock.advance_to(clock.now_s() + self.call_s)
        if not size or size % TRANSFER.size:
            raise os_error(errno.EINVAL)
        transfers = list(TRANSFER.iter_unpack(data))
        if sum(-(-length // self.align) * self.align for _, _, length, *_ in transfers) > self.bufsiz:
            raise os_error(errno.EMSGSIZE)
        if faults.happens("unplug"):
            self.unplugged = True
            raise os_error(errno.ESHUTDOWN)
        if faults.happens("busy"):
            raise os_error(errno.EBUSY)
        self.messages.append(len(transfers))
        total = 0
        now = clock.now_s()
        for k, (tx, rx, length, speed, delay, bits, change, *_rest) in enumerate(transfers):
            last = k == len(transfers) - 1
            if last and change:
                raise AssertionError("cs_change on the last transfer keeps CS low")
            if not last and not change:
                raise AssertionError("two frames in one chip-select period")
            assert bits == 8, "words of another size are in the host's byte order"
            assert speed, "0 is the file's own clock, not a slow one"
            if faults.happens("hang"):
                clock.advance_to(now + 1.0)
                raise os_error(errno.ETIMEDOUT)
            if faults.happens("drop"):
                raise os_error(errno.EIO)
            mode = self.modes[path]
            assert not mode & (THREE_WIRE | LOOP), "MISO is not what comes in"
            sent = ctypes.string_at(tx, length)
            reply = pins.transfer(
                _turned(sent) if mode & LSB_FIRST else sent,
                clock_hz=speed,
                mode=mode & 3,
                cs_hold_s=delay * 1e-6,
                selected=self._chip_sees_its_select(path),
                start_s=now,
            )
            ctypes.memmove(rx, _turned(reply) if mode & LSB_FIRST else reply, length)
            total += length
            now = pins.free_s + self.cs_high_s
        return total - (1 if faults.happens("short") else 0)

    # -- GPIO ---------------------------------------------------------------------------------------------

    def _ask_chip(self, names: list[str], request: int, argument) -> int:
        """Answer as linux/gpio.h describes: gpiochip_info, gpio_v2_line_info, gpio_v2_line_request."""
        there = ctypes.addressof(argument)
        if request == CHIP_INFO:
            ctypes.memmove(there, struct.pack("<32s32sI", b"gpiochip", b"pins", len(names)), 68)
        elif request == LINE_INFO:
            offset = struct.unpack_from("<I", bytes(argument), 64)[0]
            if offset >= len(names):
                raise os_error(errno.EINVAL)
            ctypes.memmove(there, struct.pack("<32s", names[offset].encode()), 32)
        else:
            return self._get_line(request, argument)
        return 0

    def _get_line(self, request: int, argument) -> int:
        if request != GET_LINE:
            raise os_error(errno.ENOTTY)
        data = bytes(argument)
        assert len(data) == 592
        offset, flags = struct.unpack_from("<I", data)[0], struct.unpack_from("<Q", data, 288)[0]
        attributes, kind, value, mask = (
            struct.unpack_from("<I", data, 296)[0],
            *struct.unpack_from("<I4xQQ", data, 320),
        )
        lines = struct.unpack_from("<I", data, 560)[0]
        assert (flags, attributes, kind, lines) == (1 << 3 | 1 << 6, 1, 2, 1), "open-drain"
        assert value & mask == 1, "high"
        if offset > 53:
            raise os_error(errno.EINVAL)
        if offset != self.reset_line:
            raise os_error(errno.EBUSY)
        fd = self._new("line")
        ctypes.memmove(ctypes.addressof(argument) + 588, struct.pack("<i", fd), 4)
        return 0

    def _set_line(self, request: int, data: bytes) -> int:
        assert request == SET_VALUES
        bits, mask = struct.unpack("<QQ", data)
        assert mask == 1
        if self.line_low and bits:
            next(iter(self.pins.values())).hard_reset()
        self.line_low = not bits
        return 0
