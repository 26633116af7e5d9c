"""The model of a measurement: all contributions to a reading. It needs only numpy, no files, no devices."""

from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session

__all__ = ["STANDARD_GRAVITY_MPS2", "Dwell", "Session"]
