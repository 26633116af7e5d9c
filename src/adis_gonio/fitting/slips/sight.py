"""How large an error has to be for a session to show it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.fitting.slips.evidence import Beside, ScatterPoint, Whitened
from adis_gonio.fitting.slips.faults import Name, Pattern, patterns_of
from adis_gonio.fitting.slips.rows import Rows

POWER = 0.99
"""Share of sessions that show it."""
SIZES_DEG = np.geomspace(0.02, 90.0, 120)
"""Errors that are tried."""
_DRAWN = 200
"""Sessions that are imagined for it."""


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

        By sessions imagined under the scatter of this one, in each of which an error of each size is put.
        Of names with one free size; other faults at the same time are not thought of.
        """
        every = patterns_of(self.rows, self.beside.error_rad)
        patterns = [p for p in every if name in p.names and p.columns.shape[1] == 1]
        if not patterns:
            return {}
        likely = [self._likelihood(scatter) for scatter in self.grid]
        own = Whitened(self.rows, self.grid[int(np.argmax(likely))], self.beside.known[:, :0])
        drawn = own.root @ np.random.default_rng(0).standard_normal((len(own.root), _DRAWN))
        accounts = [Whitened(self.rows, scatter, self.beside.known[:, :0]) for scatter in self.grid]
        white = [(account, account.white(drawn)) for account in accounts]
        found = {}
        for pattern in patterns:
            shown = self._odds(pattern, name, white) >= math.log(certain / (1 - certain))
            enough = (shown.mean(axis=1) >= POWER)[::-1].cumprod()[::-1].astype(np.bool_)
            least = float(SIZES_DEG[enough.argmax()]) if enough.any() else math.inf
            found[self.position[pattern.dwells[0]]] = least
        return found

    def _likelihood(self, scatter: ScatterPoint) -> float:
        """Ln of prior times likelihood of the session under a scatter."""
        white = Whitened(self.rows, scatter, self.beside.known)
        z = white.white(white.mean_of(self.beside.left(self.rows)[:, None]))
        return float(white.weight(z)[0])

    def _odds(self, pattern: Pattern, name: Name, drawn: list[tuple[Whitened, Floats]]) -> Floats:
        """Log odds (sizes, sessions) of the pattern under the name against none."""
        log_prior, amplitude = pattern.names[name]
        assert amplitude is not None
        sizes = np.radians(SIZES_DEG)[:, None]
        faulty, none = np.full((2, len(sizes), drawn[0][1].shape[1]), -np.inf)
        for account, z in drawn:
            v = account.white(pattern.columns[:, 0])
            vv, vz = float(v @ v), v @ z
            clean = account.weight(z)
            none = np.logaddexp(none, clean - sizes * vz - 0.5 * sizes**2 * vv)
            seen = sizes + vz / vv
            own = amplitude(seen.ravel(), np.full(seen.size, 1 / math.sqrt(vv))).reshape(seen.shape)
            faulty = np.logaddexp(faulty, clean + 0.5 * vz**2 / vv + log_prior + own)
        return np.asarray(faulty - none)
