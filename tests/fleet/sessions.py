"""Small sessions of a fleet as samples CSV, and its rows without any file."""

from __future__ import annotations

import math
import sqlite3
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

from adis_gonio.fleet.session_record import COLUMNS

POSITIONS = 4
G_MG = 1000.0


def write_session(
    path: Path,
    rng: np.random.Generator,
    serial: str = "",
    stage: str = "",
    operator: str = "",
    title: str = "",
) -> Path:
    """A session of four positions with gains, misalignment and biases of its own, noise 1 mg."""
    gain, skew = rng.normal(0, 0.004), math.radians(rng.normal(0, 0.3))
    bias = rng.normal(0, 8, 2)
    lines = ["# sensor: adis16354", "# accel_unit: mg", "# fixture_sigma_deg: 0.02", f"# title: {title}"]
    lines += [f"# serial: {serial}", f"# stage: {stage}", f"# operator: {operator}"]
    lines += ["time_s,position,angle_deg,ax,ay"]
    for position in range(POSITIONS):
        angle = 360 * position / POSITIONS
        phi = math.radians(angle + rng.normal(0, 0.02))
        x = G_MG * (1 + gain) * math.cos(phi) + bias[0]
        y = -G_MG * math.sin(phi + skew) + bias[1]
        for k in range(6):
            t = 10 * position + 0.01 * k
            lines.append(f"{t:.2f},{position},{angle:g},{x + rng.normal():.4f},{y + rng.normal():.4f}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_fleet(folder: Path, count: int, seed: int) -> list[str]:
    """Names of so many sessions, of half as many units on four stages."""
    rng = np.random.default_rng(seed)
    folder.mkdir(exist_ok=True)
    return [
        str(write_session(folder / f"{k:03d}.csv", rng, f"SN{k // 2}", f"stage {k % 4}", f"op {k % 3}"))
        for k in range(count)
    ]


def kept_in(journal: Path) -> dict[str, str]:
    """Records of a journal by digest, while a run may write to it."""
    if not journal.exists():
        return {}
    with closing(sqlite3.connect(journal.absolute().as_uri() + "?mode=ro", uri=True)) as connection:
        with suppress(sqlite3.OperationalError):  # its tables are being made
            return dict(connection.execute("SELECT sha256, record FROM records").fetchall())
        return {}


def row(number: int, **known: Any) -> dict[str, Any]:
    """A row of a session that went well, without any value but those given."""
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {"path": f"{number:06d}.csv", "status": "ok", "reason": "", "doubts": "", "software": "test"}
    return row | {"traced": True, "adequate": True, "effects": [], "model_effects": []} | known


def quiet_rows(rng: np.random.Generator, count: int, u: float = 0.3) -> list[dict[str, Any]]:
    """A fleet in which nobody stands out: units, stages and operators drawn apart from all values."""
    names = ("quadratic", "backlash", "eccentricity")
    rows = []
    for k in range(count):
        known: dict[str, Any] = {
            "serial": f"SN{k}",
            "stage": f"stage {rng.integers(4)}",
            "operator": f"op {rng.integers(3)}",
            "effects": [name for name in names if rng.random() < 0.2],
        }
        for name in ("delta_k", "delta_phi", "bias_x", "bias_y"):
            known |= {name: rng.normal() + u * rng.normal(), f"{name}_u": u, f"{name}_dof": None}
        rows.append(row(k, **known, angle=float(np.exp(rng.normal(-3, 0.3)))))
    return rows
