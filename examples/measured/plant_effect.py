"""Plant an effect in a measured recording, without saying which one, and seal the answer.

    python examples/measured/plant_effect.py RECORDING.csv.gz PLANTED.csv.gz [--seed TEXT]

Writes the recording with the effect added to its accelerations, and `PLANTED.seal.json` with the answer.
The printed SHA-256 of the seal proves later that the answer was fixed before `trace` ran. Half of the kinds
are in the catalogue of `adis-gonio effects`, and half are not. Without `--seed` nobody knows the draw.

The size is 3 to 10 times the limit that `trace` states for the unchanged recording ("it would have shown
from"). A kind that is not in the catalogue has no such limit. It is as large as a catalogued effect of the
same covariate at 3 to 10 times that effect's limit: both move the measured size of gravity by the same
rms, after the base model and the biases are fitted.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import hashlib
import json
import secrets
from collections.abc import Callable
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
LARGEST_MG = 100.0
"""Amplitude of the catalogue's bounds for effects of the reading."""


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
    """Samples CSV as text, with its times (n,) in s, accelerations (n, 3) in g, and its units per g."""

    head: list[str]
    names: list[str]
    rows: list[list[str]]
    time_s: Floats
    accel_g: Floats
    per_g: float

    @classmethod
    def read(cls, path: Path) -> Recording:
        """Read a samples CSV whose `accel_unit` is one of `PER_G`."""
        with gzip.open(path, "rt", encoding="utf-8") as file:
            lines = file.read().splitlines()
        head = [line for line in lines if line.startswith("#")]
        units = [unit for unit in PER_G if f"# accel_unit: {unit}" in head]
        if not units:
            raise SystemExit(f"{path}: take a recording whose accel_unit is one of {', '.join(PER_G)}")
        names, *rows = csv.reader(lines[len(head) :])
        columns = {name: np.array([float(row[k]) for row in rows]) for k, name in enumerate(names)}
        accel = np.column_stack([columns[f"a{axis}"] for axis in AXES])
        return cls(head, names, rows, columns["time_s"], accel / PER_G[units[0]], PER_G[units[0]])

    def write(self, path: Path, added_mg: Floats) -> None:
        """Write the recording with values (n, 3) added to its accelerations; all else is unchanged."""
        first = self.names.index("ax")
        accel = (self.accel_g + added_mg / 1000) * self.per_g
        with gzip.open(path, "wt", encoding="utf-8", newline="\n") as file:
            file.write("\n".join([*self.head, ",".join(self.names)]) + "\n")
            for row, new in zip(self.rows, accel, strict=True):
                file.write(",".join([*row[:first], *(f"{a:.7f}" for a in new), *row[first + 3 :]]) + "\n")


def visible_rms(added: Floats, accel_g: Floats) -> float:
    """Rms change of the size of gravity that neither the base model nor the biases describe.

    Parameters
    ----------
    added, accel_g : (n, 3) float
        An effect at n attitudes, and the attitudes in g.
    """
    change = np.sum(added * accel_g, axis=1)
    pairs = [accel_g[:, i] * accel_g[:, j] for i in range(3) for j in range(i, 3)]
    # Gains and misalignments change |a|² by a quadratic form, the biases by a linear one.
    described = np.column_stack([*pairs, accel_g])
    remaining = change - described @ np.linalg.lstsq(described, change, rcond=None)[0]
    return float(np.sqrt(np.mean(remaining**2)))


def plant(
    recording: Recording, session: adis_gonio.Session, limits: dict[str, dict], kind: Kind, rng
) -> Planting:
    """Draw an effect of a kind.

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

    def values(which: Kind, accel_g: Floats, time_s: Floats, shape: int) -> Floats:
        part = (time_s - began_s) / (ended_s - began_s)
        added = np.zeros((len(accel_g), 3))
        added[:, axis] = which.function(accel_g, part, axis, other, np.random.default_rng(shape))
        return added

    reference = next(one for one in KINDS if one.name == kind.reference)
    # A drift is stated per minute; `values` takes the whole recording as its unit of time.
    smallest = limit["amplitude"] * ((ended_s - began_s) / 60 if kind.reference == "bias_drift" else 1.0)
    attitudes = np.array([dwell.accel.mean(axis=0) for dwell in session.dwells]) / recording.per_g
    middles_s = np.array([dwell.time_s.mean() for dwell in session.dwells])
    visible = smallest * visible_rms(values(reference, attitudes, middles_s, 0), attitudes)
    sign = rng.choice([-1.0, 1.0])
    for _ in range(100):
        times, shape = rng.uniform(*TIMES_THE_LIMIT), int(rng.integers(2**32))
        if not kind.catalogued:
            smallest = visible / visible_rms(values(kind, attitudes, middles_s, shape), attitudes)
        amplitude = sign * times * smallest
        if abs(amplitude) <= LARGEST_MG:
            break
    else:
        raise SystemExit(f"this recording shows no {kind.name} below {LARGEST_MG:g} mg")
    added_mg = amplitude * values(kind, recording.accel_g, recording.time_s, shape)
    answer = {
        "kind": kind.name,
        "catalogued": kind.catalogued,
        "covariate": kind.covariate,
        "axis": AXES[axis],
        "times_the_limit": round(times, 2),
        "amplitude_mg": round(amplitude, 4),
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
    planting = plant(recording, session, limits, KINDS[rng.integers(len(KINDS))], rng)
    recording.write(asked.planted, planting.added_mg)
    seal = asked.planted.with_name(asked.planted.name.removesuffix(".csv.gz") + ".seal.json")
    seal.write_text(json.dumps(planting.answer, indent=2) + "\n", encoding="utf-8")
    print(f"{asked.planted}: trace it; then open {seal}")
    print(f"SHA-256 of the seal: {hashlib.sha256(seal.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main()
