"""What each finding explains: the fall of the excess from step to step, as the table of errors has it.

The excess of a model is its χ² beyond its degrees of freedom; where the noise is not known, the square of
its residual. Shares are of the base model's excess. They follow the steps in their order and add up to what
all of them explain together, so that they never exceed 100 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adis_gonio.fitting.estimation.fit import Fit
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.outcome.result import ErrorFigures, Finding, Unnamed


def excesses(fits: Sequence[Fit], figures: Sequence[ErrorFigures]) -> list[float]:
    """Excess of each model over the measured noise."""
    if any(figure.chi2_per_dof is None for figure in figures):
        return [figure.residual_rms**2 for figure in figures]
    return [
        fit.dof * max((figure.chi2_per_dof or 1.0) - 1.0, 0.0)
        for fit, figure in zip(fits, figures, strict=True)
    ]


def shares(steps: Sequence[str], excess: Sequence[float]) -> dict[str, float]:
    """Share of each step's name; what rises instead takes nothing away that another had explained."""
    found = dict.fromkeys(steps, 0.0)
    least = excess[0]
    for name, left in zip(steps, excess[1:], strict=True):
        fall = max(least - left, 0.0)
        least -= fall
        found[name] += fall / excess[0] if excess[0] > 0 else 0.0
    return found


def with_shares(found: Sequence[Finding], of_step: dict[str, float]) -> tuple[Finding, ...]:
    """Findings with the shares of their steps."""
    return tuple(replace(finding, explains=of_step.get(finding.effect, 0.0)) for finding in found)


def unnamed_with_share(unnamed: Unnamed | None, of_step: dict[str, float]) -> Unnamed | None:
    """What has no name with the shares of its steps; without any, at most with what the steps leave."""
    if unnamed is None:
        return None
    known = catalogue()
    nameless = [name for name in of_step if name not in known]
    if nameless:
        return replace(unnamed, explains=sum(of_step[name] for name in nameless))
    return replace(unnamed, explains=min(unnamed.explains, max(1.0 - sum(of_step.values()), 0.0)))
