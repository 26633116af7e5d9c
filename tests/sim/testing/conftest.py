"""The plugin's fixtures, whether or not the installed package names the plugin already."""

from adis_gonio.sim.testing.plugin import pytest_configure, simulated_board, simulated_sensor  # noqa: F401
