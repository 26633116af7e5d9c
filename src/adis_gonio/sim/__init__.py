"""The simulated sensor: a chip at frame level (`chip`), the world around it (`world`), the bus (`bus`)."""

from adis_gonio.base import lazily

_HOMES = {
    "bus": "SimBus SimStage open_from_url",
    "chip": "SimulatedChip State",
    "sampling": "Inputs Surroundings",
    "settings": "WorldSettings",
    "stage": "Stage",
    "world": "World",
}

__getattr__ = lazily(__name__, _HOMES)
