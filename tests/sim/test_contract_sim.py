"""The simulated bus keeps the contract of all buses."""

from adis_gonio.sim import SimBus, SimulatedChip, World
from adis_gonio.sim.testing.bus_contract import BusContract, Rig, WatchedChip

SEED = 11


class TestSimBus(BusContract):
    def make(self) -> Rig:
        world = World(seed=SEED)
        chip = WatchedChip(world, start_s=-0.5)
        return Rig(SimBus(world=world, chip=chip), chip, SimulatedChip(World(seed=SEED), start_s=-0.5))


class TestSimBusWithoutStream(TestSimBus):
    def make(self) -> Rig:
        rig = super().make()
        rig.bus = SimBus(world=rig.bus.world, chip=rig.chip, stream=False)
        return rig
