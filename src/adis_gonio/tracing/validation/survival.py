"""Which names of a selection survive the dwells that took no part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import Term
from adis_gonio.tracing.outcome.naming import Names
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits


def checkable(names: Names, selection: Selection) -> Names:
    """Names less those of a model that leaves too few: it would fit whatever was there.

    A bias stands: every sensor has one, and nothing need prove it against none at all.
    """
    dof = selection.fit.dof
    if dof >= limits.least_checks:
        return names
    open_ = [name for name in names.stand if name != "bias"]
    reasons = dict.fromkeys(open_, f"the model leaves {dof} readings to check it by: too few")
    return without(replace(names, open={**names.open, **reasons}), reasons)


def without(names: Names, reasons: dict[str, str]) -> Names:
    """Names less those that were taken away, which stand under `confounded`."""
    more = tuple((name,) for name in reasons if name in names.stand)
    stand = tuple(name for name in names.stand if name not in reasons)
    return Names(stand, names.open, tuple(dict.fromkeys((*names.confounded, *more))))


def longest(errors: Sequence[float | None], most: int) -> int:
    """Steps, up to `most`, of the longest nested model whose error is hardly above any shorter one's."""
    known = [error for error in errors if error is not None]
    if len(known) < len(errors):
        return most
    count = most
    while known[count] > limits.worse * min(known[: count + 1]):
        count -= 1
    return count


def refuted(selection: Selection, fits: Sequence[Fit], errors: Sequence[float | None]) -> list[Term]:
    """Functions without a name that the left-out dwells speak against."""
    stay = fits[longest(errors, len(fits) - 1)]
    if stay is fits[-1]:
        return []
    return [term for term in selection.terms if term.name is None and term not in stay.terms]


def never_worse(
    names: Names,
    steps: Sequence[str],
    errors: Sequence[float | None],
    reported: tuple[float, float] | None,
    unit: str = "mg",
) -> tuple[int, Names, dict[str, str]]:
    """Longest nested model whose held-out error is hardly above that of any shorter one.

    Parameters
    ----------
    steps : sequence of str
        What each model has beyond the one before.
    errors : sequence of float or None
        Held-out errors of the nested models, the base model first; effects are kept in the folds.
    reported : tuple of 2 float, optional
        What stands in the result for the base model and for the longest one, which may be of other dwells.

    Returns
    -------
    The number of steps that are kept, the names that are left, and the reasons of the others.
    """
    last = len(steps)
    known = [error for error in errors if error is not None]
    if len(known) < len(errors):
        return last, names, {}
    stated_worse = reported is not None and reported[1] > limits.worse * reported[0]
    count = longest(known, last - 1 if last > 0 and stated_worse else last)
    cut = set(steps) - set(steps[:count])
    before, after = min(known[: count + 1]), known[last]
    if reported is not None and after <= limits.worse * before:
        before, after = reported
    reasons = dict.fromkeys(
        sorted(cut), f"the held-out error would go from {before:.3g} to {after:.3g} {unit} with it"
    )
    return count, without(names, reasons), reasons
