"""Common parts of the bridges on the host: clock, pace of frames, URL options, udev rules, messages."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Protocol

from adis_gonio.base.errors import CannotOpenError, UsageError
from adis_gonio.device.bus.contract import FRAME_BITS, SpiBus, SpiTiming
from adis_gonio.device.bus.opening import BusUrl, Device

RULES_FILE = "70-adis-gonio.rules"
"""Name of the rules, here and in /etc/udev/rules.d; below 73, where uaccess tags are acted upon."""


def udev_rules() -> str:
    """Text of the udev rules file of this package."""
    return files("adis_gonio.device.bus").joinpath(RULES_FILE).read_text(encoding="utf-8")


def udev_rule(words: str) -> str:
    """First udev rule that contains all the given words, such as `hidraw 04d8`.

    Raises
    ------
    LookupError
        No rule does.
    """
    for line in udev_rules().splitlines():
        if not line.startswith("#") and line and all(word in line for word in words.split()):
            return line
    raise LookupError(f"no udev rule contains '{words}'")


SAFE_TIMING = SpiTiming(clock_hz=250e3, stall_us=75.0, period_us=160.0)
"""Slow enough for both of the chip's modes; every bus starts with it."""

RESET_PULSE_S = 0.001
"""Duration in s of the low pulse on RST; the chip needs microseconds, a bridge's pin may take 1 ms."""


class Clock(Protocol):
    """Clock of a bus; tests use a virtual one."""

    def now_s(self) -> float:
        """Present monotonic time in s."""

    def sleep_s(self, seconds: float) -> None:
        """Wait for at least `seconds`."""


class WallClock:
    """The monotonic clock of this computer."""

    def now_s(self) -> float:
        """Present monotonic time in s."""
        return time.monotonic()

    def sleep_s(self, seconds: float) -> None:
        """Wait for at least `seconds`."""
        time.sleep(seconds)


WALL = WallClock()


class Pace:
    """Computes when the next frame may start, if the host has to keep stall and period.

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
        """Record that a frame has just ended."""
        self._over_s = self._clock.now_s()
        self._start_s = self._over_s - FRAME_BITS / timing.clock_hz


class HostBus(SpiBus):
    """Base class of buses in which the host times the frames: it keeps the clock and the pace.

    Parameters
    ----------
    url : str
        For messages.
    clock : Clock
        The bus's clock.
    release : callable
        Called when the bus is closed.
    """

    def __init__(self, url: str, clock: Clock, release: Callable[[], object]) -> None:
        super().__init__(SAFE_TIMING)
        self.url = url
        self._clock = clock
        self._pace = Pace(clock)
        self._release = release

    def now_s(self) -> float:
        """Present time in s on the monotonic clock of this bus."""
        return self._clock.now_s()

    def sleep_s(self, seconds: float) -> None:
        """Wait for `seconds` on the clock of this bus."""
        self._clock.sleep_s(seconds)

    def _close(self) -> None:
        self._release()


def require_separate_pins(url: str, cs: int, reset: int | None, event: int | None, event_name: str) -> None:
    """Raise `UsageError` if one pin is to have two functions; None means that a function is not used."""
    pins = [pin for pin in (cs, reset, event) if pin is not None]
    if len(set(pins)) != len(pins):
        raise UsageError(f"{url}: cs, reset_gpio and the event counter ({event_name}) need pins apart")


class UrlOptions:
    """Options of a bus URL, with checks; an unknown option is an error that lists the known ones."""

    def __init__(self, url: BusUrl, names: Sequence[str]) -> None:
        self._url = url
        for name in url.options:
            if name not in names:
                raise UsageError(f"'{url.text}': no option '{name}'; there is {', '.join(names)}")

    def text(self, name: str, default: str = "") -> str:
        """Return an option as text."""
        return self._url.options.get(name, default)

    def number(self, name: str, default: int, low: int, high: int) -> int:
        """Return an option as a whole number from `low` to `high`."""
        found = self.number_or_none(name, low, high)
        return default if found is None else found

    def number_or_none(self, name: str, low: int, high: int) -> int | None:
        """Return an option as a whole number from `low` to `high`; None if the URL lacks it."""
        text = self._url.options.get(name)
        if text is None:
            return None
        if not text.isascii() or not text.isdigit() or not low <= int(text) <= high:
            raise UsageError(f"'{self._url.text}': {name} is a whole number from {low} to {high}")
        return int(text)

    def switch(self, name: str, *, default: bool = False) -> bool:
        """Return an option that is written 0 or 1 as a bool."""
        return bool(self.number(name, int(default), 0, 1))

    def one_of(self, name: str, choices: Sequence[str]) -> str:
        """Return an option that is one of the words in `choices`; the first is the default."""
        word = self.text(name, choices[0])
        if word not in choices:
            raise UsageError(f"'{self._url.text}': {name} is one of {', '.join(choices)}")
        return word


def no_permission(url: str, what: str, rule: str) -> CannotOpenError:
    """Make the error for missing permission; its message gives the udev rule that helps.

    `rule` has words that identify the rule, as in `udev_rule`.
    """
    return CannotOpenError(
        f"{url}: no permission for {what}: run 'adis-gonio devices --udev | sudo tee"
        f" /etc/udev/rules.d/70-adis-gonio.rules', then 'sudo udevadm control --reload' and plug it in"
        f" again (rule: {udev_rule(rule)})"
    )


def busy(url: str, what: str) -> CannotOpenError:
    """Make the error for a device that another program is using."""
    return CannotOpenError(f"{url}: {what} is busy: close the other program that uses it")


def gone(url: str) -> CannotOpenError:
    """Make the error for a device that was unplugged."""
    return CannotOpenError(f"{url}: the device is gone: plug it in and open the bus again")


def missing(url: str, what: str, others: Sequence[Device] = ()) -> CannotOpenError:
    """Make the error for a device that is not connected; its message lists the connected devices."""
    there = f"connected: {', '.join(d.url for d in others)}" if others else "see 'adis-gonio devices'"
    return CannotOpenError(f"{url}: no {what} is connected; {there}")


def several(url: str, devices: Sequence[Device]) -> UsageError:
    """Make the error for a URL that fits several devices, of which none is chosen automatically."""
    return UsageError(f"{url}: {len(devices)} devices fit; choose {' or '.join(d.url for d in devices)}")


@contextlib.contextmanager
def claimed(path: str, url: str) -> Iterator[None]:
    """Lock a device file for this process while the block runs.

    Nodes such as /dev/hidraw0 can be opened many times, and an answer would go to the first reader. The
    lock is advisory: it separates two programs of this package. Without locks of the file or the system it
    does nothing.

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
            raise busy(url, path) from None
        yield
    finally:
        os.close(handle)


def readable_and_writable(path: str) -> bool:
    """True if the file may be read and written, or if it does not exist."""
    return not Path(path).exists() or os.access(path, os.R_OK | os.W_OK)
