"""The simulated sensor: a chip at frame level (`chip`), the world around it (`world`), the bus (`bus`)."""

from adis_gonio.bus.host import SAFE_TIMING
from adis_gonio.sim.bus import SimBus, SimStage, open_from_url
from adis_gonio.sim.chip import SimulatedChip, State
from adis_gonio.sim.inputs import Inputs, Surroundings
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.stage import Stage
from adis_gonio.sim.world import World

__all__ = [
    "SAFE_TIMING",
    "Inputs",
    "SimBus",
    "SimStage",
    "SimulatedChip",
    "Stage",
    "State",
    "Surroundings",
    "World",
    "WorldSettings",
    "open_from_url",
]
