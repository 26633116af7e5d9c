"""Which names of a selection survive the dwells that took no part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adis_gonio.tracing.outcome.naming import Names
from adis_gonio.tracing.outcome.sets import set_of
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.validation.gains import contradicting, held_out_gains


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


def surviving(selection: Selection, names: Names) -> tuple[Selection, Names, dict[str, str]]:
    """Take away effects that held-out dwells contradict, the worst first, each judged beside the others.

    Uncertain names go as well where dwells do not confirm them.
    """
    reasons: dict[str, str] = {}
    if len(selection.data) < limits.least_dwells:
        return selection, names, reasons
    while selection.terms:
        worst: tuple[float, str, str] | None = None
        for name in dict.fromkeys(term.shown_as for term in selection.terms):
            members = [k for k, term in enumerate(selection.terms) if term.shown_as == name]
            gains = held_out_gains(selection.fit, members, selection.inflation)
            for design, held_out in contradicting(gains).items():
                if worst is None or held_out.gain < worst[0]:
                    worst = (held_out.gain, name, design)
        if worst is None:
            break
        gain, name, design = worst
        reasons[name] = f"contradicted by dwells that took no part ({design}: χ² rises by {-gain:.1f})"
        kept = [k for k in selection.verdict.best if selection.problem.terms[k].shown_as != name]
        selection = selection.with_model(kept)
    selection, unconfirmed = _confirmed(selection, names)
    return selection, without(names, reasons), {**reasons, **unconfirmed}


def _confirmed(selection: Selection, names: Names) -> tuple[Selection, dict[str, str]]:
    """Take uncertain effects out of the model where neither the folds nor adequacy ask for them."""
    reasons: dict[str, str] = {}
    for name in names.open:
        if selection.verdict.names.get(name, 0.0) >= limits.certain or not selection.adequate:
            continue
        members = [k for k, term in enumerate(selection.terms) if term.name == name]
        if not members or set_of(selection, name).present >= limits.present:
            continue  # which name it has is open, that there is something is not
        gains = held_out_gains(selection.fit, members, selection.inflation)
        weak = [design for design, held_out in gains.items() if not held_out.confirmed]
        kept = [k for k in selection.verdict.best if selection.problem.terms[k].name != name]
        trial = selection.with_model(kept) if weak else selection
        if weak and trial.adequate:
            selection = trial
            reasons[name] = f"{names.open[name]}, and dwells that took no part do not confirm it"
    return selection, reasons


def without(names: Names, reasons: dict[str, str]) -> Names:
    """Names less those that were taken away, which stand under `confounded`."""
    more = tuple((name,) for name in reasons if name in names.stand)
    stand = tuple(name for name in names.stand if name not in reasons)
    return Names(stand, names.open, tuple(dict.fromkeys((*names.confounded, *more))))


def never_worse(
    names: Names,
    steps: Sequence[str],
    errors: Sequence[float | None],
    reported: tuple[float, float] | None,
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
    count = last
    while known[count] > limits.worse * min(known[: count + 1]) or (count == last > 0 and stated_worse):
        count -= 1
    cut = set(steps) - set(steps[:count])
    before, after = min(known[: count + 1]), known[last]
    if reported is not None and after <= limits.worse * before:
        before, after = reported
    reasons = dict.fromkeys(
        sorted(cut), f"the held-out error would go from {before:.3g} to {after:.3g} mg with it"
    )
    return count, without(names, reasons), reasons
