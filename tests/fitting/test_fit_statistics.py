"""The statistics script's targets on fewer sessions, each method's with a fixed seed."""

import numpy as np
import pytest

import fit_statistics as statistics


@pytest.mark.parametrize("name", list(statistics.SETUPS))
def test_estimates_are_unbiased_efficient_and_their_intervals_true(name):
    setup = statistics.SETUPS[name]
    rows = statistics.run(setup, 40, seed=3)
    # Three and a half standard errors of so few sessions on top of the targets: 46 figures are looked at.
    lines = statistics.judge(setup, rows, slack=3.5)
    assert [line for line in lines if line.missed] == []


def test_the_judge_sees_what_is_wrong():
    setup = statistics.SETUPS["ml"]
    rng = np.random.default_rng(1)
    n, p = 4000, len(setup.parameters)
    ones = np.ones((n, p))
    good = np.stack([rng.normal(size=(n, p)), ones, 1.959964 * ones, ones], axis=1)
    assert not any(line.missed for line in statistics.judge(setup, good, slack=3.5))
    biased = good + np.array([0.2, 0, 0, 0])[None, :, None]
    assert all("bias" in line.missed for line in statistics.judge(setup, biased))
    narrow = good * np.array([1, 0.9, 0.9, 1])[None, :, None]
    assert all("coverage" in line.missed for line in statistics.judge(setup, narrow))
    poor = good * np.array([1.1, 1.1, 1.1, 1])[None, :, None]
    assert all("variance" in line.missed for line in statistics.judge(setup, poor))


def test_the_simulated_mean_has_the_variance_that_is_taken_as_true():
    rng = np.random.default_rng(2)
    for filter_m in (0, 2, 4):
        samples = statistics.samples_at(rng, np.zeros((2000, 2)), filter_m, 200, 0.0)
        seen = samples.mean(axis=1).var()
        assert seen == pytest.approx(statistics.mean_variance(filter_m, 200), rel=0.1)
