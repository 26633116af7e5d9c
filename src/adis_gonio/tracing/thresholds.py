"""The tuned numbers of the trace, each with its origin, in one table.

`limits` holds them. `python scripts/trace_ablation.py` switches off each one that is a rule, on blind
sessions, and prints what changes; docs/thresholds.md is written from here and from its figures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from adis_gonio.base.uncertainty import CREDIBLE_SET, INADEQUATE

Origin = Literal["level", "derived", "physical", "measured", "chosen", "effort"]
"""A level is what is promised (1 %, 95 %). Derived: from mathematics, as said. Physical: no part or bench
is beyond. Measured: by a script. Chosen: judgement. Effort: more of it finds the same, slower."""


def number(value: float, origin: Origin, why: str, off: float | None = None) -> Any:
    """A field of the table; `off` is the value at which its rule never acts, none where it is no rule."""
    return field(default=value, metadata={"origin": origin, "why": why, "off": off})


INFINITE = float("inf")


@dataclass
class Limits:
    """Every number of the trace that is not arithmetic; see the table's columns in docs/thresholds.md."""

    # Prior
    effect_share: float = number(
        0.0175,
        "measured",
        "prior share of an effect, or of scatter, whatever else can show (scripts/trace_level.py)",
    )
    nameless_share: float = number(0.3, "chosen", "prior share of all functions without a name together")
    bias_weight: float = number(
        6.0, "chosen", "prior weight of a bias against another effect: every sensor has one"
    )
    quadratic_weight: float = number(
        1.5,
        "chosen",
        "prior weight of a curvature: of two names that cannot be told apart the more common stands",
    )
    g_weight: float = number(
        4.0,
        "chosen",
        "prior weight of a g-sensitivity: it and a drift stand level where force follows time",
    )
    family_weight: float = number(
        0.7,
        "chosen",
        "prior weight of supply, approach, memory and products against angle, reading, time, temperature",
    )
    smooth_weight: float = number(0.25, "chosen", "part of a covariate's prior that its polynomials have")
    pair_weight: float = number(0.3, "chosen", "prior weight of a process in two covariates against one")
    prior_snr: float = number(4.0, "chosen", "prior standard deviation of an effect, in u of a reading")

    # What a session can show
    independent: float = number(
        1e-4,
        "derived",
        "least squared part of a column beside a model: below, terms of second order differ as much",
    )
    same_prediction: float = number(
        0.3, "derived", "models that differ by less in χ², half a u altogether, are one model", off=0.0
    )
    least_range_c: float = number(
        0.5, "physical", "least range of temperature in a product: below it is noise", off=0.0
    )
    least_range_v: float = number(0.01, "physical", "the same of the supply", off=0.0)
    most_cycles: int = number(72, "physical", "most cycles a turn that are looked for: a worm of 72 teeth")

    # Choice
    adequate: float = number(INADEQUATE, "level", "level of the test of adequacy")
    certain: float = number(
        0.55, "chosen", "posterior from which a cause, or its name, is called found", off=0.0
    )
    told: float = number(
        2.0, "level", "standard uncertainties by which a value differs from zero (95 %)", off=0.0
    )
    mostly_bias: float = number(
        0.97,
        "chosen",
        "share of the excess from which a bias is taken out first: five times what varies",
        off=1.0,
    )
    scatter_checks: float = number(
        6, "derived", "least degrees of freedom: a standard deviation is known to a third", off=1
    )

    # Left-out dwells
    folds: int = number(5, "chosen", "folds of whole dwells")
    blocks: int = number(4, "chosen", "blocks of time")
    alone: int = number(
        16, "chosen", "dwells up to which each is left out alone: a fifth less is another session"
    )
    repeated_deg: float = number(2.0, "physical", "dwells nearer than this are in one position")
    predicted: float = number(
        4.0, "chosen", "largest variance of a prediction, in noise, that is one", off=INFINITE
    )
    least_choice: int = number(9, "chosen", "least dwells for choosing anew without some of them", off=0)
    least_checks: int = number(2, "chosen", "least degrees of freedom left for any name but bias", off=0)
    worse: float = number(1.05, "chosen", "largest growth of the left-out error by an effect", off=INFINITE)

    # What is said
    near: float = number(
        0.15, "chosen", "share of the best model's posterior from which a rival is named", off=INFINITE
    )
    sure: float = number(0.9, "chosen", "posterior of a name above which a rival without it is not named")
    set_level: float = number(CREDIBLE_SET, "level", "probability of a credible set")
    open_level: float = number(0.1, "level", "F-test of what could explain an inadequate model's rest")
    open_alike: float = number(10.0, "chosen", "likelihood ratio up to which other names are as good there")
    visible: float = number(
        0.05, "chosen", "least part of a formula beside base and names, for it to be averaged", off=0.0
    )

    # Effort
    scatter_ratio: float = number(0.5, "effort", "least scatter in u of a reading: less changes no weight")
    rounds: int = number(4, "effort", "rounds of choosing and refitting")
    fold_rounds: int = number(2, "effort", "the same inside a fold and under scatter")
    beam: int = number(30, "effort", "models of each size that are extended; of one term twice as many")
    fold_beam: int = number(6, "effort", "the same inside a fold")
    scatter_beam: int = number(12, "effort", "the same under scatter")
    scored: int = number(60, "effort", "least extensions of a model that are scored")
    window: float = number(9.0, "effort", "nats below the best down to which all extensions are scored")
    behind: float = number(2.0, "effort", "nats by which what a model may become is below the best")
    exchanged: int = number(6, "effort", "best models whose neighbours are extended")
    exchanges: int = number(6, "effort", "how often, while that finds a better one")
    widest: int = number(6, "effort", "models of each size that every term extends")
    names_only: int = number(3, "effort", "one model in so many of the beam has names only", off=1000000)
    active: int = number(250, "effort", "nameless terms that extend the rest of the beam")
    compared: int = number(100, "effort", "models that are compared with one another")
    weighed: float = number(7.0, "effort", "nats below the best down to which models are weighed")
    voting: float = number(12.0, "effort", "the same for models that vote for the names of a set")
    averaged: float = number(6.0, "effort", "the same for formulas in the average")
    counted: float = number(0.01, "effort", "least weight of a member of the average")
    promising: int = number(40, "effort", "processes that are tried again inside a fold")
    fold_active: int = number(150, "effort", "candidates that are tried again in a fold and under scatter")
    grid: int = number(9, "effort", "values of a time constant")


limits = Limits()
"""The numbers in use."""
