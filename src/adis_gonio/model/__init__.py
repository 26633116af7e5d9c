"""The measurement model: what a reading is made of. Pure numpy, no files, no devices."""

from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session

__all__ = ["STANDARD_GRAVITY_MPS2", "Dwell", "Session"]
