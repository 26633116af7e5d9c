"""Settings of the simulated world: every figure that a person may want to change, with its unit."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from typing import Any, Self, TypeVar, dataclass_transform

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import UsageError, suggest
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2

T = TypeVar("T")
PAIRS = tuple(a + b for a, b in itertools.product("xyz", repeat=2))
_OTHERS = tuple(a + b for a, b in itertools.permutations("xyz", 2))
_PLACES = {"each": ("x", "y", "z"), "other": _OTHERS, "pair": PAIRS}


def _above_0(default: float) -> Any:
    return field(default=default, metadata={"refused": lambda value: value <= 0, "must": "be above 0"})


def _not_negative(default: float | None) -> Any:
    return field(default=default, metadata={"refused": lambda value: value < 0, "must": "not be negative"})


def _names(name: str) -> dict[str, str]:
    """Return the names of the fields for which a name with `each`, `other` or `pair` stands, by axes."""
    place = next((part for part in name.split("_") if part in _PLACES), "")
    return (
        {axes: name.replace(f"_{place}", f"_{axes}", 1) for axes in _PLACES[place]} if place else {"": name}
    )


@dataclass_transform(frozen_default=True)
def _by_axis(cls: type[T]) -> type[T]:
    """Make a frozen dataclass from a class in which one field may stand for the settings of several axes.

    A field with `each` in its name is replaced by three fields, for x, y and z. `other` gives six fields,
    for each axis with each other axis (xy, xz, …), and `pair` gives nine, which include xx, yy and zz. The
    metadata `own` of a field is the default for xx, yy and zz.
    """
    kinds: dict[str, Any] = {}
    for name, kind in cls.__annotations__.items():
        given = cls.__dict__[name]
        entry = given if isinstance(given, Field) else field(default=given)
        delattr(cls, name)
        for axes, of_axes in _names(name).items():
            own = entry.metadata.get("own", entry.default) if axes in ("xx", "yy", "zz") else entry.default
            kinds[of_axes] = kind
            setattr(cls, of_axes, field(default=own, metadata=entry.metadata))
    cls.__annotations__ = kinds
    return dataclass(frozen=True)(cls)


@_by_axis
class GyroSettings:
    """Settings of the simulated gyros; None means a value drawn from the seed for the variant.

    A gyro reads, in °/s::

        (1 + s (T − 25 °C)) (r + a |r|) + b + t (T − 25 °C) + w exp(−time since power-on / τ)
            + G f + C f² + v (supply − 5 V)

    with the rate `r` after its own gain and direction, the temperature `T` of its own die, and the force
    `f` in g as ideal accelerometers read it: level with Z up −1 on z. Rate walk, flicker and white noise
    are added; then the range and the compensations of the chip apply.

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
        Warm-up (`w`): offset at power-on, and the time constant of its decay.
    gyro_scale_x, … : float
        Gains of the gyros, 1 is perfect.
    gyro_scale_tempco_x_ppm_per_c, … : float
        Temperature coefficients of the gains (`s`).
    gyro_asymmetry_x, … : float
        Excess of the gain for positive rates over the mean gain (`a`); negative rates have as much less.
    gyro_misalignment_xy_deg, … : float
        Misalignment of the first gyro's axis towards the second axis of the gyros' frame.
    gyro_triad_x_deg, gyro_triad_y_deg, gyro_triad_z_deg : float
        Rotation (a rotation vector) of the gyros' frame against the accelerometers' frame.
    gyro_g_dps_per_g : float or None
        Effect of a force along its own axis on each gyro (`G`).
    gyro_g_sensitivity_xx_dps_per_g, … : float or None
        Effect of a force along its own axis on one gyro.
    gyro_g_sensitivity_xy_dps_per_g, … : float
        Effect of a force along the second axis on the first gyro.
    gyro_g2_sensitivity_xx_dps_per_g2, … : float
        Effect of the squared force along the second axis on the first gyro (`C`): rectification.
    gyro_supply_dps_per_v, gyro_supply_x_dps_per_v, … : float or None
        Effect of a supply other than 5 V (`v`), on all gyros and on each.
    gyro_range_gain_150, gyro_range_gain_75 : float
        Gain of the whole signal in these ranges, relative to ±300 °/s.
    gyro_saturation : float
        Saturation of the signal, in units of the present range; the words end at twice the range.
    gyro_g_compensation : float
        Fraction of G that the chip removes if MSC_CTRL[7] is set.
    accel_place_xx_mm, … : float
        Position of the first accelerometer along the second axis, from the origin of the turns.
    origin_compensation : float
        Fraction of the effect of these positions that the chip removes if MSC_CTRL[6] is set.
    die_gradient_x_c, …, die_gradient_tau_s : float
        Excess of a gyro's die temperature over the sensor in the steady state, and its time constant.
    die_lag_x_s, … : float
        Time constants with which the dies follow the temperature of the sensor; 0 for no delay.
    earth_rate_up_dps : float
        Upward part of the earth's rotation: 0.00418 °/s times the sine of the latitude.
    autonull_s, precision_autonull_s : float
        Times over which the autonulls average; 0 takes the filter's present output.
    """

    gyro_noise_dps: float | None = _not_negative(None)
    gyro_instability_dps: float = _not_negative(0.015)
    gyro_rate_walk_dps_per_rt_s: float = _not_negative(0.0)
    gyro_bias_sigma_dps: float = _not_negative(1.0)
    gyro_bias_each_dps: float | None = None
    gyro_bias_tempco_each_dps_per_c: float = 0.0
    gyro_warm_up_each_dps: float = 0.0
    gyro_warm_up_tau_s: float = _above_0(120.0)
    gyro_scale_each: float = 1.0
    gyro_scale_tempco_each_ppm_per_c: float = 0.0
    gyro_asymmetry_each: float = 0.0
    gyro_misalignment_other_deg: float = 0.0
    gyro_triad_each_deg: float = 0.0
    gyro_g_dps_per_g: float | None = None
    gyro_g_sensitivity_pair_dps_per_g: float | None = field(default=0.0, metadata={"own": None})
    gyro_g2_sensitivity_pair_dps_per_g2: float = 0.0
    gyro_supply_dps_per_v: float | None = None
    gyro_supply_each_dps_per_v: float | None = None
    gyro_range_gain_150: float = _above_0(1.0)
    gyro_range_gain_75: float = _above_0(1.0)
    gyro_saturation: float = _above_0(1.2)
    gyro_g_compensation: float = 0.9
    accel_place_pair_mm: float = 0.0
    origin_compensation: float = 0.9
    die_gradient_each_c: float = 0.0
    die_gradient_tau_s: float = _above_0(120.0)
    die_lag_each_s: float = _not_negative(0.0)
    earth_rate_up_dps: float = 0.0
    autonull_s: float = _not_negative(0.0)
    precision_autonull_s: float = _above_0(30.0)

    def by_axis(self, name: str, unstated: Floats | float = math.nan) -> Floats:
        """Return the values (n,) of a setting for several axes.

        The name has `each` (3 values), `other` (6) or `pair` (9) in the place of the axes, such as
        `bias_each_mg`. Values that are None are taken from `unstated`, (n,) or one number.
        """
        values = np.array([getattr(self, of_axes) for of_axes in _names(name).values()], np.float64)
        return np.where(np.isnan(values), unstated, values)


@_by_axis
class WorldSettings(GyroSettings):
    """Settings of the simulated world; None means a value drawn from the seed for the variant.

    The settings of the gyros are in `GyroSettings`.

    Attributes
    ----------
    alpha_deg : float or None
        Angle of the sensor at the stage's zero; drawn within ±5°.
    delta_k, delta_phi_deg : float or None
        K_x = K_y (1 + ΔK), and the misalignment Δφ of Y in the plane.
    scale_y, scale_z : float or None
        Gains K_y and K_z (1 is perfect); K_x follows from ΔK.
    skew_xz_deg, skew_yz_deg : float or None
        Differences of the angles X-Z and Y-Z from 90°, positive for smaller angles.
    bias_x_mg, bias_y_mg, bias_z_mg : float or None
        Biases at 25 °C.
    bias_tempco_x_mg_per_c, … : float or None
        Their temperature coefficients.
    scale_tempco_x_ppm_per_c, … : float or None
        Temperature coefficients of the gains.
    noise_mg, bias_instability_mg : float or None
        White noise of an unfiltered sample (rms), and the floor of the Allan deviation.
    ambient_c, ambient_drift_c_per_h, ambient_swing_c, ambient_period_s : float
        Ambient temperature: constant, drift, and amplitude and period of a sine.
    self_heating_c, self_heating_tau_s, powered_s : float
        Self-heating, its time constant, and the time for which the sensor was powered at time zero.
    temperature_offset_sigma_c, temperature_noise_c : float
        Offsets of the temperature sensors (1 sigma) and their noise.
    supply_v, supply_drift_v_per_h, supply_noise_v, aux_v : float
        Supply and auxiliary input.
    gravity_mps2 : float
        Local gravity.
    fixture_sigma_deg, backlash_deg, overshoot_deg : float
        Standard deviation of the angle error of each move; distance between the two sides of approach;
        overshoot of a move that has to come back.
    part_slip_deg, part_slip_position : float
        Slip of the sensor in its fixture, in the sense of declared angles, during the move to a position
        (moves in the plane, counted from 0).
    axis_tilt_deg : float
        Tilt of the rotation axis out of the horizontal.
    move_speed_dps : float
        Mean speed of a move.
    vibration_mg, vibration_hz, vibration_decay_s : float
        Ringing after a move stops.
    table_vibration_mg : float or None
        Largest rms of a broadband vibration of the table, on each axis and ahead of the sensor's filter.
        The first dwell has this level, because stillness is learnt there; each other dwell has a level
        drawn uniformly between 0 and this. By default 0, or five times the sensor's noise if an added
        effect follows the variance (`vibration_rectification`).
    lever_x_mm, lever_y_mm : float
        Position of the sensor relative to the stage's axis, along its X and Y, where it feels the
        acceleration of turns.
    hand_turn_deg, hand_turn_s, hand_pauses, hand_returns : float
        Turns by hand (`hand.HandTurn`): angle of each turn, time of all turns, length of the pauses between
        grips (1 is usual), and whether every second turn goes back (if not 0).
    hand_unevenness, hand_tremor_dps, hand_vibration_mg : float
        Relative unevenness of the speed, rate of turn (rms) of the tremor, linear vibration (rms of an
        axis).
    hand_sway_deg, axis_wobble_deg : float
        Sway (rms) of a sensor that is held in the hand, and wobble of the axis of a bearing.
    hand_moves : float
        If not 0, a hand brings the sensor to its positions (`hand.HandMove`) instead of a motor.
    hand_miss : float
        Error (rms) of a hand at a mark before it corrects, relative to the last grip.
    hand_stray_deg, hand_twist_deg : float
        Stray (rms) of a sensor that a hand brings to an attitude in space, and its extra turn about the
        vertical (1 sigma).
    mark_sigma_deg : float
        Standard deviation of the angle of a sensor against its mark after a turn about an axis
        (`Stage.turn_about`).
    """

    alpha_deg: float | None = None
    delta_k: float | None = None
    delta_phi_deg: float | None = None
    scale_y: float | None = None
    scale_z: float | None = None
    skew_xz_deg: float | None = None
    skew_yz_deg: float | None = None
    bias_each_mg: float | None = None
    bias_tempco_each_mg_per_c: float | None = None
    scale_tempco_each_ppm_per_c: float | None = None
    noise_mg: float | None = _not_negative(None)
    bias_instability_mg: float | None = _not_negative(None)
    ambient_c: float = 22.0
    ambient_drift_c_per_h: float = 0.0
    ambient_swing_c: float = 0.0
    ambient_period_s: float = _above_0(1200.0)
    self_heating_c: float = 3.0
    self_heating_tau_s: float = _above_0(300.0)
    powered_s: float = _not_negative(3600.0)
    temperature_offset_sigma_c: float = _not_negative(1.0)
    temperature_noise_c: float = _not_negative(0.1)
    supply_v: float = 5.0
    supply_drift_v_per_h: float = 0.0
    supply_noise_v: float = _not_negative(0.001)
    aux_v: float = 1.0
    gravity_mps2: float = _above_0(STANDARD_GRAVITY_MPS2)
    fixture_sigma_deg: float = _not_negative(0.02)
    backlash_deg: float = 0.0
    overshoot_deg: float = _not_negative(5.0)
    part_slip_deg: float = 0.0
    part_slip_position: float = 1.0
    axis_tilt_deg: float = 0.0
    move_speed_dps: float = _above_0(45.0)
    vibration_mg: float = 20.0
    vibration_hz: float = 35.0
    vibration_decay_s: float = _above_0(0.3)
    table_vibration_mg: float | None = _not_negative(None)
    lever_x_mm: float = 0.0
    lever_y_mm: float = 0.0
    hand_turn_deg: float = 365.0
    hand_turn_s: float = _above_0(50.0)
    hand_pauses: float = _not_negative(1.0)
    hand_returns: float = 0.0
    hand_unevenness: float = _not_negative(0.15)
    hand_tremor_dps: float = _not_negative(1.0)
    hand_vibration_mg: float = _not_negative(3.0)
    hand_sway_deg: float = _not_negative(0.0)
    axis_wobble_deg: float = _not_negative(0.02)
    hand_moves: float = 0.0
    hand_miss: float = _not_negative(0.03)
    hand_stray_deg: float = _not_negative(3.0)
    hand_twist_deg: float = _not_negative(10.0)
    mark_sigma_deg: float = _not_negative(0.05)

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is None:
                continue
            if not math.isfinite(value):
                raise UsageError(f"{entry.name} must be a finite number, not {value}")
            if "refused" in entry.metadata and entry.metadata["refused"](value):
                raise UsageError(f"{entry.name} must {entry.metadata['must']}, not {value}")

    @classmethod
    def from_options(cls, options: Mapping[str, str], *, others: tuple[str, ...] = ()) -> Self:
        """Create settings from texts, such as the options of a URL.

        Parameters
        ----------
        options : mapping of str to str
            Texts of the values by name of the setting.
        others : tuple of str
            Names of other options, which the caller reads itself; they are skipped, and offered as nearest
            matches.

        Raises
        ------
        UsageError
            A name is unknown (the message has the nearest one), a value is no number or not possible.
        """
        known = cls.__dataclass_fields__
        values: dict[str, float] = {}
        for name, text in options.items():
            if name in others:
                continue
            if name not in known:
                hint = suggest(name, (*others, *known))
                raise UsageError(f"the simulator has no option '{name}'; {hint}")
            try:
                values[name] = float(text)
            except ValueError:
                raise UsageError(f"{name}: '{text}' is no number") from None
        return cls(**values)


def described_settings() -> list[tuple[str, str]]:
    """Return the names of the settings in groups, each with its description and defaults.

    The descriptions are taken from the docstrings of the two classes.
    """
    default = {entry.name: entry.default for entry in fields(WorldSettings)}
    rows: list[tuple[str, str]] = []
    for settings in (WorldSettings, GyroSettings):
        listed = inspect.cleandoc(settings.__doc__ or "").split("----------\n")[-1]
        for line in listed.splitlines():
            if not line.startswith(" "):
                rows.append((line.partition(" : ")[0], ""))
            else:
                rows[-1] = (rows[-1][0], f"{rows[-1][1]} {line.strip()}".strip())
    shown = []
    for names, text in rows:
        values = [default[name] for name in names.split(", ") if name in default]
        each = dict.fromkeys("from the seed" if value is None else f"{value:g}" for value in values)
        shown.append((names, f"{text.replace('`', '')} [{', '.join(each)}]"))
    return shown
