"""Gyros as they are sold: a draw of all their faults, each figure with its source and confidence.

Sources: CHIP is what is known of the chip, of whose sibling's sheet the figures with confidence B are; they
are taken as the size of the fault. D are estimates of what parts of this class do.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np

from adis_gonio.device.sensor.registers import Confidence
from adis_gonio.model.effects.base import AXES

_OTHERS = tuple(a + b for a, b in itertools.permutations(AXES, 2))
_ALL = tuple(a + b for a, b in itertools.product(AXES, repeat=2))
_STREAM = 10
"""Child of a world's seed that these faults are drawn from."""


@dataclass(frozen=True)
class DrawnFault:
    """How one kind of fault is drawn.

    Attributes
    ----------
    setting : str
        Name of the setting, {} where the axes stand.
    axes : tuple of str
        What stands there.
    law : {"normal", "uniform"}
    size : float
        Standard deviation, or half the width.
    middle : float
        Mean of either.
    most : float
        Bound of what is drawn about the middle; 0 for three sizes.
    """

    setting: str
    axes: tuple[str, ...]
    law: Literal["normal", "uniform"]
    size: float
    source: str
    confidence: Confidence
    middle: float = 0.0
    most: float = 0.0

    @property
    def described(self) -> str:
        """How it is drawn, in words."""
        if self.law == "uniform":
            return f"uniform, {self.middle:g} ± {self.size:g}"
        bound = f", at most {self.most:g} away" if self.most else ""
        return f"normal, {self.middle:g}, σ {self.size:g}{bound}"

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Values by setting."""
        n = len(self.axes)
        if self.law == "uniform":
            drawn = self.size * rng.uniform(-1.0, 1.0, n)
        else:
            most = self.most or 3 * self.size
            drawn = np.clip(self.size * rng.standard_normal(n), -most, most)
        return {
            self.setting.format(axis): self.middle + float(value)
            for axis, value in zip(self.axes, drawn, strict=True)
        }


_ONE = ("",)
_PART = "parts of this class"
FIGURES: tuple[DrawnFault, ...] = (
    DrawnFault("gyro_bias_{}_dps", AXES, "normal", 1.0, _PART, "D"),
    DrawnFault("gyro_bias_tempco_{}_dps_per_c", AXES, "normal", 0.02, _PART, "D"),
    DrawnFault("gyro_warm_up_{}_dps", AXES, "normal", 0.1, _PART, "D"),
    DrawnFault("gyro_warm_up_tau_s{}", _ONE, "uniform", 90.0, _PART, "D", middle=150.0),
    DrawnFault(
        "gyro_scale_{}", AXES, "normal", 0.008, "CHIP: sensitivity ±2 %", "B", middle=1.0, most=0.02
    ),
    DrawnFault("gyro_scale_tempco_{}_ppm_per_c", AXES, "normal", 100.0, "CHIP: 100 / 40 ppm/°C", "B"),
    DrawnFault("gyro_asymmetry_{}", AXES, "normal", 5e-4, "CHIP: nonlinearity ±0.2 % FS allows it", "D"),
    DrawnFault("gyro_misalignment_{}_deg", _OTHERS, "uniform", 0.25, "CHIP: non-orthogonality ±0.25°", "B"),
    DrawnFault("gyro_triad_{}_deg", AXES, "uniform", 0.5, "CHIP: axis to frame ±0.5°", "B"),
    DrawnFault("gyro_g_sensitivity_{}_dps_per_g", _ALL, "normal", 0.05, "CHIP: 0.05 °/s/g", "B"),
    DrawnFault("gyro_g2_sensitivity_{}_dps_per_g2", _ALL, "normal", 0.01, _PART, "D"),
    DrawnFault("gyro_supply_{}_dps_per_v", AXES, "normal", 0.25, "CHIP: 0.25 °/s/V", "B"),
    DrawnFault("gyro_rate_walk_dps_per_rt_s{}", _ONE, "uniform", 5e-4, _PART, "D", middle=5e-4),
    DrawnFault("gyro_range_gain_{}", ("150", "75"), "normal", 1e-3, _PART, "D", middle=1.0),
    DrawnFault("gyro_g_compensation{}", _ONE, "uniform", 0.1, _PART, "D", middle=0.9),
    DrawnFault("accel_place_{}_mm", _ALL, "normal", 2.0, _PART, "D"),
    DrawnFault("die_gradient_{}_c", AXES, "normal", 0.5, _PART, "D"),
    DrawnFault("die_lag_{}_s", AXES, "uniform", 15.0, _PART, "D", middle=20.0),
    DrawnFault("earth_rate_up_dps{}", _ONE, "uniform", 0.0036, "the earth, up to 60° of latitude", "A"),
)
"""What is drawn, in this order. Noise and bias instability stay those of the variant."""


def realistic_gyros(rng: np.random.Generator) -> dict[str, float]:
    """Settings of three gyros with all their faults.

    Parameters
    ----------
    rng : Generator
        Draws them.

    Returns
    -------
    dict of str to float
        By name, for `WorldSettings(**realistic_gyros(rng))`.
    """
    drawn: dict[str, float] = {}
    for figure in FIGURES:
        drawn |= figure.draw(rng)
    return drawn


def stream_of(seed: int) -> np.random.Generator:
    """Generator of the faults that a simulated part with this seed has."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
