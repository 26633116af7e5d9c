"""Cost of `ml` against the number of positions, and against least squares with all angles as parameters.

    python scripts/fit_scaling.py

Times the fit of readings in the plane and in space at 10 000 and 100 000 positions (best of several runs)
and prints the ratio, which is 10 for a linear cost; then the same problem of 200 positions by scipy's
`least_squares` with every nuisance angle as a parameter. Exits with 1 if ten times the positions take more
than 12 times the time.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from adis_gonio.estimation import Readings, from_means
from adis_gonio.fitting import fit_readings
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import axes_matrix
from adis_gonio.model.records import Floats

G_MG = 1000.0
NOISE_MG = 0.3
SIGMA_RAD = math.radians(0.05)
LIMIT = 12.0


def _readings(mean: Floats, angle: Floats, sigma: float) -> Readings:
    n, axes = mean.shape
    covariance = np.broadcast_to(NOISE_MG**2 * np.eye(axes), (n, axes, axes))
    conditions = Conditions(time_s=np.arange(float(n)))
    return from_means(mean, covariance, conditions, gravity_mg=G_MG, fixture_rad=sigma, angle_rad=angle)


def planar(rng: np.random.Generator, n: int) -> Readings:
    """Readings of n positions in the plane."""
    theta = rng.uniform(0, 2 * math.pi, n)
    psi = 0.4 - theta + rng.normal(0, SIGMA_RAD, n)
    ideal = np.stack([1.004 * np.cos(psi), 0.997 * np.sin(psi + 0.003)], axis=1)
    return _readings(G_MG * ideal + [12.0, -7.0] + rng.normal(0, NOISE_MG, (n, 2)), theta, SIGMA_RAD)


def spatial(rng: np.random.Generator, n: int) -> Readings:
    """Readings of n attitudes in space."""
    u = rng.normal(size=(n, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    mixing = np.array([1.004, 0.997, 1.001])[:, None] * axes_matrix(np.array([0.003, -0.002, 0.004]))
    mean = G_MG * u @ mixing.T + [12.0, -7.0, 20.0] + rng.normal(0, NOISE_MG, (n, 3))
    return _readings(mean, np.full(n, np.nan), math.inf)


def best_time(call: Callable[[], object], runs: int) -> float:
    """Shortest wall time in s of several runs."""
    times = []
    for _ in range(runs):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


def all_angles_planar(readings: Readings) -> None:
    """The planar fit with every δ as a parameter of scipy's least_squares."""
    z, n = readings.mean_mg / G_MG, len(readings)
    u = NOISE_MG / G_MG

    def residual(p: Floats) -> Floats:
        psi = p[0] - readings.angle_rad + p[6:]
        model = np.stack([p[2] * np.cos(psi) + p[4], p[3] * np.sin(psi + p[1]) + p[5]], axis=1)
        return np.concatenate([((z - model) / u).ravel(), p[6:] / SIGMA_RAD])

    start = np.zeros(6 + n)
    start[0], start[2:4] = 0.35, 1.0
    least_squares(residual, start)


def all_angles_spatial(readings: Readings) -> None:
    """The spatial fit with two angles an attitude as parameters of scipy's least_squares."""
    z, n = readings.mean_mg / G_MG, len(readings)
    u = NOISE_MG / G_MG
    base = z / np.linalg.norm(z, axis=1, keepdims=True)
    first = np.cross(base, np.eye(3)[np.abs(base).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(base, first)

    def residual(p: Floats) -> Floats:
        vectors = base + p[9 : 9 + n, None] * first + p[9 + n :, None] * second
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        mixing = p[3:6, None] * axes_matrix(p[6:9])
        return ((z - vectors @ mixing.T - p[:3]) / u).ravel()

    start = np.zeros(9 + 2 * n)
    start[3:6] = 1.0
    least_squares(residual, start)


def main() -> int:
    """Print the table; exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--positions", type=int, default=10_000, help="the smaller number; ten times it too"
    )
    parser.add_argument("--dense", type=int, default=200, help="positions of the comparison with scipy")
    parser.add_argument("--runs", type=int, default=5)
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    slow = False
    for name, make, dense in (
        ("plane", planar, all_angles_planar),
        ("space", spatial, all_angles_spatial),
    ):
        times = []
        for n in (options.positions, 10 * options.positions):
            readings = make(rng, n)
            times.append(best_time(lambda r=readings: fit_readings(r, "ml"), options.runs))
            print(f"{name}: {n:>7} positions {times[-1]:.3f} s")
        ratio = times[1] / times[0]
        slow |= ratio > LIMIT
        print(f"{name}: ten times the positions take {ratio:.1f} times the time (limit {LIMIT:g})")
        readings = make(rng, options.dense)
        mine = best_time(lambda r=readings: fit_readings(r, "ml"), options.runs)
        plain = best_time(lambda r=readings, f=dense: f(r), 1)
        print(
            f"{name}: {options.dense} positions {1000 * mine:.1f} ms; with all angles as parameters "
            f"{1000 * plain:.0f} ms, {plain / mine:.0f} times as long"
        )
    return int(slow)


if __name__ == "__main__":
    sys.exit(main())
