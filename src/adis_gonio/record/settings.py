"""Settings of a session: dwell length, settling, and the sensor's configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import field
from typing import Any

from adis_gonio.base.errors import UsageError
from adis_gonio.base.jsonable import OPTIONAL, JsonRecord
from adis_gonio.device.sensor.driver import DEFAULT_SCAN
from adis_gonio.device.sensor.registers import ACCEL_OUT
from adis_gonio.device.sensor.settings import sample_period_s, sens_avg_word

LEAST_SAMPLES = 16
"""Samples that a dwell needs so that its noise can be estimated."""

TURN_S = 10.0
"""Estimated duration in s of a turn by hand, until the first turn has been timed."""


def expected_each_s(settle_s: float, dwell_s: float) -> float:
    """Expected duration of one position in s: turning, settling and dwell."""
    return TURN_S + settle_s + dwell_s


class Settings(JsonRecord):
    """Settings of a session, stored in its archive and used again when the session is resumed.

    Attributes
    ----------
    dwell_s : float
        Length of a dwell in s.
    settle_s : float
        Wait between stillness and the dwell in s, at least the filter's settling time.
    still_timeout_s : float
        Time to wait for stillness in s before the operator is asked (or the session ends without one).
    smpl_prd : int
        SMPL_PRD; 1 is the fastest, 819.2 samples a second.
    filter_m : int
        M of the Bartlett filter.
    gyro_range_dps : int
        300, 150 or 75.
    data_ready : bool or None
        Use of data-ready pulses: None uses them if the bus supports it and the line is wired, True requires
        them, False polls.
    registers : tuple of str
        Registers of a scan; the three accelerometer outputs are required.
    turns : bool
        Keep the scans of the last minutes before each dwell too.

    Raises
    ------
    UsageError
        The sensor does not support a value, or the dwell is too short for its rate.
    """

    dwell_s: float = 10.0
    settle_s: float = 0.5
    still_timeout_s: float = 60.0
    smpl_prd: int = 1
    filter_m: int = 2
    gyro_range_dps: int = 300
    data_ready: bool | None = None
    registers: tuple[str, ...] = DEFAULT_SCAN
    turns: bool = field(default=False, metadata=OPTIONAL)

    def __post_init__(self) -> None:
        for name in ("dwell_s", "still_timeout_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name} is {value}: take a time above 0 s")
        if not (math.isfinite(self.settle_s) and self.settle_s >= 0):
            raise UsageError(f"settle_s is {self.settle_s}: take 0 s or more")
        missing = [name for name in ACCEL_OUT if name not in self.registers]
        sens_avg_word(self.gyro_range_dps, self.filter_m)
        if not 1 <= self.smpl_prd <= 0xFF:
            raise UsageError(f"smpl_prd is {self.smpl_prd}: take 1 (819.2 samples a second) to 255")
        period_s = sample_period_s(self.smpl_prd)
        if self.dwell_s < LEAST_SAMPLES * period_s:
            raise UsageError(
                f"dwell_s is {self.dwell_s:g}: at {1 / period_s:.4g} samples a second"
                f" take {LEAST_SAMPLES * period_s:.3g} s or more"
            )
        if missing:
            raise UsageError(f"a session needs {', '.join(ACCEL_OUT)}; the scan lacks {', '.join(missing)}")

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Settings:
        """Create settings from their JSON form; missing settings have their defaults.

        Raises
        ------
        UsageError
            A value is not supported, or a setting is unknown to this program.
        """
        unknown = sorted(data.keys() - cls.__dataclass_fields__.keys())
        if unknown:
            raise UsageError(
                f"the session has a setting {unknown[0]!r:.40}: update adis-gonio to resume it"
            )
        return cls(**{**data, "registers": tuple(data.get("registers", DEFAULT_SCAN))})
