"""`trace` on blind sessions: a small round of every figure of scripts/trace_statistics.py.

Files are written by one process and traced by another, which is told nothing but their paths. Most bounds
are what these very sessions miss: with so few, one more is a change to look at. Rates are the script's.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from tracing.blind import KINDS, draw
from tracing.named_truth import NAMES
from tracing.rounds import crew, rounds
from tracing.space import NAMES as SPACE_NAMES, SPACE
from tracing.undeclared import BEYOND, GRAMMAR
from tracing.verdict import Verdict

Pools = tuple[ProcessPoolExecutor, ProcessPoolExecutor]
SEED = 11
ENTRIES = ("temperature_knee", "quintic", "gain_approach", "memory_turn", "lean_time", "drift_knee")
"""One shape of the grammar for each way to enter."""


def each_name_in_two() -> list[int]:
    """Numbers of few sessions that hide every name: next is always the one that adds most."""
    hidden = {k: draw("two", SEED, k)[0].names for k in range(100)}
    left, numbers = set().union(*hidden.values()), []
    while left:
        numbers.append(max(hidden, key=lambda k: len(hidden[k] & left)))
        left -= hidden[numbers[-1]]
    return numbers


SESSIONS = {
    "none": range(3),
    "one": range(0, len(NAMES), 6),
    "uncatalogued": [list(GRAMMAR).index(name) for name in ENTRIES],
    "beyond": range(0, len(BEYOND), 5),
    SPACE + "none": range(2),
    SPACE + "one": [
        SPACE_NAMES.index(name)
        for name in ("quadratic", "scale_temperature", "supply_bias", "outlier_dwell")
    ],
    SPACE + "two": (1, 2, 20),
}
"""Numbers of the sessions; those of "two" are `each_name_in_two`, which takes a while."""


def at_least(share: float, hits: Iterable[bool]) -> bool:
    """Whether as many hit as the share asks for; one miss is allowed in any small round."""
    every = list(hits)
    return sum(every) >= min(np.floor(share * len(every)), len(every) - 1)


def missed(hits: Iterable[bool]) -> int:
    """How many did not."""
    return sum(not hit for hit in hits)


def told(verdicts: list[Verdict]) -> str:
    """What was said of each session, for a failing test."""
    return "\n" + "\n".join(f"{v.truth}: {v.claimed} wrong {v.wrong} {v.said}" for v in verdicts)


@pytest.fixture(scope="module")
def pools() -> Iterator[Pools]:
    """A process that writes and judges, and one that traces."""
    with crew(1) as both:
        yield both


@pytest.mark.parametrize("kind", KINDS)
def test_trace_names_what_is_there_and_nothing_else(kind: str, pools: Pools) -> None:
    verdicts = rounds(kind, each_name_in_two() if kind == "two" else SESSIONS[kind], SEED, pools)
    hidden = {name for v in verdicts for name in v.truth}
    assert not any(v.failure for v in verdicts), next(v.failure for v in verdicts if v.failure)
    if kind == "none":
        assert not any(v.claimed or v.unnamed for v in verdicts), told(verdicts)
    elif kind == "one":
        assert len(hidden) == len(verdicts)
        assert all(v.found for v in verdicts), told(verdicts)
        assert all(v.exact for v in verdicts), told(verdicts)
        covered = [hit for v in verdicts for _, hit, _ in v.covered]
        assert len(covered) > 3
        assert missed(covered) <= 1
    elif kind == "two":
        assert hidden == set(NAMES)
        # The sum of a power of each axis is a function, and one of two effects is not seen.
        assert missed(v.exact for v in verdicts) <= 3, told(verdicts)
        assert not any(v.wrong for v in verdicts), told(verdicts)
    else:
        # A knee in temperature is one of the supply beside creep, and a chirp is two names.
        assert missed(v.covariate for v in verdicts) <= 1, told(verdicts)
        assert all(not v.wrong for v in verdicts), told(verdicts)
    ratios = [v.heldout_ratio for v in verdicts if not np.isnan(v.heldout_ratio)]
    assert np.median(ratios) <= 1.10
    assert max(v.worse for v in verdicts) <= 1.05


@pytest.mark.parametrize("kind", ["none", "one", "two"])
def test_trace_in_space_names_what_the_norm_shows(kind: str, pools: Pools) -> None:
    """Bounds against regressions: one equation a pose tells less than two, see docs/trace.md."""
    verdicts = rounds(SPACE + kind, SESSIONS[SPACE + kind], SEED, pools)
    assert not any(v.failure for v in verdicts), next(v.failure for v in verdicts if v.failure)
    assert at_least(0.95, (not v.wrong for v in verdicts)), told(verdicts)
    if kind == "none":
        assert not any(v.claimed or v.unnamed for v in verdicts), told(verdicts)
    elif kind == "one":
        assert len({name for v in verdicts for name in v.truth}) == len(verdicts)
        assert at_least(0.90, (v.exact for v in verdicts)), told(verdicts)
    else:
        assert missed(v.exact for v in verdicts) <= 1, told(verdicts)
