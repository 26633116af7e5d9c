"""The simulated sensor: a chip at frame level (`chip`), the world around it (`world`), the bus (`bus`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "bus": "SimBus SimStage open_from_url",
    "chip": "SimulatedChip State",
    "sampling": "Inputs Surroundings",
    "settings": "WorldSettings",
    "stage": "Stage",
    "world": "World",
}


if TYPE_CHECKING:
    from adis_gonio.sim.bus import SimBus as SimBus, SimStage as SimStage, open_from_url as open_from_url
    from adis_gonio.sim.chip import SimulatedChip as SimulatedChip, State as State
    from adis_gonio.sim.sampling import Inputs as Inputs, Surroundings as Surroundings
    from adis_gonio.sim.settings import WorldSettings as WorldSettings
    from adis_gonio.sim.stage import Stage as Stage
    from adis_gonio.sim.world import World as World

__getattr__ = lazily(__name__, _HOMES)
