"""Section: what the population trace names, and what it names falsely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from results.section import Effort, Section, svg, table

UNITS = 200


def run(effort: Effort) -> Section:
    """A hundred populations with an effect and a hundred without, and some that should mislead."""
    from population_statistics import outcomes

    units = effort.sessions(UNITS, 20)
    populations = effort.sessions(100, 1)
    return section_of(outcomes(populations, units, effort.seed, effort.jobs), units)


def section_of(every: Sequence[Any], units: int) -> Section:
    """The section of outcomes."""
    lines = [
        f"Populations of {units} sessions; an effect of half of each session's detection limit in 30 %.",
        "",
    ]
    words = {
        "effect": "with one effect",
        "none": "without any",
        "scatter": "noise unlike what is stated, random walks",
        "foreign": "an effect that the catalogue lacks",
        "gross": "one gross session",
    }
    kinds: list[Sequence[str]] = []
    document: dict[str, Any] = {"units": units, "kinds": {}, "outcomes": [asdict(one) for one in every]}
    for kind, what in words.items():
        some = [one for one in every if one.kind == kind]
        if not some:
            continue
        named, held = sum(one.named for one in some), sum(one.in_set for one in some)
        false, unnamed = sum(one.false for one in some), sum(bool(one.unnamed) for one in some)
        document["kinds"][kind] = {
            "populations": len(some), "named": named, "in_set": held, "false": false, "unnamed": unnamed
        }  # fmt: skip
        shown = (f"{named}", f"{held}") if kind == "effect" else ("", "")
        kinds.append((what, str(len(some)), *shown, str(false), str(unnamed)))
    head = ("populations", "", "named alone", "named, or in a set", "something false", "unnamed")
    lines += [*table(head, kinds), ""]
    effects: list[Sequence[str]] = []
    for name in sorted({one.truth for one in every if one.kind == "effect"}):
        some = [one for one in every if one.kind == "effect" and one.truth == name]
        answers = sorted({" or ".join(names) for one in some for names in one.found})
        alone = sum(one.named for one in some)
        held = sum(one.in_set for one in some) - alone
        effects.append((name, str(len(some)), str(alone), str(held), "; ".join(answers)))
    head = ("effect", "populations", "named alone", "in a set", "answers")
    lines += [*table(head, effects), "", "![How often each effect was named](population-named.svg)"]
    return Section("Population trace", "\n".join(lines), document, {"named": _figure(every)})


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
