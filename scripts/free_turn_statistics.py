"""The free turn against the truth and against a session of dwells, on simulated hands.

    python scripts/free_turn_statistics.py --hands 500 --seed 1 --jobs 2 --turns 2

Each hand turns a part of its own (`sim/hand.py`) twice or as often as asked, on and on or forth and back,
in 60 s of recording, rests included; gyro and accelerometers have the faults of `hand_of`. The same part is
then measured in 24 dwells of 2.5 s (`tumble`, twelve angles there and back, fixture 0.02°) and fitted by
`ml`: equal time of samples that are used. Moves and settling between the dwells, about another 50 s, count
for nothing.

Error of the angle: what the goniometer shows for readings without noise, all around the turn, minus the
true angle of gravity to X, rms. The truth of biases is their mean while they were recorded.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

import turned_parts
from adis_gonio.base.arrays import Floats, wrap_radians
from adis_gonio.base.errors import AdisGonioError
from adis_gonio.bench.recorder import TURNS
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS
from adis_gonio.fitting import FitResult, fit
from adis_gonio.model.measurement import PlanarTurn
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim import World, WorldSettings
from turned_parts import FILTER_M, words

RECORDED_S = 60.0
DWELLS = 24
PERIOD_S = 1 / 819.2
NAMES = ("delta_k", "delta_phi", "bias_x", "bias_y", "alpha")
TARGET = 1.2
BAND = (0.94, 0.96)

Row = dict[str, Any]


def hand_of(rng: np.random.Generator) -> dict[str, float]:
    """Settings of one part, its gyro and the hand that turns it, in the same time however many turns."""

    def turn(rng: np.random.Generator) -> dict[str, float]:
        return {
            "hand_turn_deg": rng.uniform(360, 380) * rng.choice([-1, 1]),
            "hand_turn_s": rng.uniform(45, 52),
        }

    return turned_parts.part_of(rng, turn, (1.0, 6.0))


def world_of(seed: int, *, returns: bool = False) -> World:
    """A part and its bench."""
    settings = hand_of(np.random.default_rng(seed)) | {"hand_returns": float(returns)}
    return World(WorldSettings(**settings), seed=seed)


def samples_of(world: World, time_s: Floats) -> tuple[Floats, Floats]:
    """Accelerometers (n, 3) in mg and gyros (n, 3) in °/s behind the chip's filter, in whole LSB."""
    felt = world.sample(time_s)
    return (
        words(felt.accel_mg, world.variant.accel_mg_per_lsb),
        words(felt.gyro_dps, GYRO_LSB_DPS[300]),
    )


def free_turn(
    seed: int, turns: int = TURNS, *, returns: bool = False
) -> tuple[Session, World, dict[str, float]]:
    """One recording of turns by hand, on and on or forth and back, and the truth of its time."""
    world = world_of(seed, returns=returns)
    time_s = 5.0 + PERIOD_S * np.arange(round(RECORDED_S / PERIOD_S))
    rest_s = (RECORDED_S - world.settings.hand_turn_s) / 2
    world.stage.turn_freely(5.0 + rest_s, turns)
    accel, gyro = samples_of(world, time_s)
    session = Session(
        (), accel_unit="mg", recording=Dwell(0, time_s, accel, gyro=gyro), free_turn=True,
        facts={"configuration": {"filter_m": FILTER_M, "gyro_range_dps": 300}},
    )  # fmt: skip
    return session, world, world.truth(time_s)


def dwells(seed: int) -> tuple[Session, World, dict[str, float]]:
    """The same part in 24 dwells of the same time in all."""
    world = world_of(seed)
    now, found = 5.0, []
    up = [360.0 * k / (DWELLS // 2) for k in range(DWELLS // 2)]
    count = round(RECORDED_S / DWELLS / PERIOD_S)
    for place, (angle, approach) in enumerate([*((a, 1) for a in up), *((a, -1) for a in up[::-1])]):
        now = world.stage.move_to(now, angle, approach) + 1.5
        time_s = now + PERIOD_S * np.arange(count)
        accel, gyro = samples_of(world, time_s)
        found.append(Dwell(place, time_s, accel, angle_deg=angle, approach=approach, gyro=gyro))
        now = float(time_s[-1]) + PERIOD_S
    session = Session(tuple(found), accel_unit="mg", fixture_sigma_deg=world.settings.fixture_sigma_deg)
    return session, world, world.truth(np.concatenate([dwell.time_s for dwell in found]))


def angle_errors_deg(result: FitResult, truth: Mapping[str, float], gravity_mg: float) -> Floats:
    """Angle of gravity to X shown minus the true one, at 72 angles of the turn."""
    model, psi = PlanarTurn(gravity_mg), np.linspace(0, 2 * math.pi, 72, endpoint=False)
    true = np.array([0.0, truth["scale_x"], truth["scale_y"], math.radians(truth["delta_phi"])])
    reading = model.ideal(true, psi, np.zeros(len(psi)))
    reading = reading + np.array([truth["bias_x"], truth["bias_y"]])
    bias = [result["bias_x"].value, result["bias_y"].value]
    scales = result["scale_x"].value, result["scale_y"].value
    base = np.array([0.0, *scales, math.radians(result["delta_phi"].value)])
    return np.asarray(np.degrees(wrap_radians(model.angle_rad(base, reading - bias) - psi)))


def one(seed: int, turns: int = TURNS, *, returns: bool = False) -> Row:
    """What one hand gives, and the dwells beside it."""
    session, world, truth = free_turn(seed, turns, returns=returns)
    row: Row = {"seed": seed}
    try:
        result = fit(session)
    except AdisGonioError as error:
        return row | {"refused": str(error)}
    errors = angle_errors_deg(result, truth, world.gravity_mg)
    shown = result.shown_angle
    assert shown is not None
    row["inside"] = {
        name: bool(abs(result[name].value - truth[name]) <= (result[name].U or 0)) for name in NAMES
    }
    row["inside"]["angle"] = float(np.mean(np.abs(errors) <= (shown.U or 0)))
    row["z"] = {name: (result[name].value - truth[name]) / (result[name].u or 1) for name in NAMES}
    row["angle_rms_deg"], row["u_angle_deg"] = float(np.sqrt((errors**2).mean())), shown.u
    session, world, truth = dwells(seed)
    other = fit(session, "ml")
    row["dwells_rms_deg"] = float(np.sqrt((angle_errors_deg(other, truth, world.gravity_mg) ** 2).mean()))
    return row


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Coverage, errors and their ratio over all hands."""
    good = [row for row in rows if "refused" not in row]
    n = len(good)
    inside = {name: float(np.mean([row["inside"][name] for row in good])) for name in (*NAMES, "angle")}
    turn, dwell = (
        math.sqrt(float(np.mean([row[name] ** 2 for row in good])))
        for name in ("angle_rms_deg", "dwells_rms_deg")
    )
    squares = np.array([[row["angle_rms_deg"] ** 2, row["dwells_rms_deg"] ** 2] for row in good])
    draws = np.random.default_rng(0).integers(0, n, (1000, n))
    ratios = np.sqrt(squares[draws, 0].mean(axis=1) / squares[draws, 1].mean(axis=1))
    return {
        "hands": len(rows),
        "refused": [row["refused"] for row in rows if "refused" in row],
        "coverage": inside,
        "coverage_u": math.sqrt(0.95 * 0.05 / n),
        "scatter_over_u": {
            name: math.sqrt(float(np.mean([row["z"][name] ** 2 for row in good]))) for name in NAMES
        },
        "angle_rms_deg": turn,
        "u_angle_deg": math.sqrt(float(np.mean([row["u_angle_deg"] ** 2 for row in good]))),
        "dwells_rms_deg": dwell,
        "ratio": turn / dwell,
        "ratio_95": [float(np.quantile(ratios, 0.025)), float(np.quantile(ratios, 0.975))],
        "target_ratio": TARGET,
    }  # fmt: skip


def run(hands: int, seed: int, jobs: int, turns: int = TURNS, *, returns: bool = False) -> list[Row]:
    """All hands; the same seed has the same parts however they are turned."""
    each = partial(one, turns=turns, returns=returns)
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(hands)]
    if jobs == 1:
        return [each(s) for s in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(each, seeds, chunksize=4))


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hands", type=int, default=500)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--turns", type=int, default=TURNS, help="turns in the same 60 s")
    parser.add_argument("--returns", action="store_true", help="every second turn goes back")
    options = parser.parse_args()
    rows = run(options.hands, options.seed, options.jobs, options.turns, returns=options.returns)
    print(json.dumps({"seed": options.seed, **summary(rows)}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
