"""How large an error has to be for a session to show it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.slips.evidence import Beside, ScatterPoint, Whitened
from adis_gonio.slips.faults import Name, patterns_of
from adis_gonio.slips.rows import Rows

POWER = 2.326
"""Standard deviations of 99 % power."""
SIZES_DEG = np.geomspace(0.02, 90.0, 60)
"""Errors that are tried."""


@dataclass(frozen=True)
class Detectability:
    """A session with what was found in it taken out, and faults of each size put in.

    Attributes
    ----------
    position : tuple of int
        Numbers of the dwells.
    """

    position: tuple[int, ...]
    rows: Rows
    grid: tuple[ScatterPoint, ...]
    beside: Beside

    def detectable_deg(self, name: Name, certain: float) -> dict[int, float]:
        """Smallest error at each position whose posterior reaches `certain` with 99 % power, in degrees.

        Of names with one free size; other faults at the same time are not thought of.
        """
        every = patterns_of(self.rows, self.beside.error_rad)
        patterns = [p for p in every if name in p.names and p.columns.shape[1] == 1]
        if not patterns:
            return {}
        left = self.beside.left(self.rows)[:, None]
        columns = np.stack([p.columns[:, 0] for p in patterns], axis=1)
        sizes = np.radians(SIZES_DEG)
        none, faulty = np.empty((2, len(self.grid), len(patterns), len(sizes)))
        u = np.empty((len(self.grid), len(patterns)))
        for g, scatter in enumerate(self.grid):
            clean = Whitened(self.rows, scatter, self.beside.known)
            z = clean.white(clean.mean_of(left))
            white = Whitened(self.rows, scatter, self.beside.known[:, :0])
            v = white.white(columns)
            vv, zz = (v * v).sum(axis=0), float((z * z).sum())
            u[g] = 1 / np.sqrt(vv)
            own = clean.log_scale + scatter.log_prior - 0.5 * zz
            none[g] = own - 0.5 * np.outer(vv, sizes**2)
            for k, pattern in enumerate(patterns):
                log_prior, amplitude = pattern.names[name]
                assert amplitude is not None
                faulty[g, k] = own + log_prior + amplitude(sizes, np.full(len(sizes), u[g, k]))
        odds = np.logaddexp.reduce(faulty, axis=0) - np.logaddexp.reduce(none, axis=0)
        enough = odds >= math.log(certain / (1 - certain))
        best = int(np.argmax(np.logaddexp.reduce(faulty[:, :, -1], axis=1)))
        found = {}
        for k, pattern in enumerate(patterns):
            from_here_on = enough[k][::-1].cumprod()[::-1].astype(np.bool_)
            least = float(SIZES_DEG[from_here_on.argmax()]) if from_here_on.any() else math.inf
            found[self.position[pattern.dwells[0]]] = least + POWER * math.degrees(u[best, k])
        return found


__all__ = ["Detectability"]
