"""The scans of sweep.c in Python, and its output as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np


@dataclass(frozen=True)
class Scans:
    """Numbers in 1/256 step: readings (n, 3), temperature and supply (n,)."""

    numbers: np.ndarray
    temperature: np.ndarray
    supply: np.ndarray


def _signed(word: int, bits: int) -> int:
    data = word & ((1 << bits) - 1)
    return data - (1 << bits) if data >> (bits - 1) else data


@cache
def scans(n: int, span: int, *, words: bool) -> Scans:
    """Scans of the generator x ← 1664525 x + 1013904223 (Numerical Recipes), as sweep.c draws them."""
    state = 12345
    rows = []
    for k in range(n):
        drawn = []
        for _ in range(5):
            state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
            drawn.append(state >> 8)
        if words and k & 1:
            raw = [value & 0xFFFF for value in drawn]
            rows.append(
                [
                    *(256 * _signed(word, 14) for word in raw[:3]),
                    256 * _signed(raw[3], 12),
                    256 * (raw[4] & 0xFFF),
                ]
            )
        else:
            own = [value % span - span // 2 for value in drawn[:3]]
            rows.append([*own, drawn[3] % 200_000 - 100_000, drawn[4] % 2_000_000])
    table = np.array(rows, dtype=np.int64)
    return Scans(table[:, :3], table[:, 3], table[:, 4])


@dataclass(frozen=True)
class Printed:
    """What a machine gave: whole numbers as they are, floats as their bits."""

    self_check: int
    fixed: np.ndarray
    udeg: np.ndarray
    single: np.ndarray
    deg: np.ndarray


def parsed(text: str, axes: int) -> Printed:
    """Lines of sweep.c, whatever else a machine says between them."""
    lines = [line.strip().removeprefix("O:").split() for line in text.splitlines()]
    words = [line for line in lines if line and all(len(w) == 8 and _is_hex(w) for w in line)]
    assert len(words[0]) == 1
    table = np.array([[int(w, 16) for w in row] for row in words[1:]], dtype=np.uint32)
    assert table.shape[1] == 2 * axes + 2
    whole = table[:, : axes + 1].astype(np.int32)
    real = table[:, axes + 1 :].copy().view(np.float32)
    return Printed(int(words[0][0], 16), whole[:, :axes], whole[:, axes], real[:, :axes], real[:, axes])


def _is_hex(word: str) -> bool:
    return set(word) <= set("0123456789abcdef")
