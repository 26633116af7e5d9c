"""Charts against published run lengths, an independent chart, and series whose change is known."""

import numpy as np
import pytest
from scipy import stats

from adis_gonio.fleet.sensor_history import between_neighbours, control_chart, cusum

# Montgomery, Introduction to Statistical Quality Control, table 9.3 (two-sided, k = 1/2, h = 5).
PUBLISHED = {0.0: 465, 1.0: 10.4}


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_the_sums_that_are_kept_have_these_run_lengths(shift):
    rng = np.random.default_rng(20 + int(shift))
    lengths = []
    for _ in range(60 if shift == 0 else 300):
        up, down = cusum(rng.normal(shift, 1, 5000 if shift == 0 else 200))
        lengths.append(1 + int(np.argmax(np.maximum(up, down) > 5)))
    u = np.std(lengths) / np.sqrt(len(lengths))
    assert abs(np.mean(lengths) - PUBLISHED[shift]) < 3.5 * u


def test_expected_values_are_predictions_by_all_sessions_before():
    rng = np.random.default_rng(3)
    value, u = rng.normal(5, 1, 9), rng.uniform(0.5, 2, 9)
    chart = control_chart(value, u)
    for n in range(1, 9):  # one by one, as on paper
        others = [k for k in range(9) if k != n]
        between = between_neighbours(value[others], u[others])
        sigma2 = u**2 + between**2
        # 0.62 degrees of freedom for each of the seven differences; only the scatter is estimated.
        dof = 0.62 * 7 * (sigma2[n] / (between**2 + np.mean(u[others] ** 2))) ** 2 if between else np.inf
        mean = sum(value[i] / sigma2[i] for i in range(n)) / sum(1 / sigma2[i] for i in range(n))
        spread = (sigma2[n] + 1 / sum(1 / sigma2[i] for i in range(n))) ** 0.5
        assert chart.expected[n] == pytest.approx(mean)
        student = stats.norm if between == 0 else stats.t(dof)
        assert chart.z[n] == pytest.approx(stats.norm.ppf(student.cdf((value[n] - mean) / spread)))
        limit = spread * student.isf(stats.norm.sf(3))
        assert (chart.low[n], chart.high[n]) == pytest.approx((mean - limit, mean + limit))
    assert np.isnan(chart.expected[0])


def test_differences_from_the_past_are_standard_normal_and_independent_while_nothing_changes():
    rng = np.random.default_rng(4)
    z = []
    for _ in range(2000):
        u = rng.uniform(0.5, 2, 2)
        # two sessions: nothing between sessions can be seen, so that z is exact
        z.append(control_chart(rng.normal(7, u), u).z[1])
    assert np.std(z) == pytest.approx(1, abs=0.05)
    assert abs(np.mean(z)) < 0.08


def test_a_step_is_signalled_and_dated_to_the_session_where_it_began():
    rng = np.random.default_rng(5)
    dated = []
    for _ in range(200):
        value = rng.normal(0, 1, 24)
        value[14:] += 4
        chart = control_chart(value, np.ones(24))
        assert chart.signal is not None
        dated.append(chart.since)
    assert np.median(dated) == 14
    assert np.mean(np.abs(np.array(dated) - 14) <= 1) > 0.8


def test_one_session_far_off_is_outside_of_the_limits():
    value = np.array([0.0, 0.2, -0.1, 0.1, 9.0, 0.0, 0.1, -0.2, 0.0, 0.1, 0.0, 0.1])
    assert control_chart(value, np.full(12, 1.0)).outside == [4]


@pytest.mark.parametrize("scatter", [1.0, 20.0])
def test_a_bad_session_among_six_does_not_widen_its_own_limits(scatter: float) -> None:
    rng = np.random.default_rng(7)
    found = []
    for _ in range(200):
        value = rng.normal(0, scatter, 6)
        value[4] += 40 * scatter
        found.append(4 in control_chart(value, np.ones(6)).outside)
    assert np.mean(found) > 0.95


def test_scatter_between_few_sessions_is_not_called_outside() -> None:
    rng = np.random.default_rng(8)
    outside = [bool(control_chart(rng.normal(0, 3, 6), np.ones(6)).outside) for _ in range(1000)]
    # Known scatter would give 1.3 %. It is estimated from four differences.
    assert np.mean(outside) < 0.08


def test_scatter_between_sessions_widens_the_limits():
    rng = np.random.default_rng(6)
    value = rng.normal(0, 3, 400)
    assert between_neighbours(value, np.ones(400)) == pytest.approx(8**0.5, rel=0.1)
    assert between_neighbours(rng.normal(0, 1, 3), np.full(3, 10.0)) == 0
