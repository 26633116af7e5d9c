"""All of it: sessions, table, map, bias, ambiguities, from one seed."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from adis_gonio.base import __version__
from adis_gonio.base.budget import current
from adis_gonio.base.errors import UsageError
from adis_gonio.handover.paper.ambiguities import Ambiguity, ambiguities, load_parts
from adis_gonio.handover.paper.comparison import (
    BiasError,
    Comparison,
    errors_with_bias,
    parts_of_column,
    parts_with_bias,
    printed_verdicts,
    table_of,
)
from adis_gonio.handover.paper.crossing import DRAWS, Draws, Map, map_of
from adis_gonio.handover.paper.sessions import DWELL_S, Part, Results, all_results, facts_of
from adis_gonio.handover.paper.truth import AXES, RMSD, Axis, truth_of

SESSIONS = 10
LEAST_SESSIONS, MOST_SESSIONS = 2, 10_000
TRACED_SHARE = 5
"""One part of so many is traced, at least one, of each column and of those with a bias."""
_TRACED = (*AXES, "bias")
_MOST_JOBS = 8


@dataclass(frozen=True)
class Study:
    """The paper reproduced.

    Attributes
    ----------
    seed, sessions : int
        What it was asked for: seed of all that is random, parts of each kind.
    results : mapping of str to sequence of Results
        Parts of column `x` and `y` of the table, and those with `bias`.
    """

    seed: int
    sessions: int
    table: Comparison
    map: Map
    bias: BiasError
    ambiguities: tuple[Ambiguity, ...]
    results: Mapping[str, Sequence[Results]]

    @property
    def command(self) -> str:
        """The command that makes it again."""
        return f"adis-gonio paper --seed {self.seed} --sessions {self.sessions}"

    def as_dict(self) -> dict[str, Any]:
        """The JSON document of `paper`."""
        truths = {f"column_{column}": truth_of(column).as_dict() for column in AXES}
        return {
            "command": f"{self.command} --json",
            "software": f"adis-gonio {__version__}",
            "seed": self.seed,
            "sessions": self.sessions,
            "dwell_s": DWELL_S,
            "truth": truths,
            "table_1": {**self.table.as_dict(), "rmsd_of_the_specification": RMSD},
            "as_printed": printed_verdicts(),
            "map": self.map.as_dict(),
            "bias": self.bias.as_dict(),
            "ambiguities": [one.as_dict() for one in self.ambiguities],
            "parts": {
                kind: [facts_of(one) | {"command": one.part.command("mmpm")} for one in done]
                for kind, done in self.results.items()
            },
        }


def reproduce(
    seed: int = 0, sessions: int = SESSIONS, jobs: int | None = None, *, draws: int = DRAWS
) -> Study:
    """Reproduce the paper.

    Parameters
    ----------
    seed : int
        Everything that is drawn comes from here; not negative.
    sessions : int
        Parts of each kind: of either column, and with a bias.
    jobs : int, optional
        Processes; by default one a core.
    draws : int
        Sessions by readings at each point of the map.

    Raises
    ------
    UsageError
        A seed or a number of sessions that is not possible.
    """
    if seed < 0:
        raise UsageError(f"--seed is {seed}: take 0 or more")
    if not LEAST_SESSIONS <= sessions <= MOST_SESSIONS:
        raise UsageError(f"--sessions is {sessions}: take {LEAST_SESSIONS} to {MOST_SESSIONS}")
    tell = current().tell
    streams = [np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(6)]
    seeding, mapping, biased, _, again, at_pole = streams
    tell("the map, by readings")
    mapped = map_of(truth_of("x"), Draws.of(mapping, draws))
    kinds: dict[str, list[Part]] = {
        column: parts_of_column(column, [int(s) for s in seeding.integers(2**31, size=sessions)])
        for column in AXES
    }
    kinds["bias"] = parts_with_bias(biased, sessions)
    kinds["load"] = list(load_parts(int(seeding.integers(2**31))))
    tell("sessions through chip and driver")
    results = _measured(
        kinds, max(1, sessions // TRACED_SHARE), jobs or min(os.cpu_count() or 1, _MOST_JOBS)
    )
    columns: dict[Axis, Sequence[Results]] = {axis: results[axis] for axis in AXES}
    return Study(
        seed,
        sessions,
        table_of(columns),
        mapped,
        errors_with_bias(results["bias"], again),
        ambiguities(at_pole, results["load"]),
        results,
    )


def _measured(kinds: Mapping[str, Sequence[Part]], traced: int, jobs: int) -> dict[str, Sequence[Results]]:
    """Results by kind; the first parts of the kinds `_TRACED` are traced too."""
    work = [
        (part, k < traced and kind in _TRACED)
        for kind, parts in kinds.items()
        for k, part in enumerate(parts)
    ]
    done = iter(all_results(work, jobs))
    return {kind: [next(done) for _ in parts] for kind, parts in kinds.items()}
