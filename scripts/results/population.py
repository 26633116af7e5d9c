"""Right and wrong names of the population trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from results.section import Effort, Section, svg

UNITS = 200


def run(effort: Effort) -> Section:
    """A hundred populations with an effect and a hundred without, and some that may mislead."""
    from population_statistics import outcomes

    units = effort.sessions(UNITS, 6)
    populations = effort.sessions(100, 1)
    return section_of(outcomes(populations, units, effort.seed, effort.jobs), units)


def section_of(every: Sequence[Any], units: int) -> Section:
    """Make the section of the outcomes."""
    document: dict[str, Any] = {"units": units, "kinds": {}, "outcomes": [asdict(one) for one in every]}
    for kind in dict.fromkeys(one.kind for one in every):
        some = [one for one in every if one.kind == kind]
        document["kinds"][kind] = {
            "populations": len(some),
            "named": sum(one.named for one in some),
            "in_set": sum(one.in_set for one in some),
            "false": sum(one.false for one in some),
            "unnamed": sum(bool(one.unnamed) for one in some),
        }
    return Section(document, {"named": _figure(every)})


def _figure(every: Sequence[Any]) -> str:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    mpl.rcParams["svg.hashsalt"] = "population"
    some = [one for one in every if one.kind == "effect"]
    names = sorted({one.truth for one in some}, reverse=True)
    alone = [sum(one.named for one in some if one.truth == n) for n in names]
    held = [sum(one.in_set and not one.named for one in some if one.truth == n) for n in names]
    missed = [sum(not one.in_set for one in some if one.truth == n) for n in names]
    figure, axis = plt.subplots(figsize=(7, 0.3 * len(names) + 1.4), layout="constrained")
    axis.barh(names, alone, label="named alone", color="#2b6cb0")
    axis.barh(names, held, left=alone, label="in a set", color="#90cdf4")
    both = [a + b for a, b in zip(alone, held, strict=True)]
    axis.barh(names, missed, left=both, label="not named", color="#e2a33a")
    axis.set_xlabel("populations")
    axis.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    text = svg(figure)
    plt.close(figure)
    return text
