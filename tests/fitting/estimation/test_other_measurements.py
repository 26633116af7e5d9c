"""Another kind of reading goes through the same engine: a gyro's zero rate, with no attitude at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import from_means
from adis_gonio.model.effects import Conditions
from adis_gonio.model.measurement import BaseParameter, Measurement
from adis_gonio.tracing.trace import trace_readings


@dataclass(frozen=True)
class ZeroRate(Measurement):
    """What three gyros read at rest, in thousandths of a degree a second; the zeros are the base model."""

    parameters = tuple(BaseParameter(f"zero_{axis}", "1", 0.0, spread=np.inf) for axis in "xyz")
    axes = 3
    freedom = 0

    def begin(self, reading, angle_rad, conditions):
        return reading.mean(axis=0), np.zeros((len(reading), 0))

    def ideal(self, base, attitude, turn_rad):
        return np.tile(base, (len(attitude), 1))

    def tangent(self, base, attitude, turn_rad):
        return np.zeros((len(attitude), 3, 0))

    def columns(self, base, attitude, turn_rad):
        return np.tile(np.eye(3), (len(attitude), 1, 1))

    def moved(self, attitude, step):
        return attitude

    def calibrated(self, base, reading):
        return reading - base


def zero_rates(seed: int, n: int = 40, slope: float = 0.0):
    rng = np.random.default_rng(seed)
    warm = 25 + 8 * np.sin(np.arange(n) / 4.0)
    mean = np.array([120.0, -40.0, 15.0]) + 2.0 * rng.standard_normal((n, 3))
    mean[:, 1] += slope * (warm - 25)
    time = 30.0 * np.arange(n)
    conditions = Conditions(
        time_s=time,
        order=np.arange(float(n)),
        temperature_c=warm,
        temperature_history=(time, warm),
    )
    covariance = np.tile(4.0 * np.eye(3), (n, 1, 1))
    return from_means(mean, covariance, conditions, fixture_rad=np.inf, measurement=ZeroRate())


def test_the_zeros_are_the_means_and_nothing_else_is_there() -> None:
    data = zero_rates(1)
    fit = Fit.begin(data).refit()
    np.testing.assert_allclose(fit.values.base, data.mean.mean(axis=0))
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), 2.0 / np.sqrt(40), rtol=1e-6)
    assert fit.dof == 3 * 40 - 3
    found = [trace_readings(zero_rates(seed)).found for seed in range(4)]
    assert sum(map(bool, found)) == 0


def test_a_zero_that_follows_the_temperature_is_traced_and_what_looks_like_it_is_said() -> None:
    result = trace_readings(zero_rates(2, slope=1.0))
    (cause,) = result.sets
    assert cause.names[0] == "bias_temperature"
    # 40 minutes of warmth do not exclude a lag. Of a reading that never changes a gain is a zero too, but
    # 1 in 40 for each °C is more than any part's gain changes.
    assert "thermal_lag" in cause.names
    assert "scale_temperature" not in cause.names
    assert all("temperature" in name or name == "thermal_lag" for name in cause.names)
    final = result.fits[-1]
    (values,) = final.values.terms
    u = float(np.sqrt(final.covariance[3, 3]))
    assert abs(values[0] - 1.0) < 4 * u
    assert result.after.heldout_rms < 0.8 * result.before.heldout_rms
