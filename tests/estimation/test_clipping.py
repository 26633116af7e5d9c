"""Samples at a limit are said to be there; noise, however coarse, is not taken for a limit."""

from __future__ import annotations

import numpy as np
import pytest

from adis_gonio.estimation.screening import clipped
from adis_gonio.model.records import Dwell


def dwells(rng: np.random.Generator, step: float, limit: float | None = None) -> list[Dwell]:
    made = []
    for k, level in enumerate((990.0, 300.0, -700.0)):
        rows = rng.normal([level, 50.0], 5.0, (400, 2))
        rows = step * np.round(rows / step)
        if limit is not None:
            rows = np.clip(rows, -limit, limit)
        made.append(Dwell(k + 1, 10.0 * k + np.arange(400) / 100, rows))
    return made


@pytest.mark.parametrize("step", [0.01, 0.4672, 2.5])
def test_noise_is_no_limit(step: float) -> None:
    assert not any(clipped(dwells(np.random.default_rng(seed), step)) for seed in range(100))


def test_samples_at_a_limit_are_counted_and_their_position_named() -> None:
    (line,) = clipped(dwells(np.random.default_rng(1), 0.4672, limit=992.0))
    assert "of x stand at the extreme value 992 (position 1)" in line
    assert int(line.split()[0]) > 100
