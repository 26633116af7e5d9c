"""For tests of other packages: the bus contract, simulated sensors and boards, faults, expected frames.

pytest finds the fixtures `simulated_sensor` and `simulated_board` by the plugin; only `BusContract` needs
pytest. Names are imported when they are first used. See docs/handover.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "BusContract": "bus_contract",
    "Rig": "bus_contract",
    "WatchedChip": "bus_contract",
    "WireFrame": "bus_contract",
    "BusFaults": "faults",
    "ExpectedFrames": "expected_frames",
    "FaultyBus": "faults",
    "Faults": "faults",
    "SimulatedBoard": "doubles",
    "open_board": "doubles",
    "SimulatedSensor": "doubles",
    "open_simulated": "doubles",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605 (a list of strings)

if TYPE_CHECKING:
    from adis_gonio.sim.testing.bus_contract import BusContract as BusContract
    from adis_gonio.sim.testing.bus_contract import Rig as Rig
    from adis_gonio.sim.testing.bus_contract import WatchedChip as WatchedChip
    from adis_gonio.sim.testing.bus_contract import WireFrame as WireFrame
    from adis_gonio.sim.testing.doubles import SimulatedBoard as SimulatedBoard
    from adis_gonio.sim.testing.doubles import SimulatedSensor as SimulatedSensor
    from adis_gonio.sim.testing.doubles import open_board as open_board
    from adis_gonio.sim.testing.doubles import open_simulated as open_simulated
    from adis_gonio.sim.testing.expected_frames import ExpectedFrames as ExpectedFrames
    from adis_gonio.sim.testing.faults import BusFaults as BusFaults
    from adis_gonio.sim.testing.faults import Faults as Faults
    from adis_gonio.sim.testing.faults import FaultyBus as FaultyBus

__getattr__ = lazily(__name__, _HOMES)
