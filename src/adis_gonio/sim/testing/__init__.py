"""For tests of other packages: the bus contract, simulated sensors and boards, faults by seed.

pytest finds the fixtures `simulated_sensor` and `simulated_board` by itself (`plugin`); `BusContract` needs
pytest, the rest does not. Names are imported when they are first used. The page: docs/handover.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base.lazy_names import lazily

_HOMES = {
    "BusContract": "bus_contract",
    "Rig": "bus_contract",
    "WatchedChip": "bus_contract",
    "WireFrame": "bus_contract",
    "BusFaults": "faulty_bus",
    "FaultyBus": "faulty_bus",
    "Faults": "faults",
    "SimulatedBoard": "board",
    "open_board": "board",
    "SimulatedSensor": "simulated",
    "open_simulated": "simulated",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605 (a list of strings)

if TYPE_CHECKING:
    from adis_gonio.sim.testing.board import SimulatedBoard as SimulatedBoard
    from adis_gonio.sim.testing.board import open_board as open_board
    from adis_gonio.sim.testing.bus_contract import BusContract as BusContract
    from adis_gonio.sim.testing.bus_contract import Rig as Rig
    from adis_gonio.sim.testing.bus_contract import WatchedChip as WatchedChip
    from adis_gonio.sim.testing.bus_contract import WireFrame as WireFrame
    from adis_gonio.sim.testing.faults import Faults as Faults
    from adis_gonio.sim.testing.faulty_bus import BusFaults as BusFaults
    from adis_gonio.sim.testing.faulty_bus import FaultyBus as FaultyBus
    from adis_gonio.sim.testing.simulated import SimulatedSensor as SimulatedSensor
    from adis_gonio.sim.testing.simulated import open_simulated as open_simulated

__getattr__ = lazily(__name__, _HOMES)
