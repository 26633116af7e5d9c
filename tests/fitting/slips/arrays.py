"""Three angles of a turn as plain arrays, by equations of their own and no code of the package."""

from __future__ import annotations

import numpy as np

from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.slips.position_model import Increments
from adis_gonio.model.effects import Conditions


def angles(
    stood_deg,
    declared_deg,
    *,
    seed: int = 0,
    fixture_deg: float = 0.05,
    gyro: bool = True,
    gain: float = 1.01,
    bias_mg=(12.0, -7.0),
    push_mg=None,
    gyro_error_deg=None,
    stated: bool = True,
    approach=None,
) -> tuple[Readings, Increments]:
    """Part at `stood_deg` (n,) plus the fixture's error, read by X and Y, turned under a gyro with a gain.

    Parameters
    ----------
    push_mg : dict of int to (2,) float
        What a dwell reads beside gravity.
    gyro_error_deg : dict of int to float
        What the turn that ends in a dwell lost.
    """
    rng = np.random.default_rng(seed)
    declared, n = np.asarray(declared_deg, float), len(declared_deg)
    stood = np.asarray(stood_deg, float) + rng.normal(0, fixture_deg, n)
    psi = np.radians(2.5 - stood)
    reading = np.stack([1003 * np.cos(psi), 998 * np.sin(psi + 0.003)], axis=1) + bias_mg
    reading += rng.normal(0, 0.2, (n, 2))
    for k, pushed in (push_mg or {}).items():
        reading[k] += pushed
    turned = gain * np.diff(stood) + rng.normal(0, 0.04, n - 1)
    for k, lost in (gyro_error_deg or {}).items():
        turned[k - 1] += lost
    order = np.arange(n, dtype=float)
    theta = np.radians(declared)
    turns = np.arange(1, n) if gyro else np.zeros(0, dtype=int)
    readings = from_means(
        reading,
        np.tile(0.04 * np.eye(2), (n, 1, 1)),
        Conditions(
            time_s=10 * order, angle_rad=theta, order=order,
            previous_angle_rad=np.r_[theta[:1], theta[:-1]],
            approach=None if approach is None else np.asarray(approach, float),
        ),
        fixture_rad=np.radians(fixture_deg),
        fixture_stated=stated,
    )  # fmt: skip
    of_turns = np.radians(turned)[turns - 1], np.full(len(turns), np.radians(0.05))
    return readings, Increments(turns, *of_turns, np.zeros((len(turns), 2)))
