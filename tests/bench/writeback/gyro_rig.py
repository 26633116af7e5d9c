"""Gyros of a simulated part: its offset registers, and a fit that knows its truth."""

from __future__ import annotations

import numpy as np

from adis_gonio.base.uncertainty import Value
from adis_gonio.fitting.gyros.gyro_fit import GyroFit

GYROS = ("XGYRO_OFF", "YGYRO_OFF", "ZGYRO_OFF")
LSB = 0.018315
FAULTS = {
    "gyro_bias_x_dps": 1.21,
    "gyro_bias_y_dps": -0.73,
    "gyro_bias_z_dps": 0.38,
    "gyro_g_dps_per_g": 0.05,
    "gyro_g_sensitivity_yx_dps_per_g": 0.24,
}


def gyro_numbers(bus) -> tuple[int, ...]:
    """Gyro offsets in the registers, past the serial port."""
    return tuple(_signed(bus.chip.memory[name]) for name in GYROS)


def gyro_flash(bus) -> tuple[int, ...]:
    """Gyro offsets in the flash."""
    return tuple(_signed(bus.chip.memory._flash[name]) for name in GYROS)


def known_gyros(bus, *, u_dps: float = 0.004, more: dict[str, float] | None = None) -> GyroFit:
    """What a session would know of a part: its hidden zero rates and g-sensitivity."""
    truth = bus.world.truth()
    kinds = ("gyro_bias", "g_sensitivity")
    values = {name: value for name, value in truth.items() if name.rpartition("_")[0] in kinds}
    for name, by in (more or {}).items():
        values[name] += by
    units = {name: "dps" if name.startswith("gyro") else "dps/g" for name in values}
    parameters = {name: Value(v, u_dps, units[name]) for name, v in values.items()}
    matrix = np.diag([u_dps**2] * len(values))
    return GyroFit(
        parameters=parameters, covariance=matrix, chi2=0.0, dof=1, residual_dps=np.zeros((1, 3)),
        positions=(0,), turns=0,
    )  # fmt: skip


def _signed(word: int) -> int:
    return (word & 0x1FFF) - ((word & 0x1000) << 1)
