"""The smoothed angle of a sensor that runs: its samples to `smoothing`, and what its calibration adds.

What cannot be right is said, and widens u: gravity that is not as long as the calibration makes it in a
part at rest, and a zero rate that the gyros' calibration excludes, as with another part's file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.device.sensor.variants import VARIANTS
from adis_gonio.live.angle_smoother import LAG_S, AngleSmoother, SmoothedAngle
from adis_gonio.live.gyro_steps import GyroKnowledge, Sensing
from adis_gonio.live.motion_model import BEND
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.source import Measuring

if TYPE_CHECKING:
    from adis_gonio.calibrate import AngleReading, Calibration

GENERIC_WALK_DEG = 0.021
"""Angle random walk in a second of gyros of which nothing is known: that of the family (CHIP, B)."""
LENGTH_K = 3.0
"""Gravity is too long or too short beyond so many standard uncertainties…"""
LENGTH_FLOOR = 1e-3
"""…and by more than this: gravity itself differs from place to place, and a bias with temperature."""
Z_ERROR = 0.05
"""Relative error of Z where a calibration in the plane does not know it (CHIP, B and D)."""
_BEND_PER_U = 2.0
"""Slope of an error that goes twice around a turn, per its size."""


@dataclass(frozen=True)
class Smoothed:
    """The smoothed angle as it is shown.

    Attributes
    ----------
    smoothed_deg, smoothed_u_deg : float
        A lag ago, within ±180°, on the scale of `corrected_deg` where a calibration serves, else of
        `angle_deg`; standard uncertainty of noise, motion and drift, and of the calibration where it states
        one.
    lag_s : float
        How long before `time_s` that was: the smoother's lag, its step, the chip's filter delay.
    rate_dps : float
        Rate of turn then.
    gyro_zero_dps, gyro_zero_u_dps : float
        Zero rate of the gyro as learnt by now, beside its calibration.
    notes : tuple of str
        `gap`, `saturated`, `out_of_plane` (within the last second or so), `calibration`,
        `gyro_calibration` (does not belong to this part).
    """

    smoothed_deg: float
    smoothed_u_deg: float
    lag_s: float
    rate_dps: float
    gyro_zero_dps: float
    gyro_zero_u_dps: float
    notes: tuple[str, ...]


def sensing_of(measuring: Measuring, part: str, noise_mg: float) -> Sensing:
    """How a sensor measures: by its settings and what is known of parts of its name.

    Parameters
    ----------
    noise_mg : float
        Of a sample at rest, behind the filter.
    """
    period_s = measuring.sample_period_s
    settings = measuring if isinstance(measuring, Configuration) else None
    filter_m = settings.filter_m if settings else 0
    range_dps = settings.gyro_range_dps if settings else None
    known = VARIANTS[part].performance if part in VARIANTS else None
    return Sensing(
        period_s,
        noise_mg / white_noise_gain(filter_m),
        known.gyro_noise_dps if known else GENERIC_WALK_DEG / math.sqrt(period_s),
        filter_m,
        range_dps,
        known.bias_instability_mg if known else 0.0,
    )


class SmoothedMeter:
    """Feeds a smoother with blocks of samples and tells its angle with the calibration's share.

    Parameters
    ----------
    sensing : Sensing
    calibration : Calibration or None
        As `calibration_for` gives it.
    lag_s : float
        0 for the filter alone.
    """

    def __init__(
        self, sensing: Sensing, calibration: Calibration | None = None, *, lag_s: float = LAG_S
    ) -> None:
        self._calibration = calibration
        self._period_s = sensing.period_s
        self._drift_rad = sensing.drift_mg / sensing.gravity_mg
        gyro = None if calibration is None else calibration.gyro
        stated = {} if gyro is None else {one.name: one.u for one in gyro.parameters}
        bend = BEND if calibration is None else _bend_of(calibration)
        self._smoother = AngleSmoother(
            sensing,
            GyroKnowledge.of(gyro, stated),
            lag_s=lag_s,
            corrected=None if calibration is None else self._corrected,
            bend=bend,
        )
        self._off = 0.0
        """How far gravity's length was off when the part last rested, where that is too much."""

    def feed(self, block: Block) -> None:
        """Take samples; those without gyros are passed over."""
        columns = session_columns(block)
        if not len(block) or not all(name in columns for name in ("gx", "gy", "gz")):
            return
        gyro = np.column_stack([columns[name] for name in ("gx", "gy", "gz")])
        self._smoother.feed(block.time_s, block.accel_mg, gyro, columns.get("temp_c"))

    def restart(self) -> None:
        """The link broke; see `AngleSmoother.restart`."""
        self._smoother.restart()

    def rested(self, mean_mg: Floats, temperature_c: float | None) -> None:
        """The part is at rest and reads this (3,): judge whether gravity is as long as calibrated."""
        calibration = self._calibration
        if calibration is None:
            return
        gravity = self._corrected(mean_mg, temperature_c) / calibration.gravity_mg
        along = math.hypot(float(gravity[0]), float(gravity[1]))
        z = float(mean_mg[2]) / calibration.gravity_mg if len(gravity) < 3 else float(gravity[2])
        if along < 0.1:
            return
        off = abs(math.hypot(along, z) - 1.0)
        u_deg = self._calibration_u_deg(mean_mg, temperature_c)
        across = abs(z) * Z_ERROR if len(gravity) < 3 else 0.0
        allowed = math.hypot(math.radians(u_deg or 0.0), 3 * self._drift_rad, LENGTH_FLOOR, across)
        self._off = off if off > LENGTH_K * allowed else 0.0

    def reading(self, end_s: float) -> Smoothed | None:
        """The angle a lag before samples that end at a time; None while there is none."""
        angle = self._smoother.angle()
        return None if angle is None else self._shown(angle, end_s)

    def _shown(self, angle: SmoothedAngle, end_s: float) -> Smoothed:
        shown_deg, u_deg, notes = angle.angle_deg, angle.u_deg, angle.notes
        calibration = self._calibration
        if calibration is not None:
            if "alpha" in calibration:
                shown_deg = wrap_degrees(shown_deg + calibration["alpha"].value)
            by_calibration = self._calibration_u_deg(angle.accel_mg, None)
            u_deg = math.hypot(u_deg, by_calibration or 0.0, math.degrees(self._off))
            notes = (*notes, *(("calibration",) if self._off else ()))
        return Smoothed(
            shown_deg,
            u_deg,
            end_s - angle.time_s,
            angle.rate_dps,
            angle.zero_dps,
            angle.zero_u_dps,
            notes,
        )

    def _corrected(self, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """Gravity (2,) or (3,) in mg; zeros where the calibration has no answer."""
        assert self._calibration is not None
        gravity = self._calibration.apply(accel_mg, temperature_c) * self._calibration.gravity_mg
        return np.nan_to_num(gravity)

    def _calibration_u_deg(self, accel_mg: Floats, temperature_c: float | None) -> float | None:
        assert self._calibration is not None
        try:
            u_deg = float(_angle(self._calibration, accel_mg, temperature_c).u_deg)
        except UsageError:  # a reading too short to have an angle, or far too long
            return None
        return u_deg if math.isfinite(u_deg) else None


def _angle(calibration: Calibration, accel_mg: Floats, temperature_c: float | None) -> AngleReading:
    if "alpha" in calibration:
        return calibration.stage_angle(accel_mg, temperature_c)
    return calibration.angle(accel_mg, temperature_c, plane="xy")


def _bend_of(calibration: Calibration) -> float:
    """How much the slope of the calibrated angle may be off: by its u without that of its zero."""
    psi = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    unit = np.stack([np.cos(psi), np.sin(psi), np.zeros(8)], axis=1)[:, : calibration.axes]
    u_deg = calibration.angle(calibration.readings_of(unit), plane="xy").u_deg
    u_deg = u_deg[np.isfinite(u_deg)]
    return _BEND_PER_U * math.radians(float(u_deg.max())) if u_deg.size else BEND
