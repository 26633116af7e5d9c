"""Data that no living sensor gives: all zeros, stuck words. Refused before anything is estimated.

A quiet sensor behind a coarse converter may well repeat one word for a whole dwell, so a dwell without any
variance is no proof. Stuck is what contradicts something else that is known:

* the other dwells: the same axis moves there by more than its noise around an edge between two codes
  (0.6 steps rms), and never stood for a quarter as long;
* the positions: two or more dwells at different declared angles with the very same words on all axes, or
  all dwells alike;
* the chip: an ADIS1635x has 4.7 mg (16354) of noise before its filter, 1 LSB rms behind the longest one,
  and the chance that two axes keep one word for 256 samples, or one axis for 512, is below 1e-4. That
  holds where its words have all their bits.

An axis that stands at a limit repeats a word too (`converter`): that is a limit, and no fault.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import DataError
from adis_gonio.base.numbers import counted, name_positions
from adis_gonio.fitting.estimation.converter import Limit, steps_of
from adis_gonio.model.records import Dwell, Session

_LEAST_RUN = 32
_CHIP_RUN = 512
_LIVELY = 0.6
_MOST_GRAVITY = 1.1
"""Length of a reading at a limit in units of gravity: what is cut is longer, so that more is no limit. A
tenth for gains and biases of any sensor."""


def refuse_dead_data(session: Session, limits: Sequence[Limit], mg_per_unit: float | None) -> None:
    """Raise `DataError` with the positions that are all zero or stuck; see the module for what that is.

    Parameters
    ----------
    session : Session
    limits : sequence of Limit
        Those that its samples show.
    mg_per_unit : float or None
        Of the samples; None where their scale is not known.
    """
    dwells = [dwell for dwell in session.dwells if len(dwell)]
    zero = [dwell.position for dwell in dwells if not dwell.accel.any()]
    where = f"{session.source}: " if session.source else ""
    if zero:
        raise DataError(
            f"{where}all-zero accelerations in {name_positions(zero)}; nothing drove the data line: "
            "check wiring and supply and record again"
        )
    at_limit = _at_limit(dwells, limits, None if mg_per_unit is None else session.gravity_mg / mg_per_unit)
    dwells = [dwell for dwell in dwells if dwell.position not in at_limit]
    sampled = [dwell for dwell in dwells if len(dwell) > 1]
    stuck = _still_against_others(sampled) or _same_everywhere(dwells)
    if not stuck and session.accel_unit == "lsb" and sampled:
        whole = steps_of([dwell.accel for dwell in sampled]) <= 1
        stuck = [
            dwell.position
            for dwell in sampled
            if len(dwell) * int(((np.ptp(dwell.accel, axis=0) == 0) & whole).sum()) >= _CHIP_RUN
        ]
    if stuck:
        raise DataError(
            f"{where}stuck data in {name_positions(stuck)}: words repeat where a working sensor shows"
            " noise or follows the rotation; check the sensor and record again"
        )


def limits_in_words(limits: Sequence[Limit], unit: str) -> list[str]:
    """A sentence for each limit: what clips has no mean."""
    lines = []
    for limit in limits:
        where = f"the extreme value {limit.value:g} {unit} ({name_positions(limit.positions)})"
        samples = f"{counted(limit.samples, 'sample')} of {'xyz'[limit.axis]}"
        line = f"{samples} stand at {where}: a limit was reached there"
        if limit.spoiled:
            word = "takes" if len(limit.spoiled) == 1 else "take"
            where = name_positions(limit.spoiled)
            line += f", a mean is not the reading, and {where} {word} no part in the fit"
        lines.append(line)
    return lines


def _at_limit(dwells: Sequence[Dwell], limits: Sequence[Limit], gravity: float | None) -> set[int]:
    """Dwells whose mean a limit moves, one that several reach at either end and that gravity allows."""
    if gravity is None:
        return set()
    means = {dwell.position: dwell.accel.mean(axis=0) for dwell in dwells}
    reached: dict[float, set[int]] = defaultdict(set)
    for limit in limits:
        reached[abs(limit.value)].update(limit.positions)
    return {
        position
        for limit in limits
        for position in limit.spoiled
        if len(reached[abs(limit.value)]) > 1
        and all(float(np.linalg.norm(means[p])) <= _MOST_GRAVITY * gravity for p in limit.spoiled)
    }


def longest_runs(accel: Floats) -> Floats:
    """Longest run of one word on each axis, (axes,), in samples."""
    runs = []
    for axis in range(accel.shape[1]):
        change = np.flatnonzero(np.diff(accel[:, axis]))
        runs.append(np.diff(np.concatenate([[-1], change, [len(accel) - 1]])).max())
    return np.array(runs, dtype=float)


def _still_against_others(dwells: Sequence[Dwell]) -> list[int]:
    """Dwells in which an axis stands for at least half of the time, four times longer than in any other."""
    if len(dwells) < 2:
        return []
    runs = np.stack([longest_runs(dwell.accel) for dwell in dwells])
    length = np.array([len(dwell) for dwell in dwells])
    suspect = (runs >= _LEAST_RUN) & (runs >= 0.5 * length[:, None])
    # What the healthy dwells show; an axis without any healthy dwell is judged by the other rules.
    healthy = np.where(suspect, 0.0, runs).max(axis=0)
    lively = np.array([_is_lively(dwells, ~suspect[:, axis], axis) for axis in range(runs.shape[1])])
    stuck = suspect & lively & (runs >= 4 * healthy)
    return [dwell.position for dwell, bad in zip(dwells, stuck.any(axis=1), strict=True) if bad]


def _is_lively(dwells: Sequence[Dwell], healthy: NDArray[np.bool_], axis: int) -> bool:
    """True where an axis of the healthy dwells has more noise than a converter's step hides."""
    deviations, steps = [], []
    for dwell, use in zip(dwells, healthy, strict=True):
        if use:
            gaps = np.diff(np.unique(dwell.accel[:, axis]))
            deviations.append(float(dwell.accel[:, axis].std()))
            steps.append(float(gaps[gaps > 1e-9 * np.abs(dwell.accel[:, axis]).max()].min(initial=np.inf)))
    return bool(deviations) and float(np.median(deviations)) > _LIVELY * min(steps)


def _same_everywhere(dwells: Sequence[Dwell]) -> list[int]:
    constant = [d for d in dwells if len(d) == 1 or not np.ptp(d.accel, axis=0).any()]
    if len(constant) < 2:
        return []
    words = np.stack([dwell.accel[0] for dwell in constant])
    angles = np.array([np.nan if d.angle_deg is None else d.angle_deg % 360 for d in constant])
    one_angle = bool((angles == angles[0]).all())
    if len(constant) == len(dwells) > 2 and (words == words[0]).all() and not one_angle:
        return [dwell.position for dwell in constant]
    gap = np.abs(np.diff(angles))
    bad = np.flatnonzero((words[1:] == words[:-1]).all(axis=1) & (gap > 5) & (gap < 355))
    return sorted({constant[k + side].position for k in bad.tolist() for side in (0, 1)})
