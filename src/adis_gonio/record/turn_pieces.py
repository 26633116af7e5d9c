"""A free turn out of the pieces in which the archive has it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import Dwell
from adis_gonio.record.blocks import Block, session_columns
from adis_gonio.record.rows import StoredAttempt
from adis_gonio.record.view import ArchiveView

FREE_TURN = "free-turn"
"""Name of the plan."""
GOES_ON = "the turn goes on"
"""Reason of an attempt that is a piece of a turn and not its last."""


def recording_of(view: ArchiveView) -> tuple[Dwell | None, str]:
    """The whole of the last complete turn, else of the longest one, and what broke that one off.

    None where nothing was recorded.
    """
    chains: list[list[StoredAttempt]] = [[]]
    for attempt in view.attempts():
        if chains[-1] and chains[-1][-1].run != attempt.run:
            chains.append([])
        chains[-1].append(attempt)
        if attempt.reason != GOES_ON:
            chains.append([])
    taken = view.withdrawn()
    chains = [chain for chain in chains if chain and chain[-1].number not in taken]
    whole = [chain for chain in chains if chain[-1].outcome == "complete"]
    best = whole[-1] if whole else max(chains, key=_length_s, default=None)
    if best is None:
        return None, "nothing was recorded"
    reason = "" if whole else best[-1].reason.replace(GOES_ON, "the program ended")
    blocks = [(attempt, block) for attempt in best for block in view.blocks(attempt) if len(block)]
    return (_joined(blocks) if blocks else None), reason


def _length_s(chain: Sequence[StoredAttempt]) -> float:
    return chain[-1].ended_bus_s - chain[0].started_bus_s


def _joined(blocks: Sequence[tuple[StoredAttempt, Block]]) -> Dwell:
    columns = [session_columns(block) for _, block in blocks]

    def series(*names: str) -> Floats | None:
        if not all(name in columns[0] for name in names):
            return None
        return np.concatenate([np.column_stack([c[name] for name in names]) for c in columns])

    accel = series("ax", "ay", "az")
    if accel is None:
        raise UsageError("a recording needs the accelerometers")
    temperature, supply = series("temp_c"), series("supply_v")
    return Dwell(
        0,
        np.concatenate([block.time_s + attempt.offset_s for attempt, block in blocks]),
        accel,
        gyro=series("gx", "gy", "gz"),
        temperature_c=None if temperature is None else temperature[:, 0],
        supply_v=None if supply is None else supply[:, 0],
    )
