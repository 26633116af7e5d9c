"""More noise than the samples within the dwells show: scatter from dwell to dwell, or an unknown cause.

A loose seat of the part, an understated fixture uncertainty, or telegraph and heavy-tailed noise scatter
the readings without following a covariate. Scatter is a variance component that competes with every
function of a covariate. Its size has the greatest restricted likelihood given the base model and the chosen
terms, and the whole session is traced again with it. Of two hypotheses, the one with the higher log
evidence is used:

* functions of covariates with the measured noise: L minus the price of the terms, for the best model or
  for its named terms together with the best smooth function;
* functions of covariates with additional scatter: L of the best model with the scatter, minus the price of
  its terms and of the scatter.

L is the log likelihood of the refitted model, restricted for its base parameters (Harville, J. Am. Stat.
Assoc. 72, 1977); a price is the loss of log evidence by additional parameters. Noise that follows no
covariate costs one parameter; functions that imitate it cost many.

If no model explains the residual, an unknown cause acts in addition to every model. Otherwise the models
would be compared although all of them are wrong, and one of them would get nearly all of the posterior. The
misfit is modelled as a random function: a Gaussian process that is a sum of a smooth function of each
covariate and of a function of all covariates together. It is a part of the noise of the readings, with the
size of the greatest evidence. A name or a covariate has to stand out against it (Kennedy and O'Hagan,
Bayesian calibration of computer models, J. R. Stat. Soc. B 63, 2001).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import check
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.averaging import evidence, processes
from adis_gonio.tracing.linear_problem import LinearProblem, span
from adis_gonio.tracing.model_search import Model, search, weigh
from adis_gonio.tracing.selection import Selection, select
from adis_gonio.tracing.session_blocks import orthonormal
from adis_gonio.tracing.thresholds import limits

Kind = Literal["reading_scatter", "fixture_scatter"]


@dataclass(frozen=True)
class Scatter:
    """Dwell-to-dwell scatter: additional noise that differs from dwell to dwell.

    Attributes
    ----------
    kind : {"reading_scatter", "fixture_scatter"}
        Quantity that scatters: the reading, or the angle of the part in its fixture.
    value, u : float
        Standard deviation of the scatter, and its standard uncertainty: of a reading on each axis in the
        unit of the readings, or of an angle in degrees.
    declared : float
        Standard uncertainty measured within the dwells, or stated for the fixture, in `unit`.
    log_odds : float
        Log evidence for scatter, minus that for functions of covariates with the measured noise.
    p_value : float
        p-value of the restricted likelihood ratio without and with scatter, divided by the prior
        probability of scatter; at most 1.
    """

    kind: Kind
    value: float
    u: float
    declared: float
    log_odds: float
    p_value: float
    unit: str = "mg"

    def applied(self, data: Readings) -> Readings:
        """Return the readings with this scatter added to their noise."""
        own = self.kind == "reading_scatter"
        return _add_component(data, self.kind, self.value if own else math.radians(self.value))


def with_scatter(
    selection: Selection, terms: Sequence[Term], max_effects: int
) -> tuple[Selection, Scatter | None]:
    """Return the selection, or a selection with dwell-to-dwell scatter if its evidence is higher.

    `terms` are all candidate terms. Scatter of the readings and of the fixture are first compared with the
    candidates that scored well. With the better kind, a model is selected from all candidates. The scatter
    is None if its evidence is not higher. `max_effects` is the largest number of terms of a model.
    """
    data = selection.data
    promising = selection.promising(terms)
    plain = all(term.constant for term in selection.terms)
    checks = selection.base.dof - data.axes
    untouched = plain and selection.adequate
    if not max_effects or not data.noise_known or checks < limits.scatter_checks or untouched:
        return selection, None
    at_most = _evidence(selection)
    tried: list[tuple[float, float, Kind]] = []
    for kind in _kinds(data):
        size, again = _fit_component(data, kind, selection, promising, max_effects)
        tried.append((-math.inf if again is None else _evidence(again), size, kind))
    score, size, kind = max(tried)
    score -= price_of_scatter(data)
    if score > at_most:
        at_most = max(at_most, _evidence_of_processes(selection))
    if score <= at_most:
        return selection, None
    chosen = _select_with(data, kind, size, terms, max_effects)
    return chosen, _make_scatter(data, kind, size, chosen, score - at_most)


def _kinds(data: Readings) -> Iterator[Kind]:
    yield "reading_scatter"
    if data.planar and not data.free:
        yield "fixture_scatter"


def price_of_scatter(data: Readings) -> float:
    """Return the loss of log evidence in nats by scatter: for its parameter and its prior probability."""
    return -math.log(limits.effect_share) + 0.5 * math.log(max(data.mean.size, 2))


def _evidence(selection: Selection) -> float:
    """Return the log evidence of a selection's model, except for constants common to all models."""
    return log_evidence(selection.fit, selection.price)


def log_evidence(fit: Fit, prices: float, inflation: float = 1.0) -> float:
    """Return the log evidence of a fitted model, except for constants common to all models.

    `prices` is the price of its terms in nats, `inflation` a factor on the variance of the noise.
    """
    checks = fit.equations - len(fit.values.base)
    larger = fit.loss * (1 - 1 / inflation) - checks * math.log(inflation)
    return _restricted(fit, base_only=True) + 0.5 * larger - prices


def _evidence_of_processes(selection: Selection) -> float:
    """Return the log evidence of the best smooth function of a covariate, with named terms of the model.

    The function is tried with all named terms, with the bias only and without named terms, since named
    terms may have explained a part of it.
    """
    candidates = processes(selection.data)
    if not candidates:
        return -math.inf
    named = tuple(term for term in selection.terms if term.name is not None)
    plain = tuple(term for term in named if term.constant)
    best = -math.inf
    for kept in dict.fromkeys((named, plain, ())):
        fit = selection.fit.with_terms(kept, [selection.fit.value_of(term) for term in kept]).refit()
        basis = orthonormal(fit.jacobian)
        left = fit.residual.ravel()
        gained = evidence(fit, basis, left - basis @ (basis.T @ left), candidates)
        numbers = [k for k in selection.verdict.best if selection.problem.terms[k] in kept]
        prices = float(selection.found.prices[numbers].sum())
        best = max(best, _restricted(fit, base_only=True) - prices + float(gained.max()))
    return best


def _fit_component(
    data: Readings, kind: Kind, selection: Selection, terms: Sequence[Term], max_effects: int
) -> tuple[float, Selection | None]:
    """Return the size of one kind of scatter and the model selected with it.

    The result is (0, None) if the size is at most `limits.scatter_ratio` times the measured standard
    uncertainty. Size and model are determined alternately, twice. `terms` are the candidate terms;
    `max_effects` is the largest number of terms of the model.
    """
    bias = [term for term in selection.terms if term.constant]
    kept = selection.fit.with_terms(bias, [selection.fit.value_of(term) for term in bias])
    size = 0.0
    again: Selection | None = None
    for _ in range(2):
        check()
        fresh = _size_of_component(kept, data, kind)
        if fresh <= limits.scatter_ratio * _measured_u(data, kind):
            return 0.0, None
        if again is not None and abs(math.log(fresh / size)) < 0.1:
            break
        size = fresh
        again = _select_with(data, kind, size, terms, max_effects)
        kept = again.fit
    return size, again


def _select_with(
    data: Readings, kind: Kind, size: float, terms: Sequence[Term], max_effects: int
) -> Selection:
    """Select a model of the readings with scatter of this kind and size added to their noise.

    `terms` are the candidate terms; `max_effects` is the largest number of terms of the model.
    """
    few, rounds = limits.fold_explored, limits.fold_rounds
    found = select(_add_component(data, kind, size), terms, max_effects, explored=few, rounds=rounds)
    check()
    return found


def _size_of_component(fit: Fit, data: Readings, kind: Kind) -> float:
    """Return the size of the scatter with the greatest restricted likelihood for a fitted model; 0 if none.

    The unit is the unit of the readings, or rad for scatter of the fixture.
    """
    from scipy.optimize import minimize_scalar

    scale = _measured_u(data, kind)

    def loss(log_size: float) -> float:
        return -_restricted(_fit_with(fit, _add_component(data, kind, scale * math.exp(log_size))))

    found = minimize_scalar(loss, bounds=(-2.0, 7.0), method="bounded", options={"xatol": 0.05})
    return scale * math.exp(float(found.x)) if float(found.fun) < loss(-6.0) else 0.0


def _fit_with(fit: Fit, data: Readings) -> Fit:
    """Refit a model to readings with other noise, by a single iteration from its present values."""
    return replace(fit, data=data).refit(1)


def _measured_u(data: Readings, kind: Kind) -> float:
    """Return the standard uncertainty of a reading; for scatter of the fixture, of an angle in rad."""
    reading = float(np.sqrt(np.median(data.variance_of_mean)))
    if kind == "reading_scatter":
        return reading
    return math.hypot(reading / data.model.size, data.fixture_rad)


def _add_component(data: Readings, kind: Kind, size: float) -> Readings:
    if kind == "reading_scatter":
        return replace(data, own_covariance=data.own_covariance + size**2 * np.eye(data.axes))
    return replace(data, fixture_rad=math.hypot(data.fixture_rad, size))


def _restricted(fit: Fit, *, base_only: bool = False) -> float:
    """Return the restricted log likelihood of a fit, except for constants.

    With `base_only` it is restricted for the base parameters only, since the prices of the terms already
    account for their amplitudes.
    """
    data = fit.data
    covariance = data.own_covariance
    if fit.data.planar and not data.free:
        tangent = fit.tangent
        fixture = np.where(np.isfinite(data.fixture), data.fixture, 0.0)
        # The fixture moves a reading along its tangent.
        covariance = covariance + (fixture**2)[:, None, None] * (tangent @ tangent.transpose(0, 2, 1))
    if data.free:
        # Only one direction remains: use the variance of the whitened row.
        spread = 1 / np.maximum((fit.whitener**2).sum(axis=2), 1e-300)
        size = float(np.log(spread).sum())
    else:
        size = float(np.linalg.slogdet(covariance)[1].sum())
    rows = fit.jacobian[:, : len(fit.values.base)] if base_only else fit.jacobian
    # ½ ln |XᵀX| from the singular values, without columns that are zero.
    rows = rows[:, np.abs(rows).max(axis=0) > 0]
    scaled = np.linalg.svd(rows, compute_uv=False)
    freedom = 2 * float(np.log(np.maximum(scaled, 1e-12)).sum())
    return -0.5 * (fit.loss + size + freedom)


def _make_scatter(data: Readings, kind: Kind, size: float, chosen: Selection, log_odds: float) -> Scatter:
    """Return the scatter as a record for the result, with its uncertainty.

    `size` is in the unit of the readings or in rad, `chosen` the model selected with it. The uncertainty
    follows from the curvature of the restricted likelihood. `log_odds` is its log evidence minus that for
    functions of covariates.
    """
    from scipy.special import chdtrc

    step = 0.1

    def height(log_size: float) -> float:
        return _restricted(_fit_with(chosen.fit, _add_component(data, kind, size * math.exp(log_size))))

    none = _restricted(_fit_with(chosen.fit, data))
    ratio = 2 * max(height(0.0) - none, 0.0)
    # A variance is at the edge of its range under the null hypothesis: half of the distribution is zero.
    p_value = min(1.0, 0.5 * float(chdtrc(1, ratio)) / limits.effect_share)
    # Second derivative of the restricted likelihood by the logarithm of the size.
    curvature = -(height(step) - 2 * height(0.0) + height(-step)) / step**2
    relative = 1 / math.sqrt(curvature) if curvature > 0 else 1.0
    factor: Callable[[float], float] = math.degrees if kind == "fixture_scatter" else float
    declared = data.fixture_rad if kind == "fixture_scatter" else _measured_u(data, kind)
    unit = "deg" if kind == "fixture_scatter" else data.model.unit
    return Scatter(kind, factor(size), factor(size) * relative, factor(declared), log_odds, p_value, unit)


LENGTH, WIDTH = 0.3, 0.65
"""Distances over which the correlation of the process decays: in a covariate, in the direction of gravity.
The first is in units of the covariate's range, the second is a distance between unit vectors."""
SIZES = np.geomspace(0.5, 500.0, 31)
"""Standard deviations of the process that are tried, in standard uncertainties of a reading."""
MOST_ROWS = 600
"""Largest number of whitened readings for which the covariance of the process is computed."""


def compete_with_unknown(selection: Selection, max_terms: int) -> Selection:
    """Return a selection with the posterior of its models in competition with an unknown cause.

    The unknown cause is a Gaussian process in all covariates. The chosen model and its fit stay. A
    selection that is adequate, or with unknown noise, is returned unchanged. `max_terms` is the largest
    number of terms of a model.
    """
    data, problem = selection.data, selection.problem
    if selection.adequate or not data.noise_known or len(problem.target) > MOST_ROWS or not max_terms:
        return selection
    features = unknown_features(selection.fit)
    best = selection.verdict.best
    model: Model = tuple(k for k in best if problem.terms[k].constant)
    for _ in range(2):  # the size in addition to the bias alone, then to the best model
        competing = problem.with_covariance(features * likeliest_size(problem, model, features))
        found = search(competing, max_terms)
        model = found.best
    verdict = replace(weigh(found), best=best)
    return replace(selection, problem=competing, found=found, verdict=verdict)


def unknown_features(fit: Fit) -> Floats:
    """Return whitened features (rows, k) of an unknown cause: F Fᵀ is the covariance of the process.

    The Gaussian process has a standard deviation of one standard uncertainty of a reading. The features are
    projected off the base model.
    """
    c = fit.data.conditions
    unit = fit.ideal / np.linalg.norm(fit.ideal, axis=1)[:, None]
    kernels = [np.exp((unit @ unit.T - 1) / WIDTH**2)]
    for values in (c.time_s, c.temperature_c, c.supply_v):
        if values is not None and np.ptp(values) > 0:
            apart = (values[:, None] - values) / np.ptp(values)
            kernels.append(np.exp(-0.5 * (apart / LENGTH) ** 2))
    kernel = 0.5 * np.mean(kernels, axis=0) + 0.5 * np.prod(kernels, axis=0)
    values, vectors = np.linalg.eigh(kernel)
    root = vectors * np.sqrt(np.maximum(values, 0.0) * fit.data.variance_of_mean.mean())
    n, axes = fit.ideal.shape
    # The same process for each axis, independent of the other axes.
    columns = np.einsum("ab,nk->nabk", np.eye(axes), root).reshape(n, axes, -1)
    base = orthonormal(fit.white(fit.base_columns))
    white = fit.white(columns)
    return white - base @ (base.T @ white)


def likeliest_size(problem: LinearProblem, model: Model, features: Floats) -> float:
    """Return the size of the unknown cause with the greatest restricted likelihood, of the sizes to try.

    The size is the standard deviation of the unknown cause, in standard uncertainties of a reading. The
    unknown cause acts in addition to the terms of `model`. At size 1 it has the covariance F Fᵀ of
    `features` F.
    """
    basis, residual = span(problem, model)
    rest = features - basis @ (basis.T @ features)
    values, vectors = np.linalg.eigh(rest @ rest.T)
    grown = 1 + np.outer(SIZES**2, np.maximum(values, 0.0))
    loss = ((vectors.T @ residual) ** 2 / grown + np.log(grown)).sum(axis=1)
    return float(SIZES[np.argmin(loss)])
