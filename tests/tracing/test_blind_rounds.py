"""`trace` on blind sessions: a fixed-seed round of every figure of scripts/trace_statistics.py.

Files are written by one process and traced by another, which is told nothing but their paths.
"""

from collections.abc import Iterable

import numpy as np
import pytest

from tracing.blind import KINDS
from tracing.named_truth import NAMES
from tracing.rounds import crew, rounds
from tracing.space import BEYOND_TERMS, FOREIGN_TERMS, SPACE
from tracing.space import NAMES as SPACE_NAMES
from tracing.undeclared import BEYOND, GRAMMAR
from tracing.verdict import Verdict

SEED = 11
COUNTS = {
    "none": 24,
    "one": 2 * len(NAMES),
    "two": 100,
    "uncatalogued": len(GRAMMAR),
    "beyond": len(BEYOND),
}


def at_least(share: float, hits: Iterable[bool]) -> bool:
    """Whether as many hit as the share asks for; one miss is allowed in any small round."""
    every = list(hits)
    return sum(every) >= min(np.floor(share * len(every)), len(every) - 1)


def told(verdicts: list[Verdict]) -> str:
    """What was said of each session, for a failing test."""
    return "\n" + "\n".join(f"{v.truth}: {v.claimed} wrong {v.wrong} {v.said}" for v in verdicts)


@pytest.mark.parametrize("kind", KINDS)
def test_trace_names_what_is_there_and_nothing_else(kind: str) -> None:
    with crew(1) as pools:
        verdicts = rounds(kind, range(COUNTS[kind]), SEED, pools)
    assert not any(v.failure for v in verdicts), next(v.failure for v in verdicts if v.failure)
    if kind == "none":
        assert at_least(0.99, (not v.claimed and not v.unnamed for v in verdicts)), told(verdicts)
    elif kind == "one":
        assert at_least(0.97, (v.found for v in verdicts)), told(verdicts)
        assert at_least(0.95, (v.exact for v in verdicts)), told(verdicts)
        covered = [hit for v in verdicts for _, hit, _ in v.covered]
        assert len(covered) > 20
        assert np.mean(covered) > 0.85
    elif kind == "two":
        # The true share is about 93 % (docs/trace.md): twenty sessions do not tell it from the bound.
        assert at_least(0.90, (v.exact for v in verdicts)), told(verdicts)
    else:
        share, most = (0.90, 0.05) if kind == "uncatalogued" else (0.60, 0.15)
        assert at_least(share, (v.covariate for v in verdicts)), told(verdicts)
        assert at_least(1 - most, (not v.wrong for v in verdicts)), told(verdicts)
    ratios = [v.heldout_ratio for v in verdicts if not np.isnan(v.heldout_ratio)]
    # Beyond the grammar the oracle knows a form that nobody can name; over hundreds of sessions
    # (scripts/trace_statistics.py) the median is about 1.1 there too, in a round of eight it scatters.
    assert np.median(ratios) <= (1.3 if kind == "beyond" else 1.10)
    assert max(v.worse for v in verdicts) <= 1.05


IN_SPACE = {
    "none": 12,
    "one": len(SPACE_NAMES),
    "two": 12,
    "uncatalogued": len(FOREIGN_TERMS),
    "beyond": len(BEYOND_TERMS),
}


@pytest.mark.parametrize("kind", ["none", "one", "two"])
def test_trace_in_space_names_what_the_norm_shows(kind: str) -> None:
    """Bounds against regressions: one equation a pose tells less than two, see docs/trace.md."""
    with crew(1) as pools:
        verdicts = rounds(SPACE + kind, range(IN_SPACE[kind]), SEED, pools)
    assert not any(v.failure for v in verdicts), next(v.failure for v in verdicts if v.failure)
    assert at_least(0.95, (not v.wrong for v in verdicts)), told(verdicts)
    if kind == "none":
        assert at_least(0.99, (not v.claimed and not v.unnamed for v in verdicts)), told(verdicts)
    elif kind == "one":
        assert at_least(0.90, (v.exact for v in verdicts)), told(verdicts)
    elif kind == "two":
        assert at_least(0.60, (v.exact for v in verdicts)), told(verdicts)
