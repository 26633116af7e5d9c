"""Tools for tests of other packages: the bus contract, simulated sensors and boards, line and bus faults.

They also include a bus that expects given frames. pytest finds the fixtures `simulated_sensor` and
`simulated_board` by the plugin; only `BusContract` needs pytest. Names are imported when they are first
used. See docs/simulator.md.
"""

from typing import TYPE_CHECKING

from adis_gonio.base import lazily

_HOMES = {
    "bus_contract": "BusContract Rig WatchedChip WireFrame",
    "doubles": "ExpectedFrames SimulatedBoard SimulatedSensor open_board open_simulated",
    "faults": "Faults FaultyBus",
}


if TYPE_CHECKING:
    from adis_gonio.sim.testing.bus_contract import (
        BusContract as BusContract,
        Rig as Rig,
        WatchedChip as WatchedChip,
        WireFrame as WireFrame,
    )
    from adis_gonio.sim.testing.doubles import (
        ExpectedFrames as ExpectedFrames,
        SimulatedBoard as SimulatedBoard,
        SimulatedSensor as SimulatedSensor,
        open_board as open_board,
        open_simulated as open_simulated,
    )
    from adis_gonio.sim.testing.faults import Faults as Faults, FaultyBus as FaultyBus

__getattr__ = lazily(__name__, _HOMES)
