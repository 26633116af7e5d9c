"""Draws the errors of three gyros as settings of a simulated world.

The sizes with "DS" are in the data sheet of the ADIS16350 and ADIS16355 (confidence B); the others are
estimates for parts of this class (confidence D). Noise and bias instability are missing, which are figures
of the variant.
"""

import itertools

import numpy as np

AXES = ("x", "y", "z")
PAIRS = tuple(a + b for a, b in itertools.product(AXES, repeat=2))
OTHERS = tuple(a + b for a, b in itertools.permutations(AXES, 2))
ONE = ("",)
ERRORS = (
    # setting, axes, law, standard deviation or half width, middle
    ("gyro_bias_{}_dps", AXES, "normal", 1.0, 0.0),
    ("gyro_bias_tempco_{}_dps_per_c", AXES, "normal", 0.02, 0.0),
    ("gyro_warm_up_{}_dps", AXES, "normal", 0.1, 0.0),
    ("gyro_warm_up_tau_s{}", ONE, "uniform", 90.0, 150.0),
    ("gyro_scale_{}", AXES, "normal", 0.008, 1.0),  # DS: sensitivity ±2 %, which cuts the draw
    ("gyro_scale_tempco_{}_ppm_per_c", AXES, "normal", 100.0, 0.0),  # DS: 100 / 40 ppm/°C
    ("gyro_asymmetry_{}", AXES, "normal", 5e-4, 0.0),  # DS: nonlinearity ±0.2 % of full scale allows it
    ("gyro_misalignment_{}_deg", OTHERS, "uniform", 0.25, 0.0),  # DS: non-orthogonality ±0.25°
    ("gyro_triad_{}_deg", AXES, "uniform", 0.5, 0.0),  # DS: axis to frame ±0.5°
    ("gyro_g_sensitivity_{}_dps_per_g", PAIRS, "normal", 0.05, 0.0),  # DS: 0.05 °/s/g
    ("gyro_g2_sensitivity_{}_dps_per_g2", PAIRS, "normal", 0.01, 0.0),
    ("gyro_supply_{}_dps_per_v", AXES, "normal", 0.25, 0.0),  # DS: 0.25 °/s/V
    ("gyro_rate_walk_dps_per_rt_s{}", ONE, "uniform", 5e-4, 5e-4),
    ("gyro_range_gain_{}", ("150", "75"), "normal", 1e-3, 1.0),
    ("gyro_g_compensation{}", ONE, "uniform", 0.1, 0.9),
    ("accel_place_{}_mm", PAIRS, "normal", 2.0, 0.0),
    ("die_gradient_{}_c", AXES, "normal", 0.5, 0.0),
    ("die_lag_{}_s", AXES, "uniform", 15.0, 20.0),
    ("earth_rate_up_dps{}", ONE, "uniform", 0.0036, 0.0),  # the earth, up to 60° of latitude
)


def draw_gyros(rng: np.random.Generator) -> dict[str, float]:
    """Values by name, for `WorldSettings`; normal values stay within three standard deviations."""
    drawn = {}
    for setting, axes, law, size, middle in ERRORS:
        if law == "uniform":
            values = size * rng.uniform(-1.0, 1.0, len(axes))
        else:
            most = 2.5 if setting == "gyro_scale_{}" else 3.0
            values = size * np.clip(rng.standard_normal(len(axes)), -most, most)
        for axis, value in zip(axes, values, strict=True):
            drawn[setting.format(axis)] = middle + float(value)
    return drawn
