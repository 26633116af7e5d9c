"""Many cycles a turn that the plan folds onto something simpler."""

import itertools
from dataclasses import replace

import numpy as np

from adis_gonio.tracing.grammar import nameless_terms
from adis_gonio.tracing.selection import select
from adis_gonio.tracing.trace import trace
from tracing.alias_sessions import (
    growing_eccentricity,
    loose_fixture,
    one_sided_eccentricity,
    worm,
)
from tracing.small_problems import noisy, turn


def names(result) -> set[str]:
    return {one.effect for one in result.found}


def test_an_eccentricity_that_grows_with_time_is_not_fifty_five_cycles():
    results = [trace(growing_eccentricity(seed)) for seed in range(4)]
    assert not any("stage_periodic" in names(result) for result in results)
    by_time = [any(one.names[0] == "unnamed: time and angle" for one in result.sets) for result in results]
    assert sum(by_time) >= 3


def test_cycles_that_equal_an_eccentricity_of_one_side_share_its_set():
    results = [trace(one_sided_eccentricity(seed)) for seed in range(3)]
    assert not any("stage_periodic" in names(result) for result in results)
    both = {"unnamed: approach and angle", "stage_periodic"}
    assert all(any(both <= set(one.names) for one in result.sets) for result in results)


def test_scatter_of_the_fixture_is_not_many_cycles():
    results = [trace(loose_fixture(seed)) for seed in range(3)]
    assert not any("stage_periodic" in names(result) for result in results)
    assert sum("fixture_scatter" in names(result) for result in results) >= 2


def test_a_worm_is_found_in_the_order_in_which_few_cycles_grow():
    for seed in range(2):
        found = {one.effect: one for one in trace(worm(seed)).found}
        assert found["stage_periodic"].probability > 0.95


def test_of_waves_with_equal_columns_the_one_of_fewest_cycles_stands_for_all() -> None:
    c = turn(10)
    for cycles, seed in itertools.product((4, 6), range(10)):
        data = noisy(c, seed)
        mean = data.mean + np.column_stack([np.sin(cycles * c.angle_rad), np.zeros(10)])
        waves = [t for t in nameless_terms(data) if t.label in ("bias[x]~sin 4θ", "bias[x]~sin 6θ")]
        selection = select(replace(data, mean=mean), waves, 1)
        assert [term.label for term in selection.terms] == ["bias[x]~sin 4θ"]
