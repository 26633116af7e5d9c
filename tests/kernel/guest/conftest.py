"""What the guest's tests share; these files run inside the emulated machine only."""

import signal
from collections.abc import Iterator

import pytest

from kernel.bench import Bench

TEST_TIME_S = 300


@pytest.fixture(scope="session")
def device_process() -> Iterator[Bench]:
    """The process that is the boards."""
    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture
def bench(device_process: Bench) -> Iterator[Bench]:
    """An empty bench; what a test plugs in is pulled out after it."""
    yield device_process
    device_process.clear()


@pytest.fixture(autouse=True)
def _time_limit() -> Iterator[None]:
    """A test that hangs is a failure of its own, not of the whole run."""

    def expire(number: int, frame: object) -> None:
        raise TimeoutError(f"the test took more than {TEST_TIME_S} s")

    signal.signal(signal.SIGALRM, expire)
    signal.alarm(TEST_TIME_S)
    yield
    signal.alarm(0)
