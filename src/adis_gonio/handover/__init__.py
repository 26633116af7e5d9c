"""A calibration handed over: to a firmware, a table, the chip's registers, a certificate."""
