"""Settings of the gyros of a simulated part, and of what the chip itself does about them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GyroSettings:
    """Settings of the three gyros; None means drawn from the seed by the variant's figures.

    A gyro reads, in °/s::

        (1 + s (T − 25 °C)) (r + a |r|) + b + t (T − 25 °C) + w exp(−time since power-on / τ)
            + G f + C f² + v (supply − 5 V)

    with the rate `r` that its own gain and direction make of the turn, the temperature `T` of its own die,
    and the force `f` in g as ideal accelerometers read it: level with Z up −1 on z. To it come rate walk,
    flicker and white noise; then the chip's range and its compensations.

    Attributes
    ----------
    gyro_noise_dps, gyro_instability_dps : float or None, float
        White noise of an unfiltered sample (rms), and the floor of the Allan deviation.
    gyro_rate_walk_dps_per_rt_s : float
        Random walk of the biases: standard deviation after a second.
    gyro_bias_sigma_dps, gyro_bias_x_dps, … : float, float or None
        Standard deviation of the biases `b` at 25 °C, and the biases themselves.
    gyro_bias_tempco_x_dps_per_c, … : float
        Their temperature coefficients `t`.
    gyro_warm_up_x_dps, …, gyro_warm_up_tau_s : float
        What power-on adds (`w`), and the time constant with which that dies away.
    gyro_scale_x, … : float
        Gains of the gyros, 1 is perfect.
    gyro_scale_tempco_x_ppm_per_c, … : float
        Temperature coefficients of the gains (`s`).
    gyro_asymmetry_x, … : float
        By how much the gain is greater for positive rates than for their mean, and less for negative ones
        (`a`).
    gyro_misalignment_xy_deg, … : float
        Misalignment of the first gyro's axis towards the second axis of the gyros' frame.
    gyro_triad_x_deg, gyro_triad_y_deg, gyro_triad_z_deg : float
        Rotation (a rotation vector) of the gyros' frame against that of the accelerometers.
    gyro_g_dps_per_g : float or None
        What a force along the own axis adds to each gyro (`G`).
    gyro_g_sensitivity_xx_dps_per_g, … : float or None
        The same of one gyro.
    gyro_g_sensitivity_xy_dps_per_g, … : float
        What a force along the second axis adds to the first gyro.
    gyro_g2_sensitivity_xx_dps_per_g2, … : float
        What the square of the force along the second axis adds to the first gyro (`C`): rectification.
    gyro_supply_dps_per_v, gyro_supply_x_dps_per_v, … : float or None
        What a supply other than 5 V adds (`v`), of all and of each.
    gyro_range_gain_150, gyro_range_gain_75 : float
        Gain of the whole signal in these ranges, relative to ±300 °/s.
    gyro_saturation : float
        Where the signal is cut off, in units of the range in force; the words end at twice the range.
    gyro_g_compensation : float
        How much of G the chip takes off where MSC_CTRL[7] is set: what the factory knew of it.
    accel_place_xx_mm, … : float
        Where the first accelerometer is along the second axis, from the origin that the part turns about.
    origin_compensation : float
        How much of what these places add the chip takes off where MSC_CTRL[6] is set.
    die_gradient_x_c, …, die_gradient_tau_s : float
        How much warmer than the part a gyro's die is once it is warm, and the time constant of that.
    die_lag_x_s, … : float
        Time constants with which the dies follow the part's temperature; 0 is at once.
    earth_rate_up_dps : float
        Upward part of the earth's rotation: 0.00418 °/s times the sine of the latitude.
    autonull_s, precision_autonull_s : float
        Times over which the autonulls average; 0 takes the filter's present output.
    """

    gyro_noise_dps: float | None = None
    gyro_instability_dps: float = 0.015
    gyro_rate_walk_dps_per_rt_s: float = 0.0
    gyro_bias_sigma_dps: float = 1.0
    gyro_bias_x_dps: float | None = None
    gyro_bias_y_dps: float | None = None
    gyro_bias_z_dps: float | None = None
    gyro_bias_tempco_x_dps_per_c: float = 0.0
    gyro_bias_tempco_y_dps_per_c: float = 0.0
    gyro_bias_tempco_z_dps_per_c: float = 0.0
    gyro_warm_up_x_dps: float = 0.0
    gyro_warm_up_y_dps: float = 0.0
    gyro_warm_up_z_dps: float = 0.0
    gyro_warm_up_tau_s: float = 120.0
    gyro_scale_x: float = 1.0
    gyro_scale_y: float = 1.0
    gyro_scale_z: float = 1.0
    gyro_scale_tempco_x_ppm_per_c: float = 0.0
    gyro_scale_tempco_y_ppm_per_c: float = 0.0
    gyro_scale_tempco_z_ppm_per_c: float = 0.0
    gyro_asymmetry_x: float = 0.0
    gyro_asymmetry_y: float = 0.0
    gyro_asymmetry_z: float = 0.0
    gyro_misalignment_xy_deg: float = 0.0
    gyro_misalignment_xz_deg: float = 0.0
    gyro_misalignment_yx_deg: float = 0.0
    gyro_misalignment_yz_deg: float = 0.0
    gyro_misalignment_zx_deg: float = 0.0
    gyro_misalignment_zy_deg: float = 0.0
    gyro_triad_x_deg: float = 0.0
    gyro_triad_y_deg: float = 0.0
    gyro_triad_z_deg: float = 0.0
    gyro_g_dps_per_g: float | None = None
    gyro_g_sensitivity_xx_dps_per_g: float | None = None
    gyro_g_sensitivity_xy_dps_per_g: float = 0.0
    gyro_g_sensitivity_xz_dps_per_g: float = 0.0
    gyro_g_sensitivity_yx_dps_per_g: float = 0.0
    gyro_g_sensitivity_yy_dps_per_g: float | None = None
    gyro_g_sensitivity_yz_dps_per_g: float = 0.0
    gyro_g_sensitivity_zx_dps_per_g: float = 0.0
    gyro_g_sensitivity_zy_dps_per_g: float = 0.0
    gyro_g_sensitivity_zz_dps_per_g: float | None = None
    gyro_g2_sensitivity_xx_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_xy_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_xz_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_yx_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_yy_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_yz_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_zx_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_zy_dps_per_g2: float = 0.0
    gyro_g2_sensitivity_zz_dps_per_g2: float = 0.0
    gyro_supply_dps_per_v: float | None = None
    gyro_supply_x_dps_per_v: float | None = None
    gyro_supply_y_dps_per_v: float | None = None
    gyro_supply_z_dps_per_v: float | None = None
    gyro_range_gain_150: float = 1.0
    gyro_range_gain_75: float = 1.0
    gyro_saturation: float = 1.2
    gyro_g_compensation: float = 0.9
    accel_place_xx_mm: float = 0.0
    accel_place_xy_mm: float = 0.0
    accel_place_xz_mm: float = 0.0
    accel_place_yx_mm: float = 0.0
    accel_place_yy_mm: float = 0.0
    accel_place_yz_mm: float = 0.0
    accel_place_zx_mm: float = 0.0
    accel_place_zy_mm: float = 0.0
    accel_place_zz_mm: float = 0.0
    origin_compensation: float = 0.9
    die_gradient_x_c: float = 0.0
    die_gradient_y_c: float = 0.0
    die_gradient_z_c: float = 0.0
    die_gradient_tau_s: float = 120.0
    die_lag_x_s: float = 0.0
    die_lag_y_s: float = 0.0
    die_lag_z_s: float = 0.0
    earth_rate_up_dps: float = 0.0
    autonull_s: float = 0.0
    precision_autonull_s: float = 30.0


POSITIVE = (
    "gyro_warm_up_tau_s",
    "gyro_range_gain_150",
    "gyro_range_gain_75",
    "gyro_saturation",
    "die_gradient_tau_s",
    "precision_autonull_s",
)
AT_LEAST_ZERO = (
    "gyro_noise_dps",
    "gyro_bias_sigma_dps",
    "gyro_instability_dps",
    "gyro_rate_walk_dps_per_rt_s",
    "die_lag_x_s",
    "die_lag_y_s",
    "die_lag_z_s",
    "autonull_s",
)
