"""Uncertainty by Monte Carlo (JCGM 101:2008, GUM Supplement 1), to check the linear propagation.

Each trial draws every input from its distribution (noise with few degrees of freedom from Student's,
quantization from a rectangle, angles as real turns of the part) and fits again by the same method. Nothing
is linearised, so the result agrees with the linear propagation if the model is linear enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import JsonRecord
from adis_gonio.base.numbers import NAMES, count_decimals, format_fixed, format_unit
from adis_gonio.base.uncertainty import COVERED, Value
from adis_gonio.fitting.determination import TYPICAL, natural_units
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.fit_result import FitResult, Origin, outputs_of
from adis_gonio.fitting.methods import METHOD_TABLE
from adis_gonio.fitting.uncertainty import MODEL, TEMPERATURE, Sources, repeatability_of

WITHIN = 0.01
"""Relative difference between a Monte Carlo and a linear standard uncertainty below which they count as
equal."""


@dataclass(frozen=True)
class Propagated:
    """Standard uncertainty of one parameter by Monte Carlo, next to the result of linear propagation.

    Attributes
    ----------
    linear : Value
        The fitted parameter with its uncertainty by linear propagation.
    u : float
        Standard deviation of the trials.
    low, high : float
        Ends of the interval of 95 % with equal probabilities below and above it.
    doubt : float
        Relative standard error of `u` from the limited number of trials.
    why : str
        Reason for a difference between `u` and the linear u of more than 1 % plus twice the standard error
        of `u`; empty without such a difference.
    """

    linear: Value
    u: float
    low: float
    high: float
    doubt: float
    why: str

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON object of the parameter, one entry of `parameters` in the document."""
        return {
            "u": self.u,
            "low": self.low,
            "high": self.high,
            "unit": self.linear.unit,
            "linear_u": self.linear.u,
            "linear_U": self.linear.U,
            "u_standard_error": self.u * self.doubt,
            "agrees": not self.why,
            "why": self.why,
        }


class MonteCarlo(JsonRecord):
    """Result of a Monte Carlo propagation for a `method`: the distribution of each parameter.

    `trials` is the number of trials with a result, `failed` of trials without one; `parameters` are the
    results by name. Its JSON document is the entry `monte_carlo` of a result.
    """

    method: str
    trials: int
    failed: int
    parameters: dict[str, Propagated]

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows of a table that compares Monte Carlo with linear propagation.

        There is one row for each parameter. Half of `to` − `from` compares with `U, linear`.
        """
        head = ["parameter", "unit", "u", "u, linear", "from", "to", "U, linear"]
        rows = []
        for name, p in self.parameters.items():
            decimals = 1 + count_decimals((p.high - p.low) / 2)
            figures = (p.u, p.linear.u, p.low, p.high, p.linear.U)
            shown = (format_fixed(figure, decimals) for figure in figures)
            rows.append([NAMES.get(name, name), format_unit(p.linear.unit), *shown])
        return head, rows

    @property
    def remarks(self) -> list[str]:
        """Sentences on differences between Monte Carlo and linear propagation, and on failed trials.

        Without any, one sentence states that both agree.
        """
        remarks = [f"{NAMES.get(name, name)}: {p.why}" for name, p in self.parameters.items() if p.why]
        if self.failed:
            remarks.append(f"{self.failed} trials gave no result and were left out")
        return remarks or ["the linear uncertainties agree within 1 % and the error of the trials"]


def monte_carlo(result: FitResult, trials: int, rng: np.random.Generator) -> MonteCarlo:
    """Repeat a fit on simulated readings, with all inputs drawn from their distributions.

    Parameters
    ----------
    result : FitResult
        Result of `adis_gonio.fit`; the noise that it estimated is used.
    trials : int
        Number of repetitions. JCGM 101, 7.2: 10⁴ show u to 1 %, 10⁶ an interval's ends to two digits.

    Raises
    ------
    FitError
        The noise of a reading is unknown, or no trial gives a result.
    """
    made = result.origin
    if made is None or result.sources is None:
        raise FitError("the noise of a reading is unknown: there are no distributions to propagate")
    values, failed = [], 0
    draw, refit = _drawing(made, result.sources, rng), METHOD_TABLE[result.method].refit
    natural, found = natural_units(made.readings)[:, None], made.determination
    # A fit does not move along undetermined directions: the errors along them are drawn here.
    unseen = TYPICAL * natural * (natural[:, :0] if found is None else found.null)
    for _ in range(trials):
        try:
            fit = refit(made.noise.applied(draw()), made)
        except FitError:
            failed += 1
            continue
        parameters = unseen @ rng.standard_normal(unseen.shape[1])
        parameters[: len(fit.values.parameters)] += fit.values.parameters
        by_name = {output.name: output.value for output in outputs_of(fit.data, parameters)}
        values.append([by_name[name] for name in result.parameters])
    if len(values) < 2:
        raise FitError("no trial of the Monte Carlo propagation gave a result")
    drawn = np.array(values)
    kept = {
        output.name: _propagated(result[output.name], drawn[:, k], result.sources, output.gradient)
        for k, output in enumerate(result.outputs)
    }
    return MonteCarlo(result.method, len(values), failed, kept)


def _drawing(made: Origin, sources: Sources, rng: np.random.Generator) -> Callable[[], Readings]:
    """Return a function that makes simulated readings at each call.

    They are the session's readings plus a random error from the distribution of every input.
    """
    data, fit, noise = made.readings, made.fit, made.noise
    n, axes = data.mean.shape
    roots, dof, estimate = repeatability_of(data, noise)
    sigma = np.where(np.isfinite(fit.data.fixture), fit.data.fixture, 0.0)
    # Changes of the readings by errors that act on all dwells.
    shared = [
        one.acts_mg for one in sources.each if one.name in (TEMPERATURE, MODEL) and one.acts_mg is not None
    ]
    # Half width of a rectangle with the variance of quantization.
    rounding = np.zeros((n, axes)) if data.quantization is None else np.sqrt(3 * data.quantization)
    flicker = np.zeros((n, axes)) if data.flicker is None else np.sqrt(data.flicker)
    attitude, turn, model = fit.values.attitude, fit.turn_rad, data.model
    exact = model.ideal(fit.values.base, attitude, turn)

    def draw() -> Readings:
        factor = _students(rng, dof, estimate)
        moved = np.einsum("nab,nb->na", roots, factor * rng.standard_normal((n, axes)))
        moved += flicker * rng.standard_normal((n, axes)) + rounding * rng.uniform(-1, 1, (n, axes))
        moved += data.shared @ rng.standard_normal(data.shared.shape[2])
        if noise.extra_mg:
            moved += noise.extra_mg * _student(rng, noise.dof) * rng.standard_normal((n, axes))
        if sigma.any():
            # Turn the sensor by the error of the declared angle, exactly and not to first order.
            away = sigma * _student(rng, noise.sigma_dof) * rng.standard_normal(n)
            moved += model.ideal(fit.values.base, attitude + away, turn) - exact
        for columns in shared:
            moved += columns @ rng.standard_normal(columns.shape[2])
        links = None if data.links is None else data.links.drawn(rng)
        return replace(data, mean=data.mean + moved, links=links)

    return draw


def _student(rng: np.random.Generator, dof: float) -> float:
    """Return a random factor that turns a normal variable into a variable with Student's distribution."""
    return 1.0 if math.isinf(dof) else math.sqrt(dof / float(rng.chisquare(dof)))


def _students(rng: np.random.Generator, dof: Floats, estimate: Any) -> Floats:
    """Return random factors (n, axes) that turn normal variables into variables with Student's t.

    `dof` (n, axes) are the degrees of freedom of the variance of each variable. `estimate` (n, axes) has
    equal numbers for variances that come from one estimate; these variables get one common factor.
    """
    factor = np.ones(estimate.shape)
    for number in np.unique(estimate[np.isfinite(dof)]):
        mine = estimate == number
        factor[mine] = _student(rng, float(dof[mine].min()))
    return factor


def _propagated(linear: Value, values: Floats, sources: Sources, gradient: Floats) -> Propagated:
    """Return the distribution of a parameter by the trials' `values` (t,), next to the result `linear`.

    `gradient` (p,) is the derivative of the parameter by the natural parameters.
    """
    n = len(values)
    if linear.unit == "deg":  # a mean of angles on both sides of ±180° is none
        values = linear.value + wrap_degrees(values - linear.value)
    centred = values - values.mean()
    u = float(np.sqrt((centred**2).sum() / (n - 1)))
    # Standard error of a standard deviation, from the fourth moment of the trials.
    kurtosis = float((centred**4).mean() / max((centred**2).mean() ** 2, 1e-300))
    doubt = math.sqrt(max(kurtosis - 1, 1e-3) / (4 * n))
    low, high = np.quantile(centred, [0.5 * (1 - COVERED), 0.5 * (1 + COVERED)]) + values.mean()
    wide = _students_u(sources, gradient)
    reason = _explain_difference(linear, u, doubt, wide)
    return Propagated(linear, u, float(low), float(high), doubt, reason)


def _explain_difference(linear: Value, u: float, doubt: float, wide: float) -> str:
    """Return the reason why the trials' `u` differs from the linear u; empty if they agree.

    `doubt` is the standard error of `u` relative to it, `wide` is the linear u by Student's distribution.
    """
    stated = linear.u or 0.0
    if abs(u - stated) <= (WITHIN + 2 * doubt) * stated:
        return ""
    ratio = f"u is {u / stated:.3g} times the linear one" if stated else "the linear u is zero"
    if math.isfinite(wide) and abs(u - wide) <= (WITHIN + 3 * doubt) * wide:
        return f"{ratio}: with {linear.dof:.3g} degrees of freedom Student's distribution is wider"
    if math.isinf(wide):
        return f"{ratio}: with {linear.dof:.3g} degrees of freedom no standard deviation exists; compare U"
    return (
        f"{ratio}: the model is not linear enough over the inputs' spread; use the interval of the trials"
    )


def _students_u(sources: Sources, gradient: Floats) -> float:
    """Return the standard deviation of a quantity by linear propagation with Student's t.

    Each source has its own degrees of freedom. `gradient` (p,) is the derivative of the quantity by the
    natural parameters. The result is infinite if a source has two degrees of freedom or fewer.
    """
    total = 0.0
    for _, dof, variance in sources.parts(gradient[None]):
        if variance <= 1e-9 * (total + 1e-300):
            continue
        if dof <= 2:
            return math.inf
        total += variance * (1.0 if math.isinf(dof) else dof / (dof - 2))
    return math.sqrt(total)
