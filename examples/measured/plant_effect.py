"""Plant an effect in a measured recording, without saying which one, and seal the answer.

    python examples/measured/plant_effect.py RECORDING.csv.gz PLANTED.csv.gz [--seed TEXT]

Writes the recording with the effect added to its accelerations, and `PLANTED.seal.json` with the answer.
The printed SHA-256 of the seal proves later that the answer was fixed before `trace` ran. Five of the
eleven kinds are in the catalogue (docs/effects.md), and six are not. Without `--seed` nobody knows the
draw.

The size is 3 to 10 times the limit that `trace` states for the unchanged recording ("it would have shown
from"). A kind that is not in the catalogue has no such limit. It is as large as a catalogued effect of the
same covariate at 3 to 10 times that effect's limit: both move the measured size of gravity by the same
rms, after the base model, the biases and the most similar effect of the catalogue are fitted.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import itertools
import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import adis_gonio

Floats = NDArray[np.float64]
AXES = "xyz"
PER_G = {"g": 1.0, "mps2": 9.80665}
"""Units of acceleration per g."""
TIMES_THE_LIMIT = (3.0, 10.0)
LARGEST_MG = 40.0
"""Largest amplitude that is planted: a shape that only shows above it is nearly one of the catalogue."""


@dataclass(frozen=True)
class Kind:
    """Kind of effect that may be planted.

    Attributes
    ----------
    catalogued : bool
        True if `name` is in the catalogue.
    reference : str
        Catalogued effect whose limit sets the size.
    covariate : str
        `reading` or `time`.
    function : callable
        Takes samples (n, 3) in g, times (n,) from 0 to 1, the axis, another axis and a generator; returns
        the values (n,) added to that axis, at unit amplitude.
    """

    name: str
    catalogued: bool
    reference: str
    covariate: str
    function: Callable[[Floats, Floats, int, int, np.random.Generator], Floats]


KINDS = (
    Kind("quadratic", True, "quadratic", "reading", lambda a, t, i, p, rng: a[:, i] ** 2),
    Kind("cubic", True, "cubic", "reading", lambda a, t, i, p, rng: a[:, i] ** 3),
    Kind("asymmetry", True, "asymmetry", "reading", lambda a, t, i, p, rng: np.abs(a[:, i])),
    Kind("cross_quadratic", True, "cross_quadratic", "reading", lambda a, t, i, p, rng: a[:, p] ** 2),
    Kind("bias_drift", True, "bias_drift", "time", lambda a, t, i, p, rng: t),
    Kind(
        "knee of the reading", False, "quadratic", "reading",
        lambda a, t, i, p, rng: np.maximum(a[:, i] - rng.uniform(-0.4, 0.4), 0.0),
    ),
    Kind(
        "ripple of the reading", False, "quadratic", "reading",
        lambda a, t, i, p, rng: np.sin(2 * np.pi * (a[:, i] / rng.uniform(0.8, 1.4) + rng.uniform())),
    ),
    Kind(
        "step of the reading", False, "quadratic", "reading",
        lambda a, t, i, p, rng: np.sign(a[:, i] - rng.uniform(-0.4, 0.4)),
    ),
    Kind(
        "jump in time", False, "bias_drift", "time",
        lambda a, t, i, p, rng: (t > rng.uniform(0.3, 0.7)).astype(float),
    ),
    Kind(
        "knee in time", False, "bias_drift", "time",
        lambda a, t, i, p, rng: np.maximum(t - rng.uniform(0.3, 0.7), 0.0),
    ),
    Kind(
        "wave in time", False, "bias_drift", "time",
        lambda a, t, i, p, rng: np.sin(2 * np.pi * (rng.uniform(0.8, 1.6) * t + rng.uniform())),
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Planting:
    """Planted effect: values (n, 3) in mg at each row of the recording, and the answer."""

    added_mg: Floats
    answer: dict[str, object]


@dataclass(frozen=True)
class Recording:
    """Samples CSV as text, with its times (n,) in s and accelerations (n, 3) in g.

    A reading in the unit of the file is `zero` + `per_g` · acceleration, each (3,).
    """

    head: list[str]
    names: list[str]
    rows: list[list[str]]
    time_s: Floats
    accel_g: Floats
    zero: Floats
    per_g: Floats

    @classmethod
    def read(cls, path: Path) -> Recording:
        """Read a samples CSV; zero and scale of `counts` are those of its fit."""
        with gzip.open(path, "rt", encoding="utf-8") as file:
            lines = file.read().splitlines()
        head = [line for line in lines if line.startswith("#")]
        (unit,) = (line.removeprefix("# accel_unit: ") for line in head if "# accel_unit: " in line)
        zero, per_g = np.zeros(3), np.full(3, PER_G.get(unit, 1.0))
        if unit == "counts":
            fitted = adis_gonio.fit(path)
            zero = np.array([fitted[f"bias_{axis}"].value for axis in AXES])
            per_g = np.array([fitted[f"scale_{axis}"].value for axis in AXES]) * PER_G["mps2"]
        elif unit not in PER_G:
            raise SystemExit(f"{path}: take a recording in counts, {' or '.join(PER_G)}")
        names, *rows = csv.reader(lines[len(head) :])
        columns = {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(names)}
        accel = np.column_stack([columns[f"a{axis}"] for axis in AXES])
        return cls(head, names, rows, columns["time_s"], (accel - zero) / per_g, zero, per_g)

    def write(self, path: Path, added_mg: Floats) -> None:
        """Write the recording with values (n, 3) added to its accelerations; all else is unchanged."""
        first = self.names.index("ax")
        accel = self.zero + (self.accel_g + added_mg / 1000) * self.per_g
        with gzip.open(path, "wt", encoding="utf-8", newline="\n") as file:
            file.write("\n".join([*self.head, ",".join(self.names)]) + "\n")
            for row, new in zip(self.rows, accel, strict=True):
                file.write(",".join([*row[:first], *(f"{a:.7f}" for a in new), *row[first + 3 :]]) + "\n")


def visible_rms(added: Floats, accel_g: Floats, similar: Sequence[Floats] = ()) -> float:
    """Rms change of the size of gravity that neither the base model nor the biases describe.

    Parameters
    ----------
    added, accel_g : (n, 3) float
        An effect at n attitudes, and the attitudes in g.
    similar : sequence of (n, 3) float
        Other effects, each of which may describe part of the change; the one that leaves least counts.
    """
    change = np.sum(added * accel_g, axis=1)
    pairs = [accel_g[:, i] * accel_g[:, j] for i in range(3) for j in range(i, 3)]
    # Gains and misalignments change |a|² by a quadratic form, the biases by a linear one.
    described = np.column_stack([*pairs, accel_g])
    remaining = []
    for other in similar or [np.zeros_like(added)]:
        columns = np.column_stack([described, np.sum(other * accel_g, axis=1)])
        remaining.append(change - columns @ np.linalg.lstsq(columns, change, rcond=None)[0])
    return min(float(np.sqrt(np.mean(part**2))) for part in remaining)


def plant(
    recording: Recording, session: adis_gonio.Session, limits: dict[str, dict], kind: Kind, rng
) -> Planting | None:
    """Draw an effect of a kind; None if this recording shows the kind only above `LARGEST_MG`.

    Parameters
    ----------
    session : Session
        The unchanged recording, for the attitudes and times of its dwells.
    limits : dict
        `detectable` of the JSON of `trace` for the unchanged recording.
    rng : numpy.random.Generator
        Source of the axis, the sign, the size and the shape.
    """
    limit = limits[kind.reference]
    # The limit is stated for the axis that shows the effect best, such as `k2_z`.
    letters = limit["parameter"].rsplit("_", 1)[1]
    axis = AXES.index(letters[0])
    other = AXES.index(letters[1]) if len(letters) > 1 else (axis + 1) % 3
    began_s, ended_s = recording.time_s[0], recording.time_s[-1]

    def values(
        which: Kind, accel_g: Floats, time_s: Floats, shape: int = 0, at: tuple[int, int] = (axis, other)
    ) -> Floats:
        part = (time_s - began_s) / (ended_s - began_s)
        added = np.zeros((len(accel_g), 3))
        added[:, at[0]] = which.function(accel_g, part, *at, np.random.default_rng(shape))
        return added

    reference = next(one for one in KINDS if one.name == kind.reference)
    # A drift is stated per minute; `values` takes the whole recording as its unit of time.
    smallest = limit["amplitude"] * ((ended_s - began_s) / 60 if kind.reference == "bias_drift" else 1.0)
    means = np.array([dwell.accel.mean(axis=0) for dwell in session.dwells])
    attitudes = (means - recording.zero) / recording.per_g
    middles_s = np.array([dwell.time_s.mean() for dwell in session.dwells])
    visible = smallest * visible_rms(values(reference, attitudes, middles_s), attitudes)
    known = [
        values(one, attitudes, middles_s, at=at)
        for one in KINDS
        if one.catalogued
        for at in itertools.permutations(range(3), 2)
    ]
    sign = rng.choice([-1.0, 1.0])
    for _ in range(100):
        times, shape = rng.uniform(*TIMES_THE_LIMIT), int(rng.integers(2**32))
        if not kind.catalogued:
            smallest = visible / visible_rms(values(kind, attitudes, middles_s, shape), attitudes, known)
        amplitude = sign * times * smallest
        if abs(amplitude) <= LARGEST_MG:
            break
    else:
        return None
    added_mg = amplitude * values(kind, recording.accel_g, recording.time_s, shape)
    answer = {
        "kind": kind.name,
        "catalogued": kind.catalogued,
        "covariate": kind.covariate,
        "axis": AXES[axis],
        "times_the_limit": round(times, 2),
        "amplitude_mg": round(float(amplitude), 4),
        "salt": secrets.token_hex(16),
    }
    return Planting(added_mg, answer)


def main() -> None:
    """Plant one effect and seal the answer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("planted", type=Path)
    parser.add_argument("--seed", default=secrets.token_hex(16), help="any text; random if not given")
    asked = parser.parse_args()
    rng = np.random.default_rng(list(asked.seed.encode()))
    recording, session = Recording.read(asked.recording), adis_gonio.load_session(asked.recording)
    limits = adis_gonio.trace(session).as_dict()["detectable"]
    planting = None
    while planting is None:
        planting = plant(recording, session, limits, KINDS[rng.integers(len(KINDS))], rng)
    recording.write(asked.planted, planting.added_mg)
    seal = asked.planted.with_name(asked.planted.name.removesuffix(".csv.gz") + ".seal.json")
    seal.write_text(json.dumps(planting.answer, indent=2) + "\n", encoding="utf-8")
    print(f"{asked.planted}: trace it; then open {seal}")
    print(f"SHA-256 of the seal: {hashlib.sha256(seal.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main()
