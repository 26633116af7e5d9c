"""Linux's spidev as a bus: many frames in one ioctl where the kernel can keep the stall, else one each.

Timing
    Within a message the kernel raises CS between transfers where `cs_change` is set, and keeps it high
    for 10 µs; `delay_usecs` comes *before* the rise and so cannot lengthen the stall, and spidev hands
    on no other delay. 10 µs are enough for the chip's fast mode (9 µs). There the whole batch is one
    SPI_IOC_MESSAGE; the frame period is kept by the clock, which is taken just so slow that 16 clocks
    and the 10 µs fill it: CS rises right after the last clock, as the chip's sleep command wants it.
    For a longer stall (normal mode: 75 µs) every frame is a message of its own and the host waits in
    between. Where the device tree lengthens the time (`spi-cs-inactive-delay-ns`), say so with
    `cs_high_us` and batches go in one message in normal mode too.
Sizes
    A message holds 511 transfers by its number's size field, and fewer where the driver's buffer
    (`bufsiz`, 4096 bytes) is short, since newer kernels round each transfer up to a cache line. What is
    too long is refused before anything is clocked (EMSGSIZE); it then goes in halves, and the host keeps
    the stall between them.
Errors
    An ioctl cannot be given a time-out; the kernel's controller drivers have their own.
"""

from __future__ import annotations

import ctypes
import errno
from collections.abc import Callable
from typing import Any

import numpy as np

from adis_gonio.base.errors import BusError, BusTimeoutError, CannotOpenError, ProtocolError, UsageError
from adis_gonio.device.bus.contract import FRAME_BITS, Capability, SpiTiming, Words
from adis_gonio.device.bus.host import RESET_PULSE_S, SAFE_TIMING, WALL, Clock, HostBus, gone
from adis_gonio.device.bus.spidev.kernel import (
    BENT_FRAMES,
    MODE_3,
    MODE_BITS,
    MOST_TRANSFERS,
    RD_MODE32,
    SET_VALUES,
    WR_MODE32,
    Kernel,
    LineValues,
    Transfer,
    message,
)

CS_HIGH_US = 10.0
"""[M] CS-high time between two transfers with cs_change: the default of the kernel's SPI core
(`_spi_transfer_cs_change_delay`). A controller driver with a loop of its own may differ."""

SLOWEST_HZ = 10_000
"""The clock is not taken slower than this to fill a period; then frames go one by one."""

_GONE = (errno.ENODEV, errno.ESHUTDOWN, errno.ENXIO)


class SpidevBus(HostBus):
    """A bus over an open spidev file.

    Parameters
    ----------
    system : Kernel
        System calls.
    fd : int
        The open device file.
    release : callable
        Called when the bus is closed.
    url : str
        For messages.
    cs_high_us : float
        Time that the kernel keeps CS high between the transfers of a message.
    reset_fd : int or None
        Requested GPIO line on the chip's RST, open-drain.
    clock : Clock
        The bus's clock.

    Raises
    ------
    CannotOpenError
        The controller cannot do mode 3.
    BusError
        The file is no spidev, or the mode reads back otherwise.
    """

    def __init__(
        self,
        system: Kernel,
        fd: int,
        *,
        release: Callable[[], object],
        url: str = "spidev:",
        cs_high_us: float = CS_HIGH_US,
        reset_fd: int | None = None,
        clock: Clock = WALL,
    ) -> None:
        super().__init__(url, clock, release)
        self._system = system
        self._fd = fd
        self._cs_high_us = cs_high_us
        self._reset_fd = reset_fd
        self._most = MOST_TRANSFERS
        if reset_fd is not None:
            self.capabilities = frozenset({Capability.HARD_RESET})
        self._set_mode()
        self._timing = self._configure(SAFE_TIMING)

    # -- frames ------------------------------------------------------------------------------------------

    def _configure(self, timing: SpiTiming) -> SpiTiming:
        if timing.clock_hz < 1:
            raise UsageError(f"{self.url}: a clock of {timing.clock_hz:g} Hz is not possible")
        return SpiTiming(float(int(self._clock_for(timing))), timing.stall_us, timing.period_us)

    def _clock_for(self, timing: SpiTiming) -> float:
        """Clock that fills the period where frames go in one message, else the one asked for."""
        if timing.stall_us > self._cs_high_us:
            return timing.clock_hz
        left_us = timing.period_us - self._cs_high_us
        filling = FRAME_BITS / left_us * 1e6 if left_us > 0 else timing.clock_hz
        return min(timing.clock_hz, filling) if filling >= SLOWEST_HZ else timing.clock_hz

    def _fills(self, timing: SpiTiming) -> bool:
        """True where the kernel alone keeps stall and period within a message."""
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
        """One ioctl; every frame is a transfer with a chip-select period of its own."""
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
            self.sleep_s(RESET_PULSE_S)

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
        """Mode with its flags, as the kernel has it."""
        mode = ctypes.c_uint32()
        self._call(self._fd, RD_MODE32, mode)
        return mode.value

    def _call(self, fd: int, request: int, argument: Any) -> None:
        try:
            self._system.ioctl(fd, request, argument)
        except OSError as error:
            raise self._typed(error) from error

    def _typed(self, error: OSError) -> BusError:
        if error.errno in _GONE:
            return gone(self.url)
        if error.errno == errno.ETIMEDOUT:
            return BusTimeoutError(f"{self.url}: the SPI controller does not finish a transfer")
        if error.errno == errno.ENOTTY:
            return ProtocolError(f"{self.url}: this is no spidev file")
        return ProtocolError(f"{self.url}: the SPI driver failed: {error.strerror or error}")
