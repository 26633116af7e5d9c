"""A bench that records one calibration session: stage, oven, supply, clock and noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY_MG = 1000.0
SAMPLE_S = 0.1
FLICKER_TIMES_S = (1.0, 10.0, 100.0, 1000.0)
"""Correlation times of the processes whose sum is the 1/f noise."""


@dataclass(frozen=True)
class Course:
    """Temperature and supply once a second from power-on to the end of the session.

    Attributes
    ----------
    time_s, temp_c, supply_v
        Arrays of one length. Zero of the time is power-on.
    """

    time_s: Array
    temp_c: Array
    supply_v: Array


@dataclass(frozen=True)
class Bench:
    """The conditions of each dwell, and the true parameters of the sensor.

    Attributes
    ----------
    time_s
        Middle of each dwell, shape (n,).
    angle_deg
        Declared angle, shape (n,), 0 to 360.
    travel_deg
        Sum of the moves so far, with sign, shape (n,).
    approach
        Direction from which the dwell was reached, +1 or −1, shape (n,).
    course
        Temperature and supply between the dwells too.
    check
        Dwells that are marked `use=check`, shape (n,).
    alpha_rad, scales, misalignment_rad, bias_mg
        Start angle, gains of x and y, Δφ, zeros of x and y.
    samples, white_mg, flicker_mg, fixture_rad
        Samples of a dwell, noise of one sample, noise of each flicker process, and of a declared angle.
    """

    time_s: Array
    angle_deg: Array
    travel_deg: Array
    approach: Array
    course: Course
    check: NDArray[np.bool_]
    alpha_rad: float
    scales: tuple[float, float]
    misalignment_rad: float
    bias_mg: tuple[float, float]
    samples: int
    white_mg: float
    flicker_mg: float
    fixture_rad: float

    @property
    def temp_c(self) -> Array:
        """Temperature in the middle of each dwell, °C, shape (n,)."""
        return np.interp(self.time_s, self.course.time_s, self.course.temp_c)

    @property
    def supply_v(self) -> Array:
        """Supply in the middle of each dwell, V, shape (n,)."""
        return np.interp(self.time_s, self.course.time_s, self.course.supply_v)

    @property
    def theta(self) -> Array:
        """Declared angle in radians, shape (n,)."""
        return np.radians(self.angle_deg)

    def forces(self, turned_rad: Array | float = 0.0) -> Array:
        """Acceleration along the sensitive axes, g, shape (n, 2); `turned_rad` adds to the attitude."""
        psi = self.alpha_rad - self.theta + turned_rad
        return np.column_stack([np.cos(psi), np.sin(psi + self.misalignment_rad)])

    def readings(self, turned_rad: Array | float = 0.0) -> Array:
        """Readings without noise and disturbance, mg, shape (n, 2)."""
        return GRAVITY_MG * np.array(self.scales) * self.forces(turned_rad) + np.array(self.bias_mg)

    def slopes(self) -> Array:
        """Derivative of the readings by the attitude, mg/rad, shape (n, 2)."""
        psi = self.alpha_rad - self.theta
        tangents = np.column_stack([-np.sin(psi), np.cos(psi + self.misalignment_rad)])
        return GRAVITY_MG * np.array(self.scales) * tangents

    @property
    def dwell_mg(self) -> float:
        """Standard deviation of the mean of a dwell without the fixture, mg."""
        lags = SAMPLE_S * np.abs(np.subtract.outer(np.arange(self.samples), np.arange(self.samples)))
        shares = sum(float(np.exp(-lags / tau).mean()) for tau in FLICKER_TIMES_S)
        return float(np.sqrt(self.white_mg**2 / self.samples + self.flicker_mg**2 * shares))


def draw_bench(rng: np.random.Generator) -> Bench:
    """Draw the plan, the courses and the sensor of one session."""
    dwells = int(rng.integers(24, 49))
    angle, approach = _order(rng, dwells)
    moves = np.diff(angle, prepend=angle[0])
    moves -= 360 * np.round(
        (moves - 180 * approach) / 360
    )  # the move that ends in the direction of approach
    samples = int(rng.integers(12, 31))
    pause = rng.uniform(15, 60)
    gaps = pause * rng.uniform(0.8, 1.3, dwells) + samples * SAMPLE_S
    for _ in range(rng.integers(0, 3)):  # somebody is called to the telephone
        gaps[rng.integers(1, dwells)] += rng.uniform(3, 10) * pause
    time = rng.uniform(30, 300) + np.cumsum(gaps)
    check = np.zeros(dwells, bool)
    check[rng.choice(np.arange(2, dwells), max(5, dwells // 5), replace=False)] = True
    white = float(np.exp(rng.uniform(np.log(0.2), np.log(1.5))))
    return Bench(
        time_s=time,
        angle_deg=angle,
        travel_deg=np.cumsum(moves),
        approach=approach,
        course=_draw_course(rng, float(time[-1]) + 60),
        check=check,
        alpha_rad=float(rng.uniform(-np.pi, np.pi)),
        scales=(1 + float(rng.normal(0, 0.004)), 1 + float(rng.normal(0, 0.004))),
        misalignment_rad=float(np.radians(rng.normal(0, 0.2))),
        bias_mg=(float(rng.normal(0, 12)), float(rng.normal(0, 12))),
        samples=samples,
        white_mg=white,
        flicker_mg=white / np.sqrt(samples) * rng.uniform(0.1, 0.3),
        fixture_rad=float(np.radians(np.exp(rng.uniform(np.log(0.001), np.log(0.01))))),
    )


def _order(rng: np.random.Generator, dwells: int) -> tuple[Array, Array]:
    """Draw the order of the positions: angles in degrees and approaches."""
    start = rng.uniform(0, 360)
    steps = np.arange(dwells)
    match rng.integers(4):
        case 0:  # round the circle once, from one side
            return (start + 360 * steps / dwells) % 360, np.ones(dwells)
        case 1:  # golden angle, from either side
            angle = (start + 137.50776 * steps) % 360
            return angle, rng.choice([-1.0, 1.0], dwells)
        case 2:  # even positions upwards, then odd positions downwards
            half = (dwells + 1) // 2
            up = 720 * np.arange(half) / dwells
            down = (720 * np.arange(dwells - half) / dwells + 360 / dwells)[::-1]
            return (start + np.r_[up, down]) % 360, np.r_[np.ones(half), -np.ones(dwells - half)]
        case _:  # drawn by lot
            return (start + 360 * rng.permutation(dwells) / dwells) % 360, rng.choice([-1.0, 1.0], dwells)


def _draw_course(rng: np.random.Generator, end_s: float) -> Course:
    """Draw temperature and supply: warm-up, oven, weather; sag, sweep, wandering."""
    time = np.arange(0.0, end_s + 1)
    share = time / end_s
    temp = rng.uniform(18, 30) + rng.uniform(1, 5) * (1 - np.exp(-time / rng.uniform(100, 600)))
    match rng.integers(3):
        case 0:  # the oven goes up and down
            temp += rng.uniform(4, 12) * np.sin(2 * np.pi * (rng.uniform(0.6, 2.2) * share + rng.uniform()))
        case 1:  # a ramp that turns
            turn = rng.uniform(0.4, 0.9)
            temp += rng.uniform(5, 15) * np.interp(share, [0, turn, 1], [0, 1, rng.uniform(0, 0.7)])
        case _:  # the room
            temp += rng.uniform(3, 8) * np.sin(2 * np.pi * (rng.uniform(0.3, 1.0) * share + rng.uniform()))
    temp += _wander(rng, time, rng.uniform(100, 400), rng.uniform(0.1, 0.8))
    supply = np.full_like(time, rng.uniform(4.95, 5.05))
    match rng.integers(3):
        case 0:  # swept on purpose
            supply += rng.uniform(0.05, 0.18) * np.sin(
                2 * np.pi * (rng.uniform(1, 5) * share + rng.uniform())
            )
        case 1:  # a battery that sags
            supply -= rng.uniform(0.05, 0.2) * (share ** rng.uniform(0.5, 2))
        case _:  # another load on the same supply
            supply -= rng.uniform(0.05, 0.2) * (
                np.sin(2 * np.pi * (rng.uniform(2, 6) * share + rng.uniform())) > 0
            )
    supply += _wander(rng, time, rng.uniform(20, 200), rng.uniform(0.003, 0.04))
    return Course(time, temp, np.clip(supply, 4.75, 5.25))


def _wander(rng: np.random.Generator, time_s: Array, tau_s: float, rms: float) -> Array:
    """Draw a stationary process with correlation exp(−t/τ) at increasing times."""
    keep = np.exp(-np.diff(time_s) / tau_s)
    kicks = rng.standard_normal(len(time_s))
    values = kicks.copy()
    for step, kept in enumerate(keep, start=1):
        values[step] = kept * values[step - 1] + np.sqrt(1 - kept**2) * kicks[step]
    return rms * values


def session_csv(bench: Bench, rng: np.random.Generator, added_mg: Array, turned_rad: Array) -> str:
    """Record the session in the documented samples CSV.

    `added_mg` (n, 2) adds to the readings, `turned_rad` (n,) to the attitude.
    """
    dwells = len(bench.time_s)
    fixture = bench.fixture_rad * rng.standard_normal(dwells)
    means = bench.readings(turned_rad + fixture) + added_mg
    within = SAMPLE_S * (np.arange(bench.samples) - (bench.samples - 1) / 2)
    clock = (bench.time_s[:, None] + within).ravel()
    noise = bench.white_mg * rng.standard_normal((clock.size, 2))
    for tau in FLICKER_TIMES_S:
        noise += np.column_stack([_wander(rng, clock, tau, bench.flicker_mg) for _ in range(2)])
    accel = np.repeat(means, bench.samples, axis=0) + noise
    temp = np.interp(clock, bench.course.time_s, bench.course.temp_c) + 0.03 * rng.standard_normal(
        clock.size
    )
    supply = np.interp(clock, bench.course.time_s, bench.course.supply_v) + 0.001 * rng.standard_normal(
        clock.size
    )
    lines = [
        "# sensor: generic",
        "# accel_unit: mg",
        f"# fixture_sigma_deg: {np.degrees(bench.fixture_rad):.5f}",
        "time_s,position,angle_deg,approach,ax,ay,temp_c,supply_v,use",
    ]
    for row in range(clock.size):
        dwell = row // bench.samples
        lines.append(
            f"{clock[row]:.3f},{dwell},{bench.angle_deg[dwell]:.5f},{bench.approach[dwell]:+.0f},"
            f"{accel[row, 0]:.4f},{accel[row, 1]:.4f},{temp[row]:.3f},{supply[row]:.5f},"
            f"{'check' if bench.check[dwell] else 'fit'}"
        )
    return "\n".join(lines) + "\n"
