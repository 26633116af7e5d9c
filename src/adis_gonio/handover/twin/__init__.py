"""The digital twin: the fitted model as the simulator's world, and its data against the measured ones."""

from adis_gonio.handover.twin.comparison import TwinComparison, compare
from adis_gonio.handover.twin.replay import simulate_like
from adis_gonio.handover.twin.world import gyro_settings

__all__ = [
    "TwinComparison",
    "compare",
    "gyro_settings",
    "simulate_like",
]
