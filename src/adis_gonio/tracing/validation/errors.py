"""Errors of nested models, on the dwells that were fitted and on dwells that took no part."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.model.effects import AXES
from adis_gonio.tracing.outcome.result import ErrorFigures
from adis_gonio.tracing.selection.design import span
from adis_gonio.tracing.selection.select import Selection, select
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import Averaged, average
from adis_gonio.tracing.validation.leaving_out import (
    Chosen,
    Left,
    counted,
    counting,
    cross_validate,
    folds,
    leave,
    less_unknown,
    rms,
)


@dataclass(frozen=True)
class Fold:
    """What is done anew where dwells are left out.

    Attributes
    ----------
    terms : sequence of Term
        Candidates inside a fold.
    averaged : Averaged or None
        The average on all dwells.
    max_effects : int
    """

    terms: Sequence[Term]
    averaged: Averaged | None
    max_effects: int
    _made: dict[tuple[int, str], tuple[Fit | None, Left]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def of(
        cls, selection: Selection, terms: Sequence[Term], averaged: Averaged | None, max_effects: int
    ) -> Fold:
        """Candidates are those that showed promise (`Selection.promising`)."""
        return cls(selection.promising(terms), averaged, max_effects)

    def left_out(
        self, data: Readings, designs: Mapping[str, list[NDArray[np.bool_]]], fit: Fit | None = None
    ) -> dict[str, Left]:
        """Residuals of readings under each design, made once for the guard and for the figures.

        Parameters
        ----------
        fit : Fit, optional
            Whose effects are kept in every fold; by default they are chosen anew.
        """
        fresh = {name: masks for name, masks in designs.items() if (id(fit), name) not in self._made}
        made = cross_validate(data, fresh, self.chosen_anew if fit is None else _keeping(fit))
        self._made.update({(id(fit), name): (fit, left) for name, left in made.items()})
        return {name: self._made[id(fit), name][1] for name in designs}

    def chosen_anew(self, rows: Readings) -> Chosen:
        """Fit of the dwells that are kept, with everything chosen from them alone."""
        chosen = select(
            rows, self.terms, self.max_effects, beam=limits.fold_beam, rounds=limits.fold_rounds
        )
        if self.averaged is not None:
            again = average(chosen, self.averaged.candidates)
            if again is not None:
                return Chosen(again.fit, by=chosen.fit)
        return Chosen(chosen.fit, by=chosen.fit)


def in_order(selection: Selection, averaged: Averaged | None) -> tuple[list[Fit], list[str]]:
    """Fits of nested models, the term of the largest gain first, and the words for each step."""
    left = list(selection.verdict.best)
    model: list[int] = []
    values = {t.label: v for t, v in zip(selection.terms, selection.fit.values.terms, strict=True)}
    fits, steps = [selection.base], []
    while left:
        chi2 = {k: float((span(selection.problem, [*model, k])[1] ** 2).sum()) for k in left}
        best = min(chi2, key=lambda k: chi2[k])
        model.append(best)
        left.remove(best)
        terms = [selection.problem.terms[k] for k in model]
        steps.append(terms[-1].shown_as)
        fits.append(selection.base.having(terms, [values[term.label] for term in terms]).refit())
    if averaged is not None:
        if len(averaged.named) == len(selection.terms):
            steps.append(averaged.fit.terms[-1].shown_as)
            fits.append(averaged.fit)
        else:
            fits[-1] = averaged.fit
    return fits, steps


def error_figures(
    selection: Selection,
    measured: Readings,
    checking: Readings | None,
    fits: Sequence[Fit],
    fold: Fold,
) -> tuple[list[ErrorFigures], str]:
    """Error figures of nested models, and how dwells were left out.

    Parameters
    ----------
    measured : Readings
        Those that were fitted, with the noise that was measured.
    """
    data = selection.data
    if checking is not None:
        return without_folds(fits, measured, checking)
    again: float | None = None
    if _few(fits[-1]):
        lefts, design = _of_few(fits)
    else:
        designs = folds(data)
        counts = counting(data, designs, selection.terms)
        anew = fold.left_out(data, designs) if len(fits) > 1 else {}
        counts = less_unknown(counts, anew) if anew else counts
        designs = {name: designs[name] for name in counts}
        design = "; ".join(f"{name} ({len(masks)} folds)" for name, masks in designs.items())
        kept = fits[:-1] if len(fits) > 1 else fits
        lefts = [counted(fold.left_out(data, designs, fit), counts) for fit in kept]
        if len(fits) > 1:
            lefts.append(counted(anew, counts))
            design += "; effects chosen anew in each fold"
            if fold.averaged is None:
                parts = counted(fold.left_out(data, designs, fits[-1]), counts)
                again = rms(np.concatenate([part.residual for part in parts]), data.by_axis)
                design += f", {again:.3g} {data.model.unit} with those found kept"
    figures = [_figures(fit, measured, left) for fit, left in zip(fits, lefts, strict=True)]
    return [*figures[:-1], replace(figures[-1], heldout_kept=again)], design


def without_folds(
    fits: Sequence[Fit], measured: Readings, checking: Readings | None
) -> tuple[list[ErrorFigures], str]:
    """The same by check dwells alone: without any, and without time for folds, nothing is left out."""
    lefts: list[list[Left]] = [[] for _ in fits]
    design = "no dwell"
    if checking is not None:
        lefts = [[leave(fit, checking)] for fit in fits]
        design = f"{len(checking)} check dwells"
    return [_figures(fit, measured, left) for fit, left in zip(fits, lefts, strict=True)], design


def _figures(fit: Fit, measured: Readings, left: Sequence[Left]) -> ErrorFigures:
    residual = [part.residual for part in left]
    turned = [part.angle_rad for part in left if part.angle_rad is not None]
    chi2 = fit.chi2 if fit.data is measured else chi2_of_measured(fit, measured)
    return ErrorFigures(
        residual_rms=rms(fit.misfit, fit.data.by_axis),
        heldout_rms=rms(np.concatenate(residual), fit.data.by_axis) if residual else None,
        angle_rms_deg=_rms_deg(turned),
        chi2_per_dof=chi2 / fit.dof if fit.data.noise_known and fit.dof > 0 else None,
        heldout_by_axis=_by_axis(fit.data, residual),
        unit=fit.data.model.unit,
    )


def _by_axis(data: Readings, residual: Sequence[Floats]) -> dict[str, float] | None:
    """Held-out error of each axis, where no attitude joins them."""
    if data.model.freedom or not residual:
        return None
    each = np.sqrt((np.concatenate(residual) ** 2).mean(axis=0))
    return {AXES[k]: float(value) for k, value in enumerate(each)}


def _keeping(fit: Fit) -> Callable[[Readings], Chosen]:
    def kept(rows: Readings) -> Chosen:
        again = fit.again(rows)
        return Chosen(again, by=again)

    return kept


def _parameters(fit: Fit) -> int:
    return int(fit.data.visible.sum()) + sum(len(values) for values in fit.values.terms)


def _few(fit: Fit) -> bool:
    """True where no dwell can be left out of the selection: few, or the others do not fix the model."""
    rows = (len(fit.data) - 1) * fit.data.equations_each
    return len(fit.data) < limits.least_choice or rows < _parameters(fit)


def _of_few(fits: Sequence[Fit]) -> tuple[list[list[Left]], str]:
    """Each dwell left out alone with the effects kept, where the others determine the final model.

    The others are too few to choose effects from: only the values are fitted anew.
    """
    data, last = fits[-1].data, fits[-1]
    singles = [np.arange(len(data)) == k for k in range(len(data))]
    columns = _parameters(last)
    if any(last.again(data.rows(~mask)).used < columns for mask in singles):
        return [[] for _ in fits], (
            f"the model has {columns} parameters: {len(data) - 1} dwells do not determine it, so that none "
            "could be left out"
        )
    design = f"each of {len(data)} dwells in turn, effects kept: the others are too few to choose any from"
    designs = {design: singles}
    every = {design: np.ones(len(data), dtype=bool)}
    return [counted(cross_validate(data, designs, _keeping(fit)), every) for fit in fits], design


def guarding(selection: Selection, fits: Sequence[Fit], fold: Fold) -> list[float | None]:
    """Held-out errors of nested models by which the final one is chosen, effects kept in each fold.

    `check` dwells take no part: they must not choose.
    """
    if _few(selection.fit) or len(fits) == 1:
        return [None for _ in fits]
    data = selection.data
    out: list[float | None] = []
    designs = folds(data)
    counts = counting(data, designs, selection.terms)
    # A form that was found on all dwells knows those that are left out; an average more so.
    final = fits[-1] if fold.averaged is None else None
    lefts = [fold.left_out(data, designs, fit) for fit in (*fits[:-1], final)]
    counts = less_unknown(counts, lefts[-1])
    for left in lefts:
        parts = counted(left, counts)
        out.append(rms(np.concatenate([part.residual for part in parts]), data.by_axis))
    return out


def chi2_of_measured(fit: Fit, measured: Readings) -> float:
    """χ² of a fit against the noise that was measured, whatever was assumed in it."""
    return replace(fit, data=measured).settled().chi2


def _rms_deg(turned: list[Floats]) -> float | None:
    if not turned:
        return None
    return float(np.degrees(np.sqrt((wrap_radians(np.concatenate(turned)) ** 2).mean())))
