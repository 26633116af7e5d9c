"""The measurement model: the contributions to a reading. Only numpy, no files, no devices."""

from adis_gonio.model.records import STANDARD_GRAVITY_MPS2, Dwell, Session

__all__ = ["STANDARD_GRAVITY_MPS2", "Dwell", "Session"]
