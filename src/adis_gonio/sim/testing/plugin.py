"""The pytest plugin: fixtures `simulated_sensor` and `simulated_board`, set up by the mark `adis_gonio`.

    @pytest.mark.adis_gonio(url="sim:?seed=3&delta_k=0.01")
    def test_it(simulated_sensor): ...

A mark nearer to the test overrides a mark of its class or module, name by name. If no test uses a fixture,
only this module is imported.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from adis_gonio.sim.testing.doubles import SimulatedBoard, SimulatedSensor

MARK = "adis_gonio"
OPTIONS = {
    "url": "of the simulator, such as sim:?seed=3&delta_k=0.01",
    "check": "prove on opening that |a| is 1 g",
    "faults": "Faults of the sensor's frames, or of the board's serial line",
    "boot_s": "silence of the board at first",
}
"""Options of the mark `adis_gonio`, each with its meaning."""


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark that gives the options of a simulated sensor or board with pytest."""
    config.addinivalue_line(
        "markers", f"{MARK}({', '.join(OPTIONS)}): how a simulated sensor or board of adis-gonio is made"
    )


@pytest.fixture
def simulated_sensor(request: pytest.FixtureRequest) -> Iterator[SimulatedSensor]:
    """Fixture: an open driver of a simulated chip, in virtual time.

    In addition to the driver's methods it has `stage`, `world`, `truth()` and `faulty`.
    """
    from adis_gonio.sim.testing.doubles import open_simulated

    with _open_marked(open_simulated, request, ("url", "check", "faults")) as sensor:
        yield sensor


@pytest.fixture
def simulated_board(request: pytest.FixtureRequest) -> Iterator[SimulatedBoard]:
    """Fixture: a simulated board with the project's firmware, in real time, at its serial port `path`."""
    from adis_gonio.sim.testing.doubles import open_board

    with _open_marked(open_board, request, ("url", "faults", "boot_s")) as board:
        yield board


def _open_marked(make: Any, request: pytest.FixtureRequest, names: tuple[str, ...]) -> Any:
    """Call `make` with options from the marks of a test, and return the made sensor or board.

    Only options that `names` lists are passed. A wrong option fails the test with one line.
    """
    from adis_gonio.base.errors import AdisGonioError

    options = _options(request)
    try:
        return make(**{name: options[name] for name in names if name in options})
    except AdisGonioError as error:
        pytest.fail(f"{MARK}: {error}", pytrace=False)


def _options(request: pytest.FixtureRequest) -> dict[str, Any]:
    options: dict[str, Any] = {}
    for mark in reversed(list(request.node.iter_markers(MARK))):
        if mark.args:
            pytest.fail(f"@pytest.mark.{MARK} takes names, such as url='sim:?seed=3'", pytrace=False)
        for name in mark.kwargs:
            if name not in OPTIONS:
                from adis_gonio.base.errors import suggest

                pytest.fail(f"@pytest.mark.{MARK} has no '{name}'; {suggest(name, OPTIONS)}", pytrace=False)
        options |= mark.kwargs
    return options
