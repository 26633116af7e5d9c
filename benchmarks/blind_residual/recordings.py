"""Real recordings with a known effect added, from the folder that ADIS_GONIO_DATA names.

The recordings belong to others and are read where they lie. What is added is a term of the catalogue in
what the axes read; how much it gains is reckoned against what base model and bias leave of the recording
itself.
"""

from __future__ import annotations

import gzip
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np

from .catalogue import terms
from .causes import Planted
from .circumstances import STANDARD_MPS2, Circumstances, Floats
from .generator import BINS, Truth, amplitudes, plain, plain_planted, realised_gains, seed_of
from .harness import ChallengeError
from .likelihood import linearise
from .noise import Noise

FILES = (
    "adis16350_14_poses",
    "xsens_mti_recording",
    "mpu9150_0_recording",
    "mpu9150_1_recording",
    "mpu9150_2_recording",
    "mpu9150_3_recording",
    "mpu9150_4_recording",
)
EFFECTS = ("quadratic", "cubic", "asymmetry", "cross_axis", "bias_drift", "warm_up")

_XSENS = np.array([414.4, 412.0, 414.6]), np.array([33123.9, 33275.1, 32364.5])
"""Counts per m/s² and zero of the Xsens recording (its README), to know what its axes read."""
_KEEP_ROWS = 20
"""Of the fourteen poses' 10 000 samples each one in so many is kept, so that a trace takes seconds."""
_STILL_S, _WINDOW = 1.5, 50


def folder() -> Path:
    """Where the recordings lie."""
    path = Path(os.environ.get("ADIS_GONIO_DATA", Path(__file__).parents[3] / "shared" / "data"))
    if not path.is_dir():
        raise ChallengeError(f"{path}: no recordings there; set ADIS_GONIO_DATA to their folder")
    return path


def make(secret: str, count: int, sessions: Path, truths: Path) -> None:
    """Write `count` recordings with an effect added, and their truths."""
    truths.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        csv, truth = plant(folder(), secret, number)
        (sessions / truth.id).mkdir(parents=True, exist_ok=True)
        (sessions / truth.id / "session.csv").write_text(csv, encoding="utf-8")
        truth.save(truths / f"{truth.id}.json")


def plant(data: Path, secret: str, number: int) -> tuple[str, Truth]:
    """One recording, in turn by its number, with an effect drawn from the secret."""
    rng = np.random.default_rng(seed_of(secret + " recordings", number))
    file = FILES[number % len(FILES)]
    with gzip.open(data / f"{file}.csv.gz", "rt", encoding="utf-8") as stream:
        lines = stream.read().splitlines()
    at = next(k for k, line in enumerate(lines) if not line.startswith("#"))
    keys = {k.strip(): v.strip() for k, v in (line[1:].split(":", 1) for line in lines[:at])}
    head = lines[at].split(",")
    rows = [line.split(",") for line in lines[at + 1 :]]
    if file == "adis16350_14_poses":
        rows = rows[::_KEEP_ROWS]
    columns = [head.index(axis) for axis in ("ax", "ay", "az")]
    raw = np.array([[float(row[i]) for i in columns] for row in rows])
    time_s = np.array([float(row[head.index("time_s")]) for row in rows])
    if keys["accel_unit"] == "counts":
        to_mg, zero = 1000 / STANDARD_MPS2 / _XSENS[0], _XSENS[1]
    else:
        to_mg = np.full(3, 2.522 if keys["accel_unit"] == "lsb" else 1000 / STANDARD_MPS2)
        zero = np.zeros(3)
    sample_mg = (raw - zero) * to_mg
    position = np.array([int(row[head.index("position")]) for row in rows]) if "position" in head else None
    dwells = (
        [np.flatnonzero(position == p) for p in np.unique(position)]
        if position is not None
        else still(time_s, sample_mg)
    )
    gravity = float(keys["gravity_mps2"]) / STANDARD_MPS2 * 1000
    reading = np.array([sample_mg[d].mean(axis=0) for d in dwells])
    middle = np.array([time_s[d].mean() for d in dwells])
    c = _circumstances(middle - middle[0])
    unit = [np.eye(c.n)] * 3
    first = linearise(c, reading, unit, 0.0, gravity)
    dof = max(c.n - 9, 1)
    u = float(np.sqrt(np.sum(first.e**2) / dof))
    bias = first.values[6:]
    name = EFFECTS[rng.integers(len(EFFECTS))]
    # Samples as circumstances of their own: what each axis reads without its zero, and when.
    g = (sample_mg - bias) / 1000
    every = _circumstances(time_s - middle[0])
    ways, per_dwell = terms(name, every, g), terms(name, c, first.ideal_g)
    k = int(rng.integers(len(ways)))
    size = rng.uniform(0.4, 1, len(ways[k].parameters)) * rng.choice([-1, 1], len(ways[k].parameters))
    shape = per_dwell[k].reading @ size
    known = linearise(c, reading, [np.eye(c.n) * u**2] * 3, 0.0, gravity)
    low, high = BINS[rng.integers(2, len(BINS))]
    target = float(np.exp(rng.uniform(np.log(low), np.log(high))))
    amplitude = (amplitudes(known, [Planted(shape, np.zeros(c.n))], [target]) or [0.0])[0]
    added = ways[k].reading @ size * amplitude
    changed = raw + added / to_mg
    for row, values in zip(rows, changed, strict=True):
        for i, value in zip(columns, values, strict=True):
            row[i] = f"{value:.6g}"
    after = np.array([(sample_mg + added)[d].mean(axis=0) for d in dwells])
    planted = Planted(shape * amplitude, np.zeros(c.n), detail=ways[k].label)
    gain = realised_gains(linearise(c, after, [np.eye(c.n) * u**2] * 3, 0.0, gravity), [planted])
    truth = Truth(
        f"r{number:05d}", "recording", f"{file}:{name}", [name], [],
        dict(zip(ways[k].parameters, (size * amplitude).tolist(), strict=True)), {}, [target], gain,
        False, False, 0.0, gravity, (middle - middle[0]).tolist(), 1, 1.0, [asdict(Noise(0, 1, 0, 0, u))
        for _ in range(3)], plain(c), after.tolist(), [plain_planted(planted)],
    )  # fmt: skip
    return "\n".join([*lines[: at + 1], *(",".join(row) for row in rows)]) + "\n", truth


def _circumstances(time_s: Floats) -> Circumstances:
    n = len(time_s)
    nothing, unknown = np.zeros(n), np.full(n, np.nan)
    return Circumstances(
        False,
        time_s,
        nothing,
        unknown,
        unknown,
        nothing,
        np.zeros((n, 3)),
        np.zeros(n, dtype=bool),
        np.zeros((n, 3)),
    )


def still(time_s: Floats, sample_mg: Floats) -> list[Floats]:
    """Rows of each stretch of at least 1.5 s in which no axis scatters much more than at its quietest."""
    n = len(time_s) - _WINDOW
    spread = np.array([sample_mg[k : k + _WINDOW].std(axis=0).max() for k in range(n)])
    quiet = np.flatnonzero(spread < 3 * np.quantile(spread, 0.05))
    out = []
    for run in np.split(quiet, np.flatnonzero(np.diff(quiet) > 1) + 1):
        rows = np.arange(run[0], run[-1] + _WINDOW)
        if time_s[rows[-1]] - time_s[rows[0]] >= _STILL_S + time_s[_WINDOW] - time_s[0]:
            out.append(rows)
    return out
