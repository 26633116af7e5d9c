"""A session's biases and zero rates into the sensor's offset registers: planned, written, verified, undone.

The part adds an offset register to its output (DS, A), so the register takes the bias with its sign turned:
new = the number at which the session was recorded − bias / LSB. Names are imported when first used, so that
whoever only asks for `offsets_in_force` loads no driver.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adis_gonio.base.lazy_names import lazily

_HOMES = {
    "OffsetWriter": "writer",
    "WritePlan": "plan",
    "WriteSettings": "writer",
    "AutonullFound": "autonull",
    "bias_left_mg": "inforce",
    "gyro_offsets_in_force": "inforce",
    "gyro_offsets_recorded": "inforce",
    "offsets_in_force": "inforce",
    "offsets_recorded": "inforce",
    "plan_gyro_offsets": "plan",
    "plan_offsets": "plan",
    "standing_of": "journal",
}

__all__ = [
    "AutonullFound",
    "OffsetWriter",
    "WritePlan",
    "WriteSettings",
    "bias_left_mg",
    "gyro_offsets_in_force",
    "gyro_offsets_recorded",
    "offsets_in_force",
    "offsets_recorded",
    "plan_gyro_offsets",
    "plan_offsets",
    "standing_of",
]

if TYPE_CHECKING:
    from adis_gonio.bench.writeback.autonull import AutonullFound as AutonullFound
    from adis_gonio.bench.writeback.inforce import bias_left_mg as bias_left_mg
    from adis_gonio.bench.writeback.inforce import gyro_offsets_in_force as gyro_offsets_in_force
    from adis_gonio.bench.writeback.inforce import gyro_offsets_recorded as gyro_offsets_recorded
    from adis_gonio.bench.writeback.inforce import offsets_in_force as offsets_in_force
    from adis_gonio.bench.writeback.inforce import offsets_recorded as offsets_recorded
    from adis_gonio.bench.writeback.plan import WritePlan as WritePlan
    from adis_gonio.bench.writeback.plan import plan_gyro_offsets as plan_gyro_offsets
    from adis_gonio.bench.writeback.plan import plan_offsets as plan_offsets
    from adis_gonio.bench.writeback.writer import OffsetWriter as OffsetWriter
    from adis_gonio.bench.writeback.writer import WriteSettings as WriteSettings
    from adis_gonio.record.write_journal import standing_of as standing_of


__getattr__ = lazily(__name__, _HOMES)
