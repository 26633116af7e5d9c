"""What a front end sees of the sensor between events: angle, spread, temperature, losses."""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.bench.events import DwellProgress, Vector, Watching
from adis_gonio.bench.judge import Judge
from adis_gonio.bench.recording import Recording
from adis_gonio.live.smoothed import SmoothedMeter
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.plans import Position


class LiveView:
    """Makes the events that tell of the sensor from what has been seen of it so far.

    Attributes
    ----------
    limit_mg : Vector or None
        Standard deviation below which a window is still.
    target : Position or None
        Where the part is asked to be.
    judge : Judge or None
        Who knows the angle by gravity; None before the noise is known.
    smoother : SmoothedMeter or None
        Takes the shaking out of the angle while the part turns, by its gyros; without a lag.
    """

    def __init__(self) -> None:
        self.limit_mg: Vector | None = None
        self.target: Position | None = None
        self.judge: Judge | None = None
        self.smoother: SmoothedMeter | None = None
        self._temperature_c: float | None = None
        self._lost = 0
        self._seen_s = 0.0

    def see(self, block: Block) -> None:
        """Take scans."""
        self._lost += block.lost
        columns = session_columns(block)
        if "temp_c" in columns and len(block):
            self._temperature_c = float(columns["temp_c"][-1])
        if self.smoother is not None and len(block):
            self.smoother.feed(block)
            self._seen_s = float(block.time_s[-1])

    def angle_deg(self, accel_mg: Floats, target_deg: float | None) -> tuple[float | None, float | None]:
        """Angle as the stage counts, on the turn that is nearest to the target, and its tolerance.

        By gravity, and by the gyros if there are any. The tolerance is that of `Judge.tolerance_deg`.
        """
        if self.judge is None:
            return None, None
        smoothed_mg = self._smoothed_mg(accel_mg)
        angle = self.judge.angle_deg(smoothed_mg)
        if angle is None or target_deg is None:
            return angle, None
        tolerance = self.judge.tolerance_deg(smoothed_mg, target_deg)
        return target_deg + wrap_degrees(angle - target_deg), tolerance

    def _smoothed_mg(self, accel_mg: Floats) -> Floats:
        """A reading (3,), turned to where the smoothed angle is."""
        smoothed = None if self.smoother is None else self.smoother.reading(self._seen_s)
        if smoothed is None:
            return accel_mg
        angle = math.radians(smoothed.smoothed_deg)
        length = math.hypot(float(accel_mg[0]), float(accel_mg[1]))
        return np.array([length * math.cos(angle), -length * math.sin(angle), float(accel_mg[2])])

    def watching(
        self,
        state: Literal["idle", "measuring", "moving", "settling"],
        accel_mg: Floats,
        spread_mg: Floats,
        target_deg: float | None,
        waits_for: str,
    ) -> Watching:
        """The event of a look outside a dwell."""
        angle_deg, tolerance_deg = self.angle_deg(accel_mg, target_deg)
        return Watching(
            state,
            vector(accel_mg),
            vector(spread_mg),
            angle_deg,
            target_deg,
            self.limit_mg,
            waits_for,
            self._temperature_c,
            self._lost,
            tolerance_deg,
        )

    def dwell(
        self, recording: Recording, accel_mg: Floats, spread_mg: Floats, length_s: float
    ) -> Watching | DwellProgress:
        """The event of a look while a dwell is waited for, or under way."""
        if recording.begun:
            return self._progress(recording, accel_mg, spread_mg, length_s)
        state: Literal["settling", "moving"] = "settling" if recording.is_still else "moving"
        waits_for = "the part to settle" if recording.is_still else f"rest: {recording.why_moving}"
        return self.watching(state, accel_mg, spread_mg, recording.position.angle_deg, waits_for)

    def _progress(
        self, recording: Recording, accel_mg: Floats, spread_mg: Floats, length_s: float
    ) -> DwellProgress:
        """The event of a look within a dwell."""
        target_deg = recording.position.angle_deg
        angle_deg, _ = self.angle_deg(accel_mg, target_deg)
        return DwellProgress(
            recording.place,
            recording.elapsed_s,
            length_s,
            recording.samples,
            recording.lost,
            vector(accel_mg),
            vector(spread_mg),
            angle_deg,
            target_deg,
            self.limit_mg,
            "the dwell to end",
            self._temperature_c,
        )


def vector(values: Any) -> Vector:
    """Three numbers as floats."""
    x, y, z = (float(value) for value in np.asarray(values))
    return x, y, z
