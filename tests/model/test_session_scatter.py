"""The prior of a bias between sessions, against six recordings of one sensor at rest."""

import numpy as np
import pytest
from scipy.stats import chi2

from adis_gonio.model.measurement import SESSION_BIAS_MG, SESSION_ZERO_DPS
from recordings import RUNS_AT_REST, recording


def test_prior_of_a_bias_between_sessions_is_the_scatter_of_six_runs() -> None:
    means = []
    for name in RUNS_AT_REST:
        rows = np.genfromtxt(recording(name), delimiter=",", skip_header=1, comments="#")[:, 1:7]
        rows[:, :3] *= 1e3
        means.append(rows[len(rows) // 5 :].mean(axis=0))  # the first fifth warms up
    variance = np.var(means, axis=0, ddof=1)
    for axes, prior in ((slice(3), SESSION_BIAS_MG), (slice(3, 6), SESSION_ZERO_DPS)):
        assert np.sqrt(variance[axes].mean()) == pytest.approx(prior, rel=0.03)
        # Each axis is a plausible draw: five degrees of freedom.
        assert (np.abs(chi2.cdf(5 * variance[axes] / prior**2, 5) - 0.5) < 0.495).all()
