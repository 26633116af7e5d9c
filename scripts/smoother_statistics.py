"""The angle during the turn against the truth, on simulated hands that turn quickly, tremble and stop.

    python scripts/smoother_statistics.py --hands 40 --seed 1 --jobs 2

Each hand turns a part of its own by 90 to 400° in some seconds, between two rests; gyro and accelerometers
have the faults of `part_of`. The accelerometers are corrected by a calibration that is as it should be (the
truth, but for drift since), the gyros by none, or by one with the errors that it states. The angle is told
by gravity alone (means of 0.1 s, as `angle` shows them), by the filter (lag 0), and by the smoother at
several lags.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

import turned_parts
from adis_gonio.base.arrays import Floats
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS
from adis_gonio.live.motion_model import AngleSmoother, GyroKnowledge, Sensing
from adis_gonio.sim import World, WorldSettings
from turned_parts import FILTER_M, words

LAGS_S = (0.0, 0.1, 0.25, 0.5, 1.0)
PERIOD_S = 1 / 819.2
REST_S = 6.0
AFTER_S = 3.0
EVERY = 82
"""Samples between two angles: ten a second."""
SETTLED_S = 4.0
"""After so long a rest at the beginning angles count."""
BEND = 1e-3
"""How much the slope of the angle is off behind such a calibration: drift of biases."""
KNOWN = {"gyro_bias_z": 0.05, "gyro_scale_z": 0.002, "g_sensitivity_zx": 0.01, "g_sensitivity_zy": 0.01}
"""Standard uncertainties of the calibration of the gyros."""

Row = dict[str, Any]


def part_of(rng: np.random.Generator) -> dict[str, float]:
    """Settings of one part, its gyro and the hand that turns it."""
    turn_deg = rng.uniform(90, 400)

    def turn(rng: np.random.Generator) -> dict[str, float]:
        return {
            "hand_turn_deg": turn_deg * rng.choice([-1, 1]),
            "hand_turn_s": turn_deg / rng.uniform(15, 60),
        }

    return turned_parts.part_of(rng, turn, (2.0, 30.0))


@dataclass(frozen=True)
class Known:
    """A calibration of the gyros with the errors that it states."""

    zero_dps: float
    scale: float
    g_dps_per_g: Floats

    def correct(self, rate_dps: Floats, force_g: Floats, temperature_c: object) -> Floats:
        """Rates (n, 3)."""
        rate = rate_dps.copy()
        rate[:, 2] = (rate[:, 2] - self.zero_dps - force_g[:, :2] @ self.g_dps_per_g) / self.scale
        return rate


@dataclass(frozen=True)
class Recording:
    """Samples of one hand, and the truth.

    Attributes
    ----------
    time_s : (n,) float
    accel_mg, gyro_dps : (n, 3) float
    world : World
    turning_s : (2,) float
        When the hand begins and ends.
    """

    time_s: Floats
    accel_mg: Floats
    gyro_dps: Floats
    world: World
    turning_s: tuple[float, float]

    def true_deg(self, time_s: Floats) -> Floats:
        """Angle of X to gravity, as `angle` counts."""
        direction = self.world.stage.at(time_s).direction
        return np.asarray(np.degrees(np.arctan2(-direction[:, 1], direction[:, 0])))

    def corrected(self, accel_mg: Floats, temperature_c: float | None = None) -> Floats:
        """Gravity (…, 3) in mg by the truth of the session, but for drift."""
        bias, gains, sine, cosine = self._faults
        unit = (accel_mg - bias) / gains
        y = (unit[..., 1] - unit[..., 0] * sine) / cosine
        return np.stack([unit[..., 0], y, unit[..., 2]], axis=-1)

    @cached_property
    def _faults(self) -> tuple[Floats, Floats, float, float]:
        """Biases and gains (3,) at the recording's temperature, sine and cosine of Δφ."""
        warm = float(self.world.temperature_c(self.time_s).mean()) - 25.0
        truth = self.world.truth()
        bias = [truth[f"bias_{a}"] + truth[f"bias_temperature_{a}"] * warm for a in "xyz"]
        gains = [truth[f"scale_{a}"] * (1 + truth[f"scale_temperature_{a}"] * warm) for a in "xyz"]
        skew = math.radians(truth["skew_xy"])
        return np.array(bias), np.array(gains), math.sin(skew), math.cos(skew)


def recording_of(seed: int, given: Mapping[str, float] | None = None) -> Recording:
    """One hand, between two rests."""
    settings = part_of(np.random.default_rng(seed)) | dict(given or {})
    world = World(WorldSettings(**settings), seed=seed)
    begin_s = 5.0 + REST_S
    end_s = world.stage.turn_freely(begin_s)
    time_s = np.arange(5.0, end_s + AFTER_S, PERIOD_S)
    felt = world.sample(time_s)
    return Recording(
        time_s,
        words(felt.accel_mg, world.variant.accel_mg_per_lsb),
        words(felt.gyro_dps, GYRO_LSB_DPS[300]),
        world,
        (begin_s, end_s),
    )


def sensing_of(recording: Recording) -> Sensing:
    """As `angle` knows the sensor."""
    figures = recording.world.variant.performance
    return Sensing(
        PERIOD_S, figures.noise_mg, figures.gyro_noise_dps, FILTER_M, 300.0, figures.bias_instability_mg,
    )  # fmt: skip


def knowledge_of(recording: Recording, seed: int, *, calibrated: bool) -> GyroKnowledge:
    """What is known of the gyro: nothing, or the truth with errors as stated."""
    if not calibrated:
        return GyroKnowledge()
    truth, rng = recording.world.truth(recording.time_s[:1]), np.random.default_rng([seed, 1])
    off = {name: u * rng.standard_normal() for name, u in KNOWN.items()}
    calibration = Known(
        truth["gyro_bias_z"] + off["gyro_bias_z"],
        truth["gyro_scale_z"] + off["gyro_scale_z"],
        np.array([truth[f"g_sensitivity_z{a}"] + off[f"g_sensitivity_z{a}"] for a in "xy"]),
    )
    return GyroKnowledge.of(calibration, KNOWN)


def wrapped(angle_deg: Floats) -> Floats:
    """Within ±180°."""
    return np.asarray((angle_deg + 180) % 360 - 180)


def told(recording: Recording, lag_s: float, knowledge: GyroKnowledge) -> Floats:
    """Times, angles, u (3, m) as they would be shown live."""
    smoother = AngleSmoother(
        sensing_of(recording), knowledge, lag_s=lag_s, corrected=recording.corrected, bend=BEND
    )
    found = []
    for begin in range(0, len(recording.time_s) - EVERY, EVERY):
        rows = slice(begin, begin + EVERY)
        smoother.feed(recording.time_s[rows], recording.accel_mg[rows], recording.gyro_dps[rows])
        angle = smoother.angle()
        if angle is not None:
            found.append((angle.time_s, angle.angle_deg, angle.u_deg))
    return np.array(found).T


def by_gravity(recording: Recording) -> Floats:
    """Times and angles (2, m) of means of 0.1 s, corrected."""
    count = len(recording.time_s) // EVERY * EVERY
    means = recording.accel_mg[:count].reshape(-1, EVERY, 3).mean(axis=1)
    gravity = recording.corrected(means)
    times = recording.time_s[:count].reshape(-1, EVERY).mean(axis=1) - sensing_of(recording).delay_s
    return np.array([times, np.degrees(np.arctan2(-gravity[:, 1], gravity[:, 0]))])


def one(seed: int, *, calibrated: bool, lags_s: Sequence[float] = LAGS_S) -> Row:
    """Errors of one hand by every way, in motion and at rest, with the share within U."""
    recording = recording_of(seed)
    knowledge = knowledge_of(recording, seed, calibrated=calibrated)
    row: Row = {"seed": seed, "gravity": _judged(recording, by_gravity(recording))}
    for lag_s in lags_s:
        row[f"{lag_s:g}"] = _judged(recording, told(recording, lag_s, knowledge))
    return row


def _judged(recording: Recording, found: Floats) -> Row:
    time_s = found[0]
    error = wrapped(found[1] - recording.true_deg(time_s))
    begin, end = recording.turning_s
    moves = (time_s > begin) & (time_s < end)
    rests = ((time_s > recording.time_s[0] + SETTLED_S) & (time_s < begin)) | (time_s > end + 1.0)
    judged: Row = {}
    for name, which in (("motion", moves), ("rest", rests)):
        judged[name] = {"n": int(which.sum()), "square": float((error[which] ** 2).sum())}
        if len(found) > 2:
            z = error[which] / found[2][which]
            judged[name] |= {"inside": int((np.abs(z) <= 1.96).sum()), "z_square": float((z**2).sum())}
    return judged


def run(
    count: int, seed: int, jobs: int, *, calibrated: bool, lags_s: Sequence[float] = LAGS_S
) -> list[Row]:
    """Many hands, each with a seed of its own."""
    seeds = [int(s) for s in np.random.default_rng(seed).integers(2**32, size=count)]
    work = partial(one, calibrated=calibrated, lags_s=lags_s)
    if jobs <= 1:
        return [work(s) for s in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(work, seeds))


def rest(seed: int, lag_s: float = 0.5) -> float:
    """Error of the angle of a part at rest, after some seconds, in units of its u."""
    world = World(WorldSettings(**part_of(np.random.default_rng(seed))), seed=seed)
    time_s = np.arange(5.0, 5.0 + REST_S, PERIOD_S)
    felt = world.sample(time_s)
    recording = Recording(
        time_s,
        words(felt.accel_mg, world.variant.accel_mg_per_lsb),
        words(felt.gyro_dps, GYRO_LSB_DPS[300]),
        world,
        (np.inf, np.inf),
    )
    smoother = AngleSmoother(sensing_of(recording), lag_s=lag_s, corrected=recording.corrected, bend=BEND)
    smoother.feed(time_s, recording.accel_mg, recording.gyro_dps)
    angle = smoother.angle()
    assert angle is not None
    error = wrapped(angle.angle_deg - recording.true_deg(np.array([angle.time_s])))
    return float(error[0]) / angle.u_deg


def rests(count: int, seed: int, jobs: int) -> Row:
    """Coverage over parts at rest: one angle of each, since the drift of a part is one draw."""
    seeds = [int(s) for s in np.random.default_rng([seed, 2]).integers(2**32, size=count)]
    if jobs <= 1:
        z = np.array([rest(s) for s in seeds])
    else:
        with ProcessPoolExecutor(jobs) as pool:
            z = np.array(list(pool.map(rest, seeds)))
    share = float(np.mean(np.abs(z) <= 1.96))
    return {
        "parts": count,
        "coverage": share,
        "coverage_u": math.sqrt(0.95 * 0.05 / count),
        "normalised_square": float(np.mean(z**2)),
    }


def summary(rows: Sequence[Row]) -> Row:
    """By way and by motion or rest: rms error, coverage with its u over hands, normalised square."""
    found: Row = {"hands": len(rows)}
    for way in (name for name in rows[0] if name != "seed"):
        found[way] = {}
        for name in ("motion", "rest"):
            each = [row[way][name] for row in rows]
            n = np.array([e["n"] for e in each], float)
            entry = {"rms_deg": math.sqrt(sum(e["square"] for e in each) / n.sum())}
            if "inside" in each[0]:
                shares = np.array([e["inside"] for e in each]) / n
                entry["coverage"] = float((shares * n).sum() / n.sum())
                entry["coverage_u"] = (
                    float(shares.std(ddof=1) / math.sqrt(len(rows))) if len(rows) > 1 else 1.0
                )
                entry["normalised_square"] = float(sum(e["z_square"] for e in each) / n.sum())
            found[way][name] = entry
    return found


def main() -> int:
    """Print the summary of gyros without and with a calibration."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hands", "--sessions", type=int, default=40, dest="hands")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--fast", action="store_true", help="three hands")
    options = parser.parse_args()
    count = 3 if options.fast else options.hands
    document: Row = {"seed": options.seed}
    document["rests"] = rests(10 * count, options.seed, options.jobs)
    for name, calibrated in (("uncalibrated", False), ("calibrated", True)):
        document[name] = summary(run(count, options.seed, options.jobs, calibrated=calibrated))
    json.dump(document, sys.stdout, indent=1)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
