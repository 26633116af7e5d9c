"""Common parts of the bridges on the host: clock, pace of frames, URL options, udev rules, messages."""

from __future__ import annotations

import contextlib
import errno
import os
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Self, TypeVar

import numpy as np

from adis_gonio.base.errors import BusError, CannotOpenError, ProtocolError, UsageError, suggest
from adis_gonio.device.bus.contract import FRAME_BITS, Capability, SpiBus, SpiTiming, Words
from adis_gonio.device.bus.opening import BusUrl, Device

T = TypeVar("T")
Listing = Callable[[Sequence[T]], list[Device]]

RULES_FILE = "70-adis-gonio.rules"
"""Name of the udev rules file, in this package and in /etc/udev/rules.d.

The number is below 73, at which uaccess tags are applied.
"""


def udev_rules() -> str:
    """Return the text of the udev rules file of this package."""
    return files("adis_gonio.device.bus").joinpath(RULES_FILE).read_text(encoding="utf-8")


def udev_rule(words: str) -> str:
    """Return the first udev rule with all the given words, such as `hidraw 04d8`.

    Raises
    ------
    LookupError
        No rule contains all the words.
    """
    for line in udev_rules().splitlines():
        if not line.startswith("#") and line and all(word in line for word in words.split()):
            return line
    raise LookupError(f"no udev rule contains '{words}'")


SAFE_TIMING = SpiTiming(clock_hz=250e3, stall_us=75.0, period_us=160.0)
"""SPI timing that is slow enough for both modes of the chip, normal and fast; every bus starts with it."""

RESET_PULSE_S = 0.001
"""Duration in s of the low pulse on RST; the chip needs microseconds, a bridge's pin may take 1 ms."""


class Clock:
    """The monotonic clock of this computer; tests give a bus a virtual one."""

    def now_s(self) -> float:
        """Return the present monotonic time in s."""
        return time.monotonic()

    def sleep_s(self, seconds: float) -> None:
        """Wait for at least `seconds`."""
        time.sleep(seconds)


WALL = Clock()


class Pace:
    """Waits until the next frame may start, for a bridge that leaves stall and period to its host.

    The host knows the time at which it got the report of the end of a frame, which is later than the rise
    of chip select. Both limits count from this time, so that they are kept for any latency of the bridge.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._over_s = self._start_s = clock.now_s()

    def wait(self, timing: SpiTiming) -> None:
        """Wait until the timing allows the next frame to start."""
        due = max(self._over_s + timing.stall_us * 1e-6, self._start_s + timing.period_us * 1e-6)
        while (left := due - self._clock.now_s()) > 0:
            self._clock.sleep_s(left)

    def done(self, timing: SpiTiming) -> None:
        """Record that a frame, sent with this timing, has just ended."""
        self._over_s = self._clock.now_s()
        self._start_s = self._over_s - FRAME_BITS / timing.clock_hz


class HostBus(SpiBus):
    """Base class of buses in which the host times the frames: it keeps the clock and the pace.

    Parameters
    ----------
    url : str
        URL of the bus, used in messages.
    clock : Clock
        The bus's clock.
    """

    def __init__(self, url: str, clock: Clock) -> None:
        super().__init__(SAFE_TIMING)
        self.url = url
        self._clock = clock
        self._pace = Pace(clock)
        self._resources = contextlib.ExitStack()

    def now_s(self) -> float:
        """Return the present time in s on the monotonic clock of this bus."""
        return self._clock.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` on the clock of this bus."""
        self._clock.sleep_s(seconds)

    def take_over(self, opened: contextlib.ExitStack) -> Self:
        """Add resources to release when the bus is closed; return the bus.

        `opened` is the stack of these resources.
        """
        self._resources = opened.pop_all()
        return self

    def _close(self) -> None:
        self._resources.close()


class UrlOptions:
    """Options of a bus URL, read with checks.

    An unknown option is an error that suggests a known one.
    """

    def __init__(self, url: BusUrl, names: Sequence[str]) -> None:
        self.url = url
        for name in url.options:
            if name not in names:
                raise UsageError(f"'{url.text}': no option is called '{name}'; {suggest(name, names)}")

    def text(self, name: str, default: str = "") -> str:
        """Return the option `name` as text; `default` if the URL lacks it."""
        return self.url.options.get(name, default)

    def number(self, name: str, default: int, low: int, high: int) -> int:
        """Return the option `name` as a whole number from `low` to `high`; `default` if not given."""
        found = self.number_or_none(name, low, high)
        return default if found is None else found

    def number_or_none(self, name: str, low: int, high: int) -> int | None:
        """Return the option `name` as a whole number from `low` to `high`; None if not given."""
        text = self.url.options.get(name)
        if text is None:
            return None
        if not text.isascii() or not text.isdigit() or not low <= int(text) <= high:
            raise UsageError(f"'{self.url.text}': {name} is a whole number from {low} to {high}")
        return int(text)

    def switch(self, name: str, *, default: bool = False) -> bool:
        """Return the option `name`, which is 0 or 1, as a bool; `default` if not given."""
        return bool(self.number(name, int(default), 0, 1))

    def one_of(self, name: str, choices: Sequence[str]) -> str:
        """Return the option `name`, one of the words `choices`; the first word if not given."""
        word = self.text(name, choices[0])
        if word not in choices:
            raise UsageError(f"'{self.url.text}': {name} is one of {', '.join(choices)}")
        return word


@dataclass(frozen=True)
class UsbOptions:
    """Options that the boards with a USB bridge have in common.

    Attributes
    ----------
    cs : int
        Number of the pin that is chip select.
    reset_gpio : int or None
        Number of the pin that is wired to the chip's RST; None if RST is not wired.
    event_counter : bool
        True if data-ready is wired to the pin that counts.
    timeout_s : float
        Longest time in s for one transfer; a chip needs less than 2 ms.
    """

    cs: int = 0
    reset_gpio: int | None = None
    event_counter: bool = False
    timeout_s: float = 0.25

    @classmethod
    def of(cls, options: UrlOptions, pins: int, event_pin: int, event_name: str) -> UsbOptions:
        """Read the options from a URL of a bridge with `pins` pins.

        `event_pin` is the number of the only pin that can count edges, `event_name` its name in messages.

        Raises
        ------
        UsageError
            An option is out of range, or a pin would have two functions.
        """
        cs = options.number("cs", cls.cs, 0, pins - 1)
        reset_gpio = options.number_or_none("reset_gpio", 0, pins - 1)
        event_counter = options.switch("event_counter")
        timeout_ms = options.number("timeout_ms", round(1000 * cls.timeout_s), 10, 10_000)
        used = [cs, *([] if reset_gpio is None else [reset_gpio]), *([event_pin] if event_counter else [])]
        if len(set(used)) != len(used):
            raise UsageError(
                f"{options.url.text}: cs, reset_gpio and event counter ({event_name}) need different pins"
            )
        return cls(cs, reset_gpio, event_counter, timeout_ms / 1000)


class UsbBus(HostBus):
    """Base class of USB bridges, which send one frame after another and recover after a failure."""

    def __init__(self, url: str, options: UsbOptions, clock: Clock) -> None:
        super().__init__(url, clock)
        self._options = options
        self._unsure = False
        wired = {
            Capability.HARD_RESET: options.reset_gpio is not None,
            Capability.EVENT_COUNTER: options.event_counter,
        }
        self.capabilities = frozenset(capability for capability, there in wired.items() if there)

    def _exchange(self, frames: Words) -> Words:
        self._settle()
        replies = np.empty(len(frames), np.uint16)
        try:
            for k, frame in enumerate(frames.tolist()):
                self._pace.wait(self._timing)
                replies[k] = self._frame(frame)
                self._pace.done(self._timing)
        except BaseException as error:  # an interruption by the operator also leaves an answer behind
            self._unsure = True
            if self._note_failure(error):
                with contextlib.suppress(BusError):  # the first error counts, the next use tries again
                    self._settle()
            raise
        return replies

    def _settle(self) -> None:
        """If an earlier transfer failed, bring the device back to a known state."""
        if self._unsure:
            self._recover()
            self._unsure = False

    @abstractmethod
    def _frame(self, frame: int) -> int:
        """Send one 16-bit frame and return the 16-bit reply."""

    @abstractmethod
    def _note_failure(self, error: BaseException) -> bool:
        """Store which recovery is needed after a frame failed with `error`.

        Return True if the recovery can be done at once, False if it has to wait for the next use of the
        bus.
        """

    @abstractmethod
    def _recover(self) -> None:
        """Bring the device back to a known state after a failure."""


def choose_board(url: BusUrl, what: str, fits: Sequence[T], boards: Sequence[T], devices: Listing[T]) -> T:
    """Return the only board that fits a URL.

    Parameters
    ----------
    what : str
        Name of this kind of board, for the message that none is connected.
    fits, boards : sequence
        Boards that fit, and all connected boards.
    devices : callable
        Converts a sequence of boards to a list of `Device`, which messages show.

    Raises
    ------
    CannotOpenError
        No board fits; the message lists the connected ones.
    UsageError
        Several boards fit, of which none is chosen automatically.
    """
    if not fits:
        raise missing_error(url.text, what, devices(boards))
    if len(fits) > 1:
        urls = " or ".join(device.url for device in devices(fits))
        raise UsageError(f"{url.text}: {len(fits)} devices fit; choose {urls}")
    return fits[0]


def permission_error(url: str, what: str, rule: str) -> CannotOpenError:
    """Make the error for missing permission; its message gives the udev rule that helps.

    `what` is the device file. `rule` has words that identify the rule, see `udev_rule`.
    """
    return CannotOpenError(
        f"{url}: no permission for {what}: run 'adis-gonio devices --udev | sudo tee"
        f" /etc/udev/rules.d/70-adis-gonio.rules', then 'sudo udevadm control --reload' and plug it in"
        f" again (rule: {udev_rule(rule)})"
    )


def busy_error(url: str, what: str) -> CannotOpenError:
    """Make the error for a device, called `what` in the message, that another program is using."""
    return CannotOpenError(f"{url}: {what} is busy: close the other program that uses it")


def gone_error(url: str) -> CannotOpenError:
    """Make the error for a device that was unplugged after opening."""
    return CannotOpenError(f"{url}: the device is gone: plug it in and open the bus again")


def missing_error(url: str, what: str, others: Sequence[Device] = ()) -> CannotOpenError:
    """Make the error for a device that is not connected; its message lists the connected devices `others`.

    `what` is the kind of device.
    """
    there = f"connected: {', '.join(d.url for d in others)}" if others else "see 'adis-gonio devices'"
    return CannotOpenError(f"{url}: no {what} is connected; {there}")


def opening_error(
    error: OSError, url: str, what: str, rule: str, missing: Callable[[], BusError]
) -> BusError:
    """Make the error for a device that the system does not open.

    `what` is the device file, `rule` has words that identify its udev rule (see `udev_rule`), and `missing`
    makes the error if there is no such device; it may list the devices that are there.
    """
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return missing()
    if error.errno in (errno.EACCES, errno.EPERM):
        return permission_error(url, what, rule)
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return busy_error(url, what)
    return ProtocolError(f"{url}: {what} cannot be opened: {error.strerror or error}")


@contextlib.contextmanager
def locked(path: str, url: str) -> Iterator[None]:
    """Lock the device file `path` for this process while the block runs.

    A device file such as /dev/hidraw0 can be opened by several programs, and an answer would go to the
    first reader. The lock is advisory: it only keeps away other programs that use this package. If the
    system has no file locks or the file cannot be opened, nothing is locked. `url` is the URL of the bus,
    for messages.

    Raises
    ------
    CannotOpenError
        Another program has the lock.
    """
    try:
        import fcntl

        handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except (ImportError, OSError):
        yield
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise busy_error(url, path) from None
        yield
    finally:
        os.close(handle)


NO_PERMISSION = ", no permission (adis-gonio devices --udev)"
"""End of the description of a device that this user may not open."""


def permission_note(path: str) -> str:
    """Return `NO_PERMISSION` if the device file may not be read or written; otherwise an empty text."""
    usable = not Path(path).exists() or os.access(path, os.R_OK | os.W_OK)
    return "" if usable else NO_PERMISSION
