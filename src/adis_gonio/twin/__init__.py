"""The digital twin: the fitted model as the simulator's world, and its data against the measured ones."""

from adis_gonio.twin.comparison import TwinComparison, compare
from adis_gonio.twin.replay import simulate_like

__all__ = ["TwinComparison", "compare", "simulate_like"]
