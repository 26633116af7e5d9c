"""The tuned numbers of the trace, each with its origin, in one table.

They are the fields of `limits`. `python scripts/trace_ablation.py` switches off each number that is a
rule, on blind sessions, and prints the changes. docs/testing.md reports the changes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from adis_gonio.base.uncertainty import CREDIBLE_SET, INADEQUATE

Origin = Literal["level", "derived", "physical", "measured", "chosen", "effort"]
"""Origin of a number.
A level is a promise (1 %, 95 %). Derived: follows from mathematics. Physical: a limit of parts or benches.
Measured: by a script. Chosen: by judgement. Effort: a larger value gives equal results, but more slowly."""


def number(value: float, origin: Origin, why: str, off: float | None = None) -> Any:
    """Return a field of `Limits` with its default value, origin and reason.

    The value `off` disables the rule that uses the number; None if there is no rule.
    """
    return field(default=value, metadata={"origin": origin, "why": why, "off": off})


INFINITE = float("inf")


@dataclass
class Limits:
    """The thresholds and weights of the trace; `scripts/trace_ablation.py --numbers` lists them."""

    # Prior
    effect_share: float = number(0.0175, "measured", "prior share of an effect (scripts/trace_level.py)")
    nameless_share: float = number(0.3, "chosen", "prior share of all unnamed functions together")
    bias_share: float = number(0.9, "physical", "prior share of a bias of all axes: every part has one")
    bias_weight: float = number(6.0, "chosen", "prior weight of a bias of some axes, and in a fleet")
    quadratic_weight: float = number(1.5, "chosen", "prior weight of a curvature, a common effect")
    g_weight: float = number(4.0, "chosen", "prior weight of a g-sensitivity, as common as a drift")
    family_weight: float = number(0.7, "chosen", "prior weight of supply, approach, memory and products")
    smooth_weight: float = number(0.25, "chosen", "polynomials' part of a covariate's prior")
    own_weight: float = number(
        0.1, "chosen", "prior weight of an effect without time that differs by session"
    )
    pair_weight: float = number(0.3, "chosen", "prior weight of a process in two covariates")
    prior_snr: float = number(4.0, "chosen", "prior standard deviation of an effect, in u of a reading")

    # Visibility
    independent: float = number(1e-4, "derived", "least squared part of a column outside a model")
    same_prediction: float = number(
        0.3, "derived", "difference in χ² below which models are equivalent", off=0.0
    )
    least_range_c: float = number(0.5, "physical", "least temperature range in a product", off=0.0)
    least_range_v: float = number(0.01, "physical", "least supply range in a product", off=0.0)
    most_cycles: int = number(72, "physical", "most cycles a turn of a candidate: a worm gear of 72 teeth")

    # Choice
    adequate: float = number(INADEQUATE, "level", "level of the test of adequacy")
    certain: float = number(0.55, "chosen", "posterior above which a cause is accepted", off=0.0)
    significance: float = number(2.0, "level", "u by which a value differs from zero (95 %)", off=0.0)
    mostly_bias: float = number(0.97, "chosen", "share of the excess for which a bias goes first", off=1.0)
    scatter_checks: float = number(6, "derived", "least dof: a standard deviation known to a third", off=1)

    # Held-out dwells
    folds: int = number(5, "chosen", "folds of whole dwells")
    blocks: int = number(4, "chosen", "blocks of time")
    alone: int = number(16, "chosen", "dwells up to which each is held out alone")
    repeated_deg: float = number(2.0, "physical", "dwells nearer than this share one position")
    predicted: float = number(
        4.0, "chosen", "largest variance of a valid prediction, in noise", off=INFINITE
    )
    least_choice: int = number(9, "chosen", "least dwells for a new choice without some of them", off=0)
    least_checks: int = number(2, "chosen", "least degrees of freedom for any name but bias", off=0)
    worse: float = number(1.05, "chosen", "largest growth of the held-out error by an effect", off=INFINITE)

    # Report
    near: float = number(
        0.15, "chosen", "share of the best posterior from which a rival is listed", off=INFINITE
    )
    sure: float = number(0.9, "chosen", "posterior of a name above which rivals without it are not listed")
    set_level: float = number(CREDIBLE_SET, "level", "probability of a credible set")
    open_level: float = number(0.1, "level", "level of the F-test on an inadequate model's residual")
    open_alike: float = number(10.0, "chosen", "likelihood ratio below which other names are listed too")
    visible: float = number(0.05, "chosen", "least part of a formula outside base and names", off=0.0)

    # Effort
    scatter_ratio: float = number(0.5, "effort", "least scatter in u of a reading: less changes no weight")
    rounds: int = number(4, "effort", "rounds of choosing and refitting")
    explored: int = number(6, "effort", "best models whose neighbours are all scored")
    fold_explored: int = number(1, "effort", "the same inside a fold and with scatter")
    openings: int = number(300, "effort", "extensions by every term, after which only the best is explored")
    starts: int = number(60, "effort", "best single terms that are extended by every term")
    fold_starts: int = number(12, "effort", "the same inside a fold and with scatter")
    fold_rounds: int = number(2, "effort", "rounds inside a fold and with scatter")
    scored: int = number(60, "effort", "least number of extensions of a model that are scored")
    window: float = number(9.0, "effort", "nats below the best within which all extensions are scored")
    compared: int = number(100, "effort", "models that are compared with each other")
    weighed: float = number(7.0, "effort", "nats below the best within which models are weighed")
    voting: float = number(12.0, "effort", "nats below the best for models that vote on names")
    averaged: float = number(6.0, "effort", "nats below the best for formulas in the average")
    counted: float = number(0.01, "effort", "least weight of a member of the average")
    promising: int = number(40, "effort", "processes that are tried again inside a fold")
    fold_active: int = number(150, "effort", "candidates tried again inside a fold and with scatter")
    grid: int = number(9, "effort", "grid values of a time constant")
    paired: int = number(2500, "effort", "most columns of a joint trace in which pairs of names are scored")
    screened: int = number(300, "effort", "candidates of a joint trace after screening")


limits = Limits()
"""The thresholds and weights that the trace uses."""
