"""A session's biases and zero rates into the sensor's offset registers: planned, written, verified, undone.

The part adds an offset register to its output (DS, A), so the register takes the bias with its sign turned:
new = the number at which the session was recorded − bias / LSB.
"""

from adis_gonio.bench.writeback.offset_checks import AutonullFound
from adis_gonio.bench.writeback.offset_plan import (
    WritePlan,
    bias_left_mg,
    offsets_in_force,
    offsets_recorded,
    plan_gyro_offsets,
    plan_offsets,
)
from adis_gonio.bench.writeback.offset_writer import OffsetWriter, WriteSettings

__all__ = [
    "AutonullFound",
    "OffsetWriter",
    "WritePlan",
    "WriteSettings",
    "bias_left_mg",
    "offsets_in_force",
    "offsets_recorded",
    "plan_gyro_offsets",
    "plan_offsets",
]
