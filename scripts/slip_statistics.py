"""Slips, swapped and mistyped positions that are found, and good sessions in which nothing is accused.

    python scripts/slip_statistics.py --faulty 200 --good 500 --seed 1 --jobs 2

Each session is a part of its own, moved by hand through 8 to 24 positions (in order, there and back, or
shuffled), dwells of 2 s, recorded through the chip's filter and in whole LSB, gyros with the faults of
`adis_gonio.sim.gyros`, a fixture of 0.02° to 0.3°, which the file states, and a temperature that
drifts. A faulty one has, in turn, a slip of 0.5° to 20° (during a move or after it), two positions swapped,
or one mistyped.

*Right* is: nothing else accused, the name, the position, and the true angle within 4 u. *Alike* are entries
that predict what another fault predicts (of the first and the last position): there the set of names has to
hold the true one, and the angle has to be right as well. `--still` leaves the gyros out. Beside it stands
what `slip_oracle` says of the same session.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats, wrap_degrees
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS
from adis_gonio.fitting.estimation.readings import Readings
from adis_gonio.fitting.slips.position_model import Increments, Name, possible_entries
from adis_gonio.fitting.slips.session_positions import (
    PositionFinding,
    angles_of,
    positions_of,
    search_faults,
)
from adis_gonio.model.records import Dwell, Session
from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.sampling import bartlett_sums
from detectable_slips import detectable_deg
from slip_oracle import Law, Mistakes, answer
from typical_gyros import draw_gyros

PERIOD_S = 1 / 819.2
FILTER_M = 2
DWELL_S = 2.0
FAULTS = ("slipped", "swapped", "mistyped")
WITHIN = 4.0
"""Standard uncertainties from the truth at which an angle is right."""
LEAST_DEG, MOST_DEG = 0.5, 20.0
LAW = Law(LEAST_DEG, MOST_DEG, Mistakes(possible_entries, LEAST_DEG))
"""How faults are made here, for the oracle."""

Row = dict[str, Any]


@dataclass(frozen=True)
class Truth:
    """What was done: its name, the dwell (of a swap both), where the part stood less what is declared."""

    name: str
    positions: tuple[int, ...]
    error_deg: float


def gyros_of(rng: np.random.Generator) -> dict[str, float]:
    """Faults of one part's gyros and of the hand that moves it."""
    return draw_gyros(rng) | {
        "hand_moves": 1.0,
        "hand_tremor_dps": rng.uniform(0.3, 2.0),
        "hand_vibration_mg": rng.uniform(1.0, 6.0),
        "axis_wobble_deg": rng.uniform(0.0, 0.04),
        "lever_x_mm": rng.normal(0, 40),
        "lever_y_mm": rng.normal(0, 40),
    }


def plan_of(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Angles (n,) and directions of approach: all around, there and back, or shuffled."""
    n = int(rng.integers(8, 25))
    kind = rng.choice(["around", "back", "shuffled"])
    if kind == "back":
        half = 360.0 / (n // 2) * np.arange(n // 2)
        angles = np.concatenate([half, half[::-1]])
        return angles, np.repeat([1.0, -1.0], n // 2)
    angles = np.round(360.0 / n * np.arange(n), 1)
    if kind == "shuffled":
        angles = rng.permutation(angles)
    return angles, np.zeros(n)


def session_of(seed: int, fault: str | None, *, gyros: bool = True) -> tuple[Session, Truth | None]:
    """One recorded session, and what is wrong with it."""
    rng = np.random.default_rng(seed)
    angles, approach = plan_of(rng)
    fixture = float(np.exp(rng.uniform(np.log(0.02), np.log(0.3))))
    settings = gyros_of(rng) | {
        "fixture_sigma_deg": fixture,
        "ambient_drift_c_per_h": rng.normal(0, 5.0),
        "axis_tilt_deg": rng.normal(0, 0.3),
    }
    world = World(WorldSettings(**settings), seed=seed)
    targets, declared, truth = _with_fault(rng, angles, fault)
    spans, now = [], 3.0
    for k, (target, way) in enumerate(zip(targets, approach, strict=True)):
        late = (
            truth is not None and truth.name == "slipped" and truth.positions[0] == k and rng.random() < 0.5
        )
        if late and truth is not None:  # the stage arrives, and then the part slips
            now = world.stage.move_to(now, float(target - truth.error_deg), int(way)) + rng.uniform(
                0.2, 1.0
            )
            now = world.stage.move_to(now, float(target))
        else:
            now = world.stage.move_to(now, float(target), int(way))
        now += 1.0 + rng.uniform(0, 0.5)
        spans.append((now, now + DWELL_S))
        now += DWELL_S + rng.uniform(0.1, 1.0)
    return _recorded(world, spans, declared, fixture, gyros=gyros), truth


def _with_fault(
    rng: np.random.Generator, angles: Floats, fault: str | None
) -> tuple[Floats, Floats, Truth | None]:
    """Where the stage goes, what is declared, and what is wrong with it."""
    n = len(angles)
    if fault is None:
        return angles, angles, None
    if fault == "slipped":
        k, size = int(rng.integers(1, n)), float(rng.uniform(LEAST_DEG, MOST_DEG))
        size *= rng.choice([-1, 1])
        return angles + np.where(np.arange(n) >= k, size, 0.0), angles, Truth(fault, (k,), size)
    declared = angles.copy()
    if fault == "swapped":
        while True:
            i, j = sorted(int(v) for v in rng.choice(n, 2, replace=False))
            if abs((angles[i] - angles[j] + 180) % 360 - 180) > 1.0:
                break
        declared[i], declared[j] = angles[j], angles[i]
        return angles, declared, Truth(fault, (i, j), float(angles[i] - angles[j]))
    k = int(rng.integers(0, n))
    wrong = [
        v for v in possible_entries(float(angles[k])) if abs((v - angles[k] + 180) % 360 - 180) > LEAST_DEG
    ]
    declared[k] = float(rng.choice(wrong))
    return angles, declared, Truth(fault, (k,), float(angles[k] - declared[k]))


def _recorded(
    world: World, spans: Sequence[tuple[float, float]], declared: Floats, fixture: float, *, gyros: bool
) -> Session:
    time_s = np.arange(spans[0][0], spans[-1][1], PERIOD_S)
    felt = world.sample(time_s)
    accel = _words(felt.accel_mg, world.variant.accel_mg_per_lsb)
    gyro = _words(felt.gyro_dps, GYRO_LSB_DPS[300]) if gyros else None
    warm = felt.temperature_c.mean(axis=1)
    whole = Dwell(0, time_s, accel, gyro=gyro, temperature_c=warm)
    dwells = []
    for k, (begin, end) in enumerate(spans):
        rows = slice(*np.searchsorted(time_s, [begin, end]))
        dwells.append(
            Dwell(
                k, time_s[rows], accel[rows], angle_deg=float(declared[k]),
                gyro=None if gyro is None else gyro[rows], temperature_c=warm[rows],
            )
        )  # fmt: skip
    return Session(
        tuple(dwells), accel_unit="mg", fixture_sigma_deg=fixture, recording=whole,
        facts={"configuration": {"filter_m": FILTER_M, "gyro_range_dps": 300}},
    )  # fmt: skip


def _words(values: Floats, lsb: float) -> Floats:
    fine = np.rint(values * 1024 / lsb).astype(np.int64)
    history = np.repeat(fine[:1], 2 * 2**FILTER_M - 2, axis=0)
    sums = bartlett_sums(np.concatenate([history, fine]), FILTER_M)
    return np.asarray(np.rint(sums / (1024 * 4**FILTER_M)) * lsb)


def judged(session: Session, truth: Truth | None) -> Row:
    """What was said, held against the truth."""
    found = positions_of(session)
    said = [(one.finding, one.position) for one in found]
    if truth is None:
        return {"right": not said, "said": said}
    named = sorted(said) == sorted((truth.name, k) for k in truth.positions)
    first = next((one for one in found if (truth.name, truth.positions) in _names(one)), None)
    off = None
    if first is not None:
        # What an error of the first position is, a slip right after it is with the opposite sign.
        sign = 1.0 if first.position == truth.positions[0] else -1.0
        off = wrap_degrees(first.error_deg[0] - sign * truth.error_deg)
    angles = angles_of(session)
    assert angles is not None
    searched = search_faults(*angles)
    scatter_deg = 0.0 if searched is None else np.degrees(searched.scatter.position_rad)
    allowed = WITHIN * max(np.hypot(first.error_deg[1], scatter_deg), 1e-3) if first else 0.0
    angle = off is not None and abs(off) <= allowed
    return {
        "right": bool(named and angle),
        "alike": bool(not named and len({one.position for one in found}) == 1 and angle),
        "said": said,
        "off_deg": off,
        "size_deg": abs(truth.error_deg),
        "detectable_deg": _detectable(angles, truth),
    }


def _names(found: PositionFinding) -> set[tuple[str, tuple[int, ...]]]:
    return {(named.name, named.positions) for named in found.names}


def _detectable(angles: tuple[Readings, Increments], truth: Truth) -> float | None:
    """Size from which this session shows a fault as the true one (of a swap one half of it)."""
    names: dict[str, Name] = {"slipped": "slipped", "mistyped": "misset", "swapped": "misset"}
    least = detectable_deg(*angles, names[truth.name])
    return max(least.get(k, np.inf) for k in truth.positions)


def by_oracle(session: Session, truth: Truth | None) -> Row:
    """What somebody says who knows how the sessions are made, held against the truth."""
    said = answer(session, LAW)
    row: Row = {"said": said.name, "at": list(said.positions), "probability": said.probability}
    if truth is None:
        return row | {"right": said.name == "none"}
    off = wrap_degrees(said.error_deg - truth.error_deg)
    angle = abs(off) <= WITHIN * np.hypot(said.u_deg, session.fixture_sigma_deg or 0.0)
    right = (said.name, said.positions) == (truth.name, truth.positions)
    return row | {"right": bool(right and angle)}


def one(job: tuple[int, str | None], *, gyros: bool = True) -> Row:
    """One session and what is said of it."""
    seed, fault = job
    session, truth = session_of(seed, fault, gyros=gyros)
    if not gyros:
        session = replace(session, recording=None)
    row: Row = {"seed": seed, "fault": fault, "positions": len(session.dwells),
                "fixture_deg": session.fixture_sigma_deg}  # fmt: skip
    return (
        row
        | {"at": None if truth is None else list(truth.positions)}
        | judged(session, truth)
        | {"oracle": by_oracle(session, truth)}
    )


def run(faulty: int, good: int, seed: int, jobs: int, *, gyros: bool = True) -> list[Row]:
    """All sessions."""
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(faulty + good)]
    faults: list[str | None] = [FAULTS[k % len(FAULTS)] for k in range(faulty)]
    work = list(zip(seeds, [*faults, *([None] * good)], strict=True))
    each = partial(one, gyros=gyros)
    if jobs == 1:
        return [each(job) for job in work]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(each, work, chunksize=4))


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Counts by fault, of those that a session can show, and false accusations."""
    good = [row for row in rows if row["fault"] is None]
    bad = [row for row in rows if row["fault"] is not None]
    seen = [row for row in bad if row["size_deg"] >= row["detectable_deg"]]
    return {
        **_counts(bad),
        "of_detectable": _counts(seen),
        "of_oracle": _counts([row for row in bad if row["oracle"]["right"]]),
        "by_fault": {name: _counts([row for row in bad if row["fault"] == name]) for name in FAULTS},
        "good": len(good),
        "accused": sum(not row["right"] for row in good),
        "oracle_accused": sum(not row["oracle"]["right"] for row in good),
    }


def _counts(rows: Sequence[Row]) -> dict[str, int]:
    return {
        "sessions": len(rows),
        "right": sum(row["right"] for row in rows),
        "alike": sum(row["alike"] for row in rows),
        "oracle": sum(row["oracle"]["right"] for row in rows),
    }


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--faulty", type=int, default=200)
    parser.add_argument("--good", type=int, default=500)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--still", action="store_true", help="without gyros")
    parser.add_argument("--list", action="store_true", help="print the sessions that are not right")
    options = parser.parse_args()
    rows = run(options.faulty, options.good, options.seed, options.jobs, gyros=not options.still)
    wrong = [row for row in rows if not row["right"]]
    print(
        json.dumps(
            {"seed": options.seed, **summary(rows), **({"wrong": wrong} if options.list else {})}, indent=1
        )
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
