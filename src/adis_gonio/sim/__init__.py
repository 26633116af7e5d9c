"""The simulated sensor: a chip at frame level (`chip`), the world around it (`world`), the bus (`bus`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "Inputs": "sampling",
    "SimBus": "bus",
    "SimStage": "bus",
    "SimulatedChip": "chip",
    "Stage": "stage",
    "State": "chip",
    "Surroundings": "sampling",
    "World": "world",
    "WorldSettings": "settings",
    "open_from_url": "bus",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605 (a list of strings)

if TYPE_CHECKING:
    from adis_gonio.sim.bus import SimBus as SimBus
    from adis_gonio.sim.bus import SimStage as SimStage
    from adis_gonio.sim.bus import open_from_url as open_from_url
    from adis_gonio.sim.chip import SimulatedChip as SimulatedChip
    from adis_gonio.sim.chip import State as State
    from adis_gonio.sim.sampling import Inputs as Inputs
    from adis_gonio.sim.sampling import Surroundings as Surroundings
    from adis_gonio.sim.settings import WorldSettings as WorldSettings
    from adis_gonio.sim.stage import Stage as Stage
    from adis_gonio.sim.world import World as World

__getattr__ = lazily(__name__, _HOMES)
