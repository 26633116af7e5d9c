"""Candidates of a population: causes on some axes, each with its share of the prior."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from adis_gonio.fleet.population.columns import Column
from adis_gonio.model.effects import catalogue
from adis_gonio.tracing.thresholds import limits


@dataclass(frozen=True)
class Candidate:
    """A cause on some axes.

    Attributes
    ----------
    cause : str
        Name of the catalogue, or what a function without a name depends on.
    named : bool
    variant : str
        As in `Column`.
    axes : str
        Letters; empty for the stage.
    index : tuple of int
        Its columns among those of the population.
    log_prior : float
    """

    cause: str
    named: bool
    variant: str
    axes: str
    index: tuple[int, ...]
    log_prior: float

    @property
    def kind(self) -> tuple[str, bool]:
        """Cause, and whether it is a name."""
        return self.cause, self.named


def candidates_of(columns: Sequence[Column]) -> list[Candidate]:
    """Every cause on each axis and on all; prior shares as in the trace of one session.

    A name's share is divided evenly among its variants, among numbers of cycles by 1/n.
    """
    by_kind: dict[tuple[str, bool], list[int]] = defaultdict(list)
    for k, column in enumerate(columns):
        by_kind[column.cause, column.named].append(k)
    named = [kind for kind in by_kind if kind[1]]
    weight = {kind: limits.quadratic_weight if kind[0] == "quadratic" else 1.0 for kind in named}
    out = []
    for kind, index in by_kind.items():
        if kind[1]:
            share = (1 - limits.nameless_share) * weight[kind] / sum(weight.values())
        else:
            share = limits.nameless_share / (len(by_kind) - len(named))
        blocks = list(_blocks(kind[0] if kind[1] else "", index, columns))
        parts = [_part(variant) for variant, _, _ in blocks]
        for (variant, axes, own), part in zip(blocks, parts, strict=True):
            out.append(Candidate(*kind, variant, axes, own, math.log(share * part / sum(parts))))
    return out


def _part(variant: str) -> float:
    return 1 / int(variant.removeprefix("cycles=")) if variant.startswith("cycles=") else 1.0


def _blocks(
    name: str, index: Sequence[int], columns: Sequence[Column]
) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Variant, axes and columns of each candidate of a cause."""
    variants: dict[str, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for k in index:
        variants[columns[k].variant][columns[k].axes].append(k)
    alone = bool(name) and catalogue()[name].one_axis
    below: dict[str, list[int]] = defaultdict(list)
    for variant in sorted(variants):
        by_axis = variants[variant]
        if variant.startswith("degree="):  # a polynomial holds its lower powers
            for letter, own in by_axis.items():
                below[letter] += own
            by_axis = {letter: list(below[letter]) for letter in by_axis}
        for letter, own in by_axis.items():
            yield variant, letter, tuple(own)
        if len(by_axis) > 1 and not alone:
            yield variant, "".join(sorted(by_axis)), tuple(itertools.chain(*by_axis.values()))
