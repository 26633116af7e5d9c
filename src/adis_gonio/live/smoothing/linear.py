"""The linear Gaussian model: filter forwards, smoother backwards, one scalar observation a step.

    x(k) = F x(k−1) + s + w,  w ~ N(0, Q);    y(k) = h·x(k) + v,  v ~ N(0, r)

The way back is that of Rauch, Tung and Striebel in the form of Bierman ("Fixed interval smoothing with
discrete measurements", 1973): it carries what later observations say as an adjoint vector and matrix,
and needs no inverse, so that parts of the state that do not move, or have no variance, are no special case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats


@dataclass(frozen=True)
class StateEstimate:
    """Mean (k,) and covariance (k, k)."""

    mean: Floats
    covariance: Floats


@dataclass(frozen=True)
class TimeStep:
    """One step of the model.

    Attributes
    ----------
    transition : (k, k) float
        F.
    shift : (k,) float
        s.
    process : (k, k) float
        Q.
    design : (k,) float
        h.
    observed : float or None
        y; None where nothing was observed.
    variance : float
        r, above 0.
    """

    transition: Floats
    shift: Floats
    process: Floats
    design: Floats
    observed: float | None
    variance: float


@dataclass(frozen=True)
class Passed:
    """What the filter kept of a step.

    Attributes
    ----------
    predicted, filtered : StateEstimate
        Before the step's observation and after it.
    innovation, innovation_variance : float
        Observed minus predicted, and its variance; 0 and inf where nothing was observed.
    gain : (k,) float
    step : TimeStep
    """

    predicted: StateEstimate
    filtered: StateEstimate
    innovation: float
    innovation_variance: float
    gain: Floats
    step: TimeStep


def advance(state: StateEstimate, step: TimeStep) -> Passed:
    """One step of the filter."""
    f = step.transition
    covariance = f @ state.covariance @ f.T + step.process
    predicted = StateEstimate(f @ state.mean + step.shift, 0.5 * (covariance + covariance.T))
    if step.observed is None:
        return Passed(predicted, predicted, 0.0, np.inf, np.zeros(len(state.mean)), step)
    seen = predicted.covariance @ step.design
    variance = float(step.design @ seen) + step.variance
    innovation = step.observed - float(step.design @ predicted.mean)
    gain = seen / variance
    filtered = StateEstimate(
        predicted.mean + gain * innovation, predicted.covariance - np.outer(gain, seen)
    )
    return Passed(predicted, filtered, innovation, variance, gain, step)


def forward(state: StateEstimate, steps: Sequence[TimeStep]) -> list[Passed]:
    """The filter over many steps."""
    passed = []
    for step in steps:
        passed.append(advance(state, step))
        state = passed[-1].filtered
    return passed


def backward(passed: Sequence[Passed]) -> list[StateEstimate]:
    """Every step's state with all observations of these steps."""
    adjoint = _Adjoint(len(passed[0].gain)) if passed else None
    smoothed = []
    for one in reversed(passed):
        assert adjoint is not None
        smoothed.append(adjoint.applied(one.filtered))
        adjoint.pass_back(one)
    return smoothed[::-1]


def looked_back(state: StateEstimate, later: Sequence[Passed]) -> StateEstimate:
    """A filtered state with the observations of the steps after it: the fixed lag."""
    adjoint = _Adjoint(len(state.mean))
    for one in reversed(later):
        adjoint.pass_back(one)
    return adjoint.applied(state)


class _Adjoint:
    """What later observations say of a state, on the way back."""

    def __init__(self, size: int) -> None:
        self._vector = np.zeros(size)
        self._matrix = np.zeros((size, size))

    def applied(self, state: StateEstimate) -> StateEstimate:
        p = state.covariance
        covariance = p - p @ self._matrix @ p
        return StateEstimate(state.mean - p @ self._vector, 0.5 * (covariance + covariance.T))

    def pass_back(self, one: Passed) -> None:
        """From after a step to before it."""
        h, f = one.step.design, one.step.transition
        if np.isfinite(one.innovation_variance):
            # C = I − gain hᵀ, written out.
            by_gain = self._matrix @ one.gain
            self._vector = (
                self._vector
                - h * float(one.gain @ self._vector)
                - h * (one.innovation / one.innovation_variance)
            )
            self._matrix = (
                self._matrix
                - np.outer(h, by_gain)
                - np.outer(by_gain, h)
                + np.outer(h, h) * (float(one.gain @ by_gain) + 1 / one.innovation_variance)
            )
        self._vector = f.T @ self._vector
        self._matrix = f.T @ self._matrix @ f


__all__ = ["Passed", "StateEstimate", "TimeStep", "advance", "backward", "forward", "looked_back"]
