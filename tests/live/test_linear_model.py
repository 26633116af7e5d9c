"""Filter and smoother against one least squares over all states, and against statsmodels."""

from functools import reduce
from itertools import accumulate

import numpy as np
import pytest

from adis_gonio.live.motion_model import StateEstimate, TimeStep, advance, with_copy

SIZE, COUNT = 4, 30


def forward(state: StateEstimate, steps: list[TimeStep]) -> list[StateEstimate]:
    """The filter over many steps."""
    return list(accumulate(steps, advance, initial=state))[1:]


def smooth_lagged(state: StateEstimate, later: list[TimeStep]) -> StateEstimate:
    """A filtered state, corrected by the observations of later steps."""
    both = reduce(advance, later, with_copy(state))
    return StateEstimate(both.mean[SIZE:], both.covariance[SIZE:, SIZE:])


def smoothed_states(passed: list[StateEstimate], steps: list[TimeStep]) -> list[StateEstimate]:
    """The state of every step, given the observations of all steps."""
    return [smooth_lagged(one, steps[k + 1 :]) for k, one in enumerate(passed)]


def model(
    seed: int, *, singular: bool = False, gaps: tuple[int, ...] = ()
) -> tuple[StateEstimate, list[TimeStep]]:
    """A model that changes from step to step, and observations drawn from it."""
    return drawn(seed, singular=singular, gaps=gaps)[:2]


def drawn(
    seed: int, *, singular: bool = False, gaps: tuple[int, ...] = ()
) -> tuple[StateEstimate, list[TimeStep], list[np.ndarray]]:
    """The same with the true states."""
    rng = np.random.default_rng(seed)
    prior = StateEstimate(rng.standard_normal(SIZE), np.diag(rng.uniform(0.5, 2, SIZE)))
    x = rng.multivariate_normal(prior.mean, prior.covariance)
    steps, truth = [], []
    for k in range(COUNT):
        f = np.eye(SIZE) + 0.1 * rng.standard_normal((SIZE, SIZE))
        process = np.diag(rng.uniform(0.01, 0.3, SIZE))
        if singular:
            process[1:, 1:] = 0.0
        shift, design = rng.standard_normal(SIZE), rng.standard_normal(SIZE)
        variance = float(rng.uniform(0.1, 2))
        x = f @ x + shift + np.sqrt(np.diag(process)) * rng.standard_normal(SIZE)
        truth.append(x)
        observed = 0.0 if k in gaps else float(design @ x + np.sqrt(variance) * rng.standard_normal())
        steps.append(TimeStep(f, shift, process, design, observed, np.inf if k in gaps else variance))
    return prior, steps, truth


def batch(prior: StateEstimate, steps: list[TimeStep]) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, k) and covariances (n, k, k) of all states at once: the joint Gaussian, conditioned.

    Independent of the recursions: the states are written as a linear function of prior and drives.
    """
    n, size = len(steps), len(prior.mean)
    drives = size * (n + 1)
    made = np.zeros((n * size, drives))
    mean = np.zeros(n * size)
    now, at = np.zeros((size, drives)), prior.mean
    now[:, :size] = np.eye(size)
    for k, step in enumerate(steps):
        now, at = step.transition @ now, step.transition @ at + step.shift
        now[:, size * (k + 1) : size * (k + 2)] += np.eye(size)
        made[k * size : (k + 1) * size], mean[k * size : (k + 1) * size] = now, at
    spread = np.zeros((drives, drives))
    spread[:size, :size] = prior.covariance
    for k, step in enumerate(steps):
        block = slice(size * (k + 1), size * (k + 2))
        spread[block, block] = step.process
    joint = made @ spread @ made.T
    seen = [k for k, step in enumerate(steps) if np.isfinite(step.variance)]
    design = np.zeros((len(seen), n * size))
    for row, k in enumerate(seen):
        design[row, k * size : (k + 1) * size] = steps[k].design
    noise = np.diag([steps[k].variance for k in seen])
    observed = np.array([steps[k].observed for k in seen])
    gain = joint @ design.T @ np.linalg.inv(design @ joint @ design.T + noise)
    mean = mean + gain @ (observed - design @ mean)
    joint = joint - gain @ design @ joint
    covariances = [joint[k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(n)]
    return mean.reshape(n, size), np.array(covariances)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("singular", [False, True])
def test_all_states_are_those_of_one_least_squares(seed, singular):
    prior, steps = model(seed, singular=singular, gaps=(4, 5, 6))
    smoothed = smoothed_states(forward(prior, steps), steps)
    mean, covariance = batch(prior, steps)
    assert np.array([s.mean for s in smoothed]) == pytest.approx(mean, abs=1e-9)
    assert np.array([s.covariance for s in smoothed]) == pytest.approx(covariance, abs=1e-9)


@pytest.mark.parametrize("lag", [0, 1, 3, 10])
def test_a_fixed_lag_is_least_squares_of_all_that_has_come(lag):
    prior, steps = model(7, gaps=(2, 9))
    passed = forward(prior, steps)
    for k in range(COUNT - lag):
        told = smooth_lagged(passed[k], steps[k + 1 : k + 1 + lag])
        mean, covariance = batch(prior, steps[: k + 1 + lag])
        assert told.mean == pytest.approx(mean[k], abs=1e-9)
        assert told.covariance == pytest.approx(covariance[k], abs=1e-9)


def test_a_longer_lag_never_knows_less():
    prior, steps = model(3)
    passed = forward(prior, steps)
    spreads = [smooth_lagged(passed[5], steps[6 : 6 + lag]).covariance[0, 0] for lag in range(COUNT - 6)]
    assert (np.diff(spreads) <= 1e-12).all()
    assert spreads[-1] < 0.9 * spreads[0]


def test_statsmodels_gives_the_same():
    smoother_module = pytest.importorskip("statsmodels.tsa.statespace.kalman_smoother")
    prior, steps = model(11)
    known = smoother_module.KalmanSmoother(k_endog=1, k_states=SIZE)
    known.bind(np.array([[step.observed for step in steps]]))
    for name, parts in (
        # Their transition k leads from state k to state k + 1.
        ("transition", [step.transition for step in steps[1:]]),
        ("state_cov", [step.process for step in steps[1:]]),
        ("state_intercept", [step.shift for step in steps[1:]]),
        ("design", [step.design[None] for step in steps]),
        ("obs_cov", [np.array([[step.variance]]) for step in steps]),
    ):
        if len(parts) < COUNT:
            parts = [*parts, np.zeros_like(parts[0])]
        known[name] = np.stack(parts, axis=-1)
    known["selection"] = np.eye(SIZE)
    first = steps[0]
    start = first.transition @ prior.covariance @ first.transition.T + first.process
    known.initialize_known(first.transition @ prior.mean + first.shift, start)
    theirs = known.smooth()
    passed = forward(prior, steps)
    ours = smoothed_states(passed, steps)
    filtered, smoothed = [p.mean for p in passed], [s.mean for s in ours]
    assert pytest.approx(np.array(filtered), abs=1e-8) == theirs.filtered_state.T
    assert pytest.approx(np.array(smoothed), abs=1e-8) == theirs.smoothed_state.T
    covariances = np.moveaxis(np.array([s.covariance for s in ours]), 0, -1)
    assert covariances == pytest.approx(theirs.smoothed_state_cov, abs=1e-8)


@pytest.mark.parametrize("lag", [0, 5])
def test_squared_errors_in_units_of_u_are_chi_squared(lag):
    """Over models drawn with their truth: the state a lag ago, all of it, against its covariance."""
    found = []
    for seed in range(150):
        prior, steps, truth = drawn(seed)
        passed = forward(prior, steps)
        k = COUNT - 1 - lag
        told = smooth_lagged(passed[k], steps[k + 1 :])
        off = told.mean - truth[k]
        found.append(off @ np.linalg.solve(told.covariance, off))
    assert np.mean(found) == pytest.approx(SIZE, abs=4 * np.sqrt(2 * SIZE / len(found)))
