"""Settings of the simulated world: every figure that a person may want to change, with its unit."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Self

from adis_gonio.base.errors import UsageError
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.sim import gyro_settings
from adis_gonio.sim.gyro_settings import GyroSettings

_POSITIVE = (
    "gravity_mps2",
    "move_speed_dps",
    "self_heating_tau_s",
    "ambient_period_s",
    "vibration_decay_s",
    "hand_turn_s",
    *gyro_settings.POSITIVE,
)
_AT_LEAST_ZERO = (
    "noise_mg",
    "bias_instability_mg",
    "temperature_noise_c",
    "temperature_offset_sigma_c",
    "supply_noise_v",
    "fixture_sigma_deg",
    "powered_s",
    "overshoot_deg",
    "table_vibration_mg",
    "hand_pauses",
    "hand_unevenness",
    "hand_tremor_dps",
    "hand_vibration_mg",
    "hand_sway_deg",
    "axis_wobble_deg",
    "hand_miss",
    "hand_stray_deg",
    "hand_twist_deg",
    "mark_sigma_deg",
    *gyro_settings.AT_LEAST_ZERO,
)


@dataclass(frozen=True)
class WorldSettings(GyroSettings):
    """Settings of the world; None means drawn from the seed by the variant's figures.

    Those of the gyros are in `GyroSettings`.

    Attributes
    ----------
    alpha_deg : float or None
        Angle of the part at the stage's zero; drawn within ±5°.
    delta_k, delta_phi_deg : float or None
        K_x = K_y (1 + ΔK), and the misalignment Δφ of Y in the plane.
    scale_y, scale_z : float or None
        Gains K_y and K_z (1 is perfect); K_x follows from ΔK.
    skew_xz_deg, skew_yz_deg : float or None
        How much less than 90° the angles X-Z and Y-Z are.
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
        Self-heating, its time constant, and how long the part was powered at time zero.
    temperature_offset_sigma_c, temperature_noise_c : float
        Offsets of the temperature sensors (1 sigma) and their noise.
    supply_v, supply_drift_v_per_h, supply_noise_v, aux_v : float
        Supply and auxiliary input.
    gravity_mps2 : float
        Local gravity.
    fixture_sigma_deg, backlash_deg, overshoot_deg : float
        Standard deviation of the angle error that each move draws; how far apart the same position
        reached from both sides lies; how far a move goes past its target to turn round.
    part_slip_deg, part_slip_position : float
        By how much the part slips in its fixture, in the direction of declared angles, on the stage's way
        to a position (moves in the plane, counted from 0).
    axis_tilt_deg : float
        Tilt of the rotation axis out of the horizontal.
    move_speed_dps : float
        Mean speed of a move.
    vibration_mg, vibration_hz, vibration_decay_s : float
        Ringing after a move stops.
    table_vibration_mg : float or None
        Largest rms of a broadband vibration of the table, on each axis and ahead of the sensor's filter.
        The first dwell has the whole of it (what is at rest is learnt there), every other one a level of
        its own, uniform from 0 to this. By default none, or five times the sensor's noise where an effect
        that was added follows the variance (`vibration_rectification`).
    lever_x_mm, lever_y_mm : float
        Where the part is, from the stage's axis, along its own X and Y: it feels the turn's acceleration.
    hand_turn_deg, hand_turn_s, hand_pauses, hand_returns : float
        A turn by hand (`hand.HandTurn`): how far each goes, how long all of them take, how long the hand
        pauses between grips (1 usual), and whether (not 0) every second turn goes back.
    hand_unevenness, hand_tremor_dps, hand_vibration_mg : float
        Relative unevenness of its speed, rate of turn (rms) of its tremor, linear vibration (rms an axis).
    hand_sway_deg, axis_wobble_deg : float
        How much (rms) a part held in the hand sways, and how much the axis of a bearing wobbles.
    hand_moves : float
        Whether (not 0) a hand brings the part to its positions (`hand_moves.HandMove`), instead of a motor.
    hand_miss : float
        By how much of its last grip a hand misses a mark (rms), before it corrects.
    hand_stray_deg, hand_twist_deg : float
        How much (rms) a part that the hand brings to an attitude in space strays on its way, and how far
        (1 sigma) it turns about the vertical besides.
    mark_sigma_deg : float
        Standard deviation of the angle to which a part that was turned about an axis (`Stage.turn_about`)
        is set back against its mark.
    """

    alpha_deg: float | None = None
    delta_k: float | None = None
    delta_phi_deg: float | None = None
    scale_y: float | None = None
    scale_z: float | None = None
    skew_xz_deg: float | None = None
    skew_yz_deg: float | None = None
    bias_x_mg: float | None = None
    bias_y_mg: float | None = None
    bias_z_mg: float | None = None
    bias_tempco_x_mg_per_c: float | None = None
    bias_tempco_y_mg_per_c: float | None = None
    bias_tempco_z_mg_per_c: float | None = None
    scale_tempco_x_ppm_per_c: float | None = None
    scale_tempco_y_ppm_per_c: float | None = None
    scale_tempco_z_ppm_per_c: float | None = None
    noise_mg: float | None = None
    bias_instability_mg: float | None = None
    ambient_c: float = 22.0
    ambient_drift_c_per_h: float = 0.0
    ambient_swing_c: float = 0.0
    ambient_period_s: float = 1200.0
    self_heating_c: float = 3.0
    self_heating_tau_s: float = 300.0
    powered_s: float = 3600.0
    temperature_offset_sigma_c: float = 1.0
    temperature_noise_c: float = 0.1
    supply_v: float = 5.0
    supply_drift_v_per_h: float = 0.0
    supply_noise_v: float = 0.001
    aux_v: float = 1.0
    gravity_mps2: float = STANDARD_GRAVITY_MPS2
    fixture_sigma_deg: float = 0.02
    backlash_deg: float = 0.0
    overshoot_deg: float = 5.0
    part_slip_deg: float = 0.0
    part_slip_position: float = 1.0
    axis_tilt_deg: float = 0.0
    move_speed_dps: float = 45.0
    vibration_mg: float = 20.0
    vibration_hz: float = 35.0
    vibration_decay_s: float = 0.3
    table_vibration_mg: float | None = None
    lever_x_mm: float = 0.0
    lever_y_mm: float = 0.0
    hand_turn_deg: float = 365.0
    hand_turn_s: float = 50.0
    hand_pauses: float = 1.0
    hand_returns: float = 0.0
    hand_unevenness: float = 0.15
    hand_tremor_dps: float = 1.0
    hand_vibration_mg: float = 3.0
    hand_sway_deg: float = 0.0
    axis_wobble_deg: float = 0.02
    hand_moves: float = 0.0
    hand_miss: float = 0.03
    hand_stray_deg: float = 3.0
    hand_twist_deg: float = 10.0
    mark_sigma_deg: float = 0.05

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if value is None:
                continue
            if not math.isfinite(value):
                raise UsageError(f"{entry.name} must be a finite number, not {value}")
            if value <= 0 and entry.name in _POSITIVE:
                raise UsageError(f"{entry.name} must be above 0, not {value}")
            if value < 0 and entry.name in _AT_LEAST_ZERO:
                raise UsageError(f"{entry.name} must not be negative, not {value}")

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Names of all settings."""
        return tuple(entry.name for entry in fields(cls))

    @classmethod
    def from_options(
        cls,
        options: Mapping[str, str],
        *,
        others: tuple[str, ...] = (),
        drawn: Mapping[str, float] | None = None,
    ) -> Self:
        """Settings from text.

        Parameters
        ----------
        options : mapping of str to str
            Name and value.
        others : tuple of str
            Names that somebody else reads; they are passed over, and offered as nearest matches.
        drawn : mapping of str to float, optional
            Values of settings that the text does not give.

        Raises
        ------
        UsageError
            A name is unknown (the message has the nearest one), a value is no number or not possible.
        """
        known = cls.names()
        values: dict[str, float] = dict(drawn or {})
        for name, text in options.items():
            if name in others:
                continue
            if name not in known:
                near = difflib.get_close_matches(name, (*known, *others), n=1)
                hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join((*others, *known))}"
                raise UsageError(f"the simulator has no option '{name}'; {hint}")
            try:
                values[name] = float(text)
            except ValueError:
                raise UsageError(f"{name}: '{text}' is no number") from None
        return cls(**values)
