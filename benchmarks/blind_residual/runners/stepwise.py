"""Terms added one by one and dropped again by BIC, as pointing models of telescopes are built (TPOINT)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .common import Prepared, tuned

LARGEST = 8


def select(prepared: Prepared, least: float) -> list[int]:
    """Features by forward steps with backward looks; each gains at least `least`."""
    chosen: list[int] = []
    basis = np.zeros((len(prepared.y), 0))
    while len(chosen) < LARGEST:
        left_y = prepared.y - basis @ (basis.T @ prepared.y)
        left_x = prepared.x - basis @ (basis.T @ prepared.x)
        size = np.sum(left_x**2, axis=0)
        gains = np.where(size > 1e-4, (left_x.T @ left_y) ** 2 / np.maximum(size, 1e-4), 0.0)
        gains[chosen] = 0
        k = int(np.argmax(gains)) if gains.size else -1
        if k < 0 or gains[k] < least:
            break
        after = prepared.prune([*chosen, k], least)
        if k not in after or set(after) == set(chosen):
            break
        chosen = after
        basis = np.linalg.qr(prepared.x[:, chosen])[0]
    return chosen


def answer(directory: Path) -> dict[str, Any]:
    """Stepwise BIC: a term must gain ln(rows) and what the training set asks for."""
    prepared = Prepared(directory)
    least = max(float(np.log(len(prepared.y))), tuned("stepwise")["gain"])
    return prepared.answer(select(prepared, least))
