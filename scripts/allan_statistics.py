"""The noise at rest against its truth: coverage, false claims, and what others read off the Allan plot.

    python scripts/allan_statistics.py --sessions 200 --seed 1 --jobs 2

Each session has three axes of their own noise, written here from the textbook (IEEE Std 952-1997, Annex C)
and not by the package's simulator: white noise, flicker by its spectrum B²/(2πf) on a period eight times as
long as the record, a random walk by its steps, quantization as the difference of rounded angles; behind the
chip's window, rounded to its LSB. One case comes from the simulator instead.

Beside it stands what is usual: allantools' overlapping Allan deviation, and N, B and K read off where its
slope is nearest to −½, 0 and +½; K counts as claimed where the slope reaches +¼.
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
from functools import partial
from typing import Any

import allantools
import numpy as np
from scipy import fft

from adis_gonio.base.arrays import Floats
from adis_gonio.base.uncertainty import wilson
from adis_gonio.fitting.allan import AxisNoise, fit_allan
from adis_gonio.model.records import Dwell, Session

KINDS = ("quantization", "white", "flicker", "walk")
PERIOD_S = 0.01
LSB_DPS = 0.07326
BAND = (0.94, 0.96)

Row = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One kind of recording.

    Attributes
    ----------
    truth : mapping
        Coefficients by `KINDS` in °, °/s/√Hz, °/s (floor), °/s/√s; what is not named is absent.
    samples, filter_m : int
    share : float
        Of the sessions asked for.
    simulator : bool
        By `adis_gonio.sim`, 819.2 samples a second.
    """

    truth: Mapping[str, float]
    samples: int
    filter_m: int
    share: float = 1.0
    simulator: bool = False

    @property
    def period_s(self) -> float:
        """Time between samples."""
        return 1 / 819.2 if self.simulator else PERIOD_S


CASES: dict[str, Case] = {
    "white": Case({"white": 0.05}, 1 << 14, 0),
    "white, filter M = 6": Case({"white": 0.05}, 1 << 15, 6),
    "white and flicker": Case({"white": 0.05, "flicker": 0.03}, 1 << 15, 2),
    "white and flicker, short": Case({"white": 0.05, "flicker": 0.03}, 1 << 12, 0),
    "white and walk": Case({"white": 0.05, "walk": 0.01}, 1 << 15, 0),
    "all three": Case({"white": 0.05, "flicker": 0.02, "walk": 0.012}, 1 << 17, 0),
    "all three, filter M = 6": Case({"white": 0.05, "flicker": 0.02, "walk": 0.012}, 1 << 17, 6),
    "white and quantization": Case({"white": 0.05, "quantization": 0.001}, 1 << 14, 0),
    "simulator, filter M = 2": Case(
        {"white": 0.6 / math.sqrt(819.2), "flicker": 0.015, "walk": 0.02}, 1 << 16, 2, 0.5, simulator=True
    ),
}


def noise(case: Case, rng: np.random.Generator) -> Floats:
    """Samples (n,) in °/s of one axis."""
    window = np.convolve(np.ones(1 << case.filter_m), np.ones(1 << case.filter_m))
    n = case.samples + len(window) - 1
    truth, period_s = case.truth, case.period_s
    made = truth.get("white", 0.0) / math.sqrt(period_s) * rng.standard_normal(n)
    made += truth.get("walk", 0.0) * math.sqrt(period_s) * np.cumsum(rng.standard_normal(n))
    made += truth.get("quantization", 0.0) / period_s * np.diff(rng.standard_normal(n + 1))
    if "flicker" in truth:
        made += flicker(truth["flicker"], n, rng)
    return np.convolve(made, window / window.sum(), "valid")


def flicker(floor: float, n: int, rng: np.random.Generator) -> Floats:
    """Noise (n,) with the density B²/(2πf), B = floor/√(2 ln 2/π), of normal Fourier coefficients."""
    size = fft.next_fast_len(8 * n, real=True)
    size += size % 2
    b = floor / math.sqrt(2 * math.log(2) / math.pi)
    frequency = np.arange(1, size // 2 + 1) / size
    spread = np.sqrt(b**2 / (2 * math.pi * frequency) * size / 2)
    lines = np.zeros(size // 2 + 1, complex)
    lines[1:] = spread * (rng.standard_normal(size // 2) + 1j * rng.standard_normal(size // 2))
    lines[-1] = lines[-1].real
    return np.fft.irfft(lines, size)[:n]


def simulated(case: Case, seed: int) -> Floats:
    """Gyros (n, 3) in °/s of the simulator's still part, behind its filter."""
    from adis_gonio.sim import World, WorldSettings
    from adis_gonio.sim.sampling import bartlett_sums, history_rows

    settings = WorldSettings(gyro_rate_walk_dps_per_rt_s=case.truth["walk"])
    world = World(settings, seed=seed)
    n = case.samples + history_rows(case.filter_m)
    fine = np.rint(world.sample(np.arange(n) * case.period_s).gyro_dps * 1024 / LSB_DPS).astype(np.int64)
    return np.asarray(bartlett_sums(fine, case.filter_m) / (1024 * 4**case.filter_m) * LSB_DPS)


def samples(case: Case, seed: int) -> Floats:
    """Words (n, 3) of a session as °/s."""
    rng = np.random.default_rng(seed)
    if case.simulator:
        columns = simulated(case, seed)
    else:
        columns = np.stack([noise(case, rng) for _ in range(3)], axis=1)
    return np.rint(columns / LSB_DPS) * LSB_DPS


def session_of(case: Case, gyro: Floats) -> Session:
    """A session of one long dwell."""
    time_s = np.arange(len(gyro)) * case.period_s
    dwell = Dwell(0, time_s, np.zeros((len(gyro), 3)), gyro=gyro)
    return Session((dwell,), facts={"configuration": {"filter_m": case.filter_m}})


def read_off(values: Floats, period_s: float) -> dict[str, float]:
    """N, floor and K where the slope of allantools' curve is nearest to −½, 0 and +½."""
    taus, deviation, _, _ = allantools.oadev(values, rate=1 / period_s, data_type="freq", taus="octave")
    slope = np.diff(np.log(deviation)) / np.diff(np.log(taus))

    def at(wanted: float) -> int:
        return int(np.argmin(np.abs(slope - wanted)))

    white, flat, walk = at(-0.5), at(0.0), at(0.5)
    found = {
        "white": float(deviation[white] * math.sqrt(taus[white])),
        "flicker": float(deviation[flat]),
    }
    if slope[walk] >= 0.25:
        found["walk"] = float(deviation[walk] * math.sqrt(3 / taus[walk]))
    return found


def one(seed: int, name: str) -> list[Row]:
    """One session: a row an axis."""
    case = CASES[name]
    gyro = samples(case, seed)
    found = fit_allan(session_of(case, gyro))
    return [
        {"case": name, **_of_axis(axis, case), "peer": read_off(gyro[:, k], case.period_s)}
        for k, axis in enumerate(found.axes)
    ]


def _of_axis(axis: AxisNoise, case: Case) -> Row:
    row: Row = {"adequate": axis.adequacy >= 0.01, "kinds": {}}
    for parameter in axis.parameters:
        truth = case.truth.get(parameter.kind, 0.0)
        low, high = parameter.low, parameter.high
        value = parameter.value
        row["kinds"][parameter.kind] = {
            "claimed": parameter.present,
            "inside": low <= truth <= high,
            "value": None if value is None else value.value,
            "within_U": None if value is None else abs(value.value - truth) <= (value.U or 0.0),
            "u": None if value is None else value.u,
        }
    return row


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """By case and kind: coverage and error of what is present, claims of what is absent; and the peer's."""
    return {
        name: {
            "axes": sum(row["case"] == name for row in rows),
            "inadequate": sum(row["case"] == name and not row["adequate"] for row in rows),
            "samples": case.samples,
            "filter_m": case.filter_m,
            "kinds": {
                kind: _of_kind([row for row in rows if row["case"] == name], kind, case.truth.get(kind))
                for kind in KINDS
            },
        }
        for name, case in CASES.items()
        if any(row["case"] == name for row in rows)
    }


def _of_kind(rows: Sequence[Row], kind: str, truth: float | None) -> dict[str, Any]:
    own = [row["kinds"][kind] for row in rows if kind in row["kinds"]]
    if not own:
        return {"truth": truth}
    claimed = [one for one in own if one["claimed"]]
    peer = [row["peer"][kind] for row in rows if kind in row["peer"]]
    n = len(own)
    found: dict[str, Any] = {"truth": truth, "claimed": len(claimed) / n}
    found["claimed_95"] = list(wilson(len(claimed), n))
    found["peer_claimed"] = len(peer) / n
    if truth is None:
        return found
    inside = sum(one["inside"] for one in own)
    found |= {"coverage": inside / n, "coverage_95": list(wilson(inside, n))}
    found["within_U"] = float(np.mean([one["within_U"] for one in claimed])) if claimed else None
    for key, values in (("", [one["value"] for one in claimed]), ("peer_", peer)):
        relative = np.array(values) / truth - 1
        found[f"{key}bias"] = float(np.median(relative)) if values else None
        found[f"{key}rms"] = float(np.sqrt(np.mean(relative**2))) if values else None
    return found


def run(sessions: int, seed: int, jobs: int) -> list[Row]:
    """All cases."""
    rows: list[Row] = []
    for number, (name, case) in enumerate(CASES.items()):
        count = max(1, round(sessions * case.share))
        seeds = [int(s) for s in np.random.SeedSequence([seed, number]).generate_state(count)]
        each = partial(one, name=name)
        if jobs == 1:
            rows += [row for s in seeds for row in each(s)]
            continue
        with ProcessPoolExecutor(jobs) as pool:
            rows += [row for made in pool.map(each, seeds, chunksize=4) for row in made]
    return rows


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sessions", type=int, default=200, help="of each case; three axes each")
    parser.add_argument("--seed", type=int, default=secrets.randbits(32))
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    rows = run(options.sessions, options.seed, options.jobs)
    print(json.dumps({"seed": options.seed, "cases": summary(rows)}, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
