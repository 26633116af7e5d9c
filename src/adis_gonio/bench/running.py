"""What the dwells so far give: a fit of their means, quick enough for after each dwell.

The final fit reads all samples; this one takes each dwell as one averaged reading, with the scatter of the
dwells' own parts as its uncertainty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.events import Running
from adis_gonio.model.records import Dwell, Session
from adis_gonio.record.blocks import Block
from adis_gonio.record.plans import Plan, Position
from adis_gonio.record.rows import Header

PARTS = 8
"""Parts of a dwell whose means tell how well its mean is known; 7 degrees of freedom a dwell and axis."""
EVERY_UP_TO = 36
"""Dwells up to which each one is followed by a fit; beyond, one whenever a tenth has been added."""


@dataclass(frozen=True)
class _Mean:
    position: Position
    mean_mg: Floats
    variance_mg2: float


class RunningFit:
    """Fits the means of the dwells so far."""

    def __init__(self, header: Header) -> None:
        self._header = header
        self._means: dict[int, _Mean] = {}
        self._fitted = 0

    def add(self, place: int, position: Position, scans: Block) -> None:
        """Take a dwell; of one place the newest counts."""
        parts = np.array([part.mean(axis=0) for part in np.array_split(scans.accel_mg, PARTS)])
        variance = float(parts.var(axis=0, ddof=1).mean()) / PARTS
        self._means[place] = _Mean(position, np.asarray(scans.accel_mg.mean(axis=0)), variance)

    def withdraw(self, place: int) -> None:
        """Forget the dwell of a place."""
        self._means.pop(place, None)
        self._fitted = 0

    def result(self, plan: Plan, *, reverse: bool) -> Running | None:
        """Parameters so far; None where the dwells do not allow a fit, or the last one still serves."""
        from adis_gonio.fitting import fit

        count = len(self._means)
        if count > EVERY_UP_TO and count < 1.1 * self._fitted:
            return None
        try:
            result = fit(self._session(plan, reverse=reverse))
        except (AdisGonioError, np.linalg.LinAlgError):
            # Too few, or not different enough: the next dwell may change that.
            return None
        self._fitted = count
        # Not the whole document: methods beside each other are for the end, and cost a fit for each dwell.
        parameters = {estimate.name: estimate.stated.as_dict() for estimate in result.parameters}
        return Running(parameters, result.method, count)

    def _session(self, plan: Plan, *, reverse: bool) -> Session:
        header, sign = self._header, -1.0 if reverse else 1.0
        variance = float(np.mean([entry.variance_mg2 for entry in self._means.values()] or [1.0]))
        dwells = []
        for number, (_, entry) in enumerate(sorted(self._means.items())):
            angle = entry.position.angle_deg
            dwell = Dwell(number, np.array([float(number)]), entry.mean_mg[None, :], use=entry.position.use)
            dwells.append(replace(dwell, angle_deg=None if angle is None else sign * angle))
        return Session(
            tuple(dwells),
            sensor=header.variant,
            accel_unit="mg",
            gravity_mps2=header.gravity_mps2,
            fixture_sigma_deg=header.fixture_sigma_deg,
            plane=plan.plane,
            reading_u_mg=math.sqrt(variance),
        )


__all__ = ["RunningFit"]
