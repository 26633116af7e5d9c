"""What follows the clock of a session, taken at its middle.

At the start a bias trades with a drift and with the amplitude of a warm-up, whose sum the readings show far
better than either; at the middle their sum is as well known as the readings there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.fitting.estimation.terms import NamedTerm, Term
from adis_gonio.model.effects import AXES, Conditions
from adis_gonio.tracing.outcome.result import Finding
from adis_gonio.tracing.selection.select import Selection
from adis_gonio.tracing.unnamed.averaging import AveragedTerm


def follows_clock(term: Term) -> bool:
    """True for what follows the time since the session began and nothing else."""
    if isinstance(term, AveragedTerm):  # its members may follow more than the first of them
        return all(follows_clock(member) for _, member, _ in term.members)
    needs = term.effect.needs if isinstance(term, NamedTerm) else ()
    return term.covariates == ("time",) and not needs


def middle_s(fit: Fit) -> float:
    """Time half-way between the first and the last dwell of a fit, in s since the session began."""
    time_s = fit.data.conditions.time_s
    return float(time_s.min() + time_s.max()) / 2


def clock_at_middle(fit: Fit, ideal: Floats, *, turned: bool = False) -> tuple[Floats, Floats]:
    """What follows the clock adds to a reading at the middle of the session.

    Parameters
    ----------
    ideal : (axes,) float
        What the axes should read.
    turned : bool
        True for what is added to the angle instead, in rad.

    Returns
    -------
    added : (axes,) or () float
    gradient : (axes, p) or (p,) float
        By all parameters of the fit.
    """
    middle = Conditions(time_s=np.array([middle_s(fit)]))
    added = np.zeros(() if turned else ideal.shape)
    gradient = np.zeros((*added.shape, len(fit.values.parameters)))
    for index, (term, own) in enumerate(zip(fit.terms, fit.values.terms, strict=True)):
        if follows_clock(term) and term.enters_angle == turned:
            added = added + term.added(own, ideal[None], middle)[0]
            gradient[..., fit.slice_of(index)] += term.derivative(own, ideal[None], middle)[0]
    return added, gradient


def bias_at_middle(selection: Selection, finding: Finding) -> Finding:
    """A bias with its values at the middle of the session, and their u; any other finding as it is."""
    if finding.effect != "bias":
        return finding
    fit = selection.fit
    added, slopes = clock_at_middle(fit, np.zeros(fit.data.axes))
    if not slopes.any() and not added.any():
        return finding
    stated = dict(finding.parameters)
    for index, term in enumerate(fit.terms):
        if not isinstance(term, NamedTerm) or term.name != "bias":
            continue
        places = range(fit.slice_of(index).start, fit.slice_of(index).stop)
        for place, letter in zip(places, term.effect.axes, strict=True):
            axis = AXES.index(letter)
            slope = slopes[axis].copy()
            slope[place] += 1.0
            u = float(np.sqrt(slope @ fit.covariance @ slope * selection.inflation))
            value = float(fit.values.parameters[place] + added[axis])
            stated[f"bias_{letter}"] = replace(finding.parameters[f"bias_{letter}"], value=value, u=u)
    return replace(finding, parameters=stated)
