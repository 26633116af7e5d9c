"""Gains of the gyros from whole turns by hand, against the truth and against the bound of each session.

    python scripts/gyro_scale_statistics.py --hands 500 --seed 1 --jobs 2

Each hand turns a part of its own on a table as `calibrate --plan gyro-turns` asks for: with each arrow up
five turns forth and five back between rests of 10 s, and a rest with the arrow down (`sim/hand.py`
moves, the chip's filter in between; a turn that leaves the range is made again, as the plan's guard wants
it). The gyros have gains, misalignments, linear g-sensitivities, white and 1/f noise; the accelerometers
are those of the variant, with biases and skews that nobody tells the fit.

The bound is the Cramér–Rao bound of the gain of that very session: Fisher's information of its intervals
with the true noise (white by its density, 1/f by its spectrum, integrated numerically over the lengths of
the intervals; marks with the error that two turns share), with zero rate, g-sensitivity and direction
unknown. It takes the directions of the axes as known, which the fit has to find by the accelerometers.
"""

from __future__ import annotations

import argparse
import json
import math
import secrets
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from adis_gonio.base.arrays import Floats
from adis_gonio.bench.gyro_turns import TURNS, gyro_turns_plan
from adis_gonio.device.sensor.registers import GYRO_LSB_DPS
from adis_gonio.fitting.gyros.gyro_fit import fit_gyro_readings
from adis_gonio.fitting.gyros.gyro_readings import gyro_readings_of
from adis_gonio.model.records import Dwell, Session, Turn
from adis_gonio.record.plans import Position
from adis_gonio.sim import World, WorldSettings
from adis_gonio.sim.sampling import bartlett_sums

PERIOD_S = 1 / 819.2
FILTER_M = 2
DWELL_S, REST_S = 10.0, 1.5
RANGE_DPS = 300.0
TARGET, AIM = 1.2, 2e-4
LEVEL_DEG = 0.3
"""Of the table and of the faces on which the part is laid."""
TRIES = 6
PAIRS = [f"{a}{b}" for a in "xyz" for b in "xyz" if a != b]

Row = dict[str, Any]


def part_of(rng: np.random.Generator) -> dict[str, float]:
    """Settings of one part and of the hand that turns it."""
    settings = {"hand_moves": 1.0, "move_speed_dps": rng.uniform(75, 95), "mark_sigma_deg": 0.05}
    settings |= {"hand_unevenness": rng.uniform(0.05, 0.2), "hand_tremor_dps": rng.uniform(0.3, 2.0)}
    settings |= {"hand_pauses": rng.uniform(0.2, 1.0), "hand_vibration_mg": rng.uniform(1.0, 6.0)}
    settings |= {"lever_x_mm": rng.normal(0, 20), "lever_y_mm": rng.normal(0, 20)}
    for axis in "xyz":
        settings[f"gyro_scale_{axis}"] = 1 + rng.normal(0, 0.01)
        for other in "xyz".replace(axis, ""):
            settings[f"gyro_misalignment_{axis}{other}_deg"] = rng.normal(0, 0.3)
            settings[f"gyro_g_sensitivity_{axis}{other}_dps_per_g"] = rng.normal(0, 0.05)
    return settings


class Table:
    """A part on a table: what its chip records as it is laid, turned and left."""

    def __init__(self, world: World) -> None:
        self.world, self.now_s = world, 5.0
        self.dwells: list[Dwell] = []
        self.turns: list[Turn] = []
        self.spans: list[tuple[float, float, float, int]] = []
        self._lsb = np.array([world.variant.accel_mg_per_lsb] * 3 + [GYRO_LSB_DPS[300]] * 3)
        self._history: Floats | None = None

    def record(self, seconds: float) -> tuple[Floats, Floats, Floats]:
        """Times, accelerometers in mg and gyros in °/s behind the chip's filter, in whole LSB."""
        count = round(seconds / PERIOD_S)
        time_s = self.now_s + PERIOD_S * np.arange(count)
        self.now_s += count * PERIOD_S
        felt = self.world.sample(time_s)
        fine = np.rint(np.column_stack([felt.accel_mg, felt.gyro_dps]) * 1024 / self._lsb).astype(np.int64)
        if self._history is None:
            self._history = np.repeat(fine[:1], 2 * 2**FILTER_M - 2, axis=0)
        fine = np.concatenate([self._history, fine])
        self._history = fine[len(fine) - len(self._history) :]
        words = np.rint(bartlett_sums(fine, FILTER_M) / (1024 * 4**FILTER_M)) * self._lsb
        return time_s, words[:, :3], words[:, 3:]

    def rest(self) -> None:
        """A dwell."""
        time_s, accel, gyro = self.record(DWELL_S)
        self.spans.append((float(time_s[0]), float(time_s[-1]) + PERIOD_S, 0.0, len(self.dwells)))
        self.dwells.append(Dwell(len(self.dwells), time_s, accel, gyro=gyro))

    def lay(self, reads: Sequence[float], rng: np.random.Generator) -> None:
        """Lay the part on a face."""
        level = np.asarray(reads) + math.radians(LEVEL_DEG) * rng.standard_normal(3)
        self.now_s = self.world.stage.orient(self.now_s, level) + REST_S
        self._history = None

    def turn(self, position: Position) -> None:
        """Whole turns, made again until they stay within the range."""
        for _ in range(TRIES):
            begun_s = self.now_s
            end_s = self.world.stage.turn_about(self.now_s + REST_S, position.turned_deg or 0.0)
            time_s, accel, gyro = self.record(end_s + REST_S - begun_s)
            if np.abs(gyro).max() < RANGE_DPS:
                break
        number = len(self.dwells)
        self.spans.append((begun_s, self.now_s, float(position.turned_deg or 0.0), number))
        self.turns.append(Turn(number - 1, number, time_s, accel, gyro, turned_deg=position.turned_deg))


def session_of(
    seed: int, turns: int, faces: int = 6, bias_mg: float | None = None
) -> tuple[Session, Table]:
    """One session, and the table it was made on; `bias_mg` is that of all three accelerometers."""
    rng = np.random.default_rng(seed)
    settings = part_of(rng)
    if bias_mg is not None:
        settings |= {f"bias_{axis}_mg": bias_mg for axis in "xyz"}
    table = Table(World(WorldSettings(**settings), seed=seed))
    for position in gyro_turns_plan(turns, faces).positions:
        if position.direction is not None:
            table.lay(position.direction, rng)
        else:
            table.turn(position)
        table.rest()
    recorded = tuple(table.turns)
    return Session(
        tuple(table.dwells), accel_unit="mg", plane="none", turns_from=lambda: recorded,
        fixture_sigma_deg=table.world.settings.mark_sigma_deg,
        facts={"configuration": {"filter_m": FILTER_M, "gyro_range_dps": 300}},
    ), table  # fmt: skip


def bound(table: Table, *, without: str = "") -> Floats:
    """Least standard deviation (3,) of the gains, relative, in this session.

    Parameters
    ----------
    without : str
        A cause that is left out of the noise: `white`, `flicker` or `marks`.
    """
    settings, figures = table.world.settings, table.world.variant.performance
    begin, end, turned, _ = np.array(table.spans).T
    # What a fit can leave out of a turn are the rests at its ends, but for a second.
    still = np.where(turned != 0, REST_S - 1.0, 0.0)
    begin, end = begin + still, end - still
    length, middle = end - begin, (begin + end) / 2
    noise = figures.gyro_noise_dps if settings.gyro_noise_dps is None else settings.gyro_noise_dps
    covariance = np.zeros((len(length),) * 2)
    if without != "white":
        covariance += np.diag(noise**2 * PERIOD_S / length)
    if without != "flicker":
        covariance += settings.gyro_instability_dps**2 * _flicker(length, middle)
    if without != "marks":
        # A turn ends at a mark at which the next begins, with one error; a part laid anew has a new one.
        marks = np.zeros((len(length), len(length) + 1))
        for k in np.flatnonzero(turned):
            marks[k, k + 1] = 1.0
            marks[k, k if not turned[k - 1] and not turned[k - 2] else k - 1] = -1.0
        marks *= settings.mark_sigma_deg / length[:, None]
        covariance += marks @ marks.T
    force = np.array([table.dwells[int(k)].accel.mean(axis=0) / 1000 for k in np.array(table.spans)[:, 3]])
    found = np.empty(3)
    for gyro in range(3):
        up = -np.sign(force) * (np.abs(force) > 0.5)
        rate = (turned / length)[:, None] * up
        design = np.column_stack([np.ones(len(length)), force, rate])
        information = design.T @ np.linalg.solve(covariance, design)
        found[gyro] = math.sqrt(np.linalg.inv(information)[4 + gyro, 4 + gyro])
    return found


def _flicker(length: Floats, middle: Floats) -> Floats:
    """Covariance of means over intervals of 1/f noise with an Allan variance of 1, by its spectrum."""
    frequency = np.geomspace(3e-5, 1.5, 4000)
    density = 1 / (2 * math.log(2) * frequency)
    steps = np.gradient(frequency)
    shape = np.sinc(np.outer(length, frequency)) * np.sqrt(density * steps)
    phase = 2 * np.pi * np.outer(middle, frequency)
    cosine, sine = shape * np.cos(phase), shape * np.sin(phase)
    return np.asarray(cosine @ cosine.T + sine @ sine.T)


def one(seed: int, turns: int = TURNS, faces: int = 6, bias_mg: float | None = None) -> Row:
    """What one hand gives."""
    session, table = session_of(seed, turns, faces, bias_mg)
    result = fit_gyro_readings(gyro_readings_of(session).training, scored=False)
    least, settings = bound(table), table.world.settings
    row: Row = {
        "seed": seed,
        "turns": result.turns,
        "inside": [],
        "z": [],
        "u": [],
        "bound": least.tolist(),
    }
    row["off"] = []
    for axis in "xyz":
        name = f"gyro_scale_{axis}"
        if name not in result:
            return row | {"refused": list(result.warnings)}
        one, true = result[name], getattr(settings, name)
        row["off"].append(one.value / true - 1)
        row["u"].append((one.u or 0) / true)
        row["z"].append((one.value - true) / (one.u or 1))
        row["inside"].append(bool(abs(one.value - true) <= (one.U or 0)))
    row["without"] = {
        cause: bound(table, without=cause).tolist() for cause in ("white", "flicker", "marks")
    }
    leans = [
        (result[f"gyro_misalignment_{p}"], getattr(settings, f"gyro_misalignment_{p}_deg")) for p in PAIRS
    ]
    row["lean_inside"] = [bool(abs(lean.value - true) <= (lean.U or 0)) for lean, true in leans]
    row["lean_u"] = [lean.u for lean, _ in leans]
    row["lean_z"] = [(lean.value - true) / (lean.u or 1) for lean, true in leans]
    row["length_s"] = float(table.now_s - 5.0)
    spans = np.array(table.spans)
    row["rate_dps"] = float(np.mean(np.abs(spans[:, 2] / (spans[:, 1] - spans[:, 0]))[spans[:, 2] != 0]))
    return row


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Coverage, u against the bound and the sizes, over all hands and axes."""
    good = [row for row in rows if "refused" not in row]
    u, least, off = (np.array([row[key] for row in good]) for key in ("u", "bound", "off"))
    inside = np.array([row["inside"] for row in good])
    without = {
        cause: float(
            1 - np.mean(np.array([row["without"][cause] for row in good]) ** 2) / np.mean(least**2)
        )
        for cause in ("white", "flicker", "marks")
    }
    return {
        "hands": len(rows),
        "refused": [row["refused"] for row in rows if "refused" in row],
        "coverage": float(inside.mean()),
        "coverage_u": math.sqrt(0.95 * 0.05 / inside.size),
        "coverage_of_misalignment": float(np.mean([row["lean_inside"] for row in good])),
        "coverage_by_misalignment": dict(
            zip(PAIRS, np.mean([row["lean_inside"] for row in good], axis=0).tolist(), strict=True)
        ),
        "largest_misalignment_over_u": float(np.max(np.abs([row["lean_z"] for row in good]))),
        "misalignment_u_deg_by_name": dict(
            zip(PAIRS, np.median([row["lean_u"] for row in good], axis=0).tolist(), strict=True)
        ),
        "scatter_over_u": float(np.sqrt(np.mean(np.array([row["z"] for row in good]) ** 2))),
        "u_over_bound": {
            "median": float(np.median(u / least)),
            "quantile_95": float(np.quantile(u / least, 0.95)),
            "max": float((u / least).max()),
        },
        "error_over_bound": float(np.sqrt(np.mean((off / least) ** 2))),
        "u_rms": float(np.sqrt(np.mean(u**2))),
        "error_rms": float(np.sqrt(np.mean(off**2))),
        "bound_rms": float(np.sqrt(np.mean(least**2))),
        "share_of_bound": without,
        "misalignment_u_deg": float(np.median([row["lean_u"] for row in good])),
        "rate_dps": float(np.mean([row["rate_dps"] for row in good])),
        "length_s": float(np.mean([row["length_s"] for row in good])),
        "target_ratio": TARGET,
        "aim": AIM,
    }


def run(
    hands: int,
    seed: int,
    jobs: int,
    turns: int = TURNS,
    faces: int = 6,
    bias_mg: float | None = None,
) -> list[Row]:
    """All hands."""
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(hands)]
    if jobs == 1:
        return [one(s, turns, faces, bias_mg) for s in seeds]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(partial(one, turns=turns, faces=faces, bias_mg=bias_mg), seeds, chunksize=2))


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--hands", type=int, default=500)
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--turns", type=int, default=TURNS, help="turns each way")
    parser.add_argument("--faces", type=int, default=6, help="each arrow up and down (6), or up (3)")
    parser.add_argument("--bias-mg", type=float, help="of all three accelerometers; drawn by default")
    options = parser.parse_args()
    rows = run(options.hands, options.seed, options.jobs, options.turns, options.faces, options.bias_mg)
    print(json.dumps({"seed": options.seed, **summary(rows)}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
