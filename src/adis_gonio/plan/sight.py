"""What a plan will see, and what it will not tell apart: by the trace's own linear problem.

The detectable amplitudes are those of `trace` (`tracing.findings.detectable`), at its level, beside the
start angle, gains, Δφ and biases. Two effects are not told apart where one of them, just as large as is
detected, leaves less than `LEAST_SEPARATION` standard uncertainties beside the best imitation by the other:
the limit at which `advice` holds a measurement for worth while.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.jsonable import JsonRecord, key
from adis_gonio.base.numbers import join_words
from adis_gonio.base.uncertainty import Detectable
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.estimation.terms import NamedTerm
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.findings import detectable
from adis_gonio.tracing.linear_problem import LinearProblem, linearise, span
from adis_gonio.tracing.model_search import Search, price
from adis_gonio.tracing.named_candidates import named_terms
from adis_gonio.tracing.proposals import LEAST_SEPARATION, widest_terms


@dataclass(frozen=True)
class Alike:
    """Two effects that a plan does not tell apart.

    Attributes
    ----------
    separation : float
        Standard uncertainties by which the one, as large as is detected, stands off the other's best
        imitation; the smaller of both ways round.
    """

    one: str
    other: str
    separation: float

    def as_dict(self) -> dict[str, Any]:
        """One entry of `confounded`."""
        return {"effects": [self.one, self.other], "separation": self.separation}


@dataclass(frozen=True)
class Sight(JsonRecord):
    """What a plan sees.

    Attributes
    ----------
    detectable : dict of str to Detectable
        Of each effect of the catalogue the amplitude that would be found in 90 of 100 sessions.
    alike : tuple of Alike
        Pairs that are not told apart, the worst first.
    """

    detectable: dict[str, Detectable]
    alike: tuple[Alike, ...] = field(metadata=key("confounded"))


def sight_of(readings: Readings) -> Sight:
    """What a session with such readings will see.

    Parameters
    ----------
    readings : Readings
        Imagined, without the dwells for checking.
    """
    fit = Fit.begin(readings).refit()
    terms, missing = named_terms(readings)
    problem = linearise(fit, terms)
    found = Search(problem, price(problem))
    bias = _bias_of(problem)
    seen = detectable(found, bias, {name: _unplanned(name, why) for name, why in missing.items()})
    hidden = {name: replace(one, reason=_HIDDEN) for name, one in seen.items() if "lies in" in one.reason}
    return Sight(seen | hidden, _alike(problem, bias, seen))


def _bias_of(problem: LinearProblem) -> tuple[int, ...]:
    """The bias on all axes, which every part has and every trace finds; empty where it cannot be seen."""
    widest = widest_terms(problem.terms).get("bias")
    return () if widest is None else (problem.terms.index(widest),)


_HIDDEN = "lies in the model that every session fits, in these positions"


def _unplanned(name: str, why: str) -> str:
    needs = [need for need in catalogue("accelerometer")[name].needs if need in _SURROUNDINGS]
    if not needs:
        return why
    return f"depends on {join_words([_SURROUNDINGS[need] for need in needs])}, which no plan sets"


_SURROUNDINGS = {
    "temperature_c": "the temperature",
    "temperature_history": "its history",
    "supply_v": "the supply",
    "variance_mg2": "vibration",
}


def _alike(problem: LinearProblem, bias: tuple[int, ...], seen: dict[str, Detectable]) -> tuple[Alike, ...]:
    basis = span(problem, bias)[0]
    columns = {
        name: _columns(problem, problem.terms.index(term), basis)
        for name, term in widest_terms(problem.terms).items()
        if name != "bias" and seen[name].amplitude is not None
    }
    found = []
    for one, other in itertools.combinations(columns, 2):
        left = min(
            _separation(columns[one], columns[other], seen[one]),
            _separation(columns[other], columns[one], seen[other]),
        )
        if left < LEAST_SEPARATION:
            found.append(Alike(one, other, left))
    return tuple(sorted(found, key=lambda pair: pair.separation))


def _columns(problem: LinearProblem, term: int, basis: Floats) -> Floats:
    """Columns (rows, d) of a term by its amplitudes, whitened, beside the base model and the bias."""
    columns = problem.block(term) @ np.linalg.pinv(problem.back[term])
    return np.asarray(columns - basis @ (basis.T @ columns))


def _separation(columns: Floats, others: Floats, limit: Detectable) -> float:
    """Least distance of a detectable amplitude of any of the columns from the span of the others."""
    size = np.maximum(np.linalg.norm(others, axis=0), 1e-300)
    u, s, _ = np.linalg.svd(others / size, full_matrices=False)
    inside = u[:, s > 1e-6]
    left = np.linalg.norm(columns - inside @ (inside.T @ columns), axis=0)
    return float(left.min()) * float(limit.amplitude or 0.0)


def plain_terms(readings: Readings, names: Sequence[str]) -> tuple[NamedTerm, ...]:
    """Each named effect on all axes, as far as a plan of positions has a hand in it.

    Raises
    ------
    UsageError
        No such effect, or one that a plan of positions does not decide about.
    """
    from adis_gonio.base.errors import UsageError
    from adis_gonio.model.effects.base import did_you_mean

    terms, missing = named_terms(replace(readings, check=np.zeros(len(readings), dtype=bool)))
    offered = widest_terms(terms)
    known = sorted(name for name in offered if name not in _OF_BASE and not _remembers(offered[name]))
    for name in names:
        if name in known:
            continue
        if name not in catalogue("accelerometer"):
            near = did_you_mean(name, list(catalogue("accelerometer")))
            raise UsageError(f"beware: no effect is called '{name}'{near}")
        if name in _OF_BASE:
            why = "lies in the model that every session fits: leave it out"
        elif name in offered:
            why = "depends on all positions before, which an exchange of single ones cannot plan for"
        elif name in missing:
            why = _unplanned(name, missing[name])
        else:
            why = "acts on single dwells"
        raise UsageError(f"beware: {name} {why}; known here: {', '.join(known)}")
    return tuple(offered[name] for name in dict.fromkeys(names))


_OF_BASE = frozenset({"bias", "scale", "misalignment", "gravity"})


def _remembers(term: NamedTerm) -> bool:
    return any(need.endswith("_history") or need.startswith("previous") for need in term.effect.needs)
