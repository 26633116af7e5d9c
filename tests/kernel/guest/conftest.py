"""What the guest's tests share; these files run inside the emulated machine only."""

import signal
from collections.abc import Iterator

import pytest

# Imported once, before the processes are forked; the guest takes seconds for each. hidapi has a state.
import serial.tools.list_ports  # noqa: F401
import usb.util  # noqa: F401

import adis_gonio.device.bus.cp2130
import adis_gonio.device.bus.mcp2210
import adis_gonio.device.bus.serial
import adis_gonio.sim  # noqa: F401
from kernel import device_process, open_urls
from kernel.bench import Bench, Forked

TEST_TIME_S = 300

# Forked before any test opens a board: the state of a USB library must not be shared by two processes.
_devices = Forked(device_process.serve)
_users = Forked(open_urls.serve)


def pytest_unconfigure() -> None:
    """End the processes; boards that are still plugged in go with theirs."""
    _users.close()
    _devices.close()


@pytest.fixture
def users() -> Forked:
    """The process that opens boards as an ordinary user."""
    return _users


@pytest.fixture(scope="session")
def all_boards() -> Bench:
    """The process that is the boards."""
    return Bench(_devices)


@pytest.fixture
def bench(all_boards: Bench) -> Iterator[Bench]:
    """An empty bench; what a test plugs in is pulled out after it."""
    yield all_boards
    all_boards.clear()


@pytest.fixture(autouse=True)
def _time_limit() -> Iterator[None]:
    """A test that hangs is a failure of its own, not of the whole run."""

    def expire(number: int, frame: object) -> None:
        raise TimeoutError(f"the test took more than {TEST_TIME_S} s")

    signal.signal(signal.SIGALRM, expire)
    signal.alarm(TEST_TIME_S)
    yield
    signal.alarm(0)
