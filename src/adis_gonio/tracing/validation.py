"""Validation of a trace: errors on held-out dwells, and the names and steps that these errors allow.

Held-out dwells are the `check` dwells or, without any, folds of dwells with the selection repeated inside
each fold. A fold consists of whole dwells: every fifth dwell (shuffled); blocks of time, if positions
repeat so that no block leaves a gap of angles; or all dwells with gravity nearest to one end of a body
axis. Plain leave-one-out is too optimistic if poses repeat, because another dwell of the same pose replaces
the dwell that was left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.budget import check, with_progress
from adis_gonio.base.numbers import format_unit
from adis_gonio.fitting.estimation.fit import Fit, adequacy, predictable_dwells
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.model.effects import AXES
from adis_gonio.tracing.averaging import AveragedFit, average
from adis_gonio.tracing.credible_sets import Names
from adis_gonio.tracing.linear_problem import span
from adis_gonio.tracing.selection import Selection, select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.trace_result import ErrorFigures

BY_AXIS = "body axes"
BLOCKS_OF_TIME = "blocks of time"


@dataclass(frozen=True)
class HeldOut:
    """Residuals of a model on held-out dwells.

    Attributes
    ----------
    residual : (n, axes) float
        Reading minus model at the attitude that fits the dwell best within the fixture's tolerance.
    angle_rad : (n,) float or None
        Angle computed from the reading minus declared angle; None without declared angles.
    predicted : (n,) bool
        True for each dwell with a reading that is determined by the model that was fitted without it.
    """

    residual: Floats
    angle_rad: Floats | None
    predicted: NDArray[np.bool_]

    def rows(self, index: NDArray[np.bool_]) -> HeldOut:
        """Return the residuals of the dwells for which the mask `index` (n,) is True."""
        turned = None if self.angle_rad is None else self.angle_rad[index]
        if turned is not None and np.isnan(turned).any():
            turned = None
        return HeldOut(self.residual[index], turned, self.predicted[index])


def residuals_on(fit: Fit, data: Readings) -> HeldOut:
    """Return the residuals of a model on dwells to which it was not fitted."""
    there = fit.on(data)
    return HeldOut(there.misfit, fit.angle_error_rad(data), np.ones(len(data), dtype=bool))


def rms(residual: Floats, by_axis: bool) -> float:
    """Return the root mean square of residuals (n, axes).

    If `by_axis`, the mean is over all axes and dwells; else it is of the squared length of each dwell's
    residual.
    """
    squares = residual**2
    return float(np.sqrt(squares.mean() if by_axis else squares.sum(axis=1).mean()))


def folds(data: Readings) -> dict[str, list[NDArray[np.bool_]]]:
    """Return the possible designs of holding out dwells: for each name, the masks (n,) of its folds.

    Several sessions have only one design, folds of shuffled dwells, since a block of time would be a whole
    session.
    """
    n = len(data)
    count = min(limits.folds, n) if n > limits.alone else n
    # A fixed shuffle, so that no fold consists of exactly every fifth angle of a turn.
    shuffled = np.random.default_rng(5).permutation(n)
    designs = {"whole dwells": [shuffled % count == k for k in range(count)]}
    if data.model.origins:
        return designs
    blocks = [np.arange(n) * limits.blocks // n == k for k in range(limits.blocks)]
    if n >= 2 * limits.blocks and _poses_repeat(data, blocks):
        designs[BLOCKS_OF_TIME] = blocks
    by_axis = masks_about_axes(data)
    if by_axis and 3 * int(determined(data, by_axis).sum()) >= n:
        designs[BY_AXIS] = by_axis
    return designs


def masks_about_axes(data: Readings) -> list[NDArray[np.bool_]]:
    """Return masks (n,) of the dwells with gravity nearest to each end of each body axis.

    In one plane the result is empty unless positions repeat: at least half of the dwells need another dwell
    within `limits.repeated_deg`. In a turn of different positions no dwell can replace another, and leaving
    out a quarter of the turn makes a different session.
    """
    if data.planar:
        theta = data.conditions.angle_rad
        if theta is None:
            return []
        # Distances of all pairs of angles. Positions do not repeat if less than half of the dwells have a
        # neighbour.
        apart = np.abs(wrap_radians(theta[:, None] - theta[None, :]))
        if 2 * int(((apart < np.deg2rad(limits.repeated_deg)).sum(axis=1) > 1).sum()) < len(data):
            return []
    pose = data.model.pose(data.mean, data.conditions)
    if pose is None:
        return []
    nearest = np.abs(pose).argmax(axis=1)
    up = np.take_along_axis(pose, nearest[:, None], axis=1)[:, 0] > 0
    # Six groups in space: axis nearest to gravity, and its direction.
    groups = 2 * nearest + up
    return [groups == group for group in np.unique(groups)]


def predicted_dwells(
    data: Readings, designs: Mapping[str, list[NDArray[np.bool_]]], model: Sequence[Term]
) -> dict[str, NDArray[np.bool_]]:
    """Return for each design of holding out dwells a mask (n,) of the dwells that count in the error.

    `designs` has the masks of the folds by design, `model` the terms of the model. In folds of shuffled
    dwells every dwell counts. If the dwells about a body axis are left out together, a dwell counts only if
    the other dwells predict it by the base model and the unnamed functions of the model. This also holds
    for blocks of time if the model has unnamed functions. For example, if a quarter of a turn is left out,
    the other dwells do not determine a function with harmonics there. A design in which less than a third
    of the dwells count is omitted.
    """
    nameless = [term for term in model if term.name is None]
    every = np.ones(len(data), dtype=bool)
    counts = {}
    for name, masks in designs.items():
        counts[name] = every
        if name == BY_AXIS or (nameless and name == BLOCKS_OF_TIME):
            counts[name] = determined(data, masks, nameless)
            if name == BY_AXIS:
                counts[name] &= data.model.by_pose(data.conditions)
            if 3 * int(counts[name].sum()) < len(data):
                del counts[name]
    return counts


def determined(
    data: Readings, masks: Sequence[NDArray[np.bool_]], further: Sequence[Term] = ()
) -> NDArray[np.bool_]:
    """Return a mask (n,) of the dwells that the dwells of the other folds can predict.

    The prediction is by the base model, a bias of each axis, and further terms.

    With the whitened columns X_b of the held-out rows and X₋b of the other rows, the prediction of the
    held-out rows has covariance 1 + X_b (X₋bᵀ X₋b)⁻¹ X_bᵀ in units of the noise. A dwell counts up to a
    variance of four. An error with a larger variance shows that the other dwells do not determine the
    reading, and not that the model is wrong.

    Parameters
    ----------
    masks : sequence of (n,) bool
        The dwells of each fold.
    further : sequence of Term
        Further terms of the model, which the other folds have to determine too.
    """
    begun = Fit.begin(data)
    # A bias on each axis, in units of the full reading.
    zero = np.tile(data.model.size * np.eye(data.axes), (len(data), 1, 1))
    more = [begun.candidate(term) for term in further]
    columns = begun.white_by_dwell(np.concatenate([begun.base_columns, zero, *more], axis=2))
    out = np.zeros(len(data), dtype=bool)
    for mask in masks:
        out[mask] = predictable_dwells(
            columns[~mask].reshape(-1, columns.shape[2]), columns[mask], limits.predicted
        )
    return out


def _poses_repeat(data: Readings, blocks: list[NDArray[np.bool_]]) -> bool:
    """Return True if every dwell has a near pose in another block of time.

    Near is less than 2.5 steps of the angle, or 45° in space. `blocks` (n,) are the masks of the blocks.
    """
    theta, turn = data.conditions.angle_rad, 2 * np.pi
    unit = None if data.planar else data.model.pose(data.mean, data.conditions)
    if unit is not None:
        near = np.arccos(np.clip(unit @ unit.T, -1, 1)) < np.pi / 4
    elif data.planar and theta is not None:
        step = turn / max(len(np.unique(np.round(np.mod(theta, turn), 3))), 1)
        near = np.abs(wrap_radians(theta[:, None] - theta[None, :])) < 2.5 * step
    else:
        return False
    return all(bool(near[np.ix_(b, ~b)].any(axis=1).all()) for b in blocks)


def cross_validate(
    data: Readings,
    designs: dict[str, list[NDArray[np.bool_]]],
    fit: Callable[[Readings], Fit],
) -> dict[str, HeldOut]:
    """Return for each design the residuals of held-out dwells under models fitted without their fold.

    `designs` has the masks of the folds by name; `fit` selects and fits a model of the remaining dwells.
    """
    out = {}
    folds_in_all, begun = sum(map(len, designs.values())), 0
    for name, masks in designs.items():
        residual = np.full(data.mean.shape, np.nan)
        turned = np.full(len(data), np.nan)
        predicted = np.ones(len(data), dtype=bool)
        for mask in with_progress(masks, begun, folds_in_all):
            check()
            chosen = fit(data.rows(~mask))
            predicted[mask] = chosen.can_predict(data.rows(mask), limits.predicted)
            left = residuals_on(chosen, data.rows(mask))
            residual[mask] = left.residual
            if left.angle_rad is not None:
                turned[mask] = left.angle_rad
        begun += len(masks)
        out[name] = HeldOut(residual, turned, predicted)
    return out


def drop_unpredicted(
    counts: Mapping[str, NDArray[np.bool_]], chosen: Mapping[str, HeldOut]
) -> dict[str, NDArray[np.bool_]]:
    """Remove from masks of counted dwells the dwells that a model chosen without them does not determine.

    `counts` has the mask (n,) of the dwells that count, by design of the folds. `chosen` has the residuals
    under models that were chosen again without each fold; `HeldOut.predicted` marks the dwells that these
    models determine. If the dwells that show an effect are left out, such as a quarter of a turn, another
    effect may be chosen that fits the other dwells equally well. Its covariance shows that the left-out
    dwells are undetermined by many mg. A design with less than a third of the dwells remaining is dropped,
    unless this drops all designs.
    """
    rest = {name: own & chosen[name].predicted for name, own in counts.items()}
    kept = {name: mask for name, mask in rest.items() if 3 * int(mask.sum()) >= len(mask)}
    return kept or dict(counts)


def held_out_alike(
    models: Sequence[tuple[Fold, Readings, Fit | None]], terms: Sequence[Term], by: Sequence[int] = ()
) -> tuple[list[list[HeldOut]], dict[str, NDArray[np.bool_]]]:
    """Return the residuals of several models on the same held-out dwells, for each design of the folds.

    Returned with them are masks (n,) of these dwells, by design.

    Parameters
    ----------
    models : sequence of (Fold, Readings, Fit or None)
        Arguments of `Fold.left_out` for each model, with the readings of the same dwells.
    terms : sequence of Term
        Terms of the chosen model, by which dwells count (`predicted_dwells`).
    by : sequence of int
        Numbers of the models that must determine each dwell that counts.
    """
    data = models[0][1]
    designs = folds(data)
    counts = predicted_dwells(data, designs, terms)
    designs = {name: designs[name] for name in counts}
    lefts = [fold.left_out(own, designs, fit) for fold, own, fit in models]
    for k in by:
        counts = drop_unpredicted(counts, lefts[k])
    return [[left[name].rows(mask) for name, mask in counts.items()] for left in lefts], counts


@dataclass(frozen=True)
class Fold:
    """Settings and results of choosing and fitting a model again without the dwells of each fold.

    Attributes
    ----------
    terms : sequence of Term
        Candidate terms inside a fold.
    averaged : AveragedFit or None
        Average over unnamed functions that was found with all dwells; None without one.
    max_effects : int
        Largest number of terms of a model.
    """

    terms: Sequence[Term]
    averaged: AveragedFit | None
    max_effects: int
    _made: dict[tuple[int, str], tuple[Fit | None, HeldOut]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __contains__(self, fit: Fit) -> bool:
        """Return True if residuals of this very fit were computed in the folds."""
        return any(known == id(fit) for known, _ in self._made)

    def left_out(
        self, data: Readings, designs: Mapping[str, list[NDArray[np.bool_]]], fit: Fit | None = None
    ) -> dict[str, HeldOut]:
        """Return the residuals on held-out dwells for each design, which are computed only once.

        Parameters
        ----------
        data : Readings
            All dwells that may be held out.
        designs : mapping of str to list of (n,) bool
            Masks of the folds by design.
        fit : Fit, optional
            Fit with the effects that are kept in every fold; by default effects are chosen again.
        """
        fresh = {name: masks for name, masks in designs.items() if (id(fit), name) not in self._made}
        made = cross_validate(data, fresh, self.choose_in_fold if fit is None else fit.again)
        self._made.update({(id(fit), name): (fit, left) for name, left in made.items()})
        return {name: self._made[id(fit), name][1] for name in designs}

    def choose_in_fold(self, rows: Readings) -> Fit:
        """Choose and fit a model of `rows`, the dwells that are not held out."""
        chosen = select(
            rows, self.terms, self.max_effects, explored=limits.fold_explored, rounds=limits.fold_rounds
        )
        if self.averaged is not None:
            return average(chosen, self.averaged.promising) or chosen.fit
        return chosen.fit


def nest_fits(selection: Selection, averaged: AveragedFit | None) -> tuple[list[Fit], list[str]]:
    """Return fits of nested models, from the base model to the chosen model, and the name added at each.

    Terms that every model must have (forced terms) are added first, then in each step the term that
    explains most. If an unnamed function was averaged over several forms, `averaged` is the fit with the
    average, which is then the last fit; otherwise `averaged` is None.
    """
    left = list(selection.verdict.best)
    model: list[int] = []
    values = {t.label: v for t, v in zip(selection.terms, selection.fit.values.terms, strict=True)}
    fits, steps = [selection.base], []
    while left:
        # Forced terms come first, so that no shorter model lacks them.
        next_ = [k for k in left if selection.problem.terms[k].forced] or left
        chi2 = {k: float((span(selection.problem, [*model, k])[1] ** 2).sum()) for k in next_}
        best = min(chi2, key=lambda k: chi2[k])
        model.append(best)
        left.remove(best)
        terms = [selection.problem.terms[k] for k in model]
        steps.append(terms[-1].shown_as)
        fits.append(selection.base.with_terms(terms, [values[term.label] for term in terms]).refit())
    if averaged is not None:
        if sum(term.name is not None for term in averaged.terms) == len(selection.terms):
            steps.append(averaged.terms[-1].shown_as)
            fits.append(averaged)
        else:
            fits[-1] = averaged
    return fits, steps


def error_figures(
    selection: Selection,
    measured: Readings,
    checking: Readings | None,
    fits: Sequence[Fit],
    fold: Fold,
) -> tuple[list[ErrorFigures], str]:
    """Return the errors of nested models, and a description of how dwells were held out.

    Parameters
    ----------
    measured : Readings
        Fitted readings with the measured noise (without dwell-to-dwell scatter).
    checking : Readings or None
        Readings of the check dwells, which are then the held-out dwells; None without check dwells.
    fits : sequence of Fit
        Nested fits, the base model first.
    fold : Fold
        Settings for the choice of a model inside a fold.
    """
    data = selection.data
    if checking is not None:
        return without_folds(fits, measured, checking)
    again: float | None = None
    if leaves_too_few(fits[-1]):
        lefts, design = leave_each_out(fits)
    else:
        several = len(fits) > 1
        # The effects of the final model are chosen again, and also kept if no average replaces them.
        models = [*fits[:-1], None, *([fits[-1]] if fold.averaged is None else [])] if several else fits
        lefts, counts = held_out_alike(
            [(fold, data, fit) for fit in models], selection.terms, [len(fits) - 1] if several else []
        )
        designs = folds(data)
        shown = {k: "" if m.all() else f", {m.sum()} of {len(data)} dwells" for k, m in counts.items()}
        design = "; ".join(f"{name} ({len(designs[name])} folds{text})" for name, text in shown.items())
        if several:
            design += "; effects chosen again in each fold"
        if len(lefts) > len(fits):
            again = _heldout(lefts.pop(), data)
            design += f", {again:.3g} {format_unit(data.model.unit)} with those found kept"
        if any(shown.values()):
            design += (
                "; a dwell counts if every model predicts it: the base model's error depends on the others"
            )
    figures = [figures_of_fit(fit, measured, left) for fit, left in zip(fits, lefts, strict=True)]
    return [*figures[:-1], replace(figures[-1], heldout_kept=again)], design


def without_folds(
    fits: Sequence[Fit], measured: Readings, checking: Readings | None
) -> tuple[list[ErrorFigures], str]:
    """Return the errors of nested models without folds: held-out errors are from check dwells only.

    The second result describes the held-out dwells. `fits` are the nested models; `measured` are the fitted
    readings with the measured noise; `checking` are the check dwells, None without any.
    """
    lefts: list[list[HeldOut]] = [[] for _ in fits]
    design = "no dwell"
    if checking is not None:
        lefts = [[residuals_on(fit, checking)] for fit in fits]
        design = f"{len(checking)} check dwells"
    return [figures_of_fit(fit, measured, left) for fit, left in zip(fits, lefts, strict=True)], design


def figures_of_fit(fit: Fit, measured: Readings, left: Sequence[HeldOut]) -> ErrorFigures:
    """Return the error figures of a fit: residual, held-out error, angle error and χ².

    `left` are its residuals on held-out dwells, `measured` the readings with the measured noise.
    """
    # χ² against the measured noise, whatever noise the fit assumed.
    chi2 = fit.chi2 if fit.data is measured else replace(fit, data=measured).settled().chi2
    return ErrorFigures(
        residual_rms=rms(fit.misfit, fit.data.by_axis),
        chi2_per_dof=chi2 / fit.dof if fit.data.noise_known and fit.dof > 0 else None,
        unit=fit.data.model.unit,
        **heldout_errors(fit.data, left),
    )


def heldout_errors(data: Readings, left: Sequence[HeldOut]) -> dict[str, Any]:
    """Return the fields of `ErrorFigures` that follow from `left`, the residuals on held-out dwells."""
    turned = [part.angle_rad for part in left if part.angle_rad is not None]
    heldout = _heldout(left, data) if left else None
    errors: dict[str, Any] = {"heldout_rms": heldout, "angle_rms_deg": rms_deg(turned)}
    if left and not data.model.freedom:  # with freedom the axes share an unknown attitude
        each = np.sqrt((np.concatenate([part.residual for part in left]) ** 2).mean(axis=0))
        errors["heldout_by_axis"] = {AXES[k]: float(value) for k, value in enumerate(each)}
    return errors


def _parameters(fit: Fit) -> int:
    return int(fit.data.visible.sum()) + sum(len(values) for values in fit.values.terms)


def leaves_too_few(fit: Fit) -> bool:
    """Return True if too few dwells would remain to choose a model when some dwells are held out.

    This is so with fewer than `limits.least_choice` dwells, or if there are fewer equations than parameters
    without one dwell.
    """
    rows = (len(fit.data) - 1) * fit.data.equations_each
    return len(fit.data) < limits.least_choice or rows < _parameters(fit)


def leave_each_out(fits: Sequence[Fit]) -> tuple[list[list[HeldOut]], str]:
    """Return the residuals of the nested models `fits` with each dwell held out alone, and a description.

    The lists are empty if the other dwells do not determine the final model.

    The other dwells are too few to choose effects, so only the values are fitted again.
    """
    data, last = fits[-1].data, fits[-1]
    singles = [np.arange(len(data)) == k for k in range(len(data))]
    columns = _parameters(last)
    if any(last.again(data.rows(~mask)).used < columns for mask in singles):
        return [[] for _ in fits], (
            f"the model has {columns} parameters, too many for the other dwells: none could be held out"
        )
    design = f"each of {len(data)} dwells in turn, effects kept: the others are too few to choose any from"
    designs = {design: singles}
    return [list(cross_validate(data, designs, fit.again).values()) for fit in fits], design


def guard_errors(selection: Selection, fits: Sequence[Fit], fold: Fold) -> list[float]:
    """Return the held-out errors of nested models that decide how many terms the final model has.

    In each fold the effects are kept and only their values are fitted.

    The list is empty if no dwell can be held out. `check` dwells are excluded, since they must not
    influence the choice. `fits` are the nested models; `fold` has the settings for a choice without each
    fold.
    """
    if leaves_too_few(selection.fit) or len(fits) == 1:
        return []
    data = selection.data
    # A formula that was found with all dwells was influenced by the held-out dwells, and so was an average.
    final = fits[-1] if fold.averaged is None else None
    models = [(fold, data, fit) for fit in (*fits[:-1], final)]
    return [_heldout(left, data) for left in held_out_alike(models, selection.terms, [-1])[0]]


def _heldout(parts: Sequence[HeldOut], data: Readings) -> float:
    """Return the root mean square of the residuals in `parts`."""
    return rms(np.concatenate([part.residual for part in parts]), data.by_axis)


def rms_deg(turned: list[Floats]) -> float | None:
    """Return the root mean square in degrees of angles in rad, modulo whole turns; None if empty.

    `turned` are arrays of such angles.
    """
    if not turned:
        return None
    return float(np.degrees(np.sqrt((wrap_radians(np.concatenate(turned)) ** 2).mean())))


def reject_unchecked(names: Names, selection: Selection) -> Names:
    """Reject all names but the bias if the model leaves too few readings to check it.

    Too few are fewer than `limits.least_checks` degrees of freedom. Such a model would fit any data. A bias
    is accepted: every sensor has one, so it needs no proof.
    """
    dof = selection.fit.dof
    if dof >= limits.least_checks:
        return names
    open_ = [name for name in names.accepted if name != "bias"]
    reasons = dict.fromkeys(open_, f"the model leaves {dof} readings to check it by: too few")
    return reject_names(names, reasons)


def reject_names(names: Names, reasons: dict[str, str]) -> Names:
    """Return the names with those in `reasons` rejected.

    Each name that was accepted is then a group of its own in `Names.confounded`.
    """
    more = tuple((name,) for name in reasons if name in names.accepted)
    accepted = tuple(name for name in names.accepted if name not in reasons)
    rejected = {**names.rejected, **reasons}
    return Names(accepted, rejected, tuple(dict.fromkeys((*names.confounded, *more))))


def longest_acceptable(errors: Sequence[float], most: int, least: int = 0) -> int:
    """Return the number of terms of the longest nested model with a held-out error that is not worse.

    Not worse means at most `limits.worse` times the error of any shorter model. `errors` are the held-out
    errors, the base model first; at least `least` and at most `most` terms are allowed. The result is
    `most` if `errors` is empty, because no dwell could be held out.
    """
    count = most
    while errors and count > least and errors[count] > limits.worse * min(errors[least : count + 1]):
        count -= 1
    return count


def harmful_functions(selection: Selection, fits: Sequence[Fit], errors: Sequence[float]) -> list[Term]:
    """Return the model's unnamed functions that make the prediction of held-out dwells worse.

    `errors` are the held-out errors of the nested `fits`, empty if no dwell could be held out.
    """
    forced = sum(term.forced for term in selection.terms)
    stay = fits[longest_acceptable(errors, len(fits) - 1, forced)]
    if stay is fits[-1]:
        return []
    return [term for term in selection.terms if term.name is None and term not in stay.terms]


def cut_worse_steps(
    names: Names,
    steps: Sequence[str],
    errors: Sequence[float],
    reported: tuple[float, float] | None,
    unit: str = "mg",
    least: int = 0,
) -> tuple[int, Names]:
    """Find the longest nested model whose held-out error is hardly larger than any shorter model's.

    Hardly larger means at most `limits.worse` times as large. `unit` is the unit of the errors in the
    reasons; the first `least` terms are always kept.

    Parameters
    ----------
    names : Names
        Names of the longest model.
    steps : sequence of str
        Name of the term that each model adds to the one before.
    errors : sequence of float
        Held-out errors of the nested models, the base model first; effects are kept in the folds. If there
        are none, nothing is cut.
    reported : tuple of 2 float, optional
        Reported errors of the base model and the longest model, which may refer to other dwells.

    Returns
    -------
    The number of steps to keep, and the names without the names of the other steps.
    """
    last = len(steps)
    if not errors:
        return last, names
    stated_worse = reported is not None and reported[1] > limits.worse * reported[0]
    count = longest_acceptable(errors, last - 1 if last > least and stated_worse else last, least)
    cut = set(steps) - set(steps[:count])
    before, after = min(errors[least : count + 1]), errors[last]
    if reported is not None and after <= limits.worse * before:
        before, after = reported
    reasons = dict.fromkeys(
        sorted(cut), f"the held-out error would go from {before:.3g} to {after:.3g} {unit} with it"
    )
    return count, reject_names(names, reasons)


def disagreement_p_value(fit: Fit, others: Readings, inflation: float = 1.0) -> float:
    """Return the p-value of the residuals of held-out dwells under a fitted model.

    `others` are the held-out dwells, `inflation` is the factor on their noise variance. The predicted
    reading has the covariance 1 + X C Xᵀ, from its noise and from the covariance C of the parameters with
    whitened columns X (Cook and Weisberg, Residuals and Influence in Regression, 1982, chapter 2). Noise
    that dwells share is treated as independent noise of each dwell.
    """
    none = others.slow[:, :, :0]
    alone = replace(others, own_covariance=others.covariance, slow=none, stage=none)
    there = fit.on(alone)
    residual = there.residual.ravel() / np.sqrt(inflation)
    carried = fit.carried(there)  # carried · carriedᵀ = X C Xᵀ
    spread = np.eye(len(carried)) + carried @ carried.T
    distance = float(residual @ np.linalg.solve(spread, residual))
    return adequacy(distance, there.equations, others.noise_dof)
