"""Choice of further measurements that distinguish the remaining hypotheses, by expected information.

Each hypothesis is a model with a Gaussian posterior of its parameters. The prior is twice as wide as the
effects that benches show, so a parameter that the session does not determine is uncertain, but not absurd.
With the model linearised about the fit, the hypothesis predicts the whitened readings of an imagined dwell
as N(μ, 1 + R Rᵀ), with R Rᵀ from the uncertainty of the parameters. The expected information of a set of
dwells about the true hypothesis is estimated by its lower bound from pairwise Bhattacharyya distances B
(Kolchinsky and Tracey, Entropy 19:361, 2017), −Σᵢ wᵢ ln Σⱼ wⱼ exp(−Bᵢⱼ) in nats, with the probabilities wᵢ
of the hypotheses. The bound is exact if predictions are either equal or do not overlap, and it never
exceeds the information to be gained, even if an extrapolation is wild. Dwells are added one by one, each
given the dwells before it, by information per effort.

The design answers two questions: which of the probable models is true (`decide`), and whether an effect is
present that this session could not have shown (`cover`).

`advise` states the proposed dwells in sentences, with actions of the operator that distinguish effects.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.budget import check
from adis_gonio.base.numbers import format_duration, join_words
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings, from_means
from adis_gonio.fitting.estimation.terms import NamedTerm, NamelessTerm, Term
from adis_gonio.model.effects import AXES, catalogue
from adis_gonio.model.effects.gyro_terms import WHOLE_TURNS
from adis_gonio.model.effects.stage_terms import BETWEEN
from adis_gonio.tracing.credible_sets import undecided
from adis_gonio.tracing.findings import cycles_alike
from adis_gonio.tracing.selection import Selection, fit_model
from adis_gonio.tracing.trace_result import NextDwell, Purpose

MOST_RIVALS = 10
MOST_DWELLS = 4
"""Largest number of dwells that are proposed for each of the two questions."""
COVERED = 0.9
"""Share of the posterior that the compared models have together."""
UNSEEN = 0.03
"""Prior probability of an effect that the session could not have shown."""
LEAST_SEPARATION = 3.0
"""Least expected difference of two hypotheses, in standard uncertainties, of a proposed measurement."""
FAINT_SEPARATION = 0.1
"""Least difference that is accepted if the model is inadequate and no measurement reaches more."""
LEAST_INFORMATION: dict[Purpose, float] = {"decide": 0.05, "cover": 0.02}
"""Least expected information in nats of a measurement, by its purpose.
Two equally probable models have 0.7 nats; an effect that the session could not have shown has 0.1 nats."""
TYPICALS = 2.0
"""Prior standard deviation of an effect in units of its typical size on benches."""
START_RAD, SENSOR = 0.3, 0.03
"""Prior standard deviations of the start angle (rad), and of gains and skews (rad), about fitted values.
Without a measurement these are known as well as sensors are alike."""
PLAIN = 100.0
"""Expected difference in standard uncertainties above which a sentence states only "more than"."""
FAR = 1e6
"""Limit of predictions in standard uncertainties, because they may overflow in an extrapolation."""

_EFFORT_WAIT_S = 300.0
"""Wait in s that is as much effort as one additional position."""


Predictions = list[Floats]
"""Whitened readings of n imagined dwells as each hypothesis predicts them, arrays (n, rows, 1 + p).
The first entry of the last axis is the predicted reading. The others are a root of the covariance that the
p parameters of the hypothesis add to the predictions."""


@dataclass(frozen=True)
class Hypothesis:
    """A model that may be true, with its probability.

    Attributes
    ----------
    labels : tuple of str
        Names of the model's effects, and descriptions of its unnamed terms.
    weight : float
        Probability of the model among the hypotheses.
    fit : Fit
        Fit of the model to the session.
    shift, root : (p,), (p, p) float
        Posterior mean minus the fitted parameters, and a root of the posterior covariance.
    chi2 : float
        χ² of the residual plus χ² of the parameters with respect to their prior.
    evidence : float
        Log evidence of the session for the model.
    """

    labels: tuple[str, ...]
    weight: float
    fit: Fit
    shift: Floats
    root: Floats
    chi2: float
    evidence: float


def propose(data: Readings, selection: Selection, terms: Sequence[Term]) -> tuple[NextDwell, ...]:
    """Return proposed dwells that would distinguish the possible models, the most informative first.

    Parameters
    ----------
    data : Readings
        Readings of all dwells.
    selection : Selection
        Model chosen from the fitted dwells, with its rivals.
    terms : sequence of Term
        All candidate terms of the session.
    """
    turned = data.model.freedom > 0 or data.conditions.force_g is not None
    if not turned or (data.planar and data.conditions.angle_rad is None):
        return ()  # no attitude to choose, or unknown angles
    inflation = selection.inflation
    if selection.adequate:
        rivals = _rivals(selection)
    else:
        inflation, rivals = _explanations(selection, terms)
    decided = _greedy(data, inflation, rivals, "decide", [])
    if not decided and not selection.adequate:
        # With noise that no model explains, measurements separate little; report the best of them anyway.
        decided = _greedy(data, inflation, rivals, "decide", [], FAINT_SEPARATION)
    known = {name for h in rivals for name in h.labels}
    unseen = _normalised(_extended(selection, terms, selection.inflation, known))
    return (*decided, *_greedy(data, selection.inflation, unseen, "cover", decided))


# -- hypotheses -------------------------------------------------------------------------------------------


def label(term: Term) -> str:
    """Return the words for a term in a sentence of advice: its name, or a description if it is unnamed."""
    if term.name is not None:
        return term.name
    where = {"bias": "zero", "gain": "gain", "angle": "true angle", "misalignment": "misalignment"}
    enters = where.get(str(term.where), "reading") if isinstance(term, NamelessTerm) else "reading"
    covariates = [_COVARIATES.get(name, name.replace("_", " ")) for name in term.covariates]
    return f"an unnamed change of the {enters} with {join_words(covariates)}"


_COVARIATES = {
    "angle": "the angle",
    "reading": "the reading",
    "approach": "the side of approach",
    "previous_angle": "the position before",
    "order": "the order",
    "supply": "the supply",
    "line_frequency": "the frequency of a line that moves",
    "temperature_rate": "the speed of warming",
    "variance": "vibration",
}


def _labels(model: Sequence[Term]) -> tuple[str, ...]:
    return tuple(sorted({label(term) for term in model}))


def _rivals(selection: Selection) -> list[Hypothesis]:
    """Return the chosen model and the best model of each other probable set of names, as hypotheses.

    Together they have the share `COVERED` of the posterior probability, unless this needs more than
    `MOST_RIVALS` models. A model with one effect more than an adequate model may be among them: with few
    dwells an effect can be too faint to be found and yet as probable as its absence.
    """
    found, problem = selection.found, selection.problem
    near = found.near(7.0)
    top = max(near.values())
    ours = _labels(selection.terms)
    weight: dict[tuple[str, ...], float] = {ours: 0.0}
    best: dict[tuple[str, ...], tuple[int, ...]] = {ours: selection.verdict.best}
    for numbers in sorted(near, key=lambda m: -near[m]):
        names = _labels([problem.terms[k] for k in numbers])
        weight[names] = weight.get(names, 0.0) + float(np.exp(near[numbers] - top))
        best.setdefault(names, numbers)
    total = sum(weight.values())
    out: list[Hypothesis] = []
    together = 0.0
    for names in sorted(weight, key=lambda names: (names != ours, -weight[names]))[:MOST_RIVALS]:
        if together > COVERED * total:
            break
        together += weight[names]
        fit = selection.fit if names == ours else fit_model(problem, best[names], selection.fit)
        out.append(fitted_hypothesis(fit, weight[names], selection.inflation))
    return _normalised(out)


def _explanations(selection: Selection, terms: Sequence[Term]) -> tuple[float, list[Hypothesis]]:
    """Return a noise factor, and hypotheses that add one effect each to a model that is not adequate.

    `terms` are all candidate terms. The factor on the noise variance is 1 or, if larger, the smallest χ²
    per degree of freedom of any hypothesis. If several names are undecided, only these are compared. "No
    further effect" is not a hypothesis, because the model is not adequate.
    """
    extended = _extended(selection, terms, 1.0, set())
    freedom = max(selection.fit.dof - 1, 1)
    inflation = max(1.0, min(h.chi2 for h in extended) / freedom)
    if inflation > 1.0:
        extended = _extended(selection, terms, inflation, set())
    could = set(undecided(selection))
    standing = [h for h in extended if could & set(h.labels)]
    if len(standing) > 1:
        extended = standing
    likely = sorted(extended, key=lambda h: -h.weight)[:MOST_RIVALS]
    return inflation, _normalised([h for h in likely if h.weight > 0.02 * likely[0].weight])


def _extended(
    selection: Selection,
    terms: Sequence[Term],
    inflation: float,
    known: set[str],
) -> list[Hypothesis]:
    """Return the chosen model and its extensions by one more effect, as hypotheses with weights.

    The effects come from the candidates `terms`, without those in `known`. A weight is the prior
    probability of the effect times the evidence of the session, with the noise variance multiplied by
    `inflation`.
    """
    chosen = selection.fit
    found = [fitted_hypothesis(chosen, 1.0, inflation)]
    inside = set(found[0].labels)
    for name, term in widest_terms(terms).items():
        if name in known or name in inside:
            continue
        absent = term.start(np.zeros(len(term.amplitudes)))
        fit = chosen.with_terms((*chosen.terms, term), (*chosen.values.terms, absent))
        found.append(fitted_hypothesis(fit, UNSEEN, inflation))
    top = max(h.evidence for h in found)
    return [replace(h, weight=h.weight * float(np.exp(h.evidence - top))) for h in found]


def widest_terms(terms: Sequence[Term]) -> dict[str, NamedTerm]:
    """Return one candidate term for each effect: on all its axes, with a shape in the middle of its grid.

    It is chosen among the candidates `terms`. Effects of single dwells are omitted.
    """
    variants: dict[str, list[NamedTerm]] = {}
    for term in terms:
        if isinstance(term, NamedTerm) and "dwell" not in term.effect.choices():
            variants.setdefault(term.effect.name, []).append(term)
    out = {}
    for name, all_of_them in variants.items():
        widest = max(len(term.effect.axes) for term in all_of_them)
        same = [term for term in all_of_them if len(term.effect.axes) == widest]
        if "degree" in same[0].effect.choices():
            same = same[:1]
        out[name] = same[len(same) // 2]
    return out


def fitted_hypothesis(fit: Fit, weight: float, inflation: float) -> Hypothesis:
    """Return the hypothesis that a fitted model is true.

    `weight` is the hypothesis' prior probability; the noise variance is multiplied by `inflation`. The
    posterior of the parameters assumes priors of physically plausible size.
    """
    columns = whitened_columns(fit, fit.whitener / np.sqrt(inflation))
    flat = columns.reshape(-1, columns.shape[2])
    left = fit.residual.ravel() / np.sqrt(inflation)
    mean, precision = parameter_prior(fit, flat)
    away = mean - fit.values.parameters
    # In units of the prior's standard deviations, so that the matrix is well scaled.
    unit = 1 / np.sqrt(precision)
    scaled = flat * unit
    # The information matrix is RᵀR; computed as XᵀX + 1 it might lose the 1 by rounding.
    q, triangle = np.linalg.qr(np.concatenate([scaled, np.eye(len(unit))]))
    pull = scaled.T @ left + away / unit
    inverse = np.linalg.inv(triangle)
    step = inverse @ (q.T @ np.concatenate([left, away / unit]))
    chi2 = float(left @ left) + float(((away / unit) ** 2).sum()) - float(pull @ step)
    evidence = -0.5 * chi2 - float(np.log(np.abs(np.diagonal(triangle))).sum())
    root = unit[:, None] * inverse
    return Hypothesis(_labels(fit.terms), weight, fit, unit * step, root, chi2, evidence)


def parameter_prior(fit: Fit, flat: Floats) -> tuple[Floats, Floats]:
    """Return the mean and inverse variance (p,) of the prior of each parameter.

    `flat` are the whitened columns (rows, p) of the parameters. The prior is wide for base parameters, and
    has the typical physical size for effects.
    """
    means = [fit.values.base]
    spreads = [START_RAD if np.isinf(p.spread) else SENSOR for p in fit.data.model.parameters]
    sigmas = [np.array(spreads)]
    for index, (term, values) in enumerate(zip(fit.terms, fit.values.terms, strict=True)):
        if isinstance(term, NamedTerm):
            mean, sigma = np.zeros(len(values)), np.ones(len(values))
            for k, parameter in enumerate(term.effect.parameters):
                if parameter.shape:
                    mean[k], sigma[k] = values[k], 0.5 * max(abs(values[k]), 1e-6)
                else:
                    # An effect may be larger than usual, so the prior is at least as wide as its value.
                    sigma[k] = max(TYPICALS * abs(parameter.typical), abs(values[k]))
        else:
            mean = np.zeros(len(values))
            length = np.sqrt((flat[:, fit.slice_of(index)] ** 2).mean(axis=0))
            sigma = np.maximum(4.0 / np.maximum(length, 1e-12), np.abs(values))
        means.append(mean)
        sigmas.append(sigma)
    return np.concatenate(means), 1 / np.concatenate(sigmas) ** 2


def whitened_columns(fit: Fit, whiten: Floats) -> Floats:
    """Return the derivatives (n, rows, p) of the whitened readings with respect to all parameters.

    `whiten` (n, rows, axes) are the matrices that whiten the readings.
    """
    return np.clip(np.nan_to_num(whiten @ fit.columns, posinf=FAR, neginf=-FAR), -FAR, FAR)


def _normalised(hypotheses: list[Hypothesis]) -> list[Hypothesis]:
    total = sum(h.weight for h in hypotheses)
    return [replace(h, weight=h.weight / total) for h in hypotheses]


# -- the design -------------------------------------------------------------------------------------------


def _joined(first: Predictions, then: Predictions) -> Predictions:
    """Return the predictions for sets of dwells, followed by those for further dwells of each set."""
    return [
        np.concatenate([np.repeat(one, len(two), axis=0), two], axis=1)
        for one, two in zip(first, then, strict=True)
    ]


def _greedy(
    data: Readings,
    inflation: float,
    hypotheses: list[Hypothesis],
    purpose: Purpose,
    before: list[NextDwell],
    least: float = LEAST_SEPARATION,
) -> list[NextDwell]:
    """Choose dwells one by one; each adds the most information per effort to the dwells before it.

    Parameters
    ----------
    inflation : float
        Factor on the noise variance.
    before : list of NextDwell
        Dwells that were chosen already.
    least : float
        Least difference of two hypotheses in standard uncertainties that a dwell must show.
    """
    out: list[NextDwell] = []
    if len(hypotheses) < 2:
        return out
    weights = np.array([h.weight for h in hypotheses])
    measured = [np.zeros((1, 0, 1 + len(h.shift))) for h in hypotheses]
    for count, place in enumerate(before):
        measured = _joined(measured, _predict(data, inflation, hypotheses, [place], before[:count]))
    known = float(information_nats(weights, measured)[0])
    options = _options(data)
    effort = np.array([1.0 + place.wait_s / _EFFORT_WAIT_S for place in options])
    while len(out) < MOST_DWELLS:
        check()
        predicted = _predict(data, inflation, hypotheses, options, [*before, *out])
        gain = information_nats(weights, _joined(measured, predicted)) - known
        apart_before = expected_separations(measured)
        for k in np.argsort(-gain / effort)[:20].tolist():
            # Skip gains near zero, whose ranking depends on the grid's order and on rounding.
            if gain[k] < LEAST_INFORMATION[purpose] * min(least / LEAST_SEPARATION, 1.0) ** 2:
                continue
            with_it = _joined(measured, [own[k : k + 1] for own in predicted])
            apart = expected_separations(with_it) - apart_before
            worth = _separated_pair(weights, apart, least)
            if worth is not None:
                break
        else:
            break
        one, two = worth
        parted = [two]
        if purpose == "cover":
            reach = np.maximum(apart[one], apart[:, one])
            parted = [j for j in range(len(weights)) if j != one and reach[j] >= least**2]
        first = set(hypotheses[one].labels)
        others = [name for j in parted for name in hypotheses[j].labels if name not in first]
        own = tuple(sorted(first - set(hypotheses[parted[0]].labels)))
        out.append(
            replace(
                options[k],
                separation=float(np.sqrt(max(apart[one, two], apart[two, one]))),
                information=float(gain[k]),
                purpose=purpose,
                separates=(own, tuple(dict.fromkeys(others))),
            )
        )
        measured = with_it
        known += float(gain[k])
    return out


def _separated_pair(weights: Floats, apart: Floats, least: float) -> tuple[int, int] | None:
    """Return the two hypotheses that a dwell separates best; None if it separates no pair.

    The more probable hypothesis of the pair is first. `weights` (K,) are the probabilities of the
    hypotheses, the chosen model first; a pair with the chosen model has priority. `apart` (K, K) are the
    expected separations as χ², and a pair counts as separated from `least` standard uncertainties on.
    """
    both = np.maximum(apart, apart.T)
    likely = np.sqrt(np.outer(weights, weights)) * (both >= least**2)
    np.fill_diagonal(likely, 0.0)
    if likely[0].max() > 0:
        # The first question is whether the chosen model is right.
        likely[1:, 1:] = 0.0
    if likely.max() <= 0:
        return None
    one, two = np.unravel_index(int(likely.argmax()), likely.shape)
    return (int(one), int(two)) if weights[one] >= weights[two] else (int(two), int(one))


def information_nats(weights: Floats, dwells: Predictions) -> Floats:
    """Return the expected information (n,) in nats about the true hypothesis, of each of n sets of dwells.

    `weights` are the probabilities of the hypotheses. The predictions (n, rows, 1 + p) have the rows of all
    dwells of a set.
    """
    distance = np.zeros((len(weights), len(weights), len(dwells[0])))
    covariances = [own[..., 1:] @ own[..., 1:].transpose(0, 2, 1) + np.eye(own.shape[1]) for own in dwells]
    half = [0.5 * np.linalg.slogdet(c)[1] for c in covariances]
    for i, j in itertools.combinations(range(len(weights)), 2):
        middle = (covariances[i] + covariances[j]) / 2
        difference = dwells[i][..., 0] - dwells[j][..., 0]
        solved = np.linalg.solve(middle, difference[:, :, None])[:, :, 0]
        # Bhattacharyya distance: ⅛ Δᵀ M⁻¹ Δ + ½ ln |M| − ¼ ln |Cᵢ| |Cⱼ|, M the mean covariance.
        d = (difference * solved).sum(axis=1) / 8 + 0.5 * (np.linalg.slogdet(middle)[1] - half[i] - half[j])
        distance[i, j] = distance[j, i] = np.maximum(d, 0.0)
    mixed = np.einsum("j,ijn->in", weights, np.exp(-distance))
    return np.asarray(-(weights[:, None] * np.log(np.maximum(mixed, 1e-300))).sum(axis=0))


def expected_separations(dwells: Predictions) -> Floats:
    """Return how well dwells separate K hypotheses: the expected excess χ² (K, K) of j if i is true.

    The excess is the χ² beyond its degrees of freedom.
    """
    out = np.zeros((len(dwells), len(dwells)))
    flat = [own.reshape(-1, own.shape[2]) for own in dwells]
    mean = np.array([own[:, 0] for own in flat])
    covariance = [own[:, 1:] @ own[:, 1:].T + np.eye(len(own)) for own in flat]
    for j, matrix in enumerate(covariance):
        inverse = np.linalg.inv(matrix)
        difference = mean - mean[j]
        # Expectation of χ² under j if i is true: trace(Cⱼ⁻¹ Cᵢ) + Δᵀ Cⱼ⁻¹ Δ, minus its own n.
        out[:, j] = ((difference @ inverse) * difference).sum(axis=1) - mean.shape[1]
        out[:, j] += [(inverse * own).sum() for own in covariance]  # trace of the product
    np.fill_diagonal(out, 0.0)
    return out


# -- imagined dwells --------------------------------------------------------------------------------------


def _options(data: Readings) -> list[NextDwell]:
    """Return the imagined dwells to choose from: all positions, and some after a wait."""
    c = data.conditions
    if data.planar:
        sides = (1, -1) if c.approach is not None else (0,)
        fine = [NextDwell(float(a), None, side) for a in range(0, 360, 15) for side in sides]
        coarse = [place for place in fine if (place.angle_deg or 0.0) % 45 == 0 and place.approach >= 0]
    else:
        fine = []
        for v in itertools.product((-1, 0, 1), repeat=3):
            if any(v):
                x, y, z = (float(s) for s in np.array(v) / np.linalg.norm(v))
                fine.append(NextDwell(None, (x, y, z)))
        coarse = [place for place in fine if place.direction and max(map(abs, place.direction)) == 1.0]
    length = float(np.ptp(c.time_s))
    wait = float(np.ceil(min(max(length, 30.0), 600.0) / 30) * 30)
    return [*fine, *(replace(place, wait_s=wait) for place in coarse)]


def _predict(
    data: Readings,
    inflation: float,
    hypotheses: list[Hypothesis],
    options: list[NextDwell],
    before: list[NextDwell],
) -> Predictions:
    """Predict by each hypothesis the whitened readings of the dwells `options`, if each follows `before`.

    `before` are the dwells measured first; `inflation` is the factor on the noise variance. Predictions are
    cut off at ±`FAR`.
    """
    imagined = _imagined(data, options, before)
    _, attitude = imagined.model.begin(imagined.mean, imagined.angle_rad, imagined.conditions)
    fits = [
        Fit(imagined, h.fit.terms, replace(h.fit.values, attitude=attitude), h.fit.with_prior)
        for h in hypotheses
    ]
    whiten = fits[0].whitener / np.sqrt(inflation)
    out = []
    for h, fit in zip(hypotheses, fits, strict=True):
        with np.errstate(over="ignore", invalid="ignore"):  # an exponential far outside its range
            columns = whitened_columns(fit, whiten)
            mean = np.einsum("nrk,nk->nr", whiten, fit.predicted) + columns @ h.shift
        mean = np.nan_to_num(mean, posinf=FAR, neginf=-FAR)
        out.append(np.clip(np.concatenate([mean[..., None], columns @ h.root], axis=2), -FAR, FAR))
    return out


def _imagined(data: Readings, options: list[NextDwell], before: list[NextDwell]) -> Readings:
    """Return the readings of the imagined dwells `options`, after the session and the dwells `before`.

    They have the conditions of the last dwell, except for the median supply and the mean variance.
    """
    c, n = data.conditions, len(options)
    step = float(np.median(np.diff(np.sort(c.time_s)))) if len(data) > 1 else 30.0
    end = float(c.time_s.max()) + sum(step + place.wait_s for place in before)
    if data.planar:
        angle = np.deg2rad([place.angle_deg or 0.0 for place in options])
        ideal = np.stack([np.cos(angle), -np.sin(angle)], axis=1)
    else:
        angle, ideal = None, np.array([place.direction for place in options], dtype=float)
    changed: dict[str, Any] = {
        "time_s": end + step + np.array([place.wait_s for place in options]),
        "angle_rad": angle,
        "approach": np.array([float(place.approach) for place in options]),
        "force_g": ideal,
        "rate_dps": np.zeros((n, 3)),
        "abs_rate_dps": None,
    }
    if c.order is not None:
        changed["order"] = np.full(n, c.order.max() + 1 + len(before))
    if before and before[-1].angle_deg is not None:
        changed["previous_angle_rad"] = np.full(n, np.deg2rad(before[-1].angle_deg))
    elif c.angle_rad is not None:
        changed["previous_angle_rad"] = np.full(n, c.angle_rad[-1])
    if c.supply_v is not None:
        changed["supply_v"] = np.full(n, np.median(c.supply_v))
    if c.variance_mg2 is not None:
        changed["variance_mg2"] = np.tile(c.variance_mg2.mean(axis=0), (n, 1))
    if c.temperature_history is not None and c.temperature_c is not None:
        times, temperatures = c.temperature_history
        ends = max(end, float(times[-1])) + np.array([1.0, 1e5])
        changed["temperature_history"] = (
            np.append(times, ends),
            np.append(temperatures, [c.temperature_c[-1]] * 2),
        )
    recorded = {name: values for name, values in changed.items() if getattr(c, name) is not None}
    return from_means(
        data.model.size * (ideal if data.model.freedom else np.zeros((n, data.axes))),
        np.tile(data.covariance.mean(axis=0), (n, 1, 1)),
        replace(c.rows(np.full(n, len(data) - 1)), **recorded),
        gravity_mg=data.gravity_mg,
        fixture_rad=data.fixture_rad,
        measurement=data.measurement,
    )


def advise(
    data: Readings,
    selection: Selection,
    terms: Sequence[Term],
    confounded: Sequence[Sequence[str]],
) -> tuple[tuple[str, ...], tuple[NextDwell, ...]]:
    """Return advice for the next measurements, as sentences and as dwells, the most informative first.

    Parameters
    ----------
    data : Readings
        Readings of all dwells.
    selection : Selection
        Model chosen from the fitted dwells, with its rivals.
    terms : sequence of Term
        All candidate terms of the session.
    confounded : sequence of sequences of str
        Groups of names of effects that the session cannot distinguish.
    """
    measurements = tuple(replace(m, sentence=_sentence([m])) for m in propose(data, selection, terms))
    lines = list(sentences(measurements))
    strong = [m for m in measurements if m.purpose == "decide" and m.separation >= LEAST_SEPARATION]
    decided = {name for m in strong for names in m.separates for name in names}
    inside = {term.name for term in selection.terms}
    remedies = {
        name: (not data.planar and kind.remedy_in_space) or kind.remedy
        for name, kind in catalogue(data.model.part).items()
        if kind.remedy
    }
    groups = [c for c in confounded if c[0] in inside or not selection.adequate]
    lines += _by_hand(groups, decided, remedies, alone=not data.model.freedom)
    # Stage errors with different numbers of cycles per turn can look alike at the session's angles.
    lines += [
        f"to tell {cycles} cycles a turn from {join_words([str(n) for n in others])}: {BETWEEN}"
        for cycles, others in cycles_alike(selection)
    ]
    lines += _not_recorded(selection.data)
    if not selection.adequate and not lines:
        lines.append(
            "repeat each position at another time and from the other side: the residual is larger than "
            "the noise of the readings, and no single cause explains it"
        )
    return tuple(lines), measurements


def sentences(measurements: Sequence[NextDwell]) -> tuple[str, ...]:
    """Return the proposed measurements as sentences; one sentence lists the dwells with one purpose."""
    groups: dict[object, list[NextDwell]] = {}
    for m in measurements:
        # A group separates one pair of hypotheses, or shows effects that are not yet visible.
        groups.setdefault("cover" if m.purpose == "cover" else m.separates, []).append(m)
    return tuple(map(_sentence, groups.values()))


def place(measurement: NextDwell) -> str:
    """Describe a proposed dwell, such as `45° from above, after waiting 5 min`."""
    if measurement.angle_deg is not None:
        where = f"{measurement.angle_deg:g}°" + (" from above" if measurement.approach < 0 else "")
    else:
        parts = enumerate(measurement.direction or ())
        axes = [f"{'+' if part > 0 else '−'}{AXES[k]}" for k, part in parts if abs(part) > 0.3]
        where = f"an attitude that reads {' '.join(axes)}"
    waiting = f", after waiting {format_duration(measurement.wait_s)}" if measurement.wait_s else ""
    return where + waiting


def _sentence(group: Sequence[NextDwell]) -> str:
    """Return one sentence that proposes all dwells of a group, which answer the same question."""
    first, places = group[0], list(dict.fromkeys(map(place, group)))
    what = join_words(places, comma="; " if any("," in words for words in places) else ", ")
    if first.purpose == "cover":
        names = list(dict.fromkeys(name for m in group for names in m.separates for name in names))
        return f"measure at {what}: only then could {join_words(names)} be seen, if present"
    strongest = max(m.separation for m in group)
    figure = f"more than {PLAIN:.0f}" if strongest > PLAIN else f"about {strongest:.{int(strongest < 1)}f}"
    apart = f"expected difference {figure} standard uncertainties"
    one, other = map(join_words, first.separates)
    shows, tells = ("shows", "tells") if strongest >= LEAST_SEPARATION else ("may show", "may tell")
    if not one or not other:
        return f"measure at {what}: that {shows} whether {one or other} is there ({apart})"
    return f"measure at {what}: that {tells} {one} from {other} ({apart})"


def _by_hand(
    confounded: Sequence[Sequence[str]],
    decided: set[str],
    remedies: Mapping[str, str],
    *,
    alone: bool,
) -> list[str]:
    """Return actions of the operator that distinguish confounded effects which no further dwell separates.

    Parameters
    ----------
    confounded : sequence of sequences of str
        Groups of effects that the session cannot distinguish; the first of each group is in the model.
    decided : set of str
        Effects that a proposed dwell decides, which need no action.
    remedies : mapping of str to str
        Action by effect.
    alone : bool
        True if the readings have no attitude that a further dwell could change. If no rival in a group has
        an action, the action for the effect in the model is then returned.
    """
    to_do: dict[str, dict[str, None]] = {}
    for names in confounded:
        # The first name is in the model; if it is alone in its group it has no named rival.
        rivals = names[1:] or names
        if alone and not any(name in remedies for name in rivals):
            rivals = names[:1]
        for name in rivals:
            if name in remedies and name not in decided:
                to_do.setdefault(remedies[name], {})[name] = None
    return [f"to confirm or rule out {join_words([*names])}: {remedy}" for remedy, names in to_do.items()]


def _not_recorded(data: Readings) -> list[str]:
    """Return advice to record conditions that are missing from the session, one line each."""
    c = data.conditions
    lines = []
    if data.planar and c.angle_rad is None:
        lines.append(
            "declare the angles of the stage: without them no effect of the stage can be looked for"
        )
    elif data.planar and c.approach is None:
        lines.append(
            "record from which side each position was reached, and approach several from both: backlash "
            "and hysteresis show in nothing else"
        )
    if c.temperature_c is None:
        lines.append("record the temperature: without it no thermal effect can be looked for")
    if "rotation" in data.model.driven_by and c.rate_dps is None:
        lines.append(f"{WHOLE_TURNS}: without turns nothing is known of gains and directions")
    return lines
