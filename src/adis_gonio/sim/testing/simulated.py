"""A sensor to test host code with: the driver over a simulated chip, its stage and its world at hand."""

from __future__ import annotations

from typing import cast

from adis_gonio.base.errors import UsageError
from adis_gonio.device.bus.opening import BusUrl
from adis_gonio.device.sensor.driver import Adis16354
from adis_gonio.sim.bus import SimBus, SimStage
from adis_gonio.sim.bus import open_from_url as _open_bus
from adis_gonio.sim.chip import SimulatedChip
from adis_gonio.sim.testing.faulty_bus import NO_FAULTS, BusFaults, FaultyBus
from adis_gonio.sim.world import World

DEFAULT_URL = "sim:?seed=1"


class SimulatedSensor(Adis16354):
    """The driver on a simulated chip; open one by `open_simulated` or by the fixture `simulated_sensor`.

    All that host code calls is the driver's own. What a test wants besides stands in `stage`, `world`,
    `chip`, `truth` and `faulty`. Time is virtual: moves, dwells and waits cost nothing.
    """

    @property
    def faulty(self) -> FaultyBus:
        """The bus, which spoils frames as its `faults` say; `faulty.seen` counts what has happened."""
        return cast(FaultyBus, self.bus)

    @property
    def _simulated(self) -> SimBus:
        return cast(SimBus, self.faulty.inner)

    @property
    def stage(self) -> SimStage:
        """Moves the part: `move_to(angle_deg, approach)` in the plane, `orient((x, y, z))` in space."""
        return self._simulated.stage

    @property
    def world(self) -> World:
        """What is around the part; `bring_to` heats it or sets the supply."""
        return self._simulated.world

    @property
    def chip(self) -> SimulatedChip:
        """The chip behind the pins."""
        return self._simulated.chip

    def truth(self) -> dict[str, float]:
        """Hidden parameters by the names that a fit uses; units as `World.truth`."""
        return self.world.truth()


def simulated_bus(url: str = DEFAULT_URL) -> SimBus:
    """Open a simulated bus.

    Parameters
    ----------
    url : str
        Of the simulator: `sim:?seed=3&delta_k=0.01&effects=quadratic:k2_x=2`.

    Raises
    ------
    UsageError
        The URL is another bus's, or has an option that the simulator does not know.
    """
    parsed = BusUrl.parse(url)
    if parsed.scheme != "sim":
        raise UsageError(f"'{url}': a test double is simulated; give a URL such as {DEFAULT_URL}")
    return _open_bus(parsed)


def open_simulated(
    url: str = DEFAULT_URL, *, check: bool = True, bus_faults: BusFaults = NO_FAULTS
) -> SimulatedSensor:
    """Open a simulated sensor; use it as a context manager.

    Parameters
    ----------
    url : str
        See `simulated_bus`; the variant is the URL's.
    check : bool
        As `open_sensor`.
    bus_faults : BusFaults
        Begin when the sensor is open, so that opening it never fails by them.

    Raises
    ------
    UsageError
        As `simulated_bus`.
    """
    bus = simulated_bus(url)
    faulty = FaultyBus(bus)
    sensor = SimulatedSensor(faulty, bus.world.variant, check=check)
    faulty.faults = bus_faults
    return sensor
