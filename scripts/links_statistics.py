"""Poses in space with the turns between them: coverage, and what the turns gain, over simulated hands.

    python scripts/links_statistics.py --sessions 200 --seed 1 --jobs 2

Every session is a part of its own (adis16354 and adis16350 in turn) with realistic gyros
(`sim/gyros.py`), laid by a hand in up to 24 random poses, 5 s each, the way between them recorded
behind the chip's filter. Its first 4, 5, 6, 9, 14 and 24 poses are fitted by gravity alone, with the turns
and the gyros' data sheet, and with the turns and a calibration of the gyros that is off by its stated
uncertainty (gains 0.02 %, directions 0.02°, g-sensitivity 0.005 °/s/g: what `--plan gyro-turns` gives).

Then gyros that are false, in the first 9 poses: how often the turns are refused, and what the parameters
are worth where they are not.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import gyro_scale_statistics as hands
from adis_gonio.base.arrays import Floats
from adis_gonio.base.errors import FitError
from adis_gonio.base.uncertainty import Value
from adis_gonio.calibrate.gyro_calibration import GyroCalibration
from adis_gonio.fitting import FitResult, fit
from adis_gonio.fitting.estimation.readings import readings_of
from adis_gonio.fitting.methods import fit_of
from adis_gonio.model.records import Session, Turn
from adis_gonio.sim import World, WorldSettings
from typical_gyros import draw_gyros

POSES = (4, 5, 6, 9, 14, 24)
FALSE_POSES = 9
DWELL_S = 5.0
WAYS = ("alone", "sheet", "calibrated")
KINDS = ("scale", "skew", "bias")
GAIN_U, LEAN_U_DEG, G_U = 2e-4, 0.02, 0.005
PARTS = ("adis16354", "adis16350")

Row = dict[str, Any]


class Bench(hands.Table):
    """A part that a hand lays in poses, recorded all the way."""

    def pose(self, direction: Floats) -> None:
        """Bring gravity to a direction in the part, and rest there."""
        begun_s = self.now_s
        end_s = self.world.stage.orient(self.now_s + hands.REST_S, direction)
        if self.dwells:
            time_s, accel, gyro = self.record(end_s + hands.REST_S - begun_s)
            number = len(self.dwells)
            self.turns.append(Turn(number - 1, number, time_s, accel, gyro))
        else:
            self.now_s = end_s + hands.REST_S
        self.rest()


def session_of(seed: int, poses: int, part: str) -> tuple[Session, World]:
    """One session, and its world."""
    rng = np.random.default_rng(seed)
    settings = WorldSettings(hand_moves=1.0, **draw_gyros(rng))
    bench = Bench(World(settings, part=part, seed=seed))
    for direction in rng.standard_normal((poses, 3)):
        bench.pose(direction / np.linalg.norm(direction))
    recorded = tuple(bench.turns)
    return Session(
        tuple(bench.dwells), sensor=part, accel_unit="mg", plane="none", turns_from=lambda: recorded,
        facts={"configuration": {"filter_m": hands.FILTER_M, "gyro_range_dps": int(hands.RANGE_DPS)}},
    ), bench.world  # fmt: skip


def calibration_of(world: World, rng: np.random.Generator) -> GyroCalibration:
    """The gyros' truth, off by what the calibration says it may be."""
    true = world.truth(np.zeros(1))
    found = {}
    for name, u, unit in [
        *((f"gyro_bias_{i}", 0.5, "dps") for i in "xyz"),
        *((f"gyro_scale_{i}", GAIN_U, "1") for i in "xyz"),
        *((f"gyro_misalignment_{i}{j}", LEAN_U_DEG, "deg") for i in "xyz" for j in "xyz" if i != j),
        *((f"g_sensitivity_{i}{j}", G_U, "dps/g") for i in "xyz" for j in "xyz"),
    ]:
        found[name] = Value(float(true.get(name, 0.0) + u * rng.standard_normal()), u, unit)
    return GyroCalibration.of(found)


def one(seed: int, part: str = PARTS[0], false: bool = True, at: Sequence[int] = POSES) -> Row:
    """One part with all numbers of poses, and its false gyros."""
    session, world = session_of(seed, max(at), part)
    calibrated = calibration_of(world, np.random.default_rng([seed, 1]))
    row: Row = {"seed": seed, "part": part, "poses": {}, "false": {}}
    for poses in at:
        first = first_of(session, poses)
        true = truth_of(world, first)
        row["poses"][str(poses)] = {
            "alone": _told(_alone(first), true),
            "sheet": _told(_fitted(first, None), true),
            "calibrated": _told(_fitted(first, calibrated), true),
        }
    first = first_of(session, FALSE_POSES)
    true = truth_of(world, first)
    for name, spoil in FALSE.items() if false else ():
        row["false"][name] = _told(_fitted(spoilt(first, spoil), None), true)
    return row


def truth_of(world: World, session: Session) -> dict[str, float]:
    """What is true on the average of the session's dwells: biases follow temperature and 1/f noise."""
    return world.truth(np.concatenate([dwell.time_s for dwell in session.dwells]))


def first_of(session: Session, poses: int) -> Session:
    """The session's first poses."""
    turns = session.turns[: poses - 1]
    return replace(session, dwells=session.dwells[:poses], turns_from=lambda: turns)


def _alone(session: Session) -> FitResult | None:
    try:
        return fit_of(readings_of(session), "ml")
    except FitError:
        return None


def _fitted(session: Session, gyros: GyroCalibration | None) -> FitResult | None:
    try:
        return fit(session, gyros=gyros)
    except FitError:
        return None


def _told(result: FitResult | None, true: dict[str, float]) -> Row:
    if result is None:
        return {"parameters": {}}
    told: Row = {
        "parameters": {k: [one.value - true[k], one.u, one.U] for k, one in result.parameters.items()}
    }
    if result.links is not None:
        links = result.links
        told |= {"used": links.used, "chi2": links.chi2, "dof": links.dof, "why": links.why}
        told["refused"] = [why for *_, why in links.refused]
    return told


# -- gyros that are false ---------------------------------------------------------------------------------

Spoil = Callable[[Floats], Floats]


def _signs(*signs: float) -> Spoil:
    return lambda rate: rate * np.array(signs)


FALSE: dict[str, Spoil] = {
    "all signs wrong": _signs(-1, -1, -1),
    "sign of Z wrong": _signs(1, 1, -1),
    "X and Y swapped": lambda rate: rate[:, [1, 0, 2]],
    "axes in a ring": lambda rate: rate[:, [1, 2, 0]],
    "Z dead": _signs(1, 1, 0),
    "gain 10 % off": _signs(1.1, 1.1, 1.1),
    "saturated unseen at 60 °/s": lambda rate: np.clip(rate, -60, 60),
    "saturated at its range": lambda rate: np.clip(rate, -hands.RANGE_DPS / 4, hands.RANGE_DPS / 4),
}


def spoilt(session: Session, spoil: Spoil) -> Session:
    """The same with other gyros."""
    dwells = tuple(replace(d, gyro=spoil(d.gyro)) for d in session.dwells if d.gyro is not None)
    turns = tuple(replace(t, gyro=spoil(t.gyro)) for t in session.turns if t.gyro is not None)
    facts = session.facts
    if spoil is FALSE["saturated at its range"]:
        facts = {"configuration": {**facts["configuration"], "gyro_range_dps": int(hands.RANGE_DPS / 4)}}
    return replace(session, dwells=dwells, turns_from=lambda: turns, facts=facts)


# -- what came out ----------------------------------------------------------------------------------------


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Coverage and ratios by number of poses, and what became of false gyros."""
    found: dict[str, Any] = {"sessions": len(rows), "poses": {}, "false": {}}
    for poses in rows[0]["poses"]:
        at: dict[str, Any] = {}
        for way in WAYS:
            told = [row["poses"][poses][way] for row in rows]
            at[way] = {kind: _of_kind(told, kind) for kind in KINDS}
            at[way]["all"] = _of_kind(told, "")
            if way != "alone":
                at[way]["used"] = float(np.mean([one.get("used", 0) > 0 for one in told]))
                at[way]["ratio"] = {
                    part: _ratio([r for r in rows if r["part"] == part], poses, way) for part in PARTS
                }
        found["poses"][poses] = at
    for name in FALSE:
        told = [row["false"][name] for row in rows if name in row["false"]]
        found["false"][name] = {
            "sessions": len(told),
            "refused": sum(not one.get("used", 0) for one in told),
            "coverage": _of_kind(told, "")["coverage"],
            "some_left_out": sum(bool(one.get("used", 0) and one.get("refused")) for one in told),
        }
    return found


def _of_kind(told: Sequence[Row], kind: str) -> dict[str, Any]:
    """Coverage of U, how many, the share of parameters that are determined, and median u."""
    rows = [p for one in told for name, p in one["parameters"].items() if name.startswith(kind)]
    each = 3 if kind else 9
    inside = [abs(off) <= wide for off, _, wide in rows]
    return {
        "coverage": float(np.mean(inside)) if inside else None,
        "determined": len(rows) / max(each * len(told), 1),
        "scatter": float(np.sqrt(np.mean([(off / u) ** 2 for off, u, _ in rows]))) if rows else None,
        "u": float(np.median([u for _, u, _ in rows])) if rows else None,
    }


def _ratio(rows: Sequence[Row], poses: str, way: str) -> dict[str, float | None]:
    """Median of u with links over u by gravity alone, by kind."""
    found: dict[str, float | None] = {}
    for kind in KINDS:
        ratios = []
        for row in rows:
            with_links, alone = row["poses"][poses][way], row["poses"][poses]["alone"]["parameters"]
            for name, (_, u, _) in with_links["parameters"].items():
                if name.startswith(kind) and name in alone:
                    ratios.append(u / alone[name][1])
        found[kind] = float(np.median(ratios)) if ratios else None
    return found


def _seeded(task: tuple[int, str], false: bool, at: Sequence[int]) -> Row:
    return one(*task, false=false, at=at)


def run(sessions: int, seed: int, jobs: int, at: Sequence[int] = POSES) -> list[Row]:
    """All sessions with these numbers of poses, the two parts in turn."""
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(sessions)]
    tasks = [(s, PARTS[k % len(PARTS)]) for k, s in enumerate(seeds)]
    if jobs == 1:
        return [_seeded(task, false=True, at=at) for task in tasks]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(partial(_seeded, false=True, at=at), tasks, chunksize=1))


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--rows", help="file for the rows as JSON")
    options = parser.parse_args()
    rows = run(options.sessions, options.seed, options.jobs)
    if options.rows:
        Path(options.rows).write_text(json.dumps(rows), encoding="utf-8")
    print(json.dumps({"seed": options.seed, **summary(rows)}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
