"""Which names of the chosen model stand, and what they are confounded with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adis_gonio.fitting.estimation.terms import NamelessTerm, Term
from adis_gonio.tracing.selection.posterior import skeleton
from adis_gonio.tracing.selection.search import Model
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.thresholds import limits
from adis_gonio.tracing.unnamed.averaging import Averaged

SLOW = {"time", "order", "temperature", "temperature_rate", "supply", "variance"}
"""Covariates that move on from dwell to dwell; the others follow the position."""


@dataclass(frozen=True)
class Names:
    """Names of the chosen model.

    Attributes
    ----------
    stand : tuple of str
        Names that are found.
    open : mapping of str to str
        Names that are not, with the reason.
    confounded : tuple of tuple of str
    """

    stand: tuple[str, ...]
    open: dict[str, str]
    confounded: tuple[tuple[str, ...], ...]


def judge(selection: Selection, averaged: Averaged | None = None) -> Names:
    """Names that stand.

    A name stands if the models that hold it have most of the posterior (`certain`), and no nameless term of
    the same kind of covariate (slow or of position) stands in the same model: that name may be a piece of
    the unknown cause.

    Parameters
    ----------
    averaged : Averaged, optional
        What stands beside the names of a model without nameless terms.
    """
    verdict, terms = selection.verdict, selection.problem.terms
    model = [terms[k] for k in verdict.best]
    unknown = unknown_of(selection, averaged)
    stand: list[str] = []
    pending: dict[str, str] = {}
    confounded: list[tuple[str, ...]] = []
    for name in dict.fromkeys(term.name for term in model if term.name is not None):
        mine = [term for term in model if term.name == name]
        beside = [u for u in unknown if any(related(term, u) for term in mine)]
        probability = verdict.names.get(name, 0.0)
        if probability < limits.certain:
            pending[name] = f"models without it have {1 - probability:.0%} of the posterior"
        elif beside:
            pending[name] = "may be a piece of the same unnamed cause"
            confounded.append((name, *(u.shown_as for u in beside)))
        else:
            stand.append(name)
    confounded += _replacements(selection)
    return Names(tuple(stand), pending, tuple(dict.fromkeys(confounded)))


def unknown_of(selection: Selection, averaged: Averaged | None) -> list[NamelessTerm]:
    """Functions without a name beside which names are judged: the model's own, else what is averaged."""
    terms = [selection.problem.terms[k] for k in selection.verdict.best]
    own = [term for term in terms if isinstance(term, NamelessTerm)]
    return own if own or averaged is None else [averaged.smooth]


def related(term: Term, unknown: Term) -> bool:
    """True where a named and a nameless term may be pieces of one cause."""
    if not term.covariates:
        return False
    if term.dwell is not None:
        return True  # one dwell may be a piece of anything
    return bool(_kinds(term.covariates) & _kinds(unknown.covariates))


def _kinds(covariates: Sequence[str]) -> set[bool]:
    return {covariate in SLOW for covariate in covariates}


def _replacements(selection: Selection) -> list[tuple[str, ...]]:
    """What takes the place of names in models near the best, and in models that predict the same."""
    verdict = selection.verdict
    best = verdict.best
    top = verdict.weights[best]
    out: list[tuple[str, ...]] = []
    rivals = [m for m, w in verdict.weights.items() if m != best and w >= limits.near * top]
    rivals += [m for m in verdict.same.get(best, []) if len(m) <= len(best)]
    for rival in sorted(rivals, key=lambda m: -selection.found.scores[m]):
        if skeleton(selection.found, rival) == skeleton(selection.found, best):
            continue
        ours, theirs = _parts(selection, best), _parts(selection, rival)
        lost = [p for p in ours if p not in theirs]
        gained = [p for p in theirs if p not in ours]
        named = any(part.name is not None for part in (*lost, *gained))
        sure = all(verdict.names.get(p.name, 0.0) > limits.sure for p in lost if p.name is not None)
        same = rival in verdict.same.get(best, [])
        if lost and gained and named and (same or not sure):
            out.append(tuple(part.shown_as for part in (*lost, *gained)))
        if len(out) >= 5:
            break
    return out


@dataclass(frozen=True)
class _Part:
    """Name of an effect, or a nameless function, whatever its axes."""

    name: str | None
    shown_as: str


def _parts(selection: Selection, model: Model) -> list[_Part]:
    terms = (selection.problem.terms[k] for k in model)
    return list(dict.fromkeys(_Part(term.name, term.shown_as) for term in terms))
