"""A simulated bus that notes the write frames that reach the chip."""

from adis_gonio.device.bus import Words
from adis_gonio.sim.bus import SimBus
from adis_gonio.sim.world import World

DATA_READY = 0xB400
"""Write frame to the low byte of MSC_CTRL, which a stream sets and sets back."""


class CountingBus(SimBus):
    """`writes` holds every write frame in order."""

    def __init__(self, world: World, **options) -> None:
        super().__init__(world, **options)
        self.writes: list[int] = []

    def _exchange(self, frames: Words) -> Words:
        self.writes += [int(frame) for frame in frames if frame & 0x8000]
        return super()._exchange(frames)

    @property
    def asked_for(self) -> list[int]:
        """Write frames that are not a stream's own."""
        return [frame for frame in self.writes if frame & 0xFF00 != DATA_READY]
