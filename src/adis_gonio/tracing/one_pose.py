"""Trace of a single dwell, sample by sample: how the bias depends on conditions while the sensor rests.

A single pose does not show gains, angles or a bias. The base model is therefore one constant per axis, and
the candidates vary in time: temperature (up to the third power), its lag, warm-up, drift, supply. Each axis
has its own degree and time constant.

A bias also moves without a recorded cause: it jumps, it walks at random, or its noise is 1/f. An effect is
therefore added only if it is more probable than these (`_Noise`), and if the error in most held-out blocks
of time does not grow. Held-out blocks are used neither for the fit nor for the choice of degree and time
constant. Inside a fold, degrees and time constants are averaged instead of chosen: each combination of them
predicts the held-out blocks with a weight in proportion to its likelihood. This likelihood takes each block
as one independent value, because neighbouring samples share slow noise. A choice of a single combination
would depend mostly on the last period of constant temperature.

All candidate columns form one design, and its normal equations are summed once for each block. Leaving out
blocks is then a subtraction, and a combination of degree and time constant is a choice of rows and columns.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from adis_gonio.base.arrays import Floats, log_sum_exp
from adis_gonio.base.budget import attempt, check
from adis_gonio.base.errors import FitError
from adis_gonio.base.jsonable import ComputedOnce
from adis_gonio.base.numbers import counted, format_percent
from adis_gonio.base.uncertainty import Detectable, Value
from adis_gonio.fitting.estimation.readings import mg_per_unit
from adis_gonio.model.effects import AXES, Conditions, Effect, effect
from adis_gonio.model.effects.sensor_terms import REFERENCE_C
from adis_gonio.model.records import Dwell, Session
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_figures import Panel, StepView, Views
from adis_gonio.tracing.trace_result import ErrorFigures, Finding, Step, TraceResult

BLOCKS = 10
LEAST_ROWS = 200
AVERAGES = 100
"""Number of averages over equal intervals of the recording for which slow noise is modelled."""
NOISE_RATIOS = (0.1, 1.0, 10.0, 1e2, 1e3, 1e4)
"""Sizes of slow noise that are tried: ratios of two variances of an average of samples.
The first variance is the one over the session by slow noise, the second the one by fast noise."""
DEGREES = (1, 2, 3)
ONE_WAY = 0.98
"""Rank correlation of temperature and time above which these count as one covariate."""
TAUS = 14
_WHITE = "white noise"
_POLYNOMIAL = ("bias_temperature", "thermal_lag")
_RIDGE = 1e-12
"""Ridge of the normal equations relative to their largest diagonal entry.
It keeps them solvable if columns are equal."""


@dataclass(frozen=True)
class _Variant:
    """One form of an effect (not the type of sensor): a degree of its polynomial and a time constant.

    Attributes
    ----------
    columns : tuple of int
        Numbers of its columns in the design.
    shape : float or None
        Time constant in s; None for an effect without one.
    """

    columns: tuple[int, ...]
    shape: float | None = None


@dataclass(frozen=True)
class _Candidate:
    """An effect of the catalogue with the forms (combinations of degree and time constant) to try."""

    effect: Effect
    variants: tuple[_Variant, ...]


@dataclass(frozen=True)
class _Problem(ComputedOnce):
    """The regression of the samples on the columns of all forms of all effects.

    A form is a combination of degree and time constant.

    Attributes
    ----------
    readings : (n, axes) float
        Samples in mg, minus their mean.
    design : (n, P) float
        Columns of all forms, a constant first; each is divided by its largest absolute value `size`.
    size : (P,) float
        Largest absolute value of each column before the division.
    gram : (BLOCKS, P, P) float
        Products of the columns with each other, summed over each block of time.
    cross : (BLOCKS, P, axes) float
        Products of the columns with the readings, summed over each block of time.
    square : (BLOCKS, axes) float
        Sums of squares of the readings in each block of time.
    tried : int
        Number of candidate effects.
    noises : tuple of _Noise
        Kinds of slow noise by which the bias may move without a recorded cause.
    """

    readings: Floats
    design: Floats
    size: Floats
    gram: Floats
    cross: Floats
    square: Floats
    tried: int
    noises: tuple[_Noise, ...]


@dataclass(frozen=True)
class _Noise:
    """One kind of slow noise, with averages of the samples that are whitened for R sizes of this noise.

    An average is the mean of the samples in one of n equal intervals of the recording.

    A jump of the bias at any time competes as one more column: a step between two averages.

    Attributes
    ----------
    kind : str
        `white noise`, `a random walk` or `1/f noise`.
    readings : (R, n, axes) float
        Whitened averages of the readings. A constant was projected off these averages and off all columns.
    design : (R, n, P) float
        Whitened averages of the columns of all forms.
    steps : (R, n, n − 1) float
        Whitened steps of unit size between neighbouring averages.
    scale : (R,) float
        Logarithm of the factor of the likelihood that depends only on kind and size of the noise.
    """

    kind: str
    readings: Floats
    design: Floats
    steps: Floats
    scale: Floats


Model = tuple[_Candidate, ...]


def trace_series(session: Session, max_effects: int = 6) -> TraceResult:
    """Return the trace of a session with a single pose: the causes by which its samples drift.

    `max_effects` is the largest number of effects in the model.

    Raises
    ------
    FitError
        Too few samples, or no recorded condition that they could depend on.
    """
    dwell = next(dwell for dwell in session.dwells if len(dwell))
    where = f"{session.source}: " if session.source else ""
    if len(dwell) < LEAST_ROWS:
        raise FitError(
            f"{where}one position with {counted(len(dwell), 'sample')} shows nothing to trace; measure at"
            f" least two positions, or at least {LEAST_ROWS} samples while the temperature changes"
        )
    if dwell.temperature_c is None:
        raise FitError(
            f"{where}one position only and no temperature: there is nothing to trace; record"
            " the temperature with the samples (temp_c), or measure at least two positions"
        )
    conditions = series_conditions(dwell)
    problem, candidates = _problem(series_readings(session, dwell), conditions)
    model: Model = ()
    losses = _held_out(problem, model)
    squares = [float(losses.sum())]
    figures = [_figures(problem, model)]
    reasons: dict[str, str] = {}
    shares: list[dict[_Candidate, float]] = []
    while len(model) < max_effects:
        nothing: dict[_Candidate, float] = {}
        share = attempt("further effects", partial(_shares, problem, model, candidates), nothing)
        chosen = max(share, key=share.__getitem__, default=None)
        none = 1 - sum(share.values())
        if chosen is None or none > limits.certain:
            reasons = {
                one.effect.name: "a jump or slow noise of the bias is more probable"
                f" ({format_percent(none)})"
                for one in share
                if share[one] > 1 - limits.set_level
            }
            break
        better = _held_out(problem, (*model, chosen))
        if np.median(better / losses) > limits.worse**2:
            reasons = {chosen.effect.name: "most held-out blocks of time would have a larger error with it"}
            break
        model, losses = (*model, chosen), better
        squares.append(float(losses.sum()))
        figures.append(_figures(problem, model))
        shares.append(share)
    rest = [tuple(one for one in model if one is not chosen) for chosen in model]
    shares = attempt(
        "what cannot be told apart", lambda: [_shares(problem, one, candidates) for one in rest], shares
    )
    # The names that may be in the place of each effect, the effect first.
    rivals = [
        [one.effect.name, *(k.effect.name for k in share if k != one and share[k] > 1 - limits.set_level)]
        for one, share in zip(model, shares, strict=True)
    ]
    uncaused: list[str] = attempt("movements without a cause", partial(_uncaused, problem, model), [])
    advice: tuple[str, ...] = (
        "one pose does not show whether bias or gain changes: repeat the cycle with the sensor "
        "turned over (each axis once up and once down)",
    )
    if _one_way(conditions):
        advice = (
            "the temperature only rose or only fell, so its effect looks like a drift: let it come back",
            *advice,
        )
    certain = [k for k, one in enumerate(model) if shares[k][one] >= limits.certain]
    return TraceResult(
        adequate=False,
        found=tuple(
            _finding(problem, model, k, (squares[k] - squares[k + 1]) / squares[0], shares[k][model[k]])
            for k in certain
        ),
        steps=tuple(Step(one.effect.name, error) for one, error in zip(model, figures[1:], strict=True)),
        confounded=tuple(tuple(names) for names in rivals if len(names) > 1),
        unnamed=None,
        before=figures[0],
        after=figures[-1],
        detectable=_detectable(problem, model),
        advice=advice,
        reasons=reasons,
        notes=(
            *(["the bias changes without a recorded cause: " + ", ".join(uncaused)] if uncaused else []),
            "one pose, traced sample by sample; adequacy cannot be tested, since the noise of neighbouring "
            "samples is not independent",
            "held-out rms by axis: "
            + ", ".join(
                f"{axis} {rms:.2f} mg" for axis, rms in (figures[-1].heldout_by_axis or {}).items()
            ),
        ),
        heldout_design=f"{BLOCKS} blocks of time, degrees and time constants averaged in each fold",
        views=_views(problem, model, certain, conditions),
    )


def series_readings(session: Session, dwell: Dwell) -> Floats:
    """Return the samples (n, axes) of a dwell in mg.

    Samples in counts of unknown scale are scaled so that their mean has the length of gravity.
    """
    scale = mg_per_unit(session)
    if session.accel_unit == "counts":
        scale = session.gravity_mg / max(float(np.linalg.norm(dwell.accel.mean(axis=0))), 1e-12)
    return np.asarray(dwell.accel * scale)


def series_conditions(dwell: Dwell) -> Conditions:
    """Return the conditions (time, temperature, supply) of each sample of a dwell."""
    time = dwell.time_s - dwell.time_s[0]
    assert dwell.temperature_c is not None
    return Conditions(
        time_s=time,
        temperature_c=dwell.temperature_c,
        supply_v=dwell.supply_v,
        temperature_history=(time, dwell.temperature_c) if (np.diff(time) > 0).all() else None,
    )


def _problem(readings: Floats, conditions: Conditions) -> tuple[_Problem, tuple[_Candidate, ...]]:
    """Return the regression of the samples on all candidate effects, and these effects."""
    n, axes = readings.shape
    blocks: list[Floats] = [np.ones((n, 1))]
    candidates: list[_Candidate] = []
    for name in ("bias_temperature", "thermal_lag", "warm_up", "bias_drift", "supply_bias"):
        made = effect(name, AXES[:axes])
        variants: list[_Variant] = []
        for columns, tau in _forms(name, conditions) if not conditions.lacks(made.needs) else ():
            first = sum(block.shape[1] for block in blocks)
            blocks.append(columns)
            moving = np.ptp(columns, axis=0) > 0
            variants += [
                _Variant(tuple(range(first, first + degree)), tau)
                for degree in range(1, columns.shape[1] + 1)
                if moving[:degree].all()
            ]
        if variants:
            candidates.append(_Candidate(made, tuple(variants)))
    design = np.concatenate(blocks, axis=1)
    size = np.maximum(np.abs(design).max(axis=0), 1e-300)
    design = design / size
    # Blocks of equal length in time.
    of_block = np.arange(n) * BLOCKS // n
    centred = readings - readings.mean(axis=0)
    parts = [(design[of_block == b], centred[of_block == b]) for b in range(BLOCKS)]
    problem = _Problem(
        tried=len(candidates),
        noises=_whiten_averages(centred, design, conditions.time_s),
        readings=centred,
        design=design,
        size=size,
        gram=np.array([x.T @ x for x, _ in parts]),
        cross=np.array([x.T @ y for x, y in parts]),
        square=np.array([(y**2).sum(axis=0) for _, y in parts]),
    )
    return problem, tuple(candidates)


def _forms(name: str, conditions: Conditions) -> Iterator[tuple[Floats, float | None]]:
    """Yield the columns (n, d) of an effect on one axis, with each time constant in s to try.

    An effect without a time constant has one form, with None. Column k of an effect of the temperature is
    the term of degree k: (T − 25 °C)^k, or (T_lag − 25 °C)^k − (T − 25 °C)^k for an element at T_lag.
    """
    degrees = {"degree": DEGREES[-1]} if name == "bias_temperature" else {}
    made = effect(name, ("x",), **degrees)
    ones, length = np.ones((len(conditions), 1)), float(np.ptp(conditions.time_s))
    shaped = any(parameter.shape for parameter in made.parameters)
    for tau in np.geomspace(length / 500, length / 3, TAUS).tolist() if shaped else (None,):
        values = np.zeros(len(made.parameters))
        if tau is not None:
            values[-1] = tau
        # The last column of an effect with a time constant is the derivative by it.
        columns = made.derivative(values, ones, conditions)[:, 0, : -1 if shaped else None]
        if name == "thermal_lag":
            above = conditions.covariate("temperature_c")[:, None] - REFERENCE_C
            columns = np.concatenate([(above + columns) ** k - above**k for k in DEGREES], axis=1)
        yield columns, tau


def _labels(made: Effect, count: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names and the units of an effect's `count` amplitudes on one axis.

    Amplitude k multiplies the k-th power: for a lag the names are `lag`, `lag2`, `lag3`.
    """
    first = next(p for p in made.parameters if not p.shape)
    stem = first.name.rsplit("_", 1)[0]
    powers = [("", ""), ("2", "²"), ("3", "³")][:count]
    return tuple(stem + digit for digit, _ in powers), tuple(first.unit + up for _, up in powers)


def _choices(model: Model) -> list[tuple[int, ...]]:
    """Return all combinations of one form (degree, time constant) for each effect of a model, by number."""
    lists = []
    several = sum(len(candidate.variants) > len(DEGREES) for candidate in model) > 1
    for candidate in model:
        taus = list(dict.fromkeys(variant.shape for variant in candidate.variants))
        kept = set(taus[:: 3 if several else 1])
        lists.append([k for k, variant in enumerate(candidate.variants) if variant.shape in kept])
    degrees = [
        [len(v.columns) for v in candidate.variants] if candidate.effect.name in _POLYNOMIAL else None
        for candidate in model
    ]
    return [
        choice
        for choice in itertools.product(*lists)
        if len({of[k] for of, k in zip(degrees, choice, strict=True) if of is not None}) <= 1
    ]


def _columns(model: Model, choice: tuple[int, ...]) -> list[int]:
    return [0, *(c for one, k in zip(model, choice, strict=True) for c in one.variants[k].columns)]


def _solve_with_ridge(gram: Floats, cross: Floats) -> Floats:
    """Solve normal equations for coefficients (…, p, axes), with a negligible ridge.

    The ridge only makes the equations solvable if columns are equal.
    """
    p = gram.shape[-1]
    ridge = _RIDGE * np.trace(gram, axis1=-2, axis2=-1)[..., None, None] * np.eye(p)
    solution: Floats = np.linalg.solve(gram + ridge, cross)
    return solution


def _fits(problem: _Problem, model: Model) -> tuple[list[tuple[int, ...]], Floats, Floats, Floats]:
    """Fit each combination of forms to all time blocks but one, leaving out each block in turn.

    Returns
    -------
    choices : list of tuple of int
        Combinations: for each effect of the model the number of its form (degree and time constant).
    coefficients : (choices, BLOCKS, P, axes) float
        Coefficients of all columns without each block, zero for unused columns.
    inside : (choices, BLOCKS, axes) float
        Sums of squares of the residual in the fitted blocks.
    spread : (choices, BLOCKS) float
        Mean variance of the prediction in the left-out block, in variances of the noise.
    """
    choices = _choices(model)
    total, total_cross = problem.gram.sum(axis=0), problem.cross.sum(axis=0)
    square = problem.square.sum(axis=0) - problem.square
    coefficients = np.zeros((len(choices), *problem.cross.shape))
    inside = np.zeros((len(choices), *problem.square.shape))
    spread = np.zeros((len(choices), BLOCKS))
    for j, choice in enumerate(choices):
        columns = _columns(model, choice)
        # Normal equations of all blocks but one, restricted to the columns of this choice.
        own = problem.gram[:, columns][:, :, columns]
        gram = total[columns][:, columns] - own
        cross = (total_cross - problem.cross)[:, columns]
        solution = _solve_with_ridge(gram, cross)
        coefficients[j][:, columns] = solution
        inside[j] = _squares(square, cross, gram, solution)
        # The mean of x (XᵀX)⁻¹ xᵀ over the samples of the left-out block.
        spread[j] = np.trace(_solve_with_ridge(gram, own), axis1=1, axis2=2) / own[:, 0, 0]
    return choices, coefficients, inside, spread


def _squares(square: Floats, cross: Floats, gram: Floats, solution: Floats) -> Floats:
    """Return the residual sum of squares (BLOCKS, axes) of each fit of blocks of time.

    Parameters
    ----------
    square : (BLOCKS, axes) float
        Sums of squares of the readings.
    cross, gram : (BLOCKS, p, axes), (BLOCKS, p, p) float
        Products of the columns with the readings and with each other.
    solution : (BLOCKS, p, axes) float
        Coefficients of the columns.
    """
    # |y − Xb|² = yᵀy − 2 bᵀXᵀy + bᵀXᵀX b, from the sums of each block.
    quadratic = np.einsum("bia,bij,bja->ba", solution, gram, solution)
    left: Floats = np.maximum(square - 2 * (cross * solution).sum(axis=1) + quadratic, 0.0)
    return left


def _held_out(problem: _Problem, model: Model) -> Floats:
    """Return the sum of squared errors (BLOCKS, axes) of a model on held-out blocks of time.

    The prediction is the mean over all time constants of the model's effects, weighted by likelihood. A
    time constant takes no part in a block if the variance of its prediction from the other blocks exceeds
    four times the variance of the noise; a block without any time constant is predicted by a constant.
    """
    _, coefficients, inside, spread = problem.once(_fits, model)
    # The noise is fitted: −n/2 ln(sum of squares), with one independent value per block.
    likelihood = -BLOCKS / 2 * np.log(np.maximum(inside, 1e-300))
    weight = np.exp(likelihood - likelihood.max(axis=0)) * (spread <= limits.predicted - 1)[:, :, None]
    weight /= np.maximum(weight.sum(axis=0), 1e-300)
    mean = np.einsum("jba,jbpa->bpa", weight, coefficients)
    return _squares(problem.square, problem.cross, problem.gram, mean)


def _best_variants(problem: _Problem, model: Model) -> list[tuple[int, ...]]:
    """Return for each axis the most likely forms (degree, time constant) of the model's effects."""
    choices, _, inside, _ = problem.once(_fits, model)
    return [choices[k] for k in inside.sum(axis=1).argmin(axis=0)]


def _whiten_averages(readings: Floats, design: Floats, time_s: Floats) -> tuple[_Noise, ...]:
    """Return averages of the samples over short intervals, whitened for each kind of slow noise.

    `readings` and `design` are the samples and the columns of the regression.
    """
    count = min(AVERAGES, len(time_s))
    cuts = np.arange(count) * len(time_s) // count
    size = np.diff(np.append(cuts, len(time_s)))[:, None]

    def averaged(rows: Floats) -> Floats:
        return np.asarray(np.add.reduceat(rows, cuts) / size)

    t = averaged(time_s[:, None])[:, 0] - time_s[0]
    length = float(t[-1])
    steps = np.tri(count, count - 1, -1)  # step k is 0 up to average k and 1 after it
    columns = np.hstack([np.ones((count, 1)), averaged(readings), averaged(design[:, 1:]), steps])
    gaps = np.abs(t[:, None] - t)
    # 1/f noise is the sum of processes with correlation times at equal logarithmic spacing.
    taus = np.geomspace(length / count, 10 * length, 12)
    kernels = {
        _WHITE: np.zeros((count, count)),
        "a random walk": np.minimum(t[:, None], t),
        "1/f noise": np.exp(-gaps[None] / taus[:, None, None]).mean(axis=0),
    }
    centre = np.eye(count) - 1 / count
    noises = []
    for kind, kernel in kernels.items():
        variance = np.trace(centre @ kernel @ centre) / count
        values, vectors = np.linalg.eigh(kernel / variance if variance > 0 else kernel)
        ratios = np.array(NOISE_RATIOS if variance > 0 else (0.0,))
        spread = 1 + ratios[:, None] * np.maximum(values, 0.0)
        white = (vectors.T @ columns) / np.sqrt(spread)[:, :, None]
        constant = white[:, :, :1]
        norm = (constant**2).sum(axis=1, keepdims=True)
        white = white[:, :, 1:] - constant * (constant * white[:, :, 1:]).sum(axis=1, keepdims=True) / norm
        scale = -0.5 * (np.log(spread).sum(axis=1) + np.log(norm[:, 0, 0]))
        axes = readings.shape[1]
        parts = white[:, :, :axes], white[:, :, axes : 1 - count], white[:, :, 1 - count :]
        noises.append(_Noise(kind, *parts, scale))
    return tuple(noises)


def _log_evidence(problem: _Problem, model: Model) -> Floats:
    """Return the log evidence of a model by kind of noise, without and with a jump, (kinds, 2, axes).

    The kinds of noise have equal prior probability, and a jump has the probability of a candidate. The size
    of the noise, the time of the jump and the forms (degree, time constant) of the model's effects are
    averaged. The prior of p amplitudes is g times their covariance, with g the number n of averages
    (Zellner's prior; Liang et al., J. Am. Stat. Assoc. 103, 2008): with a share R² explained, they multiply
    the evidence by (1 + g)^((n − 1 − p)/2) (1 + g (1 − R²))^(−(n − 1)/2).
    """
    choices = _choices(model)
    out = np.empty((len(problem.noises), 2, problem.readings.shape[1]))
    for k, noise in enumerate(problem.noises):
        n = noise.readings.shape[1]
        total = (noise.readings**2).sum(axis=1)

        def factor(rest: Floats, p: int, n: int = n) -> Floats:
            """Return the logarithm of the evidence's factor for p amplitudes.

            `rest` is 1 − R², the share of the sum of squares that they leave unexplained. n is the number
            of averages.
            """
            g = float(n)
            return np.asarray(
                0.5 * (n - 1 - p) * np.log1p(g) - 0.5 * (n - 1) * np.log1p(g * np.maximum(rest, 0.0))
            )

        alone = noise.scale[:, None] - 0.5 * (n - 1) * np.log(np.maximum(total, 1e-300))
        parts = np.empty((2, len(choices), *alone.shape))
        for j, choice in enumerate(choices):
            columns = [c - 1 for c in _columns(model, choice)[1:]]
            basis = np.linalg.qr(noise.design[:, :, columns])[0]
            turned = basis.transpose(0, 2, 1)
            left = noise.readings - basis @ (turned @ noise.readings)
            steps = noise.steps - basis @ (turned @ noise.steps)
            rest = (left**2).sum(axis=1)
            norm = (steps**2).sum(axis=1)
            # A step inside the span of the other columns explains nothing more.
            gain = (steps.transpose(0, 2, 1) @ left) ** 2 / np.maximum(norm, 1e-9 * n)[:, :, None]
            floor = np.maximum(total, 1e-300)
            parts[0, j] = factor(rest / floor, len(columns))
            jumped = factor((rest[:, None] - gain) / floor[:, None], len(columns) + 1)
            parts[1, j] = log_sum_exp(jumped, axis=1) - np.log(jumped.shape[1])
        parts += alone
        out[k] = log_sum_exp(parts, axis=(1, 2)) - np.log(len(choices) * len(alone))
    jump = 1 / (1 + problem.tried)
    return out + np.log([1 - jump, jump])[:, None]


def _log_odds(problem: _Problem, model: Model, simpler: Model) -> float:
    """Return the log posterior odds of a model against a `simpler` model that lacks one of its effects.

    An effect has the prior odds 1 to the number of candidates. It may be absent on some axes, each with
    probability ½.
    """
    evidence = (problem.once(_log_evidence, one) for one in (model, simpler))
    by_axis = [log_sum_exp(one, axis=(0, 1)) for one in evidence]
    gained = by_axis[0] - by_axis[1]
    # Π (1 + BF) over the axes, without the product in which the effect is absent on each.
    product = float(np.logaddexp(0.0, gained).sum())
    inside = product + np.log(-np.expm1(-product)) if product > 0 else -np.inf
    return float(inside - np.log(2.0 ** len(gained) - 1) - np.log(problem.tried))


def _shares(problem: _Problem, model: Model, candidates: Sequence[_Candidate]) -> dict[_Candidate, float]:
    """Return for each effect that the model lacks the probability that it belongs to the model.

    The probabilities sum to 1 together with the probability that no further effect belongs to the model.
    The prior odds of each effect against none are 1 to the number of candidates.
    """
    from scipy.special import softmax

    others = [one for one in candidates if one not in model]
    odds = [0.0]
    for one in others:
        check()
        odds.append(_log_odds(problem, (*model, one), model))
    return dict(zip(others, softmax(odds).tolist()[1:], strict=True))


def _uncaused(problem: _Problem, model: Model) -> list[str]:
    """Return a text for each axis on which the bias changes without a recorded cause."""
    from scipy.special import softmax

    out = []
    chance = softmax(problem.once(_log_evidence, model), axis=(0, 1))
    for axis in range(chance.shape[2]):
        ways = {
            "a jump": chance[:, 1, axis].sum(),
            **{noise.kind: chance[k, 0, axis] for k, noise in enumerate(problem.noises)},
        }
        likely = max(ways, key=ways.__getitem__)
        if likely != _WHITE and chance[0, 0, axis] < 1 - limits.set_level:
            out.append(f"{AXES[axis]} by {likely} ({format_percent(ways[likely])})")
    return out


def _one_way(conditions: Conditions) -> bool:
    """Return True if the temperature only rises or only falls with time, except for noise."""
    from scipy.stats import spearmanr

    temperature = conditions.covariate("temperature_c")
    if np.ptp(temperature) == 0:
        return False
    return abs(float(spearmanr(conditions.time_s, temperature).statistic)) > ONE_WAY


def _figures(problem: _Problem, model: Model) -> ErrorFigures:
    """Return the rms errors of a model in mg, over all samples and over held-out blocks.

    Over all samples the most likely time constants are used. A held-out block is predicted by the mean over
    all time constants, weighted by the likelihood of the other blocks.
    """
    each = [_columns(model, choice) for choice in _best_variants(problem, model)]
    residual = _residual(problem, each)
    by_axis = np.sqrt(_held_out(problem, model).sum(axis=0) / len(residual))
    return ErrorFigures(
        residual_rms=float(np.sqrt((residual**2).mean())),
        heldout_rms=float(np.sqrt((by_axis**2).mean())),
        angle_rms_deg=None,
        chi2_per_dof=None,
        heldout_by_axis={AXES[k]: float(value) for k, value in enumerate(by_axis)},
    )


def _residual(problem: _Problem, each: Sequence[list[int]]) -> Floats:
    """Return the residual (n, axes) of the samples after a fit of the listed columns to each axis."""
    fitted = [problem.design @ _coefficients(problem, columns, axis) for axis, columns in enumerate(each)]
    return problem.readings - np.column_stack(fitted)


def _coefficients(problem: _Problem, columns: list[int], axis: int) -> Floats:
    """Return the coefficients (P,) of a fit of the listed columns to one axis; zero for other columns."""
    gram = problem.gram.sum(axis=0)[np.ix_(columns, columns)]
    out = np.zeros(problem.design.shape[1])
    out[columns] = _solve_with_ridge(gram, problem.cross.sum(axis=0)[columns, axis : axis + 1])[:, 0]
    return out


def _estimates(problem: _Problem, model: Model, which: int) -> list[tuple[_Variant, Floats, Floats]]:
    """Return for each axis the form of an effect, its amplitudes (d,) and their standard uncertainties.

    The uncertainties are from the jackknife over blocks of time. `which` is the effect's index in `model`.
    """
    choices, without_block, _, _ = problem.once(_fits, model)
    out = []
    for axis, choice in enumerate(_best_variants(problem, model)):
        variant = model[which].variants[choice[which]]
        own = list(variant.columns)
        spread = without_block[choices.index(choice)][:, own, axis].std(axis=0) * np.sqrt(BLOCKS - 1)
        values = _coefficients(problem, _columns(model, choice), axis)[own]
        out.append((variant, values / problem.size[own], spread / problem.size[own]))
    return out


def _finding(problem: _Problem, model: Model, which: int, explains: float, share: float) -> Finding:
    """Return the finding of the effect with the index `which` in a model.

    `explains` is the share of the base model's held-out squares that it removes, `share` its probability.
    """
    made = model[which].effect
    parameters: dict[str, Value] = {}
    for letter, (variant, values, spread) in zip(AXES, _estimates(problem, model, which), strict=False):
        names, units = _labels(made, len(values))
        for name, unit, value, u in zip(names, units, values.tolist(), spread.tolist(), strict=True):
            parameters[f"{name}_{letter}"] = Value(value, u, unit)
        if variant.shape is not None:
            parameters[f"tau_{letter}"] = Value(variant.shape, None, "s")
    return Finding(
        effect=made.name,
        axes=made.axes,
        parameters=parameters,
        p_value=1.0 - share,
        explains=float(np.clip(explains, 0, 1)),
        probability=share,
        cause=made.cause,
    )


def _detectable(problem: _Problem, model: Model) -> dict[str, Detectable]:
    """Return for each effect of the model the amplitude that a test at 1 % detects with 90 % probability.

    The uncertainties are from the jackknife over blocks.
    """
    out = {}
    for which, candidate in enumerate(model):
        worst = max(float(spread[0]) for _, _, spread in _estimates(problem, model, which))
        parameter = candidate.effect.parameters[0]
        out[candidate.effect.name] = Detectable((2.58 + 1.28) * worst, parameter.unit, parameter.name)
    return out


def _views(problem: _Problem, model: Model, certain: Sequence[int], conditions: Conditions) -> Views:
    """Return the data of the figures: residual of the samples before and after each effect that was found.

    `certain` are the indices of these effects in `model`. An effect that is not certain has no figure.
    """
    variants = _best_variants(problem, model)

    def residual(chosen: Sequence[int]) -> Floats:
        """Return the residual after a fit of a constant and some effects, each in its most likely form."""
        own = [[model[k].variants[choice[k]].columns for k in chosen] for choice in variants]
        return _residual(problem, [[0, *itertools.chain(*columns)] for columns in own])

    def panels(name: str, x: Floats, before: Floats, after: Floats) -> tuple[Panel, ...]:
        unknown = np.full(len(x), np.nan)
        return tuple(
            Panel(name, f"residual_{letter}", x, before[:, k], after[:, k], unknown)
            for k, letter in enumerate(AXES[: before.shape[1]])
        )

    def covariate(name: str) -> Floats:
        recorded = {"temperature": conditions.temperature_c, "supply": conditions.supply_v}.get(name)
        return conditions.time_s / 60.0 if recorded is None else recorded

    after, steps = residual(certain), []
    for k, one in enumerate(model):
        made = one.effect
        shown: tuple[Panel, ...] = ()
        if k in certain:
            name = made.shown_over or (made.covariates or ("time",))[0]
            first = one.variants[variants[0][k]].columns[0]
            lag = name == "temperature_lag"
            x = problem.design[:, first] * problem.size[first] if lag else covariate(name)
            shown = panels(name, x, residual([j for j in certain if j != k]), after)
        steps.append(StepView(made.name, shown, beside_all=k in certain))
    base = residual(())
    left = [
        panel for name in ("time", "temperature") for panel in panels(name, covariate(name), base, after)
    ]
    return Views(tuple(steps), tuple(left))
