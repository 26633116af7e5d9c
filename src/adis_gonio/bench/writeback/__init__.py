"""Write-back of biases and zero rates to the sensor's offset registers, with verification and undo.

The sensor adds an offset register to its output (data sheet, A), so that the register is set to the
negative bias: new = number during the recording − bias / LSB.
"""

from adis_gonio.bench.writeback.offset_plan import WritePlan, plan_offsets
from adis_gonio.bench.writeback.offset_writer import OffsetWriter, WriteSettings

__all__ = ["OffsetWriter", "WritePlan", "WriteSettings", "plan_offsets"]
