"""The world around the chip: attitude, sensor errors, temperature, supply, noise, effects.

Readings of the accelerometers (mg, x y z)
    ideal = G [K_x d_x, K_y (d_x sin Δφ + d_y cos Δφ), K_z (s_z · d)], with d the direction of gravity on
    the stage; reading =
    ideal (1 + tempco (T − 25 °C)) + bias + tempco (T − 25 °C) + effects + flicker + ringing + noise +
    vibration of the table (broadband, one level for each dwell). In the plane d = (cos ψ, sin ψ, 0), which
    is the convention of the samples CSV.

Noise is drawn update by update, so that the readings depend on the seed and on the settings of the chip,
but not on the grouping of frames or on the number of calls.

Not simulated
    The 350 Hz poles of the analog front ends (unfiltered samples are white, as the filter's table of gains
    supposes), turns of the axes out of the stage's plane other than the skews of Z, cross-axis response and
    nonlinearity unless an effect adds them, noise that depends on temperature, the level part of the
    earth's rotation, thermal gradients between accelerometers. Flicker ends below 3e-5 and above 1.5 Hz.

`GyroSettings` defines the readings of the gyros; `gyros` simulates their errors and die temperatures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import Variant, variant
from adis_gonio.model.effects.base import AXES, Conditions, Effect, Enters
from adis_gonio.model.effects.sensor_terms import REFERENCE_C
from adis_gonio.model.measurement import FreeAttitude, sensitivity
from adis_gonio.model.records import STANDARD_GRAVITY_MPS2
from adis_gonio.sim.gyros import Dies, GyroTriad, apply_matrix, value_or
from adis_gonio.sim.noise import Flicker
from adis_gonio.sim.sampling import Inputs
from adis_gonio.sim.settings import WorldSettings
from adis_gonio.sim.stage import Motion, Stage

GREATEST_ALPHA_DEG = 5.0
WARMING_TAU_S = 60.0
"""Time constant in s with which the sensor approaches a temperature set by `bring_to`."""
_HISTORY_STEP_S = 1.0
_DERIVATIVE_S = 1e-4
_TABLE_OVER_NOISE = 5.0
"""Vibration of the table (rms) in units of the sensor's noise.

It is the default if an effect needs a vibration.
"""

Values = Mapping[str, float] | Sequence[float] | Floats


class World:
    """The simulated surroundings of a chip: attitude, temperature, supply, and the sensor's errors.

    Parameters
    ----------
    settings : WorldSettings
        Given values; settings that are None are drawn from the seed by the figures of the variant.
    part : str or Variant
        Variant that provides the figures.
    seed : int
        Seed of all random numbers.
    day : int
        Number of the session, 0 for the first. Another day gives the same sensor with the same hidden
        parameters, but other noise and other errors of the stage.
    effects : sequence of (Effect, values)
        Effects to add to the readings; the values are by name, or in the order of the effect's parameters.
    """

    def __init__(
        self,
        settings: WorldSettings | None = None,
        *,
        part: str | Variant = "adis16354",
        seed: int = 0,
        day: int = 0,
        effects: Sequence[tuple[Effect, Values]] = (),
    ) -> None:
        self.settings = settings or WorldSettings()
        self.variant = variant(part)
        self.seed = seed
        # Separate streams, so that a change of one part leaves the draws of the others unchanged.
        self._draw(np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0]))
        source = np.random.SeedSequence([seed, day] if day else seed)
        streams = [np.random.default_rng(child) for child in source.spawn(12)]
        _, white, flicker, fixture, changes, shaking, self._level_rng = streams[:7]
        self._effect_rngs = changes.spawn(len(effects))
        self.effects = tuple(
            (
                effect,
                effect.defaults(given) if isinstance(given, Mapping) else np.asarray(given, np.float64),
            )
            for effect, given in effects
        )
        self.stage = Stage(
            self.settings, float(np.radians(self._hidden["alpha"])), fixture, streams[7], streams[9]
        )
        self.gyros = GyroTriad(self.settings, self.variant.performance, self._gyro_bias, streams[8])
        self.electronics = self.gyros.electronics
        self._dies = Dies(self.settings)
        # Position of each accelerometer (rows): of the sensor on the stage, and within the sensor.
        self._lever_m = 1e-3 * np.tile([self.settings.lever_x_mm, self.settings.lever_y_mm, 0.0], (3, 1))
        self._places_m = 1e-3 * self.settings.by_axis("accel_place_pair_mm").reshape(3, 3)
        self._warmed: list[tuple[float, float]] = []
        self._supplied: list[tuple[float, float]] = []
        figures = self.variant.performance
        self._noise_mg = value_or(self.settings.noise_mg, figures.noise_mg)
        gyro_noise = value_or(self.settings.gyro_noise_dps, figures.gyro_noise_dps)
        # White noise of accelerations, rates, temperatures and supply.
        others = [self.settings.temperature_noise_c] * 3 + [self.settings.supply_noise_v]
        self._white_sd = np.array([self._noise_mg] * 3 + [gyro_noise] * 3 + others)
        self._white = white
        floor = value_or(self.settings.bias_instability_mg, figures.bias_instability_mg)
        floors = np.array([floor] * 3 + [self.settings.gyro_instability_dps] * 3)
        self._flicker = Flicker(floors, flicker, start_s=None)
        follows = any("variance_mg2" in effect.needs for effect, _ in self.effects)
        self._table_mg = value_or(
            self.settings.table_vibration_mg, _TABLE_OVER_NOISE * self._noise_mg if follows else 0.0
        )
        self._shaking = shaking
        self._levels_mg = np.empty(0)

    def _draw(self, rng: np.random.Generator) -> None:
        """Draw all hidden parameters of the sensor.

        Parameters with a given value are drawn too, and not used: the random numbers of the other
        parameters then do not depend on which values are given.
        """
        figures, given, normal = self.variant.performance, self.settings, rng.standard_normal
        limit = figures.non_orthogonality_deg
        scale = 1 + figures.scale_error_typical * normal(3)
        self._bias = given.by_axis("bias_each_mg", figures.initial_bias_mg * normal(3))
        skew = rng.uniform(-limit, limit, 3)
        alpha = float(rng.uniform(-GREATEST_ALPHA_DEG, GREATEST_ALPHA_DEG))
        self._tempco = given.by_axis("bias_tempco_each_mg_per_c", figures.bias_tempco_mg_per_c * normal(3))
        warmer_ppm = figures.scale_tempco_ppm_per_c * normal(3)
        self._scale_tempco = 1e-6 * given.by_axis("scale_tempco_each_ppm_per_c", warmer_ppm)
        self._gyro_bias = given.by_axis("gyro_bias_each_dps", given.gyro_bias_sigma_dps * normal(3))
        self._temperature_offset = given.temperature_offset_sigma_c * normal(3)
        scale_y = value_or(given.scale_y, float(scale[1]))
        delta_k = value_or(given.delta_k, float(scale[0] / scale[1] - 1))
        delta_phi = value_or(given.delta_phi_deg, float(skew[0]))
        self._hidden = {
            "delta_k": delta_k,
            "delta_phi": delta_phi,
            "alpha": value_or(given.alpha_deg, alpha),
            "scale_x": scale_y * (1 + delta_k),
            "scale_y": scale_y,
            "scale_z": value_or(given.scale_z, float(scale[2])),
            "skew_xy": delta_phi,
            "skew_xz": value_or(given.skew_xz_deg, float(skew[1])),
            "skew_yz": value_or(given.skew_yz_deg, float(skew[2])),
        }
        in_space = FreeAttitude(self.gravity_mg).parameters
        self._sensitivity = sensitivity(np.array([self._hidden[p.name] / p.per_natural for p in in_space]))

    # -- hidden parameters -------------------------------------------------------------------------

    @property
    def gravity_mg(self) -> float:
        """Local gravity in mg (thousandths of 9.80665 m/s²)."""
        return 1000.0 * self.settings.gravity_mps2 / STANDARD_GRAVITY_MPS2

    def truth(self, time_s: Floats | None = None) -> dict[str, float]:
        """Return the true values of all hidden parameters, by the names that a fit uses.

        | name | unit | value |
        |---|---|---|
        | `delta_k`, `delta_phi` | 1, degree | base parameters of the plane |
        | `alpha` | degree | angle at the stage's zero, or at rest before a free turn, as in the fit |
        | `scale_x…` | 1 | gain; 1 is perfect |
        | `skew_xy…` | degree | 90° minus the angle between the axes |
        | `bias_x…`, `bias_temperature_x…` | mg, mg/°C | bias and its temperature coefficient |
        | `scale_temperature_x…` | 1/°C | temperature coefficient of the gain |
        | `lever_x`, `lever_y` | mm | position relative to the stage's axis |
        | `gyro_scale_x…` | 1 | gain of a gyro about the accelerometer's axis |
        | `gyro_scale_error_x…` | 1 | gain about the gyro's own axis, minus 1 |
        | `gyro_misalignment_xy…` | degree | towards the axes of the accelerometers |
        | `gyro_bias_x…` | °/s | zero rate without the effect of gravity |
        | `g_sensitivity_xy…` | °/s/g | effect of a force |
        | `g_sensitivity_left_xy…` | °/s/g | remaining effect with MSC_CTRL[7] set |
        | `g2_sensitivity_xy…` | °/s/g² | effect of a squared force |
        | `gyro_scale_temperature_x…` | 1/°C | temperature coefficient of the gain |
        | `gyro_bias_temperature_x…` | °/s/°C | temperature coefficient of the zero rate |
        | `gyro_asymmetry_x…` | 1 | excess of the gain for positive rates over the mean gain |
        | `gyro_supply_x…` | °/s/V | effect of the supply |
        | `gyro_warm_up_x…`, `gyro_warm_up_tau` | °/s, s | offset at power-on, and its time constant |
        | `gyro_range_gain_150`, `…_75` | 1 | gain in this range relative to ±300 °/s |
        | `gyro_latency` | s | delay of the gyros relative to the accelerometers |
        | `effect.parameter` | unit of the effect | parameters of added effects |

        Parameters
        ----------
        time_s : (n,) float or None
            Times in s over which temperature and supply are averaged for the biases and gains; the biases
            include the mean flicker and random walk at these times. None: 25 °C and 5 V, without flicker
            and walk.
        """
        result = dict(self._hidden)
        result["alpha"] = value_or(self.stage.free_start_deg, result["alpha"])
        result |= {"lever_x": self.settings.lever_x_mm, "lever_y": self.settings.lever_y_mm}
        result |= self.gyros.truth()
        warm, wander = 0.0, np.zeros(6)
        if time_s is not None:
            warm = float(np.mean(self.temperature_c(time_s))) - REFERENCE_C
            past = self._flicker.past_values(time_s)
            if len(past):
                wander = past.mean(axis=0)
            dies_c, supply_v = self.die_temperature_c(time_s), self.supply_v(time_s)
            result |= self.gyros.truth_at(time_s, dies_c, supply_v, wander[3:])
        result["gyro_latency"] = 0.0  # gyros and accelerometers pass the same filter
        for k, axis in enumerate(AXES):
            result[f"scale_{axis}"] *= 1 + float(self._scale_tempco[k]) * warm
            result[f"bias_{axis}"] = float(self._bias[k] + self._tempco[k] * warm + wander[k])
            result[f"bias_temperature_{axis}"] = float(self._tempco[k])
            result[f"scale_temperature_{axis}"] = float(self._scale_tempco[k])
        if warm:
            result["delta_k"] = result["scale_x"] / result["scale_y"] - 1
        for effect, values in self.effects:
            # The values of an unnamed term of a trace have no names.
            for parameter, value in zip(effect.parameters, values, strict=False):
                result[f"{effect.name}.{parameter.name}"] = float(value)
        return result

    def temperature_c(self, time_s: Floats) -> Floats:
        """Return the temperature (n,) of the sensor in °C at times (n,) in s.

        It is the sum of ambient temperature, self-heating, and changes that a user of the simulation made.
        """
        given = self.settings
        ambient = given.ambient_c + given.ambient_drift_c_per_h * time_s / 3600
        if given.ambient_swing_c:
            ambient = ambient + given.ambient_swing_c * np.sin(2 * np.pi * time_s / given.ambient_period_s)
        on_s = np.maximum(time_s + given.powered_s, 0.0)
        warmth = ambient + given.self_heating_c * -np.expm1(-on_s / given.self_heating_tau_s)
        for since_s, change in self._warmed:
            warmth = warmth + change * -np.expm1(-np.maximum(time_s - since_s, 0.0) / WARMING_TAU_S)
        return np.asarray(warmth, np.float64)

    def die_temperature_c(self, time_s: Floats) -> Floats:
        """Return the temperatures (n, 3) of the dies of the three gyros in °C at times (n,) in s."""
        return self._dies.temperature_c(time_s, self.temperature_c)

    def supply_v(self, time_s: Floats) -> Floats:
        """Return the supply voltage (n,) in V at times (n,) in s, without noise."""
        supply = self.settings.supply_v + self.settings.supply_drift_v_per_h * time_s / 3600
        for since_s, change in self._supplied:
            supply = supply + np.where(time_s >= since_s, change, 0.0)
        return np.asarray(supply, np.float64)

    def bring_to(
        self, time_s: float, temperature_c: float | None = None, supply_v: float | None = None
    ) -> None:
        """Change the sensor's temperature, the supply or both from the time `time_s` on.

        This time must not have been sampled yet. The temperature approaches `temperature_c` exponentially
        with the time constant `WARMING_TAU_S`; drifts and swings continue. None is no change.
        """
        now = np.array([time_s])
        if temperature_c is not None:
            self._warmed.append((time_s, temperature_c - float(self.temperature_c(now)[0])))
        if supply_v is not None:
            self._supplied.append((time_s, supply_v - float(self.supply_v(now)[0])))

    # -- inputs of the chip -------------------------------------------------------------------------

    def sample(self, time_s: Floats) -> Inputs:
        """Return the physical inputs of the chip at increasing times (n,) in s."""
        n = len(time_s)
        motion = self.stage.at(time_s)
        temperature = self.temperature_c(time_s)
        supply = self.supply_v(time_s)
        noise = self._white.standard_normal((n, len(self._white_sd))) * self._white_sd
        flicker = self._flicker.at(time_s)
        vibration = self._vibration_mg(motion.order)
        dies = temperature[:, None] if self._dies.alike else self.die_temperature_c(time_s)
        conditions = self._conditions(time_s, motion, dies, supply, vibration)

        # Accelerometers: gravity, faults, effects, motion, noise, and effects on samples, in this order.
        direction = self._turned(motion.direction, conditions)
        ideal = self._ideal(direction)
        warm = (temperature - REFERENCE_C)[:, None]
        accel = ideal * (1 + self._scale_tempco * warm) + self._bias + self._tempco * warm
        self._add_effects("accelerometer", accel, ideal, conditions)
        accel += flicker[:, :3]
        accel[:, :2] += motion.ringing_mg[:, None]
        moving = motion.shaking_mg
        if self._lever_m.any():
            moving = self._by_places_mg(time_s, motion, self._lever_m) + moving
        accel += moving
        places = self._by_places_mg(time_s, motion, self._places_m) if self._places_m.any() else None
        if places is not None:
            accel += places
        accel += noise[:, :3]
        if self._table_mg:
            accel += vibration[:, None] * self._shaking.standard_normal((n, 3))
        if conditions is not None:
            for (effect, values), rng in zip(self.effects, self._effect_rngs, strict=True):
                if effect.enters is Enters.SAMPLES:
                    accel = effect.samples_mg(values, accel, conditions, rng)

        # Gyros: the force in the part and the rate of turn act on each gyro.
        force = ideal + moving
        gyro = self.gyros.read(self._rate_dps(motion), force, dies, supply, time_s)
        felt = None if conditions is None else replace(conditions, force_g=force / 1000.0)
        self._add_effects("gyro", gyro, gyro, felt)
        gyro += flicker[:, 3:] + noise[:, 3:6]
        return Inputs(
            accel,
            gyro,
            dies + self._temperature_offset + noise[:, 6:9],
            supply + noise[:, 9],
            np.full(n, self.settings.aux_v),
            places,
        )

    def _add_effects(
        self, part: str, readings: Floats, before: Floats, conditions: Conditions | None
    ) -> None:
        """Add the effects on a part of the sensor, `accelerometer` or `gyro`, to its readings (n, 3).

        An effect depends on the readings `before` (n, 3), and on `conditions`, which is None without
        effects. An effect on both parts acts only on the first part that it names.
        """
        if conditions is None:
            return
        for effect, values in self.effects:
            if effect.parts[0] == part and effect.enters is Enters.READING:
                readings += effect.reading(values, before, conditions)

    def _rate_dps(self, motion: Motion) -> Floats:
        """Return the true rate of turn (n, 3) in °/s, with the vertical part of the earth's rotation.

        `motion` is the motion of the sensor at these times.
        """
        up_dps = self.settings.earth_rate_up_dps
        return motion.rate_dps - up_dps * motion.direction if up_dps else motion.rate_dps

    def _by_places_mg(self, time_s: Floats, motion: Motion, places_m: Floats) -> Floats:
        """Return the readings (n, 3) in mg that turns cause at the positions of the accelerometers.

        Each reading is minus the acceleration ω × (ω × r) + dω/dt × r along the axis of the accelerometer,
        with its position r from the axis of the turn, a row of `places_m` (3, 3) in m, and the rate of turn
        ω. `motion` is the motion of the sensor at the times (n,) in s.
        """
        rate = np.radians(motion.rate_dps)
        # Angular acceleration by central differences of the rate.
        later, earlier = (self.stage.at(time_s + step).rate_dps for step in (_DERIVATIVE_S, -_DERIVATIVE_S))
        spin = np.radians(later - earlier) / (2 * _DERIVATIVE_S)
        felt = np.empty_like(rate)
        for k, place in enumerate(places_m):
            centripetal = np.cross(rate, np.cross(rate, place))
            felt[:, k] = -(centripetal + np.cross(spin, place))[:, k]
        return felt * (1000.0 / STANDARD_GRAVITY_MPS2)

    def _ideal(self, direction: Floats) -> Floats:
        return self.gravity_mg * apply_matrix(self._sensitivity, direction)

    def _turned(self, direction: Floats, conditions: Conditions | None) -> Floats:
        if conditions is None or not any(e.enters is Enters.ATTITUDE for e, _ in self.effects):
            return direction
        angle = np.zeros(len(direction))
        for effect, values in self.effects:
            if effect.enters is Enters.ATTITUDE:
                angle += effect.attitude_rad(values, conditions)
        # Rotate gravity in the plane of x and y.
        (x, y, z), cosine, sine = direction.T, np.cos(angle), np.sin(angle)
        return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)

    def _vibration_mg(self, order: Floats) -> Floats:
        """Return the rms vibration of the table in mg (n,), which is one constant for each dwell.

        `order` (n,) has the number of the dwell at each time.
        """
        if not self._table_mg:
            return np.zeros(len(order))
        missing = int(order.max()) + 1 - len(self._levels_mg)
        if missing > 0:
            drawn = self._table_mg * self._level_rng.random(missing)
            if not len(self._levels_mg):
                # Stillness is judged by the scatter before the first move: it has to be the largest.
                drawn[0] = self._table_mg
            self._levels_mg = np.concatenate([self._levels_mg, drawn])
        return np.asarray(self._levels_mg[order.astype(np.int64)], np.float64)

    def _conditions(
        self, time_s: Floats, motion: Motion, dies_c: Floats, supply: Floats, vibration: Floats
    ) -> Conditions | None:
        """Return the conditions on which added effects depend, at times (n,) in s; None without effects.

        `dies_c` (n, 3) are the temperatures of the gyros' dies in °C, `supply` (n,) is the supply in V, and
        `vibration` (n,) the rms vibration of the table in mg.
        """
        if not self.effects:
            return None
        turned_s, directions = self.stage.course()
        rate = self._rate_dps(motion)
        history_s = np.arange(0.0, max(float(time_s[-1]), 0.0) + 2 * _HISTORY_STEP_S, _HISTORY_STEP_S)
        return Conditions(
            time_s=time_s,
            angle_rad=motion.angle_rad,
            order=motion.order,
            approach=motion.approach,
            previous_angle_rad=motion.previous_angle_rad,
            time_in_dwell_s=motion.time_in_dwell_s,
            temperature_c=self.temperature_c(time_s),
            supply_v=supply,
            temperature_history=(history_s, self.temperature_c(history_s)),
            load_history=(turned_s, self._ideal(directions)),
            variance_mg2=np.repeat((self._noise_mg**2 + vibration**2)[:, None], 3, axis=1),
            temperatures_c=np.broadcast_to(dies_c, rate.shape),
            force_g=self._ideal(motion.direction) / 1000.0,
            rate_dps=rate,
            abs_rate_dps=np.abs(rate),
        )
