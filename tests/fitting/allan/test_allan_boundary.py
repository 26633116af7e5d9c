"""Coverage that the information alone allows: the projection on the cone, and where no noise is at zero."""

import numpy as np
import pytest
from scipy import optimize

import allan_boundary
from allan_statistics import CASES, Case


def test_the_projection_on_the_cone_is_that_of_nonnegative_least_squares():
    rng = np.random.default_rng(2)
    for _ in range(20):
        root = rng.standard_normal((6, 4))
        metric, drawn = root.T @ root, rng.standard_normal((1, 4))
        found = allan_boundary.least(metric, drawn, np.zeros(4))[0]
        half = np.linalg.cholesky(metric).T
        _, distance = optimize.nnls(half, half @ drawn[0])
        assert found == pytest.approx(distance**2, abs=1e-9)
        held = allan_boundary.least(metric, drawn, np.zeros(4), 1)[0]
        others = [0, 2, 3]
        _, distance = optimize.nnls(half[:, others], half @ drawn[0])
        assert held == pytest.approx(distance**2, abs=1e-9)


def test_a_record_with_every_noise_well_seen_covers_95_percent_and_one_at_the_boundary_does_not():
    rng = np.random.default_rng(5)
    seen = Case({"white": 0.05, "flicker": 0.02, "walk": 0.012}, 1 << 20, 2)
    for share in allan_boundary.coverage(seen, 20000, rng).values():
        assert share == pytest.approx(0.95, abs=0.006)  # four standard deviations of the draws
    drawn = allan_boundary.coverage(CASES["white and walk"], 20000, rng)
    assert drawn["white"] < 0.946
