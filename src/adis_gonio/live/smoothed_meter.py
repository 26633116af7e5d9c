"""The smoothed angle for display: blocks of samples in, the angle with the calibration's uncertainty out.

The uncertainty of the displayed angle includes the calibration. Impossible values are reported and increase
the uncertainty. They are a length of gravity at rest that contradicts the calibration, and a zero rate that
the gyros' calibration excludes, such as with the file of another sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import UsageError
from adis_gonio.device.sensor.registers import VARIANTS
from adis_gonio.device.sensor.settings import Configuration, white_noise_gain
from adis_gonio.live.motion_model import BEND, LAG_S, AngleSmoother, GyroKnowledge, Sensing
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.source import Measuring

if TYPE_CHECKING:
    from adis_gonio.calibrate import Calibration

GENERIC_WALK_DEG = 0.021
"""Standard deviation, in degrees, of the angle by integrated noise after one second, for gyros of unknown
noise (ADIS16350 data sheet, B)."""
LENGTH_FLOOR = 1e-3
"""Standard uncertainty of the length of gravity, as a share of it, that is added to the calibration's:
gravity differs from place to place, and biases change with temperature."""
Z_ERROR = 0.05
"""Relative error of the reading of Z that is allowed if a calibration in the plane does not determine Z
(ADIS16350 data sheet, B and D)."""


@dataclass(frozen=True)
class Smoothed:
    """The smoothed angle for display.

    Attributes
    ----------
    smoothed_deg, smoothed_u_deg : float
        Angle at one lag before the newest sample, within ±180°. Its zero is the zero of `corrected_deg`
        with a calibration, else of `angle_deg`. Standard uncertainty by noise, motion, drift and
        calibration.
    lag_s : float
        Age of the angle at the end of the span: the smoother's lag, its time step, and the delay of the
        chip's filter.
    rate_dps : float
        Rate of turn at the time of the angle.
    gyro_zero_dps, gyro_zero_u_dps : float
        Estimated zero rate that the gyro has after its calibration, and its standard uncertainty.
    notes : tuple of str
        Events within the last second or so: `gap`, `saturated`, `out_of_plane`; `calibration` or
        `gyro_calibration` if the calibration of accelerometers or gyros does not belong to this part.
    """

    smoothed_deg: float
    smoothed_u_deg: float
    lag_s: float
    rate_dps: float
    gyro_zero_dps: float
    gyro_zero_u_dps: float
    notes: tuple[str, ...]


def sensing_of(measuring: Measuring, part: str, noise_mg: float) -> Sensing:
    """Return the properties of a sensor that the smoother needs, from its settings and its variant.

    Parameters
    ----------
    measuring : Measuring
        Settings of the sensor.
    part : str
        Name of the sensor's variant.
    noise_mg : float
        Noise (rms) of a sample at rest, after the filter.
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
    """Passes blocks of samples to a smoother; adds the calibration's uncertainty to its angle.

    Parameters
    ----------
    sensing : Sensing
        Properties of the sensor.
    calibration : Calibration or None
        Calibration for the sensor's present offsets (`calibration_for`); None for uncalibrated angles.
    lag_s : float
        Delay of the reported angle; 0 for the filter without smoothing.
    """

    def __init__(
        self, sensing: Sensing, calibration: Calibration | None = None, *, lag_s: float = LAG_S
    ) -> None:
        self._calibration = calibration
        self._period_s = sensing.period_s
        self._drift_rad = sensing.drift_mg / 1000  # gravity is 1000 mg
        gyro = None if calibration is None else calibration.gyro
        stated = {} if gyro is None else {one.name: one.u for one in gyro.parameters}
        self._smoother = AngleSmoother(
            sensing,
            GyroKnowledge.of(gyro, stated),
            lag_s=lag_s,
            corrected=None if calibration is None else self._corrected,
            bend=BEND if calibration is None else _bend_of(calibration),
        )
        self.off_deg = 0.0
        """Relative error of gravity's length at the last rest, as an angle in degrees.

        It is 0 if it does not contradict the calibration.
        """

    def feed(self, block: Block) -> None:
        """Add a block of samples; a block without gyro readings is ignored."""
        columns = session_columns(block)
        if not len(block) or not all(name in columns for name in ("gx", "gy", "gz")):
            return
        gyro = np.column_stack([columns[name] for name in ("gx", "gy", "gz")])
        self._smoother.feed(block.time_s, block.accel_mg, gyro, columns.get("temp_c"))

    def take_rest(self, mean_mg: Floats, temperature_c: float | None) -> None:
        """Check the calibration at rest: compare the length of the reading `mean_mg` with local gravity.

        `temperature_c` is None if the sensor reports none: the mean of the calibration's session is taken.
        If the length differs from local gravity by more than the uncertainties allow, the difference is
        added to the uncertainty of later angles, with a note.
        """
        calibration = self._calibration
        if calibration is None:
            return
        gravity = self._corrected(mean_mg, temperature_c) / calibration.gravity_mg
        along = math.hypot(float(gravity[0]), float(gravity[1]))
        if along < 0.1:
            return
        # A calibration in the plane has no Z: use the raw reading of Z, with a larger error.
        planar = len(gravity) < 3
        z = float(mean_mg[2]) / calibration.gravity_mg if planar else float(gravity[2])
        # Relative error of the length of gravity, and the largest allowed error.
        off = abs(math.hypot(along, z) - 1.0)
        _, u_deg = corrected_angle(calibration, mean_mg, temperature_c)
        across = abs(z) * Z_ERROR if planar else 0.0
        allowed = math.hypot(math.radians(u_deg or 0.0), 3 * self._drift_rad, LENGTH_FLOOR, across)
        self.off_deg = math.degrees(off) if off > 3 * allowed else 0.0

    def reading(self, end_s: float) -> Smoothed | None:
        """Return the smoothed angle at one lag before `end_s`, the time of the last sample.

        Return None until a lag has passed.
        """
        angle, calibration = self._smoother.angle(), self._calibration
        if angle is None:
            return None
        shown_deg, u_deg, notes = angle.angle_deg, angle.u_deg, angle.notes
        if calibration is not None:
            if "alpha" in calibration:
                shown_deg = wrap_degrees(shown_deg + calibration["alpha"].value)
            _, by_calibration = corrected_angle(calibration, angle.accel_mg, angle.temperature_c)
            u_deg = math.hypot(u_deg, by_calibration or 0.0, self.off_deg)
            notes = (*notes, "calibration") if self.off_deg else notes
        return Smoothed(
            shown_deg, u_deg, end_s - angle.time_s, angle.rate_dps, angle.zero_dps, angle.zero_u_dps, notes
        )

    def _corrected(self, accel_mg: Floats, temperature_c: float | None) -> Floats:
        """Return the calibrated gravity vector (3,) in mg; zeros if the calibration cannot compute it.

        `temperature_c` None takes the mean of the calibration's session.
        """
        assert self._calibration is not None
        gravity = self._calibration.apply(accel_mg, temperature_c) * self._calibration.gravity_mg
        return np.nan_to_num(gravity)


def corrected_angle(
    calibration: Calibration, mean_mg: Floats, temperature_c: float | None, u_mg: Floats | None = None
) -> tuple[float | None, float | None]:
    """Return the angle of a reading by a calibration, and its standard uncertainty, in degrees.

    The angle is positive for the stage's positive turn. Both results are None if the calibration refuses
    the reading, for example because its length is far from gravity. The uncertainty alone is None if it is
    not finite.

    Parameters
    ----------
    mean_mg : (3,) float
        The reading.
    temperature_c : float or None
        Its temperature; None for the mean of the session.
    u_mg : (3,) float, optional
        Standard uncertainty of the reading; without it u is the uncertainty by the calibration alone.
    """
    reading_u = None if u_mg is None else [float(u) for u in u_mg[: calibration.axes]]
    try:
        if "alpha" in calibration:
            by = calibration.stage_angle(mean_mg, temperature_c, reading_u=reading_u)
            angle_deg = float(by.angle_deg)
        else:
            by = calibration.angle(mean_mg, temperature_c, reading_u=reading_u, plane="xy")
            angle_deg = -float(by.angle_deg)
    except UsageError:
        return None, None
    u_deg = float(by.u_deg)
    return angle_deg, u_deg if math.isfinite(u_deg) else None


def _bend_of(calibration: Calibration) -> float:
    """Return the standard uncertainty of the slope of the calibrated angle as a function of the true angle.

    The slope is 1 for a perfect calibration. Its uncertainty is derived from the largest uncertainty of the
    angle over the turn, without the uncertainty of the start angle.
    """
    # Standard uncertainty of the angle at eight angles over a turn.
    psi = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    unit = np.stack([np.cos(psi), np.sin(psi), np.zeros(8)], axis=1)[:, : calibration.axes]
    u_deg = calibration.angle(calibration.readings_of(unit), plane="xy").u_deg
    u_deg = u_deg[np.isfinite(u_deg)]
    # An error with two cycles per turn has a largest slope of twice its amplitude.
    return 2 * math.radians(float(u_deg.max())) if u_deg.size else BEND
