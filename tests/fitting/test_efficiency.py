"""`ml` reaches the Cramér–Rao bound, in the plane and in space; what does not is seen."""

import numpy as np
import pytest

import efficiency

Case = efficiency.Case

CASES = [
    Case("stated", 12, 0.1),
    Case("stated", 24, 0.03),
    Case("stated", 48, None),
    Case("flicker", 12, 0.03),
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_ml_has_an_efficiency_of_98_per_cent_for_every_parameter(case):
    rows = efficiency.run(case, 60, (11, case.positions))
    for line in efficiency.lines(case, rows):
        assert line.missed == [], line
        # 1/f noise is estimated from the session: sixty sessions say less of it.
        assert case.kind == "flicker" or line.low > 0.98, line


def test_mean_square_errors_alone_are_the_bound_within_their_interval():
    case = Case("stated", 12, 0.03)
    rows = efficiency.run(case, 100, (12,))  # scripts/efficiency.py: 1500 sessions of each case
    for value, half in efficiency.pooled([rows]):
        assert abs(value - 1) < 3.5 / 1.96 * half


def test_least_squares_that_trusts_its_angles_is_seen_to_waste_information():
    case = Case("stated", 12, 0.03)
    found = efficiency.lines(case, efficiency.run(case, 100, (13,), "mmpm"))
    wasted = {line.parameter for line in found if "efficiency" in line.missed}
    assert {"delta_k", "scale_x", "scale_y"} <= wasted


def test_a_bias_and_a_wrong_uncertainty_are_missed_targets():
    case = Case("stated", 12, 0.0)
    rng = np.random.default_rng(1)
    attained = rng.normal(size=(4000, 7))
    ones = np.ones_like(attained)

    def judged(error, u):
        return efficiency.lines(case, np.stack([error, attained, u, ones], axis=1))

    assert not any(line.missed for line in judged(attained, ones))
    assert all("bias" in line.missed for line in judged(attained + 0.15, ones))
    assert all(line.missed == ["stated"] for line in judged(attained, 1.02 * ones))
    spread = attained + 0.3 * rng.normal(size=attained.shape)
    assert all(line.missed == ["efficiency"] for line in judged(spread, ones))
