"""Trace of a single dwell: how the bias depends on conditions while the sensor rests.

A single pose does not show gains, angles or a bias. The base model is therefore one constant per axis, and
the candidates vary in time: temperature (up to the third power), its lag, warm-up, drift, supply. Each axis
has its own degree and time constant. The readings are averages of the samples over equal intervals of the
recording; in other sessions they are averages over dwells.

A bias also moves without a recorded cause: it jumps, it walks at random, or its noise is 1/f. An effect is
therefore added only if it is more probable than these (`_noises`), and if the error on held-out blocks of
time does not grow. Held-out blocks are used neither for the fit nor for the choice of degree and time
constant. Inside a fold, degrees and time constants are averaged instead of chosen: each combination of them
predicts the held-out blocks with a weight in proportion to its likelihood. This likelihood takes each block
as one independent value, because neighbouring readings share slow noise. A choice of a single combination
would depend mostly on the last period of constant temperature.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from adis_gonio.base.arrays import Floats, block_means, log_sum_exp
from adis_gonio.base.budget import attempt, check
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import ComputedOnce
from adis_gonio.base.numbers import counted, format_percent
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.readings import mg_per_unit
from adis_gonio.fitting.estimation.spectrum import covariance_of_means
from adis_gonio.model.effects import AXES, Conditions, Effect, Enters, catalogue, effect
from adis_gonio.model.effects.sensor_terms import REFERENCE_C
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.findings import shares
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_figures import Panel, Views
from adis_gonio.tracing.trace_result import ErrorFigures, Finding, Step, TraceResult

BLOCKS = 10
LEAST_ROWS = 200
AVERAGES = 100
"""Number of readings, each the average over an equal interval of the recording; a multiple of `BLOCKS`."""
NOISES = ("white noise", "a random walk", "1/f noise")
NOISE_RATIOS = (0.1, 1.0, 10.0, 1e2, 1e3, 1e4)
"""Sizes of slow noise that are tried: ratios of two variances of a reading.
The first variance is the one over the session by slow noise, the second the one by fast noise."""
DEGREES = (1, 2, 3)
_CHANGING = {"temperature", "time", "supply"}
"""Covariates that change in one pose. An effect of them is a candidate if it moves a reading of 0 g."""
TAUS = 14
_RIDGE = 1e-12
"""Ridge of the normal equations relative to their trace; it keeps them solvable if columns are equal."""


@dataclass(frozen=True, eq=False)
class _Form:
    """One form of an effect: a degree of its polynomial and a time constant.

    Attributes
    ----------
    columns : (n, degree) float
        Contribution to a reading per unit of each amplitude.
    tau_s : float or None
        Time constant in s; None for an effect without one.
    coarse : bool
        True if the form is tried even if several effects of the model have time constants.
    """

    columns: Floats
    tau_s: float | None
    coarse: bool


Model = tuple[str, ...]
"""Names of the effects of a model."""
Choice = tuple[_Form, ...]
"""One form of each effect of a model."""


@dataclass(frozen=True)
class _Problem(ComputedOnce):
    """Readings of one pose with the effects that may explain them.

    Attributes
    ----------
    readings : (n, axes) float
        Averages of the samples in mg, minus the mean of all samples.
    within : (axes,) float
        Variance of the samples of a reading in mg².
    conditions : Conditions
        Time, temperature and supply of each reading.
    effects, forms : dict of str to Effect, dict of str to list of _Form
        Effects to try, and the forms of each (combinations of degree and time constant), by name.
    """

    readings: Floats
    within: Floats
    conditions: Conditions
    effects: dict[str, Effect]
    forms: dict[str, list[_Form]]


def trace_series(session: Session, max_effects: int = 6) -> TraceResult:
    """Return the trace of a session with a single pose: the causes by which its samples drift.

    `max_effects` is the largest number of effects in the model.

    Raises
    ------
    FitError
        Too few samples, all at one time, or no recorded condition that they could depend on.
    """
    dwell = next(dwell for dwell in session.dwells if len(dwell))
    where = f"{session.source}: " if session.source else ""
    if len(dwell) < LEAST_ROWS:
        raise FitError(
            f"{where}one position with {counted(len(dwell), 'sample')} shows nothing to trace; measure at"
            f" least two positions, or at least {LEAST_ROWS} samples while the temperature changes"
        )
    if not np.ptp(dwell.time_s) > 0:
        raise FitError(
            f"{where}all samples have one time, so no drift can be seen: give their times (time_s)"
        )
    if dwell.temperature_c is None:
        raise FitError(
            f"{where}one position only and no temperature: there is nothing to trace; record"
            " the temperature with the samples (temp_c), or measure at least two positions"
        )
    problem = _problem(session, dwell, dwell.temperature_c)
    model: Model = ()
    reasons: dict[str, str] = {}
    each: list[dict[str, float]] = []
    while len(model) < max_effects:
        share = attempt("further effects", partial(_shares, problem, model), dict[str, float]())
        chosen = max(share, key=share.__getitem__, default=None)
        none = 1 - sum(share.values())
        if chosen is None or none > limits.certain:
            why = f"a jump or slow noise of the bias is more probable ({format_percent(none)})"
            reasons = {name: why for name, p in share.items() if p > 1 - limits.set_level}
            break
        before, after = (problem.once(_folds, one)[0].sum() for one in (model, (*model, chosen)))
        if after > limits.worse**2 * before:
            reasons = {chosen: "the held-out error would be larger with it"}
            break
        model = (*model, chosen)
        each.append(share)
    rest = [tuple(one for one in model if one != chosen) for chosen in model]
    each = attempt("confounded effects", lambda: [_shares(problem, one) for one in rest], each)
    # The names that may be in the place of each effect, the effect first.
    rivals = [
        (name, *(other for other, p in share.items() if other != name and p > 1 - limits.set_level))
        for name, share in zip(model, each, strict=True)
    ]
    uncaused: list[str] = attempt("movements without a cause", partial(_uncaused, problem, model), [])
    figures = [_figures(problem, model[:k]) for k in range(len(model) + 1)]
    explained = shares(model, [(error.heldout_rms or 0.0) ** 2 for error in figures])
    found, detectable = [], {}
    for k, name in enumerate(model):
        parameters, detectable[name] = _parameters(problem, model, k)
        if (likely := each[k][name]) >= limits.certain:
            axes, cause = problem.effects[name].axes, problem.effects[name].cause
            found.append(Finding(name, axes, parameters, 1 - likely, explained[name], likely, cause=cause))
    return TraceResult(
        adequate=False,
        found=tuple(found),
        steps=tuple(Step(name, error) for name, error in zip(model, figures[1:], strict=True)),
        confounded=tuple(group for group in rivals if len(group) > 1),
        before=figures[0],
        after=figures[-1],
        detectable=detectable,
        advice=(
            "one pose does not show whether bias or gain changes: let the temperature rise and fall again "
            "with the sensor turned over (each axis once up and once down)",
        ),
        reasons=reasons,
        notes=("the bias changes without a recorded cause: " + ", ".join(uncaused),) if uncaused else (),
        heldout_design=f"{BLOCKS} blocks of time, degrees and time constants averaged in each fold",
        views=_views(problem, model),
    )


def _problem(session: Session, dwell: Dwell, temperature_c: Floats) -> _Problem:
    """Return the averages of the samples, and the effects with recorded conditions.

    Samples in counts of unknown scale are scaled so that their mean has the length of gravity.
    """
    scale = mg_per_unit(session)
    if session.accel_unit == "counts":
        scale = session.gravity_mg / max(float(np.linalg.norm(dwell.accel.mean(axis=0))), 1e-12)
    cuts = np.arange(AVERAGES) * len(dwell) // AVERAGES
    samples = (dwell.accel - dwell.accel.mean(axis=0)) * scale
    readings = block_means(samples, cuts)
    time = dwell.time_s - dwell.time_s[0]
    conditions = Conditions(
        block_means(time, cuts),
        temperature_c=block_means(temperature_c, cuts),
        supply_v=None if dwell.supply_v is None else block_means(dwell.supply_v, cuts),
        temperature_history=(time, temperature_c) if (np.diff(time) > 0).all() else None,
    )
    effects: dict[str, Effect] = {}
    forms: dict[str, list[_Form]] = {}
    for name, kind in catalogue("accelerometer").items():
        if kind.enters is not Enters.READING or not _CHANGING.intersection(kind.covariates):
            continue
        made = effect(name, AXES[: readings.shape[1]])
        own = [
            _Form(columns[:, :degree], tau, number % 3 == 0)
            for number, (columns, tau) in enumerate(_columns(made, conditions))
            for degree in range(1, columns.shape[1] + 1)
            if (np.ptp(columns[:, :degree], axis=0) > 0).all()
        ]
        if own:
            effects[name], forms[name] = made, own
    within = (samples**2).mean(axis=0) - (readings**2).mean(axis=0)
    return _Problem(readings, within, conditions, effects, forms)


def _columns(made: Effect, conditions: Conditions) -> Iterator[tuple[Floats, float | None]]:
    """Yield the columns (n, d) of an effect on one axis at 0 g, with each time constant in s to try.

    An effect without a time constant has one set of columns, with None; an effect of a condition that was
    not recorded has none. Column k of an effect of the temperature is the term of degree k: (T − 25 °C)^k,
    or (T_lag − 25 °C)^k − (T − 25 °C)^k for an element at T_lag.
    """
    if conditions.lacks(made.needs):
        return
    one = effect(made.name, ("x",), **dict.fromkeys(made.choices(), DEGREES[-1]))
    still, length = np.zeros((len(conditions), 2)), float(np.ptp(conditions.time_s))
    shaped = any(parameter.shape for parameter in one.parameters)
    for tau in np.geomspace(length / 500, length / 3, TAUS).tolist() if shaped else (None,):
        values = np.append(np.zeros(len(one.parameters) - 1), tau or 0.0)
        # The last column of an effect with a time constant is the derivative by it.
        columns = one.derivative(values, still, conditions)[:, 0, : -1 if shaped else None]
        if one.shown_over == "temperature_lag":
            above = conditions.covariate("temperature_c")[:, None] - REFERENCE_C
            columns = np.hstack([(above + columns) ** k - above**k for k in DEGREES])
        yield columns, tau


def _choices(problem: _Problem, model: Model) -> list[Choice]:
    """Return all combinations of one form for each effect; effects of the temperature have one degree."""
    each = [problem.forms[name] for name in model]
    several = sum(forms[0].tau_s is not None for forms in each) > 1
    lists = [[form for form in forms if form.coarse or not several] for forms in each]
    powers = [k for k, forms in enumerate(each) if forms[-1].columns.shape[1] > 1]
    return [
        choice
        for choice in itertools.product(*lists)
        if len({choice[k].columns.shape[1] for k in powers}) <= 1
    ]


def _design(problem: _Problem, choice: Sequence[_Form]) -> Floats:
    """Return a constant and the columns of some forms, (n, p)."""
    return np.hstack([np.ones((len(problem.readings), 1)), *(form.columns for form in choice)])


def _folds(problem: _Problem, model: Model) -> tuple[Floats, list[Choice], list[Floats]]:
    """Fit each combination of forms to all blocks of time but one, and predict this block; for each block.

    Returns
    -------
    held_out : (axes,) float
        Sum of squared errors on the left-out blocks. The prediction is the mean over all combinations,
        weighted by likelihood. A combination takes no part in a block if the variance of its prediction
        from the other blocks exceeds four times the variance of the noise; a block without any is predicted
        by a constant.
    best : list of Choice
        Most likely combination for each axis.
    values : list of (p + 1,) float
        Its coefficients for each axis from a fit of all blocks.
    """
    choices = _choices(problem, model)
    readings = problem.readings.reshape(BLOCKS, -1, problem.readings.shape[1])
    predicted = np.empty((len(choices), *readings.shape))
    inside = np.empty((len(choices), BLOCKS, readings.shape[2]))
    variance = np.empty((len(choices), BLOCKS, 1))
    for j, choice in enumerate(choices):
        design = _design(problem, choice)
        size = np.abs(design).max(axis=0)
        blocks = (design / size).reshape(*readings.shape[:2], -1)
        # Normal equations of all blocks but one.
        own, cross = blocks.swapaxes(1, 2) @ blocks, blocks.swapaxes(1, 2) @ readings
        gram = own.sum(axis=0) - own
        gram += _RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(len(size))
        solution = np.linalg.solve(gram, cross.sum(axis=0) - cross)
        predicted[j] = blocks @ solution
        every = ((readings - blocks @ solution[:, None]) ** 2).sum(axis=(1, 2))
        inside[j] = every - ((readings - predicted[j]) ** 2).sum(axis=1)
        # The mean of x (XᵀX)⁻¹ xᵀ over the readings of the left-out block.
        variance[j, :, 0] = np.trace(np.linalg.solve(gram, own), axis1=1, axis2=2) / blocks.shape[1]
    # The noise of the samples is fitted: −n/2 ln(sum of squares), with one independent value per block.
    inside += problem.within * (AVERAGES - AVERAGES / BLOCKS)
    likelihood = -BLOCKS / 2 * np.log(np.maximum(inside, 1e-300))
    weight = np.exp(likelihood - likelihood.max(axis=0)) * (variance <= limits.predicted - 1)
    weight /= np.maximum(weight.sum(axis=0), 1e-300)
    left = readings - (weight[:, :, None] * predicted).sum(axis=0)
    best = [choices[k] for k in inside.sum(axis=1).argmin(axis=0)]
    columns = zip(best, problem.readings.T, strict=True)
    values = [np.linalg.lstsq(_design(problem, choice), y, rcond=None)[0] for choice, y in columns]
    return (left**2).sum(axis=(0, 1)), best, values


def _u(problem: _Problem, model: Model, axis: int) -> Floats:
    """Return the standard uncertainty (p,) of the amplitudes of a model on one axis.

    It is the root mean square distance to the amplitudes that each combination of forms, kind and size of
    slow noise gives, with the uncertainty of these, by their posterior. Combinations with another number of
    amplitudes take no part.
    """
    values = problem.once(_folds, model)[2][axis][1:]
    (white, scale), free = problem.once(_noises), len(problem.readings) - 1 - len(values)
    readings = white @ problem.readings[:, axis, None]
    scores, squares = [], []
    designs = (_design(problem, choice)[:, 1:] for choice in _choices(problem, model))
    for columns in (one for one in designs if one.shape[1] == len(values)):
        basis, triangle = np.linalg.qr(white @ columns)
        turned, back = basis.swapaxes(2, 3) @ readings, np.linalg.pinv(triangle)
        rest = np.maximum(((readings - basis @ turned) ** 2).sum(axis=(2, 3)), 1e-300)
        scores.append(scale - 0.5 * free * np.log(rest))
        away = (back @ turned)[..., 0] - values
        squares.append((back**2).sum(axis=3) * (rest / free)[..., None] + away**2)
    weight = np.exp(scores - log_sum_exp(np.array(scores)))
    return np.asarray(np.sqrt((weight[..., None] * squares).sum(axis=(0, 1, 2))))


def _noises(problem: _Problem) -> tuple[Floats, Floats]:
    """Return matrices (kinds, sizes, n, n) that whiten readings with slow noise and project off a constant.

    The second result (kinds, sizes) is the logarithm of the factor of the likelihood that depends only on
    kind (`NOISES`) and size (`NOISE_RATIOS`) of the noise.
    """
    t = problem.conditions.time_s
    flicker = covariance_of_means(t, np.append(t[1:], 2 * t[-1] - t[-2]))
    kernels = np.stack([np.eye(len(t)), np.minimum(t[:, None], t), flicker])
    variance = np.trace(kernels, axis1=1, axis2=2) / len(t) - kernels.mean(axis=(1, 2))
    values, vectors = np.linalg.eigh(kernels / variance[:, None, None])
    spread = 1 + np.array(NOISE_RATIOS)[:, None] * np.maximum(values, 0.0)[:, None]
    white = vectors.swapaxes(1, 2)[:, None] / np.sqrt(spread)[..., None]
    constant = white.sum(axis=3, keepdims=True)
    norm = (constant**2).sum(axis=2, keepdims=True)
    scale = -0.5 * (np.log(spread).sum(axis=2) + np.log(norm[..., 0, 0]))
    return white - constant * (constant.swapaxes(2, 3) @ white) / norm, scale


def _log_evidence(problem: _Problem, model: Model) -> Floats:
    """Return the log evidence of a model without and with a jump, by kind of noise, (2, kinds, axes).

    The kinds of noise have equal prior probability. A jump of the bias between two readings has the
    probability of a candidate. The size of the noise, the time of the jump and the forms (degree, time
    constant) of the model's effects are averaged. The prior of p amplitudes is g times their covariance,
    with g the number n of readings (Zellner's prior; Liang et al., J. Am. Stat. Assoc. 103, 2008): with a
    share R² explained, they multiply the evidence by (1 + g)^((n − 1 − p)/2) (1 + g (1 − R²))^(−(n − 1)/2).
    """
    choices, (white, scale) = _choices(problem, model), problem.once(_noises)
    n = len(problem.readings)
    readings = white @ problem.readings
    jumps = white @ np.tri(n, n - 1, -1)  # jump k is 0 up to reading k and 1 after it
    total, square = np.maximum((readings**2).sum(axis=2), 1e-300), (jumps**2).sum(axis=2)

    def factor(rest: Floats, p: int) -> Floats:
        """Return the logarithm of the evidence's factor for p amplitudes; `rest` is 1 − R²."""
        unexplained = np.log1p(n * np.maximum(rest, 0.0))
        return np.asarray(0.5 * (n - 1 - p) * np.log1p(n) - 0.5 * (n - 1) * unexplained)

    parts = np.empty((2, len(choices), *total.shape))
    for j, choice in enumerate(choices):
        basis = np.linalg.qr(white @ _design(problem, choice)[:, 1:])[0]
        turned, p = basis.swapaxes(2, 3), basis.shape[3]
        left = readings - basis @ (turned @ readings)
        # Squared lengths of the readings and of the jumps outside the span of the columns.
        rest, norm = (left**2).sum(axis=2), square - ((turned @ jumps) ** 2).sum(axis=2)
        # A jump inside the span explains nothing more.
        gain = (jumps.swapaxes(2, 3) @ left) ** 2 / np.maximum(norm, 1e-9 * n)[..., None]
        parts[0, j] = factor(rest / total, p)
        jumped = factor((rest[:, :, None] - gain) / total[:, :, None], p + 1)
        parts[1, j] = log_sum_exp(jumped, axis=2) - np.log(n - 1)
    parts += scale[..., None] - 0.5 * (n - 1) * np.log(total)
    jump = 1 / (1 + len(problem.effects))
    prior = np.log([1 - jump, jump]) - np.log(len(choices) * len(NOISE_RATIOS))
    return np.asarray(log_sum_exp(parts, axis=(1, 3)) + prior[:, None, None])


def _shares(problem: _Problem, model: Model) -> dict[str, float]:
    """Return for each effect that the model lacks the probability that it belongs to the model.

    The probabilities sum to 1 together with the probability that no further effect belongs to the model.
    The prior odds of each effect against none are 1 to the number of candidates. An effect may be absent on
    some axes, each with probability ½.
    """
    others = [name for name in problem.effects if name not in model]
    simpler = log_sum_exp(problem.once(_log_evidence, model), axis=(0, 1))
    log_odds = [0.0]
    for name in others:
        check()
        gained = log_sum_exp(problem.once(_log_evidence, (*model, name)), axis=(0, 1)) - simpler
        # Π (1 + BF) over the axes, without the product in which the effect is absent on each.
        product = float(np.logaddexp(0.0, gained).sum())
        inside = product + np.log(-np.expm1(-product)) if product > 0 else -np.inf
        log_odds.append(inside - np.log((2.0 ** len(gained) - 1) * len(problem.effects)))
    share = np.exp(log_odds - log_sum_exp(np.array(log_odds)))
    return dict(zip(others, share.tolist()[1:], strict=True))


def _uncaused(problem: _Problem, model: Model) -> list[str]:
    """Return a text for each axis on which the bias changes without a recorded cause."""
    evidence = problem.once(_log_evidence, model)
    chance = np.exp(evidence - log_sum_exp(evidence, axis=(0, 1)))
    ways = np.vstack([chance[0], chance[1].sum(axis=0)])
    return [
        f"{AXES[axis]} by {(*NOISES, 'a jump')[k]} ({format_percent(ways[k, axis])})"
        for axis, k in enumerate(ways.argmax(axis=0))
        if k and ways[0, axis] < 1 - limits.set_level
    ]


def _figures(problem: _Problem, model: Model) -> ErrorFigures:
    """Return the rms errors of a model in mg, over all readings and over held-out blocks.

    Over all readings the most likely time constants are used. A held-out block is predicted by the mean
    over all time constants, weighted by the likelihood of the other blocks.
    """
    residual = _residual(problem, model)
    by_axis = np.sqrt(problem.once(_folds, model)[0] / len(residual))
    return ErrorFigures(
        residual_rms=float(np.sqrt((residual**2).mean())),
        heldout_rms=float(np.sqrt((by_axis**2).mean())),
        angle_rms_deg=None,
        chi2_per_dof=None,
        heldout_by_axis=dict(zip(AXES, by_axis.tolist(), strict=False)),
    )


def _residual(problem: _Problem, model: Model) -> Floats:
    """Return the residual (n, axes) of the readings after a fit of a model to each axis."""
    _, best, values = problem.once(_folds, model)
    fitted = [_design(problem, choice) @ own for choice, own in zip(best, values, strict=True)]
    return problem.readings - np.column_stack(fitted)


def _parameters(problem: _Problem, model: Model, which: int) -> tuple[dict[str, Value], Detectable]:
    """Return the parameters of the effect `which` of a model, and its smallest detectable amplitude.

    A test at 1 % detects the smallest amplitude with 90 % probability. Amplitude k multiplies the k-th
    power: for a lag the names are `lag`, `lag2`, `lag3`.
    """
    _, best, values = problem.once(_folds, model)
    first = problem.effects[model[which]].parameters[0]
    stem, letters = first.name.rsplit("_", 1)[0], problem.effects[model[which]].axes
    parameters: dict[str, Value] = {}
    for axis, choice in enumerate(best):
        u = problem.once(_u, model, axis)
        begin = 1 + sum(form.columns.shape[1] for form in choice[:which])
        for k in range(choice[which].columns.shape[1]):
            name, unit = f"{stem}{('', 2, 3)[k]}_{letters[axis]}", first.unit + ("", "²", "³")[k]
            parameters[name] = Value(float(values[axis][begin + k]), float(u[begin - 1 + k]), unit)
        if (tau_s := choice[which].tau_s) is not None:
            parameters[f"tau_{letters[axis]}"] = Value(tau_s, None, "s")
    worst = max(parameters[f"{stem}_{letter}"].u or 0.0 for letter in letters)
    return parameters, Detectable((2.58 + 1.28) * worst, first.unit, first.name)


def _views(problem: _Problem, model: Model) -> Views:
    """Return the data of the figures: residual of the readings before and after each effect of a model."""
    c = problem.conditions
    covariates = {"time": c.time_s / 60.0, "temperature": c.covariate("temperature_c")}
    if c.supply_v is not None:
        covariates["supply"] = c.supply_v
    residuals = [_residual(problem, model[:k]) for k in range(len(model) + 1)]

    def panels(name: str, x: Floats, before: Floats, after: Floats) -> tuple[Panel, ...]:
        return tuple(
            Panel(name, f"residual_{letter}", x, old, new, np.full(len(x), np.nan))
            for letter, old, new in zip(AXES, before.T, after.T, strict=False)
        )

    steps = []
    for k, one in enumerate(map(problem.effects.__getitem__, model)):
        name = one.shown_over or (*one.covariates, "time")[0]
        lag = problem.once(_folds, model)[1][0][k].columns[:, 0]
        steps.append(panels(name, covariates.get(name, lag), residuals[k], residuals[k + 1]))
    left = (panels(name, covariates[name], residuals[0], residuals[-1]) for name in ("time", "temperature"))
    return Views(tuple(steps), tuple(itertools.chain(*left)))
