"""Samples of a part that turns, made without the package's simulator: numpy, one formula a line."""

from dataclasses import dataclass

import numpy as np

from adis_gonio.live.motion_model import AngleSmoother, Sensing, SmoothedAngle

NOISE_MG, GYRO_NOISE_DPS = 4.7, 0.6


@dataclass(frozen=True)
class Turning:
    """A turn between two rests, as sensors see it.

    Attributes
    ----------
    rate_hz, seconds : float
    turn_deg, begin_s, end_s : float
        A smooth step of the angle.
    start_deg : float
    shake_mg, shake_hz : float
        Rms of a vibration on both axes while it turns: lines between 0.8 and 1.2 times the frequency.
    zero_dps, scale, limit_dps : float
        The gyro's faults and its range.
    """

    rate_hz: float = 100.0
    seconds: float = 10.0
    turn_deg: float = 90.0
    begin_s: float = 4.0
    end_s: float = 6.0
    start_deg: float = 20.0
    shake_mg: float = 0.0
    shake_hz: float = 9.0
    zero_dps: float = 0.0
    scale: float = 1.0
    limit_dps: float = np.inf
    noise: float = 1.0

    def angle(self, time_s: np.ndarray) -> np.ndarray:
        x = np.clip((time_s - self.begin_s) / (self.end_s - self.begin_s), 0, 1)
        return self.start_deg + self.turn_deg * x**3 * (10 - 15 * x + 6 * x**2)

    def rate(self, time_s: np.ndarray) -> np.ndarray:
        length = self.end_s - self.begin_s
        x = np.clip((time_s - self.begin_s) / length, 0, 1)
        return self.turn_deg / length * 30 * x**2 * (1 - x) ** 2

    def drawn(self, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times (n,), accelerometers (n, 3) in mg, gyros (n, 3) in °/s."""
        rng = np.random.default_rng(seed)
        time_s = np.arange(round(self.seconds * self.rate_hz)) / self.rate_hz
        angle = np.radians(self.angle(time_s))
        accel = 1000 * np.stack([np.cos(angle), -np.sin(angle), np.zeros_like(angle)], axis=1)
        moving = (time_s > self.begin_s) & (time_s < self.end_s)
        for axis in (0, 1):
            lines = rng.uniform(0.8, 1.2, 8) * self.shake_hz
            phases = rng.uniform(0, 2 * np.pi, 8)
            wave = np.sin(2 * np.pi * np.outer(time_s, lines) + phases).sum(axis=1) / 2
            accel[:, axis] += self.shake_mg * wave * moving
        accel += self.noise * NOISE_MG * rng.standard_normal(accel.shape)
        gyro = self.noise * GYRO_NOISE_DPS * rng.standard_normal(accel.shape)
        gyro[:, 2] += self.scale * self.rate(time_s) + self.zero_dps
        return time_s, accel, np.clip(gyro, -self.limit_dps, self.limit_dps)


def sensing(turning: Turning, range_dps: float | None = None) -> Sensing:
    return Sensing(1 / turning.rate_hz, NOISE_MG, GYRO_NOISE_DPS, gyro_range_dps=range_dps)


def told(smoother: AngleSmoother, samples: tuple[np.ndarray, ...], every: int = 10) -> list[SmoothedAngle]:
    """Angles as samples come in blocks."""
    found = []
    for begin in range(0, len(samples[0]), every):
        smoother.feed(*(column[begin : begin + every] for column in samples))
        angle = smoother.angle()
        if angle is not None:
            found.append(angle)
    return found


def errors(turning: Turning, angles: list[SmoothedAngle]) -> np.ndarray:
    true = turning.angle(np.array([angle.time_s for angle in angles]))
    off = np.array([angle.angle_deg for angle in angles]) - true
    return (off + 180) % 360 - 180


def during(angles: list[SmoothedAngle], begin_s: float, end_s: float) -> np.ndarray:
    """Which of the angles lie in a span."""
    time_s = np.array([angle.time_s for angle in angles])
    return (time_s > begin_s) & (time_s < end_s)
